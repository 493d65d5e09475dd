"""Trace rays through a sequence of surfaces: transfer, intersect, refract or reflect, clip.

The trace is a generator. To record, draw or find where a ray was lost, consume `steps`; to trace on from stored
rays, hand them with the surfaces that are left.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.maths.numerics import dot
from raytrace.maths.value import to, value
from raytrace.system.apertures import inside
from raytrace.system.lens import Lens
from raytrace.system.phases import Added, added_path, ideal_path, kind_of, path_of
from raytrace.system.poses import Gap, Turn, direction_in, point_in
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface, gap_behind, in_double, meet, normal
from raytrace.tracing.compiled.engine_choice import uses_compiled
from raytrace.tracing.compiled.run import trace_compiled
from raytrace.tracing.compiled.structure import is_expressible
from raytrace.tracing.sequence import media, sequence_of


@value
class Crossing:
    """What happened to rays at one surface.

    rays: Rays behind the surface, in its vertex frame.
    missed, totally_reflected: (...) bool, the ray ends here for that reason; also one vignetted before, which goes on.
    clipped: (...) bool, the ray was vignetted here, and not lost before.
    """

    rays: Rays
    missed: Tensor
    totally_reflected: Tensor
    clipped: Tensor


# -- laws of light: directions and normals come by components, the normal n not normalised; cosine is n·d --------------


def refract(direction, normal, cosine, norm_squared, n1: Tensor, n2: Tensor, b_squared: Tensor | None = None):
    """Snell's law n1 sin θ1 = n2 sin θ2 as a vector, and whether light passes (False: total internal reflection).

        d' = (n1/n2) d + sign(n·d) D/(a + b)/n2 n,   D = (n2 - n1)(n2 + n1),   a = n1 |n·d|,   b = √(a² + D |n|²)

    direction: unit, by components; normal: by components, of squared length norm_squared; cosine: n·d.
    b_squared: b² in float64 where it is known better than by these numbers; it then decides.
    No 1 - cos² anywhere: equal indices return d exactly, and grazing rays keep their digits. The squared length of
    d' is then brought to 1 within rounding, by a factor that is 1 identically and so is not differentiated.
    """
    a = n1 * cosine
    D = (n2 - n1) * (n2 + n1)
    passes, b_squared = _decided(torch.addcmul(D * norm_squared, a, a), b_squared)
    b = torch.sqrt(torch.where(passes, b_squared, 1.0))
    # An index of 0 is a medium without a real index: nothing passes into it.
    n2 = torch.where(n2 > 0, n2, 1.0)
    along_normal = (D / n2) / (a + torch.copysign(b, a))
    ratio = n1 / n2
    refracted = [torch.addcmul(ratio * d, along_normal, n) for d, n in zip(direction, normal, strict=True)]
    return _renormalise(refracted), passes


def reflect(direction, normal, cosine, norm_squared):
    """Law of reflection d' = d - 2 (n·d) n / |n|²; arguments as for `refract`."""
    twice = 2 * cosine / norm_squared
    return _renormalise([torch.addcmul(d, twice, n, value=-1) for d, n in zip(direction, normal, strict=True)])


def diffract(
    direction, normal, cosine, norm_squared, n1: Tensor, n2: Tensor, added: Added, *, mirror: bool, b_squared=None
):
    """Snell's law or reflection with the gradient g = ∇p of a path added to q = n1 d; and whether light passes.

        n2 d' = q + α n,  q = n1 d + g,  α = (s b - a)/|n|² = D/(a + s b),  a = q·n,  b = √(a² + D |n|²)
        D = (n2 - n1)(n2 + n1) - g·(2 n1 d + g)

    s is the sign of n·d, or the other one for a mirror: light keeps its side, or changes it. Where the root vanishes
    the order is evanescent, and no light passes. Welford, Opt. Commun. 14, 322 (1975).
    b_squared: b² in float64 where it is known better than by these numbers, as for `refract`.
    """
    L, M, N = direction
    q = n1 * L + added.x, n1 * M + added.y, n1 * N
    a, D = _across(direction, normal, cosine, n1, n2, added)
    passes, b_squared = _decided(torch.addcmul(D * norm_squared, a, a), b_squared)
    passes = passes & (n2 > 0)
    b = torch.sqrt(torch.where(passes, b_squared, 1.0))
    b = torch.where((cosine < 0) ^ mirror, -b, b)
    alike = a * b > 0
    along = torch.where(alike, D / torch.where(alike, a + b, 1.0), (b - a) / norm_squared)
    n2 = torch.where(n2 > 0, n2, 1.0)
    return _renormalise([torch.addcmul(at, along, n) / n2 for at, n in zip(q, normal, strict=True)]), passes


