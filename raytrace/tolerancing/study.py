"""Tolerancing: sensitivities, the expectation of the lens as built, and its distribution by Monte Carlo.

The criterion f of a lens with errors e and compensators c is √q, the root of a mean square; the lens as built has the
compensators that minimise it. Of one trial they come from Newton's method with the exact gradient
and differences of gradients, all lenses of a batch at once.

Second order: with g and H the derivatives of q by the errors, H those of differences of exact gradients and with the
compensators eliminated,

    H = q_ee - q_ec q_cc⁻¹ q_ce,     E[q] = q₀ + g·m + ½ (tr(H Σ) + m·H m),

m and Σ the means and variances of the errors. The distribution of f is that of the root of the same quadratic form.
Source of the expansion: Rimmer, Appl. Opt. 9, 533 (1970).
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from scipy.special import ndtr
from torch import Tensor

from raytrace.io import write_lens
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Result, Table
from raytrace.maths.sampling import gauss_rings
from raytrace.plotting.style import GREY, INK, new_figure, styled
from raytrace.shards import Share, total
from raytrace.stores import Kind, Records, listed, number, record, whole
from raytrace.system.identity import digest, identity
from raytrace.system.lens import Lens, aligned, field_points
from raytrace.system.parameter_paths import modelled, number_at, parameter_paths, sensor, with_number
from raytrace.system.surface import Surface
from raytrace.system.tolerance_data import Compensator, Tolerance
from raytrace.tolerancing.criteria import CRITERIA, Criterion, Sampling, at_best_focus
from raytrace.tolerancing.grades import tolerances as tolerances_of_grade
from raytrace.tolerancing.perturbation import Perturbation, path_of
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.tightening import limited_to_change, limited_to_yield
from raytrace.tolerancing.tolerances import BadTolerance, Tolerances

_STEP = 0.05  # of the half width of a tolerance: step of the differences of gradients
_NEWTON = 12  # steps of the compensators, at most
_SETTLED = 1e-11  # of q: the gain of the next step at which they end
_CHUNK = 512  # lenses traced at once
_MODEL = 2**15  # draws of the second-order model
#: Percentages of the table of percentiles.
PERCENTILES = (98, 90, 80, 50, 20, 10, 2)


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

    def square(self, errors: Tensor, changes: Tensor) -> Tensor:
        """q (L,) of lenses with errors (L, N) and compensators moved by (L, C)."""
        lens = with_changes(self.perturbation(errors), self.compensators, changes)
        return self.criterion.square(aligned(lens, 3), self.sampling)

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
        with torch.enable_grad():
            errors, changes = (x.detach().requires_grad_() for x in (errors, changes))
            q = self.square(errors, changes)
            found = torch.autograd.grad(q.sum(), (errors, changes), allow_unused=True)
        by_errors, by_changes = (
            torch.zeros_like(x) if g is None else g for g, x in zip(found, (errors, changes), strict=True)
        )
        return q.detach(), by_errors, by_changes

    def slope_of_compensators(self, errors: Tensor, changes: Tensor) -> Tensor:
        """Derivatives (L, C) of q by the compensators."""
        with torch.enable_grad():
            changes = changes.detach().requires_grad_()
            q = self.square(errors, changes)
            found = torch.autograd.grad(q.sum(), changes, allow_unused=True)[0] if q.requires_grad else None
            return torch.zeros_like(changes) if found is None else found

    def compensated(self, errors: Tensor) -> tuple[Tensor, Tensor]:
        """q (L,) with the compensators that minimise it, and their changes (L, C)."""
        changes = errors.new_zeros(len(errors), len(self.compensators))
        if not self.compensators:
            with torch.no_grad():
                return self.square(errors, changes), changes
        with torch.no_grad():
            if (found := self.refocused(errors)) is not None:
                return found
        curvature = self.nominal_curvature()
        for _ in range(_NEWTON):
            slopes = self.slope_of_compensators(errors, changes)
            step = torch.linalg.solve(curvature, slopes[..., None])[..., 0]
            moved = torch.clamp(changes - step, self.least, self.most)
            gain, changes = (0.5 * (slopes * (changes - moved)).sum(-1)).abs(), moved
            with torch.no_grad():
                q = self.square(errors, changes)
            if not bool((gain > _SETTLED * q).any()):
                break
        self.unsettled += int((gain > 1e-6 * q).sum())
        return q, changes

    def harm(self, errors: Tensor) -> Tensor:
        """How much worse the criterion (L,) of compensated lenses is than that of the nominal one."""
        zero = self.half.new_zeros(1, errors.shape[1])
        found = [self.compensated(part)[0] for part in (zero, *errors.to(self.half).split(_CHUNK))]
        nominal, *others = (q.sqrt() for q in found)
        return torch.cat(others) - nominal

    def nominal_curvature(self) -> Tensor:
        """q_cc (C, C) of the nominal lens, by differences of gradients."""
        if not hasattr(self, "_curvature"):
            count = len(self.compensators)
            zero = self.half.new_zeros(2 * count, len(self.half))
            steps = self.scale_of_compensators()
            moved = torch.cat([torch.diag(steps), -torch.diag(steps)])
            slopes = self.slope_of_compensators(zero, moved)
            found = (slopes[:count] - slopes[count:]) / (2 * steps[:, None])
            self._curvature = 0.5 * (found + found.T)
            dead = torch.diagonal(self._curvature) <= 0
            if bool(dead.any()):
                one = self.compensators[int(dead.int().argmax())]
                raise BadTolerance(f"compensator {one}: it does not improve the criterion; leave it out")
        return self._curvature

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
        moved = torch.cat([places, -places])
        moved[:, count:] += best
        slopes = [self.slope(part[:, :count], part[:, count:]) for part in moved.split(_CHUNK)]
        both = torch.cat([torch.cat(found[1:], -1) for found in slopes])
        whole = (both[: count + others] - both[count + others :]) / (2 * steps[:, None])
        whole = 0.5 * (whole + whole.T)
        q, slope, _ = self.slope(self.half.new_zeros(1, count), best)
        H = whole[:count, :count]
        if others:
            mixed = whole[:count, count:]
            H = H - mixed @ torch.linalg.solve(whole[count:, count:], mixed.T)
        return float(q), slope[0], H


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
    """Mean and variance of the error of a row."""
    middle, half = 0.5 * (row.minimum + row.maximum), 0.5 * (row.maximum - row.minimum)
    if row.distribution == "normal":
        s = row.sigmas
        density = math.exp(-0.5 * s * s) / math.sqrt(2 * math.pi)
        return middle, (half / s) ** 2 * (1 - 2 * s * density / (2 * float(ndtr(s)) - 1))
    return middle, half * half * {"uniform": 1 / 3, "parabolic": 3 / 5, "end_points": 1.0}[row.distribution]


@value
class Toleranced(Result):
    """The lens as built.

    nominal: () of the criterion, of the nominal lens with its compensators at their best. minimum, maximum: (N,) change
    of the criterion by each tolerance at its limits, compensated; second_minimum, second_maximum: (N,) the same by
    second order; slope: (N,) its derivative times the half width.
    estimated: () nominal + √Σ ½(Δmin² + Δmax²), as OpticStudio. expected: () the mean of the criterion by second order;
    expected_square: () that of its square. predicted: (K,) draws of the second-order model. trials: (T,) the criterion
    of the perturbed and compensated lenses, nan where no ray arrives; changes: (T, C) of the compensators.
    unsettled: how many lenses traced now had compensators that still gained 1e-6 of the mean square in the last step.
    goal: of the criterion, if one was requested; share: of lenses, whose criterion is listed; given: the tolerances
    before their limits were tightened, or None.
    """

    lens: Lens
    tolerances: object
    criterion: str
    unit: str
    nominal: Tensor
    minimum: Tensor
    maximum: Tensor
    second_minimum: Tensor
    second_maximum: Tensor
    slope: Tensor
    estimated: Tensor
    expected: Tensor
    expected_square: Tensor
    predicted: Tensor
    trials: Tensor
    changes: Tensor
    seed: int = 0
    unsettled: int = 0
    goal: float | None = None
    share: float = 0.9
    given: object = None

    COLUMNS = property(
        lambda self: (
            Column("tolerance", form="<"),
            Column("minimum", form=".5g"),
            Column("maximum", form=".5g"),
            Column("change_minimum", self.unit, ".5f", "change\nat min."),
            Column("change_maximum", self.unit, ".5f", "change\nat max."),
            Column("second_minimum", self.unit, ".5f", "2nd order\nat min."),
            Column("second_maximum", self.unit, ".5f", "2nd order\nat max."),
            Column("slope", self.unit, ".5f", "slope ×\nhalf width"),
        )
    )

    @property
    def worst(self) -> Tensor:
        """(N,) places of the tolerances, the largest change first."""
        return torch.argsort(torch.maximum(self.minimum, self.maximum), descending=True)

    def percentile(self, percent: float) -> Tensor:
        """The criterion that so many percent of the trials are below; failed trials are above all."""
        return torch.quantile(torch.nan_to_num(self.trials, nan=torch.inf), percent / 100, interpolation="higher")

    def yield_at(self, most: float) -> float:
        """Share of the trials whose criterion is at most a number."""
        return float((self.trials <= most).double().mean())

    def table_of_shares(self) -> dict[str, Tensor]:
        """The criterion that shares of the trials are below, the same by second order, and the difference."""
        shares = sorted({*PERCENTILES, 100 * self.share})
        traced = torch.stack([self.percentile(p) for p in shares])
        predicted = torch.quantile(self.predicted, traced.new_tensor(shares) / 100)
        off = 100 * (predicted / traced - 1)
        return {"share": traced.new_tensor(shares), "trials": traced, "predicted": predicted, "difference": off}

    def tightened(self) -> list[tuple[str, float]]:
        """The tolerances whose limits were tightened, with the factor, the most tightened first."""
        if self.given is None:
            return []
        pairs = zip(self.tolerances, self.given, self.tolerances.labels, strict=True)
        found = [(label, _factor(new, old)) for new, old, label in pairs]
        return sorted((pair for pair in found if pair[1] < 1), key=lambda pair: pair[1])

    def at_limit(self, number: int) -> int:
        """How many trials have a compensator, by its number from 0, at one of its limits."""
        one, moved = self.tolerances.compensators[number], self.changes[:, number]
        return int(((moved <= one.minimum) | (moved >= one.maximum)).sum())

    def trial(self, number: int) -> Lens:
        """The lens of a trial, by its number from 0: perturbed, its compensators moved; a note has its criterion.

        Its numbers are those that were fabricated: it has no variables, solves and tolerances. Raises ValueError for a
        trial that was not traced.
        """
        if not 0 <= number < len(self.trials):
            raise ValueError(f"trial {number}: expected 0 to {len(self.trials) - 1}, as {len(self.trials)} were traced")
        errors = draw_errors(self.tolerances, 1, self.seed, first=number)[0]
        lens = Perturbation(self.lens, self.tolerances)(errors)
        lens = with_changes(lens, self.tolerances.compensators, self.changes[number])
        figure = float(self.trials[number])
        stated = "no light" if math.isnan(figure) else f"{self.criterion} {figure:.6g} {self.unit}"
        data = lens.optimization_data
        data = data and dataclasses.replace(data, variables=(), solves=(), kept=(), tolerances=())
        notes = (*lens.notes, f"As built: trial {number} of seed {self.seed}, {stated}")
        return dataclasses.replace(lens, notes=notes, optimization_data=data)

    @property
    def typical(self) -> int:
        """The number of the trial nearest to the median of those that light arrives in."""
        good = self._arrived()
        return int((good - good[good.isfinite()].median()).abs().nan_to_num(torch.inf).argmin())

    @property
    def worst_trial(self) -> int:
        """The number of the trial with the largest criterion of those that light arrives in."""
        return int(self._arrived().nan_to_num(-torch.inf).argmax())

    @property
    def best_trial(self) -> int:
        """The number of the trial with the smallest criterion."""
        return int(self._arrived().nan_to_num(torch.inf).argmin())

    def _arrived(self) -> Tensor:
        """The trials. Raises ValueError where light arrives in none."""
        if not bool(self.trials.isfinite().any()):
            reason = "no light arrives in any trial" if len(self.trials) else "no trials; give `trials` above 0"
            raise ValueError(f"no typical trial and no worst one: {reason}")
        return self.trials

    def save_trials(self, folder: str | PathLike, *, catalogs: Sequence[str | Path] = ()) -> None:
        """Write the lenses of three trials: typical.zmx, worst.zmx and best.zmx, which replace those of another study.

        Glasses with index errors are in catalogs beside them, as worst-melts.agf. The folder is made. catalogs: the
        glass catalogs (.agf) that the lens was read with. Raises ValueError without trials, LensFileError for a lens
        that a .zmx file cannot hold.
        """
        lenses = [self.trial(k) for k in (self.typical, self.worst_trial, self.best_trial)]
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name, lens in zip(("typical", "worst", "best"), lenses, strict=True):
            write_lens(lens, folder / f"{name}.zmx", catalogs=catalogs)

    def columns(self) -> dict[str, Tensor]:
        order = self.worst
        return {
            "tolerance": order,
            "minimum": self.tolerances.minimum[order],
            "maximum": self.tolerances.maximum[order],
            "unit": order,
            "change_minimum": self.minimum[order],
            "change_maximum": self.maximum[order],
            "second_minimum": self.second_minimum[order],
            "second_maximum": self.second_maximum[order],
            "slope": self.slope[order],
        }

    def words(self) -> dict[str, Sequence[str]]:
        return {"tolerance": self.tolerances.labels, "unit": [row.unit for row in self.tolerances]}

    def summary(self) -> dict[str, float]:
        """Figures of the lens as built, in the unit of the criterion."""
        found = {
            "nominal": float(self.nominal),
            "estimated": float(self.estimated),
            "expected": float(self.expected),
            "expected_root_mean_square": math.sqrt(float(self.expected_square)),
        }
        if len(self.trials):
            good = self.trials[~self.trials.isnan()]
            found |= {"mean": float(good.mean()), "sigma": float(good.std()), "best": float(good.min())}
            found |= {"worst": float(good.max()), "failed": int(self.trials.isnan().sum())}
            found |= {f"percent_{p}": float(self.percentile(p)) for p in PERCENTILES}
        if self.goal is not None:
            found |= {"goal": self.goal, "yield_by_second_order": float((self.predicted <= self.goal).double().mean())}
            if len(self.trials):
                found["yield"] = self.yield_at(self.goal)
        return found

    def tables(self) -> list[Table]:
        found = self.summary()
        about = [f"{self.criterion}, {self.unit}: nominal {found['nominal']:.6g}"]
        about.append(
            f"as built, expected by second order: mean {found['expected']:.6g}, root mean square "
            f"{found['expected_root_mean_square']:.6g}; estimated by RSS {found['estimated']:.6g}"
        )
        if len(self.trials):
            about.append(
                f"{len(self.trials):,} trials (seed {self.seed}): mean {found['mean']:.6g}, σ {found['sigma']:.4g}, "
                f"best {found['best']:.6g}, worst {found['worst']:.6g}"
                + f"; {found['failed']} without light"
                * (found["failed"] > 0)
            )
            for k, one in enumerate(self.tolerances.compensators):
                c = self.changes[:, k]
                about.append(
                    f"compensator {one}: {float(c.min()):.4g} to {float(c.max()):.4g}, mean {float(c.mean()):.4g}, "
                    f"σ {float(c.std()):.4g}"
                    + (f"; at a limit in {at_limit}" if (at_limit := self.at_limit(k)) else "")
                )
        if self.goal is not None:
            traced = f", {100 * found['yield']:.4g} % of the trials" if len(self.trials) else ""
            share = f"{100 * found['yield_by_second_order']:.4g} % by second order"
            about.append(f"within {self.goal:g} {self.unit}: {share}{traced}")
        if self.given is not None:
            drawn = self.tightened()
            listed = ", ".join(f"{label} × {factor:.3g}" for label, factor in drawn[:6])
            about.append(
                f"limits tightened of {len(drawn)} of {len(self.tolerances)} tolerances{': ' * bool(drawn)}{listed}"
            )
        if self.unsettled:
            about.append(f"compensators of {self.unsettled} lenses had not settled when their steps ended")
        found = [Table(self.columns(), about)]
        if len(self.trials):
            found.append(
                Table(self.table_of_shares(), ["share of the trials within a limit, and the same by second order"])
            )
        return found

    def document(self) -> dict:
        return {"criterion": self.criterion, "unit": self.unit, **self.summary(), **Result.document(self)}

    @styled
    def draw(self):
        """Histogram of the trials with the expectation and the yield curve, and the tolerances that count most."""
        figure = new_figure(9.0, 4.2)
        left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
        shown = self.trials[~self.trials.isnan()] if len(self.trials) else self.predicted
        span = (float(min(shown.min(), self.nominal)), float(torch.quantile(shown, 0.998)))
        bins = np.linspace(*span, 41)
        if len(self.trials):
            left.hist(shown.numpy(), bins=bins, density=True, color="#9ecae1", label=f"{len(self.trials):,} trials")
        density, _ = np.histogram(self.predicted.numpy(), bins=bins, density=True)
        left.stairs(density, bins, color=INK, linewidth=1.2, label="second order")
        left.axvline(float(self.nominal), color=GREY, linestyle=":", label="nominal")
        left.axvline(float(self.expected), color="#d62728", label="expected")
        left.set(xlabel=f"{self.criterion}, {self.unit}", ylabel="density", xlim=span)
        curve = left.twinx()
        ordered = torch.sort(shown).values
        curve.plot(ordered.numpy(), np.linspace(0, 100, len(ordered)), color="#2ca02c", linewidth=1.2)
        curve.set(ylabel="yield, %", ylim=(0, 100))
        left.legend(fontsize=8, loc="center right")
        order = self.worst[:12].flip(0)
        labels = [self.tolerances.labels[k] for k in order.tolist()]
        right.barh(range(len(order)), self.maximum[order].numpy(), height=0.38, align="edge", label="at maximum")
        right.barh(range(len(order)), self.minimum[order].numpy(), height=-0.38, align="edge", label="at minimum")
        right.set_yticks(range(len(order)), labels, fontsize=7.5)
        right.set(xlabel=f"change of the criterion, {self.unit}")
        right.legend(fontsize=8, loc="lower right")
        return figure


def _factor(new: Tolerance, old: Tolerance) -> float:
    """How much narrower the limits of a row are."""
    wide = old.maximum - old.minimum
    return (new.maximum - new.minimum) / wide if wide else 1.0


def tolerance(
    lens: Lens,
    tolerances: Tolerances | None = None,
    *,
    grade: Literal["commercial", "precision", "high"] | None = None,
    limits: str | Sequence[str] = "",
    criterion: Literal["rms", "wavefront"] = "rms",
    trials: int = 1000,
    seed: int = 0,
    increment: float | None = None,
    goal: float | None = None,
    yield_: float | None = None,
    fields: Tensor | Sequence | None = None,
    rings: int = 4,
    arms: int = 6,
    checkpoint: str | PathLike | None = None,
    share: Share | None = None,
    progress: Callable | None = None,
) -> Toleranced:
    """The lens as built: sensitivities, expectation by second order and Monte Carlo.

    tolerances: as `tolerances` or `read_tolerances` return them; by default those of the lens's own file, or of `grade`
        and `limits`.
    grade: tolerances of published grades instead of the file's, see `tolerances`.
    limits: words and kinds with their limits ±, "radius=0.1% thickness=0.02 element_tilt=0.05"; they replace those of
        the file or the grade, and "index=0" leaves one out.
    criterion: "rms", the RMS spot radius in µm over fields and wavelengths by their weights, each field about the
        centroid of its light; "wavefront", the RMS wavefront in waves less mean and tilt. The compensators of every
        lens minimise its square.
    trials: number of perturbed and compensated lenses, 0 for none; seed: trial k of a seed is the same lens always.
    increment: inverse sensitivity: limits are tightened until no error alone, at a limit, makes the criterion worse by
        more than this, in its unit. Tighter limits stay.
    goal: what the criterion of a good lens is at most; the share of such lenses is reported.
    yield_: a share of the lenses, 0.9 by default, whose criterion is reported; with `goal`, limits are tightened at
        least total tightness until this share reaches the goal, by second order.
    fields: y, (x, y) or (2, F), alike in weight; by default the lens's own with their weights and, as errors are not
        symmetric, mirrored along y.
    rings: of the pupil, Gaussian quadrature, 4 by default.
    arms: of the pupil, 6 by default.
    checkpoint: a file (.jsonl) of finished trials, from which an interrupted study goes on.
    share: of this process (`shards.share()`), if all processes of a job call alike.
    progress: (count, unit) -> a progress bar.
    Raises BadTolerance for tolerances or compensators that the lens does not have, ValueError for unknown options.
    """
    if criterion not in CRITERIA:
        raise ValueError(f"criterion {criterion!r}: expected one of {', '.join(CRITERIA)}")
    if trials < 0:
        raise ValueError(f"trials {trials}: expected 0 or more")
    if tolerances is None:
        tolerances = tolerances_of_grade(lens, limits, grade=grade)
    elif grade or limits:
        raise ValueError("`tolerances` are given: leave `grade` and `limits` out")
    if not len(tolerances):
        raise BadTolerance("no tolerances; give rows, a `grade` or `limits`")
    if yield_ is not None and not 0 < yield_ < 1:
        raise ValueError(f"yield {yield_:g}: expected a share of the lenses between 0 and 1, as 0.9")
    chosen, sampling, given = CRITERIA[criterion], _sampling(lens, fields, rings, arms), tolerances
    study = Study(lens, tolerances, chosen, sampling)
    with torch.no_grad():
        nominal_square, _ = study.compensated(study.half.new_zeros(1, len(tolerances)))
        if not bool(nominal_square.isfinite().all()):
            raise BadTolerance("no ray of a field reaches the sensor of the nominal lens; give other `fields`")
        nominal = nominal_square[0].sqrt()
        if increment is not None:
            tolerances = limited_to_change(tolerances, study.harm, increment)
            study = Study(lens, tolerances, chosen, sampling)
        model = study.second_order()
        if goal is not None and yield_ is not None:
            tolerances = limited_to_yield(tolerances, model, goal**2, yield_, seed + 1)
            study = Study(lens, tolerances, chosen, sampling)
        low, high = _at_limits(study)
        changes = [q.sqrt() - nominal for q in (low, high)]
        seconds = [
            _second_order_change(model, limits.to(study.half)) for limits in (tolerances.minimum, tolerances.maximum)
        ]
        predicted, mean_square = _model(tolerances, *model, seed)
        predicted = predicted.clamp_min(0).sqrt()
        values, moved = _monte_carlo(study, trials, seed, checkpoint=checkpoint, share=share, progress=progress)
    rss = (0.5 * (changes[0] ** 2 + changes[1] ** 2)).sum().sqrt()
    return Toleranced(
        lens=lens, tolerances=tolerances, criterion=chosen.name, unit=chosen.unit, nominal=nominal,
        minimum=changes[0], maximum=changes[1], second_minimum=seconds[0], second_maximum=seconds[1],
        slope=model[1] * study.half / (2 * nominal), estimated=nominal + rss, expected=predicted.mean(),
        expected_square=mean_square, predicted=predicted, trials=values, changes=moved, seed=seed,
        unsettled=study.unsettled, goal=goal, share=0.9 if yield_ is None else yield_,
        given=None if tolerances is given else given,
    )  # fmt: skip


def _second_order_change(model: tuple[float, Tensor, Tensor], errors: Tensor) -> Tensor:
    """√(q₀ + g e + ½ H_ee e²) - √q₀ (N,) of errors (N,), each alone."""
    q0, g, H = model
    found = q0 + g * errors + 0.5 * torch.diagonal(H) * errors**2
    return found.clamp_min(0).sqrt() - math.sqrt(q0)


def _sampling(lens: Lens, fields, rings: int, arms: int) -> Sampling:
    like = {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}
    points = field_points(fields, like=lens)
    weights = lens.fields.weight if fields is None else torch.ones_like(points[0])
    if fields is None:
        mirrored = points * points.new_tensor([[1.0], [-1.0]])
        new = [k for k in range(points.shape[1]) if not bool((points == mirrored[:, k, None]).all(0).any())]
        points, weights = torch.cat([points, mirrored[:, new]], 1), torch.cat([weights, weights[new]])
    return Sampling(points, weights / weights.sum(), *gauss_rings(rings, arms, **like))


def _at_limits(study: Study) -> tuple[Tensor, Tensor]:
    """q (N,) of the lenses with one error at its minimum, and at its maximum, compensated."""
    low, high = study.tolerances.minimum.to(study.half), study.tolerances.maximum.to(study.half)
    errors = torch.cat([torch.diag(low), torch.diag(high)])
    found = torch.cat([study.compensated(part)[0] for part in errors.split(_CHUNK)])
    return found[: len(low)], found[len(low) :]


def _model(tolerances: Tolerances, q0: float, g: Tensor, H: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Draws (K,) of the quadratic form, and its exact mean ()."""
    mean, variance = (g.new_tensor(part) for part in zip(*map(moments, tolerances), strict=True))
    errors = draw_errors(tolerances, _MODEL, seed + 1).to(g)
    drawn = q0 + errors @ g + 0.5 * ((errors @ H) * errors).sum(-1)
    exact = q0 + g @ mean + 0.5 * (torch.diagonal(H) @ variance + mean @ H @ mean)
    return drawn, exact


