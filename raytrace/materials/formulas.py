"""Formulas: n of coefficients and wavelength, 0 where there is no real index; a row of FORMULAS each.

The thirteen dispersion formulas of the AGF glass catalog format, a constant index and the model glass of lens files.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide, safe_sqrt


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


class Formula(NamedTuple):
    """A dispersion formula.

    coefficients: their names. index: function of (coefficients (m, ...), wavelength (...) µm), float64, giving n.
    number: of the formula in an AGF file. wavelengths: µm, outside which it is not evaluated, so that powers down to
    λ⁻¹² and their derivatives stay finite; None where the wavelength does not count.
    """

    coefficients: str
    index: Callable[[Tensor, Tensor], Tensor]
    number: int | None = None
    wavelengths: tuple[float, float] | None = (1e-20, 1e12)

    @property
    def count(self) -> int:
        """How many coefficients it takes."""
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
