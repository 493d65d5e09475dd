"""Environment: refractive indices at a temperature and a pressure, as in OpticStudio.

Indices and wavelengths refer to air: those of a lens to air at its temperature T and pressure P, those of a catalog to
air at its reference temperature T0 and 1 atm. From a wavelength λ of the lens to the index n relative to its air:

    λ0 = λ a(T, P)/a(T0, 1),   a = n of air relative to vacuum, at λ
    n0 = f(λ0)                 the catalog's formula
    N = n0 a(T0, 1) + Δn       relative to vacuum; Δn by the coefficients of the catalog, at λ0
    n = N/a(T, P)

This assignment of λ and λ0 reproduces a value that OpticStudio stored for a doublet at 100 °C to 2e-13 mm; any other
misses it by 3e-9 mm or more. A constant index, a model glass (nd, Vd) and a six-digit code have no reference
temperature: they keep their index relative to the surrounding air. Radii and thicknesses are not expanded here.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.materials.glass import FORMULAS, WITH_ERRORS, Glass, is_air, refractive_index
from raytrace.maths.numerics import safe_divide, value
from raytrace.maths.tangents import tangents_of, with_tangents
from raytrace.words import RaytraceWarning, option

#: Default temperature in °C and pressure in atm of a catalog, and of a lens that specifies only one of them.
REFERENCE = (20.0, 1.0)

#: °C: the formula of air has a pole at -272.5; above HOTTEST a glass is a melt.
COLDEST, HOTTEST = -272.0, 1000.0

#: °C: the range to which thermal coefficients of catalogs are fitted (SCHOTT TIE-19).
FITTED = -100.0, 140.0


class NoThermalCoefficients(RaytraceWarning):
    """A glass is used at another temperature than its catalog's without thermal coefficients, or beyond their range."""


@value
class Environment:
    """The air in and around a lens: temperature in °C and pressure in atm, 0 in vacuum."""

    temperature: Tensor
    pressure: Tensor


class Thermal(NamedTuple):
    """Thermal coefficients of a glass (SCHOTT TIE-19) in 1/K, 1/K², 1/K³, µm²/K, µm²/K², the wavelength λ_TK in µm,
    and the reference temperature in °C."""

    D0: float
    D1: float
    D2: float
    E0: float
    E1: float
    resonance: float
    reference: float

    @property
    def is_known(self) -> bool:
        """Whether there are coefficients: catalogs write zeros for unknown ones."""
        return any(self[:5])


def thermal(glass: Glass) -> Thermal:
    """The thermal coefficients that a catalog lists for a glass (TD), zeros at 20 °C if it lists none."""
    listed = dict(glass.records).get("TD", ())
    return Thermal(*listed[:7], *(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, REFERENCE[0])[len(listed) :])


def is_model(glass: Glass) -> bool:
    """Whether a medium is a constant index, a model glass or a six-digit code, without a catalog's formula."""
    formula = glass.formula.removesuffix(WITH_ERRORS)
    return formula in FORMULAS and FORMULAS[formula].number is None


def air_index(wavelength: Tensor, temperature: Tensor | float, pressure: Tensor | float) -> Tensor:
    """n of air relative to vacuum at wavelengths (...) µm, temperature in °C and pressure in atm, in float64.

        n - 1 = (n_15 - 1) P/(1 + 3.4785e-3 (T - 15)),
        (n_15 - 1) 10⁸ = 6432.8 + 2949810 λ²/(146 λ² - 1) + 25540 λ²/(41 λ² - 1)

    F. Kohlrausch, Praktische Physik 1, 408 (1968), with the dispersion of B. Edlén, J. Opt. Soc. Am. 43, 339 (1953).
    """
    square = wavelength.double() ** 2
    dispersed = safe_divide(2949810.0 * square, 146.0 * square - 1.0) + safe_divide(
        25540.0 * square, 41.0 * square - 1.0
    )
    return 1.0 + 1e-8 * (6432.8 + dispersed) * pressure / (1.0 + 3.4785e-3 * (temperature - 15.0))


def index_change(glass: Glass, wavelength: Tensor, temperature: Tensor, index: Tensor) -> Tensor:
    """Δn relative to vacuum from the catalog's reference temperature T0 to T, of an index n at T0:

        Δn = (n² - 1)/(2n) (D0 ΔT + D1 ΔT² + D2 ΔT³ + (E0 ΔT + E1 ΔT²)/(λ² - S λ_TK²)),   S = sign(λ_TK)

    SCHOTT TIE-19, with n relative to air; a negative λ_TK, which a few catalogs list, is a resonance below 0.
    """
    D0, D1, D2, E0, E1, resonance, reference = thermal(glass)
    warmer = temperature - reference
    resonant = safe_divide(warmer * (E0 + E1 * warmer), wavelength * wavelength - resonance * abs(resonance))
    return 0.5 * (index - 1.0 / index) * (warmer * (D0 + warmer * (D1 + warmer * D2)) + resonant)


