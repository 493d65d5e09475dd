"""Peers as tracers: Optiland, also of tilted and toroidal lenses, and ray-optics, on the same lens and rays.

Of Optiland's trace `optic.surfaces.trace(rays, skip=1, record=False)` is timed, the loop over surfaces alone: no
paraxial launch, no ray aiming, no snapshots at every surface, media of constant index. Its own grad mode stays off, so
that only the variables are leaves of the graph. Optiland has no trace without the optical path.

Importing this file imports Optiland. ray-optics is imported when asked for.
"""

import importlib
import importlib.util
import math
import warnings
from collections.abc import Sequence

import numpy as np
import optiland.backend as be
import torch
from optiland.materials import IdealMaterial
from optiland.optic import Optic
from optiland.rays import RealRays
from torch import Tensor

from raytrace.bench.measure import name_of, shape_of, squared_radius, variables
from raytrace.maths.value import to
from raytrace.system.lens import Lens, media
from raytrace.system.phases import Grating
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.geometry import Frame, frames

_RAY_OPTICS_MOST = 1024  # rays: it traces one at a time in Python
# mm, where Optiland's search for a toroid ends: what float32 does not reach it would try in vain a hundred times
_CLOSE = {torch.float32: 1e-4, torch.float64: 1e-10}


class Optiland:
    """One lens in Optiland. backend: "torch" or "numpy" (float64, forward only).

    by_indices: gradients also by the index of every medium.
    """

    with_path = True

    def __init__(self, lens: Lens, dtype: torch.dtype, *, backend: str, by_indices: bool = False):
        self.name = f"Optiland, {backend}"
        self.dtype, self.backend, self.by_indices = dtype, backend, by_indices
        self.has_gradient = backend == "torch"
        self.lens = to(lens, dtype=dtype)
        self.wavelength = float(lens.primary)
        self.indices = media(self.lens, self.lens.primary)
        self._leaves: tuple[list[Tensor], dict[int, Tensor]] | None = None
        self.prepare()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Optiland and of its compiler, once
            self.optic = self._build()
            self._set_conditions()
            axis = torch.zeros(3, 2, dtype=dtype)
            axis[2] = 1.0
            self.forward(Rays(torch.zeros_like(axis), axis, torch.ones(2, dtype=torch.bool)))  # compiles

    def prepare(self) -> None:
        """Optiland's back end, precision and grad mode are global."""
        be.set_backend(self.backend)
        if self.backend == "torch":
            be.set_precision(name_of(self.dtype))
            be.grad_mode.disable()

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        if self._leaves is not None:
            self._without_leaves()
        with torch.no_grad():
            end = self._trace(rays)
        return torch.stack([torch.as_tensor(end.x), torch.as_tensor(end.y)]), torch.as_tensor(end.opd)

    def gradient(self, rays: Rays, centroid: Tensor) -> list[Tensor]:
        """By radius, thickness and index, as Optiland has them, then from radius to curvature: d/dc = -R² d/dR."""
        if self._leaves is None:
            self._leaves = self._with_leaves()
        leaves, thicknesses = self._leaves
        z = torch.zeros((), dtype=self.dtype)
        for number in range(1, len(self.lens.surfaces)):
            self.optic.surfaces[number].geometry.cs.z = z
            z = z + thicknesses.get(number, 0.0)
        end = self._trace(rays)
        found = list(torch.autograd.grad(squared_radius(end.x, end.y, centroid), leaves))
        for place, (_, name) in enumerate(variables(self.lens)):
            if name == "curvature":
                found[place] = -(leaves[place].detach() ** 2) * found[place]
        return found

    def _with_leaves(self) -> tuple[list[Tensor], dict[int, Tensor]]:
        """The variables, each a leaf that stays in its place, and those that are thicknesses by surface."""
        surfaces, leaves, thicknesses = self.optic.surfaces, [], {}
        for number, name in variables(self.lens):
            if name == "curvature":
                leaf = surfaces[number].geometry.radius.detach().clone().requires_grad_()
                surfaces[number].geometry.radius = leaf
            else:
                leaf = self.lens.surfaces[number].thickness.detach().clone().requires_grad_()
                thicknesses[number] = leaf
            leaves.append(leaf)
        leaf = None
        for number, index in enumerate(self.indices if self.by_indices else ()):
            if number == 0 or index is not self.indices[number - 1]:
                leaf = index.detach().reshape(1).clone().requires_grad_()
                leaves.append(leaf)
            surfaces[number].material_post.index = leaf
        return leaves, thicknesses

    def _without_leaves(self) -> None:
        """Leave no graph behind for the forward runs."""
        for number in range(1, len(self.lens.surfaces)):
            surface = self.optic.surfaces[number]
            surface.geometry.radius = torch.as_tensor(surface.geometry.radius).detach()
            surface.geometry.cs.z = surface.geometry.cs.z.detach()
        if self.by_indices:
            for number in range(len(self.indices)):
                material = self.optic.surfaces[number].material_post
                material.index = material.index.detach()
        self._leaves = None

    def _trace(self, rays: Rays) -> RealRays:
        x, y, z = rays.position
        L, M, N = rays.direction
        columns = [x, y, z, L, M, N, torch.ones_like(x), x.new_full((1,), self.wavelength)]
        if self.backend == "numpy":
            columns = [column.numpy() for column in columns]
        return self.optic.surfaces.trace(RealRays(*columns), skip=1, record=False)

    def _build(self) -> Optic:
        optic, last = Optic(), len(self.lens.surfaces) - 1
        for number, surface in enumerate(self.lens.surfaces):
            curvature, conic, coefficients = shape_of(surface, number)
            numbers = {"thickness": float(surface.thickness) if number < last else 0.0}
            if curvature:
                numbers |= {"radius": 1 / curvature, "conic": conic}
            if coefficients:
                numbers["coefficients"] = coefficients
            optic.surfaces.add(
                index=number,
                surface_type="even_asphere" if coefficients else "standard",
                is_stop=number == self.lens.stop,
                material="mirror" if surface.is_mirror else IdealMaterial(float(self.indices[number])),
                **numbers,
            )
        return optic

    def _set_conditions(self) -> None:
        self.optic.set_aperture("EPD", 1.0)
        self.optic.fields.set_type("angle")
        self.optic.fields.add(y=0.0)
        self.optic.wavelengths.add(self.wavelength, is_primary=True)


