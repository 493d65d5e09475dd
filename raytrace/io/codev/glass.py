"""Glasses of a CODE V sequence: of a catalog, by index and Abbe number, and private ones; read and written.

NBK7_SCHOTT is the glass of the catalog SCHOTT whose name is NBK7 without its hyphens, blanks and points.
517642 and 517.642, with any number of digits on either side of the point, give n_d - 1 and V_d; so does 1.517:64.2.
PRV … END holds private glasses: indices at the wavelengths PWL, or the coefficients of a formula.
"""

import re
import warnings
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import torch

from raytrace.io.assembly import (
    by_figures,
    catalogs_in_folder,
    catalogs_of_lens,
    is_code,
    is_left_out,
    listed_glass,
    same_figures,
)
from raytrace.io.codev.keywords import unquoted
from raytrace.io.source import (
    FORMULA,
    Draft,
    LensFileError,
    Place,
    Record,
    double,
    exact,
    exact_list,
    is_number,
    number,
    shown,
)
from raytrace.materials.catalogs import Catalog, UnknownGlass, find_glass, plain_names, same_catalog
from raytrace.materials.glass import AIR, FORMULAS, LINES, Glass, constant, from_table, mil_glass, refractive_index
from raytrace.words import option

#: Formula of a private glass by its word: n² = C1 + C2 λ² + C3 λ⁻² + C4 λ⁻⁴ + …, λ in µm.
FORMULA_WORDS = {"LAU": "schott"}

#: Terms of the formula through the indices of a table; fewer of them are met exactly.
_TERMS = 6

#: An index that a formula estimates with a larger error is refused, unless the formula was requested.
_MOST_ERROR = 1e-4

#: Between these lines, µm, index and Abbe number determine the dispersion.
_DETERMINED = (LINES["F"] * (1 - 1e-4), LINES["C"] * (1 + 1e-4))

_CODE = re.compile(r"(\d{3,})\.(\d{2,})", re.ASCII)
_PAIR = re.compile(r"([^:]+):([^:]+)")


# -- reading ----------------------------------------------------------------------------------------------------------


class GlassLibrary(NamedTuple):
    """The glasses of a file: private ones by name in capitals, catalogs that came with the lens, those of the user.

    wavelengths: of the lens, µm.
    """

    private: dict[str, Glass]
    came: Sequence[Catalog]
    user: Sequence[Path]
    wavelengths: Sequence[float] = ()


def came_with(file: str, words: Sequence[str], user: Sequence[Path], report: Draft) -> list[Catalog]:
    """The catalogs in the folder of a file that words of glasses name, as MINE of NAME_MINE."""
    in_folder = catalogs_in_folder(file)
    names = [name for word in words if (name := unquoted(word).rpartition("_")[2]).upper() in in_folder]
    catalogs = catalogs_of_lens(names, user, report) if names else ()
    return [catalog for catalog in catalogs if isinstance(catalog, Catalog)]


def medium(word: str, library: GlassLibrary, *, place: Place, report: Draft) -> Glass:
    """The medium of a word. Raises UnknownGlass, and LensFileError for other words."""
    name = unquoted(word)
    if report.substitutes.of(name) not in (None, FORMULA):
        glass = None if name.upper() in library.private else _figures(name, place)
        numbers = None
        if glass is not None and glass.formula == "model":
            nd, vd, _ = glass.coefficients.tolist()
            numbers = nd, vd
        return listed_glass(name, catalogs=library.came, user=library.user, place=place, report=report, figures=numbers)
    if name.upper() in library.private:
        report.glass(place, name, "private glass of the file (PRV)")
        return library.private[name.upper()]
    if name.upper() == "AIR" or not name:
        return AIR
    figures = _figures(name, place)
    if figures is not None:
        report.glass(place, name, "nd and Vd by its digits, partial dispersion of the normal line")
        _refuse_estimates(name, *_fictitious_error(figures, library.wavelengths), place=place, report=report)
        return figures
    return _listed(name, library, place=place, report=report)


