"""Merit: what a lens is worth, as rows of (operand, arguments, target, weight), with the Jacobian of all rows.

    M² = Σ w (v - t)² / Σ w

over rows with a weight. A row whose ray is lost counts as an error of `LOST` units.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from raytrace.maths.dual import Dual, slope_of, value_of
from raytrace.merit.model import Model
from raytrace.merit.operands import OPERANDS, SETTINGS
from raytrace.merit.plan import Evaluate, Found, Line, Now, Planner, planner_of
from raytrace.merit.readings import Readings
from raytrace.system.intent import Row

#: Error of a row whose ray is lost, in the row's unit: as the stored merits of other programs are judged here.
LOST = 10.0


class UnknownOperand(ValueError):
    """A row with weight whose operand is not known, or that names what the lens does not have."""


@dataclasses.dataclass(frozen=True)
class Evaluated:
    """A merit function at given variables.

    values: (R,) of all rows, nan for text and rows of unknown operands; lost: (R,) bool. residuals: (m,) whose squares
    sum up to M²; jacobian: (m, n) their derivatives by the variables; of_row: (m,) the row, from 0, of each.
    """

    values: np.ndarray
    lost: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray | None
    of_row: np.ndarray

    @property
    def merit(self) -> float:
        return float(np.sqrt(self.residuals @ self.residuals))


class Evaluation:
    """The rows of a merit function over a model: planned once, then called with variables (n,)."""

    def __init__(
        self,
        model: Model,
        rows: Sequence[Row],
        *,
        unit: float = 1.0,
        skip_unknown: bool = False,
        readings: Readings | None = None,
    ):
        """unit: mm in the unit of length of the rows; readings: where operands are open. Raises UnknownOperand."""
        self.model, self.rows, self.unit = model, tuple(rows), unit
        self.readings = readings or Readings()
        self.groups: list[tuple[Planner, tuple[Line, ...], Evaluate]] = []
        self.planners: list[tuple[int, Planner]] = []
        self.skipped = tuple(self._plan(skip_unknown))
        self.units = np.array([unit ** OPERANDS[r.operand].length if r.operand in OPERANDS else 1.0 for r in self.rows])
        weights = np.array([row.weight for row in self.rows])
        counted = np.zeros(len(self.rows), dtype=bool)
        counted[[line.number - 1 for _, lines, _ in self.groups for line in lines]] = True
        self.weights = np.where(counted, weights, 0.0)
        total = self.weights[self.weights > 0].sum()
        self.factors = np.sqrt(np.abs(self.weights) / total) if total > 0 else np.zeros(len(self.rows))
        self.targets = np.array([row.target for row in self.rows])

    def _plan(self, skip_unknown: bool):
        """Plan all rows; yields those that are skipped."""
        lens = self.model.lens
        settings = configuration, primary = lens.current_configuration, lens.primary_wavelength
        planners: dict[tuple[int, int], Planner] = {}
        groups: dict[tuple, list[Line]] = {}
        for number, row in enumerate(self.rows, 1):
            if row.operand == "CONF":
                configuration = row.integers[0]
            elif row.operand == "PRIM":
                primary = row.integers[1] - 1
            elif row.operand in OPERANDS:
                settings = configuration, primary
                if settings not in planners:
                    planners[settings] = planner_of(self.model, *settings, self.readings, self.unit)
                wavelength = row.integers[1] - 1 if row.integers[1] > 0 else primary
                groups.setdefault((settings, row.operand), []).append(Line(number, row, wavelength))
            elif row.operand not in SETTINGS:
                if row.weight != 0 and not skip_unknown:
                    raise UnknownOperand(
                        f"row {number} of the merit function: operand {row.operand} is not known; "
                        "`skip_unknown` leaves such rows out"
                    )
                yield number
        for (settings, name), lines in groups.items():
            planner = planners[settings]
            self.groups.append((planner, tuple(lines), OPERANDS[name].plan(lines, planner)))
        self.planners = [(configuration, planner) for (configuration, _), planner in planners.items()]

    def __call__(self, variables: np.ndarray, *, derivatives: bool = False) -> Evaluated:
        """All rows there; derivatives: with the Jacobian."""
        count = len(variables)
        x = Dual(np.asarray(variables, dtype=float), np.eye(count)) if derivatives else np.asarray(variables, float)
        values, residuals, slopes, of_row = np.full(len(self.rows), np.nan), [], [], []
        found: dict[int, object] = {}
        moments = {configuration: self.model.views[configuration - 1].moment(x) for configuration, _ in self.planners}
        now = {id(planner): Now(planner, moments[configuration], found) for configuration, planner in self.planners}
        for planner, lines, evaluate in self.groups:
            places = np.array([line.number - 1 for line in lines])
            told = evaluate(now[id(planner)])
            units = self.units[places]
            told = Found(told.values / units, tuple(part / units for part in told.parts))
            values[places] = value_of(told.values)
            found |= {line.number: told.values[k] for k, line in enumerate(lines)} if self._refers else {}
            counted = self.factors[places] > 0
            in_parts = counted & bool(told.parts) & (self.targets[places] == 0)
            for number, chosen in [(told.values, counted & ~in_parts), *((part, in_parts) for part in told.parts)]:
                if not chosen.any():
                    continue
                factor = self.factors[places][chosen]
                target = self.targets[places][chosen] if number is told.values else 0.0
                residuals.append(factor * (value_of(number)[chosen] - target))
                if derivatives:
                    slopes.append((factor * slope_of(number, count)[:, chosen]).T)
                of_row.append(places[chosen])
        return self._evaluated(values, residuals, slopes if derivatives else None, of_row, count)

    @cached_property
    def _refers(self) -> bool:
        return False

    def _evaluated(self, values, residuals, slopes, of_row, count: int) -> Evaluated:
        of_row = np.concatenate(of_row) if of_row else np.zeros(0, dtype=int)
        residual = np.concatenate(residuals) if residuals else np.zeros(0)
        gone = np.isnan(residual)
        parts = np.bincount(of_row, minlength=len(self.rows))[of_row]
        residual = np.where(gone, LOST * self.factors[of_row] / np.sqrt(np.maximum(parts, 1)), residual)
        jacobian = None
        if slopes is not None:
            jacobian = np.concatenate(slopes) if slopes else np.zeros((0, count))
            jacobian = np.where(gone[:, None], 0.0, jacobian)
        lost = np.zeros(len(self.rows), dtype=bool)
        lost[of_row[gone]] = True
        return Evaluated(values, lost, residual, jacobian, of_row)
