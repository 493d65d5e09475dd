"""The closed form of linear restoration: against drawn noise, and in its limits."""

import pytest
import torch
from differences import gradcheck

from raytrace.imaging.closed_form import patch_spectrum
from raytrace.imaging.image import transfer_functions
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.restoration import depth_invariant_error, depth_invariant_wiener, errors

SIZE = 24


def gaussians(*widths: float) -> torch.Tensor:
    x = torch.arange(-5, 6, dtype=torch.float64)
    kernels = [torch.exp(-0.5 * (x[:, None] ** 2 + x**2) / w**2) for w in widths]
    return torch.stack([kernel / kernel.sum() for kernel in kernels])


def falling_spectrum() -> torch.Tensor:
    f = torch.fft.fftfreq(SIZE, dtype=torch.float64)
    return 0.05 / (1e-3 + f[:, None] ** 2 + f**2)


@pytest.mark.parametrize("knows", [False, True])
def test_error_is_that_of_drawn_pictures_and_noise(knows):
    """4,000 draws of pictures of that spectrum: the closed form within 1 %."""
    generator = torch.Generator().manual_seed(2)
    S, sigma, H = falling_spectrum(), 0.3, transfer_functions(gaussians(0.6, 2.0), SIZE)
    white = torch.randn(2, 4000, SIZE, SIZE, generator=generator, dtype=torch.float64)
    picture = S.sqrt() * torch.fft.fft2(white[0])
    noise = sigma * torch.fft.fft2(white[1])
    expected = depth_invariant_error(H[None], S, sigma) if knows else errors(H, S, sigma)
    for z in range(2):
        G = depth_invariant_wiener(H[z : z + 1] if knows else H, S, sigma)
        left = torch.fft.ifft2(G * (H[z] * picture + noise) - picture).real
        assert float(left.square().mean()) == pytest.approx(float(expected[z]), rel=0.01)


def test_no_other_filter_does_better():
    """The mean error is stationary at the filter, and rises in every direction by what is added, quadratically."""
    S, sigma, H = falling_spectrum(), 0.2, transfer_functions(gaussians(0.6, 1.2, 2.0), SIZE)
    best, G = errors(H, S, sigma).mean(), depth_invariant_wiener(H, S, sigma)
    generator = torch.Generator().manual_seed(1)
    for _ in range(3):
        change = torch.view_as_complex(torch.randn(SIZE, SIZE, 2, generator=generator, dtype=torch.float64))
        rises = [float(errors(H, S, sigma, filter=G + step * change).mean() - best) for step in (1e-3, 2e-3)]
        assert rises[0] > 0
        assert rises[1] / rises[0] == pytest.approx(4.0, rel=1e-3)


def test_limits():
    S, H = falling_spectrum(), transfer_functions(gaussians(0.6, 2.0), SIZE)
    # One kernel: blind and knowing are the same; without blur σ²S/(S + σ²); with much noise nothing is restored.
    torch.testing.assert_close(errors(H[:1], S, 0.1), depth_invariant_error(H[None, :1], S, 0.1), rtol=1e-12, atol=0)
    flat = torch.ones(1, SIZE, SIZE, dtype=torch.complex128)
    torch.testing.assert_close(errors(flat, S, 0.1)[0], (S * 0.01 / (S + 0.01)).mean(), rtol=1e-12, atol=0)
    torch.testing.assert_close(errors(H, S, 1e6), S.mean().expand(2), rtol=1e-6, atol=0)
    assert bool((errors(H, S, 0.1) >= depth_invariant_error(H[None], S, 0.1)).all())


def test_transfer_function_of_a_symmetric_kernel_is_real_and_one_at_zero():
    H = transfer_functions(gaussians(0.6, 2.0), SIZE)
    torch.testing.assert_close(H[:, 0, 0].real, torch.ones(2, dtype=torch.float64))
    assert float(H.imag.abs().max()) < 1e-15


def test_spectrum_of_pictures_adds_up_to_their_mean_square():
    pictures = dead_leaves(12, size=48)
    S = patch_spectrum(pictures, 32, crops=8)
    mean_square = sum(float((sample / 255.0).__pow__(2).mean()) for sample in pictures.samples) / len(pictures)
    assert float(S.mean()) == pytest.approx(mean_square, rel=0.1)
    assert float(S[0, 0]) > 100 * float(S[8, 8]) > 0


def test_derivatives_in_the_kernels():
    S = falling_spectrum()[:12, :12].contiguous()

    def mean_error(kernels):
        return errors(transfer_functions(kernels, 12), S, 0.1).mean()

    assert gradcheck(mean_error, gaussians(0.8, 1.5)[:, 3:8, 3:8].clone().requires_grad_())
