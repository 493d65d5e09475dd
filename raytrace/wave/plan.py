"""Plan: which engine computes the PSFs of a scene, how finely, at what cost, and how wrong it will be.

    pupil      N cells across D repeat the image every P = λzN/D: P >= reach of the window + half the blur
    radial     Gauss radii between steps by the phase between them
    fresnel    dx <= λz/(D + blur) samples the converging field; |f| < L/(2λz) keeps light from wrapping round
    pixels     Gauss nodes by the cutoff D/(λz) of the intensity

Errors are relative L2 norms (`sampling`). A PSF wider than its window leaves light out, which is no error here.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from torch import Tensor

from raytrace.kernels.dft import Aliased, integrate, rings_and_arms
from raytrace.kernels.ladder import NotConverged
from raytrace.kernels.radial import is_centred, reach
from raytrace.wave import mixed, propagate, pupil, radial
from raytrace.wave.element import Pixels, is_smooth
from raytrace.wave.mixed import deflection, extent_of, is_mixed, radii_of_band, round_part
from raytrace.wave.pupil import cells_across
from raytrace.wave.sampling import (
    Setting,
    bessel,
    cut_error,
    edge_error,
    gauss_count,
    half_phases,
    node_error,
    only_pixels,
    radius_error,
    setting_of,
    step_error,
    transfer_error,
)
from raytrace.wave.scene import WaveScene, aperture, check, is_round, millimetres
from raytrace.wave.spread import blur
from raytrace.words import calling_level

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
    the scene; warns `kernels.dft.Aliased` where the converging field is undersampled, and `NotConverged` where the
    finest sampling there is does not meet tol.
    """
    check(scene)
    round_scene = is_round(scene) and is_centred(scene.grid)
    if engine == "auto":
        engine = "radial" if round_scene else "pupil"
    if engine not in ENGINES:
        raise ValueError(f"no engine {engine!r}; choose among auto, {', '.join(ENGINES)}")
    if engine == "radial" and not round_scene:
        raise ValueError("the radial engine needs round elements and a grid centred on the axis; use engine='pupil'")
    setting = setting_of(scene)
    found = ENGINES[engine].plan(
        scene, setting, engine=engine, samples=samples, nodes=nodes, tol=tol, pad=pad, band_limit=band_limit
    )
    if not ENGINES[engine].is_reference and samples is None and nodes is None and found.error > tol:
        message = f"predicted error {found.error:.2g} above the tolerance {tol:.2g} with {found.samples} samples"
        message += f"; the worst light lies within ±{setting.width:.3g} mm"
        warnings.warn(message, NotConverged, stacklevel=calling_level())
    return found


# -- the engines -------------------------------------------------------------------------------------------------------


def _pupil(scene: WaveScene, s: Setting, *, samples: int | None, nodes: int | None, tol: float, **_) -> Plan:
    nodes = nodes or _nodes(s, tol)
    if samples is None and is_mixed(scene):
        return _mixed(scene, s, nodes, tol)
    least = s.diameter * (s.reach + s.blur) / (s.shortest * s.distance)
    if samples is not None and samples < least and not only_pixels(scene):
        raise AliasedSampling(
            f"{samples} cells across the aperture repeat the image every {1e3 * s.period(samples):.0f} µm, inside the "
            f"window of ±{1e3 * s.reach:.0f} µm with a blur of ±{1e3 * s.blur:.0f} µm: take at least "
            f"{math.ceil(least)} samples, or a smaller window"
        )
    kind, extent, inner, parts = "smooth", 1.0, 1, 1
    if only_pixels(scene):
        profile, kind = scene.elements[0].profile, "flat"
        across = max(cells_across(profile.pitch, n, aperture(scene)) for n in profile.heights.shape)
        bare = float(blur(scene).max())
        wanted = samples or _least(lambda n: cut_error(s, n, bare), 0.5 * tol)
        parts = max(1, math.ceil(wanted / across))
        samples, pitch = parts * across, float(profile.pitch.detach()) / parts
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
    flops = 2 * D * W * (K * cells**2 + K**2 * cells + 30 * cells**2) * (1 if kind != "flat" else 4)
    memory = s.bytes * (D * W * (6 * cells**2 + 4 * K * cells + 8 * K**2) + 4 * W * K * cells)
    return Plan("pupil", samples, nodes, error, flops, memory, cells=kind, extent=extent, inner=inner, parts=parts)


def _mixed(scene: WaveScene, s: Setting, nodes: int, tol: float) -> Plan:
    """Smooth cells behind a round part that is known within a band: what the free part takes into the window's corner,
    and 25 Airy radii beyond, where light diffracted at the rim has faded."""
    longest = float(millimetres(scene).detach().max())
    aside, beyond = deflection(scene, 1.0), 25 * longest * s.distance / s.diameter
    near = math.sqrt(2) * s.reach + aside + beyond
    band = near, 1.4 * near
    extent = extent_of(scene, band)
    period = band[1] + deflection(scene, extent) + beyond + s.reach
    samples = _even(extent * s.diameter * period / (s.shortest * s.distance))
    half, turned = half_phases(round_part(scene), replace(s, reach=band[1] / math.sqrt(2)))
    inner = gauss_count(half, 0.1 * tol)
    error = node_error(s, nodes) + radius_error(turned, inner) + 3e-4
    D, W = s.kernels
    K, J, n = s.size * nodes, inner * (len(radial.edges(round_part(scene))) - 1), radii_of_band(scene, band)
    T = 20 * n
    flops = W * n * (J + T) * (60 + 4 * D) + D * W * (K * samples**2 + K**2 * samples + 150 * samples**2)
    memory = s.bytes * (W * n * (J + T) + (2 * W + 8) * samples**2 * 4 + D * W * 8 * K**2)
    return Plan("pupil", samples, nodes, error, flops, memory, cells="mixed", extent=extent, inner=inner, band=band)


