"""Co-design of the double Gauss: the claims of the published study, compared with our runs.

    python docs/experiments/codesign.py double_gauss --data DIR -o FOLDER --docs docs
    python docs/experiments/codesign.py double_gauss --data DIR -o F1.9 --docs docs --page codesign_f1.9 --f-number 1.9

Arguments and runs are those of `raytrace codesign compare`; the page has the published numbers and claims in addition.
A claim is a row (text, criterion, function that judges it).
"""

import argparse
import dataclasses
import math
import statistics
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

from raytrace.cli import codesign
from raytrace.cli.codesign_compare import Publication, Report, compare
from raytrace.imaging.codesign import Outcome
from raytrace.imaging.codesign_study import StepTime, Summary, losses_by_distance, penalty, percent, summaries
from raytrace.settings import NAMES
from raytrace.system.lens import Lens

#: The paper's table: L1 after step 1, L1 with DRT PSFs after step 2, focus distance in m.
PAPER = {"paraxial": (0.0415, 0.0504, 33.9), "fourier": (0.0408, 0.0509, 35.7), "gaussian": (0.0429, 0.0430, 27.3)}

#: Curvature radii in mm of the paper's lens (Table 3), to five digits; the plane ones and the stop left out.
_RADII = (54.153, 152.522, 35.9506, 22.2699, -25.685, -36.9802, 196.417, -67.1476)

SIMPLE = ("paraxial", "fourier")
OURS = "gaussian"


@dataclasses.dataclass(frozen=True)
class Claim:
    """What the paper says, when we call it true, whether it is (None: not answered), and the figures, or the reason.

    pending: whether runs of this study that are not finished will answer it; without them it is not applicable.
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
class Seen:
    """What the figures of a study show, by model.

    distances: m, of blur: RMS diameters in mm of traced rays of the learned lenses; settled: the part of step 1 behind
    which the paraxial focus stays within 2 m of its end, the mean over seeds.
    """

    distances: tuple[float, ...] = ()
    blur: Mapping[str, Sequence[float]] = dataclasses.field(default_factory=dict)
    settled: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Finished runs, their summaries by model, and the ms of PSFs by model. KeyError where a model is missing."""

    runs: Sequence[Outcome]
    of: Mapping[str, Summary]
    ms: Mapping[str, float]
    seen: Seen

    def simple(self, column: str) -> list[float]:
        """Means of both simple models."""
        return [self.of[model].mean[column] for model in SIMPLE]

    def gains(self) -> dict[float, float]:
        """Relative gain of Gaussian DRT over the better of the simple models, by object distance in mm."""
        distances, losses = losses_by_distance(self.runs)
        means = {model: list(map(statistics.fmean, zip(*seeds, strict=True))) for model, seeds in losses.items()}
        columns = zip(distances, means[OURS], *(means[model] for model in SIMPLE), strict=True)
        return {distance: min(others) / ours - 1 for distance, ours, *others in columns}


_NOTHING = Seen()


def is_of_paper(lens: Lens) -> bool:
    """Whether a lens is that of the paper, whatever its sensor distance and aperture: no other has its claims."""
    bent = [1 / float(s.curvature) for s in lens.surfaces if s.curvature is not None and float(s.curvature) != 0]
    return len(bent) == len(_RADII) and all(math.isclose(a, b, rel_tol=1e-4) for a, b in zip(bent, _RADII, strict=True))


def claims(
    found: Sequence[Outcome],
    times: Sequence[StepTime],
    seen: Seen = _NOTHING,
    *,
    pending: Collection[str] = (),
) -> list[Claim]:
    """All claims, over the finished runs of a study, the measured times of a step and what its figures show.

    pending: models of the study with runs that are not finished.
    """
    of, ms = {one.model: one for one in summaries(found)}, {time.model: time.psf for time in times}
    evidence = Evidence(found, of, ms, seen)
    return [_answered(evidence, pending, *row) for row in CLAIMS]


class _Unanswered(LookupError):
    """Why a claim cannot be answered, in words."""


