"""Close-ups: the light of a model far finer than the pixels of a sensor, in windows that its kernels fill."""

import dataclasses
import math
import warnings

import torch
from torch import Tensor

from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_sqrt
from raytrace.maths.value import value
from raytrace.psf_models.models import MODELS, NotConverged, psf
from raytrace.psf_models.result import EmptyPsf, Psf, mixture
from raytrace.system.lens import with_object_distance
from raytrace.tracing.f_number import axial_f_number

_SIGMAS = 3.0  # of the rays, and Airy radii, that half a window holds: a uniform disc reaches 2 σ, a caustic 3
_RADII = 3.0
_ALIKE = 4.0  # widths that differ by more than this have windows of their own
_SAMPLES = 129  # across a window
_WORK = 3e9  # of a kernel of waves: pupil points times nodes of the sensor, seconds
_RAYS = 2**18  # of a ray-traced one: dozens in a sample


@value
class CloseUp:
    """Light over object distance × field (× wavelength), as the `Psf` it belongs to, N × N samples each.

    light: (D, F, N, N) or (D, F, W, N, N), 1 being all light through the entrance pupil, in each sample.
    half: (D, F) mm, half the width of the windows; centre: (2, D, F) mm, theirs on the sensor.
    """

    light: Tensor
    half: Tensor
    centre: Tensor


@torch.no_grad()
def close_up(found: Psf) -> CloseUp:
    """The light that kernels are made of.

    Windows stand about the centroid of the rays and hold three of their σ, with diffraction three Airy radii more, but
    no less than a pixel where the light is a point. All have one size, but where kernels differ by more than four
    times in width each has its own. Where waves would need too many samples for that, windows are smaller, down to
    the pixels of `found`.
    """
    half, centre = _windows(found)
    half = _affordable(found, half)
    plain = MODELS[found.model].plain is not None
    numbers = {"rays": _RAYS, "order": None} if plain else {"order": found.order}
    model = dataclasses.replace(found.parameters, **numbers)
    work = {"wavelengths": found.wavelengths, "wavelength_weights": found.wavelength_weights}
    work |= {"per_wavelength": not found.wavelengths_summed, "center": "axis"}

    def light(distances: slice, chosen: slice) -> Tensor:
        grid = Grid(2 * half[distances, chosen].max() / _SAMPLES, _SAMPLES, _SAMPLES, centre[:, distances, chosen])
        where = {"fields": found.fields[:, chosen], "object_distances": found.object_distances[distances]}
        try:
            return psf(found.lens, model, grid=grid, **where, **work).kernel
        except EmptyPsf:  # no light: nothing to see
            return found.kernel.new_zeros(*found.energy[distances, chosen].shape, _SAMPLES, _SAMPLES)

    def of_all() -> Tensor:
        if bool((half == half.max()).all()):
            return light(slice(None), slice(None))
        each = [[light(slice(d, d + 1), slice(f, f + 1)) for f in range(half.shape[1])] for d in range(len(half))]
        return torch.cat([torch.cat(row, 1) for row in each])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)
        return CloseUp(of_all(), half, centre)


def _f_number(found: Psf) -> Tensor:
    """Working F-number (D, 1)."""
    return axial_f_number(with_object_distance(found.lens, found.object_distances[:, None])).abs()


def _windows(found: Psf) -> tuple[Tensor, Tensor]:
    """Half widths (D, F) mm and centres (2, D, F) mm of windows that the kernels fill."""
    centroid, covariance = (moment.nan_to_num(0.0) for moment in (found.ray_centroid, found.ray_covariance))
    if not found.wavelengths_summed:
        centroid, covariance = mixture(found.wavelength_weights.expand(found.energy.shape), centroid, covariance)
    half = _SIGMAS * safe_sqrt(torch.maximum(covariance[0], covariance[2]))
    if found.waves:
        number = _f_number(found)
        airy = 1.22e-3 * found.wavelengths.max() * torch.where(torch.isfinite(number), number, 0.0)
        half = half + _RADII * airy
    half = torch.where(half > 1e-9, half, found.grid.pitch)
    alike = bool(half.max() <= _ALIKE * half.min())
    return (half.max().expand_as(half) if alike else half), centroid


def _affordable(found: Psf, half: Tensor) -> Tensor:
    """The half widths, or smaller ones where waves would take more than `_WORK`; not below those of the pixels.

    The pupil points of a kernel grow with the square of blur and window (`phase_along_radius`), the nodes of the sensor
    with the square of the window over the finest fringes of the light.
    """
    least = 0.5 * found.grid.pitch * max(found.grid.shape)
    if not found.waves:
        return half
    number = _f_number(found)
    cutoff = 1e3 / (found.wavelengths.min() * torch.where(torch.isfinite(number), number, 1.0))
    blur = 2 * safe_sqrt(torch.maximum(found.ray_covariance[0], found.ray_covariance[2]).nan_to_num(0.0))
    blur = blur if found.wavelengths_summed else blur.amax(-1)
    for _ in range(20):
        points = found.rays * ((blur + 1.4 * half) / (blur + 1.4 * least)) ** 2
        nodes = math.pi * cutoff * half + 2 * _SAMPLES
        dear = (points * nodes * nodes > _WORK) & (half > least)
        half = torch.where(dear, torch.maximum(0.8 * half, least), half)
    return half
