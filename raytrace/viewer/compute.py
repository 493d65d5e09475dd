"""Numbers and drawings of a lens that the viewer shows, all of them from the library's analyses.

`refresh` is what a drag needs. Slower analyses follow when the slider is released: `mtf_of_field`, of diffraction, and
the warnings of the analyses, `remarks`.
"""

import dataclasses
import math
from contextlib import suppress
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from raytrace.analysis.chief import field_curvature_of
from raytrace.analysis.fans import ray_fan_of
from raytrace.analysis.layout import draw_layout
from raytrace.analysis.mtf import geometric_mtf, least_reach, mtf, transfer
from raytrace.analysis.setting import field_range
from raytrace.analysis.spot_diagram import airy_radius, field_spots
from raytrace.materials.glass import label
from raytrace.maths.numerics import detached
from raytrace.maths.result import masked, plain
from raytrace.maths.sampling import hexapolar
from raytrace.optimization.attained import Attained, attained_by
from raytrace.optimization.conditions import OFF
from raytrace.plotting import style
from raytrace.system.configurations import count
from raytrace.system.lens import Lens, computed_once, field_label, field_points, shared
from raytrace.system.parameter_paths import number_at, parameter_paths
from raytrace.tracing.f_number import working_f_number
from raytrace.tracing.geometry import defects, fixed_semi_diameters, mechanical_semi_diameters, semi_diameters
from raytrace.tracing.launch import unfilled
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.ray_failures import ray_failures
from raytrace.viewer.state import State, has_merit, named, shown_fields, slider_ends, word_of

_detached = shared(detached)

#: Rays of a fan and of a field in the layout, rings of dots, fields of a curve, frequencies of the MTF.
FAN, RAYS, RINGS, FIELDS, FREQUENCIES = 33, 7, 8, 17, 81
_DIGITS = 5  # of the cross section


def curves(values: Tensor) -> list:
    """Numbers of a drawing, to six digits of the largest; None for nan."""
    numbers = style.array(values)
    finite = np.isfinite(numbers)
    largest = np.abs(numbers[finite]).max(initial=0.0)
    exponent = math.floor(math.log10(1.000001 * largest)) if largest > 0 else 0  # of 1 and of 1 - 1e-16 alike
    rounded = numbers.round(5 - exponent).tolist()
    return rounded if finite.all() else plain(rounded)


def hexadecimal(colour: str | tuple[float, ...]) -> str:
    return colour if isinstance(colour, str) else "#" + "".join(f"{round(255 * part):02x}" for part in colour)


# -- the drawing of a lens


