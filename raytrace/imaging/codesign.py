"""Co-design: a lens and a restoration network trained together, then the network refined on ray-traced PSFs.

Step 1 ("joint") trains the variables of the lens and the network with one PSF model. Step 2 ("refine") freezes the lens
and continues to train the network on ray-traced (DRT) PSFs for the same number of epochs, so that all lenses are
compared with the same PSF model.

Samples are keyed by their number: crop, object distance, noise and errors of manufacture are the same for all models of
a seed.
"""

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from raytrace.files import write_json
from raytrace.imaging.camera import Camera
from raytrace.imaging.closed_form import (
    Course,
    camera_error,
    even_distances,
    field_filters,
    focus_columns,
    least_of_closed_form,
    out_of_focus,
    patch_spectrum,
)
from raytrace.imaging.field_kernels import Model
from raytrace.imaging.image import decoded
from raytrace.imaging.network import RedNetShape, UNetShape, network
from raytrace.imaging.pictures import Pictures, crop, draws
from raytrace.imaging.restoration import psnr, restore, restore_jointly
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.training import DamagedRun, Record, Run, Share, load_state, train
from raytrace.imaging.variables import Variables
from raytrace.io import write_lens
from raytrace.maths.result import plain
from raytrace.maths.sampling import hexapolar, sobol
from raytrace.optimization.least_squares import NoOptimum
from raytrace.psf_models import DRT, Paraxial, model_of
from raytrace.settings import GAUSSIAN, CodesignSettings
from raytrace.shards import share
from raytrace.stores import fields_of, read_document
from raytrace.system.apertures import Aperture
from raytrace.system.lens import Lens, with_object_distance, with_sensor_distance, with_wavelengths
from raytrace.system.parameter_paths import GLASS, parse_range
from raytrace.tolerancing.grades import tolerances
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.table import ToleranceTable
from raytrace.tracing.focus import focused, real_image_distance

_SAMPLE = 10  # last number of the key of a sample's random numbers
TEST_EPOCH = 2**20  # epoch of the test samples, which training never reaches
_FIRST_TEST_TRIAL = 2**62  # trial number of the first perturbed test camera, of seed 0, which training never reaches
STEPS = ("joint", "refine")
LENS_STEPS = 6  # of the lens in a turn
_BATCHES = 4  # of the loss of a turn
_ADAPTING = 3  # steps of the network inside the loss of a turn
_RATES = tuple(4.0**-k for k in range(8))  # of these steps
TEST_POSITIONS = (0.0, 0.7, 1.0)  # of the test patches, as shares of the half diagonal of a sensor
LENS = "lens.zmx"  # of a run: the optimised lens
_INFINITE = ("focus_paraxial_m", "focus_rms_m")  # of an outcome; null in its file

# -- the camera of an experiment


def lens_at_start(lens: Lens, settings: CodesignSettings) -> Lens:
    """The lens at the wavelengths, aperture and ray aiming of the experiment, focused for the start of training.

    Raises NoImage where an object at the focus distance, or between near and far, has no real image.
    """
    wavelengths, weights = (lens.wavelengths.new_tensor(n) for n in (settings.wavelengths, settings.wavelength_weights))
    if weights.shape != wavelengths.shape or not bool((weights >= 0).all() and weights.sum() > 0):
        raise ValueError(
            f"{len(weights)} wavelength_weights for {len(wavelengths)} wavelengths: give one weight ≥ 0 for each "
            "wavelength, at least one above 0"
        )
    lens = with_wavelengths(lens, wavelengths, weights)
    lens = lens.at(f_number=settings.f_number, ray_aiming=settings.ray_aiming)
    if settings.vignetting == "semi-diameters":  # at every surface but the stop, which the F/number sizes
        surfaces = list(lens.surfaces)
        for number, surface in enumerate(surfaces):
            if surface.semi_diameter is not None and number != lens.stop:
                rim = Aperture("circular", (0.0, surface.semi_diameter))
                surfaces[number] = dataclasses.replace(surface, apertures=(*surface.apertures, rim))
        lens = dataclasses.replace(lens, surfaces=tuple(surfaces))
    real_image_distance(lens, wavelengths.new_tensor([settings.near, settings.far]))  # raises NoImage
    if settings.start in ("paraxial", "rms", "spectral", GAUSSIAN):
        return focused(lens, settings.focus_distance, on="rms" if settings.start == "rms" else "paraxial")
    try:
        return with_sensor_distance(with_object_distance(lens, settings.focus_distance), float(settings.start))
    except ValueError as error:
        raise ValueError(
            f"start {settings.start!r}: expected paraxial, rms, spectral, gaussian or a sensor distance in mm"
        ) from error


