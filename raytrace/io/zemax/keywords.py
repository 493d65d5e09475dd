"""The keywords of a .zmx file, a row each, and a text sorted by them: the system, the surfaces, what follows them."""

import re
from collections.abc import Iterator
from typing import NamedTuple

from raytrace.io.report import IGNORED, READ, UNKNOWN, Draft
from raytrace.io.source import MAX_SURFACES, LensFileError, Place, shown
from raytrace.io.spelling import integer, number
from raytrace.system.apertures import SHAPES


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


#: Keywords of the system and of a surface that are read; an aperture's are in the rows of `aperture.SHAPES`.
SYSTEM_READ = _words(
    "VERS MODE NAME NOTE UNIT GCAT ENVD GFAC RAIM FTYP PWAV MNUM ENPD FNUM OBNA FLOA XFLN YFLN FWGN XFLD YFLD FWGT"
    " FEFD SDMA VDXN VDYN VCXN VCYN VANN ZVDX ZVDY ZVCX ZVCY ZVAN VDX VDY VCX VCY VAN WAVM WAVL WAVN WWGT WWGN"
)
_SURFACE_READ = _words(
    "SURF TYPE CURV CONI DISZ GLAS DIAM STOP PARM COMM FLAP OBDC USAP USOB UDAD SCBD IGNR XDAT VCON VDSZ VPAR PPAR PZUP"
    " MAZH TOLE EDGE"
)

#: Keywords that may stand more than once in the system or in one surface.
REPEATED = ("NOTE", "WAVM", "FEFD", "PARM", "UDAD", "XDAT", "PPAR", "VPAR", "SCBD")


def _left_out(rows: dict[str, str]) -> dict[str, str]:
    return {word: reason for reason, words in rows.items() for word in words.split()}


#: Keywords that are known and left out, with the reason.
SYSTEM_IGNORED = _left_out(
    {
        "setting of the program, says nothing about the lens": "PFIL LANG HYPR ROPD PICB EERA LUID IWDP STUD FSVY",
        "how mechanical semi-diameters are recomputed": "OMMA",
        "shift of the pupil for the program's own ray aiming": "PUSH",
        "global coordinate reference: changes no ray": "GLRS",
        "default tolerances and glass substitution": "GSTD",
        "settings of non-sequential mode": "NSCD",
        "names of coating and scatter files": "COFN",
        "polarisation": "POLS",
        "author; not carried": "AUTH",
        "comment on a field point; not carried": "FCOM",
        "entry of the vendor's catalog": "DBDT",
        "checksum of the program": "CSUM",
        "number of fields, which FTYP states": "FENF",
    }
)
SURFACE_IGNORED = _left_out(
    {
        "setting of the program, says nothing about the lens": "FIMP",
        "how the program draws it": "HIDE SCOL",
        "substrate of a mirror, for drawing": "MIRR",
        "label for the program's macros": "SLAB SSID",
        "sampling of wave propagation": "POPS",
        "mechanical semi-diameter: for drawing and mounting, never clips a ray": "MEMA",
        "edge of the mechanical part": "OEMA",
        "coatings do not bend rays": "COAT",
        "coefficient of thermal expansion": "TCED",
    }
)

#: What follows the last surface belongs to these, and not to the lens.
TAIL_REASON = "behind the surfaces, and no line of a merit function, of tolerances or of configurations"

#: Types of surface that are not modelled, by what OpticStudio calls them; those that are, are rows of `zemax_types`.
_TYPES = (
    "EGRATING elliptical grating, XOSPHERE extended odd asphere, ZERNSAG Zernike sag, "
    "SZERNSAG Zernike standard sag, SZERNPHA Zernike standard phase, POLYNOMI polynomial, BINARY_3 binary 3, "
    "BINARY_4 binary 4, QED_TYPE Q-type asphere, CFRESNEL cylindrical Fresnel, GRINSUR1 gradient index 1, "
    "GRINSUR5 gradient index 5, GRADIUM gradient index, HOLOGRM1 hologram 1, CONJUGAT conjugate, "
    "RETROREF retro-reflector, ATMOSPHR atmospheric, GRIDSAG grid sag, GRID_SAG grid sag, ALTERNAT alternate, "
    "QTYPE Q-type asphere, NONSEQCO non-sequential component, USERSURF user-defined (DLL), "
    "BIREFR_I birefringent in, BIREFR_O birefringent out, BICONIC biconic, CUBICSPL cubic spline, DATASURF data, "
    "BLACKBOX black box"
)
TYPE_NAMES = dict(name.split(" ", 1) for name in _TYPES.split(", "))

