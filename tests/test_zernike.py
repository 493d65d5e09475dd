"""Zernike polynomials: published tables, orthonormality, exact fits."""

import math

import pytest
import torch

from raytrace.maths import zernike
from raytrace.maths.sampling import gauss_rings

EXACT = 1e-12  # rounding of sums over a few thousand points


def disc(rings=12, arms=48):
    points, weights = gauss_rings(rings, arms)
    return points[0], points[1], weights


def test_indices_follow_the_published_tables():
    assert [zernike.noll(j) for j in range(1, 12)] == [
        (0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0),
    ]  # fmt: skip
    assert [zernike.fringe(j) for j in range(1, 17)] == [
        (0, 0), (1, 1), (1, -1), (2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (4, 0), (3, 3), (3, -3), (4, 2), (4, -2),
        (5, 1), (5, -1), (6, 0),
    ]  # fmt: skip
    # The 37th term of interferogram reports is the pure twelfth order; those it displaces follow.
    assert [zernike.fringe(j) for j in (36, 37, 38, 39, 49, 50)] == [
        (10, 0), (12, 0), (6, 6), (6, -6), (11, -1), (7, 7),
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["noll", "fringe"])
def test_every_index_names_one_polynomial(name):
    orders = [getattr(zernike, name)(j) for j in range(1, 301)]
    assert len(set(orders)) == 300
    assert all(n >= abs(m) and (n - m) % 2 == 0 for n, m in orders)
    with pytest.raises(ValueError, match="the first is 1"):
        getattr(zernike, name)(0)


def test_polynomials_are_orthonormal_over_the_disc():
    x, y, w = disc()
    z = zernike.polynomials([zernike.noll(j) for j in range(1, 67)], x, y)
    assert ((z * w) @ z.T - torch.eye(66, dtype=w.dtype)).abs().max() < EXACT


def test_polynomials_are_the_textbook_ones():
    x, y, _ = disc(3, 7)
    r, theta = torch.hypot(x, y), torch.atan2(y, x)
    found = zernike.polynomials([zernike.noll(j) for j in (3, 4, 8, 11, 22)], x, y)
    expected = [
        2 * r * torch.sin(theta),
        math.sqrt(3) * (2 * r**2 - 1),
        math.sqrt(8) * (3 * r**3 - 2 * r) * torch.cos(theta),
        math.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
        math.sqrt(7) * (20 * r**6 - 30 * r**4 + 12 * r**2 - 1),
    ]
    assert (found - torch.stack(expected)).abs().max() < EXACT


def test_high_orders_keep_their_digits_at_the_edge():
    one, zero = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    for n, m in [(60, 0), (61, 31), (80, 40), (100, 0)]:
        value = zernike.polynomials([(n, m)], one, zero)[0, 0]
        assert abs(value / zernike.norm(n, m) - 1) < EXACT


def test_gradients_are_those_of_autograd_and_finite_at_the_centre():
    x = torch.tensor([0.0, 0.3, -0.6], dtype=torch.float64, requires_grad=True)
    y = torch.tensor([0.0, -0.2, 0.7], dtype=torch.float64, requires_grad=True)
    orders = [zernike.noll(j) for j in range(2, 120)]
    by_x, by_y = zernike.gradients(orders, x.detach(), y.detach())
    for j, order in enumerate(orders):
        z = zernike.polynomials([order], x, y).sum()
        found = torch.autograd.grad(z, (x, y), allow_unused=True, materialize_grads=True)
        assert (torch.stack(found) - torch.stack([by_x[j], by_y[j]])).abs().max() < EXACT


def test_fit_finds_the_coefficients_whatever_is_cut_out_of_the_disc():
    x, y, w = disc(8, 32)
    basis = zernike.polynomials([zernike.noll(j) for j in range(1, 16)], x, y)
    true = torch.linspace(-1, 1, 15, dtype=w.dtype)
    values = true @ basis
    cut = torch.where(torch.hypot(x - 0.3, y) > 0.4, w, 0.0)
    spoiled = torch.where(cut > 0, values, 1e6)
    assert (zernike.fit(values, basis, w) - true).abs().max() < EXACT
    assert (zernike.fit(torch.stack([values, spoiled]), basis, torch.stack([w, cut]))[1] - true).abs().max() < EXACT
    with pytest.raises(ValueError, match="cannot fit 15"):
        zernike.fit(values, basis, torch.where(torch.arange(len(w)) < 3, w, 0.0))


def test_wrong_orders_are_refused():
    with pytest.raises(ValueError, match="n = 2, m = 1"):
        zernike.polynomials([(2, 1)], torch.zeros(1), torch.zeros(1))


def test_condition_is_one_on_the_whole_disc_and_grows_as_light_fills_less_of_it():
    points, weights = gauss_rings(14, 56)
    basis = zernike.polynomials([zernike.noll(j) for j in range(1, 38)], *points)
    radius = torch.linalg.vector_norm(points, dim=0)
    parts = torch.stack([weights * (radius < r) for r in (1.0, 0.9, 0.7, 0.5, 0.05)])
    found = zernike.condition(basis, parts)
    assert found[0].item() == pytest.approx(1, rel=1e-12)
    assert (found.diff()[:3] > 0).all()
    assert found[2].item() == pytest.approx(torch.linalg.cond(parts[2].sqrt()[:, None] * basis.T).item(), rel=1e-6)
    assert found[-1].isinf()
