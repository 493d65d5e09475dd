"""`raytrace seidel`, `longitudinal`, `grid`, `incidence`, `rms`."""

import argparse

from raytrace import analysis
from raytrace.cli.analysis_commands import DENSE, draw, opened, print_table, report, rows
from raytrace.cli.door import field_points, open_lens, print_json
from raytrace.system.lens import FIELD_UNITS, name_of_field


def seidel(arguments: argparse.Namespace) -> None:
    """Third-order aberrations by surface and their sums."""
    lens = open_lens(arguments)
    fields = field_points(lens, arguments) if arguments.fields else None
    found = analysis.seidel(lens, fields=fields, kind=arguments.told)
    if arguments.json:
        document = {"analysis": "seidel", "kind": found.kind, "unit": found.unit}
        print_json({**document, "results": rows(found.columns()), "summary": rows(found.sums())})
    else:
        unit = FIELD_UNITS[lens.fields.kind]
        for number, field in enumerate(found.fields.unbind(1)):
            invariant = f"optical invariant {_cell(abs(float(found.invariant[number]))).strip()} mm"
            print(f"field {name_of_field(field)} {unit}, {invariant}, aberrations in {found.unit}")
            _print_surfaces(found, number)
    draw(arguments, lens, found, "seidel_bars")


def _print_surfaces(found: analysis.Seidel, field: int) -> None:
    """The table of one field: a row for each surface, and their sums, of which y n i has none."""
    by_surface = dict(zip(found.names, found.contributions[:, field], strict=True))
    yni = {"y n i": found.marginal_yni[field], "ȳ n ī": found.chief_yni[field]} if found.kind == "coefficients" else {}
    print(f"{'surface':>7}" + "".join(f"{name:>13}" for name in (*by_surface, *yni)))
    for k in range(found.contributions.shape[-1]):
        print(f"{k + 1:>7}" + "".join(_cell(float(column[k])) for column in (*by_surface.values(), *yni.values())))
    print(f"{'sum':>7}" + "".join(_cell(float(column.sum())) for column in by_surface.values()))


def _cell(value: float) -> str:
    return f"{'-':>13}" if value != value else f"{value + 0.0:>13.6g}"


def longitudinal(arguments: argparse.Namespace) -> None:
    """Crossings with the axis over the pupil."""
    lens = open_lens(arguments)
    found = analysis.longitudinal_aberration(lens, size=arguments.points)
    report(arguments, lens, found, "longitudinal_curves", every=5)


def grid(arguments: argparse.Namespace) -> None:
    """Grid distortion: the text is a map in per cent, top row first; the JSON has the points."""
    lens = open_lens(arguments)
    wavelengths = lens.wavelengths if arguments.wavelengths else None
    found = analysis.grid_distortion(lens, wavelengths=wavelengths, size=arguments.points)
    if arguments.json:
        summary = {"wavelength": found.wavelengths, "largest": found.largest()}
        print_json({"analysis": "grid", "results": rows(found.columns()), "summary": rows(summary)})
    else:
        for w, wavelength in enumerate(found.wavelengths.tolist()):
            print(
                f"distortion in % at {wavelength:g} µm over the grid, largest {100 * float(found.largest()[w]):.6f} %"
            )
            for row, valid in zip(found.distortion[w].flip(0), found.valid[w].flip(0), strict=True):
                cells = (
                    f"{100 * float(d) + 0.0:>9.4f}" if ok else f"{'-':>9}" for d, ok in zip(row, valid, strict=True)
                )
                print("".join(cells))
    draw(arguments, lens, found, "distorted_grid", exaggerate=arguments.exaggerate)


def incidence(arguments: argparse.Namespace) -> None:
    """Angles of incidence on the sensor, or with --surfaces on every surface."""
    lens, fields = opened(arguments) if arguments.fields else (open_lens(arguments), None)
    wavelengths = lens.wavelengths if arguments.wavelengths else None
    found = analysis.incidence(lens, fields=fields, wavelengths=wavelengths, size=arguments.samples)
    if arguments.json:
        print_json({"analysis": "incidence", "results": rows(found.columns()), "summary": rows(found.on_sensor())})
    else:
        table = found.columns() if arguments.surfaces else found.on_sensor()
        print_table(table, FIELD_UNITS[lens.fields.kind], 1, "")
    if arguments.plot:
        dense = analysis.incidence(lens, fields=fields, wavelengths=wavelengths, size=DENSE)
        draw(arguments, lens, dense, "incidence_curves")


def rms(arguments: argparse.Namespace) -> None:
    """RMS over the field: a row for each field, the wavelengths beside one another."""
    lens, fields = opened(arguments) if arguments.fields else (open_lens(arguments), None)
    rule = {"quantity": "spot" if arguments.spot else "wavefront", "reference": arguments.reference}
    found = analysis.rms_over_field(lens, fields=fields, size=arguments.samples, **rule)
    if arguments.json:
        head = {"analysis": "rms", "quantity": found.quantity, "reference": found.reference}
        print_json({**head, "results": rows(found.columns()), "summary": rows(found.summary())})
    else:
        _print_rms(found, FIELD_UNITS[lens.fields.kind])
    if arguments.plot:
        draw(arguments, lens, analysis.rms_over_field(lens, fields=fields, size=DENSE, **rule), "rms_curves")


def _print_rms(found: analysis.RmsOverField, field_unit: str) -> None:
    unit, factor = ("waves", 1.0) if found.quantity == "wavefront" else ("µm", 1e3)
    heads = ["all, weighted", *(f"{wavelength:g} µm" for wavelength in found.wavelengths.tolist())]
    strehl = ["Strehl"] if found.strehl is not None else []
    print(f"{'field':>10}" + "".join(f"{head:>13}" for head in (*heads, *strehl)))
    print(f"{field_unit:>10}" + "".join(f"{unit:>13}" for _ in heads))
    for f, field in enumerate(found.fields.unbind(1)):
        values = [factor * float(value) for value in (found.polychromatic[f], *found.rms[f])]
        shown = "".join(map(_cell, values)) + ("" if found.strehl is None else f"{float(found.strehl[f]):>13.4f}")
        print(f"{name_of_field(field):>10}{shown.replace('nan', '  -')}")
