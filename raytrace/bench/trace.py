"""Speed of the trace over the number of rays, forward and with gradient, against its error and Optiland."""

import dataclasses
import statistics
from collections.abc import Callable, Sequence

import torch

from raytrace.bench.figures import trace_figure
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
from raytrace.bench.report import Measured, Request, clock_of, digits, in_words, table
from raytrace.cli.progress import progress
from raytrace.cli.run import CommandError
from raytrace.maths.numerics import to
from raytrace.system.lens import Lens
from raytrace.system.rays import Rays

LENS, COUNTS = "double_gauss", (10**3, 10**4, 10**5, 10**6)
LARGEST_GRAPH = 200_000  # rays whose graph is held at once
WORK = ("forward", "forward+backward")


@dataclasses.dataclass(frozen=True)
class Row:
    """A measurement. piece: rays at a time; seconds: median; ratio: speed relative to Optiland's torch back end at the
    same task, None for Optiland or without it.
    """

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


def bench(request: Request) -> Measured:
    """One lens, several numbers of rays."""
    arguments = request.arguments
    name, counts, repeats = arguments.lens or LENS, arguments.rays or COUNTS, arguments.repeats
    lens = request.open_lens(name)
    if not bool(field_rays(lens, 1000).valid.all()):
        raise CommandError(f"{name}: rays of the middle field fail at launch; choose another lens")
    tracers = [Own(lens, dtype, with_path=path) for dtype in DTYPES for path in (True, False)]
    tracers += request.peers.peers(lens) if request.peers else []
    steps = len(counts) * repeats * sum(1 + tracer.has_gradient for tracer in tracers)
    with progress(steps, "call", what="measuring") as bar:
        rows = measure(lens, tracers, counts, repeats=repeats, threads=request.threads, progress=bar.update)
    about = {"lens": name, "surfaces": surfaces_of(lens), "repeats": repeats, "machine": request.about()}
    return Measured(rows, report(rows, **about), about, trace_figure)


def measure(
    lens: Lens, tracers: Sequence[Tracer], counts: Sequence[int], *, repeats: int, threads: int,
    progress: Callable[[int], object] = nothing,
) -> list[Row]:  # fmt: skip
    """Time every tracer on every number of rays."""
    errors = [errors_of(tracer, lens, field_rays(lens, SAMPLE)) for tracer in tracers]
    rows = []
    for count in sorted(counts):
        jobs, pieces = {}, {}
        rays = {dtype: to(field_rays(lens, count), dtype=dtype) for dtype in DTYPES}
        for number, tracer in enumerate(tracers):
            for what in WORK[: 1 + tracer.has_gradient]:
                jobs[number, what], pieces[number, what] = _job(tracer, what, rays[tracer.dtype], threads)
        for (number, what), seconds in in_turns(jobs, repeats=repeats, threads=threads, progress=progress).items():
            tracer, median = tracers[number], statistics.median(seconds)
            speed = count * surfaces_of(lens) / max(median, 1e-9)
            task = (tracer.name, name_of(tracer.dtype), what, tracer.with_path, count, pieces[number, what])
            rows.append(Row(*task, median, min(seconds), speed, errors[number]))
    peers = {(row.dtype, row.what, row.rays): row.speed for row in rows if row.tracer.endswith("torch")}
    ratios = [
        row.speed / peers[row.dtype, row.what, row.rays] if peers and row.tracer == "raytrace" else None for row in rows
    ]
    return [dataclasses.replace(row, ratio=ratio) for row, ratio in zip(rows, ratios, strict=True)]


def _job(tracer: Tracer, what: str, rays: Rays, threads: int) -> tuple[Job, int]:
    centroid, backward = torch.zeros(2, dtype=tracer.dtype), what != "forward"
    work = (lambda rays: tracer.gradient(rays, centroid)) if backward else tracer.forward
    most = LARGEST_GRAPH if backward else None
    return in_best_pieces(work, rays, tracer.prepare, sizes=PIECES, threads=threads, most=most)


def report(rows: Sequence[Row], *, lens: str, surfaces: int, machine: dict, repeats: int) -> list[str]:
    """The machine, the measurement, and a line for each row."""
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
        f"Lens `{lens}`: {surfaces} surfaces (with stop and image, without the object). Speed in millions of rays × "
        f"surfaces per second, from the median {clock_of(machine)} of {repeats} runs; the tracers take turns.",
        "",
        in_words(machine) + ".",
        "",
        "Forward: positions and directions on the image without a graph. Forward+backward: the gradient of the mean "
        "squared spot radius with respect to every curvature and thickness. Each tracer traces as many rays at a time "
        f"as is fastest for it (column *at a time*). Errors: the largest of {SAMPLE} rays against an independent "
        "tracer of 50 digits with the same rounded numbers: position on the image; optical path relative to the first "
        "ray; gradient relative to its largest component.",
        "",
        *table(columns, rows),
    ]
