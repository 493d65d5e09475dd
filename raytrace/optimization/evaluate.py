"""Evaluating: what a lens is worth by a merit function, row by row."""

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.result import Result, cell, rows
from raytrace.maths.value import value
from raytrace.optimization.default_merit import DefaultMerit
from raytrace.optimization.lens_model import Model
from raytrace.optimization.merit import Merit, arguments, configurations_of, merit_for
from raytrace.optimization.merit_rows import Evaluation
from raytrace.optimization.operands.table import OPERANDS
from raytrace.plotting.style import FAINT, field_colours, new_figure, number_text, styled
from raytrace.system.lens import Lens, field_points
from raytrace.system.optimization_data import Row
from raytrace.tracing.launch import warn_of_filling

_WHOLE = 40  # rows that are listed one by one
_TOGETHER = 3  # rows of one field that share a line in longer tables

_BARS = 16  # of the figure


@value
class MeritResult(Result):
    """A merit function of a lens.

    merit: √(Σ w (v - t)²/Σ w), in its unit of length: `unit` mm. function: all its rows. row: (R,) the numbers, from 1,
    of those that have a value; values: (R,) mm, radians, waves … as operands have them, lengths in its unit; targets,
    weights: (R,); contributions: (R,) parts of the square of the merit, which add up to 1; lost: (R,) bool, whether a
    ray that the row needs does not arrive; configurations: (R,) of the rows. skipped: numbers of rows of unknown
    operands, which are left out. each: whether the text lists every row.
    """

    lens: Lens
    merit: Tensor
    function: tuple[Row, ...]
    row: Tensor
    values: Tensor
    targets: Tensor
    weights: Tensor
    contributions: Tensor
    lost: Tensor
    configurations: Tensor
    unit: float
    skipped: tuple[int, ...]
    each: bool = False

    def columns(self) -> dict[str, Tensor]:
        kinds, said = self.words()["operand"], self.words()["arguments"]
        rows = self.valued()
        return {
            "row": self.row,
            "configuration": self.configurations,
            "operand": torch.tensor([kinds.index(row.name) for row in rows], dtype=torch.int64),
            "arguments": torch.tensor([said.index(arguments(row)) for row in rows], dtype=torch.int64),
            "target": self.targets,
            "weight": self.weights,
            "value": self.values,
            "contribution": self.contributions,
            "lost": self.lost,
        }

    def words(self) -> dict[str, Sequence[str]]:
        rows = self.valued()
        return {
            "operand": [*dict.fromkeys(row.name for row in rows)],
            "arguments": [*dict.fromkeys(map(arguments, rows))],
        }

    def valued(self) -> list[Row]:
        """The rows that have a value."""
        return [self.function[number - 1] for number in self.row.tolist()]

    def document(self) -> dict:
        words = self.words()
        told = [{**one, **{name: words[name][int(one[name])] for name in words}} for one in rows(self.columns())]
        for one in told:
            one |= {"row": int(one["row"]), "configuration": int(one["configuration"]), "lost": bool(one["lost"])}
        head = {"merit": float(self.merit), "unit": self.unit, "skipped": [*self.skipped]}
        return {"analysis": "merit", **head, "results": told}

    def __str__(self) -> str:
        counted, unit = int((self.weights != 0).sum()), "" if self.unit == 1 else f", lengths in {self.unit:g} mm"
        lines = [f"merit {float(self.merit):.10g}: {len(self.row)} rows, {counted} with a weight{unit}"]
        if self.skipped:
            left = ", ".join(f"{number} ({self.function[number - 1].name})" for number in self.skipped)
            lines.append(f"left out, unknown: rows {left}")
        if lost := int(self.lost.sum()):
            lines.append(f"{lost} rows have lost their ray")
        several = len({*self.configurations.tolist()}) > 1
        groups = [*self.groups()]
        width = max((len(arguments(self.function[group[0]])) for group in groups), default=0) + 2
        width = max(width, 18)
        head = f"{'row':>9}  {'operand':<8}{'arguments':<{width}}{'target':>12}{'weight':>12}{'value':>14}{'part':>9}"
        lines.append((f"{'conf.':>5}" if several else "") + head)
        lines += [(f"{self._configuration(g):>5}" if several else "") + self._line(g, width) for g in groups]
        return "\n".join(lines)

    def groups(self) -> Iterator[list[int]]:
        """Rows, from 0 in `function`, that share a line of the text: in long tables rays of one field."""
        numbers = [number - 1 for number in self.row.tolist()]
        if self.each or len(numbers) <= _WHOLE:
            yield from ([number] for number in numbers)
            return
        for _, together in groupby(numbers, self._shared):
            alike = [*together]
            yield from [alike] if len(alike) >= _TOGETHER else ([one] for one in alike)

    def _shared(self, number: int) -> tuple:
        row = self.function[number]
        alone = () if row.weight and any(row.numbers[2:]) else (number,)
        return (row.operand, row.integers[0], row.numbers[:2], row.target, self._configuration([number]), *alone)

    def _configuration(self, group: list[int]) -> int:
        return int(self.configurations[self.row.tolist().index(group[0] + 1)])

    def _line(self, group: list[int], width: int) -> str:
        row, places = self.function[group[0]], [self.row.tolist().index(number + 1) for number in group]
        weight, v = self.weights[places], self.values[places]
        if len(group) == 1:
            name, said, shown = str(group[0] + 1), arguments(row), cell(float(v), ">14.6g")
        else:
            name = f"{group[0] + 1}-{group[-1] + 1}"
            said = f"field {row.numbers[0]:.4g} {row.numbers[1]:.4g}, {len(group)} rays"
            shown = cell(float((weight * v**2).sum().div(weight.sum()).sqrt()), ">14.6g")
        part, lost = float(self.contributions[places].sum()), "  lost" if bool(self.lost[places].any()) else ""
        told = f"{row.target:>12.6g}{float(weight.sum()):>12.6g}{shown}{100 * part:>8.2f}%{lost}"
        return f"{name:>9}  {row.name:<8}{said:<{width}}{told}"

    @styled
    def draw(self):
        """A bar for every operand and field, the largest part first; rays of a field share one.

        Bars are coloured by operand; the smallest are summed in the last bar.
        """
        shares = _shares(self)
        names = sorted(shares, key=lambda name: -shares[name][1])
        shown, rest = names[:_BARS], names[_BARS:]
        kinds = [*dict.fromkeys(shares[name][0] for name in shown)]
        colours = dict(zip(kinds, field_colours(len(kinds)), strict=True))
        figure = new_figure(6.4, 0.24 * (len(shown) + bool(rest)) + 1.2)
        panel = figure.subplots()
        bars = [(name, 100 * shares[name][1], colours[shares[name][0]]) for name in shown]
        if rest:
            bars.append((f"{len(rest)} more", 100 * sum(shares[name][1] for name in rest), FAINT))
        labels, parts, fills = zip(*bars, strict=True)
        panel.barh(range(len(bars)), parts, color=fills, height=0.72)
        panel.set_yticks(range(len(bars)), labels)
        panel.invert_yaxis()
        panel.grid(axis="x", color=FAINT, linewidth=0.6, alpha=0.6)
        panel.set_axisbelow(True)
        panel.set_xlabel("part of the square of the merit (%)")
        title = f"merit {number_text(float(self.merit))}"
        panel.set_title(f"{self.lens.name}: {title}" if self.lens.name else title)
        return figure


