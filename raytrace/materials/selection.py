"""Selection of glasses by status, price, transmittance and resistance: `rt.glasses`, and glasses to choose from.

A selection is words, all of which a glass meets:

    preferred standard unlisted special obsolete melt    statuses; by default the first three
    radiation_hard                                       radiation-hard glasses, too
    any                                                  all statuses and radiation-hard glasses
    price<=3 density<=4 expansion<=9 nd>=1.7 vd<=40      figures of FIGURES
    transmittance:0.4>=0.98                              internal transmittance of 10 mm at 0.4 µm
    climate<=2 stain<=1 acid<=2 alkali<=2 phosphate<=2   classes of resistance, the best class is the lowest

A glass whose catalog does not list a figure does not meet a limit of that figure.
"""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike

import torch
from torch import Tensor

from raytrace.materials.agf import STATUSES, Catalog
from raytrace.materials.catalogs import catalogs_named
from raytrace.materials.glass import LINES, RESISTANCE, Glass, abbe_number, internal_transmittance, is_air, nd
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Columns, Result, Table
from raytrace.words import RaytraceError, did_you_mean

_UNLISTED = "unlisted"  # the status of a glass whose catalog lists none
#: Statuses of glasses that a selection without statuses passes.
CURRENT = ("preferred", "standard", _UNLISTED)
_WORDS = (*CURRENT, *(status for status in STATUSES.values() if status not in CURRENT))
RADIATION_HARD, _ANY = "radiation_hard", "any"

#: SCHOTT's names of glasses with cerium, which stay clear under ionising radiation: the kind, then G and a number.
_STABILISED = re.compile(r"[A-Z]+\d+G\d\d")


def _covers(glass: Glass, wavelengths: Sequence[float]) -> bool:
    shortest, longest = glass.wavelength_range or (0.0, float("inf"))
    return all(shortest <= wavelength <= longest for wavelength in wavelengths)


#: Figures with limits, other than the transmittance, which is of a wavelength; None where not listed.
FIGURES: dict[str, Callable[[Glass], float | None]] = {
    "price": lambda glass: glass.relative_price,
    "density": lambda glass: glass.density,
    "expansion": lambda glass: glass.expansion,
    "nd": lambda glass: float(nd(glass)) if _covers(glass, [LINES["d"]]) else None,
    "vd": lambda glass: float(abbe_number(glass)) if _covers(glass, [LINES["F"], LINES["C"]]) else None,
    **{name: lambda glass, name=name: glass.resistance.get(name) for name in RESISTANCE},  # type: ignore[misc]
}
_TRANSMITTANCE = "transmittance"
#: Columns of every table, behind the names.
_COLUMNS = (
    Column("nd", form=".5f"), Column("vd", form=".2f"), Column("price"), Column("density", "g/cm³"),
    Column("expansion", "1e-6/K"),
)  # fmt: skip
_LIMIT = re.compile(r"(?P<name>[a-z]+)(:(?P<wavelength>[\d.]+))?(?P<sign><=|>=)(?P<bound>-?\d+\.?\d*|\.\d+)")
_MANY = 5  # catalogs whose names are not listed


class BadSelection(RaytraceError, ValueError):
    """A word of a selection of glasses that is neither a status nor a limit of a figure."""


def is_radiation_hard(glass: Glass) -> bool:
    """Whether a glass is radiation-hard. Such glasses absorb blue light: SF6G05 transmits 0.36 of it, SF6 0.99
    (10 mm, 0.46 µm).

    Glasses of the catalog RAD_HARD, which holds no others, are not counted as such.
    """
    return glass.catalog != "RAD_HARD" and _STABILISED.fullmatch(glass.listed_name or glass.name) is not None


def status_of(glass: Glass) -> str:
    """The status in words, "unlisted" where the catalog lists none."""
    return f"{glass.status or _UNLISTED}{', radiation-hard' if is_radiation_hard(glass) else ''}"


