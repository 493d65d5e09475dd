"""Spot: centroid, RMS and geometric radius of the points where rays meet a surface."""

import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.value import value
from raytrace.system.rays import Rays


@value
class Spot:
    """Statistics over the last axis of a batch of rays; entries (...), mm.

    centroid: (2, ...); rms_radius and geometric_radius (the largest distance) are about it, or about another point.
    mean_square_radius: mm², smooth where the RMS is 0: minimise this one.
    points: (2, ..., P) and valid: (..., P) what was averaged; rays: how many were valid.

    A spot that no ray of any weight reaches is nan, with gradient 0: it spoils the sum that it is added to, and no
    derivative of the others. A merit that leaves it out (`nansum`, a mask by `rays`) is rewarded for losing it: keep
    the lens where `rays` does not fall, add what a lost spot is to cost, or ask for an error (`empty`).
    """

    centroid: Tensor
    mean_square_radius: Tensor
    rms_radius: Tensor
    geometric_radius: Tensor
    points: Tensor
    valid: Tensor
    rays: Tensor


class EmptySpot(ValueError):
    """No ray of a spot arrives: it has no centroid and no radius."""


def spot_of(rays: Rays, weights: Tensor | None = None, *, about: Tensor | None = None, empty: str = "nan") -> Spot:
    """Spot of rays (3, ..., P) over their last axis, invalid ones left out; weights: (P,) or (..., P), 1 by default.

    about: (2, ...) mm, from where radii count, the centroid by default. Equally weighted hexapolar rays about the
    primary wavelength's chief ray are the default of OpticStudio; by the area that a ray stands for, about the
    centroid, a spot has the moments of the light.
    empty: what a spot without rays is: "nan", or "error", which raises EmptySpot and looks at the numbers to do so.
    """
    return spot_of_points(rays.position[:2], rays.valid, weights, about=about, empty=empty)


def spot_of_points(
    points: Tensor, valid: Tensor, weights: Tensor | None = None, *, about: Tensor | None = None, empty: str = "nan"
) -> Spot:
    """Spot of points (2, ..., P) mm; `about` and `empty` as for `spot_of`.

    One point is subtracted before the mean is formed, so that a spot of 1 pm 1 m off the axis keeps its digits; a spot
    of one ray has radius 0 and gradient 0.
    """
    weights = torch.ones_like(points[0]) if weights is None else weights.expand(points.shape[1:])
    weights = torch.where(valid, weights, 0.0)
    total = weights.sum(-1, keepdim=True)
    share = safe_divide(weights, total)
    first = valid & (valid.to(torch.int64).cumsum(-1) == 1)
    reference = torch.where(first, points, 0.0).sum(-1, keepdim=True)
    offset = torch.where(valid, points - reference, 0.0)
    mean = (share * offset).sum(-1, keepdim=True)
    centre = mean if about is None else about[..., None] - reference
    centred = torch.where(valid, offset - centre, 0.0)
    mean_square = (share * (centred[0] ** 2 + centred[1] ** 2)).sum(-1)
    # The radii are formed in units of a power of two near the largest coordinate: squares of 1e-200 or 1e200 are none.
    scale = _power_of_two(centred)
    square = (centred[0] / scale) ** 2 + (centred[1] / scale) ** 2
    scaled_mean = (share * square).sum(-1)
    largest = square.amax(-1) if square.shape[-1] else scaled_mean
    rms, geometric = (scale[..., 0] * safe_sqrt(t) for t in (scaled_mean, largest))
    found = where_lit(total[..., 0] != 0, (reference + mean)[..., 0], mean_square, rms, geometric, empty=empty)
    return Spot(*found, points=points, valid=valid, rays=valid.sum(-1))


def where_lit(lit: Tensor, *numbers: Tensor, empty: str = "nan") -> tuple[Tensor, ...]:
    """The numbers (..., *lit.shape) of spots where light arrives; elsewhere nan with gradient 0.

    empty: "nan", or "error": then EmptySpot is raised if a spot is dark. Raises ValueError for another word.
    """
    if empty not in ("nan", "error"):
        raise ValueError(f"empty = {empty!r}: expected 'nan' or 'error', what a spot without rays is")
    if empty == "error" and not bool(lit.all()):
        first = tuple(torch.nonzero(~lit)[0].tolist())
        raise EmptySpot(
            f"no ray reaches {int((~lit).sum())} of {lit.numel()} spots, first that of index {first}: "
            "it has no centroid and no radius"
        )
    return tuple(torch.where(lit, number, torch.nan) for number in numbers)


def _power_of_two(vectors: Tensor) -> Tensor:
    """The power of two above the largest entry of (2, ..., P) over the first and last axes, (..., 1); 1 if none."""
    if not vectors.shape[-1]:
        return vectors.new_ones((*vectors.shape[1:-1], 1))
    largest = vectors.detach().abs().amax(0).amax(-1, keepdim=True)
    usable = (largest > 0) & torch.isfinite(largest)
    return torch.ldexp(torch.ones_like(largest), torch.frexp(torch.where(usable, largest, 0.5)).exponent)
