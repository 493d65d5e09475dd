"""The exit pupil as a regular grid of directions, whose autocorrelation is the optical transfer function."""

import math

import torch
from torch import Tensor

from raytrace.analysis.setting import refuse_dark
from raytrace.analysis.smooth_pupil import MARGIN, Beam, beam_of, on_grid, polynomials_of
from raytrace.budget import forewarn, piece
from raytrace.kernels.dft import TooManyPoints, phasor
from raytrace.maths import zernike
from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.value import value
from raytrace.optics.axis import is_bent
from raytrace.optics.scene import Scene, beam_share
from raytrace.optics.wavefront import wavefront_of
from raytrace.system.lens import name_of_field

_DEGREE, _TERMS = 10, 66  # of the Zernike map from directions to the pupil
_LEAST, _MOST = 128, 1280  # points across the grid
_TRACED_BYTES, _CELL_BYTES = 480, 96  # of a cell that is traced, and of others
_TRACED = 160  # points across a grid up to which every cell is traced
_SURFACE_SECONDS = 4e-7  # a ray and surface, one core: 4 million rays through 12 surfaces took 17 to 24 s


@value
class ExitPupil:
    """The wave of every field and wavelength over a regular grid of direction cosines (L, M).

    amplitude: (F, W, N, N) complex, rows along M; energy: (F, W) Σ |A|², cells on the rim by their share.
    step: (2, F, W) spatial frequency in 1/mm by which neighbours differ, n ΔL/λ and n ΔM/λ.
    centre: (2, F, W) mm, the chief ray's point; centroid: (2, F, W) mm of the rays; light: (F, W) transmitted share.
    """

    amplitude: Tensor
    energy: Tensor
    step: Tensor
    centre: Tensor
    centroid: Tensor
    light: Tensor


