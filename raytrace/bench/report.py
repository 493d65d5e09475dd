"""The measured table in words: the machine, how it was measured, one line a figure."""

from collections.abc import Sequence

from raytrace.bench.measure import SAMPLE, Row


def markdown(rows: Sequence[Row], *, lens: str, surfaces: int, about: dict[str, str | int], repeats: int) -> str:
    """The report: a heading line, how it was measured, and the table."""
    clock = "processor time" if about["torch threads"] == 1 else "time of day"
    by_ratio = any(row.ratio is not None for row in rows)
    lines = [
        f"Lens `{lens}`: {surfaces} surfaces a ray is carried to (stop and image counted, the object not). Speed in "
        f"millions of rays × surfaces per second, from the median {clock} of {repeats} runs, the tracers in turns.",
        "",
        "; ".join(f"{name}: {value}" for name, value in about.items()) + ".",
        "",
        "Forward: positions and directions on the image without a graph. Forward+backward: the gradient of the mean "
        "squared spot radius by every curvature and every thickness. Rays are traced as many at a time as suits each "
        f"tracer best (column *at a time*). Errors: the largest over {SAMPLE} of the rays against an independent "
        "tracer of 50 digits that gets the same rounded numbers: position on the image; optical path relative to the "
        "first ray; gradient relative to its largest component.",
        "",
    ]
    header = ["rays", "what", "dtype", "tracer", "path", "at a time", "M/s"]
    header += ["× Optiland"] if by_ratio else []
    header += ["position error, nm", "path error, waves", "gradient error"]
    lines += ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for row in rows:
        cells = [f"{row.rays:,}", row.what, row.dtype, row.tracer, "yes" if row.path else "no", f"{row.piece:,}"]
        cells.append(f"{row.speed / 1e6:.2f}")
        cells += [_digits(row.ratio, ".2f")] if by_ratio else []
        cells += [_digits(row.errors.position, ".2g"), _digits(row.errors.path, ".2g")]
        cells.append(_digits(row.errors.gradient, ".1e") if row.what != "forward" else "")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _digits(number: float | None, form: str) -> str:
    return "" if number is None else format(number, form)