_JOURNAL = Kind(
    damaged=BadTolerance,
    advice="give a new name for `checkpoint`",
    other=BadTolerance,
    refusal="{path} holds the trials of another study: {difference}; give a new name for `checkpoint`",
)
_TRIALS = record({"first": whole(), "rows": listed(listed(number(infinite=True)))})


class _Trials:
    """Finished trials in a file: rows of the criterion and the compensators, by the number of their first trial."""

    def __init__(self, path: str | PathLike, study: Study, seed: int):
        rows = [dataclasses.astuple(row) for row in (*study.tolerances, *study.compensators)]
        about = {"of": "raytrace tolerance", "lens": identity(study.lens), "criterion": study.criterion.name}
        about |= {"tolerances": digest(repr(rows), study.tolerances.test_wavelength), "seed": seed}
        about |= {"fields and pupil": digest(study.sampling)}
        self.store = Records(path, about, _JOURNAL, _TRIALS)
        self.found = {record["first"]: record["rows"] for _, record in self.store.read()}

    def put(self, first: int, rows: Tensor) -> None:
        # JSON has no nan: a trial without light is infinite
        self.store.append({"first": first, "rows": torch.nan_to_num(rows, nan=math.inf).tolist()})


def _monte_carlo(study: Study, trials: int, seed: int, *, checkpoint, share: Share | None, progress):
    """The criterion (T,) of the trials, and the changes (T, C) of their compensators."""
    count, others = len(study.tolerances), len(study.compensators)
    found = study.half.new_zeros(trials, 1 + others)
    chunks = [range(first, min(first + _CHUNK, trials)) for first in range(0, trials, _CHUNK)]
    mine = (share or Share()).of(range(len(chunks)))
    stored = _Trials(checkpoint, study, seed) if checkpoint is not None else None
    bar = progress(trials, "lens") if progress and trials else None
    for k in mine:
        part = chunks[k]
        rows = stored.found.get(part.start) if stored else None
        if rows is None or len(rows) != len(part):
            errors = draw_errors(study.tolerances, len(part), seed, first=part.start).to(study.half)
            q, changes = study.compensated(errors.reshape(len(part), count))
            rows = torch.cat([q.sqrt()[:, None], changes], -1)
            if stored:
                stored.put(part.start, rows)
        found[part.start : part.stop] = torch.as_tensor(rows, dtype=found.dtype)
        if bar is not None:
            bar.update(len(part))
    if bar is not None:
        bar.close()
    if share is not None and share.processes > 1:
        found = total(found)
    return torch.where(found[:, 0].isfinite(), found[:, 0], torch.nan), found[:, 1:]
