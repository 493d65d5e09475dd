"""A pupil and its wave as polynomials of directions, where a few hundred rays determine them."""

import torch
from torch import Tensor

from raytrace.maths.pupil import gauss_rings
from raytrace.maths.value import value
from raytrace.optics.scene import Scene
from raytrace.optics.wavefront import Wavefront, wavefront_of
from raytrace.system.aperture import stands_inside

_PROBE = 10, 40
_DEGREES = (14, 18, 22)  # tried in this order
_MISSED = 1e-4  # waves that the polynomial may miss, at any of the rays that it is not fitted to
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
    like = {"dtype": scene.wavelengths.dtype, "device": scene.wavelengths.device}
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
    like = {"dtype": scene.wavelengths.dtype, "device": scene.wavelengths.device}
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
        found = torch.linalg.solve_triangular(r, q.mT @ (root[:, None] * wanted[..., :fitted, :]), upper=True)
        missed = (wanted - basis @ found)[..., fitted:, 2].detach().abs().amax()
        if float(missed) <= _MISSED:
            table = found.new_zeros(3, *found.shape[:2], degree + 1, degree + 1)
            at = tuple(torch.tensor(part, device=found.device) for part in zip(*powers, strict=True))
            return _filled(table, at, found)
    return None


def _filled(table: Tensor, at: tuple[Tensor, Tensor], found: Tensor) -> Tensor:
    """Coefficients (F, W, J, 3) at their powers in a table (3, F, W, N, N)."""
    place = at[0] * table.shape[-1] + at[1]
    return table.flatten(-2).index_copy(-1, place, found.movedim(-1, 0)).unflatten(-1, table.shape[-2:])


def on_grid(polynomial: Tensor, line: Tensor) -> Tensor:
    """A polynomial (..., N, N) of u^i v^j on the grid (..., V, U) of a line (P,) of both."""
    powers = torch.stack([line**k for k in range(polynomial.shape[-1])], -1)
    return powers @ polynomial.mT @ powers.T
