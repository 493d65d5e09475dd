"""Tasks of a search: the problem, its bounds and starts, descents in stages, the journal, and the distinct minima.

A search is a fixed sequence of tasks, each known by its key. Results are looked up in the journal first, so that a
resumed search repeats the course of an uninterrupted one. Processes share the tasks of a batch.

Default bounds follow from the focal length f and the radius h of the entrance pupil:

    |c| ≤ 1 / (0.9 h), 4 / f;  glass 0.02 f to 0.2 f, air 0.005 f to 0.35 f, before the image 0.05 f to 2 f
"""

import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from scipy.stats import qmc

from raytrace.optimization.conditions import Condition
from raytrace.optimization.least_squares import SolverOptions, least_squares
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.merit import RowOptions
from raytrace.optimization.problem import NoProblem, Problem
from raytrace.optimization.variables import DesignVariables
from raytrace.shards import agreeing, share, total
from raytrace.stores import DamagedLine, Kind, Records, listed, number, record, text
from raytrace.system.identity import identity, unlike
from raytrace.system.optimization_data import Row, Vary
from raytrace.system.parameter_paths import sensor
from raytrace.words import RaytraceError, calling_level, option

# -- the journal -------------------------------------------------------------------------------------------------------

FILE = "search.jsonl"
_TASK = record(
    {"task": text, "x": listed(number()), "seconds": number(0)}
    | dict.fromkeys(("lost", "missed", "merit"), number(0, infinite=True))
)


class BadSearch(RaytraceError, ValueError):
    """A folder of another search, or of none; the message says what was found and what was expected."""


class SearchStopped(Exception):
    """The time is up, or the user interrupted; the remaining tasks are not done."""


class TaskResult(NamedTuple):
    """Result of a task: failed rays, largest violation of a condition, merit, processor seconds, x (n,)."""

    lost: float
    missed: float
    merit: float
    seconds: float
    x: np.ndarray

    @property
    def rank(self) -> tuple[float, float, float]:
        """Lower is better: fewer failed rays, then conditions met, then a lower merit."""
        return self.lost, self.missed if self.missed > 1e-7 else 0.0, self.merit

    @property
    def is_valid(self) -> bool:
        return self.lost == 0 and self.missed <= 1e-6 and bool(np.isfinite(self.merit))


_JOURNAL = Kind(
    BadSearch,
    "it keeps no search: name a new folder",
    BadSearch,
    "{path} keeps a search of {difference}; name a new folder",
    unlike,
    "the search continues, but cannot resume from here",
)


class Journal:
    """Results of tasks, in a file of a folder or, without one, in memory alone."""

    def __init__(self, folder: str | PathLike | None, about: dict, until: float):
        """about: dependencies of the tasks, as a folder serves one search; until: a time of `time.monotonic`.

        Raises BadSearch.
        """
        self.until = until
        self.known: dict[str, TaskResult] = {}
        self.lines: dict[str, int] = {}
        self.store = Records(None if folder is None else Path(folder) / FILE, about, _JOURNAL, _TASK)
        for line, result in self.store.read():
            numbers = {name: result[name] for name in TaskResult._fields[:4]}
            self.known[result["task"]] = TaskResult(**numbers, x=np.array(result["x"]))
            self.lines[result["task"]] = line

    def each(
        self, tasks: Sequence[tuple[str, Callable[[], TaskResult]]], count: int | Sequence[int]
    ) -> list[TaskResult]:
        """Results of tasks, a key and a function each, at `count` variables, one number or that of each task. Raises
        SearchStopped."""
        counts = [count] * len(tasks) if isinstance(count, int) else list(count)
        for (key, _), count in zip(tasks, counts, strict=True):
            if key in self.known and len(self.known[key].x) != count:  # of another number of variables
                words = f"x: found a list of {len(self.known.pop(key).x)}, expected {count} of them"
                place = f"{self.store.path}, line {self.lines[key]}"
                warnings.warn(f"{place}: {words}; the line is ignored", DamagedLine, stacklevel=calling_level())
        left = [(key, task, count) for (key, task), count in zip(tasks, counts, strict=True) if key not in self.known]
        mine = share()
        table = torch.zeros(len(left), 5 + max(counts, default=0), dtype=torch.float64)
        stopped = False
        with agreeing():
            for k in mine.of(range(len(left))):
                key, task, count = left[k]
                try:
                    stopped = time.monotonic() > self.until
                    if stopped:
                        break
                    result = task()
                except (KeyboardInterrupt, SearchStopped):
                    stopped = True
                    break
                table[k, : 5 + count] = torch.tensor([1.0, *result[:4], *result.x], dtype=torch.float64)
                if mine.processes == 1:
                    self._add(key, result)
        if mine.processes > 1:
            for (key, _, count), row in zip(left, total(table), strict=True):
                if row[0]:
                    lost, missed, merit, seconds = row[1:5].tolist()
                    self._add(key, TaskResult(lost, missed, merit, seconds, row[5 : 5 + count].numpy()))
        if stopped or any(key not in self.known for key, _ in tasks):
            raise SearchStopped
        return [self.known[key] for key, _ in tasks]

    def _add(self, key: str, result: TaskResult) -> None:
        self.known[key] = result
        numbers = dict(zip(TaskResult._fields[:4], map(float, result[:4]), strict=True))
        self.store.append({"task": key, **numbers, "x": result.x.tolist()})


