"""Paths: several descents from one start, each damped in its own manner, of which the best counts.

A merit function has many minima, and which one a descent ends in depends on how it is damped. The first path is the
fastest; every further one starts anew, and a path ends early where another has been before it.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from raytrace.optimization.least_squares import Cycle, Evaluate, Manner, Standing, State, least_squares

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


@dataclass(frozen=True)
class Course:
    """How far several paths have come: the number of the path, from 0, and where it began; where it stands; cycles and
    evaluations before it; and the best end (x, why) of those before it, None for the first."""

    path: int
    start: np.ndarray
    standing: Standing | None
    before: tuple[Cycle, ...] = ()
    evaluations: int = 0
    best: tuple[np.ndarray, str] | None = None

    @property
    def history(self) -> tuple[Cycle, ...]:
        """Every cycle of all paths."""
        return (*self.before, *_behind(self.standing.cycles, len(self.before), self.evaluations))


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
    watch: Callable[[Cycle, Course], None] | None = None,
    course: Course | None = None,
) -> Found:
    """Descend from x within the bounds in so many manners; cycles and seconds: of all of them together, without either
    LIMIT each.

    watch: invoked after each cycle; course: how far earlier descents came, which are resumed there: cycles count from
    their beginning.
    """
    until = time.monotonic() + (np.inf if seconds is None else seconds)
    most = cycles if cycles is not None else LIMIT * max(1, paths) if seconds is None else 1_000_000
    begun = Course(0, x, None) if course is None else course
    x, best, stopped = begun.start, None, ""
    if begun.best is not None:
        best, stopped = evaluate(begun.best[0], False), begun.best[1]
    history, evaluations = begun.before, begun.evaluations
    for path in range(begun.path, min(len(MANNERS), max(1, paths))):
        now = Course(path, x, begun.standing, history, evaluations, None if best is None else (best.x, stopped))
        one = least_squares(
            evaluate, x, lower=lower, upper=upper, typical=typical, manner=MANNERS[path], cycles=most - len(history),
            until=until, watch=_counted(watch, now), standing=begun.standing if path == begun.path else None,
        )  # fmt: skip
        history = (*history, *_behind(one.cycles, len(history), evaluations))
        evaluations += one.evaluations
        if best is None or is_better(one.state, best):
            best, stopped = one.state, one.stopped
        if one.stopped in ("interrupted", "seconds") or len(history) >= most or time.monotonic() > until:
            stopped = one.stopped if one.stopped in ("interrupted", "cycles", "seconds") else stopped
            break
    return Found(best, history, stopped, len(history), evaluations)


def is_better(one: State, other: State) -> bool:
    """Fewer rays lost, then conditions met, then less merit."""
    return _rank(one) < _rank(other)


def _rank(state: State) -> tuple:
    missed = float(state.missed.max(initial=0.0))
    return state.lost, missed if missed > 1e-8 else 0.0, state.cost


def _behind(cycles: Sequence[Cycle], before: int, evaluations: int) -> list[Cycle]:
    """Cycles of a path by their number in all paths."""
    return [
        dataclasses.replace(one, number=one.number + before, evaluations=one.evaluations + evaluations)
        for one in cycles
    ]


def _counted(watch, now: Course):
    """The same, invoked with cycles by their number in all paths, and with how far these have come."""
    if watch is None:
        return None

    def each(cycle: Cycle, standing: Standing) -> None:
        (counted,) = _behind([cycle], len(now.before), now.evaluations)
        watch(counted, dataclasses.replace(now, standing=standing))

    return each
