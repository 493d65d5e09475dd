"""The configurations of a .zmx file: its multi-configuration operands, a row each, as those of a lens.

    THIC   6   2 -2.0E+001 0 0 0 2 2 1.0E+000 0.0E+000 0

An operand gives its surface (field, wavelength), the configuration, the value, its status (1 variable, 2 pickup), and
its second argument, which is the number of the parameter for PRAM; then the numbers of a pickup from another
configuration. The value is the solved one. An operand puts a word into a record, as if the file had been saved in that
configuration, so that every type of surface reads it; pickups of the surfaces are followed. The place of an operand in
the lens is found by reading the file with it at other values: so a pickup is one more place. An operand that changes
nothing is reported.

Temperature and pressure: ENVD gives those of the lens (°C, atm, and whether indices follow them; 0: those of the
catalogs). TEMP and PRES of the multi-configuration table hold for the surfaces that the operands after them name (CRVT,
THIC, GLSS), up to the next one of the same name; the last is the lens's own, which ENVD repeats. With this rule the
stored image distance of OpticStudio's sample of an evacuated cell is reproduced to 4e-12 mm.
"""

import dataclasses
import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.io.assembly import environment_at
from raytrace.io.source import (
    IGNORED,
    READ,
    UNKNOWN,
    Block,
    Draft,
    LensFileError,
    Place,
    Record,
    by_word,
    double,
    exact,
    is_infinite,
    is_number,
    plain,
    shown,
)
from raytrace.io.zemax.surfaces import FIELD_LISTS, Sections, aperture_keywords, glass_source, is_blank
from raytrace.materials import environment as environments
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.environment import REFERENCE, Environment
from raytrace.materials.glass import Glass
from raytrace.system import configurations
from raytrace.system.configurations import Operand, Path, ScaledPath, differences, part, same, taken, with_part
from raytrace.system.lens import Lens, unknown_changes
from raytrace.system.surface import Surface

#: More configurations, and more operands, than any file has.
MOST_CONFIGURATIONS, MOST_CELLS = 200, 2000

#: Values at which the place of an operand is sought: far from those of lenses, and exact in binary.
_PROBES = ("0.34375", "0.40625", "0.46875")

#: In place of a temperature or pressure of a surface that is the lens's.
OF_LENS = "-"

#: At this distance an operand has the object at infinity.
FAR = 1e10

#: The operands of an environment, each with the field of `Environment` that it sets, and those that name its surfaces.
ENVIRONMENT_OPERANDS = {"TEMP": "temperature", "PRES": "pressure"}
_NAMING = ("CRVT", "THIC", "GLSS")


class OperandRow(NamedTuple):
    """The record that an operand changes.

    of: the meaning of its first argument: "surface", "field", "wavelength" or "" of the system.
    keyword, position: the record and the word of it that the value is; a keyword that ends in # is one of several
        numbered records, and a position of None is counted by the argument.
    path: of a value that is not a number, its path in the lens, or in its surface.
    refracts: whether the paraxial rays at other surfaces depend on it, and with them the solves there.
    """

    of: str
    keyword: str
    position: int | None = 0
    path: str = ""
    refracts: bool = False


def _field(name: str) -> OperandRow:
    return OperandRow("field", FIELD_LISTS[name].keywords[0], None)


