"""Launch: from field points and pupil points to rays in front of surface 1.

Rays start on the plane of the paraxial entrance pupil (at the primary wavelength), wherever it lies; an object 10¹² mm
away costs no digits. With ray aiming they are steered until they fill the stop, whose radius is that of the paraxial or
of the real marginal ray; where the axis bends they set out for what the stop looks like along the base ray.


Vignetting factors: the part of the entrance pupil that a field fills, an ellipse, and how it changes over the field.

The factors of a field make an affine map of the pupil, p' = V + M p. Between the fields of a lens, maps are
interpolated:

- all fields on one half-line from the axis (0, 14, 20 degrees along y): linearly in the distance from the axis, where
  the pupil is whole if no field is listed there, and the ellipse turns with the field, as in a lens of revolution;
- all on one line through the axis, on both sides of it: linearly along that line, at the foot of the perpendicular;
- elsewhere: by weights 1/distance² of all fields (Shepard, 1968).

Each is exact at the fields of the lens, continuous, and beyond the last field stays what it is there.


Filling: how far the rays of each field miss the points of the stop that they stand for.

Without ray aiming, rays go through the paraxial entrance pupil. Its aberrations move them on the stop: the chief ray
leaves its centre, and marginal rays fall short of its rim or beyond it.

"""

import dataclasses
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.utils import _pytree as pytree

from raytrace.maths.dual import select
from raytrace.maths.numerics import broadcast_shape, dot, dot_2, safe_divide, safe_sqrt, unit
from raytrace.maths.pupil import gauss_rings
from raytrace.maths.value import detached, value
from raytrace.system.lens import (
    FIELD_UNITS,
    RAY_AIMING,
    Lens,
    field_points,
    index_behind,
    name_of_field,
    wavelengths_of,
)
from raytrace.system.rays import Rays, start
from raytrace.system.surface import sag
from raytrace.tracing.aiming import aim_at_image, aim_at_stop, aiming_of, at_stop, is_bent
from raytrace.tracing.base_ray import Entrance, entrance_of
from raytrace.tracing.paraxial import FirstOrder, field_scale, first_order
from raytrace.words import calling_level, named_value


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
    points = _points(pupil)
    wavelengths = wavelengths_of(lens, wavelengths)
    fields = field_points(fields, like=lens)
    found = launch(lens, points, fields=fields, wavelengths=wavelengths, ray_aiming=ray_aiming)
    return dataclasses.replace(found, wavelength=wavelengths[:, None])


def _points(pupil: Tensor | tuple[Tensor, Tensor]) -> Tensor:
    """Points (2, P) of a rule (points, weights), or as they are. Raises TypeError, ValueError for others."""
    points = pupil[0] if isinstance(pupil, (tuple, list)) and pupil else pupil
    expected = "expected points (2, P) of the unit disc, or a rule (points, weights) as rt.gauss_rings(6)"
    if not isinstance(points, Tensor):
        raise TypeError(f"rays: `pupil` is {named_value(pupil)}; {expected}")
    if points.dim() != 2 or len(points) != 2:
        raise ValueError(f"rays: `pupil` has the shape {tuple(points.shape)}; {expected}")
    return points


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
    their vignetting factors (other fields get those that `raytrace.tracing.launch` interpolates);
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
    return start(aim, chord, index * path_from_point(aim, point, dot(chord, unit(chord)), dot(point, unit(point))))


def path_from_point(aim, point, chord, distance):
    """Path in mm (n = 1) at aim points A less the distance |O| of the point; chord: |A - O|. Any number type."""
    return (dot(aim, aim) - 2 * dot(aim, point)) / (chord + distance)