def _answered(
    evidence: Evidence,
    pending: Collection[str],
    text: str,
    criterion: str,
    judge: Callable[[Evidence], tuple[bool, str]],
) -> Claim:
    try:
        return Claim(text, criterion, *judge(evidence))
    except _Unanswered as why:
        return Claim(text, criterion, None, str(why))
    except KeyError as missing:
        model = missing.args[0]
        if model in pending:
            return Claim(text, criterion, None, f"no finished run of {model}", pending=True)
        return Claim(text, criterion, None, f"{NAMES.get(model, model)} is not among the models of this study")


def _agree(given: Evidence) -> tuple[bool, str]:
    places = given.simple("focus_paraxial_m")
    return abs(places[0] - places[1]) <= 2, f"{_metres(places)}, paraxial conjugates"


def _focus_of_simple(given: Evidence) -> tuple[bool, str]:
    """Both in one definition of focus, whichever departs less."""
    of = {name: given.simple(column) for column, name in _DEFINITIONS.items()}
    departs = {name: _departure(places, _papers(2, SIMPLE)) for name, places in of.items()}
    least = min(departs, key=departs.get)
    figures = "; ".join(f"{_metres(places)}, {name}" for name, places in of.items())
    return departs[least] <= _METRES, f"{figures}: {departs[least]:.1f} m off at most, {least}"


def _papers(column: int, models: Iterable[str]) -> list[float]:
    return [PAPER[model][column] for model in models]


def _departure(found: Sequence[float], papers: Sequence[float]) -> float:
    return max(abs(one - paper) for one, paper in zip(found, papers, strict=True))


def _another_place(given: Evidence) -> tuple[bool, str]:
    ours, places = given.of[OURS], given.simple("sensor_mm")
    shifts, apart = [ours.mean["sensor_mm"] - place for place in places], abs(places[0] - places[1])
    own = ours.deviation["sensor_mm"]
    spread = max(math.hypot(own, given.of[model].deviation["sensor_mm"]) for model in SIMPLE)
    shift = min(shifts, key=abs)
    side = "nearer to" if shift < 0 else "further from"
    over = f"deviation over {ours.seeds} seeds {1e3 * spread:.1f} µm"
    figures = (
        f"{1e3 * abs(shift):.0f} µm {side} the lens than the closer one; those are {1e3 * apart:.0f} µm apart, "
        f"{over if ours.seeds > 1 else 'one seed, no deviation known'}"
    )
    return abs(shift) > max(3 * spread, apart) and shifts[0] * shifts[1] > 0, figures


def _nearer(given: Evidence) -> tuple[bool, str]:
    ours = given.of[OURS].mean
    figures = ", ".join(f"{ours[column]:.1f} m {name}" for column, name in _DEFINITIONS.items())
    return all(ours[column] < min(given.simple(column)) for column in _DEFINITIONS), figures


def _at_27_m(given: Evidence) -> tuple[bool, str]:
    places = [given.of[OURS].mean[column] for column in _DEFINITIONS]
    departure = min(abs(place - PAPER[OURS][2]) for place in places)
    return departure <= _METRES, f"{_metres(places)}, paraxial conjugate and least RMS spot: {departure:.1f} m off"


def _rises(*models: str, points: float) -> Callable[[Evidence], tuple[bool, str]]:
    """Whether losses rise by as much as the paper's when the light is traced, to some points."""

    def judge(given: Evidence) -> tuple[bool, str]:
        found = [penalty(given.of[model]) for model in models]
        departure = 100 * _departure(found, [PAPER[model][1] / PAPER[model][0] - 1 for model in models])
        return departure <= points, f"{' and '.join(map(percent, found))}: {departure:.1f} points off at most"

    return judge


def _order_of_step_1(given: Evidence) -> tuple[bool, str]:
    found = {model: given.of[model].mean["l1_joint"] for model in PAPER}
    order = sorted(found, key=found.get)
    figures = ", ".join(f"{NAMES[model]} {found[model]:.4f}" for model in order)
    return order == sorted(PAPER, key=lambda model: PAPER[model][0]), figures


def _as_large(given: Evidence) -> tuple[bool, str]:
    ratios = [
        given.of[model].mean[column] / PAPER[model][place] - 1
        for model in PAPER
        for place, column in enumerate(("l1_joint", "l1_drt"))
    ]
    return max(map(abs, ratios)) <= 0.1, f"{percent(min(ratios))} to {percent(max(ratios))}"


