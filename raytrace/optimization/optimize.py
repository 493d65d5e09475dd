"""Optimising: the lens at a minimum of its merit function, from the lens as it is, and the report of it.

Opening: where most rays of the initial design fail, it descends first on the rays of a small part of pupil and field,
through which light passes every lens. The part grows until no ray of the whole beam fails.

Conditions c_i = 0 or ≤ 0 exclude one another, with the bounds of the variables, if multipliers w_i exist for which
Σ w_i c_i does not depend on the free variables, or is bounded by them, and is above 0 (Farkas). They come from the
linear program of minimum total miss

    minimise Σ t_i  with  |c_i + a_i p| ≤ t_i  or  c_i + a_i p ≤ t_i,  lower ≤ x + p ≤ upper,

a_i the derivatives of c_i. At one point the result concerns the linear model. If the sum moves at other points as the
model predicts, it concerns the conditions themselves.
"""

import dataclasses
import os
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from os import PathLike
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import linprog
from torch import Tensor

from raytrace.analysis.layout import draw_layout, on_one_scale
from raytrace.analysis.panels import first_order_text
from raytrace.analysis.spot_diagram import airy_radius, draw_spot_to_scale, field_spots, panel_size, wavelength_handles
from raytrace.files import check_output
from raytrace.io import write_lens
from raytrace.maths.numerics import detached, value
from raytrace.maths.result import Column, Result, Table, number, plain, text_table
from raytrace.optimization.checkpoint import STOPPED, BadCheckpoint, Checkpoint, Log, Stored, read_checkpoint
from raytrace.optimization.glass_choice import Choice, GlassStep, catalogs_of, pool_of
from raytrace.optimization.least_squares import (
    BestDescent,
    Cycle,
    PathState,
    SolverOptions,
    SolverState,
    best_of_paths,
    least_squares,
    minimise,
)
from raytrace.optimization.merit import DefaultMerit, Evaluated, Merit, arguments, configurations_of, merit_for
from raytrace.optimization.operands.mtf import MODULATION
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import (
    RELATIONS,
    Condition,
    Expectation,
    ExpectationSettings,
    FunctionMerit,
    NoProblem,
    Problem,
    conditions_in_unit,
    optimization_data_of,
    typical_of,
)
from raytrace.optimization.variables import DesignVariables, bounds_of, design_variables, name_of, without_glass
from raytrace.plotting import style
from raytrace.system.identity import digest, identity
from raytrace.system.lens import Lens, field_label, field_points
from raytrace.system.optimization_data import Row, Vary
from raytrace.system.parameter_paths import OF_LENS
from raytrace.tracing.compiled import prepare
from raytrace.tracing.geometry import warn_of_defects
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.paraxial import first_order
from raytrace.words import RaytraceWarning, calling_level, option

# -- conditions: what is required, and what is reached -----------------------------------------------------------------

EXACT = 1e-6  # tolerance of a condition, relative to its target, or to 1
SOFT = 1e-3  # tolerance of a boundary in the merit function, relative to its target, or 1 µm
_EXCLUDED = 1e-7  # total miss of the linear program, conditions by their slopes
_COUNTS = 1e-6  # multipliers that count
_ELSEWHERE = 0.03  # relative to the scale of the variables: distance at which a contradiction is checked
_TRIES = 4
_NAMED = 4  # variables in one sentence


class NotReached(RaytraceWarning):
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
    results = [*conditions_at(problem, x), *_boundaries(problem, x)]
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
    values = {condition.words: condition.reached for condition in conditions_at(problem, x)}
    listed = ", ".join(f"{name} (now {values[name]:.6g})" if name in values else name for name in named)
    raise NoProblem(
        f"{option('hold')}: {listed}: {conflict.words(problem)}; change {option('hold')}, {option('vary')} or "
        f"{option('bounds')}"
    )


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


def conditions_at(problem: Problem, x: np.ndarray) -> Iterator[Reached]:
    """Every condition at variables (n,), without reasons."""
    evaluated, model = problem.evaluated(x), problem.model
    excesses = _largest_excesses(evaluated)
    for k, condition in zip(_held_rows(problem), problem.conditions, strict=True):
        unit = problem.unit ** OPERANDS[condition.row.operand].length
        number, surface = _number_of(problem, k, evaluated, excesses)
        relation, target, number = condition.relation, unit * problem.evaluation.rows[k].target, unit * number
        missed = abs(number - target) if relation == "=" else RELATIONS[relation] * (number - target)
        met = bool(missed <= EXACT * max(abs(target), 1.0))
        configuration = (condition.configuration or model.lens.current_configuration) if len(model.views) > 1 else 0
        where = {"configuration": configuration, "surface": 0 if met else surface}
        yield Reached(_name(condition), relation, target, number, met, **where)


def _name(condition: Condition) -> str:
    at = f"@{condition.configuration}" if condition.configuration else ""
    return f"{condition.name or condition.row.name}{at}"


def _largest_excesses(evaluated: Evaluated) -> dict[int, tuple[float, int]]:
    """The largest excess of every one-sided row, also below 0, and its surface."""
    largest: dict[int, tuple[float, int]] = {}
    for rows, excesses, _, surfaces in evaluated.sides:
        for row, excess, surface in zip(rows.tolist(), excesses.tolist(), surfaces.tolist(), strict=True):
            if row not in largest or excess > largest[row][0]:
                largest[row] = excess, surface
    return largest