def _radial(scene: WaveScene, s: Setting, *, samples: int | None, nodes: int | None, tol: float, **_) -> Plan:
    half, turned = half_phases(scene, s)
    if samples is None:
        samples = gauss_count(half, 0.1 * tol) if half < 20 else rings_and_arms(2 * half, 0 if tol > 1e-6 else 1)[0]
    # Nodes of the rule of pixels from order -2 on (`radii_of_waves`).
    base = math.ceil(0.5 * s.band) + 4
    nodes = max(base - 2, gauss_count(s.band, 0.5 * tol / 0.15)) if nodes is None else max(nodes, base - 2)
    error = node_error(s, nodes) + radius_error(turned, samples)
    D, W = s.kernels
    J = samples * (len(radial.edges(scene)) - 1)
    K = math.ceil(s.band * reach(scene.grid) + 1.5 * (4 + (2 * s.band * reach(scene.grid)) ** (1 / 3)))
    flops = W * K * J * 4 * D + D * W * (K * s.pixels / 4 + 40 * J)
    return Plan("radial", samples, nodes, error + 1e-7, flops, s.bytes * (3 * W * K * J + K * s.pixels / 8))


def _transfer(scene: WaveScene, s: Setting, *, engine, samples, nodes, tol, pad, band_limit) -> Plan:
    nodes = nodes or _nodes(s, tol)
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
    size = propagate.padded(samples, pad)
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


def _least(error, tol: float) -> int:
    return next((n for n in range(16, _FINEST, 4) if error(n) <= tol), _FINEST)


def _even(number: float) -> int:
    return max(16, 2 * math.ceil(0.5 * number))


def _nodes(s: Setting, tol: float) -> int:
    """Per pixel and axis."""
    return gauss_count(s.band, 0.4 * tol / 0.15)


# -- what carries them out ---------------------------------------------------------------------------------------------


def _pupil_sums(scene: WaveScene, plan: Plan) -> pupil.PupilSums | mixed.MixedSums:
    if plan.cells == "mixed":
        return mixed.prepare(scene, plan.samples, plan.nodes, extent=plan.extent, radii=plan.inner, band=plan.band)
    if plan.cells == "flat":
        return pupil.prepare_pixels(scene, plan.nodes, plan.inner, parts=plan.parts)
    return pupil.prepare(scene, plan.samples, plan.nodes, extent=plan.extent)


def _pupil_kernels(scene: WaveScene, sums, plan: Plan) -> Tensor:
    light = (mixed if plan.cells == "mixed" else pupil).intensity(scene, sums)
    return integrate(light, sums.pixel, scene.grid.pitch)


def _radial_sums(scene: WaveScene, plan: Plan) -> radial.RadialSums:
    return radial.prepare(scene, plan.samples, radial.order_of(scene, plan.nodes))


def _sent(scene: WaveScene, sums: None, plan: Plan) -> Tensor:
    how = {"pad": plan.pad, "band_limit": plan.band_limit, "spectrum": plan.engine == "angular_spectrum"}
    light, weight = propagate.intensity(scene, samples=plan.samples, nodes=plan.nodes, **how)
    return integrate(light, weight, scene.grid.pitch)


class Engine(NamedTuple):
    """A way from the elements to the pixels.

    assumes: of the scene; errs: by what; plan: (scene, its numbers, what is asked for) -> Plan, with cost and error;
    kernels: (scene, sums, plan) -> light in the pixels (D, W, rows, columns); prepare: (scene, plan) -> sums, what the
    heights do not change, if there is anything.
    """

    assumes: str
    errs: str
    plan: Callable[..., Plan]
    kernels: Callable[[WaveScene, Any, Plan], Tensor]
    prepare: Callable[[WaveScene, Plan], Any] | None = None

    @property
    def is_reference(self) -> bool:
        """Whether it samples the converging field itself: never chosen, and not held to a tolerance."""
        return self.prepare is None


ENGINES = {
    "pupil": Engine("nothing", "copies of the image; cells at rim and steps", _pupil, _pupil_kernels, _pupil_sums),
    "radial": Engine(
        "round elements, a window on the axis",
        "phase between two radii",
        _radial,
        lambda scene, sums, plan: radial.kernels(scene, sums),
        _radial_sums,
    ),
    "fresnel": Engine("paraboloids", "light that wraps round, or the band limit cuts off", _transfer, _sent),
    "angular_spectrum": Engine("true spheres", "the same, and paraboloids elsewhere", _transfer, _sent),
}
