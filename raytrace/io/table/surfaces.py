"""A row of a prescription table as a `Surface`: shape, medium (by name, or by indices and Abbe numbers), apertures."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from raytrace.io.assembly import by_figures, is_code, listed_glass
from raytrace.io.report import Draft
from raytrace.io.source import LensFileError, Place, UnsupportedSurface, double, is_infinite, is_number, number, shown
from raytrace.io.table.columns import order
from raytrace.io.table.system import ENVIRONMENT, environment_of
from raytrace.io.table.text import Row
from raytrace.materials.catalogs import Catalog
from raytrace.materials.environment import Environment
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
from raytrace.system.shapes import KINDS
from raytrace.system.surface import Surface

#: Spellings of the Abbe number of air or of a medium without dispersion.
NOTHING = ("", "-", "0", "0.0", "∞", "inf", "infinity", "nan", "none")


def figures(cells: dict[str, str]) -> dict[str, str]:
    """The cells of a row that give its medium by numbers, by column: "index d", "abbe d", "pgf", "dpgf"."""
    named = {name: cell for name, cell in cells.items() if name.startswith(("index ", "abbe ")) or name in _PARTIAL}
    return {name: cell for name, cell in named.items() if cell.lower() not in NOTHING}


_PARTIAL = ("pgf", "dpgf")


def medium(cells: dict[str, str], place: Place, report: Draft) -> Glass:
    """The medium of a row without a named glass; air where no figure is given.

    One index alone is constant. n_d, V_d and ΔP_gF are kept unchanged; any other set of figures is met by the model
    glass n = A + B/λ + C/λ^3.5 (`raytrace.materials.glass`), on the normal line of glasses where two are
    given, by least squares where more than three are.
    """
    given = {name: number(cell, name.replace("_", " "), place) for name, cell in figures(cells).items()}
    indices = {name.split()[1]: value for name, value in given.items() if name.startswith("index")}
    if not indices:
        if given:
            name = next(iter(given))
            raise LensFileError(f"{name} is {given[name]:g}, but no index is given; fill in nd", place)
        return AIR
    for line, value in indices.items():
        if not 0 < value < 100:
            raise LensFileError(f"index {line} is {value:g}, expected a positive number, as 1.5168", place)
    if any(value <= 0 for name, value in given.items() if name.startswith("abbe")):
        raise LensFileError(f"an Abbe number of {min(given.values()):g}, expected a positive one", place)
    if all(value == 1 for value in indices.values()):
        return AIR
    if len(given) == 1:
        line, value = indices.popitem()
        at = "" if line == "d" else f" (given at {line})"
        report.glass(place.surface, "", f"constant index {value!r}{at}")
        return constant(value)
    if given.keys() <= {"index d", "abbe d", "dpgf"} and "abbe d" in given:
        numbers = tuple(given.get(name, 0.0) for name in ("index d", "abbe d", "dpgf"))
    else:
        numbers = _fitted(indices, given, place)
    written = "/".join(f"{value:.7g}" for value in numbers if value)
    report.glass(place.surface, "", f"model glass {written} by {', '.join(given)}")
    return model_glass(*numbers)


def _powers(wavelength: float) -> np.ndarray:
    return np.array([1.0, 1 / wavelength, wavelength**-3.5])


def _fitted(indices: dict[str, float], given: dict[str, float], place: Place) -> tuple[float, float, float]:
    """n_d, V_d, ΔP_gF of the model glass through figures that are linear in its A, B, C."""
    at = {line: _powers(wavelength) for line, wavelength in LINES.items()}
    blue_red, violet_blue = at["F"] - at["C"], at["g"] - at["F"]
    model = {line: _powers(wavelength) for line, wavelength in MODEL_LINES.items()}  # rounded there
    dispersion, violet = model["F"] - model["C"], model["g"] - model["F"]
    normal = violet - 0.6438 * dispersion + 0.001682 * model["d"]
    rows = [(at[line], value) for line, value in indices.items()]
    for name, value in given.items():
        kind, _, line = name.partition(" ")
        if kind == "abbe":
            span = at["F'"] - at["C'"] if line == "e" else blue_red
            rows.append((value * span - at[line], -1.0))
        elif kind == "pgf":
            rows.append((violet_blue - value * blue_red, 0.0))
        elif kind == "dpgf":
            rows.append((normal - value * dispersion, 0.001682))
    if len(rows) == 2:
        rows.append((normal, 0.001682))
    matrix, wanted = np.array([row for row, _ in rows]), np.array([value for _, value in rows])
    scale = np.abs(matrix).max(1)
    found, *_ = np.linalg.lstsq(matrix / scale[:, None], wanted / scale, rcond=None)
    nd, spread = float(model["d"] @ found), float(dispersion @ found)
    for line, value in indices.items():
        if abs(float(at[line] @ found) - value) > 1e-4:
            listed = ", ".join(f"{name} {value:g}" for name, value in given.items())
            raise LensFileError(f"no glass has {shown(listed)}; is a column named wrongly?", place)
    if not (spread > 0 and nd > 1):
        raise LensFileError(f"an index that rises with the wavelength ({', '.join(given)}); columns mixed up?", place)
    abbe = (nd - 1) / spread
    return nd, abbe, float(violet @ found) / spread - 0.6438 + 0.001682 * abbe


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


def refuse_unsupported(rows: Sequence[Row]) -> None:
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
        apertures=tuple(
            _aperture(text, unit, place) for text in re.split(r"\s\+\s", cells.get("apertures", "")) if text.strip()
        ),
        environment=_environment(cells, place),
        comment=cells.get("comment") or ("" if is_number(cells.get("label", "0")) else cells["label"]),
    )


def _environment(cells: Mapping[str, str], place: Place) -> Environment | None:
    keys = [key for key in ENVIRONMENT if key in cells]
    if len(keys) == 1:
        raise LensFileError(f"a {keys[0]} alone; give {' and '.join(ENVIRONMENT)}, or neither", place)
    return environment_of(cells, place) if keys else None


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
    thickness = _cell(row, "thickness")
    return 0.0 if thickness is None else thickness


def _curvature(row: Row, unit: float) -> Tensor | None:
    curvature = _cell(row, "curvature")
    radius = None if is_infinite(row.cells.get("radius", "")) else _cell(row, "radius")
    if radius and not abs(radius) > 1e-300:
        raise LensFileError(f"radius is {radius:g}, too small", row.place)
    if radius and curvature and abs(radius * curvature - 1) > 1e-3:
        raise LensFileError(f"curvature {curvature:g} and radius {radius:g} contradict each other", row.place)
    value = curvature if curvature is not None else 1 / radius if radius else 0.0
    return double(value / unit) if value else None


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
    size = semi_diameter if semi_diameter is not None else (diameter or 0.0) / 2
    if size < 0:
        raise LensFileError(f"semi-diameter is {size:g}, expected 0 or more", row.place)
    return size * unit or None


def _glass(row: Row, catalogs: Sequence[str | Catalog], user: Sequence[Path], report: Draft) -> Glass:
    text, place = row.cells.get("glass", ""), row.place
    numbers = figures(row.cells)
    if text.lower() in _AIR or (numbers and text.lower() == "unknown"):
        glass = MIRROR if _MIRROR.search(row.cells.get("type", "")) else medium(row.cells, place, report)
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
        report.glass(place.surface, text, "six-digit code: nd and Vd by its digits")
        return mil_glass(text)
    if equals or all(is_number(part.strip()) for part in digits.split("/")):
        return _by_figures(name, digits, place, report)
    d_line = [numbers.get(name) for name in ("index d", "abbe d")]
    nearest = None if None in d_line else tuple(number(cell, "index or Abbe number", place) for cell in d_line)
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
    report.glass(place.surface, name, f"constant index {nd!r}" if vd == dpgf == 0 else f"model glass {digits}")
    return by_figures(nd, vd, dpgf, name)


def _aperture(text: str, unit: float, place: Place) -> Aperture:
    words = text.lower().split()
    obscures = words[0] == "obscuration"
    words = words[1:] if obscures else words
    at = words.index("at") if "at" in words else len(words)
    shape = SHAPES.get(words[0]) if words else None
    if shape is None or at - 1 != (shape.sizes or at - 1) or len(words[at + 1 :]) != (2 if words[at:] else 0):
        expected = "expected for example 'circular 0 12.5' or 'rectangular 3 4'"
        raise LensFileError(f"aperture is {shown(text)}, {expected}", place)
    sizes = tuple(number(word, "size of the aperture", place) * unit for word in words[1:at])
    x, y = [number(word, "centre of the aperture", place) * unit for word in words[at + 1 :]] or [0.0, 0.0]
    if shape.objection(sizes):
        raise LensFileError(f"aperture {shown(text)} {shape.objection(sizes)}", place)
    return Aperture(words[0], sizes, obscures, (x, y))
