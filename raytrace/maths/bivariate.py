"""Polynomials in x and y: Σ c_k x^i y^j in the order x, y, x², xy, y², x³, …, and Zernike's terms in these."""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.zernike import fringe


class Sag(NamedTuple):
    """A function D (...) of x and y, its slopes and second derivatives; those above the highest requested are 0."""

    z: Tensor
    x: Tensor
    y: Tensor
    xx: Tensor
    xy: Tensor
    yy: Tensor


def powers(count: int) -> list[tuple[int, int]]:
    """(i, j) of the first `count` terms x^i y^j, without the constant."""
    degrees = range(1, degree(count) + 1)
    return [(n - j, j) for n in degrees for j in range(n + 1)][:count]


def round_power(n: int) -> dict[tuple[int, int], int]:
    """(x² + y²)^n as factors of x^i y^j, by (i, j)."""
    return {(2 * (n - j), 2 * j): math.comb(n, j) for j in range(n + 1)}


def degree(count: int) -> int:
    """The smallest degree n for which n(n + 3)/2, the number of terms, is at least `count`."""
    return math.ceil((math.sqrt(9 + 8 * count) - 3) / 2)


def polynomial_xy(coefficients: Tensor, x: Tensor, y: Tensor, highest: int = 2) -> Sag:
    """Σ c_k x^i y^j and its derivatives at points (...); coefficients: (K, ...) in the order of `powers`."""
    x, y = torch.broadcast_tensors(x, y)
    zero, n = torch.zeros_like(x), degree(len(coefficients))
    rows = [[zero] * (n - j + 1) for j in range(n + 1)]  # c_ij by j, then i
    for (i, j), c in zip(powers(len(coefficients)), coefficients.unbind(0), strict=True):
        rows[j][i] = c + zero
    flat = [_horner(row, x, highest) for row in rows]  # of each power of y, its polynomial in x
    z, zx, zxx = ([part[order] for part in flat] for order in range(3))
    value, slope, bend = _horner(z, y, highest)
    across = _horner(zx, y, highest - 1) if highest > 0 else (zero,) * 3
    along = _horner(zxx, y, highest - 2)[0] if highest > 1 else zero
    return Sag(value, across[0], slope, along, across[1], bend)


def _horner(coefficients: list[Tensor], x: Tensor, highest: int) -> tuple[Tensor, Tensor, Tensor]:
    """p(x), p'(x), p''(x) of coefficients (...) from the constant up; derivatives above the highest are 0."""
    zero = torch.zeros_like(x)
    p, dp, half = coefficients[-1], zero, zero
    for c in reversed(coefficients[:-1]):
        if highest > 1:
            half = torch.addcmul(dp, half, x)
        if highest > 0:
            dp = torch.addcmul(p, dp, x)
        p = torch.addcmul(c, p, x)
    return p, dp, 2 * half


def shifted(coefficients: Sequence[Tensor], x: Tensor, y: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Σ c_k x^i y^j about a centre x_0, y_0 (...): the value there, and the coefficients of powers of x - x_0, y - y_0.

    coefficients: (...) each, in the order of `powers`, as those of the result.
    """
    order = powers(len(coefficients))
    sums: dict[tuple[int, int], Tensor] = {}
    for (i, j), c in zip(order, coefficients, strict=True):
        for p in range(i + 1):
            for q in range(j + 1):
                part = math.comb(i, p) * math.comb(j, q) * c * x ** (i - p) * y ** (j - q)
                sums[p, q] = sums[p, q] + part if (p, q) in sums else part
    zero = torch.zeros_like(x)
    return sums.get((0, 0), zero), [sums.get(power, zero) for power in order]


def fringe_to_powers(count: int) -> tuple[np.ndarray, np.ndarray]:
    """`zernike_to_powers` of the first `count` fringe terms: the matrix (K, count), and the constants (count,)."""
    return zernike_to_powers(tuple(fringe(j) for j in range(1, count + 1)))


@functools.lru_cache(maxsize=8)
def zernike_to_powers(orders: tuple[tuple[int, int], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (K, J) from coefficients of terms (n, m), 1 at the rim, to those of x^i y^j; and the constants (J,).

    R_n^m(ρ) cos mφ = Σ_s (-1)^s (n-s)!/(s! ((n+m)/2 - s)! ((n-m)/2 - s)!) ρ^(n-2s-m) · Re (x + iy)^m
    """
    top = max((n for n, _ in orders), default=0)
    order = powers(top * (top + 3) // 2)
    place = {power: k for k, power in enumerate(order)}
    matrix, constants = np.zeros((len(order), len(orders))), np.zeros(len(orders))
    for column, (n, m) in enumerate(orders):
        for power, c in _terms(n, m).items():
            if power == (0, 0):
                constants[column] += c
            else:
                matrix[place[power], column] += c
    return matrix, constants


def _terms(n: int, m: int) -> dict[tuple[int, int], float]:
    size = abs(m)
    terms: dict[tuple[int, int], float] = {}
    for s in range((n - size) // 2 + 1):
        plus, minus = (n + size) // 2 - s, (n - size) // 2 - s
        c = (-1) ** s * math.factorial(n - s) // (math.factorial(s) * math.factorial(plus) * math.factorial(minus))
        for power, weight in _harmonic_terms(m).items():
            for k in range(minus + 1):  # (x² + y²)^minus
                key = power[0] + 2 * k, power[1] + 2 * (minus - k)
                terms[key] = terms.get(key, 0) + c * weight * math.comb(minus, k)
    return terms


def _harmonic_terms(m: int) -> dict[tuple[int, int], int]:
    """Re (x + iy)^m, or Im (x + iy)^|m| of m < 0."""
    size = abs(m)
    parts = range(0 if m >= 0 else 1, size + 1, 2)
    return {(size - j, j): (-1) ** (j // 2) * math.comb(size, j) for j in parts}
