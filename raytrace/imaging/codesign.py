"""Co-design: a lens and a network learned together, then the network refined on ray-traced PSFs.

Step 1 ("joint") learns the variables of the lens and the network with one PSF model. Step 2 ("refine") freezes the lens
and goes on with the network on ray-traced (DRT) PSFs, the same budget for every model: which model's lens was best?

Every sample is keyed by its number: crop, object distance and noise are the same for all models of a seed.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace.files import write_json
from raytrace.imaging.camera import Camera
from raytrace.imaging.closed_form import (
    Course,
    camera_error,
    even_distances,
    least_of_closed_form,
    out_of_focus,
    place_of,
    power_spectrum,
)
from raytrace.imaging.network import RedNet, RedNetShape
from raytrace.imaging.pictures import Pictures, crop, draws
from raytrace.imaging.plain_rays import PlainRays, points_of_models
from raytrace.imaging.training import DamagedRun, Record, Run, Share, train
from raytrace.imaging.variables import Variables
from raytrace.io import write_lens
from raytrace.maths.grid import grid
from raytrace.maths.result import plain
from raytrace.optimization.solver import NoOptimum
from raytrace.settings import GAUSSIAN, CodesignSettings
from raytrace.stores import fields_of, read_document
from raytrace.system.apertures import Aperture
from raytrace.system.lens import Lens, with_object_distance, with_sensor_distance, with_wavelengths
from raytrace.system.parameter_paths import parse_range
from raytrace.tracing.focus import focused, real_image_distance

_SAMPLE = 10  # last number of the key of what a sample draws
TEST_EPOCH = 2**20  # test samples are those of an epoch that no training reaches
STEPS = ("joint", "refine")
LENS = "lens.zmx"  # of a run: the lens as it was learned
#: What Adam's rates are multiplied with, by the part of the steps that are taken.
_DECAYS: dict[str, Callable[[float], float]] = {
    "none": lambda part: 1.0,
    "cosine": lambda part: 0.5 * (1 + math.cos(math.pi * part)),
}
_INFINITE = ("focus_paraxial_m", "focus_rms_m")  # of an outcome; null in its file


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one run found: a row of the table.

    l1_joint: on test pictures after step 1, with the PSFs of its own model; l1_drt: after step 2, with DRT PSFs;
    l1_before: between the two, the network of step 1 on DRT PSFs. focus_paraxial_m, focus_rms_m: object distance from
    vertex 1 in focus, of paraxial rays and of least RMS spot. by_distance: L1 with DRT PSFs after step 2. penalty:
    mm², violation of the thickness limits, no part of the losses; no_optimum: why the lens is none of least loss
    ("" where nothing speaks against it).
    """

    model: str
    seed: int
    l1_joint: float
    l1_before: float
    l1_drt: float
    focus_paraxial_m: float
    focus_rms_m: float
    sensor_mm: float
    variables: dict[str, float]
    by_distance: dict[str, float]
    penalty: float = 0.0
    no_optimum: str = ""

    def document(self) -> dict:
        return dataclasses.asdict(self)


def lens_at_start(lens: Lens, settings: CodesignSettings) -> Lens:
    """The lens at the wavelengths, aperture and ray aiming of the experiment, focused for the start of training.

    Raises NoImage where an object at the focus distance, or between near and far, has no real image.
    """
    wavelengths, weights = (lens.wavelengths.new_tensor(n) for n in (settings.wavelengths, settings.wavelength_weights))
    if weights.shape != wavelengths.shape or not bool((weights >= 0).all() and weights.sum() > 0):
        raise ValueError(f"{len(weights)} weights of {len(wavelengths)} wavelengths; expected one ≥ 0 for each")
    lens = with_wavelengths(lens, wavelengths, weights)
    lens = lens.at(f_number=settings.f_number, ray_aiming=settings.ray_aiming)
    if settings.vignetting == "semi-diameters":
        lens = _clipped(lens)
    real_image_distance(lens, wavelengths.new_tensor([settings.near, settings.far]))  # refuses what has none
    if settings.start in ("paraxial", "rms", "spectral", GAUSSIAN):
        return focused(lens, settings.focus_distance, on="rms" if settings.start == "rms" else "paraxial")
    try:
        return with_sensor_distance(with_object_distance(lens, settings.focus_distance), float(settings.start))
    except ValueError as error:
        raise ValueError(
            f"start {settings.start!r}: expected paraxial, rms, spectral, gaussian or a sensor distance in mm"
        ) from error


