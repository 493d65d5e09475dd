"""Accuracy of the PSFs of the co-design experiment: how few rays do, and how far the models are from each other.

Every entrant computes the kernels of a batch of object distances. Its error counts from the limit of its own model:
Gaussian DRT from many quadrature rays, DRT from the finest ray map. How far those limits lie from the DRT's own is the
error of the model, which decides what lens is chosen.
"""

import dataclasses
import functools
import statistics
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.autograd import forward_ad

from raytrace.bench.measure import clock
from raytrace.kernels import MODELS, fourier, paraxial, rays
from raytrace.kernels.pixels import gaussian_pixels
from raytrace.kernels.result import Kernels
from raytrace.maths import pupil
from raytrace.maths.grid import Grid, grid
from raytrace.maths.numerics import safe_divide
from raytrace.optics.scene import Scene, scene, trace_scene
from raytrace.system.lens import Lens, with_sensor_distance

FIELDS = (0.0, 9.8, 14.0)  # degrees: the axis, 0.7 and all of the double Gauss's field
SENSORS = (57.88, 57.66)  # mm: about the paraxial image of 25 m and the least RMS spot of it
NEAR, FAR = 1e4, 5e4  # mm
SAMPLES = 32  # object distances in a batch
PITCH, PIXELS = 0.005, 21
WAVELENGTH = 0.53
DRAWS = 8  # of random rays: their errors are means over so many
GAUSSIAN, DRT = "gaussian", "drt"
_FINEST = {GAUSSIAN: 12, DRT: 6}  # orders that stand for the limits
_PIECE = 4  # object distances at a time


@dataclasses.dataclass(frozen=True)
class Entrant:
    """A way to compute the kernels of a batch. run: (scene, grid, number of the draw) -> Kernels.

    model: "gaussian" or "drt", whose limit it should reach; has_gradient: in the sensor's place.
    """

    model: str
    sampling: str
    run: Callable[[Scene, Grid, int], Kernels]
    drawn: bool = False
    has_gradient: bool = True


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """What one entrant costs and how much it errs, means over a batch (and over draws).

    field: degrees; sensor: mm; rays: traced for a kernel; sigma_error: |σ/σ₀ - 1|, σ² the trace of the covariance;
    l1_error: Σ|k - k₀| of kernels that sum to 1 in the window; slope_error: Σ|k′ - k₀′|/Σ|k₀′| of their derivatives by
    the sensor's place, None without one; both_ms: of a batch, forward and backward; without derivative forward only.
    """

    field: float
    sensor: float
    model: str
    sampling: str
    rays: int
    sigma_error: float
    l1_error: float
    slope_error: float | None
    both_ms: float


@dataclasses.dataclass(frozen=True)
class ModelError:
    """How far the limit of a model is from DRT's at one object distance (mm): relative L1 of the kernels."""

    field: float
    sensor: float
    model: str
    distance: float
    l1_error: float


@dataclasses.dataclass(frozen=True)
class Place:
    """One field (degrees) and sensor distance (mm) of a lens at the wavelength of the experiment."""

    lens: Lens
    field: float
    sensor: float

    def scene(self, distances: Tensor, *, sensor: Tensor | None = None) -> Scene:
        """The scene of object distances (D,) mm; sensor: its place, where that is to be differentiated."""
        moved = with_sensor_distance(self.lens, distances.new_tensor(self.sensor) if sensor is None else sensor)
        field = distances.new_tensor([[0.0], [self.field]])
        return scene(moved, field, distances, distances.new_tensor([WAVELENGTH]))

    def window(self, batch: Scene) -> Grid:
        """Its pixels: around the traced chief rays, which do not move with the sensor here."""
        pixels = grid(self.lens.wavelengths.new_tensor(PITCH), PIXELS)
        if self.field == 0:
            return pixels
        with torch.no_grad():
            chief = trace_scene(batch, batch.fields.new_zeros(2, 1)).position[:2, ..., 0]
        return dataclasses.replace(pixels, centre=chief)