#: System apertures: keyword, and the number after the size if it has one.
SYSTEM_APERTURES = {
    "entrance_pupil_diameter": ("ENPD", None),
    "image_f_number": ("FNUM", 0),
    "paraxial_working_f_number": ("FNUM", 1),
    "object_na": ("OBNA", 0),
    "object_cone_angle": ("OBNA", 1),
    "float_by_stop": ("FLOA", None),
}

#: Kind of field by the number of FTYP, and back.
FIELD_KINDS = ("angle", "object_height", "paraxial_image_height", "real_image_height")
FIELD_NAMES = {4: "theodolite angle"}


class FieldList(NamedTuple):
    """Numbers a field point each: keywords, the first of which is written; what a missing one is; and what it is."""

    keywords: tuple[str, ...]
    default: float
    what: str


FIELD_LISTS = {
    "x": FieldList(("XFLN", "XFLD"), 0.0, "field"),
    "y": FieldList(("YFLN", "YFLD"), 0.0, "field"),
    "weight": FieldList(("FWGN", "FWGT"), 1.0, "weight of a field"),
    **{
        name: FieldList((f"{name}N", f"Z{name}", name), 0.0, "vignetting factor")
        for name in ("VDX", "VDY", "VCX", "VCY", "VAN")
    },
}

#: The lists of fields hold this many; a FEFD line holds a number of every list for each further field.
FIELDS_IN_LISTS = 12
#: Ray aiming by the second number of RAIM; a file without RAIM specifies none.
AIMINGS = ("off", "paraxial", "real")

#: OpticStudio cuts a long note into pieces of this many characters.
NOTE_PIECE = 200


def aperture_keywords() -> dict[str, tuple[str, bool]]:
    """Shape of an aperture, and whether it obscures, by keyword; FLAP floats by the semi-diameter."""
    rows = {keyword: (name, bool(k)) for name, shape in SHAPES.items() for k, keyword in enumerate(shape.zemax)}
    return {"FLAP": ("circular", False), **rows}


def surface_read() -> frozenset[str]:
    """Keywords of a surface that are read."""
    return _SURFACE_READ | aperture_keywords().keys()


# -- records --------------------------------------------------------------------------------------------------------


class Record(NamedTuple):
    """One line: its keyword, the words after it, and the raw text after the keyword and one space."""

    keyword: str
    words: tuple[str, ...]
    text: str
    place: Place
    indented: bool

    def number(self, position: int, what: str, default: float | None = None) -> float:
        """The finite number at a position (0 is the first after the keyword), or `default` where the line ends."""
        if position < len(self.words):
            return number(self.words[position], f"{self.keyword}: {what}", self.place)
        if default is None:
            raise LensFileError(f"{self.keyword} has {len(self.words)} values; {what} is missing", self.place)
        return default

    def integer(self, position: int, what: str, default: int | None = None) -> int:
        """The whole number at a position, or `default` where the line ends."""
        if position >= len(self.words) and default is not None:
            return default
        self.number(position, what)
        return integer(self.words[position], f"{self.keyword}: {what}", self.place)


class Block:
    """The records of the system or of one surface, by keyword."""

    def __init__(self, place: Place):
        self.place = place
        self.records: dict[str, list[Record]] = {}

    def all(self, *keywords: str) -> list[Record]:
        """Every record of these keywords, in the order of the file."""
        found = [record for keyword in keywords for record in self.records.get(keyword, ())]
        return sorted(found, key=lambda record: record.place.line)

    def last(self, *keywords: str) -> Record | None:
        """The last record of the first of these keywords that is there."""
        for keyword in keywords:
            if keyword in self.records:
                return self.records[keyword][-1]
        return None


#: The name of a glass that a GLAS line leaves out: the medium is a model glass, or that of another surface.
BLANK = "___BLANK"


def is_blank(record: Record) -> bool:
    """True for a GLAS line without the name of a glass."""
    return record.words[:1] != () and record.words[0].upper() == BLANK


def glass_source(block: Block) -> int | None:
    """The number of the earlier surface whose medium is picked up: GLAS name 2 surface; None without a pickup."""
    record = block.last("GLAS")
    if not record or len(record.words) < 3 or record.words[1] != "2" or not re.fullmatch("[0-9]{1,6}", record.words[2]):
        return None
    source = int(record.words[2])
    return source if source < block.place.surface else None


