"""Merit functions of a batch of lenses, with derivatives by every number that differs between them.

The rows are planned once for lens 0, with all numbers that differ or require a gradient as variables, and evaluated for
each lens with exact derivatives by these.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.tangents import applied
from raytrace.optimization.merit import Evaluated, Evaluation, Merit
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens, aligned
from raytrace.system.optimization_data import Vary
from raytrace.system.parameter_paths import APERTURE, GLASS_NUMBER, Address, ParameterPath, parameter_paths


class MeritOfBatch:
    """A merit function planned for a batch of lenses.

    addresses: (surface, quantity) of the numbers that differ; numbers: (L, n) of them; by: places of those that require
    a gradient. Raises ValueError for a batch of temperatures or pressures, BadMerit and UnknownOperand as `evaluate`.
    """

    def __init__(self, lens: Lens, function: Merit):
        self.count, lens = lens.count or 1, aligned(lens, 0, exactly=True)
        first = pytree.tree_map_only(Tensor, Tensor.detach, lens if lens.count is None else lens[0])
        differing = dict(_differing(lens, first))
        self.addresses = tuple(differing)
        columns = [number.reshape(-1).expand(self.count) for number in differing.values()]
        self.by = tuple(k for k, column in enumerate(columns) if column.requires_grad)
        self.numbers = torch.stack(columns, -1) if columns else lens.wavelengths.new_zeros(self.count, 0)
        model = DesignVariables(first, variables=tuple(Vary(*address) for address in self.addresses))
        self.evaluation = Evaluation(model, function.rows, **function.options)

    def evaluated(self) -> list[Evaluated]:
        """The merit function of each lens, without derivatives."""
        return [self.evaluation(x) for x in self.numbers.detach().numpy()]

    def square(self) -> Tensor:
        """M² (L,) with its derivatives."""
        return applied(_Square, self.numbers, self.evaluation, self.by)


class _Square(torch.autograd.Function):
    """M² = Σ r² of lenses with variables x (L, n), ∂M²/∂x = 2 rᵀ ∂r/∂x."""

    @staticmethod
    def forward(context: Any, x: Tensor, evaluation: Evaluation, by: tuple[int, ...]) -> Tensor:
        needed = context.needs_input_grad[0]
        each = [evaluation(row, derivatives=needed, shown=False, by=by) for row in x.numpy()]
        if needed:
            slopes = torch.zeros_like(x)
            slopes[:, list(by)] = x.new_tensor(
                np.stack([2 * evaluated.residuals @ evaluated.jacobian for evaluated in each])
            )
            context.save_for_backward(slopes)
        return x.new_tensor([evaluated.residuals @ evaluated.residuals for evaluated in each])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context: Any, slope: Tensor) -> tuple[Tensor, None, None]:
        return slope[:, None] * context.saved_tensors[0], None, None


def _differing(lens: Lens, first: Lens) -> Iterator[tuple[Address, Tensor]]:
    """The numbers, () or (L, 1, …), that differ between the lenses or require a gradient, by their address."""
    if lens.environment is not None and lens.count is not None:
        environment = first.environment
        for name in ("temperature", "pressure"):
            if getattr(lens.environment, name).dim() > getattr(environment, name).dim():
                raise ValueError(f"merit functions take no batch of {name}s: evaluate each lens by itself")
    if _moves(lens.aperture.value, first.aperture.value):
        yield APERTURE, lens.aperture.value
    for k, (surface, single) in enumerate(zip(lens.surfaces, first.surfaces, strict=True)):
        paths = {"thickness": ParameterPath(("thickness",)), **parameter_paths(single)}
        for n in range(single.glass.coefficients.numel()):
            paths[f"{GLASS_NUMBER}{n + 1}"] = ParameterPath(("glass", "coefficients"), n)
        for quantity, (steps, entry) in paths.items():
            part: Any = surface
            of_first: Any = single
            for name in steps:
                part, of_first = getattr(part, name), getattr(of_first, name)
            if part is not None and _moves(part, of_first):
                yield (k, quantity), part if entry is None else part.reshape(of_first.numel(), -1)[entry]


def _moves(number: Tensor, single: Tensor) -> bool:
    return number.requires_grad or number.numel() > single.numel()
