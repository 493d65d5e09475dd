"""Optimisation of lens files by their own merit functions: how far and how fast, and the cost of derivatives.

    python docs/experiments/bench_optimise.py FILE … --docs docs

Files are optimised from their stored state, and from a start where every variable is moved by up to 5 %. An oracle.json
in the folder of a file has the results of an independent program: merits as stored, the best, and the moved start.
"""

import argparse
import dataclasses
import json
import math
import re
import statistics
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import bench_kit as kit
import numpy as np
from bench_kit import Page, Request, in_words
from matplotlib.figure import Figure
from pages import digits, listing

from raytrace.cli.progress import progress
from raytrace.io import read_lens
from raytrace.optimization.merit import DefaultMerit
from raytrace.optimization.optimize import optimize
from raytrace.optimization.problem import Problem
from raytrace.optimization.variables import DesignVariables, design_variables
from raytrace.plotting import style
from raytrace.system.lens import Lens
from raytrace.tracing.compiled import prepare

MOST = 10.0  # s a file
FRACTION = 0.05  # by which variables are moved
ROUNDING = 1e-6  # lower merits are drawn as this
REACHED = 1e-5  # relative: a merit that much higher is equal


@dataclasses.dataclass(frozen=True)
class FileRow:
    """A file: merit as stored, by this package and by the oracle; ends from there and from the moved start."""

    file: str
    variables: int
    rows: int
    stored: float
    by_oracle: float
    best_of_oracle: float
    settled: bool
    start_moved: float
    end_stored: float
    seconds_stored: float
    end_moved: float
    seconds_moved: float
    evaluations_moved: int
    stopped: str


def bench(request: Request) -> Page:
    """The files, and the Jacobian of a default merit function."""
    prepare()
    files = request.arguments.lenses
    with progress(len(files), "file", what="optimising") as bar:
        rows = [_of_file(name, bar) for name in files]
    forward, whole, variables, rays = _jacobian(request.open_lens("double_gauss"), request.arguments.repeats)
    about = request.about()
    lines = [
        "# Optimisation of lens files by their own merit functions", "", *_answer(rows),
        "    python docs/experiments/bench_optimise.py FILE … --docs docs", "", in_words(about), "",
        *(_of_files(rows) if rows else ()),
        "## Derivatives", "",
        f"Default merit function of the shipped double Gauss, 3 fields and wavelengths, 6 rings and arms, {rays} rays, "
        f"with {variables} variables: {1e3 * forward:.2f} ms; with the exact Jacobian of all rows "
        f"{1e3 * whole:.2f} ms, {whole / forward:.1f} times as much.",
    ]  # fmt: skip
    document = {"about": about, "forward_s": forward, "jacobian_s": whole}
    return Page(rows, lines, document, optimise_figure, ("optimise.md", "optimise"))


def _of_file(name: str, bar) -> FileRow:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lens = read_lens(name)
    known = _oracle(Path(name))
    free = design_variables(lens)
    model = free
    moved = model.lens_at(model.start * factors(known, [variable.name for variable in free.variables]))
    stored, from_moved = (optimize(start, seconds=MOST) for start in (lens, moved))
    bar.update(1)
    return FileRow(
        Path(name).name, len(model.variables), sum(row.weight != 0 for row in stored.merit), stored.merit_before,
        known.get("mf_stored", math.nan), known.get("mf_best", math.nan), known.get("settled", False),
        from_moved.merit_before, stored.merit_after, stored.seconds, from_moved.merit_after, from_moved.seconds,
        from_moved.evaluations, from_moved.stopped,
    )  # fmt: skip


def _oracle(path: Path) -> dict:
    oracle = path.with_name("oracle.json")
    files = json.loads(oracle.read_text(encoding="utf-8"))["files"] if oracle.exists() else []
    return next((known for known in files if known["file"] == path.name), {})


def factors(known: Mapping, names: Sequence[str]) -> np.ndarray:
    """By which variables are moved: those of the oracle, else up to 5 % either way."""
    if not known:
        return 1 + FRACTION * np.random.default_rng(0).uniform(-1, 1, len(names))
    stored, start = np.array(known["x_stored"]), np.array(known["from_perturbed"]["x_start"])
    ratios = np.divide(start, stored, out=np.ones_like(start), where=stored != 0)
    by_name = dict(zip(map(_name_here, known["variables"]), ratios, strict=True))
    return np.array([by_name[name] for name in names])


def _name_here(variable: str) -> str:
    """The oracle's `thickness:3` and, for a parameter of a surface, `p:3/2`."""
    quantity, _, where = variable.partition(":")
    surface, _, parameter = where.partition("/")
    return f"a{2 * int(parameter)}_{surface}" if quantity == "p" else f"{quantity}_{surface}"


