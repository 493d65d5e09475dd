"""Surface: sag, normal and intersection of a refracting or reflecting surface.

    z = c r² / (1 + √(1 - (1+k) c² r²)) + Σ_j a_j b_j(r²) + D(x, y),  j = 1, 2, …

b_j = r^(2j) of an even asphere; other kinds, and the departures D that few surfaces have, are rows of `shapes`.

Every function works in the frame of the surface's vertex, components first, for any batch shape. Roots are found
outside the graph and in float64, also of float32 rays: within 1e-7 of the edge of a surface rounding would decide
between a hit and a miss.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.maths.numerics import differentiating, dot
from raytrace.maths.value import to, value
from raytrace.media.environment import Environment
from raytrace.media.glass import AIR, Glass
from raytrace.system.aperture import Aperture
from raytrace.system.departure import Departure
from raytrace.system.phases import Phase, kind_of
from raytrace.system.pose import Gap, Pose
from raytrace.system.search import first_crossing
from raytrace.system.shapes import DEPARTURES, EVEN, KINDS, Relief, relief, sag_and_derivatives


@value
class Surface:
    """One surface of a lens and the gap behind it. What is None is not modelled, and costs nothing.

    thickness: mm from this vertex to the next; the object's may be inf.
    curvature: c, 1/mm; None is a plane for good (put a tensor of 0 to differentiate a plane's curvature).
    conic: k; None is a sphere.
    coefficients: (m, ...) a_1, a_2, … of the `kind`, a key of `shapes.KINDS`: of an even asphere of r², r⁴, … in
        mm^(1-2j); None if not aspheric.
    departure: what the sag has beside, of a kind of `shapes.DEPARTURES`; None if nothing. A height at the vertex
        belongs to the thickness before: paraxial optics takes D(0, 0) and the slopes there for 0.
    phase: what the surface adds to the path of light, or does in place of Snell's law, of a kind of `phases.PHASES`;
        None for a surface that refracts or reflects.
    before, after: the pose of the surface's axes in those of its vertex, and of the axes that the thickness is laid
        along in those of the surface; None where they are the same.
    is_break: whether rays only change their axes here, to those of `before`, and meet nothing: a coordinate break.
    glass: the medium behind the surface; MIRROR reflects and keeps the medium before it, as a coordinate break does.
    semi_diameter: mm, as stored in the file; it never clips a ray (only `apertures` do), but bounds the search for
        the first crossing with an asphere that a ray may cross more than once.
    apertures: what the surface lets through.
    comment: free text of the file.
    environment: temperature and pressure of the medium behind the surface, where they are not the lens's.
    """

    thickness: Tensor
    curvature: Tensor | None = None
    conic: Tensor | None = None
    coefficients: Tensor | None = None
    kind: str = EVEN
    departure: Departure | None = None
    phase: Phase | None = None
    before: Pose | None = None
    after: Pose | None = None
    is_break: bool = False
    glass: Glass = AIR
    semi_diameter: float | None = None
    apertures: tuple[Aperture, ...] = ()
    comment: str = ""
    environment: Environment | None = None

    @property
    def is_mirror(self) -> bool:
        return self.glass.formula == "mirror"

    @property
    def is_plane(self) -> bool:
        """True if the surface has neither curvature nor aspheric terms nor a departure to model."""
        return self.curvature is None and self.coefficients is None and self.departure is None


_BESIDE = (
    *("thickness", "phase", "before", "after", "is_break", "glass", "environment"),
    *("semi_diameter", "apertures", "comment"),
)

#: The fields of a surface that make its shape: all but how it stands, what stands behind it and around it.
SHAPE = tuple(field.name for field in dataclasses.fields(Surface) if field.name not in _BESIDE)


def gap_behind(surface: Surface) -> Tensor | Gap:
    """What lies between a surface and the next: its thickness, and its pose behind it if it has one."""
    return surface.thickness if surface.after is None else Gap(surface.after, surface.thickness)


def is_posed(surface: Surface) -> bool:
    """Whether the surface is tilted or decentred, or a coordinate break."""
    return surface.is_break or surface.before is not None or surface.after is not None


def is_round(surface: Surface) -> bool:
    """Whether sag and phase are symmetric about the axis, by their kind and whatever their numbers are."""
    if surface.phase is not None and not kind_of(surface.phase).is_round:
        return False
    return surface.departure is None or DEPARTURES[type(surface.departure).__name__].is_round


def is_even(surface: Surface) -> bool:
    """Whether the surface is a centred conic with the terms of an even asphere at most: what other programs know."""
    plain = surface.departure is None and surface.phase is None and not is_posed(surface)
    return plain and (surface.coefficients is None or surface.kind == EVEN)


def is_searched(surface: Surface) -> bool:
    """Whether rays look for the surface step by step: there is no formula for where they meet it."""
    return surface.coefficients is not None or surface.departure is not None


def vertex_curvature(surface: Surface) -> Tensor:
    """c + 2 P'(0) + (D_xx + D_yy)/2 in 1/mm: a term a r² bends the vertex like a curvature.

    A departure D may bend it differently along x and y: this is the mean. Its tilt at the vertex, and that of an odd
    asphere, are left out.
    """
    total = torch.zeros_like(surface.thickness) if surface.curvature is None else surface.curvature
    centre = torch.zeros_like(surface.thickness)
    if surface.coefficients is not None:
        total = total + 2 * KINDS[surface.kind].terms(centre, surface.coefficients, 1, 1.0)[1]
    if surface.departure is None:
        return total
    bend = relief(surface.departure).sag(centre, centre)
    return total + 0.5 * (bend.xx + bend.yy)


def sag(surface: Surface, radius_squared: Tensor) -> Tensor:
    """Sag z in mm at r² (...) in mm²; the radicand is clamped at 0 beyond the edge of a closed conic.

    Raises ValueError for a surface with a departure, whose sag the radius does not tell: see `sag_at`.
    """
    if surface.departure is not None:
        raise ValueError("the sag of a surface with a departure depends on x and y: use sag_at(surface, x, y)")
    return _round(surface, radius_squared, 0)[0]


def sag_at(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """Sag z in mm at points (...) mm of any surface."""
    z = _round(surface, x * x + y * y, 0)[0]
    return z if surface.departure is None else z + relief(surface.departure).sag(x, y, highest=0).z


def _round(surface: Surface, u: Tensor, highest: int, along: Tensor | float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """`sag_and_derivatives` of all but the departure."""
    c, k, a = surface.curvature, surface.conic, surface.coefficients
    return sag_and_derivatives(u, c, k, a, highest, along=along, kind=surface.kind)


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
    if surface.is_plane or (surface.phase is not None and kind_of(surface.phase).flat):
        return _meet_plane(position, direction)
    if is_searched(surface):
        return _meet_searched(surface, position, direction)
    return _meet_conic(surface, position, direction)


def normal(surface: Surface, hit: Sequence[Tensor]) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor | float]:
    """A normal at a point on the surface by components, not normalised, z > 0 at the vertex; its squared length.

    Conic: (-c x, -c y, 1 - (1+k) c z), squared length 1 - k c² r² on the surface (1 for a sphere): no square root.
    """
    x, y, z = hit
    if surface.phase is not None and kind_of(surface.phase).flat:
        return _sloped_normal(surface, x, y, None)
    if surface.is_plane:
        return (torch.zeros_like(x), torch.zeros_like(x), torch.ones_like(x)), 1.0
    if is_searched(surface):
        return _sloped_normal(surface, x, y, None if surface.departure is None else relief(surface.departure))
    c = surface.curvature
    if surface.conic is None:
        return (-c * x, -c * y, 1 - c * z), 1.0
    # In this order no product of a backward derivative leaves the range of numbers: c² c̄ and r² c̄ would.
    k = surface.conic
    return (-c * x, -c * y, 1 - (1 + k) * c * z), 1 - k * (c * (c * (x * x + y * y)))


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
    """The surface with the numbers of its shape in float64."""
    shape = {name: getattr(surface, name) for name in SHAPE}
    return dataclasses.replace(surface, **{name: to(part, dtype=torch.float64) for name, part in shape.items()})


def _meet_searched(surface: Surface, position, direction) -> Meeting:
    """F(t) = z - S(x² + y²) - D(x, y) = 0 along the ray; the root itself is found outside the graph."""
    c, k, a = surface.curvature, surface.conic, surface.coefficients
    bumps = None if surface.departure is None else relief(surface.departure)
    zero = position[0].new_zeros((), dtype=torch.float64)
    foot, slide = foot_of(position, direction)
    way = way_of(position, direction, foot, slide)
    root, met = first_crossing(
        torch.stack(torch.broadcast_tensors(*way.foot)),
        torch.stack(torch.broadcast_tensors(*way.direction)),
        zero if c is None else double(c),
        zero if k is None else double(k),
        zero[None] if a is None else double(a),
        float("inf") if surface.semi_diameter is None else surface.semi_diameter,
        kind=surface.kind,
        relief=bumps,
    )
    t, exact = way.back(root, met)
    L, M, N = (torch.where(met, d, at) for d, at in zip(direction, (0.0, 0.0, 1.0), strict=True))
    x, y, z = (torch.addcmul(torch.where(met, p, 0.0), t, d) for p, d in zip(foot, (L, M, N), strict=True))
    radial = x * L + y * M
    S, dS, d2S = _round(surface, x * x + y * y, 2, radial)
    F, dF, d2F = z - S, N - 2 * dS * radial, -(4 * d2S + 2 * dS * (L * L + M * M))
    if bumps is not None:
        D = bumps.sag(x, y)
        F, dF = F - D.z, dF - (D.x * L + D.y * M)
        d2F = d2F - (D.xx * L * L + 2 * D.xy * L * M + D.yy * M * M)
    step = _step(F, dF, d2F, t.dtype == torch.float64)
    hit = tuple(torch.addcmul(a, step, d, value=-1) for a, d in zip((x, y, z), (L, M, N), strict=True))
    n, norm_squared = _sloped_normal(surface, *hit[:2], bumps)
    return Meeting(hit, dot(n, (L, M, N)), met, (n, norm_squared), exact)


def _sloped_normal(surface: Surface, x: Tensor, y: Tensor, bumps: Relief | None):
    """`normal` by the slopes of the sag: (-z_x, -z_y, 1)."""
    slope = 2 * _round(surface, x * x + y * y, 1)[1]
    n_x, n_y = -slope * x, -slope * y
    if bumps is not None:
        D = bumps.sag(x, y, highest=1)
        n_x, n_y = n_x - D.x, n_y - D.y
    return (n_x, n_y, torch.ones_like(n_x)), 1 + n_x * n_x + n_y * n_y


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


def foot_of(position, direction) -> tuple[list[Tensor], Tensor]:
    """Foot of the perpendicular from the vertex to the ray, and the path to it.

    From there a far origin costs no digits (Feder 1951, Spencer & Murty 1962); the slide stays in the graph.
    """
    slide = -dot(position, direction)
    return [torch.addcmul(p, slide, d) for p, d in zip(position, direction, strict=True)], slide


class Way(NamedTuple):
    """Where a root is looked for, detached and in float64 also for float32 rays.

    foot, direction: triples; lag: of float32 rays how much longer the exact slide is than theirs, else None; dtype:
    theirs.
    """

    foot: Sequence[Tensor]
    direction: Sequence[Tensor]
    lag: Tensor | None
    dtype: torch.dtype

    def back(self, root: Tensor, met: Tensor) -> tuple[Tensor, tuple | None]:
        """The path from the rays' own foot, in their dtype; and of float32 rays `Meeting.exact`."""
        if self.lag is None:
            return root, None
        hit = [torch.addcmul(p, root, d) for p, d in zip(self.foot, self.direction, strict=True)]
        return torch.where(met, root + self.lag, 0.0).to(self.dtype), (hit, self.direction)


def way_of(position, direction, foot, slide) -> Way:
    """The way of rays whose foot and slide are known already, as `foot_of` gives them."""
    if slide.dtype == torch.float64:
        return Way([p.detach() for p in foot], [d.detach() for d in direction], None, slide.dtype)
    position, direction = doubles(position), doubles(direction)
    foot, exact = foot_of(position, direction)
    return Way(foot, direction, exact - slide.detach(), slide.dtype)


def doubles(vector: Sequence[Tensor]) -> list[Tensor]:
    """Components in float64, outside the graph."""
    return [double(component) for component in vector]


def double(x: Tensor | None) -> Tensor | None:
    """A number in float64, outside the graph; None stays None."""
    return None if x is None else x.detach().double()


def conic_root(foot, direction, c: Tensor, shape: Tensor | None) -> tuple[Tensor, Tensor]:
    """Path t (...) from the foot of the perpendicular to the conic of shape 1+k, 0 if there is none; and whether met.

        A t² - 2 G t + F = 0,  A = c (L² + M² + (1+k) N²),  G = N - c k p_z N - c (p·d),
        F = c (p_x² + p_y² + (1+k) p_z²) - 2 p_z

    in the algebraic form that does not cancel (Kahan 2004), regular at c = 0 and at k = -1. For a sphere (shape None)
    A = c and G = N, and G never cancels against the root. Asked for in float64 also of float32 rays: within 1e-7 of the
    edge of a surface rounding would decide between a hit and a miss.
    """
    L, M, N = direction
    x, y, z = foot
    if shape is None:
        F = torch.sub(c * torch.addcmul(x * x + y * y, z, z), z, alpha=2)
        discriminant = torch.addcmul(N * N, c, F, value=-1)
        t = F / (N + torch.copysign(torch.sqrt(discriminant.clamp_min(0.0)), N))
        met = (discriminant > 0) & ((c * torch.addcmul(z, t, N)).abs() < 1)
        return torch.where(met, t, 0.0), met
    shaped = shape * N
    A = c * torch.addcmul(L * L + M * M, shaped, N)
    G = torch.addcmul(N, c, torch.addcmul(x * L + y * M, shaped, z), value=-1)
    F = torch.sub(c * torch.addcmul(x * x + y * y, shape * z, z), z, alpha=2)
    discriminant = torch.addcmul(G * G, A, F, value=-1)
    root = torch.copysign(torch.sqrt(discriminant.clamp_min(0.0)), N)
    same_sign = torch.where(N < 0, -G, G) >= 0
    t = torch.where(same_sign, F, G - root) / torch.where(same_sign, G + root, A)
    met = (discriminant > 0) & ((shape * c) * torch.addcmul(z, t, N) < 1) & (t.abs() < float("inf"))
    return torch.where(met, t, 0.0), met
