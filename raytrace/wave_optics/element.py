"""Thin phase elements, given by their height over the aperture, as designed and as fabricated.

    path(x, y, λ) = (n(λ) - 1) h(x, y)

relative to air. A thicker part delays light: a converging element is thickest on its axis.

Free heights are pixels or rings (a rotationally symmetric height profile), flat each; smooth ones Zernike polynomials
or even powers of the radius; KINDS has a row for each. Elements in contact add their paths. Everything is
differentiable.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, TypeGuard

import torch
from torch import Tensor

from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import Glass, constant, index
from raytrace.maths.numerics import safe_sqrt, value
from raytrace.maths.zernike import noll, polynomials
from raytrace.words import option, with_article

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


#: Profiles of features of one pitch, flat each.
Flat = Pixels | Rings
Profile = Flat | Zernike | EvenPowers


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
    height: Callable[[Any, Tensor, Tensor, Tensor], Tensor]
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

    def __repr__(self) -> str:
        count, across = " × ".join(map(str, self.numbers.shape)), 2 * float(self.radius.detach())
        if has_features(self.profile):
            words = f"{count} {self.kind.words} of {1e3 * float(self.profile.pitch.detach()):g} µm"
        else:
            words = f"{self.kind.words}, {count} coefficients"
        if self.period is not None:
            steps = f" in {self.levels} steps" if self.levels else ""
            words += f", wrapped at {1e3 * float(self.period.detach()):.4g} µm{steps}"
        return f"<Element: {words}, of {self.glass.name or 'constant index'}, ⌀ {across:g} mm>"

    @property
    def kind(self) -> Kind:
        return KINDS[type(self.profile)]

    @property
    def numbers(self) -> Tensor:
        """Heights or coefficients."""
        return getattr(self.profile, self.kind.numbers)

    def with_numbers(self, numbers: Tensor) -> "Element":
        """The element with other heights or coefficients."""
        change: dict[str, Any] = {self.kind.numbers: numbers}
        return dataclasses.replace(self, profile=dataclasses.replace(self.profile, **change))


#: Profiles of `element` by name: the value, the number of axes of its numbers.
PROFILES = {"pixels": (Pixels, 2), "rings": (Rings, 1), "zernike": (Zernike, 1), "powers": (EvenPowers, 1)}


def phase_element(
    numbers: Tensor | Sequence[float],
    *,
    aperture: float,
    glass: str | Glass | float,
    profile: Literal["pixels", "rings", "zernike", "powers"] = "pixels",
    pitch: float | None = None,
    design_wavelength: float | None = None,
    levels: int = 0,
) -> Element:
    """A phase element of heights or coefficients in memory, in which its PSFs are differentiable.

    It adds the path (n(λ) - 1) h relative to air: a converging element is thickest on its axis.

    numbers: a tensor or an array, by the profile: "pixels" (rows, columns) mm, heights of flat squares of `pitch` mm
        around the axis, row 0 at the smallest y, column 0 at the smallest x; "rings" (R,) mm, of flat rings of `pitch`
        mm from the axis outwards; "zernike" (J,) mm RMS, Noll's from j = 1 (piston) on over the aperture, where
        j = 2 is tilt along x; "powers" (K,) mm^(1 - 2k), of r², r⁴, …
    aperture: diameter, mm. glass: a name, a Glass, or one index for all wavelengths. design_wavelength: µm, at which
        the heights are wrapped, modulo one wave, in so many equal `levels` (0: any height); without it they are whole.
    Raises ValueError for numbers of another shape or not finite, for heights that do not fill the aperture, and for
    levels without a design wavelength; UnknownGlass.
    """
    if profile not in PROFILES:
        raise ValueError(f"profile {profile!r} is not known; expected one of {', '.join(PROFILES)}")
    kind, axes = PROFILES[profile]
    numbers = torch.as_tensor(numbers)
    numbers = numbers if numbers.is_floating_point() else numbers.to(torch.float64)
    if numbers.dim() != axes or not numbers.numel():
        shapes = {"pixels": "(rows, columns)", "rings": "(R,)", "zernike": "(J,)", "powers": "(K,)"}
        raise ValueError(
            f"{profile} of the shape {tuple(numbers.shape)}; expected {shapes[profile]}; "
            f"`profile` is one of {', '.join(PROFILES)}"
        )
    if wrong := int((~torch.isfinite(numbers.detach())).sum()):
        raise ValueError(f"{wrong} of {numbers.numel()} numbers of the element are not finite; replace them first")
    if not aperture > 0:
        raise ValueError(f"aperture {aperture:g} mm; expected a positive diameter")
    if KINDS[kind].is_flat != (pitch is not None):
        needs = f"needs {option('pitch')}, mm" if pitch is None else f"is smooth and has no {option('pitch')}"
        raise ValueError(f"a profile of {profile} {needs}")
    if pitch is not None and not pitch > 0:
        raise ValueError(f"pitch {pitch:g} mm; expected a positive number")
    if levels and not design_wavelength:
        raise ValueError(f"{option('levels')} are steps of one wave's height; give {option('design_wavelength')}, µm")
    if isinstance(glass, str):
        glass = find_glass(glass)
    elif not isinstance(glass, Glass):
        glass = constant(float(glass))
    shape = kind(numbers, *([] if pitch is None else [torch.as_tensor(pitch).to(numbers)]))
    check_fills(shape, aperture)
    wave = period(glass, design_wavelength).to(numbers) if design_wavelength else None
    return Element(shape, torch.as_tensor(0.5 * aperture).to(numbers), glass, wave, levels)


def check_fills(profile: Profile, aperture: float, place: str = "") -> None:
    """Raise ValueError for heights that do not fill an aperture of so many mm, but for one feature at the rim."""
    if not has_features(profile):
        return
    counts = (2 * len(profile.heights),) if isinstance(profile, Rings) else profile.heights.shape
    across = min(counts) * float(profile.pitch)
    if across + 2 * float(profile.pitch) < aperture:
        raise ValueError(
            f"{place}the heights are {across:.6g} mm across, less than the aperture of {aperture:g} mm; "
            f"give {option('aperture', f'{across:.6g}')}"
        )


def in_contact(elements: Element | Sequence[Element]) -> tuple[Element, ...]:
    """One element or several as a tuple. Raises TypeError for other values."""
    parts = (elements,) if isinstance(elements, Element) else tuple(elements)
    if any(not isinstance(part, Element) for part in parts):
        wrong = next(part for part in parts if not isinstance(part, Element))
        kind = with_article(type(wrong if isinstance(elements, tuple | list) else elements).__name__)
        raise TypeError(
            f"{kind} is no phase element; expected an Element or several: rt.wave_optics.phase_elements(name or file) "
            "or, of an array of heights, rt.wave_optics.phase_element(heights, pitch=…, aperture=…, glass=…)"
        )
    return parts


def is_radial(element: Element) -> bool:
    """Whether the height depends on the distance from the axis alone."""
    return element.kind.is_radial


def has_features(profile: Profile) -> TypeGuard[Flat]:
    """Whether a profile has features of one pitch, flat each."""
    return KINDS[type(profile)].is_flat


def is_flat(element: Element) -> bool:
    """Whether the height has features, flat each."""
    return has_features(element.profile)


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
