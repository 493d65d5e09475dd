"""Modulation of diffraction from few rays: a pupil over itself, sheared, by quadrature.

    OTF(ν) = ∬ √(J₊ J₋) exp 2πi (W₊ - W₋) ds / ∬ J ds,    ± at s ± ν/2

Over directions s = n (L, M)/λ in 1/mm, with W the wave in waves and J = |∂p/∂s| the light of an entrance pupil |p| ≤ 1
that is lit evenly. W and p are polynomials of s that fit the rays of a few rings by least squares. The part that both
pupils cover is cut into lines along the shear from rim to rim, with Gaussian rules along and across: their error falls
exponentially with their points, where cells of a grid err by their share at the rim.

Derivatives are exact for the computed numbers: backward from the OTFs to the polynomials, by torch, and by the normal
equations from these to the rays, whose derivatives by the variables come from the trace.

Source: Hopkins, Proc. Phys. Soc. B 70, 1957 (the sheared pupil); Golub & Pereyra 1973 (derivative of a fit).

Where polynomials do not describe pupil and wave, the OTF is the autocorrelation of a regular grid of directions.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.setting import refuse_dark
from raytrace.budget import forewarn, piece
from raytrace.maths import zernike
from raytrace.maths.numerics import placed, safe_divide, safe_sqrt, value
from raytrace.maths.sampling import gauss_legendre, gauss_rings
from raytrace.psf_models.dft import TooManyPoints, phasor
from raytrace.system.apertures import stands_inside
from raytrace.system.lens import name_of_field
from raytrace.tracing.scene import Scene, beam_share
from raytrace.tracing.trace import is_bent
from raytrace.tracing.wavefront import Wavefront, wavefront_of
from raytrace.words import with_options

_PROBE = 10, 40
_DEGREES = (14, 18, 22)  # tried in this order
_MISSED = 1e-4  # waves that the polynomial may miss, at any of the rays that it is not fitted to
_RAYS = "focus the lens, or use geometric rays, {geometric=True}"
MARGIN = 1.06  # the square of directions reaches that much beyond the outermost ray of the probe


@value
class Beam:
    """The rays of a few rings of the pupil, and the square of direction cosines (u, v) = ((L, M) - middle)/half.

    middle, half: (2, 1, F, W), half with the margin; waves_per: (W,) n/λ, 1/mm.
    """

    wavefront: Wavefront
    middle: Tensor
    half: Tensor
    waves_per: Tensor

    @property
    def blur(self) -> Tensor:
        """Farthest landing (1, F, W) mm of a usable ray from the chief ray's point."""
        front = self.wavefront
        return torch.where(front.usable, torch.linalg.vector_norm(front.landing, dim=0), 0.0).amax(-1)

    @property
    def cutoffs(self) -> Tensor:
        """Highest frequencies (2, F, W) 1/mm that pass along x and y, the widths of the beam's directions n L/λ."""
        return (2 / MARGIN * self.half * self.waves_per)[:, 0]


def beam_of(scene: Scene) -> Beam:
    like: dict[str, Any] = {"dtype": scene.wavelengths.dtype, "device": scene.wavelengths.device}
    front = wavefront_of(scene, *gauss_rings(*_PROBE, **like))
    directions = front.direction[:2]
    low = torch.where(front.usable, directions, torch.inf).amin(-1)
    high = torch.where(front.usable, directions, -torch.inf).amax(-1)
    return Beam(front, (low + high) / 2, MARGIN * (high - low) / 2, 1e3 * front.index / front.wavelength)


