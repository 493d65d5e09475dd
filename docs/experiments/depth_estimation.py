"""Depth from defocus: how well one image determines the distance of its object, and the most likely distance.

A patch of a scene of power spectrum S, blurred by the kernel of distance z, with white noise of variance σ², is a
Gaussian random field of the spectrum

    P_z = S |H_z|² + σ²

ordered as by `fft2`, the frequency 0 left out: the mean of a patch is unknown. With sums over all other frequencies

    ln p_z = -½ Σ (|Y|²/P_z + ln P_z)                      of an image Y (Whittle, 1953)
    E_a ln p_a/p_b = ½ Σ (P_a/P_b - 1 - ln P_a/P_b)        expected log-likelihood ratio (Kullback and Leibler, 1951)
    I = ½ Σ (∂ ln P_v/∂v)²                                 Fisher information; 1/I is the Cramér-Rao bound of v

v = 1/z is the place on which the blur depends nearly linearly. All sums grow with the number of pixels of the patch.
"""

import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide


def blurred_spectra(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """P (D, rows, columns) of transfer functions (D, rows, columns) and S (rows, columns)."""
    return spectrum * (transfer.real**2 + transfer.imag**2) + sigma**2


def expected_log_likelihood_ratios(spectra: Tensor, *, pixels: float | None = None) -> Tensor:
    """E_a ln p_a/p_b (D, D) in nats of images at distance a, of spectra (D, rows, columns).

    pixels: of the patch, by default rows · columns; of another number the spectra are samples of the same function.
    """
    power = spectra.flatten(1)[:, 1:]
    logarithm = power.log().sum(1)
    ratios = power @ (1 / power).T - power.shape[1]
    return 0.5 * _share(spectra, pixels) * (ratios - logarithm[:, None] + logarithm)


def _share(spectra: Tensor, pixels: float | None) -> float:
    return 1.0 if pixels is None else pixels / (spectra.shape[-2] * spectra.shape[-1])


def expected_square_error(spectra: Tensor, places: Tensor, *, pixels: float | None = None) -> Tensor:
    """Mean square error (D,) of the place estimated at each of the places (D,), of spectra (D, rows, columns).

    That of the mean likelihood, the mean over images of the log-likelihood: weights w_ab ∝ exp(-E_a ln p_a/p_b) of
    places b, whose mean square distance from a is the error. Of fine steps and much information it is the Cramér-Rao
    bound. Places that are far but look alike, as in front of and behind the focus, count too, but less than images
    mistake them where the ratio is several nats. pixels: of the patch, as for `expected_log_likelihood_ratios`.
    """
    weights = torch.softmax(-expected_log_likelihood_ratios(spectra, pixels=pixels), 1)
    return (weights * (places - places[:, None]) ** 2).sum(1)


def cramer_rao(spectra: Tensor, slopes: Tensor, *, pixels: float | None = None) -> Tensor:
    """Least mean square error (D,) of an unbiased estimate of the place v; slopes: ∂P/∂v (D, rows, columns).

    Infinite where nothing changes with the place. pixels: of the patch, as for `expected_log_likelihood_ratios`.
    """
    information = 0.5 * _share(spectra, pixels) * (slopes / spectra).flatten(1)[:, 1:].square().sum(1)
    return torch.where(information > 0, safe_divide(torch.ones_like(information), information), torch.inf)


def log_likelihoods(periodograms: Tensor, spectra: Tensor) -> Tensor:
    """ln p_z (B, D) of images of periodograms |Y|² over the number of pixels (B, rows, columns), as `power_spectrum`.

    Up to a constant of each image.
    """
    power = spectra.flatten(1)[:, 1:]
    return -0.5 * (periodograms.flatten(1)[:, 1:] @ (1 / power).T + power.log().sum(1))


def most_likely(
    periodograms: Tensor, transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, contrasts: Tensor
) -> Tensor:
    """Numbers (B,) of the most likely of transfer functions (D, rows, columns), at the best contrast of each patch.

    contrasts: (C,) factors of the spectrum, of which the most likely one counts.
    """
    spectra = (blurred_spectra(transfer, contrast * spectrum, sigma) for contrast in contrasts.unbind())
    return torch.stack([log_likelihoods(periodograms, part) for part in spectra]).amax(0).argmax(1)
