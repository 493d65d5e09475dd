"""Launch: from field points and pupil points to rays in front of surface 1.

Rays start on the plane of the paraxial entrance pupil (at the primary wavelength), wherever it lies; an object 10¹² mm
away costs no digits. With ray aiming they are steered until they fill the real stop.
"""

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from raytrace import glass
from raytrace.lens import Lens
from raytrace.numerics import dot, safe_divide, unit
from raytrace.paraxial import FirstOrder, first_order
from raytrace.rays import Rays
from raytrace.surface import sag
from raytrace.trace import media, start, steps, trace, trace_surfaces

_AIMING_STAGES = ((0.25, 2), (0.5, 2), (0.75, 2), (1.0, 7))  # fraction of the field, Newton steps
_AIMING_TOLERANCE = 1e-7  # of the stop radius, in float64


def launch(
    lens: Lens,
    pupil: Tensor,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    ray_aiming: bool | None = None,
) -> Rays:
    """Rays of every field, wavelength and pupil point: batch shape (F, W, P).

    pupil: (2, P) on the unit disc; fields: (2, F) in the lens's own kind of field, by default those of the lens with
    their vignetting factors (a field given that equals one of the lens's gets its factors too);
    wavelengths: (W,) µm, by default those of the lens; ray_aiming: by default as the lens asks.
    """
    fields = torch.stack([lens.fields.x, lens.fields.y]) if fields is None else fields
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    vignetted = vignette(lens, fields[:, :, None, None], pupil)
    return rays_of_field(
        lens, fields[:, :, None, None], vignetted, wavelength=wavelengths[:, None], ray_aiming=ray_aiming
    )


def vignette(lens: Lens, field: Tensor, pupil: Tensor) -> Tensor:
    """Pupil points shrunk and shifted by the vignetting factors of the lens's field of the same coordinates.

    p' = V + (1 - C) p, in axes turned by VAN;  field: (2, ...), pupil: (2, ...), result (2, ...) broadcast.
    """
    factors = lens.fields.vignetting
    if factors is None:
        return torch.stack([p.expand(torch.broadcast_shapes(field.shape[1:], p.shape)) for p in pupil])
    own = torch.stack([lens.fields.x, lens.fields.y])
    same = (own.reshape(2, -1, *(1,) * (field.dim() - 1)) == field[:, None]).all(0)
    first = same & (same.to(torch.int64).cumsum(0) == 1)
    vdx, vdy, vcx, vcy, angle = (
        torch.where(first, factor.reshape(-1, *(1,) * (field.dim() - 1)), 0.0).sum(0) for factor in factors
    )
    cosine, sine = torch.cos(torch.deg2rad(angle)), torch.sin(torch.deg2rad(angle))
    x = vdx + (1 - vcx) * (cosine * pupil[0] + sine * pupil[1])
    y = vdy + (1 - vcy) * (cosine * pupil[1] - sine * pupil[0])
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y])


def rays_of_field(
    lens: Lens, field: Tensor, pupil: Tensor, *, wavelength: Tensor, ray_aiming: bool | None = None
) -> Rays:
    """Rays of field points through pupil points; everything broadcasts.

    field: (2, ...) degrees or mm, as `lens.fields.kind` says; pupil: (2, ...) fractions of the entrance pupil, or of
    the stop with ray aiming; wavelength: (...) µm. An aimed ray that finds no way to its stop point is lost.
    """
    ray_aiming = lens.ray_aiming if ray_aiming is None else ray_aiming
    paraxial = first_order(lens)
    index = glass.refractive_index(lens.surfaces[0].glass, wavelength).to(pupil.dtype)
    field = object_field(lens, field, paraxial, ray_aiming=ray_aiming)

    def through(pupil: Tensor, fraction: float = 1.0) -> Rays:
        return _through_entrance_pupil(lens, fraction * field, pupil, paraxial, index)

    if not ray_aiming or lens.fields.telecentric:
        return through(pupil)
    aimed, found = aim_at_stop(lens, through, pupil, wavelength)
    rays = through(aimed)
    return dataclasses.replace(rays, valid=rays.valid & found)


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


