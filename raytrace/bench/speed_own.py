"""This package's trace as the speed benchmark calls it, by the engine it chooses or by one asked for."""

import dataclasses

import torch
from torch import Tensor

from raytrace.bench.tracers import Own, Tracer, squared_radius, with_leaves
from raytrace.fused import prepare, tracing
from raytrace.media.glass import constant
from raytrace.optics.trace import media, trace_surfaces
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface


class Engine(Own):
    """The trace by one engine: "auto" (the program's choice, where it need not wait for the compiler) or "eager"."""

    def __init__(self, lens: Lens, dtype: torch.dtype, engine: str = "auto"):
        super().__init__(lens, dtype, with_path=False)
        if engine == "auto":
            prepare()
        self.lens_as_read, self.engine = lens, engine
        self.name = "raytrace" if engine == "auto" else f"raytrace, {engine}"
        self._surfaces, self._indices, self.leaves = leaves_of(self.lens)

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        with tracing(self.engine):
            return super().forward(rays)

    def gradient(self, rays: Rays, centroid: Tensor) -> Tensor:
        with tracing(self.engine):
            return super().gradient(rays, centroid)

    def gradient_by_all(self, rays: Rays, centroid: Tensor) -> tuple[Tensor, ...]:
        """Derivatives of the mean squared distance from `centroid` (2,) by curvatures, thicknesses and indices."""
        with tracing(self.engine):
            end = trace_surfaces(self._surfaces, rays, indices=self._indices)
            return torch.autograd.grad(squared_radius(end.position[0], end.position[1], centroid), self.leaves)


class Repeated:
    """A tracer whose sample of rays stands many times in a batch, so that it takes the way of large batches."""

    def __init__(self, tracer: Tracer, copies: int, *, has_gradient: bool):
        self.tracer, self.copies, self.has_gradient = tracer, copies, has_gradient
        self.dtype, self.with_path = tracer.dtype, tracer.with_path

    def prepare(self) -> None:
        self.tracer.prepare()

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        points, path = self.tracer.forward(self._many(rays))
        return points[:, : rays.direction.shape[1]], None if path is None else path[: rays.direction.shape[1]]

    def gradient(self, rays: Rays, centroid: Tensor) -> Tensor:
        return self.tracer.gradient(self._many(rays), centroid)

    def _many(self, rays: Rays) -> Rays:
        many = (x.repeat(*(1,) * (x.dim() - 1), self.copies) for x in (rays.position, rays.direction, rays.valid))
        return Rays(*many)


def leaves_of(lens: Lens) -> tuple[tuple[Surface, ...], list[Tensor], list[Tensor]]:
    """Surfaces after the object and indices of all media, every number a leaf; and the leaves.

    Neighbouring gaps of one medium share a leaf: the surface between them bends nothing.
    """
    moving, leaves = with_leaves(lens)
    indices: list[Tensor] = []
    fixed = media(lens, lens.wavelengths[lens.primary_wavelength])
    for number, index in enumerate(fixed):
        same = number > 0 and index is fixed[number - 1]
        indices.append(indices[-1] if same else index.detach().clone().requires_grad_())
        leaves = leaves if same else [*leaves, indices[-1]]
    return moving.surfaces[1:], indices, leaves


def three_aspheres() -> Lens:
    """Three strong even aspheres (r⁴ to r¹⁰), 14 mm at F/1.8, 10 degrees off the axis.

    At the rim of the beam their terms move the sag by 0.8, 0.9 and 0.3 mm, and bend it by 37, 39 and 18 degrees.
    """

    def number(x: float) -> Tensor:
        return torch.tensor(x, dtype=torch.float64)

    def asphere(curvature: float, conic: float, terms: tuple[float, ...], thickness: float, index: float) -> Surface:
        return Surface(
            thickness=number(thickness),
            curvature=number(curvature),
            conic=number(conic),
            coefficients=torch.tensor((0.0, *terms), dtype=torch.float64),
            glass=constant(index),
            semi_diameter=5.0,
        )

    surfaces = (
        Surface(thickness=number(float("inf"))),
        asphere(0.09, -0.8, (3.2e-3, -8e-5, 2.4e-6, -1.6e-8), 4.0, 1.53),
        asphere(-0.02, 0.5, (-4.8e-3, 1.2e-4, -3.2e-6, 2.4e-8), 3.0, 1.64),
        asphere(-0.05, -1.5, (3.6e-3, -1.2e-4, 2.8e-6, -2e-8), 14.0, 1.0),
        Surface(thickness=number(0.0)),
    )
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    fields = Fields("angle", zero, 10.0 * one, one)
    aperture = SystemAperture("entrance_pupil_diameter", number(8.0))
    return Lens(surfaces, 1, aperture, fields, 0.55 * one, one, name="three strong even aspheres")


def with_sensor_leaf(lens: Lens) -> tuple[Lens, Tensor]:
    """The lens with its sensor distance a leaf, and the leaf."""
    surfaces = list(lens.surfaces)
    leaf = surfaces[-2].thickness.detach().clone().requires_grad_()
    surfaces[-2] = dataclasses.replace(surfaces[-2], thickness=leaf)
    return dataclasses.replace(lens, surfaces=tuple(surfaces)), leaf
