"""A camera's error in closed form, by the best linear filter of `deconvolve`: deterministic, no network, no noise."""

import dataclasses
import math

import torch
from torch import Tensor

from raytrace.camera.camera import Camera
from raytrace.camera.deconvolve import kernel_error
from raytrace.camera.deconvolve import power_spectrum as periodogram
from raytrace.studies.codesign.conjugates import sensor_range
from raytrace.studies.descent import Descent, minimise
from raytrace.studies.pictures import Pictures, crop

#: Length of the first step, mm of thickness or of sag. L-BFGS-B takes 1 of its own units, and a sensor moved by 1 mm
#: lands behind the next optimum: where windows hold but the middle of a blur.
_FIRST_STEP = 0.02


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


def even_distances(camera: Camera, count: int = 33) -> Tensor:
    """Object distances (count,) mm, evenly over the camera's range: the middle of each of so many parts."""
    near, far = camera.range
    place = (torch.arange(count, dtype=camera.fields.dtype, device=camera.fields.device) + 0.5) / count
    return near + (far - near) * place


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

    # Errors are of 1e-3 and variables of millimetres: the default tolerance (2e-9 of 1) would stop too soon.
    found = minimise(
        list(variables.parameters()),
        whole,
        unit=_FIRST_STEP,
        bounds=[_parameter_bounds(variables, variable) for variable in variables.variables],
        tolerance=1e-11,
    )
    names = tuple(one.name for one, at_end in zip(variables.variables, found.at_end, strict=True) if at_end)
    errors, penalties = zip(*parts, strict=True)
    return Course(errors, penalties, names, _no_optimum(camera, found, names))


def _no_optimum(camera: Camera, found: Descent, at_end: tuple[str, ...]) -> str:
    """Why a descent ended at no optimum; "" where it is one, if only within some of the bounds."""
    variables = camera.variables
    if found.is_flat:
        return "no optimum: where the search began, the loss does not change with the variables"
    if at_end and ("sensor" in at_end or len(at_end) == len(variables.variables)):
        ranges = (f"{name} from {low:g} to {high:g}" for name in at_end for low, high in [variables.bounds[name]])
        return f"no optimum inside {', '.join(ranges)}: the loss still falls at its end"
    return out_of_focus(camera)


def out_of_focus(camera: Camera) -> str:
    """Why the sensor of a camera is out of focus for all objects of its range; "" where it is not."""
    lens = camera.variables()
    width = float(camera.pixels.pitch.detach()) * camera.pixels.rows
    low, high = sensor_range(lens, camera.range, fields=camera.fields, width=width)
    sensor = float(lens.surfaces[-2].thickness.detach())
    if low <= sensor <= high:
        return ""
    near, far = camera.range
    return (
        f"no optimum inside {low:.7g} to {high:.7g} mm of sensor distance, where an object from {near:g} to {far:g} mm "
        f"is in focus to the width of the PSF: the loss still falls at its end, and the sensor went to {sensor:.7g} mm"
    )


def _parameter_bounds(variables, variable) -> tuple[float, float]:
    low, high = variables.bounds.get(variable.name, (-math.inf, math.inf))
    return tuple(sorted(((low - variable.start) / variable.unit, (high - variable.start) / variable.unit)))
