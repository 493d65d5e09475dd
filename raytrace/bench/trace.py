"""Speed of the trace over the number of rays, forward and with gradient, and its error."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

from raytrace.bench.measure import (
    DTYPES,
    SAMPLE,
    Row,
    Tracer,
    field_rays,
    measured_rows,
    surfaces_of,
    variables,
)
from raytrace.bench.result import Figure, Measured, Quantity, clock_name, curves, machine
from raytrace.cli.progress import progress
from raytrace.cli.runner import CommandError
from raytrace.maths.numerics import to
from raytrace.maths.result import Column
from raytrace.system.lens import Lens

COUNTS = (10**3, 10**4, 10**5, 10**6)
PIECES = (2**15, 2**16)  # numbers of rays traced at a time that are tried, and all at once
LARGEST_GRAPH = 200_000  # rays whose graph is held at once
WORKS = ("forward", "forward+backward")

PRINTED: Mapping[Column, Quantity] = {
    Column("rays", form=".0f"): attrgetter("rays"),
    Column("work", form="<"): attrgetter("what"),
    Column("dtype", form="<"): attrgetter("dtype"),
    Column("tracer", form="<"): attrgetter("tracer"),
    Column("path"): lambda row: "yes" if row.path else "no",
    Column("at a time", form=".0f"): attrgetter("piece"),
    Column("speed", "M/s", ".4g"): lambda row: row.speed / 1e6,
    Column("position", "nm", ".2g", "error of\nposition"): attrgetter("position"),
    Column("path error", "waves", ".2g", "error of\npath"): attrgetter("path_error"),
    Column("gradient", form=".2g", heading="error of\ngradient"): lambda row: (
        row.gradient if row.what != WORKS[0] else None
    ),
}


def bench(
    lenses: Mapping[str, Lens], *, repeats: int, threads: int, rays: Sequence[int] | None, device: str | None
) -> Measured:
    """Speed and error of several numbers of rays through one lens, on the CPU and on a device."""
    ((name, lens),) = lenses.items()
    if not bool(field_rays(lens, 1000).valid.all()):
        raise CommandError(f"{name}: rays of the middle field fail at launch; choose another lens")
    tracers = [Tracer(lens, dtype, with_path=path) for dtype in DTYPES for path in (True, False)]
    if device:
        try:
            torch.empty(0, device=device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise CommandError(f"--device {device}: torch cannot use this device ({reason})") from None
        tracers += [Tracer(lens, dtype, with_path=True, device=device) for dtype in DTYPES]
    tasks = [(tracer, work, error) for tracer in tracers for error in [errors_of(tracer, lens)] for work in WORKS]
    counts = sorted(rays or COUNTS)
    how: dict[str, Any] = {"sizes": PIECES, "graphs": lambda tracer: LARGEST_GRAPH, "repeats": repeats}
    with progress(len(counts) * repeats * len(tasks), "call", what="measuring") as bar:
        how |= {"threads": threads, "progress": bar.update}
        measurements = [row for count in counts for row in measured_rows(tasks, lens, count, **how)]
    about = {"lens": name, "surfaces": surfaces_of(lens), "repeats": repeats, "machine": machine()}
    notes = (
        f"Lens {name}, {surfaces_of(lens)} surfaces, stop and image included. Speed: millions of rays × surfaces / s, "
        f"of the median {clock_name(threads)} of {repeats} runs in turns, as many rays at a time as is fastest.",
        "forward: positions and directions on the image. forward+backward: the gradient of the mean squared spot "
        "radius with respect to every curvature and thickness.",
        f"Errors of float32: the largest differences of {SAMPLE} rays from float64; of the path relative to the first "
        "ray, of the gradient relative to its largest component.",
    )
    return Measured(measurements, about, PRINTED, notes, figure)


def errors_of(tracer: Tracer, lens: Lens) -> dict[str, float | None]:
    """Differences from the float64 trace of the same lens and rays; none of float64."""
    if tracer.dtype == torch.float64:
        return {}
    exact = _results(Tracer(lens, torch.float64, with_path=tracer.with_path), lens)
    off = {name: float((values - exact[name]).abs().max()) for name, values in _results(tracer, lens).items()}
    path = 1e3 / float(lens.primary) * off["path"] if tracer.with_path else None
    kinds = {name for _, name in variables(lens)}
    gradient = max(off[kind] / float(exact[kind].abs().max()) for kind in kinds)
    return {"position": 1e6 * off["position"], "path_error": path, "gradient": gradient}


def _results(tracer: Tracer, lens: Lens) -> dict[str, Tensor]:
    """Positions, paths relative to the first ray, and derivatives by the kind of their variable, of a few rays."""
    rays = to(field_rays(lens, SAMPLE), dtype=tracer.dtype, device=tracer.device)
    points, path = tracer.forward(rays)
    slopes: dict[str, list[Tensor]] = {}
    for (_, kind), slope in zip(variables(lens), tracer.gradient(rays, points.mean(1)), strict=True):
        slopes.setdefault(kind, []).append(slope)
    results = {kind: torch.stack(values) for kind, values in slopes.items()} | {"position": points}
    if path is not None:
        results["path"] = path - path[0]
    return {name: values.double().cpu() for name, values in results.items()}


def figure(rows: Sequence[Row]) -> Figure:
    """Speed over the number of rays, of tracers that compute the optical path."""
    panels: dict[str, dict[str, list]] = {}
    for row in rows:
        if row.path:
            lines = panels.setdefault(row.what, {})
            lines.setdefault(f"{row.tracer}, {row.dtype}", []).append((row.rays, row.speed / 1e6))
    return curves(panels, "rays", "rays × surfaces per second, millions")
