"""Spaces: optima of the closed form where thicknesses vary within boxes, the focal length held or free.

A free focal length is a way out: a shorter lens of one entrance pupil has less blur over a range of distances, and
pictures are scaled so that scale is no loss. What correction is worth is seen with the focal length held.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence

from torch import Tensor

from raytrace.studies.codesign import optima
from raytrace.studies.codesign.kept import Kept, found_once
from raytrace.studies.codesign.optima import Optimum, closed_form
from raytrace.studies.codesign.settings import GAUSSIAN, MODELS, Settings
from raytrace.system.lens import Lens
from raytrace.tracing.paraxial import first_order

ALONE = "sensor only"


@dataclasses.dataclass(frozen=True)
class Case:
    """One optimum to find: in a box, by its number from 1 (0: the sensor only), with the focal length held or not."""

    box: int
    settings: Settings


@dataclasses.dataclass(frozen=True)
class Row(optima.Place):
    """One optimum.

    start: "paraxial", the file's lens with its sensor at the paraxial image, or "gaussian", Gaussian DRT's optimum.
    refocused_mm, error_refocused: where the sensor is best with DRT PSFs behind these thicknesses, and the error there.
    efl_mm: effective focal length. at_bound: names of variables at an end of their bounds behind which the error still
    falls. variables: by name.
    """

    box: int = 0
    hold: str = ""
    start: str = ""
    refocused_mm: float = 0.0
    error_refocused: float = 0.0
    efl_mm: float = 0.0
    at_bound: str = ""
    variables: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def group(self) -> tuple[int, str]:
        return self.box, self.hold

    def document(self) -> dict:
        """All of it, a number for each variable."""
        found = dataclasses.asdict(self)
        return {**found, **{f"{name}_mm": value for name, value in found.pop("variables").items() if name != "sensor"}}


#: What an optimum is kept with.
FOUND = (*optima.COLUMNS, "refocused_mm", "error_refocused", "efl_mm", "at_bound", "variables")


def columns(rows: Sequence[Row]) -> tuple[str, ...]:
    """Columns of the table of all rows."""
    first = ("box", "hold", "model", "start", "error", "error_drt", "error_refocused", "efl_mm", "sensor_mm")
    own = dict.fromkeys(name for row in rows for name in row.document() if name.endswith("_mm") and name not in first)
    rest = (name for name in (*optima.COLUMNS, "at_bound") if name not in (*first, *own))
    return (*first, *own, *rest)


def cases(settings: Settings, boxes: Sequence[str]) -> list[Case]:
    """All optima: of the sensor only, then in every box with the focal length held and free; of DRT from two starts."""
    alone = _sensor_alone(settings)
    found = [Case(0, dataclasses.replace(alone, model=model)) for model in MODELS]
    for number, box in enumerate(boxes, 1):
        bounds = f"{settings.bounds} {box}".strip()
        for hold in (settings.hold, ""):
            within = dataclasses.replace(settings, bounds=bounds, hold=hold)
            found += [Case(number, dataclasses.replace(within, model=model)) for model in MODELS]
            found += [Case(number, dataclasses.replace(within, model="drt", start=GAUSSIAN))]
    return found


def _sensor_alone(settings: Settings) -> Settings:
    """The settings with the sensor as the only variable, within its own bounds."""
    bounds = [word for word in settings.bounds.split() if word.startswith("sensor:")]
    return dataclasses.replace(settings, vary="sensor", bounds=" ".join(bounds), hold="")


def spaces(
    lens: Lens,
    settings: Settings,
    boxes: Sequence[str],
    spectrum: Tensor,
    *,
    progress: Callable[[Sequence[Case]], Iterable[Case]] = iter,
    kept: Kept | None = None,
) -> list[Row]:
    """The optimum of every case. boxes: bounds as `settings.bounds` has them; progress, kept: as for `found_once`."""
    pairs = found_once(cases(settings, boxes), lambda own: _found(lens, own, spectrum), progress=progress, kept=kept)
    return [Row(**found, box=one.box, hold=one.settings.hold, start=one.settings.start) for one, found in pairs]


def _found(lens: Lens, settings: Settings, spectrum: Tensor) -> dict:
    """An optimum, and what its thicknesses are worth in the light of DRT."""
    found = closed_form(lens, settings, spectrum)
    refocused = _refocused(found, settings, spectrum)
    more = (
        *(refocused.sensor_mm, refocused.error, float(first_order(found.lens).effective_focal_length)),
        *(" ".join(found.at_end), found.variables),
    )
    return dict(zip(FOUND, (*(getattr(found, name) for name in optima.COLUMNS), *more), strict=True))


def _refocused(found: Optimum, settings: Settings, spectrum: Tensor) -> Optimum:
    """The optimum of the sensor alone with DRT PSFs of all light, behind the thicknesses that were found."""
    if found.model == "drt" and settings.vary == "sensor" and settings.rays is None and settings.drt_rays is None:
        return found
    alone = dataclasses.replace(_sensor_alone(settings), model="drt", rays=None, drt_rays=None, start="paraxial")
    return closed_form(found.lens, alone, spectrum)


def best(rows: Iterable[Row]) -> list[Row]:
    """The rows, of those that differ in their start alone the one of least error."""
    least: dict[tuple, Row] = {}
    for row in rows:
        known = least.setdefault((*row.group, row.model), row)
        least[(*row.group, row.model)] = min(known, row, key=lambda one: one.error)
    return list(least.values())


def gains(rows: Sequence[Row]) -> Iterator[tuple[Row, float, float, float]]:
    """What every box is worth over the sensor alone: parts of the error with a model's own PSFs, with DRT PSFs, and
    with DRT PSFs where the sensor is refocused, there beside DRT's own optimum of the sensor alone."""
    alone = {row.model: row for row in rows if not row.box}
    for row in rows:
        if row.box:
            own = alone[row.model]
            yield (
                row,
                1 - row.error / own.error,
                1 - row.error_drt / own.error_drt,
                1 - row.error_refocused / alone["drt"].error_drt,
            )
