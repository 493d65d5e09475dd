"""`raytrace distortion`."""

import argparse

from raytrace.cli.options import analysis, samples

SUMMARY = "distortion over the field"
DESCRIPTION = "Height of the chief ray on the sensor against f tan θ and f θ (1 = 100 % in JSON, % in text)."
EXAMPLES = """examples:
  raytrace distortion phone --plot distortion.png
  raytrace distortion double_gauss --field 5 10 14 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the curves")
    samples(parser)
