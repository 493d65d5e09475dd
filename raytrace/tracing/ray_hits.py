"""Arrivals: where every ray of a spot meets the sensor, from which field, colour and point of the pupil."""

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from raytrace.budget import RAY_BYTES, afford
from raytrace.maths.result import Result, axis, masked
from raytrace.maths.value import value
from raytrace.system.lens import Lens, field_points
from raytrace.system.rays import Rays
from raytrace.tracing.axis import is_bent
from raytrace.tracing.focus import image_rays
from raytrace.tracing.launch import launch
from raytrace.tracing.ray_failures import STATUS, ray_status
from raytrace.tracing.trace import lens_steps

_KEPT_BYTES = 100  # of a ray on the sensor, with its status


@value
class Arrivals(Result):
    """Rays (3, F, W, P) on the sensor, every ray of the pupil for every field and wavelength.

    status: (F, W, P), place in STATUS of what befell it first; reached: (F, W, P), whether it has a place on the
    sensor, as a vignetted ray that goes on may have. weight: (W, P), 1 in all for a field.
    pupil: (2, P); fields: (2, F); wavelengths: (W,) µm.
    The table has a row a ray, its status in words; x and y are empty where it is not on the sensor.
    """

    rays: Rays
    status: Tensor
    reached: Tensor
    weight: Tensor
    pupil: Tensor
    fields: Tensor
    wavelengths: Tensor

    def columns(self) -> dict[str, Tensor]:
        return {
            "field_x": axis(self.fields[0], 0, 3),
            "field_y": axis(self.fields[1], 0, 3),
            "wavelength": axis(self.wavelengths, 1, 3),
            "pupil_x": axis(self.pupil[0], 2, 3),
            "pupil_y": axis(self.pupil[1], 2, 3),
            "x": masked(self.rays.position[0], self.reached),
            "y": masked(self.rays.position[1], self.reached),
            "weight": self.weight,
            "status": self.status,
        }

    def words(self) -> dict:
        return {"status": STATUS}


def arrivals(
    lens: Lens,
    pupil: Tensor,
    weights: Tensor,
    *,
    fields: Tensor | None = None,
    ray_aiming: str | None = None,
    progress: Callable[[Sequence[Tensor]], Iterable[Tensor]] = iter,
) -> Arrivals:
    """Trace points (2, P) of the pupil and their weights (P,) to the sensor, field by field.

    fields, ray_aiming: as for `launch`; progress: goes over the fields one by one, as a bar does. Raises
    budget.OverBudget for more rays than memory holds.
    """
    fields = field_points(fields, like=lens)
    F, W, P = fields.shape[1], len(lens.wavelengths), pupil.shape[1]
    count = f"{F * W * P:,} rays ({F} fields × {W} wavelengths × {P:,} pupil points)"
    afford(RAY_BYTES * W * P + _KEPT_BYTES * F * W * P, count, helps="ask for fewer, or by `rays`, which keeps none")
    each = [_field(lens, pupil, field[:, None], ray_aiming) for field in progress(fields.unbind(1))]
    joined = Rays(
        torch.cat([rays.position for rays, *_ in each], 1),
        torch.cat([rays.direction for rays, *_ in each], 1),
        torch.cat([rays.valid for rays, *_ in each]),
    )
    shares = lens.wavelength_weights / lens.wavelength_weights.sum()
    weight = shares[:, None] * weights / weights.sum()
    status, reached = (torch.cat(found) for found in zip(*(rest for _, *rest in each), strict=True))
    return Arrivals(joined, status, reached, weight, pupil, fields, lens.wavelengths)


def _field(lens: Lens, pupil: Tensor, field: Tensor, ray_aiming: str | None) -> tuple[Rays, Tensor, Tensor]:
    """Rays (3, 1, W, P) of one field (2, 1) on the sensor, their status, and whether they reach it."""
    rays = launch(lens, pupil, fields=field, ray_aiming=ray_aiming)
    reached = rays.valid
    for crossing, status in ray_status(lens, rays, lens.wavelengths[:, None]):
        reached = reached & ~crossing.missed & ~crossing.totally_reflected
        found = crossing.rays, status, reached
    return found


def chief_points(lens: Lens, fields: Tensor, wavelengths: Tensor) -> tuple[Tensor, Tensor]:
    """Where chief rays of fields (2, F) meet the sensor, (2, F, W) mm; whether they arrive or were only vignetted."""
    rays = image_rays(lens, fields.new_zeros(2, 1), fields=fields, wavelengths=wavelengths)
    if is_bent(lens):
        return rays.position[:2, ..., 0], unclipped(lens, fields.new_zeros(2, 1), fields, wavelengths)[..., 0]
    on_axis = (fields == 0).all(0)[:, None]
    return rays.position[:2, ..., 0], (rays.valid | keeps_coordinates(rays.direction))[..., 0] | on_axis


@torch.no_grad()
def unclipped(lens: Lens, pupil: Tensor, fields: Tensor, wavelengths: Tensor) -> Tensor:
    """Which rays (F, W, P) of pupil points (2, P) reach the sensor, or would if nothing clipped any."""
    rays = launch(lens, pupil, fields=fields, wavelengths=wavelengths)
    reached = rays.valid
    for crossing in lens_steps(lens, rays, wavelengths[:, None]):
        reached = reached & ~crossing.missed & ~crossing.totally_reflected
    return reached


def chief_reference(lens: Lens, fields: Tensor) -> Tensor:
    """Where the primary wavelength's chief rays of fields (2, F) meet the sensor, (2, F, 1) mm; nan where none does."""
    points, valid = chief_points(lens, fields, lens.primary[None])
    return torch.where(valid, points, torch.nan)


def keeps_coordinates(direction: Tensor) -> Tensor:
    """Whether rays keep their coordinates, if the axis is straight: one that missed a surface has become axial."""
    return (direction[:2] != 0).any(0)
