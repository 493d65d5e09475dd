"""A camera's error in closed form, by the best linear filter of `deconvolve`: deterministic, no network, no noise."""

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence

import scipy.optimize
import torch
from torch import Tensor

from raytrace.imaging.camera import Camera
from raytrace.imaging.pictures import Pictures, crop
from raytrace.imaging.restoration import kernel_error
from raytrace.imaging.restoration import power_spectrum as periodogram
from raytrace.maths.numerics import safe_divide
from raytrace.maths.pupil import gauss_rings
from raytrace.optimization.solver import TensorDescent, minimise_tensors
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.focus import best_focus, focus_moments, real_image_distance
from raytrace.tracing.paraxial import paraxial_image_distance
from raytrace.tracing.spot import image_rays

#: Length of the first step, mm of thickness or of sag. L-BFGS-B takes 1 of its own units, and a sensor moved by 1 mm
#: lands behind the next optimum: where windows hold but the middle of a blur.
_FIRST_STEP = 0.02
#: Sensors that a scan tries, by model; those of one focus have one optimum, and Gaussians seldom two.
_SCANNED = {"gaussian": 17, "drt": 81}  # 16 µm apart for the double Gauss at F/3
_SETTLED = 1e-6  # of the error: a descent that gains less is at its end
_RINGS = 12  # of the pupil, for focus
_BETTER = 1e-4  # of the error: so much less a scan must promise for a second descent


def power_spectrum(pictures: Pictures, size: int, *, crops: int = 4, seed: int = 0) -> Tensor:
    """S (size, size) of patches of pictures, in the order of an FFT: its mean is the mean square of a pixel.

    Patches fade out towards their borders (a Hann window), whose edges would else look like texture.
    """
    total = torch.zeros(size, size, dtype=torch.float64)
    count = crops * len(pictures)
    for sample in range(count):
        patch = torch.as_tensor(crop(pictures, sample, epoch=0, size=size, crops=crops, seed=seed)).to(torch.float64)
        total += periodogram(patch[None])
    return total / count


def camera_error(camera: Camera, spectrum: Tensor, distances: Tensor) -> Tensor:
    """Mean square error of a camera with the best blind linear filter, over object distances (Z,) mm and its fields.

    spectrum: `power_spectrum` of the camera's pictures. Differentiable in the variables of the lens.
    """
    kernels = [camera.kernels(distances, field) for field in range(camera.fields.shape[1])]
    return kernel_error(torch.cat(kernels), spectrum.to(kernels[0].dtype), camera.noise)


def even_distances(camera: Camera, count: int = 33, *, spread: str = "uniform") -> Tensor:
    """Object distances z (count,) mm over the camera's range: the middle of each of so many parts.

    spread: parts are as large in z ("uniform") or in 1/z ("reciprocal").
    """
    near, far = camera.range
    place = (torch.arange(count, dtype=camera.fields.dtype, device=camera.fields.device) + 0.5) / count
    return near + (far - near) * place if spread == "uniform" else 1 / (1 / near + (1 / far - 1 / near) * place)


@dataclasses.dataclass(frozen=True)
class Course:
    """How the closed form led a lens: errors and penalties (mm²) at every evaluation, their sum being what falls.

    at_end: names of variables that stand at an end of their bounds behind which it still falls; no_optimum: why the
    last lens is none of least error, "" where it is one.
    """

    errors: tuple[float, ...]
    penalties: tuple[float, ...]
    at_end: tuple[str, ...]
    no_optimum: str


