"""Intersection of rays with a surface: point, normal and exact derivatives, and the first crossing of an asphere.

Planes and conics have closed forms. A strong asphere may be crossed several times (gull wings), and Newton's method may
settle on a wrong crossing or on none: `first_crossing` starts it at the base conic, accepts by a residual relative to
the size of the terms, and passes the few rays that fail to a bracketed search. Roots are found outside the graph and in
float64, also of float32 rays: within 1e-7 of the edge of a surface rounding would decide between a hit and a miss.
Derivatives are attached by one step: see `_step`. Functions take and return components, triples of (...), in the frame
of the surface's vertex.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from raytrace.maths.numerics import broadcast_shape, differentiating, dot, with_batch_axes
from raytrace.system.phases import kind_of
from raytrace.system.sag_terms import Relief, Sag, relief
from raytrace.system.shapes import EVEN, KINDS, Form, size_of_terms
from raytrace.system.surface import Surface, freeform_sag, is_freeform, is_searched, round_sag, sag_and_derivatives


def intersect(surface: Surface, position: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """The points where rays cross the surface in their direction of propagation; the path to it may be negative.

    position: (3, ...) mm, anywhere on the ray, in the frame of this surface's vertex; direction: (3, ...) unit.
    Returns the hit point (3, ...) mm and whether there is one (...). Of two crossings it is the one on the vertex
    sheet whose normal looks along the ray's own z direction. A ray that misses comes back at the vertex.
    First and second derivatives are exact: see `_step`.
    """
    meeting = meet(surface, position.unbind(0), direction.unbind(0))
    hit = torch.stack(torch.broadcast_tensors(*meeting.hit, meeting.met)[:3])
    return torch.where(meeting.met, hit, 0.0), meeting.met


#: A point or a direction: x, y, z (...).
Vector: TypeAlias = Sequence[Tensor]
#: A normal, not normalised, and its squared length.
Normal: TypeAlias = tuple[tuple[Tensor, Tensor, Tensor], Tensor | float]


class Meeting(NamedTuple):
    """Rays at a surface, by components.

    hit: (x, y, z) mm, each (...); where a ray misses, finite and at the vertex, or on the vertex plane of a plane.
    cosine: (...) n·d with the normal n of `normal`, n_z > 0 at the vertex; finite where a ray misses.
    met: (...) bool, whether there is a crossing.
    normal: that of `normal` and its squared length if computed, else None.
    exact: of float32 rays hit and direction in float64, triples that decide on total reflection; None of float64 rays.
    """

    hit: tuple[Tensor, Tensor, Tensor]
    cosine: Tensor
    met: Tensor
    normal: Normal | None = None
    exact: tuple[Vector, Vector] | None = None


def meet(surface: Surface, position: Sequence[Tensor], direction: Sequence[Tensor]) -> Meeting:
    """`intersect` by components, with the cosine that comes with it; arguments are triples of (...)."""
    if surface.phase is not None and kind_of(surface.phase).flat:
        meeting = _meet_plane(position, direction)
        return meeting._replace(met=meeting.met & _has_facet(surface, *meeting.hit[:2]))
    if is_searched(surface):
        return _meet_searched(surface, position, direction)
    if surface.curvature is None:
        return _meet_plane(position, direction)
    return _meet_conic(surface.curvature, surface.conic, position, direction)


def normal(surface: Surface, hit: Sequence[Tensor]) -> Normal:
    """A normal at a point on the surface by components, not normalised, z > 0 at the vertex; its squared length.

    Conic: (-c x, -c y, 1 - (1+k) c z), squared length 1 - k c² r² on the surface (1 for a sphere): no square root.
    """
    x, y, z = hit
    if surface.phase is not None and kind_of(surface.phase).flat:
        within = _has_facet(surface, x, y)
        return _sloped_normal(surface, torch.where(within, x, 0.0), torch.where(within, y, 0.0), None)
    if is_searched(surface):
        return _sloped_normal(surface, x, y, None if surface.sag_terms is None else relief(surface.sag_terms))
    c, k = surface.curvature, surface.conic
    if c is None:
        return (torch.zeros_like(x), torch.zeros_like(x), torch.ones_like(x)), 1.0
    if k is None:
        return (-c * x, -c * y, 1 - c * z), 1.0
    # In this order no product of a backward derivative leaves the range of numbers: c² c̄ and r² c̄ would.
    return (-c * x, -c * y, 1 - (1 + k) * c * z), 1 - k * (c * (c * (x * x + y * y)))


def _has_facet(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """Whether points lie within the edge of the conic whose slopes the facets have."""
    c = x.new_zeros(()) if surface.curvature is None else surface.curvature
    shape = 1.0 if surface.conic is None else 1 + surface.conic
    return (shape * c * c * (x * x + y * y)).detach() < 1


def _meet_plane(position: Vector, direction: Vector) -> Meeting:
    x, y, z = position
    L, M, N = direction
    # A ray along the plane misses it, and so does a ray whose path to it leaves the range of numbers.
    reach = z.detach() / N.detach()
    met = reach * reach < float("inf")
    N = torch.where(met, N, 1.0)
    t = z / N
    hit = torch.addcmul(x, t, L, value=-1), torch.addcmul(y, t, M, value=-1), z.new_zeros(())
    exact = None if N.dtype == torch.float64 else (doubles(hit), doubles(direction))
    return Meeting(hit, N, met, exact=exact)


def _meet_conic(c: Tensor, conic: Tensor | None, position: Vector, direction: Vector) -> Meeting:
    """F(t) = c/2 (x² + y² + (1+k) z²) - z = 0 along the ray: F' and F'' are as simple as F, and F' = -n·d.

    In float32 the root comes from float64 and a step would only add rounding: there only its derivatives are kept.
    """
    shape = None if conic is None else 1 + conic
    foot, slide = foot_of(position, direction)
    way = way_of(position, direction, foot, slide)
    root, met = conic_root(way.foot, way.direction, double(c), None if shape is None else double(shape))
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
    return Meeting(_moved(x, y, z, step, (L, M, N)), d2F * step - dF, met, exact=exact)


def _moved(x: Tensor, y: Tensor, z: Tensor, step: Tensor, direction: Vector) -> tuple[Tensor, Tensor, Tensor]:
    """A point moved back by a step along its ray."""
    L, M, N = direction
    return (
        torch.addcmul(x, step, L, value=-1),
        torch.addcmul(y, step, M, value=-1),
        torch.addcmul(z, step, N, value=-1),
    )


def _meet_searched(surface: Surface, position: Vector, direction: Vector) -> Meeting:
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
    L, M, N = (torch.where(met, d, axis) for d, axis in zip(direction, (0.0, 0.0, 1.0), strict=True))
    x, y, z = (torch.addcmul(torch.where(met, p, 0.0), t, d) for p, d in zip(foot, (L, M, N), strict=True))
    if is_freeform(surface):
        F, dF, d2F = _less((z, N, torch.zeros_like(N)), freeform_sag(surface, x, y, 2), L, M)
    else:
        radial = x * L + y * M
        S, dS, d2S = round_sag(surface, x * x + y * y, 2, radial)
        F, dF, d2F = z - S, N - 2 * dS * radial, -(4 * d2S + 2 * dS * (L * L + M * M))
    if bumps is not None:
        F, dF, d2F = _less((F, dF, d2F), bumps.sag(x, y), L, M)
    step = _step(F, dF, d2F, t.dtype == torch.float64)
    hit = _moved(x, y, z, step, (L, M, N))
    n, norm_squared = _sloped_normal(surface, hit[0], hit[1], bumps)
    return Meeting(hit, dot(n, (L, M, N)), met, (n, norm_squared), exact)


def _less(F: Sequence[Tensor], D: Sag, L: Tensor, M: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """F, F', F'' along a ray, less those of a sag."""
    turn = D.xx * L * L + 2 * D.xy * L * M + D.yy * M * M
    return F[0] - D.z, F[1] - (D.x * L + D.y * M), F[2] - turn