def _figures(name: str, place: Place) -> Glass | None:
    """The glass whose index and Abbe number are its name; None for a name of letters."""
    if is_code(name):
        return mil_glass(name)
    code, pair = _CODE.fullmatch(name), _PAIR.fullmatch(name)
    if code:
        return by_figures(float(f"1.{code[1]}"), float(f"{code[2][:2]}.{code[2][2:] or 0}"), 0.0, name)
    if pair:
        nd, vd = number(pair[1], "index", place), number(pair[2], "Abbe number", place)
        if nd <= 0 or vd < 0:
            raise LensFileError(f"glass of nd {nd:g}, Vd {vd:g}; expected nd > 0 and Vd ≥ 0", place)
        return by_figures(nd, vd, 0.0, "")
    if is_number(name):
        raise LensFileError(f"the glass is {shown(name)}, expected a name, 517642, 517.642 or 1.517:64.2", place)
    return None


def _fictitious_error(glass: Glass, wavelengths: Sequence[float]) -> tuple[list[float], float]:
    """Wavelengths beyond the lines F and C, and the error of an index there that is estimated from n_d and V_d.

    The error is the difference from n² = 1 + B λ²/(λ² - C) of the same n_d and V_d. For 1,180 glasses of four makers at
    0.4047 µm its median is 3.9e-4; the estimate errs by 1.4e-4 (median) and 1.4e-3 (95 %).
    """
    outside = [wave for wave in wavelengths if not _DETERMINED[0] <= wave <= _DETERMINED[1]]
    if not outside or glass.formula != "model":
        return [], 0.0
    nd, vd, _ = glass.coefficients.tolist()
    d, blue, red = (LINES[line] ** 2 for line in "dFC")
    low, high = 0.0, 0.9 * blue  # of C: the dispersion rises with it
    for _ in range(60):
        pole = 0.5 * (low + high)
        strength = (nd * nd - 1) * (d - pole) / d
        spread = (1 + strength * blue / (blue - pole)) ** 0.5 - (1 + strength * red / (red - pole)) ** 0.5
        low, high = (pole, high) if spread < (nd - 1) / vd else (low, pole)
    waves = double(outside) ** 2
    other = (1 + strength * waves / (waves - pole)).clamp_min(0.0).sqrt()
    return outside, float((refractive_index(glass, double(outside)) - other).abs().max())


def _refuse_estimates(name: str, waves: Sequence[float], error: float, *, place: Place, report: Draft) -> None:
    """Refuse indices that a formula estimates with too large an error, unless that was requested; else report them."""
    if not waves:
        return
    listed = ", ".join(f"{1e3 * wave:g}" for wave in waves[:5])
    estimate = f"the index of {name} at {listed} nm is estimated by a formula, to about {error:.1e}"
    if error <= _MOST_ERROR:
        report.note(f"{place}: {estimate}")
    elif report.substitutes.takes_formula(name):
        report.substituted.add(name.upper())
        report.warn(f"{estimate}, as requested", place)
    else:
        ways = f"{option('substitute', f'{name}=GLASS')}, or {name}={FORMULA} to accept the estimate"
        message = f"{estimate}; expected {_MOST_ERROR:.0e} at most: name the intended glass by {ways}"
        raise LensFileError(message, place)


def _listed(name: str, library: GlassLibrary, *, place: Place, report: Draft) -> Glass:
    """The glass of a catalog, by NAME_CATALOG or NAME. Raises UnknownGlass."""

    def listed(spelling: str, catalogs: Sequence[str | Catalog]) -> Glass:
        return listed_glass(spelling, catalogs=catalogs, user=library.user, place=place, report=report)

    plain, _, catalog = name.rpartition("_")
    for spelled in (name, plain):
        if report.substitutes.of(spelled) is not None:
            return listed(spelled, library.came)
    hits = plain_names(plain, came=library.came, user=library.user) if plain else ()
    matches = [hit for hit in hits if same_catalog(hit[1], catalog)]
    is_stated = bool(matches)
    matches = matches or list(plain_names(name, came=library.came, user=library.user))
    if not matches:
        if plain:  # by another spelling of its catalog
            try:
                with warnings.catch_warnings(action="ignore"):
                    glass = find_glass(plain, catalogs=[catalog], user=library.user, where=str(place))
                if same_catalog(glass.catalog, catalog):
                    return listed(glass.listed_name, [catalog])
            except UnknownGlass:
                pass
        return listed(name, library.came)
    spelling, home = matches[0]
    if here := {other for other, where in matches[1:] if where == home and other != spelling}:
        spellings = ", ".join([spelling, *sorted(here)])
        raise LensFileError(f"{shown(name)} may be {spellings} of {home}; spell it as the catalog does", place)
    rivals = [f"{other} ({where})" for other, where in matches[1:] if other != spelling]
    if rivals:
        report.warn(f"{name} is taken for {spelling} ({home}), but may be {', '.join(rivals)}", place)
    stated = [next((catalog for catalog in library.came if catalog.name == home), home)] if is_stated or rivals else []
    return listed(spelling, stated)


