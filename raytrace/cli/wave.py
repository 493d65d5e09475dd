"""`raytrace wave`: a group of subcommands. Imports no torch."""

import argparse

from raytrace.cli.command import Command

SUMMARY = "phase elements: PSFs, design, restoration"

DESCRIPTION = """\
Wave optics of a thin phase element in front of a sensor: point spread functions (PSFs) over depth and wavelength,
design of the element together with a restoration filter, and restored images. `raytrace wave SUB --help` shows
examples."""

EXAMPLES = """examples:
  raytrace wave psf --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
  raytrace wave psf --element fresnel --wavelength 0.46 0.55 0.64 --json
  raytrace wave design --element smooth --starts 2 -o run --plot element.png
  raytrace wave restore scene.png --element run/heights.npy --simulate 500 -o simulated"""

SUBCOMMANDS = tuple(Command.of(f"cli.{name}") for name in ("wave_psf", "wave_design", "wave_restore"))


def options(parser: argparse.ArgumentParser) -> None:
    children = parser.add_subparsers(dest="subcommand", metavar="SUB", required=True)
    for command in SUBCOMMANDS:
        command.add_to(children, command.name.removeprefix("wave-"))
