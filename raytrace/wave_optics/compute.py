"""The wave camera as one call: an element, a sensor behind it, and its PSFs over depth and colour."""

import dataclasses
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.budget import afford, allowed_bytes, forewarn
from raytrace.materials.glass import Glass, check_unit, check_wavelengths, from_table
from raytrace.maths.grid import grid
from raytrace.wave_optics.designs import BASELINES, STEPPED, aim, baseline
from raytrace.wave_optics.element import Element
from raytrace.wave_optics.element_files import ELEMENT_FORMATS, SMOOTH, read_element
from raytrace.wave_optics.exchange import FORMATS
from raytrace.wave_optics.plan import Plan, plan
from raytrace.wave_optics.psf import ElementPsf, psf
from raytrace.wave_optics.scene import WaveScene, aperture
from raytrace.words import did_you_mean

COLOURS = (0.46, 0.55, 0.64)
_DESIGN = 0.55  # µm
_PIECE = 1e9  # bytes: what would take more is computed kernel by kernel
_RATE = 1.5e9  # operations of a plan in a second of one core, to a factor of three
_PLANES, _RANGE, _ACROSS = 121, (0.8, 1.2), 0.05  # of a caustic: over the sensor distance, and of the aperture

#: Shows how far a loop has come: (what is gone through, its unit) -> the same.
Progress = Callable[[Sequence, str], Iterable]


def _silent(items: Sequence, unit: str) -> Sequence:
    return items


def wave_psf(
    element: str | os.PathLike | Element | Sequence[Element] = "singlet",
    *,
    aperture: float = 5.0,
    sensor: float = 35.5,
    focus: float = 1000.0,
    design_wavelength: float | None = None,
    levels: int | None = None,
    exact: bool = False,
    glass: str | Glass | None = None,
    index: Sequence[float] | None = None,
    pitch: float | None = None,
    span: Sequence[float] | None = None,
    catalog: Sequence[str | os.PathLike] = (),
    depths: Sequence[float] = (500.0, 1000.0, math.inf),
    wavelengths: Sequence[float] = COLOURS,
    pixel: float = 0.00369,
    size: int = 128,
    engine: str = "auto",
    samples: int | None = None,
    tol: float = 1e-3,
    progress: Progress = _silent,
) -> ElementPsf:
    """PSFs of a phase element, integrated over pixels, for points on the axis over depth and wavelength.

    element, and all up to catalog: as for `elements`; or one that was made already, in whose numbers the kernels are
    differentiable. depths: mm, inf allowed; wavelengths: µm; pixel: mm; size: pixels across a window around the axis.
    engine, samples, tol: as for `wave_optics.plan.plan`, which chooses the sampling and predicts its error.
    What would take too much memory at once is computed kernel by kernel.
    Raises ValueError for what makes no sense together, budget.OverBudget where one kernel alone would take too much.
    """
    made = _made(element)
    parts = made or elements(
        element,
        aperture=aperture,
        sensor=sensor,
        focus=focus,
        design_wavelength=design_wavelength,
        levels=levels,
        exact=exact,
        glass=glass,
        index=index,
        wavelengths=wavelengths,
        pitch=pitch,
        span=span,
        catalog=catalog,
    )
    _check_colours(parts, wavelengths)
    scene = WaveScene(
        elements=parts,
        sensor_distance=_double(sensor),
        depths=_double(depths),
        wavelengths=_double(wavelengths),
        grid=grid(_double(pixel), size),
        exact=exact,
    )
    chosen = plan(scene, engine=engine, samples=samples, tol=tol)
    name = str(element) if not made else " + ".join(part.kind.words for part in parts)
    kernel, axial = _kernels(scene, chosen, progress), None
    if size % 2 == 0:  # a corner of four pixels lies on the axis
        axial = _kernels(dataclasses.replace(scene, grid=grid(_double(pixel), 1)), chosen, _silent)[..., 0, 0]
    return ElementPsf(kernel, scene, chosen, name, axial)


