"""Surface: sag, normal and intersection of a refracting or reflecting surface.

    z = c r² / (1 + √(1 - (1+k) c² r²)) + Σ_j a_j r^(2j) + D(x, y),  j = 1, 2, …

Rotationally symmetric but for the departure D, which few surfaces have.

Every function works in the frame of the surface's vertex, components first, for any batch shape.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.maths.numerics import broadcast_shape, differentiating, dot
from raytrace.maths.value import to, value
from raytrace.media.glass import AIR, Glass
from raytrace.system.asphere import aligned, asphere_root, sag_and_derivatives, search
from raytrace.system.departure import Departure, covers, numbers, sag_of, size_of
from raytrace.system.roots import conic_root, double, doubles, foot_of, way_of


@value
class Aperture:
    """The part of a surface that passes light; one surface may carry several, and a ray must pass all of them.

    shape: "circular" (extent: inner and outer radius), "rectangular" or "elliptic" (half-widths in x and y).
    extent: the two numbers of the shape, mm.
    obscures: True if the shape blocks what lies inside it (an obscuration) instead of passing it.
    centre: (x, y) mm of the shape in the surface's frame.
    """

    shape: str
    extent: tuple[float, float]
    obscures: bool = False
    centre: tuple[float, float] = (0.0, 0.0)


@value
class Surface:
    """One surface of a lens and the gap behind it. What is None is not modelled, and costs nothing.

    thickness: mm from this vertex to the next; the object's may be inf.
    curvature: c, 1/mm; None is a plane for good (put a tensor of 0 to differentiate a plane's curvature).
    conic: k; None is a sphere.
    coefficients: (m, ...) a_1, a_2, … of r², r⁴, … in mm^(1-2j); None if not aspheric.
    departure: what the sag has beside; None if nothing. Any kind counts as not rotationally symmetric. A height at the
        vertex belongs to the thickness before: paraxial optics takes D(0, 0) and the slopes there for 0.
    glass: the medium behind the surface; MIRROR reflects and keeps the medium before it.
    semi_diameter: mm, as stored in the file; it never clips a ray (only `apertures` do), but bounds the search for
        the first crossing with an asphere that a ray may cross more than once.
    apertures: what the surface lets through.
    comment: free text of the file.
    """

    thickness: Tensor
    curvature: Tensor | None = None
    conic: Tensor | None = None
    coefficients: Tensor | None = None
    departure: Departure | None = None
    glass: Glass = AIR
    semi_diameter: float | None = None
    apertures: tuple[Aperture, ...] = ()
    comment: str = ""

    @property
    def is_mirror(self) -> bool:
        return self.glass.formula == "mirror"

    @property
    def is_plane(self) -> bool:
        """True if the surface has neither curvature nor aspheric terms nor a departure to model."""
        return self.curvature is None and self.coefficients is None and self.departure is None


def sag(surface: Surface, radius_squared: Tensor) -> Tensor:
    """Sag z in mm at r² (...) in mm²; the radicand is clamped at 0 beyond the edge of a closed conic.

    Raises ValueError for a surface with a departure, whose sag the radius does not tell: see `sag_at`.
    """
    if surface.departure is not None:
        raise ValueError("the sag of a surface with a departure depends on x and y: use sag_at(surface, x, y)")
    if surface.is_plane:
        return torch.zeros_like(radius_squared)
    return sag_and_derivatives(radius_squared, surface.curvature, surface.conic, surface.coefficients, 0)[0]


def sag_at(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """Sag z in mm at points (...) mm of any surface."""
    symmetric = dataclasses.replace(surface, departure=None)
    z = sag(symmetric, x * x + y * y)
    return z if surface.departure is None else z + sag_of(numbers(surface.departure), x, y, highest=0).z


def intersect(surface: Surface, position: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays cross the surface in their own direction of propagation; the path to it may be negative.

    position: (3, ...) mm, anywhere on the ray, in the frame of this surface's vertex; direction: (3, ...) unit.
    Returns the hit point (3, ...) mm and whether there is one (...). Of two crossings it is the one on the vertex
    sheet whose normal looks along the ray's own z direction. A ray that misses comes back at the vertex.
    First and second derivatives are exact: see `_step`.
    """
    meeting = meet(surface, position.unbind(0), direction.unbind(0))
    hit = torch.stack(torch.broadcast_tensors(*meeting.hit, meeting.met)[:3])
    return torch.where(meeting.met, hit, 0.0), meeting.met


class Meeting(NamedTuple):
    """Rays at a surface, by components.

    hit: (x, y, z) mm, each (...); where a ray misses, finite and at the vertex, or on the vertex plane of a plane.
    cosine: (...) n·d with the normal n of `normal`, n_z > 0 at the vertex; finite where a ray misses.
    met: (...) bool, whether there is a crossing.
    normal: that of `normal` and its squared length where they are known already, else None.
    exact: of rays in float32 the hit and the direction in float64, each a triple, from which it is decided whether
        light passes: within 1e-7 of the critical angle rounding would. None of rays in float64.
    """

    hit: tuple[Tensor, Tensor, Tensor]
    cosine: Tensor
    met: Tensor
    normal: tuple | None = None
    exact: tuple[Sequence[Tensor], Sequence[Tensor]] | None = None


def meet(surface: Surface, position: Sequence[Tensor], direction: Sequence[Tensor]) -> Meeting:
    """`intersect` by components, with the cosine that comes with it; arguments are triples of (...)."""
    if surface.is_plane:
        return _meet_plane(position, direction)
    if surface.departure is not None:
        return _meet_departure(surface, position, direction)
    if surface.coefficients is not None:
        return _meet_asphere(surface, position, direction)
    return _meet_conic(surface, position, direction)


def normal(surface: Surface, hit: Sequence[Tensor]) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor | float]:
    """A normal at a point on the surface by components, not normalised, z > 0 at the vertex; its squared length.

    Conic: (-c x, -c y, 1 - (1+k) c z), squared length 1 - k c² r² on the surface (1 for a sphere): no square root.
    """
    x, y, z = hit
    if surface.is_plane:
        return (torch.zeros_like(x), torch.zeros_like(x), torch.ones_like(x)), 1.0
    if surface.departure is not None:
        return _tilted_normal(surface, sag_of(numbers(surface.departure), x, y, highest=1), x, y)
    if surface.coefficients is not None:
        slope = 2 * sag_and_derivatives(x * x + y * y, surface.curvature, surface.conic, surface.coefficients, 1)[1]
        n_x, n_y = -slope * x, -slope * y
        return (n_x, n_y, torch.ones_like(x)), 1 + n_x * n_x + n_y * n_y
    c = surface.curvature
    if surface.conic is None:
        return (-c * x, -c * y, 1 - c * z), 1.0
    # In this order no product of a backward derivative leaves the range of numbers: c² c̄ and r² c̄ would.
    k = surface.conic
    return (-c * x, -c * y, 1 - (1 + k) * c * z), 1 - k * (c * (c * (x * x + y * y)))


