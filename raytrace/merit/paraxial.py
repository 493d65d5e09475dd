"""Operands of first order."""

from collections.abc import Callable, Sequence

import numpy as np

from raytrace.maths.dual import Dual, slope_of, value_of
from raytrace.merit.plan import Evaluate, Found, Line, Now, Operand, Planner


def one_by_one(tell: Callable[[Now, Line], object]) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """Rows that share nothing: a number for each, of the moment and the row."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        return lambda now: Found(listed([tell(now, line) for line in lines], now.moment.count))

    return plan


def listed(numbers: Sequence, count: int):
    """Numbers () as one array (R,), with derivatives if there are any."""
    values = np.array([float(value_of(number)) for number in numbers])
    return Dual(values, np.stack([slope_of(n, count) for n in numbers], -1)) if count else values


def _effective_focal_length(now: Now, line: Line):
    return now.moment.gaussian(line.wavelength).effective_focal_length


PARAXIAL = {
    "EFFL": Operand(one_by_one(_effective_focal_length), "effective focal length at a wavelength", length=1),
}
