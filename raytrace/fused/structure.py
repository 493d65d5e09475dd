"""Structure: a run of surfaces as the compiled trace reads it, apart from the numbers that go with it.

A structure is a table of integers, one row a surface: its kind, what it does to light, and which of the numbers it
takes. The numbers are tensors, and autograd sees how they were put together.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.system.aperture import SHAPES
from raytrace.system.shapes import KINDS
from raytrace.system.surface import Surface, is_posed

_PLANE, _SPHERE, _CONIC = range(3)  # and the codes of shapes.KINDS
_NONE, _REFRACT, _REFLECT = range(3)


class _Row(NamedTuple):
    """`Layout` of block.h: the first six are told there, the others are places of numbers, -1 where there is none."""

    kind: int
    bend: int
    side: int
    terms: int
    apertures: int
    first_aperture: int
    gap: int
    curvature: int
    conic: int
    coefficients: int
    before: int
    behind: int
    rim: int


@dataclasses.dataclass(frozen=True, eq=False)
class Structure:
    """Surfaces without their numbers.

    layout: (S, 13) int32, a `_Row` each; constants: (C,) float64, what no derivative is asked for: rims and apertures.
    """

    layout: np.ndarray
    constants: np.ndarray


def is_expressible(surface: Surface) -> bool:
    """Whether the compiled trace knows the surface: kind and apertures compiled, no departure, not too many terms."""
    if surface.phase is not None or is_posed(surface):
        return False
    if surface.departure is not None or any(SHAPES[aperture.shape].code is None for aperture in surface.apertures):
        return False
    kind = KINDS[surface.kind]
    return surface.coefficients is None or (kind.code is not None and len(surface.coefficients) <= kind.compiled)


def structure_of(
    surfaces: Sequence[Surface], indices: Sequence[Tensor], side: int, gap: Tensor | None
) -> tuple[Structure, list[Tensor]]:
    """The structure of a run of surfaces, and the tensors (...) it counts as its numbers; arguments as for `steps`."""
    numbers: list[Tensor] = []
    places: dict[int, int] = {}
    constants: list[float] = []

    def place(number: Tensor | None) -> int:
        if number is None:
            return -1
        if id(number) not in places:
            places[id(number)] = len(numbers)
            numbers.append(number)
        return places[id(number)]

    rows = []
    for surface, n1, n2 in zip(surfaces, indices[:-1], indices[1:], strict=True):
        terms = () if surface.coefficients is None else surface.coefficients.unbind(0)
        first_term, rim = len(numbers), len(constants)
        numbers.extend(terms)
        constants.append(float("inf") if surface.semi_diameter is None else surface.semi_diameter)
        for aperture in surface.apertures:
            sizes = aperture.extent
            constants += [SHAPES[aperture.shape].code, float(aperture.obscures), *aperture.centre, len(sizes), *sizes]
        rows.append(
            _Row(
                kind=_kind(surface),
                bend=_REFLECT if surface.is_mirror else _NONE if n2 is n1 else _REFRACT,
                side=side,
                terms=len(terms),
                apertures=len(surface.apertures),
                first_aperture=rim + 1,
                gap=place(gap),
                curvature=place(surface.curvature),
                conic=place(surface.conic),
                coefficients=first_term,
                before=place(n1),
                behind=place(n2),
                rim=rim,
            )
        )
        gap, side = surface.thickness, -side if surface.is_mirror else side
    return Structure(np.array(rows, dtype=np.int32), np.array(constants, dtype=np.float64)), numbers


def with_numbers(
    structure: Structure, surfaces: Sequence[Surface], numbers: Sequence[Tensor]
) -> tuple[list[Surface], list[Tensor], Tensor | None]:
    """Surfaces, indices and gap of a structure with these numbers in their places: `structure_of` undone."""

    def number(place: int) -> Tensor | None:
        return None if place < 0 else numbers[place]

    rows = [_Row(*row) for row in structure.layout.tolist()]
    gaps = [number(row.gap) for row in rows]
    own = []
    for row, surface, thickness in zip(rows, surfaces, [*gaps[1:], surfaces[-1].thickness], strict=True):
        terms = numbers[row.coefficients : row.coefficients + row.terms]
        own.append(
            dataclasses.replace(
                surface,
                thickness=thickness,
                curvature=number(row.curvature),
                conic=number(row.conic),
                coefficients=surface.coefficients if not terms else torch.stack(list(terms)),
            )
        )
    return own, [numbers[rows[0].before], *(numbers[row.behind] for row in rows)], gaps[0]


def _kind(surface: Surface) -> int:
    if surface.coefficients is not None:
        return KINDS[surface.kind].code
    if surface.curvature is None:
        return _PLANE
    return _SPHERE if surface.conic is None else _CONIC
