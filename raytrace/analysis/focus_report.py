"""Focus: the sensor at the best distance, the report of it, and the RMS spot radius through focus."""

import math
import warnings
from collections.abc import Iterable, Sequence
from os import PathLike
from typing import Literal, NamedTuple, TypedDict, cast

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.layout import draw_layout
from raytrace.analysis.panels import first_order_text
from raytrace.analysis.spot_diagram import (
    airy_radius,
    draw_spot_to_scale,
    field_spots,
    panel_size,
    shares_of,
    wavelength_handles,
)
from raytrace.io import write_lens
from raytrace.maths.numerics import detached, safe_divide, value
from raytrace.maths.result import Column, Result, Table, number, numbers, object_text
from raytrace.maths.sampling import SAMPLINGS, sampled
from raytrace.plotting import style
from raytrace.system.lens import (
    Lens,
    field_label,
    field_points,
    field_title,
    name_of_field,
    vector,
    wavelengths_of,
    with_object_distance,
    with_sensor_distance,
)
from raytrace.system.rays import Rays
from raytrace.tracing.clear_pupil import clear_pupil
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.focus import (
    Conjugates,
    along_normal,
    focus_moments,
    focus_of_mean_radius,
    focus_of_rms,
    is_behind,
    mean_rms_radius,
    paraxial_sensor,
    through_focus,
)
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.paraxial import first_order, paraxial_image_distance
from raytrace.tracing.ray_failures import LostRays, warn_of_failures
from raytrace.tracing.spot import image_rays
from raytrace.words import RaytraceError, RaytraceWarning, calling_level, option

_SAMPLES = 401  # of a curve through focus
_MOST_SPOTS = 5  # columns of spots that stay legible
_DASHES = {"sensor before": (0, (6, 2.5)), "sensor after": "solid", "paraxial focus": (0, (1, 1.6))}


class NoFocus(RaytraceError, ValueError):
    """The light of an object has no focus; the message has the cause and a remedy."""


class VirtualImage(RaytraceWarning):
    """The best sensor distance is on the side that light comes from."""