def diffracted_root(direction, normal, cosine, norm_squared, n1: Tensor, n2: Tensor, added: Added) -> Tensor:
    """b² of `diffract`."""
    a, D = _across(direction, normal, cosine, n1, n2, added)
    return torch.addcmul(D * norm_squared, a, a)


def _across(direction, normal, cosine, n1: Tensor, n2: Tensor, added: Added) -> tuple[Tensor, Tensor]:
    """a and D of `diffract`."""
    L, M, _ = direction
    a = torch.addcmul(n1 * cosine + added.x * normal[0], added.y, normal[1])
    return a, (n2 - n1) * (n2 + n1) - (added.x * (2 * n1 * L + added.x) + added.y * (2 * n1 * M + added.y))


def bend_slopes(direction, height, power, n1: Tensor, n2: Tensor):
    """The ideal lens n2 tan θ2 = n1 tan θ1 - power · height in x and y, with -n for n where light travels backward.

        d' ∝ (n1 L - φx x |N|, n1 M - φy y |N|, n2 N)

    Slopes may be of any size: a ray along the plane goes on along it.
    """
    L, M, N = direction
    (power_x, power_y), (x, y, _) = power, height
    bent = [n1 * L - power_x * x * N.abs(), n1 * M - power_y * y * N.abs(), n2 * N]
    factor = torch.rsqrt(dot(bent, bent))
    return [component * factor for component in bent]


def _decided(b_squared: Tensor, exact: Tensor | None) -> tuple[Tensor, Tensor]:
    """Whether light passes, and b² with the value of the exact one and its own derivatives."""
    if exact is None:
        return b_squared > 0, b_squared
    smallest = torch.finfo(b_squared.dtype).tiny
    return exact > 0, exact.to(b_squared.dtype).clamp_min(smallest) + (b_squared - b_squared.detach())


def _renormalise(direction):
    detached = [d.detach() for d in direction]
    factor = torch.rsub(dot(detached, detached), 1.5, alpha=0.5)
    return [d * factor for d in direction]


# -- rays at a surface -------------------------------------------------------------------------------------------------


def _snell_discriminant(surface: Surface, hit, direction, n1: Tensor, n2: Tensor) -> Tensor:
    """b² of `refract` in float64, outside the graph."""
    with torch.no_grad():
        n, norm_squared = normal(in_double(surface), hit)
        n1, n2 = n1.double(), n2.double()
        a = n1 * dot(n, direction)
        return torch.addcmul((n2 - n1) * (n2 + n1) * torch.as_tensor(norm_squared), a, a).detach()


class _Ray(NamedTuple):
    """Rays by components, as the loop over surfaces carries them."""

    position: Sequence[Tensor]
    direction: Sequence[Tensor]
    valid: Tensor
    opl: Tensor | None

    @staticmethod
    def of(rays: Rays) -> "_Ray":
        return _Ray(rays.position.unbind(0), rays.direction.unbind(0), rays.valid, rays.opl)

    def rays(self) -> Rays:
        x, y, z, L, M, N = torch.broadcast_tensors(*self.position, *self.direction)
        return Rays(torch.stack([x, y, z]), torch.stack([L, M, N]), self.valid, self.opl)


def cross(
    surface: Surface,
    rays: Rays,
    gap: Tensor | Gap | None,
    side: int,
    n1: Tensor,
    n2: Tensor,
    wavelength: Tensor | None = None,
) -> Crossing:
    """Carry rays over the gap before a surface and through the surface.

    rays: in the frame of the surface before, or of this one, before its pose, if gap is None; gap: mm between the two
    vertices, or what `gap_behind` says; side: σ = ±1, the axial direction of light in the gap; n1, n2: (...) indices
    before and behind; wavelength: (...) µm, needed by surfaces with a phase.
    If n2 is the same tensor as n1 the surface is a dummy and does not bend.
    """
    return _crossing(_Ray.of(rays), *_cross(surface, _Ray.of(rays), gap, side, n1, n2, wavelength))


def _crossing(before: _Ray, after: _Ray, met: Tensor, passes: Tensor | None, clear: Tensor | None) -> Crossing:
    survives = met if passes is None else met & passes
    return Crossing(
        after.rays(),
        ~met,
        torch.zeros_like(met) if passes is None else met & ~passes,
        torch.zeros_like(after.valid) if clear is None else before.valid & survives & ~clear,
    )


