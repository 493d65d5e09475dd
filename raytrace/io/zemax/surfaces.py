"""Tables of a .zmx file: keywords, values and types of surface; and a surface read from its records.

A row of `ROWS` gives the path of a value in the lens, its power of length, and the operand of configurations that sets
it. A type of surface lists the path and the power of length of every number of its own:

    PARM j value        a number of the type
    XDAT 1 count, XDAT 2 radius, XDAT 3 …       further terms, and the radius that normalises them
    SCBD w o p dx dy tx ty tz       decentre and tilt before (w = 1) and after (w = 2) the surface, o the order

Reader, writer, unit conversion, configurations, variables and pickups use the same row. Lengths are in the file's unit
and become mm.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from decimal import Context, Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from raytrace.io.assembly import by_figures, clear_aperture, is_code, listed_glass, pose_of
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
    double,
    exact,
    is_infinite,
    is_number,
    nonzero,
    plain,
    refuse_surplus,
    shown,
    warn_of_repeats,
)
from raytrace.materials.catalogs import Catalog
from raytrace.materials.glass import AIR, MIRROR, Glass, mil_glass
from raytrace.maths.numerics import Number
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.configurations import Path as LensPath
from raytrace.system.configurations import part, same
from raytrace.system.lens import Lens
from raytrace.system.parameter_paths import ParameterPath, parameter_paths
from raytrace.system.phases import Facets, FringePhase, Grating, Hologram, IdealLens, PolynomialPhase, RadialPhase
from raytrace.system.poses import Pose, undone
from raytrace.system.sag_terms import FringeSag, IrregularSag, PolynomialSag, TiltSag
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface

#: Keywords of the system and of a surface that are read; apertures have theirs in `apertures.SHAPES`.
SYSTEM_READ = by_word(
    {
        "read": "VERS MODE NAME NOTE UNIT GCAT ENVD GFAC RAIM FTYP PWAV MNUM ENPD FNUM OBNA FLOA XFLN YFLN FWGN XFLD"
        " YFLD FWGT FEFD SDMA OMMA VDXN VDYN VCXN VCYN VANN ZVDX ZVDY ZVCX ZVCY ZVAN VDX VDY VCX VCY VAN WAVM WAVL WAVN"
        " WWGT WWGN"
    }
)
_SURFACE_READ = by_word(
    {
        "read": "SURF TYPE CURV CONI DISZ GLAS DIAM STOP PARM COMM OBDC USAP USOB UDAD SCBD IGNR XDAT VCON VDSZ VPAR"
        " PPAR PZUP MAZH TOLE EDGE TCED MEMA OEMA"
    }
)

#: Keywords that may occur more than once in the system or in one surface.
_REPEATED = ("NOTE", "WAVM", "FEFD", "PARM", "UDAD", "XDAT", "PPAR", "VPAR", "SCBD")


#: Keywords that are known and left out, with the reason.
SYSTEM_IGNORED = by_word(
    {
        "setting of the program, independent of the lens": "PFIL LANG HYPR ROPD PICB EERA LUID IWDP STUD FSVY",
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
SURFACE_IGNORED = by_word(
    {
        "setting of the program, independent of the lens": "FIMP",
        "how the program draws it": "HIDE SCOL",
        "substrate of a mirror, for drawing": "MIRR",
        "label for the program's macros": "SLAB SSID",
        "sampling of wave propagation": "POPS",
        "coatings refract no rays": "COAT",
    }
)
TAIL_REASON = "behind the surfaces, and no line of a merit function, of tolerances or of configurations"

#: Types of surface that are not modelled, by OpticStudio's names; modelled types are rows of `types`.
_OTHER_TYPES = (
    "EGRATING elliptical grating, XOSPHERE extended odd asphere, ZERNSAG Zernike sag, "
    "SZERNSAG Zernike standard sag, SZERNPHA Zernike standard phase, POLYNOMI polynomial, BINARY_3 binary 3, "
    "BINARY_4 binary 4, QED_TYPE Q-type asphere, CFRESNEL cylindrical Fresnel, GRINSUR1 gradient index 1, "
    "GRINSUR5 gradient index 5, GRADIUM gradient index, HOLOGRM1 hologram 1, CONJUGAT conjugate, "
    "RETROREF retro-reflector, ATMOSPHR atmospheric, GRIDSAG grid sag, GRID_SAG grid sag, ALTERNAT alternate, "
    "QTYPE Q-type asphere, NONSEQCO non-sequential component, USERSURF user-defined (DLL), "
    "BIREFR_I birefringent in, BIREFR_O birefringent out, BICONIC biconic, CUBICSPL cubic spline, DATASURF data, "
    "BLACKBOX black box"
)
TYPE_NAMES = dict(name.split(" ", 1) for name in _OTHER_TYPES.split(", "))

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

#: Number of fields in the lists; an FEFD line holds a number of every list for each further field.
FIELDS_IN_LISTS = 12

#: Ray aiming by the second number of RAIM; a file without RAIM specifies none.
AIMINGS = ("off", "paraxial", "real")

#: An object at this distance or further away, in the unit of the file, is at infinity.
FAR = 1e10

#: Keywords of a surface that belong to it without indentation too: neither the system nor the lines behind the surfaces
#: have them.
_UNMISTAKABLE = by_word({"surface": "TYPE CURV DISZ GLAS CONI DIAM PARM STOP"})

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
    return source if source < block.surface else None


#: Lines of tolerances: an operand, and the comment on it.
TOLERANCES = ("TOL", "TCMM")


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

    A surface's records are indented in files of OpticStudio. Where all lines are or none is, the keyword decides.
    The merit function, tolerances and configurations after the last surface are reported by their readers.
    """
    lines, surface_read = list(records(text, file)), {*_SURFACE_READ, *aperture_keywords()}
    start = next((position for position, record in enumerate(lines, 1) if record.keyword == "SURF"), None)
    if start is None:
        hint = "is it a sequential lens file of OpticStudio (.zmx)?"
        raise LensFileError(f"no SURF line in {len(lines)} lines; {hint}", Place(file))
    system = Block(Place(file))
    surfaces: list[Block] = []
    tail: list[Record] = []
    indents = any(record.indented for record in lines[start:]) and not lines[start - 1].indented
    without_indent = _UNMISTAKABLE if indents else {*surface_read, *SURFACE_IGNORED}
    block, after_surfaces = system, False
    for record in lines:
        word = record.keyword
        if word == "SURF":
            refuse_surplus(surfaces, record.place)
            if record.integer(0, "surface number") != len(surfaces):
                message = f"SURF {shown(record.words[0])} where surface {len(surfaces)} should follow"
                raise LensFileError(f"{message}; lines lost or reordered?", record.place)
            block, after_surfaces = Block(record.place._replace(surface=len(surfaces))), False
            surfaces.append(block)
            report.met("SURF", READ, block.place)
        elif block is not system and ((indents and record.indented) or word in without_indent):
            record = record._replace(place=record.place._replace(surface=block.place.surface))
            _sort(record, block, surface_read, SURFACE_IGNORED, report)
        elif word not in SYSTEM_READ and (after_surfaces or (surfaces and word not in SYSTEM_IGNORED)):
            block, after_surfaces = system, True
            tail.append(record)
        else:
            block = system
            _sort(record, system, SYSTEM_READ, SYSTEM_IGNORED, report)
    once = {*SYSTEM_READ, *surface_read} - {*_REPEATED}
    warn_of_repeats([system, *surfaces], once.__contains__, report)
    _join_fields(system)
    return Sections(system, surfaces, tail)


