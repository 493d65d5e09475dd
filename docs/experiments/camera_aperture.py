"""Which aperture wins at equal light: F/numbers with shot and read noise at a fixed exposure, by five PSF models.

    python docs/experiments/camera_aperture.py --data DIR -o FOLDER --docs docs
    python docs/experiments/camera_aperture.py --table docs/camera_aperture.csv    # table and counts of stored rows

Scene and exposure time are fixed: the electrons of a pixel are proportional to the solid angle of its beam, which the
semi-diameters of the file clip. At every F/number each model moves the sensor to the least mean square error of
depth-invariant Wiener filters, one for each field. Pictures are blurred by DRT kernels and restored. A second call
computes what is missing.
"""

import argparse
import csv
import dataclasses
import functools
import math
import warnings
from pathlib import Path

import numpy as np
import torch
from scipy.stats import t as student
from torch import Tensor

import raytrace as rt
from raytrace.files import write_json
from raytrace.imaging.image import add_noise, blur, count_electrons, linearised, transfer_functions
from raytrace.imaging.pictures import draws, files, read, split
from raytrace.imaging.restoration import depth_invariant_wiener, kernel_error, mean_square_error, power_spectrum
from raytrace.imaging.training import read_json
from raytrace.plotting.style import FIELD_COLOURS, GREY, new_figure
from raytrace.psf_models import model_of
from raytrace.system.lens import Lens
from raytrace.system.surface import Aperture
from raytrace.tracing.focus import paraxial_sensor
from raytrace.tracing.launch import UnfilledStop

#: F/numbers and fields in degrees of each lens; wavelengths: the primary one.
LENSES = {
    "double_gauss": ((2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0), (0.0, 7.0, 10.0)),
    "cooke_triplet": ((3.5, 4.0, 5.6, 8.0, 11.0, 16.0), (0.0, 8.4, 11.9)),
}
RANGES = {"narrow": (28e3, 33e3), "wide": (20e3, 60e3)}  # object distances, mm
LIGHTS = {"bright": 10_000.0, "dark": 100.0}  # electrons of white on the axis of an ideal F/4
READ_NOISE = 3.0  # electrons
PITCH, SIZE, PATCH = 0.006, 41, 128  # mm, pixels of the PSF and of a patch
DEPTHS, SENSORS, PATCHES, SEEDS = 5, 9, 12, 5
ORDERS = {"paraxial": 0, "fourier": -1, "gaussian": 4, "drt": 0, "wave": -1}
FIRST_ORDER = "paraxial", "fourier"
WAVES_FROM = 2.8  # F/number from which the PSFs of waves are computed off the axis
LEVEL = 0.1  # dB of PSNR, difference up to which two F/numbers are level


def clipped(name: str) -> Lens:
    """The lens at its primary wavelength, clipped by the semi-diameters of all surfaces but the stop."""
    lens = rt.read_lens(name)
    lens = lens.at(wavelengths=[float(lens.primary)])
    for number, surface in enumerate(lens.surfaces[1:-1], 1):
        if number != lens.stop:
            lens = lens.replace(number, apertures=(Aperture("circular", (0.0, surface.semi_diameter)),))
    return dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, vignetting=None))


def kernels_of(lens: Lens, model: str, fields: tuple[float, ...], distances: Tensor) -> Tensor:
    """PSFs (F, D, rows, columns) about the chief ray, of sum 1; of first-order models alike for all fields."""
    fields = (0.0,) if model in FIRST_ORDER else fields
    one = model_of(model, order=ORDERS[model])
    found = [
        rt.psf(lens, one, fields=[field], object_distances=distances, pixel=PITCH, size=SIZE, center="chief",
               normalise="window").kernel[:, 0] for field in fields
    ]  # fmt: skip
    return torch.stack(found)


def judging(lens: Lens, fields: tuple[float, ...], distances: Tensor) -> Tensor:
    """PSFs of waves, of DRT off the axis at F/numbers below `WAVES_FROM`."""
    if float(rt.first_order(lens).f_number) > 0.99 * WAVES_FROM:
        return kernels_of(lens, "wave", fields, distances)
    axis, others = fields[:1], fields[1:]
    return torch.cat([kernels_of(lens, "wave", axis, distances), kernels_of(lens, "drt", others, distances)])


def noise_of(electrons: Tensor, mean: float) -> Tensor:
    """Standard deviation (F,) of levels, shot noise at the mean level and read noise."""
    return (electrons * mean + READ_NOISE**2).sqrt() / electrons


