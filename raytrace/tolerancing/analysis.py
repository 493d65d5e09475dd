"""Tolerance analysis: sensitivities, expectation and distribution of the lens as built, with table and figure."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from raytrace.budget import afford
from raytrace.io import write_lens
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Result, Table
from raytrace.optimization.attained import NotReached, attained_by
from raytrace.optimization.merit import DefaultMerit, Merit
from raytrace.plotting.style import GREY, INK, fill, new_figure, styled
from raytrace.settings import GRADES
from raytrace.shards import Share
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.system.tolerance_data import Tolerance
from raytrace.tolerancing import grades
from raytrace.tolerancing.compensators import within_conditions
from raytrace.tolerancing.criteria import Criterion, Sampling, criterion_of
from raytrace.tolerancing.makeable import Makeable
from raytrace.tolerancing.monte_carlo import monte_carlo
from raytrace.tolerancing.perturbation import Perturbation
from raytrace.tolerancing.radial import limits_alone
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.second_order import SecondOrder
from raytrace.tolerancing.study import Study, moments, views_of, with_changes
from raytrace.tolerancing.table import BadTolerance, ToleranceTable
from raytrace.tolerancing.tightening import Proposal, limited_to_change, limited_to_yield
from raytrace.words import RaytraceWarning, calling_level, did_you_mean, option

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Percentages of the table of percentiles.
PERCENTILES = (98, 90, 80, 50, 20, 10, 2)
_MODEL = 2**15  # draws of the second-order model
_CHECKED, _UNEXPLAINED = 64, 0.25  # lenses that the model is compared with; accepted part of their standard deviation
_ABOVE, _CLOSE = 1 + 1e-6, 0.003  # accepted part of an increment, and error of a yield
_NEGATIVE = 0.02  # accepted share of draws whose mean square is negative by second order


class GoalMissed(RaytraceWarning):
    """A goal of the criterion that the nominal lens itself misses."""


@value
class ToleranceAnalysis(Result):
    """The lens as built.

    better: "smaller" or "larger", which values of the criterion are better; angle: radians of its unit, 0 for no angle.
    nominal: () of the criterion, of the nominal lens with its compensators at their best. minimum, maximum: (N,) change
    of the criterion by each tolerance at its limits, compensated; second_minimum, second_maximum: (N,) the same by
    second order; slope: (N,) its derivative times the half width. direction: (N,) of a radial error the direction of
    its largest change, which is that at the maximum, degrees from x to y; the change at the minimum is that of the
    opposite direction; nan of other rows.
    estimated: () nominal ± √Σ ½(Δmin² + Δmax²), to the worse, as OpticStudio. expected: () the mean of the criterion by
    second order; expected_square: () that of its square, of the MTF that of 1 - MTF. predicted: (K,) draws of the
    second-order model, whose compensators keep their limits. holds: whether that model describes the lens: why not, or
    "". trials: (T,) the criterion of the perturbed and compensated lenses, nan of a lens that failed: no ray of a field
    arrives, or it loses more than `light_loss` of the light of the nominal lens; changes: (T, C) of the compensators.
    lost: (T,) shares of the light of the nominal lens that the trials lose, in the configuration that loses most;
    lost_minimum, lost_maximum: (N,) those of lenses with one error at its limit, whose changes are nan beyond
    `light_loss`.
    unsettled: how many lenses traced now had compensators that still gained 1e-6 of the mean square in the last step.
    goal: of the criterion, if one was requested; share: of lenses, whose criterion is listed; given: the tolerances
    before their limits were tightened, or None. conditions: of the lens, that limit compensators, in words. missed: why
    the tightened limits do not reach the increment or the yield, or ""; finest: the first rows of those at the finest
    limit of the workshop; cost: of the given and of these limits, 1 for the finest limit of one tolerance, or None.
    """

    lens: Lens
    tolerances: ToleranceTable
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
    lost: Tensor
    lost_minimum: Tensor
    lost_maximum: Tensor
    direction: Tensor
    light_loss: float = 0.05
    holds: str = ""
    configurations: int = 1
    seed: int = 0
    unsettled: int = 0
    angle: float = 0.0
    goal: float | None = None
    share: float = 0.9
    given: ToleranceTable | None = None
    conditions: tuple[str, ...] = ()
    missed: str = ""
    finest: tuple[int, ...] = ()
    cost: tuple[float, float] | None = None
    workshop: str = "any"
    better: str = "smaller"

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
            Column("direction", "°", ".4g", "worst\ndirection"),
            Column("lost", "%", ".3g", "light\nlost"),
            Column("share", "%", ".4g"),
            Column("trials", self.unit, ".5f"),
            Column("predicted", self.unit, ".5f", "2nd order"),
            Column("difference", "%", "+.2f"),
        )
    )

    @property
    def title(self) -> str:
        """The criterion and its unit."""
        return f"{self.criterion}, {self.unit}" if self.unit else self.criterion

    @property
    def sign(self) -> int:
        """1 where smaller values of the criterion are better, else -1."""
        return -1 if self.better == "larger" else 1

    @property
    def worst(self) -> Tensor:
        """Places (G,) of the tolerances, the largest change to the worse first; of a group that of its first row."""
        changes = torch.maximum(self.sign * self.minimum, self.sign * self.maximum)
        order = torch.argsort(changes.nan_to_num(torch.inf), descending=True)  # nan: the lens fails
        leaders = self.tolerances.leaders
        return order[leaders[order] == order]

    @property
    def labels(self) -> list[str]:
        """Kind and place of every row in words; of the first row of a group those of all its rows."""
        return self.tolerances.names

    def percentile(self, percent: float) -> Tensor:
        """The criterion that so many percent of the trials meet or surpass; failed trials are worse than all."""
        ordered = torch.nan_to_num(self.sign * self.trials, nan=torch.inf)
        return self.sign * torch.quantile(ordered, percent / 100, interpolation="higher")

    def yield_at(self, limit: float) -> float:
        """Share of the trials whose criterion is a number or better: at most it, or at least it of the MTF."""
        return float((self.sign * self.trials <= self.sign * limit).double().mean())

    def table_of_shares(self) -> dict[str, Tensor]:
        """The criterion that shares of the trials meet or surpass, the same by second order, and the difference."""
        shares = sorted({*PERCENTILES, 100 * self.share})
        traced = torch.stack([self.percentile(p) for p in shares])
        predicted = self.sign * torch.quantile(self.sign * self.predicted, traced.new_tensor(shares) / 100)
        off = 100 * (predicted / traced - 1)
        return {"share": traced.new_tensor(shares), "trials": traced, "predicted": predicted, "difference": off}

    def tightened(self) -> list[tuple[str, float]]:
        """The tolerances whose limits were tightened, with the factor, the most tightened first."""
        if self.given is None:
            return []
        hidden = {error.places[1] for error in self.tolerances.radial.values()}
        rows = enumerate(zip(self.tolerances, self.given, self.tolerances.labels, self.labels, strict=True))
        factors = [
            (name if n in self.tolerances.radial else label, _factor(new, old))
            for n, (new, old, label, name) in rows
            if n not in hidden
        ]
        return sorted((pair for pair in factors if pair[1] < 1), key=lambda pair: pair[1])

    def at_limit(self, number: int) -> int:
        """How many trials have a compensator, by its number from 0, at one of its limits."""
        compensator, moved = self.tolerances.compensators[number], self.changes[:, number]
        return int(((moved <= compensator.minimum) | (moved >= compensator.maximum)).sum())

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
        stated = "no light" if math.isnan(figure) else f"{self.criterion} {figure:.6g} {self.unit}".rstrip()
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
        """The number of the trial with the worst criterion of those that light arrives in."""
        return int((self.sign * self._arrived()).nan_to_num(-torch.inf).argmax())

    @property
    def best_trial(self) -> int:
        """The number of the trial with the best criterion."""
        return int((self.sign * self._arrived()).nan_to_num(torch.inf).argmin())

    def _arrived(self) -> Tensor:
        """The trials. Raises ValueError where light arrives in none."""
        if not bool(self.trials.isfinite().any()):
            reason = (
                "no light arrives in any trial" if len(self.trials) else f"no trials; give {option('trials')} above 0"
            )
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

    def save_lens(self, path: str | PathLike, *, catalogs: Sequence[str | Path] = ()) -> None:
        """Write the nominal lens with these tolerances and compensators as a .zmx file (`Lens.with_tolerances`).

        catalogs: as of `save_trials`. Raises BadTolerance, LensFileError.
        """
        write_lens(self.lens.with_tolerances(self.tolerances), path, catalogs=catalogs)

    def columns(self) -> dict[str, Tensor]:
        """Changes by tolerances, the worst first, without angles of irregularities, which change nothing alone."""
        angles = torch.tensor([row.kind == "irregularity_angle" for row in self.tolerances], dtype=torch.bool)
        order, (low, high) = self.worst, self.tolerances.ranges
        order = order[~angles[order]]
        lost = 100 * torch.maximum(self.lost_minimum, self.lost_maximum)
        columns = {
            "tolerance": order,
            "minimum": low[order],
            "maximum": high[order],
            "unit": order,
            "change_minimum": self.minimum[order],
            "change_maximum": self.maximum[order],
            "second_minimum": self.second_minimum[order],
            "second_maximum": self.second_maximum[order],
            "slope": self.slope[order],
        }
        columns |= {"direction": self.direction[order]} if bool(self.direction.isfinite().any()) else {}
        return columns | ({"lost": lost[order]} if bool(lost.any()) else {})

    def words(self) -> dict[str, Sequence[str]]:
        return {"tolerance": self.labels, "unit": [row.unit for row in self.tolerances]}

    def summary(self) -> dict[str, float]:
        """Numbers of the lens as built, in the unit of the criterion."""
        summary = {
            "nominal": float(self.nominal),
            "estimated": float(self.estimated),
            "expected": float(self.expected),
        }
        if self.better == "smaller":
            summary["expected_root_mean_square"] = math.sqrt(float(self.expected_square))
        summary["second_order_holds"] = not self.holds
        if len(self.trials):
            good = self.trials[~self.trials.isnan()]
            ends = (good * self.sign).aminmax() if len(good) else (torch.tensor(torch.nan),) * 2
            summary |= {"mean": float(good.mean()), "sigma": float(good.std()) if len(good) > 1 else math.nan}
            summary |= {"best": float(ends[0]) * self.sign, "worst": float(ends[1]) * self.sign}
            summary |= {"failed": len(self.trials) - len(good), "lost_light": float(self.lost.max())}
            summary |= {f"percent_{p}": float(self.percentile(p)) for p in PERCENTILES}
        if self.cost is not None:
            summary |= {"cost_given": self.cost[0], "cost": self.cost[1], "target_reached": not self.missed}
        if self.goal is not None:
            reached = self.sign * self.predicted <= self.sign * self.goal
            summary |= {"goal": self.goal, "yield_by_second_order": float(reached.double().mean())}
            if len(self.trials):
                summary["yield"] = self.yield_at(self.goal)
        return summary

    def tables(self) -> list[Table]:
        summary = self.summary()
        about = [f"{self.title}: nominal {summary['nominal']:.6g}" + (", larger is better" if self.sign < 0 else "")]
        if self.configurations > 1:
            about[0] += f", of {self.configurations} configurations together"
        root, failing = summary.get("expected_root_mean_square"), int((self.minimum + self.maximum).isnan().sum())
        about.append(
            f"as built, expected by second order: mean {summary['expected']:.6g}"
            + (f", root mean square {root:.6g}" if root is not None else "")
            + f"; estimated by RSS {summary['estimated']:.6g}"
        )
        if self.holds:
            about.append(f"the second order does not hold: {self.holds}; rely on the trials")
        if failing:
            about.append(
                f"{failing} tolerances lose more than {100 * self.light_loss:g} % of the light at a limit: not in RSS"
            )
        if self.angle:
            numbers = {"expected": summary["expected"], "estimated by RSS": summary["estimated"]}
            numbers |= {"90 % within": summary["percent_90"]} if len(self.trials) else {}
            listed = ", ".join(f"{word} {1e3 * self.angle * number:.4g}" for word, number in numbers.items())
            about.append(f"as an angle, divided by the focal length, mrad: {listed}")
        if not self.tolerances.compensators:
            about.append("no compensator")
        if self.conditions:
            about.append(f"compensators within the conditions of the lens: {', '.join(self.conditions)}")
        if len(self.trials):
            about.append(
                f"{len(self.trials):,} trials (seed {self.seed}): mean {summary['mean']:.6g}, "
                f"σ {summary['sigma']:.4g}, best {summary['best']:.6g}, worst {summary['worst']:.6g}"
            )
            if summary["lost_light"] > 0:
                about.append(
                    f"light lost in {int((self.lost > 0).sum())} trials, {100 * summary['lost_light']:.3g} % at most; "
                    f"{summary['failed']} failed, by more than {100 * self.light_loss:g} %, and count as the worst"
                )
            good = ~self.trials.isnan()
            for k, compensator in enumerate(self.tolerances.compensators):
                c = self.changes[good, k]
                if not bool(c.any()):
                    about.append(f"compensator {compensator}: it stays{', as it has no effect' * bool(len(c))}")
                    continue
                about.append(
                    f"compensator {compensator}: {float(c.min()):.4g} to {float(c.max()):.4g}, "
                    f"mean {float(c.mean()):.4g}, σ {float(c.std()):.4g}"
                    + (f"; at a limit in {at_limit}" if (at_limit := self.at_limit(k)) else "")
                )
        if self.goal is not None:
            traced = f", {100 * summary['yield']:.4g} % of the trials" if len(self.trials) else ""
            share = f"{100 * summary['yield_by_second_order']:.4g} % by second order"
            bound = "at most" if self.sign > 0 else "at least"
            about.append(f"{bound} {self.goal:g}{' ' * bool(self.unit)}{self.unit}: {share}{traced}")
        if self.given is not None:
            drawn = self.tightened()
            listed = ", ".join(f"{label} × {factor:.3g}" for label, factor in drawn[:6])
            about.append(
                f"limits tightened of {len(drawn)} of {len(self.tolerances)} tolerances{': ' * bool(drawn)}{listed}"
            )
            if self.cost is not None:
                about.append(f"relative cost {self.cost[0]:.4g} of the given limits, {self.cost[1]:.4g} of these")
            if self.finest:
                names = self.tolerances.names
                about.append(
                    f"at the finest limit of the workshop ({self.workshop}): "
                    + ", ".join(names[n] for n in self.finest)
                )
            if self.missed:
                about.append(f"the target is not reached: {self.missed}")
        if self.unsettled:
            about.append(f"compensators of {self.unsettled} lenses had not settled when their steps ended")
        tables = [Table(self.columns(), about, self.tolerances.notes)]
        if len(self.trials):
            bound = "within" if self.sign > 0 else "above"
            tables.append(
                Table(self.table_of_shares(), [f"share of the trials {bound} a limit, and the same by second order"])
            )
        return tables

    def document(self) -> dict[str, Any]:
        about = {"criterion": self.criterion, "unit": self.unit, **self.summary(), **Result.document(self)}
        return about | ({"unread": list(self.tolerances.unread)} if self.tolerances.unread else {})

    @styled
    def draw(self, **options: Any) -> "Figure":
        """Histogram of the trials with the expectation and the yield curve, and the tolerances that count most."""
        figure = new_figure(9.0, 4.5)
        title = f"{self.lens.name or 'Lens'}\nas built, {len(self.tolerances) - len(self.tolerances.radial)} tolerances"
        figure.suptitle(fill(title, figure.get_figwidth(), 10, bold=True), fontweight="bold", fontsize=10)
        left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
        good = self.trials[~self.trials.isnan()]
        shown = good if len(good) else self.predicted
        tail = torch.quantile(self.sign * shown, 0.998) * self.sign
        ends = ((self.sign * shown).min() * self.sign, self.nominal, tail)
        span = (float(min(ends)), float(max(ends)))
        bins = np.linspace(*span, 41)
        if len(good):
            left.hist(shown.numpy(), bins=bins, density=True, color="#9ecae1", label=f"{len(good):,} trials")
        density, _ = np.histogram(self.predicted.numpy(), bins=bins, density=True)
        left.stairs(density, bins, color=INK, linewidth=1.2, label="second order")
        left.axvline(float(self.nominal), color=GREY, linestyle=":", label="nominal")
        left.axvline(float(self.expected), color="#d62728", label="expected")
        left.set(xlabel=self.title, ylabel="density", xlim=span)
        curve = left.twinx()
        ordered = torch.sort(shown).values
        curve.plot(ordered.numpy(), np.linspace(0, 100, len(ordered))[:: self.sign], color="#2ca02c", linewidth=1.2)
        curve.set(ylim=(0, 100))
        curve.set_ylabel("yield, %", color="#2ca02c")
        curve.tick_params(axis="y", colors="#2ca02c")
        side = "right" if self.sign > 0 else "left"
        left.legend(fontsize=8, loc=f"center {side}")
        order = self.worst[:12].flip(0)
        labels = [self.labels[k] for k in order.tolist()]
        right.barh(range(len(order)), self.maximum[order].numpy(), height=0.38, align="edge", label="at maximum")
        right.barh(range(len(order)), self.minimum[order].numpy(), height=-0.38, align="edge", label="at minimum")
        right.set_yticks(range(len(order)), labels, fontsize=7.5)
        right.set(xlabel=", ".join(filter(None, ("change of the criterion", self.unit))))
        right.legend(fontsize=8, loc=f"lower {side}")
        return figure


def _factor(new: Tolerance, old: Tolerance) -> float:
    """The ratio of the new to the old range of a row."""
    wide = old.maximum - old.minimum
    return (new.maximum - new.minimum) / wide if wide else 1.0


def tolerance(
    lens: Lens,
    tolerances: ToleranceTable | None = None,
    *,
    grade: Literal["commercial", "precision", "high"] | None = None,
    limits: str | Sequence[str] = "",
    radial: bool = False,
    criterion: str = "rms",
    trials: int = 1000,
    seed: int = 0,
    increment: float | None = None,
    goal: float | None = None,
    yield_: float | None = None,
    workshop: Literal["commercial", "precision", "high", "any"] = "high",
    costs: str | Sequence[str] = "",
    hold: bool = True,
    fields: Tensor | Sequence | None = None,
    rings: int | None = None,
    arms: int | None = None,
    light_loss: float = 0.05,
    model: Literal["gaussian", "drt"] = "gaussian",
    pixel: float | None = None,
    size: int | tuple[int, int] | None = None,
    merit: Merit | DefaultMerit | Sequence[Row] | str | None = None,
    checkpoint: str | PathLike | None = None,
    share: Share | None = None,
    progress: Callable | None = None,
) -> ToleranceAnalysis:
    """The lens as built: sensitivities, expectation by second order and Monte Carlo.

    A lens of several configurations is judged in all of them: the compensators minimise the mean over the
    configurations by the weights of the file (CWGT), equal by default. For `lens.configuration(2)` alone, remove the
    others by `operands=()`.

    tolerances: as `tolerances` or `read_tolerances` return them; by default those of the lens's own file, or of
        `grade` and `limits`.
    grade: tolerances of published grades instead of the file's, see `tolerances`.
    limits: words and kinds with their limits ±, "radius=0.1% thickness=0.02 element_tilt=0.05"; they replace those of
        the file or the grade, and "index=0" leaves one out.
    radial: whether decentres, tilts and wedges of the grade and of limits are magnitudes in a random direction; by
        default x and y are separate. "wedge_radial=0.01" is one of these alone.
    criterion: "rms", the RMS spot radius in µm over fields and wavelengths by their weights, each field about the
        centroid of its light, of an afocal lens that of "angle", the RMS angle in mrad of the rays; "wavefront", the
        RMS wavefront in waves less mean and tilt; "mtf@30", the MTF of diffraction at 30 cycles/mm, mean of
        tangential and sagittal over the fields; "psf", the change of the PSFs, √(Σ(h - h₀)²/Σh₀²) with h₀ of the
        nominal lens, mean square over the fields, in windows about the chief ray; "boresight", the distance in µm by
        which the chief ray of the axial field misses its nominal place on the sensor; "merit", a merit function. The
        compensators of every lens bring it to its best.
    trials: number of perturbed and compensated lenses, 0 for none; seed: trial k of a seed is the same lens always.
    increment: inverse sensitivity: limits are tightened until no error alone, at a limit, makes the criterion worse by
        more than this, in its unit. Tighter limits stay. Radial errors are in their worst direction.
    goal: value of the criterion that a good lens reaches, in its unit: its largest, of the MTF its smallest. Alone it
        reports the share of good lenses (yield); with `yield_` it tightens the limits. Warns GoalMissed of one that the
        nominal lens misses.
    yield_: a share of the lenses, 0.9 by default, whose criterion is reported; with `goal`, limits are tightened at
        least cost until this share reaches the goal, by second order corrected by traced lenses.
    workshop: whose figures, those of a grade, are the finest limits that are proposed. Proposals are in steps,
        as 0.005 mm of decentres, ± alike where the given limits are, and the same along x and y. "any": exact limits,
        of any size, each row apart.
    costs: weights of the costs of tolerances, which are inverse to their limits and 1 at the finest of the workshop:
        "element_decenter=3 index=0.5", words as of `limits`.
    hold: whether compensators stay within the limits that conditions of the lens put on the thickness, or the edge,
        that they adjust, as air_thickness>=1 (MNCA), bfd>=30 or thickness:7<=60; other conditions hold of the nominal
        lens.
    fields: y, (x, y) or (2, F), alike in weight; by default the lens's own with their weights and, as errors are not
        symmetric, mirrored along y if the lens is round, at half the weight each: the criterion of the nominal lens is
        that of its own fields.
    rings: of the pupil, Gaussian quadrature; by default the fewest that give the spots of `spot`.
    arms: of the pupil, 4·rings by default.
    light_loss: share of the light of the nominal lens that a lens may lose, 0.05 by default; one that loses more has
        failed.
    model: of "psf", by default gaussian, which is smooth in the errors; pixel, size: of its windows, pitch in mm,
        0.005 by default, and number of pixels across, 21 by default.
    merit: of "merit", as `optimize` takes it; by default that of the file.
    checkpoint: a file (.jsonl) of finished trials, from which an interrupted study resumes.
    share: of this process (`shards.share()`), if all processes of a job call alike.
    progress: (count, unit) -> a progress bar.
    Warns NotReached of conditions of the lens that it does not meet before it is perturbed, GoalMissed where limits
    that the workshop makes do not reach the increment or the yield.
    Raises BadTolerance for tolerances or compensators that the lens does not have, ValueError for unknown options.
    """
    if trials < 0:
        raise ValueError(f"trials {trials}: expected 0 or more")
    if tolerances is None:
        tolerances = grades.tolerances(lens, limits, grade=grade, radial=radial)
    elif grade or limits or radial:
        left_out = f"{option('grade')}, {option('limits')} and {option('radial')}"
        raise ValueError(f"`tolerances` are given: leave {left_out} out")
    if not len(tolerances):
        raise BadTolerance(f"no tolerances; give rows, a {option('grade')} or {option('limits')}")
    afford(8.0 * trials * len(tolerances), f"the errors of {trials:,} lenses", helps="ask for fewer {trials}")
    if yield_ is not None and not 0 < yield_ < 1:
        raise ValueError(f"yield {yield_:g}: expected a share of the lenses between 0 and 1, as 0.9")
    if workshop != "any" and workshop not in GRADES:
        raise ValueError(f"workshop {workshop!r}{did_you_mean(workshop, GRADES)}: expected {', '.join(GRADES)} or any")
    if not 0 <= light_loss <= 1:
        raise ValueError(f"light_loss {light_loss:g}: expected a share of the light between 0 and 1, as 0.05")

    limits_by_conditions: list[str] = []
    if hold:
        compensators, limits_by_conditions = within_conditions(lens, tolerances.compensators)
        tolerances = dataclasses.replace(tolerances, compensators=compensators)
    for condition in attained_by(lens) if hold else ():
        if not (condition.met or condition.row):
            warnings.warn(f"the nominal lens: {condition}", NotReached, stacklevel=calling_level())

    def criterion_near(view: Lens, sampling: Sampling) -> Criterion:
        return criterion_of(criterion, view, sampling, model=model, pixel=pixel, size=size, merit=merit)

    views = views_of(lens, criterion_near, fields, rings, arms)
    chosen, study, given = views[0].criterion, Study(views, tolerances, light_loss), tolerances
    if study.compensators:
        study.nominal_curvature()  # refuses those without effect
    with torch.no_grad():
        nominal_quantity, *_ = study.compensated(study.half.new_zeros(1, len(tolerances)))
        if not bool(nominal_quantity.isfinite().all()):
            raise BadTolerance(
                f"no ray of a field reaches the sensor of the nominal lens; give other {option('fields')}"
            )
        nominal = chosen.value(nominal_quantity[0])
        if goal is not None and chosen.sign * float(nominal) > chosen.sign * goal:
            message = (
                f"{option('goal')} {goal:g} {chosen.unit}".rstrip()
                + f": the nominal lens has {float(nominal):.4g} and does not reach the goal, a value of the criterion; "
                f"a share of the lenses is {option('yield_', 0.9)}"
            )
            if yield_ is not None:
                raise BadTolerance(message)
            warnings.warn(message, GoalMissed, stacklevel=calling_level())

        def harm(errors: Tensor) -> Tensor:
            return study.harm(errors)[0]

        def makeable(tolerances: ToleranceTable) -> Makeable | None:
            return None if workshop == "any" else Makeable(lens, tolerances, workshop, costs)

        proposal = Proposal(tolerances)

        if increment is not None:
            proposal = limited_to_change(tolerances, harm, increment, makeable(tolerances))
            tolerances, study = proposal.tolerances, Study(views, proposal.tolerances, light_loss)
        second = study.second_order()
        if goal is not None and yield_ is not None:
            proposal = limited_to_yield(
                tolerances, second, lambda errors: study.compensated(errors.to(study.half))[0],
                chosen.quantity_of(goal), yield_, seed + 1, makeable(tolerances),
            )  # fmt: skip
            tolerances, study = proposal.tolerances, Study(views, proposal.tolerances, light_loss)
        *limited, directions = limits_alone(tolerances, harm)
        alone = torch.cat(limited).to(study.half)
        changes, light = study.harm(alone)
        start, slope = second(torch.zeros_like(alone[:1]))
        seconds = chosen.value(second(alone)[0].clamp_min(0)) - chosen.value(start.clamp_min(0))
        mean, variance = (study.half.new_tensor(part) for part in zip(*map(moments, tolerances), strict=True))
        drawn = draw_errors(tolerances, _MODEL, seed + 1).to(study.half)
        predicted, expected, mean_square, negative = second.means(drawn, mean, variance, chosen.value)
        holds = _broken(study, second, drawn[:_CHECKED], float(negative))
        values, moved, kept = monte_carlo(study, trials, seed, checkpoint=checkpoint, share=share, progress=progress)
    missed = _missed(tolerances, changes, increment) if increment is not None else ""
    if goal is not None and yield_ is not None and proposal.share < yield_ - max(2 * proposal.error, _CLOSE):
        missed = f"{100 * proposal.share:.3g} % of the lenses reach the goal instead of {100 * yield_:.4g} %"
    if missed:
        missed += f", as the workshop ({workshop}) makes no finer limits" if proposal.finest else ""
        warnings.warn(f"the proposed limits miss the target: {missed}", GoalMissed, stacklevel=calling_level())
    priced = makeable(given) if tolerances is not given else None
    low, high = (chosen.sign * changes).chunk(2)
    light_low, light_high = (1 - light).chunk(2)
    rss = (0.5 * (low**2 + high**2)).nansum().sqrt()
    return ToleranceAnalysis(
        lens=lens, tolerances=tolerances, criterion=chosen.name, unit=chosen.unit, nominal=nominal, minimum=low,
        maximum=high, second_minimum=seconds[: len(low)], second_maximum=seconds[len(low) :],
        slope=_slope(chosen, start[0], slope[0], second.H, 0.5 * (alone[len(low) :] - alone[: len(low)])),
        direction=directions,
        estimated=nominal + chosen.sign * rss, expected=expected, expected_square=mean_square, predicted=predicted,
        trials=values, changes=moved, lost=1 - kept, lost_minimum=light_low, lost_maximum=light_high,
        light_loss=light_loss, holds=holds, configurations=len(views), seed=seed, unsettled=study.unsettled, goal=goal,
        share=0.9 if yield_ is None else yield_, given=None if tolerances is given else given,
        conditions=tuple(limits_by_conditions), missed=missed, finest=proposal.finest, workshop=workshop,
        cost=None if priced is None else (priced.cost(given), priced.cost(tolerances)),
        better="smaller" if chosen.sign > 0 else "larger", angle=chosen.angle,
    )  # fmt: skip


def _missed(tolerances: ToleranceTable, changes: Tensor, increment: float) -> str:
    """The tolerances whose changes (2 N,), at their limits, exceed an increment."""
    worst = torch.maximum(*changes.nan_to_num(torch.inf).chunk(2))
    names = tolerances.names
    beyond = [names[n] for n in torch.argsort(worst, descending=True).tolist() if float(worst[n]) > increment * _ABOVE]
    more = f" and {len(beyond) - 3} others" if len(beyond) > 3 else ""
    return f"{', '.join(beyond[:3])}{more} exceed the change of {increment:g}" if beyond else ""


def _broken(study: Study, model: SecondOrder, errors: Tensor, negative: float) -> str:
    """Why the second-order model does not describe the lens, "" where it does; errors (L, N) of lenses that are traced.

    It does where it explains the criterion of these lenses but for a quarter of its standard deviation.
    """
    if negative > _NEGATIVE:
        return f"it gives a negative mean square of {100 * negative:.3g} % of the lenses"
    traced, modelled = (study.criterion.value(q.clamp_min(0)) for q in (study.compensated(errors)[0], model(errors)[0]))
    arriving = traced.isfinite()
    if not int(arriving.sum()) > 1:
        return f"none of {len(errors)} traced lenses has a criterion"
    off, spread = (modelled - traced)[arriving], traced[arriving].std()
    root = off.square().mean().sqrt()
    if root <= _UNEXPLAINED * spread:
        return ""
    return (
        f"the criterion of {int(arriving.sum())} traced lenses differs from it by {float(root):.3g} "
        f"{study.criterion.unit} (RMS; mean {float(off.mean()):+.3g}), and from lens to lens by {float(spread):.3g}"
    )


def _slope(criterion: Criterion, q0: Tensor, g: Tensor, H: Tensor, errors: Tensor) -> Tensor:
    """Changes (L,) of the criterion along errors (L, N) to first order; where its square is 0 of the nominal lens, by
    their sizes."""
    if float(q0) <= 1e-12 * criterion.scale:
        return torch.sqrt((0.5 * ((errors @ H) * errors).sum(-1)).clamp_min(0))
    with torch.enable_grad():
        q = q0.detach().clone().requires_grad_()
        return (errors @ g) * torch.autograd.grad(criterion.value(q), q)[0]
