"""Read a sequential lens file of OSLO (.len).

A lens file is a list of commands: LEN NEW begins a lens, NXT begins the next surface, END ends the lens. Commands of
the system precede the data of the first surface and follow those of the last. Conventions, each verified against
numbers of files that others wrote, most of them by OSLO itself (`test_oslo`):

- Numbers are in units of UNI mm. Radii, conics and thicknesses have the meaning of a .zmx file, behind mirrors too.
- AD, AE, AF, AG are the terms of r⁴, r⁶, r⁸, r¹⁰. A surface without a medium has air behind it.
- The first wavelength is the primary one. Indices of a glass are at the wavelengths in force where it is defined.
- EBR is the radius of the beam on surface 1, FNO the F-number, both of an object at infinity; NAO is n sin θ of a near
  object. ANG is the largest field angle; OBH the largest object height, which of an object at infinity gives the angle:
  light from below the axis, of negative height, goes up.
- AP sizes a surface, AP CHK also clips. AST marks the stop; without it surface 1 is the stop.
- Results of solves are not stored: PU, PY 0 of the axial ray are solved again by the y-nu trace. Others are refused.
- Pickups: PK GLA -k is the medium of the k-th surface before. CV and TH are its curvature and its thickness, to which a
  number may be added, CVM and THM those of opposite sign; with a curvature come conic and terms.
- The axes of a surface are decentred by DCX, DCY, DCZ, then tilted by TLA, TLB, TLC about x, y and z in turn (DT 1), or
  tilted about z, y and x and then decentred (DT -1). TLA and TLB are left-handed, TLC right-handed. The following
  surfaces are in these axes; behind a mirror with BEN, in axes that are tilted again by the same angle, so that the
  axis of the light continues along z; behind RCO, in the axes before the surface.

Other pickups, special surfaces and apertures, and further configurations are refused by name. Sources of the poses:
Lambda Research, export of OSLO's tilts to another program (the sequence and the signs); Sinclair Optics, the pentaprism
of the user guide; the tests of Optiland, which were written from the program's reference.
"""

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from raytrace.io.assembly import BENT, ONWARD, RETURNED, LensDraft, assemble, listed_glass, poses_of
from raytrace.io.source import (
    IGNORED,
    READ,
    UNKNOWN,
    Block,
    Draft,
    LensFileError,
    Place,
    Record,
    UnsupportedSurface,
    by_word,
    decode,
    double,
    in_lines,
    is_binary,
    is_number,
    nonzero,
    number,
    read_content,
    refuse_few,
    refuse_surplus,
    shown,
    warn_of_repeats,
)
from raytrace.materials.glass import AIR, MIRROR, Glass, constant, from_table, refractive_index
from raytrace.system.apertures import Aperture
from raytrace.system.lens import Lens
from raytrace.system.surface import Surface, is_posed, medium_surfaces, power, signed, ynu

# -- the commands -----------------------------------------------------------------------------------------------------

#: The field of a pose by its command, and the sign that it takes there.
_POSES = {
    **{"DCX": ("x", 1), "DCY": ("y", 1), "DCZ": ("z", 1)},
    **{"TLA": ("tilt_x", -1), "TLB": ("tilt_y", -1), "TLC": ("tilt_z", 1)},
}

#: Commands of the system that are read; WV2, WW2, SNO1, … count as WV, WW, SNO.
_SYSTEM_READ = by_word({"read": "LEN UNI EBR FNO NAO ANG OBH WV WW SNO NXT END"})
_SYSTEM_IGNORED = by_word(
    {
        "name of the designer; not carried": "DES",
        "setting of the program, independent of the lens": "CBK CALLBACK GPRT DLRS",
    }
)
_SYSTEM_REFUSED = by_word(
    {
        "the size of the beam by its image side": "NAP PUK",
        "the field by its Gaussian image height": "GIH",
        "a jump between surfaces": "GTO",
    }
)
#: Switches of the system that change the trace, unless they are off.
_OFF = ("OFF", "0", "NO")
_SWITCHES = {"TELE": "telecentric object space", "WARM": "wide-angle ray aiming", "AFO": "afocal image space"}

