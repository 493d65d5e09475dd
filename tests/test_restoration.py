"""Deconvolution: against dense least squares, drawn noise, and its limits."""

import functools
import math

import pytest
import torch
from differences import gradcheck
from problems import covariance, draws

from raytrace.imaging.image import blur, transfer_functions
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.restoration import (
    depth_invariant_error,
    depth_invariant_wiener,
    errors,
    errors_knowing,
    kernel_error,
    mean_square_error,
    power_law,
    power_spectrum,
    psnr,
    restore,
    towards_estimate,
    towards_measurement,
    wiener,
    within,
)


def gaussians(*widths: float, size: int = 11) -> torch.Tensor:
    x = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    kernels = [torch.exp(-0.5 * (x[:, None] ** 2 + x**2) / w**2) for w in widths]
    return torch.stack([kernel / kernel.sum() for kernel in kernels])


def pillbox(radius: float, size: int) -> torch.Tensor:
    x = torch.arange(size, dtype=torch.float64) - size // 2
    disc = (x[:, None] ** 2 + x**2 <= radius**2).to(torch.float64)
    return disc / disc.sum()


@functools.cache
def leaves() -> torch.Tensor:
    """24 pictures of 80 × 80."""
    return torch.stack([torch.as_tensor(sample) for sample in dead_leaves(24, size=80).samples]).to(torch.float64) / 255


