"""Elements and cemented groups of a lens, from the media between its surfaces, mirrors and phases; their diameters."""

import math
from collections.abc import Sequence

import torch

from raytrace.materials.glass import Glass, is_air
from raytrace.system.lens import Lens
from raytrace.system.surface import medium_surfaces


def lens_elements(lens: Lens) -> list[tuple[int, int]]:
    """First and last surface of every element: a run of one medium other than air, a mirror, or a phase in air.

    Elements of a cemented group share a surface: (1, 2) and (2, 3). A mirror inside glass, as that of a Mangin mirror,
    belongs to the glass. Planes and coordinate breaks inside a medium belong to it, those in air to none.
    """
    media, last = _media(lens), len(lens.surfaces) - 1
    elements, k = [], 1
    while k < last:
        surface = lens.surfaces[k]
        if not is_air(media[k]) and not surface.is_break and not _same(media[k], media[k - 1]):
            end = k + 1
            while end < last and _same(media[end], media[k]):
                end += 1
            elements.append((k, end))
            k = end if end < last and not is_air(media[end]) else end + 1
            continue
        if is_air(media[k]) and (surface.is_mirror or surface.phase is not None):
            elements.append((k, k))
        k += 1
    return elements


def cemented_groups(lens: Lens) -> list[tuple[int, int]]:
    """First and last surface of every group of elements that share surfaces."""
    groups: list[list[tuple[int, int]]] = []
    for element in lens_elements(lens):
        if groups and groups[-1][-1][1] == element[0]:
            groups[-1].append(element)
        else:
            groups.append([element])
    return [(group[0][0], group[-1][1]) for group in groups if len(group) > 1]


def polished_semi_diameters(lens: Lens, clear: Sequence[float]) -> list[float]:
    """mm of every surface, of its `clear` semi-diameter in mm and its chip zone: up to there it follows its sag."""
    return [size + (surface.chip_zone or 0.0) for size, surface in zip(clear, lens.surfaces, strict=True)]


def mechanical_semi_diameters(lens: Lens, clear: Sequence[float]) -> list[float]:
    """mm of the part at every surface, of `clear` semi-diameters in mm; nan where they are unknown.

    Fixed ones as stored; the others are the largest of the polished and the fixed ones of the element, or of the
    cemented group (all automatic ones that OpticStudio stores in public files).
    """
    polished = polished_semi_diameters(lens, clear)
    sizes = [s.mechanical_semi_diameter or size for s, size in zip(lens.surfaces, polished, strict=True)]
    if lens.optimization_data is not None and not lens.optimization_data.shares_mechanical:
        return sizes
    result = list(sizes)
    for first, last in [*lens_elements(lens), *cemented_groups(lens)]:
        faces = [k for k in range(first, last + 1) if not lens.surfaces[k].is_break]
        widest = max((sizes[k] for k in faces if not math.isnan(sizes[k])), default=math.nan)
        for k in faces:
            result[k] = lens.surfaces[k].mechanical_semi_diameter or widest
    return result


def _media(lens: Lens) -> list[Glass]:
    """The medium behind every surface; a mirror or a coordinate break keeps it."""
    return [lens.surfaces[number].glass for number in medium_surfaces(lens.surfaces)]


def _same(glass: Glass, other: Glass) -> bool:
    """Whether two media are alike, so that no ray refracts between them."""
    alike = (glass.name, glass.catalog, glass.formula) == (other.name, other.catalog, other.formula)
    return glass is other or (alike and torch.equal(glass.coefficients, other.coefficients))
