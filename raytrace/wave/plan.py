"""Plan: which engine computes the PSFs of a scene, how finely, at what cost, and how wrong it will be.

    pupil      N cells across D repeat the image every P = λzN/D: P >= reach of the window + half the blur
    radial     Gauss radii between steps by the phase between them
    fresnel    dx <= λz/(D + blur) samples the converging field; |f| < L/(2λz) keeps light from wrapping round
    pixels     Gauss nodes by the cutoff D/(λz) of the intensity

Errors are relative L2 norms, fitted to converged references of two dozen scenes: half to five times what is measured
where that is above 1e-4. Stray light, spread evenly with a density ε per mm², errs by √(2 ε A), A the area of the light
(`spread`). A PSF wider than its window leaves light out, which is no error here.
"""

import math
import warnings
from dataclasses import dataclass, replace

import torch

from raytrace.kernels.dft import Aliased, rings_and_arms
from raytrace.kernels.ladder import NotConverged
from raytrace.kernels.radial import is_centred, reach
from raytrace.wave import propagate, radial
from raytrace.wave.element import Pixels, is_flat, is_smooth
from raytrace.wave.mixed import deflection, extent_of, is_mixed, radii_of_band, round_part
from raytrace.wave.pupil import cells_across
from raytrace.wave.scene import WaveScene, aperture, check, is_round, millimetres
from raytrace.wave.spread import blur, blur_of_pixels, is_free, slopes, spread

ENGINES = "pupil", "radial", "fresnel", "angular_spectrum"
_FINEST = 4096  # cells across the aperture


class AliasedSampling(ValueError):
    """Copies of the image lie inside the window at this sampling: the result would be wrong altogether."""


