"""The benchmark of wave PSFs in words: page and CSV."""

import math
from collections.abc import Mapping, Sequence

from raytrace.bench.wave import DEPTH, ERROR, PIXEL, SITZMANN, SIZE, TARGET, WAVELENGTH, WaveRow, target
from raytrace.pages import KEPT as KEPT
from raytrace.pages import measured, page
from raytrace.pages import table as table

_NAMES = {
    "pupil": "pupil matrix DFT",
    "radial": "ring integrals",
    "fresnel": "Fresnel transfer function, band limit",
    "angular_spectrum": "angular spectrum, band limit, true spheres",
    SITZMANN: "Fresnel transfer function as Sitzmann et al. (2018)",
}


def markdown(
    rows: Sequence[WaveRow], *, agreement: float, about: Mapping[str, str | int], repeats: int, kept: str = ""
) -> str:
    """The page, `kept` below the mark."""
    lines = [
        "# Waves behind a phase element: speed beside error",
        "",
        "    raytrace bench wave --docs docs",
        "",
        f"One kernel: a PMMA lens of 5 mm made for 1 m, 35.5 mm before the sensor, a point at {DEPTH / 1e3:g} m in "
        f"{1e3 * WAVELENGTH:g} nm, {SIZE} × {SIZE} pixels of {1e3 * PIXEL:g} µm, integrated over them. Error: relative "
        "L² of the kernel against converged ring integrals, from which a converged matrix DFT differs by "
        f"{agreement:.1e}. Times are of a step that changes heights alone, as in learning: *forward*, and *with "
        "gradient* by the coefficients of the lens; *first* is a forward call that nothing is kept from.",
        "",
        "The method of Sitzmann et al. (ACM Trans. Graph. 37, 114, 2018): the field behind the element on 2500² "
        "samples of 2 µm, padded to "
        "3744², times Fresnel's transfer function, no band limit. It is judged at its own samples, and its sphere and "
        "its transfer function are made once, outside the time.",
        "",
        "![Time over error of the engines](wave/speed_vs_error.png)",
        "",
        *_goals(rows),
        "",
        *_rows(rows),
        "",
        "Rows in italics are refused by `plan` (`AliasedSampling`) and forced here: copies of the image lie in the "
        "window, and the result is wrong altogether, not a little. *Predicted* is what `plan` says of the error.",
        "",
        measured(f"up to {repeats} calls", about) + ". All figures: [speed_vs_error.csv](wave/speed_vs_error.csv).",
    ]
    return page(lines, kept)


def _goals(rows: Sequence[WaveRow]) -> list[str]:
    lines = [
        f"Target: {TARGET:g} × less time than their method at an error of at most {ERROR:g}. The fastest sampling "
        "of each engine that comes so close, beside the fastest run of their method:",
        "",
        "| engine | sampling | error | forward | with gradient | met |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for one in target(rows):
        best = one.best
        cells = [_NAMES[best.engine], f"{best.sampling}, {best.dtype}", f"{best.error:.1e}"]
        cells += [_ratio(one.forward), _ratio(one.both), "yes" if one.met else "no"]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _rows(rows: Sequence[WaveRow]) -> list[str]:
    lines = [
        "| engine | sampling | dtype | error | predicted | forward, ms | with gradient, ms | first, ms |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        cells = [_NAMES[row.engine], row.sampling, row.dtype, _digits(row.error), _digits(row.predicted)]
        cells += [f"{1e3 * seconds:.3g}" for seconds in (row.forward_s, row.both_s, row.cold_s)]
        if row.refused:
            cells = [f"*{cell}*" for cell in cells]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _ratio(value: float) -> str:
    return f"{value:.0f} ×" if value >= 10 else f"{value:.2g} ×"


def _digits(value: float | None) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.1e}" if value < 1 else f"{value:.1f}"
