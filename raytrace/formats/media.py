"""Glasses by their names, found for a reader and named by a writer."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import torch

from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, Place, shown
from raytrace.media.catalog import AmbiguousGlass, UnknownGlass, find_glass, missing_catalogs
from raytrace.media.glass import Glass, constant, model_glass
from raytrace.system.lens import Lens

#: More characters than the name of any glass has.
_LONGEST = 80


def listed_glass(name: str, *, catalogs: Sequence[str], user: Sequence[Path], place: Place, report: Draft) -> Glass:
    """The glass of a name, as `find_glass` finds it, its warnings in the report. Raises UnknownGlass."""
    if len(name) > _LONGEST:
        raise LensFileError(f"the glass {shown(name)} has {len(name)} characters; no glass has such a name", place)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        glass = find_glass(name, catalogs=catalogs, user=user, where=str(place))
    for warning in caught:
        if issubclass(warning.category, AmbiguousGlass):
            report.warn(str(warning.message).removeprefix(f"{place}: "), place)
        else:
            report.note(str(warning.message))
    alias = f" as {glass.listed_name}" if glass.listed_name and glass.listed_name.upper() != name.upper() else ""
    report.glass(place.surface, name, f"{glass.catalog or 'user catalog'}{alias}")
    return glass


def report_missing_catalogs(catalogs: Sequence[str], user: Sequence[Path], report: Draft) -> None:
    """Note the catalogs that a file names and that are not at hand."""
    missing = missing_catalogs(catalogs, user=user)
    if missing:
        report.note(f"catalogs that are not shipped: {', '.join(missing)}; their glasses are sought in the others")


def is_left_out(glass: Glass) -> bool:
    """True for the medium that files leave out."""
    return glass.formula == "constant" and glass.name == "" and bool((glass.coefficients == 1).all())


def is_listed(glass: Glass) -> bool:
    """True for a glass that a file holds by name only, its figures being in a catalog."""
    return glass.formula not in ("constant", "model", "mirror")


def catalogs_needed(lens: Lens, user: Sequence[Path], file: str) -> tuple[str, ...]:
    """The lens's catalogs, and those it lacks, such that every name finds the glass the lens has.

    Raises LensFileError for a glass whose figures are not those its name finds: the file would lose them.
    """
    names = lens.catalogs
    for number, surface in enumerate(lens.surfaces):
        glass = surface.glass
        if not is_listed(glass):
            continue
        place = Place(file, None, number)
        if _found(glass, names, user, place):
            continue
        if glass.catalog and _found(glass, (*names, glass.catalog), user, place):
            names = (*names, glass.catalog)
            continue
        message = f"the figures of {glass.name!r} are not those of its catalog; a file holds its name only"
        raise LensFileError(f"{message}: use the listed glass or a model glass", place)
    return names


def _found(glass: Glass, catalogs: tuple[str, ...], user: Sequence[Path], place: Place) -> bool:
    """True if the name finds the same figures, or is of a catalog that is not at hand."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AmbiguousGlass)
            found = find_glass(glass.name, catalogs=catalogs, user=tuple(user), where=str(place))
    except UnknownGlass:
        return bool(glass.catalog)
    same = found.formula == glass.formula and found.coefficients.shape == glass.coefficients.shape
    return same and torch.equal(found.coefficients.double(), glass.coefficients.detach().double().cpu())


def listed_name(glass: Glass, place: Place) -> str:
    """The name of a glass as one word."""
    if not glass.name or len(glass.name.split()) != 1 or not glass.name.isprintable():
        raise LensFileError(f"the name of the glass is {glass.name!r}, expected one word", place)
    return glass.name


def is_code(name: str) -> bool:
    """True for a MIL code, six digits that tell index and Abbe number."""
    return len(name) == 6 and name.isascii() and name.isdigit()


def by_figures(nd: float, vd: float, dpgf: float, name: str) -> Glass:
    """The medium of numbers in a file: a constant index where it has no dispersion, else a model glass."""
    return constant(nd, name) if vd == dpgf == 0 else model_glass(nd, vd, dpgf, name=name)
