"""Study: the runs of several models and seeds side by side: tables, courses and what to draw.

A study is a folder of runs, `<row>-<seed>/`; finished ones are read again, never repeated. A row is a PSF model, or
`AFTER_PARAXIAL`: Gaussian DRT with the sensor where the paraxial run of the same seed ended.
"""

import copy
import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.imaging.camera import Camera
from raytrace.imaging.codesign import STEPS, Batch, Outcome, batch, outcome
from raytrace.imaging.codesign import camera as camera_at_start
from raytrace.imaging.image import blur
from raytrace.imaging.pictures import Pictures
from raytrace.imaging.training import load_state, read_log, read_state
from raytrace.maths.pupil import gauss_rings
from raytrace.settings import AFTER_PARAXIAL, NAMES, CodesignSettings
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.launch import launch
from raytrace.tracing.spot import spot_of
from raytrace.tracing.trace import trace_lens

_CHOICE = 16  # patches of which the one with most contrast is shown

#: Columns of `table2.csv`.
COLUMNS = (
    *("model", "seed", "l1_joint", "l1_drt", "focus_paraxial_m", "focus_rms_m", "sensor_mm"),
    *("sensor_last_epochs_mm", "sensor_range_last_epochs_mm", "focus_last_epochs_m"),
)
_LAST = 2  # epochs that are averaged beside the last iterate


@dataclasses.dataclass(frozen=True)
class Summary:
    """One model over its seeds: mean and standard deviation of every column of the table; seeds: how many."""

    model: str
    seeds: int
    mean: dict[str, float]
    deviation: dict[str, float]


def run_folder(study: Path, row: str, seed: int) -> Path:
    return Path(study) / f"{row}-{seed}"


def run_settings(study: Path, row: str, seed: int, settings: CodesignSettings) -> CodesignSettings | None:
    """The settings of one run; None where it starts from a run that is not finished."""
    if row != AFTER_PARAXIAL:
        return dataclasses.replace(settings, model=row, seed=seed)
    before = outcome(run_folder(study, "paraxial", seed))
    return before and dataclasses.replace(settings, model="gaussian", seed=seed, start=repr(before.sensor_mm))


def begun(study: Path) -> list[tuple[str, int]]:
    """(row, seed) of the runs that have a folder, in the order of the table."""
    of = {row: [path.name.removeprefix(f"{row}-") for path in study.glob(f"{row}-[0-9]*")] for row in NAMES}
    return [(row, int(seed)) for row, seeds in of.items() for seed in seeds if seed.isdecimal()]


def outcomes(study: Path, models: Sequence[str], seeds: Sequence[int]) -> list[Outcome]:
    """The finished runs of a study, each with its row as its model."""
    found = [(model, outcome(run_folder(study, model, seed))) for model in models for seed in seeds]
    return [dataclasses.replace(one, model=model) for model, one in found if one is not None]


def with_last_epochs(
    study: Path, found: Sequence[Outcome], epochs: int, focus: Callable[[float], float] | None
) -> list[Outcome]:
    """Outcomes with the mean place of the sensor over the last two epochs of step 1, its range, and focus by `focus`.

    At a constant rate the last iterate jitters about its place. Runs without a sensor that varies stay as they are.
    """
    result = []
    for one in found:
        (course,) = (*courses(study, [one], "sensor").values(), [[]])[0]
        if course and focus is not None:
            last = of_last_epochs(course, epochs)
            place = statistics.fmean(last)
            one = dataclasses.replace(
                one,
                sensor_last_epochs_mm=place,
                sensor_range_last_epochs_mm=max(last) - min(last),
                focus_last_epochs_m=focus(place),
            )
        result.append(one)
    return result


