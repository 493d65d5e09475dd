"""Meniscus: a lens of no thickness beside a surface, which changes no ray, and the saddle of the merit that it makes.

Before surface k between air and a glass two more of its shape are put, so that a lens of the same glass, without
thickness, touches it. Of the curvatures (c₁, c₂, c₃) of the three the merit stays what it was for

    c₁ = c₂, c₃ = c_k      and      c₁ = c_k, c₂ = c₃

and where a lens is a minimum, its slope along (1, 1, 1) vanishes as well: all three vanish, and along the two lines the
merit is flat while it is not between them. So the lens is a saddle with one way down, to two sides.

Source: Bociort & van Turnhout, Generating saddle points in the merit function landscape of optical systems, Proc. SPIE
5962, 2005; van Turnhout & Bociort, Instabilities and fractal basins of attraction in optical system optimization,
Opt. Express 17, 2009.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from raytrace.media.glass import is_air
from raytrace.merit.boundaries import BOUNDARIES
from raytrace.merit.operands import OPERANDS
from raytrace.merit.vary import Freedom
from raytrace.optimization.asked import Asked
from raytrace.optimization.least_squares import State
from raytrace.optimization.problem import NoProblem, Problem
from raytrace.system.intent import Intent, Row, Solve, Vary
from raytrace.system.lens import Lens
from raytrace.system.naming import sensor
from raytrace.system.surface import Surface, is_posed

_SURFACES = ("surface", "place", "met surface", "contribution")  # of `arguments.ARGUMENTS`
_NEAR = 0.01  # of the residuals: by how much a step along a variable changes them, to tell second derivatives
_ACTIVE = 1e-9  # up to which a limit counts as reached


# -- where one can stand -----------------------------------------------------------------------------------------------


def places_of(free: Freedom, named: Sequence[int] = ()) -> tuple[int, ...]:
    """The surfaces at which a meniscus can stand, or those that are named. Raises NoProblem."""
    lens = free.lens
    if lens.operands:
        raise NoProblem("`insert`: the lens has several configurations; take one of them")
    if not named:
        found = tuple(k for k in range(1, sensor(lens) + 1) if not _objection(free, k))
        if not found:
            raise NoProblem("`insert`: no spherical surface between glass and air whose curvature varies")
        return found
    for k in named:
        if objection := _objection(free, k):
            raise NoProblem(f"`insert`: surface {k} {objection}")
    return tuple(dict.fromkeys(named))


def _objection(free: Freedom, k: int) -> str:
    """What keeps a meniscus from a surface; nothing where it can stand there."""
    lens = free.lens
    if not 1 <= k <= sensor(lens):
        return f"is none before the image: this lens has surfaces 1 to {sensor(lens)}"
    surface, before = lens.surfaces[k], lens.surfaces[k - 1]
    shaped = (surface.conic, surface.coefficients, surface.departure, surface.phase)
    if surface.is_mirror or before.is_mirror or any(part is not None for part in shaped) or is_posed(surface):
        return "is no centred sphere that refracts"
    if before.is_break or is_air(before.glass) == is_air(surface.glass):
        return "does not stand between glass and air"
    varies = any((one.surface, one.quantity) == (k, "curvature") for one in free.variables)
    return "" if varies else "has a curvature that does not vary: name it by `vary`"


# -- the lens with one element more ------------------------------------------------------------------------------------


def enlarged(lens: Lens, asked: Asked, k: int) -> Asked:
    """What is searched of a lens with a meniscus before surface k, by what is asked of the lens itself."""
    made, free = with_meniscus(lens, k), asked.free
    new = [Vary(s, quantity) for quantity in ("curvature", "thickness") for s in (k, k + 1)]
    old = [_moved(one, k) for one in free.variables]
    own = {one: ends for one, *ends in zip(old, *asked.bounds, strict=True)}
    steep = own[next(one for one in old if (one.surface, one.quantity) == (k + 2, "curvature"))]
    own |= {one: steep if one.quantity == "curvature" else (-np.inf, np.inf) for one in new}
    quantities = list(dict.fromkeys(one.quantity for one in (*new, *old)))
    variables = tuple(sorted(own, key=lambda one: (quantities.index(one.quantity), one.surface)))
    solves = tuple(_moved(one, k) for one in free.solves)
    if lens.intent is not None:
        made = replace(made, intent=_intent(lens.intent, k, variables, solves))
    return replace(
        asked,
        free=Freedom(made, variables, solves),
        rows=tuple(_row(row, k) for row in asked.rows),
        conditions=tuple(replace(one, row=_row(one.row, k)) for one in asked.conditions),
        bounds=tuple(np.array([own[one][side] for one in variables], dtype=float) for side in range(2)),
    )


def new_gaps(asked: Asked, k: int) -> np.ndarray:
    """(n,) which variables are the thicknesses of the meniscus and of the air beside it."""
    return np.array([one.quantity == "thickness" and one.surface in (k, k + 1) for one in asked.free.variables])


def thinned(rows: Sequence[Row], k: int, part: float) -> tuple[Row, ...]:
    """The rows with that part of the least thicknesses asked of the new gaps, of 0 none; as many rows ahead of those
    that are split off."""
    pieces = [_split(row, k, part) if part < 1 else [row] for row in rows]
    return (*(one[0] for one in pieces), *(row for one in pieces for row in one[1:]))


def with_meniscus(lens: Lens, k: int) -> Lens:
    """The lens with a meniscus without thickness before surface k, of the glass beside it; no ray goes otherwise."""
    surface = lens.surfaces[k]
    media = lens.surfaces[k], lens.surfaces[k - 1]  # behind the two new surfaces
    new = tuple(_touching(surface, one) for one in media)
    stop = lens.stop + 2 if lens.stop >= k else lens.stop
    return replace(lens, surfaces=(*lens.surfaces[:k], *new, *lens.surfaces[k:]), stop=stop)


def _touching(surface: Surface, medium: Surface) -> Surface:
    """A surface of the same shape with another medium behind it, and no space."""
    nothing = 0 * surface.thickness
    beside = {"glass": medium.glass, "environment": medium.environment}
    return replace(surface, thickness=nothing, apertures=(), comment="", **beside)


def _behind(surface: int, k: int) -> int:
    """The number of a surface once two more stand before surface k."""
    return surface + 2 if surface >= k else surface


def _moved(one: Vary | Solve, k: int) -> Vary | Solve:
    further = {"source": _behind(one.source, k)} if isinstance(one, Solve) else {}
    return replace(one, surface=_behind(one.surface, k), **further)


def _row(row: Row, k: int) -> Row:
    """A row that names the same surfaces by their new numbers."""
    kinds = _kinds(row)
    moved = [_behind(n, k) if kind in _SURFACES else n for kind, n in zip(kinds, row.integers, strict=True)]
    return replace(row, integers=tuple(moved)) if any(kinds) else row


def _kinds(row: Row) -> tuple[str, str]:
    """What the integers of a row name."""
    if row.operand in BOUNDARIES:
        return ("surface", "surface" if row.operand[:2] in ("MN", "MX") else "")
    return OPERANDS[row.operand].takes if row.operand in OPERANDS else ("", "")


def _split(row: Row, k: int, part: float) -> list[Row]:
    """A row of least thicknesses as several: of the gaps of old, and with part of its target of the new ones."""
    first, last = row.integers
    is_least = row.operand in BOUNDARIES and row.operand[:2] == "MN" and row.operand[-1] in "TGA"
    if not is_least or last < k or first > k + 1:
        return [row]
    ranges = [(first, k - 1), (max(first, k + 2), last)]
    found = [replace(row, integers=ends) for ends in ranges if ends[0] <= ends[1]]
    if part > 0:
        found.append(replace(row, integers=(k, k + 1), target=part * row.target))
    return found or [replace(row, weight=0.0)]


def _intent(intent: Intent, k: int, variables: tuple[Vary, ...], solves: tuple[Solve, ...]) -> Intent:
    """What the file means, by the new numbers of its surfaces; lines of tolerances, which name surfaces, are left."""
    return dataclasses.replace(
        intent,
        variables=variables,
        solves=solves,
        merit=tuple(_row(row, k) for row in intent.merit),
        tolerances=(),
        semi_diameters=tuple(_behind(one, k) for one in intent.semi_diameters),
        kept=tuple(_moved(one, k) for one in intent.kept),
    )


# -- the saddle --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Saddle:
    """How the merit curves under its conditions. ways (n, m): a basis of the steps that break none, each of which
    changes the residuals alike; slope (m,) and curves (m, m) of half the square of the merit along them."""

    ways: np.ndarray
    slope: np.ndarray
    curves: np.ndarray

    @property
    def descent(self) -> np.ndarray:
        """(n,) the way along which it falls most, to both sides."""
        return self.ways @ np.linalg.eigh(self.curves)[1][:, 0]


def saddle(problem: Problem, x: np.ndarray, moves: np.ndarray) -> Saddle:
    """How the merit curves at x (n,) where the variables `moves` (n,) move."""
    state = problem.state(x, True)
    columns = np.sqrt((state.jacobian**2).sum(0))
    scale = np.where(columns > 0, columns, 1.0)
    step = _NEAR * np.sqrt(max(state.cost, 1e-30)) / scale
    slopes = _conditions(state)
    price = np.linalg.lstsq((slopes / scale)[:, moves].T, -(_slope(state) / scale)[moves], rcond=None)[0]
    told = lambda s: _slope(s) + price @ _conditions(s, like=state)  # noqa: E731
    free = np.nonzero(moves)[0]
    second = np.zeros((len(free), len(free)))
    for row, j in enumerate(free):
        ahead, back = (problem.state(x + sign * step * (np.arange(len(x)) == j), True) for sign in (1, -1))
        second[row] = ((told(ahead) - told(back)) / (2 * step[j] * scale[j]) / scale)[free]
    along = null_space((slopes / scale)[:, free]) if len(slopes) else np.eye(len(free))
    ways = np.zeros((len(x), along.shape[1]))
    ways[free] = along / scale[free, None]
    return Saddle(ways, ways.T @ told(state), 0.5 * along.T @ (second + second.T) @ along)


def _slope(state: State) -> np.ndarray:
    """Half the gradient (n,) of the sum of squares."""
    sides = state.sides
    over = sides.excess > 0
    sums = np.bincount(sides.row, np.maximum(sides.excess, 0.0)) if len(sides.row) else np.zeros(0)
    return state.jacobian.T @ state.residuals + sums[sides.row[over]] @ sides.slope[over]


def _conditions(state: State, like: State | None = None) -> np.ndarray:
    """Slopes (h, n) of what is held and of the limits that are reached, at the state `like`."""
    reached = (like or state).limits > -_ACTIVE
    return np.concatenate([state.held_slope, state.limits_slope[reached]])
