"""Read a prescription table: .csv, .tsv, .txt, or any text with one row per surface.

The headings name the columns, in any order and many spellings (`table.columns`): curvature or radius, thickness,
glass, and if wanted nd and Vd, conic, semi-diameter or diameter, aspheric terms (A4 is the coefficient of r⁴),
apertures, type, comment. Header lines '# key: value' hold the system (`table.system`). Without them the lens is read
with assumptions that are stated in warnings: on axis, the d line, F/10 unless the stop row has a semi-diameter.

- An empty curvature, radius `inf` or 0 is a plane; lengths are mm unless '# units:' says otherwise.
- A column of numbers whose heading is not known, or may mean two things, is an error; '# ignore: NAME' leaves it out.
- Glass: empty or `air`; a catalog name; `MIRROR`; a number, the constant index; `1.5168/64.17` (nd/Vd) or
  `1.5168/64.17/0.0008` (nd/Vd/ΔPgF), a model glass; six digits, a MIL code; `NAME=1.33` or `NAME=1.5168/64.17`, the
  same with a name. Columns of indices and Abbe numbers define the glass of a row that names none.
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

from raytrace.io.assembly import AtHand, LensDraft, assemble, catalogs_of_lens
from raytrace.io.report import Draft
from raytrace.io.source import (
    MILLIMETRES,
    LensFileError,
    Place,
    double,
    integer,
    is_infinite,
    is_number,
    number,
    plain_text,
    shown,
    words,
)
from raytrace.io.table import surfaces as table_surfaces
from raytrace.io.table import system as table_system
from raytrace.io.table.text import Row, Table, cleaned, parse
from raytrace.materials.glass import AIR
from raytrace.system.lens import Lens, unknown_changes
from raytrace.system.surface import Surface

_STOP = re.compile(r"\b(stop|sto|aperture|diaphragm|iris|blende|diaphragme)\b|絞り|光阑|光圈", re.IGNORECASE)
_IMAGE = re.compile(r"\b(image|ima|img|sensor|detector|bild|bildebene)\b|像面|成像|撮像|センサ", re.IGNORECASE)
_OBJECT = re.compile(r"\b(object|obj|objekt|objet)\b|物体|物面", re.IGNORECASE)


#: Columns in which a row may be called the stop, and its names there; the first column that has one counts.
_STOP_MARKS = (
    ("stop", re.compile(r"x|yes|true|1|stop|sto|\*|y", re.IGNORECASE).fullmatch),
    ("type", _STOP.search),
    ("label", _STOP.search),
    ("comment", re.compile(r"\bstop\b", re.IGNORECASE).search),
)


def read(text: str, file: str, report: Draft, catalogs: Sequence[Path] = ()) -> Lens:
    """The lens of a table's text; report: filled. Raises LensFileError, UnsupportedSurface and UnknownGlass."""
    return build(parse(text, file, report), catalogs=catalogs)


def build(table: Table, *, catalogs: Sequence[Path] = (), packed: AtHand | None = None) -> Lens:
    """The lens of a parsed table. packed: its glass catalogs, instead of those in the folder of its file."""
    value, place = table.metadata.get("units", ("mm", table.place))
    if value.upper() not in MILLIMETRES:
        raise LensFileError(f"units is {shown(value)}, expected mm, cm, in or m", place)
    unit, rows = MILLIMETRES[value.upper()], _numbered(table)
    names = tuple(words(table.value("catalogs")))
    came = catalogs_of_lens(names, catalogs, table.report, packed)
    surfaces = [table_surfaces.build(row, unit, came, catalogs, table.report) for row in rows]
    # a table that names no medium would refract nothing: its column was lost, or its heading not understood
    has_media = any(column == "glass" or column.startswith("index ") for column in table.columns if column)
    if not has_media and any(s.curvature is not None for s in surfaces) and all(s.glass is AIR for s in surfaces):
        message = "no column names a medium, and every surface would be in air"
        raise LensFileError(f"{message}; add a column 'glass', or 'nd' and 'Vd'", table.place)
    surfaces = _with_object(surfaces, rows, table, unit)
    surfaces += _missing_image(rows, surfaces, table.report)
    _warn_of_zero_radii(rows, surfaces, table.report)
    stop, place = _stop(rows, table)
    semi_diameter = surfaces[stop].semi_diameter if 0 <= stop < len(surfaces) else None
    kind, size = table_system.aperture(table, semi_diameter, unit)
    draft = LensDraft(
        surfaces=surfaces,
        stop=stop,
        aperture_kind=kind,
        aperture=size,
        **table_system.fields(table, unit),
        **table_system.wavelengths(table),
        name=plain_text(table.value("title")),
        notes=tuple(table.notes),
        catalogs=names,
        ray_aiming=table_system.ray_aiming(table),
        environment=table_system.environment(table),
        sources={
            key.replace(" ", "_"): (f"the {key}", table.metadata[key][1])
            for key in ("wavelengths", "wavelength weights", "primary wavelength")
            if key in table.metadata
        },
    )
    draft.sources["stop"] = ("the stop", place)
    value, place = table.metadata.get("aperture", ("", table.place))
    draft.sources["aperture"] = (f"the aperture is {shown(value)}", place)
    lens = assemble(draft, table.place.file)
    places = {row.place.surface: row.place for row in rows}
    for surface, message in unknown_changes(lens).items():
        table.report.warn(message, places.get(surface, table.place))
    return lens