#: The operands that are followed.
ROWS = {
    "THIC": OperandRow("surface", "DISZ", refracts=True),
    "CRVT": OperandRow("surface", "CURV", refracts=True),
    "CONN": OperandRow("surface", "CONI"),
    "GLSS": OperandRow("surface", "GLAS", path="glass", refracts=True),
    "MIND": OperandRow("surface", "GLAS", 3, refracts=True),
    "MABB": OperandRow("surface", "GLAS", 4),
    "MDPG": OperandRow("surface", "GLAS", 5),
    "PRAM": OperandRow("surface", "PARM#", 1),
    **{f"PAR{j}": OperandRow("surface", "PARM#", 1) for j in range(1, 9)},
    "EDVA": OperandRow("surface", "XDAT#", 1),
    "SDIA": OperandRow("surface", "DIAM", path="semi_diameter"),
    "APMN": OperandRow("surface", "APERTURE", 0),
    "APMX": OperandRow("surface", "APERTURE", 1),
    "APDX": OperandRow("surface", "OBDC", 0),
    "APDY": OperandRow("surface", "OBDC", 1),
    **{
        f"C{side}{axis}": OperandRow("surface", f"SCBD{number}", 3 + k)
        for number, side in ((1, "B"), (2, "A"))
        for k, axis in enumerate(("DX", "DY", "TX", "TY", "TZ"))
    },
    "MCOM": OperandRow("surface", "COMM", path="comment"),
    "XFIE": _field("x"),
    "YFIE": _field("y"),
    "FLWT": _field("weight"),
    **{f"F{name}": _field(name) for name in ("VDX", "VDY", "VCX", "VCY", "VAN")},
    "WAVE": OperandRow("wavelength", "WAVM#", 1, refracts=True),
    "WLWT": OperandRow("wavelength", "WAVM#", 2),
    "PRWV": OperandRow("", "PWAV", path="primary_wavelength", refracts=True),
    "APER": OperandRow("", "SIZE", refracts=True),
    "STPS": OperandRow("", "STOP", path="stop", refracts=True),
    "TELE": OperandRow("", "FTYP", 1, path="fields.telecentric"),
    "RAAM": OperandRow("", "RAIM", 1, path="ray_aiming"),
    "TEMP": OperandRow("", "ENVD", 0, refracts=True),
    "PRES": OperandRow("", "ENVD", 1, refracts=True),
    "LTTL": OperandRow("", "NAME", path="name"),
}

#: Operands that change no ray and are kept with the lens: a comment, the weight of a configuration.
KEPT = ("MOFF", "CWGT")

#: Operands that are known and left out, with the reason.
_LEFT_OUT = by_word(
    {
        "coatings refract no rays": "COTN",
        "global coordinate reference: changes no ray": "GCRS GCPR",
        "polarisation": "GPEX GPEY GPIU GPJX GPJY GPPX GPPY GQPO",
        "setting of the computation, independent of the lens": "MTFU OPDR CPCN PXAR SWCN AICN HOLD SDRW",
        "shift of the pupil for the program's own ray aiming": "PSHX PSHY PSHZ PSCX PSCY PUCN",
        "coefficient of thermal expansion": "TCEX",
        "mechanical semi-diameter: for drawing and mounting, never clips a ray": "MCHI",
    }
)

#: Operands that are known, with the reason why a configuration in which they differ is refused.
_REFUSED = by_word(
    {
        "it is not modelled": "IGNR IGNM SATP FLTP AFOC APDF APDT APTP UDAF CAOR CBOR CROR CRSR SRTS CSP1 CSP2 PSP1 "
        "PSP2 PSP3 TSP1 TSP2 TSP3 NCOM NCOT NGLS NPAR NPOS NPRO"
    }
)


# -- cells of the table -----------------------------------------------------------------------------------------------


