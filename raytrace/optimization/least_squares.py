"""Solvers: damped least squares under bounds and conditions, descents with several dampings; L-BFGS-B of tensors.

Each cycle of `least_squares` takes the exact Jacobian J of the residuals r, scales variables by its columns and tries
the step of the damped linear model, bent by the second derivative along it (geodesic acceleration). The ratio of the
achieved to the predicted reduction sets the damping of the next cycle.

    minimum of |J p + r|² + λ |D p|² + Σ (Σ max(0, e + E p))²    where  A p = -c  and  lower ≤ p ≤ upper, G p ≤ g

The inner sum is over the sides of one row: requirements e ≤ 0 that cost nothing while they are met. Equalities leave
their null space; inequalities make a problem of least distance, solved by non-negative least squares.

A merit function has several minima; the one reached depends on the damping. `best_of_paths` descends from one start
with several settings of the damping and returns the best end.

Source: Levenberg 1944, Marquardt 1963, Moré 1978 (scaling); Nielsen 1999 (damping by the gain); Transtrum & Sethna 2012
(geodesic acceleration); Lawson & Hanson, Solving Least Squares Problems, 1974, ch. 20, 23; Byrd, Lu, Nocedal & Zhu 1995
(L-BFGS-B).
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import scipy.optimize
import torch
from scipy.optimize import nnls
from torch import Tensor

from raytrace.words import RaytraceError, RaytraceWarning

_SHARED = 1e-5  # weight of the single sides of a row relative to their sum, which alone does not distinguish them
_ROUNDS = 12  # in which inequalities that a step violates are added
_SLACK = 1e-11  # of the scaled step: violation of a condition that is tolerated


Arrays: TypeAlias = tuple[np.ndarray, np.ndarray]


class NoStep(RaytraceError, ValueError):
    """No step meets the conditions."""


@dataclasses.dataclass(frozen=True)
class Sides:
    """Requirements e ≤ 0: excess (K,), by the variables: slope (K, n); row (K,): those of one row are summed."""

    excess: np.ndarray
    slope: np.ndarray
    row: np.ndarray

    @property
    def sums(self) -> np.ndarray:
        """Σ max(0, e) by row."""
        return np.bincount(self.row, np.maximum(self.excess, 0.0)) if len(self.row) else np.zeros(0)

    def cost(self) -> float:
        """Σ (Σ max(0, e))²"""
        sums = self.sums
        return float(sums @ sums)

    def at(self, step: np.ndarray) -> "Sides":
        return Sides(self.excess + self.slope @ step, self.slope, self.row)

    @classmethod
    def none(cls, count: int) -> "Sides":
        return cls(np.zeros(0), np.zeros((0, count)), np.zeros(0, dtype=int))


class Linear:
    """The model at a point. residuals (m,), jacobian (m, n); sides; held (h,) = 0 and its slope (h, n).

    lower, upper: (n,) of the step; limits (l,) ≤ 0 and their slope (l, n); scale: D (n,); damper: (k, n), of
    which damping holds |damper p| small, by default the diagonal matrix of D.
    """

    def __init__(
        self,
        residuals: np.ndarray,
        jacobian: np.ndarray,
        *,
        sides: Sides,
        held: Arrays,
        limits: Arrays,
        lower: np.ndarray,
        upper: np.ndarray,
        scale: np.ndarray,
        damper: np.ndarray | None = None,
    ):
        self.scale = scale
        self.damper = np.eye(len(scale)) if damper is None else damper / scale
        scaled = jacobian / scale
        if len(scaled) > len(scale):
            basis, self.triangle = np.linalg.qr(scaled)
            self.start = basis.T @ residuals
        else:
            self.triangle, self.start = scaled, residuals
        self.gradient = self.triangle.T @ self.start
        self.sides = Sides(sides.excess, sides.slope / scale, sides.row)
        self.held = held[0], held[1] / scale
        unit = np.eye(len(scale))
        finite = [np.isfinite(bound) for bound in (lower, upper)]
        self.conditions = np.concatenate([unit[finite[0]], -unit[finite[1]], -limits[1] / scale])
        self.least = np.concatenate([(lower * scale)[finite[0]], (-upper * scale)[finite[1]], limits[0]])

    def value(self, y: np.ndarray) -> float:
        """The undamped model, without the part that no step changes."""
        smooth = self.triangle @ y + self.start
        return float(smooth @ smooth) + self.sides.at(y).cost()

    def steepness(self) -> float:
        """The largest component of the gradient that conditions leave free, by a variable of unit column."""
        pull = np.where(self.sides.excess > 0, self.sides.sums[self.sides.row], 0.0)
        total = self.gradient + self.sides.slope.T @ pull
        _, free = _of_equalities(self.held[1], self.held[0])
        total = total - (total - free @ (free.T @ total))
        active = self.least >= -_SLACK
        if active.any():  # active inequalities carry the component that pushes against them
            carried, _ = nnls(self.conditions[active].T, total)
            total = total - self.conditions[active].T @ carried
        return float(np.abs(total).max(initial=0.0))

    def bend(self, second: np.ndarray, damping: float) -> np.ndarray:
        """-(JᵀJ + λ D²)⁻¹ of D⁻¹ Jᵀ r″, in the space that equalities and active bounds leave free."""
        _, triangle = np.linalg.qr(np.vstack([self.triangle, np.sqrt(damping) * self.damper]))
        active = self.least >= -_SLACK
        _, free = _of_equalities(
            np.vstack([self.held[1], self.conditions[active]]), np.zeros(len(self.held[0]) + active.sum())
        )
        matrix = triangle @ free
        normal = matrix.T @ matrix
        return -(free @ np.linalg.lstsq(normal, free.T @ second, rcond=None)[0]) / self.scale

    def correction(self, held: np.ndarray) -> np.ndarray:
        """The shortest step that lowers equalities by so much."""
        return _of_equalities(self.held[1], held)[0] / self.scale

    def step(self, damping: float, share: float = 1.0) -> np.ndarray:
        """The step (n,); share: part of the violation of equalities and limits that the step removes. Raises NoStep."""
        basis, triangle = np.linalg.qr(np.vstack([self.triangle, np.sqrt(damping) * self.damper]))
        target = -basis[: len(self.start)].T @ self.start
        base, free = _of_equalities(self.held[1], -share * self.held[0])
        least = np.where(self.least > 0, share * self.least, self.least)
        active = np.zeros(len(least), dtype=bool)
        switched = self.sides.excess > 0
        for _ in range(_ROUNDS):
            y = self._under(triangle, target, base, free, active, least, switched)
            broken = self.conditions @ y < least - _SLACK
            crossed = self.sides.at(y).excess > 0
            if not (broken & ~active).any() and not (crossed & ~switched).any():
                break
            active, switched = active | broken, switched | crossed
        return y / self.scale

    def _under(
        self,
        triangle: np.ndarray,
        target: np.ndarray,
        base: np.ndarray,
        free: np.ndarray,
        active: np.ndarray,
        least: np.ndarray,
        switched: np.ndarray,
    ) -> np.ndarray:
        """The minimum of the damped model under the active conditions and sides."""
        matrix, right = triangle @ free, target - triangle @ base
        conditions, bound = self.conditions[active] @ free, (least - self.conditions @ base)[active]
        if not active.any() and not switched.any():
            if not matrix.shape[1]:
                return base
            return base + free @ np.linalg.lstsq(matrix, right, rcond=None)[0]
        side = self.sides
        rows = np.unique(side.row[switched])
        sums = (side.row[switched] == rows[:, None]).astype(float)
        single, width = sums.shape[1], free.shape[1]
        extended = np.block(
            [
                [matrix, np.zeros((len(matrix), single))],
                [np.zeros((len(sums), width)), sums],
                [np.zeros((single, width)), _SHARED * np.eye(single)],
            ]
        )
        slopes, excess = side.slope[switched] @ free, (side.excess + side.slope @ base)[switched]
        needs = np.block(
            [
                [conditions, np.zeros((len(conditions), single))],
                [-slopes, np.eye(single)],
                [np.zeros((single, width)), np.eye(single)],
            ]
        )
        right = np.concatenate([right, np.zeros(len(sums) + single)])
        end = _least_under(extended, right, needs, np.concatenate([bound, excess, np.zeros(single)]))
        return base + free @ end[:width]


def _of_equalities(matrix: np.ndarray, right: np.ndarray) -> Arrays:
    """The shortest step that meets equalities as well as possible, and a basis (n, f) of their null space."""
    count = matrix.shape[1]
    if not len(matrix):
        return np.zeros(count), np.eye(count)
    left, values, rest = np.linalg.svd(matrix)
    rank = int((values > 1e-12 * max(values[0], 1e-300)).sum())
    return rest[:rank].T @ ((left[:, :rank].T @ right) / values[:rank]), rest[rank:].T


def _least_under(matrix: np.ndarray, right: np.ndarray, needs: np.ndarray, least: np.ndarray) -> np.ndarray:
    """The minimum of |matrix u - right| where needs u ≥ least; matrix of full column rank. Raises NoStep.

    With z = R u - Qᵀ right it is the shortest z where needs R⁻¹ z ≥ least - needs R⁻¹ Qᵀ right.
    """
    basis, triangle = np.linalg.qr(matrix)
    free = basis.T @ right
    reach = np.linalg.solve(triangle.T, needs.T).T
    lengths = np.maximum(np.linalg.norm(reach, axis=1), 1e-300)
    reach, bound = reach / lengths[:, None], (least - reach @ free) / lengths
    return np.linalg.solve(triangle, free + _shortest(reach, bound))


def _shortest(reach: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """The shortest z where reach z ≥ bound; rows of reach have length 1."""
    if not (bound > 0).any():
        return np.zeros(reach.shape[1])
    size = bound[bound > 0].max()
    dual = np.vstack([reach.T, bound / size])
    goal = np.zeros(len(dual))
    goal[-1] = 1.0
    multipliers, _ = nnls(dual, goal, maxiter=30 * len(bound) + 100)
    rest = dual @ multipliers - goal
    if -rest[-1] < 1e-13:
        raise NoStep
    z = -size * rest[:-1] / rest[-1]
    met = multipliers > 0  # exactly, where these alone determine it
    polished = np.linalg.lstsq(reach[met], bound[met], rcond=None)[0]
    return polished if (reach @ polished >= bound - 1e-9 * size).all() else z


# -- damped least squares ----------------------------------------------------------------------------------------------

_BEND = 0.75  # maximum acceleration relative to the velocity
_PROBE = 0.1  # of the velocity, over which its change is measured
_ACCEPT = 1e-4  # minimum gain of a step: achieved over predicted reduction
_TRIES = 40  # of steps in one cycle
_FLAT = 1e-10  # cosine between the residuals and any column of the Jacobian at a minimum
_STILL = 1e-13  # a step relative to the variables
_ROUNDING = 1e-14  # of the merit's square: minimum predicted reduction of a step
_IDLE = 8  # cycles over which the merit must have changed
_MET = 1e-11  # conditions relative to their scale
_UNLIMITED = 500  # cycles of a path without other limits: along a narrow valley a merit may fall for ever


@dataclasses.dataclass(frozen=True)
class SumOfSquares:
    """A sum of squares and its conditions at x (n,): residuals (m,), sides, held (h,) = 0 and limits (l,) ≤ 0.

    lost: number of failed rays; jacobian, held_slope, limits_slope: derivatives, empty unless requested; damper: as of
    `Linear`.
    """

    x: np.ndarray
    residuals: np.ndarray
    lost: int
    sides: Sides
    held: np.ndarray
    limits: np.ndarray
    jacobian: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    held_slope: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    limits_slope: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    damper: np.ndarray | None = None

    @property
    def cost(self) -> float:
        """What a descent lowers."""
        return float(self.residuals @ self.residuals) + self.sides.cost()

    @property
    def merit(self) -> float:
        """The cost as it is reported."""
        return float(np.sqrt(self.cost))

    @property
    def size(self) -> float:
        """The scale of the residuals."""
        return float(np.sqrt(self.cost))

    @property
    def missed(self) -> np.ndarray:
        """Violation of each condition."""
        return np.concatenate([np.abs(self.held), np.maximum(self.limits, 0.0)])

    @property
    def is_finite(self) -> bool:
        return bool(np.isfinite(self.cost) and np.isfinite(self.held).all() and np.isfinite(self.limits).all())

    def is_better(self, other: "SumOfSquares") -> bool:
        """Fewer failed rays, then conditions met, then a lower merit."""
        missed = [float(state.missed.max(initial=0.0)) for state in (self, other)]
        ranks = [
            (state.lost, m if m > 1e-8 else 0.0, state.cost) for state, m in zip((self, other), missed, strict=True)
        ]
        return ranks[0] < ranks[1]


@dataclasses.dataclass(frozen=True)
class Cycle:
    """Report of a cycle: its number, the merit, the largest violation of a condition, the step, and active limits."""

    number: int
    merit: float
    missed: float
    step: float
    damping: float
    evaluations: int
    seconds: float
    limits: str = ""


@dataclasses.dataclass(frozen=True)
class CycleStart:
    """All that determines the next cycle.

    x: the variables (n,); damping, and factor by which it is raised next; share: of violated conditions that a step
    removes, and their price; scale: of the variables (n,); evaluations and cycles so far.
    """

    x: np.ndarray
    damping: float
    factor: float
    share: float
    price: float
    scale: np.ndarray
    evaluations: int
    cycles: tuple[Cycle, ...]


@dataclasses.dataclass(frozen=True)
class Descent:
    """The state in which a descent ended, and the reason."""

    state: SumOfSquares
    stopped: str
    cycles: tuple[Cycle, ...]
    evaluations: int


Evaluate = Callable[[np.ndarray, bool], SumOfSquares]


@dataclasses.dataclass(frozen=True)
class SolverOptions:
    """damping: at the start; raised, lowered: factors, the latter the smallest; bends: with geodesic acceleration;
    keeps: scales of variables never decrease. Other options may lead to another minimum."""

    damping: float = 1e-3
    raised: float = 2.0
    lowered: float = 0.2
    bends: bool = True
    keeps: bool = False
    tolerance: float = 1e-8
    floor: float = 0.01


#: Options of the paths, in the order in which they are tried; the first is the fastest.
PATHS = (
    SolverOptions(),
    SolverOptions(damping=1.0, lowered=0.5),
    SolverOptions(damping=1e-2, bends=False, keeps=True),
)


def least_squares(
    evaluate: Evaluate,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    options: SolverOptions = SolverOptions(),
    cycles: int = 1000,
    until: float = np.inf,
    watch: Callable[[Cycle, CycleStart], None] | None = None,
    resume: CycleStart | None = None,
) -> Descent:
    """Descend from x, which is within the bounds, for at most so many cycles, or until a time of `time.monotonic`.

    No evaluation starts that would not end in time, as long as the last of its kind took. watch: invoked after each
    cycle; resume: state of an earlier descent, which is resumed bit-identically: cycles count from its start.
    A KeyboardInterrupt ends with the best state.
    """
    typical = np.full(len(x), np.inf) if typical is None else typical
    return _LeastSquares(evaluate, lower, upper, typical, options, until, watch).descend(x, cycles, resume)


class _OutOfTime(Exception):
    """The next evaluation would not end in time."""


class _LeastSquares:
    state: SumOfSquares

    def __init__(
        self,
        evaluate: Evaluate,
        lower: np.ndarray,
        upper: np.ndarray,
        typical: np.ndarray,
        options: SolverOptions,
        until: float,
        watch: Callable[[Cycle, CycleStart], None] | None,
    ):
        self.evaluate, self.lower, self.upper, self.options = evaluate, lower, upper, options
        self.typical, self.until, self.watch = typical, until, watch
        self.evaluations, self.started = 0, time.monotonic()
        self.cycles: list[Cycle] = []
        self.damping, self.share, self.price = options.damping, 1.0, 0.0
        self.scale = np.zeros(len(lower))
        self.factor = 2.0
        self.seconds = {False: 0.0, True: 0.0}  # of the last evaluation without and with derivatives

    def at(self, x: np.ndarray, derivatives: bool = False) -> SumOfSquares:
        """The state at x. Raises _OutOfTime."""
        started = time.monotonic()
        if started + self.seconds[derivatives] > self.until:
            raise _OutOfTime
        self.evaluations += 1
        state = self.evaluate(x, derivatives)
        self.seconds[derivatives] = time.monotonic() - started
        return state

    def descend(self, x: np.ndarray, cycles: int, resume: CycleStart | None) -> Descent:
        if resume is not None:
            self.damping, self.factor, self.share = resume.damping, resume.factor, resume.share
            self.price, self.scale = resume.price, resume.scale
            self.evaluations, self.cycles = resume.evaluations, [*resume.cycles]
            self.started -= resume.cycles[-1].seconds if resume.cycles else 0.0
            x = resume.x
        try:
            self.state = self.at(x, True)
            self.evaluations -= resume is not None  # it was counted before
        except _OutOfTime:
            return Descent(self.evaluate(x, False), "seconds", tuple(self.cycles), self.evaluations)
        except KeyboardInterrupt:
            return Descent(self.evaluate(x, False), "interrupted", tuple(self.cycles), self.evaluations)
        stopped = self._idle() if resume is not None and len(self.cycles) < cycles else ""
        try:
            while not stopped:
                stopped = "cycles" if len(self.cycles) >= cycles else self._cycle(len(self.cycles) + 1)
        except _OutOfTime:
            stopped = "seconds"
        except KeyboardInterrupt:
            stopped = "interrupted"
        return Descent(self.state, stopped, tuple(self.cycles), self.evaluations)

    def _cycle(self, number: int) -> str:
        """Take one accepted step; the reason to stop, "" to continue. Raises _OutOfTime."""
        linear = self._linear()
        if self._is_flat(linear):
            return "gradient"
        for _ in range(_TRIES):
            is_missed = bool((self.state.missed > 1e-9).any())
            if (tried := self._try(linear)) is None:
                self._raise_damping(True)
                continue
            trial, step, predicted = tried
            if self.damping < 1 and predicted <= _ROUNDING * self.state.size**2 and not is_missed:
                return "gradient"
            if self._accepts(trial, predicted):
                try:
                    self.state = self.at(trial.x, True)
                except _OutOfTime:
                    self.state = trial  # its derivatives are not needed any more
                    self._report(number, step)
                    return "seconds"
                self._report(number, step)
                return self._idle()
            self._raise_damping(is_missed)
            if np.linalg.norm(self.scale * step) <= _STILL * (np.linalg.norm(self.scale * self.state.x) + 1e-300):
                return "step"
        return "step"

    def _raise_damping(self, halves_share: bool) -> None:
        self.damping, self.factor = self.damping * self.factor, 2 * self.factor
        self.share *= 0.5 if halves_share else 1.0

    def _linear(self) -> Linear:
        state = self.state
        columns = np.sqrt((state.jacobian**2).sum(0) + (state.sides.slope[state.sides.excess > 0] ** 2).sum(0))
        floor = self.options.floor * self.state.size / self.typical
        columns = np.sqrt(columns**2 + floor**2)
        columns = np.where(columns > 0, columns, 1.0)
        self.scale = np.maximum(columns, self.scale) if self.options.keeps else columns
        return Linear(
            state.residuals, state.jacobian, sides=state.sides, held=(state.held, state.held_slope),
            limits=(state.limits, state.limits_slope), lower=self.lower - state.x, upper=self.upper - state.x,
            scale=self.scale, damper=state.damper,
        )  # fmt: skip

    def _try(self, linear: Linear) -> tuple[SumOfSquares, np.ndarray, float] | None:
        """The state of a trial step, the step, and the predicted reduction; None where there is no step."""
        try:
            step = linear.step(self.damping, self.share)
        except NoStep:
            return None
        bent = self._bent(linear, step) if self.options.bends else step
        trial = self.at(np.clip(self.state.x + bent, self.lower, self.upper))
        if len(self.state.held) and trial.is_finite:
            trial = self._restored(linear, trial)
        predicted = linear.value(0 * step) - linear.value(step * self.scale)
        return trial, step, predicted

    def _bent(self, linear: Linear, step: np.ndarray) -> np.ndarray:
        """The step with half its acceleration -(JᵀJ + λ D²)⁻¹ Jᵀ r″, r″ the second derivative along it."""
        ahead = self.at(np.clip(self.state.x + _PROBE * step, self.lower, self.upper))
        if not ahead.is_finite or ahead.lost > self.state.lost or len(ahead.residuals) != len(self.state.residuals):
            return step
        change = (ahead.residuals - self.state.residuals) / _PROBE
        second = 2 / _PROBE * (change - self.state.jacobian @ step)
        bend = 0.5 * linear.bend(self.state.jacobian.T @ second / self.scale, self.damping)
        if 2 * np.linalg.norm(self.scale * bend) > _BEND * np.linalg.norm(self.scale * step):
            return step
        return step + bend

    def _restored(self, linear: Linear, trial: SumOfSquares) -> SumOfSquares:
        """The trial with nonlinear equalities met again after the step."""
        for _ in range(2):
            if np.abs(trial.held).max() <= _MET * max(np.abs(self.state.held).max(), 1e-3):
                break
            x = trial.x - linear.correction((1 - self.share) * -self.state.held + trial.held)
            again = self.at(np.clip(x, self.lower, self.upper))
            if not again.is_finite or np.abs(again.held).sum() > np.abs(trial.held).sum():
                break
            trial = again
        return trial

    def _accepts(self, trial: SumOfSquares, predicted: float) -> bool:
        """Whether a trial is accepted; sets the damping by the ratio of achieved to predicted reduction."""
        state = self.state
        if not trial.is_finite or trial.lost > state.lost:
            return False
        missed, left = state.missed.sum(), trial.missed.sum()
        if missed > 0 and left < missed:
            self.price = max(self.price, 2 * abs(min(predicted, 0.0)) / (missed - left))
        won = state.cost - trial.cost + self.price * (missed - left)
        predicted = predicted + self.price * missed * self.share
        if trial.lost < state.lost:
            return True
        gain = won / predicted if predicted > 0 else -1.0
        if not gain > _ACCEPT:
            return False
        if gain > 0.25:
            self.damping = max(self.damping * max(self.options.lowered, 1 - (2 * min(gain, 1.5) - 1) ** 3), 1e-15)
        self.factor, self.share = self.options.raised, min(1.0, 2 * self.share)
        return True

    def _is_flat(self, linear: Linear) -> bool:
        size = self.state.size
        if size == 0:
            return not self.state.missed.any()
        return linear.steepness() <= _FLAT * size and not (self.state.missed > 1e-9).any()

    def _idle(self) -> str:
        """ "merit" where it has not changed over some cycles."""
        last = self.cycles[-_IDLE - 1 :]
        if len(last) <= _IDLE or last[0].missed > max(1e-9, 1.01 * last[-1].missed):
            return ""
        reduction = last[0].merit - last[-1].merit
        return "merit" if reduction <= self.options.tolerance * abs(last[0].merit) else ""

    def _report(self, number: int, step: np.ndarray) -> None:
        state = self.state
        length = float(np.linalg.norm(self.scale * step))
        at_bound = int(((state.x <= self.lower) | (state.x >= self.upper)).sum())
        cycle = Cycle(
            number, state.merit, float(state.missed.max(initial=0.0)), length, self.damping,
            self.evaluations, time.monotonic() - self.started, f"{at_bound} at their bounds" if at_bound else "",
        )  # fmt: skip
        self.cycles.append(cycle)
        if self.watch is not None:
            self.watch(
                cycle,
                CycleStart(
                    state.x, self.damping, self.factor, self.share, self.price, self.scale, self.evaluations,
                    tuple(self.cycles),
                ),
            )  # fmt: skip


# -- several paths -----------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class BestDescent:
    """The best state, the cycles of all paths, and why the path of the best one ended."""

    state: SumOfSquares
    history: tuple[Cycle, ...]
    stopped: str
    cycles: int
    evaluations: int


@dataclasses.dataclass(frozen=True)
class PathProgress:
    """Progress of descents along several paths: number of the current path, from 0, its start, and where its next cycle
    starts; cycles and evaluations of the paths before it, and their best end (x, reason), None for the first path."""

    path: int
    start: np.ndarray
    solver: CycleStart
    before: tuple[Cycle, ...] = ()
    evaluations: int = 0
    best: tuple[np.ndarray, str] | None = None

    @property
    def history(self) -> tuple[Cycle, ...]:
        """The cycles of all paths."""
        return (*self.before, *_counted(self.solver.cycles, len(self.before), self.evaluations))


def _counted(cycles: Sequence[Cycle], before: int, evaluations: int) -> list[Cycle]:
    """Cycles of a path by their number in all paths; before, evaluations: cycles and evaluations of earlier paths."""
    return [
        dataclasses.replace(cycle, number=cycle.number + before, evaluations=cycle.evaluations + evaluations)
        for cycle in cycles
    ]


#: Cycles, evaluations and the best end of earlier paths, as of `PathProgress`.
_Earlier: TypeAlias = tuple[tuple[Cycle, ...], int, tuple[np.ndarray, str] | None]


def best_of_paths(
    evaluate: Evaluate,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    paths: int = 1,
    cycles: int | None = None,
    seconds: float | None = None,
    watch: Callable[[Cycle, PathProgress], None] | None = None,
    resume: PathProgress | None = None,
) -> BestDescent:
    """Descend from x within the bounds with the options of so many PATHS; cycles and seconds: of all of them together,
    by default 500 cycles each.

    watch: invoked after each cycle; resume: state of earlier paths: cycles count from their start.
    """
    until = time.monotonic() + (np.inf if seconds is None else seconds)
    most = cycles if cycles is not None else _UNLIMITED * max(1, paths) if seconds is None else 1_000_000
    first, evaluations = 0, 0
    solver: CycleStart | None = None
    history: tuple[Cycle, ...] = ()
    best: SumOfSquares | None = None
    stopped = ""
    if resume is not None:
        first, x, solver, history, evaluations = (
            resume.path, resume.start, resume.solver, resume.before, resume.evaluations,
        )  # fmt: skip
        if resume.best is not None:
            best, stopped = evaluate(resume.best[0], False), resume.best[1]
    for path in range(first, min(len(PATHS), max(1, paths))):
        earlier = history, evaluations, None if best is None else (best.x, stopped)

        def each(cycle: Cycle, solver: CycleStart, path: int = path, earlier: _Earlier = earlier) -> None:
            if watch is not None:
                progress = PathProgress(path, x, solver, *earlier)
                watch(_counted([cycle], len(progress.before), progress.evaluations)[0], progress)

        descent = least_squares(
            evaluate, x, lower=lower, upper=upper, typical=typical, options=PATHS[path], cycles=most - len(history),
            until=until, watch=each, resume=solver if path == first else None,
        )  # fmt: skip
        history = (*history, *_counted(descent.cycles, len(history), evaluations))
        evaluations += descent.evaluations
        if best is None or descent.state.is_better(best):
            best, stopped = descent.state, descent.stopped
        if descent.stopped in ("interrupted", "seconds") or len(history) >= most or time.monotonic() > until:
            stopped = descent.stopped if descent.stopped in ("interrupted", "cycles", "seconds") else stopped
            break
    assert best is not None  # there is a path
    return BestDescent(best, history, stopped, len(history), evaluations)


# -- L-BFGS-B ----------------------------------------------------------------------------------------------------------

_STEPS = 15_000


class NoOptimum(RaytraceWarning):
    """A descent ended where the error still falls, or contacts of spacers still move; its last point is used."""


Slope: TypeAlias = tuple[float, np.ndarray]  # a value and its gradient


def _lbfgsb(
    function: Callable[[np.ndarray], Slope],
    x: np.ndarray,
    scale: np.ndarray | float,
    bounds: np.ndarray | None,
    **options: float,
) -> Any:
    """scipy's L-BFGS-B on y = x / scale. function: x -> (value, gradient); bounds: (n, 2) of x, or None."""

    def scaled(y: np.ndarray) -> Slope:
        value, gradient = function(y * scale)
        return value, gradient * scale

    if bounds is not None:
        bounds = bounds / np.reshape(scale, (-1, 1))
    return scipy.optimize.minimize(scaled, x / scale, jac=True, method="L-BFGS-B", bounds=bounds, options=options)


