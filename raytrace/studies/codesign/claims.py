"""Claims of the paper, each answered by the numbers of a study: a claim is a row (text, when it is true, judge)."""

import dataclasses
import math
import statistics
from collections.abc import Callable, Iterable, Sequence

from raytrace.studies.codesign.experiment import Outcome
from raytrace.studies.codesign.settings import NAMES
from raytrace.studies.codesign.study import StepTime, Summary, losses_by_distance, summaries
from raytrace.system.lens import Lens

#: Curvature radii in mm of the paper's lens (Table 3), to five digits; the plane ones and the stop left out.
_RADII = (54.153, 152.522, 35.9506, 22.2699, -25.685, -36.9802, 196.417, -67.1476)

SIMPLE = ("paraxial", "fourier")
OURS = "gaussian"


@dataclasses.dataclass(frozen=True)
class Claim:
    """What the paper says, when we call it true, whether it is (None: runs are missing), and the figures."""

    text: str
    criterion: str
    holds: bool | None
    figures: str

    @property
    def answer(self) -> str:
        return {True: "yes", False: "no", None: "not run yet"}[self.holds]


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Finished runs, their summaries by model, and the ms of PSFs by model. KeyError where a model is missing."""

    runs: Sequence[Outcome]
    of: dict[str, Summary]
    ms: dict[str, float]

    def simple(self, column: str) -> list[float]:
        """Means of both simple models."""
        return [self.of[model].mean[column] for model in SIMPLE]

    def gains(self) -> dict[float, float]:
        """Relative gain of Gaussian DRT over the better of the simple models, by object distance in mm."""
        distances, losses = losses_by_distance(self.runs)
        means = {model: list(map(statistics.fmean, zip(*seeds, strict=True))) for model, seeds in losses.items()}
        columns = zip(distances, means[OURS], *(means[model] for model in SIMPLE), strict=True)
        return {distance: min(others) / ours - 1 for distance, ours, *others in columns}


def is_of_paper(lens: Lens) -> bool:
    """Whether a lens is that of the paper, whatever its sensor distance and aperture: no other has its claims."""
    bent = [1 / float(s.curvature) for s in lens.surfaces if s.curvature is not None and float(s.curvature) != 0]
    return len(bent) == len(_RADII) and all(math.isclose(a, b, rel_tol=1e-4) for a, b in zip(bent, _RADII, strict=True))


def claims(found: Sequence[Outcome], times: Sequence[StepTime]) -> list[Claim]:
    """All claims, over the finished runs of a study and the measured times of a step."""
    evidence = Evidence(found, {one.model: one for one in summaries(found)}, {time.model: time.psf for time in times})
    return [_answered(evidence, *row) for row in CLAIMS]


def _answered(evidence: Evidence, text: str, criterion: str, judge: Callable[[Evidence], tuple[bool, str]]) -> Claim:
    try:
        return Claim(text, criterion, *judge(evidence))
    except KeyError as missing:
        return Claim(text, criterion, None, f"no finished run of {missing.args[0]}")


def penalty(summary: Summary) -> float:
    """Relative rise of the loss from step 1, with the model's own PSFs, to step 2 with DRT PSFs."""
    return summary.mean["l1_drt"] / summary.mean["l1_joint"] - 1


def percent(part: float) -> str:
    return f"{100 * part:+.1f} %"


def _agree(given: Evidence) -> tuple[bool, str]:
    places = given.simple("focus_paraxial_m")
    return abs(places[0] - places[1]) <= 2, f"{_metres(places)}, paraxial conjugates"


def _at_34_to_36_m(given: Evidence) -> tuple[bool, str]:
    places = given.simple("focus_paraxial_m")
    figures = f"{_metres(places)}; by least RMS spot {_metres(given.simple('focus_rms_m'))}"
    return all(33.5 <= place <= 36.5 for place in places), figures


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
    ours, columns = given.of[OURS].mean, ("focus_paraxial_m", "focus_rms_m")
    figures = f"{ours[columns[0]]:.1f} m paraxial, {ours[columns[1]]:.1f} m by least RMS spot"
    return all(ours[column] < min(given.simple(column)) for column in columns), figures


def _simple_lose(given: Evidence) -> tuple[bool, str]:
    losses = [penalty(given.of[model]) for model in SIMPLE]
    return min(losses) >= 0.1, " and ".join(map(percent, losses))


def _ours_loses_little(given: Evidence) -> tuple[bool, str]:
    loss = penalty(given.of[OURS])
    return loss <= 0.02, percent(loss)


def _wins(given: Evidence) -> tuple[bool, str]:
    ours, others = given.of[OURS].mean["l1_drt"], given.simple("l1_drt")
    told = [
        f"{loss:.4f} ({NAMES[name]}, {percent(loss / ours - 1)})" for name, loss in zip(SIMPLE, others, strict=True)
    ]
    return ours < min(others), f"{ours:.4f} beside {' and '.join(told)}"


def _wins_everywhere(given: Evidence) -> tuple[bool, str]:
    gains = given.gains()
    told = ", ".join(f"{percent(gain)} at {distance / 1e3:g} m" for distance, gain in gains.items())
    return min(gains.values()) > 0, f"loss of the better of both, over its own: {told}"


def _most_at_20_to_30_m(given: Evidence) -> tuple[bool, str]:
    gains = given.gains()
    place = max(gains, key=gains.get)
    return gains[place] > 0 and 20e3 <= place <= 30e3, f"greatest at {place / 1e3:g} m ({percent(gains[place])})"


def _simple_cheaper(given: Evidence) -> tuple[bool, str]:
    holds = max(given.ms[model] for model in SIMPLE) < 0.9 * min(given.ms[OURS], given.ms["drt"])
    return holds, _costs(given, given.ms)


def _ours_cheaper(given: Evidence) -> tuple[bool, str]:
    return given.ms[OURS] < 0.9 * given.ms["drt"], _costs(given, (OURS, "drt"))


def _costs(given: Evidence, models: Iterable[str]) -> str:
    return ", ".join(f"{NAMES[model]} {given.ms[model]:.1f} ms" for model in sorted(models, key=given.ms.get))


def _metres(distances: Sequence[float]) -> str:
    return " and ".join(f"{distance:.1f} m" for distance in distances)


CLAIMS = (
    ("Paraxial and Fourier optics agree", "focus within 2 m of each other", _agree),
    ("… at 34 to 36 m", "both from 33.5 to 36.5 m, paraxial conjugate", _at_34_to_36_m),
    (
        "Gaussian DRT chooses another sensor position",
        "further from both than three deviations, and than they are apart",
        _another_place,
    ),
    ("… focused nearer (27.3 m)", "nearer than both, in both definitions of focus", _nearer),
    ("The simple models lose much to DRT (+21 %, +25 %)", "10 % or more, both", _simple_lose),
    ("Gaussian DRT loses little (+0.2 %)", "2 % or less", _ours_loses_little),
    ("The lens of Gaussian DRT is best after step 2", "least mean loss with DRT PSFs", _wins),
    ("… at all object distances", "less loss than both at each", _wins_everywhere),
    ("… most at 20 to 30 m", "a gain over the better of both, and the greatest there", _most_at_20_to_30_m),
    (
        "Paraxial and Fourier optics cost less than ray tracing",
        "PSFs and gradient of a batch: both a tenth less than Gaussian DRT and DRT, or better",
        _simple_cheaper,
    ),
    ("A Gaussian DRT costs less than the DRT", "PSFs and gradient of a batch: a tenth less or better", _ours_cheaper),
)
