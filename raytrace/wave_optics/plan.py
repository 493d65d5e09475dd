"""Plan: which engine computes the PSFs of a scene, how finely, at what cost, and with which error.

    pupil      N cells across D repeat the image every P = λzN/D: P >= reach of the window + half the blur
    radial     Gauss radii between steps by the phase between them
    fresnel    dx <= λz/(D + blur) samples the converging field; |f| < L/(2λz) keeps light from wrapping round
    pixels     Gauss nodes by the cutoff D/(λz) of the intensity

Errors are relative L2 norms, fitted to converged references of two dozen scenes: half to five times the measured error
where that is above 1e-4. A PSF wider than its window leaves light out, which is no error here. Stray light, spread
evenly with a density ε per mm², errs by √(2 ε A), A the area of the light.

`spread` finds by rays where light lands, before anything is computed. Rays are refracted by the local slope of the
residual path, W(x + s) - W(x) over s, modulo a wave: over flat features s is their pitch, so that a staircase refracts
as the slope it follows.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from raytrace.maths.numerics import to, value
from raytrace.maths.sampling import gauss_rings
from raytrace.psf_models.dft import Aliased, integrate, rings_and_arms, sub_pixels
from raytrace.psf_models.models import NotConverged
from raytrace.psf_models.radial import is_centred, reach
from raytrace.wave_optics import mixed, propagation, pupil
from raytrace.wave_optics.element import (
    Element,
    Pixels,
    Rings,
    designed_height,
    excess_index,
    fabricated_height,
    has_features,
    height,
    is_flat,
    is_smooth,
    slopes_of,
)
from raytrace.wave_optics.mixed import deflection, extent_of, is_mixed, radii_of_band, round_part
from raytrace.wave_optics.pupil import cells_across
from raytrace.wave_optics.scene import WaveScene, aperture, check, is_round, millimetres, residual, spheres
from raytrace.words import RaytraceError, calling_level

_RAYS = 4096
_AIRY = 2.4  # λz/D: √(1/∫I²) of a kernel in focus, behind pixels as large as its core


@value
class Spread:
    """Distribution of light on the sensor: width (D, W) mm, √2 times the RMS distance from the axis, the radius of an
    even disc; area (D, W) mm², ∫I/∫I² inside the window; steps (W,) 1/mm, Σ |jump of the field|² · length of the edge
    over the area of the aperture.
    """

    width: Tensor
    area: Tensor
    steps: Tensor


@torch.no_grad()
def spread(scene: WaveScene) -> Spread:
    """The spread of a scene, by 4096 rays a kernel.

    Free features keep the share |⟨exp(iφ)⟩|² of the light where it would go without them, and scatter the rest; wrapped
    heights refract as their first order.
    """
    scene = to(scene, dtype=torch.float64)
    free = [e for e in scene.elements if is_free(e)]
    whole = [e for e in scene.elements if not is_free(e)]
    R = aperture(scene)
    # Random over the disc: an ordered rule would bias the distances of pairs.
    place, turn = torch.rand(2, _RAYS, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(R)
    r, angle = R * torch.sqrt(place), 2 * math.pi * turn
    points = r * torch.cos(angle), r * torch.sin(angle)
    phase = 2 * math.pi * _waves(scene, free, *points)
    coherent = torch.cos(phase).mean(-1) ** 2 + torch.sin(phase).mean(-1) ** 2 if free else phase[:, 0]
    width = squares = light = coherent.new_zeros(len(scene.depths), len(scene.wavelengths))
    for share, elements in [(coherent[None], whole)] * bool(free) + [(1 - coherent[None], scene.elements)]:
        x, y = _landings(scene, elements, *points)
        inside, squared = _sums_in_bins(scene, x, y)
        width = width + share * 2 * (x * x + y * y).mean(-1)
        light, squares = light + share * inside, squares + share**2 * squared
    # Where no two rays meet the light is thin: an even disc.
    area = torch.where(squares > 0, light / squares.clamp(min=1e-300), math.pi * width)
    return Spread(torch.sqrt(width), area, torch.stack([_steps_of(e, scene) for e in scene.elements]).sum(0))


def is_free(element: Element) -> bool:
    """Whether the heights are those of features and not wrapped."""
    return is_flat(element) and element.period is None


def blur(scene: WaveScene) -> Tensor:
    """Geometric radius (D, W) mm of the light of the smooth profiles on the sensor, without the light of steps."""
    R = aperture(scene).detach()
    points, _ = gauss_rings(24, dtype=R.dtype, device=R.device)
    edge = torch.linspace(0, 2 * math.pi, 97, dtype=R.dtype, device=R.device)
    x, y = R * torch.cat([points, torch.stack([torch.cos(edge), torch.sin(edge)])], 1)
    angles = torch.stack([torch.linalg.vector_norm(slopes(scene, x, y, order), dim=0) for order in (False, True)])
    return angles.amax((0, -1)) * scene.sensor_distance.detach()


def slopes(scene: WaveScene, x: Tensor, y: Tensor, diffracted: bool = False) -> Tensor:
    """Gradient (2, D, W, P) of the residual path at points (P,), of heights before they are wrapped or stepped.

    diffracted: a wrapped height refracts as its first order, λ/period times its gradient.
    """
    wavelength = millimetres(scene).detach()
    r2, z = x * x + y * y, scene.sensor_distance.detach()
    total = x.new_zeros(2, len(scene.depths), len(wavelength), len(x))
    position = torch.stack([x, y])[:, None, None]
    for v in ((1 / scene.depths.detach())[:, None, None], 1 / z):
        total = total + position * (v / torch.sqrt(1 + r2 * v * v) if scene.exact else v)
    for element in (element for element in scene.elements if not is_flat(element)):
        power = excess_index(element, scene.wavelengths.detach(), x)
        if diffracted and element.period is not None:
            power = wavelength / element.period.detach()
        total = total + power[:, None] * slopes_of(element, x, y)[:, None, None]
    return total


def blur_of_pixels(scene: WaveScene, profile: Pixels) -> Tensor:
    """Radius (D, W) mm of a disc as wide, in the mean square, as the light behind a map of pixels."""
    R = aperture(scene).detach()
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
    # Where the bare sphere is too steep to be resolved by steps between pixels, the light is as wide as without them.
    return torch.where(bare > 0.5 * widest, bare, torch.sqrt(2 * total) * widest)


def _waves(scene: WaveScene, elements: Sequence[Element], x: Tensor, y: Tensor) -> Tensor:
    """Path (W, P) in waves of elements; a wrapped height counts whole, in periods: the first order."""
    total = x.new_zeros(len(scene.wavelengths), len(x))
    for element in elements:
        excess = excess_index(element, scene.wavelengths, x) / millimetres(scene)
        scale = excess if element.period is None else (1 / element.period).expand_as(excess)
        total = total + scale[:, None] * designed_height(element, x, y)
    return total


def _landings(scene: WaveScene, elements: Sequence[Element], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Points (D, W, M) mm on the sensor of rays through some of the elements; they cross steps of rings radially."""
    R, wavelength = aperture(scene), millimetres(scene)[:, None]
    features = [e.profile.pitch for e in elements if has_features(e.profile)]
    step = min(features) if features else wavelength.min() * scene.sensor_distance / (8 * R)
    along = torch.ones_like(x), torch.zeros_like(x)
    if any(isinstance(e.profile, Rings) for e in elements):
        along = x / torch.hypot(x, y), y / torch.hypot(x, y)

    def waves(share: float, a: Tensor, b: Tensor) -> Tensor:
        u, v = x + share * step * a, y + share * step * b
        return spheres(scene, u * u + v * v)[:, None] / wavelength + _waves(scene, elements, u, v)

    def deflection_along(a: Tensor, b: Tensor) -> Tensor:
        apart = waves(0.5, a, b) - waves(-0.5, a, b)
        return (apart - apart.round()) * wavelength * scene.sensor_distance / step

    (a, b), (c, d) = along, (-along[1], along[0])
    u, v = deflection_along(a, b), deflection_along(c, d)
    return u * a + v * c, u * b + v * d


