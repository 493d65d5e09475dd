"""Radial engine: elements that depend on the distance from the axis alone, along one radius.

    U(ρ) = 2π/λ ∫_0^R A exp(ik W_residual(r)) J₀(k ρ t(r)) z/(r² + z²) r dr,   t = r/z; true spheres t = r/√(r² + z²)

The integral is a Gauss rule in r² between the radii where a height steps or jumps (ring edges, zones of a wrapped
lens), so that only smooth phases are ever sampled. |U|² is band-limited: its values at a few radii give the light of
every pixel (`kernels.radial`). J₀ depends on neither heights nor depths: while those alone vary, a step costs one real
product.
"""

import math

import numpy as np
import torch
from torch import Tensor

from raytrace.kernels.dft import bessel_j0, phasor
from raytrace.kernels.radial import radii_of_waves, unfold
from raytrace.maths.value import value
from raytrace.wave.element import Element, Rings, designed_height, path
from raytrace.wave.scene import WaveScene, aperture, millimetres, spheres

_PROBES = 20_000  # radii where the jumps of a wrapped height are looked for


@value
class RadialSums:
    """What the heights do not change.

    r: (J,) mm, radii of the element; sphere: (D, J) mm; bessel: (W, K, J), from amplitudes at r to fields at the K
    radii of the sensor, with the weights of the integral; to_pixels: (U, K) mm² to the pixels that differ.
    """

    r: Tensor
    sphere: Tensor
    bessel: Tensor
    to_pixels: Tensor


def prepare(scene: WaveScene, nodes: int, order: int) -> RadialSums:
    """Constants for `nodes` Gauss radii between steps, and an order of the radii on the sensor (`radii_of_waves`)."""
    rho, to_pixels = radii_of_waves(scene.grid, cutoff(scene), order)
    r, bessel = to_radii(scene, rho, nodes)
    return RadialSums(r, spheres(scene, r * r), bessel, to_pixels)


def to_radii(scene: WaveScene, rho: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Radii r (J,) mm of the element, `nodes` between steps, and the matrix (W, K, J) from the phasors there to U, |U|²
    per mm², at radii rho (K,) mm of the sensor."""
    wavelength = millimetres(scene)[:, None, None]
    r, weight = rule(edges(scene), nodes)
    t, light = slope(scene, r)
    scale = 2 * math.sqrt(math.pi) / (aperture(scene) * wavelength)
    return r, scale * weight * light * bessel_j0(2 * math.pi * rho[:, None] * t / wavelength)


def kernels(scene: WaveScene, sums: RadialSums) -> Tensor:
    """Energy in the pixels (D, W, rows, columns), 1 = all through the aperture."""
    return unfold(scene.grid, intensity(scene, sums) @ sums.to_pixels.T)


def intensity(scene: WaveScene, sums: RadialSums) -> Tensor:
    """Light per mm² (D, W, K) at the radii of the sensor."""
    U = phasors(scene, sums.r, sums.sphere)
    # A real matrix on the columns Re U, Im U of all depths.
    parts = torch.view_as_real(U).permute(1, 2, 0, 3).flatten(2)
    parts = (sums.bessel @ parts).unflatten(-1, (-1, 2))
    return (parts**2).sum(-1).permute(2, 0, 1)


def field(scene: WaveScene, rho: Tensor, nodes: int) -> Tensor:
    """U (D, W, K) at radii rho (K,) mm on the sensor, |U|² per mm² as `intensity`."""
    r, bessel = to_radii(scene, rho, nodes)
    U = phasors(scene, r, spheres(scene, r * r))
    return (bessel.to(U.dtype) @ U[..., None])[..., 0]


def phasors(scene: WaveScene, r: Tensor, sphere: Tensor) -> Tensor:
    """exp(ik W_residual) (D, W, J) at radii r (J,) of the element; sphere: of `spheres`."""
    waves = path(scene.elements, r, torch.zeros_like(r), scene.wavelengths) + sphere[:, None]
    return phasor(waves / millimetres(scene)[:, None])


def slope(scene: WaveScene, r: Tensor) -> tuple[Tensor, Tensor]:
    """t(r), and cos θ/|x - u| = z/(r² + z²) in 1/mm; paraxially r/z and 1/z."""
    z = scene.sensor_distance
    if not scene.exact:
        return r / z, (1 / z).expand(r.shape)
    return r / torch.sqrt(r * r + z * z), z / (r * r + z * z)


def cutoff(scene: WaveScene) -> float:
    """Highest spatial frequency of the intensity, 1/mm, at the shortest wavelength: λN/2 is its sampling."""
    t, _ = slope(scene, aperture(scene).detach())
    return float(2 * t.detach() / millimetres(scene).detach().min())


def order_of(scene: WaveScene, nodes: int) -> int:
    """Order of `radii_of_waves` that takes so many nodes per pixel."""
    return nodes - 4 - math.ceil(0.5 * math.pi * cutoff(scene) * float(scene.grid.pitch.detach()))


def edges(scene: WaveScene) -> Tensor:
    """Radii (E,) mm from 0 to R between which no height steps or jumps."""
    R = aperture(scene)
    inner = [R.detach().new_zeros(0)]
    for element in scene.elements:
        if isinstance(element.profile, Rings):
            pitch, count = element.profile.pitch, len(element.profile.heights)
            steps = pitch * torch.arange(1, count, dtype=pitch.dtype, device=pitch.device)
            inner.append(steps)
        elif element.period is not None:
            inner.append(_jumps(element, R.detach()))
    # Two steps of different elements at one radius, to rounding, are one.
    found = torch.cat(inner).sort().values
    share = found.detach() / R.detach()
    apart = (torch.cat([share.new_zeros(1), share]).diff() > 1e-9) & (share < 1 - 1e-9)
    return torch.cat([R.new_zeros(1), found[apart], R.reshape(1)])


def _jumps(element: Element, radius: Tensor) -> Tensor:
    """Radii where a wrapped or stepped smooth height jumps: between two probes h runs straight."""
    r = radius * torch.sqrt(torch.linspace(0, 1, _PROBES, dtype=radius.dtype, device=radius.device))
    h = designed_height(element, r, torch.zeros_like(r)).detach()
    step = h / (element.period.detach() / max(1, element.levels))
    at = step.floor().diff().nonzero()[:, 0]
    # The integer between the two, the higher one's floor.
    level = torch.maximum(step[at], step[at + 1]).floor()
    share = (level - step[at]) / (step[at + 1] - step[at])
    return torch.sqrt(r[at] ** 2 + share * (r[at + 1] ** 2 - r[at] ** 2))


def rule(edges: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Radii (J,) mm and weights (J,) mm² of ∫ f r dr: Gauss nodes in r² between each pair of edges."""
    place, share = (edges.new_tensor(a) / 2 for a in np.polynomial.legendre.leggauss(nodes))
    s = edges * edges
    width = s.diff()[:, None]
    middle = (0.5 * (s[1:] + s[:-1]))[:, None]
    return torch.sqrt(middle + place * width).flatten(), 0.5 * (share * width).flatten()
