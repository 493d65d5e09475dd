"""`raytrace lateral-colour`."""

import argparse

from raytrace.cli.options import analysis, samples

SUMMARY = "lateral colour"
DESCRIPTION = "Height of each wavelength's chief ray on the sensor less the primary wavelength's."
EXAMPLES = """examples:
  raytrace lateral-colour tessar --plot lateral.png
  raytrace lateral-colour double_gauss --wavelength 0.5876 0.4861 0.6563 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the curves")
    samples(parser)
