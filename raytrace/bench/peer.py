"""Optiland as the benchmark calls it: torch and numpy back ends, on the same lens and the same rays.

What is timed is `optic.surfaces.trace(rays, skip=1, record=False)`, the loop over surfaces alone: no paraxial launch,
no ray aiming, no snapshots at every surface, media of constant index. Its own grad mode stays off, so that only the
variables are leaves of the graph. Optiland has no trace without the optical path.

Importing this file imports Optiland: it needs the extra [bench].
"""

import warnings
from importlib.metadata import version

import numba
import optiland.backend as be
import torch
from optiland.materials import IdealMaterial
from optiland.optic import Optic
from optiland.rays import RealRays
from torch import Tensor

from raytrace.bench.tracers import squared_radius, variables
from raytrace.maths.value import to
from raytrace.optics.trace import media
from raytrace.system.lens import Lens
from raytrace.system.rays import Rays
from raytrace.system.surface import is_even

VERSION = version("optiland")
NUMBA_VERSION = version("numba")


class Optiland:
    """One lens in Optiland. backend: "torch" or "numpy" (float64, forward only)."""

    with_path = True

    def __init__(self, lens: Lens, dtype: torch.dtype, *, backend: str):
        self.name = f"Optiland, {backend}"
        self.dtype, self.backend = dtype, backend
        self.has_gradient = backend == "torch"
        self.lens = to(lens, dtype=dtype)
        self.wavelength = float(lens.wavelengths[lens.primary_wavelength])
        self.variables = variables(lens)
        self.prepare()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Optiland and of its compiler, once
            self.optic = self._build()
            axis = torch.zeros(3, 2, dtype=dtype)
            axis[2] = 1.0
            self.forward(Rays(torch.zeros_like(axis), axis, torch.ones(2, dtype=torch.bool)))  # compiles

    def prepare(self) -> None:
        """Optiland's back end, precision and grad mode are global."""
        be.set_backend(self.backend)
        if self.backend == "torch":
            be.set_precision("float32" if self.dtype == torch.float32 else "float64")
            be.grad_mode.disable()

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        with torch.no_grad():
            end = self._trace(rays)
        return torch.stack([torch.as_tensor(end.x), torch.as_tensor(end.y)]), torch.as_tensor(end.opd)

    def gradient(self, rays: Rays, centroid: Tensor) -> Tensor:
        """By radius and thickness, as Optiland has them, then brought from radius to curvature: d/dc = -R² d/dR."""
        surfaces, leaves, radii = self.optic.surfaces, [], []
        z = torch.zeros((), dtype=self.dtype)
        thicknesses = {}
        for number, name in self.variables:
            if name == "curvature":
                radius = surfaces[number].geometry.radius.detach().clone().requires_grad_()
                surfaces[number].geometry.radius = radius
                radii.append(radius)
                leaves.append(radius)
            else:
                thicknesses[number] = self.lens.surfaces[number].thickness.detach().clone().requires_grad_()
                leaves.append(thicknesses[number])
        for number in range(1, len(self.lens.surfaces)):
            surfaces[number].geometry.cs.z = z
            z = z + thicknesses.get(number, 0.0)
        end = self._trace(rays)
        found = torch.autograd.grad(squared_radius(end.x, end.y, centroid), leaves)
        for number, name in self.variables:  # leave no graph behind for the forward runs
            if name == "curvature":
                surfaces[number].geometry.radius = surfaces[number].geometry.radius.detach()
        for number in range(1, len(self.lens.surfaces)):
            surfaces[number].geometry.cs.z = surfaces[number].geometry.cs.z.detach()
        by_curvature = [-(radius.detach() ** 2) * d for radius, d in zip(radii, found, strict=False)]
        return torch.stack([*by_curvature, *found[len(radii) :]])

    def _trace(self, rays: Rays) -> RealRays:
        x, y, z = rays.position
        L, M, N = rays.direction
        columns = [x, y, z, L, M, N, torch.ones_like(x), x.new_full((1,), self.wavelength)]
        if self.backend == "numpy":
            columns = [column.numpy() for column in columns]
        return self.optic.surfaces.trace(RealRays(*columns), skip=1, record=False)

    def _build(self) -> Optic:
        optic, last = Optic(), len(self.lens.surfaces) - 1
        wavelength = self.lens.wavelengths.new_tensor(self.wavelength)
        indices = [float(index) for index in media(self.lens, wavelength)]
        for number, surface in enumerate(self.lens.surfaces):
            numbers = {"thickness": float(surface.thickness) if number < last else 0.0}
            if surface.curvature is not None and float(surface.curvature) != 0:
                numbers["radius"] = 1 / float(surface.curvature)
                numbers["conic"] = 0.0 if surface.conic is None else float(surface.conic)
            if not is_even(surface):
                raise ValueError(f"surface {number} departs from a conic and even terms; this peer is not given it")
            kind = "standard"
            if surface.coefficients is not None:
                kind, numbers["coefficients"] = "even_asphere", surface.coefficients.tolist()
            optic.surfaces.add(
                index=number,
                surface_type=kind,
                is_stop=number == self.lens.stop,
                material="mirror" if surface.is_mirror else IdealMaterial(indices[number]),
                **numbers,
            )
        optic.set_aperture("EPD", 1.0)
        optic.fields.set_type("angle")
        optic.fields.add(y=0.0)
        optic.wavelengths.add(self.wavelength, is_primary=True)
        return optic


def set_threads(threads: int) -> None:
    """Threads of Optiland's compiled loops. They may set those of torch too, so `measure` sets those at every call."""
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


def peers(lens: Lens, *, with_numpy: bool = True) -> list[Optiland]:
    """Optiland in float32 and float64 on torch, and on numpy."""
    found = [Optiland(lens, dtype, backend="torch") for dtype in (torch.float32, torch.float64)]
    return [*found, Optiland(lens, torch.float64, backend="numpy")] if with_numpy else found
