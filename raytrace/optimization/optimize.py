"""Optimising: the lens at a minimum of its merit function, from the lens as it is (`opening`, `least_squares`)."""

import dataclasses
import inspect
import logging
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any, TypeAlias

import numpy as np
import torch

from raytrace.files import check_output
from raytrace.maths.result import plain
from raytrace.optimization.attained import Attained, NotReached, attained
from raytrace.optimization.between import between, warn_of_worse
from raytrace.optimization.checkpoint import BadCheckpoint, Checkpoint, Log, Stored, read_checkpoint
from raytrace.optimization.conditions import Condition, conditions_in_unit, specified
from raytrace.optimization.contradictions import refuse_contradictions, with_reasons
from raytrace.optimization.fitting import Design
from raytrace.optimization.glass_choice import Choice, catalogs_of, pool_of
from raytrace.optimization.least_squares import Cycle, NoOptimum, PathProgress, best_of_paths
from raytrace.optimization.loss import Loss, LossDescents
from raytrace.optimization.merit import DefaultMerit, Evaluated, Merit
from raytrace.optimization.opening import Opened, opened
from raytrace.optimization.optimized import AsBuiltChange, Optimized
from raytrace.optimization.plate_fit import PlateFit
from raytrace.optimization.problem import (
    ExpectationSettings,
    NoProblem,
    Problem,
    optimization_data_of,
    typical_of,
)
from raytrace.optimization.quantities import Quantity, quantity_of
from raytrace.optimization.spacer_choice import choose_spacers, materials_of, without_glasses, without_spacers
from raytrace.optimization.stock_fit import StockFit
from raytrace.optimization.variables import DesignVariables, bounds_of, design_variables, without_glass
from raytrace.stock.index import parts_of
from raytrace.stock.plates import TestPlate, read_plates
from raytrace.system.identity import digest, identity
from raytrace.system.lens import Lens, field_points
from raytrace.system.optimization_data import OptimizationData, Row, Vary
from raytrace.system.parameter_paths import OF_LENS
from raytrace.tracing.compiled import prepare
from raytrace.tracing.geometry import warn_of_defects, with_contacts, with_semi_diameters
from raytrace.tracing.launch import warn_of_filling
from raytrace.words import calling_level, option

_LOG = logging.getLogger(__name__)
_CONTACTS = 4  # times that the spacers of a lens with temperatures have contact at the semi-diameters of its rays anew

#: Suffixes of the files that an optimisation writes beside its lens.
LOGS, CHECKPOINTS = (".csv", ".txt", ".log"), (".json",)

Numbers: TypeAlias = np.ndarray | Sequence[float]


