"""`raytrace bench wave`: its page, its table and its figure."""

import argparse
import dataclasses
from pathlib import Path

from raytrace import plot
from raytrace.bench import wave_report
from raytrace.bench.figure_wave import bench_figure
from raytrace.bench.wave import agreement, bench_scene, entrants, measure, target
from raytrace.cli.door import print_json
from raytrace.cli.progress import progress
from raytrace.files import write_atomically
from raytrace.maths.result import number
from raytrace.pages import machine


def bench_wave(arguments: argparse.Namespace) -> None:
    """Every engine at several samplings beside the method of Sitzmann et al. (2018), in one run and one thread."""
    found = entrants()
    with progress(len(found) * (1 + arguments.repeats), what="measuring") as bar:
        rows = measure(found, repeats=arguments.repeats, progress=bar.update)
    apart = agreement(bench_scene())
    about = machine() | {"torch threads": 1}
    folder = Path(arguments.docs) if arguments.docs else None
    page = folder / "wave_bench.md" if folder else None
    kept = page.read_text(encoding="utf-8").partition(wave_report.KEPT)[2].strip() if page and page.exists() else ""
    report = wave_report.markdown(rows, agreement=apart, about=about, repeats=arguments.repeats, kept=kept)
    if page:
        (folder / "wave").mkdir(parents=True, exist_ok=True)
        table = wave_report.table(rows).encode()
        write_atomically(folder / "wave" / "speed_vs_error.csv", lambda file: file.write(table))
        figure = bench_figure([dataclasses.asdict(row) for row in rows])
        plot.save(figure, folder / "wave" / "speed_vs_error.png")
        write_atomically(page, lambda file: file.write(report.encode()))
    if arguments.json:
        goals = [dataclasses.asdict(one) | {"met": one.met} for one in target(rows)]
        document = {"repeats": arguments.repeats, "machine": about, "agreement": number(apart)}
        print_json(document | {"targets": goals, "rows": [dataclasses.asdict(row) for row in rows]})
    else:
        print(report, end="")
