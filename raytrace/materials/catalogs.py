"""Glass catalogs: a glass by its name.

A name is never replaced by a similar one. `find_glass` searches, in this order,

1. the catalogs of the user: files given by the caller, then those in the environment variable RAYTRACE_CATALOGS;
2. the catalogs that the lens file lists, in its order: those supplied with it, else the shipped ones of these names;
3. the other shipped catalogs, in the order of SHIPPED (with a warning if two of them define the name differently);
4. the alias table glass_catalogs/ALIASES.csv: other spellings of the same glass, each with its reason;

and otherwise raises `UnknownGlass`. Names are compared without regard to case: programs store them in capitals, and no
shipped catalog has two names that differ in case alone. The Glass has the requested name, its catalog, and the
catalog's spelling.
"""

import csv
import difflib
import math
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.files import shipped
from raytrace.materials import agf
from raytrace.materials.agf import Catalog as Catalog
from raytrace.materials.agf import CatalogError as CatalogError
from raytrace.materials.agf import CatalogWarning as CatalogWarning
from raytrace.materials.agf import read_agf as read_agf
from raytrace.materials.agf import read_text
from raytrace.materials.agf import write_agf as write_agf
from raytrace.materials.glass import AIR, LINES, MIRROR, Glass, abbe_number, constant, model_glass, nd, refractive_index
from raytrace.words import RaytraceError, RaytraceWarning, calling_level, did_you_mean

#: Shipped catalogs in search order: makers by their frequency in lens files, then collections, then makers of few
#: glasses; BIREFRINGENT last, as its entries are single rays of a crystal.
SHIPPED = (
    *("SCHOTT", "OHARA", "HOYA", "CDGM", "HIKARI", "SUMITA", "LZOS", "CORNING", "INFRARED", "MISC", "HERAEUS", "TOPAS"),
    *("NHG", "PLASTIC", "ZEON", "ARTON", "LIGHTPATH", "RPO", "UMICORE", "ISUZU", "ARCHER", "RAD_HARD", "PILKINGTON"),
    "BIREFRINGENT",
)
#: Further names that lens files give to a shipped catalog.
CATALOG_NAMES = {
    "NIKON": "HIKARI", "NIKON-HIKARI": "HIKARI", "NIKON_HIKARI": "HIKARI", "PLASTIC2022": "PLASTIC",
    "ANGSTROMLINK": "PLASTIC", "CORNING_FS": "CORNING", "CORNING_B": "CORNING", "SCHOTT_IG": "INFRARED",
}  # fmt: skip
#: Environment variable: paths of AGF files, separated as in PATH.
ENVIRONMENT = "RAYTRACE_CATALOGS"
#: Glasses of an older edition than that of lens files of 2023: the newer edition, and the largest difference of its
#: indices from ours from 0.42 to 0.46 µm. No source of its coefficients could be compared.
OLDER_EDITIONS = {
    ("CDGM", "H-ZBAF20"): ("CDGM of 2023-09", 5.3e-5),
    ("CDGM", "H-ZBAF1"): ("CDGM of 2023-09", 3.0e-5),
}
#: Weight of a difference in V_d relative to one in n_d, for the nearest glasses.
_PER_ABBE = 0.01
#: Glasses of one name whose indices differ by more than this are different glasses.
SAME_INDEX = 1e-6


class AmbiguousGlass(RaytraceWarning):
    """Two catalogs define a name differently, and the lens file does not specify the catalog."""


def _at(where: str) -> str:
    return f"{where}: " if where else ""


class UnknownGlass(RaytraceError, LookupError):
    """No catalog has the name; `suggestions`: (glass, catalog) of similar names, `searched`: names of the catalogs."""

    def __init__(
        self,
        name: str,
        where: str,
        suggestions: tuple[tuple[str, str], ...],
        searched: Sequence[str],
        hint: str = "",
    ) -> None:
        self.name, self.where, self.suggestions, self.searched = name, where, suggestions, searched
        near = ", ".join(f"{glass} ({catalog})" for glass, catalog in suggestions)
        super().__init__(
            f"{_at(where)}unknown glass {name!r}; no catalog of {', '.join(searched)} holds it. "
            + (f"Nearest names: {near}. " if near else "No name comes near. ")
            + f"Correct the name, or give the AGF file that defines it (--catalog FILE or {ENVIRONMENT})"
            + (f"; {hint}." if hint else ".")
        )


