"""A study of co-design: every PSF model and seed trained, and the page of the results.

    python docs/experiments/codesign.py double_gauss --data DIR -o FOLDER --docs docs
    python docs/experiments/codesign.py double_gauss --data DIR -o F1.9 --docs docs --page codesign_f1.9 --f-number 1.9

Settings are those of `raytrace codesign`, by default with lens and network trained together (`--optimizer adam`), as in
the published study, with which the page of the double Gauss compares the results.
"""

import argparse
import dataclasses
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import codesign_figures as figures
import codesign_study as runs
import numpy as np
from codesign_claims import PAPER, Claim, Measurements, claims, is_of_paper
from codesign_study import (
    AFTER_PARAXIAL,
    NAMES,
    StepTime,
    StudyOutcome,
    Summary,
    closed_forms,
    loss_increase,
    percent,
    summaries,
)
from experiments import publish
from pages import grid, picture, shown
from torch import Tensor

from raytrace.bench.result import machine
from raytrace.cli import codesign
from raytrace.cli.codesign_run import (
    Experiment,
    conjugates,
    focus_of,
    open_experiment,
    recorded_settings,
    settings_of,
    train_run,
)
from raytrace.cli.runner import CommandError, present, say
from raytrace.cli.settings import documents, words
from raytrace.cli.types import file_name, seed_number
from raytrace.files import table
from raytrace.imaging.closed_form import even_distances, scan
from raytrace.imaging.codesign import (
    OPTIMUM_COLUMNS,
    STEPS,
    Optimum,
    initial_camera,
    lens_at_start,
    make_batch,
    outcome,
)
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.training import Run
from raytrace.maths.result import Result, plain
from raytrace.settings import GAUSSIAN, MODELS, CodesignSettings
from raytrace.shards import processes, share
from raytrace.system.lens import Lens

#: Figures of the page by file name, and their captions.
CAPTIONS = {
    "loss.png": "Loss in training, mean of every epoch; bands: range over seeds.",
    "focus.png": "The sensor in training, and the object distance whose paraxial image it is; dashed: focus in the "
    "paper.",
    "blur.png": "RMS blur of traced rays on the axis, of the learned lenses; dashed: focus in the paper.",
    "distance.png": "Loss of test pictures with DRT PSFs after step 2, over object distance; dashed: mean losses "
    "in the paper.",
    "examples.png": "A patch of dead leaves: sensor image (left half) and restoration (right half), with DRT PSFs "
    "after step 2; L¹ of the whole restored patch.",
    "scan.png": "Expected error behind the best linear filter, over the sensor distance: without a network, without "
    "drawn noise.",
}
_TIME_COLUMNS = ("model", "psf_ms", "image_ms", "network_ms")
_CLAIM_COLUMNS = ("claim", "answer", "figures", "criterion")
_COMMAND = "python docs/experiments/codesign.py"
_PAPER_NOTE = "; “paper”: the published study of this lens and these models, which does not say which focus is its own"
_SWEEP = " At other apertures, ρ, noise, normalisations and distances: [sweep.csv](codesign/sweep.csv)."


