"""The value of a merit function of a lens, row by row."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_sqrt, value
from raytrace.maths.result import Column, Result, Table, rows
from raytrace.optimization.attained import Attained, attained_by, table_of
from raytrace.optimization.merit import DefaultMerit, Evaluation, Merit, arguments, configurations_of, merit_for
from raytrace.optimization.merit_of_batch import MeritOfBatch
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.variables import DesignVariables
from raytrace.plotting.style import FAINT, field_colours, new_figure, number_text, styled
from raytrace.system.lens import Lens, field_points
from raytrace.system.optimization_data import Row
from raytrace.tracing.launch import warn_of_filling

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WHOLE = 40  # rows up to which each has a line
_TOGETHER = 3  # rows of one field that share a line in longer tables
_BARS = 16  # of the figure


@value
class MeritResult(Result):
    """A merit function of a lens.

    merit: √(Σ w (v - t)²/Σ w), in its unit of length: `unit` mm. function: all its rows. row: (R,) the numbers, from 1,
    of those that have a value; values: (R,) mm, radians, waves … of the operands, lengths in its unit; targets,
    weights: (R,); contributions: (R,) parts of the square of the merit, which add up to 1; lost: (R,) bool, rows with a
    lost ray; configurations: (R,) of the rows. skipped: numbers of rows of unknown operands, which are left out. each:
    whether the text lists every row. conditions: those of the lens and boundaries of its own merit function, with the
    values that it has; rows of negative weight are conditions, no part of the merit.
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
    conditions: tuple[Attained, ...] = ()

    COLUMNS = property(
        lambda self: [Column(name, f"of the operand, lengths in {self.unit:g} mm") for name in ("target", "value")]
    )

    def columns(self) -> dict[str, Tensor]:
        words, valued = self.words(), self.valued()
        operands = [words["operand"].index(row.name) for row in valued]
        return {
            "row": self.row,
            "configuration": self.configurations,
            "operand": torch.tensor(operands, dtype=torch.int64),
            "arguments": torch.tensor([words["arguments"].index(arguments(row)) for row in valued], dtype=torch.int64),
            "target": self.targets,
            "weight": self.weights,
            "value": self.values,
            "contribution_percent": 100 * self.contributions,
            "lost": self.lost,
        }

    def words(self) -> dict[str, Sequence[str]]:
        valued = self.valued()
        return {
            "operand": [*dict.fromkeys(row.name for row in valued)],
            "arguments": [*dict.fromkeys(map(arguments, valued))],
        }

    def valued(self) -> list[Row]:
        """The rows that have a value."""
        return [self.function[number - 1] for number in self.row.tolist()]

    def document(self) -> dict:
        words = self.words()
        results = [{**row, **{name: words[name][int(row[name])] for name in words}} for row in rows(self.columns())]
        for row in results:
            row |= {"row": int(row["row"]), "configuration": int(row["configuration"]), "lost": bool(row["lost"])}
        head = {"merit": float(self.merit), "unit": self.unit, "skipped": [*self.skipped]}
        conditions = [condition.document() for condition in self.conditions]
        return {"analysis": "merit", **head, "results": results, **({"conditions": conditions} if conditions else {})}

    def tables(self) -> list[Table]:
        """A line for every row; in long tables for the rays of one field."""
        counted, unit = int((self.weights != 0).sum()), "" if self.unit == 1 else f", lengths in {self.unit:g} mm"
        lines = [f"merit {float(self.merit):.10g}: {len(self.row)} rows, {counted} with a weight{unit}"]
        if self.skipped:
            left = ", ".join(f"{number} ({self.function[number - 1].name})" for number in self.skipped)
            lines.append(f"left out, unknown: rows {left}")
        if lost := int(self.lost.sum()):
            lines.append(f"{lost} rows have lost their ray")
        groups, valued = [*self._groups()], self.valued()
        first = [group[0] for group in groups]
        columns: dict[Column, Any] = {
            Column("conf."): self.configurations[first],
            Column("row"): [self._numbers(group) for group in groups],
            Column("operand", form="<"): [valued[k].name for k in first],
            Column("arguments", form="<"): [self._arguments(group) for group in groups],
            Column("target"): self.targets[first],
            Column("weight"): torch.stack([self.weights[group].sum() for group in groups]) if groups else [],
            Column("value"): [self._value(group) for group in groups],
            Column("part", "%", ".2f"): [100 * float(self.contributions[group].sum()) for group in groups],
            Column("lost", form="<", heading=" "): ["lost" if bool(self.lost[g].any()) else "" for g in groups],
        }
        if len({*self.configurations.tolist()}) < 2:
            del columns[Column("conf.")]
        conditions = table_of(self.conditions)
        return [Table(columns, lines, ["", *conditions] if conditions else [])]

    def _numbers(self, group: list[int]) -> str:
        first, last = (int(self.row[k]) for k in (group[0], group[-1]))
        return str(first) if len(group) == 1 else f"{first}-{last}"

    def _arguments(self, group: list[int]) -> str:
        row = self.valued()[group[0]]
        return (
            arguments(row) if len(group) == 1 else f"field {row.numbers[0]:.4g} {row.numbers[1]:.4g}, {len(group)} rays"
        )

    def _value(self, group: list[int]) -> float:
        """Of a row, or the root mean square of the rays of a field."""
        weight, v = self.weights[group], self.values[group]
        return float(v) if len(group) == 1 else float((weight * v**2).sum().div(weight.sum()).sqrt())

    def _groups(self) -> Iterator[list[int]]:
        """Places of the rows that share a line of the text: in long tables rays of one field."""
        valued, configurations = self.valued(), self.configurations.tolist()
        if self.each or len(valued) <= _WHOLE:
            yield from ([k] for k in range(len(valued)))
            return

        def shared(k: int) -> tuple:
            row = valued[k]
            alone = () if row.weight and any(row.numbers[2:]) else (k,)
            return (row.operand, row.integers[0], row.numbers[:2], row.target, configurations[k], *alone)

        for _, together in groupby(range(len(valued)), shared):
            alike = [*together]
            yield from [alike] if len(alike) >= _TOGETHER else ([k] for k in alike)

    @styled
    def draw(self, **options: Any) -> "Figure":
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


