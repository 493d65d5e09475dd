"""A study of colours restored together: lenses for a joint Wiener filter of three channels against filters of each.

    python docs/experiments/codesign_colours.py cooke_triplet double_gauss --data DIR -o FOLDER --docs docs

Air spaces, model glasses and the sensor of a lens are optimised by steps of second order for the mean square error in
closed form, behind the best filter of each channel or behind the best joint filter: from the file's lens, from a lens
with axial colour, and from the lens that the other criterion found; the lowest end counts. Both lenses are judged
with DRT PSFs, behind both filters, on pictures that neither has seen. Every seed has its own split of the pictures and
its own noise; differences are paired by seed. A second call resumes, and computes what is missing.
"""

import argparse
import functools
import itertools
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from codesign_as_built import interval, save
from torch import Tensor

import raytrace as rt
from raytrace.files import write_json
from raytrace.imaging.image import add_noise, blur, linearised, transfer_functions
from raytrace.imaging.lens_steps import LensSteps
from raytrace.imaging.pictures import Pictures, crop, digest, files, read, split
from raytrace.imaging.restoration import (
    cross_spectrum,
    depth_invariant_wiener,
    joint_kernel_error,
    joint_wiener,
    kernel_error,
    mean_square_error,
    restore,
    restore_jointly,
)
from raytrace.imaging.training import read_json
from raytrace.maths.sampling import grid
from raytrace.plotting.style import FIELD_COLOURS, GREY, INK, new_figure
from raytrace.psf_models import model_of
from raytrace.system.lens import Lens
from raytrace.tracing.compiled import prepare

#: Variables of each lens, of which the last holds the focal length, and the Abbe numbers of flints.
VARY = {
    "cooke_triplet": ("thickness:2,4,5 index:1,3,6 abbe_number:1,3,6 sensor curvature:7", ("abbe_number_3",)),
    "double_gauss": (
        "thickness:2,5,6,9 index:1,3,4,7,8,10 abbe_number:1,3,4,7,8,10 sensor curvature:11",
        ("abbe_number_4", "abbe_number_7"),
    ),
}
WAVELENGTHS = (0.464, 0.532, 0.607)  # µm, the peaks of blue, green and red of the sensor
SENSOR = rt.Sensor((24.0, 16.0), (4800, 3200), response="rgb")
NOISE = 0.01
#: Object distances in mm: one, or a range whose images are spread over ±0.2 mm.
SCENES = {"16 to 48 m": (16e3, 48e3), "24 m": (24e3, 24e3)}
#: Places along +y of the sensor, relative to half of its diagonal.
FIELDS = {"axis": (0.0,), "field": (0.0, 0.7, 1.0)}
CORRELATIONS = ("0", "0.9", "0.97")
#: Groups of runs, in this order: fields, scene, criteria, seeds.
RUNS = (
    ("axis", "16 to 48 m", ("apart", "joint"), 5),
    ("axis", "24 m", ("apart", "joint"), 5),
    ("axis", "16 to 48 m", CORRELATIONS, 1),
    ("field", "16 to 48 m", ("apart", "joint"), 3),
)
BANDS = (0.0, 0.03, 0.06, 0.12, 0.25, 0.5)  # of frequency, 1/pixel

_DEPTHS, _TESTED = 4, 5  # of an optimisation and of its test
_SIZE, _PERIOD = 41, 64  # pixels of a kernel and of the period of closed forms
_PATCH, _FILTER, _MARGIN = 96, 128, 8  # pixels of a recorded patch, of the filter of its extension, and left out
_CROPS, _TESTS = 4, 4  # of every picture of training and of test
_COLOUR = 0.4  # mm between the foci of blue and red of the second start
_INDEX, _ABBE, _ABBES = 0.05, 15.0, (20.0, 85.0)  # changes of model glasses, and bounds
_GAUSSIAN, _DRT = 6, 2  # orders
_AXIAL, _SHIFTS = (0.0, 0.1, 0.2, 0.3), 0.05  # specified axial colour and steps of the sensor distance, mm
_WIDE, _WIDE_SIZE = 96, 61  # period and kernels of specified axial colour


def distances(scene: str, count: int) -> Tensor:
    """Object distances (Z,) mm, evenly spaced in 1/z: the centres of equal parts of the range."""
    near, far = SCENES[scene]
    if near == far:
        return torch.tensor([near], dtype=torch.float64)
    share = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return 1 / (1 / far + (1 / near - 1 / far) * share)


