"""Sag terms: D(x, y), added to the conic and even terms of a surface, z = S(r²) + D(x, y).

    GridSag         D = Σ_ij c_ij B(x/p - i) B(y/p - j), the cubic spline through heights at points p apart
    SplineSag       that spline by its coefficients c, computed once
    ZernikeSag      D = Σ_j c_j Z_j(x/R, y/R), Noll's polynomials
    FringeSag       D = Σ_j c_j F_j((x - x_0)/R, (y - y_0)/R), the fringe polynomials, which are 1 at the rim
    PolynomialSag   D = Σ_k c_k E_k(x/R, y/R),  E = x, y, x², xy, y², x³, x²y, …
    IrregularSag    D = Z_s ρ⁴ + Z_a v² + Z_c ρ² v,  ρ = r/R,  v = (y cos θ - x sin θ)/R
    TiltSag         D = x tan_x + y tan_y
    PowerSag        D = h + Σ_k c_k E_k(u, v),  u = (x - x_0)/R,  v = (y - y_0)/R

Slopes and second derivatives are written out, and autograd may differentiate them further. Functions take the tensors
of sag terms in float64; each kind is a row of SAG_TERMS. IrregularSag and TiltSag are converted to
PolynomialSag and, for the compiled trace, all but splines to PowerSag, by linear maps that autograd follows.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from raytrace.maths.bivariate import Sag, degree, polynomial_xy, powers, round_power, shifted, zernike_to_powers
from raytrace.maths.numerics import broadcast_shape, polynomial, value
from raytrace.maths.zernike import Jacobi, Order, fringe, harmonics, jacobi, noll, norm
from raytrace.system.poses import cos_sin

_LEAST = 4  # points along a side of a grid: a cubic
_FELT = 32  # points: influence falls by 2 - √3 from one to the next, to 1e-18
_BLOCK = 128  # coefficients that are computed together
_FRINGE_DEGREE = 5  # of powers that fringe terms hold


@value
class GridSag:
    """The spline through heights (rows, columns) mm at points `pitch` mm apart, the vertex in their middle.

    Row 0 lies at the smallest y, column 0 at the smallest x. The spline is cubic with continuous second derivatives;
    at the ends the third derivative is continuous at the last point but one ("not a knot"), so that the error falls as
    pitch⁴ up to the rim. The surface ends half a pitch beyond the outermost points: a ray that crosses farther out
    misses it. The coefficients of the spline are computed anew for every batch of rays: see `spline`.
    """

    heights: Tensor
    pitch: Tensor


@value
class SplineSag:
    """A cubic spline by its coefficients (rows + 2, columns + 2) mm, those beyond either end included; pitch: mm."""

    coefficients: Tensor
    pitch: Tensor


@value
class ZernikeSag:
    """Noll's polynomials from j = 1: coefficients (J,) mm RMS over the disc of `radius` mm, valid beyond it too."""

    coefficients: Tensor
    radius: Tensor


@value
class FringeSag:
    """The fringe polynomials from j = 1: coefficients (J,) mm at the rim of the disc of `radius` mm, valid beyond too.

    centre_x, centre_y: mm, the centre of the disc.
    """

    coefficients: Tensor
    radius: Tensor
    centre_x: Tensor
    centre_y: Tensor


def spline(grid: GridSag) -> SplineSag:
    """The spline of a grid, in float64, differentiable in the heights: a lens traced many times computes it once.

    Raises ValueError for a grid of fewer than 4 × 4 heights.
    """
    heights = grid.heights.double()
    rows, columns = heights.shape
    if min(rows, columns) < _LEAST:
        raise ValueError(f"{rows} × {columns} heights: a cubic spline needs at least {_LEAST} × {_LEAST}")
    return SplineSag(_spline_coefficients(_spline_coefficients(heights).T).T, grid.pitch.double())


