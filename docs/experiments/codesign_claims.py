"""The claims of the published study of the double Gauss, compared with finished runs.

    python docs/experiments/codesign_claims.py docs/codesign_f2_x2 --f-number 2   # claims.csv of a table.csv
    python docs/experiments/codesign_claims.py docs/codesign_f2_x2 --f-number 2 --runs FOLDER   # with further runs

A claim is a row (text, criterion, function that judges it). A table.csv has a row for each model and seed: losses, foci
and sensor distance, and the loss after step 2 at every object distance. It says nothing about the course of training
and about times, whose claims are left unanswered.
"""

import argparse
import csv
import dataclasses
import json
import math
import re
import statistics
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path

import torch
from codesign_study import (
    NAMES,
    StepTime,
    StudyOutcome,
    Summary,
    blur_diameters,
    loss_increase,
    losses_by_distance,
    percent,
    summaries,
)

import raytrace as rt
from raytrace.files import write_table
from raytrace.imaging.codesign import Outcome, lens_at_start
from raytrace.settings import CodesignSettings
from raytrace.system.lens import Lens

#: The paper's table: L1 after step 1, L1 with DRT PSFs after step 2, focus distance in m.
PAPER = {"paraxial": (0.0415, 0.0504, 33.9), "fourier": (0.0408, 0.0509, 35.7), "gaussian": (0.0429, 0.0430, 27.3)}

#: Curvature radii in mm of the paper's lens (Table 3), to five digits; the plane ones and the stop left out.
_RADII = (54.153, 152.522, 35.9506, 22.2699, -25.685, -36.9802, 196.417, -67.1476)

SIMPLE = ("paraxial", "fourier")
OURS = "gaussian"


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement of the paper, the criterion, whether it holds (None: unanswered), and the figures, or the reason.

    pending: unfinished runs of this study will answer it; otherwise an unanswered claim is not applicable.
    """

    text: str
    criterion: str
    holds: bool | None
    figures: str
    pending: bool = False

    @property
    def answer(self) -> str:
        if self.holds is None:
            return "not run yet" if self.pending else "not applicable"
        return "yes" if self.holds else "no"


@dataclasses.dataclass(frozen=True)
class Measurements:
    """Of the optimised lenses, by model. distances: m, of blur: RMS diameters in mm of traced rays; settled: fraction
    of step 1 after which the paraxial focus stays within 2 m of its end, mean over seeds."""

    distances: tuple[float, ...] = ()
    blur: Mapping[str, Sequence[float]] = dataclasses.field(default_factory=dict)
    settled: Mapping[str, float] = dataclasses.field(default_factory=dict)


_NO_MEASUREMENTS = Measurements()


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Finished runs, their summaries by model, and the ms of PSFs by model. KeyError if a model is missing."""

    runs: Sequence[Outcome]
    of: Mapping[str, Summary]
    ms: Mapping[str, float]
    measured: Measurements

    def simple(self, column: str) -> list[float]:
        """Means of both simple models."""
        return [self.of[model].mean[column] for model in SIMPLE]

    def gains(self) -> dict[float, float]:
        """Relative gain of Gaussian DRT over the better of the simple models, by object distance in mm."""
        distances, losses = losses_by_distance(self.runs)
        means = {model: list(map(statistics.fmean, zip(*seeds, strict=True))) for model, seeds in losses.items()}
        columns = zip(distances, means[OURS], *(means[model] for model in SIMPLE), strict=True)
        return {distance: min(others) / ours - 1 for distance, ours, *others in columns}


class _Unanswered(LookupError):
    """The reason why a claim cannot be answered."""


def is_of_paper(lens: Lens) -> bool:
    """Whether a lens is that of the paper, at any sensor distance and aperture."""
    radii = [1 / float(s.curvature) for s in lens.surfaces if s.curvature is not None and float(s.curvature) != 0]
    return len(radii) == len(_RADII) and all(
        math.isclose(a, b, rel_tol=1e-4) for a, b in zip(radii, _RADII, strict=True)
    )