def _sloped_normal(surface: Surface, x: Tensor, y: Tensor, bumps: Relief | None) -> Normal:
    """`normal` by the slopes of the sag: (-z_x, -z_y, 1)."""
    if is_freeform(surface):
        base = freeform_sag(surface, x, y, 1)
        n_x, n_y = -base.x, -base.y
    else:
        slope = 2 * round_sag(surface, x * x + y * y, 1)[1]
        n_x, n_y = -slope * x, -slope * y
    if bumps is not None:
        D = bumps.sag(x, y, highest=1)
        n_x, n_y = n_x - D.x, n_y - D.y
    return (n_x, n_y, torch.ones_like(n_x)), 1 + n_x * n_x + n_y * n_y


def _step(F: Tensor, dF: Tensor, d2F: Tensor, polish: bool) -> Tensor:
    """One step of Chebyshev's method from a root t found outside the graph: it attaches derivatives and polishes t.

    With F(t, p) = 0 and δ = F/F', the step t - δ - (F''/2F') δ² has, at δ = 0, the first derivative -F_p/F_t of the
    implicit function and, because δ² has no first but a second derivative, also its second derivative: the last term
    supplies -(F_tt/F_t) t_p t_q. F'' itself need not be differentiated. The value of F at the root is rounding: it
    polishes t (if `polish`), but must not leak into derivatives through F'.
    """
    if not differentiating():
        return F / dF if polish else F.new_zeros(())
    step = (F - F.detach()) / dF
    step = torch.addcmul(step, (0.5 * d2F / dF).detach() * step, step)
    return step + (F / dF).detach() if polish else step


