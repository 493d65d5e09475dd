"""What PARM and XDAT of a surface of a .zmx file are called in the lens: found by reading the surface at two values.

So a new type of surface brings the names of its numbers with it.
"""

import dataclasses
from typing import NamedTuple

from torch import Tensor

from raytrace.formats.zemax_numbers import Numbers, SurfaceType
from raytrace.system.configurations import Path, part, with_part
from raytrace.system.places import number_at, places
from raytrace.system.surface import Surface

#: Values far from what lenses have, exact in binary.
_PROBES = (0.34375, 0.40625)

#: The first datum of XDAT that is a term.
FIRST_TERM = 3


class Named(NamedTuple):
    """A number of the lens: its name in `places.places`, and factor · (number of the file, in mm) + offset, it is."""

    name: str
    factor: float
    offset: float

    @property
    def is_plain(self) -> bool:
        return (self.factor, self.offset) == (1.0, 0.0)


def names(surface: Surface, row: SurfaceType, told: Numbers, keyword: str, j: int) -> tuple[tuple[Named, ...], Surface]:
    """What PARM j, or XDAT j, of a surface is in the lens, and a surface in which all of that is modelled.

    row, told: its type and its numbers. Nothing for what is no number of the lens, as the order of tilts.
    """
    try:
        probed = [dataclasses.replace(surface, **row.fields(_with(row, told, keyword, j, one))) for one in _PROBES]
    except (KeyError, IndexError, ValueError):
        return (), surface
    found = []
    for name, place in places(probed[0]).items():
        one, other = (number_at(like, place) if name in places(like) else None for like in probed)
        if isinstance(one, Tensor) and isinstance(other, Tensor) and float(one) != float(other):
            factor = (float(other) - float(one)) / (_PROBES[1] - _PROBES[0])
            found.append(Named(name, factor, float(one) - factor * _PROBES[0]))
    return tuple(found), probed[0]


def _with(row: SurfaceType, told: Numbers, keyword: str, j: int, number: float) -> Numbers:
    """The numbers with another one. Raises KeyError, IndexError for what the type does not have."""
    if keyword == "PARM":
        if j not in row.parameters:
            raise KeyError(j)
        return told._replace(parameters={**told.parameters, j: number})
    if told.terms is None or j < FIRST_TERM:
        raise IndexError(j)
    terms = told.terms.clone()
    terms[j - FIRST_TERM] = number
    return told._replace(terms=terms)


def listed(row: SurfaceType, told: Numbers) -> list[tuple[str, int]]:
    """Every PARM and XDAT that a surface of a type has."""
    data = 0 if told.terms is None else len(told.terms)
    return [*(("PARM", j) for j in row.parameters), *(("XDAT", FIRST_TERM + k) for k in range(data))]


def path_of(surface: Surface, name: str) -> Path | None:
    """Where a surface holds a number of a name; None of one that it has no room for."""
    place = places(surface).get(name)
    if place is None:
        return None
    entry = () if place.entry is None else ((place.entry,),)
    return (*place.path, *entry)


def with_room(surface: Surface, name: str, like: Surface, zero: Tensor) -> Surface:
    """The surface with a number of a name modelled, 0 where it was not, as `like` has it."""
    path = ("thickness",) if name == "thickness" else path_of(like, name)
    if path is None or part(surface, path) is not None:
        return surface
    return with_part(surface, path, zero, like=like)