def claims(
    results: Sequence[Outcome],
    times: Sequence[StepTime],
    measured: Measurements = _NO_MEASUREMENTS,
    *,
    pending: Collection[str] = (),
) -> list[Claim]:
    """All claims. times: of a step; pending: models of the study with unfinished runs."""
    by_model, ms = {summary.model: summary for summary in summaries(results)}, {time.model: time.psf for time in times}
    evidence, judged = Evidence(results, by_model, ms, measured), []
    for text, criterion, judge in CLAIMS:
        try:
            claim = Claim(text, criterion, *judge(evidence))
        except _Unanswered as reason:
            claim = Claim(text, criterion, None, str(reason))
        except KeyError as missing:
            model = missing.args[0]
            reason = f"{NAMES.get(model, model)} is not among the models of this study"
            reason = f"no finished run of {model}" if model in pending else reason
            claim = Claim(text, criterion, None, reason, pending=model in pending)
        judged.append(claim)
    return judged


def _agree(evidence: Evidence) -> tuple[bool, str]:
    places = evidence.simple("focus_paraxial_m")
    return abs(places[0] - places[1]) <= 2, f"{_metres(places)}, paraxial conjugates"


def _focus_of_simple(evidence: Evidence) -> tuple[bool, str]:
    """Both in one definition of focus, whichever departs less."""
    of = {name: evidence.simple(column) for column, name in _DEFINITIONS.items()}
    departs = {name: _departure(places, _papers(2, SIMPLE)) for name, places in of.items()}
    least = min(departs, key=departs.get)
    figures = "; ".join(f"{_metres(places)}, {name}" for name, places in of.items())
    return departs[least] <= _METRES, f"{figures}: {departs[least]:.1f} m off at most, {least}"


def _papers(column: int, models: Iterable[str]) -> list[float]:
    return [PAPER[model][column] for model in models]


def _departure(values: Sequence[float], papers: Sequence[float]) -> float:
    return max(abs(value - paper) for value, paper in zip(values, papers, strict=True))


def _another_place(evidence: Evidence) -> tuple[bool, str]:
    ours, places = evidence.of[OURS], evidence.simple("sensor_mm")
    shifts, apart = [ours.mean["sensor_mm"] - place for place in places], abs(places[0] - places[1])
    deviation = ours.deviation["sensor_mm"]
    spread = max(math.hypot(deviation, evidence.of[model].deviation["sensor_mm"]) for model in SIMPLE)
    shift = min(shifts, key=abs)
    side = "nearer to" if shift < 0 else "further from"
    over = f"deviation over {ours.seeds} seeds {1e3 * spread:.1f} µm"
    figures = (
        f"{1e3 * abs(shift):.0f} µm {side} the lens than the closer one; those are {1e3 * apart:.0f} µm apart, "
        f"{over if ours.seeds > 1 else 'one seed, no deviation known'}"
    )
    return abs(shift) > max(3 * spread, apart) and shifts[0] * shifts[1] > 0, figures


def _nearer(evidence: Evidence) -> tuple[bool, str]:
    ours = evidence.of[OURS].mean
    figures = ", ".join(f"{ours[column]:.1f} m {name}" for column, name in _DEFINITIONS.items())
    return all(ours[column] < min(evidence.simple(column)) for column in _DEFINITIONS), figures


def _at_27_m(evidence: Evidence) -> tuple[bool, str]:
    places = [evidence.of[OURS].mean[column] for column in _DEFINITIONS]
    departure = min(abs(place - PAPER[OURS][2]) for place in places)
    return departure <= _METRES, f"{_metres(places)}, paraxial conjugate and least RMS spot: {departure:.1f} m off"


def _rises(*models: str, points: float) -> Callable[[Evidence], tuple[bool, str]]:
    """Whether losses rise by as much as the paper's when the light is traced, to some points."""

    def judge(evidence: Evidence) -> tuple[bool, str]:
        increases = [loss_increase(evidence.of[model]) for model in models]
        departure = 100 * _departure(increases, [PAPER[model][1] / PAPER[model][0] - 1 for model in models])
        return departure <= points, f"{' and '.join(map(percent, increases))}: {departure:.1f} points off at most"

    return judge