class Cell(NamedTuple):
    """One line of the table: an operand's value in one configuration, as text.

    covered: the surfaces that have a temperature or pressure of their own; None for the lens's.
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


_CELL = re.compile(r'\s*(-?\d{1,6})\s+(-?\d{1,6})\s+("[^"]*"|\S+)(.*)', re.ASCII)


def cell_of(record: Record) -> Cell | None:
    """The cell of a record after MNUM; None if it is no operand."""
    match = _CELL.fullmatch(record.text)
    if not match or not re.fullmatch(r"[A-Z][A-Z0-9]{3}", record.keyword):
        return None
    rest = match[4].split()
    parameter = int(rest[1]) if len(rest) > 1 and re.fullmatch(r"-?\d{1,6}", rest[1]) else 0
    if re.fullmatch(r"PAR[1-8]", record.keyword):
        parameter = int(record.keyword[3])
    elif record.keyword not in ("PRAM", "EDVA") and record.keyword in ROWS:
        parameter = 0
    number, configuration, value = int(match[1]), int(match[2]), match[3].strip('"')
    return Cell(record.keyword, number, parameter, configuration, value, record, None, tuple(rest))


def _cells(records: Iterable[Record], count: int, report: Draft) -> list[Cell]:
    """The cells of the lines after MNUM, every line reported."""
    cells = []
    for record in records:
        cell, word = cell_of(record), record.keyword
        if cell is None or word in _LEFT_OUT:
            report.met(word[:40], IGNORED, record.place, _LEFT_OUT.get(word, "no multi-configuration operand"))
        elif word not in ROWS and word not in KEPT and word not in _REFUSED:
            report.met(word, UNKNOWN, record.place)
        else:
            report.met(word, READ, record.place)
            if 1 <= cell.configuration <= count:
                cells.append(cell)
            else:
                report.warn(f"{word} of configuration {cell.configuration}, of {count}: left out", record.place)
        if len(cells) > MOST_CELLS:
            raise LensFileError(f"more than {MOST_CELLS} multi-configuration operands", record.place)
    return cells


def _grouped(cells: Sequence[Cell], count: int, report: Draft) -> list[tuple[Cell, ...]]:
    """The cells of each operand, one a configuration. A missing configuration has the value of the first.

    Operands of an environment other than the lens's have the surfaces that it covers.
    """
    groups: list[list[Cell]] = []
    for cell in cells:
        if groups and groups[-1][-1].key == cell.key and groups[-1][-1].configuration < cell.configuration:
            groups[-1].append(cell)
        else:
            groups.append([cell])
    operands = []
    for group in groups:
        by_number = {cell.configuration: cell for cell in group}
        missing = [str(k) for k in range(1, count + 1) if k not in by_number]
        if missing and group[0].name not in KEPT:
            listed = ", ".join(missing[:8])
            message = f"{group[0].name} {group[0].number} has no value for configuration {listed}; the first is taken"
            report.warn(message, group[0].record.place)
        operands.append(tuple(by_number.get(k, group[0]) for k in range(1, count + 1)))
    for name in ENVIRONMENT_OPERANDS:
        starts = [k for k, operand in enumerate(operands) if operand[0].name == name]
        for start, end in itertools.pairwise(starts):
            between = (operand[0] for operand in operands[start + 1 : end])
            covered = tuple(dict.fromkeys(cell.number for cell in between if cell.name in _NAMING))
            operands[start] = tuple(cell._replace(covered=covered) for cell in operands[start])
    return operands


# -- the records of a file with an operand applied --------------------------------------------------------------------


def applied(sections: Sections, cell: Cell, value: str) -> Sections:
    """The records with an operand of ROWS at a value. Raises LensFileError for a surface (field …) not present."""
    row, surfaces, last = ROWS[cell.name], list(sections.surfaces), len(sections.surfaces) - 1
    if row.keyword == "STOP":
        number = int(plain(value)) if is_number(value) else -1
        if not 0 < number < last:
            raise LensFileError(f"STPS is {shown(value)}; expected a surface from 1 to {last - 1}", cell.record.place)
        surfaces = [_with_record(block, old, None) if (old := block.last("STOP")) else block for block in surfaces]
        stop = Record("STOP", (), "", cell.record.place._replace(surface=number), True)
        surfaces[number] = _with_record(surfaces[number], None, stop)
        return sections._replace(surfaces=surfaces)
    if row.of != "surface" and cell.covered is None:
        return sections._replace(system=_put(sections.system, cell, value))
    for k in (cell.number,) if cell.covered is None else cell.covered:
        if not 0 <= k <= last:
            raise LensFileError(f"{cell.name} of surface {k}; expected one from 0 to {last}", cell.record.place)
    if cell.covered is None:
        surfaces[cell.number] = _put(surfaces[cell.number], cell, value)
        return sections._replace(surfaces=_followed(surfaces, sections.surfaces))
    for k in cell.covered:
        old = surfaces[k].last("ENVD")
        words = list(old.words if old else (OF_LENS, OF_LENS))
        words[row.position] = value
        new = Record("ENVD", tuple(words), " ".join(words), cell.record.place._replace(surface=k), True)
        surfaces[k] = _with_record(surfaces[k], old, new)
    return sections._replace(surfaces=surfaces)


def word_of(sections: Sections, cell: Cell) -> str | None:
    """The word of the records that is an operand's value; None where there is none."""
    row = ROWS[cell.name]
    if row.keyword == "STOP":
        return next((str(k) for k, block in enumerate(sections.surfaces) if block.last("STOP")), None)
    block = sections.surfaces[cell.number] if row.of == "surface" else sections.system
    record, position, _ = _target(block, cell)
    if row.keyword in ("NAME", "COMM"):
        return record.text.strip() if record else ""
    return record.words[position] if record and position < len(record.words) else None


