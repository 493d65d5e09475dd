"""Less work: what reuse, planes, symmetry and shared parts save, each beside the same result found without it.

Every case is a pair of calls that return the same numbers. They are timed in turns, by processor time of one thread in
float64, so that a gain is that of the work that is left out, not of the machine.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.bench.measure import field_rays
from raytrace.bench.speed import Bench, Sizes, double_gauss, interleaved
from raytrace.bench.speed_own import with_sensor_leaf
from raytrace.bench.tracers import squared_radius
from raytrace.fused import prepare, tracing
from raytrace.kernels import psf
from raytrace.maths.grid import grid
from raytrace.maths.pupil import sobol
from raytrace.optics.reuse import Bundle, Memo, trace_bundle
from raytrace.optics.trace import media, trace_surfaces
from raytrace.system.lens import Lens, with_object_distance
from raytrace.system.rays import Rays

_SKEW = 1e-12  # degrees: off the axis by less than rounding, but not on it
_FIELD = 10.0  # degrees
_WAVELENGTHS = 0.48, 0.51, 0.53, 0.58, 0.64  # µm
_FINITE = 10e3, 50e3  # mm, of object distances


@dataclasses.dataclass(frozen=True)
class Case:
    """The same numbers with less work and with all of it. engine: of the trace, "auto" for the program's choice."""

    what: str
    engine: str
    less: Callable[[], Tensor]
    full: Callable[[], Tensor]


@dataclasses.dataclass(frozen=True)
class Gain:
    """One row. seconds: medians, with less work and with all of it; gain: their ratio.

    error: Σ |less - full| / Σ |full| of the numbers that both return.
    """

    what: str
    engine: str
    seconds: float
    seconds_without: float
    gain: float
    error: float


def measure(sizes: Sizes, *, repeats: int, progress: Callable[[str], object] = lambda words: None) -> list[Gain]:
    """A row for every case; progress: called with each before it is measured, `len(cases(sizes))` times."""
    threads, bench = torch.get_num_threads(), Bench(torch.float64, sizes, repeats, 1, None)
    try:
        torch.set_num_threads(1)
        rows = []
        for case in cases(sizes):
            progress(case.what)
            rows.append(_gain(case, bench))
        return rows
    finally:
        torch.set_num_threads(threads)


def cases(sizes: Sizes) -> list[Case]:
    """All of them; nothing is traced before a case is called. Without a compiler those of the compiled trace lack."""
    engines = ["fused", "eager"] if prepare() == "fused" else ["eager"]
    traced = [case for engine in engines for make in (_prefix, _sensor, *_PLANES) for case in make(sizes, engine)]
    return [*traced, *_symmetries(sizes), *_wavelengths(sizes), *_object_distances(sizes)]


def _gain(case: Case, bench: Bench) -> Gain:
    with tracing(case.engine):
        less, full = case.less(), case.full()
        seconds = interleaved({"less": (case.less, _nothing), "full": (case.full, _nothing)}, bench)
    error = float((less - full).abs().sum() / full.abs().sum())
    return Gain(case.what, case.engine, seconds["less"], seconds["full"], seconds["full"] / seconds["less"], error)


def _nothing() -> None:
    pass


# -- traced: prefix and planes -----------------------------------------------------------------------------------------


def _prefix(sizes: Sizes, engine: str) -> list[Case]:
    lens, leaf = _with_curvature_leaf(double_gauss(), 11)
    return [_remembered("prefix: step of the last radius, Memo over none", engine, lens, leaf, sizes.less)]


def _sensor(sizes: Sizes, engine: str) -> list[Case]:
    lens, leaf = with_sensor_leaf(double_gauss())
    return [_remembered("prefix: step of the sensor distance, Memo over none", engine, lens, leaf, sizes.less)]


def _remembered(what: str, engine: str, lens: Lens, leaf: Tensor, count: int) -> Case:
    """Forward and gradient by one number of the lens, of launched rays; the rays before it kept, or not."""
    field = torch.tensor([[0.0], [_FIELD]], dtype=torch.float64)
    bundle, memo = (lens, field, lens.wavelengths[0], sobol(count)[0]), Memo()
    return Case(what, engine, lambda: _slope(bundle, leaf, memo), lambda: _slope(bundle, leaf, None))


def _slope(bundle: Bundle, leaf: Tensor, memo: Memo | None) -> Tensor:
    return _derivative(trace_bundle(bundle, memo), leaf)


def _derivative(rays: Rays, leaf: Tensor) -> Tensor:
    """Derivative of the mean squared spot radius."""
    x, y, _ = rays.position
    centroid = torch.stack([x.detach().mean(), y.detach().mean()])
    return torch.autograd.grad(squared_radius(x, y, centroid), leaf)[0]


def _planes_forward(sizes: Sizes, engine: str) -> list[Case]:
    lens, rays = double_gauss(), field_rays(double_gauss(), sizes.less)
    less, full = (lambda lens=each: _end(lens, rays) for each in (lens, with_spheres_for_planes(lens)))
    return [Case(f"{_planes_in(lens)} over spheres of curvature 0, forward", engine, less, full)]


def _planes_backward(sizes: Sizes, engine: str) -> list[Case]:
    rays, (lens, leaf) = field_rays(double_gauss(), sizes.less), _with_curvature_leaf(double_gauss(), 1)
    less, full = (
        lambda lens=each: _derivative(_traced(lens, rays), leaf) for each in (lens, with_spheres_for_planes(lens))
    )
    return [Case(f"{_planes_in(lens)} over spheres of curvature 0, forward + backward", engine, less, full)]


_PLANES = _planes_forward, _planes_backward


