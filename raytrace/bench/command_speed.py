"""`raytrace bench speed`: its page, its table and its figure."""

import argparse
import dataclasses
import importlib
import os
from pathlib import Path
from types import ModuleType

import torch

from raytrace import plot
from raytrace.bench import less_work, speed, speed_report
from raytrace.bench.figure_speed import speed_figure
from raytrace.bench.limit import Built, build
from raytrace.bench.speed_own import three_aspheres
from raytrace.cli.door import print_json, say
from raytrace.cli.progress import Bar, Lines, progress
from raytrace.files import write_atomically
from raytrace.fused import NoCompiler
from raytrace.maths.result import number
from raytrace.pages import machine


def bench_speed(arguments: argparse.Namespace, *, with_peers: bool) -> None:
    """The targets of speed in one run, all entrants in turns."""
    before = torch.get_num_threads()
    threads = arguments.threads or _cores()
    built, compiler = _built()
    try:
        torch.set_num_threads(threads)
        peers = importlib.import_module("raytrace.bench.speed_peer") if with_peers else None
        benches = _benches(arguments, threads, built, peers)
        sizes = benches[0].sizes
        total = speed.stages(benches) + len(less_work.cases(sizes))
        with progress(total, what="measuring") as bar:
            rows, ratios = speed.measure(benches, progress=lambda words: _show(bar, words))
            gains = less_work.measure(sizes, repeats=arguments.repeats, progress=lambda words: _show(bar, words))
        torch.set_num_threads(threads)
        about = machine() | (peers.versions() if peers else {})
    finally:
        torch.set_num_threads(before)
    page = Path(arguments.docs) / "speed.md" if arguments.docs else None
    kept = page.read_text(encoding="utf-8").partition(speed_report.KEPT)[2].strip() if page and page.exists() else ""
    report = speed_report.markdown(
        rows, ratios, sizes=sizes, about=about, compiler=compiler, repeats=arguments.repeats, gains=gains, kept=kept
    )
    if page:
        _write(page, report, rows)
    if arguments.json:
        found = speed_report.document(rows, ratios)
        errors = [dataclasses.asdict(row) | {"position": number(row.position)} for row in rows]
        about = {"machine": about, "compiler": compiler, "repeats": arguments.repeats, "sizes": sizes.__dict__}
        print_json(found | about | {"rows": errors, "less_work": [dataclasses.asdict(gain) for gain in gains]})
    else:
        print(report, end="")


def _show(bar: Bar | Lines, words: str) -> None:
    bar.set_postfix_str(words)
    bar.update()


def _benches(
    arguments: argparse.Namespace, threads: int, built: Built | None, peers: ModuleType | None
) -> list[speed.Bench]:
    sizes = speed.QUICK if arguments.quick else speed.Sizes()
    if peers:
        importlib.import_module("raytrace.bench.peer").set_threads(threads)
    return [
        speed.Bench(
            dtype,
            sizes,
            arguments.repeats,
            threads,
            built,
            *([peers.peers_of(lens, dtype) for lens in (speed.double_gauss(), three_aspheres())] if peers else []),
        )
        for dtype in speed.DTYPES
    ]


def _built() -> tuple[Built | None, str]:
    """The limits and how they were built; or none, and why not."""
    try:
        built = build()
    except NoCompiler as error:
        say(f"{error}: without limits")
        return None, str(error)
    say(f"limits built by {built.words}")
    return built, f"{built.compiler} with `{' '.join(built.flags)}`"


def _write(page: Path, report: str, rows: list[speed.Row]) -> None:
    page.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(page.with_suffix(".csv"), lambda file: file.write(speed_report.table(rows).encode()))
    plot.save(speed_figure([dataclasses.asdict(row) for row in rows]), page.with_suffix(".png"))
    write_atomically(page, lambda file: file.write(report.encode()))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