def find_glass(
    name: str, *, catalogs: Sequence[str | Catalog] = (), user: Sequence[str | Path] = (), where: str = ""
) -> Glass:
    """The glass of a name, searched in the order of the module's docstring.

    catalogs: those of the lens file in its order: names (those not shipped are ignored: see `missing_catalogs`) and
    catalogs supplied with it; user: AGF files, searched first; where: the location for messages, as "lens.zmx:31,
    surface 2". Raises UnknownGlass, and CatalogError for a bad user catalog; warns AmbiguousGlass.
    """
    wanted = name.strip()
    of_user = [load(path) for path in user_catalogs(user)]
    for catalog in (*of_user, *catalogs):
        glass = catalog.find(wanted) if isinstance(catalog, Catalog) else _of_shipped(wanted, catalog)
        if glass:
            return replace(glass, name=name)
    others = [_shipped_glass(wanted, shipped) for shipped in SHIPPED if wanted.upper() in _shipped_names(shipped)]
    if others:
        _warn_if_ambiguous(others, where)
        return replace(others[0], name=name)
    alias = aliases().get(wanted.upper())
    if alias:
        return replace(_shipped_glass(alias.glass, alias.catalog), name=name)
    supplied = of_user + [catalog for catalog in catalogs if isinstance(catalog, Catalog)]
    raise UnknownGlass(name, where, _nearest(wanted, supplied), [*(catalog.name for catalog in supplied), *SHIPPED])


def medium(glass: Glass | str | float | Sequence[float], catalogs: Sequence[str] = (), where: str = "") -> Glass:
    """A glass by its name, its index, (nd, Vd) or (nd, Vd, ΔPgF); a Glass passes as it is."""
    if isinstance(glass, Glass):
        return glass
    if isinstance(glass, str):
        word = glass.strip().upper()
        known = {"": AIR, "AIR": AIR, "MIRROR": MIRROR}
        return known[word] if word in known else find_glass(glass.strip(), catalogs=catalogs, where=where)
    if isinstance(glass, Sequence):
        return model_glass(*glass)
    return AIR if not isinstance(glass, Tensor) and float(glass) == 1 else constant(glass)


def nearest_glasses(
    glass: Glass | str | Sequence[float],
    *,
    catalogs: Sequence[str | Catalog] = (),
    count: int = 5,
    user: Sequence[str | Path] = (),
) -> tuple[Glass, ...]:
    """The catalog glasses nearest to a glass by n_d and V_d, the nearest first: √(Δn_d² + (ΔV_d/100)²).

    glass: a Glass, a name or (nd, Vd); it is not among the results. catalogs: names of the vendors, as ["OHARA"], and
    catalogs that came with a lens; by default the user's and all shipped ones. user: AGF files, searched first. Raises
    UnknownGlass, CatalogError for an unknown catalog, ValueError for a medium without n_d and V_d.
    """
    sought = catalogs_named(catalogs, user=user)
    if isinstance(glass, str):
        glass = find_glass(glass, user=user)
    index, dispersion = _nd_and_vd(glass) if isinstance(glass, Glass) else map(float, glass)

    def distance(other: Glass) -> float:
        if other.nd_listed is None or not other.abbe_listed:
            return math.inf
        return (other.nd_listed - index) ** 2 + (_PER_ABBE * (other.abbe_listed - dispersion)) ** 2

    def is_same(other: Glass) -> bool:
        if not isinstance(glass, Glass) or (glass.listed_name or glass.name) != other.name:
            return False
        return same_catalog(glass.catalog, other.catalog)

    others = (other for catalog in sought for other in catalog.glasses.values() if not is_same(other))
    return tuple(sorted(others, key=distance)[:count])


def catalogs_named(
    catalogs: Sequence[str | PathLike | Catalog] = (), *, user: Sequence[str | Path] = ()
) -> tuple[Catalog, ...]:
    """Catalogs by the name of a user's or a shipped one, or by their AGF file; a Catalog passes as it is.

    By default the user's and all shipped ones, except BIREFRINGENT, whose entries are single rays of a crystal. Raises
    CatalogError.
    """
    of_user = [load(path) for path in user_catalogs(user)]
    if not catalogs:
        return (*of_user, *(shipped_catalog(name) for name in SHIPPED if name != "BIREFRINGENT"))
    by_name = {catalog.name: catalog for catalog in reversed(of_user)}

    def catalog_of(catalog: str | PathLike | Catalog) -> Catalog:
        if isinstance(catalog, Catalog):
            return catalog
        if (known := by_name.get(str(catalog).upper())) is not None:
            return known
        path = Path(catalog)
        return load(path) if path.suffix or path.is_file() else shipped_catalog(str(catalog))

    return tuple(catalog_of(catalog) for catalog in catalogs)