# -- minima ------------------------------------------------------------------------------------------------------------

_ALIKE = 0.03  # of the range of a variable: minima that are nearer are one
_EQUAL = 2e-2  # of the merit


@dataclass
class Minimum:
    """A minimum, the task that reached it, the processor seconds until then, and the number of descents to it."""

    result: TaskResult
    task: str
    seconds: float
    descents: int = 1


@dataclass
class Minima:
    """Distinct minima, the best first. ranges: (n,) of the variables; reversal: for a lens whose reversal has the same
    variables, the variable that each becomes, and its sign."""

    ranges: np.ndarray
    reversal: tuple[np.ndarray, np.ndarray] | None = None
    each: list[Minimum] = field(default_factory=list)

    def add(self, result: TaskResult, task: str, seconds: float) -> bool:
        """Add a result; whether it is new, or better than the minimum that it equals."""
        if not result.is_valid:
            return False
        same = next((minimum for minimum in self.each if self.is_same(minimum.result, result)), None)
        better = same is None or result.merit < same.result.merit * (1 - 1e-6)
        if same is None:
            self.each.append(Minimum(result, task, seconds))
        else:
            same.descents += 1
            if better:
                same.result, same.task, same.seconds = result, task, seconds
        self.each.sort(key=lambda minimum: minimum.result.merit)
        return better

    def is_same(self, result: TaskResult, other: TaskResult) -> bool:
        """Whether two results are of one minimum."""
        if abs(result.merit - other.merit) > _EQUAL * max(result.merit, other.merit):
            return False
        designs = [other.x]
        if self.reversal is not None:
            indices, signs = self.reversal
            designs.append(signs * other.x[indices])
        return any(np.abs((result.x - x) / self.ranges).max() < _ALIKE for x in designs)


# -- bounds and starts -------------------------------------------------------------------------------------------------

STEEPEST = 3.0  # curvature of a start in units of 1/f
_FACTORS = np.concatenate([np.geomspace(0.15, 4, 24), -np.geomspace(0.15, 4, 24)])  # of all curvatures
_HALVINGS = 40
_SPREAD = {"conic": (-2.0, 2.0), "index": (1.45, 1.9), "abbe_number": (20.0, 80.0)}

Range = tuple[float, float] | None


class Paraxial(NamedTuple):
    """Paraxial properties of a lens: power, 1/mm, None where it is free; distance of the sensor from the focus, mm."""

    power: float | None
    defocus: float


