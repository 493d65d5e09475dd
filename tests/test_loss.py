"""Losses by lifted least squares: the solver, quantities, conditions, checks by denser rays, restarts."""

import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.io import read_lens
from raytrace.optimization.least_squares import Sides, SumOfSquares
from raytrace.optimization.lifted import Lifted
from raytrace.optimization.loss import LossDescents
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.quantities import Kernels, Otf, Points

TRIPLET = read_lens("cooke_triplet")
TRANSFER = Otf((10.0, 20.0, 40.0), rings=4)
FEW = {"vary": "curvature:1-4 sensor", "restarts": 0}


def mean_square(points):
    return (points - points.mean((-2, -1), keepdim=True)).square().sum(0).mean()


def low_contrast(otf):
    return (1 - otf.abs()).mean()


# -- the solver


FREE = {"lower": np.full(2, -np.inf), "upper": np.full(2, np.inf), "typical": np.ones(2)}


def valley(x):
    """Rosenbrock's function and its gradient."""
    bend = x[1] - x[0] ** 2
    return 100 * bend**2 + (1 - x[0]) ** 2, np.array([-400 * x[0] * bend - 2 * (1 - x[0]), 200 * bend])


def rows(x, derivatives, held=None):
    """Rays that land at x: a metric that knows nothing of the function."""
    none = np.zeros((0, 2))
    value, slope = (np.zeros(0), none) if held is None else held(x)
    return SumOfSquares(x, x + 2.0, 0, Sides.none(2), value, np.zeros(0), np.eye(2), slope, none)


def test_a_narrow_valley_is_followed_to_its_end():
    evaluations = []

    def counted(x):
        evaluations.append(x)
        return valley(x)

    end = Lifted(counted, rows, **FREE).descend(np.array([-1.2, 1.0]), cycles=100)
    assert end.state.x == pytest.approx([1.0, 1.0], abs=1e-5)
    assert end.state.merit < 1e-10
    assert len(evaluations) < 200


def test_an_equality_that_is_curved_is_met_at_the_minimum():
    """On the circle x² + y² = 1 Rosenbrock's function has its minimum at (0.7864, 0.6177), by Lagrange's conditions."""

    def circle(x):
        return np.array([x @ x - 1.0]), 2 * x[None, :]

    lifted = Lifted(valley, lambda x, derivatives: rows(x, derivatives, circle), **FREE)
    end = lifted.descend(np.array([0.1, 0.9]), cycles=100)
    assert end.state.x == pytest.approx([0.78641515, 0.61769831], abs=1e-6)
    assert abs(end.state.held[0]) < 1e-9


@pytest.mark.parametrize("cubic", [0.0, 1e4])
def test_a_displaced_lens_has_at_most_three_times_the_spot_and_a_finite_loss(cubic):
    """Residuals x + 2 + cubic · (x − x₀)³ grow faster than by their derivatives; the loss is infinite at x > 1."""
    start = np.array([1.0, -1.0])

    def of_rays(x, derivatives):
        state = rows(x, derivatives)
        return dataclasses.replace(state, residuals=state.residuals + cubic * (x - start) ** 3)

    def loss(x):
        return (np.inf if x[0] > 1 else float(x @ x)), 2 * x

    lifted = Lifted(loss, of_rays, **FREE)
    spot = np.linalg.norm(of_rays(start, True).residuals)
    for seed in range(8):
        near = lifted.displaced(start, np.random.default_rng(seed))
        assert near[0] <= 1
        assert np.linalg.norm(of_rays(near, False).residuals) <= 3 * spot


# -- losses of a lens


def test_a_mean_square_spot_as_a_loss_ends_where_its_rows_do():
    by_rows = rt.optimize(TRIPLET, merit="spot", vary="curvature:1-4 sensor", hold="efl=100")
    by_loss = rt.optimize(TRIPLET, loss=mean_square, of=Points(6), first=None, hold="efl=100", **FEW)
    radii = [rt.spot(result.lens).rms_radius.square().mean().sqrt() for result in (by_rows, by_loss)]
    assert float(radii[1]) == pytest.approx(float(radii[0]), rel=2e-3)
    assert float(rt.first_order(by_loss.lens).effective_focal_length) == pytest.approx(100, abs=1e-6)
    assert by_loss.conditions[0].met
    assert by_loss.merit_after == pytest.approx(float(mean_square(Points(6)(by_loss.lens))), rel=1e-9)
    assert by_loss.merit_before == pytest.approx(float(mean_square(Points(6)(TRIPLET))), rel=1e-9)