def foot_of(position: Vector, direction: Vector) -> tuple[list[Tensor], Tensor]:
    """Foot of the perpendicular from the vertex to the ray, and the path to it.

    From there a far origin loses no precision (Feder 1951, Spencer & Murty 1962); the slide stays in the graph.
    """
    slide = -dot(position, direction)
    return [torch.addcmul(p, slide, d) for p, d in zip(position, direction, strict=True)], slide


class Way(NamedTuple):
    """The ray on which a root is sought, detached and in float64.

    foot, direction: triples; lag: of float32 rays the exact slide less theirs, else None; dtype: of the rays.
    """

    foot: Vector
    direction: Vector
    lag: Tensor | None
    dtype: torch.dtype

    def back(self, root: Tensor, met: Tensor) -> tuple[Tensor, tuple[Vector, Vector] | None]:
        """The path from the foot of the rays, in their dtype; and `Meeting.exact`."""
        if self.lag is None:
            return root, None
        hit = [torch.addcmul(p, root, d) for p, d in zip(self.foot, self.direction, strict=True)]
        return torch.where(met, root + self.lag, 0.0).to(self.dtype), (hit, self.direction)


def way_of(position: Vector, direction: Vector, foot: Vector, slide: Tensor) -> Way:
    if slide.dtype == torch.float64:
        return Way([p.detach() for p in foot], [d.detach() for d in direction], None, slide.dtype)
    position, direction = doubles(position), doubles(direction)
    foot, exact = foot_of(position, direction)
    return Way(foot, direction, exact - slide.detach(), slide.dtype)


def doubles(vector: Sequence[Tensor]) -> list[Tensor]:
    return [double(component) for component in vector]


def double(x: Tensor) -> Tensor:
    """A number in float64, outside the graph."""
    return x.detach().double()


