"""Insertion and splitting: from a minimum to minima of lenses with one element more.

New surfaces are added where they change no ray: a meniscus without thickness at a surface, or an element cut into two
without air between them. At first all but the new gaps without thickness vary; then these grow in parts of their least
thicknesses, each part projected (`moves`), while the lens follows.

Insertion. Before surface k between air and a glass two more surfaces of its shape are inserted, so that a lens of the
same glass, without thickness, touches it. The merit is unchanged along two lines of the curvatures (c₁, c₂, c₃) of the
three,

    c₁ = c₂, c₃ = c_k      and      c₁ = c_k, c₂ = c₃

and where the lens is a minimum, its slope along (1, 1, 1) vanishes as well: all three vanish, and along the two lines
the merit is flat while it is not between them. So the lens is a saddle with one descent direction, to two sides.

Splitting. An element of curvatures c₁ and c₂ is cut by two faces of curvature (c₁ + c₂)/2, so that both parts have half
of its power as thin lenses.

Source: Bociort & van Turnhout, Generating saddle points in the merit function landscape of optical systems, Proc. SPIE
5962, 2005; van Turnhout & Bociort, Instabilities and fractal basins of attraction in optical system optimization,
Opt. Express 17, 2009.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import null_space

from raytrace.edit.surfaces import as_inserted, split, with_meniscus
from raytrace.materials.glass import is_air
from raytrace.optimization.least_squares import SolverOptions, SumOfSquares
from raytrace.optimization.moves import Move, changed, met, no_sphere, projected, thinned, with_gaps
from raytrace.optimization.problem import Problem
from raytrace.optimization.search_tasks import SearchProblem, Stage, TaskResult, descended
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Vary
from raytrace.system.parameter_paths import sensor
from raytrace.words import option

_NEAR = 0.01  # relative change of the residuals by a step along a variable, for second derivatives
_ACTIVE = 1e-9  # up to which a limit counts as reached


# -- where an element is added -----------------------------------------------------------------------------------------


def no_insertion(task: SearchProblem, lens: Lens, k: int) -> str:
    """The reason why no meniscus can be inserted before a surface, "" where it can."""
    if not 1 <= k <= sensor(lens):
        return f"is none before the image: this lens has surfaces 1 to {sensor(lens)}"
    surface, before = lens.surfaces[k], lens.surfaces[k - 1]
    if no_sphere(surface) or before.is_mirror:
        return "is not a centred refracting sphere"
    if before.is_break or is_air(before.glass) == is_air(surface.glass):
        return "is not between glass and air"
    varies = any(variable.address == (k, "curvature") for variable in task.model.variables)
    return "" if varies else f"has a curvature that does not vary: name it by {option('vary')}"


def no_split(task: SearchProblem, lens: Lens, k: int) -> str:
    """The reason why the element whose first surface is k cannot be split, "" where it can."""
    if not 1 <= k < sensor(lens):
        return f"begins no element: this lens has surfaces 1 to {sensor(lens)}"
    if is_air(lens.surfaces[k].glass) or lens.surfaces[k - 1].is_break or not float(lens.surfaces[k].thickness) > 0:
        return "begins no element"
    if any(no_sphere(face) for face in lens.surfaces[k : k + 2]):
        return "begins an element with other than centred refracting spheres"
    if not {(face, "curvature") for face in (k, k + 1)} & {variable.address for variable in task.model.variables}:
        return f"begins an element of curvatures that do not vary: name them by {option('vary')}"
    solved = {(solve.surface, solve.quantity) for solve in task.model.solves}
    solved |= {solve.address_of_source for solve in task.model.solves if solve.kind == "pickup"}
    return "begins an element whose thickness a solve or a pickup uses" if (k, "thickness") in solved else ""


# -- the lens with one element more ------------------------------------------------------------------------------------


def enlarged(lens: Lens, task: SearchProblem, k: int) -> SearchProblem:
    """The search problem of the lens with a meniscus in front of surface k."""
    return _with_surfaces(with_meniscus(lens, k), lens, task, k)


def divided(lens: Lens, task: SearchProblem, k: int) -> SearchProblem:
    """The search problem of the lens with the element of surfaces k and k + 1 in two, without air between them."""
    faces = [surface.curvature for surface in lens.surfaces[k : k + 2]]
    mean = 0.5 * sum(0.0 if curvature is None else float(curvature) for curvature in faces)
    return _with_surfaces(split(lens, (k, k + 1), curvature=mean), lens, task, k + 1)


def _with_surfaces(made: Lens, lens: Lens, task: SearchProblem, k: int) -> SearchProblem:
    """The search problem of a lens with two more surfaces before surface k, which vary with the gaps behind them."""
    numbering = as_inserted(lens, k, 2)
    ends = dict(zip((variable.address for variable in task.model.variables), zip(*task.bounds, strict=True),
                    strict=True))  # fmt: skip
    free = (-np.inf, np.inf)
    steep = ends.get((k, "curvature"), ends.get((k - 1, "curvature"), free))
    new = {Vary(s, "curvature"): steep for s in (k, k + 1)} | {Vary(s, "thickness"): free for s in (k, k + 1)}
    return changed(task, made, numbering, new, with_gaps(task.rows, numbering, k, 2))


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


# -- the moves ---------------------------------------------------------------------------------------------------------

_SIDES = {"one side": 1.0, "other side": -1.0}
_PARTS = 0.25, 0.5, 0.75, 1.0  # of the least thicknesses, one after the other
_OFF = np.geomspace(0.03, 10, 18)  # of the residuals: steps off the saddle that are tried
_CYCLES = 15, 10  # without thickness, and with every part of it
_CAREFUL = SolverOptions(damping=0.1, bends=False)


@dataclass(frozen=True)
class Enlargement:
    """A lens with new gaps, from the first to the last: its problems by the part of the least thicknesses that they
    have; empty: those that have no thickness yet."""

    gaps: tuple[int, int]
    empty: tuple[int, ...]
    task: SearchProblem

    def stage(self, part: float, cycles: int, options: SolverOptions) -> Stage:
        """The descent with a part of the least thicknesses; with a part of 0 the empty gaps stay at 0."""
        space = self.task.space
        behind = [v.surface if v.quantity == "thickness" else -1 for v in self.task.model.variables]
        thin, empty = np.isin(behind, range(self.gaps[0], self.gaps[1] + 1)), np.isin(behind, self.empty)
        lower = np.where(thin, part * space.lower, space.lower)
        upper = np.where(empty & (part == 0), 0.0, space.upper)
        return Stage(self.task.problem(thinned(self.task.rows, self.gaps, part)), cycles, options, lower, upper)

    def taken(self, until: float = np.inf, *, sign: float = 0.0) -> TaskResult:
        """Variables near the minimum of a lens of real thickness; sign: off a saddle, to one side. Raises
        SearchStopped."""
        first, start = self.stage(0.0, _CYCLES[0], _CAREFUL), self.task.model.start
        x = self.displaced(first, sign) if sign else start
        thicker = [self.stage(part, _CYCLES[1], _CAREFUL) for part in _PARTS]
        return descended(x, [first, *thicker], until, projected(self.task.space, start))

    def displaced(self, stage: Stage, sign: float) -> np.ndarray:
        """Variables (n,) off the saddle to one side, as far as the merit falls, with the conditions met again."""
        x, problem = self.task.model.start, stage.problem
        way = saddle(problem, x, stage.moves(x)).descent
        way = sign * way / np.abs(way[np.argmax(np.abs(way))]) * np.sign(way[np.argmax(np.abs(way))])
        columns = np.sqrt((problem.state(x, True).jacobian ** 2).sum(0))
        unit = np.sqrt(problem.state(x, False).cost) / np.linalg.norm(columns * way)
        best, least = x + _OFF[0] * unit * way, np.inf
        for size in _OFF:
            trial = met(stage, x + size * unit * way)
            state = problem.state(trial, False)
            if not state.is_finite or state.lost or state.cost >= least:
                break
            best, least = trial, state.cost
        return best


def insertions(task: SearchProblem, lens: Lens, places: Sequence[int]) -> Iterator[Move]:
    """A meniscus at each surface of a lens at its minimum, on both sides of the saddle."""
    for k in places:
        thin = Enlargement((k, k + 1), (k, k + 1), enlarged(lens, task, k))
        for side, sign in _SIDES.items():
            yield Move(f"insert {k}, {side}", thin.task, partial(thin.taken, sign=sign))


def splits(task: SearchProblem, lens: Lens, places: Sequence[int]) -> Iterator[Move]:
    """Each element of a lens at its minimum, by its first surface, in two."""
    for k in places:
        cut = Enlargement((k, k + 2), (k + 1,), divided(lens, task, k))
        yield Move(f"split {k}", cut.task, cut.taken)
