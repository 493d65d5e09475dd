"""Accuracy of the PSFs of the co-design experiment: error over time of few and many rays, and of the models."""

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from raytrace.plot import style
from raytrace.plot.style import LOOKS

#: Kinds of rays by the last words of their sampling: colour, marker and name.
_KINDS = {
    "rings": (2, "s", "Gaussian DRT, quadrature"),
    "random": (3, "o", "Gaussian DRT, random rays"),
    "hexapolar": (4, "D", "Gaussian DRT, hexapolar rays"),
    "map": (0, "^", "DRT, ray map"),
    "splatted": (5, "v", "DRT, random rays splatted"),
    "counted": (7, "x", "DRT, random rays counted"),
}
_FLOOR = 1e-9  # errors below are rounding, and drawn here
_TIMES = (5, 7, 10, 15, 20, 30, 50, 70, 100, 200, 500, 1000, 2000)  # ms that may be marked
_ROUND_TIMES = (5, 10, 20, 50, 100, 200, 500, 1000)  # where they lie close


@style.styled
def accuracy_figure(rows: Sequence[Mapping], gaps: Sequence[Mapping], sensor: float) -> Figure:
    """At one sensor distance (mm), a column for each field: error over time of the kernels and of their derivative, and
    the distance of the models from DRT over object distance. rows, gaps: of the benchmark, as mappings."""
    rows = [row for row in rows if row["sensor"] == sensor]
    fields = list(dict.fromkeys(row["field"] for row in rows))
    figure = style.new_figure(3.1 * len(fields) + 0.4, 7.6)
    axes = figure.subplots(3, len(fields), sharey="row", squeeze=False)
    for column, field in zip(axes.T, fields, strict=True):
        own = [row for row in rows if row["field"] == field]
        for panel, error in zip(column, ("l1_error", "slope_error"), strict=False):
            _errors(panel, own, error)
        _label(column[0], own, "l1_error")
        column[0].set_title("on the axis" if field == 0 else f"{field:g}° off the axis")
        column[1].set_xlabel(f"ms, batch of {_batch(gaps)}, forward + backward")
        _models(column[2], [gap for gap in gaps if (gap["field"], gap["sensor"]) == (field, sensor)])
    for panel, label in zip(
        axes[:, 0],
        ("error of the kernel (rel. L¹)", "error of its derivative\nby the sensor (rel. L¹)", "model to DRT (rel. L¹)"),
        strict=True,
    ):
        panel.set_ylabel(label)
    figure.legend(handles=_legend(rows), loc="outside upper center", ncols=3)
    figure.legend(handles=_model_legend(axes[2][0]), loc="outside lower center", ncols=3, handlelength=3)
    return figure


def _batch(gaps: Sequence[Mapping]) -> int:
    return len({gap["distance"] for gap in gaps})


def _kind(row: Mapping) -> str:
    return next(kind for kind in _KINDS if kind in row["sampling"])


def _errors(panel: Axes, rows: Sequence[Mapping], error: str) -> None:
    """One mark for every entrant, those of a kind joined from few rays to many."""
    rows = [row for row in rows if row[error] is not None]
    for kind, (colour, marker, _) in _KINDS.items():
        own = sorted((row for row in rows if _kind(row) == kind), key=lambda row: row["rays"])
        look = {"color": style.field_colour(colour), "marker": marker, "markersize": 4.5, "linewidth": 0.8}
        panel.plot([row["both_ms"] for row in own], [max(row[error], _FLOOR) for row in own], **look)
    panel.set(xscale="log", yscale="log")
    times = [row["both_ms"] for row in rows]
    panel.set_xlim(min(times) / 1.4, max(times) * 1.5)
    wide = max(times) > 10 * min(times)
    panel.xaxis.set_major_locator(FixedLocator([time for time in _TIMES if not wide or time in _ROUND_TIMES]))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.xaxis.set_minor_locator(NullLocator())
    panel.yaxis.set_major_locator(LogLocator(numticks=8))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.grid(True, which="major", color=style.FAINT, linewidth=0.5)
    panel.set_axisbelow(True)


def _label(panel: Axes, rows: Sequence[Mapping], error: str) -> None:
    """How many rays the marks of the few stand for, those of one height together."""
    for kind, (aside, align) in {"rings": ((6, -2.5), "left"), "map": ((-5, -8), "right")}.items():
        heaps: dict[float, list[Mapping]] = {}
        for row in rows:
            if _kind(row) == kind:
                # Marks that lie in a heap share their words.
                heaps.setdefault(max(row[error], _FLOOR) if kind == "rings" else row["both_ms"] // 50, []).append(row)
        for heap in heaps.values():
            edge = (max if kind == "rings" else min)(heap, key=lambda row: row["both_ms"])
            words, place = ", ".join(str(row["rays"]) for row in heap), (edge["both_ms"], max(edge[error], _FLOOR))
            panel.annotate(words, place, aside, textcoords="offset points", ha=align, fontsize=6.5)


def _models(panel: Axes, gaps: Sequence[Mapping]) -> None:
    for model in dict.fromkeys(gap["model"] for gap in gaps):
        own = [gap for gap in gaps if gap["model"] == model]
        colour, dashes = LOOKS[model]
        places, errors = [gap["distance"] / 1e3 for gap in own], [gap["l1_error"] for gap in own]
        panel.plot(places, errors, color=colour, linestyle=dashes, label=model)
    panel.set(xlabel="object distance (m)", ylim=(0, 2))
    panel.grid(True, axis="y", color=style.FAINT, linewidth=0.5)


def _legend(rows: Sequence[Mapping]) -> list[Line2D]:
    shown = {_kind(row) for row in rows}
    return [
        Line2D([], [], color=style.field_colour(colour), marker=marker, markersize=4.5, linewidth=0.8, label=name)
        for kind, (colour, marker, name) in _KINDS.items()
        if kind in shown
    ]


def _model_legend(panel: Axes) -> list[Line2D]:
    names = {"paraxial": "paraxial", "fourier": "Fourier", "gaussian": "Gaussian DRT"}
    lines = panel.get_lines()
    for line in lines:
        line.set_label(names[line.get_label()])
    return lines
