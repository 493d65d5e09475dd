"""Evaluation of the rows (operand, arguments, target, weight) of a merit function, with the Jacobian of all rows.

    M² = Σ w (v - t)² / Σ w

over rows with a weight. A row whose ray is lost counts as an error of `LOST` units.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from raytrace.maths.numerics import Dual, slope_of, value_of
from raytrace.optimization.context import SETTINGS, Evaluate, EvaluationContext, Line, Planner, RowValues
from raytrace.optimization.conventions import Conventions
from raytrace.optimization.lens_model import Model
from raytrace.optimization.operands.arguments import need, need_all
from raytrace.optimization.operands.arithmetic import in_order
from raytrace.optimization.operands.table import OPERANDS
from raytrace.system.optimization_data import Row

#: Error of a row whose ray is lost, in the row's unit.
LOST = 10.0


class UnknownOperand(ValueError):
    """A row with weight whose operand is not known."""


@dataclasses.dataclass(frozen=True)
class Evaluated:
    """A merit function at given variables.

    values: (R,) of all rows, nan for text and rows of unknown operands; lost: (R,) bool. residuals: (m,) whose squares
    sum up to M²; jacobian: (m, n) their derivatives by the variables; of_row: (m,) the row, from 0, of each.
    sides: of one-sided rows, whose residual is Σ max(0, e), by operand: the rows (K,), e (K,), by the variables (K, n),
    and the surfaces (K,).
    """

    values: np.ndarray
    lost: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray | None
    of_row: np.ndarray
    sides: tuple[tuple, ...] = ()

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
        conventions: Conventions | None = None,
    ):
        """unit: mm in the unit of length of the rows; conventions: of operands. Raises UnknownOperand."""
        self.model, self.rows, self.unit = model, tuple(rows), unit
        self.conventions = conventions or Conventions()
        self.groups: list[tuple[Planner, tuple[Line, ...], Evaluate]] = []
        self.planners: list[tuple[int, Planner]] = []
        self.skipped = tuple(self._plan(skip_unknown))
        self.units = np.array([unit ** OPERANDS[r.operand].length if r.operand in OPERANDS else 1.0 for r in self.rows])
        counted = np.zeros(len(self.rows), dtype=bool)
        counted[[line.number - 1 for _, lines, _ in self.groups for line in lines]] = True
        self.weights = np.where(counted, [row.weight for row in self.rows], 0.0)
        total = self.weights[self.weights > 0].sum()
        self.factors = np.sqrt(np.abs(self.weights) / total) if total > 0 else np.zeros(len(self.rows))
        self.targets = np.array([row.target for row in self.rows])

    def _plan(self, skip_unknown: bool) -> list[int]:
        """Plan all rows, those of arithmetic last and in the order of their references. Returns the skipped rows."""
        placed = {line.number: (settings, line) for settings, line in self._lines()}
        referred, skipped = self._referred(placed, skip_unknown)
        planners: dict[tuple[int, int], Planner] = {}
        groups: dict[tuple, list[Line]] = {}
        order = [number for number in placed if number not in referred] + in_order(referred)
        for number in (number for number in order if number not in skipped):
            settings, line = placed[number]
            operand = OPERANDS[line.row.operand]
            if settings not in planners:
                configuration, primary = settings
                view = self.model.views[configuration - 1]
                planners[settings] = Planner(view, primary, self.conventions, self.unit, self.rows)
            need_all(line, operand, planners[settings].lens)
            groups.setdefault((settings, line.row.operand, number if operand.refers else 0), []).append(line)
        for (settings, name, _), lines in groups.items():
            planner = planners[settings]
            self.groups.append((planner, tuple(lines), OPERANDS[name].plan(lines, planner)))
        self.planners = [(configuration, planner) for (configuration, _), planner in planners.items()]
        #: Rows that others take values of.
        self.needed = frozenset(row for rows in referred.values() for row in rows)
        #: Rows with a weight, and all that rows of arithmetic among them take values of.
        self.counted: set[int] = set()
        left = [number for number, row in enumerate(self.rows, 1) if row.weight != 0]
        while left:
            number = left.pop()
            if number not in self.counted:
                self.counted.add(number)
                left += referred.get(number, ())
        return sorted(skipped)

    def _lines(self):
        """Rows that have a value, each with the configuration and the primary wavelength of the settings above it."""
        lens = self.model.lens
        configuration, primary = lens.current_configuration, lens.primary_wavelength - 1
        for number, row in enumerate(self.rows, 1):
            line = Line(number, row, row.integers[1] - 1 if row.integers[1] > 0 else primary)
            if row.operand == "CONF":
                configuration = need(line, "configuration", row.integers[0], lens)
            elif row.operand == "PRIM":
                primary = need(line, "primary", row.integers[1], lens) - 1
            elif row.operand not in SETTINGS:
                yield (configuration, primary), line

    def _referred(self, placed: dict, skip_unknown: bool) -> tuple[dict[int, Sequence[int]], set[int]]:
        """The rows that each row of arithmetic takes values of, and the rows that cannot be evaluated."""
        referred, skipped = {}, set()

        def skip(line: Line, why: str) -> None:
            if line.row.weight != 0 and not skip_unknown:
                raise UnknownOperand(
                    f"row {line.number} of the merit function: {why}; `skip_unknown` leaves such rows out"
                )
            skipped.add(line.number)

        for number, (_, line) in placed.items():
            name = line.row.operand
            if name not in OPERANDS:
                skip(line, f"operand {name} is not known")
            elif OPERANDS[name].refers:
                referred[number] = OPERANDS[name].refers(line, self.rows)
        for number in in_order(referred):
            if missing := skipped.intersection(referred[number]):
                line, first = placed[number][1], min(missing)
                value = f"the value of row {first}, {self.rows[first - 1].operand}, which has none"
                skip(line, f"{line.row.operand} takes {value}")
        return referred, skipped

    def __call__(self, variables: np.ndarray, *, derivatives: bool = False, shown: bool = True) -> Evaluated:
        """All rows at variables; derivatives: with the Jacobian; shown: also operands without a row that counts."""
        count = len(variables)
        x = Dual(np.asarray(variables, dtype=float), np.eye(count)) if derivatives else np.asarray(variables, float)
        values, residuals, slopes, of_row = np.full(len(self.rows), np.nan), [], [], []
        numbers, sides = {}, []
        states = {configuration: self.model.views[configuration - 1].state(x) for configuration, _ in self.planners}
        contexts = {
            id(planner): EvaluationContext(planner, states[configuration], numbers)
            for configuration, planner in self.planners
        }
        for planner, lines, evaluate in self.groups:
            if not (shown or any(line.number in self.counted for line in lines)):
                continue
            places = np.array([line.number - 1 for line in lines])
            units = self.units[places]
            group = evaluate(contexts[id(planner)])
            sides += self._sides(group, places, units, count if derivatives else None)
            all_values, parts = group.values / units, [part / units for part in group.parts]
            values[places] = value_of(all_values)
            numbers |= {line.number: all_values[k] for k, line in enumerate(lines) if line.number in self.needed}
            counted = self.factors[places] > 0
            in_parts = counted & bool(parts) & (self.targets[places] == 0)
            targets = self.targets[places]
            for number, chosen, target in (
                (all_values, counted & ~in_parts, targets),
                *((part, in_parts, np.zeros_like(targets)) for part in parts),
            ):
                if not chosen.any():
                    continue
                factor = self.factors[places][chosen]
                errors = factor * (value_of(number)[..., chosen] - target[chosen])
                residuals.append(errors.ravel())
                if derivatives:
                    slopes.append((factor * slope_of(number, count)[..., chosen]).reshape(count, -1).T)
                of_row.append(np.broadcast_to(places[chosen], errors.shape).ravel())
        of_row = np.concatenate(of_row) if of_row else np.zeros(0, dtype=int)
        residual = np.concatenate(residuals) if residuals else np.zeros(0)
        gone = ~np.isfinite(residual)
        parts = np.bincount(of_row, minlength=len(self.rows))[of_row]
        residual = np.where(gone, LOST * self.factors[of_row] / np.sqrt(np.maximum(parts, 1)), residual)
        jacobian = None
        if derivatives:
            jacobian = np.concatenate(slopes) if slopes else np.zeros((0, count))
            jacobian = np.where(gone[:, None], 0.0, jacobian)
        lost = np.zeros(len(self.rows), dtype=bool)
        lost[of_row[gone]] = True
        return Evaluated(values, lost, residual, jacobian, of_row, tuple(sides))

    def _sides(self, group: RowValues, places: np.ndarray, units: np.ndarray, count: int | None):
        """One-sided rows of an operand, as in `Evaluated.sides`, except those that are nan."""
        if not group.sides:
            return
        rows, excess, surfaces = group.sides
        undefined = np.bincount(rows, np.isnan(value_of(excess)), minlength=len(places)) > 0
        chosen = (self.factors[places] > 0)[rows] & ~undefined[rows]
        if chosen.any():
            scale = (self.factors[places] / units)[rows[chosen]]
            slope = None if count is None else (scale * slope_of(excess, count)[:, chosen]).T
            yield places[rows[chosen]], scale * value_of(excess)[chosen], slope, surfaces[chosen]
