"""Insertion: from a minimum over saddles to the minima of lenses with one element more, two from every surface.

A meniscus without thickness makes a saddle of the minimum (`meniscus.py`). Down either side of it all but the new
thicknesses vary; then these grow, a part of their least values at a time, and the lens follows; at last everything
varies under the whole merit function.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from raytrace.optimization.asked import Asked
from raytrace.optimization.journal import Ended, Journal
from raytrace.optimization.least_squares import Manner
from raytrace.optimization.meniscus import enlarged, new_gaps, saddle, thinned
from raytrace.optimization.minima import Minima, Minimum
from raytrace.optimization.problem import NoProblem, Problem
from raytrace.optimization.stages import FOLLOW, LONG, Stage, descended

SIDES = {"one side": 1.0, "other side": -1.0}
_PARTS = 0.25, 0.5, 0.75, 1.0  # of the least thicknesses, one after the other
_OFF = np.geomspace(0.03, 10, 18)  # of the residuals: steps off the saddle that are tried
_CYCLES = 15, 10  # off the saddle, and with every part of the thickness
_CAREFUL = Manner(damping=0.1, bends=False)
_MEETINGS = 4  # of conditions, after a step off the saddle


@dataclass(frozen=True)
class Place:
    """A lens with a meniscus before surface k: its problems by how much of its least thickness it has."""

    k: int
    asked: Asked

    def stage(self, part: float, cycles: int, manner: Manner) -> Stage:
        """With that part of the least thicknesses; with none of it the new gaps stay at 0."""
        gaps, space = new_gaps(self.asked, self.k), self.asked.space
        lower = np.where(gaps, part * space.lower, space.lower)
        upper = np.where(gaps & (part == 0), 0.0, space.upper)
        problem = self.asked.problem(thinned(self.asked.rows, self.k, part))
        return Stage(problem, cycles, manner, lower, upper)

    @property
    def family(self) -> tuple:
        """What lenses have in common whose variables can be compared."""
        lens = self.asked.free.lens
        variables = tuple((one.surface, one.quantity) for one in self.asked.free.variables)
        media = tuple((one.glass.name, *one.glass.coefficients.tolist()) for one in lens.surfaces)
        return media, lens.stop, variables

    def gone(self, sign: float, until: float = np.inf) -> Ended:
        """The minimum on one side of the saddle, of a lens of real thickness. Raises Stopped."""
        first = self.stage(0.0, _CYCLES[0], _CAREFUL)
        thicker = [self.stage(part, _CYCLES[1], _CAREFUL) for part in _PARTS]
        x = self.beside(first, sign)
        return descended(x, [first, *thicker, self.stage(1.0, LONG, FOLLOW)], until)

    def beside(self, stage: Stage, sign: float) -> np.ndarray:
        """(n,) off the saddle to one side: as far as the merit falls, with the conditions met again."""
        x, problem = self.asked.model.start, stage.problem
        way = saddle(problem, x, stage.moves(x)).descent
        way = sign * way / np.abs(way[np.argmax(np.abs(way))]) * np.sign(way[np.argmax(np.abs(way))])
        columns = np.sqrt((problem.state(x, True).jacobian ** 2).sum(0))
        unit = np.sqrt(problem.state(x, False).cost) / np.linalg.norm(columns * way)
        best, least = x + _OFF[0] * unit * way, np.inf
        for size in _OFF:
            there = self._met(stage, x + size * unit * way)
            state = problem.state(there, False)
            if not state.is_finite or state.lost or state.cost >= least:
                break
            best, least = there, state.cost
        return best

    def _met(self, stage: Stage, x: np.ndarray) -> np.ndarray:
        """x with what is held met, by the shortest steps."""
        x = np.clip(x, stage.lower, stage.upper)
        moves = stage.moves(x)
        for _ in range(_MEETINGS):
            state = stage.problem.state(x, True)
            if not len(state.held) or not state.is_finite:
                return x
            columns = np.sqrt((state.jacobian**2).sum(0))
            scale = np.where(columns > 0, columns, 1.0)
            back = np.linalg.lstsq((state.held_slope / scale)[:, moves], state.held, rcond=None)[0]
            x = x.copy()
            x[moves] -= back / scale[moves]
            x = np.clip(x, stage.lower, stage.upper)
        return x


@dataclass
class Insertion:
    """The search from a lens, over menisci at some of its surfaces."""

    asked: Asked
    journal: Journal
    places: Sequence[int]
    found: dict[tuple, tuple[Problem, Minima]] = field(default_factory=dict)
    begun: int = 0  # descents

    DONE: ClassVar[str] = "surfaces"

    @property
    def followed(self) -> int:
        """Descents that were followed to their end."""
        return self.begun

    def through(self, progress: Callable | None) -> None:
        """The lens itself, then both sides at every place. Raises Stopped and NoProblem."""
        model, space = self.asked.model, self.asked.space
        stage = Stage(self.asked.whole, LONG, FOLLOW, space.lower, space.upper)
        until = self.journal.until
        own = self.journal.each([("the lens", lambda: descended(model.start, [stage], until))], len(model.start))[0]
        if not own.is_whole:
            raise NoProblem("`insert`: the lens itself loses rays or misses what is held; search without insert first")
        lens, work = model.lens_at(own.x), own.seconds
        bar = None if progress is None else progress(len(self.places) * len(SIDES), "descent")
        try:
            for k in self.places:
                work += self._both(Place(k, enlarged(lens, self.asked, k)), work, bar)
        finally:
            if bar is not None:
                bar.close()

    def _both(self, place: Place, work: float, bar) -> float:
        """The two sides of a saddle; the seconds that they took."""
        tasks = [
            (f"surface {place.k}, {side}", lambda sign=sign: place.gone(sign, self.journal.until))
            for side, sign in SIDES.items()
        ]
        space = place.asked.space
        ends = self.journal.each(tasks, len(space.lower))
        ranges = np.maximum(space.upper - space.lower, 1e-300)
        _, minima = self.found.setdefault(place.family, (place.asked.whole, Minima(ranges)))
        for (key, _), end in zip(tasks, ends, strict=True):
            work += end.seconds
            minima.add(end, key, work)
            self.begun += 1
            if bar is not None:
                bar.update(1)
                bar.set_postfix_str(self._words())
        return sum(end.seconds for end in ends)

    def _words(self) -> str:
        each = self.each()
        return f"{len(each)} minima, the best {each[0][1].ended.merit:.6g}" if each else ""

    def each(self) -> list[tuple[Problem, Minimum]]:
        """All minima, the best first, each with the problem that it is one of."""
        found = [(problem, one) for problem, minima in self.found.values() for one in minima.each]
        return sorted(found, key=lambda pair: pair[1].ended.merit)
