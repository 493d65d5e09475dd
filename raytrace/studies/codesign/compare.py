"""`raytrace codesign compare`: every model and seed, and the page about them."""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from raytrace.camera.training import Run, share
from raytrace.cli.door import CommandError, say
from raytrace.cli.run import present
from raytrace.files import table
from raytrace.pages import machine
from raytrace.studies.codesign import figures, optima
from raytrace.studies.codesign import study as runs
from raytrace.studies.codesign.claims import is_of_paper
from raytrace.studies.codesign.closed_form import even_distances, scan
from raytrace.studies.codesign.experiment import STEPS, Outcome, batch, camera, lens_at_start, outcome, usual
from raytrace.studies.codesign.page import CAPTIONS, Report
from raytrace.studies.codesign.settings import AFTER_PARAXIAL, MODELS, NAMES, Settings
from raytrace.studies.codesign.setup import (
    Experiment,
    conjugates,
    experiment,
    recorded,
    refuse_too_few,
    settings_of,
    train_run,
)
from raytrace.studies.options import read
from raytrace.studies.pictures import dead_leaves
from raytrace.studies.publish import publish


def compare(arguments: argparse.Namespace) -> None:
    """Train what is missing, then write table, figures and page from what is there."""
    if not arguments.folder:
        raise CommandError("no folder to keep the runs in: give -o FOLDER")
    study = Path(arguments.folder)
    begun = study / "settings.json"
    if (arguments.resume or arguments.report_only) and not begun.exists():
        raise CommandError(f"{study}: no study was begun here")
    given = experiment(arguments, _recorded_settings(begun) if arguments.report_only else settings_of(arguments, begun))
    refuse_too_few(given)
    common = {k: v for k, v in dataclasses.asdict(given.settings).items() if k not in ("model", "seed")}
    Run(
        study, {**common, **given.about}, usual=usual(given.settings)
    )  # refuses a folder begun with other settings, lens or pictures
    models, seeds = _asked(arguments, study)
    if not arguments.report_only:
        _train(given, study, models, seeds)
    if share().rank:
        return  # the first process writes
    report = _report(given, study, models, seeds, Path(arguments.docs or study), arguments.page or "codesign")
    present(report, arguments)
    nowhere = [one for one in (*report.optima, *report.found) if one.no_optimum]
    for one in nowhere:
        kind = "the closed form" if isinstance(one, optima.Optimum) else f"seed {one.seed}"
        say(f"warning: {one.model}, {kind}: {one.no_optimum}")
    if nowhere and len(nowhere) == len(report.optima) + len(report.found):
        raise CommandError("no model has an optimum; see the warnings, and choose other --near, --far, --bounds")


def _recorded_settings(path: Path) -> Settings:
    known = {field.name for field in dataclasses.fields(Settings)}
    return read(Settings, {key: value for key, value in recorded(path).items() if key in known})


def _asked(arguments: argparse.Namespace, study: Path) -> tuple[list[str], list[int]]:
    """Models, in the order of the table, and seeds: those asked for; for a mere report those that were begun."""
    begun = [(row, int(path.name[len(row) + 1 :])) for row in NAMES for path in study.glob(f"{row}-[0-9]*")]
    usual_models, usual_seeds = list(MODELS), [0, 1, 2]
    if arguments.report_only and begun:
        usual_models, usual_seeds = [row for row, _ in begun], sorted({seed for _, seed in begun})
    models = [row for row in NAMES if row in (arguments.models or usual_models)]
    seeds = list(dict.fromkeys(arguments.seeds or usual_seeds))
    is_lacking = any(outcome(runs.run_folder(study, "paraxial", seed)) is None for seed in seeds)
    if AFTER_PARAXIAL in models and "paraxial" not in models and is_lacking:
        raise CommandError(f"{AFTER_PARAXIAL} begins where paraxial ended: add paraxial to --models")
    return models, seeds


def _train(given: Experiment, study: Path, models: Sequence[str], seeds: Sequence[int]) -> None:
    # Seeds outside: a study that is stopped has compared as many models as possible.
    asked = [(row, seed) for seed in seeds for row in models]
    for number, (row, seed) in enumerate(asked, 1):
        own = runs.run_settings(study, row, seed, given.settings)
        train_run(given, own, runs.run_folder(study, row, seed), f"{number}/{len(asked)} {row} {seed}")


