"""Problem: the rows of a merit function over a model, as the sum of squares and conditions that a solver descends on.

Rows of positive weight are squared; rows of negative weight, and what is held, are conditions that are met exactly.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from raytrace.merit.hold import Condition as Condition
from raytrace.merit.merit import LOST, Evaluated, Evaluation
from raytrace.merit.model import Model
from raytrace.merit.readings import Readings
from raytrace.optimization.least_squares import State
from raytrace.optimization.lost import MARGIN, STEEP, Recovery
from raytrace.optimization.step import Sides
from raytrace.system.intent import Intent, Row
from raytrace.system.lens import Lens

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
        readings: Readings | None = None,
    ):
        """unit: mm in the unit of length of rows and conditions. Raises NoProblem and UnknownOperand."""
        held = tuple(_held(model.lens, rows, conditions))
        self._again = lambda model: Problem(
            model, rows, conditions, unit=unit, skip_unknown=skip_unknown, readings=readings
        )
        self.model, self.rows, self.unit, self.conditions = model, tuple(rows), unit, tuple(conditions)
        self.evaluation = Evaluation(
            model, (*rows, *(row for row, _ in held)), unit=unit, skip_unknown=skip_unknown, readings=readings
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


def intent_of(model: Model, rows: Sequence[Row], unit: float) -> Intent:
    """What a lens is optimised for, where its file says nothing of it; all semi-diameters that it has stay given."""
    given = tuple(k for k, surface in enumerate(model.lens.surfaces) if surface.semi_diameter)
    return Intent(model.variables, model.solves, tuple(rows), unit, semi_diameters=given)


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
    moment = model.views[model.lens.current_configuration - 1].moment(model.start)
    h = 0.5 * float(moment.entrance_pupil_diameter)
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
