"""Speed of the trace against targets: peers (`bench_ratios.py`), limits of the machine and whole processes.

    python docs/experiments/bench_speed.py --threads 2 --docs docs

The limits are bench_limit.cpp, built by the compiler of this machine: without allocation, dispatch or
gradients. Whole processes measure peak memory, the time of a command, and two traces at once.
"""

import argparse
import contextlib
import ctypes
import dataclasses
import math
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import bench_kit as kit
import bench_ratios as speed
import torch
from bench_figures import speed_figure
from bench_kit import Page, Request
from bench_reference import shape_of
from pages import listing, significant
from torch import Tensor

from raytrace.bench.measure import Row, Tracer, field_rays, name_of, some, surfaces_of
from raytrace.cli.progress import progress
from raytrace.cli.runner import say
from raytrace.io import read_lens
from raytrace.maths.numerics import to
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.system.surface import is_even
from raytrace.tracing.compiled import prepare
from raytrace.tracing.compiler import NoCompiler, compiler, private_folder, run_compiler

#: Ratio, its words in addition to those of `speed.WORDS`, its bound, and whether that is the largest allowed.
TARGETS = (
    ("forward_over_limit", "forward, {rays} rays, double Gauss: speed over the safe limit", 0.7, False),
    ("forward_over_optiland", "… over Optiland's best back end", 25, False),
    ("backward_over_forward", "", 4, True),
    ("backward_over_optiland", "", 15, False),
    ("bytes_per_ray", "its peak memory above the inputs, bytes a ray", 120, True),
    ("small_batch_ms", "", 0.5, True),
    ("small_batch_over_optiland", "", 20, False),
    ("asphere_over_limit", "three strong even aspheres, {rays} rays: speed over the safe limit", 0.5, False),
    ("asphere_over_optiland", "… over Optiland's best back end", 15, False),
    ("sensor_step_gain", "", 10, False),
    ("spot_process_ratio", "process of `raytrace spot` over that of the bare imports", 1.3, True),
    ("two_process_gain", "two processes of one thread over one", 1.7, False),
)
MEMORY, WINDOW = {False: 2**22, True: 2**18}, {False: 1.0, True: 0.2}  # rays of the peak, s of a turn; by --quick


def met(key: str, bound: float, at_most: bool, dtype: str, value: float | None) -> bool | None:
    """Whether a target is met; None if it is not measured. Peak memory is a target in float32 only."""
    if value is None or not math.isfinite(value) or (key == "bytes_per_ray" and dtype != "float32"):
        return None
    return value <= bound if at_most else value >= bound


def bench(request: Request) -> Page:
    """Speeds, limits and whole processes."""
    quick, repeats, threads = request.arguments.quick, request.arguments.repeats, request.threads
    sizes = speed.QUICK if quick else speed.Sizes()
    try:
        built = build()
        compiled = built.words
    except NoCompiler as error:
        built, compiled = None, str(error)
    say(f"limits: {compiled}")
    benches = speed.benches_of(request, sizes)
    steps = [with_limits(bench, built) for bench in benches]
    with progress((len(speed.STAGES) + 2) * len(benches), what="measuring") as bar:
        rows, ratios = speed.measure([bench for bench, _ in steps], progress=bar.update)
        spot = dict(zip(("spot_process_ratio", "spot_s", "bare_imports_s"), spot_process_ratio(repeats), strict=True))
        for bench, newton in steps:
            values = ratios[name_of(bench.dtype)]
            values |= of_limits(rows, name_of(bench.dtype), sizes) | spot | {"asphere_newton_steps": newton}
            values["bytes_per_ray"], values["bytes_per_ray_rays"] = bytes_per_ray(
                bench.dtype, MEMORY[quick], threads=threads
            )
            bar.update()
            gain, one, two = two_process_gain(bench.dtype, sizes.rays, seconds=WINDOW[quick], repeats=repeats)
            count = surfaces_of(speed.double_gauss())
            values |= {"two_process_gain": gain, "one_process_speed": one * count, "two_process_speed": two * count}
            bar.update()
    about = {"machine": request.about(), "compiler": compiled, "repeats": repeats, "sizes": dataclasses.asdict(sizes)}
    page = lines(ratios, sizes=sizes, about=about["machine"], compiled=compiled, repeats=repeats)
    return Page(rows, page, speed.document(rows, ratios) | about, speed_figure, ("speed.md", "speed"))


