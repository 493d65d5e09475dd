"""Freeform: sags that differ along x and y by their kind; rows of `shapes.KINDS`.

    toroidal   z = g + c_x x²/(q + √(q² - c_x² x²)),  q = 1 - c_x g,  g = g(y) a conic and Σ_j a_j y^(2j)
    biconic    z = (c_x x² + c y²)/(1 + √(1 - (1+k_x) c_x² x² - (1+k) c² y²))

The first is the curve g turned about a line along y through z = 1/c_x. Curvature c and conic k are those of the section
along y, the other numbers the coefficients. Both are even in x and in y. All is put together from numbers without a
unit, so that lengths may be as small and as large as numbers go. Beyond its edge a surface is held at that height.
"""

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from raytrace.system.sag_terms import Sag
from raytrace.system.terms import conic_terms, even_terms


@dataclasses.dataclass(frozen=True)
class Form:
    """A sag of x and y, by functions of curvature c (...), conic k (...), coefficients a (m, ...), and points (...) mm.

    sag: with its derivatives up to the highest; covers: where there is a surface, on the sheet of the vertex;
    extent: of c, k, a and a limit (...) mm, how far that sheet goes along x and y, at most to the limit;
    size: of c, a and points, what the sag adds up from, by which its rounding is judged.
    """

    sag: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, int], Sag]
    covers: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]
    extent: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
    size: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


def _section(c: Tensor, k: Tensor, a: Tensor, y: Tensor, highest: int) -> tuple[Tensor, Tensor, Tensor]:
    """g(y), g' and g''."""
    S, dS, d2S = conic_terms(y * y, c, k, highest, y)
    if len(a):
        P, dP, d2P = even_terms(y * y, a, highest, y)
        S, dS, d2S = S + P, dS if dP is None else dS + dP, d2S if d2P is None else d2S + d2P
    return S, 2 * dS * y, 2 * dS + 4 * d2S


def _toroid(c, k, a, x, y, highest: int) -> Sag:
    """w = 1 - c_x z gives w z_x = c_x x and w z_y = q g', and these the second derivatives."""
    c_x, zero = a[0], torch.zeros_like(x * y)
    g, dg, d2g = _section(c, k, a[1:], y, highest)
    p, q = c_x * x, 1 - c_x * g
    inside = (q > 0) & (q > p.abs())
    q = torch.where(inside, q, 1.0)
    p = torch.where(inside, p, 0.0)
    w = torch.sqrt((q - p) * (q + p))
    edge = 1 / torch.where(inside, 1.0, c_x)
    z = torch.where(inside, g + x * p / (q + w), edge)
    if highest == 0:
        return Sag(z, *(zero,) * 5)
    dg = torch.where(inside, dg, 0.0)
    z_x, z_y = p / w, q / w * dg
    if highest == 1:
        return Sag(z, z_x, z_y, *(zero,) * 3)
    turn = c_x / w
    z_yy = torch.where(inside, q / w * d2g, 0.0) + turn * (z_y * z_y - dg * dg)
    return Sag(z, z_x, z_y, turn * (1 + z_x * z_x), turn * z_x * z_y, z_yy)


def _toroid_covers(c, k, a, x, y) -> Tensor:
    g, *_ = _section(c, k, a[1:], y, 0)
    q = 1 - a[0] * g
    return (1 - (1 + k) * (c * (c * (y * y))) > 0) & (q > 0) & (q > (a[0] * x).abs())


def _toroid_extent(c, k, a, limit) -> tuple[Tensor, Tensor]:
    along_y = _edge(c, k, limit)
    y = torch.linspace(0, 1, 17, dtype=c.dtype, device=c.device).reshape(-1, *(1,) * along_y.dim()) * along_y
    q = 1 - a[0] * _section(c, k, a[1:], y * (1 - 1e-8), 0)[0]
    reach = q.amax(0) / torch.where(a[0] == 0, 1.0, a[0]).abs()
    return torch.where((a[0] != 0) & (reach < limit), reach, limit), along_y


def _biconic(c, k, a, x, y, highest: int) -> Sag:
    """z (1 + w) = c_x x² + c y², derived twice; w w_x = -(1+k_x) c_x² x."""
    c_x, shape_x, shape_y = a[0], 1 + a[1], 1 + k
    zero = torch.zeros_like(x * y)
    p, q = c_x * x, c * y
    radicand = 1 - shape_x * (p * p) - shape_y * (q * q)
    inside = radicand > 0
    root = torch.sqrt(torch.where(inside, radicand, 1.0))
    z = (x * p + y * q) / (1 + torch.where(inside, root, 0.0))
    if highest == 0:
        return Sag(z, *(zero,) * 5)
    over_w = torch.where(inside, 1 / root, 0.0)
    share = 1 / (1 + torch.where(inside, root, 0.0))
    w_x, w_y = -shape_x * c_x * p * over_w, -shape_y * c * q * over_w
    z_x, z_y = (2 * p - z * w_x) * share, (2 * q - z * w_y) * share
    if highest == 1:
        return Sag(z, z_x, z_y, *(zero,) * 3)
    w_xx, w_yy = -(shape_x * c_x * c_x + w_x * w_x) * over_w, -(shape_y * c * c + w_y * w_y) * over_w
    w_xy = -w_x * w_y * over_w
    return Sag(
        z,
        z_x,
        z_y,
        (2 * c_x - 2 * z_x * w_x - z * w_xx) * share,
        -(z_x * w_y + z_y * w_x + z * w_xy) * share,
        (2 * c - 2 * z_y * w_y - z * w_yy) * share,
    )


def _biconic_covers(c, k, a, x, y) -> Tensor:
    p, q = a[0] * x, c * y
    return 1 - (1 + a[1]) * (p * p) - (1 + k) * (q * q) > 0


def _biconic_extent(c, k, a, limit) -> tuple[Tensor, Tensor]:
    """A section that stays open along one axis moves the edge along the other one out."""
    open_x, open_y = (
        torch.sqrt(1 + (-(1 + conic) * (bend * limit) ** 2).clamp_min(0.0)) for bend, conic in ((a[0], a[1]), (c, k))
    )
    return (_edge(a[0], a[1], limit) * open_y).minimum(limit), (_edge(c, k, limit) * open_x).minimum(limit)


def _size(c, a, x, y, terms: Tensor | float = 0.0) -> Tensor:
    return (c * y * y).abs() + (a[0] * x * x).abs() + terms


def _toroid_size(c, a, x, y) -> Tensor:
    return _size(c, a, x, y, even_terms(y * y, a[1:].abs(), 0, 1.0)[0])


def _edge(c: Tensor, k: Tensor, limit: Tensor) -> Tensor:
    """Where a conic closes, at most the limit."""
    closed = (1 + k) * c * c
    return torch.where(closed > 0, torch.rsqrt(torch.where(closed > 0, closed, 1.0)), limit).minimum(limit)


TOROIDAL = Form(_toroid, _toroid_covers, _toroid_extent, _toroid_size)
BICONIC = Form(_biconic, _biconic_covers, _biconic_extent, _size)
