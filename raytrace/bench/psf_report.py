"""The PSF benchmark in words: targets, one table a case, what the estimates are worth; and all rows as CSV."""

import csv
import dataclasses
import io
from collections.abc import Sequence

from raytrace.bench.psf import RAYS_ERROR, WAVE_ERROR, PsfRow
from raytrace.bench.psf_cases import DIRECT, PIXELS, RANDOM

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


def table(rows: Sequence[PsfRow]) -> str:
    """All rows as CSV; empty where a quantity does not exist."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in dataclasses.fields(PsfRow)], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: _csv(value) for name, value in dataclasses.asdict(row).items()})
    return text.getvalue()


def targets(rows: Sequence[PsfRow]) -> list[Target]:
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


def _targets_of_case(case: str, on_axis: bool, rows: Sequence[PsfRow]) -> list[Target]:
    orders = [row for row in rows if not row.sampling.startswith("tol")]

    def meeting(model: str, error: float) -> list[PsfRow]:
        return [row for row in orders if row.model == model and row.l1_error is not None and row.l1_error <= error]

    found = []
    gaussians = [row for row in orders if row.model == "gaussian"]
    close = [row.rays for row in gaussians if max(row.sigma_error, row.centroid_error) <= GAUSSIAN_ERROR]
    words = f"{min(close)} rays" if close else "not reached"
    found.append(Target(_GOALS[0 if on_axis else 1], case, words, bool(close) and min(close) <= GAUSSIAN_RAYS[on_axis]))
    found += _ratio(_GOALS[2], case, meeting("drt", RAYS_ERROR), meeting(RANDOM, RAYS_ERROR))
    waves = [row for row in orders if row.model == "wave"]
    if waves:
        best = min(row.l1_error for row in waves)
        found.append(Target(_GOALS[3], case, f"{best:.1e}", best <= WAVE_ERROR))
    for goal, rule in zip(_GOALS[4:], ("grid", "rings"), strict=True):
        found += _ratio(goal, case, meeting("wave", WAVE_ERROR), meeting(f"{DIRECT}, {rule}", WAVE_ERROR))
    return found


def _ratio(goal: str, case: str, fast: Sequence[PsfRow], slow: Sequence[PsfRow]) -> list[Target]:
    """The quickest of each against the other."""
    if not fast or not slow:
        return []
    ours, theirs = (min(rows, key=lambda row: row.forward_s) for rows in (fast, slow))
    ratio = theirs.forward_s / ours.forward_s
    about = "extrapolated " if theirs.extrapolated else ""
    words = (
        f"{ratio:.0f}×: {_ms(ours.forward_s)} ms ({ours.sampling}, {ours.l1_error:.1e}) against {about}"
        f"{_ms(theirs.forward_s)} ms ({theirs.sampling})"
    )
    return [Target(goal, case, words, ratio >= FASTER)]


def _target_of_estimates(rows: Sequence[PsfRow], dtype: str) -> list[Target]:
    """How many estimates bound the true error, and bound it within ten times."""
    found = judged(rows)
    if not found:
        return []
    bounding = sum(row.own_error <= row.estimate for row in found) / len(found)
    near = sum(row.own_error <= row.estimate <= 10 * row.own_error for row in found) / len(found)
    return [
        Target("estimates bound the true error in ≥ 95 %", dtype, f"{bounding:.0%} of {len(found)}", bounding >= 0.95),
        Target("estimates bound it within ten times in ≥ 50 %", dtype, f"{near:.0%} of {len(found)}", near >= 0.5),
    ]


def judged(rows: Sequence[PsfRow]) -> list[PsfRow]:
    """The rows with an estimate, once each: two tolerances may be met by the same kernel."""
    found = {}
    for row in rows:
        if row.estimate is not None:
            found.setdefault((row.lens, row.field, row.model, row.dtype, row.estimate), row)
    return list(found.values())


def markdown(rows: Sequence[PsfRow], *, titles: dict[tuple[str, float], str], about: dict, repeats: int) -> str:
    """The report. titles: of the cases, by lens and field."""
    clock = "processor time" if about["torch threads"] == 1 else "time of day"
    lines = [f"Times of one kernel of {PIXELS} × {PIXELS} pixels, ms: median {clock} of up to {repeats} warm runs.", ""]
    lines += ["; ".join(f"{name}: {value}" for name, value in about.items()) + ".", ""]
    lines += ["## Targets", "", *_target_table(targets(rows)), "", "## How to read the tables", "", *_LEGEND, ""]
    for case, title in titles.items():
        own = [row for row in rows if (row.lens, row.field) == case]
        lines += [f"## {title}", "", *_case_table([row for row in own if row.estimate is None]), ""]
    lines += ["## Driven by a tolerance", "", *_estimate_table(rows, titles)]
    return "\n".join(lines) + "\n"


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


def _target_table(found: Sequence[Target]) -> list[str]:
    cells = [[t.goal, t.case, t.measured, "" if t.met is None else "yes" if t.met else "no"] for t in found]
    return _table(["target", "case", "measured", "met"], cells)


def _case_table(rows: Sequence[PsfRow]) -> list[str]:
    """A line for every model and sampling, float64 / float32."""
    header = [
        "model",
        "sampling",
        "rays",
        "forward",
        "+ backward",
        "L1 error",
        "σ error",
        "centroid error",
        "from wave",
    ]
    lines = []
    for pair in _pairs(rows):
        first = pair[0]
        note = "*" if first.extrapolated else ""
        cells = [first.model, first.sampling + note, " / ".join(dict.fromkeys(f"{row.rays:,}" for row in pair))]
        cells += [_both(pair, "forward_s", _ms), _both(pair, "both_s", _ms)]
        cells += [_both(pair, name, _error) for name in ("l1_error", "sigma_error", "centroid_error")]
        lines.append([*cells, _error(first.model_error)])
    return _table(header, lines)


def _estimate_table(rows: Sequence[PsfRow], titles: dict[tuple[str, float], str]) -> list[str]:
    header = [
        "case",
        "model",
        "asked",
        "dtype",
        "estimated",
        "true",
        "bounds",
        "within ten",
        "rays",
        "forward",
        "+ backward",
    ]
    lines = []
    for row in rows:
        if row.estimate is None:
            continue
        bound = row.own_error <= row.estimate
        close = bound and row.estimate <= 10 * row.own_error
        cells = [titles[row.lens, row.field], row.model, row.sampling.removeprefix("tol "), row.dtype]
        cells += [_error(row.estimate), _error(row.own_error), *("yes" if fact else "no" for fact in (bound, close))]
        lines.append([*cells, f"{row.rays:,}", _ms(row.forward_s), _ms(row.both_s)])
    return _table(header, lines)


def _pairs(rows: Sequence[PsfRow]) -> list[list[PsfRow]]:
    """Rows that differ in their dtype alone, float64 first; random rays of another number stay apart."""
    groups: dict[tuple[str, str], list[PsfRow]] = {}
    for row in rows:
        groups.setdefault((row.model, row.sampling), []).append(row)
    return [sorted(group, key=lambda row: row.dtype, reverse=True) for group in groups.values()]


def _both(pair: Sequence[PsfRow], name: str, form) -> str:
    if all(getattr(row, name) is None for row in pair):
        return ""
    if len(pair) == 1 and pair[0].dtype == "float32":
        return "– / " + form(getattr(pair[0], name))
    return " / ".join(form(getattr(row, name)) for row in pair)


def _table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *lines)]


def _ms(seconds: float | None) -> str:
    if seconds is None:
        return ""
    return f"{1e3 * seconds:,.0f}" if seconds >= 0.1 else f"{1e3 * seconds:.3g}"


def _error(number: float | None) -> str:
    return "" if number is None else "0" if number == 0 else f"{number:.1e}"


def _csv(value) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
