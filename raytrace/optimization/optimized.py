"""Result of an optimisation: the lens, the values of its variables and rows before and after, and their tables."""

import dataclasses
from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from raytrace.io import write_lens
from raytrace.materials.selection import GlassList, columns_of
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Columns, Result, Table, number, plain
from raytrace.optimization.attained import Attained, table_of
from raytrace.optimization.between import Between, summary
from raytrace.optimization.checkpoint import STOPPED
from raytrace.optimization.fitting import Fitted
from raytrace.optimization.glass_choice import GlassStep
from raytrace.optimization.loss import LossReport
from raytrace.optimization.merit import configurations_of
from raytrace.optimization.operands.mtf import MODULATION
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import Expectation
from raytrace.optimization.spacer_choice import SpacerStep
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.tracing.paraxial import first_order
from raytrace.words import option

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = 12  # rows of the merit function in the text, those of largest contribution
_UNSHARP = 0.1  # MTF, of a start from which an MTF merit function is far from its maximum


def _glass_table(steps: Sequence[GlassStep]) -> Table:
    columns: Columns = {
        Column("glass", form="<"): [step.words for step in steps],
        Column("predicted"): [step.predicted if step.surface else "" for step in steps],
        Column("merit"): [step.reached for step in steps],
        Column("seconds", form=".1f", heading="s"): [step.seconds for step in steps],
    }
    return Table(columns, [""])


def _chosen_table(lens: Lens, steps: Sequence[GlassStep], listing: GlassList | None) -> Table:
    """The glasses behind the surfaces where they were chosen, with their status and price."""
    surfaces = sorted({step.surface for step in steps if step.surface})
    glasses = [lens.surfaces[k].glass for k in surfaces]
    head = [] if listing is None else [f"glasses to choose from: {listing.summary}", ""]
    return Table({Column("surface"): surfaces, **columns_of(glasses)} if glasses else {}, ["", *head])


@value
class AsBuiltChange:
    """RMS spot radius in mm, before and after: expected of the lens as built (the root of the mean square), and of the
    refocused lens without errors; tolerances: of which errors."""

    tolerances: str
    expected: tuple[float, float]
    nominal: tuple[float, float]

    @classmethod
    def of(cls, term: Expectation, before: Lens, after: Lens) -> "AsBuiltChange":
        with torch.no_grad():
            radii = [(float(q(before)) ** 0.5, float(q(after)) ** 0.5) for q in (term.expected, term.nominal)]
        return cls(term.words(), *radii)

    def __str__(self) -> str:
        pairs = (self.expected, self.nominal)
        expected, nominal = (" → ".join(f"{1e3 * radius:.5g}" for radius in pair) + " µm" for pair in pairs)
        return f"RMS spot radius as built ({self.tolerances}): expected {expected}, without errors {nominal}"