def variables(lens: Lens, settings: CodesignSettings, *, catalogs: Sequence[str | PathLike] = ()) -> Variables:
    """The variables of an experiment at its start, with their bounds and the limits of thicknesses.

    catalogs: names or AGF files of the glasses that may be chosen, by default those of the lens.
    """
    return Variables(
        lens_at_start(lens, settings),
        settings.vary,
        bounds=settings.bounds,
        hold=settings.hold,
        stored=not settings.no_hold,
        glass_thickness=parse_range(settings.glass_thickness) if settings.glass_thickness else None,
        air_thickness=parse_range(settings.air_thickness) if settings.air_thickness else None,
        edge=settings.edge,
        glasses=settings.glasses,
        catalog=catalogs,
        step=settings.step,
    )


def pupil_points(sampling: str, count: int | None, *, seed: int = 0) -> Tensor | None:
    """Pupil points (2, P): `count` Sobol points, or hexapolar ones of the fewest rings with as many; None if no
    count is specified."""
    if count is None:
        return None
    if sampling == "hexapolar":
        rings = 1
        while 1 + 3 * rings * (rings + 1) < count:
            rings += 1
        return hexapolar(rings)[0]
    return sobol(count, seed=seed)[0]


def tolerances_at_start(lens: Lens, settings: CodesignSettings) -> ToleranceTable | None:
    """Tolerances of an experiment, of its grade and limits or of the file; None if none are specified. Raises
    BadTolerance."""
    if not settings.is_toleranced:
        return None
    if settings.refocus not in ("sensor", "none"):
        raise ValueError(f"refocus {settings.refocus!r}: expected sensor or none")
    compensators = None if settings.refocus == "sensor" else ()
    return tolerances(
        lens_at_start(lens, settings), settings.limits, grade=settings.grade or None, compensators=compensators
    )


@functools.lru_cache(maxsize=8)  # called for every batch; the response may be a file
def sensor_at_start(settings: CodesignSettings) -> Sensor:
    """The sensor of an experiment; without `sensor` a monochrome sensor of one patch with Gaussian noise alone."""
    if not settings.sensor:
        side, count = settings.patch * settings.pixel, settings.patch
        return Sensor(size=(side, side), pixels=(count, count), read_noise=settings.noise, saturation=math.inf)
    columns, rows = (max(1, round(side / settings.pixel)) for side in settings.sensor)
    return Sensor(
        size=(columns * settings.pixel, rows * settings.pixel),
        pixels=(columns, rows),
        response=settings.response,
        mosaic=settings.mosaic,
        full_well=settings.full_well,
        read_noise=settings.noise if settings.full_well is None else settings.read_noise,
        bits=settings.bits,
    )


def network_at_start(settings: CodesignSettings) -> torch.nn.Module:
    """The untrained network of an experiment, of as many channels as its sensor has; its weights are channels_last.

    Raises ValueError.
    """
    shapes: dict[str, type[RedNetShape] | type[UNetShape]] = {"red-net": RedNetShape, "u-net": UNetShape}
    if settings.network not in shapes:
        raise ValueError(f"network {settings.network!r}: expected {' or '.join(shapes)}")
    shape = shapes[settings.network](settings.depth, settings.width)
    untrained = network(shape, channels=len(sensor_at_start(settings).channels), seed=settings.seed)
    return untrained.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in torch's overloads


def model_at(name: str, settings: CodesignSettings) -> Model:
    """PSF model of an experiment; a specified number of rays sets fixed pupil points, which replace `tol`."""
    rays = {"gaussian": settings.rays, "drt": settings.rays if settings.drt_rays is None else settings.drt_rays}
    if name == "paraxial":
        return Paraxial(rho=settings.rho)
    points = pupil_points(settings.sampling, rays.get(name), seed=settings.seed)
    return model_of(name) if points is None else model_of(name, rays=points)