@dataclasses.dataclass(frozen=True)
class Report(Result):
    """The contents of the page.

    missing: (row, seed) of unfinished runs; figures: file names that exist; folder: next to the page, of tables and
    figures; measured: of the optimised lenses; is_of_paper: the page compares the results with the published study.
    """

    lens: str
    pictures: str
    settings: CodesignSettings
    outcomes: tuple[StudyOutcome, ...]
    missing: tuple[tuple[str, int], ...]
    optima: tuple[Optimum, ...]
    times: tuple[StepTime, ...]
    figures: tuple[str, ...]
    machine: Mapping[str, str | int]
    folder: str = "codesign"
    measured: Measurements = dataclasses.field(default_factory=Measurements)
    is_of_paper: bool = False

    @property
    def claims(self) -> list[Claim]:
        """Those of the published study."""
        if not self.is_of_paper:
            return []
        return claims(self.outcomes, self.times, self.measured, pending={row for row, _ in self.missing})

    def document(self) -> dict:
        return plain(
            {
                "settings": dataclasses.asdict(self.settings),
                "rows": [{column: getattr(run, column) for column in runs.COLUMNS} for run in self.outcomes],
                "missing": [{"model": row, "seed": seed} for row, seed in self.missing],
                "models": [dataclasses.asdict(summary) for summary in summaries(self.outcomes)],
                "claims": [{**dataclasses.asdict(claim), "answer": claim.answer} for claim in self.claims],
                "closed_form": [optimum.document() for optimum in self.optima],
                "times": [dataclasses.asdict(time) for time in self.times],
            }
        )

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        columns = ("L1 step 1", "L1 step 2", "paraxial m", "RMS m", "sensor mm")
        yield f"{'model':>26} {'seeds':>5} " + " ".join(f"{column:>10}" for column in columns)
        for summary in summaries(self.outcomes):
            mean = summary.mean
            yield (
                f"{NAMES[summary.model]:>26} {summary.seeds:>5} {mean['l1_joint']:>10.5f} {mean['l1_drt']:>10.5f} "
                f"{mean['focus_paraxial_m']:>10.2f} {mean['focus_rms_m']:>10.2f} {mean['sensor_mm']:>10.4f}"
            )
        for claim in self.claims:
            yield f"{claim.answer:>11}: {claim.text}; {claim.figures}"
        if self.missing:
            yield f"not finished: {', '.join(f'{row} {seed}' for row, seed in self.missing)}"

    def parts(self) -> list[str]:
        """The page."""
        missing, done = ", ".join(f"{row} {seed}" for row, seed in self.missing), len(self.outcomes)
        all_runs = done + len(self.missing)
        unfinished = f"**Unfinished: {done} of {all_runs} runs.** Missing, by model and seed: {missing}."
        return [
            "# Co-design: which PSF model chooses the better lens?",
            _answer(self),
            _command(self),
            _experiment(self),
            unfinished if self.missing else "",
            "## Loss and focus",
            _table(self),
            *(picture(f"{self.folder}/{name}", CAPTIONS[name]) for name in self.figures),
            "## The best linear filter and training",
            _closed_form(self),
            _times(self),
        ]


def _answer(report: Report) -> str:
    ranked = sorted(summaries(report.outcomes), key=lambda summary: summary.mean["l1_drt"])
    losses = ", ".join(f"{NAMES[summary.model]} {summary.mean['l1_drt']:.4f}" for summary in ranked)
    text = f"**Test loss with DRT PSFs after step 2, by the model that chose the lens: {losses}.**" if ranked else ""
    if report.is_of_paper:
        holds = sum(claim.answer == "yes" for claim in report.claims)
        text += (
            f" Of {len(report.claims)} criteria for the claims of the paper {holds} are met: "
            f"[claims.csv]({report.folder}/claims.csv); which of them decide: [papers.md](papers.md)."
        )
    return text


def _command(report: Report) -> str:
    rows = list(dict.fromkeys([run.model for run in report.outcomes] + [row for row, _ in report.missing]))
    seeds = sorted({run.seed for run in report.outcomes} | {seed for _, seed in report.missing})
    page = [] if report.folder == "codesign" else [f"--page {report.folder}"]
    chosen = [f"--models {' '.join(rows)}", f"--seeds {' '.join(map(str, seeds))}", *page]
    chosen += words(report.settings, codesign.ROWS)
    return f"    {_COMMAND} {report.lens} --data DIR -o FOLDER --docs docs {' '.join(chosen)}"


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
    return ", ".join(f"{number:g}" for number in numbers)


def _table(report: Report) -> str:
    if not report.outcomes:
        return "No run is finished yet."
    header = [
        *("model", "seeds", "L¹, step 1", "L¹, step 2 (DRT)", "change", "focus, paraxial (m)", "focus, RMS (m)"),
        *("sensor (mm)", "mean of the last two epochs (mm)"),
    ]
    columns = {"focus_paraxial_m": 1, "focus_rms_m": 1, "sensor_mm": 4, "sensor_last_epochs_mm": 4}
    lines = [
        [
            NAMES[summary.model],
            summary.seeds,
            _spread(summary, "l1_joint", 4),
            _spread(summary, "l1_drt", 4),
            percent(loss_increase(summary)),
            *(_spread(summary, column, digits) for column, digits in columns.items()),
        ]
        for summary in summaries(report.outcomes)
    ]
    if report.is_of_paper:
        header += ["paper: L¹, step 1", "paper: step 2", "paper: focus (m)"]
        published = {model: (f"{a:.4f}", f"{b:.4f}", f"{focus:.1f}") for model, (a, b, focus) in PAPER.items()}
        for line, summary in zip(lines, summaries(report.outcomes), strict=True):
            line += published.get(summary.model, ("–", "–", "–"))
    return (
        f"{grid(header, lines)}\n\nMean ± standard deviation over seeds, of test pictures; every model of a seed sees "
        "the same crops, distances and noise. Focus is the object distance from vertex 1 whose image is on the sensor: "
        f"the paraxial one, or that of least RMS spot{_PAPER_NOTE if report.is_of_paper else ''}."
        f" Rows one by one, with the range of the sensor in the last two epochs of step 1: "
        f"[table2.csv]({report.folder}/table2.csv); by object distance: "
        f"[distance.csv]({report.folder}/distance.csv)."
    )


