"""Stages: a descent over several problems of one lens, each with its own bounds, as a task of a search.

Asked: a lens, what varies of it, and the merit function, as a search has them.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from raytrace.optimization.constraints import Condition
from raytrace.optimization.journal import Ended, Stopped
from raytrace.optimization.least_squares import Manner, State, least_squares
from raytrace.optimization.lens_model import Model
from raytrace.optimization.problem import Problem
from raytrace.optimization.starts import Range, Space, length_of, space_of
from raytrace.optimization.variables import Freedom, name_of
from raytrace.system.identity import identity
from raytrace.system.optimization_data import Row


@dataclass(frozen=True)
class Asked:
    """What is searched.

    rows, conditions: of the merit function, and what is held; bounds: lower and upper (n,), infinite where none are
    given; glass, air: ranges of thicknesses, mm; how: of `Problem`.
    """

    free: Freedom
    rows: tuple[Row, ...]
    conditions: tuple[Condition, ...]
    bounds: tuple[np.ndarray, np.ndarray]
    glass: Range
    air: Range
    how: dict

    @cached_property
    def model(self) -> Model:
        return Model(self.free.lens, self.free.variables, self.free.solves)

    @cached_property
    def space(self) -> Space:
        length = length_of(self.model, self.rows, self.how["unit"], self.conditions)
        return space_of(self.model, self.bounds, length, self.glass, self.air)

    @cached_property
    def whole(self) -> Problem:
        return self.problem(self.rows)

    def problem(self, rows: Sequence[Row]) -> Problem:
        """Of other rows."""
        return Problem(self.model, rows, self.conditions, **self.how)

    def about(self, seed: int) -> dict:
        """What a search depends on, for its journal."""
        return {
            **identity(self.free.lens),
            "variables": [name_of(one) for one in self.model.variables],
            "start": self.model.start.tolist(),
            "bounds": [self.space.lower.tolist(), self.space.upper.tolist()],
            "rows": [repr(row) for row in self.whole.evaluation.rows],
            "seed": seed,
        }


#: How a descent is followed to its minimum, and in how many cycles at most.
FOLLOW, LONG = Manner(tolerance=1e-5), 120
_AT_BOUND = 1e-9  # of the range of a variable


class Stage(NamedTuple):
    """A problem to descend on between bounds (n,), in at most so many cycles."""

    problem: Problem
    cycles: int
    manner: Manner
    lower: np.ndarray
    upper: np.ndarray

    def moves(self, x: np.ndarray) -> np.ndarray:
        """(n,) which variables are at none of their bounds."""
        near = _AT_BOUND * np.maximum(self.upper - self.lower, 0.0)
        return (x - self.lower > near) & (self.upper - x > near)


def descended(x: np.ndarray, stages: Sequence[Stage], until: float = np.inf) -> Ended:
    """Where x comes to on each of the stages in turn; all rays are lost where there is no way from there.

    until: a time of `time.monotonic`, after which a descent is no task that is done. Raises Stopped.
    """
    begun = time.process_time()
    for stage in stages:
        with np.errstate(all="ignore"):
            end = _end(stage, np.clip(x, stage.lower, stage.upper), until)
        if end is None:
            return Ended(np.inf, np.inf, np.inf, time.process_time() - begun, x)
        x = end.x
    missed = float(end.missed.max(initial=0.0))
    return Ended(end.lost, missed, float(np.sqrt(end.cost)), time.process_time() - begun, end.x)


def _end(stage: Stage, x: np.ndarray, until: float) -> State | None:
    """The state that a stage ends in; None where there is no way from x. Raises Stopped."""
    if not stage.problem.state(x, False).is_finite:
        return None
    try:
        end = least_squares(
            stage.problem.state, x, lower=stage.lower, upper=stage.upper, manner=stage.manner, cycles=stage.cycles,
            until=until,
        )  # fmt: skip
    except (np.linalg.LinAlgError, RuntimeError):
        return None  # numbers that overflow on the way
    if end.stopped in ("interrupted", "seconds"):
        raise Stopped
    return end.state if end.state.is_finite else None
