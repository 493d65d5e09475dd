"""`raytrace codesign retrain`: fresh networks for the lenses of a study, and the page about them."""

import argparse
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from raytrace.cli.door import CommandError
from raytrace.cli.run import present
from raytrace.files import table
from raytrace.imaging.training import Run, share
from raytrace.maths.result import Result, plain
from raytrace.pages import grid
from raytrace.studies.codesign.experiment import usual
from raytrace.studies.codesign.retrain import (
    COLUMNS,
    DISTANCE_COLUMNS,
    LOSSES,
    STEP,
    Effect,
    Retrained,
    effects,
    means,
    retrain,
    retrained,
    sensors_of,
    settings_of_lens,
)
from raytrace.studies.codesign.settings import NAMES, Settings
from raytrace.studies.codesign.setup import (
    Experiment,
    experiment,
    follow,
    recorded,
    recorded_settings,
    refuse_too_few,
    settings_of,
)
from raytrace.studies.codesign.study import begun as begun_runs
from raytrace.studies.codesign.study import distance_rows
from raytrace.studies.publish import publish

_SEEDS = (0, 1, 2, 3, 4)
_TEST, _LAST = LOSSES
_SAID = {_TEST: "L¹, test pictures", _LAST: "L¹, batches of the last two epochs"}


@dataclasses.dataclass(frozen=True)
class Footing(Result):
    """What fresh networks say of lenses; missing: (row, seed) of networks that are not finished."""

    given: Experiment
    sensors: dict[str, float]
    found: tuple[Retrained, ...]
    missing: tuple[tuple[str, int], ...]

    @property
    def effects(self) -> list[Effect]:
        return effects(self.found)

    @property
    def effects_by_distance(self) -> list[Effect]:
        return effects(self.found, losses=sorted({z for one in self.found for z in one.by_distance}, key=float))

    def document(self) -> dict:
        return plain(
            {
                "settings": dataclasses.asdict(self.given.settings),
                **self.given.about,
                "sensors": self.sensors,
                "rows": [dataclasses.asdict(one) for one in self.found],
                "effects": [dataclasses.asdict(one) for one in self.effects],
                "missing": [{"model": row, "seed": seed} for row, seed in self.missing],
            }
        )

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"{'lens of':>26} {'sensor mm':>10} {'seeds':>5} {'L1 test':>9} {'L1 last':>9}"
        for model, of in means(self.found).items():
            seeds = sum(one.model == model for one in self.found)
            losses = " ".join(f"{of[loss][0]:>9.5f}" for loss in LOSSES)
            yield f"{NAMES[model]:>26} {self.sensors[model]:>10.4f} {seeds:>5} {losses}"
        for one in self.effects:
            yield f"{NAMES[one.model]:>26}: {_told(one)} over {NAMES[one.reference]}, {_SAID[one.loss]}"
        if self.missing:
            yield f"not finished: {', '.join(f'{row} {seed}' for row, seed in self.missing)}"

    def parts(self, folder: str) -> list[str]:
        """The page, whose table is in the folder."""
        s, begun = self.given.settings, f"{len(self.found)} of {len(self.found) + len(self.missing)}"
        words = " ".join([*self._asked(), *([] if folder == "codesign" else [f"--page {folder}"]), *s.words()])
        aperture = "the file's aperture" if s.f_number is None else f"F/{s.f_number:g}"
        return [
            "# Co-design: the lenses on an equal footing",
            f"    raytrace codesign retrain {self.given.name} --sensors TABLE --data DIR -o FOLDER --docs docs {words}",
            f"{self.given.name} at {aperture} with its sensor where each model put it (mean over the seeds of "
            "`codesign compare`), held there. For every lens and seed a fresh network is trained on ray-traced (DRT) "
            f"PSFs for {s.epochs} epochs: one budget, and the same crops, object distances and noise for all lenses of "
            f"a seed. {len(self.given.train)} {self.given.kind} to train on, {len(self.given.test)} to test.",
            f"**Unfinished: {begun} networks.**" if self.missing else "",
            _losses(self),
            "## Differences, seed by seed",
            _effects(self.effects),
            "Relative to Gaussian DRT's lens, with 95 % intervals of the mean (Student's t of differences by seed). "
            "Test pictures: by the last iterate. Batches of the last two epochs: each before the network learned from "
            f"it. Network by network: [retrain.csv]({folder}/retrain.csv).",
            "## Over object distance",
            _by_distance(self.effects_by_distance, folder),
        ]

    def _asked(self) -> list[str]:
        """Lenses and seeds as options of the command, where they are not all of the table and the usual ones."""
        every = [*((one.model, one.seed) for one in self.found), *self.missing]
        models, seeds = {model for model, _ in every}, sorted({seed for _, seed in every})
        chosen = [model for model in self.sensors if model in models]
        found = [] if len(chosen) == len(self.sensors) else [f"--models {' '.join(chosen)}"]
        return found if tuple(seeds) == _SEEDS else [*found, f"--seeds {' '.join(map(str, seeds))}"]