def _number_of(
    problem: Problem, k: int, evaluated: Evaluated, excesses: dict[int, tuple[float, int]]
) -> tuple[float, int]:
    """The quantity of a row, which a one-sided operand reports as its target where it is met, and its surface."""
    row, number = problem.evaluation.rows[k], float(evaluated.values[k])
    operand = OPERANDS[row.operand]
    if k in excesses:
        excess, surface = excesses[k]
        side = -1.0 if operand.bounds == ">=" else 1.0
        return row.target + side * excess / problem.evaluation.factors[k], surface
    if operand.bounds and operand.refers:
        number = float(evaluated.values[row.integers[0] - 1])
        number = abs(number) if row.operand.startswith("AB") else number
    return number, 0


def _boundaries(problem: Problem, x: np.ndarray) -> Iterator[Reached]:
    evaluation, evaluated = problem.evaluation, problem.evaluated(x)
    excesses = _largest_excesses(evaluated)
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
    for k in conflict.numbers:
        others = [_condition_text(problem, other) for other in conflict.numbers if other != k]
        listed = ", ".join(others[:_NAMED]) + (", …" if len(others) > _NAMED else "")
        words = f"it and {listed} exclude one another" if others else conflict.words(problem)
        reasons[k] = f"near this lens {words}"
    return reasons


# -- report ------------------------------------------------------------------------------------------------------------

_MOST_FIELDS = 5
_MOST_BARS = 10
_MOST_CONFIGURATIONS = 4
_BEFORE, _AFTER = style.FAINT, style.FIELD_COLOURS[0]


@style.styled
def optimize_report(found):
    """One page: the lens and its spots before and after in its configurations, on one scale, the merit by cycle, the
    operands that are left, and what conditions and boundaries asked for and reached."""
    each, conditions = _configurations(found), found.shown_conditions()
    count, below = len(each), 0.16 * (len(conditions) + 3) if conditions else 0.0
    heights = [2.8 * count, 4.2 * count, 2.9, *([below] if conditions else [])]
    figure = style.new_figure(10.0, 0.3 + sum(heights))
    name = style.fill(found.lens.name, figure.get_figwidth(), 12, bold=True) or "Lens"
    figure.suptitle(name, fontsize=12, fontweight="bold")
    top, middle, bottom, *last = figure.subfigures(len(heights), 1, height_ratios=heights, hspace=0.02)
    for row, (label, before, after) in zip(top.subplots(count, 2, squeeze=False), each, strict=True):
        for axes, lens, when, merit in (
            (row[0], before, "Before", found.merit_before),
            (row[1], after, "After", found.merit_after),
        ):
            _draw_lens(axes, lens, f"{when}, {label}" if label else f"{when}: merit {style.number_text(merit)}")
        on_one_scale(row)
    _draw_spots(middle, each)
    left, right = bottom.subplots(1, 2, width_ratios=(1.0, 1.0))
    _draw_history(left, found)
    _draw_left(right, found)
    if conditions:
        _draw_conditions(last[0].add_subplot(), found)
    return figure


def _configurations(found) -> list[tuple[str, Lens, Lens]]:
    """The configurations that are drawn, spread over all: label, before and after; one alone has no label."""
    pairs = [*zip(found.before.configurations, found.lens.configurations, strict=True)]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_CONFIGURATIONS)).round().astype(int))
    several = len(pairs) > 1
    return [
        (f"configuration {k + 1} of {len(pairs)}" if several else "", *(detached(one) for one in pairs[k]))
        for k in chosen.tolist()
    ]


def _draw_conditions(axes, found) -> None:
    """The table of targets and values reached; those not met are red."""
    lines, shown = found.conditions_in_words(), found.shown_conditions()
    axes.axis("off")
    axes.set_title("Asked and reached", fontweight="bold", loc="left")
    for k, line in enumerate(lines):
        missed = 0 < k <= len(shown) and not shown[k - 1].met
        axes.annotate(
            line, (0.0, 1.0), (0, -11 * k - 4), xycoords="axes fraction", textcoords="offset points", va="top",
            fontsize=7.5, family="monospace", color="#b00020" if missed else style.INK,
        )  # fmt: skip


def _draw_lens(axes, lens: Lens, title: str) -> None:
    draw_layout(axes, lens, fields=drawn_fields(lens), rays=5)
    axes.set_title(f"{title}\n", fontweight="bold", pad=4)
    axes.annotate(
        first_order_text(lens), (0.5, 1.0), (0, 5), xycoords="axes fraction",
        textcoords="offset points", ha="center", fontsize=7.5, color=style.GREY,
    )  # fmt: skip


def drawn_fields(lens: Lens):
    """The fields that are drawn (2, F): all, or as many as stay legible, spread over all."""
    points = torch.stack([lens.fields.x, lens.fields.y])
    count = points.shape[1]
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_FIELDS)).round().astype(int))
    return points[:, chosen.tolist()]