def conic_root(foot: Vector, direction: Vector, c: Tensor, shape: Tensor | None) -> tuple[Tensor, Tensor]:
    """Path t (...) from the foot of the perpendicular to the conic of shape 1+k, 0 if there is none; and whether met.

        A t² - 2 G t + F = 0,  A = c (L² + M² + (1+k) N²),  G = N - c k p_z N - c (p·d),
        F = c (p_x² + p_y² + (1+k) p_z²) - 2 p_z

    in the algebraic form that does not cancel (Kahan 2004), regular at c = 0 and at k = -1. For a sphere (shape None)
    A = c and G = N, and G never cancels against the root.
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


_NEWTON_STEPS = 24
_BISECTIONS = 64
_SAMPLES = 96
_CANDIDATES = 4  # sign changes and edges of the domain that are examined on one ray
_AT_ONCE = 32768  # points that are examined in one call
_ACCEPTED_RESIDUAL = 64.0  # units of the rounding error of the terms of F

# `torch.library.custom_op` would load the compiler at its first call.
torch.library.define(
    "raytrace::first_crossing",
    "(Tensor foot, Tensor direction, Tensor curvature, Tensor conic, Tensor coefficients, str kind, Tensor[] numbers,"
    " str sag_terms, float rim) -> (Tensor, Tensor)",
)


def first_crossing(
    foot: Tensor,
    direction: Tensor,
    curvature: Tensor,
    conic: Tensor,
    coefficients: Tensor,
    rim: float,
    *,
    kind: str = EVEN,
    relief: Relief | None = None,
) -> tuple[Tensor, Tensor]:
    """Path t (...) from `foot` to the first crossing with the surface, and whether there is one (...).

    foot, direction: (3, ...); curvature, conic: (...); coefficients: (m, ...) of this kind; rim: semi-diameter in mm
    (inf: the whole sag); a crossing outside the rim is taken only if there is none in it. In float64; not
    differentiated: pass detached tensors.
    """
    numbers = [] if relief is None else [number.detach() for number in relief.numbers]
    sag_terms = "" if relief is None else relief.kind
    find = torch.ops.raytrace.first_crossing
    return find(foot, direction, curvature, conic, coefficients, kind, numbers, sag_terms, rim)


@torch.library.register_fake("raytrace::first_crossing")
def _(
    foot: Tensor,
    direction: Tensor,
    curvature: Tensor,
    conic: Tensor,
    coefficients: Tensor,
    kind: str,
    numbers: Sequence[Tensor],
    sag_terms: str,
    rim: float,
) -> tuple[Tensor, Tensor]:
    batch = _batch(foot, direction, curvature, conic, coefficients, numbers, sag_terms)
    return foot.new_empty(batch), foot.new_empty(batch, dtype=torch.bool)


def _batch(
    foot: Tensor,
    direction: Tensor,
    curvature: Tensor,
    conic: Tensor,
    coefficients: Tensor,
    numbers: Sequence[Tensor],
    sag_terms: str,
) -> torch.Size:
    """The shape that the arguments of the operator broadcast to."""
    varied = Relief(sag_terms, numbers).batch if sag_terms else ()
    rays = foot.shape[1:], direction.shape[1:]
    return broadcast_shape(*rays, curvature.shape, conic.shape, coefficients.shape[1:], varied)


@torch.library.register_vmap("raytrace::first_crossing")
def _(info: Any, in_dims: Sequence[Any], *arguments: Any) -> tuple[tuple[Tensor, ...], tuple[int, int]]:
    """The mapped axis goes in front of the batch axes; sag terms that differ are searched one by one."""
    *tensors, kind, numbers, sag_terms, rim = arguments
    find, dims = torch.ops.raytrace.first_crossing, in_dims[6] if sag_terms else []
    if all(dim is None for dim in dims):
        return find(*_aligned(tensors, in_dims[:5]), kind, numbers, sag_terms, rim), (0, 0)

    def part(inputs: Sequence[Tensor], dims: Sequence[int | None], i: int) -> list[Tensor]:
        return [x if dim is None else x.select(dim, i) for x, dim in zip(inputs, dims, strict=True)]

    each = [
        find(*part(tensors, in_dims[:5], i), kind, part(numbers, dims, i), sag_terms, rim)
        for i in range(info.batch_size)
    ]
    return tuple(map(torch.stack, zip(*each, strict=True))), (0, 0)


def search(
    foot: Tensor,
    direction: Tensor,
    curvature: Tensor,
    conic: Tensor,
    coefficients: Tensor,
    kind: str,
    numbers: Sequence[Tensor],
    sag_terms: str,
    rim: float,
) -> tuple[Tensor, Tensor]:
    """The operator outside of transforms."""
    batch = _batch(foot, direction, curvature, conic, coefficients, numbers, sag_terms)
    relief = Relief(sag_terms, numbers).flat(batch) if sag_terms else None
    p, d = _expand(foot.double(), batch).reshape(3, -1), _expand(direction.double(), batch).reshape(3, -1)
    c, k = curvature.double().expand(batch).reshape(-1), conic.double().expand(batch).reshape(-1)
    coefficients = coefficients.double()
    # A coefficient axis without batch is kept short: `polynomial` broadcasts it.
    a = coefficients[:, None] if coefficients.dim() == 1 else _expand(coefficients, batch).flatten(1)

    rays = _Rays(p, d, c, k, a, rim, kind, relief)
    t, residual_small, forward, radius = _newton(rays, _start(rays))
    converged = residual_small & forward
    good = converged & (radius <= rim)
    t, good = _searched(rays, t, good)
    good = good | converged
    if rim < _big(t):
        t, good = _searched(rays._replace(rim=torch.inf), t, good)
    t = torch.where(good, t, 0.0)
    return t.reshape(batch).to(foot.dtype), good.reshape(batch).clone()


torch.library.impl("raytrace::first_crossing", "CompositeExplicitAutograd")(search)


def _searched(rays: "_Rays", t: Tensor, good: Tensor) -> tuple[Tensor, Tensor]:
    """t and good, of rays that are not good by the bracketed search."""
    if not _reads_are_free(t):
        t_few, is_crossing = _bracketed(rays)
        return torch.where(is_crossing & ~good, t_few, t), good | is_crossing
    if bool(good.all()):
        return t, good
    few = ~good
    t_few, is_crossing = _bracketed(rays.of(few))
    t, good = t.clone(), good.clone()
    t[few], good[few] = torch.where(is_crossing, t_few, t[few]), is_crossing
    return t, good


def _reads_are_free(tensor: Tensor) -> bool:
    """Whether the host may read a tensor without waiting for a device; else every ray takes all steps."""
    return tensor.device.type == "cpu"


def _expand(x: Tensor, batch: torch.Size) -> Tensor:
    """(m, ...) to (m, *batch)."""
    return with_batch_axes(x, len(batch)).expand(x.shape[0], *batch)


def _aligned(tensors: Sequence[Tensor], in_dims: Sequence[int | None]) -> list[Tensor]:
    """Foot, direction, curvature, conic and coefficients with the mapped axis in front of all batch axes."""
    leading = (1, 1, 0, 0, 1)  # component or term axis before the batch axes
    mapped = [dim is not None for dim in in_dims]
    ranks = [x.dim() - lead - m for x, lead, m in zip(tensors, leading, mapped, strict=True)]
    aligned = []
    for x, lead, dim, rank in zip(tensors, leading, in_dims, ranks, strict=True):
        if dim is not None:
            x = x.movedim(dim, lead)
            x = x.reshape(*x.shape[: lead + 1], *(1,) * (max(ranks) - rank), *x.shape[lead + 1 :])
        aligned.append(x)
    return aligned


class _Rays(NamedTuple):
    """Rays (n,) in float64 and their surface: foot, direction, c, k, a (m, n or 1), rim, kind, D."""

    p: Tensor
    d: Tensor
    c: Tensor
    k: Tensor
    a: Tensor
    rim: float
    kind: str
    relief: Relief | None

    @property
    def form(self) -> Form | None:
        return KINDS[self.kind].form

    def of(self, few: Tensor) -> "_Rays":
        a = self.a if self.a.shape[1] == 1 else self.a[:, few]
        relief = None if self.relief is None else self.relief.of(few)
        return self._replace(p=self.p[:, few], d=self.d[:, few], c=self.c[few], k=self.k[few], a=a, relief=relief)

    def sag(self, u: Tensor, highest: int) -> tuple[Tensor, Tensor, Tensor]:
        return sag_and_derivatives(u, self.c, self.k, self.a, highest, kind=self.kind)


def _start(rays: _Rays) -> Tensor:
    """The base quadric's crossing if it lies inside the rim, else the vertex plane's, else the foot."""
    p, d, c, k, _, rim, *_ = rays
    N = d[2]
    flat = N.abs() > 1e-6
    plane = torch.where(flat, -p[2] / torch.where(flat, N, 1.0), 0.0)
    if rays.form is None:
        shape = 1 + k
        A = c * (d[0] ** 2 + d[1] ** 2 + shape * N * N)
        G = N - c * (p[0] * d[0] + p[1] * d[1] + shape * p[2] * N)
        F = c * (p[0] ** 2 + p[1] ** 2 + shape * p[2] ** 2) - 2 * p[2]
    else:
        # c_x x² + c_y y² + c_z z² = 2 z osculates at the vertex; c_z is that of c_x, c_y which contributes more at the
        # foot: a toroid is exactly such a quadric in either of its sections.
        (x, y, z), (L, M, _), zero = p, d, torch.zeros_like(p[0])
        vertex = rays.form.sag(c, k, rays.a, zero, zero, 2)
        c_x, c_y = vertex.xx, vertex.yy
        c_z = torch.where((c_x * x * x).abs() > (c_y * y * y).abs(), c_x, c_y)
        A = c_x * L * L + c_y * M * M + c_z * N * N
        G = N - (c_x * x * L + c_y * y * M + c_z * z * N)
        F = c_x * x * x + c_y * y * y + c_z * z * z - 2 * z
    discriminant = G * G - A * F
    s = torch.where(N < 0, -1.0, 1.0).to(N.dtype)
    denominator = G + s * torch.sqrt(discriminant.clamp_min(0.0))
    usable = (discriminant > 0) & (s * G > 0)
    t = F / torch.where(usable, denominator, 1.0)
    radius = torch.sqrt((p[0] + t * d[0]) ** 2 + (p[1] + t * d[1]) ** 2)
    return torch.where(usable & (radius <= rim), t, plane)


def _residual(rays: _Rays, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """F = z - S, F' = dF/dt, the rounding scale of F, r² at t, and whether there is a surface."""
    p, d, c, k, a, _, kind, relief = rays
    x, y, z = p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2]
    u = x * x + y * y
    if rays.form is None:
        S, dS, _ = rays.sag(u, 1)
        radial = x * d[0] + y * d[1]
        F, dF = z - S, d[2] - 2 * dS * radial
        scale = z.abs() + (c * u).abs() + size_of_terms(u, a, kind) + p[2].abs() + (t * d[2]).abs()
        scale = scale + 2 * dS.abs() * (u + radial.abs() * t.abs())
        inside_domain = 1 - (1 + k) * (c * (c * u)) > 0
    else:
        S, S_x, S_y, *_ = rays.form.sag(c, k, a, x, y, 1)
        F, dF = z - S, d[2] - (S_x * d[0] + S_y * d[1])
        scale = z.abs() + rays.form.size(c, a, x, y) + p[2].abs() + (t * d[2]).abs()
        scale = scale + (S_x.abs() + S_y.abs()) * (x.abs() + y.abs() + t.abs())
        inside_domain = rays.form.covers(c, k, a, x, y)
    if relief is not None:
        D, D_x, D_y, *_ = relief.sag(x, y, highest=1)
        F, dF = F - D, dF - (D_x * d[0] + D_y * d[1])
        inside_domain = inside_domain & relief.covers(x, y)
        scale = scale + relief.size(torch.sqrt(u)) + (D_x.abs() + D_y.abs()) * (x.abs() + y.abs() + t.abs())
    return F, dF, scale, u, inside_domain


