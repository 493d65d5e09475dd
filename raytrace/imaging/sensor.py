"""Sensor: read noise, shot noise and quantisation.

Integers of 8 or 16 bits are scaled to 0 … 1 (`image.as_picture`).
"""

import torch
from torch import Tensor

from raytrace.imaging.image import as_picture
from raytrace.maths.numerics import safe_sqrt


def add_noise(picture: Tensor, sigma: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Gaussian noise of standard deviation `sigma`, in the unit of the image, broadcast against it."""
    picture = as_picture(picture)
    return picture + sigma * _normal(picture, generator)


def add_shot_noise(picture: Tensor, electrons: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Shot noise in the Gaussian approximation, y = x + √(x/N) ξ, differentiable in x and N.

    electrons: N, per pixel at level 1. Levels ≤ 0 have no noise.
    """
    picture = as_picture(picture)
    return picture + safe_sqrt(picture / electrons) * _normal(picture, generator)


def count_electrons(picture: Tensor, electrons: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Poisson shot noise: y = n/N, n of mean N x, 0 for x < 0; the gradient is that of x."""
    picture = as_picture(picture)
    counts = torch.poisson((picture.detach() * electrons).clamp(min=0), generator=generator)
    return picture + (counts / electrons - picture).detach()


def digitise(picture: Tensor, bits: int) -> Tensor:
    """The nearest of 2^bits levels from 0 to 1, saturated beyond; the gradient ignores the quantisation."""
    if bits < 1:
        raise ValueError(f"{bits} bits: expected at least 1")
    picture = as_picture(picture)
    steps = 2**bits - 1
    limited = picture.clamp(0.0, 1.0)
    return limited + ((limited * steps).round() / steps - limited).detach()


def _normal(picture: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.randn(picture.shape, dtype=picture.dtype, device=picture.device, generator=generator)