def _nd_and_vd(glass: Glass) -> tuple[float, float]:
    if glass.nd_listed is not None and glass.abbe_listed:
        return glass.nd_listed, glass.abbe_listed
    index, dispersion = float(nd(glass)), float(abbe_number(glass))
    if not math.isfinite(index) or not dispersion:
        raise ValueError(f"{glass.name or 'this medium'} has no nd and Vd; give a pair (nd, Vd)")
    return index, dispersion


def edition(glass: Glass) -> tuple[str, ...]:
    """Statements on the edition of a glass's coefficients; empty for a glass of no catalog.

    Shipped catalogs hold coefficients on which several public sources, listed in the glass's comment, agree.
    """
    if not glass.catalog:
        return ()
    parts = [part.strip() for part in glass.comment.split(";")]
    sources = [part for part in parts if re.search(r"\bsources? (agree|alone)\b|deviate by|^sources of figures", part)]
    if not sources:
        edition = f": {glass.comment}" if glass.comment else " does not state its edition"
        return (glass.catalog + edition,)
    newer = OLDER_EDITIONS.get((glass.catalog, glass.listed_name or glass.name))
    older = [f"older than {newer[0]}, whose indices differ by up to {newer[1]:.1e}"] if newer else []
    return ("date not stated; " + "; ".join(sources), *older)


def missing_catalogs(catalogs: Sequence[str], *, user: Sequence[str | Path] = ()) -> tuple[str, ...]:
    """The catalog names of a lens file that are neither shipped nor the file name of a user catalog."""
    of_user = {path.stem.upper() for path in user_catalogs(user)}
    return tuple(name for name in catalogs if not _shipped_name(name) and name.upper() not in of_user)


def _nearest(name: str, supplied: Sequence[Catalog]) -> tuple[tuple[str, str], ...]:
    """Up to five (glass, catalog) of similar names, the nearest first; hyphens are ignored."""
    spellings: dict[str, list[tuple[str, str]]] = {}
    for glass, catalog in _listed_names(supplied):
        spellings.setdefault(_bare(glass), []).append((glass, catalog))
    near = difflib.get_close_matches(_bare(name), spellings, n=5, cutoff=0.6)
    return tuple(hit for spelling in near for hit in spellings[spelling])[:5]


def plain_names(
    name: str, *, came: Sequence[Catalog] = (), user: Sequence[str | Path] = ()
) -> tuple[tuple[str, str], ...]:
    """The (glass, catalog) whose names are `name` but for hyphens, underscores, blanks and points, in search order.

    came: catalogs that came with a lens; user: further AGF files.
    """
    listed = _listed_names([*(load(path) for path in user_catalogs(user)), *came])
    return tuple((glass, catalog) for glass, catalog in listed if _bare(glass) == _bare(name))


def _listed_names(first: Sequence[Catalog]) -> Iterator[tuple[str, str]]:
    """(glass, catalog) of every glass of these catalogs, then of the shipped ones."""
    yield from ((glass, catalog.name) for catalog in first for glass in catalog.glasses)
    yield from ((glass, catalog) for catalog in SHIPPED for glass in _shipped_names(catalog).values())


def same_catalog(a: str, b: str) -> bool:
    """Whether two names denote the same catalog, as NIKON and HIKARI do."""
    return a.upper() == b.upper() or (_shipped_name(a) or a) == (_shipped_name(b) or b)


def user_catalogs(user: Sequence[str | Path] = ()) -> tuple[Path, ...]:
    """The user's AGF files: those given, then those of the environment variable RAYTRACE_CATALOGS.

    Each is a path, or the name of a shipped catalog. Raises CatalogError for one that is neither.
    """
    listed = [entry for entry in os.environ.get(ENVIRONMENT, "").split(os.pathsep) if entry.strip()]
    return tuple(dict.fromkeys(map(catalog_file, (*user, *listed))))


def catalog_file(name: str | PathLike) -> Path:
    """The AGF file of a path, or of the name of a shipped catalog. Raises CatalogError for a name that is neither."""
    path = Path(name)
    file = path if path.is_file() else shipped_file(str(name)) or path
    if not (file.suffix or file.exists()):
        shipped = f"the name of a shipped one: {', '.join(SHIPPED)}"
        meant = did_you_mean(path.name, SHIPPED)
        raise CatalogError(f"{name}: no such glass catalog; expected an AGF file, or {shipped}{meant}")
    return file


