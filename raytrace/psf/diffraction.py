"""Wave model: the diffraction PSF of the traced wavefront, over the pupil as the lens leaves it.

    U(x, y) = (n/λ) Σ_j √(E_j Ω_j) exp(2πi [W_j + n (L_j x + M_j y)]/λ)

Every ray j carries the light E_j of its share of the entrance pupil through its share Ω_j = |∂(L, M)/∂p| dp of the
directions, so that the intensity |U|² holds the transmitted light (Parseval), whatever the distortion of the pupil.
W is the OPD on the reference sphere and (L, M) point from there to its centre (Debye's integral, Born & Wolf §8.8.1).
"""

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from raytrace import zernike
from raytrace.grid import Grid
from raytrace.launch import rays_of_field, vignette
from raytrace.lens import with_object_distance
from raytrace.numerics import safe_divide, safe_sqrt
from raytrace.psf.dft import (
    disc_rule,
    integrate,
    nodes_per_pixel,
    phasor,
    rings_and_arms,
    rings_to_grid,
    sub_pixels,
    to_grid,
    to_grid_mirrored,
)
from raytrace.pupil import gauss_rings
from raytrace.scene import Kernels, Scene
from raytrace.surface import inside
from raytrace.trace import media, steps
from raytrace.value import value
from raytrace.wavefront import Wavefront, rays_on_sensor, wavefront

_MOST_RAYS = 400_000  # rays of one kernel; beyond, the phase is refused
_TERMS = 66  # Zernike terms (to degree 10) of the map from the pupil to directions
_PROBE = 8, 32  # rings and arms of the rays that find the map and the sampling
_SCAN, _SECTIONS, _ZOOMS = 24, 16, 6  # the edge of the pupil is found to 16⁻⁶/24 of its radius


@value
class Waves:
    """Plane waves that meet at the sensor: (D, F, W, P) of one field, ready to be summed.

    amplitude: √(E Ω), 0 where no light comes; wavefront: its OPD, directions and centre.
    symmetry: "round": each ray stands for its ring; "mirror": for itself and its image in x; "none".
    """

    amplitude: Tensor
    wavefront: Wavefront
    symmetry: str


def kernels(scene: Scene, grid: Grid, *, order: int = 0) -> Kernels:
    """Kernels of the wave model; a kernel whose light is blocked altogether is 0 with gradient 0.

    order: each one adds rays and pixel nodes; two successive ones estimate the error.
    centroid and covariance are those of the rays: the mean of the wave is theirs (Ehrenfest), its second moment does
    not exist behind a hard edge. residual: size of the terms that Debye's integral leaves out.
    Raises ValueError where the window or the blur would need too many rays.
    """
    fields = [_field_kernels(_one_field(scene, f), _one_field_grid(grid, f), order) for f in range(scene.shape[1])]
    kernel, centroid, covariance, residual = (
        torch.cat(parts, axis)
        for parts, axis in zip(zip(*(entries for _, *entries in fields), strict=True), (1, 2, 2, 1), strict=True)
    )
    return Kernels(kernel, grid, centroid, covariance, max(rays for rays, *_ in fields), residual)


def waves(scene: Scene, reach: Tensor | float, *, order: int = 0) -> Waves:
    """Waves of one field, sampled for points up to `reach` mm from the chief ray's point.

    The rays are Gauss rings over the pupil; where it is vignetted, over the clear part of every arm. One arm is enough
    on the axis of a round lens, half the arms for a field in the y-z plane.
    """
    probe, symmetry = _probe(scene), _symmetry(scene)
    phase = phase_along_radius(probe, reach)
    rings, arms = rings_and_arms(phase, order)
    if symmetry == "round":
        arms, rule = 1, gauss_rings(rings, 1, dtype=probe.opd.dtype, device=probe.opd.device)
    else:
        rule = disc_rule(phase, order, most=_MOST_RAYS, what="the wave model", like=probe.opd)
    clear = _clear_arms(scene, arms, like=probe.opd)
    pupil, weights = rule if clear is None else _between(*clear, *rule)
    if symmetry == "mirror":
        right = rule[0][0] > 0
        pupil, weights = pupil[..., right], 2 * weights[..., right]
    front = wavefront(scene, pupil, weights)
    solid = math.pi * weights * _jacobian(_direction_map(probe), pupil)
    return Waves(safe_sqrt(front.energy * solid), front, symmetry)


