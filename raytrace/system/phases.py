"""Phases: what a thin structure on a surface does to light beside Snell's law; one row for every kind.

A grating, a hologram or a diffractive lens adds a path p(x, y), in mm, and its gradient to what light carries along
the surface: [n2 d2] = [n1 d1] + ∇p, tangentially (`optics.laws`). An ideal lens bends slopes instead. A new kind is a
new value and a new row of PHASES: rays, derivatives, first order, variables and files read it.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.maths.value import value

MICROMETRES = 1e-3  # mm


class Added(NamedTuple):
    """The path (...) mm that is added at a point, and its derivatives (...) by x and y."""

    path: Tensor
    x: Tensor
    y: Tensor


@value
class Grating:
    """Straight grooves along x, equally spaced in the projection on the x-y plane.

    frequency: lines per µm along y; order: of diffraction; p = order · frequency · λ y.
    """

    frequency: Tensor
    order: Tensor


@value
class IdealLens:
    """A thin lens without aberrations: n2 tan θ2 = n1 tan θ1 - power · height, in x and in y.

    power_x, power_y: 1/mm. opd_mode: how OpticStudio counts the path through it, 0 to 3; kept for the file.
    """

    power_x: Tensor
    power_y: Tensor
    opd_mode: int = 0


Phase = Grating | IdealLens


@dataclasses.dataclass(frozen=True)
class PhaseKind:
    """A kind of phase.

    added: phase, x, y (...) mm, wavelength (...) µm -> what is added; None for a kind that adds no path.
    power: phase, wavelength -> (x, y), -∂²p/∂x² and -∂²p/∂y² at the vertex in 1/mm: its paraxial power.
    slopes: whether it bends slopes by that power, in place of adding a gradient to Snell's law.
    zemax: TYPE of a .zmx file; is_round: about the axis.
    """

    power: Callable[[Phase, Tensor], tuple[Tensor, Tensor]]
    added: Callable[[Phase, Tensor, Tensor, Tensor], Added] | None = None
    slopes: bool = False
    zemax: str | None = None
    is_round: bool = False


def _grating(phase: Grating, x: Tensor, y: Tensor, wavelength: Tensor) -> Added:
    slope = phase.order * phase.frequency * wavelength
    return Added(slope * y, torch.zeros_like(slope), slope)


PHASES = {
    "Grating": PhaseKind(power=lambda p, _: (torch.zeros_like(p.order),) * 2, added=_grating, zemax="DGRATING"),
    "IdealLens": PhaseKind(power=lambda p, _: (p.power_x, p.power_y), slopes=True, zemax="PARAXIAL"),
}


def kind_of(phase: Phase) -> PhaseKind:
    """The row of a phase."""
    return PHASES[type(phase).__name__]
