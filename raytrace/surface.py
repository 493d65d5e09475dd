"""Surface: sag, normal and intersection of a rotationally symmetric refracting or reflecting surface."""

import torch
from torch import Tensor

from raytrace.glass import AIR, Glass
from raytrace.value import value


@value
class Aperture:
    """The part of a surface that passes light; one surface may carry several, and a ray must pass all of them.

    shape: "circular" (radii: inner, outer), "rectangular" or "elliptic" (half-widths in x, y); mm.
    extent: the two numbers of the shape, mm.
    obscures: True if the shape blocks what lies inside it (an obscuration) instead of passing it.
    centre: (x, y) mm of the shape in the surface's frame.
    """

    shape: str
    extent: tuple[float, float]
    obscures: bool = False
    centre: tuple[float, float] = (0.0, 0.0)


@value
class Surface:
    """One surface of a lens and the gap behind it. What is None is not modelled, and costs nothing.

        z(r) = c r² / (1 + √(1 - (1+k) c² r²)) + Σ_j a_j r^(2j),  j = 1, 2, …

    curvature: c, 1/mm; None is a plane for good (put a tensor of 0 to differentiate a plane's curvature).
    conic: k; None is a sphere.
    coefficients: (m, ...) a_1, a_2, … of r², r⁴, … in mm^(1-2j); None if not aspheric.
    thickness: mm from this vertex to the next; the object's may be inf.
    glass: the medium behind the surface; MIRROR reflects and keeps the medium before it.
    semi_diameter: mm, as stored in the file; it never clips a ray (only `apertures` do).
    apertures: what the surface lets through.
    comment: free text of the file.
    """

    thickness: Tensor
    curvature: Tensor | None = None
    conic: Tensor | None = None
    coefficients: Tensor | None = None
    glass: Glass = AIR
    semi_diameter: float | None = None
    apertures: tuple[Aperture, ...] = ()
    comment: str = ""

    @property
    def is_mirror(self) -> bool:
        return self.glass.formula == "mirror"
