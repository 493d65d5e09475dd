"""Results of public functions: numbers, a table, a text, a document for JSON and a figure."""

import functools
import html
import json
import math
import os
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from raytrace.files import write_atomically
from raytrace.maths.numerics import broadcast_shape
from raytrace.plotting import style
from raytrace.words import option

if TYPE_CHECKING:  # both are slow to load
    import pandas
    from matplotlib.figure import Figure


class Column(NamedTuple):
    """A column of a table: its name in JSON, CSV and frames, and its unit there and in text.

    form, heading: in text, the format of its numbers, < in front to align it left, and one line or two; by default the
    name.
    """

    name: str
    unit: str = ""
    form: str = ".6g"
    heading: str = ""


#: Columns of a text: numbers or texts, by the name of the column or by a `Column` of the text alone.
Columns: TypeAlias = Mapping[Any, Tensor | Sequence]


class Table(NamedTuple):
    """A table of a text, with lines above and below."""

    columns: Columns
    title: Sequence[str] = ()
    notes: Sequence[str] = ()


#: Columns of several results; the unit of fields is the lens's, other names end in their unit (SUFFIXES).
COLUMNS = {
    "wavelength": "µm", "frequency": "1/mm", "projected_solid_angle": "sr", "lower": "°", "chief": "°", "upper": "°",
    "dn_dt": "1/K", "dn_dt_absolute": "1/K", "seconds": "s",
    **dict.fromkeys(
        (
            "radius", "thickness", "semi_diameter", "height", "shift", "crossing", "x", "y", "z", "opl",
            "object_distance", "sensor_distance", "optical_invariant", "marginal_yni", "chief_yni", "centroid_x",
            "centroid_y", "efl", "depth",
        ),
        "mm",
    ),
}  # fmt: skip
SUFFIXES = {"_percent": "%", "_um": "µm"}

#: Rounding of a sum or difference, in units of the rounding of its largest term.
_ROUNDING = 64

#: Rows of a table in a notebook.
MOST_ROWS = 100


