"""Super-resolution: pictures finer than the pixels that took them.

A pixel of the sensor covers s × s pixels of the picture and averages over them, after the blur:

    y_k = 1/s² Σ_a (h ∗ x)_(s k + a) + n_k,   a = 0 … s - 1 on both axes

A frequency of the image holds the s² of the picture that are equal modulo the sensor's sampling, its aliases m:

    Y = 1/s² Σ_m T_m X_m + N,    T = H B,   B_f = 1/s² Σ_a exp(2πi f·a)

Knowing how pictures fall off (S), the best linear inversion is

    X̂_m = S_m T_m* Y/(Σ_m S_m |T_m|²/s² + σ²)

One equation tells one number: whatever the kernel, of a scene that fills the sensor no less is lost than all aliases
but the strongest, Σ_m S_m - max_m S_m (`least_error`), and a kernel that shows only this one, a low pass, is the best.
To see more takes more images: several exposures, or a kernel that shows a small scene on a dark ground at several
places apart, each at another part of a pixel. These views, with T (V, ...) each, are inverted jointly,

    X̂ = S T† (T S T†/s² + σ²)⁻¹ Y,    Y of V, X of s² components

Transfer functions (Z, ..., rows, columns) are on the pixels of the picture, and averaged over Z as in `deconvolve`.
"""

import math

import torch
from torch import Tensor

from raytrace.imaging.image import EXTENSIONS, blur, extend, transfer_functions
from raytrace.maths.numerics import safe_divide


def coarse_image(picture: Tensor, kernel: Tensor, factor: int, *, boundary: str = "valid") -> Tensor:
    """What pixels `factor` times as large record of pictures (..., H, W) blurred by kernels (..., h, w).

    boundary: as for `image.blur`, whose rows and columns must be multiples of the factor.
    """
    blurred = blur(picture, kernel, boundary=boundary)
    rows, columns = _coarse(blurred.shape[-2:], factor)
    return blurred.unflatten(-1, (columns, factor)).unflatten(-3, (rows, factor)).mean((-3, -1))


def coarse_transfer(kernels: Tensor, size: int | tuple[int, int], factor: int, *, origin: str = "pixel") -> Tensor:
    """T (..., rows, columns) of kernels (..., h, w) and the large pixels, on pictures of that size."""
    transfer = transfer_functions(kernels, size, origin=origin)
    _coarse(transfer.shape[-2:], factor)
    rows, columns = (_pixel(n, factor, kernels) for n in transfer.shape[-2:])
    return transfer * rows[:, None] * columns


def inversion(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, factor: int) -> Tensor:
    """G (..., rows, columns) of the best linear inversion that does not know which T (Z, ...) it meets: X̂_m = G_m Y.

        G_m = S_m ⟨T_m*⟩/(Σ_m S_m ⟨|T_m|²⟩/s² + σ²)

    spectrum: S (..., rows, columns); sigma: of the noise in a pixel of the sensor.
    """
    return safe_divide(spectrum * transfer.mean(0).conj(), _measured(transfer, spectrum, sigma, factor).mean(0))


def inversion_errors(
    transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, factor: int, *, filter: Tensor | None = None
) -> Tensor:
    """Mean square error (Z, ...) of a pixel of the picture, by one filter; by default that of `inversion`.

    e_m = S_m - 2/s² Re(G_m T_m) S_m + |G_m|² (Σ_m S_m |T_m|²/s² + σ²)/s²
    """
    G = inversion(transfer, spectrum, sigma, factor) if filter is None else filter
    gain = (G * transfer).real
    noise = (G.real**2 + G.imag**2) * _measured(transfer, spectrum, sigma, factor)
    return (spectrum * (1 - 2 / factor**2 * gain) + noise / factor**2).mean((-2, -1))


def superresolve(image: Tensor, filter: Tensor, factor: int, *, boundary: str = "circular") -> Tensor:
    """Pictures (..., factor·H, factor·W) from images (..., H, W) by an inversion filter.

    filter: (..., rows, columns), factor times the image for "circular", else larger by what the image is extended, as
    for `deconvolve.restore`.
    """
    size, shape = image.shape[-2:], _coarse(filter.shape[-2:], factor)
    if boundary in EXTENSIONS:
        image = extend(image, shape, boundary=boundary)
    elif boundary != "circular" or tuple(size) != shape:
        raise ValueError(
            f"boundary {boundary!r}, an image of {size[0]} × {size[1]} pixels, a filter for {shape[0]} × {shape[1]}: "
            f"expected equal sizes for 'circular', or {', '.join(EXTENSIONS)} and a larger filter"
        )
    restored = torch.fft.ifft2(_unfold(torch.fft.fft2(image), factor) * filter).real
    return restored[..., : factor * size[0], : factor * size[1]]


def least_error(spectrum: Tensor, factor: int) -> Tensor:
    """Mean square error (...) of a pixel below which no blur and no linear inversion of one image go, noise or none.

    e = the mean over frequencies of S, without the greatest S_m of every s² aliases
    """
    strongest = _aliases(spectrum, factor).amax((-4, -2)).sum((-2, -1))
    return spectrum.mean((-2, -1)) - strongest / (spectrum.shape[-2] * spectrum.shape[-1])