def _draw_spots(page, each: list[tuple[str, Lens, Lens]]) -> None:
    """A row of spots before and one after, of every configuration, on one scale; small ones are enlarged in a corner
    of their panel."""
    panels = page.subplots(2 * len(each), max(drawn_fields(after).shape[1] for _, _, after in each), squeeze=False)
    first = each[0][2]
    wavelengths, airy = style.array(first.wavelengths), float(airy_radius(first))
    states = []
    for label, *both in each:
        spots = [field_spots(lens, fields=drawn_fields(lens)) for lens in both]
        half = panel_size(np.concatenate([style.array(whole.geometric_radius) for whole, _ in spots]), airy)
        states += [(label, *state, half) for state in zip(both, spots, ("before", "after"), strict=True)]
    for row, (label, lens, (whole, dots), when, half) in zip(panels, states, strict=True):
        fields = drawn_fields(lens)
        look = {"wavelengths": style.array(lens.wavelengths), "airy": float(airy_radius(lens)), "half": half}
        for f, panel in enumerate(row):
            if f >= fields.shape[1]:
                panel.axis("off")
                continue
            draw_spot_to_scale(panel, whole, dots, f, **look)
            if when == "before":
                colour = style.field_colours(len(row))[f]
                panel.set_title(field_label(lens, style.array(fields)[:, f]), color=colour, fontsize=8.5)
        row[0].set_ylabel(f"Spots {when}" + (f"\n{label}" if label else ""), fontweight="bold")
    page.legend(handles=wavelength_handles(wavelengths, airy), loc="outside lower center", ncols=6, handletextpad=0.3)


def _draw_history(axes, found) -> None:
    of_glasses = [step.reached for step in found.glasses]
    merit = np.concatenate([[found.merit_before], of_glasses, style.array(found.history)[:, 0]])
    axes.plot(np.arange(len(merit)), merit, color=_AFTER, marker="." if len(merit) < 40 else None, markersize=4)
    _scale_merit(axes, merit)
    axes.locator_params(axis="x", integer=True)
    axis = "step of the choice of glasses, then cycle" if of_glasses else "cycle"
    axes.set_xlabel(f"{axis} ({found.evaluations} evaluations, {found.seconds:.2g} s)")
    axes.set_ylabel("merit")
    axes.set_title("Merit function", fontweight="bold")
    axes.annotate(
        STOPPED[found.stopped], (0.98, 0.94), xycoords="axes fraction", ha="right", fontsize=7.5, color=style.GREY
    )
    axes.grid(alpha=0.25)


def _scale_merit(axes, merit: np.ndarray) -> None:
    """Logarithmic over more than a factor of three, else linear; a small change is drawn about a printed value."""
    least, most = float(np.min(merit)), float(np.max(merit))
    if least > 0 and most > 3 * least:
        axes.set_yscale("log")
    elif most - least <= 1e-9 * most:
        axes.set_ylim(0.9 * least, 1.1 * most or 1.0)
    else:
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 4), useOffset=True)


def _draw_left(axes, found) -> None:
    """What the square of the merit is made of now, and was."""
    shares: dict[str, np.ndarray] = {}
    for i, name in _groups(found):
        pair = np.array([float(c[i - 1]) for c in (found.contributions_before, found.contributions)])
        shares[name] = shares.get(name, 0) + pair
    names = sorted(shares, key=lambda name: -shares[name][1])[:_MOST_BARS]
    places = np.arange(len(names))
    axes.barh(places - 0.2, [100 * shares[n][0] for n in names], height=0.36, color=_BEFORE, label="before")
    axes.barh(places + 0.2, [100 * shares[n][1] for n in names], height=0.36, color=_AFTER, label="after")
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set_xlabel("part of the square of the merit, %")
    axes.set_title("What is left", fontweight="bold")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)


def _groups(found) -> list[tuple[int, str]]:
    """Rows with weight and the names of their bars: each its own, or by operand and field, or by operand, if few."""
    counts = [i for i in found.rows if found.merit[i - 1].weight != 0]
    rows = {i: found.merit[i - 1] for i in counts}
    field = {i: "".join(f" {h:.3g}" for h in row.numbers[:2]) if any(row.numbers) else "" for i, row in rows.items()}
    names = (
        {i: f"{row.name} {i}" for i, row in rows.items()},
        {i: row.name + field[i] for i, row in rows.items()},
        {i: row.name for i, row in rows.items()},
    )
    chosen = next((one for one in names if len(set(one.values())) <= _MOST_BARS), names[-1])
    return [*chosen.items()]


# -- result ------------------------------------------------------------------------------------------------------------

_SHOWN = 12  # rows of the merit function in the text, those of largest contribution
_UNSHARP = 0.1  # MTF, of a start from which an MTF merit function is far from its maximum


def _glass_table(steps: Sequence[GlassStep]) -> Table:
    columns = {
        Column("glass", form="<"): [step.words for step in steps],
        Column("predicted"): [step.predicted if step.surface else "" for step in steps],
        Column("merit"): [step.reached for step in steps],
        Column("seconds", form=".1f", heading="s"): [step.seconds for step in steps],
    }
    return Table(columns, [""])


@value
class AsBuiltChange:
    """RMS spot radius in mm, before and after: expected of the lens as built (the root of the mean square), and of the
    refocused lens without errors; tolerances: of which errors."""

    tolerances: str
    expected: tuple[float, float]
    nominal: tuple[float, float]

    @classmethod
    def of(cls, term: Expectation, before: Lens, after: Lens) -> "AsBuiltChange":
        with torch.no_grad():
            figures = [tuple(float(q(lens)) ** 0.5 for lens in (before, after)) for q in (term.expected, term.nominal)]
        return cls(term.words(), *figures)

    def __str__(self) -> str:
        pairs = (self.expected, self.nominal)
        expected, nominal = (" → ".join(f"{1e3 * one:.5g}" for one in pair) + " µm" for pair in pairs)
        return f"RMS spot radius as built ({self.tolerances}): expected {expected}, without errors {nominal}"


