"""Trace rays through a sequence of surfaces: transfer, intersect, refract or reflect, clip.

The trace is a generator. To record, draw or find where a ray was lost, consume `steps`; to trace on from stored
rays, hand them with the surfaces that are left.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from raytrace import glass
from raytrace.lens import Lens
from raytrace.numerics import dot, safe_sqrt, unit, with_batch_axes
from raytrace.rays import Rays
from raytrace.surface import Surface, inside, intersect, normal
from raytrace.value import value


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


def refract(direction: Tensor, normal: Tensor, norm_squared: Tensor, n1: Tensor, n2: Tensor) -> tuple[Tensor, Tensor]:
    """Snell's law n1 sin θ1 = n2 sin θ2 as a vector, and whether light passes (False: total internal reflection).

        n2 d' = n1 d + sign(n·d) D/(a + b) n,   D = (n2 - n1)(n2 + n1),   a = n1 |n·d|,   b = √(a² + D |n|²)

    direction: (3, ...) unit; normal: (3, ...) of squared length norm_squared (...); n1, n2: (...).
    No 1 - cos² anywhere: equal indices return d exactly, and grazing rays keep their digits. The squared length of
    d' is then brought to 1 within rounding, by a factor that is 1 identically and so is not differentiated.
    """
    cosine = dot(normal, direction)
    a = n1 * cosine.abs()
    D = (n2 - n1) * (n2 + n1)
    b_squared = a * a + D * norm_squared
    passes = b_squared > 0
    b = safe_sqrt(b_squared)
    along_normal = torch.where(cosine < 0, -D, D) / torch.where(passes, a + b, 1.0)
    # An index of 0 is a medium without a real index: nothing passes into it. n1/n2 is 1 exactly for equal indices.
    safe_n2 = torch.where(n2 > 0, n2, 1.0)
    refracted = (n1 / safe_n2) * direction + (along_normal / safe_n2) * normal
    return _renormalise(refracted), passes


def reflect(direction: Tensor, normal: Tensor, norm_squared: Tensor) -> Tensor:
    """Law of reflection d' = d - 2 (n·d) n / |n|²; arguments as for `refract`."""
    return _renormalise(direction - (2 * dot(normal, direction) / norm_squared) * normal)


def _renormalise(direction: Tensor) -> Tensor:
    return direction * (1.5 - 0.5 * dot(direction, direction)).detach()


def cross(surface: Surface, rays: Rays, gap: Tensor | None, side: int, n1: Tensor, n2: Tensor) -> Crossing:
    """Carry rays over the gap before a surface and through the surface.

    rays: in the frame of the surface before, or of this one if gap is None; gap: mm between the two vertices;
    side: σ = ±1, the axial direction of light in the gap; n1, n2: (...) indices before and behind.
    If n2 is the same tensor as n1 the surface is a dummy and does not bend.
    """
    axes = max(surface.batch_axes, n1.dim(), n2.dim(), 0 if gap is None else gap.dim(), len(rays.shape))
    axes = max(axes, rays.position.dim() - 1)
    rays = dataclasses.replace(
        rays, position=with_batch_axes(rays.position, axes), direction=with_batch_axes(rays.direction, axes)
    )
    direction = rays.direction
    arrival = rays.position if gap is None else _shift(rays.position, gap)
    hit, met = intersect(surface, arrival, direction)
    opl = rays.opl
    if opl is not None:
        opl = opl + n1 * _reduced_path(rays.position, hit, direction, gap, side)
    if surface.is_mirror or n2 is not n1:
        n, norm_squared = normal(surface, hit)
        if surface.is_mirror:
            bent, passes = reflect(direction, n, norm_squared), torch.ones_like(met)
        else:
            bent, passes = refract(direction, n, norm_squared, n1, n2)
        direction, survives = bent, met & passes
    else:
        passes, survives = torch.ones_like(met), met
    clear = inside(surface, hit)
    valid = rays.valid & survives
    clipped = torch.zeros_like(valid) if clear is None else valid & ~clear
    axis = torch.zeros_like(direction)
    axis[2] = 1.0
    after = Rays(
        position=torch.where(survives, hit, 0.0),
        direction=torch.where(survives, direction, axis),
        valid=valid & ~clipped,
        opl=opl if opl is None else torch.where(survives, opl, 0.0),
    )
    return Crossing(after, ~met, met & ~passes, clipped)


