"""Optimisation report: one page that shows what an optimisation did."""

import numpy as np
import torch

from raytrace.analysis.layout import draw_layout, on_one_scale
from raytrace.analysis.panels import first_order_text
from raytrace.analysis.spot_diagram import airy_radius, draw_spot_to_scale, field_spots, panel_size, wavelength_handles
from raytrace.maths.numerics import detached
from raytrace.optimization.checkpoint import STOPPED
from raytrace.plotting import style
from raytrace.system.lens import Lens, field_label

_MOST_FIELDS = 5
_MOST_BARS = 10
_MOST_CONFIGURATIONS = 4
_BEFORE, _AFTER = style.FAINT, style.FIELD_COLOURS[0]


@style.styled
def optimize_report(found):
    """One page: the lens and its spots before and after in its configurations, on one scale, the merit by cycle, the
    operands that are left, and what conditions and boundaries asked for and reached."""
    each, conditions = _configurations(found), found.shown_conditions()
    count, below = len(each), 0.16 * (len(conditions) + 3) if conditions else 0.0
    heights = [2.8 * count, 4.2 * count, 2.9, *([below] if conditions else [])]
    figure = style.new_figure(10.0, 0.3 + sum(heights))
    name = style.fill(found.lens.name, figure.get_figwidth(), 12, bold=True) or "Lens"
    figure.suptitle(name, fontsize=12, fontweight="bold")
    top, middle, bottom, *last = figure.subfigures(len(heights), 1, height_ratios=heights, hspace=0.02)
    for row, (label, before, after) in zip(top.subplots(count, 2, squeeze=False), each, strict=True):
        for axes, lens, when, merit in (
            (row[0], before, "Before", found.merit_before),
            (row[1], after, "After", found.merit_after),
        ):
            _draw_lens(axes, lens, f"{when}, {label}" if label else f"{when}: merit {style.number_text(merit)}")
        on_one_scale(row)
    _draw_spots(middle, each)
    left, right = bottom.subplots(1, 2, width_ratios=(1.0, 1.0))
    _draw_history(left, found)
    _draw_left(right, found)
    if conditions:
        _draw_conditions(last[0].add_subplot(), found)
    return figure


def _configurations(found) -> list[tuple[str, Lens, Lens]]:
    """The configurations that are drawn, spread over all: label, before and after; one alone has no label."""
    pairs = [*zip(found.before.configurations, found.lens.configurations, strict=True)]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_CONFIGURATIONS)).round().astype(int))
    several = len(pairs) > 1
    return [
        (f"configuration {k + 1} of {len(pairs)}" if several else "", *(detached(one) for one in pairs[k]))
        for k in chosen.tolist()
    ]


def _draw_conditions(axes, found) -> None:
    """The table of what was asked for and what was reached, what is not met in red."""
    lines, shown = found.conditions_in_words(), found.shown_conditions()
    axes.axis("off")
    axes.set_title("Asked and reached", fontweight="bold", loc="left")
    for k, line in enumerate(lines):
        missed = 0 < k <= len(shown) and not shown[k - 1].met
        axes.annotate(
            line, (0.0, 1.0), (0, -11 * k - 4), xycoords="axes fraction", textcoords="offset points", va="top",
            fontsize=7.5, family="monospace", color="#b00020" if missed else style.INK,
        )  # fmt: skip


def _draw_lens(axes, lens: Lens, title: str) -> None:
    draw_layout(axes, lens, fields=drawn_fields(lens), rays=5)
    axes.set_title(f"{title}\n", fontweight="bold", pad=4)
    axes.annotate(
        first_order_text(lens), (0.5, 1.0), (0, 5), xycoords="axes fraction",
        textcoords="offset points", ha="center", fontsize=7.5, color=style.GREY,
    )  # fmt: skip


def drawn_fields(lens: Lens):
    """The fields that are drawn (2, F): all, or as many as stay legible, spread over all."""
    points = torch.stack([lens.fields.x, lens.fields.y])
    count = points.shape[1]
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_FIELDS)).round().astype(int))
    return points[:, chosen.tolist()]


