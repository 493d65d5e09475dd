"""Descent by gradients alone, for a merit that is no sum of squares: L-BFGS within bounds.

The gradient is found backward through all that the merit does with a lens, and carried on through solves.

Source: Byrd, Lu, Nocedal & Zhu 1995.
"""

import time
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import minimize
from torch import Tensor

from raytrace.maths.dual import Dual, slope_of, value_of
from raytrace.optimization.least_squares import Cycle
from raytrace.optimization.lens_model import Model
from raytrace.system.lens import Lens

_FAR = 1e3  # of the merit at the start: what a lens costs of which it is no number
_CHANGE, _STEEP = 1e-10, 1e-9


class _Ended(Exception):
    """No time is left."""


class Function:
    """A merit of a lens as a function of the variables of a model.

    evaluated: (E, n + 1 + n) variables, value and gradient of evaluations that are known: a descent that is resumed
    passes through them again, without evaluating, to where it was.
    """

    def __init__(self, model: Model, function: Callable[[Lens], Tensor], evaluated: Sequence[np.ndarray] = ()):
        self.model, self.view = model, model.views[model.lens.current_configuration - 1]
        self.function, self.evaluations, self.evaluated = function, 0, [*evaluated]
        self.known = {one[: len(one) // 2].tobytes(): one for one in self.evaluated}

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """The merit and its gradient (n,)."""
        self.evaluations += 1
        x = np.array(x, dtype=float)
        if (known := self.known.get(x.tobytes())) is not None:
            return float(known[len(x)]), known[len(x) + 1 :].copy()
        state = self.view.state(Dual(x, np.eye(len(x))))
        (found,) = state.through_torch(lambda lens: [self.function(lens).reshape(())], clips=True)
        value, slope = float(value_of(found)), slope_of(found, len(x))
        self.evaluated.append(np.array([*x, value, *slope]))
        return value, slope


def lowest(
    merit: Function,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray,
    cycles: int | None = None,
    seconds: float | None = None,
    watch: Callable[[Cycle, np.ndarray], None] | None = None,
) -> tuple[np.ndarray, str, list[Cycle]]:
    """Variables where the merit is least, why the descent ended, and its cycles; typical: as for `least_squares`."""
    begun, told = time.monotonic(), []
    scale = np.where(np.isfinite(typical), typical, np.maximum(np.abs(x), 1e-3))
    start = merit(x)[0]
    best, last = [start, x], [0.0]  # last: s of an evaluation

    def cost(y: np.ndarray) -> tuple[float, np.ndarray]:
        begun_here = time.monotonic()
        if seconds is not None and begun_here + last[0] > begun + seconds:
            raise _Ended
        here, by = merit(y * scale)
        last[0] = time.monotonic() - begun_here
        if not (np.isfinite(here) and np.isfinite(by).all()):
            return _FAR * max(abs(start), 1.0), np.zeros_like(y)
        if here < best[0]:
            best[:] = here, y * scale
        return here, by * scale

    def each(y: np.ndarray) -> None:
        passed = time.monotonic() - begun
        told.append(Cycle(len(told) + 1, best[0], 0.0, 0.0, 0.0, merit.evaluations, passed))
        if watch is not None:
            watch(told[-1], best[1])
        if seconds is not None and passed > seconds:
            raise _Ended

    options = {"maxiter": 1000 if cycles is None else cycles, "ftol": _CHANGE, "gtol": _STEEP, "maxcor": 20}
    bounds = np.stack([lower / scale, upper / scale], -1)
    try:
        done = minimize(cost, x / scale, jac=True, method="L-BFGS-B", bounds=bounds, callback=each, options=options)
        stopped = "cycles" if done.status == 1 else "step" if done.status else "merit"
    except _Ended:
        stopped = "seconds"
    except KeyboardInterrupt:
        stopped = "interrupted"
    return best[1], stopped, told
