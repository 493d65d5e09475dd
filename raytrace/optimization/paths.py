"""Paths: several descents from one start, each damped in its own manner, of which the best counts.

A merit function has many minima, and which one a descent ends in depends on how it is damped. The first path is the
fastest; every further one starts anew, and a path ends early where another has been before it.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from raytrace.optimization.least_squares import Cycle, Evaluate, Manner, State, least_squares

#: In the order in which they are tried.
MANNERS = (
    Manner(),
    Manner(damping=1.0, lowered=0.5),
    Manner(damping=1e-2, bends=False, keeps=True),
)

#: Cycles of a path where neither these nor the time are limited: along a narrow valley a merit may fall for ever.
LIMIT = 500


@dataclass(frozen=True)
class Found:
    """The best state, every cycle of all paths, and why the path of the best one ended."""

    state: State
    history: tuple[Cycle, ...]
    stopped: str
    cycles: int
    evaluations: int


def best_of_paths(
    evaluate: Evaluate,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    paths: int = 1,
    cycles: int | None = None,
    seconds: float | None = None,
    watch: Callable[[Cycle, State], None] | None = None,
) -> Found:
    """Descend from x within the bounds in so many manners; cycles and seconds: of all of them together,
    without either LIMIT each."""
    until = time.monotonic() + (np.inf if seconds is None else seconds)
    left = cycles if cycles is not None else LIMIT * max(1, paths) if seconds is None else 1_000_000
    best, stopped, history, evaluations = None, "", [], 0
    for manner in MANNERS[: max(1, paths)]:
        one = least_squares(
            evaluate, x, lower=lower, upper=upper, typical=typical, manner=manner, cycles=left, until=until,
            watch=_counted(watch, len(history), evaluations),
        )  # fmt: skip
        history += [_behind(cycle, len(history) + 1, evaluations) for cycle in one.cycles]
        evaluations, left = evaluations + one.evaluations, left - len(one.cycles)
        if best is None or is_better(one.state, best):
            best, stopped = one.state, one.stopped
        if one.stopped == "interrupted" or left <= 0 or time.monotonic() > until:
            stopped = one.stopped if one.stopped in ("interrupted", "cycles", "seconds") else stopped
            break
    return Found(best, tuple(history), stopped, len(history), evaluations)


def is_better(one: State, other: State) -> bool:
    """Fewer rays lost, then conditions met, then less merit."""
    return _rank(one) < _rank(other)


def _rank(state: State) -> tuple:
    missed = float(state.missed.max(initial=0.0))
    return state.lost, missed if missed > 1e-8 else 0.0, state.cost


def _behind(cycle: Cycle, number: int, evaluations: int) -> Cycle:
    return dataclasses.replace(cycle, number=number, evaluations=cycle.evaluations + evaluations)


def _counted(watch, before: int, evaluations: int):
    """The same, told of cycles by their number in all paths."""
    if watch is None:
        return None
    return lambda cycle, state: watch(_behind(cycle, cycle.number + before, evaluations), state)