def optimize(
    lens: Lens,
    *,
    merit: str | Merit | DefaultMerit | Sequence[Row] | Callable[[Lens], torch.Tensor] | None = None,
    loss: Callable[..., torch.Tensor] | None = None,
    of: str | Quantity = "points",
    object_distances: Sequence[float] | None = None,
    first: str | Merit | DefaultMerit | Sequence[Row] | None = "spot",
    restarts: int = 2,
    check_rings: int | None = None,
    vary: str | Sequence[str | Vary] | None = None,
    bounds: str | Sequence[str] | None = None,
    hold: str | Sequence[str | Condition] | None = (),
    stored: bool = True,
    as_built: ExpectationSettings | None = None,
    cycles: int | None = None,
    seconds: float | None = None,
    paths: int = 1,
    catalog: Sequence[str | PathLike] = (),
    glasses: str | Sequence[str] = "",
    stock: str | PathLike | None = None,
    test_plates: str | PathLike | Sequence[TestPlate] | None = None,
    mounts: str | Sequence[str] = "",
    log: str | PathLike | None = None,
    checkpoint: str | PathLike | None = None,
    resume: str | PathLike | None = None,
    progress: Callable | None = None,
    watch: Callable[[Cycle, Lens], object] | None = None,
) -> Optimized:
    """The lens at a minimum of its merit function, by damped least squares with the exact derivatives of every row.

    merit: `Merit`, the settings `DefaultMerit` of a default merit function or its kind ("spot", "wavefront", "angular",
    "mtf"), rows, by default the file's; or any function of a lens that returns one number (), a loss without `first`
    and `restarts`. loss: a function of a quantity of the lens that returns one number () to minimise, by lifted least
    squares (`optimization.lifted`); of: the quantity, "points", "otf" or "kernels", its settings
    (`optimization.quantities`, `imaging.LensPictures`), or "lens"; object_distances: (D,) mm at which the quantity of
    the one lens is taken, in each of its configurations; first: rows that are minimised first, whose boundaries are met
    exactly; None for none; restarts: descents from lenses displaced at random by a part of the width of their spots.
    The end is judged by denser rays (`Optimized`), of check_rings rings, by default twice as many.
    vary: variables, or their syntax, as "curvature thickness:5,6" (surfaces 5 and 6), by default the file's; bounds: of
    variables, as "thickness:2..15" (mm); hold: conditions met exactly, as "efl=50 total_track<=80"
    (`optimization.conditions`), in addition to `lens.conditions` and instead of its conditions of the same
    quantity; stored: False, or None as `hold`: without the conditions of the lens. The optimised lens has all of them.
    as_built: `rt.tolerancing.AsBuilt`, the expected mean square spot of the manufactured lens as a term of the merit.
    cycles, seconds: limits, by default 500 cycles a path, and 300 a descent of a loss, without those of `first`;
    paths: damping strategies to try.
    catalog: shipped catalogs or AGF files for variable glasses, by default those of the lens, else SCHOTT
    (`optimization.glass_choice`); glasses: a selection of them, as "preferred price<=3 transmittance:0.4>=0.98", by
    default without obsolete, special and radiation-hard ones (`rt.glasses`), but with the lens's own. mounts: materials
    for "spacer" and "barrel" in vary, as "aluminium titanium 12.5" (`optimization.spacer_choice`).
    stock: an index of parts (`rt.stock_index`): the optimised lens takes the best part, in its best orientation, for
    each element and cemented group with a variable curvature, one after the other, and the rest is optimised after
    each; test_plates: a list (.csv, `stock.plates.read_plates`), from which each variable radius takes a value likewise
    (`optimization.fitting`); `Optimized.fitted` reports both.
    log: a file with a line for every cycle; checkpoint: a file (.json) of the state of the descent; resume: such a file
    of the same lens, variables and merit function, from which the descent resumes bit-identically (with real ray
    aiming, whose rays start from those of the last cycle, to 1e-10 of the merit), cycles counted from its start.
    watch: invoked after each cycle, except those of the choice of glasses, with its report and lens, while the system
    is opened the best one. Ctrl-C, or a KeyboardInterrupt that `watch` raises, ends with the best lens.
    Conditions that certainly exclude one another are refused. Conditions and boundaries that are not met at the end
    are in `Optimized.conditions` with the reason, with a warning (NotReached), as for surfaces and gaps that cannot
    be made (Unbuildable), and for spots that are more than 1.5 times as large between the fields, wavelengths or rays
    of the lens as beside them (WorseBetween; `Optimized.between` and the text list all ratios).
    Raises NoProblem, BadMerit, BadVariables, BadHold, BadRow, UnknownOperand, BadCheckpoint, BadTolerance, BadStock,
    BadPlates.
    """
    prepare()
    started = time.monotonic()
    until = np.inf if seconds is None else started + seconds
    for path, suffixes in ((log, LOGS), (checkpoint, CHECKPOINTS)):
        if path is not None:
            check_output(path, suffixes)
    for name, path in (("checkpoint", checkpoint), ("resume", resume)):
        if log is not None and path is not None and os.path.realpath(log) == os.path.realpath(path):
            raise ValueError(f"{log}: {option('log')} and {option(name)} are one file; give them two")
    vary, spaces = without_spacers(lens, vary)
    if spaces:
        function = merit if callable(merit) else None
        others = ("log", log), ("checkpoint", checkpoint), ("resume", resume), ("loss", loss), ("merit", function)
        for name, setting in (*others, ("stock", stock), ("test_plates", test_plates)):
            if setting is not None:
                raise NoProblem(f"{option('vary', 'spacer')} goes without {option(name)}: leave one out")
        return _with_spacers(
            lens, spaces, materials_of(mounts), vary, merit, hold, until, stored=stored, cycles=cycles, bounds=bounds,
            as_built=as_built, paths=paths, catalog=catalog, glasses=glasses, progress=progress, watch=watch,
        )  # fmt: skip
    warn_of_filling(lens, field_points(None, like=lens))
    model, chosen = without_glass(design_variables(lens, vary), vary)
    pool = pool_of(lens, catalogs_of(lens, catalog), glasses) if chosen else None
    is_fitted = stock is not None or test_plates is not None
    if is_fitted:
        _refuse_beside_fit(
            "test_plates" if stock is None else "stock",
            loss=loss is not None or callable(merit), checkpoint=checkpoint is not None, resume=resume is not None,
            glass=bool(chosen), as_built=stock is not None and as_built is not None,
            test_plates=stock is not None and test_plates is not None,
        )  # fmt: skip
    plates = read_plates(test_plates) if isinstance(test_plates, str | PathLike) else test_plates
    if stock is not None:
        parts_of(stock)  # refused before the work
    names = tuple(variable.name for variable in model.variables)
    if not names:
        raise NoProblem(f"nothing varies: name variables by {option('vary')}, as 'curvature thickness'")
    lower, upper = bounds_of(model.lens, model.variables, bounds)
    for name, least, most in zip(names, lower, upper, strict=True):
        if not least <= most:
            raise NoProblem(f"{option('bounds')} of {name}: from {least:g} to {most:g} there is nothing")
    typical = typical_of(model)
    is_kept = checkpoint is not None or resume is not None

    def about(**of_merit: object) -> dict[str, object]:
        """All that a checkpoint depends on."""
        variables = {"variables": list(names), "solves": digest(repr(model.solves)), "paths": paths}
        variables |= {"glasses that vary": list(chosen), "bounds": plain([lower.tolist(), upper.tolist()])}
        return {**identity(lens), **variables, **of_merit}

    def kept(about: Mapping[str, object]) -> Stored:
        return Stored(model.start, {}) if resume is None else read_checkpoint(resume, about, names)

    def observer(
        about: Mapping[str, object], lens_at: Callable[[np.ndarray], Lens], descent: PathProgress | None = None
    ) -> "_Observer":
        file = None if checkpoint is None else Checkpoint(checkpoint, about, names)
        shown = None if watch is None else lambda cycle, x: watch(cycle, lens_at(x))
        return _Observer(log, file, progress and progress(cycles, "cycle"), descent, shown)

    dependencies: dict[str, object] = {}
    if loss is not None and merit is not None:
        raise NoProblem(
            f"{option('loss')} and {option('merit')}: give one; rows to minimise before are {option('first')}"
        )
    if loss is None:
        _refuse_without_loss(
            of=of, object_distances=object_distances, first=first, restarts=restarts, check_rings=check_rings
        )
    if (loss is not None or callable(merit)) and paths != 1:
        raise NoProblem(f"{option('paths')} are of a merit of rows; a loss has {option('restarts')}")
    if restarts < 0:
        raise NoProblem(f"{option('restarts')} {restarts}: expected 0 or more")
    if callable(merit):
        loss, first, restarts, quantity, merit = merit, None, 0, None, None
    else:
        quantity = quantity_of(of)
    if loss is not None and (chosen or as_built is not None):
        words = option("vary", "glass") if chosen else option("as_built")
        raise NoProblem(f"{words} goes with a merit of rows, not with a function: leave it out")
    rows, held = specified(lens, merit if loss is None else first or "spot", hold, stored=stored)
    conditions, of_rows = conditions_in_unit(lens, held, rows.unit), rows.options
    term = None if as_built is None else as_built.of(model.lens)
    problem = Problem(model, rows.rows, conditions, as_built=term, **of_rows)
    if is_kept:
        dependencies = about(merit=digest([repr(row) for row in rows.rows], of_rows), hold=digest(repr(conditions)))
        dependencies |= {} if term is None else {"as built": digest(term.about())}
    if is_kept and loss is not None:
        name = getattr(loss, "__qualname__", type(loss).__name__)
        dependencies |= {"loss": name, "of": repr(quantity), "object distances": plain(object_distances)}
        dependencies |= {"restarts": restarts, "first": first is not None}
    resumed = kept(dependencies)
    if set(resumed.glasses) - set(chosen):
        raise BadCheckpoint(f"{resume}: glasses: found surfaces {[*resumed.glasses]}, expected some of {[*chosen]}")
    start, opening = np.clip(resumed.x, lower, upper), Opened(resumed.x)
    choice: Choice | None = None
    ends = {name: (float(least), float(most)) for name, least, most in zip(names, lower, upper, strict=True)}
    bounded = {name: pair for name, pair in ends.items() if not np.isinf(pair).all()}

    data = optimization_data_of(model, problem.rows if loss is None else (), problem.unit, held)

    def lens_at(x: np.ndarray) -> Lens:
        return _lens_at(problem.model, x, data, bounded)

    def ended(x: np.ndarray, history: Sequence[Cycle], after: Evaluated, **more: Any) -> Optimized:
        """The result at variables x (n,), with its warnings; more: further fields."""
        results = _attained(problem, after, x, lower=lower, upper=upper)
        seconds = time.monotonic() - started
        end, model = with_semi_diameters(lens_at(x)), problem.model  # the automatic ones follow the rays
        return _warned(_optimized(lens, end, model, x, history, conditions=results, seconds=seconds, **more))

    if conditions:
        refuse_contradictions(problem, start, lower=lower, upper=upper)
    if loss is not None:
        measured = Loss.of(loss, quantity, object_distances, check_rings)
        descents = LossDescents(problem, measured, (lower, upper), resumed.evaluated)
        if len(resumed.evaluated) and not descents.is_that_of(resumed.evaluated[0]):
            raise BadCheckpoint(
                f"{resume}: the loss is another function than that of the checkpoint, though of the same name: at the "
                "first lens of that run it has another value; give that function, without noise of its own, or start "
                f"without {option('resume')}"
            )
        with observer(dependencies, lens_at) as seen:

            def each(cycle: Cycle, x: np.ndarray) -> None:
                seen.after_cycle(cycle, x, evaluated=descents.function.evaluated)

            reached = descents.run(
                np.clip(model.start, lower, upper), first=first is not None, restarts=restarts, cycles=cycles,
                until=until, watch=each,
            )  # fmt: skip
            seen.write(
                reached.x, reached.report.end, len(reached.history), evaluated=descents.function.evaluated, now=True
            )  # fmt: skip
        return ended(
            reached.x, reached.history, problem.evaluated(reached.x), cycles=reached.cycles, stopped=reached.stopped,
            merits=(reached.report.start_of_end, reached.report.end), evaluations=reached.evaluations,
            loss=reached.report,
        )  # fmt: skip
    evaluating = time.monotonic()
    before = problem.evaluated(model.start)
    seconds_of_end = time.monotonic() - evaluating
    if not resumed.glasses and resumed.descent is None:
        opening = opened(
            problem, start, lower=lower, upper=upper, typical=typical, until=until,
            watch=None if watch is None else lambda cycle, x: watch(cycle, lens_at(x)),
        )  # fmt: skip
        start = opening.x
        evaluating = time.monotonic()
        _refuse_undefined(problem, problem.evaluated(start, True))
        seconds_of_end = min(seconds_of_end, time.monotonic() - evaluating)  # the first evaluation takes longer
    until -= seconds_of_end  # the result is evaluated once more
    with observer(dependencies, lens_at, resumed.descent) as seen:
        if pool is not None and not opening.interrupted:
            keep = None if seen.checkpoint is None else seen.checkpoint.write_glasses
            choice = Choice(
                model, chosen, pool, rows.rows, conditions, (lower, upper), cycles=cycles, until=until, keep=keep,
                as_built=term, **of_rows,
            )  # fmt: skip
            start, problem = choice.run(start, resumed).x, choice.problem(choice.best.glasses, ())
        descent = best_of_paths(
            problem.state, start, lower=lower, upper=upper, typical=typical, paths=paths,
            cycles=0 if opening.interrupted else cycles, seconds=None if seconds is None else until - time.monotonic(),
            watch=seen.after_cycle_of_paths, resume=resumed.descent,
        )  # fmt: skip
        for turn in range(_CONTACTS + 1):
            design = lens_at(descent.state.x)
            moved = with_contacts(design)
            if moved is design or opening.interrupted or descent.stopped == "interrupted":
                break
            if turn == _CONTACTS:
                _warn_of_contacts(design, moved)
                break
            problem = Problem(
                dataclasses.replace(problem.model, lens=moved), rows.rows, conditions, as_built=term, **of_rows
            )
            again = best_of_paths(
                problem.state, descent.state.x, lower=lower, upper=upper, typical=typical, paths=1, cycles=cycles,
                seconds=None if seconds is None else until - time.monotonic(), watch=seen.after_cycle_of_paths,
            )  # fmt: skip
            descent = dataclasses.replace(
                again, history=(*descent.history, *again.history), cycles=descent.cycles + again.cycles,
                evaluations=descent.evaluations + again.evaluations,
            )  # fmt: skip
        merit_of_rows, count = float(np.sqrt(descent.state.cost)), len(descent.history)
        seen.write(descent.state.x, merit_of_rows, count, descent=seen.descent, now=True)
    fitted, descended, evaluations = None, 0, 0
    start = dict(zip(names, model.start, strict=True))
    if is_fitted and not opening.interrupted and descent.stopped != "interrupted":
        at_minimum = Design(problem, lower, upper, descent.state)
        bar = progress(None, "trial") if progress else None
        settings: dict[str, Any] = {"cycles": cycles, "until": until, "bar": bar}
        fit = (
            StockFit(at_minimum, stock, **settings)
            if stock is not None
            else PlateFit(at_minimum, plates or (), **settings)
        )
        best_fit = fit.run()
        if bar is not None:
            bar.close()
        problem, lower, upper, fitted = best_fit.problem, best_fit.lower, best_fit.upper, fit.report(best_fit)
        descended, evaluations, fixed = fit.descended, fit.evaluations, fit.fixed(best_fit)
        data = optimization_data_of(problem.model, problem.rows, problem.unit, held)
        data = dataclasses.replace(data, variables=tuple(v for v in data.variables if v.address not in fixed))
        stopped = "interrupted" if fit.interrupted else descent.stopped
        descent = dataclasses.replace(descent, state=best_fit.state, stopped=stopped)
    x, count = descent.state.x, len(problem.rows)
    after = problem.evaluated(x)
    return ended(
        x, descent.history, after, rows=problem.rows, start=start,
        merits=(problem.merit(before, model.start), problem.merit(after, x)),
        values=(before.values[:count], after.values[:count]),
        contributions=(before.contributions(np.arange(count)), after.contributions(np.arange(count))),
        cycles=descent.cycles + opening.cycles + (choice.descended if choice else 0) + descended,
        evaluations=descent.evaluations + (choice.evaluations if choice else 0) + evaluations,
        stopped="interrupted" if opening.interrupted else descent.stopped,
        glasses=tuple(choice.steps) if choice else (), chosen_from=choice and choice.pool.listing,
        as_built=None if term is None else AsBuiltChange.of(term, lens, lens_at(x)), fitted=fitted,
    )  # fmt: skip