def field_points(lens: Lens, fields: str) -> Tensor:
    """Field points (2, N) of the chief rays that meet the sensor at its places."""
    y = torch.tensor(FIELDS[fields], dtype=torch.float64) * SENSOR.half_diagonal
    return SENSOR.fields(lens, torch.stack([torch.zeros_like(y), y]))


def kernels(lens: Lens, points: Tensor, scene: str, *, model: str = "gaussian", depths: int = _DEPTHS) -> Tensor:
    """Kernels (Z, N, 3, h, w) of depths, field points (2, N) and channels, about the chief ray of green."""
    order = {"gaussian": _GAUSSIAN, "drt": _DRT}[model]
    window = grid(lens.wavelengths.new_tensor(SENSOR.pitch), _SIZE)
    how = {"normalise": "window", "center": "chief", "grid": window, "per_wavelength": True}
    at = distances(scene, depths)
    found = rt.psf(lens, model_of(model, order=order), fields=points, object_distances=at, **how).kernel
    return torch.einsum("cw,znwij->zncij", SENSOR.weights(lens.wavelengths), found)


# -- pictures


def patches(pictures: Pictures, size: int, crops: int, epoch: int = 0) -> Tensor:
    """Crops (B, 3, size, size) of every picture, linear in light."""
    count = crops * len(pictures)
    levels = np.stack([crop(pictures, i, epoch=epoch, size=size, crops=crops) for i in range(count)])
    levels = torch.as_tensor(np.round(255 * levels).astype(np.uint8)).permute(0, 3, 1, 2)
    return linearised(levels).to(torch.float64)


def synthetic(spectrum: Tensor, correlation: float) -> Tensor:
    """The cross spectra (3, 3, rows, columns) of channels of equal power, that of all of them, equally correlated."""
    power = spectrum.real.diagonal().mean(-1)
    matrix = correlation + (1 - correlation) * torch.eye(3, dtype=torch.float64)
    return matrix[:, :, None, None] * power


def correlations(spectrum: Tensor) -> list[list[float]]:
    """Correlation of red and green, green and blue, red and blue in each band of frequency."""
    lines = [torch.fft.fftfreq(n, dtype=torch.float64) for n in spectrum.shape[-2:]]
    frequency = torch.hypot(lines[0][:, None], lines[1])
    found = []
    for low, high in itertools.pairwise(BANDS):
        inside = (frequency > low) & (frequency <= high)
        sums = spectrum.real[..., inside].sum(-1)
        found.append([float(sums[a, b] / (sums[a, a] * sums[b, b]).sqrt()) for a, b in ((0, 1), (1, 2), (0, 2))])
    return found


# -- optimisation


@functools.cache
def lens_of(name: str) -> Lens:
    """The lens in best focus for the middle of the range, at the wavelengths of the study; green is primary."""
    lens = rt.read_lens(name).at(
        wavelengths=WAVELENGTHS, wavelength_weights=[1.0, 1.0, 1.0], primary_wavelength=2, object_distance=24e3
    )
    return rt.focus(lens, fields=[0]).lens


def axial_colour(lens: Lens) -> float:
    """Back focal distance of red less that of blue, mm."""
    ends = [rt.first_order(lens.at(wavelengths=[WAVELENGTHS[at]])).back_focal_distance for at in (-1, 0)]
    return float((ends[0] - ends[1]).detach())


def variables_of(name: str, lens: Lens) -> rt.Variables:
    """Air spaces, model glasses, sensor; the last curvature holds the focal length."""
    vary, _ = VARY[name]
    numbers, bounds = rt.Variables(lens, vary, hold="efl").numbers(), {}
    for variable, start in numbers.items():
        if variable.startswith("index"):
            bounds[variable] = (start - _INDEX, start + _INDEX)
        elif variable.startswith("abbe"):
            bounds[variable] = (max(start - _ABBE, _ABBES[0]), min(start + _ABBE, _ABBES[1]))
    return rt.Variables(lens, vary, hold="efl", bounds=bounds)


