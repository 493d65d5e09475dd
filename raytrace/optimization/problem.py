"""Problem: a merit function and conditions over a model, as the sum of squares and conditions of the solver.

Rows of positive weight are squared; rows of negative weight, and `conditions`, are met exactly.

Failed rays are charged by the amount by which each misses the surface at which it fails, with derivatives that lead it
back. A ray that misses a conic has a negative discriminant; for a totally reflected ray the sine of refraction is
above 1:

    A t² + 2 B t + C = 0,  missed by A C - B²;    (n/n')² sin² I - 1

Both are dimensionless and 0 where the ray just passes. At other surfaces the amount is the distance of the ray beyond
the vertex sphere, c² r².
"""

import dataclasses
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import Dual, Number, slope_of, value_of
from raytrace.optimization.conditions import Condition, has_other_rows, stored_conditions, with_conditions
from raytrace.optimization.least_squares import Sides, SumOfSquares
from raytrace.optimization.lens_state import Bundle, Hits, LensState, Ray, View
from raytrace.optimization.merit import LOST, Evaluated, Evaluation, RowOptions, in_unit, rereferenced
from raytrace.optimization.operands.operand import Conventions
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Row
from raytrace.system.surface import is_posed
from raytrace.words import RaytraceError, named_value, option

#: Weight of a miss of 1 relative to the charge for a failed ray, and the margin by which a ray is brought back.
STEEP, MARGIN = 5.0, 0.1