def _wins(given: Evidence) -> tuple[bool, str]:
    ours, others = given.of[OURS].mean["l1_drt"], given.simple("l1_drt")
    figures = [
        f"{loss:.4f} ({NAMES[name]}, {percent(loss / ours - 1)})" for name, loss in zip(SIMPLE, others, strict=True)
    ]
    return ours < min(others), f"{ours:.4f} beside {' and '.join(figures)}"


def _wins_by_as_much(given: Evidence) -> tuple[bool, str]:
    ours = given.of[OURS].mean["l1_drt"]
    found = [loss / ours - 1 for loss in given.simple("l1_drt")]
    departure = 100 * _departure(found, [loss / PAPER[OURS][1] - 1 for loss in _papers(1, SIMPLE)])
    return departure <= _POINTS, f"{' and '.join(map(percent, found))}: {departure:.1f} points off at most"


def _wins_everywhere(given: Evidence) -> tuple[bool, str]:
    gains = given.gains()
    figures = ", ".join(f"{percent(gain)} at {distance / 1e3:g} m" for distance, gain in gains.items())
    return min(gains.values()) > 0, f"loss of the better of both, over its own: {figures}"


def _most_at_20_to_30_m(given: Evidence) -> tuple[bool, str]:
    gains = given.gains()
    place = max(gains, key=gains.get)
    return gains[place] > 0 and 20e3 <= place <= 30e3, f"greatest at {place / 1e3:g} m ({percent(gains[place])})"


def _less_at_10_than_15_m(given: Evidence) -> tuple[bool, str]:
    if not given.runs:
        raise KeyError(OURS)
    distances, losses = losses_by_distance(given.runs)
    near, next_one = (distances.index(z) if z in distances else None for z in (10e3, 15e3))
    if near is None or next_one is None:
        raise _Unanswered("no losses at 10 and 15 m")
    of = {model: [statistics.fmean(column) for column in zip(*losses[model], strict=True)] for model in PAPER}
    figures = "; ".join(f"{NAMES[model]} {of[model][near]:.4f} and {of[model][next_one]:.4f}" for model in PAPER)
    return all(of[model][near] < of[model][next_one] for model in PAPER), figures


def _settled(given: Evidence) -> tuple[bool, str]:
    if given.runs and not given.seen.settled:
        raise _Unanswered("answered only where the sensor alone varies")
    found = {model: given.seen.settled[model] for model in PAPER}
    return max(found.values()) <= 0.5, ", ".join(f"{NAMES[model]} after {part:.0%}" for model, part in found.items())


def _blur(given: Evidence, model: str) -> Sequence[float]:
    return given.seen.blur[model]


def _falls_with_distance(given: Evidence) -> tuple[bool, str]:
    least = {}
    for model in SIMPLE:
        own = _blur(given, model)
        least[model] = given.seen.distances[min(range(len(own)), key=own.__getitem__)]
    return min(least.values()) >= 33.5, ", ".join(f"{NAMES[model]} least at {z:g} m" for model, z in least.items())


def _larger_far_away(given: Evidence) -> tuple[bool, str]:
    far = {model: _blur(given, model)[-1] for model in PAPER}
    figures = ", ".join(f"{NAMES[model]} {1e3 * width:.1f} µm" for model, width in far.items())
    return far[OURS] > max(far[model] for model in SIMPLE), f"at {given.seen.distances[-1]:g} m {figures}"


def _smaller_overall(given: Evidence) -> tuple[bool, str]:
    of = {model: statistics.fmean(_blur(given, model)) for model in PAPER}
    figures = ", ".join(f"{NAMES[model]} {1e3 * width:.1f} µm" for model, width in of.items())
    return of[OURS] < min(of[model] for model in SIMPLE), f"in the mean {figures}"


def _varies_less(given: Evidence) -> tuple[bool, str]:
    of = {model: max(_blur(given, model)) - min(_blur(given, model)) for model in PAPER}
    figures = ", ".join(f"{NAMES[model]} by {1e3 * width:.1f} µm" for model, width in of.items())
    return of[OURS] < min(of[model] for model in SIMPLE), figures


def _simple_cheaper(given: Evidence) -> tuple[bool, str]:
    holds = max(given.ms[model] for model in SIMPLE) < 0.9 * min(given.ms[OURS], given.ms["drt"])
    return holds, _costs(given, given.ms)


