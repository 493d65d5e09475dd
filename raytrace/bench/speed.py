"""The targets of speed, measured in one run: this package, the limits of the machine and peers, in turns.

Every ratio is of medians of calls that were interleaved, so that a busy machine meets all alike; with one thread of
processor time, else of the time of day. A speed is rays × surfaces / s; surfaces are those a ray is carried to.
"""

import contextlib
import dataclasses
import itertools
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from raytrace.bench.limit import Built, Limit
from raytrace.bench.measure import SAMPLE, Errors, clock, errors_of, field_rays, surfaces_of
from raytrace.bench.speed_own import Engine, Repeated, three_aspheres, with_sensor_leaf
from raytrace.bench.speed_processes import bytes_per_ray, spot_process_ratio, two_process_gain
from raytrace.bench.tracers import Tracer, in_pieces, squared_radius
from raytrace.files import shipped
from raytrace.formats import read_lens
from raytrace.maths.pupil import sobol
from raytrace.maths.value import to
from raytrace.optics.focus import spot_parabola
from raytrace.optics.launch import rays_of_field
from raytrace.optics.reuse import Memo, trace_bundle
from raytrace.optics.trace import media, trace_surfaces
from raytrace.system.lens import Lens, with_object_distance
from raytrace.system.rays import Rays

