"""`raytrace info` and `layout`."""

import argparse
import math
from pathlib import Path

import torch

from raytrace.cli.door import field_points, open_lens, print_json, say
from raytrace.maths.result import number, numbers
from raytrace.optics.f_number import real_working_f_number
from raytrace.optics.paraxial import first_order
from raytrace.optics.trace import media
from raytrace.system.lens import FIELD_UNITS, Lens
from raytrace.system.shapes import EVEN
from raytrace.system.surface import vertex_curvature

#: Lines of `raytrace info`: words, entry of FirstOrder (and the real working F/#), unit.
FIRST_ORDER_LINES = (
    ("effective focal length", "effective_focal_length", "mm"),
    ("back focal distance", "back_focal_distance", "mm, from the last surface before the image"),
    ("front focal distance", "front_focal_distance", "mm, from surface 1"),
    ("F/#", "f_number", "focal length / entrance pupil diameter"),
    ("working F/#", "working_f_number", "1/(2 n' u')"),
    ("real working F/#", "real_working_f_number", "1/(2 n' sin θ') of the real marginal ray"),
    ("entrance pupil position", "entrance_pupil_position", "mm, from surface 1"),
    ("entrance pupil diameter", "entrance_pupil_diameter", "mm"),
    ("exit pupil position", "exit_pupil_position", "mm, from the image"),
    ("exit pupil diameter", "exit_pupil_diameter", "mm"),
    ("paraxial image distance", "paraxial_image_distance", "mm, from the last surface before the image"),
    ("magnification", "magnification", ""),
    ("angular magnification", "angular_magnification", "u'/u of the chief ray"),
    ("optical invariant", "optical_invariant", "mm, of the largest field"),
    ("object NA", "object_na", ""),
    ("image NA", "image_na", ""),
    ("Petzval radius", "petzval_radius", "mm"),
)


def info(arguments: argparse.Namespace) -> None:
    """First-order data and prescription."""
    lens = open_lens(arguments)
    if arguments.json:
        print_json(info_document(lens))
    else:
        print(info_text(lens, arguments.lens))


def info_document(lens: Lens) -> dict:
    """What `raytrace info --json` writes."""
    indices = media(lens, lens.wavelengths)
    return {
        "name": lens.name,
        **{name: number(figure) for (_, name, _), figure in zip(FIRST_ORDER_LINES, _figures(lens), strict=True)},
        "wavelengths": numbers(lens.wavelengths),
        "wavelength_weights": numbers(lens.wavelength_weights),
        "primary_wavelength": lens.primary_wavelength,
        "field_type": lens.fields.kind,
        "field_unit": FIELD_UNITS[lens.fields.kind],
        "fields": [
            {"x": number(x), "y": number(y), "weight": number(weight)}
            for x, y, weight in zip(lens.fields.x, lens.fields.y, lens.fields.weight, strict=True)
        ],
        "aperture": {"kind": lens.aperture.kind, "value": number(lens.aperture.value)},
        "stop_surface": lens.stop,
        "surfaces": [
            {
                "surface": k,
                "curvature": number(0.0 if surface.curvature is None else surface.curvature),
                "conic": number(0.0 if surface.conic is None else surface.conic),
                "coefficients": [] if surface.coefficients is None else numbers(surface.coefficients),
                **({} if surface.kind == EVEN else {"kind": surface.kind}),
                "thickness": number(surface.thickness),
                "glass": surface.glass.name or None,
                "indices": numbers(indices[k].expand_as(lens.wavelengths)),
                "semi_diameter": number(surface.semi_diameter),
                "comment": surface.comment,
            }
            for k, surface in enumerate(lens.surfaces)
        ],
    }


def info_text(lens: Lens, title: str) -> str:
    """What `raytrace info` prints."""
    lines = [f"{title}: {lens.name}" if lens.name else title, ""]
    for (words, _, unit), figure in zip(FIRST_ORDER_LINES, _figures(lens), strict=True):
        lines.append(f"  {words:<24} {_quantity(figure):>16}  {unit}".rstrip())
    unit = FIELD_UNITS[lens.fields.kind]
    points = ", ".join(f"({x:g}, {y:g})" for x, y in zip(lens.fields.x.tolist(), lens.fields.y.tolist(), strict=True))
    shown = [
        f"{w:g}" + ("*" if i == lens.primary_wavelength and len(lens.wavelengths) > 1 else "")
        for i, w in enumerate(lens.wavelengths.tolist())
    ]
    lines += [
        f"  {'wavelengths':<24} {', '.join(shown)} µm" + ("  (* primary)" if len(shown) > 1 else ""),
        f"  {'fields':<24} {points} {unit}, {lens.fields.kind.replace('_', ' ')}",
        "",
        f"  {'surface':>7} {'radius':>13} {'thickness':>12} {'glass':<12} {'index':>9} {'semi-dia.':>10}  note",
    ]
    indices = media(lens, lens.wavelengths[lens.primary_wavelength])
    for k, surface in enumerate(lens.surfaces):
        curvature = float(vertex_curvature(surface)) if surface.curvature is None else float(surface.curvature)
        radius = "inf" if curvature == 0 else f"{1 / curvature:.6g}"
        size = "" if surface.semi_diameter is None else f"{surface.semi_diameter:.5g}"
        lines.append(
            f"  {k:>7} {radius:>13} {float(surface.thickness):>12.7g} {surface.glass.name:<12} "
            f"{float(indices[k]):>9.6f} {size:>10}  {_remarks(lens, k)}".rstrip()
        )
    return "\n".join(lines)


def _quantity(value: float) -> str:
    """A number, "infinite", which has no sign, or - for one that does not exist."""
    if math.isnan(value):
        return "-"
    return "infinite" if math.isinf(value) else f"{value + 0.0:.9g}"


def _figures(lens: Lens) -> list[float]:
    """The numbers of FIRST_ORDER_LINES; nan or infinite where a quantity does not exist."""
    data, real = first_order(lens), real_working_f_number(lens)
    return [float(getattr(data, name, real)) for _, name, _ in FIRST_ORDER_LINES]


def _remarks(lens: Lens, k: int) -> str:
    surface = lens.surfaces[k]
    parts = {0: ["object"], lens.stop: ["stop"], len(lens.surfaces) - 1: ["image"]}.get(k, [])
    if surface.conic is not None:
        parts.append(f"conic {float(surface.conic):g}")
    if surface.coefficients is not None:
        parts.append(surface.kind)
    parts += [f"{a.shape} {'obscuration' if a.obscures else 'aperture'}" for a in surface.apertures]
    return ", ".join(dict.fromkeys(filter(None, [*parts, surface.comment])))


def layout(arguments: argparse.Namespace) -> None:
    """The cross section with rays."""
    lens = open_lens(arguments)
    from raytrace import plot

    output = arguments.plot or f"{Path(arguments.lens).stem}_layout{arguments.suffix}.png"
    fields = field_points(lens, arguments)
    figure = plot.layout(lens, fields=fields)
    plot.save(figure, output)
    if arguments.json:
        print_json({"output": output, "fields": [numbers(point) for point in torch.unbind(fields, 1)]})
    else:
        say(f"layout written to {output}")
