"""Launch: from field points and pupil points to rays in front of surface 1.

Rays start on the plane of the paraxial entrance pupil (at the primary wavelength), wherever it lies; an object 10¹² mm
away loses no precision. With ray aiming they fill the stop, whose radius is that of the paraxial or of the real
marginal ray; where the axis bends they start towards the image of the stop about the base ray.

Vignetting factors make an affine map of the pupil, p' = V + M p. Between the fields of a lens maps are interpolated,
exact at its fields, continuous, and constant beyond the last one; where the derivatives on both sides of a field
differ, their mean is the derivative:

- fields on one half-line from the axis (0, 14, 20 degrees along y): linearly in the distance from the axis, where the
  pupil is whole if no field is listed there; the change of the ellipse turns with the field, as in a lens of
  revolution;
- fields on both sides of the axis on one line: linearly along that line, at the foot of the perpendicular;
- others: by weights 1/distance² of all fields (Shepard, 1968).

Without ray aiming, pupil aberrations move rays on the stop: `filling` measures by how much.
"""

import dataclasses
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import (
    Number,
    broadcast_shape,
    detached,
    dot,
    dot_2,
    is_any,
    safe_divide,
    safe_sqrt,
    select,
    unit,
    value,
    varies,
)
from raytrace.maths.sampling import gauss_rings
from raytrace.system.lens import (
    FIELD_UNITS,
    RAY_AIMING,
    Lens,
    aligned,
    field_points,
    index_behind,
    name_of_field,
    one_lens,
    shared,
    wavelengths_of,
)
from raytrace.system.poses import point_out
from raytrace.system.rays import Rays, start
from raytrace.system.surface import sag
from raytrace.tracing.aiming import aim_at_image, aim_at_stop
from raytrace.tracing.base_ray import Entrance, entrance_of
from raytrace.tracing.paraxial import CONES, Beam, FirstOrder, axial_beam, cone_angle, field_scale
from raytrace.tracing.trace import aiming_of, at_stop, is_bent
from raytrace.words import RaytraceWarning, calling_level, named_value, option


class MarginalRayLost(RaytraceWarning):
    """The real marginal ray does not reach the stop, so that it cannot define its radius."""


def rays(
    lens: Lens,
    *,
    fields: Tensor | Sequence | None = None,
    pupil: Tensor | tuple[Tensor, Tensor] | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    ray_aiming: str | None = None,
) -> Rays:
    """Rays (3, F, W, P) of every field, wavelength and pupil point in front of surface 1, each with its wavelength.

    fields: y, or (x, y), or (2, F) in the lens's kind of field; wavelengths: µm; both by default those of the lens.
    pupil: points (2, P) of the unit disc, or a rule (points, weights), as `gauss_rings(6)` (default); ray_aiming: a key
    of RAY_AIMING, by default the lens's. Raises TypeError, ValueError for other arguments.
    """
    if pupil is None:
        pupil = gauss_rings(dtype=lens.surfaces[-2].thickness.dtype, device=lens.wavelengths.device)
    points = pupil[0] if isinstance(pupil, (tuple, list)) and pupil else pupil
    expected = "expected points (2, P) of the unit disc, or a rule (points, weights) as rt.maths.gauss_rings(6)"
    if not isinstance(points, Tensor):
        raise TypeError(f"rays: `pupil` is {named_value(pupil)}; {expected}")
    if points.dim() != 2 or len(points) != 2:
        raise ValueError(f"rays: `pupil` has the shape {tuple(points.shape)}; {expected}")
    lens, wavelengths = aligned(lens, 3), wavelengths_of(lens, wavelengths)
    launched = launch(lens, points, fields=fields, wavelengths=wavelengths, ray_aiming=ray_aiming)
    return dataclasses.replace(launched, wavelength=wavelengths[:, None])


