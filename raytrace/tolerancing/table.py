"""Table of tolerances: the rows of a lens, the compensators that are adjusted after manufacture, and the wavelength of
the test."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from raytrace.maths.result import Column, Result, Table, number
from raytrace.system.tolerance_data import DISTRIBUTIONS, TEST_WAVELENGTH, Compensator, Tolerance
from raytrace.words import RaytraceError

_LETTERS = 9  # sources that are named by letters


class BadTolerance(RaytraceError, ValueError):
    """A tolerance that the lens does not have, or limits that no error meets."""


class Radial(NamedTuple):
    """A radial error: its rows along x and along y, its kind in words, and its largest magnitude, in their unit."""

    places: tuple[int, int]
    along: tuple[int, int]
    name: str
    magnitude: float


@dataclass(frozen=True, eq=False, repr=False)
class ToleranceTable(Result):
    """The tolerances of a lens: `print(table)` shows them, `table[3]` is a row, `len(table)` their number.

    rows: `Tolerance`; an error of `perturbed` belongs to each, in this order.
    compensators: `Compensator`; test_wavelength: of fringes, µm.
    saves: the rows whose lenses a file asks to be saved, with the number in the name: (row, number).
    unread: lines that are not read, with the reason.
    """

    rows: tuple[Tolerance, ...]
    compensators: tuple[Compensator, ...] = ()
    test_wavelength: float = TEST_WAVELENGTH
    saves: tuple[tuple[int, int], ...] = ()
    unread: tuple[str, ...] = ()

    COLUMNS = (
        Column("row", form="d"),
        Column("tolerance", form="<"),
        Column("minimum", form=".6g"),
        Column("maximum", form=".6g"),
        Column("sigmas", form=".3g"),
        Column("source", form="<"),
    )

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Tolerance]:
        return iter(self.rows)

    def __getitem__(self, place: int) -> Tolerance:
        return self.rows[place]

    @property
    def minimum(self) -> Tensor:
        """Lower limits (N,) in the rows' units, float64."""
        return torch.tensor([row.minimum for row in self.rows], dtype=torch.float64)

    @property
    def maximum(self) -> Tensor:
        """Upper limits (N,) in the rows' units, float64."""
        return torch.tensor([row.maximum for row in self.rows], dtype=torch.float64)

    @property
    def labels(self) -> list[str]:
        """Kind and place of every row in words: "radius of surface 3"."""
        return [f"{row.name} of {row.where}" for row in self.rows]

    @property
    def notes(self) -> list[str]:
        """The lines that are not read, in words."""
        return [f"not read: {line}" for line in self.unread]

    @property
    def radial(self) -> dict[int, Radial]:
        """The radial errors by their first row."""
        pairs = (places for places in groups_of(self.rows) if len(places) == 2)
        return {places[0]: radial for places in pairs if (radial := _radial(self.rows, places)) is not None}

    @property
    def names(self) -> list[str]:
        """Kind and place of every row in words; of the first row of a group those of all its rows."""
        names = self.labels
        for first, *_, last in (places for places in groups_of(self.rows) if len(places) > 1):
            names[first] = f"{self.rows[first].name} … {names[last]}"
        for first, radial in self.radial.items():
            names[first] = f"{radial.name} of {self.rows[first].where}"
        return names

    @property
    def ranges(self) -> tuple[Tensor, Tensor]:
        """Limits (N,), (N,) of every row; of the first row of a radial error -R and R of its magnitude."""
        low, high = self.minimum, self.maximum
        for first, radial in self.radial.items():
            low[first], high[first] = -radial.magnitude, radial.magnitude
        return low, high

    @property
    def leaders(self) -> Tensor:
        """The first row (N,) of the group of every row; of one without a group, itself."""
        leaders = torch.arange(len(self.rows))
        for places in groups_of(self.rows):
            leaders[places] = places[0]
        return leaders

    def alone(self, limits: Tensor) -> Tensor:
        """Limits (N,) as errors (N, N) of N lenses, one row alone in each; in that of its first row a whole group."""
        every = torch.arange(len(self.rows))
        return limits.new_zeros(len(every), len(every)).index_put((self.leaders, every), limits)

    def only(self, *kinds: str) -> "ToleranceTable":
        """The tolerances with the rows of these kinds alone."""
        return dataclasses.replace(self, rows=tuple(row for row in self.rows if row.kind in kinds), saves=())

    def columns(self) -> dict[str, Tensor]:
        """Number of each row, from 1, kind and place, limits and distribution; a radial error is one line."""
        hidden = {radial.places[1] for radial in self.radial.values()}
        shown = torch.tensor([n for n in range(len(self.rows)) if n not in hidden], dtype=torch.int64)
        low, high = self.ranges
        sigmas = torch.tensor([row.sigmas if row.distribution == "normal" else torch.nan for row in self.rows])
        return {
            "row": shown + 1,
            "tolerance": shown,
            "minimum": low[shown],
            "maximum": high[shown],
            "unit": shown,
            "distribution": shown,
            "sigmas": sigmas[shown],
            "source": shown,
        }

    def words(self) -> dict[str, Sequence[str]]:
        notes, names = [self._note(row) for row in self.rows], self.labels
        for first in self.radial:
            names[first] = self.names[first]
        return {
            "tolerance": [f"{label}{note}" for label, note in zip(names, notes, strict=True)],
            "unit": [row.unit for row in self.rows],
            "distribution": [row.distribution for row in self.rows],
            "source": [row.source for row in self.rows],
        }

    @staticmethod
    def _note(row: Tolerance) -> str:
        if row.adjust is not None and row.adjust != row.surfaces[0]:
            return f", taken up by surface {row.adjust}"
        return f", pivot {row.pivot:g} mm" if row.pivot else ""

    def tables(self) -> Sequence[Table]:
        count = len(self.rows) - len(self.radial)
        title = [f"{count} tolerances, fringes at {self.test_wavelength:g} µm"]
        notes = [f"compensator: {compensator}" for compensator in self.compensators]
        columns: dict[str, Any] = self.columns() if self.rows else {}
        sources = dict.fromkeys(row.source for row in self.rows if row.source)
        if 0 < len(sources) <= _LETTERS:  # long texts, which rows share
            letters = {"": "", **{source: chr(ord("A") + n) for n, source in enumerate(sources)}}
            columns["source"] = [letters[self.rows[n].source] for n in columns["source"].tolist()]
            notes = [*(f"{letters[source]}: {source}" for source in sources), *notes]
        return [Table(columns, title, [*notes, *self.notes])]

    def document(self) -> dict[str, Any]:
        """The rows and compensators as plain values."""

        def plain(row: Tolerance | Compensator) -> dict[str, Any]:
            fields = {field.name: getattr(row, field.name) for field in dataclasses.fields(row)}
            stated = {name: part for name, part in fields.items() if part not in ("", None, ())}
            return {name: number(part) if isinstance(part, float) else part for name, part in stated.items()}

        return {
            "test_wavelength": self.test_wavelength,
            "tolerances": [plain(row) for row in self.rows],
            "compensators": [plain(compensator) for compensator in self.compensators],
            "unread": list(self.unread),
        }


