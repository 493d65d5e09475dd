"""`raytrace wave table`: its words and options. Imports no torch before it runs."""

import argparse

from raytrace.cli.options import json, output_folder
from raytrace.studies.edof.command import LIMIT, PICTURES
from raytrace.studies.edof.settings import Settings
from raytrace.studies.options import add_options, documents, pictures

SUMMARY = "compare elements of extended depth of field"
DESCRIPTION = """\
PSNR of restored pictures over 0.5 m to infinity for every baseline and for learned elements, behind two filters: the
Wiener filter of the PSF at 1 m with the best constant, and the best depth-invariant one (the linear filter with the
least error over all depths). On dead leaves (discs that hide one another) of two sizes, and on pictures with --data.
What is learned is kept in FOLDER, if one is given, and read again."""
EXAMPLES = """examples:
  raytrace wave table --json
  raytrace wave table --rows fresnel singlet achromat
  raytrace wave table --rows fresnel learned --also learned-images learned-adadelta -o learned
  raytrace wave table --data pictures -o learned --docs docs"""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rows", metavar="ROW", nargs="+", help="only these (default: all but those of --also)")
    parser.add_argument(
        "--also",
        metavar="ROW",
        nargs="+",
        help="rows of other ways of learning beside the others: learned-images (--loss images --filter towards), "
        "learned-adadelta (the same by Adadelta), learned-zernike (22 polynomials, no symmetry, by Adadelta)",
    )
    add_options(parser, Settings, "steps", "starts")
    pictures(parser, PICTURES, "seed", limit=LIMIT)
    output_folder(parser, "folder of learned elements")
    documents(parser, "wave_edof.md and wave/")
    json(parser)


run = "studies.edof.report.table"
