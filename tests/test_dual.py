"""Dual numbers: their derivatives are those of finite differences, and what is no dual number does not change."""

import numpy as np
import pytest

from raytrace.maths.numerics import Dual, slope_of, value_of

FUNCTIONS = [
    lambda a, b: a * b + a / b - b / a + 2 * a - b * 3 + 1 / a - (2 - b),
    lambda a, b: np.sqrt(a * a + b * b),
    lambda a, b: np.sin(a) * np.cos(b) + np.tan(a) * np.arctan(b) + np.arcsin(a / 5) + np.arccos(b / 5),
    lambda a, b: np.exp(a) + np.log(b) + np.log10(a) + np.abs(-a) + a**3,
    lambda a, b: np.where(value_of(a) > value_of(b), a, b) + np.maximum(a, b) * np.minimum(a, 1.0),
    lambda a, b: np.stack([a, b, a * b]).sum(0),
    lambda a, b: np.deg2rad(a) + np.rad2deg(b) + np.array([2.0]) * a - np.array([[1.0], [3.0]]) / b,
]


@pytest.mark.parametrize("place", range(len(FUNCTIONS)))
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_slopes_are_derivatives(place, shape):
    function, generator = FUNCTIONS[place], np.random.default_rng(place)
    at, along = generator.uniform(1, 2, (2, *shape)), generator.normal(size=(2, *shape))
    found = function(*(Dual(x, dx[None]) for x, dx in zip(at, along, strict=True)))
    step = 1e-6
    ahead, back = (function(*(at + sign * step * along)) for sign in (1, -1))
    assert np.allclose(value_of(found), function(*at), rtol=1e-15)
    assert np.allclose(slope_of(found, 1)[0], (ahead - back) / (2 * step), rtol=1e-6, atol=1e-8)


def test_a_matrix_and_entries():
    matrix, vector = np.arange(6.0).reshape(2, 3), Dual(np.array([1.0, 2.0, 3.0]), np.eye(3))
    assert np.array_equal((matrix @ vector).slope, matrix.T)
    assert np.array_equal(vector[np.array([2, 0])].slope, np.eye(3)[:, [2, 0]])
    assert np.array_equal(vector.sum().slope, np.ones(3))


def test_the_length_of_nothing_has_no_derivative():
    assert np.array_equal(np.sqrt(Dual(np.zeros(2), np.ones((1, 2)))).slope, np.zeros((1, 2)))
    assert slope_of(3.0, 2).shape == (2,)
