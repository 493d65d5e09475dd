"""Read an optical model of ray-optics (.roa), a JSON file of the program's objects: each has a class and attributes.

Conventions, as in ray-optics 0.9 (rayoptics.elem, .seq, .raytr; opticalglass), compared with rays that it traced:

- `seq_model.ifcs` are the surfaces, `gaps[k]` is thickness and medium behind surface k, in system units. An object
  at 1e10 or further away is at infinity. Thicknesses and curvatures keep their signs behind mirrors, as in a .zmx file.
- A profile is the one of `profile_dict` whose key is the surface's `profile_id`, or is in the surface itself.
- Wavelengths are in nm. A pupil of the image space is given by the paraxial slope of the marginal ray: 1/(2 F/#).
- Fields are in degrees or system units; relative ones are parts of `value`. Tilts alpha and beta are left-handed.
- Vignetting scales the upper and the lower half of the pupil, about its centre, each by its factor: read as CODE V's.
- Aspheric terms begin with r², those of a radial polynomial with r; its `ec` is the conic constant + 1.
- A diffractive element adds order λ/λ_ref Σ c_j r^2j to the path. A model glass has Buchdahl's two coefficients.
- At a diffractive surface in air ray-optics 0.9.8 leaves out the refraction; here it is traced.

Elements, parts and the paraxial design are for drawing and left out. Thin lenses, which are holograms there, gratings,
x toroids and stops that float are refused by name.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import torch

from raytrace.io.assembly import (
    BENT,
    MOST_POINTS,
    ONWARD,
    RETURNED,
    LensDraft,
    assemble,
    clear_aperture,
    listed_glass,
    poses_of,
)
from raytrace.io.source import (
    IGNORED,
    MAX_SURFACES,
    READ,
    Draft,
    LensFileError,
    Place,
    UnsupportedSurface,
    double,
    nonzero,
    shown,
)
from raytrace.materials.glass import AIR, MIRROR, Glass, constant, from_table, refractive_index
from raytrace.system.apertures import Aperture
from raytrace.system.lens import Lens
from raytrace.system.phases import RadialPhase
from raytrace.system.poses import Pose
from raytrace.system.surface import Surface

# -- objects of the file ----------------------------------------------------------------------------------------------


class Part(NamedTuple):
    """An object of the file: module and name of its class, its attributes, its path in the file, and its surface."""

    module: str
    kind: str
    attributes: dict
    path: str
    place: Place

    def error(self, message: str) -> LensFileError:
        return LensFileError(f"{self.path}: {message}", self.place)

    def unsupported(self, message: str) -> UnsupportedSurface:
        return UnsupportedSurface(f"{self.path}: {message}", self.place)

    def has(self, name: str) -> bool:
        return self.attributes.get(name) is not None

    def number(self, name: str, default: float | None = None) -> float:
        """A finite number; `default` where there is none."""
        return self._finite(name, self.attributes.get(name, default))

    def _finite(self, name: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(f"{name} is {shown(repr(value))}, expected a number")
        if not abs(value) < 1e300:
            raise self.error(f"{name} is {shown(repr(value))}, expected a finite number")
        return float(value)

    def text(self, name: str, default: str = "") -> str:
        text = self.attributes.get(name, default)
        if not isinstance(text, str):
            raise self.error(f"{name} is {shown(repr(text))}, expected a text")
        return text

    def numbers(self, name: str) -> list[float]:
        """The finite numbers of a list or an array, none where it is absent."""
        values = self.attributes.get(name) or []
        values = values.get("__ndarray__") if isinstance(values, dict) else values
        if not isinstance(values, list) or len(values) > MOST_POINTS:
            raise self.error(f"{name} is {shown(repr(values))}, expected a list of at most {MOST_POINTS} numbers")
        return [self._finite(name, value) for value in values]

    def part(self, name: str) -> "Part":
        if not self.has(name):
            raise self.error(f"no {name}; cut off, or another kind of model?")
        return part_of(self.attributes[name], f"{self.path}.{name}", self.place)

    def parts(self, name: str, most: int = MOST_POINTS, surfaces: bool = False) -> list["Part"]:
        """The objects of a list; surfaces: whether they are counted as those of the lens."""
        values = self.attributes.get(name)
        if not isinstance(values, list) or len(values) > most:
            raise self.error(f"{name} is no list of at most {most}")
        places = [self.place._replace(surface=k) if surfaces else self.place for k in range(len(values))]
        return [part_of(value, f"{self.path}.{name}[{k}]", places[k]) for k, value in enumerate(values)]


def part_of(value: object, path: str, place: Place) -> Part:
    """An object of the file, with its class in __instance_type__. Raises LensFileError for anything else."""
    type_ = value.get("__instance_type__") if isinstance(value, dict) else None
    attributes = value.get("attributes") if isinstance(value, dict) else None
    names = type_ if isinstance(type_, list) and all(isinstance(word, str) for word in type_) else []
    if len(names) != 2 or not isinstance(attributes, dict):
        raise LensFileError(f"{path} is {shown(repr(value))}, expected an object with __instance_type__", place)
    return Part(names[0], names[1], attributes, path, place)


def model_of(content: bytes, place: Place) -> Part:
    """The optical model of a file's bytes. Raises LensFileError."""
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        line = error.lineno if isinstance(error, json.JSONDecodeError) else None
        reason = str(error)[:80] if line else "nested too deeply, or no text"
        message = f"no JSON file of ray-optics: {reason}; damaged or cut off?"
        raise LensFileError(message, place._replace(line=line)) from None
    if not isinstance(document, dict) or "optical_model" not in document:
        raise LensFileError("no optical_model; is it a model of ray-optics (.roa)?", place)
    return part_of(document["optical_model"], "optical_model", place)


