"""Peers of the speed benchmark: Optiland with its indices as variables too, and ray-optics.

Importing this file imports Optiland: it needs the extra [bench]. ray-optics is imported when asked for.
"""

import importlib
import importlib.util
from importlib.metadata import version

import numpy as np
import torch
from torch import Tensor

from raytrace.bench.peer import Optiland
from raytrace.bench.tracers import squared_radius
from raytrace.optics.trace import media
from raytrace.system.lens import Lens
from raytrace.system.rays import Rays

_RAY_OPTICS_MOST = 1024  # rays: it traces one at a time in Python


class OptilandByAll(Optiland):
    """Optiland with gradients by every curvature, thickness and index, each a leaf that stays in its place."""

    def __init__(self, lens: Lens, dtype: torch.dtype, *, backend: str):
        super().__init__(lens, dtype, backend=backend)
        self._kept: tuple[list[Tensor], dict[int, Tensor]] | None = None

    def gradient(self, rays: Rays, centroid: Tensor) -> Tensor:
        self._kept = None  # puts leaves of its own in the places of these
        return super().gradient(rays, centroid)

    def gradient_by_all(self, rays: Rays, centroid: Tensor) -> tuple[Tensor, ...]:
        """Derivatives by radii, thicknesses and indices, in the order of `leaves_of` but for radius in place of c."""
        if self._kept is None:
            self._kept = self._leaves()
        leaves, thicknesses = self._kept
        z = torch.zeros((), dtype=self.dtype)
        for number in range(1, len(self.lens.surfaces)):
            self.optic.surfaces[number].geometry.cs.z = z
            z = z + thicknesses.get(number, 0.0)
        end = self._trace(rays)
        return torch.autograd.grad(squared_radius(end.x, end.y, centroid), leaves)

    def _leaves(self) -> tuple[list[Tensor], dict[int, Tensor]]:
        surfaces, leaves, thicknesses = self.optic.surfaces, [], {}
        for number, name in self.variables:
            if name == "curvature":
                leaf = surfaces[number].geometry.radius.detach().clone().requires_grad_()
                surfaces[number].geometry.radius = leaf
            else:
                leaf = self.lens.surfaces[number].thickness.detach().clone().requires_grad_()
                thicknesses[number] = leaf
            leaves.append(leaf)
        indices = media(self.lens, self.lens.wavelengths[self.lens.primary_wavelength])
        leaf = None
        for number, index in enumerate(indices):
            if number == 0 or index is not indices[number - 1]:
                leaf = index.detach().reshape(1).clone().requires_grad_()
                leaves.append(leaf)
            surfaces[number].material_post.index = leaf
        return leaves, thicknesses


class RayOptics:
    """ray-optics: one ray at a time, float64, forward. Raises ModuleNotFoundError where it is not installed."""

    name, most = "ray-optics", _RAY_OPTICS_MOST
    dtype, with_path, has_gradient = torch.float64, True, False

    def __init__(self, lens: Lens):
        self.trace = importlib.import_module("rayoptics.raytr.raytrace").trace_raw
        surface = importlib.import_module("rayoptics.elem.surface").Surface
        sphere = importlib.import_module("rayoptics.elem.profiles").Spherical
        self.wavelength = 1e3 * float(lens.wavelengths[lens.primary_wavelength])
        indices = [float(index) for index in media(lens, lens.wavelengths[lens.primary_wavelength])]
        unturned, gaps = np.eye(3), [0.0, *(float(one.thickness) for one in lens.surfaces[1:])]
        self.path = [[surface(), None, (unturned, np.zeros(3)), indices[0], 1]]
        for one, gap, index in zip(lens.surfaces[1:], gaps[1:], indices[1:], strict=True):
            if one.conic is not None or one.coefficients is not None or one.is_mirror:
                raise ValueError("this peer is given spheres and planes only")
            profile = sphere(c=0.0 if one.curvature is None else float(one.curvature))
            shift = unturned, np.array([0.0, 0.0, gap])
            self.path.append([surface(profile=profile, interact_mode="transmit"), None, shift, index, 1])

    def prepare(self) -> None:
        pass

    def forward(self, rays: Rays) -> tuple[Tensor, None]:
        starts = zip(rays.position.T.numpy(), rays.direction.T.numpy(), strict=True)
        ends = [
            self.trace(iter(self.path), position, direction, self.wavelength, intersect_obj=False)[0][-1][0]
            for position, direction in starts
        ]
        return torch.as_tensor(np.array(ends).T[:2]), None


def peers_of(lens: Lens, dtype: torch.dtype) -> list[OptilandByAll | RayOptics]:
    """Optiland on torch in this dtype and on numpy, always float64; and ray-optics, beside float64 and where it is."""
    found = [OptilandByAll(lens, dtype, backend="torch"), OptilandByAll(lens, torch.float64, backend="numpy")]
    simple = all(one.coefficients is None and one.conic is None for one in lens.surfaces)
    others = dtype == torch.float64 and simple and importlib.util.find_spec("rayoptics") is not None
    return [*found, RayOptics(lens)] if others else found


def versions() -> dict[str, str]:
    """Versions of the peers, for people."""
    names = {"Optiland": "optiland", "numba": "numba", "ray-optics": "rayoptics"}
    return {word: version(name) for word, name in names.items() if importlib.util.find_spec(name) is not None}
