"""Minima: the distinct ones that a search found, each once."""

from dataclasses import dataclass, field

import numpy as np

from raytrace.optimization.journal import Ended

_ALIKE = 0.03  # of the range of a variable: how far two minima may lie apart that are one
_EQUAL = 2e-2  # of the merit


@dataclass
class Minimum:
    """Where it lies, how often it was found, how it was found first, and after how many processor seconds."""

    ended: Ended
    task: str
    seconds: float
    found: int = 1


@dataclass
class Minima:
    """All that were found, the best first. ranges: (n,) of the variables; turned: which variable stands where each one
    stands in the lens that is turned round, where that is a lens of the same variables, and its sign."""

    ranges: np.ndarray
    turned: tuple[np.ndarray, np.ndarray] | None = None
    each: list[Minimum] = field(default_factory=list)

    def add(self, ended: Ended, task: str, seconds: float) -> bool:
        """Whether it is new, or better than the one that it is."""
        if not ended.is_whole:
            return False
        same = next((one for one in self.each if self._is_same(one.ended, ended)), None)
        better = same is None or ended.merit < same.ended.merit * (1 - 1e-6)
        if same is None:
            self.each.append(Minimum(ended, task, seconds))
        else:
            same.found += 1
            if better:
                same.ended, same.task, same.seconds = ended, task, seconds
        self.each.sort(key=lambda one: one.ended.merit)
        return better

    def _is_same(self, one: Ended, other: Ended) -> bool:
        if abs(one.merit - other.merit) > _EQUAL * max(one.merit, other.merit):
            return False
        ways = [other.x]
        if self.turned is not None:
            places, signs = self.turned
            ways.append(signs * other.x[places])
        return any(np.abs((one.x - way) / self.ranges).max() < _ALIKE for way in ways)
