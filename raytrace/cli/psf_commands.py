"""`raytrace psf`."""

import argparse
import math

import numpy as np

from raytrace.cli.door import field_points, number, numbers, open_lens, print_json, say
from raytrace.files import write_atomically
from raytrace.grid import grid
from raytrace.lens import FIELD_UNITS
from raytrace.psf import Psf
from raytrace.psf import psf as compute


def psf(arguments: argparse.Namespace) -> None:
    """Kernels over object distance × field: print, plot, save."""
    lens = open_lens(arguments)
    fields = field_points(lens, arguments, on_axis=True)
    distances = arguments.object_distance or [float(lens.surfaces[0].thickness)]
    found = compute(
        lens,
        arguments.model,
        fields=fields,
        object_distances=lens.wavelengths.new_tensor(distances),
        grid=grid(lens.wavelengths.new_tensor(arguments.pixel), arguments.size),
        center=arguments.center,
        tol=arguments.tol,
        rays=arguments.rays,
        normalise=arguments.normalise,
    )
    labels = [f"{y:g}" if x == 0 else f"{x:g},{y:g}" for x, y in fields.T.tolist()]
    if arguments.output:
        write_atomically(arguments.output, lambda file: save(found, distances, fields, file))
    if arguments.plot:
        from raytrace import plot

        title = f"{lens.name or arguments.lens}: {found.model} PSF"
        unit = FIELD_UNITS[lens.fields.kind]
        plot.save(plot.psf_grid(found, distances, [f"{label} {unit}" for label in labels], title=title), arguments.plot)
    if arguments.json:
        print_json({"model": found.model, "reason": found.reason or None, "results": results(found, distances, fields)})
    else:
        _print(found, distances, labels, FIELD_UNITS[lens.fields.kind])
    for path in filter(None, (arguments.plot, arguments.output)):
        say(f"written: {path}")


def results(found: Psf, distances: list[float], fields) -> list[dict]:
    """One entry per kernel, distance-major: what `raytrace psf --json` writes."""
    return [
        {
            "object_distance": number(distance),
            "field": numbers(fields[:, f]),
            "centroid": numbers(found.centroid[:, d, f]),
            "covariance": [numbers(found.covariance[:2, d, f]), numbers(found.covariance[1:, d, f])],
            "energy": number(found.energy[d, f]),
            "error": number(found.error[d, f]),
            "residual": None if found.residual is None else number(found.residual[d, f]),
            "rays": found.rays,
        }
        for d, distance in enumerate(distances)
        for f in range(fields.shape[1])
    ]


def save(found: Psf, distances: list[float], fields, file) -> None:
    """Write the arrays of `-o`: psf[distance, field, y, x] and what belongs to it."""
    np.savez_compressed(
        file,
        psf=found.kernel.detach().numpy(),
        pixel_pitch=float(found.grid.pitch),
        centre=found.grid.centre.detach().numpy(),
        energy=found.energy.detach().numpy(),
        error=found.error.detach().numpy(),
        centroid=found.centroid.detach().numpy(),
        covariance=found.covariance.detach().numpy(),
        object_distance=np.array(distances),
        field=fields.T.numpy(),
        model=found.model,
        normalised=found.normalised,
    )


def _print(found: Psf, distances: list[float], labels: list[str], unit: str) -> None:
    print(
        f"{found.model} PSF, {found.grid.columns} × {found.grid.rows} pixels of {1000 * float(found.grid.pitch):g} µm"
    )
    if found.reason:
        print(found.reason)
    print(
        f"{'object':>12} {'field':>9} {'centroid x':>12} {'centroid y':>12} {'σ x':>9} {'σ y':>9} {'energy':>8} ",
        end="",
    )
    print(f"{'error':>9} {'rays':>7}")
    print(f"{'mm':>12} {unit:>9} {'mm':>12} {'mm':>12} {'µm':>9} {'µm':>9} {'window':>8} {'est.':>9} {'':>7}")
    for d, distance in enumerate(distances):
        for f, label in enumerate(labels):
            x, y = (value + 0.0 for value in found.centroid[:, d, f].tolist())
            xx, yy = (1000 * math.sqrt(max(0.0, value)) for value in found.covariance[::2, d, f].tolist())
            print(
                f"{distance:>12g} {label:>9} {x:>12.6f} {y:>12.6f} {xx:>9.4f} {yy:>9.4f} "
                f"{float(found.energy[d, f]):>8.4f} {float(found.error[d, f]):>9.1e} {found.rays:>7}"
            )
