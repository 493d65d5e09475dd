"""Optiland as a tracer of tilted and toroidal lenses. Importing this file imports Optiland."""

import math
from collections.abc import Sequence

import torch
from optiland.materials import IdealMaterial
from optiland.optic import Optic
from optiland.rays import RealRays
from scripts import script
from torch import Tensor

from raytrace.bench.measure import squared_radius, variables
from raytrace.maths.numerics import to
from raytrace.system.lens import Lens
from raytrace.system.phases import Grating
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.geometry import Frame, frames

Optiland = script("bench_peers").Optiland

# mm, where Optiland's search for a toroid ends: in float32 it would not reach less in a hundred iterations
_CLOSE = {torch.float32: 1e-4, torch.float64: 1e-10}


class PosedOptiland(Optiland):
    """A lens of toroids, gratings and tilts in Optiland, each surface by its frame in global coordinates.

    Its gratings add no optical path, and its planes have no curvature to differentiate by: that derivative is 0.
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
        """What Optiland leaves out of the task."""
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
        """By radius and thickness; d/dc = -R² d/dR."""
        curvatures = [number for number, name in variables(self.lens) if name == "curvature"]
        radii = [_leaf(1 / self.lens.surfaces[number].curvature) for number in curvatures]
        thicknesses = [_leaf(self.lens.surfaces[number].thickness) for number in self.thicknesses]
        self._set(curvatures, radii, thicknesses)
        x, y, _ = self._on_image(self._trace(rays))
        slopes = torch.autograd.grad(
            squared_radius(x, y, centroid), radii + thicknesses, materialize_grads=True, allow_unused=True
        )
        radii, thicknesses = [radius.detach() for radius in radii], [gap.detach() for gap in thicknesses]
        self._set(curvatures, radii, thicknesses)  # drops the graph
        scales = [torch.where(radius.isinf(), 0.0, -(radius**2)) for radius in radii]
        by_curvature = [scale * slope for scale, slope in zip(scales, slopes, strict=False)]
        return by_curvature + list(slopes[len(radii) :])

    def _set(self, curved: Sequence[int], radii: Sequence[Tensor], thicknesses: Sequence[Tensor]) -> None:
        for number, radius in zip(curved, radii, strict=True):
            if float(self.lens.surfaces[number].curvature) == 0:
                continue  # a plane is another kind of surface there
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
                **(_vertex(frame) | _shaped(surface, self.dtype) if number else {"z": -1.0}),
            )
        return optic


def _leaf(number: Tensor) -> Tensor:
    return number.detach().clone().requires_grad_()


def _vertex(frame: Frame) -> dict[str, float]:
    """Vertex in mm and turns in radians, of x first: axes = Rz Ry Rx."""
    x, y, z = frame.origin.tolist()
    a = frame.axes
    turns = {"rx": torch.atan2(a[2, 1], a[2, 2]), "ry": -torch.asin(a[2, 0]), "rz": torch.atan2(a[1, 0], a[0, 0])}
    return {"x": x, "y": y, "z": z} | {name: float(turn) for name, turn in turns.items()}


def _shaped(surface: Surface, dtype: torch.dtype) -> dict:
    """Shape and phase in Optiland's terms. Raises ValueError for others."""
    c, k = (0.0 if one is None else float(one) for one in (surface.curvature, surface.conic))
    radius = 1 / c if c else math.inf
    if surface.kind == "toroidal" and surface.phase is None:
        across, *terms = surface.coefficients.tolist()
        radii = {"radius_x": 1 / across if across else math.inf, "radius_y": radius}
        numbers = {"conic": k, "toroidal_coeffs_poly_y": terms, "tol": _CLOSE[dtype]}
        return {"surface_type": "toroidal"} | numbers | radii
    if surface.coefficients is not None or surface.sag_terms is not None:
        raise ValueError("expected a conic or a toroid")
    if isinstance(surface.phase, Grating):
        period = 1 / float(surface.phase.frequency)  # µm
        numbers = {"grating_order": float(surface.phase.order), "grating_period": period}
        return {"surface_type": "grating", "radius": radius, "conic": k} | numbers
    if surface.phase is not None:
        raise ValueError("expected a grating")
    return {"radius": radius, "conic": k} if c else {}
