"""Paraxial optics: the y-nu trace, focal lengths, pupils, principal planes and conjugates.

A ray is (y, ω) with ω = n u, u = dy/dz the slope and n the *signed* index, negative while light travels towards -z.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths.value import value
from raytrace.system.lens import Lens
from raytrace.system.phases import power_of
from raytrace.system.surface import Surface, is_posed, is_round, vertex_curvature
from raytrace.tracing.trace import media


@value
class FirstOrder:
    """First-order data of a lens at its primary wavelength or at those asked for; every entry (...), mm.

    power: -ω′/y₁ in 1/mm.
    effective_focal_length: -y₁/u′ in image space, u′ taken along the light: positive for a concave mirror.
    back_focal_distance: from the last surface before the image to the rear focal point.
    front_focal_distance: from surface 1 to the front focal point.
    entrance_pupil_position: from surface 1; entrance_pupil_diameter > 0.
    exit_pupil_position: from the image surface; exit_pupil_diameter > 0.
    stop_height: of the marginal ray at the stop; negative where the entrance pupil is an inverted image of the stop.
    f_number: |EFL| / entrance pupil diameter; paraxial_working_f_number: 1/(2 n′ |u′|) of the marginal ray.
    paraxial_image_distance: from the last surface before the image to the paraxial image of the object.
    magnification: of that image (0 for an object at infinity).
    angular_magnification: ū′/ū of the chief ray, the slopes through the centres of the pupils.
    optical_invariant: |H| = |n (ū y - u ȳ)| of the marginal ray and the chief ray of the largest field, Lagrange's; the
        field of a lens whose fields are image heights is that height in the paraxial image.
    object_na, image_na: n sin θ of the paraxial marginal ray.
    petzval_radius: radius of the Petzval surface, signed like a surface's.
    front_principal_plane, rear_principal_plane: from surface 1, and from the last surface before the image.
    """

    power: Tensor
    effective_focal_length: Tensor
    back_focal_distance: Tensor
    front_focal_distance: Tensor
    entrance_pupil_position: Tensor
    entrance_pupil_diameter: Tensor
    exit_pupil_position: Tensor
    exit_pupil_diameter: Tensor
    stop_height: Tensor
    f_number: Tensor
    paraxial_working_f_number: Tensor
    paraxial_image_distance: Tensor
    magnification: Tensor
    angular_magnification: Tensor
    optical_invariant: Tensor
    object_na: Tensor
    image_na: Tensor
    petzval_radius: Tensor
    front_principal_plane: Tensor
    rear_principal_plane: Tensor


def signed(surfaces: Sequence[Surface], indices: Sequence[Tensor]) -> list[Tensor]:
    """Indices made negative where light travels towards -z; arguments and order as for `trace.steps`."""
    side, result = 1, [indices[0]]
    for surface, n in zip(surfaces, indices[1:], strict=True):
        side = -side if surface.is_mirror else side
        result.append(side * n)
    return result


def ynu(y, omega, powers: Sequence, gaps: Sequence) -> list[tuple]:
    """(y, ω) of a paraxial ray before each surface, and at last behind the last surface, or its gap if that is given.

    powers: of the surfaces, 1/mm; gaps: t/n behind all of them, or all but the last. Any number type.
    """
    rays = [(y, omega)]
    for k, power in enumerate(powers):
        omega = omega - power * y
        y = y + gaps[k] * omega if k < len(gaps) else y
        rays.append((y, omega))
    return rays


def brackets(powers: Sequence, gaps: Sequence) -> tuple:
    """(A, B, C, D) with y′ = A y + B ω, ω′ = C y + D ω; arguments as for `ynu`. Gauss's brackets (Herzberger 1943)."""
    (A, C), (B, D) = (ynu(y, omega, powers, gaps)[-1] for y, omega in ((1.0, 0.0), (0.0, 1.0)))
    return A, B, C, D