class Drawing:
    """Axes that keep the lines and areas of a cross section as data; the page draws them."""

    def __init__(self) -> None:
        self.shapes: list[dict[str, Any]] = []
        self.patches: list = []
        self.limits = {"x": (0.0, 1.0), "y": (0.0, 1.0)}
        self.dataLim = self

    def plot(
        self, x: ArrayLike, y: ArrayLike, *marker: str, color: str = "", linewidth: float = 1.0, linestyle: str = "",
        gid: str = "", **look: object,
    ) -> None:  # fmt: skip
        dashed = linestyle not in ("", "-") and not marker
        self._add(x, y, kind="mark" if marker else "line", stroke=color, width=linewidth, dashed=dashed, id=gid)

    def fill(
        self, x: ArrayLike, y: ArrayLike, *, facecolor: str = "", color: str = "", gid: str = "", **look: object
    ) -> None:
        self._add(x, y, kind="area", fill=facecolor or color, id=gid)

    def _add(self, x: ArrayLike, y: ArrayLike, **look: Any) -> None:
        look |= {name: hexadecimal(look[name]) for name in ("stroke", "fill") if name in look}
        points = np.stack(np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float)))
        self.shapes.append({**look, "points": points})

    def annotate(self, words: str, place: tuple, *more: object, **look: object) -> None:
        self.shapes.append({"kind": "text", "text": words, "points": np.array(place, dtype=float)[:, None]})

    def set_xlim(self, low: float, high: float) -> None:
        self.limits["x"] = low, high

    def set_ylim(self, low: float, high: float) -> None:
        self.limits["y"] = low, high

    def get_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower left and upper right corner of all shapes."""
        points = np.concatenate([shape["points"] for shape in self.shapes], 1)
        return points.min(1), points.max(1)

    def relim(self) -> None:
        """Limits follow the shapes."""

    def set_aspect(self, aspect: str) -> None:
        """Both directions have one scale."""

    axis = set_aspect

    def document(self) -> dict:
        size = self.limits["x"][1] - self.limits["x"][0]
        places = _DIGITS - 1 - math.floor(math.log10(size))
        shapes = [{**shape, "points": shape["points"].round(places).tolist()} for shape in self.shapes]
        return {"shapes": shapes, **self.limits}


def layout_of(lens: Lens, fields: Tensor) -> dict:
    """The cross section with the rays of fields (2, F). Raises ValueError for a lens that cannot be drawn."""
    drawing = Drawing()
    draw_layout(cast(style.Axes, drawing), lens, fields=fields, rays=RAYS)  # a drawing has the methods that it calls
    return drawing.document()


# -- analyses


def spots_of(lens: Lens, fields: Tensor) -> dict:
    """Spots of fields (2, F): radii in µm, and dots in thousandths of the largest radius about the centroid."""
    whole, dots = field_spots(lens, fields=fields, rings=RINGS)
    offset = torch.where(dots.valid, dots.points - whole.centroid[:, :, None, None], torch.nan)
    half = float(whole.geometric_radius.nan_to_num(0.0).max())
    scaled = (1e3 / half if half > 0 else 0.0) * style.array(offset)
    listed = []
    for field in np.moveaxis(scaled, 0, -1):  # (W, P, 2)
        listed.append([dot[~np.isnan(dot[:, 0])].round().astype(int).ravel().tolist() for dot in field])
    return {
        "rms": plain((1e3 * whole.rms_radius).tolist()),
        "airy": plain(1e3 * float(airy_radius(lens))),
        "half": 1e3 * half,
        "dots": listed,
    }


def fans_of(lens: Lens, fields: Tensor) -> dict:
    """Ray fans in µm, (F, W, P) each; None where no ray arrives."""
    fan = ray_fan_of(lens, fields, FAN)
    tangential, sagittal = masked(fan.tangential, fan.tangential_valid), masked(fan.sagittal, fan.sagittal_valid)
    return {"pupil": fan.pupil.tolist(), "tangential": curves(1e3 * tangential), "sagittal": curves(1e3 * sagittal)}


def curvature_of(lens: Lens) -> dict:
    """Field curvature in mm over fields from the axis to the largest, (W, F) each."""
    fields = field_range(lens, FIELDS)
    foci = field_curvature_of(lens, fields)
    tangential, sagittal = (masked(curve, foci.valid).T for curve in (foci.tangential, foci.sagittal))
    return {"field": fields[1].tolist(), "tangential": curves(tangential), "sagittal": curves(sagittal)}


def mtf_of(lens: Lens, fields: Tensor, highest: float, *, diffraction: bool = False) -> dict:
    """MTF (F, K) of rays, or of diffraction, up to the highest frequency in cycles/mm."""
    frequencies = torch.linspace(0.0, highest, FREQUENCIES, dtype=fields.dtype)
    contrast: Any = mtf(lens, frequencies, fields=fields) if diffraction else geometric_mtf(lens, fields, frequencies)
    return {
        "frequency": frequencies.tolist(),
        "tangential": curves(contrast.tangential),
        "sagittal": curves(contrast.sagittal),
        "limit": None if contrast.limit is None else curves(contrast.limit.amax((0, 1))),
        "transfer": transfer(contrast),
    }


def first_order_of(lens: Lens) -> list[dict]:
    """First-order data and the working F/#: name, value and unit; words of a value that is infinite in practice."""
    data = first_order(lens)
    infinite = data.infinite()
    names = {"EFL": "effective_focal_length", "entrance pupil": "entrance_pupil_position",
        "exit pupil": "exit_pupil_position"}  # fmt: skip
    rows = (
        ("EFL", data.effective_focal_length, "mm"),
        ("BFD", data.back_focal_distance, "mm"),
        ("F/#", data.f_number, ""),
        ("working F/#", working_f_number(lens), ""),
        ("EPD", data.entrance_pupil_diameter, "mm"),
        ("entrance pupil", data.entrance_pupil_position, "mm"),
        ("exit pupil", data.exit_pupil_position, "mm"),
        ("m", data.magnification, ""),
        ("image at", data.paraxial_image_distance, "mm"),
    )
    return [
        {"name": name, "value": plain(float(value)), "unit": unit}
        | ({"words": word} if (word := infinite.get(names.get(name, ""))) else {})
        for name, value, unit in rows
    ]


