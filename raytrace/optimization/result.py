"""Optimized: the lens that an optimisation ended at, and how it came there."""

from os import PathLike

import numpy as np
import torch
from torch import Tensor

from raytrace.io import write_lens
from raytrace.maths.result import Result, cell, number, plain
from raytrace.maths.value import value
from raytrace.optimization.attained import Reached
from raytrace.optimization.glass_choice import GlassStep
from raytrace.optimization.merit import configurations_of
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.report import STOPPED, optimize_report
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.tracing.paraxial import first_order

_SHOWN = 12  # rows of the merit function in the text, those that are left most


@value
class Optimized(Result):
    """The lens at the least merit that was found, and the one before.

    merit: the rows; names (n,) of the variables, before and after in variables: (n,) in mm; values: (R,) of the rows
    before and after; contributions: (R,) of each to the square of the merit, which add up to 1; history: (cycles, 5)
    merit, how far conditions are missed, step, damping and seconds of every cycle; stopped: a key of STOPPED;
    glasses: the steps in which glasses that vary were chosen; conditions: what was asked for and what was reached.
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
        kept = [i - 1 for i in self.rows]
        rows = [self.merit[k] for k in kept]
        kinds = self.words()["operand"]
        return {
            "row": torch.tensor(self.rows),
            "configuration": torch.tensor([self.configurations[k] for k in kept]),
            "operand": torch.tensor([kinds.index(row.name) for row in rows]),
            "target": torch.tensor([row.target for row in rows], dtype=torch.float64),
            "weight": torch.tensor([row.weight for row in rows], dtype=torch.float64),
            "before": self.values_before[kept],
            "after": self.values_after[kept],
            "contribution": self.contributions[kept],
        }

    def words(self) -> dict:
        return {"operand": [*dict.fromkeys(self.merit[i - 1].name for i in self.rows)]}

    def document(self) -> dict:
        moved = zip(self.names, self.variables_before.tolist(), self.variables_after.tolist(), strict=True)
        before, after = self.values_before.tolist(), self.values_after.tolist()
        return plain(
            {
                "merit_before": self.merit_before,
                "merit_after": self.merit_after,
                "cycles": self.cycles,
                "evaluations": self.evaluations,
                "seconds": round(self.seconds, 3),
                "stopped": self.stopped,
                "variables": [{"name": name, "before": start, "after": end} for name, start, end in moved],
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
        fell = self.merit_before / self.merit_after if self.merit_after > 0 else np.inf
        lines = [
            self.lens.name,
            f"  merit {self.merit_before:.8g} → {self.merit_after:.8g}"
            + (f", {fell:.4g} times less" if 1.1 < fell < np.inf else ""),
            f"  {self.cycles} cycles, {self.evaluations} evaluations, {self.seconds:.1f} s; {STOPPED[self.stopped]}\n",
            f"  {'variable':<18} {'before':>16} {'after':>16}",
        ]
        for name, *ends in zip(self.names, self.variables_before.tolist(), self.variables_after.tolist(), strict=True):
            lines.append(f"  {name:<18} {ends[0]:>16.8g} {ends[1]:>16.8g}")
        if self.glasses:
            lines.append(f"\n  {'glass':<52} {'predicted':>14} {'merit':>14} {'s':>8}")
            lines += [f"  {step}" for step in self.glasses]
        lines += self._by_configuration()
        left = [i for i in sorted(self.rows, key=lambda i: -float(self.contributions[i - 1])) if self._counts(i)]
        ends = f"{'before':>14} {'after':>14}"
        head = f"{'conf.':>5} " if self.has_configurations else ""
        lines.append(f"\n  {head}{'row':>5} {'operand':<8} {'target':>12} {'weight':>10} {ends} {'left':>7}")
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

    def _by_configuration(self) -> list[str]:
        """The focal length of every configuration, and its part in the square of the merit; nothing of one alone."""
        if not self.has_configurations:
            return []
        lines = [f"\n  {'configuration':<18} {'EFL before, mm':>16} {'EFL after, mm':>16} {'left':>7}"]
        pairs = zip(self.before.configurations, self.lens.configurations, strict=True)
        for k, pair in enumerate(pairs, 1):
            lengths = " ".join(cell(float(first_order(one).effective_focal_length), "16.8g") for one in pair)
            of = zip(self.configurations, self.contributions.tolist(), strict=False)
            lines.append(f"  {k:<18} {lengths} {sum(part for at, part in of if at == k):>7.1%}")
        return lines

    def conditions_in_words(self) -> list[str]:
        """The table of what was asked for and reached; of boundaries that are met as many as fit."""
        shown = self.shown_conditions()
        if not shown:
            return []
        width = max(24, *(len(one.name) for one in shown))
        lines = [f"{'condition':<{width}} {'asked':>15} {'reached':>14}"]
        for one in shown:
            asked, number = f"{one.relation} {one.asked:.6g}", cell(one.reached, "14.6g")
            told = ", ".join(filter(None, ["" if one.met else "not met", one.place]))
            lines.append(f"{one.name:<{width}} {asked:>15} {number:>14}  {told}".rstrip())
        if len(shown) < len(self.conditions):
            lines.append(f"and {len(self.conditions) - len(shown)} more boundaries, met")
        return lines

    def shown_conditions(self) -> list[Reached]:
        """Those of tables: all but boundaries that are met, of which there are the first few."""
        chosen = [k for k, one in enumerate(self.conditions) if not one.met or not one.row]
        met = [k for k, one in enumerate(self.conditions) if one.met and one.row]
        return [self.conditions[k] for k in sorted(chosen + met[: max(_SHOWN - len(chosen), 0)])]

    def _counts(self, i: int) -> bool:
        return self.merit[i - 1].weight != 0

    def save(self, path: str | PathLike) -> None:
        """Write the lens, with its variables and its merit function."""
        write_lens(self.lens, path)
