"""What figures of curves share: ruled panels, titles and legends, and the curves of every wavelength or field."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from torch import Tensor

from raytrace.maths.result import masked, object_text
from raytrace.plotting.style import (
    GREY,
    INK,
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

#: Dashes of wavelengths, in order, for colour-blind readers; and of sagittal curves.
DASHES = ("solid", (0, (5, 1.5)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)))
SAGITTAL = (0, (4, 2))

_FEW = 5  # fields that are drawn as points, for a line of one would not be seen


def by_wavelength(panel, found, x: np.ndarray, y: np.ndarray, *, suffix="", dashes=DASHES, **look) -> None:
    """A curve of every wavelength in its colour, x or y (N, W); dashes: one after another; look: of all lines."""
    for w, colour in enumerate(wavelength_colours(found.wavelengths.tolist())):
        places = (values[:, w] if values.ndim == 2 else values for values in (x, y))
        dash = dashes[w % len(dashes)]
        panel.plot(*places, label=wavelength_label(found, w) + suffix, color=colour, linestyle=dash, **look)


def by_field(panel, found, x: np.ndarray, **curves: np.ndarray) -> None:
    """Curves (F, N) of every field in its colour, the first solid, the second dashed; the legend names them if two."""
    drawn = [*zip(curves, ("solid", SAGITTAL), strict=False)]
    for f, (label, colour) in enumerate(zip(field_labels(found), field_colours(found.fields.shape[1]), strict=True)):
        for name, dash in drawn:
            legend = {"label": label} if name == drawn[0][0] else {}
            panel.plot(x, curves[name][f], color=colour, linewidth=1.5, linestyle=dash, **legend)
    for name, dash in drawn if len(drawn) > 1 else ():
        panel.plot([], [], color=INK, linewidth=1.2, linestyle=dash, label=name)


def mark_fields(panel, x: np.ndarray, *curves: np.ndarray) -> None:
    """What was asked for on curves (F, N) of fields."""
    for f, colour in enumerate(field_colours(len(curves[0]))):
        for values in curves:
            marks(panel, x, values[f], colour)


def marks(panel, x: np.ndarray, y: np.ndarray, colour) -> None:
    panel.plot(x, y, "o", color=colour, markersize=3.5, clip_on=False, zorder=4)


def over_field(panel, found, values: Tensor, **options) -> None:
    """Curves (F, W) drawn upwards over the field, as lens designers do; options: as for `by_wavelength`."""
    ruled(panel)
    order = np.argsort(field_axis(found), kind="stable")
    field = field_axis(found)[order]
    by_wavelength(panel, found, seen(values, found.valid)[order], field, linewidth=1.4, **few(field), **options)
    panel.axvline(0, color=GREY, linewidth=0.6)
    panel.set_ylim(0, field.max() or 1.0)
    panel.set_ylabel(field_name(found.lens))


def few(field: np.ndarray) -> dict:
    """How lines are marked that have few points."""
    return {"marker": "o", "markersize": 3.5} if len(field) <= _FEW else {}


def seen(values: Tensor, valid: Tensor) -> np.ndarray:
    """Numbers for drawing, nan where invalid."""
    return array(masked(values, valid))


def drawn_at_least(axes: Iterable, floor: float, along: str) -> None:
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


def field_axis(found) -> np.ndarray:
    return np.hypot(*array(found.fields))


def field_name(lens: Lens) -> str:
    return f"{field_title(lens)} ({'°' if lens.fields.kind == 'angle' else 'mm'})"


def field_labels(found) -> Sequence[str]:
    return [field_label(found.lens, field) for field in array(found.fields).T]


def wavelength_label(found, w: int) -> str:
    return f"{number_text(1e3 * float(found.wavelengths[w]), 4)} nm"


def first_order_text(lens: Lens) -> str:
    """`EFL 99.51 mm · F/2.99 · object at 25.00 m`, as a subtitle."""
    data, distance, parts = first_order(lens), float(lens.surfaces[0].thickness), []
    if math.isfinite(focal_length := float(data.effective_focal_length)):
        parts += [f"EFL {length_text(focal_length)}", f"F/{number_text(float(data.f_number), 3)}"]
    parts.append(f"object at {object_text(distance)}")
    if math.isfinite(distance) and math.isfinite(working := float(data.paraxial_working_f_number)):
        parts.append(f"working F/{number_text(working, 3)}")
    return "  ·  ".join(parts)


def chart(width: float, height: float, x: str, y: str):
    """A figure of one ruled panel, its axes named."""
    figure = new_figure(width, height)
    panel = ruled(figure.add_subplot())
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    return figure, panel


def ruled(panel):
    panel.grid(color="#ececec", linewidth=0.6, zorder=0)
    panel.set_axisbelow(True)
    return panel


def finished(panel, found, what: str, columns: int = 0):
    """The figure of a panel with its title, and a legend of so many columns below it."""
    figure, name = panel.figure, found.lens.name
    if columns:
        figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    words = f"{name}\n{what}" if name else what.capitalize()
    figure.suptitle(fill(words, figure.get_figwidth(), 10, bold=True), fontweight="bold", fontsize=10)
    return figure
