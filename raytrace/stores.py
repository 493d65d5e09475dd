"""Stores: JSON files that work resumes from, each checked against a schema when it is read.

A schema is a check: it takes what JSON holds and returns the value, or raises Unfit saying what was found and expected.
A document is one value, replaced as a whole. Records are one a line, appended: what a killed process began to append is
no record, and a damaged line is reported by its number while the others hold.
"""

import dataclasses
import json
import math
import os
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from raytrace.files import append_text, read_bytes, write_text
from raytrace.words import calling_level

#: A value as JSON has it -> the value that is stored. Raises Unfit.
Check = Callable[[object], object]

_MOST = 1 << 30  # bytes of a file
_REPORTED = 5  # damaged lines of a file


class Unfit(ValueError):
    """A value that a store cannot hold: what was found and what was expected; line: of the file, 0 if unknown."""

    def __init__(self, message: str, line: int = 0):
        super().__init__(message)
        self.line = line


class DamagedLine(UserWarning):
    """A line of a store that holds no record; the others are kept."""


# -- schemas ----------------------------------------------------------------------------------------------------------


def number(least: float = -math.inf, most: float = math.inf, *, infinite: bool = False) -> Check:
    """A number from least to most, finite unless infinite ones are allowed."""
    words = "a number" if infinite else "a finite number"
    span = f" from {least:g}" * (least > -math.inf) + f" to {most:g}" * (most < math.inf)

    def check(value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise Unfit(f"found {shown(value)}, expected {words}{span}")
        try:
            found = float(value)
        except OverflowError:
            found = math.nan
        if math.isnan(found) or (math.isinf(found) and not infinite) or not least <= found <= most:
            raise Unfit(f"found {shown(value)}, expected {words}{span}")
        return found

    return check


def whole(least: int = 0, most: int = 2**63 - 1) -> Check:
    """A whole number from least to most."""

    def check(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise Unfit(f"found {shown(value)}, expected a whole number from {least}")
        return value

    return check


def text(value: object) -> str:
    """A text."""
    if not isinstance(value, str):
        raise Unfit(f"found {shown(value)}, expected a text")
    return value


def anything(value: object) -> object:
    """Any value."""
    return value


def either(*checks: Check) -> Check:
    """What one of the checks takes; the last says what was expected."""

    def check(value: object) -> object:
        for one in checks[:-1]:
            try:
                return one(value)
            except Unfit:
                continue
        return checks[-1](value)

    return check


def exactly(*values: object) -> Check:
    """One of these values."""

    def check(value: object) -> object:
        for one in values:
            if type(value) is type(one) and value == one:
                return value
        raise Unfit(f"found {shown(value)}, expected {' or '.join(map(shown, values))}")

    return check


def listed(entry: Check, least: int = 0, most: int | None = None) -> Check:
    """A list of least to most entries, of any length if no most is given."""
    words = f"{least}" if least == most else f"{least} or more" if most is None else f"{least} to {most}"

    def check(value: object) -> list:
        if not isinstance(value, list):
            raise Unfit(f"found {shown(value)}, expected a list")
        if not least <= len(value) <= (len(value) if most is None else most):
            raise Unfit(f"found {shown(value)}, expected {words} of them")
        return [_inside(f"entry {k}", entry, one) for k, one in enumerate(value, 1)]

    return check


def mapped(entry: Check) -> Check:
    """Names with values of one kind."""

    def check(value: object) -> dict:
        return {name: _inside(name, entry, one) for name, one in _names(value).items()}

    return check


def record(needed: Mapping[str, Check], optional: Mapping[str, Check] = MappingProxyType({})) -> Check:
    """Names with values of their kinds; other names are left as they are."""

    def check(value: object) -> dict:
        found = dict(_names(value))
        if missing := [name for name in needed if name not in found]:
            raise Unfit(f"{missing[0]!r} is missing")
        for name, entry in (*needed.items(), *optional.items()):
            if name in found:
                found[name] = _inside(name, entry, found[name])
        return found

    return check


def fields_of(kind: type, nullable: Sequence[str] = ()) -> Check:
    """The plain fields of a dataclass: numbers, texts, names with numbers; nullable: names that may be null.

    Other names are refused, and defaults hold for those that are missing.
    """
    of_type = {float: number(), int: whole(), str: text, dict[str, float]: mapped(number()), dict: mapped(anything)}
    checks, needed = {}, {}
    for field in dataclasses.fields(kind):
        check = of_type[typing.get_type_hints(kind)[field.name]]
        checks[field.name] = either(exactly(None), check) if field.name in nullable else check
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            needed[field.name] = checks[field.name]

    def check(value: object) -> dict:
        if unknown := [name for name in _names(value) if name not in checks]:
            raise Unfit(f"found {unknown[0]!r}, expected {', '.join(checks)}")
        return record(needed, checks)(value)

    return check


def _names(value: object) -> dict:
    if not isinstance(value, dict):
        raise Unfit(f"found {shown(value)}, expected names and values")
    return value


def _inside(name: str, check: Check, value: object) -> object:
    try:
        return check(value)
    except Unfit as error:
        raise Unfit(f"{name[:40]}: {error}") from None


def shown(value: object) -> str:
    """A value in an error, however large it is."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return f"names {', '.join(map(repr, [*value][:3]))}"[:80] if value else "no names"
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 10**20:
        return "a whole number above 1e20" if value > 0 else "a whole number below -1e20"
    return json.dumps(value)[:60]


def parsed(content: bytes) -> object:
    """What JSON in UTF-8 holds. Raises Unfit."""
    try:
        return json.loads(content.decode("utf-8"))
    except json.JSONDecodeError as error:
        raise Unfit(f"is no JSON ({error.msg} at column {error.colno})", error.lineno) from None
    except RecursionError:
        raise Unfit("is nested too deeply") from None
    except ValueError as error:  # no UTF-8, a number of thousands of digits
        raise Unfit(f"is no JSON ({str(error)[:80]})") from None


# -- files ------------------------------------------------------------------------------------------------------------


def read_document(path: str | os.PathLike, check: Check, error: type[ValueError], advice: str) -> object:
    """The value of a document. Raises OSError, and `error` with the file, its line, and the advice how to go on."""
    try:
        return check(parsed(read_bytes(path, _MOST)))
    except Unfit as found:
        place = f"{path}, line {found.line}" if found.line else f"{path}"
        raise error(f"{place}: {found}; {advice}") from found


class Lines:
    """Records of a file, a line of JSON each, behind a first line of another kind if `head` is its check."""

    def __init__(self, path: str | os.PathLike, record: Check, *, head: Check | None = None):
        self.path, self.record, self.head = Path(path), record, head
        self._end: int | None = None  # bytes of what is whole, where more follows
        self._gap = ""  # between the last record and the next

    def read(self, error: type[ValueError], advice: str) -> tuple[object, list[tuple[int, object]]]:
        """The head, None where there is none, and every record with the number of its line.

        Warns DamagedLine of lines that hold none. Raises OSError, and `error` with the advice for a damaged head.
        """
        content = read_bytes(self.path, _MOST) if self.path.exists() else b""
        *lines, torn = content.split(b"\n")
        head, found, damaged = None, [], []
        for number, line in enumerate([*lines, torn], 1):
            is_torn = number > len(lines)
            if is_torn and not line:
                break
            is_head = number == 1 and self.head is not None
            try:
                value = (self.head if is_head else self.record)(parsed(line))
            except Unfit as reason:
                if is_head:
                    raise error(f"{self.path}, line 1: {reason}; {advice}") from reason
                if is_torn:
                    self._end = len(content) - len(torn)
                else:
                    damaged.append(f"line {number}: {reason}")
                continue
            if is_head:
                head = value
            else:
                found.append((number, value))
            self._gap = "\n" if is_torn else ""
        self._report(damaged)
        return head, found

    def _report(self, damaged: list[str]) -> None:
        for words in damaged[:_REPORTED]:
            warnings.warn(f"{self.path}, {words}; the line is ignored", DamagedLine, stacklevel=calling_level())
        if len(damaged) > _REPORTED:
            warnings.warn(f"{self.path}: {len(damaged)} damaged lines in all", DamagedLine, stacklevel=calling_level())

    def begin(self, head: object) -> None:
        """Begin the file with its first line, as a whole or not at all; the folder is made."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_text(self.path, json.dumps(head) + "\n")

    def append(self, value: object) -> None:
        """Add a record behind all that are whole. Raises OSError; the file is as before then."""
        append_text(self.path, self._gap + json.dumps(value) + "\n", end=self._end)
        self._end, self._gap = None, ""