def _clipped(lens: Lens) -> Lens:
    """The lens with an aperture at the semi-diameter of every surface but the stop, which the F/number sizes."""
    surfaces = list(lens.surfaces)
    for number, surface in enumerate(surfaces):
        if surface.semi_diameter is not None and number != lens.stop:
            rim = Aperture("circular", (0.0, surface.semi_diameter))
            surfaces[number] = dataclasses.replace(surface, apertures=(*surface.apertures, rim))
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def variables(lens: Lens, settings: CodesignSettings) -> Variables:
    """The variables of an experiment as it begins, with their bounds and the limits of thicknesses."""
    return Variables(
        lens_at_start(lens, settings),
        settings.vary,
        bounds=settings.bounds,
        hold=settings.hold,
        glass_thickness=parse_range(settings.glass_thickness) if settings.glass_thickness else None,
        air_thickness=parse_range(settings.air_thickness) if settings.air_thickness else None,
        edge=settings.edge,
    )


def camera(lens: Lens, settings: CodesignSettings) -> Camera:
    """The camera of an experiment, as it begins."""
    like = lens.wavelengths
    fields = torch.stack([like.new_zeros(len(settings.fields)), like.new_tensor(settings.fields)])
    if settings.precision not in ("float32", "bfloat16"):
        raise ValueError(f"precision {settings.precision!r}: expected float32 or bfloat16")
    kind = Camera
    sampled = points_of_models(settings)
    if sampled:
        kind = partial(PlainRays, points=sampled, kept=() if settings.drt_rays is None else ("drt",))
    return kind(
        variables(lens, settings),
        RedNet(RedNetShape(settings.depth, settings.width), seed=settings.seed).to(memory_format=torch.channels_last),
        model=settings.model,
        object_distances=(settings.near, settings.far),
        fields=fields,
        pixels=grid(like.new_tensor(settings.pixel), settings.size),
        normalise=settings.normalise,
        noise=settings.noise,
        tol=settings.tol,
        rho=settings.rho,
        network_dtype=torch.bfloat16 if settings.precision == "bfloat16" else None,
    )


def begin(own: Camera, settings: CodesignSettings, spectrum: Tensor) -> Course:
    """Bring the variables of a camera to the optimum of a closed form: of its own model, or of Gaussian DRT, as
    the `start` of the settings says."""
    model = "gaussian" if settings.start == GAUSSIAN else settings.model
    first = camera(own.variables.lens, dataclasses.replace(settings, model=model))
    course, _ = least_of_closed_form(first, spectrum, distances=even_distances(first, spread=settings.spread))
    own.variables.load_state_dict(first.variables.state_dict())
    return course


@dataclasses.dataclass(frozen=True)
class Batch:
    """Samples of one step: picture (B, H, W) float32, distance (B,) mm float64, noise (B, h, w) of deviation 1."""

    picture: Tensor
    distance: Tensor
    noise: Tensor
    field: list[int]


def batch(pictures: Pictures, settings: CodesignSettings, samples: list[int], epoch: int) -> Batch:
    """The samples of an epoch with these numbers."""
    size, parts = settings.patch + settings.size - 1, []
    for sample in samples:
        patch = crop(pictures, sample, epoch=epoch, size=size, crops=settings.crops, seed=settings.seed)
        random = draws(settings.seed, epoch, sample, _SAMPLE)
        distance = drawn_distance(random, settings)
        parts.append((patch, distance, random.standard_normal((settings.patch,) * 2, dtype=np.float32)))
    picture, distance, noise = (np.stack(part) for part in zip(*parts, strict=True))
    field = [sample % len(settings.fields) for sample in samples]
    return Batch(torch.as_tensor(picture), torch.as_tensor(distance), torch.as_tensor(noise), field)


def drawn_distance(random: np.random.Generator, settings: CodesignSettings) -> float:
    """An object distance in mm, even in z or in 1/z."""
    if settings.spread == "uniform":
        return random.uniform(settings.near, settings.far)
    return 1 / random.uniform(1 / settings.far, 1 / settings.near)


def steps_per_epoch(pictures: Pictures, settings: CodesignSettings) -> int:
    """Raises ValueError if the pictures do not fill a batch."""
    if steps := len(pictures) * settings.crops // settings.batch:
        return steps
    raise ValueError(
        f"{len(pictures)} pictures to train on, {settings.crops} crops of each, do not fill one batch of "
        f"{settings.batch}; give more pictures, more crops or a smaller batch"
    )


class Batches:
    """The batches of a run by step; the next one is made while a step is taken."""

    def __init__(self, pictures: Pictures, settings: CodesignSettings):
        self.pictures, self.settings = pictures, settings
        self.steps_per_epoch = steps_per_epoch(pictures, settings)
        self._maker = ThreadPoolExecutor(1)
        self._coming: dict[tuple[int, Share], object] = {}

    def __call__(self, step: int, share: Share) -> Batch:
        ready = self._coming.pop((step, share), None) or self._make(step, share)
        self._coming = {(step + 1, share): self._make(step + 1, share)}
        return ready.result()

    def _make(self, step: int, share: Share):
        epoch, place = divmod(step, self.steps_per_epoch)
        first = place * self.settings.batch
        samples = share.of(range(first, first + self.settings.batch))
        return self._maker.submit(batch, self.pictures, self.settings, samples, epoch)


