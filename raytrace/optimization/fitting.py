"""Fitting: numbers of a lens take values of a list, one after the other, while the rest is optimised.

The items are the radii of a lens, which take those of test plates (`plate_fit`), or its elements and cemented groups,
which parts of stock replace (`stock_fit`).

1. Of every item that is left, an expansion of the merit in the variables predicts the merit with each candidate when
   all other variables have followed (`glass_choice.expansion`).
2. One item takes its turn. The best few candidates are optimised over some cycles, and the merit reached decides. The
   rest of the lens is then optimised with it. Not one but the best few designs are continued so.
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
from raytrace.optimization.glass_choice import Expansion, expansion
from raytrace.optimization.least_squares import SumOfSquares, least_squares
from raytrace.optimization.problem import Problem, typical_of
from raytrace.words import RaytraceWarning, calling_level

#: Candidates of an item that are optimised, and over how many cycles; designs that are continued.
TRIED, TRIAL_CYCLES, BEAM = 4, 25, 3
_CYCLES = 100  # with every item
_ROUNDS = 3  # of exchanges through all items
_GAIN = 1e-4  # smallest relative reduction of the merit by an exchange
_MET = 1e-4  # violation up to which a condition counts as met, until the last descent
_LAST = 500  # cycles of that
_NEARLY = 1e-2  # violation of a condition that doubles the merit of a trial, whose cycles are few

#: The two orders of the items.
ORDERS = {"worst": "the item that raises the merit most first", "best": "the item that raises the merit least first"}


class NotFitted(RaytraceWarning):
    """A radius without a test plate, an element without a part, a part that is smaller than the light, or solves and
    pickups that do not hold for a part."""


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

    def score(self) -> tuple[float, float]:
        """The order of trials: fewer failed rays, then a lower merit with a charge for conditions that are not met."""
        return self.state.lost, self.merit * (1 + self.missed / _NEARLY)


@dataclass(frozen=True)
class FitStep:
    """One step of a fit.

    kind: "design", the lens before it, "fitted" or "exchanged"; surfaces, name: of the item and its candidate;
    predicted, reached: merits; missed: the largest violation of a condition, 0 where they are met; exceeded: how many
    parts are smaller than the light. A design with fewer of both takes the place of one with a lower merit.
    """

    kind: str
    reached: float
    seconds: float
    surfaces: str = ""
    name: str = ""
    predicted: float = float("nan")
    missed: float = 0.0
    exceeded: int = 0

    @property
    def note(self) -> str:
        """Why a later step may have a higher merit."""
        missed = [f"a condition missed by {self.missed:.2g}"] if self.missed else []
        smaller = [f"{self.exceeded} smaller than the light"] if self.exceeded else []
        return ", ".join(missed + smaller)


@value
class Fitted:
    """The report of a fit.

    what: "parts" or "test plates"; source: the file of the list; order: a key of ORDERS; steps: of the sequence that is
    kept, its exchanges included; entries: a row for each item, (heading, unit) -> cells; notes: (surfaces, text) of the
    items without a candidate, with solves that are left out, and of those that the light exceeds; evaluations: of the
    merit function.
    """

    what: str
    source: str
    order: str
    steps: tuple[FitStep, ...]
    entries: Columns
    notes: tuple[tuple[str, str], ...]
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
        columns: dict[Column, Any] = {
            Column("step", form="<"): [f"{step.kind} {step.surfaces} {step.name}".strip() for step in self.steps],
            Column("predicted"): [step.predicted if step.predicted == step.predicted else "" for step in self.steps],
            Column("merit"): [step.reached for step in self.steps],
            Column("cost", form=".3g"): ["", *cost],
            Column("seconds", form=".1f", heading="s"): [step.seconds for step in self.steps],
        }
        if any(step.note for step in self.steps):
            columns[Column("note", form="<")] = [step.note for step in self.steps]
        notes = [f"surfaces {surfaces}: {text}" for surfaces, text in self.notes]
        is_fitted = len(self.steps) > 1
        entries = [Table(self.entries if is_fitted else {}, [""], ["", *notes] if notes and is_fitted else notes)]
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
            "notes": [{"surfaces": surfaces, "text": text} for surfaces, text in self.notes],
        }

    def warn(self) -> None:
        """One warning of all notes."""
        if self.notes:
            words = "; ".join(f"surfaces {surfaces}: {text}" for surfaces, text in self.notes)
            warnings.warn(f"{self.what}: {words}", NotFitted, stacklevel=calling_level())


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
        self.so_far: tuple[Design, list[FitStep]] = (design, [])

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

    def exceeded(self, design: Design) -> list[tuple[str, str]]:
        """Notes of the items that the light exceeds at the end."""
        return []

    def left_out(self, design: Design) -> list[tuple[str, str]]:
        """Notes of the solves and pickups that do not hold for the candidates."""
        return []

    def fixed(self, design: Design) -> set[tuple[int, str]]:
        """Addresses of the variables of the design that its candidates fix."""
        return set()

    # -- the fit ------------------------------------------------------------------------------------------------------

    def run(self) -> Design:
        """The best design, with all items fitted, or after Ctrl-C those that are."""
        best, kept = self.design, self.steps
        items = self.items()
        try:
            for order in ORDERS if len(items) > 1 else [*ORDERS][:1]:
                if best.chosen and time.monotonic() > self.until:
                    break
                design, steps = self.sequence(items, order)
                if not best.chosen or self.rank(design) < self.rank(best):
                    best, kept, self.order = design, [*self.steps[:1], *steps], order
            self.steps = kept
            best = self.exchanged(best)
            best = self.descend(best, _LAST if self.cycles == _CYCLES else self.cycles)
        except KeyboardInterrupt:
            self.interrupted, self.steps = True, kept if best.chosen else [*self.steps[:1], *self.so_far[1]]
            best = best if best.chosen else self.so_far[0]
            self.missing += [
                (item.words, "interrupted before it was fitted") for item in items if item not in best.chosen
            ]
        last = self.steps[-1]
        self.steps = [*self.steps[:-1], dataclasses.replace(self.ended(last, best), seconds=last.seconds)]
        return best

    def report(self, design: Design) -> Fitted:
        return Fitted(
            what=self.what,
            source=self.source,
            order=self.order,
            steps=tuple(self.steps),
            entries=self.entries(design),
            notes=(*self.missing, *self.left_out(design), *self.exceeded(design)),
            evaluations=self.evaluations,
        )

    def sequence(self, items: Sequence[Item], order: str) -> tuple[Design, list[FitStep]]:
        """The best design with all items fitted, one after the other in an order, and its steps.

        The best few designs with some of the items are continued (a beam search), as the candidate that is best for
        one item may leave no good one for the next.
        """
        waiting = [*items]
        beam: list[tuple[Design, list[FitStep]]] = [(self.design, [])]
        while waiting:
            each = {item: self.candidates(beam[0][0], item) for item in waiting}
            pick: Callable = max if order == "worst" else min
            item = pick(waiting, key=lambda item: each[item][0][0])
            waiting.remove(item)
            trials = [
                (predicted, k, candidate)
                for k, (design, _) in enumerate(beam)
                for predicted, candidate in (self.candidates(design, item) if k else each[item])[:TRIED]
            ]
            trials.sort(key=lambda trial: trial[0])
            ends: list[tuple[Design, list[FitStep]]] = []
            for predicted, k, candidate in trials[: TRIED + len(beam)]:
                if ends and time.monotonic() > self.until:
                    break
                end = self.trial(beam[k][0], item, candidate)
                step = FitStep("fitted", end.merit, self.seconds, item.words, self.name(item, candidate), predicted)
                ends.append((end, [*beam[k][1], step]))
            ends.sort(key=lambda pair: pair[0].score())
            beam = [(self.descend(end, self.cycles), steps) for end, steps in ends[:BEAM]]
            beam = [(end, [*steps[:-1], self.ended(steps[-1], end)]) for end, steps in beam]
            beam.sort(key=lambda pair: self.rank(pair[0]))
            self.so_far = beam[0]
        return beam[0]

    def exchanged(self, design: Design) -> Design:
        """The design after exchanges of one item at a time, until none lowers the merit."""
        left = [*design.chosen]
        for _ in range(_ROUNDS * len(left)):
            if not left or time.monotonic() > self.until:
                break
            item = left.pop(0)
            ends: list[tuple[Design, float, Any]] = []
            for predicted, candidate in self.candidates(design, item)[: TRIED + 1]:
                if candidate != design.chosen[item]:
                    ends.append((self.trial(design, item, candidate), predicted, candidate))
            if not ends:
                continue
            trial, predicted, candidate = min(ends, key=lambda end: end[0].score())
            *first, merit = self.rank(design)
            is_near = trial.score() < (design.state.lost, 1.5 * design.score()[1])
            end = self.descend(trial, self.cycles) if is_near else trial
            if self.rank(end) < (*first, merit * (1 - _GAIN)):
                design, left = end, [other for other in design.chosen if other != item]
                words = item.words, self.name(item, candidate)
                step = FitStep("exchanged", end.merit, self.seconds, *words, predicted)
                self.steps.append(self.ended(step, end))
        return design

    def rank(self, design: Design) -> tuple[float, int, float, float]:
        """Fewer failed rays, then fewer parts that are smaller than the light, conditions met, and a lower merit."""
        missed = design.missed if design.missed > _MET else 0.0
        return design.state.lost, len(self.exceeded(design)), missed, design.merit

    def ended(self, step: FitStep, design: Design) -> FitStep:
        """A step with the design at its end."""
        _, exceeded, missed, merit = self.rank(design)
        return dataclasses.replace(step, reached=merit, seconds=self.seconds, missed=missed, exceeded=exceeded)

    def trial(self, design: Design, item: Item, candidate: Any) -> Design:
        """The design with a candidate, optimised over some cycles."""
        end = self.descend(self.placed(design, item, candidate), min(TRIAL_CYCLES, self.cycles))
        if self.bar is not None:
            self.bar.update(1)
            self.bar.set_postfix_str(f"surfaces {item.words}: {self.name(item, candidate)}, merit {end.merit:.6g}")
        return end

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


def relaxed(state: SumOfSquares, following: np.ndarray, columns: Sequence[int] | np.ndarray = ()) -> Expansion:
    """The expansion of the merit by columns of the variables, with the `following` ones at their best."""
    met = state.limits_slope[np.abs(state.limits) < _MET] if len(state.limits) else np.zeros((0, len(state.x)))
    met = met[np.abs(met[:, following]).sum(1) > 0] if len(met) else met
    return expansion(state, np.asarray(columns, dtype=int), following, met)