_SURFACE_READ = by_word({"read": "AIR GLA RFL RFH RD CV TH CC AD AE AF AG AP AST PK PU PY NOT DT BEN RCO"}) | _POSES
_SURFACE_IGNORED = by_word(
    {
        "how the program draws it": "DRW LDP BDI BDD VX PF",
        "coefficient of thermal expansion": "TCE",
        "name of an element": "LMN LME ELMDF1 ELMDF2",
    }
)
#: Commands of features that are not modelled, and their names.
_SURFACE_REFUSED = by_word(
    {
        "axes of its own": "GC",
        "a general asphere": "ASP",
        "a toroid": "CVX RDX",
        "a perfect lens, which obeys the sine condition": "PFL PFM",
        "a grating": "GSP GOR",
        "special apertures": "APN ATP AAC AAN AX1 AX2 AY1 AY2",
        "a solve by chief ray or by edge": "PUC PYC EC",
        "a group that is not sequential": "LMO",
    }
)
#: The point that a tilt is about, unless it is the vertex.
_PIVOTS = ("TOX", "TOY", "TOZ")

_TAIL_REASON = "after END: variables, operands, fields of analyses or configurations, not part of the lens"

#: µm: the wavelengths of a lens that states none.
_DEFAULT_WAVELENGTHS = (0.58756, 0.48613, 0.65627)

_TOKEN = re.compile(r'"((?:[^"\\]|\\.)*)"?|(//.*)|(;)|([^\s,;"/]+|/)')
_NUMBERED = re.compile(r"(WV|WW|SNO)([1-9][0-9]{0,2})")


class _Commands(Block):
    """The commands of one surface, and the wavelengths in force where its medium is defined, µm."""

    def __init__(self, place: Place) -> None:
        super().__init__(place)
        self.wavelengths: tuple[float, ...] = ()


class _Sections(NamedTuple):
    """A file sorted: its LEN command, the system, the surfaces, and the wavelengths of the lens, if specified."""

    head: Record
    system: Block
    surfaces: list[_Commands]
    wavelengths: list[float]


def _commands(text: str, file: str) -> Iterator[Record]:
    """The commands of a text: one a line, or several between semicolons; words between blanks, commas or quotes."""
    for line_number, line in enumerate(text.split("\n"), 1):
        words: list[str] = []
        for quoted, comment, end, word in _TOKEN.findall(f"{line};"):
            if not comment and not end:
                words.append(word or quoted.replace('\\"', '"').replace("\\\\", "\\"))
            elif words:
                yield Record(words[0].upper(), tuple(words[1:]), "", Place(file, line_number), False)
                words = []
        if words:
            yield Record(words[0].upper(), tuple(words[1:]), "", Place(file, line_number), False)


def _sections(text: str, file: str, report: Draft) -> _Sections:
    """The commands of the first lens of a text, each of them reported. Raises LensFileError and UnsupportedSurface."""
    records = list(_commands(text, file))
    if not records or records[0].keyword != "LEN" or [word.upper() for word in records[0].words[:1]] != ["NEW"]:
        place = records[0].place if records else Place(file)
        message = "expected LEN NEW at the beginning of a lens file of OSLO (.len)"
        if any(record.keyword in ("RDM", "SO", "DIM") for record in records):
            message += "; the commands are those of CODE V: rename the file to .seq"
        raise LensFileError(message, place)
    system, waves = Block(Place(file)), _Wavelengths()
    surfaces = [_Commands(records[0].place._replace(surface=0))]
    end = next((k for k, record in enumerate(records) if record.keyword == "END"), None)
    last = sum(record.keyword == "NXT" for record in records[:end])
    for record in records[: None if end is None else end + 1]:
        if record.keyword == "NXT":
            refuse_surplus(surfaces, record.place)
            surfaces.append(_Commands(record.place._replace(surface=len(surfaces))))
        _sort(record, system, surfaces[-1], waves, report, len(surfaces) - 1 in (0, last))
    if end is None:
        message = f"no END after {len(surfaces)} surfaces; file cut off?"
        raise LensFileError(message, records[-1].place)
    for record in records[end + 1 :]:
        word = record.keyword[:40]
        if word in ("LEN", "CFG"):
            kind = "another lens" if word == "LEN" else "further configurations"
            report.warn(f"{word} ({kind}) after END: the lens before it is read, unchanged", record.place)
        report.met(word, IGNORED, record.place, _TAIL_REASON)
    warn_of_repeats(surfaces, lambda word: word != "PK", report)
    return _Sections(records[0], system, surfaces, waves.lens)