def _shift(position: Tensor, gap: Tensor) -> Tensor:
    x, y, z = position
    return torch.stack(torch.broadcast_tensors(x, y, z - gap))


def _reduced_path(start: Tensor, hit: Tensor, direction: Tensor, gap: Tensor | None, side: int) -> Tensor:
    """Path from start (old frame) to hit (new frame) less the axial ray's T σ, without forming either.

    t - T σ = (hit - start)·d + T (N - σ),   N - σ = -σ (L² + M²)/(1 + σ N)
    """
    path = dot(hit - start, direction)
    if gap is None:
        return path
    L, M, N = direction
    forward = side * N > 0
    lag = torch.where(forward, -side * (L * L + M * M) / torch.where(forward, 1 + side * N, 1.0), N - side)
    return path + gap * lag


def steps(surfaces: Sequence[Surface], rays: Rays, *, indices: Sequence[Tensor], side: int = 1) -> Iterator[Crossing]:
    """Yield what happens at each surface in turn.

    rays: in the frame of surfaces[0], before it; indices: len(surfaces) + 1 media (...), the first before
    surfaces[0]; side: axial direction of light before it (-1 behind an odd number of mirrors).
    """
    gap = None
    for surface, n1, n2 in zip(surfaces, indices[:-1], indices[1:], strict=True):
        crossing = cross(surface, rays, gap, side, n1, n2)
        yield crossing
        rays, gap = crossing.rays, surface.thickness
        side = -side if surface.is_mirror else side


def trace_surfaces(surfaces: Sequence[Surface], rays: Rays, *, indices: Sequence[Tensor], side: int = 1) -> Rays:
    """The rays behind the last of the surfaces; arguments as for `steps`."""
    for crossing in steps(surfaces, rays, indices=indices, side=side):
        rays = crossing.rays
    return rays


def media(lens: Lens, wavelength: Tensor) -> list[Tensor]:
    """Refractive index behind every surface, object first; positive also behind a mirror.

    wavelength: (...) µm; returns one tensor (...) for each surface of the lens, in the lens's dtype. A medium that
    does not change is the same tensor, which tells `cross` that nothing bends.
    """
    dtype = lens.surfaces[-2].thickness.dtype
    indices: list[Tensor] = []
    medium = None
    for surface in lens.surfaces:
        if medium is None or not (surface.is_mirror or _same_medium(surface.glass, medium)):
            medium = surface.glass
            indices.append(glass.refractive_index(medium, wavelength).to(dtype))
        else:
            indices.append(indices[-1])
    return indices


def _same_medium(a: glass.Glass, b: glass.Glass) -> bool:
    return a is b or (a.formula == b.formula and a.coefficients is b.coefficients)


def trace(lens: Lens, rays: Rays, wavelength: Tensor) -> Rays:
    """Trace rays from the frame of surface 1 to the image surface.

    wavelength: µm, broadcast against the batch shape of the rays. Returns the rays in the frame of the image.
    """
    return trace_surfaces(lens.surfaces[1:], rays, indices=media(lens, wavelength))


def start(position: Tensor, direction: Tensor, opl: Tensor | None = None) -> Rays:
    """Rays from points and directions of any length; what is not finite or has no direction is lost from the start.

    position, direction: (3, ...) mm and any unit; opl: (...) mm or None.
    """
    axes = max(position.dim(), direction.dim()) - 1
    position, direction = torch.broadcast_tensors(with_batch_axes(position, axes), with_batch_axes(direction, axes))
    usable = torch.isfinite(position).all(0) & torch.isfinite(direction).all(0) & (direction != 0).any(0)
    axis = torch.zeros_like(direction)
    axis[2] = 1.0
    return Rays(
        position=torch.where(usable, position, 0.0),
        direction=unit(torch.where(usable, direction, axis)),
        valid=usable,
        opl=opl if opl is None else torch.where(usable, opl, 0.0),
    )


def axial_path(surfaces: Sequence[Surface], indices: Sequence[Tensor], side: int = 1) -> Tensor:
    """Σ n T σ (...) in mm of the axial ray, first to last vertex: add it to `Rays.opl` for the full path."""
    total = torch.zeros_like(indices[0])
    for surface, n in zip(surfaces[:-1], indices[1:-1], strict=True):
        side = -side if surface.is_mirror else side
        total = total + n * surface.thickness * side
    return total
