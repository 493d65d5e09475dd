"""PSFs of thin elements over depth and wavelength, integrated over the pixels of a sensor.

`wave_psf` is the public call, `psf` that of a `WaveScene`, by the engine that `wave_optics.plan` chooses.
"""

import dataclasses
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.budget import afford, allowed_bytes, forewarn
from raytrace.files import write_atomically
from raytrace.materials.glass import Glass, check_unit, check_wavelengths, from_table
from raytrace.maths.numerics import in_transform, value
from raytrace.maths.result import Column, Result, Table, masked, number, rows
from raytrace.maths.sampling import Grid, centres, grid
from raytrace.plotting.style import Figure
from raytrace.tracing.scene import Memo
from raytrace.wave_optics import figures
from raytrace.wave_optics import plan as planning
from raytrace.wave_optics.designs import BASELINES, STEPPED, aim, baseline
from raytrace.wave_optics.element import Element, EvenPowers, Rings, has_features, in_contact
from raytrace.wave_optics.element_files import ELEMENT_FORMATS, SMOOTH, read_element
from raytrace.wave_optics.fabrication import height_range
from raytrace.wave_optics.height_maps import FORMATS
from raytrace.wave_optics.plan import Plan, plan
from raytrace.wave_optics.scene import WaveScene, aperture, is_round
from raytrace.words import did_you_mean, option

T = TypeVar("T")

_KEPT = 8  # sums that a memo keeps