@pytest.mark.parametrize("scale", [2.0**-30])
def test_the_end_does_not_depend_on_the_scale_of_the_loss(scale):
    ends = [
        rt.optimize(TRIPLET, loss=lambda otf, k=k: k * low_contrast(otf), of=TRANSFER, cycles=4, **FEW).variables_after
        for k in (1.0, scale)
    ]
    assert torch.allclose(*ends, rtol=1e-12, atol=0)


def test_a_loss_beyond_the_best_spots_is_lower_than_at_the_best_spots():
    result = rt.optimize(TRIPLET, loss=low_contrast, of=TRANSFER, hold="efl=100", cycles=15, **FEW)
    way = result.loss
    assert way.end < way.first < way.start
    assert float(low_contrast(TRANSFER(result.lens))) == pytest.approx(way.end, rel=1e-9)
    assert float(low_contrast(TRANSFER.denser()(result.lens))) == pytest.approx(way.checked, rel=1e-9)
    assert f"{way.first:.6g} after pre-optimisation" in str(result)
    assert result.document()["loss"]["end"] == way.end
    assert result.plot().axes


@pytest.mark.slow
def test_a_loss_of_too_few_rays_goes_on_with_more():
    few = rt.optimize(TRIPLET, loss=low_contrast, of=Otf(rings=1), cycles=300, **FEW)
    assert few.loss.refined >= 2
    is_same = abs(few.loss.checked - few.loss.end) <= 0.02 * few.loss.checked
    assert is_same != ("denser rays change the loss by more than 2 %" in str(few))
    assert "with more rays" in str(few)


def test_restarts_end_at_the_best_descent_and_repeat():
    options = {**FEW, "restarts": 2, "cycles": 9}
    first, second = (rt.optimize(TRIPLET, loss=low_contrast, of=TRANSFER, **options) for _ in range(2))
    assert torch.equal(first.variables_after, second.variables_after)
    assert first.loss.end in first.loss.ends


def test_an_interrupt_between_descents_keeps_the_best_lens(monkeypatch):
    options = {**FEW, "restarts": 1, "cycles": 150, "loss": low_contrast, "of": TRANSFER}
    whole = rt.optimize(TRIPLET, **options)
    with monkeypatch.context() as patched:
        patched.setattr(Lifted, "displaced", Mock(side_effect=KeyboardInterrupt))
        before_restarts = rt.optimize(TRIPLET, **options)
    assert (before_restarts.stopped, before_restarts.loss.ends) == ("interrupted", whole.loss.ends[:1])
    with monkeypatch.context() as patched:
        patched.setattr(Otf, "denser", Mock(side_effect=KeyboardInterrupt))
        in_check = rt.optimize(TRIPLET, **options)
    assert (in_check.stopped, in_check.loss.ends) == ("interrupted", whole.loss.ends[:1])
    assert in_check.loss.end == whole.loss.ends[0]


@pytest.mark.parametrize("judged", [(2.0, 1.0), (1.0, 2.0), (np.inf, 2.0)])
def test_the_end_of_least_loss_by_denser_rays_counts(judged, monkeypatch):
    values = iter(judged)
    monkeypatch.setattr("raytrace.optimization.loss._ROUNDS", 0)  # no descent with denser rays
    monkeypatch.setattr(
        LossDescents,
        "_judged",
        lambda self, descent, function: (dataclasses.replace(descent.state, loss=(loss := next(values))), loss),
    )
    ended = rt.optimize(TRIPLET, loss=low_contrast, of=TRANSFER, **{**FEW, "restarts": 1}).loss
    assert len(set(ended.ends)) == 2
    assert ended.end == ended.ends[int(np.argmin(judged))]


