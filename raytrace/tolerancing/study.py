"""Study: a criterion of a lens as a function of errors and compensators, its best compensators, and its second order.

The criterion of a lens with errors e and compensators c is a function f(q), the root of a mean square q or what is
missing of the MTF; the lens as built has the compensators that minimise q. Of one trial they come from Newton's method
with the exact gradient and differences of gradients, all lenses of a batch at once.

Second order: with g and H the derivatives of q by the errors, H those of differences of exact gradients and with the
compensators eliminated,

    H = q_ee - q_ec q_cc⁻¹ q_ce,     E[q] = q₀ + g·m + ½ (tr(H Σ) + m·H m),

m and Σ the means and variances of the errors. The distribution of f is that of f of the same quadratic form.
Source of the expansion: Rimmer, Appl. Opt. 9, 533 (1970).
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from scipy.special import ndtr
from torch import Tensor

from raytrace.maths.numerics import safe_divide
from raytrace.maths.sampling import gauss_rings
from raytrace.system.lens import Lens, aligned, field_points
from raytrace.system.parameter_paths import modelled, number_at, parameter_paths, sensor, with_number
from raytrace.system.surface import Surface
from raytrace.system.tolerance_data import Compensator, Tolerance
from raytrace.tolerancing.criteria import Criterion, Sampling, at_best_focus
from raytrace.tolerancing.perturbation import Perturbation, path_of
from raytrace.tolerancing.sampling import density_moments, draw_errors
from raytrace.tolerancing.tolerances import BadTolerance, Tolerances

_STEP = 0.05  # of the half width of a tolerance: step of the differences of gradients
_NEWTON = 12  # steps of the compensators, at most
_SETTLED = 1e-11  # of q: the gain of the next step at which they end
_REACH, _NO_EFFECT = 1e3, 1e-9  # a compensator without effect: moved by so many steps it changes q by less, relatively
#: Lenses traced at once.
CHUNK = 1024
_MODEL = 2**13  # draws of the second-order model


class Study:
    """A lens with its tolerances, as functions of errors (L, N) and changes (L, C) of compensators.

    lens: nominal; sampling: as `Sampling`.
    """

    def __init__(self, lens: Lens, tolerances: Tolerances, criterion: Criterion, sampling: Sampling):
        self.lens, self.tolerances, self.criterion, self.sampling = lens, tolerances, criterion, sampling
        self.perturbation = Perturbation(lens, tolerances)
        self.compensators = tolerances.compensators
        for one in self.compensators:
            _check(lens, one)
        like = lens.wavelengths
        self.least = like.new_tensor([one.minimum for one in self.compensators])
        self.most = like.new_tensor([one.maximum for one in self.compensators])
        self.half = (0.5 * (tolerances.maximum - tolerances.minimum)).to(like)
        self.unsettled = 0  # lenses whose compensators still gained 1e-6 of q in the last step

    def quantity(self, errors: Tensor, changes: Tensor) -> Tensor:
        """q (L,) of lenses with errors (L, N) and compensators moved by (L, C)."""
        lens = with_changes(self.perturbation(errors), self.compensators, changes)
        return self.criterion.quantity(aligned(lens, 3), self.sampling)

    def refocused(self, errors: Tensor) -> tuple[Tensor, Tensor] | None:
        """q (L,) with the sensor at its least, and its shift (L, 1); None where no parabola has it."""
        if self.criterion.parabola is None or not focuses(self.lens, self.compensators):
            return None
        lens = self.perturbation(errors)
        if not is_plain_sensor(lens.surfaces[-1]):
            return None
        found = at_best_focus(self.criterion.parabola(aligned(lens, 3), self.sampling), self.least, self.most)
        return found[0], found[1][:, None]

    def slope(self, errors: Tensor, changes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """q (L,) and its derivatives by the errors (L, N) and the compensators (L, C)."""
        return self._slopes(errors, changes, by_errors=True)

    def slope_of_compensators(self, errors: Tensor, changes: Tensor) -> tuple[Tensor, Tensor]:
        """q (L,) and its derivatives (L, C) by the compensators."""
        q, _, by_changes = self._slopes(errors, changes, by_errors=False)
        return q, by_changes

    def _slopes(self, errors: Tensor, changes: Tensor, *, by_errors: bool) -> tuple[Tensor, Tensor, Tensor]:
        rows = []
        for e, c in zip(*(x.detach().split(self.criterion.together) for x in (errors, changes)), strict=True):
            with torch.enable_grad():
                e, c = e.requires_grad_(by_errors), c.requires_grad_()
                q = self.quantity(e, c)
                asked = [x for x in (e, c) if x.requires_grad]
                unused = [None] * len(asked)
                found = torch.autograd.grad(q.sum(), asked, allow_unused=True) if q.requires_grad else unused
            slopes = [torch.zeros_like(x) if g is None else g for g, x in zip(found, asked, strict=True)]
            rows.append((q.detach(), slopes[0] if by_errors else torch.zeros_like(e), slopes[-1]))
        return tuple(torch.cat(part) for part in zip(*rows, strict=True))

    def compensated(self, errors: Tensor) -> tuple[Tensor, Tensor]:
        """q (L,) with the compensators that minimise it, and their changes (L, C).

        Newton's method with the curvature of the nominal lens, scaled for each lens by the last two slopes. A step that
        does not improve q is shortened.
        """
        at = errors.new_zeros(len(errors), len(self.compensators))
        if not self.compensators:
            with torch.no_grad():
                parts = errors.split(self.criterion.together)
                return torch.cat([self.quantity(part, at[: len(part)]) for part in parts]), at
        with torch.no_grad():
            if (found := self.refocused(errors)) is not None:
                return found
        curvature, trial, count = self.nominal_curvature(), at, len(errors)
        q, slopes, gain = errors.new_full((count,), torch.inf), torch.zeros_like(at), torch.zeros(count).to(errors)
        scale, least, moving = errors.new_ones(count, 1), 1e-6 * self.criterion.scale, torch.arange(count)
        for step in range(_NEWTON + 1):
            q_trial, slopes_trial = self.slope_of_compensators(errors[moving], trial)
            better, start, before = ~(q_trial > q[moving]), at[moving], slopes[moving]
            if step:
                moved = trial - start
                expected = ((moved @ curvature) * moved).sum(-1)
                ratio = ((slopes_trial - before) * moved).sum(-1) / expected
                secant = torch.where((expected > 0) & (ratio > 0), ratio, 1.0).clamp(0.2, 25.0)
                scale[moving] = torch.where(better, secant, torch.maximum(secant, 4 * scale[moving, 0]))[:, None]
            q[moving] = torch.where(better, q_trial, q[moving])
            at[moving] = start = torch.where(better[:, None], trial, start)
            slopes[moving] = before = torch.where(better[:, None], slopes_trial, before)
            full = torch.linalg.solve(curvature, before[..., None])[..., 0] * self.acting
            trial = torch.clamp(start - full / scale[moving], self.least, self.most)
            gain[moving] = (0.5 * (before * (start - trial)).sum(-1)).abs()
            going = gain[moving] > _SETTLED * (q[moving] + least)
            moving, trial = moving[going], trial[going]
            if not len(moving):
                break
        self.unsettled += int((gain > 1e-6 * (q + least)).sum())
        return q, at

    def harm(self, errors: Tensor) -> Tensor:
        """How much worse the criterion (L,) of compensated lenses is than that of the nominal one."""
        zero = self.half.new_zeros(1, errors.shape[1])
        found = [self.compensated(part)[0] for part in (zero, *errors.to(self.half).split(CHUNK))]
        nominal, *others = (self.criterion.value(q) for q in found)
        return self.criterion.sign * (torch.cat(others) - nominal)

    def nominal_curvature(self) -> Tensor:
        """q_cc (C, C) of the nominal lens, by differences of gradients."""
        if not hasattr(self, "_curvature"):
            count = len(self.compensators)
            zero = self.half.new_zeros(2 * count, len(self.half))
            steps = self.scale_of_compensators()
            moved = torch.cat([torch.diag(steps), -torch.diag(steps)])
            q, slopes = self.slope_of_compensators(zero, moved)
            found = (slopes[:count] - slopes[count:]) / (2 * steps[:, None])
            found = 0.5 * (found + found.T)
            self.acting = self._acting(torch.diagonal(found), q)
            both = self.acting[:, None] & self.acting
            self._curvature = torch.where(both, found, torch.eye(count).to(found))
        return self._curvature

    def _acting(self, curvatures: Tensor, q: Tensor) -> Tensor:
        """Which compensators (C,) act on q; those without effect are refused, unless the criterion allows them.

        Refused are also those that the nominal lens is no minimum of.
        """
        effect = 0.5 * curvatures * (_REACH * self.scale_of_compensators()) ** 2
        least, name = _NO_EFFECT * (float(q.min()) + self.criterion.scale), self.criterion.name
        for one, gain in zip(self.compensators, effect.tolist(), strict=True):
            if abs(gain) <= least and not self.criterion.allows_idle:
                what = f"it does not improve the criterion: it has no effect on the {name}"
                raise BadTolerance(f"compensator {one}: {what}; leave it out")
            if gain < -least:
                what = f"the {name} has no optimum near the nominal lens"
                raise BadTolerance(f"compensator {one}: {what}; focus the lens first (rt.focus), or optimise it")
        return effect.abs() > least

    def scale_of_compensators(self) -> Tensor:
        """Steps (C,) of the differences by the compensators."""
        steps = [1e-3 if one.parameter == "thickness" else 1e-6 for one in self.compensators]
        return self.half.new_tensor(steps)

    def second_order(self) -> tuple[float, Tensor, Tensor]:
        """q₀, g (N,) and H (N, N) of the compensated q by errors, of the nominal lens with its best compensators."""
        count, others = len(self.half), len(self.compensators)
        _, best = self.compensated(self.half.new_zeros(1, count))
        steps = torch.cat([_STEP * self.half, self.scale_of_compensators()])
        places = torch.diag(steps)
        moved = torch.cat([places, -places, torch.zeros_like(places[:1])])
        moved[:, count:] += best
        q, *both = self.slope(moved[:, :count], moved[:, count:])
        ahead, behind, (slope,) = torch.cat(both, -1).split((len(steps), len(steps), 1))
        whole = (ahead - behind) / (2 * steps[:, None])
        whole = 0.5 * (whole + whole.T)
        H = whole[:count, :count]
        if others:
            self.nominal_curvature()
        if others and bool(self.acting.any()):
            acting = whole[:, count:][:, self.acting]
            mixed = acting[:count]
            H = H - mixed @ torch.linalg.solve(acting[count:][self.acting], mixed.T)
        return float(q[-1]), slope[:count], H


def focuses(lens: Lens, compensators: Sequence[Compensator]) -> bool:
    """Whether the distance of the sensor is all that is adjusted, and the beams do not depend on it."""
    of_sensor = [(one.surface, one.parameter) for one in compensators] == [(sensor(lens), "thickness")]
    return of_sensor and lens.fields.kind != "real_image_height"


def is_plain_sensor(surface: Surface) -> bool:
    """Whether the image surface is a plane across the axis that clips no ray."""
    return surface.is_plane and surface.before is None and not surface.apertures


def with_changes(lens: Lens, compensators: Sequence[Compensator], changes: Tensor) -> Lens:
    """The lens with compensators moved by (C,), or L lenses with those moved by (L, C)."""
    surfaces = list(lens.surfaces)
    for one, change in zip(compensators, changes.unbind(-1), strict=True):
        change = change.reshape(-1, 1, 1, 1) if change.dim() else change
        surface = modelled(surfaces[one.surface], one.parameter)
        path = path_of(surface, one.parameter)
        surfaces[one.surface] = with_number(surface, path, number_at(surface, path) + change)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def _check(lens: Lens, one: Compensator) -> None:
    if one.operand is not None:
        raise BadTolerance(f"compensator {one}: operands of configurations are not adjusted; tolerance a configuration")
    if not 0 <= one.surface < len(lens.surfaces) - 1:
        raise BadTolerance(f"compensator {one}: this lens has surfaces 0 to {len(lens.surfaces) - 2}")
    surface = lens.surfaces[one.surface]
    if path_of(surface, one.parameter) is None:
        known = ", ".join(["thickness", *parameter_paths(modelled(surface, one.parameter))])
        raise BadTolerance(f"compensator {one}: the surface does not have it; expected {known}")


def moments(row: Tolerance) -> tuple[float, float]:
    """Mean and variance of the error of a row; those of a group have no direction."""
    mean, variance = _moments(row)
    return (0.0, mean**2 + variance) if row.group else (mean, variance)


def _moments(row: Tolerance) -> tuple[float, float]:
    if row.distribution == "table":
        mean, variance, width = *density_moments(row.density), row.maximum - row.minimum
        return row.minimum + width * mean, width**2 * variance
    middle, half = 0.5 * (row.minimum + row.maximum), 0.5 * (row.maximum - row.minimum)
    if row.distribution == "normal":
        s = row.sigmas
        density = math.exp(-0.5 * s * s) / math.sqrt(2 * math.pi)
        return middle, (half / s) ** 2 * (1 - 2 * s * density / (2 * float(ndtr(s)) - 1))
    return middle, half * half * {"uniform": 1 / 3, "parabolic": 3 / 5, "end_points": 1.0}[row.distribution]


def sampling_of(lens: Lens, fields, rings: int, arms: int) -> Sampling:
    like = {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}
    points = field_points(fields, like=lens)
    weights = lens.fields.weight if fields is None else torch.ones_like(points[0])
    if fields is None:
        mirrored = points * points.new_tensor([[1.0], [-1.0]])
        new = [k for k in range(points.shape[1]) if not bool((points == mirrored[:, k, None]).all(0).any())]
        points, weights = torch.cat([points, mirrored[:, new]], 1), torch.cat([weights, weights[new]])
    return Sampling(points, weights / weights.sum(), *gauss_rings(rings, arms, **like))


def second_order_draws(
    tolerances: Tolerances, criterion: Criterion, q0: float, g: Tensor, H: Tensor, seed: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Draws (K,) of the criterion by second order, its mean (), and the exact mean of q ().

    The mean of q, which is known, is a control variate of that of the criterion.
    """
    mean, variance = (g.new_tensor(part) for part in zip(*map(moments, tolerances), strict=True))
    errors = draw_errors(tolerances, _MODEL, seed + 1).to(g)
    drawn = q0 + errors @ g + 0.5 * ((errors @ H) * errors).sum(-1)
    exact = q0 + g @ mean + 0.5 * (torch.diagonal(H) @ variance + mean @ H @ mean)
    found = criterion.value(drawn.clamp_min(0))
    off = drawn - drawn.mean()
    return found, found.mean() - safe_divide((off * found).sum(), (off * off).sum()) * (drawn.mean() - exact), exact
