"""Fitting: numbers of a lens take values of a list, one after the other, while the rest is optimised.

The items are the radii of a lens, which take those of test plates (`plate_fit`), or its elements and cemented groups,
which parts of stock replace (`stock_fit`).

1. Of every item that is left, an expansion of the merit in the variables predicts the merit with each candidate when
   all other variables have followed (`glass_choice.expansion`).
2. One item takes its turn. The best few candidates are optimised over some cycles, and the merit reached decides. The
   rest of the lens is then optimised with it.
3. When all items are fitted, one is exchanged at a time, until no exchange lowers the merit.

The sequence is run twice, and the better end is kept: each time the item comes first whose best candidate raises the
merit most, when most of the lens can still compensate, or least. Test plates: Smith, Modern Lens Design, §2.9. Stock:
Young, Global design of an off-the-shelf objective lens, Opt. Eng.; Sun et al., Lens Factory (arXiv:1506.08956).
"""

import dataclasses
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Columns, Table
from raytrace.optimization.glass_choice import expansion
from raytrace.optimization.least_squares import SumOfSquares, least_squares
from raytrace.optimization.problem import Problem, typical_of
from raytrace.words import RaytraceWarning, calling_level

#: Candidates of an item that are optimised, and over how many cycles.
TRIED, TRIAL_CYCLES = 4, 15
_CYCLES = 100  # with every item
_ROUNDS = 3  # of exchanges through all items
_GAIN = 1e-4  # smallest relative reduction of the merit by an exchange
_MET = 1e-5  # violation up to which a condition counts as met

#: The two orders of the items.
ORDERS = {"worst": "the item that raises the merit most first", "best": "the item that raises the merit least first"}


class NotFitted(RaytraceWarning):
    """A radius without a test plate, or an element without a part."""


@dataclass(frozen=True)
class Item:
    """What takes a value of a list: the radius of surfaces, or an element."""

    surfaces: tuple[int, ...]

    @property
    def words(self) -> str:
        first, *others = self.surfaces
        return f"{first}-{others[-1]}" if others else str(first)


@dataclass(frozen=True)
class Design:
    """A lens of a fit: its problem, bounds of the variables, its state, and the candidates of the fitted items."""

    problem: Problem
    lower: np.ndarray
    upper: np.ndarray
    state: SumOfSquares
    chosen: dict[Item, Any] = dataclasses.field(default_factory=dict)

    @property
    def merit(self) -> float:
        return float(np.sqrt(self.state.cost))

    @property
    def missed(self) -> float:
        """The largest violation of a condition."""
        return float(self.state.missed.max(initial=0.0))

    def rank(self) -> tuple[float, float, float]:
        """Fewer failed rays, then conditions met, then a lower merit."""
        return self.state.lost, self.missed if self.missed > _MET else 0.0, self.merit


@dataclass(frozen=True)
class FitStep:
    """One step of a fit.

    kind: "design", the lens before it, "fitted", "exchanged" or "order", the other sequence of items, whose end is not
    better; surfaces, name: of the item and its candidate; predicted, reached: merits. tried: (name, predicted, reached)
    of all candidates that were optimised.
    """

    kind: str
    reached: float
    seconds: float
    surfaces: str = ""
    name: str = ""
    predicted: float = float("nan")
    tried: tuple[tuple[str, float, float], ...] = ()


