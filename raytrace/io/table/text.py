"""The text of a prescription table as header lines, headings and rows of cells, with normalised numbers."""

import csv
import difflib
import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from raytrace.io.source import (
    READ,
    Draft,
    LensFileError,
    Place,
    is_infinite,
    is_number,
    plain_text,
    refuse_surplus,
    shown,
)
from raytrace.io.table.columns import UNREAD, columns, is_header, order, squeezed
from raytrace.system.surface import SIZES

#: Header keys, each with its further spellings; a note may occur more than once.
_KEYS = (
    "title, name; note, notes; units, unit; ignore; object distance; stop, stop surface; aperture, system aperture"
    "; fields, field; field weights; vdx; vdy; vcx; vcy; van; telecentric; afocal; wavelengths, wavelength"
    "; wavelength weights, weights; primary wavelength, primary; catalogs, catalog, glass catalogs; ray aiming"
    "; temperature; pressure; automatic; variables; conditions"
)
KEYS = {spelling: row.split(", ")[0] for row in _KEYS.split("; ") for spelling in row.split(", ")}

#: Lines before the headings beyond which the file is no table.
_PREAMBLE = 500
_WANTED = "expected one naming thickness and curvature or radius"


@dataclass
class Row:
    """One surface: cells by column meaning, without the empty ones."""

    place: Place
    cells: dict[str, str]


