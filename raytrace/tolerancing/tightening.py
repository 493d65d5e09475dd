"""Tightening of limits: until no error alone exceeds a change of the criterion, or until a share of lenses is good.

Inverse sensitivity: every limit t of a row is drawn in until the change of the criterion there, compensated and traced
exactly, is the one given.

Yield: the limits are scaled, row by row, by factors s between 0 and 1. With half widths t of the limits as they are
given, those of least total tightness

    Σ 1/s   subject to   P(q(s) ≤ q_goal) = yield

are found on a fixed sample of the second-order model: the cost of an error is taken as inverse to its tolerance. In
place of the step q ≤ q_goal, whose derivative vanishes almost everywhere, a narrow logistic curve has a derivative; the
share is then met by the step itself. The share of the lenses that are good is that of other draws of the model,

    P = P_model + mean of (traced lens is good - model says so)   over traced lenses of their own seed

and the model's share is shifted until P is the yield. Where that does not settle, traced lenses alone set a common
factor.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.second_order import SecondOrder
from raytrace.tolerancing.table import ToleranceTable

_HALVINGS = 30  # of a limit, to 1e-9 of it
_DRAWS, _OTHERS = 4096, 2**15  # of the second-order model, by which factors are found, and others that judge them
_TRACED = 512  # lenses that correct the share of the model
_SHIFTS, _CLOSE = 4, 0.003  # times that the share of the model is shifted, and the accepted error of the share
_SOFT = 0.05  # width of the logistic curve, in standard deviations of q
_LEAST = 1e-3  # scale of a limit


def scaled(tolerances: ToleranceTable, low: Tensor, high: Tensor) -> ToleranceTable:
    """The tolerances with limits multiplied by factors (N,)."""
    pairs = zip(tolerances.rows, low.tolist(), high.tolist(), strict=True)
    rows = [dataclasses.replace(row, minimum=a * row.minimum, maximum=b * row.maximum) for row, a, b in pairs]
    return dataclasses.replace(tolerances, rows=tuple(rows))


def limited_to_change(
    tolerances: ToleranceTable, change: Callable[[Tensor], Tensor], increment: float
) -> ToleranceTable:
    """The tolerances with limits at which errors, each alone at its limit, change the criterion by `increment` at most.

    change: errors (L, N) -> how much worse the criterion is (L,). Limits that do less harm stay. Where the change is no
    monotonic function of the error, one place is found at which it passes the increment.
    """
    if not increment > 0:
        raise ValueError(f"increment {increment:g}: expected a change of the criterion above 0")
    limits = torch.cat([tolerances.alone(tolerances.minimum), tolerances.alone(tolerances.maximum)])
    changes = change(limits)
    reaches = (changes > increment) | ~changes.isfinite()  # where no light arrives the limit is too wide
    few = limits[reaches]
    low, high = few.new_zeros(len(few)), few.new_ones(len(few))
    for _ in range(_HALVINGS if len(few) else 0):
        middle = 0.5 * (low + high)
        changes = change(few * middle[:, None])
        good = changes <= increment
        low, high = torch.where(good, middle, low), torch.where(good, high, middle)
    factors = torch.ones_like(reaches, dtype=few.dtype).masked_scatter(reaches, low)
    return scaled(tolerances, *(part[tolerances.leaders] for part in factors.chunk(2)))


def limited_to_yield(
    tolerances: ToleranceTable,
    model: SecondOrder,
    traced: Callable[[Tensor], Tensor],
    goal: float,
    share: float,
    seed: int,
) -> ToleranceTable:
    """The tolerances of least total tightness by which a share of the lenses, as they are traced, has q ≤ goal.

    traced: errors (L, N) -> q (L,), nan of a lens that fails. Limits that already give the share stay as they are.
    The lens without errors reaches the goal.
    """
    others, checked = (draw_errors(tolerances, count, seed + k + 1) for k, count in enumerate((_OTHERS, _TRACED)))

    def good(s: Tensor) -> Tensor:
        """Whether each traced lens reaches the goal."""
        return traced(s * checked.to(s)) <= goal

    def reached(s: Tensor) -> tuple[float, float]:
        """The share of lenses that reach the goal, and its standard error."""
        off = good(s).double() - (model(s * checked.to(s))[0] <= goal).double()
        goal_met = (model(s * others.to(s))[0] <= goal).double()
        error = (off.var() / len(off) + goal_met.var() / len(goal_met)).sqrt()
        return float(goal_met.mean() + off.mean()), float(error)

    best = torch.ones(len(tolerances)).to(model.g)
    good_share, error = reached(best)
    if good_share >= share - error:
        return tolerances
    wanted = share
    for _ in range(_SHIFTS):
        best = _least_tight(tolerances, model, goal, min(max(wanted, 0.0), 1 - 1 / _DRAWS), seed)
        good_share, error = reached(best)
        if abs(good_share - share) <= max(error, _CLOSE):
            return scaled(tolerances, best, best)
        wanted += share - good_share
    best = best * _largest(lambda factor: float(good(factor * best).double().mean()) >= share, steps=12)
    return scaled(tolerances, best, best)


def _least_tight(tolerances: ToleranceTable, model: SecondOrder, goal: float, share: float, seed: int) -> Tensor:
    """Factors (N,) of least total tightness by which a share of the lenses has q ≤ goal in the second-order model."""
    errors = draw_errors(tolerances, _DRAWS, seed).to(model.g)

    def met(s: Tensor) -> float:
        return float((model(s * errors)[0] <= goal).double().mean())

    ones = torch.ones_like(model.g)
    start = ones * _largest(lambda factor: met(factor * ones) >= share)

    def tightness(u: np.ndarray) -> tuple[float, np.ndarray]:
        return float(np.exp(-u).mean()), -np.exp(-u) / len(u)

    @functools.lru_cache(maxsize=4)
    def excess(u: tuple[float, ...]) -> tuple[float, np.ndarray]:
        s = torch.exp(ones.new_tensor(u))
        q, by_errors = model(s * errors)
        width = _SOFT * q.std()
        y = torch.sigmoid((goal - q) / width)
        slope = ((y * (y - 1) / width) @ (by_errors * errors)) * s / len(q)
        return float(y.mean()) - share, slope.double().numpy()

    optimum = minimize(
        tightness, np.log(start.double().numpy()), jac=True, method="SLSQP", bounds=[(np.log(_LEAST), 0.0)] * len(ones),
        constraints={"type": "ineq", "fun": lambda u: excess(tuple(u))[0], "jac": lambda u: excess(tuple(u))[1]},
        options={"maxiter": 100, "ftol": 1e-7},
    )  # fmt: skip
    best = torch.exp(torch.from_numpy(optimum.x)).to(ones)
    # The step itself in place of the logistic curve: all factors times one number.
    best = (best * _largest(lambda factor: met((factor * best).clamp(max=1.0)) >= share, 2.0)).clamp(max=1.0)
    if met(best) < share or float((1 / best).sum()) > float((1 / start).sum()):
        best = start
    return best


def _largest(holds: Callable[[float], bool], most: float = 1.0, steps: int = 40) -> float:
    """The largest factor up to `most` for which a condition holds that holds at 0, by halving."""
    low, high = 0.0, most
    for _ in range(steps):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
