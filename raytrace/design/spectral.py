"""The closed form: how well the best linear filter restores pictures, from optical transfer functions alone.

A camera blurs x by one of the kernels h_z, its sensor adds white noise of variance σ², and a filter g that does not
know z restores it. With the power spectrum S of the pictures and averages ⟨·⟩ over z,

    G = S ⟨H*⟩/(S ⟨|H|²⟩ + σ²),     E|g∗(h_z∗x + n) - x|² = ∫ S |G H_z - 1|² + σ² |G|² df

(Wiener, 1949): deterministic, no network, no draws of noise. A filter that knows z has G_z = S H_z*/(S |H_z|² + σ²).
"""

import math
from collections.abc import Sequence

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

from raytrace.design.camera import Camera
from raytrace.pictures import Pictures, crop


def power_spectrum(pictures: Pictures, size: int, *, crops: int = 4, seed: int = 0) -> Tensor:
    """S (size, size) of patches of pictures, in the order of an FFT: its mean is the mean square of a pixel.

    Patches fade out towards their borders (a Hann window), whose edges would else look like texture.
    """
    fade = torch.hann_window(size, periodic=True, dtype=torch.float64)
    window = fade[:, None] * fade
    window = window / window.square().mean().sqrt()
    total = torch.zeros(size, size, dtype=torch.float64)
    count = crops * len(pictures)
    for sample in range(count):
        patch = torch.as_tensor(crop(pictures, sample, epoch=0, size=size, crops=crops, seed=seed)).to(torch.float64)
        mean = patch.mean()
        spectrum = torch.fft.fft2((patch - mean) * window)
        total += spectrum.real**2 + spectrum.imag**2
        total[0, 0] += (mean * size * size) ** 2
    return total / (count * size * size)


def transfer_functions(kernels: Tensor, size: int) -> Tensor:
    """OTFs (..., size, size), the middle of each kernel (..., h, w) as the origin."""
    h, w = kernels.shape[-2:]
    padded = torch.nn.functional.pad(kernels, (0, size - w, 0, size - h))
    return torch.fft.fft2(torch.roll(padded, (-(h // 2), -(w // 2)), (-2, -1)))


def blind_filter(transfer: Tensor, spectrum: Tensor, sigma: float) -> Tensor:
    """G (size, size) of the filter that does not know which of the transfer functions (Z, size, size) it meets."""
    power = (transfer.real**2 + transfer.imag**2).mean(0)
    return spectrum * transfer.mean(0).conj() / (spectrum * power + sigma**2)


def errors(transfer: Tensor, spectrum: Tensor, sigma: float, *, filter: Tensor | None = None) -> Tensor:
    """Mean square error of a pixel (Z) at every transfer function, by one filter; by default the best blind one."""
    G = blind_filter(transfer, spectrum, sigma) if filter is None else filter
    left = G * transfer - 1
    noise = sigma**2 * (G.real**2 + G.imag**2)
    return (spectrum * (left.real**2 + left.imag**2) + noise).mean((-2, -1))


def errors_knowing(transfer: Tensor, spectrum: Tensor, sigma: float) -> Tensor:
    """Mean square error (Z) where the filter knows every transfer function: the least that any linear one leaves."""
    power = transfer.real**2 + transfer.imag**2
    return (spectrum * sigma**2 / (spectrum * power + sigma**2)).mean((-2, -1))


def camera_error(camera: Camera, spectrum: Tensor, distances: Tensor) -> Tensor:
    """Mean square error of a camera with the best blind linear filter, over object distances (Z,) mm and its fields.

    spectrum: `power_spectrum` of the camera's pictures. Differentiable in the variables of the lens.
    """
    kernels = [camera.kernels(distances, field) for field in range(camera.fields.shape[1])]
    transfer = transfer_functions(torch.cat(kernels), spectrum.shape[-1])
    return errors(transfer, spectrum.to(transfer.real.dtype), camera.noise).mean()


def even_distances(camera: Camera, count: int = 33) -> Tensor:
    """Object distances (count,) mm, evenly over the camera's range: the middle of each of so many parts."""
    near, far = camera.range
    place = (torch.arange(count, dtype=camera.fields.dtype, device=camera.fields.device) + 0.5) / count
    return near + (far - near) * place


def optimise_closed_form(camera: Camera, spectrum: Tensor, *, distances: Tensor | None = None) -> list[float]:
    """Bring the variables of the lens to the least `camera_error`; returns it as it fell, from start to end.

    By L-BFGS-B with exact gradients (scipy), within the bounds of the variables.
    """
    distances = even_distances(camera) if distances is None else distances
    variables = camera.variables
    parameters = list(variables.parameters())
    course: list[float] = []

    def put(values: Sequence[float]) -> None:
        with torch.no_grad():
            for parameter, value in zip(parameters, values, strict=True):
                parameter.fill_(float(value))

    def error_and_gradient(values: np.ndarray) -> tuple[float, np.ndarray]:
        put(values)
        error = camera_error(camera, spectrum, distances) + variables.violation()
        gradient = torch.autograd.grad(error, parameters)
        course.append(float(error.detach()))
        return course[-1], np.array([float(g) for g in gradient])

    start = np.array([float(parameter.detach()) for parameter in parameters])
    bounds = [_parameter_bounds(variables, variable) for variable in variables.variables]
    # Errors are of 1e-3 and variables of millimetres: the default tolerance (2e-9 of 1) would stop too soon.
    best = scipy.optimize.minimize(
        error_and_gradient, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-11, "gtol": 1e-9}
    )
    put(best.x)
    return course


def _parameter_bounds(variables, variable) -> tuple[float, float]:
    low, high = variables.bounds.get(variable.name, (-math.inf, math.inf))
    ends = sorted(((low - variable.start) / variable.unit, (high - variable.start) / variable.unit))
    return ends[0], ends[1]
