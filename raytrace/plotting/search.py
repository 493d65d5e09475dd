"""Search: the minima that were found, side by side."""

from os import PathLike

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from raytrace.optimization.search import Searched
from raytrace.plotting import style
from raytrace.plotting.layout import draw_layout, on_one_scale
from raytrace.plotting.optimize import drawn_fields
from raytrace.system.lens import Lens

_MOST, _COLUMNS = 9, 3


@style.styled
def best(found: Searched) -> Figure:
    """The best lenses on one scale, each with its merit, its spots and how often it was found."""
    count = min(_MOST, len(found.lenses))
    columns = min(_COLUMNS, count)
    rows = -(-count // columns)
    figure = style.new_figure(3.6 * max(columns, 2), 2.5 * rows + 0.5)
    figure.suptitle(
        style.fill(found.before.name or "Lens", figure.get_figwidth(), 11, bold=True), fontsize=11, fontweight="bold"
    )
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for k, axes in enumerate(panels):
        if k < count:
            _draw(axes, found, k)
        else:
            axes.set_axis_off()
    on_one_scale(panels[:count])
    return figure


def _draw(axes: Axes, found: Searched, k: int) -> None:
    _draw_lens(axes, found.lenses[k])
    spots = ", ".join(f"{1e3 * float(one):.1f}" for one in found.spots[k])
    times = int(found.found[k])
    axes.set_title(
        f"{k + 1}: merit {style.number_text(float(found.merit[k]))}\n"
        f"RMS spots {spots} µm; found by {times} of {found.descents} descents", fontsize=8,
    )  # fmt: skip


def _draw_lens(axes: Axes, lens: Lens) -> None:
    lens = style.detached(lens)
    draw_layout(axes, lens, fields=drawn_fields(lens), rays=3)


@style.styled
def thumbnail(lens: Lens, path: str | PathLike) -> None:
    """Write the cross section alone, small."""
    figure = style.new_figure(3.0, 1.8)
    _draw_lens(figure.add_subplot(), lens)
    style.save(figure, path, dpi=80)
