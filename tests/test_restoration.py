"""Deconvolution: against dense least squares, drawn noise, and its limits."""

import functools
import math
from fractions import Fraction

import pytest
import torch
from differences import gradcheck
from problems import covariance, draws

from raytrace.imaging.image import blur, transfer_functions
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.restoration import (
    cross_spectrum,
    depth_invariant_error,
    depth_invariant_wiener,
    errors,
    joint_error,
    joint_errors,
    joint_kernel_error,
    joint_wiener,
    kernel_error,
    mean_square_error,
    power_law,
    power_spectrum,
    psnr,
    restore,
    restore_jointly,
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


def test_errors_of_many_spectra_are_those_of_each():
    """Of single pictures, of two depths and three colours, behind one filter."""
    H = transfer_functions(gaussians(0.5, 1, 1.5, 2, 2.5, 3).unflatten(0, (2, 3)), 80)
    powers = power_spectrum(leaves()[None, :4])
    G = depth_invariant_wiener(H, powers.mean(0), 0.05)
    several = errors(H, powers[:, None, None], 0.05, filter=G)
    assert several.shape == (4, 2, 3)
    each = torch.stack([errors(H, power, 0.05, filter=G) for power in powers])
    torch.testing.assert_close(several, each, rtol=1e-13, atol=0)
    remaining = powers[:, None, None] * (G * H - 1).abs().square() + 0.05**2 * G.abs().square()
    torch.testing.assert_close(several, remaining.mean((-2, -1)), rtol=1e-13, atol=0)


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
    assert bool((depth_invariant_error(H[None], S, sigma) <= best).all())


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
    with pytest.raises(ValueError, match="5 rows and 5 columns of 10 × 12 pixels: nothing"):
        within(estimate, 5)


def test_mismatched_shapes_are_refused():
    with pytest.raises(ValueError, match=r"8 × 8 pixels, .* 12 × 12: expected equal"):
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


# --- joint filters


def blurs(*shape: int, seed: int = 1) -> torch.Tensor:
    """Random positive kernels that sum to 1."""
    kernels = draws(*shape, seed=seed)
    return kernels / kernels.sum((-2, -1), keepdim=True)


def mixed(size: tuple[int, int], seed: int = 5) -> torch.Tensor:
    """Cross spectra (3, 3, rows, columns) of real pictures: of power laws, seen through random kernels and mixed."""
    filters = transfer_functions(draws(3, 3, 3, 3, seed=seed) - 0.4, size)
    powers = torch.stack([power_law(size, exponent=exponent) for exponent in (1.0, 2.0, 2.5)])
    return torch.einsum("cmrs,mrs,dmrs->cdrs", filters, powers, filters.conj())


def correlated(correlation: float, spectrum: torch.Tensor) -> torch.Tensor:
    matrix = correlation + (1 - correlation) * torch.eye(3, dtype=torch.float64)
    return matrix[:, :, None, None] * spectrum


def joint_covariance(spectrum: torch.Tensor) -> torch.Tensor:
    """The matrix E[x xᵀ] of periodic pictures of three channels, read channel by channel."""
    rows, columns = spectrum.shape[-2:]
    correlation = torch.fft.ifft2(spectrum)
    assert float(correlation.imag.abs().max()) < 1e-12
    i, j = (n.flatten() for n in torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij"))
    blocks = correlation.real[:, :, (i[:, None] - i) % rows, (j[:, None] - j) % columns]
    return torch.cat([torch.cat([*line], 1) for line in blocks])


@pytest.mark.parametrize("depths", [1, 3])
def test_joint_wiener_is_the_dense_best_linear_estimate(depths):
    """6 × 5 pixels of three channels, noise of each: C⟨A⟩ᵀ(⟨A C Aᵀ⟩ + N)⁻¹, its error of every channel and depth."""
    size, S = (6, 5), mixed((6, 5))
    sigma = torch.tensor([0.05, 0.2, 0.1], dtype=torch.float64)[:, None, None]
    kernels = blurs(depths, 3, 4, 3)
    H, C = transfer_functions(kernels, size), joint_covariance(S)
    A = torch.stack([torch.block_diag(*[dense(one, size) for one in of_depth]) for of_depth in kernels])
    noise = torch.diag(sigma.flatten().square().repeat_interleave(30))
    best = C @ A.mean(0).T @ torch.linalg.inv((A @ C @ A.mT).mean(0) + noise)
    image, G = draws(3, *size, seed=2), joint_wiener(H, S, sigma)
    torch.testing.assert_close(restore_jointly(image, G).flatten(), best @ image.flatten(), atol=1e-11, rtol=0)
    left = best @ A - torch.eye(90, dtype=torch.float64)
    expected = [(one @ C @ one.T + best @ noise @ best.T).diagonal().unflatten(0, (3, 30)).mean(-1) for one in left]
    torch.testing.assert_close(joint_errors(H, S, sigma), torch.stack(expected), rtol=1e-10, atol=0)
    torch.testing.assert_close(joint_error(H, S, sigma), torch.stack(expected).mean(0), rtol=1e-10, atol=0)
    torch.testing.assert_close(joint_kernel_error(kernels, S, sigma), joint_error(H, S, sigma), rtol=1e-12, atol=0)


@pytest.mark.parametrize("sigma", [0.1, 1e-4, 0.0])
def test_joint_filters_of_uncorrelated_channels_are_those_of_each(sigma):
    """Without cross spectra: filter, its errors, those of another filter, and the derivatives; of two fields."""
    S = torch.stack([power_law((12, 10), exponent=exponent) for exponent in (1.0, 2.0, 3.0)])
    matrices = S * torch.eye(3, dtype=torch.float64)[:, :, None, None]
    kernels = blurs(2, 4, 3, 5, 4).requires_grad_()
    H = transfer_functions(kernels, (12, 10))
    close = {"rtol": 1e-12, "atol": 1e-12}
    G, single = joint_wiener(H, matrices, sigma), depth_invariant_wiener(H, S, sigma)
    torch.testing.assert_close(G.diagonal(dim1=-4, dim2=-3).movedim(-1, -3), single, **close)
    assert not (G * (1 - torch.eye(3, dtype=torch.float64))[:, :, None, None]).any()
    torch.testing.assert_close(joint_errors(H, matrices, sigma), errors(H, S, sigma), **close)
    torch.testing.assert_close(joint_error(H, matrices, sigma), depth_invariant_error(H, S, sigma), rtol=1e-12, atol=0)
    found, expected = joint_kernel_error(kernels, matrices, sigma), kernel_error(kernels, S, sigma)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    slopes = [torch.autograd.grad(error.sum(), kernels)[0] for error in (found, expected)]
    torch.testing.assert_close(*slopes, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("correlation", [0.0, 0.9, 0.97, 0.999, 1.0])
@pytest.mark.parametrize("sigma", [1e-2, 1e-5])
def test_nearly_singular_spectra_and_little_noise(correlation, sigma):
    """Against rational numbers: (S⁻¹ + H*H/σ²)⁻¹ of S = ρ p + (1 - ρ) p 1, equal channels.

    Channels that transmit much, little and nothing. Double precision keeps 11 digits of errors down to 1e-15 of the
    signal, single precision 4 digits.
    """
    H = torch.tensor([0.9, 0.02 + 0.01j, 0.0], dtype=torch.complex128)[:, None, None]
    S = correlated(correlation, torch.full((1, 1), 300.0, dtype=torch.float64))
    # Given the common part, channels are independent: information of the common part, by each.
    common, own = Fraction(correlation) * 300, (1 - Fraction(correlation)) * 300
    noise = Fraction(sigma) ** 2
    squares = [Fraction(float(h.real)) ** 2 + Fraction(float(h.imag)) ** 2 for h in H.flatten()]
    information = [square / (square * own + noise) for square in squares]
    remaining = common / (1 + common * sum(information))
    expected = []
    for square, one in zip(squares, information, strict=True):
        share = 1 - own * one  # of the common part in the channel's error
        expected.append(float(own * noise / (own * square + noise) + share**2 * remaining))
    expected = torch.tensor(expected, dtype=torch.float64)
    for dtype, digits in ((torch.complex128, 1e-11), (torch.complex64, 1e-3)):
        of_spectrum = S.to(torch.empty(0, dtype=dtype).real.dtype)
        found = joint_error(H[None].to(dtype), of_spectrum, sigma)
        torch.testing.assert_close(found.to(torch.float64), expected, rtol=digits, atol=0)
        G = joint_wiener(H[None].to(dtype), of_spectrum, sigma)
        assert bool(torch.isfinite(G.abs()).all())


def test_no_noise_and_no_light():
    """σ → 0: what is transmitted is restored; a channel without light is predicted from the others, or lost."""
    S, size = correlated(0.97, power_law(8)), 8
    H = transfer_functions(gaussians(0.4, 0.5, 0.6, size=5), size).clone()
    H[2] = 0
    H.requires_grad_()
    limit, found = joint_error(H[None], S, 1e-9), joint_error(H[None], S, 0.0)
    assert float(found.detach()[:2].abs().max()) < 1e-25
    one = 0.97 * 2 / (1 + 0.97)  # of two channels that are known, the best prediction of the third
    torch.testing.assert_close(found[2], S[2, 2].mean() * (1 - 0.97 * one), rtol=1e-12, atol=0)
    torch.testing.assert_close(found, limit, rtol=1e-9, atol=1e-15)
    (slope,) = torch.autograd.grad(found.sum(), H)
    assert bool(torch.isfinite(slope.abs()).all())
    dark = torch.zeros(2, 3, size, size, dtype=torch.complex128)
    torch.testing.assert_close(joint_error(dark, S, 0.0), S[0, 0].mean().expand(3), rtol=1e-12, atol=0)
    assert not joint_wiener(dark, S, 0.0).any()
    assert not joint_error(torch.ones_like(dark), S, 0.0).any()


def test_correlation_helps_and_no_other_joint_filter_does_better():
    """More correlation, less error; filters of each channel alone, scaled and shifted ones leave more."""
    S, sigma = power_law((12, 9)), 0.05
    H = transfer_functions(torch.stack([gaussians(0.5, 1.0, 1.6, size=9), gaussians(1.4, 0.9, 0.6, size=9)]), (12, 9))
    left = [float(joint_error(H, correlated(r, S), sigma).mean()) for r in (0.0, 0.5, 0.9, 0.97, 0.999)]
    assert left == sorted(left, reverse=True)
    assert left[3] < 0.8 * left[0]
    matrices = mixed((12, 9))
    best, G = joint_errors(H, matrices, sigma).mean(0), joint_wiener(H, matrices, sigma)
    powers = matrices.diagonal().movedim(-1, 0).real
    alone = depth_invariant_wiener(H, powers, sigma)
    identity = torch.eye(3, dtype=torch.float64)[:, :, None, None]
    torch.testing.assert_close(joint_errors(H, matrices, sigma, filter=alone * identity), errors(H, powers, sigma))
    for other in (alone * identity, 1.01 * G, G + 0.01j, G + 0.01 * identity.roll(1, 0)):
        assert bool((joint_errors(H, matrices, sigma, filter=other).mean(0) > best).all())


def test_derivatives_of_the_joint_closed_form():
    """By differences, through kernels and noise of each channel, of errors and of restored pictures."""
    S, image = mixed((6, 5)), draws(3, 6, 5, seed=3)

    def closed_form(kernels, sigma):
        H = transfer_functions(kernels, (6, 5))
        G = joint_wiener(H, S, sigma)
        errors = joint_error(H, S, sigma), joint_errors(H, S, sigma, filter=joint_wiener(H[:1], S, 0.2))
        return *errors, joint_kernel_error(kernels, S, sigma), restore_jointly(image, G)

    inputs = blurs(2, 3, 3, 3), torch.tensor([0.1, 0.2, 0.05], dtype=torch.float64)[:, None, None]
    assert gradcheck(closed_form, [x.requires_grad_() for x in inputs], fast_mode=True)


@pytest.mark.parametrize("size", [(12, 12), (9, 14), (7, 9)])
def test_half_the_frequencies_determine_all_of_joint_errors(size):
    """Even and odd, of fields and depths, derivatives too."""
    kernels, S = blurs(2, 4, 3, 6, 5).requires_grad_(), mixed(size)
    half, full = joint_kernel_error(kernels, S, 0.1), joint_error(transfer_functions(kernels, size), S, 0.1)
    assert half.shape == (4, 3)
    torch.testing.assert_close(half, full, rtol=1e-11, atol=0)
    slopes = [torch.autograd.grad(error.sum(), kernels)[0] for error in (half, full)]
    torch.testing.assert_close(*slopes, rtol=1e-8, atol=1e-12)


@functools.cache
def coloured_leaves() -> torch.Tensor:
    """16 pictures (3, 48, 48)."""
    samples = dead_leaves(16, size=48, colour=True).samples
    return torch.stack([torch.as_tensor(sample) for sample in samples]).permute(0, 3, 1, 2).to(torch.float64) / 255


def test_joint_closed_form_is_the_error_of_drawn_noise():
    """Dead leaves of their own cross spectra, two depths, 16 draws: the mean square error in its 99 % interval."""
    pictures, sigma = coloured_leaves(), 0.05
    S = cross_spectrum(pictures, window="none")
    H = transfer_functions(torch.stack([gaussians(0.5, 1.0, 1.8), gaussians(1.6, 0.9, 0.6)]), 48)
    G = joint_wiener(H, S, sigma)
    image = torch.fft.ifft2(H[:, None] * torch.fft.fft2(pictures)).real
    noise = torch.randn(16, *image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    drawn = mean_square_error(restore_jointly(image + sigma * noise, G), pictures).mean(2)  # (draws, Z, C)
    expected = joint_errors(H, S, sigma)
    width = 2.95 * drawn.std(0) / 4  # Student's t of 15, 99 %
    assert bool(((drawn.mean(0) - expected).abs() < width).all())
    assert float((width / expected).max()) < 0.01
    S = power_spectrum(pictures, window="none")
    assert bool((expected.mean(0) < depth_invariant_error(H, S, sigma)).all())


def test_cross_spectra_hold_those_of_each_channel():
    pictures = coloured_leaves()[:, :, :30, :].reshape(4, 4, 3, 30, 48)
    for window in ("hann", "none"):
        S = cross_spectrum(pictures, window=window)
        assert S.shape == (4, 3, 3, 30, 48)
        powers = S.diagonal(dim1=1, dim2=2).movedim(-1, 1)
        torch.testing.assert_close(powers.real, power_spectrum(pictures, window=window), rtol=1e-12, atol=1e-15)
        torch.testing.assert_close(S.transpose(1, 2).conj(), S, rtol=0, atol=0)
    expected = (pictures[:, :, :, None] * pictures[:, :, None]).mean((0, -2, -1))  # Parseval
    torch.testing.assert_close(S.mean((-2, -1)).real, expected, rtol=1e-12, atol=0)
    same = cross_spectrum(pictures[:, :, :1].expand(-1, -1, 3, -1, -1))
    torch.testing.assert_close(same, same[:, :1, :1].expand_as(same))


def test_joint_filters_of_extended_images():
    """Flat images stay flat, fields have filters of their own, single precision stays."""
    S, H = correlated(0.9, power_law((16, 20))), transfer_functions(blurs(1, 2, 3, 5, 5), (16, 20))
    G = joint_wiener(H, S, 1e-6)
    flat = torch.tensor([0.4, 0.3, 0.7], dtype=torch.float64)[:, None, None].expand(2, 3, 10, 14)
    torch.testing.assert_close(restore_jointly(flat, G, boundary="taper"), flat, atol=1e-8, rtol=0)
    image = draws(2, 3, 16, 20)
    found = restore_jointly(image, G)
    for field in range(2):
        torch.testing.assert_close(found[field], restore_jointly(image[field], joint_wiener(H[:, field], S, 1e-6)))
    single = restore_jointly(image.float(), joint_wiener(H.to(torch.complex64), S.float(), 0.1))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), restore_jointly(image, joint_wiener(H, S, 0.1)), atol=1e-5, rtol=0)


def test_other_channels_are_refused():
    H, S = transfer_functions(blurs(1, 3, 3, 3), 8), correlated(0.5, power_law(8))
    for call in (joint_wiener, joint_error, joint_errors):
        with pytest.raises(ValueError, match=r"cross spectrum .*\(8, 8\).*\(..., C, C, rows, columns\)"):
            call(H, S[0, 0], 0.1)
    with pytest.raises(ValueError, match=r"\(2, 2, 8, 8\) .*kernels .*\(1, 3, 8, 8\)"):
        joint_kernel_error(blurs(1, 3, 8, 8), S[:2, :2], 0.1)
    with pytest.raises(ValueError, match=r"expected \(B, ..., channels, rows, columns\)"):
        cross_spectrum(torch.rand(3, 8, 8))
    with pytest.raises(ValueError, match=r"\(8, 8\) .*filter .*\(3, 3, 8, 8\): expected"):
        restore_jointly(torch.rand(8, 8), joint_wiener(H, S, 0.1))
