"""Media of a lens file: glasses by name from catalogs, requested substitutes, and their names in a written file."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import torch

from raytrace.io.report import FORMULA, NEAREST, Draft
from raytrace.io.source import LensFileError, Place, shown
from raytrace.materials.catalogs import (
    SAME_INDEX,
    SHIPPED,
    AmbiguousGlass,
    Catalog,
    CatalogError,
    UnknownGlass,
    find_glass,
    load,
    missing_catalogs,
    shipped_catalog,
    shipped_difference,
    user_catalogs,
)
from raytrace.materials.glass import Glass, constant, mil_glass, model_glass
from raytrace.system.lens import Lens

#: More characters than the name of any glass has.
_LONGEST = 80

#: Weight of a difference in V_d relative to one in n_d, for the nearest glass.
_PER_ABBE = 0.01

#: Catalogs that come with a lens, by name in capitals: a description of their source, and a function that reads them.
AtHand = Mapping[str, tuple[str, Callable[[], Catalog]]]


# -- reading ----------------------------------------------------------------------------------------------------------


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

    figures: n_d and V_d of the file, for the nearest glass where that was requested.
    """
    other, nearest = report.substitutes.of(name), report.substitutes.nearest
    if other is not None:
        report.substituted.add(name.upper())
    if other is not None and other not in (NEAREST, FORMULA):
        glass = mil_glass(other) if is_code(other) else _catalog_glass(other, catalogs, user, place, report)
        report.warn(f"{glass_words(glass)} is taken for the glass {name}, as requested", place)
        return glass
    try:
        return _catalog_glass(name, catalogs, user, place, report)
    except UnknownGlass as error:
        if (other == NEAREST or nearest) and figures is not None:
            nd, vd = figures
            glass = nearest_glass(nd, vd, user=user)
            off = f"its nd differs by {glass.nd_listed - nd:+.1e}, its Vd by {glass.abbe_listed - vd:+.2g}"
            reason = f"the nearest to nd {nd:.7g}, Vd {vd:.5g} of the file"
            report.warn(f"{glass_words(glass)} is taken for the unknown glass {name}: {reason}; {off}", place)
            report.glass(place.surface, name, f"{glass_words(glass)}, the nearest glass by nd and Vd")
            return glass
        lacks = "the file has no nd and Vd to find the nearest glass by; " if nearest or other else ""
        hint = f"{lacks}specify a substitute by --substitute {name}=OTHER (`substitute`)"
        raise UnknownGlass(error.name, error.where, error.suggestions, error.searched, hint) from None


def nearest_glass(nd: float, vd: float, *, user: Sequence[Path] = ()) -> Glass:
    """The glass of the user's catalogs and the shipped ones that is nearest to n_d and V_d; the first of equals."""

    def distance(glass: Glass) -> float:
        if glass.nd_listed is None or not glass.abbe_listed:
            return float("inf")
        return (glass.nd_listed - nd) ** 2 + (_PER_ABBE * (glass.abbe_listed - vd)) ** 2

    catalogs: list[Catalog] = [load(path) for path in user_catalogs(user)]
    catalogs += [shipped_catalog(name) for name in SHIPPED if name != "BIREFRINGENT"]  # holds one ray of a crystal each
    return min((glass for catalog in catalogs for glass in catalog.glasses.values()), key=distance)


def glass_words(glass: Glass) -> str:
    """The name of a glass with its catalog."""
    return f"{glass.name} ({glass.catalog})" if glass.catalog else glass.name


def _catalog_glass(
    name: str, catalogs: Sequence[str | Catalog], user: Sequence[Path], place: Place, report: Draft
) -> Glass:
    """The glass of a name, as `find_glass` finds it, its warnings in the report. Raises UnknownGlass.

    Reports where a catalog that came with the lens differs from the shipped one of its name.
    """
    if len(name) > _LONGEST:
        raise LensFileError(f"the glass {shown(name)} has {len(name)} characters; no glass has such a name", place)
    readable = []
    for catalog in catalogs:
        try:
            if isinstance(catalog, Catalog):
                catalog.find(name)
            readable.append(catalog)
        except CatalogError as error:
            report.warn(f"the catalog {catalog.name} that came with the lens is left out: {error}", Place(report.file))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        glass = find_glass(name, catalogs=readable, user=user, where=str(place))
    for warning in caught:
        if issubclass(warning.category, AmbiguousGlass):
            report.warn(str(warning.message).removeprefix(f"{place}: "), place)
        else:
            report.note(str(warning.message))
    came = any(isinstance(catalog, Catalog) and catalog.name == glass.catalog for catalog in readable)
    gap = shipped_difference(glass) if came else 0.0
    if gap > SAME_INDEX:
        message = f"{name} is that of the {glass.catalog} that came with the lens; its index differs from that of the"
        report.warn(f"{message} shipped {glass.catalog} by up to {gap:.1e}", place)
    alias = f" as {glass.listed_name}" if glass.listed_name and glass.listed_name.upper() != name.upper() else ""
    report.glass(place.surface, name, f"{glass.catalog or 'user catalog'}{alias}")
    return glass


