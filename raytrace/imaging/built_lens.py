"""Lenses as built: with errors of manufacture, and the sensor focused again as in manufacture.

The sensor of a perturbed lens is moved by as much as the errors move its best focus,

    s' = s + f(e) - f(0),   f = -Σ W cov(x, m) / Σ W var(m) over fields and wavelengths

so that a sensor distance that is learned away from best focus keeps its distance from it.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths.sampling import gauss_rings
from raytrace.system.lens import Lens, aligned, with_sensor_distance
from raytrace.system.tolerance_data import Compensator
from raytrace.tolerancing.perturbation import perturbed
from raytrace.tolerancing.tolerances import BadTolerance, Tolerances
from raytrace.tracing.focus import along_normal, shift_to_focus, spot_parabola
from raytrace.tracing.spot import image_rays

_RINGS, _ARMS = 4, 6  # of the pupil, as of `tolerance`


def lens_as_built(lens: Lens, tolerances: Tolerances, errors: Tensor | Sequence[float], fields: Tensor) -> Lens:
    """The lens with errors (N,), or a lens for each row of (L, N), focused again where the sensor is the compensator.

    fields: (2, F) over which the mean square spot radius is least, for an object at the distance of the lens.
    Differentiable in the lens and in the errors. Raises BadTolerance for other compensators.
    """
    built, sensor = perturbed(lens, tolerances, errors), sensor_compensator(lens, tolerances)
    if sensor is None:
        return built
    shift = (_best_focus(built, fields) - _best_focus(lens, fields)).clamp(sensor.minimum, sensor.maximum)
    return with_sensor_distance(
        built, built.surfaces[-2].thickness.reshape(-1) + shift if built.count else built.surfaces[-2].thickness + shift
    )


def sensor_compensator(lens: Lens, tolerances: Tolerances) -> Compensator | None:
    """The sensor distance as compensator; None where nothing is adjusted. Raises BadTolerance for another one."""
    last = len(lens.surfaces) - 2
    for one in tolerances.compensators:
        if (one.surface, one.parameter, one.operand) != (last, "thickness", None):
            raise BadTolerance(
                f"compensator {one}: a camera as built is adjusted by its sensor distance alone, the thickness of "
                f"surface {last}; give tolerances(…, compensators=[Compensator({last})]), or compensators=() for none"
            )
    return tolerances.compensators[0] if tolerances.compensators else None


def _best_focus(lens: Lens, fields: Tensor) -> Tensor:
    """Shift of the sensor () or (L,) mm to the least mean square spot radius over fields and wavelengths."""
    points, weights = gauss_rings(_RINGS, _ARMS, dtype=fields.dtype, device=fields.device)
    _, covariance, variance = spot_parabola(image_rays(aligned(lens, 3), points, fields=fields), weights)
    shares = lens.wavelength_weights / lens.wavelength_weights.sum()
    covariance, variance = ((shares * torch.nan_to_num(part)).sum((-2, -1)) for part in (covariance, variance))
    along = along_normal(lens)
    return shift_to_focus(covariance, variance) / (
        along.reshape(covariance.shape) if isinstance(along, Tensor) else along
    )