def polynomials_of(scene: Scene, beam: Beam) -> Tensor | None:
    """Coefficients (3, F, W, N, N) of u^i v^j of the pupil point p_x, p_y and of the wave, in waves.

    None where a ray fails or is clipped, where an aperture may stop light within the beam, and where no degree of
    _DEGREES brings the rays between the fitted ones within _MISSED.
    """
    if any(stands_inside(aperture) for surface in scene.lens.surfaces for aperture in surface.apertures):
        return None
    like: dict[str, Any] = {"dtype": scene.wavelengths.dtype, "device": scene.wavelengths.device}
    for degree in _DEGREES:
        rings, arms = degree // 2 + 3, 2 * degree + 8
        points, weights = gauss_rings(rings, arms, **like)
        rim = points[:, -arms:]
        points = torch.cat([points, (1 - 1e-9) * rim / torch.hypot(*rim)], 1)
        root = torch.cat([weights, torch.full_like(rim[0], 0.5) * weights.min()]).sqrt()
        others = gauss_rings(rings + 1, arms + 3, **like)[0]
        traced = wavefront_of(scene, torch.cat([points, others], 1))
        if not bool(traced.valid.all()):
            return None
        u, v = (traced.direction[:2] - beam.middle[..., None])[:, 0] / beam.half[:, 0, ..., None]
        powers = [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]
        raised = [torch.stack([part**k for k in range(degree + 1)], -1) for part in (u, v)]
        basis = raised[0][..., [i for i, _ in powers]] * raised[1][..., [j for _, j in powers]]
        waves = (traced.opd / (1e-3 * traced.wavelength)[:, None])[0]
        wanted = torch.stack([*(part.expand_as(waves) for part in torch.cat([points, others], 1)), waves], -1)
        fitted = len(root)
        q, r = torch.linalg.qr(root[:, None] * basis[..., :fitted, :])
        terms = torch.linalg.solve_triangular(r, q.mT @ (root[:, None] * wanted[..., :fitted, :]), upper=True)
        missed = (wanted - basis @ terms)[..., fitted:, 2].detach().abs().amax()
        if float(missed) <= _MISSED:
            size = degree + 1
            place = torch.tensor([i * size + j for i, j in powers], device=terms.device)
            table = terms.new_zeros(3, *terms.shape[:2], size * size)
            return table.index_copy(-1, place, terms.movedim(-1, 0)).unflatten(-1, (size, size))
    return None


def on_grid(polynomial: Tensor, line: Tensor) -> Tensor:
    """A polynomial (..., N, N) of u^i v^j on the grid (..., V, U) of a line (P,) of both."""
    powers = torch.stack([line**k for k in range(polynomial.shape[-1])], -1)
    return powers @ polynomial.mT @ powers.T