@value
class Fitted:
    """The report of a fit.

    what: "parts" or "test plates"; source: the file of the list; order: a key of ORDERS; steps: of the sequence that is
    kept, its exchanges included; entries: a row for each item, (heading, unit) -> cells; missing: (surfaces, reason) of
    the items without a candidate; evaluations: of the merit function.
    """

    what: str
    source: str
    order: str
    steps: tuple[FitStep, ...]
    entries: Columns
    missing: tuple[tuple[str, str], ...]
    evaluations: int

    @property
    def merits(self) -> tuple[float, float]:
        """Before the fit, and after it."""
        return self.steps[0].reached, self.steps[-1].reached

    def tables(self) -> list[Table]:
        start, end = self.merits
        ratio = f", {end / start:.4g} times" if start > 0 else ""
        cost = [later.reached - earlier.reached for earlier, later in zip(self.steps, self.steps[1:], strict=False)]
        head = [f"{self.source}: merit of the design {start:.8g} → {end:.8g}{ratio}"]
        columns: Columns = {
            Column("step", form="<"): [f"{step.kind} {step.surfaces} {step.name}".strip() for step in self.steps],
            Column("predicted"): [step.predicted if step.predicted == step.predicted else "" for step in self.steps],
            Column("merit"): [step.reached for step in self.steps],
            Column("cost", form=".3g"): ["", *cost],
            Column("seconds", form=".1f", heading="s"): [step.seconds for step in self.steps],
        }
        notes = [f"surfaces {surfaces}: {reason}" for surfaces, reason in self.missing]
        entries = [Table(self.entries, [""], ["", *notes] if notes else [])] if self.entries or notes else []
        return [Table(columns, ["", *head, f"  order: {ORDERS[self.order]}", ""]), *entries]

    def document(self) -> dict[str, Any]:
        names = [column.name.replace(" ", "_") for column in self.entries]
        rows = zip(*self.entries.values(), strict=True)
        start, end = self.merits
        return {
            "what": self.what,
            "source": self.source,
            "order": self.order,
            "merit_of_design": start,
            "merit": end,
            "items": [dict(zip(names, row, strict=True)) for row in rows],
            "steps": [dataclasses.asdict(step) for step in self.steps],
            "missing": [{"surfaces": surfaces, "reason": reason} for surfaces, reason in self.missing],
        }

    def warn(self) -> None:
        """One warning of the items without a candidate."""
        if self.missing:
            words = "; ".join(f"surfaces {surfaces}: {reason}" for surfaces, reason in self.missing)
            warnings.warn(f"without {self.what}: {words}", NotFitted, stacklevel=calling_level())