def _jacobian(lens: Lens, repeats: int) -> tuple[float, float, int, int]:
    """Median seconds of a default merit function of 6 rings and 6 arms, and of it with its derivatives."""
    lens = lens.at(wavelengths=[0.5876, 0.4861, 0.6563])
    free = design_variables(lens, "curvature thickness")
    model = DesignVariables(free.lens, free.variables[:20], free.solves)
    problem = Problem(model, DefaultMerit("spot", rings=6).rows(lens))
    medians = []
    for derivatives in (False, True):
        seconds = []
        for _ in range(10 * repeats):
            start = time.perf_counter()
            problem.state(model.start, derivatives)
            seconds.append(time.perf_counter() - start)
        medians.append(statistics.median(seconds))
    return *medians, len(model.variables), sum(row.weight > 0 for row in problem.rows)


def _answer(files: Sequence[FileRow]) -> list[str]:
    """The first sentence: ends from the moved starts, over the best merit of the oracle."""
    known = [row for row in files if math.isfinite(row.best_of_oracle)]
    if not known:
        return []
    reached = sum(row.end_moved <= (1 + REACHED) * row.best_of_oracle for row in known)
    seconds = statistics.median(row.seconds_moved for row in known)
    return [
        f"{reached} of {len(known)} files reach the best merit that an independent least squares found, or a lower "
        f"one, from a start where every variable is moved by up to {FRACTION:.0%}; the median time is {seconds:.2f} s.",
        "",
    ]  # fmt: skip


def _of_files(files: Sequence[FileRow]) -> list[str]:
    columns = {
        "file": lambda row: row.file.rpartition("__")[2],
        "variables": lambda row: str(row.variables),
        "M moved": lambda row: f"{row.start_moved:.4g}",
        "end": lambda row: f"{row.end_moved:.8g}",
        "s": lambda row: f"{row.seconds_moved:.2f}",
        "end / best": lambda row: digits(row.end_moved / row.best_of_oracle, ".5f"),
    }
    return [
        "## Files with a merit function", "",
        f"M: merit of the file's own merit function. Every variable is moved by up to {FRACTION:.0%}; at most {MOST:g} "
        "s each. Best: the minimum that an independent least squares found in minutes, from the stored or the moved "
        "start. The table lists the files whose end differs from it; all figures: [optimise.csv](optimise.csv).", "",
        *listing(columns, [row for row in files if not abs(row.end_moved / row.best_of_oracle - 1) < REACHED]), "",
    ]  # fmt: skip


def short_name(file: str) -> str:
    """A file name in words, without its collection: `A__sc_cooke2.ZMX` is "cooke 2"."""
    words = Path(file).stem.rpartition("__")[2].removeprefix("sc_").partition("_320_")[0]
    words = re.sub(r"(?<=[a-z])(?=[A-Z0-9])|_", " ", words)
    return words[:1].upper() + words[1:28].strip()


@style.styled
def optimise_figure(rows: Sequence[Mapping]) -> Figure:
    """Merit of every file at its moved start and at its end."""
    figure = style.new_figure(8.0, 1.2 + 0.28 * max(len(rows), 1))
    panel = figure.subplots()
    for place, row in enumerate(rows):
        ends = [max(row[name], ROUNDING) for name in ("start_moved", "end_moved")]
        panel.plot(ends, [place, place], color=style.FAINT, linewidth=3, zorder=1)
        panel.plot(ends[0], place, "o", color=style.GREY, label="perturbed start" if place == 0 else None)
        panel.plot(ends[1], place, "o", color=style.FIELD_COLOURS[0], label="optimised" if place == 0 else None)
        if row["best_of_oracle"] > ROUNDING:
            label = "independent least squares, best" if place == 0 else None
            panel.plot(row["best_of_oracle"], place, "|", color=style.FIELD_COLOURS[2], markersize=11, label=label)
        words = f"{row['seconds_moved']:.2g} s"
        panel.annotate(words, (ends[0], place), (6, 0), textcoords="offset points", va="center", fontsize=7)
    panel.set_yticks(range(len(rows)), [short_name(row["file"]) for row in rows])
    panel.invert_yaxis()
    panel.set_xscale("log")
    panel.set_xlim(0.5 * ROUNDING, 2e3)
    panel.set_xlabel("merit, in the units of the file (lower merits are drawn at 10⁻⁶)")
    panel.grid(axis="x", alpha=0.25)
    if rows:
        figure.legend(loc="outside lower center", ncols=3)
    return figure


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lenses", metavar="FILE", nargs="*", help="files with a merit function")
    kit.shared(parser, "optimise.md, optimise.csv and optimise.png")


def main(argv: Sequence[str] | None = None) -> None:
    kit.run(bench, options, argv, peers=False)


if __name__ == "__main__":
    sys.exit(main())
