"""Media of a prescription table by their numbers: indices at spectral lines, Abbe numbers, partial dispersions."""

import numpy as np

from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, Place, shown
from raytrace.formats.spelling import number
from raytrace.media.formulas import MODEL_LINES
from raytrace.media.glass import AIR, LINES, Glass, constant, model_glass

#: What an empty or undispersed medium's Abbe number is written as.
NOTHING = ("", "-", "0", "0.0", "∞", "inf", "infinity", "nan", "none")


def figures(cells: dict[str, str]) -> dict[str, str]:
    """The cells of a row that tell its medium by numbers, by column: "index d", "abbe d", "pgf", "dpgf"."""
    named = {name: cell for name, cell in cells.items() if name.startswith(("index ", "abbe ")) or name in _PARTIAL}
    return {name: cell for name, cell in named.items() if cell.lower() not in NOTHING}


_PARTIAL = ("pgf", "dpgf")


def medium(cells: dict[str, str], place: Place, report: Draft) -> Glass:
    """The medium of a row without a named glass; air where no figure is given.

    One index alone is constant. n_d, V_d and ΔP_gF are kept as they stand; any other set of figures is met by the model
    glass n = A + B/λ + C/λ^3.5 (`raytrace.media.formulas`), on the normal line of glasses where two are
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