def _refuse_without_loss(**options: object) -> None:
    """Raise NoProblem for options of a loss, without one, that differ from their default values."""
    defaults = {name: part.default for name, part in inspect.signature(optimize).parameters.items()}
    for name, setting in options.items():
        if not (setting is defaults[name] or (isinstance(setting, str | int) and setting == defaults[name])):
            raise NoProblem(f"{option(name)} goes with {option('loss')}, a function that is minimised: leave it out")


def _warn_of_contacts(design: Lens, moved: Lens) -> None:
    """Warn NoOptimum with the semi-diameters in contact that a lens had in its last descent, and should have had."""
    sizes = [
        (k, float(before.semi_diameter), float(after.semi_diameter))
        for k, (before, after) in enumerate(zip(design.surfaces, moved.surfaces, strict=True))
        if before.semi_diameter and after.semi_diameter
    ]
    changes = ", ".join(f"surface {k} by {after - before:+.3g} mm" for k, before, after in sizes if after != before)
    warnings.warn(
        f"the semi-diameters at which spacers have contact still change after {_CONTACTS} more descents, with the "
        f"last one: {changes}; the merit has the contacts before this change: optimise the lens again",
        NoOptimum, stacklevel=calling_level(),
    )  # fmt: skip


def _refuse_beside_fit(fit: str, **given: bool) -> None:
    """Raise NoProblem for options that do not go with a fit to parts or test plates."""
    for name, is_given in given.items():
        if is_given:
            words = option("vary", "glass") if name == "glass" else option(name)
            raise NoProblem(f"{words} does not go with {option(fit)}: leave one of them out")