@pytest.mark.parametrize(("quantity", "restarts"), [(Otf(rings=1), 0), (TRANSFER, 2)])
def test_every_evaluation_is_made_once_and_counted(quantity, restarts):
    """By the rays of the descent and by denser ones, with which the first descent of few rays is continued."""
    calls, cycles = [], []

    def counted(otf):
        calls.append(float(otf.abs().sum().detach()))
        return low_contrast(otf)

    options = {**FEW, "restarts": restarts, "cycles": 6, "watch": lambda cycle, lens: cycles.append(cycle.evaluations)}
    result = rt.optimize(TRIPLET, loss=counted, of=quantity, **options)
    assert len(calls) == len({*calls}) == result.evaluations
    assert cycles == sorted(cycles)
    assert 0 < cycles[-1] <= result.evaluations
    assert np.isfinite(result.loss.checked)


def test_an_interrupt_within_a_descent_is_followed_by_no_other(monkeypatch):
    options = {**FEW, "restarts": 2, "cycles": 300, "loss": low_contrast, "of": TRANSFER}
    numbers = []

    def stop_in_second(cycle, lens):
        numbers.append(cycle.merit)
        if len(numbers) > 1 and numbers[-1] > numbers[-2]:  # the first cycle from a displaced lens, worse than the best
            raise KeyboardInterrupt

    found = rt.optimize(TRIPLET, **options, watch=stop_in_second)
    assert (found.stopped, len(found.loss.ends)) == ("interrupted", 2)
    assert found.loss.end == found.loss.ends[0] < found.loss.ends[1]

    minimise_rows = Lifted.minimise_rows
    pre_optimised = []

    def stopped(self, x, **settings):
        pre_optimised.append(dataclasses.replace(minimise_rows(self, x, **settings), stopped="interrupted"))
        return pre_optimised[0]

    monkeypatch.setattr(Lifted, "minimise_rows", stopped)
    found = rt.optimize(TRIPLET, **options)
    assert (found.stopped, len(found.history)) == ("interrupted", 0)
    assert found.variables_after.tolist() == pre_optimised[0].state.x.tolist()


def test_boundaries_of_the_first_rows_are_met_exactly():
    rows = rt.optimization.DefaultMerit("spot", glass_thickness=(3.5, 12.0))
    result = rt.optimize(
        TRIPLET,
        loss=low_contrast,
        of=TRANSFER,
        first=rows,
        vary="thickness:1,3,6 curvature:1-4 sensor",
        restarts=0,
        cycles=8,
    )
    glass = [float(result.lens.surfaces[k].thickness) for k in (1, 3, 6)]
    assert min(glass) > 3.5 - 1e-6
    assert max(glass) < 12.0 + 1e-6


def test_several_object_distances_are_those_of_one_lens():
    """The focal length of the lens is held, and the loss is the mean over the distances."""
    distances, of = [2e3, 4e3, 1e5], Points(rings=4)
    result = rt.optimize(TRIPLET, loss=mean_square, of=of, object_distances=distances, hold="efl=100", cycles=10, **FEW)
    lenses = [result.lens.at(object_distance=distance) for distance in distances]
    assert float(rt.first_order(result.lens).effective_focal_length) == pytest.approx(100, abs=1e-4)
    alone = [float(mean_square(of(lens))) for lens in lenses]
    assert result.loss.end == pytest.approx(sum(alone) / 3, rel=1e-9)


def test_quantities_have_the_axes_that_their_docstrings_say():
    distances = torch.tensor([2e3, 1e5], dtype=torch.float64)
    points, otf = Points(rings=5)(TRIPLET, distances), Otf((20.0,), rings=5)(TRIPLET, distances)
    assert points.shape == (2, 2, 3, 3, 50)
    assert otf.shape == (2, 3, 3, 2, 1)
    kernels = Kernels(pixels=15)(TRIPLET, distances)
    assert kernels.shape == (2, 3, 3, 15, 15)
    assert bool((kernels.sum((-2, -1)) <= 1 + 1e-9).all())


