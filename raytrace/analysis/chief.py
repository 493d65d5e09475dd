"""Curves over the field that follow the chief ray: distortion, field curvature, lateral colour."""

import torch
from torch import Tensor

from raytrace.analysis.setting import field_range, in_object_space, primary_number, unvignetted, wavelengths_of
from raytrace.maths.numerics import dot_2, safe_divide, safe_sqrt
from raytrace.maths.result import Result, axis, masked
from raytrace.maths.value import value
from raytrace.optics.arrivals import chief_points, keeps_coordinates
from raytrace.optics.focus import image_rays
from raytrace.optics.launch import is_at_infinity
from raytrace.system.lens import Lens

_NEAR_AXIS = 1e-4  # of the field: its chief ray gives the scale of the image; it leaves 1e-8 of the distortion
_NEAR_CHIEF = 1e-3  # of the pupil: close rays leave 1e-6 of the spherical aberration


@value
class Distortion(Result):
    """Heights (F, W) in mm of chief rays on the sensor, and by how much they miss the ideal image.

    height: along the meridian of the field, positive towards +y (+x where it is the x axis), as the ray's own y.
    f_tan: relative, height/(f tan θ) - 1, of an object at a finite distance height/(m h) - 1; 0 on the axis.
    f_theta: relative, height/(f θ) - 1; None for an object at a finite distance.
    fields: (2, F); wavelengths: (W,) µm; valid: (F, W) bool.
    """

    height: Tensor
    f_tan: Tensor
    f_theta: Tensor | None
    fields: Tensor
    wavelengths: Tensor
    valid: Tensor

    def columns(self) -> dict[str, Tensor]:
        table = {**_heads(self), "height": masked(self.height, self.valid), "f_tan": masked(self.f_tan, self.valid)}
        return table if self.f_theta is None else {**table, "f_theta": masked(self.f_theta, self.valid)}


@value
class FieldCurvature(Result):
    """Where close rays about the chief ray meet: (F, W) mm from the sensor, positive behind it.

    tangential: of rays in the plane of the field; sagittal: across it; valid: (F, W) bool.
    fields: (2, F); wavelengths: (W,) µm.
    """

    tangential: Tensor
    sagittal: Tensor
    fields: Tensor
    wavelengths: Tensor
    valid: Tensor

    def columns(self) -> dict[str, Tensor]:
        tangential, sagittal = masked(self.tangential, self.valid), masked(self.sagittal, self.valid)
        return {**_heads(self), "tangential": tangential, "sagittal": sagittal}


@value
class LateralColour(Result):
    """Height (F, W) in mm of each wavelength's chief ray on the sensor, less the primary wavelength's.

    Heights along the meridian of the field, positive towards +y (+x where it is the x axis).
    fields: (2, F); wavelengths: (W,) µm; valid: (F, W) bool.
    """

    shift: Tensor
    fields: Tensor
    wavelengths: Tensor
    valid: Tensor

    def columns(self) -> dict[str, Tensor]:
        return {**_heads(self), "shift": masked(self.shift, self.valid)}


def distortion(
    lens: Lens, *, fields: Tensor | None = None, wavelengths: Tensor | None = None, size: int = 41
) -> Distortion:
    """Distortion of the chief ray, 1 = 100 %; fields: (2, F), by default `size` from the axis to the lens's largest.

    The scale of the ideal image is that of each wavelength's own chief ray close to the axis, on the sensor as it
    stands: an image out of focus is not distorted for that.
    """
    lens = unvignetted(lens)
    fields = field_range(lens, size) if fields is None else fields
    wavelengths = wavelengths_of(lens, wavelengths)
    described, angles, extent, found = in_object_space(lens, fields)
    close = field_range(lens, 2)[:, 1:] * _NEAR_AXIS
    _, close_angles, close_extent, _ = in_object_space(lens, close)
    length = dot_2(fields, _meridian(fields)).sign() * safe_sqrt(dot_2(extent, extent))
    height, valid = _height(described, angles, wavelengths, fields)
    scale = _height(described, close_angles, wavelengths, close)[0] / safe_sqrt(dot_2(close_extent, close_extent))
    f_tan = _relative(height, scale * length[:, None])
    infinite = is_at_infinity(lens)
    f_theta = _relative(height, scale * torch.atan(length)[:, None]) if infinite else None
    return Distortion(height, f_tan, f_theta, fields, wavelengths, valid & found[:, None])