_DEGREE, _TERMS = 10, 66  # of the Zernike map from directions to the pupil
_LEAST, _MOST = 128, 1280  # points across the grid
_TRACED_BYTES, _CELL_BYTES = 480, 96  # of a cell that is traced, and of others
_RIM_RAYS = 64  # along the rim, from which the wave there is interpolated
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
    scene: Scene, *, size: int | None = None, least: int = _LEAST, seconds: float | None = None, fit: bool = False
) -> ExitPupil:
    """The wave on a regular grid of directions, whose rays are found by a Zernike map from directions to the pupil.

    Light is spread evenly over the entrance pupil: |A|² = |∂p/∂(L, M)|. A cell that the rim of the pupil crosses counts
    by its share, so that the grid errs by O(1/N²); one at the rim of another aperture counts or does not.
    Every cell is traced on a grid up to 160 across. On a finer one the wave is a polynomial of directions where it
    misses no ray by more than 1e-4 waves and no ray fails or is clipped, see `polynomials_of`; with `fit` also on a
    coarser one, and cells are not stored in the memo of the scene, whose rays serve every sensor distance.
    size: N points across, by default as many as keep blurs from overlapping, and `least`. Raises TooManyPoints where
    that is too many, or where the trace is predicted to take more than `seconds`; None: a long one is warned of.
    """
    like: dict[str, Any] = {"dtype": scene.wavelengths.dtype, "device": scene.wavelengths.device}
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
            f"the blur needs {size} points across the pupil, more than {_MOST}: {with_options(_RAYS)}{_outside(scene)}"
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
    on_disc = None  # of each field and wavelength
    if turn is not None:
        u, v = _on_disc(turn[..., None], line.expand(size, -1), line[:, None].expand(-1, size))
        on_disc = u * u + v * v <= 1
        inside = on_disc.any(2).any(1)[0]
        on_disc = on_disc[..., inside]
    parts, each = [pupil, by_l, by_m], _TRACED_BYTES
    if size > _TRACED or fit:
        polynomials = polynomials_of(scene, beam)
        if polynomials is None:
            _afford_time(scene, int(inside.sum()) * probe.opd[..., 0].numel(), seconds)
        else:
            parts.append(on_grid(polynomials[2], line)[None, None])
            each = _CELL_BYTES
    together = piece(each * probe.opd[..., 0].numel())
    rim = _rim_waves(scene) if fit and len(parts) > 3 else None
    alone = dataclasses.replace(scene, memo=None) if fit else scene
    cells = [
        _cells(alone, *some, size=size, rim=rim)
        for some in zip(*(part[..., inside].split(together, -1) for part in parts), strict=True)
    ]
    field, light = (torch.cat(parts, -1) for parts in zip(*cells, strict=True))
    field, light = (part if on_disc is None else torch.where(on_disc, part, 0.0) for part in (field, light))
    energy = torch.where(probe.valid, probe.energy, 0.0)
    total = energy.sum(-1)
    offset = safe_divide((energy * probe.landing).sum(-1), total.expand_as(probe.landing[..., 0]))
    return ExitPupil(
        amplitude=placed(field[0], inside),
        energy=light.sum(-1)[0],
        step=(2 / size * half * beam.waves_per)[:, 0],
        centre=probe.centre[:2, 0],
        centroid=(probe.centre[:2] + offset)[:, 0],
        light=total[0],
    )


def points_needed(beam: Beam) -> float:
    """Points across the pupil that keep the blurs of a beam from overlapping: not differentiated."""
    return 4 * float((beam.blur * beam.half.amax(0) * beam.waves_per).max().detach())


def _outside(scene: Scene) -> str:
    """The end of a message about a beam that is too wide: a field outside those of the lens, if there is one."""
    fields = scene.lens.fields
    largest, extent = float(torch.hypot(*scene.fields).amax()), float(fields.extent)
    return (
        f"; field {largest:.4g} {fields.unit} is outside the lens's, {extent:.4g}" if largest > 1.001 * extent else ""
    )


def _afford_time(scene: Scene, rays: int, seconds: float | None) -> None:
    """Raise TooManyPoints where a trace takes more than `seconds`; warn TakesLong of a long one without these."""
    aimed = 4 if scene.lens.ray_aiming == "real" else 1
    needed = rays * len(scene.lens.surfaces) * aimed * _SURFACE_SECONDS
    need = f"the blur needs a grid of {rays:,} rays"
    if seconds is None:
        forewarn(needed, need, helps="use geometric rays, {geometric=True}")
    elif needed > seconds:
        raise TooManyPoints(f"{need}, {needed:.0f} s: {with_options(_RAYS)}{_outside(scene)}")


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
    scene: Scene,
    pupil: Tensor,
    by_l: Tensor,
    by_m: Tensor,
    waves: Tensor | None = None,
    *,
    size: int,
    rim: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The wave (1, F, W, P) in cells of `size` across at points of the pupil (2, 1, F, W, P), and its |A|².

    by_l, by_m: derivatives of the points by directions scaled to the disc; waves: (1, 1, F, W, P), traced if None;
    rim: of `_rim_waves`, in place of traced rays at the rim.
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
        some = pupil[..., at_rim]
        traced = _traced(scene, some, radius[..., at_rim])[0] if rim is None else _at_angles(rim, some)
        waves = torch.where(beyond, torch.zeros_like(waves[0]).index_copy(-1, at_rim, traced), waves[0])
    else:
        waves = waves[0]
    return share * safe_sqrt(density) * phasor(waves), share * density


