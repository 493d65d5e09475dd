"""Wave model: the diffraction PSF of the traced wavefront, over the pupil as the lens leaves it.

    U(x, y) = (n/λ) Σ_j √(E_j Ω_j) exp(2πi [W_j + n (L_j x + M_j y)]/λ)

Every ray j carries the light E_j of its share of the entrance pupil through its share Ω_j = |∂(L, M)/∂p| dp of the
directions, so that the intensity |U|² holds the transmitted light (Parseval), whatever the distortion of the pupil.
W is the OPD on the reference sphere and (L, M) point from there to its centre (Debye's integral, Born & Wolf §8.8.1).
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from raytrace.maths import zernike
from raytrace.maths.numerics import safe_sqrt, to, value
from raytrace.maths.sampling import Grid, gauss_rings
from raytrace.psf_models import dft
from raytrace.psf_models.radial import is_centred, light_of_radii, radii_of_waves
from raytrace.psf_models.result import Kernels, combined, moments_of_rays
from raytrace.tracing.clear_pupil import arms_of
from raytrace.tracing.scene import Scene, symmetry, trace_scene
from raytrace.tracing.wavefront import Wavefront, wavefront_of

_MOST_RAYS = 400_000  # rays of one kernel; beyond, the phase is refused
_DEGREE = 10  # of the map from the pupil to directions
_TERMS = (_DEGREE + 1) * (_DEGREE + 2) // 2  # its Zernike terms
_ORDERS = [zernike.noll(j) for j in range(1, _TERMS + 1)]
_PROBE = 8, 32  # rings and arms of the rays that find the map and the sampling
_RIM = 1 - 1e-6  # of the pupil: a stop at its very edge clips nothing


@value
class Waves:
    """Plane waves that meet at the sensor: (D, F, W, P) of one field, ready to be summed.

    amplitude: √(E Ω), 0 where no light comes; wavefront: its OPD, directions and centre.
    symmetry: "round": each ray represents its ring; "mirror": itself and its image in x; "none".
    """

    amplitude: Tensor
    wavefront: Wavefront
    symmetry: str


def kernels(scene: Scene, grid: Grid, *, order: int = 0) -> Kernels:
    """Kernels of the wave model; a kernel whose light is vignetted altogether is 0 with gradient 0.

    order: from -2 on; each one adds rays and pixel nodes. centroid and covariance are those of the light inside the
    window, ray_centroid and ray_covariance those of the rays: the mean of the whole wave is theirs (Ehrenfest), its
    second moment does not exist behind a hard edge. residual: size of the terms that Debye's integral neglects. Raises
    ValueError where the window or the blur would need too many rays.
    """

    def of_field(part: Scene, window: Grid) -> Kernels:
        probe = probe_of(part)
        points = sensor_points(part, probe, window, order, is_round=symmetry(part) == "round")
        light = waves(part, points.corner, order=order, probe=probe)
        kernel, centroid, covariance = points.integrated(light, probe)
        residual = _debye_residual(light.wavefront, probe, points.corner)
        rays, arrived = light.amplitude.shape[-1], light.wavefront.energy.sum(-1)
        return Kernels(kernel, window, centroid, covariance, rays, arrived, residual, *_moments(light))

    return by_field(scene, grid, of_field)


def by_field(scene: Scene, grid: Grid, compute: Callable[[Scene, Grid], Kernels]) -> Kernels:
    """Kernels field by field, in double precision: in single precision the OPD itself is known to 1/400 wave only."""
    fields, centre = [], grid.centre
    for f in range(scene.shape[1]):
        middle = centre[:, :, f : f + 1] if centre.dim() > 1 and centre.shape[2] > 1 else centre
        window = to(dataclasses.replace(grid, centre=middle), dtype=torch.float64)
        fields.append(compute(one_field(scene, f), window))
    merged = combined(fields, lambda parts, before: torch.cat(parts, before + 1))
    return dataclasses.replace(to(merged, dtype=grid.pitch.dtype), grid=grid)


def waves(scene: Scene, reach: Tensor | float, *, order: int = 0, probe: Wavefront | None = None) -> Waves:
    """Waves of one field, sampled for points up to `reach` mm from the chief ray's point; probe: of `probe_of`.

    The rays are Gauss rings over the pupil; where it is vignetted, over the clear part of every arm. One arm is enough
    on the axis of a round lens, half the arms for a field in the y-z plane.
    """
    probe = probe_of(scene) if probe is None else probe
    fold = symmetry(scene)
    pupil, weights = _rays(scene, probe, fold, phase_along_radius(probe, reach, scene.largest), order)
    front = wavefront_of(scene, pupil, weights)
    solid = math.pi * weights * _jacobian(_direction_map(probe), pupil)
    return Waves(safe_sqrt(front.energy * solid), front, fold)


def amplitude(waves: Waves, x: Tensor, y: Tensor) -> Tensor:
    """U (D, F, W, Y, X) in 1/mm at x (..., X), y (..., Y) mm from the chief ray's point, by a matrix DFT."""
    front = waves.wavefront
    wavelength = 1e-3 * front.wavelength
    L, M, _ = front.direction
    field = waves.amplitude * dft.phasor(front.opd / wavelength[:, None])
    inside = (wavelength / front.index).expand(field.shape[:-1])
    if waves.symmetry == "round":
        U = dft.rings_to_grid(field, safe_sqrt(L * L + M * M), x, y, inside)
    elif waves.symmetry == "mirror":
        U = dft.to_grid_mirrored(0.5 * field, L, M, x, y, inside)
    else:
        U = dft.to_grid(field, L, M, x, y, inside)
    return U / inside[..., None, None]


