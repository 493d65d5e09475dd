"""Terms: what a section of a surface is made of, by u = r²: a conic, and the powers that are added to it."""

from collections.abc import Callable

import torch
from torch import Tensor

from raytrace.maths.numerics import polynomial

_TIP = 1e-24  # mm²: r² up to which a ray goes through the vertex


#: What terms add to a sag: u (...), coefficients (m, ...), highest derivative, a factor f -> Σ_j a_j b_j(u), its slope
#: and f² times its second derivative; None for those above the highest. The b_j are at least 0.
Terms = Callable[[Tensor, Tensor, int, Tensor | float], tuple[Tensor, Tensor | None, Tensor | None]]


def even_terms(u: Tensor, coefficients: Tensor, highest: int, along: Tensor | float):
    """b_j = u^j, as `Terms`."""
    P = u * polynomial(coefficients, u)
    if highest == 0:
        return P, None, None
    order = torch.arange(1, len(coefficients) + 1, dtype=coefficients.dtype, device=coefficients.device)
    first = order.reshape(-1, *(1,) * (coefficients.dim() - 1)) * coefficients
    dP = polynomial(first, u)
    if highest == 1:
        return P, dP, None
    second = (order - 1).reshape(-1, *(1,) * (coefficients.dim() - 1)) * first
    return P, dP, polynomial(second[1:], u) * along * along


def odd_terms(u: Tensor, coefficients: Tensor, highest: int, along: Tensor | float):
    """b_j = r^j, as `Terms`: those of even j, and r q(u) with q = a_1 + a_3 u + …

    The cone a_1 r has no slope at its tip: a ray through the vertex sees the mean of all directions, 0.
    """
    S, dS, d2S = even_terms(u, coefficients[1::2], highest, along)
    q, dq, d2q = even_terms(u, coefficients[2::2], highest, along)
    q = coefficients[0] + q
    apart = u > _TIP
    r = torch.sqrt(torch.where(apart, u, 1.0))
    dr, r = torch.where(apart, 0.5 / r, 0.0), torch.where(apart, r, 0.0)
    S = S + r * q
    if highest == 0:
        return S, None, None
    dS = dS + dr * q + r * dq
    if highest == 1:
        return S, dS, None
    turn = dr * along
    return S, dS, d2S + r * d2q + 2 * turn * (dq * along) - 2 * dr * turn * turn * q


def conic_terms(
    u: Tensor, c: Tensor, conic: Tensor | None, highest: int, along: Tensor | float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """S = c u/(1+w), w = √(1 - (1+k) c² u); dS = c/2w, v² d²S = v² (1+k) c³/4w³; those above `highest` are 0."""
    shape = 1.0 if conic is None else 1 + conic
    radicand = 1 - shape * (c * (c * u))  # also its derivatives stay in range: neither c² nor r² c̄
    w = torch.sqrt(torch.where(radicand > 0, radicand, torch.finfo(u.dtype).tiny))
    S = c * u / (1 + w)
    dS = d2S = torch.zeros_like(u)
    if highest > 0:
        dS = 0.5 * c / w
    if highest > 1:
        tilt = c * along / w
        d2S = 0.25 * shape * c / w * tilt * tilt
    return S, dS, d2S
