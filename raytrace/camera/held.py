"""Held: one number of a lens solved for, so that the focal length stays whatever else of the lens varies.

The power φ of a lens is linear in the curvature and the thickness of each of its surfaces (Gauss's brackets), and so in
any one such number v: φ(0) + v [φ(1) - φ(0)] = |n′|/f. The one that holds f is found at once, with its derivatives. A
power is finite where the lens is afocal, as a singlet is without its one bent surface.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from raytrace.optics.paraxial import first_order
from raytrace.optics.trace import media
from raytrace.system.lens import Lens
from raytrace.system.naming import BadVariables

_Variable = TypeVar("_Variable")
_NOTHING = 1e-9  # part of the power: what a number changes less does not change


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
        length = _length(match[1]) if match[1] else float(first_order(lens).effective_focal_length)
    except (TypeError, ValueError):
        raise BadVariables(
            f"hold {hold!r}: expected efl, the focal length of the file, or one in mm as efl=100"
        ) from None
    for variable in reversed(variables):
        power, change = (part.abs() for part in _line(lens, lambda v, one=variable: with_value(lens, one, v)))
        if bool(change > _NOTHING * power):
            return Held(length, variable)
    raise BadVariables(
        f"hold {hold!r}: none of the variables changes the focal length; vary a thickness or a curvature"
    )


def _length(text: str) -> float:
    """A focal length in mm, negative for a lens that spreads light. Raises ValueError for 0 and ∞."""
    length = float(text)
    if length == 0 or not math.isfinite(length):
        raise ValueError(text)
    return length


def solved(like: Lens, focal_length: float, with_value: Callable[[Tensor], Lens]) -> Tensor:
    """The number () that gives a lens its focal length in mm. with_value: the lens with that number at a value."""
    at_zero, change = _line(like, with_value)
    wavelength = like.primary
    *_, index, _ = media(like, wavelength)
    return (index.abs() / focal_length - at_zero) / change


def _line(like: Lens, with_value: Callable[[Tensor], Lens]) -> tuple[Tensor, Tensor]:
    """The power at 0, and what it changes by to 1; 1/mm."""
    zero = torch.zeros_like(like.surfaces[-2].thickness)
    at_zero, at_one = (first_order(with_value(zero + k)).power for k in range(2))
    return at_zero, at_one - at_zero
