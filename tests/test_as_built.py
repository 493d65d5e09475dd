"""The lens as built as a term of a merit function: its expectation, its derivatives and its place in `optimize`."""

import numpy as np
import pytest
import scipy.optimize
import torch

import raytrace as rt
from raytrace.maths.numerics import Dual
from raytrace.optimization.variables import design_variables
from raytrace.system.lens import with_sensor_distance
from raytrace.tolerancing.as_built import design, hadamard
from raytrace.tolerancing.study import moments
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.spot import image_rays

pytestmark = pytest.mark.filterwarnings("ignore::raytrace.tracing.launch.UnfilledStop")

FEW = "radius:1,3=0.2% thickness:3=0.05 element_decenter:3=0.05 element_tilt:1=0.1"


@pytest.fixture(scope="module", name="cooke")
def cooke_in_colours():
    lens = rt.read_lens("cooke_triplet")
    assert len(lens.wavelengths) == 3
    return lens


def states(lens, vary):
    free = design_variables(lens, vary)
    model = free
    return model.start, lambda x: model.views[0].state(x)


def lens_weights(lens):
    return lens.wavelength_weights / lens.wavelength_weights.sum()


@pytest.mark.parametrize(("least", "order"), [(1, 1), (2, 2), (3, 4), (13, 16), (20, 20), (48, 48), (80, 80), (86, 88)])
def test_hadamard_matrices(least, order):
    matrix = hadamard(least)
    assert len(matrix) == order
    assert (matrix[:, 0] == 1).all()
    assert (np.abs(matrix) == 1).all()
    assert (matrix.T @ matrix == order * np.eye(order)).all()


def test_the_sample_has_the_means_and_variances_of_the_tolerances(cooke):
    tolerances = rt.tolerances(cooke, "radius=-0.1..0.3 thickness=0.05 irregularity=0.5", distribution="uniform")
    errors = design(tolerances).numpy()
    mean, variance = (np.array(part) for part in zip(*map(moments, tolerances), strict=True))
    angle = np.array([row.kind == "irregularity_angle" for row in tolerances])
    assert np.abs(errors.mean(0) - mean)[~angle].max() < 1e-15
    spread = np.cov(errors.T, bias=True)
    assert np.abs(spread - np.diag(variance))[~angle][:, ~angle].max() < 1e-15
    twice = np.deg2rad(2 * errors[:, angle])
    for number, expected in ((np.cos(twice), 0), (np.cos(twice) ** 2, 0.5), (np.cos(twice) * np.sin(twice), 0)):
        assert np.abs(number.mean(0) - expected).max() < 1e-14


def test_a_lens_of_the_sample_is_refocused(cooke):
    """Against the spots of its rays on sensors among which a search finds the best."""
    term = rt.tolerancing.AsBuilt(limits="radius:1=0.3%", fields=[0, 8.4]).of(cooke)
    bent = rt.tolerancing.perturbed(cooke, term.tolerances, [0.3])
    points, weights = rt.maths.gauss_rings(3, 6)
    weights = (lens_weights(cooke)[:, None] * weights).flatten().numpy()

    def square(distance):
        lens = with_sensor_distance(bent, torch.tensor(distance, dtype=torch.float64))
        hits = image_rays(lens, points, fields=torch.tensor([[0.0, 0.0], [0.0, 8.4]], dtype=torch.float64)).position[:2]
        spots = hits.flatten(-2).numpy()
        return 0.5 * sum(np.cov(spot, aweights=weights, bias=True).trace() for spot in spots.swapaxes(0, 1))

    best = scipy.optimize.minimize_scalar(square, bracket=(77.0, 78.0), tol=1e-9)
    q = term.mean_squares(cooke, torch.tensor([[0.3]], dtype=torch.float64))
    assert abs(float(q) / best.fun - 1) < 1e-9


def test_expectation_against_random_lenses(cooke):
    settings = rt.tolerancing.AsBuilt(limits=FEW)
    term = settings.of(cooke)
    errors = rt.tolerancing.draw_errors(term.tolerances, 1500, seed=3)
    q = term.mean_squares(cooke, torch.cat([errors, -errors])).reshape(2, -1).mean(0)
    uncertainty = float(q.std()) / len(q) ** 0.5
    assert uncertainty < 0.002 * float(q.mean())
    assert abs(float(term.expected(cooke) - q.mean())) < 3.5 * uncertainty
    assert float(term.nominal(cooke)) < 0.99 * float(term.expected(cooke))


