"""Focusing: the best sensor distance by a criterion, and what it does to the spots."""

import warnings
from collections.abc import Sequence
from os import PathLike

import torch
from torch import Tensor

from raytrace.io import write_lens
from raytrace.maths import pupil
from raytrace.maths.result import Result, number, numbers
from raytrace.maths.value import value
from raytrace.system.lens import (
    FIELD_UNITS,
    Lens,
    field_points,
    name_of_field,
    vector,
    wavelengths_of,
    with_object_distance,
    with_sensor_distance,
)
from raytrace.tracing.focus import (
    focus_of_mean_radius,
    focus_of_rms,
    image_rays,
    is_behind,
    mean_rms_radius,
    paraxial_sensor,
)
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.ray_failures import LostRays, warn_of_failures
from raytrace.tracing.stop_filling import warn_of_filling
from raytrace.words import calling_level


class NoFocus(ValueError):
    """There is no place where the light of an object comes together; the message says why and what helps."""


class VirtualImage(UserWarning):
    """The best sensor distance is on the side that light comes from, where no sensor can stand."""


@value
class Focus(Result):
    """The lens with its sensor where the criterion is best, and the sensor distances that it was chosen from, mm.

    lens, before: the same but for the sensor. paraxial: (D,) of the paraxial image of every object; rms: of least RMS
    spot; criterion: as for `focus`. object_distances: (D,) mm, fields: (2, F), wavelengths: (W,) µm, their weights
    (or None) and the rule of the pupil, points (2, P) and weights (P,): what was looked at.
    """

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
    criterion: str = "rms"

    FIGURE = "plotting.report.focus_report"

    @property
    def sensor_distance(self) -> Tensor:
        """mm from the last surface before the image; differentiable in the lens, but for the criterion "mean"."""
        return self.lens.surfaces[-2].thickness

    @property
    def is_real(self) -> bool:
        """Whether light gets there: behind the lens."""
        return is_behind(self.lens, self.sensor_distance)

    def rms_radius(self, sensor_distance: Tensor | float | None = None) -> Tensor:
        """RMS radius (mm) over distances, fields and wavelengths by their weights, by default on the sensor found."""
        lens = self.lens if sensor_distance is None else with_sensor_distance(self.before, sensor_distance)
        return mean_rms_radius(lens, self.points, self.weights, **_rule(self))

    def columns(self) -> dict[str, Tensor]:
        places = torch.stack([place for _, place in self._places()])
        radii = torch.stack([self.rms_radius(place) for place in places])
        return {"place": torch.arange(len(places)), "sensor_distance": places, "rms_radius": radii}

    def words(self) -> dict:
        return {"place": [words for words, _ in self._places()]}

    def units(self) -> dict[str, str]:
        return {"sensor_distance": "mm", "rms_radius": "mm"}

    def document(self) -> dict:
        alone = len(self.object_distances) == 1
        before = self.before.surfaces[-2].thickness
        return {
            "object_distance": numbers(self.object_distances)[0] if alone else numbers(self.object_distances),
            "sensor_before": number(before),
            "sensor_paraxial": numbers(self.paraxial)[0] if alone else numbers(self.paraxial),
            "sensor_rms": number(self.rms),
            "sensor_after": number(self.sensor_distance),
            "rms_before": number(self.rms_radius(before)),
            "rms_after": number(self.rms_radius()),
            "is_real": self.is_real,
        }

    def __str__(self) -> str:
        data, kind = first_order(self.before), self.before.fields.kind
        across, place = float(data.entrance_pupil_diameter), float(data.entrance_pupil_position)
        focal, back = float(data.effective_focal_length), float(data.back_focal_distance)
        objects = ", ".join(_words(d) for d in self.object_distances.tolist())
        fields = ", ".join(name_of_field(field) for field in self.fields.unbind(1))
        colours = ", ".join(f"{w:g}" for w in self.wavelengths.tolist())
        lines = [
            self.before.name,
            f"  effective focal length {focal:.6f} mm, F/{float(data.f_number):.4g}, back focal distance {back:.6f} mm",
            f"  entrance pupil {across:.5g} mm across, {place:.5g} mm from surface 1",
            f"  object at {objects}; field {fields} {FIELD_UNITS[kind]}; {colours} µm; criterion {self.criterion}\n",
            f"  {'':<28} {'sensor distance':>18} {'RMS spot radius':>18}",
        ]
        for words, sensor in self._places():
            rms = number(self.rms_radius(sensor))
            radius = "no rays" if rms is None else f"{1000 * rms:>15.4f} µm"
            lines.append(f"  {words:<28} {float(sensor):>15.6f} mm {radius}")
        return "\n".join(lines)

    def _places(self) -> list[tuple[str, Tensor]]:
        """Sensor distances of interest, and what they are."""
        several = len(self.object_distances) > 1
        named = [f"paraxial image of {_words(d)}" if several else "paraxial" for d in self.object_distances.tolist()]
        found = [("before", self.before.surfaces[-2].thickness), ("after", self.sensor_distance)]
        return [*found, *zip(named, self.paraxial, strict=True), ("best RMS", self.rms)]

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
    criterion: str = "rms",
    sampling: str = "gauss",
    rings: int | None = None,
    points: int | None = None,
    seed: int = 0,
) -> Focus:
    """The lens with its sensor at the best distance for objects, fields and wavelengths, by their weights.

    criterion: "rms", the least RMS spot radius, in closed form and differentiable; "paraxial", the paraxial image, or
    the weighted mean of those of several objects; "mean", the least mean distance from the centroid.
    object_distances: mm, inf allowed, by default the lens's own; fields: y, (x, y) or (2, F), by default the axis;
    wavelengths: µm, by default the primary one; weights: one for each, by default alike. sampling, rings, points, seed:
    as for `pupil.sampled`. Warns LostRays and VirtualImage. Raises NoFocus, and ValueError for what is not known.
    """
    if criterion not in ("rms", "paraxial", "mean"):
        raise ValueError(f"criterion {criterion!r}: expected one of rms, paraxial, mean")
    distances = vector(lens.surfaces[0].thickness if object_distances is None else object_distances, like=lens)
    fields = field_points(fields, like=lens)
    primary = lens.primary[None]
    wavelengths = primary if wavelengths is None else wavelengths_of(lens, wavelengths)
    warn_of_filling(with_object_distance(lens, distances.min()), fields)
    like = lens.surfaces[-2].thickness
    at, weights = pupil.sampled(sampling, rings=rings, points=points, seed=seed, dtype=like.dtype, device=like.device)
    paraxial = paraxial_sensor(lens, distances)
    looked_at = {
        "object_distances": distances,
        "fields": fields,
        "wavelengths": wavelengths,
        "distance_weights": _weights(lens, distance_weights, len(distances), "`distance_weights`"),
        "field_weights": _weights(lens, field_weights, fields.shape[1], "`field_weights`"),
        "wavelength_weights": _weights(lens, wavelength_weights, len(wavelengths), "`wavelength_weights`"),
    }
    if not bool(torch.isfinite(paraxial).all()):
        raise NoFocus("the lens is afocal for this object distance; there is no focus to find")
    rms = focus_of_rms(lens, at, weights, **looked_at)
    _tell_losses(lens, at, distances, fields, wavelengths)
    if not bool(torch.isfinite(rms)):
        raise NoFocus("one ray, or parallel rays, have no focus; give more `rings` or `points`")
    best = rms
    if criterion == "mean":
        best = focus_of_mean_radius(lens, at, weights, **looked_at)
    elif criterion == "paraxial":
        shares = looked_at["distance_weights"]
        best = paraxial.mean() if shares is None else (shares * paraxial).sum() / shares.sum()
    found = Focus(
        with_sensor_distance(lens, best), lens, paraxial, rms, points=at, weights=weights, criterion=criterion,
        **looked_at,
    )  # fmt: skip
    if not found.is_real:
        place = f"{float(best):g} mm, on the side of the last surface that the light comes from"
        told = f"the image is virtual, at {place}: no sensor can stand there; take the object further away"
        warnings.warn(told, VirtualImage, stacklevel=calling_level())
    return found


def _weights(lens: Lens, given, count: int, option: str) -> Tensor | None:
    if given is None:
        return None
    found = vector(given, like=lens)
    if len(found) != count:
        raise ValueError(f"{option}: {len(found)} given, expected {count}, one for each")
    return found


def _tell_losses(lens: Lens, points: Tensor, distances: Tensor, fields: Tensor, wavelengths: Tensor) -> None:
    """Warn of rays that do not reach the image. Raises NoFocus if none does."""
    arrived = []
    for distance in distances:
        trial = with_object_distance(lens, distance)
        with torch.no_grad():
            valid = image_rays(trial, points, fields=fields, wavelengths=wavelengths).valid
        at = f"object at {float(distance):g} mm, " if len(distances) > 1 else ""
        warn_of_failures(trial, points, ~valid.any(-1), fields=fields, wavelengths=wavelengths, at=at)
        arrived.append(valid.double().mean())
    lost = 1 - float(sum(arrived)) / len(arrived)
    if lost == 1:
        raise NoFocus("no ray reaches the image")
    if lost > 0:
        message = f"{lost:.2%} of the rays are lost; the focus is of the rest"
        warnings.warn(message, LostRays, stacklevel=calling_level())


def _rule(found: Focus) -> dict:
    names = ("object_distances", "fields", "wavelengths", "distance_weights", "field_weights", "wavelength_weights")
    return {name: getattr(found, name) for name in names}


def _words(distance: float) -> str:
    return "infinity" if distance == float("inf") else f"{distance:g} mm"
