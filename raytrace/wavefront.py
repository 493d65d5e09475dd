"""Wavefront: optical path to the reference sphere, without ever subtracting two long paths."""

from torch import Tensor

from raytrace.numerics import dot, safe_sqrt
from raytrace.rays import Rays


def path_to_reference_sphere(rays: Rays, centre: Tensor, radius: Tensor, index: Tensor) -> Tensor:
    """Reduced path W (...) in mm of rays up to the reference sphere they are about to cross; OPD = W - W_chief.

        W = W_rays + n [ -(P - Q)·d + e² / (R (1 + √(1 - e²/R²))) ],   e = |(P - Q) - ((P - Q)·d) d|

    less n R of the axial ray, so that no long path is ever formed (Hopkins' equally inclined chord).
    rays: with `opl`; centre Q: (3, ...) mm in the frame of the rays; radius R: mm, inf allowed; index n behind.
    """
    offset = rays.position - centre
    along = dot(offset, rays.direction)
    across = offset - along * rays.direction
    e_squared = dot(across, across)
    sagitta = e_squared / (radius * (1 + safe_sqrt(1 - e_squared / (radius * radius))))
    return rays.opl + index * (sagitta - along)
