"""Spot diagram: where the rays of each field meet the sensor, beside the Airy disc."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide
from raytrace.maths.pupil import gauss_rings, hexapolar, with_rim
from raytrace.plotting import style
from raytrace.system.lens import Lens
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.spot import Spot, chief_reference, image_rays, spot_of_points
from raytrace.tracing.spot_diagram import Spots

_DOT_RINGS = 12  # 469 dots of a wavelength
_INSET = 0.395  # of a panel's width
_MAGNIFY = 4.0  # a spot smaller than its panel by more than this has an enlargement in it


def airy_radius(lens: Lens) -> Tensor:
    """Radius in mm of the first dark ring, 1.22 λ N: λ the primary wavelength, N the paraxial working F/#."""
    return 1.22e-3 * lens.primary * axial_f_number(lens)


def field_spots(
    lens: Lens,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    wavelength_weights: Tensor | None = None,
    pupil: tuple[Tensor, Tensor] | None = None,
    about: Tensor | None = None,
) -> tuple[Spot, Spot]:
    """Polychromatic spots (F,), and the spots (F, W) of the rays that are drawn as dots.

    The RMS radius is that of the rule `pupil` (points, weights), by default Gaussian quadrature. The dots have no
    weight in it but count for the geometric radius, as do points on the rim of the pupil. They are those of
    `even_hexapolar`: each stands for the same area of the pupil, so that light is where dots are. about: (2, F) mm,
    from where radii count, the centroid by default.
    """
    dtype, device = lens.surfaces[-2].thickness.dtype, lens.wavelengths.device
    points, weights = gauss_rings(dtype=dtype, device=device) if pupil is None else pupil
    points, weights = with_rim(points, weights)
    dots = even_hexapolar(_DOT_RINGS, dtype=dtype, device=device)
    shares = shares_of(lens, wavelengths, wavelength_weights)
    with torch.no_grad():
        rays = image_rays(lens, torch.cat([points, dots], dim=1), fields=fields, wavelengths=wavelengths)
        weights = torch.cat([weights, torch.zeros_like(dots[0])])
        hits, valid = rays.position[:2], rays.valid
        whole = spot_of_points(hits.flatten(2), valid.flatten(1), (shares[:, None] * weights).flatten(), about=about)
        drawn = points.shape[1]
        return whole, spot_of_points(hits[..., drawn:], valid[..., drawn:])


def even_hexapolar(rings: int, **like) -> Tensor:
    """Points (2, 1 + 3·rings·(rings + 1)) of equal areas of the pupil: the centre, and 6, 12, … on circles.

    The first j rings and the centre fill the radius √((1 + 3j(j + 1))/N) of N points in all; each ring halves its area.
    """
    points = hexapolar(rings, **like)[0]
    ring = torch.round(torch.hypot(*points) * rings)
    radius = torch.sqrt((1 + 3 * ring * ring) / points.shape[1])
    return torch.where(ring > 0, points * safe_divide(radius, torch.hypot(*points)), 0.0)


def shares_of(lens: Lens, wavelengths: Tensor | None, weights: Tensor | None) -> Tensor:
    """Weights (W,) of wavelengths: those given, else the lens's for its own wavelengths and equal ones for others."""
    if weights is not None:
        return weights.to(lens.wavelengths)
    return lens.wavelength_weights if wavelengths is None else torch.ones_like(wavelengths)


@style.styled
def spot_diagram(found: Spots):
    """Spot diagram: one panel a field, one colour and marker a wavelength, the Airy disc at the primary wavelength.

    All panels have the same scale, are centred on the centroid over all wavelengths or, as the reference says, on the
    chief ray of the primary one, and print the RMS and the geometric radius about it.
    """
    lens, points, rays = detached(found.lens), found.fields.detach(), found.arrivals
    about = chief_reference(lens, points)[..., 0] if found.reference == "chief" else None
    whole, dots = field_spots(lens, fields=points, pupil=(rays.pupil, rays.weight.detach().sum(0)), about=about)
    whole = whole if about is None else dataclasses.replace(whole, centroid=about)  # what panels are centred on
    fields, wavelengths = style.array(points), style.array(lens.wavelengths)
    airy = float(airy_radius(lens))
    half = panel_size(style.array(whole.geometric_radius), airy)
    columns = min(fields.shape[1], 4 if fields.shape[1] % 3 or fields.shape[1] == 12 else 3)
    rows = math.ceil(fields.shape[1] / columns)
    width = max(2.25 * columns, 5.6)
    figure = style.new_figure(width, ((width / columns if columns > 1 else 3.4) + 0.55) * rows + 1.05)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for f, panel in enumerate(axes):
        if f >= fields.shape[1]:
            panel.axis("off")
            continue
        draw_spot(panel, whole, dots, f, wavelengths=wavelengths, airy=airy, half=half)
        panel.set_title(f"{field_title(lens)} {field_label(lens, fields[:, f])}")
    name = style.fill(lens.name, width, 11, bold=True) or "Lens"
    figure.suptitle(name, fontsize=11, fontweight="bold")
    legend = figure.legend(
        handles=wavelength_handles(wavelengths, airy),
        title=f"{first_order_text(lens, first_order(lens))}\n"
        f"centred on the {'centroid' if about is None else 'chief ray'}; RMS and GEO (largest) radius about it, "
        "all wavelengths together",
        loc="outside lower center", ncols=min(6, int(width / 1.05)), handletextpad=0.3,
        title_fontproperties={"size": 8}, alignment="center",
    )  # fmt: skip
    legend.get_title().set(color=style.GREY, multialignment="center")
    return figure


