"""Plan: which engine computes the PSFs of a scene, how finely, at what cost, and how wrong it will be.

    pupil      N cells across D repeat the image every P = λzN/D: P >= reach of the window + half the blur
    radial     Gauss radii between steps by the phase between them
    fresnel    dx <= λz/(D + blur) samples the converging field; |f| < L/(2λz) keeps light from wrapping round
    pixels     Gauss nodes by the cutoff D/(λz) of the intensity

Errors are relative L2 norms, from fits to converged references: mostly upper bounds, within a factor of ten. A PSF
wider than its window leaves light out, which is no error here.
"""

import math
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from raytrace.glass import index
from raytrace.psf.dft import Aliased, rings_and_arms
from raytrace.psf.ladder import NotConverged
from raytrace.psf.radial import is_centred, reach
from raytrace.pupil import gauss_rings
from raytrace.wave import propagate, radial
from raytrace.wave.element import Pixels, Rings, profile_height
from raytrace.wave.pupil import cells_across
from raytrace.wave.scene import WaveScene, aperture, check, is_round, is_smooth, millimetres, residual

ENGINES = "pupil", "radial", "fresnel", "angular_spectrum"
_FINEST = 4096  # cells across the aperture


class AliasedSampling(ValueError):
    """Copies of the image lie inside the window at this sampling: the result would be wrong altogether."""


@dataclass(frozen=True)
class Plan:
    """How to compute the PSFs of a scene.

    engine: one of ENGINES; samples: cells or samples across the aperture (`radial`: Gauss radii between steps);
    nodes: per pixel and axis (`radial`: of its rule); cells: "smooth", "sampled" or "flat", what stands in a cell of
    the pupil; extent: of the cells over the diameter; inner: Gauss nodes in a flat cell, parts: cells
    along a flat pixel; pad, band_limit: of the
    transfer functions. error: predicted, relative L2 of the worst kernel; flops, memory (bytes): predicted.
    """

    engine: str
    samples: int
    nodes: int
    error: float
    flops: float
    memory: float
    cells: str = "smooth"
    extent: float = 1.0
    inner: int = 1
    parts: int = 1
    pad: float = 1.0
    band_limit: bool = True


@dataclass(frozen=True)
class _Setting:
    """Numbers of a scene that sampling depends on; mm."""

    diameter: float
    distance: float
    shortest: float
    blur: float  # radius on the sensor
    reach: float  # from the axis to the farther edge of the window
    kernels: tuple[int, int]
    size: int
    pixels: int
    bytes: int
    band: float  # π · cutoff · pixel: half the phase of the finest intensity across a pixel

    def period(self, samples: float) -> float:
        """Distance mm of the copies of the image that so many cells across the aperture make."""
        return self.shortest * self.distance * samples / self.diameter


def plan(
    scene: WaveScene,
    *,
    engine: str = "auto",
    samples: int | None = None,
    nodes: int | None = None,
    tol: float = 1e-3,
    pad: float = 2.0,
    band_limit: bool = True,
) -> Plan:
    """The cheapest sampling whose predicted error is at most tol (relative L2), or what a given one will do.

    engine: one of ENGINES, or "auto": `radial` for round elements and a window on the axis, else `pupil`. samples,
    nodes: to be used as they are (`Plan`). pad, band_limit: of the transfer functions; pad 1.5 without a band limit is
    the talk's.
    Raises AliasedSampling where copies of the image would lie in the window, ValueError where an engine cannot hold
    the scene; warns `psf.dft.Aliased` where the converging field is undersampled, and `NotConverged` where the finest
    sampling there is does not meet tol.
    """
    check(scene)
    round_scene = is_round(scene) and is_centred(scene.grid)
    if engine == "auto":
        engine = "radial" if round_scene else "pupil"
    if engine not in ENGINES:
        raise ValueError(f"no engine {engine!r}; choose among auto, {', '.join(ENGINES)}")
    if engine == "radial" and not round_scene:
        raise ValueError("the radial engine needs round elements and a grid centred on the axis; use engine='pupil'")
    setting = _setting(scene)
    chosen = nodes if nodes is not None else _count(setting.band, 0.4 * tol / 0.15)
    if engine == "radial":
        found = _radial(scene, setting, samples, nodes, tol)
    elif engine == "pupil":
        found = _pupil(scene, setting, samples, chosen, tol)
    else:
        return _transfer(setting, engine, samples, chosen, pad, band_limit)
    if samples is None and nodes is None and found.error > tol:
        message = f"predicted error {found.error:.2g} above the tolerance {tol:.2g} with {found.samples} samples"
        warnings.warn(f"{message}; the worst is a blur of ±{setting.blur:.3g} mm", NotConverged, stacklevel=2)
    return found