def with_colour(name: str, variables: rt.Variables) -> None:
    """Set the Abbe numbers of the flints for an axial colour of `_COLOUR`, as nearly as their bounds allow."""
    flints = [variable for variable in variables.variables if variable.name in VARY[name][1]]

    def change(number: float) -> None:
        for flint in flints:
            low, high = variables.bounds[flint.name]
            moved = min(max(flint.start + number, low), high)
            variables.get_parameter(flint.name).fill_((moved - flint.start) / flint.unit)

    with torch.no_grad():
        colours = []
        for number in (0.0, 2.0):
            change(number)
            colours.append(axial_colour(variables()))
        change(2 * (_COLOUR - colours[0]) / (colours[1] - colours[0]))  # nearly linear


def closed_form(kernels: Tensor, spectrum: Tensor, filters: str) -> Tensor:
    """Mean square error (N, 3) behind the best "joint" filter, or the best ones of each channel, "apart"."""
    if filters == "joint":
        return joint_kernel_error(kernels, spectrum, NOISE)
    return kernel_error(kernels, spectrum.real.diagonal().movedim(-1, 0), NOISE)


def descended(
    name: str,
    fields: str,
    scene: str,
    loss: Callable[[Tensor], Tensor],
    cycles: int,
    start: str,
    numbers: dict[str, float] | None = None,
) -> dict:
    """The end of a descent of second order. start: "file", "colour", or "other", the lens of the given numbers."""
    lens = lens_of(name)
    points, variables = field_points(lens, fields), variables_of(name, lens)
    if start == "colour":
        with_colour(name, variables)
    if numbers is not None:
        set_numbers(variables, numbers)
    values = (
        LensSteps(variables).minimise(lambda: 1e3 * loss(kernels(variables(), points, scene)), cycles=cycles).values
    )
    end = {"value": values[-1], "evaluations": len(values), "numbers": variables.numbers()}
    return {"start": start, **end, "axial_colour": axial_colour(variables())}


def optimised(name: str, fields: str, scene: str, loss: Callable[[Tensor], Tensor], cycles: int) -> dict:
    """The lower end of two descents: from the lens of the file, and from one with axial colour."""
    ends = [descended(name, fields, scene, loss, cycles, start) for start in ("file", "colour")]
    best = min(ends, key=lambda end: end["value"])
    return {**best, "starts": {end["start"]: (end["value"], end["axial_colour"]) for end in ends}}


def set_numbers(variables: rt.Variables, numbers: dict[str, float]) -> None:
    with torch.no_grad():
        for variable in variables.variables:
            variables.get_parameter(variable.name).fill_((numbers[variable.name] - variable.start) / variable.unit)


@torch.no_grad()
def rebuilt(name: str, numbers: dict[str, float]) -> Lens:
    """The lens of stored numbers."""
    variables = variables_of(name, lens_of(name))
    set_numbers(variables, numbers)
    return variables()


# -- test