def inside(surface: Surface, hit: Tensor) -> Tensor | None:
    """Which points (...) pass all apertures of the surface; None if it has none. An edge belongs to the clear side."""
    passed = None
    for aperture in surface.apertures:
        x, y = hit[0] - aperture.centre[0], hit[1] - aperture.centre[1]
        a, b = aperture.extent
        if aperture.shape == "circular":
            radius_squared = x * x + y * y
            within = (radius_squared >= a * a) & (radius_squared <= b * b)
            blocked = (radius_squared > a * a if a > 0 else radius_squared >= 0) & (radius_squared < b * b)
        elif aperture.shape == "rectangular":
            within, blocked = (x.abs() <= a) & (y.abs() <= b), (x.abs() < a) & (y.abs() < b)
        else:
            level = (x / a) ** 2 + (y / b) ** 2
            within, blocked = level <= 1, level < 1
        clear = ~blocked if aperture.obscures else within
        passed = clear if passed is None else passed & clear
    return passed


def _meet_plane(position, direction) -> Meeting:
    x, y, z = position
    L, M, N = direction
    # A ray along the plane misses it, and so does one that meets it further away than numbers go.
    reach = z.detach() / N.detach()
    met = reach * reach < float("inf")
    N = torch.where(met, N, 1.0)
    t = z / N
    hit = torch.addcmul(x, t, L, value=-1), torch.addcmul(y, t, M, value=-1), z.new_zeros(())
    exact = None if N.dtype == torch.float64 else (doubles(hit), doubles(direction))
    return Meeting(hit, N, met, exact=exact)


