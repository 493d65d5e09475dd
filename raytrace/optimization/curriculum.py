"""Curricula: wide and fast lenses of aspheres from plane plates, in steps of beam, field and shape.

From plates a search finds spherical lenses of a part of aperture and field. From the best of them steps lead to the
whole lens: in each the beam and the field are a little larger, the rays and fields of the merit function denser, and
further terms of the aspheres vary. At last the spots are compared between the fields, wavelengths and rays
(`optimization.between`): where they are worse there, the last step is repeated with twice the fields and more rings.

Limits relative to the focal length f that nobody gives are part of a curriculum.
"""

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Protocol

import numpy as np

from raytrace.materials.glass import is_air
from raytrace.optimization.between import worse_between
from raytrace.optimization.conditions import Condition, conditions_in_unit
from raytrace.optimization.least_squares import SolverOptions
from raytrace.optimization.merit import Boundaries, DefaultMerit, merit_for
from raytrace.optimization.opening import opened
from raytrace.optimization.problem import NoProblem, typical_of
from raytrace.optimization.search_tasks import (
    Journal,
    Minimum,
    SearchProblem,
    Stage,
    TaskResult,
    descended,
)
from raytrace.optimization.variables import bounds_of, design_variables, split_constraint
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.system.parameter_paths import sensor
from raytrace.words import did_you_mean, option

_FOLLOWED = 2  # minima of the first search
_HALVINGS = 24  # of steps whose start is far from the lens before
_LEAP = 100.0  # of the merit: beyond it a start is far
_REPEATS = 2  # of the last step, where spots are worse between its fields
_MORE_RINGS = 2


@dataclass(frozen=True)
class Step:
    """Parts of aperture and field, number of fields, terms of the aspheres that vary, rings of rays, and cycles."""

    aperture: float
    field: float
    fields: int
    terms: tuple[str, ...] = ()
    rings: int = 3
    cycles: int = 60

    def halfway(self, step: "Step") -> "Step":
        """A step to the middle of the aperture and the field between this one and another, with its terms."""
        aperture, field = 0.5 * (self.aperture + step.aperture), 0.5 * (self.field + step.field)
        return replace(step, aperture=aperture, field=field)


@dataclass(frozen=True)
class Curriculum:
    """Steps to a kind of lens, the first by a search from plates; holds: conditions, lengths relative to f, angles in
    degrees; glass, air: least and largest thickness, and least edge of glass, relative to f."""

    steps: tuple[Step, ...]
    starts: int
    holds: dict[str, float]
    glass: tuple[float, float]
    air: tuple[float, float]
    edge: float

    def merit(self, length: float, rings: int, given: DefaultMerit | None) -> DefaultMerit:
        """The merit function of a step of a lens of focal length `length`, mm; given: settings of the caller."""
        if given is not None:
            return replace(given, rings=max(rings, given.rings))
        glass, air = ((length * least, length * most) for least, most in (self.glass, self.air))
        return DefaultMerit(rings=rings, arms=8, glass_thickness=glass, air_thickness=air, edge=length * self.edge)

    def conditions(self, length: float, hold: Sequence[str]) -> list[str]:
        """The conditions of `hold`, and those of the curriculum of other quantities."""
        words, quantities = [*hold], {split_constraint(word)[0] for word in hold}
        for limit, number in self.holds.items():
            name, relation = limit[:-2], limit[-2:]
            if name not in quantities:
                words.append(f"{name}{relation}{number if name.endswith('angle') else number * length:.6g}")
        return words


#: Camera of a phone: F/2 and 60° across, as the plates say, five or six plastics, the first search at 0.4 of the
#: aperture and half the field.
CURRICULA = {
    "phone": Curriculum(
        steps=(
            Step(0.4, 0.5, 4),
            Step(0.4, 0.5, 4, ("conic", "a4")),
            Step(0.5, 0.6, 5, ("conic", "a4", "a6")),
            Step(0.62, 0.73, 6, ("conic", "a4", "a6", "a8")),
            Step(0.77, 0.87, 7, ("conic", "a4", "a6", "a8", "a10"), 4),
            Step(0.9, 0.93, 8, ("conic", "a4", "a6", "a8", "a10"), 5),
            Step(1.0, 1.0, 9, ("conic", "a4", "a6", "a8", "a10", "a12"), 6, 120),
        ),
        starts=4,
        holds={"chief_ray_angle<=": 33.0, "total_track<=": 1.35, "bfd>=": 0.08},
        glass=(0.03, 0.16),
        air=(0.01, 0.2),
        edge=0.03,
    )
}


