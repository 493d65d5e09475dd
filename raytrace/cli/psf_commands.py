"""`raytrace psf` and `raytrace compare`."""

import argparse
import warnings

import numpy as np
from torch import Tensor

from raytrace.analysis import PIXEL, SIZE, Abilities, Comparison, abilities, common_focus
from raytrace.analysis import compare as compare_models
from raytrace.cli.door import CommandError, field_points, open_lens, primary, print_json, say
from raytrace.files import write_atomically
from raytrace.kernels import NotConverged, Psf, close_up, default_center
from raytrace.kernels import psf as compute
from raytrace.maths.grid import Grid, grid
from raytrace.maths.pupil import gauss_rings
from raytrace.maths.result import cell, number, numbers
from raytrace.optics.focus import NoImage, real_image_distance
from raytrace.optics.losses import warn_of_losses
from raytrace.optics.paraxial import first_order
from raytrace.shards import Share, processes
from raytrace.system.lens import FIELD_UNITS, Lens, name_of_field, with_object_distance


def psf(arguments: argparse.Namespace) -> None:
    """Kernels over object distance × field: print, plot, save; under torchrun computed by all processes."""
    with processes() as share:
        _psf(arguments, share)


def _psf(arguments: argparse.Namespace, share: Share) -> None:
    lens = open_lens(arguments)
    fields = field_points(lens, arguments)
    distances = arguments.object_distances or [float(lens.surfaces[0].thickness)]
    rays_are_shared = arguments.model == "gaussian" or (arguments.model == "drt" and arguments.rays)
    if share.processes > 1 and len(distances) * fields.shape[1] * len(lens.wavelengths) == 1 and not rays_are_shared:
        say(f"a single kernel of {arguments.model} is not cut: each of the {share.processes} processes computes it")
    found = compute(
        lens,
        arguments.model,
        fields=fields,
        object_distances=lens.wavelengths.new_tensor(distances),
        grid=_pixels(lens, arguments),
        center=arguments.center or default_center(fields if arguments.fields else None),
        tol=arguments.tol,
        rays=arguments.rays,
        normalise=arguments.normalise,
        per_wavelength=arguments.per_wavelength,
        rho=arguments.rho,
        share=share,
    )
    if share.rank:
        return
    _warn(lens, fields, distances, found)
    if arguments.output:
        write_atomically(arguments.output, lambda file: save(found, distances, fields, file))
    if arguments.plot:
        _draw(arguments, lens, found, distances, fields)
    if arguments.json:
        print_json({**_document(found), "results": results(found, distances, fields)})
    else:
        _print(found, distances, fields, FIELD_UNITS[lens.fields.kind])
    for path in filter(None, (arguments.plot, arguments.output)):
        say(f"written: {path}")


def _warn(lens: Lens, fields: Tensor, distances: list[float], found: Psf) -> None:
    """Say of every field that no ray of a wavelength brings to the sensor where they end."""
    points = gauss_rings(6)[0]
    for d, distance in enumerate(distances):
        dark = found.ray_centroid[0, d].isnan()
        at = f"object at {distance:g} mm, " if len(distances) > 1 else ""
        trial = with_object_distance(lens, distance)
        of_each = dark if dark.dim() > 1 else dark[:, None].expand(-1, len(lens.wavelengths))
        warn_of_losses(trial, points, of_each, fields=fields, at=at)


def _pixels(lens: Lens, arguments: argparse.Namespace) -> Grid:
    """The pixels of --pixel and --size, or those by default."""
    return grid(lens.wavelengths.new_tensor(arguments.pixel or PIXEL), arguments.size or SIZE)


