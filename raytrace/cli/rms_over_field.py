"""`raytrace rms-over-field`."""

import argparse

from raytrace.cli.options import analysis, reference, samples

SUMMARY = "RMS wavefront or spot over the field"
DESCRIPTION = (
    "RMS wavefront error in waves over the field, of each wavelength and of all together by their weights, with the "
    "Strehl ratio exp(-(2π σ)²); or the RMS spot radius."
)
EXAMPLES = """examples:
  raytrace rms-over-field tessar --plot rms.png
  raytrace rms-over-field double_gauss --spot --field 0 10 14 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the curves")
    samples(parser)
    parser.add_argument("--spot", action="store_true", help="RMS spot radius about the centroid instead")
    reference(
        parser,
        "spheres of the wavelengths together: about the primary one's chief ray (default: lateral colour counts), or "
        "each about its own",
    )
