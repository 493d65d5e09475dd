"""The accuracy of the co-design experiment's PSFs in words: tables, page and CSV."""

import statistics
from collections.abc import Mapping, Sequence

from raytrace.bench.codesign_accuracy import DRAWS, FAR, NEAR, PITCH, PIXELS, WAVELENGTH, Accuracy, ModelError
from raytrace.pages import KEPT as KEPT
from raytrace.pages import measured, page
from raytrace.pages import table as table

_NAMES = {"paraxial": "paraxial", "fourier": "Fourier", "gaussian": "Gaussian DRT", "drt": "DRT"}
_SAID = {
    "random": "random, plain mean",
    "hexapolar": "hexapolar, plain mean",
    "splatted": "random, splatted over a pixel",
    "counted": "random, counted",
}


def markdown(
    rows: Sequence[Accuracy],
    gaps: Sequence[ModelError],
    *,
    about: Mapping[str, str | int],
    repeats: int,
    kept: str = "",
) -> str:
    """The page, `kept` below the mark."""
    samples = len({gap.distance for gap in gaps})
    lines = [
        "# Accuracy of the PSFs that lenses are learned with",
        "",
        "    raytrace bench codesign --docs docs",
        "",
        f"double_gauss at F/3 and {WAVELENGTH:g} µm; batches of {samples} object distances, evenly from {NEAR / 1e3:g} "
        f"to {FAR / 1e3:g} m; windows of {PIXELS} × {PIXELS} pixels of {1e3 * PITCH:g} µm, kernels that sum to 1 in "
        "them. Errors are means over the batch, against the limit of the entrant's own model: of σ, of the kernel "
        "(Σ|k - k₀|), and of the kernel's derivative by the sensor's place (Σ|k′ - k₀′|/Σ|k₀′|): what learning steps "
        "along. Times: a batch, forward and backward to the sensor's place, all rays traced; without a derivative "
        f"forward only. Random rays: means over {DRAWS} draws.",
        "",
        "![Error over time, and the models over object distance](codesign/accuracy.png)",
        "",
        "*Above: error over time; figures at marks: rays traced for a kernel; errors below 1e-9 are drawn there. "
        "Below: how far the limits of the models are from DRT's.*",
        "",
    ]
    for field, sensor in dict.fromkeys((row.field, row.sensor) for row in rows):
        own = [row for row in rows if (row.field, row.sensor) == (field, sensor)]
        lines += [f"## {_place(field)}, sensor at {sensor:g} mm", "", *_rows(own), ""]
    lines += ["## How far the models are from DRT", "", *_gaps(gaps), ""]
    lines += [
        "Relative L¹ of the converged kernels, each around its own chief ray: the mean over object distances (and the "
        "least and the most); 2 is the most there is. Every object distance is in "
        "[model_error.csv](codesign/model_error.csv), every row above in [accuracy.csv](codesign/accuracy.csv).",
        "",
        measured(f"{repeats} batches, all entrants in turns in one run", about) + ".",
    ]
    return page(lines, kept)


def _rows(rows: Sequence[Accuracy]) -> list[str]:
    lines = [
        "| model | rays | how | error of σ | of the kernel | of its derivative | ms |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        cells = [_NAMES[row.model], str(row.rays), _how(row.sampling)]
        cells += [_error(error) for error in (row.sigma_error, row.l1_error, row.slope_error)]
        lines.append("| " + " | ".join([*cells, f"{row.both_ms:.1f}"]) + " |")
    return lines


def _how(sampling: str) -> str:
    """In words; how many rays is said beside it."""
    kind = sampling.split()[-1]
    return _SAID.get(kind, f"quadrature, {sampling}" if kind == "rings" else sampling)


def _gaps(gaps: Sequence[ModelError]) -> list[str]:
    models = list(dict.fromkeys(gap.model for gap in gaps))
    lines = ["| | " + " | ".join(_NAMES[model] for model in models) + " |", "| --- |" + " --- |" * len(models)]
    for field, sensor in dict.fromkeys((gap.field, gap.sensor) for gap in gaps):
        cells = []
        for model in models:
            own = [gap.l1_error for gap in gaps if (gap.field, gap.sensor, gap.model) == (field, sensor, model)]
            cells.append(f"{statistics.mean(own):.2f} ({min(own):.2f} – {max(own):.2f})")
        lines.append(f"| {_place(field)}, {sensor:g} mm | " + " | ".join(cells) + " |")
    return lines


def _place(field: float) -> str:
    return "On the axis" if field == 0 else f"{field:g}° off the axis"


def _error(error: float | None) -> str:
    return "–" if error is None else "< 1e-9" if error < 1e-9 else f"{error:.1e}" if error < 0.001 else f"{error:.3g}"
