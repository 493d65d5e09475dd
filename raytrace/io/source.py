"""The text of a lens file: its encoding, the numbers, texts and records in it, errors with file, line and surface; and
the report of its import.

A number or text that is written reads back as the same 64-bit number or the same characters.

A glass is never replaced without request. `substitute` is a mapping {"SSK4": "SSK4A"}, or words as on the command line,
"SSK4=SSK4A". "nearest" requests the glass of smallest

    d² = Δn_d² + (0.01 ΔV_d)²

relative to the nd and Vd stored in the file: for one unknown glass by name, or, alone, for every unknown glass.
"formula" accepts, for a glass of CODE V known by nd and Vd or by a few indices, indices at other wavelengths that a
formula estimates with an error above 1e-4.
"""

import json
import os
import re
import stat
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.files import encoding
from raytrace.maths.numerics import value
from raytrace.maths.result import Result
from raytrace.system.dimensions import DIMENSION
from raytrace.system.lens import RAY_AIMING
from raytrace.system.optimization_data import Row
from raytrace.system.surface import Surface, is_freeform, is_posed
from raytrace.words import RaytraceError, RaytraceWarning, named, option

#: Limits beyond which a file is no sequential lens; real lens files have a few hundred kB. They bound the reading time.
MAX_BYTES = 16 * 2**20
MAX_SURFACES = 1000
MAX_LINES = 200_000
MAX_LINE = 100_000

#: More characters than any number needs.
_DIGITS = 400

_NOT_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f\ufffd]")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d{1,4})?", re.ASCII)
_INFINITE = re.compile(r"[+-]?(inf|infinity|infinite|∞|1\.#inf)", re.ASCII | re.IGNORECASE)

#: Millimetres in a unit of length.
MILLIMETRES = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "INCH": 25.4, "M": 1e3, "METER": 1e3}
MILLIMETRES |= {"MILLIMETERS": 1.0, "MILLIMETRES": 1.0, "INCHES": 25.4, "METERS": 1e3, "METRES": 1e3}


# -- places and errors ------------------------------------------------------------------------------------------------


class Place(NamedTuple):
    """A position in a lens file: file name, line from 1, surface from 0; None where they do not apply."""

    file: str
    line: int | None = None
    surface: int | None = None

    def __str__(self) -> str:
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        return place if self.surface is None else f"{place}, surface {self.surface}"


class LensFileError(RaytraceError, ValueError):
    """A lens file that cannot be read or written. The message is one line: place, finding, expectation, remedy.

    file, line, surface: the position in the file; None where that does not apply.
    """

    def __init__(self, message: str, place: Place) -> None:
        super().__init__(" ".join(f"{place}: {message}".split()))
        self.file, self.line, self.surface = place


class UnsupportedSurface(LensFileError):
    """A surface of a type that is not modelled; it is never dropped and never read as another type."""


class LensFileWarning(RaytraceWarning):
    """A lens file was read, but parts of it were left out, or assumptions were made."""


