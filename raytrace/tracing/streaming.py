"""Streaming: spots, and gradients of sums, over any number of rays within a memory budget.

Rays are traced in chunks of which only sums are stored: moments about means, merged without cancellation (Chan, Golub
and LeVeque 1979), pixels in float64, gradients. The size of a chunk changes a result by rounding alone.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import safe_divide, safe_sqrt, to, value
from raytrace.maths.sampling import random, with_rim
from raytrace.system.lens import Lens, field_points, media
from raytrace.system.rays import Rays
from raytrace.system.surface import is_searched
from raytrace.tracing.compiled import WORTH_COMPILING, prepare
from raytrace.tracing.launch import is_at_infinity, launch, with_ray_aiming
from raytrace.tracing.spot import where_lit
from raytrace.tracing.trace import aiming_of, sequence_of, trace_surfaces

MAX_BYTES = 256 * 2**20
_CHUNK = {"cpu": 2**15}  # rays whose temporaries stay in the caches of a core
_CHUNK_ELSEWHERE = 2**22  # rays that fill an accelerator
_FEWEST = 256  # rays of a chunk: with fewer, overhead dominates
_PILOT = 2**16  # first rays: largest distances are measured from their centroid
_SOBOL_BITS = torch.quasirandom.SobolEngine.MAXBIT
_SOBOL_POINTS = 2**_SOBOL_BITS
#: Bytes of temporaries a ray takes at most, in float64 by the eager trace; measured, see docs/reference/streaming.md.
_BYTES_OF_TRACE, _BYTES_OF_SEARCH, _BYTES_OF_AIMED_SURFACE, _BYTES_OF_RECORDED_SURFACE = 768, 5632, 768, 512

Progress = Callable[[int], object]


@value
class Beam:
    """The rays of one field and wavelength as an affine function of the pupil point p = (p_x, p_y).

        position = place (1, p_x, p_y),   direction ∝ (slope (1, p_x, p_y), 1)

    place: (3, 3) mm; slope: (2, 3), or of a plane wave its direction (3,).
    """

    place: Tensor
    valid: Tensor
    slope: Tensor


class Shot(NamedTuple):
    """The rays of one field (2,) and wavelength () µm, without their pupil points. beam: None if rays are aimed."""

    lens: Lens
    field: Tensor
    wavelength: Tensor
    indices: list[Tensor]
    beam: Beam | None


@value
class Moments:
    """Number of points, mean distance from a reference (2, ...) mm, and sums of products about it (3, ...) mm².

    scatter: Σ (x - x̄)², Σ (x - x̄)(y - ȳ), Σ (y - ȳ)². All float64.
    """

    count: Tensor
    mean: Tensor
    scatter: Tensor


@value
class StreamedSpot:
    """Statistics of a spot whose rays are not stored; entries (...), float64, mm; nan where no ray arrives.

    centroid: (2, ...); covariance: (3, ...) xx, xy, yy in mm²; mean_square_radius, rms_radius: about the centroid, as
    in `raytrace.tracing.spot.Spot`; rays: number that arrive; launched: number launched for each entry.
    geometric_radius: distance from the centroid of the ray farthest from the centroid of the first 65,536 rays: exact
    for so many, else at most the largest distance, which is at most geometric_bound.
    """

    centroid: Tensor
    covariance: Tensor
    mean_square_radius: Tensor
    rms_radius: Tensor
    geometric_radius: Tensor
    geometric_bound: Tensor
    rays: Tensor
    launched: int


def pupil_chunks(
    rays: int, size: int, *, sampling: str = "sobol", seed: int = 0, like: Tensor, cut: int | None = None
) -> Iterator[Tensor]:
    """The points of `sampling.sobol` or `sampling.random` in chunks (2, ≤ size) of `like`'s dtype and device.

    size: a power of two; cut: a number of rays at which a chunk also ends. After all 2³⁰ Sobol points, those of the
    next seed follow. Raises ValueError for another sampling.
    """
    if sampling not in ("sobol", "random"):
        raise ValueError(f"sampling {sampling!r} cannot be continued from any number of points: use sobol or random")
    generator = torch.Generator().manual_seed(seed)
    first, blocks = 0, dict[int, tuple[Tensor, Tensor]]()
    while first < rays:
        last = min((first // size + 1) * size, rays)
        last = cut if cut is not None and first < cut < last else last
        if sampling == "random":
            yield random(last - first, generator=generator, dtype=like.dtype, device=like.device)[0]
        else:
            block = first // _SOBOL_POINTS
            if block not in blocks:
                blocks = {block: _sobol_table(size, seed + block, like.device)}
            table, steps = blocks[block]
            base = first // size * size
            bits = table[:, first - base : last - base] ^ _sobol_place(base % _SOBOL_POINTS, steps, table)
            radius, angle = bits.to(like.dtype).mul_(2.0**-_SOBOL_BITS)
            radius, angle = radius.sqrt_(), angle.mul_(2 * math.pi)
            yield torch.stack([torch.cos(angle), torch.sin(angle)]).mul_(radius)
        first = last


def _sobol_table(size: int, seed: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The first `size` (a power of two) scrambled Sobol points as integers (2, size), and the steps between blocks.

    Point i is the shift ⊕ the direction numbers V_m of the bits m of its Gray code i ⊕ (i >> 1): linear over the bits
    of i, each of which adds Y_m = V_m ⊕ V_{m-1}. A block of 2^k points is the first one ⊕ one number.
    """
    engine = torch.quasirandom.SobolEngine(2, scramble=True, seed=seed)
    numbers = engine.sobolstate.to(torch.int32)
    steps = numbers ^ torch.nn.functional.pad(numbers[:, :-1], (1, 0))
    table = engine.shift.to(torch.int32)[:, None]
    for step in steps.unbind(1)[: size.bit_length() - 1]:
        table = torch.cat([table, table ^ step[:, None]], 1)
    return table.to(device), steps.to(device)


