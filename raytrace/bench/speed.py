"""The targets of speed, measured in one run: this package, the limits of the machine and peers, in turns.

Every ratio is of medians of calls that were interleaved, so that a busy machine meets all alike; with one thread of
processor time, else of the time of day.
"""

import dataclasses
import itertools
import statistics
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from raytrace.bench import less_work, speed_report
from raytrace.bench.limit import Built, Limit, build
from raytrace.bench.measure import (
    DTYPES,
    SAMPLE,
    Errors,
    Job,
    Own,
    Tracer,
    clock,
    errors_of,
    field_rays,
    in_best_pieces,
    in_turns,
    name_of,
    nothing,
    slope,
    surfaces_of,
    with_sensor_leaf,
)
from raytrace.bench.processes import bytes_per_ray, spot_process_ratio, two_process_gain
from raytrace.bench.report import Asked, Measured
from raytrace.cli.progress import progress
from raytrace.cli.run import say
from raytrace.io import read_lens
from raytrace.maths.pupil import sobol
from raytrace.maths.value import to
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens, with_object_distance
from raytrace.system.prescription import lens as lens_of
from raytrace.system.rays import Rays
from raytrace.tracing.compiled import prepare
from raytrace.tracing.compiler import NoCompiler
from raytrace.tracing.focus import spot_parabola
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.scene import Memo, trace_bundle
from raytrace.tracing.trace import trace_lens

_PIECE = 2**16
_PIECES = (_PIECE, 2**18)  # rays at a time that tracers are tried with, beside all at once
_MOST_OF_PEER = 3 * _PIECE  # rays whose graph a peer holds at once
_LARGEST_GRAPH = 4e9  # bytes
_MANY = 100  # steps timed together that take microseconds
_MOST_STEPS = 12  # of Newton's method, by which every asphere has converged
#: mm on the image: what more steps of Newton's method may change where it has converged.
_CONVERGED = {torch.float32: 1e-5, torch.float64: 1e-12}


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is measured. rays: of the ratios; counts: of the figure; small: of the small batch; memory: rays of the
    peak; sensor: rays for each of `distances`; window: s of each turn of the processes; less: rays of `less_work`.
    """

    rays: int = 2**20
    counts: tuple[int, ...] = (2**8, 2**10, 2**12, 2**14, 2**16, 2**18, 2**20)
    small: int = 328
    memory: int = 2**22
    sensor: int = 2**20
    distances: int = 41
    window: float = 1.0
    less: int = 2**18


QUICK = Sizes(2**16, (2**8, 2**12, 2**16), memory=2**18, sensor=2**14, distances=5, window=0.2, less=2**14)


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure. what: "forward", "backward" (forward + backward) or "asphere"; seconds: median; speed: see `measure`;
    position: largest error on the image, nm; gradient: see `measure.Errors`.
    """

    tracer: str
    dtype: str
    what: str
    rays: int
    seconds: float
    speed: float
    position: float | None
    gradient: float | None


@dataclasses.dataclass(frozen=True)
class Bench:
    """What all measurements of one dtype share. peers: of the double Gauss and of the aspheres."""

    dtype: torch.dtype
    sizes: Sizes
    repeats: int
    threads: int
    built: Built | None
    peers: Sequence[Tracer] = ()
    asphere_peers: Sequence[Tracer] = ()

    def medians(self, jobs: Mapping[str, Job]) -> dict[str, float]:
        """Median seconds of each job, in turns."""
        taken = in_turns(jobs, repeats=self.repeats, threads=self.threads)
        return {name: statistics.median(seconds) for name, seconds in taken.items()}


def bench(asked: Asked) -> Measured:
    """All targets, and what less work saves."""
    sizes, (built, compiler) = QUICK if asked.arguments.quick else Sizes(), _built()
    repeats, peers = asked.arguments.repeats, asked.peers
    lenses = double_gauss(), three_aspheres()
    rivals = {dtype: [peers.rivals(lens, dtype) for lens in lenses] if peers else [] for dtype in DTYPES}
    benches = [Bench(dtype, sizes, repeats, asked.threads, built, *rivals[dtype]) for dtype in DTYPES]
    with progress(stages(benches) + len(less_work.cases(sizes)), what="measuring") as bar:

        def show(words: str) -> None:
            bar.set_postfix_str(words)
            bar.update()

        rows, ratios = measure(benches, progress=show)
        gains = less_work.measure(sizes, repeats=repeats, progress=show)
    about = {"machine": asked.about(), "compiler": compiler, "repeats": repeats, "sizes": sizes.__dict__}
    lines = speed_report.lines(
        rows, ratios, gains, sizes=sizes, about=about["machine"], compiler=compiler, repeats=repeats
    )
    found = speed_report.document(rows, ratios) | about | {"less_work": [dataclasses.asdict(gain) for gain in gains]}
    return Measured(rows, lines, found, ("speed_figure",), ("speed.md", "speed"))


