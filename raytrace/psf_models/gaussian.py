"""Gaussian PSF: centroid and covariance of a few traced rays; the energy of a Gaussian in every pixel of a grid."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.polynomial import legendre
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import broadcast_shape, is_wrapped, safe_divide, safe_sqrt, value
from raytrace.maths.sampling import Grid, centres, edges, gauss_rings, sobol
from raytrace.maths.tangents import applied
from raytrace.psf_models.drt import histogram
from raytrace.psf_models.result import Kernels, moments_of_rays
from raytrace.system.apertures import stands_inside
from raytrace.tracing.clear_pupil import Arms, arms_of
from raytrace.tracing.scene import Scene, beam_share, symmetry, trace_scene

#: Standard deviations beyond which a normal distribution is 0 in float64.
_FAR = 40.0
#: Half-widths h (and h·m, m the midpoint; both over σ) up to which an interval is integrated by its midpoint series.
_NARROW = 0.25
_TERMS = 8  # of that series: the next one is 1e-18 of the first
#: The rotated rule neglects values e^-37 below its peak, and takes Φ(t) as 1 beyond t = 8.3.
_DROP, _SATURATED = 74.0, 8.3
_NODES, _WEIGHTS = (x.tolist() for x in legendre.leggauss(28))
#: The product rule: half a pixel over the smaller conditional deviation, σ_x √(1 - ρ²) or σ_y √(1 - ρ²), up to which
#: it serves; its relative error, of pixels within so many σ of the centroid and of all that are not 0.
_WIDEST = 1.5
_CLOSE, _CLOSE_ERROR, _TAIL_ERROR = 6.0, 2e-16, 3e-14
_AT_ONCE = 2**16  # pixels of either rule at once, 2 kB each
_NOTHING = 38.0  # σ beyond which a density is 0


def gaussian_pixels(grid: Grid, centroid: Tensor, covariance: Tensor) -> Tensor:
    """Energy (..., rows, columns) of a Gaussian of energy 1 in every pixel, exactly integrated.

        P = ∬_pixel exp(-½ rᵀ Σ⁻¹ r) / (2π √det Σ) dx dy,   r = (x, y) - centroid

    centroid: (2, ...) mm; covariance: (3, ...) mm², xx, xy, yy, or (2, ...), xx and yy of a Gaussian known to have no
    xy: then P is a product of two differences of Φ, of rows + columns numbers. In general P is an integral of the
    density by a product of Gauss rules where pixels are narrow, else over x of Φ differences in y. Both rules keep
    relative precision in the tails, the latter in the limits xy = 0 and det Σ = 0, a line, too. A variance of 0 is a
    point: all in one pixel, halves on an edge, and derivative 0.
    First and second derivatives are exact in all of centroid, covariance, pitch and centre.
    """
    x, y = centres(grid)
    x_edges, y_edges = edges(grid)
    half = 0.5 * grid.pitch
    x, x_edges = ((t - centroid[0][..., None])[..., None, :] for t in (x, x_edges))
    y, y_edges = ((t - centroid[1][..., None])[..., :, None] for t in (y, y_edges))
    # A σ of 1e-30 mm is a point: its derivatives would overflow.
    smallest = 1e-60 if covariance.dtype == torch.float64 else 1e-16
    xx, yy = covariance[0], covariance[-1]
    both = (xx > smallest) & (yy > smallest)
    variance_x, variance_y = (torch.where(t > smallest, t, 0.0)[..., None, None] for t in (xx, yy))
    if len(covariance) == 2:
        across, along = _sides(x, x_edges, y, y_edges, half)
        return _interval(across, safe_sqrt(variance_x)) * _interval(along, safe_sqrt(variance_y))
    xy = torch.where(both, covariance[1], 0.0)[..., None, None]
    return applied(_Rotated, x, y, half, variance_x, variance_y, xy, x_edges, y_edges, slopes=_slopes)


def wide_gaussian_pixels(grid: Grid, centroid: Tensor, covariance: Tensor) -> Tensor:
    """`gaussian_pixels` of deviations of a pixel and more in every direction, to 1e-4 of the energy, in few operations.

        P ≈ h² N(r; Σ + h²/12) [1 - h⁴/2880 (H_x + H_y)],   H_x = a⁴ - 6 Λxx a² + 3 Λxx²,   a = (Λ r)_x

    Pixels h wide add the variance h²/12 of a square to Σ, whose inverse is then Λ; the bracket is the first term of the
    Gram-Charlier series (Cramér, Mathematical Methods of Statistics, 1946, §17.6), for the fourth cumulant -h⁴/120.
    """
    x, y = centres(grid)
    x, y = (x - centroid[0][..., None])[..., None, :], (y - centroid[1][..., None])[..., :, None]
    square = grid.pitch * grid.pitch
    xx, xy, yy = (
        part[..., None, None] for part in (covariance[0] + square / 12, covariance[1], covariance[2] + square / 12)
    )
    det = xx * yy - xy * xy
    a, b = (yy * x - xy * y) / det, (xx * y - xy * x) / det
    (u, p), (v, q) = (a * a, yy / det), (b * b, xx / det)
    fourth = u * (u - 6 * p) + 3 * p * p + v * (v - 6 * q) + 3 * q * q
    peak = square / (2 * math.pi * torch.sqrt(det))
    return peak * torch.exp(-0.5 * (a * x + b * y)) * (1 - (square * square / 2880) * fourth)


#: Lower and upper edge, middle and half width of intervals, mm.
Side = tuple[Tensor, Tensor, Tensor, Tensor]


def _sides(x: Tensor, x_edges: Tensor, y: Tensor, y_edges: Tensor, half: Tensor) -> tuple[Side, Side]:
    """The sides of the pixels along x (..., 1, columns) and y (..., rows, 1)."""
    return (x_edges[..., :-1], x_edges[..., 1:], x, half), (y_edges[..., :-1, :], y_edges[..., 1:, :], y, half)


def _standard(distance: Tensor, sigma: Tensor) -> Tensor:
    """distance/σ, limited to ±40 with derivative 0 beyond; σ = 0 gives ±40, or 0 at distance 0."""
    resolved = distance.abs() < _FAR * sigma
    quotient = torch.where(resolved, distance, 0.0) / torch.where(resolved, sigma, 1.0)
    return torch.where(resolved, quotient, _FAR * torch.sign(distance.detach()))


def _interval(side: Side, sigma: Tensor) -> Tensor:
    """Φ(upper/σ) - Φ(lower/σ), with a relative error of a few roundings."""
    a, b, m, h = (_standard(distance, sigma) for distance in side)
    root = 2.0**-0.5
    left = m < 0
    near, far = root * torch.where(left, -b, a), root * torch.where(left, -a, b)
    wide = torch.where(near > 0, torch.erfc(near) - torch.erfc(far), torch.erf(far) - torch.erf(near))
    narrow = (h <= _NARROW) & ((h * m).abs() <= _NARROW)
    h, m = torch.where(narrow, h, 0.0), torch.where(narrow, m, 0.0)
    # Differences of erfc on the side of a tail, of erf around the centre, and where those would cancel,
    # 2 h φ(m) Σ_k He_2k(m) h^2k / (2k + 1)!, with e_n = He_n(m) h^n by He_(n+1) = m He_n - n He_(n-1).
    q, z = h * h, h * m
    before, now, total, factorial = torch.ones_like(z), z, torch.ones_like(z), 1.0
    for n in range(1, 2 * _TERMS, 2):
        factorial *= (n + 1) * (n + 2)
        before = z * now - n * q * before
        total = total + before / factorial
        now = z * before - (n + 1) * q * now
    return torch.where(narrow, 2 * h * _bell(m) * total, 0.5 * wide)


def _bell(t: Tensor) -> Tensor:
    """φ(t) = exp(-t²/2)/√(2π)."""
    return (2 * torch.pi) ** -0.5 * torch.exp(-0.5 * t * t)


def _density(distance: Tensor, sigma: Tensor) -> Tensor:
    """φ(distance/σ)/σ, 1/mm; 0 where σ = 0."""
    return safe_divide(_bell(_standard(distance, sigma)), sigma)


class _Rotated(torch.autograd.Function):
    """The value by quadrature, its derivatives in closed form.

    With p the density, ∂P/∂x is p integrated over an edge; as ∂p/∂Σxx = ½ ∂²p/∂x² and ∂p/∂Σxy = ∂²p/∂x∂y (Plackett
    1954), derivatives in the covariance are integrals over edges and values at corners. Arguments: middles x (..., 1,
    columns) and y (..., rows, 1), half width, Σxx, Σyy, Σxy (..., 1, 1); and the edges, which have no derivative.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(
        x: Tensor,
        y: Tensor,
        half: Tensor,
        xx: Tensor,
        yy: Tensor,
        xy: Tensor,
        x_edges: Tensor,
        y_edges: Tensor,
    ) -> Tensor:
        return _energy(*_sides(x, x_edges, y, y_edges, half), xx, xy, yy)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        slopes = (gradient * slope for slope in _slopes(*ctx.saved_tensors))
        return *(g.sum_to_size(t.shape) for g, t in zip(slopes, ctx.saved_tensors, strict=False)), None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        pairs = zip(_slopes(*ctx.saved_tensors), tangents, strict=False)
        return functools.reduce(torch.add, (slope * tangent for slope, tangent in pairs if tangent is not None))