@value
class Optimized(Result):
    """The lens at the lowest merit reached, and the initial one, `before`.

    merit: the rows of the merit function (R,); merit_before, merit_after: its values. names: (n,) of the variables;
    variables_before, variables_after: (n,) their values, lengths in mm. values_before, values_after: (R,) of the rows;
    contributions_before, contributions: (R,) of each to the square of the merit, of sum 1. history: (cycles, 5) merit,
    largest violation of a condition, step, damping and seconds of every cycle of the last descent. cycles, evaluations,
    seconds: of the whole optimisation; stopped: a key of `checkpoint.STOPPED`. glasses: the steps in which variable
    glasses were chosen. conditions: targets and values reached of conditions and boundaries. as_built: spots of the
    lens as built, if it is a term of the merit, which then includes it.
    """

    lens: Lens
    before: Lens
    merit: tuple[Row, ...]
    names: tuple[str, ...]
    variables_before: Tensor
    variables_after: Tensor
    values_before: Tensor
    values_after: Tensor
    contributions_before: Tensor
    contributions: Tensor
    history: Tensor
    merit_before: float
    merit_after: float
    cycles: int
    evaluations: int
    seconds: float
    stopped: str
    glasses: tuple[GlassStep, ...] = ()
    conditions: tuple[Reached, ...] = ()
    as_built: AsBuiltChange | None = None

    def draw(self):
        """One page: lens, spots and merit function before and after."""
        return optimize_report(self)

    @property
    def rows(self) -> tuple[int, ...]:
        """Rows that have a value, counted from 1."""
        return tuple(i for i, row in enumerate(self.merit, 1) if row.operand in OPERANDS)

    @property
    def falls_short(self) -> bool:
        return not all(one.met for one in self.conditions)

    @property
    def configurations(self) -> tuple[int, ...]:
        """Of every row, from 1."""
        return tuple(configurations_of(self.merit, self.before.current_configuration))

    @property
    def has_configurations(self) -> bool:
        return bool(self.lens.operands)

    def columns(self) -> dict[str, Tensor]:
        indices = [i - 1 for i in self.rows]
        rows, kinds = [self.merit[k] for k in indices], self.words()["operand"]
        return {
            "row": torch.tensor(self.rows),
            "configuration": torch.tensor([self.configurations[k] for k in indices]),
            "operand": torch.tensor([kinds.index(row.name) for row in rows]),
            "target": torch.tensor([row.target for row in rows], dtype=torch.float64),
            "weight": torch.tensor([row.weight for row in rows], dtype=torch.float64),
            "before": self.values_before[indices],
            "after": self.values_after[indices],
            "contribution_percent": 100 * self.contributions[indices],
        }

    def words(self) -> dict:
        return {"operand": [*dict.fromkeys(self.merit[i - 1].name for i in self.rows)]}

    def document(self) -> dict:
        variables = zip(self.names, self.variables_before.tolist(), self.variables_after.tolist(), strict=True)
        before, after = self.values_before.tolist(), self.values_after.tolist()
        return plain(
            {
                "merit_before": self.merit_before,
                "merit_after": self.merit_after,
                "cycles": self.cycles,
                "evaluations": self.evaluations,
                "seconds": round(self.seconds, 3),
                "stopped": self.stopped,
                "variables": [{"name": name, "before": start, "after": end} for name, start, end in variables],
                "operands": [
                    {
                        "row": i,
                        **({"configuration": self.configurations[i - 1]} if self.has_configurations else {}),
                        "operand": self.merit[i - 1].name,
                        "target": self.merit[i - 1].target,
                        "weight": self.merit[i - 1].weight,
                        "before": number(before[i - 1]),
                        "after": number(after[i - 1]),
                    }
                    for i in self.rows
                ],
                **({"glasses": [step.document() for step in self.glasses]} if self.glasses else {}),
                **({"as_built": dataclasses.asdict(self.as_built)} if self.as_built else {}),
                "conditions": [one.document() for one in self.conditions],
            }
        )

    def tables(self) -> list[Table]:
        """Variables, chosen glasses, configurations and the largest rows of the merit function, then the conditions."""
        ratio = self.merit_before / self.merit_after if self.merit_after > 0 else np.inf
        head = [
            self.lens.name,
            f"  merit {self.merit_before:.8g} → {self.merit_after:.8g}"
            + (f", {ratio:.4g} times less" if 1.1 < ratio < np.inf else ""),
            f"  {self.cycles} cycles, {self.evaluations} evaluations, {self.seconds:.1f} s; {STOPPED[self.stopped]}",
            *([f"  {self.as_built}"] if self.as_built else []),
            *self._unsharp_start(),
            "",
        ]
        variables = {
            Column("variable", form="<"): self.names,
            Column("before", form=".8g"): self.variables_before,
            Column("after", form=".8g"): self.variables_after,
        }
        conditions = self.conditions_in_words()
        rows = self._largest_rows()
        rows = rows._replace(notes=[*rows.notes, *(["", *conditions] if conditions else [])])
        glasses = [_glass_table(self.glasses)] if self.glasses else []
        return [Table(variables, head), *glasses, *([self._lengths()] if self.has_configurations else []), rows]

    def _unsharp_start(self) -> list[str]:
        """A line where most rows of the MTF start near zero: there it has side lobes, and hardly a slope."""
        rows = [k for k, row in enumerate(self.merit) if row.operand in MODULATION and row.weight != 0]
        low = int((self.values_before[rows].abs() < _UNSHARP).sum())
        if 2 * low <= len(rows):
            return []
        hint = f"minimise {option('merit', 'spot')} first, then the MTF from its result"
        return [f"  {low} of {len(rows)} rows of the MTF start below {_UNSHARP:g}, where it hardly has a slope: {hint}"]

    def _lengths(self) -> Table:
        """Focal lengths of every configuration, and its part of the merit that is left."""
        focal = {
            name: [float(first_order(one).effective_focal_length) for one in lens.configurations]
            for name, lens in (("before", self.before), ("after", self.lens))
        }
        numbers, parts = range(1, len(focal["after"]) + 1), self.contributions.tolist()
        left = [100 * sum(p for at, p in zip(self.configurations, parts, strict=False) if at == k) for k in numbers]
        lengths = {Column(f"EFL {name}", "mm", ".8g"): values for name, values in focal.items()}
        return Table({Column("configuration"): numbers, **lengths, Column("left", "%", ".1f"): left}, [""])

    def _largest_rows(self) -> Table:
        """The rows of the largest contributions that are left."""
        left = sorted(self.rows, key=lambda i: -float(self.contributions[i - 1]))
        left = [i for i in left if self.merit[i - 1].weight != 0]
        shown = [self.merit[i - 1] for i in left[:_SHOWN]]
        at = [i - 1 for i in left[:_SHOWN]]
        ends = {
            Column(name, form=".6g"): ["lost" if np.isnan(value) else value for value in values[at].tolist()]
            for name, values in (("before", self.values_before), ("after", self.values_after))
        }
        columns = {
            **({Column("conf."): [self.configurations[k] for k in at]} if self.has_configurations else {}),
            Column("row"): left[:_SHOWN],
            Column("operand", form="<"): [row.name for row in shown],
            Column("target"): [row.target for row in shown],
            Column("weight", form=".4g"): [row.weight for row in shown],
            **ends,
            Column("left", "%", ".1f"): 100 * self.contributions[at],
        }
        rest = sum(float(self.contributions[i - 1]) for i in left[_SHOWN:])
        more = [f"and {len(left) - _SHOWN} more rows, {rest:.1%}"] if len(left) > _SHOWN else []
        return Table(columns, [""], more)

    def conditions_in_words(self) -> list[str]:
        """The table of targets and attained values; of boundaries that are met only the first few."""
        shown = self.shown_conditions()
        if not shown:
            return []
        remarks = [", ".join(filter(None, ["" if one.met else "not met", one.place])) for one in shown]
        lines = text_table(
            {
                Column("condition", form="<"): [one.name for one in shown],
                Column("asked"): [f"{one.relation} {one.asked:.6g}" for one in shown],
                Column("reached"): [one.reached for one in shown],
                Column("remark", form="<", heading=" "): remarks,
            }
        )
        more = len(self.conditions) - len(shown)
        return [*lines, f"and {more} more boundaries, met"] if more else lines

    def shown_conditions(self) -> list[Reached]:
        """Those of tables: all but boundaries that are met, of which there are the first few."""
        chosen = [k for k, one in enumerate(self.conditions) if not one.met or not one.row]
        met = [k for k, one in enumerate(self.conditions) if one.met and one.row]
        return [self.conditions[k] for k in sorted(chosen + met[: max(_SHOWN - len(chosen), 0)])]

    def save(self, path: str | PathLike) -> None:
        """Write the lens, with its variables and its merit function; a file does not hold the constraints of `hold`."""
        write_lens(self.lens, path)


