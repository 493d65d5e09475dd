"""Speed of tracers over the number of rays: forward beside forward and backward, a line for each tracer and dtype."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from raytrace.plot import style

_PANELS = {"forward": "Forward", "forward+backward": "Forward and backward"}
_LINES = {"float64": "-", "float32": "--"}


@style.styled
def bench_figure(rows: Sequence[Mapping]) -> Figure:
    """Rows of the benchmark as mappings: tracer, dtype, what, path, rays, speed (rays × surfaces / s).

    Only rows with the optical path are drawn: all tracers compute it, so that they are seen at the same task.
    """
    rows = [row for row in rows if row["path"]]
    tracers = list(dict.fromkeys(row["tracer"] for row in rows))
    figure = style.new_figure(7.2, 3.6)
    axes = figure.subplots(1, len(_PANELS), sharey=True)
    for ax, (what, title) in zip(axes, _PANELS.items(), strict=True):
        shown = [row for row in rows if row["what"] == what]
        for number, tracer in enumerate(tracers):
            for dtype, line in _LINES.items():
                points = sorted((r["rays"], r["speed"]) for r in shown if (r["tracer"], r["dtype"]) == (tracer, dtype))
                if points:
                    ax.plot(
                        *zip(*points, strict=True),
                        line,
                        color=style.field_colour((0, 2, 4)[number % 3]),
                        marker="o",
                        markersize=3.5,
                        markerfacecolor="white" if dtype == "float32" else None,
                        linewidth=1.2,
                        label=f"{tracer}, {dtype}",
                    )
        ax.set(xscale="log", yscale="log", title=title, xlabel="rays")
        ax.grid(True, which="major", color=style.FAINT, linewidth=0.5)
        ax.set_axisbelow(True)
    speeds = [row["speed"] for row in rows]
    ticks = [m * 10.0**e for e in range(2, 12) for m in (1, 2, 5)]
    inside = [tick for tick in ticks if min(speeds) / 1.3 <= tick <= max(speeds) * 1.3]
    for ax in axes:
        ax.yaxis.set_major_locator(FixedLocator(inside))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda speed, _: f"{speed / 1e6:g}"))
        ax.set_ylim(min(speeds) / 1.3, max(speeds) * 1.3)
    axes[0].set_ylabel("rays × surfaces per second, millions")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure
