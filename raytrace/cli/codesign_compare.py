"""`raytrace codesign compare`: train every model and seed, and write the page of the results."""

import argparse
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from raytrace.cli.codesign import ROWS
from raytrace.cli.codesign_runs import (
    Experiment,
    conjugates,
    experiment,
    focus_of,
    recorded_settings,
    refuse_too_few,
    settings_of,
    single,
    spectral,
    train_run,
)
from raytrace.cli.run import CommandError, present, say
from raytrace.cli.settings import words
from raytrace.experiments import publish
from raytrace.files import table
from raytrace.imaging import codesign_study as runs
from raytrace.imaging.closed_form import even_distances, scan
from raytrace.imaging.codesign import (
    OPTIMUM_COLUMNS,
    STEPS,
    Optimum,
    Outcome,
    batch,
    camera,
    closed_forms,
    lens_at_start,
    outcome,
    usual,
)
from raytrace.imaging.codesign_study import StepTime, Summary, penalty, percent, rows, summaries
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.training import Run, share
from raytrace.maths.result import Result, plain
from raytrace.pages import grid, machine, picture, shown
from raytrace.plotting import codesign as figures
from raytrace.settings import AFTER_PARAXIAL, GAUSSIAN, MODELS, NAMES, CodesignSettings
from raytrace.shards import processes
from raytrace.system.lens import Lens
from raytrace.words import did_you_mean

#: Figures of the page, by file name: what each shows.
CAPTIONS = {
    "loss.png": "Loss in training, mean of every epoch; bands: range over seeds.",
    "focus.png": "The sensor in training, and the object distance whose paraxial image it is.",
    "blur.png": "RMS blur of traced rays on the axis, of the learned lenses.",
    "distance.png": "Loss of test pictures with DRT PSFs after step 2, over object distance.",
    "examples.png": "A patch of dead leaves as the sensor sees it and restored, with DRT PSFs after step 2.",
    "scan.png": "Expected error behind the best linear filter, over the sensor distance: without a network, without "
    "drawn noise.",
}


@dataclasses.dataclass(frozen=True)
class Publication:
    """A published table and claims that a page compares its results with.

    command: that makes the page; columns, numbers: headings of further columns of the table, and their text by model;
    note: about the published focus; claims: of a report, each with text, criterion, figures and answer; closed_form: a
    sentence below the table of the closed form.
    """

    command: str
    columns: Sequence[str]
    numbers: Mapping[str, Sequence[str]]
    note: str
    claims: Callable[["Report"], Sequence]
    closed_form: str = ""


@dataclasses.dataclass(frozen=True)
class Report(Result):
    """All that a page says.

    missing: (row, seed) of runs that are not finished; figures: file names that exist; folder: next to the page, of
    tables and figures; distances (m), blur (mm): RMS diameters of traced rays of the optimised lenses by model;
    settled: fraction of step 1 after which the paraxial focus stays within 2 m of its end, mean over seeds, by model.
    """

    lens: str
    pictures: str
    settings: CodesignSettings
    found: tuple[Outcome, ...]
    missing: tuple[tuple[str, int], ...]
    optima: tuple[Optimum, ...]
    times: tuple[StepTime, ...]
    figures: tuple[str, ...]
    machine: Mapping[str, str | int]
    folder: str = "codesign"
    distances: tuple[float, ...] = ()
    blur: Mapping[str, Sequence[float]] = dataclasses.field(default_factory=dict)
    settled: Mapping[str, float] = dataclasses.field(default_factory=dict)
    publication: Publication | None = None

    @property
    def claims(self) -> Sequence:
        """Those of the publication."""
        return self.publication.claims(self) if self.publication else ()

    def document(self) -> dict:
        return plain(
            {
                "settings": dataclasses.asdict(self.settings),
                "rows": rows(self.found),
                "missing": [{"model": row, "seed": seed} for row, seed in self.missing],
                "models": [dataclasses.asdict(one) for one in summaries(self.found)],
                "claims": [{**dataclasses.asdict(one), "answer": one.answer} for one in self.claims],
                "closed_form": [one.document() for one in self.optima],
                "times": [dataclasses.asdict(one) for one in self.times],
            }
        )

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        columns = ("L1 step 1", "L1 step 2", "paraxial m", "RMS m", "sensor mm")
        yield f"{'model':>26} {'seeds':>5} " + " ".join(f"{column:>10}" for column in columns)
        for one in summaries(self.found):
            mean = one.mean
            yield (
                f"{NAMES[one.model]:>26} {one.seeds:>5} {mean['l1_joint']:>10.5f} {mean['l1_drt']:>10.5f} "
                f"{mean['focus_paraxial_m']:>10.2f} {mean['focus_rms_m']:>10.2f} {mean['sensor_mm']:>10.4f}"
            )
        for claim in self.claims:
            yield f"{claim.answer:>11}: {claim.text}; {claim.figures}"
        if self.missing:
            yield f"not finished: {', '.join(f'{row} {seed}' for row, seed in self.missing)}"

    def parts(self) -> list[str]:
        """The page."""
        asked = ("claim", "here", "figures", "yes if")
        answers = [(one.text, f"**{one.answer}**", one.figures, one.criterion) for one in self.claims]
        return [
            "# Co-design: which PSF model chooses the better lens?",
            _command(self),
            _experiment(self),
            _progress(self),
            "## Loss and focus",
            _table(self),
            *(["## The paper's claims", grid(asked, answers)] if answers else []),
            *(picture(f"{self.folder}/{name}", CAPTIONS[name]) for name in self.figures),
            "## The best linear filter and training",
            _closed_form(self),
            "## Time of a step",
            _times(self),
        ]


def _command(report: Report) -> str:
    models = list(dict.fromkeys([one.model for one in report.found] + [row for row, _ in report.missing]))
    seeds = sorted({one.seed for one in report.found} | {seed for _, seed in report.missing})
    page = [] if report.folder == "codesign" else [f"--page {report.folder}"]
    chosen = [f"--models {' '.join(models)}", f"--seeds {' '.join(map(str, seeds))}", *page]
    chosen += words(report.settings, ROWS)
    command = report.publication.command if report.publication else "raytrace codesign compare"
    return f"    {command} {report.lens} --data DIR -o FOLDER --docs docs {' '.join(chosen)}"


def _experiment(report: Report) -> str:
    s = report.settings
    aperture = "the file's aperture" if s.f_number is None else f"F/{s.f_number:g}"
    start = {
        "paraxial": f"the paraxial image of {s.focus_distance / 1e3:g} m",
        "rms": f"the least RMS spot of an object at {s.focus_distance / 1e3:g} m",
        "spectral": "the optimum of the closed form",
        GAUSSIAN: "the optimum of the closed form of Gaussian DRT",
    }.get(s.start, f"{s.start} mm")
    where = "the axis" if s.fields == (0.0,) else f"the fields {_listed(s.fields)}"
    weights = f" weighted {_listed(s.wavelength_weights)}" if len(s.wavelengths) > 1 else ""
    counts = {"Gaussian DRT in step 1" if s.drt_rays else "step 1": s.rays, "DRT in both steps": s.drt_rays}
    traced = [f"{count} rays ({s.sampling}) for {where}" for where, count in counts.items() if count is not None]
    rays = f", traced with {' and '.join(traced)}" if traced else ""
    rays += "" if s.ray_aiming is None else f"; ray aiming {s.ray_aiming}"
    rays += "; rays beyond the semi-diameters are vignetted" if s.vignetting == "semi-diameters" else ""
    spread = "" if s.spread == "uniform" else " in 1/z"
    falling = "" if s.decay == "none" else ", falling to 0 along half a cosine"
    light = {"window": "the window", "energy": "the light through the pupil"}[s.normalise]
    return (
        f"{report.lens} at {aperture}, {_listed(s.wavelengths)} µm{weights}, on {where}; objects at {s.near / 1e3:g} "
        f"to {s.far / 1e3:g} m, drawn evenly{spread}; windows of {s.size} × {s.size} pixels of {1e3 * s.pixel:g} µm, "
        f"PSFs normalised to {light}{rays}; noise of standard deviation {s.noise:g} on pictures in [0, 1]. Learned: "
        f"{s.vary}, from {start}. RED-Net of {s.depth} layers of {s.width} maps in {s.precision}, L¹ loss, Adam at "
        f"{s.rate_network:g} (network) and {s.rate_optics:g} (lens){falling}, {s.epochs} epochs of each step, batches "
        f"of {s.batch} patches of {s.patch} × {s.patch}. {report.pictures}."
    )


def _listed(numbers: Sequence[float]) -> str:
    return ", ".join(f"{one:g}" for one in numbers)


def _progress(report: Report) -> str:
    if not report.missing:
        return ""
    missing = ", ".join(f"{row} {seed}" for row, seed in report.missing)
    done = len(report.found)
    return f"**Unfinished: {done} of {done + len(report.missing)} runs.** Missing, by model and seed: {missing}."


def _table(report: Report) -> str:
    found, publication = report.found, report.publication
    if not found:
        return "No run is finished yet."
    header = (
        "model", "seeds", "L¹, step 1", "L¹, step 2 (DRT)", "change", "focus, paraxial (m)", "focus, RMS (m)",
        "sensor (mm)", "mean of the last two epochs (mm)",
        *(publication.columns if publication else ()),
    )  # fmt: skip
    lines = [
        (
            NAMES[one.model],
            one.seeds,
            _spread(one, "l1_joint", 4),
            _spread(one, "l1_drt", 4),
            percent(penalty(one)),
            _spread(one, "focus_paraxial_m", 1),
            _spread(one, "focus_rms_m", 1),
            _spread(one, "sensor_mm", 4),
            _spread(one, "sensor_last_epochs_mm", 4),
            *(publication.numbers.get(one.model, ["–"] * len(publication.columns)) if publication else ()),
        )
        for one in summaries(found)
    ]
    return (
        f"{grid(header, lines)}\n\nMean ± standard deviation over seeds, of test pictures; every model of a seed sees "
        "the same crops, distances and noise. Focus is the object distance from vertex 1 whose image is on the sensor: "
        f"the paraxial one, or that of least RMS spot{publication.note if publication else ''}."
        f" Rows one by one, with the range of the sensor in the last two epochs of step 1: "
        f"[table2.csv]({report.folder}/table2.csv); by object distance: "
        f"[distance.csv]({report.folder}/distance.csv)."
    )


def _closed_form(report: Report) -> str:
    trained = {one.model: one for one in summaries(report.found)}
    header = (
        "model", "sensor (mm)", "trained (mm)", "focus, paraxial (m)", "focus, RMS (m)", "error, own PSFs",
        "error, DRT PSFs",
    )  # fmt: skip
    lines = [
        (
            NAMES[one.model],
            f"{one.sensor_mm:.4f}" + (" (no optimum)" if one.no_optimum else ""),
            _spread(trained[one.model], "sensor_mm", 4) if one.model in trained else "–",
            shown(one.focus_paraxial_m, 1),
            shown(one.focus_rms_m, 1),
            f"{one.error:.6f}",
            f"{one.error_drt:.6f}",
        )
        for one in report.optima
    ]
    scanned = (
        f"; over the sensor distance: [scan.csv]({report.folder}/scan.csv)" if "scan.png" in report.figures else ""
    )
    return (
        f"{grid(header, lines)}\n\nMean square error of a pixel behind the best linear filter that does not know the "
        f"object distance, for pictures of this power spectrum: [spectral.csv]({report.folder}/spectral.csv){scanned}."
        f"{f' {report.publication.closed_form}' if report.publication and report.publication.closed_form else ''}"
    )


