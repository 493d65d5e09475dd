"""Focus: the sensor distance of the smallest spot.

Rays in image space are straight: moving the sensor by s along its normal moves a hit by s·m, m = (L, M)/N. The mean
square radius about each spot's own centroid is a parabola in s, and its minimum over objects, fields and wavelengths of
weights W needs no second trace:

    s = -Σ W cov(x, m) / Σ W var(m)
"""

from collections.abc import Callable, Iterator, Sequence
from typing import TypedDict, Unpack

import scipy.optimize
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.sampling import gauss_rings
from raytrace.system.lens import (
    Lens,
    with_object_distance,
    with_sensor_distance,
)
from raytrace.system.poses import direction_in
from raytrace.system.rays import Rays
from raytrace.tracing.base_ray import base_ray
from raytrace.tracing.clear_pupil import clear_pupil
from raytrace.tracing.paraxial import paraxial_image_distance
from raytrace.tracing.spot import EmptySpot, Spot, image_rays, spot_of, spot_of_points, where_lit
from raytrace.tracing.trace import is_bent, side_behind
from raytrace.words import RaytraceError

_RINGS = 12  # of the pupil, for the focus on the axis


class Conjugates(TypedDict, total=False):
    """Options of `bundles`."""

    rings: int | None
    object_distances: Sequence[Tensor | float] | Tensor | None
    distance_weights: Sequence[float] | Tensor | None
    fields: Tensor | None
    wavelengths: Tensor | None
    field_weights: Tensor | None
    wavelength_weights: Tensor | None


class NoImage(RaytraceError, ValueError):
    """An object without a real image."""


def focus_moments(rays: Rays, weights: Tensor | None = None, *, empty: str = "nan") -> tuple[Tensor, Tensor]:
    """cov(x, m) in mm and var(m) of hits x and slopes m = (L, M)/N over the last axis of rays (3, ..., P).

    weights: (P,) or (..., P); empty: as for `spot_of`.
    """
    points, slopes = _points_and_slopes(rays)
    weights = torch.ones_like(points[0]) if weights is None else weights.expand(points.shape[1:])
    weights = torch.where(rays.valid, weights, 0.0)
    total = weights.sum(-1, keepdim=True)
    share = safe_divide(weights, total)
    centred = points - (share * points).sum(-1, keepdim=True)
    tilted = slopes - (share * slopes).sum(-1, keepdim=True)
    moments = (share * (centred * tilted).sum(0)).sum(-1), (share * (tilted * tilted).sum(0)).sum(-1)
    covariance, variance = where_lit(total[..., 0] != 0, *moments, empty=empty)
    return covariance, variance


def spot_parabola(rays: Rays, weights: Tensor | None = None, *, empty: str = "nan") -> tuple[Tensor, Tensor, Tensor]:
    """Q0 mm², Q1 mm, Q2 of the mean square radius Q0 + 2 s Q1 + s² Q2 on a sensor moved by s mm; each (...).

    rays: (3, ..., P) of `image_rays`; empty: as for `spot_of`.
    """
    return spot_of(rays, weights, empty=empty).mean_square_radius, *focus_moments(rays, weights)


def shift_to_focus(covariance: Tensor, variance: Tensor) -> Tensor:
    """s = -Q1/Q2 (...) mm along the normal of the sensor, where Q0 + 2 s Q1 + s² Q2 is least; 0 where Q2 is 0."""
    return -safe_divide(covariance, variance)


def through_focus(rays: Rays, shifts: Tensor, weights: Tensor | None = None, *, empty: str = "nan") -> Spot:
    """Spots (S, ...) on the sensor moved by each of the shifts (S,) mm along its own normal.

    rays: (3, ..., P) on the sensor; empty: as for `spot_of`.
    """
    points, slopes = _points_and_slopes(rays)
    shifts = shifts.reshape(-1, *(1,) * (points.dim() - 1))
    moved = points[:, None] + shifts * slopes[:, None]
    return spot_of_points(moved, rays.valid.expand(moved.shape[1:]), weights, empty=empty)


def focus_of_rms(
    lens: Lens, pupil: Tensor, weights: Tensor, *, empty: str = "nan", **scene: Unpack[Conjugates]
) -> Tensor:
    """Sensor distance (scalar, mm) of least RMS spot over object distances × fields × wavelengths.

    pupil, weights, scene: as for `bundles`. Differentiable in every number of the lens. empty: "nan" ignores spots
    without rays; without any ray, or with parallel rays, the distance is nan with gradient 0. "error" raises EmptySpot
    for either.
    """
    covariance = variance = torch.zeros_like(lens.surfaces[-2].thickness)
    for rays, light, share in bundles(lens, pupil, weights, **scene):
        moments = focus_moments(rays, light, empty=empty)
        covariance, variance = (
            total + torch.where(_lit(rays, light), share * moment, 0.0).sum()
            for total, moment in zip((covariance, variance), moments, strict=True)
        )
    if empty == "error" and not bool(variance > 0):
        raise EmptySpot("no sensor distance is best: the rays are parallel, or there is only one")
    shift = shift_to_focus(covariance, variance) / along_normal(lens)
    return torch.where(variance > 0, lens.surfaces[-2].thickness + shift, torch.nan)


