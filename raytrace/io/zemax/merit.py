"""The merit function and the tolerances of a .zmx file, and those of a merit function file (.MF): a row a line.

    TRAC 0 1 0 0 3.35710687E-1 0 0 7.27220522E-2 0 0        operand, two whole numbers, four numbers, target, weight …
    BLNK Operands for field 1.
    TOL TTHI   1   2 -2.0E-1 2.0E-1   0 0 0                 operand, two whole numbers, least and largest change …

They stand between the last surface and the configurations. In an .MF file two more numbers stand before the target.
"""

import dataclasses
import math
import re
from collections.abc import Iterable
from os import PathLike
from pathlib import Path

from raytrace.io.report import IGNORED, READ, Draft
from raytrace.io.source import LensFileError, Place, read_text
from raytrace.io.spelling import is_number, one_line, plain
from raytrace.io.zemax.keywords import SYSTEM_IGNORED, TAIL_REASON, Record, records
from raytrace.system.dimensions import DIMENSION
from raytrace.system.optimization_data import Row

#: Keywords of tolerances: an operand, a comment.
_TOLERANCES = ("TOL", "TCMM")

#: The operand of tolerances that stands alone where there are none.
_NO_TOLERANCE = "TOFF"

_TEXT = "BLNK"
_OPERAND = re.compile(r"[A-Z][A-Z0-9]{3}")


def rows(found: Iterable[Record], report: Draft, *, ahead: int = 0) -> tuple[Row, ...]:
    """The rows of the lines that are of a merit function, lengths in the unit of the file; every line is reported.

    ahead: how many numbers stand before the target that a .zmx file does not have. Raises LensFileError for a number
    of a known operand that is none.
    """
    read, strangers = [], {}
    for record in found:
        word = record.keyword
        if word in _TOLERANCES:
            continue
        if word == _TEXT:
            read.append(Row(word, text=record.text.strip()))
        elif word in DIMENSION or (word not in SYSTEM_IGNORED and _is_like_one(record)):
            read.append(_row(record, ahead))
            if word not in DIMENSION:
                strangers.setdefault(word, record.place)
        else:
            reason = SYSTEM_IGNORED.get(word, TAIL_REASON)
            report.met(word[:40], IGNORED, record.place, reason)
            continue
        report.met(word, READ, record.place)
    for word, place in strangers.items():
        report.note(f"{place}: {word} is no known operand of a merit function; kept as it stands")
    return tuple(read)


def _is_like_one(record: Record) -> bool:
    """Whether a line with a name that is not known has the form of a row."""
    first = record.words[:9]
    return bool(_OPERAND.fullmatch(record.keyword)) and len(first) > 7 and all(map(is_number, first))


def _row(record: Record, ahead: int) -> Row:
    integers = tuple(record.integer(k, "whole number", 0) for k in (0, 1))
    numbers = tuple(record.number(k, "argument", 0.0) for k in range(2, 6))
    target, weight = (record.number(6 + ahead + k, what, 0.0) for k, what in enumerate(("target", "weight")))
    behind = record.words[8 + ahead :]
    text = next((k for k, word in enumerate(behind) if not is_number(word)), len(behind))
    further = (*record.words[6 : 6 + ahead], *behind[:text])
    words = {"text": " ".join(behind[text:]), "further": tuple(plain(word) for word in further if is_number(word))}
    return Row(record.keyword, integers, numbers, target, weight, **words)


def lines(merit: Iterable[Row], place: Place) -> list[str]:
    """The lines of a merit function. Raises LensFileError for what is no row of one."""
    return [_line(row, place) for row in merit]


def _line(row: Row, place: Place) -> str:
    if not isinstance(row.operand, str):  # a text in its place, so that rows below keep their numbers
        name = one_line(row.name, "a name in the merit function", place)
        return f"{_TEXT} {name}: a function of the lens, target {row.target:g}, weight {row.weight:g}"
    if not _OPERAND.fullmatch(row.operand):
        raise LensFileError(f"{row.operand!r} is no name of an operand of four capital letters", place)
    text = one_line(row.text, "a text of the merit function", place)
    if row.operand == _TEXT:
        return f"{_TEXT} {text}".rstrip()
    numbers = (*row.numbers, row.target, row.weight, *row.further)
    if not all(map(math.isfinite, numbers)):
        raise LensFileError(f"{row.operand}: only finite numbers can be written", place)
    words = [row.operand, *map(str, row.integers), *(repr(float(number)) for number in numbers), text]
    return " ".join(words).rstrip()


# -- tolerances -------------------------------------------------------------------------------------------------------


def tolerances(found: Iterable[Record], report: Draft) -> tuple[str, ...]:
    """The lines of tolerances as they stand; none where only that there are none is said."""
    own = [record for record in found if record.keyword in _TOLERANCES]
    for record in own:
        report.met(record.keyword, READ, record.place)
    if all(record.keyword == "TOL" and record.words[:1] == (_NO_TOLERANCE,) for record in own):
        return ()
    return tuple(f"{record.keyword} {record.text.strip()}".rstrip() for record in own)


# -- files of a merit function alone ----------------------------------------------------------------------------------


def read_merit(path: str | PathLike) -> tuple[Row, ...]:
    """The rows of a merit function file (.MF) of OpticStudio, in the unit of length of the lens that it belongs to.

    `dataclasses.replace(lens.optimization_data, merit=rows)` is the optimisation data with them. Raises LensFileError.
    """
    name, report = str(path), Draft(str(path), "mf")
    listed = [record for record in records(read_text(Path(path)), name) if record.keyword != "VERS"]
    found = rows(listed, report, ahead=2)
    if not found:
        hint = "is it a merit function file of OpticStudio (.MF)?"
        raise LensFileError(f"no operand of a merit function in {len(listed)} lines; {hint}", Place(name))
    unread = [record for record in listed if not _is_read(record)]
    if unread:
        raise LensFileError(f"{unread[0].keyword[:40]} is no line of a merit function", unread[0].place)
    return tuple(dataclasses.replace(row, further=row.further[2:]) for row in found)


def _is_read(record: Record) -> bool:
    return record.keyword in (*_TOLERANCES, _TEXT) or record.keyword in DIMENSION or _is_like_one(record)