def with_limits(bench: speed.Bench, built: "Built | None") -> tuple[speed.Bench, int | None]:
    """The limits as peers, and the steps of Newton's method on the aspheres."""
    if built is None:
        return bench, None
    lenses, how = (speed.double_gauss(), speed.three_aspheres()), {"threads": bench.threads}
    steps = newton_steps(built, lenses[1], bench.dtype)
    spheres = [Limit(built, lenses[0], bench.dtype, safe=safe, **how) for safe in (True, False)]
    asphere = Limit(built, lenses[1], bench.dtype, safe=True, steps=steps, **how)
    peers = {"peers": [*bench.peers, *spheres], "asphere_peers": [*bench.asphere_peers, asphere]}
    return dataclasses.replace(bench, **peers), steps


def of_limits(rows: Sequence[Row], dtype: str, sizes: speed.Sizes) -> dict[str, float | None]:
    """Speeds of this package relative to the limits."""

    def over(what: str, name: str) -> float | None:
        return speed.over([row for row in rows if (row.dtype, row.what, row.rays) == (dtype, what, sizes.rays)], name)

    keys = {"forward_over_limit": ("forward", "safe"), "forward_over_plain_limit": ("forward", "plain")}
    return {key: over(*which) for key, which in (keys | {"asphere_over_limit": ("asphere", "safe")}).items()}


def lines(ratios: Mapping, *, sizes: speed.Sizes, about: Mapping, compiled: str, repeats: int) -> list[str]:
    """The page. compiled: compiler and flags of the limits, or why there are none."""
    numbers = speed.sizes_in_words(sizes)
    columns = {
        "what": lambda goal: (goal[1] or speed.WORDS[goal[0]]).format(**numbers),
        "target": lambda goal: f"{'≤' if goal[3] else '≥'} {goal[2]:g}",
    }
    for dtype, values in ratios.items():
        columns[dtype] = lambda goal, values=values, dtype=dtype: (
            significant(values[goal[0]])
            + (" (missed)" if met(goal[0], goal[2], goal[3], dtype, values[goal[0]]) is False else "")
        )

    def each(key: str, words: str = "") -> str:
        return ", ".join(f"{significant(values[key])}{words} in {dtype}" for dtype, values in ratios.items())

    return [
        *("# Speed of the compiled trace: limits of the machine and peers", ""),
        *_answer(ratios),
        *(f"    python docs/experiments/bench_speed.py --threads {about['torch threads']} --docs docs", ""),
        *listing(columns, TARGETS),
        "",
        f"Limits: `docs/experiments/bench_limit.cpp`, {compiled}; steps of Newton's method on the aspheres: "
        f"{each('asphere_newton_steps')}. Peak memory: of {each('bytes_per_ray_rays', ' rays')}.",
        "",
        *speed.figure_lines(about, repeats),
    ]


def _answer(ratios: Mapping) -> list[str]:
    """The first sentence: speeds over Optiland's, for every dtype; none without Optiland."""
    keys = ("forward_over_optiland", "backward_over_optiland")
    known = {dtype: [values[key] for key in keys] for dtype, values in ratios.items()}
    if not known or any(value is None or not math.isfinite(value) for values in known.values() for value in values):
        return []
    words = " and ".join(
        f"{significant(ahead)} times as fast as Optiland's best back end in {dtype}, {significant(both)} times with "
        "gradients"
        for dtype, (ahead, both) in known.items()
    )
    return [f"The trace of a double Gauss is {words}.", ""]


# -- limits of the machine ---------------------------------------------------------------------------------------------

#: Vectorised roots and comparisons, which errno and traps would forbid; arithmetic is the same. Flags that a compiler
#: refuses are left out.
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math")
_WIDEST, _THREADS = "-mprefer-vector-width=512", "-fopenmp"
_TERMS = 8
MOST_STEPS = 24
_PLANE, _SPHERE, _ASPHERE = range(3)
_SETTLED = 12  # steps of Newton's method, by which every asphere has converged
#: mm on the image: differences of results that have converged.
_CONVERGED = {torch.float32: 1e-5, torch.float64: 1e-12}


