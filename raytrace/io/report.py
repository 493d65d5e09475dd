"""The import of a lens file: glass substitutes that were requested, and the report of every keyword.

A glass is never replaced without request. `substitute` is a mapping {"SSK4": "SSK4A"}, or words as on the command line,
"SSK4=SSK4A". "nearest" requests the glass of smallest

    d² = Δn_d² + (0.01 ΔV_d)²

relative to the nd and Vd stored in the file: for one unknown glass by name, or, alone, for every unknown glass.
"formula" accepts, for a glass of CODE V known by nd and Vd or by a few indices, indices at other wavelengths that a
formula estimates with an error above 1e-4.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor

from raytrace.io.source import LensFileError, Place
from raytrace.maths.result import Result
from raytrace.maths.value import value
from raytrace.system.dimensions import DIMENSION
from raytrace.system.lens import RAY_AIMING
from raytrace.system.optimization_data import Row

# -- substitutes ------------------------------------------------------------------------------------------------------

NEAREST, FORMULA = "nearest", "formula"


class BadSubstitute(ValueError):
    """A malformed substitute; the message has the value found and the value expected."""


@dataclass(frozen=True)
class Substitutes:
    """Requested substitutes: glass names by the name, in capitals, that they replace.

    nearest: replace every unknown glass; formula: accept estimated indices of every glass.
    """

    named: Mapping[str, str] = field(default_factory=dict)
    nearest: bool = False
    formula: bool = False

    def of(self, name: str) -> str | None:
        """The substitute of a glass: a name, NEAREST or FORMULA; None where none was requested."""
        return self.named.get(name.upper())

    def takes_formula(self, name: str) -> bool:
        """Whether estimated indices of a glass are accepted."""
        return self.formula or self.of(name) == FORMULA


NONE = Substitutes()


def substitutes_of(requested: Mapping[str, str] | str | Sequence[str] | None) -> Substitutes:
    """Substitutes of a mapping, or of words like SSK4=SSK4A and "nearest". Raises BadSubstitute."""
    if requested is None:
        return NONE
    if isinstance(requested, Mapping):
        pairs = list(requested.items())
    else:
        words = requested.split() if isinstance(requested, str) else list(requested)
        pairs = [tuple(word.partition("=")[::2]) for word in words]
    named, general = {}, {name for name, other in pairs if name in (NEAREST, FORMULA) and other == ""}
    for name, other in pairs:
        if other == "" and name in general:
            continue
        if not (isinstance(name, str) and isinstance(other, str) and name.strip() and other.strip()):
            raise BadSubstitute(f"`substitute`: {name!r} for {other!r}; expected GLASS=OTHER, {NEAREST} or {FORMULA}")
        named[name.strip().upper()] = other.strip()
    return Substitutes(named, NEAREST in general, FORMULA in general)


# -- the report -------------------------------------------------------------------------------------------------------

READ, IGNORED, UNKNOWN = "read", "ignored", "unknown"
_TITLES = {READ: "read", IGNORED: "known and ignored", UNKNOWN: "unknown"}

#: How many lines and surfaces of a keyword the report lists.
_LISTED = 8


@dataclass(frozen=True)
class Keyword:
    """The treatment of one keyword (or column, or header line) of a file.

    status: "read", "ignored" (known, and left out for `reason`) or "unknown".
    count: number of occurrences; lines, surfaces: the first of them.
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
    """The source of the medium behind a surface: a catalog, or "model glass", "MIL code", "constant index"."""

    surface: int
    name: str
    source: str

    def __str__(self) -> str:
        return f"surface {self.surface}: {self.name or '(unnamed)'}, {self.source}"


@dataclass(frozen=True)
class Varied:
    """A multi-configuration operand, "THIC 6", and its value in each configuration."""

    operand: str
    values: tuple

    def __str__(self) -> str:
        cells = (
            f"{cell:.9g}" if isinstance(cell, float) else "-" if cell is None else str(cell)[:14] or '""'
            for cell in self.values
        )
        return f"{self.operand:<12} " + " ".join(f"{cell:>14}" for cell in cells)


#: Status of an operand of a merit function.
EVALUATED, KNOWN, UNKNOWN_OPERAND = "evaluated", "known, not evaluated", "unknown"


@dataclass(frozen=True)
class OperandUse:
    """Occurrences of an operand in the merit function of a file, all and those with a weight, and its status.

    status: "evaluated", "known, not evaluated" or "unknown"; "known" where the evaluated operands were not specified.
    """

    name: str
    count: int
    weighted: int
    status: str

    def __str__(self) -> str:
        return f"{self.name} x{self.count}" + (f" ({self.weighted} with weight)" if self.weighted < self.count else "")


def operand_uses(merit: Sequence[Row], evaluated: Collection[str] | None) -> tuple[OperandUse, ...]:
    """The operands of a merit function by name; evaluated: names of those that are evaluated."""
    rows_by_name: dict[str, list[Row]] = {}
    for row in merit:
        rows_by_name.setdefault(row.operand, []).append(row)
    uses = []
    for name, rows in rows_by_name.items():
        status = KNOWN if evaluated is not None else "known"
        if evaluated is not None and name in evaluated:
            status = EVALUATED
        elif name not in DIMENSION:
            status = UNKNOWN_OPERAND
        uses.append(OperandUse(name, len(rows), sum(row.weight != 0 for row in rows), status))
    return tuple(uses)


#: Keys that a document has only where they are not empty.
_OPTIONAL_KEYS = ("configurations", "variables", "solves", "kept", "operands", "tolerances", "geometry")


