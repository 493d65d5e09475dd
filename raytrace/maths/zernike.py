"""Zernike polynomials on the unit disc: indices, values, gradients and least-squares fits.

    Z(x, y) = √((2 - δ_m0)(n + 1)) R_n^|m|(r) · {cos mθ, m ≥ 0;  sin |m|θ, m < 0},   θ from the x axis

Normalised so that the mean of Z² over the disc is 1 (Noll, JOSA 66, 207, 1976): a coefficient is the RMS it adds.
`norm` turns a coefficient into that of the unnormalised polynomial, which is 1 at the edge (fringe reports).
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

Order = tuple[int, int]


def noll(j: int) -> Order:
    """(n, m) of Noll's j = 1, 2, …: piston, tilt x, tilt y, focus, astigmatism sin, cos, coma y, x, …"""
    _at_least(j, 1, "Noll")
    n = math.isqrt(8 * j - 7) - 1 >> 1
    k = j - n * (n + 1) // 2
    m = 2 * (k // 2) if n % 2 == 0 else 2 * ((k - 1) // 2) + 1
    return n, m if j % 2 == 0 else -m


def ansi(j: int) -> Order:
    """(n, m) of the ANSI Z80.28 index j = (n (n + 2) + m)/2 = 0, 1, …"""
    _at_least(j, 0, "ANSI")
    n = (math.isqrt(8 * j + 1) - 1) // 2
    return n, 2 * j - n * (n + 2)


def fringe(j: int) -> Order:
    """(n, m) of the fringe (University of Arizona) index j = (1 + (n + |m|)/2)² - 2|m| + [m < 0] = 1, 2, …

    But j = 37 is (12, 0), the last of the set of 37 that interferometers and lens programs use: the terms that the rule
    puts at 37 to 48 follow it, (6, 6) at 38, and from 50 on the rule holds again.
    """
    _at_least(j, 1, "fringe")
    if 37 <= j <= 49:
        j = 49 if j == 37 else j - 1
    d = math.isqrt(j - 1) + 1
    m = (d * d - j + 1) // 2
    return 2 * (d - 1) - m, -m if (d * d - j) % 2 else m


#: How terms may be numbered: the order (n, m) of the j-th, and whether its polynomial is 1 at the rim or 1 in RMS.
NUMBERINGS = {"noll": (noll, "rms"), "fringe": (fringe, "rim")}

#: What designers call the terms of low order.
WORDS = {
    (0, 0): "piston", (1, 1): "tilt x", (1, -1): "tilt y", (2, 0): "focus", (2, 2): "astigmatism 0°",
    (2, -2): "astigmatism 45°", (3, 1): "coma x", (3, -1): "coma y", (3, 3): "trefoil x", (3, -3): "trefoil y",
    (4, 0): "spherical", (4, 2): "astigmatism 0°, 5th order", (4, -2): "astigmatism 45°, 5th order",
    (4, 4): "tetrafoil 0°", (4, -4): "tetrafoil 22.5°", (5, 1): "coma x, 5th order", (5, -1): "coma y, 5th order",
    (6, 0): "spherical, 5th order", (8, 0): "spherical, 7th order", (10, 0): "spherical, 9th order",
}  # fmt: skip


def norm(n: int, m: int) -> float:
    """√((2 - δ_m0)(n + 1)), the largest value that Z takes on the edge."""
    return math.sqrt((n + 1) * (1 if m == 0 else 2))


def polynomials(orders: Sequence[Order], x: Tensor, y: Tensor) -> Tensor:
    """Z (J, ...) of orders (n, m) at points (...) of the unit disc.

    r^|m| e^{i|m|θ} = (x + iy)^|m| and R_n^m(r)/r^m = P_k^(0, m)(2 r² - 1), k = (n - |m|)/2, by the three-term
    recurrence of the Jacobi polynomials (DLMF 18.9.2): no digits lost at high orders, no angle, finite
    derivatives at the centre.
    """
    t = 2 * (x * x + y * y) - 1
    harmonics, radial = _harmonics(orders, x, y), {}
    result = []
    for n, m in orders:
        k, size = _degree(n, m), abs(m)
        _jacobi(radial, size, k, t)
        result.append(norm(n, m) * radial[size][k] * harmonics[size][0 if m >= 0 else 1])
    return torch.stack(result)


def gradients(orders: Sequence[Order], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """∂Z/∂x and ∂Z/∂y, each (J, ...), at points (...).

    ∇(P H) = H P' 4 (x, y) + P ∇H with d(x + iy)^|m| = |m| (x + iy)^(|m| - 1) (dx + i dy); P' by its recurrence.
    """
    t = 2 * (x * x + y * y) - 1
    harmonics, radial, slopes = _harmonics(orders, x, y), {}, {}
    along_x, along_y = [], []
    for n, m in orders:
        k, size = _degree(n, m), abs(m)
        _jacobi(radial, size, k, t)
        _jacobi_slopes(slopes, radial[size], size, k, t)
        c, s = harmonics[max(size - 1, 0)]
        by_x, by_y = (c, -s) if m >= 0 else (s, c)
        bent = 4 * slopes[size][k] * harmonics[size][0 if m >= 0 else 1]
        along_x.append(norm(n, m) * (bent * x + size * radial[size][k] * by_x))
        along_y.append(norm(n, m) * (bent * y + size * radial[size][k] * by_y))
    return torch.stack(along_x), torch.stack(along_y)


def fit(values: Tensor, basis: Tensor, weights: Tensor | None = None) -> Tensor:
    """Coefficients c (..., J) that minimise Σ_p w_p (values_p - Σ_j c_j basis_jp)², by QR.

    values: (..., P); basis: (J, P), as `polynomials` gives it; weights: (P,) or (..., P), not negative, 1 by default.
    Raises ValueError if a fit has fewer points of positive weight than coefficients.
    """
    weights = torch.ones_like(values) if weights is None else weights.expand(values.shape)
    _refuse_few(int((weights > 0).sum(-1).min()), len(basis))
    root = torch.sqrt(torch.where(weights > 0, weights, 1.0))
    root = torch.where(weights > 0, root, 0.0)
    return _solved(values, root, *torch.linalg.qr(root[..., None] * basis.T))


def fit_known(values: Tensor, basis: Tensor, weights: Tensor, *, worst: float) -> tuple[Tensor, Tensor]:
    """`fit` of values (..., P) by weights that share it, and where (...) these tell the coefficients: elsewhere 0.

    Known are those of a `condition` below `worst`. No derivative is taken by the weights: on what all have in common,
    the light of a field, no fit depends. Raises ValueError for fewer points than coefficients.
    """
    _refuse_few(weights.shape[-1], len(basis))
    root = torch.sqrt(weights.detach())
    q, r = torch.linalg.qr(root[..., None] * basis.T)
    known = _condition(r, root) < worst
    r = torch.where(known[..., None, None], r, torch.eye(len(basis), dtype=r.dtype, device=r.device))
    return _solved(torch.where(known[..., None], values, 0.0), root, q, r), known


def condition(basis: Tensor, weights: Tensor) -> Tensor:
    """By how much a fit may enlarge what its values err by (...): 1 on the whole disc, inf for too few points.

    The largest over the smallest singular value of the weighted basis (J, P); weights: (..., P), not negative.
    """
    root = torch.sqrt(weights)
    return _condition(torch.linalg.qr(root[..., None] * basis.T, mode="r").R, root)


def _condition(r: Tensor, root: Tensor) -> Tensor:
    values = torch.linalg.svdvals(r)
    found = values[..., 0] / values[..., -1].clamp_min(torch.finfo(values.dtype).tiny)
    return torch.where((root > 0).sum(-1) < r.shape[-1], torch.inf, found)


def _solved(values: Tensor, root: Tensor, q: Tensor, r: Tensor) -> Tensor:
    """Coefficients by the factors q r of the basis weighted by `root`."""
    right = q.mT @ (root * torch.where(root > 0, values, 0.0))[..., None]
    return torch.linalg.solve_triangular(r, right, upper=True)[..., 0]


def _refuse_few(points: int, coefficients: int) -> None:
    if points < coefficients:
        raise ValueError(f"{points} points of positive weight cannot fit {coefficients} coefficients")


def _degree(n: int, m: int) -> int:
    """k = (n - |m|)/2. Raises ValueError if there is no such polynomial."""
    k, odd = divmod(n - abs(m), 2)
    if k < 0 or odd:
        raise ValueError(f"no Zernike polynomial has n = {n}, m = {m}: n - |m| must be even and not negative")
    return k


def _harmonics(orders: Sequence[Order], x: Tensor, y: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Real and imaginary part of (x + iy)^|m|, from 0 to the largest |m|."""
    found = [(torch.ones_like(x), torch.zeros_like(x))]
    for _ in range(max((abs(m) for _, m in orders), default=0)):
        c, s = found[-1]
        found.append((c * x - s * y, c * y + s * x))
    return found


def _jacobi(known: dict[int, list[Tensor]], m: int, k: int, t: Tensor) -> None:
    """Extend known[m] up to P_k^(0, m)(t)."""
    found = known.setdefault(m, [torch.ones_like(t)])
    for i in range(len(found), k + 1):
        if i == 1:
            found.append(0.5 * ((m + 2) * t - m))
            continue
        a = 2 * i + m
        ahead = (a - 1) * (a * (a - 2) * t - m * m) * found[-1] - 2 * (i - 1) * (i + m - 1) * a * found[-2]
        found.append(ahead / (2 * i * (i + m) * (a - 2)))


def _jacobi_slopes(known: dict[int, list[Tensor]], values: list[Tensor], m: int, k: int, t: Tensor) -> None:
    """Extend known[m] up to the derivative of P_k^(0, m) at t: that of the recurrence of the values."""
    found = known.setdefault(m, [torch.zeros_like(t)])
    for i in range(len(found), k + 1):
        if i == 1:
            found.append(torch.full_like(t, 0.5 * (m + 2)))
            continue
        a = 2 * i + m
        ahead = (a - 1) * (a * (a - 2) * (t * found[-1] + values[i - 1]) - m * m * found[-1])
        found.append((ahead - 2 * (i - 1) * (i + m - 1) * a * found[-2]) / (2 * i * (i + m) * (a - 2)))


def _at_least(j: int, first: int, name: str) -> None:
    if j < first:
        raise ValueError(f"{name} index {j}: the first is {first}")
