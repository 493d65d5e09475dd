"""`raytrace mtf`."""

import argparse

from raytrace.cli.options import analysis, positive_finite

SUMMARY = "modulation transfer function"
DESCRIPTION = (
    "Tangential (of patterns that vary along y) and sagittal (along x) MTF of each field, all wavelengths by their "
    "weights, through frequency or focus."
)
EXAMPLES = """examples:
  raytrace mtf double_gauss --object-distance 25000 --plot mtf.png
  raytrace mtf tessar --frequency 10 20 40 --geometric --json
  raytrace mtf tessar --frequency 20 --through-focus 0.3 --plot focus.png"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the curves")
    parser.add_argument(
        "--geometric",
        action=argparse.BooleanOptionalAction,
        help="of rays alone, without diffraction, or always of diffraction (default: of diffraction, but of rays for "
        "fields whose blur is so large that diffraction takes long and changes the modulation by less than 0.001)",
    )
    parser.add_argument(
        "--frequency",
        dest="frequencies",
        metavar="F",
        type=positive_finite,
        nargs="+",
        help="spatial frequencies, cycles/mm (default: 41 from 0 to what the sharpest field resolves, at most half of "
        "the cutoff of diffraction)",
    )
    parser.add_argument(
        "--through-focus",
        metavar="MM",
        type=positive_finite,
        help="move the sensor by ±MM, at the one frequency of --frequency",
    )
