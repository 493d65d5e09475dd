"""Derivatives by finite differences, of merit functions and of torch functions."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from raytrace.optimization.merit import Evaluation

#: Without undefined gradients, half of the time: only a custom autograd function can fail there, and its tests call
#: `torch.autograd.gradcheck`.
gradcheck = partial(torch.autograd.gradcheck, check_undefined_grad=False)


def gradgradcheck(call: Callable, inputs, *, seed: int = 0, **how) -> bool:
    """Second derivatives against differences of first ones, of a random weighted sum of the outputs.

    Gradients are linear in the weights, and `gradcheck` of `call` has compared the coefficients: one random direction
    of the weights is compared here, in place of a difference for each output.
    """
    inputs = (inputs,) if isinstance(inputs, torch.Tensor) else tuple(inputs)
    generator = torch.Generator().manual_seed(seed)

    def outputs_of(given) -> list[torch.Tensor]:
        found = call(*given)
        return [part for part in (found if isinstance(found, tuple | list) else (found,)) if part.requires_grad]

    def drawn(outputs: list[torch.Tensor]) -> list[torch.Tensor]:
        return [2 * torch.rand(part.shape, generator=generator, dtype=part.dtype) - 1 for part in outputs]

    outputs = outputs_of(inputs)
    weights, direction = drawn(outputs), drawn(outputs)

    def gradients(share, *given):
        asked = [part for part in given if part.requires_grad]
        seeds = [weight + share * turn for weight, turn in zip(weights, direction, strict=True)]
        with torch.enable_grad():
            found = torch.autograd.grad(outputs_of(given), asked, seeds, create_graph=True, allow_unused=True)
        return tuple(part for part in found if part is not None)

    share = torch.zeros((), dtype=weights[0].dtype, requires_grad=True)
    return torch.autograd.gradcheck(gradients, (share, *inputs), check_undefined_grad=False, **how)


def slopes_by_differences(evaluation: Evaluation, start: np.ndarray, relative: float = 1e-4) -> np.ndarray:
    """∂values/∂x (R, n) by central differences of fourth order, in steps relative to the size of a variable."""
    found = []
    for k, number in enumerate(start):
        step = relative * max(abs(number), 1e-2)

        def moved(times, k=k, step=step):
            x = start.copy()
            x[k] += times * step
            return evaluation(x).values

        found.append((8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * step))
    return np.stack(found, 1)