def _with_spacers(
    lens: Lens,
    spaces: Sequence[tuple[int, ...]],
    materials: dict[str, float],
    vary: str | Sequence[str | Vary] | None,
    merit: Any,
    hold: Any,
    until: float,
    *,
    stored: bool,
    cycles: int | None,
    **settings: Any,
) -> Optimized:
    """The optimised lens with the best materials of its spacers; settings: of `optimize`."""
    started = time.monotonic()
    fixed = without_glasses(vary)

    def problem(lens: Lens) -> Problem:
        rows, held = specified(lens, merit, hold, stored=stored)
        model = design_variables(lens, fixed)
        return Problem(model, rows.rows, conditions_in_unit(lens, held, rows.unit), **rows.options)

    def optimised(lens: Lens, *, cycles: int | None) -> Optimized:
        words = vary if cycles is None else fixed
        left = None if np.isinf(until) else max(until - time.monotonic(), 1e-3)
        more = settings if cycles is None else {**settings, "progress": None, "watch": None}
        count = whole if cycles is None else min(cycles, whole or cycles)
        return optimize(
            lens, merit=merit, vary=words, hold=hold, stored=stored, cycles=count, seconds=left, **more
        )  # fmt: skip

    whole = cycles
    first = optimised(lens, cycles=None)
    best, steps, results = choose_spacers(first, spaces, materials, problem, optimised, until)
    return dataclasses.replace(
        best, before=first.before, merit_before=first.merit_before, variables_before=first.variables_before,
        values_before=first.values_before, contributions_before=first.contributions_before,
        cycles=sum(each.cycles for each in results), evaluations=sum(each.evaluations for each in results),
        seconds=time.monotonic() - started, glasses=tuple(step for each in results for step in each.glasses),
        spacers=tuple(steps),
    )  # fmt: skip


