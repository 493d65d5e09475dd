"""Minimisation of a loss: spots or other rows first, lifted least squares, restarts, and a check with denser rays."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import value
from raytrace.maths.result import plain
from raytrace.optimization.least_squares import Cycle, CycleStart, Descent, SumOfSquares
from raytrace.optimization.lifted import Lifted, LiftedLoss
from raytrace.optimization.opening import opened
from raytrace.optimization.problem import FunctionMerit, NoProblem, Problem, typical_of
from raytrace.optimization.quantities import Quantity, of_configurations
from raytrace.psf_models import EmptyPsf
from raytrace.system.lens import Lens
from raytrace.words import option

_DENSER_CHANGE = 0.02  # relative change of a loss by denser rays, above which the descent continues
_ROUNDS = 3  # of denser rays
_UNLIMITED = 300  # cycles of a descent without other limits
_SAME = 1e-6  # relative difference of the same loss between two runs: aimed rays begin elsewhere

#: Invoked after each cycle with its report and the variables (n,).
Watch: TypeAlias = Callable[[Cycle, np.ndarray], object]


@dataclasses.dataclass(frozen=True)
class Loss:
    """A scalar loss: a function of a lens, or of a quantity of it at object distances (D,) mm, in all configurations.

    check_rings: of the rays by which an end is checked, by default twice as many as those of the quantity.
    """

    function: Callable[..., Tensor]
    quantity: Quantity | None = None
    object_distances: Tensor | None = None
    check_rings: int | None = None

    @classmethod
    def of(
        cls,
        function: Callable[..., Tensor],
        quantity: Quantity | None,
        object_distances: Sequence[float] | None,
        check_rings: int | None = None,
    ) -> "Loss":
        """Raises NoProblem for distances or rings of a function of the lens itself, for rings that are no more than
        those of the quantity, and for distances of 0 or nan."""
        if quantity is None and check_rings is not None:
            raise NoProblem(f"{option('check_rings')} goes with a quantity, as {option('of', 'points')}")
        if quantity is not None and check_rings is not None:
            try:
                quantity.denser(check_rings)
            except ValueError as error:
                raise NoProblem(str(error)) from None
        if object_distances is None:
            return cls(function, quantity, check_rings=check_rings)
        if quantity is None:
            raise NoProblem(
                f"{option('object_distances')} goes with a quantity, {option('of')} points, otf or kernels: a function "
                "of the lens uses lens.at(object_distance=…)"
            )
        distances = torch.as_tensor(object_distances, dtype=torch.float64).reshape(-1)
        if not bool((distances.abs() > 0).all()):
            raise NoProblem(
                f"{option('object_distances')} {distances.tolist()}: expected distances in mm, not 0 or nan"
            )
        return cls(function, quantity, distances, check_rings)

    @property
    def words(self) -> str:
        """The name of the function, the quantity and the object distances."""
        name = getattr(self.function, "__qualname__", type(self.function).__name__)
        return f"{name} of {self.quantity} at {plain(self.object_distances)}"

    def __call__(self, lens: Lens) -> Tensor:
        if self.quantity is None:
            return self.function(lens)
        return self.function(of_configurations(self.quantity, lens, self.object_distances))

    def denser(self) -> "Loss | None":
        """The loss of the same quantity by more rays; None for a function of the lens, whose rays are unknown."""
        if self.quantity is None:
            return None
        return dataclasses.replace(self, quantity=self.quantity.denser(self.check_rings), check_rings=None)


@value
class LossReport:
    """The loss by stage: start, the initial lens; first, after the rows that are minimised first (pre-optimisation);
    ends, after each descent, the first from there, the others from displaced lenses, of which the best by denser rays
    counts; end, of the final lens with the rays of the descent; checked, with denser rays, inf where these fail.

    first: nan where rays that the loss needs fail there: the descent then begins at the initial lens; has_first:
    whether rows were minimised first; refined: descents with more rays, because a check changed the loss by more than
    2 %; start_refined: of the initial lens with as many rays as the end, nan without such descents;
    first_cycles: of the pre-optimisation.
    """

    start: float
    first: float
    ends: tuple[float, ...]
    end: float
    checked: float
    refined: int = 0
    has_first: bool = False
    start_refined: float = np.nan
    first_cycles: int = 0

    @property
    def start_of_end(self) -> float:
        """The loss of the initial lens, by the rays of the end where they do not fail."""
        return self.start_refined if np.isfinite(self.start_refined) else self.start

    def stages(self) -> list[tuple[str, float]]:
        """(stage, loss) of the stages with a finite loss."""
        listed = [("at the start", self.start), ("after pre-optimisation", self.first)]
        listed += [("after the descent", end) for end in self.ends[:1]]
        listed += [("from a displaced lens", end) for end in self.ends[1:]]
        listed += [("at the start with more rays", self.start_refined)]
        listed += [("with more rays", self.end)] if self.refined else []
        return [stage for stage in [*listed, ("by denser rays", self.checked)] if np.isfinite(stage[1])]

    def lines(self) -> list[str]:
        """One line with the loss of every stage, then warnings."""
        lines = ["loss " + ", ".join(f"{number:.6g} {name}" for name, number in self.stages())]
        if self.has_first and not np.isfinite(self.first):
            lines.append("rays that the loss needs fail after pre-optimisation: the descent began at the start")
        if np.isfinite(self.checked) and abs(self.checked - self.end) > _DENSER_CHANGE * abs(self.checked):
            lines.append(
                f"denser rays change the loss by more than 2 %: raise {option('cycles')}, or sample "
                "more densely, as by of=Points(rings=16)"
            )
        if np.isinf(self.checked):
            lines.append(
                "denser rays fail, so that their loss is unknown: sample more densely, as by of=Points(rings=16)"
            )
        return lines


@dataclasses.dataclass(frozen=True)
class LossDescent:
    """Variables (n,) at the lowest loss, history of the cycles, reason of the end, and the loss by stage."""

    x: np.ndarray
    history: tuple[Cycle, ...]
    stopped: str
    cycles: int
    evaluations: int
    report: LossReport


def _finite_or_inf(function: FunctionMerit, x: np.ndarray) -> float:
    """The loss at x (n,); inf where its rays fail."""
    try:
        loss = function(x)[0]
    except EmptyPsf:
        return np.inf
    return loss if np.isfinite(loss) else np.inf


class LossDescents:
    """Descents of a loss under the conditions of a problem, whose rows of rays define the metric of the steps.

    ends: lower and upper bounds (n,); evaluated: earlier evaluations, as of `FunctionMerit`; those by denser rays are
    not repeated. stopped: "seconds" or "interrupted" where no further descent follows.
    """

    def __init__(
        self, problem: Problem, loss: Loss, ends: tuple[np.ndarray, np.ndarray], evaluated: Iterable[np.ndarray] = ()
    ):
        self.problem, self.loss = problem, loss
        self.function = FunctionMerit(problem.model, loss, evaluated)
        self.functions = [self.function]  # and of the same loss by denser rays
        self.settings: dict[str, Any] = {"lower": ends[0], "upper": ends[1], "typical": typical_of(problem.model)}
        self.history: list[Cycle] = []
        self.cycle_limit, self.deadline, self.stopped = 0, np.inf, ""

    def run(
        self,
        start: np.ndarray,
        *,
        first: bool,
        restarts: int,
        cycles: int | None,
        until: float,
        watch: Watch | None = None,
    ) -> LossDescent:
        """The descents of a run.

        first: whether the rows are minimised first; restarts: descents from displaced lenses; cycles: of the descents
        of the loss together, by default 300 each. A KeyboardInterrupt ends with the best lens. Raises NoProblem.
        """
        self.cycle_limit, self.deadline = _UNLIMITED * (1 + restarts) if cycles is None else cycles, until
        initial_loss, x, pre_optimised_loss, cycles_used = self.function(start)[0], start, np.nan, 0
        if first:
            pre_optimised, cycles_used = self._pre_optimised(start)
            pre_optimised_loss = self.function(pre_optimised)[0]
            x = pre_optimised if np.isfinite(pre_optimised_loss) else start
        if not np.isfinite(self.function(x)[0]):
            where = "the start and after pre-optimisation" if first else "the start"
            raise NoProblem(
                f"the loss is {self.function(x)[0]:g} at {where}: rays that it needs fail, and it has no derivative; "
                "reduce the fields or the aperture, or start from another lens"
            )
        best = self._descend(self.function, x, watch)
        ends, checked, refined, start_refined = [best.state.cost], np.nan, 0, np.nan
        random = np.random.default_rng(0)
        try:
            loss = self.loss.denser()
            function = self._by(loss)
            least, checked = self._judged(best, function)
            for _ in range(restarts):
                if self._is_over():
                    break
                near = self._lifted(self.function).displaced(best.state.x, random)
                descent = self._descend(self.function, near, watch)
                ends.append(descent.state.cost)
                judged, by_denser = self._judged(descent, function)
                if judged.is_better(least):
                    best, least, checked = descent, judged, by_denser
            while loss is not None and function is not None:
                is_same = abs(checked - best.state.cost) <= _DENSER_CHANGE * abs(checked)
                if is_same or not np.isfinite(checked) or self._is_over() or refined == _ROUNDS:
                    break
                best, refined = self._descend(function, best.state.x, watch), refined + 1
                start_refined = _finite_or_inf(function, start)
                loss = loss.denser()
                function = self._by(loss)
                checked = np.nan if function is None else _finite_or_inf(function, best.state.x)
        except KeyboardInterrupt:  # outside the cycles of a descent
            self.stopped, checked = "interrupted", np.nan
        report = LossReport(
            initial_loss, pre_optimised_loss, tuple(ends), best.state.cost, checked, refined, first, start_refined,
            cycles_used,
        )  # fmt: skip
        return LossDescent(
            best.state.x, tuple(self.history), self.stopped or best.stopped, cycles_used + len(self.history),
            self.evaluations, report,
        )  # fmt: skip

    def is_that_of(self, evaluated: np.ndarray) -> bool:
        """Whether the loss has the value and the gradient of an earlier evaluation."""
        x, value, gradient = np.split(evaluated, [len(evaluated) // 2, len(evaluated) // 2 + 1])
        now, slope = FunctionMerit(self.problem.model, self.loss)(x)
        size = _SAME * max(np.abs(gradient).max(initial=0.0), np.finfo(float).tiny)
        return abs(now - value[0]) <= _SAME * abs(value[0]) and bool((np.abs(slope - gradient) <= size).all())

    @property
    def evaluations(self) -> int:
        """Of the loss, by all rays."""
        return sum(function.evaluations for function in self.functions)

    def _by(self, loss: Loss | None) -> FunctionMerit | None:
        """The merit of the loss by denser rays, whose evaluations count."""
        if loss is None:
            return None
        self.functions.append(FunctionMerit(self.problem.model, loss))
        return self.functions[-1]

    def _judged(self, descent: Descent, by_denser: FunctionMerit | None) -> tuple[SumOfSquares, float]:
        """The end of a descent with the loss by denser rays, inf where these fail, and this loss: few rays may fit a
        wide PSF that more rays do not have."""
        if by_denser is None:
            return descent.state, np.nan
        assert isinstance(descent.state, LiftedLoss)
        loss = _finite_or_inf(by_denser, descent.state.x)
        return dataclasses.replace(descent.state, loss=loss), loss

    def _is_over(self) -> bool:
        return bool(self.stopped) or len(self.history) >= self.cycle_limit or time.monotonic() > self.deadline

    def _pre_optimised(self, start: np.ndarray) -> tuple[np.ndarray, int]:
        """Variables at the minimum of the rows, and cycles."""
        opening = opened(self.problem, start, until=self.deadline, **self.settings)
        if opening.interrupted:
            self.stopped = "interrupted"
            return opening.x, opening.cycles
        descent = self._lifted(self.function).minimise_rows(opening.x, until=self.deadline)
        self.stopped = "interrupted" if descent.stopped == "interrupted" else ""
        return descent.state.x, opening.cycles + len(descent.cycles)

    def _lifted(self, function: FunctionMerit) -> Lifted:
        return Lifted(function, self.problem.state, **self.settings)

    def _descend(self, function: FunctionMerit, x: np.ndarray, watch: Watch | None) -> Descent:
        offset, lifted = len(self.history), self._lifted(function)

        def record_cycle(cycle: Cycle, start: CycleStart) -> None:
            number = cycle.number + offset
            self.history.append(dataclasses.replace(cycle, number=number, evaluations=self.evaluations))
            if watch is not None:
                watch(self.history[-1], start.x)

        cycles = 0 if self.stopped else self.cycle_limit - offset
        descent = lifted.descend(x, cycles=cycles, until=self.deadline, watch=record_cycle)
        if descent.stopped in ("seconds", "interrupted"):
            self.stopped = descent.stopped
        return descent