class PosedOptiland(Optiland):
    """A lens of toroids, gratings and tilts in Optiland: every surface where its frame stands, in one system of axes.

    Its gratings add no path to light, and a plane there has no curvature to differentiate by: that slope is told as 0.
    """

    def __init__(self, lens: Lens, dtype: torch.dtype, *, backend: str):
        self.places = frames(to(lens, dtype=torch.float64))
        self.image = to(self.places[-1], dtype=dtype)
        super().__init__(lens, dtype, backend=backend)
        self.thicknesses = [number for number, name in variables(lens) if name == "thickness"]
        first = torch.stack([lens.surfaces[number].thickness for number in self.thicknesses])
        self.steps = to(torch.func.jacfwd(self._origins)(first), dtype=dtype)  # origins are linear in thicknesses
        self.start = to(self._origins(torch.zeros_like(first)), dtype=dtype)

    def lacks(self, *, gradient: bool) -> str:
        """What Optiland leaves out of the task, in a few words."""
        gratings = any(surface.phase is not None for surface in self.lens.surfaces)
        curved = [number for number, name in variables(self.lens) if name == "curvature"]
        planes = any(float(self.lens.surfaces[number].curvature) == 0 for number in curved)
        missing = ["the grating's path"] * gratings + ["slopes by planes' curvature"] * (planes and gradient)
        return ", ".join(missing)

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        with torch.no_grad():
            end = self._trace(rays)
        return self._on_image(end)[:2], torch.as_tensor(end.opd)

    def gradient(self, rays: Rays, centroid: Tensor) -> list[Tensor]:
        """By radius and thickness, then from radius to curvature: d/dc = -R² d/dR."""
        curvatures = [number for number, name in variables(self.lens) if name == "curvature"]
        radii = [_leaf(1 / self.lens.surfaces[number].curvature) for number in curvatures]
        thicknesses = [_leaf(self.lens.surfaces[number].thickness) for number in self.thicknesses]
        self._set(curvatures, radii, thicknesses)
        x, y, _ = self._on_image(self._trace(rays))
        slopes = torch.autograd.grad(
            squared_radius(x, y, centroid), radii + thicknesses, materialize_grads=True, allow_unused=True
        )
        radii, thicknesses = [radius.detach() for radius in radii], [gap.detach() for gap in thicknesses]
        self._set(curvatures, radii, thicknesses)  # no graph stays behind
        scales = [torch.where(radius.isinf(), 0.0, -(radius**2)) for radius in radii]
        by_curvature = [scale * slope for scale, slope in zip(scales, slopes, strict=False)]
        return by_curvature + list(slopes[len(radii) :])

    def _set(self, curved: Sequence[int], radii: Sequence[Tensor], thicknesses: Sequence[Tensor]) -> None:
        for number, radius in zip(curved, radii, strict=True):
            if float(self.lens.surfaces[number].curvature) == 0:
                continue  # a plane there is of another kind
            self.optic.surfaces[number].geometry.set_radius(radius)
        origins = self.start + self.steps @ torch.stack(thicknesses)
        for surface, (x, y, z) in zip(self.optic.surfaces[1:], origins, strict=True):
            surface.geometry.cs.x, surface.geometry.cs.y, surface.geometry.cs.z = x, y, z

    def _origins(self, thicknesses: Tensor) -> Tensor:
        """Vertices (surface, 3) mm of the surfaces behind the object."""
        lens = to(self.lens, dtype=torch.float64)
        for number, thickness in zip(self.thicknesses, thicknesses, strict=True):
            lens = lens.replace(number, thickness=thickness)
        return torch.stack([frame.origin for frame in frames(lens)[1:]])

    def _on_image(self, end: RealRays) -> Tensor:
        return self.image.inside(torch.stack([torch.as_tensor(x) for x in (end.x, end.y, end.z)]))

    def _build(self) -> Optic:
        optic = Optic()
        for number, (surface, frame) in enumerate(zip(self.lens.surfaces, self.places, strict=True)):
            optic.surfaces.add(
                index=number,
                is_stop=number == self.lens.stop,
                material="mirror" if surface.is_mirror else IdealMaterial(float(self.indices[number])),
                **(_standing(frame) | _shaped(surface, self.dtype) if number else {"z": -1.0}),
            )
        return optic


