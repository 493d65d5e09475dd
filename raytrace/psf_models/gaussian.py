"""Gaussian PSF: centroid and covariance of a few traced rays, integrated over pixels."""

import dataclasses
import functools
import math

import numpy as np
import torch
from numpy.polynomial import legendre
from torch import Tensor

from raytrace.maths.numerics import safe_divide, value
from raytrace.maths.sampling import Grid, gauss_rings, sobol
from raytrace.psf_models.drt import histogram
from raytrace.psf_models.pixels import gaussian_pixels
from raytrace.psf_models.pupil_clearance import between, clear_arms, rays_of_search
from raytrace.psf_models.result import Kernels
from raytrace.system.apertures import stands_inside
from raytrace.tracing.scene import Scene, beam_share, symmetry, trace_scene

_MAP_POINTS = 4096  # of the ray map that the residual is computed from
_MAP_NODES, _MAP_ARMS = 32, 128  # the same where apertures clip: nodes on every arm, and arms of a round lens
_RIM = 1 - 1e-6  # of the pupil: a stop at its very edge clips nothing


@value
class Light:
    """Traced rays of a scene, or of the part of the pupil that its symmetry needs.

    hits: (2, D, F, W, P) mm on the sensor; valid: (D, F, W, P), those that arrive; weights: (P,) or (D, F, W, P),
    shares of the pupil, 1 in all; rays: how many were traced for each kernel. inner, outer: (D, F, W, B) radii of the
    parts of arms that the rays fill if anything is clipped, else None.
    """

    hits: Tensor
    valid: Tensor
    weights: Tensor
    rays: int
    inner: Tensor | None = None
    outer: Tensor | None = None


def kernels(scene: Scene, grid: Grid, *, order: int) -> Kernels:
    """Gaussians with the centroid and covariance of `order` Gauss rings of 4·(order - 1) arms, 8 at least.

    Only rays that the scene's symmetry does not give are traced: `order` rays of one meridian on the axis of a
    rotationally symmetric lens, half the pupil for fields in the y-z plane of a lens symmetric in x. σ of the double
    Gauss at 25 m: 4 rays on the axis give 1.4e-6, 5 give 7e-10; at 14°, 40 rays (order 5) give 9e-8. Where rays fail,
    rings follow the clear part of every arm, see `trace_light`. The energy is the transmitted fraction of the light
    through the whole entrance pupil, of which vignetting factors leave the share (1 - VCX)(1 - VCY); 0 with gradient 0
    where no ray arrives.
    """
    light, shape, gaussians = _kernels(scene, grid, order)
    return dataclasses.replace(gaussians, residual=residual(light, grid, shape, order, symmetry(scene)))


def kernels_alone(scene: Scene, grid: Grid, *, order: int) -> Kernels:
    """The same without their residual, which takes half of the time."""
    return _kernels(scene, grid, order)[2]


def _kernels(scene: Scene, grid: Grid, order: int) -> tuple[Light, Tensor, Kernels]:
    """The light, the share of every pixel in the light that arrives, and the kernels."""
    fold = symmetry(scene)
    light = trace_light(scene, order, fold)
    centroid, covariance, transmitted = spot_moments(light, fold)
    energy = transmitted * beam_share(scene)
    shape = gaussian_pixels(grid, centroid, covariance if fold == "none" else covariance[::2])
    return light, shape, Kernels(energy[..., None, None] * shape, grid, centroid, covariance, light.rays)


def trace_light(scene: Scene, order: int, fold: str) -> Light:
    """The rays of an order, of the part of the pupil that symmetry needs.

    If any ray fails, of these or of those at the rim of a lens with apertures, or an obstruction lies in the pupil,
    2·order rings on 32·(order - 1) arms fill the clear parts of the arms (`clear_arms`): energy and σ then err by 2e-4
    at order 4 where the clear pupil has corners, by less than 1e-8 where it is round.
    """
    apertures = [aperture for surface in scene.lens.surfaces for aperture in surface.apertures]
    count = 0
    if not any(stands_inside(aperture) for aperture in apertures):
        points, weights = fold_pupil(order, fold, scene.wavelengths)
        rim = _RIM * directions(2 * arms_of(order), fold, scene.wavelengths, start=0.0) if apertures else points[:, :0]
        rays = trace_scene(scene, torch.cat([points, rim], 1))
        hits, valid = rays.position[:2], rays.valid
        inside, count = points.shape[1], points.shape[1] + rim.shape[1]
        if scene.everywhere(valid.all()):
            return Light(hits[..., :inside], valid[..., :inside], weights, count)
    unit = directions(32 * max(order - 1, 1), fold, scene.wavelengths)
    inner, outer = clear_arms(scene, unit)
    points, weights = between(inner, outer, unit, rings=2 * order)
    rays = trace_scene(scene, points)
    count += rays_of_search(unit.shape[1], inner.shape[-1]) + points.shape[-1]
    return Light(rays.position[:2], rays.valid, weights, count, inner, outer)


