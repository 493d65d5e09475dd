"""What only whole processes show: peak memory, the time of a command, two processes at once.

Each measurement starts Python anew and talks to it by lines; the functions `serve_…` are what runs there.
"""

import contextlib
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from raytrace.bench.measure import Own, field_rays, name_of, some
from raytrace.io import read_lens
from raytrace.maths.value import to
from raytrace.system.rays import Rays
from raytrace.tracing.compiled import prepare

_PATTERN = 2**12  # rays that are repeated to fill a large batch: launching many would set the peak
_WARM_UP = 2**14
_MOST_BYTES = 4 * 2**30
_SPOT = ("-m", "raytrace", "spot", "lenses/double_gauss.zmx")
_BARE = ("-c", "import torch, matplotlib.pyplot")
_SAFE = "-P"  # no modules of the current folder


def bytes_per_ray(dtype: torch.dtype, rays: int, *, threads: int) -> tuple[float, int]:
    """Peak memory of forward + backward above the inputs, bytes a ray, and of how many rays.

    A 32nd of the rays goes first; where all of them would take more than 4 GiB, it stays at that.
    """
    few = max(4 * _WARM_UP, rays // 32)
    found = _peak(dtype, few, threads)
    return (found, few) if rays <= few or found * rays > _MOST_BYTES else (_peak(dtype, rays, threads), rays)


def spot_process_ratio(repeats: int) -> tuple[float, float, float]:
    """Time of `raytrace spot` over that of the bare imports, processes in turns; then both medians, s."""
    taken: dict[tuple[str, ...], list[float]] = {_SPOT: [], _BARE: []}
    for turn in range(repeats + 1):
        for words, seconds in taken.items():
            began = time.perf_counter()
            subprocess.run([sys.executable, _SAFE, *words], env=_environment(), stdout=subprocess.DEVNULL, check=True)
            if turn:  # the first brings the files into memory
                seconds.append(time.perf_counter() - began)
    spot, bare = (statistics.median(seconds) for seconds in taken.values())
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
    """Print the growth of the peak in bytes a ray, then leave."""
    torch.set_num_threads(threads)
    tracer, batch = _tracer_and_rays(dtype, rays)
    centroid = torch.zeros(2, dtype=tracer.dtype)
    few = some(batch, lambda x: x[..., :_WARM_UP].clone())
    for _ in range(2):
        tracer.gradient(few, centroid)
    # A system that takes back idle pages would bring the inputs in again, and count them.
    float(batch.position.sum() + batch.direction.sum())
    before = _peak_from_now()
    tracer.gradient(batch, centroid)
    print((_highest() - before) / rays, flush=True)


def serve_rate(dtype: str, rays: int, threads: int) -> None:
    """Trace for as long as each line of the input says, s, and print rays a second; until the input ends."""
    torch.set_num_threads(threads)
    tracer, batch = _tracer_and_rays(dtype, rays)
    for _ in range(2):
        tracer.forward(batch)
    print("ready", flush=True)
    for line in sys.stdin:
        began, done = time.perf_counter(), 0
        while time.perf_counter() - began < float(line):
            tracer.forward(batch)
            done += rays
        print(done / (time.perf_counter() - began), flush=True)


def _tracer_and_rays(dtype: str, count: int) -> tuple[Own, Rays]:
    prepare()
    lens = read_lens("double_gauss")
    tracer = Own(lens, getattr(torch, dtype), engine="auto", by_indices=True)
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
    """A process that runs one of these functions; it ends with its input."""
    code = f"from {__name__} import {function}; {function}({name_of(dtype)!r}, {rays}, {threads})"
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
        raise RuntimeError(f"a process of the benchmark ended with code {worker.wait()} before it answered")
    return line


def _environment() -> dict[str, str]:
    """The environment in which Python finds this very package."""
    here = str(Path(__file__).parents[2])
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))}


def _peak_from_now() -> int:
    """Bytes in memory now, which `_highest` counts from where Linux can forget the peak; else the highest so far."""
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
