"""Lenses as built: with errors of manufacture, and the sensor focused again as in manufacture.

The sensor of a perturbed lens is moved by as much as the errors move its best focus,

    s' = s + f(e) - f(0),   f: where the compensator of `tolerance` leaves the sensor, of one field about its centroid

so that a sensor distance that is learned away from best focus keeps its distance from it.
"""

from collections.abc import Sequence

from torch import Tensor

from raytrace.system.lens import Lens, aligned, with_sensor_distance
from raytrace.system.tolerance_data import Compensator
from raytrace.tolerancing.criteria import CRITERIA, Sampling
from raytrace.tolerancing.perturbation import perturbed
from raytrace.tolerancing.study import sampling_of
from raytrace.tolerancing.table import BadTolerance, ToleranceTable
from raytrace.tracing.focus import along_normal, shift_to_focus

_RINGS = 6  # of the pupil


def lens_as_built(lens: Lens, tolerances: ToleranceTable, errors: Tensor | Sequence[float], fields: Tensor) -> Lens:
    """The lens with errors (N,), or a lens for each row of (L, N), focused again where the sensor is the compensator.

    fields: (2, F) over which the mean square spot radius is least, all wavelengths about one centroid, for an object at
    the distance of the lens.
    Differentiable in the lens and in the errors. Raises BadTolerance for other compensators.
    """
    built, sensor = perturbed(lens, tolerances, errors), sensor_compensator(lens, tolerances)
    if sensor is None:
        return built
    sampling = sampling_of(lens, fields, _RINGS)
    shift = _best_focus(built, sampling) - _best_focus(lens, sampling)
    shift = shift.nan_to_num(0.0).clamp(sensor.minimum, sensor.maximum)  # not moved where a field has no light
    distance = built.surfaces[-2].thickness
    return with_sensor_distance(built, distance.reshape(-1) + shift if built.count else distance + shift[0])


def sensor_compensator(lens: Lens, tolerances: ToleranceTable) -> Compensator | None:
    """The sensor distance as compensator; None where nothing is adjusted. Raises BadTolerance for another one."""
    last = len(lens.surfaces) - 2
    for compensator in tolerances.compensators:
        if (compensator.surface, compensator.parameter, compensator.operand) != (last, "thickness", None):
            raise BadTolerance(
                f"compensator {compensator}: a camera as built is adjusted by its sensor distance alone, the "
                f"thickness of surface {last}; give tolerances(…, compensators=[Compensator({last})]), or "
                "compensators=() for none"
            )
    return tolerances.compensators[0] if tolerances.compensators else None


def _best_focus(lens: Lens, sampling: Sampling) -> Tensor:
    """Shift of the sensor (L,) mm, (1,) of a single lens, to the least mean square spot radius."""
    parabola = CRITERIA["rms"].parabola
    assert parabola is not None
    _, covariance, variance = parabola(aligned(lens, 3), sampling)
    along = along_normal(lens)
    return shift_to_focus(covariance, variance) / (along.reshape(-1) if isinstance(along, Tensor) else along)
