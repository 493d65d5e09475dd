"""Scene: object distance × field × wavelength, the rays of one, and what every PSF model gives back."""

import torch
from torch import Tensor

from raytrace.grid import Grid
from raytrace.launch import rays_of_field, vignette
from raytrace.lens import Lens, with_object_distance
from raytrace.rays import Rays
from raytrace.trace import trace
from raytrace.value import value


class EmptyPsf(ValueError):
    """No ray of a field reaches the sensor: there is no PSF to compute."""


@value
class Scene:
    """Object distance × field × wavelength: batch shape (D, F, W) of everything a model computes.

    lens: its object distance is (D, 1, 1), all finite or all inf.
    fields: (2, F) in the lens's kind of field; wavelengths: (W,) µm.
    """

    lens: Lens
    fields: Tensor
    wavelengths: Tensor

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, F, W)."""
        return len(self.lens.surfaces[0].thickness), self.fields.shape[1], len(self.wavelengths)


@value
class Kernels:
    """PSFs of one model, one for each object distance, field and wavelength.

    kernel: (D, F, W, rows, columns), energy in each pixel; 1 = all light through the entrance pupil.
    grid: its centre is (2,) or (2, D, F, W).
    centroid: (2, D, F, W) mm; covariance: (3, D, F, W) mm², xx, xy, yy, of the model's distribution before it is
        integrated over pixels.
    rays: how many rays were traced for each kernel; 0 if none.
    residual: (D, F, W) how wrong the model itself is here, where it can tell (relative L1), or None.
    """

    kernel: Tensor
    grid: Grid
    centroid: Tensor
    covariance: Tensor
    rays: int
    residual: Tensor | None = None


def scene(lens: Lens, fields: Tensor, object_distances: Tensor, wavelengths: Tensor) -> Scene:
    """A scene; object_distances: (D,) mm, all finite or all inf; fields: (2, F); wavelengths: (W,) µm."""
    return Scene(with_object_distance(lens, object_distances[:, None, None]), fields, wavelengths)


def trace_scene(scene: Scene, pupil: Tensor) -> Rays:
    """Rays (3, D, F, W, P) of pupil points (2, P) on the sensor, vignetting factors of the fields applied."""
    lens = with_object_distance(scene.lens, scene.lens.surfaces[0].thickness[..., None])
    field = scene.fields[:, :, None, None]
    wavelength = scene.wavelengths[:, None]
    rays = rays_of_field(lens, field, vignette(lens, field, pupil), wavelength=wavelength)
    rays = trace(lens, rays, wavelength)
    return Rays(
        *(torch.broadcast_to(t, (*t.shape[:-1], pupil.shape[1])) for t in (rays.position, rays.direction)),
        rays.valid,
        rays.opl,
    )
