"""Claims of the paper, each answered by the numbers of a study."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

from raytrace.design.codesign import Outcome
from raytrace.design.step_time import StepTime
from raytrace.design.study import Summary, losses_by_distance, summaries

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


def claims(found: Sequence[Outcome], times: Sequence[StepTime]) -> list[Claim]:
    """All claims, over the finished runs of a study and the measured times of a step."""
    of = {summary.model: summary for summary in summaries(found)}
    gains = _gains(found)
    return [
        _answered(text, criterion, lambda judge=judge, given=given: judge(given))
        for text, criterion, judge, given in (
            ("Paraxial and Fourier optics agree", "focus within 2 m", _agree, of),
            ("… at 34 to 36 m", "both from 33.5 to 36.5 m, paraxial conjugate", _at_34_to_36_m, of),
            (
                "Gaussian DRT chooses another sensor position",
                "further from both than three deviations and than they are apart",
                _another_place,
                of,
            ),
            ("… focused nearer (27.3 m)", "nearer than both, in both definitions of focus", _nearer, of),
            (
                "The simple models lose much when DRT takes their place (+21 %, +25 %)",
                "10 % or more, both",
                _simple_lose,
                of,
            ),
            ("Gaussian DRT loses little (+0.2 %)", "2 % or less", _ours_loses_little, of),
            ("The lens of Gaussian DRT is best after step 2", "least mean loss with DRT PSFs", _wins, of),
            ("… at all object distances", "less loss than both at each", _wins_everywhere, gains),
            ("… most at 20 to 30 m", "there the greatest gain over the better of both", _most_at_20_to_30_m, gains),
            (
                "A Gaussian DRT costs less than the DRT",
                "PSFs of a batch and their gradient",
                _cheaper,
                {time.model: time for time in times},
            ),
        )
    ]


def penalty(summary: Summary) -> float:
    """Relative rise of the loss from step 1, with the model's own PSFs, to step 2 with DRT PSFs."""
    return summary.mean["l1_drt"] / summary.mean["l1_joint"] - 1


def _answered(text: str, criterion: str, judge: Callable[[], tuple[bool, str]]) -> Claim:
    try:
        return Claim(text, criterion, *judge())
    except KeyError as missing:
        return Claim(text, criterion, None, f"no finished run of {missing.args[0]}")


def _agree(of: Mapping[str, Summary]) -> tuple[bool, str]:
    first, second = (of[model].mean["focus_paraxial_m"] for model in SIMPLE)
    return abs(first - second) <= 2, f"{_metres(first)} and {_metres(second)}, paraxial conjugates"


def _at_34_to_36_m(of: Mapping[str, Summary]) -> tuple[bool, str]:
    places = [of[model].mean["focus_paraxial_m"] for model in SIMPLE]
    rms = [of[model].mean["focus_rms_m"] for model in SIMPLE]
    figures = f"{_metres(places[0])} and {_metres(places[1])}; by least RMS spot {_metres(rms[0])} and {_metres(rms[1])}"
    return all(33.5 <= place <= 36.5 for place in places), figures


def _another_place(of: Mapping[str, Summary]) -> tuple[bool, str]:
    ours, others = of[OURS], [of[model] for model in SIMPLE]
    places = [other.mean["sensor_mm"] for other in others]
    shifts = [ours.mean["sensor_mm"] - place for place in places]
    spread = max(math.hypot(ours.deviation["sensor_mm"], other.deviation["sensor_mm"]) for other in others)
    least = max(3 * spread, abs(places[0] - places[1]))
    shift = min(shifts, key=abs)
    side = "nearer to" if shift < 0 else "further from"
    figures = (
        f"{1e3 * abs(shift):.0f} µm {side} the lens than the closer one; "
        f"those are {1e3 * abs(places[0] - places[1]):.0f} µm apart, deviation over seeds {1e3 * spread:.1f} µm"
    )
    return min(map(abs, shifts)) > least and shifts[0] * shifts[1] > 0, figures


def _nearer(of: Mapping[str, Summary]) -> tuple[bool, str]:
    def below(column: str) -> bool:
        return all(of[OURS].mean[column] < of[model].mean[column] for model in SIMPLE)

    ours = of[OURS].mean
    figures = f"{_metres(ours['focus_paraxial_m'])} paraxial, {_metres(ours['focus_rms_m'])} by least RMS spot"
    return below("focus_paraxial_m") and below("focus_rms_m"), figures


def _simple_lose(of: Mapping[str, Summary]) -> tuple[bool, str]:
    losses = [penalty(of[model]) for model in SIMPLE]
    return min(losses) >= 0.1, f"{losses[0]:+.1%} and {losses[1]:+.1%}"


def _ours_loses_little(of: Mapping[str, Summary]) -> tuple[bool, str]:
    return penalty(of[OURS]) <= 0.02, f"{penalty(of[OURS]):+.1%}"


def _wins(of: Mapping[str, Summary]) -> tuple[bool, str]:
    ours, others = of[OURS].mean["l1_drt"], [of[model].mean["l1_drt"] for model in SIMPLE]
    figures = f"{ours:.4f} beside {others[0]:.4f} (paraxial, {others[0] / ours - 1:+.1%})"
    return ours < min(others), f"{figures} and {others[1]:.4f} (Fourier, {others[1] / ours - 1:+.1%})"


def _gains(found: Sequence[Outcome]) -> dict[str, dict[float, float]]:
    """Relative gain of Gaussian DRT over each simple model, by object distance in mm; nothing where runs are missing."""
    distances, losses = losses_by_distance(found)
    means = {model: [sum(column) / len(column) for column in zip(*seeds, strict=True)] for model, seeds in losses.items()}
    if OURS not in means:
        return {}
    return {
        model: {d: other / ours - 1 for d, other, ours in zip(distances, means[model], means[OURS], strict=True)}
        for model in SIMPLE
        if model in means
    }


def _least_gains(gains: Mapping[str, Mapping[float, float]]) -> dict[float, float]:
    first, second = (gains[model] for model in SIMPLE)
    return {distance: min(first[distance], second[distance]) for distance in first}


def _wins_everywhere(gains: Mapping[str, Mapping[float, float]]) -> tuple[bool, str]:
    least = _least_gains(gains)
    shown = ", ".join(f"{gain:+.1%} at {distance / 1e3:g} m" for distance, gain in least.items())
    return min(least.values()) > 0, f"the better of both has {shown}"


def _most_at_20_to_30_m(gains: Mapping[str, Mapping[float, float]]) -> tuple[bool, str]:
    least = _least_gains(gains)
    place = max(least, key=least.get)
    return 20e3 <= place <= 30e3, f"greatest at {place / 1e3:g} m ({least[place]:+.1%})"


def _cheaper(times: Mapping[str, StepTime]) -> tuple[bool, str]:
    shown = ", ".join(f"{one.model} {one.psf:.1f} ms" for one in sorted(times.values(), key=lambda one: one.psf))
    return times[OURS].psf < times["drt"].psf, shown


def _metres(distance: float) -> str:
    return f"{distance:.1f} m"
