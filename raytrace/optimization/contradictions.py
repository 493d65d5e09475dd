"""Contradictions: conditions that exclude one another, and the reasons why conditions and boundaries are not met.

Conditions c_i = 0 or ≤ 0 exclude one another, with the bounds of the variables, if multipliers w_i exist for which
Σ w_i c_i does not depend on the free variables, or is bounded by them, and is above 0 (Farkas). They come from the
linear program of minimum total miss

    minimise Σ t_i  with  |c_i + a_i p| ≤ t_i  or  c_i + a_i p ≤ t_i,  lower ≤ x + p ≤ upper,

a_i the derivatives of c_i. At one point the result concerns the linear model. If the sum moves at other points as the
model predicts, it concerns the conditions themselves.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from scipy.optimize import linprog

from raytrace.optimization.attained import (
    EXACT,
    Attained,
    condition_rows,
    conditions_attained,
    rows_attained,
)
from raytrace.optimization.merit import arguments
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import NoProblem, Problem, typical_of
from raytrace.words import option

_EXCLUDED = 1e-7  # total miss of the linear program, conditions by their slopes
_COUNTS = 1e-6  # multipliers that count
_ELSEWHERE = 0.03  # relative to the scale of the variables: distance at which a contradiction is checked
_TRIES = 4
_NAMED = 4  # variables in one sentence

Bounds: TypeAlias = tuple[np.ndarray, np.ndarray]


def refuse_contradictions(problem: Problem, x: np.ndarray, *, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise NoProblem for conditions that no lens meets between the bounds, as far as that is certain."""
    rows = condition_rows(problem)
    needs = [need for need in _needs(problem, x) if need.row in rows]
    conflict = _conflict(problem, needs, x, (lower, upper))
    if conflict is None or not _holds_elsewhere(problem, conflict, x, (lower, upper)):
        return
    texts = [_condition_text(problem, row) for row in conflict.rows]
    values = {condition.words: condition.reached for condition in conditions_attained(problem, problem.evaluated(x))}
    listed = ", ".join(f"{text} (now {values[text]:.6g})" if text in values else text for text in texts)
    raise NoProblem(
        f"{option('hold')}: {listed}: {conflict.words(problem)}; change {option('hold')}, {option('vary')} or "
        f"{option('bounds')}"
    )


def with_reasons(
    results: Sequence[Attained], problem: Problem, x: np.ndarray, *, lower: np.ndarray, upper: np.ndarray
) -> tuple[Attained, ...]:
    """The results of `attained` at variables (n,) between bounds (n,), with the reason of each that is not met."""
    reasons = _reasons(problem, x, (lower, upper))
    return tuple(
        result if result.met else dataclasses.replace(result, why=reasons.get(row) or _default_reason(result))
        for row, result in zip(rows_attained(problem), results, strict=True)
    )


def _default_reason(result: Attained) -> str:
    if not np.isfinite(result.reached):
        return "a ray that it needs is lost"
    if result.row:
        return "the rest of the merit function outweighs it: give it more weight"
    return "the descent ended first: allow more cycles, or begin nearer to it"


@dataclasses.dataclass(frozen=True)
class _Need:
    """c + a p = 0, or ≤ 0; row: its place, from 0, among all rows; part: its number within the row."""

    row: int
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
    def rows(self) -> list[int]:
        return [*dict.fromkeys(need.row for need in self.needs)]

    def words(self, problem: Problem) -> str:
        if not any(need.slope.any() for need in self.needs):
            return "no variable moves it"
        excluded = "they exclude one another" if len(self.rows) > 1 else "it is out of reach"
        names = [problem.model.variables[k].name for k in self.bounded]
        return f"{excluded} within the bounds of {_listed(names)}" if names else excluded


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")


def _condition_text(problem: Problem, k: int) -> str:
    """A condition in the syntax of `hold`, or a row of the merit function by its number."""
    rows = condition_rows(problem)
    if k in rows:
        condition = problem.conditions[rows.index(k)]
        unit = problem.unit ** OPERANDS[condition.row.operand].length
        return f"{condition.quantity}{condition.relation}{unit * problem.evaluation.rows[k].target:.6g}"
    row = problem.rows[k]
    relation = (OPERANDS[row.operand].bounds if row.operand in OPERANDS else "") or "="
    return f"{row.name} {arguments(row)}".strip() + f" {relation} {row.target:.6g} (row {k + 1})"


def _needs(problem: Problem, x: np.ndarray) -> list[_Need]:
    """All conditions and boundaries at x, in units of the rows, except rows without a value."""
    evaluated, evaluation = problem.evaluated(x, True), problem.evaluation
    sided = {int(row) for rows, *_ in evaluated.sides for row in rows}
    needs: list[_Need] = []
    parts: Counter[int] = Counter()

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


def _conflict(problem: Problem, needs: Sequence[_Need], x: np.ndarray, bounds: Bounds) -> _Conflict | None:
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
    ends = [*zip(*((bound - x) / scale for bound in bounds), strict=True), *[(0.0, np.inf)] * count]
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


def _holds_elsewhere(problem: Problem, conflict: _Conflict, x: np.ndarray, bounds: Bounds) -> bool:
    """Whether the weighted sum of the needs moves at other points as their linear model predicts."""
    draw, scale, checked = np.random.default_rng(0), _scale(problem, x), 0
    for _ in range(_TRIES):
        step = np.clip(x + _ELSEWHERE * scale * draw.normal(size=len(x)), *bounds) - x
        misses = {(need.row, need.part): need.miss for need in _needs(problem, x + step)}
        if any((need.row, need.part) not in misses for need in conflict.needs):
            continue
        moved = np.array([misses[need.row, need.part] for need in conflict.needs])
        model = np.array([need.miss + need.slope @ step for need in conflict.needs])
        size = np.abs(conflict.weights) @ np.maximum(np.abs(moved), np.abs([need.miss for need in conflict.needs]))
        if abs(conflict.weights @ (moved - model)) > 1e-8 * size:
            return False
        checked += 1
    return checked >= 2


def _reasons(problem: Problem, x: np.ndarray, bounds: Bounds) -> dict[int, str]:
    """Why rows are missed, by their place, if conditions, boundaries and bounds exclude one another at x."""
    conflict = _conflict(problem, _needs(problem, x), x, bounds)
    if conflict is None:
        return {}
    reasons = {}
    for k in conflict.rows:
        others = [_condition_text(problem, other) for other in conflict.rows if other != k]
        words = f"it and {_listed(others)} exclude one another" if others else conflict.words(problem)
        reasons[k] = f"near this lens {words}"
    return reasons
