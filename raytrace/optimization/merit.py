"""Merit functions as values: the rows of a file, of a list or of a default, which can be joined and reweighted.

rt.Merit.of(lens)                      the merit function of the file
rt.Merit.default(lens, "spot")         a default one, of the settings `DefaultMerit`
merit + other, 2 * merit               joined; with all weights doubled
merit.with_weights(EFFL=1)             of all rows of an operand; with_targets likewise
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field

from raytrace.optimization.context import Line
from raytrace.optimization.conventions import Conventions, conventions_of
from raytrace.optimization.default_merit import BadMerit, Boundaries, DefaultMerit, boundary_rows
from raytrace.optimization.operands.table import OPERANDS
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.words import did_you_mean


@dataclass(frozen=True)
class Merit:
    """Rows of a merit function, in order; `rows[i - 1]` is row i.

    unit: mm in the unit of length of targets and values, which matters beside rows of pure numbers or waves.
    conventions: of operands whose meaning the file's program leaves open, as "opd_tilt=common" (`Conventions`);
    skip_unknown: leave rows of unknown operands out. boundaries: those among the rows, between which `search`
    spreads its starts. Raises ValueError for other conventions.
    """

    rows: tuple[Row, ...] = ()
    unit: float = 1.0
    _: KW_ONLY
    conventions: Conventions | str | Sequence[str] | None = None
    skip_unknown: bool = False
    boundaries: Boundaries = field(default_factory=Boundaries)

    def __post_init__(self):
        object.__setattr__(self, "conventions", conventions_of(self.conventions))

    @classmethod
    def of(
        cls,
        lens: Lens,
        *,
        glass_thickness: str | tuple[float, float] | None = None,
        air_thickness: str | tuple[float, float] | None = None,
        edge: float | None = None,
        conventions: Conventions | str | Sequence[str] | None = None,
        skip_unknown: bool = False,
    ) -> "Merit":
        """The merit function of the lens's file, with boundaries in mm (as of `DefaultMerit`) in addition.

        Raises BadMerit if the file has none.
        """
        if lens.optimization_data is None or not lens.optimization_data.merit:
            raise BadMerit("the lens has no merit function of its own: choose one by `merit=spot`")
        boundaries = Boundaries.of(glass_thickness, air_thickness, edge)
        options = {"conventions": conventions, "skip_unknown": skip_unknown, "boundaries": boundaries}
        stored = cls(lens.optimization_data.merit, lens.optimization_data.unit, **options)
        limits = boundary_rows(lens, boundaries)
        return stored + Merit(limits) if limits else stored

    @classmethod
    def default(cls, lens: Lens, kind: str = "spot", **settings) -> "Merit":
        """A default merit function of the lens, in mm; settings: those of `DefaultMerit`."""
        return merit_for(lens, DefaultMerit(kind, **settings))

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def __add__(self, other: "Merit | Sequence[Row]") -> "Merit":
        """The rows of both, in the unit of the first; rows without a `Merit` are in mm.

        Rows of the second up to its first CONF are of configuration 1, and rows of arithmetic keep their references.
        Raises BadMerit.
        """
        unit = other.unit if isinstance(other, Merit) else 1.0
        behind = (in_unit(row, unit, self.unit) for row in other)
        if any(row.operand == "PRIM" for row in self.rows):
            raise BadMerit("rows behind a row PRIM would be of that wavelength: join them the other way round")
        reset = (Row("CONF", (1, 0)),) if any(row.operand == "CONF" for row in self.rows) else ()
        ahead = (*self.rows, *reset)
        return dataclasses.replace(self, rows=(*ahead, *(_moved(row, len(ahead)) for row in behind)))

    def __radd__(self, other: Sequence[Row]) -> "Merit":
        return Merit(tuple(other)) + self

    def __mul__(self, factor: float) -> "Merit":
        """With all weights larger."""
        rows = tuple(dataclasses.replace(row, weight=row.weight * factor) for row in self.rows)
        return dataclasses.replace(self, rows=rows)

    __rmul__ = __mul__

    def with_weights(self, by_row: Mapping[int, float] | None = None, **by_operand: float) -> "Merit":
        """With other weights, by the number of a row or for all rows of an operand. Raises BadMerit."""
        return self._with("weight", by_row or {}, by_operand)

    def with_targets(self, by_row: Mapping[int, float] | None = None, **by_operand: float) -> "Merit":
        """With other targets, by the number of a row or for all rows of an operand. Raises BadMerit."""
        return self._with("target", by_row or {}, by_operand)

    def _with(self, name: str, by_row: Mapping[int, float], by_operand: Mapping[str, float]) -> "Merit":
        known = dict.fromkeys(row.name for row in self.rows)
        for operand in by_operand:
            if operand not in known:
                raise BadMerit(f"no row {operand}; there are {', '.join(known)}{did_you_mean(operand, known)}")
        for number in by_row:
            if not 1 <= number <= len(self.rows):
                raise BadMerit(f"no row {number}; there are rows 1 to {len(self.rows)}")

        def changed(number: int, row: Row) -> Row:
            value = by_row.get(number, by_operand.get(row.name))
            return row if value is None else dataclasses.replace(row, **{name: float(value)})

        return dataclasses.replace(self, rows=tuple(changed(*pair) for pair in enumerate(self.rows, 1)))

    def __str__(self) -> str:
        lines = [f"{'row':>5}  {'operand':<8}{'arguments':<40}{'target':>14}{'weight':>14}"]
        for number, row in enumerate(self.rows, 1):
            numbers = "" if row.text else f"{row.target:>14.6g}{row.weight:>14.6g}"
            lines.append(f"{number:>5}  {row.name:<8}{arguments(row) or row.text:<40}{numbers}".rstrip())
        return "\n".join(lines)

    __repr__ = __str__


def merit_for(
    lens: Lens,
    merit: "Merit | DefaultMerit | Sequence[Row] | str | None" = None,
    configurations: Sequence[int] | None = None,
) -> Merit:
    """A merit function as a value: as it is, of rows, of the settings or the name of a default one, or the file's.

    configurations: those of the rows of a default one, from 1; by default all. Raises BadMerit.
    """
    if merit is None:
        return Merit.of(lens)
    if isinstance(merit, str):
        merit = DefaultMerit(merit)
    if isinstance(merit, DefaultMerit):
        rows = merit.rows(lens, configurations)
        return Merit(rows, conventions=merit.conventions, boundaries=merit.boundaries)
    return merit if isinstance(merit, Merit) else Merit(tuple(merit))


def merit_of_options(
    lens: Lens, merit: str | None = None, *, skip_unknown: bool = False, **settings
) -> Merit | DefaultMerit:
    """The merit function of the options of a command: a default one of that kind, or the file's. Raises BadMerit."""
    if merit is not None:
        return DefaultMerit(merit, **settings)
    if other := {*settings} - {"glass_thickness", "air_thickness", "edge", "conventions"}:
        raise BadMerit(f"`{min(other)}` belongs to a default merit function: name it by `merit`, as spot")
    return Merit.of(lens, skip_unknown=skip_unknown, **settings)


