"""Image: what a camera makes of a picture: blur by point spread functions at one or many depths.

Pictures are floating-point numbers in any unit; integers of 8 or 16 bits are read as 0 to 1 (`as_picture`).

Kernels (..., h, w) are spots around their middle pixel (h//2, w//2); a kernel whose only value stands there gives the
picture back. A spot centred on a `Grid` of even size lies half a pixel before it, between pixels: such a kernel moves a
picture by half a pixel, which deconvolution with the same kernel undoes, or origin="grid" takes out of both.
"""

import math

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import broadcast_shape, safe_divide

#: What lies beyond the borders of a picture: "zero" darkens them, "reflect" mirrors the picture there, "taper" fades
#: from the mirror image at one border to that at the opposite one, so that the whole is periodic without a jump.
EXTENSIONS = ("zero", "reflect", "taper")
BOUNDARIES = ("valid", "circular", *EXTENSIONS)
COMPOSITIONS = ("masked", "sum", "occlusion")
_ORIGINS = ("pixel", "grid")
#: White of integer pictures.
_WHITE = {torch.uint8: 255, torch.uint16: 65535}


def as_picture(picture: Tensor | np.ndarray, what: str = "picture") -> Tensor:
    """A picture as floating-point numbers: as it is, or of integers of 8 or 16 bits, whose largest value becomes 1.

    Raises ValueError for other integers, whose white is unknown, and for complex numbers.
    """
    picture = torch.as_tensor(picture)
    if picture.is_floating_point():
        return picture
    if picture.dtype not in _WHITE:
        raise ValueError(
            f"a {what} of {str(picture.dtype).removeprefix('torch.')}: its white is unknown; expected floating-point "
            "numbers, or uint8 or uint16; convert it, as picture.float() / 255"
        )
    return picture.to(torch.get_default_dtype()) / _WHITE[picture.dtype]


