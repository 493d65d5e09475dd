"""Descent: parameters brought to the least of an error that has exact gradients, by L-BFGS-B (scipy)."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

_MOST = 15_000  # steps


def minimise(
    parameters: Sequence[Tensor],
    error: Callable[[], Tensor],
    *,
    steps: int = _MOST,
    unit: float = 1.0,
    bounds: Sequence[tuple[float, float]] | None = None,
    tolerance: float = 1e-10,
) -> list[float]:
    """Bring parameters to the least `error()`, the first one downhill; returns the error at every evaluation.

    unit: of the parameters, what the first step is as long as; bounds: of each of them (infinite: none), (lowest,
    highest); tolerance: relative change of the error below which it ends.
    """
    shapes, course = [p.shape for p in parameters], []
    ends = np.cumsum([shape.numel() for shape in shapes])[:-1]

    def put(values: np.ndarray) -> None:
        with torch.no_grad():
            for p, part in zip(parameters, np.split(unit * values, ends), strict=True):
                p.copy_(torch.as_tensor(part).reshape(p.shape))

    def flat(tensors: Sequence[Tensor]) -> np.ndarray:
        return torch.cat([t.detach().flatten() for t in tensors]).double().numpy()

    def error_and_gradient(values: np.ndarray) -> tuple[float, np.ndarray]:
        put(values)
        value = error()
        course.append(float(value.detach()))
        return course[-1], unit * flat(torch.autograd.grad(value, list(parameters)))

    if bounds is not None:
        bounds = [tuple(end / unit if math.isfinite(end) else None for end in pair) for pair in bounds]
    options = {"maxiter": steps, "ftol": tolerance, "gtol": 1e-10}
    found = scipy.optimize.minimize(
        error_and_gradient, flat(parameters) / unit, jac=True, method="L-BFGS-B", bounds=bounds, options=options
    )
    put(found.x)
    return course