class Sections(NamedTuple):
    """A file sorted: the system, one block per surface, and what follows them, multi-configuration operands last."""

    system: Block
    surfaces: list[Block]
    tail: list[Record]


def records(text: str, file: str) -> Iterator[Record]:
    """The lines of a text that hold something."""
    for line_number, line in enumerate(text.split("\n"), 1):
        held = line.strip()
        if held:
            keyword = held.split(None if "\t" in held else " ", 1)[0]
            raw, words = line.lstrip()[len(keyword) + 1 :], held[len(keyword) :].split()
            yield Record(keyword, tuple(words), raw, Place(file, line_number), line[0] in " \t")


def sections(text: str, file: str, report: Draft) -> Sections:
    """The records sorted by the keyword tables, each of them reported.

    A surface's records are indented in files of OpticStudio; in files that lost the indentation the keyword decides.
    After the last surface come merit function, tolerances and configurations, whose operands have names of their own;
    they are left to be reported by who reads them.
    """
    found, of_surface = list(records(text, file)), surface_read()
    start = next((position for position, record in enumerate(found, 1) if record.keyword == "SURF"), None)
    if start is None:
        hint = "is it a sequential lens file of OpticStudio (.zmx)?"
        raise LensFileError(f"no SURF line in {len(found)} lines; {hint}", Place(file))
    system, surfaces, tail = Block(Place(file)), [], []
    indents = any(record.indented for record in found[start:])
    block, after_surfaces = system, False
    for record in found:
        word = record.keyword
        if word == "SURF":
            block, after_surfaces = _next_surface(record, surfaces), False
            surfaces.append(block)
            report.met("SURF", READ, block.place)
        elif block is not system and (record.indented if indents else word in of_surface or word in SURFACE_IGNORED):
            record = record._replace(place=record.place._replace(surface=block.place.surface))
            _classify(record, block, of_surface, SURFACE_IGNORED, report)
        elif word not in SYSTEM_READ and (after_surfaces or (surfaces and word not in SYSTEM_IGNORED)):
            block, after_surfaces = system, True
            tail.append(record)
        else:
            block = system
            _classify(record, system, SYSTEM_READ, SYSTEM_IGNORED, report)
    _warn_of_repeats([system, *surfaces], report)
    _join_fields(system)
    return Sections(system, surfaces, tail)


def _join_fields(system: Block) -> None:
    """Put the fields beyond the twelfth (FEFD) behind those of the lists, each of which has a number in its line."""
    further = system.all("FEFD")
    for position, (keywords, default, what) in enumerate(FIELD_LISTS.values()) if further else ():
        record = system.last(*keywords) or Record(keywords[0], (), "", further[0].place, False)
        words = [*record.words[:FIELDS_IN_LISTS]]
        words += [repr(default)] * (FIELDS_IN_LISTS - len(words))
        for one in further:
            one.number(position, what)
            words.append(one.words[position])
        system.records[record.keyword] = [record._replace(words=tuple(words))]


def _next_surface(record: Record, surfaces: list[Block]) -> Block:
    place = record.place
    if len(surfaces) >= MAX_SURFACES:
        raise LensFileError(f"more than {MAX_SURFACES} surfaces; no sequential lens has so many", place)
    found = record.integer(0, "surface number")
    if found != len(surfaces):
        message = f"SURF {shown(record.words[0])} where surface {len(surfaces)} should follow; lines lost or reordered?"
        raise LensFileError(message, place)
    return Block(place._replace(surface=found))


def _classify(record: Record, block: Block, read: frozenset[str], ignored: dict[str, str], report: Draft) -> None:
    status = READ if record.keyword in read else IGNORED if record.keyword in ignored else UNKNOWN
    if status != UNKNOWN:
        block.records.setdefault(record.keyword, []).append(record)
    report.met(
        record.keyword[: 40 if status == UNKNOWN else None], status, record.place, ignored.get(record.keyword, "")
    )


def _warn_of_repeats(blocks: list[Block], report: Draft) -> None:
    once = (SYSTEM_READ | surface_read()) - {*REPEATED}
    for block in blocks:
        for keyword, found in block.records.items():
            if len(found) > 1 and keyword in once:
                first = found[0].place.line
                report.warn(f"{keyword} stands again (first in line {first}); the last is used", found[-1].place)
