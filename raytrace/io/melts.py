"""Melts: glasses with index errors as those of a glass catalog (.agf) in the folder of the file of their lens.

A lens file holds a glass by its name. A glass with errors is written by its `materials.glass.melt`, whose name ends in
a melt number made of the figures of the glass, as N-SK16_M3F0A2: two melts of one name are the same glass. The catalog
is named after the file of the lens, which lists it; readers find it in the folder of the file.
"""

import dataclasses
import hashlib
from pathlib import Path
from types import MappingProxyType

from torch import Tensor

from raytrace.io.source import LensFileError, Place
from raytrace.materials.agf import Catalog, CatalogError, read_text
from raytrace.materials.environment import air_index, is_model, thermal
from raytrace.materials.glass import WITH_ERRORS, Glass, NoMelt, melt
from raytrace.system.lens import Lens

#: First words of a catalog that was written with a lens, and may be replaced.
_HEADING = "Melts of the lens file"

#: The end of the name of a catalog of melts.
_END = "-MELTS"


def with_melts(lens: Lens, path: Path) -> tuple[Lens, Catalog | None]:
    """The lens with glasses without errors that have the same indices, and the catalog of the melts among them.

    path: the file of the lens, after which the catalog is named; None where no glass needs a catalog.
    Raises LensFileError for a batch of lenses, and for a glass that no formula of a catalog fits.
    """
    name = "-".join(path.stem.split()).replace("_", "-").upper() + _END
    glasses: dict[str, Glass] = {}

    def plain(glass: Glass, number: int) -> Glass:
        if glass.status == "melt" and glass.catalog.endswith(_END):  # read with another lens
            return glasses.setdefault(glass.name, dataclasses.replace(glass, catalog=name))
        if not glass.formula.endswith(WITH_ERRORS):
            return glass
        place = Place(str(path), None, number)
        if glass.coefficients.dim() > 1:
            shape = tuple(glass.coefficients.shape[1:])
            raise LensFileError(f"the index has the shape {shape}; a file holds one lens: write one of them", place)
        waves = _wavelengths(lens, glass)
        try:
            fitted = melt(glass, waves)
        except NoMelt as error:
            raise LensFileError(str(error), place) from error
        if is_model(fitted):
            return fitted
        figures = repr((glass.formula, glass.coefficients.tolist(), waves.tolist(), glass.records))
        number_of_melt = hashlib.sha256(figures.encode()).hexdigest()[:5].upper()
        called = f"{'-'.join(glass.name.split()) or 'GLASS'}_M{number_of_melt}"
        fitted = dataclasses.replace(fitted, name=called, listed_name=called, catalog=name, comment=_comment(glass))
        return glasses.setdefault(called, fitted)

    surfaces = tuple(
        surface if (glass := plain(surface.glass, k)) is surface.glass else dataclasses.replace(surface, glass=glass)
        for k, surface in enumerate(lens.surfaces)
    )
    if all(a is b for a, b in zip(surfaces, lens.surfaces, strict=True)):
        return lens, None
    lens = dataclasses.replace(lens, surfaces=surfaces)
    if not glasses:
        return lens, None
    catalogs = tuple(other for other in lens.catalogs if not other.upper().endswith(_END))
    heading = f"{_HEADING} {path.name}: glasses with index errors, between the wavelengths of the lens"
    return dataclasses.replace(lens, catalogs=(*catalogs, name)), Catalog(name, MappingProxyType(glasses), (heading,))


def _wavelengths(lens: Lens, glass: Glass) -> Tensor:
    """The wavelengths (W,) µm of a lens as the formula of a glass takes them, in the air of its catalog."""
    if lens.environment is None or is_model(glass):
        return lens.wavelengths
    exact, air = lens.wavelengths.double(), lens.environment
    return exact * air_index(exact, air.temperature, air.pressure) / air_index(exact, thermal(glass).reference, 1.0)


def _comment(glass: Glass) -> str:
    index, _, _, abbe, _ = glass.coefficients[-5:].tolist()
    return f"{glass.name or 'glass'} with an index higher by {index:.6g} and an Abbe number higher by {abbe:.6g}"


def check_catalog(path: Path, place: Place) -> None:
    """Raise LensFileError where the file is another catalog, which may not be replaced."""
    if not path.exists():
        return
    try:
        text = read_text(path)
    except CatalogError as error:
        raise LensFileError(f"its glass catalog {path.name} cannot be replaced: {error}", place) from error
    if not text.startswith(f"CC {_HEADING} "):
        message = f"needs a glass catalog {path.name} for its index errors, but there is another one of that name"
        raise LensFileError(f"{message}; give the lens another name", place)