def amplitude(waves: Waves, x: Tensor, y: Tensor) -> Tensor:
    """U (D, F, W, Y, X) in 1/mm at x (..., X), y (..., Y) mm from the chief ray's point, by a matrix DFT."""
    front = waves.wavefront
    wavelength = 1e-3 * front.wavelength
    L, M, _ = front.direction
    field = waves.amplitude * phasor(front.opd / wavelength[:, None])
    inside = (wavelength / front.index).expand(field.shape[:-1])
    if waves.symmetry == "round":
        U = rings_to_grid(field, safe_sqrt(L * L + M * M), x, y, inside)
    elif waves.symmetry == "mirror":
        U = to_grid_mirrored(0.5 * field, L, M, x, y, inside)
    else:
        U = to_grid(field, L, M, x, y, inside)
    return U / inside[..., None, None]


def strehl(scene: Scene, *, order: int = 0) -> Tensor:
    """Strehl ratio (D, F, W): the largest intensity on the sensor over Σ² of the same amplitudes without aberrations.

    The best point of the sensor plane, within 4 λ/NA of the centroid, is searched without gradient: to first order the
    value does not depend on it. 0 where no light arrives.
    """
    ratios = [_strehl(_one_field(scene, f), order) for f in range(scene.shape[1])]
    return torch.cat(ratios, 1)


def phase_along_radius(probe: Wavefront, reach: Tensor | float) -> float:
    """Largest change of phase in radians along a pupil radius, seen from points up to `reach` mm from the centre.

    dΦ/dp = (2πn/λ) |∂(L, M)/∂p · (x_ray - x)|: directions times the distance between ray and point.
    """
    with torch.no_grad():
        spread = _half_spread(probe)[..., None]
        blur = torch.where(probe.usable, torch.linalg.vector_norm(probe.landing, dim=0), 0.0).amax(-1, keepdim=True)
        phase = 2e3 * math.pi * (probe.index / probe.wavelength)[:, None] * spread * (blur + reach)
        return float(phase.max())


def _field_kernels(scene: Scene, grid: Grid, order: int) -> tuple:
    """Rays, kernel (D, 1, W, rows, columns), centroid, covariance and residual of one field."""
    probe = _probe(scene)
    centre = grid.centre.reshape(2, *(grid.centre.shape[1:] or (1, 1, 1))) - probe.centre[:2]
    local = Grid(grid.pitch, grid.rows, grid.columns, centre)
    cutoff = 2e3 * float((_half_spread(probe) * probe.index / probe.wavelength).max())
    x, y, weight = sub_pixels(local, nodes_per_pixel(float(grid.pitch), cutoff, order))
    corner = torch.hypot(x.detach().abs().amax(-1), y.detach().abs().amax(-1)).max()
    light = waves(scene, corner, order=order)
    U = amplitude(light, x, y)
    centroid, covariance = _moments(light)
    residual = _debye_residual(light.wavefront, probe, corner)
    kernel = integrate(U.real**2 + U.imag**2, weight, grid.pitch)
    return light.amplitude.shape[-1], kernel, centroid, covariance, residual


def _probe(scene: Scene) -> Wavefront:
    """A few hundred rays that find the blur, the map of directions and so the sampling."""
    points, weights = gauss_rings(*_PROBE, dtype=scene.wavelengths.dtype, device=scene.wavelengths.device)
    return wavefront(scene, points, weights)


def _symmetry(scene: Scene) -> str:
    """What a field of a lens has in common with its mirror images; "none" where a gradient may break it."""
    apertures = [a for surface in scene.lens.surfaces for a in surface.apertures]
    if scene.fields.requires_grad or scene.lens.fields.vignetting is not None or bool((scene.fields[0] != 0).any()):
        return "none"
    if any(a.centre[0] != 0 for a in apertures):
        return "none"
    if bool((scene.fields[1] != 0).any()) or any(a.centre[1] != 0 or a.shape != "circular" for a in apertures):
        return "mirror"
    return "round"


def _moments(light: Waves) -> tuple[Tensor, Tensor]:
    """Centroid (2, ...) mm on the sensor and covariance (3, ...) mm² of the rays."""
    front = light.wavefront
    share = safe_divide(front.energy, front.energy.sum(-1, keepdim=True))
    x, y = torch.where(front.valid, front.landing, 0.0)
    if light.symmetry == "round":
        variance, zero = 0.5 * (share * (x * x + y * y)).sum(-1), torch.zeros_like(share[..., 0])
        return front.centre[:2], torch.stack([variance, zero, variance])
    mean_x, mean_y = (share * x).sum(-1), (share * y).sum(-1)
    if light.symmetry == "mirror":
        mean_x = torch.zeros_like(mean_x)
    x, y = x - mean_x[..., None], y - mean_y[..., None]
    xy = torch.zeros_like(mean_x) if light.symmetry == "mirror" else (share * x * y).sum(-1)
    covariance = torch.stack([(share * x * x).sum(-1), xy, (share * y * y).sum(-1)])
    return front.centre[:2] + torch.stack([mean_x, mean_y]), covariance


