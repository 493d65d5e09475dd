"""The commands of an OSLO lens file (.len), and its text sorted by them: system, surfaces, lines after END.

A lens file is a list of commands: LEN NEW begins a lens, NXT begins the next surface, END ends the lens. Commands of
the system precede the data of the first surface and follow those of the last.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

from raytrace.io.report import IGNORED, READ, UNKNOWN, Draft
from raytrace.io.source import (
    MAX_SURFACES,
    Block,
    LensFileError,
    Place,
    Record,
    UnsupportedSurface,
    shown,
    warn_of_repeats,
)


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


def _rows(rows: dict[str, str]) -> dict[str, str]:
    return {word: text for text, words in rows.items() for word in words.split()}


#: Commands of the system that are read; WV2, WW2, SNO1, … count as WV, WW, SNO.
_SYSTEM_READ = _words("LEN UNI EBR FNO NAO ANG OBH WV WW SNO NXT END")
_SYSTEM_IGNORED = _rows(
    {
        "name of the designer; not carried": "DES",
        "setting of the program, independent of the lens": "CBK CALLBACK GPRT DLRS",
    }
)
_SYSTEM_REFUSED = _rows(
    {
        "the size of the beam by its image side": "NAP PUK",
        "the field by its Gaussian image height": "GIH",
        "a jump between surfaces": "GTO",
    }
)
#: Switches of the system that change the trace, unless they are off.
_OFF = ("OFF", "0", "NO")
_SWITCHES = {"TELE": "telecentric object space", "WARM": "wide-angle ray aiming", "AFO": "afocal image space"}

#: Numbers that tilt or decentre a surface.
POSE_NUMBERS = ("DCX", "DCY", "DCZ", "TLA", "TLB", "TLC")

_SURFACE_READ = _words("AIR GLA RFL RFH RD CV TH CC AD AE AF AG AP AST PK PU PY NOT DT BEN RCO") | {*POSE_NUMBERS}
_SURFACE_IGNORED = _rows(
    {
        "how the program draws it": "DRW LDP BDI BDD VX PF",
        "coefficient of thermal expansion": "TCE",
        "name of an element": "LMN LME ELMDF1 ELMDF2",
    }
)
#: Commands of features that are not modelled, and their names.
_SURFACE_REFUSED = _rows(
    {
        "axes of its own": "GC",
        "a general asphere": "ASP",
        "a toroid": "CVX RDX",
        "a perfect lens, which obeys the sine condition": "PFL PFM",
        "a grating": "GSP GOR",
        "special apertures": "APN ATP AAC AAN AX1 AX2 AY1 AY2",
        "a solve by chief ray or by edge": "PUC PYC EC",
    }
)
#: The point that a tilt is about, unless it is the vertex.
_PIVOTS = _words("TOX TOY TOZ")

TAIL_REASON = "after END: variables, operands, fields of analyses or configurations, not part of the lens"

#: µm: the wavelengths of a lens that states none.
DEFAULT_WAVELENGTHS = (0.58756, 0.48613, 0.65627)

_TOKEN = re.compile(r'"((?:[^"\\]|\\.)*)"?|(//.*)|(;)|([^\s,;"/]+|/)')
_NUMBERED = re.compile(r"(WV|WW|SNO)([1-9][0-9]{0,2})")


class Commands(Block):
    """The commands of one surface, and the wavelengths in force where its medium is defined, µm."""

    def __init__(self, place: Place):
        super().__init__(place)
        self.wavelengths: tuple[float, ...] = ()


class Sections(NamedTuple):
    """A file sorted: its LEN command, the system, the surfaces, and the wavelengths of the lens, if specified."""

    head: Record
    system: Block
    surfaces: list[Commands]
    wavelengths: list[float]


def commands(text: str, file: str) -> Iterator[Record]:
    """The commands of a text: one a line, or several between semicolons; words between blanks, commas or quotes."""
    for line_number, line in enumerate(text.split("\n"), 1):
        words: list[str] = []
        for quoted, comment, end, word in _TOKEN.findall(f"{line};"):
            if comment or end:
                if words:
                    yield Record(words[0].upper(), tuple(words[1:]), "", Place(file, line_number), False)
                words = []
            else:
                words.append(word or quoted.replace('\\"', '"').replace("\\\\", "\\"))
        if words:
            yield Record(words[0].upper(), tuple(words[1:]), "", Place(file, line_number), False)


def sections(text: str, file: str, report: Draft) -> Sections:
    """The commands of the first lens of a text, each of them reported. Raises LensFileError and UnsupportedSurface."""
    records = list(commands(text, file))
    if not records or records[0].keyword != "LEN" or [word.upper() for word in records[0].words[:1]] != ["NEW"]:
        place = records[0].place if records else Place(file)
        raise LensFileError("expected LEN NEW at the beginning; is it a lens file of OSLO (.len)?", place)
    system, waves, ended = Block(Place(file)), Wavelengths(), False
    surfaces = [Commands(records[0].place._replace(surface=0))]
    end = next((k for k, record in enumerate(records) if record.keyword == "END"), len(records))
    last = sum(record.keyword == "NXT" for record in records[:end])
    for record in records:
        if ended:
            word = record.keyword[:40]
            if word in ("LEN", "CFG"):
                kind = "another lens" if word == "LEN" else "further configurations"
                report.warn(f"{word} ({kind}) after END: the lens before it is read, unchanged", record.place)
            report.met(word, IGNORED, record.place, TAIL_REASON)
            continue
        ended = record.keyword == "END"
        if record.keyword == "NXT":
            if len(surfaces) >= MAX_SURFACES:
                message = f"more than {MAX_SURFACES} surfaces; no sequential lens has so many"
                raise LensFileError(message, record.place)
            surfaces.append(Commands(record.place._replace(surface=len(surfaces))))
        _sort(record, system, surfaces[-1], waves, report, len(surfaces) - 1 in (0, last))
    if not ended:
        message = f"no END after {len(surfaces)} surfaces; file cut off?"
        raise LensFileError(message, records[-1].place)
    warn_of_repeats(surfaces, lambda word: word != "PK", report)
    return Sections(records[0], system, surfaces, waves.lens)


class Wavelengths:
    """The wavelengths as the commands of a file change them: WV lists them from the first on, WV2 sets the second."""

    def __init__(self):
        self.slots = dict(enumerate(DEFAULT_WAVELENGTHS, 1))
        self.lens: list[float] = []

    def set(self, record: Record, number: int | None) -> None:
        values = [record.number(k, "wavelength") for k in range(len(record.words))]
        if not values or (number and len(values) > 1):
            raise LensFileError(f"{record.keyword} has {len(values)} values, expected one or more", record.place)
        self.slots |= dict(enumerate(values, number or 1))
        if number is None:
            self.lens = values
            return
        self.lens = self.lens or list(DEFAULT_WAVELENGTHS)
        if number > len(self.lens) + 1:
            raise LensFileError(f"{record.keyword}, but {len(self.lens)} wavelengths precede it", record.place)
        self.lens[number - 1 : number] = values

    def in_force(self) -> tuple[float, ...]:
        """The first wavelengths, up to the first that was never set."""
        count = next(k for k in range(1, len(self.slots) + 2) if k not in self.slots) - 1
        return tuple(self.slots[k] for k in range(1, count + 1))


def _sort(record: Record, system: Block, surface: Commands, waves: Wavelengths, report: Draft, at_end: bool) -> None:
    """One command into the system or a surface; at_end: of the object or the image, or of the system."""
    numbered = _NUMBERED.fullmatch(record.keyword)
    word, number = (numbered[1], int(numbered[2])) if numbered else (record.keyword, None)
    of_surface = record._replace(place=record.place._replace(surface=surface.place.surface))
    if word == "WV":
        waves.set(record, number)
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
    else:
        _beyond(of_surface, record, report, at_end)


def _beyond(of_surface: Record, record: Record, report: Draft, at_end: bool) -> None:
    """A command that is not read: left out where it changes nothing, else refused."""
    word = record.keyword
    if word in _SYSTEM_REFUSED:
        raise UnsupportedSurface(f"{word} ({_SYSTEM_REFUSED[word]}) is not modelled", record.place)
    if word in _SWITCHES:
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
    elif word in _SURFACE_REFUSED or word == "LMO" or re.fullmatch(r"AS\d+", word):
        feature = _SURFACE_REFUSED.get(word, "a group that is not sequential" if word == "LMO" else "a general asphere")
        raise UnsupportedSurface(f"{word} ({feature}) is not modelled", of_surface.place)
    elif at_end:
        report.met(word[:40], UNKNOWN, record.place)
    else:
        message = f"the command {shown(word)} is not known, and may change how light passes the surface"
        raise UnsupportedSurface(f"{message}; take it out where it does not", of_surface.place)
