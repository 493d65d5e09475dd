"""Launch: from field points and pupil points to rays in front of surface 1.

Rays start on the plane of the paraxial entrance pupil (at the primary wavelength), wherever it lies; an object 10¹² mm
away costs no digits. With ray aiming they are steered until they fill the stop, whose radius is that of the paraxial or
of the real marginal ray; where the axis bends they set out for what the stop looks like along the base ray.
"""

import dataclasses
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths.numerics import broadcast_shape, dot, dot_2, safe_divide, safe_sqrt, unit
from raytrace.maths.pupil import gauss_rings
from raytrace.system.lens import RAY_AIMING, Lens, field_points, index_behind, wavelengths_of
from raytrace.system.rays import Rays, start
from raytrace.system.surface import sag
from raytrace.tracing.aiming import aim_at_image, aim_at_stop, at_stop
from raytrace.tracing.axis import aiming_of, is_bent
from raytrace.tracing.base_ray import Entrance, entrance_of
from raytrace.tracing.paraxial import FirstOrder, first_order
from raytrace.tracing.vignetting import vignette
from raytrace.words import calling_level


class MarginalRayLost(UserWarning):
    """The real marginal ray does not reach the stop, whose size it was to tell."""


def rays(
    lens: Lens,
    *,
    fields: Tensor | Sequence | None = None,
    pupil: Tensor | tuple[Tensor, Tensor] | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    ray_aiming: str | None = None,
) -> Rays:
    """Rays (3, F, W, P) of every field, wavelength and pupil point in front of surface 1, each with its wavelength.

    fields: y, or (x, y), or (2, F) in the lens's own kind of field; wavelengths: µm; both by default the lens's own.
    pupil: points (2, P) of the unit disc, or a rule (points, weights), as `gauss_rings(6)` (default); ray_aiming: a key
    of RAY_AIMING, by default the lens's own. Raises ValueError for what is none of these.
    """
    pupil = (
        gauss_rings(dtype=lens.surfaces[-2].thickness.dtype, device=lens.wavelengths.device) if pupil is None else pupil
    )
    points = pupil if isinstance(pupil, Tensor) else pupil[0]
    wavelengths = wavelengths_of(lens, wavelengths)
    fields = field_points(fields, like=lens)
    found = launch(lens, points, fields=fields, wavelengths=wavelengths, ray_aiming=ray_aiming)
    return dataclasses.replace(found, wavelength=wavelengths[:, None])


def launch(
    lens: Lens,
    pupil: Tensor,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    ray_aiming: str | None = None,
) -> Rays:
    """Rays of every field, wavelength and pupil point: batch shape (F, W, P).

    pupil: (2, P) on the unit disc; fields: (2, F) in the lens's own kind of field, by default those of the lens with
    their vignetting factors (other fields get those that `raytrace.tracing.vignetting` interpolates);
    wavelengths: (W,) µm, by default those of the lens; ray_aiming: a key of RAY_AIMING, by default the lens's.
    """
    fields = field_points(fields, like=lens)
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    vignetted = vignette(lens, fields[:, :, None, None], pupil)
    field, wavelength = fields[:, :, None, None], wavelengths[:, None]
    rays = rays_of_field(lens, field, vignetted, wavelength=wavelength, ray_aiming=ray_aiming)
    batch = broadcast_shape(rays.shape, rays.opl.shape)
    position, direction = rays.position.expand(3, *batch), rays.direction.expand(3, *batch)
    return Rays(position, direction, rays.valid.expand(batch), rays.opl.expand(batch))