def field_curvature(
    lens: Lens, *, fields: Tensor | None = None, wavelengths: Tensor | None = None, size: int = 41
) -> FieldCurvature:
    """Tangential and sagittal foci of close rays, s = -(∂x/∂p)/(∂m/∂p) with m = (L, M)/N, as Coddington's equations.

    fields: (2, F), by default `size` from the axis to the lens's largest. Tangential is the plane through the axis and
    the field point, sagittal the one across it. Close rays that leave the lens parallel have no focus: invalid.
    """
    lens = unvignetted(lens)
    fields = field_range(lens, size) if fields is None else fields
    wavelengths = wavelengths_of(lens, wavelengths)
    along = torch.where((fields == 0).all(0), fields.new_tensor([[0.0], [1.0]]), _meridian(fields))
    alike = bool((along == along[:, :1]).all())
    groups = [(fields, along[:, :1])] if alike else zip(fields.split(1, 1), along.split(1, 1), strict=True)
    each = [_close_foci(lens, group, wavelengths, meridian) for group, meridian in groups]
    tangential, sagittal, valid = (torch.cat(found) for found in zip(*each, strict=True))
    return FieldCurvature(tangential, sagittal, fields, wavelengths, valid)


def _close_foci(lens: Lens, fields: Tensor, wavelengths: Tensor, along: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Tangential and sagittal foci (F, W) of fields (2, F) in one meridian (2, 1), and whether they exist."""
    across = torch.stack([along[1], -along[0]])
    pupil = torch.cat([along, -along, across, -across], 1) * _NEAR_CHIEF
    rays = image_rays(lens, pupil, fields=fields, wavelengths=wavelengths)
    slope = safe_divide(rays.direction[:2], rays.direction[2].expand_as(rays.direction[:2]))
    foci, valid = [], (rays.valid | keeps_coordinates(rays.direction)).all(-1)
    for section, pair in ((along, slice(0, 2)), (across, slice(2, 4))):
        place, tilt = (dot_2(part[..., pair], section[:, :, None, None]) for part in (rays.position[:2], slope))
        opening = tilt[..., 0] - tilt[..., 1]
        foci.append(-safe_divide(place[..., 0] - place[..., 1], opening))
        valid = valid & (opening.abs() > 8 * torch.finfo(opening.dtype).eps)
    return *foci, valid


def lateral_colour(
    lens: Lens, *, fields: Tensor | None = None, wavelengths: Tensor | None = None, size: int = 41
) -> LateralColour:
    """Lateral colour of the chief rays; fields: (2, F), by default `size` from the axis to the lens's largest."""
    lens = unvignetted(lens)
    fields = field_range(lens, size) if fields is None else fields
    primary = primary_number(lens, wavelengths)
    wavelengths = wavelengths_of(lens, wavelengths)
    height, valid = _height(lens, fields, wavelengths, fields)
    valid = valid & valid[:, primary : primary + 1]
    shift = torch.where(valid, height - height[:, primary : primary + 1], 0.0)
    return LateralColour(shift, fields, wavelengths, valid)


def _height(lens: Lens, fields: Tensor, wavelengths: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """Heights (F, W) of chief rays in the meridians of `along` (2, F), and whether they arrive or are but vignetted."""
    points, valid = chief_points(lens, fields, wavelengths)
    return dot_2(points, _meridian(along)[:, :, None]), valid


def _meridian(fields: Tensor) -> Tensor:
    """Unit vectors (2, F) along fields (2, F), turned to +y, or to +x on the x axis; 0 for the axis."""
    x, y = fields
    side = torch.where((y < 0) | (y == 0) & (x < 0), -1.0, 1.0)
    length = safe_sqrt(dot_2(fields, fields))
    return torch.stack([safe_divide(side * x, length), safe_divide(side * y, length)])


def _relative(height: Tensor, ideal: Tensor) -> Tensor:
    return safe_divide(height - ideal, ideal)


def _heads(curve) -> dict[str, Tensor]:
    """The columns of field and wavelength."""
    x, y = (axis(component, 0, 2) for component in curve.fields)
    return {"field_x": x, "field_y": y, "wavelength": axis(curve.wavelengths, 1, 2)}
