"""Blur by a kernel that varies over the picture: kernels at nodes of a grid, interpolated between them.

    y(r) = Σ_r′ h(r - r′; r′) x(r′),   h(·; r′) = Σ_k w_k(r′) h_k

w_k(r′) are bilinear weights of the nodes k. Every point of the picture spreads its light by the kernel of its own
place, so that kernels of sum 1 keep the light. Either of two algorithms computes the sum:

- patches: y = Σ_k h_k ∗ (w_k x). A node's weight covers the four cells around it, so that patches overlap by half.
- low rank: y = Σ_j u_j ∗ (a_j x) of the singular value decomposition h_k ≈ Σ_j a_kj u_j, a_j interpolated from a_kj.

Sources: Nagy and O'Leary, SIAM J. Sci. Comput. 19, 1063 (1998); Denis et al., Int. J. Comput. Vis. 115, 253 (2015).
"""

import bisect
import math
from collections.abc import Callable
from typing import TypeAlias

import scipy.fft
import torch
from torch import Tensor

from raytrace.imaging.image import as_picture, extend
from raytrace.maths.numerics import varies

#: Called with the number of convolutions done since the last call, and their total.
Progress: TypeAlias = Callable[[int, int], object]

_RANKS, _SAMPLE = 40, 256  # at most: modes of low rank, and kernels that they are found from


def varying_blur(
    picture: Tensor,
    kernels: Tensor,
    *,
    boundary: str = "reflect",
    tol: float = 0.0,
    progress: Progress | None = None,
) -> Tensor:
    """Images (..., C, H, W) of pictures (..., C, H, W); kernels: (m, n, C, h, w) of odd h and w, at nodes of a grid.

    The nodes are equally spaced from the upper to the lower edge of the picture and from the left to the right one; a
    single row or column of nodes is the same everywhere. boundary: one of `image.EXTENSIONS`, how the picture continues
    beyond its edge. tol: allowed error of low rank, Σ |h - ĥ| / Σ |h| of every kernel; 0: patches alone. Low rank is
    used where no derivative may be requested and where it needs fewer operations. progress: called with the number of
    convolutions done since the last call, and their total.
    Raises ValueError for other shapes.
    """
    picture = as_picture(picture)
    rows, columns = _check(picture, kernels)
    down, right = kernels.shape[-2] // 2, kernels.shape[-1] // 2
    # Extended by as much as a kernel reaches: `extend` puts half of it behind the last row and half before the first.
    large = extend(picture, (rows + 2 * down, columns + 2 * right), boundary=boundary)
    large = torch.roll(large, (down, right), (-2, -1))
    weights = [bilinear(count, reach, nodes, like=kernels) for count, reach, nodes in
               ((rows, down, kernels.shape[0]), (columns, right, kernels.shape[1]))]  # fmt: skip
    differentiated = varies(picture) or varies(kernels)
    if tol > 0 and not differentiated and _operations_of_rank(large, 1) < _operations_of_patches(large, kernels):
        low_rank = _modes(kernels, tol)
        if low_rank and _operations_of_rank(large, len(low_rank[0])) < _operations_of_patches(large, kernels):
            return _by_rank(large, *low_rank, weights, progress)
    return _by_patches(large, kernels, weights, progress, in_place=not differentiated)


def _check(picture: Tensor, kernels: Tensor) -> tuple[int, int]:
    if kernels.dim() != 5 or kernels.shape[-1] % 2 == 0 or kernels.shape[-2] % 2 == 0:
        raise ValueError(
            f"kernels of shape {tuple(kernels.shape)}: expected (m, n, C, h, w) at m × n nodes, with odd h and w"
        )
    if picture.dim() < 3 or kernels.shape[2] not in (1, picture.shape[-3]):
        raise ValueError(
            f"a picture of shape {tuple(picture.shape)} and kernels of {kernels.shape[2]} channels: expected "
            "(..., C, H, W) of as many"
        )
    return picture.shape[-2], picture.shape[-1]


def bilinear(count: int, reach: int, nodes: int, *, like: Tensor) -> Tensor:
    """Weights (nodes, reach + count + reach) of nodes from edge to edge of `count` pixels between `reach` more."""
    if nodes == 1:
        return like.new_ones(1, count + 2 * reach)
    place = (torch.arange(-reach, count + reach, dtype=like.dtype, device=like.device) + 0.5) * ((nodes - 1) / count)
    node = torch.arange(nodes, dtype=like.dtype, device=like.device)[:, None]
    return (1 - (place.clamp(0, nodes - 1) - node).abs()).clamp_min(0)


def _spans(weights: Tensor) -> list[tuple[int, int, int]]:
    """Number of each node with a weight, and first and last + 1 position at which it has one."""
    lit = enumerate(torch.nonzero(row)[:, 0] for row in weights)
    return [(node, int(places[0]), int(places[-1]) + 1) for node, places in lit if len(places)]


