"""Thin phase elements, given by their height over the aperture, as designed and as fabricated.

    path(x, y, λ) = (n(λ) - 1) h(x, y)

relative to air. A thicker part delays light: a converging element is thickest on its axis.

Free heights are pixels or rings (a rotationally symmetric height profile), flat each; smooth ones Zernike polynomials
or even powers of the radius; KINDS has a row for each. Elements in contact add their paths. Everything is
differentiable.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.materials.glass import Glass, index
from raytrace.maths.numerics import safe_sqrt
from raytrace.maths.value import value
from raytrace.maths.zernike import noll, polynomials

#: Sizes of features, mm: diamond turning of PMMA, and etching of fused silica.
TURNED, ETCHED = 3.69e-3, 2e-3


@value
class Pixels:
    """Heights (rows, columns) mm of square pixels of `pitch` mm around the axis; row 0 lies at the smallest y."""

    heights: Tensor
    pitch: Tensor


@value
class Rings:
    """Rotationally symmetric heights (R,) mm: ring k from radius k·pitch to (k + 1)·pitch mm."""

    heights: Tensor
    pitch: Tensor


@value
class Zernike:
    """h = Σ_j c_j Z_j(x/R, y/R): coefficients (J,) mm RMS, Noll's from j = 1 on; R: the radius of the element."""

    coefficients: Tensor


@value
class EvenPowers:
    """h = Σ_k c_k r^(2k), k = 1, 2, …: coefficients (K,) mm^(1 - 2k)."""

    coefficients: Tensor


Profile = Pixels | Rings | Zernike | EvenPowers


def _pixels(profile: Pixels, x: Tensor, y: Tensor, radius: Tensor) -> Tensor:
    rows, columns = profile.heights.shape
    return profile.heights[_place(y, profile.pitch, rows), _place(x, profile.pitch, columns)]


def _place(position: Tensor, pitch: Tensor, count: int) -> Tensor:
    return torch.floor((position / pitch).detach() + 0.5 * count).long().clamp(0, count - 1)


def _rings(profile: Rings, x: Tensor, y: Tensor, radius: Tensor) -> Tensor:
    r = safe_sqrt((x * x + y * y).detach())
    return profile.heights[(r / profile.pitch.detach()).long().clamp(max=len(profile.heights) - 1)]


def _zernike(profile: Zernike, x: Tensor, y: Tensor, radius: Tensor) -> Tensor:
    orders = [noll(j) for j in range(1, len(profile.coefficients) + 1)]
    return torch.tensordot(profile.coefficients, polynomials(orders, x / radius, y / radius), 1)


def _even_powers(profile: EvenPowers, x: Tensor, y: Tensor, radius: Tensor) -> Tensor:
    r2, total = x * x + y * y, torch.zeros_like(x)
    for c in profile.coefficients.flip(0):
        total = (total + c) * r2
    return total


class Kind(NamedTuple):
    """A kind of profile.

    words: its name in reports; numbers: its field of free numbers; height: (profile, x, y, radius of the aperture in
    mm) -> mm before it is wrapped or stepped; is_radial: whether it depends on the distance from the axis alone;
    is_flat: whether it has features of one pitch, flat each, with steps between them.
    """

    words: str
    numbers: str
    height: Callable[[Profile, Tensor, Tensor, Tensor], Tensor]
    is_radial: bool = False
    is_flat: bool = False


KINDS = {
    Pixels: Kind("pixels", "heights", _pixels, is_flat=True),
    Rings: Kind("rings", "heights", _rings, is_radial=True, is_flat=True),
    Zernike: Kind("smooth, free form", "coefficients", _zernike),
    EvenPowers: Kind("smooth, round", "coefficients", _even_powers, is_radial=True),
}


