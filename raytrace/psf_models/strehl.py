"""Strehl ratio: the largest intensity on the sensor, wherever light lands, over that without aberrations.

The intensity is band limited: on a grid of λ/5 NA over all that rays reach, an FFT finds the highest points, from which
Newton's method climbs. Where nothing clips the pupil, the thousands of waves of a large blur are series of few rays.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, max_pool2d

from raytrace.maths import zernike
from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.sampling import gauss_legendre, gauss_rings
from raytrace.psf_models import dft
from raytrace.psf_models.wave import Waves, amplitude, half_spread, one_field, phase_along_radius, probe_of, waves
from raytrace.system.lens import one_lens
from raytrace.tracing.clear_pupil import is_clipped
from raytrace.tracing.scene import Scene, beam_share, symmetry
from raytrace.tracing.wavefront import Wavefront, wavefront_of

_FINE = 5  # points of λ/NA: the highest of them has 0.8 of the largest intensity at the least
_TOPS = 4  # points that are climbed from
_WORTH, _MOST = 4_000, 800_000  # waves from which, and to which, they are series of fewer rays
_DEGREE = 24  # of series over the pupil
_MISSED = 1e-4  # waves that they may miss


def strehl(scene: Scene, *, order: int = 0) -> Tensor:
    """Strehl ratio (D, F, W): the largest intensity on the sensor over Σ² of the same amplitudes without aberrations.

    It is searched where rays land and 4 λ/NA beyond. First and second derivatives are those of the maximum, which moves
    with the lens. 0 where no light arrives. Raises dft.TooManyPoints where the blur needs too many rays.
    """
    return torch.cat([_of_lens(scene, d, order) for d in range(scene.shape[0])]).to(scene.wavelengths)


def _of_lens(scene: Scene, d: int, order: int) -> Tensor:
    """The ratios (1, F, W) of one lens or object distance, whose light is sampled alone."""
    if scene.shape[0] > 1:
        scene = dataclasses.replace(scene, lens=one_lens(scene.lens, slice(d, d + 1)))
    return torch.cat([_of_field(one_field(scene, f), order) for f in range(scene.shape[1])], 1)


def _of_field(scene: Scene, order: int) -> Tensor:
    probe = probe_of(scene)
    spread = half_spread(probe)
    spread = torch.where(spread > 0, spread, spread.max().clamp_min(1e-30))  # of a dark kernel any
    width = 1e-3 * probe.wavelength / probe.index / spread  # λ/NA (D, F, W) mm
    landing = torch.where(probe.usable, probe.landing.detach(), 0.0)
    low, high = landing.amin(-1) - 4 * width, landing.amax(-1) + 4 * width  # (2, D, F, W)
    blur = torch.linalg.vector_norm(landing, dim=0).amax(-1)
    reach = (torch.linalg.vector_norm(high - low, dim=0) - blur).max()
    phase = phase_along_radius(probe, reach, scene.largest)
    smooth = _smooth_waves(scene, probe, phase, order + 1)
    if smooth is None:
        light = coarse = waves(scene, reach, order=order + 1, probe=probe)
    else:  # to find maxima it is enough that rays are dense for points half as far away
        with torch.no_grad():
            coarse = smooth(0.5 * phase)
    with torch.no_grad():
        find = _highest_radii if coarse.symmetry == "round" else _highest_points
        places = zip(*find(coarse, low, high, width), strict=True)
        tops = torch.stack([torch.stack(_climbed(coarse, x, y, width, 2)) for x, y in places], 1)  # (2, K, D, F, W)
        farthest = torch.linalg.vector_norm(landing[:, None] - tops[..., None], dim=0) / width[..., None]
    if smooth is not None:
        light = smooth(2 * math.pi * float(scene.largest(farthest.max())))
    with torch.no_grad():
        best = torch.stack([_intensity(light, *top) for top in tops.unbind(1)]).argmax(0, keepdim=True)
        x, y = (c.gather(0, best)[0] for c in tops)
        x, y = _climbed(light, x, y, width, 2)
    x, y = _climbed(light, x, y, width, 1)
    peak = light.amplitude.sum(-1) / (1e-3 * probe.wavelength / probe.index)
    return safe_divide(_intensity(light, x, y), peak**2)


def _intensity(light: Waves, x: Tensor, y: Tensor) -> Tensor:
    """|U|² (D, F, W) in 1/mm² at points (D, F, W) mm from the chief ray's."""
    U = amplitude(light, x[..., None], y[..., None])[..., 0, 0]
    return U.real**2 + U.imag**2


