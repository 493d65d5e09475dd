"""Problem: a merit function and constraints over a model, as the sum of squares and conditions of the solver.

Constraint syntax is "efl=50 total_track<=80 distortion<=2% bfd>=30": a name of WORDS, a relation and a number;
efl@2=100 applies to configuration 2, thickness:3-5>=20 to the sum of these thicknesses, and REAY(8,0,0,1,0,0)=2 to any
operand by its arguments. A name alone, as "efl", keeps the number of the lens as it is; distortion, a limit, does not
become larger.

Rows of positive weight are squared; rows of negative weight, and constraints, are conditions that are met exactly.

Failed rays are charged by the amount by which each misses the surface at which it fails, with derivatives that lead it
back. A ray that misses a conic has a negative discriminant; for a totally reflected ray the sine of refraction is
above 1:

    A t² + 2 B t + C = 0,  missed by A C - B²;    (n/n')² sin² I - 1

Both are dimensionless and 0 where the ray just passes. At other surfaces the amount is the distance of the ray beyond
the vertex sphere, c² r².
"""

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.chief import SAMPLES
from raytrace.maths.numerics import Dual, Number, slope_of, value_of
from raytrace.optimization.least_squares import Sides, SumOfSquares
from raytrace.optimization.lens_state import Bundle, Hits, LensState, Ray, View
from raytrace.optimization.merit import LOST, Evaluated, Evaluation, RowOptions, in_unit
from raytrace.optimization.operands.aberrations import unvignetted
from raytrace.optimization.operands.operand import Conventions
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.variables import (
    BadHold,
    DesignVariables,
    constraint_words,
    has_power,
    split_constraint,
)
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Row
from raytrace.system.parameter_paths import sensor
from raytrace.system.surface import is_posed
from raytrace.tracing.paraxial import largest_field
from raytrace.words import RaytraceError, did_you_mean, option


@dataclass(frozen=True)
class Condition:
    """A constraint: the value of a row related to its target, lengths in mm; in a configuration, 0 the current one.

    relation: "=", "<=" or ">="; name: in tables, by default the operand of the row.
    """

    row: Row
    relation: str = "="
    configuration: int = 0
    name: str = ""


#: The arguments of a row: two integers and four numbers.
Arguments = tuple[tuple[int, int], tuple[float, float, float, float]]

