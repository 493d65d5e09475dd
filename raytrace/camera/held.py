"""Held: one number of a lens solved for, so that the focal length stays whatever else of the lens varies.

The power of a lens is linear in the curvature and the thickness of each of its surfaces (Gauss's brackets), and so is
1/f in any one such number v: 1/f(v) = 1/f(0) + v [1/f(1) - 1/f(0)]. The one that holds f is found at once, with its
derivatives.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from raytrace.optics.paraxial import first_order
from raytrace.system.lens import Lens
from raytrace.system.naming import BadVariables

_Variable = TypeVar("_Variable")
_NOTHING = 1e-9  # part of 1/f: what a number changes less does not change


@dataclass(frozen=True)
class Held:
    """A focal length in mm, and the variable that is solved for it."""

    focal_length: float
    by: object


def held(
    hold: str, lens: Lens, variables: tuple[_Variable, ...], with_value: Callable[[Lens, _Variable, Tensor], Lens]
) -> Held | None:
    """What "efl" (as the lens has it) or "efl=100" asks for, by the last variable that changes it; None for nothing.

    with_value: the lens with a variable at another value. Raises BadVariables.
    """
    if not hold:
        return None
    match = re.fullmatch(r"efl(?:=([-+.\deE]+))?", hold)
    try:
        length = float(first_order(lens).effective_focal_length) if not match[1] else float(match[1])
    except (TypeError, ValueError):
        raise BadVariables(
            f"hold {hold!r}: expected efl, the focal length of the file, or one in mm as efl=100"
        ) from None
    for variable in reversed(variables):
        vergence, change = (part.abs() for part in _line(lens, lambda v, one=variable: with_value(lens, one, v)))
        if bool(change > _NOTHING * vergence):
            return Held(length, variable)
    raise BadVariables(
        f"hold {hold!r}: none of the variables changes the focal length; vary a thickness or a curvature"
    )


def solved(like: Lens, focal_length: float, with_value: Callable[[Tensor], Lens]) -> Tensor:
    """The number () that gives a lens its focal length in mm. with_value: the lens with that number at a value."""
    at_zero, change = _line(like, with_value)
    return (1 / focal_length - at_zero) / change


def _line(like: Lens, with_value: Callable[[Tensor], Lens]) -> tuple[Tensor, Tensor]:
    """1/f at 0, and what it changes by to 1; 1/mm."""
    zero = torch.zeros_like(like.surfaces[-2].thickness)
    at_zero, at_one = (1 / first_order(with_value(zero + k)).effective_focal_length for k in range(2))
    return at_zero, at_one - at_zero
