"""Moves of a search: to lenses of other surfaces, along lenses that meet the same paraxial conditions.

A move begins at a lens at its minimum, and changes no ray at first: surfaces are added, or taken out, where a gap has
no thickness (`saddle_points`, `removal`). The gap grows, or shrinks before, in parts; each part is projected and
descends a little. `lens_moves` takes the moves of all lenses of a search.

Paraxial projection: all free curvatures are scaled to the power that the lens had, and the sensor is moved to the same
distance from the paraxial focus; then the shortest steps meet the equalities of the conditions.

Paraxial projections after discrete changes of a lens: Teh, Vicini, Bickel, Gkioulekas & O'Toole, Automated design of
compound lenses with discrete-continuous optimization, SIGGRAPH Asia 2025.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from raytrace.edit.numbering import Numbering
from raytrace.optimization.conditions import Condition
from raytrace.optimization.operands.boundaries import BOUNDARIES
from raytrace.optimization.search_tasks import SearchProblem, Space, Stage, TaskResult
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row, Solve, Vary
from raytrace.system.surface import Surface, is_posed

_MEETINGS = 4  # of conditions, by shortest steps


@dataclass(frozen=True)
class Move:
    """A step to a lens of other surfaces: its name, its search problem, and the descent to variables near its minimum,
    a function of the time when it ends, as of `descended`."""

    name: str
    task: SearchProblem
    taken: Callable[[float], TaskResult]


def no_sphere(surface: Surface) -> bool:
    """Whether a surface is other than a centred refracting sphere."""
    shaped = (surface.conic, surface.coefficients, surface.sag_terms, surface.phase)
    return surface.is_mirror or any(part is not None for part in shaped) or is_posed(surface)


# -- the paraxial projection -------------------------------------------------------------------------------------------


def projected(space: Space, before: np.ndarray) -> Callable[[Stage, np.ndarray], np.ndarray]:
    """The paraxial projection on the power and the defocus of the lens at `before` (n,), for `descended`."""
    wanted = space.paraxial(before)

    def project(stage: Stage, x: np.ndarray) -> np.ndarray:
        return met(stage, space.restored(x, wanted, stage.lower, stage.upper))

    return project


def met(stage: Stage, x: np.ndarray) -> np.ndarray:
    """x with the equalities of the conditions met, by the shortest steps."""
    x = np.clip(x, stage.lower, stage.upper)
    moves = stage.moves(x)
    for _ in range(_MEETINGS):
        state = stage.problem.state(x, True)
        if not len(state.held) or not state.is_finite:
            return x
        columns = np.sqrt((state.jacobian**2).sum(0))
        scale = np.where(columns > 0, columns, 1.0)
        back = np.linalg.lstsq((state.held_slope / scale)[:, moves], state.held, rcond=None)[0]
        x = x.copy()
        x[moves] -= back / scale[moves]
        x = np.clip(x, stage.lower, stage.upper)
    return x


# -- the search problem of other lenses --------------------------------------------------------------------


def started_at(task: SearchProblem, x: np.ndarray) -> SearchProblem:
    """The search problem from the lens at variables (n,)."""
    model = task.model
    return replace(task, model=DesignVariables(model.lens_at(x), model.variables, model.solves))


def changed(
    task: SearchProblem,
    lens: Lens,
    numbering: Numbering,
    new: dict[Vary, tuple[float, float]],
    rows: Sequence[Row] | None = None,
) -> SearchProblem:
    """The search problem of a lens of other surfaces, whose variables, rows and conditions have their new numbers.

    new: further variables and their bounds; rows: instead of those of the task by their new numbers.
    """
    old = ((numbering.variable(variable), *ends) for variable, *ends in zip(task.model.variables, *task.bounds,
                                                                           strict=True))  # fmt: skip
    bounds = {variable: (least, most) for variable, least, most in old if variable is not None} | new
    quantities = list(dict.fromkeys(variable.quantity for variable in (*new, *bounds)))
    variables = tuple(bounds)
    if new:
        variables = tuple(sorted(bounds, key=lambda variable: (quantities.index(variable.quantity), variable.surface)))
    solves: tuple[Solve, ...] = numbering.solves(task.model.solves)
    if (data := lens.optimization_data) is not None:
        lens = replace(lens, optimization_data=replace(data, variables=variables, solves=solves))
    lower, upper = (np.array([bounds[variable][end] for variable in variables], dtype=float) for end in (0, 1))
    return replace(
        task,
        model=DesignVariables(lens, variables, solves),
        rows=numbering.rows(task.rows) if rows is None else tuple(rows),
        conditions=conditions_renumbered(task.conditions, numbering),
        bounds=(lower, upper),
    )


def conditions_renumbered(conditions: Sequence[Condition], numbering: Numbering) -> tuple[Condition, ...]:
    """Conditions whose rows name the same surfaces by their new numbers."""
    moved = ((condition, numbering.rows((*condition.before, condition.row))) for condition in conditions)
    return tuple(
        replace(condition, row=rows[-1], before=rows[:-1])
        for condition, rows in moved
        if len(rows) == len(condition.before) + 1
    )


def with_gaps(rows: Sequence[Row], numbering: Numbering, k: int, count: int) -> tuple[Row, ...]:
    """The rows by their new numbers after so many surfaces before surface k: a range of boundaries that reaches to a
    gap next to surface k contains the new gaps."""
    widened = []
    for row, moved in zip(rows, numbering.rows(rows), strict=True):
        first, last = row.integers
        if is_boundary(row) and first < last and first <= k and last >= k - 1:
            moved = replace(moved, integers=(min(moved.integers[0], k), max(moved.integers[1], k + count - 1)))
        widened.append(moved)
    return tuple(widened)


def is_boundary(row: Row, kinds: tuple[str, ...] = ("MN", "MX")) -> bool:
    """Whether a row limits the thickness of gaps from one to another: the least, the largest, or either."""
    name = row.operand
    return isinstance(name, str) and name in BOUNDARIES and name.startswith(kinds) and name[-1] in "TGA"


def thinned(rows: Sequence[Row], gaps: tuple[int, int], part: float) -> tuple[Row, ...]:
    """The rows with a part of the least thicknesses of gaps, from the first to the last, without them if `part` is 0.

    Rows that are split off come last.
    """
    pieces = [_split(row, *gaps, part) if part < 1 else [row] for row in rows]
    return (*(piece[0] for piece in pieces), *(row for piece in pieces for row in piece[1:]))


def _split(row: Row, least: int, most: int, part: float) -> list[Row]:
    """A row of least thicknesses as several: of the other gaps, and with part of its target of those to be thin."""
    first, last = row.integers
    if not is_boundary(row, ("MN",)) or last < least or first > most:
        return [row]
    ranges = [(first, least - 1), (max(first, most + 1), last)]
    rows = [replace(row, integers=ends) for ends in ranges if ends[0] <= ends[1]]
    if part > 0:
        rows.append(replace(row, integers=(least, most), target=part * row.target))
    return rows or [replace(row, weight=0.0)]