@dataclass
class Table:
    """A parsed table: header lines (key, value, place), notes, rows; and the report on it."""

    place: Place
    report: Draft
    metadata: dict[str, tuple[str, Place]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    headings: tuple[str, ...] = ()
    columns: tuple[str | None, ...] = ()

    def value(self, key: str, default: str = "") -> str:
        """The value of a header key."""
        return self.metadata.get(key, (default, self.place))[0]


def parse(text: str, file: str, report: Draft) -> Table:
    """Parse a text. Separators are tabs, semicolons, commas, bars or aligned blanks, as the headings show."""
    table = Table(Place(file), report)
    lines = text.split("\n")
    split, skipped = None, 0
    for line_number, line in enumerate(lines, 1):
        place = Place(file, line_number)
        if skipped or not line.strip(" \t,;|:+-="):
            skipped = 0
            continue
        following = lines[line_number : line_number + 1]
        if split is None and not _is_metadata(line) and (layout := _headings(line, following, place)):
            split, headings, skipped = layout
            header(table, headings, place)
        elif not _metadata_line(table, line, place):
            if split is not None:
                add_row(table, split(line, place), place)
                continue
            if line_number > _PREAMBLE:
                raise LensFileError(f"no line of headings in {_PREAMBLE} lines; {_WANTED}", place)
            table.notes.append(line.strip())
            report.met("text before the table", READ, place)
    if split is None:
        hint = "; in Shift-JIS or GBK? Save it as UTF-8" if re.search("[\x80-\x9f]", text) else ""
        raise LensFileError(f"no line of headings; {_WANTED}{hint}", table.place)
    return table


def header(table: Table, cells: Sequence[str], place: Place) -> None:
    """Take a line of headings; every column is reported."""
    ignored = [squeezed(part).casefold() for part in re.split(r"[,;]", table.value("ignore"))]
    table.headings = tuple(cells)
    table.columns = tuple(columns(cells, table.value("units"), ignored, place, table.report))


def add_row(table: Table, cells: Sequence[str], place: Place) -> None:
    """Add the surface of a line; its number is its place among the rows, from 1 unless it is the object."""
    refuse_surplus(table.rows, place)
    count = len(table.columns)
    extra = [cell.strip() for cell in cells[count:] if cell.strip()]
    if extra:
        raise LensFileError(f"{len(cells)} cells under {count} headings; {shown(extra[0])} has no column", place)
    cells_of_row: dict[str, str] = {}
    for heading, column, cell in zip(table.headings, table.columns, cells, strict=False):
        cell = plain_text(cell) if column == "comment" else " ".join(cell.split())
        if column == UNREAD and is_number(cell.replace(",", ".").strip("*")):
            message = f"column {shown(heading)} holds numbers ({cell}), but its quantity is not known"
            fix = f"name it, as radius, thickness, nd, Vd, conic, A4, or write the header line '# ignore: {heading}'"
            raise LensFileError(f"{message}; {fix}", place)
        if column and column != UNREAD and cell:
            cells_of_row[column] = f"{cells_of_row[column]} {cell}" if column in cells_of_row else cell
    table.rows.append(Row(place, cells_of_row))


def _is_metadata(line: str) -> bool:
    """True for a line '# key: value' of a key that is known; other lines with '#' may be headings."""
    return line.strip().startswith(("#", '"#')) and _bare(line.strip('"# \t').partition(":")[0]) in KEYS


def _metadata_line(table: Table, line: str, place: Place) -> bool:
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
    add_metadata(table, name if colon else "", value.strip() if colon else content, place)
    return True


def _bare(name: str) -> str:
    return " ".join(re.sub(r"[_\s]+", " ", name).lower().split())


def add_metadata(table: Table, name: str, value: str, place: Place) -> None:
    """Store one header value under its key; a name that is no key makes a note of "name: value"."""
    key = KEYS.get(_bare(name), "note")
    if _bare(name) not in KEYS:
        near = difflib.get_close_matches(_bare(name), KEYS, n=1, cutoff=0.8) if len(_bare(name)) < 40 else []
        if near:
            message = f"unknown header {shown(name.strip())}, taken as a note; did you mean '{near[0]}'?"
            table.report.warn(message, place)
        value = f"{name.strip()}: {value}" if name.strip() else value
        table.notes += [value] if value else []
    elif key == "note":
        table.notes += [plain_text(value)] if value else []
    else:
        if key in table.metadata:
            table.report.warn(f"'{key}' occurs again; the last is used", place)
        table.metadata[key] = (value, place)
    table.report.met(key, READ, place)


def _headings(line: str, following: list[str], place: Place) -> tuple[Callable, list[str], int] | None:
    """(a function that splits lines into cells, the headings, further lines of headings), or None.

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
    """Cells of a line aligned under headings: in order if each column has one, else by the heading above them."""
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


# -- spellings of numbers in cells: minus signs, commas, planes, and marks of the stop -------------------------------

_MINUS = str.maketrans("−–—―‐‑‒﹣－", "-" * 9)
_PLANE = re.compile(r"plan[eo]?|flat|平面|plan[- ]?o?|無限大?|无限大?|\(?plane\)?", re.IGNORECASE)
_STOP = re.compile(
    r"\(?(?:aperture stop|stop|sto|aperture|diaphragm|iris|(?-i:AST?|ST|S)|開口絞り|絞り|孔径光阑|光阑|光圈"
    r"|aperturblende|blende|diaphragme)\)?",
    re.IGNORECASE,
)
_VARIABLE = re.compile(r"\(?(?:variable|var\.?|可変|可变|variabel)\)?|[dD]\s*\d+.*|b\.?f\.?l?\.?", re.IGNORECASE)
_COEFFICIENT = re.compile(r"(?:k|κ|ε|[A-Z]\d{0,2}|a\d{1,2})\s*=.*", re.DOTALL)

_DECIMAL = re.compile(r"[+-]?(?:0?,\d+|\d+,(?:\d{1,2}|\d{4,}))(?:[eE][+-]?\d+)?|[+-]?\d{4,},\d+")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+\.\d*|[+-]?[1-9]\d{0,2}(?:,\d{3}){2,}")
#: Columns whose numbers may reach thousands.
_MAY_BE_LARGE = ("radius", "thickness", "curvature", "diameter", "conic")
_EITHER = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}(?:[eE][+-]?\d+)?")


def is_figure(column: str) -> bool:
    """True for a column of numbers."""
    numeric = ("radius", "thickness", "curvature", "conic", "diameter", "pgf", "dpgf", *SIZES)
    return (
        column in (*numeric, "temperature", "pressure")
        or column.startswith(("index ", "abbe "))
        or order(column) is not None
    )


def plain(text: str) -> str:
    """A number in ASCII: without full-width digits, other minus signs and marks such as *."""
    text = unicodedata.normalize("NFKC", text).translate(_MINUS).strip(" *†‡")
    text = re.sub(r"^([+-])\s+(?=[\d.])", r"\1", text)
    return "-" if text and not text.strip("-") else text


def cleaned(rows: list[Row]) -> list[Row]:
    """The rows with normalised numbers, a stop marked in a radius or label moved to its column.

    Raises LensFileError for a comma that may be a decimal or a thousands separator, for a distance that is variable,
    and for lines of aspheric coefficients.
    """
    rows = [Row(row.place, {name: plain(c) if is_figure(name) else c for name, c in row.cells.items()}) for row in rows]
    cells = [cell for row in rows for name, cell in row.cells.items() if is_figure(name)]
    decimal = any(_DECIMAL.fullmatch(cell) for cell in cells)
    point = any("." in cell and is_number(cell.replace(",", "")) for cell in cells)
    return [_marked(Row(row.place, _without_commas(row, decimal, point))) for row in rows]


def _without_commas(row: Row, decimal: bool, point: bool) -> dict[str, str]:
    cells = dict(row.cells)
    for name, cell in row.cells.items():
        if _COEFFICIENT.fullmatch(cell) and name not in ("comment", "glass"):
            message = f"{shown(cell)} is a coefficient in a line of its own"
            raise LensFileError(f"{message}; write it in a column of its surface: conic, A4, A6, …", row.place)
        if not is_figure(name) or "," not in cell:
            continue
        if not name.endswith(_MAY_BE_LARGE) and (_DECIMAL.fullmatch(cell) or _EITHER.fullmatch(cell)):
            cells[name] = cell.replace(",", ".")  # an index of 1,516 is no index of 1516
        elif _THOUSANDS.fullmatch(cell) or (_EITHER.fullmatch(cell) and point and not decimal):
            cells[name] = cell.replace(",", "")
        elif _DECIMAL.fullmatch(cell) or (_EITHER.fullmatch(cell) and decimal and not point):
            cells[name] = cell.replace(",", ".")
        elif _EITHER.fullmatch(cell):
            message = f"{name} is {shown(cell)}: a decimal comma or thousands? Write {cell.replace(',', '.')}"
            raise LensFileError(f"{message} or {cell.replace(',', '')}", row.place)
    return cells


def _marked(row: Row) -> Row:
    cells = dict(row.cells)
    radius = cells.get("radius", "")
    rest = _STOP.sub("", radius, count=1).strip() if not is_number(radius) and not is_infinite(radius) else radius
    if rest != radius and (not rest or rest == "-" or is_number(rest) or is_infinite(rest) or _PLANE.fullmatch(rest)):
        cells |= {"radius": rest or "-", "stop": cells.get("stop", "stop")}
    if _PLANE.fullmatch(cells.get("radius", "")):
        cells["radius"] = "inf"
    label = unicodedata.normalize("NFKC", cells.get("label", ""))
    if re.fullmatch(r"\d+\s*\(?(?:AST?|STO?|S)\)?\*?|AST?|STO?|S", label):
        cells.setdefault("stop", "stop")
    thickness = cells.get("thickness", "")
    if _VARIABLE.fullmatch(thickness) and not is_number(thickness):
        message = f"thickness is {shown(thickness)}, a distance given elsewhere"
        raise LensFileError(f"{message}; write its number, at one position of a zoom or focus", row.place)
    return Row(row.place, cells)
