"""`raytrace psf` and `raytrace compare`."""

import argparse
import warnings

import numpy as np
from torch import Tensor

from raytrace.analysis import Abilities, Comparison, abilities, common_focus
from raytrace.analysis import compare as compare_models
from raytrace.cli.door import field_points, number, numbers, open_lens, primary, print_json, say
from raytrace.cli.spots import cell, warn_of_losses
from raytrace.files import write_atomically
from raytrace.grid import grid
from raytrace.lens import FIELD_UNITS, Lens, with_object_distance
from raytrace.psf import NotConverged, Psf
from raytrace.psf import psf as compute
from raytrace.pupil import gauss_rings
from raytrace.shards import Share, processes


def psf(arguments: argparse.Namespace) -> None:
    """Kernels over object distance × field: print, plot, save; under torchrun computed by all processes."""
    with processes() as share:
        _psf(arguments, share)


def _psf(arguments: argparse.Namespace, share: Share) -> None:
    lens = open_lens(arguments)
    fields = field_points(lens, arguments, on_axis=True)
    distances = arguments.object_distance or [float(lens.surfaces[0].thickness)]
    rays_are_shared = arguments.model == "gaussian" or (arguments.model == "drt" and arguments.rays)
    if share.processes > 1 and len(distances) * fields.shape[1] * len(lens.wavelengths) == 1 and not rays_are_shared:
        say(f"a single kernel of {arguments.model} is not cut: each of the {share.processes} processes computes it")
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
        rho=arguments.rho,
        share=share,
    )
    if share.rank:
        return
    _warn(lens, fields, distances, found)
    labels = [f"{y:g}" if x == 0 else f"{x:g},{y:g}" for x, y in fields.T.tolist()]
    if arguments.output:
        write_atomically(arguments.output, lambda file: save(found, distances, fields, file))
    if arguments.plot:
        from raytrace import plot
        from raytrace.plot.style import field_label

        title = f"{lens.name or arguments.lens}: {found.model} PSF"
        rows = [field_label(lens, field) for field in fields.T.tolist()]
        plot.save(plot.psf_grid(found, distances, rows, title=title), arguments.plot)
    if arguments.json:
        print_json({"model": found.model, "reason": found.reason or None, "results": results(found, distances, fields)})
    else:
        _print(found, distances, labels, FIELD_UNITS[lens.fields.kind])
    for path in filter(None, (arguments.plot, arguments.output)):
        say(f"written: {path}")


def _warn(lens: Lens, fields: Tensor, distances: list[float], found: Psf) -> None:
    """Say of every field that no ray of a wavelength brings to the sensor where they end."""
    points = gauss_rings(6)[0]
    for d, distance in enumerate(distances):
        dark = found.ray_centroid[0, d].isnan()
        at = f"object at {distance:g} mm, " if len(distances) > 1 else ""
        trial = with_object_distance(lens, distance)
        warn_of_losses(trial, fields, points, dark[:, None].expand(-1, len(lens.wavelengths)), at=at)


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
            places = [cell(value, ">12.6f") for value in found.centroid[:, d, f].tolist()]
            widths = (1000 * found.covariance[::2, d, f].clamp_min(0.0).sqrt()).tolist()
            print(
                " ".join([f"{distance:>12g} {label:>9}", *places, *(cell(value, ">9.4f") for value in widths)]),
                f"{float(found.energy[d, f]):>8.4f} {cell(float(found.error[d, f]), '>9.1e')} {found.rays:>7}",
            )


#: Columns of the table of `compare`: attribute, heading.
_SHOWN = {
    "conic": "Δ conic",
    "anisotropy": "σ long/short",
    "asymmetry": "asymmetry",
    "dark_ring": "dark ring/Airy",
    "parameters": "parameters",
    "rays": "rays",
}
_WHOLE = ("parameters", "rays")


def compare(arguments: argparse.Namespace) -> None:
    """The models side by side over object distance, and what each of them can represent, in numbers."""
    lens = open_lens(arguments)
    wavelength = primary(lens) if arguments.wavelength else 0.53
    lens = common_focus(lens, arguments.focus_distance, wavelength=wavelength, start=arguments.start)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)  # the estimated errors are printed
        found = compare_models(lens, lens.wavelengths.new_tensor(arguments.object_distance))
        able = abilities(lens)
    where = f"one sensor at {float(found.sensor_distance):.7f} mm, {float(found.wavelength):g} µm"
    if arguments.plot:
        from raytrace import plot

        title = f"{lens.name or arguments.lens}: {where}"
        plot.save(plot.model_grid(found, title=title), arguments.plot)
    if arguments.json:
        print_json(_comparison(found, able))
    else:
        print(f"{where}; fields on the axis")
        _print_comparison(found)
        _print_abilities(able)
    if arguments.plot:
        say(f"written: {arguments.plot}")


def _comparison(found: Comparison, able: Abilities) -> dict:
    """What `raytrace compare --json` writes."""
    distances, axis = found.object_distances.tolist(), found.object_distances.new_zeros(2, 1)
    models = {
        name: {
            **{key: _whole(key, getattr(able, key)[m]) for key in _SHOWN},
            "difference": numbers(found.difference[m]),
            "results": results(found.psfs[m], distances, axis),
        }
        for m, name in enumerate(found.models)
    }
    return {"sensor_distance": number(found.sensor_distance), "wavelength": number(found.wavelength), "models": models}


def _whole(key: str, value) -> float | int | None:
    return int(value) if key in _WHOLE else number(value)


def _print_comparison(found: Comparison) -> None:
    print(
        f"σ in µm, relative L1 difference from {found.models[-1]}, estimated error of the kernel (Gaussian DRT: of σ)"
    )
    distances = (f"{distance / 1000:g} m" for distance in found.object_distances.tolist())
    print(f"{'object at':>14} " + " ".join(f"{distance:>24}" for distance in distances))
    rows = zip(found.models, *(values.tolist() for values in (found.sigma, found.difference, found.error)), strict=True)
    for name, *columns in rows:
        cells = (f"{1000 * s:>8.3f} {d:>6.3f} {e:>8.1e}" for s, d, e in zip(*columns, strict=True))
        print(f"{name:>14} " + " ".join(cells))


def _print_abilities(able: Abilities) -> None:
    print("what each model can represent: see `raytrace compare --help`")
    print(f"{'':>14} " + " ".join(f"{heading:>15}" for heading in _SHOWN.values()))
    for m, name in enumerate(able.models):
        print(f"{name:>14} " + " ".join(f"{_cell(key, getattr(able, key)[m]):>15}" for key in _SHOWN))


def _cell(key: str, value) -> str:
    shown = _whole(key, value)
    if shown is None:
        return "none"
    return f"{shown}" if key in _WHOLE else "0" if abs(shown) < 1e-12 else f"{shown:.4f}"
