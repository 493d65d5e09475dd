"""Optimisation: how far lens files come by their own merit functions, how fast, and beside another program.

Files are optimised as they stand, and from a start where every variable was moved by up to 5 %. Beside a file may stand
an oracle.json with what an independent program found: merits as stored, best, and the start that was moved.
"""

import dataclasses
import importlib
import json
import math
import statistics
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from raytrace.bench.report import Asked, Measured, digits, in_words, table
from raytrace.cli.progress import progress
from raytrace.io import read_lens
from raytrace.optimization.default_merit import DefaultMerit
from raytrace.optimization.lens_model import Model
from raytrace.optimization.optimize import optimize
from raytrace.optimization.problem import Problem
from raytrace.optimization.variables import freedom, name_of
from raytrace.system.lens import Lens
from raytrace.tracing.compiled import prepare

MOST = 10.0  # s a file
FRACTION = 0.05  # by which variables are moved
_STEPS = 40  # of the other program's Adam


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


@dataclasses.dataclass(frozen=True)
class PeerRow:
    """One problem solved by one program. merits: M²; seconds: of the processor; reached: seconds to the other's end."""

    lens: str
    moved: float
    solver: str
    start: float
    end: float
    seconds: float
    evaluations: int
    reached: float


def bench(asked: Asked) -> Measured:
    """All files that are named, the Jacobian of a default merit, and the other program if it is there."""
    prepare()
    repeats = asked.arguments.repeats
    with progress(len(asked.arguments.lenses), "file", what="bench optimise") as bar:
        files = [_of_file(name, bar) for name in asked.arguments.lenses]
    forward, whole, variables, rays = _jacobian(asked.open_lens("double_gauss"), repeats)
    peers = [] if asked.peers is None else _beside()
    about = asked.about()
    lines = [
        "# Optimisation", "",
        "Written by `raytrace bench optimise`; merits are those of the files' own merit functions, M.",
        in_words(about), "",
        *_told(files),
        "## Derivatives", "",
        f"Default merit of the shipped double Gauss, 3 fields and wavelengths, 6 rings and arms, {rays} rays, by "
        f"{variables} variables: {1e3 * forward:.2f} ms, with "
        f"the exact Jacobian of all rows {1e3 * whole:.2f} ms, {whole / forward:.1f} times as much.", "",
        *_compared(peers),
    ]  # fmt: skip
    document = {"about": about, "forward_s": forward, "jacobian_s": whole, "peers": [*map(dataclasses.asdict, peers)]}
    return Measured(files, lines, document, ("optimise_figure",), ("optimise.md", "optimise"))


def _of_file(name: str, bar) -> FileRow:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lens = read_lens(name)
    known = _oracle(Path(name))
    free = freedom(lens)
    model = Model(free.lens, free.variables, free.solves)
    moved = model.lens_at(model.start * _factors(known, [name_of(one) for one in free.variables]))
    stored, from_moved = (optimize(one, seconds=MOST) for one in (lens, moved))
    bar.update(1)
    return FileRow(
        Path(name).name, len(model.variables), sum(row.weight != 0 for row in stored.merit), stored.merit_before,
        known.get("mf_stored", math.nan), known.get("mf_best", math.nan), known.get("settled", False),
        from_moved.merit_before, stored.merit_after, stored.seconds, from_moved.merit_after, from_moved.seconds,
        from_moved.evaluations, from_moved.stopped,
    )  # fmt: skip


def _oracle(path: Path) -> dict:
    beside = path.with_name("oracle.json")
    if not beside.exists():
        return {}
    known = json.loads(beside.read_text(encoding="utf-8"))["files"]
    return next((one for one in known if one["file"] == path.name), {})


def _factors(known: dict, names: Sequence[str]) -> np.ndarray:
    """By what variables are moved: as the oracle did, else by up to 5 % either way."""
    if not known:
        return 1 + FRACTION * np.random.default_rng(0).uniform(-1, 1, len(names))
    stored, start = np.array(known["x_stored"]), np.array(known["from_perturbed"]["x_start"])
    ratios = np.divide(start, stored, out=np.ones_like(start), where=stored != 0)
    by_name = dict(zip(map(_named, known["variables"]), ratios, strict=True))
    return np.array([by_name[name] for name in names])


