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
from raytrace.maths.numerics import safe_sqrt, value
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
    places = ((p / profile.pitch, n) for p, n in zip((y, x), profile.heights.shape, strict=True))
    return profile.heights[*(torch.floor(p.detach() + 0.5 * n).long().clamp(0, n - 1) for p, n in places)]


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