def spline_covers(numbers: Sequence[Tensor], x: Tensor, y: Tensor) -> Tensor:
    """Whether points (...) mm lie on the grid."""
    c, pitch = numbers
    half_y, half_x = (0.5 * (count - 2) * pitch for count in c.shape)
    return (x.abs() <= half_x) & (y.abs() <= half_y)


def spline_size(numbers: Sequence[Tensor], radius: Tensor) -> Tensor:
    """A bound on |D| over the grid: the weights of a spline are positive and sum to 1."""
    return numbers[0].abs().max()


def zernike_size(numbers: Sequence[Tensor], radius: Tensor) -> Tensor:
    """A bound on |D| over the disc."""
    c = numbers[0]
    norms = c.new_tensor([norm(*noll(j)) for j in range(1, len(c) + 1)])
    return (norms * c.abs()).sum()


def fringe_size(numbers: Sequence[Tensor], radius: Tensor) -> Tensor:
    """A bound on |D| over the disc."""
    return numbers[0].abs().sum()


def _spline_coefficients(heights: Tensor) -> Tensor:
    """Coefficients (n + 2, ...) along the first axis of heights (n, ...); each depends on the heights near it alone."""
    count = len(heights)
    matrix = _prefilter(count).to(heights)
    parts = []
    for first in range(0, count + 2, _BLOCK):
        near = slice(max(first - _FELT, 0), first + _BLOCK + _FELT)
        parts.append(matrix[first : first + _BLOCK, near] @ heights[near])
    return torch.cat(parts)


@functools.lru_cache(maxsize=8)
def _prefilter(count: int) -> Tensor:
    """Matrix (n + 2, n) from heights at n points to the coefficients of their spline, c[k] at the point k - 1.

    (c[k-1] + 4 c[k] + c[k+1])/6 = h,   the fourth differences of the first five and the last five c are 0
    """
    system = torch.zeros((count + 2, count + 2), dtype=torch.float64)
    for k in range(count):
        system[k + 1, k : k + 3] = torch.tensor([1 / 6, 4 / 6, 1 / 6], dtype=torch.float64)
    system[0, :5] = system[-1, -5:] = torch.tensor([1.0, -4.0, 6.0, -4.0, 1.0], dtype=torch.float64)
    return torch.linalg.inv(system)[:, 1:-1].contiguous()


def spline_sag(numbers: Sequence[Tensor], x: Tensor, y: Tensor, highest: int) -> Sag:
    """The spline at points (...) mm; beyond its edge with the height there."""
    x, y = torch.broadcast_tensors(x, y)
    c, pitch = (number.to(x.dtype) for number in numbers)
    row, weights_y = _weights(y / pitch, c.shape[0] - 2, highest)
    column, weights_x = _weights(x / pitch, c.shape[1] - 2, highest)
    lines = [[c[row + a, column + b] for b in range(4)] for a in range(4)]

    def term(along_x: int, along_y: int) -> Tensor:
        if along_x + along_y > highest:
            return torch.zeros_like(x)
        sums = [_combined(weights_x[along_x], line) for line in lines]
        return _combined(weights_y[along_y], sums) / pitch ** (along_x + along_y)

    return Sag(*(term(*orders) for orders in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))))


def _weights(place: Tensor, count: int, highest: int) -> tuple[Tensor, list[Sequence[Tensor]]]:
    """The first of the four coefficients (...) at a point, and their weights with `highest` derivatives by place.

    place: (...) in pitches from the middle; beyond the edge it is held there.
    """
    last = 0.5 * count
    held = place.clamp(-last, last)
    inside = (place.detach().abs() <= last).to(place.dtype)
    place = held + 0.5 * (count - 1)
    cell = place.detach().floor().clamp(0, count - 2)
    f = place - cell
    g = 1 - f
    weights: list[Sequence[Tensor]] = [(g**3 / 6, (f**2 * (3 * f - 6) + 4) / 6, (g**2 * (3 * g - 6) + 4) / 6, f**3 / 6)]
    if highest > 0:
        slopes = (-0.5 * g**2, f * (1.5 * f - 2), g * (2 - 1.5 * g), 0.5 * f**2)
        weights.append([inside * w for w in slopes])
    if highest > 1:
        weights.append([inside * w for w in (g, 3 * f - 2, 3 * g - 2, f)])
    return cell.long(), weights