def shown(text: str) -> str:
    """An extract of a file as an error quotes it: at most 40 characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


# -- bytes to text ----------------------------------------------------------------------------------------------------


def read_text(path: Path) -> str:
    """The text of a lens file: UTF-16 (either order, with or without mark), UTF-8, else Latin-1.

    Raises LensFileError for a file that is missing, not a regular file, larger than MAX_BYTES, or not text.
    """
    return decode(read_content(path), Place(str(path)))


def read_content(path: Path, most: int = MAX_BYTES) -> bytes:
    """The bytes of a file. Raises LensFileError if it is missing, not a regular file or larger than `most`."""
    place = Place(str(path))
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise LensFileError("is not a regular file; give the path of a lens file", place)
        if status.st_size > most:
            size = f"{status.st_size / 1e6:.0f} MB"
            raise LensFileError(f"is {size} long, more than any lens file ({most / 1e6:.0f} MB); not read", place)
        with open(path, "rb") as file:
            return file.read(most + 1)
    except OSError as error:
        raise LensFileError(f"cannot be read: {error.strerror or error}", place) from error
    except ValueError as error:
        if isinstance(error, LensFileError):
            raise
        raise LensFileError(f"cannot be opened: {error}", place) from error


#: Bytes of ASCII text.
_PLAIN = bytes([*b"\t\n\v\f\r", *range(32, 127)])


def is_binary(content: bytes) -> bool:
    """Whether bytes are no text: in their encoding more than a fifth of the characters is not of ASCII."""
    text = content.decode(encoding(content), "replace")
    ascii = text.encode("ascii", "ignore")
    return len(ascii) - len(ascii.translate(None, _PLAIN)) < 0.8 * len(text)


def decode(content: bytes, place: Place) -> str:
    """Bytes to text by the rules of `read_text`, with \\n as line end."""
    if not content.strip():
        raise LensFileError("is empty", place)
    codec = encoding(content)
    try:
        text = content.decode(codec)
    except UnicodeDecodeError as error:
        message = f"is not valid {codec.upper()} at byte {error.start}: damaged or cut off; save it again as UTF-8"
        raise LensFileError(message, place) from error
    text = text.removeprefix("\ufeff").rstrip("\x1a\x00 \t\r\n") + "\n"
    if strange := _NOT_TEXT.search(text):
        line = text.count("\n", 0, strange.start()) + 1
        message = f"holds the character U+{ord(strange[0]):04X}: binary, or of an unknown encoding; save it as UTF-8"
        raise LensFileError(message, place._replace(line=line))
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    if len(lines) > MAX_LINES or max(map(len, lines)) > MAX_LINE:
        size = f"{len(lines)} lines, the longest of {max(map(len, lines))} characters"
        raise LensFileError(f"{size}; more than any lens file ({MAX_LINES}, {MAX_LINE})", place)
    return text


# -- numbers ----------------------------------------------------------------------------------------------------------


def number(text: str, quantity: str, place: Place) -> float:
    """A finite decimal number, Fortran's D exponent included. Raises LensFileError for anything else."""
    if len(text) > _DIGITS or not _NUMBER.fullmatch(text):
        raise LensFileError(f"{quantity} is {shown(text)}, expected a finite number", place)
    result = plain(text)
    if result in (float("inf"), float("-inf")):
        raise LensFileError(f"{quantity} is {shown(text)}, too large for a 64-bit number", place)
    return result


def integer(text: str, quantity: str, place: Place) -> int:
    """A whole number below a million in size, written with or without a decimal point."""
    result = number(text, quantity, place)
    if result != int(result) or abs(result) >= 1e6:
        raise LensFileError(f"{quantity} is {shown(text)}, expected a whole number", place)
    return int(result)


def is_number(text: str) -> bool:
    """True if `number` would accept the text."""
    return len(text) <= _DIGITS and bool(_NUMBER.fullmatch(text)) and abs(plain(text)) != float("inf")


def plain(text: str) -> float:
    """The number of a text that `is_number` accepts."""
    return float(text.replace("D", "e").replace("d", "e"))


def is_infinite(text: str) -> bool:
    """True for the spellings of infinity in lens files."""
    return bool(_INFINITE.fullmatch(text))


def double(numbers: float | Tensor | Sequence) -> Tensor:
    """One or more numbers of a file as a 64-bit tensor."""
    return torch.as_tensor(numbers, dtype=torch.float64)


def unit_of(
    word: str, units: Mapping[str, float], quantity: str, expected: str, place: Place, report: "Draft"
) -> float:
    """Millimetres in a unit of length by its name, with a note of the conversion. Raises LensFileError."""
    if word not in units:
        raise LensFileError(f"{quantity} is {shown(word)}, expected {expected}", place)
    if units[word] != 1:
        report.note(f"lengths of the file are in {word}; converted to mm")
    return units[word]


def nonzero(number: float | None) -> Tensor | None:
    """A number of a shape; None where it is 0 and the surface has none of it."""
    return double(number) if number else None


def exact(number: Tensor | float | None, quantity: str, place: Place) -> str:
    """The shortest decimal (at most 17 digits) that reads back as the same 64-bit number; 0.0 for None.

    Raises LensFileError for a batch of numbers, nan and infinity.
    """
    number = 0.0 if number is None else number
    return exact_list(torch.as_tensor(number, dtype=torch.float64), quantity, place, axes=0)[0]