class _Surface(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int32) for name in ("kind", "bends", "terms", "reserved")),
        *((name, ctypes.c_double) for name in ("gap", "curvature", "shape", "before", "behind")),
        ("coefficients", ctypes.c_double * _TERMS),
    )


@dataclasses.dataclass(frozen=True)
class Built:
    """The compiled limits, and how they were built."""

    library: ctypes.CDLL
    compiler: str
    flags: tuple[str, ...]

    @property
    def words(self) -> str:
        return f"{self.compiler} with `{' '.join(self.flags)}`"


def build(named: str | None = None) -> Built:
    """Compile the limits. named: the compiler, as `compiler` takes it. Raises NoCompiler."""
    program = compiler(named)
    try:
        with private_folder() as folder:
            for flags in ((*FLAGS, _WIDEST, _THREADS), (*FLAGS, _THREADS), FLAGS):
                made = _compiled(program, flags, folder)
                if isinstance(made, ctypes.CDLL):
                    version = run_compiler(*program, "--version", folder=folder).stdout
                    return Built(made, version.splitlines()[0] if version else program[0], flags)
    except OSError as error:
        raise NoCompiler(f"the limits cannot be built: {error}") from None
    raise NoCompiler(f"{' '.join(program)} does not build the limits: {made}")


def _compiled(program: Sequence[str], flags: Sequence[str], folder: Path) -> ctypes.CDLL | str:
    """The limits, or an error. Linked without -fopenmp: threads are torch's, as of the compiled trace."""
    source, compiled, file = (
        Path(__file__).with_name("bench_limit.cpp").absolute(),
        folder / "limit.o",
        folder / "limit.so",
    )
    for words in (["-std=c++17", *flags, "-fPIC", "-c", source, "-o", compiled], ["-shared", compiled, "-o", file]):
        done = run_compiler(*program, *map(str, words), folder=folder)
        if done.returncode:
            return done.stderr.strip().splitlines()[0] if done.stderr.strip() else f"exit {done.returncode}"
    try:
        return ctypes.CDLL(str(file))
    except OSError as error:
        return str(error)


class Limit(Tracer):
    """A lens in the limits. safe: with the arithmetic of the trace, else the plain one (see `bench_limit.cpp`).

    steps: of Newton's method on aspheres. Raises ValueError for mirrors, apertures, added sag, conics without aspheric
    terms, and aspheres in the plain one.
    """

    with_path, has_gradient = False, False

    def __init__(self, built: Built, lens: Lens, dtype: torch.dtype, *, safe: bool, steps: int = 0, threads: int = 1):
        if not 0 <= steps <= MOST_STEPS:
            raise ValueError(f"{steps} steps of Newton's method: expected 0 to {MOST_STEPS}")
        self.name = "safe limit" if safe else "plain limit"
        self.dtype, self.safe, self.steps, self.threads = dtype, safe, steps, threads
        lens = to(lens, dtype=dtype)
        self._surfaces = _surfaces(lens, safe)
        self._call = getattr(built.library, f"trace_{name_of(dtype)}")
        self._call.restype = None
        self._out: Rays | None = None

    def forward(self, rays: Rays) -> tuple[Tensor, None]:
        return self.trace(rays).position[:2], None

    def trace(self, rays: Rays) -> Rays:
        """The rays (3, P) behind the last surface, in the memory of the previous result."""
        position, direction, valid = (a.contiguous() for a in (rays.position, rays.direction, rays.valid))
        if position.dtype != self.dtype or direction.dtype != self.dtype or position.dim() != 2:
            raise ValueError(f"rays {tuple(position.shape)} of {position.dtype}: expected (3, P) of {self.dtype}")
        if self._out is None or self._out.position.shape != position.shape:
            self._out = Rays(torch.zeros_like(position), torch.zeros_like(direction), torch.zeros_like(valid))
        tensors = (position, direction, valid, self._out.position, self._out.direction, self._out.valid)
        self._call(
            self._surfaces,
            len(self._surfaces),
            *(ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors),
            ctypes.c_int64(position.shape[1]),
            self.steps,
            int(not self.safe),
            self.threads,
        )
        return self._out