def _sort(record: Record, block: Block, read: Collection[str], ignored: dict[str, str], report: Draft) -> None:
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


#: In place of a power of length: the lens holds the reciprocal of the length, and 0 for a length of 0.
INVERSE = None

#: The first XDAT that is a term.
FIRST_TERM = 3


# -- reciprocals, to the last bit -------------------------------------------------------------------------------------


def inverse(text: str, millimetres: float) -> float:
    """1/length in 1/mm of the text of a length, rounded once; 0 of a length of 0. OverflowError where it is too large.

    All digits of the text count: not every 64-bit number is the rounded reciprocal of a 64-bit number.
    """
    length = Fraction(text.replace("D", "e").replace("d", "e")) * Fraction(repr(millimetres))
    return float(1 / length) if length else 0.0


def spelled_inverse(number: float) -> str:
    """A length whose `inverse` in mm is the number: the shortest 64-bit one, or one of more digits."""
    if not number:
        return "0.0"
    text = repr(float(1 / Fraction(number)))
    return text if inverse(text, 1.0) == number else str(Context(prec=40).divide(Decimal(1), Decimal(number)))


def in_millimetres(number: float, power: int, millimetres: float) -> float:
    """A number of the file in powers of mm; of a negative power by one division, as curvatures are."""
    return number * millimetres**power if power >= 0 else number / millimetres**-power


# -- values of records: path, unit and operand ------------------------------------------------------------------------

#: Kinds of value: a number that rays depend on, a size, a number of a surface or wavelength, a yes or no, …
NUMBER, SIZE, WHOLE, SWITCH, AIMING, TEXT, GLASS = "number", "size", "whole", "switch", "aiming", "text", "glass"


class ValueRow(NamedTuple):
    """A value of a record: reader, writer, unit conversion and the multi-configuration operand follow from its row.

    argument: of the operand: "surface", "field", "wavelength", or "" of the system.
    keyword, word: the record, and the position of the value in it, from 1; 0: that of the field.
    path: of the value in its surface, or in the lens; "" where the type of the surface decides (PARM, XDAT).
    power: of length in the value; of fields, of those that are lengths. quantity: as an error calls it.
    refracts: whether the paraxial rays at other surfaces depend on it, and with them the solves there.
    """

    argument: str
    keyword: str
    word: int
    path: str
    power: int = 0
    quantity: str = "value"
    kind: str = NUMBER
    refracts: bool = False

    def path_in_lens(self, number: int) -> LensPath:
        """The path of the value of a surface, field or wavelength of this number, in a lens."""
        *steps, last = (int(step) if step.isdigit() else step for step in self.path.split("."))
        if self.argument in ("field", "wavelength"):
            return (*steps, (last, number - 1)) if isinstance(last, int) else (*steps, last, (number - 1,))
        return (*(("surfaces", number) if self.argument == "surface" else ()), *steps, last)

    def read(self, record: Record, millimetres: float = 1.0, default: float | None = None) -> float:
        """The number of a record, in powers of mm."""
        return in_millimetres(record.number(self.word - 1, self.quantity, default), self.power, millimetres)

    def write(self, holder: Surface | Lens, place: Place) -> str:
        """The number that a surface, or a lens, holds, in powers of mm; 0 where it is not modelled."""
        steps = tuple(int(step) if step.isdigit() else step for step in self.path.split("."))
        return exact(part(holder, steps), self.quantity, place)


def _field(name: str, path: str, power: int = 0) -> ValueRow:
    return ValueRow("field", FIELD_LISTS[name].keywords[0], 0, path, power, FIELD_LISTS[name].quantity)


def _poses(side: str, path: str) -> dict[str, ValueRow]:
    """Decentres and tilts of an SCBD record, CBDX … before and CADX … after the surface."""
    axes = {"DX": ("x", 1), "DY": ("y", 1), "TX": ("tilt_x", 0), "TY": ("tilt_y", 0), "TZ": ("tilt_z", 0)}
    return {
        f"C{side}{axis}": ValueRow("surface", "SCBD", word, f"{path}.{name}", power, "tilt or decentre")
        for word, (axis, (name, power)) in enumerate(axes.items(), 4)
    }


