"""`raytrace wave`: a group of subcommands, one of the library and those that studies bring. No torch."""

import argparse

from raytrace.cli.command import Command
from raytrace.cli.studies import command

SUMMARY = "phase elements: their PSFs, and learning them"

DESCRIPTION = """\
Wave optics of a thin phase element before a sensor: point spread functions (PSFs) over depth and wavelength, and
elements learned from pictures or their statistics. `raytrace wave SUB --help` teaches each by example."""

EXAMPLES = """examples:
  raytrace wave psf --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
  raytrace wave psf --element fresnel --wavelength 0.46 0.55 0.64 --json
  raytrace wave focus --json"""

SUBCOMMANDS = (
    Command.of("cli.wave_psf"),
    *map(command, ("focus", "edof", "table", "noise", "network", "free", "superres", "discover", "quantise", "etch")),
)


def options(parser: argparse.ArgumentParser) -> None:
    children = parser.add_subparsers(dest="subcommand", metavar="SUB", required=True)
    for one in SUBCOMMANDS:
        one.add_to(children, one.name.removeprefix("wave-"))
