"""Ray aiming for bundles: pupil points whose rays pass given points of the stop, with their derivatives.

The points a solve s(a, x) = p r(x), s the hit on the stop, p the point of the pupil, r the radius of the stop: by
Newton's method from where they were last, and by the implicit function theorem ∂a/∂x = (∂s/∂a)⁻¹ (p ∂r/∂x - ∂s/∂x).
"""

from collections.abc import Callable

import numpy as np

from raytrace.maths.dual import Dual, value_of
from raytrace.merit.moment import Moment

_STEPS = 12
_CLOSE = 1e-9  # of the radius of the stop: one more step ends at rounding

#: The hits (x, y) on the stop of rays through pupil points (2, W, R), and which arrive.
AtStop = Callable[[Moment, tuple], tuple]


def aimed(moment: Moment, at_stop: AtStop, target: np.ndarray, radius, last: np.ndarray):
    """Pupil points, two of (W, R), as numbers or dual ones, and which rays were found.

    moment: with or without derivatives; target: (2, W, R), of the stop; radius: mm, signed; last: where to begin.
    """
    fixed = moment.fixed()
    goal = target * value_of(radius)
    points, found, inverse = _root(fixed, at_stop, goal, abs(value_of(radius)), last)
    if not moment.count:
        return tuple(points), found, points
    (x, y), _ = at_stop(moment, tuple(points))
    missed = [target[0] * radius - x, target[1] * radius - y]
    slopes = [part.full() if isinstance(part, Dual) else np.zeros((moment.count, *target.shape[1:])) for part in missed]
    moved = [inverse[k][0] * slopes[0] + inverse[k][1] * slopes[1] for k in range(2)]
    return tuple(Dual(at, np.where(found, by, 0.0)) for at, by in zip(points, moved, strict=True)), found, points


def _root(moment: Moment, at_stop: AtStop, goal: np.ndarray, size: float, start: np.ndarray):
    """Points (2, W, R), which were found, and the inverse of ∂s/∂a there, by components."""
    points, done = start.copy(), False
    for _ in range(_STEPS):
        moving = tuple(Dual(part, np.eye(2)[:, k, None, None] * np.ones_like(part)) for k, part in enumerate(points))
        (x, y), arrives = at_stop(moment, moving)
        missed = goal - np.stack([x.value, y.value])
        (xx, xy), (yx, yy) = x.full(), y.full()
        determinant = xx * yy - xy * yx
        usable = arrives & (determinant != 0)
        scale = np.where(usable, determinant, 1.0)
        inverse = ((yy / scale, -xy / scale), (-yx / scale, xx / scale))
        step = np.stack([row[0] * missed[0] + row[1] * missed[1] for row in inverse])
        points = np.where(usable, points + step, points)
        close = usable & (np.abs(missed).max(0) <= _CLOSE * size)
        if done or not usable.any():
            break
        done = bool((close | ~usable).all())
    return points, close, inverse
