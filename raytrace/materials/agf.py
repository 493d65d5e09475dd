"""AGF, the file format of glass catalogs: a Catalog from a file and back."""

import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import torch

from raytrace.files import encoding, read_bytes, write_text
from raytrace.materials.glass import BY_NUMBER, FORMULAS, Glass
from raytrace.words import RaytraceError, RaytraceWarning, calling_level

#: Statuses by their number in an NM record.
STATUSES = {0: "standard", 1: "preferred", 2: "obsolete", 3: "special", 4: "melt"}
#: Records of numbers, by rank in the order in which a glass is written.
_NUMERIC = {"ED": 0, "CD": 1, "TD": 2, "MD": 2, "OD": 2, "LD": 3, "IT": 4}
#: An unknown thermal coefficient is 0 in AGF, and its temperature 20 °C; any other unknown figure is -1.
_UNKNOWN = {"TD": (*"000000", "20", "0")}
_KEYWORDS = {"CC", "NM", "GC", *_NUMERIC}
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?", re.ASCII)
_LARGEST_FILE = 16 * 2**20

#: A catalog of more glasses is refused; all makers together list some thousands.
MOST_GLASSES = 20_000

#: Characters that no text has, and the record of a name; both are searched without regard to lines, for speed.
_BINARY = bytes({*range(32)} - {*b"\t\n\v\f\r"})
_NAME = re.compile(r"NM[ \t]+(\S+)")


class CatalogError(RaytraceError, ValueError):
    """A malformed glass catalog; the message has file and line, the text found, the text expected and a likely fix."""


class CatalogWarning(RaytraceWarning):
    """A catalog was read, but parts of it were ignored."""


@dataclass(frozen=True, eq=False)
class Catalog:
    """A glass catalog: `name`, its `glasses` by name in file order, and the comment lines of its header."""

    name: str
    glasses: Mapping[str, Glass]
    comments: tuple[str, ...] = ()

    def find(self, name: str) -> Glass | None:
        """The glass of a name, else of a name that differs in upper and lower case alone; None if there is none."""
        alike = (listed for listed in self.glasses if listed.upper() == name.upper())
        key = name if name in self.glasses else next(alike, None)
        return None if key is None else self.glasses[key]


# -- reading ----------------------------------------------------------------------------------------------------------


def read_agf(path: str | Path) -> Catalog:
    """Read a glass catalog in AGF format: UTF-16, UTF-8 or Latin-1, any line ends.

    Raises CatalogError; warns CatalogWarning of records it does not know and of a name defined twice.
    """
    return parse_agf(read_text(path), path)


def read_text(path: str | Path) -> str:
    """The text of a catalog's file, in any encoding of `files.encoding`. Raises CatalogError."""
    path = Path(path)
    try:
        content = read_bytes(path, _LARGEST_FILE)
    except OSError as error:
        raise CatalogError(f"{path}: cannot be read ({error.strerror or error}); expected a glass catalog") from error
    return decode(content, path)


def decode(content: bytes, path: str | Path) -> str:
    """The text of a catalog's bytes; `path` is its place in messages. Raises CatalogError."""
    path, codec = Path(path), encoding(content)
    try:
        text = content.decode(codec).removeprefix("\ufeff").rstrip("\x1a\0")  # end-of-file marks of old programs
    except UnicodeDecodeError as error:
        raise CatalogError(f"{path}: damaged {codec.upper()} text at byte {error.start}; cut off?") from error
    plain = text.encode()
    if len(plain.translate(None, _BINARY)) < len(plain) and (binary := re.search(f"[{_BINARY.decode()}]", text)):
        line = text.count("\n", 0, binary.start()) + 1
        raise _fault(path, line, f"binary data (byte {ord(binary[0]):#04x})", "the text of an AGF")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _names(text: str) -> list[tuple[str, int]]:
    """The name of every glass of a text, and the place where its record begins."""
    records = ((match[1], match.start()) for match in _NAME.finditer(text))
    return [(name, start) for name, start in records if not text[text.rfind("\n", 0, start) + 1 : start].strip()]


class _Listing(Mapping[str, Glass]):
    """The glasses of a catalog's text by their names, each parsed at its first use; raises CatalogError then."""

    def __init__(self, text: str, catalog: str, path: Path) -> None:
        self._text, self._catalog, self._path = text, catalog, path
        starts = _names(text)
        _refuse_many(len(starts), path)
        ends = [*(start for _, start in starts), len(text)][1:]
        self.header = text[: starts[0][1]] if starts else ""
        line = 1 + self.header.count("\n")
        self._places: dict[str, tuple[int, int, int]] = {}
        for (name, start), end in zip(starts, ends, strict=True):
            self._places.setdefault(name, (start, end, line))
            line += text.count("\n", start, end)
        self._parsed: dict[str, Glass] = {}

    def __getitem__(self, name: str) -> Glass:
        if name not in self._parsed:
            start, end, line = self._places[name]
            block = next(_blocks(_records(self._text[start:end], {}, line)))
            self._parsed[name] = _glass(block, self._catalog, self._path)
        return self._parsed[name]

    def __contains__(self, name: object) -> bool:
        return name in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