def launch(
    lens: Lens,
    pupil: Tensor,
    *,
    fields: Tensor | Sequence | None = None,
    wavelengths: Tensor | None = None,
    ray_aiming: str | None = None,
) -> Rays:
    """Rays of every field, wavelength and pupil point: batch shape (F, W, P).

    pupil: (2, P) on the unit disc; fields: (2, F) in the lens's kind of field, wavelengths: (W,) µm, ray_aiming: a key
    of RAY_AIMING, by default those of the lens. Vignetting factors are interpolated for other fields.
    """
    fields = field_points(fields, like=lens)
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    vignetted = vignette(lens, fields[:, :, None, None], pupil)
    field, wavelength = fields[:, :, None, None], wavelengths[:, None]
    rays = rays_of_field(lens, field, vignetted, wavelength=wavelength, ray_aiming=ray_aiming)
    assert rays.opl is not None  # as `start` makes rays with paths
    batch = broadcast_shape(rays.shape, rays.opl.shape)
    position, direction = rays.position.expand(3, *batch), rays.direction.expand(3, *batch)
    return Rays(position, direction, rays.valid.expand(batch), rays.opl.expand(batch))


def rays_of_field(
    lens: Lens, field: Tensor, pupil: Tensor, *, wavelength: Tensor, ray_aiming: str | None = None
) -> Rays:
    """Rays of field points through pupil points; everything broadcasts.

    field: (2, ...) degrees or mm, as `lens.fields.kind` says; pupil: (2, ...) fractions of the entrance pupil, or of
    the stop with ray aiming; wavelength: (...) µm. A ray that cannot be aimed is invalid. Position, direction and
    validity have axes of 1 where they do not depend on the wavelength.
    """
    lens = with_ray_aiming(lens, ray_aiming)
    beam = axial_beam(lens)
    index = index_behind(lens, 0, wavelength).to(pupil.dtype)
    field, reached = object_field(lens, field, beam)

    entrance = _entrance(lens)

    def through(pupil: Tensor, fraction: float = 1.0) -> Rays:
        return _through_entrance_pupil(lens, _part_of_field(lens, field, fraction), pupil, beam, index, entrance)

    def turned(pupil: Tensor) -> Tensor:
        return pupil if entrance is None else _turned(entrance.turn, pupil)

    if _is_aimed(lens):
        radius = _aimed_radius(lens, beam, entrance)
        pupil, aimed = aim_at_stop(lens, through, pupil, turned, wavelength, radius)
        reached = reached & aimed
    rays = through(pupil)
    return dataclasses.replace(rays, valid=rays.valid & reached)


def rays_from_point(point: Tensor, aim: Tensor, *, index: Tensor) -> Rays:
    """Rays of an object point O through aim points A, started at A; their path counts from |O|.

        W0 = n (|A|² - 2 A·O) / (|A - O| + |O|)

    point, aim: (3, ...) mm in the frame of surface 1; index: (...) of the object space. Any object distance.
    """
    chord = aim - point
    return start(aim, chord, index * path_from_point(aim, point, dot(chord, unit(chord)), dot(point, unit(point))))


def path_from_point(aim: Number, point: Number, chord: Number, distance: Number) -> Number:
    """Path in mm (n = 1) at aim points A less the distance |O| of the point; chord: |A - O|. Any number type."""
    return (dot(aim, aim) - 2 * dot(aim, point)) / (chord + distance)


def path_towards_lens(path: Number, distance: Number, *, backward: Number, virtual: Number, nearer: Number) -> Number:
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
    rays = start(aim, direction)
    return dataclasses.replace(rays, opl=index * dot(rays.position, rays.direction))


def is_at_infinity(lens: Lens) -> bool:
    """Whether the object, or every object of a batch, is at infinity. Raises ValueError for a batch that mixes."""
    infinite = torch.isinf(lens.surfaces[0].thickness.detach())
    if not is_any(~infinite):
        return True
    if is_any(infinite):
        raise ValueError("object distances mix infinity and finite ones in one batch: trace them in two")
    return False


def object_field(lens: Lens, field: Tensor, beam: Beam) -> tuple[Tensor, Tensor]:
    """Field points (2, ...) as slopes (tan θx, tan θy) for an object at infinity, else as object heights in mm.

    And whether a chief ray reaches the real image height (...); where none does, the field is on the axis.
    """
    estimate = paraxial_field(lens, field, beam)
    if lens.fields.kind != "real_image_height":
        return estimate, torch.ones_like(estimate[0], dtype=torch.bool)
    index, entrance = index_behind(lens, 0, lens.primary).to(field.dtype), _entrance(lens)

    def through(field: Tensor, pupil: Tensor) -> Rays:
        return _through_entrance_pupil(lens, field, pupil, beam, index, entrance)

    radius = _aimed_radius(lens, beam, entrance) if _is_aimed(lens) else None
    return aim_at_image(lens, through, field, estimate, radius)


