"""Views of a lens as it stands: first-order data and prescription, and the cross section.

Remarks: what a surface is beside a conic, in words for a table and by name for a document.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.materials.environment import in_words
from raytrace.materials.glass import label
from raytrace.maths.result import Result, number, numbers
from raytrace.maths.value import detached, value
from raytrace.system.configurations import count
from raytrace.system.lens import FIELD_UNITS, Lens, field_points, media
from raytrace.system.phases import IdealLens
from raytrace.system.poses import Pose
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface, is_posed, is_round, vertex_curvature
from raytrace.tracing.aiming import aiming_of
from raytrace.tracing.base_ray import base_ray
from raytrace.tracing.f_number import working_f_number
from raytrace.tracing.geometry import defects, warn_of_defects
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.paraxial import first_order

#: What phases and departures are called, with their own numbers; of others their kind stands alone.
_WORDS = {
    "Grating": "grating of {frequency:.6g} lines/µm, order {order:g}",
    "RadialPhase": "binary 2 over {radius:.6g} mm, order {order:g}",
    "PolynomialPhase": "binary 1 over {radius:.6g} mm, order {order:g}",
    "FringePhase": "Zernike fringe phase over {radius:.6g} mm, order {order:g}",
    "Hologram": "hologram of {wavelength:g} µm, order {order:g}",
    "Facets": "Fresnel lens",
    "TiltSag": "plane with slopes {tan_x:.6g}, {tan_y:.6g}",
    "PolynomialSag": "x-y polynomial over {radius:.6g} mm",
    "FringeSag": "Zernike fringe sag over {radius:.6g} mm",
    "ZernikeSag": "Zernike sag over {radius:.6g} mm",
    "IrregularSag": "irregular by {spherical:.6g}, {astigmatism:.6g}, {coma:.6g} mm over {radius:.6g} mm",
    "GridSag": "height map, {pitch:.6g} mm apart",
    "SplineSag": "height map, {pitch:.6g} mm apart",
}


def remarks(surface: Surface) -> list[str]:
    """What a surface is beside a conic: its kind of sag, its departure, its phase, and how it stands."""
    found = [*_kind(surface), *(_part(part) for part in (surface.sag_terms, surface.phase) if part is not None)]
    if surface.is_break:
        return [*found, "coordinate break", *_pose(surface.before)]
    for where, pose in (("before", surface.before), ("behind", surface.after)):
        if words := _pose(pose):
            found += [f"{where}: {words[0]}", *words[1:]]
    return found


def entries(surface: Surface) -> dict:
    """The same for a document: keys that only such surfaces have."""
    found: dict = {} if surface.kind == EVEN else {"kind": surface.kind}
    for name in ("sag_terms", "phase"):
        part = getattr(surface, name)
        if part is not None:
            found[name] = {"kind": type(part).__name__, **_fields(part)}
    for name in ("before", "after"):
        if getattr(surface, name) is not None:
            found[name] = _fields(getattr(surface, name))
    return found | ({"is_break": True} if surface.is_break else {})


def _kind(surface: Surface) -> list[str]:
    """The kind of sag, with the numbers that stand before its terms."""
    if surface.coefficients is None:
        return []
    heads = zip(KINDS[surface.kind].heads, surface.coefficients.tolist(), strict=False)
    return [surface.kind, *(_head(name, value) for name, value in heads)]


def _head(name: str, value: float) -> str:
    if name != "curvature_x":
        return f"{name.replace('_', ' ')} {value:.6g}"
    return f"radius x {1 / value:.6g}" if value else "radius x inf"


def _part(part) -> str:
    if isinstance(part, IdealLens):
        return f"ideal lens, f {_focal_lengths(float(part.power_x), float(part.power_y))}"
    scalars = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    scalars = {name: float(one) for name, one in scalars.items() if isinstance(one, Tensor) and one.dim() == 0}
    name = type(part).__name__
    return _WORDS.get(name, name).format(**scalars)


def _focal_lengths(power_x: float, power_y: float) -> str:
    x, y = (1 / power if power else math.inf for power in (power_x, power_y))
    return f"{x:.6g} mm" if x == y else f"{x:.6g} mm in x, {y:.6g} mm in y"


def _pose(pose: Pose | None) -> list[str]:
    if pose is None:
        return []
    decentres = [f"{axis} {float(at):.6g}" for axis in "xyz" if (at := getattr(pose, axis)) is not None]
    tilts = [f"{axis} {float(at):.6g}°" for axis in "xyz" if (at := getattr(pose, f"tilt_{axis}")) is not None]
    parts = [f"decentre {' '.join(decentres)} mm"] if decentres else []
    parts += [f"tilt {' '.join(tilts)}"] if tilts else []
    return [*(reversed(parts) if pose.tilts_first else parts)]


def _fields(part) -> dict:
    found = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    return {name: _plain(one) for name, one in found.items() if one is not None}


def _plain(one):
    if not isinstance(one, Tensor):
        return one
    return number(one) if one.dim() == 0 else numbers(one)


#: Lines of `raytrace info`: words, entry of FirstOrder (and the working F/# of real light), unit.
FIRST_ORDER_LINES = (
    ("effective focal length", "effective_focal_length", "mm"),
    ("back focal distance", "back_focal_distance", "mm, from the last surface before the image"),
    ("front focal distance", "front_focal_distance", "mm, from surface 1"),
    ("F/#", "f_number", "focal length / entrance pupil diameter"),
    ("paraxial working F/#", "paraxial_working_f_number", "1/(2 n' u')"),
    ("working F/#", "working_f_number", "1/(2 n' sin θ') of the real marginal ray"),
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

#: Lines of a lens whose axis bends, or whose sections differ: words, entry of BaseRay, unit.
BASE_RAY_LINES = (
    ("focal length", "focal_length", "mm"),
    ("back focal distance", "back_focal_distance", "mm along the base ray, from the last surface that is no break"),
    ("entrance pupil position", "entrance_pupil_position", "mm along the base ray, from surface 1"),
    ("entrance pupil diameter", "entrance_pupil_diameter", "mm"),
    ("exit pupil position", "exit_pupil_position", "mm along the base ray, from the image"),
    ("exit pupil diameter", "exit_pupil_diameter", "mm"),
    ("image distance", "image_distance", "mm along the base ray, from the last surface that is no break"),
    ("paraxial working F/#", "paraxial_working_f_number", "1/(2 n' u')"),
    ("magnification", "magnification", ""),
)


@value
class Info(Result):
    """First-order data and the prescription of a lens; the table has a row a surface: mm, the index at the primary
    wavelength."""

    lens: Lens

    def columns(self) -> dict[str, Tensor]:
        lens = detached(self.lens)
        surfaces, like = lens.surfaces, lens.wavelengths
        number_of = torch.arange(len(surfaces))
        rows = [
            (_radius(s), float(s.thickness), math.nan if s.semi_diameter is None else s.semi_diameter) for s in surfaces
        ]
        radius, thickness, size = like.new_tensor(rows).T
        return {
            "surface": number_of, "radius": radius, "thickness": thickness, "glass": number_of,
            "index": like.new_tensor(_indices(lens)), "semi_diameter": size, "note": number_of,
        }  # fmt: skip

    def words(self) -> dict[str, Sequence[str]]:
        lens = detached(self.lens)
        surfaces = lens.surfaces
        return {
            "glass": [label(s.glass) for s in surfaces],
            "note": [_remarks(lens, k) for k in range(len(surfaces))],
        }

    def document(self) -> dict:
        lens = detached(self.lens)
        indices, found = media(lens, lens.wavelengths), defects(lens)
        return {
            "name": lens.name,
            **{name: number(figure) for (_, name, _), figure in zip(FIRST_ORDER_LINES, _figures(lens), strict=True)},
            **_about_base_ray(lens),
            "wavelengths": numbers(lens.wavelengths),
            "wavelength_weights": numbers(lens.wavelength_weights),
            "primary_wavelength": lens.primary_wavelength,
            "ray_aiming": lens.ray_aiming,
            "rays_aimed": aiming_of(lens),
            "field_type": lens.fields.kind,
            "field_unit": FIELD_UNITS[lens.fields.kind],
            "fields": [
                {"x": number(x), "y": number(y), "weight": number(weight)}
                for x, y, weight in zip(lens.fields.x, lens.fields.y, lens.fields.weight, strict=True)
            ],
            "aperture": {"kind": lens.aperture.kind, "value": number(lens.aperture.value)},
            **_environment(lens),
            "stop_surface": lens.stop,
            **_configuration(lens),
            "surfaces": [
                {
                    "surface": k,
                    "curvature": number(0.0 if surface.curvature is None else surface.curvature),
                    "conic": number(0.0 if surface.conic is None else surface.conic),
                    "coefficients": [] if surface.coefficients is None else numbers(surface.coefficients),
                    **entries(surface),
                    "thickness": number(surface.thickness),
                    "glass": label(surface.glass) or None,
                    "indices": numbers(indices[k].expand_as(lens.wavelengths)),
                    "semi_diameter": number(surface.semi_diameter),
                    "comment": surface.comment,
                    **_environment(surface),
                }
                for k, surface in enumerate(lens.surfaces)
            ],
            **({"geometry": [one.document() for one in found]} if found else {}),
        }

    def __str__(self) -> str:
        lens = detached(self.lens)
        lines = [lens.name or "Lens", ""]
        for (words, _, unit), figure in zip(FIRST_ORDER_LINES, _figures(lens), strict=True):
            lines.append(f"  {words:<24} {_quantity(figure):>16}  {unit}".rstrip())
        lines += _base_ray_lines(lens)
        points = ", ".join(f"({x:g}, {y:g})" for x, y in field_points(None, like=lens).T.tolist())
        several, which = len(lens.wavelengths) > 1, _configuration(lens)
        shown = [
            f"{w:g}" + ("*" if i == lens.primary_wavelength - 1 and several else "")
            for i, w in enumerate(lens.wavelengths.tolist())
        ]
        lines += [
            f"  {'wavelengths':<24} {', '.join(shown)} µm"
            + (f"  (* primary: number {lens.primary_wavelength})" if several else ""),
            f"  {'ray aiming':<24} {_aiming(lens)}",
            *([f"  {'configuration':<24} {' of '.join(map(str, which.values()))}"] if which else []),
            f"  {'fields':<24} {points} {FIELD_UNITS[lens.fields.kind]}, {lens.fields.kind.replace('_', ' ')}",
            *([f"  {'environment':<24} {in_words(lens.environment)}"] if lens.environment else []),
            "",
            f"  {'surface':>7} {'radius':>13} {'thickness':>12} {'glass':<12} {'index':>9} {'semi-dia.':>10}  note",
        ]
        for k, (surface, index) in enumerate(zip(lens.surfaces, _indices(lens), strict=True)):
            size = surface.semi_diameter
            lines.append(
                f"  {k:>7} {_radius_in_words(surface):>13} {float(surface.thickness):>12.7g} "
                f"{label(surface.glass):<12} {index:>9.6f} {'' if size is None else f'{size:.5g}':>10}  "
                f"{_remarks(lens, k)}".rstrip()
            )
        return "\n".join(lines)


def info(lens: Lens) -> Info:
    """First-order data and prescription; what `print(lens)` shows. Warns UnfilledStop, and Unbuildable of a lens that
    cannot be made."""
    warn_of_defects(lens)
    warn_of_filling(lens, field_points(None, like=lens))
    return Info(lens)


def text(lens: Lens) -> str:
    """What `print(lens)` shows: the lens as `info` tells it, or its bare numbers where it cannot be traced."""
    try:
        return str(Info(lens))
    except (ValueError, RuntimeError):
        return repr(lens)


def _configuration(lens: Lens) -> dict[str, int]:
    """Which of its configurations a lens is in, and how many there are; nothing of a lens with one."""
    several = count(lens.operands)
    return {"configuration": lens.current_configuration, "configurations": several} if several > 1 else {}


def _aiming(lens: Lens) -> str:
    """The ray aiming of a lens, and what "auto" comes to."""
    return lens.ray_aiming if lens.ray_aiming != "auto" else f"auto: {aiming_of(lens)}"


def _radius(surface) -> float:
    """mm, of the vertex where the surface has no curvature of its own; inf of a plane."""
    curvature = float(vertex_curvature(surface)) if surface.curvature is None else float(surface.curvature)
    return math.inf if curvature == 0 else 1 / curvature


def _radius_in_words(surface: Surface) -> str:
    """The radius as the table shows it; - for a coordinate break, which has none."""
    radius = _radius(surface)
    return "-" if surface.is_break else "inf" if math.isinf(radius) else f"{radius:.6g}"


def _environment(holder: Lens | Surface) -> dict:
    """The entry of a document for an environment, where there is one."""
    place = holder.environment
    return (
        {"environment": {"temperature": number(place.temperature), "pressure": number(place.pressure)}} if place else {}
    )


def _indices(lens: Lens) -> list[float]:
    return [float(index) for index in media(lens, lens.primary)]


def _quantity(value: float) -> str:
    """A number, "infinite", which has no sign, or - for one that does not exist."""
    if math.isnan(value):
        return "-"
    return "infinite" if math.isinf(value) else f"{value + 0.0:.9g}"


def _figures(lens: Lens) -> list[float]:
    """The numbers of FIRST_ORDER_LINES; nan or infinite where a quantity does not exist."""
    data, real = first_order(lens), working_f_number(lens)
    return [float(getattr(data, name, real)) for _, name, _ in FIRST_ORDER_LINES]


def _has_sections(lens: Lens) -> bool:
    """Whether first-order data about the base ray say more than the straightened ones."""
    return not all(is_round(surface) and not is_posed(surface) for surface in lens.surfaces)


def _about_base_ray(lens: Lens) -> dict:
    """What JSON says of the base ray: (tangential, sagittal) of every figure, null for what does not exist."""
    if not _has_sections(lens):
        return {}
    base = base_ray(lens)
    figures = {name: numbers(getattr(base, name)) for _, name, _ in BASE_RAY_LINES}
    place = {"position": numbers(base.position), "direction": numbers(base.direction)}
    return {"base_ray": {"valid": bool(base.valid), **place, **figures}}


def _base_ray_lines(lens: Lens) -> list[str]:
    if not _has_sections(lens):
        return []
    base = base_ray(lens)
    if not bool(base.valid):
        return ["", "  the axial chief ray does not reach the image"]
    lines = ["", f"  {'about the axial chief ray':<24} {'tangential':>16} {'sagittal':>16}"]
    for words, name, unit in BASE_RAY_LINES:
        figures = " ".join(f"{_quantity(figure):>16}" for figure in getattr(base, name).tolist())
        lines.append(f"  {words:<24} {figures}  {unit}".rstrip())
    return [*lines, ""]


def _remarks(lens: Lens, k: int) -> str:
    surface = lens.surfaces[k]
    parts = {0: ["object"], lens.stop: ["stop"], len(lens.surfaces) - 1: ["image"]}.get(k, [])
    if surface.conic is not None:
        parts.append(f"conic {float(surface.conic):g}")
    parts += remarks(surface)
    if surface.environment is not None:
        parts.append(f"in {in_words(surface.environment)}")
    parts += [f"{a.shape} {'obscuration' if a.obscures else 'aperture'}" for a in surface.apertures]
    return ", ".join(dict.fromkeys(filter(None, [*parts, surface.comment])))