def arms_of(order: int) -> int:
    """Arms of a rule of `order` rings: as many as leave the error to the rings, a multiple of 4 for its symmetry."""
    return 4 * max(order - 1, 2)


def fold_pupil(order: int, fold: str, like: Tensor) -> tuple[Tensor, Tensor]:
    """Pupil points (2, P) and weights (P,) of the rays to trace, in the dtype and on the device of `like`."""
    if fold == "round":
        points, weights = gauss_rings(order, 1, dtype=like.dtype, device=like.device)
        radius = torch.linalg.vector_norm(points, dim=0)
        return torch.stack([torch.zeros_like(radius), radius]), weights
    points, weights = gauss_rings(order, arms_of(order), dtype=like.dtype, device=like.device)
    if fold == "none":
        return points, weights
    right = points[0] > 0
    return points[:, right], 2 * weights[right]


def directions(arms: int, fold: str, like: Tensor, *, start: float = 0.5) -> Tensor:
    """Unit vectors (2, A) of the traced ones of so many arms, `start` steps off the axes; of a round lens (0, 1)."""
    if fold == "round":
        return like.new_tensor([[0.0], [1.0]])
    angle = (torch.arange(arms, dtype=like.dtype, device=like.device) + start) * (2 * math.pi / arms)
    unit = torch.stack([torch.sin(angle), torch.cos(angle)])
    return unit if fold == "none" else unit[:, : arms // 2 + (start == 0)]


def spot_moments(light: Light, fold: str) -> tuple[Tensor, Tensor, Tensor]:
    """Centroid (2, ...), covariance (3, ...) and transmitted fraction (...) of traced light.

    One ray is subtracted before the mean is formed and the mean before squares are, so that a small spot far off the
    axis loses no precision and no variance is negative.
    """
    valid = light.valid
    weights = torch.where(valid, light.weights, 0.0)
    transmitted = weights.sum(-1)
    share = safe_divide(weights, transmitted[..., None].expand_as(weights))
    x, y = torch.where(valid, light.hits, 0.0)
    zero = torch.zeros_like(transmitted)
    if fold == "round":
        # Turned about the axis, a ray at height y is a ring of second moment y²/2 per axis.
        variance = 0.5 * (share * y * y).sum(-1)
        return torch.stack([zero, zero]), torch.stack([variance, zero, variance]), transmitted
    first = valid & (valid.to(torch.int64).cumsum(-1) == 1)

    def centred(x: Tensor) -> tuple[Tensor, Tensor]:
        reference = torch.where(first, x, 0.0).sum(-1, keepdim=True)
        offset = torch.where(valid, x - reference, 0.0)
        mean = (share * offset).sum(-1, keepdim=True)
        return (reference + mean)[..., 0], torch.where(valid, offset - mean, 0.0)

    (x_mean, x), (y_mean, y) = centred(x) if fold == "none" else (zero, x), centred(y)
    xy = (share * x * y).sum(-1) if fold == "none" else zero
    covariance = torch.stack([(share * x * x).sum(-1), xy, (share * y * y).sum(-1)])
    return torch.stack([x_mean, y_mean]), covariance, transmitted


def residual(light: Light, grid: Grid, shape: Tensor, order: int, fold: str) -> Tensor:
    """Distance of the Gaussian from the rays: Σ |h - g| / Σ h over the pixels of the window, (...), without gradient.

    g: the Gaussian's share of every pixel, `shape`; h: that of the rays themselves, counted at thousands of points of
    a polynomial map from pupil to sensor through the same few rays: nothing more is traced. The counting leaves about
    0.01. 2 is the largest distance of two distributions of equal energy.
    """
    with torch.no_grad():
        if light.inner is None:  # of Sobol points of the pupil, by a fit through the rings
            matrix = torch.as_tensor(_ray_map(order), device=light.hits.device)
            points = _unfold(light.hits, order, fold) @ matrix.to(light.hits.dtype).mT
            weights = torch.ones_like(points[0])
        else:
            points, weights = _points_of_arms(light, fold)
        h = histogram(grid, points, safe_divide(weights, weights.sum(-1, keepdim=True).expand_as(weights)))
        return safe_divide((h - shape).abs().sum((-2, -1)), h.sum((-2, -1)))


def _points_of_arms(light: Light, fold: str) -> tuple[Tensor, Tensor]:
    """Hits (2, ..., P) of many nodes in every clear part of an arm, and weights, by interpolation along it."""
    parts = light.inner.shape[-1]
    rings = light.hits.shape[-1] // parts
    fine = (np.arange(_MAP_NODES) + 0.5) / _MAP_NODES
    nodes, fitted = (legendre.legvander(x, rings - 1) for x in (2 * fine - 1, legendre.leggauss(rings)[0]))
    points = light.hits.new_tensor(nodes @ np.linalg.inv(fitted)) @ light.hits.unflatten(-1, (rings, parts))
    inner, length = light.inner[..., None, :], (light.outer - light.inner)[..., None, :]
    weights = (inner + length * light.hits.new_tensor(fine)[:, None]) * length
    if fold == "round":
        angle = torch.arange(_MAP_ARMS, dtype=points.dtype, device=points.device) * (2 * math.pi / _MAP_ARMS)
        points = torch.stack([points[1, ..., None] * torch.cos(angle), points[1, ..., None] * torch.sin(angle)])
        points, weights = points.flatten(-2), weights[..., None].expand(points.shape[1:]).flatten(-2)
    elif fold == "mirror":
        points = torch.cat([points, torch.stack([-points[0], points[1]])], -1)
        weights = torch.cat([weights, weights], -1)
    return points.flatten(-2), weights.flatten(-2)


def _unfold(position: Tensor, order: int, fold: str) -> Tensor:
    """Hits (2, ..., P) of the whole of the rule, from those of the part that was traced."""
    if fold == "none":
        return position
    arms = arms_of(order)
    points, _ = gauss_rings(order, arms, dtype=position.dtype, device=position.device)
    number = torch.arange(order * arms, device=points.device)
    ring, arm = number // arms, number % arms
    if fold == "round":
        radius = position[1][..., ring]
        direction = (points / torch.linalg.vector_norm(points, dim=0)).reshape(2, *(1,) * (radius.dim() - 1), -1)
        return radius * direction
    # The mirror image of arm k about x = 0 is arm arms/2 - 1 - k.
    traced = points[0] > 0
    place = torch.cumsum(traced, 0) - 1
    source = torch.where(traced, place, place[ring * arms + torch.remainder(arms // 2 - 1 - arm, arms)])
    x, y = position[..., source]
    return torch.stack([torch.where(traced, x, -x), y])


@functools.cache
def _ray_map(order: int) -> np.ndarray:
    """Matrix (4096, P) from values on the rings to Sobol points: a fit of r^n cos mθ, r^n sin mθ, m ≤ n < 2·order."""
    arms = arms_of(order)
    points, weights = (t.numpy() for t in gauss_rings(order, arms))
    fine = sobol(_MAP_POINTS)[0].numpy()

    def basis(p: np.ndarray) -> np.ndarray:
        r, angle = np.hypot(*p), np.arctan2(p[1], p[0])
        # n - m even, up to the m that the arms resolve.
        powers = [(n, m) for m in range(min(2 * order, arms // 2)) for n in range(m, 2 * order, 2)]
        terms = [r**n * wave(m * angle) for n, m in powers for wave in (np.cos, np.sin)]
        return np.stack(terms, axis=1)

    root = np.sqrt(weights)[:, None]
    return basis(fine) @ (np.linalg.pinv(root * basis(points)) * root.T)