@value
class ImportReport(Result):
    """The treatment of a lens file: every keyword, the source of each glass, notes and warnings.

    A note reports a choice that the file leaves open; a warning reports an assumption or a loss, and is an error when
    the file is read with `strict=True`. surfaces, stop_surface, primary_wavelength (its number, from 1), wavelengths
    (µm), ray_aiming: of the lens that was read. configurations: values of multi-configuration operands.
    variables, solves, kept: of `Lens.optimization_data`, in words; operands: of its merit function; tolerances: number
    of its lines. geometry: surfaces and gaps that cannot be fabricated.
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
        return {name: part for name, part in asdict(self).items() if part or name not in _OPTIONAL_KEYS}

    def columns(self) -> dict[str, Tensor]:
        """A row for each keyword."""
        statuses = [list(_TITLES).index(keyword.status) for keyword in self.keywords]
        counts = [keyword.count for keyword in self.keywords]
        columns = {"keyword": range(len(statuses)), "status": statuses, "count": counts}
        return {name: torch.tensor([*column]) for name, column in columns.items()}

    def words(self) -> dict[str, list[str]]:
        return {"keyword": [keyword.name for keyword in self.keywords], "status": [*_TITLES]}

    def __str__(self) -> str:
        lines = [f"{self.file} ({self.format})"]
        lines += [f"  warning: {warning}" for warning in (*self.warnings, *self.geometry)]
        lines += [f"  note: {note}" for note in self.notes]
        if self.wavelengths:
            chosen, count = self.primary_wavelength, len(self.wavelengths)
            lines += [
                f"  primary wavelength: number {chosen} of {count}, {self.wavelengths[chosen - 1]:g} µm",
                f"  ray aiming: {self.ray_aiming} ({RAY_AIMING[self.ray_aiming]})",
            ]
        for status, title in _TITLES.items():
            chosen = [str(keyword) for keyword in self.keywords if keyword.status == status]
            listed = _wrapped(chosen) if status == READ else [f"    {keyword}" for keyword in chosen]
            lines += [f"  {title}:", *listed] if chosen else []
        if self.configurations:
            numbers = " ".join(f"{k:>14}" for k in range(1, len(self.configurations[0].values) + 1))
            rows = [f"    {operand}" for operand in self.configurations]
            lines += ["  configurations:", f"    {'':<12} {numbers}", *rows]
        lines += self._optimization_data()
        lines += ["  glasses:", *(f"    {use}" for use in self.glasses)] if self.glasses else []
        return "\n".join(lines)

    def _optimization_data(self) -> list[str]:
        """Variables, solves, and the operands of the merit function by status."""
        titled = {
            f"{len(self.variables)} variables": self.variables,
            "solves and pickups": self.solves,
            "solves that are kept and not followed": self.kept,
        }
        lines = [line for title, part in titled.items() if part for line in (f"  {title}:", *_wrapped(part))]
        if self.operands:
            lines.append(f"  merit function of {sum(use.count for use in self.operands)} lines:")
        for status in dict.fromkeys(use.status for use in self.operands):
            lines += [f"    {status}:", *_wrapped([str(use) for use in self.operands if use.status == status])]
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
    """The report while a reader fills it; `finished` makes the value.

    substitutes: as requested; substituted: names, in capitals, that were replaced.
    """

    file: str
    format: str
    substitutes: Substitutes = NONE
    substituted: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    warnings: list[tuple[str, Place]] = field(default_factory=list)
    glasses: list[GlassSource] = field(default_factory=list)
    _met: dict[tuple[str, str], list[tuple[Place, str]]] = field(default_factory=dict)

    def again(self, file: str = "") -> "Draft":
        """An empty report with the same substitutes."""
        return Draft(file or self.file, self.format, self.substitutes, self.substituted)

    def append(self, other: "Draft") -> None:
        """Add the contents of another report."""
        self.notes += other.notes
        self.warnings += other.warnings
        self.glasses += other.glasses
        for key, met in other._met.items():
            self._met.setdefault(key, []).extend(met)

    def met(self, name: str, status: str, place: Place, reason: str = "") -> None:
        """Count one keyword."""
        self._met.setdefault((name, status), []).append((place, reason))

    def note(self, text: str) -> None:
        """Report a choice by which nothing is lost."""
        if text not in self.notes:
            self.notes.append(text)

    def warn(self, text: str, place: Place) -> None:
        """Report an assumption or a loss at a place."""
        self.warnings.append((text, place))

    def glass(self, surface: int, name: str, source: str) -> None:
        """Report the source of a medium."""
        self.glasses.append(GlassSource(surface, name, source))

    def finished(self, *, strict: bool) -> ImportReport:
        """The report. Raises LensFileError for the first warning if `strict`."""
        keywords = []
        for (name, status), met in self._met.items():
            lines = [place.line for place, _ in met if place.line is not None]
            surfaces = dict.fromkeys(place.surface for place, _ in met if place.surface is not None)
            count, (place, reason) = len(met), met[0]
            keywords.append(Keyword(name, status, count, tuple(lines[:_LISTED]), tuple(surfaces)[:_LISTED], reason))
            if status == UNKNOWN:
                times = "" if count == 1 else f" ({count} times)"
                label = name if name.startswith("member ") else f"keyword {name}"
                self.warn(f"unknown {label}{times}: left out", place._replace(surface=None))
        for name in self.substitutes.named:
            if name not in self.substituted:
                message = f"a substitute for the glass {name} was requested, which is not in the file"
                self.warn(message, Place(self.file))
        if strict and self.warnings:
            text, place = self.warnings[0]
            more = len(self.warnings) - 1
            also = f" (and {more} more warning{'s' if more > 1 else ''})" if more else ""
            raise LensFileError(f"{text}{also}; refused because strict reading was requested", place)
        warnings = tuple(f"{place}: {text}" for text, place in self.warnings)
        return ImportReport(self.file, self.format, tuple(keywords), tuple(self.glasses), tuple(self.notes), warnings)