def absolute_error(camera: Camera, batch: Batch) -> Tensor:
    """Σ |restored - picture| of every sample, (B,)."""
    if len(camera.fields[0]) == 1:
        restored = camera(batch.picture, batch.distance, noise=batch.noise)
        return (restored - camera.target(batch.picture)).abs().sum((-2, -1))
    errors = torch.zeros(len(batch.field))
    for field in sorted(set(batch.field)):
        where = torch.tensor([i for i, own in enumerate(batch.field) if own == field])
        restored = camera(batch.picture[where], batch.distance[where], field=field, noise=batch.noise[where])
        difference = (restored - camera.target(batch.picture[where])).abs().sum((-2, -1))
        errors = errors.index_put((where,), difference)
    return errors


def optimise(
    camera: Camera, pictures: Pictures, settings: CodesignSettings, run: Run, *, every: int = 50
) -> Iterator[tuple[int, Record]]:
    """The steps of one training, one at a time; variables of the lens that need no gradient stay where they are."""
    batches, pixels = Batches(pictures, settings), settings.batch * settings.patch**2
    optics = [p for p in camera.variables.parameters() if p.requires_grad]
    groups = [{"params": list(camera.network.parameters()), "lr": settings.rate_network}]
    groups += [{"params": optics, "lr": settings.rate_optics}] if optics else []
    optimizer, steps = torch.optim.Adam(groups), settings.epochs * batches.steps_per_epoch
    rates = [group["lr"] for group in groups]

    def loss(step: int, share: Share) -> tuple[Tensor, Record]:
        # By the number of the step alone: a run that goes on has the rates of one that never stopped.
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * _DECAYS[settings.decay](step / steps)
        return absolute_error(camera, batches(step, share)).sum() / pixels, camera.variables.numbers()

    yield from train(
        camera,
        optimizer,
        loss,
        steps=steps,
        run=run,
        every=every,
        after_step=camera.variables.project,
        penalty=camera.variables.violation,
    )


#: Wraps the batches of a test, for a bar.
Progress = Callable[[Sequence[int]], Iterable[int]]


@torch.no_grad()
def held_out_error(
    camera: Camera,
    pictures: Pictures,
    settings: CodesignSettings,
    *,
    distance: float | None = None,
    progress: Progress = iter,
) -> float:
    """Mean |restored - picture| of all test samples, at drawn object distances or at one."""
    count, total = len(pictures) * settings.crops, 0.0
    for first in progress(range(0, count, settings.batch)):
        found = batch(pictures, settings, list(range(first, min(first + settings.batch, count))), TEST_EPOCH)
        if distance is not None:
            found = dataclasses.replace(found, distance=torch.full_like(found.distance, distance))
        total += float(absolute_error(camera, found).sum())
    return total / (count * settings.patch**2)


def run_model(
    lens: Lens,
    train_pictures: Pictures,
    test_pictures: Pictures,
    settings: CodesignSettings,
    folder: Path,
    *,
    about: dict,
    distances: tuple[float, ...],
    catalogs: Sequence[str | Path] = (),
    progress: Progress = iter,
) -> Iterator[tuple[str, int, Record]]:
    """Both steps of one model and seed, a training step at a time: (step's name, its number, what it reports).

    folder: of this run, resumed if begun; about: what else decides the result (lens file, pictures); progress: wraps
    the batches of every test; catalogs: of glass, that the lens was read with. At the end the learned lens is written
    to `lens.zmx` there, and the outcome to `outcome.json`, read by `outcome`.
    """
    folder = Path(folder)
    if (folder / "outcome.json").exists():
        _run(settings, folder, about, STEPS[0])  # refuses other settings
        return
    own = camera(lens, settings)
    own.plan()  # before a checkpoint moves the lens: a run that goes on has the PSFs of one that never stopped
    for step, record in _steps(own, train_pictures, settings, folder, about, STEPS[0]):
        yield STEPS[0], step, record
    l1_joint = held_out_error(own, test_pictures, settings, progress=progress)
    own.variables.requires_grad_(False)
    own.use("drt")
    l1_before = held_out_error(own, test_pictures, settings, progress=progress)
    for step, record in _steps(own, train_pictures, settings, folder, about, STEPS[1]):
        yield STEPS[1], step, record
    found = own.variables()
    result = Outcome(
        model=settings.model,
        seed=settings.seed,
        l1_joint=l1_joint,
        l1_before=l1_before,
        l1_drt=held_out_error(own, test_pictures, settings, progress=progress),
        **place_of(found),
        variables=own.variables.numbers(),
        penalty=float(own.variables.violation().detach()),
        no_optimum=out_of_focus(own),
        by_distance={
            f"{d:g}": held_out_error(own, test_pictures, settings, distance=d, progress=progress) for d in distances
        },
    )
    write_lens(found, folder / LENS, catalogs=catalogs)
    write_outcome(result, folder)


