"""`raytrace psf` and `raytrace compare`."""

import argparse
import dataclasses
import math
import warnings

import numpy as np
import torch

from raytrace.cli.door import field_points, number, numbers, open_lens, primary, print_json, say
from raytrace.files import write_atomically
from raytrace.focus import focus
from raytrace.grid import grid
from raytrace.lens import FIELD_UNITS, Lens, SystemAperture, with_object_distance, with_sensor_distance
from raytrace.paraxial import first_order, paraxial_image_distance
from raytrace.psf import NotConverged, Psf
from raytrace.psf import psf as compute
from raytrace.pupil import gauss_rings


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


#: Rows of the comparison: what they are called, the model, and what drives it.
_ROWS = {
    "DRT": ("drt", {"rays": 256}),
    "Gaussian DRT": ("gaussian", {"tol": 1e-3}),
    "paraxial": ("paraxial", {}),
    "Fourier": ("fourier", {"tol": 1e-3}),
    "wave": ("wave", {"tol": 1e-3}),
}
_CONIC = 0.2  # by how much the conic of the strongest surface is changed
_SLOW = 16.0  # F-number at which the first dark ring is looked for
_AIRY_PIXELS = 12  # pixels in the radius of the ideal ring

#: Columns of the table: key, heading.
_SHOWN = {
    "conic": "Δ conic",
    "anisotropy": "σ long/short",
    "asymmetry": "asymmetry",
    "dark_ring": "dark ring/Airy",
    "parameters": "parameters",
    "rays": "rays",
}


def compare(arguments: argparse.Namespace) -> None:
    """The models side by side over object distance, and what each of them can represent, in numbers."""
    lens = open_lens(arguments)
    wavelength = primary(lens)[None] if arguments.wavelength else lens.wavelengths.new_tensor([0.53])
    lens = dataclasses.replace(
        lens, wavelengths=wavelength, wavelength_weights=torch.ones_like(wavelength), primary_wavelength=0
    )
    focused = with_object_distance(lens, arguments.focus_distance)
    sensor = paraxial_image_distance(lens, wavelength.new_tensor(arguments.focus_distance))
    if arguments.start == "rms":
        on_axis = wavelength.new_zeros(2, 1)
        sensor = focus(with_sensor_distance(focused, sensor), *gauss_rings(12), fields=on_axis)
    lens = with_sensor_distance(focused, sensor)
    distances = arguments.distances
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)  # the estimated errors are printed
        found = {name: _kernels(lens, name, distances) for name in _ROWS}
        table = {name: _demonstrate(lens, name) for name in _ROWS}
    if arguments.plot:
        from raytrace.plot import save as save_figure
        from raytrace.plot.psf import model_grid

        labels = [f"{name}\n({found[name].rays} rays)" if found[name].rays else f"{name}\n" for name in _ROWS]
        title = f"{lens.name or arguments.lens}: one sensor at {float(sensor):.4f} mm, {float(wavelength):g} µm"
        save_figure(model_grid(list(found.values()), distances, labels, title=title), arguments.plot)
    if arguments.json:
        document = {
            "sensor_distance": number(sensor),
            "wavelength": number(wavelength[0]),
            "models": {
                name: {**table[name], "results": results(found[name], distances, wavelength.new_zeros(2, 1))}
                for name in _ROWS
            },
        }
        print_json(document)
    else:
        print(f"one sensor at {float(sensor):.7f} mm, {float(wavelength):g} µm; fields on the axis")
        _print_comparison(found, distances)
        _print_table(table)
    if arguments.plot:
        say(f"written: {arguments.plot}")


def _kernels(lens: Lens, name: str, distances: list[float], **others) -> Psf:
    model, work = _ROWS[name]
    options = {"fields": lens.wavelengths.new_zeros(2, 1), "grid": grid(lens.wavelengths.new_tensor(0.005), 21)}
    distances = lens.wavelengths.new_tensor(distances)
    return compute(lens, model, object_distances=distances, **{**options, **work, **others})


def _demonstrate(lens: Lens, name: str) -> dict:
    """What a model can represent, one number for each key of _SHOWN.

    conic: relative L1 change of the kernel in focus when the conic of the most curved surface changes by _CONIC;
    anisotropy: the longer over the shorter σ of the kernel of the largest field; asymmetry: its relative L1 difference
    from itself turned by 180° about the centroid of the light; dark_ring: radius of the first dark ring at F/16, in
    radii of the Airy disc; parameters: how many of the lens's numbers move the kernel; rays: traced in focus.
    """
    distance = [float(lens.surfaces[0].thickness)]
    found = _kernels(lens, name, distance)
    changed = _kernels(_with_conic(lens), name, distance)
    corner = torch.stack([lens.fields.x, lens.fields.y])[:, torch.hypot(lens.fields.x, lens.fields.y).argmax()]
    upright = torch.stack([torch.zeros_like(corner[0]), torch.hypot(*corner)])[:, None]
    # Ideal lenses have no distortion: their light lands beside that of the real one.
    seen = "paraxial" if name in ("paraxial", "Fourier") else "Gaussian DRT"
    centre = _kernels(lens, seen, distance, fields=upright).centroid[:, 0, 0].detach()
    pixels = dataclasses.replace(found.grid, centre=centre)
    away = _kernels(lens, name, distance, fields=upright, grid=pixels)
    kernel = away.kernel[0, 0]
    short, long = torch.linalg.eigvalsh(away.covariance[:, 0, 0][[0, 1, 1, 2]].reshape(2, 2)).clamp_min(0).tolist()
    total = float(found.kernel.sum())
    return {
        "conic": float((changed.kernel - found.kernel).abs().sum()) / total,
        "anisotropy": math.sqrt(long / short) if short > 1e-18 else 1.0,
        "asymmetry": float((kernel - kernel.flip(0, 1)).abs().sum() / kernel.sum()),
        "dark_ring": _dark_ring(lens, name),
        "parameters": _parameters(lens, name),
        "rays": found.rays,
    }


