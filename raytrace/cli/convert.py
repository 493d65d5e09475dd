"""`raytrace convert`."""

import argparse

import raytrace
from raytrace.cli.options import Names, catalog, configuration, file_name, file_of, json, substitute

SUMMARY = "write a lens in another format"
DESCRIPTION = "Read a lens file and write it as the suffix of OUT says. Every number comes back bit for bit."
EXAMPLES = """examples:
  raytrace convert lenses/double_gauss.zmx double_gauss.csv
  raytrace convert table.txt lens.zmx
  raytrace convert lens.zmx lens.seq"""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="IN", type=file_name, help="lens file, or the name of a shipped lens")
    parser.add_argument(
        "target",
        metavar="OUT",
        type=file_of(Names("io", "WRITTEN")),
        help="lens file to write: .zmx, .seq, .csv, .tsv, .txt",
    )
    configuration(parser)
    catalog(parser)
    substitute(parser)
    json(parser)
    parser.add_argument("--strict", action="store_true", help="fail on anything unknown or assumed in IN")


def run(arguments: argparse.Namespace):
    from raytrace.cli.door import catalogs, find_lens

    path, own = find_lens(arguments.source), catalogs(arguments)
    how = {name: getattr(arguments, name) for name in ("strict", "configuration", "substitute")}
    return raytrace.convert(path, arguments.target, catalogs=own, **how)