def _order_of_step_1(evidence: Evidence) -> tuple[bool, str]:
    losses = {model: evidence.of[model].mean["l1_joint"] for model in PAPER}
    order = sorted(losses, key=losses.get)
    figures = ", ".join(f"{NAMES[model]} {losses[model]:.4f}" for model in order)
    return order == sorted(PAPER, key=lambda model: PAPER[model][0]), figures


def _as_large(evidence: Evidence) -> tuple[bool, str]:
    ratios = [
        evidence.of[model].mean[column] / PAPER[model][place] - 1
        for model in PAPER
        for place, column in enumerate(("l1_joint", "l1_drt"))
    ]
    return max(map(abs, ratios)) <= 0.1, f"{percent(min(ratios))} to {percent(max(ratios))}"


def _wins(evidence: Evidence) -> tuple[bool, str]:
    ours, others = evidence.of[OURS].mean["l1_drt"], evidence.simple("l1_drt")
    figures = [
        f"{loss:.4f} ({NAMES[name]}, {percent(loss / ours - 1)})" for name, loss in zip(SIMPLE, others, strict=True)
    ]
    return ours < min(others), f"{ours:.4f} compared with {' and '.join(figures)}"


def _wins_by_as_much(evidence: Evidence) -> tuple[bool, str]:
    ours = evidence.of[OURS].mean["l1_drt"]
    gains = [loss / ours - 1 for loss in evidence.simple("l1_drt")]
    departure = 100 * _departure(gains, [loss / PAPER[OURS][1] - 1 for loss in _papers(1, SIMPLE)])
    return departure <= _POINTS, f"{' and '.join(map(percent, gains))}: {departure:.1f} points off at most"


def _wins_everywhere(evidence: Evidence) -> tuple[bool, str]:
    gains = evidence.gains()
    figures = ", ".join(f"{percent(gain)} at {distance / 1e3:g} m" for distance, gain in gains.items())
    return min(gains.values()) > 0, f"loss of the better of both, over its own: {figures}"


def _most_at_20_to_30_m(evidence: Evidence) -> tuple[bool, str]:
    gains = evidence.gains()
    place = max(gains, key=gains.get)
    return gains[place] > 0 and 20e3 <= place <= 30e3, f"greatest at {place / 1e3:g} m ({percent(gains[place])})"


def _less_at_10_than_15_m(evidence: Evidence) -> tuple[bool, str]:
    if not evidence.runs:
        raise KeyError(OURS)
    distances, losses = losses_by_distance(evidence.runs)
    near, next_one = (distances.index(z) if z in distances else None for z in (10e3, 15e3))
    if near is None or next_one is None:
        raise _Unanswered("no losses at 10 and 15 m")
    of = {model: [statistics.fmean(column) for column in zip(*losses[model], strict=True)] for model in PAPER}
    figures = "; ".join(f"{NAMES[model]} {of[model][near]:.4f} and {of[model][next_one]:.4f}" for model in PAPER)
    return all(of[model][near] < of[model][next_one] for model in PAPER), figures


def _settled(evidence: Evidence) -> tuple[bool, str]:
    if evidence.runs and not evidence.measured.settled:
        raise _Unanswered("answered only where the sensor alone varies")
    settled = {model: evidence.measured.settled[model] for model in PAPER}
    return max(settled.values()) <= 0.5, ", ".join(
        f"{NAMES[model]} after {part:.0%}" for model, part in settled.items()
    )


def _falls_with_distance(evidence: Evidence) -> tuple[bool, str]:
    least = {}
    for model in SIMPLE:
        blur = evidence.measured.blur[model]
        least[model] = evidence.measured.distances[blur.index(min(blur))]
    return min(least.values()) >= 33.5, ", ".join(f"{NAMES[model]} least at {z:g} m" for model, z in least.items())


