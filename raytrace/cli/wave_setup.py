"""What the subcommands of `raytrace wave` share: the element that the arguments name, its scene, and PSFs of it."""

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.budget import afford, allowed_bytes, in_words
from raytrace.cli.door import CommandError, catalogs, say
from raytrace.cli.options import did_you_mean
from raytrace.cli.progress import progress
from raytrace.maths.grid import grid
from raytrace.media.catalog import find_glass
from raytrace.media.glass import Glass, check_wavelengths, from_table
from raytrace.system.lens import check_unit
from raytrace.wave.aim import Aim
from raytrace.wave.aim import aim as aim_of
from raytrace.wave.baselines import BASELINES, baseline
from raytrace.wave.element import Element, Rings
from raytrace.wave.exchange import FORMATS, read_heights
from raytrace.wave.fabrication import wrapped
from raytrace.wave.label import label_of, read_label
from raytrace.wave.plan import Plan, plan
from raytrace.wave.psf import WavePsf, psf
from raytrace.wave.scene import WaveScene

#: Named elements that are wrapped, and may be made in steps.
STEPPED = ("fresnel", "multifocal", "cubic", "achromat", "hybrid")
_WAVELENGTH = 0.55
_PIECE = 1e9  # bytes: what would take more is computed kernel by kernel
_FEW = 3.0  # s: what takes more is said
_RATE = 1.5e9  # operations of a plan in a second of one core, to a factor of three


def aim(arguments: argparse.Namespace) -> Aim:
    """What a named element is made for."""
    return aim_of(
        radius=0.5 * arguments.aperture,
        sensor=arguments.sensor,
        focus=arguments.focus,
        wavelength=arguments.design_wavelength or _WAVELENGTH,
        exact=arguments.exact,
    )


def elements(arguments: argparse.Namespace) -> tuple[Element, ...]:
    """The elements in contact that --element names: a baseline, or a height map."""
    name = arguments.element
    if name in BASELINES:
        return _named(arguments)
    if Path(name).suffix.lower() in FORMATS:
        return (_from_file(arguments),)
    raise CommandError(
        f"--element {name}: neither a named element ({', '.join(BASELINES)}) nor a height map "
        f"({', '.join(FORMATS)}){did_you_mean(name, BASELINES)}"
    )


def _named(arguments: argparse.Namespace) -> tuple[Element, ...]:
    for option in ("glass", "index", "pitch", "span"):
        if getattr(arguments, option) is not None:
            raise CommandError(f"--{option} belongs to a height map; the element {arguments.element} has its own")
    if not arguments.levels:
        return baseline(arguments.element, aim(arguments))
    if arguments.element not in STEPPED:
        raise CommandError(f"--levels: the element {arguments.element} is smooth; expected one of {', '.join(STEPPED)}")
    return baseline(arguments.element, aim(arguments), levels=arguments.levels)


def _from_file(arguments: argparse.Namespace) -> Element:
    """A height map in the aperture; wrapped where a design wavelength or steps are given."""
    element = height_map(
        arguments.element,
        aperture=arguments.aperture,
        glass=lambda: _glass(arguments),
        pitch=arguments.pitch,
        span=tuple(arguments.span) if arguments.span else None,
    )
    if not (arguments.design_wavelength or arguments.levels):
        return element
    label = read_label(arguments.element)
    design = arguments.design_wavelength or (label and label.design_wavelength)
    if not design:
        raise CommandError(f"{arguments.element}: does not say what it was made for; give --design-wavelength UM")
    return wrapped(element, design, levels=arguments.levels or 0)


def height_map(
    path: str,
    *,
    aperture: float,
    glass: Callable[[], Glass],
    pitch: float | None = None,
    span: tuple[float, float] | None = None,
) -> Element:
    """The element of a file of heights in an aperture of so many mm.

    glass: asked for once the heights are read; pitch, span: of a file that does not say them, nor its label.
    Raises CommandError where the heights do not fill the aperture, and what `read_heights` raises.
    """
    label = read_label(path)
    profile = read_heights(path, pitch=pitch or (label and label.pitch), span=span)
    profile = dataclasses.replace(profile, heights=profile.heights.double(), pitch=profile.pitch.double())
    counts = (2 * len(profile.heights),) if isinstance(profile, Rings) else profile.heights.shape
    across = min(counts) * float(profile.pitch)
    # What is cut to whole features may miss the rim by one of them.
    if across + 2 * float(profile.pitch) < aperture:
        raise CommandError(
            f"{path}: the heights are {across:.6g} mm across, less than the aperture of {aperture:g} mm; "
            f"give --aperture {across:.6g}"
        )
    return Element(profile, torch.tensor(0.5 * aperture, dtype=torch.float64), glass())