class _Wavelengths:
    """The wavelengths as the commands of a file change them: WV lists them from the first on, WV2 sets the second."""

    def __init__(self) -> None:
        self.slots = dict(enumerate(_DEFAULT_WAVELENGTHS, 1))
        self.lens: list[float] = []

    def set(self, record: Record, position: int | None) -> None:
        values = [record.number(k, "wavelength") for k in range(len(record.words))]
        if not values or (position and len(values) > 1):
            raise LensFileError(f"{record.keyword} has {len(values)} values, expected one or more", record.place)
        self.slots |= dict(enumerate(values, position or 1))
        if position is None:
            self.lens = values
            return
        self.lens = self.lens or list(_DEFAULT_WAVELENGTHS)
        if position > len(self.lens) + 1:
            raise LensFileError(f"{record.keyword}, but {len(self.lens)} wavelengths precede it", record.place)
        self.lens[position - 1 : position] = values

    def in_force(self) -> tuple[float, ...]:
        """The first wavelengths, up to the first that was never set."""
        count = next(k for k in range(1, len(self.slots) + 2) if k not in self.slots) - 1
        return tuple(self.slots[k] for k in range(1, count + 1))


def _sort(record: Record, system: Block, surface: _Commands, waves: _Wavelengths, report: Draft, at_end: bool) -> None:
    """One command into the system or a surface, or left out where it changes nothing, else refused.

    at_end: of the object or the image, or of the system.
    """
    numbered = _NUMBERED.fullmatch(record.keyword)
    word, position = (numbered[1], int(numbered[2])) if numbered else (record.keyword, None)
    of_surface = record._replace(place=record.place._replace(surface=surface.place.surface))
    if word == "WV":
        waves.set(record, position)
    if word in _SYSTEM_READ:
        system.records.setdefault(word, []).append(record)
        report.met(record.keyword, READ, record.place)
    elif word in _SYSTEM_IGNORED:
        report.met(word, IGNORED, record.place, _SYSTEM_IGNORED[word])
    elif word in _SURFACE_READ:
        if word == "GLA":
            surface.wavelengths = waves.in_force()
        surface.records.setdefault(word, []).append(of_surface)
        report.met(word, READ, of_surface.place)
    elif word in _SURFACE_IGNORED:
        report.met(word, IGNORED, of_surface.place, _SURFACE_IGNORED[word])
    elif word in _SYSTEM_REFUSED:
        raise UnsupportedSurface(f"{word} ({_SYSTEM_REFUSED[word]}) is not modelled", record.place)
    elif word in _SWITCHES:
        if not record.words or record.words[0].upper() not in _OFF:
            raise UnsupportedSurface(f"{word} ({_SWITCHES[word]}) is not modelled", record.place)
        report.met(word, IGNORED, record.place, f"{_SWITCHES[word]}: switched off")
    elif word in _PIVOTS:
        if record.number(0, "point that the tilt is about"):
            message = f"{word} {record.words[0]} (a tilt about another point than the vertex) is not modelled"
            raise UnsupportedSurface(message, of_surface.place)
        report.met(word, IGNORED, of_surface.place, "tilted about the vertex")
    elif word == "LMO" and [text.upper() for text in record.words[:1]] in (["ELE"], ["EGR"]):
        report.met(word, IGNORED, of_surface.place, "a group of surfaces under one name")
    elif word in _SURFACE_REFUSED or re.fullmatch(r"AS\d+", word):
        feature = _SURFACE_REFUSED.get(word, "a general asphere")
        raise UnsupportedSurface(f"{word} ({feature}) is not modelled", of_surface.place)
    elif at_end:
        report.met(word[:40], UNKNOWN, record.place)
    else:
        message = f"the command {shown(word)} is not known, and may change how light passes the surface"
        raise UnsupportedSurface(f"{message}; take it out where it does not", of_surface.place)


# -- the lens ---------------------------------------------------------------------------------------------------------

#: Field points, as fractions of the largest height or tangent: OSLO's own three.
_FRACTIONS = (0.0, 0.7, 1.0)

