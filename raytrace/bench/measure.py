"""Shared by the benchmarks: tracers, calls timed in turns, and errors against the reference.

A speed is rays × surfaces / s. Surfaces are those of the file without the object; stop and image count.
"""

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from raytrace.maths.numerics import to
from raytrace.maths.sampling import sobol
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.trace import trace_lens, trace_surfaces

DTYPES = (torch.float32, torch.float64)
SAMPLE = 24  # rays whose errors are computed
SHORTEST = 0.02  # s: shorter calls are timed many at a time
_MOST_CALLS = 200

Job = Callable[[], object]
K = TypeVar("K")


def nothing(*_: object) -> None:
    """No progress."""


def name_of(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


class Tracer:
    """This package's trace of one lens.

    name, dtype; with_path: whether it computes the optical path; has_gradient: whether it has derivatives; device: of
    the lens and its rays. A tracer of another program redefines `forward` and `gradient`.
    """

    has_gradient = True

    device = "cpu"

    def __init__(self, lens: Lens, dtype: torch.dtype, *, with_path: bool = False, device: str = "cpu"):
        self.name = "raytrace" if device == "cpu" else f"raytrace, {device}"
        self.dtype, self.with_path, self.device = dtype, with_path, device
        self.lens = to(lens, dtype=dtype, device=device)
        moving, self.leaves = with_leaves(self.lens, variables(self.lens))
        self.surfaces = moving.surfaces[1:]
        self.indices = media(self.lens, self.lens.primary)

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        """Positions (2, P) on the image and optical path (P,) or None, without gradient."""
        with torch.no_grad():
            end = trace_lens(self.lens, self._with_path(rays), self.lens.primary)
        return end.position[:2], end.opl

    def gradient(self, rays: Rays, centroid: Tensor) -> Sequence[Tensor]:
        """Derivatives of the mean squared distance from `centroid` (2,) with respect to `variables`."""
        end = trace_surfaces(self.surfaces, self._with_path(rays), indices=self.indices, wavelength=self.lens.primary)
        x, y, _ = end.position
        return torch.autograd.grad(squared_radius(x, y, centroid), self.leaves)

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


# -- rays --------------------------------------------------------------------------------------------------------------


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


# -- time --------------------------------------------------------------------------------------------------------------


def clock(threads: int) -> Callable[[], float]:
    """Processor time for one thread, which other load of the machine lengthens little; else the time of day."""
    return time.process_time if threads == 1 and not torch.cuda.is_initialized() else time.perf_counter


def seconds_of(job: Job, calls: int, threads: int) -> float:
    """Mean seconds of several calls."""
    with torch_threads(threads):
        now = clock(threads)
        wait_for_devices()
        start = now()
        for _ in range(calls):
            job()
        wait_for_devices()
        return (now() - start) / calls


def wait_for_devices() -> None:
    """Until the GPU, if one is used, has finished."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def in_turns(
    jobs: Mapping[K, Job], *, repeats: int, threads: int, progress: Callable[[int], object] = nothing
) -> dict[K, list[float]]:
    """Seconds of each job. Jobs take turns, so that other load affects all alike; short calls are repeated."""
    calls = {}
    for name, job in jobs.items():
        seconds_of(job, 1, threads)  # warm up
        calls[name] = max(1, min(_MOST_CALLS, math.ceil(SHORTEST / max(seconds_of(job, 1, threads), 1e-6))))
    seconds: dict[K, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            seconds[name].append(seconds_of(job, calls[name], threads))
            progress(1)
    return seconds


@dataclasses.dataclass(frozen=True)
class Row:
    """A measurement of a tracer.

    what: the task; path: whether it computes the optical path; piece: rays at a time; seconds: median; speed: rays ×
    surfaces / s. Errors, the largest of a sample of rays: position, nm on the image; path_error, wavelengths, relative
    to the first ray; gradient, of the mean squared spot radius with respect to curvatures and to thicknesses,
    |g - g_ref|/|g_ref| of the largest component, the larger of both.
    """

    tracer: str
    dtype: str
    what: str
    path: bool
    rays: int
    piece: int
    seconds: float
    speed: float
    position: float | None = None
    path_error: float | None = None
    gradient: float | None = None


def measured_rows(
    tasks: Sequence[tuple[Tracer, str, Mapping[str, Any]]], lens: Lens, count: int, *, sizes: Sequence[int],
    graphs: Callable[[Tracer], int | None], repeats: int, threads: int, progress: Callable[[int], object] = nothing,
) -> list[Row]:  # fmt: skip
    """A row of each task: a tracer, its work, and its errors as in `Row`.

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
            return lambda: call(batch)
        cuts = [slice(first, first + size) for first in range(0, count, size)]
        parts = [Rays(batch.position[:, cut], batch.direction[:, cut], batch.valid[cut]) for cut in cuts]
        return lambda: [call(part) for part in parts]

    jobs, pieces = {}, []
    for k, (tracer, work, _) in enumerate(tasks):
        whole = min(count, (work != "forward" and graphs(tracer)) or count)
        choices = {size: job(tracer, work, size) for size in {*(min(size, whole) for size in sizes), whole}}
        piece = whole
        if len(choices) > 1:
            for choice in choices.values():
                seconds_of(choice, 1, threads)  # warm up
            trials = {size: min(seconds_of(choice, 1, threads) for _ in range(2)) for size, choice in choices.items()}
            piece = min(trials, key=trials.__getitem__)
        jobs[k] = choices[piece]
        pieces.append(piece)
    turns = in_turns(jobs, repeats=repeats, threads=threads, progress=progress)
    rows = []
    for (tracer, work, errors), piece, seconds in zip(tasks, pieces, turns.values(), strict=True):
        median = statistics.median(seconds)
        task = (tracer.name, name_of(tracer.dtype), work, tracer.with_path, count, piece)
        speed = count * surfaces_of(lens) / max(median, 1e-9)
        rows.append(Row(*task, median, speed, **errors))
    return rows
