"""Speed of the trace over the number of rays, forward and with gradient, against its error and Optiland."""

import dataclasses
from collections.abc import Callable, Sequence

import torch

from raytrace.bench.figures import trace_figure
from raytrace.bench.measure import (
    COLUMNS,
    DTYPES,
    SAMPLE,
    Own,
    Row,
    Tracer,
    errors_of,
    field_rays,
    measured_rows,
    nothing,
    surfaces_of,
)
from raytrace.bench.report import Measured, Request, clock_of, in_words
from raytrace.cli.progress import progress
from raytrace.cli.run import CommandError
from raytrace.pages import listing
from raytrace.system.lens import Lens

LENS, COUNTS = "double_gauss", (10**3, 10**4, 10**5, 10**6)
PIECES = (2**15, 2**16)  # numbers of rays traced at a time that are tried, and all at once
LARGEST_GRAPH = 200_000  # rays whose graph is held at once


def bench(request: Request) -> Measured:
    """One lens, several numbers of rays."""
    arguments = request.arguments
    name, counts, repeats = arguments.lens or LENS, arguments.rays or COUNTS, arguments.repeats
    lens = request.open_lens(name)
    if not bool(field_rays(lens, 1000).valid.all()):
        raise CommandError(f"{name}: rays of the middle field fail at launch; choose another lens")
    tracers = [Own(lens, dtype, with_path=path) for dtype in DTYPES for path in (True, False)]
    if arguments.device:
        try:
            torch.empty(0, device=arguments.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise CommandError(f"--device {arguments.device}: torch cannot use this device ({reason})") from None
        tracers += [Own(lens, dtype, with_path=True, device=arguments.device) for dtype in DTYPES]
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
    tasks = [
        (tracer, work, error)
        for tracer, error in zip(tracers, errors, strict=True)
        for work in ("forward", "forward+backward")[: 1 + tracer.has_gradient]
    ]
    how = {"repeats": repeats, "threads": threads, "progress": progress}
    how |= {"sizes": PIECES, "graphs": lambda tracer: LARGEST_GRAPH}
    rows = [row for count in sorted(counts) for row in measured_rows(tasks, lens, count, **how)]
    peers = {(row.dtype, row.what, row.rays): row.speed for row in rows if row.tracer.endswith("torch")}
    return [
        dataclasses.replace(row, ratio=row.speed / peers[row.dtype, row.what, row.rays])
        if peers and row.tracer == "raytrace"
        else row
        for row in rows
    ]


def report(rows: Sequence[Row], *, lens: str, surfaces: int, machine: dict, repeats: int) -> list[str]:
    """The machine, the measurement, and a line for each row."""
    is_alone = all(row.ratio is None for row in rows)
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
        *listing({name: form for name, form in COLUMNS.items() if not (is_alone and name == "× Optiland")}, rows),
    ]
