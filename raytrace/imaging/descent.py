"""Descent: parameters brought to the least of an error that has exact gradients, by L-BFGS-B (scipy)."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

_MOST = 15_000  # steps


class NoOptimum(UserWarning):
    """A search that ended where the error still falls, and went on with what it had."""


@dataclasses.dataclass(frozen=True)
class Descent:
    """How a descent went.

    course: the error at every evaluation; at_end: for each number of the parameters, flattened, whether it stands at an
    end of its bounds behind which the error still falls; is_flat: the error had no slope where it began.
    """

    course: tuple[float, ...]
    at_end: tuple[bool, ...]
    is_flat: bool


def minimise(
    parameters: Sequence[Tensor],
    error: Callable[[], Tensor],
    *,
    steps: int = _MOST,
    unit: float = 1.0,
    bounds: Sequence[tuple[float, float]] | None = None,
    tolerance: float = 1e-10,
) -> Descent:
    """Bring parameters to the least `error()`, the first one downhill.

    unit: of the parameters, what the first step is as long as; bounds: of each of them (infinite: none), (lowest,
    highest); tolerance: relative change of the error below which it ends.
    """
    shapes, course, slopes = [p.shape for p in parameters], [], []
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
        slope = unit * flat(torch.autograd.grad(value, list(parameters)))
        slopes.append(slope)
        return course[-1], slope

    if bounds is not None:
        bounds = [tuple(end / unit if math.isfinite(end) else None for end in pair) for pair in bounds]
    options = {"maxiter": steps, "ftol": tolerance, "gtol": 1e-10}
    found = scipy.optimize.minimize(
        error_and_gradient, flat(parameters) / unit, jac=True, method="L-BFGS-B", bounds=bounds, options=options
    )
    put(found.x)
    pairs = [(None, None)] * len(found.x) if bounds is None else bounds
    at_end = tuple(map(_is_at_end, found.x.tolist(), found.jac.tolist(), pairs))
    return Descent(tuple(course), at_end, is_flat=not slopes[0].any())


def _is_at_end(place: float, slope: float, bounds: tuple[float | None, float | None]) -> bool:
    """Whether the error falls beyond a bound that a number stands at, to rounding."""
    end = bounds[0] if slope > 0 else bounds[1]
    return slope != 0 and end is not None and math.isclose(place, end, rel_tol=1e-9, abs_tol=1e-9)