def _surfaces(lens: Lens, safe: bool) -> ctypes.Array:
    indices = media(lens, lens.primary)
    gaps = [0.0, *(float(surface.thickness) for surface in lens.surfaces[1:-1])]  # rays start at the first surface
    rows = zip(lens.surfaces[1:], gaps, indices[:-1], indices[1:], strict=True)
    surfaces = []
    for number, (surface, gap, before, behind) in enumerate(rows, 1):
        conic_alone = surface.conic is not None and surface.coefficients is None
        if surface.is_mirror or surface.apertures or not is_even(surface) or conic_alone:
            raise ValueError(f"surface {number}: the limits know planes, spheres and even aspheres that refract")
        curvature, conic, a = shape_of(surface, number)
        if len(a) > _TERMS or (a and not safe):
            raise ValueError(f"surface {number}: the limits know up to {_TERMS if safe else 0} aspheric terms")
        kind, bends, rest = _PLANE if surface.is_plane else _ASPHERE if a else _SPHERE, int(behind is not before), 0
        numbers = gap, curvature, 1 + conic, float(before), float(behind), (ctypes.c_double * _TERMS)(*a)
        surfaces.append(_Surface(kind, bends, len(a), rest, *numbers))
    return (_Surface * len(surfaces))(*surfaces)


def newton_steps(built: Built, lens: Lens, dtype: torch.dtype) -> int:
    """The least number of steps of the limit whose result further steps change by rounding only."""
    rays = to(field_rays(lens, 4096), dtype=dtype)

    def end(steps: int) -> Tensor:
        return Limit(built, lens, dtype, safe=True, steps=steps).trace(rays).position.clone()

    settled, most = end(_SETTLED), _CONVERGED[dtype]
    close = (steps for steps in range(_SETTLED) if float((end(steps) - settled).abs().max()) < most)
    return next(close, _SETTLED)


# -- whole processes ---------------------------------------------------------------------------------------------------

_PATTERN = 2**12  # rays that are repeated: launching more would set the peak
_WARM_UP = 2**14
_MOST_BYTES = 4 * 2**30
_SPOT = ("-m", "raytrace", "spot", "lenses/double_gauss.zmx")
_BARE = ("-c", "import torch, matplotlib.pyplot")
_SAFE = "-P"  # no modules of the current folder


