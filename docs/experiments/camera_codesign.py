"""Colour cameras over the whole sensor: does the Gaussian PSF survive, and are lens and network better together?

    python docs/experiments/camera_codesign.py models --data DIR -o FOLDER --docs docs
    python docs/experiments/camera_codesign.py apart --data DIR -o FOLDER --docs docs
    python docs/experiments/camera_codesign.py pictures --data DIR -o FOLDER --docs docs

`models`: step 1 of the first work with Gaussian and with DRT PSFs, and with the lens of the file frozen, in `--steps`
steps each; all curvatures and air spaces of each of `--lenses`. `apart`: the lens of the file, one of least spots and
one of the closed form (by `lm`, from the least spots), each with a network trained behind it and with both
trained further, against training of both from the start. Every training of `apart` has `--seconds` of processor time,
lens and network together: its number of steps follows from the measured time of a step. Step 2 freezes the lens and
trains the network further with DRT PSFs; the test takes held-out photographs at the middle, at 0.7 and at the corner of
the sensor. A second call resumes. `pictures` draws the scene, the record of the sensor and its restorations, by the
camera that `apart` trained together first.
"""

import argparse
import csv
import dataclasses
import io
import json
import math
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from scipy.stats import t as student
from torch import Tensor

import raytrace as rt
from raytrace.files import write_json, write_text
from raytrace.imaging.camera import Camera
from raytrace.imaging.closed_form import (
    even_distances,
    field_filters,
    optimise_closed_form,
    patch_spectrum,
)
from raytrace.imaging.codesign import (
    TEST_EPOCH,
    Batches,
    absolute_error,
    initial_camera,
    lens_at_start,
    light_of,
    make_batch,
    optimise,
    spectrum_of,
    steps_per_epoch,
)
from raytrace.imaging.image import blur, encoded
from raytrace.imaging.pictures import Pictures, dead_leaves, digest, draws, files, read, split
from raytrace.imaging.restoration import psnr, restore
from raytrace.imaging.training import Run, load_state, read_json, read_state, train
from raytrace.plotting.style import FIELD_COLOURS, GREY, INK, new_figure
from raytrace.settings import CodesignSettings
from raytrace.shards import Share
from raytrace.system.lens import Lens
from raytrace.tracing.compiled import prepare

