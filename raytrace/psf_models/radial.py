"""Rotationally symmetric kernels: light symmetric about the centre of the window is computed along one radius only.

    E_ij = ∬_ij I(r) dx dy = Σ_k M_ijk I(r_k)      waves: I is band-limited, so that a few radii hold all of it
    E_ij = ∫ g_ij(r) dE(r)                         rays: g_ij the share of a ring of radius r that lies in the pixel

M and g are constants of the window in units of a pixel. Pixels alike by symmetry are computed once: 66 of 21 × 21.
"""

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.budget import afford, forewarn
from raytrace.maths.numerics import safe_divide, varies
from raytrace.maths.sampling import Grid
from raytrace.tracing.scene import Scene

_STEPS = 64  # of the table of g in a pixel


def is_centred(grid: Grid, scene: Scene | None = None) -> bool:
    """Whether every window (of the whole scene) is centred on the axis, to 1e-9 pixel, also under differentiation."""
    if varies(grid.centre):
        return False
    centred = (grid.centre.abs() <= 1e-9 * grid.pitch.abs()).all()
    return bool(centred) if scene is None else scene.everywhere(centred)


def reach(grid: Grid) -> float:
    """Distance in pixels from the centre of a window to its corner."""
    return 0.5 * math.hypot(grid.rows, grid.columns)


def radii_of_waves(grid: Grid, cutoff: float, order: int) -> tuple[Tensor, Tensor]:
    """Radii (K,) mm at which an intensity of frequencies up to `cutoff` in 1/mm is sampled, and the matrix (U, K) mm²
    to the energy of the distinct pixels, for `unfold`.

    Even Chebyshev terms up to degree 2K - 2 hold exp(iat) up to J_2K(a), a = 2π · cutoff · reach.
    """
    radii, matrix, _ = (grid.pitch.new_tensor(a) for a in _rule_of(grid, cutoff, order))
    return radii * grid.pitch, matrix * grid.pitch**2


