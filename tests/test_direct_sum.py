"""The direct Huygens sum: peaks and energy in closed form, the limit of the wave model, and converged moments."""

import dataclasses
import math

import problems
import pytest
import torch
from problems import plano_hyperbolic, scene_of, vector

from raytrace.io import read_lens
from raytrace.maths.sampling import grid
from raytrace.psf_models import wave
from raytrace.psf_models.direct_sum import (
    Sampling,
    clear_rings,
    direct_sum,
    moments,
    reference,
    sampling_of,
    solid_angle,
)
from raytrace.psf_models.gaussian import kernels as gaussian_kernels
from raytrace.system.surface import Aperture

pytestmark = pytest.mark.usefixtures("threads")


@pytest.mark.parametrize("sampling", [Sampling(12, 32, 3), Sampling(80, 0, 3)])
def test_direct_sum_of_a_perfect_lens_peaks_as_airy(sampling):
    """I(0) = E A/(λf)² with E = 1, A = πR²: to 4 NA² = 1e-4, a square grid to the raggedness of its rim, 0.5 %."""
    lens = plano_hyperbolic(diameter=0.5)
    pitch = 1e-4  # 1/300 of the Airy radius: the pixel is flat
    kernel, rays = direct_sum(scene_of(lens), grid(pitch, 1), sampling)
    expected = math.pi * 0.25**2 / (0.55e-3 * 50.0) ** 2 * pitch**2
    assert rays == (384 if sampling.arms else pytest.approx(5027, abs=40))
    assert float(kernel) == pytest.approx(expected, rel=1e-4 if sampling.arms else 5e-3)


def test_direct_sum_of_an_annulus():
    """A central stop of radius ε leaves (1 - ε²) of the light and of the area: the peak falls by its square."""
    stop = (Aperture("circular", (0.2, math.inf)),)
    window = grid(1e-4, 1)
    ratio = direct_sum(scene_of(plano_hyperbolic(diameter=1.0, apertures=stop)), window, Sampling(12, 32, 3))[0]
    ratio = ratio / direct_sum(scene_of(plano_hyperbolic(diameter=1.0)), window, Sampling(12, 32, 3))[0]
    assert float(ratio) == pytest.approx((1 - 0.4**2) ** 2, rel=1e-4)


def test_direct_sum_keeps_the_light():
    """All light of the perfect lens within 6 Airy radii but the rings' tail, 2/(π v), v = π D r/(λ f)."""
    kernel, _ = direct_sum(scene_of(plano_hyperbolic(diameter=1.0)), grid(0.08, 5), Sampling(16, 48, 7))
    tail = 2 / (math.pi * math.pi * 0.2 / (0.55e-3 * 50.0))
    assert 0.5 * tail < 1 - float(kernel.sum()) < 1.5 * tail


def test_direct_sum_is_the_wave_models_limit():
    """Off the axis, in coma: two quadratures, two Jacobians, exact and plane wavelets."""
    lens = problems.double_gauss(aperture=("entrance_pupil_diameter", 8.0))
    s = scene_of(lens, 7.0, 25e3)
    window = grid(0.01, 3, moments(s, 16, 64)[0])
    found = wave.kernels(s, window, order=1)
    kernel, _ = direct_sum(s, window, sampling_of(s, window).scaled(1.0, 1))
    assert kernel.sum() > 0.3
    for converged in (kernel, reference(s, window)):
        error = float((found.kernel[0, 0, 0] - converged).abs().sum() / converged.sum())
        assert error < min(1e-3, float(found.residual) + 1e-5)


def test_rim_is_found():
    """Rings between the edges of an annulus carry its area and none is lost."""
    stop = (Aperture("circular", (0.2, 0.45)),)
    s = scene_of(plano_hyperbolic(diameter=1.0, apertures=stop))
    points, weights = clear_rings(s, 6, 16)
    radius = 0.5 * torch.linalg.vector_norm(points, dim=0)
    assert weights.sum() == pytest.approx((0.45**2 - 0.2**2) / 0.25, rel=1e-9)
    assert radius.min() > 0.2
    assert radius.max() < 0.45


def test_solid_angle_of_a_perfect_lens():
    """Parallel light into a perfect cone: (L, M) = -R p/f to NA², so that Ω = (R/f)²."""
    points = vector(0.0, 0.3, -0.2, 0.5).reshape(2, 2)
    assert torch.allclose(solid_angle(scene_of(plano_hyperbolic(diameter=1.0)), points), vector(1e-4, 1e-4), rtol=3e-4)


def test_moments_are_those_of_many_rings():
    lens = read_lens("double_gauss")
    s = scene_of(lens, 14.0, 1e4)
    s = dataclasses.replace(s, wavelengths=lens.primary[None])
    (centroid, variance, energy), fine = moments(s, 12, 48), gaussian_kernels(s, grid(1.0, 1), order=12)
    assert torch.allclose(variance, fine.covariance[::2, 0, 0, 0], rtol=1e-10)
    assert torch.allclose(centroid, fine.centroid[:, 0, 0, 0], atol=1e-12)
    assert energy == pytest.approx(1.0, abs=1e-14)
