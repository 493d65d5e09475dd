"""A study of co-design as built: training on perturbed lenses against nominal training, in equal numbers of steps.

    python docs/experiments/codesign_as_built.py double_gauss --data DIR -o FOLDER --docs docs

Of every seed, `--start` epochs on the nominal lens are the common start. From there each training takes `--steps`. The
trainings of a seed are tested on the same perturbed cameras, which no training and no other seed sees; differences are
paired by seed. A second call resumes, and computes what is missing.
"""

import argparse
import csv
import dataclasses
import time
from pathlib import Path

import numpy as np
import torch
from scipy.stats import t as student

from raytrace.files import write_json
from raytrace.imaging.camera import Camera
from raytrace.imaging.codesign import (
    errors_as_built,
    initial_camera,
    optimise,
    steps_per_epoch,
)
from raytrace.imaging.pictures import Pictures, digest, files, read, split
from raytrace.imaging.training import Run, load_state, read_json, read_state
from raytrace.io import as_lens
from raytrace.plotting.style import FIELD_COLOURS, GREY, INK, new_figure
from raytrace.settings import CodesignSettings
from raytrace.system.lens import Lens
from raytrace.tracing.compiled import prepare

BASE = CodesignSettings(
    vary="curvature:1-3,5,7,9-11 sensor", hold="efl", optimizer="adam", noise=0.02, width=16, batch=16, patch=32,
    start="57.59", rate_network=2e-3, rate_optics=1e-4, decay="cosine", center="centroid", cameras=16,
)  # fmt: skip
#: What cameras are built with: (grade, refocus).
BUILDS = {
    "precision": ("precision", "sensor"),
    "commercial": ("commercial", "sensor"),
    "precision, fixed sensor": ("precision", "none"),
}
MEASURES = {"l1": "mean L¹", "psnr": "PSNR, dB"}
_CHECK = 6  # cameras of the test with DRT PSFs
_PATCHES = 240  # of the test, recorded by every camera


def settings_of(training: str, seed: int) -> CodesignSettings:
    """Of a training on the nominal lens, or on those of a build."""
    grade, refocus = BUILDS.get(training, ("", "sensor"))
    return dataclasses.replace(BASE, as_built=bool(grade), grade=grade, refocus=refocus, seed=seed)


def train_one(
    lens: Lens, pictures: Pictures, settings: CodesignSettings, folder: Path, about: dict, start_of: Path | None = None
) -> float:
    """Train, or what remains of it, from the end of the run in another folder; processor time in s."""
    run, spent = Run(folder, {**dataclasses.asdict(settings), **about}), folder / "seconds.json"
    done = read_json(spent)["seconds"] if spent.exists() else 0.0
    trained, start = initial_camera(lens, settings), time.process_time()
    trained.plan()
    if start_of is not None:
        load_state(trained, read_state(start_of / "checkpoint.pt"), start_of)
    for _ in optimise(trained, pictures, settings, run):
        write_json(spent, {"seconds": done + time.process_time() - start})
    return read_json(spent)["seconds"]


def restored(lens: Lens, settings: CodesignSettings, folder: Path, build: str, psf: str) -> Camera:
    """A trained camera with the tolerances of a build."""
    grade, refocus = BUILDS[build]
    tested = initial_camera(lens, dataclasses.replace(settings, grade=grade, refocus=refocus))
    tested.use(psf)
    tested.plan()  # at the start, so that all trainings have the same PSFs
    run = Run(folder, read_json(folder / "settings.json"))
    load_state(tested, run.load(), run.checkpoint)
    return tested.requires_grad_(False)


def tested(lens: Lens, pictures: Pictures, settings: CodesignSettings, folder: Path, build: str, psf: str) -> dict:
    """Means over the perturbed cameras of a build, their standard deviation, and the least PSNR."""
    path = folder / f"{file_name(build)}_{psf}.json"
    if not path.exists():
        built = restored(lens, settings, folder, build, psf)
        of_test = dataclasses.replace(settings, cameras=_CHECK if psf == "drt" else settings.cameras, batch=_PATCHES)
        l1, ratio = errors_as_built(built, pictures, of_test, set_number=settings.seed)
        write_json(path, {"l1": l1.tolist(), "psnr": ratio.tolist()})
    found = {name: np.array(numbers) for name, numbers in read_json(path).items()}
    return {
        **{name: float(numbers.mean()) for name, numbers in found.items()},
        **{f"{name}_spread": float(numbers.std(ddof=1)) for name, numbers in found.items()},
        "psnr_least": float(found["psnr"].min()),
    }


def interval(differences: list[float]) -> tuple[float, float]:
    """Mean and half width of its 95 % confidence interval by Student's t."""
    count = len(differences)
    width = student.ppf(0.975, count - 1) * np.std(differences, ddof=1) / np.sqrt(count) if count > 1 else np.nan
    return float(np.mean(differences)), float(width)


def paired(rows: list[dict], build: str, psf: str, measure: str) -> list[float]:
    """As-built less nominal training, by seed."""
    found = {(row["training"], row["seed"]): row[measure] for row in rows if (row["build"], row["psf"]) == (build, psf)}
    seeds = [seed for training, seed in found if training == build and ("nominal", seed) in found]
    return [found[build, seed] - found["nominal", seed] for seed in seeds]


