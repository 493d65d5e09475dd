"""Step: where a linear model of a merit function is least, damped, under linear conditions that are met exactly.

    least of |J p + r|² + λ |D p|² + Σ (Σ max(0, e + E p))²    where  A p = -c  and  lower ≤ p ≤ upper, G p ≤ g

The inner sum is over the sides of one row: requirements e ≤ 0 that cost nothing while they are met. Equalities leave
their null space; what is one-sided makes a problem of least distance, solved by non-negative least squares.

Source: Moré 1978 (scaling); Lawson & Hanson, Solving Least Squares Problems, 1974, ch. 20, 23.
"""

import dataclasses

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
