"""Panels of figures of curves: rulers, titles and legends, and the curves of every wavelength or field."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, cast

import numpy as np
from torch import Tensor

from raytrace.analysis.result import Analysis
from raytrace.maths.result import masked, object_text
from raytrace.plotting.style import (
    GREY,
    INK,
    Axes,
    Figure,
    array,
    field_colours,
    fill,
    length_text,
    new_figure,
    number_text,
    wavelength_colours,
)
from raytrace.system.lens import Lens, field_label, field_title
from raytrace.tracing.paraxial import first_order

#: The pattern of a line, as matplotlib takes it.
Dash = str | tuple[int, tuple[float, ...]]

#: Dashes of wavelengths, in order, for colour-blind readers; and of sagittal curves.
DASHES: tuple[Dash, ...] = ("solid", (0, (5, 1.5)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)))
SAGITTAL: Dash = (0, (4, 2))

_FEW = 5  # fields that are drawn as points, for a line of one would not be seen


def by_wavelength(
    panel: Axes,
    curves: Analysis,
    x: np.ndarray,
    y: np.ndarray,
    *,
    suffix: str = "",
    dashes: Sequence[Dash] = DASHES,
    **look: Any,
) -> None:
    """A curve of every wavelength in its colour, x or y (N, W); dashes: one after another; look: of all lines."""
    for w, colour in enumerate(wavelength_colours(curves.wavelengths.tolist())):
        places = (values[:, w] if values.ndim == 2 else values for values in (x, y))
        dash = dashes[w % len(dashes)]
        panel.plot(*places, label=wavelength_label(curves, w) + suffix, color=colour, linestyle=dash, **look)


def by_field(panel: Axes, result: Analysis, x: np.ndarray, **curves: np.ndarray) -> None:
    """Curves (F, N) of every field in its colour, the first solid, the second dashed; the legend has both names."""
    drawn = [*zip(curves, ("solid", SAGITTAL), strict=False)]
    colours = field_colours(result.fields.shape[1])
    for f, (label, colour) in enumerate(zip(field_labels(result), colours, strict=True)):
        for name, dash in drawn:
            legend = label if name == drawn[0][0] else None
            panel.plot(x, curves[name][f], color=colour, linewidth=1.5, linestyle=dash, label=legend)
    for name, dash in drawn if len(drawn) > 1 else ():
        panel.plot([], [], color=INK, linewidth=1.2, linestyle=dash, label=name)


def mark_fields(panel: Axes, x: np.ndarray, *curves: np.ndarray) -> None:
    """The points that were requested, on curves (F, N) of fields."""
    for f, colour in enumerate(field_colours(len(curves[0]))):
        for values in curves:
            marks(panel, x, values[f], colour)


def marks(panel: Axes, x: np.ndarray, y: np.ndarray, colour: str) -> None:
    panel.plot(x, y, "o", color=colour, markersize=3.5, clip_on=False, zorder=4)


def over_field(panel: Axes, curves: Analysis, values: np.ndarray, **options: Any) -> None:
    """Curves (F, W) with the field upwards, as is usual in lens design; options: as for `by_wavelength`."""
    ruled(panel)
    order = np.argsort(field_axis(curves), kind="stable")
    field = field_axis(curves)[order]
    by_wavelength(panel, curves, values[order], field, linewidth=1.4, **few(field), **options)
    panel.axvline(0, color=GREY, linewidth=0.6)
    panel.set_ylim(0, field.max() or 1.0)
    panel.set_ylabel(field_name(curves.lens))


def few(field: np.ndarray) -> dict[str, Any]:
    """Markers of a line with few points."""
    return {"marker": "o", "markersize": 3.5} if len(field) <= _FEW else {}


def seen(values: Tensor, valid: Tensor) -> np.ndarray:
    """Numbers for drawing, nan where invalid."""
    return array(masked(values, valid))


def drawn_at_least(axes: Iterable[Axes], floor: float, along: str) -> None:
    """Keep axes from magnifying rounding: where no curve exceeds the floor, the axes end there, with a note."""
    panels = list(axes)
    curves = [line for panel in panels for line in panel.lines if not str(line.get_label()).startswith("_")]
    drawn = [getattr(line, f"get_{along}data")() for line in curves]
    if max(np.nanmax(np.abs(np.asarray(values, dtype=float)), initial=0.0) for values in drawn) >= floor:
        return
    for panel in panels:
        getattr(panel, f"set_{along}lim")(-floor, floor)
        panel.text(
            0.5, 0.96, f"below {floor:g} everywhere", transform=panel.transAxes, ha="center", va="top", color=GREY
        )


def field_axis(curves: Analysis) -> np.ndarray:
    return np.hypot(*array(curves.fields))


def field_name(lens: Lens) -> str:
    return f"{field_title(lens)} ({'°' if lens.fields.kind == 'angle' else 'mm'})"


def field_labels(curves: Analysis) -> Sequence[str]:
    return [field_label(curves.lens, field) for field in array(curves.fields).T.tolist()]


def wavelength_label(curves: Analysis, w: int) -> str:
    return f"{number_text(1e3 * float(curves.wavelengths[w]), 4)} nm"


def first_order_text(lens: Lens) -> str:
    """`EFL 99.51 mm · F/2.99 · object at 25.00 m`, as a subtitle."""
    data, distance, parts = first_order(lens), float(lens.surfaces[0].thickness), []
    if math.isfinite(focal_length := float(data.effective_focal_length)):
        parts += [f"EFL {length_text(focal_length)}", f"F/{number_text(float(data.f_number), 3)}"]
    parts.append(f"object at {object_text(distance)}")
    if math.isfinite(distance) and math.isfinite(working := float(data.paraxial_working_f_number)):
        parts.append(f"working F/{number_text(working, 3)}")
    return "  ·  ".join(parts)


def chart(width: float, height: float, x: str, y: str) -> Axes:
    """The one ruled panel of a figure, its axes named."""
    panel = ruled(new_figure(width, height).add_subplot())
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    return panel


def ruled(panel: Axes) -> Axes:
    panel.grid(color="#ececec", linewidth=0.6, zorder=0)
    panel.set_axisbelow(True)
    return panel


def finished(panel: Axes, curves: Analysis, quantity: str, columns: int = 0) -> Figure:
    """The figure of a panel with its title, and a legend of so many columns below it."""
    figure, name = cast(Figure, panel.figure), curves.lens.name
    if columns:
        figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    words = f"{name}\n{quantity}" if name else quantity.capitalize()
    figure.suptitle(fill(words, figure.get_figwidth(), 10, bold=True), fontweight="bold", fontsize=10)
    return figure
