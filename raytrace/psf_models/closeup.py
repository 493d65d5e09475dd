"""Close-ups: the light of a model on samples far finer than the pixels of a sensor, in windows that it fills."""

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
_ALIKE = 4.0  # widths that differ by a larger factor have separate windows
_SAMPLES = 129  # across a window
_WORK = 3e9  # of a kernel of waves: pupil points times nodes of the sensor, seconds
_RAYS = 2**18  # of a ray-traced one: dozens in a sample


@value
class CloseUp:
    """Light over object distance × field (× wavelength), as the `Psf` it belongs to, N × N samples each.

    light: (D, F, N, N) or (D, F, W, N, N), 1 = all light through the entrance pupil, in each sample.
    half: (D, F) mm, half the width of the windows; centre: (2, D, F) mm on the sensor.
    """

    light: Tensor
    half: Tensor
    centre: Tensor


@torch.no_grad()
def close_up(psfs: Psf) -> CloseUp:
    """The light of the kernels of a `Psf`, finely sampled.

    Windows are centred on the centroid of the rays and hold three of their σ, with diffraction three Airy radii more,
    but no less than a pixel where the light is a point. All have one size, unless kernels differ by more than four
    times in width. Where waves would need too many samples, windows are smaller, down to the window of `psfs`.
    """
    half, centre = _windows(psfs)
    plain = MODELS[psfs.model].plain is not None
    model = dataclasses.replace(psfs.parameters, **({"rays": _RAYS, "order": None} if plain else {"order": psfs.order}))
    colours = {"wavelengths": psfs.wavelengths, "wavelength_weights": psfs.wavelength_weights}
    colours |= {"per_wavelength": not psfs.wavelengths_summed}

    def light(distances: slice, fields: slice) -> Tensor:
        grid = Grid(2 * half[distances, fields].max() / _SAMPLES, _SAMPLES, _SAMPLES, centre[:, distances, fields])
        where = {"fields": psfs.fields[:, fields], "object_distances": psfs.object_distances[distances]}
        try:
            return psf(psfs.lens, model, grid=grid, center="axis", **where, **colours).kernel
        except EmptyPsf:
            return psfs.kernel.new_zeros(*psfs.energy[distances, fields].shape, _SAMPLES, _SAMPLES)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)
        if bool((half == half.max()).all()):
            return CloseUp(light(slice(None), slice(None)), half, centre)
        D, F = half.shape
        rows = [[light(slice(d, d + 1), slice(f, f + 1)) for f in range(F)] for d in range(D)]
        return CloseUp(torch.cat([torch.cat(row, 1) for row in rows]), half, centre)


def _windows(psfs: Psf) -> tuple[Tensor, Tensor]:
    """Half widths (D, F) mm and centres (2, D, F) mm of windows that the kernels fill, or that waves can afford."""
    centroid, covariance = (moment.nan_to_num(0.0) for moment in (psfs.ray_centroid, psfs.ray_covariance))
    blur = 2 * safe_sqrt(torch.maximum(covariance[0], covariance[2]))
    if not psfs.wavelengths_summed:
        blur = blur.amax(-1)
        centroid, covariance = mixture(psfs.wavelength_weights.expand(psfs.energy.shape), centroid, covariance)
    half = _SIGMAS * safe_sqrt(torch.maximum(covariance[0], covariance[2]))
    if psfs.waves:
        number = axial_f_number(with_object_distance(psfs.lens, psfs.object_distances[:, None])).abs()
        half = half + _RADII * 1.22e-3 * psfs.wavelengths.max() * torch.where(torch.isfinite(number), number, 0.0)
    half = torch.where(half > 1e-9, half, psfs.grid.pitch)
    half = half.max().expand_as(half) if bool(half.max() <= _ALIKE * half.min()) else half
    if psfs.waves:
        least = 0.5 * psfs.grid.pitch * max(psfs.grid.shape)
        cutoff = 1e3 / (psfs.wavelengths.min() * torch.where(torch.isfinite(number), number, 1.0))
        # Pupil points grow with the square of blur and window, nodes with that of the window over the finest fringes.
        for _ in range(20):
            points = psfs.rays * ((blur + 1.4 * half) / (blur + 1.4 * least)) ** 2
            nodes = math.pi * cutoff * half + 2 * _SAMPLES
            expensive = (points * nodes * nodes > _WORK) & (half > least)
            half = torch.where(expensive, torch.maximum(0.8 * half, least), half)
    return half, centroid