def _attained(
    problem: Problem, evaluated: Evaluated, x: np.ndarray, *, lower: np.ndarray, upper: np.ndarray
) -> tuple[Attained, ...]:
    """Targets and attained values of conditions and boundaries, with the reason where one is not met."""
    results = attained(problem, evaluated)
    if not all(result.met for result in results):
        results = with_reasons(results, problem, x, lower=lower, upper=upper)
    return tuple(results)


class _Observer:
    """Log, checkpoint, progress bar, `watch` of an optimisation; descent: the state that is resumed, then the last."""

    def __init__(
        self,
        log: str | PathLike | None,
        checkpoint: Checkpoint | None,
        bar: Any,
        descent: PathProgress | None,
        watch: Callable[[Cycle, np.ndarray], object] | None,
    ):
        cycles = () if descent is None else descent.history
        self.log = None if log is None else Log(log, cycles)
        self.checkpoint, self.bar, self.descent, self.watch = checkpoint, bar, descent, watch
        if bar is not None and cycles:
            bar.update(len(cycles))

    def after_cycle_of_paths(self, cycle: Cycle, descent: PathProgress) -> None:
        self.descent = descent
        self.after_cycle(cycle, descent.solver.x, descent=descent)

    def after_cycle(self, cycle: Cycle, x: np.ndarray, **state: Any) -> None:
        """state: of `Checkpoint.write`."""
        self.write(x, cycle.merit, cycle.number, **state)
        _LOG.info("cycle %d: merit %.6g, step %.1e", cycle.number, cycle.merit, cycle.step)
        if self.log is not None:
            self.log.add(cycle)
        if self.bar is not None:
            words = [f"merit {cycle.merit:.6g}", f"step {cycle.step:.1e}"]
            words += [f"held to {cycle.missed:.1e}"] if cycle.missed > 1e-9 else []
            self.bar.update(1)
            self.bar.set_postfix_str(", ".join([*words, *filter(None, [cycle.limits])]))
        if self.watch is not None:
            self.watch(cycle, x)

    def write(self, x: np.ndarray, merit: float, cycles: int, **state: Any) -> None:
        """Write the checkpoint; state: of `Checkpoint.write`."""
        if self.checkpoint is not None:
            self.checkpoint.write(x, merit, cycles, **state)

    def __enter__(self) -> "_Observer":
        return self

    def __exit__(self, *error: object) -> None:
        if self.bar is not None:
            self.bar.close()


