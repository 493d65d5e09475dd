"""Shapes of surfaces: conic, even and odd asphere, toroid, biconic, and sag terms added to a round sag.

    z = c r²/(1 + √(1 - (1+k) c² r²)) + Σ_j a_j b_j(r²) + D(x, y)
    toroidal   z = g + c_x x²/(q + √(q² - c_x² x²)),  q = 1 - c_x g,  g = g(y) a conic and Σ_j a_j y^(2j)
    biconic    z = (c_x x² + c y²)/(1 + √(1 - (1+k_x) c_x² x² - (1+k) c² y²))

A toroid is the curve g turned about a line along y through z = 1/c_x. Of toroid and biconic, curvature c and conic k
are those of the section along y; the other numbers are coefficients. Beyond its edge a surface keeps the height there.

KINDS has a row for each `Surface.kind`, `sag_terms.SAG_TERMS` one for each class of `Surface.sag_terms`, D(x, y). A new
kind is a function and a row, read by tracing, derivatives, first order, variables, tolerances, figures and files, and a
function in tracing/cpp/sags.h, from which the compiled engine derives its trace, adjoint and tangents.
"""

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from raytrace.maths.bivariate import Sag
from raytrace.maths.numerics import Number, polynomial

EVEN = "even asphere"
_TIP = 1e-24  # mm²: r² up to which a ray goes through the vertex


#: The terms of a sag: u (...), coefficients (m, ...), highest derivative, a factor f -> Σ_j a_j b_j(u), its slope and
#: f² times its second derivative; None for those above the highest. The b_j are at least 0.
Sums = tuple[Tensor, Tensor | None, Tensor | None]
Terms = Callable[[Tensor, Tensor, int, Tensor | float], Sums]


def even_terms(u: Tensor, coefficients: Tensor, highest: int, along: Tensor | float) -> Sums:
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


def odd_terms(u: Tensor, coefficients: Tensor, highest: int, along: Tensor | float) -> Sums:
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
    if dS is None or dq is None:
        return S, None, None
    dS = dS + dr * q + r * dq
    if d2S is None or d2q is None:
        return S, dS, None
    turn = dr * along
    return S, dS, d2S + r * d2q + 2 * turn * (dq * along) - 2 * dr * turn * turn * q


def conic_sag(u: Number, c: Number, w: Number) -> Number:
    """c u/(1+w) of u = r² and the root w = √(1 - (1+k) c² u). Any number type."""
    return c * u / (1 + w)


def curvature_through(z: Number, h: Number, shape: Number = 1.0) -> Number:
    """c = 2z/(h² + (1+k) z²) of the conic through the vertex that has a sag z at a radius h; shape: 1+k."""
    return 2 * z / (h**2 + shape * z * z)


def conic_terms(
    u: Tensor, c: Tensor, conic: Tensor | None, highest: int, along: Tensor | float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """S = c u/(1+w), w = √(1 - (1+k) c² u); dS = c/2w, v² d²S = v² (1+k) c³/4w³; those above `highest` are 0."""
    shape = 1.0 if conic is None else 1 + conic
    radicand = 1 - shape * (c * (c * u))  # also its derivatives stay in range: neither c² nor r² c̄
    w = torch.sqrt(torch.where(radicand > 0, radicand, torch.finfo(u.dtype).tiny))
    S = conic_sag(u, c, w)
    dS = d2S = torch.zeros_like(u)
    if highest > 0:
        dS = 0.5 * c / w
    if highest > 1:
        tilt = c * along / w
        d2S = 0.25 * shape * c / w * tilt * tilt
    return S, dS, d2S


@dataclasses.dataclass(frozen=True)
class Form:
    """A sag of x and y, by functions of curvature c (...), conic k (...), coefficients a (m, ...), and points (...) mm.

    sag: with its derivatives up to the highest; covers: where there is a surface, on the sheet of the vertex;
    extent: of c, k, a and a limit (...) mm, how far that sheet goes along x and y, at most to the limit;
    size: of c, a and points, the magnitudes of the terms of a sag without its height, by which its rounding is judged.
    By default a sag covers the plane.
    """

    sag: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, int], Sag]
    covers: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor] = lambda c, k, a, x, y: torch.isfinite(x + y)
    extent: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]] = lambda c, k, a, limit: (limit, limit)
    size: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor] = lambda c, a, x, y: torch.zeros_like(x + y)


def _section(c: Tensor, k: Tensor, a: Tensor, y: Tensor, highest: int) -> tuple[Tensor, Tensor, Tensor]:
    """g(y), g' and g''."""
    S, dS, d2S = conic_terms(y * y, c, k, highest, y)
    if len(a):
        P, dP, d2P = even_terms(y * y, a, highest, y)
        S, dS, d2S = S + P, dS if dP is None else dS + dP, d2S if d2P is None else d2S + d2P
    return S, 2 * dS * y, 2 * dS + 4 * d2S


def _toroid(c: Tensor, k: Tensor, a: Tensor, x: Tensor, y: Tensor, highest: int) -> Sag:
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


def _toroid_covers(c: Tensor, k: Tensor, a: Tensor, x: Tensor, y: Tensor) -> Tensor:
    g, *_ = _section(c, k, a[1:], y, 0)
    q = 1 - a[0] * g
    return (1 - (1 + k) * (c * (c * (y * y))) > 0) & (q > 0) & (q > (a[0] * x).abs())