#: The values that configurations may give, by their operands.
ROWS = {
    "THIC": ValueRow("surface", "DISZ", 1, "thickness", 1, "thickness", refracts=True),
    "CRVT": ValueRow("surface", "CURV", 1, "curvature", -1, "curvature", refracts=True),
    "CONN": ValueRow("surface", "CONI", 1, "conic", 0, "conic constant"),
    "GLSS": ValueRow("surface", "GLAS", 1, "glass", kind=GLASS, refracts=True),
    "MIND": ValueRow("surface", "GLAS", 4, "glass", 0, "index nd", GLASS, refracts=True),
    "MABB": ValueRow("surface", "GLAS", 5, "glass", 0, "Abbe number Vd", GLASS),
    "MDPG": ValueRow("surface", "GLAS", 6, "glass", 0, "ΔPgF", GLASS),
    "PRAM": ValueRow("surface", "PARM", 2, ""),
    **{f"PAR{j}": ValueRow("surface", "PARM", 2, "") for j in range(1, 9)},
    "EDVA": ValueRow("surface", "XDAT", 2, ""),
    "SDIA": ValueRow("surface", "DIAM", 1, "semi_diameter", 1, "semi-diameter", SIZE),
    "APMN": ValueRow("surface", "CLAP", 1, "apertures.0.extent.0", 1, "size of the aperture", SIZE),
    "APMX": ValueRow("surface", "CLAP", 2, "apertures.0.extent.1", 1, "size of the aperture", SIZE),
    "APDX": ValueRow("surface", "OBDC", 1, "apertures.0.centre.0", 1, "decentre", SIZE),
    "APDY": ValueRow("surface", "OBDC", 2, "apertures.0.centre.1", 1, "decentre", SIZE),
    **_poses("B", "before"),
    **_poses("A", "after"),
    "TCEX": ValueRow("surface", "TCED", 1, "expansion", 0, "thermal expansion"),
    "MCOM": ValueRow("surface", "COMM", 1, "comment", kind=TEXT),
    "XFIE": _field("x", "fields.x", 1),
    "YFIE": _field("y", "fields.y", 1),
    "FLWT": _field("weight", "fields.weight"),
    **{
        f"F{name}": _field(name, f"fields.vignetting.{k}") for k, name in enumerate(("VDX", "VDY", "VCX", "VCY", "VAN"))
    },
    "WAVE": ValueRow("wavelength", "WAVM", 2, "wavelengths", 0, "wavelength", refracts=True),
    "WLWT": ValueRow("wavelength", "WAVM", 3, "wavelength_weights", 0, "weight of a wavelength"),
    "PRWV": ValueRow("", "PWAV", 1, "primary_wavelength", 0, "primary wavelength", WHOLE, refracts=True),
    "APER": ValueRow("", "ENPD", 1, "aperture.value", 1, "system aperture", refracts=True),
    "STPS": ValueRow("", "STOP", 1, "stop", 0, "stop", WHOLE, refracts=True),
    "TELE": ValueRow("", "FTYP", 2, "fields.telecentric", 0, "telecentric", SWITCH),
    "RAAM": ValueRow("", "RAIM", 2, "ray_aiming", 0, "ray aiming", AIMING),
    "TEMP": ValueRow("", "ENVD", 1, "environment.temperature", 0, "temperature", refracts=True),
    "PRES": ValueRow("", "ENVD", 2, "environment.pressure", 0, "pressure", refracts=True),
    "LTTL": ValueRow("", "NAME", 1, "name", kind=TEXT),
}

#: The keywords of sizes of the part, by the field of a surface.
MECHANICAL = {"chip_zone": "OEMA", "mechanical_semi_diameter": "MEMA"}


def _powers() -> dict[str, dict[int, int]]:
    """The powers of length of the rows, and those of words without an operand."""
    powers: dict[str, dict[int, int]] = {"SDMA": {3: 1}, "VDSZ": {1: 1, 2: 1}, "PZUP": {3: 1}, "UDAD": {2: 1, 3: 1}}
    powers |= {keyword: {1: 1} for keyword in MECHANICAL.values()}
    for row in ROWS.values():
        if row.power and row.argument != "field":
            powers.setdefault(row.keyword, {})[row.word] = row.power
    return powers


#: Powers of length of the words of a line, from 1, by its keyword; others have none. Apertures have their sizes first.
POWERS = _powers()


def measured(record: Record, position: int, quantity: str, millimetres: float, default: float | None = None) -> float:
    """The number of a record at a position, in powers of mm."""
    shape, _ = aperture_keywords().get(record.keyword, ("", False))
    is_size = bool(shape) and position < (SHAPES[shape].sizes or 0)
    power = 1 if is_size else POWERS.get(record.keyword, {}).get(position + 1, 0)
    return in_millimetres(record.number(position, quantity, default), power, millimetres)


# -- the rows of the types --------------------------------------------------------------------------------------------


class Numbers(NamedTuple):
    """PARM by number, and the terms of XDAT with their radius of normalisation; lengths in mm.

    size: the surface's semi-diameter.
    """

    parameters: Mapping[int, Number]
    terms: Tensor | None = None
    radius: Number = 1.0
    size: float | None = None

    @property
    def has_terms(self) -> bool:
        """Whether one of the terms is not 0."""
        return self.terms is not None and bool(self.terms.any())

    def at(self, j: int) -> Number:
        """PARM j, 0 if it is absent."""
        return self.parameters.get(j, 0.0)


def _place(path: str) -> ParameterPath:
    """The place of "phase.power_x", "coefficients.0" or "phase.first.2" in a surface."""
    *fields, last = path.split(".")
    return ParameterPath(tuple(fields), int(last)) if last.isdigit() else ParameterPath((*fields, last))


class Parameter(NamedTuple):
    """A PARM: its place in the surface, and the power of length in it.

    is_integer: a switch, which is no variable. followers: further places that hold factor times the number.
    """

    place: ParameterPath
    power: int | None = 0
    is_integer: bool = False
    followers: Mapping[ParameterPath, float] = {}


