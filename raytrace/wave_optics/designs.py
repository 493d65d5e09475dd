"""Designs: named elements for the same camera, to which a learned element is compared.

`BASELINES` lists them by name; each takes an `Aim` and options and gives the elements in contact. Smooth ones are of
PMMA, diamond-turned in features of 3.69 µm; diffractive ones of fused silica, etched in rings of 2 µm and wrapped at
the design wavelength. A wrapped lens of power φ has the power φ λ/λ₀, a smooth one φ (n(λ) - 1)/(n₀ - 1).
"""

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import Glass, constant, index
from raytrace.maths.numerics import polynomial, value
from raytrace.maths.zernike import noll, norm
from raytrace.wave_optics.element import ETCHED, TURNED, Element, EvenPowers, Rings, Zernike, fabricated_height, period
from raytrace.wave_optics.fabrication import as_rings, features, wrapped

#: The steepest sphere, (R/z)², whose series is summed.
_STEEPEST = 0.8
#: Object distances of the multifocal lens, mm: 2, 1.5, 1, 0.5 and 0 dioptres.
FOCI = (500.0, 2000 / 3, 1000.0, 2000.0, math.inf)

#: (Element) -> share (W,) of the light of its aperture that reaches a circle on the sensor.
Encircled = Callable[[Element], Tensor]


@value
class Aim:
    """Design conditions of an element: object and image point on the axis, aperture and wavelength.

    radius: of the aperture, mm; sensor, focus: distances of the sensor and of the point, mm (focus may be infinite);
    wavelength: of the design, µm. exact: true spheres instead of their parabolas.
    """

    radius: Tensor
    sensor: Tensor
    focus: Tensor
    wavelength: Tensor
    exact: bool = False


def aim(
    *,
    radius: float | Tensor = 2.5,
    sensor: float | Tensor = 35.5,
    focus: float | Tensor = 1000.0,
    wavelength: float | Tensor = 0.55,
    exact: bool = False,
) -> Aim:
    """The Aim of these numbers, by default f/7.1 at 1 m. Raises ValueError for numbers not positive and finite."""
    numbers = {"radius": radius, "sensor": sensor, "focus": focus, "wavelength": wavelength}
    for name, number in numbers.items():
        if not number > 0 or (name != "focus" and not number < math.inf):
            unit = "µm" if name == "wavelength" else "mm"
            raise ValueError(f"the {name} is {float(number):g} {unit}; expected a positive number")
    tensors = [n if isinstance(n, Tensor) else torch.tensor(n, dtype=torch.float64) for n in numbers.values()]
    return Aim(tensors[0], tensors[1], tensors[2], tensors[3], exact)


def converging(aim: Aim, focus: Tensor | None = None) -> Tensor:
    """Coefficients c_k (K,) mm^(1 - 2k) of the path Σ_k c_k r^(2k) that brings a point at `focus` mm to the sensor.

        -(1/z_f + 1/z_s) r²/2,   exact: -Σ_z (√(r² + z²) - z) = -Σ_z Σ_k (½ choose k) r^(2k)/z^(2k - 1)

    The series ends where its terms at the rim fall below 1e-13 z. focus: that of the aim by default.
    Raises ValueError where a true sphere is steeper than its series can follow.
    """
    vergences = 1 / torch.stack([aim.focus if focus is None else focus.to(aim.sensor), aim.sensor])
    if not aim.exact:
        return -0.5 * vergences.sum(0, keepdim=True)
    steepness = float((aim.radius * vergences.max()).detach()) ** 2
    if steepness > _STEEPEST:
        nearest = float(1 / vergences.detach().max())
        raise ValueError(
            f"a sphere around a point {nearest:g} mm away is too steep over an aperture of {float(aim.radius):g} mm: "
            f"expected at least {1 / math.sqrt(_STEEPEST):.2f} radii, or the paraxial form (exact=False)"
        )
    terms = max(2, math.ceil(math.log(1e-13) / math.log(steepness)))
    k = torch.arange(1, terms + 1).to(vergences)
    binomial = torch.cumprod((1.5 - k) / k, 0)
    return -(binomial * vergences[:, None] ** (2 * k - 1)).sum(0)