def _rim_waves(scene: Scene) -> Tensor | None:
    """Fourier coefficients (1, F, W, M) of the wave along the rim of the pupil, in waves, from a few rays of it.

    None where the upper half of them adds more than _MISSED waves.
    """
    like: dict[str, Any] = {"dtype": scene.wavelengths.dtype, "device": scene.wavelengths.device}
    angle = 2 * math.pi / _RIM_RAYS * torch.arange(_RIM_RAYS, **like)
    points = torch.stack([torch.cos(angle), torch.sin(angle)])
    waves, valid = _traced(scene, points, torch.ones_like(angle))
    terms = torch.fft.rfft(waves) / _RIM_RAYS
    high = 2 * terms[..., terms.shape[-1] // 2 :].detach().abs().sum(-1).max()
    return terms if bool(valid.all()) and float(high) <= _MISSED else None


def _at_angles(terms: Tensor, pupil: Tensor) -> Tensor:
    """A Fourier series (..., M) of the angle in the pupil at points (2, ..., P)."""
    turn = torch.complex(*pupil) / torch.hypot(*pupil)
    total = torch.zeros_like(turn)
    for term in terms[..., 1:].flip(-1).movedim(-1, 0):  # by Horner's rule, the highest first
        total = (total + term[..., None]) * turn
    return terms[..., :1].real + 2 * total.real


def _traced(scene: Scene, pupil: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Waves (1, F, W, P) at points of the pupil, of those beyond the rim on it, and whether the rays are valid."""
    traced = wavefront_of(scene, pupil * ((1 - 1e-9) / radius.clamp_min(1.0)))
    return traced.opd / (1e-3 * traced.wavelength)[:, None], traced.valid


_RIM = 1 - 1e-9  # rays of the rim, which rounding must not put outside
_NEWTON = 12  # steps at the most
_CLOSE = 1e-7  # of the pupil, from where one more step ends at rounding
_WHOLE = 1.98  # of pupil radii: a shear that leaves nothing in common

Pair = tuple[Tensor, Tensor]


class Layout(NamedTuple):
    """Rays of a beam: pupil points (2, R), their weights (R,), and powers (i, j) of s_x and s_y of the fit.

    half: the right half of a beam that is symmetric about the y axis; W and p_y are even in x, p_x is odd.
    """

    points: np.ndarray
    weights: np.ndarray
    degree: int
    half: bool

    @property
    def powers(self) -> tuple[np.ndarray, np.ndarray]:
        """The powers of W and p_y, and of p_x: (K, 2) each."""
        every = np.array([(i, n - i) for n in range(self.degree + 1) for i in range(n + 1)])
        even, odd = (every[every[:, 0] % 2 == parity] if self.half else every for parity in (0, 1))
        return even, odd


def layout_of(degree: int, *, half: bool) -> Layout:
    """Rings of a Gaussian rule that a polynomial of a degree is orthogonal on, and one ring at the rim."""
    rings, arms = degree // 2 + 1, 4 * (degree // 2 + 1)
    points, weights = (part.numpy() for part in gauss_rings(rings, arms))
    rim = points[:, -arms:] / np.hypot(*points[:, -arms:])
    points, weights = np.concatenate([points, _RIM * rim], 1), np.append(weights, np.full(arms, 0.5 * weights.min()))
    chosen = points[0] > 0 if half else slice(None)
    return Layout(points[:, chosen], weights[chosen], degree, half)


# -- polynomials of the rays -------------------------------------------------------------------------------------------


class Fit:
    """Polynomials (B, N, N) of W, p_x and p_y in directions, and their derivatives by the fitted rays.

    s = middle + scale * (u, v), which puts the beam into a square; `middle` and `scale` (2, B) are choices without
    effect on the polynomials in s.
    """

    def __init__(self, layout: Layout, wave: np.ndarray, directions: np.ndarray):
        """wave: (B, R) waves; directions: s (2, B, R) 1/mm."""
        self.layout, self.wave = layout, wave
        low, high = directions.min(-1), directions.max(-1)
        self.middle, self.scale = 0.5 * (low + high), 0.5 * (high - low)
        if layout.half:
            self.middle[0], self.scale[0] = 0.0, np.abs(directions[0]).max(-1)
        self.places = (directions - self.middle[..., None]) / self.scale[..., None]
        even, odd = layout.powers
        px, py = (np.broadcast_to(p, wave.shape) for p in layout.points)
        root = np.sqrt(layout.weights)
        self.parts = [_Part(powers, root, self.places, data) for powers, data in ((odd, px), (even, py), (even, wave))]

    @property
    def polynomials(self) -> np.ndarray:
        """(3, B, N, N) coefficients of u^i v^j: p_x, p_y, W."""
        return np.stack([part.table(self.layout.degree + 1) for part in self.parts])

    @property
    def missed(self) -> np.ndarray:
        """RMS (B,) in waves of the residual of the polynomials of W."""
        return np.sqrt((self.layout.weights * self.parts[2].left ** 2).sum(-1) / self.layout.weights.sum())

    def by_rays(self, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By waves (Q, B, R) and directions (2, Q, B, R), from derivatives (3, Q, B, N, N) by the polynomials."""
        backs = [part.back(slope) for part, slope in zip(self.parts, slopes, strict=True)]
        return backs[2][0], sum(places for _, places in backs) / self.scale[:, None, :, None]


class _Part:
    """One polynomial: c = V⁺ d, over powers (K, 2), of data (B, R) at places (2, B, R) with roots of weights (R,)."""

    def __init__(self, powers: np.ndarray, root: np.ndarray, places: np.ndarray, data: np.ndarray):
        self.powers, self.root = powers, root
        (across, by_across), (along, by_along) = (_raised(places[k], powers[:, k]) for k in range(2))
        self.basis, self.by_u, self.by_v = across * along, by_across * along, across * by_along
        q, r = np.linalg.qr(root[:, None] * self.basis)
        self.turn = np.linalg.inv(r)
        self.inverse: np.ndarray = self.turn @ (q.swapaxes(-1, -2) * root)
        self.terms: np.ndarray = (self.inverse @ data[..., None])[..., 0]
        self.left: np.ndarray = data - (self.basis @ self.terms[..., None])[..., 0]

    def table(self, size: int) -> np.ndarray:
        table = np.zeros((len(self.terms), size, size))
        table[:, self.powers[:, 0], self.powers[:, 1]] = self.terms
        return table

    def back(self, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By the data (Q, B, R) and by the places (2, Q, B, R).

        dc = V⁺ (dd - dV c) + (VᵀV)⁻¹ dVᵀ r, r = d - V c what is left
        """
        slopes_at = slope[..., self.powers[:, 0], self.powers[:, 1]][..., None, :]  # (Q, B, 1, K)
        by_data = (slopes_at @ self.inverse)[..., 0, :]
        inner = (slopes_at @ self.turn @ self.turn.swapaxes(-1, -2))[..., 0, :]
        left = self.root**2 * self.left
        by_places = []
        for by in (self.by_u, self.by_v):
            along, back = (by @ self.terms[..., None])[..., 0], (by @ inner[..., None])[..., 0]
            by_places.append(left * back - by_data * along)
        return by_data, np.stack(by_places)


def _raised(x: np.ndarray, powers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x^k and its slope k x^(k-1), (..., K)."""
    every = np.ones((*x.shape, powers.max() + 1))
    for k in range(1, every.shape[-1]):
        every[..., k] = every[..., k - 1] * x
    return every[..., powers], powers * every[..., np.maximum(powers - 1, 0)]


# -- the sheared pupil -------------------------------------------------------------------------------------------------


def otf(polynomials: Tensor, shear: Tensor, points: int) -> Tensor:
    """OTF (Q, B) complex of polynomials (3, Q, B, N, N), p_x, p_y and W, sheared along their last axis.

    shear: (Q, B), in the units of their places; points: of the rules along and across.
    """
    with torch.no_grad():
        corner, slope, overlap = _corners(polynomials[:2], shear)
    dead = ~overlap
    shear = torch.where(dead, 0.5, shear)
    pupil = polynomials[:2]
    ends = [_within(pupil, corner[0], corner[1] + side * shear) - 1 for side in (0.5, -0.5)]
    (a, b), (c, d) = slope
    across = corner[0] - torch.where(dead, 0.0, (d * ends[0] - b * ends[1]) / (a * d - b * c))
    nodes, weights = (torch.from_numpy(part) for part in gauss_legendre(points))
    angle = 0.5 * math.pi * nodes
    low, high = across
    half = 0.5 * (high - low)[..., None]
    place = 0.5 * (high + low)[..., None] + half * torch.sin(angle)
    width = half * 0.5 * math.pi * weights * torch.cos(angle)
    line = _lines(polynomials, place)
    bottom, top = (_rim(line[..., :2], place.detach(), side) for side in (-1.0, 1.0))
    reach = 0.5 * (top - bottom - shear[..., None])
    along = 0.5 * (top + bottom)[..., None] + reach[..., None] * nodes
    area = width[..., None] * reach[..., None] * weights
    (W1, J1), (W2, J2) = (_wave(line, along + side * shear[..., None, None]) for side in (0.5, -0.5))
    light = area * safe_sqrt(J1 * J2) / math.pi
    phase = 2 * math.pi * (W1 - W2)
    total = torch.complex((light * torch.cos(phase)).sum((-1, -2)), (light * torch.sin(phase)).sum((-1, -2)))
    return torch.where(dead, 0.0, total)


def _wave(line: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """W and J at places (..., P) of lines (..., N, 5): p_x, p_y, W, and the slopes of p_x and p_y across."""
    values, slopes = _along(line, place)
    (x, y), (x_u, y_u) = slopes[..., :2].unbind(-1), values[..., 3:].unbind(-1)
    return values[..., 2], (x_u * y - y_u * x).abs()


def _lines(polynomials: Tensor, place: Tensor) -> Tensor:
    """Polynomials (..., P, N, 5) along the lines at places (..., P) across, of p_x, p_y and W, and of p_x and p_y their
    slopes across."""
    fixed_place, count = place.detach(), polynomials.shape[-1]
    powers = _powers(fixed_place, count)
    first, second = _slope_of(powers), _slope_of(_slope_of(powers))
    moved, fixed = (place - fixed_place)[..., None], polynomials.detach()
    line = powers @ polynomials + moved * (first @ fixed)
    steep = first @ polynomials[:2] + moved * (second @ fixed[:2])
    return torch.cat([line, steep]).movedim(0, -1)


def _powers(x: Tensor, count: int) -> Tensor:
    """x^k (..., N)."""
    powers = x.new_ones(*x.shape, count)
    for k in range(1, count):
        torch.mul(powers[..., k - 1], x, out=powers[..., k])
    return powers


def _slope_of(powers: Tensor) -> Tensor:
    """k x^(k-1) of powers x^k (..., N); applied again, the second derivative."""
    k = torch.arange(powers.shape[-1], dtype=powers.dtype)
    return k * torch.roll(powers, 1, -1)


def _along(line: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Values and slopes (..., P, C) of polynomials (..., N, C) at places (..., P), with derivatives by both."""
    count, fixed = line.shape[-2], line.detach()
    powers = _powers(place.detach(), count)
    k = torch.arange(1, count, dtype=line.dtype)[:, None]
    steep = k * line[..., 1:, :2]
    values, slopes = powers @ line, powers[..., :-1] @ steep
    if not place.requires_grad:
        return values, slopes
    moved = (place - place.detach())[..., None]
    bend = powers[..., :-2] @ (k[:-1] * steep.detach()[..., 1:, :])
    return values + moved * (powers[..., :-1] @ (k * fixed[..., 1:, :])), slopes + moved * bend


def _rim(line: Tensor, place: Tensor, side: float) -> Tensor:
    """Where lines (..., P, N, 2) at places (..., P) across reach |p|² = 1, on one side."""
    fixed, rim = line.detach(), side * (safe_sqrt((1 - place * place).clamp_min(0.0)) + 0.05)
    for _ in range(_NEWTON):
        powers = _powers(rim, line.shape[-2])[..., None, :]
        p, by = powers @ fixed, _slope_of(powers) @ fixed
        slope = 2 * (p * by).sum((-1, -2))
        slope = torch.where(slope == 0, 1.0, slope)
        step = ((p * p).sum((-1, -2)) - 1) / slope
        rim = rim - step
        if float(step.abs().max()) < _CLOSE:
            break
    p = _powers(rim, line.shape[-2])[..., None, :] @ line
    return rim - ((p * p).sum((-1, -2)) - 1) / slope


def _corners(pupil: Tensor, shear: Tensor) -> tuple[Tensor, tuple[Pair, Pair], Tensor]:
    """Where both rims meet: middles (2, 2, Q, B), across and along, of both corners; slopes of |p|² there by these, of
    the pupil ahead and behind; and whether the pupils overlap (Q, B)."""
    far = 0.5 * torch.clamp(shear, max=_WHOLE)
    across = safe_sqrt(1 - far * far)
    corner = torch.stack([torch.stack([-across, across]), torch.zeros(2, *shear.shape, dtype=shear.dtype)])
    for _ in range(_NEWTON):
        (F, a, b), (G, c, d) = (_slopes(pupil, corner[0], corner[1] + side * shear) for side in (0.5, -0.5))
        det = a * d - b * c
        det = torch.where(det == 0, 1.0, det)
        step = torch.stack([d * (F - 1) - b * (G - 1), a * (G - 1) - c * (F - 1)]) / det
        corner = corner - step.clamp(-0.2, 0.2)
        if float(step.abs().max()) < _CLOSE:
            break
    overlap = (step.abs().amax((0, 1)) < _CLOSE) & (corner[0, 1] > corner[0, 0]) & (shear < _WHOLE)
    apart = torch.stack([torch.tensor([-0.5, 0.5]).double(), torch.zeros(2).double()])[..., None, None]
    return torch.where(overlap, corner, apart), ((a, b), (c, d)), overlap


def _slopes(pupil: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """|p|² and its derivatives at places (C, Q, B)."""
    (x, y), (xu, yu), (xv, yv) = (_at(pupil, *powers) for powers in _raised_at(u, v, pupil.shape[-1]))
    return x * x + y * y, 2 * (x * xu + y * yu), 2 * (x * xv + y * yv)


def _raised_at(u: Tensor, v: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
    """Powers of both, and the slopes of those of either."""
    U, V = _powers(u, count), _powers(v, count)
    return [(U, V), (_slope_of(U), V), (U, _slope_of(V))]


def _at(pupil: Tensor, U: Tensor, V: Tensor) -> Tensor:
    """p (2, C, Q, B) at places by their powers (C, Q, B, N)."""
    return ((U[..., None, :] @ pupil[:, None])[..., 0, :] * V).sum(-1)


def _within(pupil: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """|p|² at fixed places (C, Q, B)."""
    x, y = _at(pupil, _powers(u, pupil.shape[-1]), _powers(v, pupil.shape[-1]))
    return x * x + y * y
