"""Lifted losses: any differentiable function of a lens as a sum of squares, for damped least squares.

The loss L of a restored picture is one number, and damped least squares needs many. The rays of a spot merit function
lend their metric: with the derivatives J of their residuals, the length |J p| of a step p is the RMS blur it makes.
From M = JᵀJ and from pairs of steps p and changes y of the gradient g, the curvature of the loss is

    B = BFGS(c M; pairs),    c = pᵀy / pᵀM p,

and with RᵀR = B/2 and r = R⁻ᵀ g/2 the square of r + R p is L + gᵀp + pᵀB p/2 but for a constant: bounds, conditions
and the solver serve as for every other merit function. Damping holds the blur of a step small, λ c |J p|²/2, and not
the step of each variable alone: bendings that leave the spots as they are stay free. Steps are compared by the loss.

Changes of the gradient belong to L + λᵀh, h the equalities that are held and λ their multipliers: along a curved
equality the loss alone has another curvature. Pairs of negative curvature are bent towards B (Powell 1978).

Source: Côté, Tseng & Heide, ACM TOG 2026 (a loss lifted into residuals of rays); Nocedal & Wright, Numerical
Optimization, 2006, §6, §18.3 (BFGS, Powell's damping, Lagrangian).
"""

import dataclasses
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.linalg

from raytrace.optimization.least_squares import (
    Cycle,
    CycleStart,
    Descent,
    Evaluate,
    Sides,
    Slope,
    SolverOptions,
    SumOfSquares,
    least_squares,
)
from raytrace.psf_models import EmptyPsf

_PAIRS = 30  # of a step and a change of the gradient, that are kept
_FIRST = 0.2  # of the RMS spot: blur of the first undamped step
_FACTOR = 4.0  # by which c changes at most from one step to the next
_POWELL = 0.2  # least curvature of a pair, relative to B's
_RIDGE = 0.01  # of the blur by a variable alone: least blur of a step whose parts compensate each other
_SMALLEST = 1e-6  # of the RMS spot: blur of a step, below which its change of the gradient is rounding
_LEAST = 1e-8  # eigenvalue of B relative to the largest
_AGAIN = 1e-3  # relative decrease of the loss by a descent after which another one without pairs begins
_JUMP = 3.0  # of the RMS spot: blur of the displacement of a restart, and largest spot of the displaced lens
_HALVINGS = 20  # of the displacement, at most
#: Options of the solver: the residuals are a model without a second derivative along a step, and the last per mille of
#: a loss is worth no further hundred cycles.
OPTIONS = SolverOptions(bends=False, tolerance=3e-4)


@dataclasses.dataclass(frozen=True)
class LiftedLoss(SumOfSquares):
    """A loss and its conditions; residuals and jacobian: r and R of its quadratic model; loss: its value."""

    loss: float = np.nan

    @property
    def cost(self) -> float:
        return self.loss

    @property
    def merit(self) -> float:
        return self.loss

    @property
    def size(self) -> float:
        return float(np.sqrt(abs(self.loss)))


@dataclasses.dataclass(frozen=True)
class _Place:
    """Variables x (n,) at which the gradient (n,) of the loss and the slope (h, n) of the equalities are known."""

    x: np.ndarray
    gradient: np.ndarray
    slope: np.ndarray


