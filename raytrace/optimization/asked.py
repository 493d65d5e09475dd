"""Asked: a lens, what varies of it, and the merit function, as a search has them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from raytrace.merit.hold import Condition
from raytrace.merit.model import Model
from raytrace.merit.vary import Freedom, name_of
from raytrace.optimization.problem import Problem
from raytrace.optimization.starts import Range, Space, length_of, space_of
from raytrace.system.identity import identity
from raytrace.system.intent import Row


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
