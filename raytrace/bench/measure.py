"""Measure tracers side by side: time of the same call on the same rays, and the error of what it returns.

A speed is rays × surfaces / s. Surfaces are those a ray is carried to: all of the file but the object, the stop and the
image among them.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.bench.reference import ReferenceSurface, reference_surface, spot_gradient, trace_reference
from raytrace.bench.tracers import Own, Tracer, in_pieces, variables
from raytrace.maths.pupil import sobol
from raytrace.maths.value import to
from raytrace.optics.launch import rays_of_field
from raytrace.optics.trace import media
from raytrace.system.lens import Lens
from raytrace.system.rays import Rays
from raytrace.system.surface import is_even

SAMPLE = 24  # rays of the check against the reference
_PIECES = (2**15, 2**16)  # numbers of rays traced at a time that are tried, beside all at once
_TRIAL = 400_000  # at most so many rays in a trial
_LARGEST_GRAPH = 200_000  # rays whose graph is held at once


@dataclasses.dataclass(frozen=True)
class Errors:
    """What a tracer misses the reference by, largest of the sample. Both are given the same numbers of their dtype.

    position: nm on the image; path: wavelengths, relative to the first ray; gradient: of the mean squared spot radius
    by curvatures and by thicknesses, |g - g_ref|/|g_ref| in the largest component, the larger of the two.
    """

    position: float
    path: float | None
    gradient: float | None


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure: what was traced, how fast, how well. seconds: median; ratio: speed over that of the peer."""

    tracer: str
    dtype: str
    what: str
    path: bool
    rays: int
    piece: int
    seconds: float
    fastest: float
    speed: float
    errors: Errors
    ratio: float | None = None


@dataclasses.dataclass(frozen=True)
class Job:
    """One call to be timed over and over."""

    tracer: Tracer
    what: str
    rays: Rays
    piece: int
    centroid: Tensor

    def run(self) -> None:
        if self.what == "forward":
            in_pieces(self.rays, self.piece, self.tracer.forward)
        else:
            in_pieces(self.rays, self.piece, lambda rays: self.tracer.gradient(rays, self.centroid))


def field_rays(lens: Lens, count: int) -> Rays:
    """`count` rays (Sobol points of the pupil) of the lens's middle field at its primary wavelength, float64."""
    field = torch.stack([lens.fields.x, lens.fields.y])[:, len(lens.fields.x) // 2, None]
    wavelength = lens.wavelengths[lens.primary_wavelength]
    points, _ = sobol(count)
    with torch.no_grad():
        rays = rays_of_field(lens, field, points, wavelength=wavelength, ray_aiming="off")
    return dataclasses.replace(rays, opl=None)


def surfaces_of(lens: Lens) -> int:
    """Number of surfaces that a ray is carried to."""
    return len(lens.surfaces) - 1


def reference_of(lens: Lens) -> tuple[list[ReferenceSurface], float]:
    """The lens in front of surface 1 and behind, for `trace_reference`: its surfaces and the first index."""
    if not all(map(is_even, lens.surfaces)):
        raise ValueError("the reference traces conics and even aspheres: this lens has others")
    indices = [float(index) for index in media(lens, lens.wavelengths[lens.primary_wavelength])]
    surfaces = [
        reference_surface(
            *(0.0 if shape is None else float(shape) for shape in (surface.curvature, surface.conic)),
            () if surface.coefficients is None else surface.coefficients.tolist(),
            float(surface.thickness),
            index,
            surface.is_mirror,
        )
        for surface, index in zip(lens.surfaces[1:], indices[1:], strict=True)
    ]
    return surfaces, indices[0]


def errors_of(tracer: Tracer, lens: Lens, rays: Rays) -> Errors:
    """Compare a tracer with the reference on a few rays (3, P); both get the numbers as rounded to the dtype."""
    lens, rays = to(lens, dtype=tracer.dtype), to(rays, dtype=tracer.dtype)
    surfaces, index = reference_of(lens)
    starts = list(zip(rays.position.T.tolist(), rays.direction.T.tolist(), strict=True))
    exact = [trace_reference(surfaces, index, *start) for start in starts]
    tracer.prepare()
    (x, y), path = tracer.forward(rays)
    position = max(
        _worst(x.tolist(), [ray.position[0] for ray in exact]), _worst(y.tolist(), [ray.position[1] for ray in exact])
    )
    waves = None
    if path is not None:
        found = path.double() - path[0].double()
        wavelength = float(lens.wavelengths[lens.primary_wavelength])
        waves = _worst(found.tolist(), [ray.path - exact[0].path for ray in exact]) * 1e3 / wavelength
    gradient = None
    if tracer.has_gradient:
        names = variables(lens)
        expected = spot_gradient(surfaces, index, starts, [(number - 1, name) for number, name in names])
        found = tracer.gradient(rays, torch.stack([x.mean(), y.mean()])).tolist()
        gradient = 0.0
        for kind in ("curvature", "thickness"):
            pairs = [(g, e) for g, e, (_, name) in zip(found, expected, names, strict=True) if name == kind]
            if pairs:
                gradient = max(gradient, _worst(*zip(*pairs, strict=True)) / float(max(abs(e) for _, e in pairs)))
    return Errors(position * 1e6, waves, gradient)


def _worst(found: Sequence[float], expected: Sequence) -> float:
    return max(float(abs(a - b)) for a, b in zip(found, expected, strict=True))


def clock(threads: int) -> Callable[[], float]:
    """Processor time where one thread works, which neighbours on the machine lengthen little; else the time of day."""
    return time.process_time if threads == 1 else time.perf_counter


def measure(
    lens: Lens,
    counts: Sequence[int],
    *,
    repeats: int,
    peers: Sequence[Tracer] = (),
    threads: int,
    progress: Callable[[int], object] = lambda done: None,
) -> list[Row]:
    """Time every tracer on every number of rays, interleaved so that a busy machine meets all alike.

    threads: of torch; progress: called with the number of calls done since the last time, of `calls(…)` in all.
    """
    dtypes = (torch.float32, torch.float64)
    tracers = [*(Own(lens, dtype, with_path=path) for dtype in dtypes for path in (True, False)), *peers]
    torch.set_num_threads(threads)
    errors = {id(tracer): errors_of(tracer, lens, field_rays(lens, SAMPLE)) for tracer in tracers}
    rows = []
    for count in sorted(counts):
        jobs = _jobs(lens, tracers, count)
        seconds: list[list[float]] = [[] for _ in jobs]
        jobs = [dataclasses.replace(job, piece=_best_piece(job, threads)) for job in jobs]
        for _ in range(repeats):
            for job, taken in zip(jobs, seconds, strict=True):
                taken.append(_time(job, threads))
                progress(1)
        rows += [_row(job, lens, taken, errors[id(job.tracer)]) for job, taken in zip(jobs, seconds, strict=True)]
    return [dataclasses.replace(row, ratio=_ratio(row, rows)) for row in rows]


def calls(counts: Sequence[int], *, repeats: int, peers: Sequence[Tracer] = ()) -> int:
    """How many timed calls `measure` makes."""
    return len(counts) * repeats * (8 + sum(1 + peer.has_gradient for peer in peers))


def _jobs(lens: Lens, tracers: Sequence[Tracer], count: int) -> list[Job]:
    by_dtype = {dtype: to(field_rays(lens, count), dtype=dtype) for dtype in (torch.float32, torch.float64)}
    jobs = []
    for tracer in tracers:
        rays = by_dtype[tracer.dtype]
        centroid = torch.zeros(2, dtype=tracer.dtype)
        jobs.append(Job(tracer, "forward", rays, count, centroid))
        if tracer.has_gradient:
            jobs.append(Job(tracer, "forward+backward", rays, count, centroid))
    return jobs


def _time(job: Job, threads: int) -> float:
    now = clock(threads)
    torch.set_num_threads(threads)
    job.tracer.prepare()
    began = now()
    job.run()
    return now() - began


def _best_piece(job: Job, threads: int) -> int:
    """How many rays at a time suit this tracer best: each is given its own best, tried before it is measured."""
    count = job.rays.direction.shape[1]
    whole = count if job.what == "forward" else min(count, _LARGEST_GRAPH)
    if count <= min(_PIECES):
        _time(job, threads)  # warm up
        return whole
    trial = dataclasses.replace(job, rays=_first(job.rays, min(count, _TRIAL)))
    sizes = [*(size for size in _PIECES if size < whole), whole]
    tried = {size: min(_time(dataclasses.replace(trial, piece=size), threads) for _ in range(2)) for size in sizes}
    return min(tried, key=tried.get)


def _first(rays: Rays, count: int) -> Rays:
    return Rays(*(x[..., :count] for x in (rays.position, rays.direction, rays.valid)))


def _row(job: Job, lens: Lens, seconds: list[float], errors: Errors) -> Row:
    count, median = job.rays.direction.shape[1], statistics.median(seconds)
    return Row(
        tracer=job.tracer.name,
        dtype=str(job.tracer.dtype).removeprefix("torch."),
        what=job.what,
        path=job.tracer.with_path,
        rays=count,
        piece=job.piece,
        seconds=median,
        fastest=min(seconds),
        speed=count * surfaces_of(lens) / max(median, 1e-9),
        errors=errors,
    )


def _ratio(row: Row, rows: Sequence[Row]) -> float | None:
    """Speed over that of Optiland's torch back end at the same task; None for Optiland itself or without it."""
    if row.tracer != Own.name:
        return None
    same = [
        other
        for other in rows
        if other.tracer.endswith("torch") and (other.dtype, other.what, other.rays) == (row.dtype, row.what, row.rays)
    ]
    return row.speed / same[0].speed if same else None
