"""`raytrace wavefront`."""

import argparse

from raytrace.cli.options import analysis, count, size

SUMMARY = "wavefront maps, Zernike coefficients, Strehl ratio"
DESCRIPTION = (
    "RMS and peak-to-valley OPD in waves (peak to valley over 127 points across the pupil) and the Strehl ratio; with "
    "--numbering, --terms or --json also the Zernike coefficients, Noll's in waves RMS or fringe in waves at the rim."
)
EXAMPLES = """examples:
  raytrace wavefront tessar --plot wavefront.png
  raytrace wavefront double_gauss --field 0 14 --numbering fringe --terms 16
  raytrace wavefront double_gauss --field 0 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the maps")
    size(parser, "a map (default 127)")
    parser.add_argument(
        "--numbering", choices=("noll", "fringe"), help="print the coefficients, by Noll's numbers or fringe numbers"
    )
    parser.add_argument("--terms", metavar="N", type=count, help="number of Zernike terms (default 37)")
