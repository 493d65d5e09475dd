"""Read a prescription table as designers write them: .csv, .tsv, .txt, or any text with one row per surface.

The headings name the columns, in any order and many spellings (`table_columns`): curvature or radius, thickness,
glass, and if wanted nd and Vd, conic, semi-diameter or diameter, aspheric terms (A4 is the coefficient of r⁴),
apertures, type, comment. Header lines '# key: value' hold the system (`table_system`). Without them the lens is read
with what is stated in warnings: on axis, the d line, F/10 unless the stop row has a semi-diameter.

- An empty curvature, radius `inf` or 0 is a plane; lengths are mm unless '# units:' says otherwise.
- A column of numbers whose heading is not known, or may mean two things, is an error; '# ignore: NAME' leaves it out.
- Glass: empty or `air`; a catalog name; `MIRROR`; a number, the constant index; `1.5168/64.17` (nd/Vd) or
  `1.5168/64.17/0.0008` (nd/Vd/ΔPgF), a model glass; six digits, a MIL code; `NAME=1.33` or `NAME=1.5168/64.17`, the
  same with a name. Columns of indices and Abbe numbers define the glass of a row that names none (`table_media`).
- The stop is the row marked in a `stop` column, or called stop, aperture, diaphragm, iris; or '# stop: 6'.
- A first row called object, or numbered 0, is the object; otherwise the object lies at '# object distance', or at
  infinity.
- The last row is the image: it is called image, sensor or detector, or is a plane in air without a thickness. Where
  the last row has a thickness, the image is added behind it.
- Apertures: `circular 0 12.5` (inner, outer radius), `rectangular 3 4`, `elliptic 3 4` (half-widths), with
  `obscuration` before and `at 1 2` (centre) after; several are joined by ` + `.
- Columns `temperature` and `pressure` are of a medium that has others than the lens ('# temperature:', '# pressure:').
- A row of a type that is not modelled (coordinate break, toroid, grating …) raises UnsupportedSurface.
"""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import torch

from raytrace.io.materials import AtHand, catalogs_at_hand
from raytrace.io.report import Draft, ImportReport
from raytrace.io.source import LensFileError, shown
from raytrace.io.spelling import (
    MILLIMETRES,
    double,
    integer,
    is_infinite,
    is_number,
    number,
    plain_text,
    refuse_overflow,
    words,
)
from raytrace.io.substitutes import NONE, Substitutes
from raytrace.io.table import surfaces as table_surface
from raytrace.io.table import system as table_system
from raytrace.io.table.text import Row, Table, cleaned, parse
from raytrace.materials.glass import AIR
from raytrace.system.lens import Lens, unknown_changes
from raytrace.system.surface import Surface

_STOP = re.compile(r"\b(stop|sto|aperture|diaphragm|iris|blende|diaphragme)\b|絞り|光阑|光圈", re.IGNORECASE)
_IMAGE = re.compile(r"\b(image|ima|img|sensor|detector|bild|bildebene)\b|像面|成像|撮像|センサ", re.IGNORECASE)
_OBJECT = re.compile(r"\b(object|obj|objekt|objet)\b|物体|物面", re.IGNORECASE)


#: Where a row may be called the stop, and by what; the first column that has one counts.
_STOP_MARKS = (
    ("stop", re.compile(r"x|yes|true|1|stop|sto|\*|y", re.IGNORECASE).fullmatch),
    ("type", _STOP.search),
    ("label", _STOP.search),
    ("comment", re.compile(r"\bstop\b", re.IGNORECASE).search),
)


def read(
    text: str,
    file: str,
    *,
    catalogs: Sequence[Path] = (),
    strict: bool = False,
    substitutes: Substitutes = NONE,
) -> tuple[Lens, ImportReport]:
    """The lens of a table's text and the report of its import.

    file: its name, for messages. catalogs: further glass catalogs (.agf). strict: every warning is an error.
    substitutes: of glasses.
    Raises LensFileError, UnsupportedSurface and UnknownGlass.
    """
    report = Draft(file, "table", substitutes)
    return build(parse(text, file, report), catalogs=catalogs), report.finished(strict=strict)


def build(table: Table, *, catalogs: Sequence[Path] = (), packed: AtHand | None = None) -> Lens:
    """The lens of a table taken apart. packed: glass catalogs that come with it, instead of those beside its file."""
    unit, rows = _unit(table), _numbered(table)
    names = tuple(words(table.value("catalogs")))
    at_hand = catalogs_at_hand(names, catalogs, table.report, packed)
    surfaces = [table_surface.build(row, unit, at_hand, catalogs, table.report) for row in rows]
    _refuse_all_air(table, surfaces)
    surfaces = _with_object(surfaces, rows, table, unit)
    surfaces += _missing_image(rows, surfaces, table.report)
    _warn_of_zero_radii(rows, surfaces, table.report)
    stop = _stop(rows, table, len(surfaces))
    wavelengths, weights, primary = table_system.wavelengths(table)
    lens = Lens(
        surfaces=tuple(surfaces),
        stop=stop,
        aperture=table_system.aperture(table, surfaces[stop].semi_diameter, unit),
        fields=table_system.fields(table, unit),
        wavelengths=wavelengths,
        wavelength_weights=weights,
        primary_wavelength=primary,
        name=plain_text(table.value("title")),
        notes=tuple(table.notes),
        catalogs=names,
        ray_aiming=table_system.ray_aiming(table),
        environment=table_system.environment(table),
    )
    refuse_overflow(lens, table.place.file)
    _warn_of_environment(lens, rows, table)
    return lens