def optimise_closed_form(camera: Camera, spectrum: Tensor, *, distances: Tensor | None = None) -> Course:
    """Bring the variables of the lens to the least `camera_error`, with the penalty of a lens beyond its limits.

    By L-BFGS-B with exact gradients (scipy), within the bounds of the variables: the first optimum downhill.
    """
    distances = even_distances(camera) if distances is None else distances
    variables, parts = camera.variables, []

    def whole() -> Tensor:
        error, penalty = camera_error(camera, spectrum, distances), variables.violation()
        parts.append((float(error.detach()), float(penalty.detach())))
        return error + penalty

    def descend() -> TensorDescent:
        # Errors are of 1e-3 and variables of millimetres: the default tolerance (2e-9 of 1) would stop too soon.
        bounds = [_parameter_bounds(variables, variable) for variable in variables.variables]
        return minimise_tensors(list(variables.parameters()), whole, unit=_FIRST_STEP, bounds=bounds, tolerance=1e-11)

    found = descend()
    # A penalty on what is solved for has a kink where it begins, at which the search stops too soon: it begins anew.
    while variables.held is not None and found.values[0] - found.values[-1] > _SETTLED * found.values[-1]:
        found = descend()
    names = tuple(one.name for one, at_end in zip(variables.variables, found.at_end, strict=True) if at_end)
    names += (variables.held.by.name,) if variables.beyond() else ()
    errors, penalties = zip(*parts, strict=True)
    return Course(errors, penalties, names, _no_optimum(camera, found, names))


def least_of_closed_form(camera: Camera, spectrum: Tensor, *, distances: Tensor | None = None) -> tuple[Course, float]:
    """Bring the variables of the lens to the least `camera_error` of several descents; and where the first one led.

    One begins where the lens is, another at the least of a scan of sensors, evenly over all that have an object of the
    range in focus, if that promises less. Returned: the course of the better one, and the sensor distance in mm behind
    the first one, that of training without luck.
    """
    distances = even_distances(camera) if distances is None else distances
    start = copy.deepcopy(camera.variables.state_dict())
    downhill = optimise_closed_form(camera, spectrum, distances=distances)
    reached = float(camera.variables().surfaces[-2].thickness.detach())
    end = copy.deepcopy(camera.variables.state_dict())
    camera.variables.load_state_dict(start)
    place, error = least_of_scan(camera, spectrum, distances)
    if error >= downhill.errors[-1] * (1 - _BETTER):
        camera.variables.load_state_dict(end)
        return downhill, reached
    put_sensor(camera, place)
    found = optimise_closed_form(camera, spectrum, distances=distances)
    if found.no_optimum and not downhill.no_optimum:
        camera.variables.load_state_dict(end)
        return downhill, reached
    return found, reached


@torch.no_grad()
def least_of_scan(camera: Camera, spectrum: Tensor, distances: Tensor) -> tuple[float, float]:
    """Sensor distance in mm of least error among many that have some object in focus, and that error.

    (nan, inf) where the sensor is no variable, and for models of one focus, whose error has one optimum. The camera is
    left as it was.
    """
    if "sensor" not in [one.kind for one in camera.variables.variables] or camera.model not in _SCANNED:
        return math.nan, math.inf
    low, high = _in_focus(camera)
    bounds = camera.variables.bounds.get("sensor", (-math.inf, math.inf))
    low, high = max(low, bounds[0]), min(high, bounds[1])
    count = _SCANNED[camera.model]
    places = [low + (high - low) * (number + 0.5) / count for number in range(count)]
    found = scan(camera, spectrum, places, distances) if high > low else [math.inf]
    return min(zip(places, found, strict=False), key=lambda pair: pair[1])


@torch.no_grad()
def scan(camera: Camera, spectrum: Tensor, sensors: Sequence[float], distances: Tensor) -> list[float]:
    """Closed-form error of a camera with its sensor at each of the distances in mm; "sensor" is one of its variables.

    The camera is left as it was.
    """
    before, found = copy.deepcopy(camera.variables.state_dict()), []
    for sensor in sensors:
        put_sensor(camera, sensor)
        found.append(float(camera_error(camera, spectrum, distances)))
    camera.variables.load_state_dict(before)
    return found


@torch.no_grad()
def put_sensor(camera: Camera, sensor: float) -> None:
    """Move the sensor of a camera, one of its variables, to a distance in mm."""
    (variable,) = [one for one in camera.variables.variables if one.kind == "sensor"]
    camera.variables.get_parameter(variable.name).fill_((sensor - variable.start) / variable.unit)


def _no_optimum(camera: Camera, found: TensorDescent, at_end: tuple[str, ...]) -> str:
    """Why a descent ended at no optimum; "" where it is one, if only within some of the bounds."""
    variables = camera.variables
    if found.is_flat:
        return "no optimum: where the search began, the loss does not change with the variables"
    if at_end and ("sensor" in at_end or len(at_end) == len(variables.names)):
        # Without bounds of its own only a thickness that is solved for has an end.
        bounds = [variables.bounds.get(name, (0.0, math.inf)) for name in at_end]
        ranges = [f"{name} from {low:g} to {high:g}" for name, (low, high) in zip(at_end, bounds, strict=True)]
        return f"no optimum inside {', '.join(ranges)}: the loss still falls at its end"
    return out_of_focus(camera)


