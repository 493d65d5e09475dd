"""Deflection of rays at a surface: Snell's law, reflection, diffraction by gratings, ideal lenses.

Directions d and normals n are triples of components (...); n is not normalised, and cosine is n·d. With the gradient
g = ∇p of the optical path p that a grating or a diffractive lens adds (g = 0 for refraction),

    n2 d' = q + α n,   q = n1 d + g,   α = D/(a + s b),   a = q·n,   b = √(a² + D |n|²),
    D = (n2 - n1)(n2 + n1) - g·(2 n1 d + g)

s is the sign of n·d, or its opposite for a mirror. No 1 - cos² is formed: equal indices return d exactly, and grazing
rays lose no precision. Where the radicand is not positive the ray is totally reflected, or the order is evanescent.
Welford, Opt. Commun. 14, 322 (1975).
"""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths.numerics import dot, to
from raytrace.system.intersection import Meeting, normal
from raytrace.system.phases import Added, IdealLens, added_path, ideal_path, kind_of, path_of
from raytrace.system.surface import SHAPE, Surface

Vector = Sequence[Tensor]


def refract(
    direction: Vector,
    normal: Vector,
    cosine: Tensor,
    norm_squared: Tensor | float,
    n1: Tensor,
    n2: Tensor,
    b_squared: Tensor | None = None,
) -> tuple[list[Tensor], Tensor]:
    """Snell's law n1 sin θ1 = n2 sin θ2 as a vector, and whether light passes (False: total internal reflection).

        d' = (n1/n2) d + sign(n·d) D/(a + b)/n2 n,   D = (n2 - n1)(n2 + n1),   a = n1 |n·d|,   b = √(a² + D |n|²)

    direction: unit; norm_squared: |n|²; b_squared: b² in float64 if known more precisely, which then decides.
    """
    a = n1 * cosine
    D = (n2 - n1) * (n2 + n1)
    passes, b_squared = _decided(torch.addcmul(D * norm_squared, a, a), b_squared)
    b = torch.sqrt(torch.where(passes, b_squared, 1.0))
    # An index of 0 marks a medium without a real index: no light passes into it.
    n2 = torch.where(n2 > 0, n2, 1.0)
    along_normal = (D / n2) / (a + torch.copysign(b, a))
    ratio = n1 / n2
    refracted = [torch.addcmul(ratio * d, along_normal, n) for d, n in zip(direction, normal, strict=True)]
    return _renormalise(refracted), passes


def reflect(direction: Vector, normal: Vector, cosine: Tensor, norm_squared: Tensor | float) -> list[Tensor]:
    """Law of reflection d' = d - 2 (n·d) n / |n|²; arguments as for `refract`."""
    twice = 2 * cosine / norm_squared
    return _renormalise([torch.addcmul(d, twice, n, value=-1) for d, n in zip(direction, normal, strict=True)])


def diffract(
    direction: Vector,
    normal: Vector,
    cosine: Tensor,
    norm_squared: Tensor | float,
    n1: Tensor,
    n2: Tensor,
    added: Added,
    *,
    mirror: bool,
    b_squared: Tensor | None = None,
) -> tuple[list[Tensor], Tensor]:
    """Refraction or reflection with the gradient of an added path, and whether light passes: see the module."""
    L, M, N = direction
    q = n1 * L + added.x, n1 * M + added.y, n1 * N
    a, D = _grating_equation(direction, normal, cosine, n1, n2, added)
    passes, b_squared = _decided(torch.addcmul(D * norm_squared, a, a), b_squared)
    passes = passes & (n2 > 0)
    b = torch.sqrt(torch.where(passes, b_squared, 1.0))
    b = torch.where((cosine < 0) ^ mirror, -b, b)
    same_sign = a * b > 0
    along = torch.where(same_sign, D / torch.where(same_sign, a + b, 1.0), (b - a) / norm_squared)
    n2 = torch.where(n2 > 0, n2, 1.0)
    return _renormalise([torch.addcmul(along_q, along, n) / n2 for along_q, n in zip(q, normal, strict=True)]), passes


def _grating_equation(
    direction: Vector, normal: Vector, cosine: Tensor, n1: Tensor, n2: Tensor, added: Added
) -> tuple[Tensor, Tensor]:
    """a and D of the module's equation."""
    L, M, _ = direction
    a = torch.addcmul(n1 * cosine + added.x * normal[0], added.y, normal[1])
    return a, (n2 - n1) * (n2 + n1) - (added.x * (2 * n1 * L + added.x) + added.y * (2 * n1 * M + added.y))