class Recovery:
    """The amounts by which failed rays of the rows of a merit function miss a surface."""

    def __init__(self, evaluation: Evaluation):
        self.planners = {line.number - 1: (planner, line) for planner, lines, _ in evaluation.groups for line in lines}
        self._bundles: dict[tuple, tuple[Bundle, np.ndarray]] = {}

    def excess(
        self, x: np.ndarray, rows: np.ndarray, *, derivatives: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Amounts (K,) by which the rays of rows (K,), from 0, miss, by variables (K, n), and number of surfaces left.

        The amount is 0 for a ray along the surface, as behind a break of 90°, which no derivative brings back.
        """
        variables = Dual(np.asarray(x, float), np.eye(len(x))) if derivatives else np.asarray(x, float)
        missed, slopes, behind = np.zeros(len(rows)), np.zeros((len(rows), len(x))), np.zeros(len(rows))
        by_view: dict[View, list[tuple[int, Ray]]] = {}
        for place, row in enumerate(rows):
            planner, line = self.planners[row]
            ray = Ray(line.wavelength, line.field, line.pupil)
            if any(ray in bundle.rays for bundle in planner.bundles.values()):  # else the row traces no ray
                by_view.setdefault(planner.view, []).append((place, ray))
        for view, wanted in by_view.items():
            state = view.state(variables)
            with np.errstate(all="ignore"):
                misses = [*self._missed(view, state, wanted)]
            for place, miss, left in misses:
                behind[place], slope = left, slope_of(miss, len(x))
                if np.isfinite(value_of(miss)) and np.isfinite(slope).all():  # else the ray is along the surface
                    missed[place], slopes[place] = float(value_of(miss)), slope
        return missed, slopes, behind

    def _missed(self, view: View, state: LensState, wanted: list[tuple[int, Ray]]) -> Iterator[tuple[int, Number, int]]:
        """(place, miss, surfaces left) of every ray that fails on its way to the image."""
        rays = tuple(dict.fromkeys(ray for _, ray in wanted))
        failed: dict[Ray, int] = {}  # surface
        plain = view.state(value_of(state.variables))
        for k in range(1, len(view.lens.surfaces)):
            bundle, numbers = self._bundle(view, k, rays)
            valid = bundle.hits(plain).at(numbers).valid
            failed |= {ray: k for ray, inside in zip(rays, valid, strict=True) if not inside and ray not in failed}
            if len(failed) == len(rays):
                break
        traced: dict[int, Hits] = {}
        for place, ray in wanted:
            surface = failed.get(ray)
            if surface is None or is_posed(view.lens.surfaces[surface]):
                continue
            before = self._before(view, state, rays, ray, surface, traced)
            yield place, _miss(state, surface, ray.wavelength, *before), len(view.lens.surfaces) - 1 - surface

    def _bundle(self, view: View, last: int, rays: tuple[Ray, ...]) -> tuple[Bundle, np.ndarray]:
        key = id(view), last, rays
        if key not in self._bundles:
            bundle = Bundle(view, last)
            self._bundles[key] = bundle, np.array([bundle.ask(*ray) for ray in rays])
        return self._bundles[key]

    def _before(
        self, view: View, state: LensState, rays: tuple[Ray, ...], ray: Ray, surface: int, traced: dict[int, Hits]
    ) -> tuple[Sequence[Number], Sequence[Number]]:
        """Position and direction of a ray before a surface, in the axes of its vertex; traced: all rays by surface."""
        number = rays.index(ray)
        if surface == 1:
            bundle, numbers = self._bundle(view, 1, rays)
            position, direction, *_ = bundle.launched(state)
            place = int(bundle._places[0][numbers[number]])
            flat = [part.reshape(-1)[place] for part in (*position, *direction)]
            return flat[:3], flat[3:]
        bundle, numbers = self._bundle(view, surface - 1, rays)
        if surface not in traced:
            traced[surface] = bundle.hits(state)
        hit = traced[surface].at(numbers[number : number + 1])
        x, y, z = (hit.position[k][0] for k in range(3))
        return (x, y, z - state.thickness[surface - 1]), tuple(hit.direction[k][0] for k in range(3))


def _miss(
    state: LensState, surface: int, wavelength: int, position: Sequence[Number], direction: Sequence[Number]
) -> Number:
    """The amount by which a ray misses a surface, or exceeds its critical angle."""
    (x, y, z), (L, M, N) = position, direction
    has_conic = (surface, "conic") in state.numbers or state.lens.surfaces[surface].conic is not None
    c, k = state.curvature[surface], state.number(surface, "conic") if has_conic else 0.0
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


#: Signs by which a relation is a limit ≤ 0; equalities have none.
RELATIONS = {"=": 0, "<=": 1, ">=": -1}


class Expectation(Protocol):
    """The lens as built as a term of a merit function: `tolerancing.as_built.AsBuiltTerm`.

    residuals: (R,) of a state of the lens, their derivatives (R, n) by its variables, and the number of failed rays;
    unit: mm in the unit of length of the rows. expected, nominal: mean square spot radius () mm² as built and without
    errors.
    """

    def residuals(self, state: LensState, unit: float) -> tuple[np.ndarray, np.ndarray, int]: ...

    def expected(self, lens: Lens) -> Tensor: ...

    def nominal(self, lens: Lens) -> Tensor: ...

    def words(self) -> str: ...

    def about(self) -> str: ...


@runtime_checkable
class ExpectationSettings(Protocol):
    """Settings of an expectation: `tolerancing.as_built.AsBuilt`."""

    def of(self, lens: Lens) -> Expectation: ...

    def words(self) -> str: ...


class NoLight(RaytraceError, ValueError):
    """An expectation of lenses of which no ray of a field arrives."""


class NoProblem(RaytraceError, ValueError):
    """An optimisation without variables, rows or light; the message says what is missing."""


def scalar_loss(loss: object) -> Tensor:
    """A loss as a real tensor (). Raises NoProblem for other values, which a function returned by mistake."""
    if not isinstance(loss, Tensor):
        raise NoProblem(f"the loss is {named_value(loss)}; expected a tensor of one number, without float() or .item()")
    if loss.numel() != 1:
        raise NoProblem(f"the loss has the shape {tuple(loss.shape)}; expected one number: take its .mean() or .sum()")
    if loss.is_complex():
        raise NoProblem("the loss is complex; expected a real number: take .abs() or .real, as of a transfer function")
    return loss.reshape(())


def refuse_detached(loss: Tensor) -> None:
    """Raise NoProblem for a loss outside the graph of the variables."""
    if not loss.requires_grad:
        raise NoProblem(
            "the loss has no derivative by the variables: compute it from its argument by torch, without .detach(), "
            ".numpy() or torch.no_grad()"
        )


class Specification:
    """The rows of a merit function, and conditions, over a model."""

    def __init__(
        self,
        model: DesignVariables,
        rows: Sequence[Row],
        conditions: Sequence[Condition] = (),
        *,
        unit: float = 1.0,
        skip_unknown: bool = False,
        conventions: Conventions | None = None,
        as_built: Expectation | None = None,
    ):
        """unit: mm in the unit of length of rows and conditions; as_built: a term in addition to the rows, of the lens
        in its current configuration, in proportion to the weights of all rows but boundaries. Raises UnknownOperand."""
        self.as_built = as_built
        held = tuple(_held(model.lens, rows, conditions))
        self._settings: RowOptions = {"unit": unit, "skip_unknown": skip_unknown, "conventions": conventions}
        self.model, self.rows, self.unit, self.conditions = model, tuple(rows), unit, tuple(conditions)
        self.evaluation = Evaluation(model, (*rows, *(row for row, _ in held)), **self._settings)
        signs = [0] * len(self.rows) + [sign for _, sign in held]
        self.signs = np.where(self.evaluation.weights < 0, signs, 0)

    def evaluated(self, x: np.ndarray, derivatives: bool = False) -> Evaluated:
        return self.evaluation(x, derivatives=derivatives)


class Problem(Specification):
    """A specification that is optimised; `state` is the function of `least_squares`.

    Raises NoProblem where nothing varies, or no row counts.
    """

    def __init__(self, model: DesignVariables, *parts: Any, **settings: Any):
        """parts, settings: of `Specification`."""
        super().__init__(model, *parts, **settings)
        if not len(model.variables):
            raise NoProblem(f"nothing varies: name variables by {option('vary')}, as 'curvature thickness'")
        if not (self.evaluation.weights > 0).any():
            raise NoProblem(
                f"no row of the merit function has a weight that counts: choose another by {option('merit')}"
            )
        self.recovery = Recovery(self.evaluation)

    def through(self, opening: float) -> "Problem":
        """The problem with rays through a part of pupil and field alone, and without the lens as built."""
        return self.of(dataclasses.replace(self.model, opening=opening))

    def of(self, model: DesignVariables) -> "Problem":
        """The problem of the same rows and conditions over another model, without the lens as built."""
        return Problem(model, self.rows, self.conditions, **self._settings)

    def with_as_built(self, term: Expectation) -> "Problem":
        """The problem with the lens as built as a term."""
        return Problem(self.model, self.rows, self.conditions, as_built=term, **self._settings)

    def state(self, x: np.ndarray, derivatives: bool) -> SumOfSquares:
        """Residuals of rows of positive weight and of the lens as built, and violations of the other rows, in units of
        their rows."""
        evaluated = self._charged(self.evaluation(x, derivatives=derivatives, shown=False), x, derivatives)
        of_row, weights, residuals = evaluated.of_row, self.evaluation.weights, evaluated.residuals
        signs, factors = self.signs[of_row], self.evaluation.factors[of_row]
        sides, count = evaluated.sides, len(x)
        rows, excess, slopes = np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, count))
        if sides:  # one-sided rows of all operands
            rows, excess, slopes = (np.concatenate([side[k] for side in sides]) for k in range(3))
        sided = np.isin(of_row, rows)
        squared, exact = (weights[of_row] > 0) & ~sided, (weights[of_row] < 0) & ~sided
        equal, limit = exact & (signs == 0), exact & (signs != 0)
        soft, hard = weights[rows] > 0, weights[rows] < 0
        of_hard = self.evaluation.factors[rows[hard]]
        state = SumOfSquares(
            x,
            residuals[squared],
            int(evaluated.lost[weights != 0].sum()),
            Sides(excess[soft], slopes[soft], rows[soft]),
            residuals[equal] / factors[equal],
            np.concatenate([signs[limit] * residuals[limit] / factors[limit], excess[hard] / of_hard]),
        )
        added, by_variables, lost = self._as_built(x, derivatives)
        state = dataclasses.replace(state, residuals=np.concatenate([state.residuals, added]), lost=state.lost + lost)
        if not derivatives:
            return state
        jacobian = evaluated.jacobian
        of_limits = (signs[limit] / factors[limit])[:, None] * jacobian[limit], slopes[hard] / of_hard[:, None]
        return dataclasses.replace(
            state,
            jacobian=np.concatenate([np.where(np.isfinite(jacobian[squared]), jacobian[squared], 0.0), by_variables]),
            held_slope=jacobian[equal] / factors[equal, None],
            limits_slope=np.concatenate(of_limits),
        )

    def _as_built(self, x: np.ndarray, derivatives: bool) -> tuple[np.ndarray, np.ndarray, int]:
        if self.as_built is None:
            return np.zeros(0), np.zeros((0, len(x))), 0
        view = self.model.views[self.model.lens.current_configuration - 1]
        state = view.state(Dual(x, np.eye(len(x))) if derivatives else x)
        residuals, slopes, lost = self.as_built.residuals(state, self.unit)
        factor = self._share**0.5
        return factor * residuals, factor * slopes, lost

    @cached_property
    def _share(self) -> float:
        """The share of the rows without boundaries in the sum of the weights."""
        weights = np.maximum(self.evaluation.weights, 0.0)
        free = [not (row.operand in OPERANDS and OPERANDS[row.operand].bounds) for row in self.evaluation.rows]
        return float(weights[free].sum() / weights.sum())

    def _charged(self, evaluated: Evaluated, x: np.ndarray, derivatives: bool) -> Evaluated:
        """The residuals with a charge for each failed ray, larger the earlier it fails, and its miss as a residual.

        The charge ranks two lenses; the miss has derivatives, which bring the ray back.
        """
        failed = evaluated.lost[evaluated.of_row]
        rows = np.unique(evaluated.of_row[failed])
        if not len(rows):
            return evaluated
        missed, slopes, behind = self.recovery.excess(x, rows, derivatives=derivatives)
        fixed = LOST * self.evaluation.factors[rows]
        residuals, jacobian = evaluated.residuals.copy(), evaluated.jacobian
        residuals[failed] *= 1 + behind[np.searchsorted(rows, evaluated.of_row[failed])]
        if derivatives:
            jacobian = np.concatenate([jacobian, STEEP * fixed[:, None] * slopes])
        return dataclasses.replace(
            evaluated,
            residuals=np.concatenate([residuals, STEEP * fixed * np.where(missed > 0, missed + MARGIN, 0.0)]),
            jacobian=jacobian,
            of_row=np.concatenate([evaluated.of_row, rows]),
        )

    def merit(self, evaluated: Evaluated, x: np.ndarray | None = None) -> float:
        """M over the rows of the merit function; with x, the lens as built is added."""
        residuals = evaluated.residuals[evaluated.of_row < len(self.rows)]
        added = self._as_built(x, False)[0] if x is not None else np.zeros(0)
        return float(np.sqrt(residuals @ residuals + added @ added))


class FunctionMerit:
    """A function of a lens as a merit over the variables of a model, with its gradient, carried through solves.

    evaluated: (E, n + 1 + n) variables, value and gradient of earlier evaluations: a resumed descent repeats these
    without evaluating, but counts them. An evaluation at variables of an earlier one is not repeated.
    """

    def __init__(
        self, model: DesignVariables, function: Callable[[Lens], Tensor], evaluated: Iterable[np.ndarray] = ()
    ):
        self.model, self.function, self.evaluations = model, function, 0
        self.evaluated: list[np.ndarray] = [*evaluated]
        self.known = {evaluation[: len(evaluation) // 2].tobytes(): evaluation for evaluation in self.evaluated}
        self.counted: set[bytes] = set()

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """The merit and its gradient (n,)."""
        x = np.array(x, dtype=float)
        key = x.tobytes()
        known = self.known.get(key)
        self.evaluations += known is None or key not in self.counted
        self.counted.add(key)
        if known is not None:
            return float(known[len(x)]), known[len(x) + 1 :].copy()
        variables = torch.tensor(x, requires_grad=True)
        with torch.enable_grad():
            merit = scalar_loss(self.function(self.model.lens_at(variables)))
        refuse_detached(merit)
        slope = torch.autograd.grad(merit, variables, materialize_grads=True)[0].numpy()
        value = float(merit.detach())
        self.known[key] = np.array([*x, value, *slope])
        self.evaluated.append(self.known[key])
        return value, slope


def optimization_data_of(
    model: DesignVariables, rows: Sequence[Row], unit: float, conditions: Sequence[Condition] = ()
) -> OptimizationData:
    """Optimisation data of an optimised lens: those of its file, and what that lacks of this optimisation: variables,
    solves, rows of the merit function, boundaries that follow the rows of the file, and conditions, in mm.

    Semi-diameters that a lens without any data has stay specified.
    """
    lens, data = model.lens, model.lens.optimization_data
    if data is None:
        data = OptimizationData(semi_diameters=tuple(k for k, s in enumerate(lens.surfaces) if s.semi_diameter))
    of_lens, length = stored_conditions(lens), data.unit if data.rules or data.tolerances else unit
    if has_other_rows(lens):
        free = [dataclasses.replace(row, weight=0.0) if row.weight < 0 else row for row in data.merit]
        is_extended, length = [*rows[: len(free)]] == free, data.unit
        merit = (*data.merit, *(rows[len(free) :] if is_extended else ()))
    else:
        merit = tuple(in_unit(row, unit, length) for row in rows)
    data = dataclasses.replace(
        data,
        variables=data.variables or model.variables,
        solves=data.solves or model.solves,
        merit=merit,
        unit=length,
    )
    lens = with_conditions(dataclasses.replace(lens, optimization_data=data), of_lens)
    return with_conditions(lens, conditions).optimization_data or data


def _held(lens: Lens, rows: Sequence[Row], conditions: Sequence[Condition]) -> Iterator[tuple[Row, int]]:
    """Rows of conditions and the signs of their relations; rows before them set configuration and primary wavelength,
    where the merit function or a condition does."""
    above = (*rows, *(row for condition in conditions for row in condition.before))
    several = any(row.operand == "CONF" for row in above) or any(condition.configuration for condition in conditions)
    primaries, count = any(row.operand == "PRIM" for row in above), len(rows)
    for condition in conditions:
        primary = Row("PRIM", (0, lens.primary_wavelength))
        settings = [primary] if primaries else []
        settings += [Row("CONF", (condition.configuration or lens.current_configuration, 0))] if several else []
        start = count + len(settings)
        last = dataclasses.replace(condition.row, weight=-1.0)
        behind = partial(operator.add, start)
        moved = [rereferenced(row, behind) for row in condition.before]
        yield from ((row, 0) for row in (*settings, *moved))
        yield (rereferenced(last, behind) if moved else last), RELATIONS[condition.relation]
        count = start + len(moved) + 1


def typical_of(model: DesignVariables) -> np.ndarray:
    """Large changes (n,) of the variables: h of thicknesses, 0.1/h of curvatures, h the radius of the beam; inf if
    unknown."""
    state = model.views[model.lens.current_configuration - 1].state(model.start)
    h = 0.5 * float(state.entrance_pupil_diameter)
    typical = {"thickness": h, "curvature": 0.1 / h, "conic": 1.0, "index": 0.05, "abbe_number": 10.0}
    names = [variable.quantity for variable in model.variables]
    return np.array(
        [
            0.01 * h ** (1 - int(name[1:])) if name[0] == "a" and name[1:].isdigit() else typical.get(name, np.inf)
            for name in names
        ]
    )
