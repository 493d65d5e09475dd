"""Conjugates: which object distances a sensor is in focus for, and where it is for any."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import scipy.optimize
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide
from raytrace.maths.pupil import gauss_rings
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.focus import best_focus, focus_moments, real_image_distance
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import paraxial_image_distance
from raytrace.tracing.spot import image_rays
from raytrace.tracing.trace import lens_steps

_RINGS = 12  # of the pupil, where focus is found


def paraxial_image(lens: Lens) -> Tensor:
    """Sensor distance in mm of the paraxial image of the lens's object."""
    return paraxial_image_distance(lens, lens.surfaces[0].thickness)


@torch.no_grad()
def distance_in_focus(lens: Lens, image_distance: Callable[[Lens], Tensor]) -> float:
    """Object distance from vertex 1 in mm whose image, by `image_distance`, is on the sensor; inf beyond 1000 km."""

    def behind(vergence: float) -> float:
        return float(image_distance(with_object_distance(lens, 1 / vergence)) - lens.surfaces[-2].thickness)

    furthest, nearest = 1e-9, 2e-3
    if behind(furthest) >= 0:
        return math.inf
    if behind(nearest) < 0:
        raise ValueError(f"the sensor is in focus nearer than {1 / nearest:g} mm: too far behind the lens to be meant")
    return 1 / scipy.optimize.brentq(behind, furthest, nearest, xtol=1e-14, rtol=1e-12)


@torch.no_grad()
def sensor_range(lens: Lens, distances: Sequence[float], *, fields: Tensor, width: float) -> tuple[float, float]:
    """Sensor distances (mm) at which an object at some of the distances (mm) is in focus, to a blur `width` mm across.

    By paraxial images on the axis and least RMS spots of fields (2, F), from the nearest to the farthest, and by
    √2 · RMS slope of the rays on either side: there an even disc of light is as wide as that. Raises `NoImage` where
    an object has no real image.
    """
    place = lens.surfaces[-2].thickness
    found = [real_image_distance(lens, lens.wavelengths.new_tensor(distances))]
    steepness = [place.new_zeros(1)]
    for distance in distances:
        pupil, weights = gauss_rings(_RINGS)
        rays = image_rays(with_object_distance(lens, distance), pupil, fields=fields)
        covariance, variance = focus_moments(rays, weights)
        lit = variance > 0
        found.append((place - safe_divide(covariance, variance))[lit])
        steepness.append(variance[lit])
    images = torch.cat([one.flatten() for one in found])
    margin = 0.5 * width / math.sqrt(2 * float(torch.cat(steepness).max()) or math.inf)
    return float(images.min()) - margin, float(images.max()) + margin


def place_of(lens: Lens) -> dict[str, float]:
    """Where the sensor is, mm, and the object distances from vertex 1 in focus there, m: by name of the column."""
    return {
        "sensor_mm": float(lens.surfaces[-2].thickness),
        "focus_paraxial_m": 1e-3 * distance_in_focus(lens, paraxial_image),
        "focus_rms_m": 1e-3 * distance_in_focus(lens, best_focus),
    }


@dataclasses.dataclass(frozen=True)
class Cut:
    """A surface smaller than the beam on the axis: heights in mm."""

    surface: int
    height: float
    semi_diameter: float


@torch.no_grad()
def vignetted(lens: Lens) -> list[Cut]:
    """Surfaces between object and image, but for the stop, that are smaller than the beam of the object on the axis."""
    like = lens.wavelengths
    rays = launch(lens, like.new_tensor([[0.0], [1.0]]), fields=like.new_zeros(2, 1))
    crossings = list(lens_steps(lens, rays, like[:1, None]))
    heights = [float(one.rays.position[1].flatten()[0].abs()) for one in crossings]
    found = zip(lens.surfaces[1:-1], heights, strict=False)
    return [
        Cut(number, height, float(surface.semi_diameter))
        for number, (surface, height) in enumerate(found, 1)
        if surface.semi_diameter is not None and number != lens.stop and height > float(surface.semi_diameter)
    ]
