"""The multi-configuration operands of a .zmx file, a row each, and the records of a file with one of them applied.

    THIC   6   2 -2.0E+001 0 0 0 2 2 1.0E+000 0.0E+000 0

An operand tells its surface (field, wavelength), the configuration, the value, how the value is solved, and its second
argument, which is the number of the parameter for PRAM; then what a pickup from another configuration needs, whose
result is the value. An operand puts a word into a record, as if the file had been saved in that configuration, so that
every type of surface reads it; pickups of the surfaces are followed.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

from raytrace.io.source import LensFileError, shown
from raytrace.io.spelling import is_infinite, is_number, plain
from raytrace.io.zemax.keywords import FIELD_LISTS, Block, Record, Sections, aperture_keywords, glass_source, is_blank

#: Stands for the temperature or the pressure of a surface where it is the lens's.
UNTOLD = "-"

#: At this distance an operand has the object at infinity.
FAR = 1e10


class Row(NamedTuple):
    """What an operand of one name changes.

    of: whose number its first argument is: "surface", "field", "wavelength" or "" of the system.
    keyword, position: the record and the word of it that the value is; a keyword that ends in # is one of several
        numbered records, and a position of None is counted by the argument.
    path: of a value that is not a number, where the lens has it, or its surface if of one.
    bends: whether the paraxial rays of other surfaces depend on it, and with them what is solved for there.
    """

    of: str
    keyword: str
    position: int | None = 0
    path: str = ""
    bends: bool = False


def _list(name: str) -> str:
    return FIELD_LISTS[name].keywords[0]


#: The operands that are followed.
ROWS = {
    "THIC": Row("surface", "DISZ", bends=True),
    "CRVT": Row("surface", "CURV", bends=True),
    "CONN": Row("surface", "CONI"),
    "GLSS": Row("surface", "GLAS", path="glass", bends=True),
    "MIND": Row("surface", "GLAS", 3, bends=True),
    "MABB": Row("surface", "GLAS", 4),
    "MDPG": Row("surface", "GLAS", 5),
    "PRAM": Row("surface", "PARM#", 1),
    **{f"PAR{j}": Row("surface", "PARM#", 1) for j in range(1, 9)},
    "EDVA": Row("surface", "XDAT#", 1),
    "SDIA": Row("surface", "DIAM", path="semi_diameter"),
    "APMN": Row("surface", "APERTURE", 0),
    "APMX": Row("surface", "APERTURE", 1),
    "APDX": Row("surface", "OBDC", 0),
    "APDY": Row("surface", "OBDC", 1),
    **{f"CB{axis}": Row("surface", "SCBD1", 3 + k) for k, axis in enumerate(("DX", "DY", "TX", "TY", "TZ"))},
    **{f"CA{axis}": Row("surface", "SCBD2", 3 + k) for k, axis in enumerate(("DX", "DY", "TX", "TY", "TZ"))},
    "MCOM": Row("surface", "COMM", path="comment"),
    "XFIE": Row("field", _list("x"), None),
    "YFIE": Row("field", _list("y"), None),
    "FLWT": Row("field", _list("weight"), None),
    **{f"F{name}": Row("field", _list(name), None) for name in ("VDX", "VDY", "VCX", "VCY", "VAN")},
    "WAVE": Row("wavelength", "WAVM#", 1, bends=True),
    "WLWT": Row("wavelength", "WAVM#", 2),
    "PRWV": Row("", "PWAV", path="primary_wavelength", bends=True),
    "APER": Row("", "SIZE", bends=True),
    "STPS": Row("", "STOP", path="stop", bends=True),
    "TELE": Row("", "FTYP", 1, path="fields.telecentric"),
    "RAAM": Row("", "RAIM", 1, path="ray_aiming"),
    "TEMP": Row("", "ENVD", 0, bends=True),
    "PRES": Row("", "ENVD", 1, bends=True),
    "LTTL": Row("", "NAME", path="name"),
}

#: Operands that say nothing about rays and are kept with the lens: a comment, the weight of a configuration.
KEPT = ("MOFF", "CWGT")

#: Operands that are known and left out, with the reason.
IGNORED = {
    word: reason
    for reason, words in {
        "coatings do not bend rays": "COTN",
        "global coordinate reference: changes no ray": "GCRS GCPR",
        "polarisation": "GPEX GPEY GPIU GPJX GPJY GPPX GPPY GQPO",
        "how the program computes, says nothing about the lens": "MTFU OPDR CPCN PXAR SWCN AICN HOLD SDRW",
        "shift of the pupil for the program's own ray aiming": "PSHX PSHY PSHZ PSCX PSCY PUCN",
        "coefficient of thermal expansion": "TCEX",
        "mechanical semi-diameter: for drawing and mounting, never clips a ray": "MCHI",
    }.items()
    for word in words.split()
}

#: Operands that are known and not modelled: a configuration in which they differ is refused.
REFUSED = (
    *("IGNR", "IGNM", "SATP", "FLTP", "AFOC", "APDF", "APDT", "APTP", "UDAF", "CAOR", "CBOR", "CROR", "CRSR", "SRTS"),
    *("CSP1", "CSP2", "PSP1", "PSP2", "PSP3", "TSP1", "TSP2", "TSP3"),
    *("NCOM", "NCOT", "NGLS", "NPAR", "NPOS", "NPRO"),
)


class Cell(NamedTuple):
    """One line of the table: an operand's value in one configuration, as text.

    covered: of a temperature or pressure that only some surfaces have, which; None of the lens's.
    rule: the words behind the value: its status (1 variable, 2 a pickup) …
    """

    name: str
    number: int
    parameter: int
    configuration: int
    value: str
    record: Record
    covered: tuple[int, ...] | None = None
    rule: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[str, int, int]:
        return self.name, self.number, self.parameter

    def __str__(self) -> str:
        value = f"{plain(self.value):g}" if is_number(self.value) else self.value or '""'
        return f"{self.name} {self.number} = {value}"


_CELL = re.compile(r'\s*(-?\d{1,6})\s+(-?\d{1,6})\s+("[^"]*"|\S+)(.*)', re.ASCII)


def cell(record: Record) -> Cell | None:
    """The cell that a record after MNUM is; None if it is no operand."""
    found = _CELL.fullmatch(record.text)
    if not found or not re.fullmatch(r"[A-Z][A-Z0-9]{3}", record.keyword):
        return None
    rest = found[4].split()
    parameter = int(rest[1]) if len(rest) > 1 and re.fullmatch(r"-?\d{1,6}", rest[1]) else 0
    if re.fullmatch(r"PAR[1-8]", record.keyword):
        parameter = int(record.keyword[3])
    elif record.keyword not in ("PRAM", "EDVA") and record.keyword in ROWS:
        parameter = 0
    return Cell(record.keyword, int(found[1]), parameter, int(found[2]), found[3].strip('"'), record, None, tuple(rest))


# -- the records of a file with an operand applied ---------------------------------------------------------------------


def applied(found: Sections, one: Cell, value: str) -> Sections:
    """The records with an operand of the rows at a value. Raises LensFileError for a surface (field …) not there."""
    row = ROWS[one.name]
    if row.keyword == "STOP":
        return _with_stop(found, one, value)
    if one.covered is not None:
        return _with_environments(found, one, value)
    if row.of != "surface":
        return found._replace(system=_put(found.system, one, value))
    if not 0 <= one.number < len(found.surfaces):
        last = len(found.surfaces) - 1
        raise LensFileError(f"{one.name} of surface {one.number}; expected one from 0 to {last}", one.record.place)
    surfaces = list(found.surfaces)
    surfaces[one.number] = _put(surfaces[one.number], one, value)
    return found._replace(surfaces=_followed(surfaces, found.surfaces))


def word(found: Sections, one: Cell) -> str | None:
    """The word that an operand stands for, as the records have it; None where there is none."""
    row = ROWS[one.name]
    if row.keyword == "STOP":
        return next((str(k) for k, block in enumerate(found.surfaces) if block.last("STOP")), None)
    block = found.surfaces[one.number] if row.of == "surface" else found.system
    record, position, _ = _target(block, one)
    if row.keyword in ("NAME", "COMM"):
        return record.text.strip() if record else ""
    return record.words[position] if record and position < len(record.words) else None


def _put(block: Block, one: Cell, value: str) -> Block:
    """A block with another word in the record of an operand, which is added where it is missing."""
    record, position, blank = _target(block, one)
    keyword = record.keyword if record else blank[0]
    if keyword == "GLAS" and position == 0:
        return _with_glass(block, record, one, value)
    if keyword == "GLAS" and record is None:
        raise LensFileError(f"{one.name} of surface {one.number}, which has no glass", one.record.place)
    if keyword == "DISZ" and one.number == 0 and is_number(value) and plain(value) >= FAR:
        value = "INFINITY"
    if is_infinite(value) and not (keyword == "DISZ" and one.number == 0):
        raise LensFileError(f"{one.name} is {shown(value)}; only the object may be at infinity", one.record.place)
    words = list(record.words if record else blank[1:])
    words += ["0"] * (position + 1 - len(words))
    words[position] = value
    text = value if keyword in ("NAME", "COMM") else " ".join(words)
    made = Record(keyword, tuple(words), text, one.record.place._replace(surface=block.place.surface), True)
    return _with_record(block, record, made)


def _target(block: Block, one: Cell) -> tuple[Record | None, int, tuple[str, ...]]:
    """The record of an operand, the position of its word, and the record to add where there is none."""
    row = ROWS[one.name]
    position = one.number - 1 if row.position is None else row.position
    if row.keyword == "SIZE":
        return block.last("ENPD", "FNUM", "OBNA"), 0, ("ENPD",)
    if row.keyword == "APERTURE":
        found = block.all(*(keyword for keyword in aperture_keywords() if keyword != "FLAP"))
        return (found[-1] if found else None), position, ("CLAP", "0", "0")
    if row.keyword.startswith("SCBD"):
        which = row.keyword[4:]
        return _numbered(block, "SCBD", which), position, ("SCBD", which, *"0000000")
    if row.keyword.endswith("#"):
        keyword, number = row.keyword[:-1], str(one.parameter if row.of == "surface" else one.number)
        return _numbered(block, keyword, number), position, (keyword, number, "0", "1")
    return block.last(row.keyword), position, (row.keyword,)


def _numbered(block: Block, keyword: str, number: str) -> Record | None:
    return next((one for one in reversed(block.all(keyword)) if one.words and one.words[0] == number), None)


def _with_record(block: Block, old: Record | None, new: Record | None) -> Block:
    """A block with one record in place of another; `old` None: added; `new` None: taken away."""
    made = Block(block.place)
    made.records = dict(block.records)
    keyword = (new or old).keyword
    listed = [new if one is old else one for one in block.records.get(keyword, ())]
    listed += [new] if old is None else []
    listed = [one for one in listed if one is not None]
    if listed:
        made.records[keyword] = listed
    else:
        made.records.pop(keyword, None)
    return made


def _with_glass(block: Block, record: Record | None, one: Cell, name: str) -> Block:
    """A block with another glass; of the same name, with the figures that the file has for it."""
    if record and record.words and record.words[0].upper() == name.upper():
        return block
    if not name:
        return _with_record(block, record, None) if record else block
    words = (name, "0", "0", "1.5", "40")
    place = one.record.place._replace(surface=block.place.surface)
    return _with_record(block, record, Record("GLAS", words, " ".join(words), place, True))


def _with_stop(found: Sections, one: Cell, value: str) -> Sections:
    number = int(plain(value)) if is_number(value) else -1
    if not 0 < number < len(found.surfaces) - 1:
        message = f"STPS is {shown(value)}; expected a surface from 1 to {len(found.surfaces) - 2}"
        raise LensFileError(message, one.record.place)
    surfaces = [_with_record(block, old, None) if (old := block.last("STOP")) else block for block in found.surfaces]
    made = Record("STOP", (), "", one.record.place._replace(surface=number), True)
    surfaces[number] = _with_record(surfaces[number], None, made)
    return found._replace(surfaces=surfaces)


def _with_environments(found: Sections, one: Cell, value: str) -> Sections:
    """The records with a temperature or a pressure in the surfaces that it holds for."""
    surfaces, position = list(found.surfaces), ROWS[one.name].position
    for k in one.covered:
        if not 0 <= k < len(surfaces):
            last = len(surfaces) - 1
            raise LensFileError(f"{one.name} of surface {k}; expected one from 0 to {last}", one.record.place)
        old = surfaces[k].last("ENVD")
        words = list(old.words if old else (UNTOLD, UNTOLD))
        words[position] = value
        made = Record("ENVD", tuple(words), " ".join(words), one.record.place._replace(surface=k), True)
        surfaces[k] = _with_record(surfaces[k], old, made)
    return found._replace(surfaces=surfaces)


# -- pickups -----------------------------------------------------------------------------------------------------------


class Pickup(NamedTuple):
    """A number of a surface that is factor · (that of another) + offset, kept by the file as a word of `record`."""

    record: Record
    position: int
    source: int
    factor: float
    offset: float


def _pickups(block: Block) -> list[tuple[Pickup, str]]:
    """The pickups of a surface, with the keyword whose record of the other surface they take it from.

    PPAR j surface factor offset: parameter j; PZUP surface factor offset: thickness; CURV c 4 surface factor. That of
    a glass is GLAS name 2 surface.
    """
    found = []
    for told in block.all("PPAR", "PZUP", "CURV"):
        first = {"PPAR": 1, "PZUP": 0, "CURV": 2}[told.keyword]
        figures = [plain(one) for one in told.words[first : first + 3] if is_number(one)]
        if len(figures) < 2 or (told.keyword == "CURV" and (told.words[1] != "4" or any(figures[2:]))):
            continue
        number = told.words[0]
        keyword = {"PPAR": "PARM", "PZUP": "DISZ", "CURV": "CURV"}[told.keyword]
        held = _numbered(block, "PARM", number) if keyword == "PARM" else block.last(keyword)
        if held and figures[0] == int(figures[0]):
            found.append((Pickup(held, int(keyword == "PARM"), int(figures[0]), figures[1], sum(figures[2:])), number))
    return found


def _followed(surfaces: list[Block], before: Sequence[Block]) -> list[Block]:
    """The surfaces with pickups of what has changed, from the object on, as a pickup looks back.

    A pickup whose stored value is not its rule's stays as it is: it means something else.
    """
    for k, block in enumerate(surfaces):
        for pickup, number in _pickups(before[k]):
            if not 0 <= pickup.source < k or surfaces[pickup.source] is before[pickup.source]:
                continue
            old, new = (_picked(blocks[pickup.source], pickup, number) for blocks in (before, surfaces))
            stored = pickup.record.words[pickup.position] if pickup.position < len(pickup.record.words) else ""
            if old is None or new is None or old == new or not is_number(stored):
                continue
            if abs(plain(stored) - old) <= 1e-9 * abs(old) + 1e-300:
                words = list(pickup.record.words)
                words[pickup.position] = repr(new)
                block = _with_record(block, pickup.record, pickup.record._replace(words=tuple(words)))
        surfaces[k] = _with_picked_glass(block, surfaces, before)
    return surfaces


def _with_picked_glass(block: Block, surfaces: Sequence[Block], before: Sequence[Block]) -> Block:
    """A surface with the glass that it picks up from another, which has changed."""
    record, source = block.last("GLAS"), glass_source(block)
    if source is None or surfaces[source] is before[source]:
        return block
    old, new = (blocks[source].last("GLAS") for blocks in (before, surfaces))
    named_alike = bool(old) and old.words[:1] == record.words[:1]
    if not (named_alike or is_blank(record)) or (new and old and new.words[:1] == old.words[:1]):
        return block
    return _with_record(block, record, new._replace(place=record.place) if new else None)


def _picked(block: Block, pickup: Pickup, number: str) -> float | None:
    keyword = pickup.record.keyword
    record = _numbered(block, keyword, number) if keyword == "PARM" else block.last(keyword)
    if not record or pickup.position >= len(record.words) or not is_number(record.words[pickup.position]):
        return None
    return pickup.factor * plain(record.words[pickup.position]) + pickup.offset


def solved(surfaces: Sequence[Block]) -> list[str]:
    """What rays are solved for in the surfaces, which an operand may move in other configurations."""
    found = []
    for block in surfaces:
        curvature, height = block.last("CURV"), block.last("MAZH")
        if curvature and len(curvature.words) > 1 and curvature.words[1] not in ("0", "1", "4"):
            found.append(f"CURV {block.place.surface}")
        if height:
            found.append(f"DISZ {block.place.surface}")
    return found
