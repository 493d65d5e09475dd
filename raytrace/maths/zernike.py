"""Zernike polynomials on the unit disc: indices, values, gradients and least-squares fits.

    Z(x, y) = √((2 - δ_m0)(n + 1)) R_n^|m|(r) · {cos mθ, m ≥ 0;  sin |m|θ, m < 0},   θ from the x axis

Normalised so that the mean of Z² over the disc is 1 (Noll, JOSA 66, 207, 1976): a coefficient is the RMS it adds.
`norm` turns a coefficient into that of the unnormalised polynomial, which is 1 at the edge (fringe reports).
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.words import option

Order = tuple[int, int]

#: By |m|, for k = 0, 1, … the polynomial P_k^(0, |m|)(t) and its derivatives.
Jacobi = dict[int, list[tuple[Tensor, ...]]]


def noll(j: int) -> Order:
    """(n, m) of Noll's j = 1, 2, …: piston, tilt x, tilt y, focus, astigmatism sin, cos, coma y, x, …"""
    _refuse_zero(j, "Noll")
    n = math.isqrt(8 * j - 7) - 1 >> 1
    k = j - n * (n + 1) // 2
    m = 2 * (k // 2) if n % 2 == 0 else 2 * ((k - 1) // 2) + 1
    return n, m if j % 2 == 0 else -m


def fringe(j: int) -> Order:
    """(n, m) of the fringe (University of Arizona) index j = (1 + (n + |m|)/2)² - 2|m| + [m < 0] = 1, 2, …

    But j = 37 is (12, 0), the last of the set of 37 that interferometers and lens programs use: the terms that the rule
    puts at 37 to 48 follow it, (6, 6) at 38, and from 50 on the rule holds again.
    """
    _refuse_zero(j, "fringe")
    if 37 <= j <= 49:
        j = 49 if j == 37 else j - 1
    d = math.isqrt(j - 1) + 1
    m = (d * d - j + 1) // 2
    return 2 * (d - 1) - m, -m if (d * d - j) % 2 else m


#: Numberings of the terms: from j to the order (n, m), and whether the polynomial is 1 at the rim or in RMS.
NUMBERINGS = {"noll": (noll, "rms"), "fringe": (fringe, "rim")}

#: Names of the aberrations of low order.
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
    recurrence of the Jacobi polynomials (DLMF 18.9.2): full precision at high orders, no angle, finite
    derivatives at the centre.
    """
    t, pairs = 2 * (x * x + y * y) - 1, harmonics(orders, x, y)
    known: Jacobi = {}
    terms = [norm(n, m) * jacobi(known, n, m, t)[0] * pairs[abs(m)][0 if m >= 0 else 1] for n, m in orders]
    return torch.stack(terms)


def gradients(orders: Sequence[Order], x: Tensor, y: Tensor) -> Tensor:
    """∂Z/∂x and ∂Z/∂y (2, J, ...) at points (...).

    ∇(P H) = H P' 4 (x, y) + P ∇H with d(x + iy)^|m| = |m| (x + iy)^(|m| - 1) (dx + i dy); P' by its recurrence.
    """
    t, pairs = 2 * (x * x + y * y) - 1, harmonics(orders, x, y)
    known: Jacobi = {}
    point, terms = torch.stack([x, y]), []
    turned = [(torch.stack([c, -s]), torch.stack([s, c])) for c, s in pairs]
    for n, m in orders:
        size, place, (value, slope) = abs(m), 0 if m >= 0 else 1, jacobi(known, n, m, t, 1)
        by = turned[max(size - 1, 0)][place]
        terms.append(norm(n, m) * (4 * slope * pairs[size][place] * point + size * value * by))
    return torch.stack(terms, 1)


def fit(values: Tensor, basis: Tensor, weights: Tensor | None = None) -> Tensor:
    """Coefficients c (..., J) that minimise Σ_p w_p (values_p - Σ_j c_j basis_jp)², by QR.

    values: (..., P); basis: (J, P) or (J, ..., P), as `polynomials` gives it; weights:
    (P,) or (..., P), not negative, 1 by default.
    Raises ValueError if a fit has fewer points of positive weight than coefficients.
    """
    weights = values.new_ones(values.shape[-1:]) if weights is None else weights
    refuse_few(int((weights > 0).sum(-1).min()), len(basis))
    root = torch.sqrt(torch.where(weights > 0, weights, 1.0))
    root = torch.where(weights > 0, root, 0.0)
    return _solved(values, root, *torch.linalg.qr(root[..., None] * basis.movedim(0, -1)))


def fit_known(values: Tensor, basis: Tensor, weights: Tensor, *, worst: float) -> tuple[Tensor, Tensor]:
    """`fit` of values (..., P), 0 where the weights do not determine the coefficients; and where (...) they do.

    They do where the `condition` is below `worst`. No derivative is taken by the weights: a factor that they have in
    common, the light of a field, does not change the fit. Raises ValueError for fewer points than coefficients.
    """
    refuse_few(weights.shape[-1], len(basis))
    root = torch.sqrt(weights.detach())
    q, r = torch.linalg.qr(root[..., None] * basis.movedim(0, -1))
    known = _condition(r, root) < worst
    r = torch.where(known[..., None, None], r, torch.eye(len(basis), dtype=r.dtype, device=r.device))
    return _solved(torch.where(known[..., None], values, 0.0), root, q, r), known


def condition(basis: Tensor, weights: Tensor) -> Tensor:
    """The factor (...) by which a fit may enlarge errors of its values: 1 on the whole disc, inf for too few points.

    The largest over the smallest singular value of the weighted basis (J, P); weights: (..., P), not negative.
    """
    root = torch.sqrt(weights)
    return _condition(torch.linalg.qr(root[..., None] * basis.movedim(0, -1), mode="r").R, root)


def _condition(r: Tensor, root: Tensor) -> Tensor:
    values = torch.linalg.svdvals(r)
    ratio = values[..., 0] / values[..., -1].clamp_min(torch.finfo(values.dtype).tiny)
    return torch.where((root > 0).sum(-1) < r.shape[-1], torch.inf, ratio)


def _solved(values: Tensor, root: Tensor, q: Tensor, r: Tensor) -> Tensor:
    """Coefficients by the factors q r of the basis weighted by `root`."""
    right = q.mT @ (root * torch.where(root > 0, values, 0.0))[..., None]
    return torch.linalg.solve_triangular(r, right, upper=True)[..., 0]


def refuse_few(points: int, coefficients: int) -> None:
    if points < coefficients:
        raise ValueError(
            f"{points} points of positive weight cannot fit {coefficients} coefficients; ask for fewer "
            f"{option('terms')}"
        )


def harmonics(orders: Sequence[Order], x: Tensor, y: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Real and imaginary part of (x + iy)^|m|, from 0 to the largest |m|."""
    pairs = [(torch.ones_like(x), torch.zeros_like(x))]
    for _ in range(max((abs(m) for _, m in orders), default=0)):
        c, s = pairs[-1]
        pairs.append((c * x - s * y, c * y + s * x))
    return pairs


def jacobi(known: Jacobi, n: int, m: int, t: Tensor, highest: int = 0) -> tuple[Tensor, ...]:
    """P_k^(0, |m|)(t), k = (n - |m|)/2, and its derivatives up to the highest, by the recurrence; extends `known`.

    Raises ValueError if no polynomial has the order (n, m).
    """
    k, odd = divmod(n - abs(m), 2)
    if k < 0 or odd:
        raise ValueError(f"no Zernike polynomial has n = {n}, m = {m}: n - |m| must be even and not negative")
    m, rows = abs(m), known.setdefault(abs(m), [])
    for i in range(len(rows), k + 1):
        if i < 2:
            linear = 0.5 * ((m + 2) * t - m), torch.full_like(t, 0.5 * (m + 2)), torch.zeros_like(t)
            rows.append((linear if i else (torch.ones_like(t), linear[2], linear[2]))[: highest + 1])
            continue
        # P_i = (α t + β) P_(i-1) - γ P_(i-2)
        a, last, row = 2 * i + m, rows[-1], []
        whole = 2 * i * (i + m) * (a - 2)
        lead, back = (a - 1) * a * (a - 2) / whole, 2 * (i - 1) * (i + m - 1) * a / whole
        factor = lead * t - (a - 1) * m * m / whole
        for order, (p, q) in enumerate(zip(last, rows[-2], strict=True)):
            new = factor * p if order == 0 else torch.add(factor * p, last[order - 1], alpha=order * lead)
            row.append(torch.sub(new, q, alpha=back))
        rows.append(tuple(row))
    return rows[k]


def _refuse_zero(j: int, name: str) -> None:
    if j < 1:
        raise ValueError(f"{name} index {j}: the first is 1")
