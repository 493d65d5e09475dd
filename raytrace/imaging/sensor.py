"""Noise: what a sensor adds to a picture: noise of its electronics and of the light, and the steps of its converter.

Integers of 8 or 16 bits are read as 0 to 1 (`image.as_picture`).
"""

import torch
from torch import Tensor

from raytrace.imaging.image import as_picture
from raytrace.maths.numerics import safe_sqrt


def add_noise(picture: Tensor, sigma: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Gaussian sensor noise of standard deviation `sigma`, in the units of the picture, broadcast against it."""
    picture = as_picture(picture)
    return picture + sigma * _normal(picture, generator)


def add_shot_noise(picture: Tensor, electrons: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Noise of counted electrons as a Gaussian of their variance, y = x + √(x/N) ξ, differentiable in x and N.

    electrons: N, how many a pixel of level 1 collects. Levels ≤ 0 have no noise.
    """
    picture = as_picture(picture)
    return picture + safe_sqrt(picture / electrons) * _normal(picture, generator)


def count_electrons(picture: Tensor, electrons: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Exact shot noise: y = n/N, n Poisson distributed of mean N x, none for x < 0; its gradient is that of x."""
    picture = as_picture(picture)
    counts = torch.poisson((picture.detach() * electrons).clamp(min=0), generator=generator)
    return picture + (counts / electrons - picture).detach()


def digitise(picture: Tensor, bits: int) -> Tensor:
    """The nearest of 2^bits levels from 0 to 1, saturated beyond; gradients pass as if there were no steps."""
    if bits < 1:
        raise ValueError(f"{bits} bits: expected at least 1")
    picture = as_picture(picture)
    steps = 2**bits - 1
    limited = picture.clamp(0.0, 1.0)
    return limited + ((limited * steps).round() / steps - limited).detach()


def _normal(picture: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.randn(picture.shape, dtype=picture.dtype, device=picture.device, generator=generator)
