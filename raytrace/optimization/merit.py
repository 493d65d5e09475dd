"""Merit functions: default ones of spots, wavefronts, directions or MTF, rows as values, and their evaluation.

rt.Merit.of(lens)                      the merit function of the file
rt.Merit.default(lens, "spot")         a default one, of the settings `DefaultMerit`
merit + other, 2 * merit               joined; with all weights doubled
merit.with_weights(EFFL=1)             of all rows of an operand; with_targets likewise

The merit M and the Jacobian of all rows (operand, arguments, target, weight) follow from the values v and targets t:

    M² = Σ w (v - t)² / Σ w

over rows with a weight. A row whose ray is lost counts as an error of `LOST` units.

The weight of a ray of a default merit function, of the Gaussian rule of n rings and m arms, is

    w = π g v f / (W F a)

with g the weight of its ring (Σ g = 1), v and f the weights of its wavelength and field, W and F their numbers, and a
the number of arms that are traced: of a lens of revolution one for the field on the axis, half of them for a field on
y, else all. They lie half a step off the y axis. The weights v and f are those of the lens, not normalised.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from graphlib import CycleError, TopologicalSorter
from numbers import Integral
from typing import Any, NamedTuple, TypeAlias, TypedDict

import numpy as np
from torch import Tensor

from raytrace.maths.numerics import Dual, Number, slope_of, value_of
from raytrace.maths.sampling import gauss_legendre
from raytrace.optimization.operands.boundaries import AT_RIM, BOUNDARIES
from raytrace.optimization.operands.operand import (
    SETTINGS,
    Conventions,
    Evaluate,
    EvaluationContext,
    Line,
    Planner,
    RowValues,
    conventions_of,
    need,
    need_all,
)
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens, is_round_about_axis
from raytrace.system.optimization_data import Row
from raytrace.system.parameter_paths import parse_range
from raytrace.words import RaytraceError, did_you_mean, option

# -- default merit functions -------------------------------------------------------------------------------------------

#: Most rows of a default merit function: each is a ray, with its derivatives by all variables.
MOST_ROWS = 100_000

REFERENCES = ("centroid", "chief")


class BadMerit(RaytraceError, ValueError):
    """A merit function that cannot be made; the message names the row, the value and the values expected."""


#: A range of thicknesses, mm, or its text.
Thicknesses: TypeAlias = str | tuple[float, float] | None


@dataclass(frozen=True)
class Boundaries:
    """Limits of thicknesses, mm: (minimum, maximum) on the axis, of glass and of air; edge: minimum at the edge.

    None: no such row. `edge` is of glass; the minimum of air also holds at its edge. Edges are at the common rim of the
    two surfaces (`tracing.geometry.rims`). The space before the image has no maximum.
    """

    glass: tuple[float, float] | None = None
    air: tuple[float, float] | None = None
    edge: float | None = None

    @classmethod
    def of(cls, glass_thickness: Thicknesses, air_thickness: Thicknesses, edge: float | None) -> "Boundaries":
        """The limits of ranges, or of their text: "2:15", or "2" without a maximum. Raises ValueError."""
        glass, air = (parse_range(ends) if isinstance(ends, str) else ends for ends in (glass_thickness, air_thickness))
        return cls(glass, air, edge)

    def rows(self, lens: Lens) -> Iterator[Row]:
        """The rows, each over all surfaces."""
        last = len(lens.surfaces) - 2
        bounds = (
            *(("MNCA", last, self.air and self.air[0]), ("MXCA", last - 1, self.air and self.air[1])),
            *(("MNEA", last, self.air and self.air[0]), ("MNCG", last, self.glass and self.glass[0])),
            *(("MXCG", last, self.glass and self.glass[1]), ("MNEG", last, self.edge)),
        )
        for operand, end, target in bounds:
            if target is not None and np.isfinite(target) and end > 0:
                numbers = AT_RIM if operand in ("MNEA", "MNEG") else (0.0,) * 4
                yield Row(operand, (1, end), numbers, target=float(target), weight=1.0)


@dataclass(frozen=True)
class Kind:
    """A kind of default merit function: its operand for each reference, how its rows are made, and its description."""

    operands: dict[str, str]
    rows: "Callable[[Lens, str, DefaultMerit], Iterator[Row]]"
    text: str


@dataclass(frozen=True)
class DefaultMerit:
    """Settings of a default merit function, as in OpticStudio's wizard of sequential merit functions.

    kind: "spot", "wavefront", "angular" or "mtf"; rings, arms (even): of Gaussian quadrature of the pupil; reference:
    "centroid" or "chief" ray; frequencies: cycles/mm, of "mtf"; field_weights (F,), wavelength_weights (W,): by default
    those of the lens. glass_thickness, air_thickness: (minimum, maximum) on the axis, mm, or text "2:15"; edge: minimum
    thickness of glass at its edge, mm: boundary rows in addition. conventions: of operands, as "opd_tilt=common"
    (`Conventions`). Raises BadMerit, ValueError.
    """

    kind: str = "spot"
    _: KW_ONLY
    rings: int = 3
    arms: int = 6
    reference: str = "centroid"
    frequencies: Sequence[float] = ()
    field_weights: Sequence[float] | None = None
    wavelength_weights: Sequence[float] | None = None
    glass_thickness: Thicknesses = None
    air_thickness: Thicknesses = None
    edge: float | None = None
    conventions: Conventions | str | Sequence[str] | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise BadMerit(
                f"{option('merit', self.kind)}: expected one of {', '.join(KINDS)}{did_you_mean(self.kind, KINDS)}"
            )
        if self.reference not in REFERENCES:
            raise BadMerit(f"{option('reference', self.reference)}: expected one of {', '.join(REFERENCES)}")
        whole = isinstance(self.rings, Integral) and isinstance(self.arms, Integral)
        if not whole or self.rings < 1 or self.arms < 2 or self.arms % 2:
            raise BadMerit(
                f"{option('rings', self.rings)} and {option('arms', self.arms)}: expected 1 or more, and an even number"
            )
        object.__setattr__(self, "frequencies", tuple(np.atleast_1d(self.frequencies).astype(float).tolist()))
        if not all(0 <= frequency < np.inf for frequency in self.frequencies):
            raise BadMerit(f"{option('frequencies', self.frequencies)}: expected finite numbers, 0 or more, cycles/mm")
        if bool(self.frequencies) != (self.kind == "mtf"):
            raise BadMerit(
                f"{option('merit', 'mtf')} goes with {option('frequencies')}, cycles/mm, and no other merit does"
            )
        object.__setattr__(self, "conventions", conventions_of(self.conventions))

    @property
    def boundaries(self) -> Boundaries:
        return Boundaries.of(self.glass_thickness, self.air_thickness, self.edge)

    def rows(self, lens: Lens, configurations: Sequence[int] | None = None) -> tuple[Row, ...]:
        """The rows for a lens, lengths in mm, in these configurations (from 1; by default all, with equal weight).

        Raises BadMerit.
        """
        kind = KINDS[self.kind]
        operand = kind.operands.get(self.reference) or next(iter(kind.operands.values()))
        about = f"{self.kind}, from the {self.reference}" if len(kind.operands) > 1 else self.kind
        rows = [Row("DMFS"), Row("BLNK", text=f"{about}: {kind.text}")]
        for setting, configured in _configurations(lens, configurations):
            rows += (*setting, *self.boundaries.rows(configured), *kind.rows(configured, operand, self))
        return tuple(rows)


def boundary_rows(lens: Lens, boundaries: Boundaries) -> tuple[Row, ...]:
    """The rows of boundaries alone, in every configuration."""
    rows: list[Row] = []
    for setting, configured in _configurations(lens, None):
        limits = tuple(boundaries.rows(configured))
        rows += (*setting, *limits) if limits else ()
    return tuple(rows)


def _configurations(lens: Lens, chosen: Sequence[int] | None) -> Iterator[tuple[tuple[Row, ...], Lens]]:
    """The row CONF of each configuration, if there are several, and the lens in it."""
    for number in range(1, len(lens.configurations) + 1) if chosen is None else chosen:
        yield ((Row("CONF", (number, 0)),), lens.configuration(number)) if lens.operands else ((), lens)


def _by_rays(lens: Lens, operand: str, settings: DefaultMerit) -> Iterator[Row]:
    """A row for every ray, by field, wavelength, arm and ring."""
    fields, colours = (
        _fields(lens, settings),
        _weights(lens.wavelength_weights, settings.wavelength_weights, "wavelength"),
    )
    count = sum(_arm_count(lens, field, settings.arms) for field, _ in fields) * len(colours) * settings.rings
    _refuse_many(count, f"{option('rings', settings.rings)} and {option('arms', settings.arms)}")
    nodes, weights = gauss_legendre(settings.rings)
    for field, field_weight in fields:
        angles = _arms(lens, field, settings.arms)
        for wavelength, weight in enumerate(colours, 1):
            share = np.pi * weight * field_weight / (len(colours) * len(fields) * len(angles))
            for angle in angles if share else ():
                for radius, g in zip(np.sqrt(0.5 * (nodes + 1)), 0.5 * weights, strict=True):
                    x, y = (round(float(radius * part), 15) + 0.0 for part in (np.cos(angle), np.sin(angle)))
                    yield Row(operand, (0, wavelength), (*field, x, y), weight=float(share * g))


def _by_frequencies(lens: Lens, operand: str, settings: DefaultMerit) -> Iterator[Row]:
    """A row for every field and frequency, all wavelengths together, with a target of 1."""
    fields = _fields(lens, settings)
    _refuse_many(len(fields) * len(settings.frequencies), f"{len(settings.frequencies)} {option('frequencies')}")
    for number, (_, weight) in enumerate(fields, 1):
        for frequency in settings.frequencies if weight else ():
            share = weight / (len(fields) * len(settings.frequencies))
            yield Row(operand, (1, 0), (float(number), float(frequency), 0.0, 0.0), target=1.0, weight=share)


def _fields(lens: Lens, settings: DefaultMerit) -> list[tuple[tuple[float, float], float]]:
    """(Hx, Hy) as parts of the largest field, and its weight, of every field."""
    points = np.stack([lens.fields.x.detach().numpy(), lens.fields.y.detach().numpy()], -1)
    largest = np.hypot(*points.T).max()
    points = (points / largest if largest > 0 else points) + 0.0
    weights = _weights(lens.fields.weight, settings.field_weights, "field")
    return [(tuple(point), weight) for point, weight in zip(points.tolist(), weights, strict=True)]


def _weights(of_lens: Tensor, weights: Sequence[float] | None, kind: str) -> list[float]:
    """The weights of fields or wavelengths, by default those of the lens. Raises BadMerit."""
    if weights is None:
        return of_lens.detach().tolist()
    numbers = np.atleast_1d(weights).astype(float)
    if len(numbers) != len(of_lens):
        raise BadMerit(f"{option(f'{kind}_weights')}: {len(numbers)} weights, and the lens has {len(of_lens)} {kind}s")
    if not (numbers.min() >= 0 and numbers.sum() > 0):
        raise BadMerit(f"{option(f'{kind}_weights')}: expected 0 or more, not all of them 0")
    return numbers.tolist()


def _refuse_many(rows: int, settings: str) -> None:
    """Raise BadMerit for more rows than MOST_ROWS, before one is made."""
    if rows > MOST_ROWS:
        raise BadMerit(f"{settings}: {rows:,} rows of a merit function, expected at most {MOST_ROWS:,}; ask for fewer")


def _arm_count(lens: Lens, field: tuple[float, float], arms: int) -> int:
    """Number of arms traced at a field: of a lens of revolution half of them, and one on the axis."""
    if not is_round_about_axis(lens) or bool(lens.fields.x.any()):
        return arms
    return arms // 2 if field != (0.0, 0.0) else 1


def _arms(lens: Lens, field: tuple[float, float], arms: int) -> np.ndarray:
    """The angles of the arms in radians, clockwise from the first right of the y axis."""
    count = _arm_count(lens, field, arms)
    return np.deg2rad(90 - (np.arange(count) + 0.5) * (360 / arms)) if count > 1 else np.zeros(1)


KINDS = {
    "spot": Kind({"centroid": "TRAC", "chief": "TRAR"}, _by_rays, "where rays land on the image"),
    "wavefront": Kind({"centroid": "OPDX", "chief": "OPDC"}, _by_rays, "optical path differences in waves"),
    "angular": Kind({"centroid": "ANAC", "chief": "ANAR"}, _by_rays, "directions of rays behind the lens, as cosines"),
    "mtf": Kind({"": "MTFA"}, _by_frequencies, "mean of tangential and sagittal MTF"),
}


# -- merit functions as values -----------------------------------------------------------------------------------------


class RowOptions(TypedDict):
    """Options of the evaluation of rows, as of `Evaluation`."""

    unit: float
    skip_unknown: bool
    conventions: Conventions | None


@dataclass(frozen=True)
class Merit:
    """Rows of a merit function, in order; `rows[i - 1]` is row i.

    unit: mm in the unit of length of targets and values, by which lengths are weighted relative to numbers and waves.
    conventions: of operands whose meaning the file's program leaves open, as "opd_tilt=common" (`Conventions`);
    skip_unknown: leave rows of unknown operands out. boundaries: the boundaries among the rows, between which
    `search` spreads its starts. Raises ValueError for other conventions.
    """

    rows: tuple[Row, ...] = ()
    unit: float = 1.0
    _: KW_ONLY
    conventions: Conventions | str | Sequence[str] | None = None
    skip_unknown: bool = False
    boundaries: Boundaries = dataclasses.field(default_factory=Boundaries)

    def __post_init__(self) -> None:
        object.__setattr__(self, "conventions", conventions_of(self.conventions))

    @classmethod
    def of(
        cls,
        lens: Lens,
        *,
        glass_thickness: Thicknesses = None,
        air_thickness: Thicknesses = None,
        edge: float | None = None,
        conventions: Conventions | str | Sequence[str] | None = None,
        skip_unknown: bool = False,
    ) -> "Merit":
        """The merit function of the lens's file, with boundaries in mm (as of `DefaultMerit`) that it does not have.

        Raises BadMerit if the file has none.
        """
        if lens.optimization_data is None or not lens.optimization_data.merit:
            raise BadMerit(f"the lens has no merit function of its own: choose one by {option('merit', 'spot')}")
        boundaries = Boundaries.of(glass_thickness, air_thickness, edge)
        stored = cls(
            lens.optimization_data.merit, lens.optimization_data.unit, conventions=conventions,
            skip_unknown=skip_unknown, boundaries=boundaries,
        )  # fmt: skip
        held = {in_unit(row, stored.unit, 1.0) for row in stored.rows}
        limits = [row for row in boundary_rows(lens, boundaries) if row.operand == "CONF" or row not in held]
        return stored + Merit(tuple(limits)) if any(row.operand != "CONF" for row in limits) else stored

    @classmethod
    def default(cls, lens: Lens, kind: str = "spot", **settings: Any) -> "Merit":
        """A default merit function of the lens, in mm; settings: those of `DefaultMerit`."""
        return merit_for(lens, DefaultMerit(kind, **settings))

    @property
    def options(self) -> RowOptions:
        """The options of the evaluation of these rows."""
        return {"unit": self.unit, "skip_unknown": self.skip_unknown, "conventions": conventions_of(self.conventions)}

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
        return dataclasses.replace(
            self, rows=(*ahead, *(rereferenced(row, lambda n: n + len(ahead)) for row in behind))
        )

    def __radd__(self, other: Sequence[Row]) -> "Merit":
        return Merit(tuple(other)) + self

    def __mul__(self, factor: float) -> "Merit":
        """The merit function with all weights multiplied by a factor."""
        rows = tuple(dataclasses.replace(row, weight=row.weight * factor) for row in self.rows)
        return dataclasses.replace(self, rows=rows)

    __rmul__ = __mul__

    def with_weights(self, by_row: Mapping[int, float] | None = None, **by_operand: float) -> "Merit":
        """The merit function with other weights, by number of a row or for all rows of an operand. Raises BadMerit."""
        return self._with(lambda row, weight: dataclasses.replace(row, weight=weight), by_row or {}, by_operand)

    def with_targets(self, by_row: Mapping[int, float] | None = None, **by_operand: float) -> "Merit":
        """The merit function with other targets, by number of a row or for all rows of an operand. Raises BadMerit."""
        return self._with(lambda row, target: dataclasses.replace(row, target=target), by_row or {}, by_operand)

    def _with(
        self, replaced: Callable[[Row, float], Row], by_row: Mapping[int, float], by_operand: Mapping[str, float]
    ) -> "Merit":
        known = dict.fromkeys(row.name for row in self.rows)
        for operand in by_operand:
            if operand not in known:
                raise BadMerit(f"no row {operand}; there are {', '.join(known)}{did_you_mean(operand, known)}")
        for number in by_row:
            if not 1 <= number <= len(self.rows):
                raise BadMerit(f"no row {number}; there are rows 1 to {len(self.rows)}")

        def changed(number: int, row: Row) -> Row:
            value = by_row.get(number, by_operand.get(row.name))
            return row if value is None else replaced(row, float(value))

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
    """The `Merit` of a merit function: of rows, of the settings or kind of a default one, by default the file's.

    configurations: of the rows of a default one, from 1; by default all. Raises BadMerit.
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
    lens: Lens, merit: str | None = None, *, skip_unknown: bool = False, **settings: Any
) -> Merit | DefaultMerit:
    """The merit function of the options of a command: a default one of that kind, or the file's. Raises BadMerit."""
    if merit is not None:
        return DefaultMerit(merit, **settings)
    if other := {*settings} - {"glass_thickness", "air_thickness", "edge", "conventions"}:
        raise BadMerit(
            f"{option(min(other))} belongs to a default merit function: name it by {option('merit')}, as spot"
        )
    return Merit.of(lens, skip_unknown=skip_unknown, **settings)


