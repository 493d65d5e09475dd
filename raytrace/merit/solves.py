"""Solves: numbers of a lens that follow from others, a row for every kind.

Each is found from the numbers of the surfaces before, at the primary wavelength; n is signed, ω = n u.
"""

import torch
from torch import Tensor

from raytrace.optics.launch import rays_of_field
from raytrace.optics.sequence import media, sequence_of
from raytrace.optics.trace import trace_surfaces
from raytrace.optics.vignetting import vignette
from raytrace.system.intent import Solve
from raytrace.system.lens import Lens
from raytrace.system.rays import Rays
from raytrace.system.surface import sag_at

#: Through which points of the pupil light reaches furthest from the vertex of a surface.
ENDS = ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0))


def _ray_before(moment, surface: int):
    """(y, ω) of the paraxial marginal ray in front of a surface."""
    y, omega = moment.marginal_height, moment.marginal_height * moment.vergence
    if surface == 1:
        return y, omega
    A, B, C, D = moment.matrix(1, surface - 1, moment.primary, to_next=True)
    return A * y + B * omega, C * y + D * omega


def _pickup(moment, solve: Solve):
    return solve.scale * moment.number(solve.source, solve.quantity_of_source or solve.quantity) + solve.offset


def _bent_to(moment, solve: Solve, omega_behind):
    """The curvature behind which the marginal ray has ω′: c = (ω - ω′ - K y)/(y (n′ - n)), K the power beside it."""
    k, n = solve.surface, moment.index(moment.primary)
    y, omega = _ray_before(moment, k)
    return ((omega - omega_behind) / y - moment.further_power(k, moment.primary)) / (n[k] - n[k - 1])


def _marginal_angle(moment, solve: Solve):
    return _bent_to(moment, solve, moment.index(moment.primary)[solve.surface] * solve.numbers[0])


def _f_number(moment, solve: Solve):
    return _bent_to(moment, solve, -abs(moment.index(moment.primary)[solve.surface]) / (2 * solve.numbers[0]))


def _marginal_height(moment, solve: Solve):
    """t = n′ (h - y)/ω′ behind the surface, of the paraxial ray, or of the real one through a part of the pupil."""
    if any(solve.numbers[1:]):
        return moment.through_torch(lambda lens: [_real_height(lens, solve)])[0]
    k, primary = solve.surface, moment.primary
    y, omega = _ray_before(moment, k)
    return moment.index(primary)[k] * (solve.numbers[0] - y) / (omega - moment.power(k, primary) * y)


def _real_height(lens: Lens, solve: Solve) -> Tensor:
    """t = z + (N/M)(h - y) - z′(h) behind which a real axial ray meets the next surface at the height h; else nan."""
    k, (height, part) = solve.surface, solve.numbers
    like = lens.wavelengths
    rays = _behind(lens, k, like.new_zeros(2), like.new_tensor([0.0, part]), lens.primary)
    (_, y, z), (_, M, N) = rays.position, rays.direction
    crosses = rays.valid & (M != 0)
    ratio = N / torch.where(crosses, M, torch.ones_like(M))
    at = z.new_tensor(height)
    thickness = z + ratio * (at - y) - sag_at(lens.surfaces[k + 1], torch.zeros_like(at), at)
    return torch.where(crosses, thickness, torch.nan).reshape(())


def _edge_thickness(moment, solve: Solve):
    """t = e + z - z′ of both surfaces at one height, by default the semi-diameter of the first."""
    return moment.through_torch(lambda lens: [_edge(lens, solve)])[0]


def _edge(lens: Lens, solve: Solve) -> Tensor:
    k, (edge, height) = solve.surface, solve.numbers
    at = lens.wavelengths.new_tensor(height) if height else semi_diameter(lens, k)
    near, far = (sag_at(surface, torch.zeros_like(at), at) for surface in lens.surfaces[k : k + 2])
    return (edge + near - far).reshape(())


def semi_diameter(lens: Lens, k: int) -> Tensor:
    """mm (): as given, or where the light of all fields and wavelengths reaches, with the margin of `Intent`."""
    intent, own = lens.intent, lens.surfaces[k].semi_diameter
    if own and (intent is None or k in intent.semi_diameters):
        return lens.wavelengths.new_tensor(own)
    field = torch.stack([lens.fields.x, lens.fields.y])[:, None, :, None]
    points = lens.wavelengths.new_tensor(ENDS).T[:, None, None]
    rays = _behind(lens, k, field, vignette(lens, field, points), lens.wavelengths[:, None, None])
    height = torch.where(rays.valid, rays.position[0].square() + rays.position[1].square(), 0.0).amax().sqrt()
    percent, length = (0.0, 0.0) if intent is None or k == lens.stop else intent.semi_diameter_margin
    return (1 + percent / 100) * height + length


def _behind(lens: Lens, k: int, field: Tensor, pupil: Tensor, wavelength: Tensor) -> Rays:
    """Rays behind surface k, in the axes of its vertex."""
    rays = rays_of_field(lens, field, pupil, wavelength=wavelength)
    return trace_surfaces(sequence_of(lens)[:k], rays, indices=media(lens, wavelength)[: k + 1], wavelength=wavelength)


def _power(moment, solve: Solve):
    """c = P/(n′ - n) of the power that a surface has by its curvature."""
    k, n = solve.surface, moment.index(moment.primary)
    return solve.numbers[0] / (n[k] - n[k - 1])


def _position(moment, solve: Solve):
    """The thickness with which those from surface `source` to this one, or from this one on to `source`, have a sum."""
    k, source = solve.surface, solve.source
    others = range(source, k) if source <= k else range(k + 1, source)
    return solve.numbers[0] - sum(moment.thickness[j] for j in others)


#: How a number is found, by the kind of its solve: of a moment and the solve.
SOLVES = {
    "pickup": _pickup,
    "marginal_angle": _marginal_angle,
    "f_number": _f_number,
    "marginal_height": _marginal_height,
    "edge_thickness": _edge_thickness,
    "power": _power,
    "position": _position,
}
