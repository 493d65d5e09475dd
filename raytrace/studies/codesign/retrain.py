"""Retrain: fresh networks for lenses that are known, with one budget and DRT PSFs: which lens is the better one?

Networks of `compare` differ in what they saw before their lens was frozen. Here every network begins anew, and all
lenses of a seed see the same crops, object distances and noise: their losses are compared pair by pair.
"""

import csv
import dataclasses
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy.stats

from raytrace.files import write_json
from raytrace.imaging.training import DamagedRun, Record, Run
from raytrace.stores import fields_of, read_document
from raytrace.studies.codesign.experiment import Progress, camera, held_out_error, optimise, usual
from raytrace.studies.codesign.settings import NAMES, Settings
from raytrace.studies.codesign.study import of_last_epochs
from raytrace.studies.pictures import Pictures
from raytrace.system.lens import Lens

STEP = "retrain"
_CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True)
class Retrained:
    """What one fresh network reached with one lens.

    model: that chose the lens; l1: of test pictures, by the last iterate; l1_last_epochs: of the training batches of
    the last two epochs, of which every network saw the same ones, each before it learned from it; by_distance: l1 at
    object distances in mm.
    """

    model: str
    seed: int
    sensor_mm: float
    l1: float
    l1_last_epochs: float
    by_distance: dict[str, float] = dataclasses.field(default_factory=dict)


#: Columns of `retrain.csv`, and those of them that are losses.
COLUMNS = ("model", "seed", "sensor_mm", "l1", "l1_last_epochs")
LOSSES = COLUMNS[3:]

#: Columns of `retrain_distance.csv`.
DISTANCE_COLUMNS = ("model", "seed", "distance_m", "l1")


@dataclasses.dataclass(frozen=True)
class Effect:
    """By how much a lens loses more than the reference, relative to that, over the seeds that both have.

    mean, low, high: and the interval that holds the mean in 95 of 100 such studies (Student's t of the differences by
    seed); p: how probable so large a mean is where there is no difference.
    """

    model: str
    reference: str
    loss: str
    seeds: int
    mean: float
    low: float
    high: float
    p: float

    @property
    def is_clear(self) -> bool:
        """Whether the interval leaves out 0."""
        return self.low > 0 or self.high < 0


def sensors_of(path: str | Path) -> dict[str, float]:
    """The mean sensor distance in mm of every row of a table of runs, `table2.csv`. Raises DamagedRun."""
    found: dict[str, list[float]] = {}
    try:
        with open(path, newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                found.setdefault(row["model"], []).append(float(row["sensor_mm"]))
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedRun(f"{path}: expected the columns model and sensor_mm ({error})") from error
    unknown = sorted(found.keys() - NAMES.keys())
    if unknown or not found:
        raise DamagedRun(f"{path}: rows of {', '.join(unknown) or 'no model'}; expected {', '.join(NAMES)}")
    return {model: statistics.fmean(found[model]) for model in NAMES if model in found}


def settings_of_lens(settings: Settings, sensor: float, seed: int) -> Settings:
    """Settings of one network: DRT PSFs of all light, the sensor held wherever it is, whatever chose the lens."""
    whole = dataclasses.replace(settings, model="drt", rays=None, drt_rays=None, vary="sensor", bounds="", hold="")
    return dataclasses.replace(whole, start=repr(sensor), seed=seed)


def retrain(
    lens: Lens,
    train_pictures: Pictures,
    test_pictures: Pictures,
    settings: Settings,
    folder: Path,
    *,
    row: str,
    about: Mapping,
    distances: Sequence[float],
    progress: Progress = iter,
) -> Iterator[tuple[str, int, Record]]:
    """Train one network, a step at a time: (name of the step, its number, what it reports).

    settings: by `settings_of_lens`; row: what the lens is called. The folder is resumed if begun; at the end there is
    an `outcome.json`, read by `retrained`.
    """
    run = Run(folder / STEP, {**dataclasses.asdict(settings), **about, "step": STEP}, usual=usual(settings))
    if (folder / "outcome.json").exists():
        return
    own = camera(lens, settings)
    own.variables.requires_grad_(False)
    own.plan()
    for step, record in optimise(own, train_pictures, settings, run):
        yield STEP, step, record
    test = {"progress": progress}
    found = Retrained(
        model=row,
        seed=settings.seed,
        sensor_mm=float(own.variables().surfaces[-2].thickness.detach()),
        l1=held_out_error(own, test_pictures, settings, **test),
        l1_last_epochs=last_epochs([one["loss"] for one in run.rows()], settings.epochs),
        by_distance={f"{z:g}": held_out_error(own, test_pictures, settings, distance=z, **test) for z in distances},
    )
    write_json(folder / "outcome.json", dataclasses.asdict(found))


def last_epochs(values: Sequence[float], epochs: int) -> float:
    """Mean of a column of a log of so many epochs over the last two of them."""
    return statistics.fmean(of_last_epochs(values, epochs))


def retrained(folder: Path) -> Retrained | None:
    """What a finished run found, None for one that is not. Raises DamagedRun."""
    path = Path(folder) / "outcome.json"
    if not path.exists():
        return None
    return Retrained(**read_document(path, fields_of(Retrained), DamagedRun, "remove it to find it anew"))


def effects(found: Sequence[Retrained], reference: str = "gaussian", losses: Sequence[str] = LOSSES) -> list[Effect]:
    """The effect of every other lens, in every loss, where two seeds at least have both.

    losses: columns, or keys of `by_distance`.
    """
    models = [model for model in dict.fromkeys(one.model for one in found) if model != reference]
    pairs = [(model, loss, _ratios(found, model, reference, loss)) for loss in losses for model in models]
    return [_effect(model, reference, loss, ratios) for model, loss, ratios in pairs if len(ratios) > 1]


def _ratios(found: Sequence[Retrained], model: str, reference: str, loss: str) -> list[float]:
    """Loss over that of the reference, less 1, of every seed that has both."""
    of = {(one.model, one.seed): getattr(one, loss) if loss in LOSSES else one.by_distance[loss] for one in found}
    seeds = sorted({seed for name, seed in of if name == model} & {seed for name, seed in of if name == reference})
    return [of[model, seed] / of[reference, seed] - 1 for seed in seeds]


def _effect(model: str, reference: str, loss: str, ratios: Sequence[float]) -> Effect:
    mean, count = statistics.fmean(ratios), len(ratios)
    error = statistics.stdev(ratios) / count**0.5
    reach = float(scipy.stats.t.ppf(0.5 + _CONFIDENCE / 2, count - 1)) * error
    p = float(2 * scipy.stats.t.sf(abs(mean) / error, count - 1)) if error else float(mean == 0)
    return Effect(model, reference, loss, count, mean, mean - reach, mean + reach, p)


def means(found: Sequence[Retrained]) -> dict[str, dict[str, tuple[float, float]]]:
    """Mean and standard deviation over seeds of every loss, by model."""
    models = dict.fromkeys(one.model for one in found)
    return {m: {c: _spread([getattr(one, c) for one in found if one.model == m]) for c in LOSSES} for m in models}


def _spread(values: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