def _sums_in_bins(scene: WaveScene, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Light in the window and ∫I² over it in 1/mm², (D, W), by rays (D, W, M) counted in square bins."""
    window, finest = scene.grid, _AIRY * millimetres(scene) * scene.sensor_distance / (2 * aperture(scene))
    half = [0.5 * window.pitch * n for n in window.shape[::-1]]
    light, squares = x.new_zeros(x.shape[:-1]), x.new_zeros(x.shape[:-1])
    for w, bin in enumerate(torch.maximum(finest, window.pitch)):  # as wide as a core, or a pixel
        columns = 2 * torch.ceil(half[0] / bin) + 1
        for d in range(len(x)):
            u, v = (p[d, w] - c for p, c in zip((x, y), window.centre, strict=True))
            inside = (u.abs() <= half[0]) & (v.abs() <= half[1])
            places = torch.round(v[inside] / bin) * columns + torch.round(u[inside] / bin)
            counts = torch.unique(places, return_counts=True)[1].to(x)
            light[d, w] = counts.sum() / _RAYS
            # A pair of rays in a bin counts 1/bin²: fewer rays than bins are no bias.
            squares[d, w] = (counts * (counts - 1)).sum() / (_RAYS * (_RAYS - 1) * bin**2)
    return light, squares


def _steps_of(element: Element, scene: WaveScene) -> Tensor:
    """Σ |jump of the field|² · length of the edges of an element over the area of the aperture, (W,) 1/mm."""
    R, profile, none = aperture(scene), element.profile, torch.zeros_like(scene.wavelengths)
    waves = excess_index(element, scene.wavelengths, none) / millimetres(scene)  # of path in 1 mm of height

    def squares(jumps: Tensor) -> Tensor:
        return 2 - 2 * torch.cos(2 * math.pi * waves.reshape(-1, *[1] * jumps.dim()) * jumps)

    if has_features(profile):
        heights = fabricated_height(profile.heights, element.period, element.levels)
    if isinstance(profile, Pixels):
        pairs = [heights.diff(dim=dim) for dim in (0, 1) if heights.shape[dim] > 1]
        return sum((squares(pair).mean((-2, -1)) / profile.pitch for pair in pairs), none)
    if isinstance(profile, Rings):
        r = profile.pitch * torch.arange(1, len(heights), dtype=heights.dtype, device=heights.device)
        return (squares(heights.diff()) * r * (r < R)).sum(-1) * 2 / R**2
    if element.period is None:
        return none
    r = propagation.edges(replace(scene, elements=(element,)))[1:-1]
    before, behind = (height(element, r + s * 1e-6 * R, torch.zeros_like(r)) for s in (-1, 1))
    return (squares(behind - before) * r).sum(-1) * 2 / R**2


@dataclass(frozen=True)
class Setting:
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
    width: float  # radius of an even disc as wide as the light
    core: float  # of one as large in area, beyond a core in focus
    sharpest: float  # the least of it over kernels
    scatter: float  # √(2 A S/12)/(λz), mm^-1.5: light scattered by steps S/mm
    features: tuple[float, ...]  # pitches of rings and pixels, mm
    speckle: bool  # whether there are features that no period wraps
    lattice: bool  # cells can share the edges of all steps: those of one map of pixels
    edge: float  # √(2 A λz (1 + S R/2)/(2π³ R)), mm^1.5: light sent far away by edges and steps

    @property
    def airy(self) -> float:
        """λz/D, mm."""
        return self.period(1)

    def period(self, samples: float) -> float:
        """Distance mm of the copies of the image that so many cells across the aperture make."""
        return self.shortest * self.distance * samples / self.diameter


def setting_of(scene: WaveScene) -> Setting:
    centre = [abs(float(c)) for c in scene.grid.centre.detach()]
    pitch = float(scene.grid.pitch.detach())
    sides = (0.5 * pitch * n for n in scene.grid.shape[::-1])
    stepped = [element for element in scene.elements if not is_smooth(element)]
    R, z = (float(number.detach()) for number in (aperture(scene), scene.sensor_distance))
    pixels, light, focal = only_pixels(scene), spread(scene), z * millimetres(scene).detach().double()
    core = (light.area / math.pi - (2.4 * focal / (2 * R)) ** 2 / math.pi).clamp(min=0.0).sqrt()
    far = 2 * light.area * focal * (1 + 0.5 * R * light.steps) / (2 * math.pi**3 * R)
    return Setting(
        diameter=2 * R,
        distance=z,
        shortest=float(millimetres(scene).detach().min()),
        blur=float((blur(scene) if pixels is None else blur_of_pixels(scene, pixels)).max()),
        reach=max(c + side for c, side in zip(centre, sides, strict=True)),
        kernels=(len(scene.depths), len(scene.wavelengths)),
        size=max(scene.grid.shape),
        pixels=scene.grid.rows * scene.grid.columns,
        bytes=scene.sensor_distance.element_size(),
        band=math.pi * propagation.cutoff(scene) * pitch,
        width=float(light.width.max()),
        core=float(core.max()),
        sharpest=float(core.min()),
        scatter=float((torch.sqrt(light.area * light.steps / 6) / focal).max()),
        features=tuple(float(e.profile.pitch.detach()) for e in stepped if has_features(e.profile)),
        speckle=any(is_free(element) for element in stepped),
        lattice=not scene.exact and len(stepped) == 1 and isinstance(stepped[0].profile, Pixels),
        edge=float(far.sqrt().max()),
    )


def _tail(s: Setting, samples: float) -> float:
    """Of the light diffracted at the edge of the copies next to the window, which falls as the square of the gap."""
    gap = s.period(samples) - s.blur - s.reach
    return 0.3 * (s.airy / gap) ** 2 if gap > s.airy else 1.0


def edge_error(s: Setting, samples: float, width: float | None = None) -> float:
    """Of N cells with weights of sixth order at the rim: fitted over blurs and windows.

    width: radius mm of the light; by default that of its farthest rays, which is enough for any shape.
    """
    period, width = s.period(samples), s.blur if width is None else width
    # The edge counts for more where the blur is few waves of defocus, or much wider than the window.
    waves = max(0.5, 0.25 * width / s.airy)
    share = 0.016 * (1 + 4 / waves) * max(1.0, width / s.reach) ** 0.6
    return min(1.0, share * (2 * width / period) ** 3.7 + 2e-4 * (s.reach / period) ** 2 + _tail(s, samples))


def _area_error(s: Setting, samples: float) -> float:
    """Of N cells that count at the rim by their area inside, fitted likewise."""
    period = s.period(samples)
    return min(1.0, 0.2 * (2 * s.core / period) ** 2 + 5e-4 * (s.reach / period) ** 2 + _tail(s, samples))


def cut_error(s: Setting, samples: int, bare: float) -> float:
    """Of cells of flat pixels cut by the rim, across which the phase of the bare sphere varies; bare: its blur, mm."""
    return min(1.0, 0.8 * (s.core + 0.1 * s.airy) * bare / s.period(samples) ** 2 + _tail(s, samples))


def _scattered(s: Setting, samples: float) -> float:
    """Of light scattered evenly over a period: a cell cut by an edge into f and 1 - f holds the field of one side."""
    shares = [pitch * samples / s.diameter for pitch in s.features]
    whole = [min(abs(n - round(n)) / n for n in (share, 1 / share) if n > 0.5) < 0.01 for share in shares]
    if s.lattice and all(whole) and min(shares) > 0.5:
        return 0.0
    # |jump|²/12 in the mean over a cell; steps that repeat with the cells add up: up to four times as much.
    return (2.0 if any(whole) else 1.1) * s.scatter * (s.diameter / samples) ** 1.5


def step_error(s: Setting, samples: float) -> float:
    """Of N cells over a profile with steps; where cells lie in flat pixels, the smooth rest varies across them."""
    curved = 0.25 * ((s.blur + 0.5 * s.reach) / s.period(samples)) ** 2
    return min(1.0, _area_error(s, samples) + (curved if s.lattice else _scattered(s, samples)))


def transfer_error(s: Setting, samples: int, pad: float, band_limit: bool) -> float:
    """Of the sampled field, its interpolation beyond 3/4 of the band, and the light that wraps round or is cut off."""
    # Edges and steps send light to a distance ρ with a density ∝ 1/ρ³: without a limit six copies bring it back, with
    # one its sharp end rings, by the gap to the window.
    width, aside = pad * s.diameter, 0.5 * s.diameter + s.reach
    error = _area_error(s, samples) + _scattered(s, samples)
    error += 0.0025 * max(0.0, (s.diameter / (s.airy * samples) - 0.7) / 0.2) ** 5
    if band_limit:
        return error + 2.6 * s.edge * (0.5 * width) ** -1.5 * s.airy / max(s.airy, 0.5 * width - aside)
    wraps = aside + 0.5 * s.period(samples) > width
    return error + (1.3 * math.sqrt(6) * s.edge * width**-1.5 if wraps else 0.0)


def node_error(s: Setting, nodes: int) -> float:
    """Of n Gauss nodes a pixel. Free features make speckle, as fine as the cutoff; blur leaves less light there."""
    share = 1.0 if s.speckle else (2 / nodes) ** 1.4 / (1 + s.sharpest / (40 * s.airy))
    return 0.2 * share * bessel(s.band, nodes)


def radius_error(half: float, samples: int) -> float:
    """Of n Gauss radii between steps with a phase of 2·half."""
    if half < 20:
        return min(1.0, bessel(half, samples))
    enough = rings_and_arms(2 * half, 0)[0]
    return 1e-7 if samples >= enough else 0.3 * min(1.0, 10 ** (7 - 10 * samples / enough))


def bessel(a: float, nodes: int) -> float:
    """Error of n Gauss nodes for exp(iat) over [-1, 1], about J_2n(a) <= (a/2)^2n/(2n)!."""
    return min(1.0, math.exp(2 * nodes * math.log(max(a, 1e-9) / 2) - math.lgamma(2 * nodes + 1)))


def gauss_count(a: float, tol: float) -> int:
    """Gauss nodes for that error to be at most tol."""
    return next(n for n in range(max(1, math.ceil(a / 2)), 10_000) if bessel(a, n) <= tol)


def half_phases(scene: WaveScene, s: Setting) -> tuple[float, float]:
    """Two estimates of the largest half of the phase, radians, of the integrand of the radial engine between two steps:
    a bound, the slope at the farther one times their distance, and the accumulated phase."""
    edges = propagation.edges(scene).detach()
    r = torch.linspace(0, 1, 513, dtype=edges.dtype, device=edges.device) * edges[-1]
    angle = slopes(scene, r, torch.zeros_like(r))[0].abs().amax((0, 1)) + math.sqrt(2) * s.reach / s.distance
    phase = torch.cumsum(angle, 0) * (edges[-1] / 512)
    place = edges / edges[-1] * 512
    low = place.long().clamp(max=511)
    across = torch.lerp(phase[low], phase[low + 1], place - low).diff()
    bound = across if len(edges) == 2 else edges.diff() * angle[place[1:].long()]
    largest, accumulated = (float(math.pi / s.shortest * half.max()) for half in (bound, across))
    return largest, accumulated


def only_pixels(scene: WaveScene) -> Pixels | None:
    """The pixels of a paraxial scene without other elements; None of another scene."""
    profile = scene.elements[0].profile
    return profile if isinstance(profile, Pixels) and not scene.exact and len(scene.elements) == 1 else None


_FINEST = 4096  # cells across the aperture


class AliasedSampling(RaytraceError, ValueError):
    """Copies of the image lie inside the window at this sampling: the result would be wrong altogether."""


@dataclass(frozen=True)
class Plan:
    """How to compute the PSFs of a scene.

    engine: a name of ENGINES; samples: cells or samples across the aperture (`radial`: Gauss radii between steps);
    nodes: per pixel and axis (`radial`: of its rule); cells: of the pupil, "smooth", "sampled", "flat" or "mixed"
    (`wave_optics.mixed`); extent: of the cells over the diameter; inner: Gauss nodes in a flat cell, or radii between
    steps; parts: cells along a flat pixel; pad, band_limit: of the transfer functions; band: mm on the sensor over
    which the round part fades out (mixed). error: predicted, relative L2 of the worst kernel; flops, memory (bytes):
    predicted.
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
    band: tuple[float, float] = (0.0, 0.0)


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
    """The cheapest sampling whose predicted error is at most tol (relative L2), or the error of a given sampling.

    engine: a name of ENGINES, or "auto": `radial` for round elements and a window on the axis, else `pupil`. samples,
    nodes: to be used as they are (`Plan`). pad, band_limit: of the transfer functions; pad 1.5 without a band limit is
    that of Sitzmann et al. (2018). Raises AliasedSampling where copies of the image would lie in the window, ValueError
    where an engine cannot hold the scene; warns `psf_models.dft.Aliased` where the converging field is undersampled,
    and `NotConverged` where the finest sampling does not meet tol.
    """
    check(scene)
    round_scene = is_round(scene) and is_centred(scene.grid)
    if engine == "auto":
        engine = "radial" if round_scene else "pupil"
    if engine not in ENGINES:
        raise ValueError(f"no engine {engine!r}; choose among auto, {', '.join(ENGINES)}")
    if engine == "radial" and not round_scene:
        raise ValueError("the radial engine needs round elements and a grid centred on the axis; use engine='pupil'")
    row, setting = ENGINES[engine], setting_of(scene)
    sampling = row.plan(
        scene, setting, engine=engine, samples=samples, nodes=nodes, tol=tol, pad=pad, band_limit=band_limit
    )
    # An engine that samples the converging field itself is a reference: not held to a tolerance.
    if row.prepare is not None and samples is None and nodes is None and sampling.error > tol:
        message = (
            f"predicted error {sampling.error:.2g} above the tolerance {tol:.2g} with {sampling.samples} samples; "
            f"the worst light lies within ±{setting.width:.3g} mm"
        )
        warnings.warn(message, NotConverged, stacklevel=calling_level())
    return sampling


def _least(error: Callable[[int], float], tol: float) -> int:
    return next((n for n in range(16, _FINEST, 4) if error(n) <= tol), _FINEST)


def _even(number: float) -> int:
    return max(16, 2 * math.ceil(0.5 * number))


def _pupil(scene: WaveScene, s: Setting, *, samples: int | None, nodes: int | None, tol: float, **_: Any) -> Plan:
    nodes = nodes or gauss_count(s.band, 0.4 * tol / 0.15)
    if samples is None and is_mixed(scene):
        return _mixed(scene, s, nodes, tol)
    least = s.diameter * (s.reach + s.blur) / (s.shortest * s.distance)
    pixels = only_pixels(scene)
    if samples is not None and samples < least and pixels is None:
        raise AliasedSampling(
            f"{samples} cells across the aperture repeat the image every {1e3 * s.period(samples):.0f} µm, inside the "
            f"window of ±{1e3 * s.reach:.0f} µm with a blur of ±{1e3 * s.blur:.0f} µm: take at least "
            f"{math.ceil(least)} samples, or a smaller window"
        )
    kind, extent, inner, parts = "smooth", 1.0, 1, 1
    if pixels is not None:
        kind = "flat"
        across = max(cells_across(pixels.pitch, n, aperture(scene)) for n in pixels.heights.shape)
        bare = float(blur(scene).max())
        wanted = samples or _least(lambda n: cut_error(s, n, bare), 0.5 * tol)
        parts = max(1, math.ceil(wanted / across))
        samples, pitch = parts * across, float(pixels.pitch.detach()) / parts
        near = 1 / float(scene.depths.detach().min()) + 1 / s.distance
        half_phase = math.pi / s.shortest * pitch * (0.5 * s.diameter * near + s.reach / s.distance)
        inner = gauss_count(half_phase, 0.1 * tol)
        error = bessel(half_phase, inner) + cut_error(s, samples, bare)
    elif all(is_smooth(element) for element in scene.elements):
        samples = samples or _even(max(1.05 * least, _least(lambda n: edge_error(s, n), 0.5 * tol)))
        error = min(1.0, 1.4 * edge_error(s, samples, s.width**0.75 * s.core**0.25))
    else:
        kind = "sampled"
        samples = samples or _even(max(1.05 * least, _least(lambda n: step_error(s, n), 0.5 * tol)))
        samples, extent = _aligned(scene, s, samples)
        error = step_error(s, samples / extent)
    error += node_error(s, nodes)
    D, W = s.kernels
    K = s.size * nodes
    cells = samples + 6 if kind == "smooth" else samples
    if kind == "flat":  # whole pixels, and parts × parts cells of about 4 n pixels that the edge cuts
        n = samples // parts
        sums = K * n**2 + 4 * n * parts**2 * K + K**2 * (cells + n)
        flops = 8 * D * W * (sums + 8 * K * inner * cells) + 60 * W * n * (n + 4 * parts**2)
        memory = s.bytes * (2 * D * W * K * (8 * n * parts + 6 * cells + 4 * K) + W * n * (20 * n + 40 * parts**2))
    else:
        flops = 2 * D * W * (K * cells**2 + K**2 * cells + 30 * cells**2)
        memory = s.bytes * (D * W * (6 * cells**2 + 4 * K * cells + 8 * K**2) + 4 * W * K * cells)
    return Plan("pupil", samples, nodes, error, flops, memory, cells=kind, extent=extent, inner=inner, parts=parts)


def _mixed(scene: WaveScene, s: Setting, nodes: int, tol: float) -> Plan:
    """Smooth cells behind a round part that is known within a band."""
    longest = float(millimetres(scene).detach().max())
    # The reach of the free part into the window's corner, and 25 Airy radii beyond: light diffracted at the rim fades.
    aside, beyond = deflection(scene, 1.0), 25 * longest * s.distance / s.diameter
    near = math.sqrt(2) * s.reach + aside + beyond
    band = near, 1.4 * near
    extent = extent_of(scene, band)
    period = band[1] + deflection(scene, extent) + beyond + s.reach
    samples = _even(extent * s.diameter * period / (s.shortest * s.distance))
    half, phase = half_phases(round_part(scene), replace(s, reach=band[1] / math.sqrt(2)))
    inner = gauss_count(half, 0.1 * tol)
    error = node_error(s, nodes) + radius_error(phase, inner) + 3e-4
    D, W = s.kernels
    K, J, n = s.size * nodes, inner * (len(propagation.edges(round_part(scene))) - 1), radii_of_band(scene, band)
    T = 20 * n
    flops = W * n * (J + T) * (60 + 4 * D) + D * W * (K * samples**2 + K**2 * samples + 150 * samples**2)
    memory = s.bytes * (W * n * (J + T) + (2 * W + 8) * samples**2 * 4 + D * W * 8 * K**2)
    return Plan("pupil", samples, nodes, error, flops, memory, cells="mixed", extent=extent, inner=inner, band=band)


def _radial(scene: WaveScene, s: Setting, *, samples: int | None, nodes: int | None, tol: float, **_: Any) -> Plan:
    half, phase = half_phases(scene, s)
    if samples is None:
        samples = gauss_count(half, 0.1 * tol) if half < 20 else rings_and_arms(2 * half, 0 if tol > 1e-6 else 1)[0]
    # Nodes of the rule of pixels from order -2 on (`radii_of_waves`).
    base = math.ceil(0.5 * s.band) + 4
    nodes = max(base - 2, gauss_count(s.band, 0.5 * tol / 0.15)) if nodes is None else max(nodes, base - 2)
    error = node_error(s, nodes) + radius_error(phase, samples)
    D, W = s.kernels
    J = samples * (len(propagation.edges(scene)) - 1)
    K = math.ceil(s.band * reach(scene.grid) + 1.5 * (4 + (2 * s.band * reach(scene.grid)) ** (1 / 3)))
    flops = W * K * J * 4 * D + D * W * (K * s.pixels / 4 + 40 * J)
    return Plan("radial", samples, nodes, error + 1e-7, flops, s.bytes * (3 * W * K * J + K * s.pixels / 8))


def _transfer(
    scene: WaveScene,
    s: Setting,
    *,
    engine: str,
    samples: int | None,
    nodes: int | None,
    tol: float,
    pad: float,
    band_limit: bool,
) -> Plan:
    nodes = nodes or gauss_count(s.band, 0.4 * tol / 0.15)
    least, slope = s.diameter * (s.diameter + 2 * s.blur) / (s.shortest * s.distance), 0.5 * s.diameter / s.distance
    if samples is None:
        samples = _even(1.3 * least)
    if samples < least:
        warnings.warn(
            f"the converging field is undersampled: {1e3 * s.diameter / samples:.3g} µm a sample, where λz/(D + blur) "
            f"is {1e3 * s.diameter / least:.3g} µm at {1e3 * s.shortest:.3g} µm; light of the rim is lost or "
            f"misplaced. Take at least {math.ceil(least)} samples or the pupil engine",
            Aliased,
            stacklevel=calling_level(),
        )
    size = propagation.padded(samples, pad)
    error = node_error(s, nodes) + min(1.0, transfer_error(s, samples, pad, band_limit))
    seen = s.diameter * (s.diameter + 2 * s.core) / (s.shortest * s.distance)
    error += max(0.0, 1 - (samples / seen) ** 2) + (0.08 * slope**2 if engine == "angular_spectrum" else 0.0)
    D, W = s.kernels
    transform = 5 * size**2 * math.log2(size**2)
    memory = s.bytes * 2 * (D * size**2 * 4 + 2 * size**2)
    return Plan(engine, samples, nodes, error, 2 * D * W * transform, memory, pad=pad, band_limit=band_limit)


def _aligned(scene: WaveScene, s: Setting, samples: int) -> tuple[int, float]:
    """At least so many cells, a whole number to each pixel of a map, and their extent over the diameter."""
    maps = [e.profile for e in scene.elements if isinstance(e.profile, Pixels)]
    if not maps or scene.exact:
        return samples, 1.0
    finest = min(maps, key=lambda m: float(m.pitch.detach()))
    across = max(cells_across(finest.pitch, n, aperture(scene)) for n in finest.heights.shape)
    extent = across * float(finest.pitch.detach()) / s.diameter
    return across * math.ceil(samples * extent / across), extent


def behind(scene: WaveScene, plan: Plan) -> Tensor | None:
    """The light behind the elements that all depths and windows of a scene share; None where the plan has none."""
    return pupil.behind_pixels(scene) if plan.engine == "pupil" and plan.cells == "flat" else None


#: Sums of the pupil engine: of cells, of flat pixels, and behind a round part.
_Sums: TypeAlias = pupil.PupilSums | pupil.PixelSums | mixed.MixedSums


def _pupil_sums(scene: WaveScene, plan: Plan, behind: Tensor | None) -> _Sums:
    if plan.cells == "mixed":
        return mixed.prepare(scene, plan.samples, plan.nodes, extent=plan.extent, radii=plan.inner, band=plan.band)
    if plan.cells == "flat":
        return pupil.prepare_pixels(scene, plan.nodes, plan.inner, parts=plan.parts, behind=behind)
    return pupil.prepare(scene, plan.samples, plan.nodes, extent=plan.extent)


def _pupil_kernels(scene: WaveScene, sums: _Sums, plan: Plan) -> Tensor:
    light = mixed.intensity(scene, sums) if isinstance(sums, mixed.MixedSums) else pupil.intensity(scene, sums)
    return integrate(light, sums.to_pixels.pixel, scene.grid.pitch)


def _transfer_kernels(scene: WaveScene, sums: None, plan: Plan) -> Tensor:
    (u, v, weight), pitch, fields = sub_pixels(scene.grid, plan.nodes), 2 * aperture(scene) / plan.samples, []
    carried = partial(
        propagation.propagate,
        size=propagation.padded(plan.samples, plan.pad),
        band_limit=plan.band_limit,
        spectrum=plan.engine == "angular_spectrum",
    )
    for k, wavelength in enumerate(millimetres(scene)):
        field = propagation.behind(scene, k, plan.samples)
        field = carried(field, pitch, scene.sensor_distance, wavelength)
        fields.append(propagation.at_nodes(field, pitch, u, v))
    U = torch.stack(fields, 1)
    return integrate(U.real**2 + U.imag**2, weight, scene.grid.pitch)


class Engine(NamedTuple):
    """A way from the elements to the pixels.

    plan: (scene, its numbers, the request) -> Plan, with cost and error; kernels: (scene, sums, plan) -> light in the
    pixels (D, W, rows, columns); prepare: (scene, plan, light of `behind` or None) -> sums that the heights do not
    change, if any.
    """

    plan: Callable[..., Plan]
    kernels: Callable[[WaveScene, Any, Plan], Tensor]
    prepare: Callable[[WaveScene, Plan, Tensor | None], Any] | None = None


ENGINES = {
    # Any scene; copies of the image, cells at rim and steps.
    "pupil": Engine(_pupil, _pupil_kernels, _pupil_sums),
    # Round elements, a window on the axis; phase between two radii.
    "radial": Engine(
        _radial,
        lambda scene, sums, plan: propagation.radial_kernels(scene, sums),
        lambda scene, plan, _: propagation.prepare_radial(scene, plan.samples, propagation.order_of(scene, plan.nodes)),
    ),
    # Paraboloids, true spheres; light that wraps round, or that the band limit cuts off.
    "fresnel": Engine(_transfer, _transfer_kernels),
    "angular_spectrum": Engine(_transfer, _transfer_kernels),
}
