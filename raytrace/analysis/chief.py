"""Curves over the field that follow the chief ray: distortion, field curvature, lateral colour."""

import math

import torch
from torch import Tensor

from raytrace.analysis.panels import SAGITTAL, chart, drawn_at_least, finished, over_field, seen
from raytrace.analysis.result import OverField, shown
from raytrace.analysis.setting import (
    NothingToShow,
    Numbers,
    Points,
    field_range,
    in_object_space,
    refuse_axis,
    setting,
    unvignetted,
)
from raytrace.analysis.spot_diagram import airy_radius
from raytrace.maths.numerics import Number, divide, dot_2, safe_divide, safe_sqrt, value
from raytrace.maths.result import Column, masked, rounding
from raytrace.plotting.style import FAINT, Figure, new_figure, styled
from raytrace.system.lens import Lens
from raytrace.tracing.launch import is_at_infinity
from raytrace.tracing.spot import chief_points, image_rays, keeps_coordinates, unclipped
from raytrace.tracing.trace import is_bent
from raytrace.words import option

NEAR_AXIS = 1e-4  # of the field: its chief ray gives the scale of the image; it leaves 1e-8 of the distortion
SAMPLES = 11  # fields of a curve, from the axis to the largest
NEAR_CHIEF = 1e-3  # of the pupil: close rays leave 1e-6 of the spherical aberration


@value
class Distortion(OverField):
    """Heights (F, W) in mm of chief rays on the sensor, and their relative error against the ideal image.

    height: from the vertex of the sensor, along the meridian of the field, positive towards +y (+x where it is the x
        axis), as the ray's own y; where the axis bends, along the image of the meridian. `image_height` of `hold` is
        its size for the largest field.
    ideal: heights f tan θ, of an object at a finite distance m h₀, from the image of the axis: not the vertex of the
        sensor where a lens is tilted.
    f_tan: relative, h/ideal - 1 with h from the image of the axis in the same wavelength; 0 on the axis. The table has
        it in per cent, as f_theta.
    f_theta: relative, h/(f θ) - 1; None for an object at a finite distance.
    fields: (2, F); valid: (F, W) bool.
    """

    lens: Lens
    fields: Tensor
    height: Tensor
    ideal: Tensor
    f_tan: Tensor
    f_theta: Tensor | None
    valid: Tensor

    COMMAND = "distortion"

    def columns(self) -> dict[str, Tensor]:
        relative = {"f_tan_percent": self.f_tan, "f_theta_percent": self.f_theta}
        percent = {name: 100 * curve for name, curve in relative.items() if curve is not None}
        shown = {name: masked(curve, self.valid) for name, curve in {"height": self.height, **percent}.items()}
        return {**self.heads(wavelength=self.wavelengths), **shown}

    def roundings(self) -> dict[str, Tensor]:
        percent = rounding(self.f_tan.new_tensor(100.0))  # of quotients of 100 %, less 100 %
        return {"height": rounding(self.ideal), "f_tan_percent": percent, "f_theta_percent": percent}

    def at(self, fields: Tensor) -> "Distortion":
        return distortion_of(self.lens, fields)

    @styled
    def draw(self) -> Figure:
        """Distortion in percent over the field: against f tan θ, and against f θ where the object is at infinity."""
        curves = self.drawn()
        ideals = {"Height": curves.f_tan}
        if curves.f_theta is not None:
            ideals = {"F-tan θ": curves.f_tan, "F-θ": curves.f_theta}
        figure = new_figure(3.1 * len(ideals) + 0.9, 4.2)
        panels = figure.subplots(1, len(ideals), squeeze=False)[0]
        for panel, (name, values) in zip(panels, ideals.items(), strict=True):
            over_field(panel, curves, seen(100 * values, curves.valid))
            panel.set_xlabel(f"{name} distortion (%)")
            drawn_at_least([panel], 1e-6, "x")
            panel.locator_params(axis="x", nbins=4)  # long numbers of a small distortion do not touch
        return finished(panels[-1], curves, "distortion", len(curves.wavelengths))


@value
class FieldCurvature(OverField):
    """Where close rays about the chief ray meet: (F, W) mm from the sensor along its z, positive behind it.

    tangential: of rays in the plane of the field; sagittal: across it; fields: (2, F); valid: (F, W) bool.
    """

    lens: Lens
    fields: Tensor
    tangential: Tensor
    sagittal: Tensor
    valid: Tensor

    COMMAND = "field-curvature"
    COLUMNS = Column("tangential", "mm"), Column("sagittal", "mm")

    def columns(self) -> dict[str, Tensor]:
        tangential, sagittal = masked(self.tangential, self.valid), masked(self.sagittal, self.valid)
        return {**self.heads(wavelength=self.wavelengths), "tangential": tangential, "sagittal": sagittal}

    def at(self, fields: Tensor) -> "FieldCurvature":
        return field_curvature_of(self.lens, fields)

    @styled
    def draw(self) -> Figure:
        """Foci of close rays over the field: tangential solid, sagittal dashed."""
        curves = self.drawn()
        panel = chart(4.6, 4.4, "focus from the sensor (mm)", "")
        over_field(panel, curves, seen(curves.tangential, curves.valid), suffix=" T", dashes=("solid",))
        over_field(panel, curves, seen(curves.sagittal, curves.valid), suffix=" S", dashes=(SAGITTAL,))
        drawn_at_least([panel], 1e-6, "x")
        return finished(panel, curves, "field curvature", 2 if len(curves.wavelengths) < 3 else 3)