def refresh(state: State) -> dict:
    """All numbers of the page after an edit. Analyses that fail are None, with reasons in `problems`."""
    with torch.no_grad(), computed_once():
        analyses, problems = _analyses(state.lens, state.frequency)
        stored = _analyses(state.stored, state.frequency)[0] if state.compare else None
        shown = {"prescription": prescription(state), "analyses": analyses, "stored": stored}
    return {**shown, "problems": problems, "message": state.message}


def _simple(lens: Lens) -> Lens:
    """The lens as plain numbers; vignetting factors that are all 0 are not modelled."""
    lens = _detached(lens)
    if lens.fields.vignetting is None or bool(lens.fields.vignetting.any()):
        return lens
    return dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, vignetting=None))


def _analyses(lens: Lens, highest: float) -> tuple[dict, list[str]]:
    """The analyses by name, and why some are None, or rays are lost."""
    lens, problems = _simple(lens), []
    fields = shown_fields(lens)
    results: dict[str, Any] = {
        "fields": [field_label(lens, point) for point in fields.T.tolist()],
        "wavelengths": lens.wavelengths.tolist(),
        "field_colours": style.field_colours(fields.shape[1]),
        "wavelength_colours": [hexadecimal(colour) for colour in style.wavelength_colours(lens.wavelengths.tolist())],
    }
    for name, analysis in {
        "layout": lambda: layout_of(lens, fields),
        "spots": lambda: spots_of(lens, fields),
        "fans": lambda: fans_of(lens, fields),
        "mtf": lambda: (
            results["spots"] and mtf_of(lens, fields, min(highest, least_reach(1e-3 * results["spots"]["half"])))
        ),
        "curvature": lambda: curvature_of(lens),
        "first_order": lambda: first_order_of(lens),
    }.items():
        try:
            results[name] = analysis()
        except (ValueError, RuntimeError, ArithmeticError) as error:
            results[name] = None
            problems.append(str(error))
    dark = [f for f, radius in enumerate(results["spots"]["rms"] if results["spots"] else ()) if radius is None]
    return results, _lost(lens, fields[:, dark]) if dark else problems


def _lost(lens: Lens, fields: Tensor) -> list[str]:
    """Where the rays of fields (2, F) end, none of which reaches the sensor."""
    pupil = hexapolar(4, dtype=lens.wavelengths.dtype)[0]
    failures = ray_failures(lens, pupil, fields=fields, wavelengths=lens.primary[None])
    return [f"field {field_label(lens, point)}: {failures.words(f, 0)}" for f, point in enumerate(fields.T.tolist())]


def mtf_of_field(state: State, field: int) -> dict:
    """The MTF of one of the shown fields, of diffraction, and with `compare` that of the stored lens; None where the
    blur is too large for it to differ."""
    result: dict[str, Any] = {"field": field, "mtf": _diffraction_mtf(state.lens, field, state.frequency)}
    if state.compare:
        result["stored_mtf"] = _diffraction_mtf(state.stored, field, state.frequency)
    return result


def _diffraction_mtf(lens: Lens, field: int, highest: float) -> dict | None:
    with torch.no_grad(), computed_once(), suppress(ValueError, RuntimeError, ArithmeticError):  # as `refresh` reports
        lens = _simple(lens)
        fields = shown_fields(lens)
        radius = field_spots(lens, fields=fields, rings=1)[0].geometric_radius.nan_to_num(0.0).max()
        if field < fields.shape[1] and least_reach(float(radius)) >= highest / 3:
            return mtf_of(lens, fields[:, field : field + 1], highest, diffraction=True)
    return None