def _draw(arguments: argparse.Namespace, lens: Lens, found: Psf, distances: list[float], fields: Tensor) -> None:
    """The figure: the light itself in windows that it fills, but the pixels where they or their rays were asked for."""
    from raytrace import plot

    light = None
    if arguments.pixel is None and arguments.size is None and found.order is not None:
        places = lens.wavelengths.new_tensor(distances)
        light = close_up(lens, found, fields=fields, object_distances=places, rho=arguments.rho)
    rows = [plot.field_label(lens, field) for field in fields.T.tolist()]
    if not found.wavelengths_summed:
        rows = [f"{row}\n{1e3 * wavelength:.4g} nm" for row in rows for wavelength in found.wavelengths.tolist()]
    title = f"{lens.name or arguments.lens}: {found.model} PSF"
    plot.save(plot.psf_grid(found, distances, rows, close_up=light, log=arguments.log, title=title), arguments.plot)


def _document(found: Psf) -> dict:
    """What `raytrace psf --json` says of all kernels."""
    return {
        "model": found.model,
        "reason": found.reason or None,
        "wavelengths": numbers(found.wavelengths),
        "wavelength_weights": numbers(found.wavelength_weights),
        "wavelengths_summed": found.wavelengths_summed,
    }


def results(found: Psf, distances: list[float], fields: Tensor) -> list[dict]:
    """One entry per kernel, distance-major: what `raytrace psf --json` writes."""
    return [
        {
            "object_distance": number(distances[place[0]]),
            "field": numbers(fields[:, place[1]]),
            **({} if found.wavelengths_summed else {"wavelength": number(found.wavelengths[place[2]])}),
            **{key: numbers(getattr(found, key)[:, *place]) for key in ("centroid", "ray_centroid")},
            **{key: _square(getattr(found, key)[:, *place]) for key in ("covariance", "ray_covariance")},
            "energy": number(found.energy[place]),
            "error": number(found.error[place]),
            "residual": None if found.residual is None else number(found.residual[place]),
            "rays": found.rays,
        }
        for place in np.ndindex(found.energy.shape)
    ]


def _square(covariance: Tensor) -> list[list]:
    """[[xx, xy], [xy, yy]]; nulls where there is no light."""
    return [numbers(covariance[:2]), numbers(covariance[1:])]


def save(found: Psf, distances: list[float], fields: Tensor, file) -> None:
    """Write the arrays of `-o`: psf[distance, field, y, x], or [distance, field, wavelength, y, x], and what belongs to
    it.
    """
    np.savez_compressed(
        file,
        psf=found.kernel.detach().numpy(),
        pixel_pitch=float(found.grid.pitch),
        centre=found.grid.centre.detach().numpy(),
        energy=found.energy.detach().numpy(),
        error=found.error.detach().numpy(),
        centroid=found.centroid.detach().numpy(),
        covariance=found.covariance.detach().numpy(),
        ray_centroid=found.ray_centroid.detach().numpy(),
        ray_covariance=found.ray_covariance.detach().numpy(),
        object_distance=np.array(distances),
        field=fields.T.numpy(),
        wavelengths=found.wavelengths.numpy(),
        wavelength_weights=found.wavelength_weights.numpy(),
        wavelengths_summed=found.wavelengths_summed,
        model=found.model,
        normalised=found.normalised,
    )