def arguments(row: Row) -> str:
    """The arguments of a row as text: its integers with their meaning, if known, and its four numbers."""
    operand = OPERANDS.get(row.operand)
    takes = operand.takes if operand is not None else ("", "")
    named = [f"{kind} {number}" for kind, number in zip(takes, row.integers, strict=True) if kind and number]
    plain = [] if named or not any(row.integers) else [f"{row.integers[0]} {row.integers[1]}"]
    numbers = [f"{number:.6g}" for number in row.numbers]
    return "  ".join([*named, *plain, *([" ".join(numbers)] if any(row.numbers) else [])])


def configurations_of(rows: Iterable[Row], current: int) -> list[int]:
    """The configuration (from 1) of every row; current: that of the rows before the first CONF."""
    configurations = []
    for row in rows:
        current = row.integers[0] if row.operand == "CONF" else current
        configurations.append(current)
    return configurations


def in_unit(row: Row, before: float, after: float) -> Row:
    """The row with its target in another unit of length; both in mm."""
    power = OPERANDS[row.operand].length if row.operand in OPERANDS else 0
    return dataclasses.replace(row, target=row.target * (before / after) ** power) if power else row


def _moved(row: Row, by: int) -> Row:
    """A row moved down with the rows that it refers to."""
    operand = OPERANDS.get(row.operand)
    if operand is None or operand.refers is None:
        return row
    probe = tuple(Row("EFFL") for _ in range(3))
    taken = operand.refers(Line(3, Row(row.operand, (1, 2)), 0), probe)  # [1], or [1, 2] of two rows and of a range
    first, second = row.integers
    return dataclasses.replace(row, integers=(first + by, second + by if len(taken) > 1 else second))