def bend_slopes(
    direction: Vector, height: Vector, power: tuple[Tensor, Tensor], n1: Tensor, n2: Tensor
) -> list[Tensor]:
    """Ideal lens, n2 tan θ2 = n1 tan θ1 - power · height in x and y, with -n for n where light travels backward.

        d' ∝ (n1 L - φx x |N|, n1 M - φy y |N|, n2 N)

    Slopes may be of any size: a ray parallel to the plane stays parallel to it.
    """
    L, M, N = direction
    (power_x, power_y), (x, y, _) = power, height
    bent = [n1 * L - power_x * x * N.abs(), n1 * M - power_y * y * N.abs(), n2 * N]
    factor = torch.rsqrt(dot(bent, bent))
    return [component * factor for component in bent]


def deflect(
    surface: Surface, meeting: Meeting, direction: Vector, n1: Tensor, n2: Tensor, wavelength: Tensor | None
) -> tuple[Vector, Tensor | None, Tensor | None]:
    """Direction behind a surface, whether light passes (None: always), and the path that a phase adds (None: none).

    meeting: `intersection.Meeting` of the rays. If n2 is the same tensor as n1, a surface without a phase is a dummy
    and the direction is unchanged.
    """
    hit, cosine, phase, mirror = meeting.hit, meeting.cosine, surface.phase, surface.is_mirror
    if phase is None and not mirror and n2 is n1:
        return direction, None, None
    if isinstance(phase, IdealLens):
        behind = bend_slopes(direction, hit, (phase.power_x, phase.power_y), n1, n2)
        return behind, None, ideal_path(phase, hit, direction, behind, n1, n2)
    n, norm_squared = normal(surface, hit) if meeting.normal is None else meeting.normal
    exact = meeting.exact
    if phase is None or kind_of(phase).flat:
        if phase is not None:  # the facets of a Fresnel lens: `cosine` is that of the plane
            cosine, exact = dot(n, direction), None
        if mirror:
            return reflect(direction, n, cosine, norm_squared), None, None
        b_squared = None if exact is None else _exact_root(surface, exact, n1, n2)
        return *refract(direction, n, cosine, norm_squared, n1, n2, b_squared), None
    added = added_path(phase, hit[0], hit[1], wavelength)
    b_squared = None if exact is None else _exact_root(surface, exact, n1, n2, wavelength)
    direction, passes = diffract(direction, n, cosine, norm_squared, n1, n2, added, mirror=mirror, b_squared=b_squared)
    return direction, passes, added.path


@torch.no_grad()
def _exact_root(
    surface: Surface, exact: tuple[Vector, Vector], n1: Tensor, n2: Tensor, wavelength: Tensor | None = None
) -> Tensor:
    """b² in float64, outside the graph, with the phase's numbers at the precision of the rays; exact: of `Meeting`."""
    hit, direction = exact
    shape = {name: to(getattr(surface, name), dtype=torch.float64) for name in SHAPE}
    n, norm_squared = normal(dataclasses.replace(surface, **shape), hit)
    if surface.phase is None or kind_of(surface.phase).flat:
        n1, n2 = n1.double(), n2.double()
        a, D = n1 * dot(n, direction), (n2 - n1) * (n2 + n1)
        return torch.addcmul(D * torch.as_tensor(norm_squared), a, a).detach()
    path = path_of(surface.phase, None if wavelength is None else wavelength.to(n1.dtype))
    added = added_path(to(surface.phase if path is None else path, dtype=torch.float64), hit[0], hit[1], wavelength)
    a, D = _grating_equation(direction, n, dot(n, direction), n1.double(), n2.double(), added)
    return torch.addcmul(D * norm_squared, a, a)


def _decided(b_squared: Tensor, exact: Tensor | None) -> tuple[Tensor, Tensor]:
    """Whether light passes, and b² with the value of the exact root and its own derivatives."""
    if exact is None:
        return b_squared > 0, b_squared
    smallest = torch.finfo(b_squared.dtype).tiny
    return exact > 0, exact.to(b_squared.dtype).clamp_min(smallest) + (b_squared - b_squared.detach())


def _renormalise(direction: list[Tensor]) -> list[Tensor]:
    """Squared length 1 within rounding, by a factor that is 1 identically and so is not differentiated."""
    detached = [d.detach() for d in direction]
    factor = torch.rsub(dot(detached, detached), 1.5, alpha=0.5)
    return [d * factor for d in direction]
