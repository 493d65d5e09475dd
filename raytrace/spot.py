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
    square = centred[0] ** 2 + centred[1] ** 2
    mean_square = (share * square).sum(-1)
    largest = square.amax(-1) if square.shape[-1] else mean_square
    return Spot(
        centroid=(reference + mean)[..., 0],
        mean_square_radius=mean_square,
        rms_radius=safe_sqrt(mean_square),
        geometric_radius=safe_sqrt(largest),
        points=points,
        valid=valid,
        rays=valid.sum(-1),
    )
