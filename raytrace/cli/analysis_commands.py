"""`raytrace mtf`, `fan`, `opd`, `wavefront`, `distortion`, `curvature`, `lateral`, `illumination`, `encircled`."""

import argparse
from collections.abc import Callable

import torch
from torch import Tensor

from raytrace import analysis
from raytrace.cli.door import CommandError, field_points, open_lens, print_json, say
from raytrace.cli.reach import check_reach, refuse_empty
from raytrace.maths import zernike
from raytrace.maths.numerics import broadcast_shape
from raytrace.maths.result import Result, cell, flat, number
from raytrace.system.lens import FIELD_UNITS, Lens, name_of_field

_UNITS = {
    "wavelength": "µm", "frequency": "1/mm", "sensor_distance": "mm", "radius": "mm", "height": "mm", "shift": "mm",
    "f_tan": "%", "f_theta": "%", "projected_solid_angle": "sr", "crossing": "mm", "lower": "°", "chief": "°",
    "upper": "°",
}  # fmt: skip
DENSE = 65  # fields of a curve over the field, when it is drawn
FINE = 321  # frequencies or radii of a curve, when it is drawn


def mtf(arguments: argparse.Namespace) -> None:
    """Modulation through frequency or through focus."""
    lens, fields = opened(arguments, every=True)
    kind = "geometric" if arguments.geometric else "diffraction"
    frequencies = None if arguments.frequency is None else lens.wavelengths.new_tensor(arguments.frequency)
    if arguments.through_focus is None:
        found = analysis.mtf(lens, frequencies, kind=kind, fields=fields)
        fine = analysis.mtf(lens, _fine(found.frequencies), kind=kind, fields=fields) if arguments.plot else None
        asked = None if frequencies is None else found
        report(arguments, lens, found, "mtf_curves", every=5, dense=fine, asked=asked)
        return
    if frequencies is None or len(frequencies) != 1:
        raise CommandError("--through-focus needs one spatial frequency: add --frequency F")
    here = lens.surfaces[-2].thickness
    distances = here + arguments.through_focus * torch.linspace(-1, 1, 21, dtype=here.dtype)
    found = analysis.mtf_through_focus(lens, frequencies[0], distances, kind=kind, fields=fields)
    report(arguments, lens, found, "mtf_through_focus_curves", every=1)


def fan(arguments: argparse.Namespace) -> None:
    """Ray fans."""
    lens, fields = opened(arguments)
    found = analysis.ray_fan(lens, fields=fields, size=arguments.points)
    report(arguments, lens, found, "fan_plot", every=5, unit="mm")


def opd(arguments: argparse.Namespace) -> None:
    """OPD fans."""
    lens, fields = opened(arguments)
    found = analysis.opd_fan(lens, fields=fields, size=arguments.points, reference=arguments.reference)
    report(arguments, lens, found, "fan_plot", every=5, unit="waves")


def wavefront(arguments: argparse.Namespace) -> None:
    """Wavefront maps; the text is RMS, peak to valley and the Strehl ratio, on demand and in JSON the coefficients."""
    lens, fields = opened(arguments, every=True)
    rule = {"terms": arguments.terms or 37, "numbering": arguments.zernike or "noll"}
    found = analysis.wavefront_map(lens, fields=fields, size=arguments.size, **rule)
    unknown = found.coefficients[..., 0].isnan() & found.rms.isfinite()
    for f in torch.nonzero(unknown.any(1))[:, 0].tolist():
        field = f"field {name_of_field(found.fields[:, f])} {FIELD_UNITS[lens.fields.kind]}"
        say(f"warning: {field}: the light fills too little of the entrance pupil for Zernike coefficients")
    report(arguments, lens, found, "wavefront_maps", summary=found.summary(), unit="waves")
    if (arguments.zernike or arguments.terms) and not arguments.json:
        for f, field in enumerate(found.fields.unbind(1)):
            unit = {"noll": "waves RMS", "fringe": "waves at the rim"}[found.numbering]
            label = f"{name_of_field(field)} {FIELD_UNITS[lens.fields.kind]}"
            print(f"\n{found.numbering.capitalize()} coefficients of field {label}, {unit}")
            _print_terms(found, f)


def _print_terms(found: analysis.WavefrontMap, field: int) -> None:
    """The coefficients of one field: a row for each term, a column for each wavelength."""
    heads = (f"{wavelength:g} µm" for wavelength in found.wavelengths.tolist())
    print(f"{'j':>3} {'n':>3} {'m':>3}  {'term':<26}" + "".join(f"{head:>14}" for head in heads))
    order, _ = zernike.NUMBERINGS[found.numbering]
    for j, row in enumerate(found.coefficients[field].T.tolist(), 1):
        n, m = order(j)
        cells = "".join(cell(c if not abs(c) < 5e-9 else 0.0, ">14.8f") for c in row)
        print(f"{j:>3} {n:>3} {m:>3}  {zernike.WORDS.get((n, m), ''):<26}{cells}")


def distortion(arguments: argparse.Namespace) -> None:
    """Distortion of the chief ray."""
    over_field(arguments, analysis.distortion, "distortion_curves")


def curvature(arguments: argparse.Namespace) -> None:
    """Foci of close rays."""
    over_field(arguments, analysis.field_curvature, "curvature_curves")


