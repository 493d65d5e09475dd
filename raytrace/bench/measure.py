"""What the benchmarks of the trace share: who traces, calls timed in turns, and the error against the reference.

A speed is rays × surfaces / s. Surfaces are those a ray is carried to: all of the file but the object, the stop and the
image among them.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from raytrace.bench.reference import ReferenceSurface, spot_gradient, trace_reference
from raytrace.maths.pupil import sobol
from raytrace.maths.value import to
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
PIECES = (2**15, 2**16)  # numbers of rays traced at a time that are tried, beside all at once
SHORTEST = 0.02  # s: shorter calls are timed many at a time
_MOST_CALLS = 200

#: A call to be timed, and what stands before it untimed.
Job = tuple[Callable[[], object], Callable[[], object]]


def nothing(*_) -> None:
    """What stands before a call that needs no preparation; progress that nobody follows."""


def name_of(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


# -- who traces --------------------------------------------------------------------------------------------------------


class Tracer(Protocol):
    """A tracer with a lens: name, dtype and whether it computes the optical path are part of it.

    prepare: called before every timed call, untimed.
    forward: (positions (2, P) on the image, path (P,) or None) without gradient.
    gradient: derivatives of the mean squared distance from `centroid` (2,), numbers in the order of `variables`, then
    by the indices of all media where it takes those.
    """

    name: str
    dtype: torch.dtype
    with_path: bool
    has_gradient: bool

    def prepare(self) -> None: ...

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]: ...

    def gradient(self, rays: Rays, centroid: Tensor) -> Sequence[Tensor]: ...


class Own:
    """This package's trace by an engine: "auto" (the program's choice), "eager", or None, the one asked for.

    by_indices: gradients also by the index of every medium.
    """

    has_gradient = True

    def __init__(self, lens: Lens, dtype: torch.dtype, *, engine: str | None = None, with_path=False, by_indices=False):
        self.dtype, self.with_path, self.engine = dtype, with_path, engine or engine_asked_for()
        self.name = "raytrace" if engine in (None, "auto") else f"raytrace, {engine}"
        self.lens, self.wavelength = to(lens, dtype=dtype), lens.primary
        self.surfaces, self.indices, self.leaves = leaves_of(self.lens, by_indices=by_indices)

    def prepare(self) -> None:
        pass

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

    About the rays' own centroid its gradient is that of the mean squared spot radius, for the centroid moves by the
    mean of what the rays move by, and the distances from it sum to zero.
    """
    return ((x - centroid[0]) ** 2 + (y - centroid[1]) ** 2).mean()


def slope(rays: Rays, leaf: Tensor) -> Tensor:
    """Derivative of the mean squared spot radius by a number of the lens."""
    x, y = rays.position[0], rays.position[1]
    centroid = torch.stack([x.detach().mean(), y.detach().mean()])
    return torch.autograd.grad(squared_radius(x, y, centroid), leaf)[0]


def variables(lens: Lens) -> list[tuple[int, str]]:
    """What gradients are taken by: every modelled curvature and every thickness, as (surface number, name)."""
    last = len(lens.surfaces) - 1
    curved = [(i, "curvature") for i in range(1, last + 1) if lens.surfaces[i].curvature is not None]
    return curved + [(i, "thickness") for i in range(1, last)]


def with_leaf(lens: Lens, number: int, name: str) -> tuple[Lens, Tensor]:
    """The lens with one number of a surface a leaf, and the leaf."""
    leaf = getattr(lens.surfaces[number], name).detach().clone().requires_grad_()
    return lens.replace(number, **{name: leaf}), leaf


def with_leaves(lens: Lens, chosen: Sequence[tuple[int, str]] | None = None) -> tuple[Lens, list[Tensor]]:
    """The lens with a leaf for each of the chosen numbers, by default `variables`, and the leaves."""
    leaves = []
    for number, name in variables(lens) if chosen is None else chosen:
        lens, leaf = with_leaf(lens, number, name)
        leaves.append(leaf)
    return lens, leaves


def with_sensor_leaf(lens: Lens) -> tuple[Lens, Tensor]:
    """The lens with its sensor distance a leaf, and the leaf."""
    return with_leaf(lens, len(lens.surfaces) - 2, "thickness")


def leaves_of(lens: Lens, *, by_indices: bool = True) -> tuple[tuple[Surface, ...], list[Tensor], list[Tensor]]:
    """Surfaces after the object with the leaves of `variables`, the indices of all media, and the leaves.

    by_indices: the indices are leaves, too. Neighbouring gaps of one medium share one: the surface between bends
    nothing.
    """
    moving, leaves = with_leaves(lens)
    fixed = media(lens, lens.primary)
    indices = list(fixed)
    for number, index in enumerate(fixed if by_indices else ()):
        if number > 0 and index is fixed[number - 1]:
            indices[number] = indices[number - 1]
        else:
            indices[number] = index.detach().clone().requires_grad_()
            leaves.append(indices[number])
    return moving.surfaces[1:], indices, leaves


# -- rays, and what becomes of them in 50 digits -----------------------------------------------------------------------


