"""Search: the distinct minima of a merit function between bounds, the best lens first.

In batches: starts are spread evenly over the bounds, the best of several points each, and descend a little on a narrow
beam and then on the whole one; the best of a batch are followed to their minima; further descents start from points
drawn around the best minima so far. The decisions of a batch depend on earlier batches alone, never on the clock.
"""

import logging
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.layout import draw_layout, on_one_scale
from raytrace.analysis.spot_diagram import spot
from raytrace.files import NotWritten, check_output_folder, write_table
from raytrace.io import LensFileError, LensFileWarning, write_lens
from raytrace.maths.numerics import detached, value
from raytrace.maths.result import Column, Result, Table
from raytrace.optimization.attained import conditions_attained
from raytrace.optimization.between import between, warn_of_worse
from raytrace.optimization.conditions import Condition, conditions_in_unit, specified
from raytrace.optimization.contradictions import refuse_contradictions
from raytrace.optimization.curriculum import Growth, Plan
from raytrace.optimization.least_squares import SolverOptions
from raytrace.optimization.lens_moves import LensMoves, Moves, counts
from raytrace.optimization.loss import Loss
from raytrace.optimization.loss_minima import ByLoss
from raytrace.optimization.merit import KINDS, DefaultMerit, Merit, in_unit
from raytrace.optimization.opening import opened
from raytrace.optimization.optimized_figure import drawn_fields
from raytrace.optimization.problem import (
    ExpectationSettings,
    NoLight,
    NoProblem,
    Problem,
    optimization_data_of,
)
from raytrace.optimization.quantities import Quantity, quantity_of
from raytrace.optimization.search_tasks import (
    FOLLOW,
    LONG,
    Journal,
    Minima,
    Minimum,
    SearchProblem,
    SearchStopped,
    Space,
    Stage,
    TaskResult,
    descended,
)
from raytrace.optimization.variables import bounds_of, design_variables
from raytrace.plotting import style
from raytrace.shards import Share
from raytrace.system.lens import Lens, field_points
from raytrace.system.optimization_data import Row
from raytrace.tracing.compiled import prepare
from raytrace.tracing.geometry import warn_of_defects
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.paraxial import first_order
from raytrace.words import calling_level, option

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Why a search ends.
STOPPED = {
    "starts": "all starts were tried",
    "moves": "all moves were taken",
    "steps": "all steps were taken",
    "seconds": "the limit on time was reached",
    "interrupted": "interrupted; these were found so far",
}
MOST = 40  # minima of a result
NEAREST = "nearest.zmx"  # of a search without minima
_MOST, _COLUMNS = 9, 3  # lenses of the figure


