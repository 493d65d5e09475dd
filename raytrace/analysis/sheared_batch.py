"""The MTF of diffraction of lenses near a nominal one, many at once, from the rays of a few rings.

The sheared pupil of `pupil_autocorrelation.py` with all choices made of the nominal lens: rays, degree of the
polynomials and coordinates of the directions. Pupil points and waves are fitted by least squares in products of
Chebyshev polynomials. Apertures clip none of the rays: beams are those of the vignetting factors.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.mtf import cutoff, modulation, rule_of_blur
from raytrace.analysis.pupil_autocorrelation import MARGIN, otf
from raytrace.analysis.setting import wavelength_shares
from raytrace.maths.sampling import gauss_rings
from raytrace.maths.tangents import applied
from raytrace.psf_models.dft import TooManyPoints
from raytrace.system.lens import Lens, name_of_field
from raytrace.tracing.scene import Scene, scene
from raytrace.tracing.trace import without_apertures
from raytrace.tracing.wavefront import Wavefront, wavefront_of
from raytrace.words import RaytraceError

_DEGREES = (8, 10, 12, 14, 18, 22)
_MISSED = (
    3e-4  # waves in RMS that the polynomials may miss of the nominal wave, between the rays that they are fitted to
)
_RIM = 1 - 1e-9  # rays of the rim, which rounding must not put outside
_SPREAD = 2.0  # by which blurs may exceed that of the nominal lens


class ClippedBeam(RaytraceError, ValueError):
    """A beam that apertures clip, or of which rays fail."""


class ShearedPupils:
    """MTF at one frequency of lenses near a nominal one, for fields (2, F) and the wavelengths of the lens.

    frequency: cycles/mm. Raises ValueError for one that no light passes at, ClippedBeam where rays of the nominal lens
    do not arrive, TooManyPoints where they land too far apart or where no polynomial describes the wave.
    """

    def __init__(self, lens: Lens, fields: Tensor, frequency: float):
        highest = float(cutoff(lens, lens.wavelengths).max())
        if not 0 < frequency < highest:
            raise ValueError(f"{frequency:g} cycles/mm: expected more than 0 and less than the cutoff, {highest:.4g}")
        self.fields, self.frequency = fields, frequency
        with torch.no_grad():
            for self.degree in _DEGREES:
                missed, turns = self._settled(lens)
                if missed <= _MISSED:
                    break
            else:
                raise TooManyPoints(f"polynomials of the wave miss {missed:.2g} waves; expected a smoother lens")
        if rule_of_blur(_SPREAD * turns) is None:
            raise TooManyPoints(
                f"the light spreads over {turns:.3g} periods of {frequency:g} cycles/mm: focus the lens"
            )

    def _settled(self, lens: Lens) -> tuple[float, float]:
        """Make all choices for a degree: RMS in waves that its polynomials miss, and periods that the light covers."""
        like: dict[str, Any] = {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}
        rings, arms = self.degree // 2 + 1, 2 * self.degree + 4
        points, weights = gauss_rings(rings, arms, **like)
        rim = points[:, -arms:]
        self.points = torch.cat([points, _RIM * rim / torch.hypot(*rim)], 1)
        self.root = torch.cat([weights, torch.full_like(rim[0], 0.5) * weights.min()]).sqrt()
        others, shares = gauss_rings(rings + 1, arms + 3, **like)
        front = wavefront_of(_scene(lens, self.fields), torch.cat([self.points, others], 1))
        if not bool(front.valid.all()):
            self._refuse(front)
        directions = front.direction[:2, 0]
        low, high = directions.amin(-1), directions.amax(-1)
        self.middle, self.half = 0.5 * (low + high), 0.5 * MARGIN * (high - low)
        tables = self._polynomials(front, slice(None, len(self.root)))
        u, v = self._places(front)
        fitted = sum(tables[2, 0, ..., i, j, None] * u[0] ** i * v[0] ** j for i, j in self._powers())
        left = (_waves(front)[0] - fitted)[..., len(self.root) :]
        blur = torch.linalg.vector_norm(front.landing, dim=0).max()
        return float((shares * left * left).sum(-1).max().sqrt()), float(blur * self.frequency)

    def _refuse(self, front: Wavefront) -> None:
        lost = ~front.valid[0]
        field = int(lost.flatten(1).any(-1).int().argmax())
        share = 100 * float(lost[field].double().mean())
        raise ClippedBeam(
            f"{share:.3g} % of the rays of field {name_of_field(self.fields[:, field])} are clipped or fail; expected "
            "beams that arrive whole: give other fields, or vignetting factors in place of apertures"
        )

    def __call__(self, lens: Lens) -> tuple[Tensor, Tensor]:
        """Tangential and sagittal MTF (L, F) of lenses; nan where a ray fails."""
        front = wavefront_of(_scene(without_apertures(lens), self.fields), self.points)
        arrive = front.valid.all(-1).all(-1)
        polynomials = self._polynomials(front, slice(None))
        per_mm = 1e3 * front.index / front.wavelength
        shear = self.frequency / (self.half.flip(0) * per_mm)
        blur = torch.linalg.vector_norm(front.landing.detach(), dim=0).flatten(1).amax(-1)
        rules = [rule_of_blur(turns) or 0 for turns in (self.frequency * blur).tolist()]
        parts = torch.full((2, *front.valid.shape[:-1]), torch.nan, dtype=blur.dtype, device=blur.device) + 0j
        for points in sorted({*rules} - {0}):
            chosen = torch.tensor([k for k, rule in enumerate(rules) if rule == points], device=blur.device)
            some = polynomials[:, chosen]
            both = torch.stack([some, some.mT], 1)  # along y, along x
            otfs = otf(both.flatten(2, 4), shear[:, None].expand(2, len(chosen), -1, -1).flatten(1), points)
            parts = parts.index_copy(1, chosen, otfs.unflatten(1, some.shape[1:4]))
        place = front.centre[:2].flip(0)
        shift = place - place[..., lens.primary_wavelength - 1, None]
        weights = wavelength_shares(lens) * front.energy.sum(-1)
        frequencies, weights = blur.new_tensor([self.frequency]), weights.repeat(2, 1, 1)
        curves = modulation(parts.flatten(0, 2)[..., None], frequencies, shift.flatten(0, 2), weights.flatten(0, 1))
        tangential, sagittal = torch.where(arrive, curves[:, 0].unflatten(0, parts.shape[:3]), torch.nan).unbind(0)
        return tangential, sagittal

    def _powers(self) -> list[tuple[int, int]]:
        return [(i, n - i) for n in range(self.degree + 1) for i in range(n + 1)]

    def _places(self, front: Wavefront) -> Tensor:
        """Directions (2, L, F, W, P) in a square."""
        return (front.direction[:2] - self.middle[:, None, ..., None]) / self.half[:, None, ..., None]

    def _polynomials(self, front: Wavefront, fitted: slice) -> Tensor:
        """Coefficients (3, L, F, W, N, N) of u^i v^j of the pupil point p_x, p_y and of the wave in waves."""
        places, waves, powers = self._places(front)[..., fitted], _waves(front)[..., fitted], self._powers()
        raised = []
        for x in places:
            terms = [torch.ones_like(x), x]
            for _ in range(2, self.degree + 1):
                terms.append(2 * x * terms[-1] - terms[-2])
            raised.append(torch.stack(terms, -1))
        basis = self.root[:, None] * raised[0][..., [i for i, _ in powers]] * raised[1][..., [j for _, j in powers]]
        wanted = torch.stack([*(p.expand_as(waves) for p in self.points), waves], -1)
        fit = applied(_LeastSquares, basis, self.root[:, None] * wanted)
        size = self.degree + 1
        place = torch.tensor([i * size + j for i, j in powers], device=fit.device)
        table = fit.new_zeros(3, *fit.shape[:-2], size * size).index_copy(-1, place, fit.movedim(-1, 0))
        by_power = fit.new_tensor(_chebyshev(size))
        return by_power.T @ table.unflatten(-1, (size, size)) @ by_power


class _LeastSquares(torch.autograd.Function):
    """c (..., J, K) = V⁺ d of bases V (..., P, J) and data d (..., P, K), by the normal equations.

        δc = V⁺ (δd - δV c) + (VᵀV)⁻¹ δVᵀ r,   r = d - V c

    Source: Golub & Pereyra, SIAM J. Numer. Anal. 10, 413 (1973).
    """

    @staticmethod
    def forward(context: Any, basis: Tensor, data: Tensor) -> Tensor:
        root, _ = torch.linalg.cholesky_ex(basis.mT @ basis)  # of a lens whose rays fail: numbers without meaning
        fit = torch.cholesky_solve(basis.mT @ data, root)
        context.save_for_backward(basis, data, root, fit)
        return fit

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context: Any, slope: Tensor) -> tuple[Tensor, Tensor]:
        basis, data, root, fit = context.saved_tensors
        inner = torch.cholesky_solve(slope, root)
        by_data = basis @ inner
        return (data - basis @ fit) @ inner.mT - by_data @ fit.mT, by_data


def _scene(lens: Lens, fields: Tensor) -> Scene:
    distance = lens.surfaces[0].thickness.reshape(-1).expand(lens.count or 1)
    return scene(lens, fields, distance, lens.wavelengths)


def _waves(front: Wavefront) -> Tensor:
    return front.opd / (1e-3 * front.wavelength)[:, None]


def _chebyshev(size: int) -> np.ndarray:
    """Row k: the coefficients of T_k by powers."""
    rows = [np.polynomial.chebyshev.cheb2poly(row[: k + 1]) for k, row in enumerate(np.eye(size))]
    return np.stack([np.pad(row, (0, size - len(row))) for row in rows])