def _cross(surface: Surface, rays: _Ray, gap, side: int, n1: Tensor, n2: Tensor, wavelength: Tensor | None):
    """Rays behind the surface, and which of those before met it, were not totally reflected, pass its apertures."""
    if isinstance(gap, Gap) or surface.before is not None or surface.is_break:
        rays, gap = _approach(surface, rays, gap, side, n1), None
        if surface.is_break:
            return rays, torch.ones_like(rays.valid), None, None
    direction = rays.direction
    x, y, z = rays.position
    arrival = rays.position if gap is None else (x, y, z - gap)
    hit, cosine, met, known, exact = meet(surface, arrival, direction)
    opl = rays.opl
    if opl is not None:
        opl = opl + n1 * _reduced_path(rays.position, hit, direction, gap, side)
    passes = None
    if surface.phase is not None:
        direction, passes, added = _through_phase(surface, hit, direction, cosine, known, exact, n1, n2, wavelength)
        opl = opl if opl is None or added is None else opl + added
    elif surface.is_mirror or n2 is not n1:
        n, norm_squared = normal(surface, hit) if known is None else known
        if surface.is_mirror:
            direction = reflect(direction, n, cosine, norm_squared)
        else:
            sure = None if exact is None else _snell_discriminant(surface, *exact, n1, n2)
            direction, passes = refract(direction, n, cosine, norm_squared, n1, n2, sure)
    survives = met if passes is None else met & passes
    clear = inside(surface.apertures, hit)
    valid = rays.valid & survives
    after = _Ray(
        position=[at if surface.is_plane and i == 2 else torch.where(survives, at, 0.0) for i, at in enumerate(hit)],
        direction=[torch.where(survives, d, axis) for d, axis in zip(direction, (0.0, 0.0, 1.0), strict=True)],
        valid=valid if clear is None else valid & clear,
        opl=opl if opl is None else torch.where(survives, opl, 0.0),
    )
    return after, met, passes, clear


def _approach(surface: Surface, rays: _Ray, gap: Tensor | Gap | None, side: int, n1: Tensor) -> _Ray:
    """Rays told in the axes of the surface; their path less that of the gap along the axis, n1 T σ."""
    position, direction, opl = rays.position, rays.direction, rays.opl
    thickness = gap
    if isinstance(gap, Gap):
        position, direction = point_in(gap.pose, position), direction_in(gap.pose, direction)
        thickness = gap.thickness
    if thickness is not None:
        x, y, z = position
        position = x, y, z - thickness
        opl = opl if opl is None else opl - n1 * (thickness * side)
    if surface.before is not None:
        position, direction = point_in(surface.before, position), direction_in(surface.before, direction)
        if isinstance(surface.before, Turn) and opl is not None:
            opl = opl - surface.before.path
    return _Ray(position, direction, rays.valid, opl)


@torch.no_grad()
def _diffracted_discriminant(surface: Surface, hit, direction, n1: Tensor, n2: Tensor, wavelength) -> Tensor:
    """b² of `diffract` in float64, outside the graph, of a path with the numbers that the rays have it with."""
    path = path_of(surface.phase, None if wavelength is None else wavelength.to(n1.dtype))
    phase = to(surface.phase if path is None else path, dtype=torch.float64)
    n, norm_squared = normal(in_double(surface), hit)
    added = added_path(phase, hit[0], hit[1], wavelength)
    return diffracted_root(direction, n, dot(n, direction), norm_squared, n1.double(), n2.double(), added)


def _through_phase(surface: Surface, hit, direction, cosine, known, exact, n1, n2, wavelength):
    """Direction behind a surface with a phase, whether light passes (None: all does), and the path that is added."""
    kind, phase = kind_of(surface.phase), surface.phase
    if kind.slopes:
        behind = bend_slopes(direction, hit, kind.power(phase, wavelength), n1, n2)
        return behind, None, ideal_path(phase, hit, direction, behind, n1, n2)
    n, norm_squared = normal(surface, hit) if known is None else known
    if kind.flat and surface.is_mirror:
        return reflect(direction, n, dot(n, direction), norm_squared), None, None
    if kind.flat:
        return *refract(direction, n, dot(n, direction), norm_squared, n1, n2), None
    added, mirror = added_path(phase, hit[0], hit[1], wavelength), surface.is_mirror
    sure = None if exact is None else _diffracted_discriminant(surface, *exact, n1, n2, wavelength)
    direction, passes = diffract(direction, n, cosine, norm_squared, n1, n2, added, mirror=mirror, b_squared=sure)
    return direction, passes, added.path


