"""Image formation: convolution with point spread functions, at one or several depths, and noise of the sensor.

Images are floating-point numbers in any unit; integers of 8 or 16 bits are scaled to 0 … 1 (`as_picture`).

Kernels (..., h, w) are centred on their middle pixel (h//2, w//2). On a `Grid` of even size the centre lies half a
pixel before it, so that the kernel shifts an image by half a pixel; deconvolution with the same kernel removes the
shift, and so does origin="grid".
"""

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import as_tensor, broadcast_shape, safe_divide, safe_sqrt

#: Extension beyond the borders of an image: "zero"; "reflect", its mirror image; "taper", a blend of the mirror images
#: at opposite borders, so that the periodic continuation has no jump.
EXTENSIONS = ("zero", "reflect", "taper")
BOUNDARIES = ("valid", "circular", *EXTENSIONS)
COMPOSITIONS = ("masked", "sum", "occlusion")
_ORIGINS = ("pixel", "grid")
_LITTLE = 1e-3  # share of a layer that nearer ones leave visible, below which it continues as its surroundings do
#: White of integer pictures.
_WHITE = {torch.uint8: 255, torch.uint16: 65535}


def as_picture(picture: Tensor | np.ndarray, what: str = "picture") -> Tensor:
    """An image as floating-point numbers; integers of 8 or 16 bits are divided by their largest value.

    Raises ValueError for other integers, whose white level is unknown, and for complex numbers.
    """
    picture = as_tensor(picture)
    if picture.is_floating_point():
        return picture
    if picture.dtype not in _WHITE:
        raise ValueError(
            f"a {what} of {str(picture.dtype).removeprefix('torch.')}: its white is unknown; expected floating-point "
            "numbers, or uint8 or uint16; convert it, as picture.float() / 255"
        )
    return picture.to(torch.get_default_dtype()) / _WHITE[picture.dtype]


def linearised(picture: Tensor | np.ndarray) -> Tensor:
    """Numbers as they are; integers of 8 or 16 bits as the light that sRGB encodes (IEC 61966-2-1)."""
    picture = as_tensor(picture)
    if picture.is_floating_point():
        return picture
    return decoded(as_picture(picture))


def decoded(level: Tensor) -> Tensor:
    """Light of sRGB levels from 0 to 1: the inverse of `encoded` (IEC 61966-2-1)."""
    return torch.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)


