"""A study of co-design: trained cameras of several PSF models and seeds, their tables, courses and times.

A study is a folder of runs, `<row>-<seed>/`; finished runs are read again, never repeated. A row is a PSF model, or
`AFTER_PARAXIAL`: Gaussian DRT with the sensor where the paraxial run of the same seed ended.
"""

import copy
import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.imaging.camera import Camera
from raytrace.imaging.codesign import (
    STEPS,
    TEST_EPOCH,
    Batch,
    Optimum,
    Outcome,
    closed_form,
    freeze_lens,
    initial_camera,
    make_batch,
    outcome,
)
from raytrace.imaging.image import blur
from raytrace.imaging.pictures import Pictures
from raytrace.imaging.training import load_state, read_log, read_state
from raytrace.maths.sampling import gauss_rings
from raytrace.settings import CodesignSettings
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.launch import launch
from raytrace.tracing.spot import spot_of
from raytrace.tracing.trace import trace_lens

AFTER_PARAXIAL = "gaussian-after-paraxial"
#: Names of rows in tables and figures.
NAMES = {
    "paraxial": "paraxial",
    "fourier": "Fourier",
    "gaussian": "Gaussian DRT",
    "drt": "DRT",
    AFTER_PARAXIAL: "Gaussian DRT from paraxial",
}
#: Columns of `table2.csv` and of `distance.csv`.
COLUMNS = (
    *("model", "seed", "l1_joint", "l1_drt", "focus_paraxial_m", "focus_rms_m", "sensor_mm"),
    *("sensor_last_epochs_mm", "sensor_range_last_epochs_mm", "focus_last_epochs_m"),
)
DISTANCE_COLUMNS = ("model", "seed", "distance_m", "l1_drt")
#: Values by row of the study, a list for each seed.
Curves = Mapping[str, Sequence[Sequence[float]]]
_PATCHES = 16  # of which the one of the highest contrast is shown
_LAST = 2  # epochs that are averaged


@dataclasses.dataclass(frozen=True)
class StudyOutcome(Outcome):
    """A finished run; model: its row. *_last_epochs: mean and range of the sensor distance over the last two epochs of
    step 1 and the focus of the mean, nan unless the sensor alone varies: at a constant rate the last iterate jitters.
    """

    sensor_last_epochs_mm: float = math.nan
    sensor_range_last_epochs_mm: float = math.nan
    focus_last_epochs_m: float = math.nan


@dataclasses.dataclass(frozen=True)
class Summary:
    """One row over its seeds: mean and standard deviation of every column of the table; seeds: their number."""

    model: str
    seeds: int
    mean: dict[str, float]
    deviation: dict[str, float]


def run_folder(study: Path, row: str, seed: int) -> Path:
    return Path(study) / f"{row}-{seed}"


def run_settings(study: Path, row: str, seed: int, settings: CodesignSettings) -> CodesignSettings | None:
    """The settings of one run; None if it starts from a run that is not finished."""
    if row != AFTER_PARAXIAL:
        return dataclasses.replace(settings, model=row, seed=seed)
    before = outcome(run_folder(study, "paraxial", seed))
    return before and dataclasses.replace(settings, model="gaussian", seed=seed, start=repr(before.sensor_mm))


def runs_of(study: Path) -> list[tuple[str, int]]:
    """(row, seed) of the runs that have a folder, in the order of the table."""
    seeds = {row: [path.name.removeprefix(f"{row}-") for path in study.glob(f"{row}-[0-9]*")] for row in NAMES}
    return [(row, int(seed)) for row in NAMES for seed in seeds[row] if seed.isdecimal()]


def outcomes(study: Path, rows: Sequence[str], seeds: Sequence[int]) -> list[StudyOutcome]:
    """The finished runs of a study."""
    results = [(row, outcome(run_folder(study, row, seed))) for row in rows for seed in seeds]
    return [StudyOutcome(**vars(result) | {"model": row}) for row, result in results if result is not None]