# -- surfaces ---------------------------------------------------------------------------------------------------------

#: An object at this distance or further away, in the unit of the file, is at infinity.
_INFINITY = 1e10


def surfaces_of(
    model: Part, sequence: Part, unit: float, wavelengths: list[float], catalogs: Sequence[Path], report: Draft
) -> list[Surface]:
    """The surfaces of a sequence, in mm; wavelengths: of the lens, µm. Raises UnsupportedSurface, UnknownGlass."""
    interfaces = sequence.parts("ifcs", MAX_SURFACES, surfaces=True)
    gaps = sequence.parts("gaps", MAX_SURFACES, surfaces=True)
    if len(interfaces) < 3 or len(gaps) != len(interfaces) - 1:
        counts = f"{len(interfaces)} surfaces and {len(gaps)} gaps"
        raise sequence.error(f"{counts}; expected at least three, and a gap behind each but one")
    profiles = model.attributes.get("profile_dict")
    surfaces = []
    for interface, gap in zip(interfaces, [*gaps, None], strict=True):
        glass = AIR if gap is None else _medium(gap.part("medium"), wavelengths, catalogs, report)
        thickness = 0.0 if gap is None else gap.number("thi") * unit
        surfaces.append(_surface(interface, profiles, thickness, glass, unit, report))
    if bool(surfaces[0].thickness.abs() >= _INFINITY):
        surfaces[0] = Surface(double(math.inf), glass=surfaces[0].glass, comment=surfaces[0].comment)
    return surfaces


