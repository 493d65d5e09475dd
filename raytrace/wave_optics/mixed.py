"""Mixed scenes: round elements with steps in contact with smooth ones that are not round, such as a kinoform under a
cubic plate.

Cells that steps cut scatter light, so that a grid samples steps poorly. Of the round part the window sees its field
within some radius P of the axis, exact along one radius (`propagation.radial_field`):

    U_r(ρ) = ∫ F_r J₀,      F(t) = 2π/λ² ∫_0^∞ U_r(ρ) τ(ρ) J₀(2π t ρ/λ) ρ dρ

F is the round part without the light that goes beyond P, which the smooth part could not bring back into the window: τ
falls from 1 to 0 over [P₀, P₁]. It is smooth, and the product with the smooth part is summed as any smooth pupil is.
"""

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import Number, value
from raytrace.psf_models.dft import bessel_j0, phasor
from raytrace.wave_optics.element import Element, is_radial, is_smooth, path
from raytrace.wave_optics.propagation import phasors, slope, to_radii
from raytrace.wave_optics.pupil import ToPixels, cells_at, light_of, to_pixels
from raytrace.wave_optics.scene import WaveScene, aperture, millimetres, spheres

_POINTS = 12  # of the table of F per wave of its finest ripple
_STEEP = 2.6  # erfc(2.6)/2 = 1e-4 is left of the taper at its ends
_TAIL = 1.1  # erfc's transform has fallen to 1e-5 at 1.1 λ over the width of the taper


@value
class MixedSums:
    """Sums that do not depend on the heights.

    r: (J,) mm, radii of the round part; sphere: (D, J) mm; forward: (W, n, J) from its phasors to U at n radii of the
    sensor; back: (W, T, n) from there to F at T even steps of t; place: (N, N) of the cells in that table; x, y: (N, N)
    mm.
    """

    r: Tensor
    sphere: Tensor
    forward: Tensor
    back: Tensor
    place: Tensor
    x: Tensor
    y: Tensor
    to_pixels: ToPixels


def is_mixed(scene: WaveScene) -> bool:
    """Whether all steps are round, and something smooth is not."""
    stepped, free = [element for element in scene.elements if not is_smooth(element)], _free(scene)
    return bool(stepped and free) and all(map(is_radial, stepped)) and all(map(is_smooth, free))


def round_part(scene: WaveScene) -> WaveScene:
    """The scene with its round elements alone, in the aperture of the scene."""
    parts = (dataclasses.replace(part, radius=aperture(scene)) for part in scene.elements if is_radial(part))
    return dataclasses.replace(scene, elements=tuple(parts))


def _free(scene: WaveScene) -> list[Element]:
    return [element for element in scene.elements if not is_radial(element)]


@torch.no_grad()
def deflection(scene: WaveScene, extent: float) -> float:
    """Largest shift (mm) on the sensor of light by the free part, from within `extent` apertures."""
    R = aperture(scene)
    line = torch.linspace(-1, 1, 401, dtype=R.dtype, device=R.device) * R * extent
    y, x = torch.meshgrid(line, line, indexing="ij")
    along_y, along_x = torch.gradient(path(_free(scene), x, y, scene.wavelengths), spacing=(line, line), dim=(1, 2))
    inside = torch.hypot(x, y) <= R * extent
    return float((scene.sensor_distance * torch.hypot(along_x, along_y) * inside).max())


def extent_of(scene: WaveScene, band: tuple[float, float]) -> float:
    """Extent of the smoothed round part over the aperture, whose rim is washed out."""
    width = (band[1] - band[0]) / (2 * _STEEP)
    edge, _ = slope(scene, aperture(scene).detach())
    return 1 + _TAIL * float(millimetres(scene).detach().max() / width / edge)


def radii_of_band(scene: WaveScene, band: tuple[float, float]) -> int:
    """Gauss radii that the field of the round part needs within its band."""
    edge, _ = slope(scene, aperture(scene).detach())
    turns = float(edge) * band[1] * (1 + extent_of(scene, band)) / float(millimetres(scene).detach().min())
    return math.ceil(3.6 * turns) + 24


def prepare(
    scene: WaveScene, cells: int, nodes: int, *, extent: float, radii: int, band: tuple[float, float]
) -> MixedSums:
    """Constants of cells × cells over `extent` apertures; radii: Gauss radii between steps; band: P₀, P₁ mm."""
    R, wavelength = aperture(scene), millimetres(scene)[:, None, None]
    edge, _ = slope(scene, R)
    count = radii_of_band(scene, band)
    place, share = (R.new_tensor(a) for a in np.polynomial.legendre.leggauss(count))
    rho, part = 0.5 * band[1] * (place + 1), 0.5 * band[1] * share
    middle, width = 0.5 * sum(band), (band[1] - band[0]) / (2 * _STEEP)
    part = part * rho * 0.5 * torch.erfc((rho - middle) / width)
    r, forward = to_radii(round_part(scene), rho, radii)
    dt = 2 * edge * extent / cells
    axis = (torch.arange(cells, dtype=R.dtype, device=R.device) - 0.5 * (cells - 1)) * dt
    step = float(millimetres(scene).detach().min()) / (_POINTS * band[1])
    table = step * torch.arange(math.ceil(float(edge) * extent * math.sqrt(2) / step) + 4).to(R)
    back = 2 * math.pi / wavelength**2 * part * bessel_j0(2 * math.pi * table[:, None] * rho / wavelength)
    x, y, _ = cells_at(scene, axis)
    place = torch.sqrt(axis * axis + (axis * axis)[:, None]) / step
    return MixedSums(r, spheres(scene, r * r), forward, back * dt * dt, place, x, y, to_pixels(scene, axis, nodes))


def intensity(scene: WaveScene, sums: MixedSums) -> Tensor:
    """Light per mm² (D, W, Y, X) at the nodes of the pixels, 1 = all through the aperture."""
    wavelength = millimetres(scene)[:, None]
    rays = torch.view_as_real(phasors(round_part(scene), sums.r, sums.sphere))  # (D, W, J, 2)
    tables = torch.view_as_complex((sums.back @ (sums.forward @ rays)).contiguous())
    free = phasor(path(_free(scene), sums.x, sums.y, scene.wavelengths) / wavelength[..., None])
    return torch.stack([light_of(scene, sums.to_pixels, _between(table, sums.place) * free) for table in tables])


def _between(table: Tensor, place: Tensor) -> Tensor:
    """An even function at places (N, N) ≥ 0, in steps, of a table (W, T): six-point Lagrange interpolation."""
    first = torch.floor(place).long() - 2
    offset = place - first
    total: Number = 0.0
    for j in range(6):
        others = [k for k in range(6) if k != j]
        weight: Number = math.prod(1 / (j - k) for k in others)
        for k in others:
            weight = weight * (offset - k)
        step = (first + j).abs().clamp(max=table.shape[-1] - 1)
        total = total + weight * table[:, step]
    return total
