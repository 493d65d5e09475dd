"""Shapes: one row for every kind of sag, which holds all that the rest of the package knows of the kind.

    z = c r²/(1 + √(1 - (1+k) c² r²)) + Σ_j a_j b_j(r²) + D(x, y)

KINDS tells the b_j, by `Surface.kind`; DEPARTURES tells D, by the class of `Surface.departure`. A new kind is a new
row: rays, derivatives, first order, variables, figures, files and, with its terms in fused/sags.h, the compiled trace
read it.
"""

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from raytrace.maths.numerics import polynomial
from raytrace.system import departure as own
from raytrace.system.departure import Departure, Sag

EVEN = "even asphere"

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


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of rotationally symmetric terms Σ_j a_j b_j(u), u = r², j = 1, 2, …

    terms: the sum and its derivatives.
    step: b_j is r^(step j), so that a_j is named for it and in mm^(1 - step j).
    zemax: TYPE of a .zmx file, where PARM j is a_j up to `parameters`; None: no such file holds it.
    words: what the column "type" of a table may say for it; where that says nothing the powers of the terms tell.
    code: the kind in fused/sags.h, which traces up to `compiled` terms; None: traced by torch alone.
    """

    name: str
    terms: Terms = even_terms
    step: int = 2
    zemax: str | None = None
    parameters: int = 8
    words: tuple[str, ...] = ()
    code: int | None = None
    compiled: int = 16

    @property
    def powers(self) -> str:
        """The powers of r that a file holds, in words."""
        first = {1: "r", 2: "r²"}.get(self.step, f"r^{self.step}")
        return f" ({first} to r^{self.step * self.parameters})"


KINDS = {
    kind.name: kind
    for kind in (
        Kind(EVEN, even_terms, zemax="EVENASPH", words=("even", "evenasph"), code=3),
        Kind("odd asphere", odd_terms, step=1, zemax="ODDASPHE", words=("odd", "oddasphe"), code=4, compiled=8),
    )
}


@dataclasses.dataclass(frozen=True)
class DepartureKind:
    """A kind of D(x, y), by functions of its `numbers`: float64 tensors, found once for every meeting with rays.

    sag: numbers, x, y (...) mm, highest derivative -> `Sag`; size: numbers -> bound on |D| mm, by which a crossing is
    bracketed; covers: numbers, x, y -> where there is a surface; prepare: to the departure whose tensors are the
    numbers; is_round: about the axis.
    """

    sag: Callable[[Sequence[Tensor], Tensor, Tensor, int], Sag]
    size: Callable[[Sequence[Tensor]], Tensor]
    covers: Callable[[Sequence[Tensor], Tensor, Tensor], Tensor] = lambda numbers, x, y: torch.ones_like(
        x, dtype=torch.bool
    )
    prepare: Callable = lambda departure: departure
    is_round: bool = False


DEPARTURES = {
    "GridSag": DepartureKind(own.spline_sag, own.spline_size, own.spline_covers, prepare=own.spline),
    "SplineSag": DepartureKind(own.spline_sag, own.spline_size, own.spline_covers),
    "ZernikeSag": DepartureKind(own.zernike_sag, own.zernike_size),
}


@dataclasses.dataclass(frozen=True)
class Relief:
    """A departure made ready for rays: its row, by the name of its class, and its numbers."""

    kind: str
    numbers: Sequence[Tensor]

    def sag(self, x: Tensor, y: Tensor, *, highest: int = 2) -> Sag:
        """D (...) mm and derivatives up to the `highest`; a grid's goes on beyond its edge with the height there."""
        return DEPARTURES[self.kind].sag(self.numbers, x, y, highest)

    def covers(self, x: Tensor, y: Tensor) -> Tensor:
        """Whether there is a surface at points (...) mm."""
        return DEPARTURES[self.kind].covers(self.numbers, x, y)

    def size(self) -> Tensor:
        """A bound on |D| in mm."""
        return DEPARTURES[self.kind].size(self.numbers)


def relief(departure: Departure) -> Relief:
    """A departure made ready. Raises ValueError for a grid of fewer than 4 × 4 heights."""
    name = type(departure).__name__
    return Relief(name, [number.double() for number in tree_leaves(DEPARTURES[name].prepare(departure))])


def sag_and_derivatives(
    u: Tensor,
    curvature: Tensor | None,
    conic: Tensor | None,
    coefficients: Tensor | None,
    highest: int = 2,
    *,
    along: Tensor | float = 1.0,
    kind: str = EVEN,
) -> tuple[Tensor, Tensor, Tensor]:
    """S(u), dS/du, d²S/du² v² with u = r² (...) in mm²; derivatives above the `highest` asked for stay 0.

    along: v, by whose square the second derivative comes multiplied: c³ alone leaves the range of numbers before any
    length or curvature does. Beyond the edge of a closed conic its radicand is held at 0+.

    S = c u/(1+w) + Σ_j a_j b_j,  w = √(1 - (1+k) c² u);  dS = c/2w + …;  d²S = (1+k) c³/4w³ + …
    """
    S = dS = d2S = torch.zeros_like(u)
    if curvature is not None:
        c = curvature
        shape = 1.0 if conic is None else 1 + conic
        radicand = 1 - shape * (c * (c * u))  # also its derivatives stay in range: neither c² nor r² c̄
        w = torch.sqrt(torch.where(radicand > 0, radicand, torch.finfo(u.dtype).tiny))
        S = c * u / (1 + w)
        if highest > 0:
            dS = 0.5 * c / w
        if highest > 1:
            tilt = c * along / w
            d2S = 0.25 * shape * c / w * tilt * tilt
    if coefficients is not None:
        P, dP, d2P = KINDS[kind].terms(u, coefficients, highest, along)
        S = S + P
        dS = dS if dP is None else dS + dP
        d2S = d2S if d2P is None else d2S + d2P
    return S, dS, d2S


def size_of_terms(u: Tensor, coefficients: Tensor, kind: str = EVEN) -> Tensor:
    """Σ_j |a_j| b_j (...): what the terms add up from, by which their rounding is judged."""
    return KINDS[kind].terms(u, coefficients.abs(), 0, 1.0)[0]
