"""`raytrace opd-fan`."""

import argparse

from raytrace.cli.options import analysis, points, reference

SUMMARY = "OPD fans"
DESCRIPTION = (
    "Optical path difference in waves over the pupil against each wavelength's chief ray, on the reference sphere of "
    "the primary wavelength."
)
EXAMPLES = """examples:
  raytrace opd-fan tessar --plot opd.png
  raytrace opd-fan double_gauss --object-distance 25000 --reference own --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the fans")
    points(parser, "rays across the pupil (default 41)")
    reference(
        parser, "the sphere: about the point of the primary wavelength's chief ray (default), or of each one's own"
    )
