"""`raytrace encircled-energy`."""

import argparse

from raytrace.cli.options import analysis, geometric, positive_finite

SUMMARY = "encircled energy"
DESCRIPTION = "Share of the light within a radius of the centroid of the rays, by diffraction or of rays alone."
EXAMPLES = """examples:
  raytrace encircled-energy tessar --plot encircled.png
  raytrace encircled-energy double_gauss --geometric --radius 0.005 0.01 0.02 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the curves")
    geometric(parser)
    parser.add_argument(
        "--radius",
        dest="radii",
        metavar="MM",
        type=positive_finite,
        nargs="+",
        help="radii from the centroid, mm (default: from 0 to where almost all light lies)",
    )
