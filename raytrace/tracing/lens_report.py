"""Lens report: first-order data and the prescription of a lens, as text, table and document."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.materials.environment import in_words as environment_in_words
from raytrace.materials.glass import label
from raytrace.maths.numerics import detached, summary, value
from raytrace.maths.result import Column, Result, Table, number, numbers, quantity_remark, quantity_text
from raytrace.system.configurations import count
from raytrace.system.lens import FIELD_UNITS, Lens, field_points, glass_on_image, is_round_about_axis, media
from raytrace.system.phases import IdealLens, Phase
from raytrace.system.poses import Pose
from raytrace.system.sag_terms import SagTerms
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface, vertex_curvature
from raytrace.tracing.base_ray import base_ray
from raytrace.tracing.f_number import working_f_number
from raytrace.tracing.geometry import (
    defects,
    fixed_semi_diameters,
    mechanical_semi_diameters,
    semi_diameters,
    warn_of_defects,
)
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.paraxial import LINES, first_order
from raytrace.tracing.trace import aiming_of

#: Descriptions of phases and sag terms with their numbers; others are described by their class alone.
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
    """Descriptions of the kind of sag, the sag terms, the phase and the poses of a surface."""
    parts: list[str] = []
    if surface.coefficients is not None:
        parts.append(surface.kind)
        for name, number_of in zip(KINDS[surface.kind].heads, surface.coefficients.tolist(), strict=False):
            if name == "curvature_x":
                name, number_of = "radius x", 1 / number_of if number_of else math.inf
            parts.append(f"{name.replace('_', ' ')} {number_of:.6g}")
    for part in (surface.sag_terms, surface.phase):
        if isinstance(part, IdealLens):
            x, y = (1 / power if power else math.inf for power in (float(part.power_x), float(part.power_y)))
            parts.append(f"ideal lens, f {x:.6g} mm" + ("" if x == y else f" in x, {y:.6g} mm in y"))
        elif part is not None:
            scalars = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
            scalars = {name: float(n) for name, n in scalars.items() if isinstance(n, Tensor) and n.dim() == 0}
            parts.append(_WORDS.get(type(part).__name__, type(part).__name__).format(**scalars))
    if surface.is_break:
        return [*parts, "coordinate break", *_pose(surface.before)]
    for where, pose in (("before", surface.before), ("behind", surface.after)):
        if words := _pose(pose):
            parts += [f"{where}: {words[0]}", *words[1:]]
    return parts


def entries(surface: Surface) -> dict:
    """The kind of sag, sag terms, phase and poses of a surface for a document; empty for a plain surface."""
    document: dict = {} if surface.kind == EVEN else {"kind": surface.kind}
    for name, part in (("sag_terms", surface.sag_terms), ("phase", surface.phase)):
        if part is not None:
            document[name] = {"kind": type(part).__name__, **_fields(part)}
    for name, pose in (("before", surface.before), ("after", surface.after)):
        if pose is not None:
            document[name] = _fields(pose)
    return document | ({"is_break": True} if surface.is_break else {})


def _pose(pose: Pose | None) -> list[str]:
    if pose is None:
        return []
    shifts, tilts = {"x": pose.x, "y": pose.y, "z": pose.z}, {"x": pose.tilt_x, "y": pose.tilt_y, "z": pose.tilt_z}
    decentre = " ".join(f"{axis} {float(shift):.6g}" for axis, shift in shifts.items() if shift is not None)
    tilt = " ".join(f"{axis} {float(angle):.6g}°" for axis, angle in tilts.items() if angle is not None)
    parts = [*([f"decentre {decentre} mm"] if decentre else []), *([f"tilt {tilt}"] if tilt else [])]
    return parts[::-1] if pose.tilts_first else parts


def _fields(part: SagTerms | Phase | Pose) -> dict:
    """The fields of a value that are not None, tensors as numbers."""
    document = {}
    for field in dataclasses.fields(part):
        entry = getattr(part, field.name)
        if isinstance(entry, Tensor):
            document[field.name] = number(entry) if entry.dim() == 0 else numbers(entry)
        elif entry is not None:
            document[field.name] = entry
    return document


#: Lines of `raytrace info`: those of first-order data, with the real working F/#.
FIRST_ORDER_LINES = (
    *LINES[:5], ("working F/#", "working_f_number", "1/(2 n' sin θ') of the real marginal ray"), *LINES[5:]
)  # fmt: skip

#: Lines of a lens whose axis bends, or whose sections differ: text, entry of BaseRay, unit.
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
    """First-order data and prescription of a lens; the table has a row per surface, with the primary index; mm."""

    COLUMNS = (
        Column("thickness", "mm", ".7g"), Column("glass", form="<"), Column("index", "", ".6f"),
        Column("semi_diameter", "mm", ".5g", "semi-dia."),
        Column("mechanical_semi_diameter", "mm", ".5g", "mech. s.-d."), Column("note", form="<"),
    )  # fmt: skip

    lens: Lens

    def columns(self) -> dict[str, Tensor]:
        lens = detached(self.lens)
        surfaces, like = lens.surfaces, lens.wavelengths
        radius, thickness = like.new_tensor([(_radius(s), float(s.thickness)) for s in surfaces]).T
        clear = semi_diameters(lens)
        sizes = {"semi_diameter": like.new_tensor(clear)}
        if any(surface.chip_zone or surface.mechanical_semi_diameter for surface in surfaces):
            sizes["mechanical_semi_diameter"] = like.new_tensor(mechanical_semi_diameters(lens, clear))
        surface, index = torch.arange(len(surfaces)), like.new_tensor(_indices(lens))
        shape = {"surface": surface, "radius": radius, "thickness": thickness, "glass": surface, "index": index}
        return {**shape, **sizes, "note": surface}

    def words(self) -> dict[str, Sequence[str]]:
        lens = detached(self.lens)
        notes = [_remarks(lens, k) for k in range(len(lens.surfaces))]
        return {"glass": [label(surface.glass) for surface in lens.surfaces], "note": notes}

    def document(self) -> dict:
        lens = detached(self.lens)
        indices, geometry = media(lens, lens.wavelengths), [defect.document() for defect in defects(lens)]
        sizes, fixed = semi_diameters(lens), fixed_semi_diameters(lens)
        widths, data = mechanical_semi_diameters(lens, sizes), first_order(lens)
        return {
            "name": lens.name,
            **{name: number(figure) for (_, name, _), figure in zip(FIRST_ORDER_LINES, _figures(lens), strict=True)},
            **_base_ray_document(lens),
            "wavelengths": numbers(lens.wavelengths),
            "wavelength_weights": numbers(lens.wavelength_weights),
            "primary_wavelength": lens.primary_wavelength,
            "telecentric": data.telecentric_spaces,
            "afocal": "effective_focal_length" in data.infinite(),
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
                    "semi_diameter": number(sizes[k]),
                    "semi_diameter_is_fixed": k in fixed,
                    "chip_zone": surface.chip_zone or 0.0,
                    "mechanical_semi_diameter": number(widths[k]),
                    "mechanical_semi_diameter_is_fixed": surface.mechanical_semi_diameter is not None,
                    "comment": surface.comment,
                    **_environment(surface),
                    **({} if surface.expansion is None else {"expansion": number(surface.expansion)}),
                }
                for k, surface in enumerate(lens.surfaces)
            ],
            **({"geometry": geometry} if geometry else {}),
            **({"conditions": conditions} if (conditions := self._conditions_in_words()) else {}),
        }

    def quantities(self) -> list[tuple[str, str, str]]:
        """First-order data: quantity, value, and unit or definition."""
        lens = detached(self.lens)
        infinite = first_order(lens).infinite()
        rows = ((*line, infinite.get(line[1])) for line in FIRST_ORDER_LINES)
        return [
            (words, quantity_text(figure, word), unit + quantity_remark(figure, word))
            for (words, _, unit, word), figure in zip(rows, _figures(lens), strict=True)
        ]

    def base_ray_quantities(self) -> list[tuple[str, str, str, str]]:
        """Data about the axial chief ray of a lens whose axis bends or whose sections differ: quantity, tangential,
        sagittal, unit; none of other lenses."""
        lens = detached(self.lens)
        if is_round_about_axis(lens) or not bool((base := base_ray(lens)).valid):  # the sections agree in the former
            return []
        infinite = first_order(lens).infinite()
        infinite |= {"focal_length": infinite["effective_focal_length"]} if "effective_focal_length" in infinite else {}
        pairs = [
            (words, [quantity_text(figure, infinite.get(name)) for figure in getattr(base, name).tolist()], unit)
            for words, name, unit in BASE_RAY_LINES
        ]
        return [(words, tangential, sagittal, unit) for words, (tangential, sagittal), unit in pairs]

    def scene(self) -> list[tuple[str, str]]:
        """Wavelengths, fields, ray aiming, configuration, image medium and environment: quantity and text."""
        lens = detached(self.lens)
        points = ", ".join(f"({x:g}, {y:g})" for x, y in field_points(None, like=lens).T.tolist())
        several, which, spaces = len(lens.wavelengths) > 1, _configuration(lens), first_order(lens).telecentric_spaces
        aiming = lens.ray_aiming if lens.ray_aiming != "auto" else f"auto: {aiming_of(lens)}"
        shown = ", ".join(
            f"{w:g}" + ("*" if i == lens.primary_wavelength - 1 and several else "")
            for i, w in enumerate(lens.wavelengths.tolist())
        )
        primary = f"  (* primary: number {lens.primary_wavelength})" if several else ""
        return [
            ("wavelengths", f"{shown} µm{primary}"),
            *([("telecentric", f"in {' and '.join(spaces)} space")] if spaces else []),
            ("ray aiming", aiming),
            *([("configuration", " of ".join(map(str, which.values())))] if which else []),
            ("fields", f"{points} {FIELD_UNITS[lens.fields.kind]}, {lens.fields.kind.replace('_', ' ')}"),
            *([("image space", medium)] if (medium := _image_medium(lens)) else []),
            *([("environment", environment_in_words(lens.environment))] if lens.environment else []),
        ]

    def tables(self) -> list[Table]:
        lens = detached(self.lens)
        lines = [lens.name or "Lens", ""]
        lines += [f"  {words:<24} {figure:>16}  {unit}".rstrip() for words, figure, unit in self.quantities()]
        lines += self._base_ray_lines()
        lines += [*(f"  {words:<24} {text}" for words, text in self.scene()), ""]
        radius = ["-" if s.is_break else _radius(s) for s in lens.surfaces]
        conditions = self._conditions_in_words()
        return [Table({**self.columns(), "radius": radius}, lines, ["", *conditions] if conditions else [])]

    def _base_ray_lines(self) -> list[str]:
        if is_round_about_axis(self.lens):
            return []
        rows = self.base_ray_quantities()
        if not rows:
            return ["", "  the axial chief ray does not reach the image"]
        lines = ["", f"  {'about the axial chief ray':<24} {'tangential':>16} {'sagittal':>16}"]
        lines += [f"  {words:<24} {first:>16} {second:>16}  {unit}".rstrip() for words, first, second, unit in rows]
        return [*lines, ""]

    def _conditions_in_words(self) -> list[str]:
        """The conditions and boundaries of the lens, with the values that it has."""
        from raytrace.optimization.attained import in_words

        return in_words(detached(self.lens)) if self.lens.optimization_data else []


def info(lens: Lens) -> Info:
    """First-order data and prescription, the text of `print(lens)`. Warns UnfilledStop, and Unbuildable."""
    warn_of_defects(lens)
    warn_of_filling(lens, field_points(None, like=lens))
    return Info(lens)


def text(lens: Lens) -> str:
    """The text of `print(lens)`: that of `info`, or the bare numbers of a lens that cannot be traced."""
    try:
        return str(Info(lens))
    except (ValueError, RuntimeError):
        return summary(lens)


def _configuration(lens: Lens) -> dict[str, int]:
    several = count(lens.operands)
    return {"configuration": lens.current_configuration, "configurations": several} if several > 1 else {}


def _radius(surface: Surface) -> float:
    """mm, of the vertex where the surface has no curvature of its own; inf of a plane."""
    curvature = float(vertex_curvature(surface)) if surface.curvature is None else float(surface.curvature)
    return math.inf if curvature == 0 else 1 / curvature


def _environment(holder: Lens | Surface) -> dict:
    place = holder.environment
    if not place:
        return {}
    return {"environment": {"temperature": number(place.temperature), "pressure": number(place.pressure)}}


def _image_medium(lens: Lens) -> str:
    """The index of the image space and the focal length in air, of which the F/# is; "" for an image in air."""
    index, power = float(media(lens, lens.primary)[-1]), float(first_order(lens).power)
    if index == 1 or not math.isfinite(power) or power == 0:
        return ""
    return f"n' = {index:.6g}; focal length in air {1 / power:.9g} mm"


