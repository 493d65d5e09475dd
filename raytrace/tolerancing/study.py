"""Study: a criterion of a lens as a function of errors and compensators, its best compensators, and its second order.

The criterion of a lens with errors e and compensators c is a function f(q): of a mean square q its root, of
q = 1 - MTF the MTF. The lens as built has the compensators that minimise q. Newton's method finds them with the exact
gradient and differences of gradients, for all lenses of a batch at once.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import torch
from scipy.special import ndtr
from torch import Tensor

from raytrace.analysis.setting import scene_of
from raytrace.maths.sampling import SAMPLINGS, gauss_rings
from raytrace.system import configurations
from raytrace.system.lens import Lens, aligned, field_points, is_round_about_axis, per_lens
from raytrace.system.parameter_paths import modelled, parameter_paths, sensor
from raytrace.system.surface import Surface
from raytrace.system.tolerance_data import Compensator, Tolerance
from raytrace.tolerancing.criteria import CRITERIA, Criterion, Sampling, at_best_focus, light, size_of_image
from raytrace.tolerancing.perturbation import Perturbation, path_of, raised, with_operands
from raytrace.tolerancing.sampling import density_moments
from raytrace.tolerancing.second_order import SecondOrder
from raytrace.tolerancing.table import BadTolerance, ToleranceTable
from raytrace.tracing.clear_pupil import arms_of, is_clipped

_STEP = 0.05  # of the half width of a tolerance: step of the differences of gradients
_NEWTON = 12  # steps of the compensators, at most
_SETTLED = 1e-11  # of q: the gain of the next step at which they end
_REACH, _NO_EFFECT = 1e3, 1e-9  # a compensator without effect: moved by so many steps it changes q by less, relatively
_ALIKE = 1e-10  # smallest eigenvalue of the curvature matrix, scaled to a diagonal of 1, of compensators that differ
_RINGS, _SAME = (4, 6, 8), 1e-4  # rings of the pupil that are tried, and the accepted relative error of q
_CLIPPED = (4, 16), (6, 24), (8, 32), (8, 64), (12, 96)  # rings and arms where apertures clip beams; the last are exact
#: Lenses traced at once.
CHUNK = 1024


#: Fields, as of `field_points`.
FieldPoints: TypeAlias = Tensor | Sequence | None


class View(NamedTuple):
    """A configuration of a lens with its criterion and sampling, and its share in q."""

    lens: Lens
    criterion: Criterion
    sampling: Sampling
    weight: float = 1.0


class Study:
    """A lens with its tolerances, as functions of errors (L, N) and changes (L, C) of compensators.

    views: its configurations, judged together: q is their mean by weight. loss: share of the light of the nominal lens,
    in any of them, that a lens may lose; one that loses more has no criterion, q is nan.
    """

    def __init__(self, views: Sequence[View], tolerances: ToleranceTable, loss: float):
        self.views, self.tolerances, self.loss = views, tolerances, loss
        self.lens, self.criterion, self.sampling, _ = views[0]
        self.perturbations = [Perturbation(view.lens, tolerances) for view in views]
        self.compensators = tolerances.compensators
        for compensator in self.compensators:
            _check(self.lens, compensator)
        like = self.lens.wavelengths
        self.weights = like.new_tensor([[view.weight] for view in views])
        self.least = like.new_tensor([compensator.minimum for compensator in self.compensators])
        self.most = like.new_tensor([compensator.maximum for compensator in self.compensators])
        self.half = (0.5 * (tolerances.maximum - tolerances.minimum)).to(like)
        self.unsettled = 0  # lenses whose compensators still gained 1e-6 of q in the last step
        with torch.no_grad():
            zero = self.half.new_zeros(1, len(self.half))
            self.nominal_light = self._of_views(light, zero, zero.new_zeros(1, len(self.compensators)))

    def _of_views(self, judge: Callable[[Lens, Sampling], Tensor] | None, errors: Tensor, changes: Tensor) -> Tensor:
        """A number (V, L) of every configuration of lenses with errors (L, N) and compensators moved by (L, C).

        judge: the number, by default the quantity of the criterion.
        """
        values = []
        for view, perturbation in zip(self.views, self.perturbations, strict=True):
            lens = aligned(with_changes(perturbation(errors), self.compensators, changes), 3)
            number = view.criterion.quantity if judge is None else judge
            values.append(number(lens, view.sampling).expand(len(errors)))
        return torch.stack(values)

    def quantity(self, errors: Tensor, changes: Tensor) -> Tensor:
        """q (L,) of lenses with errors (L, N) and compensators moved by (L, C)."""
        return (self.weights * self._of_views(None, errors, changes)).sum(0)

    def light(self, errors: Tensor, changes: Tensor) -> Tensor:
        """Share (L,) of the light of the nominal lens that arrives, of the configuration that loses most."""
        return (self._of_views(light, errors, changes) / self.nominal_light).amin(0).clamp_max(1.0)

    def refocused(self, errors: Tensor) -> tuple[Tensor, Tensor] | None:
        """q (L,) with the sensor at its least, and its shift (L, 1); None where no parabola has it."""
        parts = []
        for (lens, criterion, sampling, _), perturbation in zip(self.views, self.perturbations, strict=True):
            if criterion.parabola is None or not focuses(lens, self.compensators):
                return None
            lenses = perturbation(errors)
            if not is_plain_sensor(lenses.surfaces[-1]):
                return None
            parts.append([part.expand(len(errors)) for part in criterion.parabola(aligned(lenses, 3), sampling)])
        parabola = ((self.weights * torch.stack(part)).sum(0) for part in zip(*parts, strict=True))
        q, shift = at_best_focus(tuple(parabola), self.least, self.most)
        return q, shift[:, None]

    def slope(self, errors: Tensor, changes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """q (L,) and its derivatives by the errors (L, N) and the compensators (L, C)."""
        return self._slopes(errors, changes, by_errors=True)

    def _slopes(self, errors: Tensor, changes: Tensor, *, by_errors: bool) -> tuple[Tensor, Tensor, Tensor]:
        rows = []
        for e, c in zip(*(x.detach().split(self.criterion.together) for x in (errors, changes)), strict=True):
            with torch.enable_grad():
                e, c = e.requires_grad_(by_errors), c.requires_grad_()
                q = self.quantity(e, c)
                asked = [x for x in (e, c) if x.requires_grad]
                unused = [None] * len(asked)
                gradients = torch.autograd.grad(q.sum(), asked, allow_unused=True) if q.requires_grad else unused
            slopes = [torch.zeros_like(x) if g is None else g for g, x in zip(gradients, asked, strict=True)]
            rows.append((q.detach(), slopes[0] if by_errors else torch.zeros_like(e), slopes[-1]))
        q, by_e, by_c = map(torch.cat, zip(*rows, strict=True))
        return q, by_e, by_c

    def compensated(self, errors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """q (L,) with the compensators that minimise it, their changes (L, C), and the share of the nominal light (L,).

        Newton's method with the curvature of the nominal lens, scaled for each lens by the last two slopes. A step that
        does not improve q is shortened. q is nan for a lens that loses more light than `loss`.
        """
        parts = []
        with torch.no_grad():
            for some in errors.split(CHUNK):
                q, changes = self._compensated(some)
                changes = changes.nan_to_num(0.0)  # of a lens with a field without light
                kept = self.light(some, changes)
                parts.append((torch.where(1 - kept > self.loss, torch.nan, q), changes, kept))
        q, changes, kept = map(torch.cat, zip(*parts, strict=True))
        return q, changes, kept

    def _compensated(self, errors: Tensor) -> tuple[Tensor, Tensor]:
        changes = errors.new_zeros(len(errors), len(self.compensators))
        if not self.compensators:
            parts = errors.split(self.criterion.together)
            return torch.cat([self.quantity(part, changes[: len(part)]) for part in parts]), changes
        if (refocused := self.refocused(errors)) is not None:
            return refocused
        curvature, trial, count = self.nominal_curvature(), changes, len(errors)
        q, slopes, gain = errors.new_full((count,), torch.inf), torch.zeros_like(changes), torch.zeros(count).to(errors)
        scale, least, moving = errors.new_ones(count, 1), 1e-6 * self.criterion.scale, torch.arange(count)
        for step in range(_NEWTON + 1):
            q_trial, _, slopes_trial = self._slopes(errors[moving], trial, by_errors=False)
            better, start, before = ~(q_trial > q[moving]), changes[moving], slopes[moving]
            if step:
                moved = trial - start
                expected = ((moved @ curvature) * moved).sum(-1)
                ratio = ((slopes_trial - before) * moved).sum(-1) / expected
                secant = torch.where((expected > 0) & (ratio > 0), ratio, 1.0).clamp(0.2, 25.0)
                scale[moving] = torch.where(better, secant, torch.maximum(secant, 4 * scale[moving, 0]))[:, None]
            q[moving] = torch.where(better, q_trial, q[moving])
            changes[moving] = start = torch.where(better[:, None], trial, start)
            slopes[moving] = before = torch.where(better[:, None], slopes_trial, before)
            full = torch.linalg.solve(curvature, before[..., None])[..., 0] * self.acting
            trial = torch.clamp(start - full / scale[moving], self.least, self.most)
            gain[moving] = (0.5 * (before * (start - trial)).sum(-1)).abs()
            going = gain[moving] > _SETTLED * (q[moving] + least)
            moving, trial = moving[going], trial[going]
            if not len(moving):
                break
        self.unsettled += int((gain > 1e-6 * (q + least)).sum())
        return q, changes

    def harm(self, errors: Tensor) -> tuple[Tensor, Tensor]:
        """How much worse the criterion (L,) of compensated lenses is than that of the nominal one; their light (L,)."""
        zero = self.half.new_zeros(1, errors.shape[1])
        q, _, light = self.compensated(torch.cat([zero, errors.to(self.half)]))
        values = self.criterion.value(q)
        return self.criterion.sign * (values[1:] - values[0]), light[1:]

    def nominal_curvature(self) -> Tensor:
        """q_cc (C, C) of the nominal lens, by differences of gradients."""
        if not hasattr(self, "_curvature"):
            count = len(self.compensators)
            zero = self.half.new_zeros(2 * count, len(self.half))
            steps = self.scale_of_compensators()
            moved = torch.cat([torch.diag(steps), -torch.diag(steps)])
            q, _, slopes = self._slopes(zero, moved, by_errors=False)
            hessian = (slopes[:count] - slopes[count:]) / (2 * steps[:, None])
            hessian = 0.5 * (hessian + hessian.T)
            self.acting = self._acting(torch.diagonal(hessian), q)
            both = self.acting[:, None] & self.acting
            self._curvature = torch.where(both, hessian, torch.eye(count).to(hessian))
            root = torch.diagonal(self._curvature).sqrt()
            if float(torch.linalg.eigvalsh(self._curvature / (root[:, None] * root))[0]) < _ALIKE:
                listed = "; ".join(map(str, self.compensators))
                raise BadTolerance(f"compensators {listed}: two of them do the same to the criterion; leave one out")
        return self._curvature

    def _acting(self, curvatures: Tensor, q: Tensor) -> Tensor:
        """Which compensators (C,) act on q; those without effect are refused, unless the criterion allows them.

        Compensators by which q of the nominal lens has no minimum are refused as well.
        """
        effect = 0.5 * curvatures * (_REACH * self.scale_of_compensators()) ** 2
        least, name = _NO_EFFECT * (float(q.min()) + self.criterion.scale), self.criterion.name
        for compensator, gain in zip(self.compensators, effect.tolist(), strict=True):
            if abs(gain) <= least and not self.criterion.allows_idle:
                reason = f"it does not improve the criterion: it has no effect on the {name}"
                raise BadTolerance(f"compensator {compensator}: {reason}; leave it out")
            if gain < -least:
                reason = f"the {name} has no optimum near the nominal lens"
                raise BadTolerance(
                    f"compensator {compensator}: {reason}; focus the lens first (rt.focus), or optimise it"
                )
        return effect.abs() > least

    def scale_of_compensators(self) -> Tensor:
        """Steps (C,) of the differences by the compensators."""
        names = [
            compensator.parameter
            if compensator.operand is None
            else self.lens.operands[compensator.operand].paths[0].path[-1]
            for compensator in self.compensators
        ]
        return self.half.new_tensor([1e-3 if name == "thickness" else 1e-6 for name in names])

    def second_order(self) -> SecondOrder:
        """The second order of q, of the nominal lens with its best compensators."""
        count = len(self.half)
        _, best, _ = self.compensated(self.half.new_zeros(1, count))
        steps = torch.cat([_STEP * self.half, self.scale_of_compensators()])
        places = torch.diag(steps)
        moved = torch.cat([places, -places, torch.zeros_like(places[:1])])
        moved[:, count:] += best
        q, *both = self.slope(moved[:, :count], moved[:, count:])
        ahead, behind, (slope,) = torch.cat(both, -1).split((len(steps), len(steps), 1))
        whole = (ahead - behind) / (2 * steps[:, None])
        whole = 0.5 * (whole + whole.T)
        acting = torch.arange(count, len(steps))
        if self.compensators:
            self.nominal_curvature()
            acting = acting[self.acting]
        mixed, curvature = whole[:count, acting], whole[acting][:, acting]
        response = -torch.linalg.solve(curvature, mixed.T).T
        start = -torch.linalg.solve(curvature, slope[acting])
        least, most = ((limit - best[0])[acting - count] for limit in (self.least, self.most))
        return SecondOrder(
            q[-1] + 0.5 * start @ slope[acting], slope[:count] + mixed @ start,
            whole[:count, :count] + mixed @ response.T, start, response, curvature, least, most,
        )  # fmt: skip


def focuses(lens: Lens, compensators: Sequence[Compensator]) -> bool:
    """Whether the sensor distance is the only compensator, and the beams do not depend on it."""
    adjusted = [(compensator.surface, compensator.parameter, compensator.operand) for compensator in compensators]
    of_sensor = adjusted == [(sensor(lens), "thickness", None)]
    return of_sensor and lens.fields.kind != "real_image_height"


def is_plain_sensor(surface: Surface) -> bool:
    """Whether the image surface is a plane across the axis that clips no ray."""
    return surface.is_plane and surface.before is None and not surface.apertures


def with_changes(lens: Lens, compensators: Sequence[Compensator], changes: Tensor) -> Lens:
    """The lens with compensators moved by (C,), or L lenses with those moved by (L, C)."""
    pairs = [*zip(compensators, map(per_lens, changes.unbind(-1)), strict=True)]
    lens = with_operands(lens, [pair for pair in pairs if pair[0].operand is not None])
    surfaces = list(lens.surfaces)
    for compensator, change in (pair for pair in pairs if pair[0].operand is None):
        surface = modelled(surfaces[compensator.surface], compensator.parameter)
        surfaces[compensator.surface] = raised(surface, compensator.parameter, change)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def _check(lens: Lens, compensator: Compensator) -> None:
    if compensator.operand is not None:
        count = configurations.count(lens.operands)
        if not 0 <= compensator.operand < len(lens.operands) or not 1 <= compensator.configuration <= count:
            known = f"{len(lens.operands)} operands in configurations 1 to {count}"
            raise BadTolerance(f"compensator {compensator}: this lens has {known}")
        if lens.operands[compensator.operand].numbers is None:
            raise BadTolerance(f"compensator {compensator}: {lens.operands[compensator.operand]} is no number")
        return
    if not 0 <= compensator.surface < len(lens.surfaces) - 1:
        raise BadTolerance(f"compensator {compensator}: this lens has surfaces 0 to {len(lens.surfaces) - 2}")
    surface = lens.surfaces[compensator.surface]
    if path_of(surface, compensator.parameter) is None:
        known = ", ".join(["thickness", *parameter_paths(modelled(surface, compensator.parameter))])
        raise BadTolerance(f"compensator {compensator}: the surface does not have it; expected {known}")


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
    shares = {"uniform": 1 / 3, "disc": 1 / 2, "parabolic": 3 / 5, "end_points": 1.0}
    return middle, half * half * shares[row.distribution]


def views_of(
    lens: Lens,
    criterion: Callable[[Lens, Sampling], Criterion],
    fields: FieldPoints,
    rings: int | None,
    arms: int | None,
) -> list[View]:
    """The configurations of a lens that have a weight with their criteria, made of each and of its sampling."""
    views, weights = [], configurations.weights(lens.operands)
    for each, weight in zip(lens.configurations if len(weights) > 1 else [lens], weights, strict=True):
        if weight > 0:
            sampling = sampling_of(each, fields, rings, arms)
            views.append(View(each, criterion(each, sampling), sampling, weight))
    return views


def sampling_of(lens: Lens, fields: FieldPoints = None, rings: int | None = None, arms: int | None = None) -> Sampling:
    """Fields and pupil points of a lens and of lenses near it.

    fields: by default those of the lens with their weights; as errors are not symmetric, a lens that is round about its
    axis has each also mirrored along y, and the two share its weight. rings, arms: of `gauss_rings`, or of the clear
    pupil (`tracing.clear_pupil`) of each lens near a nominal one that clips rays; by default the fewest that give the
    mean square spot radius of `spot` to _SAME, and where rays are clipped the wavefront's variance, too.
    """
    points = field_points(fields, like=lens)
    weights = lens.fields.weight if fields is None else torch.ones_like(points[0])
    if fields is None and is_round_about_axis(lens):
        mirrored = points * points.new_tensor([[1.0], [-1.0]])
        new = [k for k in range(points.shape[1]) if not bool((points == mirrored[:, k, None]).all(0).any())]
        share = weights.clone()
        share[new] = 0.5 * weights[new]
        points, weights = torch.cat([points, mirrored[:, new]], 1), torch.cat([share, share[new]])
    weights = weights / weights.sum()

    finest = SAMPLINGS["gauss"][2]
    view = scene_of(lens, points)

    def gauss(rings: int, arms: int | None) -> tuple[Tensor, Tensor]:
        return gauss_rings(rings, arms, dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)

    clips = is_clipped(view, gauss(finest if rings is None else rings, arms)[0])

    def rule(rings: int, arms: int | None) -> Sampling:
        clear = arms_of(view, arms or 4 * rings) if clips else None
        pupil, shares = gauss(rings, arms) if clear is None else clear.rule(rings)
        return Sampling(points, weights, pupil, shares, rings, clear)

    with torch.no_grad():
        if rings is not None:
            return rule(rings, arms)
        judges = [size_of_image(lens)]
        judges += [CRITERIA["wavefront"]] if clips and not lens.afocal else []
        *tried, last = _CLIPPED if clips else [(rings, None) for rings in (*_RINGS, finest)]
        best = rule(*last)
        squares = [judge.quantity(lens, best) for judge in judges]
        for rings, usual in tried:
            fewer = rule(rings, arms or usual)
            pairs = zip(judges, squares, strict=True)
            if all(bool((judge.quantity(lens, fewer) - q).abs() <= _SAME * q) for judge, q in pairs):
                return fewer
    return best