def _report(
    given: Experiment, study: Path, models: Sequence[str], seeds: Sequence[int], docs: Path, page: str
) -> Report:
    """Write everything; returns what the page says."""
    found = runs.outcomes(study, models, seeds)
    done = {(one.model, one.seed) for one in found}
    own = [dataclasses.replace(given.settings, model=model) for model in models if model in MODELS]
    say("the closed form, and the time of a step, of every model")
    spectrum = given.spectrum()
    best = optima.closed_forms(given.lens, given.settings, spectrum, models)
    times = [runs.step_time(camera(given.lens, s), batch(given.train, s, list(range(s.batch)), 0)) for s in own]
    drawn = _training_figures(given, study, found) | _lens_figures(given, study, found)
    drawn |= _scan_figure(given, spectrum, best, found)
    report = Report(
        lens=given.name,
        pictures=f"{len(given.train)} {given.kind} to train on, {len(given.test)} to test",
        settings=given.settings,
        found=tuple(found),
        missing=tuple((row, seed) for seed in seeds for row in models if (row, seed) not in done),
        optima=tuple(best),
        times=tuple(times),
        figures=tuple(name for name in CAPTIONS if name in drawn),
        machine=machine(),
        sweep=(docs / "codesign_sweep.md").exists(),
        folder=page,
        of_paper=is_of_paper(given.lens),
    )
    tables = {"table2.csv": table(found, runs.COLUMNS), "spectral.csv": table(best, optima.COLUMNS)}
    publish(docs / f"{page}.md", page, report.parts(), tables=tables, figures=drawn)
    return report


def _training_figures(given: Experiment, study: Path, found: Sequence[Outcome]) -> Mapping[str, figures.Figure]:
    joint, refined = (runs.courses(study, found, "loss", step) for step in STEPS)
    if not joint:
        return {}
    drawn = {"loss.png": figures.loss_figure(joint, refined, given.steps_per_epoch)}
    if sensors := runs.courses(study, found, "sensor"):
        scale = conjugates(given.lens, given.settings)
        drawn["focus.png"] = figures.focus_figure(sensors, scale, given.steps_per_epoch)
    return drawn


def _lens_figures(given: Experiment, study: Path, found: Sequence[Outcome]) -> Mapping[str, figures.Figure]:
    """Blur and loss over object distance, and restored examples of the first seed."""
    if not found:
        return {}
    near, far = given.settings.near, given.settings.far
    distances, shown = np.linspace(near, far, 41), [near + part * (far - near) for part in (0, 0.25, 0.5, 1)]
    diameters: dict[str, list[list[float]]] = {}
    restored: dict[str, dict[str, np.ndarray]] = {}
    leaves = dead_leaves(2, size=2 * (given.settings.patch + given.settings.size))
    for one in found:
        settings = runs.run_settings(study, one.model, one.seed, given.settings)
        own = runs.trained(given.lens, settings, runs.run_folder(study, one.model, one.seed))
        lens = own.variables()
        blur = runs.blur_diameters(lens, lens.wavelengths.new_tensor(distances)).tolist()
        diameters.setdefault(one.model, []).append(blur)
        if one.model not in restored:
            # Of dead leaves: the page may be published, pictures of a data set often may not.
            patches = runs.examples(own, leaves, settings, shown)
            restored[one.model] = {key: patch.float().numpy() for key, patch in patches.items()}
    means = {model: np.mean(seeds, 0).tolist() for model, seeds in diameters.items()}
    return {
        "blur.png": figures.blur_figure(distances.tolist(), means, given.settings.pixel),
        "distance.png": figures.distance_figure(*runs.losses_by_distance(found)),
        "examples.png": figures.examples_figure(restored, shown),
    }


def _scan_figure(
    given: Experiment, spectrum: Tensor, best: Sequence[optima.Optimum], found: Sequence[Outcome]
) -> Mapping[str, figures.Figure]:
    """The closed form over the sensor's place, if the sensor is what varies."""
    if given.settings.vary.split() != ["sensor"] or not best:
        return {}
    ends = {one.model: one.mean["sensor_mm"] for one in runs.summaries(found)}
    start = float(lens_at_start(given.lens, given.settings).surfaces[-2].thickness)
    places = [start, *(one.sensor_mm for one in best), *ends.values()]
    margin = 0.15 * (max(places) - min(places)) + 0.02
    sensors = np.linspace(min(places) - margin, max(places) + margin, 41).tolist()
    own = {m: camera(given.lens, dataclasses.replace(given.settings, model=m)) for m in MODELS}
    distances = {m: even_distances(own[m], spread=given.settings.spread) for m in MODELS}
    errors = {
        one.model: scan(own[one.model], spectrum, sensors, distances[one.model]) for one in best if one.model in MODELS
    }
    return {"scan.png": figures.scan_figure(sensors, errors, ends)}