DTYPES = (torch.float32, torch.float64)
_PIECE = 2**16
_PIECES = (_PIECE, 2**18)  # rays at a time that tracers are tried with, beside all at once
_MOST_OF_PEER = 3 * _PIECE  # rays whose graph a peer holds at once
_LARGEST_GRAPH = 4e9  # bytes
_MANY = 100  # steps timed together that take microseconds
_SHORTEST = 0.02  # s: shorter calls are timed many at a time
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
    """One figure. what: "forward", "backward" (forward + backward) or "asphere"; seconds: median; speed: see above;
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


#: A call to be timed, and what stands before it untimed.
Job = tuple[Callable[[], object], Callable[[], object]]


def double_gauss() -> Lens:
    return read_lens(shipped("lenses") / "double_gauss.zmx")


def measure(benches: Sequence[Bench], *, progress: Callable[[str], object] = lambda words: None) -> tuple[list, dict]:
    """Rows, and for each dtype its ratios by their fixed names.

    progress: called `stages(benches)` times, with what is measured next.
    """
    rows: list[Row] = []
    ratios: dict[str, dict[str, float | None]] = {}
    progress("spot")
    spot, spot_s, bare_s = spot_process_ratio(benches[0].repeats)
    for bench in benches:
        name = _name(bench.dtype)
        found: dict[str, float | None] = {}
        progress(f"{name}: memory")
        found["bytes_per_ray"], found["bytes_per_ray_rays"] = bytes_per_ray(
            bench.dtype, bench.sizes.memory, threads=bench.threads
        )
        for stage in (_forward, _backward, _small, _asphere, _sensor, _two_processes):
            progress(f"{name}: {stage.__name__.strip('_').replace('_', ' ')}")
            more, ratio = stage(bench, found)
            rows += more
            found |= ratio
        ratios[name] = found | {"spot_process_ratio": spot, "spot_s": spot_s, "bare_imports_s": bare_s}
    return rows, ratios


def stages(benches: Sequence[Bench]) -> int:
    return 1 + 7 * len(benches)


# -- the measurements: rows and ratios ---------------------------------------------------------------------------------


def _forward(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    """Without the optical path, which Optiland alone cannot leave out."""
    lens = double_gauss()
    tracers = [*_own(lens, bench.dtype), *_limits(lens, bench), *bench.peers]
    errors = {tracer.name: _errors(tracer, lens, bench.sizes.rays) for tracer in tracers}
    rows = []
    for count in sorted({*bench.sizes.counts, bench.sizes.rays}):
        rays = field_rays(lens, count)
        chosen = [tracer for tracer in tracers if count <= getattr(tracer, "most", count)]
        seconds = interleaved({one.name: _forward_job(one, rays, bench) for one in chosen}, bench)
        rows += _rows("forward", lens, count, chosen, seconds, errors, bench)
    last = {row.tracer: row.seconds for row in rows if row.rays == bench.sizes.rays}
    ratios = {"forward_over_limit": _over(last, "safe limit"), "forward_over_plain_limit": _over(last, "plain limit")}
    return rows, ratios | {"forward_over_optiland": _over(last, *_optiland(last)), "forward_s": last["raytrace"]}


def _backward(bench: Bench, found: Mapping) -> tuple[list[Row], dict]:
    """Forward + backward to every curvature, thickness and index; own forward once more beside it."""
    lens, count = double_gauss(), bench.sizes.rays
    rays, centroid = to(field_rays(lens, count), dtype=bench.dtype), torch.zeros(2, dtype=bench.dtype)
    own = Engine(lens, bench.dtype)
    most = max(_PIECE, int(_LARGEST_GRAPH / max(found["bytes_per_ray"], 1.0)))
    jobs = {own.name: _gradient_job(own, rays, centroid, bench, most), "forward": _forward_job(own, rays, bench)}
    tracers = [own, *(peer for peer in bench.peers if peer.has_gradient)]
    # Before the leaves of `gradient_by_all` take their places in a peer.
    errors = {one.name: _errors(one, lens, count, gradient=True) for one in tracers}
    jobs |= {one.name: _gradient_job(one, rays, centroid, bench, _MOST_OF_PEER) for one in tracers[1:]}
    seconds = interleaved(jobs, bench)
    return _rows("backward", lens, count, tracers, seconds, errors, bench), {
        "backward_over_forward": seconds[own.name] / seconds["forward"],
        "backward_over_optiland": _over(seconds, *_optiland(seconds)),
    }


def _small(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    """A few hundred rays, forward + backward, as in co-design."""
    lens, count = double_gauss(), bench.sizes.small
    rays, centroid = to(field_rays(lens, count), dtype=bench.dtype), torch.zeros(2, dtype=bench.dtype)
    tracers = [*_own(lens, bench.dtype), *(peer for peer in bench.peers if peer.has_gradient)]
    jobs = {one.name: (lambda one=one: one.gradient_by_all(rays, centroid), one.prepare) for one in tracers}
    seconds = interleaved(jobs, bench)
    return _rows("backward", lens, count, tracers, seconds, {}, bench), {
        "small_batch_ms": 1e3 * seconds["raytrace"],
        "small_batch_over_optiland": _over(seconds, *_optiland(seconds)),
    }


def _asphere(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    """The three aspheres, forward; the limit makes the steps of Newton's method that its slowest ray needs."""
    lens, count = three_aspheres(), bench.sizes.rays
    rays = field_rays(lens, count)
    steps = None if bench.built is None else newton_steps(bench, lens)
    tracers = [*_own(lens, bench.dtype), *bench.asphere_peers]
    if steps is not None:
        tracers.append(Limit(bench.built, lens, bench.dtype, safe=True, steps=steps, threads=bench.threads))
    errors = {one.name: _errors(one, lens, count) for one in tracers}
    seconds = interleaved({one.name: _forward_job(one, rays, bench) for one in tracers}, bench)
    return _rows("asphere", lens, count, tracers, seconds, errors, bench), {
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
        _slope(end, leaf)
        parabolas.append(torch.stack(spot_parabola(detached(end))))
    parabolas = torch.stack(parabolas, -1)
    with torch_threads(bench.threads):
        for _ in range(max(1, min(bench.repeats, 3))):
            turn = [0.0, 0.0]
            for bundle in bundles:
                turn = [a + b for a, b in zip(turn, _sensor_turn(bundle, leaf, memo, now), strict=True)]
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
    _slope(trace_surfaces(lens.surfaces[1:], rays, indices=media(lens, wavelength)), leaf)
    times.append(now())
    _slope(trace_bundle(bundle, memo), leaf)
    times.append(now())
    return [b - a for a, b in itertools.pairwise(times)]


def slope_of_parabolas(parabolas: Tensor, leaf: Tensor, start: float) -> Tensor:
    """The same, summed over spots, from their parabolas (3, D) about the sensor distance `start`."""
    constant, linear, square = parabolas
    shift = leaf - start
    return torch.autograd.grad((constant + 2 * shift * linear + shift * shift * square).sum(), leaf)[0]


def detached(rays: Rays) -> Rays:
    """The same rays without their graph."""
    return dataclasses.replace(rays, position=rays.position.detach(), direction=rays.direction.detach())


def _slope(rays: Rays, leaf: Tensor) -> Tensor:
    """Derivative of the mean squared spot radius by the sensor distance."""
    x, y = rays.position[0], rays.position[1]
    centroid = torch.stack([x.detach().mean(), y.detach().mean()])
    return torch.autograd.grad(squared_radius(x, y, centroid), leaf)[0]


def _two_processes(bench: Bench, _: Mapping) -> tuple[list[Row], dict]:
    sizes = bench.sizes
    gain, one, two = two_process_gain(bench.dtype, sizes.rays, seconds=sizes.window, repeats=bench.repeats)
    surfaces = surfaces_of(double_gauss())
    return [], {"two_process_gain": gain, "one_process_speed": one * surfaces, "two_process_speed": two * surfaces}


# -- timing ------------------------------------------------------------------------------------------------------------


def interleaved(jobs: Mapping[str, Job], bench: Bench) -> dict[str, float]:
    """Median seconds of each job, one call of each in turn; short calls many at a time."""
    calls = {}
    for name, job in jobs.items():
        _seconds(job, 1, bench.threads)  # warm up
        once = _seconds(job, 1, bench.threads)
        calls[name] = max(1, min(200, math.ceil(_SHORTEST / max(once, 1e-6))))
    taken: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(bench.repeats):
        for name, job in jobs.items():
            taken[name].append(_seconds(job, calls[name], bench.threads))
    return {name: statistics.median(seconds) for name, seconds in taken.items()}


def _seconds(job: Job, calls: int, threads: int) -> float:
    call, prepare = job
    with torch_threads(threads):
        prepare()
        now = clock(threads)
        began = now()
        for _ in range(calls):
            call()
        return (now() - began) / calls


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """So many threads of torch for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _forward_job(tracer: Tracer, rays: Rays, bench: Bench) -> Job:
    """Whole, or in pieces where a trial finds that faster."""
    rays, count = to(rays, dtype=tracer.dtype), rays.direction.shape[1]
    sizes = {min(count, size) for size in (*_PIECES, count)}
    return _faster({size: _in_pieces(tracer, rays, size, tracer.forward) for size in sizes}, bench)


def _gradient_job(tracer: Tracer, rays: Rays, centroid: Tensor, bench: Bench, most: int) -> Job:
    """The same of a gradient, of at most `most` rays at a time."""
    count = rays.direction.shape[1]
    sizes = {min(count, size, most) for size in (*_PIECES, most)}

    def gradient(part: Rays):
        return tracer.gradient_by_all(part, centroid)

    return _faster({size: _in_pieces(tracer, rays, size, gradient) for size in sizes}, bench)


def _in_pieces(tracer: Tracer, rays: Rays, size: int, function: Callable[[Rays], object]) -> Job:
    whole = size >= rays.direction.shape[1]
    return (lambda: function(rays)) if whole else (lambda: in_pieces(rays, size, function)), tracer.prepare


def _faster(jobs: Mapping[int, Job], bench: Bench) -> Job:
    if len(jobs) == 1:
        return next(iter(jobs.values()))
    for job in jobs.values():
        _seconds(job, 1, bench.threads)
    return min(jobs.values(), key=lambda job: min(_seconds(job, 1, bench.threads) for _ in range(2)))


# -- who takes part ----------------------------------------------------------------------------------------------------


def _own(lens: Lens, dtype: torch.dtype) -> list[Engine]:
    return [Engine(lens, dtype, engine) for engine in ("auto", "eager")]


def _limits(lens: Lens, bench: Bench) -> list[Limit]:
    if bench.built is None:
        return []
    return [Limit(bench.built, lens, bench.dtype, safe=safe, threads=bench.threads) for safe in (True, False)]


def _errors(tracer: Tracer, lens: Lens, count: int, *, gradient: bool = False) -> Errors:
    """Of `SAMPLE` rays against 50 digits; own rays in a batch as large as is timed (of a graph, at most 2¹⁶)."""
    copies = max(1, min(count, _PIECE) // SAMPLE) if isinstance(tracer, Engine) else 1
    return errors_of(Repeated(tracer, copies, has_gradient=gradient), lens, field_rays(lens, SAMPLE))


def _rows(
    what: str,
    lens: Lens,
    count: int,
    tracers: Sequence[Tracer],
    seconds: Mapping[str, float],
    errors: Mapping[str, Errors],
    bench: Bench,
) -> list[Row]:
    work, none = count * surfaces_of(lens), Errors(None, None, None)
    found = [(one.name, seconds[one.name], errors.get(one.name, none)) for one in tracers]
    return [
        Row(name, _name(bench.dtype), what, count, taken, work / taken, error.position, error.gradient)
        for name, taken, error in found
    ]


def _optiland(seconds: Mapping[str, float]) -> list[str]:
    return [name for name in seconds if name.startswith("Optiland")]


def _over(seconds: Mapping[str, float], *names: str) -> float | None:
    """Speed of this package over that of the fastest of these; None if there is none of them."""
    found = [seconds[name] for name in names if name in seconds]
    return min(found) / seconds["raytrace"] if found else None


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