def _sobol_place(first: int, steps: Tensor, table: Tensor) -> Tensor:
    place = table.new_zeros(2, 1)
    for bit in range(first.bit_length()):
        if first >> bit & 1:
            place = place ^ steps[:, bit : bit + 1]
    return place


def shot(lens: Lens, field: Tensor, wavelength: Tensor, *, ray_aiming: str | None = None) -> Shot:
    """The shot of one field (2,) and wavelength () µm; three rays in float64 define the beam."""
    lens, beam = with_ray_aiming(lens, ray_aiming), None
    if aiming_of(lens) == "off" or lens.fields.telecentric:
        exact = to(lens, dtype=torch.float64)
        corners = field.new_tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        rays = launch(exact, corners, fields=field.double()[:, None], wavelengths=wavelength[None], ray_aiming="off")
        position, direction, valid = rays.position[:, 0, 0], rays.direction[:, 0, 0], rays.valid[0, 0].all()
        plane = is_at_infinity(lens)
        # f(0, 0), ∂f/∂p_x, ∂f/∂p_y of an affine f at (0, 0), (1, 0) and (0, 1)
        place, slope = (
            torch.cat([f[:, :1], f[:, 1:] - f[:, :1]], 1)
            for f in (position, direction[:2] if plane else direction[:2] / direction[2])
        )
        beam = Beam(place, valid, direction[:, 0] if plane else slope)
        beam = to(beam, dtype=lens.surfaces[-2].thickness.dtype)
    return Shot(lens, field, wavelength, media(lens, wavelength), beam)


def start(shot: Shot, pupil: Tensor) -> Rays:
    """The rays of `raytrace.tracing.launch.launch` through pupil points (2, P), path apart: batch shape (P,)."""
    if shot.beam is None:
        rays = launch(shot.lens, pupil, fields=shot.field[:, None], wavelengths=shot.wavelength[None])
        return Rays(rays.position[:, 0, 0], rays.direction[:, 0, 0], rays.valid[0, 0])
    beam = shot.beam
    position = torch.addmm(beam.place[:, :1], beam.place[:, 1:], pupil)
    if beam.slope.dim() == 1:
        direction = beam.slope[:, None].expand_as(position)
    else:
        x, y = torch.addmm(beam.slope[:, :1], beam.slope[:, 1:], pupil)
        N = torch.rsqrt(torch.addcmul(torch.addcmul(torch.ones_like(x), x, x), y, y))
        direction = torch.stack([x * N, y * N, N])
    return Rays(position, direction, beam.valid.expand(pupil.shape[1]))