# -- opening -----------------------------------------------------------------------------------------------------------

#: Parts of the pupil and of the field, in the order in which they are opened.
PARTS = (0.02, 0.05, *np.geomspace(0.1, 1.0, 14).tolist())

_FEW = 0.05  # of the rows: with fewer failed rays the descent itself recovers
_CYCLES = 12  # at one opening
_STEEPEST = 9.0  # curvature in units of the typical one: 0.9 over the radius of the beam
_DAMPED = SolverOptions(damping=0.1, bends=False)


class Opened(NamedTuple):
    """Variables (n,) at which fewer rays fail, cycles, and whether a KeyboardInterrupt ended them."""

    x: np.ndarray
    cycles: int = 0
    interrupted: bool = False


def opened(
    problem: Problem,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    until: float = np.inf,
    watch: Callable[[Cycle, np.ndarray], None] | None = None,
) -> Opened:
    """Variables at which fewer rays fail than at x; x itself where nearly none do, or no such variables are found.

    lower, upper, typical: as for `least_squares`. until: of `time.monotonic`, when it ends; watch: invoked after each
    cycle with its report and the best variables so far.
    """
    best = shown = problem.state(x, False)
    count = 0
    if best.lost <= _FEW * (problem.evaluation.weights != 0).sum():
        return Opened(x)
    # the axial beam meets every sphere within these bounds: a narrow part of it would let any curvature grow
    curved = np.array([one.quantity == "curvature" for one in problem.model.variables])
    steepest = np.where(curved, _STEEPEST * typical_of(problem.model), np.inf)
    bounds = {
        "lower": np.maximum(lower, np.minimum(x, -steepest)),
        "upper": np.minimum(upper, np.maximum(x, steepest)),
        "typical": typical,
    }
    stages = [*(problem.through(part) for part in PARTS[:-1]), problem]

    def each(cycle: Cycle, solver: SolverState) -> None:
        nonlocal shown
        whole = problem.state(solver.x, False)
        shown = whole if whole.is_finite and whole.is_better(shown) else shown
        cycle = dataclasses.replace(cycle, number=count + cycle.number, merit=float(np.sqrt(shown.cost)))
        watch(cycle, shown.x)

    for stage, wider in pairwise(stages):
        if time.monotonic() > until:
            break
        try:
            with np.errstate(all="ignore"):
                descent = least_squares(
                    stage.state, x, options=_DAMPED, cycles=_CYCLES, until=until, watch=watch and each, **bounds
                )
        except np.linalg.LinAlgError:  # numbers overflow
            continue
        trial, count = descent.state, count + len(descent.cycles)
        if descent.stopped == "interrupted":
            return Opened((shown if shown.is_better(best) else best).x, count, True)
        if not trial.is_finite or wider.state(trial.x, False).lost > wider.state(x, False).lost:
            continue
        x, whole = trial.x, problem.state(trial.x, False)
        best = whole if whole.is_finite and whole.is_better(best) else best
        if best.lost == 0:
            break
    return Opened(best.x, count)