def exact_list(numbers: Tensor, quantity: str, place: Place, *, axes: int = 1) -> list[str]:
    """`exact` of every number of a one-dimensional tensor."""
    if numbers.ndim != axes:
        shape = tuple(numbers.shape)
        raise LensFileError(f"{quantity} has the shape {shape}; a file holds one lens: write one of them", place)
    values = numbers.detach().double().reshape(-1)
    for unwritable in values[~torch.isfinite(values)].tolist():
        raise LensFileError(f"{quantity} is {unwritable}; only finite numbers can be written", place)
    return [*map(repr, values.tolist())]


def thickness(number: Tensor, infinity: str, place: Place) -> str:
    """A thickness as text; only the distance of the object may be infinite."""
    if place.surface == 0 and number.ndim == 0 and float(number) == torch.inf:
        return infinity
    return exact(number, "thickness", place)


def refuse_sag_terms(surface: Surface, place: Place) -> None:
    """Raise LensFileError for a surface that formats of conics and rotationally symmetric terms do not hold."""
    if surface.sag_terms is not None:
        feature = f"has sag terms of {named(surface.sag_terms)}"
    elif is_freeform(surface):
        feature = f"is {surface.kind}"
    elif surface.phase is not None:
        feature = f"has a phase ({named(surface.phase)})"
    elif is_posed(surface):
        feature = "is tilted or decentred"
    else:
        return
    raise LensFileError(f"the surface {feature}, which this format does not hold; a .zmx file holds most kinds", place)


# -- texts: unchanged where that reads back, else quoted and escaped as in JSON ---------------------------------------

#: Blanks that no reader strips inside a text, though Python calls them not printable.
BLANKS = "\u00a0\u3000"


def quoted(text: str) -> str:
    """A text for a cell or a header line: itself, or in quotes with \\n, \\t, \\" and \\u escapes."""
    unchanged = text == text.strip() and text and is_printable(text) and text[-1] not in ",;" and not _is_quoted(text)
    return text if unchanged else _escaped(text)


def plain_text(text: str) -> str:
    """The text that `quoted` wrote; any other text without the blanks around it."""
    text = text.strip()
    if _is_quoted(text):
        try:
            content = json.loads(text)
        except ValueError:
            return text
        return content if isinstance(content, str) else text
    return text


def is_printable(text: str) -> bool:
    """True for a text without control characters, line separators and characters that no encoding holds."""
    return "\ufffd" not in text and text.translate(dict.fromkeys(map(ord, BLANKS), " ")).isprintable()


def words(text: str) -> list[str]:
    """Words between blanks, commas or semicolons; those in quotes as `quoted` writes them."""
    return [plain_text(word) for word in re.findall(r'"(?:[^"\\]|\\.)*"|[^\s,;]+', text)]


def word(text: str) -> str:
    """A text as one of `words`."""
    return text if words(text) == [text] and is_printable(text) and '"' not in text else _escaped(text)


def _escaped(text: str) -> str:
    return "".join(c if is_printable(c) else json.dumps(c)[1:-1] for c in json.dumps(text, ensure_ascii=False))


def _is_quoted(text: str) -> bool:
    return len(text) > 1 and text[0] == text[-1] == '"'


def one_line(text: str, quantity: str, place: Place) -> str:
    """A text without its surrounding blanks. Raises LensFileError if it does not fit on one line of a file."""
    if not is_printable(text.replace("\t", " ")):
        raise LensFileError(f"{quantity} holds a line break or a control character, and cannot be written", place)
    return text.strip()


# -- records ----------------------------------------------------------------------------------------------------------


class Record(NamedTuple):
    """One line or command: its keyword, the words after it, and the raw text after the keyword and one space."""

    keyword: str
    words: tuple[str, ...]
    text: str
    place: Place
    indented: bool = False

    def number(self, position: int, quantity: str, default: float | None = None) -> float:
        """The finite number at a position (0 is the first after the keyword), or `default` where the line ends."""
        if position < len(self.words):
            return number(self.words[position], f"{self.keyword}: {quantity}", self.place)
        if default is None:
            raise LensFileError(f"{self.keyword} has {len(self.words)} values; {quantity} is missing", self.place)
        return default

    def integer(self, position: int, quantity: str, default: int | None = None) -> int:
        """The whole number at a position, or `default` where the line ends."""
        if position >= len(self.words) and default is not None:
            return default
        self.number(position, quantity)
        return integer(self.words[position], f"{self.keyword}: {quantity}", self.place)


