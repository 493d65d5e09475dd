"""Operands of incidence: the angle of a ray, in front of a surface or behind it, to the normal where they meet."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import dot, safe_sqrt
from raytrace.merit.plan import Now, Operand
from raytrace.merit.rays import by_surface, known
from raytrace.system.lens import Lens
from raytrace.system.pose import Gap, direction_in
from raytrace.system.surface import gap_behind, normal


def _to_normal(tell: Callable[[Tensor, Tensor], Tensor], *, behind: bool) -> Callable:
    """A number of |cosine| and sine of the angle to the normal, of the ray in front of the surface or behind it."""

    def number(now: Now, rays: dict[int, np.ndarray], surface: int):
        here = now.hits(rays[surface], surface=surface)
        ray = here if behind else now.hits(rays[surface - 1], surface=surface - 1)

        def of(lens: Lens, *numbers: Tensor) -> Tensor:
            position, direction = numbers[:3], list(numbers[3:])
            if not behind:
                direction = _told_at(lens, surface, direction)
            n, _ = normal(lens.surfaces[surface], position)
            across = [n[i - 2] * direction[i - 1] - n[i - 1] * direction[i - 2] for i in range(3)]
            length = torch.sqrt(dot(n, n))
            return tell(dot(n, direction).abs() / length, safe_sqrt(dot(across, across)) / length)

        found = now.moment.each_through_torch(of, (*here.position, *ray.direction))
        return known(here.valid & ray.valid, found)

    return by_surface(number, lambda surface: (surface,) if behind else (surface - 1, surface))


def _told_at(lens: Lens, surface: int, direction: list[Tensor]) -> list[Tensor]:
    """A direction behind the surface before, or of a launched ray, in the axes of a surface."""
    gap = gap_behind(lens.surfaces[surface - 1]) if surface > 1 else None
    for pose in (gap.pose if isinstance(gap, Gap) else None, lens.surfaces[surface].before):
        if pose is not None:
            direction = direction_in(pose, direction)
    return direction


def _degrees(cosine: Tensor, sine: Tensor) -> Tensor:
    return torch.rad2deg(torch.atan2(sine, cosine))


def _cosine(cosine: Tensor, sine: Tensor) -> Tensor:
    return cosine


_TAKES = "met surface", "wavelength"

INCIDENCE = {
    "RAID": Operand(
        _to_normal(_degrees, behind=False), "angle of incidence on a surface, degrees, never negative", takes=_TAKES
    ),
    "RAIN": Operand(_to_normal(_cosine, behind=False), "cosine of the angle of incidence on a surface", takes=_TAKES),
    "RAED": Operand(
        _to_normal(_degrees, behind=True),
        "angle behind a surface to its normal, degrees, never negative",
        takes=_TAKES,
    ),
    "RAEN": Operand(
        _to_normal(_cosine, behind=True), "cosine of the angle behind a surface to its normal", takes=_TAKES
    ),
}