def error_of(kernels: Tensor, spectrum: Tensor, sigma: Tensor) -> Tensor:
    """Expected mean square error (F,) behind depth-invariant Wiener filters of kernels (F or 1, D, h, w)."""
    each = kernels.expand(len(sigma), *kernels.shape[1:])
    return torch.stack([kernel_error(one, spectrum, s) for one, s in zip(each, sigma, strict=True)])


def best_sensors(
    lens: Lens, model: str, fields: tuple[float, ...], distances: Tensor, spectrum: Tensor, noise: dict[str, Tensor]
) -> dict[str, float]:
    """Sensor distance, mm, of least error for every light: of a grid, and the parabola through its neighbours."""
    ends = paraxial_sensor(lens, distances)
    low = float(ends.min()) if model in FIRST_ORDER else rms_focus(lens, float(distances.max())) - 0.1
    grid = np.linspace(low, float(ends.max()), SENSORS)
    kernels = [kernels_of(lens.at(sensor_distance=s), model, fields, distances) for s in grid]
    best = {}
    for light, sigma in noise.items():
        found = [float(error_of(one, spectrum, sigma).mean()) for one in kernels]
        least = min(max(int(np.argmin(found)), 1), SENSORS - 2)
        square, slope, _ = np.polyfit(grid[least - 1 : least + 2], found[least - 1 : least + 2], 2)
        bottom = -slope / (2 * square) if square > 0 else grid[int(np.argmin(found))]
        best[light] = float(np.clip(bottom, grid[0], grid[-1]))
    return best


def rms_focus(lens: Lens, distance: float) -> float:
    return float(rt.focus(lens.at(object_distance=distance)).lens.surfaces[-2].thickness)


def patches_of(pictures: list[Tensor], count: int, *key: int) -> Tensor:
    """Random patches (count, PATCH, PATCH) of light, functions of the key."""
    random, found = draws(*key), []
    for _ in range(count):
        picture = pictures[int(random.integers(len(pictures)))]
        row, column = (int(random.integers(side - PATCH + 1)) for side in picture.shape)
        found.append(picture[row : row + PATCH, column : column + PATCH])
    return torch.stack(found)