def catalogs_in_folder(file: str) -> AtHand:
    """The glass catalogs (.agf) in the folder of a lens file."""
    try:
        paths = sorted(path for path in Path(file).parent.iterdir() if path.suffix.lower() == ".agf" and path.is_file())
    except (OSError, ValueError):
        return {}
    return {
        path.stem.upper(): (f"{path.name} in the folder of the lens", partial(load, path, listed=True))
        for path in paths
    }


def catalogs_of_lens(
    names: Sequence[str], user: Sequence[Path], report: Draft, packed: AtHand | None = None
) -> tuple[str | Catalog, ...]:
    """The catalogs that a lens file names, in its order: a `Catalog` that came with the lens, others by name.

    A catalog comes with the lens as NAME.agf in its folder, in upper or lower case, or `packed` in an archive. It
    precedes a shipped catalog of its name, and is ignored where `user` has one. The report lists the catalogs that were
    found, and those that are unavailable.
    """
    came = catalogs_in_folder(report.file) if packed is None else packed
    stated = {path.stem.upper() for path in user_catalogs(user)}
    catalogs, missing = [], []
    for name in dict.fromkeys(names):
        where, read = came.get(name.upper(), ("", None))
        catalog = _came(name, where, read, report) if read and name.upper() not in stated else None
        catalogs.append(catalog or name)
        missing += [] if catalog else missing_catalogs([name], user=user)
    if missing:
        report.note(f"catalogs that are not shipped: {', '.join(missing)}; their glasses are sought in the others")
    return tuple(catalogs)


def _came(name: str, where: str, read: Callable[[], Catalog], report: Draft) -> Catalog | None:
    """A catalog that came with the lens; None, with a warning, where it cannot be read."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            catalog = read()
        except CatalogError as error:
            report.warn(f"the catalog {name} that came with the lens is left out: {error}", Place(report.file))
            return None
    for warning in caught:
        report.note(str(warning.message))
    shipped = "" if missing_catalogs([name]) else ", which precedes the shipped one"
    report.note(f"catalog {name}: {where}{shipped}")
    return catalog


def is_code(name: str) -> bool:
    """True for a MIL code, six digits that give index and Abbe number."""
    return len(name) == 6 and name.isascii() and name.isdigit()


def by_figures(nd: float, vd: float, dpgf: float, name: str) -> Glass:
    """The medium of numbers in a file: a constant index where it has no dispersion, else a model glass."""
    return constant(nd, name) if vd == dpgf == 0 else model_glass(nd, vd, dpgf, name=name)


# -- writing ----------------------------------------------------------------------------------------------------------


def is_left_out(glass: Glass) -> bool:
    """True for the medium that files leave out: unnamed, of index 1."""
    return glass.formula == "constant" and glass.name == "" and bool((glass.coefficients == 1).all())


def is_listed(glass: Glass) -> bool:
    """True for a glass that a file holds by name only; its dispersion is that of a catalog."""
    return glass.formula not in ("constant", "model", "mirror")


def catalogs_needed(lens: Lens, user: Sequence[Path], file: str) -> tuple[str, ...]:
    """The lens's catalogs, and those it lacks, such that every name finds the glass of the lens.

    Raises LensFileError for a glass that its name does not find, or finds with other coefficients.
    """
    names = lens.catalogs
    for number, surface in enumerate(lens.surfaces):
        glass, place = surface.glass, Place(file, None, number)
        if not is_listed(glass) or _finds(glass, names, user, place):
            continue
        if glass.catalog and _finds(glass, (*names, glass.catalog), user, place):
            names = (*names, glass.catalog)
            continue
        message = f"the figures of {glass.name!r} are not those of its catalog; a file holds its name only"
        hint = "use the listed glass or a model glass, or put its catalog into the folder of the file"
        raise LensFileError(f"{message}: {hint}", place)
    return names


def _finds(glass: Glass, names: tuple[str, ...], user: Sequence[Path], place: Place) -> bool:
    """True if the name finds the same coefficients, or belongs to a catalog that is unavailable."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AmbiguousGlass)
            catalogs = catalogs_of_lens(names, user, Draft(place.file, ""))
            listed = find_glass(glass.name, catalogs=catalogs, user=tuple(user), where=str(place))
    except UnknownGlass:
        return bool(glass.catalog)
    same = listed.formula == glass.formula and listed.coefficients.shape == glass.coefficients.shape
    return same and torch.equal(listed.coefficients.double(), glass.coefficients.detach().double().cpu())


def listed_name(glass: Glass, place: Place) -> str:
    """The name of a glass as one word."""
    if not glass.name or len(glass.name.split()) != 1 or not glass.name.isprintable():
        raise LensFileError(f"the name of the glass is {glass.name!r}, expected one word", place)
    return glass.name