def paraxial_field(lens: Lens, field: Tensor, beam: Beam | FirstOrder) -> Tensor:
    """As `object_field`, with real image heights taken as paraxial ones."""
    kind, at_infinity = lens.fields.kind, is_at_infinity(lens)
    if kind == "object_height":
        if at_infinity:
            raise ValueError("fields are object heights but the object is at infinity: give angles, or a distance")
        return field
    extent = torch.tan(torch.deg2rad(field)) if kind == "angle" else field
    return extent if kind == "angle" and at_infinity else _scaled(extent, _paraxial_scale(lens, beam))


def field_of_object(lens: Lens, extent: Tensor, beam: Beam | FirstOrder) -> Tensor:
    """Field points (2, ...) of slopes, or object heights in mm, (2, ...): the inverse of `paraxial_field`."""
    kind, at_infinity = lens.fields.kind, is_at_infinity(lens)
    if kind != "object_height" and not (kind == "angle" and at_infinity):
        extent = _scaled(extent, 1 / _paraxial_scale(lens, beam))
    return torch.rad2deg(torch.atan(extent)) if kind == "angle" else extent


def object_point(lens: Lens, height: Tensor) -> Tensor:
    """The points (3, ...) mm of object heights (2, ...) mm along the object's axes, in the frame of surface 1."""
    source = lens.surfaces[0]
    point = [height[0], height[1], sag(source, dot_2(height, height))]
    x, y, z = point if source.before is None else point_out(source.before, point)
    return torch.stack(torch.broadcast_tensors(x, y, z - source.thickness))


def _paraxial_scale(lens: Lens, beam: Beam | FirstOrder) -> Tensor | float:
    """`field_scale` of the kind of field of a lens."""
    return field_scale(
        lens.fields.kind,
        at_infinity=is_at_infinity(lens),
        distance=lens.surfaces[0].thickness,
        entrance_pupil=beam.entrance_pupil_position,
        power=beam.power / index_behind(lens, 0, lens.primary),
        magnification=beam.magnification,
    )


def _part_of_field(lens: Lens, field: Tensor, fraction: float) -> Tensor:
    """A fraction of a field point (2, ...): of its angle for an object at infinity, else of its height."""
    if fraction == 1.0 or not is_at_infinity(lens):
        return fraction * field
    slope = safe_sqrt(dot_2(field, field))
    return _scaled(field, safe_divide(torch.tan(fraction * torch.atan(slope)), slope))


def _is_aimed(lens: Lens) -> bool:
    return aiming_of(lens) != "off" and not lens.fields.telecentric


def _entrance(lens: Lens) -> Entrance | None:
    """The entrance pupil of aimed rays in a lens whose axis bends; None: the paraxial one."""
    return entrance_of(lens) if _is_aimed(lens) and is_bent(lens) else None


def _turned(matrix: Tensor, points: Tensor) -> Tensor:
    """A matrix (2, 2, ...) times points (2, ...)."""
    (xx, xy), (yx, yy) = matrix
    return torch.stack([xx * points[0] + xy * points[1], yx * points[0] + yy * points[1]])


def with_ray_aiming(lens: Lens, ray_aiming: str | None) -> Lens:
    """The lens with another kind of ray aiming, a key of RAY_AIMING; None: unchanged."""
    if ray_aiming in (None, lens.ray_aiming):
        return lens
    if ray_aiming not in RAY_AIMING:
        raise ValueError(f"ray aiming {ray_aiming!r}: expected one of {', '.join(RAY_AIMING)}")
    return dataclasses.replace(lens, ray_aiming=ray_aiming)