def entrants() -> list[Entrant]:
    """Few quadrature rays, the dozens of the paper; few rays of a map, and hundreds of plain ones."""
    found = [Entrant(GAUSSIAN, f"{order} rings", functools.partial(_order, GAUSSIAN, order)) for order in (2, 4, 6, 8)]
    found += [Entrant(GAUSSIAN, f"{n} random", functools.partial(_random_moments, n), drawn=True) for n in (24, 36, 48)]
    found += [
        Entrant(GAUSSIAN, f"{1 + 3 * n * (n + 1)} hexapolar", functools.partial(_plain_moments, n)) for n in (2, 3, 4)
    ]
    found += [Entrant(DRT, f"map, order {order}", functools.partial(_order, DRT, order)) for order in (0, 1, 2)]
    for count in (256, 512, 1024):
        found.append(Entrant(DRT, f"{count} splatted", functools.partial(_random_rays, count, 0.5), drawn=True))
    for count in (256, 512, 1024):
        run = functools.partial(_random_rays, count, 0.0)
        found.append(Entrant(DRT, f"{count} counted", run, drawn=True, has_gradient=False))
    return found


def measure(
    lens: Lens,
    *,
    fields: Sequence[float],
    sensors: Sequence[float],
    samples: int,
    chosen: Sequence[Entrant],
    repeats: int,
    draws: int = DRAWS,
    progress: Callable[[int], object] = lambda done: None,
) -> tuple[list[Accuracy], list[ModelError]]:
    """All entrants at all places, timed in turns with one thread. progress: of `steps(…)`."""
    before = torch.get_num_threads()
    rows, gaps = [], []
    torch.set_num_threads(1)
    try:
        for place in (Place(lens, field, sensor) for field in fields for sensor in sensors):
            truths = {model: found(place, _finest(model), distances_of(samples)) for model in (GAUSSIAN, DRT)}
            gaps += model_errors(place, samples, truths)
            progress(1)
            times = _times(place, chosen, samples, repeats, progress)
            for entrant, time in zip(chosen, times, strict=True):
                errors = errors_of(place, entrant, truths[entrant.model], draws if entrant.drawn else 1)
                rows.append(Accuracy(place.field, place.sensor, entrant.model, entrant.sampling, *errors, time))
                progress(1)
    finally:
        torch.set_num_threads(before)
    return rows, gaps


def steps(chosen: Sequence[Entrant], *, fields: int, sensors: int, repeats: int) -> int:
    """How often `measure` reports progress."""
    return fields * sensors * (1 + len(chosen) + repeats)


def distances_of(samples: int) -> Tensor:
    """Object distances (D,) mm of a batch: the middle of each of so many even parts of the range."""
    return NEAR + (FAR - NEAR) * (torch.arange(samples, dtype=torch.float64) + 0.5) / samples


@dataclasses.dataclass(frozen=True)
class Found:
    """Of a batch: kernel (D, rows, columns) that sums to 1, sigma (D,) mm, slope (D, rows, columns) 1/mm or None."""

    kernel: Tensor
    sigma: Tensor
    slope: Tensor | None
    rays: int


@torch.no_grad()
def found(place: Place, entrant: Entrant, distances: Tensor, draw: int = 0) -> Found:
    """What an entrant finds, a few distances at a time: the finest maps take gigabytes."""
    parts = [_found(place, entrant, part, draw) for part in distances.split(_PIECE)]
    slopes = [part.slope for part in parts]
    return Found(
        torch.cat([part.kernel for part in parts]),
        torch.cat([part.sigma for part in parts]),
        None if slopes[0] is None else torch.cat(slopes),
        parts[0].rays,
    )


def _found(place: Place, entrant: Entrant, distances: Tensor, draw: int) -> Found:
    window = place.window(place.scene(distances))
    with forward_ad.dual_level():
        sensor = forward_ad.make_dual(distances.new_tensor(place.sensor), distances.new_tensor(1.0))
        light = entrant.run(place.scene(distances, sensor=sensor), window, draw)
        kernel, slope = forward_ad.unpack_dual(_shares(light))
        covariance = forward_ad.unpack_dual(light.ray_moments[1]).primal
    sigma = torch.sqrt(covariance[0] + covariance[2])[:, 0, 0]
    return Found(kernel, sigma, slope if entrant.has_gradient else None, light.rays)


def errors_of(place: Place, entrant: Entrant, truth: Found, draws: int) -> tuple[int, float, float, float | None]:
    """Rays of a kernel, and the errors of σ, of the kernel and of its slope."""
    sigma, kernel, slope = [], [], []
    for draw in range(draws):
        own = found(place, entrant, distances_of(len(truth.kernel)), draw)
        sigma.append((own.sigma / truth.sigma - 1).abs().mean())
        kernel.append((own.kernel - truth.kernel).abs().sum((-2, -1)).mean())
        if own.slope is not None:
            slope.append(_relative_l1(own.slope, truth.slope).mean())
    mean = [float(torch.stack(values).mean()) if values else None for values in (sigma, kernel, slope)]
    return own.rays, *mean


