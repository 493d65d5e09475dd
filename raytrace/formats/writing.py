"""What every writer of lens files needs: exact numbers, one-line texts, and media that a name can bring back."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.formats.source import LensFileError, Place
from raytrace.formats.texts import is_printable
from raytrace.media.catalog import AmbiguousGlass, UnknownGlass, find_glass
from raytrace.media.glass import Glass
from raytrace.system.lens import Lens
from raytrace.system.surface import Surface


def exact(number: Tensor | float, what: str, place: Place) -> str:
    """The shortest decimal (at most 17 digits) that reads back as the same 64-bit number.

    Raises LensFileError for a batch of numbers, nan and infinity.
    """
    if isinstance(number, Tensor):
        if number.ndim:
            shape = tuple(number.shape)
            raise LensFileError(f"{what} has the shape {shape}; a file holds one lens: write one of them", place)
        number = float(number.detach())
    if number != number or number in (float("inf"), float("-inf")):
        raise LensFileError(f"{what} is {number}; only finite numbers can be written", place)
    return repr(float(number))


def exact_list(numbers: Tensor, what: str, place: Place) -> list[str]:
    """`exact` of every number of a one-dimensional tensor."""
    if numbers.ndim != 1:
        shape = tuple(numbers.shape)
        raise LensFileError(f"{what} has the shape {shape}; a file holds one lens: write one of them", place)
    return [exact(number, what, place) for number in numbers]


def thickness(number: Tensor, infinity: str, place: Place) -> str:
    """A thickness; the object's may be infinite."""
    if place.surface == 0 and number.ndim == 0 and float(number) == float("inf"):
        return infinity
    return exact(number, "thickness", place)


def one_line(text: str, what: str, place: Place) -> str:
    """A text without its surrounding blanks. Raises LensFileError if it does not fit on one line of a file."""
    if not is_printable(text.replace("\t", " ")):
        raise LensFileError(f"{what} holds a line break or a control character, and cannot be written", place)
    return text.strip()


def refuse_departure(surface: Surface, place: Place) -> None:
    """Raise LensFileError for a surface with a departure: the formats hold conics and even aspheres."""
    if surface.departure is not None:
        kind = type(surface.departure).__name__
        raise LensFileError(f"the surface departs from a conic and even terms ({kind}), which no file holds", place)


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