def initial_camera(
    lens: Lens, settings: CodesignSettings, *, catalogs: Sequence[str | PathLike] = ()
) -> Camera[Variables]:
    """The camera of an experiment at its start; catalogs: as of `variables`."""
    if settings.precision not in ("float32", "bfloat16"):
        raise ValueError(f"precision {settings.precision!r}: expected float32 or bfloat16")
    if settings.turns and settings.optimizer != "lm":
        raise ValueError(f"turns {settings.turns} with optimizer {settings.optimizer!r}: expected optimizer lm")
    return Camera(
        variables(lens, settings, catalogs=catalogs),
        network_at_start(settings),
        sensor=sensor_at_start(settings),
        model=model_at(settings.model, settings),
        object_distances=(settings.near, settings.far),
        fields=None if settings.sensor else settings.fields,
        pixels=settings.size,
        normalise=settings.normalise,
        tol=settings.tol,
        network_dtype=torch.bfloat16 if settings.precision == "bfloat16" else None,
        center=settings.center or ("centroid" if settings.is_toleranced else "chief"),
        tolerances=tolerances_at_start(lens, settings),
    )


def with_catalog_glasses(
    trained: Camera[Variables], settings: CodesignSettings
) -> tuple[Camera[Variables], CodesignSettings]:
    """The camera with the nearest glasses of the catalogs, and the settings to train it again for `relearn` epochs.

    All variables except those of glasses remain, at their current values, and the network is the trained one. Raises
    BadVariables where no glass varies.
    """
    lens = trained.variables.snapped()
    words = [word for word in settings.vary.split() if word.partition(":")[0] not in GLASS]
    hold = " ".join(word for word in settings.hold.split() if word != "catalog")
    sensor = float(lens.surfaces[-2].thickness)
    again = dataclasses.replace(
        settings, vary=" ".join(words), hold=hold, epochs=settings.relearn, start=repr(sensor), relearn=0
    )
    with_glasses = initial_camera(lens, again, catalogs=trained.variables.catalog)
    with_glasses.network.load_state_dict(trained.network.state_dict())
    with_glasses.plan()
    return with_glasses, again


def freeze_lens(camera: Camera[Variables], settings: CodesignSettings) -> None:
    """Prepare step 2: a fixed lens and its DRT PSFs, over the whole pupil or of the `drt_rays`."""
    camera.variables.requires_grad_(False)
    points = pupil_points(settings.sampling, settings.drt_rays, seed=settings.seed)
    camera.use("drt" if points is None else DRT(rays=points))


# -- training


@dataclasses.dataclass(frozen=True)
class Batch:
    """Samples of one step: picture (B, C, H, W) float32, distance (B,) mm float64; index (B,), seed: of their noise.

    field: (B,) numbers of the camera's fields, or points: (2, B) mm on the sensor; errors: of manufacture, (B, N) or
    (N,) of one lens, float64; None of the nominal lens.
    """

    picture: Tensor
    distance: Tensor
    index: Tensor
    seed: int
    field: list[int]
    points: Tensor | None = None
    errors: Tensor | None = None

    def to(self, device: torch.device) -> Self:
        """The batch on a device; field, index and seed remain plain numbers."""
        if self.picture.device == device:
            return self
        names = ("picture", "distance", "errors", "points")
        moved = {name: getattr(self, name).to(device) for name in names if getattr(self, name) is not None}
        return dataclasses.replace(self, **moved)

    @property
    def capture(self) -> dict:
        """Place, errors and noise of the samples, as a camera takes them."""
        names = ("field", "points", "errors", "index", "seed")
        return {name: getattr(self, name) for name in names}


def make_batch(
    pictures: Pictures,
    settings: CodesignSettings,
    samples: list[int],
    epoch: int,
    tolerances: ToleranceTable | None = None,
) -> Batch:
    """The samples of an epoch with these numbers; object distances are uniform in z or in 1/z.

    tolerances: each sample has its own perturbed lens, whose trial number is the number of the sample, counted over all
    epochs.
    """
    size, parts = settings.patch + settings.size - 1, []
    for sample in samples:
        patch = crop(pictures, sample, epoch=epoch, size=size, crops=settings.crops, seed=settings.seed)
        random = draws(settings.seed, epoch, sample, _SAMPLE)
        if settings.spread == "uniform":
            z = random.uniform(settings.near, settings.far)
        else:
            z = 1 / random.uniform(1 / settings.far, 1 / settings.near)
        parts.append((patch, z))
    picture, distance = (torch.as_tensor(np.stack(part)) for part in zip(*parts, strict=True))
    count, numbers, points, errors = len(pictures) * settings.crops, torch.tensor(samples), None, None
    index, sensor = epoch * count + numbers, sensor_at_start(settings)
    if settings.sensor:
        picture = light_of(picture)
        points = sensor.patch_points(sensor.random_patches(index, settings.patch, settings.seed), settings.patch)
    else:
        picture = picture[:, None]
    if tolerances is not None:
        first, last = min(samples), max(samples)
        drawn = draw_errors(tolerances, last - first + 1, settings.seed, first=epoch * count + first)
        errors = drawn[numbers - first]
    field = [sample % len(settings.fields) for sample in samples]
    return Batch(picture, distance, index, settings.seed, field, points, errors)


