"""Exact constraints of a training: the nearest lens that meets them, after every step of an optimiser.

Optimisers of trainings, such as Adam, know no constraints. From the variables x that such a step reached, the lens
moves to the nearest x′ that is buildable and meets the conditions of `hold`:

    min |x′ - x|²   with   c(x′) = 0,   g(x′) ≤ 0,   lower ≤ x′ ≤ upper

in units of the variables, by a sequence of quadratic programs (Nocedal and Wright, Numerical Optimization, 2006, §18).
Rays of the rim that miss a surface or are totally reflected are brought back: the amount by which they miss is a
further residual, which has a derivative where images have none.
"""

import dataclasses
import warnings
from collections.abc import Callable, Sequence

import numpy as np
import torch

from raytrace.optimization.least_squares import Linear, NoStep, Sides, State
from raytrace.optimization.optimize import EXACT, NotReached
from raytrace.optimization.problem import Condition, Problem
from raytrace.optimization.variables import Model, name_of
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row, Vary
from raytrace.words import calling_level

_STEPS = 30  # quadratic programs at most
_HALVES = 12  # of a step
_MET = 1e-8  # violation that is met, in units of the conditions, as mm
_PUPIL = ((0.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0))  # rays of every field that must arrive

#: x (n,), whether derivatives are requested -> excess (K,) over limits and its derivatives (K, n), or None.
Limits = Callable[[np.ndarray, bool], tuple[np.ndarray, np.ndarray | None]]


class Constraints:
    """Conditions on the variables of a lens.

    conditions: of constraint syntax; limits: further ones, or None; unit: (n,) of the variables; lower, upper: (n,).
    """

    def __init__(
        self,
        lens: Lens,
        variables: Sequence[Vary],
        conditions: Sequence[Condition],
        *,
        unit: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        limits: Limits | None = None,
    ):
        self.problem = Problem(Model(lens, tuple(variables)), [*_rays(lens)], conditions)
        self.conditions, self.names = tuple(conditions), tuple(map(name_of, variables))
        self.unit, self.lower, self.upper, self.limits = unit, lower, upper, limits

    def nearest(self, x: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
        """The nearest variables (n,) that meet all conditions; before: those of the last step, whose rays arrive.

        Rays that fail are brought back by their misses, or else by a shorter step. Warns NotReached for conditions that
        are not met.
        """
        wanted = np.clip(x, self.lower, self.upper)
        x, state = wanted, self._state(wanted, derivatives=False)
        for _ in range(_STEPS):
            if state.lost and (back := self._brought_back(x, state)) is not None:
                x, state = back
                wanted = x
                continue
            if state.lost and before is not None:
                x = wanted = self._shortened(before, x)
                state, before = self._state(x, derivatives=False), None
            if _violation(state) <= _MET or state.lost:
                break
            try:
                step = self._linear(x, wanted, state).step(1e-12)
            except NoStep:
                break
            x = np.clip(x + step, self.lower, self.upper)
            state = self._state(x, derivatives=False)
        self._warn(state)
        return x

    def _brought_back(self, x: np.ndarray, state: State) -> tuple[np.ndarray, State] | None:
        """A step towards the lens whose failed rays arrive, if there is one: fewer fail, or they miss by less."""
        step = self._linear(x, x, state).step(1e-12)
        rays = len(self.problem.rows)
        for _ in range(_HALVES):
            trial = np.clip(x + step, self.lower, self.upper)
            after = self._state(trial, derivatives=False)
            fewer = after.lost - state.lost, after.residuals[rays:].sum() - 0.99 * state.residuals[rays:].sum()
            if after.is_finite and (fewer[0] < 0 or (fewer[0] == 0 and fewer[1] < 0)):
                return trial, after
            step = 0.5 * step
        return None

    def _shortened(self, before: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The largest part of the step from `before` to x, of halves of halves, at which no ray fails."""
        if self._state(before, derivatives=False).lost:
            return x
        arrives = 0.0
        for k in range(1, _HALVES):
            trial = arrives + 0.5**k
            arrives = arrives if self._state(before + trial * (x - before), derivatives=False).lost else trial
        return before + arrives * (x - before)

    def _state(self, x: np.ndarray, *, derivatives: bool) -> State:
        state = self.problem.state(x, derivatives)
        if self.limits is None:
            return state
        excess, slope = self.limits(x, derivatives)
        state = dataclasses.replace(state, limits=np.concatenate([state.limits, excess]))
        if not derivatives:
            return state
        return dataclasses.replace(state, limits_slope=np.concatenate([state.limits_slope, slope]))

    def _linear(self, x: np.ndarray, wanted: np.ndarray, state: State) -> Linear:
        """The quadratic program at x: the distance from the wanted variables, or the misses of rays that fail."""
        lost, state = state.lost, self._state(x, derivatives=True)
        rays = len(self.problem.rows)
        distance = (x - wanted) / self.unit, np.diag(1 / self.unit)
        residuals, jacobian = (state.residuals[rays:], state.jacobian[rays:]) if lost else distance
        return Linear(
            residuals,
            jacobian,
            sides=Sides.none(len(x)),
            held=(state.held, state.held_slope),
            limits=(state.limits, state.limits_slope),
            lower=self.lower - x,
            upper=self.upper - x,
            scale=1 / self.unit,
        )

    def _warn(self, state: State) -> None:
        lost = f"{state.lost} rays of the rim fail" if state.lost else ""
        violation = _violation(state)
        beyond = f"conditions are violated by up to {violation:.3g}" if violation > EXACT else ""
        if words := " and ".join(filter(None, (beyond, lost))):
            held = ", ".join(f"{one.name}{one.relation}{one.row.target:g}" for one in self.conditions)
            advice = "vary more numbers, widen the bounds or take smaller steps"
            warnings.warn(f"constraints {held or 'of the lens'}: {words}; {advice}", NotReached, calling_level())


def _violation(state: State) -> float:
    return float(max(np.abs(state.held).max(initial=0.0), state.limits.max(initial=0.0)))


def _rays(lens: Lens):
    """A row for each ray of every field whose failure is brought back; their values do not count."""
    image = len(lens.surfaces) - 1
    x, y = lens.fields.x.detach(), lens.fields.y.detach()
    largest = float(torch.hypot(x, y).max()) or 1.0
    fields = {(float(a) / largest, float(b) / largest) for a, b in zip(x, y, strict=True)} | {(0.0, 0.0)}
    for field in sorted(fields):
        for pupil in _PUPIL:
            yield Row("REAR", (image, lens.primary_wavelength), (*field, *pupil), weight=1.0)
