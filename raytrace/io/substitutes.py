"""Substitutes: other glasses for those of a lens file, by name, or the nearest one by n_d and V_d.

A name is never replaced unasked. `substitute` is a mapping {"SSK4": "SSK4A"}, or words as on the command line,
"SSK4=SSK4A"; "nearest" stands for the glass of least

    d² = Δn_d² + (0.01 ΔV_d)²

from the figures that the file has for the one that is not known: of an unknown glass by name, or alone of every one.
"formula" accepts, of a glass of CODE V that is known by its n_d and V_d or by a few indices, those that a formula
estimates at other wavelengths to no better than 1e-4.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from raytrace.materials.catalogs import SHIPPED, Catalog, load, shipped_catalog, user_catalogs
from raytrace.materials.glass import Glass

NEAREST = "nearest"

#: Stands for the indices that a formula estimates, of a glass that a file has by few figures.
FORMULA = "formula"

#: By how much of n_d a unit of V_d counts.
_PER_ABBE = 0.01


class BadSubstitute(ValueError):
    """What is no substitute of a glass; the message says what was found and what was expected."""


@dataclass(frozen=True)
class Substitutes:
    """Names of glasses by those, in capitals, that they are taken for; nearest: whether every unknown one has one.

    formula: whether the indices that a formula estimates are accepted for every glass.
    """

    named: Mapping[str, str] = field(default_factory=dict)
    nearest: bool = False
    formula: bool = False

    def of(self, name: str) -> str | None:
        """The name that is taken for a name, NEAREST among them; None where none was asked for."""
        return self.named.get(name.upper())

    def takes_formula(self, name: str) -> bool:
        """Whether the indices that a formula estimates for a glass were asked for."""
        return self.formula or self.of(name) == FORMULA


NONE = Substitutes()


def substitutes_of(given: Mapping[str, str] | str | Sequence[str] | None) -> Substitutes:
    """Substitutes of a mapping, or of words like SSK4=SSK4A and "nearest". Raises BadSubstitute."""
    if given is None:
        return NONE
    if isinstance(given, Mapping):
        pairs = list(given.items())
    else:
        words = given.split() if isinstance(given, str) else list(given)
        pairs = [tuple(word.partition("=")[::2]) for word in words]
    named, alone = {}, {name for name, other in pairs if name in (NEAREST, FORMULA) and other == ""}
    for name, other in pairs:
        if other == "" and name in alone:
            continue
        if not (isinstance(name, str) and isinstance(other, str) and name.strip() and other.strip()):
            raise BadSubstitute(f"`substitute`: {name!r} for {other!r}; expected GLASS=OTHER, {NEAREST} or {FORMULA}")
        named[name.strip().upper()] = other.strip()
    return Substitutes(named, NEAREST in alone, FORMULA in alone)


def nearest_glass(nd: float, vd: float, *, user: Sequence[Path] = ()) -> Glass:
    """The glass of the user's catalogs and the shipped ones that is nearest to n_d and V_d; the first of equals."""
    catalogs: list[Catalog] = [load(path) for path in user_catalogs(user)]
    catalogs += [shipped_catalog(name) for name in SHIPPED if name != "BIREFRINGENT"]  # one ray of a crystal each
    listed = [glass for catalog in catalogs for glass in catalog.glasses.values()]
    return min(listed, key=lambda glass: _distance(glass, nd, vd))


def _distance(glass: Glass, nd: float, vd: float) -> float:
    if glass.nd_listed is None or not glass.abbe_listed:
        return float("inf")
    return (glass.nd_listed - nd) ** 2 + (_PER_ABBE * (glass.abbe_listed - vd)) ** 2