@dataclasses.dataclass(frozen=True)
class SurfaceType:
    """A TYPE.

    name: OpticStudio's name; holds: fields of a surface's shape that the type has.
    parameters: the PARM that are used; unused: PARM that are known and change no ray, with the reason.
    kind: of the coefficients, a key of KINDS; least: how many of them are modelled even if 0, None: as many as given.
    part: class of the added sag terms or phase. amplitudes: PARM that are all 0 where the sag terms vanish.
    terms: power of length in the terms of XDAT, None if the type has none; most: their maximum number.
    objection: numbers -> why they are out of range, or ""; beyond: numbers -> the feature that is not modelled, or "".
    is_break: whether the type is a coordinate break; flat: whether a curvature is not modelled.
    powers: the powers of r of the parameters, in words.
    """

    name: str
    holds: tuple[str, ...] = ("curvature", "conic")
    parameters: Mapping[int, Parameter] = dataclasses.field(default_factory=dict)
    unused: Mapping[int, str] = dataclasses.field(default_factory=dict)
    kind: str = EVEN
    least: int | None = 0
    part: type | None = None
    amplitudes: tuple[int, ...] = ()
    terms: int | None = None
    most: int = 0
    objection: Callable[[Numbers], str] = lambda numbers: ""
    beyond: Callable[[Numbers], str] = lambda numbers: ""
    is_break: bool = False
    flat: bool = False
    powers: str = ""

    @property
    def terms_are_coefficients(self) -> bool:
        """Whether the terms of XDAT are those of r², r⁴, …; the terms of a toroid are not modelled."""
        return self.terms is not None and self.part is None and not self.parameters

    def fields(self, numbers: Numbers) -> dict:
        """The fields of `Surface`. Raises ValueError for numbers out of range."""
        if objection := self.objection(numbers):
            raise ValueError(objection)
        values: dict[str, dict] = {"coefficients": {}, "sag_terms": {}, "phase": {}, "before": {}}
        for j, parameter in self.parameters.items():
            number = numbers.at(j)
            for place in (parameter.place, *parameter.followers):
                owner = values.get(place.path[0], {})  # "after" is the inverse of "before"
                if place.entry is not None:
                    owner.setdefault(place.path[-1], []).append(number)
                else:
                    owner[place.path[-1]] = int(number) if parameter.is_integer else number
        tilts_first = bool(values["before"].pop("tilts_first", 0))
        pose = pose_of(values["before"], tilts_first=tilts_first)
        fields = {"is_break": True, "before": pose} if self.is_break else {}
        if pose is not None and not self.is_break:
            fields |= {"before": pose, "after": undone(pose)}
        return (
            fields
            | self._coefficients(values["coefficients"].get("coefficients", []), numbers)
            | self._part(values["sag_terms"] | values["phase"], numbers)
        )

    def _coefficients(self, coefficients: list[float], numbers: Numbers) -> dict:
        if self.terms_are_coefficients and numbers.terms is not None:  # a_i = α_i / R^2i
            coefficients = [α / numbers.radius ** (2 * i) for i, α in enumerate(numbers.terms.tolist(), 1)]
        if self.least is None:
            count = max(numbers.parameters, default=len(coefficients))
        else:
            count = max([self.least, *(k for k, number in enumerate(coefficients, 1) if number)])
        return {"kind": self.kind, "coefficients": double(coefficients[:count])} if coefficients[:count] else {}

    def _part(self, values: dict, numbers: Numbers) -> dict:
        has_terms = numbers.terms is not None and len(numbers.terms) > 0
        if self.part is None or (
            "phase" not in self.holds and not has_terms and not any(map(numbers.at, self.amplitudes))
        ):
            return {}
        values = {name: number if isinstance(number, int) else double(number) for name, number in values.items()}
        if self.terms is not None:
            values |= {"coefficients": numbers.terms if has_terms else double([0.0]), "radius": double(numbers.radius)}
        if self.part is IrregularSag and numbers.size is not None:
            values["radius"] = double(numbers.size)
        return {"phase" if "phase" in self.holds else "sag_terms": self.part(**values)}

    def numbers(self, surface: Surface) -> Numbers:
        """`fields` inverted. Raises ValueError for numbers that the type cannot hold."""
        sag, pose = surface.sag_terms, surface.pose
        parameters: dict[int, Number] = {}
        if self.is_break and pose is not None and pose.z is not None:
            raise ValueError("a decentre along z; add it to the thickness before")
        if isinstance(sag, IrregularSag):
            if surface.semi_diameter is None or float(sag.radius) != surface.semi_diameter:
                radii = f"a radius of {float(sag.radius)!r} mm and a semi-diameter of {surface.semi_diameter!r}"
                raise ValueError(f"an irregular surface with {radii}: the file has one number for both")
            pose = pose if poses_are_parameters(surface) else None
        for j, parameter in self.parameters.items():
            owner, *name = parameter.place.path
            value: Any = pose if owner == "before" else getattr(surface, owner)
            for step in name:
                value = 0.0 if value is None else getattr(value, step)
            value = 0.0 if value is None and owner == "before" else value
            if parameter.place.entry is not None:
                if value is None or parameter.place.entry >= len(value):
                    continue
                value = value[parameter.place.entry]
            parameters[j] = float(value) if parameter.is_integer else value
        if self.terms is None or not (self.part or self.terms_are_coefficients):
            return Numbers(parameters)
        held: Any = surface if self.part is None else surface.phase or sag
        return Numbers(parameters, held.coefficients, 1.0 if self.part is None else held.radius)

    def places(
        self, surface: Surface, numbers: Numbers, keyword: str, j: int
    ) -> tuple[dict[ParameterPath, float], Surface]:
        """The paths in a surface that PARM j, or XDAT j, gives, each with its factor; and a surface that models them.

        The lens holds factor times the number of the file in mm. Empty for a switch, and for numbers that the surface
        does not model.
        """
        modelled = 0.34375  # any number other than 0
        if keyword == "PARM" and j in self.parameters:
            parameter, numbers = self.parameters[j], numbers._replace(parameters={**numbers.parameters, j: modelled})
            factors = {} if parameter.is_integer else {parameter.place: 1.0, **parameter.followers}
        elif keyword == "XDAT" and numbers.terms is not None and 0 <= j - FIRST_TERM < len(numbers.terms):
            entry, terms = j - FIRST_TERM, numbers.terms.clone()
            terms[entry] = modelled
            numbers = numbers._replace(terms=terms)
            owner = "phase" if "phase" in self.holds else "sag_terms"
            factors = {ParameterPath((owner, "coefficients"), entry): 1.0} if self.part else {}
            if self.terms_are_coefficients:
                factors = {ParameterPath(("coefficients",), entry): float(numbers.radius) ** (-2 * (entry + 1))}
        elif keyword == "XDAT" and j == 2 and self.part is not None and numbers.terms is not None:
            factors = {ParameterPath(("phase" if "phase" in self.holds else "sag_terms", "radius")): 1.0}
        else:
            return {}, surface
        try:
            like = dataclasses.replace(surface, **self.fields(numbers))
        except ValueError:
            return {}, surface
        held = parameter_paths(like).values()
        return {place: factor for place, factor in factors.items() if place in held}, like

    def names(self, surface: Surface, numbers: Numbers, keyword: str, j: int) -> tuple[dict[str, float], Surface]:
        """`places` by the names of the numbers; without the radius that normalises terms, which is no variable."""
        factors, like = self.places(surface, numbers, keyword, j)
        names = {place: name for name, place in parameter_paths(like).items()}
        is_number = keyword == "PARM" or j >= FIRST_TERM
        return {names[place]: factor for place, factor in factors.items() if is_number}, like

    def named(self, surface: Surface, numbers: Numbers) -> dict[str, tuple[str, int, Surface]]:
        """PARM or XDAT of every number of the lens that the type gives, by its name, and a surface that models it."""
        terms = 0 if numbers.terms is None else len(numbers.terms)
        by_name: dict[str, tuple[str, int, Surface]] = {}
        for keyword, j in (*(("PARM", j) for j in self.parameters), *(("XDAT", FIRST_TERM + k) for k in range(terms))):
            names, like = self.names(surface, numbers, keyword, j)
            for name in names:
                by_name.setdefault(name, (keyword, j, like))
        return by_name

    def power(self, keyword: str, j: int) -> int | None:
        """The power of length in PARM j, or in XDAT j."""
        if keyword == "XDAT":
            return {1: 0, 2: 1}.get(j, self.terms or 0)
        return self.parameters[j].power if j in self.parameters else 0