def groups_of(rows: Sequence[Tolerance]) -> list[list[int]]:
    """The places of the rows of each group, in the order of its first row."""
    groups: dict[str | int, list[int]] = {}
    for place, row in enumerate(rows):
        groups.setdefault(row.group or place, []).append(place)
    return list(groups.values())


def _radial(rows: Sequence[Tolerance], places: Sequence[int]) -> Radial | None:
    """The radial error of two rows of a group; None where they are not along x and y of the same surfaces."""
    first, second = (rows[place] for place in places)
    axes = {row.kind[-2:]: place for row, place in zip((first, second), places, strict=True)}
    name = first.kind[:-2]
    if name != second.kind[:-2] or axes.keys() != {"_x", "_y"} or first.surfaces != second.surfaces:
        return None
    largest = max(abs(limit) for row in (first, second) for limit in (row.minimum, row.maximum))
    return Radial((places[0], places[1]), (axes["_x"], axes["_y"]), f"{name}_radial", math.sqrt(2) * largest)


def rows_of(tolerances: ToleranceTable | Iterable[Tolerance]) -> tuple[Tolerance, ...]:
    """The rows of tolerances, or of a sequence of them."""
    return tolerances.rows if isinstance(tolerances, ToleranceTable) else tuple(tolerances)


def check_limits(row: Tolerance) -> None:
    """Refuse limits and distributions that no error has. Raises BadTolerance."""
    if not row.minimum <= row.maximum or not abs(row.minimum) < float("inf") or not abs(row.maximum) < float("inf"):
        raise BadTolerance(f"{row}{_origin(row)}: expected finite limits, the minimum not above the maximum")
    if row.distribution not in DISTRIBUTIONS:
        known = ", ".join(DISTRIBUTIONS)
        raise BadTolerance(f"{row}{_origin(row)}: distribution {row.distribution!r}; expected one of {known}")
    if row.distribution == "table":
        _check_density(row)
    if row.distribution == "normal" and not 0 < row.sigmas < float("inf"):
        raise BadTolerance(f"{row}{_origin(row)}: limits at {row.sigmas:g} standard deviations; expected more than 0")


def _check_density(row: Tolerance) -> None:
    x, p = zip(*row.density, strict=True) if row.density else ((), ())
    rising = len(x) > 1 and all(a < b for a, b in itertools.pairwise(x)) and x[0] >= 0 and x[-1] <= 1
    if not rising or min(p) < 0 or not 0 < sum(p) < float("inf"):
        message = "expected rising fractions from 0 to 1 of the way between the limits, and densities of 0 and more"
        raise BadTolerance(f"{row}{_origin(row)}: density {row.density}; {message}")


def _origin(row: Tolerance) -> str:
    return f" ({row.source})" if row.source else ""
