"""Deconvolve: linear filters that restore blurred, noisy pictures, and the error each leaves, in closed form.

A camera blurs x by one of the kernels h_z, its sensor adds white noise n of variance σ², a filter G restores it:

    X̂ = G Y,   Y = H_z X + N,      e_z = S |1 - G H_z|² + σ² |G|²,      E|x̂ - x|² = the mean of e_z over frequencies

S is the power spectrum of the pictures, in the order of `fft2`: its mean is the mean square of a pixel. Transfer
functions (Z, ..., rows, columns) have the kernels to be averaged over (depths) on the first axis; colours or fields
stand behind it, each with a filter (..., rows, columns) of its own. S and σ broadcast against (..., rows, columns).
"""

import math

import torch
from torch import Tensor

from raytrace.imaging.image import EXTENSIONS, as_picture, check_axes, check_fit, extend
from raytrace.maths.numerics import safe_divide


def wiener(transfer: Tensor, noise_to_signal: Tensor | float) -> Tensor:
    """The classic filter of one known kernel (Wiener, 1949), any axes before (rows, columns).

        G = H*/(|H|² + γ)

    noise_to_signal: γ ≥ 0, a number or any tensor that broadcasts; σ²/S makes it the best one. γ = 0 inverts, and
    gives 0 where H is 0.
    """
    return safe_divide(transfer.conj(), _square(transfer) + noise_to_signal)


def towards_estimate(image: Tensor, transfer: Tensor, gamma: Tensor | float, *, estimate: Tensor) -> Tensor:
    """The picture least in |h ∗ x - y|² + γ |x - x₀|²: inverse where the camera sees much, else an estimate x₀.

        X̂ = (H* Y + γ X₀)/(|H|² + γ) = X₀ + H* (Y - H X₀)/(|H|² + γ)

    image, estimate: (..., rows, columns), periodic; the second form has the limit γ → 0 where H is 0.
    """
    Y, X = torch.fft.fft2(image), torch.fft.fft2(estimate)
    return torch.fft.ifft2(X + wiener(transfer, gamma) * (Y - transfer * X)).real


def towards_measurement(transfer: Tensor, gamma: Tensor | float) -> Tensor:
    """The filter of `towards_estimate` with the blurred picture itself as the estimate.

        G = (H* + γ)/(|H|² + γ) = 1 + H* (1 - H)/(|H|² + γ)

    γ → ∞ leaves the measurement as it is. (Sitzmann et al., 2018, learn γ = v² and the depth of H.)
    """
    return 1 + wiener(transfer, gamma) * (1 - transfer)


