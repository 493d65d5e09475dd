"""Optimising: the lens whose merit function is least, from the lens as it is."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from os import PathLike

import numpy as np
import torch

from raytrace.fused import prepare
from raytrace.merit.hold import conditions_of
from raytrace.merit.merit import Evaluated
from raytrace.merit.model import Model
from raytrace.merit.readings import Readings, readings_of
from raytrace.merit.value import Merit, in_unit, merit_for
from raytrace.merit.vary import Freedom, bounds_of, freedom, name_of
from raytrace.optimization.checkpoint import Checkpoint, Log, resumed
from raytrace.optimization.least_squares import Cycle, State
from raytrace.optimization.paths import Found, best_of_paths
from raytrace.optimization.problem import Condition, NoProblem, Problem
from raytrace.optimization.result import Optimized
from raytrace.system.intent import Intent, Row, Vary
from raytrace.system.lens import Lens


def optimize(
    lens: Lens,
    *,
    merit: str | Merit | Sequence[Row] | None = None,
    vary: str | Sequence[str | Vary] | None = None,
    bounds: str | Sequence[str] | None = None,
    hold: str | Sequence[str | Condition] | None = None,
    rings: int | None = None,
    arms: int | None = None,
    reference: str | None = None,
    frequencies: Sequence[float] | None = None,
    field_weights: Sequence[float] | None = None,
    wavelength_weights: Sequence[float] | None = None,
    glass_thickness: str | tuple[float, float] | None = None,
    air_thickness: str | tuple[float, float] | None = None,
    edge: float | None = None,
    cycles: int | None = None,
    seconds: float | None = None,
    paths: int = 1,
    skip_unknown: bool = False,
    readings: Readings | str | Sequence[str] | None = None,
    log: str | PathLike | None = None,
    checkpoint: str | PathLike | None = None,
    resume: str | PathLike | None = None,
    progress: Callable | None = None,
) -> Optimized:
    """The lens at the least of its merit function, by damped least squares on the exact derivatives of every row.

    merit: `Merit`, rows, by default the file's, or the kind of a default merit function: "spot", "wavefront",
    "angular", "mtf", which rings, arms, reference, frequencies (cycles/mm) and the weights of fields and wavelengths
    belong to, as in `default.rows_of`; boundaries in mm beside it: glass_thickness, air_thickness (least, greatest),
    edge (least).
    vary: variables, or words for them, as "curvature thickness:5,6", by default the file's; bounds: of variables, as
    "thickness:2,15"; hold: what is met exactly, as "efl=50 total_track<=80" (`merit.hold`). cycles, seconds: after
    which it ends; paths: how many ways of damping are tried. skip_unknown: leave rows of unknown operands out;
    readings: where an operand is open (`Readings`). log: a file with a line for every cycle; checkpoint: a file that
    keeps the best variables; resume: one that they are taken from. Ctrl-C ends with the best lens.
    Raises NoProblem, BadMerit, BadVariables, BadHold, BadRow, UnknownOperand, BadCheckpoint.
    """
    prepare()
    function = merit_for(
        lens, merit, rings=rings, arms=arms, reference=reference, frequencies=frequencies, field_weights=field_weights,
        wavelength_weights=wavelength_weights, glass_thickness=glass_thickness, air_thickness=air_thickness, edge=edge,
    )  # fmt: skip
    free = _freedom(lens, vary)
    names = tuple(name_of(one) for one in free.variables)
    model = Model(free.lens, free.variables, free.solves)
    problem = Problem(
        model,
        function.rows,
        _conditions(lens, hold, function.unit),
        unit=function.unit,
        skip_unknown=skip_unknown,
        readings=readings_of(readings),
    )
    lower, upper = _bounds(free, bounds, names)
    start = model.start if resume is None else resumed(resume, names)
    begun, before = time.monotonic(), problem.evaluated(model.start)
    _refuse_undefined(problem, before)
    with_log, kept = Log(log), Checkpoint(checkpoint, names)

    def watch(cycle: Cycle, state: State) -> None:
        with_log.tell(cycle)
        kept.keep(state.x, cycle.merit, cycle.number)
        if bar is not None:
            bar.update(1)
            bar.set_postfix_str(_words(cycle))

    bar = None if progress is None else progress(cycles, "cycle")
    try:
        found = best_of_paths(
            problem.state, np.clip(start, lower, upper), lower=lower, upper=upper, typical=problem.typical,
            paths=paths, cycles=cycles, seconds=seconds, watch=watch,
        )  # fmt: skip
        kept.keep(found.state.x, float(np.sqrt(found.state.cost)), found.cycles, now=True)
    finally:
        with_log.close()
        if bar is not None:
            bar.close()
    return _result(lens, problem, names, before, found, time.monotonic() - begun)


def _freedom(lens: Lens, vary: str | Sequence[str | Vary] | None) -> Freedom:
    if vary is None or isinstance(vary, str) or all(isinstance(one, str) for one in vary):
        return freedom(lens, vary)
    return Freedom(lens, tuple(vary), () if lens.intent is None else lens.intent.solves)


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
    """Raise NoProblem where the merit is no number at the start, or of no ray."""
    bad = ~np.isfinite(found.residuals)
    if bad.any():
        k = int(found.of_row[np.argmax(bad)])
        row, number = problem.evaluation.rows[k], found.values[k]
        raise NoProblem(f"row {k + 1} of the merit function, {row.name}, is {number:g} at the start")
    counted = np.unique(found.of_row)
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
    model, count = problem.model, len(problem.rows)
    after = problem.evaluated(found.state.x)
    history = [[c.merit, c.missed, c.step, c.damping, c.seconds] for c in found.history]
    tensor = lambda numbers: torch.tensor(np.asarray(numbers, dtype=float), dtype=torch.float64)  # noqa: E731
    return Optimized(
        lens=_with_intent(model.lens_at(found.state.x), model, problem),
        before=lens,
        merit=problem.rows,
        names=names,
        variables_before=tensor(model.start),
        variables_after=tensor(found.state.x),
        values_before=tensor(before.values[:count]),
        values_after=tensor(after.values[:count]),
        contributions_before=tensor(_contributions(before, count)),
        contributions=tensor(_contributions(after, count)),
        history=tensor(history).reshape(-1, 5),
        merit_before=problem.merit(before),
        merit_after=problem.merit(after),
        cycles=found.cycles,
        evaluations=found.evaluations,
        seconds=seconds,
        stopped=found.stopped,
    )


def _contributions(found: Evaluated, rows: int) -> np.ndarray:
    """The part (R,) of every row in the square of the merit."""
    squares = np.bincount(found.of_row, found.residuals**2, minlength=rows)[:rows]
    return squares / max(squares.sum(), 1e-300)


def _with_intent(lens: Lens, model: Model, problem: Problem) -> Lens:
    """The lens with what it was optimised for, where its file says nothing of it."""
    if lens.intent is not None:
        return lens
    return dataclasses.replace(lens, intent=Intent(model.variables, model.solves, problem.rows, problem.unit))
