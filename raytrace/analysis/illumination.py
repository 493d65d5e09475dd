"""Relative illumination: how much light a field's cone brings to the sensor, against the axis."""

import math

import torch
from torch import Tensor

from raytrace.analysis.setting import field_range, scene_of, wavelength_weights
from raytrace.maths import zernike
from raytrace.maths.numerics import safe_divide
from raytrace.maths.pupil import gauss_rings
from raytrace.maths.result import Result, axis
from raytrace.maths.value import value
from raytrace.optics.wavefront import wavefront_of
from raytrace.system.lens import Lens

_RINGS = 24, 96
_WORST_CONDITION = 1e8  # of the fit of that map
_TERMS = 45  # Zernike terms (to degree 8) of the map from the pupil to directions


@value
class RelativeIllumination(Result):
    """illumination: (F,), 1 on the axis; projected_solid_angle: (F,) sr; fields: (2, F)."""

    illumination: Tensor
    projected_solid_angle: Tensor
    fields: Tensor

    def columns(self) -> dict[str, Tensor]:
        return {
            "field_x": axis(self.fields[0], 0, 1),
            "field_y": axis(self.fields[1], 0, 1),
            "illumination": self.illumination,
            "projected_solid_angle": self.projected_solid_angle,
        }


def relative_illumination(
    lens: Lens, *, fields: Tensor | None = None, wavelengths: Tensor | None = None, size: int = 21
) -> RelativeIllumination:
    """E(field)/E(axis) of a uniformly bright object (Lambertian), without losses in glass:

        E = B ∬ dL dM = B π Σ_j w_j |∂(L, M)/∂p|_j      over the rays that arrive

    (L, M) the directions from the reference sphere at the exit pupil to the chief ray's point (Born & Wolf §4.8.3): the
    pupil as the sensor sees it, whatever the aberrations. fields: (2, F); by default `size` from the
    axis to the lens's largest. Vignetting by a hard edge is resolved to about 1e-3.
    """
    fields = field_range(lens, size) if fields is None else fields
    like = {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}
    points, weights = gauss_rings(*_RINGS, **like)
    view = scene_of(lens, torch.cat([torch.zeros_like(fields[:, :1]), fields], 1), wavelengths)
    front = wavefront_of(view, points, weights)
    orders = [zernike.noll(j) for j in range(1, _TERMS + 1)]
    basis = zernike.polynomials(orders, *points)
    # Where light comes through a small part of the pupil alone, the slopes of the map are not known from it.
    enough = (zernike.condition(basis, front.usable * weights) < _WORST_CONDITION)[..., None]
    directions = torch.where(front.usable & enough, front.direction[:2], 0.0)
    share = torch.where(front.usable | ~enough, weights, 0.0)
    fitted = zernike.fit(directions, basis, share)
    (L_x, M_x), (L_y, M_y) = (fitted @ slope for slope in zernike.gradients(orders, *points))
    jacobian = (L_x * M_y - L_y * M_x).abs()
    angle = math.pi * torch.where(front.valid & enough, weights * jacobian, 0.0).sum(-1)[0]
    angle = torch.where(enough[0, ..., 0] | ~front.valid[0].any(-1), angle, torch.nan)
    solid = (angle * wavelength_weights(lens, wavelengths)).sum(-1)
    return RelativeIllumination(safe_divide(solid[1:], solid[:1].expand_as(solid[1:])), solid[1:], fields)
