"""Read a prescription table: .csv, .tsv, .txt, or any text with one row per surface.

The headings name the columns, in any order and many spellings (`table.columns`): curvature or radius, thickness,
glass, and if wanted nd and Vd, conic, semi-diameter or diameter, aspheric terms (A4 is the coefficient of r⁴),
apertures, type, comment. Header lines '# key: value' hold the system (`table.system`). Without them the lens is read
with assumptions that are stated in warnings: on axis, the d line, F/10 unless the stop row has a semi-diameter.

- An empty curvature, radius `inf` or 0 is a plane; lengths are mm unless '# units:' states another unit.
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
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace.io.assembly import (
    CatalogSources,
    LensDraft,
    assemble,
    by_figures,
    catalogs_of_lens,
    clear_aperture,
    is_code,
    listed_glass,
    with_written_automatic,
    with_written_conditions,
    with_written_variables,
)
from raytrace.io.source import (
    MILLIMETRES,
    Draft,
    LensFileError,
    Place,
    UnsupportedSurface,
    double,
    integer,
    is_infinite,
    is_number,
    nonzero,
    number,
    plain_text,
    shown,
    words,
)
from raytrace.io.table import system as table_system
from raytrace.io.table.columns import order
from raytrace.io.table.system import ENVIRONMENT, environment_of
from raytrace.io.table.text import Row, Table, cleaned, parse
from raytrace.materials.catalogs import Catalog
from raytrace.materials.glass import (
    AIR,
    LINES,
    MIRROR,
    MODEL_LINES,
    Glass,
    constant,
    mil_glass,
    model_glass,
    refractive_index,
)
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.lens import Lens, unknown_changes
from raytrace.system.shapes import KINDS
from raytrace.system.surface import Surface

#: Spellings of the Abbe number of air or of a medium without dispersion.
_NOTHING = ("", "-", "0", "0.0", "∞", "inf", "infinity", "nan", "none")


def _figures(cells: dict[str, str]) -> dict[str, str]:
    """The cells of a row that give its medium by numbers, by column: "index d", "abbe d", "pgf", "dpgf"."""
    is_figure = re.compile("index .*|abbe .*|d?pgf").fullmatch
    return {name: cell for name, cell in cells.items() if is_figure(name) and cell.lower() not in _NOTHING}


def _medium(cells: dict[str, str], place: Place, report: Draft) -> Glass:
    """The medium of a row without a named glass; air where no figure is given.

    One index alone is constant. n_d, V_d and ΔP_gF are kept unchanged; any other set of figures is met by the model
    glass n = A + B/λ + C/λ^3.5 (`raytrace.materials.glass`), on the normal line of glasses where two are
    given, by least squares where more than three are.
    """
    figures = {name: number(cell, name.replace("_", " "), place) for name, cell in _figures(cells).items()}
    indices = {name.split()[1]: value for name, value in figures.items() if name.startswith("index")}
    if not indices:
        if figures:
            name = next(iter(figures))
            raise LensFileError(f"{name} is {figures[name]:g}, but no index is given; fill in nd", place)
        return AIR
    for line, value in indices.items():
        if not 0 < value < 100:
            raise LensFileError(f"index {line} is {value:g}, expected a positive number, as 1.5168", place)
    if any(value <= 0 for name, value in figures.items() if name.startswith("abbe")):
        raise LensFileError(f"an Abbe number of {min(figures.values()):g}, expected a positive one", place)
    if all(value == 1 for value in indices.values()):
        return AIR
    if len(figures) == 1:
        line, value = indices.popitem()
        of_line = "" if line == "d" else f" (given at {line})"
        report.glass(place, "", f"constant index {value!r}{of_line}")
        return constant(value)
    if figures.keys() <= {"index d", "abbe d", "dpgf"} and "abbe d" in figures:
        numbers = tuple(figures.get(name, 0.0) for name in ("index d", "abbe d", "dpgf"))
    else:
        numbers = _fitted(indices, figures, place)
    written = "/".join(f"{value:.7g}" for value in numbers if value)
    report.glass(place, "", f"model glass {written} by {', '.join(figures)}")
    return model_glass(*numbers)


def _fitted(indices: dict[str, float], figures: dict[str, float], place: Place) -> tuple[float, float, float]:
    """n_d, V_d, ΔP_gF of the model glass through figures that are linear in its A, B, C."""

    def at_lines(lines: Mapping[str, float]) -> dict[str, np.ndarray]:
        return {line: np.array([1.0, 1 / wave, wave**-3.5]) for line, wave in lines.items()}

    terms, model = at_lines(LINES), at_lines(MODEL_LINES)  # the model's are rounded
    blue_red, violet_blue = terms["F"] - terms["C"], terms["g"] - terms["F"]
    dispersion, violet = model["F"] - model["C"], model["g"] - model["F"]
    normal = violet - 0.6438 * dispersion + 0.001682 * model["d"]
    rows = [(terms[line], value) for line, value in indices.items()]
    for name, value in figures.items():
        kind, _, line = name.partition(" ")
        if kind == "abbe":
            span = terms["F'"] - terms["C'"] if line == "e" else blue_red
            rows.append((value * span - terms[line], -1.0))
        elif kind == "pgf":
            rows.append((violet_blue - value * blue_red, 0.0))
        elif kind == "dpgf":
            rows.append((normal - value * dispersion, 0.001682))
    if len(rows) == 2:
        rows.append((normal, 0.001682))
    matrix, wanted = np.array([row for row, _ in rows]), np.array([value for _, value in rows])
    scale = np.abs(matrix).max(1)
    solution, *_ = np.linalg.lstsq(matrix / scale[:, None], wanted / scale, rcond=None)
    nd, spread = float(model["d"] @ solution), float(dispersion @ solution)
    for line, value in indices.items():
        if abs(float(terms[line] @ solution) - value) > 1e-4:
            listed = ", ".join(f"{name} {value:g}" for name, value in figures.items())
            raise LensFileError(f"no glass has {shown(listed)}; is a column named wrongly?", place)
    if not (spread > 0 and nd > 1):
        raise LensFileError(f"an index that rises with the wavelength ({', '.join(figures)}); columns mixed up?", place)
    abbe = (nd - 1) / spread
    return nd, abbe, float(violet @ solution) / spread - 0.6438 + 0.001682 * abbe


_AIR = ("", "air", "-", "none", "nan", "vacuum", "luft", "空気", "空气")
_MIRROR = re.compile(r"\b(mirror|reflect|reflecting|refl)\b", re.IGNORECASE)

#: Words of a type, in addition to those of `shapes.KINDS`. Any other word is a shape that is not modelled.
_TYPE = re.compile(
    r"standard|spher(e|ical)|plan(e|o)?|flat|conic(oid)?|aspher(e|ic|ical)|lens|surface|s"
    r"|stop|sto|aperture|diaphragm|iris|image|ima|img|sensor|detector|object|obj"
    r"|mirror|refl|reflect(ing)?|refr|refract(ing)?|dummy|planar"
)
_UNSUPPORTED = re.compile(
    r"coord|toroid|toric|cylind|grating|biconic|anamorph|paraxial|zernike|free.?form|odd.?asph|fresnel|binary|\bgrin\b"
    r"|hologram|diffract|decent|tilt",
    re.IGNORECASE,
)


def _refuse_unsupported(rows: Sequence[Row]) -> None:
    """Raise UnsupportedSurface for the first row whose type, or name, is that of a surface that is not modelled."""
    words_of_kinds = {word for kind in KINDS.values() for word in kind.words}
    for row in rows:
        kind, label = row.cells.get("type", ""), row.cells.get("label", "")
        unknown = any(not _TYPE.fullmatch(word) and word not in words_of_kinds for word in _words(kind))
        other = _UNSUPPORTED.search(label) and not words_of_kinds & set(_words(label))
        refused = kind if unknown else label if other else ""
        if refused:
            message = f"type {shown(refused)} is not modelled; modelled are conics and {', '.join(KINDS)}s"
            raise UnsupportedSurface(message, row.place)


def _words(text: str) -> list[str]:
    return re.findall(r"[^\W\d_]+", text.lower())


def _surface(row: Row, unit: float, catalogs: Sequence[str | Catalog], user: Sequence[Path], report: Draft) -> Surface:
    """The surface of a row, its lengths in units of `unit` mm."""
    cells, place = row.cells, row.place
    conic, distance = _cell(row, "conic"), cells.get("thickness", "")
    is_far = is_infinite(distance) and place.surface == 0 and not distance.startswith("-")
    thickness = float("inf") if is_far else _cell(row, "thickness")
    kind, coefficients = _terms(row, unit)
    environment = [key for key in ENVIRONMENT if key in cells]
    if len(environment) == 1:
        raise LensFileError(f"a {environment[0]} alone; give {' and '.join(ENVIRONMENT)}, or neither", place)
    return Surface(
        thickness=double(0.0 if thickness is None else thickness * unit),
        curvature=_curvature(row, unit),
        conic=nonzero(conic),
        coefficients=coefficients,
        kind=kind,
        glass=_glass(row, catalogs, user, report),
        semi_diameter=_semi_diameter(row, unit),
        chip_zone=_size(row, "chip_zone", unit),
        mechanical_semi_diameter=_size(row, "mechanical_semi_diameter", unit),
        apertures=tuple(
            _aperture(text, unit, place) for text in re.split(r"\s\+\s", cells.get("apertures", "")) if text.strip()
        ),
        environment=environment_of(cells, place) if environment else None,
        expansion=None if (stated := _cell(row, "expansion")) is None else double(stated),
        comment=cells.get("comment") or ("" if is_number(cells.get("label", "0")) else cells["label"]),
    )


def _cell(row: Row, column: str) -> float | None:
    """The number of a cell, None if it is empty."""
    text = row.cells.get(column)
    if text is None or text.lower() in ("-", "nan", "none"):
        return None
    return number(text, column, row.place)


def _curvature(row: Row, unit: float) -> Tensor | None:
    curvature = _cell(row, "curvature")
    radius = None if is_infinite(row.cells.get("radius", "")) else _cell(row, "radius")
    if radius and not abs(radius) > 1e-300:
        raise LensFileError(f"radius is {radius:g}, too small", row.place)
    if radius and curvature and abs(radius * curvature - 1) > 1e-3:
        raise LensFileError(f"curvature {curvature:g} and radius {radius:g} contradict each other", row.place)
    value = curvature if curvature is not None else 1 / radius if radius else 0.0
    return nonzero(value / unit)


def _terms(row: Row, unit: float) -> tuple[str, Tensor | None]:
    """The kind that the type names, or the first that fits; and its a_j up to the last cell that is filled."""
    powers = {n: column for column in row.cells if (n := order(column)) is not None}
    cells = {n: _cell(row, column) for n, column in powers.items()}
    terms = {n: term for n, term in cells.items() if term is not None}
    words = set(_words(row.cells.get("type", "")))
    named_first = sorted(KINDS.values(), key=lambda kind: not words & set(kind.words))
    kind = next(kind for kind in named_first if not any(term and n % kind.step for n, term in terms.items()))
    last = max((n for n in terms if n % kind.step == 0), default=0)
    numbers = [terms.get(n, 0.0) / unit ** (n - 1) for n in range(kind.step, last + 1, kind.step)]
    return kind.name, double(numbers) if numbers else None


def _semi_diameter(row: Row, unit: float) -> float | None:
    semi_diameter, diameter = _cell(row, "semi_diameter"), _cell(row, "diameter")
    size = semi_diameter if semi_diameter is not None else (diameter or 0.0) / 2
    if size < 0:
        raise LensFileError(f"semi-diameter is {size:g}, expected 0 or more", row.place)
    return size * unit or None


def _size(row: Row, column: str, unit: float) -> float | None:
    size = _cell(row, column) or 0.0
    if size < 0:
        raise LensFileError(f"{column} is {size:g}, expected 0 or more", row.place)
    return size * unit or None


def _glass(row: Row, catalogs: Sequence[str | Catalog], user: Sequence[Path], report: Draft) -> Glass:
    text, place = row.cells.get("glass", ""), row.place
    numbers = _figures(row.cells)
    if text.lower() in _AIR or (numbers and text.lower() == "unknown"):
        glass = MIRROR if _MIRROR.search(row.cells.get("type", "")) else _medium(row.cells, place, report)
        if text and text.lower() in _AIR[1:] and text != "-" and glass not in (AIR, MIRROR):
            raise LensFileError(
                f"the medium is {shown(text)}, but its figures are {', '.join(numbers.values())}", place
            )
        return glass
    if text.lower() in ("mirror", "refl", "reflect"):
        return MIRROR
    name, equals, digits = text.partition("=")
    digits = digits if equals else text
    name = name.strip() if equals else ""
    if not equals and is_code(text):
        report.glass(place, text, "six-digit code: nd and Vd by its digits")
        return mil_glass(text)
    if equals or all(is_number(part.strip()) for part in digits.split("/")):
        return _by_figures(name, digits, place, report)
    nearest = None
    if "index d" in numbers and "abbe d" in numbers:
        index, abbe = (number(numbers[name], "index or Abbe number", place) for name in ("index d", "abbe d"))
        nearest = index, abbe
    glass = listed_glass(text, catalogs=catalogs, user=user, place=place, report=report, figures=nearest)
    for name, cell in numbers.items():
        kind, _, line = name.partition(" ")
        listed = float(refractive_index(glass, double(LINES[line]))) if kind == "index" else 0.0
        if kind == "index" and abs(listed - number(cell, name, place)) > 2e-3:
            report.warn(f"index {cell} stated for {text}, whose n{line} is {listed:.5f}; the catalog is used", place)
    return glass


def _by_figures(name: str, digits: str, place: Place, report: Draft) -> Glass:
    """A medium by its numbers: n, nd/Vd or nd/Vd/ΔPgF."""
    values = [number(part.strip(), "glass", place) for part in digits.split("/")]
    nd, vd, dpgf = [*values, 0.0, 0.0][:3]
    if len(values) > 3 or nd <= 0 or vd < 0:
        raise LensFileError(f"glass is {shown(digits)}, expected an index, nd/Vd or nd/Vd/ΔPgF", place)
    if nd == 1 and vd == 0 and not name:
        return AIR
    report.glass(place, name, f"constant index {nd!r}" if vd == dpgf == 0 else f"model glass {digits}")
    return by_figures(nd, vd, dpgf, name)


def _aperture(text: str, unit: float, place: Place) -> Aperture:
    words = text.lower().split()
    obscures = words[0] == "obscuration"
    words = words[1:] if obscures else words
    count = words.index("at") if "at" in words else len(words)  # of the words of the shape
    shape = SHAPES.get(words[0]) if words else None
    if (
        shape is None
        or count - 1 != (shape.sizes or count - 1)
        or len(words[count + 1 :]) != (2 if words[count:] else 0)
    ):
        expected = "expected for example 'circular 0 12.5' or 'rectangular 3 4'"
        raise LensFileError(f"aperture is {shown(text)}, {expected}", place)
    sizes = tuple(number(word, "size of the aperture", place) * unit for word in words[1:count])
    x, y = [number(word, "centre of the aperture", place) * unit for word in words[count + 1 :]] or [0.0, 0.0]
    return clear_aperture(words[0], sizes, obscures, (x, y), f"aperture {shown(text)}", place)


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


def build(table: Table, *, catalogs: Sequence[Path] = (), packed: CatalogSources | None = None) -> Lens:
    """The lens of a parsed table. packed: its glass catalogs, instead of those in the folder of its file."""
    value, place = table.metadata.get("units", ("mm", table.place))
    if value.upper() not in MILLIMETRES:
        raise LensFileError(f"units is {shown(value)}, expected mm, cm, in or m", place)
    unit, rows = MILLIMETRES[value.upper()], _numbered(table)
    names = tuple(words(table.value("catalogs")))
    came = catalogs_of_lens(names, catalogs, table.report, packed)
    surfaces = [_surface(row, unit, came, catalogs, table.report) for row in rows]
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
    lens = with_written_automatic(lens, *table.metadata.get("automatic", ("", table.place)))
    lens = with_written_variables(lens, *table.metadata.get("variables", ("", table.place)))
    return with_written_conditions(lens, *table.metadata.get("conditions", ("", table.place)))


def _numbered(table: Table) -> list[Row]:
    """The rows with their surface numbers, unsupported types refused."""
    if len(table.rows) < 2:
        message = f"{len(table.rows)} rows of surfaces, expected at least one surface and the image"
        raise LensFileError(message, table.place)
    first = table.rows[0]
    label = first.cells.get("label", "")
    is_object = _OBJECT.search(f"{first.cells.get('type', '')} | {label}") or (
        is_number(label) and number(label, "surface", first.place) == 0
    )
    start = 0 if is_object else 1
    rows = cleaned([Row(row.place._replace(surface=k), row.cells) for k, row in enumerate(table.rows, start)])
    _refuse_unsupported(rows)
    return rows


def _with_object(surfaces: list[Surface], rows: list[Row], table: Table, unit: float) -> list[Surface]:
    """The surfaces with the object before them, at the distance of its row or of the header."""
    has_row = rows[0].place.surface == 0
    is_given = has_row and rows[0].cells.get("thickness", "-").lower() not in ("-", "nan", "none")
    is_stated = "object distance" in table.metadata
    value, place = table.metadata.get("object distance", ("inf", table.place))
    infinite = is_infinite(value) and not value.startswith("-")
    distance = torch.inf if infinite else number(value.removesuffix("mm").strip(), "object distance", place) * unit
    if is_given and is_stated and float(surfaces[0].thickness) != distance:
        raise LensFileError(f"object distance {value}, but the row of the object has another", place)
    if is_given:
        return surfaces
    first, others = (surfaces[0], surfaces[1:]) if has_row else (Surface(thickness=double(distance)), surfaces)
    return [dataclasses.replace(first, thickness=double(distance)), *others]


def _missing_image(rows: list[Row], surfaces: list[Surface], report: Draft) -> list[Surface]:
    """The image, if the table ends with the last lens surface and its distance from it."""
    last = rows[-1]
    for row in rows[:-1]:
        if _IMAGE.search(row.cells.get("type", "")):
            raise LensFileError("rows after the image; expected the image in the last row", row.place)
        if row.place.surface and "thickness" not in row.cells:
            raise LensFileError("no thickness; expected a number (0 for surfaces in contact)", row.place)
    if rows[0].place.surface == 0 and len(rows) < 3:
        raise LensFileError("only object and image; expected a surface between them", last.place)
    label = last.cells.get("label", "")
    if _IMAGE.search(f"{last.cells.get('type', '')} | {label}"):
        return []
    if surfaces[-1].thickness != 0:
        message = f"no row of the image: added {float(surfaces[-1].thickness):g} mm behind the last surface"
        report.warn(message, last.place)
        return [Surface(thickness=double(0.0))]
    ends_glass = len(surfaces) > 1 and not surfaces[-2].is_mirror and surfaces[-2].glass is not AIR
    if surfaces[-1].curvature is not None or ends_glass or surfaces[-1].glass is not AIR:
        message = "the last row is a surface of the lens without a distance to the image"
        raise LensFileError(f"{message}; fill in its thickness, or add a row 'Image'", last.place)
    if label and not re.fullmatch(r"[^\d=:]{0,12}\d+\W*", label):
        raise LensFileError(f"the last row is called {shown(label)}; call it 'Image' if it is the image", last.place)
    return []


def _warn_of_zero_radii(rows: list[Row], surfaces: list[Surface], report: Draft) -> None:
    """Warn of radius 0 of a refracting surface, which is a plane or a missing number."""
    refracting = [k for k in range(1, len(surfaces)) if surfaces[k].glass is not surfaces[k - 1].glass]
    radii = [(row.place, row.cells.get("radius", "")) for row in rows if row.place.surface in refracting]
    places = [place for place, cell in radii if is_number(cell) and number(cell, "radius", place) == 0]
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
            return marked[0].surface or 0, marked[0]
    raise LensFileError("no row is the stop; call one 'Stop', or write the header line '# stop: 6'", table.place)
