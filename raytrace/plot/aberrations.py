"""Figures of aberrations: Seidel's by surface, longitudinal, grid distortion, incidence, RMS over the field."""

import numpy as np
from matplotlib.figure import Figure

from raytrace.analysis import GridDistortion, Incidence, LongitudinalAberration, RmsOverField, Seidel
from raytrace.plot.panels import (
    DASHES,
    chart,
    drawn_at_least,
    field_axis,
    field_name,
    legend_below,
    titled,
    wavelength_label,
)
from raytrace.plot.style import (
    FAINT,
    GREY,
    INK,
    array,
    field_colour,
    field_label,
    new_figure,
    number_text,
    styled,
    wavelength_colours,
)
from raytrace.system.lens import Lens

_WORDS = {
    "S1": "spherical", "S2": "coma", "S3": "astigmatism", "S4": "Petzval", "S5": "distortion", "C1": "axial colour",
    "C2": "lateral colour", "W040": "spherical", "W131": "coma", "W222": "astigmatism", "W220P": "Petzval",
    "W311": "distortion", "W020": "axial colour", "W111": "lateral colour",
}  # fmt: skip
_COLOURS = ("C1", "C2", "W020", "W111", "TAXC", "TLAC", "LAXC")


@styled
def seidel_bars(lens: Lens, found: Seidel) -> Figure:
    """A row for each aberration, a bar for each surface and one for the sum, of the field farthest from the axis."""
    field = int(np.hypot(*array(found.fields)).argmax())
    values = {name: row for name, row in zip(found.names, array(found.contributions[:, field]), strict=True)}
    # A lens of one wavelength has no colours to show.
    values = {name: row for name, row in values.items() if len(lens.wavelengths) > 1 or name not in _COLOURS}
    surfaces = found.contributions.shape[-1]
    figure = new_figure(max(5.2, 0.24 * surfaces + 2.4), 0.78 * len(values) + 1.1)
    panels = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
    place = [*range(1, surfaces + 1), surfaces + 1.6]
    for panel, (name, row) in zip(panels, values.items(), strict=True):
        panel.grid(axis="y", color="#ececec", linewidth=0.6, zorder=0)
        panel.set_axisbelow(True)
        colours = [field_colour(0)] * surfaces + [INK]
        panel.bar(place, [*row, row.sum()], color=colours, width=0.7)
        panel.axhline(0, color=GREY, linewidth=0.6)
        panel.axvline(surfaces + 0.8, color=FAINT, linewidth=0.8)
        panel.set_ylabel(f"{name}\n{_WORDS.get(name, '')}".strip(), rotation=0, ha="right", va="center")
        panel.locator_params(axis="y", nbins=3)
        panel.tick_params(axis="x", length=0)
        panel.margins(y=0.15)
    every = 1 if surfaces <= 24 else 2
    shown = range(1, surfaces + 1, every)
    panels[-1].set_xticks([*shown, place[-1]], [*(str(k) for k in shown), "sum"])
    panels[-1].set_xlim(0.3, surfaces + 2.2)
    panels[-1].set_xlabel("surface")
    figure.align_ylabels(panels)
    told = {"coefficients": "coefficients", "waves": "coefficients"}.get(found.kind, f"{found.kind} aberrations")
    words = f"Seidel {told} ({found.unit}), field {field_label(lens, array(found.fields)[:, field])}"
    return titled(figure, lens, words)


@styled
def longitudinal_curves(lens: Lens, found: LongitudinalAberration) -> Figure:
    """Crossings with the axis over the height in the pupil, drawn upwards."""
    figure, panel = chart(4.2, 4.4, "crossing with the axis, from the sensor (mm)", "height in the pupil")
    shown = np.where(array(found.valid).astype(bool), array(found.crossing), np.nan)
    for w, colour in enumerate(wavelength_colours(found.wavelengths.tolist())):
        style = {"color": colour, "linewidth": 1.4, "linestyle": DASHES[w % len(DASHES)]}
        panel.plot(shown[w], array(found.pupil), label=wavelength_label(found, w), **style)
    panel.axvline(0, color=GREY, linewidth=0.6)
    panel.set_ylim(0, 1)
    drawn_at_least([panel], 1e-6, "x")
    legend_below(figure, panel, 3)
    return titled(figure, lens, "longitudinal aberration")


