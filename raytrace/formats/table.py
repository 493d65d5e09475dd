"""Read a prescription table as designers write them: .csv, .tsv, .txt, or any text with one row per surface.

The headings name the columns, in any order and many spellings (`table_columns`): curvature or radius, thickness,
glass, and if wanted nd and Vd, conic, semi-diameter or diameter, aspheric terms (A4 is the coefficient of r⁴),
apertures, type, comment. Header lines '# key: value' hold the system (`table_system`). Without them the lens is read
with what is stated in warnings: on axis, the d line, F/10 unless the stop row has a semi-diameter.

- An empty curvature, radius `inf` or 0 is a plane; lengths are mm unless '# units:' says otherwise.
- Glass: empty or `air`; a catalog name; `MIRROR`; a number, the constant index; `1.5168/64.17` (nd/Vd) or
  `1.5168/64.17/0.0008` (nd/Vd/ΔPgF), a model glass; six digits, a MIL code; `NAME=1.33` or `NAME=1.5168/64.17`, the
  same with a name. Columns nd and Vd define the glass of a row that names none.
- The stop is the row marked in a `stop` column, or called stop, aperture, diaphragm, iris; or '# stop: 6'.
- A first row called object, or numbered 0, is the object; otherwise the object lies at '# object distance', or at
  infinity.
- The last row is the image: it is called image, sensor or detector, or has no thickness.
- Apertures: `circular 0 12.5` (inner, outer radius), `rectangular 3 4`, `elliptic 3 4` (half-widths), with
  `obscuration` before and `at 1 2` (centre) after; several are joined by ` + `.
- A row of a type that is not modelled (coordinate break, toroid, grating …) raises UnsupportedSurface.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.formats import table_surface, table_system
from raytrace.formats.finite import refuse_overflow
from raytrace.formats.media import report_missing_catalogs
from raytrace.formats.report import Draft, ImportReport
from raytrace.formats.source import LensFileError, Place, integer, is_infinite, is_number, number, shown
from raytrace.formats.table_text import Row, Table, parse
from raytrace.formats.zemax_keywords import MILLIMETRES
from raytrace.lens import Lens
from raytrace.surface import Surface

_STOP = re.compile(r"\b(stop|sto|aperture|diaphragm|iris)\b", re.IGNORECASE)
_IMAGE = re.compile(r"\b(image|ima|img|sensor|detector)\b", re.IGNORECASE)
_OBJECT = re.compile(r"\b(object|obj)\b", re.IGNORECASE)


def read(text: str, file: str, *, catalogs: Sequence[Path] = (), strict: bool = False) -> tuple[Lens, ImportReport]:
    """The lens of a table's text and the report of its import.

    file: its name, for messages. catalogs: further glass catalogs (.agf). strict: every warning is an error.
    Raises LensFileError, UnsupportedSurface and UnknownGlass.
    """
    report = Draft(file, "table")
    return build(parse(text, file, report), report, catalogs=catalogs), report.finished(strict=strict)


def build(table: Table, report: Draft, *, catalogs: Sequence[Path] = ()) -> Lens:
    """The lens of a table taken apart."""
    metadata, place = table.metadata, table.place
    unit = _unit(metadata)
    rows = _numbered(table)
    names = tuple(word for word in re.split(r"[\s,;]+", metadata.get("catalogs", ("", place))[0]) if word)
    report_missing_catalogs(names, catalogs, report)
    surfaces = [table_surface.build(row, unit, names, catalogs, report) for row in rows]
    surfaces = _with_object(surfaces, rows, metadata, unit)
    _check_image(rows, surfaces)
    stop = _stop(rows, metadata, len(surfaces), place)
    wavelengths, weights, primary = table_system.wavelengths(metadata, place, report)
    lens = Lens(
        surfaces=tuple(surfaces),
        stop=stop,
        aperture=table_system.aperture(metadata, surfaces[stop].semi_diameter, unit, place, report),
        fields=table_system.fields(metadata, unit, place, report),
        wavelengths=wavelengths,
        wavelength_weights=weights,
        primary_wavelength=primary,
        name=metadata.get("title", ("", place))[0],
        notes=tuple(table.notes),
        catalogs=names,
        ray_aiming=table_system.ray_aiming(metadata),
    )
    refuse_overflow(lens, place.file)
    return lens


def _unit(metadata: table_system.Metadata) -> float:
    if "units" not in metadata:
        return 1.0
    value, place = metadata["units"]
    if value.upper() not in MILLIMETRES:
        raise LensFileError(f"units is {shown(value)}, expected mm, cm, in or m", place)
    return MILLIMETRES[value.upper()]


def _words(row: Row) -> str:
    return f"{row.cells.get('type', '')} | {row.cells.get('label', '')}"


def _numbered(table: Table) -> list[Row]:
    """The rows with their surface numbers, unsupported types refused."""
    if len(table.rows) < 2:
        raise LensFileError(
            f"{len(table.rows)} rows of surfaces, expected at least one surface and the image", table.place
        )
    first = table.rows[0]
    label = first.cells.get("label", "")
    start = 0 if _OBJECT.search(_words(first)) or (is_number(label) and float(label) == 0) else 1
    rows = [Row(row.place._replace(surface=k), row.cells) for k, row in enumerate(table.rows, start)]
    table_surface.refuse_unsupported(rows)
    return rows


def _with_object(
    surfaces: list[Surface], rows: list[Row], metadata: table_system.Metadata, unit: float
) -> list[Surface]:
    """The surfaces with the object before them, at the distance of its row or of the header."""
    has_row = rows[0].place.surface == 0
    if "object distance" not in metadata:
        return surfaces if has_row else [Surface(thickness=_scalar(float("inf"))), *surfaces]
    value, place = metadata["object distance"]
    infinite = is_infinite(value) and not value.startswith("-")
    distance = float("inf") if infinite else number(value.removesuffix("mm").strip(), "object distance", place) * unit
    if not has_row:
        return [Surface(thickness=_scalar(distance)), *surfaces]
    if "thickness" in rows[0].cells and float(surfaces[0].thickness) != distance:
        raise LensFileError(f"object distance {value}, but the row of the object says otherwise", place)
    return surfaces


def _check_image(rows: list[Row], surfaces: list[Surface]) -> None:
    image = rows[-1]
    if not _IMAGE.search(_words(image)) and surfaces[-1].thickness != 0:
        message = "the last row has a thickness and is not called image: the image is missing; add a row 'Image'"
        raise LensFileError(message, image.place)
    for row in rows[:-1]:
        if _IMAGE.search(row.cells.get("type", "")):
            raise LensFileError("rows after the image; expected the image in the last row", row.place)
        if row.place.surface > 0 and "thickness" not in row.cells:
            raise LensFileError("no thickness; expected a number (0 for surfaces in contact)", row.place)
    if rows[0].place.surface == 0 and len(rows) < 3:
        raise LensFileError("only object and image; expected a surface between them", image.place)


def _stop(rows: list[Row], metadata: table_system.Metadata, count: int, table: Place) -> int:
    """The stop by the header, by the column of stops, by the type, or by the name of the row."""
    if "stop" in metadata:
        value, place = metadata["stop"]
        stop = integer(value, "stop", place)
    else:
        stop, place = _stop_row(rows, table)
    if not 0 < stop < count - 1:
        raise LensFileError(f"the stop is surface {stop}, expected 1 to {count - 2}", place)
    return stop


def _stop_row(rows: list[Row], table: Place) -> tuple[int, Place]:
    marks = ("x", "yes", "true", "1", "stop", "sto", "*", "y")
    found = [row for row in rows if row.cells.get("stop", "").lower() in marks]
    found = found or [row for row in rows if _STOP.search(row.cells.get("type", ""))]
    found = found or [row for row in rows if _STOP.search(row.cells.get("label", ""))]
    found = found or [row for row in rows if re.search(r"\bstop\b", row.cells.get("comment", ""), re.IGNORECASE)]
    if not found:
        raise LensFileError("no row is the stop; call one 'Stop', or write the header line '# stop: 6'", table)
    if len(found) > 1:
        raise LensFileError(f"a second stop; surface {found[0].place.surface} is the stop already", found[1].place)
    return found[0].place.surface, found[0].place


def _scalar(number: float) -> Tensor:
    return torch.tensor(number, dtype=torch.float64)
