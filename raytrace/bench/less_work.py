"""Less work: what reuse, planes, symmetry and shared parts save, each beside the same result found without it.

Every case is a pair of calls that return the same numbers. They are timed in turns, by processor time of one thread in
float64, so that a gain is that of the work that is left out, not of the machine.
"""

import dataclasses
import functools
import statistics
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.bench.measure import field_rays, in_turns, nothing, slope, with_leaf, with_sensor_leaf
from raytrace.io import read_lens
from raytrace.maths.grid import grid
from raytrace.maths.pupil import sobol
from raytrace.psf_models import model_of, psf
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens, with_object_distance
from raytrace.system.rays import Rays
from raytrace.tracing.compiled import prepare, trace_engine
from raytrace.tracing.scene import Memo, trace_bundle
from raytrace.tracing.trace import trace_lens

SKEW = 1e-12  # degrees: off the axis by less than rounding, but not on it
FIELD = 10.0  # degrees
_WAVELENGTHS = 0.48, 0.51, 0.53, 0.58, 0.64  # µm
_FINITE = 10e3, 50e3  # mm, of object distances
_ORDERS = {"gaussian": 4, "drt": 4, "wave": 0}


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


def measure(sizes, *, repeats: int, progress: Callable[[str], object] = nothing) -> list[Gain]:
    """A row for every case; progress: called with each before it is measured, `len(cases(sizes))` times."""
    rows = []
    with torch_threads(1):
        for case in cases(sizes):
            progress(case.what)
            rows.append(_gain(case, repeats))
    return rows


def cases(sizes) -> list[Case]:
    """All of them (sizes: `speed.Sizes`); nothing is traced before a case is called. Without a compiler those of the
    compiled trace lack."""
    engines = ["compiled", "eager"] if prepare() == "compiled" else ["eager"]
    found = [Case(what, engine, *pair) for engine in engines for what, pair in _traced(sizes.less).items()]
    others = _kernel_cases(sizes.distances) | _launched(sizes.less)
    return [*found, *(Case(what, "auto", *pair) for what, pair in sorted(others.items(), key=_kind))]


def _kind(case: tuple[str, object]) -> int:
    return ("symmetry", "wavelengths", "object distances").index(case[0].partition(":")[0])


def _gain(case: Case, repeats: int) -> Gain:
    with trace_engine(case.engine):
        less, full = case.less(), case.full()
        taken = in_turns({one: (one, nothing) for one in (case.less, case.full)}, repeats=repeats, threads=1)
        seconds, without = (statistics.median(one) for one in taken.values())
    error = float((less - full).abs().sum() / full.abs().sum())
    return Gain(case.what, case.engine, seconds, without, without / seconds, error)


# -- traced: prefix and planes -----------------------------------------------------------------------------------------


def double_gauss() -> Lens:
    return read_lens("double_gauss")


def _traced(count: int) -> dict[str, tuple[Callable, Callable]]:
    """Pairs of calls that trace so many rays."""
    lens, rays = double_gauss(), field_rays(double_gauss(), count)
    bent, leaf = with_leaf(lens, 1, "curvature")
    planes = f"planes: {sum(one.is_plane for one in lens.surfaces[1:])} of {len(lens.surfaces) - 1} surfaces"
    return {
        "prefix: step of the last radius, Memo over none": _remembered(*with_leaf(lens, 11, "curvature"), count),
        "prefix: step of the sensor distance, Memo over none": _remembered(*with_sensor_leaf(lens), count),
        f"{planes} over spheres of curvature 0, forward": tuple(
            functools.partial(_end, each, rays) for each in (lens, with_spheres_for_planes(lens))
        ),
        f"{planes} over spheres of curvature 0, forward + backward": tuple(
            lambda each=each: slope(_through(each, rays), leaf) for each in (bent, with_spheres_for_planes(bent))
        ),
    }


def _remembered(lens: Lens, leaf: Tensor, count: int) -> tuple[Callable, Callable]:
    """Forward and gradient by one number of the lens, of launched rays; the rays before it kept, or not."""
    field = torch.tensor([[0.0], [FIELD]], dtype=torch.float64)
    bundle, memo = (lens, field, lens.wavelengths[0], sobol(count)[0]), Memo()
    return lambda: slope(trace_bundle(bundle, memo), leaf), lambda: slope(trace_bundle(bundle), leaf)


