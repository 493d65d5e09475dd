"""Fabrication: an element at the size of its features, its steps, its tolerance, and how rough it is.

Every function takes an Element or a height map and gives a new one; gradients pass all of them.
"""

import dataclasses

import torch
from torch import Tensor

from raytrace.wave.element import Element, Pixels, Rings, fabricated, is_radial, period, profile_height

#: Sizes of features, mm: what diamond turning makes of PMMA, and etching of fused silica.
TURNED, ETCHED = 3.69e-3, 2e-3


def as_rings(element: Element, pitch: float | Tensor) -> Element:
    """A radial element with the height at the middle of every ring of `pitch` mm, flat over the ring.

    Period and levels stay those of the element. Raises ValueError for an element that is not radial.
    """
    if not is_radial(element):
        kind = type(element.profile).__name__
        raise ValueError(f"a profile of {kind} is not radial, and rings cannot hold it; use as_pixels")
    pitch = torch.as_tensor(pitch, dtype=element.radius.dtype, device=element.radius.device)
    r = (torch.arange(features(element.radius, pitch)).to(pitch) + 0.5) * pitch
    heights = profile_height(element.profile, r, torch.zeros_like(r), radius=element.radius)
    return dataclasses.replace(element, profile=Rings(heights, pitch))


def as_pixels(element: Element, pitch: float | Tensor) -> Element:
    """An element with the height at the middle of every square of `pitch` mm around the axis, flat over the square.

    Period and levels stay those of the element. Beyond the aperture the profile is continued.
    """
    pitch = torch.as_tensor(pitch, dtype=element.radius.dtype, device=element.radius.device)
    count = features(2 * element.radius, pitch)
    x = (torch.arange(count).to(pitch) - 0.5 * (count - 1)) * pitch
    y, x = torch.meshgrid(x, x, indexing="ij")
    return dataclasses.replace(
        element, profile=Pixels(profile_height(element.profile, x, y, radius=element.radius), pitch)
    )


def features(length: Tensor, pitch: Tensor) -> int:
    """How many features of `pitch` mm cover `length` mm; one is not added for what rounding leaves."""
    return int(torch.ceil((length / pitch).detach() * (1 - 1e-6)))


def wrapped(element: Element, wavelength: float | Tensor, *, levels: int = 0) -> Element:
    """The element with its height modulo one wave of `wavelength` µm, in `levels` equal steps (0: any height).

    Neutral at that wavelength alone. A kinoform of L levels keeps sinc²(1/L) of its light (Goodman and Silvestri,
    IBM J. Res. Dev. 14, 478, 1970).
    """
    return dataclasses.replace(element, period=period(element.glass, wavelength).to(element.radius), levels=levels)


def as_made(element: Element) -> Element:
    """The element with the heights of its rings or pixels wrapped and stepped, as they are to be written to a file.

    Raises ValueError for a smooth profile, which has no features.
    """
    profile = element.profile
    if not isinstance(profile, Rings | Pixels):
        kind = type(profile).__name__
        raise ValueError(f"a profile of {kind} has no features to be made; use as_rings or as_pixels first")
    heights = fabricated(profile.heights, element.period, element.levels)
    return dataclasses.replace(element, profile=dataclasses.replace(profile, heights=heights), period=None, levels=0)


def with_tolerance(element: Element, tolerance: float | Tensor, *, generator: torch.Generator | None = None) -> Element:
    """The element as made, but each ring or pixel off by a uniform draw of ± `tolerance` mm.

    The same generator state gives the same errors. Raises ValueError for a smooth profile, which has no features.
    """
    made = as_made(element)
    heights = made.profile.heights
    draw = torch.rand(heights.shape, generator=generator, dtype=heights.dtype, device=heights.device)
    off = dataclasses.replace(made.profile, heights=heights + tolerance * (2 * draw - 1))
    return dataclasses.replace(made, profile=off)


def roughness(heights: Tensor) -> Tensor:
    """Mean |Σ of the 8 neighbours - 8 h| (...) mm over the inner points of height maps (..., rows, columns) mm.

    0 for a tilted plane. Raises ValueError for a map of fewer than 3 × 3 points, which has no inner one.
    """
    if heights.ndim < 2 or min(heights.shape[-2:]) < 3:
        raise ValueError(f"roughness needs a map of 3 × 3 heights at least; found the shape {tuple(heights.shape)}")
    across = heights[..., :, :-2] + heights[..., :, 1:-1] + heights[..., :, 2:]
    square = across[..., :-2, :] + across[..., 1:-1, :] + across[..., 2:, :]
    return (square - 9 * heights[..., 1:-1, 1:-1]).abs().mean((-2, -1))
