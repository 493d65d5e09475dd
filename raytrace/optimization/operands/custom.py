"""Rows of any function of a lens, with the derivatives of torch, backward through the function, solves and pickups."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import torch

from raytrace.optimization.context import BadRow, Evaluate, EvaluationContext, Line, Operand, Planner, RowValues
from raytrace.optimization.lens_state import listed
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row


@dataclasses.dataclass(frozen=True)
class Measure:
    """A user-defined operand: its name, and a function from a lens to a tensor () or (k,).

    The lens is in the configuration of the row, with its apertures. Several numbers count by their length √Σ v²; with
    a target of 0 the solver uses each. length: the power of mm in them, which become the unit of the rows.
    """

    name: str
    function: Callable[[Lens], torch.Tensor]
    length: int = 0

    def __call__(self, lens: Lens) -> torch.Tensor:
        return self.function(lens)

    def __str__(self) -> str:
        return self.name


def measured(function: Callable[[Lens], torch.Tensor]) -> Operand:
    """The operand of rows of a `Measure`, or of a plain function."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        is_scalar = []

        def numbers(lens: Lens) -> Sequence[torch.Tensor]:
            result = function(lens)
            if not isinstance(result, torch.Tensor) or result.dim() > 1 or not result.numel():
                shape = list(result.shape) if isinstance(result, torch.Tensor) else type(result).__name__
                raise TypeError(f"row {lines[0].number} of the merit function: {shape}, expected a tensor () or (k,)")
            is_scalar[:] = [result.dim() == 0]
            return list(result.reshape(-1))

        numbers_or_none = OrLost(lines[0], lambda context: context.state.through_torch(numbers, clips=True))

        def evaluate(context: EvaluationContext) -> RowValues:
            def alike(number):
                return listed([number] * len(lines), context.state.count)

            parts = numbers_or_none(context)
            if parts is None or is_scalar[0]:
                return RowValues(alike(np.nan if parts is None else parts[0]))
            return RowValues(alike(np.sqrt(sum(number * number for number in parts))), tuple(map(alike, parts)))

        return evaluate

    text = f"{Row(function).name}, a function of the lens"
    return Operand(plan, text, length=getattr(function, "length", 0))


class OrLost:
    """Numbers of a state, or None where the lens of a later state does not have them. Raises BadRow for the first."""

    def __init__(self, line: Line, numbers: Callable[[EvaluationContext], Sequence]):
        self.line, self.numbers, self.succeeded = line, numbers, False

    def __call__(self, context: EvaluationContext) -> Sequence | None:
        try:
            numbers = self.numbers(context)
        except ValueError as error:
            if not self.succeeded:
                raise BadRow(self.line, f"has no value: {error}") from error
            return None
        self.succeeded = True
        return numbers
