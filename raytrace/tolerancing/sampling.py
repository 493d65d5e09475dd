"""Sampling: random errors of manufacture, each trial by its own number, so that it is the same in any batch.

Row n of trial k takes the k-th uniform number u of the generator of key (seed, n), and the error F⁻¹(u) between the
limits a and b, m their middle and h half their distance:

    normal       m + σ Φ⁻¹(p + u (1 - 2p)),  σ = h/sigmas,  p = Φ(-sigmas)
    uniform      a + u (b - a)
    parabolic    m + h ∛(2u - 1),  density 3 (e - m)²/(2h³)
    disc         m ± h √|2u - 1|,  density |e - m|/h²
    end_points   a or b
    table        a + (b - a) x, x of a density that is linear between the points of a table

The rows of a group have the errors √n d F⁻¹(v): d a direction in all n of them alike, v uniform. Both follow from the
numbers of the rows: d from g = Φ⁻¹(u), v = P(χ²_n ≤ |g|²).
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from scipy.special import chdtr, ndtr, ndtri
from torch import Tensor

from raytrace.system.tolerance_data import Tolerance
from raytrace.tolerancing.table import ToleranceTable, check_limits, groups_of, rows_of


def draw_errors(
    tolerances: ToleranceTable | Iterable[Tolerance], count: int, seed: int = 0, *, first: int = 0
) -> Tensor:
    """Random errors (count, N) in the rows' units, float64: the trials `first`, `first` + 1, … of a seed.

    A trial depends on the seed, its own number and the place of each row alone: trials 0 to 9 and 10 to 19 are those of
    0 to 19. Raises BadTolerance for limits that no error meets, ValueError for a count or a number below 0.
    """
    rows = rows_of(tolerances)
    if count < 0 or first < 0 or seed < 0:
        raise ValueError(f"count {count}, seed {seed}, first {first}: expected whole numbers of 0 and more")
    for row in rows:
        check_limits(row)
    uniform = _uniform(seed, first, count, len(rows))
    columns = [_errors(row, uniform[:, n]) for n, row in enumerate(rows)]
    for places in groups_of(rows):
        if len(places) > 1:
            normal = ndtri(uniform[:, places])
            squares = (normal * normal).sum(-1)
            for n, g in zip(places, normal.T, strict=True):
                columns[n] = np.sqrt(len(places) / squares) * g * _errors(rows[n], chdtr(len(places), squares))
    return torch.from_numpy(np.stack(columns, -1) if columns else np.zeros((count, 0)))


def _uniform(seed: int, first: int, count: int, rows: int) -> np.ndarray:
    """(count, rows) numbers in (0, 1): row n of trial k is the k-th of the generator of key (seed, n)."""
    numbers = np.empty((count, rows))
    block, skipped = divmod(first, 4)  # a step of its counter yields four numbers
    for n in range(rows):
        generator = np.random.Philox(key=np.array([seed, n], dtype=np.uint64)).advance(block)
        bits = generator.random_raw(skipped + count)[skipped:]
        numbers[:, n] = ((bits >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52
    return numbers


def _errors(row: Tolerance, u: np.ndarray) -> np.ndarray:
    """F⁻¹(u) of one row."""
    middle, half = 0.5 * (row.minimum + row.maximum), 0.5 * (row.maximum - row.minimum)
    if row.distribution == "normal":
        tail = ndtr(-row.sigmas)
        return np.clip(middle + half / row.sigmas * ndtri(tail + u * (1 - 2 * tail)), row.minimum, row.maximum)
    if row.distribution == "uniform":
        return row.minimum + u * (row.maximum - row.minimum)
    if row.distribution == "parabolic":
        return middle + half * np.cbrt(2 * u - 1)
    if row.distribution == "disc":
        return middle + half * np.sign(2 * u - 1) * np.sqrt(np.abs(2 * u - 1))
    if row.distribution == "table":
        return row.minimum + 2 * half * _quantile(row.density, u)
    return np.where(u < 0.5, row.minimum, row.maximum)


def _quantile(density: Sequence[tuple[float, float]], u: np.ndarray) -> np.ndarray:
    """Fraction of the way between the limits below which a share u lies: p₀ t + ½ (p₁ - p₀) t²/w of each step w."""
    x, p = np.array(density).T
    widths, starts = np.diff(x), p[:-1]
    areas = np.concatenate([[0.0], np.cumsum(0.5 * widths * (p[1:] + starts))])
    rest = u * areas[-1]
    k = np.clip(np.searchsorted(areas, rest, side="right") - 1, 0, len(widths) - 1)
    rest, slope = rest - areas[k], ((p[1:] - starts) / widths)[k]
    root = starts[k] + np.sqrt(np.maximum(starts[k] ** 2 + 2 * slope * rest, 0.0))
    return x[k] + np.clip(2 * rest / np.maximum(root, np.finfo(float).tiny), 0.0, widths[k])


def density_moments(density: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Mean and variance of the fraction of the way between the limits."""
    x, p = np.array(density).T
    a, b, first, last, widths = x[:-1], x[1:], p[:-1], p[1:], np.diff(x)
    whole = widths @ (first + last) / 2
    mean = widths @ (first * (2 * a + b) + last * (a + 2 * b)) / (6 * whole)
    square = widths @ (first * (3 * a * a + 2 * a * b + b * b) + last * (a * a + 2 * a * b + 3 * b * b)) / (12 * whole)
    return float(mean), float(square - mean**2)
