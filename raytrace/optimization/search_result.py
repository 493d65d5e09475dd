"""Searched: the distinct minima that a search found, the best first.

Minima: the distinct ones that a search found, each once.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.layout import draw_layout, on_one_scale
from raytrace.analysis.spot_diagram import spot
from raytrace.files import write_table
from raytrace.io import LensFileWarning, write_lens
from raytrace.maths.result import Result, cell
from raytrace.maths.value import detached, value
from raytrace.optimization.journal import Ended
from raytrace.optimization.problem import NoProblem, Problem, optimization_data_of
from raytrace.optimization.report import drawn_fields
from raytrace.plotting import style
from raytrace.system.lens import Lens
from raytrace.tracing.paraxial import first_order

_ALIKE = 0.03  # of the range of a variable: how far two minima may lie apart that are one
_EQUAL = 2e-2  # of the merit


@dataclass
class Minimum:
    """Where it lies, how often it was found, how it was found first, and after how many processor seconds."""

    ended: Ended
    task: str
    seconds: float
    found: int = 1


@dataclass
class Minima:
    """All that were found, the best first. ranges: (n,) of the variables; turned: which variable stands where each one
    stands in the lens that is turned round, where that is a lens of the same variables, and its sign."""

    ranges: np.ndarray
    turned: tuple[np.ndarray, np.ndarray] | None = None
    each: list[Minimum] = field(default_factory=list)

    def add(self, ended: Ended, task: str, seconds: float) -> bool:
        """Whether it is new, or better than the one that it is."""
        if not ended.is_whole:
            return False
        same = next((one for one in self.each if self._is_same(one.ended, ended)), None)
        better = same is None or ended.merit < same.ended.merit * (1 - 1e-6)
        if same is None:
            self.each.append(Minimum(ended, task, seconds))
        else:
            same.found += 1
            if better:
                same.ended, same.task, same.seconds = ended, task, seconds
        self.each.sort(key=lambda one: one.ended.merit)
        return better

    def _is_same(self, one: Ended, other: Ended) -> bool:
        if abs(one.merit - other.merit) > _EQUAL * max(one.merit, other.merit):
            return False
        ways = [other.x]
        if self.turned is not None:
            places, signs = self.turned
            ways.append(signs * other.x[places])
        return any(np.abs((one.x - way) / self.ranges).max() < _ALIKE for way in ways)


#: Why a search ends, by what is told of it.
STOPPED = {
    "starts": "as many starts as were asked for",
    "surfaces": "both sides of every surface",
    "seconds": "as much time as was asked for",
    "interrupted": "interrupted; these were found so far",
}
KEPT = 40  # minima that are told of

_MOST, _COLUMNS = 9, 3  # lenses of the figure


@value
class Searched(Result):
    """The minima (M,), the best first.

    lenses: one each; merit, focal_length in mm, spots (M, F): RMS radius of every field in mm, all wavelengths by their
    weights; found: how many of the descents that were followed to their end; after: processor seconds until the first
    did; tasks: which one that was. variables: (M, n). starts, descents: how many there were of either: the best starts
    are followed, and hops from the best minima.
    """

    before: Lens
    lenses: tuple[Lens, ...]
    names: tuple[str, ...]
    tasks: tuple[str, ...]
    variables: Tensor
    merit: Tensor
    focal_length: Tensor
    spots: Tensor
    found: Tensor
    after: Tensor
    starts: int
    descents: int
    seconds: float
    stopped: str

    @property
    def lens(self) -> Lens:
        """The best one."""
        return self.lenses[0]

    def columns(self) -> dict[str, Tensor]:
        fields = {f"rms_{f}": self.spots[:, f - 1] for f in range(1, self.spots.shape[1] + 1)}
        variables = {name: self.variables[:, k] for k, name in enumerate(self.names)}
        number = torch.arange(1, len(self.lenses) + 1)
        own = {"minimum": number, "merit": self.merit, "efl": self.focal_length, **fields}
        return {**own, "found": self.found, "seconds": self.after, **variables}

    def document(self) -> dict:
        told = {"starts": self.starts, "descents": self.descents, "seconds": round(self.seconds, 3)}
        told |= {"stopped": self.stopped}
        return {**told, **Result.document(self)}

    def __str__(self) -> str:
        width = max(8 * self.spots.shape[1], 8)
        count = f"{len(self.lenses)} minima" if len(self.lenses) > 1 else "1 minimum"
        lines = [
            self.before.name,
            f"  {count} from {self.starts} starts in {self.seconds:.1f} s; {STOPPED[self.stopped]}",
            f"  found: by how many of the {self.descents} descents that were followed to their end\n",
            f"  {'':>7} {'':>12} {'EFL':>10} {'RMS spots':>{width}}\n  {'minimum':>7} {'merit':>12} {'mm':>10} "
            f"{'µm, by field':>{width}} {'found':>6}",
        ]
        for k in range(len(self.lenses)):
            spots = "".join(cell(1e3 * float(one), "8.2f") for one in self.spots[k])
            length = cell(float(self.focal_length[k]), "10.4f")
            merit, found = float(self.merit[k]), int(self.found[k])
            lines.append(f"  {k + 1:>7} {merit:>12.6g} {length} {spots:>{width}} {found:>6}")
        return "\n".join(lines)

    @style.styled
    def draw(self):
        """The best lenses on one scale, each with its merit, its spots and how often it was self."""
        count = min(_MOST, len(self.lenses))
        columns = min(_COLUMNS, count)
        rows = -(-count // columns)
        figure = style.new_figure(3.6 * max(columns, 2), 2.5 * rows + 0.5)
        figure.suptitle(
            style.fill(self.before.name or "Lens", figure.get_figwidth(), 11, bold=True), fontsize=11, fontweight="bold"
        )
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for k, axes in enumerate(panels):
            if k < count:
                _draw(axes, self, k)
            else:
                axes.set_axis_off()
        on_one_scale(panels[:count])
        return figure

    def save(self, folder: str | PathLike) -> None:
        """Write a lens file and a thumbnail of every minimum, the table, and a figure of the best side by side."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for number, lens in enumerate(self.lenses, 1):
            with warnings.catch_warnings():
                if number > 1:  # what a file cannot hold is the same of all
                    warnings.simplefilter("ignore", LensFileWarning)
                write_lens(lens, folder / f"minimum_{number:02d}.zmx")
            thumbnail(lens, folder / f"minimum_{number:02d}.png")
        for path in folder.glob("minimum_*.*"):
            if path.stem.removeprefix("minimum_").isdigit() and int(path.stem.removeprefix("minimum_")) > number:
                path.unlink()
        columns = {name: column.tolist() for name, column in self.columns().items()}
        write_table(
            folder / "minima.csv", [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        )
        self.plot(folder / "best.png")


def searched(
    lens: Lens, each: Sequence[tuple[Problem, Minimum]], *, starts: int, descents: int, stopped: str, seconds: float
) -> Searched:
    """The result: minima, the best first, each with the problem that it is one of. Raises NoProblem without any."""
    if not each:
        raise NoProblem(
            f"no lens of all light, and of what is held, from {starts} starts: allow more by `starts`, `seconds` or "
            "wider `bounds`, or hold less"
        )
    kept = each[:KEPT]
    lenses = tuple(_named(lens, problem, one.ended.x, k) for k, (problem, one) in enumerate(kept, 1))
    tensor = lambda numbers: torch.tensor(np.asarray(numbers, dtype=float), dtype=torch.float64)  # noqa: E731
    names, variables = _variables(kept)
    return Searched(
        before=lens,
        lenses=lenses,
        names=names,
        tasks=tuple(one.task for _, one in kept),
        variables=tensor(variables),
        merit=tensor([one.ended.merit for _, one in kept]),
        focal_length=torch.stack([first_order(one).effective_focal_length.reshape(()) for one in lenses]),
        spots=torch.stack([_spots(one) for one in lenses]),
        found=torch.tensor([one.found for _, one in kept]),
        after=tensor([one.seconds for _, one in kept]),
        starts=starts,
        descents=descents,
        seconds=seconds,
        stopped=stopped,
    )


def _variables(kept: Sequence[tuple[Problem, Minimum]]) -> tuple[tuple[str, ...], list[list[float]]]:
    """Names of what varies in any of them, and their numbers; nan where one does not vary."""
    tables = [
        {f"{v.quantity}_{v.surface}": number for v, number in zip(problem.model.variables, one.ended.x, strict=True)}
        for problem, one in kept
    ]
    names = tuple(dict.fromkeys(name for table in tables for name in table))
    return names, [[table.get(name, np.nan) for name in names] for table in tables]


def _spots(lens: Lens) -> Tensor:
    """RMS radius (F,) in mm about the centroid of all wavelengths, by their weights."""
    each = spot(lens, wavelengths=lens.wavelengths)
    share = lens.wavelength_weights / lens.wavelength_weights.sum()
    centre = (each.centroid * share).sum(-1, keepdim=True)
    apart = (each.centroid - centre).square().sum(0)
    return ((each.rms_radius.square() + apart) * share).sum(-1).sqrt().reshape(-1)


def _named(lens: Lens, problem: Problem, x: np.ndarray, number: int) -> Lens:
    """The lens there, with its number behind its name, and with what it was searched for."""
    model = problem.model
    found = model.lens_at(x)
    optimization_data = found.optimization_data or optimization_data_of(model, problem.rows, problem.unit)
    return replace(found, name=f"{lens.name}, minimum {number}".removeprefix(", "), optimization_data=optimization_data)


def _draw(axes, found: Searched, k: int) -> None:
    _draw_lens(axes, found.lenses[k])
    spots = ", ".join(f"{1e3 * float(one):.1f}" for one in found.spots[k])
    times = int(found.found[k])
    axes.set_title(
        f"{k + 1}: merit {style.number_text(float(found.merit[k]))}\n"
        f"RMS spots {spots} µm; found by {times} of {found.descents} descents", fontsize=8,
    )  # fmt: skip


def _draw_lens(axes, lens: Lens) -> None:
    lens = detached(lens)
    draw_layout(axes, lens, fields=drawn_fields(lens), rays=3)


@style.styled
def thumbnail(lens: Lens, path: str | PathLike) -> None:
    """Write the cross section alone, small."""
    figure = style.new_figure(3.0, 1.8)
    _draw_lens(figure.add_subplot(), lens)
    style.save(figure, path, dpi=80)
