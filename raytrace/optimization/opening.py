"""Opening: a start that most rays do not get through, opened step by step until they do.

Through a small enough part of its pupil and its field light passes every lens. There the lens descends for a few
cycles, then more is opened; what does not lose more at the next opening is kept, until no ray of the whole is lost.
"""

import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from raytrace.optimization.least_squares import Cycle, Manner, least_squares
from raytrace.optimization.paths import is_better
from raytrace.optimization.problem import Problem, typical_of

#: Parts of the pupil and of the field, in the order in which they are opened.
PARTS = (0.02, 0.05, *np.geomspace(0.1, 1.0, 14).tolist())

_FEW = 0.05  # of the rows: what fewer lose the descent itself brings back
_CYCLES = 12  # at one opening
_STEEPEST = 9.0  # curvature of what is typical: 0.9 over the radius of the beam
_DAMPED = Manner(damping=0.1, bends=False)


def opened(
    problem: Problem,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    until: float = np.inf,
    watch: Callable[[Cycle], None] | None = None,
) -> np.ndarray:
    """Variables (n,) at which less light is lost than at x; x itself where next to none is, or no way was found.

    lower, upper, typical: as for `least_squares`. until: of `time.monotonic`, when it ends; watch: invoked after each
    cycle.
    """
    begin = best = problem.state(x, False)
    if begin.lost <= _FEW * (problem.evaluation.weights != 0).sum():
        return x
    lower, upper = _no_steeper(problem, x, lower, upper)
    stages = [*(problem.through(part) for part in PARTS[:-1]), problem]
    for stage, wider in pairwise(stages):
        if time.monotonic() > until:
            break
        trial = _descended(stage, x, until, watch, lower=lower, upper=upper, typical=typical)
        if trial is None or wider.state(trial, False).lost > wider.state(x, False).lost:
            continue
        x, whole = trial, problem.state(trial, False)
        best = whole if whole.is_finite and is_better(whole, best) else best
        if best.lost == 0:
            break
    return best.x


def _no_steeper(problem: Problem, x: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, ...]:
    """Bounds within which the axial beam meets every sphere: a narrow part of it would let any curvature grow."""
    bent = np.array([one.quantity == "curvature" for one in problem.model.variables])
    steepest = np.where(bent, _STEEPEST * typical_of(problem.model), np.inf)
    return np.maximum(lower, np.minimum(x, -steepest)), np.minimum(upper, np.maximum(x, steepest))


def _descended(problem: Problem, x: np.ndarray, until: float, watch, **bounds) -> np.ndarray | None:
    """Where a few cycles lead; None where numbers overflow on the way."""
    try:
        with np.errstate(all="ignore"):
            each = watch and (lambda cycle, standing: watch(cycle))
            state = least_squares(
                problem.state, x, manner=_DAMPED, cycles=_CYCLES, until=until, watch=each, **bounds
            ).state
    except np.linalg.LinAlgError:
        return None
    return state.x if state.is_finite else None
