"""Etching: the heights that a process of lithography can make of an element of any height.

A process etches rings or pixels to L equal depths below m waves of the design wavelength, each with an error up to a
tolerance. Modulo m waves nothing changes at the design wavelength, but at every other one: so the depth is taken whose
phases agree best with those of the element at all wavelengths,

    h = argmax_d Σ_λ cos(k_λ (n_λ - 1) (d - h₀) - φ_λ),     φ_λ the pistons, which no image shows
"""

import dataclasses
import math

import torch
from torch import Tensor

from raytrace.materials.glass import index
from raytrace.maths.value import value
from raytrace.wave_optics.element import Element, is_flat, period

_CANDIDATES = 256  # depths within the relief, where any can be made
_ROUNDS = 12  # of depths and pistons in turn
_TRIES = 6  # first pistons


@value
class Process:
    """waves: depth in waves of the design wavelength (µm); levels: equal depths, 0 for any; tolerance: ± mm."""

    waves: int = 1
    levels: int = 0
    tolerance: float = 0.0
    wavelength: float = 0.55

    def period(self, element: Element) -> Tensor:
        """The depth in mm of `waves` whole waves at the design wavelength, which is not reached."""
        return self.waves * period(element.glass, self.wavelength).to(element.radius)


def relief(element: Element, process: Process) -> Tensor:
    """The largest depth (mm) that the process etches: (L - 1)/L of its waves."""
    whole = process.period(element)
    return whole * ((process.levels - 1) / process.levels) if process.levels else whole


@torch.no_grad()
def matched(element: Element, process: Process, wavelengths: Tensor) -> tuple[Element, float]:
    """The element that the process can make nearest in phase at wavelengths (W,) µm, and their agreement: 1 at best.

    Rings count by their area. Raises ValueError for a smooth element, which has no features to etch.
    """
    if not is_flat(element):
        kind = type(element.profile).__name__
        raise ValueError(f"a profile of {kind} has no features to be etched; use as_rings or as_pixels first")
    rate = 2 * math.pi / (1e-3 * wavelengths) * (index(element.glass, wavelengths) - 1)  # radians per mm
    wanted = element.numbers.detach().flatten()
    count = process.levels or _CANDIDATES
    depths = process.period(element) * torch.arange(count).to(wanted) / count
    area = torch.arange(len(wanted)).to(wanted) + 0.5 if element.kind.is_radial else torch.ones_like(wanted)
    random = torch.Generator().manual_seed(0)
    best, most = wanted, -math.inf
    for trial in range(_TRIES):
        pistons = 2 * math.pi * torch.rand(len(rate), generator=random, dtype=torch.float64).to(wanted)
        pistons = pistons if trial else torch.zeros_like(pistons)
        for _ in range(_ROUNDS):
            agreement = _agreement(rate, depths, wanted, pistons)
            nearest = depths[agreement.argmax(0)]
            pistons = torch.angle(
                (area * torch.polar(torch.ones_like(rate)[:, None], rate[:, None] * (nearest - wanted))).sum(1)
            )
        near = float((area * agreement.amax(0)).sum() / (area.sum() * len(rate)))
        if near > most:
            best, most = nearest, near
    etched = element.with_numbers(best.reshape(element.numbers.shape))
    return dataclasses.replace(etched, period=process.period(element), levels=process.levels), most


def _agreement(rate: Tensor, depths: Tensor, wanted: Tensor, pistons: Tensor) -> Tensor:
    """Σ_λ cos (C, R) of phases of depths (C,) with those wanted (R,)."""
    total = torch.zeros(len(depths), len(wanted)).to(wanted)
    for slope, piston in zip(rate, pistons, strict=True):
        total += torch.cos(slope * (depths[:, None] - wanted) - piston)
    return total