def _climbed(light: Waves, x: Tensor, y: Tensor, width: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Points (D, F, W) mm some Newton steps nearer to a maximum of the intensity, by differences over ε^¼ λ/NA.

    The Hessian is a constant: at a maximum a step is 0 and its derivatives are those of the maximum. Along directions
    in which the intensity has no maximum there is no step.
    """
    h, longest = torch.finfo(width.dtype).eps ** 0.25 * width, width / _FINE
    offsets = h[..., None] * h.new_tensor([-1.0, 0.0, 1.0])
    for _ in range(steps):
        U = amplitude(light, x[..., None] + offsets, y[..., None] + offsets)
        (a, b, c), (d, e, f), (g, i, j) = ((row.unbind(-1)) for row in (U.real**2 + U.imag**2).unbind(-2))
        by_x, by_y = (f - d) / (2 * h), (i - b) / (2 * h)
        with torch.no_grad():
            xx, yy, xy = (d + f - 2 * e) / h**2, (b + i - 2 * e) / h**2, (a + j - c - g) / (4 * h**2)
            determinant = xx * yy - xy**2
            is_top = (xx < 0) & (determinant > 1e-6 * xx**2)
        full = safe_divide(yy * by_x - xy * by_y, determinant), safe_divide(xx * by_y - xy * by_x, determinant)
        alone = (torch.where(bend < 0, safe_divide(by, bend), 0.0) for by, bend in ((by_x, xx), (by_y, yy)))
        pairs = zip(full, alone, strict=True)
        moves = [torch.where(is_top, newton, along).clamp(-longest, longest) for newton, along in pairs]
        x, y = x - moves[0], y - moves[1]
    return x, y


def _highest_radii(light: Waves, low: Tensor, high: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """Points (K, D, F, W) mm along x at the highest maxima over the radius of round light."""
    count = math.ceil(float((_FINE * torch.maximum(high[1], -low[1]) / width).max())) + 1
    x = width[..., None] / _FINE * torch.arange(count, dtype=width.dtype, device=width.device)
    U = amplitude(light, x, torch.zeros_like(x[..., :1]))[..., 0, :]
    line = (U.real**2 + U.imag**2).flatten(0, -2)
    tops = torch.where(line == max_pool1d(line[:, None], 3, 1, 1)[:, 0], line, -1.0).reshape(x.shape)
    x = x.gather(-1, tops.topk(_TOPS).indices).movedim(-1, 0)
    return x, torch.zeros_like(x)


def _highest_points(light: Waves, low: Tensor, high: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """Points (K, D, F, W) mm at the highest maxima of a grid over the rectangle from low to high."""
    front, step = light.wavefront, width / _FINE
    columns, rows = (math.ceil(float(extent)) for extent in ((high - low) / step).flatten(1).amax(1))
    middle = 0.5 * (low + high)
    L, M, _ = front.direction
    wavelength = (1e-3 * front.wavelength / front.index).expand(step.shape)[..., None]
    path, field = front.opd + M * middle[1, ..., None], light.amplitude
    if light.symmetry == "mirror":  # each ray represents its image in x, too
        field, path, L, M = (
            torch.cat([0.5 * field] * 2, -1),
            torch.cat([path] * 2, -1),
            torch.cat([L, -L], -1),
            torch.cat([M] * 2, -1),
        )
    field = field * dft.phasor((path + L * middle[0, ..., None]) / wavelength)
    u, v = (part * (step[..., None] / wavelength) for part in (L, M))
    tops = []
    for kernel, along_x, along_y in zip(*(part.flatten(0, -2) for part in (field, u, v)), strict=True):
        image = dft.on_lattice(kernel, along_x, along_y, (rows, columns))
        is_top = image == max_pool2d(image[None], 3, 1, 1)[0]
        tops.append(torch.where(is_top, image, -1.0).flatten().topk(_TOPS).indices)
    best = torch.stack(tops, -1).reshape(_TOPS, *step.shape)
    k, l = best % columns - columns // 2, best // columns - rows // 2
    return middle[0] + k * step, middle[1] + l * step


def _smooth_waves(scene: Scene, probe: Wavefront, phase: float, order: int) -> Callable[[float], Waves] | None:
    """`waves` by the radians of phase along a radius, of a pupil that nothing clips, from few rays.

    Path and directions are Zernike series of rays on Gauss rings, where these polynomials are orthonormal. None for
    few waves or too many, where a ray fails, and where the series miss other rays by more than _MISSED waves.
    """
    fold, rule = symmetry(scene), functools.partial(gauss_rings, dtype=probe.opd.dtype, device=probe.opd.device)
    worth = _WORTH <= math.prod(dft.rings_and_arms(phase, order)) <= _MOST
    if fold == "round" or not worth or not scene.everywhere(probe.valid.all()):
        return None
    orders = [zernike.noll(j) for j in range(1, (_DEGREE + 1) * (_DEGREE + 2) // 2 + 1)]
    points, weights = rule(_DEGREE // 2 + 2, 2 * _DEGREE + 4)
    others = rule(_DEGREE // 2 + 3, 2 * _DEGREE + 7)[0]
    front, fitted = wavefront_of(scene, torch.cat([points, others], 1)), len(weights)
    if not scene.everywhere(front.valid.all()) or is_clipped(scene):
        return None
    numbers = torch.stack([front.opd, *front.direction[:2]])
    series = (numbers[..., :fitted] * weights) @ zernike.polynomials(orders, *points).T
    with torch.no_grad():
        path, *directions = (series @ zernike.polynomials(orders, *others) - numbers[..., fitted:]).abs().amax(-1)
        waves_of_direction = phase / (2 * math.pi * half_spread(probe))
        missed = torch.stack([path / (1e-3 * front.wavelength), *(waves_of_direction * part for part in directions)])
    if not float(scene.largest(missed.max())) <= _MISSED:
        return None
    return lambda phase: _dense(scene, front, series, orders, *dft.rings_and_arms(phase, order), fold)


def _dense(scene: Scene, front: Wavefront, series: Tensor, orders: Sequence, rings: int, arms: int, fold: str) -> Waves:
    """The waves of `gauss_rings(rings, arms)` by Zernike series (3, D, F, W, J) of the OPD and of L and M.

    A polynomial is a function of the radius times one of the angle, and so is the sum over those of one harmonic.
    """
    nodes, weights = (series.new_tensor(part) for part in gauss_legendre(rings))
    radius = torch.sqrt(0.5 * (nodes + 1))
    angle = (torch.arange(arms, dtype=series.dtype, device=series.device) + 0.5) * (2 * math.pi / arms)
    angle = angle[torch.cos(angle) > 0] if fold == "mirror" else angle
    of_term, every = series.new_tensor([m for _, m in orders]), torch.arange(-_DEGREE, _DEGREE + 1).to(series)[:, None]
    harmonic = (of_term == every).to(series).T  # (J, 2 N + 1)
    cosine, sine = torch.cos(every.abs() * angle), torch.sin(every.abs() * angle)
    along, across = torch.where(every < 0, sine, cosine), torch.where(every < 0, cosine, -sine) * every.abs()
    plain, zero = [(n, m) for n, m in orders if m >= 0], torch.zeros_like(radius)  # the same along the radius as of -m
    places = [plain.index((n, abs(m))) for n, m in orders]
    values, slopes = (
        part[places].T for part in (zernike.polynomials(plain, radius, zero), zernike.gradients(plain, radius, zero)[0])
    )
    by_harmonic = (series[..., None, :] * values) @ harmonic  # (3, D, F, W, rings, 2 N + 1)
    W, L, M = (by_harmonic @ along).flatten(-2)
    by_r = (series[1:, ..., None, :] * slopes) @ harmonic @ along
    by_t = by_harmonic[1:] @ across / radius[:, None]
    jacobian = (by_r[0] * by_t[1] - by_r[1] * by_t[0]).abs().flatten(-2)
    shares = (weights / (2 * len(angle)))[:, None].expand(-1, len(angle)).flatten()
    energy = (shares * beam_share(scene)[..., None]).expand(W.shape)
    direction = torch.stack([L, M, safe_sqrt(1 - L * L - M * M)])
    front = dataclasses.replace(front, opd=W, direction=direction, energy=energy)
    return Waves(safe_sqrt(energy * math.pi * shares * jacobian), front, fold)
