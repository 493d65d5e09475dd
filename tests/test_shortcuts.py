"""Shortcuts (reuse of rays, planes, symmetry, shared parts) give the same numbers as the full computation."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from functools import partial

import pytest
import torch
from scripts import script
from torch import Tensor

from raytrace.bench.measure import field_rays, with_leaves
from raytrace.io import read_lens
from raytrace.maths.sampling import grid, sobol
from raytrace.psf_models import MODELS, fourier, model_of, psf
from raytrace.system.lens import Lens, with_object_distance
from raytrace.system.rays import Rays
from raytrace.tracing.compiled import prepare, trace_engine
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.scene import Memo, scene, symmetry, trace_bundle
from raytrace.tracing.trace import trace_lens

ratios = script("bench_ratios")
slope, with_sensor_leaf = ratios.slope, ratios.with_sensor_leaf

SKEW = 1e-12  # degrees: off the axis by less than rounding, but not on it
FIELD = 10.0  # degrees
_WAVELENGTHS = 0.48, 0.51, 0.53, 0.58, 0.64  # µm
_FINITE = 10e3, 50e3  # mm, of object distances
_ORDERS = {"gaussian": 4, "drt": 4, "wave": 0}
ROUNDING = 1e-10  # of sums of kernels and gradients; a kernel 1e-12 degrees off the axis moves by 3e-11 of itself
#: Kernels by two rules of one order: differences of the errors that order leaves.
RULES = {"drt": 1e-3, "wave": 1e-3}


def bound(what):
    is_rule = what.startswith("symmetry")
    return next((most for model, most in RULES.items() if is_rule and f"{model} " in what), ROUNDING)


double_gauss = partial(read_lens, "double_gauss")


def of_last_radius(lens: Lens) -> tuple[Lens, Tensor]:
    """The lens with its last curvature as a leaf, and the leaf."""
    lens, (leaf,) = with_leaves(lens, [(11, "curvature")])
    return lens, leaf


def _traced(count: int) -> dict[str, tuple[Callable, Callable]]:
    """Pairs of calls that trace so many rays."""
    lens, rays = double_gauss(), field_rays(double_gauss(), count)
    bent, (leaf,) = with_leaves(lens, [(1, "curvature")])
    planes = f"planes: {sum(one.is_plane for one in lens.surfaces[1:])} of {len(lens.surfaces) - 1} surfaces"
    return {
        "prefix: step of the last radius, Memo over none": _remembered(*of_last_radius(lens), count),
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


def cases(count: int, distances: int) -> list[tuple[str, str, Callable, Callable]]:
    """(engine, words, with less work, with all of it)."""
    engines = ["compiled", "eager"] if prepare() == "compiled" else ["eager"]
    found = [(engine, what, *pair) for engine in engines for what, pair in _traced(count).items()]
    return found + [("auto", what, *pair) for what, pair in (_kernel_cases(distances) | _launched(count)).items()]


CASES = cases(64, 2)


@pytest.mark.parametrize(("engine", "what", "less", "full"), CASES, ids=[f"{case[0]} {case[1]}" for case in CASES])
def test_a_shortcut_gives_the_same_result(engine, what, less, full):
    with trace_engine(engine):
        for _ in range(2):  # a Memo is filled by the first call
            a, b = less(), full()
            assert a.shape == b.shape
            assert float(b.abs().sum()) > 0
            assert float((a - b).abs().sum() / b.abs().sum()) < bound(what)


@pytest.mark.parametrize(("number", "again"), [(None, 1), (11, 2)])
def test_memo_of_the_cases_traces_only_changed_surfaces(number, again):
    """Surfaces crossed by a second call: the image alone, or also the last one before it."""
    lens, _ = with_sensor_leaf(double_gauss()) if number is None else of_last_radius(double_gauss())
    bundle = (
        lens,
        torch.zeros(2, 1, dtype=torch.float64),
        lens.wavelengths[0],
        torch.rand(2, 8, dtype=torch.float64) - 0.5,
    )
    memo = Memo()
    trace_bundle(bundle, memo)
    first = memo.crossed
    trace_bundle(bundle, memo)
    assert (first, memo.crossed - first) == (12, again)


def test_planes_and_symmetry_are_taken_away():
    """What the fuller side lacks: without planes there is a root for each surface, off the axis no meridian."""
    assert sum(surface.is_plane for surface in double_gauss().surfaces[1:]) == 4
    assert not any(surface.is_plane for surface in with_spheres_for_planes(double_gauss()).surfaces[1:])
    number = torch.tensor([25e3], dtype=torch.float64)
    kinds = [
        symmetry(scene(double_gauss(), torch.tensor([[x], [y]], dtype=torch.float64), number, number * 0 + 0.53))
        for x, y in ((0.0, 0.0), (SKEW, 0.0), (0.0, FIELD), (FIELD, 0.0))
    ]
    assert kinds == ["round", "none", "mirror", "none"]


def test_wavelengths_share_all_of_a_launch_but_their_paths():
    """Bit for bit the rays of each wavelength alone, in a medium that disperses."""
    lens = with_object_distance(double_gauss(), 25e3)
    lens = lens.replace(0, glass=lens.surfaces[1].glass)
    field, pupil = torch.tensor([0.0, 10.0], dtype=torch.float64)[:, None, None], sobol(32)[0]
    colours = torch.tensor([0.48, 0.53, 0.64], dtype=torch.float64)
    together = rays_of_field(lens, field, pupil, wavelength=colours[:, None])
    assert together.position.shape == together.direction.shape == (3, 1, 32)
    assert together.opl.shape == (3, 32)
    for path, colour in zip(together.opl, colours, strict=True):
        alone = rays_of_field(lens, field[..., 0], pupil, wavelength=colour)
        assert torch.equal(together.position[:, 0], alone.position)
        assert torch.equal(together.direction[:, 0], alone.direction)
        assert torch.equal(path, alone.opl)
    assert not torch.equal(together.opl[0], together.opl[2])


def test_a_range_of_distances_is_remembered_behind_surfaces_that_do_not_bend():
    """There the wavelengths still share their rays, but not their paths."""
    lens = with_object_distance(double_gauss(), torch.tensor([12e3, 40e3], dtype=torch.float64)[:, None, None, None])
    gap = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    dummy = dataclasses.replace(lens.surfaces[6], thickness=gap)
    lens = dataclasses.replace(lens, surfaces=(lens.surfaces[0], dummy, *lens.surfaces[1:]), stop=1)
    colours = torch.tensor([0.48, 0.64], dtype=torch.float64)[:, None]
    bundle = lens, torch.zeros(2, 1, 1, 1, dtype=torch.float64), colours, sobol(8)[0]
    memo = Memo(object_distances=(10e3, 50e3))
    with trace_engine("eager"):
        kept, traced = trace_bundle(bundle, memo), trace_bundle(bundle)
    assert [(stored.result.count, stored.result.smooth) for stored in memo._stored] == [(1, True)]
    assert float((kept.position - traced.position).detach().abs().max()) < 1e-8  # mm
    assert float((kept.opl - traced.opl).detach().abs().max()) < 1e-8


@pytest.mark.parametrize(("varies", "again"), [(False, 0), (True, 1)])
def test_a_tolerance_computes_an_order_twice_only_for_a_derivative(monkeypatch, varies, again):
    orders = []

    def counted(batch, pixels, *, order, zernike):
        orders.append(order)
        return fourier.kernels(batch, pixels, order=order, zernike=zernike)

    monkeypatch.setitem(MODELS, "fourier", dataclasses.replace(MODELS["fourier"], kernels=counted))
    lens, leaf = with_sensor_leaf(with_object_distance(double_gauss(), 25e3))
    leaf.requires_grad_(varies)
    found = psf(lens, "fourier", fields=torch.zeros(2, 1, dtype=torch.float64), tol=1e-2)
    assert len(orders) - len(set(orders)) == again
    assert found.kernel.requires_grad == varies
