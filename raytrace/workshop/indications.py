"""Indications of ISO 10110 on a drawing, from the tolerances of a lens.

    0/A             stress birefringence, nm/cm              3/A(B/C)   surface form, fringes of 546.07 nm
    1/N×A           bubbles and inclusions                   4/σ        centring, minutes of arc
    2/A;B           inhomogeneity class; striae class        5/N×A      surface imperfections
                                                             6/H        laser damage threshold

A of 3/ is the sagitta error (power), B the irregularity, C the irregularity of revolution. A fringe is half a
wavelength: N fringes at λ are N λ/546.07 nm here. 4/ is the largest tilt of a face: that of its tolerances, of a runout
e over the diameter 2h the angle arctan(e/2h), of a decentre d the angle d |c|; of a radial error that of its magnitude.
A dash: the lens has no such tolerance.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence

from raytrace.system.lens import Lens
from raytrace.system.tolerance_data import Tolerance
from raytrace.tolerancing.files import tolerances_of
from raytrace.tolerancing.grades import tolerances
from raytrace.tolerancing.table import ToleranceTable
from raytrace.words import RaytraceError
from raytrace.workshop.parts import Face, Part

#: µm of the fringes of 3/, of the line e of mercury.
WAVELENGTH = 0.54607

#: Indications that no tolerance of a lens gives: the number, and where it is on a sheet.
STATED = {"0": "material", "1": "material", "2": "material", "5": "surface", "6": "surface"}

#: The number of a line of a file, in the source of a tolerance.
_LINE = re.compile(r"(?: line)?:\d+$")

#: Kinds of tolerances that have a place of their own on a sheet; others are lines below the table.
_PLACED = (
    *("radius", "power", "curvature", "irregularity", "irregularity_angle", "thickness", "index", "abbe"),
    *("surface_tilt_x", "surface_tilt_y", "surface_runout_x", "surface_runout_y"),
    *("surface_decenter_x", "surface_decenter_y"),
    *("element_tilt_x", "element_tilt_y", "element_decenter_x", "element_decenter_y"),
)


class BadIndication(RaytraceError, ValueError):
    """An indication that ISO 10110 does not have, or that the tolerances of the lens give."""


def stated(words: str | Sequence[str]) -> dict[str, str]:
    """Indications by their number: "0/20 1/3x0.16 5/5x0.25" -> {"0": "0/20", …}. Raises BadIndication."""
    result = {}
    for word in words.split() if isinstance(words, str) else [w for text in words for w in text.split()]:
        number, slash, value = word.partition("/")
        if number in ("3", "4"):
            raise BadIndication(f"{word!r}: 3/ and 4/ follow from the tolerances of the lens: give them as limits")
        if number not in STATED or not slash or not value:
            raise BadIndication(f"{word!r}: expected one of {', '.join(f'{n}/…' for n in STATED)}, as 5/5x0.25")
        result[number] = f"{number}/{value.replace('x', '×')}"
    return result


def limits(row: Tolerance | None, factor: float = 1.0, unit: str = "", digits: int = 3) -> str:
    """The limits of a tolerance in words: "± 0.02", "+0.5 −0.2"; "" without one."""
    if row is None:
        return ""
    low, high = sorted((row.minimum * factor, row.maximum * factor))
    text = f"± {high:.{digits}g}" if math.isclose(-low, high) else f"{high:+.{digits}g} {low:+.{digits}g}"
    return f"{text}{unit}".replace("-", "−")


def sized(length: float, decimals: int = 4) -> str:
    """A length in mm, without zeros at its end."""
    return f"{length:.{decimals}f}".rstrip("0").rstrip(".")


def toleranced(length: float, row: Tolerance | None, factor: float = 1.0) -> str:
    """A length in mm to a tenth of its tolerance, from 0.01 to 0.0001 mm, and the limits, times a factor in mm.

    "8.747 ± 0.02"; without a tolerance the length to 0.001 mm.
    """
    least = min((abs(factor * end) for end in (row.minimum, row.maximum) if end), default=None) if row else None
    decimals = 3 if least is None else min(max(1 - math.floor(math.log10(least) + 1e-9), 2), 4)
    return f"{sized(length, decimals)} {limits(row, factor)}".rstrip()


def tolerances_for(lens: Lens, limits: str | Sequence[str], *, grade: str | None, radial: bool) -> ToleranceTable:
    """The tolerances of a document: of a grade and of limits, as of `tolerances`, else those of the lens, or none."""
    if grade or limits or radial:
        return tolerances(lens, limits, grade=grade, radial=radial)
    return tolerances_of(lens)


class Indications:
    """The tolerances of a lens by their place on the sheets; words: further indications, as of `stated`."""

    def __init__(self, table: ToleranceTable, words: Mapping[str, str], coating: str = "") -> None:
        self.rows, self.words, self.coating = table.rows, words, coating
        self.radial = {(error.name, table[first].surfaces): error.magnitude for first, error in table.radial.items()}
        self.fringe = table.test_wavelength / WAVELENGTH

    def row(self, kind: str, *surfaces: int) -> Tolerance | None:
        """The tolerance of a kind at surfaces; None without one."""
        return next((row for row in self.rows if row.kind == kind and row.surfaces == surfaces), None)

    def radius(self, face: Face, side: str) -> str:
        """Radius in mm with its tolerance; side: CX or CC."""
        if face.curvature == 0:
            return "R ∞"
        radius, k = 1 / face.curvature, face.number
        percent, curvature = self.row("radius", k), self.row("curvature", k)
        row, factor = percent or curvature, radius**2
        if row is None:
            return f"R {abs(radius):.6g} {side}"
        if percent is not None:
            factor = abs(radius) / 100 if percent.unit == "%" else 1.0
        size, _, error = toleranced(abs(radius), row, factor).partition(" ")
        return f"R {size} {side} {error}".rstrip()

    def form(self, face: Face) -> str:
        """3/A(B): power and irregularity in fringes of 546.07 nm."""
        power, irregularity = self.row("power", face.number), self.row("irregularity", face.number)
        if power is None and irregularity is None:
            return "3/ –"
        a, b = ("–" if row is None else f"{_largest(row) * self.fringe:.3g}" for row in (power, irregularity))
        return f"3/{a}({b})"

    def tilt(self, face: Face) -> float:
        """Degrees by which the tolerances of a face tilt it at most; nan without one."""
        tilt, runout, shift = (self.largest(f"surface_{kind}", face.number) for kind in ("tilt", "runout", "decenter"))
        angles = [] if tilt is None else [tilt]
        angles += [] if runout is None else [math.degrees(math.atan(runout / (2 * face.clear)))]
        angles += [] if shift is None else [math.degrees(math.atan(shift * abs(face.curvature)))]
        return max(angles, default=math.nan)

    def largest(self, kind: str, *surfaces: int) -> float | None:
        """The magnitude of a radial error at surfaces, or the largest one along x or y; None without a tolerance."""
        if (magnitude := self.radial.get((f"{kind}_radial", surfaces))) is not None:
            return magnitude
        rows = (self.row(f"{kind}_{axis}", *surfaces) for axis in "xy")
        return max((_largest(row) for row in rows if row is not None), default=None)

    def centring(self, face: Face) -> str:
        """4/σ in minutes, or in seconds of arc below one minute."""
        minutes = 60 * self.tilt(face)
        if math.isnan(minutes):
            return "4/ –"
        return f"4/{minutes:.2g}′" if minutes >= 1 else f"4/{60 * minutes:.2g}″"

    def of_words(self, number: str) -> str:
        return self.words.get(number, f"{number}/ –")

    def mounting(self, first: int, last: int) -> tuple[str, str]:
        """Decentre in mm and tilt in minutes of arc of an element or a group in its mount; "–" without one."""
        kinds = [f"element_{kind}" for kind in ("decenter", "tilt")]
        radial = [self.radial.get((f"{kind}_radial", (first, last))) for kind in kinds]
        rows = [self.row(f"{kind}_x", first, last) or self.row(f"{kind}_y", first, last) for kind in kinds]
        shift = limits(rows[0]) if radial[0] is None else f"{radial[0]:.3g} radial"
        tilt = limits(rows[1], 60, "′", 2) if radial[1] is None else f"{60 * radial[1]:.2g}′ radial"
        return shift or "–", tilt or "–"

    def others(self, part: Part) -> list[str]:
        """Tolerances of a part that have no place in the table, in words."""
        inside = set(range(part.surfaces[0], part.surfaces[1] + 1))
        rows = (row for row in self.rows if row.kind not in _PLACED and row.surfaces)
        return [str(row) for row in rows if inside.issuperset(row.surfaces)]

    def sources(self) -> list[str]:
        """Where the tolerances come from, each once."""
        return list(dict.fromkeys(_first(row.source for row in self.rows)))


def _first(sources: Iterable[str]) -> Iterable[str]:
    """The first of the sources of each row; lines of a file are that file."""
    return (_LINE.sub("", source.partition(";")[0]) for source in sources if source)


def _largest(row: Tolerance) -> float:
    return max(abs(row.minimum), abs(row.maximum))
