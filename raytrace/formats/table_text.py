"""The text of a prescription table as header lines, headings and rows of cells."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

from raytrace.formats import spelling
from raytrace.formats.report import READ, Draft
from raytrace.formats.source import MAX_SURFACES, LensFileError, Place, shown
from raytrace.formats.spelling import is_number
from raytrace.formats.table_columns import UNREAD, columns, is_header, squeezed
from raytrace.formats.table_system import KEYS, key_of

#: Lines before the headings beyond which the file is no table.
_PREAMBLE = 500


@dataclass
class Row:
    """One surface: cells by column meaning, without the empty ones."""

    place: Place
    cells: dict[str, str]


@dataclass
class Table:
    """A table taken apart: header lines (key, value, place), notes, rows."""

    place: Place
    metadata: dict[str, tuple[str, Place]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    headings: tuple[str, ...] = ()
    columns: tuple[str | None, ...] = ()


def parse(text: str, file: str, report: Draft) -> Table:
    """Take a text apart. Separators are tabs, semicolons, commas, bars or aligned blanks, as the headings show."""
    table = Table(Place(file))
    lines = text.split("\n")
    split, skipped = None, 0
    for line_number, line in enumerate(lines, 1):
        place = Place(file, line_number)
        if skipped or not line.strip(" \t,;|:+-="):
            skipped = 0
            continue
        following = lines[line_number : line_number + 1]
        if split is None and not _is_metadata(line) and (found := _headings(line, following, place)):
            split, headings, skipped = found
            header(table, headings, place, report)
        elif not metadata_line(table, line, place, report):
            if split is None:
                _preamble(table, line, place, report)
            else:
                add_row(table, split(line, place), place)
    if split is None:
        hint = "; in Shift-JIS or GBK? Save it as UTF-8" if re.search("[\x80-\x9f]", text) else ""
        raise LensFileError(
            f"no line of headings; expected one naming thickness and curvature or radius{hint}", table.place
        )
    return table


def header(table: Table, cells: Sequence[str], place: Place, report: Draft) -> None:
    """Take a line of headings; every column is reported."""
    units, ignored = (table.metadata.get(key, ("", place))[0] for key in ("units", "ignore"))
    ignored = [squeezed(part).casefold() for part in re.split(r"[,;]", ignored)]
    table.headings = tuple(cells)
    table.columns = tuple(columns(cells, units, ignored, place, report))


def add_row(table: Table, cells: Sequence[str], place: Place) -> None:
    """Add the surface of a line; its number is its place among the rows, from 1 unless it is the object."""
    if len(table.rows) >= MAX_SURFACES:
        raise LensFileError(f"more than {MAX_SURFACES} surfaces; no sequential lens has so many", place)
    count = len(table.columns)
    extra = [cell.strip() for cell in cells[count:] if cell.strip()]
    if extra:
        raise LensFileError(f"{len(cells)} cells under {count} headings; {shown(extra[0])} has no column", place)
    named: dict[str, str] = {}
    for heading, column, cell in zip(table.headings, table.columns, cells, strict=False):
        cell = spelling.plain_text(cell) if column == "comment" else " ".join(cell.split())
        if column == UNREAD and is_number(cell.replace(",", ".").strip("*")):
            message = f"column {shown(heading)} holds numbers ({cell}), but what they are is not known"
            fix = f"name it, as radius, thickness, nd, Vd, conic, A4, or write the header line '# ignore: {heading}'"
            raise LensFileError(f"{message}; {fix}", place)
        if column and column != UNREAD and cell:
            named[column] = f"{named[column]} {cell}" if column in named else cell
    table.rows.append(Row(place, named))


def _is_metadata(line: str) -> bool:
    """True for a line '# key: value' of a key that is known; other lines with '#' may be headings."""
    return line.strip().startswith(("#", '"#')) and key_of(line.strip('"# \t').partition(":")[0])[0] is not None


def metadata_line(table: Table, line: str, place: Place, report: Draft) -> bool:
    """Take a line '# key: value', or a comment '# text', which becomes a note."""
    content = line.strip()
    bare = content.rstrip(",;\t ")
    content = bare if len(content) - len(bare) > 1 else content  # a spreadsheet pads lines with separators
    if content.startswith('"') and content.endswith('"') and len(content) > 1:
        content = content[1:-1].replace('""', '"').strip()  # and quotes them
    if not content.startswith("#"):
        return False
    content = content.lstrip("#").strip()
    name, colon, value = content.partition(":")
    add_metadata(table, name if colon else "", value.strip() if colon else content, place, report)
    return True


def add_metadata(table: Table, name: str, value: str, place: Place, report: Draft) -> None:
    """Store one header value under its key; a name that is no key makes a note of "name: value"."""
    key, near = key_of(name)
    if key is None:
        text = f"{name.strip()}: {value}" if name.strip() else value
        if near:
            report.warn(f"unknown header {shown(name.strip())}, taken as a note; is '{near}' meant?", place)
        if text:
            table.notes.append(text)
        report.met("note", READ, place)
    elif KEYS[key] == "repeated":
        if value:
            table.notes.append(spelling.plain_text(value))
        report.met(key, READ, place)
    else:
        if key in table.metadata:
            report.warn(f"'{key}' stands again; the last is used", place)
        table.metadata[key] = (value, place)
        report.met(key, READ, place)


def _preamble(table: Table, line: str, place: Place, report: Draft) -> None:
    if place.line > _PREAMBLE:
        message = f"no line of headings in {_PREAMBLE} lines; expected one naming thickness and curvature or radius"
        raise LensFileError(message, place)
    table.notes.append(line.strip())
    report.met("text before the table", READ, place)


def _headings(line: str, following: list[str], place: Place):
    """(what splits lines like these into cells, the headings, lines they take beyond the first), or None.

    A second line of words or units, as "curvature" and "(mm)" under "Radius of", belongs to the headings.
    """
    commented = line.lstrip().startswith("#")
    line = line.replace("#", " ", 1) if commented else line
    line = line.expandtabs() if "\t" not in line.strip() else line
    for separator in "\t;,|":
        if separator not in line:
            continue
        cells = _plain_cells(line, separator)
        below = [
            _plain_cells(text, separator) for text in following if separator in text and not re.search(r"\d", text)
        ]
        joined = [" ".join(pair).strip() for pair in zip(cells, *below, strict=False)] if below else []
        if len(joined) == len(cells) and is_header(joined, known=1.0) and any(below[0]):
            return partial(_cells, separator), joined, 1
        if is_header(cells, known=0.5 + 0.5 * commented):
            return partial(_cells, separator), _cells(separator, line, place), 0
    for gap in (r"\s{2,}", r"\s+"):
        spans = _spans(line, gap)
        if is_header([line[start:end] for start, end in spans], known=1.0):
            headings = [line[start:end] for start, end in spans]
            return partial(_aligned, gap, spans), headings, 0
    return None


def _plain_cells(line: str, separator: str) -> list[str]:
    line = line.strip().strip("|") if separator == "|" else line
    return [cell.strip() for cell in line.replace('"', "").split(separator)]


def _cells(separator: str, line: str, place: Place) -> list[str]:
    line = line.strip().strip("|") if separator == "|" else line
    try:
        return next(csv.reader([line], delimiter=separator, strict=True))
    except (csv.Error, StopIteration) as error:
        raise LensFileError(f"the quotes of this line do not match ({error})", place) from error


def _spans(line: str, gap: str) -> list[tuple[int, int]]:
    spans, start = [], None
    for match in re.finditer(rf"{gap}|$", line):
        if start is None:
            start = 0
        if match.start() > start:
            spans.append((start, match.start()))
        start = match.end()
    return spans


def _aligned(gap: str, spans: list[tuple[int, int]], line: str, place: Place) -> list[str]:
    """Cells of a line aligned under headings: in order if each column has one, else by the heading they stand under."""
    line = line.expandtabs()
    words = _spans(line, gap)
    if len(words) == len(spans):
        return [line[start:end].strip() for start, end in words]
    cells = [""] * len(spans)
    for start, end in words:
        overlaps = [min(end, stop) - max(start, begin) for begin, stop in spans]
        column = overlaps.index(max(overlaps))
        word = line[start:end].strip()
        mixed = " " in word and any("." in part and is_number(part) for part in word.split())
        if cells[column] or mixed:
            message = f"{shown(word)} is not under a heading of its own"
            raise LensFileError(f"{message}; align the columns, or separate them by tabs or commas", place)
        cells[column] = word
    return cells