def with_spheres_for_planes(lens: Lens) -> Lens:
    """The same lens, its planes behind the object spheres of curvature 0, as if they were variables."""
    zero = torch.zeros_like(lens.surfaces[-2].thickness)
    curved = [dataclasses.replace(one, curvature=zero) if one.is_plane else one for one in lens.surfaces[1:]]
    return dataclasses.replace(lens, surfaces=(lens.surfaces[0], *curved))


def _planes_in(lens: Lens) -> str:
    return f"planes: {sum(one.is_plane for one in lens.surfaces[1:])} of {len(lens.surfaces) - 1} surfaces"


def _end(lens: Lens, rays: Rays) -> Tensor:
    with torch.no_grad():
        return _traced(lens, rays).position[:2]


def _traced(lens: Lens, rays: Rays) -> Rays:
    return trace_surfaces(lens.surfaces[1:], rays, indices=media(lens, lens.wavelengths[0]))


def _with_curvature_leaf(lens: Lens, number: int) -> tuple[Lens, Tensor]:
    surfaces = list(lens.surfaces)
    leaf = surfaces[number].curvature.detach().clone().requires_grad_()
    surfaces[number] = dataclasses.replace(surfaces[number], curvature=leaf)
    return dataclasses.replace(lens, surfaces=tuple(surfaces)), leaf


# -- kernels: symmetry, wavelengths, object distances ------------------------------------------------------------------


def _symmetries(sizes: Sizes) -> list[Case]:
    """On the axis a meridian, off it half the pupil; over the same light where `scene.symmetry` sees none.

    A field 1e-12 degrees off in x is on the axis to rounding; one along x is one along y, columns and rows exchanged.
    """
    return [
        case
        for model, order, distances in (("gaussian", 4, sizes.distances), ("drt", 4, 3), ("wave", 0, 1))
        for case in (
            Case(
                f"symmetry: a meridian over the whole pupil, {model} on the axis, {_counted(distances)}",
                "auto",
                lambda model=model, order=order, count=distances: _kernels(model, order, (0.0, 0.0), count),
                lambda model=model, order=order, count=distances: _kernels(model, order, (_SKEW, 0.0), count),
            ),
            Case(
                f"symmetry: half the pupil over all of it, {model} at 10 degrees, {_counted(distances)}",
                "auto",
                lambda model=model, order=order, count=distances: _kernels(model, order, (0.0, _FIELD), count),
                lambda model=model, order=order, count=distances: _kernels(model, order, (_FIELD, 0.0), count).mT,
            ),
        )
    ]


def _wavelengths(sizes: Sizes) -> list[Case]:
    found = [
        Case(
            f"wavelengths: {len(_WAVELENGTHS)} in one call over a call each, {model} on the axis",
            "auto",
            lambda model=model, order=order: _kernels(model, order, (0.0, 0.0), 1, _WAVELENGTHS),
            lambda model=model, order=order: _mean(
                [_kernels(model, order, (0.0, 0.0), 1, (one,)) for one in _WAVELENGTHS]
            ),
        )
        for model, order in (("gaussian", 4), ("drt", 4))
    ]
    lens, pupil = double_gauss(), sobol(max(1, sizes.less // 4))[0]
    field = torch.tensor([0.0, _FIELD], dtype=torch.float64)[:, None, None]
    colours = [torch.tensor(some, dtype=torch.float64)[:, None] for some in (_WAVELENGTHS, *zip(_WAVELENGTHS))]

    def hits(wavelengths: Tensor) -> Tensor:
        with torch.no_grad():
            return trace_bundle((lens, field, wavelengths, pupil)).position[:2]

    what = f"wavelengths: {len(_WAVELENGTHS)} in one call over a call each, launch and trace of {pupil.shape[1]:,} rays"
    together, *alone = colours
    return [*found, Case(what, "auto", lambda: hits(together), lambda: torch.cat([hits(one) for one in alone], 1))]


def _object_distances(sizes: Sizes) -> list[Case]:
    count = sizes.distances
    distances = torch.linspace(*_FINITE, count, dtype=torch.float64)
    return [
        Case(
            f"object distances: {count} in one call over a call each, {model} on the axis",
            "auto",
            lambda model=model, order=order: _kernels(model, order, (0.0, 0.0), count),
            lambda model=model, order=order: torch.cat(
                [_kernels_at(model, order, (0.0, 0.0), distance[None]) for distance in distances]
            ),
        )
        for model, order in (("gaussian", 4), ("drt", 4))
    ]


def _kernels(
    model: str, order: int, field: tuple[float, float], count: int, wavelengths: Sequence[float] = (0.53,)
) -> Tensor:
    return _kernels_at(model, order, field, torch.linspace(*_FINITE, count, dtype=torch.float64), wavelengths)


def _kernels_at(
    model: str, order: int, field: tuple[float, float], distances: Tensor, wavelengths: Sequence[float] = (0.53,)
) -> Tensor:
    """Kernels (D, rows, columns) of an order about the chief ray, or the axis on it."""
    place = torch.tensor(field, dtype=torch.float64)[:, None]
    center = "chief" if _FIELD in field else "axis"
    colours = torch.tensor(wavelengths, dtype=torch.float64)
    with torch.no_grad():
        found = psf(
            _focused(),
            model,
            fields=place,
            object_distances=distances,
            wavelengths=colours,
            grid=grid(0.005, 21),
            center=center,
            order=order,
        )
    return found.kernel[:, 0]


@functools.cache
def _focused() -> Lens:
    return with_object_distance(double_gauss(), 25e3)


def _mean(kernels: Sequence[Tensor]) -> Tensor:
    return torch.stack(list(kernels)).mean(0)


def _counted(distances: int) -> str:
    return "one object distance" if distances == 1 else f"{distances} object distances"
