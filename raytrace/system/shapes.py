"""Shapes: one row for every kind of sag, which holds all that the rest of the package knows of the kind.

    z = c r²/(1 + √(1 - (1+k) c² r²)) + Σ_j a_j b_j(r²) + D(x, y)

KINDS tells the b_j, by `Surface.kind`, or the form that a kind has in place of them and the conic; SAG_TERMS tells D,
by the class of `Surface.sag_terms`. A new kind is a new row: rays, derivatives, first order, variables, figures, files
and, with its terms in tracing/cpp/sags.h, the compiled trace read it.
"""

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from raytrace.system import freeform
from raytrace.system import sag_terms as own
from raytrace.system.polynomials import (
    IrregularSag,
    PolynomialSag,
    PowerSag,
    TiltSag,
    as_polynomial,
    polynomial_sag,
    polynomial_size,
    power_sag,
    power_size,
    powers_of_fringe,
    powers_of_polynomial,
    powers_of_zernike,
)
from raytrace.system.sag_terms import FringeSag, GridSag, Sag, SplineSag, ZernikeSag
from raytrace.system.terms import Terms, conic_terms, even_terms, odd_terms

EVEN = "even asphere"


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of sag: of rotationally symmetric terms Σ_j a_j b_j(u), u = r², j = 1, 2, …, or of a form of its own.

    terms: the sum and its derivatives.
    form: the whole sag of a kind that is not round; curvature and conic are those of its section along y.
    heads: names of the first coefficients of such a kind; only then come the a_j, of y² … or none.
    least, most: how many coefficients it has.
    step: b_j is r^(step j), so that a_j is named for it and in mm^(1 - step j).
    zemax: TYPE of a .zmx file, where PARM j is a_j up to `parameters`; None: no such file holds it.
    words: what the column "type" of a table may say for it; where that says nothing the powers of the terms tell.
    code: the kind in tracing/cpp/sags.h, which traces up to `compiled` terms; None: traced by torch alone.
    """

    name: str
    terms: Terms = even_terms
    form: freeform.Form | None = None
    heads: tuple[str, ...] = ()
    least: int = 0
    most: int | None = None
    step: int = 2
    zemax: str | None = None
    parameters: int = 8
    words: tuple[str, ...] = ()
    code: int | None = None
    compiled: int = 16

    @property
    def is_round(self) -> bool:
        """Whether the sag depends on r alone."""
        return self.form is None

    def name_of(self, entry: int) -> str:
        """What a coefficient is called, counted from 0: a4 is that of r⁴, or of y⁴."""
        heads = len(self.heads)
        return self.heads[entry] if entry < heads else f"a{self.step * (entry - heads + 1)}"

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
        Kind(
            "toroidal",
            zemax="TOROIDAL",
            form=freeform.TOROIDAL,
            heads=("curvature_x",),
            least=1,
            most=8,
            code=5,
            compiled=8,
        ),
        Kind(
            "biconic",
            zemax="BICONICX",
            form=freeform.BICONIC,
            heads=("curvature_x", "conic_x"),
            least=2,
            most=2,
            code=6,
        ),
    )
}


@dataclasses.dataclass(frozen=True)
class SagTermKind:
    """A kind of D(x, y), by functions of its `numbers`: float64 tensors, found once for every meeting with rays.

    sag: numbers, x, y (...) mm, highest derivative -> `Sag`; size: numbers, radius (...) mm -> bound on |D| mm within
    it, by which a crossing is bracketed and rounding is judged; covers: numbers, x, y -> where there is a surface;
    prepare: to the sag terms whose tensors are the numbers; is_round: about the axis.
    powers: to the same as powers about a centre, which the compiled trace takes, up to `compiled` coefficients; None:
    traced by torch alone.
    """

    sag: Callable[[Sequence[Tensor], Tensor, Tensor, int], Sag]
    size: Callable[[Sequence[Tensor], Tensor], Tensor]
    covers: Callable[[Sequence[Tensor], Tensor, Tensor], Tensor] = lambda numbers, x, y: torch.ones_like(
        x, dtype=torch.bool
    )
    prepare: Callable = lambda sag_terms: sag_terms
    is_round: bool = False
    powers: Callable | None = None
    compiled: int | None = None


SAG_TERMS = {
    "GridSag": SagTermKind(own.spline_sag, own.spline_size, own.spline_covers, prepare=own.spline),
    "SplineSag": SagTermKind(own.spline_sag, own.spline_size, own.spline_covers),
    "ZernikeSag": SagTermKind(own.zernike_sag, own.zernike_size, powers=powers_of_zernike, compiled=91),
    "FringeSag": SagTermKind(own.fringe_sag, own.fringe_size, powers=powers_of_fringe, compiled=37),
    "PolynomialSag": SagTermKind(polynomial_sag, polynomial_size, powers=powers_of_polynomial),
    "IrregularSag": SagTermKind(polynomial_sag, polynomial_size, prepare=as_polynomial, powers=powers_of_polynomial),
    "TiltSag": SagTermKind(polynomial_sag, polynomial_size, prepare=as_polynomial, powers=powers_of_polynomial),
    "PowerSag": SagTermKind(power_sag, power_size, powers=lambda sag_terms: sag_terms),
}

SagTerms = GridSag | SplineSag | ZernikeSag | FringeSag | PolynomialSag | IrregularSag | TiltSag | PowerSag


@dataclasses.dataclass(frozen=True)
class Relief:
    """sag terms made ready for rays: its row, by the name of its class, and its numbers."""

    kind: str
    numbers: Sequence[Tensor]

    def sag(self, x: Tensor, y: Tensor, *, highest: int = 2) -> Sag:
        """D (...) mm and derivatives up to the `highest`; a grid's goes on beyond its edge with the height there."""
        return SAG_TERMS[self.kind].sag(self.numbers, x, y, highest)

    def covers(self, x: Tensor, y: Tensor) -> Tensor:
        """Whether there is a surface at points (...) mm."""
        return SAG_TERMS[self.kind].covers(self.numbers, x, y)

    def size(self, radius: Tensor) -> Tensor:
        """A bound on |D| in mm up to a radius (...) mm; of grids and Zernike polynomials over all that they cover."""
        return SAG_TERMS[self.kind].size(self.numbers, radius)


def relief(sag_terms: SagTerms) -> Relief:
    """sag terms made ready. Raises ValueError for a grid of fewer than 4 × 4 heights."""
    name = type(sag_terms).__name__
    return Relief(name, [number.double() for number in tree_leaves(SAG_TERMS[name].prepare(sag_terms))])


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
        S, dS, d2S = conic_terms(u, curvature, conic, highest, along)
    if coefficients is not None:
        P, dP, d2P = KINDS[kind].terms(u, coefficients, highest, along)
        S = S + P
        dS = dS if dP is None else dS + dP
        d2S = d2S if d2P is None else d2S + d2P
    return S, dS, d2S


def size_of_terms(u: Tensor, coefficients: Tensor, kind: str = EVEN) -> Tensor:
    """Σ_j |a_j| b_j (...): what the terms add up from, by which their rounding is judged."""
    return KINDS[kind].terms(u, coefficients.abs(), 0, 1.0)[0]
