"""Deletion and cementing: from a minimum to minima of lenses with one element, or one surface, less.

The gap between surfaces k and k + 1, an element between air or the air between two elements, is closed in parts while
the rest of the lens follows, each part projected (`moves`):

    c₁, c₂ = c ± p (c₁⁰ - c₂⁰)/2,   c = (c₁⁰ + c₂⁰)/2,   t = p t⁰,

At p = 0 it changes no ray. Both surfaces of an element are taken out then, and the air before and behind it is one gap;
of the surfaces of an air space one is left, which is cemented. Then everything varies. It is the reverse of
`saddle_points`. Which element is the least useful is not estimated: all of them are removed in turn, and the best lens
shows it.

Elements are flattened and thinned until they can be removed in Lens component deletion based on differentiable ray
tracing (HappyLens), CVPR 2026, too.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from raytrace.edit.numbering import Numbering
from raytrace.edit.surfaces import cemented, no_air_space, without
from raytrace.materials.glass import is_air
from raytrace.optimization.least_squares import SolverOptions
from raytrace.optimization.moves import Move, changed, no_sphere, projected, thinned
from raytrace.optimization.search_tasks import SearchProblem, Stage, TaskResult, descended
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Vary
from raytrace.system.parameter_paths import sensor
from raytrace.system.surface import vertex_curvature
from raytrace.words import option

_PARTS = 0.8, 0.6, 0.4, 0.2, 0.1, 0.0  # of the difference of the curvatures and of the thickness
_CYCLES = 12  # with every part
_CAREFUL = SolverOptions(damping=0.1, bends=False)
_AGREE = 1.0  # of the power of the lens: difference of facing curvatures that nearly agree


def no_deletion(task: SearchProblem, lens: Lens, k: int) -> str:
    """The reason why the element whose first surface is k cannot be removed, "" where it can."""
    if not 1 <= k < sensor(lens):
        return f"begins no element: this lens has surfaces 1 to {sensor(lens)}"
    before, first, second = lens.surfaces[k - 1 : k + 2]
    if not is_air(before.glass) or is_air(first.glass) or not is_air(second.glass) or before.is_break:
        return "begins no element between air"
    if any(no_sphere(face) for face in (first, second)):
        return "begins an element with other than centred refracting spheres"
    if lens.stop in (k, k + 1):
        return "begins the element that is the stop"
    return _no_closing(task, lens, k, "begins an element")


def no_cementing(task: SearchProblem, lens: Lens, k: int, *, named: bool = True) -> str:
    """The reason why surfaces k and k + 1 cannot be cemented, "" where they can; named: whatever their curvatures."""
    if not 1 <= k < sensor(lens):
        return f"faces no other: this lens has surfaces 1 to {sensor(lens)}"
    if any(no_sphere(face) for face in lens.surfaces[k : k + 2]):
        return "begins an air space with other than centred refracting spheres"
    if why := no_air_space(lens, k):
        return f"begins no air space to cement: {why}"
    if why := _no_closing(task, lens, k, "begins an air space"):
        return why
    if named or (length := task.space.focal_length) is None:
        return ""
    front, back = (float(vertex_curvature(lens.surfaces[face])) for face in (k, k + 1))
    return "" if abs(front - back) * length <= _AGREE else "faces one of another curvature"


def _no_closing(task: SearchProblem, lens: Lens, k: int, begins: str) -> str:
    free, faces = task.model, (k, k + 1)
    if not {(face, "curvature") for face in faces} <= {variable.address for variable in free.variables}:
        return f"{begins} of curvatures that do not vary: name them by {option('vary')}"
    if any(solve.surface == k or (solve.kind == "pickup" and solve.source in faces) for solve in free.solves):
        return f"{begins} with a solve, or one from which another number is picked up"
    _, numbering = _closed(lens, free, k)
    if any(numbering.row(condition.row) is None for condition in task.conditions):
        return f"{begins} that {option('hold')} names"
    return ""


@dataclass(frozen=True)
class Closing:
    """The gap between surfaces k and k + 1 of a lens at a minimum of a search problem."""

    k: int
    lens: Lens
    task: SearchProblem

    def taken(self, until: float = np.inf) -> TaskResult:
        """Variables of the lens without the gap, near its minimum. Raises SearchStopped."""
        start = self._whole.model.start
        thin = descended(start, [self.stage(part) for part in _PARTS], until, projected(self._whole.space, start))
        if not np.isfinite(thin.merit):
            return thin._replace(x=self.reduced.model.start)
        return thin._replace(x=self.without(thin.x))

    @cached_property
    def _whole(self) -> SearchProblem:
        """The search problem at the minimum, with the thickness of the gap among the variables."""
        free, new = self.task.model, Vary(self.k, "thickness")
        if any(variable.address == new.address for variable in free.variables):
            return replace(self.task, model=DesignVariables(self.lens, free.variables, free.solves))
        lower, upper = self.task.bounds
        return replace(
            self.task,
            model=DesignVariables(self.lens, (*free.variables, new), free.solves),
            bounds=(np.append(lower, -np.inf), np.append(upper, np.inf)),
        )

    def stage(self, part: float) -> Stage:
        """The descent with a part of the difference of the curvatures and of the thickness."""
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

    def without(self, x: np.ndarray) -> np.ndarray:
        """The variables of the lens without the gap, from those of the lens with it."""
        moved = self._whole.model.lens_at(x)
        return replace(self.reduced.model, lens=_closed(moved, self.task.model, self.k)[0]).start

    @cached_property
    def reduced(self) -> SearchProblem:
        """The search problem of the lens without the gap."""
        lens, numbering = _closed(self.lens, self.task.model, self.k)
        return changed(self.task, lens, numbering, {})


def _closed(lens: Lens, free: DesignVariables, k: int) -> tuple[Lens, Numbering]:
    """The lens without the element of surfaces k and k + 1, or with both as one cemented surface, and the numbering."""
    if is_air(lens.surfaces[k].glass):
        return cemented(lens, k)
    return without(lens, k, k + 1, (*free.variables, *free.solves))


def _closings(name: str) -> Callable[[SearchProblem, Lens, Sequence[int]], Iterator[Move]]:
    def moves(task: SearchProblem, lens: Lens, places: Sequence[int]) -> Iterator[Move]:
        for k in places:
            closing = Closing(k, lens, task)
            yield Move(f"{name} {k}", closing.reduced, closing.taken)

    return moves


#: Each element of a lens at its minimum, by its first surface, removed; the facing surfaces of each air space cemented.
deletions, cementings = _closings("delete"), _closings("cement")
