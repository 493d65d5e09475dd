"""The lens as built as a term of a merit function: the expected mean square spot radius, with exact derivatives.

The expectation is the mean over a fixed sample of lenses with errors e = m ± σ s, m and σ the means and standard
deviations of the tolerances, s the rows of a Hadamard matrix without its first column. Its columns are orthogonal,

    Σ s_i = 0,   Σ s_i s_j = L δ_ij,   so that   mean of q = q(m) + ½ tr(H Σ) + terms of third order in e:

L > N lenses with errors of usual size have the second order in all N tolerances exactly. The sensor of every lens is
at the minimum of its own q, a parabola of its position. The residuals are the distances of the rays from the centroid
of their spot, so that damped least squares has its usual model of the term.
Source of the design: Plackett & Burman, Biometrika 33, 305 (1946); of the matrices: Paley, J. Math. Phys. 12, 311
(1933).
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide
from raytrace.maths.tangents import tangents_of, value_of
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.problem import NoLight
from raytrace.system.lens import Lens, aligned
from raytrace.system.rays import Rays
from raytrace.tolerancing.grades import tolerances
from raytrace.tolerancing.perturbation import Perturbation
from raytrace.tolerancing.study import focuses, moments, sampling_of
from raytrace.tolerancing.table import BadTolerance, ToleranceTable
from raytrace.tracing.compiled import prepare
from raytrace.tracing.focus import focus_moments, shift_to_focus
from raytrace.tracing.spot import image_rays
from raytrace.tracing.trace import without_apertures
from raytrace.words import option

#: Angle of the astigmatism of an irregularity, degrees, and its change: the squares and the product of cos 2θ and
#: sin 2θ have the means of a uniform distribution.
_ANGLES = 45.0, 22.5


class Unlit(BadTolerance, NoLight):
    """In a lens of the sample no ray of a field passes."""


@dataclass(frozen=True)
class AsBuilt:
    """The lens as built as a term of `optimize` and `search`: M² + weight · E[q] instead of M².

    E[q] is the expected mean square spot radius of the manufactured and refocused lens, in the square of the unit of
    length of the merit function; of merit="spot" M² is that of the nominal lens.

    grade, limits: of `tolerances`, by default those of the lens's file; tolerances: instead of both. weight: above
    0; a large one minimises the lens as built alone. fields: as of `tolerance`, by default those of the lens,
    mirrored along y; rings, arms: of the pupil. Raises BadTolerance, ValueError.
    """

    grade: str | None = None
    limits: str | Sequence[str] = ""
    _: KW_ONLY
    tolerances: ToleranceTable | None = None
    weight: float = 1.0
    fields: Tensor | Sequence | None = None
    rings: int = 3
    arms: int = 6

    def __post_init__(self) -> None:
        if not 0 < self.weight < float("inf"):
            raise ValueError(f"{option('weight')} {self.weight:g} of the lens as built: expected a number above 0")
        if self.tolerances is not None and (self.grade or self.limits):
            raise ValueError(f"`tolerances` are given: leave {option('grade')} and {option('limits')} out")

    def words(self) -> str:
        """The settings in words."""
        by = self.grade or "of " + ("limits" if self.limits else "tolerances" if self.tolerances else "its file")
        return f"{by}, weight {self.weight:g}"

    def of(self, lens: Lens) -> "AsBuiltTerm":
        """The term for a lens and for those that its variables lead to. Raises BadTolerance."""
        return AsBuiltTerm(self, lens)


class AsBuiltTerm:
    """The sample of errors of one lens, and the expectation of any lens with the same surfaces.

    Limits and semi-diameters, to which fringes and runouts refer, are those of this lens. Apertures clip no ray, as in
    a merit function.
    """

    def __init__(self, settings: AsBuilt, lens: Lens):
        prepare()
        self.settings, rows = settings, settings.tolerances
        self.tolerances = tolerances(lens, settings.limits, grade=settings.grade) if rows is None else rows
        if not len(self.tolerances):
            raise BadTolerance(f"no tolerances; give a {option('grade')}, {option('limits')} or `tolerances`")
        self.limits = _focus_limits(lens, self.tolerances)
        self.perturbation = Perturbation(without_apertures(lens), self.tolerances)
        self.errors = design(self.tolerances).to(lens.wavelengths)
        self.sampling = sampling_of(without_apertures(lens), settings.fields, settings.rings, settings.arms)
        shares = lens.wavelength_weights / lens.wavelength_weights.sum()
        self.weights = (shares[:, None] * self.sampling.weights).flatten()
        if not bool(torch.isfinite(self.expected(lens))):
            raise Unlit(f"no ray of a field reaches the sensor of a lens of the sample; give other {option('fields')}")

    def words(self) -> str:
        """The term in words."""
        return f"{len(self.tolerances)} tolerances, {self.settings.words()}"

    def about(self) -> str:
        """Everything on which the term depends besides the lens."""
        rows = [dataclasses.astuple(row) for row in (*self.tolerances, *self.tolerances.compensators)]
        numbers = [self.sampling.fields, self.sampling.field_weights, self.sampling.points, self.weights]
        return repr(
            [
                rows,
                self.tolerances.test_wavelength,
                self.settings.weight,
                self.perturbation.radii,
                [n.tolist() for n in numbers],
            ]
        )

    def expected(self, lens: Lens) -> Tensor:
        """E[q] (), mm²: differentiable in every number of the lens. nan without light."""
        return self.mean_squares(lens, self.errors).mean()

    def nominal(self, lens: Lens) -> Tensor:
        """q (), mm², of the lens without errors, refocused."""
        return self.mean_squares(lens, torch.zeros_like(self.errors[:1]))[0]

    def mean_squares(self, lens: Lens, errors: Tensor) -> Tensor:
        """q (L,), mm², of lenses with errors (L, N), refocused. nan where no ray of a field arrives."""
        rays = image_rays(self.lenses(lens, errors), self.sampling.points, fields=self.sampling.fields)
        q = self._offsets(rays.position, rays.direction, rays.valid).square().sum((0, 2, 3))
        return torch.where(rays.valid.flatten(-2).any(-1).all(-1), q, torch.nan)

    def lenses(self, lens: Lens, errors: Tensor) -> Lens:
        """Lenses with errors (L, N), without apertures."""
        return aligned(self.perturbation(errors, without_apertures(lens)), 3)

    def _offsets(self, position: Tensor, direction: Tensor, valid: Tensor) -> Tensor:
        """Offsets (2, L, F, W P) mm of rays (3, L, F, W, P) from the centroid of each spot at the best focus of each
        lens, times the root of their weight: the sums of their squares are q."""
        points, along, valid = position[:2].flatten(-2), direction.flatten(-2), valid.flatten(-2)
        fields, weights = self.sampling.field_weights, torch.where(valid, self.weights, 0.0)
        share = safe_divide(weights, weights.sum(-1, keepdim=True))
        moments = focus_moments(Rays(position.flatten(-2), along, valid), self.weights)
        covariance, variance = ((fields * part).sum(-1) for part in moments)
        shift = torch.clamp(shift_to_focus(covariance, variance), *self.limits)[:, None, None]
        moved = torch.where(valid, points + shift * safe_divide(along[:2], along[2].expand_as(along[:2])), 0.0)
        offsets = torch.where(valid, moved - (share * moved).sum(-1, keepdim=True), 0.0)
        return (fields[:, None] * share).sqrt() * offsets

    # -- residuals of least squares ------------------------------------------------------------------------------------

    def residuals(self, state: LensState, unit: float) -> tuple[np.ndarray, np.ndarray, int]:
        """Residuals (R,) of sum weight · E[q], squared, their derivatives (R, n), and the number of failed rays.

        unit: mm in the unit of length of the merit function; n: 0 of a state without derivatives.
        """
        factor = (self.settings.weight / len(self.errors)) ** 0.5 / unit
        with torch.set_grad_enabled(state.count > 0):
            rays = image_rays(
                self.lenses(state.moving_lens(), self.errors), self.sampling.points, fields=self.sampling.fields
            )
            offsets = factor * self._offsets(rays.position, rays.direction, rays.valid).reshape(-1)
        slopes = tangents_of(offsets, state.count).detach().numpy().T
        return value_of(offsets).detach().numpy(), slopes, int((~rays.valid).sum())


def _focus_limits(lens: Lens, tolerances: ToleranceTable) -> tuple[float, float]:
    """Limits in mm of the motion of the sensor, 0 and 0 without a compensator. Raises BadTolerance."""
    compensators = tolerances.compensators
    if not compensators:
        return 0.0, 0.0
    if not focuses(lens, compensators) or not lens.surfaces[-1].is_plane:
        listed = ", ".join(map(str, compensators))
        raise BadTolerance(
            f"compensators: {listed}; in a merit function the lens as built is refocused by the distance of a plane "
            "sensor alone: give `tolerances` with that compensator, or with none"
        )
    return compensators[0].minimum, compensators[0].maximum


# -- the sample --------------------------------------------------------------------------------------------------------


def design(tolerances: ToleranceTable) -> Tensor:
    """Errors (L, N) of the sample in the rows' units, float64."""
    mean, variance = (np.array(part) for part in zip(*map(moments, tolerances), strict=True))
    signs = hadamard(len(tolerances) + 1)[:, 1 : len(tolerances) + 1]
    errors = mean + signs * np.sqrt(variance)
    for n, row in enumerate(tolerances):
        if row.kind == "irregularity_angle" and (row.minimum, row.maximum) == (-90, 90):
            errors[:, n] = _ANGLES[0] + _ANGLES[1] * signs[:, n]
    return torch.from_numpy(errors)


def hadamard(least: int) -> np.ndarray:
    """A Hadamard matrix of the smallest order from `least` by Paley's and Sylvester's constructions, first column 1."""
    order = max(least, 1)
    while (matrix := _hadamard(order)) is None:
        order += 1
    return matrix


def _hadamard(order: int) -> np.ndarray | None:
    """Paley's matrix of order q + 1, q a prime of the form 4k + 3; else twice that of half the order, by Sylvester."""
    if order == 1:
        return np.ones((1, 1))
    q = order - 1
    if order % 4 == 0 and all(q % k for k in range(2, int(q**0.5) + 1)):
        squares = np.zeros(q, dtype=bool)
        squares[np.arange(1, q) ** 2 % q] = True
        character = np.where(squares, 1.0, -1.0)
        character[0] = 0.0
        matrix = np.ones((order, order))
        matrix[1:, 1:] = character[(np.arange(q) - np.arange(q)[:, None]) % q] - np.eye(q)
        return matrix
    half = _hadamard(order // 2) if order % 2 == 0 else None
    return None if half is None else np.block([[half, half], [half, -half]])