def _warn_of_environment(lens: Lens, rows: list[Row], table: Table) -> None:
    places = {row.place.surface: row.place for row in rows}
    for surface, message in unknown_changes(lens).items():
        table.report.warn(message, places.get(surface, table.place))


def _unit(table: Table) -> float:
    value, place = table.metadata.get("units", ("mm", table.place))
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
    start = (
        0 if _OBJECT.search(_words(first)) or (is_number(label) and number(label, "surface", first.place) == 0) else 1
    )
    rows = cleaned([Row(row.place._replace(surface=k), row.cells) for k, row in enumerate(table.rows, start)])
    table_surface.refuse_unsupported(rows)
    return rows


def _with_object(surfaces: list[Surface], rows: list[Row], table: Table, unit: float) -> list[Surface]:
    """The surfaces with the object before them, at the distance of its row or of the header."""
    has_row = rows[0].place.surface == 0
    told = has_row and rows[0].cells.get("thickness", "-").lower() not in ("-", "nan", "none")
    value, place = table.metadata.get("object distance", ("inf", None))
    infinite = is_infinite(value) and not value.startswith("-")
    distance = torch.inf if infinite else number(value.removesuffix("mm").strip(), "object distance", place) * unit
    if told and place and float(surfaces[0].thickness) != distance:
        raise LensFileError(f"object distance {value}, but the row of the object says otherwise", place)
    if told:
        return surfaces
    own, others = (surfaces[0], surfaces[1:]) if has_row else (Surface(thickness=double(distance)), surfaces)
    return [dataclasses.replace(own, thickness=double(distance)), *others]


def _refuse_all_air(table: Table, surfaces: list[Surface]) -> None:
    """A table that names no medium would bend no ray: its column was lost, or its heading not understood."""
    told = any(column == "glass" or column.startswith("index ") for column in table.columns if column)
    curved = any(surface.curvature is not None for surface in surfaces)
    if curved and not told and all(surface.glass is AIR for surface in surfaces):
        message = "no column names a medium, and every surface would stand in air"
        raise LensFileError(f"{message}; add a column 'glass', or 'nd' and 'Vd'", table.place)


def _missing_image(rows: list[Row], surfaces: list[Surface], report: Draft) -> list[Surface]:
    """The image, if the table ends with the last lens surface and its distance from it."""
    last = rows[-1]
    for row in rows[:-1]:
        if _IMAGE.search(row.cells.get("type", "")):
            raise LensFileError("rows after the image; expected the image in the last row", row.place)
        if row.place.surface > 0 and "thickness" not in row.cells:
            raise LensFileError("no thickness; expected a number (0 for surfaces in contact)", row.place)
    if rows[0].place.surface == 0 and len(rows) < 3:
        raise LensFileError("only object and image; expected a surface between them", last.place)
    if _IMAGE.search(_words(last)):
        return []
    if surfaces[-1].thickness != 0:
        message = f"no row of the image: added {float(surfaces[-1].thickness):g} mm behind the last surface"
        report.warn(message, last.place)
        return [Surface(thickness=double(0.0))]
    label = last.cells.get("label", "")
    ends_glass = len(surfaces) > 1 and surfaces[-2].glass.formula not in ("mirror",) and surfaces[-2].glass is not AIR
    if surfaces[-1].curvature is not None or ends_glass or surfaces[-1].glass is not AIR:
        message = "the last row is a surface of the lens without a distance to the image"
        raise LensFileError(f"{message}; fill in its thickness, or add a row 'Image'", last.place)
    if label and not re.fullmatch(r"[^\d=:]{0,12}\d+\W*", label):
        raise LensFileError(f"the last row is called {shown(label)}; call it 'Image' if it is the image", last.place)
    return []


def _warn_of_zero_radii(rows: list[Row], surfaces: list[Surface], report: Draft) -> None:
    """Radius 0 is how programs and people write a plane, and how a lost number looks."""
    found = [
        row
        for row in rows
        if is_number(row.cells.get("radius", "")) and number(row.cells["radius"], "radius", row.place) == 0
    ]
    bends = [k for k in range(1, len(surfaces)) if surfaces[k].glass is not surfaces[k - 1].glass]
    found = [row for row in found if row.place.surface in bends]
    if found:
        listed = ", ".join(str(row.place.surface) for row in found)
        message = f"radius 0 of surface {listed} is taken as a plane; write inf if it is one"
        report.warn(message, found[0].place._replace(surface=None))


def _stop(rows: list[Row], table: Table, count: int) -> int:
    """The stop by the header, by the column of stops, by the type, or by the name of the row."""
    if "stop" in table.metadata:
        value, place = table.metadata["stop"]
        stop = integer(value, "stop", place)
    else:
        place = _stop_row(rows, table).place
        stop = place.surface
    if not 0 < stop < count - 1:
        raise LensFileError(f"the stop is surface {stop}, expected 1 to {count - 2}", place)
    return stop


def _stop_row(rows: list[Row], table: Table) -> Row:
    for column, mark in _STOP_MARKS:
        found = [row for row in rows if mark(row.cells.get(column, ""))]
        if len(found) > 1:
            message = f"a second stop; surface {found[0].place.surface} is the stop already"
            raise LensFileError(message, found[1].place)
        if found:
            return found[0]
    raise LensFileError("no row is the stop; call one 'Stop', or write the header line '# stop: 6'", table.place)
