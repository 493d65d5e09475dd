"""`raytrace check`."""

import argparse

import raytrace
from raytrace.cli.options import lens

SUMMARY = "what was read from a lens file, and what was not"
DESCRIPTION = (
    "Print the import report: every keyword read, ignored (with the reason) or unknown, and where each glass came "
    "from. Fails if the file cannot be read; with --strict also if anything was assumed."
)
EXAMPLES = """examples:
  raytrace check lens.zmx
  raytrace check lens.zmx --strict --json"""


def options(parser: argparse.ArgumentParser) -> None:
    lens(parser)
    parser.add_argument("--strict", action="store_true", help="fail on anything unknown or assumed")


def run(arguments: argparse.Namespace):
    from raytrace.cli.door import catalogs, find_lens

    return raytrace.check(
        find_lens(arguments.lens),
        catalogs=catalogs(arguments),
        strict=arguments.strict,
        configuration=arguments.configuration,
        substitute=arguments.substitute,
    )
