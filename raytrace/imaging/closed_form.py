"""A camera's error in closed form, by the best linear filter that knows neither object distance nor field, as a network
does not: deterministic, no network, no noise."""

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal, TypedDict

import scipy.optimize
import torch
from torch import Tensor

from raytrace.imaging.camera import Camera
from raytrace.imaging.image import decoded
from raytrace.imaging.lens_steps import LensSteps
from raytrace.imaging.octant import octant_error
from raytrace.imaging.pictures import Pictures, crop
from raytrace.imaging.restoration import (
    cross_spectrum,
    depth_invariant_wiener,
    joint_kernel_error,
    joint_wiener,
    kernel_error,
    power_spectrum,
)
from raytrace.imaging.variables import Variables
from raytrace.maths.numerics import safe_divide
from raytrace.maths.sampling import gauss_rings
from raytrace.optimization.least_squares import TensorDescent, minimise_tensors
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.focus import best_focus, focus_moments, real_image_distance
from raytrace.tracing.paraxial import paraxial_image_distance
from raytrace.tracing.spot import image_rays

#: Length of the first step, mm of thickness or of sag. L-BFGS-B takes 1 of its own units, and a sensor moved by 1 mm
#: lands beyond the next optimum, where a window holds only the middle of a blur.
_FIRST_STEP = 0.02
#: Sensor distances of a scan, by model; models of a single focus have one optimum, and Gaussians seldom two.
_SCANNED = {"gaussian": 17, "drt": 81}  # 16 µm apart for the double Gauss at F/3
_SETTLED = 1e-6  # relative decrease of the error below which a descent has ended
_BETTER = 1e-4  # relative decrease of the error for which a second descent is made
_RINGS = 12  # of the pupil, for focus


def patch_spectrum(pictures: Pictures, size: int, *, crops: int = 4, seed: int = 0, joint: bool = False) -> Tensor:
    """S (size, size) of patches of pictures, ordered as by `fft2`: its mean is the mean square of a pixel.

    A Hann window suppresses the borders of patches, which would look like texture. Of colour pictures (3, size, size),
    of their light; joint: their cross spectra (3, 3, size, size), see `cross_spectrum`.
    """
    total = torch.zeros(())
    count = crops * len(pictures)
    for sample in range(count):
        patch = torch.as_tensor(crop(pictures, sample, epoch=0, size=size, crops=crops, seed=seed)).to(torch.float64)
        patch = decoded(patch.movedim(-1, 0)) if patch.dim() == 3 else patch
        total = total + (cross_spectrum if joint else power_spectrum)(patch[None])
    return total / count


def camera_error(
    camera: Camera,
    spectrum: Tensor,
    distances: Tensor | Sequence[float],
    *,
    filter_each_field: bool = False,
    draw: torch.Generator | None = None,
) -> Tensor:
    """Mean square error behind the best filter that knows neither the field nor the object distance, over the camera's
    fields and distances (Z,) mm.

    spectrum: `patch_spectrum` of the camera's pictures. Differentiable in the variables of the camera. The mean over
    the channels of the sensor, each with a filter of its own; with cross spectra (C, C, rows, columns) the filter is
    joint, `joint_wiener`. filter_each_field: with filters for each field, which restore more than a network that does
    not know the field can. draw: of an element alone, generator of errors of fabrication. Round elements whose sampling
    is fixed (`Camera.plan`) need an eighth of the frequencies (`octant`).
    """
    _refuse_aliases(camera)
    spectrum = spectrum.to(camera.fields.device)
    sigma = camera.sensor.noise_deviation(spectrum)
    haze = camera.normalise == "haze"
    if haze:  # of elements alone, whose kernels are alike at all places
        of_elements = camera.element_kernels(distances, draw=draw)
        error = octant_error(of_elements, spectrum, sigma)
        if error is not None:
            return error
        kernels = of_elements.paired(camera.fields)[:, None]
    else:
        kernels = camera.kernels_over_field(distances, draw=draw)
    if not filter_each_field:
        kernels = kernels.flatten(0, 1)[:, None]
    if spectrum.dim() == 4:
        return joint_kernel_error(kernels, spectrum, sigma, haze=haze).mean()
    return kernel_error(kernels, spectrum.to(kernels.dtype), sigma, haze=haze).mean()


