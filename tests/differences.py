"""Derivatives by finite differences, of merit functions and of torch functions."""

from functools import partial

import numpy as np
import torch

from raytrace.optimization.merit import Evaluation

#: Without undefined gradients, half of the time: only a custom autograd function can fail there, and its tests call
#: `torch.autograd.gradcheck`.
gradcheck = partial(torch.autograd.gradcheck, check_undefined_grad=False)
gradgradcheck = partial(torch.autograd.gradgradcheck, check_undefined_grad=False)


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