def _combined(weights: Sequence[Tensor], values: Sequence[Tensor]) -> Tensor:
    """Σ w v, written out: the order of a reduction would depend on the shape of the batch."""
    (w, *others), (v, *rest) = weights, values
    total = w * v
    for w, v in zip(others, rest, strict=True):
        total = torch.addcmul(total, w, v)
    return total


def zernike_sag(numbers: Sequence[Tensor], x: Tensor, y: Tensor, highest: int) -> Sag:
    """Σ_j c_j Z_j of Noll's terms at points (...) mm."""
    c, radius = (number.to(x.dtype) for number in numbers)
    orders = [noll(j) for j in range(1, len(c) + 1)]
    terms = [(order, a * norm(*order)) for order, a in zip(orders, c.unbind(0), strict=True)]
    return _summed(terms, radius, x, y, highest)


def fringe_sag(numbers: Sequence[Tensor], x: Tensor, y: Tensor, highest: int) -> Sag:
    """Σ_j c_j F_j of the fringe terms at points (...) mm."""
    c, radius, centre_x, centre_y = (number.to(x.dtype) for number in numbers)
    terms = [(fringe(j), a) for j, a in enumerate(c.unbind(0), 1)]
    return _summed(terms, radius, x - centre_x, y - centre_y, highest)


def _summed(terms: Sequence[tuple[Order, Tensor]], radius: Tensor, x: Tensor, y: Tensor, highest: int) -> Sag:
    """Σ_m (Σ_k c_mk P_k(t)) H_m, t = 2 r² - 1, with the harmonics H_m of `zernike.polynomials`; ∇²H = 0."""
    x, y = torch.broadcast_tensors(x / radius, y / radius)
    t, known = 2 * (x * x + y * y) - 1, Jacobi()
    radial: dict[int, list[Tensor]] = {}
    for (n, m), c in terms:
        parts = [c * p for p in jacobi(known, n, m, t, highest)]
        radial[m] = [a + b for a, b in zip(radial[m], parts, strict=True)] if m in radial else parts
    pairs = harmonics([order for order, _ in terms], x, y)
    z, zx, zy, zxx, zxy, zyy = (torch.zeros_like(x),) * 6
    for m, (p, *slopes) in radial.items():
        size = abs(m)
        # H of m > 0 is Re (x + iy)^m, and of m < 0 Im (x + iy)^|m| = Re (-i (x + iy)^|m|).
        lower = [pairs[max(size - j, 0)] for j in range(3)]
        (h, _), (c, s), (cc, ss) = lower if m >= 0 else [(im, -re) for re, im in lower]
        z = z + p * h
        if highest > 0:
            dp, hx, hy = slopes[0], size * c, -size * s
            zx = zx + 4 * x * dp * h + p * hx
            zy = zy + 4 * y * dp * h + p * hy
        if highest > 1:
            d2p, hxx, hxy = slopes[1], size * (size - 1) * cc, -size * (size - 1) * ss
            both = 4 * dp * h
            zxx = zxx + both + 16 * x * x * d2p * h + 8 * x * dp * hx + p * hxx
            zxy = zxy + 16 * x * y * d2p * h + 4 * dp * (x * hy + y * hx) + p * hxy
            zyy = zyy + both + 16 * y * y * d2p * h + 8 * y * dp * hy - p * hxx
    return Sag(z, zx / radius, zy / radius, *(s / radius**2 for s in (zxx, zxy, zyy)))


@value
class PolynomialSag:
    """Powers of x/R and y/R by coefficients (J,) mm: x, y, x², xy, y², x³, x²y, …; radius: R mm."""

    coefficients: Tensor
    radius: Tensor


