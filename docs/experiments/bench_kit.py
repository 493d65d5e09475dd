"""Options and output that the scripts bench_*.py share."""

import argparse
from collections.abc import Callable, Sequence

from raytrace.bench.command import installed, measured
from raytrace.bench.report import Measured, Request
from raytrace.cli.options import json
from raytrace.cli.run import present, printed_on_failure
from raytrace.cli.settings import documents
from raytrace.cli.types import count

Options = Callable[[argparse.ArgumentParser], object]


def shared(parser: argparse.ArgumentParser, content: str) -> None:
    """--repeats, --threads, --no-peers, --docs and --json; content: of the folder --docs."""
    parser.add_argument("--repeats", metavar="N", type=count, default=5, help="runs, whose median is reported")
    parser.add_argument("--threads", metavar="N", type=count, default=1, help="threads of torch (default 1)")
    parser.add_argument("--no-peers", action="store_true", help="leave out Optiland even if it is installed")
    documents(parser, content)
    json(parser)


def run(bench: Callable[[Request], Measured], options: Options, argv: Sequence[str] | None, *, peers: bool) -> None:
    """Measure, write the page under --docs, and print the result. peers: whether the script measures them."""
    parser = argparse.ArgumentParser(description=bench.__doc__)
    options(parser)
    arguments = parser.parse_args(argv)
    module = installed() if peers and not arguments.no_peers else None
    result = measured(bench, arguments, arguments.threads, module)
    if arguments.docs:
        with printed_on_failure(result, arguments):
            result.save_page(arguments.docs)
    present(result, arguments)