#: Millimetres in a lens unit, beyond which UNI is damaged.
_SMALLEST_UNIT, _LARGEST_UNIT = 1e-6, 1e6

#: System apertures by their commands, and whether they refer to an object at infinity.
_APERTURES = {
    "EBR": ("entrance_pupil_diameter", True),
    "FNO": ("image_f_number", True),
    "NAO": ("object_na", False),
}


def load(path: Path) -> str:
    """The text of a file. Raises LensFileError, also for the binary .len files of CODE V."""
    content = read_content(path)
    if is_binary(content):
        message = "is binary: a .len file of CODE V, which is not read; OSLO's is text. In CODE V, write it by WRL"
        raise LensFileError(f"{message} as a sequence file (.seq)", Place(str(path)))
    return decode(content, Place(str(path)))


def read(text: str, file: str, report: Draft, catalogs: Sequence[Path] = ()) -> Lens:
    """The lens of a .len text; report: filled. catalogs: precede the shipped ones; the file names none.

    Raises LensFileError, UnsupportedSurface and UnknownGlass.
    """
    parts = _sections(text, file, report)
    _refuse_incomplete(parts)
    unit = parts.system.number("UNI", "mm in a lens unit", 1.0)
    if not _SMALLEST_UNIT <= unit <= _LARGEST_UNIT:
        raise LensFileError(f"UNI is {unit:g}, expected the millimetres in a lens unit", parts.system.place_of("UNI"))
    surfaces: list[Surface] = []
    for commands in parts.surfaces:
        surfaces.append(_surface(commands, surfaces, parts.surfaces, unit, catalogs, report))
    far = float(surfaces[0].thickness) == math.inf
    waves = list(parts.wavelengths)
    if not waves:
        waves = list(_DEFAULT_WAVELENGTHS)
        message = f"no WV: the program's own wavelengths are taken, {', '.join(map(str, waves))} µm"
        report.warn(message, parts.head.place)
    if min(waves) <= 0:  # before they are used for indices
        raise LensFileError(f"wavelength {min(waves):g} µm, expected a positive number", parts.head.place)
    kind, aperture, source = _system_aperture(parts, far, unit, report)
    field_kind, y = _fields(parts, far, unit, report)
    words = parts.head.words[1:2]
    notes = (" ".join(record.words).strip() for record in parts.system.all("SNO"))
    stop = _stop(parts, report)
    beam = 0.5 * aperture if kind == "entrance_pupil_diameter" else None
    draft = LensDraft(
        surfaces=_solved(parts, surfaces, waves[0], beam, unit, report),
        stop=stop.surface or 0,
        aperture_kind=kind,
        aperture=aperture,
        field_kind=field_kind,
        x=[0.0] * len(y),
        y=y,
        wavelengths=waves,
        wavelength_weights=_weights(parts, len(waves)),
        name=words[0].strip() if words and not is_number(words[0]) else "",
        notes=tuple(note for note in notes if note),
        sources={"stop": ("AST", stop), "aperture": source},
    )
    if weights := parts.system.all("WW"):
        draft.sources["wavelength_weights"] = (weights[-1].keyword, weights[-1].place)
    return assemble(draft, file)


def _refuse_incomplete(parts: _Sections) -> None:
    surfaces, last = parts.surfaces, len(parts.surfaces) - 1
    refuse_few(surfaces)
    counts = [("LEN NEW", number(word, "surfaces", parts.head.place)) for word in _stated(parts)[1:]]
    end = parts.system.last("END")
    counts += [("END", end.number(0, "number of the image"))] if end and end.words else []
    for keyword, count in counts:
        if count != last and not (keyword == "LEN NEW" and count > last):  # space for more surfaces
            place = parts.system.place_of("END") if keyword == "END" else parts.head.place
            raise LensFileError(f"{keyword} states that the image is surface {count:g}, but it is {last}", place)
    if shift := surfaces[-1].number("TH", "focus shift"):
        message = f"TH {shift:g} of the image (a focus shift) is not modelled; add it to the thickness before"
        raise UnsupportedSurface(message, surfaces[-1].place_of("TH"))
    for word, k in (*((word, k) for word in ("PU", "PY") for k in (0, last)), ("RFL", 0), ("RFH", 0)):
        if record := surfaces[k].last(word):
            kind = "a solve" if word[0] == "P" else "a mirror"
            raise UnsupportedSurface(f"{word} ({kind}) of the object or the image is not modelled", record.place)