# -- optimising --------------------------------------------------------------------------------------------------------

#: Suffixes of the files that an optimisation writes beside its lens.
LOGS, CHECKPOINTS = (".csv", ".txt", ".log"), (".json",)


def optimize(
    lens: Lens,
    *,
    merit: str | Merit | DefaultMerit | Sequence[Row] | Callable[[Lens], torch.Tensor] | None = None,
    vary: str | Sequence[str | Vary] | None = None,
    bounds: str | Sequence[str] | None = None,
    hold: str | Sequence[str | Condition] | None = None,
    as_built: ExpectationSettings | None = None,
    cycles: int | None = None,
    seconds: float | None = None,
    paths: int = 1,
    catalog: Sequence[str | PathLike] = (),
    log: str | PathLike | None = None,
    checkpoint: str | PathLike | None = None,
    resume: str | PathLike | None = None,
    progress: Callable | None = None,
    watch: Callable[[Cycle, Lens], object] | None = None,
) -> Optimized:
    """The lens at a minimum of its merit function, by damped least squares with the exact derivatives of every row.

    merit: `Merit`, the settings `DefaultMerit` of a default merit function or its kind ("spot", "wavefront", "angular",
    "mtf"), rows, by default the file's; or any function of a lens that returns one number () to minimise, by L-BFGS.
    vary: variables, or their syntax, as "curvature thickness:5,6", by default the file's; bounds: of variables, as
    "thickness:2,15"; hold: constraints met exactly, as "efl=50 total_track<=80" (`optimization.problem`). as_built:
    `AsBuilt`, the expected mean square spot of the manufactured lens as a term of the merit. cycles,
    seconds: limits, by default 500 cycles a path; paths: damping strategies to try. catalog: shipped catalogs or
    AGF files for variable glasses, by default those of the lens, else SCHOTT (`optimization.glass_choice`). log: a file
    with a line for every cycle; checkpoint: a file (.json) of the state of the descent; resume: such a file of the same
    lens, variables and merit function, from which the descent resumes bit-identically (with real ray aiming, whose
    rays start from those of the last cycle, to 1e-10 of the merit), cycles counted from its start. watch: invoked
    after each cycle, except those of the choice of glasses, with its report and lens, while the system is opened the
    best one. Ctrl-C, or a KeyboardInterrupt that `watch` raises, ends with the best lens.
    Conditions that certainly exclude one another are refused. Conditions and boundaries that are not met at the end
    are in `Optimized.conditions` with the reason, with a warning (NotReached), as for surfaces and gaps that cannot
    be made (Unbuildable).
    Raises NoProblem, BadMerit, BadVariables, BadHold, BadRow, UnknownOperand, BadCheckpoint, BadTolerance.
    """
    prepare()
    started = time.monotonic()
    until = np.inf if seconds is None else started + seconds
    for path, suffixes in ((log, LOGS), (checkpoint, CHECKPOINTS)):
        if path is not None:
            check_output(path, suffixes)
    for name, path in (("checkpoint", checkpoint), ("resume", resume)):
        if None not in (log, path) and os.path.realpath(log) == os.path.realpath(path):
            raise ValueError(f"{log}: {option('log')} and {option(name)} are one file; give them two")
    warn_of_filling(lens, field_points(None, like=lens))
    model, glasses = without_glass(design_variables(lens, vary), vary)
    names = tuple(name_of(one) for one in model.variables)
    lower, upper = bounds_of(model.lens, model.variables, bounds)
    for name, least, most in zip(names, lower, upper, strict=True):
        if not least <= most:
            raise NoProblem(f"{option('bounds')} of {name}: from {least:g} to {most:g} there is nothing")
    settings = {"lower": lower, "upper": upper, "typical": typical_of(model), "cycles": cycles}
    of = {**identity(lens), "variables": list(names), "solves": digest(repr(model.solves)), "paths": paths}
    of |= {"glasses that vary": list(glasses), "bounds": plain([lower.tolist(), upper.tolist()])}

    def stored() -> Stored:
        return Stored(model.start, {}) if resume is None else read_checkpoint(resume, of, names)

    if callable(merit):
        if glasses:
            raise NoProblem(f"{option('vary', 'glass')} goes with a merit of rows: make the function a row")
        if hold:
            raise NoProblem(
                f"{option('hold')} goes with a merit of rows: of a function give {option('bounds')}, or make it a row"
            )
        if as_built is not None:
            raise NoProblem(
                f"{option('as_built')} goes with a merit of rows: add `as_built.of(lens).expected` to the function"
            )
        of["merit"] = getattr(merit, "__qualname__", type(merit).__name__)
        function = FunctionMerit(model, merit, stored().evaluated)
        start = np.clip(model.start, lower, upper)
        if not names:
            raise NoProblem(f"nothing varies: name variables by {option('vary')}, as 'curvature thickness'")
        bar, seen = progress and progress(cycles, "cycle"), watch and (lambda one, x: watch(one, _lens_at(model, x)))
        with _Observer(log, Checkpoint(checkpoint, of, names), bar, None, seen) as observer:
            before = function(model.start)[0]
            if not np.isfinite(before):
                raise NoProblem(f"the merit is {before:g} at the start: nothing to follow")
            left = None if np.isinf(until) else until - time.monotonic()
            each = lambda cycle, x: observer.after_cycle(cycle, x, evaluated=function.evaluated)  # noqa: E731
            x, stopped, history = minimise(function, start, watch=each, seconds=left, **settings)
            after = function(x)[0]
            observer.checkpoint.write(x, after, len(history), evaluated=function.evaluated, now=True)
        descent = BestDescent(x, tuple(history), stopped, len(history), function.evaluations)
        result = _lens_at(model, x)
        return _warned(_optimized(lens, result, model, names, x, descent, started, merits=(before, after)))
    function = merit_for(lens, merit)
    conditions = conditions_in_unit(lens, hold, function.unit)
    of_rows = {"unit": function.unit, "skip_unknown": function.skip_unknown, "conventions": function.conventions}
    term = None if as_built is None else as_built.of(model.lens)
    problem = Problem(model, function.rows, conditions, as_built=term, **of_rows)
    of |= {"merit": digest([repr(row) for row in function.rows], of_rows), "hold": digest(repr(conditions))}
    of |= {} if term is None else {"as built": digest(term.about())}
    resumed = stored()
    if set(resumed.glasses) - set(glasses):
        raise BadCheckpoint(f"{resume}: glasses: found surfaces {[*resumed.glasses]}, expected some of {[*glasses]}")
    start, choice, opening = np.clip(resumed.x, lower, upper), None, Opened(resumed.x)
    ends = {name: (float(least), float(most)) for name, least, most in zip(names, lower, upper, strict=True)}
    bounded = {name: pair for name, pair in ends.items() if not np.isinf(pair).all()}

    def lens_at(x: np.ndarray) -> Lens:
        return _lens_at(problem.model, x, rows=problem.rows, unit=problem.unit, bounded=bounded)

    seen = watch and (lambda cycle, x: watch(cycle, lens_at(x)))
    refuse_contradictions(problem, start, lower=lower, upper=upper)
    evaluating = time.monotonic()
    before = problem.evaluated(model.start)
    seconds_of_end = time.monotonic() - evaluating
    if not resumed.glasses and resumed.descent is None:
        opening = opened(problem, start, lower=lower, upper=upper, typical=settings["typical"], until=until, watch=seen)
        start = opening.x
        settings |= {"cycles": 0} if opening.interrupted else {}
        evaluating = time.monotonic()
        _refuse_undefined(problem, problem.evaluated(start, True))
        seconds_of_end = min(seconds_of_end, time.monotonic() - evaluating)  # the first evaluation takes longer
    until -= seconds_of_end  # the result is evaluated once more
    bar = progress and progress(cycles, "cycle")
    with _Observer(log, Checkpoint(checkpoint, of, names), bar, resumed.descent, seen) as observer:
        if glasses and not opening.interrupted:
            pool, limits = pool_of(lens, catalogs_of(lens, catalog)), (lower, upper)
            of_choice = {"cycles": cycles, "until": until, "keep": observer.checkpoint.write_glasses, **of_rows}
            of_choice |= {"as_built": term}
            choice = Choice(model, glasses, pool, function.rows, conditions, limits, **of_choice)
            start, problem = choice.run(start, resumed).x, choice.problem(choice.best.glasses, ())
        settings["seconds"] = None if seconds is None else until - time.monotonic()
        descent = best_of_paths(
            problem.state, start, paths=paths, watch=observer.after_cycle_of_paths, resume=resumed.descent, **settings
        )
        observer.checkpoint.write(
            descent.state.x,
            float(np.sqrt(descent.state.cost)),
            len(descent.history),
            descent=observer.descent,
            now=True,
        )
    x, count = descent.state.x, len(problem.rows)
    descent = dataclasses.replace(
        descent,
        stopped="interrupted" if opening.interrupted else descent.stopped,
        cycles=descent.cycles + opening.cycles + (choice.descended if choice else 0),
        evaluations=descent.evaluations + (choice.evaluations if choice else 0),
    )
    after = problem.evaluated(x)
    end = lens_at(x)
    result = _optimized(
        lens, end, problem.model, names, x, descent, started, rows=problem.rows,
        merits=(problem.merit(before, model.start), problem.merit(after, x)),
        values=(before.values[:count], after.values[:count]),
        contributions=tuple(end.contributions(np.arange(count)) for end in (before, after)),
        glasses=tuple(choice.steps) if choice else (), conditions=reached(problem, x, lower=lower, upper=upper),
        as_built=None if term is None else AsBuiltChange.of(term, lens, end),
    )  # fmt: skip
    return _warned(result)