@styled
def distorted_grid(lens: Lens, found: GridDistortion, *, exaggerate: float = 1.0) -> Figure:
    """The ideal grid in grey, the real one over it, its distortion so many times as large; of the first wavelength."""
    ideal, actual = (array(points[:, 0]) for points in (found.ideal, found.actual))
    valid = array(found.valid[0]).astype(bool)
    actual = np.where(valid, ideal + exaggerate * (actual - ideal), np.nan)
    figure = new_figure(4.6, 5.0)
    panel = figure.add_subplot(aspect="equal")
    for points, style in (
        (ideal, {"color": GREY, "linewidth": 0.8}),
        (actual, {"color": field_colour(0), "linewidth": 1.2}),
    ):
        panel.plot(points[0], points[1], **style)
        panel.plot(points[0].T, points[1].T, **style)
    panel.plot([], [], color=GREY, linewidth=0.8, label="ideal")
    panel.plot(
        [],
        [],
        color=field_colour(0),
        linewidth=1.2,
        label="chief rays" + (f", distortion × {exaggerate:g}" if exaggerate != 1 else ""),
    )
    panel.set_xlabel("x on the sensor (mm)")
    panel.set_ylabel("y on the sensor (mm)")
    legend_below(figure, panel, 2)
    largest = number_text(100 * float(found.largest()[0]), 3)
    return titled(figure, lens, f"grid distortion, largest {largest} % ({wavelength_label(found, 0)})")


@styled
def incidence_curves(lens: Lens, found: Incidence) -> Figure:
    """Angles at the sensor over the image height, of the first wavelength: the chief ray inside its beam."""
    figure, panel = chart(5.6, 3.8, "image height (mm)", "angle of incidence on the sensor (°)")
    table = {name: array(column.expand_as(found.angle[..., 0, -1]))[:, 0] for name, column in found.on_sensor().items()}
    order = np.argsort(table["height"])
    height, lower, chief, upper = (table[name][order] for name in ("height", "lower", "chief", "upper"))
    panel.fill_between(height, lower, upper, color=field_colour(0), alpha=0.12, linewidth=0, label="beam")
    panel.plot(height, upper, color=field_colour(0), linewidth=1.2, linestyle=DASHES[1], label="upper rim")
    panel.plot(height, chief, color=INK, linewidth=1.5, label="chief ray")
    panel.plot(height, lower, color=field_colour(2), linewidth=1.2, linestyle=DASHES[1], label="lower rim")
    panel.axhline(0, color=GREY, linewidth=0.6)
    if len(height) > 1 and np.isfinite(height).any():
        panel.set_xlim(np.nanmin(height), np.nanmax(height))
    legend_below(figure, panel, 4)
    return titled(figure, lens, f"angles of incidence ({wavelength_label(found, 0)})")


@styled
def rms_curves(lens: Lens, found: RmsOverField) -> Figure:
    """RMS over the field: all wavelengths together dark, each in its colour; of wavefronts Maréchal's limit dotted."""
    waves = found.quantity == "wavefront"
    what = "RMS wavefront error" if waves else "RMS spot radius"
    figure, panel = chart(5.6, 3.8, field_name(lens), f"{what} ({'waves' if waves else 'µm'})")
    scale, field = 1.0 if waves else 1e3, field_axis(found)
    order = np.argsort(field)
    for w, colour in enumerate(wavelength_colours(found.wavelengths.tolist())):
        style = {"color": colour, "linewidth": 1.2, "linestyle": DASHES[w % len(DASHES)]}
        panel.plot(field[order], scale * array(found.rms[:, w])[order], label=wavelength_label(found, w), **style)
    if len(found.wavelengths) > 1:
        panel.plot(
            field[order], scale * array(found.polychromatic)[order], color=INK, linewidth=1.6, label="all, weighted"
        )
    if waves:
        panel.axhline(1 / 14, color=GREY, linewidth=0.8, linestyle=":", label="λ/14")
    panel.set_ylim(bottom=0)
    if field.max() > field.min():
        panel.set_xlim(field.min(), field.max())
    legend_below(figure, panel, 5)
    return titled(figure, lens, what)