def _parameters(first: int, *rows: tuple) -> dict[int, Parameter]:
    """PARM from `first` on, a row each: its place, then as the fields of `Parameter`, followers by their places."""
    parameters = {}
    for j, (path, *more) in enumerate(rows, first):
        power, followers = more[0] if more else 0, more[1] if len(more) > 1 else {}
        places = {_place(follower): factor for follower, factor in followers.items()}
        parameters[j] = Parameter(_place(path), power if power != "switch" else 0, power == "switch", places)
    return parameters


def _coefficients(first: int, powers: Sequence[int | None]) -> dict[int, Parameter]:
    """PARM that are coefficients, from `first` on, by the power of length of each."""
    return _parameters(first, *((f"coefficients.{k}", power) for k, power in enumerate(powers)))


_ROUND = ("curvature", "conic", "coefficients")
_EVEN = _coefficients(1, [1 - 2 * j for j in range(1, 9)])
_POLARISATION = dict.fromkeys(range(1, 9), "polarisation; its plane refracts as any other")


def _unknown_mode(number: float) -> str:
    return "" if number in (0, 1, 2, 3) else f"an OPD mode of {number:g}, expected 0, 1, 2 or 3"


def _unsized(numbers: Numbers) -> str:
    if numbers.size is None and any(map(numbers.at, (5, 6, 7))):
        return "no semi-diameter (DIAM), by which the terms of an irregular surface are normalised"
    return ""


def _no_focal_length(numbers: Numbers) -> str:
    missing = "a focal length of 0 (PARM 1), expected one in the file's unit of length"
    return _unknown_mode(numbers.at(2)) if numbers.at(1) else missing


def _no_order(numbers: Numbers) -> str:
    is_missing = 0 not in numbers.parameters and numbers.has_terms
    return "no order of diffraction (PARM 0); lines lost?" if is_missing else ""


def _no_construction(numbers: Numbers) -> str:
    if not any(map(numbers.at, (1, 2, 3))) or not any(map(numbers.at, (4, 5, 6))):
        return "a construction point at the vertex (PARM 1 to 3, or 4 to 6), expected one away from it"
    if numbers.at(7) <= 0:
        return f"a construction wavelength of {numbers.at(7):g} µm (PARM 7), expected a positive one"
    return ""


@functools.cache
def _round(name: str) -> SurfaceType:
    """The type of a kind of rotationally symmetric terms: PARM j is a_j; without any it has as many zeros."""
    kind = KINDS[name]
    powers = [1 - kind.step * j for j in range(1, kind.parameters + 1)]
    return SurfaceType(name, _ROUND, _coefficients(1, powers), kind=name, least=None, powers=kind.powers)


def _diffractive(name: str, phase: type, most: int) -> SurfaceType:
    """A phase of coefficients, radius and order (PARM 0), with even terms."""
    parameters = _parameters(0, ("phase.order",)) | _EVEN
    return SurfaceType(name, (*_ROUND, "phase"), parameters, part=phase, terms=0, most=most, objection=_no_order)


#: The types that are modelled, but those of rotationally symmetric terms, which have their rows in KINDS.
_TYPES = {
    "STANDARD": SurfaceType("standard"),
    "XASPHERE": SurfaceType("extended asphere", _ROUND, least=None, terms=1, most=240),
    "TILTSURF": SurfaceType(
        "tilted",
        ("sag_terms",),
        _parameters(1, ("sag_terms.tan_x",), ("sag_terms.tan_y",)),
        part=TiltSag,
        amplitudes=(1, 2),
    ),
    "TOROIDAL": SurfaceType(
        "toroidal",
        _ROUND,
        _coefficients(1, [INVERSE, *(3 - 2 * j for j in range(2, 9))]),
        kind="toroidal",
        least=1,
        terms=1,
        most=240,
        beyond=lambda numbers: "with Zernike terms (XDAT 1)" if numbers.has_terms else "",
    ),
    "BICONICX": SurfaceType("biconic", _ROUND, _coefficients(1, [INVERSE, 0]), kind="biconic", least=2),
    "XPOLYNOM": SurfaceType(
        "extended polynomial", ("curvature", "conic", "sag_terms"), part=PolynomialSag, terms=1, most=230
    ),
    "FZERNSAG": SurfaceType(
        "Zernike fringe sag",
        (*_ROUND, "sag_terms"),
        _EVEN | _parameters(9, ("sag_terms.centre_x", 1), ("sag_terms.centre_y", 1)),
        unused={0: "whether the sag ends with its terms' disc; it continues"},
        part=FringeSag,
        terms=1,
        most=37,
    ),
    "IRREGULA": SurfaceType(
        "irregular",
        ("curvature", "conic", "sag_terms"),
        _parameters(
            1,
            ("before.x", 1, {"after.x": -1.0}),
            ("before.y", 1, {"after.y": -1.0}),
            ("before.tilt_x", 0, {"after.tilt_x": -1.0}),
            ("before.tilt_y", 0, {"after.tilt_y": -1.0}),
            *(("sag_terms.spherical", 1), ("sag_terms.astigmatism", 1), ("sag_terms.coma", 1), ("sag_terms.angle",)),
        ),
        part=IrregularSag,
        amplitudes=(5, 6, 7),
        objection=_unsized,
    ),
    "COORDBRK": SurfaceType(
        "coordinate break",
        (),
        _parameters(
            1,
            *(("before.x", 1), ("before.y", 1), ("before.tilt_x",), ("before.tilt_y",), ("before.tilt_z",)),
            ("before.tilts_first", "switch"),
        ),
        beyond=lambda n: "" if n.at(6) in (0, 1) else f"of order {n.at(6):g} (PARM 6; 0 and 1 are known)",
        is_break=True,
    ),
    "DGRATING": SurfaceType(
        "diffraction grating",
        ("curvature", "conic", "phase"),
        _parameters(1, ("phase.frequency",), ("phase.order",)),
        part=Grating,
    ),
    "PARAXIAL": SurfaceType(
        "paraxial lens",
        ("phase",),
        _parameters(1, ("phase.power_x", INVERSE, {"phase.power_y": 1.0}), ("phase.opd_mode", "switch")),
        part=IdealLens,
        objection=_no_focal_length,
    ),
    "PARAX_XY": SurfaceType(
        "paraxial XY",
        ("phase",),
        _parameters(1, ("phase.power_x", -1), ("phase.power_y", -1), ("phase.opd_mode", "switch")),
        part=IdealLens,
        objection=lambda numbers: _unknown_mode(numbers.at(3)),
    ),
    "BINARY_1": _diffractive("binary 1", PolynomialPhase, 230),
    "BINARY_2": _diffractive("binary 2", RadialPhase, 240),
    "FZERNPHA": _diffractive("Zernike fringe phase", FringePhase, 37),
    "HOLOGRM2": SurfaceType(
        "hologram 2",
        ("phase",),
        _parameters(
            1,
            *((f"phase.{beam}.{k}", 1) for beam in ("first", "second") for k in range(3)),
            *(("phase.wavelength",), ("phase.order",)),
        ),
        part=Hologram,
        objection=_no_construction,
        flat=True,
    ),
    "FRESNELS": SurfaceType("Fresnel", (*_ROUND, "phase"), _EVEN, part=Facets),
    "JONESMAT": SurfaceType("Jones matrix", (), unused=_POLARISATION),
}


