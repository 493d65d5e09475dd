"""Spread: where the light of a scene goes by rays: how wide it lands, how it gathers, and how much steps scatter.

A plan needs to know before anything is computed how much light lies where copies of the image, edges and steps would
put it. Rays are bent by the local slope of the residual path, W(x + s) - W(x) over s, modulo a wave: over flat features
s is their pitch, so that a staircase bends as the slope it follows.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths.pupil import gauss_rings
from raytrace.maths.value import to, value
from raytrace.wave import radial
from raytrace.wave.element import (
    Element,
    Pixels,
    Rings,
    designed_height,
    excess_index,
    fabricated_height,
    height,
    is_flat,
    slopes_of,
)
from raytrace.wave.scene import WaveScene, aperture, millimetres, residual, spheres

_RAYS = 4096
_AIRY = 2.4  # λz/D: √(1/∫I²) of a kernel in focus, behind pixels as large as its core


@value
class Spread:
    """Of every kernel: width (D, W) mm, √2 times the RMS distance from the axis, the radius of an even disc; area
    (D, W) mm², ∫I/∫I² inside the window; and of every wavelength: steps (W,) 1/mm, Σ |jump of the field|² · length of
    the edge, over the area of the aperture.
    """

    width: Tensor
    area: Tensor
    steps: Tensor


@torch.no_grad()
def spread(scene: WaveScene) -> Spread:
    """The spread of a scene, by 4096 rays a kernel.

    Free features keep the share |⟨exp(iφ)⟩|² of the light where it would go without them, and scatter the rest; wrapped
    heights bend as their first order.
    """
    scene = to(scene, dtype=torch.float64)
    free = [e for e in scene.elements if is_free(e)]
    kept = _coherent(scene, free)[None]
    width = squares = light = kept.new_zeros(len(scene.depths), len(scene.wavelengths))
    parts = [(kept, [e for e in scene.elements if not is_free(e)]), (1 - kept, scene.elements)]
    for share, elements in parts if free else parts[1:]:
        x, y = _landings(scene, elements)
        inside, gathered = _gathered(scene, x, y)
        width = width + share * 2 * (x * x + y * y).mean(-1)
        light, squares = light + share * inside, squares + share**2 * gathered
    # Where no two rays meet the light is thin: an even disc.
    area = torch.where(squares > 0, light / squares.clamp(min=1e-300), math.pi * width)
    return Spread(torch.sqrt(width), area, _steps(scene))


def is_free(element: Element) -> bool:
    """Whether heights are those of features, not wrapped: whatever they are."""
    return is_flat(element) and element.period is None


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
        if is_flat(element):
            continue
        power = excess_index(element, scene.wavelengths.detach(), x)
        if diffracted and element.period is not None:
            power = wavelength / element.period.detach()
        total = total + power[:, None] * slopes_of(element, x, y)[:, None, None]
    return total


def blur_of_pixels(scene: WaveScene) -> Tensor:
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


def _coherent(scene: WaveScene, elements: Sequence[Element]) -> Tensor:
    """|⟨exp(iφ)⟩|² (W,) of elements over the aperture; 0 of none."""
    waves = _waves(scene, elements, *_points(aperture(scene)))
    phase = 2 * math.pi * waves
    return torch.cos(phase).mean(-1) ** 2 + torch.sin(phase).mean(-1) ** 2 if len(elements) else waves[:, 0]


def _waves(scene: WaveScene, elements: Sequence[Element], x: Tensor, y: Tensor) -> Tensor:
    """Path (W, P) in waves of elements; a wrapped height counts whole, in periods: the first order."""
    total = x.new_zeros(len(scene.wavelengths), len(x))
    for element in elements:
        h = designed_height(element, x, y)
        excess = excess_index(element, scene.wavelengths, x) / millimetres(scene)
        scale = excess if element.period is None else (1 / element.period).expand_as(excess)
        total = total + scale[:, None] * h
    return total


def _points(radius: Tensor) -> tuple[Tensor, Tensor]:
    """x, y (M,) mm all over a disc, drawn: of points in any order pairs would come closer, or less close, than rays."""
    draw = torch.Generator().manual_seed(0)
    place, turn = torch.rand(2, _RAYS, generator=draw, dtype=torch.float64).to(radius)
    r, angle = radius * torch.sqrt(place), 2 * math.pi * turn
    return r * torch.cos(angle), r * torch.sin(angle)


def _landings(scene: WaveScene, elements: Sequence[Element]) -> tuple[Tensor, Tensor]:
    """x, y (D, W, M) mm on the sensor of rays through some of the elements.

    Steps of rings are crossed along the radius, where one pitch holds one of them.
    """
    R, wavelength = aperture(scene), millimetres(scene)[:, None]
    x, y = _points(R)
    features = [e.profile.pitch for e in elements if is_flat(e)]
    step = min(features) if features else wavelength.min() * scene.sensor_distance / (8 * R)
    along = torch.ones_like(x), torch.zeros_like(x)
    if any(isinstance(e.profile, Rings) for e in elements):
        along = tuple(p / torch.hypot(x, y) for p in (x, y))

    def waves(share: float, a: Tensor, b: Tensor) -> Tensor:
        u, v = x + share * step * a, y + share * step * b
        return spheres(scene, u * u + v * v)[:, None] / wavelength + _waves(scene, elements, u, v)

    def bent(a: Tensor, b: Tensor) -> Tensor:
        apart = waves(0.5, a, b) - waves(-0.5, a, b)
        return (apart - apart.round()) * wavelength * scene.sensor_distance / step

    (a, b), (c, d) = along, (-along[1], along[0])
    u, v = bent(a, b), bent(c, d)
    return u * a + v * c, u * b + v * d


def _gathered(scene: WaveScene, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Light in the window and ∫I² over it in 1/mm², (D, W), by rays (D, W, M) counted in square bins.

    A pair of rays in a bin counts 1/bin²: fewer rays than bins are no bias. Bins are as wide as a core, or a pixel.
    """
    window, finest = scene.grid, _AIRY * millimetres(scene) * scene.sensor_distance / (2 * aperture(scene))
    half = [0.5 * window.pitch * n for n in window.shape[::-1]]
    light, squares = x.new_zeros(x.shape[:-1]), x.new_zeros(x.shape[:-1])
    for w, bin in enumerate(torch.maximum(finest, window.pitch)):
        columns = 2 * torch.ceil(half[0] / bin) + 1
        for d in range(len(x)):
            u, v = (p[d, w] - c for p, c in zip((x, y), window.centre, strict=True))
            inside = (u.abs() <= half[0]) & (v.abs() <= half[1])
            places = torch.round(v[inside] / bin) * columns + torch.round(u[inside] / bin)
            counts = torch.unique(places, return_counts=True)[1].to(x)
            light[d, w] = counts.sum() / _RAYS
            squares[d, w] = (counts * (counts - 1)).sum() / (_RAYS * (_RAYS - 1) * bin**2)
    return light, squares


