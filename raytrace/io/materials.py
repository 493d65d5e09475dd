"""Glasses by their names, found for a reader and named by a writer."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import torch

from raytrace.io.report import Draft
from raytrace.io.source import LensFileError, Place, shown
from raytrace.io.substitutes import FORMULA, NEAREST, nearest_glass
from raytrace.materials.catalogs import (
    SAME_INDEX,
    AmbiguousGlass,
    Catalog,
    CatalogError,
    UnknownGlass,
    find_glass,
    load,
    missing_catalogs,
    shipped_difference,
    user_catalogs,
)
from raytrace.materials.glass import Glass, constant, mil_glass, model_glass
from raytrace.system.lens import Lens

#: More characters than the name of any glass has.
_LONGEST = 80


def listed_glass(
    name: str,
    *,
    catalogs: Sequence[str | Catalog],
    user: Sequence[Path],
    place: Place,
    report: Draft,
    figures: tuple[float, float] | None = None,
) -> Glass:
    """The glass of a name, or its substitute, with a warning in the report. Raises UnknownGlass.

    figures: n_d and V_d that the file has for it, of which the nearest glass is taken where that was asked for.
    """
    other = report.substitutes.of(name)
    how = {"catalogs": catalogs, "user": user, "place": place, "report": report}
    if other is not None:
        report.substituted.add(name.upper())
    if other is not None and other not in (NEAREST, FORMULA):
        glass = mil_glass(other) if is_code(other) else _catalog_glass(other, **how)
        report.warn(f"{glass_words(glass)} is taken for the glass {name}, as asked for", place)
        return glass
    try:
        return _catalog_glass(name, **how)
    except UnknownGlass as error:
        if (other == NEAREST or report.substitutes.nearest) and figures is not None:
            return _nearest(name, figures, user, place, report)
        lacks = (
            "the file has no nd and Vd to find the nearest glass by; " if report.substitutes.nearest or other else ""
        )
        hint = f"{lacks}another one is taken for it by --substitute {name}=OTHER (`substitute`)"
        raise UnknownGlass(error.name, error.where, error.suggestions, error.searched, hint) from None


def _nearest(name: str, figures: tuple[float, float], user: Sequence[Path], place: Place, report: Draft) -> Glass:
    """The nearest glass to n_d and V_d, with a warning of how far it is."""
    nd, vd = figures
    glass = nearest_glass(nd, vd, user=user)
    off = f"its nd differs by {glass.nd_listed - nd:+.1e}, its Vd by {glass.abbe_listed - vd:+.2g}"
    told = f"the nearest to nd {nd:.7g}, Vd {vd:.5g} of the file"
    report.warn(f"{glass_words(glass)} is taken for the unknown glass {name}: {told}; {off}", place)
    report.glass(place.surface, name, f"{glass_words(glass)}, the nearest glass by nd and Vd")
    return glass


def glass_words(glass: Glass) -> str:
    """The name of a glass with its catalog."""
    return f"{glass.name} ({glass.catalog})" if glass.catalog else glass.name


def _catalog_glass(
    name: str, *, catalogs: Sequence[str | Catalog], user: Sequence[Path], place: Place, report: Draft
) -> Glass:
    """The glass of a name, as `find_glass` finds it, its warnings in the report. Raises UnknownGlass.

    Where it comes from a catalog that came with the lens, and the shipped one of that name has other figures, the
    report says so.
    """
    if len(name) > _LONGEST:
        raise LensFileError(f"the glass {shown(name)} has {len(name)} characters; no glass has such a name", place)
    catalogs = [catalog for catalog in catalogs if _is_readable(catalog, name, place, report)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        glass = find_glass(name, catalogs=catalogs, user=user, where=str(place))
    for warning in caught:
        if issubclass(warning.category, AmbiguousGlass):
            report.warn(str(warning.message).removeprefix(f"{place}: "), place)
        else:
            report.note(str(warning.message))
    came = any(isinstance(catalog, Catalog) and catalog.name == glass.catalog for catalog in catalogs)
    gap = shipped_difference(glass) if came else 0.0
    if gap > SAME_INDEX:
        message = (
            f"{name} is the one of the {glass.catalog} that came with the lens; its index differs from that of the"
        )
        report.warn(f"{message} shipped {glass.catalog} by up to {gap:.1e}", place)
    alias = f" as {glass.listed_name}" if glass.listed_name and glass.listed_name.upper() != name.upper() else ""
    report.glass(place.surface, name, f"{glass.catalog or 'user catalog'}{alias}")
    return glass


def _is_readable(catalog: str | Catalog, name: str, place: Place, report: Draft) -> bool:
    """Whether a catalog's entry of a name can be read, if it has one; of a damaged one the report warns."""
    if isinstance(catalog, Catalog):
        try:
            catalog.find(name)
        except CatalogError as error:
            report.warn(_left_out(catalog.name, error), Place(report.file))
            return False
    return True


def _left_out(name: str, error: CatalogError) -> str:
    return f"the catalog {name} that came with the lens is left out: {error}"


#: Catalogs at hand by their names in capitals: where each stands, and what reads it.
AtHand = Mapping[str, tuple[str, Callable[[], Catalog]]]


def beside(file: str) -> AtHand:
    """The glass catalogs (.agf) in the folder of a lens file."""
    try:
        found = sorted(path for path in Path(file).parent.iterdir() if path.suffix.lower() == ".agf" and path.is_file())
    except (OSError, ValueError):
        return {}
    return {path.stem.upper(): (f"{path.name} beside the lens", partial(load, path, listed=True)) for path in found}


def catalogs_at_hand(
    names: Sequence[str], user: Sequence[Path], report: Draft, packed: AtHand | None = None
) -> tuple[str | Catalog, ...]:
    """The catalogs that a lens file names, in its order: one that came with the lens itself, any other by its name.

    A catalog comes with the lens if it lies beside it as NAME.agf, in upper or lower case, or, of an archive, is
    `packed` with it. It goes before a shipped one of its name, and is passed over where `user` has one. The report says
    which were found, and which are nowhere.
    """
    came, stated = beside(report.file) if packed is None else packed, {p.stem.upper() for p in user_catalogs(user)}
    found, nowhere = [], []
    for name in dict.fromkeys(names):
        where, read = came.get(name.upper(), ("", None))
        catalog = _came(name, where, read, report) if read and name.upper() not in stated else None
        found.append(catalog or name)
        nowhere += [] if catalog else missing_catalogs([name], user=user)
    if nowhere:
        report.note(f"catalogs that are not shipped: {', '.join(nowhere)}; their glasses are sought in the others")
    return tuple(found)


def _came(name: str, where: str, read: Callable[[], Catalog], report: Draft) -> Catalog | None:
    """A catalog that came with the lens; None, with a warning, where it cannot be read."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            catalog = read()
        except CatalogError as error:
            report.warn(_left_out(name, error), Place(report.file))
            return None
    for warning in caught:
        report.note(str(warning.message))
    shipped = "" if missing_catalogs([name]) else ", which goes before the shipped one"
    report.note(f"catalog {name}: {where}{shipped}")
    return catalog


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
        hint = "use the listed glass or a model glass, or put its catalog beside the file"
        raise LensFileError(f"{message}: {hint}", place)
    return names


def _found(glass: Glass, names: tuple[str, ...], user: Sequence[Path], place: Place) -> bool:
    """True if the name finds the same figures, or is of a catalog that is not at hand."""
    catalogs = catalogs_at_hand(names, user, Draft(place.file, ""))
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
