"""Time over error of PSFs: one panel a case, one line a model, its samplings from coarse to fine."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from raytrace.plot import style

#: Number of the colour, marker and order in the legend, by model.
_MODELS = {
    "random rays": (7, "o"),
    "Sobol rays": (5, "o"),
    "drt": (0, "o"),
    "gaussian": (1, "s"),
    "fourier": (4, "D"),
    "wave": (2, "^"),
    "direct sum, rings": (6, "v"),
    "direct sum, grid": (6, "P"),
    "Optiland histogram": (3, "o"),
    "Optiland FFT": (3, "D"),
    "Optiland Huygens": (3, "v"),
}
_LEAST = 1e-9  # errors below are rounding


@style.styled
def pareto_figure(rows: Sequence[Mapping], titles: Mapping[tuple[str, float], str]) -> Figure:
    """Rows of the PSF benchmark as mappings: lens, field, model, sampling, dtype, forward_s, l1_error, extrapolated.

    titles: of the panels, by lens and field. Rows driven by a
    tolerance are left out: they hold the same kernels.
    """
    rows = [row for row in rows if row["l1_error"] and row["l1_error"] > _LEAST and row["estimate"] is None]
    columns = 2 if len(titles) > 1 else 1
    lines = -(-len(titles) // columns)
    figure = style.new_figure(3.9 * columns, 3.1 * lines + 0.7)
    axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).flat
    for ax, (case, title) in zip(axes, titles.items(), strict=False):
        own = [row for row in rows if (row["lens"], row["field"]) == case]
        for model, (colour, marker) in _MODELS.items():
            _draw(ax, [row for row in own if row["model"] == model], style.field_colour(colour), marker)
        ax.set(xscale="log", yscale="log", title=title)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(LogLocator(numticks=12))
            axis.set_minor_locator(NullLocator())
        ax.grid(True, which="major", color=style.FAINT, linewidth=0.5)
        ax.set_axisbelow(True)
        ax.tick_params(labelbottom=True, labelleft=True)
    for ax in list(axes)[len(titles) :]:
        ax.remove()
    for number, ax in enumerate(figure.axes):
        ax.set_xlabel("relative L1 error of the kernel" if number + columns >= len(titles) else "")
        ax.set_ylabel("time of one kernel, s" if number % columns == 0 else "")
    figure.legend(handles=_legend(rows), loc="outside lower center", ncols=2 * columns)
    return figure


def _legend(rows: Sequence[Mapping]) -> list[Line2D]:
    """What stands for a model, and what for a dtype."""
    shown = {row["model"] for row in rows}
    handles = [
        Line2D([], [], marker=marker, color=style.field_colour(colour), markersize=4, linewidth=1.0, label=model)
        for model, (colour, marker) in _MODELS.items()
        if model in shown
    ]
    for marker, face, words in (("o", style.INK, "float64"), ("o", "white", "float32"), ("x", "none", "extrapolated")):
        look = {"color": style.INK, "markerfacecolor": face, "markersize": 4, "linestyle": "none"}
        handles.append(Line2D([], [], marker=marker, label=words, **look))
    return handles


def _draw(ax, rows: Sequence[Mapping], colour: str, marker: str) -> None:
    """The samplings of one model: float64 joined in the order of their rays, what was extrapolated by dots."""
    look = {"marker": marker, "color": colour, "markersize": 4, "markeredgewidth": 0.9}
    for dtype in ("float64", "float32"):
        own = sorted((row for row in rows if row["dtype"] == dtype), key=lambda row: row["rays"])
        run = [(row["l1_error"], row["forward_s"]) for row in own if not row["extrapolated"]]
        far = [(row["l1_error"], row["forward_s"]) for row in own if row["extrapolated"]]
        if run and dtype == "float64":
            ax.plot(*zip(*run, strict=True), linewidth=1.0, **look)
        elif run:
            ax.plot(*zip(*run, strict=True), linestyle="none", markerfacecolor="white", alpha=0.8, **look)
        if far:
            ax.plot(*zip(*run[-1:], *far, strict=True), ":", color=colour, linewidth=1.0)
            ax.plot(*zip(*far, strict=True), "x", color=colour, markersize=5)
