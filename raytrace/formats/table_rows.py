"""The cells of a prescription table as people write numbers: minus signs, commas, planes, and marks of the stop."""

import re
import unicodedata

from raytrace.formats.source import LensFileError, shown
from raytrace.formats.spelling import is_infinite, is_number
from raytrace.formats.table_columns import order
from raytrace.formats.table_text import Row

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
_SIZES = ("radius", "thickness", "curvature", "diameter", "conic")
_EITHER = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}(?:[eE][+-]?\d+)?")


def is_figure(column: str) -> bool:
    """True for a column of numbers."""
    named = ("radius", "thickness", "curvature", "conic", "semi_diameter", "diameter", "pgf", "dpgf")
    return column in named or column.startswith(("index ", "abbe ")) or order(column) is not None


def plain(text: str) -> str:
    """A number in ASCII: full-width digits, other minus signs and marks such as * taken away."""
    text = unicodedata.normalize("NFKC", text).translate(_MINUS).strip(" *†‡")
    text = re.sub(r"^([+-])\s+(?=[\d.])", r"\1", text)
    return "-" if text and not text.strip("-") else text


def cleaned(rows: list[Row]) -> list[Row]:
    """The rows with their numbers plain, a stop marked in a radius or label moved to its column.

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
        if not name.endswith(_SIZES) and (_DECIMAL.fullmatch(cell) or _EITHER.fullmatch(cell)):
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