def _put(block: Block, cell: Cell, value: str) -> Block:
    """A block with another word in the record of an operand, which is added where it is missing."""
    record, position, blank = _target(block, cell)
    keyword = record.keyword if record else blank[0]
    place = cell.record.place._replace(surface=block.place.surface)
    if keyword == "GLAS" and position == 0:
        if record and record.words and record.words[0].upper() == value.upper():
            return block  # of the same name, with the indices that the file has for it
        if not value:
            return _with_record(block, record, None) if record else block
        words = (value, "0", "0", "1.5", "40")
        return _with_record(block, record, Record("GLAS", words, " ".join(words), place, True))
    if keyword == "GLAS" and record is None:
        raise LensFileError(f"{cell.name} of surface {cell.number}, which has no glass", cell.record.place)
    if keyword == "DISZ" and cell.number == 0 and is_number(value) and plain(value) >= FAR:
        value = "INFINITY"
    if is_infinite(value) and not (keyword == "DISZ" and cell.number == 0):
        raise LensFileError(f"{cell.name} is {shown(value)}; only the object may be at infinity", cell.record.place)
    words = list(record.words if record else blank[1:])
    words += ["0"] * (position + 1 - len(words))
    words[position] = value
    text = value if keyword in ("NAME", "COMM") else " ".join(words)
    return _with_record(block, record, Record(keyword, tuple(words), text, place, True))


def _target(block: Block, cell: Cell) -> tuple[Record | None, int, tuple[str, ...]]:
    """The record of an operand, the position of its word, and the record to add where there is none."""
    row = ROWS[cell.name]
    position = cell.number - 1 if row.position is None else row.position
    if row.keyword == "SIZE":
        return block.last("ENPD", "FNUM", "OBNA"), 0, ("ENPD",)
    if row.keyword == "APERTURE":
        apertures = block.all(*(keyword for keyword in aperture_keywords() if keyword != "FLAP"))
        return (apertures[-1] if apertures else None), position, ("CLAP", "0", "0")
    if row.keyword.startswith("SCBD"):
        side = row.keyword[4:]
        return _numbered(block, "SCBD", side), position, ("SCBD", side, *"0000000")
    if row.keyword.endswith("#"):
        keyword, number = row.keyword[:-1], str(cell.parameter if row.of == "surface" else cell.number)
        return _numbered(block, keyword, number), position, (keyword, number, "0", "1")
    return block.last(row.keyword), position, (row.keyword,)


def _numbered(block: Block, keyword: str, number: str) -> Record | None:
    records = reversed(block.all(keyword))
    return next((record for record in records if record.words and record.words[0] == number), None)


def _with_record(block: Block, old: Record | None, new: Record | None) -> Block:
    """A block with one record in place of another; `old` None: added; `new` None: removed."""
    changed, keyword = Block(block.place), (new or old).keyword
    listed = [new if record is old else record for record in block.records.get(keyword, ())]
    listed = [record for record in (*listed, *([new] if old is None else [])) if record is not None]
    changed.records = {**block.records, keyword: listed}
    if not listed:
        del changed.records[keyword]
    return changed


# -- pickups and solves of the surfaces -------------------------------------------------------------------------------


#: Pickups of numbers: by the keyword of the rule, that of the number, its word, and the first word of the rule.
#: PPAR j surface factor offset: parameter j; PZUP surface factor offset: thickness; CURV c 4 surface factor.
_PICKUPS = {"PPAR": ("PARM", 1, 1), "PZUP": ("DISZ", 0, 0), "CURV": ("CURV", 0, 2)}


def _followed(surfaces: list[Block], before: Sequence[Block]) -> list[Block]:
    """The surfaces with pickups of changed surfaces, from the object on, as a pickup looks back.

    A pickup whose stored value is not its rule's stays unchanged: it has another meaning.
    """

    def holder(block: Block, keyword: str, number: str) -> Record | None:
        return _numbered(block, keyword, number) if keyword == "PARM" else block.last(keyword)

    for k, block in enumerate(surfaces):
        for rule in before[k].all(*_PICKUPS):
            keyword, position, first = _PICKUPS[rule.keyword]
            numbers = [plain(word) for word in rule.words[first : first + 3] if is_number(word)]
            if len(numbers) < 2 or (keyword == "CURV" and (rule.words[1] != "4" or any(numbers[2:]))):
                continue
            source, factor, offset = int(numbers[0]), numbers[1], sum(numbers[2:])
            if source != numbers[0] or not 0 <= source < k or surfaces[source] is before[source]:
                continue
            blocks = before[k], before[source], surfaces[source]
            records = [holder(each, keyword, rule.words[0]) for each in blocks]
            texts = [record.words[position] if record and position < len(record.words) else "" for record in records]
            if not all(map(is_number, texts)):
                continue
            stored, *sources = map(plain, texts)
            old, new = (factor * number + offset for number in sources)
            if old != new and abs(stored - old) <= 1e-9 * abs(old) + 1e-300:
                words = list(records[0].words)
                words[position] = repr(new)
                block = _with_record(block, records[0], records[0]._replace(words=tuple(words)))
        surfaces[k] = _with_picked_glass(block, surfaces, before)
    return surfaces