def _closed_form(report: Report) -> str:
    trained = {summary.model: summary for summary in summaries(report.outcomes)}
    header = (
        *("model", "sensor (mm)", "trained (mm)", "focus, paraxial (m)", "focus, RMS (m)", "error, own PSFs"),
        "error, DRT PSFs",
    )
    lines = [
        (
            NAMES[optimum.model],
            f"{optimum.sensor_mm:.4f}" + (" (no optimum)" if optimum.no_optimum else ""),
            _spread(trained[optimum.model], "sensor_mm", 4) if optimum.model in trained else "–",
            shown(optimum.focus_paraxial_m, 1),
            shown(optimum.focus_rms_m, 1),
            f"{optimum.error:.6f}",
            f"{optimum.error_drt:.6f}",
        )
        for optimum in report.optima
    ]
    scan_csv = f"; over the sensor distance: [scan.csv]({report.folder}/scan.csv)"
    return (
        f"{grid(header, lines)}\n\nMean square error of a pixel behind the best linear filter that does not know the "
        f"object distance, for pictures of this power spectrum: [spectral.csv]({report.folder}/spectral.csv)"
        f"{scan_csv if 'scan.png' in report.figures else ''}.{_SWEEP if report.is_of_paper else ''}"
    )


def _times(report: Report) -> str:
    about = ", ".join(f"{key} {value}" for key, value in report.machine.items())
    return (
        "Times of PSFs, image and network in a step, forward and backward, median of several, the models in turns: "
        f"[times.csv]({report.folder}/times.csv); {about}."
    )


def _spread(summary: Summary, column: str, digits: int) -> str:
    mean, deviation = shown(summary.mean[column], digits), shown(summary.deviation[column], digits)
    return f"{mean} ± {deviation}" if summary.seeds > 1 and math.isfinite(summary.deviation[column]) else mean


# -- the study


def compare(arguments: argparse.Namespace) -> None:
    """Train the missing runs, then write table, figures and page from the finished ones."""
    if not arguments.folder:
        raise CommandError("no folder to keep the runs in: give -o FOLDER")
    study = Path(arguments.folder)
    stored = study / "settings.json"
    if (arguments.resume or arguments.report_only) and not stored.exists():
        raise CommandError(f"{study}: no study was started here")
    settings = recorded_settings(stored) if arguments.report_only else settings_of(arguments, stored)
    experiment = open_experiment(arguments, settings)
    steps = experiment.steps_per_epoch  # refuses pictures that do not fill a batch
    common = {name: value for name, value in dataclasses.asdict(settings).items() if name not in ("model", "seed")}
    # Refuses a folder of other settings, another lens or other pictures.
    Run(study, {**common, **experiment.about}, usual=settings.recorded({}))
    rows, seeds = _rows_and_seeds(arguments, study)
    if not arguments.report_only:
        # Seeds outside: a study that is stopped has compared as many models as possible.
        for number, (row, seed) in enumerate([(row, seed) for seed in seeds for row in rows], 1):
            of_run = runs.run_settings(study, row, seed, settings)
            label = f"{number}/{len(rows) * len(seeds)} {row} {seed}"
            train_run(experiment, of_run, runs.run_folder(study, row, seed), label)
    if share().rank:
        return  # the first process writes
    docs = Path(arguments.docs or study)
    report = _report(experiment, study, rows, seeds, docs, arguments.page or "codesign", steps)
    present(report, arguments)
    failed = [result for result in (*report.optima, *report.outcomes) if result.no_optimum]
    for result in failed:
        kind = "the closed form" if isinstance(result, Optimum) else f"seed {result.seed}"
        say(f"warning: {result.model}, {kind}: {result.no_optimum}")
    if failed and len(failed) == len(report.optima) + len(report.outcomes):
        raise CommandError("no model has an optimum; see the warnings, and choose other --near, --far, --bounds")