def _surface(interface: Part, profiles: object, thickness: float, glass: Glass, unit: float, report: Draft) -> Surface:
    report.met(interface.kind[:40], READ, interface.place)
    if interface.kind != "Surface":
        kind = f"an interface of class {interface.kind[:40]}"
        kind = "a thin lens, a hologram there," if interface.kind == "ThinLens" else kind
        raise interface.unsupported(f"{kind} is not modelled; modelled is Surface")
    mode = interface.text("interact_mode", "transmit")
    if mode not in ("transmit", "reflect", "dummy"):
        modelled = "modelled are transmit, reflect, dummy"
        raise interface.unsupported(f"interact_mode {shown(mode)} is not modelled; {modelled}")
    if mode == "reflect" and interface.place.surface == 0:
        raise interface.error("the object is a mirror")
    before, behind = _poses(interface.part("decenter"), unit) if interface.has("decenter") else (None, None)
    size = abs(interface.number("max_aperture", 0.0)) * unit
    clear = interface.parts("clear_apertures") if interface.has("clear_apertures") else ()
    return Surface(
        thickness=double(thickness),
        **_profile(interface, profiles, unit, report),
        phase=_phase(interface.part("phase_element"), unit, report) if interface.has("phase_element") else None,
        before=before,
        after=behind,
        glass=MIRROR if mode == "reflect" else glass,
        semi_diameter=size if 0 < size < 1e8 else None,
        apertures=tuple(_clear(part, unit) for part in clear),
        comment=interface.text("label").strip(),
    )


def _profile(interface: Part, profiles: object, unit: float, report: Draft) -> dict:
    """Curvature, conic and terms of a surface."""
    if interface.has("profile"):
        profile = interface.part("profile")
    else:
        key = interface.attributes.get("profile_id")
        stored = profiles.get(str(key)) if isinstance(profiles, dict) else None
        if stored is None:
            raise interface.error(f"no profile {shown(str(key))} in profile_dict; cut off?")
        profile = part_of(stored, f"profile_dict.{str(key)[:40]}", interface.place)
    report.met(profile.kind[:40], READ, interface.place)
    if profile.kind not in _PROFILES:
        known = ", ".join(_PROFILES)
        raise profile.unsupported(f"a profile of class {profile.kind[:40]} is not modelled; modelled are {known}")
    shape = {"curvature": nonzero(profile.number("cv", 0.0) / unit)}
    step = _PROFILES[profile.kind]
    if step is None:
        return shape
    round_conic = profile.number("ec", 1.0) - 1.0 if step == 1 else profile.number("cc", 0.0)
    shape["conic"], terms = nonzero(round_conic), _terms(profile, step, unit) if step else []
    if profile.kind == "YToroid":  # a section in y, with even terms, turned about an axis along y
        if len(terms) > 7:
            raise profile.unsupported("terms of a toroid beyond y^14 are not modelled")
        curvature_x = profile.number("cR", 0.0) / unit
        return shape | {"kind": "toroidal", "coefficients": double([curvature_x, *terms])}
    if step == 1 and any(terms[::2]):
        return shape | {"kind": "odd asphere", "coefficients": double(terms)}
    return shape | ({"coefficients": double(terms[1::2] if step == 1 else terms)} if terms else {})


#: Profiles, and the step in the powers of r of their terms: 0 without terms, None without a conic constant.
_PROFILES = {"Spherical": None, "Conic": 0, "EvenPolynomial": 2, "RadialPolynomial": 1, "YToroid": 2}


def _terms(profile: Part, step: int, unit: float) -> list[float]:
    """The coefficients of r^step, r^2step, … in mm, without zeros at the end; files before 0.9.5 name each."""
    listed = profile.numbers("coefs")
    if not any(listed):
        listed = [profile.number(f"coef{step * j}", 0.0) for j in range(1, 11)]
    while listed and not listed[-1]:
        listed.pop()
    return [c / unit ** (step * j - 1) for j, c in enumerate(listed, 1)]


def _phase(element: Part, unit: float, report: Draft) -> RadialPhase:
    """p = order λ/λ_ref Σ c_j r^2j, as a phase in radians at the radius of a unit of length."""
    report.met(element.kind[:40], READ, element.place)
    function = element.text("phase_fct_name", element.kind)
    if element.kind != "DiffractiveElement" or function != "radial_phase_fct":
        kind = f"a phase of class {element.kind[:40]} ({function[:40]})"
        raise element.unsupported(f"{kind} is not modelled; modelled is radial_phase_fct")
    wave = element.number("ref_wl") * 1e-6  # mm
    if not wave > 0:
        raise element.error("ref_wl is expected above 0")
    message = "light refracts at the diffractive surface, which ray-optics 0.9.8 leaves out of light from air"
    report.warn(message, element.place)
    terms = [2 * math.pi * c * unit / wave for c in element.numbers("coefficients")] or [0.0]
    return RadialPhase(double(terms), double(unit), double(element.number("order", 1.0)))