@value
class LateralColour(OverField):
    """Height (F, W) in mm of each wavelength's chief ray on the sensor, less the primary wavelength's.

    Heights along the meridian of the field, positive towards +y (+x where it is the x axis).
    fields: (2, F); valid: (F, W) bool.
    """

    lens: Lens
    fields: Tensor
    shift: Tensor
    valid: Tensor

    COMMAND = "lateral-colour"

    def columns(self) -> dict[str, Tensor]:
        return {**self.heads(wavelength=self.wavelengths), "shift": masked(self.shift, self.valid)}

    def at(self, fields: Tensor) -> "LateralColour":
        return lateral_colour_of(self.lens, fields)

    @styled
    def draw(self) -> Figure:
        """Chief-ray heights less that of the primary wavelength over the field; its Airy radius is grey."""
        curves = self.drawn()
        panel = chart(4.6, 4.4, "lateral colour (µm)", "")
        if math.isfinite(airy := 1e3 * float(airy_radius(curves.lens))):
            panel.axvspan(-airy, airy, color=FAINT, alpha=0.35, linewidth=0, label="Airy radius")
        over_field(panel, curves, seen(1e3 * curves.shift, curves.valid))
        if not panel.patches:
            drawn_at_least([panel], 1e-3, "x")
        return finished(panel, curves, "lateral colour", 4)


def distortion(lens: Lens, *, fields: Points = None, wavelengths: Numbers = None, samples: int = SAMPLES) -> Distortion:
    """Distortion of the chief ray; fields: y or (x, y), by default `samples` from the axis to the largest.

    Relative, in per cent in the table. Heights count from the vertex of the sensor; the ideal image, and with it the
    distortion, from the image of the axis, so that a shift of the whole image is none. The scale of the ideal image is
    that of each wavelength's own chief ray close to the axis, on the sensor at its position: defocus is no
    distortion. wavelengths: µm. Raises NothingToShow for the axis alone.
    """
    lens, fields = setting(lens, fields, wavelengths, samples=samples)
    refuse_axis(fields)
    return shown(distortion_of(lens, fields))


def distortion_of(lens: Lens, fields: Tensor) -> Distortion:
    """The distortion of fields (2, F), which need not be in reach."""
    bare = unvignetted(lens)
    described, angles, extent, exist = in_object_space(bare, fields)
    close = _close_fields(lens, fields)
    _, close_angles, close_extent, _ = in_object_space(bare, close)
    length = dot_2(fields, _meridian(fields)).sign() * safe_sqrt(dot_2(extent, extent))
    bent = is_bent(lens)
    along = close if bent else fields
    height, valid = _height(described, angles, along)
    image = _height(described, angles, along, from_axis=True)[0] if bent else height
    reach = safe_sqrt(dot_2(close_extent, close_extent))
    scale = _height(described, close_angles, close, from_axis=True)[0] / reach[:, None]
    ideal = scale * length[:, None]
    f_theta = relative_error(image, scale * torch.atan(length)[:, None]) if is_at_infinity(lens) else None
    return Distortion(lens, fields, height, ideal, relative_error(image, ideal), f_theta, valid & exist[:, None])


def field_curvature(
    lens: Lens, *, fields: Points = None, wavelengths: Numbers = None, samples: int = 11
) -> FieldCurvature:
    """Tangential and sagittal foci of close rays, s = -(∂x/∂p)/(∂m/∂p) with m = (L, M)/N, as Coddington's equations.

    fields: y or (x, y), by default `samples` from the axis to the lens's largest; wavelengths: µm. Tangential is the
    plane through the axis and the field point, sagittal the one across it. Close rays that leave the lens parallel have
    no focus: nan, and invalid where neither section has one. Where the axis bends, s counts along the normal of the
    sensor to where the two rays of a section come closest.
    """
    asked = fields is not None
    lens, fields = setting(lens, fields, wavelengths, samples=samples)
    if not asked:
        refuse_axis(fields)
    return shown(field_curvature_of(lens, fields))


def field_curvature_of(lens: Lens, fields: Tensor) -> FieldCurvature:
    """The field curvature of fields (2, F), which need not be in reach."""
    bare = unvignetted(lens)
    along = torch.where((fields == 0).all(0), fields.new_tensor([[0.0], [1.0]]), _meridian(fields))
    alike = bool((along == along[:, :1]).all())
    groups = [(fields, along[:, :1])] if alike else zip(fields.split(1, 1), along.split(1, 1), strict=True)
    each = [_close_foci(bare, group, meridian) for group, meridian in groups]
    tangential, sagittal, valid = (torch.cat(parts) for parts in zip(*each, strict=True))
    return FieldCurvature(lens, fields, tangential, sagittal, valid)