def blur(scene: WaveScene) -> Tensor:
    """Geometric radius (D, W) mm of the light on the sensor, of the smooth profiles; steps spread light beside it."""
    R = aperture(scene).detach()
    points, _ = gauss_rings(24, dtype=R.dtype, device=R.device)
    edge = torch.linspace(0, 2 * math.pi, 97, dtype=R.dtype, device=R.device)
    x, y = R * torch.cat([points, torch.stack([torch.cos(edge), torch.sin(edge)])], 1)
    bent = torch.stack([torch.linalg.vector_norm(slopes(scene, x, y, order), dim=0) for order in (False, True)])
    return bent.amax((0, -1)) * scene.sensor_distance.detach()


def slopes(scene: WaveScene, x: Tensor, y: Tensor, diffracted: bool = False) -> Tensor:
    """Gradient (2, D, W, P) of the residual path at points (P,), of heights before they are wrapped or stepped.

    diffracted: a wrapped height bends as its first order, λ/period times its gradient.
    """
    wavelength = millimetres(scene).detach()
    r2, z = x * x + y * y, scene.sensor_distance.detach()
    total = torch.zeros(2, len(scene.depths), len(wavelength), len(x), dtype=x.dtype, device=x.device)
    position = torch.stack([x, y])[:, None, None]
    for v in ((1 / scene.depths.detach())[:, None, None], 1 / z):
        total = total + position * (v / torch.sqrt(1 + r2 * v * v) if scene.exact else v)
    for element in scene.elements:
        if isinstance(element.profile, Pixels | Rings):
            continue
        power = index(element.glass, scene.wavelengths.detach()).to(x) - 1
        if diffracted and element.period is not None:
            power = wavelength / element.period.detach()
        with torch.enable_grad():
            a, b = x.clone().requires_grad_(), y.clone().requires_grad_()
            h = profile_height(element.profile, a, b, radius=element.radius.detach())
            gradient = torch.stack(torch.autograd.grad(h.sum(), (a, b)))
        total = total + power[:, None] * gradient[:, None, None]
    return total


def _setting(scene: WaveScene) -> _Setting:
    centre = [abs(float(c)) for c in scene.grid.centre.detach()]
    pitch = float(scene.grid.pitch.detach())
    sides = (0.5 * pitch * n for n in scene.grid.shape[::-1])
    return _Setting(
        diameter=2 * float(aperture(scene).detach()),
        distance=float(scene.sensor_distance.detach()),
        shortest=float(millimetres(scene).detach().min()),
        blur=float((_blur_of_pixels(scene) if _only_pixels(scene) else blur(scene)).max()),
        reach=max(c + side for c, side in zip(centre, sides, strict=True)),
        kernels=(len(scene.depths), len(scene.wavelengths)),
        size=max(scene.grid.shape),
        pixels=scene.grid.rows * scene.grid.columns,
        bytes=scene.sensor_distance.element_size(),
        band=math.pi * radial.cutoff(scene) * pitch,
    )


# -- the engines -------------------------------------------------------------------------------------------------------


def _pupil(scene: WaveScene, s: _Setting, samples: int | None, nodes: int, tol: float) -> Plan:
    least = s.diameter * (s.reach + s.blur) / (s.shortest * s.distance)
    if samples is not None and samples < least and not _only_pixels(scene):
        raise AliasedSampling(
            f"{samples} cells across the aperture repeat the image every {1e3 * s.period(samples):.0f} µm, inside the "
            f"window of ±{1e3 * s.reach:.0f} µm with a blur of ±{1e3 * s.blur:.0f} µm: take at least "
            f"{math.ceil(least)} samples, or a smaller window"
        )
    kind, extent, inner, parts = "smooth", 1.0, 1, 1
    if _only_pixels(scene):
        profile, kind = scene.elements[0].profile, "flat"
        across = max(cells_across(profile.pitch, n, aperture(scene)) for n in profile.heights.shape)
        wanted = samples or min(_FINEST, _least(lambda n: _area_error(s, n), 0.5 * tol))
        parts = max(1, math.ceil(wanted / across))
        samples, pitch = parts * across, float(profile.pitch.detach()) / parts
        near = 1 / float(scene.depths.detach().min()) + 1 / s.distance
        half_phase = math.pi / s.shortest * pitch * (0.5 * s.diameter * near + s.reach / s.distance)
        inner = _count(half_phase, 0.1 * tol)
        error = _bessel(half_phase, inner) + _area_error(s, samples)
    elif all(is_smooth(element) for element in scene.elements):
        samples = samples or _even(max(1.05 * least, _least(lambda n: _edge_error(s, n), 0.5 * tol)))
        error = _edge_error(s, samples)
    else:
        kind, step = "sampled", _finest_step(scene)
        samples = samples or _even(max(1.05 * least, _least(lambda n: _step_error(s, n, step), 0.5 * tol)))
        samples, extent = _aligned(scene, s, samples)
        error = _step_error(s, samples / extent, step)
    error += 0.15 * _bessel(s.band, nodes)
    D, W = s.kernels
    K = s.size * nodes
    cells = samples + 6 if kind == "smooth" else samples
    flops = 2 * D * W * (K * cells**2 + K**2 * cells + 30 * cells**2) * (1 if kind != "flat" else 4)
    memory = s.bytes * (D * W * (6 * cells**2 + 4 * K * cells + 8 * K**2) + 4 * W * K * cells)
    return Plan("pupil", samples, nodes, error, flops, memory, cells=kind, extent=extent, inner=inner, parts=parts)


def _radial(scene: WaveScene, s: _Setting, samples: int | None, nodes: int | None, tol: float) -> Plan:
    half = _half_phases(scene, s)
    if samples is None:
        samples = _count(half, 0.1 * tol) if half < 20 else rings_and_arms(2 * half, 0 if tol > 1e-6 else 1)[0]
    # Nodes of the rule of pixels from order -2 on (`radii_of_waves`).
    base = math.ceil(0.5 * s.band) + 4
    nodes = max(base - 2, _count(s.band, 0.5 * tol / 0.15)) if nodes is None else max(nodes, base - 2)
    enough = half < 20 or samples >= rings_and_arms(2 * half, 0)[0]
    error = 0.15 * _bessel(s.band, nodes) + (min(1.0, _bessel(half, samples)) if half < 20 else 1e-7 if enough else 0.3)
    D, W = s.kernels
    J = samples * (len(radial.edges(scene)) - 1)
    K = math.ceil(s.band * reach(scene.grid) + 1.5 * (4 + (2 * s.band * reach(scene.grid)) ** (1 / 3)))
    flops = W * K * J * 4 * D + D * W * (K * s.pixels / 4 + 40 * J)
    return Plan("radial", samples, nodes, error + 1e-7, flops, s.bytes * (3 * W * K * J + K * s.pixels / 8))


def _transfer(s: _Setting, engine: str, samples: int | None, nodes: int, pad: float, band_limit: bool) -> Plan:
    least = s.diameter * (s.diameter + 2 * s.blur) / (s.shortest * s.distance)
    if samples is None:
        samples = _even(1.3 * least)
    if samples < least:
        warnings.warn(
            f"the converging field is undersampled: {1e3 * s.diameter / samples:.3g} µm a sample, where λz/(D + blur) "
            f"is {1e3 * s.diameter / least:.3g} µm at {1e3 * s.shortest:.3g} µm; light of the rim is lost or "
            f"misplaced. Take at least {math.ceil(least)} samples or the pupil engine",
            Aliased,
            stacklevel=3,
        )
    size = propagate.padded(samples, pad)
    lost = max(0.0, 1 - (samples / least) ** 2)
    error = 0.1 / samples + lost + 0.15 * _bessel(s.band, nodes) + (0.0 if band_limit and pad >= 2 else 1e-4)
    D, W = s.kernels
    transform = 5 * size**2 * math.log2(size**2)
    memory = s.bytes * 2 * (D * size**2 * 4 + 2 * size**2)
    return Plan(engine, samples, nodes, error, 2 * D * W * transform, memory, pad=pad, band_limit=band_limit)


# -- their errors ------------------------------------------------------------------------------------------------------


def _edge_error(s: _Setting, samples: int) -> float:
    """Of N cells with weights of sixth order at the rim: fitted over blurs and windows.

    The edge counts for more where the blur is few waves of defocus, or much wider than the window.
    """
    period = s.period(samples)
    waves = max(0.5, 0.25 * s.blur * s.diameter / (s.distance * s.shortest))
    share = 0.016 * (1 + 4 / waves) * max(1.0, s.blur / s.reach) ** 0.6
    return min(1.0, share * (2 * s.blur / period) ** 3.7 + 2e-4 * (s.reach / period) ** 2 + _tail(s, samples))


def _step_error(s: _Setting, samples: float, step: float | None) -> float:
    """Of N cells over a profile with steps; step: width mm of the narrowest flat that cells do not share, or None."""
    bent = 0.5 * ((s.blur + s.reach) / s.period(samples)) ** 2
    return min(1.0, _area_error(s, samples) + bent + (0.0 if step is None else 0.5 * s.diameter / samples / step))


def _tail(s: _Setting, samples: int) -> float:
    """Of the light diffracted at the edge of the copies next to the window, which falls as the square of the gap."""
    gap = s.period(samples) - s.blur - s.reach
    airy = s.shortest * s.distance / s.diameter
    return 0.3 * (airy / gap) ** 2 if gap > airy else 1.0