def _with_picked_glass(block: Block, surfaces: Sequence[Block], before: Sequence[Block]) -> Block:
    """A surface with the glass that it picks up from a changed surface."""
    record, source = block.last("GLAS"), glass_source(block)
    if source is None or surfaces[source] is before[source]:
        return block
    old, new = (blocks[source].last("GLAS") for blocks in (before, surfaces))
    named_alike = bool(old) and old.words[:1] == record.words[:1]
    if not (named_alike or is_blank(record)) or (new and old and new.words[:1] == old.words[:1]):
        return block
    return _with_record(block, record, new._replace(place=record.place) if new else None)


# -- reading ----------------------------------------------------------------------------------------------------------


Rebuild = Callable[[Sections], Lens]


class PlacedOperand(NamedTuple):
    """An operand with the lines it comes from, and a lens in which all of its places are modelled."""

    operand: Operand
    cells: tuple[Cell, ...]
    like: Lens


def read(sections: Sections, lens: Lens, rebuild: Rebuild, report: Draft, configuration: int | None) -> Lens:
    """The lens, as its surfaces are stored, with its operands, and in the requested configuration.

    rebuild: the lens of changed records.
    """
    head = sections.system.last("MNUM")
    if head is None:
        return lens if configuration is None else lens.configuration(configuration)
    count = head.integer(0, "number of configurations", 1)
    if not 1 <= count <= MOST_CONFIGURATIONS:
        raise LensFileError(f"MNUM is {count}, expected 1 to {MOST_CONFIGURATIONS} configurations", head.place)
    tail = [record for record in sections.tail if record.place.line > head.place.line]
    groups = _grouped(_cells(tail, count, report), count, report)
    stated = head.integer(1, "active configuration", 0) if count > 1 else 1
    is_stated = 1 <= stated <= count
    environments = [group[(stated if is_stated else 1) - 1] for group in groups if group[0].covered is not None]
    for cell in environments:  # only operands give the environments of surfaces
        sections = applied(sections, cell, cell.value)
    lens = rebuild(sections) if environments else lens
    operands = [_placed_operand(group, sections, lens, rebuild) for group in groups]
    agreeing = [k for k in range(1, count + 1) if all(_agrees(placed, lens, k) is not False for placed in operands)]
    active = stated if is_stated else agreeing[0] if agreeing else 1
    if count > 1:
        sure = stated or len(agreeing) == 1
        which = f"configuration {active} of {count}" if sure else f"one of {count} configurations (taken for {active})"
        varied = ", ".join(sorted({placed.operand.name for placed in operands})[:8]) or "nothing"
        message = f"multi-configuration file: {which} read, as stored in its surfaces; they differ in {varied}"
        if configuration is not None:
            report.note(message.replace(" read,", ","))
            report.note(f"configuration {configuration} of {count} read, as requested")
        elif active == 1 and sure:
            report.note(message)
        else:
            report.warn(message, head.place)
    for placed in operands:
        _report_operand(placed, lens, active, count, report)
    _report_solved(sections, operands, active, report)
    for placed in operands:
        for place in placed.operand.paths if placed.operand.numbers is not None else ():
            if part(lens, place.path) is None:
                lens = with_part(lens, place.path, double(0.0), like=placed.like)
    # the surfaces have more digits than the operands, where both agree
    listed = [taken(p.operand, lens, active - 1) if _agrees(p, lens, active) else p.operand for p in operands]
    listed = tuple(o for o in listed if o.name != "MOFF" or o.numbers is not None or any(map(any, o.words)))
    if count > 1 and not listed:
        listed = (Operand("MOFF", words=(("",),) * count),)  # keeps the count
    lens = dataclasses.replace(lens, operands=listed, current_configuration=active)
    try:
        return lens if configuration is None else lens.configuration(configuration)
    except ValueError as error:
        raise LensFileError(str(error), head.place) from error


