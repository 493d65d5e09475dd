"""What figures of curves share: ruled panels, titles and legends, curves of each wavelength over the field."""

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from raytrace.plot.style import GREY, array, field_label, field_title, fill, new_figure, number_text, wavelength_colours
from raytrace.system.lens import Lens

#: Dashes of wavelengths, in order, for readers who do not tell their colours apart.
DASHES = ("solid", (0, (5, 1.5)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)))

#: So many fields are drawn as points, for a line of one would not be seen.
FEW = 5


def over_field(panel: Axes, lens: Lens, found, values: np.ndarray, valid: np.ndarray, *, dashes, suffix="") -> None:
    """Curves (F, W) drawn upwards over the field, as lens designers do; dashes: one after another by wavelength."""
    ruled(panel)
    field, shown = field_axis(found), np.where(valid.astype(bool), values, np.nan)
    order = np.argsort(field, kind="stable")
    field, shown = field[order], shown[order]
    for w, colour in enumerate(wavelength_colours(found.wavelengths.tolist())):
        style = {"color": colour, "linewidth": 1.4, "linestyle": dashes[w % len(dashes)]}
        style |= {"marker": "o", "markersize": 3.5} if len(field) <= FEW else {}
        panel.plot(shown[:, w], field, label=wavelength_label(found, w) + suffix, **style)
    panel.axvline(0, color=GREY, linewidth=0.6)
    panel.set_ylim(0, field.max() or 1.0)
    panel.set_ylabel(field_name(lens))


def drawn_at_least(axes: Iterable[Axes], floor: float, along: str) -> None:
    """Keep axes of one scale from magnifying rounding: where no curve passes the floor, they end there and say so."""
    panels = list(axes)
    curves = [line for panel in panels for line in panel.lines if not line.get_label().startswith("_")]  # no rulers
    drawn = [getattr(line, f"get_{along}data")() for line in curves]
    if max(np.nanmax(np.abs(np.asarray(values, dtype=float)), initial=0.0) for values in drawn) >= floor:
        return
    for panel in panels:
        getattr(panel, f"set_{along}lim")(-floor, floor)
        panel.text(
            0.5, 0.96, f"below {floor:g} everywhere", transform=panel.transAxes, ha="center", va="top", color=GREY
        )


def nothing(panel: Axes, words: str) -> None:
    """Say in an empty panel why it is empty, instead of axes that measure nothing."""
    panel.set(xlim=(-1, 1), ylim=(0, 1), xticks=[], yticks=[])
    panel.text(0.5, 0.5, words, transform=panel.transAxes, ha="center", va="center", color=GREY, zorder=5)


def field_axis(found) -> np.ndarray:
    return np.hypot(*array(found.fields))


def field_name(lens: Lens) -> str:
    return f"{field_title(lens)} ({'°' if lens.fields.kind == 'angle' else 'mm'})"


def field_labels(lens: Lens, fields) -> Sequence[str]:
    return [field_label(lens, field) for field in array(fields).T]


def wavelength_label(found, w: int) -> str:
    return f"{number_text(1e3 * float(found.wavelengths[w]), 4)} nm"


def chart(width: float, height: float, x: str, y: str) -> tuple[Figure, Axes]:
    """A figure of one ruled panel, its axes named."""
    figure = new_figure(width, height)
    panel = ruled(figure.add_subplot())
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    return figure, panel


def ruled(panel: Axes) -> Axes:
    panel.grid(color="#ececec", linewidth=0.6, zorder=0)
    panel.set_axisbelow(True)
    return panel


def legend_below(figure: Figure, panel: Axes, columns: int) -> None:
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=max(columns, 1))


def titled(figure: Figure, lens: Lens, what: str) -> Figure:
    words = f"{lens.name}\n{what}" if lens.name else what.capitalize()
    figure.suptitle(fill(words, figure.get_figwidth(), 10, bold=True), fontweight="bold", fontsize=10)
    return figure
