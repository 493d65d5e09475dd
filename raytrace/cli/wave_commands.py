"""`raytrace wave psf`."""

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace import plot
from raytrace.cli.door import print_json, refuse_suffix, say
from raytrace.cli.progress import progress
from raytrace.cli.wave_setup import elements, kernels, scene
from raytrace.files import write_atomically
from raytrace.maths.grid import Grid, centres
from raytrace.maths.result import number
from raytrace.plot import wave as figures
from raytrace.plot.style import object_text
from raytrace.wave.caustic import caustic
from raytrace.wave.psf import WavePsf
from raytrace.wave.scene import WaveScene

_PLANES = 121  # of a caustic


def psf(arguments: argparse.Namespace) -> None:
    """Kernels over depth × wavelength: print, draw, save."""
    refuse_suffix("-o", arguments.output, (".npz",))
    drawn = {draw: path for name, draw in _FIGURES.items() if (path := getattr(arguments, name))}
    parts = elements(arguments)
    seen = scene(arguments, parts)
    found = kernels(
        seen,
        engine=arguments.engine,
        samples=arguments.samples,
        tol=arguments.tol,
    )
    if arguments.output:
        write_atomically(arguments.output, lambda file: save(found, arguments.element, file))
    for draw, path in drawn.items():
        plot.save(draw(arguments, seen, found), path)
    if arguments.json:
        print_json(_document(found, arguments))
    else:
        _print(found, arguments)
    for path in filter(None, (arguments.output, *drawn.values())):
        say(f"written: {path}")


def _heights(arguments: argparse.Namespace, seen: WaveScene, found: WavePsf):
    return figures.height_figure(seen.elements, title=_title(arguments))


def _caustic(arguments: argparse.Namespace, seen: WaveScene, found: WavePsf):
    """Planes from four fifths of the sensor distance to six fifths; light up to a tenth of the aperture."""
    z = seen.sensor_distance
    distances, half = z * torch.linspace(0.8, 1.2, _PLANES, dtype=z.dtype), 0.05 * arguments.aperture
    planes = progress(distances, "plane", what="caustic")
    light = torch.cat([caustic(seen, plane[None], half=half) for plane in planes], -2)
    return figures.caustic_figure(
        light,
        distances,
        half=half,
        wavelengths=arguments.wavelength,
        depths=arguments.depth,
        sensor=arguments.sensor,
        title=_title(arguments),
    )


def _kernels(arguments: argparse.Namespace, seen: WaveScene, found: WavePsf):
    return figures.psf_figure(found, title=_title(arguments))


def _encircled(arguments: argparse.Namespace, seen: WaveScene, found: WavePsf):
    return figures.encircled_figure(found, title=_title(arguments))


_FIGURES = {"plot": _kernels, "heights": _heights, "caustic": _caustic, "encircled": _encircled}


def save(found: WavePsf, element: str, file) -> None:
    """Write the arrays of `-o`: psf[depth, wavelength, y, x] and what belongs to it."""
    np.savez_compressed(
        file,
        psf=found.kernel.detach().numpy(),
        pixel_pitch=float(found.pitch),
        centre=found.grid.centre.detach().numpy(),
        energy=found.energy.detach().numpy(),
        depths=found.depths.detach().numpy(),
        wavelengths=found.wavelengths.detach().numpy(),
        engine=found.engine,
        samples=found.plan.samples,
        error=found.error,
        element=element,
    )


def half_energy_radius(kernel: Tensor, window: Grid) -> Tensor:
    """Radius (...) mm about the axis that holds half of all light through the aperture; inf where the window does not.

    Pixels count by the distance of their centres: good to half a pixel.
    """
    x, y = centres(window)
    distance, order = torch.sqrt(x * x + (y * y)[:, None]).flatten().sort()
    held = kernel.flatten(-2)[..., order].cumsum(-1)
    inside = (held < 0.5).sum(-1)
    radius = distance[inside.clamp(max=len(distance) - 1)]
    return torch.where(inside < len(distance), radius, math.inf)


def _document(found: WavePsf, arguments: argparse.Namespace) -> dict:
    """What `raytrace wave psf --json` writes; an infinite depth is null."""
    radius = half_energy_radius(found.kernel, found.grid)
    results = [
        {
            "depth": number(depth),
            "wavelength": number(wavelength),
            "energy": number(found.energy[d, w]),
            "peak": number(found.kernel[d, w].max()),
            "half_energy_radius": number(radius[d, w]),
        }
        for d, depth in enumerate(found.depths)
        for w, wavelength in enumerate(found.wavelengths)
    ]
    return {
        "element": arguments.element,
        "engine": found.engine,
        "samples": found.plan.samples,
        "error": number(found.error),
        "pixel_pitch": number(found.pitch),
        "size": found.grid.rows,
        "exact": arguments.exact,
        "results": results,
    }


def _title(arguments: argparse.Namespace) -> str:
    name = Path(arguments.element).name
    return f"{name}, ⌀ {arguments.aperture:g} mm, sensor at {arguments.sensor:g} mm"


def _print(found: WavePsf, arguments: argparse.Namespace) -> None:
    print(_title(arguments))
    print(
        f"{found.engine} engine, {found.plan.samples} samples, predicted error {found.error:.1e}; "
        f"{found.grid.columns} × {found.grid.rows} pixels of {1e3 * float(found.pitch):g} µm"
    )
    print(f"{'object':>12} {'wavelength':>11} {'energy':>8} {'peak':>10} {'half-energy':>12}")
    print(f"{'':>12} {'µm':>11} {'window':>8} {'pixel':>10} {'radius, µm':>12}")
    radius = half_energy_radius(found.kernel, found.grid)
    for d, depth in enumerate(found.depths.tolist()):
        for w, wavelength in enumerate(found.wavelengths.tolist()):
            half = float(radius[d, w])
            print(
                f"{object_text(depth):>12} {wavelength:>11g} {float(found.energy[d, w]):>8.4f} "
                f"{float(found.kernel[d, w].max()):>10.6f} {f'{1e3 * half:.2f}' if math.isfinite(half) else '–':>12}"
            )
