"""`raytrace codesign compare`: every model and seed, and the page about them."""

import argparse
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from raytrace.cli.door import CommandError, say
from raytrace.cli.run import present
from raytrace.files import table
from raytrace.imaging.training import Run, share
from raytrace.pages import machine
from raytrace.studies.codesign import figures, optima
from raytrace.studies.codesign import study as runs
from raytrace.studies.codesign.claims import Seen, is_of_paper
from raytrace.studies.codesign.closed_form import even_distances, scan
from raytrace.studies.codesign.experiment import STEPS, Outcome, batch, camera, lens_at_start, outcome, usual
from raytrace.studies.codesign.page import CAPTIONS, Report
from raytrace.studies.codesign.settings import AFTER_PARAXIAL, MODELS, NAMES
from raytrace.studies.codesign.setup import (
    Experiment,
    conjugates,
    experiment,
    focus_of,
    recorded_settings,
    refuse_too_few,
    settings_of,
    train_run,
)
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
    given = experiment(arguments, recorded_settings(begun) if arguments.report_only else settings_of(arguments, begun))
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


def _asked(arguments: argparse.Namespace, study: Path) -> tuple[list[str], list[int]]:
    """Models, in the order of the table, and seeds: those asked for; for a mere report those that were begun."""
    begun = runs.begun(study)
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
    focus = focus_of(given.lens, given.settings)
    found = runs.with_last_epochs(study, runs.outcomes(study, models, seeds), given.settings.epochs, focus)
    done = {(one.model, one.seed) for one in found}
    own = [dataclasses.replace(given.settings, model=model) for model in models if model in MODELS]
    say("the closed form, and the time of a step, of every model")
    spectrum = given.spectrum()
    best = optima.closed_forms(given.lens, given.settings, spectrum, models)
    crops = batch(given.train, given.settings, list(range(given.settings.batch)), 0)
    times = runs.step_times([camera(given.lens, s) for s in own], crops)
    blur = _blur(given, study, found)
    drawn = _training_figures(given, study, found) | _lens_figures(given, study, found, blur)
    scanned = _scan(given, spectrum, best, found)
    if scanned:
        ends = {one.model: one.mean["sensor_mm"] for one in runs.summaries(found)}
        drawn["scan.png"] = figures.scan_figure(*scanned, ends)
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
        seen=Seen(tuple(_distances(given) / 1e3), blur, _settled(given, study, found, focus)),
    )
    tables = {
        "table2.csv": table(found, runs.COLUMNS),
        "distance.csv": table(runs.distance_rows(found), runs.DISTANCE_COLUMNS),
        "blur.csv": _curves(("model", "distance_m", "diameter_um"), report.seen.distances, blur, 1e3),
        "spectral.csv": table(best, optima.COLUMNS),
    }
    if scanned:
        tables["scan.csv"] = _curves(("model", "sensor_mm", "error"), *scanned)
    publish(docs / f"{page}.md", page, report.parts(), tables=tables, figures=drawn)
    return report


def _curves(
    columns: Sequence[str], places: Sequence[float], values: Mapping[str, Sequence[float]], scale: float = 1
) -> str:
    """A table of values of every model at places, a row for each."""
    return table(
        [
            dict(zip(columns, (model, place, scale * value), strict=True))
            for model, own in values.items()
            for place, value in zip(places, own, strict=True)
        ],
        columns,
    )


def _training_figures(given: Experiment, study: Path, found: Sequence[Outcome]) -> Mapping[str, figures.Figure]:
    joint, refined = (runs.courses(study, found, "loss", step) for step in STEPS)
    if not joint:
        return {}
    drawn = {"loss.png": figures.loss_figure(joint, refined, given.steps_per_epoch)}
    if sensors := runs.courses(study, found, "sensor"):
        scale = conjugates(given.lens, given.settings)
        drawn["focus.png"] = figures.focus_figure(sensors, scale, given.steps_per_epoch)
    return drawn