@value
class MeritsOfBatch(Result):
    """A merit function of a batch of lenses: merit (L,), with its derivatives, and what `MeritResult` has, for each.

    values, contributions: (L, R), lost: (L, R) bool, of the rows `row` (R,) that have a value, from 1.
    """

    lens: Lens
    merit: Tensor
    function: tuple[Row, ...]
    row: Tensor
    values: Tensor
    contributions: Tensor
    lost: Tensor
    unit: float

    COLUMNS = (Column("lens"), Column("merit", form=".10g"), Column("lost_rows"))

    def columns(self) -> dict[str, Tensor]:
        return {"lens": torch.arange(len(self.merit)), "merit": self.merit.detach(), "lost_rows": self.lost.sum(-1)}


def _of_batch(lens: Lens, function: Merit, shown: list[int]) -> MeritsOfBatch:
    """The merit function of each lens of a batch; shown: places of the rows that are listed."""
    merits = MeritOfBatch(lens, function)
    each = merits.evaluated()
    return MeritsOfBatch(
        lens=lens,
        merit=safe_sqrt(merits.square()),
        function=function.rows,
        row=torch.tensor([k + 1 for k in shown], dtype=torch.int64),
        values=torch.as_tensor(np.stack([evaluated.values[shown] for evaluated in each])),
        contributions=torch.as_tensor(np.stack([evaluated.contributions(shown) for evaluated in each])),
        lost=torch.as_tensor(np.stack([evaluated.lost[shown] for evaluated in each])),
        unit=function.unit,
    )


def evaluate(
    lens: Lens,
    *,
    merit: Merit | DefaultMerit | Sequence[Row] | str | None = None,
    configuration: int | None = None,
    each: bool = False,
) -> MeritResult | MeritsOfBatch:
    """The merit of a lens, or of each lens of a batch, and the values of the rows of its merit function.

    merit: `Merit`, `DefaultMerit`, rows, or a kind of default one ("spot", "wavefront", "angular", "mtf"); by default
    the file's. configuration: its rows alone. each: list every row in the text. Of a batch the merit (L,) has
    derivatives by every number of the lenses. Raises BadMerit, UnknownOperand.
    """
    function = merit_for(
        lens if lens.count is None else lens[0], merit, configuration if configuration is None else [configuration]
    )
    if lens.count is None:
        warn_of_filling(lens, field_points(None, like=lens))
    of_rows = configurations_of(function, lens.current_configuration)
    if configuration is not None:
        function = function.with_weights({k: 0.0 for k, of_row in enumerate(of_rows, 1) if of_row != configuration})
    shown = [
        k for k, row in enumerate(function) if row.operand in OPERANDS and of_rows[k] in (configuration or of_rows[k],)
    ]
    if lens.count is not None:
        return _of_batch(lens, function, shown)
    free = [replace(row, weight=0.0) if row.weight < 0 else row for row in function.rows]
    evaluation = Evaluation(DesignVariables(lens), free, **function.options)
    evaluated, like = evaluation(np.zeros(0)), torch.float64
    weights = np.minimum(evaluation.weights, [row.weight for row in function.rows])
    return MeritResult(
        lens=lens,
        merit=torch.tensor(evaluated.merit, dtype=like),
        function=function.rows,
        row=torch.tensor([k + 1 for k in shown], dtype=torch.int64),
        values=torch.as_tensor(evaluated.values[shown], dtype=like),
        targets=torch.as_tensor(evaluation.targets[shown], dtype=like),
        weights=torch.as_tensor(weights[shown], dtype=like),
        contributions=torch.as_tensor(evaluated.contributions(shown), dtype=like),
        lost=torch.as_tensor(evaluated.lost[shown]),
        configurations=torch.tensor([of_rows[k] for k in shown], dtype=torch.int64),
        unit=function.unit,
        skipped=evaluation.skipped,
        each=each,
        conditions=attained_by(lens),
    )


def _shares(result: MeritResult) -> dict[str, tuple[str, float]]:
    """Operand and part of every bar by its name."""
    several = len({*result.configurations.tolist()}) > 1
    shares: dict[str, tuple[str, float]] = {}
    numbers = (result.row, result.configurations, result.weights, result.contributions)
    for row, number, configuration, weight, part in zip(result.valued(), *(n.tolist() for n in numbers), strict=True):
        if weight:
            name = f"{_name(number, row)}, conf. {configuration}" if several else _name(number, row)
            shares[name] = (row.name, shares.get(name, ("", 0.0))[1] + part)
    return shares or {"no row has a weight": ("", 0.0)}


def _name(number: int, row: Row) -> str:
    if any(row.numbers[2:]):
        return f"{row.name} field {row.numbers[0]:.3g}, {row.numbers[1]:.3g}"
    return f"{number} {row.name} {arguments(row)}".rstrip()
