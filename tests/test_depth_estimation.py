"""Depth from defocus in closed form, against random fields of the same spectra."""

import pytest
import torch
from scripts import script

from raytrace.imaging.restoration import power_law

depth = script("depth_estimation")
blurred_spectra, cramer_rao, log_likelihoods = depth.blurred_spectra, depth.cramer_rao, depth.log_likelihoods
expected_log_likelihood_ratios, most_likely = depth.expected_log_likelihood_ratios, depth.most_likely
expected_square_error = depth.expected_square_error

SIZE, NOISE = 32, 0.1
PLACES = torch.linspace(0, 1, 11, dtype=torch.float64)


def transfer(places):
    """Gaussian blurs of deviation 0.5 to 2.5 pixels (D, rows, columns)."""
    frequency = torch.fft.fftfreq(SIZE, dtype=torch.float64)
    square = frequency[:, None] ** 2 + frequency**2
    deviation = (0.5 + 2 * places)[:, None, None]
    return torch.exp(-2 * (torch.pi * deviation) ** 2 * square).to(torch.complex128)


def spectra(places=PLACES):
    return blurred_spectra(transfer(places), power_law(SIZE), NOISE)


def periodograms(spectrum, count, seed=0):
    """Of random periodic Gaussian fields of a spectrum (rows, columns)."""
    white = torch.randn(count, SIZE, SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return (torch.fft.fft2(white) * spectrum.sqrt()).abs() ** 2 / SIZE**2


def test_expected_ratios_are_the_means_over_random_fields():
    P = spectra()
    found = expected_log_likelihood_ratios(P)
    images = periodograms(P[3], 2000)
    each = log_likelihoods(images, P)
    sampled = each[:, [3]] - each
    error = sampled.std(0) / 2000**0.5
    assert bool(((sampled.mean(0) - found[3]).abs() <= 4 * error + 1e-9).all())
    torch.testing.assert_close(expected_log_likelihood_ratios(P, pixels=SIZE**2 / 4), found / 4)
    assert float(found.diagonal().abs().max()) < 1e-9
    assert float(found.min()) > -1e-9


def test_the_ratio_of_near_places_is_half_the_information():
    """E ln p_v/p_(v+δ) = ½ I δ² + O(δ³)."""
    place, step = torch.tensor([0.4], dtype=torch.float64), 1e-4
    P = spectra(place)
    slopes = (spectra(place + step) - spectra(place - step)) / (2 * step)
    ratio = expected_log_likelihood_ratios(torch.cat([P, spectra(place + 1e-3)]))[0, 1]
    assert float(ratio) == pytest.approx(0.5 * 1e-6 / float(cramer_rao(P, slopes)), rel=1e-2)
    assert bool(torch.isinf(cramer_rao(P, torch.zeros_like(P))).all())


def test_the_square_error_is_the_bound_where_the_likelihood_is_a_parabola():
    places = torch.linspace(0.2, 0.6, 801, dtype=torch.float64)
    step = 1e-4
    slopes = (spectra(places[[400]] + step) - spectra(places[[400]] - step)) / (2 * step)
    bound = cramer_rao(spectra(places[[400]]), slopes)
    found = expected_square_error(spectra(places), places)[400]
    assert float(found) == pytest.approx(float(bound), rel=0.05)


def test_two_places_that_look_alike_count_with_their_distance():
    """Two equal spectra: half of the estimates are at the other place."""
    places = torch.tensor([0.0, 1.0], dtype=torch.float64)
    P = spectra(torch.tensor([0.3, 0.3], dtype=torch.float64))
    torch.testing.assert_close(expected_square_error(P, places), torch.tensor([0.5, 0.5], dtype=torch.float64))


@pytest.mark.parametrize(("contrasts", "factor"), [([0.5], 1.0), ([0.25, 0.5, 1.0], 1.7)])
def test_the_most_likely_place_errs_as_expected(contrasts, factor):
    """More where the contrast is unknown, too."""
    P = blurred_spectra(transfer(PLACES), 0.5 * power_law(SIZE), NOISE)
    images = torch.cat([periodograms(P[d], 100, seed=d) for d in (2, 8)])
    found = PLACES[most_likely(images, transfer(PLACES), power_law(SIZE), NOISE, P.new_tensor(contrasts))]
    error = (found - PLACES[[2] * 100 + [8] * 100]).square().mean().sqrt()
    expected = expected_square_error(P, PLACES)[[2, 8]].mean().sqrt()
    assert float(error / expected) == pytest.approx(factor, rel=0.2)


def test_derivatives_of_the_square_error():
    def error(shift):
        return expected_square_error(spectra(PLACES * shift), PLACES).mean()

    shift = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(error, shift)
