"""Figure of an optimisation: one page with the lens, its spots and its merit function before and after."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.layout import draw_layout, on_one_scale
from raytrace.analysis.panels import first_order_text
from raytrace.analysis.spot_diagram import airy_radius, draw_spot_to_scale, field_spots, panel_size, wavelength_handles
from raytrace.maths.numerics import detached
from raytrace.optimization.attained import shown, table_of
from raytrace.optimization.checkpoint import STOPPED
from raytrace.optimization.fitting import Fitted
from raytrace.optimization.loss import LossReport
from raytrace.optimization.optimized import Optimized
from raytrace.plotting import style
from raytrace.system.lens import Lens, field_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_FIELDS = 5
_MOST_BARS = 10
_MOST_CONFIGURATIONS = 4
_BEFORE, _AFTER = style.FAINT, style.FIELD_COLOURS[0]


@style.styled
def optimize_report(result: Optimized) -> "Figure":
    """One page: the lens and its spots before and after in its configurations, on one scale, the merit by cycle, the
    largest contributions to it, and targets and attained values of conditions and boundaries."""
    drawn, conditions = _drawn_configurations(result), shown(result.conditions)
    count, below = len(drawn), 0.16 * (len(conditions) + 3) if conditions else 0.0
    heights = [2.8 * count, 4.2 * count, 2.9, *([below] if conditions else [])]
    figure = style.new_figure(10.0, 0.3 + sum(heights))
    name = style.fill(result.lens.name, figure.get_figwidth(), 12, bold=True) or "Lens"
    figure.suptitle(name, fontsize=12, fontweight="bold")
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights, hspace=0.02)
    top, middle, bottom, *last = parts
    for row, (label, before, after) in zip(top.subplots(count, 2, squeeze=False), drawn, strict=True):
        for axes, lens, when, merit in (
            (row[0], before, "Before", result.merit_before),
            (row[1], after, "After", result.merit_after),
        ):
            _draw_lens(
                axes, lens, f"{when}, {label}" if label else f"{when}: {result.measure} {style.number_text(merit)}"
            )
        on_one_scale(row)
    _draw_spots(middle, drawn)
    left, right = bottom.subplots(1, 2, width_ratios=(1.0, 1.0))
    _draw_history(left, result)
    if result.loss is None:
        _draw_contributions(right, result)
    else:
        _draw_way(right, result.loss)
    if conditions:
        _draw_conditions(last[0].add_subplot(), result)
    return figure


def _drawn_configurations(result: Optimized) -> list[tuple[str, Lens, Lens]]:
    """The configurations that are drawn, spread over all: label, before and after; one alone has no label."""
    pairs = [*zip(result.before.configurations, result.lens.configurations, strict=True)]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_CONFIGURATIONS)).round().astype(int))
    several = len(pairs) > 1
    return [
        (f"configuration {k + 1} of {len(pairs)}" if several else "", *(detached(lens) for lens in pairs[k]))
        for k in chosen.tolist()
    ]


def _draw_conditions(axes: "Axes", result: Optimized) -> None:
    """The table of targets and values reached; those not met are red."""
    lines, rows = table_of(result.conditions), shown(result.conditions)
    axes.axis("off")
    axes.set_title("Asked and reached", fontweight="bold", loc="left")
    for k, line in enumerate(lines):
        missed = 0 < k <= len(rows) and not rows[k - 1].met
        axes.annotate(
            line, (0.0, 1.0), (0, -11 * k - 4), xycoords="axes fraction", textcoords="offset points", va="top",
            fontsize=7.5, family="monospace", color="#b00020" if missed else style.INK,
        )  # fmt: skip


def _draw_lens(axes: "Axes", lens: Lens, title: str) -> None:
    draw_layout(axes, lens, fields=drawn_fields(lens), rays=5)
    axes.set_title(f"{title}\n", fontweight="bold", pad=4)
    axes.annotate(
        first_order_text(lens), (0.5, 1.0), (0, 5), xycoords="axes fraction",
        textcoords="offset points", ha="center", fontsize=7.5, color=style.GREY,
    )  # fmt: skip


def drawn_fields(lens: Lens) -> Tensor:
    """The fields that are drawn (2, F): all, or as many as stay legible, spread over all."""
    points = torch.stack([lens.fields.x, lens.fields.y])
    count = points.shape[1]
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_FIELDS)).round().astype(int))
    return points[:, chosen.tolist()]


def _draw_spots(page: Any, drawn: list[tuple[str, Lens, Lens]]) -> None:
    """A row of spots before and one after, of every configuration, on one scale; small ones are enlarged in a corner
    of their panel."""
    panels = page.subplots(2 * len(drawn), max(drawn_fields(after).shape[1] for _, _, after in drawn), squeeze=False)
    first = drawn[0][2]
    wavelengths, airy = first.wavelengths.tolist(), float(airy_radius(first))
    rows = []
    for label, *both in drawn:
        spots = [field_spots(lens, fields=drawn_fields(lens)) for lens in both]
        half = panel_size(np.concatenate([style.array(whole.geometric_radius) for whole, _ in spots]).tolist(), airy)
        rows += [(label, *row, half) for row in zip(both, spots, ("before", "after"), strict=True)]
    for row, (label, lens, (whole, dots), when, half) in zip(panels, rows, strict=True):
        fields = drawn_fields(lens)
        waves, radius = lens.wavelengths.tolist(), float(airy_radius(lens))
        for f, panel in enumerate(row):
            if f >= fields.shape[1]:
                panel.axis("off")
                continue
            draw_spot_to_scale(panel, whole, dots, f, wavelengths=waves, airy=radius, half=half)
            if when == "before":
                colour = style.field_colours(len(row))[f]
                panel.set_title(field_label(lens, fields[:, f].tolist()), color=colour, fontsize=8.5)
        row[0].set_ylabel(f"Spots {when}" + (f"\n{label}" if label else ""), fontweight="bold")
    page.legend(handles=wavelength_handles(wavelengths, airy), loc="outside lower center", ncols=6, handletextpad=0.3)


def _draw_history(axes: "Axes", result: Optimized) -> None:
    if result.fitted is not None:
        return _draw_fit(axes, result, result.fitted)
    of_glasses = [step.reached for step in result.glasses]
    merit = np.concatenate([[result.merit_before], of_glasses, style.array(result.history)[:, 0]])
    axes.plot(np.arange(len(merit)), merit, color=_AFTER, marker="." if len(merit) < 40 else None, markersize=4)
    _scale_merit(axes, merit)
    axes.locator_params(axis="x", integer=True)
    axis = "step of the choice of glasses, then cycle" if of_glasses else "cycle"
    axes.set_xlabel(f"{axis} ({result.evaluations} evaluations, {_time(result)})")
    axes.set_ylabel(result.measure)
    axes.set_title("Merit function" if result.loss is None else "Loss", fontweight="bold")
    axes.annotate(
        STOPPED[result.stopped], (0.98, 0.94), xycoords="axes fraction", ha="right", fontsize=7.5, color=style.GREY
    )
    axes.grid(alpha=0.25)


def _draw_fit(axes: "Axes", result: Optimized, fitted: Fitted) -> None:
    """The merit after each step of a fit of parts or test plates."""
    merit = np.array([step.reached for step in fitted.steps])
    names = [f"{step.surfaces} {step.name}".strip() or "design" for step in fitted.steps]
    axes.plot(np.arange(len(merit)), merit, color=_AFTER, marker=".", markersize=4)
    _scale_merit(axes, merit)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=6.5)
    axes.set_ylabel(result.measure)
    axes.set_title(f"Merit after each step ({_time(result)})", fontweight="bold")
    axes.grid(alpha=0.25)


def _time(result: Optimized) -> str:
    return f"{result.seconds:.2g} s" if result.seconds < 99.5 else f"{result.seconds:.0f} s"


def _scale_merit(axes: "Axes", merit: np.ndarray) -> None:
    """Logarithmic over more than a factor of three, else linear; a small change is drawn about a printed value."""
    least, most = float(np.min(merit)), float(np.max(merit))
    if least > 0 and most > 3 * least:
        axes.set_yscale("log")
    elif most - least <= 1e-9 * most:
        axes.set_ylim(0.9 * least, 1.1 * most or 1.0)
    else:
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 4), useOffset=True)


def _draw_way(axes: "Axes", way: LossReport) -> None:
    """The loss at the start, after pre-optimisation, at the end of each descent, and by denser rays."""
    bars = way.stages()
    places = np.arange(len(bars))
    values = [number for _, number in bars]
    axes.barh(places, values, 0.6, color=[_BEFORE, *[_AFTER] * (len(bars) - 1)])
    axes.set_yticks(places, [name for name, _ in bars])
    axes.invert_yaxis()
    for place, number in zip(places, values, strict=True):
        axes.annotate(
            style.number_text(number), (number, place), (3, 0), textcoords="offset points", va="center", fontsize=7.5
        )
    axes.margins(x=0.15)
    axes.set_xlabel("loss")
    axes.set_title("The way of the loss", fontweight="bold")


def _draw_contributions(axes: "Axes", result: Optimized) -> None:
    """Contributions to the square of the merit before and after."""
    shares: dict[str, np.ndarray] = {}
    for i, name in _groups(result):
        pair = np.array([float(c[i - 1]) for c in (result.contributions_before, result.contributions)])
        shares[name] = shares.get(name, np.zeros(2)) + pair
    names = sorted(shares, key=lambda name: -shares[name][1])[:_MOST_BARS]
    places = np.arange(len(names))
    axes.barh(places - 0.2, [100 * shares[n][0] for n in names], height=0.36, color=_BEFORE, label="before")
    axes.barh(places + 0.2, [100 * shares[n][1] for n in names], height=0.36, color=_AFTER, label="after")
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set_xlabel("part of the square of the merit, %")
    axes.set_title("What is left", fontweight="bold")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)


def _groups(result: Optimized) -> list[tuple[int, str]]:
    """Rows with a weight and the names of their bars: of every row, else of every operand and field, else of every
    operand, the first of these with few names."""
    counts = [i for i in result.rows if result.merit[i - 1].weight != 0]
    rows = {i: result.merit[i - 1] for i in counts}
    field = {
        i: f" field {row.numbers[0]:.3g}, {row.numbers[1]:.3g}" if any(row.numbers) else "" for i, row in rows.items()
    }
    names = (
        {i: f"{row.name} {i}" for i, row in rows.items()},
        {i: row.name + field[i] for i, row in rows.items()},
        {i: row.name for i, row in rows.items()},
    )
    chosen = next((bars for bars in names if len(set(bars.values())) <= _MOST_BARS), names[-1])
    return [*chosen.items()]
