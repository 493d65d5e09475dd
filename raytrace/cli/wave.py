"""`raytrace wave`: a group of subcommands, one of the library and those that studies bring. No torch."""

import argparse

from raytrace.cli.command import Command
from raytrace.cli.options import max_bytes
from raytrace.cli.studies import words

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
    *(Command(*entry) for study in ("focusing", "edof", "superres") for entry in words(study)),
)


def options(parser: argparse.ArgumentParser) -> None:
    children = parser.add_subparsers(dest="subcommand", metavar="SUB", required=True)
    for command in SUBCOMMANDS:
        child = children.add_parser(
            command.name.removeprefix("wave-"),
            help=command.summary,
            description=command.description,
            epilog=command.examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.add_arguments(child)
        max_bytes(child)
        child.set_defaults(run=command.run)