def path_towards_lens(path, distance, *, backward, virtual, nearer):
    """Path of a ray that travels towards +z, started at the nearer of object point and aim point. Any number type.

    path: as of `path_from_point`; distance: |O|; backward: whether A lies before O; virtual: O behind surface 1;
    nearer: O nearer to surface 1 than A. Paths count from the object, or to it if it is virtual.
    """
    from_aim = select(backward, select(virtual, -path, -path - 2 * distance), path)
    return select(nearer, select(virtual, distance, -distance), from_aim)


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
    kind, at_infinity = lens.fields.kind, is_at_infinity(lens)
    if kind == "object_height":
        if at_infinity:
            raise ValueError("fields are object heights but the object is at infinity: give angles, or a distance")
        return field
    scale = field_scale(
        kind,
        at_infinity=at_infinity,
        distance=lens.surfaces[0].thickness,
        entrance_pupil=paraxial.entrance_pupil_position,
        power=paraxial.power / index_behind(lens, 0, lens.primary),
        magnification=paraxial.magnification,
    )
    if kind != "angle":
        return _scaled(field, scale)
    slope = torch.tan(torch.deg2rad(field))
    return slope if at_infinity else _scaled(slope, scale)


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
    of what is before it): then light runs from A to O on the same line.
    """
    rays = rays_from_point(point, aim, index=index)
    backward, nearer = aim[2] < point[2], point[2].abs() < aim[2].abs()
    far = index * dot(point, unit(point))
    path = path_towards_lens(rays.opl, far, backward=backward, virtual=point[2] > 0, nearer=nearer)
    return Rays(
        position=torch.where(rays.valid & nearer, point, rays.position),
        direction=torch.where(rays.valid & backward, -rays.direction, rays.direction),
        valid=rays.valid,
        opl=torch.where(rays.valid, path, 0.0),
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


_OFF_LINE = 1e-9  # of the largest field


def vignette(lens: Lens, field: Tensor, pupil: Tensor) -> Tensor:
    """Pupil points shrunk and shifted by the vignetting factors of a field: p' = V + (1 - C) p, in axes turned by VAN.

    field: (2, ...) in the lens's own kind of field, pupil: (2, ...), result (2, ...) broadcast.
    """
    if lens.fields.vignetting is None:
        return torch.stack([p.expand(broadcast_shape(field.shape[1:], p.shape)) for p in pupil])
    x, y, xx, xy, yy = _map_of(lens, field)
    return torch.stack([x + (xx * pupil[0] + xy * pupil[1]), y + (xy * pupil[0] + yy * pupil[1])])


def _map_of(lens: Lens, field: Tensor) -> Tensor:
    """V_x, V_y, M_xx, M_xy, M_yy (5, ...) of fields (2, ...)."""
    listed = torch.stack([lens.fields.x, lens.fields.y]).reshape(2, -1, *(1,) * (field.dim() - 1))
    maps = _maps(lens.fields.vignetting).reshape(5, *listed.shape[1:])
    same = (listed == field[:, None]).all(0)
    first = same & (same.to(torch.int64).cumsum(0) == 1)
    own = torch.where(first, maps, 0.0).sum(1)
    return torch.where(same.any(0), own, _between(listed, maps, field[:, None]))


def _maps(factors: Tensor) -> Tensor:
    """The maps (5, F) of vignetting factors (5, F): VDX, VDY, VCX, VCY, VAN."""
    vdx, vdy, vcx, vcy, angle = factors
    return _rotated(torch.stack([vdx, vdy, 1 - vcx, torch.zeros_like(vcx), 1 - vcy]), *_cos_sin(angle))


def _cos_sin(degrees: Tensor) -> tuple[Tensor, Tensor]:
    return torch.cos(torch.deg2rad(degrees)), torch.sin(torch.deg2rad(degrees))


def _rotated(maps: Tensor, c: Tensor, s: Tensor) -> Tensor:
    """R V and R M Rᵀ for the rotation R by the angle of cosine c and sine s."""
    x, y, xx, xy, yy = maps
    return torch.stack(
        [
            c * x - s * y,
            s * x + c * y,
            c * c * xx - 2 * c * s * xy + s * s * yy,
            c * s * (xx - yy) + (c * c - s * s) * xy,
            s * s * xx + 2 * c * s * xy + c * c * yy,
        ]
    )


def _between(listed: Tensor, maps: Tensor, field: Tensor) -> Tensor:
    """Maps (5, ...) by one of the three rules; listed: (2, F, ...), maps: (5, F, ...), field: (2, 1, ...)."""
    radius = safe_sqrt(dot_2(listed, listed))
    largest, place = radius.max(0, keepdim=True)
    x, y = (safe_divide(torch.gather(part, 0, place), largest) for part in listed)
    line = torch.stack([x, torch.where(largest > 0, y, 1.0)])
    along, across = dot_2(line, listed), _cross(line, listed)
    on_line = (across.abs() <= _OFF_LINE * largest).all(0)
    one_sided = (along >= -_OFF_LINE * largest).all(0)
    by_radius = _by_radius(radius, maps, line, field)
    by_line = _linear(along, maps, dot_2(line, field))
    return torch.where(on_line, torch.where(one_sided, by_radius, by_line), _by_distance(listed, maps, field))


def _by_radius(radius: Tensor, maps: Tensor, line: Tensor, field: Tensor) -> Tensor:
    """Linear in the distance from the axis, turned with the field; an axis that is not listed has the whole pupil."""
    axis = torch.where((radius == 0).any(0, keepdim=True), -1.0, 0.0).to(radius.dtype)
    whole = maps.new_tensor([0.0, 0.0, 1.0, 0.0, 1.0]).reshape(5, *(1,) * (maps.dim() - 1))
    asked = safe_sqrt(dot_2(field, field))
    found = _linear(torch.cat([axis, radius]), torch.cat([whole.expand(5, *axis.shape), maps], 1), asked)
    cosine = torch.where(asked > 0, safe_divide(dot_2(line, field), asked), 1.0)
    return _rotated(found, cosine[0], safe_divide(_cross(line, field), asked)[0])


def _by_distance(listed: Tensor, maps: Tensor, field: Tensor) -> Tensor:
    """Weights 1/distance², taken against the nearest so that none overflows."""
    distance = dot_2(listed - field, listed - field)
    weight = safe_divide(distance.amin(0).expand_as(distance), distance)
    return safe_divide((weight * maps).sum(1), weight.sum(0))


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[1] - a[1] * b[0]


def _linear(knots: Tensor, maps: Tensor, at: Tensor) -> Tensor:
    """Maps (5, ...) linear between knots (F, ...) in any order, constant outside; at: (1, ...)."""
    at = torch.minimum(torch.maximum(at, knots.amin(0)), knots.amax(0))
    low, below = torch.where(knots <= at, knots, -torch.inf).max(0, keepdim=True)
    high, above = torch.where(knots >= at, knots, torch.inf).min(0, keepdim=True)
    share = safe_divide(at - low, high - low)
    shape = (5, *below.shape)
    first, last = (
        torch.gather(maps.expand(5, maps.shape[1], *below.shape[1:]), 1, index.expand(shape))
        for index in (below, above)
    )
    return ((1 - share) * first + share * last)[:, 0]


#: What the beam may miss the stop by without a warning, of the stop's semi-diameter.
TOLERANCE = 0.02

MOST_FIELDS = 64  # that are measured of one call: a map of a field asks for thousands


class UnfilledStop(UserWarning):
    """The beam of a field misses the stop by more than TOLERANCE; the message has figures and a remedy."""

    of_result = True  # said of a result: an error that ends the command stands alone


@value
class Filling:
    """How far rays miss the stop, fractions of its semi-diameter; inf for a ray that does not reach it.

    chief: (F,) chief ray from the centre. marginal: (F,) the worst of four marginal rays, from its point of the rim; of
    a field with vignetting factors from the point that these leave. lost: (F,) whether no ray reaches the stop; radius:
    () mm, semi-diameter of the stop.
    """

    chief: Tensor
    marginal: Tensor
    lost: Tensor
    radius: Tensor


@torch.no_grad()
def filling(lens: Lens, fields: Tensor) -> Filling:
    """How far the rays of fields (2, F) miss the stop as the lens launches them, at the primary wavelength.

    Five rays a field are traced to the stop. The stop is as wide as the real marginal ray of the axial beam makes it.
    """
    lens, fields = detached(lens), fields.detach()
    wavelength = lens.primary
    five = fields.new_tensor([[0.0, 0.0, 0.0, -1.0, 1.0], [0.0, -1.0, 1.0, 0.0, 0.0]])
    pupil = vignette(lens, fields[:, :, None], five)
    target, radius = points_of_stop(with_ray_aiming(lens, "real"), pupil)
    position, arrives = at_stop(lens, rays_of_field(lens, fields[:, :, None], pupil, wavelength=wavelength), wavelength)
    missed = torch.linalg.vector_norm(position - target, dim=0) / radius
    missed = torch.where(arrives & torch.isfinite(missed), missed, torch.inf)
    return Filling(missed[:, 0], missed[:, 1:].amax(1), ~arrives.any(1), radius)


def warn_of_filling(lens: Lens, fields: Tensor, *, ray_aiming: str | None = None) -> None:
    """Warn UnfilledStop of the field of (2, F) that misses the stop most, if it does by more than TOLERANCE.

    Of more than MOST_FIELDS so many are measured, evenly spread over them, and the largest one.
    A field that loses all its rays in front of the stop is left to LostRays. Nothing is traced where rays are aimed,
    where chief rays are parallel in object space, and in optimisation: where numbers of the lens or fields require a
    gradient or are inside a transform of torch.func.
    """
    lens = with_ray_aiming(lens, ray_aiming)
    if _is_being_optimised((lens, fields)) or lens.fields.telecentric or aiming_of(lens) != "off":
        return
    if fields.shape[1] > MOST_FIELDS:
        spread = torch.linspace(0, fields.shape[1] - 1, MOST_FIELDS, dtype=torch.float64).long()
        fields = fields[:, [*spread.tolist(), int(fields.norm(dim=0).argmax())]]
    found = filling(lens, fields)
    worst = torch.where(found.lost, 0.0, torch.maximum(found.chief, found.marginal))
    if not bool((worst > TOLERANCE).any() & (found.radius > 1e-9)):  # a point has no rim
        return
    at = int(worst.argmax())
    named = f"{name_of_field(fields[:, at])} {FIELD_UNITS[lens.fields.kind]}"
    many = f" ({int((worst > TOLERANCE).sum())} of {len(worst)} fields by more than {TOLERANCE:.0%})"
    warnings.warn(
        f"field {named}: rays miss the stop, whose semi-diameter is {float(found.radius):.4g} mm: the chief ray "
        f"{_words(found.chief[at], 'centre')}, marginal rays {_words(found.marginal[at], 'rim')}"
        f"{many if len(worst) > 1 else ''}; `ray_aiming=real` aims them, in Python lens.at(ray_aiming='real')",
        UnfilledStop,
        stacklevel=calling_level(),
    )


def _words(missed: Tensor, place: str) -> str:
    """How far from its place of the stop a ray passes, of the semi-diameter."""
    return f"by {100 * float(missed):.3g} % of it from the {place}" if bool(missed.isfinite()) else "altogether"


def _is_being_optimised(numbers: tuple[Lens, Tensor]) -> bool:
    leaves = [leaf for leaf in pytree.tree_leaves(numbers) if isinstance(leaf, Tensor)]
    return any(is_functorch_wrapped_tensor(leaf) or leaf.requires_grad for leaf in leaves)
