"""`python -m raytrace` is the command `raytrace`."""

from raytrace.cli import script

if __name__ == "__main__":
    script()