@dataclass(frozen=True)
class Limit:
    """A limit of a figure, as "price<=3"; wavelength: µm, of a transmittance."""

    text: str
    name: str
    wavelength: float
    is_most: bool
    bound: float

    @classmethod
    def of(cls, word: str) -> "Limit":
        """Raises BadSelection."""
        match = _LIMIT.fullmatch(word)
        name = match["name"] if match else ""
        if match is None or (name != _TRANSMITTANCE and (name not in FIGURES or match["wavelength"])):
            known = (*_WORDS, RADIATION_HARD, _ANY, *FIGURES, _TRANSMITTANCE)
            meant = did_you_mean(re.split("[:<>=]", word)[0], known)
            figures = ", ".join((*FIGURES, f"{_TRANSMITTANCE}:0.4"))
            raise BadSelection(
                f"selection of glasses, {word!r}: expected {', '.join(known[: -len(FIGURES) - 1])}, or a limit as "
                f"price<=3, transmittance:0.4>=0.98 (µm) of {figures}{meant}"
            )
        try:
            wavelength = float(match["wavelength"] or 0)
        except ValueError:
            wavelength = 0.0
        if name == _TRANSMITTANCE and wavelength <= 0:
            raise BadSelection(
                f"selection of glasses, {word!r}: expected a wavelength in µm, as {_TRANSMITTANCE}:0.4>=0.98"
            )
        return cls(word, name, wavelength, match["sign"] == "<=", float(match["bound"]))

    def figure(self, glass: Glass) -> float | None:
        """The figure of a glass, None where not listed."""
        if self.name != _TRANSMITTANCE:
            return FIGURES[self.name](glass)
        passed = float(internal_transmittance(glass, self.wavelength))
        return None if passed != passed else passed

    def objection(self, glass: Glass) -> str:
        """The reason why a glass does not meet the limit; "" where it does."""
        figure = self.figure(glass)
        if figure is None:
            return f"{self.heading} not listed"
        return "" if (figure <= self.bound if self.is_most else figure >= self.bound) else f"not {self.text}"

    @property
    def heading(self) -> str:
        return f"{self.name}:{self.wavelength:g}" if self.wavelength else self.name


@dataclass(frozen=True)
class Selection:
    """Statuses and limits of glasses; radiation_hard: whether radiation-hard glasses pass."""

    statuses: tuple[str, ...]
    radiation_hard: bool
    limits: tuple[Limit, ...]

    @classmethod
    def of(cls, words: str | Sequence[str]) -> "Selection":
        """The selection of words (see the module). Raises BadSelection."""
        listed = (words if isinstance(words, str) else " ".join(words)).split()
        statuses = tuple(word for word in listed if word in _WORDS)
        limits = tuple(Limit.of(word) for word in listed if word not in (*_WORDS, RADIATION_HARD, _ANY))
        if _ANY in listed:
            return cls(_WORDS, True, limits)
        return cls(statuses or CURRENT, RADIATION_HARD in listed, limits)

    def objection(self, glass: Glass) -> str:
        """The reason why a glass does not pass; "" where it does."""
        status = glass.status or _UNLISTED
        if status not in self.statuses:
            return status
        if is_radiation_hard(glass) and not self.radiation_hard:
            return RADIATION_HARD
        return next((reason for limit in self.limits if (reason := limit.objection(glass))), "")