def types() -> dict[str, SurfaceType]:
    """Every type that is modelled, STANDARD first."""
    symmetric = {kind.zemax: _round(kind.name) for kind in KINDS.values() if kind.zemax and kind.form is None}
    return {"STANDARD": _TYPES["STANDARD"], **symmetric, **_TYPES}


#: TYPE by the class of the sag terms or the phase of a surface; a kind of coefficients has its own in KINDS.
_OF_PARTS = {row.part: kind for kind, row in _TYPES.items() if row.part is not None and kind != "PARAXIAL"}


def type_of(surface: Surface) -> str | None:
    """The TYPE that a surface is written as; None where a .zmx file has none."""
    if surface.is_break:
        return "COORDBRK"
    if (phase := surface.phase) is not None:
        if isinstance(phase, IdealLens) and phase.power_x.dim() == 0:
            return "PARAXIAL" if float(phase.power_x) == float(phase.power_y) != 0 else "PARAX_XY"
        return _OF_PARTS.get(type(phase))
    if surface.sag_terms is not None:
        return _OF_PARTS.get(type(surface.sag_terms))
    if surface.coefficients is None:
        return "STANDARD"
    kind = KINDS[surface.kind]
    return "XASPHERE" if surface.kind == EVEN and len(surface.coefficients) > kind.parameters else kind.zemax


# -- poses ------------------------------------------------------------------------------------------------------------


def poses_are_parameters(surface: Surface) -> bool:
    """Whether an irregular surface has a pose that its parameters hold, and that is undone behind the surface."""
    before, after = surface.pose, surface.after
    if not isinstance(surface.sag_terms, IrregularSag) or before is None or after is None:
        return False
    return not before.tilts_first and before.z is None and before.tilt_z is None and same(undone(before), after)


_POSE = tuple(_poses("B", "before").values())


def poses(block: Block, millimetres: float) -> dict[str, Pose | None]:
    """The fields "before" and "after" of SCBD records, where they are not 0.

    SCBD w o p dx dy tx ty tz: w 1 before, 2 after the surface; o the order, as of a coordinate break; p the method that
    found the numbers, which are stored. SCBD 3 marks a coordinate return. Raises UnsupportedSurface for others.
    """
    fields = {}
    for record in block.all("SCBD"):
        where = record.integer(0, "side of the tilt", 0)
        numbers = {row.path.rpartition(".")[2]: row.read(record, millimetres, 0.0) for row in _POSE}
        if where == 3 or not any(numbers.values()):
            continue
        order = record.number(1, "order")
        if where not in (1, 2) or order not in (0, 1):
            message = f"tilt or decentre of the surface (SCBD {where:g} of order {order:g}) is not modelled"
            raise UnsupportedSurface(f"{message}; known are SCBD 1 and 2 of order 0 and 1", record.place)
        fields["before" if where == 1 else "after"] = pose_of(numbers, tilts_first=order == 1)
    return fields


# -- PARM and XDAT of a surface ---------------------------------------------------------------------------------------


def numbers_of(block: Block, row: SurfaceType, millimetres: float) -> Numbers:
    """The numbers of a surface of a type, in mm; nothing of it is reported."""
    parameters = {}
    for record in block.all("PARM"):
        j, value = record.integer(0, "number of the parameter"), record.number(1, "value")
        if j not in row.parameters:
            continue
        power = row.parameters[j].power
        try:
            if power is INVERSE:
                parameters[j] = inverse(record.words[1], millimetres) if value else 0.0
            else:
                parameters[j] = in_millimetres(value, power, millimetres)
        except OverflowError as error:
            message = f"PARM {record.words[0]} is {shown(record.words[1])}, too small a length"
            raise LensFileError(message, record.place) from error
    size = semi_diameter(block, millimetres)
    if row.terms is None:
        return Numbers(parameters, size=size)
    data = {record.integer(0, "number of the datum"): record for record in block.all("XDAT")}
    count = term_count(block, row)
    if not count:
        return Numbers(parameters, double([]), size=size)
    if 2 not in data:
        raise LensFileError("no XDAT 2, the radius that the terms are normalised by; lines lost?", block.place)
    radius = data[2].number(1, "radius of normalisation")
    if radius <= 0:
        message = f"XDAT 2 is {shown(data[2].words[1])}: the radius of normalisation, expected a positive length"
        raise LensFileError(message, data[2].place)
    values = [data[j].number(1, "value") if j in data else 0.0 for j in range(FIRST_TERM, FIRST_TERM + count)]
    terms = [in_millimetres(value, row.terms, millimetres) for value in values]
    return Numbers(parameters, double(terms), radius * millimetres, size)


def term_count(block: Block, row: SurfaceType) -> int:
    """XDAT 1, the number of terms."""
    records = [record for record in block.all("XDAT") if record.integer(0, "number of the datum") == 1]
    count = records[-1].integer(1, "number of terms") if records else 0
    if not 0 <= count <= row.most:
        message = f"XDAT 1 is {shown(records[-1].words[1])}: the number of terms of a surface that is {row.name}"
        raise LensFileError(f"{message}, expected 0 to {row.most}", records[-1].place)
    return count


