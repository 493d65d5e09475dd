"""Tolerances: the rows of a lens, what is adjusted after manufacture, and the wavelength of the test."""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from raytrace.maths.result import Column, Result, Table, number
from raytrace.system.tolerance_data import DISTRIBUTIONS, TEST_WAVELENGTH, Compensator, Tolerance


class BadTolerance(ValueError):
    """A tolerance that the lens does not have, or limits that no error meets."""


@dataclass(frozen=True, eq=False, repr=False)
class Tolerances(Result):
    """Tolerances of a lens: `print(tolerances)` shows them, `tolerances[3]` is a row, `len(tolerances)` their number.

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
        Column("minimum", form=".6g"),
        Column("maximum", form=".6g"),
        Column("sigmas", form=".3g"),
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

    def only(self, *kinds: str) -> "Tolerances":
        """The tolerances with the rows of these kinds alone."""
        return dataclasses.replace(self, rows=tuple(row for row in self.rows if row.kind in kinds), saves=())

    def columns(self) -> dict[str, Tensor]:
        """Number of each row, from 1, kind and place, limits and distribution."""
        count = len(self.rows)
        ends = torch.arange(count)
        return {
            "row": ends + 1,
            "tolerance": ends,
            "minimum": self.minimum,
            "maximum": self.maximum,
            "unit": ends,
            "distribution": ends,
            "sigmas": torch.tensor([row.sigmas if row.distribution == "normal" else torch.nan for row in self.rows]),
            "source": ends,
        }

    def words(self) -> dict[str, Sequence[str]]:
        notes = [self._note(row) for row in self.rows]
        return {
            "tolerance": [f"{label}{note}" for label, note in zip(self.labels, notes, strict=True)],
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
        title = [f"{len(self.rows)} tolerances, fringes at {self.test_wavelength:g} µm"]
        notes = [*(f"compensator: {one}" for one in self.compensators), *(f"not read: {line}" for line in self.unread)]
        return [Table(self.columns() if self.rows else {}, title, notes)]

    def document(self) -> dict:
        """The rows and compensators as plain values."""

        def plain(row) -> dict:
            found = {field.name: getattr(row, field.name) for field in dataclasses.fields(row)}
            return {name: number(v) if isinstance(v, float) else v for name, v in found.items() if v not in ("", None)}

        return {
            "test_wavelength": self.test_wavelength,
            "tolerances": [plain(row) for row in self.rows],
            "compensators": [plain(one) for one in self.compensators],
            "unread": list(self.unread),
        }


def rows_of(tolerances: Tolerances | Iterable[Tolerance]) -> tuple[Tolerance, ...]:
    """The rows of tolerances, or of a sequence of them."""
    return tolerances.rows if isinstance(tolerances, Tolerances) else tuple(tolerances)


def check_limits(row: Tolerance) -> None:
    """Refuse limits and distributions that no error has. Raises BadTolerance."""
    if not row.minimum <= row.maximum or not abs(row.minimum) < float("inf") or not abs(row.maximum) < float("inf"):
        raise BadTolerance(f"{row}{_origin(row)}: expected finite limits, the minimum not above the maximum")
    if row.distribution not in DISTRIBUTIONS:
        known = ", ".join(DISTRIBUTIONS)
        raise BadTolerance(f"{row}{_origin(row)}: distribution {row.distribution!r}; expected one of {known}")
    if row.distribution == "normal" and not 0 < row.sigmas < float("inf"):
        raise BadTolerance(f"{row}{_origin(row)}: limits at {row.sigmas:g} standard deviations; expected more than 0")


def _origin(row: Tolerance) -> str:
    return f" ({row.source})" if row.source else ""
