"""Element: a thin phase element, its height over the aperture.

    path(x, y, λ) = (n(λ) - 1) h(x, y)

beside air. Thicker is later: a converging element is thickest on its axis.

Free heights are pixels or rings, flat each; smooth ones Zernike polynomials or even powers of the radius. Elements in
contact add their paths.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths.numerics import safe_sqrt
from raytrace.maths.value import value
from raytrace.maths.zernike import noll, polynomials
from raytrace.media.glass import Glass, index


@value
class Pixels:
    """Heights (rows, columns) mm of square pixels of `pitch` mm around the axis; row 0 lies at the smallest y."""

    heights: Tensor
    pitch: Tensor


@value
class Rings:
    """Heights (R,) mm of rings: ring k from radius k·pitch to (k + 1)·pitch mm."""

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


@value
class Element:
    """A profile in a round aperture.

    radius: of the aperture, mm; glass: its material (`glass.constant(2.0)` makes a path of the same mm at every
    wavelength). period: height in mm that is as good as none at the design wavelength, λ₀/(n₀ - 1): the height is taken
    modulo it, None leaves it whole. levels: how many equal steps of a period can be made, 0 for any height; gradients
    pass the steps as if they were not there.
    """

    profile: Profile
    radius: Tensor
    glass: Glass
    period: Tensor | None = None
    levels: int = 0


def is_radial(element: Element) -> bool:
    """Whether the height depends on the distance from the axis alone, by the kind of its profile."""
    return isinstance(element.profile, Rings | EvenPowers)


def height(element: Element, x: Tensor, y: Tensor) -> Tensor:
    """h (...) mm at points (...) mm, as it can be made; beyond the outermost pixel or ring, that of its neighbour."""
    return fabricated(profile_height(element.profile, x, y, radius=element.radius), element.period, element.levels)


def profile_height(profile: Profile, x: Tensor, y: Tensor, *, radius: Tensor) -> Tensor:
    """h (...) mm before it is wrapped or stepped. radius: of the aperture, mm."""
    match profile:
        case Pixels(heights, pitch):
            return heights[_place(y, pitch, heights.shape[0]), _place(x, pitch, heights.shape[1])]
        case Rings(heights, pitch):
            r = safe_sqrt((x * x + y * y).detach())
            return heights[(r / pitch.detach()).long().clamp(max=len(heights) - 1)]
        case Zernike(coefficients):
            orders = [noll(j) for j in range(1, len(coefficients) + 1)]
            return torch.tensordot(coefficients, polynomials(orders, x / radius, y / radius), 1)
        case EvenPowers(coefficients):
            r2, total = x * x + y * y, torch.zeros_like(x)
            for c in coefficients.flip(0):
                total = (total + c) * r2
            return total


def fabricated(height: Tensor, period: Tensor | None, levels: int = 0) -> Tensor:
    """Heights modulo a period, and lowered to the step below: floor(h/H·L)·H/L. The gradient is that of the height."""
    if period is None:
        return height
    # A height at a step to rounding is that step: sixteen levels read from a file stay as they are.
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


def path(elements: Sequence[Element], x: Tensor, y: Tensor, wavelengths: Tensor) -> Tensor:
    """Optical path (W, ...) mm that elements in contact add at points (...) mm, at wavelengths (W,) µm."""
    total = torch.zeros(len(wavelengths), *x.shape, dtype=x.dtype, device=x.device)
    for element in elements:
        excess = index(element.glass, wavelengths).to(x) - 1
        total = total + excess.reshape(-1, *[1] * x.ndim) * height(element, x, y)
    return total


def _place(position: Tensor, pitch: Tensor, count: int) -> Tensor:
    return torch.floor((position / pitch).detach() + 0.5 * count).long().clamp(0, count - 1)