def _placed_operand(cells: tuple[Cell, ...], sections: Sections, lens: Lens, rebuild: Rebuild) -> PlacedOperand:
    """The operand of these cells with its places in the lens, or the reason why it is not followed."""
    first, values = cells[0], tuple(cell.value for cell in cells)
    texts = tuple((value,) for value in values)

    def placed(like: Lens = lens, **fields) -> PlacedOperand:
        return PlacedOperand(Operand(first.name, first.number, first.parameter, **fields), cells, like)

    numbers = double([plain(value) for value in values]) if all(map(is_number, values)) else None
    unplaced = placed(words=texts) if numbers is None else placed(numbers=numbers)
    if first.name in KEPT:
        return unplaced
    if first.name in _REFUSED:
        return placed(words=texts, refusal=_REFUSED[first.name])
    try:
        lenses = {value: rebuild(applied(sections, cell, value)) for cell, value in zip(cells, values, strict=True)}
    except (LensFileError, UnknownGlass) as error:
        return placed(words=texts, refusal=str(error))
    row, probes = ROWS[first.name], []
    if not row.path:
        try:
            probes = [rebuild(applied(sections, first, value)) for value in _PROBES]
        except (LensFileError, UnknownGlass):
            probes = []  # it is no number
    start = ("surfaces", first.number) if row.of == "surface" else ()
    paths = [(*start, *row.path.split("."))] if row.path else []
    readings = probes or [lens, *lenses.values()]
    paths += [path for other in readings[1:] for path in differences(readings[0], other)]
    paths = list(dict.fromkeys(paths))
    if not paths:
        return unplaced
    held = [[part(lenses[value], path) for path in paths] for value in values]
    if scaled_paths := _linear_paths(paths, probes, held):
        numbers = torch.stack([double(0.0) if parts[0] is None else parts[0] for parts in held])
        return placed(probes[0], paths=scaled_paths, numbers=numbers)
    for *owner, end in paths:
        if part(lens, (*owner, end)) is None and not (isinstance(end, str) and part(lens, tuple(owner)) is not None):
            return placed(words=texts, refusal="the lens as stored has no such part, an aperture for example")
    scaled_paths = tuple(map(ScaledPath, paths))
    if all(isinstance(parts[0], Glass) and all(same(parts[0], other) for other in parts) for parts in held):
        return placed(paths=scaled_paths, media=tuple(parts[0] for parts in held))
    return placed(paths=scaled_paths, words=tuple(map(tuple, held)))


def _linear_paths(paths: Sequence[Path], probes: Sequence[Lens], held: Sequence[Sequence]) -> tuple[ScaledPath, ...]:
    """The places of a number, each linear in the first; none where they are no numbers, or not linear."""

    def is_scalar(value) -> bool:
        return isinstance(value, Tensor) and value.ndim == 0

    if not probes or any(not (value is None or is_scalar(value)) for row in held for value in row):
        return ()
    parts = [[part(lens, path) for path in paths] for lens in probes]
    if not all(is_scalar(value) for row in parts for value in row):
        return ()
    probed = [[float(value) for value in row] for row in parts]
    scaled_paths = [ScaledPath(paths[0])]
    for position, path in enumerate(paths[1:], 1):
        rise = (probed[1][position] - probed[0][position]) / (probed[1][0] - probed[0][0])
        scaled_paths.append(ScaledPath(path, rise, probed[0][position] - rise * probed[0][0]))
    for row in (*probed, *([0.0 if value is None else float(value) for value in row] for row in held)):
        for number, place in zip(row, scaled_paths, strict=True):
            if abs(place.factor * row[0] + place.offset - number) > 1e-12 * abs(number):
                return ()
    return tuple(scaled_paths)


def _agrees(placed: PlacedOperand, lens: Lens, configuration: int) -> bool | None:
    """Whether the lens as stored holds the operand of a configuration; None where that cannot be decided.

    Operands are saved with 13 digits. A semi-diameter of 0 is left to be computed.
    """
    operand, k = placed.operand, configuration - 1
    if not operand.paths:
        return None
    stored = part(lens, operand.paths[0].path)
    if operand.numbers is None:
        wanted = operand.media[k] if operand.media else operand.words[k][0]
        if operand.name == "SDIA":
            return None if wanted is None else stored is not None and abs(stored - wanted) <= 1e-9 * wanted
        return same(stored, wanted)
    number, wanted = 0.0 if stored is None else float(stored), float(operand.numbers[k])
    return number == wanted or abs(number - wanted) <= 1e-9 * abs(wanted)


