"""Solves of an OSLO lens file: curvatures and thicknesses that the file leaves to the axial ray, by the y-nu trace."""

from collections.abc import Sequence
from dataclasses import dataclass

from raytrace.formats.source import LensFileError, Place, UnsupportedSurface
from raytrace.formats.zemax_keywords import Record


@dataclass
class Step:
    """A surface as the axial ray meets it: curvature 1/mm and thickness mm, or the solves for them.

    index: of the medium behind, at the primary wavelength; of a mirror that before it. slope, height: the solves PU
    and PY, for the slope of the axial ray behind the surface and its height on the next, in mm.
    """

    place: Place
    curvature: float
    thickness: float
    index: float
    is_mirror: bool = False
    slope: Record | None = None
    height: Record | None = None


def solve(steps: Sequence[Step], beam: float | None, unit: float) -> None:
    """Fill in what is solved for, from the object on.

    beam: mm, height of the axial ray on surface 1 where the file tells it and the object is at infinity; None where
    only its direction is known, which a height of 0 needs alone. Raises LensFileError and UnsupportedSurface.
    """
    distance = steps[0].thickness
    infinite = distance == float("inf")
    height, slope = (beam or 1.0, 0.0) if infinite else (distance, 1.0)
    n = steps[0].index
    for step in steps[1:-1]:
        behind = -n if step.is_mirror else step.index * (-1 if n < 0 else 1)
        if step.slope:
            step.curvature = _curvature(step, n, behind, height, slope, beam)
        slope = (n * slope - height * (behind - n) * step.curvature) / behind
        if step.height:
            step.thickness = _thickness(step, height, slope, beam, unit)
        height, n = height + slope * step.thickness, behind


def _curvature(step: Step, n: float, behind: float, height: float, slope: float, beam: float | None) -> float:
    wanted, place = step.slope.number(0, "slope of the axial ray"), step.slope.place
    if beam is None:
        raise UnsupportedSurface("PU (a solve for the slope of the axial ray) is solved for a beam by EBR only", place)
    if not height * (behind - n):
        raise LensFileError(f"PU {wanted:g}: no curvature here bends the axial ray", place)
    return (n * slope - behind * wanted) / (height * (behind - n))


def _thickness(step: Step, height: float, slope: float, beam: float | None, unit: float) -> float:
    wanted, place = step.height.number(0, "height of the axial ray") * unit, step.height.place
    if beam is None and wanted:
        raise UnsupportedSurface(f"PY {wanted / unit:g} is solved for a beam by EBR only; PY 0 for any", place)
    found = (wanted - height) / slope if slope else float("inf")
    if abs(found) > 1e12:
        raise LensFileError(f"PY {wanted / unit:g}: the axial ray never comes to that height", place)
    return found


def focal_length(steps: Sequence[Step]) -> float | None:
    """mm, of the steps solved; None for an afocal lens. Its sign is that of a lens before which no mirror stands."""
    height, slope, n = 1.0, 0.0, steps[0].index
    for step in steps[1:-1]:
        behind = -n if step.is_mirror else step.index * (-1 if n < 0 else 1)
        slope = (n * slope - height * (behind - n) * step.curvature) / behind
        height, n = height + slope * step.thickness, behind
    return -steps[0].index / (n * slope) if abs(slope) > 1e-12 else None