def _times(report: Report) -> str:
    lines = [(NAMES[one.model], *(f"{ms:.1f}" for ms in (one.psf, one.image, one.network))) for one in report.times]
    about = ", ".join(f"{key} {value}" for key, value in report.machine.items())
    table = grid(("model", "PSFs (ms)", "image (ms)", "network (ms)"), lines)
    return f"{table}\n\nA batch, forward and backward, median of several, the models in turns: {about}."


def _spread(one: Summary, column: str, digits: int) -> str:
    mean, deviation = shown(one.mean[column], digits), shown(one.deviation[column], digits)
    return f"{mean} ± {deviation}" if one.seeds > 1 and math.isfinite(one.deviation[column]) else mean


# -- the command -------------------------------------------------------------------------------------------------------


def compare(
    arguments: argparse.Namespace, publication: Callable[[Lens], Publication | None] = lambda lens: None
) -> None:
    """Train the missing runs, then write table, figures and page from the finished ones.

    publication: of a lens, that the results are compared with.
    """
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
    docs, page = Path(arguments.docs or study), arguments.page or "codesign"
    report = _report(given, study, models, seeds, docs, page, publication(given.lens))
    present(report, arguments)
    nowhere = [one for one in (*report.optima, *report.found) if one.no_optimum]
    for one in nowhere:
        kind = "the closed form" if isinstance(one, Optimum) else f"seed {one.seed}"
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
    given: Experiment,
    study: Path,
    models: Sequence[str],
    seeds: Sequence[int],
    docs: Path,
    page: str,
    publication: Publication | None,
) -> Report:
    """Write everything; returns what the page says."""
    focus = focus_of(given.lens, given.settings)
    found = runs.with_last_epochs(study, runs.outcomes(study, models, seeds), given.settings.epochs, focus)
    done = {(one.model, one.seed) for one in found}
    own = [dataclasses.replace(given.settings, model=model) for model in models if model in MODELS]
    say("the closed form, and the time of a step, of every model")
    spectrum = given.spectrum()
    best = closed_forms(given.lens, given.settings, spectrum, models)
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
        folder=page,
        distances=tuple(_distances(given) / 1e3),
        blur=blur,
        settled=_settled(given, study, found, focus),
        publication=publication,
    )
    tables = {
        "table2.csv": table(found, runs.COLUMNS),
        "distance.csv": table(runs.distance_rows(found), runs.DISTANCE_COLUMNS),
        "blur.csv": _curves(("model", "distance_m", "diameter_um"), report.distances, blur, 1e3),
        "spectral.csv": table(best, OPTIMUM_COLUMNS),
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
    """Object distances in mm of the blur curves."""
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
    given: Experiment, spectrum: Tensor, best: Sequence[Optimum], found: Sequence[Outcome]
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


#: Options that only one form of the command has.
_OF_COMPARE = ("models", "seeds", "report_only", "docs", "page")
_OF_ONE_RUN = ("model", "seed")


def run(arguments: argparse.Namespace) -> None:
    """Train one model, or bring it to the optimum of the closed form; after the word `compare` train all of them."""
    *form, arguments.lens = arguments.words
    if form not in ([], ["compare"]):
        meant = did_you_mean(form[0], ("compare",))
        raise CommandError(f"{' '.join(arguments.words)}: expected LENS, or compare LENS{meant}")
    for name in _OF_ONE_RUN if form else _OF_COMPARE:
        if getattr(arguments, name) not in (None, False):
            owner = "codesign LENS" if form else "codesign compare LENS"
            raise CommandError(f"--{name.replace('_', '-')} belongs to {owner}")
    if form and arguments.loss == "spectral":
        raise CommandError("--loss spectral belongs to codesign LENS; compare uses the closed form anyway")
    if arguments.resume and arguments.loss == "spectral":
        raise CommandError("--resume belongs to training; leave out --resume or --loss spectral")
    with processes():
        if form:
            compare(arguments)
        elif arguments.loss == "spectral":
            spectral(arguments)
        else:
            single(arguments)