def depth_invariant_wiener(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """The best linear filter (..., rows, columns) that does not know which transfer function (Z, ...) it meets.

        G = S ⟨H*⟩/(S ⟨|H|²⟩ + σ²),   ⟨·⟩ the mean over the first axis

    At σ = 0 it gives 0 where every H is 0.
    """
    power = spectrum * _square(transfer).mean(0) + _variance(sigma)
    return safe_divide(spectrum * transfer.mean(0).conj(), power)


def errors(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, *, filter: Tensor | None = None) -> Tensor:
    """Mean square error (Z, ...) of a pixel at each transfer function, by one filter: by default the best blind one."""
    G = depth_invariant_wiener(transfer, spectrum, sigma) if filter is None else filter
    return (spectrum * _square(G * transfer - 1) + _variance(sigma) * _square(G)).mean((-2, -1))


def depth_invariant_error(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """Mean over the kernels of `errors` by the best blind filter (...), without the filter.

        e = S - S² |⟨H⟩|²/(S ⟨|H|²⟩ + σ²) = S (S (⟨|H|²⟩ - |⟨H⟩|²) + σ²)/(S ⟨|H|²⟩ + σ²)

    In the second form, whose difference is the variance ⟨|H - ⟨H⟩|²⟩, small errors keep their digits.
    """
    return depth_invariant_density(transfer, spectrum, sigma).mean((-2, -1))


def depth_invariant_density(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """e (..., frequencies) whose mean over all frequencies is `depth_invariant_error`; any axes for the frequencies."""
    middle = transfer.mean(0)
    spread, noise = _square(transfer - middle).mean(0), _variance(sigma)
    total = spectrum * (spread + _square(middle)) + noise
    # No light and no noise: nothing is measured, and all of S is missing.
    return spectrum * torch.where(total != 0, safe_divide(spectrum * spread + noise, total), 1.0)


def kernel_error(kernels: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """`depth_invariant_error` (...) of kernels (Z, ..., h, w), from the non-redundant half of the frequencies.

    Pictures and kernels are real, so that S and |H| at f and -f are equal; and where the middle of the kernels lies
    does not matter, as long as it is the same for all Z.
    """
    rows, columns = spectrum.shape[-2:]
    check_fit(kernels.shape[-2:], (rows, columns))
    half = columns // 2 + 1
    place = torch.arange(half, device=spectrum.device)
    # Every column stands for its mirror image as well, but 0 and the Nyquist frequency, which are their own.
    weight = torch.where((place == 0) | (2 * place == columns), 1.0, 2.0).to(spectrum.dtype) * (half / columns)
    transfer = torch.fft.rfft2(kernels, s=(rows, columns))
    return (weight * depth_invariant_density(transfer, spectrum[..., :half], sigma)).mean((-2, -1))


def errors_knowing(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """Mean square error (Z, ...) where the filter knows every transfer function: the least any linear one leaves."""
    return depth_invariant_error(transfer[None], spectrum, sigma)


def restore(image: Tensor, filter: Tensor, *, boundary: str = "circular") -> Tensor:
    """A filter applied to images (..., H, W): (..., H, W).

    filter: (..., rows, columns), as large as the image for "circular", else larger by what the image is extended:
    boundary "taper" keeps the jump between opposite borders from ringing, by reflection that fades from one to the
    other; "reflect" and "zero" are those of `image.extend`. Differentiable in both.
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
    """S (..., rows, columns) of pictures (B, ..., rows, columns): the mean of |X|²/(rows·columns) over the first axis.

    window: "hann" fades pictures (about their mean) out towards their borders, whose edges would else look like
    texture; "none" is right for periodic ones, and adds up to their mean square exactly.
    Raises ValueError for a single picture without the axis B.
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
    """S ∝ 1/|f|^exponent of natural pictures (Field, 1987), float64; mean, deviation: those of a pixel."""
    rows, columns = (size, size) if isinstance(size, int) else size
    lines = [torch.fft.fftfreq(n, dtype=torch.float64) for n in (rows, columns)]
    square = lines[0][:, None] ** 2 + lines[1] ** 2
    falling = torch.where(square > 0, torch.where(square > 0, square, 1.0) ** (-0.5 * exponent), 0.0)
    spectrum = falling * (deviation**2 / falling.mean())
    spectrum[0, 0] = mean**2 * rows * columns
    return spectrum


def within(picture: Tensor, margin: int | tuple[int, int]) -> Tensor:
    """Pictures without `margin` rows and columns at every border: (h//2, w//2) of a kernel for what it blurs fully."""
    top, left = (margin, margin) if isinstance(margin, int) else margin
    rows, columns = picture.shape[-2:]
    if not (0 <= 2 * top < rows and 0 <= 2 * left < columns):
        raise ValueError(f"a margin of {top} rows and {left} columns of {rows} × {columns} pixels: nothing is left")
    return picture[..., top : rows - top, left : columns - left]


def mean_square_error(estimate: Tensor, picture: Tensor, *, margin: int | tuple[int, int] = 0) -> Tensor:
    """(...) of pictures (..., H, W), by their last two axes, within a margin."""
    return within(as_picture(estimate) - as_picture(picture), margin).square().mean((-2, -1))


def psnr(mean_square: Tensor, *, peak: float = 1.0) -> Tensor:
    """Peak signal over a mean square error, 10 log₁₀(peak²/e) dB; average the errors of colours first.

    Raises ValueError for errors of integer pictures, whose differences wrap around.
    """
    mean_square = torch.as_tensor(mean_square)
    if not mean_square.is_floating_point():
        kind = str(mean_square.dtype).removeprefix("torch.")
        raise ValueError(
            f"a mean square error of {kind}: expected floating-point numbers; convert pictures before subtraction"
        )
    return 20 * math.log10(peak) - 10 * torch.log10(mean_square)


def _square(z: Tensor) -> Tensor:
    """|z|², without the root in `abs` whose derivative has no value at 0."""
    return z.real**2 + z.imag**2 if z.is_complex() else z**2


def _variance(sigma: Tensor | float) -> Tensor | float:
    return sigma**2
