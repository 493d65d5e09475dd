"""Removal: from a minimum to minima of lenses with one element less.

Each element between air is flattened and thinned in parts while the rest of the lens follows,

    c₁, c₂ = c ± p (c₁⁰ - c₂⁰)/2,   c = (c₁⁰ + c₂⁰)/2,   t = p t⁰,

to a meniscus of no thickness, p = 0, which changes no ray: its two surfaces are taken out, the air before and behind it
is one gap, and everything varies. It is the reverse of `saddle_points`. Which element is the least useful is thus not
estimated: all of them are removed in turn, and the best lens says it.

Deletion of elements is a step of automatic lens design in HappyLens (CVPR 2026) and OptiNeuro (2025).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from raytrace.edit.numbering import Numbering
from raytrace.edit.surfaces import without
from raytrace.materials.glass import is_air
from raytrace.optimization.conditions import Condition
from raytrace.optimization.least_squares import SolverOptions
from raytrace.optimization.one_element import Move, conditions_renumbered, thinned
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.search_tasks import FOLLOW, LONG, SearchProblem, Stage, TaskResult, descended
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Vary
from raytrace.system.parameter_paths import sensor
from raytrace.system.surface import is_posed
from raytrace.words import option

_PARTS = 0.8, 0.6, 0.4, 0.2, 0.1, 0.0  # of the power and the thickness of an element, one after the other
_CYCLES = 12  # with every part
_CAREFUL = SolverOptions(damping=0.1, bends=False)


def elements_of(
    free: DesignVariables, conditions: Sequence[Condition], surfaces: Sequence[int] = ()
) -> tuple[int, ...]:
    """First surfaces of the elements that can be removed, or the given ones, checked. Raises NoProblem."""
    lens = free.lens
    if lens.operands:
        raise NoProblem(f"{option('delete')}: the lens has several configurations; take one of them")
    if not surfaces:
        surfaces = tuple(k for k in range(1, sensor(lens)) if not _objection(free, conditions, k))
        if not surfaces:
            raise NoProblem(f"{option('delete')}: no spherical element between air whose curvatures vary")
        return surfaces
    for k in surfaces:
        if objection := _objection(free, conditions, k):
            raise NoProblem(f"{option('delete')}: surface {k} {objection}")
    return tuple(dict.fromkeys(surfaces))


def _objection(free: DesignVariables, conditions: Sequence[Condition], k: int) -> str:
    """The reason why the element whose first surface is k cannot be removed, "" where it can."""
    lens, faces = free.lens, (k, k + 1)
    if not 1 <= k < sensor(lens):
        return f"begins no element: this lens has surfaces 1 to {sensor(lens)}"
    before, first, second = lens.surfaces[k - 1 : k + 2]
    if not is_air(before.glass) or is_air(first.glass) or not is_air(second.glass) or before.is_break:
        return "begins no element between air"
    for face in (first, second):
        shaped = (face.conic, face.coefficients, face.sag_terms, face.phase)
        if face.is_mirror or any(part is not None for part in shaped) or is_posed(face):
            return "begins an element with other than centred refracting spheres"
    if lens.stop in faces:
        return "begins the element that is the stop"
    if not {(face, "curvature") for face in faces} <= {variable.address for variable in free.variables}:
        return f"begins an element of curvatures that do not vary: name them by {option('vary')}"
    if any(solve.surface == k or (solve.kind == "pickup" and solve.source in faces) for solve in free.solves):
        return "begins an element with a solve, or one from which another number is picked up"
    _, numbering = _without_element(lens, free, k)
    if any(numbering.row(condition.row) is None for condition in conditions):
        return f"begins an element that {option('hold')} names"
    return ""


def removals(task: SearchProblem, elements: Sequence[int]) -> Callable[[Lens], Iterator[Move]]:
    """The moves from a minimum of a search problem: the removal of each element."""

    def moves(lens: Lens) -> Iterator[Move]:
        for k in elements:
            removal = Removal(k, lens, task)
            yield Move(removal.reduced, [(f"without the element of surface {k}", removal.taken)])

    return moves


@dataclass(frozen=True)
class Removal:
    """The element of surfaces k and k + 1 of a lens at a minimum of a search problem."""

    k: int
    lens: Lens
    task: SearchProblem

    def taken(self, until: float = np.inf) -> TaskResult:
        """The minimum of the lens without the element. Raises SearchStopped."""
        thick = descended(self._whole.model.start, [self._stage(part) for part in _PARTS], until)
        if not np.isfinite(thick.merit):
            return thick._replace(x=self.reduced.model.start)
        x = self._without(thick.x)
        space = self.reduced.space
        end = descended(x, [Stage(self.reduced.whole, LONG, FOLLOW, space.lower, space.upper)], until)
        return end._replace(seconds=end.seconds + thick.seconds)

    @cached_property
    def _whole(self) -> SearchProblem:
        """The search problem at the minimum, with the thickness of the element among the variables."""
        free, new = self.task.model, Vary(self.k, "thickness")
        if any(variable.address == new.address for variable in free.variables):
            return replace(self.task, model=DesignVariables(self.lens, free.variables, free.solves))
        lower, upper = self.task.bounds
        return replace(
            self.task,
            model=DesignVariables(self.lens, (*free.variables, new), free.solves),
            bounds=(np.append(lower, -np.inf), np.append(upper, np.inf)),
        )

    def _stage(self, part: float) -> Stage:
        """The descent with a part of the power and the thickness of the element."""
        whole, k = self._whole, self.k
        start, space = whole.model.start, whole.space
        number = {variable.address: i for i, variable in enumerate(whole.model.variables)}
        faces = [number[k, "curvature"], number[k + 1, "curvature"]]
        lower, upper = space.lower.copy(), space.upper.copy()
        mean = start[faces].mean()
        for place, fixed in ((number[k, "thickness"], part * start[number[k, "thickness"]]),
                             *((face, mean + part * (start[face] - mean)) for face in faces)):  # fmt: skip
            lower[place] = upper[place] = fixed
        problem = whole.problem(thinned(whole.rows, (k, k), part))
        return Stage(problem, _CYCLES, _CAREFUL, lower, upper)

    def _without(self, x: np.ndarray) -> np.ndarray:
        """The variables of the lens without the element, from those of the lens with it."""
        moved = self._whole.model.lens_at(x)
        return replace(self.reduced.model, lens=_without_element(moved, self.task.model, self.k)[0]).start

    @cached_property
    def reduced(self) -> SearchProblem:
        """The search problem of the lens without the element."""
        free = self.task.model
        lens, numbering = _without_element(self.lens, free, self.k)
        old = zip(free.variables, *self.task.bounds, strict=True)
        kept = [
            (moved, least, most) for variable, least, most in old if (moved := numbering.variable(variable)) is not None
        ]
        variables, solves = tuple(variable for variable, _, _ in kept), numbering.solves(free.solves)
        if (data := lens.optimization_data) is not None:
            lens = replace(lens, optimization_data=replace(data, variables=variables, solves=solves))
        return replace(
            self.task,
            model=DesignVariables(lens, variables, solves),
            rows=numbering.rows(self.task.rows),
            conditions=conditions_renumbered(self.task.conditions, numbering),
            bounds=(
                np.array([least for _, least, _ in kept], dtype=float),
                np.array([most for _, _, most in kept], dtype=float),
            ),
        )


def _without_element(lens: Lens, free: DesignVariables, k: int) -> tuple[Lens, Numbering]:
    """The lens without surfaces k and k + 1, and the new numbers of the others."""
    return without(lens, k, k + 1, (*free.variables, *free.solves))
