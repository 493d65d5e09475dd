"""The commands of a CODE V sequence (.seq), a row each, and a text sorted by them: the system and the surfaces.

A sequence is a stream of commands: `;` separates two of them on a line, `&` at the end of a line continues it in the
next, `!` begins a comment, texts are in ' or ". A command has three letters, in either case; it may be followed by its
object: a surface (SO, SI, Sk), a field (Fk), a wavelength (Wk), a zoom position (Zk).
"""

import itertools
import re
from collections.abc import Iterator
from fractions import Fraction

from raytrace.io.assembly import BENT, RETURNED, REVERSED
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
    is_number,
    plain,
    refuse_surplus,
    shown,
)

#: Commands of x and y of the field points, by the kind of field.
FIELD_KINDS = {
    "angle": ("XAN", "YAN"),
    "object_height": ("XOB", "YOB"),
    "paraxial_image_height": ("XIM", "YIM"),
    "real_image_height": ("XRI", "YRI"),
}

#: Commands of the system aperture, by its kind.
SYSTEM_APERTURES = {"entrance_pupil_diameter": "EPD", "image_f_number": "FNO", "object_na": "NAO"}

#: An object at this distance or further away, in the unit of the file, is at infinity.
INFINITY = 1e10

#: More coefficients than any diffractive surface has; mm.
MOST_TERMS, NANOMETRE = 50, Fraction(1, 10**6)

#: Coefficients of an asphere, of r⁴, r⁶, … r²⁰.
LETTERS = "ABCDEFGHJ"

#: Shape of an aperture by the commands of its sizes.
APERTURES = {"circular": ("CIR",), "rectangular": ("REX", "REY"), "elliptic": ("ELX", "ELY")}
APERTURE_WORDS = (*(word for words in APERTURES.values() for word in words), "ADX", "ADY", "ARO")

#: Label of an obscuration that makes a ring of the clear circle of its surface.
RING = "RING"

#: Data that CODE V has no command for are in comments, `!raytrace catalogs SCHOTT OHARA`.
COMMENT = "!RAYTRACE"
_COMMENT_WORDS = (
    "AIMING",
    "AUTOMATIC",
    "BREAK",
    "CATALOGS",
    "CONDITIONS",
    "EXPANSION",
    "CHIP_ZONE",
    "MECHANICAL_SEMI_DIAMETER",
    "NOTE",
    "RADIUS",
    "UNNAMED",
    "VARIABLES",
)

#: Decentres and tilts by the numbers of a pose; tilts about x and y are left-handed: their sign changes.
POSE_WORDS = {"x": "XDE", "y": "YDE", "z": "ZDE", "tilt_x": "ADE", "tilt_y": "BDE", "tilt_z": "CDE"}
LEFT_HANDED = ("ADE", "BDE")

#: Types of decentres and tilts, by the axes behind the surface.
POSE_TYPES = {"DAR": RETURNED, "BEN": BENT, "REV": REVERSED}


SYSTEM_READ = {
    *by_word({"": "RDM LEN TIT DIM WL REF WTW WTF VUX VLX VUY VLY SO S SI GO PRV PWL END ZOO TEM PRE CA PIM AFI"}),
    *("PUX", "PUY", "PUI", *SYSTEM_APERTURES.values()),
    *(word for pair in FIELD_KINDS.values() for word in pair),
}
SURFACE_READ = {
    *by_word({"": "CUY RDY THI GLA RMD STO SLB SPH CON ASP K CUF DIF HOR HWL HCT HCO"}),
    *(*LETTERS, *APERTURE_WORDS, *POSE_WORDS.values(), *POSE_TYPES),
}


#: Commands that are known and left out, with the reason.
LEFT_OUT = by_word(
    {
        "initials of the designer": "INI",
        "identity of the program": "UID",
        "colour or style of a drawing": "CLS DOR",
        "substrate of a mirror, for drawing": "CUM THM",
        "value kept by the program for its error function": "DER",
        "pick-up: the stored value is read": "PIK",
        "variable or coupling of the optimisation": "CCY CCX THC GLC KC AC BC CC DC EC FC GC HC JC XDC YDC ZDC ADC BDC"
        " CDC HCC CUC",
        "tolerance": "DLT DLN DLV DLF DLR DLX DLY DLZ DLA DLB DLG DLC DLS TRX TRY TRR BTX BTY DSX DSY DSZ DSR BSX BSY"
        " BSZ TIR CYD CYN IRR HOM ROL CMP SWV",
        "coatings refract no rays": "MFL COA CWL",
        "polarisation": "POL",
        "thermal expansion": "TCE",
        "how the program finds the rays of a wide field": "WID",
        "listing, drawing or analysis: changes no lens": "LIS SUR VIE DRA MTF PSF SPO RIM FIE WAV FIR THO FOO RSI SIN"
        " PMA OUT SAV EXI",
    }
)