@dataclass(frozen=True)
class Space:
    """Search space: bounds (n,) of the variables, and the part (n,) of them from which starts are drawn.

    focal_length: mm that starts are scaled to, None where none is known.
    """

    model: DesignVariables
    lower: np.ndarray
    upper: np.ndarray
    low: np.ndarray
    high: np.ndarray
    focal_length: float | None

    def sobol(self, number: int, count: int, seed: int) -> np.ndarray:
        """(count, n) points from number·count of Sobol's sequence, scrambled by the seed."""
        sequence = qmc.Sobol(len(self.low), seed=seed)
        if number:
            sequence.fast_forward(number * count)
        return self.low + (self.high - self.low) * sequence.random(count)

    def prepared(self, x: np.ndarray) -> np.ndarray:
        """x with its curvatures scaled to the focal length and the sensor at the paraxial focus, within bounds."""
        power = None if self.focal_length is None else 1 / self.focal_length
        return self.restored(x, Paraxial(power, 0.0), self.lower, self.upper)

    def paraxial(self, x: np.ndarray) -> "Paraxial":
        """Power and defocus of the lens at x (n,)."""
        at_sensor = self._sensor
        defocus = 0.0 if at_sensor is None else float(x[at_sensor]) - self._image_distance(x)
        return Paraxial(self._power(x), defocus)

    def restored(self, x: np.ndarray, wanted: "Paraxial", lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """x within bounds (n,), with all curvatures that these leave free scaled to a power, or else the last of them
        changed, and the sensor, where it is free, at a defocus."""
        x, free = np.clip(x, lower, upper), upper > lower
        if wanted.power:
            x = np.clip(self._focused(x, wanted.power, free), lower, upper)
        at_sensor = self._sensor
        if at_sensor is not None and free[at_sensor]:
            distance = self._image_distance(x) + wanted.defocus
            if np.isfinite(distance):
                x[at_sensor] = np.clip(distance, lower[at_sensor], upper[at_sensor])
        return x

    @property
    def _sensor(self) -> int | None:
        """The number of the variable that is the distance of the sensor."""
        last = sensor(self.model.lens), "thickness"
        return next((k for k, variable in enumerate(self.model.variables) if variable.address == last), None)

    def _image_distance(self, x: np.ndarray) -> float:
        """Paraxial distance of the image from the last surface, mm; nan of a lens without one."""
        state = self._state(x)
        data = state.gaussian(state.primary)
        height, omega = data.A + data.B * state.vergence, data.C + data.D * state.vergence
        return float(-height * data.n_image / omega) if omega != 0 else np.nan

    def _power(self, x: np.ndarray) -> float:
        """Power in 1/mm, by the index of the image."""
        state = self._state(x)
        data = state.gaussian(state.primary)
        return float(-data.C / abs(data.n_image))

    def _state(self, x: np.ndarray) -> LensState:
        return self.model.views[self.model.lens.current_configuration - 1].state(x)

    def _focused(self, x: np.ndarray, power: float, free: np.ndarray) -> np.ndarray:
        """x for a power: with all free curvatures scaled by a factor, or else with the last of them changed."""

        def excess(x: np.ndarray) -> float:
            """Power beyond the wanted one, in its units."""
            return self._power(x) / power - 1

        curved = free & np.array([variable.quantity == "curvature" for variable in self.model.variables])
        if not curved.any():
            return x
        scaled = lambda s: np.where(curved, s * x, x)  # noqa: E731
        factor = _root(lambda s: excess(scaled(s)), _FACTORS, lambda s: abs(np.log(abs(s))))
        if factor is not None:
            return scaled(factor)
        last = np.nonzero(curved)[0][-1]
        moved = lambda c: np.where(np.arange(len(x)) == last, c, x)  # noqa: E731
        steps = np.linspace(self.lower[last], self.upper[last], 24)
        last_curvature = _root(lambda c: excess(moved(c)), steps, abs)
        return x if last_curvature is None else moved(last_curvature)


def _root(function: Callable[[float], float], points: np.ndarray, distance: Callable[[float], float]) -> float | None:
    """The root of least distance between neighbouring points within a factor; None without any."""
    values = np.array([function(point) for point in points])
    turns = np.nonzero(values[:-1] * values[1:] < 0)[0]
    pairs = [(points[k], points[k + 1]) for k in turns if abs(points[k] - points[k + 1]) < 1]
    if not pairs:
        return None
    low, high = min(pairs, key=lambda pair: distance(pair[0]))
    sign = np.sign(function(low))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.sign(function(middle)) == sign else (low, middle)
    return 0.5 * (low + high)


def space_of(
    model: DesignVariables,
    bounds: tuple[np.ndarray, np.ndarray],
    length: float | None,
    glass: Range = None,
    air: Range = None,
) -> Space:
    """The search space: bounds (n,), infinite ones replaced; length: the focal length in mm, None where it is free.

    glass, air: ranges of thicknesses, mm. Raises NoProblem where bounds are needed and no length is known.
    """
    ends = [_ends(model, variable, length, glass, air) for variable in model.variables]
    lower = np.where(np.isfinite(bounds[0]), bounds[0], [low for low, _ in ends])
    upper = np.where(np.isfinite(bounds[1]), bounds[1], [high for _, high in ends])
    for variable, least, most in zip(model.variables, lower, upper, strict=True):
        if not least <= most:
            raise NoProblem(
                f"{option('bounds')} of {variable.quantity}_{variable.surface}: from {least:g} to {most:g} there is "
                "nothing"
            )
    low, high = lower.copy(), upper.copy()
    for k, variable in enumerate(model.variables):
        if variable.quantity == "curvature" and length is not None:
            low[k], high[k] = max(low[k], -STEEPEST / length), min(high[k], STEEPEST / length)
            low[k], high[k] = (low[k], high[k]) if low[k] <= high[k] else (lower[k], upper[k])
    start = np.clip(model.start, lower, upper)
    finite = np.isfinite(low) & np.isfinite(high)
    return Space(model, lower, upper, np.where(finite, low, start), np.where(finite, high, start), length)


def _ends(
    model: DesignVariables, variable: Vary, length: float | None, glass: Range, air: Range
) -> tuple[float, float]:
    """Default bounds of a variable; infinite where there are none."""
    if variable.quantity in _SPREAD:
        return _SPREAD[variable.quantity]
    if variable.quantity not in ("curvature", "thickness") or variable.surface == 0:
        return -np.inf, np.inf
    if length is None:
        raise NoProblem(f"how large the lens is to be is not known: {option('hold')} its focal length, as efl=50")
    if variable.quantity == "curvature":
        aperture = model.lens.aperture
        if aperture.kind == "entrance_pupil_diameter":
            radius = 0.5 * float(aperture.value)
        elif aperture.kind in ("image_f_number", "paraxial_working_f_number"):
            radius = 0.5 * length / float(aperture.value)
        else:
            diameter = float(model.views[0].state(model.start).entrance_pupil_diameter)
            radius = 0.5 * diameter if np.isfinite(diameter) and diameter > 0 else length / 16
        steepest = min(1 / (0.9 * radius), 4 / length)
        return -steepest, steepest
    if variable.surface == sensor(model.lens):
        return 0.05 * length, 2 * length if np.isinf(float(model.lens.surfaces[0].thickness)) else 20 * length
    is_glass = abs(model.views[0].indices[model.lens.primary_wavelength - 1][variable.surface]) > 1.01
    least, most = (glass if is_glass else air) or ((0.02, 0.2) if is_glass else (0.005, 0.35))
    scale = 1.0 if (glass if is_glass else air) else length
    return scale * least, scale * most if np.isfinite(most) else (0.2 if is_glass else 0.35) * length


def length_of(
    model: DesignVariables, rows: Sequence[Row], unit: float, conditions: Sequence[Condition]
) -> float | None:
    """The focal length in mm of `hold`, of the target of a row EFFL, or of the lens; None of an afocal lens."""
    for condition in conditions:
        if condition.row.operand == "EFFL":
            return abs(condition.row.target * unit)
    targets = [row for row in rows if row.operand == "EFFL" and row.weight != 0 and row.target != 0]
    if targets:
        return abs(targets[0].target * unit)
    state = model.views[model.lens.current_configuration - 1].state(model.start)
    length = abs(float(state.gaussian(state.primary).effective_focal_length))
    return length if np.isfinite(length) else None


# -- descents ----------------------------------------------------------------------------------------------------------

#: Options of a descent to its minimum, and its maximum number of cycles.
FOLLOW, LONG = SolverOptions(tolerance=1e-5), 120
_AT_BOUND = 1e-9  # of the range of a variable


@dataclass(frozen=True)
class SearchProblem:
    """A lens with its variables, and the merit function of a search.

    rows, conditions: of the merit function, and constraints; bounds: lower and upper (n,), infinite where none are
    given; glass, air: ranges of thicknesses, mm; settings: of `Problem`.
    """

    model: DesignVariables
    rows: tuple[Row, ...]
    conditions: tuple[Condition, ...]
    bounds: tuple[np.ndarray, np.ndarray]
    glass: Range
    air: Range
    settings: RowOptions

    @cached_property
    def space(self) -> Space:
        length = length_of(self.model, self.rows, self.settings["unit"], self.conditions)
        return space_of(self.model, self.bounds, length, self.glass, self.air)

    @cached_property
    def whole(self) -> Problem:
        return self.problem(self.rows)

    def problem(self, rows: Sequence[Row]) -> Problem:
        """The problem of other rows."""
        return Problem(self.model, rows, self.conditions, **self.settings)

    def about(self, seed: int) -> dict:
        """Dependencies of a search, for its journal."""
        return {
            **identity(self.model.lens),
            "variables": [variable.name for variable in self.model.variables],
            "start": self.model.start.tolist(),
            "bounds": [self.space.lower.tolist(), self.space.upper.tolist()],
            "rows": [repr(row) for row in self.whole.evaluation.rows],
            "seed": seed,
        }


#: A minimum with its problem.
Found: TypeAlias = tuple[SearchProblem, Minimum]


class Stage(NamedTuple):
    """A descent on a problem between bounds (n,), in at most so many cycles; typical: as for `least_squares`."""

    problem: Problem
    cycles: int
    options: SolverOptions
    lower: np.ndarray
    upper: np.ndarray
    typical: np.ndarray | None = None

    def moves(self, x: np.ndarray) -> np.ndarray:
        """(n,) which variables are at none of their bounds."""
        near = _AT_BOUND * np.maximum(self.upper - self.lower, 0.0)
        return (x - self.lower > near) & (self.upper - x > near)


def descended(
    x: np.ndarray,
    stages: Sequence[Stage],
    until: float = np.inf,
    project: Callable[[Stage, np.ndarray], np.ndarray] | None = None,
) -> TaskResult:
    """The end of the stages in turn from x; all rays count as failed where a merit is not finite.

    until: a time of `time.monotonic`, after which a task is not completed; project: changes the variables before each
    stage. Raises SearchStopped.
    """
    started = time.process_time()
    for stage in stages:
        end = None
        with np.errstate(all="ignore"):
            x = np.clip(x if project is None else project(stage, x), stage.lower, stage.upper)
        with np.errstate(all="ignore"):
            if stage.problem.state(x, False).is_finite:
                with suppress(np.linalg.LinAlgError, RuntimeError):  # numbers overflow
                    end = least_squares(
                        stage.problem.state, x, lower=stage.lower, upper=stage.upper, typical=stage.typical,
                        options=stage.options, cycles=stage.cycles, until=until,
                    )  # fmt: skip
        if end is not None and end.stopped in ("interrupted", "seconds"):
            raise SearchStopped
        if end is None or not end.state.is_finite:
            return TaskResult(np.inf, np.inf, np.inf, time.process_time() - started, x)
        state, x = end.state, end.state.x
    missed = float(state.missed.max(initial=0.0))
    return TaskResult(state.lost, missed, float(np.sqrt(state.cost)), time.process_time() - started, x)
