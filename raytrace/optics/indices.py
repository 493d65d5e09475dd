"""Indices: the media of a lens at wavelengths, as the trace takes them."""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.media import glass
from raytrace.system.lens import Lens, index_behind


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
