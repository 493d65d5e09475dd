"""Figures of the analyses, each of the result that names it: a function (result, **options) -> Figure."""

import matplotlib
import numpy as np
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

from raytrace.analysis.chief import Distortion, FieldCurvature, LateralColour
from raytrace.analysis.chromatic import ChromaticFocalShift
from raytrace.analysis.encircled import EncircledEnergy
from raytrace.analysis.fans import Fan
from raytrace.analysis.grid import GridDistortion
from raytrace.analysis.illumination import RelativeIllumination
from raytrace.analysis.incidence import Incidence
from raytrace.analysis.longitudinal import LongitudinalAberration
from raytrace.analysis.mtf import Mtf, ThroughFocusMtf, cutoff, transfer
from raytrace.analysis.rms import RmsOverField
from raytrace.analysis.seidel import Seidel
from raytrace.analysis.setting import primary_wavelength
from raytrace.analysis.wavefronts import WavefrontMap
from raytrace.plotting.panels import (
    DASHES,
    SAGITTAL,
    by_field,
    by_wavelength,
    chart,
    drawn_at_least,
    few,
    field_axis,
    field_labels,
    field_name,
    finished,
    mark_fields,
    marks,
    over_field,
    ruled,
    seen,
    wavelength_label,
)
from raytrace.plotting.style import (
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

_SEIDEL = {
    "S1": "spherical", "S2": "coma", "S3": "astigmatism", "S4": "Petzval", "S5": "distortion", "C1": "axial colour",
    "C2": "lateral colour", "W040": "spherical", "W131": "coma", "W222": "astigmatism", "W220P": "Petzval",
    "W311": "distortion", "W020": "axial colour", "W111": "lateral colour",
}  # fmt: skip
_FINE = 241  # places of a smooth curve
_COLOURS = ("C1", "C2", "W020", "W111", "TAXC", "TLAC", "LAXC")


@styled
def fan_plot(found: Fan) -> Figure:
    """A row for each field: the tangential fan on the left, the sagittal one on the right, one scale for all."""
    labels, ray = field_labels(found), found.quantity == "ray"
    figure = new_figure(6.6, 1.45 * len(labels) + 1.1)
    axes = figure.subplots(len(labels), 2, sharex=True, sharey=True, squeeze=False)
    shown = [seen(found.tangential, found.tangential_valid), seen(found.sagittal, found.sagittal_valid)]
    for (row, column), panel in np.ndenumerate(axes):
        values = (1e3 if ray else 1.0) * shown[column][row].T
        by_wavelength(ruled(panel), found, array(found.pupil), values, linewidth=1.2)
        panel.axhline(0, color=GREY, linewidth=0.6)
        panel.axvline(0, color=GREY, linewidth=0.6)
    for panel, label in zip(axes[:, 0], labels, strict=True):
        panel.set_ylabel(label)
    axes[0][0].set_title("tangential" + (": ε$_y$ over pupil y" if ray else ": over pupil y"))
    axes[0][1].set_title("sagittal" + (": ε$_x$ over pupil x" if ray else ": over pupil x"))
    for panel in axes[-1]:
        panel.set_xlim(-1, 1)
        panel.set_xlabel("pupil coordinate")
    figure.supylabel("transverse aberration (µm)" if ray else "OPD (waves)", fontsize=8.5)
    drawn_at_least(axes.flat, 1e-3 if ray else 1e-4, "y")
    return finished(axes[0][0], found, "ray fans" if ray else "OPD fans", len(found.wavelengths))


@styled
def wavefront_maps(found: WavefrontMap) -> Figure:
    """A panel for each field (rows) and wavelength (columns), one scale for all, RMS, P-V and Strehl below.

    Maps of a single wavelength follow each other in lines of four. 0 is white, and the scale ends where the maps end.
    """
    labels, count = field_labels(found), len(found.wavelengths)
    flows = count == 1
    shape = (-(-len(labels) // 4), min(len(labels), 4)) if flows else (len(labels), count)
    side = 2.9 if shape == (1, 1) else 1.9
    figure = new_figure(side * shape[1] + 1.3, (side + 0.6) * shape[0] + (0.75 if shape[0] > 1 else 0.95))
    grid = figure.subplots(*shape, squeeze=False)
    axes = grid.reshape(-1, 1) if flows else grid
    opd = seen(found.opd, found.valid)
    colours, scale = _diverging(opd)
    for row, w in np.ndindex(len(labels), count):
        panel = axes[row][w]
        drawn = panel.imshow(opd[row, w], origin="lower", cmap=colours, norm=scale, extent=(-1, 1, -1, 1))
        panel.set(xticks=[], yticks=[])
        panel.spines[:].set_visible(False)
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
    return finished(grid[0][0], found, f"wavefront, {wavelength_label(found, 0)}" if flows else "wavefront")


def _diverging(values: np.ndarray) -> tuple[Colormap, Normalize]:
    """Blue below 0, white at 0, red above, equally deep on either side; from the least to the largest of the values."""
    low, high = min(float(np.nanmin(values, initial=0.0)), 0.0), max(float(np.nanmax(values, initial=0.0)), 0.0)
    largest = max(-low, high, 1e-4)
    low, high = (low, high) if high - low > 1e-4 else (-largest, largest)
    shades = matplotlib.colormaps["RdBu_r"](0.5 + 0.5 * np.linspace(low, high, 256) / largest)
    return ListedColormap(shades), Normalize(low, high)


@styled
def mtf_curves(found: Mtf, *, asked: Mtf | None = None) -> Figure:
    """Modulation over spatial frequency: tangential solid, sagittal dashed, the diffraction limit grey.

    asked: frequencies of their own, marked on the curves.
    """
    _, panel = chart(6.4, 4.0, "spatial frequency (cycles/mm)", "modulation")
    frequency = array(found.frequencies)
    by_field(panel, found, frequency, tangential=array(found.tangential), sagittal=array(found.sagittal))
    if asked is not None:
        mark_fields(panel, array(asked.frequencies), array(asked.tangential), array(asked.sagittal))
    if found.limit is not None:
        panel.plot(frequency, array(found.limit), color=GREY, linewidth=1.0, linestyle=":", label="diffraction limit")
    panel.set(xlim=(0, frequency.max()), ylim=(0, 1.0))
    return finished(panel, found, f"{transfer(found)} MTF", 6)


@styled
def mtf_through_focus_curves(found: ThroughFocusMtf) -> Figure:
    """Modulation at one frequency over the sensor distance, a smooth curve through the places computed."""
    modulation = f"modulation at {number_text(float(found.frequency), 4)} cycles/mm"
    _, panel = chart(6.4, 4.0, "sensor distance (mm)", modulation)
    distance = array(found.sensor_distances)
    fine = np.linspace(distance.min(), distance.max(), _FINE)
    curves = {"tangential": found.tangential, "sagittal": found.sagittal}
    smooth = {name: CubicSpline(distance, array(curve))(fine).T.clip(0, 1) for name, curve in curves.items()}
    by_field(panel, found, fine, **smooth)
    panel.axvline(float(found.lens.surfaces[-2].thickness), color=GREY, linewidth=0.8)
    panel.set(xlim=(distance.min(), distance.max()), ylim=(0, 1.0))
    return finished(panel, found, f"{transfer(found)} MTF through focus", 6)


@styled
def encircled_curves(found: EncircledEnergy, *, asked: EncircledEnergy | None = None) -> Figure:
    """Share of the light over the radius about the centroid. asked: radii of their own, marked on the curves."""
    _, panel = chart(6.0, 3.8, "radius from the centroid (µm)", "encircled energy")
    radii = 1e3 * array(found.radii)
    by_field(panel, found, radii, share=array(found.share))
    if asked is not None:
        mark_fields(panel, 1e3 * array(asked.radii), array(asked.share))
    panel.axhline(0.8, color=GREY, linewidth=0.7, linestyle=":")
    panel.set(xlim=(0, radii.max()), ylim=(0, 1.02))
    light = "geometric" if found.geometric else "diffraction"
    return finished(panel, found, f"{light} encircled energy", 6)


@styled
def distortion_curves(found: Distortion) -> Figure:
    """Distortion in percent over the field: against f tan θ, and against f θ where the object is at infinity."""
    infinite = found.f_theta is not None
    curves = {"F-tan θ": found.f_tan, "F-θ": found.f_theta} if infinite else {"Height": found.f_tan}
    figure = new_figure(3.1 * len(curves) + 0.9, 4.2)
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for panel, (name, values) in zip(panels, curves.items(), strict=True):
        over_field(panel, found, 100 * values)
        panel.set_xlabel(f"{name} distortion (%)")
        drawn_at_least([panel], 1e-6, "x")
    return finished(panels[-1], found, "distortion", len(found.wavelengths))


@styled
def curvature_curves(found: FieldCurvature) -> Figure:
    """Foci of close rays over the field: tangential solid, sagittal dashed."""
    _, panel = chart(4.6, 4.4, "focus from the sensor (mm)", "")
    over_field(panel, found, found.tangential, suffix=" T", dashes=("solid",))
    over_field(panel, found, found.sagittal, suffix=" S", dashes=(SAGITTAL,))
    drawn_at_least([panel], 1e-6, "x")
    return finished(panel, found, "field curvature", 2 if len(found.wavelengths) < 3 else 3)


@styled
def lateral_curves(found: LateralColour) -> Figure:
    """Chief rays' heights less the primary wavelength's over the field, beside the Airy radius of that one in grey."""
    _, panel = chart(4.6, 4.4, "lateral colour (µm)", "")
    if (resolved := float(cutoff(found.lens, primary_wavelength(found.lens)))) > 0:
        airy = 1.22e3 / resolved
        panel.axvspan(-airy, airy, color=FAINT, alpha=0.35, linewidth=0, label="Airy radius")
    over_field(panel, found, 1e3 * found.shift)
    if not panel.patches:
        drawn_at_least([panel], 1e-3, "x")
    return finished(panel, found, "lateral colour", 4)


@styled
def illumination_curve(found: RelativeIllumination, *, asked: RelativeIllumination | None = None) -> Figure:
    """Relative illumination over the field, beside cos⁴θ where fields are angles; asked: fields marked on the line."""
    _, panel = chart(5.4, 3.6, field_name(found.lens), "relative illumination")
    order = np.argsort(field_axis(found), kind="stable")
    field, values = field_axis(found)[order], array(found.illumination)[order]
    look = {"color": field_colour(0), "linewidth": 1.5, "clip_on": False, "zorder": 3, **few(field)}
    panel.plot(field, values, label="this lens", **look)
    if asked is not None:
        marks(panel, field_axis(asked), array(asked.illumination), field_colour(0))
    if found.lens.fields.kind == "angle":
        fine = np.linspace(0, field.max(), 100)
        panel.plot(fine, np.cos(np.deg2rad(fine)) ** 4, color=GREY, linewidth=1.0, linestyle=":", label="cos⁴θ")
    panel.set(xlim=(0, field.max() or 1.0), ylim=(0, 1.05 * max(1.0, values.max())))
    return finished(panel, found, "relative illumination", 2)


@styled
def seidel_bars(found: Seidel) -> Figure:
    """A row for each aberration, a bar for each surface and one for the sum, of the field farthest from the axis."""
    field = int(field_axis(found).argmax())
    values = {name: row for name, row in zip(found.names, array(found.contributions[:, field]), strict=True)}
    # A lens of one wavelength has no colours to show.
    values = {name: row for name, row in values.items() if len(found.wavelengths) > 1 or name not in _COLOURS}
    surfaces = found.contributions.shape[-1]
    figure = new_figure(max(5.2, 0.24 * surfaces + 2.4), 0.78 * len(values) + 1.1)
    panels = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
    place = [*range(1, surfaces + 1), surfaces + 1.6]
    for panel, (name, row) in zip(panels, values.items(), strict=True):
        panel.grid(axis="y", color="#ececec", linewidth=0.6, zorder=0)
        panel.set_axisbelow(True)
        panel.bar(place, [*row, row.sum()], color=[field_colour(0)] * surfaces + [INK], width=0.7)
        panel.axhline(0, color=GREY, linewidth=0.6)
        panel.axvline(surfaces + 0.8, color=FAINT, linewidth=0.8)
        panel.set_ylabel(f"{name}\n{_SEIDEL.get(name, '')}".strip(), rotation=0, ha="right", va="center")
        panel.locator_params(axis="y", nbins=3)
        panel.tick_params(axis="x", length=0)
        panel.margins(y=0.15)
    shown = range(1, surfaces + 1, 1 if surfaces <= 24 else 2)
    panels[-1].set_xticks([*shown, place[-1]], [*(str(k) for k in shown), "sum"])
    panels[-1].set(xlim=(0.3, surfaces + 2.2), xlabel="surface")
    figure.align_ylabels(panels)
    told = "coefficients" if found.kind in ("coefficients", "waves") else f"{found.kind} aberrations"
    label = field_label(found.lens, array(found.fields)[:, field])
    return finished(panels[0], found, f"Seidel {told} ({found.unit}), field {label}")


@styled
def longitudinal_curves(found: LongitudinalAberration) -> Figure:
    """Crossings with the axis over the height in the pupil, drawn upwards."""
    _, panel = chart(4.2, 4.4, "crossing with the axis, from the sensor (mm)", "height in the pupil")
    by_wavelength(panel, found, seen(found.crossing, found.valid).T, array(found.pupil), linewidth=1.4)
    panel.axvline(0, color=GREY, linewidth=0.6)
    panel.set_ylim(0, 1)
    drawn_at_least([panel], 1e-6, "x")
    return finished(panel, found, "longitudinal aberration", 3)


@styled
def chromatic_curve(found: ChromaticFocalShift) -> Figure:
    """The focus over wavelength, drawn sideways, between the limits of a quarter wave."""
    _, panel = chart(4.2, 4.4, "paraxial focus, from that of the primary wavelength (mm)", "wavelength (µm)")
    places, shift, depth = array(found.wavelength), array(found.shift), float(found.depth_of_focus)
    panel.axvspan(-depth, depth, color=FAINT, alpha=0.45, linewidth=0, label=f"±{1e3 * depth:.3g} µm: λ/4 of wavefront")
    for low, high, a, b in zip(places, places[1:], shift, shift[1:], strict=False):
        panel.plot([a, b], [low, high], color=wavelength_colours([0.5 * (low + high)])[0], linewidth=2.0)
    panel.plot(shift, places, color=INK, linewidth=0.4, zorder=1, label="paraxial focus")
    panel.axvline(0, color=GREY, linewidth=0.6)
    panel.set_ylim(places[0], places[-1])
    drawn_at_least([panel], 1e-6, "x")
    total = number_text(1e3 * float(shift.max() - shift.min()), 3)
    return finished(panel, found, f"chromatic focal shift, {total} µm in all", 1)


@styled
def distorted_grid(found: GridDistortion, *, exaggerate: float = 1.0) -> Figure:
    """The ideal grid in grey, the real one over it, its distortion so many times as large; of the first wavelength."""
    ideal, actual = (array(points[:, 0]) for points in (found.ideal, found.actual))
    actual = np.where(array(found.valid[0]).astype(bool), ideal + exaggerate * (actual - ideal), np.nan)
    figure = new_figure(4.6, 5.0)
    panel = figure.add_subplot(aspect="equal")
    rays = "chief rays" + (f", distortion × {exaggerate:g}" if exaggerate != 1 else "")
    for points, label, colour, width in ((ideal, "ideal", GREY, 0.8), (actual, rays, field_colour(0), 1.2)):
        panel.plot(*points, color=colour, linewidth=width)
        panel.plot(*points.transpose(0, 2, 1), color=colour, linewidth=width)
        panel.plot([], [], color=colour, linewidth=width, label=label)
    panel.set(xlabel="x on the sensor (mm)", ylabel="y on the sensor (mm)")
    largest = number_text(100 * float(found.largest()[0]), 3)
    return finished(panel, found, f"grid distortion, largest {largest} % ({wavelength_label(found, 0)})", 2)


@styled
def incidence_curves(found: Incidence) -> Figure:
    """Angles at the sensor over the image height, of the first wavelength: the chief ray inside its beam."""
    _, panel = chart(5.6, 3.8, "image height (mm)", "angle of incidence on the sensor (°)")
    table = found.summary()
    height = array(table["height"][:, 0])
    order = np.argsort(height)
    height = height[order]
    lower, chief, upper = (array(table[name][:, 0])[order] for name in ("lower", "chief", "upper"))
    panel.fill_between(height, lower, upper, color=field_colour(0), alpha=0.12, linewidth=0, label="beam")
    panel.plot(height, upper, color=field_colour(0), linewidth=1.2, linestyle=DASHES[1], label="upper rim")
    panel.plot(height, chief, color=INK, linewidth=1.5, label="chief ray")
    panel.plot(height, lower, color=field_colour(2), linewidth=1.2, linestyle=DASHES[1], label="lower rim")
    panel.axhline(0, color=GREY, linewidth=0.6)
    if len(height) > 1 and np.isfinite(height).any():
        panel.set_xlim(np.nanmin(height), np.nanmax(height))
    return finished(panel, found, f"angles of incidence ({wavelength_label(found, 0)})", 4)


@styled
def rms_curves(found: RmsOverField) -> Figure:
    """RMS over the field: all wavelengths together dark, each in its colour; of wavefronts Maréchal's limit dotted."""
    waves = found.quantity == "wavefront"
    what = "RMS wavefront error" if waves else "RMS spot radius"
    _, panel = chart(5.6, 3.8, field_name(found.lens), f"{what} ({'waves' if waves else 'µm'})")
    order = np.argsort(field_axis(found))
    field, scale = field_axis(found)[order], 1.0 if waves else 1e3
    by_wavelength(panel, found, field, scale * array(found.rms)[order], linewidth=1.2)
    if len(found.wavelengths) > 1:
        together = scale * array(found.polychromatic)[order]
        panel.plot(field, together, color=INK, linewidth=1.6, label="all, weighted")
    if waves:
        panel.axhline(1 / 14, color=GREY, linewidth=0.8, linestyle=":", label="λ/14")
    panel.set_ylim(bottom=0)
    if field.max() > field.min():
        panel.set_xlim(field.min(), field.max())
    return finished(panel, found, what, 5)
