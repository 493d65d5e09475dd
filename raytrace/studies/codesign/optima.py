"""Optima of the closed form: where each PSF model would put the lens, without a network, and what DRT says of it."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.studies.codesign import conjugates
from raytrace.studies.codesign.closed_form import camera_error, even_distances, least_of_closed_form
from raytrace.studies.codesign.experiment import begin, camera
from raytrace.studies.codesign.settings import AFTER_PARAXIAL, GAUSSIAN, Settings
from raytrace.system.lens import Lens


@dataclasses.dataclass(frozen=True)
class Place:
    """Where one model put the lens.

    error: mean square error of a pixel with the model's own PSFs; error_drt: of the same lens with DRT PSFs and the
    filter that is best for them; penalty: mm² of what thicknesses lack (`limits.violation`), no part of the errors.
    Focus distances in m as for `Outcome`; no_optimum: why this lens is none of least error, "" where it is one.
    downhill_mm: the sensor of the optimum downhill from where the search began, another than `sensor_mm` where that one
    is only a local one (`least_of_closed_form`).
    """

    model: str
    sensor_mm: float
    focus_paraxial_m: float
    focus_rms_m: float
    error: float
    error_drt: float
    penalty: float = 0.0
    no_optimum: str = ""
    downhill_mm: float = math.nan


#: Columns of `spectral.csv`.
COLUMNS = tuple(field.name for field in dataclasses.fields(Place))


@dataclasses.dataclass(frozen=True)
class Optimum(Place):
    """The lens of least closed-form error of one model, or of one row of a study.

    course, penalties: error and penalty at every evaluation. at_end: variables at an end of their bounds behind which
    the error still falls; lens: as it was found.
    """

    variables: dict[str, float] = dataclasses.field(default_factory=dict)
    course: tuple[float, ...] = ()
    penalties: tuple[float, ...] = ()
    at_end: tuple[str, ...] = ()
    lens: Lens | None = None

    def document(self) -> dict:
        """All but the lens."""
        return {name: value for name, value in vars(self).items() if name != "lens"}


def closed_form(lens: Lens, settings: Settings, spectrum: Tensor) -> Optimum:
    """The optimum of the model of the settings. spectrum: `power_spectrum` of the pictures."""
    own = camera(lens, settings)
    if settings.start == GAUSSIAN:
        begin(own, settings, spectrum)
    distances = even_distances(own, spread=settings.spread)
    course, downhill = least_of_closed_form(own, spectrum, distances=distances)
    with torch.no_grad():
        found = own.variables()
        error = camera_error(own, spectrum, distances)
        own.use("drt")
        error_drt = camera_error(own, spectrum, distances)
    return Optimum(
        model=settings.model,
        **conjugates.place_of(found),
        downhill_mm=downhill,
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

    def optimum(model: str, start: str = settings.start) -> Optimum:
        return closed_form(lens, dataclasses.replace(settings, model=model, start=start), spectrum)

    found = {row: optimum(row) for row in rows if row != AFTER_PARAXIAL}
    if AFTER_PARAXIAL in rows:
        before = found.get("paraxial") or optimum("paraxial")
        found[AFTER_PARAXIAL] = dataclasses.replace(optimum("gaussian", repr(before.sensor_mm)), model=AFTER_PARAXIAL)
    return [found[row] for row in rows]
