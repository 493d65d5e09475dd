"""Attained values: every condition and boundary of an optimisation with its target and the value that the lens has."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from raytrace.maths.result import Column, text_table
from raytrace.optimization.conditions import conditions_in_unit, specified, with_taken
from raytrace.optimization.merit import Evaluated, Merit, arguments
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import RELATIONS, Specification
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.words import RaytraceWarning

EXACT = 1e-6  # tolerance of a condition, relative to its target, or to 1
_SHOWN = 12  # conditions and boundaries of a table
SOFT = 1e-3  # tolerance of a boundary in the merit function, relative to its target, or 1 µm


class NotReached(RaytraceWarning):
    """A condition or a boundary that the optimised lens does not meet."""


@dataclasses.dataclass(frozen=True)
class Attained:
    """The target and the attained value of a condition or boundary.

    name: of the condition, or of the operand and its arguments; relation: =, <= or >=; asked, reached: the target and
    the value, in mm of conditions, in the unit of the row of rows; row: in the merit function, from 1; 0 of `hold`;
    configuration: 0 for a lens with a single configuration; surface: the one with the largest excess over a boundary,
    0 for none; why: the reason.
    """

    name: str
    relation: str
    asked: float
    reached: float
    met: bool
    row: int = 0
    configuration: int = 0
    surface: int = 0
    why: str = ""

    @property
    def words(self) -> str:
        """The condition, as "efl=100"."""
        if self.row:
            return f"{self.name} {self.relation} {self.asked:.6g} (row {self.row})"
        return f"{self.name}{self.relation}{self.asked:.6g}"

    @property
    def place(self) -> str:
        """Surface and configuration in words."""
        parts = {"surface": self.surface, "configuration": self.configuration}
        return ", ".join(f"{name} {number}" for name, number in parts.items() if number)

    def document(self) -> dict[str, object]:
        return {**dataclasses.asdict(self), "reached": self.reached if np.isfinite(self.reached) else None}

    def __str__(self) -> str:
        where = f" ({self.place})" if self.place else ""
        reached = f"{self.reached:.6g}" if np.isfinite(self.reached) else "undefined"
        return f"{self.words} is not reached: {reached}{where}{f'; {self.why}' if self.why else ''}"


def attained_by(lens: Lens) -> tuple[Attained, ...]:
    """Every condition that a lens stores and every boundary of its merit function, with the values that it has.

    None of a batch. Raises BadHold and BadRow for a row of a surface that the lens does not have.
    """
    data = lens.optimization_data
    if data is None or lens.count is not None or not any(row.weight < 0 or _is_boundary(row) for row in data.merit):
        return ()
    function, held = specified(lens, Merit(data.merit, data.unit), ())
    bounding = [k for k, row in enumerate(function.rows, 1) if _is_boundary(row) and row.weight]
    needed = with_taken(function.rows, bounding)
    rows = [
        row if k in needed or row.operand in ("CONF", "PRIM") else Row("BLNK") for k, row in enumerate(function.rows, 1)
    ]
    conditions = conditions_in_unit(lens, held, data.unit)
    model = DesignVariables(lens)
    specification = Specification(model, rows, conditions, unit=data.unit, skip_unknown=True)
    return attained(specification, specification.evaluation(np.zeros(0), shown=False))


def in_words(lens: Lens) -> list[str]:
    """The table of `attained_by`, and the conditions that are off; an error that it raises is a line."""
    try:
        lines = table_of(attained_by(lens))
        off = [str(condition) for condition in lens.conditions if not condition.on]
    except ValueError as error:
        return [f"conditions: {error}"]
    return [*lines, *off]


def shown(results: Sequence[Attained]) -> list[Attained]:
    """The conditions and boundaries that tables list: all but boundaries that are met, of which the first few."""
    chosen = [k for k, row in enumerate(results) if not row.met or not row.row]
    met = [k for k, row in enumerate(results) if row.met and row.row]
    return [results[k] for k in sorted(chosen + met[: max(_SHOWN - len(chosen), 0)])]


def table_of(results: Sequence[Attained]) -> list[str]:
    """The lines of a table of the conditions and boundaries that are `shown`; none without any."""
    if not results:
        return []
    lines, more = text_table(columns_of(results)), len(results) - len(shown(results))
    return [*lines, f"and {more} more boundaries, met"] if more else lines


def columns_of(results: Sequence[Attained]) -> dict[Column, list]:
    """The columns of a table of the conditions and boundaries that are `shown`."""
    rows = shown(results)
    return {
        Column("condition", form="<"): [row.name for row in rows],
        Column("asked"): [f"{row.relation} {row.asked:.6g}" for row in rows],
        Column("reached"): [row.reached for row in rows],
        Column("remark", form="<", heading=" "): [
            ", ".join(filter(None, ["" if row.met else "not met", row.place])) for row in rows
        ],
    }


def attained(problem: Specification, evaluated: Evaluated) -> tuple[Attained, ...]:
    """Every condition, then every boundary of the merit function, without reasons."""
    return *conditions_attained(problem, evaluated), *_boundaries(problem, evaluated)


def rows_attained(problem: Specification) -> list[int]:
    """The rows, from 0, of the results of `attained`."""
    return [*condition_rows(problem), *_bounding_rows(problem)]


def condition_rows(problem: Specification) -> list[int]:
    """The rows of the conditions, from 0, among all rows of the evaluation."""
    rows = problem.evaluation.rows
    return [k for k in range(len(problem.rows), len(rows)) if rows[k].weight < 0]


def _bounding_rows(problem: Specification) -> list[int]:
    """Rows of the merit function, from 0, that must be met: rows with a weight below 0, and boundaries."""
    weights = problem.evaluation.weights
    return [k for k, row in enumerate(problem.rows) if weights[k] and (weights[k] < 0 or _is_boundary(row))]


def _is_boundary(row: Row) -> bool:
    return row.operand in OPERANDS and bool(OPERANDS[row.operand].bounds)


def conditions_attained(problem: Specification, evaluated: Evaluated) -> Iterator[Attained]:
    """Every condition, without reasons."""
    model, excesses = problem.model, _largest_excesses(evaluated)
    for k, condition in zip(condition_rows(problem), problem.conditions, strict=True):
        unit = problem.unit ** OPERANDS[condition.row.operand].length
        number, surface = _number_of(problem, k, evaluated, excesses)
        relation, target, number = condition.relation, unit * problem.evaluation.rows[k].target, unit * number
        missed = abs(number - target) if relation == "=" else RELATIONS[relation] * (number - target)
        met = bool(missed <= EXACT * max(abs(target), 1.0))
        configuration = (condition.configuration or model.lens.current_configuration) if len(model.views) > 1 else 0
        surface = 0 if met else surface
        yield Attained(condition.quantity, relation, target, number, met, 0, configuration, surface)


def _largest_excesses(evaluated: Evaluated) -> dict[int, tuple[float, int]]:
    """The largest excess of every one-sided row, also below 0, and its surface."""
    largest: dict[int, tuple[float, int]] = {}
    for rows, excesses, _, surfaces in evaluated.sides:
        for row, excess, surface in zip(rows.tolist(), excesses.tolist(), surfaces.tolist(), strict=True):
            if row not in largest or excess > largest[row][0]:
                largest[row] = excess, surface
    return largest


def _number_of(
    problem: Specification, k: int, evaluated: Evaluated, excesses: dict[int, tuple[float, int]]
) -> tuple[float, int]:
    """The quantity of a row, which a one-sided operand reports as its target where it is met, and its surface."""
    row, number = problem.evaluation.rows[k], float(evaluated.values[k])
    operand = OPERANDS[row.operand]
    if k in excesses:
        excess, surface = excesses[k]
        side = -1.0 if operand.bounds == ">=" else 1.0
        return row.target + side * excess / float(problem.evaluation.factors[k]), surface
    if operand.bounds and operand.refers:
        number = float(evaluated.values[row.integers[0] - 1])
        number = abs(number) if row.name.startswith("AB") else number
    return number, 0


def _boundaries(problem: Specification, evaluated: Evaluated) -> Iterator[Attained]:
    evaluation, excesses = problem.evaluation, _largest_excesses(evaluated)
    configurations = {
        line.number - 1: planner.view.configuration for planner, lines, _ in evaluation.groups for line in lines
    }
    several = len(problem.model.views) > 1
    for k in _bounding_rows(problem):
        row, operand = problem.rows[k], OPERANDS[problem.rows[k].operand]
        relation = operand.bounds or "="
        number, surface = _number_of(problem, k, evaluated, excesses)
        surface = surface if k in excesses and excesses[k][0] > 0 else 0
        missed = abs(number - row.target) if relation == "=" else RELATIONS[relation] * (number - row.target)
        tolerance = EXACT if evaluation.weights[k] < 0 else SOFT
        least = 1e-3 / problem.unit if tolerance == SOFT and operand.length == 1 else tolerance
        met = bool(missed <= max(tolerance * abs(row.target), least))
        name = f"{row.name} {arguments(row)}".strip()
        yield Attained(name, relation, row.target, number, met, k + 1, configurations[k] if several else 0, surface)