#: Commands that are known and not modelled: a file with one of them is refused.
REFUSED = by_word(
    {
        "centre of a tilt off the vertex": "XOD YOD ZOD",
        "return to an earlier surface": "RET",
        "global coordinates": "GLB",
        "toroid or cylinder": "CYL YTO XTO AAS CUX RDX KX KY AR BR CR DR AP BP CP DP",
        "special surface": "SPS SCO UDS SPL ZRN",
        "diffractive surface": "HOE GRT GRO GRS GRX GRY GRZ HV1 HV2 HX1 HX2 HY1 HY2 HZ1 HZ2",
        "gradient index": "GRI GRN GRC",
        "thermal gradient": "THG",
        "non-sequential surfaces": "NSS NSC",
        "array": "ARR",
        "lens module": "MOD MCO",
        "birefringent medium": "BIR OAX OAY OAZ",
        "numerical aperture in image space": "NA",
        "telecentric object space": "TEL",
        "afocal image space": "AFC",
        "glass of one side of a surface": "GL1 GL2",
        "surface deformed by a file": "INT ISF",
        "command that puts in, takes out or turns round surfaces": "INS DEL FLY SCA COP MOV",
        "optimisation": "AUT",
        "another file": "IN RES RUN",
        "macro": "LCL GBL NUM STR FOR WHI IF ELS UNT FCT EVA WRI GOT LBL RFD RFS",
    }
)
_KNOWN = SYSTEM_READ | SURFACE_READ | LEFT_OUT.keys() | REFUSED.keys()

_SURFACE = re.compile(r"S(O|I|\d{1,6})", re.ASCII | re.IGNORECASE)
_ZOOM = re.compile(r"Z(\d{1,6})", re.ASCII | re.IGNORECASE)
_OF = re.compile(r"([FW]\d{1,6}|S(O|I|\d{1,6})|L['\"].*|CLR|OBS|EDG|HOL)", re.ASCII | re.IGNORECASE)
_PIECE = re.compile(r"'[^']*'|\"[^\"]*\"|[^'\"!;]+|[!;'\"]")
_WORD = re.compile(r"[Ll]?'[^']*'|[Ll]?\"[^\"]*\"|[^\s'\"]+")


# -- text to commands -------------------------------------------------------------------------------------------------


def commands(text: str, file: str) -> Iterator[Record]:
    """The commands of a text, each with the line it begins in; and the comments of this package."""
    waiting, start = "", 0
    for line_number, line in enumerate(text.split("\n"), 1):
        place = Place(file, line_number)
        if line.lstrip().upper().startswith(COMMENT) and not waiting:
            _, *words = line.split(None, 2)
            yield Record(COMMENT, tuple(words), words[-1] if len(words) > 1 else "", place, False)
            continue
        pieces = list(itertools.takewhile(lambda piece: piece != "!", _PIECE.findall(line)))
        if mark := next((piece for piece in pieces if piece in "'\""), None):
            raise LensFileError(f"a text that begins with {mark} does not end on its line", place)
        content, start = "".join(pieces), start if waiting else line_number
        if content.rstrip().endswith("&"):
            waiting += content.rstrip()[:-1]
            continue
        yield from _parted(waiting + content, Place(file, start))
        waiting = ""
    if waiting:
        raise LensFileError("the last line ends in &, which continues it: file cut off?", Place(file, start))


def _parted(line: str, place: Place) -> Iterator[Record]:
    texts = [""]
    for piece in _PIECE.findall(line):
        if piece == ";":
            texts.append("")
        else:
            texts[-1] += piece
    for text in texts:
        words = _WORD.findall(text)
        if words:
            yield Record(_keyword(words[0]), tuple(words[1:]), text, place, False)


def _keyword(word: str) -> str:
    """The command of a word; words longer than three letters may be cut to them."""
    capitals = word.upper()
    if capitals in _KNOWN or _SURFACE.fullmatch(capitals):
        return capitals
    return capitals[:3] if capitals.isalpha() and capitals[:3] in _KNOWN else capitals


