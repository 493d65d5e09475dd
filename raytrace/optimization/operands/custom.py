"""Rows of any function of a lens, and what counts as lost where such a function has no number.

Its derivatives are those that torch finds backward through all that it does, from a lens whose numbers are those of
the state, carried on through solves and pickups.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import torch

from raytrace.optimization.context import BadRow, Evaluate, EvaluationContext, Found, Line, Operand, Planner
from raytrace.optimization.operands.paraxial import listed
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row


@dataclasses.dataclass(frozen=True)
class Measure:
    """An operand of one's own: its name, and a function from a lens to a tensor () or (k,).

    The lens is in the configuration of the row, with its apertures. Several numbers count by their length √Σ v²; with
    a target of 0 the solver is given each. length: the power of mm in them, which become the unit of the rows.
    """

    name: str
    function: Callable[[Lens], torch.Tensor]
    length: int = 0

    def __call__(self, lens: Lens) -> torch.Tensor:
        return self.function(lens)

    def __str__(self) -> str:
        return self.name


def measured(function: Callable[[Lens], torch.Tensor]) -> Operand:
    """The operand of rows that hold a `Measure`, or a function just as it is."""
    text = f"{Row(function).name}, a function of the lens"
    return Operand(_planned(function), text, length=getattr(function, "length", 0))


def _planned(function: Callable) -> Callable[[Sequence[Line], Planner], Evaluate]:
    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        one, alone = lines[0], []

        def told(lens: Lens) -> Sequence[torch.Tensor]:
            found = function(lens)
            if not isinstance(found, torch.Tensor) or found.dim() > 1 or not found.numel():
                shape = list(found.shape) if isinstance(found, torch.Tensor) else type(found).__name__
                raise TypeError(f"row {one.number} of the merit function: {shape}, expected a tensor () or (k,)")
            alone[:] = [found.dim() == 0]
            return list(found.reshape(-1))

        numbers = OrLost(one, lambda context: context.state.through_torch(told, clips=True))

        def evaluate(context: EvaluationContext) -> Found:
            found = numbers(context)
            if found is None or alone[0]:
                return Found(listed([np.nan if found is None else found[0]] * len(lines), context.state.count))
            length = np.sqrt(sum(number * number for number in found))
            parts = tuple(listed([number] * len(lines), context.state.count) for number in found)
            return Found(listed([length] * len(lines), context.state.count), parts)

        return evaluate

    return plan


class OrLost:
    """Numbers of a state, or None where they cannot be had of the lens that an optimisation tries.

    A lens to begin with that does not have them is an error of the row. Raises BadRow.
    """

    def __init__(self, line: Line, tell: Callable[[EvaluationContext], Sequence]):
        self.line, self.tell, self.had = line, tell, False

    def __call__(self, context: EvaluationContext) -> Sequence | None:
        try:
            found = self.tell(context)
        except ValueError as error:
            if not self.had:
                raise BadRow(self.line, f"has no value: {error}") from error
            return None
        self.had = True
        return found
