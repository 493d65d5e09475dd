"""Limits of compensators by the conditions of a lens: those on the number that is adjusted.

A compensator of a thickness or a curvature moves within the limits that conditions put on that thickness, its edge or
that curvature: MNCA, MXEA, CTGT … of a range of surfaces, and thickness:7<=60 or bfd>=30 of one space. The nominal lens
is compared: c with v(c) = target, v the value of the condition. Other conditions, as of the total track or the focal
length, and exact values hold for the nominal lens alone.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from raytrace.optimization.conditions import Condition
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.operands.boundaries import BOUNDARIES
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.system.tolerance_data import Compensator
from raytrace.tolerancing.study import with_changes

_FAR = 1e5  # a target that no thickness and no curvature meets, so that a row has the value of its surface
_STEPS = {"thickness": 1e-2, "curvature": 1e-6}  # differences by the compensators; of others no condition is a limit
_ACCURACY = 1e-10  # mm, of a condition at a limit


def within_conditions(lens: Lens, compensators: Sequence[Compensator]) -> tuple[tuple[Compensator, ...], list[str]]:
    """The compensators with limits by the conditions of the lens, and these limits in words."""
    limited, words = [], []
    for compensator in compensators:
        for condition in lens.conditions if compensator.operand is None else ():
            narrower = _limited(lens, compensator, condition)
            if narrower != compensator:
                words.append(f"{compensator.variable}: {condition}")
                compensator = narrower
        limited.append(compensator)
    return tuple(limited), words


def _limited(lens: Lens, compensator: Compensator, condition: Condition) -> Compensator:
    """The compensator with the limit of a condition; a condition that the lens does not meet is none."""
    row = _of_surface(condition, compensator.surface)
    step = _STEPS.get(compensator.parameter)
    if row is None or step is None or not condition.on or condition.relation == "=":
        return compensator
    view = lens.configuration(condition.configuration) if condition.configuration else lens
    side = 1.0 if condition.relation == ">=" else -1.0

    def value(change: float) -> float:
        moved = with_changes(view, [compensator], view.wavelengths.new_tensor([change]))
        return float(Evaluation(DesignVariables(moved), (row,))(np.zeros(0)).values[0])

    start = value(0.0)
    slope = (value(step) - start) / step
    if not abs(start) < 0.5 * _FAR or not abs(slope) > 1e-6 or not side * (start - condition.row.target) >= 0:
        return compensator  # no such gap behind surface k, or a violated condition
    change = (condition.row.target - start) / slope
    for _ in range(8):  # the edge is no linear function of a curvature
        off = condition.row.target - value(change)
        if not abs(off) > _ACCURACY:
            break
        change += off / slope
    if not math.isfinite(change):
        return compensator
    if side * slope < 0:
        return dataclasses.replace(compensator, maximum=min(compensator.maximum, max(change, 0.0)))
    return dataclasses.replace(compensator, minimum=max(compensator.minimum, min(change, 0.0)))


def _of_surface(condition: Condition, k: int) -> Row | None:
    """The row of a condition of a surface alone, with a target that it does not meet; None if it has no part in it."""
    row, (first, last) = condition.row, condition.row.integers
    if not isinstance(row.operand, str) or condition.before:
        return None
    name = row.operand
    if name == "TTHI":
        return row if first == last == k else None
    if name not in BOUNDARIES:
        return None
    far = _FAR if condition.relation == ">=" else -_FAR
    if name[:2] in ("MN", "MX"):
        return dataclasses.replace(row, integers=(k, k), target=far) if first <= k <= last else None
    return dataclasses.replace(row, target=far) if first == k else None
