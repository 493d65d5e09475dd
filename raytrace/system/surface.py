"""Surface: sag, normal and intersection of a refracting or reflecting surface.

    z = c r² / (1 + √(1 - (1+k) c² r²)) + Σ_j a_j b_j(r²) + D(x, y),  j = 1, 2, …

b_j = r^(2j) of an even asphere; other kinds, some of which are not round, and the sag_terms D that few surfaces have,
are rows of `shapes`.

Every function works in the frame of the surface's vertex, components first, for any batch shape. Roots are found
outside the graph and in float64, also of float32 rays: within 1e-7 of the edge of a surface rounding would decide
between a hit and a miss.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.materials.environment import Environment
from raytrace.materials.glass import AIR, Glass
from raytrace.maths.numerics import differentiating, dot
from raytrace.maths.value import to, value
from raytrace.system.apertures import Aperture
from raytrace.system.intersection import conic_root, double, doubles, first_crossing, foot_of, way_of
from raytrace.system.phases import Phase, kind_of
from raytrace.system.poses import Gap, Pose, Turn
from raytrace.system.sag_terms import Sag
from raytrace.system.shapes import EVEN, KINDS, SAG_TERMS, Relief, SagTerms, relief, sag_and_derivatives


@value
class Surface:
    """One surface of a lens and the gap behind it. What is None is not modelled, and costs nothing.

    thickness: mm from this vertex to the next; the object's may be inf.
    curvature: c, 1/mm; None is a plane for good (put a tensor of 0 to differentiate a plane's curvature).
    conic: k; None is a sphere.
    coefficients: (m, ...) a_1, a_2, … of the `kind`, a key of `shapes.KINDS`: of an even asphere of r², r⁴, … in
        mm^(1-2j), of a toroid its curvature along x and terms of y², y⁴, …; None if not aspheric.
    sag_terms: what the sag has beside, of a kind of `shapes.SAG_TERMS`; None if nothing. A height at the vertex
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
    sag_terms: SagTerms | None = None
    phase: Phase | None = None
    before: Pose | Turn | None = None
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
        """True if the surface has neither curvature nor aspheric terms nor sag terms to model."""
        return self.curvature is None and self.coefficients is None and self.sag_terms is None


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
    if is_freeform(surface):
        return False
    return surface.sag_terms is None or SAG_TERMS[type(surface.sag_terms).__name__].is_round


def is_freeform(surface: Surface) -> bool:
    """Whether the sag is of a kind that is not round, whatever departs from it: a toroid, a biconic."""
    return surface.coefficients is not None and not KINDS[surface.kind].is_round


def is_even(surface: Surface) -> bool:
    """Whether the surface is a centred conic with the terms of an even asphere at most: what other programs know."""
    plain = surface.sag_terms is None and surface.phase is None and not is_posed(surface)
    return plain and (surface.coefficients is None or surface.kind == EVEN)


def is_searched(surface: Surface) -> bool:
    """Whether rays look for the surface step by step: there is no formula for where they meet it."""
    return surface.coefficients is not None or surface.sag_terms is not None


def vertex_curvature(surface: Surface) -> Tensor:
    """c + 2 P'(0) + (D_xx + D_yy)/2 in 1/mm: a term a r² bends the vertex like a curvature.

    Of a toroid or a biconic it is that of the section along y, as other programs straighten an axis. sag terms D may
    bend the vertex differently along x and y: this is the mean. Its tilt at the vertex, and that of an odd asphere, are
    left out.
    """
    total, bend = _vertex(surface)[1], _bend(surface)
    return total if bend is None else total + 0.5 * (bend.xx + bend.yy)


def vertex_curvatures(surface: Surface) -> tuple[Tensor, Tensor]:
    """The curvatures in 1/mm of the sections along x and along y at the vertex, sag_terms included."""
    (along_x, along_y), bend = _vertex(surface), _bend(surface)
    return (along_x, along_y) if bend is None else (along_x + bend.xx, along_y + bend.yy)


def _vertex(surface: Surface) -> tuple[Tensor, Tensor]:
    """The curvatures at the vertex without sag terms, along x and along y."""
    centre = torch.zeros_like(surface.thickness)
    if is_freeform(surface):
        bend = _freeform(surface, centre, centre, 2)
        return bend.xx, bend.yy
    total = centre if surface.curvature is None else surface.curvature
    if surface.coefficients is not None:
        total = total + 2 * KINDS[surface.kind].terms(centre, surface.coefficients, 1, 1.0)[1]
    return total, total


def _bend(surface: Surface) -> Sag | None:
    """The sag_terms at the vertex."""
    if surface.sag_terms is None:
        return None
    centre = torch.zeros_like(surface.thickness)
    return relief(surface.sag_terms).sag(centre, centre)


def sag(surface: Surface, radius_squared: Tensor) -> Tensor:
    """Sag z in mm at r² (...) in mm²; the radicand is clamped at 0 beyond the edge of a closed conic.

    Raises ValueError for a surface that is not round, whose sag the radius does not tell: see `sag_at`.
    """
    if surface.sag_terms is not None or is_freeform(surface):
        raise ValueError("the sag of a surface that is not round depends on x and y: use sag_at(surface, x, y)")
    return _round(surface, radius_squared, 0)[0]


def sag_at(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """Sag z in mm at points (...) mm of any surface; beyond its edge that of the edge."""
    z = _freeform(surface, x, y, 0).z if is_freeform(surface) else _round(surface, x * x + y * y, 0)[0]
    return z if surface.sag_terms is None else z + relief(surface.sag_terms).sag(x, y, highest=0).z


def _round(surface: Surface, u: Tensor, highest: int, along: Tensor | float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """`sag_and_derivatives` of all but the sag terms."""
    c, k, a = surface.curvature, surface.conic, surface.coefficients
    return sag_and_derivatives(u, c, k, a, highest, along=along, kind=surface.kind)


def _freeform(surface: Surface, x: Tensor, y: Tensor, highest: int) -> Sag:
    """The sag of a kind that is not round, without the sag terms."""
    a = surface.coefficients
    c, k = (a.new_zeros(()) if number is None else number for number in (surface.curvature, surface.conic))
    return KINDS[surface.kind].form.sag(c, k, a, x, y, highest)


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
    if surface.phase is not None and kind_of(surface.phase).flat:
        meeting = _meet_plane(position, direction)
        return meeting._replace(met=meeting.met & _within(surface, *meeting.hit[:2]))
    if surface.is_plane:
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
        within = _within(surface, x, y)
        return _sloped_normal(surface, torch.where(within, x, 0.0), torch.where(within, y, 0.0), None)
    if surface.is_plane:
        return (torch.zeros_like(x), torch.zeros_like(x), torch.ones_like(x)), 1.0
    if is_searched(surface):
        return _sloped_normal(surface, x, y, None if surface.sag_terms is None else relief(surface.sag_terms))
    c = surface.curvature
    if surface.conic is None:
        return (-c * x, -c * y, 1 - c * z), 1.0
    # In this order no product of a backward derivative leaves the range of numbers: c² c̄ and r² c̄ would.
    k = surface.conic
    return (-c * x, -c * y, 1 - (1 + k) * c * z), 1 - k * (c * (c * (x * x + y * y)))


def _within(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """Whether there is a facet: one above the edge of a closed conic has no slope."""
    c = x.new_zeros(()) if surface.curvature is None else surface.curvature
    shape = 1.0 if surface.conic is None else 1 + surface.conic
    return (shape * c * c * (x * x + y * y)).detach() < 1


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
    bumps = None if surface.sag_terms is None else relief(surface.sag_terms)
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
    if is_freeform(surface):
        F, dF, d2F = _less((z, N, torch.zeros_like(N)), _freeform(surface, x, y, 2), L, M)
    else:
        radial = x * L + y * M
        S, dS, d2S = _round(surface, x * x + y * y, 2, radial)
        F, dF, d2F = z - S, N - 2 * dS * radial, -(4 * d2S + 2 * dS * (L * L + M * M))
    if bumps is not None:
        F, dF, d2F = _less((F, dF, d2F), bumps.sag(x, y), L, M)
    step = _step(F, dF, d2F, t.dtype == torch.float64)
    hit = tuple(torch.addcmul(a, step, d, value=-1) for a, d in zip((x, y, z), (L, M, N), strict=True))
    n, norm_squared = _sloped_normal(surface, *hit[:2], bumps)
    return Meeting(hit, dot(n, (L, M, N)), met, (n, norm_squared), exact)


def _less(F: Sequence[Tensor], D: Sag, L: Tensor, M: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """F, F', F'' along a ray, less those of a sag."""
    turn = D.xx * L * L + 2 * D.xy * L * M + D.yy * M * M
    return F[0] - D.z, F[1] - (D.x * L + D.y * M), F[2] - turn


def _sloped_normal(surface: Surface, x: Tensor, y: Tensor, bumps: Relief | None):
    """`normal` by the slopes of the sag: (-z_x, -z_y, 1)."""
    if is_freeform(surface):
        base = _freeform(surface, x, y, 1)
        n_x, n_y = -base.x, -base.y
    else:
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