def _stated(parts: _Sections) -> list[str]:
    """The numbers that LEN NEW states at most: focal length and number of the image."""
    words = parts.head.words[1:]
    numbers = words[1:] if words and not is_number(words[0]) else words
    return [word for word in numbers[:2] if is_number(word)]


def _weights(parts: _Sections, count: int) -> list[float]:
    """The weights of the wavelengths: WW lists them from the first on, WW2 from the second."""
    weights = dict.fromkeys(range(1, count + 1), 1.0)
    for record in parts.system.all("WW"):
        start = int(record.keyword[2:] or 1)
        listed = {start + k: record.number(k, "weight") for k in range(len(record.words))}
        if not listed or not listed.keys() <= weights.keys():
            message = f"{record.keyword} has {len(listed)} values for {count} wavelengths"
            raise LensFileError(message, record.place)
        weights |= listed
    return list(weights.values())


def _system_aperture(parts: _Sections, far: bool, unit: float, report: Draft) -> tuple[str, float, tuple[str, Place]]:
    """Kind and size of the system aperture, and its source; far: whether the object is at infinity."""
    record = parts.system.last_of_kind(_APERTURES, "system aperture", report)
    size = record.number(0, "size of the aperture")
    kind, is_of_far = _APERTURES[record.keyword]
    if is_of_far != far:
        where = "a near object" if is_of_far else "an object at infinity"
        raise UnsupportedSurface(f"{record.keyword} of {where} is not modelled", record.place)
    source = (f"{record.keyword} is {shown(record.words[0])}", record.place)
    return kind, 2 * size * unit if record.keyword == "EBR" else size, source


def _fields(parts: _Sections, far: bool, unit: float, report: Draft) -> tuple[str, list[float]]:
    """Points on the y axis, at _FRACTIONS of the largest field, the only one in the file."""
    records = parts.system.all("ANG", "OBH")
    if not records:
        report.note("neither ANG nor OBH: the field is the axis")
        return "angle", [0.0]
    record = records[-1]
    if len(records) > 1:
        report.warn(f"several fields ({in_lines(records)}); the last is used", record.place)
    most = record.number(0, "field")
    if record.keyword == "ANG" and not far:
        raise UnsupportedSurface("ANG (a field angle) of a near object is not modelled", record.place)
    if most:
        fractions = ", ".join(f"{fraction:g}" for fraction in _FRACTIONS)
        report.note(f"fields: {fractions} of the largest one, which {record.keyword} gives")
    if not far:
        return "object_height", [fraction * most * unit for fraction in _FRACTIONS] if most else [0.0]
    if record.keyword == "ANG":
        if abs(most) >= 90:
            raise LensFileError(f"ANG is {shown(record.words[0])}, expected less than 90 degrees", record.place)
        tangent = math.tan(math.radians(most))
    else:
        tangent = -most / parts.surfaces[0].number("TH", "thickness")
    angles = [math.degrees(math.atan(fraction * tangent)) for fraction in _FRACTIONS]
    angles[-1] = most if record.keyword == "ANG" else angles[-1]
    return "angle", angles if tangent else [0.0]


def _stop(parts: _Sections, report: Draft) -> Place:
    marks = [record for surface in parts.surfaces if (record := surface.last("AST"))]
    if not marks:
        report.note("no AST: surface 1 is the stop")
        return parts.surfaces[1].place
    if len(marks) > 1:
        message = f"a second AST; surface {marks[0].place.surface} is the stop already"
        raise LensFileError(message, marks[1].place)
    return marks[0].place


# -- solves, by the y-nu trace of the axial ray -----------------------------------------------------------------------