def ideal(aim: Aim) -> tuple[Element, ...]:
    """A lens without dispersion: the same path at every wavelength."""
    return (_lens(aim, constant(2.0)),)


def singlet(aim: Aim) -> tuple[Element, ...]:
    """A smooth PMMA lens; its focal length is f₀ (n₀ - 1)/(n - 1)."""
    return (_lens(aim, find_glass("PMMA")),)


def fresnel(aim: Aim, *, levels: int = 0, pitch: float = ETCHED) -> tuple[Element, ...]:
    """A kinoform of fused silica, in `levels` steps (0: any height); its focal length is f₀ λ₀/λ."""
    lens = _lens(aim, find_glass("F_SILICA"))
    return (as_rings(wrapped(lens, aim.wavelength, levels=levels), pitch),)


def multifocal(
    aim: Aim, *, foci: Sequence[float] = FOCI, levels: int = 0, pitch: float = ETCHED
) -> tuple[Element, ...]:
    """A kinoform of as many annuli of equal area as `foci` (mm), from the axis outwards, each for one of them."""
    glass = find_glass("F_SILICA")
    element = Element(_annuli(aim, foci, glass, pitch=pitch, less=None), aim.radius, glass)
    return (wrapped(element, aim.wavelength, levels=levels),)


def multifocal_refractive(aim: Aim, *, foci: Sequence[float] = FOCI, pitch: float = TURNED) -> tuple[Element, ...]:
    """The same of PMMA, not wrapped: a smooth lens for the focus of the aim, and in rings the difference of the annuli.

    The whole in rings would lose light: 3.69 µm rings of an f/7 lens are half a wave of slope at the rim.
    """
    glass = find_glass("PMMA")
    rings = _annuli(aim, foci, glass, pitch=pitch, less=aim.focus)
    return _lens(aim, glass), Element(rings, aim.radius, glass)


def cubic(aim: Aim, *, strength: float = 20.0, levels: int = 0, pitch: float = ETCHED) -> tuple[Element, ...]:
    """The kinoform with a cubic phase plate of fused silica: a path of strength · λ₀ (x³ + y³)/R³.

    Dowski and Cathey, Appl. Opt. 34, 1859 (1995).
    """
    return *fresnel(aim, levels=levels, pitch=pitch), _cubic_plate(aim, find_glass("F_SILICA"), strength)


def cubic_refractive(aim: Aim, *, strength: float = 20.0) -> tuple[Element, ...]:
    """The PMMA lens with a cubic phase plate of PMMA."""
    return *singlet(aim), _cubic_plate(aim, find_glass("PMMA"), strength)


def hybrid(
    aim: Aim, *, ends: tuple[float, float] = (0.46, 0.64), levels: int = 0, pitch: float = ETCHED
) -> tuple[Element, ...]:
    """A smooth PMMA lens and a kinoform in contact, of the same power at the wavelengths `ends` (µm):

        φ_r + φ_d = φ,   φ_r/V_r + φ_d/V_d = 0,   V_r = (n₀ - 1)/(n₁ - n₂),   V_d = λ₀/(λ₁ - λ₂)

    The lens has the terms of true spheres beyond parabolas. Stone and George, Appl. Opt. 27, 2960 (1988).
    """
    smooth, etched = find_glass("PMMA"), find_glass("F_SILICA")
    first, last = torch.tensor(ends, dtype=torch.float64).to(aim.wavelength)
    v_smooth = (index(smooth, aim.wavelength) - 1) / (index(smooth, first) - index(smooth, last))
    v_etched = aim.wavelength / (first - last)
    path = converging(aim)
    diffracted = path[:1] * v_etched / (v_etched - v_smooth)
    refracted = torch.cat([path[:1] - diffracted, path[1:]])
    kinoform = wrapped(_smooth(aim, etched, diffracted), aim.wavelength, levels=levels)
    return _smooth(aim, smooth, refracted), as_rings(kinoform, pitch)


