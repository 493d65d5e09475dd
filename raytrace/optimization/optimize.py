"""Optimising: the lens at a minimum of its merit function, from the lens as it is, and the report of it.

Opening: where most rays of the initial design fail, it descends first on the rays of a small part of pupil and field,
through which light passes every lens. The part grows until no ray of the whole beam fails.
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
from torch import Tensor

from raytrace.files import check_output
from raytrace.io import write_lens
from raytrace.maths.numerics import value
from raytrace.maths.result import Result, cell, number, plain
from raytrace.optimization.attained import NotReached, Reached, reached, refuse_contradictions
from raytrace.optimization.checkpoint import STOPPED, BadCheckpoint, Checkpoint, Log, Stored, read_checkpoint
from raytrace.optimization.default_merit import DefaultMerit
from raytrace.optimization.glass_choice import Choice, GlassStep, catalogs_of, pool_of
from raytrace.optimization.lens_model import Model
from raytrace.optimization.merit import Merit, configurations_of, merit_for
from raytrace.optimization.merit_rows import Evaluated
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import (
    Condition,
    FunctionMerit,
    NoProblem,
    Problem,
    conditions_in_unit,
    optimization_data_of,
    typical_of,
)
from raytrace.optimization.report import optimize_report
from raytrace.optimization.solver import (
    BestDescent,
    Cycle,
    PathState,
    SolverOptions,
    best_of_paths,
    least_squares,
    minimise,
)
from raytrace.optimization.variables import bounds_of, freedom, name_of, without_glass
from raytrace.system.identity import digest, identity
from raytrace.system.lens import Lens, field_points
from raytrace.system.optimization_data import Row, Vary
from raytrace.tracing.compiled import prepare
from raytrace.tracing.geometry import warn_of_defects
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.paraxial import first_order
from raytrace.words import calling_level

_SHOWN = 12  # rows of the merit function in the text, those of largest contribution


@value
class Optimized(Result):
    """The lens at the lowest merit reached, and the initial one.

    merit: the rows; names (n,) of the variables, before and after in variables: (n,) in mm; values: (R,) of the rows
    before and after; contributions: (R,) of each to the square of the merit, of sum 1; history: (cycles, 5) merit,
    largest violation of a condition, step, damping and seconds of every cycle; stopped: a key of `checkpoint.STOPPED`;
    glasses: the steps in which variable glasses were chosen; conditions: targets and attained values.
    """

    lens: Lens
    before: Lens
    merit: tuple[Row, ...]
    names: tuple[str, ...]
    variables_before: Tensor
    variables_after: Tensor
    values_before: Tensor
    values_after: Tensor
    contributions_before: Tensor
    contributions: Tensor
    history: Tensor
    merit_before: float
    merit_after: float
    cycles: int
    evaluations: int
    seconds: float
    stopped: str
    glasses: tuple[GlassStep, ...] = ()
    conditions: tuple[Reached, ...] = ()

    def draw(self):
        """One page: lens, spots and merit function before and after."""
        return optimize_report(self)

    @property
    def rows(self) -> tuple[int, ...]:
        """Rows that have a value, counted from 1."""
        return tuple(i for i, row in enumerate(self.merit, 1) if row.operand in OPERANDS)

    @property
    def falls_short(self) -> bool:
        return not all(one.met for one in self.conditions)

    @property
    def configurations(self) -> tuple[int, ...]:
        """Of every row, from 1."""
        return tuple(configurations_of(self.merit, self.before.current_configuration))

    @property
    def has_configurations(self) -> bool:
        return bool(self.lens.operands)

    def columns(self) -> dict[str, Tensor]:
        indices = [i - 1 for i in self.rows]
        rows, kinds = [self.merit[k] for k in indices], self.words()["operand"]
        return {
            "row": torch.tensor(self.rows),
            "configuration": torch.tensor([self.configurations[k] for k in indices]),
            "operand": torch.tensor([kinds.index(row.name) for row in rows]),
            "target": torch.tensor([row.target for row in rows], dtype=torch.float64),
            "weight": torch.tensor([row.weight for row in rows], dtype=torch.float64),
            "before": self.values_before[indices],
            "after": self.values_after[indices],
            "contribution_percent": 100 * self.contributions[indices],
        }

    def words(self) -> dict:
        return {"operand": [*dict.fromkeys(self.merit[i - 1].name for i in self.rows)]}

    def document(self) -> dict:
        variables = zip(self.names, self.variables_before.tolist(), self.variables_after.tolist(), strict=True)
        before, after = self.values_before.tolist(), self.values_after.tolist()
        return plain(
            {
                "merit_before": self.merit_before,
                "merit_after": self.merit_after,
                "cycles": self.cycles,
                "evaluations": self.evaluations,
                "seconds": round(self.seconds, 3),
                "stopped": self.stopped,
                "variables": [{"name": name, "before": start, "after": end} for name, start, end in variables],
                "operands": [
                    {
                        "row": i,
                        **({"configuration": self.configurations[i - 1]} if self.has_configurations else {}),
                        "operand": self.merit[i - 1].name,
                        "target": self.merit[i - 1].target,
                        "weight": self.merit[i - 1].weight,
                        "before": number(before[i - 1]),
                        "after": number(after[i - 1]),
                    }
                    for i in self.rows
                ],
                **({"glasses": [step.document() for step in self.glasses]} if self.glasses else {}),
                "conditions": [one.document() for one in self.conditions],
            }
        )

    def __str__(self) -> str:
        ratio = self.merit_before / self.merit_after if self.merit_after > 0 else np.inf
        lines = [
            self.lens.name,
            f"  merit {self.merit_before:.8g} → {self.merit_after:.8g}"
            + (f", {ratio:.4g} times less" if 1.1 < ratio < np.inf else ""),
            f"  {self.cycles} cycles, {self.evaluations} evaluations, {self.seconds:.1f} s; {STOPPED[self.stopped]}\n",
            f"  {'variable':<18} {'before':>16} {'after':>16}",
        ]
        for name, *ends in zip(self.names, self.variables_before.tolist(), self.variables_after.tolist(), strict=True):
            lines.append(f"  {name:<18} {ends[0]:>16.8g} {ends[1]:>16.8g}")
        if self.glasses:
            lines.append(f"\n  {'glass':<52} {'predicted':>14} {'merit':>14} {'s':>8}")
            lines += [f"  {step}" for step in self.glasses]
        if self.has_configurations:
            lines.append(f"\n  {'configuration':<18} {'EFL before, mm':>16} {'EFL after, mm':>16} {'left':>7}")
            pairs = zip(self.before.configurations, self.lens.configurations, strict=True)
            for k, pair in enumerate(pairs, 1):
                lengths = " ".join(cell(float(first_order(one).effective_focal_length), "16.8g") for one in pair)
                of = zip(self.configurations, self.contributions.tolist(), strict=False)
                lines.append(f"  {k:<18} {lengths} {sum(part for at, part in of if at == k):>7.1%}")
        left = sorted(self.rows, key=lambda i: -float(self.contributions[i - 1]))
        left = [i for i in left if self.merit[i - 1].weight != 0]
        head = f"{'conf.':>5} " if self.has_configurations else ""
        ends = f"{'before':>14} {'after':>14} {'left':>7}"
        lines.append(f"\n  {head}{'row':>5} {'operand':<8} {'target':>12} {'weight':>10} {ends}")
        for i in left[:_SHOWN]:
            row, share = self.merit[i - 1], float(self.contributions[i - 1])
            both = (float(values[i - 1]) for values in (self.values_before, self.values_after))
            ends = " ".join(f"{'lost':>14}" if np.isnan(one) else f"{one:>14.6g}" for one in both)
            of = f"{self.configurations[i - 1]:>5} " if self.has_configurations else ""
            lines.append(f"  {of}{i:>5} {row.name:<8} {row.target:>12.6g} {row.weight:>10.4g} {ends} {share:>7.1%}")
        if len(left) > _SHOWN:
            rest = sum(float(self.contributions[i - 1]) for i in left[_SHOWN:])
            lines.append(f"  and {len(left) - _SHOWN} more rows, {rest:.1%}")
        table = self.conditions_in_words()
        return "\n".join([*lines, *(["", *(f"  {line}" for line in table)] if table else [])])

    def conditions_in_words(self) -> list[str]:
        """The table of targets and attained values; of boundaries that are met only the first few."""
        shown = self.shown_conditions()
        if not shown:
            return []
        width = max(24, *(len(one.name) for one in shown))
        lines = [f"{'condition':<{width}} {'asked':>15} {'reached':>14}"]
        for one in shown:
            target, attained = f"{one.relation} {one.asked:.6g}", cell(one.reached, "14.6g")
            remark = ", ".join(filter(None, ["" if one.met else "not met", one.place]))
            lines.append(f"{one.name:<{width}} {target:>15} {attained:>14}  {remark}".rstrip())
        if len(shown) < len(self.conditions):
            lines.append(f"and {len(self.conditions) - len(shown)} more boundaries, met")
        return lines

    def shown_conditions(self) -> list[Reached]:
        """Those of tables: all but boundaries that are met, of which there are the first few."""
        chosen = [k for k, one in enumerate(self.conditions) if not one.met or not one.row]
        met = [k for k, one in enumerate(self.conditions) if one.met and one.row]
        return [self.conditions[k] for k in sorted(chosen + met[: max(_SHOWN - len(chosen), 0)])]

    def save(self, path: str | PathLike) -> None:
        """Write the lens, with its variables and its merit function."""
        write_lens(self.lens, path)


# -- opening -----------------------------------------------------------------------------------------------------------

#: Parts of the pupil and of the field, in the order in which they are opened.
PARTS = (0.02, 0.05, *np.geomspace(0.1, 1.0, 14).tolist())

_FEW = 0.05  # of the rows: with fewer failed rays the descent itself recovers
_CYCLES = 12  # at one opening
_STEEPEST = 9.0  # curvature in units of the typical one: 0.9 over the radius of the beam
_DAMPED = SolverOptions(damping=0.1, bends=False)


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
    """Variables (n,) at which fewer rays fail than at x; x itself where nearly none do, or no such variables are found.

    lower, upper, typical: as for `least_squares`. until: of `time.monotonic`, when it ends; watch: invoked after each
    cycle.
    """
    best = problem.state(x, False)
    if best.lost <= _FEW * (problem.evaluation.weights != 0).sum():
        return x
    # the axial beam meets every sphere within these bounds: a narrow part of it would let any curvature grow
    curved = np.array([one.quantity == "curvature" for one in problem.model.variables])
    steepest = np.where(curved, _STEEPEST * typical_of(problem.model), np.inf)
    bounds = {
        "lower": np.maximum(lower, np.minimum(x, -steepest)),
        "upper": np.minimum(upper, np.maximum(x, steepest)),
        "typical": typical,
    }
    stages = [*(problem.through(part) for part in PARTS[:-1]), problem]
    for stage, wider in pairwise(stages):
        if time.monotonic() > until:
            break
        try:
            with np.errstate(all="ignore"):
                trial = least_squares(
                    stage.state, x, options=_DAMPED, cycles=_CYCLES, until=until,
                    watch=watch and (lambda cycle, state: watch(cycle)), **bounds,
                ).state  # fmt: skip
        except np.linalg.LinAlgError:  # numbers overflow
            continue
        if not trial.is_finite or wider.state(trial.x, False).lost > wider.state(x, False).lost:
            continue
        x, whole = trial.x, problem.state(trial.x, False)
        best = whole if whole.is_finite and whole.is_better(best) else best
        if best.lost == 0:
            break
    return best.x


# -- optimising --------------------------------------------------------------------------------------------------------

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
    """The lens at a minimum of its merit function, by damped least squares with the exact derivatives of every row.

    merit: `Merit`, the settings `DefaultMerit` of a default merit function or its kind ("spot", "wavefront", "angular",
    "mtf"), rows, by default the file's; or any function of a lens that returns one number () to minimise, by L-BFGS.
    vary: variables, or their syntax, as "curvature thickness:5,6", by default the file's; bounds: of variables, as
    "thickness:2,15"; hold: constraints met exactly, as "efl=50 total_track<=80" (`optimization.problem`). cycles,
    seconds: limits, by default 500 cycles a path; paths: damping strategies to try. catalog: shipped catalogs or
    AGF files for variable glasses, by default those of the lens, else SCHOTT (`optimization.glass_choice`). log: a file
    with a line for every cycle; checkpoint: a file (.json) of the state of the descent; resume: such a file of the same
    lens, variables and merit function, from which the descent resumes bit-identically, cycles counted from its start
    (`checkpoint.py`). Ctrl-C ends with the best lens.
    Conditions that certainly exclude one another are refused. Conditions and boundaries that are not met at the end
    are in `Optimized.conditions` with the reason, with a warning (NotReached), as for surfaces and gaps that cannot
    be made (Unbuildable).
    Raises NoProblem, BadMerit, BadVariables, BadHold, BadRow, UnknownOperand, BadCheckpoint.
    """
    prepare()
    started = time.monotonic()
    until = np.inf if seconds is None else started + seconds
    for path, suffixes in ((log, LOGS), (checkpoint, CHECKPOINTS)):
        if path is not None:
            check_output(path, suffixes)
    for option, path in (("checkpoint", checkpoint), ("resume", resume)):
        if None not in (log, path) and os.path.realpath(log) == os.path.realpath(path):
            raise ValueError(f"{log}: `log` and `{option}` are one file; give them two")
    warn_of_filling(lens, field_points(None, like=lens))
    free, glasses = without_glass(freedom(lens, vary), vary)
    names = tuple(name_of(one) for one in free.variables)
    model = Model(free.lens, free.variables, free.solves)
    lower, upper = bounds_of(free.lens, free.variables, bounds)
    for name, least, most in zip(names, lower, upper, strict=True):
        if not least <= most:
            raise NoProblem(f"`bounds` of {name}: from {least:g} to {most:g} there is nothing")
    settings = {"lower": lower, "upper": upper, "typical": typical_of(model), "cycles": cycles}
    of = {**identity(lens), "variables": list(names), "solves": digest(repr(free.solves)), "paths": paths}
    of |= {"glasses that vary": list(glasses), "bounds": plain([lower.tolist(), upper.tolist()])}

    def stored() -> Stored:
        return Stored(model.start, {}) if resume is None else read_checkpoint(resume, of, names)

    if callable(merit):
        if glasses:
            raise NoProblem("`vary=glass` goes with a merit of rows: make the function a row")
        if hold:
            raise NoProblem("`hold` goes with a merit of rows: of a function give `bounds`, or make it a row")
        of["merit"] = getattr(merit, "__qualname__", type(merit).__name__)
        function = FunctionMerit(model, merit, stored().evaluated)
        start = np.clip(model.start, lower, upper)
        if not names:
            raise NoProblem("nothing varies: name variables by `vary`, as 'curvature thickness'")
        with _Observer(
            log, Checkpoint(checkpoint, of, names), progress and progress(cycles, "cycle"), None
        ) as observer:
            before = function(model.start)[0]
            if not np.isfinite(before):
                raise NoProblem(f"the merit is {before:g} at the start: nothing to follow")
            left = None if np.isinf(until) else until - time.monotonic()
            watch = lambda cycle, x: observer.after_cycle(cycle, x, evaluated=function.evaluated)  # noqa: E731
            x, stopped, history = minimise(function, start, watch=watch, seconds=left, **settings)
            after = function(x)[0]
            observer.checkpoint.write(x, after, len(history), evaluated=function.evaluated, now=True)
        descent = BestDescent(x, tuple(history), stopped, len(history), function.evaluations)
        return _warned(_optimized(lens, model, names, x, descent, started, merits=(before, after)))
    function = merit_for(lens, merit)
    conditions = conditions_in_unit(lens, hold, function.unit)
    of_rows = {"unit": function.unit, "skip_unknown": function.skip_unknown, "conventions": function.conventions}
    problem = Problem(model, function.rows, conditions, **of_rows)
    of |= {"merit": digest([repr(row) for row in function.rows], of_rows), "hold": digest(repr(conditions))}
    resumed = stored()
    if set(resumed.glasses) - set(glasses):
        raise BadCheckpoint(f"{resume}: glasses: found surfaces {[*resumed.glasses]}, expected some of {[*glasses]}")
    start, choice, opening = np.clip(resumed.x, lower, upper), None, []
    refuse_contradictions(problem, start, lower=lower, upper=upper)
    evaluating = time.monotonic()
    before = problem.evaluated(model.start)
    seconds_of_end = time.monotonic() - evaluating
    if not resumed.glasses and resumed.descent is None:
        start = opened(
            problem, start, lower=lower, upper=upper, typical=settings["typical"], until=until, watch=opening.append
        )
        evaluating = time.monotonic()
        _refuse_undefined(problem, problem.evaluated(start, True))
        seconds_of_end = min(seconds_of_end, time.monotonic() - evaluating)  # the first evaluation takes longer
    until -= seconds_of_end  # the result is evaluated once more
    bar = progress and progress(cycles, "cycle")
    with _Observer(log, Checkpoint(checkpoint, of, names), bar, resumed.descent) as observer:
        if glasses:
            pool, limits = pool_of(lens, catalogs_of(lens, catalog)), (lower, upper)
            of_choice = {"cycles": cycles, "until": until, "keep": observer.checkpoint.write_glasses, **of_rows}
            choice = Choice(free, glasses, pool, function.rows, conditions, limits, **of_choice)
            start, problem = choice.run(start, resumed).x, choice.problem(choice.best.glasses, ())
        settings["seconds"] = None if seconds is None else until - time.monotonic()
        descent = best_of_paths(
            problem.state, start, paths=paths, watch=observer.after_cycle_of_paths, resume=resumed.descent, **settings
        )
        observer.checkpoint.write(
            descent.state.x,
            float(np.sqrt(descent.state.cost)),
            len(descent.history),
            descent=observer.descent,
            now=True,
        )
    x, count = descent.state.x, len(problem.rows)
    descent = dataclasses.replace(
        descent,
        cycles=descent.cycles + len(opening) + (choice.descended if choice else 0),
        evaluations=descent.evaluations + (choice.evaluations if choice else 0),
    )
    after = problem.evaluated(x)
    result = _optimized(
        lens, problem.model, names, x, descent, started, rows=problem.rows, unit=problem.unit,
        merits=(problem.merit(before), problem.merit(after)), values=(before.values[:count], after.values[:count]),
        contributions=(_contributions(before, count), _contributions(after, count)),
        glasses=tuple(choice.steps) if choice else (), conditions=reached(problem, x, lower=lower, upper=upper),
    )  # fmt: skip
    ends = {name: (float(least), float(most)) for name, least, most in zip(names, lower, upper, strict=True)}
    bounded = {name: pair for name, pair in ends.items() if not np.isinf(pair).all()}
    data = result.lens.optimization_data  # its variables have the bounds of this optimisation
    variables = tuple(dataclasses.replace(one, bounds=bounded.get(name_of(one), one.bounds)) for one in data.variables)
    data = dataclasses.replace(data, variables=variables)
    return _warned(dataclasses.replace(result, lens=dataclasses.replace(result.lens, optimization_data=data)))


class _Observer:
    """Log, checkpoint and progress bar of an optimisation; descent: the state that is resumed, then the last one."""

    def __init__(self, log, checkpoint: Checkpoint, bar, descent: PathState | None):
        cycles = () if descent is None else descent.history
        self.log, self.checkpoint, self.bar, self.descent = Log(log, cycles), checkpoint, bar, descent
        if bar is not None and cycles:
            bar.update(len(cycles))

    def after_cycle_of_paths(self, cycle: Cycle, descent: PathState) -> None:
        self.descent = descent
        self.after_cycle(cycle, descent.solver.x, descent=descent)

    def after_cycle(self, cycle: Cycle, x: np.ndarray, **state) -> None:
        """state: of `Checkpoint.write`."""
        self.checkpoint.write(x, cycle.merit, cycle.number, **state)
        self.log.add(cycle)
        if self.bar is not None:
            words = [f"merit {cycle.merit:.6g}", f"step {cycle.step:.1e}"]
            words += [f"held to {cycle.missed:.1e}"] if cycle.missed > 1e-9 else []
            self.bar.update(1)
            self.bar.set_postfix_str(", ".join([*words, *filter(None, [cycle.limits])]))

    def __enter__(self) -> "_Observer":
        return self

    def __exit__(self, *error) -> None:
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
        k, variable = np.argwhere(~np.isfinite(start.jacobian))[0]
        row, name = int(start.of_row[k]), name_of(problem.model.variables[variable])
        raise NoProblem(
            f"row {row + 1} of the merit function, {problem.evaluation.rows[row].name}, has no derivative by {name} at "
            f"the start: {start.jacobian[k, variable]:g}"
        )
    if start.lost[np.unique(start.of_row)].all():
        raise NoProblem("no row of the merit function has a value: no ray of them gets through the lens as it is")


def _optimized(
    lens: Lens,
    model: Model,
    names: tuple[str, ...],
    x: np.ndarray,
    descent: BestDescent,
    started: float,
    *,
    merits: tuple[float, float],
    rows: tuple[Row, ...] = (),
    unit: float = 1.0,
    values: tuple = ((), ()),
    contributions: tuple = ((), ()),
    **more,
) -> Optimized:
    def tensor(numbers) -> torch.Tensor:
        return torch.tensor(np.asarray(numbers, dtype=float), dtype=torch.float64)

    after = model.lens_at(x)
    if after.optimization_data is None:  # its file has none
        after = dataclasses.replace(after, optimization_data=optimization_data_of(model, rows, unit))
    history = [[c.merit, c.missed, c.step, c.damping, c.seconds] for c in descent.history]
    return Optimized(
        lens=after,
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
        merit_before=merits[0],
        merit_after=merits[1],
        cycles=descent.cycles,
        evaluations=descent.evaluations,
        seconds=time.monotonic() - started,
        stopped=descent.stopped,
        **more,
    )


def _warned(result: Optimized) -> Optimized:
    """The result, with a warning for every condition that is not met, and for what of the lens cannot be made."""
    for one in result.conditions:
        if not one.met:
            warnings.warn(str(one), NotReached, stacklevel=calling_level())
    for lens in result.lens.configurations:
        warn_of_defects(lens)
    return result


def _contributions(evaluated: Evaluated, rows: int) -> np.ndarray:
    """The part (R,) of every row in the square of the merit."""
    squares = np.bincount(evaluated.of_row, evaluated.residuals**2, minlength=rows)[:rows]
    return squares / max(squares.sum(), 1e-300)
