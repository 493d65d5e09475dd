"""Conditions and boundaries of an optimisation: what is required, what is reached, and why a lens misses it.

Conditions c_i = 0 or ≤ 0 exclude one another, with the bounds of the variables, if multipliers w_i exist for which
Σ w_i c_i does not depend on the free variables, or is bounded by them, and is above 0 (Farkas). They come from the
linear program of minimum total miss

    minimise Σ t_i  with  |c_i + a_i p| ≤ t_i  or  c_i + a_i p ≤ t_i,  lower ≤ x + p ≤ upper,

a_i the derivatives of c_i. At one point the result concerns the linear model. If the sum moves at other points as the
model predicts, it concerns the conditions themselves.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.optimize import linprog

from raytrace.optimization.merit import arguments
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import RELATIONS, Condition, NoProblem, Problem, typical_of
from raytrace.optimization.variables import name_of

EXACT = 1e-6  # tolerance of a condition, relative to its target, or to 1
SOFT = 1e-3  # tolerance of a boundary in the merit function, relative to its target, or 1 µm
_EXCLUDED = 1e-7  # total miss of the linear program, conditions by their slopes
_COUNTS = 1e-6  # multipliers that count
_ELSEWHERE = 0.03  # relative to the scale of the variables: distance at which a contradiction is checked
_TRIES = 4
_NAMED = 4  # variables in one sentence


class NotReached(UserWarning):
    """A condition or a boundary that the optimised lens does not meet."""


@dataclasses.dataclass(frozen=True)
class Reached:
    """One condition or boundary of an optimisation.

    name: of the condition, or of the operand and its arguments; relation: =, <= or >=; asked, reached: the target and
    the value, in mm of conditions, in the unit of the row of rows; row: in the merit function, from 1; 0 of `hold`;
    configuration: 0 for a lens of one; surface: the one that passes a boundary most, 0 for none; why: the reason.
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
        parts = {"surface": self.surface, "configuration": self.configuration}
        return ", ".join(f"{name} {number}" for name, number in parts.items() if number)

    def document(self) -> dict:
        return {**dataclasses.asdict(self), "reached": self.reached if np.isfinite(self.reached) else None}

    def __str__(self) -> str:
        where = f" ({self.place})" if self.place else ""
        reached = f"{self.reached:.6g}" if np.isfinite(self.reached) else "undefined"
        return f"{self.words} is not reached: {reached}{where}{f'; {self.why}' if self.why else ''}"


def reached(problem: Problem, x: np.ndarray, *, lower: np.ndarray, upper: np.ndarray) -> tuple[Reached, ...]:
    """Every condition, then every boundary of the merit function, at variables (n,) between bounds (n,)."""
    results = [*_conditions(problem, x), *_boundaries(problem, x)]
    if all(result.met for result in results):
        return tuple(results)
    reasons, rows = _reasons(problem, x, lower, upper), [*_held_rows(problem), *_bounding_rows(problem)]
    return tuple(
        result if result.met else dataclasses.replace(result, why=reasons.get(row) or _default_reason(result))
        for row, result in zip(rows, results, strict=True)
    )


