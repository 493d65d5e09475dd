"""Round kernels along one radius: the same energy in every pixel as from the whole plane."""

import math

import numpy as np
import pytest
import torch
from differences import gradcheck
from problems import number

from raytrace.budget import OverBudget, within
from raytrace.maths.sampling import grid
from raytrace.psf_models.dft import integrate, sub_pixels
from raytrace.psf_models.radial import energy_of_rings, is_centred, radii_of_waves, unfold

SIZES = [21, 20, (1, 49), (7, 4)]


def line(rays: int, radius: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pieces of a meridian of a defocused beam, its rim at `radius` mm: where each begins and ends, and its energy."""
    heights = torch.linspace(0, radius, rays, dtype=torch.float64)
    return heights[:-1], heights[1:], heights.square().diff() / radius**2


@pytest.mark.parametrize("size", SIZES)
def test_energy_of_a_band_limited_intensity(size):
    """J₀(ka)² has frequencies up to k/π; each order divides the error by ten."""
    window, k = grid(0.005, size), 2 * math.pi * 314

    def intensity(r: torch.Tensor) -> torch.Tensor:
        return torch.special.bessel_j0(k * r) ** 2

    x, y, weight = sub_pixels(window, 24)
    expected = integrate(intensity(torch.hypot(x[None], y[:, None])), weight, window.pitch)
    for order, tolerance in ((0, 2e-3), (2, 1e-5), (4, 1e-7)):
        radii, matrix = radii_of_waves(window, k / math.pi, order)
        result = unfold(window, matrix @ intensity(radii))
        assert result.shape == expected.shape
        assert float((result - expected).abs().sum() / expected.sum()) < tolerance


@pytest.mark.parametrize("size", SIZES)
def test_energy_of_a_uniform_disc(size):
    """Against its area in every pixel, counted at 160,000 points of each (good to 1e-4 of the whole)."""
    window, radius = grid(0.005, size), 0.03
    result = unfold(window, energy_of_rings(window, *line(200, radius)))
    x, y = (((np.arange(n * 400) + 0.5) / 400 - 0.5 * n) * 0.005 for n in (window.columns, window.rows))
    half = np.sqrt(np.clip(radius**2 - y**2, 0, None))  # a row of points is inside from -half to half
    first, last = np.searchsorted(x, -half, "right"), np.searchsorted(x, half, "left")
    edge = 400 * np.arange(window.columns)
    inside = np.clip(last[:, None] - edge, 0, 400) - np.clip(first[:, None] - edge, 0, 400)
    inside = inside.reshape(window.rows, 400, window.columns).sum(1) / 400**2
    expected = inside * 0.005**2 / (np.pi * radius**2)
    assert np.abs(result.numpy() - expected).sum() < 2e-4


def test_all_light_inside_the_window_is_kept_and_the_rest_is_not_counted():
    window = grid(0.005, 21)
    assert float(unfold(window, energy_of_rings(window, *line(50, 0.05))).sum()) == pytest.approx(1.0, abs=1e-12)
    assert float(unfold(window, energy_of_rings(window, *line(500, 0.5))).sum()) == pytest.approx(
        0.105**2 / (math.pi * 0.25), rel=1e-3
    )


def test_a_window_that_memory_does_not_hold_is_refused_first():
    with within(2e7), pytest.raises(OverBudget, match=r"399 × 399 pixels.*18,0\d\d radii.*larger pixels"):
        energy_of_rings(grid(number(0.01), 399), *(number(x)[None] for x in (0.0, 1.0, 1.0)))


def test_heights_below_the_axis_are_the_same_rings():
    window = grid(0.005, 21)
    first, last, energy = line(101, 0.05)
    result, mirrored = (energy_of_rings(window, side * first, side * last, energy) for side in (1, -1))
    torch.testing.assert_close(result, mirrored, atol=1e-15, rtol=0)
    # A cell on both sides of the axis covers the axis twice over.
    both = energy_of_rings(window, number([-0.01]), number([0.02]), number([1.0]))
    apart = energy_of_rings(window, number([-0.01, 0.0]), number([0.0, 0.02]), number([1 / 3, 2 / 3]))
    torch.testing.assert_close(both, apart, atol=1e-15, rtol=0)


def test_a_focus_and_a_caustic_are_finite_and_have_finite_derivatives():
    window = grid(0.005, 21)
    for heights in (torch.zeros(9), 0.013 * torch.ones(9), torch.linspace(-1, 1, 9) ** 2 * 0.02):
        heights = heights.to(torch.float64).requires_grad_()
        result = energy_of_rings(window, heights[:-1], heights[1:], torch.full((8,), 0.125, dtype=torch.float64))
        (gradient,) = torch.autograd.grad(result.square().sum(), heights)
        assert bool(torch.isfinite(gradient).all())
        assert float(unfold(window, result).sum().detach()) == pytest.approx(1.0, abs=1e-9)


def test_derivatives_in_the_heights_the_energy_and_the_pitch():
    def energies(heights, energy, pitch):
        return energy_of_rings(grid(pitch, 9), heights[..., :-1], heights[..., 1:], energy)

    generator = torch.Generator().manual_seed(3)
    heights = 0.02 * torch.rand(2, 8, generator=generator, dtype=torch.float64)
    inputs = (heights, torch.rand(7, generator=generator, dtype=torch.float64), number(0.005))
    assert gradcheck(energies, [t.requires_grad_() for t in inputs], eps=1e-8, atol=1e-5, rtol=1e-4)
    radii, matrix = radii_of_waves(grid(number(0.005).requires_grad_(), 9), 300.0, 1)
    assert radii.requires_grad
    assert matrix.requires_grad


def test_windows_off_the_axis_or_free_to_move_are_not_round():
    assert is_centred(grid(0.005, 21))
    assert not is_centred(grid(number(0.005), 21, number([0.0, 1e-9])))
    assert is_centred(grid(number(0.005), 21, number([0.0, 1e-13])))
    assert not is_centred(grid(number(0.005), 21, number([0.0, 0.0]).requires_grad_()))
