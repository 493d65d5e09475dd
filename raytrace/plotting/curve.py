"""Through-focus curve: RMS spot radius against sensor distance, without tracing a ray twice."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide
from raytrace.plotting import style
from raytrace.plotting.spots import shares_of
from raytrace.system.lens import Lens, with_object_distance
from raytrace.system.rays import Rays
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.focus import Focus, along_normal, focus_moments, through_focus
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.spot import image_rays

_SAMPLES = 401


class FocusRays(NamedTuple):
    """Rays (3, C, P) on the sensor, one batch for every curve, with their weights (P,) or (C, P).

    slant: how far the sensor moves along its normal for each mm of its distance.
    """

    rays: Rays
    weights: Tensor
    slant: float = 1.0

    @property
    def best(self) -> np.ndarray:
        """Shifts (C,) mm of the sensor to the least RMS spot of every curve."""
        covariance, variance = focus_moments(self.rays, self.weights)
        return style.array(-safe_divide(covariance, variance)) / self.slant

    def radii(self, shifts: np.ndarray) -> np.ndarray:
        """RMS radii (S, C) mm on the sensor moved by shifts (S,) mm."""
        shifts = torch.as_tensor(shifts, dtype=self.weights.dtype, device=self.weights.device)
        return style.array(through_focus(self.rays, self.slant * shifts, self.weights).rms_radius)


@style.styled
def through_focus_curve(found: Focus, by: str = "field"):
    """RMS spot radius against the sensor distance; minima, the paraxial focus and the sensor before are marked.

    by: "field", a line for each field over all wavelengths, or "wavelength", a line for each wavelength of the first
    field; of the first object distance. Raises ValueError for another word.
    """
    if by not in ("field", "wavelength"):
        raise ValueError(f"by = {by!r}: expected 'field' or 'wavelength'")
    lens = with_object_distance(detached(found.before), found.object_distances[0].detach())
    fields, values = found.fields.detach(), style.array(found.wavelengths)
    if by == "field":
        labels = [field_label(lens, field) for field in style.array(fields).T]
        colours, title = style.field_colours(len(labels)), field_title(lens)
    else:
        fields, labels = fields[:, :1], [f"{wavelength:.4g} µm" for wavelength in values]
        colours, title = style.wavelength_colours(values), f"Field {field_label(lens, style.array(fields)[:, 0])}"
    bundle = focus_rays(
        lens, fields=fields, wavelengths=found.wavelengths.detach(), wavelength_weights=found.wavelength_weights,
        pupil=(found.points, found.weights), by=by,
    )  # fmt: skip
    sensor = float(lens.surfaces[-2].thickness)
    marks = {"paraxial focus": float(found.paraxial[0]), "sensor": sensor}
    figure = style.new_figure(7.0, 4.4)
    axes = figure.add_subplot()
    draw_curves(axes, bundle, sensor, focus_span(lens, bundle, sensor, marks.values()), labels=labels, colours=colours)
    draw_marks(axes, marks)
    axes.set_title(
        style.fill(lens.name, 6.3, 11, bold=True) or "Lens", fontsize=11, fontweight="bold", pad=20, loc="left"
    )
    axes.annotate(
        first_order_text(lens, first_order(lens)),
        (0, 1), (0, 8), xycoords="axes fraction", textcoords="offset points", color=style.GREY,
    )  # fmt: skip
    columns = 3 if max(map(len, labels)) < 6 else 2
    figure.legend(title=f"{title}: least RMS radius at", title_fontsize=8, loc="outside lower center", ncols=columns)
    return figure


def focus_rays(
    lens: Lens,
    *,
    fields: Tensor,
    wavelengths: Tensor | None,
    wavelength_weights: Tensor | None,
    pupil: tuple[Tensor, Tensor],
    by: str = "field",
) -> FocusRays:
    """The rays of every curve: by "field" all wavelengths in one with their weights, by "wavelength" each by itself."""
    points, weights = pupil
    shares, slant = shares_of(lens, wavelengths, wavelength_weights), float(along_normal(lens))
    with torch.no_grad():
        rays = image_rays(lens, points, fields=fields, wavelengths=wavelengths)
    if by == "wavelength":
        return FocusRays(
            Rays(rays.position.flatten(1, 2), rays.direction.flatten(1, 2), rays.valid.flatten(0, 1)), weights, slant
        )
    weights = (shares[:, None] * weights).flatten()
    joined = Rays(rays.position.flatten(2), rays.direction.flatten(2), rays.valid.flatten(1))
    return FocusRays(joined, weights, slant)


def focus_span(lens: Lens, bundle: FocusRays, sensor: float, marks) -> tuple[float, float]:
    """First and last sensor distance in mm: all minima and marks, and room for the curves to rise beside them.

    A perfect cone moved by s has the RMS radius s/(√8 N); the room makes that twice the least RMS radius, or five
    times the classical depth of focus 2 λ N² where the spot is smaller than the Airy disc.
    """
    best = bundle.best
    least = np.diagonal(bundle.radii(best))
    number = float(axial_f_number(lens))
    number = number if math.isfinite(number) else 0.0
    sharpest = min(least[np.isfinite(least)], default=0.0)  # no number where no ray arrives
    blur = max(2 * math.sqrt(8) * number * sharpest, 1e-2 * float(lens.wavelengths.min()) * number**2)
    seen = [x for x in (*(sensor + best), sensor, *marks) if math.isfinite(x)]
    room = max(0.2 * (max(seen) - min(seen)), blur, 1e-6)
    return min(seen) - room, max(seen) + room


def draw_curves(
    axes, bundle: FocusRays, sensor: float, span: tuple[float, float], *, labels, colours=None
) -> None:
    """One line for each batch of rays, a dot at its minimum; labels carry the place and the radius of the minimum."""
    colours = style.field_colours(len(labels)) if colours is None else colours
    shifts = np.linspace(span[0], span[1], _SAMPLES) - sensor
    radii, best = 1e3 * bundle.radii(shifts), bundle.best
    least = 1e3 * np.diagonal(bundle.radii(best))
    alive = np.isfinite(least)
    for c in np.flatnonzero(alive):
        place = f"{labels[c]}: {sensor + best[c]:.4f} mm, {style.number_text(least[c])} µm"
        width = max(1.9 - 0.3 * c, 1.0)  # so that curves that coincide all show
        axes.plot(sensor + shifts, radii[:, c], color=colours[c], linewidth=width, label=place, zorder=3)
        if span[0] <= sensor + best[c] <= span[1]:
            axes.plot(
                [sensor + best[c]], [least[c]], "o", color=colours[c], markersize=4.5, markeredgecolor="white", zorder=4
            )
    axes.set_xlim(*span)
    axes.set_ylim(0, 1.03 * radii[:, alive].max() if alive.any() else 1.0)
    axes.set_xlabel("Sensor distance from the last surface (mm)")
    axes.set_ylabel("RMS spot radius (µm)")
    axes.grid(color="#ececec", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)


def draw_marks(axes, marks: dict[str, float]) -> None:
    """Vertical lines with their names along the top, turned so that neighbours do not meet."""
    low, high = axes.get_xlim()
    dashes = ((0, (1, 1.5)), (0, (5, 2)), "solid", (0, (5, 2, 1, 2)))
    shown = {name: x for name, x in marks.items() if low <= x <= high}
    for (name, x), dash in zip(shown.items(), dashes, strict=False):
        axes.axvline(x, color=style.GREY, linewidth=0.9, linestyle=dash, zorder=2)
        nearest = min((other for other in shown.values() if other != x), key=lambda o: abs(o - x), default=math.inf)
        left = nearest > x and nearest - x < 0.06 * (high - low)
        axes.annotate(
            name, (x, 1.0), (-3 if left else 3, -3), xycoords=("data", "axes fraction"), textcoords="offset points",
            rotation=90, ha="right" if left else "left", va="top", fontsize=7.5, color=style.GREY,
        )  # fmt: skip
