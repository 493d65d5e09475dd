"""Figures of the benchmarks: on logarithmic axes a line for each tracer or model, a panel for each task or case."""

from collections.abc import Callable, Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

from raytrace.plotting import style

#: By name: number of the colour (None: grey), dashes, marker.
_TRACERS = {
    "raytrace, eager": (0, (0, (4, 2)), "o"),
    "raytrace": (0, "-", "o"),
    "safe limit": (None, "-", "s"),
    "plain limit": (None, (0, (2, 2)), "s"),
    "Optiland, torch": (2, "-", "^"),
    "Optiland, numpy": (2, (0, (4, 2)), "v"),
    "ray-optics": (4, "-", "D"),
}
#: Number of the colour, dashes, marker and order in the legend, by model of a PSF.
_MODELS = {
    "random rays": (7, "-", "o"),
    "Sobol rays": (5, "-", "o"),
    "drt": (0, "-", "o"),
    "gaussian": (1, "-", "s"),
    "fourier": (4, "-", "D"),
    "wave": (2, "-", "^"),
    "direct sum, rings": (6, "-", "v"),
    "direct sum, grid": (6, "-", "P"),
    "Optiland histogram": (3, "-", "o"),
    "Optiland FFT": (3, "-", "D"),
    "Optiland Huygens": (3, "-", "v"),
}
_TASKS = {"forward": "Forward", "forward+backward": "Forward and backward"}
_LEAST = 1e-9  # errors below are rounding


@style.styled
def trace_figure(rows: Sequence[Mapping]) -> Figure:
    """Rows of `bench_trace.py` as mappings: speed over the number of rays, a panel for each task.

    Only rows with the optical path are drawn: all tracers compute it, so that they are seen at the same task.
    """
    rows = [row for row in rows if row["path"]]
    colours = {tracer: (0, 2, 4)[k % 3] for k, tracer in enumerate(dict.fromkeys(row["tracer"] for row in rows))}

    def look_of(tracer: str, dtype: str) -> dict:
        return look(colours[tracer], "--" if dtype == "float32" else "-", "o", hollow=dtype == "float32")

    return _speeds(rows, "what", _TASKS, ("tracer", "dtype"), look_of)


@style.styled
def speed_figure(rows: Sequence[Mapping]) -> Figure:
    """Rows of `bench_speed.py` as mappings; those forward count, a panel for each dtype."""
    rows = [row for row in rows if row["what"] == "forward"]
    dtypes = {row["dtype"]: row["dtype"] for row in rows}

    def look_of(tracer: str) -> dict:
        colour, dashes, marker = _TRACERS.get(tracer, (6, "-", "*"))
        return look(colour, dashes, marker, hollow=dashes != "-")

    return _speeds(rows, "dtype", dtypes, ("tracer",), look_of)


def _speeds(rows: Sequence[Mapping], by: str, titles: Mapping[str, str], names: Sequence, look_of: Callable) -> Figure:
    """Speed over the number of rays: a panel for each value of a column, a line for each value of other columns."""
    figure = style.new_figure(3.7 * len(titles), 3.7)
    panels = figure.subplots(1, len(titles), sharex=True, sharey=True, squeeze=False)[0]
    labelled = {}
    for panel, (value, title) in zip(panels, titles.items(), strict=True):
        lines: dict[tuple, list] = {}
        for row in rows:
            if row[by] == value:
                lines.setdefault(tuple(row[name] for name in names), []).append((row["rays"], row["speed"]))
        for line, points in lines.items():
            columns, label = zip(*sorted(points), strict=True), ", ".join(line)
            labelled[label] = panel.plot(*columns, label=label, **look_of(*line))[0]
        framed(panel, title, "rays")
    low, high = min(row["speed"] for row in rows) / 1.4, max(row["speed"] for row in rows) * 1.4
    decades = [10.0**e for e in range(2, 12)]
    ticks = [tick for tick in decades if low <= tick <= high]
    if len(ticks) < 3:
        ticks = [m * tick for tick in decades for m in (1, 2, 5) if low <= m * tick <= high]
    panels[0].set(ylim=(low, high), ylabel="rays × surfaces per second, millions")
    panels[0].yaxis.set_major_locator(FixedLocator(ticks))
    panels[0].yaxis.set_minor_locator(NullLocator())
    panels[0].yaxis.set_major_formatter(FuncFormatter(lambda speed, _: f"{speed / 1e6:g}"))
    figure.legend(labelled.values(), labelled.keys(), loc="outside lower center", ncols=5 - len(names))
    return figure