def elements(
    element: str | os.PathLike = "singlet",
    *,
    aperture: float = 5.0,
    sensor: float = 35.5,
    focus: float = 1000.0,
    design_wavelength: float | None = None,
    levels: int | None = None,
    exact: bool = False,
    glass: str | Glass | None = None,
    index: Sequence[float] | None = None,
    wavelengths: Sequence[float] = COLOURS,
    pitch: float | None = None,
    span: Sequence[float] | None = None,
    catalog: Sequence[str | os.PathLike] = (),
) -> tuple[Element, ...]:
    """The elements in contact that have a name, one of `wave_optics.designs.BASELINES`, or that of a file of heights.

    aperture: diameter, mm. Of a named one sensor, focus: mm, the distances that it is made for; design_wavelength: µm,
    0.55 by default; levels: steps of a wave's height; exact: true spheres. Of a file what `read_element` takes; index:
    its refractive indices at `wavelengths` instead of a glass.
    Raises ValueError for options that do not belong together, and what `read_element` raises.
    """
    name = str(element)
    of_files = {"glass": glass, "index": index, "pitch": pitch, "span": span}
    if name in BASELINES:
        for option, given in of_files.items():
            if given is not None:
                raise ValueError(f"`{option}` belongs to a height map; the element {name} has its own")
        if levels and name not in STEPPED:
            raise ValueError(f"`levels`: the element {name} is smooth; expected one of {', '.join(STEPPED)}")
        made_for = aim(
            radius=0.5 * aperture, sensor=sensor, focus=focus, wavelength=design_wavelength or _DESIGN, exact=exact
        )
        return baseline(name, made_for, **({"levels": levels} if levels else {}))
    if Path(name).suffix.lower() not in ELEMENT_FORMATS:
        raise ValueError(
            f"`element={name}`: neither a named element ({', '.join(BASELINES)}) nor a height map "
            f"({', '.join(FORMATS)}) nor a smooth element ({SMOOTH}){did_you_mean(name, BASELINES)}"
        )
    if index is not None:
        if glass:
            raise ValueError("`glass` and `index` both name the material: give one of them")
        try:
            glass = from_table(wavelengths, index)
        except ValueError as error:
            raise ValueError(f"`index`: {error}") from error
    made_of = {"glass": glass, "pitch": pitch, "span": span, "catalog": catalog}
    wrap = {"design_wavelength": design_wavelength, "levels": levels or 0}
    return (read_element(element, aperture=aperture, **made_of, **wrap),)


def _made(element) -> tuple[Element, ...]:
    """Elements that were made already; none of a name."""
    if isinstance(element, Element):
        return (element,)
    return () if isinstance(element, str | os.PathLike) else tuple(element)


def _check_colours(parts: Sequence[Element], wavelengths: Sequence[float]) -> None:
    """Raises ValueError for a wavelength (µm) outside what a material is known for: thin elements live by n - 1."""
    for glass in {id(element.glass.coefficients): element.glass for element in parts}.values():
        check_unit(torch.tensor(wavelengths), [glass])
        if glass.formula == "constant":
            continue
        low, high = glass.wavelength_range or (0.0, math.inf)
        outside = [wavelength for wavelength in wavelengths if not low <= wavelength <= high]
        if outside:
            listed = ", ".join(f"{wavelength:g}" for wavelength in outside)
            raise ValueError(f"{glass.name or 'the material'} is known from {low:g} to {high:g} µm, not at {listed} µm")
        check_wavelengths(glass, wavelengths)


def _kernels(scene: WaveScene, chosen: Plan, progress: Progress) -> Tensor:
    """All kernels at once, or one after the other where that would take too much memory."""
    D, W = len(scene.depths), len(scene.wavelengths)
    whole = chosen.memory < min(_PIECE, allowed_bytes())
    helps = "take fewer by `samples` or a larger `tol`, a smaller window by `size`"
    needed = chosen.memory if whole else chosen.memory / (D * W)
    afford(needed, f"a kernel needs {chosen.samples:,} samples across", helps=helps)
    forewarn(chosen.flops / _RATE, f"{D * W} kernels of {chosen.samples:,} samples across", helps=helps)
    if whole:
        return psf(scene, plan=chosen).kernel
    parts = [(d, w) for d in range(D) for w in range(W)]
    found = [
        psf(
            dataclasses.replace(scene, depths=scene.depths[d : d + 1], wavelengths=scene.wavelengths[w : w + 1]),
            plan=chosen,
        ).kernel
        for d, w in progress(parts, "kernel")
    ]
    return torch.cat(found).reshape(D, W, *scene.grid.shape)


@torch.no_grad()
def caustic(
    scene: WaveScene,
    distances: Tensor | None = None,
    *,
    half: float | None = None,
    columns: int = 201,
    tol: float = 1e-2,
    progress: Progress = _silent,
) -> tuple[Tensor, Tensor, float]:
    """The caustic of a scene: light per mm² (D, W, Z, columns), 1 = all through the aperture, on y = 0 from -half to
    half mm; its distances (Z,) mm; and half.

    distances: from element to plane, by default from four fifths of the sensor distance to six fifths; half: by default
    a tenth of the radius. Pixels and sensor do not count. Light is the mean over squares 2·half/columns wide.
    """
    z = scene.sensor_distance
    distances = z * torch.linspace(*_RANGE, _PLANES, dtype=z.dtype) if distances is None else distances.to(z)
    half = 2 * _ACROSS * float(aperture(scene)) if half is None else half
    line = grid(torch.as_tensor(2 * half / columns).to(z), (1, columns))
    planes = [
        psf(dataclasses.replace(scene, sensor_distance=distance, grid=line), tol=tol).kernel[..., 0, :] / line.pitch**2
        for distance in progress(distances, "plane")
    ]
    return torch.stack(planes, -2), distances, half


def _double(numbers) -> Tensor:
    return torch.as_tensor(numbers, dtype=torch.float64)