def restored(kernels: Tensor, spectrum: Tensor, sigma: Tensor, electrons: Tensor, pictures: list[Tensor], seed: int):
    """Mean square error of restored pictures, mean over fields, depths and patches; the same patches and draws of noise
    for all F/numbers."""
    patches, found = patches_of(pictures, PATCHES, seed, 0), []
    for field, (each, s, n) in enumerate(zip(kernels, sigma, electrons, strict=True)):
        filter = depth_invariant_wiener(transfer_functions(each, PATCH), spectrum, s)
        generator = torch.Generator().manual_seed(int(draws(seed, field).integers(2**62)))
        for kernel in each:
            image = blur(patches, kernel, boundary="reflect")
            image = count_electrons(image.clamp_min(0), float(n), generator=generator)
            image = add_noise(image, READ_NOISE / float(n), generator=generator)
            estimate = rt.imaging.restore(image, filter)
            found.append(float(mean_square_error(estimate, patches, margin=SIZE // 2).mean()))
    return float(np.mean(found))


@dataclasses.dataclass(frozen=True)
class Scene:
    """A lens at an F/number, its object distances, and the light of every field by kind of light."""

    lens: Lens
    fields: tuple[float, ...]
    distances: Tensor
    electrons: dict[str, Tensor]
    noise: dict[str, Tensor]
    spectrum: Tensor


@torch.no_grad()
def scene_of(name: str, f_number: float, depth: str, pictures: list[Tensor]) -> Scene:
    """pictures: of the spectrum."""
    fields = LENSES[name][1]
    near, far = RANGES[depth]
    steps = (torch.arange(DEPTHS, dtype=torch.float64) + 0.5) / DEPTHS
    distances = 1 / (1 / near + (1 / far - 1 / near) * steps)
    lens = clipped(name).at(f_number=f_number, object_distance=float(distances[DEPTHS // 2]))
    solid = rt.relative_illumination(lens, fields=list(fields)).projected_solid_angle
    electrons = {light: n * solid / (math.pi / 4 / 4.0**2) for light, n in LIGHTS.items()}
    mean = float(torch.cat([picture.flatten() for picture in pictures]).mean())
    noise = {light: noise_of(n, mean) for light, n in electrons.items()}
    return Scene(lens, fields, distances, electrons, noise, power_spectrum(patches_of(pictures, 200, 0, 1)))


@torch.no_grad()
def predicted(scene: Scene, head: dict) -> list[dict]:
    """The error that every model expects, at the sensor distance of its own minimum, of waves at that of DRT."""
    rows, sensors = [], {}
    for model in ORDERS:
        if model != "wave":
            sensors = best_sensors(scene.lens, model, scene.fields, scene.distances, scene.spectrum, scene.noise)
        for light, sigma in scene.noise.items():
            lens = scene.lens.at(sensor_distance=sensors[light])
            compute = judging if model == "wave" else functools.partial(kernels_of, model=model)
            errors = error_of(compute(lens, fields=scene.fields, distances=scene.distances), scene.spectrum, sigma)
            row = {**head, "light": light, "model": model, "sensor_mm": sensors[light], "error": float(errors.mean())}
            row |= {f"error_{k}": float(e) for k, e in enumerate(errors)}
            rows.append(row | {"electrons_axis": float(scene.electrons[light][0])})
    return rows


@torch.no_grad()
def tested(scene: Scene, rows: list[dict], pictures: list[Tensor]) -> dict[str, dict[str, float]]:
    """Mean square error of restored pictures by kind of light and seed."""
    found = {}
    for row in rows:
        if row["model"] == "wave":
            light = row["light"]
            kernels = judging(scene.lens.at(sensor_distance=row["sensor_mm"]), scene.fields, scene.distances)
            about = scene.spectrum, scene.noise[light], scene.electrons[light], pictures
            found[light] = {f"restored_{seed}": restored(kernels, *about, seed) for seed in range(SEEDS)}
    return found


def decibel(error: float) -> float:
    return -10 * math.log10(error)


def curves(rows: list[dict], name: str, depth: str, light: str) -> dict[str, dict[float, dict]]:
    """Rows by model and F/number."""
    found: dict[str, dict[float, dict]] = {}
    for row in rows:
        if (row["lens"], row["depth"], row["light"]) == (name, depth, light):
            found.setdefault(row["model"], {})[row["f_number"]] = row
    return found


def interval(differences: list[float]) -> tuple[float, float]:
    """Mean and half width of its 95 % confidence interval by Student's t."""
    width = student.ppf(0.975, len(differences) - 1) * np.std(differences, ddof=1) / np.sqrt(len(differences))
    return float(np.mean(differences)), float(width)


def winner(curve: dict[float, dict]) -> float:
    return min(curve, key=lambda n: curve[n]["error"])


def seeds_of(row: dict) -> list[float]:
    return [decibel(row[f"restored_{seed}"]) for seed in range(SEEDS)]


def table(rows: list[dict]) -> str:
    """The table of the page: the F/number that each model selects, and the PSNR in dB that this costs."""
    heads = ["lens", "depth", "light", "wave", "PSNR of wave's choice", *[*ORDERS][:-1]]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for name, depth, light in dict.fromkeys((r["lens"], r["depth"], r["light"]) for r in rows):
        found = curves(rows, name, depth, light)
        chosen = {model: winner(curve) for model, curve in found.items()}
        judge = found["wave"]
        best = seeds_of(judge[chosen["wave"]])
        words = [name, depth, light, f"F/{chosen['wave']:g}", f"{np.mean(best):.2f}"]
        for model, lost in losses(found).items():
            middle, width = interval(lost)
            cost = "" if chosen[model] == chosen["wave"] else f", {middle:.2f} ± {width:.2f}"
            words.append(f"F/{chosen[model]:g}{cost}")
        lines.append("| " + " | ".join(words) + " |")
    return "\n".join(lines)


def losses(curves_of_scene: dict[str, dict[float, dict]]) -> dict[str, list[float]]:
    """PSNR of restored pictures at the F/number of waves less that at the F/number of each model, dB, by seed."""
    judge = curves_of_scene["wave"]
    best = seeds_of(judge[winner(judge)])
    choices = {model: winner(curve) for model, curve in curves_of_scene.items() if model != "wave"}
    return {model: [b - a for a, b in zip(seeds_of(judge[n]), best, strict=True)] for model, n in choices.items()}


def counts(rows: list[dict]) -> str:
    """Scenes in which the F/number of a model loses at most `LEVEL` to that of waves, and those in which the two best
    F/numbers of waves are level."""
    scenes = [curves(rows, *scene) for scene in dict.fromkeys((r["lens"], r["depth"], r["light"]) for r in rows)]
    level = {model: sum(np.mean(losses(scene)[model]) <= LEVEL for scene in scenes) for model in [*ORDERS][:-1]}
    expected = [sorted(decibel(row["error"]) for row in scene["wave"].values())[-2:] for scene in scenes]
    ties = sum(best - second <= LEVEL for second, best in expected)
    words = ", ".join(f"{model} {count}" for model, count in level.items())
    return f"level with waves to {LEVEL:g} dB in {words} of {len(scenes)} scenes; waves undecided in {ties}"


def figure(rows: list[dict]):
    """Predicted PSNR over the F/number by model, and that of restored pictures."""
    scenes = [*dict.fromkeys((r["depth"], r["light"]) for r in rows)]
    names = [*dict.fromkeys(r["lens"] for r in rows)]
    drawn = new_figure(3.0 * len(scenes), 2.7 * len(names))
    panels = drawn.subplots(len(names), len(scenes), squeeze=False)
    for line, name in zip(panels, names, strict=True):
        for panel, (depth, light) in zip(line, scenes, strict=True):
            found = curves(rows, name, depth, light)
            for number, (model, curve) in enumerate(found.items()):
                n = sorted(curve)
                colour = FIELD_COLOURS[number % len(FIELD_COLOURS)]
                values = [decibel(curve[k]["error"]) for k in n]
                panel.plot(n, values, color=colour, label=model, linewidth=1.8 if model == "wave" else 1.1)
                best = winner(curve)
                panel.plot(best, decibel(curve[best]["error"]), "o", ms=5, color=colour)
            judge = found["wave"]
            n = sorted(judge)
            panel.plot(n, [np.mean(seeds_of(judge[k])) for k in n], "x", color=GREY, label="restored pictures")
            panel.set_xscale("log", base=2)
            panel.set_xticks(n, [f"{k:g}" for k in n], fontsize=7)
            panel.minorticks_off()
            panel.set_title(f"{name}, {depth} depth, {light}", fontsize=8)
            panel.set(xlabel="F/number", ylabel="PSNR, dB")
    panels[0][0].legend(fontsize=6)
    return drawn


def stored(file: Path) -> list[dict]:
    """Rows that `save` wrote."""
    with open(file, newline="", encoding="utf-8") as lines:
        rows = [{key: text for key, text in row.items() if text} for row in csv.DictReader(lines)]
    words = "lens", "depth", "light", "model"
    return [{key: text if key in words else float(text) for key, text in row.items()} for row in rows]


def save(rows: list[dict], stem: Path) -> None:
    columns = [*dict.fromkeys(key for row in rows for key in row)]
    with open(stem.with_suffix(".csv"), "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    figure(rows).savefig(stem.with_suffix(".png"), dpi=150, bbox_inches="tight")


def options(parser: argparse.ArgumentParser) -> None:
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--data", help="folder of pictures")
    source.add_argument("--table", type=Path, help="stored rows: print their table and counts, compute nothing")
    parser.add_argument("--limit", type=int, default=200, help="pictures, evenly spaced")
    parser.add_argument("-o", dest="folder", type=Path, default=Path("."), help="folder of the results")
    parser.add_argument("--docs", type=Path, help="folder of documentation, for the table and the figure")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    chosen = parser.parse_args(words)
    if chosen.table:
        rows = stored(chosen.table)
        print(table(rows), counts(rows), sep="\n")
        return
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", UnfilledStop)
    rt.tracing.prepare()
    sets = split(read(files(chosen.data, chosen.limit), least=PATCH))
    pictures = tuple([linearised(sample).double() for sample in part.samples] for part in sets)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, (f_numbers, _) in LENSES.items():
        for depth in RANGES:
            for f_number in reversed(f_numbers):
                head = {"lens": name, "f_number": f_number, "depth": depth}
                paths = [chosen.folder / f"{name}_{depth}_{f_number:g}{part}.json" for part in ("", "_restored")]
                if not all(path.exists() for path in paths):
                    scene = scene_of(name, f_number, depth, pictures[0])
                if not paths[0].exists():
                    write_json(paths[0], {"rows": predicted(scene, head)})
                of_case = read_json(paths[0])["rows"]
                if not paths[1].exists():
                    write_json(paths[1], tested(scene, of_case, pictures[1]))
                    print(paths[0].name, flush=True)
                errors = read_json(paths[1])
                rows += [{**row, **errors[row["light"]]} if row["model"] == "wave" else row for row in of_case]
    print(table(rows), counts(rows), sep="\n")
    if chosen.docs:
        save(rows, chosen.docs / "camera_aperture")


if __name__ == "__main__":
    main()
