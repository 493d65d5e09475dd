"""Sampling: random errors of manufacture, each trial by its own number, so that it is the same in any batch.

Row n of trial k takes the k-th uniform number u of the generator of key (seed, n), and the error F⁻¹(u) between the
limits a and b, m their middle and h half their distance:

    normal       m + σ Φ⁻¹(p + u (1 - 2p)),  σ = h/sigmas,  p = Φ(-sigmas)
    uniform      a + u (b - a)
    parabolic    m + h ∛(2u - 1),  density 3 (e - m)²/(2h³)
    end_points   a or b
"""

from collections.abc import Iterable

import numpy as np
import torch
from scipy.special import ndtr, ndtri
from torch import Tensor

from raytrace.system.tolerance_data import Tolerance
from raytrace.tolerancing.tolerances import Tolerances, check_limits, rows_of


def draw_errors(tolerances: Tolerances | Iterable[Tolerance], count: int, seed: int = 0, *, first: int = 0) -> Tensor:
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
    errors = np.stack(columns, -1) if columns else np.zeros((count, 0))
    _share(rows, errors)
    return torch.from_numpy(errors)


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
    return np.where(u < 0.5, row.minimum, row.maximum)


def _share(rows: tuple[Tolerance, ...], errors: np.ndarray) -> None:
    """Scale the errors of each group so that they add up, in squares, to the square of its limit."""
    groups: dict[str, list[int]] = {}
    for n, row in enumerate(rows):
        if row.group:
            groups.setdefault(row.group, []).append(n)
    for places in groups.values():
        sizes = np.linalg.norm(errors[:, places], axis=1, keepdims=True)
        whole = np.sqrt(sum(rows[n].maximum ** 2 for n in places))
        errors[:, places] *= whole / np.maximum(sizes, np.finfo(float).tiny)