@shared
def stop_radius(lens: Lens) -> Tensor:
    """Radius in mm of the stop: where the axial ray through the edge of the entrance pupil meets it.

    The paraxial ray with paraxial ray aiming, or where the real one does not reach the stop; else the real one. At the
    primary wavelength. Where the axis bends it is measured from the base ray.
    """
    return _stop_radius(lens, lens.ray_aiming, axial_beam(lens), _entrance(lens))[0]


def _stop_radius(lens: Lens, ray_aiming: str, beam: Beam, entrance: Entrance | None) -> tuple[Tensor, Tensor | None]:
    """The radius of the stop, and whether the real marginal ray reaches it; None if that ray is not traced."""
    if lens.aperture.kind == "float_by_stop":
        return lens.aperture.value, None
    estimate = beam.stop_height.abs() if entrance is None else entrance.radius
    if ray_aiming == "paraxial":
        return estimate, None
    edge = lens.wavelengths.new_tensor([0.0, 1.0]).to(beam.entrance_pupil_diameter.dtype)
    index = index_behind(lens, 0, lens.primary).to(edge.dtype)
    rays = _through_entrance_pupil(lens, torch.zeros_like(edge), edge, beam, index, entrance)
    position, arrives = at_stop(lens, rays, lens.primary)
    height = position[1].abs() if entrance is None else safe_sqrt(dot_2(position, position))
    return torch.where(arrives, height, estimate), arrives


def _signed(radius: Tensor, beam: Beam, entrance: Entrance | None) -> Tensor:
    """The radius with the sign of `FirstOrder.stop_height`; an `Entrance` inverts by its `turn`."""
    return radius * torch.where(beam.stop_height.detach() < 0, -1.0, 1.0) if entrance is None else radius


def _aimed_radius(lens: Lens, beam: Beam, entrance: Entrance | None) -> Tensor:
    """The radius of the stop with the sign of `_signed`; warns MarginalRayLost."""
    radius, arrives = _stop_radius(lens, lens.ray_aiming, beam, entrance)
    if arrives is not None and is_any(~arrives):
        message = "the real marginal ray does not reach the stop; rays are aimed over the radius of the paraxial one"
        warnings.warn(message, MarginalRayLost, stacklevel=calling_level())
    return _signed(radius, beam, entrance)


def _through_entrance_pupil(
    lens: Lens, field: Tensor, pupil: Tensor, beam: Beam, index: Tensor, entrance: Entrance | None
) -> Rays:
    """Rays from a slope or object height (2, ...) to fractions (2, ...) of the entrance pupil, by default paraxial."""
    point = None if is_at_infinity(lens) else object_point(lens, field)
    radius, depth = 0.5 * beam.entrance_pupil_diameter, beam.entrance_pupil_position
    if lens.fields.telecentric:
        # The pupil is at infinity: equal cones about chief rays parallel to the axis.
        if lens.aperture.kind not in CONES:
            raise ValueError(
                "object space is telecentric, which needs an aperture given as object NA or cone angle, not "
                f"{lens.aperture.kind}"
            )
        assert point is not None  # `lens.check` refuses objects at infinity
        radius, depth = -point[2] * torch.tan(cone_angle(lens, index)), torch.zeros_like(depth)
        aim_x, aim_y = point[0] + radius * pupil[0], point[1] + radius * pupil[1]
    elif entrance is not None:
        spread = _turned(entrance.spread, pupil)
        aim_x, aim_y = entrance.centre[0] + spread[0], entrance.centre[1] + spread[1]
        depth = entrance.position
    else:
        aim_x, aim_y = radius * pupil[0], radius * pupil[1]
    # Not the index: all wavelengths start alike, and only their paths differ.
    if point is None:
        distance = lens.surfaces[0].thickness
        aim_x, aim_y, depth, _ = torch.broadcast_tensors(aim_x, aim_y, depth, distance)
        aim = torch.stack([aim_x, aim_y, depth])
        return rays_from_infinity(torch.stack([*field, torch.ones_like(field[0])]), aim, index=index)
    *point, aim_x, aim_y, depth = torch.broadcast_tensors(*point, aim_x, aim_y, depth)
    point, aim = torch.stack(point), torch.stack([aim_x, aim_y, depth])
    # Rays travel towards +z and start at the nearer of object point O and pupil point A. A virtual object lies behind
    # surface 1, and an entrance pupil may lie before the object: then light runs from A to O on the same line.
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