@torch.no_grad()
def model_errors(place: Place, samples: int, truths: dict[str, Found]) -> list[ModelError]:
    """How far paraxial, Fourier and Gaussian kernels are from those of DRT, each around its own chief ray."""
    distances = distances_of(samples)
    # Ideal lenses know of a field only where its image lies: about their own chief ray it is the image on the axis.
    axis = Place(place.lens, 0.0, place.sensor)
    batch = axis.scene(distances)
    limits = {
        "paraxial": _shares(paraxial.kernels(batch, axis.window(batch))),
        "fourier": _shares(fourier.kernels(batch, axis.window(batch), order=MODELS["fourier"].orders[-3])),
        GAUSSIAN: truths[GAUSSIAN].kernel,
    }
    return [
        ModelError(place.field, place.sensor, model, float(distance), float(error))
        for model, kernels in limits.items()
        for distance, error in zip(distances, (kernels - truths[DRT].kernel).abs().sum((-2, -1)), strict=True)
    ]


def _times(
    place: Place, chosen: Sequence[Entrant], samples: int, repeats: int, progress: Callable[[int], object]
) -> list[float]:
    """Median ms of a batch by entrant; the entrants in turns, so that all meet one load."""
    taken: list[list[float]] = [[] for _ in chosen]
    for repeat in range(repeats + 1):
        for entrant, seconds in zip(chosen, taken, strict=True):
            seconds.append(_seconds(place, entrant, distances_of(samples)))
        if repeat:
            progress(1)
    return [1e3 * statistics.median(seconds[1:]) for seconds in taken]  # the first fills caches


def _seconds(place: Place, entrant: Entrant, distances: Tensor) -> float:
    """One batch, forward and backward to the sensor's place, all rays traced and the window found anew."""
    now = clock(1)
    sensor = distances.new_tensor(place.sensor).requires_grad_(entrant.has_gradient)
    began = now()
    batch = place.scene(distances, sensor=sensor)
    kernel = _shares(entrant.run(batch, place.window(batch), 0))
    if entrant.has_gradient:
        kernel.square().sum().backward()
    return now() - began


def _relative_l1(found: Tensor, truth: Tensor) -> Tensor:
    return (found - truth).abs().sum((-2, -1)) / truth.abs().sum((-2, -1))


def _shares(light: Kernels) -> Tensor:
    """Kernels (D, rows, columns) that sum to 1, of one field and wavelength."""
    kernel = light.kernel[:, 0, 0]
    return safe_divide(kernel, kernel.sum((-2, -1), keepdim=True))


def _finest(model: str) -> Entrant:
    return Entrant(model, "finest", functools.partial(_order, model, _FINEST[model]))


def _order(model: str, order: int, batch: Scene, window: Grid, draw: int) -> Kernels:
    ladder = MODELS[model]
    return (ladder.lean or ladder.kernels)(batch, window, order=order)


def _random_rays(count: int, width: float, batch: Scene, window: Grid, draw: int) -> Kernels:
    """Independent rays, blurred over `width` pixels either side, or counted."""
    return rays.kernels(batch, window, rays=count, sampling=functools.partial(pupil.random, seed=draw), width=width)


def _random_moments(count: int, batch: Scene, window: Grid, draw: int) -> Kernels:
    return _moments(batch, window, pupil.random(count, seed=draw)[0])


def _plain_moments(rings: int, batch: Scene, window: Grid, draw: int) -> Kernels:
    """The centre and rings of 6, 12, … rays that count alike."""
    return _moments(batch, window, pupil.hexapolar(rings)[0])


def _moments(batch: Scene, window: Grid, points: Tensor) -> Kernels:
    """A Gaussian with the plain mean and variances of the rays of pupil points (2, P), xy left out: light of fields in
    y is symmetric in x, so that it is 0 but for the draw."""
    traced = trace_scene(batch, points)
    count = traced.valid.sum(-1)
    hits = torch.where(traced.valid, traced.position[:2], 0.0)
    mean = safe_divide(hits.sum(-1), count.expand(hits.shape[:-1]))
    offset = torch.where(traced.valid, hits - mean[..., None], 0.0)
    x, y = safe_divide((offset * offset).sum(-1), count.expand(hits.shape[:-1]))
    kernel = gaussian_pixels(window, mean, torch.stack([x, y]))
    return Kernels(kernel, window, mean, torch.stack([x, torch.zeros_like(x), y]), points.shape[1])
