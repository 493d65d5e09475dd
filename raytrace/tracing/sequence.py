"""Sequence: what a lens is traced as, its surfaces after the object and the media between them."""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.materials import glass
from raytrace.system.lens import Lens, index_behind
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
    wavelength = lens.primary
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


def media(lens: Lens, wavelength: Tensor) -> list[Tensor]:
    """Refractive index behind every surface, object first; positive also behind a mirror.

    wavelength: (...) µm; returns one tensor (...) for each surface of the lens, in the lens's dtype. A medium that
    does not change is the same tensor, which tells `cross` that nothing bends.
    """
    if lens.environment is not None or any(surface.environment is not None for surface in lens.surfaces):
        return _media_in_environment(lens, wavelength)
    media: list[glass.Glass] = []
    for surface in lens.surfaces:
        same = media and (surface.is_mirror or surface.is_break or _same_medium(surface.glass, media[-1]))
        media.append(media[-1] if same else surface.glass)
    # Air stands between all elements: each medium is evaluated once, and none for a surface that keeps the one before.
    distinct = {(medium.formula, id(medium.coefficients)): medium for medium in media}
    dtype = lens.surfaces[-2].thickness.dtype
    found = _refractive_indices(list(distinct.values()), wavelength)
    by_medium = dict(zip(distinct, (n.to(dtype) for n in found), strict=True))
    return [by_medium[medium.formula, id(medium.coefficients)] for medium in media]


def _media_in_environment(lens: Lens, wavelength: Tensor) -> list[Tensor]:
    """`media` of a lens at a temperature and a pressure."""
    found: list[Tensor] = []
    by_medium: dict[tuple, Tensor] = {}
    for number, surface in enumerate(lens.surfaces):
        if found and (surface.is_mirror or surface.is_break):
            found.append(found[-1])
            continue
        key = (surface.glass.formula, id(surface.glass.coefficients), surface.glass.records, id(surface.environment))
        if key not in by_medium:
            by_medium[key] = index_behind(lens, number, wavelength).to(lens.surfaces[-2].thickness.dtype)
        found.append(by_medium[key])
    return found


def _refractive_indices(glasses: Sequence[glass.Glass], wavelength: Tensor) -> list[Tensor]:
    """n of each glass, as `refractive_index` gives it; glasses of one formula are evaluated together."""
    groups: dict[object, list[int]] = {}
    for number, medium in enumerate(glasses):
        together = medium.formula not in ("mirror", "constant") and medium.coefficients.dim() == 1
        groups.setdefault((medium.formula, len(medium.coefficients)) if together else number, []).append(number)
    found: dict[int, Tensor] = {}
    for numbers in groups.values():
        if len(numbers) == 1:
            found[numbers[0]] = glass.refractive_index(glasses[numbers[0]], wavelength)
            continue
        stacked = torch.stack([glasses[number].coefficients for number in numbers], -1)
        stacked = stacked.reshape(*stacked.shape, *(1,) * wavelength.dim())
        indices = glass.refractive_index(
            dataclasses.replace(glasses[numbers[0]], coefficients=stacked), wavelength[None]
        )
        found |= dict(zip(numbers, indices.unbind(0), strict=True))
    return [found[number] for number in range(len(glasses))]


def _same_medium(a: glass.Glass, b: glass.Glass) -> bool:
    return a is b or (a.formula == b.formula and a.coefficients is b.coefficients)