def focus_of_mean_radius(lens: Lens, pupil: Tensor, weights: Tensor, **scene: Unpack[Conjugates]) -> Tensor:
    """Sensor distance (scalar, mm) of least mean distance of the hits from the centroid of their spot.

    Arguments as for `focus_of_rms`, whose result starts the search. Rays are traced once, to the sensor's present
    position; those that its rim clips there stay clipped. Not differentiable: on the axis the least mean is at a kink,
    where the rays of one ring cross. Raises EmptySpot if the rays have no focus, ValueError as `focus_of_merit`.
    """
    with torch.no_grad():
        start = focus_of_rms(lens, pupil, weights, **scene)
        traced = list(bundles(lens, pupil, weights, **scene))
    if not bool(torch.isfinite(start)):
        raise EmptySpot("no ray reaches the image, or all are parallel: there is no focus")

    def merit(sensor: Tensor) -> Tensor:
        total = torch.zeros_like(sensor)
        for rays, weights, share in traced:
            shift = (sensor - lens.surfaces[-2].thickness) * along_normal(lens)
            spots = through_focus(rays, shift.reshape(1), weights)
            x, y = torch.where(spots.valid, spots.points - spots.centroid[..., None], 0.0)
            light = torch.where(rays.valid, weights, 0.0)
            radius = safe_divide((light * safe_sqrt(x * x + y * y)).sum(-1), light.sum(-1))
            total = total + (share * radius).sum()
        return total

    return focus_of_merit(merit, start)


def mean_rms_radius(
    lens: Lens, pupil: Tensor, weights: Tensor, *, empty: str = "nan", **scene: Unpack[Conjugates]
) -> Tensor:
    """√ of the weighted mean of the mean square radii (scalar, mm) over object distances × fields × wavelengths.

    Arguments as for `focus_of_rms`, which minimises it. Spots without rays are ignored; without any ray it is nan or,
    with empty = "error", raises EmptySpot.
    """
    total = sum_of_shares = torch.zeros_like(lens.surfaces[-2].thickness)
    for rays, light, share in bundles(lens, pupil, weights, **scene):
        lit = _lit(rays, light)
        square = spot_of(rays, light, empty=empty).mean_square_radius
        total = total + torch.where(lit, share * square, 0.0).sum()
        sum_of_shares = sum_of_shares + torch.where(lit, share, 0.0).sum()
    return where_lit(sum_of_shares > 0, safe_sqrt(safe_divide(total, sum_of_shares)), empty=empty)[0]


def _lit(rays: Rays, weights: Tensor) -> Tensor:
    """Whether a ray of any weight arrives, (...)."""
    return (rays.valid & (weights != 0)).any(-1)


def bundles(
    lens: Lens,
    pupil: Tensor,
    weights: Tensor,
    *,
    rings: int | None = None,
    object_distances: Sequence[Tensor | float] | Tensor | None = None,
    distance_weights: Sequence[float] | Tensor | None = None,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    field_weights: Tensor | None = None,
    wavelength_weights: Tensor | None = None,
) -> Iterator[tuple[Rays, Tensor, Tensor]]:
    """The rays (3, F, W, P) of every object distance (mm, the lens's by default), their weights, and those (F, W) of
    their spots.

    pupil, weights: (2, P), (P,) of a rule, of which the rays that arrive count; rings: instead, those of
    `clear_pupil`, which end at the edges of apertures. fields, wavelengths: as for `launch`; weights of object
    distances, fields and wavelengths: one for each, 1 by default.
    """
    distances = [lens.surfaces[0].thickness] if object_distances is None else object_distances
    distance_weights = [1.0] * len(distances) if distance_weights is None else distance_weights
    for distance, distance_weight in zip(distances, distance_weights, strict=True):
        view = with_object_distance(lens, distance)
        if rings is not None:
            pupil, weights = clear_pupil(view, fields=fields, wavelengths=wavelengths, rings=rings, arms=4 * rings)
        rays = image_rays(view, pupil, fields=fields, wavelengths=wavelengths)
        share = rays.position.new_full(rays.shape[:-1], distance_weight)
        share = share if field_weights is None else share * field_weights[:, None]
        yield rays, weights, share if wavelength_weights is None else share * wavelength_weights


