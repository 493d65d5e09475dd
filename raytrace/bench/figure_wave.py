"""The benchmark of wave engines as a picture."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from raytrace.plot.style import FAINT, INK, field_colour, new_figure, styled

#: Number of the colour, marker and name, by engine.
_ENGINES = {
    "pupil": (0, "o", "pupil matrix DFT"),
    "radial": (1, "s", "ring integrals"),
    "fresnel": (4, "D", "Fresnel transfer, band limit"),
    "angular_spectrum": (3, "v", "angular spectrum"),
    "sitzmann": (2, "*", "as Sitzmann 2018"),
}


@styled
def bench_figure(rows: Sequence[Mapping]) -> Figure:
    """Time over error of wave engines, forward and with the gradient: rows of the benchmark as mappings.

    Full marks are float64, open ones float32; crosses are refused samplings.
    """
    figure = new_figure(7.6, 3.6)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for panel, key, name in zip(axes, ("forward_s", "both_s"), ("forward", "forward and gradient"), strict=True):
        for engine, (number, marker, label) in _ENGINES.items():
            for dtype in ("float64", "float32"):
                own = [row for row in rows if (row["engine"], row["dtype"]) == (engine, dtype) and not row["refused"]]
                look = {
                    "color": field_colour(number),
                    "marker": marker,
                    "markersize": 9 if marker == "*" else 5,
                    "linewidth": 0.9,
                    "markerfacecolor": field_colour(number) if dtype == "float64" else "white",
                    "linestyle": "-" if dtype == "float64" else ":",
                }
                place = [row["error"] for row in own], [1e3 * row[key] for row in own]
                panel.plot(*place, label=label if dtype == "float64" else None, **look)
        refused = [row for row in rows if row["refused"]]
        place = [row["error"] for row in refused], [1e3 * row[key] for row in refused]
        panel.plot(*place, "x", color=field_colour(7), label="refused by the plan")
        panel.set(xscale="log", yscale="log", title=name, xlabel="relative L² error of the kernel")
        panel.grid(True, color=FAINT, linewidth=0.5)
        panel.set_axisbelow(True)
    axes[0].set_ylabel("time of one kernel, ms")
    handles = [*axes[0].get_legend_handles_labels()[0]]
    for face, words in ((INK, "float64"), ("white", "float32")):
        handles.append(Line2D([], [], marker="o", linestyle="", color=INK, markerfacecolor=face, label=words))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure
