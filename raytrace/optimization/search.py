"""Searching: the distinct minima of a merit function between bounds, the best lens first.

In batches: starts spread evenly (`starts.py`), the best of several points each, descend a little on a narrow beam and
then on the whole one; the best of a batch are followed to their minima; and from the best minima so far the search
hops over their walls. What a batch decides follows from the batches before it alone, never from the clock.
"""

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import ClassVar

import numpy as np

from raytrace.files import NotWritten, check_output_folder
from raytrace.io import LensFileError
from raytrace.optimization.attained import refuse_contradictions
from raytrace.optimization.constraints import Condition, conditions_of
from raytrace.optimization.default_merit import KINDS, DefaultMerit
from raytrace.optimization.journal import Ended, Journal, Stopped
from raytrace.optimization.least_squares import Manner
from raytrace.optimization.merit import Merit, in_unit, merit_for
from raytrace.optimization.optimize import opened
from raytrace.optimization.problem import NoProblem, Problem
from raytrace.optimization.saddle_points import Insertion, places_of
from raytrace.optimization.search_result import Minima, Minimum, Searched, searched
from raytrace.optimization.search_settings import FOLLOW, LONG, Asked, Stage, descended
from raytrace.optimization.starts import Space
from raytrace.optimization.variables import Freedom, bounds_of, freedom
from raytrace.shards import Share
from raytrace.system.lens import Lens, field_points
from raytrace.system.optimization_data import Row
from raytrace.tracing.compiled import prepare
from raytrace.tracing.launch import warn_of_filling
from raytrace.words import calling_level

STARTS = 64
_BATCH = 16  # starts; what is done in a batch is shared by processes
_POINTS = 8  # of which a start is the best
_NARROW = 0.5, 0.6  # parts of pupil and field that a start descends on first
_SHORT = 10, 12  # cycles on the narrow and on the whole beam
_FOLLOWED = 4  # of a batch
_HOPS = 4  # of a batch
_SPRINGS = 3  # minima from which they start, the best ones
_REACH = 0.02, 0.3  # of a hop, of the ranges of the variables
_DAMPED = Manner(damping=0.1, bends=False)

_DEFAULT = {operand for kind in KINDS.values() for operand in kind.operands.values()} - {"MTFA"}


def search(
    lens: Lens,
    *,
    merit: str | Merit | DefaultMerit | Sequence[Row] | None = None,
    vary: str | Sequence[str] | None = None,
    bounds: str | Sequence[str] | None = None,
    hold: str | Sequence[str] | Sequence[Condition] | None = None,
    starts: int | None = None,
    insert: bool | Sequence[int] | None = None,
    seconds: float | None = None,
    seed: int = 0,
    folder: str | PathLike | None = None,
    progress: Callable | None = None,
    share: Share | None = None,
) -> Searched:
    """The distinct minima of a merit function, from starts spread over all that the bounds allow; the lens is one.

    merit, vary, bounds, hold: as for `optimize`; bounds that are not given follow from the focal length (`starts.py`),
    which is that of `hold`, of a row EFFL or of the lens. starts: how many; insert: instead of starts True, or
    surfaces, at which a meniscus without thickness is inserted, to descend on either side to lenses with one element
    more (`saddle_points.py`). seconds: after which it ends; seed: of the draws. folder: keeps the minima as lens
    files, a table and figures, and how far the search has come: called again it goes on, and ends as if it had never
    ended before. Ctrl-C ends with what was found.
    Raises NoProblem, BadMerit, BadVariables, BadHold, BadRow, UnknownOperand, BadSearch.
    """
    if folder is not None:
        check_output_folder(folder)
    prepare()
    warn_of_filling(lens, field_points(None, like=lens))
    begun = time.monotonic()
    function = merit_for(lens, merit)
    free = freedom(lens, vary)
    if any(one.quantity == "glass" for one in free.variables):
        raise NoProblem(
            "`vary=glass` is for optimize: search with the glasses as they are, then optimize what is found"
        )
    glass, air = function.boundaries.glass, function.boundaries.air
    ends, conditions = bounds_of(free.lens, free.variables, bounds), _conditions(lens, hold, function.unit)
    how = {"unit": function.unit, "skip_unknown": function.skip_unknown, "conventions": function.conventions}
    asked = Asked(free, tuple(function.rows), conditions, ends, glass, air, how)
    until = begun + (np.inf if seconds is None else seconds)
    places = () if insert is None or insert is False else _places(free, insert, starts)
    if conditions:
        low, high = asked.space.lower, asked.space.upper
        refuse_contradictions(asked.whole, np.clip(asked.model.start, low, high), lower=low, upper=high)
    if not places:
        run = _Run(asked, Journal(folder, asked.about(seed), until), seed, STARTS if starts is None else starts)
    else:
        journal = Journal(folder, {**asked.about(seed), "insert": list(places)}, until)
        run = Insertion(asked, journal, places)
    stopped = _stopped(run, progress)
    found = searched(
        lens, run.each(), starts=run.begun, descents=run.followed, stopped=stopped, seconds=time.monotonic() - begun
    )
    if folder is not None and not (share and share.rank):
        try:
            found.save(folder)
        except (OSError, LensFileError) as error:
            warnings.warn(f"{folder}: not all minima are written: {error}", NotWritten, stacklevel=calling_level())
    return found