@torch.no_grad()
def field_filters(
    camera: Camera, spectrum: Tensor, places: Sequence[float], distances: Tensor | Sequence[float] | None = None
) -> Tensor:
    """Depth-invariant Wiener filters (N, C, rows, columns) of a sensor's channels at places on its diagonal; joint ones
    (N, C, C, rows, columns) for cross spectra (C, C, rows, columns).

    places: (N,) shares of the way from the middle of the sensor to its corner; distances: (Z,) mm, by default evenly
    over the camera's range; spectrum: (C, rows, columns) of the scene.
    """
    _refuse_aliases(camera)
    distances = even_distances(camera) if distances is None else distances
    spectrum = spectrum.to(camera.fields.device)
    kernels = camera.kernels_over_field(distances, camera.sensor.on_diagonal(places))
    transfer = camera.transfer(kernels, spectrum.shape[-2:])
    if spectrum.dim() == 4:
        return joint_wiener(transfer, spectrum, camera.sensor.noise_deviation(spectrum))
    return depth_invariant_wiener(transfer, spectrum.to(kernels.dtype), camera.sensor.noise_deviation(spectrum))


def _refuse_aliases(camera: Camera) -> None:
    if camera.oversampling > 1:
        raise ValueError(f"a camera with oversampling {camera.oversampling}: the error here has no aliases; expected 1")


def even_distances(camera: Camera, count: int = 33, *, spread: str = "uniform") -> Tensor:
    """Object distances z (count,) mm: the centres of equal parts of the camera's range.

    spread: the parts are equal in z ("uniform") or in 1/z ("reciprocal").
    """
    near, far = camera.range
    place = (torch.arange(count, dtype=camera.fields.dtype, device=camera.fields.device) + 0.5) / count
    return near + (far - near) * place if spread == "uniform" else 1 / (1 / near + (1 / far - 1 / near) * place)


@dataclasses.dataclass(frozen=True)
class Course:
    """Errors and penalties (mm²) at every evaluation of a descent, which minimises their sum.

    at_end: names of variables at a bound beyond which the sum still falls; no_optimum: the reason why the last lens is
    no optimum, "" if it is one.
    """

    errors: tuple[float, ...]
    penalties: tuple[float, ...]
    at_end: tuple[str, ...]
    no_optimum: str


def optimise_closed_form(
    camera: Camera[Variables],
    spectrum: Tensor,
    *,
    distances: Tensor | None = None,
    steps: int | None = None,
    optimizer: Literal["lbfgs", "lm"] = "lbfgs",
    filter_each_field: bool = False,
) -> Course:
    """Minimise `camera_error` plus the penalty for violated limits, within the bounds: the local optimum downhill.

    optimizer: "lbfgs", L-BFGS-B of scipy in the units of the variables, or "lm", steps of second order in the metric of
    the blur, under the conditions of the variables (`lens_steps`). steps: at most so many, by default until it has
    settled. filter_each_field: as of `camera_error`.
    """
    distances = even_distances(camera) if distances is None else distances
    variables, parts = camera.variables, []

    def loss() -> Tensor:
        error = camera_error(camera, spectrum, distances, filter_each_field=filter_each_field)
        penalty = variables.violation()
        parts.append((float(error.detach()), float(penalty.detach())))
        return error + penalty

    bounds = []
    for variable in variables.variables:
        ends = variables.bounds.get(variable.name, (-math.inf, math.inf))
        low, high = sorted((end - variable.start) / variable.unit for end in ends)
        bounds.append((low, high))

    def descend() -> TensorDescent:
        # Errors are of 1e-3 and variables of millimetres: the default tolerance (2e-9 of 1) would stop too soon.
        if optimizer == "lm":
            return LensSteps(variables).minimise(loss, **({} if steps is None else {"cycles": steps}))
        most = {} if steps is None else {"steps": steps}
        parameters = list(variables.parameters())
        return minimise_tensors(parameters, loss, unit=_FIRST_STEP, bounds=bounds, tolerance=1e-11, **most)

    descent = descend()
    # A penalty on a solved thickness has a kink where it begins, at which a descent stops too soon: restart it.
    while (
        steps is None
        and optimizer == "lbfgs"
        and variables.held is not None
        and descent.values[0] - descent.values[-1] > _SETTLED * descent.values[-1]
    ):
        descent = descend()
    names = tuple(variable.name for variable, at_end in zip(variables.variables, descent.at_end, strict=True) if at_end)
    names += (variables.held.by.name,) if variables.held is not None and variables.beyond() else ()
    if descent.is_flat:
        no_optimum = "no optimum: at the start of the search the loss does not change with the variables"
    elif names and ("sensor" in names or len(names) == len(variables.names)):
        # Without bounds of its own only a solved thickness has an end.
        ranges = ", ".join(
            "{} from {:g} to {:g}".format(name, *variables.bounds.get(name, (0.0, math.inf))) for name in names
        )
        no_optimum = f"no optimum inside {ranges}: the loss still falls at its end"
    else:
        no_optimum = out_of_focus(camera)
    errors, penalties = zip(*parts, strict=True)
    return Course(errors, penalties, names, no_optimum)


