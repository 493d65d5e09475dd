"""Guarded arithmetic: values, and gradients that stay finite where the textbook form gives NaN."""

import pytest
import torch
from differences import gradcheck, gradgradcheck

from raytrace.maths.numerics import dot, polynomial, safe_divide, safe_sqrt, unit

ROUNDING = 2.0**-53


def tensor(*numbers):
    return torch.tensor(numbers, dtype=torch.float64, requires_grad=True)


def test_safe_sqrt_is_sqrt_where_positive_and_zero_elsewhere():
    x = tensor(4.0, 0.0, -1.0, 5e-324, float("inf"), float("nan"), -float("inf"))
    y = safe_sqrt(x)
    assert y.tolist() == [2.0, 0.0, 0.0, 5e-324**0.5, float("inf"), 0.0, 0.0]
    (gradient,) = torch.autograd.grad(y[:3].sum() + y[5:].sum(), x)
    assert gradient.tolist() == [0.25, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_safe_divide_is_division_and_zero_by_zero_is_zero():
    a, b = tensor(1.0, 1.0, 0.0, -3.0), tensor(4.0, 0.0, 0.0, 2.0)
    y = safe_divide(a, b)
    assert y.tolist() == [0.25, 0.0, 0.0, -1.5]
    for gradient, expected in zip(
        torch.autograd.grad(y.sum(), (a, b)), ([0.25, 0, 0, 0.5], [-1 / 16, 0, 0, 0.75]), strict=True
    ):
        assert gradient.tolist() == expected


def test_second_derivatives_of_guarded_functions():
    x = tensor(0.3, 2.0, -1.0)
    assert gradcheck(safe_sqrt, x)
    assert gradgradcheck(safe_sqrt, x)
    d = tensor(0.5, -2.0, 3.0)
    assert gradcheck(safe_divide, (x, d))
    assert gradgradcheck(safe_divide, (x, d))


@pytest.mark.parametrize("factor", [1.0, 1e-200, 1e200, 5e-324 / 2.0**-1074, 2.0**-1040])
def test_unit_has_length_one_at_every_scale(factor):
    vector = torch.tensor([[3.0, -0.1], [4.0, 0.2], [12.0, 0.3]], dtype=torch.float64) * factor
    direction = unit(vector)
    assert (torch.linalg.vector_norm(direction, dim=0) - 1).abs().max() <= 2 * ROUNDING
    # A denormal component keeps fewer digits: 2^-1040 leaves 34 bits.
    tolerance = 1e-9 if factor < 1e-300 else 3 * ROUNDING
    exact = torch.tensor([3 / 13, 4 / 13, 12 / 13], dtype=torch.float64)
    assert (direction[:, 0] - exact).abs().max() <= tolerance


def test_unit_of_nothing_is_zero_with_zero_gradient():
    nan, inf = float("nan"), float("inf")
    vector = torch.tensor(
        [[0.0, nan, inf, 1.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, -inf, 0.0]], dtype=torch.float64, requires_grad=True
    )
    direction = unit(vector)
    assert direction[:, :3].abs().max() == 0
    (gradient,) = torch.autograd.grad(direction.sum(), vector)
    assert torch.isfinite(gradient).all()
    assert gradient[:, :3].abs().max() == 0
    assert gradient[:, 3].tolist() == [0.0, 1.0, 1.0]


def test_unit_derivatives():
    vector = torch.tensor([[1.0, -0.2], [0.5, 0.1], [2.0, -1.0]], dtype=torch.float64, requires_grad=True)
    assert gradcheck(unit, vector)
    assert gradgradcheck(unit, vector)


def test_dot_does_not_depend_on_the_batch():
    generator = torch.Generator().manual_seed(1)
    a, b = torch.randn(2, 3, 1001, generator=generator, dtype=torch.float64)
    whole = dot(a, b)
    assert all(torch.equal(dot(a[:, i], b[:, i]), whole[i]) for i in range(0, 1001, 37))
    assert (whole - (a * b).sum(0)).abs().max() <= 8 * ROUNDING


def test_polynomial_is_horners_and_broadcasts_over_populations():
    coefficients = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    x = torch.linspace(-1, 1, 5, dtype=torch.float64)
    assert torch.equal(polynomial(coefficients, x), (3 * x - 2) * x + 1)
    population = torch.stack([coefficients, 2 * coefficients], dim=1)[..., None]
    assert torch.equal(polynomial(population, x)[1], 2 * polynomial(coefficients, x))
    assert torch.equal(polynomial(coefficients[:0], x), torch.zeros_like(x))
