"""Moments belong to the kernel that is given, those of the rays are named so; and kernels of each wavelength."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from problems import number

from raytrace import read_lens
from raytrace.maths.sampling import centres, grid
from raytrace.psf_models import model_of, psf
from raytrace.system.lens import with_sensor_distance

LENSES = Path(__file__).parents[1] / "lenses"
WAVES = ("fourier", "wave")


def axis() -> torch.Tensor:
    return torch.zeros(2, 1, dtype=torch.float64)


def sums(kernel: torch.Tensor, window) -> tuple[torch.Tensor, ...]:
    """Mean x and y and the second moments xx, xy, yy of a kernel (rows, columns), less those of a pixel."""
    x, y = (c - c.mean() for c in centres(dataclasses.replace(window, centre=number([0.0, 0.0]))))
    share, pixel = kernel / kernel.sum(), float(window.pitch) ** 2 / 12
    mean_x, mean_y = (share.sum(0) * x).sum(), (share.sum(1) * y).sum()
    x, y = x - mean_x, y - mean_y
    cross = (share * y[:, None] * x).sum()
    return mean_x, mean_y, (share.sum(0) * x * x).sum() - pixel, cross, (share.sum(1) * y * y).sum() - pixel


@pytest.mark.parametrize("model", WAVES)
def test_the_reported_width_of_waves_is_that_of_the_kernel_not_of_the_rays(model):
    """The telescope's rays meet in 0.01 µm, its diffraction pattern is a thousand times wider."""
    result = psf(read_lens("hubble"), model, fields=axis(), tol=1e-3)
    *_, xx, _, yy = sums(result.kernel[0, 0], result.grid)
    assert result.covariance[0, 0, 0] == pytest.approx(float(xx), rel=3e-3)
    assert result.covariance[2, 0, 0] == pytest.approx(float(yy), rel=3e-3)
    assert 9e-3 < float(result.covariance[0, 0, 0].sqrt()) < 12e-3
    assert 0 < float(result.ray_covariance[0, 0, 0].sqrt()) < 1e-5


@pytest.mark.parametrize("model", WAVES)
@pytest.mark.parametrize("shape", [(9, 21), (20, 8)])
def test_round_light_in_a_window_that_is_not(model, shape):
    """Along one radius, or at every node of the window: the same moments, and those of a fine kernel."""
    lens, pitch = read_lens("hubble"), 0.004
    options, model = {"fields": axis()}, model_of(model, order=2)
    round_, plain = (
        psf(lens, model, grid=grid(number(pitch), shape, number([shift, 0.0])), **options) for shift in (0.0, 1e-9)
    )
    torch.testing.assert_close(round_.covariance, plain.covariance, rtol=1e-6, atol=1e-14)
    fine = grid(number(pitch / 4), tuple(4 * side for side in shape))
    *_, xx, _, yy = sums(psf(lens, model, grid=fine, **options).kernel[0, 0], fine)
    assert round_.covariance[::2, 0, 0].tolist() == pytest.approx([float(xx), float(yy)], rel=1e-3)
    assert (float(xx) > float(yy)) == (shape[1] > shape[0])


def test_moments_of_waves_off_the_axis_are_those_of_a_fine_kernel():
    lens = read_lens("telephoto")
    lens = dataclasses.replace(lens, wavelengths=number([0.5, 0.6]), wavelength_weights=number([3.0, 1.0]))
    field, window = number([[1.0], [2.0]]), grid(number(0.0004), 61)
    result = psf(lens, "wave", fields=field, grid=window, center="chief", tol=0.01)
    kernel, centre = result.kernel[0, 0], result.grid.centre[:, 0, 0]
    x, y, xx, xy, yy = sums(kernel, window)
    assert result.centroid[:, 0, 0].tolist() == pytest.approx([float(centre[0] + x), float(centre[1] + y)], abs=1e-7)
    assert result.covariance[:, 0, 0].tolist() == pytest.approx([float(xx), float(xy), float(yy)], rel=2e-3)
    # The mean of the whole wave is that of its rays (Ehrenfest); a window cuts tails off.
    torch.testing.assert_close(result.ray_centroid, result.centroid, atol=5e-4, rtol=0)


