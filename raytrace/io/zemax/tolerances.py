"""Tolerances of a .zmx file: the lines behind its merit function, as rows.

    TOL TRAD   1   0           -0.2            0.2   0 0 0        operand, two whole numbers, minimum, maximum, a third
    TCMM Default radius tolerances.                               comment on the line above

As OpticStudio's help has them, in the unit of length of the file, degrees and fringes at TWAV's wavelength:

    COMP surface code       compensator: 0 thickness, 1 curvature, 2 conic
    CPAR surface parameter  compensator: PARM of a surface; CMCO row configuration: an operand of configurations
    TWAV 0 0 µm             wavelength of fringes
    TTHI surface adjuster   the adjuster's thickness changes by the opposite; none if it is the surface itself
    TEDX first last         of an element; TETX … about the vertex of its first surface, or the pivot of MPVT
    TSDR surface            decentre in a random direction; TEDR first last: of an element
    TARX first last seat    roll of an element about the centre of curvature of its seat, the first surface where it is
                            0: TARX, TARY by an angle about x, y; TRLX, TRLY by a decentre of the vertex of the seat
                            along x, y; TARR, TRLR in a random direction
    TEZI surface most - … least   Noll's terms from the third whole number (2 where it is 0) to the second; their RMS is
                            the maximum, and each has the share RMS/√terms
    TEXI surface most - … least   fringe terms likewise; the root of the sum of their squares at the rim is the maximum,
                            in fringes
    TIRR surface            and an angle of its astigmatism, which is uniform
    MPVT code               pivot of the tilts of elements below: 0, 1 the vertex of the first, the last surface, 2, 3
                            their edges, 4 the middle between the vertices
    STAT n sigmas           distribution of the lines below: 0 normal, 1 uniform, 2 parabolic, 3 a table, whose file the
                            comment names: x from 0 to 1 between the limits, and the density there
    SAVE number             the lens of the line above is saved under that number

Components of a radial decentre and the terms of one irregularity are a group: at its limits, all are at once.
Every other operand is listed with the reason why it is not read.

`written_lines` are the lines of rows. A comment `raytrace: …` has what they cannot hold: that two components are a
radial error, and the source of a row.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

from raytrace.io.source import LensFileError, Place, Record, is_number, plain
from raytrace.io.zemax.surfaces import in_millimetres, type_of, types
from raytrace.materials.glass import abbe_number
from raytrace.system.configurations import count
from raytrace.system.dimensions import power_at
from raytrace.system.lens import Lens
from raytrace.system.parameter_paths import modelled, path_of
from raytrace.system.shapes import EVEN
from raytrace.system.shapes import KINDS as KINDS_OF_SAG
from raytrace.system.surface import is_even, sag_at
from raytrace.system.tolerance_data import KINDS, MOST_TERM, TEST_WAVELENGTH, Compensator, Tolerance

#: Kinds by their operands; those with further rules are read by functions.
_KINDS = {operand: name for name, kind in KINDS.items() for operand in kind.operand.split()}
_DISTRIBUTIONS = {0: "normal", 1: "uniform", 2: "parabolic", 3: "table"}
_COMPENSATORS = {0: "thickness", 1: "curvature", 2: "conic"}
_BREAKS = {"TUDX": "x", "TUDY": "y", "TUTX": "tilt_x", "TUTY": "tilt_y", "TUTZ": "tilt_z"}
#: Rolls of an element: the axis of the angle, or of the decentre, and whether the limits are an angle.
_ROLLS = {"TARX": ("x", True), "TARY": ("y", True), "TRLX": ("x", False), "TRLY": ("y", False)}
#: Components of the operands whose direction is random.
_RADIAL = {"TSDR": ("TSDX", "TSDY"), "TEDR": ("TEDX", "TEDY"), "TRLR": ("TRLX", "TRLY"), "TARR": ("TARX", "TARY")}
#: Terms of irregularity: the kind of a row, and the power of length of its limits.
_TERMS = {"TEZI": ("zernike", 1), "TEXI": ("fringe", 0)}
_SIGMAS = 2.0
#: Comments on the line above: "raytrace: radial; source" of both components of a radial error without an operand.
_OURS, _LINKED = "raytrace:", "radial"

#: Operands that are known and not read, with the reason.
_UNREAD = {
    "TOFF": "off",
    "NOP": "off",
    "TSDI": "a semi-diameter clips no ray by itself",
    **dict.fromkeys(("ISOA", "ISOB", "ISOC", "ISOD"), "figure by ISO 10110-5; TFRN, TIRR and TEZI are read"),
    "TPAI": "the inverse of a parameter",
    "TEDV": "an extra datum",
    "TNPA": "a parameter of non-sequential objects",
    "TNPS": "a position of a non-sequential object",
    "TNMA": "material of a non-sequential object",
    "TMCS": "a multi-configuration offset",
    "TCMU": "a coating",
    "TCIO": "a coating",
    "TCEO": "a coating",
    "CEDV": "an extra datum",
    "CNPA": "a parameter of non-sequential objects",
    "CNPS": "a position of a non-sequential object",
    "SEED": "the seed is an option of the Monte Carlo analysis",
}


class ToleranceLines(NamedTuple):
    """The tolerances of a file: rows, compensators, wavelength in µm, saved rows (row, number), and lines not read."""

    rows: tuple[Tolerance, ...]
    compensators: tuple[Compensator, ...]
    test_wavelength: float
    saves: tuple[tuple[int, int], ...]
    unread: tuple[str, ...]


def read_lines(lens: Lens, lines: Sequence[str], file: str = "", numbers: Sequence[int] = ()) -> ToleranceLines:
    """The tolerances of the lines of a lens (`OptimizationData.tolerances`).

    numbers: their lines in the file, for messages. Raises LensFileError naming file, line and operand.
    """
    reader = _Reader(lens)
    for k, line in enumerate(lines):
        keyword, *words = line.split()
        if keyword != "TOL" or not words:
            continue  # a comment on the line above
        place = Place(file or "tolerance line", numbers[k] if k < len(numbers) else k + 1)
        comment, _, text = (*lines[k + 1 : k + 2], "")[0].partition(" ")
        reader.read(Record(words[0], tuple(words[1:]), line, place), text.strip() if comment == "TCMM" else "")
    return reader.result()


def _words_of(comment: str) -> tuple[bool, str]:
    """Whether a row is a component of a radial error, and its source; of a comment that is not ours False and ""."""
    if not comment.startswith(_OURS):
        return False, ""
    words = comment.removeprefix(_OURS).strip()
    first, _, others = words.partition("; ")
    return (True, others) if first == _LINKED else (False, words)


def _source(record: Record) -> str:
    """File name and line."""
    return f"{PurePath(record.place.file).name}:{record.place.line}"


class _Reader:
    """The rows while lines are read; drawn: the distribution of the last STAT; pivot: the code of the last MPVT."""

    def __init__(self, lens: Lens) -> None:
        self.lens, self.data = lens, lens.optimization_data
        self.unit = 1.0 if self.data is None else self.data.unit
        self.drawn: dict[str, Any] = {"distribution": "normal", "sigmas": _SIGMAS}
        self.wavelength, self.pivot = TEST_WAVELENGTH, 0
        self.rows: list[Tolerance] = []
        self.compensators: list[Compensator] = []
        self.saves: list[tuple[int, int]] = []
        self.unread: list[str] = []

    def result(self) -> ToleranceLines:
        rows = tuple(self.rows)
        return ToleranceLines(rows, tuple(self.compensators), self.wavelength, tuple(self.saves), tuple(self.unread))

    def read(self, record: Record, comment: str = "") -> None:
        name, count = record.keyword, len(self.rows)
        if name == "TWAV":
            self.wavelength = self._positive(record, 2, "test wavelength in µm")
        elif name == "STAT":
            self._statistics(record, comment)
        elif name == "SAVE":
            if self.rows:
                self.saves.append((len(self.rows) - 1, record.integer(0, "number of the file", 0)))
        elif name in ("COMP", "CPAR", "CMCO"):
            self._compensator(record)
        elif name == "TMCO":
            self._operand(record)
        elif name == "MPVT":
            self.pivot = record.integer(0, "pivot", 0)
            if self.pivot not in range(5):
                raise LensFileError(f"MPVT: pivot {self.pivot}, expected 0 to 4", record.place)
        elif name in _RADIAL:
            for component in _RADIAL[name]:
                self._motion(record, component, math.sqrt(0.5), group=_source(record))
        elif name in _TERMS:
            self._terms(record, *_TERMS[name])
        elif name == "TPAR" or name in _BREAKS:
            self._parameter(record)
        elif name in _KINDS or name in _ROLLS:
            self._motion(record, name)
        else:
            self._leave(record, _UNREAD.get(name, "an operand that is not known"))
        linked, source = _words_of(comment)
        self.rows[count:] = [_marked(row, linked, source) for row in self.rows[count:]]

    def _leave(self, record: Record, reason: str) -> None:
        self.unread.append(f"{record.place}: {record.keyword}: {reason}")

    def _add(self, record: Record, kind: str, surfaces: tuple[int, ...], low: float, high: float, **more: Any) -> None:
        if low > high:
            raise LensFileError(f"{record.keyword}: minimum {low:g} above maximum {high:g}", record.place)
        self.rows.append(Tolerance(kind, surfaces, low, high, **({**self.drawn, "source": _source(record)} | more)))

    def _limits(self, record: Record, power: int = 0) -> tuple[float, float]:
        low, high = record.number(2, "minimum"), record.number(3, "maximum")
        return in_millimetres(low, power, self.unit), in_millimetres(high, power, self.unit)

    def _surface(self, record: Record, position: int, last: int | None = None) -> int:
        k = record.integer(position, "surface")
        last = len(self.lens.surfaces) - 1 if last is None else last
        if not 0 <= k <= last:
            raise LensFileError(f"{record.keyword}: surface {k}; this lens has surfaces 0 to {last}", record.place)
        return k

    def _positive(self, record: Record, position: int, quantity: str) -> float:
        number = record.number(position, quantity)
        if not number > 0:
            raise LensFileError(f"{record.keyword}: {quantity} is {number:g}, expected more than 0", record.place)
        return number

    def _motion(self, record: Record, operand: str, part: float = 1.0, **more: Any) -> None:
        """A row by the rule of an operand, with a part of the limits."""
        if operand in _ROLLS:
            self._roll(record, *_ROLLS[operand], part, **more)
        else:
            self._row(record, _KINDS[operand], part, **more)

    def _element(self, record: Record) -> tuple[int, int]:
        first = self._surface(record, 0)
        last = self._surface(record, 1) or first
        if last < first:
            raise LensFileError(f"{record.keyword}: last surface {last} before {first}", record.place)
        return first, last

    def _depth(self, first: int, k: int) -> float:
        """The distance of the vertex of a surface behind that of the first, mm."""
        return sum(float(surface.thickness) for surface in self.lens.surfaces[first:k])

    def _pivot(self, record: Record, first: int, last: int) -> float:
        """The distance of the pivot of the last MPVT behind the vertex of the first surface, mm."""
        whole = self._depth(first, last)
        if self.pivot in (0, 1, 4):
            return {0: 0.0, 1: whole, 4: 0.5 * whole}[self.pivot]
        k, vertex = (first, 0.0) if self.pivot == 2 else (last, whole)
        h = self.lens.surfaces[k].semi_diameter
        if h is None:
            raise LensFileError(f"MPVT: surface {k} has no semi-diameter (DIAM), and no edge", record.place)
        edge = self.lens.wavelengths.new_tensor(h)
        return vertex + float(sag_at(self.lens.surfaces[k], 0 * edge, edge))

    def _roll(self, record: Record, axis: str, is_angle: bool, part: float, **more: Any) -> None:
        """A roll on a spherical seat is a tilt about its centre of curvature; on a plane it is a decentre."""
        first, last = self._element(record)
        seat = record.integer(4, "seat", 0) or first
        if not first <= seat <= last:
            message = f"{record.keyword}: the seat, surface {seat}, is not one of the element {first} to {last}"
            raise LensFileError(message, record.place)
        low, high = (part * limit for limit in self._limits(record, 0 if is_angle else 1))
        surface, kind = self.lens.surfaces[seat], f"element_tilt_{axis}"
        radius = math.inf if surface.is_plane else float(surface.radius)
        if math.isinf(radius):
            if is_angle:
                return self._leave(record, f"a roll by an angle on the plane surface {seat}")
            kind = f"element_decenter_{axis}"
        else:
            more["pivot"] = self._depth(first, seat) + radius
            if not is_angle:
                if max(abs(low), abs(high)) > abs(radius):
                    message = f"{record.keyword}: a decentre beyond the radius {radius:g} mm of surface {seat}"
                    raise LensFileError(message, record.place)
                kind, sign = ("element_tilt_y", -1) if axis == "x" else ("element_tilt_x", 1)
                low, high = sorted(sign * math.degrees(math.asin(limit / radius)) for limit in (low, high))
        self._add(record, kind, (first, last), low, high, **more)

    def _row(self, record: Record, kind: str, part: float, **more: Any) -> None:
        low, high = (part * limit for limit in self._limits(record, KINDS[kind].length))
        first = self._surface(record, 0)
        surfaces: tuple[int, ...] = (first,)
        if KINDS[kind].elements:
            surfaces = first, last = self._element(record)
            if kind.startswith("element_tilt") and (pivot := self._pivot(record, first, last)):
                more["pivot"] = pivot
        elif kind == "thickness":
            adjuster = self._surface(record, 1, len(self.lens.surfaces) - 2)
            more |= {} if adjuster == first else {"adjust": adjuster}
        elif kind == "radius" and record.integer(1, "unit", 0) == 1:  # in % of the radius
            (low, high), more["unit"] = self._limits(record), "%"
        if kind == "irregularity_angle":
            kind = "irregularity"
        self._add(record, kind, surfaces, low, high, **more)
        if kind == "irregularity":
            self._add(record, "irregularity_angle", surfaces, -90.0, 90.0, distribution="uniform")

    def _statistics(self, record: Record, comment: str) -> None:
        code, sigmas = record.integer(0, "distribution", 0), record.number(1, "standard deviations", 0.0)
        if code not in _DISTRIBUTIONS:
            raise LensFileError(f"STAT: distribution {code}, expected 0 to 3", record.place)
        if sigmas < 0:
            raise LensFileError(f"STAT: {sigmas:g} standard deviations, expected more than 0", record.place)
        tables = dict(self.data.distributions) if self.data else {}
        if _DISTRIBUTIONS[code] == "table" and comment not in tables:
            kept = self.drawn["distribution"]
            self._leave(
                record, f"the table {comment or '(no comment names it)'} is not beside the file; {kept} is kept"
            )
            return
        self.drawn = {"distribution": _DISTRIBUTIONS[code], "sigmas": sigmas or _SIGMAS}
        if _DISTRIBUTIONS[code] == "table":
            self.drawn["density"] = tables[comment]

    def _compensator(self, record: Record) -> None:
        ends = {"minimum": record.number(2, "minimum", 0.0), "maximum": record.number(3, "maximum", 0.0)}
        limits: dict[str, Any] = {name: number for name, number in ends.items() if number}
        source = _source(record)
        if record.keyword == "CMCO":
            operand, configuration = self._place_of_operand(record)
            number = self.lens.operands[operand].number
            compensator = Compensator(number, configuration=configuration, operand=operand, source=source, **limits)
        elif record.keyword == "CPAR":
            place = self._name(record)
            if place is None:
                return
            k, name, scale = place
            limits = {key: number * scale for key, number in limits.items()}
            compensator = Compensator(k, name, source=source, **limits)
        else:
            k, code = self._surface(record, 0), record.integer(1, "code", 0)
            if code not in _COMPENSATORS:
                self._leave(record, f"compensator {code}; expected 0 (thickness), 1 (curvature) or 2 (conic)")
                return
            name = _COMPENSATORS[code]
            power = {"thickness": 1, "curvature": -1, "conic": 0}[name]
            limits = {key: in_millimetres(number, power, self.unit) for key, number in limits.items()}
            compensator = Compensator(k, name, source=source, **limits)
        self.compensators.append(compensator)

    def _place_of_operand(self, record: Record) -> tuple[int, int]:
        row, configuration = record.integer(0, "row of the operands"), record.integer(1, "configuration")
        operands, most = self.lens.operands, count(self.lens.operands)
        if not 1 <= row <= len(operands):
            message = f"row {row}; this lens has {len(operands)} operands of configurations"
            raise LensFileError(f"{record.keyword}: {message}", record.place)
        if not 1 <= configuration <= most:
            message = f"configuration {configuration}; this lens has configurations 1 to {most}"
            raise LensFileError(f"{record.keyword}: {message}", record.place)
        return row - 1, configuration

    def _operand(self, record: Record) -> None:
        operand, configuration = self._place_of_operand(record)
        held = self.lens.operands[operand]
        if held.numbers is None:
            self._leave(record, f"operand {held} is no number")
            return
        path = held.paths[0].path if held.paths else ()
        power = {"thickness": 1, "curvature": -1}.get(str(path[2]), 0) if len(path) == 3 else 0
        power = 1 if path[-1:] in (("x",), ("y",)) and "before" in path else power
        low, high = self._limits(record, power)
        surfaces = (held.number,) if held.number else ()
        self._add(record, "operand", surfaces, low, high, operand=operand, configuration=configuration)

    def _terms(self, record: Record, kind: str, length: int) -> None:
        k, most = self._surface(record, 0), record.integer(1, "highest term")
        size, least = self._limits(record, length)[1], record.integer(4, "lowest term", 0) or 2
        if not 2 <= least <= most <= MOST_TERM[kind]:
            message = f"terms {least} to {most}, expected numbers from 2 to {MOST_TERM[kind]}"
            raise LensFileError(f"{record.keyword}: {message}", record.place)
        if size < 0:
            raise LensFileError(f"{record.keyword}: a maximum of {size:g}, expected 0 or more", record.place)
        share = size / math.sqrt(most - least + 1)
        more = {"distribution": "end_points", "group": _source(record) if most > least else ""}
        for term in range(least, most + 1):
            self._add(record, kind, (k,), -share, share, term=term, **more)

    def _parameter(self, record: Record) -> None:
        if record.keyword in _BREAKS:
            k, name = self._surface(record, 0), _BREAKS[record.keyword]
            if not self.lens.surfaces[k].is_break:
                message = f"surface {k} is no coordinate break; TEDX … and TETX … move others"
                raise LensFileError(f"{record.keyword}: {message}", record.place)
            length = name in ("x", "y")
            low, high = self._limits(record, int(length))
            self._add(record, "parameter", (k,), low, high, parameter=name, unit="mm" if length else "degrees")
            return
        place = self._name(record)
        if place is None:
            return
        k, name, scale = place
        low, high = sorted(number * scale for number in self._limits(record))
        unit = "degrees" if name.startswith("tilt") else "mm" if name in ("x", "y", "z") else ""
        self._add(record, "parameter", (k,), low, high, parameter=name, unit=unit)

    def _name(self, record: Record) -> tuple[int, str, float] | None:
        """Surface and name of PARM j, and the number of the lens in that of the file; None: it is not read."""
        k, j = self._surface(record, 0), record.integer(1, "parameter")
        surface = self.lens.surfaces[k]
        row = types().get(type_of(surface) or "")
        if row is not None:
            numbers = row.numbers(surface)._replace(size=surface.semi_diameter)
            names, _ = row.names(surface, numbers, "PARM", j)
            power = row.power("PARM", j)
            if len(names) == 1 and isinstance(power, int):
                (name, factor), *_ = names.items()
                return k, name, factor * in_millimetres(1.0, power, self.unit)
        if is_even(surface) and surface.kind == EVEN and 1 <= j <= KINDS_OF_SAG[EVEN].parameters:
            return k, f"a{2 * j}", in_millimetres(1.0, 1 - 2 * j, self.unit)
        self._leave(record, f"parameter {j} of surface {k} is no single number of the lens")
        return None


def _marked(row: Tolerance, linked: bool, source: str) -> Tolerance:
    """A row with what our comment on its line states."""
    row = dataclasses.replace(row, source=source) if source else row
    return dataclasses.replace(row, group=f"{row.kind[:-2]}_radial of {row.where}") if linked else row


# -- lines of rows -----------------------------------------------------------------------------------------------------

_CODES = {name: code for code, name in _DISTRIBUTIONS.items()}
_RADIAL_OPERANDS = {"surface_decenter": "TSDR", "element_decenter": "TEDR"}
_TERM_OPERANDS = {kind: operand for operand, (kind, _) in _TERMS.items()}
_BREAK_OPERANDS = {name: operand for operand, name in _BREAKS.items()}
_MOST_PARAMETER = 30  # of PARM


class Unwritable(ValueError):
    """A row or a compensator that has no line."""


def written_lines(
    lens: Lens,
    rows: Sequence[Tolerance],
    compensators: Sequence[Compensator] = (),
    test_wavelength: float = TEST_WAVELENGTH,
) -> tuple[str, ...]:
    """The lines of rows of a lens (`OptimizationData.tolerances`): `read_lines` reads them back.

    An Abbe number in % is written as a number. A radial tilt or runout is two lines, each with a comment. Raises
    Unwritable for a row that OpticStudio has no operand for.
    """
    writer = _Writer(lens)
    writer.line("TWAV", 0, 0, test_wavelength, 0.0)
    for compensator in compensators:
        writer.compensator(compensator)
    groups: dict[str, list[Tolerance]] = {}
    for n, row in enumerate(rows):
        groups.setdefault(row.group or str(n), []).append(row)
    for group in groups.values():
        writer.rows(group, rows)
    return tuple(writer.lines)


class _Writer:
    """The lines while rows are written; drawn: the distribution and pivot: the code of the lines above."""

    def __init__(self, lens: Lens) -> None:
        self.lens, self.lines = lens, list[str]()
        self.unit = 1.0 if lens.optimization_data is None else lens.optimization_data.unit
        self.reader = _Reader(lens)
        self.drawn, self.pivot = ("normal", _SIGMAS), 0

    def line(self, name: str, first: int, second: int, low: float, high: float, third: int = 0) -> None:
        limits = " ".join(repr(float(limit)) for limit in (low, high))
        self.lines.append(f"TOL {name} {first} {second} {limits} {third} 0 0")

    def comment(self, row: Tolerance, *, linked: bool = False) -> None:
        words = "; ".join(([_LINKED] if linked else []) + ([row.source] if row.source else []))
        if words:
            self.lines.append(f"TCMM {_OURS} {words}")

    def of_file(self, number: float, power: int) -> float:
        """A number of the lens in the unit of its file."""
        return number / in_millimetres(1.0, power, self.unit)

    def rows(self, group: Sequence[Tolerance], every: Sequence[Tolerance]) -> None:
        """The lines of a group of rows, or of one row."""
        first = group[0]
        if first.kind == "irregularity_angle":
            usual = (first.minimum, first.maximum, first.distribution) == (-90.0, 90.0, "uniform")
            if not usual or not any(row.kind == "irregularity" and row.surfaces == first.surfaces for row in every):
                raise Unwritable(f"{first}: a .zmx file has the angle of an irregularity, from -90 to 90 degrees, only")
            return
        if first.kind in _TERM_OPERANDS:
            return self._terms(group)
        self._statistics(first)
        name, along = first.kind[:-2], [row.kind[-2:] for row in group]
        if len(group) == 2 and along == ["_x", "_y"] and name in _RADIAL_OPERANDS:
            k, last = first.surfaces[0], first.surfaces[-1]
            whole = [self.of_file(math.sqrt(2) * limit, 1) for limit in (first.minimum, first.maximum)]
            self.line(_RADIAL_OPERANDS[name], k, last if KINDS[first.kind].elements else 0, whole[0], whole[1])
            return self.comment(first)
        if len(group) > 1 and (len(group) > 2 or along != ["_x", "_y"]):
            raise Unwritable(f"{first}: a group of {len(group)} errors, which no operand of a .zmx file has")
        for row in group:
            self._row(row)
            self.comment(row, linked=len(group) == 2)

    def _statistics(self, row: Tolerance) -> None:
        if row.distribution not in _CODES or row.distribution == "table":
            known = ", ".join(name for name in _CODES if name != "table")
            raise Unwritable(f"{row}: the distribution {row.distribution!r}; a .zmx file has {known}")
        drawn = row.distribution, row.sigmas if row.distribution == "normal" else _SIGMAS
        if drawn != self.drawn:
            self.drawn = drawn
            self.lines.append(f"TOL STAT {_CODES[drawn[0]]} {drawn[1]:g} 0.0 0.0 0 0 0")

    def _row(self, row: Tolerance) -> None:
        kind, k, second = KINDS[row.kind], (*row.surfaces, 0)[0], 0
        name, power = kind.operand, kind.length
        if row.kind == "operand":
            name, k, second = "TMCO", (row.operand or 0) + 1, row.configuration
            power = ToleranceLine(name, (k, second, 0)).power(self.lens) or 0
        elif row.kind == "parameter":
            name, second, factor = self._parameter(row)
            ends = sorted(limit / factor for limit in (row.minimum, row.maximum))
            return self.line(name, k, second, ends[0], ends[1])
        elif kind.elements:
            second = row.surfaces[-1]
            self._pivot(row)
        elif row.kind == "thickness":
            second = k if row.adjust is None else row.adjust
        elif row.kind == "radius" and row.unit == "%":
            second, power = 1, 0
        if not name:
            raise Unwritable(f"{row}: OpticStudio has no operand for it")
        part = 1.0
        if row.kind == "abbe" and row.unit == "%":
            part = float(abbe_number(self.lens.surfaces[k].glass)) / 100
        low, high = (self.of_file(part * limit, power) for limit in (row.minimum, row.maximum))
        self.line(name, k, second, low, high)

    def _pivot(self, row: Tolerance) -> None:
        """MPVT, where a tilt has another pivot than the lines above."""
        if not row.kind.startswith("element_tilt"):
            return
        first, last = row.surfaces[0], row.surfaces[-1]
        record = Record("MPVT", (), "", Place("tolerance line"))
        for code in (self.pivot, 0, 1, 4, 2, 3):
            self.reader.pivot = code
            if code in (2, 3) and self.lens.surfaces[first if code == 2 else last].semi_diameter is None:
                continue
            if math.isclose(self.reader._pivot(record, first, last), row.pivot, rel_tol=1e-9, abs_tol=1e-9):
                break
        else:
            raise Unwritable(f"{row}: the pivot {row.pivot:g} mm is neither a vertex, an edge nor the middle")
        if code != self.pivot:
            self.pivot = code
            self.line("MPVT", code, 0, 0.0, 0.0)

    def _parameter(self, row: Tolerance) -> tuple[str, int, float]:
        """Operand, second whole number and scale of a row of a parameter."""
        k = row.surfaces[0]
        if self.lens.surfaces[k].is_break and row.parameter in _BREAK_OPERANDS:
            length = row.parameter in ("x", "y")
            return _BREAK_OPERANDS[row.parameter], 0, in_millimetres(1.0, int(length), self.unit)
        return ("TPAR", *self._place(k, row.parameter, str(row)))

    def _place(self, k: int, name: str, words: str) -> tuple[int, float]:
        """The number j of PARM that holds a parameter, and its scale."""
        for j in range(1, _MOST_PARAMETER):
            place = self.reader._name(Record("TPAR", (str(k), str(j)), "", Place("tolerance line")))
            if place is not None and place[1] == name:
                return j, place[2]
        raise Unwritable(f"{words}: {name} of surface {k} is no parameter of a .zmx file")

    def _terms(self, group: Sequence[Tolerance]) -> None:
        first, terms = group[0], sorted(row.term for row in group)
        alike = all(
            (row.kind, row.surfaces, row.maximum) == (first.kind, first.surfaces, first.maximum) for row in group
        )
        even = all(row.distribution == "end_points" and row.minimum == -row.maximum for row in group)
        if not (alike and even and terms == [*range(terms[0], terms[-1] + 1)]):
            message = "a .zmx file has terms in a row with equal limits ± and the distribution 'end_points'"
            raise Unwritable(f"{first}: {message}")
        operand = _TERM_OPERANDS[first.kind]
        size = self.of_file(math.sqrt(len(terms)) * first.maximum, _TERMS[operand][1])
        self.line(operand, first.surfaces[0], terms[-1], 0.0, size, terms[0])
        self.comment(first)

    def compensator(self, item: Compensator) -> None:
        limits = [0.0 if math.isinf(limit) else limit for limit in (item.minimum, item.maximum)]
        codes = {name: code for code, name in _COMPENSATORS.items()}
        if item.operand is not None:
            name, first, second, scale = "CMCO", item.operand + 1, item.configuration, 1.0
        elif item.parameter in codes:
            name, first, second = "COMP", item.surface, codes[item.parameter]
            scale = in_millimetres(1.0, {"thickness": 1, "curvature": -1, "conic": 0}[item.parameter], self.unit)
        else:
            name, first = "CPAR", item.surface
            second, scale = self._place(item.surface, item.parameter, f"compensator {item}")
        low, high = (limit / scale for limit in (limits if scale > 0 else limits[::-1]))
        self.line(name, first, second, low, high)


# -- lines of a lens that is edited ------------------------------------------------------------------------------------

#: What the whole numbers of a line number, where they are not a surface alone: a gap by the surface before it, the
#: surfaces of an element, its seat, an operand of the configurations.
_ARGUMENTS = {
    **dict.fromkeys(("TIND", "TABB"), ("gap", "", "")),
    "TTHI": ("gap", "gap", ""),
    **dict.fromkeys(("TEDX", "TEDY", "TETX", "TETY", "TETZ", "TEDR"), ("element", "", "")),
    **dict.fromkeys((*_ROLLS, "TRLR", "TARR"), ("element", "", "surface")),
    **dict.fromkeys(("TMCO", "CMCO"), ("operand", "", "")),
    **dict.fromkeys(("TOFF", "NOP", "TWAV", "STAT", "SAVE", "MPVT", "SEED"), ("", "", "")),
}
_MIRRORED = ("x", "z", "tilt_x", "tilt_z")  # motions that change their sign with a turn about y


@dataclasses.dataclass(frozen=True)
class ToleranceLine:
    """A line of a tolerance: its operand, its three whole numbers, its limits, and its words as they are written."""

    name: str
    integers: tuple[int, int, int]
    limits: tuple[float, float] = (0.0, 0.0)
    words: tuple[str, ...] = ("0", "0", "0", "0", "0", "0", "0")

    @staticmethod
    def of(words: Sequence[str]) -> "ToleranceLine | None":
        """The line of the words behind TOL; None where they are no such line."""
        written = (*words[1:], *("0",) * max(0, 5 - len(words[1:])))
        if not all(map(is_number, written[:5])):
            return None
        first, second, low, high, third = map(plain, written[:5])
        return ToleranceLine(words[0], (int(first), int(second), int(third)), (low, high), written)

    def __str__(self) -> str:
        return " ".join([self.name, *self._written()[:2]])

    def _written(self) -> list[str]:
        """The words; those of numbers that have not changed are as they were."""
        (first, second, third), (low, high) = self.integers, self.limits
        numbers = (first, second, low, high, third)
        changed = [
            word if plain(word) == number else repr(number) for word, number in zip(self.words, numbers, strict=False)
        ]
        return [*changed, *self.words[5:]]

    def line(self) -> str:
        return " ".join(["TOL", self.name, *self._written()])

    @property
    def arguments(self) -> tuple[str, str, str]:
        """What its whole numbers number."""
        if self.name == "COMP" and self.integers[1] == 0:
            return "gap", "", ""
        return _ARGUMENTS.get(self.name, ("surface", "", ""))

    @property
    def has_pivot(self) -> bool:
        """Whether it tilts an element about the pivot of MPVT."""
        return self.name in ("TETX", "TETY")

    def negated(self) -> "ToleranceLine":
        """The line of the errors of opposite sign."""
        low, high = self.limits
        return dataclasses.replace(self, limits=(0.0 - high, 0.0 - low))

    def scaled(self, factor: float) -> "ToleranceLine":
        """The line with limits that are so many times as large."""
        low, high = self.limits
        return dataclasses.replace(self, limits=(low * factor, high * factor))

    def sign(self, lens: Lens, of_number: Callable[[int, str], float]) -> float:
        """-1 where the error has the opposite sign on a surface that is turned around; of_number: surface, name."""
        if (name := self.quantity(lens)) is not None:
            return of_number(self.integers[0], name)
        if self.name in _ROLLS:
            return -1.0 if _ROLLS[self.name][0] in _MIRRORED else 1.0
        kind = _KINDS.get(self.name, "")
        is_percent = kind == "radius" and self.integers[1] == 1
        is_of_sag = kind in ("radius", "power", "curvature", "irregularity", "irregularity_angle") and not is_percent
        return -1.0 if is_of_sag or (kind in KINDS and KINDS[kind].motion in _MIRRORED) else 1.0

    def power(self, lens: Lens) -> int | None:
        """The power of length in its limits; None where it is not known."""
        if self.arguments[0] == "operand":
            number, _, _ = self.integers
            held = lens.operands[number - 1] if 1 <= number <= len(lens.operands) else None
            return power_at(lens, held.paths[0].path) if held is not None and held.paths else None
        if self.name in ("TPAR", "CPAR", "COMP") or self.name in _BREAKS:
            name, k = self.quantity(lens), self.integers[0]
            if name is None or not 0 <= k < len(lens.surfaces):
                return None
            surface = modelled(lens.surfaces[k], name)
            return power_at(surface, path_of(surface, name).steps)
        if self.name in _ROLLS or self.name in _RADIAL:
            return 0 if self.name in ("TARX", "TARY", "TARR") else 1
        kind = _TERMS.get(self.name, (_KINDS.get(self.name, ""),))[0]
        if kind not in KINDS:
            return None if self.arguments[0] and any(self.limits) else 0
        return 0 if kind == "radius" and self.integers[1] == 1 else KINDS[kind].length

    def quantity(self, lens: Lens) -> str | None:
        """The name of the number of the lens that it changes, of COMP, CPAR, TPAR and TUDX; None for others."""
        if self.name in _BREAKS:
            return _BREAKS[self.name]
        if self.name == "COMP":
            return _COMPENSATORS.get(self.integers[1])
        if self.name not in ("TPAR", "CPAR") or not 0 <= self.integers[0] < len(lens.surfaces):
            return None
        place = _Reader(lens)._name(Record(self.name, self.words, "", Place("tolerance line")))
        return None if place is None else place[1]


def rewritten(lines: Sequence[str], change: Callable[[ToleranceLine], Sequence[ToleranceLine]]) -> tuple[str, ...]:
    """The lines of tolerances, each changed to others, or to none; a comment belongs to the line above it."""
    kept: list[str] = []
    is_left = True
    for text in lines:
        keyword, *words = text.split()
        line = ToleranceLine.of(words) if keyword == "TOL" and words else None
        if line is not None:
            new = change(line)
            is_left = bool(new)
            kept += [text if other == line else other.line() for other in new]
        elif keyword == "TOL" or is_left:
            kept.append(text)
    return tuple(kept)
