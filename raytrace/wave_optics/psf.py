"""PSFs of a wave scene: depth × wavelength, integrated over the pixels of the sensor, by the engine that fits."""

import dataclasses
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.files import write_atomically
from raytrace.maths.grid import Grid, centres
from raytrace.maths.result import Result, number, object_text, rows
from raytrace.maths.value import value
from raytrace.tracing.scene import Memo
from raytrace.wave_optics import plan as planning
from raytrace.wave_optics.element import Element, EvenPowers, height_range
from raytrace.wave_optics.plan import Plan
from raytrace.wave_optics.scene import WaveScene, aperture

_KEPT = 8  # sums that a memo keeps


@value
class ElementPsf(Result):
    """PSFs of an element for points on the axis, over depth and colour.

    kernel: (D, W, rows, columns), light in each pixel, 1 = all through the aperture; scene: the camera; plan: how it
    was computed, with the predicted error, relative L2 of the worst kernel; element: its name.
    axial: (D, W), light in one pixel centred on the axis, where the window has a corner or an edge of pixels there;
    None where it was not computed, or is a pixel of the window.
    """

    FIGURE: ClassVar[str] = "plotting.wave.element_figure"

    kernel: Tensor
    scene: WaveScene
    plan: Plan
    element: str = ""
    axial: Tensor | None = None

    @property
    def depths(self) -> Tensor:
        return self.scene.depths

    @property
    def wavelengths(self) -> Tensor:
        return self.scene.wavelengths

    @property
    def grid(self) -> Grid:
        return self.scene.grid

    @property
    def pitch(self) -> Tensor:
        return self.grid.pitch

    @property
    def engine(self) -> str:
        return self.plan.engine

    @property
    def error(self) -> float:
        return self.plan.error

    @property
    def energy(self) -> Tensor:
        """(D, W): light inside the window."""
        return self.kernel.sum((-2, -1))

    @property
    def peak(self) -> Tensor:
        """(D, W): the most light in one pixel, of those of the window and one centred on the axis.

        Light that is brightest on the axis has the same peak in windows of an even and of an odd number of pixels.
        """
        brightest = self.kernel.amax((-2, -1))
        return brightest if self.axial is None else torch.maximum(brightest, self.axial)

    @property
    def half_energy_radius(self) -> Tensor:
        """(D, W) mm about the axis that holds half of all light through the aperture; inf where the window does not.

        Pixels count by the distance of their centres: good to half a pixel.
        """
        x, y = centres(self.grid)
        distance, order = torch.sqrt(x * x + (y * y)[:, None]).flatten().sort()
        inside = (self.kernel.flatten(-2)[..., order].cumsum(-1) < 0.5).sum(-1)
        return torch.where(inside < len(distance), distance[inside.clamp(max=len(distance) - 1)], math.inf)

    def columns(self) -> dict[str, Tensor]:
        return {
            "depth": self.depths[:, None],
            "wavelength": self.wavelengths,
            "energy": self.energy,
            "peak": self.peak,
            "half_energy_radius": self.half_energy_radius,
        }

    def document(self) -> dict:
        return {
            "element": self.element,
            "height_range": [[*height_range(element)] for element in self.scene.elements],
            "engine": self.plan.engine,
            "samples": self.plan.samples,
            "error": number(self.plan.error),
            "pixel_pitch": number(self.pitch),
            "size": self.grid.rows,
            "exact": self.scene.exact,
            "results": rows(self.columns()),
        }

    @property
    def title(self) -> str:
        across, z = 2 * float(aperture(self.scene)), float(self.scene.sensor_distance)
        return f"{Path(self.element).name}, ⌀ {across:g} mm, sensor at {z:g} mm"

    def __str__(self) -> str:
        return "\n".join(
            [
                self.title,
                *map(_heights, self.scene.elements),
                f"{self.plan.engine} engine, {self.plan.samples} samples, predicted error {self.plan.error:.1e}; "
                f"{self.grid.columns} × {self.grid.rows} pixels of {1e3 * float(self.pitch):g} µm",
                f"{'object':>12} {'wavelength':>11} {'energy':>8} {'peak':>10} {'half-energy':>12}",
                f"{'':>12} {'µm':>11} {'window':>8} {'pixel':>10} {'radius, µm':>12}",
                *(_row(**{name: number(cell) for name, cell in row.items()}) for row in rows(self.columns())),
            ]
        )

    def save(self, path: str | os.PathLike) -> None:
        """Write the arrays, psf[depth, wavelength, y, x] and what belongs to it, as .npz."""
        if Path(path).suffix.lower() != ".npz":
            raise ValueError(f"{path}: expected a name that ends in .npz")
        arrays = {
            "psf": self.kernel.detach().numpy(),
            "pixel_pitch": float(self.pitch),
            "centre": self.grid.centre.detach().numpy(),
            "energy": self.energy.detach().numpy(),
            "depths": self.depths.detach().numpy(),
            "wavelengths": self.wavelengths.detach().numpy(),
            "engine": self.plan.engine,
            "samples": self.plan.samples,
            "error": self.plan.error,
            "element": self.element,
        }
        write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def _heights(element: Element) -> str:
    low, high = height_range(element)
    return f"{element.kind.words} of {element.glass.name or 'constant index'}, heights over {1e3 * (high - low):.4g} µm"