def rays_of_field(
    lens: Lens, field: Tensor, pupil: Tensor, *, wavelength: Tensor, ray_aiming: str | None = None
) -> Rays:
    """Rays of field points through pupil points; everything broadcasts.

    field: (2, ...) degrees or mm, as `lens.fields.kind` says; pupil: (2, ...) fractions of the entrance pupil, or of
    the stop with ray aiming; wavelength: (...) µm. An aimed ray that finds no way to its stop point is lost.
    Position, direction and validity have axes of 1 where the wavelength makes no difference to them.
    """
    lens = with_ray_aiming(lens, ray_aiming)
    paraxial = first_order(lens)
    index = index_behind(lens, 0, wavelength).to(pupil.dtype)
    field, reached = object_field(lens, field, paraxial)

    entrance = _entrance(lens)

    def through(pupil: Tensor, fraction: float = 1.0) -> Rays:
        return _through_entrance_pupil(lens, _part_of_field(lens, field, fraction), pupil, paraxial, index, entrance)

    if _is_aimed(lens):
        radius = _aimed_radius(lens, paraxial, entrance)
        target = pupil if entrance is None else _turned(entrance.turn, pupil)
        pupil, found = aim_at_stop(lens, through, pupil, target, wavelength, radius)
        reached = reached & found
    rays = through(pupil)
    return dataclasses.replace(rays, valid=rays.valid & reached)


def rays_from_point(point: Tensor, aim: Tensor, *, index: Tensor) -> Rays:
    """Rays of an object point O through aim points A, started at A; their path counts from |O|.

        W0 = n (|A|² - 2 A·O) / (|A - O| + |O|)

    point, aim: (3, ...) mm in the frame of surface 1; index: (...) of the object space. Any object distance.
    """
    chord = aim - point
    length = dot(chord, unit(chord)) + dot(point, unit(point))
    return start(aim, chord, index * (dot(aim, aim) - 2 * dot(aim, point)) / length)


def rays_from_infinity(direction: Tensor, aim: Tensor, *, index: Tensor) -> Rays:
    """Rays of a plane wave through aim points A, started at A; W0 = n A·d is the wave's phase there.

    direction: (3, ...) of any length; aim: (3, ...) mm in the frame of surface 1; index: (...) of the object space.
    """
    return start(aim, direction, index * dot(aim, unit(direction)))


def is_at_infinity(lens: Lens) -> bool:
    """Whether the object, or every object of a batch, is at infinity. Raises ValueError for a batch that mixes."""
    infinite = torch.isinf(lens.surfaces[0].thickness.detach())
    if bool(infinite.all()):
        return True
    if bool(infinite.any()):
        raise ValueError("object distances mix infinity and finite ones in one batch: trace them in two")
    return False


def object_field(lens: Lens, field: Tensor, paraxial: FirstOrder) -> tuple[Tensor, Tensor]:
    """Field points (2, ...) as slopes (tan θx, tan θy) for an object at infinity, else as object heights in mm.

    And whether there are such (...): no chief ray may reach a real image height; then the axis comes.
    """
    if lens.fields.kind == "real_image_height":
        return _field_of_real_height(lens, field, paraxial_field(lens, field, paraxial), paraxial)
    found = paraxial_field(lens, field, paraxial)
    return found, torch.ones_like(found[0], dtype=torch.bool)


def paraxial_field(lens: Lens, field: Tensor, paraxial: FirstOrder) -> Tensor:
    """As `object_field`, real image heights as if they were paraxial ones."""
    distance, kind = lens.surfaces[0].thickness, lens.fields.kind
    at_infinity = is_at_infinity(lens)
    if kind == "angle":
        slope = torch.tan(torch.deg2rad(field))
        return slope if at_infinity else _scaled(slope, -(distance + paraxial.entrance_pupil_position))
    if kind == "object_height":
        if at_infinity:
            raise ValueError("fields are object heights but the object is at infinity: give angles, or a distance")
        return field
    index = index_behind(lens, 0, lens.primary)
    scale = paraxial.power / index if at_infinity else 1 / paraxial.magnification
    return _scaled(field, scale)


def _part_of_field(lens: Lens, field: Tensor, fraction: float) -> Tensor:
    """A fraction of a field point (2, ...): of its angle for an object at infinity, else of its height."""
    if fraction == 1.0 or not is_at_infinity(lens):
        return fraction * field
    slope = safe_sqrt(dot_2(field, field))
    return _scaled(field, safe_divide(torch.tan(fraction * torch.atan(slope)), slope))


def _is_aimed(lens: Lens) -> bool:
    return aiming_of(lens) != "off" and not lens.fields.telecentric


