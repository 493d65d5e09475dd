"""Checkpoints and the log of an optimisation: files that tell how far it has come."""

import json
import time
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from raytrace.files import write_atomically
from raytrace.optimization.least_squares import Cycle

EVERY = 2.0  # s between two checkpoints
_COLUMNS = ("cycle", "merit", "missed", "step", "damping", "evaluations", "seconds", "limits")


class BadCheckpoint(ValueError):
    """A checkpoint that is none, or of another lens; the message says what was found and what was expected."""


class Kept(NamedTuple):
    """What a checkpoint keeps: the variables (n,); of glasses that vary (catalog, name) by surface, and the surfaces
    that no exchange has helped at since the last one."""

    x: np.ndarray
    glasses: dict[int, tuple[str, str]]
    tested: tuple[int, ...] = ()


class Checkpoint:
    """Keeps the best variables in a file, replaced as a whole: {"variables": {name: number}, "merit": …, …}.

    With "glasses": {surface: [catalog, name]} and "tested" where glasses vary.
    """

    def __init__(self, path: str | PathLike | None, names: Sequence[str]):
        self.path, self.names, self.last, self.more = path, names, -np.inf, {}

    def keep_glasses(self, kept: Kept, merit: float) -> None:
        """Keep a state of the choice of glasses, and these glasses with all variables that follow."""
        self.more = {"glasses": {str(k): list(one) for k, one in kept.glasses.items()}, "tested": list(kept.tested)}
        self.keep(kept.x, merit, 0, now=True)

    def keep(self, x: np.ndarray, merit: float, cycle: int, *, now: bool = False) -> None:
        if self.path is None or (not now and time.monotonic() < self.last + EVERY):
            return
        variables = dict(zip(self.names, x.tolist(), strict=True))
        text = json.dumps({"merit": merit, "cycles": cycle, "variables": variables, **self.more}, indent=1)
        write_atomically(self.path, lambda file: file.write(text.encode()))
        self.last = time.monotonic()


def resumed(path: str | PathLike, names: Sequence[str]) -> Kept:
    """What a checkpoint of these variables keeps. Raises BadCheckpoint and OSError."""
    try:
        told = json.loads(Path(path).read_text(encoding="utf-8"))
        found = {str(name): float(number) for name, number in told["variables"].items()}
        glasses = {int(k): (str(catalog), str(name)) for k, (catalog, name) in told.get("glasses", {}).items()}
        tested = tuple(map(int, told.get("tested", ())))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadCheckpoint(f"{path}: no checkpoint of an optimisation; expected what `checkpoint` wrote") from error
    if missing := [name for name in names if name not in found]:
        raise BadCheckpoint(
            f"{path}: a checkpoint of other variables: {', '.join(found)}; expected {missing[0]} among them"
        )
    return Kept(np.array([found[name] for name in names]), glasses, tested)


class Log:
    """A line of comma-separated values for every cycle."""

    def __init__(self, path: str | PathLike | None):
        self.file = None if path is None else open(path, "w", encoding="utf-8")  # noqa: SIM115
        self._write(_COLUMNS)

    def tell(self, cycle: Cycle) -> None:
        numbers = cycle.number, cycle.merit, cycle.missed, cycle.step, cycle.damping, cycle.evaluations
        self._write([*map(repr, numbers), f"{cycle.seconds:.3f}", cycle.limits.replace(",", ";")])

    def _write(self, words: Sequence[str]) -> None:
        if self.file is not None:
            self.file.write(",".join(words) + "\n")
            self.file.flush()

    def close(self) -> None:
        if self.file is not None:
            self.file.close()