def _losses(given: Footing) -> str:
    lines = [
        (
            NAMES[model],
            f"{given.sensors[model]:.4f}",
            sum(one.model == model for one in given.found),
            *(f"{of[loss][0]:.5f} ± {of[loss][1]:.5f}" for loss in LOSSES),
        )
        for model, of in means(given.found).items()
    ]
    return grid(("lens of", "sensor (mm)", "seeds", *_SAID.values()), lines) if lines else "No network is finished yet."


def _effects(found: Sequence[Effect]) -> str:
    if not found:
        return "Two seeds of two lenses are needed."
    header = ("lens of", "loss", "seeds", "more than Gaussian DRT's", "p", "")
    lines = [
        (
            NAMES[one.model],
            _SAID[one.loss],
            one.seeds,
            _told(one),
            f"{one.p:.2g}",
            ("worse" if one.mean > 0 else "better") if one.is_clear else "no difference shown",
        )
        for one in found
    ]
    return grid(header, lines)


def _told(one: Effect) -> str:
    return f"{_fine(one.mean)} ({_fine(one.low)} to {_fine(one.high)})"


def _fine(part: float) -> str:
    return f"{100 * part:+.2f} %"


def _by_distance(found: Sequence[Effect], folder: str) -> str:
    if not found:
        return "Two seeds of two lenses are needed."
    rows: dict[tuple[str, int], list[str]] = {}
    for one in found:
        cell = f"{100 * one.mean:+.1f} ± {100 * (one.high - one.mean):.1f}"
        rows.setdefault((NAMES[one.model], one.seeds), []).append(cell)
    header = ("lens of", "seeds", *(f"{float(z) / 1e3:g} m" for z in dict.fromkeys(one.loss for one in found)))
    return (
        f"{grid(header, [(*key, *cells) for key, cells in rows.items()])}\n\nLoss of test pictures more than Gaussian "
        "DRT's in per cent, with half the interval of 95 % as above. Network by network: "
        f"[retrain_distance.csv]({folder}/retrain_distance.csv)."
    )


def retrain_all(arguments: argparse.Namespace) -> None:
    """Train what is missing, seed by seed, then write table and page from what is there."""
    if not (arguments.folder and (arguments.sensors or arguments.report_only)):
        raise CommandError("give the table of the lenses, --sensors table2.csv, and a folder for the runs, -o FOLDER")
    study = Path(arguments.folder)
    begun = study / "settings.json"
    if arguments.report_only and "sensors" not in recorded(begun):
        raise CommandError(f"{study}: no study was begun here")
    sensors = sensors_of(arguments.sensors) if arguments.sensors else recorded(begun)["sensors"]
    models, seeds = _asked(arguments, study, sensors)
    given = experiment(arguments, recorded_settings(begun) if arguments.report_only else settings_of(arguments, begun))
    refuse_too_few(given)
    common = {k: v for k, v in dataclasses.asdict(given.settings).items() if k not in ("model", "seed", "start")}
    Run(study, {**common, **given.about, "sensors": sensors}, usual=usual(given.settings))
    asked = [(row, seed) for seed in seeds for row in models]
    for number, (row, seed) in enumerate(asked if not arguments.report_only else (), 1):
        own = settings_of_lens(given.settings, sensors[row], seed)
        _train(given, own, study / f"{row}-{seed}", row, f"{number}/{len(asked)} {row} {seed}")
    if share().rank:
        return  # the first process writes
    runs = {(row, seed): retrained(study / f"{row}-{seed}") for row, seed in asked}
    found = tuple(one for one in runs.values() if one is not None)
    footing = Footing(given, sensors, found, tuple(key for key, one in runs.items() if one is None))
    page = Path(arguments.docs or study) / f"{arguments.page or 'codesign'}_retrain.md"
    folder = arguments.page or "codesign"
    tables = {
        "retrain.csv": table(found, COLUMNS),
        "retrain_distance.csv": table(distance_rows(found, DISTANCE_COLUMNS), DISTANCE_COLUMNS),
    }
    publish(page, folder, footing.parts(folder), tables=tables, figures={})
    present(footing, arguments)


def _asked(
    arguments: argparse.Namespace, study: Path, sensors: Mapping[str, float]
) -> tuple[Sequence[str], Sequence[int]]:
    """Lenses, in the order of the table, and seeds: those asked for; for a mere report those that were begun."""
    unknown = [model for model in arguments.models or () if model not in sensors]
    if unknown:
        raise CommandError(
            f"{arguments.sensors or study}: no lens of {', '.join(unknown)}; --models of {', '.join(sensors)}"
        )
    usual_models, usual_seeds = list(sensors), list(_SEEDS)
    if arguments.report_only and (runs := [(row, seed) for row, seed in begun_runs(study) if row in sensors]):
        usual_models, usual_seeds = [row for row, _ in runs], sorted({seed for _, seed in runs})
    models = [model for model in sensors if model in (arguments.models or usual_models)]
    return models, list(dict.fromkeys(arguments.seeds or usual_seeds))


def _train(given: Experiment, settings: Settings, folder: Path, row: str, label: str) -> None:
    follow(
        given,
        settings,
        label,
        (STEP,),
        lambda testing: retrain(
            given.lens,
            given.train,
            given.test,
            settings,
            folder,
            row=row,
            about=given.about,
            distances=given.distances,
            progress=testing,
        ),
    )