# -- reporting --------------------------------------------------------------------------------------------------------


def _report_operand(placed: PlacedOperand, lens: Lens, active: int, count: int, report: Draft) -> None:
    """Warn of an operand that is not followed, and of one that contradicts the surfaces."""
    cell, operand = placed.cells[active - 1], placed.operand
    text = f"{plain(cell.value):g}" if is_number(cell.value) else cell.value or '""'
    place, label = cell.record.place, f"multi-configuration operand {cell.name} {cell.number} = {text}"
    if cell.name in ENVIRONMENT_OPERANDS and not operand.paths:
        normal, unit, quantity = {"PRES": (1, "atm", "pressure"), "TEMP": (20, "°C", "temperature")}[cell.name]
        if is_number(cell.value) and plain(cell.value) != normal:
            message = f"{cell.name} {text} {unit} ({quantity} of configuration {cell.configuration})"
            report.warn(f"{message}: not followed; indices are those at {normal} {unit}", place)
    elif operand.refusal:
        if count == 1 or any(other.value != cell.value for other in placed.cells):
            report.warn(f"{label} (configuration {active}): not followed: {operand.refusal}", place)
    elif not operand.paths:
        if operand.name not in KEPT:
            report.warn(f"{label}: not followed: no number of the lens depends on it", place)
    elif _agrees(placed, lens, active) is False:
        stored = part(lens, operand.paths[0].path)
        if isinstance(stored, Glass):
            value = stored.name or "air"
        elif stored is None:
            value = "0"
        else:
            value = f"{float(stored):.13g}" if isinstance(stored, Tensor | float) else repr(stored)
        report.warn(f"{label}: not followed by the lens as stored, which holds {value} (configuration {active})", place)


def _report_solved(sections: Sections, operands: Sequence[PlacedOperand], active: int, report: Draft) -> None:
    """Warn of ray solves, where operands change the rays: their result is stored for one configuration only."""

    def refracts(operand: Operand) -> bool:
        row = ROWS.get(operand.name)
        if row is None or not row.keyword.startswith("PARM"):
            return row is not None and row.refracts
        kind = sections.surfaces[operand.number].last("TYPE") if operand.number < len(sections.surfaces) else None
        return bool(operand.paths) and not (kind and kind.words[:1] == ("COORDBRK",))

    solved = []
    for block in sections.surfaces:
        curvature = block.last("CURV")
        if curvature and len(curvature.words) > 1 and curvature.words[1] not in ("0", "1", "4"):
            solved.append(("CRVT", block.place.surface))
        if block.last("MAZH"):
            solved.append(("THIC", block.place.surface))
    listed = [placed.operand for placed in operands]
    set_by_operands = {(operand.name, operand.number) for operand in listed}
    left = [f"{ROWS[name].keyword} of surface {k}" for name, k in solved if (name, k) not in set_by_operands]
    varying = (operand.values() for operand in listed if refracts(operand))
    if left and any(value != values[0] for values in varying for value in values):
        message = f"solved for configuration {active}, and unchanged in the others: {', '.join(left)}"
        report.warn(message, sections.system.last("MNUM").place)


# -- the environment, read --------------------------------------------------------------------------------------------


def environment(system: Block) -> Environment | None:
    """The environment of ENVD; None where indices do not follow it. Raises LensFileError for values out of range."""
    record = system.last("ENVD")
    if record is None or not record.integer(2, "whether indices follow the environment", 0):
        return None
    return environment_at((record.number(0, "temperature"), record.number(1, "pressure")), record.place)


def in_environments(
    surfaces: Sequence[Surface], blocks: Sequence[Block], around: Environment | None
) -> tuple[Surface, ...]:
    """The surfaces with their own environments, which `applied` writes as ENVD into their blocks."""
    changed = list(surfaces)
    for k, block in enumerate(blocks if around is not None else ()):
        if record := block.last("ENVD"):
            of_lens = float(around.temperature), float(around.pressure)
            values = [
                of_lens[position] if record.words[position] == OF_LENS else record.number(position, name)
                for position, name in enumerate(ENVIRONMENT_OPERANDS.values())
            ]
            changed[k] = dataclasses.replace(changed[k], environment=environment_at(values, record.place))
    return tuple(changed)