def _scaled(field: Tensor, factor: Tensor | float) -> Tensor:
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


def factors_at(lens: Lens, fields: Tensor) -> Tensor | None:
    """Vignetting factors (5, F) of fields (2, F), as of `Fields`: those of the lens at its own fields, else of the map
    between them, whose matrix is turned to be diagonal by tan 2 VAN = 2 M_xy / (M_xx - M_yy); None without factors."""
    if lens.fields.vignetting is None:
        return None
    maps = _map_of(lens, fields)
    xx, xy, yy = maps[2:]
    angle = torch.where(xy.abs() > 1e-12, 0.5 * torch.atan2(2 * xy, xx - yy), 0.0)
    x, y, xx, _, yy = _rotated(maps, torch.cos(angle), -torch.sin(angle))
    between = torch.stack([x, y, 1 - xx, 1 - yy, torch.rad2deg(angle)])
    same = (torch.stack([lens.fields.x, lens.fields.y])[:, :, None] == fields[:, None]).all(0)
    return torch.where(same.any(0), lens.fields.vignetting[:, same.to(torch.int64).argmax(0)], between)


@shared
def _map_of(lens: Lens, field: Tensor) -> Tensor:
    """V_x, V_y, M_xx, M_xy, M_yy (5, ...) of fields (2, ...), with the derivatives of the interpolation everywhere."""
    listed = torch.stack([lens.fields.x, lens.fields.y])
    assert lens.fields.vignetting is not None
    vdx, vdy, vcx, vcy, angle = lens.fields.vignetting
    angle = torch.deg2rad(angle)
    maps = torch.stack([vdx, vdy, 1 - vcx, torch.zeros_like(vcx), 1 - vcy])
    first = (listed[:, :, None] == listed[:, None]).all(0).to(torch.int64).argmax(1)  # of equal fields it alone counts
    maps = _rotated(maps, torch.cos(angle), torch.sin(angle))[:, first]
    same = (listed.reshape(2, -1, *(1,) * (field.dim() - 1)) == field[:, None]).all(0)
    at_listed = maps[:, same.to(torch.int64).argmax(0)]
    if not any(map(varies, (field, lens.fields.x, lens.fields.y))) and not is_any(~same.any(0)):
        return at_listed  # the interpolation is needed for derivatives by the field alone
    axes = (1,) * (field.dim() - 1)
    listed, is_first = listed.reshape(2, -1, *axes), (first.diff(prepend=first[:1] - 1) > 0).reshape(-1, *axes)
    between = _between(listed, maps.reshape(5, -1, *axes), is_first, field[:, None])
    return between + torch.where(same.any(0), at_listed - between, 0.0).detach()


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


def _between(listed: Tensor, maps: Tensor, is_first: Tensor, field: Tensor) -> Tensor:
    """Maps (5, ...) by the rule that applies; listed: (2, F, ...), maps: (5, F, ...), field: (2, 1, ...).

    is_first: (F, ...), whether no equal field is listed before.
    """
    radius = safe_sqrt(dot_2(listed, listed))
    largest, place = radius.max(0, keepdim=True)
    x, y = (safe_divide(torch.gather(part, 0, place), largest) for part in listed)
    line = torch.stack([x, torch.where(largest > 0, y, 1.0)])
    along, across = dot_2(line, listed), _cross(line, listed)
    on_line = (across.abs() <= _OFF_LINE * largest).all(0)
    one_sided = (along >= -_OFF_LINE * largest).all(0)
    rules = (
        (on_line & one_sided, lambda: _by_radius(radius, maps, line, field)),
        (on_line & ~one_sided, lambda: _at_least(maps, along)[:, 0] + _rise(along, maps, dot_2(line, field))),
        (~on_line, lambda: _by_distance(listed, maps, is_first, field)),
    )
    applied = [(applies, rule()) for applies, rule in rules if is_any(applies)]
    (_, result), *others = applied or [(on_line, rules[0][1]())]  # of no fields
    for applies, other in others:  # of fields that `torch.func.vmap` batches
        result = torch.where(applies, other, result)
    return result