def best_focus(lens: Lens) -> Tensor:
    """Sensor distance (scalar, mm) of least RMS spot on the axis, over the lens's wavelengths by their weights.

    Raises EmptySpot where no ray arrives.
    """
    axis, weights = lens.wavelengths.new_zeros(2, 1), lens.wavelength_weights
    rule = gauss_rings(_RINGS)
    return focus_of_rms(lens, *rule, rings=_RINGS, fields=axis, wavelength_weights=weights, empty="error")


def along_normal(lens: Lens) -> Tensor | float:
    """Motion of the sensor along its own normal per mm of sensor distance: cos of the tilt of the image surface."""
    pose = lens.surfaces[-1].before
    if pose is None:
        return 1.0
    zero = torch.zeros_like(lens.surfaces[-2].thickness)
    return direction_in(pose, [zero, zero, torch.ones_like(zero)])[2]


def paraxial_sensor(lens: Lens, object_distances: Tensor) -> Tensor:
    """Sensor distances (D,) mm of the paraxial images of objects at distances (D,) mm, inf allowed.

    Where the axis bends: the mean of the images of both sections along the base ray, or the only one.
    """
    if not is_bent(lens):
        return paraxial_image_distance(lens, object_distances)
    base = base_ray(with_object_distance(lens, object_distances))
    finite = torch.isfinite(base.image_distance)
    total, count = torch.where(finite, base.image_distance, 0.0).sum(0), finite.sum(0)
    ahead = torch.where(count > 0, total / count.clamp_min(1), torch.inf) - base.way_to_image
    return lens.surfaces[-2].thickness + ahead * base.direction[2] / along_normal(lens)


def real_image_distance(lens: Lens, object_distances: Tensor) -> Tensor:
    """`paraxial_sensor`; raises NoImage for an image that is not behind the lens."""
    images = paraxial_sensor(lens, object_distances)
    wrong = ~(_behind(lens, images) & torch.isfinite(images))
    if bool(wrong.any()):
        distance, image = (float(part[wrong][0]) for part in (object_distances.detach(), images.detach()))
        raise NoImage(
            f"no real image of an object at {distance:g} mm: it lies within the focal length, or the lens diverges "
            f"(paraxial image at {image:g} mm)"
        )
    return images


def is_behind(lens: Lens, distance: Tensor) -> bool:
    """Whether a sensor distance (mm) lies on the side of the last surface that the light travels to."""
    return bool(_behind(lens, distance).all())


def _behind(lens: Lens, distance: Tensor) -> Tensor:
    if is_bent(lens):
        base = base_ray(lens)
        ahead = (distance - lens.surfaces[-2].thickness) * along_normal(lens) / base.direction[2]
        return (base.way_to_image + ahead > 0).detach()
    side = side_behind(lens.surfaces)
    return (side * distance > 0).detach()


def focused(lens: Lens, object_distance: float, *, on: str = "paraxial") -> Lens:
    """The lens with an object at a distance (mm, inf allowed) and the sensor at its image on the axis.

    on: "paraxial", or "rms", the least RMS spot. Raises NoImage where the image is not real.
    """
    lens = with_object_distance(lens, object_distance)
    sensor = real_image_distance(lens, lens.wavelengths.new_tensor([object_distance]))
    lens = with_sensor_distance(lens, sensor[0].detach())
    return with_sensor_distance(lens, best_focus(lens).detach()) if on == "rms" else lens


def _points_and_slopes(rays: Rays) -> tuple[Tensor, Tensor]:
    """Hits (2, ...) mm and slopes (L, M)/N (2, ...), zero for lost rays."""
    slopes = safe_divide(rays.direction[:2], rays.direction[2].expand_as(rays.direction[:2]))
    return torch.where(rays.valid, rays.position[:2], 0.0), torch.where(rays.valid, slopes, 0.0)


def focus_of_merit(
    merit: Callable[[Tensor], Tensor], start: Tensor, *, step: float = 0.1, tolerance: float = 1e-10
) -> Tensor:
    """Sensor distance (scalar, mm) that minimises a merit function of it, without derivatives.

    merit: sensor distance (scalar, mm) -> scalar, differentiable; start: mm, within the basin of the minimum; step: mm,
    the first step of the bracketing; tolerance: mm. The zero of the slope is bracketed and found by Brent's method
    (scipy). Raises ValueError if the merit has no minimum within 2²⁰ steps.
    """

    def slope_at(s: float) -> float:
        sensor = start.new_tensor(s).requires_grad_()
        return float(torch.autograd.grad(merit(sensor), sensor)[0])

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
    return start.new_tensor(first)
