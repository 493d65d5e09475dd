"""Speed over the number of rays: this package, its peers and the limits of the machine on the same axes."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from raytrace.plot import style

#: By the start of an entrant's name: number of its colour (None: grey), dashes, marker.
_LOOKS = {
    "raytrace, eager": (0, (0, (4, 2)), "o"),
    "raytrace": (0, "-", "o"),
    "safe limit": (None, "-", "s"),
    "plain limit": (None, (0, (2, 2)), "s"),
    "Optiland, torch": (2, "-", "^"),
    "Optiland, numpy": (2, (0, (4, 2)), "v"),
    "ray-optics": (4, "-", "D"),
}


@style.styled
def speed_figure(rows: Sequence[Mapping]) -> Figure:
    """Rows of the benchmark as mappings: tracer, dtype, what, rays, speed (rays × surfaces / s); those forward count.

    One panel for each dtype, both axes logarithmic and shared.
    """
    rows = [row for row in rows if row["what"] == "forward"]
    dtypes = list(dict.fromkeys(row["dtype"] for row in rows))
    figure = style.new_figure(3.7 * len(dtypes), 3.9)
    panels = figure.subplots(1, len(dtypes), sharex=True, sharey=True, squeeze=False)[0]
    for panel, dtype in zip(panels, dtypes, strict=True):
        for tracer in dict.fromkeys(row["tracer"] for row in rows):
            points = sorted((r["rays"], r["speed"]) for r in rows if (r["tracer"], r["dtype"]) == (tracer, dtype))
            if points:
                panel.plot(*zip(*points, strict=True), label=tracer, **_look(tracer))
        panel.set(xscale="log", yscale="log", title=dtype, xlabel="rays")
        panel.grid(True, which="major", color=style.FAINT, linewidth=0.5)
        panel.set_axisbelow(True)
    _ticks(panels[0], [row["speed"] for row in rows])
    panels[0].set_ylabel("rays × surfaces per second, millions")
    labelled = {label: line for panel in panels for line, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(labelled.values(), labelled.keys(), loc="outside lower center", ncols=4)
    return figure


def _look(tracer: str) -> dict:
    colour, dashes, marker = _LOOKS.get(tracer, (6, "-", "*"))
    return {
        "color": style.GREY if colour is None else style.field_colour(colour),
        "linestyle": dashes,
        "marker": marker,
        "markersize": 3.5,
        "markerfacecolor": "white" if dashes != "-" else None,
        "linewidth": 1.2,
    }


def _ticks(panel, speeds: Sequence[float]) -> None:
    low, high = min(speeds) / 1.4, max(speeds) * 1.4
    inside = [10.0**e for e in range(2, 12) if low <= 10.0**e <= high]
    if len(inside) < 3:
        inside = [m * 10.0**e for e in range(2, 12) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    panel.yaxis.set_major_locator(FixedLocator(inside))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.yaxis.set_major_formatter(FuncFormatter(lambda speed, _: f"{speed / 1e6:g}"))
    panel.set_ylim(low, high)
