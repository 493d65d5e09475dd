"""Shared by the benchmarks: tracers, calls timed in turns, and errors against the reference.

A speed is rays × surfaces / s. Surfaces are all of the file but the object: stop and image count.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from raytrace.bench.reference import ReferenceSurface, spot_gradient, trace_reference
from raytrace.maths.numerics import to
from raytrace.maths.sampling import sobol
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface, is_even
from raytrace.tracing.compiled import engine as engine_asked_for
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.trace import trace_lens, trace_surfaces

DTYPES = (torch.float32, torch.float64)
SAMPLE = 24  # rays of the check against the reference
PIECES = (2**15, 2**16)  # numbers of rays traced at a time that are tried, and all at once
SHORTEST = 0.02  # s: shorter calls are timed many at a time
_MOST_CALLS = 200

#: A call that is timed, and its preparation, which is not.
Job = tuple[Callable[[], object], Callable[[], object]]


def nothing(*_) -> None:
    """No preparation; no progress."""


def name_of(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


class Tracer(Protocol):
    """A tracer of one lens.

    prepare: called before every timed call. forward: positions (2, P) on the image and optical path (P,) or None,
    without gradient. gradient: derivatives of the mean squared distance from `centroid` (2,) with respect to
    `variables`, then to the indices of media if it takes those.
    """

    name: str
    dtype: torch.dtype
    with_path: bool
    has_gradient: bool
    most: int | None  # rays it traces in bearable time; None: any number

    def prepare(self) -> None: ...

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]: ...

    def gradient(self, rays: Rays, centroid: Tensor) -> Sequence[Tensor]: ...


class Own:
    """This package's trace. engine: "auto" (the program's choice), "eager", or None for the engine that is set;
    by_indices: gradients also with respect to the index of every medium.
    """

    has_gradient, most = True, None

    def __init__(self, lens: Lens, dtype: torch.dtype, *, engine: str | None = None, with_path=False, by_indices=False):
        self.dtype, self.with_path, self.engine = dtype, with_path, engine or engine_asked_for()
        self.name = "raytrace" if engine in (None, "auto") else f"raytrace, {engine}"
        self.lens, self.wavelength = to(lens, dtype=dtype), lens.primary
        self.surfaces, self.indices, self.leaves = leaves_of(self.lens, by_indices=by_indices)

    prepare = nothing

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
        path = torch.zeros_like(rays.direction[0]) if self.with_path else None
        return dataclasses.replace(rays, opl=path)


def squared_radius(x: Tensor, y: Tensor, centroid: Tensor) -> Tensor:
    """Mean squared distance from a fixed point.

    At the centroid its gradient is that of the mean squared spot radius: distances from the centroid sum to zero.
    """
    return ((x - centroid[0]) ** 2 + (y - centroid[1]) ** 2).mean()


def slope(rays: Rays, leaf: Tensor) -> Tensor:
    """Derivative of the mean squared spot radius with respect to a number of the lens."""
    x, y = rays.position[0], rays.position[1]
    centroid = torch.stack([x.detach().mean(), y.detach().mean()])
    return torch.autograd.grad(squared_radius(x, y, centroid), leaf)[0]


def variables(lens: Lens) -> list[tuple[int, str]]:
    """Variables of gradients: every modelled curvature and every thickness, as (surface number, name)."""
    last = len(lens.surfaces) - 1
    curved = [(i, "curvature") for i in range(1, last + 1) if lens.surfaces[i].curvature is not None]
    return curved + [(i, "thickness") for i in range(1, last)]


def with_leaf(lens: Lens, number: int, name: str) -> tuple[Lens, Tensor]:
    """The lens with one number of a surface as a leaf, and the leaf."""
    leaf = getattr(lens.surfaces[number], name).detach().clone().requires_grad_()
    return lens.replace(number, **{name: leaf}), leaf


def with_leaves(lens: Lens, chosen: Sequence[tuple[int, str]]) -> tuple[Lens, list[Tensor]]:
    """The lens with a leaf for each of the chosen numbers, and the leaves."""
    leaves = []
    for number, name in chosen:
        lens, leaf = with_leaf(lens, number, name)
        leaves.append(leaf)
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

    position: float | None
    path: float | None
    gradient: float | None


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
    batch = some(rays, lambda x: x.repeat(*(1,) * (x.dim() - 1), copies))
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
    return time.process_time if threads == 1 else time.perf_counter


def seconds_of(job: Job, calls: int, threads: int) -> float:
    """Mean seconds of several calls."""
    call, prepare = job
    with torch_threads(threads):
        prepare()
        now = clock(threads)
        start = now()
        for _ in range(calls):
            call()
        return (now() - start) / calls


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


def in_best_pieces(
    function: Callable[[Rays], object], rays: Rays, prepare: Callable, *, sizes: Sequence[int], threads: int,
    most: int | None = None,
) -> tuple[Job, int]:  # fmt: skip
    """A call on all rays in pieces, and their size: the fastest of `sizes` and all at once, ≤ most."""
    count = rays.direction.shape[1]
    whole = min(count, most or count)

    def by_pieces(size: int) -> Callable[[], object]:
        if size >= count:
            return lambda: function(rays)
        pieces = [some(rays, lambda x, first=first: x[..., first : first + size]) for first in range(0, count, size)]
        return lambda: [function(piece) for piece in pieces]

    jobs = {size: (by_pieces(size), prepare) for size in {*(min(size, whole) for size in sizes), whole}}
    if len(jobs) == 1:
        return jobs[whole], whole
    for job in jobs.values():
        seconds_of(job, 1, threads)
    best = min(jobs, key=lambda size: min(seconds_of(jobs[size], 1, threads) for _ in range(2)))
    return jobs[best], best
