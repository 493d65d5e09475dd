"""Polynomials: sag_terms that are sums of powers of x and y, linear in their coefficients.

    PolynomialSag   D = Σ_k c_k E_k(x/R, y/R),  E = x, y, x², xy, y², x³, x²y, …
    IrregularSag    D = Z_s ρ⁴ + Z_a v² + Z_c ρ² v,  ρ = r/R,  v = (y cos θ - x sin θ)/R
    TiltSag         D = x tan_x + y tan_y

The other two are made into the first (`as_polynomial`), by linear maps that autograd follows. For the compiled trace
all three, and Zernike's polynomials, are made into powers about a centre:

    PowerSag        D = h + Σ_k c_k E_k(u, v),  u = (x - x_0)/R,  v = (y - y_0)/R
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths.bivariate import polynomial_xy, powers, zernike_to_powers
from raytrace.maths.numerics import polynomial
from raytrace.maths.value import value
from raytrace.maths.zernike import Order, fringe, noll, norm
from raytrace.system.poses import cos_sin
from raytrace.system.sag_terms import FringeSag, Sag, ZernikeSag


@value
class PolynomialSag:
    """Powers of x/R and y/R by coefficients (J,) mm: x, y, x², xy, y², x³, x²y, …; radius: R mm."""

    coefficients: Tensor
    radius: Tensor


@value
class IrregularSag:
    """Errors of making by their height in mm at `radius` mm: spherical aberration, astigmatism and coma.

    angle: degrees, by which astigmatism and coma are turned from y.
    """

    spherical: Tensor
    astigmatism: Tensor
    coma: Tensor
    angle: Tensor
    radius: Tensor


@value
class TiltSag:
    """A plane that leans: its slopes along x and y, tangents."""

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
    """The same as a sum of powers."""
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
    sums = [c.new_zeros(())] * (max(degrees, default=0) + 1)
    for degree, a in zip(degrees, c.abs().unbind(0), strict=True):
        sums[degree] = sums[degree] + a
    return polynomial(torch.stack(sums), radius / unit.abs())


def powers_of_polynomial(sag_terms: PolynomialSag | IrregularSag | TiltSag) -> PowerSag:
    """The same as powers about the vertex."""
    given = sag_terms if isinstance(sag_terms, PolynomialSag) else as_polynomial(sag_terms)
    zero = torch.zeros_like(given.radius)
    return PowerSag(zero, zero, given.radius, zero, given.coefficients)


def powers_of_fringe(sag_terms: FringeSag) -> PowerSag:
    """The same as powers about its centre."""
    orders = [fringe(j) for j in range(1, len(sag_terms.coefficients) + 1)]
    height, powers_ = _powers_of(orders, sag_terms.coefficients)
    return PowerSag(sag_terms.centre_x, sag_terms.centre_y, sag_terms.radius, height, powers_)


def powers_of_zernike(sag_terms: ZernikeSag) -> PowerSag:
    """The same as powers about the vertex."""
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
    found = polynomial_sag((coefficients, radius), x - centre_x, y - centre_y, highest)
    return found._replace(z=found.z + height)


def power_size(numbers: Sequence[Tensor], radius: Tensor) -> Tensor:
    """A bound on |D| up to a radius (...) mm of the vertex."""
    centre_x, centre_y, unit, height, coefficients = numbers
    return height.abs() + polynomial_size((coefficients, unit), radius + centre_x.abs() + centre_y.abs())
