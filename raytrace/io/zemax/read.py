"""Read a sequential lens file of Zemax OpticStudio (.zmx).

Three stages: text -> records with line numbers -> the keyword table -> Lens. Conventions, each settled against numbers
that OpticStudio itself stored:

- The file carries solved values; nothing is solved again. Lengths are in the file's UNIT and become mm.
- DIAM is a semi-diameter, and alone clips no ray. CLAP, FLAP, SQAP, ELAP clip, OBSC, SQOB, ELOB obscure, about OBDC.
  FLAP, the floating aperture, is the circle of the surface's DIAM.
- A surface without TYPE is STANDARD. CURV 0 and CONI 0 become None: a plane, a sphere.
- EVENASPH: PARM j is the coefficient of r^(2j), from r² on.
- WAVM has padded slots, field lists are padded; FTYP tells how many are used. PWAV counts from 1.
- The surfaces of a multi-configuration file hold the configuration active when it was saved, normally the first;
  the others are read from its operands (`zemax_configurations`).
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from torch import Tensor

from raytrace.io.materials import AtHand, catalogs_at_hand
from raytrace.io.report import Draft, ImportReport
from raytrace.io.source import LensFileError, UnsupportedSurface, shown
from raytrace.io.spelling import MILLIMETRES, double, refuse_overflow
from raytrace.io.substitutes import NONE, Substitutes
from raytrace.io.zemax import configurations as zemax_configurations
from raytrace.io.zemax import environment as zemax_environment
from raytrace.io.zemax import optimization
from raytrace.io.zemax import surfaces as zemax_surface
from raytrace.io.zemax.keywords import (
    AIMINGS,
    FIELD_KINDS,
    FIELD_LISTS,
    FIELD_NAMES,
    NOTE_PIECE,
    SYSTEM_APERTURES,
    Block,
    Record,
    Sections,
    sections,
)
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.surface import Surface

#: More field points or wavelengths than any file has.
_MOST = 1000


def read(
    text: str,
    file: str,
    *,
    catalogs: Sequence[Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    packed: AtHand | None = None,
    substitutes: Substitutes = NONE,
) -> tuple[Lens, ImportReport]:
    """The lens of a .zmx text and the report of its import.

    file: its name, for messages and for the catalogs beside it. catalogs: further glass catalogs (.agf). strict: every
    warning is an error. configuration: which one of a multi-configuration file, from 1; None: the one that its surfaces
    hold. packed: the catalogs of an archive, instead of those beside the file. substitutes: of glasses.
    Raises LensFileError, UnsupportedSurface (a type that is not modelled) and UnknownGlass.
    """
    report = Draft(file, "zmx", substitutes)
    found = sections(text, file, report)
    _refuse_incomplete(found)
    zemax_surface.refuse_unsupported(found.surfaces)
    unit = _millimetres(found.system, report)
    names = tuple(name for record in found.system.all("GCAT") for name in record.words)
    at_hand = catalogs_at_hand(names, catalogs, report, packed)
    build = partial(zemax_surface.build, millimetres=unit, catalogs=at_hand, user=catalogs)
    lens = _lens(found, [build(block, blocks=found.surfaces, report=report) for block in found.surfaces], unit, report)
    refuse_overflow(lens, file)
    _remarks(found, report)
    known = dict(zip(found.surfaces, lens.surfaces, strict=True))

    def rebuild(other: Sections) -> Lens:
        """The lens of changed records; what they were before is known."""
        draft = report.again()
        surfaces = [known.get(block) or build(block, blocks=other.surfaces, report=draft) for block in other.surfaces]
        changed = _lens(other, surfaces, unit, draft)
        refuse_overflow(changed, file)
        return changed

    lens = zemax_configurations.read(found, lens, rebuild, report, configuration)
    lens = optimization.read(found, lens, unit, report)
    zemax_environment.tell(found, lens, report)
    return lens, report.finished(strict=strict)


def _lens(found: Sections, surfaces: Sequence[Surface], unit: float, report: Draft) -> Lens:
    """The lens of these surfaces and the records of the system."""
    system, stop = found.system, _stop(found.surfaces)
    wavelengths, weights = _wavelengths(system, report)
    name, environment = system.last("NAME"), zemax_environment.environment(system)
    return Lens(
        surfaces=zemax_environment.placed(surfaces, found.surfaces, environment),
        stop=stop,
        aperture=_aperture(system, surfaces[stop].semi_diameter, unit, report),
        fields=_fields(system, unit, report),
        wavelengths=wavelengths,
        wavelength_weights=weights,
        primary_wavelength=_primary(system, len(wavelengths), report),
        name=name.text.strip() if name else "",
        notes=_notes(system),
        catalogs=tuple(name for record in system.all("GCAT") for name in record.words),
        ray_aiming=_ray_aiming(system),
        environment=environment,
    )


def _refuse_incomplete(found: Sections) -> None:
    mode = found.system.last("MODE")
    if mode and mode.words[:1] != ("SEQ",):
        message = f"MODE {' '.join(mode.words)[:40]}: only sequential files (MODE SEQ) are modelled"
        raise UnsupportedSurface(message, mode.place)
    surfaces = found.surfaces
    if len(surfaces) < 3:
        message = f"{len(surfaces)} surfaces, expected at least object, one surface and image; file cut off?"
        raise LensFileError(message, surfaces[-1].place)
    image = surfaces[-1].last("DISZ")
    if image and image.words and image.words[0].strip("+-0.eE") != "":
        message = f"the last surface has thickness {image.words[0][:40]}, but the image has DISZ 0; image cut off?"
        raise LensFileError(message, image.place)


def _stop(surfaces: Sequence[Block]) -> int:
    stops = [block.last("STOP") for block in surfaces if block.last("STOP")]
    if not stops:
        raise LensFileError("no surface is marked STOP; add the line STOP to the aperture stop", surfaces[0].place)
    if len(stops) > 1:
        first = stops[0].place.surface
        raise LensFileError(f"a second STOP; surface {first} is the stop already", stops[1].place)
    stop = stops[0].place
    if not 0 < stop.surface < len(surfaces) - 1:
        raise LensFileError("STOP on the object or the image; expected a surface between them", stop)
    return stop.surface


def _millimetres(system: Block, report: Draft) -> float:
    """Millimetres in the file's unit of length."""
    record = system.last("UNIT")
    if record is None:
        report.note("no UNIT: lengths are in mm")
        return 1.0
    unit = record.words[0].upper() if record.words else ""
    if unit not in MILLIMETRES:
        raise LensFileError(f"UNIT is {shown(unit)}, expected one of MM, CM, IN, METER", record.place)
    if unit != "MM":
        report.note(f"lengths of the file are in {unit}; converted to mm")
    return MILLIMETRES[unit]


