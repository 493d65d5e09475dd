"""Searches from a lens to lenses with an element more (`saddle_points`) or less (`removal`).

The lens itself is followed to its minimum; from there each move leads to a lens of other surfaces, in descents of its
own. Rows and conditions name the surfaces of the new lens by their new numbers.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from raytrace.edit.numbering import Numbering
from raytrace.optimization.conditions import Condition
from raytrace.optimization.operands.boundaries import BOUNDARIES
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.search_tasks import (
    FOLLOW,
    LONG,
    Journal,
    Minima,
    Minimum,
    SearchProblem,
    Stage,
    TaskResult,
    descended,
)
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.words import option


@dataclass(frozen=True)
class Move:
    """A step to a lens of other surfaces: its search problem, and descents by their keys, functions of a time limit."""

    task: SearchProblem
    descents: Sequence[tuple[str, Callable[[float], TaskResult]]]


@dataclass
class FromLens:
    """The search from a lens; moves: of its minimum, as many as `count` descents; name: the option of the search."""

    task: SearchProblem
    journal: Journal
    moves: Callable[[Lens], Iterator[Move]]
    count: int
    name: str
    families: dict[tuple, tuple[SearchProblem, Minima]] = field(default_factory=dict)
    started: int = 0  # descents

    DONE: ClassVar[str] = "surfaces"

    @property
    def followed(self) -> int:
        """Descents that were followed to their end."""
        return self.started

    def through(self, progress: Callable | None) -> None:
        """The lens itself, then every move. Raises SearchStopped and NoProblem."""
        model, space = self.task.model, self.task.space
        stage = Stage(self.task.whole, LONG, FOLLOW, space.lower, space.upper)
        until = self.journal.until
        of_lens = self.journal.each([("the lens", lambda: descended(model.start, [stage], until))], len(model.start))[0]
        if not of_lens.is_valid:
            raise NoProblem(
                f"{option(self.name)}: the lens itself loses rays or violates {option('hold')}; search without it first"
            )
        lens, work = model.lens_at(of_lens.x), of_lens.seconds
        bar = None if progress is None else progress(self.count, "descent")
        try:
            for move in self.moves(lens):
                work += self._taken(move, work, bar)
        finally:
            if bar is not None:
                bar.close()

    def _taken(self, move: Move, work: float, bar: Any) -> float:
        """The descents of a move; the seconds that they took."""
        until, space = self.journal.until, move.task.space
        tasks = [(key, lambda descent=descent: descent(until)) for key, descent in move.descents]
        ends = self.journal.each(tasks, len(space.lower))
        ranges = np.maximum(space.upper - space.lower, 1e-300)
        _, minima = self.families.setdefault(_family(move.task), (move.task, Minima(ranges)))
        for (key, _), end in zip(tasks, ends, strict=True):
            work += end.seconds
            minima.add(end, key, work)
            self.started += 1
            if bar is not None:
                bar.update(1)
                each = self.each()
                bar.set_postfix_str(f"{len(each)} minima, the best {each[0][1].result.merit:.6g}" if each else "")
        return sum(end.seconds for end in ends)

    def each(self) -> list[tuple[SearchProblem, Minimum]]:
        """All minima, the best first, each with its problem."""
        minima = [(task, minimum) for task, distinct in self.families.values() for minimum in distinct.each]
        return sorted(minima, key=lambda pair: pair[1].result.merit)


def _family(task: SearchProblem) -> tuple:
    """Media, stop and variables: minima of lenses with the same ones can be compared."""
    lens = task.model.lens
    variables = tuple(variable.address for variable in task.model.variables)
    media = tuple((surface.glass.name, *surface.glass.coefficients.tolist()) for surface in lens.surfaces)
    return media, lens.stop, variables


# -- rows of a lens of other surfaces ----------------------------------------------------------------------------------


def conditions_renumbered(conditions: Sequence[Condition], numbering: Numbering) -> tuple[Condition, ...]:
    """Conditions whose rows name the same surfaces by their new numbers."""
    moved = ((condition, numbering.rows((*condition.before, condition.row))) for condition in conditions)
    return tuple(
        replace(condition, row=rows[-1], before=rows[:-1])
        for condition, rows in moved
        if len(rows) == len(condition.before) + 1
    )


def thinned(rows: Sequence[Row], gaps: tuple[int, int], part: float) -> tuple[Row, ...]:
    """The rows with a part of the least thicknesses of gaps, from the first to the last, without them if `part` is 0.

    Rows that are split off come last.
    """
    pieces = [_split(row, *gaps, part) if part < 1 else [row] for row in rows]
    return (*(piece[0] for piece in pieces), *(row for piece in pieces for row in piece[1:]))


def _split(row: Row, least: int, most: int, part: float) -> list[Row]:
    """A row of least thicknesses as several: of the other gaps, and with part of its target of those to be thin."""
    first, last = row.integers
    is_least = row.operand in BOUNDARIES and row.operand[:2] == "MN" and row.operand[-1] in "TGA"
    if not is_least or last < least or first > most:
        return [row]
    ranges = [(first, least - 1), (max(first, most + 1), last)]
    rows = [replace(row, integers=ends) for ends in ranges if ends[0] <= ends[1]]
    if part > 0:
        rows.append(replace(row, integers=(least, most), target=part * row.target))
    return rows or [replace(row, weight=0.0)]