_NONE: Arguments = ((0, 0), (0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Word:
    """A quantity of constraint syntax: an operand with its arguments, in mm or `unit`."""

    operand: str
    text: str
    unit: str = "mm"
    arguments: Callable[[Lens], Arguments] = lambda lens: _NONE


def conditions_of(lens: Lens, hold: str | Sequence[str] | None) -> tuple[Condition, ...]:
    """The conditions of constraint syntax. Raises BadHold."""
    return tuple(_condition(lens, word) for word in constraint_words(hold))


def conditions_in_unit(lens: Lens, hold: str | Sequence[str | Condition] | None, unit: float) -> tuple[Condition, ...]:
    """The conditions of `hold`, from mm to the unit of length of the merit function."""
    listed = [hold] if isinstance(hold, str) else hold or ()
    words = [word for word in listed if isinstance(word, str)]
    values = [condition for condition in listed if isinstance(condition, Condition)]
    conditions = (*conditions_of(lens, words), *values)
    return tuple(dataclasses.replace(condition, row=in_unit(condition.row, 1.0, unit)) for condition in conditions)


def _condition(lens: Lens, word: str) -> Condition:
    name, configuration, relation, number = split_constraint(word)
    if configuration > len(lens.configurations):
        raise BadHold(
            f"{option('hold')}: {word!r}: configuration {configuration}; this lens has {len(lens.configurations)}"
        )
    view = lens.configuration(configuration) if configuration else lens
    if name in WORDS:
        known = WORDS[name]
        arguments = known.arguments(view)
    elif sum_of := re.fullmatch(r"thickness:(\d+)(?:-(\d+))?", name):
        first, last = int(sum_of[1]), int(sum_of[2] or sum_of[1])
        if not 0 <= first <= last <= sensor(lens):
            raise BadHold(f"{option('hold')}: {word!r}: this lens has gaps behind surfaces 0 to {sensor(lens)}")
        known, arguments = Word("TTHI", "a sum of thicknesses"), ((first, last), _NONE[1])
    elif operand := re.fullmatch(r"([A-Z][A-Z0-9]{3})(?:\(([^()]*)\))?", name):
        if operand[1] not in OPERANDS:
            raise BadHold(
                f"{option('hold')}: {word!r}: no operand {operand[1]}{did_you_mean(operand[1], map(str, OPERANDS))}"
            )
        known, arguments = Word(operand[1], "", ""), _arguments(operand[2] or "", word)
    else:
        meant = f"; did you mean {_INSTEAD[name.lower()]}?" if name.lower() in _INSTEAD else did_you_mean(name, WORDS)
        raise BadHold(
            f"{option('hold')}: {word!r}: {name!r} is nothing to hold; expected one of {', '.join(WORDS)}{meant}"
        )
    bounds = OPERANDS[known.operand].bounds
    if not number:
        row = Row(known.operand, *arguments)
        row = dataclasses.replace(row, target=_number_of(view, row, word))
        return Condition(row, bounds or relation, configuration, name)
    if bounds and relation != bounds:
        raise BadHold(f"{option('hold')}: {word!r}: {name} is a limit on one side; expected {name}{bounds}{number}")
    try:
        target = float(number.removesuffix(known.unit) if known.unit else number)
    except ValueError:
        target = float("nan")
    if not abs(target) < float("inf"):
        unit = f" in {known.unit}" if known.unit else ""
        raise BadHold(f"{option('hold')}: {word!r}: {number!r} is no number{unit}")
    return Condition(Row(known.operand, *arguments, target=target), relation, configuration, name)


def _number_of(lens: Lens, row: Row, word: str) -> float:
    """The number of a row of a lens as it is. Raises BadHold."""
    number = float(Evaluation(DesignVariables(lens), (row,))(np.zeros(0)).values[0])
    if not np.isfinite(number):
        raise BadHold(f"{option('hold')}: {word!r} keeps the number of the lens as it is, which is {number:g}")
    return number


def _arguments(text: str, word: str) -> Arguments:
    """The arguments of a row from text: two integers, then up to four numbers."""
    try:
        numbers = [float(part) for part in text.split(",") if part]
        first = [int(part) for part in numbers[:2]]
    except ValueError:
        numbers, first = [0.0] * 7, []
    if len(numbers) > 6 or first != numbers[:2]:
        raise BadHold(
            f"{option('hold')}: {word!r}: expected two whole numbers and up to four numbers, as REAY(8,0,0,1,0,0)"
        )
    first, others = first + [0] * (2 - len(first)), numbers[2:] + [0.0] * (4 - len(numbers[2:]))
    return (first[0], first[1]), (others[0], others[1], others[2], others[3])


# -- arguments in a lens -----------------------------------------------------------------------------------------------


def _behind_the_lens(lens: Lens) -> Arguments:
    """The gaps from the last powered surface to the image."""
    bending = [k for k in range(1, sensor(lens) + 1) if has_power(lens, k)]
    return (max(bending, default=1), sensor(lens)), _NONE[1]


def _chief_ray(lens: Lens) -> Arguments:
    """The ray of the largest field through the centre of its pupil, vignetting applied, on the image."""
    if not (extent := lens.fields.extent):
        raise BadHold(f"{option('hold')}: all fields are on the axis: there is no off-axis chief ray")
    x, y = (largest_field(lens)[:, 0] / extent).tolist()
    return (len(lens.surfaces) - 1, 0), (x, y, 0.0, 0.0)


def _through_stop(lens: Lens) -> Arguments:
    """The ray of the largest field through the centre of the stop, without vignetting factors, on the image."""
    surface, (x, y, *_) = _chief_ray(lens)
    return surface, (x, y, *unvignetted(lens, (x, y)))


def _curve(lens: Lens) -> Arguments:
    """The fields of the curve of `analysis.chief.distortion`."""
    return (0, 0), (0.0, float(SAMPLES), 0.0, 0.0)


def _outer_colours(lens: Lens) -> Arguments:
    """The shortest and the longest wavelength."""
    return (int(lens.wavelengths.argmin()) + 1, int(lens.wavelengths.argmax()) + 1), _NONE[1]


#: Names of quantities in other programs, and their name in constraint syntax.
_INSTEAD = {
    **dict.fromkeys(("bfl", "back_focal_length", "back_focal_distance"), "bfd"),
    **dict.fromkeys(("focal_length", "effective_focal_length", "efy"), "efl"),
    **dict.fromkeys(("ttl", "oal", "track", "length"), "total_track"),
    **dict.fromkeys(("fno", "f#", "f/#"), "f_number"),
    "epd": "entrance_pupil_diameter",
    "na": "numerical_aperture",
}

#: Quantities of constraint syntax; each is the number of the analysis of that name.
WORDS = {
    "efl": Word("EFFL", "effective focal length"),
    "f_number": Word("ISFN", "focal length / entrance pupil diameter", ""),
    "working_f_number": Word("WFNO", "of the real cone on the axis", ""),
    "numerical_aperture": Word("ISNA", "of the image, paraxial", ""),
    "magnification": Word("PMAG", "paraxial, of an object at a finite distance", ""),
    "angular_magnification": Word("AMAG", "paraxial, of the chief ray", ""),
    "total_track": Word("TOTR", "from the first vertex to the image"),
    "bfd": Word("TTHI", "from the last powered surface to the image", arguments=_behind_the_lens),
    "image_height": Word(
        "REAR",
        "from the vertex of the sensor, of the ray of the largest field through the centre of the stop",
        arguments=_through_stop,
    ),
    "paraxial_image_height": Word("PIMH", "of the largest field"),
    "distortion": Word("DIMX", "the largest absolute value from the axis to the largest field", "%", _curve),
    "petzval_radius": Word("PETZ", "of the image without astigmatism"),
    "entrance_pupil_diameter": Word("EPDI", "of the beam"),
    "entrance_pupil": Word("ENPP", "distance from surface 1"),
    "exit_pupil": Word("EXPP", "distance from the image"),
    "chief_ray_angle": Word("RAID", "between the chief ray of the largest field and the image's axis", "°", _chief_ray),
    "lateral_colour": Word("LACL", "between the outer wavelengths", arguments=_outer_colours),
    "axial_colour": Word("AXCL", "between the outer wavelengths", arguments=_outer_colours),
}


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


class Problem:
    """The rows of a merit function, and conditions, over a model; `state` is the function of `least_squares`."""

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
        in its current configuration, in proportion to the weights of all rows but boundaries. Raises NoProblem and
        UnknownOperand."""
        self.as_built = as_built
        held = tuple(_held(model.lens, rows, conditions))
        self._settings: RowOptions = {"unit": unit, "skip_unknown": skip_unknown, "conventions": conventions}
        self.model, self.rows, self.unit, self.conditions = model, tuple(rows), unit, tuple(conditions)
        self.evaluation = Evaluation(model, (*rows, *(row for row, _ in held)), **self._settings)
        weights = self.evaluation.weights
        if not len(model.variables):
            raise NoProblem(f"nothing varies: name variables by {option('vary')}, as 'curvature thickness'")
        if not (weights > 0).any():
            raise NoProblem(
                f"no row of the merit function has a weight that counts: choose another by {option('merit')}"
            )
        signs = [0] * len(self.rows) + [sign for _, sign in held]
        self.signs = np.where(weights < 0, signs, 0)
        self.recovery = Recovery(self.evaluation)

    def through(self, opening: float) -> "Problem":
        """The problem with rays through a part of pupil and field alone, and without the lens as built."""
        model = dataclasses.replace(self.model, opening=opening)
        return Problem(model, self.rows, self.conditions, **self._settings)

    def with_as_built(self, term: Expectation) -> "Problem":
        """The problem with the lens as built as a term."""
        return Problem(self.model, self.rows, self.conditions, as_built=term, **self._settings)

    def evaluated(self, x: np.ndarray, derivatives: bool = False) -> Evaluated:
        return self.evaluation(x, derivatives=derivatives)

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
    without evaluating. An evaluation at the variables of the last one is not repeated.
    """

    def __init__(
        self, model: DesignVariables, function: Callable[[Lens], Tensor], evaluated: Iterable[np.ndarray] = ()
    ):
        self.model, self.function, self.evaluations = model, function, 0
        self.last: np.ndarray | None = None
        self.evaluated: list[np.ndarray] = [*evaluated]
        self.known = {evaluation[: len(evaluation) // 2].tobytes(): evaluation for evaluation in self.evaluated}

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """The merit and its gradient (n,)."""
        x = np.array(x, dtype=float)
        if self.last is not None and x.tobytes() == self.last[: len(x)].tobytes():
            return float(self.last[len(x)]), self.last[len(x) + 1 :].copy()
        self.evaluations += 1
        if (known := self.known.get(x.tobytes())) is not None:
            self.last = known
            return float(known[len(x)]), known[len(x) + 1 :].copy()
        variables = torch.tensor(x, requires_grad=True)
        with torch.enable_grad():
            merit = self.function(self.model.lens_at(variables)).reshape(())
        slope = np.zeros(len(x))
        if merit.requires_grad:
            slope = torch.autograd.grad(merit, variables, materialize_grads=True)[0].numpy()
        value = float(merit.detach())
        self.last = np.array([*x, value, *slope])
        self.evaluated.append(self.last)
        return value, slope


def optimization_data_of(model: DesignVariables, rows: Sequence[Row], unit: float) -> OptimizationData:
    """Optimisation data of a lens whose file has none; all semi-diameters that it has stay specified."""
    given = tuple(k for k, surface in enumerate(model.lens.surfaces) if surface.semi_diameter)
    return OptimizationData(model.variables, model.solves, tuple(rows), unit, semi_diameters=given)


def _held(lens: Lens, rows: Sequence[Row], conditions: Sequence[Condition]) -> Iterator[tuple[Row, int]]:
    """Rows of conditions and the signs of their relations; rows before them set configuration and primary wavelength,
    where the merit function or a condition does."""
    if any(row.operand == "PRIM" for row in rows):
        yield Row("PRIM", (0, lens.primary_wavelength)), 0
    several = any(row.operand == "CONF" for row in rows) or any(condition.configuration for condition in conditions)
    for condition in conditions:
        if several:
            yield Row("CONF", (condition.configuration or lens.current_configuration, 0)), 0
        yield dataclasses.replace(condition.row, weight=-1.0), RELATIONS[condition.relation]


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