def shipped_folder() -> Path:
    """The folder of the shipped catalogs: inside the installed package, or next to it in a checkout."""
    folder = shipped("glass_catalogs")
    if not (folder / f"{SHIPPED[0]}.AGF").is_file():
        raise CatalogError(f"{folder}: no glass catalogs here; reinstall raytrace")
    return folder


def shipped_file(name: str) -> Path | None:
    """The file of a shipped catalog; None for a name that is not shipped."""
    shipped = _shipped_name(name)
    return None if shipped is None else shipped_folder() / f"{shipped}.AGF"


def shipped_catalog(name: str) -> Catalog:
    """A shipped catalog by its name, a glass parsed when it is used. Raises CatalogError for a name not shipped."""
    shipped = _shipped_name(name)
    if shipped is None:
        raise CatalogError(f"no catalog {name!r} is shipped; there are {', '.join(SHIPPED)}")
    return load(shipped_folder() / f"{shipped}.AGF", listed=True)


def load(path: str | Path, *, listed: bool = False) -> Catalog:
    """The catalog of an AGF file, parsed again only after a change of the file. Raises CatalogError.

    listed: each glass is parsed at its first use, and raises then.
    """
    path = Path(path)
    try:
        state = path.stat()
    except OSError as error:
        raise CatalogError(f"{path}: cannot be read ({error.strerror}); expected a glass catalog (AGF)") from error
    return _load(path.resolve(), state.st_mtime_ns, state.st_size, listed)


@lru_cache(maxsize=64)
def _load(path: Path, modified: int, size: int, listed: bool) -> Catalog:
    return agf.listed(read_text(path), path) if listed else read_agf(path)


class Alias(NamedTuple):
    """Another spelling of a glass, and why it is the same glass."""

    glass: str
    catalog: str
    reason: str


@lru_cache(maxsize=1)
def aliases() -> dict[str, Alias]:
    """The alias table, by name in capitals."""
    with (shipped_folder() / "ALIASES.csv").open(encoding="utf-8", newline="") as file:
        return {row.pop("alias").upper(): Alias(**row) for row in csv.DictReader(file)}


@lru_cache(maxsize=64)
def _shipped_names(catalog: str) -> dict[str, str]:
    """Capitals -> name of the glasses of a shipped catalog, without parsing their figures."""
    return {name.upper(): name for name in shipped_catalog(catalog).glasses}


def _shipped_name(catalog: str) -> str | None:
    name = CATALOG_NAMES.get(catalog.upper(), catalog.upper())
    return name if name in SHIPPED else None


def _of_shipped(name: str, catalog: str) -> Glass | None:
    shipped = _shipped_name(catalog)
    return _shipped_glass(name, shipped) if shipped and name.upper() in _shipped_names(shipped) else None


def shipped_difference(glass: Glass) -> float:
    """Largest index difference of a glass from that of the same name in the shipped catalog; 0 if there is none."""
    shipped = _of_shipped(glass.listed_name, glass.catalog)
    return _difference(glass, shipped) if shipped else 0.0


@lru_cache(maxsize=1024)
def _shipped_glass(name: str, catalog: str) -> Glass:
    return shipped_catalog(catalog).glasses[_shipped_names(catalog)[name.upper()]]


def _bare(name: str) -> str:
    return re.sub(r"[-_ .]", "", name.upper())


def _warn_if_ambiguous(candidates: Sequence[Glass], where: str) -> None:
    glass, *others = candidates
    rivals = [f"{other.catalog} by {gap:.1e}" for other in others if (gap := _difference(glass, other)) > SAME_INDEX]
    if rivals:
        message = (
            f"{_at(where)}{glass.listed_name} is taken from {glass.catalog}, but another glass has this name in other "
            f"catalogs (index differs in {', '.join(rivals)}); name the catalog in the file, or give it (--catalog)"
        )
        warnings.warn(message, AmbiguousGlass, stacklevel=calling_level())


def _difference(a: Glass, b: Glass) -> float:
    """Largest difference of two indices in the range they share, or at the d line if they share none."""
    spans = [glass.wavelength_range for glass in (a, b) if glass.wavelength_range]
    shortest, longest = max((span[0] for span in spans), default=1.0), min((span[1] for span in spans), default=0.0)
    if shortest > longest:
        shortest = longest = LINES["d"]
    wavelengths = torch.linspace(shortest, longest, 9, dtype=torch.float64)
    return float((refractive_index(a, wavelengths) - refractive_index(b, wavelengths)).abs().max())
