"""Super-resolution: inversion of aliases against a dense estimator, learning by derivatives, views against one view."""

import argparse

import pytest
import torch
from scripts import script

from raytrace.imaging.image import pixel_means
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.restoration import power_law, power_spectrum, psnr
from raytrace.imaging.variables import PhaseVariables

superres = script("wave_superres")
SETUP = superres.Setup(2, (0.55,), 0.001)
LEAVES = dead_leaves(4, size=96, seed=1)


@pytest.fixture
def coarse_plate(monkeypatch):
    """200 cells across the aperture instead of 400."""
    monkeypatch.setattr(superres, "CELLS", 200)


@pytest.mark.parametrize("factor", [2, 3])
def test_inversion_is_the_dense_linear_estimator(factor):
    """x̂ = C Aᵀ (A C Aᵀ + σ²)⁻¹ y and its error, by matrices of 144 pixels; views of random kernels."""
    n, sigma, views = 12, 0.05, 2
    random = torch.Generator().manual_seed(0)
    kernels = torch.rand(views, 5, 5, generator=random, dtype=torch.float64) / 25
    S = power_law(n, exponent=1.5)
    basis = torch.eye(n * n, dtype=torch.float64).reshape(n * n, 1, n, n)
    config = superres.Setup(factor, (0.55,), sigma).config(5)
    camera = config.camera(superres.plain_lens(), oversampling=factor, normalise="energy")
    A = camera.blurred(basis, kernels).flatten(1).T  # (V (n/s)², n²)
    C = torch.fft.ifft2(S * torch.fft.fft2(basis[:, 0])).real.flatten(1)
    power = A @ C @ A.T + sigma**2 * torch.eye(len(A), dtype=torch.float64)
    expected = torch.linalg.solve(power, A @ C).T
    T = camera.transfer(kernels, n)
    y = torch.rand(len(A), generator=random, dtype=torch.float64)
    G = superres.inversion(T, S, sigma, factor)
    estimate = superres.superresolve(y.reshape(views, n // factor, n // factor), G, factor)
    torch.testing.assert_close(estimate.flatten(), expected @ y, atol=1e-12, rtol=0)
    left = (C - expected @ A @ C).trace() / n**2
    torch.testing.assert_close(superres.error(T, S, sigma, factor), left, atol=1e-13, rtol=1e-10)


def test_one_view_loses_all_aliases_but_the_strongest():
    """Three quarters of a white spectrum. No kernel is better, and without noise an ideal low pass reaches the bound
    of a falling spectrum."""
    S = torch.ones(24, 24, dtype=torch.float64)
    assert superres.least_error(S, 2) == pytest.approx(0.75)
    S = power_law(24)
    frequency = torch.fft.fftfreq(24, dtype=torch.float64)
    low = (frequency >= -0.25) & (frequency < 0.25)
    ideal = (low[:, None] & low).to(torch.complex128)
    assert superres.error(ideal[None], S, 1e-6, 2) == pytest.approx(float(superres.least_error(S, 2)), rel=1e-6)
    assert superres.error(torch.ones_like(ideal)[None], S, 1e-6, 2) > superres.least_error(S, 2)


def test_bicubic_enlargement_is_in_place():
    """Exact for a ramp of pixel means, away from the borders."""
    ramp = torch.arange(24, dtype=torch.float64).expand(1, 1, 24, 24) / 24
    fine = superres.bicubic(pixel_means(ramp, 2), 2)
    torch.testing.assert_close(fine[..., 6:-6], ramp[..., 6:-6], atol=1e-12, rtol=0)


def test_errors_have_the_derivatives_of_the_heights(coarse_plate):
    """First and second order, along a direction, against central differences."""
    S = power_spectrum(superres.small_scenes(LEAVES), window="none")
    elements = superres.plate(superres.hologram(superres.wedges(3, 2), 0))
    variables = PhaseVariables(elements[0], others=elements[1:])
    camera = SETUP.plate_camera(variables, superres.CELLS)
    direction = torch.rand(variables.change.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def slope(step: float) -> tuple[float, float]:
        variables.change.data.copy_(step * direction)
        error = superres.error_of_views(camera, superres.kernels_of(camera), 3, S, SETUP)
        (gradient,) = torch.autograd.grad(error, variables.change)
        return float(error.detach()), float((gradient * direction).sum())

    variables.change.data.zero_()
    error = superres.error_of_views(camera, superres.kernels_of(camera), 3, S, SETUP)
    (gradient,) = torch.autograd.grad(error, variables.change, create_graph=True)
    (second,) = torch.autograd.grad((gradient * direction).sum(), variables.change)
    step = 1e-4  # µm
    (before, falling), (after, rising) = slope(-step), slope(step)
    assert float((gradient * direction).sum().detach()) == pytest.approx((after - before) / (2 * step), rel=1e-5)
    assert float((second * direction).sum()) == pytest.approx((rising - falling) / (2 * step), rel=1e-5)


def test_views_of_a_plate_restore_more_than_the_plain_lens(coarse_plate):
    """Four views by more than 4 dB; images, whose light astray is simulated, agree with the closed form."""
    scenes = superres.small_scenes(LEAVES)
    plain = superres.of_one_view({"plain lens": superres.plain_lens()}, SETUP, scenes, scenes, 0)[1]
    elements = superres.plate(superres.hologram(superres.wedges(4, 2), 0))
    row, *_ = superres.of_views("4 places", elements, 4, SETUP, scenes, scenes, 0)
    assert row.psnr > plain.psnr + 4
    assert row.closed > plain.closed + 4
    assert row.psnr == pytest.approx(row.closed, abs=0.3)
    assert plain.psnr == pytest.approx(plain.closed, abs=0.1)  # aliases of pictures are correlated


def test_heights_that_are_learned_further_have_a_lower_error(coarse_plate):
    S = power_spectrum(superres.small_scenes(LEAVES), window="none")
    elements = superres.plate(superres.hologram(superres.wedges(3, 2), 0))
    further, errors = superres.learned_plate(SETUP, elements, 3, S, 2), []
    with torch.no_grad():
        for parts in (elements, further):
            camera = SETUP.plate_camera(parts, superres.CELLS)
            errors.append(superres.error_of_views(camera, superres.kernels_of(camera), 3, S, SETUP))
    assert psnr(errors[1]) > psnr(errors[0]) + 0.001


def test_a_scene_that_fills_the_sensor_gains_by_polynomials():
    """The error after a few steps lies between that of the plain lens and the bound of one view."""
    S, setup = power_spectrum(superres.periodic(LEAVES, 72), window="none"), superres.Setup(2, (0.5, 0.6), 0.001)
    change = superres.learned_lens(setup, S, superres.Settings(steps=4, starts=0))
    with torch.no_grad():
        plain, learned = (
            superres.error_of_frame(setup.camera(superres.polynomials(terms)), S, setup) for terms in (None, change)
        )
    assert superres.least_error(S, 2) < learned < plain


def test_the_command_of_the_page_repeats_its_settings():
    parser = argparse.ArgumentParser()
    superres.options(parser)
    words = "--data DIR --limit 9 --factor 2 3 --noise 0.01 --steps 7 --starts 2 --seed 4 --wavelength 0.5 "
    arguments = parser.parse_args([*words.split(), "--wavelength", "0.46", "0.64"])
    settings = superres.Settings.of(vars(arguments))
    line = superres._command(arguments, settings)
    again = parser.parse_args(line.split()[2:])
    assert superres.Settings.of(vars(again)) == settings
    assert (again.data, again.limit) == ("DIR", 9)
