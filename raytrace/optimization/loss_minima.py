"""From the minima of a search by its merit function to minima of a loss."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from raytrace.optimization.loss import Loss, LossDescents
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.search_tasks import LONG, Found, Journal, Minimum, SearchProblem, SearchStopped, TaskResult
from raytrace.psf_models import EmptyPsf

_LOG = logging.getLogger(__name__)
_MOST = 8  # minima that are followed to minima of the loss, if it is at most so many times that of the best one there:
_PROMISING = 2.0


@dataclass(frozen=True)
class ByLoss:
    """Descents of a loss from minima of the merit function, between the same bounds and under the same conditions."""

    loss: Loss
    journal: Journal

    def listed(self, each: Sequence[Found], progress: Callable | None) -> tuple[list[Found], list[float]]:
        """The promising minima at those of the loss, and their losses, in its order; after an interrupt the others
        behind them, with nan."""
        chosen = self._promising(each)
        promising = [each[k] for k in chosen]
        ends: list[tuple[float, Found, Found]] = []
        try:
            self._follow(promising, ends, progress)
        except (SearchStopped, KeyboardInterrupt):
            _LOG.info("the descents of the loss are not complete")
        ends.sort(key=lambda end: end[0])
        rest: list[Found] = []
        if len(ends) < len(promising):
            rest = [*promising[len(ends) :], *(pair for k, pair in enumerate(each) if k not in chosen)]
        return [*(pair for _, _, pair in ends), *rest], [value for value, _, _ in ends] + [np.nan] * len(rest)

    def ends(self, each: Sequence[Found], progress: Callable | None) -> list[tuple[float, Found, Found]]:
        """The loss of promising minima at minima of the loss, each with the minimum of the merit function and that of
        the loss, the best first. Raises SearchStopped."""
        ends: list[tuple[float, Found, Found]] = []
        self._follow([each[k] for k in self._promising(each)], ends, progress)
        return sorted(ends, key=lambda end: end[0])

    def _promising(self, each: Sequence[Found]) -> list[int]:
        values = [self._before(*pair) for pair in each[:_MOST]]
        most = min(values) + (_PROMISING - 1) * abs(min(values))
        return [k for k, value in enumerate(values) if value <= most]

    @torch.no_grad()
    def _before(self, task: SearchProblem, minimum: Minimum) -> float:
        try:
            value = float(self.loss(task.model.lens_at(torch.tensor(minimum.result.x))))
        except EmptyPsf:
            value = np.nan
        return value if np.isfinite(value) else np.inf

    def _follow(
        self, promising: Sequence[Found], ends: list[tuple[float, Found, Found]], progress: Callable | None
    ) -> None:
        bar = None if progress is None else progress(len(promising), "descent")
        try:
            for task, minimum in promising:
                x, key = minimum.result.x, f"{minimum.task}, loss {self.loss.words}"
                (end,) = self.journal.each([(key, partial(self._minimised, task, x))], len(x))
                merit = task.whole.merit(task.whole.evaluated(end.x), end.x)
                at_loss = replace(minimum, result=end._replace(merit=merit))
                ends.append((end.merit, (task, minimum), (task, at_loss)))
                if bar is not None:
                    bar.update(1)
        finally:
            if bar is not None:
                bar.close()

    def _minimised(self, task: SearchProblem, x: np.ndarray) -> TaskResult:
        started = time.process_time()
        descents = LossDescents(task.whole, self.loss, (task.space.lower, task.space.upper))
        try:
            end = descents.run(x, first=False, restarts=0, cycles=LONG, until=self.journal.until)
        except (NoProblem, EmptyPsf):  # rays of the loss fail
            return TaskResult(np.inf, np.inf, np.inf, time.process_time() - started, x)
        if end.stopped in ("interrupted", "seconds"):
            raise SearchStopped
        missed = float(task.whole.state(end.x, False).missed.max(initial=0.0))
        value = end.report.end if np.isnan(end.report.checked) else end.report.checked
        return TaskResult(0.0, missed, value, time.process_time() - started, end.x)
