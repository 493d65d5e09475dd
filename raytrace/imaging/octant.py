"""The closed-form error of round elements, from their light along one radius, without an image of pixels.

    H_f = Σ_k Q_fk I(ρ_k),   I = |L U|²       I: light per mm² at the radii of `radial`; Q: to its pixels, and their
                                             transform; L: of U, of half the frequencies, from half as many radii

Round light in a centred window has the symmetry of the square: an octant, an eighth of the frequencies f, is enough.
"""

import functools
import math

import torch
from torch import Tensor

from raytrace.imaging.field_kernels import ElementKernels
from raytrace.imaging.image import transfer_functions
from raytrace.imaging.restoration import depth_invariant_density
from raytrace.maths.sampling import grid
from raytrace.psf_models.radial import radii_of_waves, reach, unfold
from raytrace.wave_optics import propagation
from raytrace.wave_optics.compute import remembered
from raytrace.wave_optics.element import Rings
from raytrace.wave_optics.plan import Plan
from raytrace.wave_optics.scene import WaveScene, spheres

_CHUNK = 32  # radii whose pixels are computed at once


class Octant:
    """The operators of round elements that do not depend on their heights, for pictures of a spectrum.

    scene, plan: of the radial engine; later elements may have other heights, with steps at the same radii. spectrum: S
    (size, size) of pictures that equal their mirror images; dtype: of all sums; phases have that of the scene.
    """

    def __init__(self, scene: WaveScene, plan: Plan, spectrum: Tensor, *, dtype: torch.dtype = torch.float64):
        size = spectrum.shape[-1]
        order, cutoff = propagation.order_of(scene, plan.nodes), propagation.cutoff(scene)
        half, _ = radii_of_waves(scene.grid, 0.5 * cutoff, order)
        self._r, bessel = propagation.to_radii(scene, half, plan.samples)
        self._sphere, self._bessel = spheres(scene, self._r * self._r), bessel.to(dtype)
        pixels, pitch = scene.grid.rows, float(scene.grid.pitch)
        radii = radii_of_waves(scene.grid, cutoff, order)[0] / (pitch * reach(scene.grid))
        self._between = _between(radii, len(half)).to(dtype)
        self._to_octant = _to_octant(pixels, pitch, cutoff, order, size).to(dtype)
        rows, columns = _octant(size)
        # (2, F): of each frequency of the octant and of its transpose the power, and the weight in a mean over all.
        self._spectrum = torch.stack([spectrum[rows, columns], spectrum[columns, rows]])
        alone = [torch.where((n == 0) | (2 * n == size), 1.0, 2.0).double() for n in (rows, columns)]
        diagonal = torch.where(rows == columns, 0.5, 1.0)
        self._weight = (alone[0] * alone[1] * diagonal / size**2).expand(2, -1)

    def transfer(self, scene: WaveScene) -> Tensor:
        """H (D, W, F), real, of the frequencies of the octant; light beyond the window is haze, at the first one."""
        rays = torch.view_as_real(propagation.phasors(scene, self._r, self._sphere)).permute(1, 2, 0, 3)  # (W, J, D, 2)
        field = self._between @ (self._bessel @ rays.flatten(2).to(self._bessel.dtype))
        light = field.unflatten(-1, (-1, 2)).square().sum(-1).permute(2, 0, 1)
        H = (light.flatten(0, 1) @ self._to_octant.T).unflatten(0, light.shape[:2]).to(self._r.dtype)
        return torch.cat([torch.ones_like(H[..., :1]), H[..., 1:]], -1)

    def error(self, transfer: Tensor, sigma: Tensor | float) -> Tensor:
        """Mean square error behind the best depth-invariant filter, mean over channels; transfer: (D, C, F)."""
        density = depth_invariant_density(transfer[:, :, None], self._spectrum, sigma)
        return (self._weight * density).sum((-2, -1)).mean()


def octant_error(kernels: ElementKernels, spectrum: Tensor, sigma: Tensor) -> Tensor | None:
    """`Octant.error` of elements with haze; None where the octant is not enough, or their sampling is not fixed."""
    scene, plan = kernels.scene, kernels.plan
    if plan is None or kernels.memo is None or spectrum.dim() > 2:
        return None

    def octant() -> Octant | None:
        # Rings in single precision: their sums take most of the time, and Adam needs no more.
        is_rings = isinstance(scene.elements[0].profile, Rings)
        dtype = torch.float32 if is_rings else torch.float64
        return Octant(scene, plan, spectrum, dtype=dtype) if fits(scene, plan, spectrum) else None

    part = remembered(kernels.memo, scene, ("octant", plan), octant, spectrum)
    if part is None:
        return None
    return part.error(kernels.weights @ part.transfer(scene), sigma)


def _between(places: Tensor, count: int) -> Tensor:
    """(P, K) from values of an even function at K Chebyshev points of [0, 1] to those at places (P,)."""
    order = 2 * torch.arange(count, dtype=places.dtype, device=places.device)
    points = torch.cos((order + 1) * (math.pi / (4 * count)))
    series = torch.where(order == 0, 1.0, 2.0)[:, None] / count * torch.cos(order[:, None] * torch.arccos(points))
    return torch.cos(order * torch.arccos(places)[:, None]) @ series


@functools.lru_cache(maxsize=4)
def _to_octant(rows: int, pitch: float, cutoff: float, order: int, size: int) -> Tensor:
    """Q (F, K)."""
    window = grid(torch.tensor(pitch, dtype=torch.float64, device="cpu"), rows)
    _, to_pixels = radii_of_waves(window, cutoff, order)
    a, b = _octant(size)
    parts = [transfer_functions(unfold(window, part), size).real[..., a, b] for part in to_pixels.T.split(_CHUNK)]
    return torch.cat(parts).T.contiguous()


def _octant(size: int) -> tuple[Tensor, Tensor]:
    """Rows and columns (F,) of the frequencies 0 <= a <= b <= size/2, that of the mean first."""
    rows, columns = torch.triu_indices(size // 2 + 1, size // 2 + 1)
    return rows, columns


def fits(scene: WaveScene, plan: Plan, spectrum: Tensor) -> bool:
    """Whether the octant is enough: round light in a centred square window, pictures that equal their mirror images."""
    square = scene.grid.rows == scene.grid.columns and spectrum.shape[-2] == spectrum.shape[-1]
    mirrored = all(
        torch.allclose(spectrum, torch.roll(spectrum.flip(axis), 1, axis), rtol=1e-9, atol=0) for axis in (-1, -2)
    )
    return plan.engine == "radial" and square and scene.grid.rows % 2 == 1 and mirrored