def _poses(decentre: Part, unit: float) -> tuple[Pose | None, Pose | None]:
    """The pose of a surface and that behind it, by a decentre, tilts, and their type."""
    kind = decentre.text("_dtype", decentre.text("dtype", "decenter"))
    dec, euler = ((decentre.numbers(name) + [0.0] * 3)[:3] for name in ("dec", "euler"))
    if any(decentre.numbers("rot_pt")):
        raise decentre.unsupported("a point of rotation other than the vertex is not modelled")
    numbers = dict(zip(("x", "y", "z"), (unit * value for value in dec), strict=True))
    numbers |= {"tilt_x": -euler[0], "tilt_y": -euler[1], "tilt_z": euler[2]}
    modelled = {name: number for name, number in numbers.items() if number}
    tilts = sum(name.startswith("tilt") for name in modelled)
    axes = {"decenter": ONWARD, "dec and return": RETURNED, "bend": BENT}.get(kind, "")
    is_known = {ONWARD: True, RETURNED: tilts in (0, len(modelled)), BENT: tilts <= 1}
    if not modelled or is_known.get(axes):
        return poses_of(modelled, axes or ONWARD)
    message = f"{shown(kind)} of {', '.join(modelled)} is not modelled; modelled are decenter, "
    raise decentre.unsupported(f"{message}dec and return of a decentre or of tilts, and bend about one axis")


_SHAPES = {
    "Circular": ("circular", ("radius",)),
    "Rectangular": ("rectangular", ("x_half_width", "y_half_width")),
    "Elliptical": ("elliptic", ("x_half_width", "y_half_width")),
}


def _clear(aperture: Part, unit: float) -> Aperture:
    if aperture.kind not in _SHAPES or aperture.number("rotation", 0.0):
        raise aperture.unsupported(f"an aperture of class {aperture.kind[:40]}, or a rotated one, is not modelled")
    shape, names = _SHAPES[aperture.kind]
    sizes = tuple(abs(aperture.number(name)) * unit for name in names)
    sizes = (0.0, *sizes) if shape == "circular" else sizes
    centre = tuple(aperture.number(name, 0.0) * unit for name in ("x_offset", "y_offset"))
    obscures = bool(aperture.attributes.get("is_obscuration"))
    return clear_aperture(shape, sizes, obscures, centre, f"{aperture.path}:", aperture.place)


# -- media ------------------------------------------------------------------------------------------------------------


def _medium(medium: Part, wavelengths: list[float], catalogs: Sequence[Path], report: Draft) -> Glass:
    """Air, a constant index, a table, a model glass, or a glass of a catalog, by the class of a medium."""
    name, kind, place = medium.text("label").strip(), medium.kind, medium.place
    if kind == "Air":
        return AIR
    if kind in ("ConstantIndex", "Medium"):
        index = medium.number("n")
        report.glass(place, name, f"constant index {index!r}")
        return AIR if index == 1 else constant(_positive(medium, index), name)
    if kind in ("InterpolatedMedium", "InterpolatedGlass"):
        waves, indices = [1e-3 * wave for wave in medium.numbers("wvls")], medium.numbers("rndx")
        report.glass(place, name, f"a formula for its {len(waves)} indices")
        try:
            return from_table(waves, indices, name=name)
        except ValueError as error:
            raise medium.error(str(error)) from error
    if kind in ("ModelGlass", "Glass") and not medium.has("gname"):
        return _model_glass(medium, name, wavelengths, report)
    if not medium.has("gname"):
        raise medium.unsupported(f"a medium of class {kind[:40]} is not modelled")
    maker = medium.module.rpartition(".")[2].upper()
    return listed_glass(medium.text("gname"), catalogs=(maker,), user=catalogs, place=place, report=report)


