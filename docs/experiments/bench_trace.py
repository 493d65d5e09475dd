"""Speed and error of the trace and of Optiland over the number of rays: tables of docs/speed.md.

    NUMBA_NUM_THREADS=1 python docs/experiments/bench_trace.py --docs FOLDER

Errors are those against a tracer of 50 digits (`bench_reference.py`). Needs the extra [bench] for Optiland.
"""

import argparse
import sys
from collections.abc import Sequence

import bench_kit as kit
from bench_figures import trace_figure
from bench_kit import Page, Request, clock_of, in_words
from bench_reference import COLUMNS, errors_of
from pages import digits, listing

from raytrace.bench.measure import DTYPES, SAMPLE, Row, Tracer, field_rays, measured_rows, surfaces_of
from raytrace.bench.trace import COUNTS, LARGEST_GRAPH, PIECES, WORKS
from raytrace.cli.progress import progress
from raytrace.cli.types import count


def bench(request: Request) -> Page:
    """One lens, several numbers of rays, this package and Optiland in turns."""
    arguments, lens = request.arguments, request.open_lens(request.arguments.lens)
    counts, repeats = sorted(arguments.rays or COUNTS), arguments.repeats
    tracers = [Tracer(lens, dtype, with_path=path) for dtype in DTYPES for path in (True, False)]
    tracers += request.peers.peers(lens) if request.peers else []
    tasks = [
        (tracer, work, errors)
        for tracer in tracers
        for errors in [errors_of(tracer, lens, field_rays(lens, SAMPLE))]
        for work in WORKS[: 1 + tracer.has_gradient]
    ]
    how = {"sizes": PIECES, "graphs": lambda tracer: LARGEST_GRAPH, "repeats": repeats, "threads": request.threads}
    with progress(len(counts) * repeats * len(tasks), "call", what="measuring") as bar:
        rows = [row for n in counts for row in measured_rows(tasks, lens, n, **how, progress=bar.update)]
    about = {"lens": arguments.lens, "surfaces": surfaces_of(lens), "repeats": repeats, "machine": request.about()}
    lines = [
        f"Lens `{arguments.lens}`: {surfaces_of(lens)} surfaces. Millions of rays × surfaces per second, of the median "
        f"{clock_of(about['machine'])} of {repeats} runs in turns. Errors: the largest of {SAMPLE} rays.",
        "",
        *listing(COLUMNS | {"× Optiland": lambda row: digits(ratio(row, rows), ".2f")}, rows),
        "",
        in_words(about["machine"]) + ".",
    ]
    return Page(rows, lines, about, trace_figure, ("tables.md", "bench_trace"))


def ratio(row: Row, rows: Sequence[Row]) -> float | None:
    """Speed of this package relative to Optiland's torch back end at the same task; None if it is not measured."""
    task = (row.dtype, row.what, row.rays)
    peers = (
        peer.speed for peer in rows if peer.tracer.endswith("torch") and (peer.dtype, peer.what, peer.rays) == task
    )
    return None if row.tracer != "raytrace" else next((row.speed / speed for speed in peers), None)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--lens", metavar="LENS", default="double_gauss", help="lens to trace (default double_gauss)")
    parser.add_argument("--rays", metavar="N", type=count, nargs="+", help="numbers of rays (default 10³ to 10⁶)")
    kit.shared(parser, "tables.md, bench_trace.csv and bench_trace.png")


def main(argv: Sequence[str] | None = None) -> None:
    kit.run(bench, options, argv, peers=True)


if __name__ == "__main__":
    sys.exit(main())
