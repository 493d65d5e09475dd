"""Radial errors at their limits: the direction in which the criterion gets worst.

A radial error (R cos φ, R sin φ) changes the criterion by a smooth function of φ with period 2π. It is traced at twelve
directions, interpolated by the trigonometric polynomial through them, and the largest value is its worst direction.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from raytrace.tolerancing.table import ToleranceTable

_DIRECTIONS, _FINE = 12, 1440
_EQUAL = 1e-6  # of the largest change: differences between directions that are none


def limits_alone(tolerances: ToleranceTable, harm: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Errors (N, N) of lenses with one row alone at its minimum, at its maximum, and the worst directions (N,).

    harm: errors (L, N) -> how much worse the criterion is (L,). All rows of a group are at their limits at once; a
    radial error has its whole magnitude in its worst direction at the maximum, and in the opposite one at the minimum.
    Directions are in degrees from x to y, nan of rows that are not radial; 0 where the direction does not matter.
    """
    low, high = tolerances.alone(tolerances.minimum), tolerances.alone(tolerances.maximum)
    worst = torch.full((len(tolerances),), torch.nan, dtype=torch.float64)
    radial = tolerances.radial
    if not radial:
        return low, high, worst
    angles = 2 * math.pi / _DIRECTIONS * torch.arange(_DIRECTIONS, dtype=torch.float64)
    errors = low.new_zeros(len(radial), _DIRECTIONS, len(tolerances))
    for k, error in enumerate(radial.values()):
        errors[k][:, error.along] = error.magnitude * torch.stack([angles.cos(), angles.sin()], -1)
    changes = harm(errors.flatten(0, 1)).reshape(len(radial), _DIRECTIONS).double()
    for (first, error), around in zip(radial.items(), changes, strict=True):
        angle = torch.deg2rad(_largest(around))
        worst[first] = torch.rad2deg(angle)
        towards = error.magnitude * torch.stack([angle.cos(), angle.sin()]).to(high)
        high[first, error.along] = towards
        low[first, error.along] = -towards
    return low, high, worst


def _largest(around: Tensor) -> Tensor:
    """The direction, in degrees, of the largest value of a periodic function, of values (D,) at D directions."""
    count = len(around)
    if not bool(around.isfinite().all()):  # the lens fails there
        return around.nan_to_num(torch.inf).argmax().double() * (360.0 / count)
    scale = _EQUAL * around.abs().max()
    fine = torch.fft.irfft(torch.fft.rfft(around), _FINE) * (_FINE / count)
    best = around if float(fine.max()) <= float(around.max() + scale) else fine
    return (best >= best.max() - scale).double().argmax().double() * (360.0 / len(best))
