"""`raytrace relative-illumination`."""

import argparse

from raytrace.cli.options import analysis, samples

SUMMARY = "relative illumination"
DESCRIPTION = "Light on the sensor against the axis, from the solid angle that the rays of a uniform object fill."
EXAMPLES = """examples:
  raytrace relative-illumination phone --plot illumination.png
  raytrace relative-illumination double_gauss --field 0 10 14 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the curves")
    samples(parser)
