"""Claims of the paper, each answered by the numbers of a study."""

import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping, Sequence

from raytrace.studies.codesign.experiment import Outcome
from raytrace.studies.codesign.step_time import StepTime
from raytrace.studies.codesign.study import NAMES, Summary, losses_by_distance, summaries
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


def is_of_paper(lens: Lens) -> bool:
    """Whether a lens is that of the paper, whatever its sensor distance and aperture: no other has its claims."""
    bent = [1 / float(s.curvature) for s in lens.surfaces if s.curvature is not None and float(s.curvature) != 0]
    return len(bent) == len(_RADII) and all(math.isclose(a, b, rel_tol=1e-4) for a, b in zip(bent, _RADII, strict=True))


def claims(found: Sequence[Outcome], times: Sequence[StepTime]) -> list[Claim]:
    """All claims, over the finished runs of a study and the measured times of a step."""
    of = {summary.model: summary for summary in summaries(found)}
    return [
        _answered("Paraxial and Fourier optics agree", "focus within 2 m of each other", _agree, of),
        _answered("… at 34 to 36 m", "both from 33.5 to 36.5 m, paraxial conjugate", _at_34_to_36_m, of),
        _answered(
            "Gaussian DRT chooses another sensor position",
            "further from both than three deviations, and than they are apart",
            _another_place,
            of,
        ),
        _answered("… focused nearer (27.3 m)", "nearer than both, in both definitions of focus", _nearer, of),
        _answered("The simple models lose much to DRT (+21 %, +25 %)", "10 % or more, both", _simple_lose, of),
        _answered("Gaussian DRT loses little (+0.2 %)", "2 % or less", _ours_loses_little, of),
        _answered("The lens of Gaussian DRT is best after step 2", "least mean loss with DRT PSFs", _wins, of),
        _answered("… at all object distances", "less loss than both at each", _wins_everywhere, found),
        _answered(
            "… most at 20 to 30 m", "a gain over the better of both, and the greatest there", _most_at_20_to_30_m, found
        ),
        _answered(
            "Paraxial and Fourier optics cost less than ray tracing",
            "PSFs and gradient of a batch: both a tenth less than Gaussian DRT and DRT, or better",
            _simple_cheaper,
            times,
        ),
        _answered(
            "A Gaussian DRT costs less than the DRT",
            "PSFs and gradient of a batch: a tenth less or better",
            _ours_cheaper,
            times,
        ),
    ]


def penalty(summary: Summary) -> float:
    """Relative rise of the loss from step 1, with the model's own PSFs, to step 2 with DRT PSFs."""
    return summary.mean["l1_drt"] / summary.mean["l1_joint"] - 1


def _answered(text: str, criterion: str, judge: Callable[..., tuple[bool, str]], given) -> Claim:
    try:
        return Claim(text, criterion, *judge(given))
    except KeyError as missing:
        return Claim(text, criterion, None, f"no finished run of {missing.args[0]}")


def _agree(of: Mapping[str, Summary]) -> tuple[bool, str]:
    first, second = (of[model].mean["focus_paraxial_m"] for model in SIMPLE)
    return abs(first - second) <= 2, f"{_metres(first)} and {_metres(second)}, paraxial conjugates"


def _at_34_to_36_m(of: Mapping[str, Summary]) -> tuple[bool, str]:
    places = [of[model].mean["focus_paraxial_m"] for model in SIMPLE]
    rms = [of[model].mean["focus_rms_m"] for model in SIMPLE]
    figures = (
        f"{_metres(places[0])} and {_metres(places[1])}; by least RMS spot {_metres(rms[0])} and {_metres(rms[1])}"
    )
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
        f"those are {1e3 * abs(places[0] - places[1]):.0f} µm apart, {_over_seeds(ours.seeds, spread)}"
    )
    return min(map(abs, shifts)) > least and shifts[0] * shifts[1] > 0, figures


def _over_seeds(seeds: int, spread: float) -> str:
    return f"deviation over {seeds} seeds {1e3 * spread:.1f} µm" if seeds > 1 else "one seed, no deviation known"


def _nearer(of: Mapping[str, Summary]) -> tuple[bool, str]:
    def below(column: str) -> bool:
        return all(of[OURS].mean[column] < of[model].mean[column] for model in SIMPLE)

    ours = of[OURS].mean
    figures = f"{_metres(ours['focus_paraxial_m'])} paraxial, {_metres(ours['focus_rms_m'])} by least RMS spot"
    return below("focus_paraxial_m") and below("focus_rms_m"), figures


def _simple_lose(of: Mapping[str, Summary]) -> tuple[bool, str]:
    losses = [penalty(of[model]) for model in SIMPLE]
    return min(losses) >= 0.1, f"{_percent(losses[0])} and {_percent(losses[1])}"


def _ours_loses_little(of: Mapping[str, Summary]) -> tuple[bool, str]:
    return penalty(of[OURS]) <= 0.02, f"{_percent(penalty(of[OURS]))}"


def _wins(of: Mapping[str, Summary]) -> tuple[bool, str]:
    ours, others = of[OURS].mean["l1_drt"], [of[model].mean["l1_drt"] for model in SIMPLE]
    figures = f"{ours:.4f} beside {others[0]:.4f} (paraxial, {_percent(others[0] / ours - 1)})"
    return ours < min(others), f"{figures} and {others[1]:.4f} (Fourier, {_percent(others[1] / ours - 1)})"


def _gains(found: Sequence[Outcome]) -> dict[float, float]:
    """Relative gain of Gaussian DRT over the better of the simple models, by object distance in mm."""
    distances, losses = losses_by_distance(found)
    means = {
        model: [statistics.fmean(column) for column in zip(*seeds, strict=True)] for model, seeds in losses.items()
    }
    columns = zip(distances, means[OURS], *(means[model] for model in SIMPLE), strict=True)
    return {distance: min(others) / ours - 1 for distance, ours, *others in columns}


def _wins_everywhere(found: Sequence[Outcome]) -> tuple[bool, str]:
    gains = _gains(found)
    shown = ", ".join(f"{_percent(gain)} at {distance / 1e3:g} m" for distance, gain in gains.items())
    return min(gains.values()) > 0, f"loss of the better of both, over its own: {shown}"


def _most_at_20_to_30_m(found: Sequence[Outcome]) -> tuple[bool, str]:
    gains = _gains(found)
    place = max(gains, key=gains.get)
    return gains[place] > 0 and 20e3 <= place <= 30e3, f"greatest at {place / 1e3:g} m ({_percent(gains[place])})"


def _simple_cheaper(times: Sequence[StepTime]) -> tuple[bool, str]:
    of = {time.model: time.psf for time in times}
    holds = max(of[model] for model in SIMPLE) < 0.9 * min(of[OURS], of["drt"])
    return holds, _costs(of)


def _ours_cheaper(times: Sequence[StepTime]) -> tuple[bool, str]:
    of = {time.model: time.psf for time in times}
    return of[OURS] < 0.9 * of["drt"], _costs({model: of[model] for model in (OURS, "drt")})


def _costs(of: Mapping[str, float]) -> str:
    return ", ".join(f"{NAMES[model]} {psf:.1f} ms" for model, psf in sorted(of.items(), key=lambda item: item[1]))


def _percent(part: float) -> str:
    return f"{100 * part:+.1f} %"


def _metres(distance: float) -> str:
    return f"{distance:.1f} m"