def _debye_residual(front: Wavefront, probe: Wavefront, corner: Tensor) -> Tensor:
    """2π n b² s²/(2 |R| λ) (...): phase that |q - p| - R leaves out beside L x + M y, over the window or the blur b."""
    with torch.no_grad():
        spread = _half_spread(probe)
        wavelength = 1e-3 * front.wavelength / front.index
        blur = torch.where(probe.usable, torch.linalg.vector_norm(probe.landing, dim=0), 0.0).amax(-1)
        b = torch.minimum(corner, blur + wavelength / spread.clamp_min(1e-30))
        return math.pi * (b * spread) ** 2 / (front.radius.abs() * wavelength)


def _half_spread(front: Wavefront) -> Tensor:
    """Largest distance (...) of the directions (L, M) of the rays from their mean."""
    L, M = torch.where(front.usable, front.direction[:2], 0.0).detach()
    count = front.usable.sum(-1, keepdim=True).clamp_min(1)
    dL, dM = L - L.sum(-1, keepdim=True) / count, M - M.sum(-1, keepdim=True) / count
    return torch.where(front.usable, torch.hypot(dL, dM), 0.0).amax(-1)


def _orders() -> list[tuple[int, int]]:
    return [zernike.noll(j) for j in range(1, _TERMS + 1)]


def _direction_map(probe: Wavefront) -> Tensor:
    """Zernike coefficients (2, ..., J) of L and M over the pupil; 0 where too few rays come through."""
    basis = zernike.polynomials(_orders(), *probe.pupil)
    enough = probe.usable.sum(-1, keepdim=True) >= 2 * _TERMS
    weights = torch.where(probe.usable | ~enough, probe.weights, 0.0)
    directions = torch.where(probe.usable & enough, probe.direction[:2], 0.0)
    return zernike.fit(directions, basis, weights)


def _jacobian(directions: Tensor, pupil: Tensor) -> Tensor:
    """|∂(L, M)/∂(p_x, p_y)| (..., P) at pupil points."""
    by_x, by_y = (g.movedim(0, -2) for g in zernike.gradients(_orders(), *pupil))
    (L_x, M_x), (L_y, M_y) = ((directions[..., None, :] @ g)[..., 0, :] for g in (by_x, by_y))
    return (L_x * M_y - L_y * M_x).abs()


def _clear_arms(scene: Scene, arms: int, *, like: Tensor) -> tuple[Tensor, Tensor] | None:
    """Radii (D, F, W, arms) between which light passes along each arm of a ring rule; None if everything passes.

    The first and the last clear point of a scan, refined by repeated division. A gap inside (the arm of a spider)
    stays: its rays are blocked one by one.
    """
    angle = (torch.arange(arms, dtype=like.dtype, device=like.device) + 0.5) * (2 * math.pi / arms)
    unit = torch.stack([torch.cos(angle), torch.sin(angle)])

    def clear(radii: Tensor) -> Tensor:
        """(K, D, F, W, arms) for radii (K, D, F, W, arms), or (K, 1, 1, 1, arms) for all alike."""
        points = torch.stack([(radii * direction).movedim(0, -2).flatten(-2) for direction in unit])
        points = points.reshape(2, -1) if radii.shape[1:4] == (1, 1, 1) else points
        return rays_on_sensor(scene, points).valid.unflatten(-1, (len(radii), arms)).movedim(-2, 0)

    with torch.no_grad():
        step = torch.arange(_SCAN + 1, dtype=angle.dtype, device=angle.device) / _SCAN
        passed = clear(step[:, None, None, None, None].expand(-1, 1, 1, 1, arms))
        if bool(passed.all()):
            return None
        first = passed.to(torch.int8).argmax(0)
        last = _SCAN - passed.flip(0).to(torch.int8).argmax(0)
        some = passed.any(0)
        edges = [_edge(clear, step[i], step[(i + d).clamp(0, _SCAN)]) for i, d in ((first, -1), (last, 1))]
    return tuple(torch.where(some, _follow_rim(scene, *edge, unit), 0.0) for edge in edges)


def _edge(clear: Callable[[Tensor], Tensor], passes: Tensor, blocked: Tensor) -> tuple[Tensor, Tensor]:
    """The last radius (...) that passes on the way from one that does to one that does not, and the next."""
    share = torch.arange(_SECTIONS + 1, dtype=passes.dtype, device=passes.device) / _SECTIONS
    for _ in range(_ZOOMS):
        radii = passes + share.reshape(-1, *(1,) * passes.dim()) * (blocked - passes)
        reached = clear(radii)[1:].to(torch.int64).cumprod(0).sum(0)
        passes, blocked = (
            torch.gather(radii, 0, index[None])[0] for index in (reached, (reached + 1).clamp_max(_SECTIONS))
        )
    return passes, blocked


