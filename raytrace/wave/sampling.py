"""Sampling: the numbers of a wave scene that decide how finely it is to be sampled, and the error that each sampling
leaves.

Errors are relative L2 norms, fitted to converged references of two dozen scenes: half to five times what is measured
where that is above 1e-4. Stray light, spread evenly with a density ε per mm², errs by √(2 ε A), A the area of the light
(`spread`).
"""

import math
from dataclasses import dataclass

import torch

from raytrace.kernels.dft import rings_and_arms
from raytrace.wave import radial
from raytrace.wave.element import Pixels, is_flat, is_smooth
from raytrace.wave.scene import WaveScene, aperture, millimetres
from raytrace.wave.spread import blur, blur_of_pixels, is_free, slopes, spread


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


def setting_of(scene: WaveScene) -> Setting:
    centre = [abs(float(c)) for c in scene.grid.centre.detach()]
    pitch = float(scene.grid.pitch.detach())
    sides = (0.5 * pitch * n for n in scene.grid.shape[::-1])
    stepped = [element for element in scene.elements if not is_smooth(element)]
    R, z = (float(number.detach()) for number in (aperture(scene), scene.sensor_distance))
    light, focal = spread(scene), z * millimetres(scene).detach().double()
    core = (light.area / math.pi - (2.4 * focal / (2 * R)) ** 2 / math.pi).clamp(min=0.0).sqrt()
    far = 2 * light.area * focal * (1 + 0.5 * R * light.steps) / (2 * math.pi**3 * R)
    return Setting(
        diameter=2 * R,
        distance=z,
        shortest=float(millimetres(scene).detach().min()),
        blur=float((blur_of_pixels(scene) if only_pixels(scene) else blur(scene)).max()),
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


def edge_error(s: Setting, samples: int, width: float | None = None) -> float:
    """Of N cells with weights of sixth order at the rim: fitted over blurs and windows.

    The edge counts for more where the blur is few waves of defocus, or much wider than the window. width: radius mm of
    the light; by default that of its farthest rays, which is enough for any shape.
    """
    period, width = s.period(samples), s.blur if width is None else width
    waves = max(0.5, 0.25 * width / s.airy)
    share = 0.016 * (1 + 4 / waves) * max(1.0, width / s.reach) ** 0.6
    return min(1.0, share * (2 * width / period) ** 3.7 + 2e-4 * (s.reach / period) ** 2 + _tail(s, samples))


def step_error(s: Setting, samples: float) -> float:
    """Of N cells over a profile with steps; where cells lie in flat pixels, the smooth rest bends across them."""
    bent = 0.25 * ((s.blur + 0.5 * s.reach) / s.period(samples)) ** 2
    return min(1.0, _area_error(s, samples) + (bent if s.lattice else _scattered(s, samples)))


def _scattered(s: Setting, samples: float) -> float:
    """A cell cut by an edge into f and 1 - f holds the field of one side: in the mean over a cell |jump|²/12 of light,
    scattered evenly over a period. What repeats with the cells adds up: up to four times as much.
    """
    shares = [pitch * samples / s.diameter for pitch in s.features]
    whole = [min(abs(n - round(n)) / n for n in (share, 1 / share) if n > 0.5) < 0.01 for share in shares]
    if s.lattice and all(whole) and min(shares) > 0.5:
        return 0.0
    return (2.0 if any(whole) else 1.1) * s.scatter * (s.diameter / samples) ** 1.5


def transfer_error(s: Setting, samples: int, pad: float, band_limit: bool) -> float:
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


def node_error(s: Setting, nodes: int) -> float:
    """Of n Gauss nodes a pixel. Free features make speckle, as fine as the cutoff; blur leaves less light there."""
    share = 1.0 if s.speckle else (2 / nodes) ** 1.4 / (1 + s.sharpest / (40 * s.airy))
    return 0.2 * share * bessel(s.band, nodes)


def radius_error(half: float, samples: int) -> float:
    """Of n Gauss radii between steps that the phase turns by 2·half."""
    if half < 20:
        return min(1.0, bessel(half, samples))
    enough = rings_and_arms(2 * half, 0)[0]
    return 1e-7 if samples >= enough else 0.3 * min(1.0, 10 ** (7 - 10 * samples / enough))


def _tail(s: Setting, samples: int) -> float:
    """Of the light diffracted at the edge of the copies next to the window, which falls as the square of the gap."""
    gap = s.period(samples) - s.blur - s.reach
    return 0.3 * (s.airy / gap) ** 2 if gap > s.airy else 1.0


def _area_error(s: Setting, samples: float) -> float:
    """Of N cells that count at the rim by their area inside, fitted likewise."""
    period = s.period(samples)
    return min(1.0, 0.2 * (2 * s.core / period) ** 2 + 5e-4 * (s.reach / period) ** 2 + _tail(s, samples))


def cut_error(s: Setting, samples: int, bare: float) -> float:
    """Of cells of flat pixels cut by the rim: across them turns the bare sphere, with a blur of `bare` mm."""
    return min(1.0, 0.8 * (s.core + 0.1 * s.airy) * bare / s.period(samples) ** 2 + _tail(s, samples))


def bessel(a: float, nodes: int) -> float:
    """Error of n Gauss nodes for exp(iat) over [-1, 1], about J_2n(a) <= (a/2)^2n/(2n)!."""
    return min(1.0, math.exp(2 * nodes * math.log(max(a, 1e-9) / 2) - math.lgamma(2 * nodes + 1)))


def gauss_count(a: float, tol: float) -> int:
    """Gauss nodes for that error to be at most tol."""
    return next(n for n in range(max(1, math.ceil(a / 2)), 10_000) if bessel(a, n) <= tol)


def half_phases(scene: WaveScene, s: Setting) -> tuple[float, float]:
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


def only_pixels(scene: WaveScene) -> bool:
    return not scene.exact and len(scene.elements) == 1 and isinstance(scene.elements[0].profile, Pixels)