@value
class Focus(Result):
    """The refocused lens, and the sensor distances by other criteria, mm.

    lens, before: with the new and the old sensor distance; paraxial: (D,) of the paraxial image of every object; rms:
    of least RMS spot; criterion: as for `focus`. object_distances: (D,) mm, fields: (2, F), wavelengths: (W,) µm, their
    weights (or None), and points (2, P) and weights (P,) of the pupil: those evaluated; rings: of the clear pupil, None
    for other samplings.
    """

    COLUMNS = (
        Column("place", form="<", heading=" "), Column("sensor_distance", "mm", ".6f", "sensor distance"),
        Column("rms_radius_um", "µm", ".4f", "RMS spot radius"),
    )  # fmt: skip

    lens: Lens
    before: Lens
    paraxial: Tensor
    rms: Tensor
    object_distances: Tensor
    fields: Tensor
    wavelengths: Tensor
    distance_weights: Tensor | None
    field_weights: Tensor | None
    wavelength_weights: Tensor | None
    points: Tensor
    weights: Tensor
    rings: int | None = None
    criterion: str = "rms"

    @property
    def sensor_distance(self) -> Tensor:
        """mm from the last surface before the image; differentiable in the lens, but for the criterion "mean"."""
        return self.lens.surfaces[-2].thickness

    @property
    def pupil(self) -> tuple[Tensor, Tensor] | None:
        """Points and weights of the pupil, None for the clear pupil."""
        return (self.points, self.weights) if self.rings is None else None

    @property
    def is_real(self) -> bool:
        """Whether the image is real: behind the lens."""
        return is_behind(self.lens, self.sensor_distance)

    def rms_radius(self, sensor_distance: Tensor | float | None = None) -> Tensor:
        """Weighted RMS radius (mm) over distances, fields and wavelengths, by default at the new sensor distance."""
        lens = self.lens if sensor_distance is None else with_sensor_distance(self.before, sensor_distance)
        return mean_rms_radius(
            lens,
            self.points,
            self.weights,
            rings=self.rings,
            object_distances=self.object_distances,
            distance_weights=self.distance_weights,
            fields=self.fields,
            field_weights=self.field_weights,
            wavelengths=self.wavelengths,
            wavelength_weights=self.wavelength_weights,
        )

    def columns(self) -> dict[str, Tensor]:
        sensors = torch.stack([sensor for _, sensor in self._sensors()])
        radii = torch.stack([self.rms_radius(sensor) for sensor in sensors])
        return {"place": torch.arange(len(sensors)), "sensor_distance": sensors, "rms_radius_um": 1e3 * radii}

    def words(self) -> dict:
        return {"place": [words for words, _ in self._sensors()]}

    def document(self) -> dict:
        alone = len(self.object_distances) == 1
        before = self.before.surfaces[-2].thickness
        return {
            "object_distance": numbers(self.object_distances)[0] if alone else numbers(self.object_distances),
            "sensor_before": number(before),
            "sensor_paraxial": numbers(self.paraxial)[0] if alone else numbers(self.paraxial),
            "sensor_rms": number(self.rms),
            "sensor_after": number(self.sensor_distance),
            "rms_before_um": number(1e3 * self.rms_radius(before)),
            "rms_after_um": number(1e3 * self.rms_radius()),
            "is_real": self.is_real,
        }

    def tables(self) -> list[Table]:
        data = first_order(self.before)
        diameter, position = float(data.entrance_pupil_diameter), float(data.entrance_pupil_position)
        focal, back = float(data.effective_focal_length), float(data.back_focal_distance)
        objects = ", ".join(_words(d) for d in self.object_distances.tolist())
        fields = ", ".join(name_of_field(field) for field in self.fields.unbind(1))
        colours = ", ".join(f"{w:g}" for w in self.wavelengths.tolist())
        lines = [
            self.before.name,
            f"  effective focal length {focal:.6f} mm, F/{float(data.f_number):.4g}, back focal distance {back:.6f} mm",
            f"  entrance pupil {diameter:.5g} mm across, {position:.5g} mm from surface 1",
            f"  object at {objects}; field {fields} {self.before.fields.unit}; {colours} µm; "
            f"criterion {self.criterion}",
            "",
        ]
        return [Table(self.columns(), lines)]

    def _sensors(self) -> list[tuple[str, Tensor]]:
        """Sensor distances with their names."""
        several = len(self.object_distances) > 1
        names = [f"paraxial image of {_words(d)}" if several else "paraxial" for d in self.object_distances.tolist()]
        both = [("before", self.before.surfaces[-2].thickness), ("after", self.sensor_distance)]
        return [*both, *zip(names, self.paraxial, strict=True), ("best RMS", self.rms)]

    @style.styled
    def draw(self, by: str | None = None) -> style.Figure:
        """One page: the lens, the RMS spot radius through focus, and the spots before and after on one scale.

        Every object distance and field is a curve and a pair of spots. by: instead the curves alone, as for
        `through_focus_curve`.
        """
        if by is not None:
            return through_focus_curve(self, by)
        lens_before, lens_after = detached(self.before), detached(self.lens)
        lens, fields, wavelengths = lens_before, self.fields.detach(), self.wavelengths.detach()
        distances = self.object_distances.tolist()
        labels = _labels(lens, distances, fields)
        light = _Light(
            fields=fields, wavelengths=wavelengths, wavelength_weights=self.wavelength_weights, pupil=self.pupil
        )

        columns = max(len(labels), 1)
        figure = style.new_figure(10.0 if columns > 3 else 9.0, 8.4)
        name = style.fill(lens.name, figure.get_figwidth(), 12, bold=True) or "Lens"
        figure.suptitle(name, fontsize=12, fontweight="bold")
        top, bottom = cast(np.ndarray, figure.subfigures(2, 1, height_ratios=(1.0, 1.0), hspace=0.02))
        wide = min(1.0 + 0.32 * (columns - 1), 1.6)
        left, right = bottom.subfigures(1, 2, width_ratios=(1.25, wide), wspace=0.02)

        axes = top.add_subplot()
        drawn = with_object_distance(lens_after, distances[0])
        draw_layout(axes, drawn, fields=fields, wavelengths=wavelengths[:1], rays=11 if fields.shape[1] == 1 else 7)
        top.suptitle(first_order_text(drawn), fontsize=8.5, color=style.GREY)

        _draw_focus(left.add_subplot(), lens_before, lens_after, distances, labels, light)
        left.legend(
            loc="outside lower center", ncols=1 if columns == 1 else 2, fontsize=7.5, handlelength=1.8,
            columnspacing=1.2,
            title=None if len(labels) == 1 else "least RMS radius of every curve", title_fontsize=7.5,
        )  # fmt: skip
        _draw_spots(right, lens_before, lens_after, distances, labels, light)
        return figure

    def save(self, path: str | PathLike) -> None:
        """Write the lens with its new sensor distance."""
        write_lens(self.lens, path)