def least_of_closed_form(
    camera: Camera[Variables],
    spectrum: Tensor,
    *,
    distances: Tensor | None = None,
    optimizer: Literal["lbfgs", "lm"] = "lbfgs",
    filter_each_field: bool = False,
) -> tuple[Course, float]:
    """Minimise `camera_error` by descents from several lenses; returns the best one, at which the lens of the camera
    is, and the sensor distance reached by the first.

    The first starts at the camera's lens. With "lm" the next starts at the sharpest spots. The last starts at the
    minimum of a scan of sensor distances, evenly over those at which an object of the range is in focus, if the sensor
    varies and the scan promises less than the others reached: DRT and Gaussian DRT have several optima.
    filter_each_field: as of `camera_error`.
    """
    distances = even_distances(camera) if distances is None else distances
    variables, ends = camera.variables, []
    start = copy.deepcopy(variables.state_dict())

    def descend() -> None:
        course = optimise_closed_form(
            camera, spectrum, distances=distances, optimizer=optimizer, filter_each_field=filter_each_field
        )
        ends.append((course, copy.deepcopy(variables.state_dict())))
        variables.load_state_dict(start)

    descend()
    if optimizer == "lm":
        LensSteps(variables).minimise_spots()
        descend()
    if "sensor" in [variable.name for variable in variables.variables] and camera.model in _SCANNED:
        with torch.no_grad():
            ranges = _in_focus(camera), variables.bounds.get("sensor", (-math.inf, math.inf))
        low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
        count = _SCANNED[camera.model]
        sensors = [low + (high - low) * (number + 0.5) / count for number in range(count)]
        errors = [math.inf]
        if high > low:
            errors = scan(camera, spectrum, sensors, distances, filter_each_field=filter_each_field)
        if min(errors) < min(course.errors[-1] for course, _ in ends) * (1 - _BETTER):
            _move_sensor(camera, sensors[errors.index(min(errors))])
            descend()
    variables.load_state_dict(ends[0][1])
    reached = float(variables().surfaces[-2].thickness.detach())
    best, state = min(ends, key=lambda end: (bool(end[0].no_optimum), end[0].errors[-1] + end[0].penalties[-1]))
    variables.load_state_dict(state)
    return best, reached


@torch.no_grad()
def scan(
    camera: Camera[Variables],
    spectrum: Tensor,
    sensors: Sequence[float],
    distances: Tensor,
    *,
    filter_each_field: bool = False,
) -> list[float]:
    """`camera_error` at each sensor distance in mm; the sensor is a variable, and is put back."""
    before, errors = copy.deepcopy(camera.variables.state_dict()), []
    for sensor in sensors:
        _move_sensor(camera, sensor)
        errors.append(float(camera_error(camera, spectrum, distances, filter_each_field=filter_each_field)))
    camera.variables.load_state_dict(before)
    return errors


