"""Optimising: the lens whose merit function is least, from the lens as it is.

Opening: a start that most rays do not get through, opened step by step until they do.

Through a small enough part of its pupil and its field light passes every lens. There the lens descends for a few
cycles, then more is opened; what does not lose more at the next opening is kept, until no ray of the whole is lost.
"""

import dataclasses
import os
import time
import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from os import PathLike

import numpy as np
import torch

from raytrace.files import check_output
from raytrace.maths.result import plain
from raytrace.optimization.attained import NotReached, reached, refuse_contradictions
from raytrace.optimization.bfgs import Function, lowest
from raytrace.optimization.checkpoint import (
    BadCheckpoint,
    Checkpoint,
    Course,
    Found,
    Kept,
    Log,
    best_of_paths,
    is_better,
    resumed,
)
from raytrace.optimization.constraints import conditions_of
from raytrace.optimization.default_merit import DefaultMerit
from raytrace.optimization.glass_choice import Choice, catalogs_of, pool_of, without_glass
from raytrace.optimization.least_squares import Cycle, Manner, least_squares
from raytrace.optimization.lens_model import Model
from raytrace.optimization.merit import Merit, in_unit, merit_for
from raytrace.optimization.merit_rows import Evaluated
from raytrace.optimization.problem import Condition, NoProblem, Problem, optimization_data_of, typical_of
from raytrace.optimization.result import Optimized
from raytrace.optimization.variables import Freedom, bounds_of, freedom, name_of
from raytrace.system.identity import digest, identity
from raytrace.system.lens import Lens, field_points
from raytrace.system.optimization_data import Row, Vary
from raytrace.tracing.compiled import prepare
from raytrace.tracing.geometry import warn_of_defects
from raytrace.tracing.launch import warn_of_filling
from raytrace.words import calling_level

#: Parts of the pupil and of the field, in the order in which they are opened.
PARTS = (0.02, 0.05, *np.geomspace(0.1, 1.0, 14).tolist())

_FEW = 0.05  # of the rows: what fewer lose the descent itself brings back
_CYCLES = 12  # at one opening
_STEEPEST = 9.0  # curvature of what is typical: 0.9 over the radius of the beam
_DAMPED = Manner(damping=0.1, bends=False)


def opened(
    problem: Problem,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    until: float = np.inf,
    watch: Callable[[Cycle], None] | None = None,
) -> np.ndarray:
    """Variables (n,) at which less light is lost than at x; x itself where next to none is, or no way was found.

    lower, upper, typical: as for `least_squares`. until: of `time.monotonic`, when it ends; watch: invoked after each
    cycle.
    """
    begin = best = problem.state(x, False)
    if begin.lost <= _FEW * (problem.evaluation.weights != 0).sum():
        return x
    lower, upper = _no_steeper(problem, x, lower, upper)
    stages = [*(problem.through(part) for part in PARTS[:-1]), problem]
    for stage, wider in pairwise(stages):
        if time.monotonic() > until:
            break
        trial = _descended(stage, x, until, watch, lower=lower, upper=upper, typical=typical)
        if trial is None or wider.state(trial, False).lost > wider.state(x, False).lost:
            continue
        x, whole = trial, problem.state(trial, False)
        best = whole if whole.is_finite and is_better(whole, best) else best
        if best.lost == 0:
            break
    return best.x


def _no_steeper(problem: Problem, x: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, ...]:
    """Bounds within which the axial beam meets every sphere: a narrow part of it would let any curvature grow."""
    bent = np.array([one.quantity == "curvature" for one in problem.model.variables])
    steepest = np.where(bent, _STEEPEST * typical_of(problem.model), np.inf)
    return np.maximum(lower, np.minimum(x, -steepest)), np.minimum(upper, np.maximum(x, steepest))