def field_rays(lens: Lens, count: int) -> Rays:
    """`count` rays (Sobol points of the pupil) of the lens's middle field at its primary wavelength, float64."""
    field = torch.stack([lens.fields.x, lens.fields.y])[:, len(lens.fields.x) // 2, None]
    wavelength = lens.primary
    with torch.no_grad():
        rays = rays_of_field(lens, field, sobol(count)[0], wavelength=wavelength, ray_aiming="off")
    return dataclasses.replace(rays, opl=None)


def some(rays: Rays, change: Callable[[Tensor], Tensor]) -> Rays:
    """Rays without path whose every tensor (…, P) is changed."""
    return Rays(*(change(x) for x in (rays.position, rays.direction, rays.valid)))


def surfaces_of(lens: Lens) -> int:
    """Number of surfaces that a ray is carried to."""
    return len(lens.surfaces) - 1


@dataclasses.dataclass(frozen=True)
class Errors:
    """What a tracer misses the reference by, largest of the sample. Both are given the same numbers of their dtype.

    position: nm on the image; path: wavelengths, relative to the first ray; gradient: of the mean squared spot radius
    by curvatures and by thicknesses, |g - g_ref|/|g_ref| in the largest component, the larger of the two.
    """

    position: float | None
    path: float | None
    gradient: float | None


def shape_of(surface: Surface, number: int) -> tuple[float, float, list[float]]:
    """Curvature, conic and terms of r², r⁴, …: the shapes that everyone here knows. Raises ValueError for others."""
    if not is_even(surface):
        raise ValueError(f"surface {number} is no conic with even terms: its shape is not handed over")
    c, k = (0.0 if one is None else float(one) for one in (surface.curvature, surface.conic))
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
    """Compare a tracer with the reference on a few rays (3, P); both get the numbers as rounded to the dtype.

    copies: how often the rays stand in the batch, so that it takes the way of large ones; gradient: whether to compare
    that, too, where there is one.
    """
    lens, rays = to(lens, dtype=tracer.dtype), to(rays, dtype=tracer.dtype)
    surfaces, index = reference_of(lens)
    starts = list(zip(rays.position.T.tolist(), rays.direction.T.tolist(), strict=True))
    exact, count = [trace_reference(surfaces, index, *start) for start in starts], len(starts)
    batch = some(rays, lambda x: x.repeat(*(1,) * (x.dim() - 1), copies))
    tracer.prepare()
    points, path = tracer.forward(batch)
    points = points[:, :count]
    found = Errors(
        1e6 * max(_worst(points[axis].tolist(), [ray.position[axis] for ray in exact]) for axis in (0, 1)), None, None
    )
    if path is not None:
        waves = 1e3 / float(lens.primary)
        own = path[:count].double() - path[0].double()
        found = dataclasses.replace(
            found, path=waves * _worst(own.tolist(), [ray.path - exact[0].path for ray in exact])
        )
    if gradient and tracer.has_gradient:
        names = variables(lens)
        expected = spot_gradient(surfaces, index, starts, [(number - 1, name) for number, name in names])
        own = [float(slope) for slope in tracer.gradient(batch, points.mean(1))][: len(names)]
        found = dataclasses.replace(found, gradient=_worst_by_kind(own, expected, [name for _, name in names]))
    return found


def _worst_by_kind(found: Sequence[float], expected: Sequence, kinds: Sequence[str]) -> float:
    """The largest error relative to the largest component of its kind."""
    worst = 0.0
    for kind in set(kinds):
        pairs = [(a, b) for a, b, own in zip(found, expected, kinds, strict=True) if own == kind]
        worst = max(worst, _worst(*zip(*pairs, strict=True)) / float(max(abs(b) for _, b in pairs)))
    return worst


def _worst(found: Sequence[float], expected: Sequence) -> float:
    return max(float(abs(a - b)) for a, b in zip(found, expected, strict=True))


# -- time --------------------------------------------------------------------------------------------------------------


def clock(threads: int) -> Callable[[], float]:
    """Processor time where one thread works, which neighbours on the machine lengthen little; else the time of day."""
    return time.process_time if threads == 1 else time.perf_counter


def seconds_of(job: Job, calls: int, threads: int) -> float:
    """Of one call, the mean of several."""
    call, prepare = job
    with torch_threads(threads):
        prepare()
        now = clock(threads)
        began = now()
        for _ in range(calls):
            call()
        return (now() - began) / calls


def in_turns(
    jobs: Mapping[object, Job], *, repeats: int, threads: int, progress: Callable[[int], object] = nothing
) -> dict[object, list[float]]:
    """Seconds of each job, one call of each in turn so that a busy machine meets all alike; short calls many at a time.

    progress: called with 1 for each, `repeats` times the jobs.
    """
    calls = {}
    for name, job in jobs.items():
        seconds_of(job, 1, threads)  # warm up
        once = seconds_of(job, 1, threads)
        calls[name] = max(1, min(_MOST_CALLS, math.ceil(SHORTEST / max(once, 1e-6))))
    taken: dict[object, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            taken[name].append(seconds_of(job, calls[name], threads))
            progress(1)
    return taken


def in_best_pieces(
    function: Callable[[Rays], object],
    rays: Rays,
    prepare: Callable[[], object],
    *,
    sizes: Sequence[int],
    threads: int,
    most: int | None = None,
) -> tuple[Job, int]:
    """A call on all rays, as many at a time as a trial finds fastest, and how many: of `sizes`, or at most `most`."""
    count = rays.direction.shape[1]
    whole = min(count, most or count)
    jobs = {
        size: (_by_pieces(function, rays, size), prepare) for size in {*(min(size, whole) for size in sizes), whole}
    }
    if len(jobs) == 1:
        return jobs[whole], whole
    for job in jobs.values():
        seconds_of(job, 1, threads)
    best = min(jobs, key=lambda size: min(seconds_of(jobs[size], 1, threads) for _ in range(2)))
    return jobs[best], best


def _by_pieces(function: Callable[[Rays], object], rays: Rays, size: int) -> Callable[[], object]:
    count = rays.direction.shape[1]
    if size >= count:
        return lambda: function(rays)
    pieces = [some(rays, lambda x, first=first: x[..., first : first + size]) for first in range(0, count, size)]
    return lambda: [function(piece) for piece in pieces]