def phase_along_radius(
    probe: Wavefront, reach: Tensor | float, largest: Callable[[Tensor], Tensor] = torch.Tensor.detach
) -> float:
    """Largest change of phase in radians along a pupil radius, seen from points up to `reach` mm from the centre.

    dΦ/dp = (2πn/λ) |∂(L, M)/∂p · (x_ray - x)|: directions times the distance between ray and point.
    largest: as `Scene` has it.
    """
    with torch.no_grad():
        spread = half_spread(probe)[..., None]
        blur = torch.where(probe.usable, torch.linalg.vector_norm(probe.landing, dim=0), 0.0).amax(-1, keepdim=True)
        phase = 2e3 * math.pi * (probe.index / probe.wavelength)[:, None] * spread * (blur + reach)
        return float(largest(phase.max()))


@dataclasses.dataclass(frozen=True)
class SensorPoints:
    """Points of the sensor at which waves are summed: radii if they are round, else the nodes of the pixels.

    x, y: mm from the chief ray's point; weight: of the nodes of a pixel, None for radii; corner: largest distance, mm.
    """

    grid: Grid
    cutoff: float
    order: int
    x: Tensor
    y: Tensor
    weight: Tensor | None
    corner: Tensor

    def integrated(self, light: Waves, probe: Wavefront) -> tuple[Tensor, Tensor, Tensor]:
        """Kernel, and centroid and covariance of the light inside the window."""
        return self.integrated_amplitude(amplitude(light, self.x, self.y), probe)

    def integrated_amplitude(self, U: Tensor, probe: Wavefront) -> tuple[Tensor, Tensor, Tensor]:
        """`integrated` of the amplitude (D, F, W, Y, X) at the points."""
        intensity = U.real**2 + U.imag**2
        if self.weight is None:
            return light_of_radii(self.grid, self.cutoff, self.order, intensity[..., 0, :])
        kernel = dft.integrate(intensity, self.weight, self.grid.pitch)
        centroid, covariance = dft.window_moments(intensity, self.x, self.y, self.weight, self.grid.pitch)
        return kernel, centroid + probe.centre[:2], covariance


def sensor_points(scene: Scene, probe: Wavefront, grid: Grid, order: int, *, is_round: bool) -> SensorPoints:
    """The points of one field; is_round: whether the light is, so that one radius is enough in a centred window."""
    cutoff = 2e3 * float(scene.largest((half_spread(probe) * probe.index / probe.wavelength).max()))
    if is_round and is_centred(grid, scene):
        x, _ = radii_of_waves(grid, cutoff, order)
        return SensorPoints(grid, cutoff, order, x, torch.zeros_like(x[:1]), None, x.detach().max())
    centre = grid.centre.reshape(2, *(grid.centre.shape[1:] or (1, 1, 1))) - probe.centre[:2]
    nodes = dft.nodes_per_pixel(float(grid.pitch.detach()), cutoff, order)
    dft.afford_sensor("the wave PSF", scene, grid, nodes)
    x, y, weight = dft.sub_pixels(Grid(grid.pitch, grid.rows, grid.columns, centre), nodes)
    corner = scene.largest(torch.hypot(x.detach().abs().amax(-1), y.detach().abs().amax(-1)).max())
    return SensorPoints(grid, cutoff, order, x, y, weight, corner)


def probe_of(scene: Scene) -> Wavefront:
    """A few hundred rays that determine the blur, the map of directions and so the sampling."""
    points, weights = gauss_rings(*_PROBE, dtype=scene.wavelengths.dtype, device=scene.wavelengths.device)
    return wavefront_of(scene, points, weights)


def _moments(light: Waves) -> tuple[Tensor, Tensor]:
    """Centroid (2, ...) mm on the sensor and covariance (3, ...) mm² of the rays."""
    front = light.wavefront
    centroid, covariance = moments_of_rays(front.landing, front.energy, light.symmetry)
    return front.centre[:2] + centroid, covariance