def object_field(lens: Lens, field: Tensor, paraxial: FirstOrder, *, ray_aiming: bool = False) -> Tensor:
    """Field points (2, ...) as slopes (tan θx, tan θy) for an object at infinity, else as object heights in mm."""
    distance, kind = lens.surfaces[0].thickness, lens.fields.kind
    at_infinity = is_at_infinity(lens)
    if kind == "angle":
        slope = torch.tan(torch.deg2rad(field))
        return slope if at_infinity else _scaled(slope, -(distance + paraxial.entrance_pupil_position))
    if kind == "object_height":
        if at_infinity:
            raise ValueError("fields are object heights but the object is at infinity: give angles, or a distance")
        return field
    index = glass.refractive_index(lens.surfaces[0].glass, lens.wavelengths[lens.primary_wavelength])
    scale = paraxial.power / index if at_infinity else 1 / paraxial.magnification
    estimate = _scaled(field, scale)
    if kind == "paraxial_image_height":
        return estimate
    return _field_of_real_height(lens, field, estimate, paraxial)


def aim_at_stop(lens: Lens, through: Callable[..., Rays], pupil: Tensor, wavelength: Tensor) -> tuple[Tensor, Tensor]:
    """Entrance pupil points (2, ...) whose rays pass the stop at `pupil` times its radius; and whether found (...).

    through(pupil, fraction): rays of the field scaled by `fraction`. Newton's method,
    followed from the axis to the full field; the last step is attached, so first derivatives are exact.
    """
    surfaces = lens.surfaces[1 : lens.stop + 1]
    indices = media(lens, wavelength)[: lens.stop + 1]
    radius = stop_radius(lens)

    def at_stop(pupil: Tensor, fraction: float = 1.0) -> tuple[Tensor, Tensor]:
        rays = through(pupil, fraction)
        arrives = rays.valid
        for crossing in steps(surfaces, rays, indices=indices):
            rays, arrives = crossing.rays, arrives & ~(crossing.missed | crossing.totally_reflected)
        return rays.position[:2] / radius, arrives

    batch = torch.broadcast_shapes(at_stop(pupil)[0].shape[1:], pupil.shape[1:])
    target = torch.stack([p.expand(batch) for p in pupil])
    guess = target.detach().clone()
    for fraction, count in _AIMING_STAGES:
        for _ in range(count):
            error, jacobian = _error_and_jacobian(lambda q, f=fraction: at_stop(q, f)[0], guess, target.detach())
            step = _solve(jacobian, error)
            # Half the pupil at most in one step: a full step from a bad start can leave the lens for good.
            length = torch.linalg.vector_norm(step, dim=0)
            guess = guess - step * (0.5 / length.clamp_min(0.5))
    error, jacobian = _error_and_jacobian(lambda q: at_stop(q)[0], guess, target.detach())
    reached, arrives = at_stop(guess)
    tolerance = _AIMING_TOLERANCE if pupil.dtype == torch.float64 else 1e-4
    found = (error.abs() <= tolerance).all(0) & arrives
    attached = guess - _solve(jacobian, reached - target)
    return torch.where(found, attached, target), found


def stop_radius(lens: Lens) -> Tensor:
    """Height in mm at the stop of the real axial ray through the edge of the entrance pupil, primary wavelength."""
    if lens.aperture.kind == "float_by_stop":
        return lens.aperture.value
    wavelength = lens.wavelengths[lens.primary_wavelength]
    paraxial = first_order(lens)
    edge = lens.wavelengths.new_tensor([0.0, 1.0]).to(paraxial.entrance_pupil_diameter.dtype)
    index = glass.refractive_index(lens.surfaces[0].glass, wavelength).to(edge.dtype)
    rays = _through_entrance_pupil(lens, torch.zeros_like(edge), edge, paraxial, index)
    indices = media(lens, wavelength)[: lens.stop + 1]
    return trace_surfaces(lens.surfaces[1 : lens.stop + 1], rays, indices=indices).position[1].abs()


