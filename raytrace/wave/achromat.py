"""The diffractive achromat: free rings that put as much light of every colour as they can into one small circle.

After Peng, Fu, Heide and Heidrich, ACM Trans. Graph. 35, 31 (2016), who search greedily for equal spectra; here the
product of the encircled energies is raised along its gradient.
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import polynomial
from raytrace.media.catalog import find_glass
from raytrace.media.glass import Glass, index
from raytrace.wave.aim import Aim, converging
from raytrace.wave.element import Element, Rings, fabricated, period
from raytrace.wave.fabrication import ETCHED, features

#: (Element) -> share (W,) of the light of its aperture that reaches a circle on the sensor.
Encircled = Callable[[Element], Tensor]


def achromat(
    aim: Aim,
    *,
    wavelengths: tuple[float, ...] = (0.46, 0.55, 0.64),
    spot: float = 0.015,
    pitch: float = ETCHED,
    levels: int = 0,
    iterations: int = 400,
    rate: float = 0.1,
    encircled: Encircled | None = None,
) -> tuple[Element, ...]:
    """Rings of fused silica, heights within one wave of the design wavelength, that maximise Σ_λ log E_λ(spot).

    wavelengths: µm; spot: radius of the circle, mm; pitch: of the rings, mm; rate: of Adam, on the logit of the height;
    encircled: the engine that gives E, by default `encircled_energy`. Starts from the rings that suit the lenses of all
    wavelengths at once. The same numbers give the same rings.
    """
    glass = find_glass("F_SILICA")
    colours = torch.tensor(wavelengths, dtype=torch.float64, device=aim.radius.device)
    energy = encircled or encircled_energy(aim, colours, spot=spot, pitch=pitch)
    top = period(glass, aim.wavelength.detach().double())
    wide = torch.tensor(pitch, dtype=torch.float64, device=colours.device)
    radius = aim.radius.detach().double()

    def element(fraction: Tensor) -> Element:
        return Element(Rings(top * fraction, wide), radius, glass)

    with torch.enable_grad():
        start = _start(aim, colours, glass, pitch=wide, top=top) / top
        free = torch.logit(start.clamp(0.02, 0.98)).requires_grad_()
        optimizer = torch.optim.Adam([free], rate)
        for _ in range(iterations):
            optimizer.zero_grad()
            (-torch.log(energy(element(torch.sigmoid(free)))).sum()).backward()
            optimizer.step()
    heights = (top * torch.sigmoid(free.detach())).to(aim.radius)
    return (Element(Rings(heights, wide.to(aim.radius)), aim.radius, glass, top.to(aim.radius), levels),)


def encircled_energy(aim: Aim, wavelengths: Tensor, *, spot: float, pitch: float, inner: int = 32) -> Encircled:
    """The share of light within `spot` mm of the axis, behind an element of rings of `pitch` mm, for a point at focus.

        U(ρ) = (2π/λz) Σ_rings e^(ik (n - 1) h) ∫ e^(ik e(r)) J0(2πρr/λz) r dr,   E = ∫ |U|² 2πρ dρ / πR²

    with e(r) the path from the point and to the sensor. The integral over a ring, in `inner` parts of constant e(r),
    does not know the heights: it is done once, and E is a sum of squares of linear forms. The circle is integrated by
    Gauss's rule of 32 points. Exact in the parabolic approximation. wavelengths: (W,) µm.
    """
    wavelengths, radius = wavelengths.double(), aim.radius.detach().double()
    count = features(radius, torch.tensor(pitch, dtype=torch.float64))
    edges = (torch.arange(count * inner + 1).to(radius) * (pitch / inner)).clamp(max=radius)
    middle = 0.5 * (edges[1:] ** 2 + edges[:-1] ** 2)
    excess = -polynomial(converging(aim).detach().double(), middle) * middle
    points, weights = (torch.from_numpy(part).to(radius) for part in np.polynomial.legendre.leggauss(32))
    rho, weights = 0.5 * spot * (points + 1), 0.5 * spot * weights
    forms = []
    for wavelength in 1e-3 * wavelengths:
        rate = 2 * math.pi * rho[:, None] / (wavelength * aim.sensor.detach().double())
        # The kernel depends on no variable, so that bessel_j1, which has no derivative, may stand here.
        rings = torch.diff(edges * torch.special.bessel_j1(rate * edges) / rate, dim=1)
        phased = rings * torch.polar(torch.ones_like(excess), 2 * math.pi / wavelength * excess)
        scale = rate * torch.sqrt(2 * weights / rho)[:, None] / radius
        forms.append(scale * phased.reshape(len(rho), count, inner).sum(-1))
    return partial(_energy, torch.stack(forms), wavelengths)


def _energy(forms: Tensor, wavelengths: Tensor, element: Element) -> Tensor:
    """E_λ = Σ |forms_λ · e^(ik (n - 1) h)|² (W,) of an element of rings. forms: (W, M, R)."""
    heights = fabricated(element.profile.heights, element.period, element.levels).double()
    phase = _phase(element.glass, wavelengths) * heights
    field = (forms @ torch.polar(torch.ones_like(phase), phase)[..., None])[..., 0]
    return (field.real**2 + field.imag**2).sum(-1)


def _start(aim: Aim, wavelengths: Tensor, glass: Glass, *, pitch: Tensor, top: Tensor) -> Tensor:
    """Heights (R,), of 200 up to `top`, whose phases agree best, by Σ cos, with the lenses of all wavelengths."""
    radius = aim.radius.detach().double()
    r2 = ((torch.arange(features(radius, pitch)).to(radius) + 0.5) * pitch) ** 2
    lens = polynomial(converging(aim).detach().double(), r2) * r2
    heights = torch.linspace(0, 1, 200).to(radius) * top
    wanted = 2 * math.pi / (1e-3 * wavelengths)[:, None, None] * lens[:, None]
    agreement = torch.cos(_phase(glass, wavelengths)[..., None] * heights - wanted).sum(0)
    return heights[agreement.argmax(-1)]


def _phase(glass: Glass, wavelengths: Tensor) -> Tensor:
    """Phase (W, 1) that 1 mm of glass adds, radians."""
    return (2 * math.pi / (1e-3 * wavelengths) * (index(glass, wavelengths) - 1))[:, None]
