"""Rays: the value that travels through a lens."""

import torch
from torch import Tensor

from raytrace.maths.numerics import unit, value, with_batch_axes

#: Columns of a table of rays: mm in the frame of a surface, and direction cosines.
COLUMNS = ("x", "y", "z", "l", "m", "n")
#: Columns of a table of traced rays, a row for every surface that a ray reaches.
TRACED = ("ray", "surface", *COLUMNS, "opl", "status")


@value
class Rays:
    """A batch of rays in the vertex frame of one surface; any batch shape, components first.

    position: (3, ...) mm, relative to the vertex of the surface the rays are at.
    direction: (3, ...) unit vector of direction cosines (L, M, N); light travels towards +z until a mirror.
    valid: (...) bool. False once a ray missed a surface, was totally reflected or was vignetted; never NaN. A ray
        that missed or was totally reflected is replaced by an axial ray; a vignetted one keeps its coordinates.
    opl: (...) mm, the *reduced* optical path: Σ n·path less the path n·T·σ of the axial ray in every gap of
        thickness T (σ = ±1, its sign changed by every mirror), and less that of the object's distance. None when
        the path is not asked for, and then not computed.
    wavelength: µm, broadcast against the batch shape; None if the wavelength is passed to the tracer.
    """

    position: Tensor
    direction: Tensor
    valid: Tensor
    opl: Tensor | None = None
    wavelength: Tensor | None = None

    @property
    def shape(self) -> torch.Size:
        """Batch shape of the rays."""
        return self.direction.shape[1:]


def start(position: Tensor, direction: Tensor, opl: Tensor | None = None) -> Rays:
    """Rays from points and directions of any length; rays without direction, or with infinite numbers, are invalid.

    position, direction: (3, ...) mm and any unit; opl: (...) mm or None.
    """
    axes = max(position.dim(), direction.dim()) - 1
    position, direction = with_batch_axes(position, axes), with_batch_axes(direction, axes)
    farthest, largest = (vector.detach().abs().amax(0) for vector in (position, direction))
    directed = (largest > 0) & (largest < torch.inf)
    usable = (farthest < torch.inf) & directed
    axis = direction.new_tensor([0.0, 0.0, 1.0]).reshape(3, *(1,) * axes)
    return Rays(
        position=torch.where(usable, position, 0.0),
        direction=torch.where(usable, unit(torch.where(directed, direction, axis)), axis),
        valid=usable,
        opl=opl if opl is None else torch.where(usable, opl, 0.0),
    )