@torch.no_grad()
def restored(lens: Lens, fields: str, scene: str, spectrum: Tensor, unseen: Tensor, seed: int) -> dict[str, list]:
    """Mean square errors (fields, depths, channels) of unseen patches with DRT PSFs, behind both filters."""
    kernel = kernels(lens, field_points(lens, fields), scene, model="drt", depths=_TESTED)
    transfer = transfer_functions(kernel, _FILTER)
    apart = depth_invariant_wiener(transfer, spectrum.real.diagonal().movedim(-1, 0), NOISE)
    joint = joint_wiener(transfer, spectrum, NOISE)
    truth = unseen[..., _SIZE // 2 : -(_SIZE // 2), _SIZE // 2 : -(_SIZE // 2)]
    found = {"apart": [], "joint": []}
    generator = torch.Generator().manual_seed(seed)
    for field in range(kernel.shape[1]):
        for filters in found.values():
            filters.append([])
        for depth in range(len(kernel)):
            image = add_noise(blur(unseen, kernel[depth, field], boundary="valid"), NOISE, generator=generator)
            estimates = {
                "apart": restore(image, apart[field], boundary="taper"),
                "joint": restore_jointly(image, joint[field], boundary="taper"),
            }
            for filters, estimate in estimates.items():
                found[filters][-1].append(mean_square_error(estimate, truth, margin=_MARGIN).mean(0).tolist())
    return found


def run(
    name: str,
    fields: str,
    scene: str,
    criterion: str,
    seed: int,
    pictures: Pictures,
    folder: Path,
    cycles: int,
    other: dict | None = None,
) -> dict:
    """A lens optimised and tested, or its stored results. criterion: "apart", "joint", or a correlation.

    other: the results of the other criterion, whose lens is a third start; the lowest end of the three is tested.
    """
    path = folder / f"{name}_{fields}_{scene.replace(' ', '_')}_{criterion}_{seed}.json"
    stored = read_json(path) if path.exists() else None
    if stored and (other is None or "other" in stored["starts"]):
        return stored
    start = time.perf_counter()
    of_training, of_test = split(pictures, seed=seed)
    measured = cross_spectrum(patches(of_training, _PERIOD, _CROPS))
    controlled = criterion not in ("apart", "joint")
    spectrum = synthetic(measured, float(criterion)) if controlled else measured
    filters = criterion if criterion == "apart" else "joint"

    def loss(kernel: Tensor) -> Tensor:
        return closed_form(kernel, spectrum, filters).mean()

    document = stored or optimised(name, fields, scene, loss, cycles)
    if other is not None:
        end = descended(name, fields, scene, loss, cycles, "other", other["numbers"])
        starts = {**document["starts"], "other": (end["value"], end["axial_colour"])}
        lower = end["value"] < document["value"]
        document = {**document, **(end if lower else {}), "starts": starts}
    lens = rebuilt(name, document["numbers"])
    seconds = time.perf_counter() - start + (stored["seconds"] if stored else 0.0)
    document |= {"axial_colour": axial_colour(lens), "seconds": seconds}
    if controlled:
        with torch.no_grad():
            kernel = kernels(lens, field_points(lens, fields), scene, model="drt", depths=_TESTED)
            errors = [closed_form(kernel, synthetic(measured, float(r)), "joint").mean() for r in CORRELATIONS]
            document["drt"] = {r: float(error) for r, error in zip(CORRELATIONS, errors, strict=True)}
    else:
        wide = cross_spectrum(patches(of_training, _FILTER, _CROPS))
        unseen = patches(of_test, _PATCH + _SIZE - 1, _TESTS, epoch=1)
        document["errors"] = restored(lens, fields, scene, wide, unseen, seed)
        document["correlations"] = correlations(measured)
    write_json(path, document)
    print(f"{path.stem}: {document['value']:.4f}, {document['axial_colour']:+.3f} mm, {seconds:.0f} s", flush=True)
    return document


# -- axial colour specified


@torch.no_grad()
def specified(name: str, pictures: Pictures) -> list[dict]:
    """Errors in closed form on the axis of a lens without dispersion whose channels are focused apart.

    Red, green and blue have sensor distances that differ by the axial colour; their common shift is the best one.
    """
    measured = cross_spectrum(patches(pictures, _WIDE, _CROPS))
    spectra = {r: synthetic(measured, float(r)) for r in CORRELATIONS} | {"pictures": measured}
    lens = rt.focus(rt.read_lens(name).at(wavelengths=[WAVELENGTHS[1]], object_distance=24e3), fields=[0]).lens
    rows, steps = [], round(max(_AXIAL) / _SHIFTS)
    window = grid(lens.wavelengths.new_tensor(SENSOR.pitch), _WIDE_SIZE)
    for scene in SCENES:
        at, model = distances(scene, _TESTED), model_of("drt", order=_DRT)
        how = {"fields": [0], "object_distances": at, "normalise": "window", "grid": window, "center": "chief"}
        shifts = _SHIFTS * torch.arange(-2 * steps, 2 * steps + 1, dtype=torch.float64)
        focus = lens.surfaces[-2].thickness
        kernel = [rt.psf(lens.at(sensor_distance=focus + shift), model, **how).kernel[:, 0] for shift in shifts]
        for axial in _AXIAL:
            apart = round(axial / _SHIFTS)
            middles = range(steps, 3 * steps + 1, 2)
            sets = [torch.stack([kernel[m - apart], kernel[m], kernel[m + apart]], 1) for m in middles]
            for spectrum, S in spectra.items():
                for filters in ("joint",) if axial else ("joint", "apart"):
                    errors = [float(closed_form(one, S, filters).mean()) for one in sets]
                    row = {"scene": scene, "axial_colour": axial, "spectrum": spectrum, "filters": filters}
                    rows.append({**row, "mse": min(errors)})
    return rows


# -- page


def error_of(document: dict, filters: str) -> float:
    """Mean over fields, depths and channels."""
    return float(np.mean(document["errors"][filters]))


def comparisons(found: dict[tuple, dict], names: list[str]) -> list[dict]:
    """By lens, fields, scene and spectrum: errors by seed, and the difference of the joint design in percent.

    A difference is relative to the lens for filters apart behind the joint filter; of synthetic spectra that lens is
    the one of no correlation.
    """
    rows = []
    for name in names:
        for fields, scene, criterion in ((*group, one) for *group, criteria, _ in RUNS for one in criteria[1:]):
            before = "apart" if criterion == "joint" else "0"
            keys = [(fields, scene, one) for one in (before, criterion)]
            seeds = sorted(seed for n, *key, seed in found if n == name and tuple(key) == keys[1])
            pairs = [[found.get((name, *key, seed)) for key in keys] for seed in seeds]
            pairs = [pair for pair in pairs if None not in pair]
            if not pairs:
                continue
            if criterion == "joint":
                errors = [(error_of(a, "apart"), error_of(a, "joint"), error_of(j, "joint")) for a, j in pairs]
            else:
                errors = [(a["drt"]["0"], a["drt"][criterion], j["drt"][criterion]) for a, j in pairs]
            row = {"lens": name, "fields": fields, "scene": scene, "seeds": len(pairs)}
            rows.append(
                {
                    **row,
                    "spectrum": "pictures" if criterion == "joint" else f"correlation {criterion}",
                    "errors": errors,
                    "difference": [100 * (j / a - 1) for _, a, j in errors],
                    "to_apart": [100 * (j / a - 1) for a, _, j in errors],
                    "colour": [(a["axial_colour"], j["axial_colour"]) for a, j in pairs],
                }
            )
    return rows


def table(rows: list[dict]) -> str:
    """The table of the page, which quotes other spectra in a sentence."""
    lines = [
        "| lens | fields | objects at | spectra | lens apart, joint filter, 10⁻⁴ | lens and filter joint | "
        "difference of the joint lens, % | axial colour (modulus), mm: apart | joint |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        errors, colour = 1e4 * np.mean(row["errors"], 0), np.mean(np.abs(row["colour"]), 0)
        mean, width = interval(row["difference"])
        change = f"{mean:+.1f} ± {width:.1f}" if row["seeds"] > 1 else f"{mean:+.1f}"
        words = [row["lens"], row["fields"], row["scene"], row["spectrum"], *(f"{error:.3f}" for error in errors[1:])]
        words += [change, *(f"{one:.2f}" for one in colour)]
        lines.append("| " + " | ".join(words) + " |")
    return "\n".join(lines)


def table_specified(rows: list[dict]) -> str:
    """Errors behind the joint filter relative to no axial colour, in percent."""
    lines = ["| objects at | spectra | " + " | ".join(f"±{axial:g} mm" for axial in _AXIAL) + " |"]
    lines.append("|---" * (2 + len(_AXIAL)) + "|")
    for scene, spectrum in dict.fromkeys((row["scene"], row["spectrum"]) for row in rows):
        of = [r["mse"] for r in rows if (r["scene"], r["spectrum"], r["filters"]) == (scene, spectrum, "joint")]
        words = [f"{1e4 * of[0]:.3f} · 10⁻⁴", *(f"{100 * (one / of[0] - 1):+.0f} %" for one in of[1:])]
        name = spectrum if spectrum == "pictures" else f"correlation {spectrum}"
        lines.append(f"| {scene} | {name} | " + " | ".join(words) + " |")
    return "\n".join(lines)


def figure(rows: list[dict], given: list[dict]):
    """Errors against the specified axial colour, and differences of the optimised lenses with their intervals."""
    drawn = new_figure(8.0, 3.4)
    left, right = drawn.subplots(1, 2)
    for spectrum, colour in zip((*CORRELATIONS, "pictures"), FIELD_COLOURS, strict=False):
        of = [r["mse"] for r in given if (r["scene"], r["spectrum"], r["filters"]) == ("16 to 48 m", spectrum, "joint")]
        name = spectrum if spectrum == "pictures" else f"correlation {spectrum}"
        left.plot(_AXIAL, [100 * (one / of[0] - 1) for one in of], "o-", ms=4, color=colour, label=name)
    left.set(xlabel="axial colour of red and blue, ± mm", ylabel="mean square error, change in %")
    left.legend(fontsize=8)
    names = []
    for number, row in enumerate(rows):
        mean, width = interval(row["difference"])
        right.plot(row["difference"], [-number + 0.15] * len(row["difference"]), "o", ms=3, color=GREY)
        right.errorbar(
            mean,
            -number - 0.1,
            xerr=width if row["seeds"] > 1 else None,
            fmt="s",
            capsize=3,
            ms=4,
            color=FIELD_COLOURS[0],
        )
        names.append(f"{row['lens'].replace('_', ' ')}, {row['fields']}, {row['scene']},\n{row['spectrum']}")
    right.set_yticks([-number for number in range(len(rows))], names, fontsize=6)
    right.set(xlabel="joint design, change of the mean square error, %")
    for panel, line in ((left, left.axhline), (right, right.axvline)):
        line(0, color=INK, linewidth=0.8, linestyle=":")
        panel.tick_params(labelsize=8)
    return drawn


def lines_of(found: dict[tuple, dict]) -> list[dict]:
    """Rows of the CSV file: a lens, its axial colour and errors, and the end of each descent, in closed form."""
    rows = []
    for (name, fields, scene, criterion, seed), one in found.items():
        row = {"lens": name, "fields": fields, "scene": scene, "criterion": criterion, "seed": seed}
        row |= {"start": one["start"], "evaluations": one["evaluations"], "axial_colour_mm": one["axial_colour"]}
        of = {f"mse_{name}": error_of(one, name) for name in one["errors"]} if "errors" in one else {}
        of |= {f"mse_correlation_{name}": error for name, error in one.get("drt", {}).items()}
        names = ("mse_apart", "mse_joint", *(f"mse_correlation_{r}" for r in CORRELATIONS))
        row |= {name: of.get(name, "") for name in names}
        for start in ("file", "colour", "other"):
            value, colour = one["starts"].get(start, ("", ""))
            row |= {f"mse_from_{start}": value and 1e-3 * value, f"axial_colour_from_{start}_mm": colour}
        rows.append(row)
    return rows


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lenses", nargs="+", choices=[*VARY])
    parser.add_argument("--data", required=True, help="folder of colour pictures")
    parser.add_argument("-o", dest="folder", type=Path, required=True, help="folder of the results")
    parser.add_argument("--docs", type=Path, help="folder of documentation, for the table and the figure")
    parser.add_argument("--seeds", type=int, default=5, help="of a group, at most")
    parser.add_argument("--cycles", type=int, default=60, help="of a descent, at most")
    parser.add_argument("--groups", type=int, default=len(RUNS), help="the first groups of runs alone")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    chosen = parser.parse_args(words)
    torch.set_num_threads(1)
    prepare()
    warnings.simplefilter("ignore")  # of lost rays in descents
    pictures = read(files(chosen.data), least=_PATCH + _SIZE - 1, colour=True)
    print(digest(pictures.samples), flush=True)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    stored = chosen.folder / "specified.json"
    if not stored.exists():
        write_json(stored, {"rows": specified("double_gauss", pictures)})
    given, found = read_json(stored)["rows"], {}
    print(table_specified(given), flush=True)
    for fields, scene, criteria, seeds in RUNS[: chosen.groups]:
        for name, seed in itertools.product(chosen.lenses, range(min(seeds, chosen.seeds))):
            how = {"pictures": pictures, "folder": chosen.folder, "cycles": chosen.cycles}
            ends = {one: run(name, fields, scene, one, seed, **how) for one in criteria}
            if criteria != CORRELATIONS:
                others = {"apart": ends["joint"], "joint": ends["apart"]}
                ends = {one: run(name, fields, scene, one, seed, **how, other=others[one]) for one in criteria}
            found |= {(name, fields, scene, one, seed): end for one, end in ends.items()}
        print(table(comparisons(found, chosen.lenses)), flush=True)
    rows = comparisons(found, chosen.lenses)
    if chosen.docs:
        save(lines_of(found), figure(rows, given), chosen.docs / "codesign_colours")
        print(np.mean([one["correlations"] for one in found.values() if "correlations" in one], 0))


if __name__ == "__main__":
    main()
