"""Damped least squares: variables to where a sum of squares is least, under bounds and conditions.

Every cycle takes the exact Jacobian J of the residuals r, scales variables by its columns and tries the step of the
damped linear model, bent by the second derivative along it (geodesic acceleration); how much of what the
model foretold came true sets the damping of the next.

Source: Levenberg 1944, Marquardt 1963, Moré 1978; Nielsen 1999 (damping by the gain); Transtrum & Sethna 2012 (geodesic
acceleration).

Step: where a linear model of a merit function is least, damped, under linear conditions that are met exactly.

    least of |J p + r|² + λ |D p|² + Σ (Σ max(0, e + E p))²    where  A p = -c  and  lower ≤ p ≤ upper, G p ≤ g

The inner sum is over the sides of one row: requirements e ≤ 0 that cost nothing while they are met. Equalities leave
their null space; what is one-sided makes a problem of least distance, solved by non-negative least squares.

Source: Moré 1978 (scaling); Lawson & Hanson, Solving Least Squares Problems, 1974, ch. 20, 23.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls

_SHARED = 1e-5  # weight of the single sides of a row beside their sum, which alone does not tell them apart
_ROUNDS = 12  # in which one-sided conditions that a step breaks are taken up
_SLACK = 1e-11  # by which a condition may be missed in the scaled step before it counts as broken


class NoStep(ValueError):
    """No step meets the conditions."""


@dataclasses.dataclass(frozen=True)
class Sides:
    """Requirements e ≤ 0: excess (K,), by the variables: slope (K, n); row (K,): those of one row are summed."""

    excess: np.ndarray
    slope: np.ndarray
    row: np.ndarray

    def cost(self) -> float:
        """Σ (Σ max(0, e))²"""
        sums = np.bincount(self.row, np.maximum(self.excess, 0.0)) if len(self.row) else np.zeros(0)
        return float(sums @ sums)

    def at(self, step: np.ndarray) -> "Sides":
        return Sides(self.excess + self.slope @ step, self.slope, self.row)

    @classmethod
    def none(cls, count: int) -> "Sides":
        return cls(np.zeros(0), np.zeros((0, count)), np.zeros(0, dtype=int))


class Linear:
    """The model at a point. residuals (m,), jacobian (m, n); sides; held (h,) = 0 and its slope (h, n).

    lower, upper: (n,) of the step; limits (l,) ≤ 0 and their slope (l, n); scale: D (n,).
    """

    def __init__(self, residuals, jacobian, *, sides: Sides, held, limits, lower, upper, scale):
        self.scale = scale
        scaled = jacobian / scale
        if len(scaled) > len(scale):
            basis, self.triangle = np.linalg.qr(scaled)
            self.start = basis.T @ residuals
        else:
            self.triangle, self.start = scaled, residuals
        self.gradient = self.triangle.T @ self.start
        self.sides = Sides(sides.excess, sides.slope / scale, sides.row)
        self.held = held[0], held[1] / scale
        count = len(scale)
        finite = [np.isfinite(bound) for bound in (lower, upper)]
        self.conditions = np.concatenate([np.eye(count)[finite[0]], -np.eye(count)[finite[1]], -limits[1] / scale])
        self.least = np.concatenate([(lower * scale)[finite[0]], (-upper * scale)[finite[1]], limits[0]])

    def value(self, y: np.ndarray) -> float:
        """The model there, undamped, but for what no step changes."""
        smooth = self.triangle @ y + self.start
        return float(smooth @ smooth) + self.sides.at(y).cost()

    def steepness(self) -> float:
        """The longest part of the gradient, by a variable of unit column, that conditions leave free."""
        total = self.gradient + self.sides.slope.T @ self._pull()
        _, free = _of_equalities(self.held[1], self.held[0])
        total = total - (total - free @ (free.T @ total))
        at = self.least >= -_SLACK
        if at.any():  # what pushes against a condition is carried by it
            carried, _ = nnls(self.conditions[at].T, total)
            total = total - self.conditions[at].T @ carried
        return float(np.abs(total).max(initial=0.0))

    def _pull(self) -> np.ndarray:
        sums = np.bincount(self.sides.row, np.maximum(self.sides.excess, 0.0)) if len(self.sides.row) else np.zeros(0)
        return np.where(self.sides.excess > 0, sums[self.sides.row], 0.0)

    def bend(self, second: np.ndarray, damping: float) -> np.ndarray:
        """-(JᵀJ + λ D²)⁻¹ of D⁻¹ Jᵀ r″, along equalities and what the bounds leave free."""
        count = len(self.scale)
        _, triangle = np.linalg.qr(np.vstack([self.triangle, np.sqrt(damping) * np.eye(count)]))
        at = self.least >= -_SLACK
        _, free = _of_equalities(np.vstack([self.held[1], self.conditions[at]]), np.zeros(len(self.held[0]) + at.sum()))
        matrix = triangle @ free
        normal = matrix.T @ matrix
        return -(free @ np.linalg.lstsq(normal, free.T @ second, rcond=None)[0]) / self.scale

    def correction(self, held: np.ndarray) -> np.ndarray:
        """The shortest step that takes so much from what is held."""
        return _of_equalities(self.held[1], held)[0] / self.scale

    def step(self, damping: float, share: float = 1.0) -> np.ndarray:
        """The step (n,); share: how much of what equalities and limits miss it makes good. Raises NoStep."""
        count = len(self.scale)
        basis, triangle = np.linalg.qr(np.vstack([self.triangle, np.sqrt(damping) * np.eye(count)]))
        target = -basis[: len(self.start)].T @ self.start
        base, free = _of_equalities(self.held[1], -share * self.held[0])
        least = np.where(self.least > 0, share * self.least, self.least)
        taken = np.zeros(len(least), dtype=bool)
        switched = self.sides.excess > 0
        for _ in range(_ROUNDS):
            y = self._under(triangle, target, base, free, taken, least, switched)
            broken = self.conditions @ y < least - _SLACK
            crossed = self.sides.at(y).excess > 0
            if not (broken & ~taken).any() and not (crossed & ~switched).any():
                break
            taken, switched = taken | broken, switched | crossed
        return y / self.scale

    def _under(self, triangle, target, base, free, taken, least, switched) -> np.ndarray:
        """The least of the damped model under the conditions and sides that are taken up."""
        matrix, right = triangle @ free, target - triangle @ base
        conditions, bound = self.conditions[taken] @ free, (least - self.conditions @ base)[taken]
        if not taken.any() and not switched.any():
            return base + free @ _least_squares(matrix, right)
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
        found = least_under(extended, right, needs, np.concatenate([bound, excess, np.zeros(single)]))
        return base + free @ found[:width]


def _of_equalities(matrix: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The shortest step that meets equalities as well as it can, and a basis (n, f) of what they leave free."""
    count = matrix.shape[1]
    if not len(matrix):
        return np.zeros(count), np.eye(count)
    left, values, rest = np.linalg.svd(matrix)
    rank = int((values > 1e-12 * max(values[0], 1e-300)).sum())
    return rest[:rank].T @ ((left[:, :rank].T @ right) / values[:rank]), rest[rank:].T