@pytest.mark.parametrize("field", [0, 1])
def test_transfer_functions_of_rays_are_the_geometric_mtf(field):
    lens = TRIPLET.at(wavelengths=[0.5876])
    curves = rt.mtf(lens, frequencies=[10.0, 20.0], geometric=True)
    otf = Otf((10.0, 20.0), rings=24)(lens).abs()[0, field, 0]
    for direction, curve in zip(otf, (curves.tangential, curves.sagittal), strict=True):
        assert torch.allclose(direction, curve[field].reshape(-1)[-2:], atol=2e-3)


def test_what_goes_with_rows_alone_is_refused():
    for given, words in (
        ({"vary": "sensor glass:1"}, "goes with a merit of rows"),
        ({"of": "lens", "object_distances": [1e3]}, "goes with a quantity"),
        ({"merit": mean_square}, "give one; rows to minimise before are `first`"),
        ({"merit": "wavefront"}, "give one; rows to minimise before are `first`"),
        ({"paths": 2}, "`paths` are of a merit of rows"),
        ({"restarts": -1}, "`restarts` -1: expected 0 or more"),
        ({"check_rings": 8}, "expected more than the rings of the descent, 8"),
        ({"object_distances": [1e4, 0.0]}, "expected distances in mm, not 0 or nan"),
    ):
        with pytest.raises(NoProblem, match=words):
            rt.optimize(TRIPLET, **{"loss": mean_square, "vary": "sensor", **given})
    with pytest.raises(ValueError, match="did you mean points"):
        rt.optimize(TRIPLET, loss=mean_square, of="point", vary="sensor")


@pytest.mark.parametrize("merit", ["spot", mean_square])
def test_what_goes_with_a_loss_alone_is_refused(merit):
    """A reader of a result of rows would believe that the distances count."""
    for given in ({"object_distances": [1e4]}, {"of": "otf"}, {"restarts": 7}, {"check_rings": 30}, {"first": None}):
        with pytest.raises(NoProblem, match=rf"`{next(iter(given))}` goes with `loss`"):
            rt.optimize(TRIPLET, merit=merit, vary="sensor", **given)
    with pytest.raises(NoProblem, match="`object_distances` goes with `loss`"):
        rt.search(TRIPLET, object_distances=[1e4])


@pytest.mark.parametrize(
    ("loss", "of", "words"),
    [
        (lambda points: mean_square(points).detach(), "points", "no derivative by the variables"),
        (lambda points: float(mean_square(points)), "points", r"the loss is .*; expected a tensor of one number"),
        (lambda points: points.std(-1), "points", r"has the shape \(2, 1, 3, 3\); expected one number"),
        (lambda otf: (1 - otf).mean(), "otf", r"is complex; expected a real number: take \.abs\(\)"),
    ],
)
def test_what_is_no_loss_is_refused(loss, of, words):
    with pytest.raises(NoProblem, match=words):
        rt.optimize(TRIPLET, loss=loss, of=of, first=None, **FEW)
    with pytest.raises(TypeError, match=r"quantity as Points\(rings=12\)"):
        rt.optimize(TRIPLET, loss=low_contrast, of=Otf, **FEW)


def test_another_loss_of_the_same_name_does_not_resume(tmp_path):
    """Its stored values would be those of the other one."""
    kept = tmp_path / "kept.json"

    def of_power(power):
        return lambda otf: (1 - otf.abs() ** power).mean()

    how = {"of": TRANSFER, "first": None, **FEW}
    rt.optimize(TRIPLET, loss=of_power(1), cycles=2, checkpoint=kept, **how)
    with pytest.raises(rt.BadCheckpoint, match="another function than that of the checkpoint"):
        rt.optimize(TRIPLET, loss=of_power(4), cycles=4, resume=kept, **how)
    again = rt.optimize(TRIPLET, loss=of_power(1), cycles=4, resume=kept, **how)
    assert again.merit_after == rt.optimize(TRIPLET, loss=of_power(1), cycles=4, **how).merit_after


