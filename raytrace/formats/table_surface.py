"""A row of a prescription table as a `Surface`: shape, medium and apertures."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from torch import Tensor

from raytrace.formats.media import by_figures, is_code, listed_glass
from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, Place, UnsupportedSurface, shown
from raytrace.formats.spelling import double, is_infinite, is_number, number
from raytrace.formats.table_columns import order
from raytrace.formats.table_media import figures as figures_of
from raytrace.formats.table_media import medium
from raytrace.formats.table_system import ENVIRONMENT, environment_of
from raytrace.formats.table_text import Row
from raytrace.media.catalog import Catalog
from raytrace.media.environment import Environment
from raytrace.media.glass import AIR, LINES, MIRROR, Glass, mil_glass, refractive_index
from raytrace.system.aperture import SHAPES, Aperture
from raytrace.system.shapes import KINDS
from raytrace.system.surface import Surface

_AIR = ("", "air", "-", "none", "nan", "vacuum", "luft", "空気", "空气")
_MIRROR = re.compile(r"\b(mirror|reflect|reflecting|refl)\b", re.IGNORECASE)

#: What a type may be called, beside the words of `shapes.KINDS`. Any other word is a shape that is not modelled.
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


def refuse_unsupported(rows: Sequence[Row]) -> None:
    """Raise UnsupportedSurface for the first row whose type, or name, is that of a surface that is not modelled."""
    own = {word for kind in KINDS.values() for word in kind.words}
    for row in rows:
        kind, label = row.cells.get("type", ""), row.cells.get("label", "")
        unknown = any(not _TYPE.fullmatch(word) and word not in own for word in _words(kind))
        other = _UNSUPPORTED.search(label) and not own & set(_words(label))
        found = kind if unknown else label if other else ""
        if found:
            message = f"type {shown(found)} is not modelled; modelled are conics and {', '.join(KINDS)}s"
            raise UnsupportedSurface(message, row.place)


def _words(text: str) -> list[str]:
    return re.findall(r"[^\W\d_]+", text.lower())


def build(row: Row, unit: float, catalogs: Sequence[str | Catalog], user: Sequence[Path], report: Draft) -> Surface:
    """The surface of a row, its lengths in units of `unit` mm."""
    cells, place = row.cells, row.place
    conic = _cell(row, "conic")
    kind, coefficients = _terms(row, unit)
    return Surface(
        thickness=double(_thickness(row) * unit),
        curvature=_curvature(row, unit),
        conic=double(conic) if conic else None,
        coefficients=coefficients,
        kind=kind,
        glass=_glass(row, catalogs, user, report),
        semi_diameter=_semi_diameter(row, unit),
        apertures=tuple(_aperture(text, unit, place) for text in _several(cells.get("apertures", ""))),
        environment=_environment(cells, place),
        comment=cells.get("comment") or ("" if is_number(cells.get("label", "0")) else cells["label"]),
    )


def _environment(cells: Mapping[str, str], place: Place) -> Environment | None:
    told = [key for key in ENVIRONMENT if key in cells]
    if len(told) == 1:
        raise LensFileError(f"a {told[0]} alone; give {' and '.join(ENVIRONMENT)}, or neither", place)
    return environment_of(cells, place) if told else None


def _cell(row: Row, column: str) -> float | None:
    """The number of a cell, None if it is empty."""
    text = row.cells.get(column)
    if text is None or text.lower() in ("-", "nan", "none"):
        return None
    return number(text, column, row.place)


def _thickness(row: Row) -> float:
    text = row.cells.get("thickness", "")
    if is_infinite(text) and row.place.surface == 0 and not text.startswith("-"):
        return float("inf")
    found = _cell(row, "thickness")
    return 0.0 if found is None else found


def _curvature(row: Row, unit: float) -> Tensor | None:
    curvature = _cell(row, "curvature")
    radius = None if is_infinite(row.cells.get("radius", "")) else _cell(row, "radius")
    if radius and not abs(radius) > 1e-300:
        raise LensFileError(f"radius is {radius:g}, too small", row.place)
    if radius and curvature and abs(radius * curvature - 1) > 1e-3:
        raise LensFileError(f"curvature {curvature:g} and radius {radius:g} contradict each other", row.place)
    found = curvature if curvature is not None else 1 / radius if radius else 0.0
    return double(found / unit) if found else None


def _terms(row: Row, unit: float) -> tuple[str, Tensor | None]:
    """The kind that the type names, or the first that fits; and its a_j up to the last cell that is filled."""
    powers = {n: column for column in row.cells if (n := order(column)) is not None}
    terms = {n: found for n, column in powers.items() if (found := _cell(row, column)) is not None}
    words = set(_words(row.cells.get("type", "")))
    named_first = sorted(KINDS.values(), key=lambda kind: not words & set(kind.words))
    kind = next(kind for kind in named_first if not any(found and n % kind.step for n, found in terms.items()))
    last = max((n for n in terms if n % kind.step == 0), default=0)
    numbers = [terms.get(n, 0.0) / unit ** (n - 1) for n in range(kind.step, last + 1, kind.step)]
    return kind.name, double(numbers) if numbers else None


def _semi_diameter(row: Row, unit: float) -> float | None:
    semi_diameter, diameter = _cell(row, "semi_diameter"), _cell(row, "diameter")
    found = semi_diameter if semi_diameter is not None else (diameter or 0.0) / 2
    if found < 0:
        raise LensFileError(f"semi-diameter is {found:g}, expected 0 or more", row.place)
    return found * unit or None


def _glass(row: Row, catalogs: Sequence[str | Catalog], user: Sequence[Path], report: Draft) -> Glass:
    text, place = row.cells.get("glass", ""), row.place
    given = figures_of(row.cells)
    if text.lower() in _AIR or (given and text.lower() == "unknown"):
        found = MIRROR if _MIRROR.search(row.cells.get("type", "")) else medium(row.cells, place, report)
        if text and text.lower() in _AIR[1:] and text != "-" and found not in (AIR, MIRROR):
            raise LensFileError(f"the medium is {shown(text)}, but its figures are {', '.join(given.values())}", place)
        return found
    if text.lower() in ("mirror", "refl", "reflect"):
        return MIRROR
    name, equals, figures = text.partition("=")
    figures = figures if equals else text
    name = name.strip() if equals else ""
    if not equals and is_code(text):
        report.glass(place.surface, text, "six-digit code: nd and Vd by its digits")
        return mil_glass(text)
    if equals or all(is_number(part.strip()) for part in figures.split("/")):
        return _by_figures(name, figures, place, report)
    how = {"catalogs": catalogs, "user": user, "place": place, "report": report}
    glass = listed_glass(text, **how, figures=_d_line(given, place))
    for name, cell in given.items():
        kind, _, line = name.partition(" ")
        listed = float(refractive_index(glass, double(LINES[line]))) if kind == "index" else 0.0
        if kind == "index" and abs(listed - number(cell, name, place)) > 2e-3:
            report.warn(f"index {cell} stated for {text}, whose n{line} is {listed:.5f}; the catalog is used", place)
    return glass


def _d_line(given: dict[str, str], place: Place) -> tuple[float, float] | None:
    """n_d and V_d among the cells of a row, None where they do not both stand there."""
    cells = [given.get(name) for name in ("index d", "abbe d")]
    return None if None in cells else tuple(number(cell, "figure of the glass", place) for cell in cells)


def _by_figures(name: str, figures: str, place: Place, report: Draft) -> Glass:
    """A medium by its numbers: n, nd/Vd or nd/Vd/ΔPgF."""
    values = [number(part.strip(), "glass", place) for part in figures.split("/")]
    nd, vd, dpgf = [*values, 0.0, 0.0][:3]
    if len(values) > 3 or nd <= 0 or vd < 0:
        raise LensFileError(f"glass is {shown(figures)}, expected an index, nd/Vd or nd/Vd/ΔPgF", place)
    if nd == 1 and vd == 0 and not name:
        return AIR
    report.glass(place.surface, name, f"constant index {nd!r}" if vd == dpgf == 0 else f"model glass {figures}")
    return by_figures(nd, vd, dpgf, name)


def _several(text: str) -> list[str]:
    """The apertures of a cell, joined by a plus between blanks."""
    return [part for part in re.split(r"\s\+\s", text) if part.strip()]


def _aperture(text: str, unit: float, place: Place) -> Aperture:
    words = text.lower().split()
    obscures = words[0] == "obscuration"
    words = words[1:] if obscures else words
    at = words.index("at") if "at" in words else len(words)
    shape = SHAPES.get(words[0]) if words else None
    if shape is None or at - 1 != (shape.sizes or at - 1) or len(words[at + 1 :]) != (2 if words[at:] else 0):
        raise LensFileError(
            f"aperture is {shown(text)}, expected for example 'circular 0 12.5' or 'rectangular 3 4'", place
        )
    sizes = tuple(number(word, "size of the aperture", place) * unit for word in words[1:at])
    x, y = [number(word, "centre of the aperture", place) * unit for word in words[at + 1 :]] or [0.0, 0.0]
    if shape.objection(sizes):
        raise LensFileError(f"aperture {shown(text)} {shape.objection(sizes)}", place)
    return Aperture(words[0], sizes, obscures, (x, y))
