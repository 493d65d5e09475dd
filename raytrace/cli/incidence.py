"""`raytrace incidence`."""

import argparse

from raytrace.cli.options import analysis, samples

SUMMARY = "angles of incidence"
DESCRIPTION = (
    "Angles at which the chief ray and the rim of each field's beam meet the sensor, or every surface, in degrees."
)
EXAMPLES = """examples:
  raytrace incidence phone --plot incidence.png
  raytrace incidence double_gauss --field 0 14 --surfaces --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "the curves")
    samples(parser)
    parser.add_argument("--surfaces", action="store_true", help="list every surface, not the sensor alone")
