"""Caustic: the light along a line across the axis, plane by plane behind the element."""

import dataclasses

import torch
from torch import Tensor

from raytrace.maths.grid import grid
from raytrace.wave.psf import psf
from raytrace.wave.scene import WaveScene


@torch.no_grad()
def caustic(scene: WaveScene, distances: Tensor, *, half: float, columns: int = 201, tol: float = 1e-2) -> Tensor:
    """Light per mm² (D, W, Z, columns), 1 = all through the aperture, on y = 0 from -half to half mm.

    distances: (Z,) mm from element to plane; the scene's own pixels and sensor do not count. Light is the mean over
    squares 2·half/columns wide.
    """
    line = grid(torch.as_tensor(2 * half / columns).to(scene.sensor_distance), (1, columns))
    planes = []
    for distance in distances.to(scene.sensor_distance):
        found = psf(dataclasses.replace(scene, sensor_distance=distance, grid=line), tol=tol)
        planes.append(found.kernel[..., 0, :] / line.pitch**2)
    return torch.stack(planes, -2)