def _by_distance(listed: Tensor, maps: Tensor, is_first: Tensor, field: Tensor) -> Tensor:
    """Weights 1/distance², relative to the nearest, which has 1: smooth, and level at the fields."""
    distance = dot_2(listed - field, listed - field)
    nearest, place = distance.min(0, keepdim=True)
    weight = is_first * safe_divide(nearest, distance).scatter(0, place, 1.0)
    return (weight * maps).sum(1) / weight.sum(0)


def _by_radius(radius: Tensor, maps: Tensor, line: Tensor, field: Tensor) -> Tensor:
    """Linear in the distance r from the axis, the change from the axis turned by R from the line to the field:

        V = V₀ + R (V(r) - V₀),   M = M₀ + R (M(r) - M₀) Rᵀ

    An axis that is not listed has the whole pupil.
    """
    whole = maps.new_tensor([0.0, 0.0, 1.0, 0.0, 1.0]).reshape(5, *(1,) * (maps.dim() - 1))
    axis = torch.where(radius.amin(0, keepdim=True) == 0, _at_least(maps, radius), whole)
    size = safe_sqrt(dot_2(field, field))
    # Up to the nearest field the change is proportional to r, on the axis too.
    r = torch.where(size > 0, size, torch.where(radius > 0, radius, torch.inf).amin(0, keepdim=True))
    rise = _rise(torch.cat([torch.zeros_like(radius[:1]), radius]), torch.cat([axis, maps], 1), r)
    x, y, *matrix = _rotated(rise / r[0], dot_2(line, field)[0], _cross(line, field)[0])
    return axis[:, 0] + torch.stack([x, y, *(safe_divide(part, size[0]) for part in matrix)])


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[1] - a[1] * b[0]


def _at_least(maps: Tensor, knots: Tensor) -> Tensor:
    """The map (5, 1, ...) of the smallest of knots (F, ...)."""
    place = knots.argmin(0, keepdim=True)
    return torch.gather(maps, 1, place.expand(5, *place.shape))


def _rise(knots: Tensor, maps: Tensor, place: Tensor) -> Tensor:
    """Maps (5, ...) at a place (1, ...), less that of the smallest knot.

    They are linear between knots (F, ...) and constant outside; at a knot the derivative is the mean of both sides.
    """
    knots, order = knots.sort(0)
    maps = torch.gather(maps, 1, order.expand_as(maps))
    width = knots.diff(dim=0)
    # Equal arguments of maximum and minimum have half of the derivative each.
    beyond = torch.minimum(torch.maximum(place - knots[:-1], torch.zeros_like(place)), width)
    return (safe_divide(beyond, width) * maps.diff(dim=1)).sum(1)


#: Deviation of the beam from the stop without a warning, as a fraction of its semi-diameter.
TOLERANCE = 0.02

MOST_FIELDS = 64  # measured per call: a map of the field has thousands
MOST_LENSES = 64  # of a batch


class UnfilledStop(RaytraceWarning):
    """The beam of a field misses the stop by more than TOLERANCE; the message has figures and a remedy."""

    of_result = True  # about a result: not printed with an error that ends the command


@value
class Filling:
    """How far rays miss the stop, fractions of its semi-diameter; inf for a ray that does not reach it.

    chief: (F,) chief ray from the centre. marginal: (F,) the worst of four marginal rays, from its point of the rim, or
    of the vignetted rim. lost: (F,) whether no ray reaches the stop; radius: () mm, semi-diameter of the stop. Of a
    batch of lenses (L, F), and the radius (L, 1, 1, 1).
    """

    chief: Tensor
    marginal: Tensor
    lost: Tensor
    radius: Tensor