@pytest.mark.parametrize("model", ["paraxial", "gaussian", "drt"])
def test_geometric_models_keep_their_moments_whatever_the_window(model):
    lens = read_lens("double_gauss")
    wide, narrow = (
        psf(lens, model_of(model, order=0 if model != "gaussian" else 4), fields=axis(), grid=grid(number(0.005), size))
        for size in (21, 3)
    )
    torch.testing.assert_close(wide.covariance, narrow.covariance, rtol=1e-12, atol=0)
    assert torch.equal(wide.ray_covariance, wide.covariance)
    assert torch.equal(wide.ray_centroid, wide.centroid)


@pytest.mark.parametrize("shift", [0.0, 1e-3])
@pytest.mark.parametrize("model", WAVES)
def test_derivatives_of_the_moments(model, shift):
    lens = read_lens("hubble")

    def variance(sensor: torch.Tensor) -> torch.Tensor:
        window = grid(number(0.005), 7, number([shift, 0.0]))
        return psf(
            with_sensor_distance(lens, sensor), model_of(model, order=0), fields=axis(), grid=window
        ).covariance.sum()

    sensor, step = lens.surfaces[-2].thickness + 8.0, 3e-3
    (slope,) = torch.autograd.grad(variance(sensor.requires_grad_()), sensor)
    with torch.no_grad():
        expected = (variance(sensor + step) - variance(sensor - step)) / (2 * step)
    assert float(expected.abs()) > 1e-8
    assert float(slope) == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize("model", ["paraxial", "gaussian", pytest.param("wave", marks=pytest.mark.slow)])
def test_kernels_of_each_wavelength_sum_to_those_of_all(model):
    lens = read_lens("telephoto")
    options = {"fields": number([[0.0, 0.0], [0.0, 2.0]]), "center": "chief", "tol": 1e-2}
    options |= {"object_distances": number([1e5, math.inf, 2e5]), "grid": grid(number(0.01), (5, 7))}
    each, whole = (psf(lens, model, per_wavelength=kept, **options) for kept in (True, False))
    assert each.kernel.shape == (3, 2, 3, 5, 7)
    assert each.energy.shape == each.error.shape == (3, 2, 3)
    assert each.covariance.shape == each.ray_covariance.shape == (3, 3, 2, 3)
    assert whole.wavelengths_summed
    assert not each.wavelengths_summed
    torch.testing.assert_close(each.wavelengths, lens.wavelengths)
    torch.testing.assert_close(whole.wavelength_weights, lens.wavelength_weights / lens.wavelength_weights.sum())
    summed = (each.wavelength_weights[:, None, None] * each.kernel).sum(2)
    torch.testing.assert_close(summed, whole.kernel, atol=2e-2 * float(whole.kernel.max()), rtol=0)
    for w, wavelength in enumerate(lens.wavelengths):
        alone = psf(lens, model, wavelengths=wavelength[None], **options)
        assert float((each.kernel[:, :, w] - alone.kernel).abs().sum() / alone.kernel.sum()) < 2e-2
    by_window = psf(lens, model, per_wavelength=True, normalise="window", **options)
    torch.testing.assert_close(by_window.kernel.sum((-2, -1)), torch.ones(3, 2, 3, dtype=torch.float64))


def test_windows_are_centred_on_chief_rays():
    lens = read_lens("double_gauss")
    result, off_axis = psf(lens, "gaussian"), psf(lens, "gaussian", fields=number([[0.0], [14.0]]))
    about_axis = psf(lens, "gaussian", fields=number([[0.0], [14.0]]), center="axis")
    assert result.kernel.shape[1] == 3
    assert bool((result.energy > 0.05).all())
    torch.testing.assert_close(off_axis.kernel[:, 0], result.kernel[:, 2], rtol=0, atol=1e-12)
    assert float(about_axis.energy) == 0
    assert about_axis.grid.centre.tolist() == [0.0, 0.0]
