"""What the types of surface of a .zmx file are told by: PARM, XDAT, decentres and tilts, and units of length.

PARM j is a number; XDAT 1 counts further terms, XDAT 2 is the radius they are normalised by, and XDAT 3 is the first of
them. Every length is a power of the file's unit, which the row of a type knows.
"""

import dataclasses
from collections.abc import Callable, Mapping
from decimal import Context, Decimal
from fractions import Fraction
from typing import NamedTuple

from torch import Tensor

from raytrace.io.spelling import double
from raytrace.system.poses import Pose
from raytrace.system.surface import Surface


class Numbers(NamedTuple):
    """PARM by number, and the terms of XDAT with the radius they are normalised by; lengths in mm.

    size: the surface's semi-diameter.
    """

    parameters: Mapping[int, float | Tensor]
    terms: Tensor | None = None
    radius: float | Tensor = 1.0
    size: float | None = None

    def at(self, j: int) -> float:
        """PARM j, 0 if it is not told."""
        return self.parameters.get(j, 0.0)


#: In place of a power of the unit: a length that the lens knows by its reciprocal, 0 for a length of 0.
INVERSE = None


@dataclasses.dataclass(frozen=True)
class SurfaceType:
    """A TYPE.

    name: what OpticStudio calls it; holds: fields of a surface's shape that it has.
    parameters: power of the file's unit of every PARM that is used; unused: PARM that are known and bend no ray.
    terms: power of the unit of the terms in XDAT, None if it has none; most: how many.
    fields: numbers -> fields of `Surface`, None for one whose shape is all; ValueError for numbers out of range.
    numbers: surface -> numbers, `fields` undone.
    beyond: numbers -> what is not modelled of them, "" if all is; flat: whether a curvature is not.
    powers: what the parameters stand for, in words.
    """

    name: str
    holds: tuple[str, ...] = ("curvature", "conic")
    parameters: Mapping[int, int | None] = dataclasses.field(default_factory=dict)
    unused: Mapping[int, str] = dataclasses.field(default_factory=dict)
    terms: int | None = None
    most: int = 0
    fields: Callable[[Numbers], dict] = lambda numbers: {}
    numbers: Callable[[Surface], Numbers] = lambda surface: Numbers({})
    beyond: Callable[[Numbers], str] = lambda numbers: ""
    flat: bool = False
    powers: str = ""


# -- poses ------------------------------------------------------------------------------------------------------------

_POSE = ("x", "y", "tilt_x", "tilt_y", "tilt_z")


def pose_of(numbers: list[float], order: int) -> Pose | None:
    """The pose of decentres x, y in mm and tilts about x, y, z in degrees; what is 0 is not modelled."""
    told = {name: double(number) for name, number in zip(_POSE, numbers, strict=True) if number}
    return Pose(**told, tilts_first=order != 0) if told else None


def numbers_of(pose: Pose | None) -> list[Tensor | float]:
    """`pose_of` undone: decentres and tilts. Raises ValueError for a decentre along z."""
    if pose is not None and pose.z is not None:
        raise ValueError("a decentre along z; add it to the thickness before")
    return [0.0 if (number := getattr(pose, name, None)) is None else number for name in _POSE]


def order_is_known(number: float) -> bool:
    """Whether decentre and tilts come in one of the two orders."""
    return number in (0, 1)


# -- reciprocals, to the last bit -------------------------------------------------------------------------------------


def inverse(text: str, millimetres: float) -> float:
    """1/length in 1/mm of the text of a length, rounded once; 0 of a length of 0. OverflowError where it is too large.

    The text is taken as it stands, with all its digits: of two neighbouring numbers not both are the reciprocal of one
    of 53 bits.
    """
    length = Fraction(text.replace("D", "e").replace("d", "e")) * Fraction(repr(millimetres))
    return float(1 / length) if length else 0.0


def spelled_inverse(number: float) -> str:
    """A length whose `inverse` in mm is the number: the shortest that a 64-bit number has, or one of more digits."""
    if not number:
        return "0.0"
    text = repr(float(1 / Fraction(number)))
    return text if inverse(text, 1.0) == number else str(Context(prec=40).divide(Decimal(1), Decimal(number)))
