"""Co-design as built in closed form: sensor distance and linear filter for perturbed lenses against nominal ones.

    python docs/experiments/codesign_as_built_filter.py double_gauss --data DIR -o FOLDER --docs docs

Nominal training: the sensor distance and the depth-invariant Wiener filter of least mean square error for the nominal
lens. As-built training: those of least error for perturbed lenses. Both restore the same noisy images of other
perturbed lenses. Every seed has its own lenses of training and test, crops and noise; differences are paired by seed. A
second call computes what is missing.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np
import torch
from codesign_as_built import BASE, BUILDS, MEASURES, figure, file_name, interval, save
from torch import Tensor

from raytrace.files import write_json
from raytrace.imaging.camera import Camera
from raytrace.imaging.closed_form import even_distances, patch_spectrum
from raytrace.imaging.codesign import TEST_EPOCH, initial_camera, make_batch
from raytrace.imaging.image import transfer_functions
from raytrace.imaging.pictures import Pictures, files, read, split
from raytrace.imaging.restoration import depth_invariant_error, depth_invariant_wiener, psnr, restore
from raytrace.imaging.training import read_json
from raytrace.io import as_lens
from raytrace.system.lens import Lens
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tracing.compiled import prepare

#: Patches are restored with a border of the PSF on each side, which is then cut off.
SETTINGS = dataclasses.replace(BASE, start="paraxial", vary="sensor", hold="", patch=BASE.patch + BASE.size - 1)
_LENSES, _DISTANCES, _PATCHES = 24, 8, 8  # of a training, of each lens there, and of each lens of the test
_SENSORS = np.linspace(-0.45, -0.09, 7)  # mm from the paraxial image at 25 m, where the error is computed
_UNSEEN = 2**62


def kernels_of(built: Camera, errors: Tensor | None) -> Tensor:
    """PSFs (K, h, w) of all lenses (L, N), or of the nominal one, at even object distances."""
    distances = even_distances(built, _DISTANCES)
    if errors is None:
        return built.kernels(distances)[:, 0]
    return built.kernels(distances.repeat(len(errors)), 0, errors.repeat_interleave(len(distances), 0))[:, 0]


def trained(built: Camera, spectrum: Tensor, errors: Tensor | None) -> tuple[float, Tensor]:
    """Sensor distance, mm, and filter (rows, columns) of least mean square error."""
    sensor, found = built.variables.get_parameter("sensor"), []
    for change in _SENSORS:
        sensor.fill_(change)
        transfer = transfer_functions(kernels_of(built, errors), SETTINGS.patch)
        found.append(float(depth_invariant_error(transfer, spectrum, SETTINGS.noise)))
    least = min(max(int(np.argmin(found)), 1), len(found) - 2)  # and the parabola through its neighbours
    square, slope, _ = np.polyfit(_SENSORS[least - 1 : least + 2], found[least - 1 : least + 2], 2)
    best = float(np.clip(-slope / (2 * square), _SENSORS[0], _SENSORS[-1]))
    sensor.fill_(best)
    transfer = transfer_functions(kernels_of(built, errors), SETTINGS.patch)
    return built.variables.numbers()["sensor"], depth_invariant_wiener(transfer, spectrum, SETTINGS.noise)


def tested(built: Camera, pictures: Pictures, seed: int, sensor: float, filter: Tensor, errors: Tensor | None) -> dict:
    """Mean L¹ and PSNR over the lenses (L, N), with the standard deviation and the least of PSNR."""
    built.variables.get_parameter("sensor").fill_(sensor - float(built.variables.lens.surfaces[-2].thickness))
    count = _PATCHES * _LENSES
    settings = dataclasses.replace(SETTINGS, seed=seed, crops=-(-count // len(pictures)))
    samples = make_batch(pictures, settings, list(range(count)), TEST_EPOCH)
    each = None if errors is None else errors.repeat_interleave(_PATCHES, 0)
    image = built.image(samples.picture.double(), samples.distance, 0, each)
    image = built.demosaiced(image, index=samples.index, seed=samples.seed)
    border = SETTINGS.size // 2
    inner = (..., slice(border, -border), slice(border, -border))
    difference = (restore(image, filter) - built.target(samples.picture.double()))[inner].reshape(_LENSES, -1)
    ratio = psnr(difference.square().mean(-1))
    return {
        "l1": float(difference.abs().mean()),
        "psnr": float(ratio.mean()),
        "psnr_spread": float(ratio.std()),
        "psnr_least": float(ratio.min()),
    }


@torch.no_grad()
def rows_of(lens: Lens, pictures: tuple[Pictures, Pictures], build: str, seed: int) -> list[dict]:
    """The rows of a build and a seed."""
    grade, refocus = BUILDS[build]
    built = initial_camera(lens, dataclasses.replace(SETTINGS, grade=grade, refocus=refocus))
    built.plan()
    spectrum = patch_spectrum(pictures[0], SETTINGS.patch, crops=1, seed=seed)
    errors = draw_errors(built.tolerances, _LENSES, seed)
    unseen, rows = draw_errors(built.tolerances, _LENSES, seed, first=_UNSEEN), []
    for training, of_training in (("nominal", None), ("as built", errors)):
        sensor, filter = trained(built, spectrum, of_training)
        for place, of_test in (("perturbed", unseen), ("nominal", None)):
            row = {"build": build, "seed": seed, "training": training, "tested on": place, "sensor_mm": sensor}
            rows.append(row | tested(built, pictures[1], seed, sensor, filter, of_test))
    return rows


def column(rows: list[dict], build: str, training: str, place: str, measure: str) -> np.ndarray:
    """A measure by seed."""
    wanted = build, training, place
    return np.array([r[measure] for r in rows if (r["build"], r["training"], r["tested on"]) == wanted])


def table(rows: list[dict]) -> str:
    """The table of the page."""
    heads = ["perturbed cameras", "seeds"]
    heads += ["PSNR, nominal training", "as-built training", "difference (95 %)"]
    heads += [
        "L¹, nominal training",
        "as-built training",
        "difference (95 %)",
        "PSNR of nominal training on nominal lens",
    ]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for build in dict.fromkeys(row["build"] for row in rows):
        words = [build, str(len(column(rows, build, "nominal", "perturbed", "l1")))]
        for measure, form in (("psnr", ".3f"), ("l1", ".5f")):
            pair = [column(rows, build, training, "perturbed", measure) for training in ("nominal", "as built")]
            mean, width = interval(list(pair[1] - pair[0]))
            words += [*(f"{values.mean():{form}}" for values in pair), f"{mean:+{form}} ± {width:{form}}"]
        words.append(f"{column(rows, build, 'nominal', 'nominal', 'psnr').mean():.3f}")
        lines.append("| " + " | ".join(words) + " |")
    return "\n".join(lines)


def differences(rows: list[dict]) -> dict[str, dict[str, list[float]]]:
    """As-built less nominal training on perturbed cameras, of every seed, by measure and build."""
    builds = [*dict.fromkeys(row["build"] for row in rows)]

    def of(build: str, measure: str) -> list[float]:
        nominal, built = (column(rows, build, training, "perturbed", measure) for training in ("nominal", "as built"))
        return list(built - nominal)

    return {measure: {build: of(build, measure) for build in builds} for measure in MEASURES}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lens")
    parser.add_argument("--data", required=True, help="folder of pictures")
    parser.add_argument("--limit", type=int, default=200, help="pictures, evenly spaced")
    parser.add_argument("-o", dest="folder", type=Path, required=True, help="folder of the results")
    parser.add_argument("--docs", type=Path, help="folder of documentation, for the table and the figure")
    parser.add_argument("--seeds", type=int, default=5)


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    chosen = parser.parse_args(words)
    torch.set_num_threads(1)
    prepare()
    lens = as_lens(chosen.lens, "the study")
    pictures = split(read(files(chosen.data, chosen.limit), least=SETTINGS.patch + SETTINGS.size - 1))
    chosen.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for build in BUILDS:
        for seed in range(chosen.seeds):
            path = chosen.folder / f"{file_name(build)}_{seed}.json"
            if not path.exists():
                write_json(path, {"rows": rows_of(lens, pictures, build, seed)})
            rows += read_json(path)["rows"]
        print(table(rows), flush=True)
    if chosen.docs:
        save(rows, figure(differences(rows)), chosen.docs / "codesign_as_built")


if __name__ == "__main__":
    main()
