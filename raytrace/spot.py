"""Spot: centroid, RMS and geometric radius of the points where rays meet a surface."""

import torch
from torch import Tensor

from raytrace.numerics import safe_divide, safe_sqrt
from raytrace.rays import Rays
from raytrace.value import value


@value
class Spot:
    """Statistics over the last axis of a batch of rays; entries (...), mm.

    centroid: (2, ...); rms_radius and geometric_radius (the largest distance) are about the centroid.
    mean_square_radius: mm², smooth where the RMS is 0: minimise this one.
    points: (2, ..., P) and valid: (..., P) what was averaged; rays: how many were valid.
    """

    centroid: Tensor
    mean_square_radius: Tensor
    rms_radius: Tensor
    geometric_radius: Tensor
    points: Tensor
    valid: Tensor
    rays: Tensor


def spot(rays: Rays, weights: Tensor | None = None) -> Spot:
    """Spot of rays (3, ..., P) over their last axis, invalid ones left out; weights: (P,) or (..., P), 1 by default."""
    return spot_of_points(rays.position[:2], rays.valid, weights)


def spot_of_points(points: Tensor, valid: Tensor, weights: Tensor | None = None) -> Spot:
    """Spot of points (2, ..., P) mm.

    One point is subtracted before the mean is formed, so that a spot of 1 pm 1 m off the axis keeps its digits; an
    empty spot, or a spot of one ray, has radius 0 and gradient 0.
    """
    weights = torch.ones_like(points[0]) if weights is None else weights.expand(points.shape[1:])
    weights = torch.where(valid, weights, 0.0)
    total = weights.sum(-1, keepdim=True)
    share = safe_divide(weights, total)
    first = valid & (valid.to(torch.int64).cumsum(-1) == 1)
    reference = torch.where(first, points, 0.0).sum(-1, keepdim=True)
    offset = torch.where(valid, points - reference, 0.0)
    mean = (share * offset).sum(-1, keepdim=True)
    centred = torch.where(valid, offset - mean, 0.0)
    mean_square = (share * (centred[0] ** 2 + centred[1] ** 2)).sum(-1)
    # The radii are formed in units of a power of two near the largest coordinate: squares of 1e-200 or 1e200 are none.
    scale = _power_of_two(centred)
    square = (centred[0] / scale) ** 2 + (centred[1] / scale) ** 2
    scaled_mean = (share * square).sum(-1)
    largest = square.amax(-1) if square.shape[-1] else scaled_mean
    return Spot(
        centroid=(reference + mean)[..., 0],
        mean_square_radius=mean_square,
        rms_radius=scale[..., 0] * safe_sqrt(scaled_mean),
        geometric_radius=scale[..., 0] * safe_sqrt(largest),
        points=points,
        valid=valid,
        rays=valid.sum(-1),
    )


def _power_of_two(vectors: Tensor) -> Tensor:
    """The power of two above the largest entry of (2, ..., P) over the first and last axes, (..., 1); 1 if none."""
    if not vectors.shape[-1]:
        return vectors.new_ones((*vectors.shape[1:-1], 1))
    largest = vectors.detach().abs().amax(0).amax(-1, keepdim=True)
    usable = (largest > 0) & torch.isfinite(largest)
    return torch.ldexp(torch.ones_like(largest), torch.frexp(torch.where(usable, largest, 0.5)).exponent)