def _by_patches(
    large: Tensor, kernels: Tensor, weights: list[Tensor], progress: Progress | None, *, in_place: bool
) -> Tensor:
    h, w = kernels.shape[-2:]
    shape = large.shape[-2] + h - 1, large.shape[-1] + w - 1
    total = large.new_zeros(*large.shape[:-2], *shape)
    down, across = map(_spans, weights)
    for k, top, bottom in down:
        for n, left, right in across:
            window = weights[0][k, top:bottom, None] * weights[1][n, left:right]
            part = large[..., top:bottom, left:right] * window.to(large.dtype)
            part = _convolved(part, kernels[k, n].to(large.dtype))
            rows, columns = part.shape[-2:]
            if in_place:
                total[..., top : top + rows, left : left + columns] += part
            else:
                beyond = left, shape[1] - left - columns, top, shape[0] - top - rows
                total = total + torch.nn.functional.pad(part, beyond)
            if progress is not None:
                progress(1, len(down) * len(across))
    return _inner(total, h, w)


def _inner(full: Tensor, h: int, w: int) -> Tensor:
    """Without the extension and the reach of the kernels on all sides."""
    return full[..., h - 1 : full.shape[-2] - h + 1, w - 1 : full.shape[-1] - w + 1]


def _convolved(picture: Tensor, kernel: Tensor) -> Tensor:
    """The whole linear convolution (..., H + h - 1, W + w - 1)."""
    shape = [a + b - 1 for a, b in zip(picture.shape[-2:], kernel.shape[-2:], strict=True)]
    fast = [scipy.fft.next_fast_len(n, real=True) for n in shape]
    product = torch.fft.rfft2(picture, s=fast) * torch.fft.rfft2(kernel, s=fast)
    return torch.fft.irfft2(product, s=fast)[..., : shape[0], : shape[1]]


def _modes(kernels: Tensor, tol: float) -> tuple[Tensor, Tensor] | None:
    """Kernels u_j (J, h, w) and shares a (J, m, n, C) that give all kernels to `tol`; None where these are too many.

    The modes are singular vectors of at most 256 of the kernels, evenly spread; the error is checked for all.
    """
    flat = kernels.detach().flatten(3).flatten(0, 2)
    some = flat[:: math.ceil(len(flat) / _SAMPLE)]
    modes = torch.linalg.svd(some, full_matrices=False)[2][:_RANKS]
    shares, allowed = flat @ modes.T, tol * flat.abs().sum(-1)

    def suffices(count: int) -> bool:
        close = shares[:, :count] @ modes[:count]
        return bool(((flat - close).abs().sum(-1) <= allowed).all())

    if not suffices(len(modes)):
        return None
    count = 1 + bisect.bisect_left(range(1, len(modes)), True, key=suffices)
    # As much light as the kernels have.
    scale = flat.sum(-1) / (shares[:, :count] @ modes[:count].sum(-1))
    kept = shares[:, :count] * scale[:, None]
    return modes[:count].reshape(count, *kernels.shape[-2:]), kept.T.reshape(count, *kernels.shape[:3])


def _operations_of_rank(large: Tensor, count: int) -> float:
    pixels = large.shape[-2] * large.shape[-1]
    return (count + 1) * pixels * math.log2(pixels)


def _operations_of_patches(large: Tensor, kernels: Tensor) -> float:
    (m, n), (h, w) = kernels.shape[:2], kernels.shape[-2:]
    sides = [2 * size / max(nodes - 1, 2) + reach for size, nodes, reach in
             zip(large.shape[-2:], (m, n), (h, w), strict=True)]  # fmt: skip
    return 2 * m * n * sides[0] * sides[1] * math.log2(sides[0] * sides[1])


def _by_rank(large: Tensor, modes: Tensor, shares: Tensor, weights: list[Tensor], progress: Progress | None) -> Tensor:
    h, w = modes.shape[-2:]
    shape = large.shape[-2] + h - 1, large.shape[-1] + w - 1
    fast = [scipy.fft.next_fast_len(n, real=True) for n in shape]
    channels = []
    for c in range(large.shape[-3]):
        total = torch.zeros(())
        for mode, share in zip(modes, shares[..., min(c, shares.shape[-1] - 1)], strict=True):
            weight = (weights[0].T @ share @ weights[1]).to(large.dtype)
            spectrum = torch.fft.rfft2(large[..., c, :, :] * weight, s=fast)
            total = total + spectrum * torch.fft.rfft2(mode.to(large.dtype), s=fast)
            if progress is not None:
                progress(1, len(modes) * large.shape[-3])
        channels.append(_inner(torch.fft.irfft2(total, s=fast)[..., : shape[0], : shape[1]], h, w))
    return torch.stack(channels, -3)