def _report_unused(block: Block, kind: str, row: SurfaceType, report: Draft) -> None:
    """Report the numbers other than 0 that a surface of this type does not use, with the reason where it is known."""
    for record in block.all("PARM"):
        j = record.integer(0, "number of the parameter")
        if j in row.parameters or not record.number(1, "value"):
            continue
        if j in row.unused:
            report.note(f"{record.place}: PARM {j} of a {kind} surface is not used: {row.unused[j]}")
        elif row.parameters or row.unused:
            first, *_, last = sorted(row.parameters or row.unused) * 2
            article = "an" if kind[0] in "AEIOU" else "a"
            message = f"PARM {j}: {article} {kind} has parameters {first} to {last}{row.powers}; left out"
            report.warn(message, record.place)
        else:
            report.note(f"{record.place}: PARM {j} is not used by a {kind} surface")
    end = FIRST_TERM + term_count(block, row) if row.terms is not None else 0
    for record in block.all("XDAT"):
        j = record.integer(0, "number of the datum")
        if row.terms is None and record.number(1, "value"):
            report.note(f"{record.place}: XDAT {j} is not used by a {kind} surface")
        elif row.terms is not None and j >= end and j > 2 and record.number(1, "value"):
            report.warn(f"XDAT {j}: XDAT 1 states {end - FIRST_TERM} terms, to XDAT {end - 1}; left out", record.place)
    for keyword, name in (("CURV", "curvature"), ("CONI", "conic")):
        stored = block.last(keyword)
        if stored and name not in row.holds and stored.number(0, name):
            report.note(f"{stored.place}: {keyword} is not used by a {kind} surface")
    for record in block.all("SCBD"):
        if record.words[:1] == ("3",) and record.integer(1, "kind of coordinate return", 0) > 0:
            report.note(f"{record.place}: coordinate return; its solved values, which the file stores, are read")


# -- types that are not modelled --------------------------------------------------------------------------------------


def refuse_unsupported(blocks: Sequence[Block]) -> None:
    """Raise UnsupportedSurface for the first surface that is not modelled, and list the others."""
    last = len(blocks) - 1
    refused = [(block, reason) for k, block in enumerate(blocks) if (reason := _unsupported(block, k in (0, last)))]
    if not refused:
        return
    block, reason = refused[0]
    record = block.last("TYPE", "SURF")
    others = [f"{other.place.surface} ({why.split()[1]})" for other, why in refused[1:7]]
    more = " …" if len(refused) > 7 else ""
    also = f"; neither are surfaces {', '.join(others)}{more}" if others else ""
    message = f"{reason} is not modelled{also}; modelled are {_modelled()}"
    raise UnsupportedSurface(message, record.place if record else block.place)


def _unsupported(block: Block, at_end: bool) -> str:
    """Why a surface is not modelled; at_end: whether it is the object or the image."""
    kind = type_name(block)
    row = types().get(kind)
    if row is None:
        return f"type {kind[:40]}" + (f" ({TYPE_NAMES[kind]})" if kind in TYPE_NAMES else "")
    ignored = block.last("IGNR")
    if ignored and ignored.words[:1] not in ((), ("0",)):
        return f"type {kind} marked as to be ignored (IGNR)"
    if at_end and (row.is_break or "phase" in row.holds):
        return f"type {kind} ({row.name}) of the object or the image"
    posed = any(poses(block, 1.0).values())
    if block.place.surface == 0 and posed:
        return f"type {kind} of the object with a tilt or decentre of the surface (SCBD)"
    if row.is_break and posed:
        return f"type {kind} ({row.name}) with a tilt or decentre of the surface (SCBD)"
    if row.flat and any(_nonzero(block, held, 1.0) is not None for held in _SHAPES.values()):
        return f"type {kind} ({row.name}) on a curved surface (CURV)"
    numbers = numbers_of(block, row, 1.0)
    if kind == "IRREGULA" and any(map(numbers.at, (1, 2, 3, 4))) and posed:
        return f"type {kind} ({row.name}) with tilts of its own (PARM 1 to 4) and of the surface (SCBD)"
    beyond = row.beyond(numbers)
    return f"type {kind} ({row.name}) {beyond}" if beyond else ""


def type_name(block: Block) -> str:
    """The TYPE of a surface, STANDARD where it has none.

    Some programs write the terms of an XASPHERE as those of an EVENASPH, which it then is.
    """
    record = block.last("TYPE")
    if record is None:
        return "STANDARD"
    if not record.words:
        raise LensFileError(f"TYPE without a name; expected {_modelled()}", record.place)
    kind = record.words[0].upper()
    held = {keyword: any(entry.number(1, "value") for entry in block.all(keyword)) for keyword in ("PARM", "XDAT")}
    return "EVENASPH" if kind == "XASPHERE" and held["PARM"] and not held["XDAT"] else kind


def _modelled() -> str:
    *first, last = types()
    return f"{', '.join(first)} and {last}"


# -- a surface --------------------------------------------------------------------------------------------------------


def build(
    block: Block,
    millimetres: float,
    blocks: Sequence[Block],
    *,
    catalogs: Sequence[str | Catalog],
    user: Sequence[Path],
    report: Draft,
) -> Surface:
    """The surface of a block, its lengths in units of `millimetres`.

    blocks: all surfaces of the file, from which a glass may be picked up.
    GLAS names are looked up in `catalogs`, then `user` files; raises UnknownGlass as `find_glass` does.
    """
    thickness = block.last("DISZ")
    if thickness is None:
        raise LensFileError("surface has no DISZ (thickness): file cut off? A plane image has DISZ 0", block.place)
    word = thickness.words[0] if thickness.words else ""
    is_far = block.place.surface == 0 and is_number(word) and plain(word) >= FAR
    if is_infinite(word) or is_far:
        if block.place.surface != 0 or word.startswith("-"):
            raise LensFileError(f"DISZ is {shown(word)}; only the object may be at infinity", thickness.place)
        distance = float("inf")
    else:
        distance = ROWS["THIC"].read(thickness, millimetres)
    kind = type_name(block)
    row = types()[kind]
    fields: dict[str, Any] = {}
    if "curvature" in row.holds:
        fields |= {field: _nonzero(block, held, millimetres) for field, held in _SHAPES.items()}
    if row.is_break:
        for keyword in ("GLAS", *aperture_keywords()):
            record = block.last(keyword)
            if record and (keyword != "GLAS" or record.words[:1] != ("AIR",)):
                message = f"{keyword} on a coordinate break is not used: the medium stays, and nothing clips"
                report.warn(message, record.place)
    else:
        fields["glass"] = _medium(block, blocks, catalogs, user, report)
        fields["apertures"] = _apertures(block, millimetres, report)
    numbers, marked = numbers_of(block, row, millimetres), block.last("TYPE", "SURF")
    if marked and marked.words[0].upper() == "XASPHERE" and kind == "EVENASPH":
        report.warn("an XASPHERE without XDAT: PARM 1 to 8 are taken as its terms of r², r⁴, …", marked.place)
    try:
        fields |= poses(block, millimetres) | row.fields(numbers)
    except ValueError as error:
        if isinstance(error, LensFileError):
            raise
        raise LensFileError(str(error), marked.place if marked else block.place) from error
    _report_unused(block, kind, row, report)
    comment, stated = block.last("COMM"), block.last("TCED")
    return Surface(
        thickness=double(distance),
        semi_diameter=numbers.size,
        chip_zone=_part_size(block, "OEMA", millimetres),
        mechanical_semi_diameter=_part_size(block, "MEMA", millimetres)
        if block.integer("MEMA", "code", 0, 1)
        else None,
        comment=comment.text.strip() if comment else "",
        expansion=double(ROWS["TCEX"].read(stated)) if stated else None,
        **fields,
    )