def out_of_focus(camera: Camera) -> str:
    """Why the sensor of a camera is out of focus for all objects of its range; "" where it is not."""
    low, high = _in_focus(camera)
    sensor = float(camera.variables().surfaces[-2].thickness.detach())
    if low <= sensor <= high:
        return ""
    near, far = camera.range
    return (
        f"no optimum inside {low:.7g} to {high:.7g} mm of sensor distance, where an object from {near:g} to {far:g} mm "
        f"is in focus to the width of the PSF: the loss still falls at its end, and the sensor went to {sensor:.7g} mm"
    )


def _in_focus(camera: Camera) -> tuple[float, float]:
    """Sensor distances in mm at which an object of the range is in focus to the width of the PSF."""
    width = float(camera.pixels.pitch.detach()) * camera.pixels.rows
    return sensor_range(camera.variables(), camera.range, fields=camera.fields, width=width)


def _parameter_bounds(variables, variable) -> tuple[float, float]:
    low, high = variables.bounds.get(variable.name, (-math.inf, math.inf))
    return tuple(sorted(((low - variable.start) / variable.unit, (high - variable.start) / variable.unit)))


# -- object distances in focus -----------------------------------------------------------------------------------------


def paraxial_image(lens: Lens) -> Tensor:
    """Sensor distance in mm of the paraxial image of the lens's object."""
    return paraxial_image_distance(lens, lens.surfaces[0].thickness)


@torch.no_grad()
def distance_in_focus(lens: Lens, image_distance: Callable[[Lens], Tensor]) -> float:
    """Object distance from vertex 1 in mm whose image, by `image_distance`, is on the sensor; inf beyond 1000 km."""

    def behind(vergence: float) -> float:
        return float(image_distance(with_object_distance(lens, 1 / vergence)) - lens.surfaces[-2].thickness)

    furthest, nearest = 1e-9, 2e-3
    if behind(furthest) >= 0:
        return math.inf
    if behind(nearest) < 0:
        raise ValueError(f"the sensor is in focus nearer than {1 / nearest:g} mm: too far behind the lens to be meant")
    return 1 / scipy.optimize.brentq(behind, furthest, nearest, xtol=1e-14, rtol=1e-12)


@torch.no_grad()
def sensor_range(lens: Lens, distances: Sequence[float], *, fields: Tensor, width: float) -> tuple[float, float]:
    """Sensor distances (mm) at which an object at some of the distances (mm) is in focus, to a blur `width` mm across.

    By paraxial images on the axis and least RMS spots of fields (2, F), from the nearest to the farthest, and by
    √2 · RMS slope of the rays on either side: there an even disc of light is as wide as that. Raises `NoImage` where
    an object has no real image.
    """
    place = lens.surfaces[-2].thickness
    found = [real_image_distance(lens, lens.wavelengths.new_tensor(distances))]
    steepness = [place.new_zeros(1)]
    for distance in distances:
        pupil, weights = gauss_rings(_RINGS)
        rays = image_rays(with_object_distance(lens, distance), pupil, fields=fields)
        covariance, variance = focus_moments(rays, weights)
        lit = variance > 0
        found.append((place - safe_divide(covariance, variance))[lit])
        steepness.append(variance[lit])
    images = torch.cat([one.flatten() for one in found])
    margin = 0.5 * width / math.sqrt(2 * float(torch.cat(steepness).max()) or math.inf)
    return float(images.min()) - margin, float(images.max()) + margin


def place_of(lens: Lens) -> dict[str, float]:
    """Where the sensor is, mm, and the object distances from vertex 1 in focus there, m: by name of the column."""
    return {
        "sensor_mm": float(lens.surfaces[-2].thickness),
        "focus_paraxial_m": 1e-3 * distance_in_focus(lens, paraxial_image),
        "focus_rms_m": 1e-3 * distance_in_focus(lens, best_focus),
    }