def arguments(row: Row) -> str:
    """The arguments of a row as text: its integers with their meaning, if known, and its four numbers."""
    operand = OPERANDS.get(row.operand)
    takes = operand.takes if operand is not None else ("", "")
    integers = [f"{kind} {number}" for kind, number in zip(takes, row.integers, strict=True) if kind and number]
    plain = [] if integers or not any(row.integers) else [f"{row.integers[0]} {row.integers[1]}"]
    numbers = [f"{number:.6g}" for number in row.numbers]
    has_numbers = any(row.numbers) and not (row.operand in BOUNDARIES and row.numbers == AT_RIM)
    return "  ".join([*integers, *plain, *([" ".join(numbers)] if has_numbers else [])])


def configurations_of(rows: Iterable[Row], current: int) -> list[int]:
    """The configuration (from 1) of every row; current: that of the rows before the first CONF."""
    configurations = []
    for row in rows:
        current = row.integers[0] if row.operand == "CONF" else current
        configurations.append(current)
    return configurations


def in_unit(row: Row, before: float, after: float) -> Row:
    """The row with its target in another unit of length; before, after: the units in mm."""
    power = OPERANDS[row.operand].length if row.operand in OPERANDS else 0
    return dataclasses.replace(row, target=row.target * (before / after) ** power) if power else row