def _refuse_undefined(problem: Problem, start: Evaluated) -> None:
    """Raise NoProblem where the merit, or a derivative of it, is not finite at the start, or all its rays fail."""
    bad = ~np.isfinite(start.residuals)
    if bad.any():
        k = int(start.of_row[np.argmax(bad)])
        row, number = problem.evaluation.rows[k], start.values[k]
        raise NoProblem(f"row {k + 1} of the merit function, {row.name}, is {number:g} at the start")
    if not np.isfinite(start.jacobian).all():
        place, variable = np.argwhere(~np.isfinite(start.jacobian))[0]
        k, name = int(start.of_row[place]), problem.model.variables[variable].name
        raise NoProblem(
            f"row {k + 1} of the merit function, {problem.evaluation.rows[k].name}, has no derivative by {name} at "
            f"the start: {start.jacobian[place, variable]:g}"
        )
    if start.lost[np.unique(start.of_row)].all():
        raise NoProblem("no row of the merit function has a value: no ray of them gets through the lens as it is")


def _lens_at(model: DesignVariables, x: np.ndarray, data: OptimizationData, bounded: dict[str, tuple]) -> Lens:
    """The lens with optimisation data; bounded: the bounds of this optimisation, by variable."""
    lens = model.lens_at(x)
    variables = tuple(
        dataclasses.replace(variable, bounds=bounded.get(variable.name, variable.bounds))
        for variable in data.variables
        if variable.address not in OF_LENS  # which no file holds
    )
    return dataclasses.replace(lens, optimization_data=dataclasses.replace(data, variables=variables))


