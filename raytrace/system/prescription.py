"""A lens built from plain numbers, as printed in a book or a patent.

lens([dict(radius=37.4, thickness=5.9, glass="SK4"), …], stop=5, f_number=3.5, fields=[0, 8.4, 11.9])
"""

import math
from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor

from raytrace.materials.catalogs import ENVIRONMENT, SHIPPED, medium, missing_catalogs
from raytrace.materials.glass import AIR, check_unit
from raytrace.system.lens import APERTURE_KINDS, FIELD_UNITS, Fields, Lens, SystemAperture, changed, check, field_points
from raytrace.system.surface import Surface
from raytrace.words import RaytraceError, did_you_mean, named_value


class BadPrescription(RaytraceError, ValueError):
    """Numbers that make no lens; the message has the surface, the value found and the value expected."""


def lens(
    rows: Iterable[Mapping],
    *,
    stop: int,
    fields: Sequence = (0.0,),
    field_kind: str = "",
    wavelengths: Sequence[float] = (0.5875618,),
    wavelength_weights: Sequence[float] | None = None,
    primary_wavelength: int = 1,
    object_distance: float = math.inf,
    name: str = "",
    catalogs: Sequence[str] = (),
    ray_aiming: str = "auto",
    **aperture: float,
) -> Lens:
    """A lens from rows of plain numbers, surface 1 to the last before the sensor; object and image are added.

    rows: mappings, or a DataFrame: radius (mm, inf is a plane) or curvature (1/mm), thickness (mm to the next vertex,
    of the last row to the sensor), glass (a name, an index, (nd, Vd) or a Glass behind the surface; air by default,
    "MIRROR" reflects; of the last row the medium of the image), conic, coefficients (of r², r⁴, … in mm^(1-2j)),
    semi_diameter, chip_zone, mechanical_semi_diameter, apertures, comment; decentres x, y, z (mm) and tilts tilt_x,
    tilt_y, tilt_z (degrees) of its axes, and x_after, … of the axes behind it, each pose also as a Pose, before or
    after; numbers may be tensors that require a gradient.
    stop: number of the stop surface, counted from 1. One aperture by name, as f_number=3.5 or
    entrance_pupil_diameter=10; f_number is the image-space F/#, the others are keys of APERTURE_KINDS.
    fields: y, or (x, y), in degrees where the object is at infinity, else object heights in mm; field_kind: a key of
    FIELD_UNITS for another kind. wavelengths: µm; primary_wavelength: its number, from 1, the first by default.
    object_distance: mm from surface 1. catalogs: names of glass catalogs, sought first; one that is not
    shipped is found by the environment variable RAYTRACE_CATALOGS. name: the title; ray_aiming: a key of RAY_AIMING.
    Raises BadPrescription, UnknownGlass.
    """
    rows = rows.to_dict("records") if hasattr(rows, "to_dict") else list(rows)
    if not rows:
        raise BadPrescription(
            "no rows: give one mapping for each surface, as dict(radius=50, thickness=5, glass='N-BK7')"
        )
    if missing := missing_catalogs(catalogs):
        message = f"catalogs: {missing[0]!r} is no shipped catalog, and no file of {ENVIRONMENT} has this name"
        raise BadPrescription(f"{message}; expected some of {', '.join(SHIPPED)}, or the path of its AGF file there")
    surfaces = [surface(row, number, catalogs) for number, row in enumerate(rows, 1)]
    samples = _vector(wavelengths, "wavelengths")
    weights = torch.ones_like(samples) if wavelength_weights is None else _vector(wavelength_weights, "weights")
    kind = field_kind or ("angle" if math.isinf(float(object_distance)) else "object_height")
    if kind not in FIELD_UNITS:
        raise BadPrescription(f"field_kind {kind!r}: expected one of {', '.join(FIELD_UNITS)}")
    points = field_points(fields, like=samples)
    built = Lens(
        surfaces=(Surface(_tensor(object_distance)), *surfaces, Surface(_tensor(0.0))),
        stop=stop,
        aperture=_aperture(aperture),
        fields=Fields(kind, points[0], points[1], torch.ones_like(points[0])),
        wavelengths=samples,
        wavelength_weights=weights,
        primary_wavelength=primary_wavelength,
        name=name,
        catalogs=tuple(catalogs),
        ray_aiming=ray_aiming,
    )
    try:
        check_unit(samples, (surface.glass for surface in built.surfaces))
        check(built)
    except ValueError as error:
        raise BadPrescription(str(error)) from error
    return built


def surface(row: Mapping, number: int = 0, catalogs: Sequence[str] = ()) -> Surface:
    """A surface of a row of plain numbers; number: its number, for errors. Raises BadPrescription, UnknownGlass."""
    where = f"surface {number}"
    if not isinstance(row, Mapping):
        raise BadPrescription(
            f"{where}: {named_value(row)}; expected a mapping, as dict(radius=50, thickness=5, glass='N-BK7')"
        )
    cells = {key: value for key, value in row.items() if not _is_empty(value)}
    if "thickness" not in cells:
        raise BadPrescription(f"{where}: no thickness; give mm to the next vertex, 0 where they touch")
    plane = {"radius": math.inf, "curvature": 0.0}
    if any(not isinstance(cells.get(key), Tensor) and cells.get(key) == flat for key, flat in plane.items()):
        cells = {key: value for key, value in cells.items() if key not in plane}
    cells["glass"] = medium(cells.get("glass", AIR), catalogs, where)
    try:
        return changed(Surface(_tensor(0.0)), cells, where, like=_tensor(0.0))
    except (TypeError, ValueError) as error:
        raise BadPrescription(str(error) if str(error).startswith(where) else f"{where}: {error}") from error


#: Arguments of `lens` besides its aperture, and other words for them.
_ARGUMENTS = (
    *("rows", "stop", "fields", "field_kind", "wavelengths", "wavelength_weights", "primary_wavelength"),
    *("object_distance", "name", "catalogs", "ray_aiming"),
)
_SYNONYMS = {"title": "name", "epd": "entrance_pupil_diameter", "primary": "primary_wavelength"}


def _aperture(apertures: Mapping[str, float]) -> SystemAperture:
    names = {"f_number": "image_f_number"} | {kind: kind for kind in APERTURE_KINDS}
    for other in apertures:
        if other not in names:
            meant = did_you_mean(_SYNONYMS.get(other, other), [*_ARGUMENTS, *names])
            raise BadPrescription(f"{other!r} is no argument{meant}; expected {', '.join(_ARGUMENTS)} and an aperture")
    if len(apertures) != 1 or next(iter(apertures)) not in names:
        listed = ", ".join(apertures) or "none"
        raise BadPrescription(f"aperture: {listed} given; expected one of {', '.join(names)}, as f_number=3.5")
    ((name, number),) = apertures.items()
    return SystemAperture(names[name], _tensor(number))


def _is_empty(value: object) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _tensor(number: Tensor | float) -> Tensor:
    return number if isinstance(number, Tensor) else torch.as_tensor(number, dtype=torch.float64)


def _vector(numbers: Sequence[float], quantity: str) -> Tensor:
    try:
        return torch.as_tensor(numbers, dtype=torch.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise BadPrescription(f"{quantity} {numbers!r}: expected numbers") from error