def _distances(given: Experiment) -> np.ndarray:
    """Object distances in mm over which blur is told."""
    return np.linspace(given.settings.near, given.settings.far, 41)


def _blur(given: Experiment, study: Path, found: Sequence[Outcome]) -> dict[str, list[float]]:
    """RMS blur diameters in mm of the learned lenses over object distances, the mean over seeds, by model."""
    diameters: dict[str, list[list[float]]] = {}
    for one in found:
        settings = runs.run_settings(study, one.model, one.seed, given.settings)
        lens = runs.trained(given.lens, settings, runs.run_folder(study, one.model, one.seed)).variables()
        blur = runs.blur_diameters(lens, lens.wavelengths.new_tensor(_distances(given)))
        diameters.setdefault(one.model, []).append(blur.tolist())
    return {model: np.mean(seeds, 0).tolist() for model, seeds in diameters.items()}


def _settled(
    given: Experiment, study: Path, found: Sequence[Outcome], focus: Callable[[float], float] | None
) -> dict[str, float]:
    """The part of step 1 behind which the mean focus of an epoch stays within 2 m of its end, by model."""
    if focus is None:
        return {}
    courses, size = runs.courses(study, found, "sensor"), given.steps_per_epoch
    by_epoch = {
        model: [[focus(float(np.mean(one[i : i + size]))) for i in range(0, len(one), size)] for one in seeds]
        for model, seeds in courses.items()
    }
    return {model: float(np.mean([runs.settled(one) for one in seeds])) for model, seeds in by_epoch.items()}


def _lens_figures(
    given: Experiment, study: Path, found: Sequence[Outcome], blur: Mapping[str, Sequence[float]]
) -> Mapping[str, figures.Figure]:
    """Blur and loss over object distance, and restored examples of the first seed."""
    if not found:
        return {}
    near, far = given.settings.near, given.settings.far
    shown = [near + part * (far - near) for part in (0, 0.25, 0.5, 1)]
    restored: dict[str, dict[str, np.ndarray]] = {}
    leaves = dead_leaves(2, size=2 * (given.settings.patch + given.settings.size))
    for one in found:
        if one.model not in restored:
            settings = runs.run_settings(study, one.model, one.seed, given.settings)
            own = runs.trained(given.lens, settings, runs.run_folder(study, one.model, one.seed))
            # Of dead leaves: the page may be published, pictures of a data set often may not.
            patches = runs.examples(own, leaves, settings, shown)
            restored[one.model] = {key: patch.float().numpy() for key, patch in patches.items()}
    return {
        "blur.png": figures.blur_figure(_distances(given).tolist(), dict(blur), given.settings.pixel),
        "distance.png": figures.distance_figure(*runs.losses_by_distance(found)),
        "examples.png": figures.examples_figure(restored, shown),
    }


def _scan(
    given: Experiment, spectrum: Tensor, best: Sequence[optima.Optimum], found: Sequence[Outcome]
) -> tuple[list[float], dict[str, list[float]]] | None:
    """Sensors in mm, and errors of the closed form there by model; None unless the sensor alone is what varies."""
    if given.settings.vary.split() != ["sensor"] or not best:
        return None
    start = float(lens_at_start(given.lens, given.settings).surfaces[-2].thickness)
    places = [start, *(one.sensor_mm for one in best), *(one.mean["sensor_mm"] for one in runs.summaries(found))]
    margin = 0.15 * (max(places) - min(places)) + 0.02
    sensors = np.linspace(min(places) - margin, max(places) + margin, 41).tolist()
    own = {m: camera(given.lens, dataclasses.replace(given.settings, model=m)) for m in MODELS}
    distances = {m: even_distances(own[m], spread=given.settings.spread) for m in MODELS}
    return sensors, {
        one.model: scan(own[one.model], spectrum, sensors, distances[one.model]) for one in best if one.model in MODELS
    }
