"""Image formation: a convolution with its adjoint, and noise of the size asked for."""

import pytest
import torch

from raytrace.image import add_noise, blur


def direct(picture: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    """Σ_ab h_ab x_(i - a, j - b), written out."""
    return torch.nn.functional.conv2d(picture[None, None], kernel.flip(-1, -2)[None, None])[0, 0]


@pytest.mark.parametrize("size", [(5, 5), (4, 7), (1, 3), (1, 1)])
def test_blur_is_a_convolution(size):
    picture, kernel = torch.rand(3, 20, 17, dtype=torch.float64), torch.rand(3, *size, dtype=torch.float64)
    found = blur(picture, kernel)
    assert found.shape == (3, 20 - size[0] + 1, 17 - size[1] + 1)
    for one, x, h in zip(found, picture, kernel, strict=True):
        torch.testing.assert_close(one, direct(x, h), atol=1e-13, rtol=0)


def test_a_point_becomes_the_kernel():
    point, kernel = torch.zeros(9, 9, dtype=torch.float64), torch.rand(3, 3, dtype=torch.float64)
    point[4, 4] = 1.0
    torch.testing.assert_close(blur(point, kernel)[2:5, 2:5], kernel, atol=1e-15, rtol=0)


def test_a_flat_picture_keeps_its_level_to_the_border():
    kernel = torch.rand(7, 7, dtype=torch.float64)
    found = blur(torch.full((30, 30), 0.3, dtype=torch.float64), kernel / kernel.sum())
    torch.testing.assert_close(found, torch.full((24, 24), 0.3, dtype=torch.float64), atol=1e-15, rtol=0)


def test_adjoint():
    """<B x, y> = <x, B* y>, B* from autograd: to rounding."""
    picture = torch.rand(2, 16, 16, dtype=torch.float64, requires_grad=True)
    kernel, other = torch.rand(2, 5, 5, dtype=torch.float64), torch.rand(2, 12, 12, dtype=torch.float64)
    image = blur(picture, kernel)
    (back,) = torch.autograd.grad(image, picture, other)
    assert float((image * other).sum().detach()) == pytest.approx(float((picture * back).sum().detach()), rel=1e-13)


def test_derivatives():
    inputs = [torch.rand(2, n, n, dtype=torch.float64, requires_grad=True) for n in (7, 3)]
    assert torch.autograd.gradcheck(blur, inputs)


def test_a_kernel_larger_than_the_picture_is_refused():
    with pytest.raises(ValueError, match="a kernel of 9 × 3 pixels on a picture of 8 × 8"):
        blur(torch.zeros(8, 8), torch.zeros(9, 3))


def test_noise_has_the_deviation_asked_for_and_repeats_with_its_seed():
    picture = torch.full((400, 400), 0.5, dtype=torch.float64)
    first, again = (add_noise(picture, 0.1, generator=torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first, again)
    # 160,000 draws: three deviations of the estimate are 0.0005 of the width, 0.00075 of the mean.
    assert float((first - picture).std()) == pytest.approx(0.1, abs=6e-4)
    assert float((first - picture).mean()) == pytest.approx(0.0, abs=1e-3)
