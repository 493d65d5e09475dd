"""Limits: how thin and how thick glass and air may be, and how far a lens is from keeping to it.

limits = limits_of(lens, glass=(2, 15), edge=1)
violation(lens, limits)          # Σ (what a thickness lacks, or has too much of)², mm²; 0 is buildable
"""

import dataclasses
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from raytrace.materials.glass import Glass, is_air
from raytrace.system.lens import Lens
from raytrace.system.parameter_paths import BadLimits as BadLimits
from raytrace.system.parameter_paths import parse_range as parse_range
from raytrace.system.surface import Surface, sag

#: Least thickness over the largest diameter of the lens, where none is given: of glass at its centre (a 50 mm lens:
#: 1 mm) and at its edge, and of air. A phone's cover glass is as thin; who knows the workshop gives its numbers.
_GLASS, _EDGE, _AIR = 1 / 50, 1 / 100, 1 / 2000


@dataclasses.dataclass(frozen=True)
class Limits:
    """Least and greatest thickness at the axis in mm, of glass and of air; edge: least of glass at its edge."""

    glass: tuple[float, float]
    air: tuple[float, float]
    edge: float


def limits_of(
    lens: Lens,
    *,
    glass: tuple[float, float] | None = None,
    air: tuple[float, float] | None = None,
    edge: float | None = None,
) -> Limits:
    """Limits, mm; what is None goes with the lens: of its largest diameter glass 1/50 at least, at its edge 1/100, air
    between elements 1/2000, and nothing at most. A lens without semi-diameters gets 0."""
    diameter = 2 * max((surface.semi_diameter or 0.0) for surface in lens.surfaces[1:-1])
    return Limits(
        glass=(_GLASS * diameter, math.inf) if glass is None else glass,
        air=(_AIR * diameter, math.inf) if air is None else air,
        edge=_EDGE * diameter if edge is None else edge,
    )


def violation(lens: Lens, limits: Limits | None = None) -> Tensor:
    """Σ (what a thickness lacks or has too much of)² in mm², over all elements and air spaces; 0 is buildable.

    limits: `limits_of(lens)` by default. An air space reaches from element to element, across a stop and other surfaces
    with air on both sides: elements touch neither at the axis nor at the rim, and a stop stands where its own rim is
    free (it may be inside the bulge of an element). The space before the image has no greatest thickness.
    """
    limits = limits_of(lens) if limits is None else limits
    total = torch.zeros_like(lens.surfaces[-2].thickness)
    for lack in _lacks(lens, limits):
        total = total + lack.clamp_min(0).square()
    return total


def _lacks(lens: Lens, limits: Limits) -> Iterator[Tensor]:
    """What each thickness lacks, at the axis and at the edge; negative where it has more than enough."""
    surfaces, media = lens.surfaces, _media(lens)
    air = [is_air(medium) for medium in media]
    bodies = [k for k in range(1, len(surfaces) - 1) if surfaces[k].is_mirror or not (air[k - 1] and air[k])]
    last, side = len(surfaces) - 1, 1
    start = None  # the element before the air space at hand
    for k in range(1, last):
        side = -side if surfaces[k].is_mirror else side
        before, after = surfaces[k], surfaces[k + 1]
        if k in bodies:
            start = k
        if not air[k]:
            yield from _outside(side * before.thickness, *limits.glass)
            yield from _edge(before, after, side, limits.edge)
            continue
        yield from _edge(before, after, side, 0.0)
        if start is None or k + 1 not in (*bodies, last):
            continue
        gap = torch.stack([surface.thickness for surface in surfaces[start : k + 1]]).sum()
        yield from _outside(side * gap, limits.air[0], limits.air[1] if k + 1 < last else math.inf)
        if start < k:
            yield from _edge(dataclasses.replace(surfaces[start], thickness=gap), after, side, 0.0)


def _media(lens: Lens) -> list[Glass]:
    """The medium behind every surface: behind a mirror, the one before it."""
    found: list[Glass] = []
    for surface in lens.surfaces:
        found.append(found[-1] if surface.is_mirror and found else surface.glass)
    return found


def _outside(thickness: Tensor, least: float, most: float) -> Iterator[Tensor]:
    yield least - thickness
    if math.isfinite(most):
        yield thickness - most


def _edge(before: Surface, after: Surface, side: int, least: float) -> Iterator[Tensor]:
    if before.semi_diameter and after.semi_diameter:
        yield least - side * edge_thickness(before, after)


def edge_thickness(before: Surface, after: Surface) -> Tensor:
    """Thickness in mm between two surfaces at the smaller of their semi-diameters."""
    height = before.thickness.new_tensor(min(before.semi_diameter, after.semi_diameter)) ** 2
    return before.thickness + sag(after, height) - sag(before, height)
