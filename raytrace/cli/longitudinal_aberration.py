"""`raytrace longitudinal-aberration`."""

import argparse

from raytrace.cli.options import conditions, lens, plot, points

SUMMARY = "longitudinal aberration"
DESCRIPTION = "Where rays of the axial object point cross the axis, mm from the sensor, over their height in the pupil."
EXAMPLES = """examples:
  raytrace longitudinal-aberration tessar --plot longitudinal.png
  raytrace longitudinal-aberration cooke_triplet --wavelength 0.55 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    lens(parser)
    conditions(parser)
    plot(parser, "the curves")
    points(parser, "rays from the axis to the rim of the pupil (default 41)")