def test_both_ends_of_the_headline_are_of_the_same_rays():
    few = rt.optimize(TRIPLET, loss=low_contrast, of=Otf(rings=2), cycles=60, **FEW)
    assert few.loss.refined
    rings = 2 * 2**few.loss.refined
    assert few.merit_before == few.loss.start_refined
    assert few.merit_before == pytest.approx(float(low_contrast(Otf(rings=rings)(TRIPLET))), rel=1e-12)
    assert few.merit_after == pytest.approx(float(low_contrast(Otf(rings=rings)(few.lens))), rel=1e-9)
    assert f"({few.loss.first_cycles} of pre-optimisation)" in str(few)
    assert few.loss.first_cycles > 0


def test_a_descent_begins_at_the_start_where_rays_fail_at_the_best_spots():
    def needs_its_sensor(lens):
        """A loss without a value where the sensor has moved by more than 0.1 mm."""
        moved = lens.surfaces[-2].thickness - TRIPLET.surfaces[-2].thickness
        return torch.where(moved.abs() < 0.1, 2.0 + moved + moved**2, torch.nan)

    result = rt.optimize(TRIPLET, loss=needs_its_sensor, of="lens", vary="sensor", restarts=0)
    assert np.isnan(result.loss.first)
    assert result.loss.end < result.loss.start
    assert "rays that the loss needs fail after pre-optimisation" in str(result)


# -- configurations, pictures, rings of the check


def test_a_loss_has_all_configurations_along_the_axis_of_distances():
    zoom = TRIPLET.with_configurations(thickness={4: [2.0, 3.0]})
    shapes = []

    def loss(points):
        shapes.append(points.shape)
        return mean_square(points)

    result = rt.optimize(
        zoom, loss=loss, of=Points(4), object_distances=[5e3, 1e5], first=None, restarts=0, cycles=2,
        vary="curvature:1-4 thickness:4", hold="efl@1=101.18",
    )  # fmt: skip
    assert shapes[0][1] == 4
    each = [Points(4)(view, torch.tensor([5e3, 1e5])) for view in result.lens.configurations]
    assert float(mean_square(torch.cat(each, 1))) == pytest.approx(result.merit_after, rel=1e-9)
    assert float(rt.first_order(result.lens.configuration(1)).effective_focal_length) == pytest.approx(101.18, rel=1e-6)


def test_pictures_are_those_of_the_kernels_and_lower_a_loss():
    scenes = torch.rand(2, 1, 40, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    kernels = Kernels(pixel=0.01, pixels=15, order=3)
    of = rt.imaging.LensPictures(scenes, kernels)
    pictures = of(TRIPLET, torch.tensor([2e4, 1e5]))
    spread = kernels(TRIPLET, torch.tensor([2e4, 1e5]))
    assert pictures.shape == (2, 2, 3, 3, 26, 26)
    expected = rt.imaging.blur(scenes[1, 0], spread[1, 2, 0])
    assert torch.allclose(pictures[1, 1, 2, 0], expected, atol=1e-12)
    sharp = scenes[:, None, None, :, 7:-7, 7:-7]
    result = rt.optimize(
        TRIPLET, loss=lambda seen: (seen - sharp).square().mean(), of=of, vary="sensor curvature:6",
        first=None, restarts=0, cycles=3,
    )  # fmt: skip
    assert result.merit_after < 0.9 * result.merit_before
    with pytest.raises(ValueError, match="LensPictures"):
        rt.optimize(TRIPLET, loss=mean_square, of="pictures", **FEW)


def test_the_rings_of_the_check_may_be_given():
    rays = []

    def loss(points):
        rays.append(points.shape[-1])
        return mean_square(points)

    rt.optimize(TRIPLET, loss=loss, of=Points(3), check_rings=9, first=None, cycles=1, **FEW)
    assert rays[-1] == Points(9)(TRIPLET).shape[-1]
    with pytest.raises(NoProblem, match="check_rings"):
        rt.optimize(TRIPLET, loss=lambda lens: lens.wavelengths.sum(), of="lens", check_rings=9, **FEW)
