"""Plain rays: a camera whose traced PSFs are of a few rays, the same ones at every step, as many publications have it.

A Gaussian of twelve rays has the centroid and covariance of those twelve, all of one weight; a lens learned with it
follows what they say of the aberrations, not what all light does.
"""

import dataclasses
import itertools
from collections.abc import Collection, Mapping

import torch
from torch import Tensor

from raytrace.imaging.camera import Camera
from raytrace.maths import pupil
from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide
from raytrace.psf_models import drt, gaussian
from raytrace.psf_models.pixels import gaussian_pixels
from raytrace.settings import CodesignSettings
from raytrace.tracing.scene import Scene, beam_share, scene, symmetry, trace_scene

_BLUR = 0.25  # of a ray of `drt`, half width in pixels: what makes it differentiable


def points(sampling: str, count: int, *, seed: int = 0) -> Tensor:
    """Pupil points (2, P): `count` of "sobol", or the least whole rings of "hexapolar" with as many."""
    if sampling == "hexapolar":
        return pupil.hexapolar(next(n for n in itertools.count(1) if 1 + 3 * n * (n + 1) >= count))[0]
    return pupil.sobol(count, seed=seed)[0]


def points_of_models(settings: CodesignSettings) -> dict[str, Tensor]:
    """Pupil points (2, P) of the models that are traced with plain rays, by the settings; none of the others."""
    counts = {"gaussian": settings.rays, "drt": settings.rays if settings.drt_rays is None else settings.drt_rays}
    return {
        model: points(settings.sampling, count, seed=settings.seed)
        for model, count in counts.items()
        if count is not None and (model == settings.model or (model == "drt" and settings.drt_rays is not None))
    }


class PlainRays(Camera):
    """A camera whose traced PSFs are those of rays through given pupil points, all of one weight.

    points: pupil points (2, P) by the name of a PSF model; a model without points is simulated as by any camera, with
    as many rays as its tolerance needs. The points of a model that `use` leaves are not used again: without
    `--drt-rays`, the DRT PSFs of step 2 sample the whole pupil, whatever the model of step 1 is.
    """

    def __init__(self, *given, points: Mapping[str, Tensor], kept: Collection[str] = (), **named):
        super().__init__(*given, **named)
        self._points, self._kept = dict(points), frozenset(kept)

    def use(self, model: str) -> None:
        self._points = {name: disc for name, disc in self._points.items() if name in self._kept}
        super().use(model)

    def kernels(self, object_distances: Tensor, field: int = 0) -> Tensor:
        if self.model not in self._points:
            return super().kernels(object_distances, field)
        lens, distances, fields = self.variables(), object_distances.to(self.fields.dtype), self.fields[:, [field]]
        light = scene(lens, fields, distances, lens.wavelengths, self._memo)
        window = _of_wavelengths(self._window(lens, fields, distances), len(lens.wavelengths))
        shares = lens.wavelength_weights / lens.wavelength_weights.sum()
        kernel = _KERNELS[self.model](light, window, self._points[self.model].to(fields))
        kernel = (kernel * shares[:, None, None]).sum(2)[:, 0]
        return safe_divide(kernel, kernel.sum((-2, -1), keepdim=True)) if self.normalise == "window" else kernel


def _of_wavelengths(window: Grid, count: int) -> Grid:
    """A window that follows chief rays, (2, D, F) of them, for each of so many wavelengths."""
    if window.centre.dim() == 1:
        return window
    return dataclasses.replace(window, centre=window.centre[..., None].expand(*window.centre.shape, count))


def _gaussian(light: Scene, window: Grid, disc: Tensor) -> Tensor:
    """Kernels (D, F, W, rows, columns) of the mean and covariance of the rays that arrive."""
    traced, weights = trace_scene(light, disc), torch.full_like(disc[0], 1 / disc.shape[1])
    valid = traced.valid.expand(*light.shape, disc.shape[1])
    hits = traced.position[:2].expand(2, *valid.shape)
    centroid, covariance, arrived = gaussian.spot_moments(gaussian.Light(hits, valid, weights, disc.shape[1]), "none")
    if symmetry(light) != "none" and _is_mirrored(disc):
        covariance = covariance[[0, 2]]  # xy is 0 but for rounding, and costs a quadrature over every pixel
    return (arrived * beam_share(light))[..., None, None] * gaussian_pixels(window, centroid, covariance)


def _drt(light: Scene, window: Grid, disc: Tensor) -> Tensor:
    return drt.kernels_of_points(light, window, disc, torch.full_like(disc[0], 1 / disc.shape[1]), width=_BLUR).kernel


def _is_mirrored(disc: Tensor) -> bool:
    """Whether pupil points (2, P) have, to rounding, their mirror images about x = 0 among them."""
    image = disc * disc.new_tensor([[-1.0], [1.0]])
    return bool(((image[:, :, None] - disc[:, None]).abs().amax(0).amin(1) < 1e-12).all())


_KERNELS = {"gaussian": _gaussian, "drt": _drt}
