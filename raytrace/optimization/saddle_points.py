"""Insertion: from a minimum over saddles to minima of lenses with one element more, two from every surface.

A meniscus without thickness makes a saddle of the minimum. On either side of it all but the new thicknesses vary; then
these grow in parts of their minimum values while the lens follows; at last everything varies.

Before surface k between air and a glass two more surfaces of its shape are inserted, so that a lens of the same glass,
without thickness, touches it. The merit is unchanged along two lines of the curvatures (c₁, c₂, c₃) of the three,

    c₁ = c₂, c₃ = c_k      and      c₁ = c_k, c₂ = c₃

and where the lens is a minimum, its slope along (1, 1, 1) vanishes as well: all three vanish, and along the two lines
the merit is flat while it is not between them. So the lens is a saddle with one descent direction, to two sides.

Source: Bociort & van Turnhout, Generating saddle points in the merit function landscape of optical systems, Proc. SPIE
5962, 2005; van Turnhout & Bociort, Instabilities and fractal basins of attraction in optical system optimization,
Opt. Express 17, 2009.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import null_space

from raytrace.edit.surfaces import as_inserted, with_meniscus
from raytrace.materials.glass import is_air
from raytrace.optimization.least_squares import SolverOptions, SumOfSquares
from raytrace.optimization.one_element import Move, conditions_renumbered, thinned
from raytrace.optimization.problem import NoProblem, Problem
from raytrace.optimization.search_tasks import (
    FOLLOW,
    LONG,
    SearchProblem,
    Stage,
    TaskResult,
    descended,
)
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Vary
from raytrace.system.parameter_paths import sensor
from raytrace.system.surface import is_posed
from raytrace.words import option

_NEAR = 0.01  # relative change of the residuals by a step along a variable, for second derivatives
_ACTIVE = 1e-9  # up to which a limit counts as reached


# -- surfaces for a meniscus -------------------------------------------------------------------------------------------


def surfaces_of(free: DesignVariables, surfaces: Sequence[int] = ()) -> tuple[int, ...]:
    """All surfaces before which a meniscus can be inserted, or the given ones, checked. Raises NoProblem."""
    lens = free.lens
    if lens.operands:
        raise NoProblem(f"{option('insert')}: the lens has several configurations; take one of them")
    if not surfaces:
        surfaces = tuple(k for k in range(1, sensor(lens) + 1) if not _objection(free, k))
        if not surfaces:
            raise NoProblem(f"{option('insert')}: no spherical surface between glass and air whose curvature varies")
        return surfaces
    for k in surfaces:
        if objection := _objection(free, k):
            raise NoProblem(f"{option('insert')}: surface {k} {objection}")
    return tuple(dict.fromkeys(surfaces))


def _objection(free: DesignVariables, k: int) -> str:
    """The reason why no meniscus can be inserted before a surface, "" where it can."""
    lens = free.lens
    if not 1 <= k <= sensor(lens):
        return f"is none before the image: this lens has surfaces 1 to {sensor(lens)}"
    surface, before = lens.surfaces[k], lens.surfaces[k - 1]
    shaped = (surface.conic, surface.coefficients, surface.sag_terms, surface.phase)
    if surface.is_mirror or before.is_mirror or any(part is not None for part in shaped) or is_posed(surface):
        return "is not a centred refracting sphere"
    if before.is_break or is_air(before.glass) == is_air(surface.glass):
        return "is not between glass and air"
    varies = any(variable.address == (k, "curvature") for variable in free.variables)
    return "" if varies else f"has a curvature that does not vary: name it by {option('vary')}"


# -- the lens with one element more ------------------------------------------------------------------------------------


def enlarged(lens: Lens, task: SearchProblem, k: int) -> SearchProblem:
    """The search problem of the lens with a meniscus in front of surface k."""
    made, free, numbering = with_meniscus(lens, k), task.model, as_inserted(lens, k, 2)
    new = [Vary(s, quantity) for quantity in ("curvature", "thickness") for s in (k, k + 1)]
    old = numbering.variables(free.variables)
    bounds = {variable: (least, most) for variable, least, most in zip(old, *task.bounds, strict=True)}
    steep = bounds[next(variable for variable in old if variable.address == (k + 2, "curvature"))]
    bounds |= {variable: steep if variable.quantity == "curvature" else (-np.inf, np.inf) for variable in new}
    quantities = list(dict.fromkeys(variable.quantity for variable in (*new, *old)))
    variables = tuple(sorted(bounds, key=lambda variable: (quantities.index(variable.quantity), variable.surface)))
    solves = numbering.solves(free.solves)
    if (data := made.optimization_data) is not None:
        made = replace(made, optimization_data=replace(data, variables=variables, solves=solves))
    return replace(
        task,
        model=DesignVariables(made, variables, solves),
        rows=numbering.rows(task.rows),
        conditions=conditions_renumbered(task.conditions, numbering),
        bounds=(
            np.array([bounds[variable][0] for variable in variables], dtype=float),
            np.array([bounds[variable][1] for variable in variables], dtype=float),
        ),
    )


# -- the saddle --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Saddle:
    """Second order of the merit under its conditions.

    ways (n, m): a basis of the steps that keep the conditions, each of which changes the residuals by the same amount;
    slope (m,) and curves (m, m) of half the square of the merit along them.
    """

    ways: np.ndarray
    slope: np.ndarray
    curves: np.ndarray

    @property
    def descent(self) -> np.ndarray:
        """The direction (n,) along which the merit falls most, to both sides."""
        return self.ways @ np.linalg.eigh(self.curves)[1][:, 0]


def saddle(problem: Problem, x: np.ndarray, moves: np.ndarray) -> Saddle:
    """Second order of the merit at x (n,), by the variables `moves` (n,)."""
    state = problem.state(x, True)
    columns = np.sqrt((state.jacobian**2).sum(0))
    scale = np.where(columns > 0, columns, 1.0)
    step = _NEAR * np.sqrt(max(state.cost, 1e-30)) / scale
    slopes = _conditions(state)
    price = np.linalg.lstsq((slopes / scale)[:, moves].T, -(_slope(state) / scale)[moves], rcond=None)[0]
    gradient = lambda s: _slope(s) + price @ _conditions(s, like=state)  # noqa: E731
    free = np.nonzero(moves)[0]
    second = np.zeros((len(free), len(free)))
    for row, j in enumerate(free):
        ahead, back = (problem.state(x + sign * step * (np.arange(len(x)) == j), True) for sign in (1, -1))
        second[row] = ((gradient(ahead) - gradient(back)) / (2 * step[j] * scale[j]) / scale)[free]
    along = null_space((slopes / scale)[:, free]) if len(slopes) else np.eye(len(free))
    ways = np.zeros((len(x), along.shape[1]))
    ways[free] = along / scale[free, None]
    return Saddle(ways, ways.T @ gradient(state), 0.5 * along.T @ (second + second.T) @ along)


def _slope(state: SumOfSquares) -> np.ndarray:
    """Half the gradient (n,) of the sum of squares."""
    sides = state.sides
    over = sides.excess > 0
    sums = np.bincount(sides.row, np.maximum(sides.excess, 0.0)) if len(sides.row) else np.zeros(0)
    return state.jacobian.T @ state.residuals + sums[sides.row[over]] @ sides.slope[over]


def _conditions(state: SumOfSquares, like: SumOfSquares | None = None) -> np.ndarray:
    """Slopes (h, n) of the equalities and of the limits that are active at the state `like`."""
    reached = (like or state).limits > -_ACTIVE
    return np.concatenate([state.held_slope, state.limits_slope[reached]])


SIDES = {"one side": 1.0, "other side": -1.0}
_PARTS = 0.25, 0.5, 0.75, 1.0  # of the least thicknesses, one after the other
_OFF = np.geomspace(0.03, 10, 18)  # of the residuals: steps off the saddle that are tried
_CYCLES = 15, 10  # off the saddle, and with every part of the thickness
_CAREFUL = SolverOptions(damping=0.1, bends=False)
_MEETINGS = 4  # of conditions, after a step off the saddle


@dataclass(frozen=True)
class Place:
    """A lens with a meniscus before surface k: its problems by how much of its least thickness it has."""

    k: int
    task: SearchProblem

    def stage(self, part: float, cycles: int, options: SolverOptions) -> Stage:
        """The descent with a part of the least thicknesses; with a part of 0 the new gaps stay at 0."""
        space, new = self.task.space, (self.k, self.k + 1)  # the meniscus and the adjacent air
        gaps = np.array(
            [variable.quantity == "thickness" and variable.surface in new for variable in self.task.model.variables]
        )
        lower = np.where(gaps, part * space.lower, space.lower)
        upper = np.where(gaps & (part == 0), 0.0, space.upper)
        problem = self.task.problem(thinned(self.task.rows, (self.k, self.k + 1), part))
        return Stage(problem, cycles, options, lower, upper)

    def gone(self, sign: float, until: float = np.inf) -> TaskResult:
        """The minimum on one side of the saddle, of a lens of real thickness. Raises SearchStopped."""
        first = self.stage(0.0, _CYCLES[0], _CAREFUL)
        thicker = [self.stage(part, _CYCLES[1], _CAREFUL) for part in _PARTS]
        x = self.displaced(first, sign)
        return descended(x, [first, *thicker, self.stage(1.0, LONG, FOLLOW)], until)

    def displaced(self, stage: Stage, sign: float) -> np.ndarray:
        """Variables (n,) off the saddle to one side, as far as the merit falls, with the conditions met again."""
        x, problem = self.task.model.start, stage.problem
        way = saddle(problem, x, stage.moves(x)).descent
        way = sign * way / np.abs(way[np.argmax(np.abs(way))]) * np.sign(way[np.argmax(np.abs(way))])
        columns = np.sqrt((problem.state(x, True).jacobian ** 2).sum(0))
        unit = np.sqrt(problem.state(x, False).cost) / np.linalg.norm(columns * way)
        best, least = x + _OFF[0] * unit * way, np.inf
        for size in _OFF:
            trial = self._met(stage, x + size * unit * way)
            state = problem.state(trial, False)
            if not state.is_finite or state.lost or state.cost >= least:
                break
            best, least = trial, state.cost
        return best

    def _met(self, stage: Stage, x: np.ndarray) -> np.ndarray:
        """x with the equalities met, by the shortest steps."""
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


def insertions(task: SearchProblem, places: Sequence[int]) -> Callable[[Lens], Iterator[Move]]:
    """The moves from a minimum of a search problem: a meniscus at each surface, and the descents on both sides."""

    def moves(lens: Lens) -> Iterator[Move]:
        for k in places:
            place = Place(k, enlarged(lens, task, k))
            descents = [(f"surface {k}, {side}", partial(place.gone, sign)) for side, sign in SIDES.items()]
            yield Move(place.task, descents)

    return moves
