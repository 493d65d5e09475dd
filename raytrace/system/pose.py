"""Pose: where the axes of a surface stand, decentred and tilted, and vectors told in them.

    old = d + Rx Ry Rz new          decentre first, the usual order
    old = Rz Ry Rx (new + d)        tilts first, which undoes the other with every number negated

d = (x, y, z), and R turn about the axes of x, y and z by right-handed angles: OpticStudio's coordinate break of order 0
and 1. What is None is not modelled, and costs nothing.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths.value import value


@value
class Pose:
    """A decentre x, y, z (...) mm and tilts (...) about the axes of x, y and z in degrees; each None if there is none.

    tilts_first: whether the axes are tilted, about z, y and x in turn, before they are decentred.
    """

    x: Tensor | None = None
    y: Tensor | None = None
    z: Tensor | None = None
    tilt_x: Tensor | None = None
    tilt_y: Tensor | None = None
    tilt_z: Tensor | None = None
    tilts_first: bool = False


@value
class Gap:
    """What lies between a surface and the next: its pose behind it, then a thickness (...) mm along the new axis."""

    pose: Pose
    thickness: Tensor


#: About which of the axes a tilt turns, and between which: from the first of the two to the second.
_TURNS = {"tilt_x": (1, 2), "tilt_y": (2, 0), "tilt_z": (0, 1)}

Vector = Sequence[Tensor]


def point_in(pose: Pose, point: Vector) -> Vector:
    """A point (x, y, z) of (...) mm each, told in the new axes."""
    if pose.tilts_first:
        return _moved(pose, direction_in(pose, point))
    return direction_in(pose, _moved(pose, point))


def direction_in(pose: Pose, direction: Vector) -> Vector:
    """A direction, by components (...), told in the new axes."""
    for name in reversed(_TURNS) if pose.tilts_first else _TURNS:
        tilt = getattr(pose, name)
        if tilt is not None:
            direction = _turned(direction, tilt, _TURNS[name])
    return direction


def point_out(pose: Pose, point: Vector) -> Vector:
    """A point told in the new axes, told in the old ones: `point_in` undone."""
    return point_in(undone(pose), point)


def direction_out(pose: Pose, direction: Vector) -> Vector:
    """A direction told in the new axes, told in the old ones: `direction_in` undone."""
    return direction_in(undone(pose), direction)


def undone(pose: Pose) -> Pose:
    """The pose that leads back."""
    numbers = {name: getattr(pose, name) for name in ("x", "y", "z", *_TURNS)}
    back = {name: None if number is None else -number for name, number in numbers.items()}
    return Pose(**back, tilts_first=not pose.tilts_first)


def _moved(pose: Pose, point: Vector) -> Vector:
    steps = (pose.x, pose.y, pose.z)
    return [at if step is None else at - step for at, step in zip(point, steps, strict=True)]


def _turned(vector: Vector, degrees: Tensor, plane: tuple[int, int]) -> Vector:
    """The vector in axes that are turned in a plane, from its first axis to its second."""
    cosine, sine = cos_sin(torch.as_tensor(degrees))
    i, j = plane
    found = list(vector)
    found[i] = cosine * vector[i] + sine * vector[j]
    found[j] = cosine * vector[j] - sine * vector[i]
    return found


def cos_sin(degrees: Tensor) -> tuple[Tensor, Tensor]:
    """cos and sin (...) of an angle in degrees, exactly 0 and ±1 at whole right angles: a fold of 90° is one."""
    radians = torch.deg2rad(degrees)
    cosine, sine = torch.cos(radians), torch.sin(radians)
    quarter = torch.remainder(degrees.detach(), 180.0)
    cosine = cosine - torch.where(quarter == 90, cosine, 0.0).detach()
    return cosine, sine - torch.where(quarter == 0, sine, 0.0).detach()