class Fit(ABC):
    """Items of a lens that take candidates of a list; `run` returns the best design."""

    what: ClassVar[str]

    def __init__(
        self,
        design: Design,
        *,
        source: str = "",
        cycles: int | None = None,
        until: float = np.inf,
        bar: Any = None,
    ):
        """cycles: with every item, at most; until: a time of `time.monotonic`; bar: updated by every trial."""
        self.design, self.source, self.bar = design, source, bar
        self.cycles = _CYCLES if cycles is None else min(cycles, _CYCLES)
        self.until, self.started = until, time.monotonic()
        self.evaluations = self.descended = 0
        self.order, self.interrupted = next(iter(ORDERS)), False
        self.missing: list[tuple[str, str]] = []
        self.steps: list[FitStep] = [FitStep("design", design.merit, 0.0)]

    # -- of a kind of items -------------------------------------------------------------------------------------------

    @abstractmethod
    def items(self) -> list[Item]:
        """The items that have a candidate; the others are in `missing`."""

    @abstractmethod
    def candidates(self, design: Design, item: Item) -> list[tuple[float, Any]]:
        """Candidates of an item with their predicted merits, the lowest first."""

    @abstractmethod
    def placed(self, design: Design, item: Item, candidate: Any) -> Design:
        """The design with a candidate, not optimised."""

    @abstractmethod
    def name(self, item: Item, candidate: Any) -> str:
        """A candidate in the list of steps."""

    @abstractmethod
    def entries(self, design: Design) -> Columns:
        """The table of the fitted items."""

    def fixed(self, design: Design) -> set[tuple[int, str]]:
        """Addresses of the variables of the design that its candidates fix."""
        return set()

    # -- the fit ------------------------------------------------------------------------------------------------------

    def run(self) -> Design:
        """The best design, with all items fitted, or after Ctrl-C those that are."""
        best, current, kept = self.design, self.design, self.steps
        items = self.items()
        try:
            for order in ORDERS:
                if best.chosen and time.monotonic() > self.until:
                    break
                self.steps, current = kept[:1], self.design
                for current in self.sequence(self.design, items, order):  # noqa: B007
                    if not best.chosen:
                        kept = self.steps
                current = self.descend(current, self.cycles)
                if not best.chosen or current.rank() < best.rank():
                    best, kept, self.order = current, self.steps, order
                if len(items) < 2:
                    break
            self.steps = kept
            best = self.exchanged(best)
        except KeyboardInterrupt:
            self.interrupted = True
            best = best if best.chosen else current
            unfitted = [(item.words, "interrupted before it was fitted") for item in items if item not in best.chosen]
            self.missing += unfitted
        self.steps = [*self.steps[:-1], dataclasses.replace(self.steps[-1], reached=best.merit)]
        return best

    def report(self, design: Design) -> Fitted:
        return Fitted(
            what=self.what,
            source=self.source,
            order=self.order,
            steps=tuple(self.steps),
            entries=self.entries(design),
            missing=tuple(self.missing),
            evaluations=self.evaluations,
        )

    def sequence(self, design: Design, items: Sequence[Item], order: str) -> Any:
        """The designs with one item more each, in an order."""
        waiting = [*items]
        while waiting:
            each = {item: self.candidates(design, item) for item in waiting}
            pick: Callable = max if order == "worst" else min
            item = pick(waiting, key=lambda item: each[item][0][0])
            waiting.remove(item)
            trial = self.tried(design, item, each[item])
            assert trial is not None, "an item has a candidate"
            design, step = trial
            design = self.descend(design, self.cycles) if waiting else design
            self.steps.append(dataclasses.replace(step, reached=design.merit, seconds=self.seconds))
            yield design

    def exchanged(self, design: Design) -> Design:
        """The design after exchanges of one item at a time, until none lowers the merit."""
        left = [*design.chosen]
        for _ in range(_ROUNDS * len(left)):
            if not left or time.monotonic() > self.until:
                break
            item = left.pop(0)
            others = [
                (predicted, candidate)
                for predicted, candidate in self.candidates(design, item)
                if candidate != design.chosen[item]
            ]
            trial = self.tried(design, item, others)
            if trial is None:
                continue
            lost, missed, merit = design.rank()
            end = self.descend(trial[0], self.cycles) if trial[0].rank() < (lost, missed, 1.2 * merit) else trial[0]
            if end.rank() < (lost, missed, merit * (1 - _GAIN)):
                design = end
                left = [other for other in design.chosen if other != item]
                step = dataclasses.replace(trial[1], kind="exchanged", reached=end.merit, seconds=self.seconds)
                self.steps.append(step)
        return design

    def tried(
        self, design: Design, item: Item, candidates: Sequence[tuple[float, Any]]
    ) -> tuple[Design, FitStep] | None:
        """The best of the promising candidates, optimised over some cycles; None where there is none."""
        best: tuple[Design, FitStep] | None = None
        tried: list[tuple[str, float, float]] = []
        for predicted, candidate in candidates[:TRIED]:
            if best is not None and time.monotonic() > self.until:
                break
            end = self.descend(self.placed(design, item, candidate), min(TRIAL_CYCLES, self.cycles))
            name = self.name(item, candidate)
            tried.append((name, predicted, end.merit))
            if self.bar is not None:
                self.bar.update(1)
                self.bar.set_postfix_str(f"surfaces {item.words}: {name}, merit {end.merit:.6g}")
            if best is None or end.rank() < best[0].rank():
                best = end, FitStep("fitted", end.merit, self.seconds, item.words, name, predicted)
        return None if best is None else (best[0], dataclasses.replace(best[1], tried=tuple(tried)))

    def descend(self, design: Design, cycles: int) -> Design:
        """The design at its minimum."""
        with np.errstate(all="ignore"):
            descent = least_squares(
                design.problem.state, np.clip(design.state.x, design.lower, design.upper), lower=design.lower,
                upper=design.upper, typical=typical_of(design.problem.model), cycles=cycles, until=self.until,
            )  # fmt: skip
        if descent.stopped == "interrupted":
            raise KeyboardInterrupt
        self.evaluations += descent.evaluations
        self.descended += len(descent.cycles)
        return dataclasses.replace(design, state=descent.state)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.started


def free_of(design: Design) -> np.ndarray:
    """Numbers of the variables that are within their bounds."""
    x = design.state.x
    return np.flatnonzero((x > design.lower) & (x < design.upper))


def relaxed(state: SumOfSquares, following: np.ndarray, columns: Sequence[int] = ()) -> Any:
    """The expansion of the merit by columns of the variables, with the `following` ones at their best."""
    met = state.limits_slope[np.abs(state.limits) < _MET] if len(state.limits) else np.zeros((0, len(state.x)))
    met = met[np.abs(met[:, following]).sum(1) > 0] if len(met) else met
    return expansion(state, np.asarray(columns, dtype=int), following, met)