def _places(free: Freedom, insert: bool | Sequence[int], starts: int | None) -> tuple[int, ...]:
    """Surfaces at which a meniscus is inserted. Raises NoProblem."""
    if starts is not None:
        raise NoProblem(
            "`starts` goes without `insert`, which begins at the lens alone, on both sides of every surface"
        )
    return places_of(free, () if insert is True else tuple(insert))


def _stopped(run: "_Run | Insertion", progress: Callable | None) -> str:
    """Why a search ended: a key of `search_result.STOPPED`."""
    try:
        run.through(progress)
    except Stopped:
        return "seconds" if time.monotonic() > run.journal.until else "interrupted"
    except KeyboardInterrupt:
        return "interrupted"
    return run.DONE


def _conditions(lens: Lens, hold, unit: float) -> tuple[Condition, ...]:
    """What is held, from mm to the unit of length of the merit function."""
    in_words = hold is None or isinstance(hold, str) or all(isinstance(one, str) for one in hold)
    found = conditions_of(lens, hold) if in_words else hold
    return tuple(replace(one, row=in_unit(one.row, 1.0, unit)) for one in found)


def _narrowed(rows: Sequence[Row]) -> tuple[Row, ...]:
    """The rows with the rays of default merit functions nearer to the axis, in pupil and field."""
    pupil, field = _NARROW
    scale = np.array([field, field, pupil, pupil])
    return tuple(
        replace(row, numbers=tuple((scale * row.numbers).tolist())) if row.operand in _DEFAULT else row for row in rows
    )