def _row(depth: float | None, wavelength: float, energy: float, peak: float, half_energy_radius: float | None) -> str:
    half = "–" if half_energy_radius is None else f"{1e3 * half_energy_radius:.2f}"
    place = object_text(math.inf if depth is None else depth)
    return f"{place:>12} {wavelength:>11g} {energy:>8.4f} {peak:>10.6f} {half:>12}"


def psf(
    scene: WaveScene,
    *,
    engine: str = "auto",
    samples: int | None = None,
    nodes: int | None = None,
    tol: float = 1e-3,
    pad: float = 2.0,
    band_limit: bool = True,
    plan: Plan | None = None,
    memo: Memo | None = None,
) -> ElementPsf:
    """PSFs of a scene, differentiable in every number of it.

    engine, samples, nodes, tol, pad, band_limit: as `plan.plan` takes them. plan: of an earlier call, instead of them:
    for loops, nothing is estimated. memo: sums that do not depend on the heights, which are not made again while the
    rest of the scene stays as it is.
    Raises what `plan.plan` raises.
    """
    if plan is None:
        plan = planning.plan(
            scene, engine=engine, samples=samples, nodes=nodes, tol=tol, pad=pad, band_limit=band_limit
        )
    return ElementPsf(_kernels(scene, plan, memo), scene, plan)


def _kernels(scene: WaveScene, plan: Plan, memo: Memo | None) -> Tensor:
    engine = planning.ENGINES[plan.engine]
    if engine.prepare is None:
        return engine.kernels(scene, None, plan)
    sums = engine.prepare(scene, plan) if memo is None else _remembered(memo, scene, plan, engine.prepare)
    return engine.kernels(scene, sums, plan)


def _remembered(memo: Memo, scene: WaveScene, plan: Plan, make: Callable[[WaveScene, Plan], Any]) -> Any:
    """`make(scene, plan)` without graph, from memory where nothing but heights and coefficients has changed."""
    numbers, structure = _constants(scene)
    if torch._C._are_functorch_transforms_active() or any(n.requires_grad for n in numbers):
        memo.made += 1
        return make(scene, plan)
    with torch.no_grad():
        return memo.find(numbers, (structure, plan), lambda: make(scene, plan), most=_KEPT)


def _constants(scene: WaveScene) -> tuple[list[Tensor], Any]:
    """All numbers of a scene that sums depend on, and its structure."""
    leaves, structure = pytree.tree_flatten(dataclasses.replace(scene, elements=()))
    for element in scene.elements:
        profile = element.profile
        free = element.numbers
        # Of free heights only how many there are counts; where a wrapped smooth one jumps moves with its coefficients.
        jumps = isinstance(profile, EvenPowers) and element.period is not None
        held = [free.detach()] if jumps else []
        parts = [element.radius, getattr(profile, "pitch", None), element.period]
        leaves += [t for t in (*parts, *held) if t is not None]
        own = (type(profile), free.shape, free.dtype, free.device, element.levels, element.period is None)
        structure = (structure, *own)
    return leaves, structure