def _least_squares(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(matrix, right, rcond=None)[0] if matrix.shape[1] else np.zeros(0)


def least_under(matrix: np.ndarray, right: np.ndarray, needs: np.ndarray, least: np.ndarray) -> np.ndarray:
    """The least of |matrix u - right| where needs u ≥ least; matrix of full column rank. Raises NoStep.

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
    met = multipliers > 0  # exactly, where those alone tell it
    polished = np.linalg.lstsq(reach[met], bound[met], rcond=None)[0]
    return polished if (reach @ polished >= bound - 1e-9 * size).all() else z


_BEND = 0.75  # the longest acceleration beside the velocity
_PROBE = 0.1  # of the velocity, over which its change is measured
_ACCEPT = 1e-4  # the least gain of a step, as part of what was foretold
_TRIES = 40  # of steps in one cycle
_FLAT = 1e-10  # cosine between the residuals and any column of the Jacobian at a minimum
_STILL = 1e-13  # a step as part of the variables
_ROUNDING = 1e-14  # of the merit's square: what a step must at least foretell
_IDLE = 8  # cycles over which the merit must have changed
_MET = 1e-11  # conditions as part of their own scale


@dataclasses.dataclass(frozen=True)
class State:
    """A sum of squares and its conditions at x (n,): residuals (m,), sides, held (h,) = 0 and limits (l,) ≤ 0.

    lost: how many rays are; jacobian, held_slope, limits_slope: derivatives, None where none were asked for.
    """

    x: np.ndarray
    residuals: np.ndarray
    lost: int
    sides: Sides
    held: np.ndarray
    limits: np.ndarray
    jacobian: np.ndarray | None = None
    held_slope: np.ndarray | None = None
    limits_slope: np.ndarray | None = None

    @property
    def cost(self) -> float:
        return float(self.residuals @ self.residuals) + self.sides.cost()

    @property
    def missed(self) -> np.ndarray:
        """By how much each condition is missed."""
        return np.concatenate([np.abs(self.held), np.maximum(self.limits, 0.0)])

    @property
    def is_finite(self) -> bool:
        return bool(np.isfinite(self.cost) and np.isfinite(self.held).all() and np.isfinite(self.limits).all())


@dataclasses.dataclass(frozen=True)
class Cycle:
    """What is told of a cycle: its number, the merit, how far conditions are missed, the step, and what limits it."""

    number: int
    merit: float
    missed: float
    step: float
    damping: float
    evaluations: int
    seconds: float
    limits: str = ""


@dataclasses.dataclass(frozen=True)
class Standing:
    """All that decides the next cycle.

    x: the variables (n,); damping, and factor by which it is raised next; share: of missed conditions that a step makes
    good, and their price; scale: of the variables (n,); evaluations and cycles so far.
    """

    x: np.ndarray
    damping: float
    factor: float
    share: float
    price: float
    scale: np.ndarray | None
    evaluations: int
    cycles: tuple[Cycle, ...]


@dataclasses.dataclass(frozen=True)
class Descent:
    """Where it ended and why."""

    state: State
    stopped: str
    cycles: tuple[Cycle, ...]
    evaluations: int
    damping: float


Evaluate = Callable[[np.ndarray, bool], State]


@dataclasses.dataclass(frozen=True)
class Manner:
    """How to descend. damping: at the start; raised, lowered: by how much, as the least; bends: with acceleration;
    keeps: scales of variables never shrink. A path of its own each, where there are several minima."""

    damping: float = 1e-3
    raised: float = 2.0
    lowered: float = 0.2
    bends: bool = True
    keeps: bool = False
    tolerance: float = 1e-8
    floor: float = 0.01


def least_squares(
    evaluate: Evaluate,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    manner: Manner = Manner(),
    cycles: int = 1000,
    until: float = np.inf,
    watch: Callable[[Cycle, Standing], None] | None = None,
    standing: Standing | None = None,
) -> Descent:
    """Descend from x, which is within the bounds, so many cycles, or until a time of `time.monotonic`.

    No evaluation begins that would not end in time, as long as the last of its kind took. watch: invoked after each
    cycle; standing: where an earlier descent stood, which is resumed bit-identically: cycles count from its beginning.
    A KeyboardInterrupt ends with the best state.
    """
    typical = np.full(len(x), np.inf) if typical is None else typical
    return _Run(evaluate, lower, upper, typical, manner, until, watch).descend(x, cycles, standing)


class _OutOfTime(Exception):
    """The next evaluation would not end in time."""


class _Run:
    def __init__(self, evaluate, lower, upper, typical, manner: Manner, until: float, watch):
        self.evaluate, self.lower, self.upper, self.manner = evaluate, lower, upper, manner
        self.typical, self.until, self.watch = typical, until, watch
        self.evaluations, self.told, self.begun = 0, [], time.monotonic()
        self.damping, self.share, self.price = manner.damping, 1.0, 0.0
        self.scale = None
        self.factor = 2.0
        self.seconds = {False: 0.0, True: 0.0}  # of the last evaluation without and with derivatives

    def at(self, x: np.ndarray, derivatives: bool = False) -> State:
        """The state at x. Raises _OutOfTime."""
        begun = time.monotonic()
        if begun + self.seconds[derivatives] > self.until:
            raise _OutOfTime
        self.evaluations += 1
        state = self.evaluate(x, derivatives)
        self.seconds[derivatives] = time.monotonic() - begun
        return state

    def descend(self, x: np.ndarray, cycles: int, standing: Standing | None) -> Descent:
        if standing is not None:
            x = self._resume(standing)
        try:
            self.state = self.at(x, True)
            self.evaluations -= standing is not None  # it was counted before
        except _OutOfTime:
            return Descent(self.evaluate(x, False), "seconds", tuple(self.told), self.evaluations, self.damping)
        try:
            ended = self._idle() if standing is not None and len(self.told) < cycles else ""
            stopped = ended or self._cycles(cycles)
        except KeyboardInterrupt:
            stopped = "interrupted"
        return Descent(self.state, stopped, tuple(self.told), self.evaluations, self.damping)

    def _cycles(self, cycles: int) -> str:
        """Cycles up to so many in all, and why they end."""
        try:
            for number in range(len(self.told) + 1, cycles + 1):
                if reason := self._cycle(number):
                    return reason
        except _OutOfTime:
            return "seconds"
        return "cycles"

    def _resume(self, standing: Standing) -> np.ndarray:
        """Take up what an earlier descent ended its last cycle with; its variables."""
        self.damping, self.factor, self.share = standing.damping, standing.factor, standing.share
        self.price, self.scale = standing.price, standing.scale
        self.evaluations, self.told = standing.evaluations, [*standing.cycles]
        self.begun -= standing.cycles[-1].seconds if standing.cycles else 0.0
        return standing.x

    def _standing(self) -> Standing:
        return Standing(
            self.state.x, self.damping, self.factor, self.share, self.price, self.scale, self.evaluations,
            tuple(self.told),
        )  # fmt: skip

    def _cycle(self, number: int) -> str:
        """One accepted step; the reason where there is none to come. Raises _OutOfTime."""
        linear = self._linear()
        if self._is_flat(linear):
            return "gradient"
        for _ in range(_TRIES):
            trial, step, foretold = self._try(linear)
            if (
                step is not None
                and self.damping < 1
                and foretold <= _ROUNDING * self.state.cost
                and not (self.state.missed > 1e-9).any()
            ):
                return "gradient"
            if trial is not None and self._takes(trial, foretold):
                try:
                    self.state = self.at(trial.x, True)
                except _OutOfTime:
                    self.state = trial  # its derivatives are not needed any more
                    self._tell(number, step)
                    return "seconds"
                self._tell(number, step)
                return self._idle()
            self.damping, self.factor = self.damping * self.factor, 2 * self.factor
            if step is None or (self.state.missed > 1e-9).any():
                self.share *= 0.5
            if step is None:
                continue
            if np.linalg.norm(self.scale * step) <= _STILL * (np.linalg.norm(self.scale * self.state.x) + 1e-300):
                return "step"
        return "step"

    def _linear(self) -> Linear:
        state = self.state
        columns = np.sqrt((state.jacobian**2).sum(0) + (state.sides.slope[state.sides.excess > 0] ** 2).sum(0))
        floor = self.manner.floor * np.sqrt(self.state.cost) / self.typical
        columns = np.sqrt(columns**2 + floor**2)
        columns = np.where(columns > 0, columns, 1.0)
        self.scale = np.maximum(columns, self.scale) if self.manner.keeps and self.scale is not None else columns
        return Linear(
            state.residuals, state.jacobian, sides=state.sides, held=(state.held, state.held_slope),
            limits=(state.limits, state.limits_slope), lower=self.lower - state.x, upper=self.upper - state.x,
            scale=self.scale,
        )  # fmt: skip

    def _try(self, linear: Linear):
        """The state of a trial step, the step, and what the model foretells; None where there is no step."""
        try:
            step = linear.step(self.damping, self.share)
        except NoStep:
            return None, None, 0.0
        bent = self._bent(linear, step) if self.manner.bends else step
        trial = self.at(np.clip(self.state.x + bent, self.lower, self.upper))
        if len(self.state.held) and trial.is_finite:
            trial = self._restored(linear, trial)
        foretold = linear.value(0 * step) - linear.value(step * self.scale)
        return trial, step, foretold

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

    def _restored(self, linear: Linear, trial: State) -> State:
        """Equalities met again, which curved away beneath the step."""
        for _ in range(2):
            if np.abs(trial.held).max() <= _MET * max(np.abs(self.state.held).max(), 1e-3):
                break
            x = trial.x - linear.correction((1 - self.share) * -self.state.held + trial.held)
            again = self.at(np.clip(x, self.lower, self.upper))
            if not again.is_finite or np.abs(again.held).sum() > np.abs(trial.held).sum():
                break
            trial = again
        return trial

    def _takes(self, trial: State, foretold: float) -> bool:
        """Whether a trial is taken; sets the damping by how much of what was foretold came true."""
        state = self.state
        if not trial.is_finite or trial.lost > state.lost:
            return False
        missed, left = state.missed.sum(), trial.missed.sum()
        if missed > 0 and left < missed:
            self.price = max(self.price, 2 * abs(min(foretold, 0.0)) / (missed - left))
        won = state.cost - trial.cost + self.price * (missed - left)
        foretold = foretold + self.price * missed * self.share
        if trial.lost < state.lost:
            return True
        gain = won / foretold if foretold > 0 else -1.0
        if not gain > _ACCEPT:
            return False
        if gain > 0.25:
            self.damping = max(self.damping * max(self.manner.lowered, 1 - (2 * min(gain, 1.5) - 1) ** 3), 1e-15)
        self.factor, self.share = self.manner.raised, min(1.0, 2 * self.share)
        return True

    def _is_flat(self, linear: Linear) -> bool:
        size = np.sqrt(self.state.cost)
        if size == 0:
            return not self.state.missed.any()
        return linear.steepness() <= _FLAT * size and not (self.state.missed > 1e-9).any()

    def _idle(self) -> str:
        """ "merit" where it has not changed over some cycles."""
        told = self.told[-_IDLE - 1 :]
        if len(told) <= _IDLE or told[0].missed > max(1e-9, 1.01 * told[-1].missed):
            return ""
        fell = told[0].merit - told[-1].merit
        return "merit" if fell <= self.manner.tolerance * told[0].merit else ""

    def _tell(self, number: int, step: np.ndarray) -> None:
        state = self.state
        length = float(np.linalg.norm(self.scale * step))
        at_bound = int(((state.x <= self.lower) | (state.x >= self.upper)).sum())
        words = f"{at_bound} at their bounds" if at_bound else ""
        told = Cycle(
            number, float(np.sqrt(state.cost)), float(state.missed.max(initial=0.0)), length, self.damping,
            self.evaluations, time.monotonic() - self.begun, words,
        )  # fmt: skip
        self.told.append(told)
        if self.watch is not None:
            self.watch(told, self._standing())
