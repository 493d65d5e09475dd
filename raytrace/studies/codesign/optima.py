"""Optima of the closed form: where each PSF model would put the lens, without a network, and what DRT says of it."""

import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.camera.camera import Camera
from raytrace.files import write_atomically
from raytrace.optics.conjugates import distance_in_focus, paraxial_image
from raytrace.optics.focus import best_focus
from raytrace.studies.codesign.closed_form import camera_error, even_distances, optimise_closed_form
from raytrace.studies.codesign.experiment import Settings, camera
from raytrace.studies.codesign.study import AFTER_PARAXIAL
from raytrace.system.lens import Lens


@dataclasses.dataclass(frozen=True)
class Optimum:
    """The lens of least closed-form error of one model, or of one row of a study.

    error: mean square error of a pixel with the model's own PSFs; error_drt: of the same lens with DRT PSFs and the
    filter that is best for them; penalty: mm² of what thicknesses lack (`limits.violation`), no part of the errors;
    course, penalties: error and penalty at every evaluation. Focus distances in m as for `Outcome`.
    at_end: variables at an end of their bounds behind which the error still falls; no_optimum: why this lens is none of
    least error, "" where it is one. lens: as it was found.
    """

    model: str
    sensor_mm: float
    focus_paraxial_m: float
    focus_rms_m: float
    error: float
    error_drt: float
    variables: dict[str, float]
    course: tuple[float, ...]
    penalty: float = 0.0
    penalties: tuple[float, ...] = ()
    at_end: tuple[str, ...] = ()
    no_optimum: str = ""
    lens: Lens | None = None


def document(found: Optimum) -> dict:
    """An optimum for JSON: all but its lens."""
    return {field.name: getattr(found, field.name) for field in dataclasses.fields(found) if field.name != "lens"}


#: Columns of `spectral.csv`.
COLUMNS = ("model", "sensor_mm", "focus_paraxial_m", "focus_rms_m", "error", "error_drt", "penalty", "no_optimum")


def closed_form(lens: Lens, settings: Settings, spectrum: Tensor) -> Optimum:
    """The optimum of the model of the settings. spectrum: `power_spectrum` of the pictures."""
    own = camera(lens, settings)
    course = optimise_closed_form(own, spectrum)
    with torch.no_grad():
        found = own.variables()
        error = camera_error(own, spectrum, even_distances(own))
        own.use("drt")
        error_drt = camera_error(own, spectrum, even_distances(own))
    return Optimum(
        model=settings.model,
        sensor_mm=float(found.surfaces[-2].thickness),
        focus_paraxial_m=1e-3 * distance_in_focus(found, paraxial_image),
        focus_rms_m=1e-3 * distance_in_focus(found, best_focus),
        error=float(error),
        error_drt=float(error_drt),
        variables=own.variables.numbers(),
        course=course.errors,
        penalty=float(own.variables.violation().detach()),
        penalties=course.penalties,
        at_end=course.at_end,
        no_optimum=course.no_optimum,
        lens=found,
    )


def closed_forms(lens: Lens, settings: Settings, spectrum: Tensor, rows: Sequence[str]) -> list[Optimum]:
    """The optimum of every row of a study. `AFTER_PARAXIAL`: of Gaussian DRT, begun where paraxial optics end."""
    found: dict[str, Optimum] = {}
    for row in sorted(rows, key=lambda row: row == AFTER_PARAXIAL):  # the last of them
        own = dataclasses.replace(settings, model=row)
        if row == AFTER_PARAXIAL:
            before = found.get("paraxial") or closed_form(
                lens, dataclasses.replace(settings, model="paraxial"), spectrum
            )
            own = dataclasses.replace(settings, model="gaussian", start=repr(before.sensor_mm))
        found[row] = dataclasses.replace(closed_form(lens, own, spectrum), model=row)
    return [found[row] for row in rows]


@torch.no_grad()
def scan(own: Camera, spectrum: Tensor, sensors: Sequence[float]) -> list[float]:
    """Closed-form error of a camera with its sensor at each of the distances in mm; "sensor" is one of its variables.

    The camera is left as it was.
    """
    place = own.variables.get_parameter("sensor")
    (variable,) = [one for one in own.variables.variables if one.kind == "sensor"]
    before, found = place.clone(), []
    for sensor in sensors:
        place.fill_((sensor - variable.start) / variable.unit)
        found.append(float(camera_error(own, spectrum, even_distances(own))))
    place.copy_(before)
    return found


def write_optima(found: Sequence[Optimum], path: Path) -> None:
    """The table of the optima, a row for each model."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({column: getattr(one, column) for column in COLUMNS} for one in found)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))
