"""Diffractive surfaces of a CODE V sequence: round ones (DIF DOE, HCT R), read and written.

    p = HOR λ/HWL Σ_j C_j r^2j

HCO Cj tells C_j in units of length, HWL the wavelength of the construction in nm, HOR the order. A `RadialPhase` has
coefficients in radians at a radius of its own, A_j = 2π C_j radius^2j/HWL, which are rounded once, and come back.
"""

import math
from decimal import Decimal, localcontext
from fractions import Fraction

from raytrace.formats.seq_keywords import OWN
from raytrace.formats.source import LensFileError, Place, UnsupportedSurface
from raytrace.formats.spelling import double, exact, exact_list
from raytrace.formats.zemax_keywords import Block, Record
from raytrace.system.phases import RadialPhase

#: More coefficients than any diffractive surface has.
_MOST = 50

#: Digits of a written coefficient, such that it comes back through two roundings.
_DIGITS = 40

_NANOMETRE = Fraction(1, 10**6)  # mm


def phase(block: Block, radius: float, unit: float) -> RadialPhase | None:
    """The phase of a surface, None if it is not diffractive; radius: mm, of its coefficients."""
    record = block.last("DIF")
    if record is None:
        return None
    kind, type_, wave = record.words[:1], block.last("HCT"), block.last("HWL")
    if [word.upper() for word in kind] != ["DOE"]:
        raise UnsupportedSurface(f"DIF {' '.join(kind)[:40]} (diffractive surface) is not modelled", record.place)
    if not type_ or [word.upper() for word in type_.words] != ["R"]:
        found = f"HCT {' '.join(type_.words)[:40]}" if type_ else "DIF DOE without HCT"
        raise UnsupportedSurface(f"{found} is not modelled; modelled is HCT R, powers of r²", record.place)
    if wave is None or wave.number(0, "wavelength") <= 0:
        raise LensFileError("DIF DOE without the wavelength of its construction (HWL)", record.place)
    length = _fraction(wave.words[0]) * _NANOMETRE
    terms = _terms(block)
    coefficients = [_radians(terms.get(j), j, length, radius, unit) for j in range(1, max(terms, default=0) + 1)]
    order = block.last("HOR")
    return RadialPhase(double(coefficients), double(radius), double(order.number(0, "order") if order else 1.0))


def _fraction(word: str) -> Fraction:
    return Fraction(word.upper().replace("D", "E"))


def _terms(block: Block) -> dict[int, Record]:
    terms = {}
    for record in block.all("HCO"):
        word = record.words[0].upper() if record.words else ""
        j = int(word[1:]) if word[:1] == "C" and word[1:].isdigit() and len(word) < 6 else 0
        if not 1 <= j <= _MOST:
            raise LensFileError(f"HCO {word[:20]}, expected C1 to C{_MOST} and a number", record.place)
        record.number(1, f"coefficient C{j}")
        terms[j] = record
    return terms


def _radians(record: Record | None, j: int, length: Fraction, radius: float, unit: float) -> float:
    if record is None:
        return 0.0
    written = _fraction(record.words[1]) / Fraction(unit) ** (2 * j - 1)
    found = Fraction(2 * math.pi) * written * Fraction(radius) ** (2 * j) / length
    try:
        return float(found) + 0.0
    except OverflowError as error:
        raise LensFileError(f"HCO C{j} is too large", record.place) from error


def lines(phase: RadialPhase, wavelength: float, place: Place) -> list[str]:
    """The commands of a phase; wavelength: µm, that of its construction."""
    length = Fraction(repr(wavelength)) * 1000 * _NANOMETRE
    radius = exact(phase.radius, "radius of the phase", place)
    if not float(radius) > 0:
        raise LensFileError(f"the radius of the phase is {radius}, expected one above 0", place)
    terms = exact_list(phase.coefficients, "coefficients of the phase", place)
    if len(terms) > _MOST:
        raise LensFileError(f"{len(terms)} coefficients of the phase, a .seq file has at most {_MOST}", place)
    return [
        "  DIF DOE",
        f"  HOR {exact(phase.order, 'order', place)}",
        f"  HWL {Decimal(repr(wavelength)).scaleb(3).normalize():f}; HCT R",
        *(f"  HCO C{j} {_length(float(term), j, length, float(radius))}" for j, term in enumerate(terms, 1)),
        f"  {OWN.lower()} radius {radius}" if float(radius) != 1 else "",
    ]


def _length(term: float, j: int, length: Fraction, radius: float) -> str:
    """C_j with more digits than a number has, where it needs them."""
    found = Fraction(term) * length / (Fraction(2 * math.pi) * Fraction(radius) ** (2 * j))
    with localcontext(prec=_DIGITS):
        return str(Decimal(found.numerator) / Decimal(found.denominator))