def _descended(problem: Problem, x: np.ndarray, until: float, watch, **bounds) -> np.ndarray | None:
    """Where a few cycles lead; None where numbers overflow on the way."""
    try:
        with np.errstate(all="ignore"):
            each = watch and (lambda cycle, standing: watch(cycle))
            state = least_squares(
                problem.state, x, manner=_DAMPED, cycles=_CYCLES, until=until, watch=each, **bounds
            ).state
    except np.linalg.LinAlgError:
        return None
    return state.x if state.is_finite else None


#: Suffixes of the files that an optimisation writes beside its lens.
LOGS, CHECKPOINTS = (".csv", ".txt", ".log"), (".json",)


def optimize(
    lens: Lens,
    *,
    merit: str | Merit | DefaultMerit | Sequence[Row] | Callable[[Lens], torch.Tensor] | None = None,
    vary: str | Sequence[str | Vary] | None = None,
    bounds: str | Sequence[str] | None = None,
    hold: str | Sequence[str | Condition] | None = None,
    cycles: int | None = None,
    seconds: float | None = None,
    paths: int = 1,
    catalog: Sequence[str | PathLike] = (),
    log: str | PathLike | None = None,
    checkpoint: str | PathLike | None = None,
    resume: str | PathLike | None = None,
    progress: Callable | None = None,
) -> Optimized:
    """The lens at the least of its merit function, by damped least squares on the exact derivatives of every row.

    merit: `Merit`, the settings `DefaultMerit` of a default merit function or its kind ("spot", "wavefront", "angular",
    "mtf"), rows, by default the file's; or any function of a lens that returns one number () to minimise, by L-BFGS.
    vary: variables, or their syntax, as "curvature thickness:5,6", by default the file's; bounds: of variables, as
    "thickness:2,15"; hold: constraints met exactly, as "efl=50 total_track<=80" (`optimization.constraints`). cycles,
    seconds: limits, by default 500 cycles a path; paths: damping strategies to try. catalog: shipped catalogs or
    AGF files for variable glasses, by default those of the lens, else SCHOTT (`optimization.glass_choice`). log: a file
    with a line for every cycle; checkpoint: a file (.json) of the state of the descent; resume: such a file of the same
    lens, variables and merit function, from which the descent resumes bit-identically, cycles counted from its start
    (`checkpoint.py`). Ctrl-C ends with the best lens.
    Conditions that exclude one another for certain are refused. Conditions and boundaries that are not met at the end
    are in `Optimized.conditions` with the reason; they are warned of (NotReached), as are surfaces and gaps that cannot
    be made (Unbuildable).
    Raises NoProblem, BadMerit, BadVariables, BadHold, BadRow, UnknownOperand, BadCheckpoint.
    """
    prepare()
    begun = time.monotonic()
    until = np.inf if seconds is None else begun + seconds
    _check_files(log, checkpoint, resume)
    warn_of_filling(lens, field_points(None, like=lens))
    free, glasses = without_glass(_freedom(lens, vary), vary)
    names = tuple(name_of(one) for one in free.variables)
    model = Model(free.lens, free.variables, free.solves)
    lower, upper = _bounds(free, bounds, names)
    how = {"lower": lower, "upper": upper, "typical": typical_of(model), "cycles": cycles}
    of = {**identity(lens), "variables": list(names), "solves": digest(repr(free.solves)), "paths": paths}
    of |= {"glasses that vary": list(glasses), "bounds": plain([lower.tolist(), upper.tolist()])}
    if callable(merit):
        if glasses:
            raise NoProblem("`vary=glass` goes with a merit of rows: make the function a row")
        if hold:
            raise NoProblem("`hold` goes with a merit of rows: of a function give `bounds`, or make it a row")
        of["merit"] = getattr(merit, "__qualname__", type(merit).__name__)
        kept = Kept(model.start, {}) if resume is None else resumed(resume, of, names)
        with _Told(log, Checkpoint(checkpoint, of, names), progress and progress(cycles, "cycle"), kept.course) as told:
            start, function = np.clip(model.start, lower, upper), Function(model, merit, kept.evaluated)
            return _warned(_by_gradient(lens, function, names, start, how, told, begun, until))
    function = merit_for(lens, merit)
    conditions = _conditions(lens, hold, function.unit)
    of_rows = {"unit": function.unit, "skip_unknown": function.skip_unknown, "conventions": function.conventions}
    problem = Problem(model, function.rows, conditions, **of_rows)
    of |= {"merit": digest([repr(row) for row in function.rows], of_rows), "hold": digest(repr(conditions))}
    kept = Kept(model.start, {}) if resume is None else resumed(resume, of, names)
    if set(kept.glasses) - set(glasses):
        raise BadCheckpoint(f"{resume}: glasses: found surfaces {[*kept.glasses]}, expected some of {[*glasses]}")
    start, choice, opening = np.clip(kept.x, lower, upper), None, []
    refuse_contradictions(problem, start, lower=lower, upper=upper)
    before, seconds_of_end = _timed(lambda: problem.evaluated(model.start))
    if not kept.glasses and kept.course is None:
        start = opened(
            problem, start, lower=lower, upper=upper, typical=how["typical"], until=until, watch=opening.append
        )
        begin, again = _timed(lambda: problem.evaluated(start, True))
        _refuse_undefined(problem, begin)
        seconds_of_end = min(seconds_of_end, again)  # the first evaluation takes longer
    until -= seconds_of_end  # the result is evaluated once more
    bar = progress and progress(cycles, "cycle")
    with _Told(log, Checkpoint(checkpoint, of, names), bar, kept.course) as told:
        if glasses:
            pool, limits = pool_of(lens, catalogs_of(lens, catalog)), (lower, upper)
            how_chosen = {"cycles": cycles, "until": until, "keep": told.kept.keep_glasses, **of_rows}
            choice = Choice(free, glasses, pool, function.rows, conditions, limits, **how_chosen)
            start, problem = choice.run(start, kept).x, choice.problem(choice.best.glasses, ())
        how["seconds"] = None if seconds is None else until - time.monotonic()
        found = best_of_paths(problem.state, start, paths=paths, watch=told.tell, course=kept.course, **how)
        told.kept.keep(
            found.state.x, float(np.sqrt(found.state.cost)), len(found.history), course=told.course, now=True
        )
    found = dataclasses.replace(found, cycles=found.cycles + len(opening) + (choice.descended if choice else 0))
    done = _result(lens, problem, names, before, found, time.monotonic() - begun)
    ends = reached(problem, found.state.x, lower=lower, upper=upper)
    done = dataclasses.replace(done, lens=_with_bounds(done.lens, free.variables, lower, upper), conditions=ends)
    return _warned(_with_choice(done, choice))


