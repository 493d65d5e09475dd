"""Angles of incidence: how steeply the middle and the rim of each field's beam meet every surface and the sensor."""

import torch
from torch import Tensor

from raytrace.analysis.setting import field_range
from raytrace.maths.numerics import dot
from raytrace.maths.result import Result, axis, masked
from raytrace.maths.value import value
from raytrace.optics.launch import launch
from raytrace.optics.trace import media, steps
from raytrace.system.lens import Lens
from raytrace.system.surface import Surface, normal

_LOWER, _CHIEF, _UPPER = range(3)


@value
class Incidence(Result):
    """Angles (F, W, 3, K) in degrees at surfaces 1 … K, the last of them the sensor.

    angle: between the normal of the surface and the ray in front of it, in the plane of the field: positive where the
        ray runs towards +y of a field along +y. Of the lower, chief and upper ray: the pupil at -1, 0 and 1 along the
        direction of the field. 0 where `valid` is False.
    height: (F, W, 3) mm, where they meet the sensor, along the direction of the field.
    valid: (F, W, 3, K) bool, whether they get there; a chief ray that is only vignetted does.
    fields: (2, F); wavelengths: (W,) µm.
    """

    angle: Tensor
    height: Tensor
    valid: Tensor
    fields: Tensor
    wavelengths: Tensor

    def columns(self) -> dict[str, Tensor]:
        surfaces = torch.arange(1, self.angle.shape[-1] + 1, device=self.angle.device)
        angle = masked(self.angle, self.valid)
        return {
            "field_x": axis(self.fields[0], 0, 3),
            "field_y": axis(self.fields[1], 0, 3),
            "wavelength": axis(self.wavelengths, 1, 3),
            "surface": axis(surfaces, 2, 3),
            "lower": angle[:, :, _LOWER],
            "chief": angle[:, :, _CHIEF],
            "upper": angle[:, :, _UPPER],
        }

    def on_sensor(self) -> dict[str, Tensor]:
        """The columns of a table with a row for every field and wavelength: angles over the image height."""
        table = {name: column[..., -1] for name, column in self.columns().items() if name != "surface"}
        height = masked(self.height, self.valid[..., -1])[:, :, _CHIEF]
        angles = {name: table.pop(name) for name in ("lower", "chief", "upper")}
        return {**table, "height": height, **angles}


def incidence(
    lens: Lens, *, fields: Tensor | None = None, wavelengths: Tensor | None = None, size: int = 11
) -> Incidence:
    """Angles of incidence at every surface; fields: (2, F), by default `size` from the axis to the lens's largest.

    wavelengths: (W,) µm, by default the lens's primary one. The rim is that of each field's beam, vignetting factors
    and ray aiming applied.
    """
    fields = field_range(lens, size) if fields is None else fields
    wavelengths = lens.wavelengths[lens.primary_wavelength][None] if wavelengths is None else wavelengths
    along = _directions(lens, fields)[:, :, None, None]  # (2, F, 1, 1), beside (F, W, P)
    rays = launch(lens, along * fields.new_tensor([-1.0, 0.0, 1.0]), fields=fields, wavelengths=wavelengths)
    angles, valid, reached = [], [], rays.valid
    for surface, crossing in zip(
        lens.surfaces[1:], steps(lens.surfaces[1:], rays, indices=media(lens, wavelengths[:, None])), strict=True
    ):
        reached = reached & ~(crossing.missed | crossing.totally_reflected)
        angles.append(_angle(surface, rays.direction, crossing.rays.position, along))
        rays = crossing.rays
        is_chief = torch.arange(3, device=along.device) == _CHIEF
        valid.append(reached & (rays.valid | is_chief))
    valid = torch.stack(valid, -1)
    return Incidence(
        angle=torch.where(valid, torch.rad2deg(torch.stack(angles, -1)), 0.0),
        height=(rays.position[:2] * along).sum(0),
        valid=valid,
        fields=fields,
        wavelengths=wavelengths,
    )


def _directions(lens: Lens, fields: Tensor) -> Tensor:
    """Unit vectors (2, F) across the axis, from it towards the fields; +y for the axis."""
    x, y = torch.tan(torch.deg2rad(fields)) if lens.fields.kind == "angle" else fields
    length = torch.hypot(x, y)
    on_axis = length == 0
    length = torch.where(on_axis, 1.0, length)
    return torch.stack([x / length, torch.where(on_axis, 1.0, y / length)])


def _angle(surface: Surface, direction: Tensor, position: Tensor, along: Tensor) -> Tensor:
    """atan2(d·τ, |d·n|) of rays d and the normal n where they meet the surface; τ ⟂ n lies in the field's plane."""
    n, _ = normal(surface, position.unbind(0))
    t_x, t_y = along
    tangent = t_x * n[2], t_y * n[2], -(t_x * n[0] + t_y * n[1])
    return torch.atan2(dot(tangent, direction), dot(n, direction).abs())