def _debye_residual(front: Wavefront, probe: Wavefront, corner: Tensor) -> Tensor:
    """Relative L1 error (...) of neglecting in |q - p| - R the term beyond L x + M y, π n (s·p)²/(|R| λ) of phase."""
    with torch.no_grad():
        spread = half_spread(probe)
        wavelength = 1e-3 * front.wavelength / front.index
        blur = torch.where(probe.usable, torch.linalg.vector_norm(probe.landing, dim=0), 0.0).amax(-1)
        # Over the window or the blur b, and directions up to s, the mean of (s·p)² is b² s²/8; a fifth allows for light
        # at the rim. Where the phase is large it only moves rays, by up to b² s/|R|: densities by up to 6 b s/|R|.
        b = torch.minimum(corner, blur + wavelength / spread.clamp_min(1e-30))
        stretch = b * spread / front.radius.abs()
        return torch.minimum(0.2 * math.pi * b * spread / wavelength, torch.full_like(b, 6.0)) * stretch


def half_spread(front: Wavefront) -> Tensor:
    """Largest distance (...) of the directions (L, M) of the rays from their mean."""
    L, M = torch.where(front.usable, front.direction[:2], 0.0).detach()
    count = front.usable.sum(-1, keepdim=True).clamp_min(1)
    dL, dM = L - L.sum(-1, keepdim=True) / count, M - M.sum(-1, keepdim=True) / count
    return torch.where(front.usable, torch.hypot(dL, dM), 0.0).amax(-1)


def _direction_map(probe: Wavefront) -> Tensor:
    """Zernike coefficients (2, ..., J) of L and M over the pupil; 0 where too few rays come through."""
    basis = zernike.polynomials(_ORDERS, *probe.pupil)
    enough = probe.usable.sum(-1, keepdim=True) >= 2 * _TERMS
    weights = torch.where(probe.usable | ~enough, probe.weights, 0.0)
    directions = torch.where(probe.usable & enough, probe.direction[:2], 0.0)
    return zernike.fit(directions, basis, weights)


def _jacobian(directions: Tensor, pupil: Tensor) -> Tensor:
    """|∂(L, M)/∂(p_x, p_y)| (..., P) at pupil points, of Zernike series (2, ..., J) written out in powers of p."""
    matrix, i, j = _powers()
    terms = directions @ directions.new_tensor(matrix)
    x, y = (torch.stack([torch.ones_like(p), *itertools.accumulate([p] * _DEGREE, torch.mul)]) for p in pupil)
    by_x = (x[np.maximum(i - 1, 0)] * y[j]).movedim(0, -2)
    by_y = (x[i] * y[np.maximum(j - 1, 0)]).movedim(0, -2)
    (L_x, M_x), (L_y, M_y) = (
        ((terms * terms.new_tensor(power))[..., None, :] @ slope)[..., 0, :] for power, slope in ((i, by_x), (j, by_y))
    )
    return (L_x * M_y - L_y * M_x).abs()


@functools.cache
def _powers() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix (J, T) from Zernike coefficients to those of x^i y^j, and the exponents i and j (T,)."""
    i, j = np.array([(n - k, k) for n in range(_DEGREE + 1) for k in range(n + 1)]).T
    points, _ = gauss_rings(2 * _DEGREE, 4 * _DEGREE, device=torch.device("cpu"))
    x, y = points.numpy()[:, :, None]
    values = zernike.polynomials(_ORDERS, *points).numpy()
    return np.linalg.lstsq(x**i * y**j, values.T, rcond=None)[0].T, i, j


def _rays(scene: Scene, probe: Wavefront, fold: str, phase: float, order: int) -> tuple[Tensor, Tensor]:
    """Pupil points (2, P) and weights (P,), or (2, D, F, W, P) and (D, F, W, P) over the clear part of every arm."""
    rings, whole = dft.rings_and_arms(phase, order)
    arms = whole
    if fold == "round":
        dft.afford_rings("the wave PSF", scene, rings, phase)
        arms, (points, weights) = 1, gauss_rings(rings, 1, dtype=probe.opd.dtype, device=probe.opd.device)
    else:
        points, weights = dft.disc_rule(phase, order, most=_MOST_RAYS, what="the wave model", like=probe.opd)
    unit = points[:, :arms] / torch.hypot(*points[:, :arms])
    if fold == "mirror":
        right = points[0] > 0
        points, weights, unit = points[:, right], 2 * weights[right], unit[:, unit[0] > 0]
    with torch.no_grad():
        if scene.everywhere(probe.valid.all()) and scene.everywhere(trace_scene(scene, _RIM * unit).valid.all()):
            return points, weights
    # Gaussian nodes between kinks are less dense in the middle than equal steps, by up to π/2; and an arm from a point
    # off the centre may be longer than 1, and the phase along it larger.
    clear = arms_of(scene, math.ceil(1.25 * whole), fold)
    longest = scene.largest((clear.outer - clear.inner).detach().max().clamp_min(1.0))
    return clear.rule(math.ceil(rings * float(longest)))


def one_field(scene: Scene, f: int) -> Scene:
    """One field of a scene, in double precision."""
    return to(dataclasses.replace(scene, fields=scene.fields[..., f : f + 1]), dtype=torch.float64)
