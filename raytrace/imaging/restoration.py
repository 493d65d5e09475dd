"""Restoration: linear filters for blurred, noisy images (Wiener), and their mean square error in closed form.

An image x is blurred by one of the kernels h_z; the sensor adds white noise n of variance σ²; a filter G restores it:

    X̂ = G Y,   Y = H_z X + N,      e_z = S |1 - G H_z|² + σ² |G|²,      E|x̂ - x|² = the mean of e_z over frequencies

S is the power spectrum of the images, ordered as by `fft2`; its mean is the mean square of a pixel. Transfer functions
(Z, ..., rows, columns) have the kernels to be averaged over (depths) on the first axis, then colours or fields, each
with its own filter (..., rows, columns). S and σ broadcast against (..., rows, columns).

Joint filters restore all channels of an image from all recorded channels: S and G are then matrices (..., C, C, rows,
columns), and H is diagonal: every channel has a kernel of its own. With cross spectra S_cd = E[X_c X_d*] that vanish
for c ≠ d they are the filters of each channel alone. (Hunt and Kübler, IEEE Trans. ASSP 32, 1984; Galatsanos and Chin,
IEEE Trans. ASSP 37, 1989.)
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.imaging.image import EXTENSIONS, as_picture, check_axes, check_fit, extend
from raytrace.maths.numerics import as_tensor, safe_divide, safe_sqrt


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
    """Mean square error (Z, ...) of a pixel for each transfer function; filter: the depth-invariant one by default.

    Of many spectra (B, 1, ..., rows, columns) behind one filter (B, Z, ...), without a product of their size.
    """
    G = depth_invariant_wiener(transfer, spectrum, sigma) if filter is None else filter
    left = _square(G * transfer - 1)
    power = spectrum + left.new_zeros(left.shape[-2:])
    remaining = torch.einsum("...ij,...ij->...", power, left.to(power.dtype)) / math.prod(left.shape[-2:])
    return remaining + (sigma**2 * _square(G)).mean((-2, -1))


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


def kernel_error(kernels: Tensor, spectrum: Tensor, sigma: Tensor | float, *, haze: bool = False) -> Tensor:
    """`depth_invariant_error` (...) of kernels (Z, ..., h, w), from half of the frequencies.

    Images and kernels are real, so that S and |H| are equal at f and -f; the position of the kernels' centre is
    irrelevant as long as it is the same for all Z. haze: as for `transfer_functions`.
    """
    transfer, weight = _half_transfer(kernels, spectrum, haze)
    density = depth_invariant_density(transfer, spectrum[..., : len(weight)], sigma)
    return (weight * density).mean((-2, -1))


def _half_transfer(kernels: Tensor, spectrum: Tensor, haze: bool) -> tuple[Tensor, Tensor]:
    """Transfer functions (..., rows, half) as by `rfft2`, and weights (half,) of columns, whose mean is 1."""
    rows, columns = spectrum.shape[-2:]
    check_fit(kernels.shape[-2:], (rows, columns))
    half = columns // 2 + 1
    place = torch.arange(half, device=spectrum.device)
    # Every column counts for its mirror image too, except 0 and the Nyquist frequency.
    weight = torch.where((place == 0) | (2 * place == columns), 1.0, 2.0).to(spectrum.real.dtype) * (half / columns)
    transfer = torch.fft.rfft2(kernels, s=(rows, columns))
    if haze:
        transfer[..., 0, 0] = 1
    return transfer, weight


# -- joint filters of several channels


def joint_wiener(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """The joint, depth-invariant Wiener filter (..., C, C, rows, columns): restored by recorded channel.

        G = S ⟨H⟩ᴴ (⟨H S Hᴴ⟩ + σ²)⁻¹,   matrices of C × C at every frequency, ⟨·⟩ the mean over the first axis

    transfer: (Z, ..., C, rows, columns), the diagonals of H; spectrum: `cross_spectrum` (..., C, C, rows, columns); σ:
    of each channel, broadcast against (..., C, rows, columns). Spectra of full correlation and σ = 0 are allowed.
    Raises ValueError for a spectrum of other channels.
    """
    _check_channels(transfer, spectrum)
    G = torch.zeros_like(spectrum, dtype=torch.promote_types(spectrum.dtype, transfer.dtype))
    for gain, row, combination in _joint_steps(transfer, spectrum, sigma)[1]:
        predicted = (row[..., :, None, :, :] * G).sum(-4)
        G = G + gain[..., :, None, :, :] * (combination - predicted)[..., None, :, :, :]
    return G


def joint_errors(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, *, filter: Tensor | None = None) -> Tensor:
    """Mean square error (Z, ..., C) of each channel, for each transfer function; filter: `joint_wiener` by default.

    e_z = diag[(G H_z - 1) S (G H_z - 1)ᴴ + σ² G Gᴴ], arguments as for `joint_wiener`.
    """
    _check_channels(transfer, spectrum)
    G = joint_wiener(transfer, spectrum, sigma) if filter is None else filter
    channels = torch.eye(spectrum.shape[-3], dtype=G.dtype, device=G.device)[:, :, None, None]
    left = G * transfer[..., None, :, :, :] - channels
    noise = (_square(G) * _noise(transfer, sigma)[..., None, :, :, :]).sum(-3)
    remaining = sum(_square((left * column[..., None, :, :, :]).sum(-3)) for column in _cholesky(spectrum))
    return (remaining + noise).mean((-2, -1))


def joint_error(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """Mean of `joint_errors` over the transfer functions (..., C), in a form that keeps the precision of small errors.

    E = S - S ⟨H⟩ᴴ (⟨H S Hᴴ⟩ + σ²)⁻¹ ⟨H⟩ S, of which these are the diagonal elements.
    """
    return joint_density(transfer, spectrum, sigma).mean((-2, -1))


def joint_density(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float) -> Tensor:
    """Diagonals of E (..., C, frequencies), whose means over all frequencies are `joint_error`."""
    return sum((_square(column) for column in _joint_steps(transfer, spectrum, sigma)[0]), torch.zeros(()))


def joint_kernel_error(kernels: Tensor, spectrum: Tensor, sigma: Tensor | float, *, haze: bool = False) -> Tensor:
    """`joint_error` (..., C) of kernels (Z, ..., C, h, w), from half of the frequencies, as `kernel_error`.

    Kernels of all channels must have a common centre: lateral colour shifts them.
    """
    _check_channels(kernels, spectrum)
    transfer, weight = _half_transfer(kernels, spectrum, haze)
    return (weight * joint_density(transfer, spectrum[..., : len(weight)], sigma)).mean((-2, -1))


def _joint_steps(
    transfer: Tensor, spectrum: Tensor, sigma: Tensor | float
) -> tuple[list[Tensor], list[tuple[Tensor, Tensor, Tensor]]]:
    """Columns L (..., C, frequencies) of a root of E = L Lᴴ, and the steps that lead to it.

    Recorded channels are measurements y = ⟨H⟩ X + n, of which n, noise and the spread of H, has the covariance D. In
    turn each one, less its part that is correlated with the noise of those before, updates the estimate of X and its
    covariance. A step: gain (..., C, frequencies), the measurement's row of ⟨H⟩, and its combination of channels.

    The root, S = L Lᴴ at the start, is updated by Carlson's formula (AIAA J. 11, 1973), of a measurement a X + n, n of
    variance δ, and g = a L:

        d_k = δ + Σ_(i≤k) |g_i|²,   L_k ← L_k √(d_(k-1)/d_k) - g_k Σ_(i<k) L_i g_i* / √(d_(k-1) d_k)

    It needs no inverse of S or D, and squares no small difference.
    """
    _check_channels(transfer, spectrum)
    count = transfer.shape[-3]
    mean = transfer.mean(0)
    identity = torch.eye(count, dtype=mean.dtype, device=mean.device)[:, :, None, None]
    spread = transfer - mean
    D = spectrum * (spread[..., :, None, :, :] * spread[..., None, :, :, :].conj()).mean(0)
    D = D + _noise(transfer, sigma)[..., None, :, :] * identity
    rows, combinations = mean[..., :, None, :, :] * identity, identity.expand(D.shape)
    scale, root, steps = _diagonal(D), _cholesky(spectrum), []
    for i in range(count):
        row, variance = rows[..., i, :, :, :], _pivot(D, i, scale)
        before, total, shift = safe_sqrt(variance), variance, torch.zeros_like(row)
        updated = []
        for column in root:
            g = (row * column).sum(-3)
            total = total + _square(g)
            after = safe_sqrt(total)
            kept = torch.where(after > 0, safe_divide(before, after), 1.0)
            moved = safe_divide(g, before * after)
            updated.append(column * kept[..., None, :, :] - shift * moved[..., None, :, :])
            shift, before = shift + column * g.conj()[..., None, :, :], after
        steps.append((safe_divide(shift, total[..., None, :, :]), row, combinations[..., i, :, :, :]))
        root = updated
        if len(transfer) > 1:  # otherwise D is diagonal
            later = (torch.arange(count, device=D.device) > i)[:, None, None]
            factor = torch.where(later, safe_divide(D[..., :, i, :, :], variance[..., None, :, :]), 0.0)
            D, rows, combinations = (
                matrix - factor[..., :, None, :, :] * matrix[..., i, None, :, :, :]
                for matrix in (D, rows, combinations)
            )
    return root, steps


def _check_channels(transfer: Tensor, spectrum: Tensor) -> None:
    """Raise ValueError unless a cross spectrum has the channels of transfer functions or kernels."""
    count = transfer.shape[-3] if transfer.dim() > 3 else 0
    if not count or spectrum.dim() < 4 or spectrum.shape[-4:-2] != (count, count):
        raise ValueError(
            f"a cross spectrum of shape {tuple(spectrum.shape)} and transfer functions or kernels of shape "
            f"{tuple(transfer.shape)}: expected (..., C, C, rows, columns), as of `cross_spectrum`, and (Z, ..., C, "
            "rows, columns)"
        )


def _noise(transfer: Tensor, sigma: Tensor | float) -> Tensor:
    """σ² (..., C, rows, columns)."""
    return torch.zeros_like(transfer[0].real) + sigma**2


def _cholesky(matrix: Tensor) -> list[Tensor]:
    """Columns L (..., C, frequencies) of matrices (..., C, C, frequencies) = L Lᴴ, lower triangular; 0 for singular
    parts.

    `torch.linalg.cholesky` refuses singular matrices, and wants frequencies first.
    """
    count, scale, columns = matrix.shape[-3], _diagonal(matrix), []
    for k in range(count):
        lower = (torch.arange(count, device=matrix.device) >= k)[:, None, None]
        side = safe_sqrt(_pivot(matrix, k, scale))
        column = torch.where(lower, safe_divide(matrix[..., :, k, :, :], side[..., None, :, :]), 0.0)
        matrix = matrix - column[..., :, None, :, :] * column[..., None, :, :, :].conj()
        columns.append(column)
    return columns


def _diagonal(matrix: Tensor) -> Tensor:
    """Diagonals (..., C, frequencies) of Hermitian matrices (..., C, C, frequencies)."""
    return matrix.real.diagonal(dim1=-4, dim2=-3).movedim(-1, -3).detach()


def _pivot(matrix: Tensor, k: int, scale: Tensor) -> Tensor:
    """The pivot k (..., frequencies) of what elimination leaves; 0 where it is the rounding of the diagonal."""
    pivot = matrix[..., k, k, :, :].real
    return torch.where(pivot > 8 * torch.finfo(pivot.dtype).eps * scale[..., k, :, :], pivot, 0.0)


def restore_jointly(image: Tensor, filter: Tensor, *, boundary: str = "circular") -> Tensor:
    """Images (..., C, H, W) filtered by joint filters (..., C, C, rows, columns), restored by recorded channel.

    Size and boundary as for `restore`. Raises ValueError for a filter of other channels.
    """
    image = as_picture(image, "image")
    if image.dim() < 3 or filter.dim() < 4 or filter.shape[-4:-2] != (image.shape[-3],) * 2:
        raise ValueError(
            f"an image of shape {tuple(image.shape)} and a filter of shape {tuple(filter.shape)}: expected an image "
            "(..., C, H, W) and a filter (..., C, C, rows, columns), as `joint_wiener` gives it"
        )
    return _filtered(image, lambda spectrum: (filter * spectrum[..., None, :, :, :]).sum(-3), filter.shape, boundary)


def cross_spectrum(pictures: Tensor, *, window: str = "hann") -> Tensor:
    """S (..., C, C, rows, columns) of images (B, ..., C, rows, columns): the mean of X_c X_d*/(rows·columns) over B.

    The diagonal is `power_spectrum` of every channel, with the same windows. S_cd/√(S_cc S_dd) is the correlation of
    channels at every frequency, of modulus 1 if B is 1. Raises ValueError for images without the axes B and C.
    """
    pictures = as_picture(pictures, "set of pictures")
    if pictures.dim() < 4:
        raise ValueError(
            f"pictures of shape {tuple(pictures.shape)}: expected (B, ..., channels, rows, columns); add an axis by "
            "picture[None]"
        )
    X, mean = _fluctuations(pictures, window)
    return (_products(X) + _constants(_products(mean), X)).mean(0)


def _products(channels: Tensor) -> Tensor:
    """x_c x_d* (..., C, C, rows, columns)."""
    return channels[..., :, None, :, :] * channels[..., None, :, :, :].conj()


# -- images


def restore(image: Tensor, filter: Tensor, *, boundary: str = "circular") -> Tensor:
    """Images (..., H, W) filtered: (..., H, W); differentiable in both arguments.

    filter: (..., rows, columns), the size of the image for "circular", else larger by the extension. boundary: "taper"
    avoids ringing from the jump between opposite borders; "reflect" and "zero" as for `image.extend`.
    """
    image = as_picture(image, "image")
    check_axes(image=image, filter=filter)
    return _filtered(image, lambda spectrum: filter * spectrum, filter.shape, boundary)


def _filtered(image: Tensor, filter: Callable[[Tensor], Tensor], shape: Sequence[int], boundary: str) -> Tensor:
    """Images (..., H, W) whose spectrum is filtered, extended to the last two numbers of a shape."""
    size, shape = image.shape[-2:], tuple(shape[-2:])
    if boundary in EXTENSIONS:
        image = extend(image, shape, boundary=boundary)
    elif boundary != "circular" or size != shape:
        raise ValueError(
            f"boundary {boundary!r}, an image of {size[0]} × {size[1]} pixels, a filter of {shape[0]} × {shape[1]}: "
            f"expected equal sizes for 'circular', or {', '.join(EXTENSIONS)} and a larger filter"
        )
    return torch.fft.ifft2(filter(torch.fft.fft2(image))).real[..., : size[0], : size[1]]


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
    X, mean = _fluctuations(pictures, window)
    return (_square(X) + _constants(mean**2, X)).mean(0)


def _fluctuations(pictures: Tensor, window: str) -> tuple[Tensor, Tensor]:
    """Spectra X/√(rows·columns) of images (..., rows, columns) about their means, windowed, and the means."""
    if window not in ("hann", "none"):
        raise ValueError(f"window {window!r}: expected hann, none")
    rows, columns = pictures.shape[-2:]
    mean = pictures.mean((-2, -1), keepdim=True)
    centred = pictures - mean
    if window == "hann":
        lines = [torch.hann_window(n, dtype=pictures.dtype, device=pictures.device) for n in (rows, columns)]
        fade = lines[0][:, None] * lines[1]
        centred = centred * (fade / fade.square().mean().sqrt())
    return torch.fft.fft2(centred, norm="ortho"), mean


def _constants(square: Tensor, like: Tensor) -> Tensor:
    """The power (..., rows, columns) of constant images of a mean square (..., 1, 1)."""
    rows, columns = like.shape[-2:]
    return torch.nn.functional.pad(square * (rows * columns), (0, columns - 1, 0, rows - 1))


def power_law(
    size: int | Sequence[int], *, mean: float = 0.5, deviation: float = 0.25, exponent: float = 2.0
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
    mean_square = as_tensor(mean_square)
    if not mean_square.is_floating_point():
        kind = str(mean_square.dtype).removeprefix("torch.")
        raise ValueError(
            f"a mean square error of {kind}: expected floating-point numbers; convert pictures before subtraction"
        )
    return 20 * math.log10(peak) - 10 * torch.log10(mean_square)


def _square(z: Tensor) -> Tensor:
    """|z|², whose derivative, unlike that of abs, is defined at 0."""
    return z.real**2 + z.imag**2 if z.is_complex() else z**2
