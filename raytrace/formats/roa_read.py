"""Read an optical model of ray-optics (.roa), a JSON file of the program's objects: each has a class and attributes.

Conventions, as ray-optics 0.9 has them (rayoptics.elem, .seq, .raytr; opticalglass), compared with rays that it traced:

- `seq_model.ifcs` are the surfaces, `gaps[k]` is thickness and medium behind surface k, in system units. An object
  at 1e10 or further away is at infinity. Thicknesses and curvatures keep their signs behind mirrors, as in a .zmx file.
- A profile is the one of `profile_dict` whose key is the surface's `profile_id`, or stands in the surface itself.
- Wavelengths are in nm. A pupil of the image space is told by the paraxial slope of the marginal ray: 1/(2 F/#).
- Fields are in degrees or system units; relative ones are parts of `value`. Tilts alpha and beta are left-handed.
- Vignetting scales the upper and the lower half of the pupil, about its centre, each by its factor: read as CODE V's.
- Aspheric terms begin with r², those of a radial polynomial with r; its `ec` is the conic constant + 1.
- A diffractive element adds order λ/λ_ref Σ c_j r^2j to the path. A model glass has Buchdahl's two coefficients.
- At a diffractive surface that light meets in air ray-optics 0.9.8 leaves out the refraction; here it is traced.

Elements, parts and the paraxial design are for drawing and left out. Thin lenses, which are holograms there, gratings,
x toroids and stops that float are refused by name.
"""

import math
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import torch

from raytrace.formats.report import IGNORED, READ, Draft, ImportReport
from raytrace.formats.roa_parts import Part, model_of
from raytrace.formats.roa_surface import surfaces_of
from raytrace.formats.source import Place, shown
from raytrace.formats.spelling import double, refuse_overflow
from raytrace.formats.substitutes import NONE, Substitutes
from raytrace.media.glass import refractive_index
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.surface import Surface

_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1e3, "in": 25.4, "inch": 25.4, "inches": 25.4, "ft": 304.8, "feet": 304.8}

#: Parts of a model that are left out, and why.
_LEFT_OUT = {
    "specsheet": "inputs of the program's first-order layout",
    "parax_model": "paraxial design; derived from the surfaces",
    "ele_model": "elements, for drawing",
    "part_tree": "elements, for drawing",
    "parts_dict": "elements, for drawing",
    "radius_mode": "setting of the program",
    "ro_version": "version of the program",
}

_FIELDS = {
    ("object", "angle"): "angle",
    ("object", "height"): "object_height",
    ("image", "height"): "paraxial_image_height",
    ("image", "real height"): "real_image_height",
}


def read(
    content: bytes,
    file: str,
    *,
    catalogs: Sequence[Path] = (),
    strict: bool = False,
    substitutes: Substitutes = NONE,
) -> tuple[Lens, ImportReport]:
    """The lens of a .roa file's bytes and the report of its import.

    file: its name, for messages. catalogs: further glass catalogs (.agf). strict: every warning is an error.
    substitutes: of glasses. Raises LensFileError, UnsupportedSurface and UnknownGlass.
    """
    report, place = Draft(file, "roa", substitutes), Place(file)
    model = model_of(content, place)
    for name in model.attributes:
        status = IGNORED if name in _LEFT_OUT else READ
        report.met(name[:40], status, place, _LEFT_OUT.get(name, ""))
    sequence, optics, system = (model.part(name) for name in ("seq_model", "optical_spec", "system_spec"))
    unit = _unit(system)
    wavelengths, weights, primary = _wavelengths(optics.part("spectral_region"), report)
    surfaces = surfaces_of(model, sequence, unit, wavelengths, catalogs, report)
    _warn_of_environment(system, report)
    lens = Lens(
        surfaces=_focused(surfaces, optics, unit, report),
        stop=_stop(sequence, len(surfaces)),
        aperture=_aperture(optics.part("pupil"), surfaces, wavelengths[primary], unit),
        fields=_fields(optics.part("field_of_view"), unit, report),
        wavelengths=double(wavelengths),
        wavelength_weights=double(weights),
        primary_wavelength=primary + 1,
        name=system.text("title").strip(),
        catalogs=tuple(dict.fromkeys(one.glass.catalog for one in surfaces if one.glass.catalog)),
    )
    refuse_overflow(lens, file)
    return lens, report.finished(strict=strict)


def _unit(system: Part) -> float:
    name = system.text("_dimensions", system.text("dimensions", "mm")).lower()
    if name not in _UNITS:
        raise system.error(f"dimensions are {shown(name)}, expected one of {', '.join(_UNITS)}")
    return _UNITS[name]


