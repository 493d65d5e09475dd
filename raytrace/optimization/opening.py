"""Opening: variables at which most rays of the whole beam pass, from a lens at which they fail.

Where most rays of the initial design fail, it descends first on the rays of a small part of pupil and field, through
which light passes every lens. The part grows until no ray of the whole beam fails.
"""

import dataclasses
import time
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from raytrace.optimization.least_squares import Cycle, CycleStart, SolverOptions, least_squares
from raytrace.optimization.problem import Problem, typical_of

#: Parts of the pupil and of the field, in the order in which they are opened.
PARTS = (0.02, 0.05, *np.geomspace(0.1, 1.0, 14).tolist())

_FEW = 0.05  # of the rows: with fewer failed rays the descent itself recovers
_CYCLES = 12  # at one opening
_STEEPEST = 9.0  # curvature in units of the typical one: 0.9 over the radius of the beam
_DAMPED = SolverOptions(damping=0.1, bends=False)


class Opened(NamedTuple):
    """Variables (n,) at which fewer rays fail, cycles, and whether a KeyboardInterrupt ended them."""

    x: np.ndarray
    cycles: int = 0
    interrupted: bool = False


def opened(
    problem: Problem,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    until: float = np.inf,
    watch: Callable[[Cycle, np.ndarray], object] | None = None,
) -> Opened:
    """Variables at which fewer rays fail than at x; x itself where nearly none do, or no such variables are found.

    lower, upper, typical: as for `least_squares`. until: of `time.monotonic`, when it ends; watch: invoked after each
    cycle with its report and the best variables so far.
    """
    best = shown = problem.state(x, False)
    count = 0
    if best.lost <= _FEW * (problem.evaluation.weights != 0).sum():
        return Opened(x)
    # the axial beam meets every sphere within these bounds: a narrow part of it would let any curvature grow
    curved = np.array([variable.quantity == "curvature" for variable in problem.model.variables])
    steepest = np.where(curved, _STEEPEST * typical_of(problem.model), np.inf)
    bounds = {
        "lower": np.maximum(lower, np.minimum(x, -steepest)),
        "upper": np.minimum(upper, np.maximum(x, steepest)),
        "typical": typical,
    }
    stages = [*(problem.through(part) for part in PARTS[:-1]), problem]

    def each(cycle: Cycle, solver: CycleStart) -> None:
        nonlocal shown
        if watch is None:
            return
        whole = problem.state(solver.x, False)
        shown = whole if whole.is_finite and whole.is_better(shown) else shown
        cycle = dataclasses.replace(cycle, number=count + cycle.number, merit=float(np.sqrt(shown.cost)))
        watch(cycle, shown.x)

    for stage, wider in pairwise(stages):
        if time.monotonic() > until:
            break
        try:
            with np.errstate(all="ignore"):
                descent = least_squares(
                    stage.state, x, options=_DAMPED, cycles=_CYCLES, until=until, watch=each, **bounds
                )
        except np.linalg.LinAlgError:  # numbers overflow
            continue
        trial, count = descent.state, count + len(descent.cycles)
        if descent.stopped == "interrupted":
            return Opened((shown if shown.is_better(best) else best).x, count, True)
        if not trial.is_finite or wider.state(trial.x, False).lost > wider.state(x, False).lost:
            continue
        x, whole = trial.x, problem.state(trial.x, False)
        best = whole if whole.is_finite and whole.is_better(best) else best
        if best.lost == 0:
            break
    return Opened(best.x, count)