def _check_files(log, checkpoint, resume) -> None:
    """Refuse files that cannot be written, or that are one file, before the work. Raises ValueError and OSError."""
    for path, suffixes in ((log, LOGS), (checkpoint, CHECKPOINTS)):
        if path is not None:
            check_output(path, suffixes)
    for option, path in (("checkpoint", checkpoint), ("resume", resume)):
        if None not in (log, path) and os.path.realpath(log) == os.path.realpath(path):
            raise ValueError(f"{log}: `log` and `{option}` are one file; give them two")


class _Told:
    """Who is told of every cycle: a log, a checkpoint and a bar of progress; course: what is resumed."""

    def __init__(self, log, kept: Checkpoint, bar, course: Course | None):
        cycles = () if course is None else course.history
        self.log, self.kept, self.bar, self.course = Log(log, cycles), kept, bar, course
        if bar is not None and cycles:
            bar.update(len(cycles))

    def tell(self, cycle: Cycle, course: Course) -> None:
        """After a cycle of damped least squares."""
        self.course = course
        self.kept.keep(course.standing.x, cycle.merit, cycle.number, course=course)
        self._show(cycle)

    def tell_evaluated(self, cycle: Cycle, x: np.ndarray, evaluated: Sequence[np.ndarray]) -> None:
        """After a cycle of a merit that is no sum of squares."""
        self.kept.keep(x, cycle.merit, cycle.number, evaluated=evaluated)
        self._show(cycle)

    def _show(self, cycle: Cycle) -> None:
        self.log.tell(cycle)
        if self.bar is not None:
            self.bar.update(1)
            self.bar.set_postfix_str(_words(cycle))

    def __enter__(self) -> "_Told":
        return self

    def __exit__(self, *error) -> None:
        if self.bar is not None:
            self.bar.close()


