"""Reached: what conditions and boundaries of an optimisation ask for, what the lens has, and why it misses them.

Conditions c_i = 0 or ≤ 0 exclude one another, with the bounds of the variables, where multipliers w_i exist for which
Σ w_i c_i does not depend on the variables that are free, or is bounded by them, and is above 0 (Farkas). They come from
the linear program of least total miss

    least Σ t_i  where  |c_i + a_i p| ≤ t_i  or  c_i + a_i p ≤ t_i,  lower ≤ x + p ≤ upper,

a_i the derivatives of c_i. At one point that is a statement about the linear model. Where the sum moves as the model
says at other points, too, it is one about the conditions themselves.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.optimize import linprog

from raytrace.optimization.merit import arguments
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import RELATIONS, NoProblem, Problem, typical_of
from raytrace.optimization.variables import name_of

EXACT = 1e-6  # of a target, or of 1: by which a condition that is held may be missed
SOFT = 1e-3  # of a target, or of 1 µm: by which a boundary may be passed that only costs what passes it
_EXCLUDED = 1e-7  # total miss of the linear program, conditions by their slopes
_COUNTS = 1e-6  # multipliers that count
_ELSEWHERE = 0.03  # of what is a lot of a variable: how far away a contradiction is checked
_TRIES = 4
_NAMED = 4  # variables in one sentence


class NotReached(UserWarning):
    """A condition or a boundary that the lens at the end of an optimisation does not meet."""


@dataclasses.dataclass(frozen=True)
class Reached:
    """One condition or boundary of an optimisation: what was asked for and what was reached.

    asked, reached: in mm of conditions, in the unit of the row of rows.

    name: of the condition, or of the operand and its arguments; relation: =, <= or >=; row: in the merit function, from
    1; 0 of `hold`; configuration: 0 where the lens has one; surface: which one passes a boundary most, 0 for none.
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
        """What was asked for, as "efl=100"."""
        return f"{self.name}{self.relation}{self.asked:.6g}" if not self.row else self._of_row

    @property
    def _of_row(self) -> str:
        return f"{self.name} {self.relation} {self.asked:.6g} (row {self.row})"

    @property
    def place(self) -> str:
        told = [f"surface {self.surface}"] if self.surface else []
        return ", ".join([*told, *([f"configuration {self.configuration}"] if self.configuration else [])])

    def document(self) -> dict:
        found = dataclasses.asdict(self)
        found["reached"] = self.reached if np.isfinite(self.reached) else None
        return found

    def __str__(self) -> str:
        where = f" ({self.place})" if self.place else ""
        reached = f"{self.reached:.6g}" if np.isfinite(self.reached) else "undefined"
        return f"{self.words} is not reached: {reached}{where}{f'; {self.why}' if self.why else ''}"


def reached(problem: Problem, x: np.ndarray, *, lower: np.ndarray, upper: np.ndarray) -> tuple[Reached, ...]:
    """Every condition, then every boundary of the merit function, at variables (n,) between bounds (n,)."""
    found = [*_conditions(problem, x), *_boundaries(problem, x)]
    if all(one.met for one in found):
        return tuple(found)
    reasons = _reasons(problem, x, lower, upper)
    return tuple(
        one if one.met else dataclasses.replace(one, why=reasons.get(number) or _ended(one))
        for number, one in zip(_numbers(problem), found, strict=True)
    )