def report_environment(sections: Sections, lens: Lens, report: Draft) -> None:
    """Report the environment of the indices, and the glasses whose thermal data are incomplete."""
    record = sections.system.last("ENVD")
    if lens.environment is not None:
        report.note(
            f"indices are those at {environments.in_words(lens.environment)} (ENVD); radii, thicknesses as stored"
        )
        for number, message in unknown_changes(lens).items():
            glass = sections.surfaces[number].last("GLAS")
            report.warn(message, glass.place if glass else sections.surfaces[number].place)
    elif record and record.words:
        stored = record.number(0, "temperature"), record.number(1, "pressure", REFERENCE[1])
        if stored != REFERENCE:
            message = f"environment of {stored[0]:g} °C and {stored[1]:g} atm, which indices do not follow (ENVD, third"
            report.warn(f"{message} number 0): they are the catalogs'", record.place)


# -- the environment, written -----------------------------------------------------------------------------------------


def environment_line(lens: Lens, place: Place) -> str:
    """The line of ENVD."""
    if lens.environment is None:
        return "ENVD 20 1 0"
    values = (exact(getattr(lens.environment, name), name, place) for name in ENVIRONMENT_OPERANDS.values())
    return " ".join(["ENVD", *values, "1"])


def is_of_surfaces(operand: Operand) -> bool:
    """Whether an operand sets the environment of some surfaces, and not that of the lens."""
    return operand.name in ENVIRONMENT_OPERANDS and bool(operand.paths) and operand.paths[0].path[0] == "surfaces"


def with_environments(lens: Lens, place: Place) -> Lens:
    """The lens with operands that give the environments of its surfaces.

    Raises LensFileError where the lens has none itself, for indices then follow none in such a file.
    """
    missing = [k for k, s in enumerate(lens.surfaces) if s.environment is not None and not _is_set(lens, k)]
    if lens.environment is None and missing:
        message = "a surface in an environment of its own, of a lens without one; give it one, as lens.at(pressure=1)"
        raise LensFileError(message, place._replace(surface=missing[0]))
    added = [operand for k in missing for operand in (*_environment_operands(lens, "surfaces", k), _naming(lens, k))]
    listed = []
    for position, operand in enumerate(candidates := [*added, *lens.operands]):
        listed.append(operand)
        if is_of_surfaces(operand):  # is followed by operands that name its surfaces
            behind = itertools.takewhile(lambda o, name=operand.name: o.name != name, candidates[position + 1 :])
            named = {other.number for other in behind if other.name in _NAMING}
            listed += [_naming(lens, path[1]) for path, *_ in operand.paths if path[1] not in named]
    for name, last in zip(ENVIRONMENT_OPERANDS, _environment_operands(lens) if lens.environment else (), strict=False):
        of_name = [operand for operand in listed if operand.name == name]
        listed += [last] if of_name and is_of_surfaces(of_name[-1]) else []
    return dataclasses.replace(lens, operands=tuple(listed))


def _is_set(lens: Lens, k: int) -> bool:
    """Whether operands of the lens set the environment of a surface; the quantities they do not set are the lens's."""
    if lens.environment is None:
        return False
    held = {path for operand in lens.operands for path, *_ in operand.paths}
    is_set = {name: ("surfaces", k, "environment", name) in held for name in ENVIRONMENT_OPERANDS.values()}
    as_lens = (same(getattr(lens.surfaces[k].environment, n), getattr(lens.environment, n)) for n in is_set)
    return any(is_set.values()) and all(map(max, is_set.values(), as_lens))


def _naming(lens: Lens, k: int) -> Operand:
    """An operand that changes nothing and names a surface."""
    media = (lens.surfaces[k].glass,) * configurations.count(lens.operands)
    return Operand("GLSS", k, paths=(ScaledPath(("surfaces", k, "glass")),), media=media)


def _environment_operands(lens: Lens, *path: str | int) -> list[Operand]:
    """Temperature and pressure of the lens, or of one of its surfaces, alike in all configurations."""
    air, count = part(lens, (*path, "environment")), configurations.count(lens.operands)
    return [
        Operand(
            name,
            paths=(ScaledPath((*path, "environment", field)),),
            numbers=torch.stack([getattr(air, field)] * count),
        )
        for name, field in ENVIRONMENT_OPERANDS.items()
    ]
