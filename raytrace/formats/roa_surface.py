"""A surface of a file of ray-optics as a `Surface`, and the medium behind it: a row for every class."""

import math
from collections.abc import Sequence
from pathlib import Path

from raytrace.formats.media import listed_glass
from raytrace.formats.report import READ, Draft
from raytrace.formats.roa_parts import Part, part_of
from raytrace.formats.source import MAX_SURFACES, shown
from raytrace.formats.spelling import double
from raytrace.media.glass import AIR, MIRROR, Glass, constant, from_table, refractive_index
from raytrace.system.aperture import SHAPES, Aperture
from raytrace.system.phases import RadialPhase
from raytrace.system.pose import Pose, undone
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