def _rows_and_seeds(arguments: argparse.Namespace, study: Path) -> tuple[list[str], list[int]]:
    """Rows, in the order of the table, and seeds: those of the options; for a report alone those of the folder."""
    stored, rows, seeds = runs.runs_of(study), list(MODELS), [0, 1, 2]
    if arguments.report_only and stored:
        rows, seeds = [row for row, _ in stored], sorted({seed for _, seed in stored})
    rows = [row for row in NAMES if row in (arguments.models or rows)]
    seeds = list(dict.fromkeys(arguments.seeds or seeds))
    is_lacking = any(outcome(runs.run_folder(study, "paraxial", seed)) is None for seed in seeds)
    if AFTER_PARAXIAL in rows and "paraxial" not in rows and is_lacking:
        raise CommandError(f"{AFTER_PARAXIAL} starts from the paraxial run: add paraxial to --models")
    return rows, seeds


def _report(
    experiment: Experiment,
    study: Path,
    rows: Sequence[str],
    seeds: Sequence[int],
    docs: Path,
    page: str,
    steps_per_epoch: int,
) -> Report:
    """Write the page, its tables and figures."""
    lens, settings = experiment.lens, experiment.settings
    focus = focus_of(lens, settings)
    results = runs.with_last_epochs(study, runs.outcomes(study, rows, seeds), settings.epochs, focus)
    say("the closed form, and the time of a step, of every model")
    spectrum = experiment.spectrum()
    optima = closed_forms(lens, settings, spectrum, rows)
    cameras = [initial_camera(lens, dataclasses.replace(settings, model=row)) for row in rows if row in MODELS]
    times = runs.step_times(cameras, make_batch(experiment.train, settings, list(range(settings.batch)), 0))
    drawn: dict[str, figures.Figure] = {}
    if joint := runs.courses(study, results, "loss", STEPS[0]):
        refined = runs.courses(study, results, "loss", STEPS[1])
        drawn["loss.png"] = figures.loss_figure(joint, refined, steps_per_epoch)
    sensors = runs.courses(study, results, "sensor")
    if sensors:
        drawn["focus.png"] = figures.focus_figure(
            sensors, conjugates(lens, settings), steps_per_epoch, _published(lens, 2)
        )
    distances = np.linspace(settings.near, settings.far, 41)
    blur: dict[str, list[float]] = {}
    if results:
        shown_distances = [settings.near + part * (settings.far - settings.near) for part in (0, 0.25, 0.5, 1)]
        blur, patches = _of_trained_lenses(experiment, study, results, distances, shown_distances)
        drawn["blur.png"] = figures.blur_figure(distances.tolist(), blur, settings.pixel, _published(lens, 2))
        drawn["distance.png"] = figures.distance_figure(*runs.losses_by_distance(results), _published(lens, 1))
        drawn["examples.png"] = figures.examples_figure(patches, shown_distances)
    ends = {summary.model: summary.mean["sensor_mm"] for summary in summaries(results)}
    scanned = _scan(experiment, spectrum, optima, list(ends.values()))
    if scanned:
        drawn["scan.png"] = figures.scan_figure(*scanned, ends)
    settled = {} if focus is None else {row: _settled(seeds, focus, steps_per_epoch) for row, seeds in sensors.items()}
    done = {(run.model, run.seed) for run in results}
    report = Report(
        lens=experiment.name,
        pictures=f"{len(experiment.train)} {experiment.kind} to train on, {len(experiment.test)} to test",
        settings=settings,
        outcomes=tuple(results),
        missing=tuple((row, seed) for seed in seeds for row in rows if (row, seed) not in done),
        optima=tuple(optima),
        times=tuple(times),
        figures=tuple(name for name in CAPTIONS if name in drawn),
        machine=machine(),
        folder=page,
        measured=Measurements(tuple(distances / 1e3), blur, settled),
        is_of_paper=is_of_paper(lens),
    )
    tables = {
        "table2.csv": table(results, runs.COLUMNS),
        "distance.csv": table(runs.distance_rows(results), runs.DISTANCE_COLUMNS),
        "blur.csv": _curves(("model", "distance_m", "diameter_um"), report.measured.distances, blur, 1e3),
        "spectral.csv": table(optima, OPTIMUM_COLUMNS),
        "times.csv": table(
            [dict(zip(_TIME_COLUMNS, (t.model, t.psf, t.image, t.network), strict=True)) for t in times], _TIME_COLUMNS
        ),
    }
    if report.claims:
        texts = [(claim.text, claim.answer, claim.figures, claim.criterion) for claim in report.claims]
        tables["claims.csv"] = table([dict(zip(_CLAIM_COLUMNS, t, strict=True)) for t in texts], _CLAIM_COLUMNS)
    if scanned:
        tables["scan.csv"] = _curves(("model", "sensor_mm", "error"), *scanned)
    publish(docs / f"{page}.md", page, report.parts(), tables=tables, figures=drawn)
    return report