@value
class Searched(Result):
    """The minima (M,), the best first.

    lenses: one each; merit, focal_length in mm, spots (M, F): RMS radius of every field in mm, all wavelengths by their
    weights; between: the largest ratio of an RMS spot between fields, wavelengths or rays to those beside it
    (`optimization.between`); times_reached: number of followed descents to it, the column `found`; after: processor
    seconds until the first; tasks: key of that one. variables: (M, n). starts, descents: numbers of starts, and of
    descents that were followed to their end. as_built: (M, 3) the merit with the lens as built, by which the minima are
    ordered, nan where a perturbed lens fails; and RMS spot radius in mm, expected (the root of the mean square) and of
    the refocused lens without errors; tolerances: of which errors. loss: (M,), by which the minima are ordered, nan of
    those that were not followed to a minimum of the loss. elements, groups: (M,) numbers of elements and of groups of
    them, of a search by moves.
    """

    before: Lens
    lenses: tuple[Lens, ...]
    names: tuple[str, ...]
    tasks: tuple[str, ...]
    variables: Tensor
    merit: Tensor
    focal_length: Tensor
    spots: Tensor
    times_reached: Tensor
    after: Tensor
    between: Tensor
    starts: int
    descents: int
    seconds: float
    stopped: str
    as_built: Tensor | None = None
    tolerances: str = ""
    loss: Tensor | None = None
    elements: Tensor | None = None
    groups: Tensor | None = None

    @property
    def found(self) -> Tensor:
        """`times_reached`, by its former name."""
        return self.times_reached

    @property
    def lens(self) -> Lens:
        """The best one."""
        return self.lenses[0]

    @property
    def of_elements(self) -> dict[int, Lens]:
        """The best lens of every number of elements, of a search by moves."""
        numbers = [] if self.elements is None else self.elements.tolist()
        return {numbers[k]: self.lenses[k] for k in sorted(self._best, key=lambda k: numbers[k])}

    @property
    def _best(self) -> list[int]:
        """The numbers of the best lenses of every number of elements, the best first."""
        listed = [] if self.elements is None else self.elements.tolist()
        return [k for k, number in enumerate(listed) if number not in listed[:k]]

    def columns(self) -> dict[str, Tensor]:
        fields = {f"rms_{f}_um": 1e3 * self.spots[:, f - 1] for f in range(1, self.spots.shape[1] + 1)}
        variables = {name: self.variables[:, k] for k, name in enumerate(self.names)}
        number = torch.arange(1, len(self.lenses) + 1)
        of_lens = {"minimum": number}
        if self.elements is not None and self.groups is not None:
            of_lens |= {"elements": self.elements, "groups": self.groups}
        of_lens |= {**({} if self.loss is None else {"loss": self.loss}), "merit": self.merit}
        of_lens |= {"efl": self.focal_length, **fields, "between": self.between}
        if self.as_built is not None:
            merit, expected, nominal = self.as_built.unbind(-1)
            of_lens |= {"merit_as_built": merit, "expected_um": 1e3 * expected, "refocused_um": 1e3 * nominal}
        return {**of_lens, "found": self.times_reached, "seconds": self.after, **variables}

    def document(self) -> dict:
        counts = {"starts": self.starts, "descents": self.descents, "seconds": round(self.seconds, 3)}
        return {**counts, "stopped": self.stopped, **Result.document(self)}

    def tables(self) -> list[Table]:
        count = f"{len(self.lenses)} minima" if len(self.lenses) > 1 else "1 minimum"
        source = f"{self.starts} starts" if self.elements is None else f"{self.starts} moves"
        title = [
            self.before.name,
            f"  {count} from {source} in {self.seconds:.1f} s; {STOPPED[self.stopped]}",
            f"  found: by how many of the {self.descents} descents that were followed to their end",
            "  between: the largest ratio of an RMS spot between fields, wavelengths or rays to those beside it",
            *([f"  in the order of the merit as built: {self.tolerances}"] if self.as_built is not None else []),
            "",
        ]
        columns = self.columns()
        spots = {
            Column(name, "µm", ".2f", f"RMS\nfield {name.split('_')[1]}"): columns[name]
            for name in columns
            if name.startswith("rms_")
        }
        of_loss = {} if self.loss is None else {Column("loss"): self.loss}
        shown = {Column("minimum"): columns["minimum"]}
        if self.elements is not None and self.groups is not None:
            shown |= {Column("elements"): self.elements, Column("groups"): self.groups}
        shown |= {**of_loss, Column("merit"): self.merit}
        if self.as_built is not None:
            merit, expected, nominal = self.as_built.unbind(-1)
            shown |= {Column("merit_as_built", heading="merit\nas built"): merit}
            shown |= {Column("expected", "µm", ".2f", "RMS\nas built"): 1e3 * expected}
            shown |= {Column("refocused", "µm", ".2f", "RMS\nno errors"): 1e3 * nominal}
        shown |= {Column("EFL", "mm", ".4f"): self.focal_length, **spots}
        shown |= {Column("between", form=".2f"): self.between, Column("found"): self.times_reached}
        return [Table(shown, title)]

    @style.styled
    def draw(self, **options: Any) -> "Figure":
        """The best lenses on one scale, first of every number of elements, each with its merit, its spots and how many
        descents reached it."""
        count = min(_MOST, len(self.lenses))
        order = [*self._best, *(k for k in range(len(self.lenses)) if k not in self._best)]
        columns = min(_COLUMNS, count)
        rows = -(-count // columns)
        figure = style.new_figure(3.6 * max(columns, 2), 2.5 * rows + 0.5)
        figure.suptitle(
            style.fill(self.before.name or "Lens", figure.get_figwidth(), 11, bold=True), fontsize=11, fontweight="bold"
        )
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for k, axes in enumerate(panels):
            if k < count:
                _draw(axes, self, order[k])
            else:
                axes.set_axis_off()
        on_one_scale([*panels[:count]])
        return figure

    def save(self, folder: str | PathLike) -> None:
        """Write a lens file and a thumbnail of every minimum, the table, and a figure of the best side by side."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for number, lens in enumerate(self.lenses, 1):
            with warnings.catch_warnings():
                if number > 1:  # the same warnings for every minimum
                    warnings.simplefilter("ignore", LensFileWarning)
                write_lens(lens, folder / f"minimum_{number:02d}.zmx")
            thumbnail(lens, folder / f"minimum_{number:02d}.png")
        (folder / NEAREST).unlink(missing_ok=True)
        for path in folder.glob("minimum_*.*"):
            if path.stem.removeprefix("minimum_").isdigit() and int(path.stem.removeprefix("minimum_")) > number:
                path.unlink()
        columns = {name: column.tolist() for name, column in self.columns().items()}
        write_table(
            folder / "minima.csv", [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        )
        self.plot(folder / "best.png")


def searched(
    lens: Lens,
    each: Sequence[tuple[SearchProblem, Minimum]],
    *,
    losses: Sequence[float] = (),
    starts: int,
    descents: int,
    stopped: str,
    seconds: float,
    as_built: ExpectationSettings | None = None,
    of_moves: bool = False,
) -> Searched:
    """The result: minima, the best first, each with its problem, and their losses. Warns WorseBetween of the best."""
    terms: list[tuple[float, float, float]] = []
    if as_built is not None:
        terms = [_as_built(task.whole, minimum, as_built) for task, minimum in each[:MOST]]
        order = sorted(range(len(terms)), key=lambda k: (np.isnan(terms[k][0]), terms[k][0]))
        each, terms = [each[k] for k in order], [terms[k] for k in order]
    minima, lenses, tables = each[:MOST], [], []
    for k, (task, minimum) in enumerate(minima, 1):
        problem = task.whole
        variables = zip(problem.model.variables, minimum.result.x, strict=True)
        lenses.append(_design(problem, minimum.result.x, f"{lens.name}, minimum {k}".removeprefix(", ")))
        tables.append({f"{v.quantity}_{v.surface}": number for v, number in variables})
    names = tuple(dict.fromkeys(name for table in tables for name in table))
    gaps = [between(of_minimum) for of_minimum in lenses]
    warn_of_worse(gaps[0])
    tensor = lambda numbers: torch.tensor(np.asarray(numbers, dtype=float), dtype=torch.float64)  # noqa: E731
    return Searched(
        before=lens,
        lenses=tuple(lenses),
        names=names,
        tasks=tuple(minimum.task for _, minimum in minima),
        variables=tensor([[table.get(name, np.nan) for name in names] for table in tables]),
        merit=tensor([minimum.result.merit for _, minimum in minima]),
        loss=tensor(losses[:MOST]) if losses else None,
        focal_length=torch.stack(
            [first_order(lens_of_minimum).effective_focal_length.reshape(()) for lens_of_minimum in lenses]
        ),
        spots=_spots(lens, lenses),
        between=tensor([max((gap.ratio for gap in of_lens), default=np.nan) for of_lens in gaps]),
        times_reached=torch.tensor([minimum.descents for _, minimum in minima]),
        after=tensor([minimum.seconds for _, minimum in minima]),
        starts=starts,
        descents=descents,
        stopped=stopped,
        seconds=seconds,
        as_built=tensor(terms) if terms else None,
        tolerances=as_built.words() if as_built is not None and terms else "",
        elements=torch.tensor([counts(of_minimum)[0] for of_minimum in lenses]) if of_moves else None,
        groups=torch.tensor([counts(of_minimum)[1] for of_minimum in lenses]) if of_moves else None,
    )


def _without_minima(
    task: SearchProblem, journal: Journal, starts: int, folder: str | PathLike | None, ended: Sequence[str]
) -> NoProblem:
    """The error of a search without minima, with the nearest lens of all its descents, which is written; ended: where
    the steps of a curriculum ended."""
    parts = [f"no lens without failing rays that meets {option('hold')}, from {starts} starts", *ended]
    ends = [end for end in journal.known.values() if len(end.x) == len(task.model.start) and np.isfinite(end.merit)]
    if ends:
        nearest = min(ends, key=lambda end: end.rank)
        conditions = conditions_attained(task.whole, task.whole.evaluated(nearest.x))
        missed = [condition for condition in conditions if not condition.met]
        rays = [f"failing rays in {nearest.lost:g} rows"] if nearest.lost else []
        words = ", ".join([*rays, *(f"{condition.words} at {condition.reached:.6g}" for condition in missed)])
        place = ""
        if folder is not None:
            path = Path(folder) / NEAREST
            write_lens(_design(task.whole, nearest.x, task.model.lens.name), path)
            place = f", in {path}"
        parts.append(f"the nearest of {len(ends)} descents{place}: {words or 'it is not at its minimum yet'}")
    return NoProblem(
        "; ".join(parts)
        + f": allow more {option('starts')}, {option('seconds')} or wider {option('bounds')}, or hold less"
    )


def _design(problem: Problem, x: np.ndarray, name: str) -> Lens:
    """The lens at variables (n,), with its optimisation data."""
    design = problem.model.lens_at(x)
    conditions = [replace(c, row=in_unit(c.row, problem.unit, 1.0)) for c in problem.conditions]
    data = optimization_data_of(problem.model, problem.rows, problem.unit, conditions)
    return replace(design, name=name, optimization_data=data)


def _as_built(problem: Problem, minimum: Minimum, settings: ExpectationSettings) -> tuple[float, float, float]:
    """The merit with the lens as built, and the RMS spot radius in mm expected and without errors, nan where a
    perturbed lens fails; the tolerances are those of the lens of the minimum."""
    lens, x = problem.model.lens_at(minimum.result.x), minimum.result.x
    try:
        term = settings.of(lens)
    except NoLight:
        return np.nan, np.nan, np.nan
    problem = problem.with_as_built(term)
    with torch.no_grad():
        spots = [float(q(lens)) ** 0.5 for q in (term.expected, term.nominal)]
    return problem.merit(problem.evaluated(x), x), *spots


def _spots(before: Lens, lenses: Sequence[Lens]) -> Tensor:
    """RMS radii (M, F) in mm, of all wavelengths, at the fields of the lenses, of `before` where they have others."""
    counts = {len(lens.fields.y) for lens in (before, *lenses)}
    fields = None if len(counts) == 1 else field_points(None, like=before)
    return torch.stack([spot(lens, fields=fields).whole.rms_radius for lens in lenses])


def _draw(axes: "Axes", result: Searched, k: int) -> None:
    _draw_lens(axes, result.lenses[k])
    spots = ", ".join(f"{1e3 * float(radius):.1f}" for radius in result.spots[k])
    times = int(result.times_reached[k])
    axes.set_title(
        f"{k + 1}: merit {style.number_text(float(result.merit[k]))}\n"
        f"RMS spots {spots} µm; found by {times} of {result.descents} descents", fontsize=8,
    )  # fmt: skip


def _draw_lens(axes: "Axes", lens: Lens) -> None:
    lens = detached(lens)
    draw_layout(axes, lens, fields=drawn_fields(lens), rays=3)


@style.styled
def thumbnail(lens: Lens, path: str | PathLike) -> None:
    """Write a small figure of the cross section."""
    figure = style.new_figure(3.0, 1.8)
    _draw_lens(figure.add_subplot(), lens)
    style.save(figure, path, dpi=80)


# -- the search --------------------------------------------------------------------------------------------------------

STARTS = 64
_LOG = logging.getLogger(__name__)
_BATCH = 16  # starts; what is done in a batch is shared by processes
_FIRST = 4  # starts of the first batch of several: a limit of time passes after a minimum
_POINTS = 8  # of which a start is the best
_NARROW = 0.5, 0.6  # parts of pupil and field that a start descends on first
_SHORT = 10, 12  # cycles on the narrow and on the whole beam
_FOLLOWED = 4  # of a batch
_HOPS = 4  # of a batch
_SPRINGS = 3  # minima from which they start, the best ones
_REACH = 0.02, 0.3  # of a hop, of the ranges of the variables
_DAMPED = SolverOptions(damping=0.1, bends=False)

_DEFAULT = {operand for kind in KINDS.values() for operand in kind.operands.values()} - {"MTFA"}


def search(
    lens: Lens,
    *,
    kind: str | None = None,
    merit: str | Merit | DefaultMerit | Sequence[Row] | None = None,
    vary: str | Sequence[str] | None = None,
    bounds: str | Sequence[str] | None = None,
    hold: str | Sequence[str | Condition] | None = (),
    stored: bool = True,
    starts: int | None = None,
    moves: str | Sequence[str] | None = None,
    elements: int | str | Sequence[int] | None = None,
    keep: int | None = None,
    seconds: float | None = None,
    seed: int = 0,
    as_built: ExpectationSettings | None = None,
    loss: Callable[..., Tensor] | None = None,
    of: str | Quantity = "points",
    object_distances: Sequence[float] | None = None,
    folder: str | PathLike | None = None,
    progress: Callable | None = None,
    share: Share | None = None,
) -> Searched:
    """The distinct minima of a merit function globally, within bounds; the lens is one of the starts.

    merit, vary, bounds, hold, stored: as for `optimize`; default bounds follow from the focal length, that of `hold`,
    of a row EFFL or of the lens (`search_tasks.py`). starts: how many. kind: "phone", a curriculum from plates of
    plastic to a wide and fast lens of aspheres, in steps of aperture, field and terms (`curriculum.py`); `hold` its
    focal length; merit: None or a `DefaultMerit`. seconds: after which it ends; seed: of the draws.
    moves: words of moves from the lens at its minimum, or with `starts` from the best minima: "insert" a meniscus
    without thickness at each surface, to descend on either side of a saddle, "split" each element into two
    (`saddle_points.py`), "cement" facing surfaces of nearly equal curvature, "delete" each element, which is flattened
    and thinned until it is gone (`removal.py`); of some surfaces as "insert:1,4 delete:3", by the first surface of an
    element or an air space. After each change a paraxial projection restores power and defocus (`moves.py`). elements:
    a number, or the smallest and the largest as "2:5": moves from the best `keep` (2) lenses of each number lead to the
    next number, up to the largest, then down to the smallest; the result has the best `keep` of every number.
    Without it all moves are taken once.
    as_built: `rt.tolerancing.AsBuilt`, the expected mean square spot of the manufactured lens: the minima are those of
    the merit function alone, in the order of the merit with this term; of each lens with the tolerances of its own
    surfaces.
    loss, of, object_distances: as for `optimize`; of the eight best minima of the merit function those are followed to
    minima of the loss, in at most 120 cycles, whose loss is at most twice the least, between the same bounds and under
    the same conditions; these are the result, in the order of the loss; merit and spots are those there. With
    `elements` these are the eight best of each number of elements, and lenses are kept by their loss.
    folder: keeps the minima as lens files, a table and figures, and the journal: called again the search resumes, with
    the same result as without the interruption. Ctrl-C ends with the minima so far; without any the nearest lens of all
    descents is written there.
    Raises NoProblem, BadMerit, BadVariables, BadHold, BadRow, UnknownOperand, BadSearch, BadTolerance.
    """
    if as_built is not None:
        as_built.of(lens)  # raises BadTolerance before the search
    if folder is not None:
        check_output_folder(folder)
    if loss is None and (object_distances is not None or of != "points"):
        name = "of" if object_distances is None else "object_distances"
        raise NoProblem(f"{option(name)} goes with {option('loss')}, a function that is minimised: leave it out")
    measured = None if loss is None else Loss.of(loss, quantity_of(of), object_distances)
    if measured is not None and as_built is not None:
        raise NoProblem(f"{option('as_built')} orders minima by a merit of rows: leave it or {option('loss')} out")
    prepare()
    warn_of_filling(lens, field_points(None, like=lens))
    started = time.monotonic()
    until = started + (np.inf if seconds is None else seconds)
    if kind is not None and (moves is not None or elements is not None):
        raise NoProblem(f"{option('kind', kind)} goes without {option('moves')} and {option('elements')}")
    if moves is None and (elements is not None or keep is not None):
        name = "elements" if elements is not None else "keep"
        raise NoProblem(f"{option(name)} goes with {option('moves')}, as {option('moves', 'insert delete')}")
    plan = None
    if kind is not None:
        if merit is not None and not isinstance(merit, DefaultMerit):
            raise NoProblem(f"{option('kind', kind)} has a merit function of its own: leave {option('merit')} out")
        _, held = specified(lens, DefaultMerit(), hold, stored=stored)
        words = [str(condition) if condition.is_worded else condition for condition in held if condition.on]
        plan = Plan(kind, lens, vary, bounds, words, merit if isinstance(merit, DefaultMerit) else None)
        task = plan.problem(lens, plan.curriculum.steps[0])
        starts = plan.curriculum.starts if starts is None else starts
    else:
        (function, held), free = specified(lens, merit, hold, stored=stored), design_variables(lens, vary)
        ends, conditions = bounds_of(free.lens, free.variables, bounds), conditions_in_unit(lens, held, function.unit)
        glass, air = function.boundaries.glass, function.boundaries.air
        task = SearchProblem(free, function.rows, conditions, ends, glass, air, function.options)
    if any(variable.quantity == "glass" for variable in task.model.variables):
        raise NoProblem(
            f"{option('vary', 'glass')} is for optimize: search with the glasses as they are, then optimize what is "
            "found"
        )
    if task.conditions:
        low, high = task.space.lower, task.space.upper
        refuse_contradictions(task.whole, np.clip(task.model.start, low, high), lower=low, upper=high)
    run: LensMoves | Growth | _Run
    taken = None if moves is None else Moves.of(moves, elements, keep, task)
    about = task.about(seed) if plan is None else {**task.about(seed), "kind": kind}
    if taken is not None:
        about |= {**taken.about(), **({} if starts is None else {"starts": starts})}
    journal = Journal(folder, about, until)
    first = _Run(task, journal, seed, STARTS if starts is None else starts)
    by_loss = None if measured is None else ByLoss(measured, journal)
    if taken is not None:
        run = LensMoves(task, journal, taken, None if starts is None else first, by_loss)
    else:
        run = first if plan is None else Growth(plan, first, journal)
    stopped = run.DONE
    try:
        run.through(progress)
    except SearchStopped:
        stopped = "seconds" if time.monotonic() > until else "interrupted"
    except KeyboardInterrupt:
        stopped = "interrupted"
    if not (each := run.each()):
        ended = run.ended if isinstance(run, Growth) else ()
        raise _without_minima(task, run.journal, run.started, folder if not (share and share.rank) else None, ended)
    losses: list[float] = []
    if by_loss is not None:
        each, losses = run.minima_of_loss(progress) if isinstance(run, LensMoves) else by_loss.listed(each, progress)
        if stopped == run.DONE and np.isnan(losses).any():
            stopped = "seconds" if time.monotonic() > until else "interrupted"
    result = searched(
        lens, each, losses=losses, of_moves=taken is not None, starts=run.started, descents=run.followed,
        stopped=stopped, seconds=time.monotonic() - started, as_built=as_built,
    )  # fmt: skip
    warn_of_defects(result.lens)
    if folder is not None and not (share and share.rank):
        try:
            result.save(folder)
        except (OSError, LensFileError) as error:
            warnings.warn(f"{folder}: not all minima are written: {error}", NotWritten, stacklevel=calling_level())
    return result


@dataclass
class _Run:
    """A search from starts."""

    task: SearchProblem
    journal: Journal
    seed: int
    starts: int
    started: int = 0  # starts
    followed: int = 0  # descents
    work: float = 0.0  # s

    DONE: ClassVar[str] = "starts"

    def __post_init__(self) -> None:
        pupil, field = _NARROW  # the rays of default merit functions nearer to the axis
        scale = np.array([field, field, pupil, pupil])
        rows = [
            replace(row, numbers=tuple((scale * row.numbers).tolist())) if row.operand in _DEFAULT else row
            for row in self.task.rows
        ]
        self.narrow, self.whole, self.space = self.task.problem(tuple(rows)), self.task.whole, self.task.space
        self.bounds = self.space.lower, self.space.upper
        self.minima = Minima(np.maximum(self.space.upper - self.space.lower, 1e-300), _reversal(self.space))

    def each(self) -> list[tuple[SearchProblem, Minimum]]:
        """All minima, the best first, each with its problem."""
        return [(self.task, minimum) for minimum in self.minima.each]

    def through(self, progress: Callable | None) -> None:
        """Run all batches. Raises SearchStopped."""
        bar = None if progress is None else progress(self.starts, "start")
        try:
            first = [_FIRST] if self.starts > _BATCH else []
            for numbers in pairwise([0, *first, *range(_BATCH, self.starts, _BATCH), self.starts]):
                self._batch(range(*numbers), bar)
        finally:
            if bar is not None:
                bar.close()

    def _batch(self, numbers: range, bar: Any) -> None:
        def start(number: int) -> TaskResult:
            result = self._start(number)
            if bar is not None:
                bar.update(1)
            return result

        keys = [f"start {i}" for i in numbers]
        ends = self._results([(key, partial(start, i)) for key, i in zip(keys, numbers, strict=True)])
        self.started = numbers.stop
        best = sorted(zip(keys, ends, strict=True), key=lambda pair: pair[1].rank)[:_FOLLOWED]
        self._follow([(f"{key}, followed", end.x) for key, end in best], bar)
        springs = self.minima.each[:_SPRINGS]
        hops = [(f"hop {numbers[0] + k}", springs[k % len(springs)].result.x) for k in range(_HOPS)] if springs else []
        self._follow([(key, self._hopped(key, x)) for key, x in hops], bar)

    def _results(self, tasks: Sequence[tuple[str, Callable[[], TaskResult]]]) -> list[TaskResult]:
        ends = self.journal.each(tasks, len(self.space.lower))
        self.work += sum(end.seconds for end in ends)
        return ends

    def _follow(self, tasks: Sequence[tuple[str, np.ndarray]], bar: Any) -> None:
        stages = [Stage(self.whole, LONG, FOLLOW, *self.bounds)]
        ends = self._results([(key, partial(descended, x, stages, self.journal.until)) for key, x in tasks])
        self.followed += len(tasks)
        for (key, _), end in zip(tasks, ends, strict=True):
            if not self.minima.add(end, key, self.work):
                continue
            words = f"{len(self.minima.each)} minima, the best {self.minima.each[0].result.merit:.6g}"
            _LOG.info("%s: %s", key, words)
            if bar is not None:
                bar.set_postfix_str(words)

    def _start(self, number: int) -> TaskResult:
        """The lens as it is, or the best of some points between the bounds; both descended a little."""
        start = self.task.model.start
        points = self.space.sobol(number, _POINTS, self.seed) if number else np.clip(start, *self.bounds)[None]

        def rank(x: np.ndarray) -> tuple[float, float]:
            """Failed rays and sum of squares on the narrow beam."""
            with np.errstate(all="ignore"):
                evaluated = self.narrow.evaluated(x)
            return float(evaluated.lost.sum()), float(np.nansum(evaluated.residuals**2))

        (lost, _), best = min(((rank(x), x) for x in map(self.space.prepared, points)), key=lambda pair: pair[0])
        if lost:
            lower, upper = self.space.lower, self.space.upper
            best, _, interrupted = opened(self.whole, best, lower=lower, upper=upper, until=self.journal.until)
            if interrupted or time.monotonic() > self.journal.until:
                raise SearchStopped
        stages = [
            Stage(self.narrow, _SHORT[0], _DAMPED, *self.bounds),
            Stage(self.whole, _SHORT[1], SolverOptions(), *self.bounds),
        ]
        return descended(best, stages, self.journal.until)

    def _hopped(self, key: str, x: np.ndarray) -> np.ndarray:
        """A point beyond a minimum, drawn by the name of the hop."""
        draw = np.random.default_rng([self.seed, *key.encode()])
        size = _REACH[0] * (_REACH[1] / _REACH[0]) ** draw.random()
        return self.space.prepared(x + size * (self.space.high - self.space.low) * draw.normal(size=len(x)))


def _reversal(space: Space) -> tuple[np.ndarray, np.ndarray] | None:
    """The variable that each becomes in the reversed lens, and its sign; None if the reversed lens has other ones."""
    lens = space.model.lens
    if not np.isfinite(float(lens.surfaces[0].thickness)):
        return None
    variables, last = space.model.variables, len(lens.surfaces) - 2
    columns = {variable.address: k for k, variable in enumerate(variables)}
    partner = {"curvature": lambda k: last + 1 - k, "thickness": lambda k: last - k}
    other = [
        (partner.get(variable.quantity, lambda k: -1)(variable.surface), variable.quantity) for variable in variables
    ]
    if any(address not in columns for address in other):
        return None
    return np.array([columns[address] for address in other]), np.where([o == "curvature" for _, o in other], -1.0, 1.0)