def focus(
    lens: Lens,
    *,
    object_distances: Sequence[float] | Tensor | None = None,
    distance_weights: Sequence[float] | Tensor | None = None,
    fields: Tensor | Sequence = (0.0,),
    field_weights: Sequence[float] | Tensor | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    wavelength_weights: Sequence[float] | Tensor | None = None,
    criterion: Literal["rms", "paraxial", "mean"] = "rms",
    sampling: Literal["gauss", "hexapolar", "square", "sobol", "random"] = "gauss",
    rings: int | None = None,
    points: int | None = None,
    seed: int = 0,
) -> Focus:
    """The lens with its sensor at the best distance for weighted objects, fields and wavelengths.

    criterion: "rms" (minimum RMS spot radius, in closed form and differentiable), "paraxial" (image, or the weighted
    mean of those of several objects) or "mean" (minimum mean distance from the centroid). object_distances: mm, inf
    allowed, by default the lens's; fields: y, (x, y) or (2, F), by default the axis; wavelengths: µm, by default the
    primary one; weights: one for each, by default equal. sampling, rings, points, seed: as for `sampling.sampled`;
    `gauss` integrates a beam that apertures clip up to its edge, as `spot` does, other samplings count the rays that
    arrive.
    Warns LostRays and VirtualImage. Raises NoFocus, and ValueError for an unknown argument.
    """
    if criterion not in ("rms", "paraxial", "mean"):
        raise ValueError(f"criterion {criterion!r}: expected one of rms, paraxial, mean")
    distances = vector(lens.surfaces[0].thickness if object_distances is None else object_distances, like=lens)
    fields = field_points(fields, like=lens)
    primary = lens.primary[None]
    wavelengths = primary if wavelengths is None else wavelengths_of(lens, wavelengths)
    warn_of_filling(with_object_distance(lens, distances.min()), fields)
    like = lens.surfaces[-2].thickness
    pupil, weights = sampled(sampling, rings=rings, points=points, seed=seed, dtype=like.dtype, device=like.device)
    paraxial = paraxial_sensor(lens, distances)
    shares = _weights(lens, distance_weights, len(distances), option("distance_weights"))
    scene = Conjugates(
        object_distances=distances,
        fields=fields,
        wavelengths=wavelengths,
        distance_weights=shares,
        field_weights=_weights(lens, field_weights, fields.shape[1], option("field_weights")),
        wavelength_weights=_weights(lens, wavelength_weights, len(wavelengths), option("wavelength_weights")),
        rings=(rings or SAMPLINGS["gauss"][2]) if sampling == "gauss" else None,
    )
    if not bool(torch.isfinite(paraxial).all()):
        raise NoFocus("the lens is afocal for this object distance; there is no focus to find")
    rms = focus_of_rms(lens, pupil, weights, **scene)
    _check_rays(lens, pupil, distances, fields, wavelengths)
    if not bool(torch.isfinite(rms)):
        raise NoFocus(f"one ray, or parallel rays, have no focus; give more {option('rings')} or {option('points')}")
    best = rms
    if criterion == "mean":
        best = focus_of_mean_radius(lens, pupil, weights, **scene)
    elif criterion == "paraxial":
        best = paraxial.mean() if shares is None else (shares * paraxial).sum() / shares.sum()
    result = Focus(
        lens=with_sensor_distance(lens, best),
        before=lens,
        paraxial=paraxial,
        rms=rms,
        object_distances=distances,
        fields=fields,
        wavelengths=wavelengths,
        distance_weights=shares,
        field_weights=scene["field_weights"],
        wavelength_weights=scene["wavelength_weights"],
        points=pupil,
        weights=weights,
        rings=scene["rings"],
        criterion=criterion,
    )
    if not result.is_real:
        message = (
            f"the image is virtual, at {float(best):g} mm, on the side of the last surface that the light comes from"
        )
        if bool(torch.isfinite(lens.surfaces[0].thickness)):
            message += ": move the object further away"
        warnings.warn(message, VirtualImage, stacklevel=calling_level())
    return result


