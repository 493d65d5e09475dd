"""Checkpoint and log of an optimisation: the state of the solver as a JSON file, cycles as a CSV file."""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import NamedTuple

import numpy as np

from raytrace.maths.result import plain
from raytrace.optimization.least_squares import PATHS, Cycle, CycleStart, PathProgress
from raytrace.stores import (
    Check,
    Document,
    Kind,
    Store,
    Table,
    Unfit,
    anything,
    either,
    exactly,
    listed,
    mapped,
    number,
    record,
    text,
    whole,
)
from raytrace.system.identity import unlike
from raytrace.words import RaytraceError

EVERY = 2.0  # s between two checkpoints
#: Why a descent ends.
STOPPED = {
    "gradient": "the gradient of the merit function vanishes",
    "step": "no step lowers the merit function",
    "merit": "the merit function no longer changes",
    "cycles": "the limit on cycles was reached",
    "seconds": "the limit on time was reached",
    "interrupted": "interrupted; this is the best so far",
}
_COLUMNS = ("cycle", "merit", "missed", "step", "damping", "evaluations", "seconds", "limits")


class BadCheckpoint(RaytraceError, ValueError):
    """A file that is no checkpoint, or of another optimisation; the message compares found and expected."""


class Stored(NamedTuple):
    """The content of a checkpoint.

    x: the variables (n,); glasses: of surfaces where they vary, (catalog, name); tested: surfaces at which no exchange
    has helped since the last one; descent: None before it started; evaluated: of a merit that is not a sum of squares,
    every evaluation so far (E, n + 1 + n): variables, value, gradient.
    """

    x: np.ndarray
    glasses: dict[int, tuple[str, str]]
    tested: tuple[int, ...] = ()
    descent: PathProgress | None = None
    evaluated: np.ndarray = np.zeros((0, 0))


_CHECKPOINT = Kind(
    BadCheckpoint,
    "expected a checkpoint of optimize; start anew without it",
    BadCheckpoint,
    "{path}: a checkpoint of {difference}; resume with the options that it was made with",
    unlike,
    "the optimisation continues, but cannot resume from here",
)
_LOG = dataclasses.replace(_CHECKPOINT, lost="the log ends here")


class Checkpoint:
    """A file of the state of an optimisation, replaced as a whole.

    {"of": the dependencies, "merit": …, "cycles": …, "variables": {name: number} of the last cycle, at the end of the
    best lens, "descent": all that determines the next cycle}; with "glasses": {surface: [catalog, name]} and "tested"
    where glasses vary, and with "evaluated" in the place of "descent" for a merit that is not a sum of squares.
    """

    def __init__(self, path: str | PathLike, about: Mapping[str, object], names: Sequence[str]):
        self.store, self.names, self.last = Document(path, about, _CHECKPOINT), names, -np.inf
        self.of_glasses: dict[str, object] = {}

    def write_glasses(self, stored: Stored, merit: float) -> None:
        """Write a state of the choice of glasses; later states repeat these glasses."""
        glasses = {str(k): list(glass) for k, glass in stored.glasses.items()}
        self.of_glasses = {"glasses": glasses, "tested": list(stored.tested)}
        self.write(stored.x, merit, 0, now=True)

    def write(
        self,
        x: np.ndarray,
        merit: float,
        cycles: int,
        *,
        descent: PathProgress | None = None,
        evaluated: Sequence[np.ndarray] = (),
        now: bool = False,
    ) -> None:
        """Write the best variables and the state of the descent, at most every few seconds unless `now`.

        Warns NotWritten where the file cannot be written; the optimisation continues.
        """
        if not now and time.monotonic() < self.last + EVERY:
            return
        variables = dict(zip(self.names, x.tolist(), strict=True))
        document: dict[str, object] = {"merit": merit, "cycles": cycles, "variables": variables, **self.of_glasses}
        if descent is not None:
            state = descent.solver
            document["descent"] = {
                "path": descent.path,
                "start": descent.start.tolist(),
                "before": [len(descent.before), descent.evaluations],
                "best": None if descent.best is None else [descent.best[0].tolist(), descent.best[1]],
                "x": state.x.tolist(),
                "damping": float(state.damping),
                "factor": float(state.factor),
                "share": float(state.share),
                "price": float(state.price),
                "scale": state.scale.tolist(),
                "evaluations": state.evaluations,
                "history": [list(dataclasses.astuple(cycle)) for cycle in descent.history],
            }
        if evaluated:
            document["evaluated"] = [plain(evaluation.tolist()) for evaluation in evaluated]
        self.store.write(document)
        self.last = time.monotonic()


