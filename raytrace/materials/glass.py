"""Glass: dispersion formulas, a row of FORMULAS each, media, and their refractive indices.

The formulas are the thirteen of the AGF glass catalog format, a constant index and the model glass of lens files.
`refractive_index` is for use inside `torch.func` and optimisation: where the formula has no real index (n² ≤ 0, a pole,
a wavelength that is no length) it returns 0 with gradient 0, never NaN. `check_wavelengths` raises `InvalidIndex` there
and warns `OutOfRange` outside the range that the coefficients were fitted to; `index` does both.

Wavelengths in µm, indices relative to air at the catalog's reference temperature and 1 atm (`environment.py`:
at others).
"""

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from raytrace.maths.numerics import is_wrapped, safe_divide, safe_sqrt, value
from raytrace.words import RaytraceError, RaytraceWarning, calling_level

# -- dispersion formulas -----------------------------------------------------------------------------------------------


def _gap(wavelength: Tensor, pole: Tensor | float) -> tuple[Tensor, Tensor]:
    """λ² - pole to the last digit, also next to the pole, and where it is 0; there the gap is 1 to divide safely.

    λ² is rounded by up to half a unit in the last place, which near a pole is most of the difference. The rounding
    error is recovered exactly (Dekker, Numer. Math. 18, 224 (1971)); it is a constant to every derivative.
    """
    square = wavelength * wavelength
    exact = wavelength.detach()
    split = 134217729.0 * exact  # 2²⁷ + 1: halves the 53 bits
    high = split - (split - exact)
    low = exact - high
    rounding = ((high * high - square.detach()) + 2.0 * high * low) + low * low
    gap = (square - pole) + rounding
    at_pole = gap == 0
    return torch.where(at_pole, 1.0, gap), at_pole


def _resonance(wavelength: Tensor, pole: Tensor) -> tuple[Tensor, Tensor]:
    """λ²/(λ² - pole), and where that is infinite (there it is λ²).

    Far above the pole it is evaluated as 1 + pole/(λ² - pole): its slope is then one term, where the quotient's is the
    difference of two that cancel (3,500 units in the last place at 1 mm in a glass).
    """
    square = wavelength * wavelength
    gap, at_pole = _gap(wavelength, pole)
    return torch.where(square > 2.0 * torch.abs(pole), 1.0 + pole / gap, square / gap), at_pole


