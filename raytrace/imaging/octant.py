"""The closed-form error of round elements, from their light along one radius: no pixel is ever written.

    H_f = Σ_k Q_fk I(ρ_k),   I = |L U|²       I: light per mm² at the radii of `radial`; Q: to its pixels, and their
                                             transform; L: of U, of half the frequencies, from half as many radii

Round light in a centred window has the symmetry of the square, so that f runs over an octant: an eighth of the
frequencies holds all.
"""

import functools
import math

import torch
from torch import Tensor

from raytrace.imaging.image import transfer_functions
from raytrace.imaging.restoration import depth_invariant_density
from raytrace.maths.grid import grid
from raytrace.psf_models.radial import radii_of_waves, reach, unfold
from raytrace.wave_optics import propagation
from raytrace.wave_optics.plan import Plan
from raytrace.wave_optics.scene import WaveScene, spheres

_CHUNK = 32  # radii whose pixels are held at once


class Octant:
    """What the heights of round elements do not change, for pictures of size × size pixels.

    scene, plan: one of the radial engine, whose elements may have other heights later, steps at the same radii. dtype:
    of all sums; phases are of the scene's own.
    """

    def __init__(self, scene: WaveScene, plan: Plan, size: int, *, dtype: torch.dtype = torch.float64):
        order, cutoff = propagation.order_of(scene, plan.nodes), propagation.cutoff(scene)
        half, _ = radii_of_waves(scene.grid, 0.5 * cutoff, order)
        self._r, bessel = propagation.to_radii(scene, half, plan.samples)
        self._sphere, self._bessel = spheres(scene, self._r * self._r), bessel.to(dtype)
        rows, pitch = scene.grid.rows, float(scene.grid.pitch)
        self._between = _between(radii_of_waves(scene.grid, cutoff, order)[0] / (pitch * reach(scene.grid)), len(half))
        self._between = self._between.to(dtype)
        self._to_octant = _to_octant(rows, pitch, cutoff, order, size).to(dtype)
        self._rows, self._columns = _octant(size)
        self._weight = _weight(size)

    def transfer(self, scene: WaveScene) -> Tensor:
        """H (D, W, F), real, of the frequencies of the octant; light that misses the window is haze, at the first."""
        rays = torch.view_as_real(propagation.phasors(scene, self._r, self._sphere)).permute(1, 2, 0, 3)  # (W, J, D, 2)
        field = self._between @ (self._bessel @ rays.flatten(2).to(self._bessel.dtype))
        light = field.unflatten(-1, (-1, 2)).square().sum(-1).permute(2, 0, 1)
        found = light.flatten(0, 1) @ self._to_octant.T
        found = found.unflatten(0, light.shape[:2]).to(self._r.dtype)
        return torch.cat([torch.ones_like(found[..., :1]), found[..., 1:]], -1)

    def error(self, scene: WaveScene, spectrum: Tensor, noise: float) -> Tensor:
        """Mean square error behind the best blind filter, for pictures of S (size, size) that are their own mirror
        images; mean over colours."""
        both = torch.stack([spectrum[self._rows, self._columns], spectrum[self._columns, self._rows]])
        density = depth_invariant_density(self.transfer(scene)[:, :, None], both, noise)
        return (self._weight * density).sum((-2, -1)).mean()


def _between(places: Tensor, count: int) -> Tensor:
    """(P, K) from values of an even function at K Chebyshev points of [0, 1] to those at places (P,)."""
    points = torch.cos((2 * torch.arange(count, dtype=places.dtype) + 1) * (math.pi / (4 * count)))
    order = 2 * torch.arange(count, dtype=places.dtype)
    series = torch.where(order == 0, 1.0, 2.0)[:, None] / count * torch.cos(order[:, None] * torch.arccos(points))
    return torch.cos(order * torch.arccos(places)[:, None]) @ series


@functools.lru_cache(maxsize=4)
def _to_octant(rows: int, pitch: float, cutoff: float, order: int, size: int) -> Tensor:
    """Q (F, K)."""
    window = grid(torch.tensor(pitch, dtype=torch.float64), rows)
    _, to_pixels = radii_of_waves(window, cutoff, order)
    a, b = _octant(size)
    parts = [transfer_functions(unfold(window, part), size).real[..., a, b] for part in to_pixels.T.split(_CHUNK)]
    return torch.cat(parts).T.contiguous()


def _octant(size: int) -> tuple[Tensor, Tensor]:
    """Rows and columns (F,) of the frequencies 0 <= a <= b <= size/2, that of the mean first."""
    return torch.triu_indices(size // 2 + 1, size // 2 + 1).unbind()


def _weight(size: int) -> Tensor:
    """(2, F): what each frequency of the octant, and its mirror image at the diagonal, stand for in a mean of all."""
    a, b = _octant(size)
    alone = [torch.where((n == 0) | (2 * n == size), 1.0, 2.0).double() for n in (a, b)]
    return (alone[0] * alone[1] * torch.where(a == b, 0.5, 1.0) / size**2).expand(2, -1)


def fits(scene: WaveScene, plan: Plan, spectrum: Tensor) -> bool:
    """Whether the octant tells all: round light in a centred square window, pictures that are their mirror images."""
    square = scene.grid.rows == scene.grid.columns and spectrum.shape[-2] == spectrum.shape[-1]
    mirrored = torch.allclose(spectrum, torch.roll(spectrum.flip(-1), 1, -1), rtol=1e-9, atol=0)
    mirrored = mirrored and torch.allclose(spectrum, torch.roll(spectrum.flip(-2), 1, -2), rtol=1e-9, atol=0)
    return plan.engine == "radial" and square and scene.grid.rows % 2 == 1 and mirrored
