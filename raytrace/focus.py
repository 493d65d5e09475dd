"""Focus: the sensor distance of least RMS spot, in closed form.

Rays in image space are straight: moving the sensor by s moves a hit by s·m, m = (L, M)/N. The mean square radius about
each spot's own centroid is a parabola in s, so nothing is retraced:

    s = -Σ W cov(x, m) / Σ W var(m)
"""

from collections.abc import Callable, Sequence

import scipy.optimize
import torch
from torch import Tensor

from raytrace.launch import launch
from raytrace.lens import Lens, with_object_distance
from raytrace.numerics import safe_divide
from raytrace.rays import Rays
from raytrace.spot import Spot, spot_of_points
from raytrace.trace import media, trace_surfaces


def image_rays(lens: Lens, pupil: Tensor, *, fields: Tensor | None = None, wavelengths: Tensor | None = None) -> Rays:
    """Rays (3, F, W, P) on the sensor, with their direction before it; arguments as for `launch`.

    The sensor may touch glass: what bends rays there does not tell where they came from.
    """
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    indices = media(lens, wavelengths[:, None])
    rays = launch(lens, pupil, fields=fields, wavelengths=wavelengths)
    return trace_surfaces(lens.surfaces[1:], rays, indices=[*indices[:-1], indices[-2]])


def focus_moments(rays: Rays, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """cov(x, m) in mm and var(m), x the hits and m = (L, M)/N the slopes, over the last axis of rays (3, ..., P).

    The mean square radius on a sensor moved by s is its value at 0 plus 2 s cov + s² var. weights: (P,) or (..., P).
    """
    points, slopes = _points_and_slopes(rays)
    weights = torch.ones_like(points[0]) if weights is None else weights.expand(points.shape[1:])
    weights = torch.where(rays.valid, weights, 0.0)
    share = safe_divide(weights, weights.sum(-1, keepdim=True))
    centred = points - (share * points).sum(-1, keepdim=True)
    tilted = slopes - (share * slopes).sum(-1, keepdim=True)
    return (share * (centred * tilted).sum(0)).sum(-1), (share * (tilted * tilted).sum(0)).sum(-1)


def spot_parabola(rays: Rays, weights: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Q0 mm², Q1 mm, Q2 of the mean square radius Q0 + 2 s Q1 + s² Q2 on a sensor moved by s mm; each (...).

    rays: (3, ..., P) as `image_rays` gives them. Once they are traced, a step of an optimisation of the sensor distance
    is this polynomial, whatever the number of rays.
    """
    return spot_of_points(rays.position[:2], rays.valid, weights).mean_square_radius, *focus_moments(rays, weights)


def through_focus(rays: Rays, shifts: Tensor, weights: Tensor | None = None) -> Spot:
    """Spots (S, ...) on the sensor moved by each of the shifts (S,) mm; rays: (3, ..., P) on the sensor."""
    points, slopes = _points_and_slopes(rays)
    shifts = shifts.reshape(-1, *(1,) * (points.dim() - 1))
    moved = points[:, None] + shifts * slopes[:, None]
    return spot_of_points(moved, rays.valid.expand(moved.shape[1:]), weights)


def focus(
    lens: Lens,
    pupil: Tensor,
    weights: Tensor,
    *,
    object_distances: Sequence[Tensor | float] | None = None,
    distance_weights: Sequence[float] | None = None,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    field_weights: Tensor | None = None,
    wavelength_weights: Tensor | None = None,
) -> Tensor:
    """Sensor distance (scalar, mm) of least RMS spot over object distances × fields × wavelengths.

    pupil, weights: (2, P), (P,) of a rule in `pupil`; object_distances: mm, that of the lens by default; the other
    weights are 1 by default. Differentiable in every number of the lens.
    """
    distances = [lens.surfaces[0].thickness] if object_distances is None else object_distances
    distance_weights = [1.0] * len(distances) if distance_weights is None else distance_weights
    covariance = variance = torch.zeros_like(lens.surfaces[-2].thickness)
    for distance, distance_weight in zip(distances, distance_weights, strict=True):
        rays = image_rays(with_object_distance(lens, distance), pupil, fields=fields, wavelengths=wavelengths)
        moments = focus_moments(rays, weights)
        share = rays.position.new_full(moments[0].shape, distance_weight)
        share = share if field_weights is None else share * field_weights[:, None]
        share = share if wavelength_weights is None else share * wavelength_weights
        covariance, variance = covariance + (share * moments[0]).sum(), variance + (share * moments[1]).sum()
    return lens.surfaces[-2].thickness - safe_divide(covariance, variance)


def _points_and_slopes(rays: Rays) -> tuple[Tensor, Tensor]:
    """Hits (2, ...) mm and slopes (L, M)/N (2, ...), zero for lost rays."""
    slopes = safe_divide(rays.direction[:2], rays.direction[2].expand_as(rays.direction[:2]))
    return torch.where(rays.valid, rays.position[:2], 0.0), torch.where(rays.valid, slopes, 0.0)


def focus_of_merit(merit: Callable[[Tensor], Tensor], start: Tensor, *, step: float = 0.1, tolerance: float = 1e-10):
    """Sensor distance (scalar, mm) that minimises any differentiable merit of it, found by its gradient.

    merit: sensor distance (scalar, mm) -> scalar, smooth near its minimum; start: mm, where the search begins, within
    the basin of the minimum; step: mm, the first step of the search for a bracket; tolerance: mm.
    The slope is bracketed and its zero found by Brent's method (scipy); one Newton step then attaches the implicit
    derivative ds/dp = -∂²M/∂s∂p / ∂²M/∂s², so the result is differentiable once in all that the merit depends on.
    Raises ValueError if the merit has no minimum within 2²⁰ steps.
    """

    def slope(s: Tensor, *, create_graph: bool = False) -> Tensor:
        s = s if s.requires_grad else s.detach().requires_grad_()
        return torch.autograd.grad(merit(s), s, create_graph=create_graph)[0]

    def slope_at(s: float) -> float:
        return float(slope(start.new_tensor(s)))

    first = float(start)
    here = slope_at(first)
    if here != 0:
        direction = -step if here > 0 else step
        for doubling in range(20):
            last = first + direction * 2**doubling
            if slope_at(last) * here <= 0:
                break
        else:
            raise ValueError(f"the merit has no minimum within {abs(last - first):g} mm of sensor distance {first:g}")
        low, high = sorted((first, last))
        first = scipy.optimize.brentq(slope_at, low, high, xtol=tolerance, rtol=8.9e-16)
    s = start.new_tensor(first).requires_grad_()
    gradient = slope(s, create_graph=True)
    if not gradient.requires_grad:
        return s.detach()
    (bend,) = torch.autograd.grad(gradient, s, retain_graph=True)
    if float(bend) <= 0:
        return s.detach()
    return s.detach() - (gradient - gradient.detach()) / bend.detach()