def listed(text: str, path: str | Path) -> Catalog:
    """The catalog of a text as of `parse_agf`, each glass parsed at its first use.

    Raises CatalogError for no glasses, or more than MOST_GLASSES; for a damaged glass at its first use.
    """
    path = Path(path)
    glasses = _Listing(text, path.stem.upper(), path)
    if not glasses:
        raise _fault(path, 1, "no glass", "an AGF catalog, with one NM record for each glass")
    return Catalog(
        path.stem.upper(), glasses, tuple(re.findall(r"^[ \t]*CC[ \t]+(\S.*)$", glasses.header, re.MULTILINE))
    )


def _refuse_many(count: int, path: Path) -> None:
    if count > MOST_GLASSES:
        raise CatalogError(f"{path}: {count} glasses, more than any catalog ({MOST_GLASSES}); not read")


def parse_agf(text: str, path: str | Path) -> Catalog:
    """The catalog written in the text of an AGF file; `path` gives its name and its place in messages."""
    path = Path(path)
    _refuse_many(len(_names(text)), path)
    name = path.stem.upper()
    comments: list[str] = []
    glasses: dict[str, Glass] = {}
    unknown: dict[str, int] = {}
    for block in _blocks(_records(text, unknown)):
        comments += [rest for _, keyword, rest in block if keyword == "CC" and rest]
        if block[0][1] != "NM":
            stray = next((record for record in block if record[1] != "CC"), None)
            if stray:
                raise _fault(path, stray[0], f"a {stray[1]} record before any glass", "an NM record first")
            continue
        glass = _glass(block, name, path)
        first = glasses.setdefault(glass.listed_name, glass)
        if first is not glass:
            message = f"{path}:{block[0][0]}: {glass.listed_name} is defined again; the first definition holds"
            warnings.warn(message, CatalogWarning, stacklevel=calling_level())
    if not glasses:
        raise _fault(path, 1, "no glass", "an AGF catalog, with one NM record for each glass")
    if unknown:
        listed = ", ".join(f"{word!r} (line {line})" for word, line in list(unknown.items())[:5])
        warnings.warn(f"{path}: left aside lines that begin with {listed}", CatalogWarning, stacklevel=calling_level())
    return Catalog(name, MappingProxyType(glasses), tuple(comments))


def _fault(path: Path, line: int, text: str, expected: str, fix: str = "") -> CatalogError:
    return CatalogError(f"{path}:{line}: found {text}, expected {expected}" + (f"; {fix}" if fix else ""))


def _records(text: str, unknown: dict[str, int], first: int = 1) -> Iterator[tuple[int, str, str]]:
    """(line, keyword, rest) of every record, its lines counted from `first`.

    A line that begins with a number continues the numeric record before it; one that begins with "!" explains a
    status; the first words of other lines are noted in `unknown`, with their lines.
    """
    line_of_record, keyword = 0, ""
    parts: list[str] = []
    for line, content in enumerate(re.split(r"\r\n|\r|\n", text), first):
        word, *rest = content.split(maxsplit=1) or [""]
        if not word or word.startswith("!"):
            continue
        if word in _KEYWORDS:
            if keyword:
                yield line_of_record, keyword, " ".join(parts).strip()
            line_of_record, keyword, parts = line, word, rest
        elif keyword in _NUMERIC and _NUMBER.fullmatch(word):
            parts.append(content)
        elif len(unknown) < 100:
            unknown.setdefault(word[:20], line)
    if keyword:
        yield line_of_record, keyword, " ".join(parts).strip()


def _blocks(records: Iterator[tuple[int, str, str]]) -> Iterator[list[tuple[int, str, str]]]:
    """The records of each glass, its NM first; the file's header, if any, before them."""
    block: list[tuple[int, str, str]] = []
    for record in records:
        if record[1] == "NM" and block:
            yield block
            block = []
        block.append(record)
    if block:
        yield block


