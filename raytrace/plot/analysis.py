"""Figures of the analyses: fans, wavefronts, MTF, encircled energy, and curves over the field."""

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure

from raytrace.analysis import (
    Distortion,
    EncircledEnergy,
    Fan,
    FieldCurvature,
    LateralColour,
    Mtf,
    RelativeIllumination,
    ThroughFocusMtf,
    WavefrontMap,
    cutoff,
)
from raytrace.plot.panels import (
    DASHES,
    FEW,
    chart,
    drawn_at_least,
    field_axis,
    field_labels,
    field_name,
    legend_below,
    nothing,
    over_field,
    ruled,
    titled,
    wavelength_label,
)
from raytrace.plot.style import (
    FAINT,
    GREY,
    INK,
    array,
    field_colour,
    field_colours,
    new_figure,
    number_text,
    styled,
    wavelength_colours,
)
from raytrace.system.lens import Lens

_SAGITTAL = (0, (4, 2))


@styled
def fan_plot(lens: Lens, found: Fan) -> Figure:
    """A row for each field: the tangential fan on the left, the sagittal one on the right, one scale for all."""
    labels = field_labels(lens, found.fields)
    ray = found.quantity == "ray"
    figure = new_figure(6.6, 1.45 * len(labels) + 1.1)
    axes = figure.subplots(len(labels), 2, sharex=True, sharey=True, squeeze=False)
    pupil, colours = array(found.pupil), wavelength_colours(found.wavelengths.tolist())
    scale = 1e3 if ray else 1.0
    curves = ((found.tangential, found.tangential_valid), (found.sagittal, found.sagittal_valid))
    for column, (values, valid) in enumerate(curves):
        shown = np.where(array(valid).astype(bool), scale * array(values), np.nan)
        for row, label in enumerate(labels):
            panel = ruled(axes[row][column])
            for w, colour in enumerate(colours):
                style = {"color": colour, "linewidth": 1.2, "linestyle": DASHES[w % len(DASHES)]}
                panel.plot(pupil, shown[row, w], label=wavelength_label(found, w), **style)
            panel.axhline(0, color=GREY, linewidth=0.6)
            panel.axvline(0, color=GREY, linewidth=0.6)
            if column == 0:
                panel.set_ylabel(label)
    axes[0][0].set_title("tangential" + (": ε$_y$ over pupil y" if ray else ": over pupil y"))
    axes[0][1].set_title("sagittal" + (": ε$_x$ over pupil x" if ray else ": over pupil x"))
    for panel in axes[-1]:
        panel.set_xlim(-1, 1)
        panel.set_xlabel("pupil coordinate")
    figure.supylabel("transverse aberration (µm)" if ray else "OPD (waves)", fontsize=8.5)
    drawn_at_least(axes.flat, 1e-3 if ray else 1e-4, "y")
    legend_below(figure, axes[0][0], len(colours))
    return titled(figure, lens, "ray fans" if ray else "OPD fans")