def _follow_rim(scene: Scene, passes: Tensor, blocked: Tensor, unit: Tensor) -> Tensor:
    """The radius `passes` with the derivatives of a rim that moves with the lens.

    The ray just outside is stopped where its r² in an aperture has the value of the rim, r²(ρ, θ) = constant:
        dρ/dθ = -(∂r²/∂θ) / (∂r²/∂ρ)
    for circular apertures; a rim of another shape, or where rays miss a surface, stands still.
    """
    if not torch.is_grad_enabled():
        return passes
    radius = blocked.clone().requires_grad_()
    along = _level_at_rim(scene, radius * unit[0], radius * unit[1])
    if not along.requires_grad:
        return passes
    (slope,) = torch.autograd.grad(along.sum(), radius, retain_graph=True)
    level = _level_at_rim(scene, blocked * unit[0], blocked * unit[1])
    return passes - safe_divide(level - level.detach(), slope)


def _level_at_rim(scene: Scene, *pupil: Tensor) -> Tensor:
    """r² (D, F, W, P) in mm² of rays in the circular aperture that stops them; 0 for others."""
    lens = with_object_distance(scene.lens, scene.lens.surfaces[0].thickness[..., None])
    field, wavelength = scene.fields[:, :, None, None], scene.wavelengths[:, None]
    rays = rays_of_field(lens, field, vignette(lens, field, torch.stack(pupil)), wavelength=wavelength)
    level = torch.zeros_like(pupil[0])
    walk = steps(lens.surfaces[1:], rays, indices=media(lens, wavelength))
    for surface, crossing in zip(lens.surfaces[1:], walk, strict=True):
        for aperture in surface.apertures:
            stops = ~inside(dataclasses.replace(surface, apertures=(aperture,)), crossing.rays.position)
            x, y = (crossing.rays.position[i] - aperture.centre[i] for i in (0, 1))
            here = crossing.clipped & stops & (level == 0) & (aperture.shape == "circular")
            level = torch.where(here, x * x + y * y, level)
    return level


def _between(inner: Tensor, outer: Tensor, pupil: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """A ring rule squeezed, arm by arm, into the clear annulus: r² = i² + (o² - i²) u; same share of its area."""
    arms = inner.shape[-1]
    rings = pupil.shape[1] // arms
    share = outer**2 - inner**2
    u = (pupil**2).sum(0).reshape(rings, arms)[:, 0]
    radius = torch.sqrt(inner[..., None, :] ** 2 + share[..., None, :] * u[:, None])
    unit = pupil[:, :arms] / torch.hypot(*pupil[:, :arms])
    points = torch.stack([(radius * direction).flatten(-2) for direction in unit])
    return points, (share[..., None, :] * weights.reshape(rings, arms)).flatten(-2)


def _strehl(scene: Scene, order: int) -> Tensor:
    probe = _probe(scene)
    spacing = 0.25e-3 * probe.wavelength / probe.index / _half_spread(probe).clamp_min(1e-30)
    light = waves(scene, 20 * spacing.max(), order=order + 1)
    front = light.wavefront
    with torch.no_grad():
        x, y = _moments(light)[0] - front.centre[:2]
        offsets = torch.arange(-16, 17, dtype=x.dtype, device=x.device)
        for _ in range(8):
            near_x, near_y = (c[..., None] + offsets * spacing[..., None] for c in (x, y))
            U = amplitude(light, near_x, near_y)
            best = (U.real**2 + U.imag**2).flatten(-2).argmax(-1, keepdim=True)
            x = torch.gather(near_x, -1, best % len(offsets))[..., 0]
            y = torch.gather(near_y, -1, best // len(offsets))[..., 0]
            spacing = spacing / 8
    U = amplitude(light, x[..., None], y[..., None])[..., 0, 0]
    peak = light.amplitude.sum(-1) / (1e-3 * front.wavelength / front.index)
    return safe_divide(U.real**2 + U.imag**2, peak**2)


def _one_field(scene: Scene, f: int) -> Scene:
    return Scene(scene.lens, scene.fields[:, f : f + 1], scene.wavelengths)


def _one_field_grid(grid: Grid, f: int) -> Grid:
    centre = grid.centre
    if centre.dim() > 1 and centre.shape[2] > 1:
        centre = centre[:, :, f : f + 1]
    return Grid(grid.pitch, grid.rows, grid.columns, centre)