def _words(row: Row) -> str:
    return f"{row.cells.get('type', '')} | {row.cells.get('label', '')}"


def _numbered(table: Table) -> list[Row]:
    """The rows with their surface numbers, unsupported types refused."""
    if len(table.rows) < 2:
        message = f"{len(table.rows)} rows of surfaces, expected at least one surface and the image"
        raise LensFileError(message, table.place)
    first = table.rows[0]
    label = first.cells.get("label", "")
    is_object = _OBJECT.search(_words(first)) or (is_number(label) and number(label, "surface", first.place) == 0)
    start = 0 if is_object else 1
    rows = cleaned([Row(row.place._replace(surface=k), row.cells) for k, row in enumerate(table.rows, start)])
    table_surfaces.refuse_unsupported(rows)
    return rows


def _with_object(surfaces: list[Surface], rows: list[Row], table: Table, unit: float) -> list[Surface]:
    """The surfaces with the object before them, at the distance of its row or of the header."""
    has_row = rows[0].place.surface == 0
    is_given = has_row and rows[0].cells.get("thickness", "-").lower() not in ("-", "nan", "none")
    value, place = table.metadata.get("object distance", ("inf", None))
    infinite = is_infinite(value) and not value.startswith("-")
    distance = torch.inf if infinite else number(value.removesuffix("mm").strip(), "object distance", place) * unit
    if is_given and place and float(surfaces[0].thickness) != distance:
        raise LensFileError(f"object distance {value}, but the row of the object has another", place)
    if is_given:
        return surfaces
    own, others = (surfaces[0], surfaces[1:]) if has_row else (Surface(thickness=double(distance)), surfaces)
    return [dataclasses.replace(own, thickness=double(distance)), *others]


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
    """Warn of radius 0 of a refracting surface, which is a plane or a missing number."""
    refracting = [k for k in range(1, len(surfaces)) if surfaces[k].glass is not surfaces[k - 1].glass]
    places = []
    for row in rows:
        radius = row.cells.get("radius", "")
        if row.place.surface in refracting and is_number(radius) and number(radius, "radius", row.place) == 0:
            places.append(row.place)
    if places:
        listed = ", ".join(str(place.surface) for place in places)
        message = f"radius 0 of surface {listed} is taken as a plane; write inf if it is one"
        report.warn(message, places[0]._replace(surface=None))


def _stop(rows: list[Row], table: Table) -> tuple[int, Place]:
    """The stop by the header, by the column of stops, by the type, or by the name of the row."""
    if "stop" in table.metadata:
        value, place = table.metadata["stop"]
        return integer(value, "stop", place), place
    for column, mark in _STOP_MARKS:
        marked = [row.place for row in rows if mark(row.cells.get(column, ""))]
        if len(marked) > 1:
            raise LensFileError(f"a second stop; surface {marked[0].surface} is the stop already", marked[1])
        if marked:
            return marked[0].surface, marked[0]
    raise LensFileError("no row is the stop; call one 'Stop', or write the header line '# stop: 6'", table.place)