BASE = CodesignSettings(
    vary="thickness sensor curvature", hold="efl buildable", optimizer="adam", spread="reciprocal",
    start="rms", noise=0.02,
    wavelengths=(0.5876, 0.4861, 0.6563), wavelength_weights=(1.0, 1.0, 1.0), network="u-net", depth=2, width=16,
    size=21, patch=64, batch=8, crops=1, rate_network=2e-3, rate_optics=5e-3, decay="cosine",
)  # fmt: skip
#: Lens, sensor and objects: blur discs of about 20 pixels at the ends of the range.
LENSES = {
    "double_gauss": {"sensor": (36.0, 24.0), "pixel": 0.01, "near": 7e3, "far": 50e3, "focus_distance": 12.3e3},
    "cooke_triplet": {"sensor": (34.0, 22.0), "pixel": 0.01, "near": 7e3, "far": 50e3, "focus_distance": 12.3e3},
    "phone": {
        "sensor": (4.8, 3.6), "pixel": 0.0014, "near": 160.0, "far": 2e3, "focus_distance": 296.0, "rate_optics": 2e-4,
        "vary": "thickness:1-12 sensor curvature:2-13",
    },
}  # fmt: skip
PLACES = (0.0, 0.7, 1.0)  # shares of the half diagonal
BANK = 48  # places and distances whose DRT PSFs train the network of a frozen lens
REFINED = 80  # steps of step 2
SEEDS = range(5)
SHOWN = 9e3  # mm, object distance of the pictures
TESTED = 7  # distances of the test, even in their reciprocal
DISTANCES = 5  # of the closed form
CYCLES = 16  # of the closed form
ARMS = {
    "models": ("gaussian", "drt", "frozen"),
    "apart": ("file", "spot", "spot, together", "closed form", "closed form, together", "together"),
}
FROZEN = "frozen", "file", "spot", "closed form"
REFERENCE = {"models": "drt", "apart": "together"}
WORDS = {
    "gaussian": "Gaussian DRT", "drt": "DRT", "frozen": "lens of the file", "file": "lens of the file, network",
    "spot": "least spots, network", "spot, together": "least spots, both", "closed form": "closed form, network",
    "closed form, together": "closed form, both", "together": "both from the start",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Study:
    """One of the two studies: the trainings of every lens and seed."""

    kind: str
    folder: Path
    seconds: float
    steps: int
    lenses: tuple[str, ...]
    pictures: Pictures

    def settings(self, lens: str, arm: str, seed: int) -> CodesignSettings:
        return dataclasses.replace(BASE, **LENSES[lens], model="drt" if arm == "drt" else "gaussian", seed=seed)


def step_seconds(lens: Lens, pictures: Pictures, settings: CodesignSettings, *, frozen: bool, count: int = 6) -> float:
    """Median processor time of a training step, s; frozen: of the network alone."""
    trained = initial_camera(lens, settings)
    trained.variables.requires_grad_(not frozen)
    trained.plan()
    batches = Batches(pictures, settings)
    optimizer, seconds = torch.optim.Adam(trained.parameters(), 1e-9), []
    for step in range(count + 2):
        start = time.process_time()
        optimizer.zero_grad(set_to_none=True)
        (absolute_error(trained, batches(step, Share())).mean() + trained.variables.violation()).backward()
        optimizer.step()
        if not frozen:
            trained.variables.project()
        seconds.append(time.process_time() - start)
    return float(np.median(seconds[2:]))


def for_spots(lens: Lens, settings: CodesignSettings) -> tuple[Lens, float]:
    """The lens of least spots at the focus distance, with the same variables and limits; processor time in s."""
    start, initial = time.process_time(), lens_at_start(lens, settings)
    length = float(rt.first_order(initial).effective_focal_length)
    kinds = {
        "hold": f"efl={length!r}",
        "bounds": "thickness:1..15 thickness_6:4..15 sensor:60..90",
        "cycles": 40,
        "seconds": 20,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        optimised = rt.optimize(initial, merit="spot", vary=settings.vary, **kinds).lens
    return optimised, time.process_time() - start


def trained_camera(study: Study, lens: Lens, name: str, arm: str, seed: int) -> tuple[Camera, dict]:
    """The camera after step 1, and its number of steps and times."""
    settings = study.settings(name, arm, seed)
    train_pictures, _ = split(study.pictures, seed=seed)
    folder = study.folder / name / arm.replace(" ", "_").replace(",", "") / str(seed)
    spent, frozen = 0.0, arm in FROZEN
    if arm.startswith(("spot", "closed form")):
        lens, spent = for_spots(lens, settings)
    one = initial_camera(lens, settings)
    if arm.startswith("closed form"):
        stored = folder / "closed_form.pt"
        if not stored.exists():
            spectrum, start = spectrum_of(train_pictures, settings), time.process_time()
            distances = even_distances(one, DISTANCES, spread=settings.spread)
            optimise_closed_form(one, spectrum, distances=distances, steps=CYCLES, optimizer="lm")
            folder.mkdir(parents=True, exist_ok=True)
            torch.save({"seconds": time.process_time() - start, "variables": one.variables.state_dict()}, stored)
        content = torch.load(stored, weights_only=True)
        one.variables.load_state_dict(content["variables"])
        spent += content["seconds"]
    one.variables.requires_grad_(not frozen)
    per_epoch, epochs = steps_per_epoch(train_pictures, settings), 0
    if study.kind == "models":
        epochs = round(study.steps / per_epoch)
    else:
        each_file = study.folder / f"{name}, {'frozen' if frozen else 'both'}.json"
        if not each_file.exists():
            write_json(each_file, {"seconds": step_seconds(lens, train_pictures, settings, frozen=frozen)})
        epochs = max(1, round((study.seconds - spent) / read_json(each_file)["seconds"] / per_epoch))
    settings, measured = dataclasses.replace(settings, epochs=epochs), folder / "seconds.json"
    one.plan()
    start, before = time.process_time(), read_json(measured)["seconds"] if measured.exists() else 0.0
    run = Run(folder / "step1", {**dataclasses.asdict(settings), "arm": arm})
    for _ in optimise(one, train_pictures, settings, run):
        write_json(measured, {"seconds": before + time.process_time() - start})
    return one, {
        "steps": epochs * per_epoch,
        "lens_seconds": spent,
        "seconds": spent + read_json(measured)["seconds"],
        "folder": folder,
    }


# -- step 2 and the test, with DRT PSFs of the frozen lens


@torch.no_grad()
def kernels_of(one: Camera, points: Tensor, distances: Tensor) -> Tensor:
    """DRT PSFs (K, C, h, w) of pairs, float32."""
    parts = zip(points.split(8, 1), distances.split(8), strict=True)
    return torch.cat([one.kernels(some, points=part) for part, some in parts]).float()


def refined(one: Camera, pictures: Pictures, settings: CodesignSettings, folder: Path) -> None:
    """Train the network further on DRT PSFs of BANK places and distances."""
    one.variables.requires_grad_(False)
    one.use("drt")
    random = draws(settings.seed, 77)
    origins = one.sensor.random_patches(range(BANK), settings.patch, settings.seed + 1000)
    points = one.sensor.patch_points(origins, settings.patch)
    distances = torch.as_tensor(1 / random.uniform(1 / settings.far, 1 / settings.near, BANK))
    stored = folder / "bank.pt"
    if not stored.exists():
        torch.save(kernels_of(one, points, distances), stored)
    bank = torch.load(stored, weights_only=True)
    batches = Batches(pictures, settings)
    optimizer = torch.optim.Adam(one.network.parameters(), settings.rate_network / 2)

    def loss(step: int, share: Share):
        taken = torch.as_tensor(draws(settings.seed, step, 78).integers(BANK, size=settings.batch))
        samples = batches(step, share)
        image = blur(samples.picture, bank[taken])
        recorded = one.demosaiced(image, points[:, taken], samples.index, settings.seed)
        difference = one.restore(recorded) - one.target(samples.picture)
        return difference.abs().mean(), {}

    run = Run(folder / "step2", {**dataclasses.asdict(settings), "refined": REFINED})
    for _ in train(one, optimizer, loss, steps=REFINED, run=run):
        pass


@torch.no_grad()
def tested(one: Camera, train_pictures: Pictures, test_pictures: Pictures, settings: CodesignSettings) -> dict:
    """PSNR, dB, at each place, behind the network and behind the Wiener filter of the place.

    Every held-out photograph is recorded at every one of TESTED distances: no lens is lucky to be in focus.
    """
    spectrum = spectrum_of(train_pictures, settings)
    filters = field_filters(one, spectrum, PLACES, even_distances(one, DISTANCES, spread=settings.spread))
    samples, row = make_batch(test_pictures, settings, [*range(len(test_pictures))], TEST_EPOCH), {}
    distances, count = even_distances(one, TESTED, spread=settings.spread), len(test_pictures)
    target = one.target(samples.picture)
    for place, filter in zip(PLACES, filters, strict=True):
        points = one.sensor.on_diagonal([place])
        kernels, errors = kernels_of(one, points.expand(2, TESTED), distances), {}
        for number, kernel in enumerate(kernels):
            image = blur(samples.picture, kernel)
            recorded = one.demosaiced(image, points.expand(2, count), samples.index + number * count, settings.seed)
            found = {"network": one.restore(recorded), "recorded": recorded}
            found["wiener"] = restore(recorded, filter.to(torch.complex64), boundary="taper")
            for name, estimate in found.items():
                errors.setdefault(name, []).append((estimate - target).square().mean())
        for name, squares in errors.items():
            row[f"{name}_{place:g}"] = float(psnr(torch.stack(squares).mean()))
    for name in ("network", "wiener", "recorded"):
        row[name] = float(np.mean([row[f"{name}_{place:g}"] for place in PLACES]))
    return row


def row_of(study: Study, name: str, arm: str, seed: int) -> dict:
    """A row of the table: trained, refined and tested, or as stored."""
    folder = study.folder / name / arm.replace(" ", "_").replace(",", "") / str(seed)
    stored = folder / "row.json"
    if stored.exists():
        return read_json(stored)
    lens = rt.read_lens(name)
    one, about = trained_camera(study, lens, name, arm, seed)
    settings = study.settings(name, arm, seed)
    train_pictures, test_pictures = split(study.pictures, seed=seed)
    refined(one, train_pictures, settings, folder)
    measured = tested(one, train_pictures, test_pictures, settings)
    row = {
        "lens": name,
        "training": arm,
        "seed": seed,
        "steps": about["steps"],
        "lens_seconds": about["lens_seconds"],
        "seconds": about["seconds"],
        **measured,
    }
    write_json(stored, row)
    rt.write_lens(one.variables(), folder / "lens.zmx")
    return row


def differences(rows: list[dict], lens: str, one: str, other: str, key: str) -> tuple[float, float]:
    """Mean of one less other paired by seed, and the half width of its 95 % interval (Student's t)."""
    by_arm = {
        arm: {row["seed"]: row[key] for row in rows if (row["lens"], row["training"]) == (lens, arm)}
        for arm in (one, other)
    }
    seeds = sorted(by_arm[one].keys() & by_arm[other].keys())
    found = np.array([by_arm[one][seed] - by_arm[other][seed] for seed in seeds])
    half = (
        student.ppf(0.975, len(found) - 1) * found.std(ddof=1) / math.sqrt(len(found)) if len(found) > 1 else math.nan
    )
    return float(found.mean()), float(half)


def draw(study: Study, rows: list[dict], reference: str):
    """Differences of PSNR from the reference, of every seed, with the mean and its interval."""
    arms = [arm for arm in ARMS[study.kind] if arm != reference]
    panels = [(lens, arm) for lens in study.lenses for arm in arms]
    figure = new_figure(1.2 + 1.9 * len(panels), 3.4)
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    keys = {f"{kind}_{place:g}": (kind, place) for kind in ("network", "wiener") for place in PLACES}
    for axis, (lens, arm) in zip(axes, panels, strict=True):
        for number, (key, (kind, _)) in enumerate(keys.items()):
            colour = FIELD_COLOURS[0] if kind == "network" else FIELD_COLOURS[1]
            at = number % 3 + (0.16 if kind == "wiener" else -0.16)
            pairs = {}
            for row in rows:
                if row["lens"] == lens:
                    pairs.setdefault(row["seed"], {})[row["training"]] = row[key]
            each = [pair[arm] - pair[reference] for pair in pairs.values() if arm in pair and reference in pair]
            mean, half = differences(rows, lens, arm, reference, key)
            axis.plot([at] * len(each), each, "o", ms=3, color=colour, alpha=0.5)
            axis.errorbar(at, mean, half, fmt="_", color=INK, capsize=3, ms=9)
        axis.axhline(0, color=GREY, linewidth=0.8)
        axis.set_xticks(range(3), [f"{place:g}" for place in PLACES])
        axis.set_title(f"{lens}\n{WORDS[arm]}" if len(study.lenses) > 1 else WORDS[arm], fontsize=9)
        axis.set_xlabel("share of the half diagonal")
    axes[0].set_ylabel(f"PSNR less that of {WORDS[reference]}, dB")
    for kind, colour in (("network", FIELD_COLOURS[0]), ("Wiener filter of the place", FIELD_COLOURS[1])):
        axes[-1].plot([], [], "o", color=colour, label=kind)
    axes[-1].legend(fontsize=7)
    return figure


@torch.no_grad()
def draw_pictures(study: Study):
    """Scene, record, restorations and the residual of the network, at the middle and at the corner of the sensor."""
    folder = study.folder.parent / "apart" / "cooke_triplet" / "together" / "0"
    settings = study.settings("cooke_triplet", "together", 0)
    one = initial_camera(rt.read_lens("cooke_triplet"), settings)
    load_state(one, read_state(folder / "step2" / "checkpoint.pt"), folder)
    one.use("drt")
    size = 96 + settings.size - 1
    light = light_of(torch.as_tensor(dead_leaves(1, size=size, seed=3, smallest=4.0, colour=True).samples[0] / 255.0))
    train_pictures, _ = split(study.pictures, seed=0)
    spectrum = patch_spectrum(train_pictures, 96 + settings.size - 1, crops=1)
    filters = field_filters(one, spectrum, (0.0, 1.0), even_distances(one, DISTANCES, spread=settings.spread))
    scene, distance = light[None].float(), torch.tensor([SHOWN], dtype=torch.float64)
    figure = new_figure(10.2, 4.6)
    axes = figure.subplots(2, 5)
    for row, (place, filter) in enumerate(zip((0.0, 1.0), filters, strict=True)):
        points = one.sensor.on_diagonal([place])
        recorded = one.demosaiced(one.image(scene, distance, points=points), points, [row], 0)
        target, network = one.target(scene), one.restore(recorded)
        wiener = restore(recorded, filter.to(torch.complex64), boundary="taper")
        shown = {"scene": target, "sensor": recorded, "network": network, "Wiener filter": wiener}
        for axis, (name, image) in zip(axes[row], shown.items(), strict=False):
            axis.imshow(encoded(image[0]).movedim(0, -1).numpy(), interpolation="nearest")
            quality = "" if name == "scene" else f", {float(psnr((image - target).square().mean())):.2f} dB"
            axis.set_title(name + quality, fontsize=9)
        residual = (0.5 + (network - target)[0]).clamp(0, 1)
        axes[row, 4].imshow(residual.movedim(0, -1).numpy(), interpolation="nearest")
        axes[row, 4].set_title("residual of the network", fontsize=9)
        axes[row, 0].set_ylabel("middle" if place == 0 else "corner")
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    return figure


def table(rows: list[dict]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, [*rows[0]], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({key: f"{value:.4f}" if isinstance(value, float) else value for key, value in row.items()})
    return text.getvalue()


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("study", choices=[*ARMS, "pictures"])
    parser.add_argument("--data", required=True, help="folder of colour photographs")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--docs", type=Path, help="folder for the table and the figure")
    parser.add_argument("--seconds", type=float, default=40.0, help="processor time of a training of `apart`")
    parser.add_argument("--steps", type=int, default=60, help="of a training of `models`")
    parser.add_argument("--lenses", nargs="+", choices=[*LENSES], default=["double_gauss", "cooke_triplet"])
    parser.add_argument("--seeds", type=int, default=len(SEEDS))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    prepare()
    warnings.filterwarnings("ignore", category=UserWarning)
    pictures = read(files(arguments.data), least=BASE.patch + BASE.size - 1, colour=True)
    lenses = tuple(arguments.lenses) if arguments.study == "models" else ("cooke_triplet",)
    study = Study(
        arguments.study, arguments.output / arguments.study, arguments.seconds, arguments.steps, lenses, pictures
    )
    if arguments.study == "pictures":
        draw_pictures(study).savefig(arguments.docs / "camera_pictures.png")
        return
    study.folder.mkdir(parents=True, exist_ok=True)
    budget = {"steps": arguments.steps} if arguments.study == "models" else {"seconds": arguments.seconds}
    about = {"pictures": digest(pictures.samples), **budget}
    Run(study.folder / "about", about)
    rows = []
    for seed in range(arguments.seeds):
        for name in study.lenses:
            for arm in ARMS[study.kind]:
                rows.append(row_of(study, name, arm, seed))
                print(json.dumps(rows[-1]), flush=True)
    reference = REFERENCE[study.kind]
    for name in study.lenses:
        for arm in ARMS[study.kind]:
            if arm != reference:
                shown = {key: differences(rows, name, arm, reference, key) for key in ("network", "wiener", "recorded")}
                print(
                    name, f"{arm} less {reference}, dB:", {key: f"{a:+.3f} ± {b:.3f}" for key, (a, b) in shown.items()}
                )
    if arguments.docs:
        stem = f"camera_{study.kind}"
        write_text(arguments.docs / f"{stem}.csv", table(rows))
        draw(study, rows, reference).savefig(arguments.docs / f"{stem}.png")


if __name__ == "__main__":
    main()