def _named(variable: str) -> str:
    """The oracle's `thickness:3` and, for a parameter of a surface, `p:3/2`."""
    quantity, _, where = variable.partition(":")
    surface, _, parameter = where.partition("/")
    return f"a{2 * int(parameter)}_{surface}" if quantity == "p" else f"{quantity}_{surface}"


def _jacobian(lens: Lens, repeats: int) -> tuple[float, float, int, int]:
    """Median seconds of a default merit of 6 rings and 6 arms, and of it with its derivatives."""
    lens = lens.at(wavelengths=[0.5876, 0.4861, 0.6563])
    free = freedom(lens, "curvature thickness")
    model = Model(free.lens, free.variables[:20], free.solves)
    problem = Problem(model, DefaultMerit("spot", rings=6).rows(lens))
    seconds = []
    for derivatives in (False, True):
        each = []
        for _ in range(10 * repeats):
            begun = time.perf_counter()
            problem.state(model.start, derivatives)
            each.append(time.perf_counter() - begun)
        seconds.append(statistics.median(each))
    return *seconds, len(model.variables), sum(row.weight > 0 for row in problem.rows)


def _beside() -> list[PeerRow]:
    """The other program's sample lenses by both programs, from the same starts with the same rays."""
    peers = importlib.import_module("raytrace.bench.peers_optimise")
    found = []
    for name in peers.PROBLEMS:
        for moved in (0.0, 0.02):
            problem = peers.problem(name, moved=moved)
            theirs = [peers.least_squares(problem), peers.adam(problem, _STEPS)]
            begun = time.process_time()
            ours = optimize(problem.lens)
            seconds, merits = time.process_time() - begun, ours.history[:, 0].square()
            ends = ours.merit_before**2, ours.merit_after**2
            found.append(PeerRow(name, moved, "this package", *ends, seconds, ours.evaluations, math.nan))
            for run in theirs:
                there = (merits <= run.end).nonzero()
                when = float(ours.history[int(there[0]), 4]) if len(there) else math.inf
                row = PeerRow(name, moved, run.method, run.start, run.end, run.seconds, run.evaluations, when)
                found.append(row)
    return found


def _told(files: Sequence[FileRow]) -> list[str]:
    if not files:
        return []
    columns = {
        "file": lambda row: row.file,
        "variables": lambda row: str(row.variables),
        "rows": lambda row: str(row.rows),
        "M stored": lambda row: f"{row.stored:.8g}",
        "off the oracle's": lambda row: digits(row.stored / row.by_oracle - 1),
        "end from there": lambda row: f"{row.end_stored:.8g}",
        "s": lambda row: f"{row.seconds_stored:.2f}",
        "M moved": lambda row: f"{row.start_moved:.4g}",
        "end|moved": lambda row: f"{row.end_moved:.8g}",
        "s|moved": lambda row: f"{row.seconds_moved:.2f}",
        "evaluations": lambda row: str(row.evaluations_moved),
        "the oracle's best": lambda row: digits(row.best_of_oracle, ".8g"),
        "end / best": lambda row: digits(row.end_moved / row.best_of_oracle, ".5f"),
        "stopped by": lambda row: row.stopped,
    }
    return [
        "## Files with a merit function", "",
        f"As stored, and from a start where every variable is moved by up to {FRACTION:.0%}; at most {MOST:g} s each. "
        "Best: the least that an independent least squares found from either start in minutes.", "",
        *table(columns, files), "",
    ]  # fmt: skip


def _compared(peers: Sequence[PeerRow]) -> list[str]:
    if not peers:
        return []
    columns = {
        "lens": lambda row: row.lens,
        "start": lambda row: f"sample ± {row.moved:.0%}" if row.moved else "sample",
        "solver": lambda row: row.solver,
        "M² before": lambda row: f"{row.start:.5g}",
        "M² after": lambda row: f"{row.end:.6g}",
        "processor s": lambda row: f"{row.seconds:.3g}",
        "evaluations": lambda row: str(row.evaluations),
        "this package gets there in, s": lambda row: digits(row.reached, ".3g", "–"),
        "ratio": lambda row: digits(row.seconds / row.reached, ".0f", "–") if row.reached else "–",
    }
    return [
        "## Beside Optiland", "",
        "Its sample lenses, variables, focal length and rays, told alike in both programs (`bench/peers_optimise.py`).",
        "", *table(columns, peers), "",
    ]  # fmt: skip
