"""Longitudinal aberration: where rays of an axial object point cross the axis, over the pupil."""

import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide
from raytrace.maths.result import Result, axis, masked
from raytrace.maths.value import value
from raytrace.optics.focus import image_rays
from raytrace.system.lens import Lens

_NEAR_AXIS = 1e-4  # of the pupil: the ray that stands for the centre leaves 1e-8 of the spherical aberration


@value
class LongitudinalAberration(Result):
    """Crossings (W, P) with the axis, mm along z from the sensor, of rays at heights `pupil` (P,) from 0 to 1.

    The first one is the paraxial focus of each wavelength. valid: (W, P) bool, whether there is a crossing;
    wavelengths: (W,) µm.
    """

    crossing: Tensor
    pupil: Tensor
    wavelengths: Tensor
    valid: Tensor

    def columns(self) -> dict[str, Tensor]:
        return {
            "wavelength": axis(self.wavelengths, 0, 2),
            "pupil": axis(self.pupil, 1, 2),
            "crossing": masked(self.crossing, self.valid),
        }


def longitudinal_aberration(lens: Lens, *, wavelengths: Tensor | None = None, size: int = 41) -> LongitudinalAberration:
    """Spherical aberration of every wavelength as -y N/M of rays (0, M, N) through `size` points of the pupil's y axis.

    A ray parallel to the axis behind the lens has no crossing, nor has a lost one.
    """
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    pupil = torch.linspace(0.0, 1.0, size, dtype=wavelengths.dtype, device=wavelengths.device)
    heights = torch.cat([torch.full_like(pupil[:1], _NEAR_AXIS), pupil[1:]])
    points = torch.stack([torch.zeros_like(heights), heights])
    rays = image_rays(lens, points, fields=torch.zeros_like(points[:, :1]), wavelengths=wavelengths)
    _, M, N = rays.direction[:, 0]
    crossing = -safe_divide(rays.position[1, 0] * N, M)
    return LongitudinalAberration(crossing, pupil, wavelengths, rays.valid[0] & (M != 0))