def read_checkpoint(path: str | PathLike, about: Mapping[str, object], names: Sequence[str]) -> Stored:
    """The checkpoint of this optimisation. Raises BadCheckpoint and OSError."""
    finite, entry = listed(number(), len(names), len(names)), either(exactly(None), number(infinite=True))
    columns: tuple[Check, ...] = (whole(), *(number(0),) * 4, whole(), number(), text)
    document_of = record(
        {"variables": mapped(number()), "cycles": whole()},
        {
            "glasses": mapped(listed(text, 2, 2)),
            "tested": listed(whole()),
            "evaluated": listed(listed(entry, 1 + 2 * len(names), 1 + 2 * len(names))),
        },
    )

    def vector(value: object) -> np.ndarray:
        return np.array(finite(value))

    def best(value: object) -> tuple[np.ndarray, str]:
        x, stopped = listed(anything, 2, 2)(value)
        return vector(x), exactly(*STOPPED)(stopped)

    def cycle(value: object) -> Cycle:
        cells = listed(anything, len(columns), len(columns))(value)
        return Cycle(*(column(cell) for column, cell in zip(columns, cells, strict=True)))

    of_solver = {"x": vector, **dict.fromkeys(("damping", "factor", "share", "price"), number(0))}
    of_solver |= {"scale": vector, "evaluations": whole()}
    of_paths = {"path": whole(0, len(PATHS) - 1), "start": vector, "best": either(exactly(None), best)}
    descent_of = record({**of_paths, **of_solver, "before": listed(whole(), 2, 2), "history": listed(cycle)})

    def descent(value: object) -> PathProgress:
        stored = descent_of(value)
        (before, evaluations), history = stored["before"], stored["history"]
        if before > len(history):
            raise Unfit("history: expected the cycles of every path")
        cycles = tuple(
            dataclasses.replace(cycle, number=cycle.number - before, evaluations=cycle.evaluations - evaluations)
            for cycle in history[before:]
        )
        solver = CycleStart(cycles=cycles, **{name: stored[name] for name in of_solver})
        paths = {name: stored[name] for name in of_paths}
        return PathProgress(solver=solver, before=tuple(history[:before]), evaluations=evaluations, **paths)

    def check(value: object) -> Stored:
        document = record({}, {"descent": descent})(document_of(value))
        if set(document["variables"]) != set(names):
            raise Unfit(f"variables: found {', '.join(document['variables'])}, expected {', '.join(names)}")
        glasses = document.get("glasses", {})
        for name in glasses:
            if not name.isascii() or not name.isdecimal() or len(name) > 6:
                raise Unfit(f"glasses: found {name[:20]!r}, expected the number of a surface")
        return Stored(
            np.array([document["variables"][name] for name in names]),
            {int(k): (catalog, name) for k, (catalog, name) in glasses.items()},
            tuple(document.get("tested", ())),
            document.get("descent"),
            np.array(document.get("evaluated", []), dtype=float),
        )

    return Document(path, about, _CHECKPOINT).read(check)


class Log:
    """A file of comma-separated values, a line for every cycle; rewritten with the cycles so far."""

    def __init__(self, path: str | PathLike, cycles: Sequence[Cycle] = ()):
        self.store, self.table = Store(path, {}, _LOG), Table(path)
        self.table.begin(_COLUMNS, *map(_cells, cycles))

    def add(self, cycle: Cycle) -> None:
        """Add a cycle. Warns NotWritten where the file cannot be written; the optimisation continues."""
        self.store.keep(lambda: self.table.append(_cells(cycle), sync=False))


def _cells(cycle: Cycle) -> list:
    numbers = map(float, (cycle.merit, cycle.missed, cycle.step, cycle.damping))
    seconds, limits = f"{cycle.seconds:.3f}", cycle.limits.replace(",", ";")
    return [cycle.number, *numbers, cycle.evaluations, seconds, limits]