class Block:
    """The records of the system or of one surface, by keyword."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.records: dict[str, list[Record]] = {}

    @property
    def surface(self) -> int:
        """The number of the surface; 0 of the system."""
        return self.place.surface or 0

    def place_of(self, *keywords: str) -> Place:
        """The place of the last record of these keywords, else that of the block."""
        record = self.last(*keywords)
        return self.place if record is None else record.place

    def all(self, *keywords: str) -> list[Record]:
        """Every record of these keywords, in the order of the file."""
        chosen = [record for keyword in keywords for record in self.records.get(keyword, ())]
        return sorted(chosen, key=lambda record: record.place.line or 0)

    def last(self, *keywords: str) -> Record | None:
        """The last record of the first of these keywords that is present."""
        return next((self.records[keyword][-1] for keyword in keywords if keyword in self.records), None)

    def number(self, keyword: str, quantity: str, default: float = 0.0) -> float:
        """The first number of the last record of a keyword; `default` where the keyword is absent."""
        record = self.last(keyword)
        return record.number(0, quantity) if record else default

    def integer(self, keyword: str, quantity: str, default: int, position: int = 0) -> int:
        """The whole number at a position of the last record of a keyword; `default` where it is absent."""
        record = self.last(keyword)
        return record.integer(position, quantity, default) if record else default

    def last_of_kind(self, keywords: Iterable[str], kind: str, report: "Draft") -> Record:
        """The last record of keywords that exclude one another. Raises LensFileError where there is none."""
        records = self.all(*keywords)
        if not records:
            raise LensFileError(f"no {kind}; expected one of {', '.join(keywords)}", self.place)
        if len({record.keyword for record in records}) > 1:
            report.warn(f"several {kind}s ({in_lines(records)}); the last is used", records[-1].place)
        return records[-1]


def by_word(rows: dict[str, str]) -> dict[str, str]:
    """A text for each of the words that it has in a table of rows."""
    return {word: text for text, words in rows.items() for word in words.split()}


def in_lines(records: Sequence[Record]) -> str:
    """Keywords with their lines, as an error lists them."""
    return " and ".join(f"{record.keyword} in line {record.place.line}" for record in records)


def refuse_surplus(surfaces: Sequence, place: Place) -> None:
    """Raise LensFileError where there is no space for a further surface."""
    if len(surfaces) >= MAX_SURFACES:
        raise LensFileError(f"more than {MAX_SURFACES} surfaces; no sequential lens has so many", place)


def refuse_few(surfaces: Sequence[Block]) -> None:
    """Raise LensFileError for a file with fewer surfaces than the simplest lens."""
    if len(surfaces) < 3:
        message = f"{len(surfaces)} surfaces, expected at least object, one surface and image; file cut off?"
        raise LensFileError(message, surfaces[-1].place)


def warn_of_repeats(blocks: Sequence[Block], once: Callable[[str], bool], report: "Draft") -> None:
    """Warn of a keyword that occurs again in a block, for which `once` is true."""
    for block in blocks:
        for keyword, repeated in block.records.items():
            if len(repeated) > 1 and once(keyword):
                first, last = repeated[0].place.line, repeated[-1].place
                report.warn(f"{keyword} occurs again (first in line {first}); the last is used", last)


# -- substitutes ------------------------------------------------------------------------------------------------------

NEAREST, FORMULA = "nearest", "formula"


class BadSubstitute(RaytraceError, ValueError):
    """A malformed substitute; the message has the value found and the value expected."""


@dataclass(frozen=True)
class Substitutes:
    """Requested substitutes: glass names by the name, in capitals, that they replace.

    nearest: replace every unknown glass; formula: accept estimated indices of every glass.
    """

    by_name: Mapping[str, str] = field(default_factory=dict)
    nearest: bool = False
    formula: bool = False

    def of(self, name: str) -> str | None:
        """The substitute of a glass: a name, NEAREST or FORMULA; None where none was requested."""
        return self.by_name.get(name.upper())

    def takes_formula(self, name: str) -> bool:
        """Whether estimated indices of a glass are accepted."""
        return self.formula or self.of(name) == FORMULA


NONE = Substitutes()


def substitutes_of(requested: Mapping[str, str] | str | Sequence[str] | None) -> Substitutes:
    """Substitutes of a mapping, or of words like SSK4=SSK4A and "nearest". Raises BadSubstitute."""
    if requested is None:
        return NONE
    if isinstance(requested, Mapping):
        pairs = list(requested.items())
    else:
        words = requested.split() if isinstance(requested, str) else list(requested)
        pairs = [(name, other) for name, _, other in (word.partition("=") for word in words)]
    by_name, general = {}, {name for name, other in pairs if name in (NEAREST, FORMULA) and other == ""}
    for name, other in pairs:
        if other == "" and name in general:
            continue
        if not (isinstance(name, str) and isinstance(other, str) and name.strip() and other.strip()):
            raise BadSubstitute(
                f"{option('substitute')}: {name!r} for {other!r}; expected GLASS=OTHER, {NEAREST} or {FORMULA}"
            )
        by_name[name.strip().upper()] = other.strip()
    return Substitutes(by_name, NEAREST in general, FORMULA in general)


# -- the report -------------------------------------------------------------------------------------------------------

READ, IGNORED, UNKNOWN = "read", "ignored", "unknown"
_TITLES = {READ: "read", IGNORED: "known and ignored", UNKNOWN: "unknown"}

#: Number of lines and surfaces of a keyword in the report, at most.
_LISTED = 8


@dataclass(frozen=True)
class Keyword:
    """The treatment of one keyword (or column, or header line) of a file.

    status: "read", "ignored" (known, and left out for `reason`) or "unknown".
    count: number of occurrences; lines, surfaces: the first of them.
    """

    name: str
    status: str
    count: int
    lines: tuple[int, ...]
    surfaces: tuple[int, ...]
    reason: str = ""

    def __str__(self) -> str:
        if self.status == READ:
            return f"{self.name} x{self.count}"
        where, times = ("line", "") if self.count == 1 else ("lines", f" x{self.count}")
        listed = ", ".join(map(str, self.lines)) + (", …" if self.count > len(self.lines) else "")
        place = f" ({where} {listed})" if self.lines else ""
        return f"{self.name}{times}{place}" + (f": {self.reason}" if self.reason else "")


@dataclass(frozen=True)
class GlassSource:
    """The source of the medium behind a surface: a catalog, or "model glass", "MIL code", "constant index"."""

    surface: int
    name: str
    source: str

    def __str__(self) -> str:
        return f"surface {self.surface}: {self.name or '(unnamed)'}, {self.source}"


@dataclass(frozen=True)
class Varied:
    """A multi-configuration operand, "THIC 6", and its value in each configuration."""

    operand: str
    values: tuple

    def __str__(self) -> str:
        cells = (
            f"{cell:.9g}" if isinstance(cell, float) else "-" if cell is None else str(cell)[:14] or '""'
            for cell in self.values
        )
        return f"{self.operand:<12} " + " ".join(f"{cell:>14}" for cell in cells)


#: Status of an operand of a merit function.
EVALUATED, KNOWN, UNKNOWN_OPERAND = "evaluated", "known, not evaluated", "unknown"


@dataclass(frozen=True)
class OperandUse:
    """Occurrences of an operand in the merit function of a file, all and those with a weight, and its status.

    status: "evaluated", "known, not evaluated" or "unknown"; "known" where the evaluated operands were not specified.
    """

    name: str
    count: int
    weighted: int
    status: str

    def __str__(self) -> str:
        return f"{self.name} x{self.count}" + (f" ({self.weighted} with weight)" if self.weighted < self.count else "")


def operand_uses(merit: Sequence[Row], evaluated: Collection[str] | None) -> tuple[OperandUse, ...]:
    """The operands of a merit function by name; evaluated: names of those that are evaluated."""
    rows_by_name: dict[str, list[Row]] = {}
    for row in merit:
        rows_by_name.setdefault(row.name, []).append(row)
    uses = []
    for name, rows in rows_by_name.items():
        status = KNOWN if evaluated is not None else "known"
        if evaluated is not None and name in evaluated:
            status = EVALUATED
        elif name not in DIMENSION:
            status = UNKNOWN_OPERAND
        uses.append(OperandUse(name, len(rows), sum(row.weight != 0 for row in rows), status))
    return tuple(uses)


#: Keys that a document has only where they are not empty.
_OPTIONAL_KEYS = (
    "configurations",
    "variables",
    "solves",
    "kept",
    "operands",
    "tolerances",
    "unread_tolerances",
    "geometry",
    "conditions",
)


@value
class ImportReport(Result):
    """The treatment of a lens file: every keyword, the source of each glass, notes and warnings.

    A note reports a choice that the file leaves open; a warning reports an assumption or a loss, and is an error when
    the file is read with `strict=True`. surfaces, stop_surface, primary_wavelength (its number, from 1), wavelengths
    (µm), ray_aiming: of the lens that was read. configurations: values of multi-configuration operands.
    variables, solves, kept: of `Lens.optimization_data`, in words; operands: of its merit function; tolerances: number
    of its lines; unread_tolerances: lines that are not read, with the reason. geometry: surfaces and gaps that cannot
    be fabricated. conditions: the lines of a table of conditions and boundaries, with the values of the lens.
    """

    file: str
    format: str
    keywords: tuple[Keyword, ...] = ()
    glasses: tuple[GlassSource, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    surfaces: int = 0
    stop_surface: int = 0
    primary_wavelength: int = 1
    wavelengths: tuple[float, ...] = ()
    ray_aiming: str = ""
    configurations: tuple[Varied, ...] = ()
    variables: tuple[str, ...] = ()
    solves: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    operands: tuple[OperandUse, ...] = ()
    tolerances: int = 0
    unread_tolerances: tuple[str, ...] = ()
    geometry: tuple[str, ...] = ()
    conditions: tuple[str, ...] = ()

    def document(self) -> dict:
        return {name: part for name, part in asdict(self).items() if part or name not in _OPTIONAL_KEYS}

    def columns(self) -> dict[str, Tensor]:
        """A row for each keyword."""
        statuses = [list(_TITLES).index(keyword.status) for keyword in self.keywords]
        counts = [keyword.count for keyword in self.keywords]
        columns = {"keyword": range(len(statuses)), "status": statuses, "count": counts}
        return {name: torch.tensor([*column]) for name, column in columns.items()}

    def words(self) -> dict[str, Sequence[str]]:
        return {"keyword": [keyword.name for keyword in self.keywords], "status": [*_TITLES]}

    def __str__(self) -> str:
        lines = [f"{self.file} ({self.format})"]
        lines += [f"  warning: {warning}" for warning in (*self.warnings, *self.geometry)]
        lines += [f"  note: {note}" for note in self.notes]
        if self.wavelengths:
            primary, count = self.primary_wavelength, len(self.wavelengths)
            lines += [
                f"  primary wavelength: number {primary} of {count}, {self.wavelengths[primary - 1]:g} µm",
                f"  ray aiming: {self.ray_aiming} ({RAY_AIMING[self.ray_aiming]})",
            ]
        for status, title in _TITLES.items():
            chosen = [str(keyword) for keyword in self.keywords if keyword.status == status]
            listed = _wrapped(chosen) if status == READ else [f"    {keyword}" for keyword in chosen]
            lines += [f"  {title}:", *listed] if chosen else []
        if self.configurations:
            numbers = " ".join(f"{k:>14}" for k in range(1, len(self.configurations[0].values) + 1))
            rows = [f"    {operand}" for operand in self.configurations]
            lines += ["  configurations:", f"    {'':<12} {numbers}", *rows]
        lines += self._optimization_data()
        lines += ["  glasses:", *(f"    {use}" for use in self.glasses)] if self.glasses else []
        return "\n".join(lines)

    def _optimization_data(self) -> list[str]:
        """Variables, solves, and the operands of the merit function by status."""
        titled = {
            f"{len(self.variables)} variables": self.variables,
            "solves and pickups": self.solves,
            "solves that are kept and not followed": self.kept,
        }
        lines = [line for title, part in titled.items() if part for line in (f"  {title}:", *_wrapped(part))]
        if self.operands:
            lines.append(f"  merit function of {sum(use.count for use in self.operands)} lines:")
        for status in dict.fromkeys(use.status for use in self.operands):
            lines += [f"    {status}:", *_wrapped([str(use) for use in self.operands if use.status == status])]
        lines += (
            ["  conditions and boundaries:", *(f"    {line}" for line in self.conditions)] if self.conditions else []
        )
        lines += [f"  tolerances: {self.tolerances} lines, kept"] if self.tolerances else []
        return lines + [f"    not read: {line}" for line in self.unread_tolerances]


def _wrapped(words: Iterable[str]) -> list[str]:
    """Lines of at most 100 characters with words between commas."""
    lines, line = [], "   "
    for word in words:
        if len(line) + len(word) + 2 > 100:
            lines.append(line)
            line = "   "
        line += f" {word},"
    return [*lines, line.rstrip(",")]


@dataclass
class Draft:
    """The report while a reader fills it; `finished` makes the value.

    substitutes: as requested; substituted: names, in capitals, that were replaced.
    """

    file: str
    format: str
    substitutes: Substitutes = NONE
    substituted: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    warnings: list[tuple[str, Place]] = field(default_factory=list)
    glasses: list[GlassSource] = field(default_factory=list)
    _met: dict[tuple[str, str], list[tuple[Place, str]]] = field(default_factory=dict)

    def again(self, file: str = "") -> "Draft":
        """An empty report with the same substitutes."""
        return Draft(file or self.file, self.format, self.substitutes, self.substituted)

    def append(self, other: "Draft") -> None:
        """Add the contents of another report."""
        self.notes += other.notes
        self.warnings += other.warnings
        self.glasses += other.glasses
        for key, met in other._met.items():
            self._met.setdefault(key, []).extend(met)

    def met(self, name: str, status: str, place: Place, reason: str = "") -> None:
        """Count one keyword."""
        self._met.setdefault((name, status), []).append((place, reason))

    def note(self, text: str) -> None:
        """Report a choice by which nothing is lost."""
        if text not in self.notes:
            self.notes.append(text)

    def warn(self, text: str, place: Place) -> None:
        """Report an assumption or a loss at a place."""
        self.warnings.append((text, place))

    def glass(self, place: Place, name: str, source: str) -> None:
        """Report the source of the medium behind the surface of a place."""
        self.glasses.append(GlassSource(place.surface or 0, name, source))

    def finished(self, *, strict: bool) -> ImportReport:
        """The report. Raises LensFileError for the first warning if `strict`."""
        keywords = []
        for (name, status), met in self._met.items():
            lines = [place.line for place, _ in met if place.line is not None]
            surfaces = dict.fromkeys(place.surface for place, _ in met if place.surface is not None)
            count, (place, reason) = len(met), met[0]
            keywords.append(Keyword(name, status, count, tuple(lines[:_LISTED]), tuple(surfaces)[:_LISTED], reason))
            if status == UNKNOWN:
                times = "" if count == 1 else f" ({count} times)"
                label = name if name.startswith("member ") else f"keyword {name}"
                self.warn(f"unknown {label}{times}: left out", place._replace(surface=None))
        for name in self.substitutes.by_name:
            if name not in self.substituted:
                message = f"a substitute for the glass {name} was requested, which is not in the file"
                self.warn(message, Place(self.file))
        if strict and self.warnings:
            text, place = self.warnings[0]
            more = len(self.warnings) - 1
            also = f" (and {more} more warning{'s' if more > 1 else ''})" if more else ""
            raise LensFileError(f"{text}{also}; refused because strict reading was requested", place)
        warnings = tuple(f"{place}: {text}" for text, place in self.warnings)
        return ImportReport(self.file, self.format, tuple(keywords), tuple(self.glasses), tuple(self.notes), warnings)