def _slopes(
    x: Tensor, y: Tensor, half: Tensor, xx: Tensor, yy: Tensor, xy: Tensor, x_edges: Tensor, y_edges: Tensor
) -> tuple[Tensor, ...]:
    """∂P by x, y, half, xx, yy and xy (..., rows, columns)."""
    det, (across, along) = _determinant(xx, xy, yy), _sides(x, x_edges, y, y_edges, half)
    by_x, by_y = _edges(across, along, xx, xy, det), _edges(along, across, yy, xy, det)
    return by_x[0], by_y[0], by_x[1] + by_y[1], 0.5 * by_x[2], 0.5 * by_y[2], by_x[3]


def _energy(across: Side, along: Side, xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
    """P by the product rule where half a pixel is no wider than 1.5 conditional σ, else by `_rule`."""
    det = _determinant(xx, xy, yy)
    if any(map(is_wrapped, (*across, *along, xx, xy, yy))):
        return _rule(across, along, xx, xy, yy, det)  # a choice by values cannot be mapped
    width = across[3] * safe_sqrt(safe_divide(torch.maximum(xx, yy), det))
    batch = broadcast_shape(*(t.shape[:-2] for t in (xx, across[2], along[2])))
    narrow = ((det > 0) & (width <= _WIDEST)).expand(*batch, 1, 1).flatten()
    rows, columns = along[2].shape[-2], across[2].shape[-1]

    def chosen(t: Tensor, some: Tensor) -> Tensor:
        return t.expand(*batch, *t.shape[-2:]).reshape(-1, *t.shape[-2:])[some] if t.dim() else t

    energy, together = xx.new_zeros(len(narrow), rows, columns), max(1, _AT_ONCE // (rows * columns))
    for rule, mask in ((_product_rule, narrow), (_rule, ~narrow)):
        for some in torch.nonzero(mask)[:, 0].split(together) if bool(mask.any()) else ():
            arguments = (across, along, xx, xy, yy, det)
            energy[some] = rule(*pytree.tree_map(lambda t, some=some: chosen(t, some), arguments))
    return energy.unflatten(0, batch) if batch else energy[0]


def _product_rule(across: Side, along: Side, xx: Tensor, xy: Tensor, yy: Tensor, det: Tensor) -> Tensor:
    """∬ p dx dy over narrow pixels by Gauss nodes ξ, η of [-1, 1] about their centre (x, y), with Λ = Σ⁻¹:

        P = 4h² √det Λ/2π e^(-E) Σ_k c^k/k! Σ_ξ w ξ^k e^(-αhξ - Λxx h²ξ²/2) Σ_η w η^k e^(-βhη - Λyy h²η²/2)

    c = -Λxy h²; E = rᵀΛr/2 and (α, β) = Λr at the centre. Half of E goes with either sum, so that nothing overflows.
    """
    (x, h), (y, _) = across[2:], along[2:]
    # By conditional deviations: Λ itself cancels where ρ is near 1.
    s_x, s_y = det / yy, det / xx
    from_y, from_x = x - xy / yy * y, y - xy / xx * x
    twice_energy = x * x / xx + from_x * from_x / s_y
    c = h * h * xy / det
    largest = torch.stack([t.abs().max() for t in (h * h / s_x, h * h / s_y, c, twice_energy)]).tolist()
    width, reach = max(largest[:2]) ** 0.5, min(largest[3] ** 0.5, _NOTHING)
    # In steps of a twelfth, so that few rules are made.
    nodes = _count_nodes(*(math.ceil(12 * math.log2(max(t, 2.0**-20))) for t in (width, reach * width)))
    # Terms of exp(c ξη) for ξη in [-1, 1].
    terms = next(k for k in itertools.count(1) if largest[2] ** k <= _CLOSE_ERROR * math.factorial(k))
    node, moments = (xx.new_tensor(t) for t in _gauss_moments(nodes, terms))
    sums = [
        torch.exp(
            (-0.25 * twice_energy)[..., None] - (h * slope)[..., None] * node - (0.5 * h * h / s)[..., None] * node**2
        )
        @ moments
        for slope, s in ((from_y / s_x, s_x), (from_x / s_y, s_y))
    ]
    k = torch.arange(terms, dtype=c.dtype, device=c.device)
    powers = c[..., None] ** k / torch.exp(torch.lgamma(k + 1))
    return (2 / torch.pi) * h * h / safe_sqrt(det) * (powers * sums[0] * sums[1]).sum(-1)


@functools.cache
def _count_nodes(width: int, slope: int) -> int:
    """Gauss nodes that integrate exp(-a s - b² s²/2) over [-1, 1]; width, slope: 12 log₂ of b and of the largest a."""
    # b is half a pixel over σ, a up to 6 b and more.
    b, steepest = (2 ** (t / 12) for t in (width, slope))
    cases = (min(steepest, _CLOSE * b), _CLOSE_ERROR), (steepest, _TAIL_ERROR)

    def integral(count: int, a: float) -> np.longdouble:
        s, weight = _gauss(count)
        return np.dot(weight, np.exp(-a * (s + 1) - 0.5 * (b * s) ** 2))

    def serves(count: int) -> bool:
        return all(abs(integral(count, a) / integral(count + 12, a) - 1) <= error for a, error in cases)

    return next((count for count in range(4, 48, 2) if serves(count)), 48)


@functools.cache
def _gauss_moments(nodes: int, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes (N,) of [-1, 1] and w ξ^k/2 (N, K)."""
    node, weight = _gauss(nodes)
    moments = 0.5 * weight[:, None] * node[:, None] ** np.arange(terms)
    return node.astype(np.float64), moments.astype(np.float64)


@functools.cache
def _gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights 2/((1 - x²) P'(x)²), in long double: numpy's err by 4e-14 of a weight."""
    x: np.ndarray = legendre.leggauss(count)[0].astype(np.longdouble)
    for _ in range(3):
        before, now = np.ones_like(x), x
        for n in range(2, count + 1):
            before, now = now, ((2 * n - 1) * x * now - (n - 1) * before) / n
        slope = count * (before - x * now) / (1 - x**2)
        weight, x = 2 / ((1 - x**2) * slope**2), x - now / slope
    return x, weight


def _determinant(xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
    """xx·yy - xy², its value from exact products (Veltkamp, Dekker 1971): the rounding of ρ² would blur a thin line."""

    def product(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        (a1, a2), (b1, b2) = split(a), split(b)
        whole = a * b
        return whole, a2 * b2 - (((whole - a1 * b1) - a2 * b1) - a1 * b2)

    def split(a: Tensor) -> tuple[Tensor, Tensor]:
        c = (2.0**27 + 1 if a.dtype == torch.float64 else 2.0**12 + 1) * a
        high = c - (c - a)
        return high, a - high

    (p, dp), (q, dq) = product(xx.detach(), yy.detach()), product(xy.detach(), xy.detach())
    plain = xx * yy - xy * xy
    return (plain - plain.detach()) + ((p - q) + (dp - dq)).clamp_min(0.0)


def _edges(side: Side, other: Side, variance: Tensor, xy: Tensor, det: Tensor) -> tuple[Tensor, ...]:
    """E₁ - E₀, E₁ + E₀, E′₁ - E′₀ and C₁ - C₀ of the edges x₀, x₁ of a pixel.

    E(x) = ∫ p dy and E′(x) = ∫ ∂p/∂x dy over an edge, C(x): p at its upper end less p at its lower end.
    """
    lower, upper, middle, half_width = other
    sigma, slope = safe_sqrt(variance), safe_divide(xy, variance)
    s = safe_sqrt(safe_divide(det, variance))
    density, strip, energy, tilt, ends = [], [], [], [], []
    for x in side[:2]:
        shift = slope * x
        density.append(_density(x, sigma))
        strip.append(_interval((lower - shift, upper - shift, middle - shift, half_width), s))
        ends.append(density[-1] * (_density(upper - shift, s) - _density(lower - shift, s)))
        energy.append(density[-1] * strip[-1])
        tilt.append(-(safe_divide(x, torch.broadcast_tensors(variance, x)[0]) * energy[-1]) - slope * ends[-1])
    # The difference of densities of a narrow pixel, -2 p(m) exp(-h²/2) sinh(m h), does not cancel.
    m, h = (_standard(distance, sigma) for distance in side[2:])
    narrow = (h <= 1) & ((h * m).abs() <= 1)
    h, m = torch.where(narrow, h, 0.0), torch.where(narrow, m, 0.0)
    stable = safe_divide(-2 * _bell(m) * torch.exp(-0.5 * h * h) * torch.sinh(m * h), sigma)
    step = torch.where(narrow, stable, density[1] - density[0])
    difference = 0.5 * (step * (strip[0] + strip[1]) + (density[0] + density[1]) * (strip[1] - strip[0]))
    return difference, energy[0] + energy[1], tilt[1] - tilt[0], ends[1] - ends[0]


def _rule(across: Side, along: Side, xx: Tensor, xy: Tensor, yy: Tensor, det: Tensor) -> Tensor:
    """∫ φ(u) [Φ((y₁ - ρu)/r) - Φ((y₀ - ρu)/r)] du over a pixel, r² = 1 - ρ², all over σ; a Gaussian rule in pieces.

    The integrand is log-concave with its peak at u*, the point of the pixel nearest to the centroid in the norm of Σ:
    g(u) = u² + max(0, y₀ - ρu, ρu - y₁)²/r² is least there. Outside {g ≤ g(u*) + 74} nothing is left in float64; the
    rest is cut where it turns: at u*, where either Φ is ½, and where either is 1.
    """
    sigma_x, sigma_y = safe_sqrt(xx), safe_sqrt(yy)
    rho = safe_divide(xy, sigma_x * sigma_y)
    # ρ > 0 without loss: mirror y.
    mirrored = rho < 0
    lower, upper, middle, half = along
    lower, upper = torch.where(mirrored, -upper, lower), torch.where(mirrored, -lower, upper)
    middle = torch.where(mirrored, -middle, middle)
    rho = rho.abs().clamp_max(1.0)
    r = safe_sqrt(safe_divide(det, xx * yy)).clamp_max(1.0)
    y0, y1, y, y_half = (_standard(t, sigma_y) for t in (lower, upper, middle, half))
    a, b, x, x_half = (_standard(t, sigma_x) for t in across)

    # Narrow pixels count u from their centre, so that their width loses no precision.
    origin = torch.where(x_half <= 1, x, 0.0)
    a, b = torch.where(x_half <= 1, -x_half, a), torch.where(x_half <= 1, x_half, b)
    pieces = _pieces(a + origin, b + origin, y0, y1, rho, r)
    a, b, *pieces = torch.broadcast_tensors(a, b, *pieces)
    cuts = torch.stack([torch.minimum(torch.maximum(piece - origin, a), b) for piece in pieces]).sort(0).values
    total = torch.zeros_like(a)
    nodes, weights = (total.new_tensor(t).reshape(-1, *(1,) * total.dim()) for t in (_NODES, _WEIGHTS))
    for start, end in itertools.pairwise(cuts):
        length = 0.5 * (end - start)
        u = origin + (start + (1 + nodes) * length)
        shift = rho * u
        strip = _interval((y0 - shift, y1 - shift, y - shift, y_half), r)
        total = total + length * (weights * (_bell(u) * strip)).sum(0)
    straight = _interval(across, sigma_x) * _interval(along, sigma_y)
    return torch.where(xy == 0, straight, total)


def _pieces(a: Tensor, b: Tensor, y0: Tensor, y1: Tensor, rho: Tensor, r: Tensor) -> list[Tensor]:
    """Where to cut the integral over u: both ends of {g ≤ g(u*) + 74}, u*, and both ends of both steps of Φ.

    u² + (y - ρu)²/r² = R² at u = ρy ± r √(R² - y²), and is least, y², at u = ρy.
    """
    floor = 1e-18 if r.dtype == torch.float64 else 1e-9
    peak = torch.where(y0 > 0, rho * y0, torch.where(y1 < 0, rho * y1, 0.0))
    peak = torch.minimum(torch.maximum(peak, a), b)
    beyond = torch.maximum(y0 - rho * peak, rho * peak - y1).clamp_min(0.0) / r.clamp_min(floor)
    R = torch.sqrt(peak * peak + beyond * beyond + _DROP)
    reach0, reach1 = (r * safe_sqrt(R * R - y * y) for y in (y0, y1))
    below0, below1 = y0 > -rho * R, y1 < -rho * R
    above0, above1 = y0 > rho * R, y1 < rho * R
    first = torch.maximum(torch.where(below0, rho * y0 - reach0, -R), torch.where(below1, rho * y1 - reach1, -R))
    last = torch.minimum(torch.where(above1, rho * y1 + reach1, R), torch.where(above0, rho * y0 + reach0, R))
    first, last = torch.maximum(first, a), torch.minimum(last, b)
    steps = [y / rho.clamp_min(floor) for y in (y0, y0 + _SATURATED * r, y1 - _SATURATED * r, y1)]
    return [first, last, *(torch.minimum(torch.maximum(t, first), last) for t in (peak, *steps))]


_MAP_POINTS = 4096  # of the ray map that the residual is computed from
_MAP_NODES, _MAP_ARMS = 32, 128  # the same where apertures clip: nodes on every arm, and arms of a round lens
_RIM = 1 - 1e-6  # of the pupil: a stop at its very edge clips nothing


@value
class Light:
    """Traced rays of a scene, or of the part of the pupil that its symmetry needs.

    hits: (2, D, F, W, P) mm on the sensor; valid: (D, F, W, P), those that arrive; weights: (P,) or (D, F, W, P),
    shares of the pupil, 1 in all; rays: how many were traced for each kernel. arms: those that the rays fill where the
    beam is clipped, else None. pairs: (K,) numbers d F + f of the pairs of a distance and a field whose light it is, in
    place of D and F; None for all.
    """

    hits: Tensor
    valid: Tensor
    weights: Tensor
    rays: int
    arms: Arms | None = None
    pairs: Tensor | None = None


def kernels(scene: Scene, grid: Grid, *, order: int) -> Kernels:
    """Gaussians with the centroid and covariance of `order` Gauss rings of 4·(order - 1) arms, 8 at least.

    Only rays that the scene's symmetry does not give are traced: `order` rays of one meridian on the axis of a
    rotationally symmetric lens, half the pupil for fields in the y-z plane of a lens symmetric in x. σ of the double
    Gauss at 25 m: 4 rays on the axis give 1.4e-6, 5 give 7e-10; at 14°, 40 rays (order 5) give 9e-8. Where rays fail,
    rings follow the clear part of every arm, see `trace_light`. The energy is the transmitted fraction of the light
    through the whole entrance pupil, of which vignetting factors leave the share (1 - VCX)(1 - VCY); 0 with gradient 0
    where no ray arrives.
    """
    lights, shape, gaussians = _kernels(scene, grid, order)
    fold, residuals = symmetry(scene), []
    for light in lights:
        window, part = grid, shape
        if light.pairs is not None:
            centre = grid.centre.reshape(2, *(grid.centre.shape[1:] or (1, 1, 1)))
            window = dataclasses.replace(grid, centre=_of_pairs(centre.expand(2, *scene.shape), light))
            part = _of_pairs(shape[None], light)[0]
        residuals.append(residual(light, window, part, order, fold))
    return dataclasses.replace(gaussians, residual=_merged(lights, residuals))


def kernels_alone(scene: Scene, grid: Grid, *, order: int) -> Kernels:
    """The same without their residual, which takes half of the time."""
    return _kernels(scene, grid, order)[2]


def kernels_of_points(scene: Scene, grid: Grid, points: Tensor) -> Kernels:
    """Gaussians of the rays through pupil points (2, P), all of one weight: with their centroid and covariance, which
    differ from the moments of all light."""
    traced = trace_scene(scene, points)
    arrives = (traced.valid.to(traced.position) / points.shape[1]).expand(*scene.shape, -1)
    centroid, covariance = moments_of_rays(traced.position[:2].expand(2, *arrives.shape), arrives)
    # Points with their mirror images in x have no covariance xy but for rounding, which would cost a quadrature.
    mirrored = points * points.new_tensor([[-1.0], [1.0]])
    distance = (mirrored[:, :, None] - points[:, None]).abs().amax(0).amin(1)
    is_mirrored = symmetry(scene) != "none" and bool((distance < 1e-12).all())
    pixels = gaussian_pixels(grid, centroid, covariance[::2] if is_mirrored else covariance)
    energy = arrives.sum(-1) * beam_share(scene)
    return Kernels(energy[..., None, None] * pixels, grid, centroid, covariance, points.shape[1], energy)


def _kernels(scene: Scene, grid: Grid, order: int) -> tuple[list[Light], Tensor, Kernels]:
    """The light, the share of every pixel in the light that arrives, and the kernels."""
    fold = symmetry(scene)
    lights = trace_light(scene, order, fold)
    arrives = [torch.where(light.valid, light.weights, 0.0) for light in lights]
    moments = [moments_of_rays(light.hits, some, fold) for light, some in zip(lights, arrives, strict=True)]
    centroid, covariance = (_merged(lights, parts) for parts in zip(*moments, strict=True))
    energy = _merged(lights, [some.sum(-1) for some in arrives]) * beam_share(scene)
    shape = gaussian_pixels(grid, centroid, covariance if fold == "none" else covariance[::2])
    kernels = energy[..., None, None] * shape
    return lights, shape, Kernels(kernels, grid, centroid, covariance, lights[-1].rays, energy)


def _merged(lights: list[Light], parts: Sequence[Tensor]) -> Tensor:
    """Numbers (..., D, F, W) of all kernels, in which those of pairs replace the ones of the first light."""
    merged = parts[0]
    for light, part in zip(lights[1:], parts[1:], strict=True):
        axis = part.dim() - 3
        assert light.pairs is not None  # as `trace_light` makes them
        each = merged.flatten(axis, axis + 1).index_copy(axis, light.pairs, part.flatten(axis, axis + 1))
        merged = each.unflatten(axis, merged.shape[axis : axis + 2])
    return merged


def _of_pairs(numbers: Tensor, light: Light) -> Tensor:
    """Numbers (n, D, F, W, ...) of the pairs of a light, as its axes."""
    return numbers.flatten(1, 2)[:, light.pairs].unflatten(1, light.valid.shape[:2])


def trace_light(scene: Scene, order: int, fold: str) -> list[Light]:
    """The rays of an order, of the part of the pupil that symmetry needs; then those of pairs whose beams are clipped.

    If any ray of a pair of a distance and a field fails, of these or of those at the rim of a lens with apertures, or
    an obstruction lies in the pupil, 2·order rings fill the clear parts of 8·order arms (`clear_pupil.arms_of`), 32·
    (order - 1) with an obstruction or a polygon, whose corners then leave an error of 2e-4 at order 4. The clear parts
    of all such pairs are searched at once; the rays of the others, and so their kernels, stay the same.
    """
    apertures = [aperture for surface in scene.lens.surfaces for aperture in surface.apertures]
    lights, count, is_hollow = [], 0, any(map(stands_inside, apertures))
    pairs: Tensor | None = None
    if not is_hollow:
        points, weights = fold_pupil(order, fold, scene.wavelengths)
        rim = (
            _RIM * directions(2 * round_arms(order), fold, scene.wavelengths, start=0.0) if apertures else points[:, :0]
        )
        rays = trace_scene(scene, torch.cat([points, rim], 1))
        hits, valid = rays.position[:2], rays.valid
        inside, count = points.shape[1], points.shape[1] + rim.shape[1]
        fails = ~valid.flatten(2).all(-1).flatten()
        if not bool(fails.all()):
            lights = [Light(hits[..., :inside], valid[..., :inside], weights, count)]
            if not bool(fails.any()):
                return lights
            pairs = fails.nonzero()[:, 0]
            scene = scene.of_pairs(pairs)
    arms = arms_of(scene, 32 * max(order - 1, 1) if is_hollow else 8 * order, fold)
    points, weights = arms.rule(2 * order)
    rays = trace_scene(scene, points)
    traced = count + arms.rays + points.shape[-1]
    return [*lights, Light(rays.position[:2], rays.valid, weights, traced, arms, pairs)]


def round_arms(order: int) -> int:
    """Arms of a rule of `order` rings: as many as leave the error to the rings, a multiple of 4 for its symmetry."""
    return 4 * max(order - 1, 2)


def fold_pupil(order: int, fold: str, like: Tensor) -> tuple[Tensor, Tensor]:
    """Pupil points (2, P) and weights (P,) of the rays to trace, in the dtype and on the device of `like`."""
    if fold == "round":
        points, weights = gauss_rings(order, 1, dtype=like.dtype, device=like.device)
        radius = torch.linalg.vector_norm(points, dim=0)
        return torch.stack([torch.zeros_like(radius), radius]), weights
    points, weights = gauss_rings(order, round_arms(order), dtype=like.dtype, device=like.device)
    if fold == "none":
        return points, weights
    right = points[0] > 0
    return points[:, right], 2 * weights[right]


def directions(arms: int, fold: str, like: Tensor, *, start: float = 0.5) -> Tensor:
    """Unit vectors (2, A) of the traced ones of so many arms, `start` steps off the axes; of a round lens (0, 1)."""
    if fold == "round":
        return like.new_tensor([[0.0], [1.0]])
    angle = (torch.arange(arms, dtype=like.dtype, device=like.device) + start) * (2 * math.pi / arms)
    unit = torch.stack([torch.sin(angle), torch.cos(angle)])
    return unit if fold == "none" else unit[:, : arms // 2 + (start == 0)]


def residual(light: Light, grid: Grid, shape: Tensor, order: int, fold: str) -> Tensor:
    """Distance of the Gaussian from the rays: Σ |h - g| / Σ h over the pixels of the window, (...), without gradient.

    g: the Gaussian's share of every pixel, `shape`; h: that of the rays themselves, counted at thousands of points of
    a polynomial map from pupil to sensor through the same few rays: nothing more is traced. The counting leaves about
    0.01. 2 is the largest distance of two distributions of equal energy.
    """
    with torch.no_grad():
        if light.arms is None:  # of Sobol points of the pupil, by a fit through the rings
            matrix = torch.as_tensor(_ray_map(order), device=light.hits.device)
            points = _unfold(light.hits, order, fold) @ matrix.to(light.hits.dtype).mT
            weights = torch.ones_like(points[0])
        else:
            points, weights = _points_of_arms(light.hits, light.arms, fold)
        h = histogram(grid, points, safe_divide(weights, weights.sum(-1, keepdim=True).expand_as(weights)))
        return safe_divide((h - shape).abs().sum((-2, -1)), h.sum((-2, -1)))


def _points_of_arms(hits: Tensor, arms: Arms, fold: str) -> tuple[Tensor, Tensor]:
    """Hits (2, ..., P) of many nodes in every clear part of an arm, and weights, by interpolation along it."""
    parts = arms.inner.shape[-1]
    rings = hits.shape[-1] // parts
    fine = (np.arange(_MAP_NODES) + 0.5) / _MAP_NODES
    nodes, fitted = (legendre.legvander(x, rings - 1) for x in (2 * fine - 1, legendre.leggauss(rings)[0]))
    points = hits.new_tensor(nodes @ np.linalg.inv(fitted)) @ hits.unflatten(-1, (rings, parts))
    inner, length = arms.inner[..., None, :], (arms.outer - arms.inner)[..., None, :]
    weights = (inner + length * hits.new_tensor(fine)[:, None]) * length * arms.share[..., None, :]
    if fold == "round":
        angle = torch.arange(_MAP_ARMS, dtype=points.dtype, device=points.device) * (2 * math.pi / _MAP_ARMS)
        points = torch.stack([points[1, ..., None] * torch.cos(angle), points[1, ..., None] * torch.sin(angle)])
        points, weights = points.flatten(-2), weights[..., None].expand(points.shape[1:]).flatten(-2)
    elif fold == "mirror":
        points = torch.cat([points, torch.stack([-points[0], points[1]])], -1)
        weights = torch.cat([weights, weights], -1)
    return points.flatten(-2), weights.flatten(-2)


def _unfold(position: Tensor, order: int, fold: str) -> Tensor:
    """Hits (2, ..., P) of the whole of the rule, from those of the part that was traced."""
    if fold == "none":
        return position
    arms = round_arms(order)
    points, _ = gauss_rings(order, arms, dtype=position.dtype, device=position.device)
    number = torch.arange(order * arms, device=points.device)
    ring, arm = number // arms, number % arms
    if fold == "round":
        radius = position[1][..., ring]
        direction = (points / torch.linalg.vector_norm(points, dim=0)).reshape(2, *(1,) * (radius.dim() - 1), -1)
        return radius * direction
    # The mirror image of arm k about x = 0 is arm arms/2 - 1 - k.
    traced = points[0] > 0
    place = torch.cumsum(traced, 0) - 1
    source = torch.where(traced, place, place[ring * arms + torch.remainder(arms // 2 - 1 - arm, arms)])
    x, y = position[..., source]
    return torch.stack([torch.where(traced, x, -x), y])


@functools.cache
def _ray_map(order: int) -> np.ndarray:
    """Matrix (4096, P) from values on the rings to Sobol points: a fit of r^n cos mθ, r^n sin mθ, m ≤ n < 2·order."""
    arms = round_arms(order)
    points, weights = (t.numpy() for t in gauss_rings(order, arms, device=torch.device("cpu")))
    fine = sobol(_MAP_POINTS, device=torch.device("cpu"))[0].numpy()

    def basis(p: np.ndarray) -> np.ndarray:
        r, angle = np.hypot(*p), np.arctan2(p[1], p[0])
        # n - m even, up to the m that the arms resolve.
        powers = [(n, m) for m in range(min(2 * order, arms // 2)) for n in range(m, 2 * order, 2)]
        terms = [r**n * wave(m * angle) for n, m in powers for wave in (np.cos, np.sin)]
        return np.stack(terms, axis=1)

    root = np.sqrt(weights)[:, None]
    return basis(fine) @ (np.linalg.pinv(root * basis(points)) * root.T)
