"""`raytrace seidel`."""

import argparse

from raytrace.cli.options import analysis

SUMMARY = "Seidel aberrations by surface"
DESCRIPTION = (
    "Third-order aberrations S1 to S5 (spherical, coma, astigmatism, Petzval, distortion), C1, C2 (axial, lateral "
    "colour) of every surface and their sums, with y n i of the marginal and chief ray, at the largest field or those "
    "of --field."
)
EXAMPLES = """examples:
  raytrace seidel tessar --plot seidel.png
  raytrace seidel double_gauss --kind waves --field 10 14 --json"""


def options(parser: argparse.ArgumentParser) -> None:
    analysis(parser, "a bar for each surface")
    parser.add_argument(
        "--kind",
        choices=("coefficients", "waves", "transverse", "longitudinal"),
        help="S1 to C2 in mm (default), wavefront coefficients in waves, or ray aberrations in mm",
    )
