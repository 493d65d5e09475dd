"""The benchmark of speed in words: what was to be reached, what was measured, and every speed with its error."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

from raytrace.bench.less_work import Gain
from raytrace.bench.measure import SAMPLE
from raytrace.bench.speed import Row, Sizes
from raytrace.pages import KEPT as KEPT
from raytrace.pages import page
from raytrace.pages import table as table

_WHATS = {
    "forward": "double Gauss, forward",
    "backward": "double Gauss, forward + backward",
    "asphere": "three aspheres, forward",
}


@dataclasses.dataclass(frozen=True)
class Target:
    """One line of the table: a ratio's key, what it means, and the least or the most it is to be."""

    key: str
    words: str
    bound: float
    at_most: bool = False
    dtypes: tuple[str, ...] = ("float32", "float64")

    def met(self, value: float | None) -> bool | None:
        if value is None or not math.isfinite(value):
            return None
        return value <= self.bound if self.at_most else value >= self.bound


def targets(sizes: Sizes) -> list[Target]:
    """What is to be reached, in the words of these numbers of rays."""
    rays, sensor = _power(sizes.rays), _power(sizes.sensor)
    backward = "forward + backward to all curvatures, thicknesses and indices: "
    return [
        Target("forward_over_limit", f"forward, {rays} rays, double Gauss: speed over the safe limit", 0.7),
        Target("forward_over_optiland", "… over Optiland's best back end", 25),
        Target("backward_over_forward", f"{backward}time over own forward", 4, at_most=True),
        Target("backward_over_optiland", "… speed over Optiland's", 15),
        Target("bytes_per_ray", "its peak memory above the inputs, bytes a ray", 120, True, ("float32",)),
        Target("small_batch_ms", f"{sizes.small} rays forward + backward, ms", 0.5, at_most=True),
        Target("small_batch_over_optiland", "… speed over Optiland's", 20),
        Target("asphere_over_limit", f"three strong even aspheres, {rays} rays: speed over the safe limit", 0.5),
        Target("asphere_over_optiland", "… over Optiland's best back end", 15),
        Target("sensor_step_gain", f"step of the sensor distance, {sensor} rays × {sizes.distances}: × retracing", 10),
        Target("spot_process_ratio", "process of `raytrace spot` over that of the bare imports", 1.3, at_most=True),
        Target("two_process_gain", "two processes of one thread over one", 1.7),
    ]


def document(rows: Sequence[Row], ratios: Mapping[str, Mapping[str, float | None]]) -> dict:
    """For JSON: for each dtype its ratios, and the speed of every entrant in millions of rays × surfaces / s."""
    found: dict[str, dict] = {}
    for dtype, numbers in ratios.items():
        speeds: dict[str, dict[str, dict[str, float]]] = {}
        for row in (one for one in rows if one.dtype == dtype):
            by_count = speeds.setdefault(row.what, {}).setdefault(row.tracer, {})
            by_count[str(row.rays)] = row.speed / 1e6
        finite = {key: value if value is None or math.isfinite(value) else None for key, value in numbers.items()}
        found[dtype] = finite | {"millions_per_second": speeds}
    return found


def markdown(
    rows: Sequence[Row],
    ratios: Mapping[str, Mapping[str, float | None]],
    *,
    sizes: Sizes,
    about: Mapping[str, str | int],
    compiler: str,
    repeats: int,
    gains: Sequence[Gain] = (),
    kept: str = "",
) -> str:
    """The page, `kept` below the mark. compiler: and its flags, or why there is no limit; gains: of less work."""
    lines = [
        "# Speed: this package, its limits and its peers",
        "",
        "    raytrace bench speed --docs docs",
        "",
        *_goals(ratios, sizes),
        "",
        *_definitions(ratios, compiler),
        "",
        "![Speed over number of rays](speed.png)",
        "",
        *_speeds(rows, sizes),
        "",
        f"Medians of {repeats} turns, all entrants in each, of {_clock(about)}; "
        + ", ".join(f"{name} {value}" for name, value in about.items())
        + ". All figures: [speed.csv](speed.csv).",
        *(_less_work(gains, sizes) if gains else ()),
    ]
    return page(lines, kept)