def spectrum_of(pictures: Pictures, settings: CodesignSettings) -> Tensor:
    """`patch_spectrum` of the patches of an experiment with their margin; cross spectra for joint filters."""
    if settings.filters not in ("separate", "joint"):
        raise ValueError(f"filters {settings.filters!r}: expected separate or joint")
    size = settings.patch + settings.size - 1
    joint = settings.filters == "joint"
    if joint and not settings.sensor:
        raise ValueError("filters 'joint' require a sensor with colours: set sensor, as 24x16")
    return patch_spectrum(pictures, size, crops=settings.crops, seed=settings.seed, joint=joint)


def light_of(levels: Tensor) -> Tensor:
    """Light (..., C, H, W) of sRGB levels (..., H, W), or (..., H, W, 3), from 0 to 1."""
    channels_first = levels.movedim(-1, -3) if levels.shape[-1] == 3 else levels[..., None, :, :]
    return decoded(channels_first).contiguous()


def steps_per_epoch(pictures: Pictures, settings: CodesignSettings) -> int:
    """The number of whole batches of an epoch. Raises ValueError if the pictures do not fill one."""
    if steps := len(pictures) * settings.crops // settings.batch:
        return steps
    raise ValueError(
        f"{len(pictures)} pictures to train on, {settings.crops} crops of each, do not fill one batch of "
        f"{settings.batch}; give more pictures, more crops or a smaller batch"
    )


class Batches:
    """The batches of a run by step; the next one is prepared by a thread while a step is taken."""

    def __init__(self, pictures: Pictures, settings: CodesignSettings, tolerances: ToleranceTable | None = None):
        self.pictures, self.settings, self.tolerances = pictures, settings, tolerances
        self.steps_per_epoch = steps_per_epoch(pictures, settings)
        self._thread = ThreadPoolExecutor(1)
        self._next: dict[tuple[int, Share], Future[Batch]] = {}

    def __call__(self, step: int, share: Share) -> Batch:
        ready = self._next.pop((step, share), None) or self._make(step, share)
        self._next = {(step + 1, share): self._make(step + 1, share)}
        return ready.result()

    def _make(self, step: int, share: Share) -> Future[Batch]:
        epoch, place = divmod(step, self.steps_per_epoch)
        first = place * self.settings.batch
        samples = share.of(range(first, first + self.settings.batch))
        return self._thread.submit(make_batch, self.pictures, self.settings, samples, epoch, self.tolerances)


def absolute_error(camera: Camera, batch: Batch) -> Tensor:
    """Σ |restored - picture| of every sample, (B,)."""
    return _summed(camera, batch, lambda difference: difference.abs())[0]


def _summed(camera: Camera, batch: Batch, *measures: Callable[[Tensor], Tensor]) -> list[Tensor]:
    """Sum over pixels of each measure of (restored - picture), (B,), averaged over channels."""
    batch = batch.to(camera.fields.device)
    difference = camera(batch.picture, batch.distance, **batch.capture) - camera.target(batch.picture)
    return [measure(difference).mean(-3).sum((-2, -1)) for measure in measures]