def _published(lens: Lens, column: int) -> dict[str, float]:
    """A column of the paper's table by model, if the lens is the paper's."""
    return {model: values[column] for model, values in PAPER.items()} if is_of_paper(lens) else {}


def _curves(
    columns: Sequence[str], places: Sequence[float], values: Mapping[str, Sequence[float]], scale: float = 1
) -> str:
    """A table of values of every model at places, a row for each."""
    points = [(row, x, scale * y) for row, curve in values.items() for x, y in zip(places, curve, strict=True)]
    return table([dict(zip(columns, point, strict=True)) for point in points], columns)


def _of_trained_lenses(
    experiment: Experiment, study: Path, results: Sequence[StudyOutcome], distances: np.ndarray, shown: Sequence[float]
) -> tuple[dict[str, list[float]], dict[str, dict[str, np.ndarray]]]:
    """RMS blur diameters in mm over distances (mm), the mean over seeds, and patches restored by the first seed."""
    diameters: dict[str, list[list[float]]] = {}
    patches: dict[str, dict[str, np.ndarray]] = {}
    # Of dead leaves: the page may be published, pictures of a data set often may not.
    leaves = dead_leaves(2, size=2 * (experiment.settings.patch + experiment.settings.size))
    for run in results:
        settings = runs.run_settings(study, run.model, run.seed, experiment.settings)
        trained = runs.trained(experiment.lens, settings, runs.run_folder(study, run.model, run.seed))
        if run.model not in patches:
            restored = runs.examples(trained, leaves, settings, shown)
            patches[run.model] = {name: patch.float().numpy() for name, patch in restored.items()}
        lens = trained.variables()
        blur = runs.blur_diameters(lens, lens.wavelengths.new_tensor(distances))
        diameters.setdefault(run.model, []).append(blur.tolist())
    return {row: np.mean(curves, 0).tolist() for row, curves in diameters.items()}, patches


def _settled(seeds: Sequence[Sequence[float]], focus: Callable[[float], float], steps_per_epoch: int) -> float:
    """Fraction of step 1 after which the mean focus of an epoch stays within 2 m of its end, mean over seeds."""
    starts = range(0, len(seeds[0]), steps_per_epoch)
    epochs = [[focus(float(np.mean(course[i : i + steps_per_epoch]))) for i in starts] for course in seeds]
    return float(np.mean([runs.settled(course) for course in epochs]))


def _scan(
    experiment: Experiment, spectrum: Tensor, optima: Sequence[Optimum], ends: Sequence[float]
) -> tuple[list[float], dict[str, list[float]]] | None:
    """Sensor distances in mm, and errors of the closed form there by model; None unless the sensor alone varies.

    ends: sensor distances at the end of training.
    """
    lens, settings = experiment.lens, experiment.settings
    if settings.vary.split() != ["sensor"] or not optima:
        return None
    start = float(lens_at_start(lens, settings).surfaces[-2].thickness)
    places = [start, *(optimum.sensor_mm for optimum in optima), *ends]
    margin = 0.15 * (max(places) - min(places)) + 0.02
    sensors = np.linspace(min(places) - margin, max(places) + margin, 41).tolist()
    errors = {}
    for model in [optimum.model for optimum in optima if optimum.model in MODELS]:
        at_start = initial_camera(lens, dataclasses.replace(settings, model=model))
        errors[model] = scan(at_start, spectrum, sensors, even_distances(at_start, spread=settings.spread))
    return sensors, errors


def options(parser: argparse.ArgumentParser) -> None:
    codesign.experiment_options(parser)
    parser.set_defaults(optimizer="adam")
    group = parser.add_argument_group("study")
    group.add_argument(
        "--models",
        metavar="MODEL",
        choices=(*MODELS, AFTER_PARAXIAL),
        nargs="+",
        help=f"rows of the table: {', '.join(MODELS)} (default: all), and {AFTER_PARAXIAL}: Gaussian DRT started where "
        "the paraxial run ended",
    )
    group.add_argument("--seeds", metavar="N", type=seed_number, nargs="+", help="of the runs (default 0 1 2)")
    documents(group, "the page and of codesign/ (default: FOLDER)")
    group.add_argument(
        "--page", metavar="NAME", type=file_name, help="write NAME.md and NAME/ there (default codesign)"
    )
    group.add_argument("--report-only", action="store_true", help="train nothing, write the page of the stored runs")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args(argv)
    with processes():
        compare(arguments)


if __name__ == "__main__":
    sys.exit(main())