def _optimized(
    lens: Lens,
    after: Lens,
    model: DesignVariables,
    x: np.ndarray,
    history: Sequence[Cycle],
    *,
    merits: tuple[float, float],
    rows: tuple[Row, ...] = (),
    start: Mapping[str, float] | None = None,
    values: tuple[Numbers, Numbers] = ((), ()),
    contributions: tuple[Numbers, Numbers] = ((), ()),
    **more: Any,
) -> Optimized:
    """The result; start: values of the variables before, by name, by default of the model; values, contributions: of
    the rows before and after; more: further fields."""

    def tensor(numbers: Numbers) -> torch.Tensor:
        return torch.tensor(np.asarray(numbers, dtype=float), dtype=torch.float64)

    cycles = [[cycle.merit, cycle.missed, cycle.step, cycle.damping, cycle.seconds] for cycle in history]
    return Optimized(
        lens=after,
        before=lens,
        merit=rows,
        names=tuple(variable.name for variable in model.variables),
        variables_before=tensor(model.start if start is None else [start[v.name] for v in model.variables]),
        variables_after=tensor(x),
        values_before=tensor(values[0]),
        values_after=tensor(values[1]),
        contributions_before=tensor(contributions[0]),
        contributions=tensor(contributions[1]),
        history=tensor(np.reshape(cycles, (-1, 5))),
        merit_before=merits[0],
        merit_after=merits[1],
        between=() if after.afocal else between(after),
        **more,
    )


def _warned(result: Optimized) -> Optimized:
    """The result, with a warning for every condition that is not met, for spots that are much larger between fields,
    wavelengths or rays than at them, and for surfaces and gaps that cannot be made."""
    for condition in result.conditions:
        if not condition.met:
            warnings.warn(str(condition), NotReached, stacklevel=calling_level())
    warn_of_worse(result.between)
    if result.fitted is not None:
        result.fitted.warn()
    for lens in result.lens.configurations:
        warn_of_defects(lens)
    return result
