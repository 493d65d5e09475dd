"""Paraxial PSF: blur of a defocused thin lens."""

import dataclasses
import math

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import double_gauss, fields, lens, scalar, surface, vector

from raytrace.maths.sampling import Grid, grid
from raytrace.psf_models import paraxial, psf
from raytrace.system.lens import with_sensor_distance
from raytrace.tracing.paraxial import paraxial_image_distance
from raytrace.tracing.scene import scene

INF = math.inf


def double_gauss_at(sensor_distance, field=(0.0, 0.0), distances=(25_000.0,)):
    built = with_sensor_distance(double_gauss(), torch.as_tensor(sensor_distance, dtype=torch.float64))
    return scene(built, vector(*field)[:, None], vector(*distances), vector(0.530))


@pytest.mark.parametrize("distance", [10_000.0, 25_000.0, INF])
def test_blur_of_a_thin_lens(distance):
    """A lens of no thickness, f = 100 mm, radius 5: ε = R |1 - z_i (1/f - 1/z_o)| by hand; in object space at z_o."""
    thin = lens([surface(0.02, 0.0, 1.5), surface(0.0, 103.0)], object_distance=distance)
    computed = paraxial.blur_radius(scene(thin, vector(0.0, 0.0)[:, None], vector(distance), vector(0.55)))
    assert computed.item() == pytest.approx(5 * abs(1 - 103 * (1 / 100 - 1 / distance)), rel=1e-12)


def test_the_double_gauss_of_the_comparison():
    """F/3 in focus at 25 m: the blur diameter of 10 m is EPD (z_i - z_i′)/z_i′ with z_i′ the image distance of 10 m."""
    assert paraxial.blur_radius(double_gauss_at(57.8817685)).item() < 1e-8
    principal = 99.5145515666 - 57.4851290372  # before the last surface
    image = paraxial_image_distance(double_gauss(), scalar(10_000.0)).item()
    diameter = 2 * paraxial.blur_radius(double_gauss_at(57.8817685, distances=(10_000.0,))).item()
    assert diameter == pytest.approx(33.33 * abs((57.8817685 + principal) / (image + principal) - 1), rel=1e-6)
    assert diameter == pytest.approx(0.198, abs=0.001)


def test_centroid_is_the_chief_ray():
    """In focus at infinity the height is f tan θ; a positive field lands at +y."""
    computed = paraxial.kernels(double_gauss_at(57.4851290372, (3.0, 14.0), (INF,)), grid(0.005, 3)).centroid.flatten()
    expected = [99.5145515666 * math.tan(math.radians(angle)) for angle in (3.0, 14.0)]
    torch.testing.assert_close(computed, vector(*expected), rtol=1e-9, atol=0)
    far = paraxial.kernels(double_gauss_at(57.4851290372, (3.0, 14.0), (1e12,)), grid(0.005, 3)).centroid.flatten()
    torch.testing.assert_close(computed, far, rtol=1e-9, atol=0)


def test_object_height_is_magnified():
    thin = lens(
        [surface(0.02, 0.0, 1.5), surface(0.0, 200.0)], object_distance=200.0, field=fields("object_height", (1.0,))
    )
    result = paraxial.kernels(scene(thin, vector(0.0, 3.0)[:, None], vector(200.0), vector(0.55)), grid(0.005, 5))
    assert result.centroid.flatten().tolist() == pytest.approx([0.0, -3.0])
    assert result.covariance[0].item() == pytest.approx(0, abs=1e-24)


def test_in_focus_all_is_in_one_pixel_and_the_gradient_is_finite():
    distance = scalar(100.0).requires_grad_()
    thin = lens([surface(0.02, 0.0, 1.5), surface(0.0, distance)])
    result = paraxial.kernels(scene(thin, vector(0.0, 0.0)[:, None], vector(INF), vector(0.55)), grid(0.005, 5))
    assert result.kernel[0, 0, 0, 2, 2].item() == pytest.approx(1)
    (slope,) = torch.autograd.grad((result.kernel * torch.arange(25.0).reshape(5, 5)).sum(), distance)
    assert torch.isfinite(slope)


def test_derivatives():
    def kernel(curvature, sensor_distance, rho, pitch, centre):
        thin = lens([surface(curvature / 100, 2.0, 1.5), surface(-0.001, sensor_distance)])
        computed = scene(thin, vector(0.0, 0.01)[:, None], vector(5000.0), vector(0.55))
        return paraxial.kernels(computed, Grid(pitch / 50, 2, 3, centre / 50), rho=rho).kernel

    numbers = [scalar(2.0), scalar(97.0), scalar(0.5), scalar(1.5), vector(0.2, -0.3)]
    numbers = [number.requires_grad_() for number in numbers]
    assert gradcheck(kernel, numbers, atol=1e-6)
    assert gradgradcheck(kernel, numbers, atol=1e-5)


def test_a_nearly_empty_window_has_finite_derivatives():
    """The tail of a Gaussian 29 σ away holds 1e-180 of the light: its kernel sums to 1, its derivatives are numbers."""
    system = double_gauss()
    place = torch.tensor([[0.0], [2.4]], dtype=torch.float64, requires_grad=True)
    pixels = dataclasses.replace(grid(scalar(0.005), 5), centre=place[:, :, None])
    computed = psf(system, "paraxial", fields=system.wavelengths.new_zeros(2, 1), grid=pixels, normalise="window")
    assert 0 < float(computed.energy.detach()) < 1e-160
    assert float(computed.kernel.detach().sum()) == pytest.approx(1)
    (slope,) = torch.autograd.grad(computed.kernel[..., 0, 0].sum(), place)
    assert bool(torch.isfinite(slope).all())
    assert float(slope[1]) != 0
