"""Image: what a camera makes of a picture: blur by point spread functions, and sensor noise."""

import torch
from torch import Tensor


def blur(picture: Tensor, kernel: Tensor) -> Tensor:
    """Convolution over the part of the plane where the whole kernel lies on the picture: no border darkens.

        y_ij = Σ_ab h_ab x_(i - a, j - b)

    picture: (..., H, W); kernel: (..., h, w), h ≤ H and w ≤ W, its middle the image of the point; the axes before
    broadcast. Returns (..., H - h + 1, W - w + 1). By FFT of the picture's own size: what wraps around is cut off.
    """
    size, (h, w) = picture.shape[-2:], kernel.shape[-2:]
    if h > size[0] or w > size[1]:
        raise ValueError(f"a kernel of {h} × {w} pixels on a picture of {size[0]} × {size[1]}: expected a larger one")
    spectrum = torch.fft.rfft2(picture) * torch.fft.rfft2(kernel, s=size)
    return torch.fft.irfft2(spectrum, s=size)[..., h - 1 :, w - 1 :]


def add_noise(picture: Tensor, sigma: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Gaussian sensor noise of standard deviation `sigma`, in the units of the picture."""
    noise = torch.randn(picture.shape, dtype=picture.dtype, device=picture.device, generator=generator)
    return picture + sigma * noise