def _built() -> tuple[Built | None, str]:
    """The limits and how they were built; or none, and why not."""
    try:
        built = build()
    except NoCompiler as error:
        say(f"{error}: without limits")
        return None, str(error)
    say(f"limits built by {built.words}")
    return built, f"{built.compiler} with `{' '.join(built.flags)}`"


def measure(benches: Sequence[Bench], *, progress: Callable[[str], object] = nothing) -> tuple[list, dict]:
    """Rows, and for each dtype its ratios by their fixed names.

    progress: called `stages(benches)` times, with what is measured next.
    """
    rows: list[Row] = []
    ratios: dict[str, dict[str, float | None]] = {}
    progress("spot")
    names = ("spot_process_ratio", "spot_s", "bare_imports_s")
    spot = dict(zip(names, spot_process_ratio(benches[0].repeats), strict=True))
    for bench in benches:
        name = name_of(bench.dtype)
        found: dict[str, float | None] = {}
        for stage in _STAGES:
            progress(f"{name}: {stage.__name__.strip('_').replace('_', ' ')}")
            more, ratio = stage(bench, found)
            rows += more
            found |= ratio
        ratios[name] = found | spot
    return rows, ratios


def stages(benches: Sequence[Bench]) -> int:
    return 1 + len(_STAGES) * len(benches)


# -- the measurements: rows and ratios ---------------------------------------------------------------------------------