@style.styled
def psf_figure(rows: Sequence[Mapping], titles: Mapping[tuple[str, float], str]) -> Figure:
    """Rows of `bench_psf.py` as mappings: time over error, a panel for each case, samplings from coarse to fine.

    titles: of the panels, by lens and field. Drawn are float64 rows of a fixed sampling: float32 and rows of a
    tolerance repeat them.
    """
    rows = [row for row in rows if row["dtype"] == "float64" and row["estimate"] is None]
    rows = [row for row in rows if row["l1_error"] and row["l1_error"] > _LEAST]
    columns = 2 if len(titles) > 1 else 1
    lines = -(-len(titles) // columns)
    figure = style.new_figure(3.9 * columns, 3.1 * lines + 0.7)
    panels = list(figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).flat)
    for number, (panel, (case, title)) in enumerate(zip(panels, titles.items(), strict=False)):
        for model, of_model in _MODELS.items():
            chosen = [row for row in rows if (row["lens"], row["field"], row["model"]) == (*case, model)]
            _samplings(panel, chosen, look(*of_model, hollow=False))
        framed(panel, title, "relative L1 error of the kernel" if number + columns >= len(titles) else "")
        panel.set_ylabel("time of one kernel, s" if number % columns == 0 else "")
        for axis in (panel.xaxis, panel.yaxis):
            axis.set_major_locator(LogLocator(numticks=12))
            axis.set_minor_locator(NullLocator())
        panel.tick_params(labelbottom=True, labelleft=True)
    for panel in panels[len(titles) :]:
        panel.remove()
    shown = {row["model"] for row in rows}
    handles = [_key(model, **look(*of_model, hollow=False)) for model, of_model in _MODELS.items() if model in shown]
    handles.append(_key("extrapolated", marker="x", color=style.INK, linestyle="none"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2 * columns)
    return figure


def _samplings(panel: Axes, rows: Sequence[Mapping], look: dict) -> None:
    """The samplings of one model, joined in the order of their rays, extrapolated ones dotted."""
    chosen = sorted(rows, key=lambda row: row["rays"])
    run = [(row["l1_error"], row["forward_s"]) for row in chosen if not row["extrapolated"]]
    far = [(row["l1_error"], row["forward_s"]) for row in chosen if row["extrapolated"]]
    if run:
        panel.plot(*zip(*run, strict=True), **look)
    if far:
        panel.plot(*zip(*run[-1:], *far, strict=True), ":", color=look["color"], linewidth=1.0)
        panel.plot(*zip(*far, strict=True), "x", color=look["color"], markersize=5)


def look(colour: int | None, line, marker: str, *, hollow: bool) -> dict:
    return {
        "color": style.GREY if colour is None else style.field_colour(colour),
        "linestyle": line,
        "marker": marker,
        "markersize": 8 if marker == "*" else 4,
        "markerfacecolor": "white" if hollow else None,
        "linewidth": 1.1,
    }


def dtype_keys() -> list[Line2D]:
    """Legend of the marks by dtype."""
    marks = {"marker": "o", "color": style.INK, "linestyle": "none"}
    return [_key("float64", **marks), _key("float32", markerfacecolor="white", **marks)]


def _key(label: str, **look) -> Line2D:
    return Line2D([], [], label=label, **{"markersize": 4} | look)


def framed(panel: Axes, title: str, abscissa: str) -> None:
    panel.set(xscale="log", yscale="log", title=title, xlabel=abscissa)
    panel.grid(True, which="major", color=style.FAINT, linewidth=0.5)
    panel.set_axisbelow(True)
