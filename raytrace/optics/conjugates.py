"""Conjugates: the point that each ideal lens of a lens images, by which the path through it is told."""

import dataclasses

import torch
from torch import Tensor

from raytrace.optics.indices import media
from raytrace.system.lens import Lens
from raytrace.system.phases import IdealLens, power_of
from raytrace.system.surface import Surface, vertex_curvature


def sequence_of(lens: Lens) -> tuple[Surface, ...]:
    """The surfaces after the object as they are traced: ideal lenses know the vergence of the axial object point.

    It is that of the straightened paraxial ray at the primary wavelength, which leaves the axis there.
    """
    surfaces = lens.surfaces[1:]
    if not any(isinstance(surface.phase, IdealLens) for surface in surfaces):
        return surfaces
    found = zip(surfaces, _vergences(lens), strict=True)
    return tuple(_imaging(surface, vergence) for surface, vergence in found)


def _imaging(surface: Surface, vergence: Tensor) -> Surface:
    if not isinstance(surface.phase, IdealLens):
        return surface
    return dataclasses.replace(surface, phase=dataclasses.replace(surface.phase, vergence=vergence))


def _vergences(lens: Lens) -> list[Tensor]:
    """u/y in 1/mm of the marginal ray before every surface after the object, along the light."""
    wavelength = lens.wavelengths[lens.primary_wavelength]
    indices, surfaces, side = media(lens, wavelength), lens.surfaces[1:], 1
    y, omega = torch.ones_like(indices[0]), indices[0] / lens.surfaces[0].thickness
    found = []
    for surface, n1, n2 in zip(surfaces, indices[:-1], indices[1:], strict=True):
        apart = torch.where(y == 0, torch.finfo(y.dtype).tiny ** 0.5, y)
        found.append(omega / (n1 * apart))
        behind = -side if surface.is_mirror else side
        power = vertex_curvature(surface) * (behind * n2 - side * n1)
        power = power if surface.phase is None else power + power_of(surface.phase, wavelength)[1]
        omega = omega - power * y
        y, side = y + surface.thickness * omega / (behind * n2), behind
    return found