#: Curvature and conic constant, by the field of a surface.
_SHAPES = {row.path: row for row in (ROWS["CRVT"], ROWS["CONN"])}


def _nonzero(block: Block, row: ValueRow, millimetres: float) -> Tensor | None:
    record = block.last(row.keyword)
    return nonzero(row.read(record, millimetres)) if record else None


def semi_diameter(block: Block, millimetres: float) -> float | None:
    """DIAM, which is a semi-diameter, in mm; None if absent or 0 (left to be computed)."""
    record = block.last("DIAM")
    size = ROWS["SDIA"].read(record, millimetres) if record and record.words else 0.0
    if record and size < 0:
        raise LensFileError(f"DIAM is {shown(record.words[0])}, expected a semi-diameter of 0 or more", record.place)
    return size or None


def _part_size(block: Block, keyword: str, millimetres: float) -> float | None:
    """A size of the part in mm; None where it is absent or 0."""
    record = block.last(keyword)
    size = measured(record, 0, "size of the part", millimetres) if record and record.words else 0.0
    if record and size < 0:
        raise LensFileError(f"{keyword} is {shown(record.words[0])}, expected a length of 0 or more", record.place)
    return size or None


def _picked_up(block: Block, blocks: Sequence[Block], report: Draft) -> Record | None:
    """The GLAS record of the medium of a surface: its own, or that of the surface it is picked up from; None is air.

    A file stores the name of a glass that is picked up, but no indices of air or of a model glass: those in the line
    are obsolete.
    """
    record, source = block.last("GLAS"), glass_source(block)
    if record is None or source is None:
        return record
    held = _picked_up(blocks[source], blocks, report)
    name = record.words[0].upper()
    if held is not None and held.words[:1] and held.words[0].upper() == name:
        return held._replace(place=record.place)
    if is_blank(record):
        medium = held.words[0] if held is not None and held.words else "air"
        report.note(f"surface {block.place.surface}: the medium, {medium}, is picked up from surface {source}")
        return held and held._replace(place=record.place)
    message = f"GLAS {name[:40]} is a pickup from surface {source}, which has {held.words[0] if held else 'air'}"
    report.warn(f"{message}; {name[:40]} is taken", record.place)
    return record


def _medium(
    block: Block, blocks: Sequence[Block], catalogs: Sequence[str | Catalog], user: Sequence[Path], report: Draft
) -> Glass:
    record = _picked_up(block, blocks, report)
    return AIR if record is None else medium(record, catalogs, user, report)


def medium(record: Record, catalogs: Sequence[str | Catalog], user: Sequence[Path], report: Draft) -> Glass:
    """The medium of a GLAS record: name, flag (0 catalog, 1 model, 2 pickup, 3 substitute), -, nd, Vd, ΔPgF.

    The columns after the name are placeholders unless the flag says model glass or the name is ___BLANK.
    """
    if not record.words:
        raise LensFileError("GLAS without a name; delete the line for air", record.place)
    name = record.words[0]
    if name.upper() in ("AIR", "MIRROR"):
        return AIR if name.upper() == "AIR" else MIRROR
    if is_blank(record) or record.integer(1, "flag", 0) == 1:
        name = "" if is_blank(record) else name
        nd, vd = record.number(3, "index nd"), record.number(4, "Abbe number Vd", 0.0)
        dpgf = record.number(5, "ΔPgF", 0.0)
        if nd <= 0 or vd < 0:
            raise LensFileError(f"model glass of nd {nd:g}, Vd {vd:g}; expected nd > 0 and Vd ≥ 0", record.place)
        report.glass(record.place, name, f"model glass nd {nd!r}, Vd {vd!r}, ΔPgF {dpgf!r}")
        return by_figures(nd, vd, dpgf, name)
    if is_code(name):
        report.glass(record.place, name, "six-digit code: nd and Vd by its digits")
        return mil_glass(name)
    nd, vd = (record.number(k, "index or Abbe number of the glass", 0.0) for k in (3, 4))
    figures = (nd, vd) if nd > 1 and vd > 0 and (nd, vd) != (1.5, 40.0) else None  # 1.5 and 40 are placeholders
    return listed_glass(name, catalogs=catalogs, user=user, place=record.place, report=report, figures=figures)


def _apertures(block: Block, millimetres: float, report: Draft) -> tuple[Aperture, ...]:
    """The aperture of a surface; OpticStudio has one per surface.

    A floating aperture (FLAP) follows the semi-diameter of its surface: it clips at DIAM.
    """
    records = block.all(*aperture_keywords())
    if not records:
        return ()
    record = records[-1]
    if len({other.keyword for other in records}) > 1:
        names = ", ".join(other.keyword for other in records)
        report.warn(f"several apertures on one surface ({names}); the last is used", record.place)
    shape, obscures = aperture_keywords()[record.keyword]
    count = SHAPES[shape].sizes
    if count is None:
        sizes = _corners(block.all("UDAD"), millimetres)
        if not sizes:
            message = f"user-defined aperture ({record.keyword}) is not of polygons (UDAD): it blocks no ray"
            report.warn(message, record.place)
            return ()
    else:
        sizes = tuple(measured(record, k, "size of the aperture", millimetres) for k in range(count))
    if record.keyword == "FLAP":
        sizes = 0.0, semi_diameter(block, millimetres) or sizes[1]
    decentre = block.last("OBDC")
    centre = tuple(ROWS[name].read(decentre, millimetres) for name in ("APDX", "APDY")) if decentre else (0.0, 0.0)
    return (clear_aperture(shape, sizes, obscures, centre, record.keyword, record.place),)


def _corners(records: Sequence[Record], millimetres: float) -> tuple[float, ...]:
    """x and y of the corners of polygons, each closed by its first corner; none for other elements, as arcs.

    UDAD k x y 0: line 0 names a file, and 0 0 0 ends a polygon.
    """
    corners: list[float] = []
    polygon: list[float] = []
    for record in (*(record for record in records if record.integer(0, "number of the point") > 0), None):
        x, y, other = (
            (measured(record, k, "point of the aperture", millimetres, 0.0) for k in (1, 2, 3)) if record else (0, 0, 0)
        )
        if other:
            return ()
        if (x, y) != (0, 0):
            polygon += [x, y]
        elif polygon:
            corners += [*polygon, *polygon[:2]]
            polygon = []
    return tuple(corners)