def joint_inversion(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, factor: int) -> Tensor:
    """G (..., V, rows, columns) of the best linear inversion of V images of one picture.

        X̂_m = Σ_v G_vm Y_v,    G = S ⟨T⟩† (⟨T S T†⟩/s² + σ²)⁻¹

    transfer: (Z, ..., V, rows, columns), ⟨·⟩ over the first axis; spectrum: (..., rows, columns); sigma: one for all.
    """
    T, S = _columns(transfer, factor), _columns(spectrum[..., None, :, :], factor)
    G = torch.linalg.solve(_joint_power(T, S, sigma, factor).mean(0), T.mean(0) * S).conj()
    return _frequencies(G, factor)


def joint_errors(
    transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, factor: int, *, filter: Tensor | None = None
) -> Tensor:
    """Mean square error (Z, ...) of a pixel of the picture from V images, as `inversion_errors` from one."""
    G = joint_inversion(transfer, spectrum, sigma, factor) if filter is None else filter
    gain = (G * transfer).real.sum(-3)
    g, S = _columns(G, factor).mT, _columns(spectrum[..., None, :, :], factor)
    noise = ((g @ _joint_power(_columns(transfer, factor), S, sigma, factor)) * g.conj()).real.sum(-1)
    kept = (spectrum * (1 - 2 / factor**2 * gain)).mean((-2, -1))
    return kept + noise.mean((-3, -2, -1)) / factor**2


def joint_superresolve(images: Tensor, filter: Tensor, factor: int, *, boundary: str = "circular") -> Tensor:
    """Pictures (..., factor·H, factor·W) from V images (..., V, H, W) each, by `joint_inversion`."""
    return superresolve(images, filter, factor, boundary=boundary).sum(-3)


def bicubic(image: Tensor, factor: int) -> Tensor:
    """Images (..., H, W) on pixels smaller by `factor`, by cubic convolution (Keys, 1981): what needs no optics."""
    flat = image.reshape(-1, 1, *image.shape[-2:])
    # antialias chooses Keys's own a = -½, exact for parabolas; upwards it smooths nothing.
    fine = torch.nn.functional.interpolate(
        flat, scale_factor=factor, mode="bicubic", align_corners=False, antialias=True
    )
    return fine.reshape(*image.shape[:-2], *fine.shape[-2:])


def _measured(transfer: Tensor, spectrum: Tensor, sigma: Tensor | float, factor: int) -> Tensor:
    """The power of the image, Σ_m S_m |T_m|²/s² + σ², at every alias: (Z, ..., rows, columns)."""
    aliases = _fold(spectrum * (transfer.real**2 + transfer.imag**2), factor)
    return _unfold(aliases / factor**2 + sigma**2, factor)


def _joint_power(T: Tensor, S: Tensor, sigma: Tensor | float, factor: int) -> Tensor:
    """T S T†/s² + σ² (..., V, V) of columns T (..., V, s²) and S (..., 1, s²); never singular."""
    power = (T * S) @ T.mH / factor**2
    # Views that agree, without noise: as much of it as rounding makes; and of no light at all, anything.
    light = power.diagonal(dim1=-2, dim2=-1).real.sum(-1)
    least = torch.where(light > 0, torch.finfo(light.dtype).eps * light, 1.0)
    noise = least + torch.as_tensor(sigma, dtype=light.dtype, device=light.device) ** 2
    return power + noise[..., None, None] * torch.eye(T.shape[-2], dtype=T.dtype, device=T.device)


def _columns(values: Tensor, factor: int) -> Tensor:
    """The aliases of every frequency of the image last: (..., V, rows, columns) -> (..., r, c, V, s²)."""
    return _aliases(values, factor).movedim((-3, -1), (-5, -4)).flatten(-2)


def _frequencies(columns: Tensor, factor: int) -> Tensor:
    """Back from `_columns`: (..., r, c, V, s²) -> (..., V, rows, columns)."""
    apart = columns.unflatten(-1, (factor, factor)).movedim((-5, -4), (-3, -1))
    return apart.flatten(-2).flatten(-3, -2)


def _aliases(values: Tensor, factor: int) -> Tensor:
    """(..., rows, columns) -> (..., s, rows/s, s, columns/s)."""
    rows, columns = _coarse(values.shape[-2:], factor)
    return values.unflatten(-1, (factor, columns)).unflatten(-3, (factor, rows))


def _fold(values: Tensor, factor: int) -> Tensor:
    """Sum over the aliases: (..., rows, columns) -> (..., rows/s, columns/s)."""
    return _aliases(values, factor).sum((-4, -2))


def _unfold(values: Tensor, factor: int) -> Tensor:
    """The same value at every alias."""
    return values.repeat(*(1,) * (values.dim() - 2), factor, factor)


def _pixel(count: int, factor: int, like: Tensor) -> Tensor:
    """B (count,) along one axis: the mean over a pixel of the sensor, seen from its first pixel of the picture."""
    frequency = torch.fft.fftfreq(count, dtype=like.dtype, device=like.device)
    phase = 2 * math.pi * frequency[:, None] * torch.arange(factor, dtype=like.dtype, device=like.device)
    return torch.polar(torch.ones_like(phase), phase).mean(-1)


def _coarse(size, factor: int) -> tuple[int, int]:
    rows, columns = size
    if factor < 1 or rows % factor or columns % factor:
        raise ValueError(
            f"{rows} × {columns} pixels, {factor} to one of the sensor: expected multiples of a factor ≥ 1"
        )
    return rows // factor, columns // factor