@value
class GlassList(Result):
    """Glasses of catalogs that a selection passes.

    left_out: (reason, number of glasses) of the others, each counted for its first reason; limits: of the selection,
    whose figures are columns of the table.
    """

    COLUMNS = _COLUMNS

    glasses: tuple[Glass, ...]
    catalogs: tuple[str, ...]
    left_out: tuple[tuple[str, int], ...]
    limits: tuple[Limit, ...] = ()

    @property
    def summary(self) -> str:
        """Numbers of the glasses that pass and of those left out, with the word that lets these pass."""
        count = len(self.glasses) + sum(number for _, number in self.left_out)
        source = ", ".join(self.catalogs) if len(self.catalogs) < _MANY else f"{len(self.catalogs)} catalogs"
        parts = [f"{number} {reason}" for reason, number in self.left_out]
        words = {reason for reason, _ in self.left_out} & {*_WORDS, RADIATION_HARD}
        sentence = f"{len(self.glasses)} of {count} glasses of {source}"
        left_out = f"; left out: {', '.join(parts)}" if parts else ""
        hint = f" (the word {_ANY} adds all statuses and radiation-hard glasses)" if words else ""
        return sentence + left_out + hint

    def columns(self) -> dict[str, Tensor]:
        listed, texts = columns_of(self.glasses, self.limits, blank=float("nan")), self.words()
        rows = {column.name: values for column, values in listed.items()}
        places = {name: [known.index(text) for text in rows[name]] for name, known in texts.items()}
        figures = {name: torch.tensor(rows[name], dtype=torch.float64) for name in rows.keys() - texts.keys()}
        return {name: torch.tensor(places[name]) if name in places else figures[name] for name in rows}

    def words(self) -> dict[str, Sequence[str]]:
        texts = [*columns_of(self.glasses).items()][:3]
        return {column.name: [*dict.fromkeys(values)] for column, values in texts}

    def tables(self) -> list[Table]:
        return [Table(columns_of(self.glasses, self.limits), [self.summary, ""])]

    def document(self) -> dict:
        names = [column.name for column in columns_of((), self.limits)]
        rows = zip(*columns_of(self.glasses, self.limits, blank=None).values(), strict=True)
        return {
            "results": [dict(zip(names, row, strict=True)) for row in rows],
            "left_out": dict(self.left_out),
        }


def columns_of(glasses: Sequence[Glass], limits: Sequence[Limit] = (), blank: object = "-") -> Columns:
    """Name, catalog, status, n_d, V_d, price, density and expansion of glasses, and the figures of limits.

    blank: of a figure that is not listed.
    """
    names = [column.name for column in _COLUMNS]
    figures = {column: FIGURES[column.name] for column in _COLUMNS}
    figures |= {Column(limit.heading): limit.figure for limit in limits if limit.name not in names}
    return {
        Column("glass", form="<"): [glass.listed_name or glass.name for glass in glasses],
        Column("catalog", form="<"): [glass.catalog for glass in glasses],
        Column("status", form="<"): [status_of(glass) for glass in glasses],
        **{
            column: [blank if (number := figure(glass)) is None else number for glass in glasses]
            for column, figure in figures.items()
        },
    }


def glasses(
    words: str | Sequence[str] = "",
    *,
    catalogs: Sequence[str | PathLike | Catalog] = (),
    wavelengths: Sequence[float] | Tensor | None = None,
) -> GlassList:
    """Glasses of catalogs by status, price, transmittance and resistance, for a choice of glasses.

    words: statuses and limits, as "preferred price<=3 transmittance:0.4>=0.98 acid<=2" (`materials.selection`); by
    default preferred and standard glasses and those without a status, radiation-hard ones left out. catalogs: names of
    shipped ones and AGF files, by default all of them; wavelengths: µm, which the range of each glass covers.
    Prices are relative to the maker's BK7, densities in g/cm³, expansions in 1e-6/K from -30 to 70 °C.
    Raises BadSelection, CatalogError.
    """
    selection = Selection.of(words)
    sought = catalogs_named(catalogs)
    waves = [] if wavelengths is None else torch.as_tensor(wavelengths, dtype=torch.float64).reshape(-1).tolist()
    passing, left_out = [], Counter[str]()
    for glass in (glass for catalog in sought for glass in catalog.glasses.values() if not is_air(glass)):
        if reason := selection.objection(glass) or ("" if _covers(glass, waves) else "outside the wavelengths"):
            left_out[reason] += 1
        else:
            passing.append(glass)
    return GlassList(
        tuple(passing), tuple(catalog.name for catalog in sought), tuple(left_out.most_common()), selection.limits
    )