def _sellmeier(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n² = 1 + Σ_i K_i λ²/(λ² - L_i); coefficients K_1, L_1, K_2, L_2, … (formulas Sellmeier 1, 3 and 5)."""
    strengths, poles = coefficients[0::2], coefficients[1::2]
    resonances, at_pole = _resonance(wavelength, poles)
    # Added one by one: a reduction may associate differently in batches of different shape.
    n_squared = sum((strengths * resonances).unbind(0), 1.0)
    impossible = (at_pole & (strengths != 0)).any(0)
    return safe_sqrt(torch.where(impossible, 0.0, n_squared))


def _laurent(rising: Sequence[int], falling: Sequence[int], coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n² = Σ_j a_rising[j] λ^(2j) + Σ_j a_falling[j] λ^(-2j-2): the power-series formulas, each by Horner's rule."""
    square = wavelength * wavelength
    upper = lower = torch.zeros_like(wavelength)
    for j in reversed(rising):
        upper = upper * square + coefficients[j]
    for j in reversed(falling):
        lower = (lower + coefficients[j]) / square
    return safe_sqrt(upper + lower)


def _herzberger(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n = A + B L + C L² + D λ² + E λ⁴ + F λ⁶ with L = 1/(λ² - 0.028)."""
    gap, at_pole = _gap(wavelength, 0.028)
    a, b, c, d, e, f = coefficients[:6].unbind(0)
    square = wavelength * wavelength
    n = a + (b + c / gap) / gap + square * (d + square * (e + square * f))
    return torch.where(at_pole, 0.0, n)


def _sellmeier_2(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n² = 1 + A + B1 λ²/(λ² - λ1²) + B2/(λ² - λ2²); coefficients A, B1, λ1, B2, λ2."""
    a, b1, pole1, b2, pole2 = coefficients[:5].unbind(0)
    resonance, at_pole1 = _resonance(wavelength, pole1 * pole1)
    gap, at_pole2 = _gap(wavelength, pole2 * pole2)
    impossible = (at_pole1 & (b1 != 0)) | (at_pole2 & (b2 != 0))
    return safe_sqrt(torch.where(impossible, 0.0, 1.0 + a + b1 * resonance + b2 / gap))


def _conrady(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n = n0 + A/λ + B/λ^3.5."""
    n0, a, b = coefficients[:3].unbind(0)
    return n0 + a / wavelength + b * wavelength**-3.5


def _handbook_1(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n² = A + B/(λ² - C) - D λ²."""
    a, b, c, d = coefficients[:4].unbind(0)
    gap, at_pole = _gap(wavelength, c)
    n_squared = a + b / gap - d * wavelength * wavelength
    return safe_sqrt(torch.where(at_pole & (b != 0), 0.0, n_squared))


def _handbook_2(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n² = A + B λ²/(λ² - C) - D λ²."""
    a, b, c, d = coefficients[:4].unbind(0)
    resonance, at_pole = _resonance(wavelength, c)
    n_squared = a + b * resonance - d * wavelength * wavelength
    return safe_sqrt(torch.where(at_pole & (b != 0), 0.0, n_squared))


def _sellmeier_4(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n² = A + B λ²/(λ² - C) + D λ²/(λ² - E)."""
    a, b, c, d, e = coefficients[:5].unbind(0)
    (first, at_pole1), (second, at_pole2) = _resonance(wavelength, c), _resonance(wavelength, e)
    impossible = (at_pole1 & (b != 0)) | (at_pole2 & (d != 0))
    return safe_sqrt(torch.where(impossible, 0.0, a + b * first + d * second))


def _constant(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n at every wavelength."""
    return torch.broadcast_tensors(coefficients[0], wavelength)[0]


#: The lines of the model-glass fit, µm, rounded as the programs that wrote the files round them.
MODEL_LINES = {"d": 0.5876, "F": 0.4861, "C": 0.6563, "g": 0.4358}
_D, _F, _C, _G = MODEL_LINES.values()


def _model(coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """A glass by n_d, V_d and ΔP_gF: n = A + B/λ + C/λ^3.5 (Conrady) through

        n(d) = n_d,  n(F) - n(C) = Δ = (n_d - 1)/V_d,  n(g) - n(F) = P_gF Δ,  P_gF = 0.6438 - 0.001682 V_d + ΔP_gF.

    The 2×2 system for B and C is solved in closed form. V_d = 0 means a constant index, as in lens files.
    """
    nd, vd, dpgf = coefficients[:3].unbind(0)
    first_fc, first_gf = 1 / _F - 1 / _C, 1 / _G - 1 / _F
    power_fc, power_gf = _F**-3.5 - _C**-3.5, _G**-3.5 - _F**-3.5
    determinant = first_fc * power_gf - first_gf * power_fc
    # A V_d so small that 1/V_d² is no number counts as 0: its derivative would be inf·0.
    dispersion = safe_divide(nd - 1.0, torch.where(vd.abs() > 1e-100, vd, 0.0))
    partial_dispersion = (0.6438 - 0.001682 * vd + dpgf) * dispersion
    b = (power_gf * dispersion - power_fc * partial_dispersion) / determinant
    c = (first_fc * partial_dispersion - first_gf * dispersion) / determinant
    return nd + b * (1.0 / wavelength - 1 / _D) + c * (wavelength**-3.5 - _D**-3.5)


@dataclasses.dataclass(frozen=True)
class Formula:
    """A dispersion formula.

    coefficients: their names. index: function of (coefficients (m, ...), wavelength (...) µm), float64, giving n.
    number: of the formula in an AGF file. wavelengths: µm, outside which it is not evaluated, so that powers down to
    λ⁻¹² and their derivatives stay finite; None for a constant index.
    """

    coefficients: str
    index: Callable[[Tensor, Tensor], Tensor]
    number: int | None = None
    wavelengths: tuple[float, float] | None = (1e-20, 1e12)

    @property
    def count(self) -> int:
        """The number of coefficients."""
        return len(self.coefficients.split())


#: Every formula by the name that `Glass.formula` holds.
FORMULAS = {
    # n² = a0 + a1 λ² + a2 λ⁻² + a3 λ⁻⁴ + a4 λ⁻⁶ + a5 λ⁻⁸
    "schott": Formula("a0 a1 a2 a3 a4 a5", partial(_laurent, (0, 1), (2, 3, 4, 5)), 1),
    "sellmeier_1": Formula("K1 L1 K2 L2 K3 L3", _sellmeier, 2),
    "herzberger": Formula("A B C D E F", _herzberger, 3),
    "sellmeier_2": Formula("A B1 λ1 B2 λ2", _sellmeier_2, 4),
    "conrady": Formula("n0 A B", _conrady, 5),
    "sellmeier_3": Formula("K1 L1 K2 L2 K3 L3 K4 L4", _sellmeier, 6),
    "handbook_1": Formula("A B C D", _handbook_1, 7),
    "handbook_2": Formula("A B C D", _handbook_2, 8),
    "sellmeier_4": Formula("A B C D E", _sellmeier_4, 9),
    # the Schott formula continued by a6 λ⁻¹⁰ + a7 λ⁻¹²
    "extended": Formula("a0 a1 a2 a3 a4 a5 a6 a7", partial(_laurent, (0, 1), (2, 3, 4, 5, 6, 7)), 10),
    "sellmeier_5": Formula("K1 L1 K2 L2 K3 L3 K4 L4 K5 L5", _sellmeier, 11),
    # the Schott formula continued by a6 λ⁴ + a7 λ⁶
    "extended_2": Formula("a0 a1 a2 a3 a4 a5 a6 a7", partial(_laurent, (0, 1, 6, 7), (2, 3, 4, 5)), 12),
    # n² = a0 + a1 λ² + a2 λ⁴ + a3 λ⁻² + … + a8 λ⁻¹²
    "extended_3": Formula("a0 a1 a2 a3 a4 a5 a6 a7 a8", partial(_laurent, (0, 1, 2), (3, 4, 5, 6, 7, 8)), 13),
    "constant": Formula("n", _constant, wavelengths=None),
    "model": Formula("nd Vd ΔPgF", _model),
}

#: The same by the number in an AGF file.
BY_NUMBER = {formula.number: name for name, formula in FORMULAS.items() if formula.number}


#: Behind the name of a formula: the formula with errors of manufacture, which are five further coefficients.
WITH_ERRORS, _ERRORS = " with errors", 5


@functools.cache
def formula_of(name: str) -> Formula:
    """The formula of a name that `Glass.formula` holds."""
    if name in FORMULAS:
        return FORMULAS[name]
    nominal = FORMULAS[name.removesuffix(WITH_ERRORS)]
    return Formula(f"{nominal.coefficients} Δn nd Vd ΔVd ΔPgF", partial(_with_errors, nominal))


def _with_errors(formula: Formula, coefficients: Tensor, wavelength: Tensor) -> Tensor:
    """n + Δn + M(n_d, V_d + ΔV_d, ΔP_gF) - M(n_d, V_d, ΔP_gF), M the model glass."""
    n = formula.index(coefficients[:-_ERRORS], wavelength)
    change, nd, vd, abbe_change, dpgf = coefficients[-_ERRORS:].unbind(0)
    abbe = torch.stack([vd + abbe_change, vd])
    changed, nominal = _model(torch.stack([nd.expand_as(abbe), abbe, dpgf.expand_as(abbe)]), wavelength).unbind(0)
    return torch.where(n > 0, n + change + (changed - nominal), n)


# -- glasses -----------------------------------------------------------------------------------------------------------

#: Spectral lines, µm (ISO 7944 and the neighbours that catalogs list).
LINES = {"i": 0.3650146, "h": 0.4046561, "g": 0.4358343, "F'": 0.4799914, "F": 0.4861327, "e": 0.5460740}
LINES |= {"d": 0.5875618, "D": 0.5892938, "C'": 0.6438469, "C": 0.6562725, "r": 0.7065188, "s": 0.8521100}
LINES |= {"t": 1.0139800}

#: Classes of resistance in the order of an OD record: CR, FR, SR, AR and PR.
RESISTANCE = ("climate", "stain", "acid", "alkali", "phosphate")

#: Relative slack at the ends of a wavelength range: a few float32 spacings.
_RANGE_SLACK = 1e-6

#: µm: wavelengths between these are traced; glasses end at 39, x-ray mirrors begin at 1e-4.
_SHORTEST, _LONGEST = 3e-5, 100.0
_UNITS, _LIKELY = (1e-3, 1e6), (0.1, 20.0)  # µm of a nm and of a m, and likely wavelengths


class ImplausibleWavelength(RaytraceError, ValueError):
    """A wavelength outside the range of all lenses: most likely it is in another unit than µm."""


class InvalidIndex(RaytraceError, ValueError):
    """A glass has no real, positive refractive index at a requested wavelength."""


class OutOfRange(RaytraceWarning):
    """A wavelength lies outside the range that the coefficients of a glass were fitted to."""


@value
class Glass:
    """A refracting medium: a dispersion formula with its coefficients.

    name: as written in the lens file, "" for air.
    formula: key of FORMULAS ("constant", "model", "schott", "sellmeier_1", ...), or "mirror"; behind it WITH_ERRORS for
        a glass with errors of manufacture.
    coefficients: (m, ...) of the formula, float64; trailing axes broadcast against the wavelength.
    catalog: name of the catalog the glass came from, "" if none.
    wavelength_range: µm (shortest, longest) or None.
    status: "standard", "preferred", "obsolete", "special", "melt", or "" if not listed.
    nd_listed, abbe_listed: n_d and V_d as the catalog lists them (rounded by its maker), None if it does not.
    alternatives: names of similar present-day glasses of the same catalog, from its comments.
    listed_name: the catalog's own spelling of the name.
    comment: the catalog's comment on the glass.
    records: further figures of the catalog, (keyword, numbers) in file order: ED, TD, MD, OD, IT.
    """

    name: str
    formula: str
    coefficients: Tensor
    catalog: str = ""
    wavelength_range: tuple[float, float] | None = None
    status: str = ""
    nd_listed: float | None = None
    abbe_listed: float | None = None
    alternatives: tuple[str, ...] = ()
    listed_name: str = ""
    comment: str = ""
    records: tuple[tuple[str, tuple[float, ...]], ...] = ()

    def __repr__(self) -> str:
        return f"<Glass: {', '.join(_description(self))}>"

    @property
    def expansion(self) -> float | None:
        """Linear thermal expansion from -30 to 70 °C, 1e-6/K; None if not listed."""
        return self._figure("ED", 0)

    @property
    def expansion_20_300(self) -> float | None:
        """Linear thermal expansion from 20 to 300 °C, 1e-6/K; None if not listed."""
        return self._figure("ED", 1)

    @property
    def density(self) -> float | None:
        """g/cm³; None if not listed."""
        return self._figure("ED", 2)

    @property
    def relative_price(self) -> float | None:
        """Price by volume relative to the maker's glass of the kind BK7; None if not listed."""
        return self._figure("OD", 0)

    @property
    def transmittance(self) -> tuple[tuple[float, float, float], ...]:
        """Rows (wavelength µm, internal transmittance, thickness mm) by wavelength; empty if not listed."""
        rows = (numbers for keyword, numbers in self.records if keyword == "IT" and len(numbers) > 2)
        return tuple(sorted((wavelength, passed, depth) for wavelength, passed, depth, *_ in rows))

    @property
    def resistance(self) -> dict[str, float]:
        """Classes of resistance of RESISTANCE that are listed: to climate, stain, acid, alkali and phosphate."""
        numbers = next((numbers[1:6] for keyword, numbers in self.records if keyword == "OD"), ())
        classes = dict(zip(RESISTANCE, numbers, strict=False))
        is_listed = any(number > 0 for number in classes.values())  # then stain 0 is a class, the best one
        return {name: c for name, c in classes.items() if c > 0 or (name == "stain" and c == 0 and is_listed)}

    def _figure(self, keyword: str, place: int) -> float | None:
        numbers = next((numbers for word, numbers in self.records if word == keyword), ())
        return next((number for number in numbers[place : place + 1] if number not in (0.0, -1.0)), None)


# -- the index --------------------------------------------------------------------------------------------------------


def refractive_index(glass: Glass, wavelength: Tensor | float) -> Tensor:
    """n of a glass, evaluated in float64; 0 with gradient 0 where the formula has no real, positive index.

    wavelength: (...) µm, plain numbers in float64; a constant index takes any number. Returns (...), broadcast with the
    trailing axes of the coefficients, in the dtype and on the device of `wavelength`. No check, no warning, no host
    synchronisation: see the module's docstring.
    Raises InvalidIndex for MIRROR, which has no index: light stays in the medium before it.
    """
    if glass.formula == "mirror":
        raise InvalidIndex("a mirror has no refractive index: the light stays in the medium before it")
    if not isinstance(wavelength, Tensor):
        wavelength = torch.as_tensor(wavelength, dtype=torch.float64)
    exact = wavelength.to(torch.float64)
    coefficients = glass.coefficients.to(device=wavelength.device, dtype=torch.float64)
    count, *batch = coefficients.shape
    coefficients = coefficients.reshape(count, *[1] * (exact.dim() - len(batch)), *batch)
    formula = formula_of(glass.formula)
    if formula.wavelengths is None:  # air is half of all media: no formula, no wavelength
        n = formula.index(coefficients, exact)
        return torch.where((n > 0) & (n < torch.inf), n, 0.0).to(wavelength.dtype)
    shortest, longest = formula.wavelengths
    finite = coefficients.abs() < torch.inf
    usable = (exact > shortest) & (exact < longest) & finite.all(0)
    n = formula.index(torch.where(finite, coefficients, 0.0), torch.where(usable, exact, 1.0))
    return torch.where(usable & (n > 0) & (n < torch.inf), n, 0.0).to(wavelength.dtype)


def internal_transmittance(glass: Glass, wavelength: Tensor | float, thickness: Tensor | float = 10.0) -> Tensor:
    """Internal transmittance of a glass of a thickness (...) mm by its catalog, without reflection at the surfaces.

        τ = exp(-α t),  α linear between the listed wavelengths

    wavelength: (...) µm. nan outside the listed wavelengths, and for a medium that lists none.
    """
    wavelength, thickness = _as_wavelength(wavelength), torch.as_tensor(thickness, dtype=torch.float64)
    rows = [row for row in glass.transmittance if row[0] > 0 and row[2] > 0]
    if len(rows) < 2:
        return torch.full_like(wavelength * thickness, torch.nan)
    columns = [*zip(*rows, strict=True)]
    listed, τ, depth = torch.tensor(columns, dtype=torch.float64, device=wavelength.device)
    absorption, exact = -torch.log(τ.clamp(torch.finfo(τ.dtype).tiny, 1.0)) / depth, wavelength.to(torch.float64)
    k = torch.searchsorted(listed, exact.detach().contiguous()).clamp(1, len(rows) - 1)
    share = safe_divide(exact - listed[k - 1], listed[k] - listed[k - 1])
    α = absorption[k - 1] + share * (absorption[k] - absorption[k - 1])
    inside = (exact >= listed[0]) & (exact <= listed[-1])
    return torch.where(inside, torch.exp(-α * thickness), torch.nan).to(wavelength.dtype)


def check_wavelengths(glass: Glass, wavelengths: Tensor | Sequence[float] | float, *, where: str = "") -> None:
    """Refuse wavelengths (µm) at which a glass has no index; warn of those outside its range.

    where: the place to name in the message ("lens.zmx:31, surface 2"). Raises InvalidIndex; warns OutOfRange.
    """
    if glass.formula == "mirror":
        return
    wavelengths = _as_wavelength(wavelengths).detach()
    place = f"{where}: " if where else ""
    name = f"{glass.name or 'medium'} ({glass.catalog})" if glass.catalog else glass.name or "medium"
    span = glass.wavelength_range
    fitted = f"its coefficients hold from {span[0]:g} to {span[1]:g} µm" if span else "it lists no wavelength range"
    n = refractive_index(glass, wavelengths).detach()
    exists = (n > 0) & (wavelengths > 0) & torch.isfinite(wavelengths)
    missing = wavelengths.expand(exists.shape)[~exists]
    if missing.numel():
        raise InvalidIndex(
            f"{place}{name} has no real refractive index at {_spell(missing)} µm (formula {glass.formula}: "
            f"n² ≤ 0, a pole, or not a wavelength); {fitted}. Check the wavelength, in µm, or choose another glass"
        )
    if span:
        shortest, longest = span[0] * (1 - _RANGE_SLACK), span[1] * (1 + _RANGE_SLACK)
        outside = wavelengths[(wavelengths < shortest) | (wavelengths > longest)]
        if outside.numel():
            message = f"{place}{name} is extrapolated to {_spell(outside)} µm; {fitted}"
            warnings.warn(message, OutOfRange, stacklevel=calling_level())


def check_unit(
    wavelengths: Tensor, media: Iterable[Glass] = (), *, believed: Tensor | None = None, where: str = ""
) -> None:
    """Refuse wavelengths in another unit than µm: shorter than hard x-rays, or longer than any glass transmits.

    media: glasses whose ranges are accepted as well. believed: wavelengths (...) known to be in µm, as those of a lens
    file, which are accepted with up to ten times longer and shorter ones. Raises ImplausibleWavelength, with a guess of
    the unit, also for numbers that are not positive and finite.
    """
    spans = [medium.wavelength_range for medium in media if medium.wavelength_range]
    known = [] if believed is None else [wave for wave in believed.detach().flatten().tolist() if 0 < wave < math.inf]
    shortest = min([_SHORTEST, *(s[0] for s in spans), *(0.1 * wave for wave in known)])
    longest = max([_LONGEST, *(s[1] for s in spans), *(10 * wave for wave in known)])
    for wavelength in wavelengths.detach().flatten().tolist():
        if not (0 < wavelength < math.inf and shortest <= wavelength <= longest):
            guesses = (wavelength * factor for factor in _UNITS)
            guess = next((f"did you mean {g:.7g}?" for g in guesses if _LIKELY[0] <= g <= _LIKELY[1]), None)
            raise ImplausibleWavelength(
                f"{where}{': ' if where else ''}a wavelength of {wavelength:g} µm: expected "
                f"{shortest:g} to {longest:g}; wavelengths are in µm" + (f"; {guess}" if guess else "")
            )


def index(glass: Glass, wavelength: Tensor | float) -> Tensor:
    """n of a glass at wavelengths (...) µm, checked: raises InvalidIndex, warns OutOfRange (`check_wavelengths`)."""
    wavelength = _as_wavelength(wavelength)
    check_wavelengths(glass, wavelength)
    return refractive_index(glass, wavelength)


def _as_wavelength(wavelength: Tensor | Sequence[float] | float) -> Tensor:
    if isinstance(wavelength, Tensor) and wavelength.is_floating_point():
        return wavelength
    return torch.as_tensor(wavelength, dtype=torch.float64)


def _spell(wavelengths: Tensor) -> str:
    listed = list(dict.fromkeys(f"{number:.7g}" for number in wavelengths.flatten().tolist()))
    return ", ".join(listed[:5]) + (f" and {len(listed) - 5} more" if len(listed) > 5 else "")


def _at_lines(glass: Glass, lines: str) -> tuple[Tensor, ...]:
    device = glass.coefficients.device
    return tuple(
        refractive_index(glass, torch.tensor(LINES[line], dtype=torch.float64, device=device)) for line in lines
    )


def nd(glass: Glass) -> Tensor:
    """n at the helium d line (0.5875618 µm), by the formula also where that lies outside the glass's range."""
    return _at_lines(glass, "d")[0]


def abbe_number(glass: Glass) -> Tensor:
    """V_d = (n_d - 1)/(n_F - n_C); 0 for a medium without dispersion, as lens files write it."""
    d, blue, red = _at_lines(glass, "dFC")
    return safe_divide(d - 1.0, blue - red)


# -- media ------------------------------------------------------------------------------------------------------------


def constant(index: float | Tensor, name: str = "") -> Glass:
    """A medium of one refractive index at every wavelength."""
    return Glass(name, "constant", torch.as_tensor(index, dtype=torch.float64).reshape(1))


#: Sellmeier's formulas of three, four and five terms.
_SELLMEIER = ("sellmeier_1", "sellmeier_3", "sellmeier_5")


def sellmeier(
    strengths: Tensor | Sequence[float], poles: Tensor | Sequence[float], name: str = "", **known: Any
) -> Glass:
    """The glass n² = 1 + Σ_i B_i λ²/(λ² - C_i): strengths B_i and poles C_i (µm²), (m, ...) with m ≤ 5.

    known: further fields of Glass, such as `wavelength_range`.
    """
    b, c = (torch.as_tensor(part, dtype=torch.float64) for part in (strengths, poles))
    formula = next((name for name in _SELLMEIER if FORMULAS[name].count >= 2 * b.shape[0]), None)
    if b.shape[:1] != c.shape[:1] or formula is None:
        raise ValueError(f"expected as many strengths as poles and at most 5, found {b.shape[0]} and {c.shape[0]}")
    b, c = torch.broadcast_tensors(b, c)
    pairs = torch.stack([b, c], 1).flatten(0, 1)
    padding = pairs.new_zeros(FORMULAS[formula].count - pairs.shape[0], *pairs.shape[1:])
    return Glass(name, formula, torch.cat([pairs, padding]), **known)


def model_glass(nd: float | Tensor, vd: float | Tensor, dpgf: float | Tensor = 0.0, *, name: str = "") -> Glass:
    """The medium of index n_d, Abbe number V_d and deviation ΔP_gF from the normal line (`FORMULAS["model"]`).

    Differentiable in all three. V_d = 0 is a constant index. Raises ValueError where a number is not finite or nd ≤ 0.
    """
    numbers = torch.broadcast_tensors(*(torch.as_tensor(part, dtype=torch.float64) for part in (nd, vd, dpgf)))
    coefficients = torch.stack(numbers)
    if not (torch.isfinite(coefficients).all() and (numbers[0] > 0).all() and (numbers[1] >= 0).all()):
        raise ValueError(f"a model glass needs finite nd > 0, Vd ≥ 0 and ΔPgF; found {nd}, {vd}, {dpgf}")
    return Glass(name, "model", coefficients)


def with_index_errors(
    glass: Glass, index: Tensor | None = None, abbe: Tensor | None = None, *, percent: bool = False
) -> Glass:
    """A medium whose index is higher by `index` at all wavelengths, and its Abbe number by `abbe`, or `abbe` per cent.

        n′(λ) = n(λ) + Δn + M(n_d, V_d + ΔV_d, ΔP_gF; λ) - M(n_d, V_d, ΔP_gF; λ)

    M: the model glass (`FORMULAS["model"]`), by whose dispersion a changed Abbe number changes the index and which is 0
    at the d line; the dispersion formula of the glass stays. ΔP_gF: that of a model glass, 0 of others.
    index, abbe: (...) with trailing axes as those of a lens's numbers. Errors of a medium with errors are added.
    Raises InvalidIndex for a mirror, and for an Abbe number of a medium that has none: a constant index, or a glass
    that is opaque at the lines d, F and C.
    """
    if glass.formula == "mirror":
        raise InvalidIndex("a mirror has no refractive index: the light stays in the medium before it")
    if not glass.formula.endswith(WITH_ERRORS):
        if abbe is not None and not has_abbe_number(glass):
            raise InvalidIndex(f"{label(glass) or 'the medium'} has no Abbe number: expected a glass with dispersion")
        nominal = glass.coefficients.double()
        numbers = torch.stack([refractive_index(glass, LINES[line]) for line in "dFC"])
        n, v = numbers[0], safe_divide(numbers[0] - 1.0, numbers[1] - numbers[2])
        deviation = nominal[2] if glass.formula == "model" else torch.zeros_like(n)
        parts = torch.broadcast_tensors(*nominal.unbind(0), 0 * n, n, v, 0 * n, deviation)
        name = f"{glass.formula}{WITH_ERRORS}"
        glass = dataclasses.replace(glass, formula=name, coefficients=torch.stack(parts), catalog="", status="")
    *inner, change, n, v, abbe_change, deviation = glass.coefficients.unbind(0)
    if index is not None:
        change = change + index.double()
    if abbe is not None:
        abbe_change = abbe_change + (v * abbe.double() / 100 if percent else abbe.double())
    parts = torch.broadcast_tensors(*inner, change, n, v, abbe_change, deviation)
    return dataclasses.replace(glass, coefficients=torch.stack(parts))


def has_abbe_number(glass: Glass) -> bool:
    """Whether a medium has indices at the lines d, F and C that differ."""
    yellow, blue, red = (refractive_index(glass, LINES[line]).detach() for line in "dFC")
    return bool(((yellow > 0) & (red > 0) & (blue > red)).all())


def label(glass: Glass) -> str:
    """The name of a medium; without a name, n_d/V_d of a model glass, "n 1.5" of a constant index, "" of air."""
    if glass.name or glass.coefficients.dim() > 1:
        return glass.name
    numbers = glass.coefficients.tolist()
    if glass.formula == "model":
        return f"{numbers[0]:.6g}/{numbers[1]:.4g}"
    return f"n {numbers[0]:.6g}" if glass.formula == "constant" and numbers[0] != 1 else ""


def _description(glass: Glass) -> list[str]:
    """Name and catalog, n_d and V_d as its coefficients give them; of a batch the smallest and the largest."""
    name = label(glass) or ("air" if glass.formula == "constant" and glass.coefficients.dim() == 1 else "no name")
    words = [f"{name} ({glass.catalog})" if glass.catalog else name]
    if glass.formula in ("mirror", "constant") or is_wrapped(glass.coefficients):
        return words
    for symbol, number in (("n_d", nd(glass).detach()), ("V_d", abbe_number(glass).detach())):
        low, high = (f"{float(extreme):.6g}" for extreme in (number.min(), number.max()))
        words.append(f"{symbol} {low}" if low == high else f"{symbol} {low} to {high}")
    return words


def mil_glass(code: str) -> Glass:
    """The model glass of a six-digit code: "517642" is n_d = 1.517, V_d = 64.2.

    The code holds three decimals of n_d - 1, so an index of 2 or more cannot be written (003283 reads 1.003).
    Raises ValueError for anything but six digits.
    """
    if len(code) != 6 or not (code.isascii() and code.isdigit()):
        raise ValueError(f"a MIL glass code is six digits, as 517642 for nd = 1.517 and Vd = 64.2; found {code!r}")
    return model_glass(float(f"1.{code[:3]}"), float(f"{code[3:5]}.{code[5]}"), name=code)


#: Powers of λ in Schott's formula in the order in which measured indices determine them, and their places in it.
_SCHOTT_POWERS, _SCHOTT_PLACES = (0, -2, 2, -4, -6, -8), (0, 2, 1, 3, 4, 5)


def from_table(
    wavelengths: Sequence[float] | Tensor,
    indices: Sequence[float] | Tensor,
    *,
    exact: int = 0,
    terms: int = len(_SCHOTT_POWERS),
    name: str = "table",
) -> Glass:
    """The glass n² = a₀ + a₂ λ⁻² + a₁ λ² + a₃ λ⁻⁴ + … through indices (m,) at wavelengths (m,) µm.

    As many indices as terms are met exactly. More are fitted by least squares, of which the first `exact`, fewer than
    the terms, are met exactly. Differentiable in the indices. Raises ValueError for lists of unequal length, equal
    wavelengths, and numbers that are not finite and positive.
    """
    w, n = (torch.as_tensor(part, dtype=torch.float64) for part in (wavelengths, indices))
    if w.dim() != 1 or w.shape != n.shape or not len(w):
        raise ValueError(f"{n.numel()} indices at {w.numel()} wavelengths: expected one each")
    if not bool((w > 0).all() & torch.isfinite(w).all() & (n > 0).all() & torch.isfinite(n).all()):
        raise ValueError(f"wavelengths {w.tolist()} µm and indices {n.tolist()}: expected finite, positive numbers")
    if len(torch.unique(w)) < len(w):
        raise ValueError(f"a wavelength occurs twice in {w.tolist()}: expected one index for each")
    terms, exact = min(len(w), terms, len(_SCHOTT_POWERS)), min(exact, len(w))
    a = _meeting(torch.stack([w**power for power in _SCHOTT_POWERS[:terms]], -1), n * n, exact)
    coefficients = a.new_zeros(6).index_put((torch.tensor(_SCHOTT_PLACES[:terms]),), a)
    return Glass(name, "schott", coefficients, wavelength_range=(float(w.min()), float(w.max())))


def _meeting(basis: Tensor, values: Tensor, exact: int) -> Tensor:
    """a (k,) of basis (m, k) · a = values (m,) by least squares, the first `exact` rows, fewer than k, met exactly."""
    if not len(values) > basis.shape[1] > exact > 0:
        return torch.linalg.lstsq(basis, values[:, None]).solution[:, 0]
    # a = Q (y, z): y by the first rows, z by least squares
    values, (q, r) = values[:, None], torch.linalg.qr(basis[:exact].T, mode="complete")
    y = torch.linalg.solve_triangular(r[:exact].T, values[:exact], upper=False)
    rest = basis[exact:] @ q
    left = values[exact:] - rest[:, :exact] @ y
    a = (q @ torch.cat([y, torch.linalg.lstsq(rest[:, exact:], left).solution]))[:, 0]
    missed = values[:exact] - basis[:exact] @ a[:, None]  # by rounding
    return a + (q[:, :exact] @ torch.linalg.solve_triangular(r[:exact].T, missed, upper=False))[:, 0]


#: Powers of λ in the formula "extended_3", in the order of its coefficients.
_EXTENDED_POWERS = (0, 2, 4, -2, -4, -6, -8, -10, -12)

#: Largest difference of a melt's index from that of the glass with errors, between the wavelengths of a lens.
MELT_ERROR = 1e-7
_MARGIN = 0.1  # of the wavelengths of a lens, by which the fit of a melt reaches further


class NoMelt(RaytraceError, ValueError):
    """No formula of a catalog fits the dispersion of a glass with index errors."""


def melt(glass: Glass, wavelengths: Tensor) -> Glass:
    """The medium of a glass with index errors by a formula that lens files hold.

    wavelengths: (W,) µm, those of a lens. A constant index, a model glass and Conrady's formula keep their formula and
    are exact at all wavelengths. Others are n² = a₀ + a₁ λ² + a₂ λ⁴ + a₃ λ⁻² + … + a₈ λ⁻¹² ("extended_3", status
    "melt"): exact at up to 9 wavelengths, between them by least squares. A glass without errors is returned itself.
    Raises NoMelt where the indices differ by more than MELT_ERROR between the wavelengths, or where there is none.
    """
    if not glass.formula.endswith(WITH_ERRORS):
        return glass
    formula = glass.formula.removesuffix(WITH_ERRORS)
    nominal, errors = glass.coefficients[:-_ERRORS], glass.coefficients[-_ERRORS:]
    if formula == "constant":
        return dataclasses.replace(glass, formula=formula, coefficients=nominal + errors[:1])
    if formula in ("model", "conrady"):
        return dataclasses.replace(glass, formula=formula, coefficients=_of_three(glass, formula))
    w = torch.unique(wavelengths.detach().double().cpu())
    low, high = float(w.min()), float(w.max())
    span = glass.wavelength_range or (0.0, math.inf)
    between, error = torch.linspace(low, high, 201, dtype=torch.float64), math.inf
    for margin in (_MARGIN, 0.0):
        ends = min(low, max(low * (1 - margin), span[0])), max(high, min(high * (1 + margin), span[1]))
        fitted = _extended(glass, w, ends)
        error = float((refractive_index(fitted, between) - refractive_index(glass, between)).abs().max())
        if error <= MELT_ERROR and bool((refractive_index(glass, between) > 0).all()):
            return fitted
    name, reason = glass.name or "a glass", f"a formula differs by {error:.1e}, {MELT_ERROR:.0e} at most is accepted"
    raise NoMelt(f"{name} with index errors has no melt from {low:g} to {high:g} µm: {reason}")


def _of_three(glass: Glass, formula: str) -> Tensor:
    """The coefficients (3,) of a medium n = A + B/λ + C/λ^3.5: Conrady's, or those of a model glass."""
    lines = torch.tensor(tuple(MODEL_LINES.values()), dtype=torch.float64)
    d, blue, red, violet = n = refractive_index(glass, lines)
    if formula == "conrady":
        basis = torch.stack([torch.ones_like(lines), 1 / lines, lines**-3.5], -1)
        return torch.linalg.solve(basis[:3], n[:3])
    abbe = safe_divide(d - 1, blue - red)
    return torch.stack([d, abbe, _off_normal_line(violet, blue, red, abbe)])


def _extended(glass: Glass, w: Tensor, ends: tuple[float, float]) -> Glass:
    """The formula "extended_3" for a glass between two wavelengths, µm, exact at w (W,) µm where its terms suffice."""
    middle = (ends[0] * ends[1]) ** 0.5  # the unit of λ, in which all powers are of similar size
    nodes = 0.5 * (1 - torch.cos(torch.linspace(0, math.pi, 41, dtype=torch.float64)))
    met = len(w) == len(_EXTENDED_POWERS)  # by as many terms: no least squares
    points = w if met else torch.cat([w, ends[0] + (ends[1] - ends[0]) * nodes])
    n = refractive_index(glass, points)
    scaled = torch.stack([(points / middle) ** power for power in _EXTENDED_POWERS], -1)
    a = _meeting(scaled, n * n, len(w)) / middle ** torch.tensor(_EXTENDED_POWERS, dtype=torch.float64)
    fitted = Glass(
        glass.name, "extended_3", a, wavelength_range=ends, status="melt", listed_name=glass.listed_name,
        records=glass.records,
    )  # fmt: skip
    figures = (float(nd(fitted)), float(abbe_number(fitted)))
    if figures[0] > 0 and 0 < figures[1] < math.inf:
        fitted = dataclasses.replace(fitted, nd_listed=figures[0], abbe_listed=figures[1])
    return fitted


def normal_line_deviation(glass: Glass) -> Tensor:
    """ΔP_gF = (n_g - n_F)/(n_F - n_C) - 0.6438 + 0.001682 V_d, the number a model glass takes; 0 without dispersion."""
    violet, blue, red = _at_lines(glass, "gFC")
    return _off_normal_line(violet, blue, red, abbe_number(glass))


def _off_normal_line(violet: Tensor, blue: Tensor, red: Tensor, abbe: Tensor) -> Tensor:
    return torch.where(blue == red, 0.0, safe_divide(violet - blue, blue - red) - (0.6438 - 0.001682 * abbe))


#: Largest n - 1 of a gas: air at 1 atm has 0.0003, carbon dioxide 0.0005.
_GAS = 1e-3


def is_air(glass: Glass) -> bool:
    """Whether a medium is air or another gas: its index at the d line is 1 to 1e-3, whatever its name."""
    return glass.formula != "mirror" and bool(((nd(glass).detach() - 1).abs() < _GAS).all())


AIR = constant(1.0)
MIRROR = Glass("MIRROR", "mirror", torch.ones(1, dtype=torch.float64))