def with_spheres_for_planes(lens: Lens) -> Lens:
    """The same lens, its planes behind the object spheres of curvature 0, as if they were variables."""
    for number, one in enumerate(lens.surfaces[1:], 1):
        lens = lens.replace(number, curvature=torch.zeros_like(one.thickness)) if one.is_plane else lens
    return lens


def _end(lens: Lens, rays: Rays) -> Tensor:
    with torch.no_grad():
        return _through(lens, rays).position[:2]


def _through(lens: Lens, rays: Rays) -> Rays:
    return trace_lens(lens, rays, lens.wavelengths[0])


# -- kernels: symmetry, wavelengths, object distances ------------------------------------------------------------------


def _kernel_cases(distances: int) -> dict[str, tuple[Callable, Callable]]:
    """Symmetry: on the axis a meridian, off it half the pupil; over the same light where `scene.symmetry` sees none.

    A field 1e-12 degrees off in x is on the axis to rounding; one along x is one along y, columns and rows exchanged.
    """
    found = {}
    for model, count in (("gaussian", distances), ("drt", 3), ("wave", 1)):
        at, many = functools.partial(_kernels, model), _distances(count)
        words = "one object distance" if count == 1 else f"{count} object distances"
        found[f"symmetry: a meridian over the whole pupil, {model} on the axis, {words}"] = (
            functools.partial(at, (0.0, 0.0), many),
            functools.partial(at, (SKEW, 0.0), many),
        )
        found[f"symmetry: half the pupil over all of it, {model} at 10 degrees, {words}"] = (
            functools.partial(at, (0.0, FIELD), many),
            lambda at=at, many=many: at((FIELD, 0.0), many).mT,
        )
    for model in ("gaussian", "drt"):
        at, many = functools.partial(_kernels, model, (0.0, 0.0)), _distances(distances)
        found[f"wavelengths: {len(_WAVELENGTHS)} in one call over a call each, {model} on the axis"] = (
            functools.partial(at, _distances(1), _WAVELENGTHS),
            lambda at=at: torch.stack([at(_distances(1), (one,)) for one in _WAVELENGTHS]).mean(0),
        )
        found[f"object distances: {distances} in one call over a call each, {model} on the axis"] = (
            functools.partial(at, many),
            lambda at=at, many=many: torch.cat([at(distance[None]) for distance in many]),
        )
    return found


def _launched(rays: int) -> dict[str, tuple[Callable, Callable]]:
    """All wavelengths launched and traced at once."""
    lens, pupil = double_gauss(), sobol(max(1, rays // 4))[0]
    field = torch.tensor([0.0, FIELD], dtype=torch.float64)[:, None, None]

    def hits(wavelengths: Sequence[float]) -> Tensor:
        colours = torch.tensor(wavelengths, dtype=torch.float64)[:, None]
        with torch.no_grad():
            return trace_bundle((lens, field, colours, pupil)).position[:2]

    words = (
        f"wavelengths: {len(_WAVELENGTHS)} in one call over a call each, launch and trace of {pupil.shape[1]:,} rays"
    )
    return {words: (lambda: hits(_WAVELENGTHS), lambda: torch.cat([hits([one]) for one in _WAVELENGTHS], 1))}


def _distances(count: int) -> Tensor:
    return torch.linspace(*_FINITE, count, dtype=torch.float64)


def _kernels(
    model: str, field: tuple[float, float], distances: Tensor, wavelengths: Sequence[float] = (0.53,)
) -> Tensor:
    """Kernels (D, rows, columns) of one order about the chief ray, or the axis on it."""
    with torch.no_grad():
        found = psf(
            _focused(),
            model_of(model, order=_ORDERS[model]),
            fields=distances.new_tensor(field)[:, None],
            object_distances=distances,
            wavelengths=distances.new_tensor(wavelengths),
            grid=grid(0.005, 21),
            center="chief" if FIELD in field else "axis",
        )
    return found.kernel[:, 0]


@functools.cache
def _focused() -> Lens:
    return with_object_distance(double_gauss(), 25e3)
