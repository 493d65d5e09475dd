"""Frames: where the vertex of every surface stands, and how it is turned, in the axes that rays start in."""

import torch
from torch import Tensor

from raytrace.maths.value import value
from raytrace.system.lens import Lens
from raytrace.system.poses import Pose, direction_out, point_out


@value
class Frame:
    """The axes of a surface: its vertex (3,) mm, and by columns (3, 3) the directions of its x, y and z."""

    origin: Tensor
    axes: Tensor

    def outside(self, point: Tensor) -> Tensor:
        """A point (3, ...) mm of the surface, told in the axes that rays start in."""
        return self.along(point) + self.origin.reshape(3, *(1,) * (point.dim() - 1))

    def along(self, direction: Tensor) -> Tensor:
        """A direction (3, ...), told in the axes that rays start in."""
        return torch.tensordot(self.axes, direction, dims=1)

    def inside(self, point: Tensor) -> Tensor:
        """A point (3, ...) mm, told in the axes of the surface."""
        moved = point - self.origin.reshape(3, *(1,) * (point.dim() - 1))
        return torch.tensordot(self.axes.T, moved, dims=1)


def frames(lens: Lens) -> list[Frame]:
    """The frame of every surface after its pose, in that of surface 1 before its own; the object's may be at -inf."""
    distance = lens.surfaces[0].thickness
    axes = torch.eye(3, dtype=distance.dtype, device=distance.device)
    here = Frame(torch.zeros_like(axes[0]), axes)
    found = [Frame(-distance * axes[2], axes)]
    for surface in lens.surfaces[1:]:
        here = _posed(here, surface.before)
        found.append(here)
        here = _posed(here, surface.after)
        here = Frame(here.origin + surface.thickness * here.axes[:, 2], here.axes)
    return found


def _posed(frame: Frame, pose: Pose | None) -> Frame:
    if pose is None:
        return frame
    one = torch.eye(3, dtype=frame.axes.dtype, device=frame.axes.device)
    zero = list(torch.zeros_like(one[0]))
    vertex = torch.stack(list(point_out(pose, zero)))
    turned = torch.stack([torch.stack(list(direction_out(pose, list(axis)))) for axis in one], 1)
    return Frame(frame.outside(vertex), frame.axes @ turned)