def hits(shot: Shot, pupil: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays through pupil points (2, P) meet the image, (2, P) mm, and whether they arrive (P,)."""
    rays = start(shot, pupil)
    rays = trace_surfaces(sequence_of(shot.lens), rays, indices=shot.indices, wavelength=shot.wavelength)
    return rays.position[:2], rays.valid


def chunk_size(shot: Shot, max_bytes: float, *, kept: int = 0, recorded: bool = False) -> int:
    """Rays of a chunk, a power of two, whose temporaries stay within max_bytes less those `kept` for results.

    recorded: whether a graph is recorded. Raises ValueError for fewer than 256 rays.
    """
    per_ray = bytes_per_ray(shot, recorded=recorded)
    most = int(max_bytes - kept) // per_ray
    if most < _FEWEST:
        raise ValueError(
            f"max_bytes {max_bytes:g} is too little: {_FEWEST} rays of {per_ray} bytes each, and {kept} bytes of "
            f"results, are the least; give {kept + _FEWEST * per_ray} or more"
        )
    device = shot.lens.surfaces[-2].thickness.device.type
    return min(1 << (most.bit_length() - 1), _CHUNK.get(device, _CHUNK_ELSEWHERE))


def bytes_per_ray(shot: Shot, *, recorded: bool = False) -> int:
    """Bytes of temporaries a ray takes at most; all rays of an asphere may need its bracketed search."""
    surfaces = shot.lens.surfaces
    aspheric = sum(map(is_searched, surfaces))
    total = _BYTES_OF_TRACE + (_BYTES_OF_SEARCH if aspheric else 0)
    if recorded:
        total += _BYTES_OF_RECORDED_SURFACE * (len(surfaces) + aspheric)
    return total if shot.beam is not None else total + _BYTES_OF_AIMED_SURFACE * (shot.lens.stop + 1)


def moments(points: Tensor, valid: Tensor, reference: Tensor) -> Moments:
    """Moments of points (2, P) where valid, from a reference (2,) mm near them."""
    mask = valid.to(points.dtype)
    count = mask.sum(dtype=torch.float64)
    offset = (points - reference[:, None]) * mask
    mean = safe_divide(offset.sum(1, dtype=torch.float64), count)
    offset = (offset - mean.to(points.dtype)[:, None]) * mask
    # A second pass removes the rounding error of the mean.
    rest = safe_divide(offset.sum(1, dtype=torch.float64), count)
    x, y = offset
    scatter = torch.stack([(a * b).sum(dtype=torch.float64) for a, b in ((x, x), (x, y), (y, y))])
    used = mean.to(points.dtype).double()
    return Moments(count, used + rest, scatter - count * _products(rest))


def merge(a: Moments, b: Moments) -> Moments:
    """Moments of both sets of points, from one reference (Chan, Golub and LeVeque 1979).

    mean = x̄_a + δ n_b/n,   scatter = S_a + S_b + δδ n_a n_b/n,   δ = x̄_b - x̄_a
    """
    count = a.count + b.count
    share = safe_divide(b.count, count)
    step = b.mean - a.mean
    return Moments(count, a.mean + share * step, a.scatter + b.scatter + a.count * share * _products(step))


def _products(v: Tensor) -> Tensor:
    return torch.stack([v[0] * v[0], v[0] * v[1], v[1] * v[1]])


def nothing(like: Tensor, batch: Sequence[int] = ()) -> Moments:
    zeros = like.new_zeros(6, *batch, dtype=torch.float64)
    return Moments(zeros[0], zeros[1:3], zeros[3:])


class _Far(NamedTuple):
    """The point (2,) farthest from a reference (2,), and the square of its distance ()."""

    reference: Tensor
    point: Tensor
    square: Tensor

    def or_of(self, points: Tensor, valid: Tensor) -> "_Far":
        x, y = (points - self.reference[:, None]) * valid.to(points.dtype)
        square, place = torch.addcmul(x * x, y, y).max(0)
        farther, point = square > self.square, points.index_select(1, place[None])[:, 0]
        return _Far(self.reference, torch.where(farther, point, self.point), torch.where(farther, square, self.square))


def stream_spot(lens: Lens, rays: int, **conditions: Any) -> StreamedSpot:
    """Spot (F, W) of that many rays for each field and wavelength; conditions: as for `stream_spots`."""
    return stream_spots(lens, rays, **conditions)[0]


@torch.no_grad()
def stream_spots(
    lens: Lens,
    rays: int,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    wavelength_weights: Tensor | None = None,
    sampling: str = "sobol",
    seed: int = 0,
    rim: int = 0,
    ray_aiming: str | None = None,
    max_bytes: int = MAX_BYTES,
    progress: Progress | None = None,
    empty: str = "nan",
) -> tuple[StreamedSpot, StreamedSpot]:
    """Spots (F, W), and those (F,) of all wavelengths together by their weights. No derivatives.

    fields: (2, F) and wavelengths: (W,) µm as for `launch`; sampling: "sobol" or "random"; rim: number of rays on the
    rim that count for the largest radius alone, as in `sampling.with_rim`; max_bytes: of additional memory; progress:
    called with the number of rays traced since the last call; empty: as for `spot_of`.
    """
    shots, shape, weights = shots_of(lens, rays, fields, wavelengths, wavelength_weights, ray_aiming)
    like = lens.surfaces[-2].thickness
    size = chunk_size(shots[0], max_bytes)
    chunks = partial(pupil_chunks, size=size, sampling=sampling, seed=seed, like=like)
    # The centroids of the first rays: of every shot, and of all wavelengths of its field.
    first, axis = [nothing(like)] * len(shots), like.new_zeros(2)
    for part in chunks(min(rays, _PILOT)):
        first = [merge(m, moments(*hits(s, part), axis)) for m, s in zip(first, shots, strict=True)]
    joint = _of_colours(stacked(first, shape), weights).mean
    references = [(m.mean.to(like.dtype), joint[:, k // shape[1]].to(like.dtype)) for k, m in enumerate(first)]
    sums = [nothing(like)] * len(shots)
    far = [[_Far(r, r, like.new_zeros(())) for r in both] for both in references]
    if rim:
        edge = with_rim(like.new_zeros(2, 0), like.new_zeros(0), rim)[0]
        far = [[farthest.or_of(*hits(s, edge)) for farthest in both] for s, both in zip(shots, far, strict=True)]
    for part in chunks(rays):
        for k, s in enumerate(shots):
            landing, valid = hits(s, part)
            sums[k] = merge(sums[k], moments(landing, valid, far[k][0].reference))
            alone = far[k][0].or_of(landing, valid)
            far[k] = [alone, alone if shape[1] == 1 else far[k][1].or_of(landing, valid)]
            if progress is not None:
                progress(part.shape[1])
    each = stacked(sums, shape)
    apart = torch.stack([alone.double() - joint.double() for alone, joint in references], 1).unflatten(1, shape)
    whole = _of_colours(Moments(each.count, each.mean + apart, each.scatter), weights)
    reached = each.count.to(torch.int64)
    return (
        _spot(each, [alone for alone, _ in far], shape, reached, rays, empty),
        _spot(whole, [joint for _, joint in far], shape, reached.sum(-1), rays * shape[1], empty),
    )


def shots_of(
    lens: Lens,
    rays: int,
    fields: Tensor | None,
    wavelengths: Tensor | None,
    wavelength_weights: Tensor | None,
    ray_aiming: str | None,
) -> tuple[list[Shot], tuple[int, int], Tensor]:
    """Shots of fields × wavelengths, those numbers, and the weights (W,) of the wavelengths, which sum to 1."""
    if rays * len(lens.surfaces) >= WORTH_COMPILING:
        prepare()  # a chunk alone would not be worth it
    fields = torch.stack([lens.fields.x, lens.fields.y]) if fields is None else fields
    weights = lens.wavelength_weights if wavelengths is None and wavelength_weights is None else wavelength_weights
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    weights = torch.ones_like(wavelengths) if weights is None else weights
    shots = [shot(lens, f, w, ray_aiming=ray_aiming) for f in fields.unbind(1) for w in wavelengths.unbind(0)]
    return shots, (fields.shape[1], len(wavelengths)), (weights / weights.sum()).double()


def stacked(parts: Sequence[Moments], shape: Sequence[int]) -> Moments:
    tensors = ([m.count for m in parts], [m.mean for m in parts], [m.scatter for m in parts])
    return Moments(*(torch.stack(tensor, -1).unflatten(-1, shape) for tensor in tensors))


def _of_colours(each: Moments, weights: Tensor) -> Moments:
    """Moments (F,) of all wavelengths of (F, W), each counting by its weight."""
    whole = nothing(weights, each.count.shape[:-1])
    for w, weight in enumerate(weights.unbind(0)):
        whole = merge(whole, Moments(weight * each.count[..., w], each.mean[..., w], weight * each.scatter[..., w]))
    return whole


def _spot(
    m: Moments, far: Sequence[_Far], shape: Sequence[int], rays: Tensor, launched: int, empty: str
) -> StreamedSpot:
    covariance = safe_divide(m.scatter, m.count)
    square = covariance[0] + covariance[2]
    joint = m.mean.dim() == 2
    reference, point, largest = (torch.stack(t, -1).unflatten(-1, shape).double() for t in zip(*far, strict=True))
    moved = m.mean[..., None] if joint else m.mean
    radius = torch.linalg.vector_norm(point - reference - moved, dim=0)
    bound = torch.maximum(safe_sqrt(largest) + torch.linalg.vector_norm(moved, dim=0), radius)
    if joint:
        reference, radius, bound = reference[..., 0], radius.amax(-1), bound.amax(-1)
    figures = reference + m.mean, covariance, square, safe_sqrt(square), radius, bound
    centroid, covariance, square, rms, radius, bound = where_lit(m.count > 0, *figures, empty=empty)
    return StreamedSpot(centroid, covariance, square, rms, radius, bound, rays, launched)


def stream_gradient(
    merit: Callable[..., Tensor], leaves: Sequence[Tensor], chunks: Iterator
) -> tuple[Tensor, list[Tensor]]:
    """Σ merit(chunk), float64, and its derivatives in the leaves, in their dtypes, with one graph at a time.

    merit: from a chunk to a scalar, a new graph from the leaves each time; leaves it does not depend on have 0.
    """
    total = leaves[0].new_zeros((), dtype=torch.float64)
    sums = [torch.zeros_like(leaf, dtype=torch.float64) for leaf in leaves]
    for chunk in chunks:
        with torch.enable_grad():
            term = merit(chunk)
        parts = torch.autograd.grad(term, leaves, allow_unused=True)
        total = total + term.detach()
        sums = [s if part is None else s + part for s, part in zip(sums, parts, strict=True)]
    return total, [s.to(leaf.dtype) for s, leaf in zip(sums, leaves, strict=True)]


def mean_square_gradient(
    lens: Lens,
    leaves: Sequence[Tensor],
    rays: int,
    *,
    fields: Tensor | Sequence | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    weights: Tensor | None = None,
    sampling: str = "sobol",
    seed: int = 0,
    ray_aiming: str | None = None,
    max_bytes: int = MAX_BYTES,
    progress: Progress | None = None,
    empty: str = "nan",
) -> tuple[Tensor, list[Tensor]]:
    """Mean square spot radius in mm², averaged over fields and wavelengths, and its first derivatives in the leaves.

        R² = (1/n) Σ |q - q̄|²,   dR² = (2/n) Σ (q - q̄)·dq, for Σ (q - q̄) = 0

    lens: made from the leaves by differentiable operations; fields: (2, F), y, or (x, y), and wavelengths: µm, the
    lens's by default; weights: (F, W), equal by default. The rays are traced twice: for the centroids and for the sum.
    The graph is cut at the numbers of the lens that rays depend on, so that the part before is differentiated once.
    empty: the mean where a weighted spot has no rays: "nan", with the derivatives of the other spots, or "error",
    which raises EmptySpot.
    """
    fields = None if fields is None else field_points(fields, like=lens.fields.y)
    wavelengths = None if wavelengths is None else torch.as_tensor(wavelengths).to(lens.wavelengths)
    common = {"sampling": sampling, "seed": seed, "max_bytes": max_bytes, "progress": progress}
    conditions = {"fields": fields, "wavelengths": wavelengths, "ray_aiming": ray_aiming}
    light = stream_spot(lens, rays, **conditions, **common)
    share = torch.ones_like(light.rms_radius) if weights is None else weights
    (whole,) = where_lit(((light.rays > 0) | (share == 0)).all(), torch.ones_like(share[0, 0]), empty=empty)
    share = safe_divide(share / share.sum(), light.rays).flatten()
    with torch.enable_grad():
        shots = shots_of(lens, rays, fields, wavelengths, None, ray_aiming)[0]
    # Each differentiated tensor becomes one leaf wherever it occurs: the trace skips a surface between equal indices.
    parts, structure = pytree.tree_flatten(shots)
    seen = {id(t): t for t in parts if isinstance(t, Tensor) and t.requires_grad}
    cut = {key: t.detach().requires_grad_() for key, t in seen.items()}
    shots = pytree.tree_unflatten([cut.get(id(t), t) for t in parts], structure)
    like = lens.surfaces[-2].thickness
    size = chunk_size(shots[0], max_bytes, recorded=True)
    centroids = torch.where(light.rays > 0, light.centroid, 0.0).flatten(1).to(like.dtype)

    def merit(part: tuple[int, Tensor]) -> Tensor:
        k, points = part
        landing, valid = hits(shots[k], points)
        offset = (landing - centroids[:, k, None]) * valid.to(landing.dtype)
        return share[k] * (offset * offset).sum(dtype=torch.float64)

    def chunks() -> Iterator[tuple[int, Tensor]]:
        for points in pupil_chunks(rays, size, sampling=sampling, seed=seed, like=like):
            yield from ((k, points) for k in range(len(shots)))
            if progress is not None:
                progress(points.shape[1] * len(shots))

    total, slopes = stream_gradient(merit, list(cut.values()), chunks())
    gradients = torch.autograd.grad(list(seen.values()), leaves, slopes, allow_unused=True)
    return total * whole, [torch.zeros_like(t) if g is None else g for t, g in zip(leaves, gradients, strict=True)]