def _wavelengths(region: Part, report: Draft) -> tuple[list[float], list[float], int]:
    """Wavelengths in µm, each rounded once, their weights, and the 0-based position of the reference."""
    waves = [float(Decimal(repr(wave)).scaleb(-3)) for wave in region.numbers("wavelengths")]
    weights, primary = region.numbers("spectral_wts"), int(region.number("reference_wvl", 0))
    if not waves or min(waves) <= 0:
        raise region.error("wavelengths in nm are expected, each above 0")
    if len(weights) < len(waves):
        report.warn(f"{len(weights)} weights for {len(waves)} wavelengths; the others are taken as 1", region.place)
    weights = (weights + [1.0] * len(waves))[: len(waves)]
    if min(weights) < 0 or not 0 <= primary < len(waves):
        raise region.error("expected weights of 0 or more, and reference_wvl below the number of wavelengths")
    return waves, weights, primary


def _warn_of_environment(system: Part, report: Draft) -> None:
    for name, normal, unit in (("temperature", 20.0, "°C"), ("pressure", 760.0, "mm Hg")):
        if system.number(name, normal) != normal:
            message = f"{name} {system.number(name):g} {unit}: indices are those of the catalogs"
            report.warn(message, system.place)


# -- the system -------------------------------------------------------------------------------------------------------


def _stop(sequence: Part, count: int) -> int:
    stop = sequence.attributes.get("stop_surface")
    if stop is None:
        raise sequence.unsupported("no stop_surface: a stop that floats is not modelled; give a surface the stop")
    if isinstance(stop, bool) or not isinstance(stop, int) or not 0 < stop < count - 1:
        raise sequence.error(f"stop_surface is {shown(repr(stop))}, expected a surface between object and image")
    return stop


def _focused(surfaces: list[Surface], optics: Part, unit: float, report: Draft) -> tuple[Surface, ...]:
    """The surfaces, the image shifted as the program's analyses shift it."""
    shift = optics.part("defocus").number("focus_shift", 0.0) * unit if optics.has("defocus") else 0.0
    if not shift:
        return tuple(surfaces)
    *others, last, image = surfaces
    report.warn(f"the focus shift of {shift:g} mm is added to the distance of the image", optics.place)
    values = {name: getattr(last, name) for name in last.__dataclass_fields__} | {"thickness": last.thickness + shift}
    return (*others, Surface(**values), image)


def _key(found: Part) -> tuple[str, str]:
    key = found.attributes.get("_key", found.attributes.get("key"))
    if not isinstance(key, list) or len(key) < 2 or not all(isinstance(word, str) for word in key):
        raise found.error(f"key is {shown(repr(key))}, expected what it is a number of, as [object, epd]")
    return key[-2], key[-1]


def _aperture(pupil: Part, surfaces: list[Surface], wavelength: float, unit: float) -> SystemAperture:
    space, kind = _key(pupil)
    size = abs(pupil.number("value"))
    if not size > 0:
        raise pupil.error("value is expected above 0")
    at_infinity = bool(torch.isinf(surfaces[0].thickness))
    if space == "object" and kind in ("epd", "pupil"):
        return SystemAperture("entrance_pupil_diameter", double(size * unit))
    if space == "object" and not at_infinity and kind in ("NA", "f/#"):
        slope = math.sin(math.atan(0.5 / size)) if kind == "f/#" else size
        return SystemAperture("object_na", double(slope))
    if space == "image" and kind == "NA":
        index = float(refractive_index(surfaces[-2].glass, double(wavelength))) if not surfaces[-2].is_mirror else 1.0
        if not size < index:
            raise pupil.error(f"an NA of {size:g} of an image space of index {index:g}")
        kind, size = "f/#", 0.5 / (index * math.tan(math.asin(size / index)))
    if space == "image" and kind == "f/#":
        return SystemAperture("image_f_number" if at_infinity else "working_f_number", double(size))
    raise pupil.error(f"a pupil by {space} {kind} is not modelled; expected object epd or NA, image f/# or NA")


def _fields(found: Part, unit: float, report: Draft) -> Fields:
    kind = _FIELDS.get(_key(found))
    if kind is None:
        raise found.error(
            f"fields by {' '.join(_key(found))} are not modelled; expected object angle, height, image height"
        )
    points = found.parts("fields")
    if not points:
        raise found.error("no fields")
    length = (1.0 if kind == "angle" else unit) * (
        found.number("value", 1.0) if found.attributes.get("is_relative") else 1.0
    )
    rows = [_vignetting(point) for point in points]
    if any(any(row) for row in rows):
        report.note("vignetting: the pupil is decentred and compressed as a whole, as CODE V's factors say")
    factors = double(list(zip(*rows, strict=True)))
    return Fields(
        kind=kind,
        x=double([length * point.number("x") for point in points]),
        y=double([length * point.number("y") for point in points]),
        weight=double([point.number("wt", 1.0) for point in points]),
        vignetting=factors if bool(factors.any()) else None,
    )


def _vignetting(point: Part) -> tuple[float, ...]:
    """Decentre and compression in x and y, and the angle 0, from what is cut off on either side."""
    cut = [point.number(f"v{side}{axis}", 0.0) for axis in "xy" for side in "lu"]
    low_x, high_x, low_y, high_y = cut
    return 0.5 * (low_x - high_x), 0.5 * (low_y - high_y), 0.5 * (low_x + high_x), 0.5 * (low_y + high_y), 0.0
