"""The search by moves: from a lens, or from the best minima of a search, to lenses of other surfaces and elements.

Each move (`saddle_points`, `removal`) leads to a lens near its minimum, from which a descent follows. Without numbers
of elements all moves of the first lenses are taken, once. With them the best lenses of a number of elements lead to
those of the next number, up to the largest and then down to the smallest; of the lenses near a minimum the best are
followed. Cemented lenses count with the others of as many elements.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np

from raytrace.optimization.loss_minima import ByLoss
from raytrace.optimization.moves import Move, started_at
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.removal import cementings, deletions, no_cementing, no_deletion
from raytrace.optimization.saddle_points import insertions, no_insertion, no_split, splits
from raytrace.optimization.search_tasks import (
    FOLLOW,
    LONG,
    Found,
    Journal,
    Minima,
    Minimum,
    SearchProblem,
    Stage,
    TaskResult,
    descended,
)
from raytrace.system.elements import cemented_groups, lens_elements
from raytrace.system.lens import Lens
from raytrace.system.parameter_paths import counted, joined, sensor
from raytrace.words import did_you_mean, option

_NEAR = 16  # cycles of the first descent of the whole lens, by whose end lenses are selected
_FOLLOWED = 3  # selected lenses, for each lens that is kept
_CLOSE = 1e-2  # violation of a condition up to which they count as met there
KEEP = 2  # lenses of a number of elements from which moves begin


@dataclass(frozen=True)
class Kind:
    """A kind of moves: by how many elements it changes the lens, the moves at some surfaces of a lens, the reason why
    there is none at a surface, and what the lens lacks without any."""

    elements: int
    moves: Callable[[SearchProblem, Lens, Sequence[int]], Iterator[Move]]
    objection: Callable[..., str]
    without: str


KINDS = {
    "insert": Kind(1, insertions, no_insertion, "no spherical surface between glass and air whose curvature varies"),
    "split": Kind(1, splits, no_split, "no spherical element whose curvatures vary"),
    "cement": Kind(0, cementings, partial(no_cementing, named=False),
                   "no air space between two glasses whose facing curvatures vary and nearly agree"),
    "delete": Kind(-1, deletions, no_deletion, "no spherical element between air whose curvatures vary"),
}  # fmt: skip


def counts(lens: Lens) -> tuple[int, int]:
    """The numbers of elements and of groups of a lens."""
    elements = lens_elements(lens)
    return len(elements), len(elements) - sum(
        sum(first <= element[0] < last for element in elements) - 1 for first, last in cemented_groups(lens)
    )


@dataclass(frozen=True)
class Moves:
    """The moves of a search: surfaces by kind, all where there are none; elements: the smallest and the largest number,
    None for all moves once; keep: lenses of a number of elements from which moves begin."""

    surfaces: dict[str, tuple[int, ...]]
    elements: tuple[int, int] | None = None
    keep: int = KEEP

    @classmethod
    def of(
        cls,
        words: str | Sequence[str],
        elements: int | str | Sequence[int] | None,
        keep: int | None,
        task: SearchProblem,
    ) -> "Moves":
        """The moves of words as "insert:1,4 delete" of a lens. Raises NoProblem and BadVariables."""
        lens, surfaces = task.model.lens, {}
        for word in joined(words).split():
            name, colon, numbers = word.partition(":")
            if name not in KINDS:
                raise NoProblem(
                    f"{option('moves', word)}: no move {name!r}{did_you_mean(name, KINDS)}; expected some of "
                    f"{', '.join(KINDS)}, of some surfaces as insert:1,4"
                )
            surfaces[name] = tuple(dict.fromkeys(counted(word, numbers))) if colon else ()
        if not surfaces:
            raise NoProblem(f"{option('moves')}: none; expected some of {', '.join(KINDS)}")
        if lens.operands:
            raise NoProblem(f"{option('moves')}: the lens has several configurations; take one of them")
        for name, chosen in surfaces.items():
            objection = no_cementing if name == "cement" else KINDS[name].objection
            for k in chosen:
                if why := objection(task, lens, k):
                    raise NoProblem(f"{option('moves', f'{name}:{k}')}: surface {k} {why}")
        if elements is None:
            if keep is not None:
                raise NoProblem(f"{option('keep')} goes with {option('elements')}, numbers of elements, as 2:5")
            return cls(surfaces)
        if any(surfaces.values()):
            raise NoProblem(
                f"{option('moves', joined(words))}: surface numbers are of the given lens, and change on the way to "
                f"{option('elements', elements)}; leave one of both out"
            )
        return cls(surfaces, _range_of(elements, lens, surfaces), KEEP if keep is None else keep)

    def of_lens(self, task: SearchProblem, lens: Lens, changes: Sequence[int] = (1, 0, -1)) -> list[Move]:
        """The moves of a lens at its minimum that change its number of elements by some of these numbers."""
        each: list[Move] = []
        for name, chosen in self.surfaces.items():
            kind = KINDS[name]
            if kind.elements in changes:
                every = range(1, sensor(lens) + 1)
                each += kind.moves(task, lens, chosen or [k for k in every if not kind.objection(task, lens, k)])
        return each

    def about(self) -> dict:
        """Dependencies of the search, for its journal."""
        return {
            "moves": [
                f"{name}:{','.join(map(str, chosen))}".removesuffix(":") for name, chosen in self.surfaces.items()
            ],
            "elements": None if self.elements is None else [*self.elements],
            **({} if self.elements is None else {"keep": self.keep}),
        }


def _range_of(elements: int | str | Sequence[int], lens: Lens, names: Sequence[str] | dict) -> tuple[int, int]:
    """The smallest and the largest number of elements. Raises NoProblem."""
    now, _ = counts(lens)
    ends = str(elements).split(":") if isinstance(elements, int | str) else elements
    said = option("elements", elements if isinstance(elements, int | str) else ":".join(map(str, elements)))
    try:
        low, high = int(ends[0]), int(ends[-1])
    except (ValueError, IndexError):
        low, high = 0, 0
    if not 1 <= low <= high or len(ends) > 2:
        raise NoProblem(f"{said}: expected numbers of elements from 1 on, as 4, or the least and the most, as 2:5")
    changes = {KINDS[name].elements for name in names}
    if high > now and 1 not in changes:
        raise NoProblem(f"{said}: the lens has {now}; more are made by {option('moves', 'insert split')}")
    if low < now and -1 not in changes:
        raise NoProblem(f"{said}: the lens has {now}; fewer are made by {option('moves', 'delete')}")
    return low, high


@dataclass
class LensMoves:
    """The search by moves; first: the search from starts whose best minima are the first lenses, by default the lens
    itself; loss: minima are followed to those of a loss, by which lenses of a number of elements are kept; the moves
    begin at the minima of the merit function."""

    task: SearchProblem
    journal: Journal
    moves: Moves
    first: Any = None
    loss: ByLoss | None = None
    families: dict[tuple, tuple[SearchProblem, Minima]] = field(default_factory=dict)
    at_loss: dict[int, list[tuple[float, Found, Found]]] = field(default_factory=dict)
    started: int = 0  # moves
    followed: int = 0  # descents that were followed to their end
    work: float = 0.0  # s

    DONE: ClassVar[str] = "moves"

    def through(self, progress: Callable | None) -> None:
        """The first lenses, then the moves. Raises SearchStopped and NoProblem."""
        roots = self._roots(progress)
        if self.moves.elements is None:
            if not self._taken(roots, (1, 0, -1), progress, ""):
                lacking = "; ".join(KINDS[name].without for name in self.moves.surfaces)
                raise NoProblem(f"{option('moves')} {' '.join(self.moves.surfaces)}: {lacking}")
            return
        for task, minimum in roots:
            self._minima(task).each.append(minimum)
        now, (low, high) = counts(self.task.model.lens)[0], self.moves.elements
        numbers = [*range(now, high), *range(max(now, high), low - 1, -1)]
        for place, number in enumerate(numbers):
            rises = number < high and place < high - now
            if number not in numbers[:place] and 0 in (KINDS[name].elements for name in self.moves.surfaces):
                self._taken(self._kept(number, progress), (0,), progress, f"{number} elements")
            self.at_loss.pop(number, None)
            best = self._kept(number, progress)
            if rises or number > low:
                change = 1 if rises else -1
                self._taken(best, (change,), progress, f"{number + change} elements")
                self.at_loss.pop(number + change, None)
        for number in range(low, high + 1):
            self._kept(number, progress)

    def _roots(self, progress: Callable | None) -> list[Found]:
        if self.first is not None:
            self.first.through(progress)
            self.work += self.first.work
            kept = self.first.each()[: self.moves.keep]
            if not kept:
                raise NoProblem(
                    f"{option('moves')}: no minimum that meets {option('hold')} from {self.first.started} starts; "
                    f"allow more {option('starts')}"
                )
            return kept
        model, space = self.task.model, self.task.space
        stage = Stage(self.task.whole, LONG, FOLLOW, space.lower, space.upper)
        until = self.journal.until
        of_lens = self.journal.each([("the lens", lambda: descended(model.start, [stage], until))], len(model.start))[0]
        if not of_lens.is_valid:
            raise NoProblem(
                f"{option('moves')}: the lens itself loses rays or violates {option('hold')}; search without them "
                f"first, or by {option('starts')}"
            )
        self.work += of_lens.seconds
        return [(self.task, Minimum(of_lens, "the lens", self.work))]

    def _taken(self, lenses: Sequence[Found], changes: Sequence[int], progress: Callable | None, unit: str) -> int:
        """The moves of lenses, and the descents from the best ends; the number of moves."""
        steps: list[tuple[str, Move]] = []
        for task, minimum in lenses:
            at_minimum = started_at(task, minimum.result.x)
            for move in self.moves.of_lens(at_minimum, at_minimum.model.lens, changes):
                steps.append((f"{minimum.task} > {move.name}", move))
        few = len(steps) if self.moves.elements is None else _FOLLOWED * self.moves.keep
        bar = None if progress is None or not steps else progress(len(steps) + min(few, len(steps)), "descent")
        try:
            ends = self._each([(key, move, partial(self._near, move)) for key, move in steps], bar, unit)
            self.started += len(steps)
            tasks = [
                (f"{key}, followed", move, partial(self._followed, move, end.x, LONG))
                for key, move, end in self._selected(steps, ends, few)
            ]
            for (key, move, _), end in zip(tasks, self._each(tasks, bar, unit), strict=True):
                self._minima(move.task).add(end, key.removesuffix(", followed"), self.work)
                self.followed += 1
        finally:
            if bar is not None:
                bar.close()
        return len(steps)

    def _near(self, move: Move) -> TaskResult:
        """The lens of a move near its minimum."""
        near = move.taken(self.journal.until)
        if not np.isfinite(near.merit):
            return near
        end = self._followed(move, near.x, _NEAR)
        return end._replace(seconds=near.seconds + end.seconds)

    def _followed(self, move: Move, x: np.ndarray, cycles: int) -> TaskResult:
        space = move.task.space
        stage = Stage(move.task.whole, cycles, FOLLOW, space.lower, space.upper)
        return descended(x, [stage], self.journal.until)

    def _selected(
        self, steps: Sequence[tuple[str, Move]], ends: Sequence[TaskResult], few: int
    ) -> list[tuple[str, Move, TaskResult]]:
        """The best ends of moves, without those that are near the same minimum as a better one."""
        pairs = [(key, move, end) for (key, move), end in zip(steps, ends, strict=True) if np.isfinite(end.merit)]
        pairs.sort(key=lambda pair: (pair[2].lost, pair[2].missed > _CLOSE, pair[2].merit))
        if self.moves.elements is None:
            return pairs
        selected: list[tuple[str, Move, TaskResult]] = []
        for key, move, end in pairs:
            like, family = self._minima(move.task), _family(move.task)
            if not any(_family(m.task) == family and like.is_same(end, e) for _, m, e in selected):
                selected.append((key, move, end))
        return selected[:few]

    def _each(
        self, tasks: Sequence[tuple[str, Move, Callable[[], TaskResult]]], bar: Any, unit: str
    ) -> list[TaskResult]:
        def counting(task: Callable[[], TaskResult]) -> TaskResult:
            result = task()
            if bar is not None:
                bar.update(1)
                each = self.each()
                words = f"{len(each)} minima, the best {each[0][1].result.merit:.6g}" if each else ""
                bar.set_postfix_str(f"{unit} {words}".strip())
            return result

        sizes = [len(move.task.model.variables) for _, move, _ in tasks]
        ends = self.journal.each([(key, partial(counting, task)) for key, _, task in tasks], sizes)
        self.work += sum(end.seconds for end in ends)
        return ends

    def _minima(self, task: SearchProblem) -> Minima:
        space = task.space
        ranges = np.maximum(space.upper - space.lower, 1e-300)
        return self.families.setdefault(_family(task), (task, Minima(ranges)))[1]

    def _of_number(self, number: int) -> list[Found]:
        """The minima of a number of elements, the best first."""
        return [pair for pair in self._by_merit() if counts(pair[0].model.lens)[0] == number]

    def _kept(self, number: int, progress: Callable | None) -> list[Found]:
        """The best lenses of a number of elements, from which moves begin."""
        each = self._of_number(number)
        if self.loss is None or not each:
            return each[: self.moves.keep]
        if number not in self.at_loss:
            self.at_loss[number] = self.loss.ends(each, progress)
        return [of_merit for _, of_merit, _ in self.at_loss[number][: self.moves.keep]]

    def minima_of_loss(self, progress: Callable | None) -> tuple[list[Found], list[float]]:
        """The minima at those of the loss, and their losses, in its order; nan of those that were not followed."""
        assert self.loss is not None, "the search has a loss"
        if self.moves.elements is None:
            return self.loss.listed(self.each(), progress)
        low, high = self.moves.elements
        ends: list[tuple[float, Found]] = []
        for number in range(low, high + 1):
            if number in self.at_loss:
                ends += [(value, pair) for value, _, pair in self.at_loss[number][: self.moves.keep]]
            else:
                ends += [(np.nan, pair) for pair in self._of_number(number)[: self.moves.keep]]
        ends.sort(key=lambda end: (np.isnan(end[0]), end[0]))
        return [pair for _, pair in ends], [value for value, _ in ends]

    def _by_merit(self) -> list[Found]:
        minima = [(task, minimum) for task, distinct in self.families.values() for minimum in distinct.each]
        return sorted(minima, key=lambda pair: pair[1].result.merit)

    def each(self) -> list[Found]:
        """All minima, the best first, each with its problem; of numbers of elements those that are kept."""
        if self.moves.elements is None:
            return self._by_merit()
        low, high = self.moves.elements
        kept = [pair for number in range(low, high + 1) for pair in self._of_number(number)[: self.moves.keep]]
        return sorted(kept, key=lambda pair: pair[1].result.merit)


def _family(task: SearchProblem) -> tuple:
    """Media, stop and variables: minima of lenses with the same ones can be compared."""
    lens = task.model.lens
    variables = tuple(variable.address for variable in task.model.variables)
    media = tuple((surface.glass.name, *surface.glass.coefficients.tolist()) for surface in lens.surfaces)
    return media, lens.stop, variables