def _entrance(lens: Lens) -> Entrance | None:
    """Where aimed rays set out for in a lens whose axis bends; None: for the paraxial entrance pupil."""
    return entrance_of(lens) if _is_aimed(lens) and is_bent(lens) else None


def _turned(matrix: Tensor, points: Tensor) -> Tensor:
    """A matrix (2, 2, ...) times points (2, ...)."""
    (xx, xy), (yx, yy) = matrix
    return torch.stack([xx * points[0] + xy * points[1], yx * points[0] + yy * points[1]])


def with_ray_aiming(lens: Lens, ray_aiming: str | None) -> Lens:
    """The lens with another kind of ray aiming, a key of RAY_AIMING; its own where that is None."""
    if ray_aiming in (None, lens.ray_aiming):
        return lens
    if ray_aiming not in RAY_AIMING:
        raise ValueError(f"ray aiming {ray_aiming!r}: expected one of {', '.join(RAY_AIMING)}")
    return dataclasses.replace(lens, ray_aiming=ray_aiming)


def stop_radius(lens: Lens) -> Tensor:
    """Radius in mm of the stop: where the axial ray through the edge of the entrance pupil meets it.

    The paraxial ray where rays are aimed by it, or where the real one does not reach the stop; else the real one. At
    the primary wavelength. Where the axis bends it counts from the base ray.
    """
    return _stop_radius(lens, first_order(lens), _entrance(lens))[0]


def points_of_stop(lens: Lens, pupil: Tensor) -> tuple[Tensor, Tensor]:
    """The points (2, ...) mm of the stop that pupil points (2, ...) stand for where rays are aimed, as in this lens,
    and the radius of the stop, mm."""
    paraxial, entrance = first_order(lens), _entrance(lens)
    radius = _stop_radius(lens, paraxial, entrance)[0]
    target = pupil if entrance is None else _turned(entrance.turn, pupil)
    return _signed(radius, paraxial, entrance) * target, radius


def _stop_radius(lens: Lens, paraxial: FirstOrder, entrance: Entrance | None) -> tuple[Tensor, Tensor | None]:
    """And whether the real marginal ray tells it, None where that is not asked."""
    if lens.aperture.kind == "float_by_stop":
        return lens.aperture.value, None
    estimate = paraxial.stop_height.abs() if entrance is None else entrance.radius
    if lens.ray_aiming == "paraxial":
        return estimate, None
    height, arrives = _marginal_height(lens, paraxial, entrance)
    return torch.where(arrives, height.abs(), estimate), arrives


def _signed(radius: Tensor, paraxial: FirstOrder, entrance: Entrance | None) -> Tensor:
    """The radius of the stop with the sign of `FirstOrder.stop_height`.

    Where the axis bends an `Entrance` tells what an inverted image of the stop turns, and the sign is +.
    """
    return radius * torch.where(paraxial.stop_height.detach() < 0, -1.0, 1.0) if entrance is None else radius


def _aimed_radius(lens: Lens, paraxial: FirstOrder, entrance: Entrance | None) -> Tensor:
    """The radius of the stop with its sign, as `_signed`; warns MarginalRayLost."""
    radius, arrives = _stop_radius(lens, paraxial, entrance)
    if arrives is not None and not bool(arrives.all()):
        message = "the real marginal ray does not reach the stop; rays are aimed over the radius of the paraxial one"
        warnings.warn(message, MarginalRayLost, stacklevel=calling_level())
    return _signed(radius, paraxial, entrance)


def _marginal_height(lens: Lens, paraxial: FirstOrder, entrance: Entrance | None) -> tuple[Tensor, Tensor]:
    """Height in mm at the stop of the real axial ray through the edge of the entrance pupil, and whether it arrives."""
    wavelength = lens.primary
    edge = lens.wavelengths.new_tensor([0.0, 1.0]).to(paraxial.entrance_pupil_diameter.dtype)
    index = index_behind(lens, 0, wavelength).to(edge.dtype)
    rays = _through_entrance_pupil(lens, torch.zeros_like(edge), edge, paraxial, index, entrance)
    position, arrives = at_stop(lens, rays, wavelength)
    return (position[1] if entrance is None else safe_sqrt(dot_2(position, position))), arrives