class FirstSearch(Protocol):
    """A search from starts: `search._Run`."""

    started: int
    followed: int

    def through(self, progress: Callable | None) -> None: ...

    def each(self) -> list[tuple[SearchProblem, Minimum]]: ...


@dataclass
class Plan:
    """A curriculum for a lens of plates: the search problem of every step.

    vary: variables of the first step, by default the lens's; bounds, merit: as for `search`; hold: all conditions.
    Raises NoProblem.
    """

    kind: str
    lens: Lens
    vary: str | Sequence[str] | None
    bounds: str | Sequence[str] | None
    hold: Sequence[str | Condition]
    merit: DefaultMerit | None

    def __post_init__(self) -> None:
        if self.kind not in CURRICULA:
            raise NoProblem(f"{option('kind', self.kind)}: expected {', '.join(CURRICULA)}"
                            f"{did_you_mean(self.kind, CURRICULA)}")  # fmt: skip
        self.words = [word for word in self.hold if isinstance(word, str)]
        self.others = [condition for condition in self.hold if isinstance(condition, Condition)]
        lens, held = self.lens, [word for word in self.words if word.startswith("efl=")]
        if not held:
            raise NoProblem(f"{option('kind', self.kind)} needs the focal length: {option('hold')} it, as efl=6")
        if lens.aperture.kind not in ("entrance_pupil_diameter", "image_f_number"):
            raise NoProblem(
                f"{option('kind', self.kind)}: the aperture of the lens is of the kind {lens.aperture.kind}; expected "
                "an entrance pupil diameter or an F/#"
            )
        if lens.operands or not lens.fields.extent:
            raise NoProblem(f"{option('kind', self.kind)}: expected a single configuration, and a field off the axis")
        self.length = float(held[0].removeprefix("efl="))
        self.curriculum = CURRICULA[self.kind]

    def problem(self, lens: Lens, step: Step) -> SearchProblem:
        """The search problem of a step, from a lens of the step before."""
        seen = self._seen(lens, step)
        free = design_variables(seen, self.vary)
        curved = [variable.surface for variable in free.variables if variable.quantity == "curvature"]
        if not curved:
            raise NoProblem(f"{option('kind', self.kind)}: no curvature varies: name them by {option('vary')}")
        words = [variable.name.replace("_", ":") for variable in free.variables]
        if step.terms:
            places = ",".join(map(str, curved))
            free = design_variables(seen, [*words, *(f"{term}:{places}" for term in step.terms)])
        function = merit_for(seen, self.curriculum.merit(self.length, step.rings, self.merit))
        if step.terms:
            function = replace(function, rows=(*function.rows, *self._full_thicknesses(seen, function.boundaries)))
        hold: list[str | Condition] = [*self.curriculum.conditions(self.length, self.words), *self.others]
        conditions = conditions_in_unit(seen, hold, function.unit)
        ends, limits = bounds_of(free.lens, free.variables, self.bounds), function.boundaries
        return SearchProblem(free, function.rows, conditions, ends, limits.glass, limits.air, function.options)

    @staticmethod
    def _full_thicknesses(lens: Lens, limits: Boundaries) -> Iterator[Row]:
        """Rows by which no two surfaces come too near to each other between the axis and the edge, as aspheres may."""
        for k in range(1, sensor(lens)):
            least = (limits.air or (0.0, 0.0))[0] if is_air(lens.surfaces[k].glass) else limits.edge or 0.0
            yield Row("FTGT", (k, 0), target=least, weight=1.0)

    def _seen(self, lens: Lens, step: Step) -> Lens:
        """The lens with the aperture and the fields of a step."""
        fields = np.linspace(0, step.field * self.lens.fields.extent, step.fields).tolist()
        number = float(self.lens.aperture.value)
        if self.lens.aperture.kind == "image_f_number":
            return lens.at(fields=fields, f_number=number / step.aperture)
        return lens.at(fields=fields, entrance_pupil_diameter=number * step.aperture)