def _ours_cheaper(given: Evidence) -> tuple[bool, str]:
    return given.ms[OURS] < 0.9 * given.ms["drt"], _costs(given, (OURS, "drt"))


def _costs(given: Evidence, models: Iterable[str]) -> str:
    return ", ".join(f"{NAMES[model]} {given.ms[model]:.1f} ms" for model in sorted(models, key=given.ms.get))


def _metres(distances: Sequence[float]) -> str:
    return " and ".join(f"{distance:.1f} m" for distance in distances)


_DEFINITIONS = {"focus_paraxial_m": "paraxial conjugate", "focus_rms_m": "least RMS spot"}
_METRES, _POINTS = 2.0, 5.0  # by which a number may depart from the paper's

CLAIMS = (
    ("Paraxial and Fourier optics agree", "focus within 2 m of each other (the paper: 1.8 m)", _agree),
    ("… at 33.9 and 35.7 m", "both within 2 m, in one definition of focus", _focus_of_simple),
    (
        "Gaussian DRT chooses another sensor position",
        "further from both than three deviations, and than they are apart",
        _another_place,
    ),
    ("… focused nearer", "nearer than both, in both definitions of focus", _nearer),
    ("… at 27.3 m", "within 2 m, in one of the definitions", _at_27_m),
    ("The focus is near its end early (Figure 4)", "within 2 m of it after half of step 1, all three", _settled),
    ("The simple lenses' blur falls with distance (Figure 5)", "least at 33.5 m or further", _falls_with_distance),
    ("… that of Gaussian DRT's is larger far away", "than both, at the furthest object", _larger_far_away),
    ("… but smaller overall", "than both, the mean over distances", _smaller_overall),
    ("… and varies less", "greatest less least, than both", _varies_less),
    ("Losses are the paper's, 0.041 to 0.051", "all six within 10 %", _as_large),
    ("Fourier optics' loss of step 1 is the least, Gaussian DRT's the greatest", "in this order", _order_of_step_1),
    (
        "The simple models lose much to DRT (+21 %, +25 %)",
        "both to 5 points",
        _rises(*SIMPLE, points=_POINTS),
    ),
    ("Gaussian DRT loses little (+0.2 %)", "to 1 point", _rises(OURS, points=1.0)),
    ("The lens of Gaussian DRT is best after step 2", "least mean loss with DRT PSFs", _wins),
    ("… by 17 and 18 %", "both to 5 points", _wins_by_as_much),
    ("… at all object distances (Figure 6)", "less loss than both at each", _wins_everywhere),
    ("… most at 20 to 30 m", "a gain over the better of both, and the greatest there", _most_at_20_to_30_m),
    ("All lose less at 10 m than at 15 m (Figure 6)", "each of the three", _less_at_10_than_15_m),
    (
        "Paraxial and Fourier optics cost less than ray tracing",
        "PSFs and gradient of a batch: both a tenth less than Gaussian DRT and DRT, or better",
        _simple_cheaper,
    ),
    ("A Gaussian DRT costs less than the DRT", "PSFs and gradient of a batch: a tenth less or better", _ours_cheaper),
)


def publication(lens: Lens) -> Publication | None:
    """The publication, of its lens only."""
    if not is_of_paper(lens):
        return None
    return Publication(
        command="python docs/experiments/codesign.py",
        columns=("paper: L¹, step 1", "paper: step 2", "paper: focus (m)"),
        numbers={model: (f"{a:.4f}", f"{b:.4f}", f"{focus:.1f}") for model, (a, b, focus) in PAPER.items()},
        note="; “paper”: the published study of this lens and these models, which does not say which focus is its own",
        claims=claims_of,
        closed_form="At other apertures, ρ, noise, normalisations and starts: [codesign_sweep.md](codesign_sweep.md).",
    )


def claims_of(report: Report) -> list[Claim]:
    seen = Seen(report.distances, report.blur, report.settled)
    return claims(report.found, report.times, seen, pending={model for model, _ in report.missing})


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    codesign.options(parser)
    parser.usage = "codesign.py LENS -o FOLDER [--docs DOCS] [options of raytrace codesign compare]"
    arguments = parser.parse_args(argv)
    (arguments.lens,) = arguments.words
    compare(arguments, publication)


if __name__ == "__main__":
    sys.exit(main())
