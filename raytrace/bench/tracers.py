"""The tracer under test, as the benchmark calls it; a peer offers the same methods (see `peer`)."""

import dataclasses
from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from raytrace.maths.value import to
from raytrace.optics.trace import axial_path, media, trace_lens
from raytrace.system.lens import Lens
from raytrace.system.rays import Rays


class Tracer(Protocol):
    """A tracer with a lens: name, dtype and whether it computes the optical path are part of it.

    prepare: called before every timed call, untimed.
    forward: (positions (2, P) on the image, path (P,) or None) without gradient.
    gradient: derivatives of the mean squared distance from `centroid` (2,) by the variables, (V,).
    """

    name: str
    dtype: torch.dtype
    with_path: bool
    has_gradient: bool

    def prepare(self) -> None: ...

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]: ...

    def gradient(self, rays: Rays, centroid: Tensor) -> Tensor: ...


class Own:
    """This package's eager trace."""

    name = "raytrace"
    has_gradient = True

    def __init__(self, lens: Lens, dtype: torch.dtype, *, with_path: bool):
        self.dtype, self.with_path = dtype, with_path
        self.lens = to(lens, dtype=dtype)
        self.wavelength = lens.wavelengths[lens.primary_wavelength]

    def prepare(self) -> None:
        pass

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        with torch.no_grad():
            end = trace_lens(self.lens, self._with_path(rays), self.wavelength)
        return end.position[:2], end.opl

    def gradient(self, rays: Rays, centroid: Tensor) -> Tensor:
        lens, leaves = with_leaves(self.lens)
        end = trace_lens(lens, self._with_path(rays), self.wavelength)
        return torch.stack(torch.autograd.grad(squared_radius(*end.position[:2], centroid), leaves))

    def full_path(self, reduced: Tensor) -> Tensor:
        """The whole optical path of rays whose reduced path is given."""
        return reduced + axial_path(self.lens.surfaces[1:], media(self.lens, self.wavelength))

    def _with_path(self, rays: Rays) -> Rays:
        path = torch.zeros_like(rays.direction[0]) if self.with_path else None
        return dataclasses.replace(rays, opl=path)


def squared_radius(x: Tensor, y: Tensor, centroid: Tensor) -> Tensor:
    """Mean squared distance from a fixed point.

    About the rays' own centroid its gradient is that of the mean squared spot radius, for the centroid moves by the
    mean of what the rays move by, and the distances from it sum to zero.
    """
    return ((x - centroid[0]) ** 2 + (y - centroid[1]) ** 2).mean()


def variables(lens: Lens) -> list[tuple[int, str]]:
    """What gradients are taken by: every modelled curvature and every thickness, as (surface number, name)."""
    last = len(lens.surfaces) - 1
    curved = [(i, "curvature") for i in range(1, last + 1) if lens.surfaces[i].curvature is not None]
    return curved + [(i, "thickness") for i in range(1, last)]


def with_leaves(lens: Lens) -> tuple[Lens, list[Tensor]]:
    """The lens with a leaf of its own for each of `variables`, and the leaves."""
    surfaces, leaves = list(lens.surfaces), []
    for number, name in variables(lens):
        leaf = getattr(surfaces[number], name).detach().clone().requires_grad_()
        surfaces[number] = dataclasses.replace(surfaces[number], **{name: leaf})
        leaves.append(leaf)
    return dataclasses.replace(lens, surfaces=tuple(surfaces)), leaves


def in_pieces(rays: Rays, size: int, function: Callable[[Rays], Tensor]) -> list[tuple[Tensor, int]]:
    """Call the function on pieces of at most `size` rays; returns its results with the number of rays of each."""
    count = rays.direction.shape[1]
    results = []
    for first in range(0, count, size):
        piece = Rays(*(x[..., first : first + size] for x in (rays.position, rays.direction, rays.valid)))
        results.append((function(piece), piece.direction.shape[1]))
    return results