def _through_entrance_pupil(
    lens: Lens, field: Tensor, pupil: Tensor, paraxial: FirstOrder, index: Tensor, entrance: Entrance | None
) -> Rays:
    """Rays from a slope or object height (2, ...) to the entrance pupil, the paraxial one if there is no other, at
    fractions (2, ...)."""
    distance = lens.surfaces[0].thickness
    at_infinity = is_at_infinity(lens)
    radius, depth = 0.5 * paraxial.entrance_pupil_diameter, paraxial.entrance_pupil_position
    if lens.fields.telecentric:
        # The pupil is at infinity: cones of equal rays about a chief ray parallel to the axis.
        radius, depth = _telecentric_radius(lens, paraxial, index), torch.zeros_like(distance)
        aim_x, aim_y = field[0] + radius * pupil[0], field[1] + radius * pupil[1]
    elif entrance is not None:
        aim_x, aim_y = (at + to for at, to in zip(entrance.centre, _turned(entrance.spread, pupil), strict=True))
        depth = entrance.position
    else:
        aim_x, aim_y = radius * pupil[0], radius * pupil[1]
    # Not the index: all wavelengths start alike, and only their paths differ.
    x, y, aim_x, aim_y, depth, distance = torch.broadcast_tensors(field[0], field[1], aim_x, aim_y, depth, distance)
    aim = torch.stack([aim_x, aim_y, depth])
    if at_infinity:
        return rays_from_infinity(torch.stack([x, y, torch.ones_like(x)]), aim, index=index)
    z = sag(lens.surfaces[0], x * x + y * y) - distance
    return _towards_the_lens(torch.stack([x, y, z]), aim, index)


def _towards_the_lens(point: Tensor, aim: Tensor, index: Tensor) -> Rays:
    """Rays of an object point O through pupil points A that travel towards +z, started at the nearer of O and A.

    A virtual object lies behind surface 1, and an entrance pupil may lie before the object (a stop behind the focus
    of what is before it): then light runs from A to O on the same line. Paths count from the object, O_z < 0, or, if
    it is virtual, to it.
    """
    rays = rays_from_point(point, aim, index=index)
    backward = aim[2] < point[2]
    virtual = point[2] > 0
    length = index * dot(point, unit(point))
    from_aim = torch.where(backward, torch.where(virtual, -rays.opl, -rays.opl - 2 * length), rays.opl)
    nearer = point[2].abs() < aim[2].abs()
    return Rays(
        position=torch.where(rays.valid & nearer, point, rays.position),
        direction=torch.where(rays.valid & backward, -rays.direction, rays.direction),
        valid=rays.valid,
        opl=torch.where(rays.valid, torch.where(nearer, torch.where(virtual, length, -length), from_aim), 0.0),
    )


def _telecentric_radius(lens: Lens, paraxial: FirstOrder, index: Tensor) -> Tensor:
    distance, kind, number = lens.surfaces[0].thickness, lens.aperture.kind, lens.aperture.value
    if kind == "object_na":
        return distance * torch.tan(torch.asin(number / index))
    if kind == "object_cone_angle":
        return distance * torch.tan(torch.deg2rad(number))
    raise ValueError(
        f"object space is telecentric, which needs an aperture given as object NA or cone angle, not {kind}"
    )


def _field_of_real_height(lens, height: Tensor, estimate: Tensor, paraxial: FirstOrder) -> tuple[Tensor, Tensor]:
    """The field (2, ...) whose real chief ray meets the image at `height` (2, ...) mm, and whether there is one."""
    wavelength = lens.primary
    index = index_behind(lens, 0, wavelength).to(height.dtype)

    entrance = _entrance(lens)

    def through(field: Tensor, pupil: Tensor) -> Rays:
        return _through_entrance_pupil(lens, field, pupil, paraxial, index, entrance)

    radius = _aimed_radius(lens, paraxial, entrance) if _is_aimed(lens) else None
    return aim_at_image(lens, through, height, estimate, radius)


def _scaled(field: Tensor, factor: Tensor) -> Tensor:
    """field (2, ...) times factor (...): the batch axes broadcast behind the component axis."""
    return torch.stack([component * factor for component in field])
