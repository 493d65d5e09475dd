"""A surface of an OSLO lens file as a `Surface`: shape, medium and aperture."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch

from raytrace.formats.media import listed_glass
from raytrace.formats.oslo_keywords import Surface as Commands
from raytrace.formats.oslo_pickups import Built, curved, picked_up, what
from raytrace.formats.oslo_poses import poses
from raytrace.formats.oslo_solves import Step
from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, UnsupportedSurface, shown
from raytrace.formats.spelling import double, is_number
from raytrace.formats.zemax_keywords import Record
from raytrace.media.glass import AIR, MIRROR, Glass, constant, from_table, refractive_index
from raytrace.system.aperture import Aperture
from raytrace.system.surface import Surface

#: Lens units: an object at this distance or beyond is at infinity.
INFINITE = 1e8

#: Aspheric terms by the power of r they stand with.
_TERMS = {"AD": 4, "AE": 6, "AF": 8, "AG": 10}

#: No medium has an index beyond these.
_SMALLEST, _LARGEST = 0.1, 6.0


def build(commands: Commands, before: Sequence[Built], unit: float, user: Sequence[Path], report: Draft) -> Built:
    """The surface of its commands, lengths in units of `unit` mm; what is solved for is 0 until it is solved.

    before: the surfaces that it may pick up from. user: glass catalogs (.agf). Raises LensFileError, UnsupportedSurface
    and UnknownGlass.
    """
    note = commands.last("NOT")
    radius, aperture = _aperture(commands, unit)
    picked = picked_up(commands, before, unit, report)
    shape = {
        "thickness": double(_thickness(commands, unit)),
        "curvature": curved(_curvature(commands) / unit),
        "conic": curved(_last_number(commands, "CC", "conic constant")),
        "coefficients": _coefficients(commands, unit),
        "glass": picked["glass"] if "glass" in picked else _medium(commands, user, report),
    }
    surface = Surface(
        semi_diameter=radius,
        apertures=aperture,
        comment=" ".join(note.words) if note else "",
        **(shape | picked),
        **poses(commands, unit),
    )
    return Built(surface, commands)


def _last_number(commands: Commands, word: str, what: str) -> float:
    record = commands.last(word)
    return record.number(0, what) if record else 0.0


def step(built: Built, primary: float, before: Step | None) -> Step:
    """The surface as the axial ray meets it, at the primary wavelength in µm."""
    surface, commands = built
    index = before.index if surface.is_mirror else float(refractive_index(surface.glass, double(primary)))
    if not index:
        raise LensFileError(f"{surface.glass.name or 'the medium'} has no index at {primary:g} µm", commands.place)
    curvature = float(surface.curvature) if surface.curvature is not None else 0.0
    return Step(commands.place, curvature, float(surface.thickness), index, surface.is_mirror, *_solves(commands))


def _solves(commands: Commands) -> tuple[Record | None, Record | None]:
    """PU and PY. Raises LensFileError where the number that they solve for is told beside them."""
    solves = commands.last("PU"), commands.last("PY")
    pickups = {what(record): record for record in commands.all("PK")}
    told = (
        (commands.last("RD", "CV") or pickups.get("CV") or pickups.get("CVM")),
        (commands.last("TH") or pickups.get("TH") or pickups.get("THM")),
    )
    for given, solved in zip(told, solves, strict=True):
        if given and solved:
            message = f"{given.keyword} in line {given.place.line} and {solved.keyword} tell the same number twice"
            raise LensFileError(f"{message}; delete one of them", solved.place)
    return solves


def solved(surface: Surface, found: Step) -> Surface:
    """The surface with what its solves came to."""
    if found.slope:
        surface = dataclasses.replace(surface, curvature=double(found.curvature))
    return dataclasses.replace(surface, thickness=double(found.thickness)) if found.height else surface


def _curvature(commands: Commands) -> float:
    """In 1/units: of RD, where 0 is a plane, or CV."""
    radius, curvature = commands.last("RD"), commands.last("CV")
    if radius and curvature:
        raise LensFileError(f"CV, but RD in line {radius.place.line} tells the radius", curvature.place)
    if curvature:
        return curvature.number(0, "curvature")
    found = radius.number(0, "radius of curvature") if radius else 0.0
    return 1 / found if found else 0.0


def _thickness(commands: Commands, unit: float) -> float:
    record = commands.last("TH")
    found = record.number(0, "thickness") if record else 0.0
    if commands.place.surface == 0 and found >= INFINITE:
        return float("inf")
    if abs(found) >= INFINITE:
        raise LensFileError(f"TH is {shown(record.words[0])}; only the object may be at infinity", record.place)
    return found * unit


def _coefficients(commands: Commands, unit: float) -> torch.Tensor | None:
    """Of r², r⁴, … r¹⁰: OSLO's asphere begins with r⁴."""
    found = {power: commands.last(word) for word, power in _TERMS.items()}
    terms = [0.0, *(r.number(0, f"coefficient of r^{p}") / unit ** (p - 1) if r else 0.0 for p, r in found.items())]
    return double(terms) if any(terms) else None