def _solved(
    parts: _Sections, surfaces: Sequence[Surface], primary: float, beam: float | None, unit: float, report: Draft
) -> list[Surface]:
    """The surfaces with the results of solves, and a note where the focal length differs from that of the file.

    beam: mm, height of the axial ray on surface 1 where the file gives it; None where only its direction is known,
    which suffices for a height of 0.
    """
    surfaces = list(surfaces)
    n: list[float] = []
    for k in medium_surfaces(surfaces)[:-1]:
        n.append(float(refractive_index(surfaces[k].glass, double(primary))))
        if not n[-1]:
            name = surfaces[k].glass.name or "the medium"
            raise LensFileError(f"{name} has no index at {primary:g} µm", parts.surfaces[k].place)
    n = signed(surfaces[1:-1], n)
    solves = [_solves(commands) for commands in parts.surfaces]
    first = next((record for pair in solves for record in pair if record), None)
    if first and any(map(is_posed, surfaces)):
        message = f"{first.keyword} (a solve) in a lens with tilted or decentred surfaces is not modelled"
        raise UnsupportedSurface(message, first.place)
    distance = float(surfaces[0].thickness)
    y, omega = (beam or 1.0, 0.0) if distance == math.inf else (distance, n[0])
    powers: list[float] = []
    gaps: list[float] = []
    for k in range(1, len(surfaces) - 1):
        slope, height = solves[k]
        if slope:
            curvature = _solved_curvature(slope, n[k - 1], n[k], y, omega, beam)
            surfaces[k] = dataclasses.replace(surfaces[k], curvature=double(curvature))
            report.note(f"surface {k}: PU {slope.words[0]} solved again, curvature {curvature:.9g} in mm")
        powers.append(float(power(surfaces[k], double(n[k - 1]), double(n[k]))))
        if height:
            thickness = _solved_thickness(height, y, ynu(y, omega, powers[-1:], [])[1][1] / n[k], beam, unit)
            surfaces[k] = dataclasses.replace(surfaces[k], thickness=double(thickness))
            report.note(f"surface {k}: PY {height.words[0]} solved again, thickness {thickness:.9g} in mm")
        gaps.append(float(surfaces[k].thickness) / n[k])
        y, omega = ynu(y, omega, powers[-1:], gaps[-1:])[-1]
    omega = ynu(1.0, 0.0, powers, gaps)[-1][1]
    if (stated := _stated(parts)[:1]) and abs(omega / n[-1]) > 1e-12:
        length, focal = number(stated[0], "focal length", parts.head.place) * unit, -n[0] / omega
        if abs(abs(length) - abs(focal)) > 1e-4 * abs(focal):
            message = f"LEN NEW states a focal length of {length:.6g} mm, the lens as read has {focal:.6g}"
            report.note(f"{message}: by glasses of another edition, or the number was typed in")
    return surfaces


def _solves(commands: _Commands) -> tuple[Record | None, Record | None]:
    """PU, for the slope of the axial ray behind the surface, and PY, for its height on the next.

    Raises LensFileError where the number that they solve for is also given.
    """
    solves = commands.last("PU"), commands.last("PY")
    pickups = {record.words[0].upper(): record for record in commands.all("PK") if record.words}
    stated = (
        commands.last("RD", "CV") or pickups.get("CV") or pickups.get("CVM"),
        commands.last("TH") or pickups.get("TH") or pickups.get("THM"),
    )
    for other, solve in zip(stated, solves, strict=True):
        if other and solve:
            message = f"{other.keyword} in line {other.place.line} and {solve.keyword} give the same number twice"
            raise LensFileError(f"{message}; delete one of them", solve.place)
    return solves


def _solved_curvature(
    record: Record, before: float, behind: float, y: float, omega: float, beam: float | None
) -> float:
    slope = record.number(0, "slope of the axial ray")
    if beam is None:
        message = "PU (a solve for the slope of the axial ray) is solved for a beam by EBR only"
        raise UnsupportedSurface(message, record.place)
    if not y * (behind - before):
        raise LensFileError(f"PU {slope:g}: no curvature here refracts the axial ray", record.place)
    return (omega - behind * slope) / (y * (behind - before))


def _solved_thickness(record: Record, y: float, slope: float, beam: float | None, unit: float) -> float:
    height = record.number(0, "height of the axial ray")
    if beam is None and height:
        raise UnsupportedSurface(f"PY {height:g} is solved for a beam by EBR only; PY 0 for any", record.place)
    distance = (height * unit - y) / slope if slope else math.inf
    if abs(distance) > 1e12:
        raise LensFileError(f"PY {height:g}: the axial ray never reaches that height", record.place)
    return distance


