"""Gradients of sums over any number of rays within a memory budget; see raytrace/tracing/streaming.py."""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import safe_divide
from raytrace.system.lens import Lens, field_points
from raytrace.tracing.spot import where_lit
from raytrace.tracing.streaming import MAX_BYTES, Progress, Shot, chunk_size, hits, pupil_chunks, shots_of, stream_spot


def stream_gradient(
    merit: Callable[..., Tensor], leaves: Sequence[Tensor], chunks: Iterator
) -> tuple[Tensor, list[Tensor]]:
    """Σ merit(chunk) and its derivatives in the leaves, one graph at a time: memory is that of one chunk.

    merit: from a chunk to a scalar, a new graph from the leaves each time. Sums are float64, derivatives come back in
    the dtype of their leaves; 0 for a leaf that merit does not depend on.
    """
    total = leaves[0].new_zeros((), dtype=torch.float64)
    sums = [torch.zeros_like(leaf, dtype=torch.float64) for leaf in leaves]
    for chunk in chunks:
        with torch.enable_grad():
            found = merit(chunk)
        parts = torch.autograd.grad(found, leaves, allow_unused=True)
        total = total + found.detach()
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

        R² = (1/n) Σ |q - q̄|²,   dR² = (2/n) Σ (q - q̄)·dq:  q̄ may be held, for Σ (q - q̄) = 0

    lens: made from the leaves by differentiable operations; fields: (2, F), y, or (x, y), and wavelengths: µm, the
    lens's own by default; weights: (F, W), alike by default. The rays are traced twice: for the centroids, then for the
    sum. The graph is cut at the numbers of the lens that rays see, so what made the lens is gone through once, not for
    every chunk.
    empty: what the mean is if a spot of any weight has no rays: "nan", the derivatives those of the other spots, or
    "error", which raises EmptySpot.
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
    shots, seen, cut = _cut(shots)
    like = lens.surfaces[-2].thickness
    size = chunk_size(shots[0], max_bytes, recorded=True)
    centroids = torch.where(light.rays > 0, light.centroid, 0.0).flatten(1).to(like.dtype)

    def merit(part: tuple[int, Tensor]) -> Tensor:
        k, points = part
        found, valid = hits(shots[k], points)
        offset = (found - centroids[:, k, None]) * valid.to(found.dtype)
        return share[k] * (offset * offset).sum(dtype=torch.float64)

    def parts() -> Iterator[tuple[int, Tensor]]:
        for points in pupil_chunks(rays, size, sampling=sampling, seed=seed, like=like):
            yield from ((k, points) for k in range(len(shots)))
            if progress is not None:
                progress(points.shape[1] * len(shots))

    total, slopes = stream_gradient(merit, cut, parts())
    found = torch.autograd.grad(seen, leaves, slopes, allow_unused=True)
    return total * whole, [torch.zeros_like(leaf) if g is None else g for leaf, g in zip(leaves, found, strict=True)]


def _cut(shots: list[Shot]) -> tuple[list[Shot], list[Tensor], list[Tensor]]:
    """The shots with every tensor that is differentiated replaced by a new leaf; those tensors, and the leaves.

    A tensor that stands in several places stays one: an index that is the one before tells the trace nothing bends.
    """
    found, structure = pytree.tree_flatten(shots)
    seen = {id(t): t for t in found if isinstance(t, Tensor) and t.requires_grad}
    cut = {key: t.detach().requires_grad_() for key, t in seen.items()}
    shots = pytree.tree_unflatten([cut.get(id(t), t) for t in found], structure)
    return shots, list(seen.values()), list(cut.values())
