"""Shared by the benchmarks: tracers, calls timed in turns, and errors against the reference.

A speed is rays × surfaces / s. Surfaces are all of the file but the object: stop and image count.
"""

import abc
import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from raytrace.bench.reference import ReferenceSurface, spot_gradient, trace_reference
from raytrace.maths.numerics import to
from raytrace.maths.sampling import sobol
from raytrace.pages import digits, significant, yes
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface, is_even
from raytrace.tracing.compiled import engine as current_engine
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.trace import trace_lens, trace_surfaces

DTYPES = (torch.float32, torch.float64)
SAMPLE = 24  # rays of the check against the reference
SHORTEST = 0.02  # s: shorter calls are timed many at a time
_MOST_CALLS = 200

#: A call that is timed, and its preparation, which is not.
Job = tuple[Callable[[], object], Callable[[], object]]


def nothing(*_) -> None:
    """No preparation; no progress."""


def name_of(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


class Tracer(abc.ABC):
    """A tracer of one lens: its name and dtype; with_path: whether it computes the optical path.

    most: rays it traces in bearable time, None for any number.
    """

    name: str
    dtype: torch.dtype
    with_path: bool = True
    has_gradient: bool = True
    most: int | None = None
    device: str = "cpu"

    prepare = nothing  # called before every timed call

    @abc.abstractmethod
    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        """Positions (2, P) on the image and optical path (P,) or None, without gradient."""

    def gradient(self, rays: Rays, centroid: Tensor) -> Sequence[Tensor]:
        """Derivatives of the mean squared distance from `centroid` (2,) with respect to `variables`, then indices.

        None without `has_gradient`.
        """
        return ()


class Own(Tracer):
    """This package's trace. engine: "auto" (the program's choice), "eager", or None for the current engine;
    by_indices: gradients also with respect to the index of every medium; device: of the lens and its rays.
    """

    def __init__(
        self, lens: Lens, dtype: torch.dtype, *, engine: str | None = None, with_path=False, by_indices=False,
        device: str = "cpu",
    ):  # fmt: skip
        self.dtype, self.with_path, self.engine, self.device = dtype, with_path, engine or current_engine(), device
        parts = ["raytrace", "" if engine in (None, "auto") else engine, "" if device == "cpu" else device]
        self.name = ", ".join(part for part in parts if part)
        self.lens = to(lens, dtype=dtype, device=device)
        self.wavelength = self.lens.primary
        self.surfaces, self.indices, self.leaves = leaves_of(self.lens, by_indices=by_indices)

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        with torch.no_grad(), trace_engine(self.engine):
            end = trace_lens(self.lens, self._with_path(rays), self.wavelength)
        return end.position[:2], end.opl

    def gradient(self, rays: Rays, centroid: Tensor) -> tuple[Tensor, ...]:
        with trace_engine(self.engine):
            how = {"indices": self.indices, "wavelength": self.wavelength}
            end = trace_surfaces(self.surfaces, self._with_path(rays), **how)
            return torch.autograd.grad(squared_radius(*end.position[:2], centroid), self.leaves)

    def _with_path(self, rays: Rays) -> Rays:
        return dataclasses.replace(rays, opl=torch.zeros_like(rays.direction[0]) if self.with_path else None)


def squared_radius(x: Tensor, y: Tensor, centroid: Tensor) -> Tensor:
    """Mean squared distance from a fixed point.

    At the centroid its gradient is that of the mean squared spot radius: distances from the centroid sum to zero.
    """
    return ((x - centroid[0]) ** 2 + (y - centroid[1]) ** 2).mean()


def variables(lens: Lens) -> list[tuple[int, str]]:
    """Variables of gradients: every modelled curvature and every thickness, as (surface number, name)."""
    last = len(lens.surfaces) - 1
    curved = [(i, "curvature") for i in range(1, last + 1) if lens.surfaces[i].curvature is not None]
    return curved + [(i, "thickness") for i in range(1, last)]


def with_leaves(lens: Lens, chosen: Sequence[tuple[int, str]]) -> tuple[Lens, list[Tensor]]:
    """The lens with a leaf for each of the chosen numbers of surfaces, and the leaves."""
    leaves = []
    for number, name in chosen:
        leaves.append(getattr(lens.surfaces[number], name).detach().clone().requires_grad_())
        lens = lens.replace(number, **{name: leaves[-1]})
    return lens, leaves


def leaves_of(lens: Lens, *, by_indices: bool = True) -> tuple[tuple[Surface, ...], list[Tensor], list[Tensor]]:
    """Surfaces after the object with the leaves of `variables`, the indices of all media, and the leaves.

    by_indices: the indices are leaves, too; neighbouring gaps of one medium share one.
    """
    moving, leaves = with_leaves(lens, variables(lens))
    fixed = media(lens, lens.primary)
    indices = list(fixed)
    for number, index in enumerate(fixed if by_indices else ()):
        if number > 0 and index is fixed[number - 1]:
            indices[number] = indices[number - 1]
        else:
            indices[number] = index.detach().clone().requires_grad_()
            leaves.append(indices[number])
    return moving.surfaces[1:], indices, leaves


# -- rays and errors ---------------------------------------------------------------------------------------------------


def field_rays(lens: Lens, count: int) -> Rays:
    """`count` rays (Sobol points of the pupil) of the lens's middle field at its primary wavelength, float64."""
    field = torch.stack([lens.fields.x, lens.fields.y])[:, len(lens.fields.x) // 2, None]
    with torch.no_grad():
        rays = rays_of_field(lens, field, sobol(count)[0], wavelength=lens.primary, ray_aiming="off")
    return dataclasses.replace(rays, opl=None)


def some(rays: Rays, change: Callable[[Tensor], Tensor]) -> Rays:
    """Rays without path whose every tensor (…, P) is changed."""
    return Rays(*(change(x) for x in (rays.position, rays.direction, rays.valid)))


def surfaces_of(lens: Lens) -> int:
    """Number of surfaces but the object."""
    return len(lens.surfaces) - 1


@dataclasses.dataclass(frozen=True)
class Errors:
    """Errors against the reference, the largest of the sample; both trace the same numbers of the dtype.

    position: nm on the image; path: wavelengths, relative to the first ray; gradient: of the mean squared spot radius
    with respect to curvatures and to thicknesses, |g - g_ref|/|g_ref| of the largest component, the larger of both.
    """

    position: float | None = None
    path: float | None = None
    gradient: float | None = None


def shape_of(surface: Surface, number: int) -> tuple[float, float, list[float]]:
    """Curvature, conic and coefficients of r², r⁴, …. Raises ValueError for other shapes."""
    if not is_even(surface):
        raise ValueError(f"surface {number} is no conic with even terms: peers and references cannot trace it")
    c, k = (0.0 if value is None else float(value) for value in (surface.curvature, surface.conic))
    return c, k, [] if surface.coefficients is None else surface.coefficients.tolist()


def reference_of(lens: Lens) -> tuple[list[ReferenceSurface], float]:
    """The surfaces behind the object and the first index, for `trace_reference`."""
    indices = [float(index) for index in media(lens, lens.primary)]
    surfaces = [
        ReferenceSurface(*shape_of(surface, number), float(surface.thickness), index, surface.is_mirror)
        for number, (surface, index) in enumerate(zip(lens.surfaces[1:], indices[1:], strict=True), 1)
    ]
    return surfaces, indices[0]


def errors_of(tracer: Tracer, lens: Lens, rays: Rays, *, copies: int = 1, gradient: bool = True) -> Errors:
    """Errors of a tracer on a few rays (3, P), both with the numbers as rounded to the dtype.

    copies: of the rays in the batch, so that the engine of large batches traces it; gradient: whether to compare that,
    too.
    """
    lens, rays = to(lens, dtype=tracer.dtype), to(rays, dtype=tracer.dtype)
    surfaces, index = reference_of(lens)
    starts = list(zip(rays.position.T.tolist(), rays.direction.T.tolist(), strict=True))
    exact, count = [trace_reference(surfaces, index, *start) for start in starts], len(starts)
    batch = to(some(rays, lambda x: x.repeat(*(1,) * (x.dim() - 1), copies)), device=tracer.device)
    tracer.prepare()
    points, path = tracer.forward(batch)
    points = points[:, :count]
    position = 1e6 * max(_worst(points[axis].tolist(), [ray.position[axis] for ray in exact]) for axis in (0, 1))
    path_error = gradient_error = None
    if path is not None:
        relative = (path[:count].double() - path[0].double()).tolist()
        path_error = 1e3 / float(lens.primary) * _worst(relative, [ray.path - exact[0].path for ray in exact])
    if gradient and tracer.has_gradient:
        names = variables(lens)
        expected = spot_gradient(surfaces, index, starts, [(number - 1, name) for number, name in names])
        slopes = [float(slope) for slope in tracer.gradient(batch, points.mean(1))]
        gradient_error = 0.0
        for kind in {name for _, name in names}:
            pairs = [(a, b) for a, b, (_, name) in zip(slopes, expected, names, strict=False) if name == kind]
            error = _worst(*zip(*pairs, strict=True)) / float(max(abs(b) for _, b in pairs))
            gradient_error = max(gradient_error, error)
    return Errors(position, path_error, gradient_error)


def _worst(values: Sequence[float], expected: Sequence) -> float:
    return max(float(abs(a - b)) for a, b in zip(values, expected, strict=True))


# -- time --------------------------------------------------------------------------------------------------------------


def clock(threads: int) -> Callable[[], float]:
    """Processor time for one thread, which other load of the machine lengthens little; else the time of day."""
    return time.process_time if threads == 1 and not torch.cuda.is_initialized() else time.perf_counter


def seconds_of(job: Job, calls: int, threads: int) -> float:
    """Mean seconds of several calls."""
    call, prepare = job
    with torch_threads(threads):
        prepare()
        now = clock(threads)
        wait_for_devices()
        start = now()
        for _ in range(calls):
            call()
        wait_for_devices()
        return (now() - start) / calls


def wait_for_devices() -> None:
    """Until the GPU, if one is used, has finished."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def in_turns(
    jobs: Mapping[object, Job], *, repeats: int, threads: int, progress: Callable[[int], object] = nothing
) -> dict[object, list[float]]:
    """Seconds of each job. Jobs take turns, so that other load affects all alike; short calls are timed many at a time.

    progress: called with 1 for each, `repeats` times the jobs.
    """
    calls = {}
    for name, job in jobs.items():
        seconds_of(job, 1, threads)  # warm up
        calls[name] = max(1, min(_MOST_CALLS, math.ceil(SHORTEST / max(seconds_of(job, 1, threads), 1e-6))))
    seconds: dict[object, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            seconds[name].append(seconds_of(job, calls[name], threads))
            progress(1)
    return seconds


@dataclasses.dataclass(frozen=True)
class Row:
    """A measurement of a tracer.

    what: the task; path: whether it computes the optical path; piece: rays at a time; seconds: median; speed: rays ×
    surfaces / s; position, path_error, gradient: see `Errors`; ratio: speed relative to Optiland's torch back end.
    """

    tracer: str
    dtype: str
    what: str
    path: bool
    rays: int
    piece: int
    seconds: float
    fastest: float
    speed: float
    position: float | None = None
    path_error: float | None = None
    gradient: float | None = None
    ratio: float | None = None


def measured_rows(
    tasks: Sequence[tuple[Tracer, str, Errors]], lens: Lens, count: int, *, sizes: Sequence[int],
    graphs: Callable[[Tracer], int | None], repeats: int, threads: int, progress: Callable[[int], object] = nothing,
) -> list[Row]:  # fmt: skip
    """A row of each task: a tracer, its work, which starts with "forward" where it has no gradient, and its errors.

    sizes: numbers of rays at a time, of which the fastest is chosen, or all at once; graphs: largest number of rays of
    a graph of a tracer, None for any. Tasks are timed in turns.
    """
    rays = field_rays(lens, count)
    kinds = {(tracer.dtype, tracer.device) for tracer, *_ in tasks}
    of_kind = {(dtype, device): to(rays, dtype=dtype, device=device) for dtype, device in kinds}

    def job(tracer: Tracer, work: str, size: int) -> Job:
        batch = of_kind[tracer.dtype, tracer.device]
        centroid = torch.zeros(2, dtype=tracer.dtype, device=tracer.device)
        call = tracer.forward if work == "forward" else lambda part: tracer.gradient(part, centroid)
        if size >= count:
            return lambda: call(batch), tracer.prepare
        parts = [some(batch, lambda x, first=first: x[..., first : first + size]) for first in range(0, count, size)]
        return lambda: [call(part) for part in parts], tracer.prepare

    jobs, pieces = {}, []
    for k, (tracer, work, _) in enumerate(tasks):
        whole = min(count, (work != "forward" and graphs(tracer)) or count)
        choices = {size: job(tracer, work, size) for size in {*(min(size, whole) for size in sizes), whole}}
        piece = whole
        if len(choices) > 1:
            for choice in choices.values():
                seconds_of(choice, 1, threads)  # warm up
            trials = {size: min(seconds_of(choice, 1, threads) for _ in range(2)) for size, choice in choices.items()}
            piece = min(trials, key=trials.get)
        jobs[k] = choices[piece]
        pieces.append(piece)
    turns = in_turns(jobs, repeats=repeats, threads=threads, progress=progress)
    rows = []
    for (tracer, work, errors), piece, seconds in zip(tasks, pieces, turns.values(), strict=True):
        median = statistics.median(seconds)
        task = (tracer.name, name_of(tracer.dtype), work, tracer.with_path, count, piece)
        speed = count * surfaces_of(lens) / max(median, 1e-9)
        rows.append(Row(*task, median, min(seconds), speed, *dataclasses.astuple(errors)))
    return rows


#: Columns of the tables of rows.
COLUMNS = {
    "rays": lambda row: f"{row.rays:,}",
    "what": lambda row: row.what,
    "dtype": lambda row: row.dtype,
    "tracer": lambda row: row.tracer,
    "path": lambda row: yes(row.path),
    "at a time": lambda row: f"{row.piece:,}",
    "M/s": lambda row: significant(row.speed / 1e6),
    "× Optiland": lambda row: digits(row.ratio, ".2f"),
    "position error, nm": lambda row: digits(row.position, ".2g"),
    "path error, waves": lambda row: digits(row.path_error, ".2g"),
    "gradient error": lambda row: digits(row.gradient, ".2g") if row.what != "forward" else "",
}
