"""Rays by torch: for lenses that are launched or traced by torch alone, a derivative for every variable."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from raytrace.maths.dual import Dual, value_of
from raytrace.merit.moment import Moment
from raytrace.system.lens import Lens
from raytrace.system.rays import Rays


def rays_by_torch(
    moment: Moment, function: Callable[[Lens], Rays], shape: tuple[int, int], *, backward: bool = False
) -> tuple[list, np.ndarray]:
    """x, y, z, L, M, N and path (W, R) of the rays that a function takes from the lens at a moment; and validity.

    backward: derivatives of every ray, one by one, where the function takes forward derivatives of its own (rays aimed
    about a base ray), which do not nest.
    """

    def told(lens: Lens) -> tuple[list[Tensor], Tensor]:
        rays = function(lens)
        parts = *rays.position, *rays.direction, rays.opl
        return [part.expand(shape) for part in parts], rays.valid.expand(shape)

    with torch.no_grad():
        parts, valid = told(moment.view.leaves(_values(moment))[1])
        values, valid = [part.numpy().copy() for part in parts], valid.numpy().copy()
    if not moment.count:
        return values, valid
    slopes = (_backward if backward else _forward)(moment, lambda lens: told(lens)[0], valid)
    return [Dual(value, np.where(valid, slope, 0.0)) for value, slope in zip(values, slopes, strict=True)], valid


def _values(moment: Moment) -> dict:
    return {at: value_of(number) for at, number in moment.numbers.items()}


def _forward(moment: Moment, told, valid: np.ndarray) -> np.ndarray:
    slopes = np.zeros((7, moment.count, *valid.shape))
    numbers = {at: torch.tensor(float(n), dtype=torch.float64) for at, n in _values(moment).items()}
    for variable in range(moment.count):
        with forward_ad.dual_level():
            moved = {
                at: forward_ad.make_dual(numbers[at], numbers[at].new_tensor(float(number.slope[variable])))
                for at, number in moment.numbers.items()
                if isinstance(number, Dual)
            }
            for part, number in zip(slopes, told(moment.view.held(numbers | moved)), strict=True):
                tangent = forward_ad.unpack_dual(number).tangent
                if tangent is not None:
                    part[variable] = tangent.numpy()
    return slopes


def _backward(moment: Moment, told, valid: np.ndarray) -> np.ndarray:
    slopes = np.zeros((7, moment.count, valid.size))
    with torch.enable_grad():
        leaves, lens = moment.view.leaves(_values(moment))
        for part, number in zip(slopes, told(lens), strict=True):
            for ray in np.flatnonzero(valid) if number.requires_grad else ():
                part[:, ray] = moment.chained(number.reshape(-1)[ray], leaves).slope
    return slopes.reshape(7, moment.count, *valid.shape)