def _print(found: Psf, distances: list[float], fields: Tensor, unit: str) -> None:
    pitch = 1000 * float(found.grid.pitch)
    print(f"{found.model} PSF, {found.grid.columns} × {found.grid.rows} pixels of {pitch:g} µm, {_colours(found)}")
    if found.reason:
        print(found.reason)
    waves = found.model in ("fourier", "wave")
    if waves:
        print("centroid and σ: of the light inside the window, before pixels; rays' σ: of geometric optics")
    columns = {
        "object": "mm",
        "field": unit,
        "λ": "µm",
        "centroid x": "mm",
        "centroid y": "mm",
        "σ x": "µm",
        "σ y": "µm",
    }
    columns |= {"rays' σ x": "µm", "rays' σ y": "µm", "energy": "window", "error": "est.", "rays": ""}
    widths = dict(zip(columns, (12, 9, 9, 12, 12, 9, 9, 9, 9, 8, 9, 7), strict=True))
    left_out = ({"λ"} if found.wavelengths_summed else set()) | (set() if waves else {"rays' σ x", "rays' σ y"})
    shown = [name for name in columns if name not in left_out]
    for words in (shown, (columns[name] for name in shown)):
        print(" ".join(f"{word:>{widths[name]}}" for name, word in zip(shown, words, strict=True)))
    for place in np.ndindex(found.energy.shape):
        at = (slice(None), *place)
        sigmas = [1000 * m[at][::2].clamp_min(0.0).sqrt() for m in (found.covariance, found.ray_covariance)]
        cells = {
            "object": f"{distances[place[0]]:g}",
            "field": name_of_field(fields[:, place[1]]),
            "rays": f"{found.rays}",
        }
        cells |= {"λ": "" if found.wavelengths_summed else f"{float(found.wavelengths[place[2]]):g}"}
        cells |= {
            f"centroid {a}": cell(value, ".6f") for a, value in zip("xy", found.centroid[at].tolist(), strict=True)
        }
        cells |= {f"σ {a}": cell(value, ".4f") for a, value in zip("xy", sigmas[0].tolist(), strict=True)}
        cells |= {f"rays' σ {a}": cell(value, ".4f") for a, value in zip("xy", sigmas[1].tolist(), strict=True)}
        cells |= {"energy": f"{float(found.energy[place]):.4f}", "error": cell(float(found.error[place]), ".1e")}
        print(" ".join(f"{cells[name]:>{widths[name]}}" for name in shown))
    if bool(((found.energy < 1e-6) & (found.ray_covariance > 0).any(0)).any()):
        print("kernels of energy 0: their light lies outside the window; --center chief moves it there")


def _colours(found: Psf) -> str:
    """The wavelengths in words, and what was done with them."""
    named = ", ".join(f"{wavelength:g}" for wavelength in found.wavelengths.tolist())
    if len(found.wavelengths) == 1:
        return f"at {named} µm"
    shares = ":".join(
        f"{weight:.3g}" for weight in (found.wavelength_weights / found.wavelength_weights.max()).tolist()
    )
    return f"summed over {named} µm by weights {shares}" if found.wavelengths_summed else f"each of {named} µm"


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
    wavelength = primary(lens) if arguments.wavelengths else 0.53
    distances = lens.wavelengths.new_tensor(arguments.object_distances)
    try:
        lens = common_focus(lens, arguments.focus_distance, wavelength=wavelength, start=arguments.start)
        real_image_distance(lens, distances)
    except NoImage as error:
        raise CommandError(
            f"{arguments.lens}: {error}; its focal length is {_focal_length(lens):.6g} mm, give --focus-distance and "
            "--object-distance beyond, or inf"
        ) from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)  # the estimated errors are printed
        pixels = _pixels(lens, arguments)
        found = compare_models(lens, distances, pixels=pixels)
        able = abilities(lens, pixels=pixels)
    where = f"one sensor at {float(found.sensor_distance):.7f} mm, {float(found.wavelength):g} µm"
    if arguments.plot:
        from raytrace import plot

        title = f"{lens.name or arguments.lens}: {where}"
        plot.save(plot.model_grid(found, log=arguments.log, title=title), arguments.plot)
    if arguments.json:
        print_json(_comparison(found, able))
    else:
        print(f"{where}; on the axis, {pixels.columns} × {pixels.rows} pixels of {1000 * float(pixels.pitch):g} µm")
        _print_comparison(found)
        _print_abilities(able)
    if arguments.plot:
        say(f"written: {arguments.plot}")


def _focal_length(lens: Lens) -> float:
    return float(first_order(lens).effective_focal_length)


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
        f"σ in µm (Fourier, wave: of the light inside the window), relative L1 difference from {found.models[-1]}, "
        "estimated error of the kernel (Gaussian DRT: of σ)"
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