def _aperture(system: Block, stop_semi_diameter: float | None, unit: float, report: Draft) -> SystemAperture:
    """The system aperture: ENPD, FNUM (0 image space, 1 working), OBNA (0 sine, 1 cone angle) or FLOA (by the stop)."""
    found = system.all("ENPD", "FNUM", "OBNA", "FLOA")
    if not found:
        raise LensFileError("no system aperture; expected one of ENPD, FNUM, OBNA, FLOA", system.place)
    record = found[-1]
    if len({other.keyword for other in found}) > 1:
        names = " and ".join(f"{other.keyword} in line {other.place.line}" for other in found)
        report.warn(f"several system apertures ({names}); the last is used", record.place)
    if record.keyword == "FLOA":
        if not stop_semi_diameter:
            raise LensFileError("FLOA (float by stop size), but the stop surface has no DIAM", record.place)
        return SystemAperture("float_by_stop", double(stop_semi_diameter))
    size = record.number(0, "size of the aperture")
    if size <= 0:
        raise LensFileError(f"{record.keyword} is {shown(record.words[0])}, expected a positive number", record.place)
    flag = None if record.keyword == "ENPD" else record.integer(1, "kind of the aperture", 0)
    kind = next((kind for kind, row in SYSTEM_APERTURES.items() if row == (record.keyword, flag)), None)
    if kind is None:
        raise LensFileError(f"{record.keyword} of kind {flag}, expected 0 or 1", record.place)
    if kind == "object_cone_angle" and size > 90:
        told = f"a cone of {record.words[0]} degrees reaches behind the object; rays leave on the same lines forwards"
        report.warn(f"{told}, within {180 - size:g} degrees of the axis, and cover less of a reflector", record.place)
    return SystemAperture(kind, double(size * unit if flag is None else size))


def _count(system: Block, position: int, what: str) -> int | None:
    record = system.last("FTYP")
    if record is None or len(record.words) <= position:
        return None
    count = record.integer(position, what)
    if not 1 <= count <= _MOST:
        raise LensFileError(f"FTYP: {what} is {count}, expected 1 to {_MOST}", record.place)
    return count


def _fields(system: Block, unit: float, report: Draft) -> Fields:
    """The field points: FTYP (kind, telecentric, count), XFLN, YFLN, weights and vignetting factors."""
    record = system.last("FTYP")
    kind = record.integer(0, "kind of field", 0) if record else 0
    if not 0 <= kind < len(FIELD_KINDS):
        name = f" ({FIELD_NAMES[kind]})" if kind in FIELD_NAMES else ""
        raise LensFileError(f"FTYP {kind}{name} is not modelled; expected a kind of field from 0 to 3", record.place)
    points = [system.last(*FIELD_LISTS[axis].keywords) for axis in "xy"]
    count = _count(system, 2, "number of fields")
    if count is None:
        count = max([1, *(_used(line) for line in points if line)])
        place = record.place if record else system.place
        report.warn(f"the number of fields is not stated (FTYP, third value); {count} taken", place)
    length = 1.0 if kind == 0 else unit
    found = {name: _list(system, name, count, report) for name in sorted(FIELD_LISTS, key=str.islower)}
    factors = double([found[name] for name in FIELD_LISTS if name.isupper()])
    return Fields(
        kind=FIELD_KINDS[kind],
        x=double([length * value for value in found["x"]]),
        y=double([length * value for value in found["y"]]),
        weight=double(found["weight"]),
        vignetting=factors if bool(factors.any()) else None,
        telecentric=bool(record.integer(1, "telecentric", 0)) if record else False,
    )