def exit_pupil(
    scene: Scene, *, size: int | None = None, least: int = _LEAST, seconds: float | None = None
) -> ExitPupil:
    """The wave on a regular grid of directions, whose rays are found by a Zernike map from directions to the pupil.

    Light is spread evenly over the entrance pupil: |A|² = |∂p/∂(L, M)|. A cell that the rim of the pupil crosses counts
    by its share, so that the grid errs by O(1/N²); one at the rim of another aperture counts or does not.
    Every cell is traced on a grid up to 160 across. On a finer one the wave is a polynomial of directions where it
    misses no ray by more than 1e-4 waves and no ray fails or is clipped, see `polynomials_of`.
    size: N points across, by default as many as keep blurs from overlapping, and `least`. Raises TooManyPoints where
    that is too many, or where the trace is predicted to take more than `seconds`; None: a long one is warned of.
    """
    like = {"dtype": scene.wavelengths.dtype, "device": scene.wavelengths.device}
    beam = beam_of(scene)
    probe, middle, half = beam.wavefront, beam.middle, beam.half
    enough = (probe.usable.sum(-1) >= 2 * _TERMS) & probe.valid.any(-1)
    refuse_dark(scene.lens, scene.fields, enough[0], "wave on the sensor")
    narrow = (beam_share(scene)[0, :, 0] == 0) | (half == 0).any(0).any(-1)[0]
    if bool(narrow.any()):
        name = name_of_field(scene.fields[:, int(narrow.to(torch.int8).argmax())])
        raise ValueError(f"the beam of field {name} has no width: its vignetting factors leave nothing of the pupil")
    if size is None:
        size = max(least, 64 * math.ceil(points_needed(beam) / 64))
    if size > _MOST:
        raise TooManyPoints(
            f"the blur needs {size} points across the pupil, more than {_MOST}: focus the lens, or use geometric rays"
        )
    normal = (probe.direction[:2] - middle[..., None]) / half[..., None]
    turn = _to_disc(normal.detach(), probe.usable) if is_bent(scene.lens) else None
    basis = zernike.polynomials(_orders(_DEGREE), *_on_disc(turn, *normal)).movedim(0, -1)
    root = safe_sqrt(torch.where(probe.usable, probe.weights, 0.0))[..., None]
    map_to_pupil = torch.linalg.lstsq(root * basis, root * probe.pupil.T).solution  # (1, F, W, J, 2)
    nodes, values, slopes = _interpolation(size, _DEGREE, like)
    at_nodes = _at_nodes(map_to_pupil, _DEGREE, turn, nodes)
    pupil, by_l, by_m = (
        rows @ at_nodes @ columns.T for rows, columns in ((values, values), (values, slopes), (slopes, values))
    )
    line = (2 * torch.arange(size, **like) + 1 - size) / size
    inside = line * line + (line * line)[:, None] <= 1
    own = None
    if turn is not None:
        u, v = _on_disc(turn[..., None], line.expand(size, -1), line[:, None].expand(-1, size))
        own = u * u + v * v <= 1
        inside = own.any(2).any(1)[0]
        own = own[..., inside]
    parts, each = [pupil, by_l, by_m], _TRACED_BYTES
    if size > _TRACED:
        polynomials = polynomials_of(scene, beam)
        if polynomials is None:
            _afford_time(scene, int(inside.sum()) * probe.opd[..., 0].numel(), seconds)
        else:
            parts.append(on_grid(polynomials[2], line)[None, None])
            each = _CELL_BYTES
    together = piece(each * probe.opd[..., 0].numel())
    cells = [
        _cells(scene, *some, size=size)
        for some in zip(*(part[..., inside].split(together, -1) for part in parts), strict=True)
    ]
    field, light = (torch.cat(parts, -1) for parts in zip(*cells, strict=True))
    field, light = (part if own is None else torch.where(own, part, 0.0) for part in (field, light))
    amplitude = field.new_zeros(*field.shape[1:3], size, size)
    amplitude[..., inside] = field[0]
    energy = torch.where(probe.valid, probe.energy, 0.0)
    total = energy.sum(-1)
    offset = safe_divide((energy * probe.landing).sum(-1), total.expand_as(probe.landing[..., 0]))
    return ExitPupil(
        amplitude=amplitude,
        energy=light.sum(-1)[0],
        step=(2 / size * half * beam.waves_per)[:, 0],
        centre=probe.centre[:2, 0],
        centroid=(probe.centre[:2] + offset)[:, 0],
        light=total[0],
    )


def points_needed(beam: Beam) -> float:
    """Points across the pupil that keep the blurs of a beam from overlapping: not differentiated."""
    return 4 * float((beam.blur * beam.half.amax(0) * beam.waves_per).max().detach())


def _afford_time(scene: Scene, rays: int, seconds: float | None) -> None:
    """Raise TooManyPoints where a trace takes more than `seconds`; warn TakesLong of a long one without these."""
    aimed = 4 if scene.lens.ray_aiming == "real" else 1
    needed = rays * len(scene.lens.surfaces) * aimed * _SURFACE_SECONDS
    what = f"the blur needs a grid of {rays:,} rays"
    if seconds is None:
        forewarn(needed, what, helps="use geometric rays")
    elif needed > seconds:
        raise TooManyPoints(f"{what}, {needed:.0f} s: focus the lens, or use geometric rays")


