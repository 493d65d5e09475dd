"""A .zmx text as records with line numbers, sorted into the system, the surfaces and what follows them."""

from collections.abc import Iterator
from typing import NamedTuple

from raytrace.formats.report import IGNORED, READ, UNKNOWN, Draft
from raytrace.formats.source import MAX_SURFACES, LensFileError, Place, integer, number, shown
from raytrace.formats.zemax_keywords import (
    REPEATED,
    SURFACE_IGNORED,
    SYSTEM_IGNORED,
    SYSTEM_READ,
    TAIL_REASON,
    surface_read,
)


class Record(NamedTuple):
    """One line: its keyword, the words after it, and the raw text after the keyword and one space."""

    keyword: str
    words: tuple[str, ...]
    text: str
    place: Place
    indented: bool

    def number(self, position: int, what: str, default: float | None = None) -> float:
        """The finite number at a position (0 is the first after the keyword), or `default` where the line ends."""
        if position < len(self.words):
            return number(self.words[position], f"{self.keyword}: {what}", self.place)
        if default is None:
            raise LensFileError(f"{self.keyword} has {len(self.words)} values; {what} is missing", self.place)
        return default

    def integer(self, position: int, what: str, default: int | None = None) -> int:
        """The whole number at a position, or `default` where the line ends."""
        if position >= len(self.words) and default is not None:
            return default
        self.number(position, what)
        return integer(self.words[position], f"{self.keyword}: {what}", self.place)


class Block:
    """The records of the system or of one surface, by keyword."""

    def __init__(self, place: Place):
        self.place = place
        self.records: dict[str, list[Record]] = {}

    def add(self, record: Record) -> None:
        self.records.setdefault(record.keyword, []).append(record)

    def all(self, *keywords: str) -> list[Record]:
        """Every record of these keywords, in the order of the file."""
        found = [record for keyword in keywords for record in self.records.get(keyword, ())]
        return sorted(found, key=lambda record: record.place.line)

    def last(self, *keywords: str) -> Record | None:
        """The last record of the first of these keywords that is there."""
        for keyword in keywords:
            if keyword in self.records:
                return self.records[keyword][-1]
        return None


class Sections(NamedTuple):
    """A file sorted: the system, one block per surface, and the multi-configuration operands that follow."""

    system: Block
    surfaces: list[Block]
    tail: list[Record]


def records(text: str, file: str) -> Iterator[Record]:
    """Stage 1: the lines of a text that hold something."""
    for line_number, line in enumerate(text.split("\n"), 1):
        stripped = line.strip()
        if not stripped:
            continue
        keyword, _, rest = stripped.partition(" ") if "\t" not in stripped else _partition_tab(stripped)
        raw = line.lstrip()[len(keyword) + 1 :]
        yield Record(keyword, tuple(rest.split()), raw, Place(file, line_number), line[0] in " \t")


def _partition_tab(line: str) -> tuple[str, str, str]:
    keyword, *rest = line.split(None, 1)
    return keyword, " ", rest[0] if rest else ""


def sections(text: str, file: str, report: Draft) -> Sections:
    """Stage 2: sort the records by the keyword table, and report each of them.

    A surface's records are indented in files of OpticStudio; in files that lost the indentation the keyword decides.
    After the last surface come merit function, tolerances and configurations, whose operands have names of their own.
    """
    found = list(records(text, file))
    starts = [position for position, record in enumerate(found) if record.keyword == "SURF"]
    if not starts:
        hint = "is it a sequential lens file of OpticStudio (.zmx)?"
        raise LensFileError(f"no SURF line in {len(found)} lines; {hint}", Place(file))
    system, surfaces, tail = Block(Place(file)), [], []
    indents = any(record.indented for record in found[starts[0] + 1 :])
    block, after_surfaces = system, False
    for record in found:
        if record.keyword == "SURF":
            block = _next_surface(record, surfaces)
            surfaces.append(block)
            after_surfaces = False
            report.met("SURF", READ, block.place)
        elif block is not system and (record.indented if indents else _of_surface(record)):
            record = record._replace(place=record.place._replace(surface=block.place.surface))
            _classify(record, block, surface_read(), SURFACE_IGNORED, report)
        elif record.keyword in SYSTEM_READ:
            block = system
            _classify(record, system, SYSTEM_READ, SYSTEM_IGNORED, report)
        elif after_surfaces or (surfaces and record.keyword not in SYSTEM_IGNORED):
            block, after_surfaces = system, True
            tail.append(record)
            report.met(record.keyword, IGNORED, record.place, TAIL_REASON)
        else:
            block = system
            _classify(record, system, SYSTEM_READ, SYSTEM_IGNORED, report)
    _warn_of_repeats([system, *surfaces], report)
    return Sections(system, surfaces, tail)


def _of_surface(record: Record) -> bool:
    return record.keyword in surface_read() or record.keyword in SURFACE_IGNORED


def _next_surface(record: Record, surfaces: list[Block]) -> Block:
    place = record.place
    if len(surfaces) >= MAX_SURFACES:
        raise LensFileError(f"more than {MAX_SURFACES} surfaces; no sequential lens has so many", place)
    found = record.integer(0, "surface number")
    if found != len(surfaces):
        message = f"SURF {shown(record.words[0])} where surface {len(surfaces)} should follow; lines lost or reordered?"
        raise LensFileError(message, place)
    return Block(place._replace(surface=found))


def _classify(record: Record, block: Block, read: frozenset[str], ignored: dict[str, str], report: Draft) -> None:
    if record.keyword in read:
        block.add(record)
        report.met(record.keyword, READ, record.place)
    elif record.keyword in ignored:
        block.add(record)
        report.met(record.keyword, IGNORED, record.place, ignored[record.keyword])
    else:
        report.met(record.keyword[:40], UNKNOWN, record.place)


def _warn_of_repeats(blocks: list[Block], report: Draft) -> None:
    for block in blocks:
        for keyword, found in block.records.items():
            if len(found) > 1 and keyword in SYSTEM_READ | surface_read() and keyword not in REPEATED:
                first = found[0].place.line
                report.warn(f"{keyword} stands again (first in line {first}); the last is used", found[-1].place)