@value
class Optimized(Result):
    """The lens at the lowest merit reached, and the initial one, `before`.

    merit: the rows of the merit function (R,); merit_before, merit_after: its values. names: (n,) of the variables;
    variables_before, variables_after: (n,) their values, lengths in mm. values_before, values_after: (R,) of the rows;
    contributions_before, contributions: (R,) of each to the square of the merit, of sum 1. history: (cycles, 5) merit,
    largest violation of a condition, step, damping and seconds of every cycle of the last descent. cycles, evaluations,
    seconds: of the whole optimisation; stopped: a key of `checkpoint.STOPPED`. glasses: the steps in which variable
    glasses were chosen; chosen_from: the glasses that could be chosen; spacers: the steps in which materials of spacers
    were chosen. conditions: targets and values reached of
    conditions and boundaries. as_built: spots of the lens as built, if it is a term of the merit, which then includes
    it. loss: the way of a loss, in the place of rows. between: the largest spots between fields, wavelengths and rays
    relative to those beside them; none of an afocal lens. fitted: the parts of stock or test plates that the lens has
    taken.
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
    chosen_from: GlassList | None = None
    spacers: tuple[SpacerStep, ...] = ()
    conditions: tuple[Attained, ...] = ()
    as_built: AsBuiltChange | None = None
    loss: LossReport | None = None
    between: tuple[Between, ...] = ()
    fitted: Fitted | None = None

    def draw(self, **options: Any) -> "Figure":
        """One page: lens, spots and merit function before and after."""
        from raytrace.optimization.optimized_figure import optimize_report

        return optimize_report(self)

    @property
    def measure(self) -> str:
        """What was minimised, in a word."""
        return "merit" if self.loss is None else "loss"

    @property
    def rows(self) -> tuple[int, ...]:
        """Rows that have a value, counted from 1."""
        return tuple(i for i, row in enumerate(self.merit, 1) if row.operand in OPERANDS)

    @property
    def falls_short(self) -> bool:
        return not all(condition.met for condition in self.conditions)

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

    def words(self) -> dict[str, Sequence[str]]:
        return {"operand": [*dict.fromkeys(self.merit[i - 1].name for i in self.rows)]}

    def document(self) -> dict[str, Any]:
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
                **({"spacers": [step.document() for step in self.spacers]} if self.spacers else {}),
                **({"chosen_from": self.chosen_from.summary} if self.chosen_from else {}),
                **({"fitted": self.fitted.document()} if self.fitted else {}),
                **({"as_built": dataclasses.asdict(self.as_built)} if self.as_built else {}),
                **({"loss": dataclasses.asdict(self.loss)} if self.loss else {}),
                "conditions": [condition.document() for condition in self.conditions],
                **({"between": [dataclasses.asdict(spot) for spot in self.between]} if self.between else {}),
            }
        )

    def tables(self) -> list[Table]:
        """Variables, chosen glasses, configurations and the largest rows of the merit function, then the conditions."""
        ratio = self.merit_before / self.merit_after if self.merit_after > 0 else np.inf
        head = [
            self.lens.name,
            f"  {self.measure} {self.merit_before:.8g} → {self.merit_after:.8g}"
            + (f", {ratio:.4g} times less" if 1.1 < ratio < np.inf else ""),
            f"  {self._cycles_in_words()}, {self.evaluations} evaluations, {self.seconds:.1f} s; "
            + STOPPED[self.stopped],
            *([f"  {self.as_built}"] if self.as_built else []),
            *([f"  {line}" for line in self.loss.lines()] if self.loss else []),
            *(f"  {step.words}; merit {step.reached:.6g}, predicted {step.predicted:.6g}" for step in self.spacers),
            *self._unsharp_start(),
            *(f"  {line}" for line in summary(self.between)),
            "",
        ]
        variables: Columns = {
            Column("variable", form="<"): self.names,
            Column("before", form=".8g"): self.variables_before,
            Column("after", form=".8g"): self.variables_after,
        }
        conditions = table_of(self.conditions)
        rows = self._largest_rows()
        rows = rows._replace(notes=[*rows.notes, *(["", *conditions] if conditions else [])])
        glasses = []
        if self.glasses:
            glasses = [_glass_table(self.glasses), _chosen_table(self.lens, self.glasses, self.chosen_from)]
        fitted = self.fitted.tables() if self.fitted else []
        return [
            Table(variables, head),
            *glasses,
            *fitted,
            *([self._lengths()] if self.has_configurations else []),
            rows,
        ]

    def _cycles_in_words(self) -> str:
        of_first = self.loss.first_cycles if self.loss else 0
        return f"{self.cycles} cycles" + (f" ({of_first} of pre-optimisation)" if of_first else "")

    def _unsharp_start(self) -> list[str]:
        """A line where most rows of the MTF start near zero, where the MTF has side lobes and nearly no slope."""
        rows = [k for k, row in enumerate(self.merit) if row.operand in MODULATION and row.weight != 0]
        low = int((self.values_before[rows].abs() < _UNSHARP).sum())
        if 2 * low <= len(rows):
            return []
        hint = f"minimise {option('merit', 'spot')} first, then the MTF from its result"
        return [f"  {low} of {len(rows)} rows of the MTF start below {_UNSHARP:g}, where it hardly has a slope: {hint}"]

    def _lengths(self) -> Table:
        """Focal lengths of every configuration, and its contribution to the square of the merit."""
        focal = {
            name: [float(first_order(view).effective_focal_length) for view in lens.configurations]
            for name, lens in (("before", self.before), ("after", self.lens))
        }
        numbers = range(1, len(focal["after"]) + 1)
        parts = [*zip(self.configurations, self.contributions.tolist(), strict=False)]
        left = [100 * sum(part for configuration, part in parts if configuration == k) for k in numbers]
        lengths = {Column(f"EFL {name}", "mm", ".8g"): values for name, values in focal.items()}
        return Table({Column("configuration"): numbers, **lengths, Column("left", "%", ".1f"): left}, [""])

    def _largest_rows(self) -> Table:
        """The rows of the largest contributions; none of a loss."""
        if not self.merit:
            return Table({}, [])
        left = sorted(self.rows, key=lambda i: -float(self.contributions[i - 1]))
        left = [i for i in left if self.merit[i - 1].weight != 0]
        shown = [self.merit[i - 1] for i in left[:_SHOWN]]
        places = [i - 1 for i in left[:_SHOWN]]
        ends = {
            Column(name, form=".6g"): ["lost" if np.isnan(value) else value for value in values[places].tolist()]
            for name, values in (("before", self.values_before), ("after", self.values_after))
        }
        columns: Columns = {
            **({Column("conf."): [self.configurations[k] for k in places]} if self.has_configurations else {}),
            Column("row"): left[:_SHOWN],
            Column("operand", form="<"): [row.name for row in shown],
            Column("target"): [row.target for row in shown],
            Column("weight", form=".4g"): [row.weight for row in shown],
            **ends,
            Column("left", "%", ".1f"): 100 * self.contributions[places],
        }
        rest = sum(float(self.contributions[i - 1]) for i in left[_SHOWN:])
        more = [f"and {len(left) - _SHOWN} more rows, {rest:.1%}"] if len(left) > _SHOWN else []
        return Table(columns, [""], more)

    def save(self, path: str | PathLike) -> None:
        """Write the lens, with its variables, its merit function and its conditions."""
        write_lens(self.lens, path)