@torch.no_grad()
def _move_sensor(camera: Camera[Variables], sensor: float) -> None:
    (variable,) = [variable for variable in camera.variables.variables if variable.name == "sensor"]
    camera.variables.get_parameter(variable.name).fill_((sensor - variable.start) / variable.unit)


def out_of_focus(camera: Camera[Variables]) -> str:
    """The reason why every object of the camera's range is out of focus on its sensor; "" if one is in focus."""
    low, high = _in_focus(camera)
    sensor = float(camera.variables().surfaces[-2].thickness.detach())
    if low <= sensor <= high:
        return ""
    near, far = camera.range
    return (
        f"no optimum inside {low:.7g} to {high:.7g} mm of sensor distance, where an object from {near:g} to {far:g} mm "
        f"is in focus to the width of the PSF: the loss still falls at its end, and the sensor went to {sensor:.7g} mm"
    )


def _in_focus(camera: Camera[Variables]) -> tuple[float, float]:
    """Sensor distances in mm at which an object of the range is in focus to the width of the PSF."""
    width = camera.picture_sensor.pitch * camera.size
    return sensor_range(camera.variables(), camera.range, fields=camera.fields, width=width)


# -- object distances in focus


@torch.no_grad()
def distance_in_focus(lens: Lens, image_distance: Callable[[Lens], Tensor]) -> float:
    """Object distance from vertex 1 in mm whose image, by `image_distance`, is on the sensor; inf beyond 1000 km."""

    def defocus(vergence: float) -> float:
        return float(image_distance(with_object_distance(lens, 1 / vergence)) - lens.surfaces[-2].thickness)

    furthest, nearest = 1e-9, 2e-3
    if defocus(furthest) >= 0:
        return math.inf
    if defocus(nearest) < 0:
        raise ValueError(
            f"the sensor, {float(lens.surfaces[-2].thickness):g} mm behind the lens, is in focus nearer than "
            f"{1 / nearest:g} mm; expected a shorter sensor distance"
        )
    return 1 / scipy.optimize.brentq(defocus, furthest, nearest, xtol=1e-14, rtol=1e-12)


class FocusColumns(TypedDict):
    """Sensor distance, mm, and object distances from vertex 1 in focus, m."""

    sensor_mm: float
    focus_paraxial_m: float
    focus_rms_m: float


def focus_columns(lens: Lens) -> FocusColumns:
    """Sensor distance, mm, and object distances from vertex 1 in focus, m: of paraxial rays and of least RMS spot."""
    paraxial = distance_in_focus(lens, lambda lens: paraxial_image_distance(lens, lens.surfaces[0].thickness))
    return {
        "sensor_mm": float(lens.surfaces[-2].thickness),
        "focus_paraxial_m": 1e-3 * paraxial,
        "focus_rms_m": 1e-3 * distance_in_focus(lens, best_focus),
    }


@torch.no_grad()
def sensor_range(lens: Lens, distances: Sequence[float], *, fields: Tensor, width: float) -> tuple[float, float]:
    """Sensor distances (mm) at which an object at some of the distances (mm) is in focus, to a blur `width` mm across.

    From the nearest to the farthest paraxial image or least RMS spot of fields (2, F), extended by the defocus at which
    a uniform disc of light, of √2 times the RMS slope of the rays, is `width` across. Raises `NoImage` for an object
    without real image.
    """
    place = lens.surfaces[-2].thickness
    images = [real_image_distance(lens, lens.wavelengths.new_tensor(distances)).flatten()]
    steepness = [place.new_zeros(1)]
    for distance in distances:
        pupil, weights = gauss_rings(_RINGS)
        rays = image_rays(with_object_distance(lens, distance), pupil, fields=fields)
        covariance, variance = focus_moments(rays, weights)
        lit = variance > 0
        images.append((place - safe_divide(covariance, variance))[lit])
        steepness.append(variance[lit])
    ends = torch.cat(images)
    margin = 0.5 * width / math.sqrt(2 * float(torch.cat(steepness).max()) or math.inf)
    return float(ends.min()) - margin, float(ends.max()) + margin
