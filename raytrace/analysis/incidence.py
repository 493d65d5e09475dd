"""Angles of incidence: how steeply the middle and the rim of each field's beam meet every surface and the sensor."""

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.panels import DASHES, chart, finished, wavelength_label
from raytrace.analysis.result import OverField
from raytrace.analysis.setting import Numbers, Points, primary_wavelength, setting
from raytrace.maths.numerics import dot, value
from raytrace.maths.result import Table, masked
from raytrace.plotting.style import GREY, INK, Figure, array, field_colour, styled
from raytrace.system.intersection import normal
from raytrace.system.lens import Lens
from raytrace.system.poses import Gap, direction_in
from raytrace.system.surface import Surface, gap_behind
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import lens_steps

_RAYS = ("lower", "chief", "upper")
_CHIEF = _RAYS.index("chief")


@value
class Incidence(OverField):
    """Angles (F, W, 3, K) in degrees at surfaces 1 … K, the last of them the sensor.

    angle: between the normal of the surface and the ray in front of it, in the plane of the field: positive where the
        ray runs towards +y of a field along +y. Of the lower, chief and upper ray: the pupil at -1, 0 and 1 along the
        direction of the field. 0 where `valid` is False.
    height: (F, W, 3) mm, where they meet the sensor, along the direction of the field.
    valid: (F, W, 3, K) bool, whether they get there; a chief ray that is only vignetted does.
    fields: (2, F); surfaces: whether the text lists every surface, not the sensor alone.
    """

    lens: Lens
    fields: Tensor
    angle: Tensor
    height: Tensor
    valid: Tensor
    surfaces: bool = False

    COMMAND = "incidence"

    def columns(self) -> dict[str, Tensor]:
        numbers = torch.arange(1, self.angle.shape[-1] + 1, device=self.angle.device)
        angles = masked(self.angle, self.valid).unbind(2)
        return self.heads(wavelength=self.wavelengths, surface=numbers) | dict(zip(_RAYS, angles, strict=True))

    def summary(self) -> dict[str, Tensor]:
        """A row for every field and wavelength: angles on the sensor over the image height."""
        height = masked(self.height, self.valid[..., -1])[:, :, _CHIEF]
        angles = masked(self.angle, self.valid)[..., -1].unbind(2)
        return {**self.heads(wavelength=self.wavelengths), "height": height, **dict(zip(_RAYS, angles, strict=True))}

    def tables(self) -> list[Table]:
        if self.surfaces:
            return [Table(self.columns())]
        return [
            Table(self.summary(), ["angles of incidence on the sensor, of the rays at both rims and the chief ray"])
        ]

    def at(self, fields: Tensor) -> "Incidence":
        return _incidence(self.lens, fields)

    @styled
    def draw(self) -> Figure:
        """Angles at the sensor over the image height, of the first wavelength: the chief ray inside its beam."""
        curves = self.drawn()
        panel = chart(5.6, 3.8, "image height (mm)", "angle of incidence on the sensor (°)")
        table = curves.summary()
        height = array(table["height"][:, 0])
        order = np.argsort(height)
        height = height[order]
        lower, chief, upper = (array(table[name][:, 0])[order] for name in ("lower", "chief", "upper"))
        panel.fill_between(height, lower, upper, color=field_colour(0), alpha=0.12, linewidth=0, label="beam")
        panel.plot(height, upper, color=field_colour(0), linewidth=1.2, linestyle=DASHES[1], label="upper rim")
        panel.plot(height, chief, color=INK, linewidth=1.5, label="chief ray")
        panel.plot(height, lower, color=field_colour(2), linewidth=1.2, linestyle=DASHES[1], label="lower rim")
        panel.axhline(0, color=GREY, linewidth=0.6)
        if len(height) > 1 and np.isfinite(height).any():
            panel.set_xlim(np.nanmin(height), np.nanmax(height))
        return finished(panel, curves, f"angles of incidence ({wavelength_label(curves, 0)})", 4)


def incidence(
    lens: Lens, *, fields: Points = None, wavelengths: Numbers = None, samples: int = 11, surfaces: bool = False
) -> Incidence:
    """Angles of incidence at every surface; fields: y or (x, y), by default `samples` from the axis to the largest.

    wavelengths: µm, by default the lens's primary one; surfaces: list every surface in the text, not only the sensor.
    The rim is that of each field's beam, vignetting factors and ray aiming applied. A coordinate break has no angles.
    """
    lens, fields = setting(
        lens, fields, primary_wavelength(lens) if wavelengths is None else wavelengths, samples=samples
    )
    return _incidence(lens, fields, surfaces=surfaces)


def _incidence(lens: Lens, fields: Tensor, *, surfaces: bool = False) -> Incidence:
    along = field_directions(lens, fields)[:, :, None, None]  # (2, F, 1, 1), against (F, W, P)
    rays = launch(lens, along * fields.new_tensor([-1.0, 0.0, 1.0]), fields=fields)
    along = torch.cat([along, torch.zeros_like(along[:1])])
    angles, arrive, reached = [], [], rays.valid
    crossings = lens_steps(lens, rays, lens.wavelengths[:, None])
    gap = None
    for surface, crossing in zip(lens.surfaces[1:], crossings, strict=True):
        reached = reached & ~(crossing.missed | crossing.totally_reflected)
        direction, along = (in_axes_of(surface, gap, vector) for vector in (rays.direction, along))
        angles.append(_angle(surface, direction, crossing.rays.position, along))
        rays, gap = crossing.rays, gap_behind(surface)
        if surface.is_break:
            arrive.append(torch.zeros_like(reached))
            continue
        is_chief = torch.arange(3, device=along.device) == _CHIEF
        arrive.append(reached & (rays.valid | is_chief))
    valid = torch.stack(arrive, -1)
    return Incidence(
        lens=lens,
        fields=fields,
        angle=torch.where(valid, torch.rad2deg(torch.stack(angles, -1)), 0.0),
        height=(rays.position[:2] * along[:2]).sum(0),
        valid=valid,
        surfaces=surfaces,
    )


def field_directions(lens: Lens, fields: Tensor) -> Tensor:
    """Unit vectors (2, F) across the axis, from it towards the fields; +y for the axis."""
    x, y = torch.tan(torch.deg2rad(fields)) if lens.fields.kind == "angle" else fields
    length = torch.hypot(x, y)
    on_axis = length == 0
    length = torch.where(on_axis, 1.0, length)
    return torch.stack([x / length, torch.where(on_axis, 1.0, y / length)])


def in_axes_of(surface: Surface, gap: Tensor | Gap | None, vector: Tensor) -> Tensor:
    """A direction (3, ...) behind the surface before, in the axes of this one."""
    for pose in (gap.pose if isinstance(gap, Gap) else None, surface.before):
        if pose is not None:
            vector = torch.stack(torch.broadcast_tensors(*direction_in(pose, vector.unbind(0))))
    return vector


def _angle(surface: Surface, direction: Tensor, position: Tensor, along: Tensor) -> Tensor:
    """atan2(d·τ, |d·n|) of rays d and the normal n where they meet the surface; τ ⟂ n lies in the field's plane."""
    n, _ = normal(surface, position.unbind(0))
    t_x, t_y, _ = along
    tangent = t_x * n[2], t_y * n[2], -(t_x * n[0] + t_y * n[1])
    return torch.atan2(dot(tangent, direction), dot(n, direction).abs())