class Result:
    """A result of a public function; a class of results defines its columns, and `draw` if it has a figure.

    columns: a table; to_frame: the same for pandas; document: of `--json`; str: the text that the command prints, of
    `tables`, which a notebook shows as HTML; plot: the figure; save: what `-o` writes.
    """

    __slots__ = ()

    lens: Any  #: of results with columns of fields

    #: Columns that are not in the table COLUMNS, or have another unit or format.
    COLUMNS: ClassVar[Sequence[Column]] = ()

    @property
    def falls_short(self) -> bool:
        """Whether a goal is missed: the command prints and saves the result, and exits with 1."""
        return False

    def columns(self) -> dict[str, Tensor]:
        """Columns by name, broadcast against one another; nan where no ray arrives. Raises TypeError: no table."""
        raise TypeError(f"{type(self).__name__} is no table; see its document() for what it holds")

    def words(self) -> dict[str, Sequence[str]]:
        """Texts of columns whose numbers are places in these texts, from 0, by the name of the column."""
        return {}

    def roundings(self) -> dict[str, Tensor]:
        """Rounding of columns of sums and differences by name, () or one a row; a text has smaller numbers as 0."""
        return {}

    def column(self, name: str) -> Column:
        """Unit, format and heading of a column by its name."""
        if column := next((column for column in self.COLUMNS if column.name == name), None):
            return column
        if name in ("field_x", "field_y"):
            return Column(name, self.lens.fields.unit)
        ending = next((unit for suffix, unit in SUFFIXES.items() if name.endswith(suffix)), "")
        return Column(name, COLUMNS.get(name, ending))

    def tables(self) -> Sequence[Table]:
        """The tables of the text."""
        return [Table(self.columns())]

    def units(self) -> dict[str, str]:
        """Units of columns by their names, of those that have one; `to_frame` has them in `attrs`."""
        return {name: unit for name in self.columns() if (unit := self.column(name).unit)}

    def to_frame(self) -> "pandas.DataFrame":
        """The table for pandas, a row for every point of every curve; units are in `frame.attrs["units"]`."""
        import pandas

        columns = self.columns()
        frame = pandas.DataFrame(flat(columns))
        frame.attrs["units"] = {name: unit for name in columns if (unit := self.column(name).unit)}
        return frame.assign(**{name: [words[number] for number in frame[name]] for name, words in self.words().items()})

    def save(self, path: str | PathLike) -> None:
        """Write the table as .csv, or the document as .json, as a whole or not at all. Raises ValueError for others."""
        suffix = Path(path).suffix.lower()
        if suffix == ".json":
            text = json.dumps(self.document(), ensure_ascii=False, allow_nan=False, indent=2)
            write_atomically(path, lambda file: file.write(text.encode()))
        elif suffix == ".csv":
            write_atomically(path, lambda file: self.to_frame().to_csv(file, index=False))
        else:
            raise ValueError(
                f"{os.fspath(path)}: a result is saved as .csv or .json; figures are saved by {option('plot')}"
            )

    def files(self, path: str | PathLike) -> list[Path]:
        """The files that `save` writes."""
        return [Path(path)]

    def document(self) -> dict:
        """The result for JSON: plain numbers, null for undefined ones."""
        return {"results": rows(self.columns())}

    def draw(self, *arguments: Any, **options: Any) -> "Figure":
        """The figure of `plot`. Raises TypeError: no figure."""
        raise TypeError(f"{type(self).__name__} has no figure")

    def plot(self, path: str | PathLike | None = None, *, dpi: float = 200, **options: Any) -> "Figure":
        """The figure (matplotlib), also saved under `path` (.png, .pdf, .svg) if one is given; dpi: pixels per inch
        of a .png.

        It is not a figure of pyplot, whose `show` and `savefig` do not know it. A notebook shows it where it is the
        value of a cell; its own `savefig` saves it.
        """
        figure = self.draw(**options)
        if path is not None:
            style.save(figure, path, dpi=dpi)
        return figure

    def __str__(self) -> str:
        return "\n".join(line for t in self.tables() for line in (*t.title, *self._lines(t.columns), *t.notes))

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        """The tables of the text for a notebook, or the text of a result without a table."""
        try:
            tables = self.tables()
        except TypeError:
            return _block(str(self).splitlines())
        parts = ((_block(t.title), html_table(self.printed_columns(t.columns)), _block(t.notes)) for t in tables)
        return "\n".join(part for table in parts for part in table if part)

    def _lines(self, columns: Columns) -> list[str]:
        return text_table(self.printed_columns(columns))

    def printed_columns(self, columns: Columns) -> dict[Column, Sequence]:
        """Columns as they are printed, without field_x where it is 0, and with 0 for rounding errors (`roundings`)."""
        listed: dict[Any, Any] = {**columns, **flat({k: v for k, v in columns.items() if isinstance(v, Tensor)})}
        words, roundings, printed = self.words(), self.roundings(), {}
        if "field_x" in listed and not np.any(listed["field_x"]):
            del listed["field_x"]
        for name, values in listed.items():
            counted = name in words and isinstance(columns[name], Tensor)
            column = self.column(name) if isinstance(name, str) else name
            printed[column] = [words[name][int(value)] for value in values] if counted else values
            if column.name in roundings:
                printed[column] = _without_rounding(values, roundings[column.name])
        return printed


def rounding(*terms: Tensor) -> Tensor:
    """Rounding () of sums and differences of quantities (...), by the largest of them; nan and inf are left out."""
    sizes = (_ROUNDING * torch.finfo(term.dtype).eps * term.detach().abs().nan_to_num(0, 0, 0).max() for term in terms)
    return functools.reduce(torch.maximum, sizes)


def _without_rounding(values: Sequence, rounding: Tensor) -> list:
    """Numbers of a column, 0 where they are below their rounding; texts as they are."""
    limits = rounding.expand(len(values)).tolist()
    pairs = zip(values, limits, strict=True)
    return [v if isinstance(v, str) or not abs(float(v)) < limit else 0.0 for v, limit in pairs]


