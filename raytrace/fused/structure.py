"""Structure: a run of surfaces as the compiled trace reads it, apart from the numbers that go with it.

A structure is a table of integers, one row a surface: its kind, what it does to light, and which of the numbers it
takes. The numbers are tensors, and autograd sees how they were put together.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.system.surface import Surface

_FIELDS = 18  # integers of a surface, see `Layout` in block.h
_MOST_TERMS = 16  # of an even asphere
_PLANE, _SPHERE, _CONIC, _ASPHERE = range(4)
_NONE, _REFRACT, _REFLECT = range(3)
_SHAPES = {"circular": 0.0, "rectangular": 1.0, "elliptic": 2.0}


@dataclasses.dataclass(frozen=True, eq=False)
class Structure:
    """Surfaces without their numbers.

    layout: (S, 18) int32; constants: (C,) float64, what no derivative is asked for: rims and apertures.
    """

    layout: np.ndarray
    constants: np.ndarray


def is_expressible(surface: Surface) -> bool:
    """Whether the compiled trace knows the surface: no departure, at most 16 aspheric terms."""
    return surface.departure is None and len(_terms(surface)) <= _MOST_TERMS


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
        bend = _REFLECT if surface.is_mirror else _NONE if n2 is n1 else _REFRACT
        terms, first_term, rim = _terms(surface), len(numbers), len(constants)
        numbers.extend(terms)
        constants.append(float("inf") if surface.semi_diameter is None else surface.semi_diameter)
        for aperture in surface.apertures:
            shape = _SHAPES[aperture.shape]
            constants += [shape, *aperture.extent, float(aperture.obscures), *aperture.centre]
        rows.append(
            [_kind(surface), bend, side, len(terms), len(surface.apertures), rim + 1]
            + [place(gap), place(surface.curvature), place(surface.conic), first_term, place(n1), place(n2), rim]
            + [0] * (_FIELDS - 13)
        )
        gap, side = surface.thickness, -side if surface.is_mirror else side
    return Structure(np.array(rows, dtype=np.int32), np.array(constants, dtype=np.float64)), numbers


def with_numbers(
    structure: Structure, surfaces: Sequence[Surface], numbers: Sequence[Tensor]
) -> tuple[list[Surface], list[Tensor], Tensor | None]:
    """Surfaces, indices and gap of a structure with these numbers in their places: `structure_of` undone."""

    def number(place: int) -> Tensor | None:
        return None if place < 0 else numbers[place]

    rows = structure.layout.tolist()
    gaps = [number(row[6]) for row in rows]
    own = []
    for row, surface, thickness in zip(rows, surfaces, [*gaps[1:], surfaces[-1].thickness], strict=True):
        terms = numbers[row[9] : row[9] + row[3]]
        own.append(
            dataclasses.replace(
                surface,
                thickness=thickness,
                curvature=number(row[7]),
                conic=number(row[8]),
                coefficients=surface.coefficients if not terms else torch.stack(list(terms)),
            )
        )
    return own, [numbers[rows[0][10]], *(numbers[row[11]] for row in rows)], gaps[0]


def _terms(surface: Surface) -> tuple[Tensor, ...]:
    return () if surface.coefficients is None else surface.coefficients.unbind(0)


def _kind(surface: Surface) -> int:
    if surface.coefficients is not None:
        return _ASPHERE
    if surface.curvature is None:
        return _PLANE
    return _SPHERE if surface.conic is None else _CONIC