def _indices(lens: Lens) -> list[float]:
    return [float(index) for index in media(lens, lens.primary)]


def _figures(lens: Lens) -> list[float]:
    """The numbers of FIRST_ORDER_LINES; nan or infinite where a quantity does not exist."""
    data, real = first_order(lens), working_f_number(lens)
    return [float(getattr(data, name, real)) for _, name, _ in FIRST_ORDER_LINES]


def _base_ray_document(lens: Lens) -> dict:
    """(tangential, sagittal) of every figure, null for those that do not exist."""
    if is_round_about_axis(lens):  # the sections agree with the straightened lens
        return {}
    base = base_ray(lens)
    figures = {name: numbers(getattr(base, name)) for _, name, _ in BASE_RAY_LINES}
    place = {"position": numbers(base.position), "direction": numbers(base.direction)}
    return {"base_ray": {"valid": bool(base.valid), **place, **figures}}


def _remarks(lens: Lens, k: int) -> str:
    surface = lens.surfaces[k]
    parts = {0: ["object"], lens.stop: ["stop"], len(lens.surfaces) - 1: ["image"]}.get(k, [])
    if surface.conic is not None:
        parts.append(f"conic {float(surface.conic):g}")
    parts += remarks(surface)
    if k == len(lens.surfaces) - 1 and (unused := glass_on_image(lens)):
        parts.append(f"light does not enter {unused}")
    if surface.environment is not None:
        parts.append(f"in {environment_in_words(surface.environment)}")
    if surface.expansion is not None:
        parts.append(f"expansion {float(surface.expansion):g}e-6/K")
    parts += [f"{a.shape} {'obscuration' if a.obscures else 'aperture'}" for a in surface.apertures]
    return ", ".join(dict.fromkeys(filter(None, [*parts, surface.comment])))