def rereferenced(row: Row, number: Callable[[int], int]) -> Row:
    """A row with the new numbers of the rows that it refers to."""
    operand = OPERANDS.get(row.operand)
    if operand is None or operand.refers is None:
        return row
    probe = tuple(Row("EFFL") for _ in range(3))
    taken = operand.refers(Line(3, Row(row.operand, (1, 2)), 0), probe)  # [1], or [1, 2] of two rows and of a range
    first, second = row.integers
    return dataclasses.replace(row, integers=(number(first), number(second) if len(taken) > 1 else second))


# -- evaluation --------------------------------------------------------------------------------------------------------

#: Error of a row whose ray is lost, in the row's unit.
LOST = 10.0


class UnknownOperand(RaytraceError, ValueError):
    """A row with weight whose operand is not known."""


class Excesses(NamedTuple):
    """Excesses e (K,) of the rows of a one-sided operand: the row, from 0, of each, its derivatives (K, n), n = 0 where
    none are asked for, and its surface."""

    rows: np.ndarray
    excess: np.ndarray
    slope: np.ndarray
    surfaces: np.ndarray


@dataclasses.dataclass(frozen=True)
class Evaluated:
    """A merit function at given variables.

    values: (R,) of all rows, nan for text and rows of unknown operands; lost: (R,) bool. residuals: (m,) whose squares
    sum up to M²; jacobian: (m, n) their derivatives by the variables, (m, 0) where none are asked for; of_row: (m,) the
    row, from 0, of each. sides: of one-sided rows, whose residual is Σ max(0, e), by operand.
    """

    values: np.ndarray
    lost: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    of_row: np.ndarray
    sides: tuple[Excesses, ...] = ()

    @property
    def merit(self) -> float:
        return float(np.sqrt(self.residuals @ self.residuals))

    def contributions(self, rows: Sequence[int] | np.ndarray) -> np.ndarray:
        """Parts (K,) of some rows, from 0, in the sum of their squares."""
        squares = np.bincount(self.of_row, self.residuals**2, minlength=len(self.values))[rows]
        return squares / max(squares.sum(), 1e-300)


