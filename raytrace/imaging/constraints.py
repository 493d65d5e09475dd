"""Exact constraints of a training: the nearest lens that meets them, after every step of an optimiser.

Optimisers of trainings, such as Adam, know no constraints. From the variables x that such a step reached, the lens
moves to the nearest x′ that is buildable and meets the conditions of `hold`:

    min |x′ - x|²   with   c(x′) = 0,   g(x′) ≤ 0,   lower ≤ x′ ≤ upper

in units of the variables, by a sequence of quadratic programs (Nocedal and Wright, Numerical Optimization, 2006, §18).
Rays of the rim that miss a surface or are totally reflected are brought back: the amount by which they miss is a
further limit, with a derivative, where images have none.
"""

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from raytrace.materials.glass import Glass
from raytrace.optimization.attained import EXACT, NotReached
from raytrace.optimization.conditions import Condition
from raytrace.optimization.glass_choice import Pool
from raytrace.optimization.least_squares import Linear, NoStep, Sides, SumOfSquares
from raytrace.optimization.problem import Problem
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.words import calling_level

_STEPS = 30  # quadratic programs at most
_HALVES = 12  # of a step
_FAR = 3.0  # times the step of the optimiser: constraints do not move the lens further
_INSIDE = 1e-3  # of the miss, by which a ray that is brought back is inside
_MET = 1e-8  # violation that is met, in units of the conditions, as mm
_PUPIL = ((0.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0))  # rays of every field that must arrive

#: x (n,), whether derivatives are requested -> excess (K,) over limits and its derivatives (K, n), or None.
FurtherLimits = Callable[[np.ndarray, bool], tuple[np.ndarray, np.ndarray | None]]