def _positive(medium: Part, index: float) -> float:
    if not index > 0:
        raise medium.error(f"an index of {index:g}, expected a positive one")
    return index


def _model_glass(medium: Part, name: str, wavelengths: list[float], report: Draft) -> Glass:
    """n = n_0 + ν_1 ω + ν_2 ω², ω = (λ - λ_0)/(1 + 2.5 (λ - λ_0)), as a formula that meets it at the lens's lines."""
    model = medium.part("bdhl_model")
    start, index, terms = model.number("wv0"), _positive(medium, model.number("rind0")), model.numbers("coefs")
    if len(terms) != 2:
        raise model.error(f"{len(terms)} coefficients, expected Buchdahl's two")
    lines = list(dict.fromkeys(wavelengths))[:5]
    low, high = min(0.42, *lines), max(0.68, *lines)
    grid = [wave for k in range(13) if (wave := low + (high - low) * k / 12) not in lines]
    waves = double([*lines, *grid])
    omega = (waves - start) / (1 + 2.5 * (waves - start))
    indices = index + terms[0] * omega + terms[1] * omega**2
    if not bool(((1 + 2.5 * (waves - start)) > 0.05).all() & (indices > 0).all()):
        raise medium.error("Buchdahl's formula has no index at a wavelength of the lens")
    glass = from_table(waves, indices, exact=len(lines), name=name)
    off = float((refractive_index(glass, waves) - indices).abs().max())
    figures = f"nd {medium.number('n', index):g}, Vd {medium.number('v', 0.0):g} by Buchdahl's formula"
    report.glass(medium.place, name, f"{figures}, met to {off:.1e} from {low:g} to {high:g} µm")
    return glass


# -- the system -------------------------------------------------------------------------------------------------------

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


def read(content: bytes, file: str, report: Draft, catalogs: Sequence[Path] = ()) -> Lens:
    """The lens of a .roa file's bytes; report: filled. Raises LensFileError, UnsupportedSurface and UnknownGlass."""
    place = Place(file)
    model = model_of(content, place)
    for name in model.attributes:
        status = IGNORED if name in _LEFT_OUT else READ
        report.met(name[:40], status, place, _LEFT_OUT.get(name, ""))
    sequence, optics, system = (model.part(name) for name in ("seq_model", "optical_spec", "system_spec"))
    dimensions = system.text("_dimensions", system.text("dimensions", "mm")).lower()
    if dimensions not in _UNITS:
        raise system.error(f"dimensions are {shown(dimensions)}, expected one of {', '.join(_UNITS)}")
    unit, region, pupil = _UNITS[dimensions], optics.part("spectral_region"), optics.part("pupil")
    # nm in the file, each rounded once
    waves = [float(Decimal(repr(wave)).scaleb(-3)) for wave in region.numbers("wavelengths")]
    weights, primary = region.numbers("spectral_wts"), int(region.number("reference_wvl", 0))
    if not waves or min(waves) <= 0 or not 0 <= primary < len(waves):  # before they are used for indices
        raise region.error("expected wavelengths in nm above 0, and reference_wvl below the number of wavelengths")
    if len(weights) < len(waves):
        report.warn(f"{len(weights)} weights for {len(waves)} wavelengths; the others are taken as 1", region.place)
    surfaces = surfaces_of(model, sequence, unit, waves, catalogs, report)
    for name, normal, scale in (("temperature", 20.0, "°C"), ("pressure", 760.0, "mm Hg")):
        if system.number(name, normal) != normal:
            message = f"{name} {system.number(name):g} {scale}: indices are those of the catalogs"
            report.warn(message, system.place)
    shift = optics.part("defocus").number("focus_shift", 0.0) * unit if optics.has("defocus") else 0.0
    if shift:
        report.warn(f"the focus shift of {shift:g} mm is added to the distance of the image", optics.place)
        surfaces[-2] = dataclasses.replace(surfaces[-2], thickness=surfaces[-2].thickness + shift)
    stop = sequence.attributes.get("stop_surface")
    if stop is None:
        raise sequence.unsupported("no stop_surface: a stop that floats is not modelled; give a surface the stop")
    if isinstance(stop, bool) or not isinstance(stop, int):
        raise sequence.error(f"stop_surface is {shown(repr(stop))}, expected a surface between object and image")
    kind, aperture = _aperture(pupil, surfaces, waves[primary], unit)
    draft = LensDraft(
        surfaces=surfaces,
        stop=stop,
        aperture_kind=kind,
        aperture=aperture,
        **_fields(optics.part("field_of_view"), unit, report),
        wavelengths=waves,
        wavelength_weights=(weights + [1.0] * len(waves))[: len(waves)],
        primary_wavelength=primary + 1,
        name=system.text("title").strip(),
        catalogs=tuple(dict.fromkeys(surface.glass.catalog for surface in surfaces if surface.glass.catalog)),
        sources={
            "stop": (f"{sequence.path}: stop_surface", sequence.place),
            "aperture": (f"{pupil.path}: value is {pupil.number('value'):g}", pupil.place),
            "wavelength_weights": (f"{region.path}: spectral_wts", region.place),
        },
    )
    return assemble(draft, file)


