"""`raytrace chromatic-focal-shift`."""

import argparse

from raytrace.cli.options import conditions, count, lens, plot

SUMMARY = "chromatic focal shift"
DESCRIPTION = "Where each wavelength has its paraxial focus, mm from that of the primary one."
EXAMPLES = """examples:
  raytrace chromatic-focal-shift cemented_achromat --plot shift.png
  raytrace chromatic-focal-shift singlet --wavelength 0.45 0.65 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    lens(parser)
    conditions(parser)
    plot(parser, "the curve")
    parser.add_argument(
        "--samples", metavar="N", type=count, default=101, help="wavelengths of the curve (default 101)"
    )