def _most_curved(lens: Lens) -> int:
    strength = [0.0 if s.curvature is None else abs(float(s.curvature)) for s in lens.surfaces]
    return strength.index(max(strength))


def _with_conic(lens: Lens) -> Lens:
    surfaces, k = list(lens.surfaces), _most_curved(lens)
    conic = torch.zeros_like(surfaces[k].thickness) if surfaces[k].conic is None else surfaces[k].conic
    surfaces[k] = dataclasses.replace(surfaces[k], conic=conic + _CONIC)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def _dark_ring(lens: Lens, name: str) -> float | None:
    """First minimum along x of the kernel of the slowed lens, below a twentieth of the peak; None without one."""
    slowed = dataclasses.replace(lens, aperture=SystemAperture("image_f_number", lens.wavelengths.new_tensor(_SLOW)))
    airy = 1.2197e-3 * float(lens.wavelengths) * float(first_order(slowed).working_f_number)
    pixels = grid(lens.wavelengths.new_tensor(airy / _AIRY_PIXELS), (1, 4 * _AIRY_PIXELS + 1))
    found = _kernels(slowed, name, [float(lens.surfaces[0].thickness)], grid=pixels)
    line = found.kernel[0, 0, 0, 2 * _AIRY_PIXELS :].tolist()
    for i in range(1, len(line) - 1):
        a, b, c = line[i - 1 : i + 2]
        # A geometric kernel falls to 0 and stays there; a ring rises again.
        if a > b < c and b < 0.05 * line[0] and max(line[i:]) > 1e-3 * line[0]:
            return (i + 0.5 * (a - c) / (a - 2 * b + c)) / _AIRY_PIXELS
    return None


def _parameters(lens: Lens, name: str) -> int:
    """How many curvatures, conics and thicknesses, object and sensor distance among them, move the kernel."""
    surfaces, numbers = list(lens.surfaces), []
    for k, surface in enumerate(surfaces[:-1]):
        changes = {"thickness": surface.thickness}
        if surface.curvature is not None and float(surface.curvature) != 0:
            conic = torch.zeros_like(surface.thickness) if surface.conic is None else surface.conic
            changes |= {"curvature": surface.curvature, "conic": conic}
        changes = {key: value.detach().clone().requires_grad_() for key, value in changes.items()}
        numbers += [changes[key] for key in changes]
        surfaces[k] = dataclasses.replace(surface, **changes)
    lens = dataclasses.replace(lens, surfaces=tuple(surfaces))
    model, work = _ROWS[name]
    near = 0.5 * surfaces[0].thickness
    pixels = grid(lens.wavelengths.new_tensor(0.02), 5)
    found = compute(
        lens,
        model,
        fields=lens.wavelengths.new_zeros(2, 1),
        object_distances=near[None],
        grid=pixels,
        **({"tol": 0.05} if "tol" in work else work),
    )
    gradients = torch.autograd.grad(found.kernel.square().sum(), numbers, allow_unused=True)
    return sum(gradient is not None and float(gradient) != 0 for gradient in gradients)


def _print_comparison(found: dict[str, Psf], distances: list[float]) -> None:
    print("σ in µm, relative L1 difference from the wave PSF, and estimated error of the kernel (Gaussian DRT: of σ)")
    print(f"{'':>14} " + " ".join(f"{distance / 1000:>22g} m" for distance in distances))
    best = found["wave"].kernel
    for name, one in found.items():
        difference = (one.kernel - best).abs().sum((-2, -1)) / best.sum((-2, -1))
        cells = [
            f"{1000 * math.sqrt(max(0.0, float(one.covariance[2, d, 0]))):>8.3f} {float(difference[d, 0]):>6.3f} "
            f"{float(one.error[d, 0]):>8.1e}"
            for d in range(len(distances))
        ]
        print(f"{name:>14} " + " ".join(cells))


def _print_table(table: dict[str, dict]) -> None:
    print("what each model can represent: see `raytrace compare --help`")
    print(f"{'':>14} " + " ".join(f"{heading:>15}" for heading in _SHOWN.values()))
    for name, row in table.items():
        print(f"{name:>14} " + " ".join(f"{_cell(row[key]):>15}" for key in _SHOWN))


def _cell(value: float | None) -> str:
    if value is None:
        return "none"
    if isinstance(value, int):
        return str(value)
    return "0" if abs(value) < 1e-12 else f"{value:.4f}"