def _key(part: Part) -> tuple[str, str]:
    key = part.attributes.get("_key", part.attributes.get("key"))
    if not isinstance(key, list) or len(key) < 2 or not all(isinstance(word, str) for word in key):
        raise part.error(f"key is {shown(repr(key))}, expected the quantity of its value, as [object, epd]")
    return key[-2], key[-1]


def _aperture(pupil: Part, surfaces: list[Surface], wavelength: float, unit: float) -> tuple[str, float]:
    """Kind and size of the system aperture."""
    space, kind = _key(pupil)
    size = abs(pupil.number("value"))
    at_infinity = bool(torch.isinf(surfaces[0].thickness))
    if space == "object" and kind in ("epd", "pupil"):
        return "entrance_pupil_diameter", size * unit
    if not size:
        return "image_f_number", size  # which `assemble` refuses
    if space == "object" and not at_infinity and kind in ("NA", "f/#"):
        return "object_na", math.sin(math.atan(0.5 / size)) if kind == "f/#" else size
    if space == "image" and kind == "NA":
        index = float(refractive_index(surfaces[-2].glass, double(wavelength))) if not surfaces[-2].is_mirror else 1.0
        if not size < index:
            raise pupil.error(f"an NA of {size:g} of an image space of index {index:g}")
        kind, size = "f/#", 0.5 / (index * math.tan(math.asin(size / index)))
    if space == "image" and kind == "f/#":
        return "image_f_number" if at_infinity else "paraxial_working_f_number", size
    raise pupil.error(f"a pupil by {space} {kind} is not modelled; expected object epd or NA, image f/# or NA")


def _fields(view: Part, unit: float, report: Draft) -> dict:
    key = _key(view)
    if key not in _FIELDS:
        raise view.error(f"fields by {' '.join(key)} are not modelled; expected object angle, height, image height")
    points = view.parts("fields")
    if not points:
        raise view.error("no fields")
    kind = _FIELDS[key]
    length = 1.0 if kind == "angle" else unit
    length *= view.number("value", 1.0) if view.attributes.get("is_relative") else 1.0
    rows = []
    for point in points:  # decentre and compression in x and y, from the fractions cut off on either side
        low_x, high_x, low_y, high_y = (point.number(f"v{side}{axis}", 0.0) for axis in "xy" for side in "lu")
        decentre = 0.5 * (low_x - high_x), 0.5 * (low_y - high_y)
        rows.append((*decentre, 0.5 * (low_x + high_x), 0.5 * (low_y + high_y), 0.0))
    if any(map(any, rows)):
        report.note("vignetting: the pupil is decentred and compressed as a whole, as by CODE V's factors")
    return {
        "field_kind": kind,
        "x": [length * point.number("x") for point in points],
        "y": [length * point.number("y") for point in points],
        "field_weights": [point.number("wt", 1.0) for point in points],
        "vignetting": list(zip(*rows, strict=True)),
    }
