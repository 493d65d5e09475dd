"""Less work: both sides of every comparison give the same result, and the lesser side does less. No timings."""

import dataclasses

import pytest
import torch

from raytrace.bench import less_work
from raytrace.bench import measure as timing
from raytrace.bench.less_work import cases, double_gauss, measure, with_spheres_for_planes
from raytrace.bench.measure import with_leaf, with_sensor_leaf
from raytrace.bench.speed import Sizes
from raytrace.maths.pupil import sobol
from raytrace.psf_models import MODELS, fourier, psf
from raytrace.system.lens import with_object_distance
from raytrace.tracing.compiled import prepare, trace_engine
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.scene import Memo, scene, symmetry, trace_bundle

TINY = Sizes(less=64, distances=2)
ROUNDING = 1e-10  # of sums of kernels and gradients; a kernel 1e-12 degrees off the axis moves by 3e-11 of itself
#: Kernels by two rules of one order: differences of the errors that order leaves.
RULES = {"drt": 1e-3, "wave": 1e-3}


def bound(what):
    is_rule = what.startswith("symmetry")
    return next((most for model, most in RULES.items() if is_rule and f"{model} " in what), ROUNDING)


@pytest.mark.parametrize("case", cases(TINY), ids=lambda case: f"{case.engine} {case.what}")
def test_less_work_gives_the_same_result(case):
    with trace_engine(case.engine):
        for _ in range(2):  # a Memo is filled by the first call
            less, full = case.less(), case.full()
            assert less.shape == full.shape
            assert float(full.abs().sum()) > 0
            assert float((less - full).abs().sum() / full.abs().sum()) < bound(case.what)


def test_rows_say_what_was_compared(monkeypatch):
    monkeypatch.setattr(timing, "SHORTEST", 0.0)
    few = [case for case in cases(TINY) if case.what.startswith(("prefix", "planes"))]
    monkeypatch.setattr(less_work, "cases", lambda sizes: few)
    words, before = [], torch.get_num_threads()
    rows = measure(TINY, repeats=1, progress=words.append)
    assert torch.get_num_threads() == before
    assert words == [row.what for row in rows] == [case.what for case in few]
    assert {row.engine for row in rows} == {"eager"} | ({"compiled"} if prepare() == "compiled" else set())
    for row in rows:
        assert row.gain == row.seconds_without / row.seconds
        assert 0 <= row.error < ROUNDING


@pytest.mark.parametrize(("number", "again"), [(None, 1), (11, 2)])
def test_memo_of_the_cases_traces_only_what_moves(number, again):
    """Surfaces crossed by a second call: the image alone, or also the last one before it."""
    lens, _ = with_sensor_leaf(double_gauss()) if number is None else with_leaf(double_gauss(), 11, "curvature")
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
        for x, y in ((0.0, 0.0), (less_work.SKEW, 0.0), (0.0, less_work.FIELD), (less_work.FIELD, 0.0))
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