def _larger_far_away(evidence: Evidence) -> tuple[bool, str]:
    far = {model: evidence.measured.blur[model][-1] for model in PAPER}
    figures = ", ".join(f"{NAMES[model]} {1e3 * width:.1f} µm" for model, width in far.items())
    return far[OURS] > max(far[model] for model in SIMPLE), f"at {evidence.measured.distances[-1]:g} m {figures}"


def _smaller_overall(evidence: Evidence) -> tuple[bool, str]:
    of = {model: statistics.fmean(evidence.measured.blur[model]) for model in PAPER}
    figures = ", ".join(f"{NAMES[model]} {1e3 * width:.1f} µm" for model, width in of.items())
    return of[OURS] < min(of[model] for model in SIMPLE), f"in the mean {figures}"


def _varies_less(evidence: Evidence) -> tuple[bool, str]:
    of = {model: max(evidence.measured.blur[model]) - min(evidence.measured.blur[model]) for model in PAPER}
    figures = ", ".join(f"{NAMES[model]} by {1e3 * width:.1f} µm" for model, width in of.items())
    return of[OURS] < min(of[model] for model in SIMPLE), figures


def _simple_cheaper(evidence: Evidence) -> tuple[bool, str]:
    holds = max(evidence.ms[model] for model in SIMPLE) < 0.9 * min(evidence.ms[OURS], evidence.ms["drt"])
    return holds, _costs(evidence, evidence.ms)


def _ours_cheaper(evidence: Evidence) -> tuple[bool, str]:
    return evidence.ms[OURS] < 0.9 * evidence.ms["drt"], _costs(evidence, (OURS, "drt"))


def _costs(evidence: Evidence, models: Iterable[str]) -> str:
    return ", ".join(f"{NAMES[model]} {evidence.ms[model]:.1f} ms" for model in sorted(models, key=evidence.ms.get))


def _metres(distances: Sequence[float]) -> str:
    return " and ".join(f"{distance:.1f} m" for distance in distances)


_DEFINITIONS = {"focus_paraxial_m": "paraxial conjugate", "focus_rms_m": "least RMS spot"}
_METRES, _POINTS = 2.0, 5.0  # by which a number may depart from the paper's

CLAIMS = (
    ("Paraxial and Fourier optics agree", "focus within 2 m of each other (the paper: 1.8 m)", _agree),
    ("… at 33.9 and 35.7 m", "both within 2 m, in one definition of focus", _focus_of_simple),
    (
        "Gaussian DRT chooses another sensor position",
        "distance from both above three deviations and above their own difference",
        _another_place,
    ),
    ("… focused nearer", "nearer than both, in both definitions of focus", _nearer),
    ("… at 27.3 m", "within 2 m, in one of the definitions", _at_27_m),
    ("The focus is near its end early (Figure 4)", "within 2 m of it after half of step 1, all three", _settled),
    ("The simple lenses' blur falls with distance (Figure 5)", "least at 33.5 m or further", _falls_with_distance),
    ("… that of Gaussian DRT is larger far away", "compared with both, at the furthest object", _larger_far_away),
    ("… but smaller overall", "compared with both, mean over distances", _smaller_overall),
    ("… and varies less", "largest less smallest blur, compared with both", _varies_less),
    ("Losses are the paper's, 0.041 to 0.051", "all six within 10 %", _as_large),
    ("Fourier optics' loss of step 1 is the least, Gaussian DRT's the greatest", "in this order", _order_of_step_1),
    (
        "The simple models lose much to DRT (+21 %, +25 %)",
        "both within 5 points",
        _rises(*SIMPLE, points=_POINTS),
    ),
    ("Gaussian DRT loses little (+0.2 %)", "within 1 point", _rises(OURS, points=1.0)),
    ("The lens of Gaussian DRT is best after step 2", "least mean loss with DRT PSFs", _wins),
    ("… by 17 and 18 %", "both within 5 points", _wins_by_as_much),
    ("… at all object distances (Figure 6)", "less loss than both at each", _wins_everywhere),
    ("… most at 20 to 30 m", "a gain over the better of both, largest there", _most_at_20_to_30_m),
    ("All lose less at 10 m than at 15 m (Figure 6)", "each of the three", _less_at_10_than_15_m),
    (
        "Paraxial and Fourier optics cost less than ray tracing",
        "PSFs and gradient of a batch: both at least 10 % below Gaussian DRT and DRT",
        _simple_cheaper,
    ),
    ("A Gaussian DRT costs less than the DRT", "PSFs and gradient of a batch: at least 10 % below", _ours_cheaper),
)