def _orders(degree: int) -> list[zernike.Order]:
    return [zernike.noll(j) for j in range(1, (degree + 1) * (degree + 2) // 2 + 1)]


def _at_nodes(coefficients: Tensor, degree: int, turn: Tensor | None, nodes: Tensor) -> Tensor:
    """Polynomials (C, 1, F, W, K, K) of coefficients (1, F, W, J, C) at nodes (K,) of both directions."""
    y, x = torch.meshgrid(nodes, nodes, indexing="ij")
    if turn is None:
        return torch.einsum("jyx,...jc->c...yx", zernike.polynomials(_orders(degree), x, y), coefficients)
    terms = zernike.polynomials(_orders(degree), *_on_disc(turn[..., None], x, y))
    return torch.einsum("j...yx,...jc->c...yx", terms, coefficients)


def _to_disc(normal: Tensor, usable: Tensor) -> Tensor:
    """Matrices (2, 2, ..., 1) that make the directions (2, ..., P), an ellipse that may be askew in its box, a disc.

    The root of their covariance, by which the outermost come to lie within the margin.
    """
    count = usable.sum(-1)
    x, y = torch.where(usable, normal, 0.0)
    xx, xy, yy = ((a * b).sum(-1) / count for a, b in ((x, x), (x, y), (y, y)))
    across = safe_sqrt(yy - xy * xy / xx)
    zero = torch.zeros_like(xx)
    matrix = torch.stack(
        [torch.stack([1 / safe_sqrt(xx), zero]), torch.stack([-xy / xx, torch.ones_like(xx)]) / across]
    )
    u, v = _on_disc(matrix[..., None], x, y)
    farthest = torch.hypot(u, v).amax(-1)
    return (matrix / (MARGIN * farthest))[..., None]


def _on_disc(turn: Tensor | None, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    if turn is None:
        return x, y
    (xx, xy), (yx, yy) = turn
    return xx * x + xy * y, yx * x + yy * y


def _interpolation(size: int, degree: int, like: dict) -> tuple[Tensor, Tensor, Tensor]:
    """Chebyshev nodes (K,), and matrices (N, K) that give a polynomial of them, and its slope, on the line of a grid.

    A polynomial of directions is one in each of them: two small products instead of all its terms in every cell.
    """
    count = degree + 1
    k = torch.arange(count, **like)
    angle = math.pi * (k + 0.5) / count
    terms = (2 - (k == 0).to(k.dtype)) / count * torch.cos(angle[:, None] * k)  # from values at nodes to coefficients
    theta = torch.acos((2 * torch.arange(size, **like) + 1 - size) / size)[:, None]
    slopes = k * torch.sin(k * theta) / torch.sin(theta)
    return torch.cos(angle), torch.cos(k * theta) @ terms.T, slopes @ terms.T


def _cells(
    scene: Scene, pupil: Tensor, by_l: Tensor, by_m: Tensor, waves: Tensor | None = None, *, size: int
) -> tuple[Tensor, Tensor]:
    """The wave (1, F, W, P) in cells of `size` across at points of the pupil (2, 1, F, W, P), and its |A|².

    by_l, by_m: derivatives of the points by directions scaled to the disc; waves: (1, 1, F, W, P), traced if None.
    """
    radius = safe_sqrt((pupil * pupil).sum(0))
    slope = safe_divide(safe_sqrt((pupil * by_l).sum(0) ** 2 + (pupil * by_m).sum(0) ** 2), radius)
    share = (0.5 + safe_divide(1 - radius, 2 / size * slope)).clamp(0.0, 1.0)
    share = torch.where(radius < 0.5, 1.0, share)
    density = (by_l[0] * by_m[1] - by_l[1] * by_m[0]).abs()
    beyond = radius > 1  # cells whose middle lies beyond the rim have the wave of the rim
    at_rim = torch.nonzero((beyond & (share > 0)).flatten(0, -2).any(0))[:, 0]
    if waves is None:
        waves, valid = _traced(scene, pupil, radius)
        share = torch.where(valid, share, 0.0)
    elif len(at_rim):
        rim, _ = _traced(scene, pupil[..., at_rim], radius[..., at_rim])
        waves = torch.where(beyond, torch.zeros_like(waves[0]).index_copy(-1, at_rim, rim), waves[0])
    else:
        waves = waves[0]
    return share * safe_sqrt(density) * phasor(waves), share * density


def _traced(scene: Scene, pupil: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Waves (1, F, W, P) at points of the pupil, of those beyond the rim on it, and whether the rays are valid."""
    traced = wavefront_of(scene, pupil * ((1 - 1e-9) / radius.clamp_min(1.0)))
    return traced.opd / (1e-3 * traced.wavelength)[:, None], traced.valid