class Circle(RaytraceError, ValueError):
    """Rows that take values of one another in a circle."""


class Evaluation:
    """The rows of a merit function over a model: planned once, then called with variables (n,)."""

    def __init__(
        self,
        model: DesignVariables,
        rows: Sequence[Row],
        *,
        unit: float = 1.0,
        skip_unknown: bool = False,
        conventions: Conventions | None = None,
    ):
        """unit: mm in the unit of length of the rows; conventions: of operands. Raises UnknownOperand."""
        self.model, self.rows, self.unit = model, tuple(rows), unit
        self.conventions = conventions or Conventions()
        self.groups: list[tuple[Planner, tuple[Line, ...], Evaluate]] = []
        self.planners: list[tuple[int, Planner]] = []
        self.skipped = tuple(self._plan(skip_unknown))
        self.units = np.array([unit ** OPERANDS[r.operand].length if r.operand in OPERANDS else 1.0 for r in self.rows])
        counted = np.zeros(len(self.rows), dtype=bool)
        counted[[line.number - 1 for _, lines, _ in self.groups for line in lines]] = True
        self.weights = np.where(counted, [row.weight for row in self.rows], 0.0)
        total = self.weights[self.weights > 0].sum() or 1.0  # of conditions alone
        self.factors = np.sqrt(np.abs(self.weights) / total)
        self.targets = np.array([row.target for row in self.rows])

    def _plan(self, skip_unknown: bool) -> list[int]:
        """Plan all rows, those of arithmetic last and in the order of their references. Returns the skipped rows."""
        placed = {line.number: (settings, line) for settings, line in self._lines()}
        referred, skipped = self._referred(placed, skip_unknown)
        planners: dict[tuple[int, int], Planner] = {}
        groups: dict[tuple, list[Line]] = {}
        order = [number for number in placed if number not in referred] + in_order(referred)
        for number in (number for number in order if number not in skipped):
            settings, line = placed[number]
            operand = OPERANDS[line.row.operand]
            if settings not in planners:
                configuration, primary = settings
                view = self.model.views[configuration - 1]
                planners[settings] = Planner(view, primary, self.conventions, self.unit, self.rows)
            need_all(line, operand, planners[settings].lens)
            groups.setdefault((settings, line.row.operand, number if operand.refers else 0), []).append(line)
        for (settings, name, _), lines in groups.items():
            planner = planners[settings]
            self.groups.append((planner, tuple(lines), OPERANDS[name].plan(lines, planner)))
        self.planners = [(configuration, planner) for (configuration, _), planner in planners.items()]
        #: Rows whose values rows of arithmetic take.
        self.needed = frozenset(row for rows in referred.values() for row in rows)
        #: Rows with a weight, and all rows whose values they take.
        self.counted: set[int] = set()
        left = [number for number, row in enumerate(self.rows, 1) if row.weight != 0]
        while left:
            number = left.pop()
            if number not in self.counted:
                self.counted.add(number)
                left += referred.get(number, ())
        return sorted(skipped)

    def _lines(self) -> Iterator[tuple[tuple[int, int], Line]]:
        """Rows that have a value, each with the configuration and the primary wavelength of the settings above it."""
        lens = self.model.lens
        configuration, primary = lens.current_configuration, lens.primary_wavelength - 1
        for number, row in enumerate(self.rows, 1):
            line = Line(number, row, row.integers[1] - 1 if row.integers[1] > 0 else primary)
            if row.operand == "CONF":
                configuration = need(line, "configuration", row.integers[0], lens)
            elif row.operand == "PRIM":
                primary = need(line, "primary", row.integers[1], lens) - 1
            elif row.operand not in SETTINGS:
                yield (configuration, primary), line

    def _referred(self, placed: dict, skip_unknown: bool) -> tuple[dict[int, Sequence[int]], set[int]]:
        """The rows whose values each row of arithmetic takes, and the rows that cannot be evaluated."""
        referred, skipped = {}, set()

        def skip(line: Line, why: str, meant: str = "") -> None:
            if line.row.weight != 0 and not skip_unknown:
                raise UnknownOperand(
                    f"row {line.number} of the merit function: {why}; {option('skip_unknown')} leaves such rows "
                    f"out{meant}"
                )
            skipped.add(line.number)

        for number, (_, line) in placed.items():
            name = line.row.operand
            if name not in OPERANDS:
                skip(line, f"operand {name} is not known", did_you_mean(name, map(str, OPERANDS)))
            elif refers := OPERANDS[name].refers:
                referred[number] = refers(line, self.rows)
        for number in in_order(referred):
            if missing := skipped.intersection(referred[number]):
                line, first = placed[number][1], min(missing)
                value = f"the value of row {first}, {self.rows[first - 1].operand}, which has none"
                skip(line, f"{line.row.operand} takes {value}")
        return referred, skipped

    def __call__(
        self, variables: np.ndarray, *, derivatives: bool = False, shown: bool = True, by: Sequence[int] | None = None
    ) -> Evaluated:
        """All rows at variables; derivatives: with the Jacobian, by some of the variables or, without `by`, all.

        shown: with operands none of whose rows has a weight.
        """
        each = np.eye(len(variables))[slice(None) if by is None else list(by)]
        count = len(each)
        x = Dual(np.asarray(variables, dtype=float), each) if derivatives else np.asarray(variables, float)
        values = np.full(len(self.rows), np.nan)
        errors: list[np.ndarray] = []
        slopes: list[np.ndarray] = []
        rows: list[np.ndarray] = []
        numbers: dict[int, Number] = {}
        sides: list[Excesses] = []
        states = {configuration: self.model.views[configuration - 1].state(x) for configuration, _ in self.planners}
        contexts = {
            id(planner): EvaluationContext(planner, states[configuration], numbers)
            for configuration, planner in self.planners
        }
        for planner, lines, evaluate in self.groups:
            if not (shown or any(line.number in self.counted for line in lines)):
                continue
            places = np.array([line.number - 1 for line in lines])
            units = self.units[places]
            group = evaluate(contexts[id(planner)])
            sides += self._sides(group, places, units, count if derivatives else 0)
            all_values, parts = group.values / units, [part / units for part in group.parts]
            values[places] = value_of(all_values)
            numbers |= {line.number: all_values[k] for k, line in enumerate(lines) if line.number in self.needed}
            counted = self.factors[places] > 0
            in_parts = counted & bool(parts) & (self.targets[places] == 0)
            targets = self.targets[places]
            for number, chosen, target in (
                (all_values, counted & ~in_parts, targets),
                *((part, in_parts, np.zeros_like(targets)) for part in parts),
            ):
                if not chosen.any():
                    continue
                factor = self.factors[places][chosen]
                error = factor * (value_of(number)[..., chosen] - target[chosen])
                errors.append(error.ravel())
                if derivatives:
                    slopes.append((factor * slope_of(number, count)[..., chosen]).reshape(count, -1).T)
                rows.append(np.broadcast_to(places[chosen], error.shape).ravel())
        of_row = np.concatenate(rows) if rows else np.zeros(0, dtype=int)
        residuals = np.concatenate(errors) if errors else np.zeros(0)
        gone = ~np.isfinite(residuals)
        shared = np.bincount(of_row, minlength=len(self.rows))[of_row]
        residuals = np.where(gone, LOST * self.factors[of_row] / np.sqrt(np.maximum(shared, 1)), residuals)
        jacobian = np.zeros((len(residuals), 0))
        if derivatives:
            jacobian = np.concatenate(slopes) if slopes else np.zeros((0, count))
            jacobian = np.where(gone[:, None], 0.0, jacobian)
        lost = np.zeros(len(self.rows), dtype=bool)
        lost[of_row[gone]] = True
        return Evaluated(values, lost, residuals, jacobian, of_row, tuple(sides))

    def _sides(self, group: RowValues, places: np.ndarray, units: np.ndarray, count: int) -> Iterator[Excesses]:
        """The excesses of one-sided rows of an operand, except those that are nan, and `count` derivatives."""
        if not group.sides:
            return
        rows, excess, surfaces = group.sides
        undefined = np.bincount(rows, np.isnan(value_of(excess)), minlength=len(places)) > 0
        chosen = (self.factors[places] > 0)[rows] & ~undefined[rows]
        if chosen.any():
            scale = (self.factors[places] / units)[rows[chosen]]
            slope = (scale * slope_of(excess, count)[:, chosen]).T
            yield Excesses(places[rows[chosen]], scale * value_of(excess)[chosen], slope, surfaces[chosen])


def in_order(referred: dict[int, Sequence[int]]) -> list[int]:
    """Rows of arithmetic, each after the rows whose values it takes. Raises Circle.

    referred: these rows, by the number of the row of arithmetic.
    """
    try:
        return [row for row in TopologicalSorter(referred).static_order() if row in referred]
    except CycleError as error:
        circle = " → ".join(map(str, reversed(error.args[1])))
        raise Circle(
            f"rows {circle} of the merit function take values of one another in a circle: no row may wait for itself"
        ) from None