def light_of_radii(grid: Grid, cutoff: float, order: int, intensity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Kernel (..., rows, columns), centroid (2, ...) mm and covariance (3, ...) mm² of the light inside the window, 0
    if there is none, of round light about the axis, from its intensity (..., K) at those radii.
    """
    _, matrix, second = (grid.pitch.new_tensor(a) for a in _rule_of(grid, cutoff, order))
    kernel = unfold(grid, intensity @ (matrix * grid.pitch**2).mT)
    squares = intensity @ (second * grid.pitch**4).mT
    xx, yy = (safe_divide(part, kernel.sum((-2, -1))) for part in squares.unbind(-1))
    zero = torch.zeros_like(xx)
    return kernel, torch.stack([zero, zero]), torch.stack([xx, zero, yy])


def _rule_of(grid: Grid, cutoff: float, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pitch = float(grid.pitch.detach())
    argument = 2 * math.pi * cutoff * pitch * reach(grid)
    count = math.ceil(0.5 * argument + max(1.5, 2 + order) * (4 + argument ** (1 / 3)))
    nodes = math.ceil(0.5 * math.pi * cutoff * pitch) + 4 + order
    distinct = grid.rows * grid.columns / (4 if grid.rows != grid.columns else 8) + grid.rows
    afford(
        8.0 * (8 * distinct * nodes**2 + (2 * distinct + 2 * count) * count),
        f"the PSF needs its light at {count:,} radii and {nodes:,}² points of each pixel",
        helps="ask for a smaller {size} or {pixel}, a slower aperture ({f_number}) or {model=drt}",
    )
    return _wave_rule(grid.rows, grid.columns, nodes, count)


def energy_of_rings(grid: Grid, first: Tensor, last: Tensor, energy: Tensor) -> Tensor:
    """Pixel energies (..., U) of pieces of one meridian rotated about the axis; for `unfold`.

        E_u = Σ_c e_c (G_u(b_c) - G_u(a_c))/(b_c - a_c),   G_u(h) = ∫_0^h g_u(|r|) dr

    first, last: (..., C) mm, signed heights a, b of the ends of a piece; energy: (..., C) of the pieces, spread evenly
    over their heights.
    """
    table = torch.from_numpy(_ring_table(grid.rows, grid.columns)).to(grid.pitch.detach())
    last_step = len(table) - 1
    a, b = first / grid.pitch, last / grid.pitch
    # A caustic has pieces without width: the share of a ring is taken there, over a thousandth of a pixel.
    narrow = (b - a).abs() < 1e-3
    middle = 0.5 * (a + b)
    lower, upper = torch.where(narrow, middle - 5e-4, a), torch.where(narrow, middle + 5e-4, b)
    density = energy / (upper - lower)
    weights = density.new_zeros(*density.shape[:-1], last_step + 1)
    for end, share in ((lower, -density), (upper, density)):
        share = torch.where(end < 0, -share, share)
        place = (end.abs() * _STEPS).clamp(max=float(last_step))
        below = place.detach().floor().clamp(max=last_step - 1)
        above = place - below
        index = below.long()
        weights = weights.scatter_add(-1, index, share * (1 - above)).scatter_add(-1, index + 1, share * above)
    return weights @ table


def lit_part(first: Tensor, last: Tensor, clearances: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor | float]:
    """The ends and the share of the part between a and b (..., C) where light passes, for linear clearances (..., C +
    1).
    """
    begin, end = torch.zeros_like(first), torch.ones_like(first)
    for clearance in clearances:
        c, d = clearance[..., :-1], clearance[..., 1:]
        edge = safe_divide(c, c - d)
        begin = torch.maximum(begin, torch.where(c >= 0, 0.0, torch.where(d > 0, edge, 1.0)))
        end = torch.minimum(end, torch.where(d >= 0, 1.0, torch.where(c > 0, edge, 0.0)))
    share = (end - begin).clamp_min(0.0)
    return first + begin * (last - first), first + end * (last - first), share


def unfold(grid: Grid, values: Tensor) -> Tensor:
    """Pixels (..., rows, columns) from the distinct ones (..., U)."""
    index = torch.as_tensor(_distinct(grid.rows, grid.columns)[1], device=values.device)
    return values[..., index]


def _offsets(rows: int, columns: int) -> Sequence[np.ndarray]:
    """y and x (rows, columns) of the centres of the pixels, in pixels."""
    return np.meshgrid(*(np.arange(n) - 0.5 * (n - 1) for n in (rows, columns)), indexing="ij")


@functools.lru_cache(maxsize=16)
def _distinct(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres (U, 2) in pixels of the distinct pixels, 0 <= a <= b, and the index of each pixel in them."""
    pair = np.sort(np.abs(np.stack(_offsets(rows, columns), -1)), -1)
    places, index = np.unique(pair.reshape(-1, 2), axis=0, return_inverse=True)
    return places, index.reshape(rows, columns)


@functools.lru_cache(maxsize=16)
def _wave_rule(rows: int, columns: int, nodes: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chebyshev radii (K,) in pixels; matrices (U, K) to pixels and (2, K) to the second moments along x and y."""
    corner = 0.5 * math.hypot(rows, columns)
    angle = (2 * np.arange(count) + 1) * (np.pi / (4 * count))
    terms = 2 * np.arange(count)
    # c_m = (2 - δ_m0)/K Σ_k f(r_k) T_2m(r_k/R)
    series = np.where(terms == 0, 1, 2)[:, None] / count * np.cos(terms[:, None] * angle)
    node, weight = (a / 2 for a in np.polynomial.legendre.leggauss(nodes))
    places = _distinct(rows, columns)[0]
    forewarn(
        5e-9 * count * len(places) * nodes**2,
        f"a PSF needs its light at {count:,} radii and {nodes:,}² points of each pixel",
        helps="ask for a smaller {size} or {pixel}, a slower aperture ({f_number}) or {model=drt}",
    )
    x, y = (places[:, axis, None] + node for axis in (0, 1))
    # T_2m by its recurrence in T_2: a tenth of the time of as many cosines.
    twice = 2 * (2 * np.minimum(np.hypot(x[:, :, None], y[:, None, :]) / corner, 1.0) ** 2 - 1)
    previous, current = 0.5 * twice, np.ones_like(twice)  # T_-2 = T_2, T_0
    pixels, second = np.empty((len(places), count)), np.empty((2, count))
    # Weights (U, A, A) of ∬ I x² and ∬ I y²: a pixel with |x| > |y| on the sensor is the image of one exchanged.
    (height, width), index = np.abs(_offsets(rows, columns)), _distinct(rows, columns)[1]
    upright = width <= height
    as_is, exchanged = (np.bincount(index[mask], minlength=len(x))[:, None, None] for mask in (upright, ~upright))
    xx, yy, rule = x[:, :, None] ** 2, y[:, None, :] ** 2, weight[:, None] * weight
    squares = rule * (as_is * xx + exchanged * yy), rule * (as_is * yy + exchanged * xx)
    for m in range(count):
        pixels[:, m] = np.einsum("uab,a,b->u", current, weight, weight, optimize=True)
        second[:, m] = [np.einsum("uab,uab->", current, share, optimize=True) for share in squares]
        previous, current = current, twice * current - previous
    return corner * np.cos(angle), pixels @ series, second @ series


@functools.lru_cache(maxsize=4)  # the largest ones have gigabytes
def _ring_table(rows: int, columns: int) -> np.ndarray:
    """G (K, U): ∫_0^r of the share of rings in each pixel, at r in steps of 1/_STEPS pixel to beyond the corner."""
    fine = 16  # midpoints in a step
    count = math.ceil(0.5 * math.hypot(rows, columns) * _STEPS) + 1
    places = _distinct(rows, columns)[0]
    what = f"the PSF of {rows} × {columns} pixels needs its light at {count:,} radii"
    afford(10.0 * (count + 1) * len(places), what, helps="ask for a smaller {size}, or larger pixels")
    (a0, b0), (a1, b1) = ((places + side).T[..., None, None] for side in (-0.5, 0.5))
    # A pixel has shares of rings between its nearest and its farthest corner only, less than 3/2 pixels apart.
    nearest = np.hypot(*np.maximum(0.0, places - 0.5).T)
    step = np.floor(nearest * _STEPS).astype(int)[:, None] + np.arange(math.ceil(1.5 * _STEPS) + 1)
    r = (step[..., None] * fine + np.arange(fine) + 0.5) / (_STEPS * fine)  # (U, steps, fine)

    def below(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Share of a ring in the quadrant rectangle [0, a] × [0, b]: from acos(a/r) to asin(b/r)."""
        arcs = sum(np.arcsin(np.minimum(1.0, np.abs(edge) / r)) for edge in (a, b))
        return np.sign(a) * np.sign(b) * np.maximum(0.0, arcs - 0.5 * np.pi) / (2 * np.pi)

    shares = below(a1, b1) - below(a0, b1) - below(a1, b0) + below(a0, b0)
    table = np.zeros((count + 1, len(places)))
    inside = step < count
    table[step[inside] + 1, np.nonzero(inside)[0]] = (shares.mean(-1) / _STEPS)[inside]
    return np.cumsum(table, 0, out=table)