def _newton(rays: _Rays, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """t by Newton's method, whether it is on the surface, whether the ray crosses it forwards, and the radius there.

    A ray that has converged is moved no further, so that no result depends on the other rays.
    """
    rounding = torch.finfo(t.dtype).eps
    active = torch.ones_like(t, dtype=torch.bool)
    for _ in range(_NEWTON_STEPS):
        F, dF, scale, _, _ = _residual(rays, t)
        usable = (dF != 0) & torch.isfinite(F)
        step = torch.where(usable, F / torch.where(usable, dF, 1.0), 0.0)
        t = torch.where(active, t - step, t)
        active = active & usable & (F.abs() > rounding * scale)
        if _reads_are_free(t) and not bool(active.any()):
            break
    F, dF, scale, u, inside_domain = _residual(rays, t)
    small = _is_small(F, dF, scale, u, inside_domain) & torch.isfinite(t)
    forward = dF * torch.where(rays.d[2] < 0, -1.0, 1.0) > 0
    return t, small, forward, torch.sqrt(u)


def _bracketed(rays: _Rays) -> tuple[Tensor, Tensor]:
    """First crossing in the direction of propagation within rim and sag range (1-D batch).

    A sign change counts only between points on the surface: beyond the domain F does not exist, so the bisection ends
    at a crossing or at the edge of the domain; the residual distinguishes them.
    """
    first, last, possible = _stretch_round(rays) if rays.form is None else _stretch_freeform(rays, rays.form)
    width = (last - first) / _SAMPLES
    before, behind = _sides(rays, first + torch.arange(_SAMPLES + 1, device=first.device)[:, None] * width)
    leaves = before[:-1] & ~before[1:]
    steps = (leaves | ~(before[:-1] | behind[:-1]) & behind[1:]) & possible  # that may contain a crossing
    number = steps.cumsum(0)  # of a step, from 1, among those of its ray
    if _reads_are_free(first):
        step, ray = (steps & (number <= _CANDIDATES)).nonzero(as_tuple=True)
        if not len(step):
            return first, torch.zeros_like(possible)
        exists = torch.ones_like(ray, dtype=torch.bool)
    else:
        each = torch.stack([steps & (number == i) for i in range(1, _CANDIDATES + 1)])
        step, exists = each.to(torch.uint8).argmax(1).flatten(), each.any(1).flatten()
        ray = torch.arange(len(first), device=first.device).repeat(_CANDIDATES)
    right = first[ray] + (step + 1) * width[ray]
    ends = ray, right - width[ray], right, leaves[step, ray]
    chunks = zip(*(end.split(max(_AT_ONCE, len(first))) for end in ends), strict=True)
    roots = [_bisected(rays.of(few), *ends_of_few) for few, *ends_of_few in chunks]
    t, is_crossing = (torch.cat(parts) for parts in zip(*roots, strict=True))
    none = _CANDIDATES + 1
    number = torch.where(is_crossing & exists, number[step, ray], none)
    least = torch.full_like(first, none, dtype=number.dtype).scatter_reduce(0, ray, number, "amin")
    is_first = (number < none) & (number == least[ray])  # one of a ray
    t = torch.zeros_like(first).scatter_add(0, ray, torch.where(is_first, t, 0.0))
    return torch.where(least < none, t, first), least < none


def _bisected(rays: _Rays, left: Tensor, right: Tensor, leaves: Tensor) -> tuple[Tensor, Tensor]:
    """Crossing between points, the left one before the surface (leaves) or the right one behind it; whether it is."""
    width = right - left
    for _ in range(_BISECTIONS):
        middle = 0.5 * (left + right)
        is_before, is_behind = _side(rays, middle)
        low = torch.where(leaves, is_before, ~is_behind)
        left, right = torch.where(low, middle, left), torch.where(low, right, middle)
    t = torch.where(leaves, left, right)  # the end on the surface
    t_polished, small, forward, _ = _newton(rays, t)
    stayed = small & forward & ((t_polished - t).abs() <= width.abs())
    return torch.where(stayed, t_polished, t), stayed | _is_small(*_residual(rays, t))


def _sides(rays: _Rays, t: Tensor) -> tuple[Tensor, Tensor]:
    """`_side` of points t (m, n) of each ray, of some 30,000 at once: of few rays, the calls cost more than numbers."""
    count = t.shape[1]
    ray = torch.arange(count, device=t.device)
    chunks = t.split(max(1, _AT_ONCE // max(count, 1)))
    sides = [_side(rays.of(ray.repeat(len(chunk))), chunk.flatten()) for chunk in chunks]
    before, behind = (torch.cat(side).reshape(t.shape) for side in zip(*sides, strict=True))
    return before, behind


def _side(rays: _Rays, t: Tensor) -> tuple[Tensor, Tensor]:
    """Whether the point at t is before the surface, and whether it is behind it: neither where there is none."""
    F, _, _, _, inside = _residual(rays, t)
    below = torch.where(rays.d[2] < 0, -F, F) <= 0
    return inside & below, inside & ~below


def _is_small(F: Tensor, dF: Tensor, scale: Tensor, u: Tensor, inside: Tensor) -> Tensor:
    """Whether a point is on the surface."""
    return (F.abs() <= _ACCEPTED_RESIDUAL * torch.finfo(F.dtype).eps * scale) & inside


def _stretch_round(rays: _Rays) -> tuple[Tensor, Tensor, Tensor]:
    """First and last t of a possible crossing, and whether there can be one."""
    p, (L, M, _), c, k, a, rim, *_ = rays
    big = _big(p)
    closed = (1 + k) * c * c
    edge = torch.where(closed > 0, torch.rsqrt(torch.where(closed > 0, closed, 1.0)), big)
    radius = torch.where(edge < big, edge.clamp_max(rim), torch.full_like(edge, rim))
    radius = torch.where(torch.isfinite(radius) & (radius < big), radius, _reach(rays))

    # Stretch inside the cylinder r = radius …
    A = L * L + M * M
    B = p[0] * L + p[1] * M
    C = p[0] ** 2 + p[1] ** 2 - radius**2
    oblique = A > 0
    discriminant = B * B - A * C
    root = torch.sqrt(discriminant.clamp_min(0.0))
    safe = torch.where(oblique, A, 1.0)
    first = torch.where(oblique, (-B - root) / safe, -big)
    last = torch.where(oblique, (-B + root) / safe, big)
    possible = torch.where(oblique, discriminant >= 0, C <= 0)

    # … and between the lowest and the highest sag.
    fraction = torch.linspace(0, 1, 65, dtype=p.dtype, device=p.device)[:, None]
    heights = rays._replace(a=a[:, None]).sag((fraction * radius) ** 2 * (1 - 1e-7), 0)[0]
    return _between(rays, heights, 0.05, radius, first, last, possible)


def _stretch_freeform(rays: _Rays, form: Form) -> tuple[Tensor, Tensor, Tensor]:
    """The same inside the box about the sheet of the vertex."""
    p, d, c, k, a, rim, *_ = rays
    big = _big(p)
    limit = torch.full_like(p[0], rim) if rim < big else _reach(rays)
    extent = form.extent(c, k, a, torch.full_like(p[0], min(rim, big)))
    sides = [torch.where(side < big, side, limit) for side in extent]
    first, last = torch.full_like(limit, -big), torch.full_like(limit, big)
    possible = torch.ones_like(limit, dtype=torch.bool)
    for foot, slope, side in zip(p, d, sides, strict=False):
        oblique = slope != 0
        ends = [(sign * side - foot) / torch.where(oblique, slope, 1.0) for sign in (-1, 1)]
        first = torch.where(oblique, torch.maximum(first, torch.minimum(*ends)), first)
        last = torch.where(oblique, torch.minimum(last, torch.maximum(*ends)), last)
        possible = possible & (oblique | (foot.abs() <= side))
    fraction = torch.linspace(0, 1 - 1e-8, 9, dtype=p.dtype, device=p.device)
    x, y = (fraction[:, None, None] * sides[0]), fraction[None, :, None] * sides[1]
    heights = form.sag(c, k, a[:, None, None], x, y, 0).z.flatten(0, 1)
    return _between(rays, heights, 0.25, torch.hypot(*sides), first, last, possible)


def _big(like: Tensor) -> float:
    """A length whose square is finite."""
    return torch.finfo(like.dtype).max ** 0.48


def _reach(rays: _Rays) -> Tensor:
    """Radius of the search about the foot, of a surface without rim and edge."""
    return 4 * (torch.sqrt(rays.p[0] ** 2 + rays.p[1] ** 2) + rays.p[2].abs())


def _between(
    rays: _Rays, heights: Tensor, share: float, radius: Tensor, first: Tensor, last: Tensor, possible: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The range of t between the heights (k, n) mm, widened by a share of their range."""
    margin = (heights.amax(0) - heights.amin(0)) * share + torch.finfo(heights.dtype).tiny
    margin = margin if rays.relief is None else margin + rays.relief.size(radius)
    low, high = heights.amin(0) - margin, heights.amax(0) + margin
    z, N = rays.p[2], rays.d[2]
    steep = N.abs() > 1e-9
    safe_N = torch.where(steep, N, 1.0)
    t_low, t_high = (low - z) / safe_N, (high - z) / safe_N
    first = torch.where(steep, torch.maximum(first, torch.minimum(t_low, t_high)), first)
    last = torch.where(steep, torch.minimum(last, torch.maximum(t_low, t_high)), last)
    return first, last, possible & (last >= first)