def _toroid_extent(c: Tensor, k: Tensor, a: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    along_y = _edge(c, k, limit)
    y = torch.linspace(0, 1, 17, dtype=c.dtype, device=c.device).reshape(-1, *(1,) * along_y.dim()) * along_y
    q = 1 - a[0] * _section(c, k, a[1:], y * (1 - 1e-8), 0)[0]
    reach = q.amax(0) / torch.where(a[0] == 0, 1.0, a[0]).abs()
    return torch.where((a[0] != 0) & (reach < limit), reach, limit), along_y


def _biconic(c: Tensor, k: Tensor, a: Tensor, x: Tensor, y: Tensor, highest: int) -> Sag:
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


def _biconic_covers(c: Tensor, k: Tensor, a: Tensor, x: Tensor, y: Tensor) -> Tensor:
    p, q = a[0] * x, c * y
    return 1 - (1 + a[1]) * (p * p) - (1 + k) * (q * q) > 0


def _biconic_extent(c: Tensor, k: Tensor, a: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    """A section that stays open along one axis moves the edge along the other axis outwards."""
    open_x, open_y = (
        torch.sqrt(1 + (-(1 + conic) * (bend * limit) ** 2).clamp_min(0.0)) for bend, conic in ((a[0], a[1]), (c, k))
    )
    return (_edge(a[0], a[1], limit) * open_y).minimum(limit), (_edge(c, k, limit) * open_x).minimum(limit)


def _size(c: Tensor, a: Tensor, x: Tensor, y: Tensor, terms: Tensor | float = 0.0) -> Tensor:
    return (c * y * y).abs() + (a[0] * x * x).abs() + terms


def _toroid_size(c: Tensor, a: Tensor, x: Tensor, y: Tensor) -> Tensor:
    return _size(c, a, x, y, even_terms(y * y, a[1:].abs(), 0, 1.0)[0])


def _edge(c: Tensor, k: Tensor, limit: Tensor) -> Tensor:
    """The radius at which a conic closes, at most the limit."""
    closed = (1 + k) * c * c
    return torch.where(closed > 0, torch.rsqrt(torch.where(closed > 0, closed, 1.0)), limit).minimum(limit)


TOROIDAL = Form(_toroid, _toroid_covers, _toroid_extent, _toroid_size)
BICONIC = Form(_biconic, _biconic_covers, _biconic_extent, _size)


#: Power of length of the first coefficients of kinds that are not round, and their sign on a turned surface.
HEADS = {"curvature_x": (-1, -1), "conic_x": (0, 1)}


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of sag: a conic with rotationally symmetric terms Σ_j a_j b_j(u), u = r², j = 1, 2, …, or a form.

    terms: the sum and its derivatives.
    form: the whole sag of a kind that is not round; curvature and conic are those of its section along y.
    heads: names of the first coefficients of such a kind, which the a_j of y² … follow, if it has any.
    least, most: the smallest and largest number of its coefficients.
    step: b_j is r^(step j), so that a_j is named for it and in mm^(1 - step j).
    zemax: TYPE of a .zmx file, where PARM j is a_j up to `parameters`; None: no such file holds it.
    words: entries of the column "type" of a table; an empty one is resolved by the powers of the terms.
    code: its place in `Kind` of tracing/cpp/sags.h, which traces up to `compiled` coefficients; None: torch traces it.
    """

    name: str
    terms: Terms = even_terms
    form: Form | None = None
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
        """The name of a coefficient, counted from 0: a4 is that of r⁴, or of y⁴."""
        heads = len(self.heads)
        return self.heads[entry] if entry < heads else f"a{self.step * (entry - heads + 1)}"

    def power_of(self, entry: int) -> int:
        """The power of length in a coefficient, counted from 0."""
        heads = len(self.heads)
        return HEADS[self.heads[entry]][0] if entry < heads else 1 - self.step * (entry - heads + 1)

    def sign_of(self, entry: int) -> int:
        """The sign of a coefficient, counted from 0, on a surface that is turned around: z(x, y) -> -z(-x, y)."""
        return HEADS[self.heads[entry]][1] if entry < len(self.heads) else -1

    @property
    def powers(self) -> str:
        """The powers of r that a file holds, in words."""
        first = {1: "r", 2: "r²"}.get(self.step, f"r^{self.step}")
        return f" ({first} to r^{self.step * self.parameters})"


KINDS = {
    kind.name: kind
    for kind in (
        Kind(EVEN, even_terms, zemax="EVENASPH", words=("even", "evenasph"), code=4),
        Kind("odd asphere", odd_terms, step=1, zemax="ODDASPHE", words=("odd", "oddasphe"), code=5, compiled=8),
        Kind("toroidal", zemax="TOROIDAL", form=TOROIDAL, heads=("curvature_x",), least=1, most=8, code=6, compiled=8),
        Kind("biconic", zemax="BICONICX", form=BICONIC, heads=("curvature_x", "conic_x"), least=2, most=2, code=7),
    )
}


def size_of_terms(u: Tensor, coefficients: Tensor, kind: str = EVEN) -> Tensor:
    """Σ_j |a_j| b_j (...), the size of the terms, by which their rounding is judged."""
    return KINDS[kind].terms(u, coefficients.abs(), 0, 1.0)[0]