def flat(columns: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Columns as flat arrays of one length, in the order of their common shape."""
    shape = broadcast_shape(*(column.shape for column in columns.values())) if columns else ()
    return {name: column.detach().cpu().expand(shape).reshape(-1).numpy() for name, column in columns.items()}


def axis(values: Tensor, place: int, axes: int) -> Tensor:
    """A vector (n,) as axis `place` of a tensor of `axes` axes: a column of a table."""
    return values.reshape(*(-1 if i == place else 1 for i in range(axes)))


def masked(values: Tensor, valid: Tensor) -> Tensor:
    """Values, nan where invalid: for tables and figures only, never before a derivative."""
    return torch.where(valid, values, torch.nan)


def rows(columns: dict[str, Tensor]) -> list[dict]:
    """Columns as a list of rows for JSON."""
    table = flat(columns)
    return [dict(zip(table, map(number, row), strict=True)) for row in zip(*table.values(), strict=True)]


def number(value: Any) -> float | None:
    """A number for JSON; null for undefined, infinite and missing ones."""
    if value is None:
        return None
    value = float(value)
    return value + 0.0 if math.isfinite(value) else None  # + 0.0 makes -0 a 0


def numbers(values: Tensor) -> list:
    """A tensor as nested lists of numbers for JSON."""
    return [number(entry) if entry.dim() == 0 else numbers(entry) for entry in values.detach()]


def plain(document: Any) -> Any:
    """A document for JSON: null for numbers that are not finite."""
    if isinstance(document, dict):
        return {name: plain(entry) for name, entry in document.items()}
    if isinstance(document, list | tuple):
        return [plain(entry) for entry in document]
    return number(document) if isinstance(document, float) else document


def point_text(x: float, y: float) -> str:
    """A field point: its y alone on the axis of x."""
    return f"{y:g}" if x == 0 else f"{x:g},{y:g}"


def cell(value: float, form: str) -> str:
    """A number in a table of text; - for nan."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else str(float(value))
    shown = f"{value:{form.removeprefix('<')}}"
    return shown if float(shown) else f"{0.0:{form.removeprefix('<')}}"  # a number that rounds to 0 has no sign


def cells(column: Column, values: Sequence) -> list[str]:
    """The texts of a column: two lines of its heading with its unit, and its numbers or texts."""
    first, _, second = (column.heading or column.name).partition("\n")
    shown = [value if isinstance(value, str) else cell(value, column.form) for value in values]
    return [first, ", ".join(filter(None, (second, column.unit))), *shown]


def text_table(columns: Mapping[Column, Sequence]) -> list[str]:
    """Lines of columns of numbers, or of texts, under their headings and units."""
    texts = []
    for column, values in columns.items():
        shown = cells(column, values)
        width = max(map(len, shown))
        texts.append([text.ljust(width) if column.form.startswith("<") else text.rjust(width) for text in shown])
    lines = ["  ".join(row).rstrip() for row in zip(*texts, strict=True)]
    return [line for k, line in enumerate(lines) if k > 1 or line]


def html_table(columns: Mapping[Column, Sequence]) -> str:
    """The table as HTML, at most MOST_ROWS rows of it; empty without columns."""
    if not columns:
        return ""
    sides = ["left" if column.form.startswith("<") else "right" for column in columns]
    first, second, *body = zip(*(cells(column, values) for column, values in columns.items()), strict=True)
    heads = ["<br>".join(filter(None, map(html.escape, pair))) for pair in zip(first, second, strict=True)]
    lines = [("th", heads), *(("td", map(html.escape, row)) for row in body[:MOST_ROWS])]
    table = "\n".join(
        "<tr>" + "".join(f'<{tag} style="text-align:{side}">{c}</{tag}>' for side, c in zip(sides, row, strict=True))
        + "</tr>" for tag, row in lines
    )  # fmt: skip
    rest = len(body) - MOST_ROWS
    return f"<table>\n{table}\n</table>" + (_block([f"and {rest:,} rows; to_frame() has all"]) if rest > 0 else "")


def _block(lines: Sequence[str]) -> str:
    return f"<pre>{html.escape(chr(10).join(lines))}</pre>" if lines else ""


def object_text(distance: float) -> str:
    """An object distance of mm as a text: `25 m`, `400 mm`, `infinity`."""
    if math.isinf(distance):
        return "infinity"
    return (f"{distance / 1000:.6g} m" if abs(distance) >= 1e4 else f"{distance:.6g} mm").replace("-", "−")


def quantity_text(figure: float, word: str | None = None) -> str:
    """A number of first-order data as it is printed; word: of one that is infinite in practice."""
    if word:
        return word
    return "-" if math.isnan(figure) else "infinite" if math.isinf(figure) else f"{figure + 0.0:.9g}"


def quantity_remark(figure: float, word: str | None = None) -> str:
    """The number of a quantity that is infinite in practice, behind its unit."""
    return f"; {figure:.4g} mm by first-order data" if word and math.isfinite(figure) else ""