def system_matrix(
    surfaces: Sequence[Surface], indices: Sequence[Tensor], wavelength: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(A, B, C, D) with y′ = A y + B ω, ω′ = C y + D ω from the first vertex, before it, to behind the last surface.

    The axis is straightened: tilts, decentres and the mean slope of a grating are left out, and what bends differently
    along x and y counts by its section along y. indices: signed, len(surfaces) + 1, entries (...); wavelength: (...)
    µm, which surfaces with a phase need. C is minus the power; AD - BC = 1.
    """
    powers = [power(s, n1, n2, wavelength) for s, n1, n2 in zip(surfaces, indices[:-1], indices[1:], strict=True)]
    gaps = [surface.thickness / n for surface, n in zip(surfaces[:-1], indices[1:-1], strict=True)]
    one = torch.ones_like(indices[0])
    return tuple(one * part for part in brackets(powers, gaps))


def power(surface: Surface, before: Tensor, behind: Tensor, wavelength: Tensor | None = None) -> Tensor:
    """Power (...) in 1/mm of a surface between signed indices (...), by its section along y."""
    found = vertex_curvature(surface) * (behind - before)
    return found if surface.phase is None else found + power_of(surface.phase, wavelength)[1]


def first_order(lens: Lens, wavelength: Tensor | None = None) -> FirstOrder:
    """First-order data; wavelength: (...) µm, the primary one by default. Source: Welford, Aberrations, ch. 3.

    A quantity that does not exist (the focal length of an afocal lens, say) comes out infinite.
    """
    wavelength = lens.primary if wavelength is None else wavelength
    surfaces = lens.surfaces[1:-1]
    n = signed(surfaces, media(lens, wavelength)[:-1])
    n_object, n_image = n[0], n[-1]
    A, B, C, D = system_matrix(surfaces, n, wavelength)
    focal_length = -n_image.abs() / C

    # The stop seen from the front (transfer to its vertex) and from the back.
    before, behind = surfaces[: lens.stop - 1], surfaces[lens.stop - 1 :]
    A1, B1 = _to_next_vertex(before, n[: lens.stop], wavelength)
    _, B2, _, D2 = system_matrix(behind, n[lens.stop - 1 :], wavelength)
    entrance_pupil = n_object * B1 / A1
    exit_pupil = -n_image * B2 / D2 - surfaces[-1].thickness

    vergence = n_object / object_distance_of(lens)  # 0 for an object at infinity
    y, omega = A + B * vergence, C + D * vergence
    image_distance = -n_image * y / omega

    diameter = _entrance_pupil_diameter(lens, focal_length, entrance_pupil, A1, n_object, n_image, vergence, omega)
    scale = _marginal_height(lens, entrance_pupil, diameter, n_object, vergence)
    slope_object, slope_image = scale * vergence / n_object, scale * omega / n_image
    petzval = sum(
        vertex_curvature(s) * (n[i + 1] - n[i]) / (n[i] * n[i + 1]) for i, s in enumerate(surfaces)
    ) * torch.ones_like(n_object)
    return FirstOrder(
        power=-C,
        effective_focal_length=focal_length,
        back_focal_distance=-n_image * A / C,
        front_focal_distance=n_object * D / C,
        entrance_pupil_position=entrance_pupil,
        entrance_pupil_diameter=diameter,
        exit_pupil_position=exit_pupil,
        exit_pupil_diameter=diameter * (A1 / D2).abs(),
        stop_height=0.5 * diameter * A1,
        f_number=focal_length.abs() / diameter,
        paraxial_working_f_number=0.5 / (n_image * slope_image).abs(),
        paraxial_image_distance=image_distance,
        magnification=vergence / omega,
        angular_magnification=n_object * D2 / (n_image * A1),
        optical_invariant=_optical_invariant(lens, 0.5 * diameter, n_object, slope_object, n_image * slope_image),
        object_na=(n_object * torch.sin(torch.atan(slope_object))).abs(),
        image_na=(n_image * torch.sin(torch.atan(slope_image))).abs(),
        petzval_radius=-1 / (n_image * petzval),
        front_principal_plane=n_object * (D - 1) / C,
        rear_principal_plane=n_image * (1 - A) / C,
    )


def object_distance_of(lens: Lens) -> Tensor:
    """The distance (...) mm of the object; of one at surface 1 so little that all is what it is in the limit."""
    distance = lens.surfaces[0].thickness
    return torch.where(distance == 0, torch.finfo(distance.dtype).tiny ** 0.5, distance)


def largest_field(lens: Lens) -> Tensor:
    """The field point (2, 1) along y that is as far from the axis as the lens's outermost, in its own unit.

    Where not every surface is round about one axis it is the outermost itself: directions are not alike.
    """
    size = torch.hypot(lens.fields.x, lens.fields.y)
    if all(is_round(surface) and not is_posed(surface) for surface in lens.surfaces):
        largest = size.amax()
        return torch.stack([torch.zeros_like(largest), largest])[:, None]
    outermost = size.argmax()
    return torch.stack([lens.fields.x[outermost], lens.fields.y[outermost]])[:, None]


def marginal_ray(lens: Lens) -> tuple[Tensor, Tensor]:
    """(y, ω) in mm and 1 of the marginal ray in front of surface 1, at the primary wavelength."""
    wavelength = lens.primary
    n_object = media(lens, wavelength)[0]
    data = first_order(lens)
    vergence = n_object / object_distance_of(lens)
    y = _marginal_height(lens, data.entrance_pupil_position, data.entrance_pupil_diameter, n_object, vergence)
    return y, y * vergence


def paraxial_image_distance(lens: Lens, object_distance: Tensor, wavelength: Tensor | None = None) -> Tensor:
    """Paraxial image distance (...) mm from the last surface before the image; object_distance: (...) mm or inf."""
    wavelength = lens.primary if wavelength is None else wavelength
    surfaces = lens.surfaces[1:-1]
    n = signed(surfaces, media(lens, wavelength)[:-1])
    A, B, C, D = system_matrix(surfaces, n, wavelength)
    vergence = n[0] / object_distance
    return -n[-1] * (A + B * vergence) / (C + D * vergence)


def _marginal_height(lens: Lens, entrance_pupil, diameter, n_object, vergence) -> Tensor:
    """Height in mm at surface 1 of the ray from the axial object point through the edge of the entrance pupil.

    The cone of an object NA or angle needs no pupil, which may lie at infinity.
    """
    if lens.aperture.kind in ("object_na", "object_cone_angle"):
        pupil_before_object = 1 + entrance_pupil * vergence / n_object < 0
        height = (lens.surfaces[0].thickness * torch.tan(cone_angle(lens, n_object))).abs()
        return torch.where(pupil_before_object, -height, height)
    return 0.5 * diameter / (1 + entrance_pupil * vergence / n_object)


def cone_angle(lens: Lens, n_object: Tensor) -> Tensor:
    """Half angle of the cone at the object, radians, of an aperture that is given as one."""
    kind, number = lens.aperture.kind, lens.aperture.value
    return torch.asin(number / n_object) if kind == "object_na" else torch.deg2rad(number)


def _optical_invariant(lens: Lens, radius, n_object, slope_object, omega_image) -> Tensor:
    """|n u h| at the object, |n ū y| at the entrance pupil or |n′ u′ h′| at the image, as the largest field is told."""
    largest = torch.hypot(*largest_field(lens))[0]
    if lens.fields.kind == "angle":
        return (n_object * radius * torch.tan(torch.deg2rad(largest))).abs()
    return ((n_object * slope_object if lens.fields.kind == "object_height" else omega_image) * largest).abs()


def _to_next_vertex(surfaces: Sequence[Surface], indices: Sequence[Tensor], wavelength) -> tuple[Tensor, Tensor]:
    """A and B from the first vertex to the vertex that follows the last of the surfaces."""
    if not surfaces:
        return torch.ones_like(indices[0]), torch.zeros_like(indices[0])
    A, B, C, D = system_matrix(surfaces, indices, wavelength)
    gap = surfaces[-1].thickness / indices[-1]
    return A + gap * C, B + gap * D


def _entrance_pupil_diameter(lens, focal_length, entrance_pupil, A1, n_object, n_image, vergence, omega) -> Tensor:
    """The diameter in mm that the lens's aperture specification means."""
    kind, number = lens.aperture.kind, lens.aperture.value
    if kind == "entrance_pupil_diameter":
        return number * torch.ones_like(focal_length)
    if kind == "image_f_number":
        return focal_length.abs() / number
    if kind == "float_by_stop":
        return 2 * number / A1.abs()
    if kind == "paraxial_working_f_number":
        slope = 0.5 / (number * n_image.abs())
        return 2 * (slope * n_image / omega * (1 + entrance_pupil * vergence / n_object)).abs()
    distance = lens.surfaces[0].thickness + entrance_pupil
    return 2 * (distance * torch.tan(cone_angle(lens, n_object))).abs()
