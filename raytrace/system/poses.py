"""Pose: position and tilt of the axes of a surface, and vectors in them.

    old = d + Rx Ry Rz new          decentre first, the usual order
    old = Rz Ry Rx (new + d)        tilts first, which undoes the other with every number negated

d = (x, y, z), and R turn about the axes of x, y and z by right-handed angles: OpticStudio's coordinate break of order 0
and 1. Numbers that are None are not modelled.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from raytrace.maths.numerics import value


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
    """The gap to the next surface: the pose behind this one, then a thickness (...) mm along the new axis."""

    pose: Pose
    thickness: Tensor


@value
class Turn:
    """A passage of the compiled trace: new = rotation · old + shift.

    rotation: (3, 3, ...); shift: (3, ...) mm; path: (...) mm of the axial ray, which is subtracted.
    """

    rotation: Tensor
    shift: Tensor
    path: Tensor


#: The plane of each tilt, from its first axis to its second.
_TURNS = {"tilt_x": (1, 2), "tilt_y": (2, 0), "tilt_z": (0, 1)}

Vector = Sequence[Tensor]


def point_in(pose: Pose | Turn, point: Vector) -> Vector:
    """A point (x, y, z) of (...) mm each, in the new axes."""
    if isinstance(pose, Turn):
        return [turned + step for turned, step in zip(direction_in(pose, point), pose.shift, strict=True)]
    if pose.tilts_first:
        return _moved(pose, direction_in(pose, point))
    return direction_in(pose, _moved(pose, point))


def direction_in(pose: Pose | Turn, direction: Vector) -> Vector:
    """A direction, by components (...), in the new axes."""
    if isinstance(pose, Turn):
        x, y, z = direction
        return [row[0] * x + row[1] * y + row[2] * z for row in pose.rotation]
    for name in reversed(_TURNS) if pose.tilts_first else _TURNS:
        tilt = getattr(pose, name)
        if tilt is not None:
            cosine, sine = cos_sin(torch.as_tensor(tilt))
            (i, j), old, direction = _TURNS[name], direction, list(direction)
            direction[i] = cosine * old[i] + sine * old[j]
            direction[j] = cosine * old[j] - sine * old[i]
    return direction


def point_out(pose: Pose, point: Vector) -> Vector:
    """A point of the new axes in the old ones: inverse of `point_in`."""
    return point_in(undone(pose), point)


def direction_out(pose: Pose, direction: Vector) -> Vector:
    """A direction of the new axes in the old ones: inverse of `direction_in`."""
    return direction_in(undone(pose), direction)


def undone(pose: Pose) -> Pose:
    """The inverse pose."""
    numbers = {name: number for name in ("x", "y", "z", *_TURNS) if (number := getattr(pose, name)) is not None}
    negated: dict[str, Any] = {name: -number for name, number in numbers.items()}
    return dataclasses.replace(pose, tilts_first=not pose.tilts_first, **negated)


def _moved(pose: Pose, point: Vector) -> Vector:
    steps = (pose.x, pose.y, pose.z)
    return [old if step is None else old - step for old, step in zip(point, steps, strict=True)]


def cos_sin(degrees: Tensor) -> tuple[Tensor, Tensor]:
    """cos and sin (...) of an angle in degrees, exactly 0 and ±1 at multiples of 90°, such as the angle of a fold."""
    radians = torch.deg2rad(degrees)
    cosine, sine = torch.cos(radians), torch.sin(radians)
    quarter = torch.remainder(degrees.detach(), 180.0)
    cosine = cosine - torch.where(quarter == 90, cosine, 0.0).detach()
    return cosine, sine - torch.where(quarter == 0, sine, 0.0).detach()


#: A constant or a tensor.
Number = float | Tensor


#: New = rotation · old + shift as rows (3, 4); entries that are 0 or 1 for all angles stay constants.
Rows = list[list[Number]]


def passage(gap: Tensor | Gap | None, before: Pose | None) -> Rows:
    """`point_in` along a gap and a pose as the rows of rotation and shift (3, 4): [x, y, z, 1] -> new.

    Entries that are 0 or 1 for all angles stay constants, without operators.
    """
    steps = [gap.pose, gap.thickness] if isinstance(gap, Gap) else [gap]
    return rows_along([*steps, before])


def rows_along(steps: Sequence[Pose | Tensor | None]) -> Rows:
    """The rows of poses and thicknesses (...) mm in sequence; None is no step."""
    rows: Rows = [[1.0 if i == j else 0.0 for j in range(4)] for i in range(3)]
    for step in steps:
        if isinstance(step, Pose):
            rows = _through(step, rows)
        elif step is not None:
            rows[2] = [*rows[2][:3], _sum(rows[2][3], -step)]
    return rows


def rows_back(rows: Rows) -> Rows:
    """The inverse rows: new = rotationᵀ · (old - shift)."""
    turned = [[rows[j][i] for j in range(3)] for i in range(3)]
    return [[*row, _negative(_dot(row, [entry[3] for entry in rows]))] for row in turned]


def rows_of_both(first: Rows, second: Rows) -> Rows:
    """The rows of two passages in sequence."""
    columns = list(zip(*first, strict=True))
    return [
        [_sum(_dot(row[:3], column), row[3] if j == 3 else 0.0) for j, column in enumerate(columns)] for row in second
    ]


def pose_of(rows: Rows) -> Pose:
    """The pose, decentred first, of a passage: old = d + A new, A = Rx Ry Rz.

        d = -A shift,  tan tilt_x = -A_yz/A_zz,  tan tilt_y = A_xz/√(A_xx² + A_xy²),  tan tilt_z = -A_xy/A_xx

    Numbers that are 0 for all angles are None. At tilt_y = ±90° the tilts are not unique and have no derivative.
    """
    back = rows_back(rows)
    (xx, xy, xz, x), (_, _, yz, y), (_, _, zz, z) = back
    across = xx if isinstance(xy, float) and xy == 0.0 else torch.hypot(*torch.broadcast_tensors(*_tensors(xx, xy)))
    decentres: dict[str, Any] = {name: d for name, d in zip("xyz", (x, y, z), strict=True) if isinstance(d, Tensor)}
    tilts = _angle(_negative(yz), zz), _angle(xz, across), _angle(_negative(xy), xx)
    return Pose(tilt_x=tilts[0], tilt_y=tilts[1], tilt_z=tilts[2], **decentres)


def decentred_first(pose: Pose) -> Pose:
    """The same passage, decentred before it is tilted; tilts as those of `pose_of`."""
    return pose_of(rows_along([pose])) if pose.tilts_first else pose


def tilted_first(pose: Pose) -> Pose:
    """The same passage, tilted before it is decentred: old = Rz Ry Rx (new + d); tilts as those of `pose_of`."""
    return pose if pose.tilts_first else undone(pose_of(rows_along([undone(pose)])))


def without_z(pose: Pose) -> Pose | None:
    """The pose without its decentre along z; None where that is all."""
    numbers = (pose.x, pose.y, pose.tilt_x, pose.tilt_y, pose.tilt_z)
    return None if all(number is None for number in numbers) else dataclasses.replace(pose, z=None)


def _angle(sine: Number, cosine: Number) -> Tensor | None:
    """The angle in degrees; None where it is 0 for all."""
    if isinstance(sine, float) and sine == 0.0:
        return None
    return torch.rad2deg(torch.atan2(*torch.broadcast_tensors(*_tensors(sine, cosine))))


def _tensors(*numbers: Number) -> list[Tensor]:
    like = next(number for number in numbers if isinstance(number, Tensor))
    return [number if isinstance(number, Tensor) else like.new_tensor(number) for number in numbers]


def _negative(number: Number) -> Number:
    return 0.0 if isinstance(number, float) and number == 0.0 else -number


def _dot(row: Sequence[Number], column: Sequence[Number]) -> Number:
    total: Number = 0.0
    for a, b in zip(row, column, strict=True):
        total = _sum(total, (b if a == 1.0 else 0.0) if isinstance(a, float) else _product(a, b))
    return total


def _through(pose: Pose, rows: Rows) -> Rows:
    def shifted(rows: Rows) -> Rows:
        steps = [0.0 if step is None else -step for step in (pose.x, pose.y, pose.z)]
        return [[*row[:3], _sum(row[3], step)] for row, step in zip(rows, steps, strict=True)]

    rows = rows if pose.tilts_first else shifted(rows)
    for name in reversed(_TURNS) if pose.tilts_first else _TURNS:
        tilt = getattr(pose, name)
        if tilt is not None:
            cosine, sine = cos_sin(torch.as_tensor(tilt))
            back, (i, j), old, rows = -sine, _TURNS[name], rows, list(rows)
            pairs = list(zip(old[i], old[j], strict=True))
            rows[i] = [_sum(_product(cosine, a), _product(sine, b)) for a, b in pairs]
            rows[j] = [_sum(_product(cosine, b), _product(back, a)) for a, b in pairs]
    return shifted(rows) if pose.tilts_first else rows


def _product(factor: Tensor, number: Number) -> Number:
    if isinstance(number, float):
        return factor if number == 1.0 else 0.0
    return factor * number


def _sum(a: Number, b: Number) -> Number:
    if isinstance(a, float) and a == 0.0:
        return b
    return a if isinstance(b, float) and b == 0.0 else a + b