@value
class Element:
    """A profile in a round aperture.

    radius: of the aperture, mm; glass: its material (`glass.constant(2.0)` gives the same path in mm at every
    wavelength). period: height in mm that adds a whole wave at the design wavelength, λ₀/(n₀ - 1): the height is taken
    modulo it, None leaves it whole. levels: number of equal steps of a period, 0 for any height; gradients ignore the
    steps.
    """

    profile: Profile
    radius: Tensor
    glass: Glass
    period: Tensor | None = None
    levels: int = 0

    @property
    def kind(self) -> Kind:
        return KINDS[type(self.profile)]

    @property
    def numbers(self) -> Tensor:
        """Heights or coefficients."""
        return getattr(self.profile, self.kind.numbers)

    def with_numbers(self, numbers: Tensor) -> "Element":
        """The element with other heights or coefficients."""
        return dataclasses.replace(self, profile=dataclasses.replace(self.profile, **{self.kind.numbers: numbers}))


def is_radial(element: Element) -> bool:
    """Whether the height depends on the distance from the axis alone."""
    return element.kind.is_radial


def is_flat(element: Element) -> bool:
    """Whether the height has features, flat each."""
    return element.kind.is_flat


def is_smooth(element: Element) -> bool:
    """Whether the height has neither steps nor jumps."""
    return element.period is None and not is_flat(element)


def height(element: Element, x: Tensor, y: Tensor) -> Tensor:
    """h (...) mm at points (...) mm, as it is fabricated; beyond the outermost pixel or ring, that of its neighbour."""
    return fabricated_height(designed_height(element, x, y), element.period, element.levels)


def designed_height(element: Element, x: Tensor, y: Tensor) -> Tensor:
    """h (...) mm before it is wrapped or stepped."""
    return element.kind.height(element.profile, x, y, element.radius)


def slopes_of(element: Element, x: Tensor, y: Tensor) -> Tensor:
    """∂h/∂x and ∂h/∂y (2, ...) of the designed height at points (...) mm, as numbers."""
    with torch.enable_grad():
        x, y = (p.detach().clone().requires_grad_() for p in (x, y))
        return torch.stack(torch.autograd.grad(designed_height(element, x, y).sum(), (x, y)))


def fabricated_height(height: Tensor, period: Tensor | None, levels: int = 0) -> Tensor:
    """Heights modulo a period, and lowered to the step below: floor(h/H·L)·H/L. The gradient is that of the height."""
    if period is None:
        return height
    # A height at a step to rounding is that step: sixteen levels read from a file do not change.
    slack = 1e-4 / levels if levels else 0.0
    wrapped = height - period * torch.floor((height / period).detach() + slack)
    if not levels:
        return wrapped
    step = (period / levels).detach()
    stepped = torch.floor((wrapped / step).detach() + 1e-4).clamp(max=levels - 1) * step
    return wrapped + (stepped - wrapped).detach()


def period(glass: Glass, wavelength: Tensor | float) -> Tensor:
    """λ₀/(n₀ - 1) in mm: the height that delays the design wavelength (µm) by one wave."""
    wavelength = torch.as_tensor(wavelength, dtype=torch.float64)
    return 1e-3 * wavelength / (index(glass, wavelength) - 1)


def excess_index(element: Element, wavelengths: Tensor, like: Tensor) -> Tensor:
    """n - 1 (W,) at wavelengths (W,) µm, in the dtype and on the device of `like`."""
    return index(element.glass, wavelengths).to(like) - 1


def path(elements: Sequence[Element], x: Tensor, y: Tensor, wavelengths: Tensor) -> Tensor:
    """Optical path (W, ...) mm that elements in contact add at points (...) mm, at wavelengths (W,) µm."""
    total = torch.zeros(len(wavelengths), *x.shape, dtype=x.dtype, device=x.device)
    for element in elements:
        excess = excess_index(element, wavelengths, x)
        total = total + excess.reshape(-1, *[1] * x.ndim) * height(element, x, y)
    return total


# -- fabrication -------------------------------------------------------------------------------------------------------


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
    if not is_flat(element):
        kind = type(element.profile).__name__
        raise ValueError(f"a profile of {kind} has no features to be fabricated; use as_rings or as_pixels first")
    heights = fabricated_height(element.numbers, element.period, element.levels)
    return dataclasses.replace(element.with_numbers(heights), period=None, levels=0)


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
