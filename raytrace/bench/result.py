"""Measurements as text, table, JSON document and figure, and the machine on which they were made."""

import dataclasses
import math
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from raytrace.maths.result import Column, Result, Table, plain
from raytrace.plotting.style import FAINT, field_colour, new_figure, styled

#: A quantity of a row as a number or a text of the table; None where the row has no such quantity.
Quantity = Callable[[Any], float | str | None]


@dataclasses.dataclass(frozen=True, repr=False)
class Measured(Result):
    """Measurements of one kind.

    rows: dataclasses of one class; about: conditions and machine, in the JSON document; printed: columns of the text;
    notes: lines below the table; figure: draws the rows, None: no figure.
    """

    rows: Sequence[Any]
    about: dict
    printed: Mapping[Column, Quantity]
    notes: Sequence[str]
    figure: Callable[[Sequence[Any]], Figure] | None = None

    def document(self) -> dict:
        return self.about | {"rows": [plain(dataclasses.asdict(row)) for row in self.rows]}

    def to_frame(self) -> Any:
        """All quantities of the rows for pandas."""
        import pandas

        return pandas.DataFrame(list(map(dataclasses.asdict, self.rows)))

    def tables(self) -> list[Table]:
        columns: dict[str | Column, list] = {}
        for column, quantity in self.printed.items():
            columns[column] = [math.nan if (value := quantity(row)) is None else value for row in self.rows]
        machine = "; ".join(f"{name}: {value}" for name, value in self.about["machine"].items())
        return [Table(columns, notes=("", *self.notes, f"Machine: {machine}."))]

    def draw(self, **options: Any) -> Figure:
        return self.figure(self.rows) if self.figure else super().draw(**options)


def machine() -> dict[str, str | int]:
    """The machine and the versions on which measurements depend."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "vector instructions": torch.backends.cpu.get_cpu_capability(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torch threads": torch.get_num_threads(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


@styled
def curves(panels: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]], abscissa: str, ordinate: str) -> Figure:
    """Points (x, y) on logarithmic axes, joined: by the title of their panel and the label of their line."""
    figure = new_figure(3.7 * len(panels), 3.9)
    axes = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    labels = list(dict.fromkeys(label for lines in panels.values() for label in lines))
    entries = {}
    for panel, (title, lines) in zip(axes, panels.items(), strict=True):
        for label, points in lines.items():
            look = {"color": field_colour(labels.index(label)), "marker": "o", "markersize": 4, "linewidth": 1.1}
            entries[label] = panel.plot(*zip(*points, strict=True), **look)[0]
        panel.set(xscale="log", yscale="log", title=title, xlabel=abscissa)
        panel.grid(True, color=FAINT, linewidth=0.5)
    axes[0].set_ylabel(ordinate)
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=3)
    return figure


def clock_name(threads: int) -> str:
    """The quantity that `measure.clock` reads."""
    return "processor time" if threads == 1 else "time of day"