def write_outcome(found: Outcome, folder: Path) -> None:
    """Write `outcome.json`; a focus at infinity is null there."""
    write_json(folder / "outcome.json", plain(found.document()))


def outcome(folder: Path) -> Outcome | None:
    """What a finished run found, None for one that is not."""
    path = Path(folder) / "outcome.json"
    if not path.exists():
        return None
    check = fields_of(Outcome, nullable=_INFINITE)
    document = read_document(path, check, DamagedRun, "remove it to find it anew")
    return Outcome(**document | {key: math.inf for key in _INFINITE if document.get(key, 0.0) is None})


def _run(settings: CodesignSettings, folder: Path, about: dict, name: str) -> Run:
    """The folder of a step. Raises OtherSettings."""
    return Run(folder / name, {**dataclasses.asdict(settings), **about, "step": name}, usual=usual(settings))


def usual(settings: CodesignSettings) -> dict:
    """The defaults of all settings: what a folder means that was begun before there was one of them."""
    return {field.name: field.default for field in dataclasses.fields(settings)}


def _steps(own: Camera, pictures: Pictures, settings: CodesignSettings, folder: Path, about: dict, name: str):
    run = _run(settings, folder, about, name)
    if settings.start in ("spectral", GAUSSIAN) and name == STEPS[0] and not run.checkpoint.exists():
        size = settings.patch + settings.size - 1
        course = begin(own, settings, power_spectrum(pictures, size, crops=settings.crops, seed=settings.seed))
        if course.no_optimum:
            warnings.warn(f"start {settings.start}: {course.no_optimum}", NoOptimum, stacklevel=2)
    yield from optimise(own, pictures, settings, run)


# -- the closed form ---------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Place:
    """Where one model put the lens.

    error: mean square error of a pixel with the model's own PSFs; error_drt: of the same lens with DRT PSFs and the
    filter that is best for them; penalty: mm², violation of the limits, no part of the errors.
    Focus distances in m as for `Outcome`; no_optimum: why this lens is none of least error, "" where it is one.
    downhill_mm: the sensor of the optimum downhill from where the search began, another than `sensor_mm` where that one
    is only a local one (`least_of_closed_form`).
    """

    model: str
    sensor_mm: float
    focus_paraxial_m: float
    focus_rms_m: float
    error: float
    error_drt: float
    penalty: float = 0.0
    no_optimum: str = ""
    downhill_mm: float = math.nan


#: Columns of `spectral.csv`.
OPTIMUM_COLUMNS = tuple(field.name for field in dataclasses.fields(Place))


@dataclasses.dataclass(frozen=True)
class Optimum(Place):
    """The lens of least closed-form error of one model.

    course, penalties: error and penalty at every evaluation. at_end: variables at an end of their bounds behind which
    the error still falls; lens: as it was found.
    """

    variables: dict[str, float] = dataclasses.field(default_factory=dict)
    course: tuple[float, ...] = ()
    penalties: tuple[float, ...] = ()
    at_end: tuple[str, ...] = ()
    lens: Lens | None = None

    def document(self) -> dict:
        """All but the lens."""
        return {name: value for name, value in vars(self).items() if name != "lens"}


def closed_form(lens: Lens, settings: CodesignSettings, spectrum: Tensor) -> Optimum:
    """The optimum of the model of the settings. spectrum: `power_spectrum` of the pictures."""
    own = camera(lens, settings)
    if settings.start == GAUSSIAN:
        begin(own, settings, spectrum)
    distances = even_distances(own, spread=settings.spread)
    course, downhill = least_of_closed_form(own, spectrum, distances=distances)
    with torch.no_grad():
        found = own.variables()
        error = camera_error(own, spectrum, distances)
        own.use("drt")
        error_drt = camera_error(own, spectrum, distances)
    return Optimum(
        model=settings.model,
        **place_of(found),
        downhill_mm=downhill,
        error=float(error),
        error_drt=float(error_drt),
        variables=own.variables.numbers(),
        course=course.errors,
        penalty=float(own.variables.violation().detach()),
        penalties=course.penalties,
        at_end=course.at_end,
        no_optimum=course.no_optimum,
        lens=found,
    )