def _used(record: Record) -> int:
    """How many numbers of a list are meant: lists of twelve are padded with zeros."""
    words = list(record.words)
    while len(record.words) >= 12 and len(words) > 1 and words[-1].strip("+-0.eE") == "":
        words.pop()
    return len(words)


def _list(system: Block, name: str, count: int, report: Draft) -> list[float]:
    """A list over the field points, a row of FIELD_LISTS."""
    keywords, default, _ = FIELD_LISTS[name]
    record = system.last(*keywords)
    if record is None:
        return [default] * count
    if len(record.words) < count:
        found = f"{record.keyword} has {len(record.words)} values for {count}"
        if name in "xy":
            raise LensFileError(f"{found} fields", record.place)
        report.warn(f"{found}; the others are taken as {default:g}", record.place)
    return [record.number(position, f"{name} of field", default) for position in range(count)]


def _wavelengths(system: Block, report: Draft) -> tuple[Tensor, Tensor]:
    """Wavelengths in µm and their weights.

    WAVM holds padded slots of which FTYP tells the number in use; older files carry lists (WAVN or WAVL).
    """
    slots = {record.integer(0, "number of the wavelength"): record for record in system.all("WAVM")}
    listed, weights = system.last("WAVN", "WAVL"), system.last("WWGN", "WWGT")
    count = _count(system, 3, "number of wavelengths") or _guessed_count(system, slots, report)
    if all(slot in slots for slot in range(1, count + 1)):
        chosen = [slots[slot] for slot in range(1, count + 1)]
        pairs = [(record.number(1, "wavelength"), record.number(2, "weight", 1.0), record.place) for record in chosen]
    elif listed is not None and len(listed.words) >= count:
        weight = [weights.number(k, "weight", 1.0) if weights else 1.0 for k in range(count)]
        pairs = [(listed.number(k, "wavelength"), weight[k], listed.place) for k in range(count)]
    else:
        place = (slots or {0: system}).popitem()[1].place
        found = f"WAVM {', '.join(map(str, sorted(slots)[:6]))}" if slots else "no WAVM"
        raise LensFileError(f"{found}, expected {count} wavelengths (WAVM 1 to {count})", place)
    for wavelength, weight, place in pairs:
        if not wavelength > 0:
            raise LensFileError(f"wavelength {wavelength:g} µm, expected a positive number", place)
        if weight < 0:
            raise LensFileError(f"weight {weight:g} of a wavelength, expected 0 or more", place)
    return double([pair[0] for pair in pairs]), double([pair[1] for pair in pairs])


def _guessed_count(system: Block, slots: dict[int, Record], report: Draft) -> int:
    short = system.last("WAVL")
    count = len(short.words) if short else len(slots)
    place = short.place if short else system.place
    if not 1 <= count <= 12:
        raise LensFileError("the number of wavelengths is not stated (FTYP, fourth value)", place)
    report.warn(f"the number of wavelengths is not stated (FTYP, fourth value); {count} taken", place)
    return count


def _primary(system: Block, count: int, report: Draft) -> int:
    """The number of the primary wavelength, from 1."""
    record = system.last("PWAV")
    if record is None:
        if count > 1:
            report.warn("no PWAV: the first wavelength is taken as the primary one", system.place)
        return 1
    primary = record.integer(0, "primary wavelength")
    if not 1 <= primary <= count:
        raise LensFileError(f"PWAV is {primary}, expected 1 to {count}, the number of wavelengths", record.place)
    return primary


def _notes(system: Block) -> tuple[str, ...]:
    """The notes: NOTE 0 holds text in pieces of 200 characters, any other number ends a note."""
    found, continues = [], False
    for record in system.all("NOTE"):
        kind, _, text = record.text.partition(" ")
        if kind != "0":
            continues = False
            continue
        if continues:
            found[-1] += text
        else:
            found.append(text)
        continues = len(text) >= NOTE_PIECE
    stripped = (note.strip() for note in found)
    return tuple(note for note in stripped if note and note != "Notes...")


def _ray_aiming(system: Block) -> str:
    """Whether RAIM, in its second number, asks for rays aimed at the stop; "auto" of a file without RAIM."""
    record = system.last("RAIM")
    if record is None:
        return "auto"
    kind = record.integer(1, "ray aiming", 0)
    if not 0 <= kind < len(AIMINGS):
        raise LensFileError(f"RAIM of kind {kind}, expected 0 (off), 1 (paraxial) or 2 (real)", record.place)
    return AIMINGS[kind]


def _remarks(found: Sections, report: Draft) -> None:
    """Say what the file asks for and the lens does not carry: apodisation, afocal."""
    for keyword, position, what, message in (
        ("GFAC", 1, "kind of apodisation", "the beam is apodised (GFAC); taken as uniform"),
        ("FTYP", 6, "afocal", "afocal image space (FTYP, seventh value); the image is taken as a plane"),
    ):
        record = found.system.last(keyword)
        if record and record.integer(position, what, 0):
            report.warn(message, record.place)
