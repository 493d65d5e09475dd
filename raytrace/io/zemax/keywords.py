"""The keywords of a .zmx file, and its text sorted by them: the system, the surfaces, and the lines after them."""

import re
from collections.abc import Iterator
from typing import NamedTuple

from raytrace.io.report import IGNORED, READ, UNKNOWN, Draft
from raytrace.io.source import MAX_SURFACES, Block, LensFileError, Place, Record, shown, warn_of_repeats
from raytrace.system.apertures import SHAPES


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


#: Keywords of the system and of a surface that are read; apertures have theirs in `apertures.SHAPES`.
SYSTEM_READ = _words(
    "VERS MODE NAME NOTE UNIT GCAT ENVD GFAC RAIM FTYP PWAV MNUM ENPD FNUM OBNA FLOA XFLN YFLN FWGN XFLD YFLD FWGT"
    " FEFD SDMA VDXN VDYN VCXN VCYN VANN ZVDX ZVDY ZVCX ZVCY ZVAN VDX VDY VCX VCY VAN WAVM WAVL WAVN WWGT WWGN"
)
_SURFACE_READ = _words(
    "SURF TYPE CURV CONI DISZ GLAS DIAM STOP PARM COMM OBDC USAP USOB UDAD SCBD IGNR XDAT VCON VDSZ VPAR PPAR PZUP"
    " MAZH TOLE EDGE"
)

#: Keywords that may occur more than once in the system or in one surface.
_REPEATED = ("NOTE", "WAVM", "FEFD", "PARM", "UDAD", "XDAT", "PPAR", "VPAR", "SCBD")


def _by_word(rows: dict[str, str]) -> dict[str, str]:
    return {word: reason for reason, words in rows.items() for word in words.split()}