def _glass(arguments: argparse.Namespace) -> Glass:
    """The material of a height map: of --index, or as `material` finds it."""
    if arguments.index is None:
        return material(arguments.element, arguments.glass, user=catalogs(arguments))
    if arguments.glass:
        raise CommandError("--glass and --index both name the material: give one of them")
    try:
        return from_table(arguments.wavelength, arguments.index)
    except ValueError as error:
        raise CommandError(f"--index: {error}") from error


def material(path: str, name: str | None, *, user: Sequence[Path] = ()) -> Glass:
    """The glass of a name, else that of the label beside a height map. Raises CommandError where neither says it."""
    if name:
        return find_glass(name, user=tuple(user))
    label = read_label(path)
    if label is None:
        raise CommandError(
            f"{path}: does not say its material (there is no {label_of(path).name} beside it); give --glass NAME, as "
            "PMMA, or --index N for each --wavelength where the command has it"
        )
    return label.glass


def check_colours(parts: Sequence[Element], wavelengths: Sequence[float]) -> None:
    """Raises CommandError for a wavelength (µm) outside what a material is known for: thin elements live by n - 1."""
    for glass in {id(element.glass.coefficients): element.glass for element in parts}.values():
        check_unit(torch.tensor(wavelengths), [glass])
        if glass.formula == "constant":
            continue
        low, high = glass.wavelength_range or (0.0, math.inf)
        outside = [wavelength for wavelength in wavelengths if not low <= wavelength <= high]
        if outside:
            listed = ", ".join(f"{wavelength:g}" for wavelength in outside)
            raise CommandError(
                f"{glass.name or 'the material'} is known from {low:g} to {high:g} µm, not at {listed} µm"
            )
        check_wavelengths(glass, wavelengths)


def scene(arguments: argparse.Namespace, parts: Sequence[Element]) -> WaveScene:
    """The scene of --depth, --wavelength, --pixel, --size and the camera's arguments."""
    check_colours(parts, arguments.wavelength)
    return WaveScene(
        elements=tuple(parts),
        sensor_distance=_double(arguments.sensor),
        depths=_double(arguments.depth),
        wavelengths=_double(arguments.wavelength),
        grid=grid(_double(arguments.pixel), arguments.size),
        exact=arguments.exact,
    )


@torch.no_grad()
def kernels(found: WaveScene, *, engine: str, samples: int | None, tol: float) -> WavePsf:
    """PSFs of a scene; where all at once would take too much memory, one after the other. What takes more than a few
    seconds is said before it begins.

    Raises budget.OverBudget where one kernel alone would take too much.
    """
    chosen = plan(found, engine=engine, samples=samples, tol=tol)
    count = len(found.depths) * len(found.wavelengths)
    whole = chosen.memory < min(_PIECE, allowed_bytes())
    needed = chosen.memory if whole else chosen.memory / count
    afford(
        needed,
        f"a kernel needs {chosen.samples:,} samples across",
        helps="take fewer by --samples or a larger --tol, a smaller window by --size",
    )
    seconds = chosen.flops / _RATE
    if seconds > _FEW:
        say(f"{count} kernels, {chosen.samples} samples: about {seconds:.0f} s and {in_words(needed)}")
    return psf(found, plan=chosen) if whole else _one_by_one(found, chosen)


def _one_by_one(found: WaveScene, chosen: Plan) -> WavePsf:
    rows = []
    with progress(len(found.depths) * len(found.wavelengths), "kernel", what="wave psf") as bar:
        for depth in found.depths.split(1):
            row = []
            for wavelength in found.wavelengths.split(1):
                one = dataclasses.replace(found, depths=depth, wavelengths=wavelength)
                row.append(psf(one, plan=chosen).kernel)
                bar.update(1)
            rows.append(torch.cat(row, 1))
    return WavePsf(torch.cat(rows), found.depths, found.wavelengths, found.grid, chosen)


def _double(numbers) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)