def of_last_epochs(course: Sequence[float], epochs: int) -> Sequence[float]:
    """The part of a column of a log of so many epochs that is of the last two of them."""
    return course[-min(_LAST, epochs) * (len(course) // epochs) :]


def settled(course: Sequence[float], near: float = 2.0) -> float:
    """The part of a course behind which it stays within `near` of its end."""
    away = [number for number, value in enumerate(course, 1) if abs(value - course[-1]) > near]
    return (away[-1] if away else 0) / len(course)


def rows(found: Sequence[Outcome]) -> list[dict[str, str | float]]:
    """The table, a row for each model and seed."""
    return [{column: getattr(one, column) for column in COLUMNS} for one in found]


def summaries(found: Sequence[Outcome]) -> list[Summary]:
    """Mean and deviation over seeds, in the order in which the models come first."""
    result = []
    for model in dict.fromkeys(one.model for one in found):
        own = [one for one in found if one.model == model]
        values = {c: [float(getattr(one, c)) for one in own] for c in (*COLUMNS[2:], "l1_before")}
        mean = {c: statistics.fmean(v) for c, v in values.items()}
        deviation = {c: _deviation(v) for c, v in values.items()}
        result.append(Summary(model, len(own), mean, deviation))
    return result


def penalty(summary: Summary) -> float:
    """Relative increase of the loss from step 1, with the model's own PSFs, to step 2 with DRT PSFs."""
    return summary.mean["l1_drt"] / summary.mean["l1_joint"] - 1


def percent(part: float) -> str:
    return f"{100 * part:+.1f} %"


def _deviation(values: Sequence[float]) -> float:
    """Standard deviation; 0 of one value, nan where one is not finite."""
    if not all(map(math.isfinite, values)):
        return math.nan
    return statistics.stdev(values) if len(values) > 1 else 0.0


def courses(study: Path, found: Sequence[Outcome], column: str, step: str = STEPS[0]) -> dict[str, list[list[float]]]:
    """One column of the logs of finished runs, by model, a list for each seed; models without it are left out."""
    result: dict[str, list[list[float]]] = {}
    for one in found:
        path = run_folder(study, one.model, one.seed) / step / "log.csv"
        values = [row[column] for row in (read_log(path) if path.exists() else ()) if column in row]
        if values:
            result.setdefault(one.model, []).append(values)
    return result


def losses_by_distance(found: Sequence[Outcome]) -> tuple[list[float], dict[str, list[list[float]]]]:
    """Object distances in mm and the loss with DRT PSFs after step 2 at each, by model, a list for each seed."""
    distances = sorted({float(d) for one in found for d in one.by_distance})
    result: dict[str, list[list[float]]] = {}
    for one in found:
        own = {float(d): loss for d, loss in one.by_distance.items()}
        result.setdefault(one.model, []).append([own[d] for d in distances])
    return distances, result


#: Columns of `distance.csv`.
DISTANCE_COLUMNS = ("model", "seed", "distance_m", "l1_drt")


def distance_rows(found: Sequence, columns: Sequence[str] = DISTANCE_COLUMNS) -> list[dict[str, str | float]]:
    """Losses of test pictures by model, seed and object distance in m, of all that have `by_distance`, in mm."""
    return [
        dict(zip(columns, (one.model, one.seed, float(distance) / 1e3, loss), strict=True))
        for one in found
        for distance, loss in one.by_distance.items()
    ]


def trained(lens: Lens, settings: CodesignSettings, folder: Path) -> Camera:
    """The camera of a finished run as it ended, with DRT PSFs. settings: those of the run."""
    own = camera_at_start(lens, settings)
    kept = Path(folder) / STEPS[1] / "checkpoint.pt"
    load_state(own, read_state(kept), kept)
    own.variables.requires_grad_(False)
    own.use("drt")
    return own


@torch.no_grad()
def blur_diameters(lens: Lens, distances: Tensor) -> Tensor:
    """RMS blur diameter (Z,) mm of traced rays on the axis, over object distances (Z,) mm."""
    pupil, weights = gauss_rings(12, dtype=lens.wavelengths.dtype)
    axis = lens.wavelengths.new_zeros(2, 1)
    found = []
    for distance in distances:
        own = with_object_distance(lens, distance)
        rays = trace_lens(own, launch(own, pupil, fields=axis), own.wavelengths[:, None])
        share = own.wavelength_weights / own.wavelength_weights.sum()
        found.append(2 * (share * spot_of(rays, weights).mean_square_radius[0]).sum().sqrt())
    return torch.stack(found)


@torch.no_grad()
def examples(
    camera: Camera, pictures: Pictures, settings: CodesignSettings, distances: Sequence[float]
) -> dict[str, Tensor]:
    """A test patch at several distances (Z,): "picture", "image" and "restored", each (Z, h, w).

    Of the first patches it is the one of most contrast: a plain one shows no blur.
    """
    few = list(range(min(_CHOICE, len(pictures) * settings.crops)))
    own = batch(pictures, settings, few, 2**20)
    chosen = int(own.picture.flatten(1).std(1).argmax())
    many = torch.tensor(distances, dtype=camera.fields.dtype)
    picture = own.picture[chosen].expand(len(many), -1, -1)
    image = camera.image(picture, many) + camera.noise * own.noise[chosen]
    return {"picture": camera.target(picture), "image": image, "restored": camera.restore(image)}


# ---------------------------------------------------------------- time of a step


@dataclasses.dataclass(frozen=True)
class StepTime:
    """Median times in ms of a batch, forward and backward."""

    model: str
    psf: float
    image: float
    network: float


def step_times(cameras: Sequence[Camera], batch: Batch, *, repeats: int = 5) -> list[StepTime]:
    """What the parts of one step cost with each camera, in turns: a machine that slows down slows all of them.

    The cameras are left as they were, without gradients.
    """
    before = [copy.deepcopy(own.variables.state_dict()) for own in cameras]
    parts = [_parts(own, batch) for own in cameras]
    times = [{part: [] for part in own} for own in parts]
    for _ in range(repeats):
        for own, taken in zip(parts, times, strict=True):
            for part, work in own.items():
                taken[part].extend(_timed(work, 4 if part == "psf" else 1))  # the shortest, and what models differ by
    for own, state in zip(cameras, before, strict=True):
        own.variables.load_state_dict(state)
        own.zero_grad(set_to_none=True)
    return [
        StepTime(own.model, **{part: statistics.median(ms) for part, ms in taken.items()})
        for own, taken in zip(cameras, times, strict=True)
    ]


def _parts(camera: Camera, batch: Batch) -> dict[str, Callable[[], None]]:
    """The work of a step, forward and backward, each part by itself."""
    kernels = camera.kernels(batch.distance).detach().to(batch.picture.dtype).requires_grad_()
    image = camera.image(batch.picture, batch.distance).detach().requires_grad_()

    def psf() -> None:
        _nudge(camera)
        camera.kernels(batch.distance).square().sum().backward()

    return {
        "psf": psf,
        "image": lambda: blur(batch.picture, kernels).square().sum().backward(),
        "network": lambda: camera.restore(image).square().sum().backward(),
    }


@torch.no_grad()
def _nudge(camera: Camera) -> None:
    """Move the lens by next to nothing: what a step of training computes anew is then computed anew."""
    for parameter in camera.variables.parameters():
        parameter.add_(1e-9)


def _timed(work: Callable[[], None], repeats: int) -> list[float]:
    """Times in ms, after a call that plans and fills caches."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return times