def evaluate(
    lens: Lens,
    *,
    merit: Merit | DefaultMerit | Sequence[Row] | str | None = None,
    configuration: int | None = None,
    each: bool = False,
) -> MeritResult:
    """What the lens is worth by a merit function, row by row.

    merit: `Merit`, `DefaultMerit`, rows, or a kind of default one ("spot", "wavefront", "angular", "mtf"); by default
    the file's. configuration: its rows alone. each: list every row in the text. Raises BadMerit, UnknownOperand.
    """
    function = merit_for(lens, merit, configuration and [configuration])
    warn_of_filling(lens, field_points(None, like=lens))
    where = configurations_of(function, lens.current_configuration)
    if configuration is not None:
        apart = {number: 0.0 for number, at in enumerate(where, 1) if at != configuration}
        function = function.with_weights(apart)
    planned = Evaluation(
        Model(lens),
        function.rows,
        unit=function.unit,
        skip_unknown=function.skip_unknown,
        conventions=function.conventions,
    )
    shown = [
        k for k, row in enumerate(function) if row.operand in OPERANDS and where[k] in (configuration or where[k],)
    ]
    return _result(lens, function, planned, shown, [where[k] for k in shown], each)


def _result(
    lens: Lens, function: Merit, planned: Evaluation, shown: list[int], where: list[int], each: bool
) -> MeritResult:
    """shown: the rows, from 0, that have a value; where: the configuration of each."""
    found, like = planned(np.zeros(0)), torch.float64
    squares = np.bincount(found.of_row, found.residuals**2, minlength=len(function))[shown]
    return MeritResult(
        lens=lens,
        merit=torch.tensor(found.merit, dtype=like),
        function=function.rows,
        row=torch.tensor([k + 1 for k in shown], dtype=torch.int64),
        values=torch.as_tensor(found.values[shown], dtype=like),
        targets=torch.as_tensor(planned.targets[shown], dtype=like),
        weights=torch.as_tensor(planned.weights[shown], dtype=like),
        contributions=torch.as_tensor(squares / max(squares.sum(), 1e-300), dtype=like),
        lost=torch.as_tensor(found.lost[shown]),
        configurations=torch.tensor(where, dtype=torch.int64),
        unit=function.unit,
        skipped=planned.skipped,
        each=each,
    )


def _shares(found: MeritResult) -> dict[str, tuple[str, float]]:
    """Operand and part of every bar by its name."""
    several = len({*found.configurations.tolist()}) > 1
    shares: dict[str, tuple[str, float]] = {}
    numbers = (found.row, found.configurations, found.weights, found.contributions)
    for row, number, at, weight, part in zip(found.valued(), *(n.tolist() for n in numbers), strict=True):
        if weight:
            name = f"{_name(number, row)}, conf. {at}" if several else _name(number, row)
            shares[name] = (row.name, shares.get(name, ("", 0.0))[1] + part)
    return shares or {"no row has a weight": ("", 0.0)}


def _name(number: int, row: Row) -> str:
    if any(row.numbers[2:]):
        return f"{row.name} field {row.numbers[0]:.3g}, {row.numbers[1]:.3g}"
    return f"{number} {row.name} {arguments(row)}".rstrip()
