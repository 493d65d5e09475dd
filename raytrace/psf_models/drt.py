"""Ray map: the image point as a polynomial of the pupil point, fitted through dozens of traced rays.

    x(ρ, θ) = Σ_mj c_mj ρ^m T_j(2ρ² - 1) {cos mθ, sin mθ},   m + 2j <= degree

As many rays as coefficients, on concentric rings where the interpolation is well-conditioned (Ramos-López, Sánchez-
Granero, Fernández-Martínez and Martínez-Finkelshtein, Appl. Math. Comput. 274, 2016), so the fit is one constant
matrix. Rays that were not fitted check it. The points where rays cross an aperture are mapped in the same way, which
gives smooth edges of vignetting. Where no polynomial fits, rays are traced, and the reason is said.
"""

import functools
import math

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide
from raytrace.maths.value import value
from raytrace.psf_models.radial import energy_of_rings, is_centred, lit_part, unfold
from raytrace.psf_models.rays import (
    Fans,
    afford_cells,
    cell_width,
    energy_of_fans,
    kernels_of_fans,
    moments_of_fans,
    places,
    trace_apertures,
    trace_fans,
    turned,
)
from raytrace.psf_models.result import Kernels
from raytrace.psf_models.splat import cell_widths
from raytrace.system.apertures import Aperture, clearance
from raytrace.tracing.scene import Scene, beam_share, symmetry, varies

_LINES = 32  # round the pupil at least, and half as many cells on each
_MOST_LINES = 8192
_PIECES = 32  # of the meridian of round light at order 0
_DEGREES = (6, 8, 10, 12, 14, 16, 20)
_CHECKS = 8  # rays that are traced but not fitted
_PIXELS = 0.1  # error of a ray in pixels that order 0 takes; each order takes half of the one before
_CLOSE = 0.01  # pixels: a map this close is better than any number of rays that one would trace instead
_HIGHER_DEGREES = (14, 20)  # tried where the degree of the order does not do


@value
class RayMap:
    """Coefficients of the map of a scene: of the hits on the sensor and on the apertures.

    hits: (2, D, F, W, T) mm; crossings: (2, D, F, W, T) mm for each of `apertures`; of an axial scene only y counts.
    residual: (D, F, W) mm, the largest error of the rays that were not fitted; NaN-free, inf if a ray is lost.
    edge_residual: (D, F, W) the same for the clearance in the apertures, of their radius.
    is_mirrored: whether the light is symmetric in x.
    """

    degree: int
    axial: bool
    hits: Tensor
    crossings: tuple[Tensor, ...]
    apertures: tuple[Aperture, ...]
    residual: Tensor
    edge_residual: Tensor
    rays: int
    is_mirrored: bool = False


def kernels(scene: Scene, grid: Grid, *, order: int = 3) -> Kernels:
    """PSFs through the ray map, or of traced rays where it fails; see `kernels_and_reason`."""
    return kernels_and_reason(scene, grid, order=order)[0]


def kernels_and_reason(scene: Scene, grid: Grid, *, order: int = 3) -> tuple[Kernels, str]:
    """PSFs through the ray map, and in one line how they were found.

    order: 0 … 10; each has twice the cells of the one before, half its error, and a map of higher degree.
    `Kernels.residual` bounds what the error of the map does to the kernel (relative L1); it is 0 for traced rays.
    """
    limit = max(_PIXELS * 0.5**order, _CLOSE)
    pitch = grid.pitch.detach()
    why = ""
    for degree in _degrees(order):
        found = fit(scene, degree)
        error = float(scene.largest((found.residual / pitch).amax()))
        edge_error = float(scene.largest(found.edge_residual.amax()))
        if error <= limit and edge_error <= limit:
            return _kernels_of_map(scene, grid, found, order), (
                f"map of degree {degree} through {found.rays} rays, within {error:.1e} pixels"
            )
        if error == float("inf"):
            why = "a ray misses a surface or is totally reflected"
            break
        why = f"a map of degree {degree} errs by {error:.1e} pixels (edges {edge_error:.1e}), above {limit:.1e}"
    finer = min(order + 2, 10)
    traced = kernels_of_fans(scene, grid, trace_fans(scene, finer), width=cell_width(finer))
    return _with_residual(traced, torch.zeros_like(traced.centroid[0])), f"{traced.rays} rays traced: {why}"