class Lifted:
    """A loss of n variables within bounds, and its descents; `state` is the function of `least_squares`.

    function: x (n,) -> loss and gradient (n,); rows: the state of a merit function of rays, whose residuals are the
    metric, with the conditions; its boundaries are met exactly. lower, upper, typical: as for `least_squares`.
    """

    def __init__(
        self,
        function: Callable[[np.ndarray], Slope],
        rows: Callable[[np.ndarray, bool], SumOfSquares],
        *,
        lower: np.ndarray,
        upper: np.ndarray,
        typical: np.ndarray,
    ):
        self.function, self.rows = function, rows
        self.lower, self.upper, self.typical = lower, upper, typical
        self.places: deque[_Place] = deque(maxlen=_PAIRS + 1)
        self.scale: float | None = None

    def state(self, x: np.ndarray, derivatives: bool) -> LiftedLoss:
        rows = self.rows(x, derivatives)
        loss, gradient = self._evaluated(x)
        limits = np.concatenate([rows.limits, rows.sides.excess])
        state = LiftedLoss(x, np.zeros(0), rows.lost, Sides.none(len(x)), rows.held, limits, loss=loss)
        if not derivatives:
            return state
        blur, spot = self._metric(rows)
        self.places.append(_Place(x, gradient, rows.held_slope))
        values, axes = np.linalg.eigh(self._curvature(blur, spot))
        roots = np.sqrt(0.5 * np.maximum(values, _LEAST * values[-1]))
        return dataclasses.replace(
            state,
            residuals=0.5 * (axes.T @ _solved(blur, gradient)) / roots,
            jacobian=roots[:, None] * (axes.T @ blur),
            damper=np.sqrt(0.5 * (self.scale or 1.0)) * blur,
            held_slope=rows.held_slope,
            limits_slope=np.concatenate([rows.limits_slope, rows.sides.slope]),
        )

    def _evaluated(self, x: np.ndarray) -> Slope:
        """Loss and gradient (n,); inf and zeros where no light arrives, so that the trial lens is refused."""
        try:
            return self.function(x)
        except EmptyPsf:
            return np.inf, np.zeros(len(x))

    def _metric(self, rows: SumOfSquares) -> tuple[np.ndarray, float]:
        """The triangle U (n, n) of M = UᵀU, a step p of which makes an RMS blur |U p|, and the RMS spot."""
        spot, columns = float(np.linalg.norm(rows.residuals)), np.linalg.norm(rows.jacobian, axis=0)
        scale = np.hypot(columns, 1e-3 * spot / self.typical)
        scale = np.where(scale > 0, scale, 1.0)
        extended = np.vstack([rows.jacobian / scale, _RIDGE * np.eye(len(scale))])
        return np.linalg.qr(extended)[1] * scale, spot

    def _curvature(self, blur: np.ndarray, spot: float) -> np.ndarray:
        """B (n, n) at the last place, of steps U p."""
        pairs = [(blur @ step, _solved(blur, change)) for step, change in self._pairs()]
        pairs = [pair for pair in pairs if np.linalg.norm(pair[0]) > _SMALLEST * spot]
        if self.scale is None:
            steepness = float(np.linalg.norm(_solved(blur, self.places[-1].gradient)))
            self.scale = max(steepness / (_FIRST * spot), 1e-300) if spot > 0 else 1.0
        elif pairs:
            step, change = pairs[-1]
            along, moved = float(step @ change), float(step @ step)
            if along > 0 and moved > 0:
                self.scale = float(np.clip(along / moved, self.scale / _FACTOR, self.scale * _FACTOR))
        curvature = self.scale * np.eye(len(blur))
        for step, change in pairs:
            pull = curvature @ step
            least, along = step @ pull, step @ change
            if not least > 0:
                continue
            if along < _POWELL * least:
                share = (1 - _POWELL) * least / (least - along)
                change = share * change + (1 - share) * pull
                along = step @ change
            curvature = curvature - np.outer(pull, pull) / least + np.outer(change, change) / along
        return 0.5 * (curvature + curvature.T)

    def _pairs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Steps (n,) between successive places, and the changes (n,) of the gradient of the Lagrangian."""
        places = [*self.places]
        slope, gradient = places[-1].slope, places[-1].gradient
        multipliers = -np.linalg.lstsq(slope.T, gradient, rcond=None)[0] if len(slope) else np.zeros(0)
        pairs = []
        for before, after in pairwise(places):
            bend = (after.slope - before.slope).T @ multipliers
            pairs.append((after.x - before.x, after.gradient - before.gradient + bend))
        return pairs

    def forget(self) -> None:
        """Drop all pairs and the scale of the curvature."""
        self.places.clear()
        self.scale = None

    def memory(self) -> dict:
        """The scale of the curvature and the places of the pairs, as plain values for JSON."""
        return {
            "scale": self.scale,
            "places": [[part.tolist() for part in (place.x, place.gradient, place.slope)] for place in self.places],
        }

    def resume(self, memory: dict) -> None:
        """Continue with the curvature of a `memory`."""
        self.scale = memory["scale"]
        for x, gradient, slope in memory["places"]:
            self.places.append(_Place(np.array(x), np.array(gradient), np.array(slope).reshape(-1, len(x))))

    def displaced(self, x: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Variables from x in a random direction, within the bounds, as far as makes a blur of 3 RMS spots by the
        derivatives; half as far until the spot is at most 3 times as large and the loss is finite."""
        blur, spot = self._metric(self.rows(x, True))
        direction = random.standard_normal(len(x))
        step = _JUMP * spot / float(np.linalg.norm(direction)) * scipy.linalg.solve_triangular(blur, direction)
        for _ in range(_HALVINGS):
            near = np.clip(x + step, self.lower, self.upper)
            size = float(np.linalg.norm(self.rows(near, False).residuals))
            if size <= _JUMP * spot and np.isfinite(self._evaluated(near)[0]):
                return near
            step = 0.5 * step
        return x

    def minimise_rows(self, x: np.ndarray, *, cycles: int = 100, until: float = np.inf) -> Descent:
        """Descend from x to the minimum of the rows."""
        return self._least_squares(self.rows, x, cycles=cycles, until=until)

    def step(self, x: np.ndarray, damping: float) -> Descent:
        """One cycle from x, with the pairs of the cycles before."""
        return self._least_squares(self.state, x, options=dataclasses.replace(OPTIONS, damping=damping), cycles=1)

    def descend(
        self,
        x: np.ndarray,
        *,
        cycles: int,
        until: float = np.inf,
        watch: Callable[[Cycle, CycleStart], None] | None = None,
    ) -> Descent:
        """Descend from x: again and again without pairs, until that lowers the loss by nearly nothing.

        cycles, until: as for `least_squares`; watch: invoked after each cycle.
        """
        history: tuple[Cycle, ...] = ()
        evaluations, started, before = 0, time.monotonic(), np.inf
        while True:
            self.forget()
            offset = len(history), evaluations, time.monotonic() - started

            def counted(cycle: Cycle, offset: tuple[int, int, float] = offset) -> Cycle:
                number, evaluated, seconds = offset
                return dataclasses.replace(
                    cycle, number=cycle.number + number, evaluations=cycle.evaluations + evaluated,
                    seconds=cycle.seconds + seconds,
                )  # fmt: skip

            def each(cycle: Cycle, start: CycleStart, counted: Callable[[Cycle], Cycle] = counted) -> None:
                if watch is not None:
                    watch(counted(cycle), start)

            descent = self._least_squares(
                self.state, x, options=OPTIONS, cycles=cycles - len(history), until=until, watch=each
            )
            history, evaluations = (*history, *map(counted, descent.cycles)), evaluations + descent.evaluations
            x, end = descent.state.x, descent.state.cost
            ended = descent.stopped in ("gradient", "cycles", "seconds", "interrupted")
            if ended or before - end <= _AGAIN * abs(end):
                return dataclasses.replace(descent, cycles=history, evaluations=evaluations)
            before = end

    def _least_squares(self, evaluate: Evaluate, x: np.ndarray, **settings: Any) -> Descent:
        return least_squares(evaluate, x, lower=self.lower, upper=self.upper, typical=self.typical, **settings)


def _solved(blur: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """U⁻ᵀ g: a gradient by steps U p."""
    return scipy.linalg.solve_triangular(blur, gradient, trans="T")