def encoded(light: Tensor) -> Tensor:
    """sRGB levels of light, clipped to [0, 1] (IEC 61966-2-1)."""
    light = light.clamp(0.0, 1.0)
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def blur(picture: Tensor, kernel: Tensor, *, boundary: str = "valid", origin: str = "pixel") -> Tensor:
    """Convolution, by default over the region where the whole kernel lies inside the image; by FFT.

        y_ij = Σ_ab h_ab x_(i + h//2 - a, j + w//2 - b)

    picture: (..., H, W); kernel: (..., h, w); leading axes broadcast. boundary: "valid" returns (..., H - h + 1,
    W - w + 1), the region `visible`. All others return (..., H, W): "circular" assumes a periodic image, `EXTENSIONS`
    extend it. origin: "pixel", or "grid": the centre of an even kernel is (h - 1)/2 and its half-pixel shift is removed
    (not for "valid", where the shift would wrap around). Raises ValueError for a kernel larger than a valid or circular
    image, and for axes that do not broadcast.
    """
    picture = as_picture(picture)
    _check_choice(boundary, BOUNDARIES, "boundary")
    _check_kernel(kernel)
    check_axes(picture=picture, kernel=kernel)
    size, spot = picture.shape[-2:], kernel.shape[-2:]
    _check_choice(origin, _ORIGINS, "origin")
    if boundary == "valid" and origin == "grid" and (spot[0] % 2 == 0 or spot[1] % 2 == 0):
        raise ValueError(
            f"origin 'grid' with a kernel of {spot[0]} × {spot[1]} pixels and boundary 'valid': half a pixel's shift "
            "reaches across the whole picture; expected odd sizes, or another boundary"
        )
    # An extension holds the reach of the kernel on both sides.
    shape = tuple(n + 2 * (m // 2) if boundary in EXTENSIONS else n for n, m in zip(size, spot, strict=True))
    check_fit(spot, shape)
    if boundary in EXTENSIONS:
        picture = extend(picture, shape, boundary=boundary)
    transfer = torch.fft.rfft2(kernel, s=shape)
    if origin == "grid":
        transfer = transfer * _half_pixels(kernel, shape)[:, : shape[1] // 2 + 1]
    blurred = torch.fft.irfft2(torch.fft.rfft2(picture) * transfer, s=shape)
    if boundary == "valid":
        return blurred[..., spot[0] - 1 :, spot[1] - 1 :]
    return torch.roll(blurred, (-(spot[0] // 2), -(spot[1] // 2)), (-2, -1))[..., : size[0], : size[1]]


def visible(picture: Tensor, spot: Sequence[int]) -> Tensor:
    """The region (..., H - h + 1, W - w + 1) of images that a "valid" blur returns; spot: (h, w) of the kernels."""
    (rows, columns), (h, w) = picture.shape[-2:], spot
    top, left = h - 1 - h // 2, w - 1 - w // 2
    return picture[..., top : rows - h // 2, left : columns - w // 2]


def transfer_functions(
    kernels: Tensor, size: int | Sequence[int], *, origin: str = "pixel", haze: bool = False
) -> Tensor:
    """H (..., rows, columns), Fourier transforms of kernels (..., h, w) on images of that size, ordered as by `fft2`.

    origin: as for `blur`, which multiplies by them for boundary "circular". At origin "grid" an even kernel is 0 at the
    Nyquist frequency, where a half-pixel shift is undefined. haze: light beyond the window of kernels, whose sum is the
    share of all light, lies evenly over the image: H is 1 at frequency 0.
    """
    shape = (size, size) if isinstance(size, int) else (size[0], size[1])
    _check_choice(origin, _ORIGINS, "origin")
    h, w = kernels.shape[-2:]
    check_fit((h, w), shape)
    padded = torch.nn.functional.pad(kernels, (0, shape[1] - w, 0, shape[0] - h))
    placed = torch.roll(padded, (-(h // 2), -(w // 2)), (-2, -1))
    transfer = torch.fft.fft2(placed)
    if haze:
        transfer[..., 0, 0] = 1
    return transfer if origin == "pixel" else transfer * _half_pixels(kernels, shape)


def pixel_means(picture: Tensor, factor: int) -> Tensor:
    """Images (..., H/s, W/s) of pixels s times as large as those of images (..., H, W): means of s × s pixels.

    Raises ValueError for rows and columns that are no multiples of the factor s.
    """
    if factor == 1:
        return picture
    rows, columns = picture.shape[-2:]
    if rows % factor or columns % factor:
        raise ValueError(f"{rows} × {columns} pixels: expected multiples of {factor}, the pixels to one of the sensor")
    return picture.unflatten(-1, (-1, factor)).unflatten(-3, (-1, factor)).mean((-3, -1))


def pixel_transfer(size: Sequence[int], factor: int) -> Tensor:
    """B (rows, columns) of the mean over s × s pixels, on images of this size; the first of them is the origin.

        B_f = 1/s² Σ_a exp(2πi f·a),   a = 0 … s - 1 on both axes

    The image (`pixel_means`) is Y_f = 1/s² Σ_m B_m X_m, over the s² frequencies m that equal f modulo the sampling of
    the large pixels (aliases).
    """
    a = torch.arange(factor, dtype=torch.float64)
    rows, columns = (
        torch.exp(2j * math.pi * torch.fft.fftfreq(n, dtype=torch.float64)[:, None] * a).mean(1) for n in size
    )
    return rows[:, None] * columns


def extend(picture: Tensor, shape: Sequence[int], *, boundary: str) -> Tensor:
    """Images (..., H, W) extended to `shape`, one period of the continuation.

    The first half of the added rows and columns continues the last one, the second half precedes the first one.
    boundary: one of `EXTENSIONS`; mirror images repeat the border pixel, as often as needed.
    """
    _check_choice(boundary, EXTENSIONS, "boundary")
    rows, columns = picture.shape[-2:]
    check_fit((rows, columns), shape, "a picture", "a period")
    if boundary == "zero":
        return torch.nn.functional.pad(picture, (0, shape[1] - columns, 0, shape[0] - rows))
    return _extend_axis(_extend_axis(picture, shape[0], -2, boundary), shape[1], -1, boundary)


def depth_masks(depth: Tensor, planes: Tensor, *, softness: float = 0.0, feather: float = 0.0) -> Tensor:
    """Weights (..., D, H, W) of every pixel of a depth map (..., H, W) in layers at `planes` (D,); they sum to one.

        m_d = s((z - b_d)/w) - s((z - b_(d+1))/w),   b_d midway between planes d - 1 and d,   s(t) = 1/(1 + e^-t)

    planes: ascending and finite, in the unit of the depth map; reciprocal distances (0 at infinity) order the layers
    from far to near, as `blur_layers` requires. softness: w, in the same unit; 0 assigns every pixel to the nearest
    plane. feather: standard deviation in pixels of a Gaussian blur of the masks.
    """
    if planes.dim() != 1 or not bool((planes[1:] > planes[:-1]).all() & torch.isfinite(planes).all()):
        raise ValueError(
            f"planes {planes.tolist()}: expected finite, ascending ones (1/distance where one is infinite)"
        )
    beyond = depth[..., None, :, :] - (0.5 * (planes[1:] + planes[:-1]))[:, None, None]
    above = torch.sigmoid(beyond / softness) if softness > 0 else (beyond > 0).to(beyond.dtype)
    whole = torch.ones_like(depth)[..., None, :, :]
    masks = torch.cat([whole, above], -3) - torch.cat([above, torch.zeros_like(whole)], -3)
    if not feather > 0:
        return masks
    reach = math.ceil(4 * feather)
    x = torch.arange(-reach, reach + 1, dtype=masks.dtype, device=masks.device)
    line = torch.exp(-0.5 * (x / feather) ** 2)
    return blur(masks, (line[:, None] * line) / line.sum() ** 2, boundary="reflect")


def blur_layers(
    picture: Tensor,
    masks: Tensor,
    kernels: Tensor,
    *,
    composition: str = "occlusion",
    boundary: str = "valid",
    background: Tensor | None = None,
) -> Tensor:
    """The image of a layered colour scene, each layer blurred by its own kernels.

        masked:     y = Σ_d m_d (h_d ∗ x)          each pixel as if the whole scene were at its depth
        sum:        y = Σ_d h_d ∗ (m_d x)          no occlusion
        occlusion:  y_d = (1 - h_d ∗ α_d) y_(d-1) + h_d ∗ (α_d x_d),   y = y_D

    With occlusion a blurred near layer covers the layers behind, which continue behind it: α_d and x_d are those of
    `extended_layers`. A uniform image stays uniform with "masked" and "occlusion". picture: (..., C, H, W); masks:
    (..., D, H, W) from far to near, summing to one; kernels: (..., D, C, h, w). background: (..., C, H, W), the scene
    behind the objects, for "occlusion". boundary: as for `blur`. Raises ValueError for other shapes.
    """
    picture = as_picture(picture)
    _check_kernel(kernels)
    inputs = (("picture", picture, "C, H, W"), ("masks", masks, "D, H, W"), ("kernels", kernels, "D, C, h, w"))
    for name, tensor, axes in inputs:
        if tensor.dim() < axes.count(",") + 1:
            raise ValueError(f"{name} of shape {tuple(tensor.shape)}: expected (..., {axes})")
    colours, of_kernels = picture.shape[-3], kernels.shape[-3]
    if colours != of_kernels and 1 not in (colours, of_kernels):
        raise ValueError(f"a picture of {colours} colours and kernels of {of_kernels}: expected one each")
    masks = masks if masks.is_floating_point() else masks.to(kernels.dtype)  # shares of 0 and 1
    _check_choice(composition, COMPOSITIONS, "composition")
    if masks.shape[-3] != kernels.shape[-4] and kernels.shape[-4] != 1:
        raise ValueError(f"{masks.shape[-3]} masks and kernels of {kernels.shape[-4]} depths: expected one each")
    layers, scene = masks[..., :, None, :, :], picture[..., None, :, :, :]
    if composition == "masked":
        shown = visible(layers, kernels.shape[-2:]) if boundary == "valid" else layers
        return (shown * blur(scene, kernels, boundary=boundary)).sum(-4)
    if composition == "sum":
        return blur(layers * scene, kernels, boundary=boundary).sum(-4)
    # Coverage by normalised kernels: a kernel of energy below 1 darkens its layer without making it transparent.
    unit = safe_divide(kernels, kernels.sum((-2, -1), keepdim=True))
    each = enumerate(extended_layers(layers * scene, masks, background))
    covered = [(d if kernels.shape[-4] > 1 else 0, *layer) for d, layer in each]
    return occlusion(
        (
            blur(light, kernels[..., d, :, :, :], boundary=boundary),
            blur(cover, unit[..., d, :, :, :], boundary=boundary),
        )
        for d, light, cover in covered
    )


def occlusion(layers: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
    """The image (..., C, H, W) of layers from far to near, each its light and its coverage; the first one is opaque."""
    total = torch.zeros((), device="cpu")
    for light, cover in layers:
        total = (1 - cover) * total + light
    return total


def extended_layers(light: Tensor, masks: Tensor, background: Tensor | None = None) -> Iterator[tuple[Tensor, Tensor]]:
    """Light α_d x_d (..., C, H, W) and coverage α_d (..., 1, H, W) of layers from far to near, hidden parts included.

        α_d = m_d/v_d,   v_d = Σ_(k ≤ d) m_k     where nearer layers leave a share v_d visible

    Where they hide it, a layer continues as its visible surroundings do (`_filled`), the farthest one as `background`,
    if this is given. light: (..., D, C, H, W), of each layer's own part, m_d x; masks: (..., D, H, W).
    """
    count, visible = masks.shape[-3], masks.cumsum(-3)[..., None, :, :]
    for d in range(count):
        known, mask = visible[..., d, :, :, :], masks[..., d, None, :, :]
        if d == 0 and background is not None:
            seen = _sure(known)
            yield seen * safe_divide(light[..., d, :, :, :], known) + (1 - seen) * background, torch.ones_like(mask)
        elif d == count - 1:  # nothing is in front of it
            yield light[..., d, :, :, :], torch.ones_like(mask) if d == 0 else mask
        else:
            cover = mask.expand(*light.shape[:-4], *mask.shape[-3:])
            parts = _filled(torch.cat([light[..., d, :, :, :], cover], -3), known)
            yield parts[..., :-1, :, :], torch.ones_like(cover) if d == 0 else parts[..., -1:, :, :]


def _filled(values: Tensor, known: Tensor) -> Tensor:
    """Values (..., K, H, W), of which pixels know a share (..., 1, H, W), over the share; unknown ones are averages.

    Those are of the known pixels around, over a square twice as large for as long as it has none (Gortler et al., The
    lumigraph, SIGGRAPH 1996), bilinear between the squares.
    """
    rows, columns = values.shape[-2:]
    mean = safe_divide(values, known)
    if max(rows, columns) == 1:
        return mean
    batch = torch.cat([values, known.expand(*values.shape[:-3], 1, rows, columns)], -3)
    pooled = torch.nn.functional.avg_pool2d(
        batch.reshape(-1, *batch.shape[-3:]), 2, ceil_mode=True, count_include_pad=False
    )
    pooled = pooled.reshape(*batch.shape[:-2], *pooled.shape[-2:])
    coarse = _filled(pooled[..., :-1, :, :], pooled[..., -1:, :, :])
    around = torch.nn.functional.interpolate(
        coarse.reshape(-1, *coarse.shape[-3:]), size=(rows, columns), mode="bilinear", align_corners=False
    ).reshape(values.shape)
    return around + _sure(known) * (mean - around)


def _sure(known: Tensor) -> Tensor:
    """Weights of values that pixels know to a share, 1 but for the smallest shares."""
    return known * (1 + _LITTLE) / (known + _LITTLE)


def _extend_axis(picture: Tensor, length: int, axis: int, boundary: str) -> Tensor:
    """Mirror images behind an axis up to `length`, blending from the image at its end to the image at its start."""
    count = picture.shape[axis]
    missing = length - count
    if missing == 0:
        return picture
    place = torch.arange(missing, device=picture.device)
    share = ((place + 0.5) / missing).to(picture.dtype)
    # Cosine: no kink at the borders.
    fade = 0.5 - 0.5 * torch.cos(math.pi * share) if boundary == "taper" else (share > 0.5).to(picture.dtype)
    fade = fade[:, None] if axis == -2 else fade
    mirrors = []
    for k in (count + place, place - missing):  # indices of the mirrored continuation: … 1 0 | 0 1 2 | 2 1 …
        folded = k % (2 * count)
        mirrors.append(picture.index_select(axis, torch.minimum(folded, 2 * count - 1 - folded)))
    last, first = mirrors
    return torch.cat([picture, last + fade * (first - last)], axis)


def _half_pixels(kernel: Tensor, shape: Sequence[int]) -> Tensor:
    """Phases exp(-iπf) (rows, columns) that shift kernels by half a pixel along every axis of even size."""
    phases = []
    for count, size in zip(shape, kernel.shape[-2:], strict=True):
        frequency = torch.fft.fftfreq(count, dtype=kernel.dtype, device=kernel.device)
        # At ½ the phase must be real: half the sum of exp(-iπ/2) and its conjugate, 0.
        shift = torch.polar((frequency.abs() < 0.5).to(frequency.dtype), -math.pi * frequency)
        phases.append(torch.ones_like(frequency) if size % 2 else shift)
    return phases[0][:, None] * phases[1]


def check_axes(**tensors: Tensor) -> None:
    """Raise ValueError unless the axes before (rows, columns) of images, kernels or filters broadcast."""
    try:
        broadcast_shape(*(tensor.shape[:-2] for tensor in tensors.values()))
    except ValueError:
        shapes = " and ".join(f"a {name} of shape {tuple(tensor.shape)}" for name, tensor in tensors.items())
        raise ValueError(
            f"{shapes}: the axes before (rows, columns) do not broadcast; expected equal numbers, or 1"
        ) from None


def _check_kernel(kernel: Tensor) -> None:
    if not kernel.is_floating_point():
        kind = str(kernel.dtype).removeprefix("torch.")
        raise ValueError(f"a kernel of {kind}: expected floating-point numbers, the share of the light in each pixel")


def _check_choice(choice: str, known: tuple[str, ...], what: str) -> None:
    if choice not in known:
        raise ValueError(f"{what} {choice!r}: expected {', '.join(known)}")


def check_fit(small: Sequence[int], large: Sequence[int], what: str = "a kernel", where: str = "a picture") -> None:
    """Raise ValueError unless `small` (rows, columns) fit into `large`."""
    (h, w), (rows, columns) = small, large
    if h > rows or w > columns:
        raise ValueError(f"{what} of {h} × {w} pixels on {where} of {rows} × {columns}: expected a larger one")


# -- noise and quantisation of the sensor


def add_noise(picture: Tensor, sigma: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Gaussian noise of standard deviation `sigma`, in the unit of the image, broadcast against it."""
    picture = as_picture(picture)
    return picture + sigma * _normal(picture, generator)


def add_shot_noise(picture: Tensor, electrons: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Shot noise in the Gaussian approximation, y = x + √(x/N) ξ, differentiable in x and N.

    electrons: N, per pixel at level 1. Levels ≤ 0 have no noise.
    """
    picture = as_picture(picture)
    return picture + safe_sqrt(picture / electrons) * _normal(picture, generator)


def count_electrons(picture: Tensor, electrons: Tensor | float, *, generator: torch.Generator | None = None) -> Tensor:
    """Poisson shot noise: y = n/N, n of mean N x, 0 for x < 0; the gradient is x's."""
    picture = as_picture(picture)
    counts = torch.poisson((picture.detach() * electrons).clamp(min=0), generator=generator)
    return picture + (counts / electrons - picture).detach()


def digitise(picture: Tensor, bits: int) -> Tensor:
    """The nearest of 2^bits levels from 0 to 1, saturated beyond; the gradient ignores the quantisation."""
    if bits < 1:
        raise ValueError(f"{bits} bits: expected at least 1")
    picture = as_picture(picture)
    steps = 2**bits - 1
    limited = picture.clamp(0.0, 1.0)
    return limited + ((limited * steps).round() / steps - limited).detach()


def _normal(picture: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.randn(picture.shape, dtype=picture.dtype, device=picture.device, generator=generator)
