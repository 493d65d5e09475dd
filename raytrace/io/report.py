"""The import report: what a reader did with every keyword of a lens file."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor

from raytrace.io.source import LensFileError, Place
from raytrace.io.substitutes import NONE, Substitutes
from raytrace.maths.result import Result
from raytrace.maths.value import value
from raytrace.system.conditions import RAY_AIMING
from raytrace.system.dimensions import DIMENSION
from raytrace.system.optimization_data import Row

READ, IGNORED, UNKNOWN = "read", "ignored", "unknown"
_TITLES = {READ: "read", IGNORED: "known and ignored", UNKNOWN: "unknown"}

#: A keyword met a thousand times is listed with its first lines only.
_LISTED = 8


@dataclass(frozen=True)
class Keyword:
    """What was done with one keyword (or column, or header line) of a file.

    status: "read", "ignored" (known, and left out for `reason`) or "unknown".
    count: how often it was met; lines: the first of them; surfaces: the first surfaces that carry it.
    """

    name: str
    status: str
    count: int
    lines: tuple[int, ...]
    surfaces: tuple[int, ...]
    reason: str = ""

    def __str__(self) -> str:
        if self.status == READ:
            return f"{self.name} x{self.count}"
        where, times = ("line", "") if self.count == 1 else ("lines", f" x{self.count}")
        listed = ", ".join(map(str, self.lines)) + (", …" if self.count > len(self.lines) else "")
        place = f" ({where} {listed})" if self.lines else ""
        return f"{self.name}{times}{place}" + (f": {self.reason}" if self.reason else "")


@dataclass(frozen=True)
class GlassSource:
    """Where the medium behind a surface came from: a catalog, or "model glass", "MIL code", "constant index"."""

    surface: int
    name: str
    source: str

    def __str__(self) -> str:
        return f"surface {self.surface}: {self.name or '(unnamed)'}, {self.source}"


@dataclass(frozen=True)
class Varied:
    """What differs between the configurations of a lens: the operand, "THIC 6", and its value in each."""

    operand: str
    values: tuple

    def __str__(self) -> str:
        return f"{self.operand:<12} " + " ".join(f"{_short(one):>14}" for one in self.values)


#: What becomes of an operand of a merit function.
EVALUATED, KNOWN, UNKNOWN_OPERAND = "evaluated", "known, not evaluated", "unknown"


@dataclass(frozen=True)
class OperandUse:
    """How often an operand stands in the merit function of a file, with a weight and in all, and what becomes of it.

    status: "evaluated", "known, not evaluated" or "unknown"; of a file whose operands nobody evaluates "known".
    """

    name: str
    count: int
    weighted: int
    status: str

    def __str__(self) -> str:
        return f"{self.name} x{self.count}" + (f" ({self.weighted} with weight)" if self.weighted < self.count else "")


def operand_uses(merit: Sequence[Row], evaluated: Collection[str] | None) -> tuple[OperandUse, ...]:
    """The operands of a merit function by name; evaluated: the names of those that are."""
    found: dict[str, list[Row]] = {}
    for row in merit:
        found.setdefault(row.operand, []).append(row)
    return tuple(
        OperandUse(name, len(rows), sum(row.weight != 0 for row in rows), _status(name, evaluated))
        for name, rows in found.items()
    )


def _status(name: str, evaluated: Collection[str] | None) -> str:
    if evaluated is not None and name in evaluated:
        return EVALUATED
    if name not in DIMENSION:
        return UNKNOWN_OPERAND
    return KNOWN if evaluated is not None else "known"


def _short(one: object) -> str:
    return f"{one:.9g}" if isinstance(one, float) else "-" if one is None else str(one)[:14] or '""'


#: Keys that a document has only where there is something to say.
_WHERE_THERE_ARE_SOME = ("configurations", "variables", "solves", "kept", "operands", "tolerances", "geometry")


@value
class ImportReport(Result):
    """What became of a lens file: every keyword met, where each glass came from, notes and warnings.

    A note says what was done where the file leaves a choice; a warning says what was assumed or lost, and is an
    error when the file is read with `strict=True`. surfaces, stop_surface, primary_wavelength (its
    number, from 1), wavelengths (µm), ray_aiming: of the lens that was read.
    configurations: what differs between those of a multi-configuration file.
    variables, solves, kept: of `Lens.optimization_data`, in words; operands: of the merit; tolerances: its lines.
    geometry: surfaces and gaps that cannot be made.
    """

    file: str
    format: str
    keywords: tuple[Keyword, ...] = ()
    glasses: tuple[GlassSource, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    surfaces: int = 0
    stop_surface: int = 0
    primary_wavelength: int = 1
    wavelengths: tuple[float, ...] = ()
    ray_aiming: str = ""
    configurations: tuple[Varied, ...] = ()
    variables: tuple[str, ...] = ()
    solves: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    operands: tuple[OperandUse, ...] = ()
    tolerances: int = 0
    geometry: tuple[str, ...] = ()

    def document(self) -> dict:
        return {name: one for name, one in asdict(self).items() if one or name not in _WHERE_THERE_ARE_SOME}

    def columns(self) -> dict[str, Tensor]:
        """A row for each keyword."""
        statuses = [list(_TITLES).index(keyword.status) for keyword in self.keywords]
        columns = {"keyword": range(len(statuses)), "status": statuses, "count": [one.count for one in self.keywords]}
        return {name: torch.tensor([*column]) for name, column in columns.items()}

    def words(self) -> dict[str, list[str]]:
        return {"keyword": [keyword.name for keyword in self.keywords], "status": [*_TITLES]}

    def __str__(self) -> str:
        lines = [f"{self.file} ({self.format})"]
        lines += [f"  warning: {warning}" for warning in (*self.warnings, *self.geometry)]
        lines += [f"  note: {note}" for note in self.notes]
        lines += self._conventions()
        for status, title in _TITLES.items():
            chosen = [str(keyword) for keyword in self.keywords if keyword.status == status]
            listed = _wrapped(chosen) if status == READ else [f"    {keyword}" for keyword in chosen]
            lines += [f"  {title}:", *listed] if chosen else []
        if self.configurations:
            numbers = " ".join(f"{k:>14}" for k in range(1, len(self.configurations[0].values) + 1))
            lines += ["  configurations:", f"    {'':<12} {numbers}", *(f"    {one}" for one in self.configurations)]
        lines += self._optimization_data()
        lines += ["  glasses:", *(f"    {use}" for use in self.glasses)] if self.glasses else []
        return "\n".join(lines)

    def _conventions(self) -> list[str]:
        """The primary wavelength and the ray aiming of the lens."""
        if not self.wavelengths:
            return []
        chosen, count = self.primary_wavelength, len(self.wavelengths)
        return [
            f"  primary wavelength: number {chosen} of {count}, {self.wavelengths[chosen - 1]:g} µm",
            f"  ray aiming: {self.ray_aiming} ({RAY_AIMING[self.ray_aiming]})",
        ]

    def _optimization_data(self) -> list[str]:
        """What the lens is to become, and the operands of its merit function by what becomes of them."""
        titled = {f"{len(self.variables)} variables": self.variables, "solves and pickups": self.solves}
        titled["rules that are kept and not followed"] = self.kept
        lines = [line for title, one in titled.items() if one for line in (f"  {title}:", *_wrapped(one))]
        if self.operands:
            lines.append(f"  merit function of {sum(one.count for one in self.operands)} lines:")
        for status in dict.fromkeys(one.status for one in self.operands):
            lines += [f"    {status}:", *_wrapped([str(one) for one in self.operands if one.status == status])]
        return [*lines, *([f"  tolerances: {self.tolerances} lines, kept"] if self.tolerances else [])]


def _wrapped(words: Iterable[str], width: int = 100) -> list[str]:
    lines, line = [], "   "
    for word in words:
        if len(line) + len(word) + 2 > width:
            lines.append(line)
            line = "   "
        line += f" {word},"
    return [*lines, line.rstrip(",")]


@dataclass
class Draft:
    """A report being written by a reader; `finished` makes the value.

    substitutes: of glasses, as asked for; substituted: the names of those that were, in capitals.
    """

    file: str
    format: str
    substitutes: Substitutes = NONE
    substituted: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    warnings: list[tuple[str, Place]] = field(default_factory=list)
    glasses: list[GlassSource] = field(default_factory=list)
    _met: dict[tuple[str, str], list[tuple[Place, str]]] = field(default_factory=dict)

    def again(self) -> "Draft":
        """A new report of the same file, for what is read once more."""
        return Draft(self.file, self.format, self.substitutes, self.substituted)

    def met(self, name: str, status: str, place: Place, reason: str = "") -> None:
        """Count one keyword."""
        self._met.setdefault((name, status), []).append((place, reason))

    def note(self, text: str) -> None:
        """Say what was done, with nothing lost."""
        if text not in self.notes:
            self.notes.append(text)

    def warn(self, text: str, place: Place) -> None:
        """Say what was assumed or lost at a place."""
        self.warnings.append((text, place))

    def glass(self, surface: int, name: str, source: str) -> None:
        """Say where a medium came from."""
        self.glasses.append(GlassSource(surface, name, source))

    def finished(self, *, strict: bool) -> ImportReport:
        """The report. Raises LensFileError for the first warning if `strict`."""
        keywords = [_keyword(name, status, met) for (name, status), met in self._met.items()]
        for one in keywords:
            if one.status == UNKNOWN:
                times = "" if one.count == 1 else f" ({one.count} times)"
                place = Place(self.file, one.lines[0] if one.lines else None)
                what = one.name if one.name.startswith("member ") else f"keyword {one.name}"
                self.warn(f"unknown {what}{times}: left out", place)
        for name in self.substitutes.named:
            if name not in self.substituted:
                self.warn(
                    f"a substitute for the glass {name} was asked for, which the file does not name", Place(self.file)
                )
        if strict and self.warnings:
            text, place = self.warnings[0]
            more = len(self.warnings) - 1
            also = f" (and {more} more warning{'s' if more > 1 else ''})" if more else ""
            raise LensFileError(f"{text}{also}; refused because strict reading was asked for", place)
        warnings = tuple(f"{place}: {text}" for text, place in self.warnings)
        return ImportReport(self.file, self.format, tuple(keywords), tuple(self.glasses), tuple(self.notes), warnings)


def _keyword(name: str, status: str, met: list[tuple[Place, str]]) -> Keyword:
    lines = [place.line for place, _ in met if place.line is not None]
    surfaces = dict.fromkeys(place.surface for place, _ in met if place.surface is not None)
    return Keyword(name, status, len(met), tuple(lines[:_LISTED]), tuple(surfaces)[:_LISTED], met[0][1])
