"""Restoration: linear filters for blurred, noisy images (Wiener), and their mean square error in closed form.

An image x is blurred by one of the kernels h_z; the sensor adds white noise n of variance σ²; a filter G restores it:

    X̂ = G Y,   Y = H_z X + N,      e_z = S |1 - G H_z|² + σ² |G|²,      E|x̂ - x|² = the mean of e_z over frequencies

S is the power spectrum of the images, ordered as by `fft2`; its mean is the mean square of a pixel. Transfer functions
(Z, ..., rows, columns) have the kernels to be averaged over (depths) on the first axis, then colours or fields, each
with its own filter (..., rows, columns). S and σ broadcast against (..., rows, columns).
"""

import math

import torch
from torch import Tensor

from raytrace.imaging.image import EXTENSIONS, as_picture, check_axes, check_fit, extend
from raytrace.maths.numerics import safe_divide


def wiener(transfer: Tensor, noise_to_signal: Tensor | float) -> Tensor:
    """The Wiener filter of one known kernel (Wiener, 1949), any axes before (rows, columns).

        G = H*/(|H|² + γ)

    noise_to_signal: γ ≥ 0, a number or a tensor that broadcasts; γ = σ²/S is optimal. γ = 0 inverts, and gives 0 where
    H is 0.
    """
    return safe_divide(transfer.conj(), _square(transfer) + noise_to_signal)


def towards_estimate(image: Tensor, transfer: Tensor, gamma: Tensor | float, *, estimate: Tensor) -> Tensor:
    """The minimiser of |h ∗ x - y|² + γ |x - x₀|²: inverse where |H| is large, the estimate x₀ elsewhere.

        X̂ = (H* Y + γ X₀)/(|H|² + γ) = X₀ + H* (Y - H X₀)/(|H|² + γ)

    image, estimate: (..., rows, columns), periodic; the second form has the limit γ → 0 where H is 0.
    """
    Y, X = torch.fft.fft2(image), torch.fft.fft2(estimate)
    return torch.fft.ifft2(X + wiener(transfer, gamma) * (Y - transfer * X)).real


def towards_measurement(transfer: Tensor, gamma: Tensor | float) -> Tensor:
    """The filter of `towards_estimate` with the blurred image itself as the estimate.

        G = (H* + γ)/(|H|² + γ) = 1 + H* (1 - H)/(|H|² + γ)

    γ → ∞ returns the measurement. (Sitzmann et al., 2018, learn γ = v² and the depth of H.)
    """
    return 1 + wiener(transfer, gamma) * (1 - transfer)


