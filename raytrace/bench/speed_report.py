"""The benchmark of speed in words: what was to be reached, what was measured, and every speed with its error."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

from raytrace.bench.report import clock_of, in_words, significant, table, yes

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


def targets(sizes) -> list[Target]:
    """What is to be reached, in the words of these numbers of rays (`speed.Sizes`)."""
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


def document(rows: Sequence, ratios: Mapping[str, Mapping[str, float | None]]) -> dict:
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


def lines(
    rows: Sequence, ratios: Mapping, gains: Sequence = (), *, sizes, about: Mapping, compiler: str, repeats: int
) -> list[str]:
    """The page. compiler: and its flags, or why there is no limit; gains: of less work."""
    return [
        "# Speed: this package, its limits and its peers",
        "",
        "    raytrace bench speed --docs docs",
        "",
        *_goals(ratios, sizes),
        "",
        _conditions(ratios, compiler),
        "",
        "![Speed over number of rays](speed.png)",
        "",
        *_speeds(rows, sizes),
        "",
        f"Medians of {repeats} turns, all entrants in each, of {clock_of(about)}; {in_words(about, ' ', ', ')}. All "
        "figures: [speed.csv](speed.csv).",
        *(_less_work(gains, sizes) if gains else ()),
    ]


def _goals(ratios: Mapping, sizes) -> list[str]:
    columns = {
        "what": lambda one: one.words,
        "target": lambda one: f"{'≤' if one.at_most else '≥'} {one.bound:g}",
    }
    for dtype, numbers in ratios.items():
        columns[dtype] = lambda one, found=numbers: significant(found.get(one.key))
        columns[f"met|{dtype}"] = lambda one, found=numbers, dtype=dtype: yes(
            one.met(found.get(one.key)) if dtype in one.dtypes else None
        )
    return table(columns, targets(sizes))


def _conditions(ratios: Mapping, compiler: str) -> str:
    """What of the conditions was found while measuring."""

    def each(key: str, words: str = "") -> str:
        return ", ".join(f"{significant(numbers.get(key))}{words} in {dtype}" for dtype, numbers in ratios.items())

    steps = [numbers.get("asphere_newton_steps") for numbers in ratios.values()]
    limits = f"No limits: {compiler}."
    if None not in steps:
        limits = (
            f"Limits: `raytrace/bench/limit.cpp`, built by {compiler}; steps of Newton's method on the aspheres: "
            f"{each('asphere_newton_steps')}."
        )
    return (
        f"{limits} Peak memory: of {each('bytes_per_ray_rays', ' rays')}. Gain of a sensor step that carries every ray "
        f"to the sensor (`Memo`) instead of parabolas: {each('sensor_step_gain_of_memo')}."
    )


def _speeds(rows: Sequence, sizes) -> list[str]:
    most = {row.tracer: min(sizes.rays, max(r.rays for r in rows if r.tracer == row.tracer)) for row in rows}
    columns = {
        "what": lambda row: _WHATS[row.what],
        "dtype": lambda row: row.dtype,
        "rays": lambda row: f"{row.rays:,}",
        "tracer": lambda row: row.tracer,
        "M/s": lambda row: significant(row.speed / 1e6),
        "position error, nm": lambda row: significant(row.position, 2),
        "gradient error": lambda row: significant(row.gradient, 2) if row.what == "backward" else "",
    }
    return table(columns, [row for row in rows if row.rays in (sizes.small, most[row.tracer])])


def _less_work(gains: Sequence, sizes) -> list[str]:
    columns = {
        "what": lambda row: row.what,
        "engine": lambda row: row.engine,
        "with, ms": lambda row: significant(1e3 * row.seconds),
        "without, ms": lambda row: significant(1e3 * row.seconds_without),
        "gain": lambda row: significant(row.gain),
        "difference": lambda row: significant(row.error, 2),
    }
    return [
        "",
        "## Less work",
        "",
        "The same result with less work and with all of it, in turns: medians of processor time of one thread, "
        f"float64; double Gauss, {_power(sizes.less)} rays where rays are traced alone, kernels of 21 × 21 pixels of "
        "5 µm. The gain is the ratio of both times, the difference Σ |a - b| / Σ |b| of both results.",
        "",
        *table(columns, gains),
    ]


def _power(count: int) -> str:
    exponent = count.bit_length() - 1
    superscript = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
    return f"2{str(exponent).translate(superscript)}" if count == 2**exponent else f"{count:,}"