@styled
def wavefront_maps(lens: Lens, found: WavefrontMap) -> Figure:
    """A panel for each field (rows) and wavelength (columns), one scale for all, RMS, P-V and Strehl below.

    Maps of a single wavelength follow each other in lines of four. 0 is white, and the scale ends where the maps end.
    """
    labels, count = field_labels(lens, found.fields), len(found.wavelengths)
    flows = count == 1
    shape = (-(-len(labels) // 4), min(len(labels), 4)) if flows else (len(labels), count)
    side = 2.9 if shape == (1, 1) else 1.9
    figure = new_figure(side * shape[1] + 1.3, (side + 0.6) * shape[0] + (0.75 if shape[0] > 1 else 0.95))
    grid = figure.subplots(*shape, squeeze=False)
    axes = grid.reshape(-1, 1) if flows else grid
    opd = np.where(array(found.valid).astype(bool), array(found.opd), np.nan)
    colours, scale = _diverging(opd)
    for row, w in np.ndindex(len(labels), count):
        panel = axes[row][w]
        drawn = panel.imshow(opd[row, w], origin="lower", cmap=colours, norm=scale, extent=(-1, 1, -1, 1))
        panel.set(xticks=[], yticks=[])
        for spine in panel.spines.values():
            spine.set_visible(False)
        rms, valley, strehl = (
            number_text(float(v[row, w]), 3) for v in (found.rms, found.peak_to_valley, found.strehl)
        )
        panel.set_xlabel(f"RMS {rms}, P–V {valley}\nStrehl {strehl}", fontsize=7.5, color=GREY)
        if flows:
            panel.set_title(labels[row], color=INK)
        elif row == 0:
            panel.set_title(wavelength_label(found, w), color=INK)
        if w == 0 and not flows:
            panel.set_ylabel(labels[row])
    for panel in axes.ravel()[len(labels) * count :]:
        panel.axis("off")
    bar = figure.colorbar(drawn, ax=grid, shrink=0.8, aspect=30, pad=0.02)
    bar.set_label("OPD (waves)")
    bar.outline.set_visible(False)
    return titled(figure, lens, f"wavefront, {wavelength_label(found, 0)}" if flows else "wavefront")


def _diverging(values: np.ndarray) -> tuple[Colormap, Normalize]:
    """Blue below 0, white at 0, red above, equally deep on either side; from the least to the largest of the values."""
    low, high = min(float(np.nanmin(values, initial=0.0)), 0.0), max(float(np.nanmax(values, initial=0.0)), 0.0)
    largest = max(-low, high, 1e-4)
    low, high = (low, high) if high - low > 1e-4 else (-largest, largest)
    shades = matplotlib.colormaps["RdBu_r"](0.5 + 0.5 * np.linspace(low, high, 256) / largest)
    return ListedColormap(shades), Normalize(low, high)


@styled
def mtf_curves(lens: Lens, found: Mtf, *, asked: Mtf | None = None) -> Figure:
    """Modulation over spatial frequency: tangential solid, sagittal dashed, the diffraction limit grey.

    asked: frequencies of their own, marked on the curves.
    """
    figure, panel = chart(6.4, 4.0, "spatial frequency (cycles/mm)", "modulation")
    frequency = array(found.frequencies)
    _pairs(panel, lens, found, frequency, array(found.tangential), array(found.sagittal))
    for f, colour in enumerate(field_colours(found.fields.shape[1]) if asked is not None else []):
        for values in (asked.tangential, asked.sagittal):
            _marks(panel, array(asked.frequencies), array(values[f]), colour)
    if found.limit is not None:
        panel.plot(frequency, array(found.limit), color=GREY, linewidth=1.0, linestyle=":", label="diffraction limit")
    panel.set_xlim(0, frequency.max())
    panel.set_ylim(0, 1.0)
    legend_below(figure, panel, 6)
    return titled(figure, lens, f"{found.kind} MTF")


@styled
def mtf_through_focus_curves(lens: Lens, found: ThroughFocusMtf) -> Figure:
    """Modulation at one frequency over the sensor distance."""
    modulation = f"modulation at {number_text(float(found.frequency), 4)} cycles/mm"
    figure, panel = chart(6.4, 4.0, "sensor distance (mm)", modulation)
    distance = array(found.sensor_distances)
    _pairs(panel, lens, found, distance, array(found.tangential).T, array(found.sagittal).T)
    panel.axvline(float(lens.surfaces[-2].thickness), color=GREY, linewidth=0.8)
    panel.set_xlim(distance.min(), distance.max())
    panel.set_ylim(0, 1.0)
    legend_below(figure, panel, 6)
    return titled(figure, lens, f"{found.kind} MTF through focus")


@styled
def encircled_curves(lens: Lens, found: EncircledEnergy, *, asked: EncircledEnergy | None = None) -> Figure:
    """Share of the light over the radius about the centroid. asked: radii of their own, marked on the curves."""
    figure, panel = chart(6.0, 3.8, "radius from the centroid (µm)", "encircled energy")
    radii, labels = 1e3 * array(found.radii), field_labels(lens, found.fields)
    for f, (label, colour) in enumerate(zip(labels, field_colours(len(labels)), strict=True)):
        panel.plot(radii, array(found.share[f]), color=colour, linewidth=1.5, label=label)
        if asked is not None:
            _marks(panel, 1e3 * array(asked.radii), array(asked.share[f]), colour)
    panel.axhline(0.8, color=GREY, linewidth=0.7, linestyle=":")
    panel.set_xlim(0, radii.max())
    panel.set_ylim(0, 1.02)
    legend_below(figure, panel, 6)
    return titled(figure, lens, f"{found.kind} encircled energy")


@styled
def distortion_curves(lens: Lens, found: Distortion) -> Figure:
    """Distortion in percent over the field: against f tan θ, and against f θ where the object is at infinity."""
    curves = [("F-tan θ" if found.f_theta is not None else "Height", found.f_tan)]
    curves += [] if found.f_theta is None else [("F-θ", found.f_theta)]
    figure = new_figure(3.1 * len(curves) + 0.9, 4.2)
    for panel, (name, values) in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves, strict=True):
        over_field(panel, lens, found, 100 * array(values), array(found.valid), dashes=DASHES)
        panel.set_xlabel(f"{name} distortion (%)")
        drawn_at_least([panel], 1e-6, "x")
    legend_below(figure, panel, len(found.wavelengths))
    return titled(figure, lens, "distortion")


@styled
def curvature_curves(lens: Lens, found: FieldCurvature) -> Figure:
    """Foci of close rays over the field: tangential solid, sagittal dashed."""
    figure, panel = chart(4.6, 4.4, "focus from the sensor (mm)", "")
    valid = array(found.valid)
    over_field(panel, lens, found, array(found.tangential), valid, suffix=" T", dashes=("solid",))
    over_field(panel, lens, found, array(found.sagittal), valid, suffix=" S", dashes=(_SAGITTAL,))
    drawn_at_least([panel], 1e-6, "x")
    legend_below(figure, panel, 2 if len(found.wavelengths) < 3 else 3)
    return titled(figure, lens, "field curvature")


@styled
def lateral_curves(lens: Lens, found: LateralColour) -> Figure:
    """Chief rays' heights less the primary wavelength's over the field, beside the Airy radius of that one in grey."""
    figure, panel = chart(4.6, 4.4, "lateral colour (µm)", "")
    if len(found.wavelengths) == 1:
        panel.set_ylabel(field_name(lens))
        nothing(panel, "one wavelength:\nno lateral colour")
        return titled(figure, lens, "lateral colour")
    if (resolved := float(cutoff(lens, lens.wavelengths[lens.primary_wavelength]))) > 0:
        airy = 1.22e3 / resolved
        panel.axvspan(-airy, airy, color=FAINT, alpha=0.35, linewidth=0, label="Airy radius")
    over_field(panel, lens, found, 1e3 * array(found.shift), array(found.valid), dashes=DASHES)
    if not panel.patches:
        drawn_at_least([panel], 1e-3, "x")
    legend_below(figure, panel, 4)
    return titled(figure, lens, "lateral colour")


@styled
def illumination_curve(lens: Lens, found: RelativeIllumination, *, asked: RelativeIllumination | None = None) -> Figure:
    """Relative illumination over the field, beside cos⁴θ where fields are angles; asked: fields marked on the line."""
    figure, panel = chart(5.4, 3.6, field_name(lens), "relative illumination")
    order = np.argsort(field_axis(found), kind="stable")
    field, values = field_axis(found)[order], array(found.illumination)[order]
    look = {"marker": "o", "markersize": 3.5} if len(field) <= FEW else {}
    panel.plot(field, values, color=field_colour(0), linewidth=1.5, clip_on=False, zorder=3, label="this lens", **look)
    if asked is not None:
        _marks(panel, field_axis(asked), array(asked.illumination), field_colour(0))
    if lens.fields.kind == "angle":
        fine = np.linspace(0, field.max(), 100)
        panel.plot(fine, np.cos(np.deg2rad(fine)) ** 4, color=GREY, linewidth=1.0, linestyle=":", label="cos⁴θ")
    panel.set_xlim(0, field.max() or 1.0)
    panel.set_ylim(0, 1.05 * max(1.0, values.max()))
    legend_below(figure, panel, 2)
    return titled(figure, lens, "relative illumination")


def _pairs(panel: Axes, lens: Lens, found, x: np.ndarray, tangential: np.ndarray, sagittal: np.ndarray) -> None:
    """Curves of fields in their colours, tangential solid, sagittal dashed, and what the legend says of both."""
    labels = field_labels(lens, found.fields)
    for f, (label, colour) in enumerate(zip(labels, field_colours(len(labels)), strict=True)):
        panel.plot(x, tangential[f], color=colour, linewidth=1.5, label=label)
        panel.plot(x, sagittal[f], color=colour, linewidth=1.5, linestyle=_SAGITTAL)
    for name, dash in (("tangential", "solid"), ("sagittal", _SAGITTAL)):
        panel.plot([], [], color=INK, linewidth=1.2, linestyle=dash, label=name)


def _marks(panel: Axes, x: np.ndarray, y: np.ndarray, colour) -> None:
    panel.plot(x, y, "o", color=colour, markersize=3.5, clip_on=False, zorder=4)