def _aperture(commands: Commands, unit: float) -> tuple[float | None, tuple[Aperture, ...]]:
    """AP r is a semi-diameter, AP CHK r also clips rays; 0 is left to the program. The object's says its field."""
    record = commands.last("AP")
    if record is None or commands.place.surface == 0:
        return None, ()
    checked = [word.upper() for word in record.words[:1]] == ["CHK"]
    radius = record.number(int(checked), "radius of the aperture")
    if radius < 0:
        raise LensFileError(f"AP is {radius:g}, expected a radius of 0 or more", record.place)
    if len(record.words) > 1 + checked:
        raise UnsupportedSurface(f"AP {shown(' '.join(record.words))}: expected AP r or AP CHK r", record.place)
    radius *= unit
    return radius or None, (Aperture("circular", (0.0, radius), False, (0.0, 0.0)),) if checked and radius else ()


def _medium(commands: Commands, user: Sequence[Path], report: Draft) -> Glass:
    """AIR, RFL and RFH (a mirror) or GLA: the last of them; air where none stands."""
    found = commands.all("AIR", "RFL", "RFH", "GLA")
    if not found:
        return AIR
    record = found[-1]
    if record.keyword in ("RFL", "RFH"):
        return MIRROR
    return AIR if record.keyword == "AIR" else _glass(record, commands, user, report)


def _glass(record: Record, commands: Commands, user: Sequence[Path], report: Draft) -> Glass:
    """A glass by its name, or by its indices at the wavelengths in force: GLA n…, GLA name n…, GLA MOD name n…"""
    words, place = list(record.words), record.place
    modelled = len(words) > 1 and words[0].upper() == "MOD"
    words = words[modelled:]
    name = words.pop(0) if words and not is_number(words[0]) else ""
    if not words:
        if not name or modelled:
            raise LensFileError(f"GLA {' '.join(record.words)} without a name or an index".replace("  ", " "), place)
        return listed_glass(name, catalogs=(), user=user, place=place, report=report)
    indices = [record.number(len(record.words) - len(words) + k, "index") for k in range(len(words))]
    for index in indices:
        if not _SMALLEST <= index <= _LARGEST:
            message = f"GLA {shown(' '.join(record.words))}: {index:g} is no index; a glass by index and Abbe number"
            raise UnsupportedSurface(f"{message}, or by a code, is not modelled", place)
    return _by_indices(name, indices, commands.wavelengths, record, report)


def _by_indices(name: str, indices: list[float], at: tuple[float, ...], record: Record, report: Draft) -> Glass:
    listed = ", ".join(map(repr, indices))
    if len(set(indices)) == 1:
        report.glass(record.place.surface, name, f"constant index {indices[0]!r}")
        return constant(indices[0], name)
    if len(indices) > len(at):
        raise LensFileError(f"{len(indices)} indices for {len(at)} wavelengths", record.place)
    report.glass(record.place.surface, name, f"indices {listed} at {', '.join(map(repr, at[: len(indices)]))} µm")
    try:
        return from_table(at[: len(indices)], indices, name=name)
    except ValueError as error:
        raise LensFileError(f"GLA: {error}", record.place) from error
