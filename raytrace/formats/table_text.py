"""The text of a prescription table as header lines, headings and rows of cells."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from raytrace.formats.report import IGNORED, READ, UNKNOWN, Draft
from raytrace.formats.source import MAX_SURFACES, LensFileError, Place, is_number, shown
from raytrace.formats.table_columns import is_header, meaning, order
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


def parse(text: str, file: str, report: Draft) -> Table:
    """Take a text apart. Separators are tabs, semicolons, commas or aligned blanks, as the headings show."""
    table = Table(Place(file))
    split = None
    for line_number, line in enumerate(text.split("\n"), 1):
        place = Place(file, line_number)
        if not line.strip(" \t,;"):
            continue
        if split is None:
            split = _header_splitter(line, place)
            if split is not None:
                heading = line.replace("#", " ", 1) if line.lstrip().startswith("#") else line
                columns = header(split(heading, place), place, report)
            elif not metadata_line(table, line, place, report):
                _preamble(table, line, place, report)
        elif not metadata_line(table, line, place, report):
            add_row(table, columns, split(line, place), place)
    if split is None:
        raise LensFileError("no line of headings; expected one naming thickness and curvature or radius", table.place)
    return table


def header(cells: Sequence[str], place: Place, report: Draft) -> list[str | None]:
    """The meaning of each column; every column is reported."""
    columns: list[str | None] = []
    for cell in cells:
        found = meaning(cell, place) if len(cell) < 60 else None
        term = order(found) if found else None
        if found in columns and found is not None:
            report.met(f"column {cell[:40]}", IGNORED, place, f"a second column of the {found}")
            report.warn(f"a second column of the {found} ({shown(cell)}) is left out", place)
            found = None
        elif found is None:
            if cell:
                report.met(f"column {cell[:40]}", UNKNOWN, place)
        elif term is not None and not 2 <= term <= 60:
            raise LensFileError(f"column {shown(cell)}: expected a coefficient of r² to r^60", place)
        else:
            report.met(f"column {cell[:40] or '(unnamed)'}", READ, place)
        columns.append(found)
    return columns


def add_row(table: Table, columns: Sequence[str | None], cells: Sequence[str], place: Place) -> None:
    """Add the surface of a line; its number is its place among the rows, from 1 unless it is the object."""
    if len(table.rows) >= MAX_SURFACES:
        raise LensFileError(f"more than {MAX_SURFACES} surfaces; no sequential lens has so many", place)
    extra = [cell for cell in cells[len(columns) :] if cell]
    if extra:
        raise LensFileError(f"{len(cells)} cells under {len(columns)} headings; {shown(extra[0])} has no column", place)
    named = {column: cell for column, cell in zip(columns, cells, strict=False) if column and cell}
    table.rows.append(Row(place, named))


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
            table.notes.append(value)
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


def _header_splitter(line: str, place: Place):
    """The function that splits lines like this one into cells, or None if this is no line of headings."""
    commented = line.lstrip().startswith("#")
    if commented:
        if key_of(line.strip("# \t").partition(":")[0])[0]:
            return None
        line = line.replace("#", " ", 1)
    line = line.expandtabs() if "\t" not in line.strip() else line
    for separator in "\t;,":
        if separator in line and is_header(line.replace('"', "").split(separator), place, known=0.5 + 0.5 * commented):
            return lambda text, where: _cells(text, separator, where)
    for gap in (r"\s{2,}", r"\s+"):
        spans = _spans(line, gap)
        if is_header([line[start:end] for start, end in spans], place, known=1.0):
            return lambda text, where, gap=gap, spans=spans: _aligned(text, gap, spans, where)
    return None


def _cells(line: str, separator: str, place: Place) -> list[str]:
    try:
        cells = next(csv.reader([line], delimiter=separator, strict=True))
    except (csv.Error, StopIteration) as error:
        raise LensFileError(f"the quotes of this line do not match ({error})", place) from error
    return [" ".join(cell.split()) for cell in cells]


def _spans(line: str, gap: str) -> list[tuple[int, int]]:
    spans, start = [], None
    for match in re.finditer(rf"{gap}|$", line):
        if start is None:
            start = 0
        if match.start() > start:
            spans.append((start, match.start()))
        start = match.end()
    return spans


def _aligned(line: str, gap: str, spans: list[tuple[int, int]], place: Place) -> list[str]:
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