@value
class IrregularSag:
    """Errors of fabrication by their height in mm at `radius` mm: spherical aberration, astigmatism and coma.

    angle: degrees, by which astigmatism and coma are turned from y.
    """

    spherical: Tensor
    astigmatism: Tensor
    coma: Tensor
    angle: Tensor
    radius: Tensor


@value
class TiltSag:
    """A tilted plane: its slopes along x and y, tangents."""

    tan_x: Tensor
    tan_y: Tensor


@value
class PowerSag:
    """A height and powers about a centre, all in mm; coefficients: (J,) of u, v, u², uv, v², …"""

    centre_x: Tensor
    centre_y: Tensor
    radius: Tensor
    height: Tensor
    coefficients: Tensor


def as_polynomial(sag_terms: IrregularSag | TiltSag) -> PolynomialSag:
    """An irregular sag or a tilted plane as a sum of powers."""
    if isinstance(sag_terms, TiltSag):
        return PolynomialSag(torch.stack([sag_terms.tan_x, sag_terms.tan_y]), torch.ones_like(sag_terms.tan_x))
    cosine, sine = cos_sin(sag_terms.angle)
    zero, across = torch.zeros_like(sag_terms.coma), -sine * sag_terms.coma
    along, s = cosine * sag_terms.coma, sag_terms.spherical
    bent = [a * sag_terms.astigmatism for a in (sine * sine, -2 * sine * cosine, cosine * cosine)]
    return PolynomialSag(
        torch.stack([zero, zero, *bent, across, along, across, along, s, zero, 2 * s, zero, s]), sag_terms.radius
    )


def polynomial_sag(numbers: Sequence[Tensor], x: Tensor, y: Tensor, highest: int) -> Sag:
    """The sum of powers at points (...) mm."""
    c, radius = (number.to(x.dtype) for number in numbers)
    z, *slopes = polynomial_xy(c, x / radius, y / radius, highest)
    return Sag(z, *(slope / radius for slope in slopes[:2]), *(bend / radius**2 for bend in slopes[2:]))


def polynomial_size(numbers: Sequence[Tensor], radius: Tensor) -> Tensor:
    """A bound on |D| up to a radius (...) mm: Σ |c| (r/R)^degree."""
    c, unit = numbers
    degrees = [sum(power) for power in powers(len(c))]
    sums = [torch.zeros_like(c[0])] * (max(degrees, default=0) + 1) if len(c) else [c.new_zeros(())]
    for power, a in zip(degrees, c.abs().unbind(0), strict=True):
        sums[power] = sums[power] + a
    return polynomial(torch.stack(sums), radius / unit.abs())


def powers_of_polynomial(sag_terms: PolynomialSag | IrregularSag | TiltSag) -> PowerSag:
    """A sum of powers about the vertex as powers about a centre."""
    polynomial = sag_terms if isinstance(sag_terms, PolynomialSag) else as_polynomial(sag_terms)
    zero = torch.zeros_like(polynomial.radius)
    return PowerSag(zero, zero, polynomial.radius, zero, polynomial.coefficients)


def powers_of_fringe(sag_terms: FringeSag) -> PowerSag:
    """Fringe terms as powers about their centre."""
    orders = [fringe(j) for j in range(1, len(sag_terms.coefficients) + 1)]
    height, powers_ = _powers_of(orders, sag_terms.coefficients)
    return PowerSag(sag_terms.centre_x, sag_terms.centre_y, sag_terms.radius, height, powers_)


def powers_of_zernike(sag_terms: ZernikeSag) -> PowerSag:
    """Noll's terms as powers about the vertex."""
    orders = [noll(j) for j in range(1, len(sag_terms.coefficients) + 1)]
    norms = sag_terms.coefficients.new_tensor([norm(*order) for order in orders])
    height, powers_ = _powers_of(orders, norms * sag_terms.coefficients)
    zero = torch.zeros_like(sag_terms.radius)
    return PowerSag(zero, zero, sag_terms.radius, height, powers_)