def refuse_contradictions(problem: Problem, x: np.ndarray, *, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise NoProblem for conditions that no lens meets between the bounds, as far as that is certain."""
    held = _held_rows(problem)
    needs = [need for need in _needs(problem, x) if need.number in held] if held else []
    conflict = _conflict(problem, needs, x, lower, upper)
    if conflict is None or not _holds_elsewhere(problem, conflict, x, lower, upper):
        return
    named = [_condition_text(problem, number) for number in conflict.numbers]
    values = {condition.words: condition.reached for condition in _conditions(problem, x)}
    listed = ", ".join(f"{name} (now {values[name]:.6g})" if name in values else name for name in named)
    raise NoProblem(f"`hold`: {listed}: {conflict.words(problem)}; change `hold`, `vary` or `bounds`")


# -- values ------------------------------------------------------------------------------------------------------------


def _held_rows(problem: Problem) -> list[int]:
    """Places of the conditions in all rows."""
    rows = problem.evaluation.rows
    return [k for k in range(len(problem.rows), len(rows)) if rows[k].weight < 0]


def _bounding_rows(problem: Problem) -> list[int]:
    """Places of rows of the merit function that must be met: with a weight below 0, or boundaries."""
    weights = problem.evaluation.weights
    return [
        k
        for k, row in enumerate(problem.rows)
        if weights[k] and (weights[k] < 0 or (row.operand in OPERANDS and OPERANDS[row.operand].bounds))
    ]


def _conditions(problem: Problem, x: np.ndarray) -> Iterator[Reached]:
    values, model = problem.evaluated(x).values, problem.model
    for k, condition in zip(_held_rows(problem), problem.conditions, strict=True):
        unit = problem.unit ** OPERANDS[condition.row.operand].length
        relation, target, number = condition.relation, unit * problem.evaluation.rows[k].target, unit * float(values[k])
        missed = abs(number - target) if relation == "=" else RELATIONS[relation] * (number - target)
        met = bool(missed <= EXACT * max(abs(target), 1.0))
        configuration = (condition.configuration or model.lens.current_configuration) if len(model.views) > 1 else 0
        yield Reached(_name(condition), relation, target, number, met, configuration=configuration)


def _name(condition: Condition) -> str:
    at = f"@{condition.configuration}" if condition.configuration else ""
    return f"{condition.name or condition.row.name}{at}"


def _boundaries(problem: Problem, x: np.ndarray) -> Iterator[Reached]:
    evaluation, evaluated = problem.evaluation, problem.evaluated(x)
    largest: dict[int, tuple[float, int]] = {}  # excess of every one-sided row, and its surface
    for rows, excesses, _, surfaces in evaluated.sides:
        for row, excess, surface in zip(rows.tolist(), excesses.tolist(), surfaces.tolist(), strict=True):
            if row not in largest or excess > largest[row][0]:
                largest[row] = excess, surface
    configurations = {
        line.number - 1: planner.view.configuration for planner, lines, _ in evaluation.groups for line in lines
    }
    several = len(problem.model.views) > 1
    for k in _bounding_rows(problem):
        row, operand = problem.rows[k], OPERANDS[problem.rows[k].operand]
        relation, number, surface = operand.bounds or "=", float(evaluated.values[k]), 0
        side = -1.0 if relation == ">=" else 1.0
        if k in largest:
            excess, surface = largest[k]
            number = row.target + side * excess / evaluation.factors[k]
            surface = surface if excess > 0 else 0
        elif operand.bounds and operand.refers:
            number = float(evaluated.values[row.integers[0] - 1])
            number = abs(number) if row.operand.startswith("AB") else number
        missed = abs(number - row.target) if relation == "=" else side * (number - row.target)
        tolerance = EXACT if evaluation.weights[k] < 0 else SOFT
        least = 1e-3 / problem.unit if tolerance == SOFT and operand.length == 1 else tolerance
        met = bool(missed <= max(tolerance * abs(row.target), least))
        name = f"{row.name} {arguments(row)}".strip()
        yield Reached(name, relation, row.target, number, met, k + 1, configurations[k] if several else 0, surface)


def _default_reason(result: Reached) -> str:
    if not np.isfinite(result.reached):
        return "a ray that it needs is lost"
    if result.row:
        return "the rest of the merit function outweighs it: give it more weight"
    return "the descent ended first: allow more cycles, or begin nearer to it"


# -- reasons -----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Need:
    """c + a p = 0, or ≤ 0; number: place of its row among all rows; part: its number within the row."""

    number: int
    miss: float
    slope: np.ndarray
    equal: bool
    part: int = 0


@dataclasses.dataclass(frozen=True)
class _Conflict:
    """Needs that exclude one another, their multipliers, and the variables whose bounds take part."""

    needs: tuple[_Need, ...]
    weights: np.ndarray
    bounded: tuple[int, ...]

    @property
    def numbers(self) -> list[int]:
        return [*dict.fromkeys(need.number for need in self.needs)]

    def words(self, problem: Problem) -> str:
        names = [name_of(problem.model.variables[k]) for k in self.bounded]
        listed = ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
        if not any(need.slope.any() for need in self.needs):
            return "no variable moves it"
        several = len(self.numbers) > 1
        if names:
            return f"{'they exclude one another' if several else 'it is out of reach'} within the bounds of {listed}"
        return "they exclude one another" if several else "it is out of reach"


def _condition_text(problem: Problem, number: int) -> str:
    """A condition in the syntax of `hold`, or a row of the merit function by its number."""
    held = _held_rows(problem)
    if number in held:
        condition = problem.conditions[held.index(number)]
        unit = problem.unit ** OPERANDS[condition.row.operand].length
        return f"{_name(condition)}{condition.relation}{unit * problem.evaluation.rows[number].target:.6g}"
    row = problem.rows[number]
    relation = (OPERANDS[row.operand].bounds if row.operand in OPERANDS else "") or "="
    return f"{row.name} {arguments(row)}".strip() + f" {relation} {row.target:.6g} (row {number + 1})"


def _needs(problem: Problem, x: np.ndarray) -> list[_Need]:
    """All conditions and boundaries at x, in units of the rows; none of rows without a value."""
    evaluated, evaluation = problem.evaluated(x, True), problem.evaluation
    sided = {int(row) for rows, *_ in evaluated.sides for row in rows}
    needs, parts = [], Counter()

    def add(k: int, miss: float, slope: np.ndarray, sign: float, equal: bool) -> None:
        scale = sign / evaluation.factors[k]
        needs.append(_Need(k, scale * miss, scale * slope, equal, parts[k]))
        parts[k] += 1

    for k, residual, slope in zip(evaluated.of_row.tolist(), evaluated.residuals, evaluated.jacobian, strict=True):
        if evaluation.weights[k] < 0 and k not in sided and not evaluated.lost[k]:
            sign = int(problem.signs[k])
            add(k, residual, slope, sign or 1, sign == 0)
    for rows, excesses, slopes, _ in evaluated.sides:
        for k, excess, slope in zip(rows.tolist(), excesses, slopes, strict=True):
            add(k, excess, slope, 1, False)
    return needs


def _scale(problem: Problem, x: np.ndarray) -> np.ndarray:
    typical = typical_of(problem.model)
    return np.where(np.isfinite(typical), typical, np.maximum(np.abs(x), 1e-3))


def _conflict(problem: Problem, needs: Sequence[_Need], x: np.ndarray, lower, upper) -> _Conflict | None:
    """Needs that exclude one another within the bounds by the linear model."""
    if not needs:
        return None
    scale = _scale(problem, x)
    slopes = np.array([need.slope for need in needs]) * scale
    sizes = np.linalg.norm(slopes, axis=1)
    misses = np.array([need.miss for need in needs])
    sizes = np.where(sizes > 1e-12 * np.maximum(np.abs(misses), 1.0), sizes, 0.0)
    slopes = np.where(sizes[:, None] > 0, slopes, 0.0)
    units = np.where(sizes > 0, sizes, np.maximum(np.abs(misses), 1e-300))
    small = (sizes == 0) & (np.abs(misses) <= EXACT)
    slopes, misses = slopes / units[:, None], np.where(small, 0.0, misses / units)
    equal = np.array([need.equal for need in needs])
    count, size = len(needs), len(x)
    rows = np.concatenate([slopes, -slopes[equal]])
    slack = np.concatenate([-np.eye(count), -np.eye(count)[equal]])
    right = np.concatenate([-misses, misses[equal]])
    ends = [*zip((lower - x) / scale, (upper - x) / scale, strict=True), *[(0.0, np.inf)] * count]
    cost = np.concatenate([np.zeros(size), np.ones(count)])
    solution = linprog(cost, A_ub=np.hstack([rows, slack]), b_ub=right, bounds=ends, method="highs")
    if solution.status != 0 or solution.fun <= _EXCLUDED:
        return None
    signed = -solution.ineqlin.marginals[:count]
    signed[equal] += solution.ineqlin.marginals[count:]
    at_bound = (np.abs(solution.lower.marginals) + np.abs(solution.upper.marginals))[:size] > _COUNTS
    chosen = np.flatnonzero(np.abs(signed) > _COUNTS).tolist()
    weights = (signed / units)[chosen]
    return _Conflict(tuple(needs[k] for k in chosen), weights, tuple(np.flatnonzero(at_bound).tolist()))


def _holds_elsewhere(problem: Problem, conflict: _Conflict, x: np.ndarray, lower, upper) -> bool:
    """Whether the weighted sum of the needs moves at other points as their linear model predicts."""
    draw, scale, checked = np.random.default_rng(0), _scale(problem, x), 0
    for _ in range(_TRIES):
        step = np.clip(x + _ELSEWHERE * scale * draw.normal(size=len(x)), lower, upper) - x
        there = {(need.number, need.part): need.miss for need in _needs(problem, x + step)}
        if any((need.number, need.part) not in there for need in conflict.needs):
            continue
        moved = np.array([there[need.number, need.part] for need in conflict.needs])
        model = np.array([need.miss + need.slope @ step for need in conflict.needs])
        size = np.abs(conflict.weights) @ np.maximum(np.abs(moved), np.abs([need.miss for need in conflict.needs]))
        if abs(conflict.weights @ (moved - model)) > 1e-8 * size:
            return False
        checked += 1
    return checked >= 2


def _reasons(problem: Problem, x: np.ndarray, lower, upper) -> dict[int, str]:
    """Why rows are missed, by their place, if conditions, boundaries and bounds exclude one another at x."""
    conflict = _conflict(problem, _needs(problem, x), x, lower, upper)
    if conflict is None:
        return {}
    reasons = {}
    for number in conflict.numbers:
        others = [_condition_text(problem, other) for other in conflict.numbers if other != number]
        listed = ", ".join(others[:_NAMED]) + (", …" if len(others) > _NAMED else "")
        words = f"it and {listed} exclude one another" if others else conflict.words(problem)
        reasons[number] = f"near this lens {words}"
    return reasons