def unquoted(word: str) -> str:
    """A word without the quotes around it."""
    return word[1:-1] if len(word) > 1 and word[0] == word[-1] and word[0] in "'\"" else word


# -- commands to blocks -----------------------------------------------------------------------------------------------


class Stream:
    """The commands of a file in the order in which CODE V executes them, sorted: the system and the surfaces.

    private: private glasses by name; comments: those of this package.
    """

    def __init__(self, file: str, report: Draft):
        self.report, self.system = report, Block(Place(file))
        self.surfaces: list[Block] = []
        self.private: dict[str, Record] = {}
        self.comments: list[Record] = []
        self.pointer: Block | None = None
        self.slope: str | None = None  # whether S gives radii (RDY) or curvatures (CUY)
        self.in_catalog = self.has_image = False

    def take(self, record: Record) -> None:
        """Sort one command in."""
        if record.keyword == COMMENT:
            word = record.words[0].upper() if record.words else ""
            status = READ if word in _COMMENT_WORDS else UNKNOWN
            self.report.met(f"{COMMENT.lower()} {word.lower()[:40]}", status, record.place)
            self.comments.append(record._replace(keyword=word, place=self._place(record)))
        elif self.in_catalog and record.keyword not in ("PWL", "END"):
            first, waves = _WORD.match(record.text.strip()), self.system.last("PWL")
            name = unquoted(first[0]) if first else ""
            self.private[name.upper()] = record._replace(keyword=name, text=" ".join(waves.words if waves else ()))
            self.report.met("PRV", READ, record.place)
        elif any("^" in word for word in (record.keyword, *record.words) if word[0] not in "'\""):
            raise LensFileError("variables of macros (^) are not followed; export the lens as numbers", record.place)
        elif zoom := next((match for word in record.words[:2] if (match := _ZOOM.fullmatch(word))), None):
            if int(zoom[1]) == 1 and record.keyword in SYSTEM_READ | SURFACE_READ:
                words = tuple(word for word in record.words if word != zoom[0])
                self._take_command(record._replace(words=words))
            else:
                self.report.met(record.keyword[:40], IGNORED, record.place, "of another zoom position, or left out")
        else:
            self._take_command(record)

    def _take_command(self, record: Record) -> None:
        word = record.keyword
        if word in REFUSED:
            numbers = [plain(number) for number in record.words if is_number(number)]
            is_off = [switch.upper() for switch in record.words] in (["N"], ["NO"])
            if not is_off and (any(numbers) or not numbers):
                raise UnsupportedSurface(f"{word} ({REFUSED[word]}) is not modelled", self._place(record))
        if word in _HANDLED or _SURFACE.fullmatch(word):
            self.report.met("S" if _SURFACE.fullmatch(word) else word, READ, self._place(record))
            _HANDLED.get(word, Stream._surface)(self, record)
        elif word in SYSTEM_READ:
            self.report.met(word, READ, record.place)
            self.system.records.setdefault(word, []).append(record)
        elif word in SURFACE_READ:
            self._of_surface(record)
        else:
            reason = "0, or switched off" if word in REFUSED else LEFT_OUT.get(word, "")
            self.report.met(word[:40], IGNORED if reason else UNKNOWN, self._place(record), reason)

    def _place(self, record: Record) -> Place:
        return record.place if self.pointer is None else record.place._replace(surface=self.pointer.place.surface)

    # -- surfaces

    def _surface(self, record: Record) -> None:
        """S, SO, SI, Sk: the next surface or an earlier one, and its first numbers."""
        name, count = record.keyword[1:], len(self.surfaces)
        number = 0 if name == "O" else int(name) if name.isdigit() else None
        number = count - 1 if name == "I" and self.has_image else number
        if number is not None and number > count:
            raise LensFileError(f"S{number} where S{count} should follow; lines lost or reordered?", record.place)
        if number is not None and number < count:
            self.pointer = self.surfaces[number]
        else:
            refuse_surplus(self.surfaces, record.place)
            if self.has_image:
                raise LensFileError("a surface after SI, the image", record.place)
            if (count == 0) != (name == "O"):
                message = f"{record.keyword} as surface {count}; a lens begins with SO, the object"
                raise LensFileError(message, record.place)
            self.has_image = name == "I"
            self.pointer = Block(record.place._replace(surface=count))
            self.surfaces.append(self.pointer)
        # radius or curvature, thickness, glass, and refract or reflect: as commands of their own
        words, record = record.words, record._replace(place=self._place(record))
        place = record.place
        if len(words) == 1 or len(words) > 4:
            message = f"{record.keyword} with {len(words)} words, expected radius, thickness and glass"
            raise LensFileError(message, place)
        if self.slope is None and words and is_number(words[0]) and plain(words[0]):
            message = "its first number may be a radius (RDM) or a curvature (RDM N), which is not specified before"
            raise LensFileError(f"{message}; add one of them", place)
        mirror = len(words) > 2 and unquoted(words[2]).upper() == "REFL"
        keywords = (self.slope or "RDY", "THI", "RMD" if mirror else "GLA", "RMD")
        for word, keyword in zip(words, keywords, strict=False):
            slot = "CUY" if keyword == "RDY" else keyword
            self.pointer.records.setdefault(slot, []).append(record._replace(keyword=keyword, words=(word,)))

    def _of_surface(self, record: Record) -> None:
        """A command of the surface it names, else of the current one."""
        block, words = self.pointer, record.words
        if words and _SURFACE.fullmatch(words[0]):
            name = words[0][1:].upper()
            number = 0 if name == "O" else len(self.surfaces) - 1 if name == "I" and self.has_image else -1
            number = int(name) if name.isdigit() else number
            if not 0 <= number < len(self.surfaces):
                message = f"{shown(words[0])} is no surface so far; there are {len(self.surfaces)}"
                raise LensFileError(message, record.place)
            block, words = self.surfaces[number], words[1:]
        if block is None:
            raise LensFileError(f"{record.keyword} before the first surface (SO)", record.place)
        record = record._replace(words=words, place=record.place._replace(surface=block.place.surface))
        word = record.keyword
        if word in ("CUY", "RDY", "THI") and words and not is_number(words[0]):
            self.report.met(word, IGNORED, record.place, "solve: the stored value is read")
            return
        self.report.met(word, READ, record.place)
        slot = "CUY" if word == "RDY" else "TYPE" if word in ("SPH", "CON", "ASP") else word
        slot = "APERTURE" if word in APERTURE_WORDS else "POSE" if word in POSE_TYPES else slot
        block.records.setdefault(slot, []).append(record)

    # -- commands that act at once

    def _radius_mode(self, record: Record) -> None:
        self.slope = "CUY" if record.words and record.words[0][:1] in "Nn" else "RDY"

    def _new_lens(self, record: Record) -> None:
        if self.surfaces:
            raise LensFileError("LEN after the surfaces of a lens: a file of several lenses; split it", record.place)

    def _catalog(self, record: Record) -> None:
        self.in_catalog = record.keyword == "PRV"

    def _zoom(self, record: Record) -> None:
        """Take the first zoom position: the first value of a zoomed command."""
        if not record.words or is_number(record.words[0]):
            self.system.records.setdefault("ZOO", []).append(record)
            return
        keyword = _keyword(record.words[0])
        places = [word for word in record.words[1:] if _OF.fullmatch(word)]
        values = [word for word in record.words[1:] if not _OF.fullmatch(word)]
        if keyword in (SYSTEM_READ | SURFACE_READ) - _HANDLED.keys() and values:
            self._take_command(record._replace(keyword=keyword, words=(*places, values[0])))
        elif keyword in REFUSED:
            self._take_command(record._replace(keyword=keyword, words=(*places, *values[:1])))


_HANDLED = {
    "S": Stream._surface,
    "RDM": Stream._radius_mode,
    "LEN": Stream._new_lens,
    "PRV": Stream._catalog,
    "END": Stream._catalog,
    "ZOO": Stream._zoom,
}


def sections(text: str, file: str, report: Draft) -> Stream:
    """The commands of a text sorted, each of them reported."""
    stream = Stream(file, report)
    for record in commands(text, file):
        stream.take(record)
    if stream.in_catalog:
        raise LensFileError("PRV (private glasses) without END: file cut off?", Place(file))
    if not stream.surfaces:
        raise LensFileError("no surface (SO, S, SI); is it a sequence of CODE V (.seq)?", Place(file))
    if not stream.has_image:
        raise LensFileError(f"{len(stream.surfaces)} surfaces and no SI, the image: file cut off?", Place(file))
    return stream