def _close_foci(lens: Lens, fields: Tensor, along: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Tangential and sagittal foci (F, W) of fields (2, F) in one meridian (2, 1), and whether they exist."""
    across = torch.stack([along[1], -along[0]])
    pupil = torch.cat([along, -along, across, -across], 1) * NEAR_CHIEF
    rays = image_rays(lens, pupil, fields=fields)
    slope = safe_divide(rays.direction[:2], rays.direction[2].expand_as(rays.direction[:2]))
    bent = is_bent(lens)
    kept = unclipped(lens, pupil, fields, lens.wavelengths) if bent else keeps_coordinates(rays.direction)
    foci, exist = [], []
    for section, k in ((along, 0), (across, 2)):
        apart, opening = (part[..., k] - part[..., k + 1] for part in (rays.position[:2], slope))
        if bent:  # on the sensor the section of the pupil may be turned, or slanted
            foci.append(-safe_divide(dot_2(apart, opening), dot_2(opening, opening)))
            opening = torch.hypot(*opening)
        else:
            apart, opening = (dot_2(part, section[:, :, None]) for part in (apart, opening))
            foci.append(focus_of_close_rays(apart, opening))
        exist.append(opening.abs() > 8 * torch.finfo(opening.dtype).eps)
    tangential, sagittal = (torch.where(exists, focus, torch.nan) for exists, focus in zip(exist, foci, strict=True))
    return tangential, sagittal, (rays.valid | kept).all(-1) & (exist[0] | exist[1])


def lateral_colour(
    lens: Lens, *, fields: Points = None, wavelengths: Numbers = None, samples: int = 11
) -> LateralColour:
    """Lateral colour of the chief rays; fields: y or (x, y), by default `samples` from the axis to the largest.

    wavelengths: µm, the first one primary. Raises NothingToShow for a single wavelength and for the axis alone.
    """
    lens, fields = setting(lens, fields, wavelengths, samples=samples)
    if len(lens.wavelengths) < 2:
        raise NothingToShow(
            "nothing to show: lateral colour is a difference of wavelengths, and there is one, "
            f"{float(lens.wavelengths[0]):g} µm; give several by {option('wavelengths')}"
        )
    refuse_axis(fields)
    return shown(lateral_colour_of(lens, fields))


def lateral_colour_of(lens: Lens, fields: Tensor) -> LateralColour:
    """The lateral colour of fields (2, F), which need not be in reach."""
    height, valid = _height(unvignetted(lens), fields, fields)
    primary = slice(lens.primary_wavelength - 1, lens.primary_wavelength)
    valid = valid & valid[:, primary]
    return LateralColour(lens, fields, torch.where(valid, height - height[:, primary], 0.0), valid)


def _close_fields(lens: Lens, fields: Tensor) -> Tensor:
    """Fields (2, 1), or (2, F) where directions differ, so close to the axis that they give the scale of the image."""
    largest = field_range(lens, 2)[:, 1:]
    if not is_bent(lens):
        return largest * NEAR_AXIS
    along = torch.where((fields == 0).all(0), _meridian(largest), _meridian(fields))
    return along * torch.hypot(*largest) * NEAR_AXIS


def _height(lens: Lens, fields: Tensor, along: Tensor, *, from_axis: bool = False) -> tuple[Tensor, Tensor]:
    """Heights (F, W) of chief rays in the meridians of `along` (2, F), and whether they arrive or are only vignetted.

    They count from the vertex of the sensor. Where the axis bends: along the image of the meridian close to it, turned
    to the side of the field; from_axis: from the image of the axis in each wavelength.
    """
    points, valid = chief_points(lens, fields, lens.wavelengths)
    if is_bent(lens):
        meridian = _meridian(along)
        close = meridian * torch.hypot(*fields).amax() * NEAR_AXIS
        axis, _ = chief_points(lens, torch.zeros_like(fields[:, :1]), lens.wavelengths)
        way = chief_points(lens, close, lens.wavelengths)[0] - axis
        side = torch.where(dot_2(way, meridian[:, :, None]).detach() < 0, -1.0, 1.0)
        length = side * safe_sqrt(dot_2(way, way))
        return safe_divide(dot_2(points - axis if from_axis else points, way), length), valid
    return dot_2(points, _meridian(along)[:, :, None]), valid


def _meridian(fields: Tensor) -> Tensor:
    """Unit vectors (2, F) along fields (2, F), turned to +y, or to +x on the x axis; 0 for the axis."""
    x, y = fields
    side = torch.where((y < 0) | (y == 0) & (x < 0), -1.0, 1.0)
    length = safe_sqrt(dot_2(fields, fields))
    return torch.stack([safe_divide(side * x, length), safe_divide(side * y, length)])


def relative_error(height: Number, ideal: Number) -> Number:
    """height/ideal - 1 of tensors or dual numbers: distortion."""
    return divide(height - ideal, ideal)


def focus_of_close_rays(apart: Number, opening: Number) -> Number:
    """mm from the sensor to where two close rays meet, -Δx/Δm, m = (L, M)/N, along one section; of any number type."""
    return -divide(apart, opening)
