"""Pupil rules: weights sum to 1, moments of the disc exact to the promised degree, seeds reproducible."""

import math
import time

import numpy as np
import pytest
import torch

from raytrace.maths.sampling import SAMPLINGS, fan, gauss_legendre, gauss_rings, hexapolar, random, sobol, square

ROUNDING = 2.0**-53
RULES = {
    "gauss": lambda: gauss_rings(4),
    "hexapolar": lambda: hexapolar(5),
    "square": lambda: square(20),
    "sobol": lambda: sobol(256),
    "random": lambda: random(256),
}


def moment(i: int, j: int) -> float:
    """(1/π) ∬ x^i y^j over the unit disc: 0 for an odd power, else 2 (i-1)!! (j-1)!! / ((i+j+2)!!)·…, by Γ."""
    if i % 2 or j % 2:
        return 0.0
    a, b = (i + 1) / 2, (j + 1) / 2
    return 2 * math.gamma(a) * math.gamma(b) / math.gamma(a + b) / (i + j + 2) / math.pi


@pytest.mark.parametrize("name", RULES)
def test_weights_sum_to_one_and_points_lie_in_the_disc(name):
    points, weights = RULES[name]()
    assert points.shape == (2, *weights.shape)
    assert abs(weights.sum().item() - 1) <= 1e-14  # a few hundred additions
    assert (weights > 0).all()
    assert (points[0] ** 2 + points[1] ** 2).max() <= 1 + 4 * ROUNDING


@pytest.mark.parametrize("rings", [1, 2, 3, 6, 10])
def test_gauss_rings_are_exact_to_their_degree(rings):
    points, weights = gauss_rings(rings)
    for i in range(4 * rings):
        for j in range(4 * rings - i):
            if i + j <= 4 * rings - 2:
                found = (weights * points[0] ** i * points[1] ** j).sum().item()
                assert abs(found - moment(i, j)) <= 100 * ROUNDING, (i, j)


def test_gauss_rings_are_not_exact_beyond_their_degree():
    points, weights = gauss_rings(2)
    r_squared = points[0] ** 2 + points[1] ** 2
    assert abs((weights * r_squared**4).sum().item() - 1 / 5) > 1e-4


def test_gauss_arms_resolve_as_many_harmonics():
    points, weights = gauss_rings(3, arms=7)
    angle = torch.atan2(points[1], points[0])
    for m in range(1, 7):
        assert abs((weights * torch.cos(m * angle)).sum().item()) <= 20 * ROUNDING
    assert abs(abs((weights * torch.cos(7 * angle)).sum().item()) - 1) <= 20 * ROUNDING


@pytest.mark.parametrize(("rule", "sizes", "order"), [(hexapolar, (8, 16, 32), 1.8), (square, (32, 64, 128), 0.9)])
def test_rules_converge_to_the_mean_of_a_smooth_function(rule, sizes, order):
    """f = 1/(1.2 - x): mean over the disc 2 (1.2 - √(1.44 - 1)); the error falls with the size to the order given."""
    exact = 2 * (1.2 - math.sqrt(0.44))
    errors = []
    for size in sizes:
        points, weights = rule(size)
        errors.append(abs((weights / (1.2 - points[0])).sum().item() - exact))
    assert math.log2(errors[0] / errors[-1]) / 2 >= order, errors


@pytest.mark.parametrize("rule", [sobol, random])
def test_points_are_those_of_their_seed(rule):
    one, other, again = rule(64, seed=1)[0], rule(64, seed=2)[0], rule(64, seed=1)[0]
    assert torch.equal(one, again)
    assert not torch.equal(one, other)


def test_global_random_state_is_neither_read_nor_changed():
    torch.manual_seed(3)
    before = torch.get_rng_state()
    first = random(16)[0]
    sobol(16)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(4)
    assert torch.equal(random(16)[0], first)


def test_generator_is_advanced():
    generator = torch.Generator().manual_seed(7)
    assert not torch.equal(random(8, generator=generator)[0], random(8, generator=generator)[0])


@pytest.mark.parametrize(("name", "tolerance"), [("sobol", 2e-3), ("random", 6e-2)])
def test_stochastic_rules_fill_the_area_evenly(name, tolerance):
    """Mean of r² is 1/2: to about N⁻¹ for Sobol points, to three sigma 3·0.29/√256 for independent ones."""
    points, weights = RULES[name]()
    assert abs((weights * (points**2).sum(0)).sum().item() - 0.5) <= tolerance


@pytest.mark.parametrize("name", SAMPLINGS)
def test_samplings_by_name_take_one_size_and_a_dtype(name):
    points, weights = SAMPLINGS[name][0](4, dtype=torch.float32)
    assert points.dtype == weights.dtype == torch.float32


def test_patterns_are_symmetric_where_promised():
    for points, _ in (gauss_rings(3), square(9)):
        for flip in ([-1.0, 1.0], [1.0, -1.0]):
            mirrored = points * torch.tensor(flip, dtype=torch.float64)[:, None]
            distance = (mirrored[:, :, None] - points[:, None, :]).abs().amax(0).amin(1)
            assert distance.max() <= 20 * ROUNDING


def test_smallest_sizes():
    assert fan(1)[0].tolist() == [[0.0], [0.0]]
    assert fan(3, "x")[0].tolist() == [[-1.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    assert square(1)[0].tolist() == [[0.0], [0.0]]
    assert gauss_rings(1)[1].sum() == 1.0


@pytest.mark.parametrize("count", [257, 600])
def test_many_gauss_points_are_those_of_eigenvalues_and_exact(count):
    """∫ x^k dx = 2 / (k + 1) up to k = 2n - 1; the weights of eigenvalues err by ten times as much."""
    nodes, weights = gauss_legendre(count)
    assert abs(nodes - np.polynomial.legendre.leggauss(count)[0]).max() <= 4 * ROUNDING
    for k in (2, count // 2 * 2, 2 * count - 2):
        assert (weights * nodes**k).sum() == pytest.approx(2 / (k + 1), rel=3e-12)


def test_thousands_of_gauss_points_integrate_a_thousand_oscillations():
    """In 0.1 s; ∫ cos 6000 x dx = 2 sin(6000) / 6000, exact to rounding for n well above 3000."""
    began = time.process_time()
    nodes, weights = gauss_legendre(5000)
    assert time.process_time() - began < 5
    assert abs((weights * np.cos(6000 * nodes)).sum() - math.sin(6000) / 3000) <= 100 * ROUNDING