def fit(scene: Scene, degree: int) -> RayMap:
    """Trace the rays of a degree and those that check them; linear in the traced points, so gradients flow through."""
    like = scene.lens.surfaces[-2].thickness
    fold = symmetry(scene)
    axial, mirrored = fold == "round", fold == "mirror"
    constant = functools.partial(torch.tensor, dtype=like.dtype, device=like.device)
    if axial:
        height, checked = _axial_nodes(degree), np.sqrt((np.arange(4) + 1) / 4)
        disc = np.stack([np.zeros(len(height) + 4), np.concatenate([height, checked])])
        solve, check = np.linalg.inv(_axial_basis(degree, height)), _axial_basis(degree, checked)
        source = sign = None
    else:
        fitted, checked, source, sign = _disc_nodes(degree, mirrored)
        disc = np.concatenate([fitted, checked], 1)
        solve, check = _solution(degree), _basis(degree, *_polar(checked))
    hits, crossed, met = trace_apertures(scene, constant(disc))
    count = disc.shape[1] - check.shape[0]
    solve, check = constant(solve), constant(check)

    def coefficients(points: Tensor) -> Tensor:
        points = points[..., :count]
        if source is not None:
            points = points[..., torch.as_tensor(source, device=points.device)]
            points = torch.stack([points[0] * constant(sign), points[1]])
        return points @ solve.T

    def largest(error: Tensor) -> Tensor:
        return torch.where(met.all(-1), error.detach().abs().amax(-1), float("inf"))

    mapped = coefficients(hits)
    crossings = tuple(coefficients(hit) for _, hit in crossed)
    edge = torch.zeros_like(hits[0, ..., 0])
    for (aperture, hit), terms in zip(crossed, crossings, strict=True):
        error = clearance(aperture, terms @ check.T) - clearance(aperture, hit[..., count:])
        edge = torch.maximum(edge, largest(error))
    residual = largest((mapped @ check.T - hits[..., count:]).abs().amax(0))
    apertures = tuple(aperture for aperture, _ in crossed)
    return RayMap(degree, axial, mapped, crossings, apertures, residual, edge, disc.shape[1], mirrored)