def _steps(scene: WaveScene) -> Tensor:
    """Σ |jump|² · length of all edges where heights jump, (W,) 1/mm, over the area of the aperture."""
    total = torch.zeros_like(scene.wavelengths)
    for element in scene.elements:
        waves = excess_index(element, scene.wavelengths, total) / millimetres(scene)
        total = total + _edges(element, scene, waves)
    return total


def _edges(element: Element, scene: WaveScene, waves: Tensor) -> Tensor:
    """The same of one element; waves: (W,) of path in 1 mm of height."""
    R, profile = aperture(scene), element.profile

    def squares(jumps: Tensor) -> Tensor:
        return 2 - 2 * torch.cos(2 * math.pi * waves.reshape(-1, *[1] * jumps.dim()) * jumps)

    if isinstance(profile, Pixels):
        heights = fabricated_height(profile.heights, element.period, element.levels)
        pairs = [heights.diff(dim=dim) for dim in (0, 1) if heights.shape[dim] > 1]
        return sum((squares(pair).mean((-2, -1)) / profile.pitch for pair in pairs), torch.zeros_like(waves))
    if isinstance(profile, Rings):
        heights = fabricated_height(profile.heights, element.period, element.levels)
        r = profile.pitch * torch.arange(1, len(heights), dtype=heights.dtype, device=heights.device)
        return (squares(heights.diff()) * r * (r < R)).sum(-1) * 2 / R**2
    if element.period is None:
        return torch.zeros_like(waves)
    alone = WaveScene((element,), *(getattr(scene, n) for n in ("sensor_distance", "depths", "wavelengths", "grid")))
    r = radial.edges(alone)[1:-1]
    before, behind = (height(element, r + s * 1e-6 * R, torch.zeros_like(r)) for s in (-1, 1))
    return (squares(behind - before) * r).sum(-1) * 2 / R**2