def achromat(
    aim: Aim,
    *,
    wavelengths: tuple[float, ...] = (0.46, 0.55, 0.64),
    spot: float = 0.015,
    pitch: float = ETCHED,
    levels: int = 0,
    iterations: int = 400,
    rate: float = 0.1,
    encircled: Encircled | None = None,
) -> tuple[Element, ...]:
    """The diffractive achromat: rings of fused silica, heights within one wave, that maximise Σ_λ log E_λ(spot).

    After Peng, Fu, Heide and Heidrich, ACM Trans. Graph. 35, 31 (2016), with a gradient ascent of the product of
    encircled energies instead of their greedy search for equal spectra. Starts from the rings whose phases agree best
    with the lenses of all wavelengths; the same numbers give the same rings.

    wavelengths: µm; spot: radius of the circle, mm; pitch: of the rings, mm; rate: of Adam, on the logit of the height;
    encircled: the engine that gives E, by default `encircled_energy`.
    """
    glass = find_glass("F_SILICA")
    colours = torch.tensor(wavelengths, dtype=torch.float64, device=aim.radius.device)
    energy = encircled or encircled_energy(aim, colours, spot=spot, pitch=pitch)
    top = period(glass, aim.wavelength.detach().double())
    wide = torch.tensor(pitch, dtype=torch.float64, device=colours.device)
    radius = aim.radius.detach().double()

    # Of 200 heights up to `top`, those whose phases agree best, by Σ cos, with the lenses of all wavelengths.
    r2 = _middles(radius, wide) ** 2
    lens = polynomial(converging(aim).detach().double(), r2) * r2
    levelled = torch.linspace(0, 1, 200).to(radius) * top
    wanted = 2 * math.pi / (1e-3 * colours)[:, None, None] * lens[:, None]
    agreement = torch.cos(_phase(glass, colours)[..., None] * levelled - wanted).sum(0)
    start = levelled[agreement.argmax(-1)] / top
    with torch.enable_grad():
        free = torch.logit(start.clamp(0.02, 0.98)).requires_grad_()
        optimizer = torch.optim.Adam([free], rate)
        for _ in range(iterations):
            optimizer.zero_grad()
            rings = Rings(top * torch.sigmoid(free), wide)
            (-torch.log(energy(Element(rings, radius, glass))).sum()).backward()
            optimizer.step()
    heights = (top * torch.sigmoid(free.detach())).to(aim.radius)
    return (Element(Rings(heights, wide.to(aim.radius)), aim.radius, glass, top.to(aim.radius), levels),)


def encircled_energy(aim: Aim, wavelengths: Tensor, *, spot: float, pitch: float, inner: int = 32) -> Encircled:
    """The share of light within `spot` mm of the axis, behind an element of rings of `pitch` mm, for a point at focus.

        U(ρ) = (2π/λz) Σ_rings e^(ik (n - 1) h) ∫ e^(ik e(r)) J0(2πρr/λz) r dr,   E = ∫ |U|² 2πρ dρ / πR²

    with e(r) the path from the point and to the sensor, constant in each of `inner` parts of a ring. These integrals do
    not depend on the heights: E is a sum of squares of linear forms, by a Gauss rule of 32 radii ρ. Parabolic
    approximation. wavelengths: (W,) µm.
    """
    wavelengths, radius = wavelengths.double(), aim.radius.detach().double()
    count = features(radius, torch.tensor(pitch, dtype=torch.float64))
    edges = (torch.arange(count * inner + 1).to(radius) * (pitch / inner)).clamp(max=radius)
    middle = 0.5 * (edges[1:] ** 2 + edges[:-1] ** 2)
    excess = -polynomial(converging(aim).detach().double(), middle) * middle
    points, weights = (torch.from_numpy(part).to(radius) for part in np.polynomial.legendre.leggauss(32))
    rho, weights = 0.5 * spot * (points + 1), 0.5 * spot * weights
    forms = []
    for wavelength in 1e-3 * wavelengths:
        rate = 2 * math.pi * rho[:, None] / (wavelength * aim.sensor.detach().double())
        # Independent of all variables, so that torch's bessel_j1, which has no derivative, is enough.
        rings = torch.diff(edges * torch.special.bessel_j1(rate * edges) / rate, dim=1)
        phased = rings * torch.polar(torch.ones_like(excess), 2 * math.pi / wavelength * excess)
        scale = rate * torch.sqrt(2 * weights / rho)[:, None] / radius
        forms.append(scale * phased.reshape(len(rho), count, inner).sum(-1))
    stacked = torch.stack(forms)

    def energy(element: Element) -> Tensor:
        heights = fabricated_height(element.numbers, element.period, element.levels).double()
        phase = _phase(element.glass, wavelengths) * heights
        field = (stacked @ torch.polar(torch.ones_like(phase), phase)[..., None])[..., 0]
        return (field.real**2 + field.imag**2).sum(-1)

    return energy