def _memory(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    peak, rays = bytes_per_ray(bench.dtype, bench.sizes.memory, threads=bench.threads)
    return [], {"bytes_per_ray": peak, "bytes_per_ray_rays": rays}


def _forward(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    """Without the optical path, which Optiland alone cannot leave out."""
    lens = double_gauss()
    tracers = [*_own(lens, bench.dtype), *_limits(lens, bench), *bench.peers]
    errors = {tracer.name: _errors(tracer, lens, bench.sizes.rays) for tracer in tracers}
    rows = []
    for count in sorted({*bench.sizes.counts, bench.sizes.rays}):
        rays = field_rays(lens, count)
        chosen = [tracer for tracer in tracers if count <= getattr(tracer, "most", count)]
        rows += _rows("forward", lens, count, bench.medians(_forward_jobs(chosen, rays, bench)), errors, bench)
    last = {row.tracer: row.seconds for row in rows if row.rays == bench.sizes.rays}
    ratios = {"forward_over_limit": _over(last, "safe limit"), "forward_over_plain_limit": _over(last, "plain limit")}
    return rows, ratios | {"forward_over_optiland": _over(last, *_optiland(last)), "forward_s": last["raytrace"]}


def _backward(bench: Bench, found: Mapping) -> tuple[list[Row], dict]:
    """Forward + backward to every curvature, thickness and index; own forward once more beside it."""
    lens, count = double_gauss(), bench.sizes.rays
    rays, centroid = to(field_rays(lens, count), dtype=bench.dtype), torch.zeros(2, dtype=bench.dtype)
    own = Own(lens, bench.dtype, engine="auto", by_indices=True)
    tracers = [own, *(peer for peer in bench.peers if peer.has_gradient)]
    errors = {one.name: _errors(one, lens, count, gradient=True) for one in tracers}
    most = {own: max(_PIECE, int(_LARGEST_GRAPH / max(found["bytes_per_ray"], 1.0)))}
    jobs = {"forward": _forward_jobs([own], rays, bench)[own.name]}
    for one in tracers:
        gradient, largest = (lambda part, one=one: one.gradient(part, centroid)), most.get(one, _MOST_OF_PEER)
        jobs[one.name], _ = in_best_pieces(
            gradient, rays, one.prepare, sizes=_PIECES, threads=bench.threads, most=largest
        )
    seconds = bench.medians(jobs)
    return _rows("backward", lens, count, {one.name: seconds[one.name] for one in tracers}, errors, bench), {
        "backward_over_forward": seconds[own.name] / seconds["forward"],
        "backward_over_optiland": _over(seconds, *_optiland(seconds)),
    }


def _small(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    """A few hundred rays, forward + backward, as in co-design."""
    lens, count = double_gauss(), bench.sizes.small
    rays, centroid = to(field_rays(lens, count), dtype=bench.dtype), torch.zeros(2, dtype=bench.dtype)
    tracers = [*_own(lens, bench.dtype), *(peer for peer in bench.peers if peer.has_gradient)]
    seconds = bench.medians({one.name: (lambda one=one: one.gradient(rays, centroid), one.prepare) for one in tracers})
    return _rows("backward", lens, count, seconds, {}, bench), {
        "small_batch_ms": 1e3 * seconds["raytrace"],
        "small_batch_over_optiland": _over(seconds, *_optiland(seconds)),
    }


def _asphere(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    """The three aspheres, forward; the limit makes the steps of Newton's method that its slowest ray needs."""
    lens, count = three_aspheres(), bench.sizes.rays
    steps = None if bench.built is None else newton_steps(bench, lens)
    tracers = [*_own(lens, bench.dtype), *bench.asphere_peers]
    if steps is not None:
        tracers.append(Limit(bench.built, lens, bench.dtype, safe=True, steps=steps, threads=bench.threads))
    errors = {one.name: _errors(one, lens, count) for one in tracers}
    seconds = bench.medians(_forward_jobs(tracers, field_rays(lens, count), bench))
    return _rows("asphere", lens, count, seconds, errors, bench), {
        "asphere_over_limit": _over(seconds, "safe limit"),
        "asphere_over_optiland": _over(seconds, *_optiland(seconds)),
        "asphere_newton_steps": steps,
    }


def newton_steps(bench: Bench, lens: Lens) -> int:
    """The least number of steps of the limit after which more of them change nothing on the image but rounding."""
    rays = to(field_rays(lens, 4096), dtype=bench.dtype)

    def end(steps: int) -> Tensor:
        limit = Limit(bench.built, lens, bench.dtype, safe=True, steps=steps, threads=1)
        return limit.trace(rays).position.clone()

    settled, bound = end(_MOST_STEPS), _CONVERGED[bench.dtype]
    close = (steps for steps in range(_MOST_STEPS) if float((end(steps) - settled).abs().max()) < bound)
    return next(close, _MOST_STEPS)


def _sensor(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    """One step of optimising the sensor distance over many object distances: from parabolas, with a `Memo`, retraced.

    Gain: time of tracing launched rays anew over that of the step from the spots' parabolas (`focus.spot_parabola`),
    and over that of carrying every ray of a memo to the sensor.
    """
    lens, leaf = with_sensor_leaf(to(double_gauss(), dtype=bench.dtype))
    distances = torch.linspace(10e3, 50e3, bench.sizes.distances, dtype=torch.float64).tolist()
    pupil = sobol(bench.sizes.sensor)[0].to(bench.dtype)
    field = torch.stack([lens.fields.x, lens.fields.y])[:, len(lens.fields.x) // 2, None]
    bundles = [(with_object_distance(lens, distance), field, lens.wavelengths[0], pupil) for distance in distances]
    memo, taken, now = Memo(), [], clock(bench.threads)
    parabolas = []
    for bundle in bundles:
        end = trace_bundle(bundle, memo)  # fills the memo
        slope(end, leaf)
        parabolas.append(torch.stack(spot_parabola(detached(end))))
    parabolas = torch.stack(parabolas, -1)
    with torch_threads(bench.threads):
        for _ in range(max(1, min(bench.repeats, 3))):
            turns = (_sensor_turn(bundle, leaf, memo, now) for bundle in bundles)
            turn = [sum(times) for times in zip(*turns, strict=True)]
            began = now()
            for _ in range(_MANY):
                slope_of_parabolas(parabolas, leaf, float(leaf.detach()))
            taken.append([*turn, (now() - began) / _MANY])
    retraced, kept, summed = (statistics.median(column) for column in zip(*taken, strict=True))
    gains = {"sensor_step_gain": retraced / summed, "sensor_step_gain_of_memo": retraced / kept}
    return [], gains | {"sensor_step_s": summed, "sensor_rays": bench.sizes.sensor, "sensor_distances": len(distances)}


def _sensor_turn(bundle: tuple, leaf: Tensor, memo: Memo, now: Callable[[], float]) -> list[float]:
    """Seconds of retracing and of the step with a memo."""
    lens, field, wavelength, pupil = bundle
    with torch.no_grad():
        rays = rays_of_field(lens, field, pupil, wavelength=wavelength)
    times = [now()]
    slope(trace_lens(lens, rays, wavelength), leaf)
    times.append(now())
    slope(trace_bundle(bundle, memo), leaf)
    times.append(now())
    return [b - a for a, b in itertools.pairwise(times)]


def slope_of_parabolas(parabolas: Tensor, leaf: Tensor, start: float) -> Tensor:
    """The same by the sensor distance, summed over spots, from their parabolas (3, D) about the distance `start`."""
    constant, linear, square = parabolas
    shift = leaf - start
    return torch.autograd.grad((constant + 2 * shift * linear + shift * shift * square).sum(), leaf)[0]


def detached(rays: Rays) -> Rays:
    """The same rays without their graph."""
    return dataclasses.replace(rays, position=rays.position.detach(), direction=rays.direction.detach())


def _two_processes(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    sizes, surfaces = bench.sizes, surfaces_of(double_gauss())
    gain, one, two = two_process_gain(bench.dtype, sizes.rays, seconds=sizes.window, repeats=bench.repeats)
    return [], {"two_process_gain": gain, "one_process_speed": one * surfaces, "two_process_speed": two * surfaces}


_STAGES = (_memory, _forward, _backward, _small, _asphere, _sensor, _two_processes)

# -- who takes part ----------------------------------------------------------------------------------------------------


def double_gauss() -> Lens:
    return read_lens("double_gauss")


def three_aspheres() -> Lens:
    """Three strong even aspheres (r⁴ to r¹⁰), 14 mm at F/1.8, 10 degrees off the axis.

    At the rim of the beam their terms move the sag by 0.8, 0.9 and 0.3 mm, and bend it by 37, 39 and 18 degrees.
    """
    rows = (
        (0.09, -0.8, (0.0, 3.2e-3, -8e-5, 2.4e-6, -1.6e-8), 4.0, 1.53),
        (-0.02, 0.5, (0.0, -4.8e-3, 1.2e-4, -3.2e-6, 2.4e-8), 3.0, 1.64),
        (-0.05, -1.5, (0.0, 3.6e-3, -1.2e-4, 2.8e-6, -2e-8), 14.0, 1.0),
    )
    names = ("curvature", "conic", "coefficients", "thickness", "glass")
    surfaces = [dict(zip(names, row, strict=True)) | {"semi_diameter": 5.0} for row in rows]
    return lens_of(surfaces, stop=1, entrance_pupil_diameter=8.0, fields=[10.0], wavelengths=[0.55])


def _own(lens: Lens, dtype: torch.dtype) -> list[Own]:
    prepare()
    return [Own(lens, dtype, engine=engine, by_indices=True) for engine in ("auto", "eager")]


def _limits(lens: Lens, bench: Bench) -> list[Limit]:
    if bench.built is None:
        return []
    return [Limit(bench.built, lens, bench.dtype, safe=safe, threads=bench.threads) for safe in (True, False)]


def _forward_jobs(tracers: Sequence[Tracer], rays: Rays, bench: Bench) -> dict[str, Job]:
    """Whole, or in pieces where a trial finds that faster."""
    return {
        one.name: in_best_pieces(
            one.forward, to(rays, dtype=one.dtype), one.prepare, sizes=_PIECES, threads=bench.threads
        )[0]
        for one in tracers
    }


def _errors(tracer: Tracer, lens: Lens, count: int, *, gradient: bool = False) -> Errors:
    """Of `SAMPLE` rays against 50 digits; own rays in a batch as large as is timed (of a graph, at most 2¹⁶)."""
    copies = max(1, min(count, _PIECE) // SAMPLE) if isinstance(tracer, Own) else 1
    return errors_of(tracer, lens, field_rays(lens, SAMPLE), copies=copies, gradient=gradient)


def _rows(what: str, lens: Lens, count: int, seconds: Mapping[str, float], errors: Mapping, bench: Bench) -> list[Row]:
    work, none = count * surfaces_of(lens), Errors(None, None, None)
    found = [(name, taken, errors.get(name, none)) for name, taken in seconds.items()]
    return [
        Row(name, name_of(bench.dtype), what, count, taken, work / taken, error.position, error.gradient)
        for name, taken, error in found
    ]


def _optiland(seconds: Mapping[str, float]) -> list[str]:
    return [name for name in seconds if name.startswith("Optiland")]


def _over(seconds: Mapping[str, float], *names: str) -> float | None:
    """Speed of this package over that of the fastest of these; None if there is none of them."""
    found = [seconds[name] for name in names if name in seconds]
    return min(found) / seconds["raytrace"] if found else None