@dataclass
class Growth:
    """The steps of a plan from the minima of its first search; first: that search; ended: where steps from a minimum
    ended before the last one, and why."""

    plan: Plan
    first: FirstSearch
    journal: Journal
    grown: list[tuple[SearchProblem, Minimum]] = field(default_factory=list)
    ended: list[str] = field(default_factory=list)

    DONE: ClassVar[str] = "steps"

    @property
    def started(self) -> int:
        return self.first.started

    @property
    def followed(self) -> int:
        """Descents that were followed to their end."""
        return self.first.followed

    def through(self, progress: Callable | None) -> None:
        """The search from plates, then the steps of the best minima. Raises SearchStopped and NoProblem."""
        self.first.through(progress)
        minima, steps = self.first.each()[:_FOLLOWED], self.plan.curriculum.steps[1:]
        bar = None if progress is None else progress(len(minima) * len(steps), "step")
        try:
            for task, minimum in minima:
                if (end := self._grown(task, minimum, steps, bar)) is not None:
                    self.grown.append(end)
        finally:
            if bar is not None:
                bar.close()

    def _grown(
        self, task: SearchProblem, minimum: Minimum, steps: Sequence[Step], bar: Any
    ) -> tuple[SearchProblem, Minimum] | None:
        """The lens at the end of the steps from a minimum; None where one of them loses rays or misses a condition.

        A step whose start is far from this lens is taken in halves. The last step is repeated with denser fields and
        rays while spots are worse between them.
        """
        result, seconds = minimum.result, minimum.seconds
        waiting, repeats, taken, halvings = list(steps), 0, self.plan.curriculum.steps[0], _HALVINGS
        for number in itertools.count(1):
            lens, step = task.model.lens_at(result.x), waiting.pop(0)
            task = self.plan.problem(lens, step)
            while halvings and self._is_far(task, result.merit):
                halvings -= 1
                waiting.insert(0, step)
                step = taken.halfway(step)
                task = self.plan.problem(lens, step)
            taken = step
            key, descent = f"{minimum.task}, step {number}", partial(self._descended, task, step)
            (result,) = self.journal.each([(key, descent)], len(task.model.start))
            seconds += result.seconds
            if bar is not None:
                bar.update(int(number <= len(steps)))
                bar.set_postfix_str(f"step {number}: merit {result.merit:.6g}")
            if not np.isfinite(result.merit) or result.lost:
                self._end(minimum, step, f"failing rays in {result.lost:g} rows")
                return None
            if not waiting and repeats < _REPEATS and worse_between(task.model.lens_at(result.x)):
                waiting.append(replace(step, fields=2 * step.fields - 1, rings=step.rings + _MORE_RINGS))
                repeats += 1
            if not waiting:
                break
        if not result.is_valid:
            self._end(minimum, step, "a condition is not met")
            return None
        return task, Minimum(result, minimum.task, seconds, minimum.descents)

    def _end(self, minimum: Minimum, step: Step, reason: str) -> None:
        """Note why the steps from a minimum ended."""
        place = f"{step.aperture:.0%} of the aperture and {step.field:.0%} of the field"
        self.ended.append(f"from minimum {minimum.task}: {reason} at {place}")

    @staticmethod
    def _is_far(task: SearchProblem, merit: float) -> bool:
        """Whether a step loses rays at its start, or has 100 times the merit of the step before there."""
        with np.errstate(all="ignore"):
            state = task.whole.state(np.clip(task.model.start, *task.bounds), False)
        return bool(state.lost) or not state.is_finite or state.merit > _LEAP * merit

    def _descended(self, task: SearchProblem, step: Step) -> TaskResult:
        """The end of a step; rays of the larger beam that fail are brought back first. Raises SearchStopped."""
        (lower, upper), started = task.bounds, time.process_time()  # the ranges of a search are for its starts
        x = np.clip(task.model.start, lower, upper)
        typical, until = typical_of(task.model), self.journal.until
        x = opened(task.whole, x, lower=lower, upper=upper, typical=typical, until=until).x
        stage = Stage(task.whole, step.cycles, SolverOptions(tolerance=1e-5), lower, upper, typical)
        end = descended(x, [stage], until)
        return end._replace(seconds=time.process_time() - started)

    def each(self) -> list[tuple[SearchProblem, Minimum]]:
        """The lenses at the end, the best first."""
        return sorted(self.grown, key=lambda pair: pair[1].result.merit)