def _reduced_path(start, hit, direction, gap: Tensor | None, side: int) -> Tensor:
    """Path from start (old frame) to hit (new frame) less the axial ray's T σ, without forming either.

    t - T σ = (hit - start)·d + T (N - σ),   N - σ = -σ (L² + M²)/(1 + σ N)
    """
    path = dot([a - b for a, b in zip(hit, start, strict=True)], direction)
    if gap is None:
        return path
    L, M, N = direction
    forward = side * N > 0
    lag = torch.where(forward, -side * (L * L + M * M) / torch.where(forward, 1 + side * N, 1.0), N - side)
    return path + gap * lag


def steps(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    wavelength: Tensor | None = None,
    side: int = 1,
    gap: Tensor | Gap | None = None,
) -> Iterator[Crossing]:
    """Yield what happens at each surface in turn.

    rays: before surfaces[0], in its frame before its pose, or with `gap` in that of the surface before it (mm, or what
    `surface.gap_behind` says of that one); indices: len(surfaces) + 1 media (...), the first before surfaces[0];
    wavelength: (...) µm, which surfaces with a phase need; side: axial direction of light before surfaces[0] (-1 behind
    an odd number of mirrors).
    """
    for before, crossed in _walk(surfaces, rays, indices, wavelength, side, gap):
        yield _crossing(before, *crossed)


def _walk(surfaces: Sequence[Surface], rays: Rays, indices: Sequence[Tensor], wavelength: Tensor | None, side, gap):
    before = _Ray.of(rays)
    for surface, n1, n2 in zip(surfaces, indices[:-1], indices[1:], strict=True):
        crossed = _cross(surface, before, gap, side, n1, n2, wavelength)
        yield before, crossed
        before, gap = crossed[0], gap_behind(surface)
        side = -side if surface.is_mirror else side


def trace_surfaces(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    wavelength: Tensor | None = None,
    side: int = 1,
    gap: Tensor | Gap | None = None,
) -> Rays:
    """The rays behind the last of the surfaces; arguments as for `steps`.

    The compiled trace takes the runs of surfaces that it knows, where it pays: see `compiled.run`.
    """
    if torch.compiler.is_compiling():
        return _eager(surfaces, rays, indices=indices, wavelength=wavelength, side=side, gap=gap)
    first = 0
    for expressible, run in itertools.groupby(surfaces, is_expressible):
        last = first + len(list(run))
        how = {"indices": indices[first : last + 1], "wavelength": wavelength, "side": side, "gap": gap}
        rays = (_fused if expressible else _eager)(surfaces[first:last], rays, **how)
        side = -side if sum(surface.is_mirror for surface in surfaces[first:last]) % 2 else side
        gap, first = gap_behind(surfaces[last - 1]), last
    return rays


def _fused(surfaces: Sequence[Surface], rays: Rays, **how) -> Rays:
    if uses_compiled(rays, how["indices"][0], len(surfaces)):
        end = trace_compiled(surfaces, rays, **how, eager=_eager)
        if end is not None:
            return end
    return _eager(surfaces, rays, **how)


def _eager(surfaces: Sequence[Surface], rays: Rays, *, indices, wavelength=None, side: int, gap) -> Rays:
    after = None
    for _, crossed in _walk(surfaces, rays, indices, wavelength, side, gap):
        after = crossed[0]
    return rays if after is None else after.rays()


def trace_lens(lens: Lens, rays: Rays, wavelength: Tensor) -> Rays:
    """Trace rays from the frame of surface 1 to the image surface.

    wavelength: µm, broadcast against the batch shape of the rays. Returns the rays in the frame of the image.
    """
    return trace_surfaces(sequence_of(lens), rays, indices=media(lens, wavelength), wavelength=wavelength)


def lens_steps(lens: Lens, rays: Rays, wavelength: Tensor) -> Iterator[Crossing]:
    """What happens to rays before surface 1 at every surface after the object; wavelength: (...) µm."""
    return steps(sequence_of(lens), rays, indices=media(lens, wavelength), wavelength=wavelength)


def axial_path(surfaces: Sequence[Surface], indices: Sequence[Tensor], side: int = 1) -> Tensor:
    """Σ n T σ (...) in mm of the axial ray, first to last vertex: add it to `Rays.opl` for the full path."""
    total = torch.zeros_like(indices[0])
    for surface, n in zip(surfaces[:-1], indices[1:-1], strict=True):
        side = -side if surface.is_mirror else side
        total = total + n * surface.thickness * side
    return total