def depth_invariant_wiener(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """The depth-invariant Wiener filter (..., rows, columns): optimal for images of all transfer functions (Z, ...).

        G = S ⟨H*⟩/(S ⟨|H|²⟩ + σ²),   ⟨·⟩ the mean over the first axis

    At σ = 0 it is 0 where every H is 0.
    """
    power = spectrum * _square(transfer).mean(0) + sigma**2
    return safe_divide(spectrum * transfer.mean(0).conj(), power)


def errors(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, *, filter: Tensor | None = None) -> Tensor:
    """Mean square error (Z, ...) of a pixel for each transfer function; filter: the depth-invariant one by default."""
    G = depth_invariant_wiener(transfer, spectrum, sigma) if filter is None else filter
    return (spectrum * _square(G * transfer - 1) + sigma**2 * _square(G)).mean((-2, -1))


def depth_invariant_error(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """Mean over the kernels of `errors` with the depth-invariant filter (...), without computing the filter.

        e = S - S² |⟨H⟩|²/(S ⟨|H|²⟩ + σ²) = S (S (⟨|H|²⟩ - |⟨H⟩|²) + σ²)/(S ⟨|H|²⟩ + σ²)

    The second form, whose difference is the variance ⟨|H - ⟨H⟩|²⟩, keeps the precision of small errors.
    """
    return depth_invariant_density(transfer, spectrum, sigma).mean((-2, -1))


def depth_invariant_density(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """e (..., frequencies), whose mean over all frequencies is `depth_invariant_error`; any axes of frequencies."""
    middle = transfer.mean(0)
    spread, noise = _square(transfer - middle).mean(0), sigma**2
    total = spectrum * (spread + _square(middle)) + noise
    # Neither signal nor noise: the error is S.
    return spectrum * torch.where(total != 0, safe_divide(spectrum * spread + noise, total), 1.0)


def kernel_error(kernels: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """`depth_invariant_error` (...) of kernels (Z, ..., h, w), from half of the frequencies.

    Images and kernels are real, so that S and |H| are equal at f and -f; the position of the kernels' centre is
    irrelevant as long as it is the same for all Z.
    """
    rows, columns = spectrum.shape[-2:]
    check_fit(kernels.shape[-2:], (rows, columns))
    half = columns // 2 + 1
    place = torch.arange(half, device=spectrum.device)
    # Every column counts for its mirror image too, except 0 and the Nyquist frequency.
    weight = torch.where((place == 0) | (2 * place == columns), 1.0, 2.0).to(spectrum.dtype) * (half / columns)
    transfer = torch.fft.rfft2(kernels, s=(rows, columns))
    return (weight * depth_invariant_density(transfer, spectrum[..., :half], sigma)).mean((-2, -1))


def errors_knowing(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """Mean square error (Z, ...) if the transfer function is known: the minimum over linear filters."""
    return depth_invariant_error(transfer[None], spectrum, sigma)


def restore(image: Tensor, filter: Tensor, *, boundary: str = "circular") -> Tensor:
    """Images (..., H, W) filtered: (..., H, W); differentiable in both arguments.

    filter: (..., rows, columns), the size of the image for "circular", else larger by the extension. boundary: "taper"
    avoids ringing from the jump between opposite borders; "reflect" and "zero" as for `image.extend`.
    """
    image = as_picture(image, "image")
    check_axes(image=image, filter=filter)
    size, shape = image.shape[-2:], filter.shape[-2:]
    if boundary in EXTENSIONS:
        image = extend(image, (shape[0], shape[1]), boundary=boundary)
    elif boundary != "circular" or size != shape:
        raise ValueError(
            f"boundary {boundary!r}, an image of {size[0]} × {size[1]} pixels, a filter of {shape[0]} × {shape[1]}: "
            f"expected equal sizes for 'circular', or {', '.join(EXTENSIONS)} and a larger filter"
        )
    return torch.fft.ifft2(torch.fft.fft2(image) * filter).real[..., : size[0], : size[1]]


def power_spectrum(pictures: Tensor, *, window: str = "hann") -> Tensor:
    """S (..., rows, columns) of images (B, ..., rows, columns): the mean of |X|²/(rows·columns) over the first axis.

    window: "hann" (about the mean) suppresses border discontinuities; "none" is exact for periodic images, where S sums
    to the mean square. Raises ValueError for a single image without the axis B.
    """
    pictures = as_picture(pictures, "set of pictures")
    if pictures.dim() < 3:
        raise ValueError(
            f"pictures of shape {tuple(pictures.shape)}: expected (B, ..., rows, columns); add an axis by picture[None]"
        )
    if window not in ("hann", "none"):
        raise ValueError(f"window {window!r}: expected hann, none")
    rows, columns = pictures.shape[-2:]
    mean = pictures.mean((-2, -1), keepdim=True)
    centred = pictures - mean
    if window == "hann":
        lines = [torch.hann_window(n, dtype=pictures.dtype, device=pictures.device) for n in (rows, columns)]
        fade = lines[0][:, None] * lines[1]
        centred = centred * (fade / fade.square().mean().sqrt())
    power = _square(torch.fft.fft2(centred)) / (rows * columns)
    constant = torch.zeros_like(power)
    constant[..., 0, 0] = mean[..., 0, 0] ** 2 * (rows * columns)
    return (power + constant).mean(0)


def power_law(
    size: int | tuple[int, int], *, mean: float = 0.5, deviation: float = 0.25, exponent: float = 2.0
) -> Tensor:
    """S ∝ 1/|f|^exponent of natural images (Field, 1987), float64; mean, deviation: those of a pixel."""
    rows, columns = (size, size) if isinstance(size, int) else size
    lines = [torch.fft.fftfreq(n, dtype=torch.float64) for n in (rows, columns)]
    square = lines[0][:, None] ** 2 + lines[1] ** 2
    falling = torch.where(square > 0, torch.where(square > 0, square, 1.0) ** (-0.5 * exponent), 0.0)
    spectrum = falling * (deviation**2 / falling.mean())
    spectrum[0, 0] = mean**2 * rows * columns
    return spectrum


def within(picture: Tensor, margin: int | tuple[int, int]) -> Tensor:
    """Images without `margin` rows and columns at every border: (h//2, w//2) of a kernel leaves the fully blurred
    part.
    """
    top, left = (margin, margin) if isinstance(margin, int) else margin
    rows, columns = picture.shape[-2:]
    if not (0 <= 2 * top < rows and 0 <= 2 * left < columns):
        raise ValueError(f"a margin of {top} rows and {left} columns of {rows} × {columns} pixels: nothing is left")
    return picture[..., top : rows - top, left : columns - left]


def mean_square_error(estimate: Tensor, picture: Tensor, *, margin: int | tuple[int, int] = 0) -> Tensor:
    """(...) of images (..., H, W) over the last two axes, within a margin."""
    return within(as_picture(estimate) - as_picture(picture), margin).square().mean((-2, -1))


def psnr(mean_square: Tensor, *, peak: float = 1.0) -> Tensor:
    """Peak signal-to-noise ratio of a mean square error, 10 log₁₀(peak²/e) dB; average over colours before.

    Raises ValueError for errors of integer images, whose differences wrap around.
    """
    mean_square = torch.as_tensor(mean_square)
    if not mean_square.is_floating_point():
        kind = str(mean_square.dtype).removeprefix("torch.")
        raise ValueError(
            f"a mean square error of {kind}: expected floating-point numbers; convert pictures before subtraction"
        )
    return 20 * math.log10(peak) - 10 * torch.log10(mean_square)


def _square(z: Tensor) -> Tensor:
    """|z|², whose derivative, unlike that of abs, is defined at 0."""
    return z.real**2 + z.imag**2 if z.is_complex() else z**2