def optimise(
    camera: Camera[Variables],
    pictures: Pictures,
    settings: CodesignSettings,
    run: Run,
    *,
    every: int = 50,
    turn: int = 0,
) -> Iterator[tuple[int, Record]]:
    """The steps of one training, one at a time; lens variables with requires_grad=False stay fixed.

    turn: after which the network is trained again, a column of the log.
    """
    batches = Batches(pictures, settings, camera.tolerances if settings.as_built else None)
    about = {"turn": float(turn)} if turn else {}
    pixels = settings.batch * settings.patch**2
    optics = [p for p in camera.variables.parameters() if p.requires_grad]
    groups: list[dict[str, Any]] = [{"params": list(camera.network.parameters()), "lr": settings.rate_network}]
    groups += [{"params": optics, "lr": settings.rate_optics}] if optics else []
    optimizer, steps = torch.optim.Adam(groups), settings.epochs * batches.steps_per_epoch

    def loss(step: int, share: Share) -> tuple[Tensor, Record]:
        return absolute_error(camera, batches(step, share)).sum() / pixels, camera.variables.numbers() | about

    return train(
        camera,
        optimizer,
        loss,
        steps=steps,
        run=run,
        every=every,
        after_step=camera.variables.project,
        penalty=camera.variables.violation,
        schedule="cosine" if settings.decay == "cosine" else None,
    )


def adapted_error(
    camera: Camera[Variables], batches: Sequence[Batch], rate: float, *, steps: int = _ADAPTING
) -> Tensor:
    """Mean |restored - picture| of batches behind a network that has adapted to the lens, plus the penalty for violated
    limits; differentiable in the lens through the adaptation.

    The weights take `steps` steps of this rate down the gradient of the same mean from those of the camera, which stay.
    """
    recorded, targets = [], []
    for batch in batches:
        batch = batch.to(camera.fields.device)
        image = camera.image(batch.picture, batch.distance, batch.field, batch.errors, points=batch.points)
        recorded.append(camera.demosaiced(image, batch.points, batch.index, batch.seed))
        targets.append(camera.target(batch.picture))
    weights = {name: weight.detach().requires_grad_() for name, weight in camera.network.named_parameters()}
    images, pictures = torch.cat(recorded).to(next(iter(weights.values())).dtype), torch.cat(targets)

    def error(weights: Mapping[str, Tensor]) -> Tensor:
        return (functional_call(camera.network, dict(weights), (images,)) - pictures).abs().mean()

    for _ in range(steps):
        slopes = torch.autograd.grad(error(weights), list(weights.values()), create_graph=True)
        steepest = zip(weights.items(), slopes, strict=True)
        weights = {name: weight - rate * slope for (name, weight), slope in steepest}
    return error(weights) + camera.variables.violation()


def adapting_rate(camera: Camera[Variables], batches: Sequence[Batch]) -> float:
    """The rate, a power of 1/4, by which the error behind the adapted network is lowest, of the lens as it is."""
    errors = {rate: float(adapted_error(camera, batches, rate).detach()) for rate in (0.0, *_RATES)}
    return min(errors, key=lambda rate: errors[rate] if math.isfinite(errors[rate]) else math.inf)


def take_turn(
    camera: Camera[Variables], pictures: Pictures, settings: CodesignSettings, run: Run, turn: int
) -> Iterator[tuple[int, Record]]:
    """The steps of the lens of a turn, one at a time, for the loss of a network that adapts to the lens.

    The batches of all steps of a turn are the same, and in no training. A turn that resumes needs the camera as it was
    at its start.
    """
    built, size = camera.tolerances if settings.as_built else None, settings.batch
    count = min(_BATCHES, steps_per_epoch(pictures, settings))
    firsts, epoch = range(0, count * size, size), settings.epochs + turn
    batches = [make_batch(pictures, settings, [*range(first, first + size)], epoch, built) for first in firsts]
    rate = adapting_rate(camera, batches)
    state = run.load()
    step = 0 if state is None else load_state(camera, state, run.checkpoint)
    is_writer, variables = share().rank == 0, camera.variables
    if is_writer:
        run.drop_rows_from(step)
    variables.requires_grad_(True)
    while step < LENS_STEPS:
        penalty, numbers = float(variables.violation().detach()), variables.numbers()
        total = camera.lens_step(lambda: adapted_error(camera, batches, rate))
        step += 1
        record = {"loss": total - penalty, "penalty": penalty, **numbers, "turn": float(turn), "lens_step": float(step)}
        if is_writer:
            run.append([(step - 1, record)])
            run.save({"step": step, "module": camera.state_dict()})
        yield step - 1, record
    variables.requires_grad_(False)


