"""A camera's error in closed form, by the best linear filter of `deconvolve`: deterministic, no network, no noise."""

import math

import torch
from torch import Tensor

from raytrace.deconvolve import kernel_error
from raytrace.deconvolve import power_spectrum as periodogram
from raytrace.design.camera import Camera
from raytrace.design.descent import minimise
from raytrace.pictures import Pictures, crop

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


def optimise_closed_form(camera: Camera, spectrum: Tensor, *, distances: Tensor | None = None) -> list[float]:
    """Bring the variables of the lens to the least `camera_error`; returns it as it fell, from start to end.

    By L-BFGS-B with exact gradients (scipy), within the bounds of the variables: the first optimum downhill.
    """
    distances = even_distances(camera) if distances is None else distances
    variables = camera.variables

    def error() -> Tensor:
        return camera_error(camera, spectrum, distances) + variables.violation()

    # Errors are of 1e-3 and variables of millimetres: the default tolerance (2e-9 of 1) would stop too soon.
    return minimise(
        list(variables.parameters()),
        error,
        unit=_FIRST_STEP,
        bounds=[_parameter_bounds(variables, variable) for variable in variables.variables],
        tolerance=1e-11,
    )


def _parameter_bounds(variables, variable) -> tuple[float, float]:
    low, high = variables.bounds.get(variable.name, (-math.inf, math.inf))
    return tuple(sorted(((low - variable.start) / variable.unit, (high - variable.start) / variable.unit)))