def _weights(lens: Lens, weights: Sequence[float] | Tensor | None, count: int, name: str) -> Tensor | None:
    if weights is None:
        return None
    weights = vector(weights, like=lens)
    if len(weights) != count:
        raise ValueError(f"{name}: {len(weights)} given, expected {count}, one for each")
    return weights


def _check_rays(lens: Lens, points: Tensor, distances: Tensor, fields: Tensor, wavelengths: Tensor) -> None:
    """Warn of rays that do not reach the image. Raises NoFocus if none does."""
    arrived = []
    for distance in distances:
        trial = with_object_distance(lens, distance)
        with torch.no_grad():
            valid = image_rays(trial, points, fields=fields, wavelengths=wavelengths).valid
        prefix = f"object at {float(distance):g} mm, " if len(distances) > 1 else ""
        warn_of_failures(trial, points, ~valid.any(-1), fields=fields, wavelengths=wavelengths, prefix=prefix)
        arrived.append(valid.double().mean())
    lost = 1 - float(sum(arrived)) / len(arrived)
    if lost == 1:
        raise NoFocus("no ray reaches the image")
    if lost > 0:
        message = f"{lost:.2%} of the rays fail or are vignetted; the focus is that of the others"
        warnings.warn(message, LostRays, stacklevel=calling_level())


def _words(distance: float) -> str:
    return "infinity" if distance == float("inf") else f"{distance:g} mm"


def _labels(lens: Lens, distances: list[float], fields: Tensor) -> list[str]:
    """Labels of the curves, object distance outermost."""
    points = [field_label(lens, point) for point in style.array(fields).T.tolist()]
    if len(distances) == 1:
        return points
    objects = [object_text(distance) for distance in distances]
    return [place if len(points) == 1 else f"{place}, {point}" for place in objects for point in points]


class _Light(TypedDict):
    """Options of `focus_rays` and `field_spots`."""

    fields: Tensor
    wavelengths: Tensor
    wavelength_weights: Tensor | None
    pupil: tuple[Tensor, Tensor] | None


def _draw_focus(
    axes: style.Axes, before: Lens, after: Lens, distances: list[float], labels: list[str], light: _Light
) -> None:
    """The curves, and lines for the sensor before and after and for the paraxial focus, all with their numbers."""
    bundles = [focus_rays(with_object_distance(before, distance), **light) for distance in distances]
    most = max(bundle.weights.shape[-1] for bundle in bundles)  # rays of clear pupils differ in number

    def joined(parts: Sequence[Tensor], dim: int) -> Tensor:
        return torch.cat([torch.nn.functional.pad(part, (0, most - part.shape[-1])) for part in parts], dim)

    rays = [bundle.rays for bundle in bundles]
    bundle = FocusRays(
        Rays(
            joined([each.position for each in rays], 1),
            joined([each.direction for each in rays], 1),
            joined([each.valid for each in rays], 0),
        ),
        joined([bundle.weights.expand(bundle.rays.shape) for bundle in bundles], 0),
        bundles[0].slant,
    )
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


def _draw_spots(
    page: style.SubFigure, before: Lens, after: Lens, distances: list[float], labels: list[str], light: _Light
) -> None:
    """Spots before and after, the same scale in all panels; one column a curve, or side by side for one curve."""
    panels = []
    for lens in (before, after):
        spots = [field_spots(with_object_distance(lens, distance), **light) for distance in distances]
        panels.append([(*pair, f) for pair in spots for f in range(pair[0].rays.shape[0])][:_MOST_SPOTS])
    airy = float(airy_radius(with_object_distance(after, distances[0])))
    wavelengths = light["wavelengths"].tolist()
    half = panel_size([float(spot.geometric_radius[f]) for row in panels for spot, _, f in row], airy)
    count = len(panels[0])
    axes = page.subplots(*((1, 2) if count == 1 else (2, count)), squeeze=False).reshape(2, count)
    for row, when in enumerate(("before", "after")):
        for column, (whole, dots, f) in enumerate(panels[row]):
            panel = axes[row, column]
            draw_spot_to_scale(panel, whole, dots, f, wavelengths=wavelengths, airy=airy, half=half)
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
        moves = self.slant * torch.as_tensor(shifts, dtype=self.weights.dtype, device=self.weights.device)
        return style.array(through_focus(self.rays, moves, self.weights).rms_radius)