def fans_of_map(ray_map: RayMap, across: int, along: int, *, is_half: bool = False) -> Fans:
    """The map on so many lines of so many cells; is_half: as for `Fans`, of a map that is mirrored."""
    like = ray_map.hits
    at_angle, at_radius = places(across, along)
    if is_half:
        at_angle = at_angle[np.arange(-1, across // 2 + 1)]
    angle, radius = (torch.as_tensor(t, dtype=like.dtype, device=like.device) for t in (at_angle, at_radius))
    if ray_map.axial:
        radial = torch.as_tensor(_axial_basis(ray_map.degree, at_radius), dtype=like.dtype).to(like.device)

        def on_fans(terms: Tensor) -> Tensor:
            return turned((terms[1] @ radial.T)[..., None, :], angle)
    else:
        radial, around = (
            torch.as_tensor(t, dtype=like.dtype, device=like.device)
            for t in _factors(ray_map.degree, at_radius, at_angle)
        )

        def on_fans(terms: Tensor) -> Tensor:
            return around @ (terms[..., None] * radial.T)

    clearances = tuple(
        clearance(aperture, on_fans(terms))
        for aperture, terms in zip(ray_map.apertures, ray_map.crossings, strict=True)
    )
    return Fans(on_fans(ray_map.hits), radius, clearances, ray_map.rays, is_half)


def reference(scene: Scene, grid: Grid, *, lines: int = 2048) -> Tensor:
    """Converged energy (D, F, W, rows, columns), for tests and measurements: 2 million cells, each much smaller than a
    pixel, of the map of degree 20 (or of 0.26 million traced rays where that fails). Error below 1e-4, as that of
    10⁸ random rays."""
    with torch.no_grad():
        ray_map = fit(scene, _DEGREES[-1])
        if float((ray_map.residual / grid.pitch).amax()) <= 1e-4 and float(ray_map.edge_residual.amax()) <= 1e-4:
            fans = fans_of_map(ray_map, lines, lines // 2)
            return energy_of_fans(grid, fans) * beam_share(scene)[..., None, None]
        return kernels_of_fans(scene, grid, trace_fans(scene, 10), width=cell_width(4)).kernel


def _degrees(order: int) -> list[int]:
    first = _DEGREES[min(order, len(_DEGREES) - 1)]
    return [first, *(degree for degree in _HIGHER_DEGREES if degree > first)]


def _kernels_of_map(scene: Scene, grid: Grid, ray_map: RayMap, order: int) -> Kernels:
    if ray_map.axial and is_centred(grid, scene):
        return _kernels_of_meridian(scene, grid, ray_map, order)
    # Order 0 has cells as wide as a pixel, measured on a coarse map; each order makes them √2 narrower.
    coarse = fans_of_map(ray_map, 2 * _LINES, _LINES)
    *widths, both = cell_widths(grid, coarse.points, scene.largest)
    across, along = (
        2 * math.ceil(min(_MOST_LINES, max(least, width * count) * both * 2 ** (order / 2)) / 2)
        for width, count, least in zip(widths, (2 * _LINES, _LINES), (_LINES, _LINES // 2), strict=True)
    )
    is_half = ray_map.is_mirrored and _is_symmetric(grid)
    # With their moments: 129 bytes of a cell measured, 175 with a clearance.
    each = 48.0 * (3 + len(ray_map.apertures))
    afford_cells(scene.shape, across // 2 if is_half else across, along, each=each)
    fans = fans_of_map(ray_map, across, along, is_half=is_half)
    kernel = energy_of_fans(grid, fans) * beam_share(scene)[..., None, None]
    centroid, covariance = moments_of_fans(fans)
    return _with_residual(Kernels(kernel, grid, centroid, covariance, ray_map.rays), ray_map.residual)


def _is_symmetric(grid: Grid) -> bool:
    """Whether every window is symmetric in x, and stays so under differentiation."""
    return not varies(grid.centre) and not bool((grid.centre[0] != 0).any())


def _kernels_of_meridian(scene: Scene, grid: Grid, ray_map: RayMap, order: int) -> Kernels:
    """The same where the light is round about the middle of the window: pieces of one line, turned about the axis."""
    like = ray_map.hits
    nodes = np.linspace(0, 1, math.ceil(_PIECES * 2 ** (order / 2)) + 1)
    basis = torch.as_tensor(_axial_basis(ray_map.degree, nodes), dtype=like.dtype, device=like.device)
    height, *crossed = (terms[1] @ basis.mT for terms in (ray_map.hits, *ray_map.crossings))
    clearances = [
        clearance(aperture, torch.stack([torch.zeros_like(hit), hit]))
        for aperture, hit in zip(ray_map.apertures, crossed, strict=True)
    ]
    first, last, share = lit_part(height[..., :-1], height[..., 1:], clearances)
    energy = (share * like.new_tensor(np.diff(nodes**2))).expand(first.shape)
    kernel = unfold(grid, energy_of_rings(grid, first, last, energy)) * beam_share(scene)[..., None, None]
    weights = safe_divide(energy, energy.sum(-1, keepdim=True).expand_as(energy))
    # A ring of radius h has the variance h²/2 per axis; h² is averaged over every piece.
    variance = (weights * (first * first + first * last + last * last)).sum(-1) / 6
    zero = torch.zeros_like(variance)
    covariance = torch.stack([variance, zero, variance])
    found = Kernels(kernel, grid, torch.stack([zero, zero]), covariance, ray_map.rays)
    return _with_residual(found, ray_map.residual)


def _with_residual(kernels: Kernels, residual: Tensor) -> Kernels:
    """Moving light by δ changes a kernel by at most δ times its total variation."""
    kernel = kernels.kernel.detach()
    variation = kernel.diff(dim=-1).abs().sum((-2, -1)) + kernel.diff(dim=-2).abs().sum((-2, -1))
    total = kernel.sum((-2, -1))
    change = residual / kernels.grid.pitch.detach() * variation / torch.where(total > 0, total, 1.0)
    return Kernels(kernels.kernel, kernels.grid, kernels.centroid, kernels.covariance, kernels.rays, change)


def _axial_nodes(degree: int) -> np.ndarray:
    """Positive Chebyshev nodes: heights on the y axis."""
    count = degree // 2 + 1
    return np.cos((2 * np.arange(count) + 1) * np.pi / (4 * count))


def _axial_basis(degree: int, radius: np.ndarray) -> np.ndarray:
    """ρ T_j(2ρ² - 1), (points, terms): an on-axis height is odd in ρ."""
    return radius[:, None] * np.polynomial.chebyshev.chebvander(2 * radius**2 - 1, degree // 2)


@functools.lru_cache(maxsize=32)
def _disc_nodes(degree: int, mirrored: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Points (2, ...) traced to fit and to check; and the traced one, with its sign in x, for each of the rings."""
    rings = _rings(degree)
    step = np.arange(_CHECKS)
    radius, angle = np.sqrt((step + 1) / _CHECKS), np.pi * (3 - 5**0.5) * step + 0.3
    checked = radius * np.stack([np.cos(angle), np.sin(angle)])
    if not mirrored:
        return rings, checked, None, None
    kept = np.flatnonzero(rings[0] > -1e-12)
    mirror = np.abs(rings[0, kept])[None] - np.abs(rings[0])[:, None], rings[1, kept][None] - rings[1][:, None]
    source = np.argmin(mirror[0] ** 2 + mirror[1] ** 2, 1)
    return rings[:, kept], np.stack([np.abs(checked[0]), checked[1]]), source, np.where(rings[0] < -1e-12, -1.0, 1.0)


@functools.lru_cache(maxsize=32)
def _rings(degree: int) -> np.ndarray:
    """Points (2, T) on rings of 2n + 5 - 4j points, j = 1, 2, …, symmetric in x; as many as the basis has terms."""
    points = []
    for ring in range(1, degree // 2 + 2):
        zeta = np.cos((2 * ring - 1) * np.pi / (2 * (degree + 1)))
        radius = 1.1565 * zeta - 0.76535 * zeta**2 + 0.60517 * zeta**3
        count = 2 * degree + 5 - 4 * ring
        angle = np.pi / 2 + np.arange(count) * (2 * np.pi / count)
        points.append(radius * np.stack([np.cos(angle), np.sin(angle)]))
    return np.concatenate(points, 1)


@functools.lru_cache(maxsize=32)
def _solution(degree: int) -> np.ndarray:
    return np.linalg.inv(_basis(degree, *_polar(_rings(degree))))


def _polar(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.hypot(*points), np.arctan2(points[1], points[0])


def _basis(degree: int, radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
    radial, around = _factors(degree, radius, angle)
    return radial * around


def _factors(degree: int, radius: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ρ^m T_j(2ρ² - 1), (radii, terms), and cos mθ or sin mθ, (angles, terms)."""
    chebyshev = np.polynomial.chebyshev.chebvander(2 * radius**2 - 1, degree // 2)
    radial, around = [], []
    for m in range(degree + 1):
        for j in range((degree - m) // 2 + 1):
            for turn in (np.cos, np.sin)[: 2 if m else 1]:
                radial.append(radius**m * chebyshev[:, j])
                around.append(turn(m * angle))
    return np.stack(radial, -1), np.stack(around, -1)