def lateral(arguments: argparse.Namespace) -> None:
    """Lateral colour, with the Airy radius in the figure."""
    over_field(arguments, analysis.lateral_colour, "lateral_curves")


def illumination(arguments: argparse.Namespace) -> None:
    """Relative illumination."""
    over_field(arguments, analysis.relative_illumination, "illumination_curve")


def encircled(arguments: argparse.Namespace) -> None:
    """Encircled energy."""
    lens, fields = opened(arguments, every=True)
    kind = "geometric" if arguments.geometric else "diffraction"
    radii = None if arguments.radius is None else lens.wavelengths.new_tensor(arguments.radius)
    found = analysis.encircled_energy(lens, radii, kind=kind, fields=fields)
    fine = analysis.encircled_energy(lens, _fine(found.radii), kind=kind, fields=fields) if arguments.plot else None
    report(arguments, lens, found, "encircled_curves", every=5, dense=fine, asked=None if radii is None else found)


def _fine(places: Tensor) -> Tensor:
    """Frequencies or radii from 0 to the last of these, close enough for a smooth curve."""
    return places.max() * torch.linspace(0, 1, FINE, dtype=places.dtype)


def opened(arguments: argparse.Namespace, *, every: bool = False) -> tuple[Lens, Tensor]:
    """The lens, and the fields of --field, else the lens's own; rays must reach the sensor from one, or from every."""
    lens = open_lens(arguments)
    fields = field_points(lens, arguments)
    check_reach(arguments, lens, fields, every=every)
    return lens, fields


def over_field(arguments: argparse.Namespace, analyse: Callable, figure: str) -> None:
    """Report an analysis at the fields of --field, else at --samples fields; its figure is drawn through many."""
    lens, fields = opened(arguments) if arguments.fields else (open_lens(arguments), None)
    found = analyse(lens, fields=fields, size=arguments.samples)
    refuse_empty(arguments, lens, found)
    line = None if fields is None else _line(fields)
    dense = analyse(lens, fields=line, size=DENSE) if arguments.plot else None
    marks = {} if figure != "illumination_curve" or fields is None else {"asked": found}
    report(arguments, lens, found, figure, unit="mm", dense=dense, **marks)


def _line(fields: Tensor) -> Tensor:
    """Many fields (2, F) from the axis to the largest of these, if they lie on one line to it; else these."""
    size = torch.hypot(*fields)
    largest = fields[:, size.argmax()]
    along = (fields * largest[:, None]).sum(0) / size.max()
    if not size.max() > 0 or bool((along < (1 - 1e-9) * size).any()):
        return fields
    return largest[:, None] * torch.linspace(0, 1, DENSE, dtype=fields.dtype)


def report(
    arguments,
    lens: Lens,
    found: Result,
    figure: str,
    *,
    every: int = 1,
    unit: str = "",
    summary: dict[str, Tensor] | None = None,
    dense: Result | None = None,
    **options,
) -> None:
    """Print the result as JSON, or every so many-th row of its table; save the figure of it, or of the dense one."""
    if arguments.json:
        document = {"analysis": arguments.command, "results": rows(found.columns())}
        print_json(document if summary is None else {**document, "summary": rows(summary)})
    else:
        print_table(summary or found.columns(), FIELD_UNITS[lens.fields.kind], every if summary is None else 1, unit)
    draw(arguments, lens, found if dense is None else dense, figure, **options)


def draw(arguments, lens: Lens, found: Result, figure: str, **options) -> None:
    """Save the figure of that name in `raytrace.plot`, if --plot asks for it."""
    if arguments.plot:
        from raytrace import plot

        plot.save(getattr(plot, figure)(lens, found, **options), arguments.plot)
        say(f"written: {arguments.plot}")


def rows(columns: dict[str, Tensor]) -> list[dict]:
    table = flat(columns)
    return [dict(zip(table, map(number, row), strict=True)) for row in zip(*table.values(), strict=True)]


def print_table(columns: dict[str, Tensor], field_unit: str, every: int, unit: str) -> None:
    length = broadcast_shape(*(c.shape for c in columns.values()))[-1]
    thin = every if length > 2 * every else 1
    table = flat({name: c[..., ::thin] if c.shape[-1] == length else c for name, c in columns.items()})
    if "field_x" in table and not table["field_x"].any():
        del table["field_x"]
    widths = {name: max(len(name), 9) for name in table}
    print("  ".join(f"{name:>{width}}" for name, width in widths.items()))
    units = {name: field_unit if name.startswith("field") else _UNITS.get(name, "") for name in table}
    units |= {name: unit for name in ("tangential", "sagittal", "rms", "peak_to_valley") if name in table}
    print("  ".join(f"{units[name]:>{width}}" for name, width in widths.items()))
    factor = {name: 100 if units[name] == "%" else 1 for name in table}
    for row in zip(*table.values(), strict=True):
        cells = (_cell(factor[name] * float(value)) for name, value in zip(table, row, strict=True))
        print("  ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths.values(), strict=True)))
    if thin > 1:
        print(f"{len(range(0, length, thin))} of {length} points of each curve; --json lists all")


def _cell(value: float) -> str:
    return "-" if value != value else f"{value + 0.0:.6g}"
