"""`raytrace ray-fan`."""

import argparse

from raytrace.cli.options import analysis, points

SUMMARY = "ray fans"
DESCRIPTION = "Transverse ray aberration over the pupil, from the chief ray of the primary wavelength."
EXAMPLES = """examples:
  raytrace ray-fan tessar --plot fan.png
  raytrace ray-fan double_gauss --field 0 14 -10,5 --points 21 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the fans")
    points(parser, "rays across the pupil (default 41)")