def _phase(glass: Glass, wavelengths: Tensor) -> Tensor:
    """Phase (W, 1) that 1 mm of glass adds, radians."""
    return (2 * math.pi / (1e-3 * wavelengths) * (index(glass, wavelengths) - 1))[:, None]


_DESIGNS = ideal, singlet, fresnel, multifocal, multifocal_refractive, cubic, cubic_refractive, achromat, hybrid
#: Name -> (aim, options) -> elements in contact.
BASELINES: dict[str, Callable[..., tuple[Element, ...]]] = {f.__name__.replace("_", "-"): f for f in _DESIGNS}

#: Designs that can have steps of a wave.
STEPPED = tuple(name for name, design in BASELINES.items() if "levels" in inspect.signature(design).parameters)


def baseline(name: str, aim: Aim, **options: Any) -> tuple[Element, ...]:
    """The baseline of a name. Raises ValueError for an unknown name, TypeError for an unknown option."""
    if name not in BASELINES:
        raise ValueError(f"no baseline is called {name!r}; expected one of {', '.join(BASELINES)}")
    return BASELINES[name](aim, **options)


def _lens(aim: Aim, glass: Glass) -> Element:
    return _smooth(aim, glass, converging(aim))


def _smooth(aim: Aim, glass: Glass, path: Tensor) -> Element:
    """The element whose path at the design wavelength is Σ_k path_k r^(2k)."""
    return Element(EvenPowers(path / (index(glass, aim.wavelength) - 1)), aim.radius, glass)


def _annuli(aim: Aim, foci: Sequence[float], glass: Glass, *, pitch: float, less: Tensor | None) -> Rings:
    """Rings of which annulus k of equal area is a lens for foci[k]; `less`: the focus of a lens to subtract."""
    wide = torch.tensor(pitch, dtype=torch.float64).to(aim.radius)
    r2 = _middles(aim.radius, wide) ** 2
    annulus = (len(foci) * r2 / aim.radius.detach() ** 2).long().clamp(max=len(foci) - 1)

    def path_to(focus: Tensor) -> Tensor:
        return polynomial(converging(aim, focus), r2) * r2

    paths = torch.stack([path_to(torch.tensor(focus, dtype=torch.float64)) for focus in foci])
    path = paths.gather(0, annulus[None])[0]
    if less is not None:
        path = path - path_to(less)
    return Rings(path / (index(glass, aim.wavelength) - 1), wide)


def _middles(radius: Tensor, pitch: Tensor) -> Tensor:
    """Radii (R,) mm of the middles of the rings that cover an aperture."""
    return (torch.arange(features(radius, pitch)).to(pitch) + 0.5) * pitch


def _cubic_plate(aim: Aim, glass: Glass, strength: float) -> Element:
    # x³ + y³ = ½ (Z_11 + Z_1-1)/N_1 + ¼ (Z_31 + Z_3-1 + Z_33 - Z_3-3)/N_3, with N the norms.
    shares = {(1, 1): 0.5, (1, -1): 0.5, (3, 1): 0.25, (3, -1): 0.25, (3, 3): 0.25, (3, -3): -0.25}
    orders = [noll(j) for j in range(1, 11)]
    numbers = [shares.get(order, 0.0) / norm(*order) for order in orders]
    scale = strength * 1e-3 * aim.wavelength / (index(glass, aim.wavelength) - 1)
    return Element(Zernike(scale * torch.tensor(numbers, dtype=torch.float64).to(scale)), aim.radius, glass)
