"""Baselines: the elements that a learned one has to beat, all for the same camera.

`BASELINES` lists them by name; each takes an `Aim` (and its own options) and gives the elements in contact. Smooth ones
are of PMMA, diamond-turned in features of 3.69 µm; diffractive ones of fused silica, etched in rings of 2 µm and
wrapped at the design wavelength. A wrapped lens of power φ has the power φ λ/λ₀, a smooth one φ (n(λ) - 1)/(n₀ - 1).
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.maths.numerics import polynomial
from raytrace.maths.zernike import noll, norm
from raytrace.media.catalog import find_glass
from raytrace.media.glass import Glass, constant, index
from raytrace.wave.achromat import achromat
from raytrace.wave.aim import Aim, converging
from raytrace.wave.element import Element, EvenPowers, Rings, Zernike
from raytrace.wave.fabrication import ETCHED, TURNED, as_rings, features, wrapped

#: Object distances of the multifocal lens, mm: 2, 1.5, 1, 0.5 and 0 dioptres.
FOCI = (500.0, 2000 / 3, 1000.0, 2000.0, math.inf)


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
    """The same of PMMA, not wrapped: a smooth lens for the focus of the aim, and in rings what the annuli differ by.

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

    The lens bears what true spheres need beyond parabolas. Stone and George, Appl. Opt. 27, 2960 (1988).
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


#: Name -> (aim, options of its own) -> elements in contact.
BASELINES: dict[str, Callable[..., tuple[Element, ...]]] = {
    "ideal": ideal,
    "singlet": singlet,
    "fresnel": fresnel,
    "multifocal": multifocal,
    "multifocal-refractive": multifocal_refractive,
    "cubic": cubic,
    "cubic-refractive": cubic_refractive,
    "achromat": achromat,
    "hybrid": hybrid,
}


def baseline(name: str, aim: Aim, **options) -> tuple[Element, ...]:
    """The baseline of a name. Raises ValueError for a name that is none, TypeError for an option it does not have."""
    if name not in BASELINES:
        raise ValueError(f"no baseline is called {name!r}; expected one of {', '.join(BASELINES)}")
    return BASELINES[name](aim, **options)


def _lens(aim: Aim, glass: Glass) -> Element:
    return _smooth(aim, glass, converging(aim))


def _smooth(aim: Aim, glass: Glass, path: Tensor) -> Element:
    """The element whose path at the design wavelength is Σ_k path_k r^(2k)."""
    return Element(EvenPowers(path / (index(glass, aim.wavelength) - 1)), aim.radius, glass)


def _annuli(aim: Aim, foci: Sequence[float], glass: Glass, *, pitch: float, less: Tensor | None) -> Rings:
    """Rings of which annulus k of equal area is a lens for foci[k]; `less`: the focus of a lens to be left out."""
    wide = torch.tensor(pitch, dtype=torch.float64).to(aim.radius)
    r2 = ((torch.arange(features(aim.radius, wide)).to(wide) + 0.5) * wide) ** 2
    annulus = (len(foci) * r2 / aim.radius.detach() ** 2).long().clamp(max=len(foci) - 1)
    paths = [_path(aim, torch.tensor(focus, dtype=torch.float64), r2) for focus in foci]
    path = torch.stack(paths).gather(0, annulus[None])[0]
    if less is not None:
        path = path - _path(aim, less, r2)
    return Rings(path / (index(glass, aim.wavelength) - 1), wide)


def _path(aim: Aim, focus: Tensor, r2: Tensor) -> Tensor:
    return polynomial(converging(aim, focus), r2) * r2


def _cubic_plate(aim: Aim, glass: Glass, strength: float) -> Element:
    """strength · λ₀ (x³ + y³)/R³ as Zernike polynomials: with N the norms,

    x³ + y³ = ½ (Z_11 + Z_1-1)/N_1 + ¼ (Z_31 + Z_3-1 + Z_33 - Z_3-3)/N_3
    """
    shares = {(1, 1): 0.5, (1, -1): 0.5, (3, 1): 0.25, (3, -1): 0.25, (3, 3): 0.25, (3, -3): -0.25}
    orders = [noll(j) for j in range(1, 11)]
    numbers = [shares.get(order, 0.0) / norm(*order) for order in orders]
    scale = strength * 1e-3 * aim.wavelength / (index(glass, aim.wavelength) - 1)
    return Element(Zernike(scale * torch.tensor(numbers, dtype=torch.float64).to(scale)), aim.radius, glass)