@dataclasses.dataclass(frozen=True)
class TensorDescent:
    """values: of the function at every evaluation; at_end: for each number of the parameters, flattened, whether it is
    at a bound beyond which the function still falls; is_flat: the gradient was 0 at the start."""

    values: tuple[float, ...]
    at_end: tuple[bool, ...]
    is_flat: bool


def minimise_tensors(
    parameters: Sequence[Tensor],
    function: Callable[[], Tensor],
    *,
    steps: int = _STEPS,
    unit: float = 1.0,
    bounds: Sequence[tuple[float, float]] | None = None,
    tolerance: float = 1e-10,
) -> TensorDescent:
    """Bring parameters to the first minimum downhill of `function()`, with gradients by torch.

    unit: of the parameters, length of the first step; bounds: (lowest, highest) of each number; tolerance: relative
    change of the function below which it ends.
    """
    shapes = [p.shape for p in parameters]
    values: list[float] = []
    gradients: list[np.ndarray] = []
    ends = np.cumsum([shape.numel() for shape in shapes])[:-1]

    def put(x: np.ndarray) -> None:
        with torch.no_grad():
            for p, part in zip(parameters, np.split(x, ends), strict=True):
                p.copy_(torch.as_tensor(part).reshape(p.shape))

    def flat(tensors: Sequence[Tensor]) -> np.ndarray:
        return torch.cat([t.detach().flatten() for t in tensors]).double().numpy()

    def evaluate(x: np.ndarray) -> Slope:
        put(x)
        value = function()
        values.append(float(value.detach()))
        gradients.append(flat(torch.autograd.grad(value, list(parameters))))
        return values[-1], gradients[-1]

    limits = None if bounds is None else np.array(bounds, dtype=float)
    end = _lbfgsb(evaluate, flat(parameters), unit, limits, maxiter=steps, ftol=tolerance, gtol=1e-10)
    put(unit * end.x)
    if limits is None:
        at_end = np.zeros(len(end.x), dtype=bool)
    else:
        reached = np.where(end.jac > 0, limits[:, 0], limits[:, 1]) / unit
        at_end = (end.jac != 0) & np.isclose(end.x, reached, rtol=1e-9, atol=1e-9)
    return TensorDescent(tuple(values), tuple(at_end.tolist()), is_flat=not gradients[0].any())