def test_expectation_against_second_derivatives(cooke):
    """`rt.tolerance` has the same expectation from differences of gradients."""
    few = "element_decenter:3=0.05 radius:3=0.2%"
    second = rt.tolerance(cooke, limits=few, trials=0, rings=3, arms=6)
    term = rt.tolerancing.AsBuilt(limits=few).of(cooke)
    increase = 1e-6 * float(second.expected_square) - float(term.nominal(cooke))
    assert abs(float(term.expected(cooke) - term.nominal(cooke)) / increase - 1) < 0.01


def test_residuals_and_their_derivatives(cooke):
    """The Jacobian by forward derivatives against the gradient of E[q] by the adjoint, and against differences."""
    start, state = states(cooke, "curvature:1,3,6 thickness:2,5 sensor")
    term = rt.tolerancing.AsBuilt(limits="element_decenter:3=0.05 element_tilt:1=0.1", weight=2.0).of(cooke)
    residuals, jacobian, lost = term.residuals(state(Dual(start, np.eye(len(start)))), 0.5)
    assert lost == 0
    assert abs(residuals @ residuals / (8 * float(term.expected(cooke))) - 1) < 1e-12
    numbers = {
        (k, name): torch.tensor(float(getattr(cooke.surfaces[k], name)), dtype=torch.float64, requires_grad=True)
        for k, name in [(1, "curvature"), (3, "curvature"), (6, "curvature"), (2, "thickness"), (5, "thickness")]
    }
    lens = cooke
    for (k, name), number in numbers.items():
        lens = lens.replace(k, **{name: number})
    gradient = torch.autograd.grad(8 * term.expected(lens), list(numbers.values()))
    slopes = 2 * jacobian.T @ residuals
    assert np.allclose(slopes[:5], [float(g) for g in gradient], rtol=1e-9, atol=1e-14)
    assert abs(slopes[5]) < 1e-15  # the sensor is refocused
    for k, step in ((1, 1e-6), (4, 1e-3)):
        ends = [term.residuals(state(start + sign * step * np.eye(len(start))[k]), 0.5)[0] for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step)
        assert np.abs(difference - jacobian[:, k]).max() < 1e-5 * np.abs(jacobian[:, k]).max()


def test_without_the_compiled_trace(cooke):
    start, state = states(cooke, "curvature:3 thickness:2")
    term = rt.tolerancing.AsBuilt(limits="element_decenter:3=0.05").of(cooke)
    at = state(Dual(start, np.eye(2)))
    compiled = term.residuals(at, 1.0)
    with trace_engine("eager"):
        eager = term.residuals(at, 1.0)
        assert np.allclose(term.residuals(state(start), 1.0)[0], compiled[0], rtol=1e-10, atol=1e-14)
    for one, other in zip(compiled[:2], eager[:2], strict=True):
        assert np.allclose(one, other, rtol=1e-8, atol=1e-12)


@pytest.mark.slow
def test_aimed_rays(cooke):
    lens = cooke.at(ray_aiming="real")
    start, state = states(lens, "curvature:3")
    term = rt.tolerancing.AsBuilt(limits="element_decenter:3=0.05", rings=2).of(lens)
    jacobian = term.residuals(state(Dual(start, np.eye(1))), 1.0)[1]
    ends = [term.residuals(state(start + step), 1.0)[0] for step in (1e-6, -1e-6)]
    assert np.abs((ends[0] - ends[1]) / 2e-6 - jacobian[:, 0]).max() < 1e-5 * np.abs(jacobian[:, 0]).max()


def test_optimize_lowers_the_expectation(cooke):
    """Of random lenses of another sample."""
    settings = {"merit": "spot", "vary": "curvature:1-4 thickness:2,5 sensor", "hold": "efl=101.2"}
    as_built = rt.tolerancing.AsBuilt(limits="element_decenter=0.2", weight=20.0, rings=2)
    usual = rt.optimize(cooke, cycles=25, **settings)
    robust = rt.optimize(usual.lens, as_built=as_built, cycles=5, **settings)
    expected = []
    for lens in (usual.lens, robust.lens):
        term = rt.tolerancing.AsBuilt(limits="element_decenter=0.2").of(lens)
        expected.append(float(term.mean_squares(lens, rt.tolerancing.draw_errors(term.tolerances, 400, seed=8)).mean()))
    assert expected[1] < 0.995 * expected[0]
    assert abs(float(rt.first_order(robust.lens).effective_focal_length) - 101.2) < 1e-6
    change = robust.as_built
    assert change.nominal[1] < change.expected[1] < change.expected[0]
    assert robust.merit_after < robust.merit_before
    assert abs(robust.merit_after / float(robust.history[-1, 0]) - 1) < 1e-12
    assert "as built (6 tolerances, of limits, weight 20): expected" in str(robust)
    assert robust.document()["as_built"]["expected"] == list(change.expected)
    assert usual.as_built is None