@dataclass
class _Run:
    """A search under way."""

    asked: Asked
    journal: Journal
    seed: int
    starts: int
    begun: int = 0  # starts
    followed: int = 0  # descents
    work: float = 0.0  # s

    DONE: ClassVar[str] = "starts"

    def __post_init__(self):
        self.narrow = self.asked.problem(_narrowed(self.asked.rows))
        self.whole, self.space = self.asked.whole, self.asked.space
        self.minima = Minima(np.maximum(self.space.upper - self.space.lower, 1e-300), _turned(self.space))

    def each(self) -> list[tuple[Problem, Minimum]]:
        """All minima, the best first, each with the problem that it is one of."""
        return [(self.whole, one) for one in self.minima.each]

    def through(self, progress: Callable | None) -> None:
        """All batches. Raises Stopped."""
        bar = None if progress is None else progress(self.starts, "start")
        try:
            for first in range(0, self.starts, _BATCH):
                self._batch(range(first, min(first + _BATCH, self.starts)), bar)
        finally:
            if bar is not None:
                bar.close()

    def _batch(self, numbers: range, bar) -> None:
        keys = [f"start {i}" for i in numbers]
        ends = self._each(
            [(key, _watched(lambda i=i: self._start(i), bar)) for key, i in zip(keys, numbers, strict=True)]
        )
        self.begun = numbers[-1] + 1
        best = sorted(zip(keys, ends, strict=True), key=lambda pair: pair[1].rank)[:_FOLLOWED]
        self._follow([(f"{key}, followed", end.x) for key, end in best], bar)
        springs = self.minima.each[:_SPRINGS]
        hops = [(f"hop {numbers[0] + k}", springs[k % len(springs)].ended.x) for k in range(_HOPS)] if springs else []
        self._follow([(key, self._hopped(key, x)) for key, x in hops], bar)

    def _each(self, tasks) -> list[Ended]:
        ends = self.journal.each(tasks, len(self.space.lower))
        self.work += sum(end.seconds for end in ends)
        return ends

    def _follow(self, tasks: Sequence[tuple[str, np.ndarray]], bar) -> None:
        ends = self._each(
            [
                (key, lambda x=x: descended(x, [Stage(self.whole, LONG, FOLLOW, *self._bounds)], self.journal.until))
                for key, x in tasks
            ]
        )
        self.followed += len(tasks)
        for (key, _), end in zip(tasks, ends, strict=True):
            if self.minima.add(end, key, self.work) and bar is not None:
                bar.set_postfix_str(f"{len(self.minima.each)} minima, the best {self.minima.each[0].ended.merit:.6g}")

    def _start(self, number: int) -> Ended:
        """The lens as it is, or the best of some points between the bounds; both descended a little."""
        model = self.asked.model
        points = self.space.sobol(number, _POINTS, self.seed) if number else np.clip(model.start, *self._bounds)[None]
        points = [self.space.prepared(x) for x in points]
        best = min(points, key=self._worth)
        if self._worth(best)[0]:
            best = opened(self.whole, best, lower=self.space.lower, upper=self.space.upper, until=self.journal.until)
            if time.monotonic() > self.journal.until:
                raise Stopped
        narrow = Stage(self.narrow, _SHORT[0], _DAMPED, *self._bounds)
        stages = [narrow, Stage(self.whole, _SHORT[1], Manner(), *self._bounds)]
        return descended(best, stages, self.journal.until)

    @property
    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.space.lower, self.space.upper

    def _worth(self, x: np.ndarray) -> tuple[float, float]:
        """Lost rays and squares of a point on the narrow beam."""
        with np.errstate(all="ignore"):
            found = self.narrow.evaluated(x)
        squares = float(np.nansum(found.residuals**2))
        return float(found.lost.sum()), squares

    def _hopped(self, key: str, x: np.ndarray) -> np.ndarray:
        """A point beyond a minimum, drawn by the name of the hop."""
        draw = np.random.default_rng([self.seed, *key.encode()])
        size = _REACH[0] * (_REACH[1] / _REACH[0]) ** draw.random()
        return self.space.prepared(x + size * (self.space.high - self.space.low) * draw.normal(size=len(x)))


def _watched(task: Callable[[], Ended], bar) -> Callable[[], Ended]:
    """The task, after which the bar moves."""

    def done() -> Ended:
        end = task()
        if bar is not None:
            bar.update(1)
        return end

    return done


def _turned(space: Space) -> tuple[np.ndarray, np.ndarray] | None:
    """Which variable takes the place of each in the lens turned round, and its sign; None where no lens is."""
    lens = space.model.lens
    if not np.isfinite(float(lens.surfaces[0].thickness)):
        return None
    variables, last = space.model.variables, len(lens.surfaces) - 2
    at = {(one.surface, one.quantity): k for k, one in enumerate(variables)}
    partner = {"curvature": lambda k: last + 1 - k, "thickness": lambda k: last - k}
    other = [(partner.get(one.quantity, lambda k: -1)(one.surface), one.quantity) for one in variables]
    if any(place not in at for place in other):
        return None
    return np.array([at[place] for place in other]), np.where([o == "curvature" for _, o in other], -1.0, 1.0)