def private_glass(row: Record, wavelengths: Sequence[float], report: Draft) -> Glass:
    """A glass between PRV and END; wavelengths: those of the lens, µm."""
    name, words, place = row.keyword, row.words, row.place
    waves = [micrometres(word, place) for word in row.text.split()]
    if not words:
        raise LensFileError(f"the private glass {shown(name)} has no figures", place)
    if is_number(words[0]):
        indices = [number(word, f"index of {name[:40]}", place) for word in words]
        return _table(name, waves, indices, wavelengths, row, report)
    formula = FORMULA_WORDS.get(words[0].upper())
    if formula is None:
        known = ", ".join(FORMULA_WORDS)
        message = f"private glass {shown(name)} by the formula {words[0][:40]}, which is not modelled"
        raise LensFileError(f"{message}; expected indices at the wavelengths PWL, or {known}", place)
    numbers = [number(word, f"coefficient of {name[:40]}", place) for word in words[1:]]
    count = FORMULAS[formula].count
    if any(numbers[count:]) or not numbers:
        message = f"private glass {shown(name)} with {len(numbers)} coefficients, expected 1 to {count}"
        raise LensFileError(message, place)
    coefficients = (numbers + [0.0] * count)[:count]
    span = (min(waves), max(waves)) if len(set(waves)) > 1 else None
    return Glass(name, formula, double(coefficients), wavelength_range=span)


def micrometres(word: str, place: Place) -> float:
    """A wavelength in nm as µm, rounded once. Raises LensFileError unless it is above 0."""
    if not number(word, "wavelength", place) > 0:
        raise LensFileError(f"WL is {shown(word)}, expected a wavelength in nm", place)
    return float(Decimal(re.sub("[dD]", "e", word)).scaleb(-3))


def _table(
    name: str, waves: list[float], indices: list[float], wanted: Sequence[float], row: Record, report: Draft
) -> Glass:
    """The glass of a table: its indices at the wavelengths of the lens are met exactly where they are in it."""
    if len(waves) != len(indices):
        message = f"private glass {shown(name)} with {len(indices)} indices at {len(waves)} wavelengths (PWL)"
        raise LensFileError(f"{message}, expected as many", row.place)
    pairs = dict(zip(waves, indices, strict=True))
    if len(pairs) < len(waves) or min(indices) <= 0:
        raise LensFileError(f"private glass {shown(name)}: wavelengths and indices differ and are above 0", row.place)
    if len(set(indices)) == 1:
        return constant(indices[0], name)
    lines = [wave for wave in dict.fromkeys(wanted) if wave in pairs]
    missing = [wave for wave in dict.fromkeys(wanted) if wave not in pairs]
    nodes = [*lines, *(wave for wave in sorted(pairs) if wave not in lines)]
    met = [pairs[wave] for wave in nodes]
    glass = from_table(nodes, met, exact=len(lines) if len(lines) < _TERMS else 0, name=name)
    errors = (refractive_index(glass, double(nodes)) - double(met)).abs().tolist()
    if len(nodes) > _TERMS:
        report.note(f"private glass {name}: a formula for its {len(nodes)} indices, met to {max(errors):.1e}")
    if missing:
        error = max(*errors, _table_error(glass, nodes, met, missing))
        _refuse_estimates(name, missing, error, place=row.place, report=report)
    elif max(errors[: len(lines)], default=0.0) > _MOST_ERROR:
        _refuse_estimates(name, lines, max(errors[: len(lines)]), place=row.place, report=report)
    return glass


def _table_error(glass: Glass, nodes: list[float], indices: list[float], waves: list[float]) -> float:
    """The error of a formula through indices at other wavelengths, estimated by the difference from another formula.

    The other formula has one term less; for three indices or fewer it is A + B/λ + C/λ^3.5, as accurate as Schott's.
    """
    if len(nodes) > 3:
        other = refractive_index(from_table(nodes, indices, terms=min(len(nodes), _TERMS) - 1), double(waves))
    else:
        powers = (0.0, -1.0, -3.5)[: len(nodes)]
        basis = torch.stack([double(nodes) ** power for power in powers], -1)
        coefficients = torch.linalg.solve(basis, double(indices))
        other = sum(c * double(waves) ** power for c, power in zip(coefficients, powers, strict=True))
    return float((refractive_index(glass, double(waves)) - other).abs().max())


