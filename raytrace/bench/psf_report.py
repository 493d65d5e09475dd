"""The PSF benchmark in words: targets, one table a case, and what the estimates are worth."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from raytrace.bench.psf_cases import DIRECT, PIXELS, RANDOM
from raytrace.bench.report import clock_of, in_words, milliseconds, table, yes

RAYS_ERROR = 0.01  # that random rays are brought to
WAVE_ERROR = 1e-3  # that direct sums are brought to
GAUSSIAN_ERROR = 1e-6  # of σ and of the centroid
GAUSSIAN_RAYS = {True: 8, False: 40}  # on the axis, off it
FASTER = 50.0


@dataclasses.dataclass(frozen=True)
class Target:
    """A goal, what was measured on one case, and whether it is met (None: nothing to compare with)."""

    goal: str
    case: str
    measured: str
    met: bool | None


def targets(rows: Sequence) -> list[Target]:
    """The goals, measured: in float64, the estimates also in float32."""
    double, single = ([row for row in rows if row.dtype == dtype] for dtype in ("float64", "float32"))
    found = []
    for lens, field in dict.fromkeys((row.lens, row.field) for row in double):
        own = [row for row in double if (row.lens, row.field) == (lens, field)]
        found += _targets_of_case(f"{lens}, {field:g}", field == 0, own)
    found.sort(key=lambda target: _GOALS.index(target.goal))
    return [*found, *_target_of_estimates(double, "float64"), *_target_of_estimates(single, "float32")]


def _power(number: float) -> str:
    """1e-3, not 1e-03."""
    return f"{number:.0e}".replace("e-0", "e-")


_GOALS = (
    f"Gaussian parameters to {_power(GAUSSIAN_ERROR)} with ≤ {GAUSSIAN_RAYS[True]} rays on the axis",
    f"Gaussian parameters to {_power(GAUSSIAN_ERROR)} with ≤ {GAUSSIAN_RAYS[False]} rays off the axis",
    f"geometric PSF to {RAYS_ERROR:.0%} at ≥ {FASTER:.0f}× less time than random rays",
    f"wave PSF within {_power(WAVE_ERROR)} of the direct sum",
    f"wave PSF at ≥ {FASTER:.0f}× less time than the direct sum over a square grid that comes as close",
    f"wave PSF at ≥ {FASTER:.0f}× less time than the direct sum over Gauss rings that comes as close",
)


def _targets_of_case(case: str, on_axis: bool, rows: Sequence) -> list[Target]:
    orders = [row for row in rows if not row.sampling.startswith("tol")]

    def meeting(model: str, error: float) -> list:
        return [row for row in orders if row.model == model and row.l1_error is not None and row.l1_error <= error]

    gaussians = [row for row in orders if row.model == "gaussian"]
    close = [row.rays for row in gaussians if max(row.sigma_error, row.centroid_error) <= GAUSSIAN_ERROR]
    words = f"{min(close)} rays" if close else "not reached"
    met = bool(close) and min(close) <= GAUSSIAN_RAYS[on_axis]
    found = [Target(_GOALS[0 if on_axis else 1], case, words, met)]
    found += _ratio(_GOALS[2], case, meeting("drt", RAYS_ERROR), meeting(RANDOM, RAYS_ERROR))
    waves = [row.l1_error for row in orders if row.model == "wave"]
    if waves:
        found.append(Target(_GOALS[3], case, f"{min(waves):.1e}", min(waves) <= WAVE_ERROR))
    for goal, rule in zip(_GOALS[4:], ("grid", "rings"), strict=True):
        found += _ratio(goal, case, meeting("wave", WAVE_ERROR), meeting(f"{DIRECT}, {rule}", WAVE_ERROR))
    return found


def _ratio(goal: str, case: str, fast: Sequence, slow: Sequence) -> list[Target]:
    """The quickest of each against the other."""
    if not fast or not slow:
        return []
    ours, theirs = (min(rows, key=lambda row: row.forward_s) for rows in (fast, slow))
    ratio = theirs.forward_s / ours.forward_s
    about = "extrapolated " if theirs.extrapolated else ""
    words = (
        f"{ratio:.0f}×: {milliseconds(ours.forward_s)} ms ({ours.sampling}, {ours.l1_error:.1e}) against {about}"
        f"{milliseconds(theirs.forward_s)} ms ({theirs.sampling})"
    )
    return [Target(goal, case, words, ratio >= FASTER)]


def _target_of_estimates(rows: Sequence, dtype: str) -> list[Target]:
    """How many estimates bound the true error, and bound it within ten times."""
    found = judged(rows)
    if not found:
        return []
    shares = [sum(map(fact, found)) / len(found) for fact in (_bounds, _bounds_closely)]
    goals = ("estimates bound the true error in ≥ 95 %", "estimates bound it within ten times in ≥ 50 %")
    return [
        Target(goal, dtype, f"{share:.0%} of {len(found)}", share >= least)
        for goal, share, least in zip(goals, shares, (0.95, 0.5), strict=True)
    ]


def _bounds(row) -> bool:
    return row.own_error <= row.estimate


def _bounds_closely(row) -> bool:
    return row.own_error <= row.estimate <= 10 * row.own_error


def judged(rows: Sequence) -> list:
    """The rows with an estimate, once each: two tolerances may be met by the same kernel."""
    found = {}
    for row in rows:
        if row.estimate is not None:
            found.setdefault((row.lens, row.field, row.model, row.dtype, row.estimate), row)
    return list(found.values())


def lines(
    rows: Sequence, goals: Sequence[Target], *, titles: Mapping[tuple[str, float], str], about: Mapping, repeats: int
) -> list[str]:
    """The report. titles: of the cases, by lens and field."""
    columns = {
        "target": lambda goal: goal.goal,
        "case": lambda goal: goal.case,
        "measured": lambda goal: goal.measured,
        "met": lambda goal: yes(goal.met, ""),
    }
    found = [
        f"Times of one kernel of {PIXELS} × {PIXELS} pixels, ms: median {clock_of(about)} of up to {repeats} warm "
    ]
    found[0] += "runs."
    found += ["", in_words(about) + ".", "", "## Targets", "", *table(columns, goals), ""]
    found += ["## How to read the tables", "", *_LEGEND, ""]
    for case, title in titles.items():
        own = [row for row in rows if (row.lens, row.field) == case and row.estimate is None]
        found += [f"## {title}", "", *table(_CASE, _pairs(own)), ""]
    estimated = [row for row in rows if row.estimate is not None]
    return [
        *found,
        "## Driven by a tolerance",
        "",
        *table({"case": lambda r: titles[r.lens, r.field]} | _ESTIMATES, estimated),
    ]


_LEGEND = (
    "Two figures in one cell: float64 / float32. `+ backward`: forward and the gradient by every curvature, conic, "
    "asphere coefficient and thickness. An asterisk: extrapolated from the lines above it.",
    "",
    "- L1 error: Σ|k - r|/Σr of the kernel. `drt`, Sobol and random rays: against 2 million cells of the ray map. "
    "`wave`, direct sums, Optiland's waves: against the direct Huygens sum. `gaussian`: against the Gaussian of "
    "converged moments. `paraxial`, `fourier`: against their own finest order.",
    "- σ error: of σx or σy, the larger; centroid error: in units of σ; both against converged moments of the rays, "
    "for `paraxial` and `fourier`, too: there they are errors of the model.",
    "- from wave: L1 difference of the kernel from the direct Huygens sum: what the model leaves out. `paraxial` and "
    "`fourier` are compared in a window about their own chief ray, so that distortion does not count twice.",
    "- Optiland's kernels are given the energy of the reference: shapes are compared.",
)


def _error(number: float | None) -> str:
    return "" if number is None else "0" if number == 0 else f"{number:.1e}"


def _both(name: str, form: Callable[[float | None], str]) -> Callable[[Sequence], str]:
    """A figure of both dtypes in one cell."""

    def cell(pair: Sequence) -> str:
        if all(getattr(row, name) is None for row in pair):
            return ""
        alone = "– / " if len(pair) == 1 and pair[0].dtype == "float32" else ""
        return alone + " / ".join(form(getattr(row, name)) for row in pair)

    return cell


_CASE = {
    "model": lambda pair: pair[0].model,
    "sampling": lambda pair: pair[0].sampling + ("*" if pair[0].extrapolated else ""),
    "rays": lambda pair: " / ".join(dict.fromkeys(f"{row.rays:,}" for row in pair)),
    "forward": _both("forward_s", milliseconds),
    "+ backward": _both("both_s", milliseconds),
    "L1 error": _both("l1_error", _error),
    "σ error": _both("sigma_error", _error),
    "centroid error": _both("centroid_error", _error),
    "from wave": lambda pair: _error(pair[0].model_error),
}
_ESTIMATES = {
    "model": lambda row: row.model,
    "asked": lambda row: row.sampling.removeprefix("tol "),
    "dtype": lambda row: row.dtype,
    "estimated": lambda row: _error(row.estimate),
    "true": lambda row: _error(row.own_error),
    "bounds": lambda row: yes(_bounds(row)),
    "within ten": lambda row: yes(_bounds_closely(row)),
    "rays": lambda row: f"{row.rays:,}",
    "forward": lambda row: milliseconds(row.forward_s),
    "+ backward": lambda row: milliseconds(row.both_s),
}


def _pairs(rows: Sequence) -> list[list]:
    """Rows that differ in their dtype alone, float64 first; random rays of another number stay apart."""
    groups: dict[tuple[str, str], list] = {}
    for row in rows:
        groups.setdefault((row.model, row.sampling), []).append(row)
    return [sorted(group, key=lambda row: row.dtype, reverse=True) for group in groups.values()]