def panel_size(radii: Sequence[float], airy: float) -> float:
    """Half width in mm that holds spots of these geometric radii and the Airy disc."""
    return 1.14 * max(1e-7, *(radius for radius in (*radii, airy) if math.isfinite(radius)))


def draw_spot(
    axes, whole: Spot, dots: Spot, number: int, *, wavelengths: np.ndarray, airy: float, half: float
) -> None:
    """Draw the spot of one field into square axes of ± half mm about its centroid, with its radii below."""
    draw_dots(axes, whole, dots, number, wavelengths=wavelengths, airy=airy, half=half)
    bar = style.round_length(0.62 * half)
    style.scale_bar(axes, -0.93 * half, -0.93 * half, bar, align="left")
    if bool(whole.rms_radius[number].isnan()):
        axes.text(0, 0, "no ray reaches\nthe image", ha="center", va="center", color=style.GREY)
        axes.set_xlabel(" \n ")
        return
    rms, largest = (1e3 * float(r[number]) for r in (whole.rms_radius, whole.geometric_radius))
    axes.set_xlabel(f"RMS {style.number_text(rms)} µm\nGEO {style.number_text(largest)} µm", labelpad=4)


def draw_spot_to_scale(
    axes, whole: Spot, dots: Spot, number: int, *, wavelengths: np.ndarray, airy: float, half: float
) -> None:
    """As `draw_spot`, on the scale of other panels; a spot much smaller than its panel is enlarged in a corner of it,
    with the factor below."""
    look = {"wavelengths": wavelengths, "airy": airy}
    draw_spot(axes, whole, dots, number, half=half, **look)
    size = panel_size([float(whole.geometric_radius[number])], airy)
    if bool(whole.rms_radius[number].isfinite()) and half > _MAGNIFY * size:
        inset = axes.inset_axes((0.985 - _INSET, 0.985 - _INSET, _INSET, _INSET), zorder=8)
        draw_dots(inset, whole, dots, number, half=size, **look)
        inset.set_facecolor("#fbfbfb")
        inset.set_xlabel(f"{style.number_text(_INSET * half / size, 2)}×", fontsize=7, labelpad=1)


def draw_dots(
    axes, whole: Spot, dots: Spot, number: int, *, wavelengths: np.ndarray, airy: float, half: float
) -> None:
    """The dots and the Airy circle, without words."""
    centre = style.array(whole.centroid[:, number])
    size = 2.0 if half > 4 * airy else 2.4
    for cross in (axes.axhline, axes.axvline):
        cross(0, color=style.FAINT, linewidth=0.5, zorder=1)
    for w, colour in enumerate(style.wavelength_colours(wavelengths)):
        kept = style.array(dots.valid[number, w]).astype(bool)
        x, y = style.array(dots.points[:, number, w])[:, kept] - centre[:, None]
        marker = style.WAVELENGTH_MARKERS[w % len(style.WAVELENGTH_MARKERS)]
        width = 0.0 if marker not in "+x" else 0.5
        axes.plot(x, y, marker, color=colour, markersize=size + 2 * width, markeredgewidth=width, zorder=3 + 0.1 * w)
    if math.isfinite(airy):
        axes.add_patch(Circle((0, 0), airy, fill=False, edgecolor=style.INK, linewidth=0.9, zorder=4, gid="Airy"))
    axes.set_xlim(-half, half)
    axes.set_ylim(-half, half)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(True)


def wavelength_handles(wavelengths: np.ndarray, airy: float) -> list[Line2D]:
    """What the legend says of colours and of the Airy circle."""
    handles = [
        Line2D([], [], linestyle="", marker=style.WAVELENGTH_MARKERS[w % len(style.WAVELENGTH_MARKERS)], color=colour,
               markersize=4.5, label=f"{wavelength:.4g} µm")
        for w, (wavelength, colour) in enumerate(zip(wavelengths, style.wavelength_colours(wavelengths), strict=True))
    ]  # fmt: skip
    if math.isfinite(airy):
        handles.append(
            Line2D([], [], linestyle="", marker="o", markerfacecolor="none", color=style.INK, markersize=6,
                   label=f"Airy radius {style.micrometres(airy)}")
        )  # fmt: skip
    return handles