# -- writing ----------------------------------------------------------------------------------------------------------


def word(glass: Glass, private: dict[str, Glass], user: Sequence[Path], place: Place) -> str:
    """The word of a surface for its medium; glasses that have to be private are put into `private`.

    Raises LensFileError for a medium that a .seq file cannot hold.
    """
    if is_left_out(glass):
        return ""
    if glass.formula == "mirror":
        return "REFL"
    if glass.formula == "constant" or (not glass.catalog and glass.formula in FORMULA_WORDS.values()):
        return f"'{_private_name(glass, private, place)}'"
    if glass.formula != "model":
        return _catalog_name(glass, user, place)
    nd, vd, dpgf = exact_list(glass.coefficients, "model glass", place)
    if float(dpgf):
        raise LensFileError(f"a model glass with ΔPgF = {dpgf}, which a .seq file has no place for", place)
    of_code = _figures(glass.name, place) if is_code(glass.name) or _CODE.fullmatch(glass.name) else None
    if of_code and exact_list(of_code.coefficients, "model glass", place) == [nd, vd, dpgf]:
        return glass.name
    if glass.name:
        message = f"a model glass named {glass.name!r}; a .seq file identifies model glasses by index and Abbe number"
        raise LensFileError(f"{message}: leave out the name", place)
    return f"{nd}:{vd}"


def _private_name(glass: Glass, private: dict[str, Glass], place: Place) -> str:
    """The name of a private glass; a glass without a name gets a free name."""
    if not glass.name:
        same = (key for key, other in private.items() if not other.name and same_figures(other, glass))
        name = next(same, None) or next(n for k in range(1, 10**4) if (n := f"MEDIUM{k}") not in private)
        private[name] = glass
        return name
    if not re.fullmatch(r"[^\s'\"!;&^]+", glass.name) or glass.name.upper() in ("AIR", "REFL"):
        raise LensFileError(f"the name of the glass is {glass.name!r}, expected one word", place)
    key = glass.name.upper()
    if key in private and not (same_figures(private[key], glass) and private[key].name == glass.name):
        raise LensFileError(f"two glasses are named {glass.name!r}; give one of them another name", place)
    private[key] = glass
    return glass.name


def _catalog_name(glass: Glass, user: Sequence[Path], place: Place) -> str:
    """NAME_CATALOG without hyphens, if that finds the same figures again."""
    spelling = glass.listed_name or glass.name
    written = f"{re.sub('[^A-Za-z0-9+]', '', spelling)}_{glass.catalog}".upper()
    try:
        with warnings.catch_warnings(action="ignore"):
            report = Draft(place.file, "seq")
            library = GlassLibrary({}, came_with(place.file, [written], user, report), user)
            listed = _listed(written, library, place=place, report=report)
    except UnknownGlass:
        if glass.catalog:
            return written
        listed = AIR
    if not same_figures(listed, glass):
        message = f"the figures of {glass.name!r} are not those of its catalog; a file holds its name only"
        raise LensFileError(f"{message}: use the listed glass or a model glass", place)
    return written


def private_lines(private: dict[str, Glass], waves: list[str], place: Place) -> list[str]:
    """PRV … END for glasses by name; waves: the wavelengths of the lens, nm."""
    lines = []
    for key, glass in private.items():
        name, numbers = glass.name or key, exact_list(glass.coefficients, "glass", place)
        span = glass.wavelength_range
        if glass.formula == "constant":
            lines += [f"PWL {' '.join(waves)}", f"'{name}' {' '.join(numbers * len(waves))}"]
        else:
            ends = [nanometres(exact(end, "wavelength", place)) for end in span] if span else waves[:1]
            formula = next(word for word, formula in FORMULA_WORDS.items() if formula == glass.formula)
            lines += [f"PWL {' '.join(ends)}", f"'{name}' {formula} {' '.join(numbers)}"]
    return ["PRV", *lines, "END"] if lines else []


def nanometres(micrometres: str) -> str:
    """A wavelength in µm as nm, digit by digit."""
    return f"{Decimal(micrometres).scaleb(3).normalize():f}"
