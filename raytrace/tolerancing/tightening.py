"""Tightening of limits: until no error alone exceeds a change of the criterion, or until a share of lenses is good.

Inverse sensitivity: every limit t of a row is drawn in until the change of the criterion there, compensated and traced
exactly, is the one given; a radial error in its worst direction.

Yield: the limits are scaled, class by class, by factors s between 0 and 1. Those of least cost

    Σ a/s   subject to   P(q(s) ≤ q_goal) = yield

are found on a fixed sample of the second-order model: the cost of a tolerance is inverse to its limits. a is the cost
of the given limits, relative to the finest of a workshop (`makeable`), or 1 for every row without a workshop, whose
finest limits bound s. In place of the step q ≤ q_goal, whose derivative vanishes almost everywhere, a narrow logistic
curve has a derivative; the share is then met by the step itself. The share of the lenses that are good is that of other
draws of the model,

    P = P_model + mean of (traced lens is good - model says so)   over traced lenses of their own seed

and the model's share is shifted until P is the yield. Where that does not settle, traced lenses alone set a common
factor. Limits of a workshop are rounded to its steps, the finer one, and widened again by a step where the share
allows it, the most expensive first.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from raytrace.tolerancing.makeable import FIXED, Makeable
from raytrace.tolerancing.radial import limits_alone
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.second_order import SecondOrder
from raytrace.tolerancing.table import ToleranceTable

_HALVINGS = 30  # of a limit, to 1e-9 of it
_DRAWS, _OTHERS = 4096, 2**15  # of the second-order model, by which factors are found, and others that judge them
_TRACED = 512  # lenses that correct the share of the model
_SHIFTS, _CLOSE = 4, 0.003  # times that the share of the model is shifted, and the accepted error of the share
_SOFT = 0.05  # width of the logistic curve, in standard deviations of q
_LEAST = 1e-3  # scale of a limit
_TIGHTENED = "tightened from "  # before the source of a row
_TURNS, _EXACT = 4, 1e-7  # times that worst directions are searched anew, and the accepted excess of an increment


def scaled(tolerances: ToleranceTable, low: Tensor, high: Tensor) -> ToleranceTable:
    """The tolerances with limits multiplied by factors (N,), which the sources of the tightened ones state."""
    pairs = zip(tolerances.rows, low.tolist(), high.tolist(), strict=True)
    rows = [
        dataclasses.replace(row, minimum=a * row.minimum, maximum=b * row.maximum, source=_source(row.source, a, b))
        for row, a, b in pairs
    ]
    return dataclasses.replace(tolerances, rows=tuple(rows))


def _source(source: str, low: float, high: float) -> str:
    start = "" if source.startswith(_TIGHTENED) or (low, high) == (1.0, 1.0) else _TIGHTENED
    return f"{start}{source}" if source else source


class Proposal(NamedTuple):
    """Tightened tolerances; finest: the first rows of those at the finest limit of the workshop; share: of the lenses
    that reach the goal, and error: its standard error."""

    tolerances: ToleranceTable
    finest: tuple[int, ...] = ()
    share: float = 1.0
    error: float = 0.0


def limited_to_change(
    tolerances: ToleranceTable, change: Callable[[Tensor], Tensor], increment: float, makes: Makeable | None = None
) -> Proposal:
    """The tolerances with limits at which errors, each alone at its limit, change the criterion by `increment` at most.

    change: errors (L, N) -> how much worse the criterion is (L,). Limits that do less harm stay. Where the change is no
    monotonic function of the error, one place is found at which it passes the increment. makes: the limits that a
    workshop makes, no finer, which may exceed the increment.
    """
    if not increment > 0:
        raise ValueError(f"increment {increment:g}: expected a change of the criterion above 0")
    tight = tolerances
    for _ in range(_TURNS if tolerances.radial else 1):  # the worst direction may depend on the magnitude
        low, high = limits_alone(tight, change)[:2]
        limits = torch.cat([low, high])
        changes = change(limits)
        reaches = (changes > increment * (1 + _EXACT)) | ~changes.isfinite()  # where no light arrives it is too wide
        if not bool(reaches.any()):
            break
        factors = _factors_to(increment, limits, reaches, change)
        low, high = (part[tight.leaders] for part in factors.chunk(2))
        radial = [n for error in tight.radial.values() for n in error.places]
        low[radial] = high[radial] = torch.minimum(low, high)[radial]
        tight = scaled(tight, low, high)
    if makes is None:
        return Proposal(tight)
    pairs = [
        min(_ratio(new.minimum, old.minimum), _ratio(new.maximum, old.maximum))
        for new, old in zip(tight, tolerances, strict=True)
    ]
    ratios = np.array([min(pairs[n] for n in members) for members in makes.members])
    return _made(makes, makes.rounded(makes.given * ratios))


def _made(makes: Makeable, limits: np.ndarray) -> Proposal:
    """The tolerances of limits (C,) of a workshop."""
    factors = makes.factors(limits)
    return Proposal(scaled(makes.tolerances, factors, factors), tuple(makes.at_finest(limits)))


def _ratio(new: float, old: float) -> float:
    return new / old if old else 1.0


def _factors_to(increment: float, limits: Tensor, reaches: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    """Factors of limits (L, N) by which those that exceed an increment do no more, by halving."""
    few = limits[reaches]
    low, high = few.new_zeros(len(few)), few.new_ones(len(few))
    for _ in range(_HALVINGS if len(few) else 0):
        middle = 0.5 * (low + high)
        changes = change(few * middle[:, None])
        good = changes <= increment
        low, high = torch.where(good, middle, low), torch.where(good, high, middle)
    return torch.ones_like(reaches, dtype=few.dtype).masked_scatter(reaches, low)


def limited_to_yield(
    tolerances: ToleranceTable,
    model: SecondOrder,
    traced: Callable[[Tensor], Tensor],
    goal: float,
    share: float,
    seed: int,
    makes: Makeable | None = None,
) -> Proposal:
    """The tolerances of least cost by which a share of the lenses, as they are traced, has q ≤ goal.

    traced: errors (L, N) -> q (L,), nan of a lens that fails. Limits that already give the share stay as they are.
    The lens without errors reaches the goal. makes: the limits that a workshop makes, which may miss the share.
    """
    others, checked = (draw_errors(tolerances, count, seed + k + 1) for k, count in enumerate((_OTHERS, _TRACED)))
    scales = _Scales(tolerances, model, goal, seed, makes)

    def good(f: np.ndarray) -> Tensor:
        """Whether each traced lens reaches the goal."""
        s = scales.of_rows(f)
        return traced(s * checked.to(s)) <= goal

    def reached(f: np.ndarray) -> tuple[float, float]:
        """The share of lenses that reach the goal, and its standard error."""
        s = scales.of_rows(f)
        off = good(f).double() - (model(s * checked.to(s))[0] <= goal).double()
        goal_met = (model(s * others.to(s))[0] <= goal).double()
        error = (off.var() / len(off) + goal_met.var() / len(goal_met)).sqrt()
        return float(goal_met.mean() + off.mean()), float(error)

    def proposal(f: np.ndarray, good_share: float, error: float) -> Proposal:
        if makes is None:
            s = scales.of_rows(f)
            return Proposal(scaled(tolerances, s, s), (), good_share, error)
        return _made(makes, f * makes.given)._replace(share=good_share, error=error)

    best = np.ones(scales.count)
    good_share, error = reached(best)
    if good_share >= share - error:
        return Proposal(tolerances, (), good_share, error)
    wanted, enough = share, []
    for _ in range(_SHIFTS):
        best = scales.least_cost(min(max(wanted, 0.0), 1 - 1 / _DRAWS))
        good_share, error = reached(best)
        close = max(error, _CLOSE)
        if abs(good_share - share) <= close or (good_share < share and scales.is_finest(best)):
            return proposal(best, good_share, error)
        if makes is not None and good_share > share:  # steps may leave it above the yield
            enough.append((scales.cost(best), proposal(best, good_share, error)))
        wanted += share - good_share
    if enough:
        return min(enough, key=lambda pair: pair[0])[1]
    factor = _largest(lambda factor: float(good(scales.within(factor * best)).double().mean()) >= share, steps=12)
    best = scales.in_steps(scales.within(factor * best), share)
    return proposal(best, *reached(best))


class _Scales:
    """Factors (C,) of the limits of classes of rows, by the second-order model; a: their costs at 1, floors: least."""

    def __init__(
        self, tolerances: ToleranceTable, model: SecondOrder, goal: float, seed: int, makes: Makeable | None
    ) -> None:
        self.model, self.goal, self.makes = model, goal, makes
        self.errors = draw_errors(tolerances, _DRAWS, seed).to(model.g)
        fixed = [n for n, row in enumerate(tolerances) if row.kind in FIXED]
        if makes is None:
            self.classes = torch.unique(tolerances.leaders, return_inverse=True)[1]
            self.a = np.bincount(self.classes.numpy()).astype(float)
            self.floors = np.full(len(self.a), _LEAST)
            self.a[self.classes[fixed]], self.floors[self.classes[fixed]] = 0.0, 1.0
        else:
            self.classes, used = makes.classes, makes.given > 0
            self.a = np.divide(makes.weights * makes.units, makes.given, out=np.zeros(len(used)), where=used)
            least = np.divide(makes.finest, makes.given, out=np.ones(len(used)), where=used)
            self.floors = np.maximum(least, _LEAST)
        self.count = len(self.a)

    def of_rows(self, f: np.ndarray) -> Tensor:
        """Factors (N,) of the rows."""
        return torch.from_numpy(f).to(self.model.g)[self.classes]

    def within(self, f: np.ndarray) -> np.ndarray:
        return np.clip(f, self.floors, 1.0)

    def cost(self, f: np.ndarray) -> float:
        return float((self.a / f).sum())

    def is_finest(self, f: np.ndarray) -> bool:
        return bool((f <= self.floors * (1 + 1e-9)).all())

    def met(self, f: np.ndarray) -> float:
        """The share of the draws of the model that reach the goal."""
        return float((self.model(self.of_rows(f) * self.errors)[0] <= self.goal).double().mean())

    def least_cost(self, share: float) -> np.ndarray:
        """Factors of least cost by which a share of the draws reaches the goal; the floors where none does."""
        if self.met(self.floors) < share:
            return self.floors.copy()
        ones, errors = np.ones(self.count), self.errors
        start = self.within(ones * _largest(lambda factor: self.met(self.within(factor * ones)) >= share))
        total = max(self.cost(ones), 1e-300)

        def cost(u: np.ndarray) -> tuple[float, np.ndarray]:
            parts = self.a * np.exp(-u) / total
            return float(parts.sum()), -parts

        @functools.lru_cache(maxsize=4)
        def excess(u: tuple[float, ...]) -> tuple[float, np.ndarray]:
            s = self.of_rows(np.exp(np.array(u)))
            q, by_errors = self.model(s * errors)
            width = _SOFT * q.std()
            y = torch.sigmoid((self.goal - q) / width)
            slope = (((y * (y - 1) / width) @ (by_errors * errors)) * s / len(q)).double().cpu()
            by_class = slope.new_zeros(self.count).index_add(0, self.classes, slope)
            return float(y.mean()) - share, by_class.numpy()

        optimum = minimize(
            cost, np.log(start), jac=True, method="SLSQP", bounds=[(math.log(floor), 0.0) for floor in self.floors],
            constraints={"type": "ineq", "fun": lambda u: excess(tuple(u))[0], "jac": lambda u: excess(tuple(u))[1]},
            options={"maxiter": 100, "ftol": 1e-7},
        )  # fmt: skip
        best = self.within(np.exp(optimum.x))
        # The step itself in place of the logistic curve: all factors times one number.
        best = self.within(best * _largest(lambda factor: self.met(self.within(factor * best)) >= share, 2.0))
        if self.met(best) < share or self.cost(best) > self.cost(start):
            best = start
        return self.in_steps(best, share)

    def in_steps(self, f: np.ndarray, share: float) -> np.ndarray:
        """Factors of limits in the steps of the workshop: no wider, and then wider by steps where the share allows."""
        if self.makes is None:
            return f
        makes, used = self.makes, self.makes.given > 0
        limits = makes.rounded(f * makes.given)

        def ratios(limits: np.ndarray) -> np.ndarray:
            return self.within(np.divide(limits, makes.given, out=np.ones(self.count), where=used))

        going = {int(c) for c in np.flatnonzero(used & (limits < makes.given * (1 - 1e-9)))}
        while going:
            wider = {c: makes.wider(c, limits[c]) for c in going}
            c = max(going, key=lambda c: makes.weights[c] * makes.units[c] * (1 / limits[c] - 1 / wider[c]))
            trial = limits.copy()
            trial[c] = wider[c]
            if self.met(ratios(trial)) < share:
                going.discard(c)
                continue
            limits = trial
            if limits[c] >= makes.given[c] * (1 - 1e-9):
                going.discard(c)
        return ratios(limits)


def _largest(holds: Callable[[float], bool], most: float = 1.0, steps: int = 40) -> float:
    """The largest factor up to `most` for which a condition holds that holds at 0, by halving."""
    low, high = 0.0, most
    for _ in range(steps):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
