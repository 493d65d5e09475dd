"""Focus report: one page that shows what moving the sensor did."""

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.result import object_text
from raytrace.plotting import style
from raytrace.plotting.curve import FocusRays, draw_curves, focus_rays, focus_span, through_focus_curve
from raytrace.plotting.layout import draw_layout
from raytrace.plotting.spots import airy_radius, draw_spot_to_scale, field_spots, panel_size, wavelength_handles
from raytrace.system.lens import Lens, with_object_distance
from raytrace.system.rays import Rays
from raytrace.tracing.focus import Focus
from raytrace.tracing.paraxial import first_order, paraxial_image_distance

_MOST_SPOTS = 5  # columns of spots that stay legible
_DASHES = {"sensor before": (0, (6, 2.5)), "sensor after": "solid", "paraxial focus": (0, (1, 1.6))}


@style.styled
def focus_report(found: Focus, by: str | None = None):
    """One page: the lens, the RMS spot radius through focus, and the spots before and after on one scale.

    Every object distance and field is a curve and a pair of spots. by: instead the curves alone, as for
    `through_focus_curve`.
    """
    if by is not None:
        return through_focus_curve(found, by)
    lens_before, lens_after = detached(found.before), detached(found.lens)
    lens, fields, wavelengths = lens_before, found.fields.detach(), found.wavelengths.detach()
    distances = found.object_distances.tolist()
    labels = _labels(lens, distances, fields)
    rule = {
        "fields": fields, "wavelengths": wavelengths, "wavelength_weights": found.wavelength_weights,
        "pupil": (found.points, found.weights),
    }  # fmt: skip

    columns = max(len(labels), 1)
    figure = style.new_figure(10.0 if columns > 3 else 9.0, 8.4)
    name = style.fill(lens.name, figure.get_figwidth(), 12, bold=True) or "Lens"
    figure.suptitle(name, fontsize=12, fontweight="bold")
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.0, 1.0), hspace=0.02)
    wide = min(1.0 + 0.32 * (columns - 1), 1.6)
    left, right = bottom.subfigures(1, 2, width_ratios=(1.25, wide), wspace=0.02)

    axes = top.add_subplot()
    drawn = with_object_distance(lens_after, distances[0])
    draw_layout(axes, drawn, fields=fields, wavelengths=wavelengths[:1], rays=11 if fields.shape[1] == 1 else 7)
    top.suptitle(first_order_text(drawn, first_order(drawn)), fontsize=8.5, color=style.GREY)

    _draw_focus(left.add_subplot(), lens_before, lens_after, distances, labels, rule)
    left.legend(
        loc="outside lower center", ncols=1 if columns == 1 else 2, fontsize=7.5, handlelength=1.8, columnspacing=1.2,
        title=None if len(labels) == 1 else "least RMS radius of every curve", title_fontsize=7.5,
    )  # fmt: skip
    _draw_spots(right, lens_before, lens_after, distances, labels, rule)
    return figure


def _labels(lens: Lens, distances: list[float], fields: Tensor) -> list[str]:
    """What tells the curves apart, object distance outermost."""
    points = [field_label(lens, point) for point in style.array(fields).T]
    if len(distances) == 1:
        return points
    objects = [object_text(distance) for distance in distances]
    return [place if len(points) == 1 else f"{place}, {point}" for place in objects for point in points]


def _draw_focus(axes, before: Lens, after: Lens, distances: list[float], labels: list[str], rule: dict) -> None:
    """The curves, and lines for the sensor before and after and for the paraxial focus, all with their numbers."""
    bundles = [focus_rays(with_object_distance(before, distance), **rule) for distance in distances]
    rays = Rays(
        torch.cat([bundle.rays.position for bundle in bundles], dim=1),
        torch.cat([bundle.rays.direction for bundle in bundles], dim=1),
        torch.cat([bundle.rays.valid for bundle in bundles]),
    )
    bundle = FocusRays(rays, bundles[0].weights)
    sensor, moved = (float(lens.surfaces[-2].thickness) for lens in (before, after))
    paraxial = [float(paraxial_image_distance(before, before.wavelengths.new_tensor(d))) for d in distances]
    marks = {"sensor before": sensor, "sensor after": moved}
    if len(set(paraxial)) == 1:
        marks["paraxial focus"] = paraxial[0]
    span = focus_span(with_object_distance(before, distances[0]), bundle, sensor, [moved, *paraxial])
    alone = len(labels) == 1
    draw_curves(axes, bundle, sensor, span, labels=["least RMS"] if alone else labels)
    for name, place in marks.items():
        radius = f", {style.micrometres(float(bundle.radii(np.array([place - sensor]))[0, 0]))}" if alone else ""
        text = f"{name}: {place:.4f} mm{radius}"
        axes.axvline(place, color=style.GREY, linewidth=1.0, linestyle=_DASHES[name], label=text, zorder=2)
    if "paraxial focus" not in marks:
        each, colours = len(labels) // len(distances), style.field_colours(len(labels))
        for number, place in enumerate(paraxial):
            axes.plot(place, 0, "^", color=colours[number * each], markersize=5, clip_on=False, zorder=5,
                      label="paraxial foci" if number == 0 else None)  # fmt: skip
    axes.set_title("RMS spot radius through focus", fontweight="bold", pad=8)


def _draw_spots(page, before: Lens, after: Lens, distances: list[float], labels: list[str], rule: dict) -> None:
    """Spots before and after, the same scale in all panels; one column a curve, or side by side for one curve."""
    panels = []
    for lens in (before, after):
        spots = [field_spots(with_object_distance(lens, distance), **rule) for distance in distances]
        panels.append([(*pair, f) for pair in spots for f in range(pair[0].rays.shape[0])][:_MOST_SPOTS])
    airy = float(airy_radius(with_object_distance(after, distances[0])))
    wavelengths = style.array(rule["wavelengths"])
    half = panel_size([float(spot.geometric_radius[f]) for row in panels for spot, _, f in row], airy)
    count = len(panels[0])
    axes = page.subplots(*((1, 2) if count == 1 else (2, count)), squeeze=False).reshape(2, count)
    for row, when in enumerate(("before", "after")):
        for column, (whole, dots, f) in enumerate(panels[row]):
            panel, look = axes[row, column], {"wavelengths": wavelengths, "airy": airy}
            draw_spot_to_scale(panel, whole, dots, f, half=half, **look)
            if count == 1:
                panel.set_title(f"Spot {when}", fontweight="bold", pad=8)
            else:
                panel.set_ylabel(f"Spots {when}" if column == 0 else "", fontweight="bold")
                if row == 0:
                    label = labels[column] if len(distances) == 1 else f"object at {labels[column]}"
                    panel.set_title(
                        label.replace(", ", "\n", 1), color=style.field_colours(len(labels))[column], fontsize=8.5
                    )
    words = f"the first {count} of {len(labels)} spots" if count < len(labels) else None
    page.legend(
        handles=wavelength_handles(wavelengths, airy), loc="outside lower center", ncols=2, handletextpad=0.3,
        title=words, title_fontproperties={"size": 8},
    )  # fmt: skip