def _leaf(number: Tensor) -> Tensor:
    return number.detach().clone().requires_grad_()


def _standing(frame: Frame) -> dict[str, float]:
    """Vertex in mm and turns in radians, of x first: axes = Rz Ry Rx."""
    x, y, z = frame.origin.tolist()
    a = frame.axes
    turns = {"rx": torch.atan2(a[2, 1], a[2, 2]), "ry": -torch.asin(a[2, 0]), "rz": torch.atan2(a[1, 0], a[0, 0])}
    return {"x": x, "y": y, "z": z} | {name: float(turn) for name, turn in turns.items()}


def _shaped(surface: Surface, dtype: torch.dtype) -> dict:
    """Shape and phase in Optiland's words. Raises ValueError for what is not handed over."""
    c, k = (0.0 if one is None else float(one) for one in (surface.curvature, surface.conic))
    radius = 1 / c if c else math.inf
    if surface.kind == "toroidal" and surface.phase is None:
        across, *terms = surface.coefficients.tolist()
        radii = {"radius_x": 1 / across if across else math.inf, "radius_y": radius}
        numbers = {"conic": k, "toroidal_coeffs_poly_y": terms, "tol": _CLOSE[dtype]}
        return {"surface_type": "toroidal"} | numbers | radii
    if surface.coefficients is not None or surface.sag_terms is not None:
        raise ValueError("this shape is not handed over")
    if isinstance(surface.phase, Grating):
        period = 1 / float(surface.phase.frequency)  # µm
        numbers = {"grating_order": float(surface.phase.order), "grating_period": period}
        return {"surface_type": "grating", "radius": radius, "conic": k} | numbers
    if surface.phase is not None:
        raise ValueError("this phase is not handed over")
    return {"radius": radius, "conic": k} if c else {}


class RayOptics:
    """ray-optics: one ray at a time, float64, forward. Raises ModuleNotFoundError where it is not installed."""

    name, most = "ray-optics", _RAY_OPTICS_MOST
    dtype, with_path, has_gradient = torch.float64, True, False

    def __init__(self, lens: Lens):
        self.trace = importlib.import_module("rayoptics.raytr.raytrace").trace_raw
        surface = importlib.import_module("rayoptics.elem.surface").Surface
        sphere = importlib.import_module("rayoptics.elem.profiles").Spherical
        self.wavelength = 1e3 * float(lens.primary)
        indices = [float(index) for index in media(lens, lens.primary)]
        unturned = np.eye(3)
        self.path = [[surface(), None, (unturned, np.zeros(3)), indices[0], 1]]
        for number, (one, index) in enumerate(zip(lens.surfaces[1:], indices[1:], strict=True), 1):
            if one.conic is not None or one.coefficients is not None or one.is_mirror:
                raise ValueError("this peer is given spheres and planes only")
            shift = unturned, np.array([0.0, 0.0, float(one.thickness)])
            profile = sphere(c=shape_of(one, number)[0])
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