#: Keywords that are known and left out, with the reason.
SYSTEM_IGNORED = _by_word(
    {
        "setting of the program, independent of the lens": "PFIL LANG HYPR ROPD PICB EERA LUID IWDP STUD FSVY",
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
SURFACE_IGNORED = _by_word(
    {
        "setting of the program, independent of the lens": "FIMP",
        "how the program draws it": "HIDE SCOL",
        "substrate of a mirror, for drawing": "MIRR",
        "label for the program's macros": "SLAB SSID",
        "sampling of wave propagation": "POPS",
        "mechanical semi-diameter: for drawing and mounting, never clips a ray": "MEMA",
        "edge of the mechanical part": "OEMA",
        "coatings refract no rays": "COAT",
        "coefficient of thermal expansion": "TCED",
    }
)
TAIL_REASON = "behind the surfaces, and no line of a merit function, of tolerances or of configurations"

#: Types of surface that are not modelled, by OpticStudio's names; those that are, are rows of `surfaces.TYPES`.
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

#: Kind of field by the number of FTYP, and names of kinds that are not modelled.
FIELD_KINDS = ("angle", "object_height", "paraxial_image_height", "real_image_height")
FIELD_NAMES = {4: "theodolite angle"}


class FieldList(NamedTuple):
    """A list with a number for each field point: its keywords, the first of which is written; default; quantity."""

    keywords: tuple[str, ...]
    default: float
    quantity: str


FIELD_LISTS = {
    "x": FieldList(("XFLN", "XFLD"), 0.0, "field"),
    "y": FieldList(("YFLN", "YFLD"), 0.0, "field"),
    "weight": FieldList(("FWGN", "FWGT"), 1.0, "weight of a field"),
    **{
        name: FieldList((f"{name}N", f"Z{name}", name), 0.0, "vignetting factor")
        for name in ("VDX", "VDY", "VCX", "VCY", "VAN")
    },
}

#: The lists hold so many fields; an FEFD line holds a number of every list for each further field.
FIELDS_IN_LISTS = 12

#: Ray aiming by the second number of RAIM; a file without RAIM specifies none.
AIMINGS = ("off", "paraxial", "real")

#: OpticStudio splits a long note into lines of this many characters.
NOTE_PIECE = 200


def aperture_keywords() -> dict[str, tuple[str, bool]]:
    """Shape of an aperture, and whether it obscures, by keyword; FLAP follows the semi-diameter."""
    rows = {keyword: (name, bool(k)) for name, shape in SHAPES.items() for k, keyword in enumerate(shape.zemax)}
    return {"FLAP": ("circular", False), **rows}


#: In place of the name in a GLAS line: the medium is a model glass, or that of another surface.
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
    """A file sorted: the system, one block per surface, and the lines after them, multi-configuration operands last."""

    system: Block
    surfaces: list[Block]
    tail: list[Record]


def records(text: str, file: str) -> Iterator[Record]:
    """The lines of a text that are not blank."""
    for line_number, line in enumerate(text.split("\n"), 1):
        content = line.strip()
        if content:
            keyword = content.split(None if "\t" in content else " ", 1)[0]
            raw, words = line.lstrip()[len(keyword) + 1 :], content[len(keyword) :].split()
            yield Record(keyword, tuple(words), raw, Place(file, line_number), line[0] in " \t")


def sections(text: str, file: str, report: Draft) -> Sections:
    """The records sorted by the keyword tables, each of them reported.

    A surface's records are indented in files of OpticStudio; in files that lost the indentation the keyword decides.
    The merit function, tolerances and configurations after the last surface are reported by their readers.
    """
    lines, surface_read = list(records(text, file)), _SURFACE_READ | aperture_keywords().keys()
    start = next((position for position, record in enumerate(lines, 1) if record.keyword == "SURF"), None)
    if start is None:
        hint = "is it a sequential lens file of OpticStudio (.zmx)?"
        raise LensFileError(f"no SURF line in {len(lines)} lines; {hint}", Place(file))
    system, surfaces, tail = Block(Place(file)), [], []
    indents = any(record.indented for record in lines[start:])
    block, after_surfaces = system, False
    for record in lines:
        word = record.keyword
        if word == "SURF":
            if len(surfaces) >= MAX_SURFACES:
                message = f"more than {MAX_SURFACES} surfaces; no sequential lens has so many"
                raise LensFileError(message, record.place)
            if record.integer(0, "surface number") != len(surfaces):
                message = f"SURF {shown(record.words[0])} where surface {len(surfaces)} should follow"
                raise LensFileError(f"{message}; lines lost or reordered?", record.place)
            block, after_surfaces = Block(record.place._replace(surface=len(surfaces))), False
            surfaces.append(block)
            report.met("SURF", READ, block.place)
        elif block is not system and (record.indented if indents else word in surface_read or word in SURFACE_IGNORED):
            record = record._replace(place=record.place._replace(surface=block.place.surface))
            _sort(record, block, surface_read, SURFACE_IGNORED, report)
        elif word not in SYSTEM_READ and (after_surfaces or (surfaces and word not in SYSTEM_IGNORED)):
            block, after_surfaces = system, True
            tail.append(record)
        else:
            block = system
            _sort(record, system, SYSTEM_READ, SYSTEM_IGNORED, report)
    once = (SYSTEM_READ | surface_read) - {*_REPEATED}
    warn_of_repeats([system, *surfaces], once.__contains__, report)
    _join_fields(system)
    return Sections(system, surfaces, tail)


def _sort(record: Record, block: Block, read: frozenset[str], ignored: dict[str, str], report: Draft) -> None:
    word = record.keyword
    if word not in read and word not in ignored:
        report.met(word[:40], UNKNOWN, record.place)
        return
    block.records.setdefault(word, []).append(record)
    report.met(word, READ if word in read else IGNORED, record.place, ignored.get(word, ""))


def _join_fields(system: Block) -> None:
    """Append the fields beyond the twelfth (FEFD) to the lists; each list has a number in every FEFD line."""
    further = system.all("FEFD")
    for position, (keywords, default, quantity) in enumerate(FIELD_LISTS.values()) if further else ():
        record = system.last(*keywords) or Record(keywords[0], (), "", further[0].place)
        words = [*record.words[:FIELDS_IN_LISTS]]
        words += [repr(default)] * (FIELDS_IN_LISTS - len(words))
        for line in further:
            line.number(position, quantity)
            words.append(line.words[position])
        system.records[record.keyword] = [record._replace(words=tuple(words))]