def _glass(block: Sequence[tuple[int, str, str]], catalog: str, path: Path) -> Glass:
    line, _, rest = block[0]
    words = rest.split()
    if len(words) < 5:
        raise _fault(path, line, f"NM {rest[:40]}", "NM name formula code nd Vd …", "is the line cut off?")
    name = words[0]
    number, nd_listed, abbe_listed, *flags = _numbers([words[1], *words[3:7]], path, line, blanks=("-1",))
    formula = BY_NUMBER.get(int(number)) if number.is_integer() else None
    if formula is None:
        raise _fault(path, line, f"dispersion formula {words[1]} for {name}", "1 to 13, as the AGF format numbers them")
    line, text = _only(block, "CD", name, path)
    coefficients, count = _numbers(text.split(), path, line), FORMULAS[formula].count
    if len(coefficients) < count:
        figures, expected = f"{len(coefficients)} coefficients for {name}", f"at least {count} for formula {formula}"
        raise _fault(path, line, figures, expected, "is the line cut off?")
    line_of_range, text = _only(block, "LD", name, path)
    shortest, longest, *_ = (*_numbers(text.split(), path, line_of_range), math.nan, math.nan)
    is_unknown = shortest == longest == 0
    if not is_unknown and not 0 < shortest < longest:
        expected = "the shortest and the longest wavelength in µm"
        raise _fault(path, line_of_range, f"LD {text[:40]} for {name}", expected)
    comment = "\n".join(text for _, keyword, text in block if keyword == "GC" and text)
    listing = re.search(r"\balternatives: *([^;\n]+)", comment)
    unlisted = nd_listed <= 0 or (nd_listed == 1 and abbe_listed == 0)  # in catalogs, an unknown nd
    return Glass(
        name=name,
        formula=formula,
        coefficients=torch.tensor(coefficients[:count], dtype=torch.float64),
        catalog=catalog,
        wavelength_range=None if is_unknown else (shortest, longest),
        status=STATUSES.get(int(flags[1]), "") if len(flags) > 1 and flags[1].is_integer() else "",
        nd_listed=None if unlisted else nd_listed,
        abbe_listed=None if unlisted else abbe_listed,
        alternatives=tuple(listing[1].replace(",", " ").split()) if listing else (),
        listed_name=name,
        comment=comment,
        records=tuple(
            (keyword, _numbers(text.split(), path, line, blanks=_UNKNOWN.get(keyword, ("-1",))))
            for line, keyword, text in block
            if keyword in _NUMERIC.keys() - {"CD", "LD"} and text
        ),
    )


def _only(block: Sequence[tuple[int, str, str]], keyword: str, name: str, path: Path) -> tuple[int, str]:
    """The record of a keyword that every glass must have once, (line, text).

    A second record shows that a NM line is lost: the figures are then those of the next glass.
    """
    records = [(line, text) for line, key, text in block if key == keyword]
    if not records:
        raise _fault(path, block[-1][0], f"{name} without a {keyword} record", "one", "is the file cut off?")
    if len(records) > 1:
        fix = "is the NM line of the next glass missing or misspelt?"
        raise _fault(path, records[1][0], f"a second {keyword} record for {name}", "one for each glass", fix)
    return records[0]


def _numbers(words: Sequence[str], path: Path, line: int, *, blanks: Sequence[str] = ()) -> tuple[float, ...]:
    """Numbers of a record; blanks: the figures in place of "-" and "_", the last figure for all further words."""
    try:  # a catalog has some ten thousand of them
        numbers = tuple(map(float, words))
    except ValueError:
        numbers = (math.nan,)
    if math.isfinite(sum(numbers)) and "_" not in "".join(words):
        return numbers
    figures: list[float] = []
    for k, word in enumerate(words):
        if blanks and word in ("-", "_"):
            word = blanks[min(k, len(blanks) - 1)]
        try:
            number = float(word if "D" not in word else word.replace("D", "E"))  # Fortran writes 1.0D-03
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or "_" in word:
            fix = "write decimals with a point" if "," in word else "is the line damaged?"
            raise _fault(path, line, repr(word[:40]), "a finite number", fix)
        figures.append(number)
    return tuple(figures)


# -- writing ----------------------------------------------------------------------------------------------------------


def write_agf(catalog: Catalog, path: str | Path) -> None:
    """Write a catalog as an AGF file in UTF-8, every number so that it reads back to the same bits; atomically.

    Raises ValueError for a glass that the format cannot hold (its formula, or a blank in its name).
    """
    write_text(path, format_agf(catalog))


def format_agf(catalog: Catalog) -> str:
    """The text of an AGF file."""
    lines = [f"CC {comment}" for comment in catalog.comments or (catalog.name,)]
    for listed, glass in catalog.glasses.items():
        lines += _glass_lines(listed, glass)
    return "\n".join(lines) + "\n"


def _glass_lines(name: str, glass: Glass) -> list[str]:
    number = FORMULAS[glass.formula].number if glass.formula in FORMULAS else None
    if number is None or len(name.split()) != 1:
        raise ValueError(f"glass {name!r} with formula {glass.formula!r} cannot be written as AGF")
    n, v = (1.0, 0.0) if glass.nd_listed is None else (glass.nd_listed, glass.abbe_listed or 0.0)
    code = f"{round(n * 1000) % 1000:03d}{round(v * 10) % 1000:03d}"
    status = next((number for number, status in STATUSES.items() if status == glass.status), -1)
    coefficients = glass.coefficients.tolist()
    padded = (*coefficients, *[0.0] * (10 - len(coefficients)))
    figures = [*glass.records, ("CD", padded), ("LD", glass.wavelength_range or (0.0, 0.0))]
    records = sorted(figures, key=lambda record: _NUMERIC[record[0]])
    return [
        f"NM {name} {number} {code} {_spell(n)} {_spell(v)} 0 {status} -1",
        *[f"GC {comment}" for comment in glass.comment.split("\n") if comment],
        *[" ".join([keyword, *map(_spell, numbers)]) for keyword, numbers in records],
    ]


def _spell(number: float) -> str:
    return repr(float(number)).removesuffix(".0")
