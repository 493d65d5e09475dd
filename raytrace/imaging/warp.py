"""Distortion of pictures: every pixel of the image sees a quadrilateral of the picture, and records its mean light.

    y(r) = Σ_q x(q) |Q(r) ∩ q| / |Q(r)|

Pixels q of the picture are squares of constant light, and neighbouring quadrilaterals Q share an edge: all weights are
positive, and a pixel gives its light times the area of its image. So no light is negative, lost or created.

The area is taken along the rows, then along the columns. Between both, column c of the image and row v of the picture
meet where the line of the column crosses the row: the product of the two widths is the Jacobian of the map. Source:
Catmull and Smith, Computer Graphics (SIGGRAPH) 14, 279 (1980).
"""

import torch
from torch import Tensor

_NARROW = 1e-6  # pixels: quadrilaterals are at least so wide
_AT_ONCE = 2**16  # pixels of a channel at once: their sums stay in the processor's cache


def resampled(picture: Tensor, places: Tensor, boundary: str) -> Tensor:
    """Pictures (..., C, H, W) as seen by pixels centred at columns and rows (2, H, W) of the picture.

    boundary: "reflect" continues the picture by its mirror image, others by 0. Differentiable in picture and places.
    """
    lines = _edges(places)
    picture = _means(picture, _crossings(*lines), boundary)
    rows = _edges(places[1].mT)
    return _means(picture.mT, rows, boundary).mT


def _edges(places: Tensor) -> Tensor:
    """Edges (..., H, W + 1) of pixels at places (..., H, W): midway between them, linear beyond the first and last."""
    if places.shape[-1] == 1:
        return torch.cat([places - 0.5, places + 0.5], -1)
    middle = 0.5 * (places[..., 1:] + places[..., :-1])
    return torch.cat([2 * places[..., :1] - middle[..., :1], middle, 2 * places[..., -1:] - middle[..., -1:]], -1)


def _crossings(u: Tensor, v: Tensor) -> Tensor:
    """Columns (H, W) at which lines through columns u and rows v (H, W) cross the rows 0, 1, … H - 1."""
    count = v.shape[-2]
    if count == 1:
        return u
    u, v = u.mT.contiguous(), v.mT.contiguous()
    row = torch.arange(count, dtype=v.dtype, device=v.device).expand(v.shape).contiguous()
    above = torch.searchsorted(v.detach(), row).clamp(1, count - 1)
    (u_0, u_1), (v_0, v_1) = ([line.gather(-1, above - k) for k in (1, 0)] for line in (u, v))
    return (u_0 + (row - v_0) / _wide(v_1 - v_0) * (u_1 - u_0)).mT


def _means(picture: Tensor, edges: Tensor, boundary: str) -> Tensor:
    """Mean light (..., H, W) between neighbouring edges (H, W + 1) of columns of pictures (..., H, W)."""
    lines = max(1, _AT_ONCE // picture.shape[-1])
    pairs = zip(picture.split(lines, -2), edges.split(lines, -2), strict=True)
    return torch.cat([_means_of_lines(*pair, boundary) for pair in pairs], -2)


def _means_of_lines(picture: Tensor, edges: Tensor, boundary: str) -> Tensor:
    """The same of some of the rows."""
    count, light = picture.shape[-1], picture.double().contiguous()  # sums over a row, whose differences lose digits
    so_far = torch.nn.functional.pad(light.cumsum(-1), (1, 0))
    place = edges + 0.5  # pixel k lies from k to k + 1
    if boundary == "reflect":
        periods = (place.detach() / (2 * count)).floor()
        place = place - 2 * count * periods
        mirrored = place > count
        place = torch.where(mirrored, 2 * count - place, place)
    place = place.clamp(0, count)
    pixel = place.detach().floor().long().clamp_max(count - 1).expand(*picture.shape[:-1], -1)
    total = so_far.gather(-1, pixel) + (place - pixel) * light.gather(-1, pixel)
    if boundary == "reflect":
        whole = so_far[..., -1:]
        total = torch.where(mirrored, 2 * whole - total, total) + 2 * whole * periods
    return (total.diff(dim=-1) / _wide(edges.diff(dim=-1))).to(picture.dtype)


def _wide(width: Tensor) -> Tensor:
    """Widths with at least _NARROW on either side of 0."""
    return torch.where(width.abs() < _NARROW, _NARROW, width)