@torch.no_grad()
def filling(lens: Lens, fields: Tensor) -> Filling:
    """How far the rays of fields (2, F) miss the stop as the lens launches them, at the primary wavelength.

    Five rays a field are traced. The real marginal ray of the axial beam defines the semi-diameter of the stop.
    """
    lens, fields = detached(aligned(lens, 3)), fields.detach()
    wavelength, points = lens.primary, fields[:, :, None, None]
    five = fields.new_tensor([[0.0, 0.0, 0.0, -1.0, 1.0], [0.0, -1.0, 1.0, 0.0, 0.0]])
    pupil = vignette(lens, points, five)
    beam, entrance = axial_beam(lens), entrance_of(lens) if is_bent(lens) and not lens.fields.telecentric else None
    radius = _stop_radius(lens, "real", beam, entrance)[0]
    target = _scaled(pupil if entrance is None else _turned(entrance.turn, pupil), _signed(radius, beam, entrance))
    position, arrives = at_stop(lens, rays_of_field(lens, points, pupil, wavelength=wavelength), wavelength)
    missed = torch.linalg.vector_norm(position - target, dim=0) / radius
    missed = torch.where(arrives & torch.isfinite(missed), missed, torch.inf)[..., 0, :]
    return Filling(missed[..., 0], missed[..., 1:].amax(-1), ~arrives.any(-1)[..., 0], radius)


def warn_of_filling(lens: Lens, fields: Tensor, *, ray_aiming: str | None = None) -> None:
    """Warn UnfilledStop with the text of `unfilled`, if it is not empty."""
    if words := unfilled(lens, fields, ray_aiming=ray_aiming):
        warnings.warn(words, UnfilledStop, stacklevel=calling_level())


def unfilled(lens: Lens, fields: Tensor, *, ray_aiming: str | None = None) -> str:
    """A text about the field of (2, F) whose rays miss the stop most, if by more than TOLERANCE; else empty.

    Of more than MOST_FIELDS fields so many are measured, and the largest one; of more than MOST_LENSES lenses so many,
    evenly spaced in the batch. Fields without rays at the stop are left to LostRays. Nothing is traced if rays are
    aimed, if object space is telecentric, and where a derivative by numbers of the lens or fields may be requested.
    """
    lens = with_ray_aiming(lens, ray_aiming)
    if any(map(varies, pytree.tree_leaves((lens, fields)))) or lens.fields.telecentric or aiming_of(lens) != "off":
        return ""
    if fields.shape[1] > MOST_FIELDS:
        fields = fields[:, [*_spread(fields.shape[1], MOST_FIELDS), int(fields.norm(dim=0).argmax())]]
    count = lens.count
    if count == 0:
        return ""
    if count is not None and count > MOST_LENSES:
        lens = one_lens(lens, torch.tensor(_spread(count, MOST_LENSES), device=lens.wavelengths.device))
    beams = filling(lens, fields)
    worst = torch.where(beams.lost, 0.0, torch.maximum(beams.chief, beams.marginal))
    if worst.dim() > 1:  # of a batch: the lens whose stop is missed most
        k = int(worst.amax(-1).argmax())
        radius = beams.radius.expand(len(worst), 1, 1, 1)[k, 0, 0, 0]
        beams, worst = Filling(beams.chief[k], beams.marginal[k], beams.lost[k], radius), worst[k]
    if not bool((worst > TOLERANCE).any() & (beams.radius > 1e-9)):  # a point has no rim
        return ""
    f = int(worst.argmax())
    field = f"{name_of_field(fields[:, f])} {FIELD_UNITS[lens.fields.kind]}"
    many = f" ({int((worst > TOLERANCE).sum())} of {len(worst)} fields by more than {TOLERANCE:.0%})"
    return (
        f"field {field}: rays miss the stop, whose semi-diameter is {float(beams.radius):.4g} mm: the chief ray "
        f"{_words(beams.chief[f], 'centre')}, marginal rays {_words(beams.marginal[f], 'rim')}"
        f"{many if len(worst) > 1 else ''}; {option('ray_aiming', 'real')} aims them, in Python "
        "lens.at(ray_aiming='real')"
    )


def _spread(count: int, most: int) -> list[int]:
    """`most` evenly spaced places of a sequence."""
    return torch.linspace(0, count - 1, most, dtype=torch.float64, device="cpu").long().tolist()


def _words(missed: Tensor, place: str) -> str:
    return f"by {100 * float(missed):.3g} % of it from the {place}" if bool(missed.isfinite()) else "altogether"