class _Observer:
    """Log, checkpoint, progress bar, `watch` of an optimisation; descent: the state that is resumed, then the last."""

    def __init__(self, log, checkpoint: Checkpoint, bar, descent: PathState | None, watch):
        cycles = () if descent is None else descent.history
        self.log, self.checkpoint, self.bar, self.descent = Log(log, cycles), checkpoint, bar, descent
        self.watch = watch
        if bar is not None and cycles:
            bar.update(len(cycles))

    def after_cycle_of_paths(self, cycle: Cycle, descent: PathState) -> None:
        self.descent = descent
        self.after_cycle(cycle, descent.solver.x, descent=descent)

    def after_cycle(self, cycle: Cycle, x: np.ndarray, **state) -> None:
        """state: of `Checkpoint.write`."""
        self.checkpoint.write(x, cycle.merit, cycle.number, **state)
        self.log.add(cycle)
        if self.bar is not None:
            words = [f"merit {cycle.merit:.6g}", f"step {cycle.step:.1e}"]
            words += [f"held to {cycle.missed:.1e}"] if cycle.missed > 1e-9 else []
            self.bar.update(1)
            self.bar.set_postfix_str(", ".join([*words, *filter(None, [cycle.limits])]))
        if self.watch is not None:
            self.watch(cycle, x)

    def __enter__(self) -> "_Observer":
        return self

    def __exit__(self, *error) -> None:
        if self.bar is not None:
            self.bar.close()


