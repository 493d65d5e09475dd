"""The import report: what a reader did with every keyword of a lens file."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field

from raytrace.formats.source import LensFileError, Place

READ, IGNORED, UNKNOWN = "read", "ignored", "unknown"

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


@dataclass(frozen=True)
class GlassSource:
    """Where the medium behind a surface came from: a catalog, or "model glass", "MIL code", "constant index"."""

    surface: int
    name: str
    source: str


@dataclass(frozen=True)
class ImportReport:
    """What became of a lens file: every keyword met, where each glass came from, notes and warnings.

    A note says what was done where the file leaves a choice; a warning says what was assumed or lost, and is an
    error when the file is read with `strict=True`.
    """

    file: str
    format: str
    keywords: tuple[Keyword, ...] = ()
    glasses: tuple[GlassSource, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict:
        """The report as lists, dicts, strings and numbers: ready for `json.dumps`."""
        return asdict(self)

    def __str__(self) -> str:
        lines = [f"{self.file} ({self.format})"]
        lines += [f"  warning: {warning}" for warning in self.warnings]
        lines += [f"  note: {note}" for note in self.notes]
        for status, title in ((READ, "read"), (IGNORED, "known and ignored"), (UNKNOWN, "unknown")):
            chosen = [keyword for keyword in self.keywords if keyword.status == status]
            if not chosen:
                continue
            lines.append(f"  {title}:")
            if status == READ:
                lines += _wrapped(f"{keyword.name} x{keyword.count}" for keyword in chosen)
            else:
                lines += [f"    {_row(keyword)}" for keyword in chosen]
        if self.glasses:
            lines.append("  glasses:")
            lines += [f"    surface {use.surface}: {use.name or '(unnamed)'}, {use.source}" for use in self.glasses]
        return "\n".join(lines)


def _row(keyword: Keyword) -> str:
    where = "line" if keyword.count == 1 else "lines"
    listed = ", ".join(str(line) for line in keyword.lines)
    more = ", …" if keyword.count > len(keyword.lines) else ""
    times = "" if keyword.count == 1 else f" x{keyword.count}"
    reason = f": {keyword.reason}" if keyword.reason else ""
    return f"{keyword.name}{times} ({where} {listed}{more}){reason}"


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
    """A report being written by a reader; `finished` makes the value."""

    file: str
    format: str
    notes: list[str] = field(default_factory=list)
    warnings: list[tuple[str, Place]] = field(default_factory=list)
    glasses: list[GlassSource] = field(default_factory=list)
    _met: dict[tuple[str, str], dict] = field(default_factory=dict)

    def met(self, name: str, status: str, place: Place, reason: str = "") -> None:
        """Count one keyword."""
        entry = self._met.setdefault((name, status), {"count": 0, "lines": [], "surfaces": [], "reason": reason})
        entry["count"] += 1
        if len(entry["lines"]) < _LISTED and place.line is not None:
            entry["lines"].append(place.line)
        surfaces = entry["surfaces"]
        if place.surface is not None and len(surfaces) < _LISTED and place.surface not in surfaces:
            surfaces.append(place.surface)

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
        for (name, status), entry in self._met.items():
            if status == UNKNOWN:
                place = Place(self.file, entry["lines"][0] if entry["lines"] else None)
                times = "" if entry["count"] == 1 else f" ({entry['count']} times)"
                self.warn(f"unknown keyword {name}{times}: left out", place)
        if strict and self.warnings:
            text, place = self.warnings[0]
            more = len(self.warnings) - 1
            also = f" (and {more} more warning{'s' if more > 1 else ''})" if more else ""
            raise LensFileError(f"{text}{also}; refused because strict reading was asked for", place)
        keywords = tuple(
            Keyword(name, status, entry["count"], tuple(entry["lines"]), tuple(entry["surfaces"]), entry["reason"])
            for (name, status), entry in self._met.items()
        )
        warnings = tuple(f"{place}: {text}" for text, place in self.warnings)
        return ImportReport(self.file, self.format, keywords, tuple(self.glasses), tuple(self.notes), warnings)