def refuse_contradictions(problem: Problem, x: np.ndarray, *, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise NoProblem for conditions that no lens meets between the bounds, as far as that is certain."""
    held = _held_rows(problem)
    needs = [need for need in _needs(problem, x) if need.number in held] if held else []
    conflict = _conflict(problem, needs, x, lower, upper)
    if conflict is None or not _holds_elsewhere(problem, conflict, x, lower, upper):
        return
    named = [condition_name(problem, number) for number in conflict.numbers]
    now = {one.words: one.reached for one in _conditions(problem, x)}
    told = ", ".join(f"{name} (now {now[name]:.6g})" if name in now else name for name in named)
    raise NoProblem(f"`hold`: {told}: {conflict.words(problem)}; change what is held, `vary` or `bounds`")


# -- what was reached --------------------------------------------------------------------------------------------------


def _held_rows(problem: Problem) -> list[int]:
    """Places of the conditions in all rows."""
    rows = problem.evaluation.rows
    return [k for k in range(len(problem.rows), len(rows)) if rows[k].weight < 0]


def _bounding_rows(problem: Problem) -> list[int]:
    """Places of rows of the merit function that are to be met: with a weight below 0, or boundaries."""
    weights = problem.evaluation.weights
    return [
        k
        for k, row in enumerate(problem.rows)
        if weights[k] and (weights[k] < 0 or (row.operand in OPERANDS and OPERANDS[row.operand].bounds))
    ]


def _numbers(problem: Problem) -> list[int]:
    """The places of all conditions and boundaries, in the order of `reached`."""
    return [*_held_rows(problem), *_bounding_rows(problem)]


def _conditions(problem: Problem, x: np.ndarray) -> Iterator[Reached]:
    values = problem.evaluated(x).values
    several = len(problem.model.views) > 1
    for k, one in zip(_held_rows(problem), problem.conditions, strict=True):
        unit = problem.unit ** OPERANDS[one.row.operand].length
        relation, target, number = one.relation, unit * problem.evaluation.rows[k].target, unit * float(values[k])
        missed = abs(number - target) if relation == "=" else RELATIONS[relation] * (number - target)
        at = one.configuration or problem.model.lens.current_configuration
        name = one.name or one.row.name
        met = bool(missed <= EXACT * max(abs(target), 1.0))
        name = f"{name}@{at}" if one.configuration else name
        yield Reached(name, relation, target, number, met, configuration=at if several else 0)


def _boundaries(problem: Problem, x: np.ndarray) -> Iterator[Reached]:
    evaluation, found = problem.evaluation, problem.evaluated(x)
    worst = _worst(found.sides)
    at = {line.number - 1: planner for planner, lines, _ in evaluation.groups for line in lines}
    several = len(problem.model.views) > 1
    for k in _bounding_rows(problem):
        row, operand = problem.rows[k], OPERANDS[problem.rows[k].operand]
        relation, number, surface = operand.bounds or "=", float(found.values[k]), 0
        side = -1.0 if relation == ">=" else 1.0
        if k in worst:
            excess, surface = worst[k]
            number = row.target + side * excess / evaluation.factors[k]
            surface = surface if excess > 0 else 0
        elif operand.bounds and operand.refers:
            number = float(found.values[row.integers[0] - 1])
            number = abs(number) if row.operand.startswith("AB") else number
        missed = abs(number - row.target) if relation == "=" else side * (number - row.target)
        part = EXACT if evaluation.weights[k] < 0 else SOFT
        least = (1e-3 / problem.unit if operand.length == 1 else part) if part == SOFT else part
        met = bool(missed <= (max(part * abs(row.target), least)))
        where = at[k].view.configuration if several else 0
        name = f"{row.name} {arguments(row)}".strip()
        yield Reached(name, relation, row.target, number, met, k + 1, where, surface)


def _worst(sides: Sequence[tuple]) -> dict[int, tuple[float, int]]:
    """Of every one-sided row the largest excess and its surface."""
    found: dict[int, tuple[float, int]] = {}
    for rows, excess, _, surfaces in sides:
        for row, e, surface in zip(rows.tolist(), excess.tolist(), surfaces.tolist(), strict=True):
            if row not in found or e > found[row][0]:
                found[row] = e, surface
    return found


def _ended(one: Reached) -> str:
    if not np.isfinite(one.reached):
        return "a ray that it needs is lost"
    if one.row:
        return "the rest of the merit function outweighs it: give it more weight"
    return "the descent ended first: allow more cycles, or begin nearer to it"


# -- why ---------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Need:
    """c + a p = 0, or ≤ 0: number: place of its row among all rows; part: its number among those of the row."""

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


def condition_name(problem: Problem, number: int) -> str:
    """A condition as it was asked for, or a row of the merit function by its number."""
    held = _held_rows(problem)
    if number in held:
        one = problem.conditions[held.index(number)]
        at = f"@{one.configuration}" if one.configuration else ""
        unit = problem.unit ** OPERANDS[one.row.operand].length
        return f"{one.name or one.row.name}{at}{one.relation}{unit * problem.evaluation.rows[number].target:.6g}"
    row = problem.rows[number]
    relation = (OPERANDS[row.operand].bounds if row.operand in OPERANDS else "") or "="
    return f"{row.name} {arguments(row)}".strip() + f" {relation} {row.target:.6g} (row {number + 1})"


def _needs(problem: Problem, x: np.ndarray) -> list[_Need]:
    """All that is to be met at x, in units of the rows; none of rows that have no value there."""
    found, evaluation = problem.evaluated(x, True), problem.evaluation
    sided = {int(row) for rows, *_ in found.sides for row in rows}
    needs = []
    for k, residual, slope in zip(found.of_row.tolist(), found.residuals, found.jacobian, strict=True):
        if evaluation.weights[k] < 0 and k not in sided and not found.lost[k]:
            factor, sign = evaluation.factors[k], int(problem.signs[k])
            needs.append(_Need(k, (sign or 1) * residual / factor, (sign or 1) * slope / factor, sign == 0))
    for rows, excess, slopes, _ in found.sides:
        for k, e, slope in zip(rows.tolist(), excess, slopes, strict=True):
            factor = evaluation.factors[k]
            needs.append(_Need(k, e / factor, slope / factor, False))
    seen: dict[int, int] = {}
    for place, need in enumerate(needs):
        seen[need.number] = seen.get(need.number, -1) + 1
        needs[place] = dataclasses.replace(need, part=seen[need.number])
    return needs


def _scale(problem: Problem, x: np.ndarray) -> np.ndarray:
    typical = typical_of(problem.model)
    return np.where(np.isfinite(typical), typical, np.maximum(np.abs(x), 1e-3))


def _conflict(problem: Problem, needs: Sequence[_Need], x: np.ndarray, lower, upper) -> _Conflict | None:
    """Needs of which the linear model says that they exclude one another within the bounds."""
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
    done = linprog(cost, A_ub=np.hstack([rows, slack]), b_ub=right, bounds=ends, method="highs")
    if done.status != 0 or done.fun <= _EXCLUDED:
        return None
    signed = -done.ineqlin.marginals[:count]
    signed[equal] += done.ineqlin.marginals[count:]
    taken = np.abs(signed) > _COUNTS
    at_bound = (np.abs(done.lower.marginals) + np.abs(done.upper.marginals))[:size] > _COUNTS
    chosen = [k for k in range(count) if taken[k]]
    weights = (signed / units)[chosen]
    return _Conflict(tuple(needs[k] for k in chosen), weights, tuple(np.flatnonzero(at_bound).tolist()))


def _holds_elsewhere(problem: Problem, conflict: _Conflict, x: np.ndarray, lower, upper) -> bool:
    """Whether the weighted sum of the needs moves as their linear model says at other points, too."""
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
    """Why rows are missed, by their place, where conditions, boundaries and bounds exclude one another at x."""
    conflict = _conflict(problem, _needs(problem, x), x, lower, upper)
    if conflict is None:
        return {}
    found = {}
    for number in conflict.numbers:
        others = [condition_name(problem, one) for one in conflict.numbers if one != number]
        listed = ", ".join(others[:_NAMED]) + (", …" if len(others) > _NAMED else "")
        told = conflict.words(problem)
        found[number] = f"near this lens it and {listed} exclude one another" if others else f"near this lens {told}"
    return found