def _refuse_undefined(problem: Problem, start: Evaluated) -> None:
    """Raise NoProblem where the merit, or a derivative of it, is not finite at the start, or all its rays fail."""
    bad = ~np.isfinite(start.residuals)
    if bad.any():
        k = int(start.of_row[np.argmax(bad)])
        row, number = problem.evaluation.rows[k], start.values[k]
        raise NoProblem(f"row {k + 1} of the merit function, {row.name}, is {number:g} at the start")
    if not np.isfinite(start.jacobian).all():
        k, variable = np.argwhere(~np.isfinite(start.jacobian))[0]
        row, name = int(start.of_row[k]), name_of(problem.model.variables[variable])
        raise NoProblem(
            f"row {row + 1} of the merit function, {problem.evaluation.rows[row].name}, has no derivative by {name} at "
            f"the start: {start.jacobian[k, variable]:g}"
        )
    if start.lost[np.unique(start.of_row)].all():
        raise NoProblem("no row of the merit function has a value: no ray of them gets through the lens as it is")


def _lens_at(
    model: DesignVariables,
    x: np.ndarray,
    *,
    rows: Sequence[Row] = (),
    unit: float = 1.0,
    bounded: dict[str, tuple] | None = None,
) -> Lens:
    """The lens with its optimisation data; bounded: the bounds of this optimisation, by variable."""
    lens = model.lens_at(x)
    data = lens.optimization_data or optimization_data_of(model, rows, unit)
    bounds = bounded or {}
    variables = tuple(
        dataclasses.replace(one, bounds=bounds.get(name_of(one), one.bounds))
        for one in data.variables
        if (one.surface, one.quantity) not in OF_LENS  # which no file holds
    )
    return dataclasses.replace(lens, optimization_data=dataclasses.replace(data, variables=variables))


def _optimized(
    lens: Lens,
    after: Lens,
    model: DesignVariables,
    names: tuple[str, ...],
    x: np.ndarray,
    descent: BestDescent,
    started: float,
    *,
    merits: tuple[float, float],
    rows: tuple[Row, ...] = (),
    values: tuple = ((), ()),
    contributions: tuple = ((), ()),
    **more,
) -> Optimized:
    def tensor(numbers) -> torch.Tensor:
        return torch.tensor(np.asarray(numbers, dtype=float), dtype=torch.float64)

    history = [[c.merit, c.missed, c.step, c.damping, c.seconds] for c in descent.history]
    return Optimized(
        lens=after,
        before=lens,
        merit=rows,
        names=names,
        variables_before=tensor(model.start),
        variables_after=tensor(x),
        values_before=tensor(values[0]),
        values_after=tensor(values[1]),
        contributions_before=tensor(contributions[0]),
        contributions=tensor(contributions[1]),
        history=tensor(history).reshape(-1, 5),
        merit_before=merits[0],
        merit_after=merits[1],
        cycles=descent.cycles,
        evaluations=descent.evaluations,
        seconds=time.monotonic() - started,
        stopped=descent.stopped,
        **more,
    )


def _warned(result: Optimized) -> Optimized:
    """The result, with a warning for every condition that is not met, and for what of the lens cannot be made."""
    for one in result.conditions:
        if not one.met:
            warnings.warn(str(one), NotReached, stacklevel=calling_level())
    for lens in result.lens.configurations:
        warn_of_defects(lens)
    return result