# -- a surface --------------------------------------------------------------------------------------------------------

#: Lens units: an object at this distance or beyond is at infinity.
_INFINITE = 1e8

#: Aspheric terms by their power of r.
_TERMS = {"AD": 4, "AE": 6, "AF": 8, "AG": 10}

#: No medium has an index beyond these.
_SMALLEST, _LARGEST = 0.1, 6.0


def _surface(
    commands: _Commands,
    before: Sequence[Surface],
    blocks: Sequence[_Commands],
    unit: float,
    user: Sequence[Path],
    report: Draft,
) -> Surface:
    """The surface of its commands, in mm; solved quantities are 0. before: the surfaces that it may pick up from."""
    note = commands.last("NOT")
    radius, apertures = _aperture(commands, unit)
    picked = _picked_up(commands, before, blocks, unit, report)
    terms = [commands.number(word, f"coefficient of r^{p}") / unit ** (p - 1) for word, p in _TERMS.items()]
    shape: dict[str, Any] = {
        "thickness": double(_thickness(commands, unit)),
        "curvature": nonzero(_curvature(commands) / unit),
        "conic": nonzero(commands.number("CC", "conic constant")),
        "coefficients": double([0.0, *terms]) if any(terms) else None,
        "glass": picked["glass"] if "glass" in picked else _medium(commands, user, report),
    }
    return Surface(
        semi_diameter=radius,
        apertures=apertures,
        comment=" ".join(note.words) if note else "",
        **(shape | picked),
        **_poses(commands, unit),
    )


def _curvature(commands: _Commands) -> float:
    """In 1/units: of RD, where 0 is a plane, or CV."""
    radius, curvature = commands.last("RD"), commands.last("CV")
    if radius and curvature:
        raise LensFileError(f"CV, but RD in line {radius.place.line} gives the radius", curvature.place)
    if curvature:
        return curvature.number(0, "curvature")
    length = commands.number("RD", "radius of curvature")
    return 1 / length if length else 0.0


def _thickness(commands: _Commands, unit: float) -> float:
    distance = commands.number("TH", "thickness")
    if commands.place.surface == 0 and distance >= _INFINITE:
        return math.inf
    if abs(distance) >= _INFINITE:
        raise LensFileError(f"TH is {distance:g}; only the object may be at infinity", commands.place_of("TH"))
    return distance * unit


def _aperture(commands: _Commands, unit: float) -> tuple[float | None, tuple[Aperture, ...]]:
    """AP r is a semi-diameter, AP CHK r also clips rays; 0 is left to the program. That of the object is its field."""
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


def _poses(commands: _Commands, unit: float) -> dict[str, Any]:
    """The poses `before` and `after` of a surface, if any. Raises LensFileError, UnsupportedSurface."""
    moved = {word: value for word in _POSES if (value := commands.number(word, "tilt or decentre"))}
    bend, back = commands.last("BEN"), commands.last("RCO")
    for record in filter(None, (bend, back)):
        if record.words:
            raise UnsupportedSurface(f"{record.keyword} {record.words[0]} is not modelled, but alone", record.place)
    if not moved:
        return {}
    if commands.place.surface == 0:
        word = next(iter(moved))
        message = f"{word} (a tilted or decentred object) is not modelled"
        raise UnsupportedSurface(message, commands.place_of(word))
    order = commands.integer("DT", "order of tilts and decentres", 1)
    if order not in (1, -1):
        message = f"DT is {order}, expected 1 (decentre, then tilt) or -1"
        raise LensFileError(message, commands.place_of("DT"))
    signs = {word: sign * (unit if word[0] == "D" else 1.0) for word, (_, sign) in _POSES.items()}
    numbers = {_POSES[word][0]: signs[word] * value for word, value in moved.items()}
    if bend:
        mirror = commands.last("RFL", "RFH")
        if back or mirror is None or len(moved) != 1 or next(iter(moved)) not in ("TLA", "TLB"):
            message = "BEN is modelled on a mirror that is tilted by TLA or by TLB alone, and without RCO"
            raise UnsupportedSurface(message, bend.place)
    axes = BENT if bend else RETURNED if back else ONWARD
    return dict(zip(("before", "after"), poses_of(numbers, axes, tilts_first=order == -1), strict=True))