def _by_gradient(
    lens: Lens, function: Function, names: tuple[str, ...], start, how: dict, told: _Told, begun: float, until: float
) -> Optimized:
    """The lens where a function of it is least."""
    model = function.model
    if not names:
        raise NoProblem("nothing varies: name variables by `vary`, as 'curvature thickness'")
    before = function(model.start)[0]
    if not np.isfinite(before):
        raise NoProblem(f"the merit is {before:g} at the start: nothing to follow")
    left = None if np.isinf(until) else until - time.monotonic()
    watch = lambda cycle, x: told.tell_evaluated(cycle, x, function.evaluated)  # noqa: E731
    x, stopped, cycles = lowest(function, start, watch=watch, seconds=left, **how)
    after = function(x)[0]
    told.kept.keep(x, after, len(cycles), evaluated=function.evaluated, now=True)
    found = Found(x, tuple(cycles), stopped, len(cycles), function.evaluations)
    return _optimized(lens, model, names, x, found, time.monotonic() - begun, merit_before=before, merit_after=after)


def _timed(evaluate: Callable):
    """What a function gives, and the seconds that it takes."""
    begun = time.monotonic()
    return evaluate(), time.monotonic() - begun


def _freedom(lens: Lens, vary: str | Sequence[str | Vary] | None) -> Freedom:
    if vary is None or isinstance(vary, str) or all(isinstance(one, str) for one in vary):
        return freedom(lens, vary)
    return Freedom(lens, tuple(vary), () if lens.optimization_data is None else lens.optimization_data.solves)


def _conditions(lens: Lens, hold: str | Sequence[str | Condition] | None, unit: float) -> tuple[Condition, ...]:
    """What is held, from mm to the unit of length of the merit function."""
    in_words = hold is None or isinstance(hold, str) or all(isinstance(one, str) for one in hold)
    found = conditions_of(lens, hold) if in_words else hold
    return tuple(dataclasses.replace(one, row=in_unit(one.row, 1.0, unit)) for one in found)