def _through_entrance_pupil(lens: Lens, field: Tensor, pupil: Tensor, paraxial: FirstOrder, index: Tensor) -> Rays:
    """Rays from a slope or object height (2, ...) to the paraxial entrance pupil at fractions (2, ...)."""
    distance = lens.surfaces[0].thickness
    at_infinity = is_at_infinity(lens)
    radius, depth = 0.5 * paraxial.entrance_pupil_diameter, paraxial.entrance_pupil_position
    if lens.fields.telecentric:
        # The pupil is at infinity: cones of equal rays about a chief ray parallel to the axis.
        radius, depth = _telecentric_radius(lens, paraxial, index), torch.zeros_like(distance)
        aim_x, aim_y = field[0] + radius * pupil[0], field[1] + radius * pupil[1]
    else:
        aim_x, aim_y = radius * pupil[0], radius * pupil[1]
    x, y, aim_x, aim_y, depth, index, distance = torch.broadcast_tensors(
        field[0], field[1], aim_x, aim_y, depth, index, distance
    )
    aim = torch.stack([aim_x, aim_y, depth])
    if at_infinity:
        return rays_from_infinity(torch.stack([x, y, torch.ones_like(x)]), aim, index=index)
    z = sag(lens.surfaces[0], x * x + y * y) - distance
    return rays_from_point(torch.stack([x, y, z]), aim, index=index)


def _telecentric_radius(lens: Lens, paraxial: FirstOrder, index: Tensor) -> Tensor:
    distance, kind, number = lens.surfaces[0].thickness, lens.aperture.kind, lens.aperture.value
    if kind == "object_na":
        return distance * torch.tan(torch.asin(number / index))
    if kind == "object_cone_angle":
        return distance * torch.tan(torch.deg2rad(number))
    raise ValueError(
        f"object space is telecentric, which needs an aperture given as object NA or cone angle, not {kind}"
    )


def _field_of_real_height(lens: Lens, height: Tensor, estimate: Tensor, paraxial: FirstOrder) -> Tensor:
    """Scale the paraxial field (2, ...) until the real chief ray meets the image at `height` (2, ...) mm."""
    wavelength = lens.wavelengths[lens.primary_wavelength]
    index = glass.refractive_index(lens.surfaces[0].glass, wavelength).to(height.dtype)
    wanted = dot_2(height, height)

    def image_height(scale: Tensor) -> Tensor:
        rays = _through_entrance_pupil(lens, _scaled(estimate, scale), torch.zeros_like(height), paraxial, index)
        return safe_divide(dot_2(trace(lens, rays, wavelength).position[:2], height), wanted)

    scale = torch.ones_like(wanted.detach())
    for _ in range(12):
        reached, slope = _value_and_slope(image_height, scale)
        scale = (scale - safe_divide(reached - 1, slope)).detach()
    _, slope = _value_and_slope(image_height, scale)
    scale = scale - safe_divide(image_height(scale) - 1, slope)
    return _scaled(estimate, torch.where(wanted > 0, scale, 1.0))


def _scaled(field: Tensor, factor: Tensor) -> Tensor:
    """field (2, ...) times factor (...): the batch axes broadcast behind the component axis."""
    return torch.stack([component * factor for component in field])


def dot_2(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product over a leading axis of length 2."""
    return a[0] * b[0] + a[1] * b[1]


def _value_and_slope(function: Callable[[Tensor], Tensor], point: Tensor) -> tuple[Tensor, Tensor]:
    """f(p) and f'(p) of a function that acts on each entry alone, outside the graph."""
    value, pull = torch.func.vjp(function, point)
    return value.detach(), pull(torch.ones_like(value))[0].detach()


def _error_and_jacobian(function: Callable[[Tensor], Tensor], point: Tensor, target: Tensor):
    """f(p) - target (2, ...) and the rows ∂f_x/∂p, ∂f_y/∂p (2, ...) of each ray's own Jacobian, outside the graph."""
    value, pull = torch.func.vjp(function, point)
    x, y = torch.zeros_like(value), torch.zeros_like(value)
    x[0], y[1] = 1.0, 1.0
    return (value - target).detach(), (pull(x)[0].detach(), pull(y)[0].detach())


def _solve(jacobian: tuple[Tensor, Tensor], error: Tensor) -> Tensor:
    """Solve the 2 × 2 systems by Cramer's rule; 0 where singular."""
    of_x, of_y = jacobian
    determinant = of_x[0] * of_y[1] - of_x[1] * of_y[0]
    return torch.stack(
        [
            safe_divide(error[0] * of_y[1] - of_x[1] * error[1], determinant),
            safe_divide(of_x[0] * error[1] - error[0] * of_y[0], determinant),
        ]
    )