def _meet_conic(surface: Surface, position, direction) -> Meeting:
    """F(t) = c/2 (x² + y² + (1+k) z²) - z = 0 along the ray: F' and F'' are as simple as F, and F' = -n·d.

    In float32 the root comes from float64 and a step would only add rounding: there only its derivatives are kept.
    """
    c = surface.curvature
    shape = None if surface.conic is None else 1 + surface.conic
    foot, slide = foot_of(position, direction)
    way = way_of(position, direction, foot, slide)
    root, met = conic_root(way.foot, way.direction, double(c), double(shape))
    t, exact = way.back(root, met)
    L, M, N = direction
    N = torch.where(met, N, 1.0)
    x, y, z = (torch.addcmul(torch.where(met, p, 0.0), t, d) for p, d in zip(foot, (L, M, N), strict=True))
    shaped = z if shape is None else shape * z
    dF = c * torch.addcmul(x * L + y * M, shaped, N) - N
    polish = t.dtype == torch.float64
    if not (polish or differentiating()):
        return Meeting((x, y, z), -dF, met, exact=exact)
    shaped = z if shape is None else shape * z
    F = (0.5 * c) * torch.addcmul(x * x + y * y, shaped, z) - z
    d2F = c if shape is None else c * torch.addcmul(L * L + M * M, shape * N, N)
    step = _step(F, dF, d2F, polish)
    hit = tuple(torch.addcmul(a, step, d, value=-1) for a, d in zip((x, y, z), (L, M, N), strict=True))
    return Meeting(hit, d2F * step - dF, met, exact=exact)


def in_double(surface: Surface) -> Surface:
    """The surface with the numbers of its shape in float64 and outside the graph."""
    return dataclasses.replace(
        surface,
        curvature=double(surface.curvature),
        conic=double(surface.conic),
        coefficients=double(surface.coefficients),
        departure=None if surface.departure is None else to(surface.departure, dtype=torch.float64),
    )


def _meet_asphere(surface: Surface, position, direction) -> Meeting:
    """F(t) = z - sag(x² + y²) = 0 along the ray; the root itself is found outside the graph."""
    c, k, a = surface.curvature, surface.conic, surface.coefficients
    zero = a.new_zeros((), dtype=torch.float64)
    rim = float("inf") if surface.semi_diameter is None else surface.semi_diameter
    foot, slide = foot_of(position, direction)
    way = way_of(position, direction, foot, slide)
    root, met = asphere_root(
        torch.stack(torch.broadcast_tensors(*way.foot)),
        torch.stack(torch.broadcast_tensors(*way.direction)),
        zero if c is None else double(c),
        zero if k is None else double(k),
        double(a),
        rim,
    )
    t, exact = way.back(root, met)
    L, M, N = (torch.where(met, d, at) for d, at in zip(direction, (0.0, 0.0, 1.0), strict=True))
    foot = [torch.where(met, p, 0.0) for p in foot]
    x, y, z = (torch.addcmul(p, t, d) for p, d in zip(foot, (L, M, N), strict=True))
    radial = x * L + y * M
    S, dS, d2S = sag_and_derivatives(x * x + y * y, c, k, a, along=radial)
    dF = N - 2 * dS * radial
    d2F = -(4 * d2S + 2 * dS * (L * L + M * M))
    step = _step(z - S, dF, d2F, t.dtype == torch.float64)
    hit = tuple(torch.addcmul(a, step, d, value=-1) for a, d in zip((x, y, z), (L, M, N), strict=True))
    n, norm_squared = normal(surface, hit)
    return Meeting(hit, dot(n, (L, M, N)), met, (n, norm_squared), exact)


def _meet_departure(surface: Surface, position, direction) -> Meeting:
    """As `_meet_asphere`, with F(t) = z - S(x² + y²) - D(x, y)."""
    c, k, a = surface.curvature, surface.conic, surface.coefficients
    shape, scale = departure = numbers(surface.departure)
    zero = shape.new_zeros((), dtype=torch.float64)
    rim = float("inf") if surface.semi_diameter is None else surface.semi_diameter
    foot, slide = foot_of(position, direction)
    way = way_of(position, direction, foot, slide)
    root, met = torch.ops.raytrace.departure_root(
        torch.stack(torch.broadcast_tensors(*way.foot)),
        torch.stack(torch.broadcast_tensors(*way.direction)),
        zero if c is None else double(c),
        zero if k is None else double(k),
        zero[None] if a is None else double(a),
        double(shape),
        double(scale),
        rim,
    )
    t, exact = way.back(root, met)
    L, M, N = (torch.where(met, d, at) for d, at in zip(direction, (0.0, 0.0, 1.0), strict=True))
    foot = [torch.where(met, p, 0.0) for p in foot]
    x, y, z = (torch.addcmul(p, t, d) for p, d in zip(foot, (L, M, N), strict=True))
    radial = x * L + y * M
    S, dS, d2S = sag_and_derivatives(x * x + y * y, c, k, a, along=radial)
    D = sag_of(departure, x, y)
    dF = N - 2 * dS * radial - (D.x * L + D.y * M)
    d2F = -(4 * d2S + 2 * dS * (L * L + M * M))
    d2F = d2F - (D.xx * L * L + 2 * D.xy * L * M + D.yy * M * M)
    step = _step(z - S - D.z, dF, d2F, t.dtype == torch.float64)
    hit = tuple(torch.addcmul(a, step, d, value=-1) for a, d in zip((x, y, z), (L, M, N), strict=True))
    n, norm_squared = _tilted_normal(surface, sag_of(departure, *hit[:2], highest=1), *hit[:2])
    return Meeting(hit, dot(n, (L, M, N)), met, (n, norm_squared), exact)