def with_last_epochs(
    study: Path, results: Sequence[StudyOutcome], epochs: int, focus: Callable[[float], float] | None
) -> list[StudyOutcome]:
    """Outcomes with their *_last_epochs; focus: of a sensor distance, None unless the sensor alone varies."""
    if focus is None:
        return list(results)
    averaged = []
    for result in results:
        for sensors in courses(study, [result], "sensor").get(result.model, []):
            last = sensors[-min(_LAST, epochs) * (len(sensors) // epochs) :]
            result = dataclasses.replace(
                result,
                sensor_last_epochs_mm=statistics.fmean(last),
                sensor_range_last_epochs_mm=max(last) - min(last),
                focus_last_epochs_m=focus(statistics.fmean(last)),
            )
        averaged.append(result)
    return averaged


def settled(course: Sequence[float], near: float = 2.0) -> float:
    """The fraction of a course after which it stays within `near` of its end."""
    away = [number for number, value in enumerate(course, 1) if abs(value - course[-1]) > near]
    return (away[-1] if away else 0) / len(course)


def summaries(results: Sequence[Outcome]) -> list[Summary]:
    """Mean and standard deviation over seeds (0 of one value, nan if a value is infinite), in the order of the rows."""
    by_row: dict[str, list[Outcome]] = {}
    for result in results:
        by_row.setdefault(result.model, []).append(result)

    def deviation(values: Sequence[float]) -> float:
        if not all(map(math.isfinite, values)):
            return math.nan
        return statistics.stdev(values) if len(values) > 1 else 0.0

    table = []
    for row, runs in by_row.items():
        columns = {name: [float(getattr(run, name)) for run in runs] for name in (*COLUMNS[2:], "l1_before")}
        mean = {name: statistics.fmean(values) for name, values in columns.items()}
        table.append(Summary(row, len(runs), mean, {name: deviation(values) for name, values in columns.items()}))
    return table


def loss_increase(summary: Summary) -> float:
    """Relative increase of the loss from step 1, with the model's own PSFs, to step 2 with DRT PSFs."""
    return summary.mean["l1_drt"] / summary.mean["l1_joint"] - 1


def percent(part: float) -> str:
    return f"{100 * part:+.1f} %"


def courses(study: Path, results: Sequence[Outcome], column: str, step: str = STEPS[0]) -> dict[str, list[list[float]]]:
    """One column of the logs of finished runs by row; rows without the column are left out."""
    curves: dict[str, list[list[float]]] = {}
    for result in results:
        log = run_folder(study, result.model, result.seed) / step / "log.csv"
        if values := [record[column] for record in (read_log(log) if log.exists() else ()) if column in record]:
            curves.setdefault(result.model, []).append(values)
    return curves


def losses_by_distance(results: Sequence[Outcome]) -> tuple[list[float], dict[str, list[list[float]]]]:
    """Object distances in mm and the loss with DRT PSFs after step 2 at each, by row."""
    distances = sorted({float(distance) for result in results for distance in result.by_distance})
    curves: dict[str, list[list[float]]] = {}
    for result in results:
        losses = {float(distance): loss for distance, loss in result.by_distance.items()}
        curves.setdefault(result.model, []).append([losses[distance] for distance in distances])
    return distances, curves


def distance_rows(results: Sequence[Outcome]) -> Iterator[dict[str, str | float]]:
    """Losses of test pictures by row, seed and object distance in m."""
    for result in results:
        for distance, loss in result.by_distance.items():
            yield dict(zip(DISTANCE_COLUMNS, (result.model, result.seed, float(distance) / 1e3, loss), strict=True))


def trained(lens: Lens, settings: CodesignSettings, folder: Path) -> Camera:
    """The camera at the end of a finished run, with DRT PSFs. settings: those of the run."""
    camera = initial_camera(lens, settings)
    checkpoint = Path(folder) / STEPS[1] / "checkpoint.pt"
    load_state(camera, read_state(checkpoint), checkpoint)
    freeze_lens(camera, settings)
    return camera


@torch.no_grad()
def blur_diameters(lens: Lens, distances: Tensor) -> Tensor:
    """RMS blur diameter (Z,) mm of traced rays on the axis, over object distances (Z,) mm."""
    pupil, weights = gauss_rings(12, dtype=lens.wavelengths.dtype)
    share, diameters = lens.wavelength_weights / lens.wavelength_weights.sum(), []
    for distance in distances:
        focused = with_object_distance(lens, distance)
        rays = launch(focused, pupil, fields=lens.wavelengths.new_zeros(2, 1))
        spots = spot_of(trace_lens(focused, rays, lens.wavelengths[:, None]), weights)
        diameters.append(2 * (share * spots.mean_square_radius[0]).sum().sqrt())
    return torch.stack(diameters)


@torch.no_grad()
def examples(
    camera: Camera, pictures: Pictures, settings: CodesignSettings, distances: Sequence[float]
) -> dict[str, Tensor]:
    """The test patch of the highest contrast at several distances (Z,): "picture", "image", "restored", (Z, h, w)."""
    patches = make_batch(pictures, settings, list(range(min(_PATCHES, len(pictures) * settings.crops))), TEST_EPOCH)
    chosen = int(patches.picture.flatten(1).std(1).argmax())
    distances = torch.tensor(distances, dtype=camera.fields.dtype)
    picture = patches.picture[chosen].expand(len(distances), -1, -1, -1)
    index = patches.index[[chosen] * len(distances)]
    image = camera.demosaiced(camera.image(picture, distances), index=index, seed=patches.seed)
    shown = {"picture": camera.target(picture), "image": image, "restored": camera.restore(image)}
    return {name: images[:, 0] for name, images in shown.items()}


def closed_forms(lens: Lens, settings: CodesignSettings, spectrum: Tensor, rows: Sequence[str]) -> list[Optimum]:
    """The optimum of the closed form of every row. `AFTER_PARAXIAL`: Gaussian DRT started at the paraxial optimum."""

    def optimum(model: str, start: str = settings.start) -> Optimum:
        return closed_form(lens, dataclasses.replace(settings, model=model, start=start), spectrum)

    optima = {row: optimum(row) for row in rows if row != AFTER_PARAXIAL}
    if AFTER_PARAXIAL in rows:
        before = optima.get("paraxial") or optimum("paraxial")
        optima[AFTER_PARAXIAL] = dataclasses.replace(optimum("gaussian", repr(before.sensor_mm)), model=AFTER_PARAXIAL)
    return [optima[row] for row in rows]


# -- time of a training step


@dataclasses.dataclass(frozen=True)
class StepTime:
    """Median times in ms of a batch, forward and backward."""

    model: str
    psf: float
    image: float
    network: float


def step_times(cameras: Sequence[Camera], batch: Batch, *, repeats: int = 5) -> list[StepTime]:
    """Times of the parts of a step of each camera, in turns, so that a machine that slows down slows all of them.

    The cameras are left as they were, without gradients.
    """
    before = [copy.deepcopy(camera.variables.state_dict()) for camera in cameras]
    parts = [_parts(camera, batch) for camera in cameras]
    times = [{name: [] for name in work} for work in parts]
    for _ in range(repeats):
        for work, taken in zip(parts, times, strict=True):
            for name, call in work.items():
                call()  # plans and fills caches
                for _ in range(4 if name == "psf" else 1):  # the shortest part, in which the models differ
                    start = time.perf_counter()
                    call()
                    taken[name].append(1e3 * (time.perf_counter() - start))
    for camera, state in zip(cameras, before, strict=True):
        camera.variables.load_state_dict(state)
        camera.zero_grad(set_to_none=True)
    return [
        StepTime(camera.model, **{name: statistics.median(ms) for name, ms in taken.items()})
        for camera, taken in zip(cameras, times, strict=True)
    ]


def _parts(camera: Camera, batch: Batch) -> dict[str, Callable[[], None]]:
    """The parts of a step, each forward and backward."""
    kernels = camera.kernels(batch.distance).detach().to(batch.picture.dtype).requires_grad_()
    image = camera.image(batch.picture, batch.distance).detach().requires_grad_()

    def psf() -> None:
        with torch.no_grad():  # a lens that has moved, as at every step of training: nothing is reused
            for parameter in camera.variables.parameters():
                parameter.add_(1e-9)
        camera.kernels(batch.distance).square().sum().backward()

    return {
        "psf": psf,
        "image": lambda: blur(batch.picture, kernels).square().sum().backward(),
        "network": lambda: camera.restore(image).square().sum().backward(),
    }
