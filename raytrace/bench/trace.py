"""Speed of the trace over the number of rays, forward and with gradient, beside its error and beside Optiland."""

import dataclasses
import statistics
from collections.abc import Callable, Sequence

import torch

from raytrace.bench import beyond
from raytrace.bench.measure import (
    DTYPES,
    PIECES,
    SAMPLE,
    Errors,
    Job,
    Own,
    Tracer,
    errors_of,
    field_rays,
    in_best_pieces,
    in_turns,
    name_of,
    nothing,
    surfaces_of,
)
from raytrace.bench.report import Asked, Measured, clock_of, digits, in_words, table
from raytrace.cli.progress import progress
from raytrace.cli.run import CommandError
from raytrace.maths.value import to
from raytrace.system.lens import Lens
from raytrace.system.rays import Rays

LENS, COUNTS = "double_gauss", (10**3, 10**4, 10**5, 10**6)
LARGEST_GRAPH = 200_000  # rays whose graph is held at once
WORK = ("forward", "forward+backward")


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure: what was traced, how fast, how well. seconds: median; ratio: speed over that of the peer."""

    tracer: str
    dtype: str
    what: str
    path: bool
    rays: int
    piece: int
    seconds: float
    fastest: float
    speed: float
    errors: Errors
    ratio: float | None = None


def bench(asked: Asked) -> Measured:
    """One lens, several numbers of rays."""
    name, counts, repeats = asked.arguments.lens or LENS, asked.arguments.rays or COUNTS, asked.arguments.repeats
    lens = asked.open_lens(name)
    if not bool(field_rays(lens, 1000).valid.all()):
        raise CommandError(f"{name}: not every ray of the middle field starts; choose another lens")
    tracers = tracers_of(lens, asked.peers.peers(lens) if asked.peers else [])
    how = {"repeats": repeats, "threads": asked.threads}
    peers_of = asked.peers.posed_peers if asked.peers else nothing
    others = 0 if asked.arguments.lens else beyond.calls(repeats, with_peers=bool(asked.peers))
    with progress(calls(tracers, counts, repeats) + others, "call", what="measuring") as bar:
        rows = measure(lens, tracers, counts, **how, progress=bar.update)
        beside = beyond.measure(max(counts), **how, peers_of=peers_of, progress=bar.update) if others else []
    about = {"lens": name, "surfaces": surfaces_of(lens), "repeats": repeats, "machine": asked.about()}
    lines = report(rows, **about) + (beyond.report(beside) if others else [])
    told = about | ({"beyond": [dataclasses.asdict(row) for row in beside]} if others else {})
    return Measured(rows, lines, told, ("trace_figure",))


def tracers_of(lens: Lens, peers: Sequence[Tracer] = ()) -> list[Tracer]:
    return [*(Own(lens, dtype, with_path=path) for dtype in DTYPES for path in (True, False)), *peers]


def calls(tracers: Sequence[Tracer], counts: Sequence[int], repeats: int) -> int:
    """How many steps of progress `measure` makes."""
    return len(counts) * repeats * sum(1 + tracer.has_gradient for tracer in tracers)


def measure(
    lens: Lens,
    tracers: Sequence[Tracer],
    counts: Sequence[int],
    *,
    repeats: int,
    threads: int,
    progress: Callable[[int], object] = nothing,
) -> list[Row]:
    """Time every tracer on every number of rays; progress: of `calls(…)`."""
    errors = [errors_of(tracer, lens, field_rays(lens, SAMPLE)) for tracer in tracers]
    rows = []
    for count in sorted(counts):
        jobs, pieces = {}, {}
        rays = {dtype: to(field_rays(lens, count), dtype=dtype) for dtype in DTYPES}
        for number, tracer in enumerate(tracers):
            for what in WORK[: 1 + tracer.has_gradient]:
                jobs[number, what], pieces[number, what] = _job(tracer, what, rays[tracer.dtype], threads)
        for (number, what), seconds in in_turns(jobs, repeats=repeats, threads=threads, progress=progress).items():
            rows.append(_row(tracers[number], what, lens, count, pieces[number, what], seconds, errors[number]))
    return [dataclasses.replace(row, ratio=_ratio(row, rows)) for row in rows]


def _job(tracer: Tracer, what: str, rays: Rays, threads: int) -> tuple[Job, int]:
    centroid, backward = torch.zeros(2, dtype=tracer.dtype), what != "forward"
    work = (lambda rays: tracer.gradient(rays, centroid)) if backward else tracer.forward
    most = LARGEST_GRAPH if backward else None
    return in_best_pieces(work, rays, tracer.prepare, sizes=PIECES, threads=threads, most=most)


def _row(tracer: Tracer, what: str, lens: Lens, count: int, piece: int, seconds: list[float], errors: Errors) -> Row:
    median = statistics.median(seconds)
    speed = count * surfaces_of(lens) / max(median, 1e-9)
    dtype, fastest = name_of(tracer.dtype), min(seconds)
    return Row(tracer.name, dtype, what, tracer.with_path, count, piece, median, fastest, speed, errors)


def _ratio(row: Row, rows: Sequence[Row]) -> float | None:
    """Speed over that of Optiland's torch back end at the same task; None for Optiland itself or without it."""
    task = row.dtype, row.what, row.rays
    peers = [one for one in rows if one.tracer.endswith("torch") and (one.dtype, one.what, one.rays) == task]
    return row.speed / peers[0].speed if peers and row.tracer == "raytrace" else None


def report(rows: Sequence[Row], *, lens: str, surfaces: int, machine: dict, repeats: int) -> list[str]:
    """The machine, how it was measured, and one line a figure."""
    columns = {
        "rays": lambda row: f"{row.rays:,}",
        "what": lambda row: row.what,
        "dtype": lambda row: row.dtype,
        "tracer": lambda row: row.tracer,
        "path": lambda row: "yes" if row.path else "no",
        "at a time": lambda row: f"{row.piece:,}",
        "M/s": lambda row: f"{row.speed / 1e6:.2f}",
        "× Optiland": lambda row: digits(row.ratio, ".2f"),
        "position error, nm": lambda row: digits(row.errors.position, ".2g"),
        "path error, waves": lambda row: digits(row.errors.path, ".2g"),
        "gradient error": lambda row: digits(row.errors.gradient) if row.what != "forward" else "",
    }
    if all(row.ratio is None for row in rows):
        del columns["× Optiland"]
    return [
        f"Lens `{lens}`: {surfaces} surfaces a ray is carried to (stop and image counted, the object not). Speed in "
        f"millions of rays × surfaces per second, from the median {clock_of(machine)} of {repeats} runs, the tracers "
        "in turns.",
        "",
        in_words(machine) + ".",
        "",
        "Forward: positions and directions on the image without a graph. Forward+backward: the gradient of the mean "
        "squared spot radius by every curvature and every thickness. Rays are traced as many at a time as suits each "
        f"tracer best (column *at a time*). Errors: the largest over {SAMPLE} of the rays against an independent "
        "tracer of 50 digits that gets the same rounded numbers: position on the image; optical path relative to the "
        "first ray; gradient relative to its largest component.",
        "",
        *table(columns, rows),
    ]
