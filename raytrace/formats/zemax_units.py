"""The lines of a .zmx file in mm as lines in another unit of length.

A merit function of lengths and pure numbers depends on the unit, so a lens with one is written in that of its file. A
number that came out of such a file is written such that reading it again gives the same number of mm; of others, two
of which may lie between neighbouring numbers of the file, it gives that or the next one.
"""

import math
from collections.abc import Iterable
from decimal import Context, Decimal
from fractions import Fraction

from raytrace.formats.source import LensFileError, Place
from raytrace.formats.spelling import MILLIMETRES, is_infinite
from raytrace.formats.zemax_keywords import FIELD_LISTS, aperture_keywords
from raytrace.formats.zemax_numbers import INVERSE, SurfaceType
from raytrace.formats.zemax_rules import CURVATURE_SOLVES, THICKNESS_SOLVES
from raytrace.formats.zemax_types import types
from raytrace.system.aperture import SHAPES

#: Powers of length of the words of a line, from 1, by its keyword; others have none.
_WORDS = {
    "ENPD": {1: 1},
    "SDMA": {3: 1},
    "CURV": {1: -1},
    "DISZ": {1: 1},
    "DIAM": {1: 1},
    "VDSZ": {1: 1, 2: 1},
    "PZUP": {3: 1},
    "OBDC": {1: 1, 2: 1},
    "UDAD": {2: 1, 3: 1},
    "SCBD": {4: 1, 5: 1},
    **{
        keyword: {k: power for k, power in enumerate(rule.powers, 1 + rule.from_surface) if power}
        for keyword, rule in THICKNESS_SOLVES.items()
    },
}
_APERTURES = {
    keyword: dict.fromkeys(range(1, 1 + (SHAPES[name].sizes or 0)), 1)
    for keyword, (name, _) in aperture_keywords().items()
}


def unit_named(millimetres: float, place: Place) -> str:
    """The name of a unit of length. Raises LensFileError for one that a .zmx file does not have."""
    for name in ("MM", "CM", "IN", "METER"):
        if MILLIMETRES[name] == millimetres:
            return name
    raise LensFileError(f"a unit of {millimetres!r} mm, expected 1, 10, 25.4 or 1000 (MM, CM, IN, METER)", place)


def in_unit(lines: Iterable[str], millimetres: float, place: Place) -> list[str]:
    """The lines of the system and the surfaces, in mm, in a unit of `millimetres`."""
    lines = list(lines)
    if millimetres == 1:
        return lines
    name, angles, row, found = unit_named(millimetres, place), False, types()["STANDARD"], []
    for line in lines:
        words = line.split()
        keyword = words[0] if words else ""
        if keyword == "UNIT":
            line = line.replace("MM", name, 1)
        if keyword == "FTYP":
            angles = words[1] == "0"
        if keyword == "TYPE":
            row = types()[words[1]]
        powers = _powers(words, row, angles)
        found.append(_converted(line, words, powers, millimetres) if powers else line)
    return found


def _powers(words: list[str], row: SurfaceType, angles: bool) -> dict[int, int | None]:
    """The power of length of the words of a line that have one; row: the type of its surface."""
    keyword = words[0] if words else ""
    if keyword in ("PARM", "PPAR"):
        power = row.parameters.get(int(words[1]), 0)
        position = 2 if keyword == "PARM" else 4
        power = 0 if power is INVERSE and keyword == "PPAR" else power
        return {position: power} if power != 0 and len(words) > position else {}
    if keyword == "XDAT":
        power = {1: 0, 2: 1}.get(int(words[1]), row.terms or 0)
        return {2: power} if power else {}
    if keyword == "CURV" and len(words) > 3 and int(words[2]) in CURVATURE_SOLVES:
        solved = CURVATURE_SOLVES[int(words[2])].powers
        return _WORDS["CURV"] | {k: power for k, power in enumerate(solved, 3) if power}
    if keyword in (FIELD_LISTS["x"].keywords[0], FIELD_LISTS["y"].keywords[0]):
        return {} if angles else dict.fromkeys(range(1, len(words)), 1)
    if keyword == "FEFD":
        return {} if angles else {1: 1, 2: 1}
    return _WORDS.get(keyword) or _APERTURES.get(keyword) or {}


def _converted(line: str, words: list[str], powers: dict[int, int | None], millimetres: float) -> str:
    indent = line[: len(line) - len(line.lstrip())]
    told = [in_file(word, powers[k], millimetres) if k in powers else word for k, word in enumerate(words)]
    return indent + " ".join(told)


def in_file(word: str, power: int | None, millimetres: float) -> str:
    """A number in powers of mm as one in powers of a unit of `millimetres`; infinity and 0 as they are."""
    if is_infinite(word) or not float(word):
        return word
    if power is INVERSE:
        length = Fraction(word) / Fraction(repr(millimetres))
        return str(Context(prec=40).divide(Decimal(length.numerator), Decimal(length.denominator)))
    number = float(word)
    start = number / millimetres**power if power >= 0 else number * millimetres**-power
    if not math.isfinite(start):
        return word
    return repr(next((one for one in _near(start) if _read(one, power, millimetres) == number), start))


def _near(number: float) -> Iterable[float]:
    """A number and its neighbours, nearest first."""
    yield number
    above = below = number
    for _ in range(4):
        above, below = math.nextafter(above, math.inf), math.nextafter(below, -math.inf)
        yield above
        yield below


def _read(number: float, power: int, millimetres: float) -> float:
    """As the reader has it, in the same order."""
    return number * millimetres**power if power >= 0 else number / millimetres**-power