def _bounds(free: Freedom, bounds: str | Sequence[str] | None, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (n,) of the variables. Raises NoProblem where none is left between them."""
    lower, upper = bounds_of(free.lens, free.variables, bounds)
    for name, least, most in zip(names, lower, upper, strict=True):
        if not least <= most:
            raise NoProblem(f"`bounds` of {name}: from {least:g} to {most:g} there is nothing")
    return lower, upper


def _refuse_undefined(problem: Problem, found: Evaluated) -> None:
    """Raise NoProblem where the merit, or a derivative of it, is no number at the start, or where it is of no ray."""
    bad = ~np.isfinite(found.residuals)
    if bad.any():
        k = int(found.of_row[np.argmax(bad)])
        row, number = problem.evaluation.rows[k], found.values[k]
        raise NoProblem(f"row {k + 1} of the merit function, {row.name}, is {number:g} at the start")
    counted = np.unique(found.of_row)
    if not np.isfinite(found.jacobian).all():
        k, variable = np.argwhere(~np.isfinite(found.jacobian))[0]
        row, name = int(found.of_row[k]), name_of(problem.model.variables[variable])
        raise NoProblem(
            f"row {row + 1} of the merit function, {problem.evaluation.rows[row].name}, has no derivative by {name} at "
            f"the start: {found.jacobian[k, variable]:g}"
        )
    if found.lost[counted].all():
        raise NoProblem("no row of the merit function has a value: no ray of them gets through the lens as it is")


def _words(cycle: Cycle) -> str:
    said = [f"merit {cycle.merit:.6g}", f"step {cycle.step:.1e}"]
    if cycle.missed > 1e-9:
        said.append(f"held to {cycle.missed:.1e}")
    return ", ".join([*said, *filter(None, [cycle.limits])])


def _result(
    lens: Lens, problem: Problem, names: tuple[str, ...], before: Evaluated, found: Found, seconds: float
) -> Optimized:
    after, count = problem.evaluated(found.state.x), len(problem.rows)
    return _optimized(
        lens, problem.model, names, found.state.x, found, seconds, rows=problem.rows, unit=problem.unit,
        merit_before=problem.merit(before), merit_after=problem.merit(after),
        values=(before.values[:count], after.values[:count]),
        contributions=(_contributions(before, count), _contributions(after, count)),
    )  # fmt: skip


def _optimized(
    lens: Lens,
    model: Model,
    names: tuple[str, ...],
    x: np.ndarray,
    found: Found,
    seconds: float,
    *,
    merit_before: float,
    merit_after: float,
    rows: tuple[Row, ...] = (),
    unit: float = 1.0,
    values: tuple = ((), ()),
    contributions: tuple = ((), ()),
) -> Optimized:
    def tensor(numbers) -> torch.Tensor:
        return torch.tensor(np.asarray(numbers, dtype=float), dtype=torch.float64)

    history = [[c.merit, c.missed, c.step, c.damping, c.seconds] for c in found.history]
    return Optimized(
        lens=_with_optimization_data(model.lens_at(x), model, rows, unit),
        before=lens,
        merit=rows,
        names=names,
        variables_before=tensor(model.start),
        variables_after=tensor(x),
        values_before=tensor(values[0]),
        values_after=tensor(values[1]),
        contributions_before=tensor(contributions[0]),
        contributions=tensor(contributions[1]),
        history=tensor(history).reshape(-1, 5),
        merit_before=merit_before,
        merit_after=merit_after,
        cycles=found.cycles,
        evaluations=found.evaluations,
        seconds=seconds,
        stopped=found.stopped,
    )


def _warned(found: Optimized) -> Optimized:
    """The result, with a warning for every condition that is not met, and for what of the lens cannot be made."""
    for one in found.conditions:
        if not one.met:
            warnings.warn(str(one), NotReached, stacklevel=calling_level())
    for lens in found.lens.configurations:
        warn_of_defects(lens)
    return found


def _with_choice(found: Optimized, choice: Choice | None) -> Optimized:
    """The result with how its glasses were chosen."""
    if choice is None:
        return found
    evaluations = found.evaluations + choice.evaluations
    return dataclasses.replace(found, glasses=tuple(choice.steps), evaluations=evaluations)


def _contributions(found: Evaluated, rows: int) -> np.ndarray:
    """The part (R,) of every row in the square of the merit."""
    squares = np.bincount(found.of_row, found.residuals**2, minlength=rows)[:rows]
    return squares / max(squares.sum(), 1e-300)


def _with_optimization_data(lens: Lens, model: Model, rows: tuple[Row, ...], unit: float) -> Lens:
    """The lens with what it was optimised for, where its file says nothing of it."""
    if lens.optimization_data is not None:
        return lens
    return dataclasses.replace(lens, optimization_data=optimization_data_of(model, rows, unit))


def _with_bounds(lens: Lens, variables: Sequence[Vary], lower: np.ndarray, upper: np.ndarray) -> Lens:
    """The lens whose variables, where its optimisation data has them, have the bounds that held."""
    ends = zip(map(float, lower), map(float, upper), strict=True)
    held = {name_of(one): pair for one, pair in zip(variables, ends, strict=True) if not np.isinf(pair).all()}
    told = tuple(
        dataclasses.replace(one, bounds=held.get(name_of(one), one.bounds)) for one in lens.optimization_data.variables
    )
    return dataclasses.replace(lens, optimization_data=dataclasses.replace(lens.optimization_data, variables=told))