@torch.no_grad()
def held_out_error(
    camera: Camera,
    pictures: Pictures,
    settings: CodesignSettings,
    *,
    distance: float | None = None,
    place: float | None = None,
    filters: Tensor | None = None,
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> float:
    """Mean |restored - picture| of all test samples, at random object distances or at one.

    place: all patches at this share of the way from the middle of the sensor to its upper left corner; filters: (C,
    rows, columns), or joint ones (C, C, rows, columns), instead of the network; progress: wraps the batches, for a bar.
    """
    count, total = len(pictures) * settings.crops, 0.0
    for first in progress(range(0, count, settings.batch)):
        samples = make_batch(pictures, settings, list(range(first, min(first + settings.batch, count))), TEST_EPOCH)
        if distance is not None:
            samples = dataclasses.replace(samples, distance=torch.full_like(samples.distance, distance))
        if place is not None:
            points = camera.sensor.on_diagonal([place]).expand(2, len(samples.index))
            samples = dataclasses.replace(samples, points=points)
        if filters is None:
            total += float(absolute_error(camera, samples).sum())
        else:
            total += float(_filtered_error(camera, samples, filters).sum())
    return total / (count * settings.patch**2)


def _filtered_error(camera: Camera, batch: Batch, filters: Tensor) -> Tensor:
    """Σ |filtered - picture| of every sample after linear filters (C, rows, columns), (B,)."""
    batch = batch.to(camera.fields.device)
    image = camera.image(batch.picture, batch.distance, batch.field, batch.errors, points=batch.points)
    captured = camera.demosaiced(image, batch.points, batch.index, batch.seed)
    apply = restore_jointly if filters.dim() == 4 else restore
    restored = apply(captured, filters.to(torch.complex64), boundary="taper")
    return (restored - camera.target(batch.picture)).abs().mean(-3).sum((-2, -1))


@torch.no_grad()
def errors_as_built(
    camera: Camera,
    pictures: Pictures,
    settings: CodesignSettings,
    *,
    set_number: int = 0,
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> tuple[Tensor, Tensor]:
    """Mean |restored - picture| (C,) and PSNR (C,) dB of the mean square error, of perturbed cameras
    that training never draws.

    All cameras record the same batch of test samples; their errors are the same for all seeds and trainings.
    set_number: of sets of other cameras. progress: wraps the numbers of the cameras, for a bar.
    """
    count, pixels = len(pictures) * settings.crops, settings.patch**2
    samples = make_batch(pictures, settings, list(range(min(settings.batch, count))), TEST_EPOCH)
    if camera.tolerances is None:
        raise ValueError("errors as built of a camera without tolerances: give as_built, grade or limits")
    drawn, means = (
        draw_errors(camera.tolerances, settings.cameras, first=_FIRST_TEST_TRIAL + set_number * settings.cameras),
        [],
    )
    for number in progress(range(settings.cameras)):
        of_lens = dataclasses.replace(samples, errors=drawn[number])
        sums = _summed(camera, of_lens, lambda difference: difference.abs(), lambda difference: difference.square())
        means.append([float(part.sum()) / (len(samples.field) * pixels) for part in sums])
    absolute, square = torch.tensor(means, dtype=torch.float64).unbind(-1)
    return absolute, psnr(square)


# -- a run


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of a run.

    l1_joint: on test pictures after step 1, with the PSFs of its own model; l1_drt: after step 2, with DRT PSFs;
    l1_before: between the two, the network of step 1 on DRT PSFs. focus_paraxial_m, focus_rms_m: object distance from
    vertex 1 in focus, of paraxial rays and of least RMS spot. by_distance: L1 with DRT PSFs after step 2. penalty:
    mm², violation of the thickness limits, not part of the losses; no_optimum: the reason why the lens is no optimum
    ("" if none is known). l1_as_built, psnr_as_built: of perturbed cameras after step 2, by their number, with DRT
    PSFs; empty without tolerances.
    Of a sensor: l1_by_place with DRT PSFs after step 2, by the share of the half diagonal at which all test patches
    are; wiener_by_place: with the depth-invariant Wiener filter of each place and channel instead of the network.
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
    l1_as_built: dict[str, float] = dataclasses.field(default_factory=dict)
    psnr_as_built: dict[str, float] = dataclasses.field(default_factory=dict)
    l1_by_place: dict[str, float] = dataclasses.field(default_factory=dict)
    wiener_by_place: dict[str, float] = dataclasses.field(default_factory=dict)

    def document(self) -> dict:
        return dataclasses.asdict(self)


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
    device: str | torch.device = "cpu",
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> Iterator[tuple[str, int, Record]]:
    """Both steps of one model and seed, a training step at a time: (name of the step, number, record of the log).

    folder: of this run, resumed if started; about: other inputs that determine the result (lens file, pictures);
    progress: wraps the batches of every test; catalogs: of glass, with which the lens was read and from which glasses
    are chosen; device: of the training. At the end the optimised lens is written to `lens.zmx` there, and the outcome
    to `outcome.json`, read by
    `outcome`.
    """
    folder = Path(folder)

    def run(step: str) -> Run:  # raises OtherSettings
        document = {**dataclasses.asdict(settings), **about, "part": step}
        return Run(folder / step, document, usual=settings.recorded({}))

    def begin(camera: Camera[Variables], settings: CodesignSettings, run: Run) -> None:
        """The lens at the start of a training: at the optimum of the closed form, and fixed there, for lm."""
        is_second_order = settings.optimizer == "lm"
        if (is_second_order or settings.start in ("spectral", GAUSSIAN)) and not run.checkpoint.exists():
            course = to_closed_form(camera, settings, spectrum_of(train_pictures, settings))
            if course.no_optimum:
                warnings.warn(f"start {settings.start}: {course.no_optimum}", NoOptimum, stacklevel=2)
        camera.variables.requires_grad_(not is_second_order)

    current = run(STEPS[0])
    if (folder / "outcome.json").exists():
        return
    trained = initial_camera(lens, settings, catalogs=catalogs).to(device)
    trained.plan()  # before a checkpoint moves the lens, so that a resumed run has the same PSFs
    begin(trained, settings, current)
    for step, record in optimise(trained, train_pictures, settings, current):
        yield STEPS[0], step, record
    steps_done, again = settings.epochs * steps_per_epoch(train_pictures, settings), settings
    if settings.relearn:
        trained, again = with_catalog_glasses(trained, settings)
        trained.to(device)
        current = run("glasses")
        begin(trained, again, current)
        for step, record in optimise(trained, train_pictures, again, current):
            yield STEPS[0], steps_done + step, record
        steps_done += again.epochs * steps_per_epoch(train_pictures, settings)
    again = dataclasses.replace(again, epochs=settings.epochs)
    for turn in range(1, settings.turns + 1):
        for step, record in take_turn(trained, train_pictures, again, run(f"lens_{turn}"), turn):
            yield STEPS[0], steps_done + step, record
        steps_done += LENS_STEPS
        for step, record in optimise(trained, train_pictures, again, run(f"network_{turn}"), turn=turn):
            yield STEPS[0], steps_done + step, record
        steps_done += settings.epochs * steps_per_epoch(train_pictures, settings)
    l1_joint = held_out_error(trained, test_pictures, settings, progress=progress)
    freeze_lens(trained, settings)
    l1_before = held_out_error(trained, test_pictures, settings, progress=progress)
    for step, record in optimise(trained, train_pictures, settings, run(STEPS[1])):
        yield STEPS[1], step, record
    tested = functools.partial(held_out_error, trained, test_pictures, settings, progress=progress)
    optimised, l1_as_built, psnr_as_built = trained.variables(), torch.empty(0), torch.empty(0)
    if trained.tolerances is not None:
        l1_as_built, psnr_as_built = errors_as_built(trained, test_pictures, settings, progress=progress)
    l1_by_place, wiener_by_place = {}, {}
    if settings.sensor:
        filters = field_filters(trained, spectrum_of(train_pictures, settings), TEST_POSITIONS)
        for place, filter in zip(TEST_POSITIONS, filters, strict=True):
            l1_by_place[f"{place:g}"] = tested(place=place)
            wiener_by_place[f"{place:g}"] = tested(place=place, filters=filter)
    result = Outcome(
        model=settings.model,
        seed=settings.seed,
        l1_joint=l1_joint,
        l1_before=l1_before,
        l1_drt=tested(),
        **focus_columns(optimised),
        variables=trained.variables.numbers(),
        penalty=float(trained.variables.violation().detach()),
        no_optimum=out_of_focus(trained),
        l1_as_built=_by_number(l1_as_built),
        psnr_as_built=_by_number(psnr_as_built),
        l1_by_place=l1_by_place,
        wiener_by_place=wiener_by_place,
        by_distance={f"{distance:g}": tested(distance=distance) for distance in distances},
    )
    write_lens(optimised, folder / LENS, catalogs=catalogs)
    write_outcome(result, folder)


def _by_number(figures: Tensor) -> dict[str, float]:
    """Figures (C,) of perturbed cameras by their number, from 1."""
    return {str(number): figure for number, figure in enumerate(figures.tolist(), 1)}


def write_outcome(result: Outcome, folder: Path) -> None:
    """Write `outcome.json`; a focus at infinity is null there."""
    write_json(folder / "outcome.json", plain(result.document()))


def outcome(folder: Path) -> Outcome | None:
    """The outcome of a finished run; None if it is unfinished."""
    path = Path(folder) / "outcome.json"
    if not path.exists():
        return None
    check = fields_of(Outcome, nullable=_INFINITE)
    document = read_document(path, check, DamagedRun, "remove it to compute it again")
    return Outcome(**document | {key: math.inf for key in _INFINITE if document.get(key, 0.0) is None})


# -- the closed form


@dataclasses.dataclass(frozen=True)
class Optimum:
    """The optimum of the closed form with one model; columns of `spectral.csv` are the fields up to `downhill_mm`.

    error: mean square error of a pixel with the model's own PSFs; error_drt: of the same lens with DRT PSFs and the
    filter that is best for them; penalty: mm², violation of the limits, not part of the errors; focus: as for
    `Outcome`; no_optimum: the reason why this lens is no optimum, "" if it is one; downhill_mm: sensor distance of the
    minimum reached by descent from the start, which differs from `sensor_mm` if that minimum is only local
    (`least_of_closed_form`). course, penalties: error and penalty at every evaluation; at_end: variables at a bound
    beyond which the error still falls.
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
    variables: dict[str, float] = dataclasses.field(default_factory=dict)
    course: tuple[float, ...] = ()
    penalties: tuple[float, ...] = ()
    at_end: tuple[str, ...] = ()
    lens: Lens = dataclasses.field(kw_only=True)

    def document(self) -> dict:
        """The fields without the lens."""
        return {name: value for name, value in vars(self).items() if name != "lens"}


OPTIMUM_COLUMNS = tuple(field.name for field in dataclasses.fields(Optimum))[:9]


#: Optimizer of the closed form by that of the lens.
_DESCENTS: dict[str, Literal["lbfgs", "lm"]] = {"lm": "lm", "adam": "lbfgs"}


def to_closed_form(trained: Camera[Variables], settings: CodesignSettings, spectrum: Tensor) -> Course:
    """Move the lens of a camera to an optimum of the closed form: by steps of second order for the optimizer "lm", else
    to the optimum named by `start`: of the PSF model of the experiment, or of the Gaussian model."""
    model = "gaussian" if settings.start == GAUSSIAN else settings.model
    alike = dataclasses.replace(settings, model=model)
    first = initial_camera(trained.variables.lens, alike, catalogs=trained.variables.catalog)
    distances = even_distances(first, spread=settings.spread)
    course, _ = least_of_closed_form(
        first, spectrum, distances=distances, optimizer=_DESCENTS[settings.optimizer],
        filter_each_field=settings.filter_each_field,
    )  # fmt: skip
    trained.variables.load_state_dict(first.variables.state_dict())
    return course


def closed_form(
    lens: Lens, settings: CodesignSettings, spectrum: Tensor, *, catalogs: Sequence[str | PathLike] = ()
) -> Optimum:
    """The optimum of the model of the settings.

    spectrum: `patch_spectrum` of the pictures; catalogs: as of `variables`.
    """
    optimised = initial_camera(lens, settings, catalogs=catalogs)
    if settings.start == GAUSSIAN:
        to_closed_form(optimised, settings, spectrum)
    distances, each = even_distances(optimised, spread=settings.spread), settings.filter_each_field
    course, downhill = least_of_closed_form(
        optimised, spectrum, distances=distances, optimizer=_DESCENTS[settings.optimizer], filter_each_field=each
    )
    with torch.no_grad():
        lens = optimised.variables()
        error = camera_error(optimised, spectrum, distances, filter_each_field=each)
        freeze_lens(optimised, settings)
        error_drt = camera_error(optimised, spectrum, distances, filter_each_field=each)
    return Optimum(
        model=settings.model,
        **focus_columns(lens),
        downhill_mm=downhill,
        error=float(error),
        error_drt=float(error_drt),
        variables=optimised.variables.numbers(),
        course=course.errors,
        penalty=float(optimised.variables.violation().detach()),
        penalties=course.penalties,
        at_end=course.at_end,
        no_optimum=course.no_optimum,
        lens=lens,
    )