#: Pickups: the sign of the number, and the commands of the same quantity.
_PICKUPS = {
    "GLA": (1.0, ("AIR", "GLA", "RFL", "RFH")),
    "CV": (1.0, ("RD", "CV", "CC", *_TERMS)),
    "CVM": (-1.0, ("RD", "CV", "CC", *_TERMS)),
    "TH": (1.0, ("TH",)),
    "THM": (-1.0, ("TH",)),
}

#: The solve for the number of a command.
_SOLVES = {"RD": "PU", "TH": "PY"}


def _picked_up(
    commands: _Commands, before: Sequence[Surface], blocks: Sequence[_Commands], unit: float, report: Draft
) -> dict[str, Any]:
    """The fields of a surface that are picked up from an earlier one. Raises LensFileError and UnsupportedSurface."""
    fields: dict[str, Any] = {}
    for record in commands.all("PK"):
        kind = record.words[0].upper() if record.words else ""
        if kind not in _PICKUPS or len(record.words) not in (2, 2 + (kind != "GLA")):
            message = f"PK {shown(' '.join(record.words))} (a pickup) is not modelled, but of {', '.join(_PICKUPS)}"
            raise UnsupportedSurface(message, record.place)
        back = -record.integer(1, "surface to pick up from")
        if not 0 < back <= len(before):
            message = f"PK {kind} {record.words[1]}: expected how many surfaces before this one, as -2"
            raise UnsupportedSurface(message, record.place)
        sign, instead = _PICKUPS[kind]
        source, surface = len(before) - back, before[-back]
        _refuse_other_sources(record, instead, commands, blocks[source])
        added = record.number(2, "number to add", 0.0)
        if kind == "GLA":
            if surface.is_mirror:
                message = f"PK GLA {record.words[1]} picks up a mirror, which is not modelled"
                raise UnsupportedSurface(message, record.place)
            fields["glass"] = surface.glass
            report.glass(record.place, surface.glass.name, f"that of surface {source}")
        elif kind in ("TH", "THM"):
            fields["thickness"] = double(sign * float(surface.thickness) + added * unit)
        else:  # with the curvature the conic and the terms that belong to it
            curvature = sign * (0.0 if surface.curvature is None else float(surface.curvature)) + added / unit
            terms = None if surface.coefficients is None else sign * surface.coefficients
            fields |= {"curvature": nonzero(curvature), "conic": surface.conic, "coefficients": terms}
    return fields


def _refuse_other_sources(record: Record, instead: Sequence[str], commands: _Commands, source: _Commands) -> None:
    """Raise where a picked-up number is also given, or is itself solved for."""
    pickup = " ".join(record.words[:2])
    for word in instead:
        if other := commands.last(word):
            message = f"{word} in line {other.place.line} and PK {pickup} give the same number twice"
            raise LensFileError(f"{message}; delete one of them", record.place)
        if word in _SOLVES and source.last(_SOLVES[word]):
            raise UnsupportedSurface(f"PK {pickup} of a number that is solved for there is not modelled", record.place)


def _medium(commands: _Commands, user: Sequence[Path], report: Draft) -> Glass:
    """AIR, RFL and RFH (a mirror) or GLA, by name or by indices: the last of them; air where there is none.

    Indices are at the wavelengths in force: GLA n…, GLA name n…, GLA MOD name n…
    """
    records = commands.all("AIR", "RFL", "RFH", "GLA")
    if not records or records[-1].keyword == "AIR":
        return AIR
    record = records[-1]
    if record.keyword in ("RFL", "RFH"):
        return MIRROR
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
    if len(set(indices)) == 1:
        report.glass(place, name, f"constant index {indices[0]!r}")
        return constant(indices[0], name)
    waves = commands.wavelengths[: len(indices)]
    if len(indices) > len(waves):
        raise LensFileError(f"{len(indices)} indices for {len(waves)} wavelengths", place)
    figures = f"indices {', '.join(map(repr, indices))} at {', '.join(map(repr, waves))} µm"
    report.glass(place, name, figures)
    try:
        return from_table(waves, indices, name=name)
    except ValueError as error:
        raise LensFileError(f"GLA: {error}", place) from error