def remarks(state: State) -> list[str]:
    """Rays that miss the stop, surfaces and gaps that cannot be made."""
    lens = _detached(state.lens)
    with torch.no_grad(), computed_once():
        return [
            *filter(None, [unfilled(lens, field_points(None, like=lens))]),
            *(defect.words for defect in defects(lens)),
        ]


# -- the prescription


def prescription(state: State) -> dict:
    """The table of the lens and its conditions."""
    lens = _detached(state.lens)
    data = lens.optimization_data
    follows = {word_of(solve) for solve in (data.solves if data else ())}
    rows, last, sizes = [], len(lens.surfaces) - 1, semi_diameters(lens)
    widths, fixed = mechanical_semi_diameters(lens, sizes), fixed_semi_diameters(lens)
    for k, surface in enumerate(lens.surfaces):
        numbers = {} if k == last else {"thickness": surface.thickness}
        if k > 0:
            paths = parameter_paths(surface).items()
            numbers |= {name: number_at(surface, path) for name, path in paths}
        if surface.is_break:
            numbers = {name: value for name, value in numbers.items() if name not in ("curvature", "conic")}
        values = {name: 0.0 if number is None else float(number) for name, number in numbers.items()}
        here = [{word.split(":")[0] for word in words if word.endswith(f":{k}")} for words in (state.vary, follows)]
        rows.append(
            {
                "surface": k,
                "cells": {name: plain(value) for name, value in values.items()},
                "sliders": {
                    name: slider_ends(lens, k, name, value) for name, value in values.items() if math.isfinite(value)
                },
                "glass": None if k == last or surface.is_break else label(surface.glass),
                "semi_diameter": plain(sizes[k]),
                "chip_zone": surface.chip_zone or 0.0,
                "mechanical_semi_diameter": plain(widths[k]),
                "fixed": [
                    *(["semi_diameter"] if k in fixed else []),
                    *(["mechanical_semi_diameter"] if surface.mechanical_semi_diameter else []),
                ],
                "comment": surface.comment,
                "stop": k == lens.stop,
                "vary": sorted(here[0]),
                "follows": sorted(here[1]),
            }
        )
    return {
        "name": lens.name,
        "rows": rows,
        "fields": {"unit": lens.fields.unit, "x": lens.fields.x.tolist(), "y": lens.fields.y.tolist()},
        "wavelengths": lens.wavelengths.tolist(),
        "primary": lens.primary_wavelength,
        "aperture": {
            "kind": lens.aperture.kind,
            "value": float(lens.aperture.value),
            "slider": [0.4 * float(lens.aperture.value), 1.6 * float(lens.aperture.value)],
            "kinds": [*dict.fromkeys((lens.aperture.kind, "image_f_number", "entrance_pupil_diameter"))],
        },
        "configuration": lens.current_configuration,
        "configurations": count(lens.operands),
        "undo": len(state.past),
        "redo": len(state.future),
        "frequency": state.frequency,
        "merit": state.merit,
        "file_merit": has_merit(lens),
        "conditions": _conditions(lens),
        "compare": state.compare,
    }


def _conditions(lens: Lens) -> list[dict]:
    """The conditions of a lens, and behind them the boundaries of its merit function, with the values that it has."""
    try:
        results, conditions = attained_by(lens), lens.conditions
    except ValueError as error:  # of a surface that is gone
        return [{"words": str(error), "row": 1, "on": True, "reached": None, "met": False}]
    rows = lens.optimization_data.merit if lens.optimization_data else ()
    values = iter([named(lens, rows, result) for result in results])
    listed = []
    for condition in conditions:
        value = next(values) if condition.on else None
        listed.append({"words": str(condition).removeprefix(OFF), "row": 0, "on": condition.on} | _reached(value))
    return [*listed, *({"words": value.words, "row": value.row, "on": True} | _reached(value) for value in values)]


def _reached(value: Attained | None) -> dict:
    return {"reached": plain(value.reached) if value else None, "met": value is None or value.met}