@pytest.mark.slow
def test_weight_is_relative_to_all_rows_but_boundaries(cooke):
    """Of a merit function of spots M² is the mean square spot of the nominal lens, and E[q] counts alike."""
    lens = rt.focus(cooke, fields=[0, 8.4, 11.9]).lens
    expected, ratios = float(rt.tolerancing.AsBuilt(limits=FEW).of(lens).expected(lens)), []
    for merit in (
        rt.optimization.DefaultMerit("spot"),
        rt.optimization.DefaultMerit("spot", glass_thickness=(1, 20), edge=0.5),
    ):
        nominal = float(rt.evaluate(lens, merit=merit).merit) ** 2
        for weight in (1.0, 3.0):
            settings = rt.tolerancing.AsBuilt(limits=FEW, weight=weight)
            end = rt.optimize(lens, merit=merit, vary="sensor", cycles=0, as_built=settings)
            ratios.append((end.merit_before**2 - nominal) / (weight * nominal))
    assert np.allclose(ratios, ratios[0], rtol=1e-9)
    assert abs(ratios[0] * float(rt.evaluate(lens, merit="spot").merit) ** 2 / expected - 1) < 1e-9
    assert 1.05 < ratios[0] < 1.3


def test_errors(cooke):
    spots = {"merit": "spot", "vary": "curvature:1", "cycles": 1}
    for weight in (0.0, -1.0, float("inf")):
        with pytest.raises(ValueError, match="above 0"):
            rt.tolerancing.AsBuilt("precision", weight=weight)
    with pytest.raises(ValueError, match="leave `grade` and `limits` out"):
        rt.tolerancing.AsBuilt("precision", tolerances=rt.tolerances(cooke, "radius=0.1"))
    with pytest.raises(rt.BadTolerance, match="no tolerances of its own"):
        rt.optimize(cooke, as_built=rt.tolerancing.AsBuilt(), **spots)
    with pytest.raises(rt.BadTolerance, match="precision"):
        rt.optimize(cooke, as_built=rt.tolerancing.AsBuilt("precise"), **spots)
    tolerances = rt.tolerances(cooke, "radius=0.1", compensators=[rt.system.Compensator(2)])
    with pytest.raises(rt.BadTolerance, match="the distance of a plane sensor"):
        rt.optimize(cooke, as_built=rt.tolerancing.AsBuilt(tolerances=tolerances), **spots)
    with pytest.raises(rt.BadTolerance, match="no ray of a field"):
        rt.optimize(cooke, as_built=rt.tolerancing.AsBuilt("precision", fields=[80]), **spots)
    merit = lambda lens: lens.surfaces[1].curvature.reshape(())  # noqa: E731
    with pytest.raises(rt.NoProblem, match="goes with a merit of rows"):
        rt.optimize(cooke, merit=merit, vary="curvature:1", as_built=rt.tolerancing.AsBuilt("precision"))
    with pytest.raises(TypeError, match="as_built"):
        rt.optimize(cooke, as_built="precision", **spots)


@pytest.mark.slow
def test_search_orders_minima_by_the_merit_as_built(cooke):
    """The same minima as without, in another order, each with the figures of `optimize`."""
    lens = cooke.at(f_number=5, fields=[0, 8])
    settings = {"merit": "spot", "vary": "curvature:1,4 sensor", "hold": "efl=101.2", "starts": 3}
    as_built = rt.tolerancing.AsBuilt(limits="element_decenter:3=0.2", weight=5.0, rings=2)
    usual, ranked = rt.search(lens, **settings), rt.search(lens, as_built=as_built, **settings)
    assert sorted(usual.merit.tolist()) == sorted(ranked.merit.tolist())
    merit, expected, nominal = ranked.as_built.unbind(-1)
    assert (merit.diff() >= 0).all()
    for k, one in enumerate(ranked.lenses[:2]):
        end = rt.optimize(one, merit="spot", vary="sensor", cycles=0, as_built=as_built)
        assert abs(float(merit[k]) / end.merit_before - 1) < 1e-9
        assert abs(float(expected[k]) / end.as_built.expected[0] - 1) < 1e-12
        assert abs(float(nominal[k]) / end.as_built.nominal[0] - 1) < 1e-12
    assert "merit_as_built" in ranked.columns()
    assert "in the order of the merit as built: of limits, weight 5" in str(ranked)
    assert usual.as_built is None
    with pytest.raises(rt.BadTolerance, match="no tolerances of its own"):
        rt.search(lens, as_built=rt.tolerancing.AsBuilt(), **settings)
