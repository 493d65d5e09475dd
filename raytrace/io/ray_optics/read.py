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

A surface of a file of ray-optics as a `Surface`, and the medium behind it: a row for every class.
"""

import math
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import torch

from raytrace.io.materials import listed_glass
from raytrace.io.ray_optics.parts import Part, model_of, part_of
from raytrace.io.report import IGNORED, READ, Draft, ImportReport
from raytrace.io.source import MAX_SURFACES, Place, shown
from raytrace.io.spelling import double, refuse_overflow
from raytrace.io.substitutes import NONE, Substitutes
from raytrace.materials.glass import AIR, MIRROR, Glass, constant, from_table, refractive_index
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.phases import RadialPhase
from raytrace.system.poses import Pose, undone
from raytrace.system.surface import Surface

#: An object at this distance or further away, in the unit of the file, is at infinity.
_INFINITY = 1e10


def surfaces_of(
    model: Part, sequence: Part, unit: float, wavelengths: list[float], catalogs: Sequence[Path], report: Draft
) -> list[Surface]:
    """The surfaces of a sequence, in mm; wavelengths: of the lens, µm. Raises UnsupportedSurface, UnknownGlass."""
    interfaces = sequence.parts("ifcs", MAX_SURFACES, surfaces=True)
    gaps = sequence.parts("gaps", MAX_SURFACES, surfaces=True)
    if len(interfaces) < 3 or len(gaps) != len(interfaces) - 1:
        message = (
            f"{len(interfaces)} surfaces and {len(gaps)} gaps; expected at least three, and a gap behind each but one"
        )
        raise sequence.error(message)
    profiles = model.attributes.get("profile_dict")
    found = []
    for interface, gap in zip(interfaces, [*gaps, None], strict=True):
        glass = AIR if gap is None else _medium(gap.part("medium"), wavelengths, catalogs, report)
        thickness = 0.0 if gap is None else gap.number("thi") * unit
        found.append(_surface(interface, profiles, thickness, glass, unit, report))
    far = found[0].thickness
    if bool(far.abs() >= _INFINITY):
        found[0] = Surface(double(math.inf), glass=found[0].glass, comment=found[0].comment)
    return found


def _surface(one: Part, profiles: object, thickness: float, glass: Glass, unit: float, report: Draft) -> Surface:
    report.met(one.kind[:40], READ, one.place)
    if one.kind != "Surface":
        what = "a thin lens, a hologram there," if one.kind == "ThinLens" else f"an interface of class {one.kind[:40]}"
        raise one.unsupported(f"{what} is not modelled; modelled is Surface")
    mode, ends = one.text("interact_mode", "transmit"), one.place.surface == 0
    if mode not in ("transmit", "reflect", "dummy"):
        raise one.unsupported(f"interact_mode {shown(mode)} is not modelled; modelled are transmit, reflect, dummy")
    if mode == "reflect" and ends:
        raise one.error("the object is a mirror")
    before, behind = _poses(one.part("decenter"), unit) if one.has("decenter") else (None, None)
    size = abs(one.number("max_aperture", 0.0)) * unit
    return Surface(
        thickness=double(thickness),
        **_profile(one, profiles, unit, report),
        phase=_phase(one.part("phase_element"), unit, report) if one.has("phase_element") else None,
        before=before,
        after=behind,
        glass=MIRROR if mode == "reflect" else glass,
        semi_diameter=size if 0 < size < 1e8 else None,
        apertures=tuple(_clear(part, unit) for part in one.parts("clear_apertures"))
        if one.has("clear_apertures")
        else (),
        comment=one.text("label").strip(),
    )


def _profile(one: Part, profiles: object, unit: float, report: Draft) -> dict:
    """Curvature, conic and terms of a surface."""
    if one.has("profile"):
        found = one.part("profile")
    else:
        key = one.attributes.get("profile_id")
        stored = profiles.get(str(key)) if isinstance(profiles, dict) else None
        if stored is None:
            raise one.error(f"no profile {shown(str(key))} in profile_dict; cut off?")
        found = part_of(stored, f"profile_dict.{str(key)[:40]}", one.place)
    report.met(found.kind[:40], READ, one.place)
    if found.kind not in _PROFILES:
        known = ", ".join(_PROFILES)
        raise found.unsupported(f"a profile of class {found.kind[:40]} is not modelled; modelled are {known}")
    curvature = found.number("cv", 0.0) / unit
    shape = {"curvature": double(curvature) if curvature else None}
    return shape | _PROFILES[found.kind](found, unit)


def _conic(found: Part) -> dict:
    conic = found.number("cc", 0.0)
    return {"conic": double(conic) if conic else None}


def _terms(found: Part, step: int, unit: float) -> list[float]:
    """The coefficients of r^step, r^2step, … in mm, without zeros at the end; files before 0.9.5 name each."""
    listed = found.numbers("coefs")
    if not any(listed):
        listed = [found.number(f"coef{step * j}", 0.0) for j in range(1, 11)]
    while listed and not listed[-1]:
        listed.pop()
    return [c / unit ** (step * j - 1) for j, c in enumerate(listed, 1)]


def _even(found: Part, unit: float) -> dict:
    terms = _terms(found, 2, unit)
    return _conic(found) | ({"coefficients": double(terms)} if terms else {})


def _radial(found: Part, unit: float) -> dict:
    """Terms of r, r², …: an even asphere where only even ones are there."""
    conic, terms = found.number("ec", 1.0) - 1.0, _terms(found, 1, unit)
    shape = {"conic": double(conic) if conic else None}
    if not terms:
        return shape
    if not any(terms[::2]):
        return shape | {"coefficients": double(terms[1::2])}
    return shape | {"kind": "odd asphere", "coefficients": double(terms)}


def _toroid(found: Part, unit: float) -> dict:
    """A section in y, with even terms, turned about an axis along y."""
    terms = _terms(found, 2, unit)
    if len(terms) > 7:
        raise found.unsupported("terms of a toroid beyond y^14 are not modelled")
    return _conic(found) | {"kind": "toroidal", "coefficients": double([found.number("cR", 0.0) / unit, *terms])}


_PROFILES = {
    "Spherical": lambda found, unit: {},
    "Conic": lambda found, unit: _conic(found),
    "EvenPolynomial": _even,
    "RadialPolynomial": _radial,
    "YToroid": _toroid,
}


def _phase(found: Part, unit: float, report: Draft) -> RadialPhase:
    """p = order λ/λ_ref Σ c_j r^2j, as a phase in radians at the radius of a unit of length."""
    report.met(found.kind[:40], READ, found.place)
    function = found.text("phase_fct_name", found.kind)
    if found.kind != "DiffractiveElement" or function != "radial_phase_fct":
        message = f"a phase of class {found.kind[:40]} ({function[:40]}) is not modelled; modelled is radial_phase_fct"
        raise found.unsupported(message)
    wave = found.number("ref_wl") * 1e-6  # mm
    if not wave > 0:
        raise found.error("ref_wl is expected above 0")
    report.warn(
        "light refracts at the diffractive surface, which ray-optics 0.9.8 leaves out of light from air", found.place
    )
    terms = [2 * math.pi * c * unit / wave for c in found.numbers("coefficients")] or [0.0]
    return RadialPhase(double(terms), double(unit), double(found.number("order", 1.0)))


def _poses(found: Part, unit: float) -> tuple[Pose | None, Pose | None]:
    """The pose of a surface and that behind it, by a decentre, tilts, and what they are for."""
    kind = found.text("_dtype", found.text("dtype", "decenter"))
    dec, euler = ((found.numbers(name) + [0.0] * 3)[:3] for name in ("dec", "euler"))
    if any(found.numbers("rot_pt")):
        raise found.unsupported("a point of rotation other than the vertex is not modelled")
    numbers = dict(zip(("x", "y", "z"), (unit * one for one in dec), strict=True))
    numbers |= {"tilt_x": -euler[0], "tilt_y": -euler[1], "tilt_z": euler[2]}
    told = {name: double(number) for name, number in numbers.items() if number}
    if not told:
        return None, None
    pose, tilts = Pose(**told), {name: number for name, number in told.items() if name.startswith("tilt")}
    if kind == "decenter":
        return pose, None
    if kind == "dec and return" and (not tilts or len(tilts) == len(told)):
        return pose, undone(pose)
    if kind == "bend" and len(tilts) <= 1:
        return pose, Pose(**tilts) if tilts else None
    message = f"{shown(kind)} of {', '.join(told)} is not modelled; modelled are decenter, "
    raise found.unsupported(f"{message}dec and return of a decentre or of tilts, and bend about one axis")


_SHAPES = {
    "Circular": ("circular", ("radius",)),
    "Rectangular": ("rectangular", ("x_half_width", "y_half_width")),
    "Elliptical": ("elliptic", ("x_half_width", "y_half_width")),
}


def _clear(found: Part, unit: float) -> Aperture:
    if found.kind not in _SHAPES or found.number("rotation", 0.0):
        raise found.unsupported(f"an aperture of class {found.kind[:40]}, or a rotated one, is not modelled")
    shape, names = _SHAPES[found.kind]
    sizes = tuple(abs(found.number(name)) * unit for name in names)
    sizes = (0.0, *sizes) if shape == "circular" else sizes
    if wrong := SHAPES[shape].objection(sizes):
        raise found.error(wrong)
    centre = tuple(found.number(name, 0.0) * unit for name in ("x_offset", "y_offset"))
    return Aperture(shape, sizes, bool(found.attributes.get("is_obscuration")), centre)


# -- media ------------------------------------------------------------------------------------------------------------


def _medium(found: Part, wavelengths: list[float], catalogs: Sequence[Path], report: Draft) -> Glass:
    """Air, a constant index, a table, a model glass, or a glass of a catalog, by the class of a medium."""
    name, kind, surface = found.text("label").strip(), found.kind, found.place.surface
    if kind == "Air":
        return AIR
    if kind in ("ConstantIndex", "Medium"):
        index = found.number("n")
        report.glass(surface, name, f"constant index {index!r}")
        return AIR if index == 1 else constant(_positive(found, index), name)
    if kind in ("InterpolatedMedium", "InterpolatedGlass"):
        waves, indices = ([one * scale for one in found.numbers(key)] for key, scale in (("wvls", 1e-3), ("rndx", 1.0)))
        report.glass(surface, name, f"a formula for its {len(waves)} indices")
        try:
            return from_table(waves, indices, name=name)
        except ValueError as error:
            raise found.error(str(error)) from error
    if kind in ("ModelGlass", "Glass") and not found.has("gname"):
        return _model_glass(found, name, wavelengths, report)
    if not found.has("gname"):
        raise found.unsupported(f"a medium of class {kind[:40]} is not modelled")
    maker = found.module.rpartition(".")[2].upper()
    how = {"catalogs": (maker,), "user": catalogs, "place": found.place, "report": report}
    return listed_glass(found.text("gname"), **how)


def _positive(found: Part, index: float) -> float:
    if not index > 0:
        raise found.error(f"an index of {index:g}, expected a positive one")
    return index


def _model_glass(found: Part, name: str, wavelengths: list[float], report: Draft) -> Glass:
    """n = n_0 + ν_1 ω + ν_2 ω², ω = (λ - λ_0)/(1 + 2.5 (λ - λ_0)), as a formula that meets it at the lens's lines."""
    model = found.part("bdhl_model")
    start, index, terms = model.number("wv0"), _positive(found, model.number("rind0")), model.numbers("coefs")
    if len(terms) != 2:
        raise model.error(f"{len(terms)} coefficients, expected Buchdahl's two")
    lines = list(dict.fromkeys(wavelengths))[:5]
    low, high = min(0.42, *lines), max(0.68, *lines)
    grid = [one for k in range(13) if (one := low + (high - low) * k / 12) not in lines]
    waves = double([*lines, *grid])
    omega = (waves - start) / (1 + 2.5 * (waves - start))
    indices = index + terms[0] * omega + terms[1] * omega**2
    if not bool(((1 + 2.5 * (waves - start)) > 0.05).all() & (indices > 0).all()):
        raise found.error("Buchdahl's formula has no index at a wavelength of the lens")
    glass = from_table(waves, indices, exact=len(lines), name=name)
    off = float((refractive_index(glass, waves) - indices).abs().max())
    told = f"nd {found.number('n', index):g}, Vd {found.number('v', 0.0):g} by Buchdahl's formula"
    report.glass(found.place.surface, name, f"{told}, met to {off:.1e} from {low:g} to {high:g} µm")
    return glass


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