def index_in(glass: Glass, wavelength: Tensor, air: Environment, local: Environment | None = None) -> Tensor:
    """n (...) of a medium relative to the air of a lens, for wavelengths (...) µm in that air; 0 where undefined.

    local: the medium's environment if it is not that of the lens: another temperature of the glass, or of the air in a
    gap. Differentiable in temperature and pressure. Without checks, as `refractive_index`.
    """
    exact = wavelength.double()
    place = _like(air if local is None else local, exact)
    around = air_index(exact, *_like(air, exact))
    if is_model(glass):
        n = refractive_index(glass, exact)
        return (n if local is None else n * (air_index(exact, *place) / around)).to(wavelength.dtype)
    of_catalog = air_index(exact, thermal(glass).reference, REFERENCE[1])
    length = exact * around / of_catalog
    n = refractive_index(glass, length)
    exists = n > 0
    n = torch.where(exists, n, 1.0)
    absolute = n * of_catalog + index_change(glass, length, place[0], n)
    return torch.where(exists, absolute / around, 0.0).to(wavelength.dtype)


def _like(place: Environment, like: Tensor) -> tuple[Tensor, Tensor]:
    return place.temperature.to(like), place.pressure.to(like)


def dn_dt(glass: Glass, wavelength: Tensor, air: Environment) -> tuple[Tensor, Tensor]:
    """dn/dT (...) in 1/K at wavelengths (...) µm: relative to air at the glass's temperature, and to vacuum.

    The vacuum wavelength of a line is constant; its wavelength in air changes with the temperature.
    """
    exact = wavelength.double()
    temperature, pressure = _like(air, exact)
    in_vacuum = exact * air_index(exact, temperature, pressure)

    with torch.enable_grad():
        temperature = with_tangents(temperature, torch.ones_like(temperature)[None])
        around = air_index(exact, temperature, pressure)
        n = index_in(glass, in_vacuum / around, Environment(temperature, pressure))
    return tangents_of(n, 1)[0], tangents_of(n * around, 1)[0]


def objection(place: Environment) -> str:
    """The error of a temperature or a pressure out of range, else ""."""
    temperature, pressure = _numbers(place)
    if not COLDEST < temperature <= HOTTEST:
        limit = f"above {COLDEST:g}" if temperature <= COLDEST else f"up to {HOTTEST:g}"
        fitted = "thermal coefficients of catalogs hold from {:g} to {:g}".format(*FITTED)
        return f"{option('temperature', f'{temperature:g}')}: expected degrees Celsius {limit}; {fitted}"
    if not 0 <= pressure < torch.inf:
        return f"{option('pressure', f'{pressure:g}')}: expected atmospheres, 0 (vacuum) or more"
    return ""


def in_words(place: Environment) -> str:
    """An environment as text."""
    return "{:g} °C and {:g} atm".format(*_numbers(place))


def _numbers(place: Environment) -> tuple[float, float]:
    return float(place.temperature.detach()), float(place.pressure.detach())


def unknown_change(glass: Glass, place: Environment) -> str:
    """A warning if the index of a glass in an environment is not known, else ""; "" for air and mirrors."""
    if glass.formula == "mirror" or is_air(glass):
        return ""
    temperature, pressure = _numbers(place)
    name = glass.name or f"the medium of index {float(refractive_index(glass, torch.tensor(0.5875618))):.6g}"
    if is_model(glass) and (temperature, pressure) != REFERENCE:
        return f"{name} is not of a catalog: its index is kept, relative to air of {in_words(place)}"
    if not is_model(glass) and not thermal(glass).is_known and temperature != thermal(glass).reference:
        source = f"{name} ({glass.catalog})" if glass.catalog else name
        return (
            f"{source} has no thermal coefficients: at {temperature:g} °C it keeps its index relative to vacuum of "
            f"{thermal(glass).reference:g} °C"
        )
    if not is_model(glass) and not FITTED[0] <= temperature <= FITTED[1]:
        hold = "hold from {:g} to {:g} °C".format(*FITTED)
        return f"the thermal coefficients of {name} are extrapolated to {temperature:g} °C; those of catalogs {hold}"
    return ""
