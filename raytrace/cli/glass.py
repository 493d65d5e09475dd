"""`raytrace glass`."""

import argparse

import raytrace
from raytrace.cli.options import catalog, environment, json, positive_finite

SUMMARY = "look up a glass"
DESCRIPTION = (
    "Print index, nd, Vd, formula, range and catalog of a glass; a name that is not found gets suggestions. With a "
    "temperature or a pressure also its indices there, relative to air there, and their change with temperature."
)
EXAMPLES = """examples:
  raytrace glass N-BK7
  raytrace glass SK16 --wavelength 0.53 --json
  raytrace glass N-BK7 --temperature 40 --pressure 0
  raytrace glass MYGLASS --catalog my_glasses.agf"""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="name of a glass, as in a lens file, or a six-digit MIL code")
    catalog(parser)
    json(parser)
    parser.add_argument(
        "--wavelength",
        dest="wavelengths",
        metavar="UM",
        type=positive_finite,
        nargs="+",
        help="wavelengths in µm (default: F d C)",
    )
    environment(parser)


def run(arguments: argparse.Namespace):
    from raytrace.cli.door import catalogs

    given = {name: getattr(arguments, name) for name in ("wavelengths", "temperature", "pressure")}
    return raytrace.glass(arguments.name, catalogs=catalogs(arguments), **given)