def _area_error(s: _Setting, samples: int) -> float:
    """Of N cells that count at the rim by their area inside, fitted likewise."""
    period = s.period(samples)
    return min(1.0, 0.2 * (2 * s.blur / period) ** 2 + 5e-4 * (s.reach / period) ** 2 + _tail(s, samples))


def _bessel(a: float, nodes: int) -> float:
    """Error of n Gauss nodes for exp(iat) over [-1, 1], about J_2n(a) <= (a/2)^2n/(2n)!."""
    return min(1.0, math.exp(2 * nodes * math.log(max(a, 1e-9) / 2) - math.lgamma(2 * nodes + 1)))


def _count(a: float, tol: float) -> int:
    """Gauss nodes for that error to be at most tol."""
    return next(n for n in range(max(1, math.ceil(a / 2)), 10_000) if _bessel(a, n) <= tol)


def _half_phases(scene: WaveScene, s: _Setting) -> float:
    """Largest half of the phase, radians, that the integrand of the radial engine turns between two steps."""
    edges = radial.edges(scene).detach()
    r = torch.linspace(0, 1, 513, dtype=edges.dtype, device=edges.device) * edges[-1]
    bent = slopes(scene, r, torch.zeros_like(r))[0].abs().amax((0, 1)) + math.sqrt(2) * s.reach / s.distance
    turned = torch.cumsum(bent, 0) * (edges[-1] / 512)
    at_edges = turned[(edges / edges[-1] * 512).round().long()] if len(edges) == 2 else None
    across = at_edges.diff() if at_edges is not None else edges.diff() * bent[(edges[1:] / edges[-1] * 512).long()]
    return float(math.pi / s.shortest * across.max())


def _blur_of_pixels(scene: WaveScene) -> Tensor:
    """Radius (D, W) mm of a disc as wide, in the mean square, as the light behind a map of pixels.

    Where the bare sphere is too steep for the steps between pixels to tell, the light is as wide as without them.
    """
    profile, R = scene.elements[0].profile, aperture(scene).detach()
    pitch = profile.pitch.detach()
    y, x = ((torch.arange(n, dtype=R.dtype, device=R.device) - 0.5 * (n - 1)) * pitch for n in profile.heights.shape)
    x, y = torch.broadcast_tensors(x, y[:, None])
    waves = residual(scene, x, y).detach() / millimetres(scene).detach()[:, None, None]
    inside = (x * x + y * y <= R * R).to(R)
    total = torch.zeros_like(waves[..., 0, 0])
    for dim in (-2, -1):
        step = waves.diff(dim=dim)
        both = inside.narrow(dim, 0, inside.shape[dim] - 1) * inside.narrow(dim, 1, inside.shape[dim] - 1)
        total = total + (((step - step.round()) ** 2) * both).sum((-2, -1)) / both.sum().clamp(min=1)
    widest = millimetres(scene).detach() * scene.sensor_distance.detach() / pitch
    bare = blur(scene)
    return torch.where(bare > 0.5 * widest, bare, torch.sqrt(2 * total) * widest)


def _only_pixels(scene: WaveScene) -> bool:
    return not scene.exact and len(scene.elements) == 1 and isinstance(scene.elements[0].profile, Pixels)


def _finest_step(scene: WaveScene) -> float | None:
    """Width mm of the narrowest ring, pixel or zone whose edges lie between cells; None if there is none."""
    widths = []
    R = aperture(scene).detach()
    r = torch.linspace(0, 1, 65, dtype=R.dtype, device=R.device) * R
    for element in scene.elements:
        if isinstance(element.profile, Rings) or (isinstance(element.profile, Pixels) and scene.exact):
            widths.append(float(element.profile.pitch.detach()))
        elif element.period is not None and not isinstance(element.profile, Pixels):
            h = profile_height(element.profile, r, torch.zeros_like(r), radius=element.radius).detach()
            steepest = float((h.diff() / r.diff()).abs().max())
            widths.append(float(element.period.detach()) / max(steepest, 1e-12) / max(1, element.levels))
    return min(widths, default=None)


def _aligned(scene: WaveScene, s: _Setting, samples: int) -> tuple[int, float]:
    """At least so many cells, a whole number to each pixel of a map, and their extent over the diameter."""
    maps = [e.profile for e in scene.elements if isinstance(e.profile, Pixels)]
    if not maps or scene.exact:
        return samples, 1.0
    finest = min(maps, key=lambda m: float(m.pitch.detach()))
    across = max(cells_across(finest.pitch, n, aperture(scene)) for n in finest.heights.shape)
    extent = across * float(finest.pitch.detach()) / s.diameter
    return across * math.ceil(samples * extent / across), extent


def _least(error, tol: float) -> int:
    return next((n for n in range(16, _FINEST, 4) if error(n) <= tol), _FINEST)


def _even(number: float) -> int:
    return max(16, 2 * math.ceil(0.5 * number))
