"""Derivatives by finite differences, of merit functions."""

import numpy as np

from raytrace.optimization.merit_rows import Evaluation


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