def _powers_of(orders: Sequence[Order], coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """The height and the coefficients of powers of a sum of Zernike's terms, 1 at the rim."""
    matrix, constants = (coefficients.new_tensor(part) for part in zernike_to_powers(tuple(orders)))
    return (constants * coefficients).sum(), matrix @ coefficients


def power_sag(numbers: Sequence[Tensor], x: Tensor, y: Tensor, highest: int) -> Sag:
    """The height and the powers at points (...) mm."""
    centre_x, centre_y, radius, height, coefficients = (number.to(x.dtype) for number in numbers)
    sag = polynomial_sag((coefficients, radius), x - centre_x, y - centre_y, highest)
    return sag._replace(z=sag.z + height)


def power_size(numbers: Sequence[Tensor], radius: Tensor) -> Tensor:
    """A bound on |D| up to a radius (...) mm of the vertex."""
    centre_x, centre_y, unit, height, coefficients = numbers
    return height.abs() + polynomial_size((coefficients, unit), radius + centre_x.abs() + centre_y.abs())


@dataclasses.dataclass(frozen=True)
class SagTermKind:
    """A kind of D(x, y), by functions of its `numbers`: float64 tensors, computed once for a batch of rays.

    sag: numbers, x, y (...) mm, highest derivative -> `Sag`; size: numbers, radius (...) mm -> bound on |D| mm within
    it, by which a crossing is bracketed and rounding is judged; covers: numbers, x, y -> where there is a surface;
    prepare: to the sag terms whose tensors are the numbers; is_round: about the axis.
    axes: of each of its numbers in one lens; further axes vary from lens to lens, and from ray to ray.
    powers: to powers about a centre, which the compiled trace takes, up to `compiled` coefficients; None:
    traced by torch alone.
    """

    sag: Callable[[Sequence[Tensor], Tensor, Tensor, int], Sag]
    size: Callable[[Sequence[Tensor], Tensor], Tensor]
    covers: Callable[[Sequence[Tensor], Tensor, Tensor], Tensor] = lambda _, x, y: torch.ones_like(x, dtype=torch.bool)
    prepare: Callable[[Any], "SagTerms"] = lambda sag_terms: sag_terms
    is_round: bool = False
    axes: tuple[int, ...] = (1, 0)
    powers: Callable[[Any], PowerSag] | None = None
    compiled: int | None = None


SAG_TERMS = {
    "GridSag": SagTermKind(spline_sag, spline_size, spline_covers, prepare=spline, axes=(2, 0)),
    "SplineSag": SagTermKind(spline_sag, spline_size, spline_covers, axes=(2, 0)),
    "ZernikeSag": SagTermKind(zernike_sag, zernike_size, powers=powers_of_zernike, compiled=91),
    "FringeSag": SagTermKind(fringe_sag, fringe_size, axes=(1, 0, 0, 0), powers=powers_of_fringe, compiled=37),
    "PolynomialSag": SagTermKind(polynomial_sag, polynomial_size, powers=powers_of_polynomial),
    "IrregularSag": SagTermKind(polynomial_sag, polynomial_size, prepare=as_polynomial, powers=powers_of_polynomial),
    "TiltSag": SagTermKind(polynomial_sag, polynomial_size, prepare=as_polynomial, powers=powers_of_polynomial),
    "PowerSag": SagTermKind(power_sag, power_size, axes=(0, 0, 0, 0, 1), powers=lambda sag_terms: sag_terms),
}

SagTerms = GridSag | SplineSag | ZernikeSag | FringeSag | PolynomialSag | IrregularSag | TiltSag | PowerSag


@dataclasses.dataclass(frozen=True)
class Relief:
    """Sag terms prepared for rays: the row, by the name of the class, and its numbers."""

    kind: str
    numbers: Sequence[Tensor]

    def sag(self, x: Tensor, y: Tensor, *, highest: int = 2) -> Sag:
        """D (...) mm and derivatives up to the `highest`; beyond the edge of a grid, D is that of the edge."""
        return SAG_TERMS[self.kind].sag(self.numbers, x, y, highest)

    def covers(self, x: Tensor, y: Tensor) -> Tensor:
        """Whether there is a surface at points (...) mm."""
        return SAG_TERMS[self.kind].covers(self.numbers, x, y)

    def size(self, radius: Tensor) -> Tensor:
        """A bound on |D| in mm up to a radius (...) mm; of grids and Zernike polynomials over all that they cover."""
        return SAG_TERMS[self.kind].size(self.numbers, radius)

    @property
    def batch(self) -> torch.Size:
        """The shape of the axes along which its numbers vary."""
        return broadcast_shape(*(number.shape[axes:] for number, axes in self._with_axes()))

    def flat(self, batch: Sequence[int]) -> "Relief":
        """The sag terms for the rays of a batch in one axis, along which their numbers vary."""
        numbers = []
        for number, axes in self._with_axes():
            if number.dim() > axes:
                inner, trailing = number.shape[:axes], number.shape[axes:]
                number = number.reshape(*inner, *(1,) * (len(batch) - len(trailing)), *trailing)
                number = number.expand(*inner, *batch).reshape(*inner, -1)
            numbers.append(number)
        return Relief(self.kind, numbers)

    def of(self, few: Tensor) -> "Relief":
        """The sag terms for some of the rays of one axis."""
        numbers = [number[..., few] if number.dim() > axes else number for number, axes in self._with_axes()]
        return Relief(self.kind, numbers)

    def _with_axes(self) -> list[tuple[Tensor, int]]:
        return list(zip(self.numbers, SAG_TERMS[self.kind].axes, strict=True))


def relief(sag_terms: SagTerms) -> Relief:
    """Sag terms prepared for rays. Raises ValueError for a grid of fewer than 4 × 4 heights."""
    name = type(sag_terms).__name__
    return Relief(name, [number.double() for number in tree_leaves(SAG_TERMS[name].prepare(sag_terms))])


def with_powers(sag_terms: SagTerms | None, coefficients: Tensor, radius: Tensor) -> SagTerms:
    """Sag terms, or None, with further powers of x/R and y/R about the vertex added.

    coefficients: (J, ...) mm, in the order of `PolynomialSag`, trailing axes as those of a lens's numbers; radius: () R
    mm. Sums of powers and of Zernike's terms become powers about their centre. A grid gets the heights of the powers at
    its points: the spline through them is that of the sum, exact for powers of degree 3 and fewer. Raises ValueError
    for a grid in a batch of lenses.
    """
    if isinstance(sag_terms, GridSag | SplineSag):
        return _with_heights(sag_terms, coefficients, radius)
    zero = torch.zeros_like(radius)
    if sag_terms is None:
        return PowerSag(zero, zero, radius, zero, coefficients)
    before = _powers(sag_terms)
    terms = _scaled(coefficients, before.radius / radius)
    if isinstance(sag_terms, FringeSag | PowerSag):
        height, terms = shifted(terms, before.centre_x / before.radius, before.centre_y / before.radius)
        before = dataclasses.replace(before, height=before.height + height)
    entries = itertools.zip_longest(before.coefficients.unbind(0), terms, fillvalue=zero)
    sums = [a if b is zero else b if a is zero else a + b for a, b in entries]
    return dataclasses.replace(before, coefficients=torch.stack(torch.broadcast_tensors(*sums)))


def _powers(sag_terms: SagTerms) -> PowerSag:
    """Sag terms as powers about a centre. Raises ValueError for a grid of heights, which is no such sum."""
    convert = SAG_TERMS[type(sag_terms).__name__].powers
    if convert is None:
        raise ValueError("a grid of heights is no sum of powers")
    return convert(sag_terms)


def about_vertex(sag_terms: SagTerms) -> tuple[PolynomialSag, Tensor]:
    """Sag terms as a sum of powers about the vertex, and the height () mm to be added to it.

    Raises ValueError for a grid of heights, which is no such sum.
    """
    terms = _powers(sag_terms)
    if not bool(terms.centre_x.any() | terms.centre_y.any()):
        return PolynomialSag(terms.coefficients, terms.radius), terms.height
    centre = -terms.centre_x / terms.radius, -terms.centre_y / terms.radius
    height, coefficients = shifted(terms.coefficients.unbind(0), *centre)
    return PolynomialSag(torch.stack(torch.broadcast_tensors(*coefficients)), terms.radius), terms.height + height


def as_fringe(sag_terms: PolynomialSag) -> FringeSag | None:
    """A sum of powers as fringe terms over a disc of twice the radius; None for powers of a degree above 5.

    The 36 terms with n + |m| ≤ 10 hold every power to x⁵ … y⁵. Piston makes the sag at the vertex 0.
    """
    count = int(torch.nonzero(sag_terms.coefficients).max()) + 1 if bool(sag_terms.coefficients.any()) else 1
    highest = degree(count)
    if highest > _FRINGE_DEGREE:
        return None
    radius, size = 2 * sag_terms.radius, highest * (highest + 3) // 2
    terms = torch.stack(_scaled(sag_terms.coefficients[:size], radius / sag_terms.radius))
    terms = torch.cat([terms, terms.new_zeros(size - len(terms))])
    numbers = [j for j in range(2, 37) if fringe(j)[0] <= highest]
    matrix, constants = (terms.new_tensor(part) for part in zernike_to_powers(tuple(map(fringe, numbers))))
    heights = torch.linalg.solve(matrix, terms)
    coefficients = terms.new_zeros(max(numbers)).index_put((torch.tensor(numbers, device=terms.device) - 1,), heights)
    zero = torch.zeros_like(radius)
    return FringeSag(torch.cat([-(constants @ heights)[None], coefficients[1:]]), radius, zero, zero)


def with_even_terms(sag_terms: PolynomialSag, coefficients: Tensor) -> PolynomialSag:
    """A sum of powers with Σ_n a_n (x² + y²)^n added; coefficients: (m,) a_1, a_2, … in mm^(1-2n)."""
    radius, highest = sag_terms.radius, 2 * len(coefficients)
    even = {
        power: a * radius ** (2 * n) * factor
        for n, a in enumerate(coefficients.unbind(0), 1)
        for power, factor in round_power(n).items()
    }
    terms = [*sag_terms.coefficients.unbind(0)]
    order = powers(max(len(terms), highest * (highest + 3) // 2))
    terms += [torch.zeros_like(radius)] * (len(order) - len(terms))
    pairs = zip(terms, order, strict=True)
    return PolynomialSag(torch.stack([a + even[power] if power in even else a for a, power in pairs]), radius)


def _scaled(coefficients: Tensor, factor: Tensor) -> list[Tensor]:
    """The coefficients of powers of x/(f R) in place of x/R."""
    degrees = [sum(power) for power in powers(len(coefficients))]
    return [a * factor**degree for degree, a in zip(degrees, coefficients.unbind(0), strict=True)]


def _with_heights(grid: GridSag | SplineSag, coefficients: Tensor, radius: Tensor) -> GridSag | SplineSag:
    """A grid with the heights of powers at its points."""
    if coefficients.dim() > 1:
        raise ValueError("a surface with a grid of heights cannot vary from lens to lens; expected one lens at a time")
    rows, columns = grid.heights.shape if isinstance(grid, GridSag) else (size - 2 for size in grid.coefficients.shape)
    y, x = (
        (torch.arange(count, dtype=coefficients.dtype, device=coefficients.device) - 0.5 * (count - 1)) * grid.pitch
        for count in (rows, columns)
    )
    heights = polynomial_xy(coefficients, x / radius, y[:, None] / radius, 0).z
    if isinstance(grid, GridSag):
        return dataclasses.replace(grid, heights=grid.heights + heights)
    return dataclasses.replace(grid, coefficients=grid.coefficients + spline(GridSag(heights, grid.pitch)).coefficients)