def blur(picture: Tensor, kernel: Tensor, *, boundary: str = "valid", origin: str = "pixel") -> Tensor:
    """Convolution, by default over the part of the plane where the whole kernel lies on the picture.

        y_ij = Σ_ab h_ab x_(i + h//2 - a, j + w//2 - b)

    picture: (..., H, W); kernel: (..., h, w); the axes before broadcast. boundary: "valid" returns
    (..., H - h + 1, W - w + 1), that of the picture's part `visible`: no border darkens. All others return (..., H, W):
    "circular" takes the picture as periodic, `EXTENSIONS` go beyond its borders. origin: "pixel", or "grid": the middle
    of an even kernel is (h - 1)/2, and its half pixel is taken out by phases (not for "valid", where what wraps around
    would come in). By FFT. Raises ValueError for a kernel larger than a valid or circular picture, and for axes that do
    not broadcast.
    """
    picture = as_picture(picture)
    _check_choice(boundary, BOUNDARIES, "boundary")
    _check_kernel(kernel)
    check_axes(picture=picture, kernel=kernel)
    size, spot = picture.shape[-2:], kernel.shape[-2:]
    _check_origin(boundary, origin, spot)
    shape = _work_shape(size, spot, boundary)
    check_fit(spot, shape)
    if boundary in EXTENSIONS:
        picture = extend(picture, shape, boundary=boundary)
    blurred = torch.fft.irfft2(torch.fft.rfft2(picture) * _half_transfer(kernel, shape, origin), s=shape)
    if boundary == "valid":
        return blurred[..., spot[0] - 1 :, spot[1] - 1 :]
    return torch.roll(blurred, (-(spot[0] // 2), -(spot[1] // 2)), (-2, -1))[..., : size[0], : size[1]]


def blur_adjoint(image: Tensor, kernel: Tensor, *, boundary: str = "valid", origin: str = "pixel") -> Tensor:
    """The transpose of `blur`: ⟨blur(x), y⟩ = ⟨x, blur_adjoint(y)⟩; correlation, and what lies beyond borders put back.

    image: (..., H, W) as `blur` returns it with this boundary; returns pictures, which "valid" makes larger again.
    """
    more = [n - 1 if boundary == "valid" else 0 for n in kernel.shape[-2:]]
    batch = torch.broadcast_shapes(image.shape[:-2], kernel.shape[:-2])
    picture = image.new_zeros(*batch, *(n + m for n, m in zip(image.shape[-2:], more, strict=True)))
    _, transpose = torch.func.vjp(lambda x: blur(x, kernel, boundary=boundary, origin=origin), picture)
    return transpose(image.expand(*batch, *image.shape[-2:]))[0]


def visible(picture: Tensor, spot: tuple[int, int]) -> Tensor:
    """The part (..., H - h + 1, W - w + 1) of pictures that a "valid" blur images; spot: (h, w) of the kernels."""
    (rows, columns), (h, w) = picture.shape[-2:], spot
    top, left = h - 1 - h // 2, w - 1 - w // 2
    return picture[..., top : rows - h // 2, left : columns - w // 2]


def transfer_functions(kernels: Tensor, size: int | tuple[int, int], *, origin: str = "pixel") -> Tensor:
    """H (..., rows, columns), the Fourier transforms of kernels (..., h, w) on pictures of that size, as by `fft2`.

    origin: as for `blur`, which multiplies by them where its boundary is "circular". At origin "grid" an even kernel
    has no value at the Nyquist frequency, whose wave of half a pixel's shift cannot be told from none.
    """
    shape = _pair(size)
    _check_choice(origin, _ORIGINS, "origin")
    h, w = kernels.shape[-2:]
    check_fit((h, w), shape)
    padded = torch.nn.functional.pad(kernels, (0, shape[1] - w, 0, shape[0] - h))
    placed = torch.roll(padded, (-(h // 2), -(w // 2)), (-2, -1))
    transfer = torch.fft.fft2(placed)
    return transfer if origin == "pixel" else transfer * _half_pixels(kernels, shape)


def extend(picture: Tensor, shape: tuple[int, int], *, boundary: str) -> Tensor:
    """Pictures (..., H, W) with rows and columns behind them up to `shape`: one period of an endless picture.

    The first half of what is added continues the last row, the second half precedes the first one. boundary: one of
    `EXTENSIONS`; the mirror images repeat the pixel at the border, as often as needed.
    """
    _check_choice(boundary, EXTENSIONS, "boundary")
    rows, columns = picture.shape[-2:]
    check_fit((rows, columns), shape, "a picture", "a period")
    if boundary == "zero":
        return torch.nn.functional.pad(picture, (0, shape[1] - columns, 0, shape[0] - rows))
    return _extend_axis(_extend_axis(picture, shape[0], -2, boundary), shape[1], -1, boundary)


def depth_masks(depth: Tensor, planes: Tensor, *, softness: float = 0.0, feather: float = 0.0) -> Tensor:
    """Shares (..., D, H, W) of every pixel of a depth map (..., H, W) in layers at `planes` (D,); they sum to one.

        m_d = s((z - b_d)/w) - s((z - b_(d+1))/w),   b_d midway between planes d - 1 and d,   s(t) = 1/(1 + e^-t)

    planes: ascending and finite, in the measure of the depth map; with reciprocal distances (0 at infinity) the layers
    come from far to near, as `blur_layers` takes them. softness: w, in the same measure; 0 gives every pixel to the
    nearest plane. feather: standard deviation in pixels of a Gaussian that blurs the masks, for edges soft in space.
    """
    if planes.dim() != 1 or not bool((planes[1:] > planes[:-1]).all() & torch.isfinite(planes).all()):
        raise ValueError(
            f"planes {planes.tolist()}: expected finite, ascending ones (1/distance where one is infinite)"
        )
    beyond = depth[..., None, :, :] - (0.5 * (planes[1:] + planes[:-1]))[:, None, None]
    above = torch.sigmoid(beyond / softness) if softness > 0 else (beyond > 0).to(beyond.dtype)
    all_of_it = torch.ones_like(depth)[..., None, :, :]
    masks = torch.cat([all_of_it, above], -3) - torch.cat([above, torch.zeros_like(all_of_it)], -3)
    return blur(masks, _gaussian(feather, masks), boundary="reflect") if feather > 0 else masks


def blur_layers(
    picture: Tensor,
    masks: Tensor,
    kernels: Tensor,
    *,
    composition: str = "occlusion",
    boundary: str = "valid",
) -> Tensor:
    """The image of a scene in layers, each blurred by its own kernels, in colours.

        masked:     y = Σ_d m_d (h_d ∗ x)          every pixel as if the whole scene were at its depth
        sum:        y = Σ_d h_d ∗ (m_d x)          light adds up, nothing hides anything
        occlusion:  y = Y_D/A_D,   Y_d = (1 - a_d) Y_(d-1) + h_d ∗ (m_d x),   a_d = h_d ∗ m_d,  A likewise from a

    With occlusion the blurred near layer covers what lies behind; division by the coverage A fills in what the picture
    does not show there (after Ikoma et al., 2021). A flat picture stays flat by "masked" and "occlusion".
    picture: (..., C, H, W); masks: (..., D, H, W) from far to near, summing to one; kernels: (..., D, C, h, w).
    boundary: as for `blur`. Raises ValueError for other shapes.
    """
    picture = as_picture(picture)
    _check_kernel(kernels)
    for what, tensor, axes in (
        ("picture", picture, "C, H, W"),
        ("masks", masks, "D, H, W"),
        ("kernels", kernels, "D, C, h, w"),
    ):
        if tensor.dim() < axes.count(",") + 1:
            raise ValueError(f"{what} of shape {tuple(tensor.shape)}: expected (..., {axes})")
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
    light = blur(layers * scene, kernels, boundary=boundary)
    if composition == "sum":
        return light.sum(-4)
    # Coverage is of the light that arrives: a kernel that loses light darkens its layer, and does not make it clear.
    return _over(light, blur(layers, safe_divide(kernels, kernels.sum((-2, -1), keepdim=True)), boundary=boundary))


def _over(light: Tensor, cover: Tensor) -> Tensor:
    """Layers (..., D, C, H, W) of light and coverage from far to near, one before the other, over their coverage."""
    total, covered = light[..., 0, :, :, :], cover[..., 0, :, :, :]
    for near_light, near_cover in zip(light.unbind(-4)[1:], cover.unbind(-4)[1:], strict=True):
        total = (1 - near_cover) * total + near_light
        covered = (1 - near_cover) * covered + near_cover
    # Rounding of the FFT leaves ±1e-16 where nothing covers: no light either, and no division by it.
    floor = 1e3 * torch.finfo(covered.dtype).eps
    return safe_divide(total, torch.where(covered > floor, covered, 0.0))


def _extend_axis(picture: Tensor, length: int, axis: int, boundary: str) -> Tensor:
    """Mirror images behind an axis up to `length`, from that of its end to that of its start."""
    count = picture.shape[axis]
    missing = length - count
    if missing == 0:
        return picture
    after, before, fade = _mirror_images(picture, count, missing, axis, boundary)
    last, first = picture.index_select(axis, after), picture.index_select(axis, before)
    return torch.cat([picture, last + fade * (first - last)], axis)


def _mirror_images(like: Tensor, count: int, missing: int, axis: int, boundary: str) -> tuple[Tensor, Tensor, Tensor]:
    """Where the mirror images behind the end and before the start of an axis come from, and the share of the latter."""
    place = torch.arange(missing, device=like.device)
    share = ((place + 0.5) / missing).to(like.dtype)
    # Cosine: fades without a kink at the borders.
    fade = 0.5 - 0.5 * torch.cos(math.pi * share) if boundary == "taper" else (share > 0.5).to(like.dtype)
    return _mirror(count + place, count), _mirror(place - missing, count), fade[:, None] if axis == -2 else fade


def _mirror(place: Tensor, count: int) -> Tensor:
    """Index of the pixel that mirrors at both ends of a line of `count` put at any place: … 1 0 | 0 1 2 | 2 1 …"""
    folded = place % (2 * count)
    return torch.minimum(folded, 2 * count - 1 - folded)


def _half_transfer(kernel: Tensor, shape: tuple[int, int], origin: str) -> Tensor:
    """The transfer function as by `rfft2`, of the kernel with its first pixel as the origin."""
    transfer = torch.fft.rfft2(kernel, s=shape)
    return transfer if origin == "pixel" else transfer * _half_pixels(kernel, shape)[:, : shape[1] // 2 + 1]


def _half_pixels(kernel: Tensor, shape: tuple[int, int]) -> Tensor:
    """Phases exp(-iπf) (rows, columns) that move kernels by half a pixel along every axis they are even on."""
    rows, columns = (
        _half_pixel(torch.fft.fftfreq(count, dtype=kernel.dtype, device=kernel.device), even=size % 2 == 0)
        for count, size in zip(shape, kernel.shape[-2:], strict=True)
    )
    return rows[:, None] * columns


def _half_pixel(frequency: Tensor, *, even: bool) -> Tensor:
    if not even:
        return torch.ones_like(frequency)
    # At ½ the phase must be real: half the sum of exp(-iπ/2) and its conjugate, 0.
    return torch.polar((frequency.abs() < 0.5).to(frequency.dtype), -math.pi * frequency)


def _work_shape(size: tuple[int, int], spot: tuple[int, int], boundary: str) -> tuple[int, int]:
    """Size of the period in which to convolve: an extension holds the reach of the kernel on both sides."""
    if boundary not in EXTENSIONS:
        return size[0], size[1]
    return size[0] + 2 * (spot[0] // 2), size[1] + 2 * (spot[1] // 2)


def _gaussian(deviation: float, like: Tensor) -> Tensor:
    reach = math.ceil(4 * deviation)
    x = torch.arange(-reach, reach + 1, dtype=like.dtype, device=like.device)
    line = torch.exp(-0.5 * (x / deviation) ** 2)
    return (line[:, None] * line) / line.sum() ** 2


def _pair(size: int | tuple[int, int]) -> tuple[int, int]:
    return (size, size) if isinstance(size, int) else (size[0], size[1])


def check_axes(**given: Tensor) -> None:
    """Raises ValueError unless what is before the axes (rows, columns) of pictures, kernels or filters broadcasts."""
    try:
        broadcast_shape(*(tensor.shape[:-2] for tensor in given.values()))
    except ValueError:
        shapes = " and ".join(f"a {name} of shape {tuple(tensor.shape)}" for name, tensor in given.items())
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


def check_fit(small, large, what: str = "a kernel", where: str = "a picture") -> None:
    """Raises ValueError unless something of so many rows and columns fits on something larger."""
    (h, w), (rows, columns) = small, large
    if h > rows or w > columns:
        raise ValueError(f"{what} of {h} × {w} pixels on {where} of {rows} × {columns}: expected a larger one")


def _check_origin(boundary: str, origin: str, spot) -> None:
    _check_choice(origin, _ORIGINS, "origin")
    if boundary == "valid" and origin == "grid" and (spot[0] % 2 == 0 or spot[1] % 2 == 0):
        raise ValueError(
            f"origin 'grid' with a kernel of {spot[0]} × {spot[1]} pixels and boundary 'valid': half a pixel's shift "
            "reaches across the whole picture; expected odd sizes, or another boundary"
        )
