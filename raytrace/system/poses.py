"""Pose: position and tilt of the axes of a surface, and vectors in them.

    old = d + Rx Ry Rz new          decentre first, the usual order
    old = Rz Ry Rx (new + d)        tilts first, which undoes the other with every number negated

d = (x, y, z), and R turn about the axes of x, y and z by right-handed angles: OpticStudio's coordinate break of order 0
and 1. Numbers that are None are not modelled, and cost nothing.
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


@value
class Turn:
    """A passage by its numbers, as the compiled trace takes it: new = rotation · old + shift.

    rotation: (3, 3, ...); shift: (3, ...) mm; path: (...) mm, that of the axial ray along the way, which drops out.
    """

    rotation: Tensor
    shift: Tensor
    path: Tensor


#: About which of the axes a tilt turns, and between which: from the first of the two to the second.
_TURNS = {"tilt_x": (1, 2), "tilt_y": (2, 0), "tilt_z": (0, 1)}

Vector = Sequence[Tensor]


def point_in(pose: Pose | Turn, point: Vector) -> Vector:
    """A point (x, y, z) of (...) mm each, in the new axes."""
    if isinstance(pose, Turn):
        return [at + step for at, step in zip(direction_in(pose, point), pose.shift, strict=True)]
    if pose.tilts_first:
        return _moved(pose, direction_in(pose, point))
    return direction_in(pose, _moved(pose, point))


def direction_in(pose: Pose | Turn, direction: Vector) -> Vector:
    """A direction, by components (...), in the new axes."""
    if isinstance(pose, Turn):
        return [sum(r * d for r, d in zip(row, direction, strict=True)) for row in pose.rotation]
    for name in reversed(_TURNS) if pose.tilts_first else _TURNS:
        tilt = getattr(pose, name)
        if tilt is not None:
            direction = _turned(direction, tilt, _TURNS[name])
    return direction


def point_out(pose: Pose, point: Vector) -> Vector:
    """A point of the new axes in the old ones: inverse of `point_in`."""
    return point_in(undone(pose), point)


def direction_out(pose: Pose, direction: Vector) -> Vector:
    """A direction of the new axes in the old ones: inverse of `direction_in`."""
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


#: A number that is known for good, or a tensor.
Number = float | Tensor


def passage(gap: Tensor | Gap | None, before: Pose | None) -> list[list[Number]]:
    """What `point_in` does along a gap and a pose, as the rows of rotation and shift (3, 4): [x, y, z, 1] -> new.

    Entries that are 0 or 1 whatever the angles are stay such numbers, and no operator is spent on them.
    """
    rows: list[list[Number]] = [[1.0 if i == j else 0.0 for j in range(4)] for i in range(3)]
    if isinstance(gap, Gap):
        rows = _through(gap.pose, rows)
    thickness = gap.thickness if isinstance(gap, Gap) else gap
    if thickness is not None:
        rows[2] = [*rows[2][:3], _sum(rows[2][3], -thickness)]
    return rows if before is None else _through(before, rows)


def _through(pose: Pose, rows: list[list[Number]]) -> list[list[Number]]:
    steps = [0.0 if step is None else -step for step in (pose.x, pose.y, pose.z)]
    if not pose.tilts_first:
        rows = [[*row[:3], _sum(row[3], step)] for row, step in zip(rows, steps, strict=True)]
    for name in reversed(_TURNS) if pose.tilts_first else _TURNS:
        tilt = getattr(pose, name)
        if tilt is not None:
            rows = _rows_turned(rows, tilt, _TURNS[name])
    if pose.tilts_first:
        rows = [[*row[:3], _sum(row[3], step)] for row, step in zip(rows, steps, strict=True)]
    return rows


def _rows_turned(rows: list[list[Number]], degrees: Tensor, plane: tuple[int, int]) -> list[list[Number]]:
    cosine, sine = cos_sin(torch.as_tensor(degrees))
    back, (i, j) = -sine, plane
    found = list(rows)
    found[i] = [_sum(_product(cosine, a), _product(sine, b)) for a, b in zip(rows[i], rows[j], strict=True)]
    found[j] = [_sum(_product(cosine, b), _product(back, a)) for a, b in zip(rows[i], rows[j], strict=True)]
    return found


def _product(factor: Tensor, number: Number) -> Number:
    if isinstance(number, float):
        return factor if number == 1.0 else 0.0
    return factor * number


def _sum(a: Number, b: Number) -> Number:
    if isinstance(a, float) and a == 0.0:
        return b
    return a if isinstance(b, float) and b == 0.0 else a + b