@style.styled
def through_focus_curve(focus: Focus, by: str = "field") -> style.Figure:
    """RMS spot radius against the sensor distance; minima, the paraxial focus and the sensor before are marked.

    by: "field", a line for each field over all wavelengths, or "wavelength", a line for each wavelength of the first
    field; of the first object distance. Raises ValueError for another word.
    """
    if by not in ("field", "wavelength"):
        raise ValueError(f"by = {by!r}: expected 'field' or 'wavelength'")
    lens = with_object_distance(detached(focus.before), focus.object_distances[0].detach())
    fields, values = focus.fields.detach(), focus.wavelengths.tolist()
    colours: Sequence
    if by == "field":
        labels = [field_label(lens, field) for field in style.array(fields).T.tolist()]
        colours, title = style.field_colours(len(labels)), field_title(lens)
    else:
        fields, labels = fields[:, :1], [f"{wavelength:.4g} µm" for wavelength in values]
        colours, title = style.wavelength_colours(values), f"Field {field_label(lens, fields[:, 0].tolist())}"
    bundle = focus_rays(
        lens, fields=fields, wavelengths=focus.wavelengths.detach(), wavelength_weights=focus.wavelength_weights,
        pupil=focus.pupil, by=by,
    )  # fmt: skip
    sensor = float(lens.surfaces[-2].thickness)
    marks = {"paraxial focus": float(focus.paraxial[0]), "sensor": sensor}
    figure = style.new_figure(7.0, 4.4)
    axes = figure.add_subplot()
    draw_curves(axes, bundle, sensor, focus_span(lens, bundle, sensor, marks.values()), labels=labels, colours=colours)
    draw_marks(axes, marks)
    axes.set_title(
        style.fill(lens.name, 6.3, 11, bold=True) or "Lens", fontsize=11, fontweight="bold", pad=20, loc="left"
    )
    axes.annotate(
        first_order_text(lens),
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
    pupil: tuple[Tensor, Tensor] | None = None,
    by: str = "field",
) -> FocusRays:
    """The rays of every curve: by "field" all wavelengths in one with their weights, by "wavelength" each by itself.

    pupil: points (2, P) and weights (P,), of which the rays that arrive count, by default of the clear pupil.
    """
    points, weights = clear_pupil(lens, fields=fields, wavelengths=wavelengths) if pupil is None else pupil
    shares, slant = shares_of(lens, wavelengths, wavelength_weights), float(along_normal(lens))
    with torch.no_grad():
        rays = image_rays(lens, points, fields=fields, wavelengths=wavelengths)
    if by == "wavelength":
        weights = weights.expand(rays.shape).flatten(0, 1)
        return FocusRays(
            Rays(rays.position.flatten(1, 2), rays.direction.flatten(1, 2), rays.valid.flatten(0, 1)), weights, slant
        )
    weights = (shares[:, None] * weights).flatten(-2)
    joined = Rays(rays.position.flatten(2), rays.direction.flatten(2), rays.valid.flatten(1))
    return FocusRays(joined, weights, slant)


def focus_span(lens: Lens, bundle: FocusRays, sensor: float, marks: Iterable[float]) -> tuple[float, float]:
    """First and last sensor distance in mm: all minima and marks, and room for the curves to rise around them.

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
    axes: style.Axes,
    bundle: FocusRays,
    sensor: float,
    span: tuple[float, float],
    *,
    labels: Sequence[str],
    colours: Sequence | None = None,
) -> None:
    """One line for each batch of rays, a dot at its minimum; labels carry the place and the radius of the minimum."""
    colours = style.field_colours(len(labels)) if colours is None else colours
    shifts = np.linspace(span[0], span[1], _SAMPLES) - sensor
    radii, best = 1e3 * bundle.radii(shifts), bundle.best
    least = 1e3 * np.diagonal(bundle.radii(best))
    alive = np.isfinite(least)
    for c in np.flatnonzero(alive).tolist():
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


def draw_marks(axes: style.Axes, marks: dict[str, float]) -> None:
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