def _tilted_normal(surface: Surface, D, x: Tensor, y: Tensor):
    """`normal` where the departure has slopes: (-z_x, -z_y, 1)."""
    _, dS, _ = sag_and_derivatives(x * x + y * y, surface.curvature, surface.conic, surface.coefficients, 1)
    z_x, z_y = 2 * dS * x + D.x, 2 * dS * y + D.y
    return (-z_x, -z_y, torch.ones_like(z_x)), 1 + z_x * z_x + z_y * z_y


# As `asphere_root`, with the numbers of a departure.
torch.library.define(
    "raytrace::departure_root",
    "(Tensor foot, Tensor direction, Tensor curvature, Tensor conic, Tensor coefficients, Tensor shape, Tensor scale,"
    " float rim) -> (Tensor, Tensor)",
)


@torch.library.impl("raytrace::departure_root", "CompositeExplicitAutograd")
def _(foot, direction, curvature, conic, coefficients, shape, scale, rim):
    departure = shape, scale

    def slopes(x: Tensor, y: Tensor) -> Sequence[Tensor]:
        return sag_of(departure, x, y, highest=1)[:3]

    extra = slopes, size_of(departure)
    t, met = search(foot, direction, curvature, conic, coefficients, rim, extra)
    x, y = (p.double() + t.double() * d.double() for p, d in zip(foot[:2], direction[:2], strict=True))
    met = met & covers(departure, x, y)
    return torch.where(met, t, 0.0), met


@torch.library.register_fake("raytrace::departure_root")
def _(foot, direction, curvature, conic, coefficients, shape, scale, rim):
    batch = broadcast_shape(foot.shape[1:], direction.shape[1:], curvature.shape, conic.shape, coefficients.shape[1:])
    return foot.new_empty(batch), foot.new_empty(batch, dtype=torch.bool)


@torch.library.register_vmap("raytrace::departure_root")
def _(info, in_dims, foot, direction, curvature, conic, coefficients, shape, scale, rim):
    """Mapped rays and bases go through together; departures that differ one by one."""
    tensors = foot, direction, curvature, conic, coefficients, shape, scale
    root = torch.ops.raytrace.departure_root
    if in_dims[5] is None and in_dims[6] is None:
        return root(*aligned(tensors[:5], in_dims[:5]), shape, scale, rim), (0, 0)
    each = [
        root(*(x if at is None else x.select(at, i) for x, at in zip(tensors, in_dims[:7], strict=True)), rim)
        for i in range(info.batch_size)
    ]
    return tuple(torch.stack(found) for found in zip(*each, strict=True)), (0, 0)


def _step(F: Tensor, dF: Tensor, d2F: Tensor, polish: bool) -> Tensor:
    """One step of Chebyshev's method from a root t found outside the graph: it carries its derivatives and polishes t.

    With F(t, p) = 0 and δ = F/F', the step t - δ - (F''/2F') δ² has, at δ = 0, the first derivative -F_p/F_t of the
    implicit function and, because δ² has no first but a second derivative, also its second derivative: the last term
    supplies -(F_tt/F_t) t_p t_q, which one Newton step lacks. F'' itself need not be differentiated. The value of F at
    the root is rounding: it polishes t (unless polish is False), but must not leak into derivatives through F'.
    """
    if not differentiating():
        return F / dF if polish else F.new_zeros(())
    step = (F - F.detach()) / dF
    step = torch.addcmul(step, (0.5 * d2F / dF).detach() * step, step)
    return step + (F / dF).detach() if polish else step