@dataclass(frozen=True)
class Plan:
    """How to compute the PSFs of a scene.

    engine: one of ENGINES; samples: cells or samples across the aperture (`radial`: Gauss radii between steps);
    nodes: per pixel and axis (`radial`: of its rule); cells: "smooth", "sampled", "flat" or "mixed" (`wave.mixed`):
    what stands in a cell of the pupil; extent: of the cells over the diameter; inner: Gauss nodes in a flat cell, or
    radii between steps; parts: cells along a flat pixel; pad, band_limit: of the transfer functions; band: mm on the
    sensor over which the round part fades out (mixed). error: predicted, relative L2 of the worst kernel; flops, memory
    (bytes): predicted.
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
    width: float  # radius of an even disc as wide as the light
    core: float  # of one as large in area, beyond a core in focus
    sharpest: float  # the least of it over kernels
    scatter: float  # √(2 A S/12)/(λz), mm^-1.5: what steps S/mm scatter
    features: tuple[float, ...]  # pitches of rings and pixels, mm
    speckle: bool  # whether there are features that no period wraps
    lattice: bool  # cells can share the edges of all steps: those of one map of pixels
    edge: float  # √(2 A λz (1 + S R/2)/(2π³ R)), mm^1.5: what edges and steps send far away

    @property
    def airy(self) -> float:
        """λz/D, mm."""
        return self.shortest * self.distance / self.diameter

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
    that of Sitzmann et al. (2018).
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
        warnings.warn(f"{message}; the worst light lies within ±{setting.width:.3g} mm", NotConverged, stacklevel=2)
    return found


def _setting(scene: WaveScene) -> _Setting:
    centre = [abs(float(c)) for c in scene.grid.centre.detach()]
    pitch = float(scene.grid.pitch.detach())
    sides = (0.5 * pitch * n for n in scene.grid.shape[::-1])
    stepped = [element for element in scene.elements if not is_smooth(element)]
    R, z = (float(number.detach()) for number in (aperture(scene), scene.sensor_distance))
    light, focal = spread(scene), z * millimetres(scene).detach().double()
    core = (light.area / math.pi - (2.4 * focal / (2 * R)) ** 2 / math.pi).clamp(min=0.0).sqrt()
    far = 2 * light.area * focal * (1 + 0.5 * R * light.steps) / (2 * math.pi**3 * R)
    return _Setting(
        diameter=2 * R,
        distance=z,
        shortest=float(millimetres(scene).detach().min()),
        blur=float((blur_of_pixels(scene) if _only_pixels(scene) else blur(scene)).max()),
        reach=max(c + side for c, side in zip(centre, sides, strict=True)),
        kernels=(len(scene.depths), len(scene.wavelengths)),
        size=max(scene.grid.shape),
        pixels=scene.grid.rows * scene.grid.columns,
        bytes=scene.sensor_distance.element_size(),
        band=math.pi * radial.cutoff(scene) * pitch,
        width=float(light.width.max()),
        core=float(core.max()),
        sharpest=float(core.min()),
        scatter=float((torch.sqrt(light.area * light.steps / 6) / focal).max()),
        features=tuple(float(e.profile.pitch.detach()) for e in stepped if is_flat(e)),
        speckle=any(is_free(element) for element in stepped),
        lattice=not scene.exact and len(stepped) == 1 and isinstance(stepped[0].profile, Pixels),
        edge=float(far.sqrt().max()),
    )


# -- the engines -------------------------------------------------------------------------------------------------------


def _pupil(scene: WaveScene, s: _Setting, samples: int | None, nodes: int, tol: float) -> Plan:
    if samples is None and is_mixed(scene):
        return _mixed(scene, s, nodes, tol)
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
        bare = float(blur(scene).max())
        wanted = samples or _least(lambda n: _cut_error(s, n, bare), 0.5 * tol)
        parts = max(1, math.ceil(wanted / across))
        samples, pitch = parts * across, float(profile.pitch.detach()) / parts
        near = 1 / float(scene.depths.detach().min()) + 1 / s.distance
        half_phase = math.pi / s.shortest * pitch * (0.5 * s.diameter * near + s.reach / s.distance)
        inner = _count(half_phase, 0.1 * tol)
        error = _bessel(half_phase, inner) + _cut_error(s, samples, bare)
    elif all(is_smooth(element) for element in scene.elements):
        samples = samples or _even(max(1.05 * least, _least(lambda n: _edge_error(s, n), 0.5 * tol)))
        error = min(1.0, 1.4 * _edge_error(s, samples, s.width**0.75 * s.core**0.25))
    else:
        kind = "sampled"
        samples = samples or _even(max(1.05 * least, _least(lambda n: _step_error(s, n), 0.5 * tol)))
        samples, extent = _aligned(scene, s, samples)
        error = _step_error(s, samples / extent)
    error += _node_error(s, nodes)
    D, W = s.kernels
    K = s.size * nodes
    cells = samples + 6 if kind == "smooth" else samples
    flops = 2 * D * W * (K * cells**2 + K**2 * cells + 30 * cells**2) * (1 if kind != "flat" else 4)
    memory = s.bytes * (D * W * (6 * cells**2 + 4 * K * cells + 8 * K**2) + 4 * W * K * cells)
    return Plan("pupil", samples, nodes, error, flops, memory, cells=kind, extent=extent, inner=inner, parts=parts)


def _mixed(scene: WaveScene, s: _Setting, nodes: int, tol: float) -> Plan:
    """Smooth cells behind a round part that is known within a band: what the free part takes into the window's corner,
    and 25 Airy radii beyond, where light diffracted at the rim has faded."""
    longest = float(millimetres(scene).detach().max())
    aside, beyond = deflection(scene, 1.0), 25 * longest * s.distance / s.diameter
    near = math.sqrt(2) * s.reach + aside + beyond
    band = near, 1.4 * near
    extent = extent_of(scene, band)
    period = band[1] + deflection(scene, extent) + beyond + s.reach
    samples = _even(extent * s.diameter * period / (s.shortest * s.distance))
    half, turned = _half_phases(round_part(scene), replace(s, reach=band[1] / math.sqrt(2)))
    inner = _count(half, 0.1 * tol)
    error = _node_error(s, nodes) + _radius_error(turned, inner) + 3e-4
    D, W = s.kernels
    K, J, n = s.size * nodes, inner * (len(radial.edges(round_part(scene))) - 1), radii_of_band(scene, band)
    T = 20 * n
    flops = W * n * (J + T) * (60 + 4 * D) + D * W * (K * samples**2 + K**2 * samples + 150 * samples**2)
    memory = s.bytes * (W * n * (J + T) + (2 * W + 8) * samples**2 * 4 + D * W * 8 * K**2)
    return Plan("pupil", samples, nodes, error, flops, memory, cells="mixed", extent=extent, inner=inner, band=band)


def _radial(scene: WaveScene, s: _Setting, samples: int | None, nodes: int | None, tol: float) -> Plan:
    half, turned = _half_phases(scene, s)
    if samples is None:
        samples = _count(half, 0.1 * tol) if half < 20 else rings_and_arms(2 * half, 0 if tol > 1e-6 else 1)[0]
    # Nodes of the rule of pixels from order -2 on (`radii_of_waves`).
    base = math.ceil(0.5 * s.band) + 4
    nodes = max(base - 2, _count(s.band, 0.5 * tol / 0.15)) if nodes is None else max(nodes, base - 2)
    error = _node_error(s, nodes) + _radius_error(turned, samples)
    D, W = s.kernels
    J = samples * (len(radial.edges(scene)) - 1)
    K = math.ceil(s.band * reach(scene.grid) + 1.5 * (4 + (2 * s.band * reach(scene.grid)) ** (1 / 3)))
    flops = W * K * J * 4 * D + D * W * (K * s.pixels / 4 + 40 * J)
    return Plan("radial", samples, nodes, error + 1e-7, flops, s.bytes * (3 * W * K * J + K * s.pixels / 8))


def _transfer(s: _Setting, engine: str, samples: int | None, nodes: int, pad: float, band_limit: bool) -> Plan:
    least, slope = s.diameter * (s.diameter + 2 * s.blur) / (s.shortest * s.distance), 0.5 * s.diameter / s.distance
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
    error = _node_error(s, nodes) + min(1.0, _transfer_error(s, samples, pad, band_limit))
    seen = s.diameter * (s.diameter + 2 * s.core) / (s.shortest * s.distance)
    error += max(0.0, 1 - (samples / seen) ** 2) + (0.08 * slope**2 if engine == "angular_spectrum" else 0.0)
    D, W = s.kernels
    transform = 5 * size**2 * math.log2(size**2)
    memory = s.bytes * 2 * (D * size**2 * 4 + 2 * size**2)
    return Plan(engine, samples, nodes, error, 2 * D * W * transform, memory, pad=pad, band_limit=band_limit)


# -- their errors ------------------------------------------------------------------------------------------------------


def _edge_error(s: _Setting, samples: int, width: float | None = None) -> float:
    """Of N cells with weights of sixth order at the rim: fitted over blurs and windows.

    The edge counts for more where the blur is few waves of defocus, or much wider than the window. width: radius mm of
    the light; by default that of its farthest rays, which is enough for any shape.
    """
    period, width = s.period(samples), s.blur if width is None else width
    waves = max(0.5, 0.25 * width / s.airy)
    share = 0.016 * (1 + 4 / waves) * max(1.0, width / s.reach) ** 0.6
    return min(1.0, share * (2 * width / period) ** 3.7 + 2e-4 * (s.reach / period) ** 2 + _tail(s, samples))


def _step_error(s: _Setting, samples: float) -> float:
    """Of N cells over a profile with steps; where cells lie in flat pixels, the smooth rest bends across them."""
    bent = 0.25 * ((s.blur + 0.5 * s.reach) / s.period(samples)) ** 2
    return min(1.0, _area_error(s, samples) + (bent if s.lattice else _scattered(s, samples)))


def _scattered(s: _Setting, samples: float) -> float:
    """A cell cut by an edge into f and 1 - f holds the field of one side: in the mean over a cell |jump|²/12 of light,
    scattered evenly over a period. What repeats with the cells adds up: up to four times as much.
    """
    shares = [pitch * samples / s.diameter for pitch in s.features]
    whole = [min(abs(n - round(n)) / n for n in (share, 1 / share) if n > 0.5) < 0.01 for share in shares]
    if s.lattice and all(whole) and min(shares) > 0.5:
        return 0.0
    return (2.0 if any(whole) else 1.1) * s.scatter * (s.diameter / samples) ** 1.5


def _transfer_error(s: _Setting, samples: int, pad: float, band_limit: bool) -> float:
    """Of the sampled field, its interpolation beyond 3/4 of the band, and the light that wraps round or is cut off.

    Edges and steps send light to a distance ρ with a density ∝ 1/ρ³: without a limit six neighbouring copies bring it
    back, with one its sharp end rings, by the gap that is left to the window.
    """
    width, aside = pad * s.diameter, 0.5 * s.diameter + s.reach
    error = _area_error(s, samples) + _scattered(s, samples)
    error += 0.0025 * max(0.0, (s.diameter / (s.airy * samples) - 0.7) / 0.2) ** 5
    if band_limit:
        return error + 2.6 * s.edge * (0.5 * width) ** -1.5 * s.airy / max(s.airy, 0.5 * width - aside)
    wraps = aside + 0.5 * s.period(samples) > width
    return error + (1.3 * math.sqrt(6) * s.edge * width**-1.5 if wraps else 0.0)


def _node_error(s: _Setting, nodes: int) -> float:
    """Of n Gauss nodes a pixel. Free features make speckle, as fine as the cutoff; blur leaves less light there."""
    share = 1.0 if s.speckle else (2 / nodes) ** 1.4 / (1 + s.sharpest / (40 * s.airy))
    return 0.2 * share * _bessel(s.band, nodes)


def _radius_error(half: float, samples: int) -> float:
    """Of n Gauss radii between steps that the phase turns by 2·half."""
    if half < 20:
        return min(1.0, _bessel(half, samples))
    enough = rings_and_arms(2 * half, 0)[0]
    return 1e-7 if samples >= enough else 0.3 * min(1.0, 10 ** (7 - 10 * samples / enough))


def _tail(s: _Setting, samples: int) -> float:
    """Of the light diffracted at the edge of the copies next to the window, which falls as the square of the gap."""
    gap = s.period(samples) - s.blur - s.reach
    return 0.3 * (s.airy / gap) ** 2 if gap > s.airy else 1.0


def _area_error(s: _Setting, samples: float) -> float:
    """Of N cells that count at the rim by their area inside, fitted likewise."""
    period = s.period(samples)
    return min(1.0, 0.2 * (2 * s.core / period) ** 2 + 5e-4 * (s.reach / period) ** 2 + _tail(s, samples))


def _cut_error(s: _Setting, samples: int, bare: float) -> float:
    """Of cells of flat pixels cut by the rim: across them turns the bare sphere, with a blur of `bare` mm."""
    return min(1.0, 0.8 * (s.core + 0.1 * s.airy) * bare / s.period(samples) ** 2 + _tail(s, samples))


def _bessel(a: float, nodes: int) -> float:
    """Error of n Gauss nodes for exp(iat) over [-1, 1], about J_2n(a) <= (a/2)^2n/(2n)!."""
    return min(1.0, math.exp(2 * nodes * math.log(max(a, 1e-9) / 2) - math.lgamma(2 * nodes + 1)))


def _count(a: float, tol: float) -> int:
    """Gauss nodes for that error to be at most tol."""
    return next(n for n in range(max(1, math.ceil(a / 2)), 10_000) if _bessel(a, n) <= tol)


def _half_phases(scene: WaveScene, s: _Setting) -> tuple[float, float]:
    """Largest half of the phase, radians, that the integrand of the radial engine turns between two steps: a bound,
    the slope at the farther one times their distance, and what it turns."""
    edges = radial.edges(scene).detach()
    r = torch.linspace(0, 1, 513, dtype=edges.dtype, device=edges.device) * edges[-1]
    bent = slopes(scene, r, torch.zeros_like(r))[0].abs().amax((0, 1)) + math.sqrt(2) * s.reach / s.distance
    turned = torch.cumsum(bent, 0) * (edges[-1] / 512)
    place = edges / edges[-1] * 512
    low = place.long().clamp(max=511)
    across = torch.lerp(turned[low], turned[low + 1], place - low).diff()
    bound = across if len(edges) == 2 else edges.diff() * bent[place[1:].long()]
    return tuple(float(math.pi / s.shortest * half.max()) for half in (bound, across))


def _only_pixels(scene: WaveScene) -> bool:
    return not scene.exact and len(scene.elements) == 1 and isinstance(scene.elements[0].profile, Pixels)


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
