"""`raytrace field-curvature`."""

import argparse

from raytrace.cli.options import analysis, samples

SUMMARY = "field curvature"
DESCRIPTION = "Tangential and sagittal foci of close rays about the chief ray, mm from the sensor."
EXAMPLES = """examples:
  raytrace field-curvature tessar --plot curvature.png
  raytrace field-curvature double_gauss --field 0 10 14 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the curves")
    samples(parser)
