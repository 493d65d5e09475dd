"""Problem: the rows of a merit function over a model, as the sum of squares and conditions that a solver descends on.

Rows of positive weight are squared; rows of negative weight, and what is held, are conditions that are met exactly.

Lost rays: how far each misses the surface that it is lost at, with derivatives, so that a descent brings it back.

A ray that meets no point of a conic misses it by the negative discriminant of its crossing; one that is totally
reflected has the sine of its refraction beyond 1:

    A t² + 2 B t + C = 0,  missed by A C - B²;    (n/n')² sin² I - 1

Both are without a unit and 0 where the ray just passes. At any other surface it is how far the ray stands outside the
vertex sphere, c² r².
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from raytrace.maths.dual import Dual, slope_of, value_of
from raytrace.optimization.constraints import Condition as Condition
from raytrace.optimization.conventions import Conventions
from raytrace.optimization.least_squares import Sides, State
from raytrace.optimization.lens_model import Model
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.merit_rows import LOST, Evaluated, Evaluation
from raytrace.optimization.ray_bundle import Bundle, Ray
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Row
from raytrace.system.surface import is_posed

#: How much a miss of 1 weighs beside the loss itself, and how far inside a ray is brought back.
STEEP, MARGIN = 5.0, 0.1


class Recovery:
    """What is charged for the lost rays of the rows of a merit function."""

    def __init__(self, evaluation: Evaluation):
        self.evaluation = evaluation
        self.planners = {line.number - 1: (planner, line) for planner, lines, _ in evaluation.groups for line in lines}
        self._bundles: dict = {}

    def excess(self, x: np.ndarray, rows: Sequence[int], *, derivatives: bool) -> tuple[np.ndarray, ...]:
        """How far the rays of rows (K,), from 0, miss: (K,), by variables (K, n), and how many surfaces are left.

        0 of a ray that runs along the surface, as behind a break of 90°: there is no way back that derivatives know.
        """
        variables = Dual(np.asarray(x, float), np.eye(len(x))) if derivatives else np.asarray(x, float)
        missed, slopes, behind = np.zeros(len(rows)), np.zeros((len(rows), len(x))), np.zeros(len(rows))
        for view, wanted in self._by_view(rows).items():
            state = view.state(variables)
            with np.errstate(all="ignore"):
                found = [*self._missed(view, state, wanted)]
            for place, number, left in found:
                behind[place], slope = left, slope_of(number, len(x))
                if np.isfinite(value_of(number)) and np.isfinite(slope).all():  # else the ray runs along the surface
                    missed[place], slopes[place] = float(value_of(number)), slope
        return missed, slopes, behind

    def _by_view(self, rows: Sequence[int]) -> dict:
        """For every configuration: the places in `rows` and their rays."""
        found: dict = {}
        for place, row in enumerate(rows):
            planner, line = self.planners[row]
            ray = Ray(line.wavelength, line.field, line.pupil)
            if any(ray in bundle.rays for bundle in planner.bundles.values()):  # else a row of no ray
                found.setdefault(planner.view, []).append((place, ray))
        return found

    def _missed(self, view, state: LensState, wanted: list[tuple[int, Ray]]):
        """(place, how far it misses, surfaces left) of every ray that is lost on its way to the image."""
        rays = tuple(dict.fromkeys(ray for _, ray in wanted))
        ended, traced = self._ends(view, state, rays), {}
        for place, ray in wanted:
            surface = ended.get(ray)
            if surface is None or is_posed(view.lens.surfaces[surface]):
                continue
            before = self._before(view, state, rays, ray, surface, traced)
            yield place, _miss(state, surface, ray.wavelength, *before), len(view.lens.surfaces) - 1 - surface

    def _ends(self, view, state: LensState, rays: tuple[Ray, ...]) -> dict[Ray, int]:
        """The surface at which each ray is lost."""
        ended: dict[Ray, int] = {}
        plain = view.state(value_of(state.variables))
        for k in range(1, len(view.lens.surfaces)):
            bundle, numbers = self._bundle(view, k, rays)
            valid = bundle.hits(plain).at(numbers).valid
            ended |= {ray: k for ray, there in zip(rays, valid, strict=True) if not there and ray not in ended}
            if len(ended) == len(rays):
                break
        return ended

    def _bundle(self, view, last: int, rays: tuple[Ray, ...]) -> tuple[Bundle, np.ndarray]:
        key = id(view), last, rays
        if key not in self._bundles:
            bundle = Bundle(view, last)
            self._bundles[key] = bundle, np.array([bundle.ask(*ray) for ray in rays])
        return self._bundles[key]

    def _before(self, view, state: LensState, rays: tuple[Ray, ...], ray: Ray, surface: int, traced: dict):
        """Position and direction of a ray before a surface, in the axes of its vertex; traced: all rays by surface."""
        number = rays.index(ray)
        if surface == 1:
            bundle, numbers = self._bundle(view, 1, rays)
            position, direction, *_ = bundle.launched(state)
            at = int(bundle._places[0][numbers[number]])
            flat = [part.reshape(-1)[at] for part in (*position, *direction)]
            return flat[:3], flat[3:]
        bundle, numbers = self._bundle(view, surface - 1, rays)
        if surface not in traced:
            traced[surface] = bundle.hits(state)
        hit = traced[surface].at(numbers[number : number + 1])
        x, y, z = (hit.position[k][0] for k in range(3))
        return (x, y, z - state.thickness[surface - 1]), tuple(hit.direction[k][0] for k in range(3))


def _miss(state: LensState, surface: int, wavelength: int, position, direction):
    """How far a ray misses a surface, or passes its critical angle."""
    (x, y, z), (L, M, N) = position, direction
    c, k = state.curvature[surface], state.number(surface, "conic") if _has_conic(state, surface) else 0.0
    A = c * (1 + k * N * N)
    B = c * (x * L + y * M + (1 + k) * z * N) - N
    C = c * (x * x + y * y + (1 + k) * z * z) - 2 * z
    inside = B * B - A * C
    if value_of(inside) < 0:
        return -inside
    root = np.sqrt(inside)
    t = C / (-B + np.where(value_of(B) < 0, 1.0, -1.0) * root)
    x, y, z = x + t * L, y + t * M, z + t * N
    steep = (c * x) ** 2 + (c * y) ** 2 + (c * (1 + k) * z - 1) ** 2
    n = np.abs(state.index(wavelength))
    beyond = (value_of(n[surface - 1]) / value_of(n[surface])) ** 2 * (1 - inside / steep) - 1
    return beyond if value_of(beyond) > 0 else c * c * (x * x + y * y)


def _has_conic(state: LensState, surface: int) -> bool:
    return (surface, "conic") in state.numbers or state.lens.surfaces[surface].conic is not None


#: Signs by which a relation is a limit ≤ 0; equalities have none.
RELATIONS = {"=": 0, "<=": 1, ">=": -1}


class NoProblem(ValueError):
    """Nothing that could be optimised; the message says what is missing."""


class Problem:
    """The rows of a merit function, and conditions, over a model; `state` is what `least_squares` descends on."""

    def __init__(
        self,
        model: Model,
        rows: Sequence[Row],
        conditions: Sequence[Condition] = (),
        *,
        unit: float = 1.0,
        skip_unknown: bool = False,
        conventions: Conventions | None = None,
    ):
        """unit: mm in the unit of length of rows and conditions. Raises NoProblem and UnknownOperand."""
        held = tuple(_held(model.lens, rows, conditions))
        self._again = lambda model: Problem(
            model, rows, conditions, unit=unit, skip_unknown=skip_unknown, conventions=conventions
        )
        self.model, self.rows, self.unit, self.conditions = model, tuple(rows), unit, tuple(conditions)
        self.evaluation = Evaluation(
            model, (*rows, *(row for row, _ in held)), unit=unit, skip_unknown=skip_unknown, conventions=conventions
        )
        weights = self.evaluation.weights
        if not len(model.variables):
            raise NoProblem("nothing varies: name variables by `vary`, as 'curvature thickness'")
        if not (weights > 0).any():
            raise NoProblem("no row of the merit function has a weight that counts: choose another by `merit`")
        signs = [0] * len(self.rows) + [sign for _, sign in held]
        self.signs = np.where(weights < 0, signs, 0)
        self.recovery = Recovery(self.evaluation)

    def through(self, opening: float) -> "Problem":
        """The same with rays through a part of the pupil and of the field alone."""
        return self._again(dataclasses.replace(self.model, opening=opening))

    def evaluated(self, x: np.ndarray, derivatives: bool = False) -> Evaluated:
        return self.evaluation(x, derivatives=derivatives)

    def state(self, x: np.ndarray, derivatives: bool) -> State:
        """Residuals of rows of positive weight, and what the others miss, in units of their rows."""
        found = self._charged(self.evaluation(x, derivatives=derivatives, shown=False), x)
        of_row, weights = found.of_row, self.evaluation.weights
        signs, factors = self.signs[of_row], self.evaluation.factors[of_row]
        rows, excess, slopes = _joined(found.sides, len(x))
        sided = np.isin(of_row, rows)
        squared, exact = (weights[of_row] > 0) & ~sided, (weights[of_row] < 0) & ~sided
        equal, limit = exact & (signs == 0), exact & (signs != 0)
        soft, hard = weights[rows] > 0, weights[rows] < 0
        own = self.evaluation.factors[rows[hard]]
        jacobian = found.jacobian
        return State(
            x,
            found.residuals[squared],
            int(found.lost[weights != 0].sum()),
            Sides(excess[soft], slopes[soft], rows[soft]),
            found.residuals[equal] / factors[equal],
            np.concatenate([signs[limit] * found.residuals[limit] / factors[limit], excess[hard] / own]),
            None if jacobian is None else np.where(np.isfinite(jacobian[squared]), jacobian[squared], 0.0),
            None if jacobian is None else jacobian[equal] / factors[equal, None],
            None
            if jacobian is None
            else np.concatenate(
                [(signs[limit] / factors[limit])[:, None] * jacobian[limit], slopes[hard] / own[:, None]]
            ),
        )

    def _charged(self, found: Evaluated, x: np.ndarray) -> Evaluated:
        """With more charged for a lost ray the earlier it is lost, and as a residual of its own how far it misses.

        The former tells which of two states is better, the latter, of which alone there are derivatives, the way back.
        """
        rows = np.unique(found.of_row[found.lost[found.of_row]])
        if not len(rows):
            return found
        missed, slopes, behind = self.recovery.excess(x, rows, derivatives=found.jacobian is not None)
        fixed = LOST * self.evaluation.factors[rows]
        residuals, gone = found.residuals.copy(), found.lost[found.of_row]
        residuals[gone] *= 1 + behind[np.searchsorted(rows, found.of_row[gone])]
        further = np.concatenate([residuals, STEEP * fixed * np.where(missed > 0, missed + MARGIN, 0.0)])
        jacobian = found.jacobian
        if jacobian is not None:
            jacobian = np.concatenate([jacobian, STEEP * fixed[:, None] * slopes])
        return dataclasses.replace(
            found, residuals=further, jacobian=jacobian, of_row=np.concatenate([found.of_row, rows])
        )

    def merit(self, found: Evaluated) -> float:
        """M over the rows of the merit function alone."""
        own = found.residuals[found.of_row < len(self.rows)]
        return float(np.sqrt(own @ own))


def optimization_data_of(model: Model, rows: Sequence[Row], unit: float) -> OptimizationData:
    """What a lens is optimised for, where its file says nothing of it; all semi-diameters that it has stay given."""
    given = tuple(k for k, surface in enumerate(model.lens.surfaces) if surface.semi_diameter)
    return OptimizationData(model.variables, model.solves, tuple(rows), unit, semi_diameters=given)


def _held(lens: Lens, rows: Sequence[Row], conditions: Sequence[Condition]) -> Iterator[tuple[Row, int]]:
    """Rows that do not count among the squares, and the signs of their relations; rows before them say of which
    configuration and primary wavelength they are, where the merit function or a condition does."""
    if any(row.operand == "PRIM" for row in rows):
        yield Row("PRIM", (0, lens.primary_wavelength)), 0
    several = any(row.operand == "CONF" for row in rows) or any(one.configuration for one in conditions)
    for one in conditions:
        if several:
            yield Row("CONF", (one.configuration or lens.current_configuration, 0)), 0
        yield dataclasses.replace(one.row, weight=-1.0), RELATIONS[one.relation]


def typical_of(model: Model) -> np.ndarray:
    """How much (n,) of every variable is a lot: for beams h wide h in thickness, 1/10h in curvature; or inf."""
    state = model.views[model.lens.current_configuration - 1].state(model.start)
    h = 0.5 * float(state.entrance_pupil_diameter)
    return np.array([_typical(one.quantity, h) for one in model.variables])


def _typical(quantity: str, h: float) -> float:
    if quantity[0] == "a" and quantity[1:].isdigit():
        return 0.01 * h ** (1 - int(quantity[1:]))
    return {"thickness": h, "curvature": 0.1 / h, "conic": 1.0, "index": 0.05, "abbe_number": 10.0}.get(
        quantity, np.inf
    )


def _joined(sides: tuple[tuple, ...], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, excess and its slope of one-sided rows of all operands; slopes of 0 where none were asked for."""
    if not sides:
        return np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, count))
    rows, excess = (np.concatenate([one[k] for one in sides]) for k in range(2))
    slopes = [np.zeros((len(one[1]), count)) if one[2] is None else one[2] for one in sides]
    return rows, excess, np.concatenate(slopes)