@value
class ElementPsf(Result):
    """PSFs of an element for points on the axis, over depth and wavelength.

    kernel: (D, W, rows, columns), light in each pixel, 1 = all through the aperture; scene: the camera; plan: the
    sampling, with the predicted error, relative L2 of the worst kernel; element: its name.
    axial: (D, W), light in one pixel centred on the axis, where the window has a corner or an edge of pixels there;
    None where it is a pixel of the window.
    """

    COLUMNS = (
        Column("depth", "mm", "g", "object"), Column("wavelength", "µm", "g"),
        Column("energy", "", ".4f", "energy\nwindow"), Column("peak", "", ".6f", "peak\npixel"),
        Column("half_energy_radius_um", "µm", ".2f", "half-energy\nradius"),
    )  # fmt: skip

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
        """(D, W): the most light in one pixel, of those of the window and one centred on the axis."""
        brightest = self.kernel.amax((-2, -1))
        return brightest if self.axial is None else torch.maximum(brightest, self.axial)

    @property
    def half_energy_radius(self) -> Tensor:
        """(D, W) mm about the axis that holds half of all light, to half a pixel; inf where the window does not."""
        x, y = centres(self.grid)
        distance, order = torch.sqrt(x * x + (y * y)[:, None]).flatten().sort()
        inside = (self.kernel.flatten(-2)[..., order].cumsum(-1) < 0.5).sum(-1)
        return torch.where(inside < len(distance), distance[inside.clamp(max=len(distance) - 1)], math.inf)

    def columns(self) -> dict[str, Tensor]:
        radius = self.half_energy_radius
        return {
            "depth": self.depths[:, None],
            "wavelength": self.wavelengths,
            "energy": self.energy,
            "peak": self.peak,
            "half_energy_radius_um": 1e3 * masked(radius, radius.isfinite()),
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

    def tables(self) -> list[Table]:
        lines = [self.title]
        for element in self.scene.elements:
            (low, high), material = height_range(element), element.glass.name or "constant index"
            lines.append(f"{element.kind.words} of {material}, heights over {1e3 * (high - low):.4g} µm")
        lines += [
            f"{self.plan.engine} engine, {self.plan.samples} samples, predicted error {self.plan.error:.1e}; "
            f"{self.grid.columns} × {self.grid.rows} pixels of {1e3 * float(self.pitch):g} µm",
        ]
        return [Table(self.columns(), lines)]

    def draw(self, *, what: str = "kernels", progress: "Progress | None" = None) -> Figure:
        """The kernels, "heights" of the element, "caustic" or "encircled" energy; progress: of a caustic."""
        if what == "heights":
            return figures.height_figure(self.scene.elements, title=self.title)
        if what == "caustic":
            return figures.caustic_figure(self, *caustic(self.scene, progress=progress or _silent))
        if what not in ("kernels", "encircled"):
            raise ValueError(f"no figure {what!r}; expected one of kernels, heights, caustic, encircled")
        return figures.psf_figure(self) if what == "kernels" else figures.encircled_figure(self)

    def save(self, path: str | os.PathLike) -> None:
        """Write the arrays, psf[depth, wavelength, y, x] and its axes, as .npz."""
        if Path(path).suffix.lower() != ".npz":
            raise ValueError(f"{path}: expected a name that ends in .npz")
        tensors = {"psf": self.kernel, "centre": self.grid.centre, "energy": self.energy}
        tensors |= {"depths": self.depths, "wavelengths": self.wavelengths}
        arrays: dict[str, Any] = {name: tensor.detach().numpy() for name, tensor in tensors.items()}
        arrays |= {"pixel_pitch": float(self.pitch), "element": self.element}
        arrays |= {"engine": self.plan.engine, "samples": self.plan.samples, "error": self.plan.error}
        write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def psf(
    scene: WaveScene,
    *,
    plan: Plan | None = None,
    memo: Memo | None = None,
    behind: Tensor | None = None,
    **sampling: Any,
) -> ElementPsf:
    """PSFs of a scene, differentiable in every number of it.

    sampling: engine, samples, nodes, tol, pad, band_limit as `plan.plan` takes them, and its errors. plan: of an
    earlier call, instead of them: for loops. memo: sums that do not depend on the heights, reused while the rest of the
    scene stays as it is. behind: `plan.behind` of the same elements and wavelengths, for several depths or windows.
    """
    plan = planning.plan(scene, **sampling) if plan is None else plan
    engine, sums = planning.ENGINES[plan.engine], None
    if (prepare := engine.prepare) is not None:
        if memo is None:
            sums = prepare(scene, plan, behind)
        else:
            sums = remembered(memo, scene, plan, lambda: prepare(scene, plan, None))
    return ElementPsf(engine.kernels(scene, sums, plan), scene, plan)


def psf_by_depth(scene: WaveScene) -> ElementPsf:
    """PSFs of a scene; of elements that are not round depth by depth, for memory, to 0.5 %.

    Rings in contact with other elements are sampled at their own pitch (2,500 cells across 5 mm of 2 µm rings).
    """
    if is_round(scene):
        return psf(scene)
    pitches = [element.profile.pitch for element in scene.elements if isinstance(element.profile, Rings)]
    samples = math.ceil(float(2 * aperture(scene) / min(pitches))) if pitches else None
    depths = (dataclasses.replace(scene, depths=depth[None]) for depth in scene.depths.unbind())
    parts = [psf(part, tol=5e-3, samples=samples) for part in depths]
    return ElementPsf(torch.cat([part.kernel for part in parts]), scene, parts[0].plan)


def remembered(memo: Memo, scene: WaveScene, key: Any, make: Callable[[], T], *constants: Tensor) -> T:
    """`make()` without graph, from memory where nothing but heights and coefficients of the scene has changed.

    key: of the result among others of the scene; constants: further numbers that it depends on.
    """
    numbers, structure = pytree.tree_flatten(dataclasses.replace(scene, elements=()))
    numbers, key = [*numbers, *constants], (key, structure)
    for element in scene.elements:
        free = element.numbers
        # Of free heights only how many there are counts; where a wrapped smooth one jumps moves with its coefficients.
        jumps = isinstance(element.profile, EvenPowers) and element.period is not None
        pitch = element.profile.pitch if has_features(element.profile) else None
        parts = [element.radius, pitch, element.period, free.detach() if jumps else None]
        numbers += [t for t in parts if t is not None]
        kind = (type(element.profile), free.shape, free.dtype, free.device, element.levels, element.period is None)
        key = (key, *kind)
    if in_transform() or any(n.requires_grad for n in numbers):
        memo.made += 1
        return make()
    with torch.no_grad():
        return memo.find(numbers, key, make, most=_KEPT)


COLOURS = (0.46, 0.55, 0.64)
DESIGN = 0.55  # µm
_CHUNK = 1e9  # bytes: beyond, kernels are computed one by one
_RATE = 1.5e9  # operations of a plan in a second of one core, to a factor of three
_PLANES, _RANGE, _ACROSS = 151, (0.75, 1.25), 0.05  # of a caustic: over the sensor distance, and of the aperture
_COLUMNS = 201

#: Shows the progress of a loop: (its items, their unit) -> the items.
Progress = Callable[[Any, str], Iterable]


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
    engine: Literal["auto", "pupil", "radial", "fresnel", "angular_spectrum"] = "auto",
    samples: int | None = None,
    tol: float = 1e-3,
    progress: Progress = _silent,
) -> ElementPsf:
    """PSFs of a phase element, integrated over pixels, for points on the axis over depth and wavelength.

    element, and all up to catalog: as for `rt.wave_optics.phase_elements`; or an Element (of an array by
    `rt.wave_optics.phase_element`), or several in contact, in whose numbers the kernels are differentiable; of the
    options up to catalog they use `sensor` (mm from the element) and `exact` alone. depths: mm, inf allowed;
    wavelengths: µm; pixel: mm; size: pixels across a window around the axis; with an even size the axis is a corner of
    four pixels. A kernel holds the light in each pixel, 1 is all light through the aperture. engine: "auto" takes
    "radial" (Hankel integrals) for round elements, else "pupil" (matrix Fourier transform); "fresnel" and
    "angular_spectrum" propagate the field by FFT, as references. tol: bound on the predicted relative L2 error of a
    kernel; samples: across the aperture, instead. `.plan` of the result has both. Kernels that would take too much
    memory at once are computed one by one. Raises ValueError for options that exclude each other, AliasedSampling for
    samples that would repeat the kernel inside the window, budget.OverBudget where one kernel alone would take too
    much.
    """
    if isinstance(element, str | os.PathLike):
        name = str(element)
        parts = phase_elements(
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
    else:
        parts = in_contact(element)
        diameter = 2 * float(parts[0].radius.detach()) if parts else 0.0
        fixed = {"glass": glass, "index": index, "pitch": pitch, "span": span, "levels": levels}
        fixed |= {"design_wavelength": design_wavelength}
        fixed |= {"aperture": None if aperture == 5.0 or math.isclose(aperture, diameter) else aperture}
        if parameter := next((word for word, number in fixed.items() if number is not None), ""):
            message = "belongs to an element by name or from a file; an Element has it already"
            raise ValueError(f"{option(parameter)} {message}")
        name = " + ".join(part.kind.words for part in parts)
    for material in {id(part.glass.coefficients): part.glass for part in parts}.values():
        check_unit(torch.tensor(wavelengths), [material])
        if material.formula == "constant":
            continue
        low, high = material.wavelength_range or (0.0, math.inf)
        if outside := ", ".join(f"{wavelength:g}" for wavelength in wavelengths if not low <= wavelength <= high):
            words = material.name or "the material"
            raise ValueError(f"{words} has indices from {low:g} to {high:g} µm, none at {outside} µm")
        check_wavelengths(material, wavelengths)
    window = grid(_double(pixel), size)
    scene = WaveScene(parts, _double(sensor), _double(depths), _double(wavelengths), window, exact)
    chosen = plan(scene, engine=engine, samples=samples, tol=tol)
    windows = [window, grid(_double(pixel), 1)] if size % 2 == 0 else [window]  # a corner of four pixels on the axis
    kernel, *axial = _kernels(scene, windows, chosen, progress)
    return ElementPsf(kernel, scene, chosen, name, axial[0][..., 0, 0] if axial else None)


def phase_elements(
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
    """The elements in contact of a name, or of a file of heights.

    Names: ideal, singlet, fresnel, multifocal, multifocal-refractive, cubic, cubic-refractive, achromat, hybrid; cubic
    and hybrid are two elements, a lens and a plate. `rt.wave_optics.phase_element` makes an element of an array.

    aperture: diameter, mm. Of a named element sensor, focus: mm, the distances of its design; design_wavelength: µm,
    0.55 by default; levels: steps of a wave's height; exact: true spheres. Of a file as for `read_element`; index:
    its refractive indices at `wavelengths` instead of a glass.
    Raises ValueError for options that do not belong together, and the errors of `read_element`.
    """
    name = str(element)
    if name in BASELINES:
        of_maps = {"glass": glass, "index": index, "pitch": pitch, "span": span}
        if parameter := next((word for word, number in of_maps.items() if number is not None), ""):
            raise ValueError(f"{option(parameter)} belongs to a height map; it is fixed for the element {name}")
        if levels and name not in STEPPED:
            raise ValueError(f"{option('levels')}: the element {name} is smooth; expected one of {', '.join(STEPPED)}")
        wavelength = design_wavelength or DESIGN
        conditions = aim(radius=0.5 * aperture, sensor=sensor, focus=focus, wavelength=wavelength, exact=exact)
        return baseline(name, conditions, **({"levels": levels} if levels else {}))
    if Path(name).suffix.lower() not in ELEMENT_FORMATS:
        raise ValueError(
            f"{option('element', name)}: neither a named element ({', '.join(BASELINES)}) nor a height map "
            f"({', '.join(FORMATS)}) nor a smooth element ({SMOOTH}){did_you_mean(name, BASELINES)}"
        )
    if index is not None:
        if glass:
            raise ValueError(f"{option('glass')} and {option('index')} exclude each other: both specify the material")
        try:
            glass = from_table(wavelengths, index)
        except ValueError as error:
            raise ValueError(f"{option('index')}: {error}") from error
    part = read_element(
        element,
        aperture=aperture,
        glass=glass,
        pitch=pitch,
        span=span,
        design_wavelength=design_wavelength,
        levels=levels or 0,
        catalog=catalog,
    )
    return (part,)


def _kernels(scene: WaveScene, windows: Sequence[Grid], chosen: Plan, progress: Progress) -> list[Tensor]:
    """The kernels (D, W, rows, columns) of each window, of which that of the scene is the largest.

    All at once, or one after the other where that would take too much memory.
    """
    D, W = len(scene.depths), len(scene.wavelengths)
    whole = chosen.memory < min(_CHUNK, allowed_bytes())
    helps = "take fewer by {samples} or a larger {tol}, a smaller window by {size}"
    needed = chosen.memory if whole else chosen.memory / (D * W)
    afford(needed, f"a kernel needs {chosen.samples:,} samples across", helps=helps)
    forewarn(chosen.flops / _RATE, f"{D * W} kernels of {chosen.samples:,} samples across", helps=helps)

    def each(part: WaveScene, behind: Tensor | None) -> list[Tensor]:
        scenes = (dataclasses.replace(part, grid=window) for window in windows)
        return [psf(scene, plan=chosen, behind=behind).kernel for scene in scenes]

    if whole:
        return each(scene, planning.behind(scene, chosen))
    kernels, behind = [], None
    for w, d in progress([(w, d) for w in range(W) for d in range(D)], "kernel"):
        part = dataclasses.replace(scene, depths=scene.depths[d : d + 1], wavelengths=scene.wavelengths[w : w + 1])
        if d == 0:
            behind = None  # frees the light of the last wavelength first
            behind = planning.behind(part, chosen)
        kernels.append(each(part, behind))
    return [torch.cat(parts).unflatten(0, (W, D))[:, :, 0].movedim(1, 0) for parts in zip(*kernels, strict=True)]


@torch.no_grad()
def caustic(scene: WaveScene, *, progress: Progress = _silent) -> tuple[Tensor, Tensor, float]:
    """The caustic of a scene: light per mm² (D, W, Z, 201), 1 = all through the aperture, on y = 0 from -half to half
    mm; its distances (Z,) mm from the element, 0.75 to 1.25 of the sensor distance; and half, a tenth of the radius.

    Light is the mean over squares 2·half/201 wide.
    """
    distances = scene.sensor_distance * torch.linspace(*_RANGE, _PLANES).to(scene.sensor_distance)
    half = 2 * _ACROSS * float(aperture(scene))
    line = grid(torch.as_tensor(2 * half / _COLUMNS).to(distances), (1, _COLUMNS))
    planes = [
        psf(dataclasses.replace(scene, sensor_distance=distance, grid=line), tol=1e-2).kernel[..., 0, :] / line.pitch**2
        for distance in progress(distances, "plane")
    ]
    return torch.stack(planes, -2), distances, half


def _double(numbers: Sequence[float] | float) -> Tensor:
    return torch.as_tensor(numbers, dtype=torch.float64)
