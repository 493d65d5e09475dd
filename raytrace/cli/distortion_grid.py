"""`raytrace distortion-grid`."""

import argparse

from raytrace.cli.options import conditions, lens, plot, points, positive_finite

SUMMARY = "grid distortion"
DESCRIPTION = (
    "Where a square grid of object points up to the largest field lands on the sensor, against its ideal image."
)
EXAMPLES = """examples:
  raytrace distortion-grid phone --plot grid.png --exaggerate 10
  raytrace distortion-grid retrofocus --points 5 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    lens(parser)
    conditions(parser)
    plot(parser, "the ideal and the real grid")
    points(parser, "points across the grid (default 11)")
    parser.add_argument(
        "--exaggerate",
        dest="plot_exaggerate",
        metavar="N",
        type=positive_finite,
        default=1.0,
        help="draw the distortion N times as large",
    )