def _goals(ratios: Mapping, sizes: Sizes) -> list[str]:
    dtypes = list(ratios)
    head = "| what | target |" + "".join(f" {dtype} | met |" for dtype in dtypes)
    lines = [head, "| --- | --- |" + " --- | --- |" * len(dtypes)]
    for target in targets(sizes):
        cells = [target.words, f"{'≤' if target.at_most else '≥'} {target.bound:g}"]
        for dtype in dtypes:
            value = ratios[dtype].get(target.key)
            met = target.met(value) if dtype in target.dtypes else None
            cells += [_number(value), {True: "yes", False: "no", None: "–"}[met]]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _definitions(ratios: Mapping, compiler: str) -> list[str]:
    carried = ", ".join(f"{_number(n.get('sensor_step_gain_of_memo'))} in {dtype}" for dtype, n in ratios.items())
    memory = ", ".join(f"{numbers['bytes_per_ray_rays']:,} rays in {dtype}" for dtype, numbers in ratios.items())
    return [
        "A speed is rays × surfaces / s; the stop and the image are surfaces, the object is not. *Forward* is `trace` "
        "without gradient and without optical path, which Optiland alone computes all the same; *forward + backward* "
        "is the gradient of the mean squared spot radius by every curvature, thickness and index. *raytrace* chooses "
        "its engine by itself, *eager* is asked for. All trace 2¹⁶ or 2¹⁸ rays at a time, or all at once, whichever a "
        "trial finds faster. Of Optiland the loop over surfaces alone is timed; its numpy back end is float64 in both "
        "columns.",
        "",
        _limits(ratios, compiler),
        "",
        f"Peak memory: growth of the resident peak of a fresh process, {memory}. Sensor step: forward and gradient of "
        "the mean squared radius by the sensor distance, from the parabolas of the spots (`focus.spot_parabola`), "
        "beside tracing anew the same rays, launched beforehand, one object distance at a time; with a `Memo`, which "
        "carries every ray to the sensor and serves any merit, the gain is "
        f"{carried}. "
        "The bare imports are `import torch, matplotlib.pyplot`, "
        "processes in turns. Two processes trace at the same time, a thread each.",
        "",
        f"Errors beside the speeds: on the image, the largest of {SAMPLE} rays against a tracer of 50 digits that gets "
        "the same rounded numbers; of the gradient by curvatures and thicknesses, relative to its largest component.",
    ]


def _limits(ratios: Mapping, compiler: str) -> str:
    steps = {dtype: numbers.get("asphere_newton_steps") for dtype, numbers in ratios.items()}
    if None in steps.values():
        return f"No limits: {compiler}."
    counted = ", ".join(f"{count} in {dtype}" for dtype, count in steps.items())
    return (
        f"The limits are `raytrace/bench/limit.cpp`, built by {compiler}. *Safe* is the arithmetic of the eager trace "
        "(foot of the perpendicular, root that does not cancel, in float64 a polishing step, Snell without "
        "cancellation, renormalised directions, misses and total reflections told apart) by blocks that stay in the "
        "first cache; in float32 all of it is float32, where eager takes roots in float64. *Plain* is textbook algebra "
        "with nothing checked. Their output is allocated beforehand. On the aspheres the limit makes for every ray as "
        f"many steps of Newton's method as the slowest needs ({counted}; then comes the residual, in float64 another "
        "step), the own trace as many as its rays need."
    )


def _speeds(rows: Sequence[Row], sizes: Sizes) -> list[str]:
    lines = [
        "| what | dtype | rays | tracer | M/s | position error, nm | gradient error |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    fewest = {row.tracer: min(sizes.rays, max(r.rays for r in rows if r.tracer == row.tracer)) for row in rows}
    for row in rows:
        if row.rays not in (sizes.small, fewest[row.tracer]):
            continue
        cells = [_WHATS[row.what], row.dtype, f"{row.rays:,}", row.tracer, _number(row.speed / 1e6)]
        cells += [_number(row.position, 2), _number(row.gradient, 2) if row.what == "backward" else ""]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _less_work(gains: Sequence[Gain], sizes: Sizes) -> list[str]:
    lines = [
        "",
        "## Less work",
        "",
        "The same result with less work and with all of it, in turns: medians of processor time of one thread, "
        f"float64; double Gauss, {_power(sizes.less)} rays where rays are traced alone, kernels of 21 × 21 pixels of "
        "5 µm. The gain is the ratio of both times, the difference Σ |a - b| / Σ |b| of both results. A round lens is "
        "made to look like none by a field 10⁻¹² degrees off the axis, and half the pupil is compared with a field "
        "along x, columns and rows exchanged: there two rules of the same order stand beside each other, and the "
        "difference is that of their errors. Of a Gaussian the symmetry saves more than rays: without it its axes are "
        "not those of the pixels, whose integrals are then no products. Without a `Memo` rays are launched and traced "
        "anew.",
        "",
        "| what | engine | with, ms | without, ms | gain | difference |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in gains:
        times = (_number(1e3 * seconds) for seconds in (row.seconds, row.seconds_without))
        cells = [row.what, row.engine, *times, _number(row.gain), _number(row.error, 2)]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _number(value: float | None, digits: int = 3) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:,.0f}" if abs(value) >= 10 ** (digits - 1) else f"{value:.{digits}g}"


def _power(count: int) -> str:
    exponent = count.bit_length() - 1
    superscript = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
    return f"2{str(exponent).translate(superscript)}" if count == 2**exponent else f"{count:,}"


def _clock(about: Mapping[str, str | int]) -> str:
    return "processor time" if about["torch threads"] == 1 else "the time of day"