def table(rows: list[dict]) -> str:
    """The table of the page."""
    lines = [
        "| perturbed cameras | PSFs of the test | seeds | PSNR, nominal training | as-built training | "
        "difference (95 %) | L¹, nominal | as-built | difference (95 %) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for build, psf in dict.fromkeys((row["build"], row["psf"]) for row in rows):
        each = {name: paired(rows, build, psf, name) for name in MEASURES}
        if not each["l1"]:
            continue
        words = [build, psf, str(len(each["l1"]))]
        for name, form in (("psnr", ".3f"), ("l1", ".5f")):
            of = [r for r in rows if (r["build"], r["psf"]) == (build, psf)]
            for training in ("nominal", build):
                words.append(f"{np.mean([r[name] for r in of if r['training'] == training]):{form}}")
            mean, width = interval(each[name])
            words.append(f"{mean:+{form}} ± {width:{form}}")
        lines.append("| " + " | ".join(words) + " |")
    return "\n".join(lines)


def figure(differences: dict[str, dict[str, list[float]]]):
    """Differences of measures, of every seed and with the mean and its interval, by build."""
    drawn = new_figure(7.0, 3.2)
    panels = drawn.subplots(1, 2)
    for panel, measure in zip(panels, ("psnr", "l1"), strict=True):
        builds = differences[measure]
        for number, (values, colour) in enumerate(zip(builds.values(), FIELD_COLOURS, strict=False)):
            words = (None, None) if number else ("a seed", "mean, 95 % interval")
            panel.plot([number - 0.15] * len(values), values, "o", ms=3.5, color=GREY, label=words[0])
            mean, width = interval(values)
            panel.errorbar(number + 0.1, mean, width, fmt="s", capsize=4, ms=5, color=colour, label=words[1])
        panel.axhline(0, color=INK, linewidth=0.8, linestyle=":")
        panel.set_xticks(range(len(builds)), [b.replace(", ", ",\n") for b in builds], fontsize=8)
        panel.set(xlim=(-0.5, len(builds) - 0.5), ylabel=f"difference of {MEASURES[measure]}")
    panels[0].legend(fontsize=8)
    return drawn


def save(rows: list[dict], drawn, stem: Path) -> None:
    """The rows as stem.csv and the figure as stem.png."""
    with open(stem.with_suffix(".csv"), "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*rows[0]], lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    drawn.savefig(stem.with_suffix(".png"), dpi=150, bbox_inches="tight")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lens")
    parser.add_argument("--data", required=True, help="folder of pictures")
    parser.add_argument("--limit", type=int, help="use so many pictures, evenly spaced")
    parser.add_argument("-o", dest="folder", type=Path, required=True, help="folder of the trainings")
    parser.add_argument("--docs", type=Path, help="folder of documentation, for the table and the figure")
    parser.add_argument("--start", type=int, default=1, help="epochs of the common start")
    parser.add_argument("--steps", type=int, default=120, help="of a training from there, in whole epochs")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--builds", nargs="+", default=["precision", "commercial"], choices=[*BUILDS])
    parser.add_argument("--check", action="store_true", help="test with DRT PSFs as well")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    chosen = parser.parse_args(words)
    torch.set_num_threads(1)
    prepare()
    lens = as_lens(chosen.lens, "the study")
    pictures = read(files(chosen.data, chosen.limit), least=BASE.patch + BASE.size - 1)
    of_training, of_test = split(pictures)
    about = {"lens": chosen.lens, "pictures": digest(pictures.samples)}
    chosen.folder.mkdir(parents=True, exist_ok=True)
    trainings = ["nominal", *chosen.builds]
    per_epoch, spent = steps_per_epoch(of_training, BASE), {}
    for seed in range(chosen.seeds):
        start = chosen.folder / f"start_{seed}"
        settings = dataclasses.replace(settings_of("nominal", seed), epochs=chosen.start, decay="none")
        train_one(lens, of_training, settings, start, about)
        for training in trainings:
            epochs = max(1, round(chosen.steps / per_epoch))
            settings = dataclasses.replace(settings_of(training, seed), epochs=epochs)
            folder = chosen.folder / f"{file_name(training)}_{seed}"
            seconds = train_one(lens, of_training, settings, folder, about, start)
            spent[training, seed] = (settings, folder, epochs * per_epoch, seconds)
            print(f"{training}, seed {seed}: {epochs * per_epoch} steps, {seconds:.0f} s", flush=True)
        rows = _rows(lens, of_test, spent, chosen)
        print(table(rows), flush=True)
    if chosen.docs:
        builds = [build for build in chosen.builds if paired(rows, build, "gaussian", "psnr")]
        differences = {m: {b: paired(rows, b, "gaussian", m) for b in builds} for m in MEASURES}
        save(rows, figure(differences), chosen.docs / "codesign_as_built_network")


def file_name(words: str) -> str:
    return words.replace(", ", "_").replace(" ", "_")


def _rows(lens: Lens, pictures: Pictures, spent: dict, chosen: argparse.Namespace) -> list[dict]:
    """A row for each finished training, build and PSF of the test."""
    rows = []
    for build in chosen.builds:
        for psf in ("gaussian", "drt") if chosen.check else ("gaussian",):
            for (training, seed), (settings, folder, steps, seconds) in spent.items():
                if training in ("nominal", build):
                    means = tested(lens, pictures, settings, folder, build, psf)
                    row = {"build": build, "psf": psf, "training": training, "seed": seed}
                    rows.append({**row, "steps": steps, "seconds": seconds, **means})
    return rows


if __name__ == "__main__":
    main()