def bytes_per_ray(dtype: torch.dtype, rays: int, *, threads: int) -> tuple[float, int]:
    """Peak memory of forward + backward above the inputs, bytes a ray, and of how many rays.

    A 32nd of the rays is traced first, and all if they need at most 4 GiB.
    """
    few = max(4 * _WARM_UP, rays // 32)
    peak = _peak(dtype, few, threads)
    return (peak, few) if rays <= few or peak * rays > _MOST_BYTES else (_peak(dtype, rays, threads), rays)


def spot_process_ratio(repeats: int) -> tuple[float, float, float]:
    """Time of `raytrace spot` over that of the bare imports, processes in turns; then both medians, s."""
    times: dict[tuple[str, ...], list[float]] = {_SPOT: [], _BARE: []}
    for turn in range(repeats + 1):
        for words, seconds in times.items():
            start = time.perf_counter()
            subprocess.run([sys.executable, _SAFE, *words], env=_environment(), stdout=subprocess.DEVNULL, check=True)
            if turn:  # the first brings the files into memory
                seconds.append(time.perf_counter() - start)
    spot, bare = (statistics.median(seconds) for seconds in times.values())
    return spot / bare, spot, bare


def two_process_gain(dtype: torch.dtype, rays: int, *, seconds: float, repeats: int) -> tuple[float, float, float]:
    """Rays a second of two processes of one thread over those of one; then both, rays/s. Medians, in turns."""
    with _worker("serve_rate", dtype, rays, 1) as first, _worker("serve_rate", dtype, rays, 1) as second:
        for worker in (first, second):
            _read(worker)
        turns = [(sum(_rates([first], seconds)), sum(_rates([first, second], seconds))) for _ in range(repeats)]
    one, two = (statistics.median(rates) for rates in zip(*turns, strict=True))
    return two / one, one, two


def serve_memory(dtype: str, rays: int, threads: int) -> None:
    """Print the growth of the peak in bytes a ray."""
    torch.set_num_threads(threads)
    tracer, batch = _tracer_and_rays(dtype, rays)
    centroid = torch.zeros(2, dtype=tracer.dtype)
    few = some(batch, lambda x: x[..., :_WARM_UP].clone())
    for _ in range(2):
        tracer.gradient(few, centroid)
    # Pages of the inputs that were swapped out would count.
    float(batch.position.sum() + batch.direction.sum())
    before = _peak_from_now()
    tracer.gradient(batch, centroid)
    print((_highest() - before) / rays, flush=True)


def serve_rate(dtype: str, rays: int, threads: int) -> None:
    """For every line of the input, trace for that many seconds and print rays a second."""
    torch.set_num_threads(threads)
    tracer, batch = _tracer_and_rays(dtype, rays)
    for _ in range(2):
        tracer.forward(batch)
    print("ready", flush=True)
    for line in sys.stdin:
        start, done = time.perf_counter(), 0
        while time.perf_counter() - start < float(line):
            tracer.forward(batch)
            done += rays
        print(done / (time.perf_counter() - start), flush=True)


def _tracer_and_rays(dtype: str, count: int) -> tuple[Tracer, Rays]:
    prepare()
    lens = read_lens("double_gauss")
    tracer = speed.EngineTracer(lens, getattr(torch, dtype), engine="auto")
    few = to(field_rays(lens, _PATTERN), dtype=tracer.dtype)
    position, direction = (torch.empty(3, count, dtype=tracer.dtype) for _ in range(2))
    for first in range(0, count, _PATTERN):
        width = min(_PATTERN, count - first)
        position[:, first : first + width] = few.position[:, :width]
        direction[:, first : first + width] = few.direction[:, :width]
    return tracer, Rays(position, direction, torch.ones(count, dtype=torch.bool))


def _peak(dtype: torch.dtype, rays: int, threads: int) -> float:
    with _worker("serve_memory", dtype, rays, threads) as worker:
        return float(_read(worker))


def _rates(workers: Sequence[subprocess.Popen], seconds: float) -> list[float]:
    for worker in workers:
        worker.stdin.write(f"{seconds}\n")
        worker.stdin.flush()
    return [float(_read(worker)) for worker in workers]


@contextlib.contextmanager
def _worker(function: str, dtype: torch.dtype, rays: int, threads: int) -> Iterator[subprocess.Popen]:
    """A process that runs a function serve_…; it ends with its input."""
    code = f"from bench_speed import {function}; {function}({name_of(dtype)!r}, {rays}, {threads})"
    environment, pipe = _environment() | {"OMP_NUM_THREADS": str(threads)}, subprocess.PIPE
    worker = subprocess.Popen([sys.executable, _SAFE, "-c", code], env=environment, stdin=pipe, stdout=pipe, text=True)
    try:
        yield worker
    finally:
        worker.stdin.close()
        worker.wait(timeout=60)


def _read(worker: subprocess.Popen) -> str:
    line = worker.stdout.readline()
    if not line:
        raise RuntimeError(f"a process of the benchmark ended with code {worker.wait()} without an answer")
    return line


def _environment() -> dict[str, str]:
    """The environment in which Python finds this package and this folder."""
    paths = (str(Path(__file__).parents[2]), str(Path(__file__).parent), os.environ.get("PYTHONPATH"))
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}


def _peak_from_now() -> int:
    """Reset the peak if the system can, and return it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _highest()


def _highest() -> int:
    """Bytes in memory at the peak."""
    try:
        status = Path("/proc/self/status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="few rays, as a trial; the ratios are not meaningful")
    kit.shared(parser, "speed.md, speed.csv and speed.png")


def main(argv: Sequence[str] | None = None) -> None:
    kit.run(bench, options, argv, peers=True)


if __name__ == "__main__":
    sys.exit(main())
