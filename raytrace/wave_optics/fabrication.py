"""Fabrication: rings, pixels and steps of an element, and the heights that a process of lithography can etch.

A process etches rings or pixels to L equal depths below m waves of the design wavelength, each with an error up to a
tolerance. Modulo m waves nothing changes at the design wavelength, but at every other one: so the depth is taken whose
phases agree best with those of the element at all wavelengths,

    h = argmax_d Σ_λ cos(k_λ (n_λ - 1) (d - h₀) - φ_λ),     φ_λ the pistons, which no image shows
"""

import dataclasses
import math

import torch
from torch import Tensor

from raytrace.materials.glass import index
from raytrace.maths.numerics import value
from raytrace.wave_optics.element import (
    Element,
    Pixels,
    Rings,
    designed_height,
    fabricated_height,
    height,
    is_flat,
    is_radial,
    period,
)

_CANDIDATES = 256  # depths within the relief of a process without steps
_ROUNDS = 12  # of depths and pistons in turn
_TRIES = 6  # first pistons


def as_rings(element: Element, pitch: float | Tensor) -> Element:
    """A radial element with the height at the middle of every ring of `pitch` mm, flat over the ring.

    Period and levels stay those of the element. Raises ValueError for an element that is not radial.
    """
    if not is_radial(element):
        kind = type(element.profile).__name__
        raise ValueError(f"a profile of {kind} is not radial, and rings cannot hold it; use as_pixels")
    pitch = torch.as_tensor(pitch, dtype=element.radius.dtype, device=element.radius.device)
    r = (torch.arange(features(element.radius, pitch)).to(pitch) + 0.5) * pitch
    return dataclasses.replace(element, profile=Rings(designed_height(element, r, torch.zeros_like(r)), pitch))


def as_pixels(element: Element, pitch: float | Tensor) -> Element:
    """An element with the height at the middle of every square of `pitch` mm around the axis, flat over the square.

    Period and levels stay those of the element. Beyond the aperture the profile is continued.
    """
    pitch = torch.as_tensor(pitch, dtype=element.radius.dtype, device=element.radius.device)
    count = features(2 * element.radius, pitch)
    x = (torch.arange(count).to(pitch) - 0.5 * (count - 1)) * pitch
    y, x = torch.meshgrid(x, x, indexing="ij")
    return dataclasses.replace(element, profile=Pixels(designed_height(element, x, y), pitch))


def features(length: Tensor, pitch: Tensor) -> int:
    """Number of features of `pitch` mm that cover `length` mm, rounding aside."""
    return int(torch.ceil((length / pitch).detach() * (1 - 1e-6)))


def wrapped(element: Element, wavelength: float | Tensor, *, levels: int = 0) -> Element:
    """The element with its height modulo one wave of `wavelength` µm, in `levels` equal steps (0: any height).

    Neutral at that wavelength alone. A kinoform of L levels keeps sinc²(1/L) of its light (Goodman and Silvestri,
    IBM J. Res. Dev. 14, 478, 1970).
    """
    return dataclasses.replace(element, period=period(element.glass, wavelength).to(element.radius), levels=levels)


def fabricated(element: Element) -> Element:
    """The element with the heights (rows, columns) or (R,) mm of its pixels or rings wrapped and stepped, as light and
    `write_element` see them.

    Raises ValueError for a smooth profile, which has no features.
    """
    _need_features(element)
    heights = fabricated_height(element.numbers, element.period, element.levels)
    return dataclasses.replace(element.with_numbers(heights), period=None, levels=0)


def _need_features(element: Element) -> None:
    if not is_flat(element):
        kind = type(element.profile).__name__
        raise ValueError(f"a profile of {kind} has no features to fabricate; use as_rings or as_pixels first")


def with_tolerance(element: Element, tolerance: float | Tensor, *, generator: torch.Generator | None = None) -> Element:
    """The fabricated element with a uniform random height error of ± `tolerance` mm of each ring or pixel.

    The same generator state gives the same errors. Raises ValueError for a smooth profile, which has no features.
    """
    exact = fabricated(element)
    heights = exact.numbers
    draw = torch.rand(heights.shape, generator=generator, dtype=heights.dtype, device=heights.device)
    return exact.with_numbers(heights + tolerance * (2 * draw - 1))


@torch.no_grad()
def height_range(element: Element) -> tuple[float, float]:
    """The smallest and the largest height in mm inside the aperture, wrapped and stepped.

    Of pixels and rings exact; of a smooth profile from 4,097 points of a radius, or of 513 × 513 of the square around.
    """
    radius, profile = element.radius, element.profile
    if isinstance(profile, Rings):
        heights = fabricated(element).numbers[: features(radius, profile.pitch)]
    else:
        if isinstance(profile, Pixels):
            y, x = ((torch.arange(n).to(radius) - 0.5 * (n - 1)) * profile.pitch for n in element.numbers.shape)
        elif is_radial(element):
            x = radius * torch.linspace(0, 1, 4097).to(radius)
            y = torch.zeros_like(x[:1])
        else:
            x = y = radius * torch.linspace(-1, 1, 513).to(radius)
        y, x = torch.meshgrid(y, x, indexing="ij")
        heights = height(element, x, y)[torch.hypot(x, y) <= radius * (1 + 1e-6)]
    return float(heights.min()) + 0.0, float(heights.max()) + 0.0


@value
class Process:
    """waves: depth in waves of the design wavelength (µm); levels: equal depths, 0 for any; tolerance: ± mm."""

    waves: int = 1
    levels: int = 0
    tolerance: float = 0.0
    wavelength: float = 0.55

    def period(self, element: Element) -> Tensor:
        """The depth in mm of `waves` whole waves at the design wavelength, which is not reached."""
        return self.waves * period(element.glass, self.wavelength).to(element.radius)


@torch.no_grad()
def matched(element: Element, process: Process, wavelengths: Tensor) -> tuple[Element, float]:
    """The element that the process can make nearest in phase at wavelengths (W,) µm, and their agreement: 1 at best.

    Rings count by their area. Raises ValueError for a smooth element, which has no features to etch.
    """
    _need_features(element)
    rate = 2 * math.pi / (1e-3 * wavelengths) * (index(element.glass, wavelengths) - 1)  # radians per mm
    wanted = element.numbers.detach().flatten()
    count = process.levels or _CANDIDATES
    depths = process.period(element) * torch.arange(count).to(wanted) / count
    area = torch.arange(len(wanted)).to(wanted) + 0.5 if element.kind.is_radial else torch.ones_like(wanted)
    random = torch.Generator().manual_seed(0)
    best, most = wanted, -math.inf
    for trial in range(_TRIES):
        pistons = 2 * math.pi * torch.rand(len(rate), generator=random, dtype=torch.float64).to(wanted)
        pistons = pistons if trial else torch.zeros_like(pistons)
        for _ in range(_ROUNDS):
            agreement = torch.zeros(len(depths), len(wanted)).to(wanted)  # Σ_λ cos of the differences in phase
            for slope, piston in zip(rate, pistons, strict=True):
                agreement += torch.cos(slope * (depths[:, None] - wanted) - piston)
            nearest = depths[agreement.argmax(0)]
            pistons = torch.angle(
                (area * torch.polar(torch.ones_like(rate)[:, None], rate[:, None] * (nearest - wanted))).sum(1)
            )
        near = float((area * agreement.amax(0)).sum() / (area.sum() * len(rate)))
        if near > most:
            best, most = nearest, near
    etched = element.with_numbers(best.reshape(element.numbers.shape))
    return dataclasses.replace(etched, period=process.period(element), levels=process.levels), most