class GlassLimits:
    """Model glasses within the convex hull of catalog glasses, as further limits.

    start: numbers (k,) of the model glass behind each surface; columns: (n,) variables as pairs (surface, number of the
    glass), None for others.
    """

    def __init__(self, pool: Pool, start: dict[int, np.ndarray], columns: Sequence[tuple[int, int] | None]):
        self.pool, self.start, self.columns = pool, start, columns

    def numbers(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Numbers (k,) of every glass at variables (n,)."""
        numbers = {surface: start.copy() for surface, start in self.start.items()}
        for value, column in zip(x, self.columns, strict=True):
            if column is not None and column[1] < self.pool.count:
                numbers[column[0]][column[1]] = value
        return numbers

    def __call__(self, x: np.ndarray, derivatives: bool) -> tuple[np.ndarray, np.ndarray | None]:
        numbers = self.numbers(x)
        excess = np.concatenate([self.pool.normal @ glass - self.pool.reach for glass in numbers.values()])
        if not derivatives:
            return excess, None
        slope = np.zeros((len(numbers), len(self.pool.reach), len(x)))
        places = {surface: place for place, surface in enumerate(numbers)}
        for k, column in enumerate(self.columns):
            if column is not None and column[1] < self.pool.count:
                slope[places[column[0]], :, k] = self.pool.normal[:, column[1]]
        return excess, slope.reshape(-1, len(x))

    def nearest(self, x: np.ndarray) -> dict[int, Glass]:
        """The catalog glass behind each surface whose numbers are nearest, in units of the spread of the catalogs."""
        width = np.maximum(np.ptp(self.pool.numbers, axis=0), 1e-9)
        distance = {
            surface: (((self.pool.numbers - glass) / width) ** 2).sum(1) for surface, glass in self.numbers(x).items()
        }
        return {surface: self.pool.glasses[int(np.argmin(squares))] for surface, squares in distance.items()}


def joined_limits(limits: Sequence[FurtherLimits]) -> FurtherLimits | None:
    """All of several limits; None of none."""
    if not limits:
        return None

    def joined(x: np.ndarray, derivatives: bool) -> tuple[np.ndarray, np.ndarray | None]:
        excess, slopes = zip(*(limit(x, derivatives) for limit in limits), strict=True)
        return np.concatenate(excess), np.concatenate(slopes) if derivatives else None

    return joined


def with_limits(state: SumOfSquares, limits: FurtherLimits | None, x: np.ndarray, *, derivatives: bool) -> SumOfSquares:
    """The state of a problem with further limits."""
    if limits is None:
        return state
    excess, slope = limits(x, derivatives)
    state = dataclasses.replace(state, limits=np.concatenate([state.limits, excess]))
    if slope is None:
        return state
    return dataclasses.replace(state, limits_slope=np.concatenate([state.limits_slope, slope]))


class Constraints:
    """Conditions on design variables.

    conditions: of constraint syntax; limits: further ones, or None; unit: (n,) of the variables; lower, upper: (n,).
    """

    def __init__(
        self,
        design: DesignVariables,
        conditions: Sequence[Condition],
        *,
        unit: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        limits: FurtherLimits | None = None,
    ):
        self.problem = Problem(design, [*_rays(design.lens)], conditions)
        self.conditions, self.limits = tuple(conditions), limits
        self.unit, self.lower, self.upper = unit, lower, upper
        self._ends = lower, upper  # of the variables that move

    def nearest(
        self, x: np.ndarray, before: np.ndarray | None = None, *, fixed: np.ndarray | None = None
    ) -> np.ndarray:
        """The nearest variables (n,) that meet all conditions and lose no ray of the rim.

        fixed: (n,) bool, variables that do not move; before: those of the last step, which met the conditions: the
        step is shortened where the nearest ones are far away. Warns NotReached for conditions that are not met.
        """
        frozen = np.zeros(len(x), dtype=bool) if fixed is None else fixed
        self._ends = np.where(frozen, x, self.lower), np.where(frozen, x, self.upper)
        wanted = np.clip(x, *self._ends)
        x, state = self._met(wanted)
        is_far = before is not None and self._distance(x, wanted) > _FAR * self._distance(wanted, before)
        if before is not None and (state.lost or is_far):
            last = self._state(before, derivatives=False)
            if _violation(last) <= EXACT and not last.lost:
                x, state = self._met(self._shortened(before, wanted))
                if state.lost:
                    x, state = before, last
        self._warn(state)
        return x

    def _met(self, wanted: np.ndarray) -> tuple[np.ndarray, SumOfSquares]:
        """The end of the quadratic programs from the wanted variables on."""
        x, state = wanted, self._state(wanted, derivatives=False)
        for _ in range(_STEPS):
            if _violation(state) <= _MET and not state.lost:
                break
            try:
                step = self._linear(x, wanted).step(1e-12)
            except NoStep:
                break
            x = np.clip(x + step, *self._ends)
            state = self._state(x, derivatives=False)
        return x, state

    def _distance(self, x: np.ndarray, y: np.ndarray) -> float:
        return float(np.linalg.norm((x - y) / self.unit))

    def _shortened(self, before: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The largest part of the step from `before` to x, of halves of halves, at which no ray fails."""
        arrives = 0.0
        for k in range(1, _HALVES):
            trial = arrives + 0.5**k
            arrives = arrives if self._state(before + trial * (x - before), derivatives=False).lost else trial
        return before + arrives * (x - before)

    def _state(self, x: np.ndarray, *, derivatives: bool) -> SumOfSquares:
        return with_limits(self.problem.state(x, derivatives), self.limits, x, derivatives=derivatives)

    def _linear(self, x: np.ndarray, wanted: np.ndarray) -> Linear:
        """The quadratic program at x, in which failed rays miss by less than nothing."""
        state = self._state(x, derivatives=True)
        missed, slopes = self._missed(x) if state.lost else (np.zeros(0), np.zeros((0, len(x))))
        return Linear(
            (x - wanted) / self.unit,
            np.diag(1 / self.unit),
            sides=Sides.none(len(x)),
            held=(state.held, state.held_slope),
            limits=(
                np.concatenate([state.limits, missed + _INSIDE]),
                np.concatenate([state.limits_slope, slopes]),
            ),
            lower=self._ends[0] - x,
            upper=self._ends[1] - x,
            scale=1 / self.unit,
        )

    def _missed(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Amounts (K,) by which failed rays of the rim miss a surface, and their derivatives (K, n)."""
        rows = np.flatnonzero(self.problem.evaluated(x).lost)
        missed, slopes, _ = self.problem.recovery.excess(x, rows, derivatives=True)
        known = missed > 0
        return missed[known], slopes[known]

    def _warn(self, state: SumOfSquares) -> None:
        lost = f"{state.lost} rays of the rim fail" if state.lost else ""
        violation = _violation(state)
        beyond = f"conditions are violated by up to {violation:.3g}" if violation > EXACT else ""
        if words := " and ".join(filter(None, (beyond, lost))):
            held = ", ".join(f"{c.name}{c.relation}{c.row.target:g}" for c in self.conditions)
            advice = "vary more numbers, widen the bounds or take smaller steps"
            warnings.warn(f"constraints {held or 'of the lens'}: {words}; {advice}", NotReached, calling_level())


def _violation(state: SumOfSquares) -> float:
    return float(max(np.abs(state.held).max(initial=0.0), state.limits.max(initial=0.0)))


def _rays(lens: Lens) -> Iterator[Row]:
    """A row for each ray of every field whose failure is brought back; their values do not count."""
    image = len(lens.surfaces) - 1
    x, y = lens.fields.x.detach(), lens.fields.y.detach()
    largest = float(lens.fields.extent) or 1.0
    fields = {(float(a) / largest, float(b) / largest) for a, b in zip(x, y, strict=True)} | {(0.0, 0.0)}
    for field in sorted(fields):
        for pupil in _PUPIL:
            yield Row("REAR", (image, lens.primary_wavelength), (*field, *pupil), weight=1.0)