def _draw_spots(page, each: list[tuple[str, Lens, Lens]]) -> None:
    """A row of spots before and one after, of every configuration, on one scale; small ones are enlarged in a corner
    of their panel."""
    panels = page.subplots(2 * len(each), max(drawn_fields(after).shape[1] for _, _, after in each), squeeze=False)
    first = each[0][2]
    wavelengths, airy = style.array(first.wavelengths), float(airy_radius(first))
    states = []
    for label, *both in each:
        spots = [field_spots(lens, fields=drawn_fields(lens)) for lens in both]
        half = panel_size(np.concatenate([style.array(whole.geometric_radius) for whole, _ in spots]), airy)
        states += [(label, *state, half) for state in zip(both, spots, ("before", "after"), strict=True)]
    for row, (label, lens, (whole, dots), when, half) in zip(panels, states, strict=True):
        fields = drawn_fields(lens)
        look = {"wavelengths": style.array(lens.wavelengths), "airy": float(airy_radius(lens)), "half": half}
        for f, panel in enumerate(row):
            if f >= fields.shape[1]:
                panel.axis("off")
                continue
            draw_spot_to_scale(panel, whole, dots, f, **look)
            if when == "before":
                colour = style.field_colours(len(row))[f]
                panel.set_title(field_label(lens, style.array(fields)[:, f]), color=colour, fontsize=8.5)
        row[0].set_ylabel(f"Spots {when}" + (f"\n{label}" if label else ""), fontweight="bold")
    page.legend(handles=wavelength_handles(wavelengths, airy), loc="outside lower center", ncols=6, handletextpad=0.3)


def _draw_history(axes, found) -> None:
    merit = np.concatenate([[found.merit_before], style.array(found.history)[:, 0]])
    axes.plot(np.arange(len(merit)), merit, color=_AFTER, marker="." if len(merit) < 40 else None, markersize=4)
    _scale_merit(axes, merit)
    axes.locator_params(axis="x", integer=True)
    axes.set_xlabel(f"cycle ({found.evaluations} evaluations, {found.seconds:.2g} s)")
    axes.set_ylabel("merit")
    axes.set_title("Merit function", fontweight="bold")
    axes.annotate(
        STOPPED[found.stopped], (0.98, 0.94), xycoords="axes fraction", ha="right", fontsize=7.5, color=style.GREY
    )
    axes.grid(alpha=0.25)


def _scale_merit(axes, merit: np.ndarray) -> None:
    """Logarithmic over more than a factor of three, else linear; a small change is drawn about a printed value."""
    least, most = float(np.min(merit)), float(np.max(merit))
    if least > 0 and most > 3 * least:
        axes.set_yscale("log")
    elif most - least <= 1e-9 * most:
        axes.set_ylim(0.9 * least, 1.1 * most or 1.0)
    else:
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 4), useOffset=True)


def _draw_left(axes, found) -> None:
    """What the square of the merit is made of now, and was."""
    shares: dict[str, np.ndarray] = {}
    for i, name in _groups(found):
        pair = np.array([float(c[i - 1]) for c in (found.contributions_before, found.contributions)])
        shares[name] = shares.get(name, 0) + pair
    names = sorted(shares, key=lambda name: -shares[name][1])[:_MOST_BARS]
    places = np.arange(len(names))
    axes.barh(places - 0.2, [100 * shares[n][0] for n in names], height=0.36, color=_BEFORE, label="before")
    axes.barh(places + 0.2, [100 * shares[n][1] for n in names], height=0.36, color=_AFTER, label="after")
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set_xlabel("part of the square of the merit, %")
    axes.set_title("What is left", fontweight="bold")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)


def _groups(found) -> list[tuple[int, str]]:
    """Rows with weight and the names of their bars: each its own, or by operand and field, or by operand, if few."""
    counts = [i for i in found.rows if found.merit[i - 1].weight != 0]
    rows = {i: found.merit[i - 1] for i in counts}
    field = {i: "".join(f" {h:.3g}" for h in row.numbers[:2]) if any(row.numbers) else "" for i, row in rows.items()}
    names = (
        {i: f"{row.name} {i}" for i, row in rows.items()},
        {i: row.name + field[i] for i, row in rows.items()},
        {i: row.name for i, row in rows.items()},
    )
    chosen = next((one for one in names if len(set(one.values())) <= _MOST_BARS), names[-1])
    return [*chosen.items()]