# -- of a table


def rows_of(path: Path) -> list[dict]:
    """The rows of a table.csv; none where there is no file."""
    if not path.exists():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def outcomes_of(path: Path) -> list[StudyOutcome]:
    """The runs of a table.csv."""
    runs = []
    for row in rows_of(path):
        numbers = {key: float(value) for key, value in row.items() if key not in ("model", "seed")}
        at = {key: float(found[1]) * 1e3 for key in numbers if (found := re.fullmatch(r"l1_([\d.]+)m", key))}
        by_distance = {f"{z:g}": numbers.pop(key) for key, z in at.items()}
        runs.append(StudyOutcome(row["model"], int(row["seed"]), **numbers, variables={}, by_distance=by_distance))
    return runs


def blur_of(runs: Sequence[Outcome], f_number: float) -> Measurements:
    """RMS blur of the double Gauss at the sensor distances of the runs, at objects every metre."""
    lens, usual = rt.read_lens("double_gauss"), CodesignSettings(f_number=f_number)
    distances, found = torch.arange(10, 51, dtype=torch.float64), {}
    for run in runs:
        focused = lens_at_start(lens, dataclasses.replace(usual, start=repr(run.sensor_mm)))
        found.setdefault(run.model, []).append(blur_diameters(focused, 1e3 * distances).tolist())
    blur = {model: [statistics.fmean(column) for column in zip(*each, strict=True)] for model, each in found.items()}
    return Measurements(tuple(distances.tolist()), blur, {})


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="of table.csv; claims.csv is written there")
    parser.add_argument("--runs", metavar="STUDY", type=Path, nargs="+", help="folders of codesign.py, for table.csv")
    parser.add_argument("--f-number", metavar="N", type=float, required=True, help="aperture of the runs")


def table_of(studies: Sequence[Path], earlier: Sequence[Mapping] = ()) -> list[dict]:
    """Rows of table.csv, by model and seed: the finished runs of studies by codesign.py, and earlier rows that none of
    them replaces; lengths in mm, foci in m."""
    names = ("model", "seed", "l1_joint", "l1_before", "l1_drt", "focus_paraxial_m", "focus_rms_m", "sensor_mm")
    of = {(row["model"], int(row["seed"])): dict(row) for row in earlier}
    for file in (file for study in studies for file in study.glob("*/outcome.json")):
        run = json.loads(file.read_text("utf-8"))
        losses = {f"l1_{float(at) / 1e3:g}m": loss for at, loss in run["by_distance"].items()}
        of[run["model"], run["seed"]] = {name: run[name] for name in names} | losses
    return [of[key] for key in sorted(of, key=lambda key: ([*NAMES].index(key[0]), key[1]))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args()
    table = arguments.folder / "table.csv"
    if arguments.runs:
        write_table(table, table_of(arguments.runs, rows_of(table)))
    if not (runs := outcomes_of(table)):
        raise SystemExit(f"{table}: no finished runs; give --runs FOLDER, the -o of codesign.py")
    judged = claims(runs, [], blur_of(runs, arguments.f_number), pending=())
    rows = [
        {"claim": one.text, "answer": one.answer, "figures": one.figures, "criterion": one.criterion} for one in judged
    ]
    write_table(arguments.folder / "claims.csv", rows)
    print("\n".join(f"{one.answer:>14}: {one.text}; {one.figures}" for one in judged))


if __name__ == "__main__":
    main()
