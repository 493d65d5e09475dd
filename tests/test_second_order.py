"""Second order within limits of compensators: minima of a quadratic form, and lenses that are traced."""

import dataclasses

import pytest
import torch
from scipy.optimize import minimize

import raytrace as rt
from raytrace.tolerancing.second_order import SecondOrder

pytestmark = pytest.mark.filterwarnings("ignore::raytrace.UnfilledStop")


def form(limit):
    """A form of three errors and two compensators that act on each other."""
    numbers = torch.Generator().manual_seed(4)

    def draw(*shape):
        return torch.randn(*shape, generator=numbers, dtype=torch.float64)

    curvature = torch.tensor([[2.0, 1.2], [1.2, 1.5]], dtype=torch.float64)
    half, limits = draw(3, 3), torch.full((2,), limit, dtype=torch.float64)
    return SecondOrder(
        torch.tensor(5.0).double(), draw(3), half @ half.T, draw(2), draw(3, 2), curvature, -limits, 0.5 * limits
    )


def test_compensators_are_at_the_minimum_within_their_limits():
    model = form(0.3)
    errors = torch.randn(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    q, _ = model(errors)
    for e, least in zip(errors, q.tolist(), strict=True):
        best = model.start + e @ model.response

        def whole(c, best=best, e=e):
            pull = torch.as_tensor(c) - best
            return float(model.q0 + model.g @ e + 0.5 * e @ model.H @ e + 0.5 * pull @ model.curvature @ pull)

        found = minimize(whole, [0.0, 0.0], bounds=[(-0.3, 0.15)] * 2, options={"ftol": 1e-15, "gtol": 1e-9})
        assert least == pytest.approx(found.fun, rel=1e-8)


@pytest.mark.parametrize("limit", [0.3, torch.inf])
def test_derivatives_by_errors(limit):
    model = form(limit)
    errors = torch.randn(4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    step = 1e-5 * torch.eye(3, dtype=torch.float64)
    differences = torch.stack([(model(errors + s)[0] - model(errors - s)[0]) / 2e-5 for s in step], -1)
    torch.testing.assert_close(model(errors)[1], differences, rtol=1e-7, atol=1e-7)


def test_means_without_limits_are_exact_and_those_within_are_of_many_draws():
    mean, variance = torch.tensor([0.1, 0.0, -0.2]).double(), torch.tensor([0.02, 0.05, 0.01]).double()
    errors = mean + variance.sqrt() * torch.randn(2**18, 3, generator=torch.Generator().manual_seed(3)).double()
    for limit in (torch.inf, 0.3):
        model = form(limit)
        q = model(errors)[0]
        assert float(q.min()) > 0
        _, expected, square, negative = model.means(errors[:4096], mean, variance, torch.sqrt)
        assert float(expected) == pytest.approx(float(q.sqrt().mean()), abs=0.003)
        assert float(square) == pytest.approx(float(q.mean()), abs=0.02)
        assert float(negative) == 0


def held(lens, limits):
    return rt.tolerances(lens, limits, compensators=[rt.system.Compensator(7, minimum=-0.1, maximum=0.1)])


@pytest.mark.slow
def test_expectation_within_limits_of_the_sensor_is_the_mean_of_the_trials(focused_triplet):
    rows = held(focused_triplet, "radius=0.1% air=0.05 element_decenter=0.05")
    found = rt.tolerance(focused_triplet, rows, trials=400, seed=7)
    free = rt.tolerance(focused_triplet, dataclasses.replace(rows, compensators=(rt.system.Compensator(7),)), trials=0)
    assert found.at_limit(0) > 100
    assert float(found.expected) > 1.05 * float(free.expected)  # limits that the expectation feels
    error = float(found.trials.std()) / len(found.trials) ** 0.5
    assert abs(float(found.expected - found.trials.mean())) < 3 * error
    assert not found.holds


@pytest.mark.slow
def test_a_yield_within_limits_of_the_sensor_is_that_of_unseen_trials(focused_triplet):
    rows = rt.tolerances(
        focused_triplet, grade="precision", compensators=held(focused_triplet, "radius=1%").compensators
    )
    tight = rt.tolerance(focused_triplet, rows, trials=0, goal=24.0, yield_=0.9, workshop="any")
    unseen = rt.tolerance(focused_triplet, tight.tolerances, trials=2000, seed=77, goal=24.0)
    assert unseen.yield_at(24.0) == pytest.approx(0.9, abs=3 * (0.9 * 0.1 / 2000) ** 0.5)
    assert unseen.summary()["yield_by_second_order"] == pytest.approx(0.9, abs=0.01)


def test_a_model_that_does_not_hold_says_so(focused_triplet):
    """Decentres far beyond second order."""
    found = rt.tolerance(focused_triplet, held(focused_triplet, "element_decenter:3=6"), trials=64)
    assert found.holds
    assert not found.summary()["second_order_holds"]
    assert "the second order does not hold" in str(found)