def dense(kernel: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """The matrix of the circular blur of pictures read row by row."""
    count = size[0] * size[1]
    points = torch.eye(count, dtype=torch.float64).reshape(count, *size)
    return blur(points, kernel, boundary="circular").reshape(count, count).T


# --- one known kernel


@pytest.mark.parametrize(("shape", "spot"), [((16, 16), 5), ((15, 20), 5), ((16, 12), 4)])
@pytest.mark.parametrize("build", [wiener, towards_measurement])
def test_frequencies_with_signal_are_inverted(build, shape, spot):
    """Noise-free, |H| ≥ 0.2, γ = 1e-10: the picture within 1e-6, not shifted; so for even kernels, and pictures not
    square."""
    kernel = 0.4 * draws(spot, spot, seed=3) / spot**2
    kernel[spot // 2, spot // 2] += 0.8
    picture = draws(2, *shape)
    image = blur(picture, kernel, boundary="circular")
    H = transfer_functions(kernel, shape)
    assert float(H.abs().min()) > 0.2
    torch.testing.assert_close(restore(image, build(H, 1e-10)), picture, atol=1e-6, rtol=0)
    torch.testing.assert_close(restore(image, build(H, 0.0)), picture, atol=1e-12, rtol=0)


def test_much_regularisation_leaves_the_measurement_or_nothing():
    kernel, image = gaussians(1.5)[0], draws(20, 16)
    H = transfer_functions(kernel, (20, 16))
    torch.testing.assert_close(restore(image, towards_measurement(H, 1e9)), image, atol=1e-8, rtol=0)
    torch.testing.assert_close(restore(image, wiener(H, 1e9)), torch.zeros_like(image), atol=1e-8, rtol=0)
    other = draws(20, 16, seed=1)
    found = towards_estimate(image, H, 1e9, estimate=other)
    torch.testing.assert_close(found, other, atol=1e-8, rtol=0)


@pytest.mark.parametrize("gamma", [1e-3, 0.3, 4.0])
def test_is_the_least_squares_solution(gamma):
    """An 8 × 8 problem: the least of |A x - y|² + γ|x - x₀|² for x₀ of 0, the measurement, and anything."""
    kernel, image, other = draws(3, 4, seed=1) / 12, draws(8, 8, seed=2), draws(8, 8, seed=3)
    A, H = dense(kernel, (8, 8)), transfer_functions(kernel, 8)
    stacked = torch.cat([A, math.sqrt(gamma) * torch.eye(64, dtype=torch.float64)])

    def least(estimate: torch.Tensor) -> torch.Tensor:
        right = torch.cat([image.flatten(), math.sqrt(gamma) * estimate.flatten()])
        return torch.linalg.lstsq(stacked, right[:, None]).solution.reshape(8, 8)

    close = {"atol": 1e-11, "rtol": 0}
    torch.testing.assert_close(restore(image, wiener(H, gamma)), least(torch.zeros_like(image)), **close)
    torch.testing.assert_close(restore(image, towards_measurement(H, gamma)), least(image), **close)
    torch.testing.assert_close(towards_estimate(image, H, gamma, estimate=other), least(other), **close)


def test_zeros_of_the_transfer_function():
    """A pillbox that cannot see two waves: finite at γ = 0 with its gradients, nothing or the estimate at the zeros."""
    kernel = torch.ones(1, 4, dtype=torch.float64) / 4
    kernel.requires_grad_()
    H = transfer_functions(kernel, 8)
    blind = H.detach().abs() < 1e-15
    assert int(blind.sum()) == 3 * 8
    H = torch.where(blind, 0.0, H)
    image, gamma = draws(8, 8), torch.zeros((), dtype=torch.float64, requires_grad=True)
    for build, left in ((wiener, 0.0), (towards_measurement, 1.0)):
        G = build(H, gamma)
        assert bool((G[blind] == left).all())
        slopes = torch.autograd.grad(restore(image, G).square().sum(), (kernel, gamma), retain_graph=True)
        assert all(bool(torch.isfinite(slope).all()) for slope in slopes)
    H = transfer_functions(pillbox(3.2, 9), (24, 20))
    S = power_law((24, 20))
    for sigma in (0.0, 1e-3):
        assert bool(torch.isfinite(depth_invariant_wiener(H[None], S, sigma).abs()).all())
        assert bool(torch.isfinite(errors(H[None], S, sigma)).all())


def test_gamma_and_kernel_have_derivatives():
    image, kernel = draws(6, 5), draws(3, 3, seed=1)
    gamma, other = torch.tensor(0.7, dtype=torch.float64), draws(6, 5, seed=2)

    def restored(image, kernel, gamma, other):
        H = transfer_functions(kernel, (6, 5))
        pictures = restore(image, wiener(H, gamma**2)), restore(image, towards_measurement(H, gamma**2))
        return *pictures, towards_estimate(image, H, gamma**2, estimate=other)

    assert gradcheck(restored, [x.requires_grad_() for x in (image, kernel, gamma, other)])


def test_gamma_may_depend_on_frequency_or_colour():
    H, S, sigma = transfer_functions(gaussians(0.8, 1.5), 16), power_law(16), 0.05
    torch.testing.assert_close(
        wiener(H[:1], sigma**2 / S)[0], depth_invariant_wiener(H[:1], S, sigma), rtol=1e-12, atol=1e-15
    )
    gammas = torch.tensor([0.1, 0.4], dtype=torch.float64)[:, None, None]
    for G, one, gamma in zip(wiener(H, gammas), H, (0.1, 0.4), strict=True):
        torch.testing.assert_close(G, wiener(one, gamma))


# --- many kernels


def test_depth_invariant_wiener_is_the_dense_best_linear_estimate():
    """8 × 6 pixels, three kernels: C⟨A⟩ᵀ(⟨A C Aᵀ⟩ + σ²)⁻¹, and the error of every kernel as the trace of its matrix."""
    size, sigma, S = (8, 6), 0.2, power_law((8, 6))
    kernels = draws(3, 4, 3, seed=1) / 12
    H, C = transfer_functions(kernels, size), covariance(S)
    A = torch.stack([dense(kernel, size) for kernel in kernels])
    white = sigma**2 * torch.eye(48, dtype=torch.float64)
    best = C @ A.mean(0).T @ torch.linalg.inv((A @ C @ A.mT).mean(0) + white)
    image = draws(*size, seed=2)
    G = depth_invariant_wiener(H, S, sigma)
    torch.testing.assert_close(restore(image, G).flatten(), best @ image.flatten(), atol=1e-11, rtol=0)
    left = best @ A - torch.eye(48, dtype=torch.float64)
    expected = torch.stack([(one @ C @ one.T + best @ white @ best.T).trace() / 48 for one in left])
    torch.testing.assert_close(errors(H, S, sigma), expected, rtol=1e-11, atol=0)
    torch.testing.assert_close(depth_invariant_error(H, S, sigma), expected.mean(), rtol=1e-11, atol=0)


@pytest.mark.parametrize("name", ["blind", "wiener", "measurement"])
def test_closed_form_is_the_error_of_drawn_noise(name):
    """24 dead leaves of their own spectrum, three colours and depths: within 1 % of what a draw of noise leaves."""
    size, sigma = (48, 60), 0.05
    pictures = torch.stack([leaves()[:, 8 * c : 8 * c + 48, 10 * c : 10 * c + 60] for c in range(3)], 1)
    S = power_spectrum(pictures, window="none")
    widths = ((0.5, 0.6, 0.7), (1.0, 1.2, 1.5), (2.0, 1.5, 1.0))
    H = transfer_functions(torch.stack([gaussians(*line) for line in widths]), size)
    known = H[1]
    G = {
        "blind": depth_invariant_wiener(H, S, sigma),
        "wiener": wiener(known, 0.02),
        "measurement": towards_measurement(known, 0.1),
    }[name]
    image = torch.fft.ifft2(H[:, None] * torch.fft.fft2(pictures)).real
    image = image + sigma * torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = mean_square_error(restore(image, G), pictures).mean(1)
    torch.testing.assert_close(found, errors(H, S, sigma, filter=G), rtol=0.01, atol=0)


def test_no_other_filter_does_better_over_colours():
    S, sigma = power_law(16), torch.tensor([0.1, 0.2], dtype=torch.float64)[:, None, None]
    H = transfer_functions(torch.stack([gaussians(0.6, 1.0), gaussians(2.0, 1.4)]), 16)
    best, G = errors(H, S, sigma), depth_invariant_wiener(H, S, sigma)
    assert best.shape == (2, 2)
    torch.testing.assert_close(depth_invariant_error(H, S, sigma), best.mean(0), rtol=1e-12, atol=0)
    for colour in range(2):
        alone = errors(H[:, colour], S, sigma[colour])
        torch.testing.assert_close(best[:, colour], alone, rtol=1e-12, atol=0)
    for other in (wiener(H[0], 0.05), 1.01 * G, G + 0.01j):
        assert bool((errors(H, S, sigma, filter=other).mean(0) > best.mean(0)).all())
    assert bool((errors_knowing(H, S, sigma) <= best).all())


def test_small_errors_keep_their_digits():
    """One kernel and little noise in single precision: σ²⟨1/|H|²⟩, 1e-8 of the pictures' power."""
    S, sigma = power_law(32).to(torch.float32), 1e-5
    H = transfer_functions(gaussians(0.4).to(torch.float32), 32)
    expected = (S * sigma**2 / (S * H.abs() ** 2 + sigma**2)).mean()
    assert float(depth_invariant_error(H, S, sigma)) == pytest.approx(float(expected), rel=1e-5)
    assert depth_invariant_error(H, S, sigma).dtype == torch.float32


def test_depth_invariant_error_without_light_or_noise():
    S, dark = power_law(8), torch.zeros(2, 8, 8, dtype=torch.complex128)
    assert float(depth_invariant_error(dark, S, 0.0)) == pytest.approx(float(S.mean()))
    torch.testing.assert_close(errors(dark, S, 0.0), S.mean().expand(2))
    assert float(depth_invariant_error(torch.ones_like(dark), S, 0.0)) == 0.0


@pytest.mark.parametrize("size", [(12, 12), (11, 14), (14, 11), (9, 9)])
def test_half_the_frequencies_determine_all(size):
    """Even and odd, colours, derivatives too: `depth_invariant_error` of the transfer functions."""
    kernels, S, sigma = draws(3, 2, 6, 5, seed=1).requires_grad_(), power_law(size), 0.3
    half, full = kernel_error(kernels, S, sigma), depth_invariant_error(transfer_functions(kernels, size), S, sigma)
    torch.testing.assert_close(half, full, rtol=1e-12, atol=0)
    slopes = [torch.autograd.grad(error.sum(), kernels)[0] for error in (half, full)]
    torch.testing.assert_close(*slopes, rtol=1e-9, atol=1e-12)


def test_derivatives_of_the_closed_form():
    S = power_law(8)

    def closed_form(kernels, sigma):
        H = transfer_functions(kernels, 8)
        return (
            depth_invariant_error(H, S, sigma),
            errors(H, S, sigma),
            errors(H, S, sigma, filter=towards_measurement(H[0], 0.3)),
        )

    inputs = gaussians(0.8, 1.5, size=3), torch.tensor(0.1, dtype=torch.float64)
    assert gradcheck(closed_form, [x.requires_grad_() for x in inputs])


# --- pictures with borders


def test_taper_keeps_borders_from_ringing():
    """A scene seen through a window, 24 pictures: the error within a kernel's margin, over that of the endless scene.

    Measured: taper 1.12, reflect 1.41, circular 7.8, zero 32. The reflection has its jump in the middle of what is
    added, 8 pixels off the border: nearer than the filter reaches at this noise.
    """
    pictures, sigma = leaves(), 0.002
    kernel = gaussians(2.5, size=15)[0]
    noise = sigma * torch.randn(24, 80, 80, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    endless = blur(pictures, kernel, boundary="circular") + noise

    def best(size: int) -> torch.Tensor:
        return depth_invariant_wiener(transfer_functions(kernel, size)[None], power_law(size), sigma)

    def error(restored: torch.Tensor) -> float:
        return float(mean_square_error(restored, within(pictures, 12), margin=7).mean())

    image, least = within(endless, 12), error(within(restore(endless, best(80)), 12))
    left = {name: error(restore(image, best(72), boundary=name)) / least for name in ("zero", "reflect", "taper")}
    left["circular"] = error(restore(image, best(56))) / least
    assert 0.99 < left["taper"] < 1.15 < 1.3 < left["reflect"] < 2 < 5 < left["circular"] < left["zero"]


def test_flat_images_stay_flat():
    image = torch.full((2, 10, 14), 0.4, dtype=torch.float64)
    H = transfer_functions(gaussians(1.0, size=5)[0], (16, 20))
    for boundary in ("reflect", "taper"):
        found = restore(image, wiener(H, 1e-12), boundary=boundary)
        torch.testing.assert_close(found, image, atol=1e-9, rtol=0)


def test_margins_and_psnr():
    truth, estimate = torch.zeros(3, 10, 12, dtype=torch.float64), torch.full((3, 10, 12), 0.1, dtype=torch.float64)
    estimate[:, 0], estimate[:, :, -3:] = 7.0, 5.0
    assert within(estimate, (1, 3)).shape == (3, 8, 6)
    found = psnr(mean_square_error(estimate, truth, margin=(1, 3)))
    torch.testing.assert_close(found, torch.full((3,), 20.0, dtype=torch.float64))
    assert float(psnr(torch.tensor(1.0), peak=255.0)) == pytest.approx(48.1308, abs=1e-4)
    assert float(psnr(torch.tensor(0.0))) == math.inf
    with pytest.raises(ValueError, match="a margin of 5 rows and 5 columns of 10 × 12 pixels: nothing is left"):
        within(estimate, 5)


def test_mismatched_shapes_are_refused():
    with pytest.raises(ValueError, match="'circular', an image of 8 × 8 pixels, a filter of 12 × 12: expected equal"):
        restore(torch.zeros(8, 8), torch.zeros(12, 12))
    with pytest.raises(ValueError, match="boundary 'valid'"):
        restore(torch.zeros(8, 8), torch.zeros(8, 8), boundary="valid")
    with pytest.raises(ValueError, match="window 'hamming': expected hann, none"):
        power_spectrum(torch.zeros(1, 8, 8), window="hamming")


# --- spectra


def test_spectra_add_up_to_the_mean_square():
    S = power_law((20, 30), mean=0.4, deviation=0.2)
    assert float(S.mean()) == pytest.approx(0.4**2 + 0.2**2, rel=1e-12)
    assert float(S[0, 2] / S[0, 4]) == pytest.approx(4.0)
    pictures = leaves()[:6, :32, :32].reshape(3, 2, 32, 32)
    measured = power_spectrum(pictures, window="none")
    torch.testing.assert_close(measured.mean((-2, -1)), pictures.square().mean((0, 2, 3)))


def test_window_shows_the_fall_of_the_spectrum():
    """Pictures of a 1/f³ law cut from larger ones: windowed, the fall between two octaves is theirs; else flatter."""
    big = power_law(256, exponent=3.0)
    white = torch.randn(20, 256, 256, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    pictures = torch.fft.ifft2(big.sqrt() * torch.fft.fft2(white)).real[:, :64, :64]
    falls = {}
    for window in ("hann", "none"):
        S = power_spectrum(pictures, window=window)
        falls[window] = float(torch.log2(S[0, 7:10].mean() / S[0, 14:19].mean()))
    assert falls["hann"] == pytest.approx(3.0, abs=0.4)
    assert falls["none"] < 2.4


def test_single_precision_stays_single():
    kernel, image = gaussians(1.0, size=5).to(torch.float32), draws(12, 9, dtype=torch.float32)
    S = power_law((12, 9))
    H = transfer_functions(kernel, (12, 9))
    found = restore(image, depth_invariant_wiener(H, S.to(torch.float32), 0.1))
    exact = transfer_functions(kernel.to(torch.float64), (12, 9))
    expected = restore(image.to(torch.float64), depth_invariant_wiener(exact, S, 0.1))
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.to(torch.float64), expected, atol=1e-5, rtol=0)
