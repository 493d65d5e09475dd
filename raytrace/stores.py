"""Stores: files from which a computation resumes. Each refuses the records of another computation.

| store | place | identity | records | of |
|---|---|---|---|---|
| `Document` | a file | its part "of" | one, replaced as a whole | `optimize` (checkpoint) |
| `Records` | a file | its first line | lines, appended | `search` (journal) |
| `Folder` | a folder | `settings.json` | files, replaced; lines, appended | training runs, experiments |

A schema is a check: it takes a value of JSON and returns the value that is stored, or raises Unfit with the value found
and the value expected. A file is replaced as a whole or not at all. The incomplete line of a killed process is cut off;
damaged lines are ignored and reported by their number.
"""

import contextlib
import csv
import dataclasses
import io
import json
import math
import os
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias, TypeVar

from raytrace.files import NotWritten, append_text, read_bytes, write_json, write_text
from raytrace.shards import share
from raytrace.words import RaytraceError, RaytraceWarning, calling_level

T = TypeVar("T")

#: A value as JSON has it -> the value that is stored. Raises Unfit.
Check: TypeAlias = Callable[[object], T]

_MOST = 1 << 30  # bytes of a file
_REPORTED = 5  # damaged lines of a file


class Unfit(RaytraceError, ValueError):
    """A value that a store cannot hold; line: of the file, 0 if unknown."""

    def __init__(self, message: str, line: int = 0) -> None:
        super().__init__(message)
        self.line = line


class DamagedLine(RaytraceWarning):
    """A line of a store that holds no record; the others are kept."""


# -- schemas ----------------------------------------------------------------------------------------------------------


def number(least: float = -math.inf, most: float = math.inf, *, infinite: bool = False) -> Check[float]:
    """A number from least to most, finite unless infinite ones are allowed."""
    words = "a number" if infinite else "a finite number"
    span = f" from {least:g}" * (least > -math.inf) + f" to {most:g}" * (most < math.inf)

    def check(value: object) -> float:
        result = math.nan
        if isinstance(value, int | float) and not isinstance(value, bool):
            with contextlib.suppress(OverflowError):
                result = float(value)
        if not least <= result <= most or (math.isinf(result) and not infinite):  # NaN is in no range
            raise Unfit(f"found {shown(value)}, expected {words}{span}")
        return result

    return check


def whole(least: int = 0, most: int = 2**63 - 1) -> Check[int]:
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


def anything(value: object) -> Any:
    """Any value."""
    return value


def either(*checks: Check[Any]) -> Check[Any]:
    """A value of the first check that accepts it; the error is that of the last."""

    def check(value: object) -> Any:
        for accepts in checks[:-1]:
            with contextlib.suppress(Unfit):
                return accepts(value)
        return checks[-1](value)

    return check


def exactly(*values: T) -> Check[T]:
    """One of these values."""

    def check(value: object) -> T:
        for allowed in values:
            if type(value) is type(allowed) and value == allowed:
                return allowed
        raise Unfit(f"found {shown(value)}, expected {' or '.join(map(shown, values))}")

    return check


def listed(entry: Check[T], least: int = 0, most: int | None = None) -> Check[list[T]]:
    """A list of least to most entries, of any length if no most is given."""
    words = f"{least}" if least == most else f"{least} or more" if most is None else f"{least} to {most}"

    def check(value: object) -> list[T]:
        if not isinstance(value, list):
            raise Unfit(f"found {shown(value)}, expected a list")
        if not least <= len(value) <= (len(value) if most is None else most):
            raise Unfit(f"found {shown(value)}, expected {words} of them")
        return [_inside(f"entry {k}", entry, content) for k, content in enumerate(value, 1)]

    return check


def mapped(entry: Check[T]) -> Check[dict[str, T]]:
    """Names with values of one kind."""
    return lambda value: {name: _inside(name, entry, content) for name, content in _names(value).items()}


def record(
    needed: Mapping[str, Check[Any]], optional: Mapping[str, Check[Any]] = MappingProxyType({})
) -> Check[dict[str, Any]]:
    """Names with values of their kinds; other names pass unchanged."""

    def check(value: object) -> dict[str, Any]:
        names = _names(value)
        if missing := [name for name in needed if name not in names]:
            raise Unfit(f"{missing[0]!r} is missing")
        checks = {name: entry for name, entry in {**needed, **optional}.items() if name in names}
        return names | {name: _inside(name, entry, names[name]) for name, entry in checks.items()}

    return check


def fields_of(kind: type, nullable: Sequence[str] = ()) -> Check[dict[str, Any]]:
    """The plain fields of a dataclass: numbers, texts, names with numbers; nullable: names that may be null.

    Other names are refused, and defaults hold for those that are missing.
    """
    of_type: dict[object, Check[Any]] = {float: number(), int: whole(), str: text, dict: mapped(anything)}
    of_type[dict[str, float]] = mapped(number())
    checks, needed = {}, {}
    for field in dataclasses.fields(kind):
        plain = of_type[typing.get_type_hints(kind)[field.name]]
        checks[field.name] = either(exactly(None), plain) if field.name in nullable else plain
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            needed[field.name] = checks[field.name]

    def check(value: object) -> dict[str, Any]:
        if unknown := [name for name in _names(value) if name not in checks]:
            raise Unfit(f"found {unknown[0]!r}, expected {', '.join(checks)}")
        return record(needed, checks)(value)

    return check


def _names(value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise Unfit(f"found {shown(value)}, expected names and values")
    return value


def _inside(name: str, check: Check[T], value: object) -> T:
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


def parsed(content: bytes) -> Any:
    """The value of JSON in UTF-8. Raises Unfit."""
    try:
        return json.loads(content.decode("utf-8"))
    except json.JSONDecodeError as error:
        raise Unfit(f"is no JSON ({error.msg} at column {error.colno})", error.lineno) from None
    except RecursionError:
        raise Unfit("is nested too deeply") from None
    except ValueError as error:  # no UTF-8, a number of thousands of digits
        raise Unfit(f"is no JSON ({str(error)[:80]})") from None


# -- files ------------------------------------------------------------------------------------------------------------


def read_file(
    path: str | os.PathLike,
    decode: Callable[[bytes], T],
    error: type[ValueError],
    advice: str,
    most: int | None = None,
) -> T:
    """The decoded content of a regular file of at most `most` bytes (default 1 GiB); decode raises Unfit.

    Raises OSError, and `error` with the file, its line, and the advice how to resume.
    """
    try:
        return decode(read_bytes(path, _MOST if most is None else most))
    except Unfit as reason:
        place = f"{path}, line {reason.line}" if reason.line else f"{path}"
        raise error(f"{place}: {reason}; {advice}") from reason


def read_document(path: str | os.PathLike, check: Check[T], error: type[ValueError], advice: str) -> T:
    """The value of a JSON file. Raises as `read_file`."""
    return read_file(path, lambda content: check(parsed(content)), error, advice)


class Lines:
    """Records of a file, a line of JSON each, behind a first line of another kind if `head` is its check."""

    def __init__(self, path: str | os.PathLike, record: Check[Any], *, head: Check[Any] | None = None) -> None:
        self.path, self.record, self.head = Path(path), record, head
        self._end: int | None = None  # bytes of complete lines, where more follows
        self._gap = ""  # between the last record and the next

    def encoded(self, value: Any) -> str:
        """The line of a record."""
        return json.dumps(value) + "\n"

    def decoded(self, line: bytes, head: Any) -> Any:
        """The record of a line behind a head; of the first line, the head itself. Raises Unfit."""
        return (self.head if head is None and self.head else self.record)(parsed(line))

    def scan(self, error: type[ValueError], advice: str) -> tuple[Any, list[tuple[int, Any]], list[str]]:
        """The head, None where there is none, every record with the number of its line, and messages of damaged lines.

        Raises OSError, and `error` with the advice for a damaged head.
        """
        content = read_bytes(self.path, _MOST) if self.path.exists() else b""
        *lines, torn = content.split(b"\n")
        head: Any = None
        records: list[tuple[int, Any]] = []
        damaged: list[str] = []
        self._end, self._gap = None, ""
        for number, line in enumerate([*lines, torn] if torn else lines, 1):
            is_head, is_torn = number == 1 and self.head is not None, number > len(lines)
            try:
                value = self.decoded(line, head)
            except Unfit as reason:
                if is_head:
                    raise error(f"{self.path}, line 1: {reason}; {advice}") from reason
                if is_torn:
                    self._end = len(content) - len(torn)
                else:
                    damaged.append(f"{self.path}, line {number}: {reason}")
                continue
            if is_head:
                head = value
            else:
                records.append((number, value))
            self._gap = "\n" if is_torn else ""
        return head, records, damaged

    def read(self, error: type[ValueError], advice: str) -> tuple[Any, list[tuple[int, Any]]]:
        """The head, and every record with the number of its line. Warns DamagedLine; raises as `scan`."""
        head, records, damaged = self.scan(error, advice)
        for words in damaged[:_REPORTED]:
            warnings.warn(f"{words}; the line is ignored", DamagedLine, stacklevel=calling_level())
        if len(damaged) > _REPORTED:
            warnings.warn(f"{self.path}: {len(damaged)} damaged lines in all", DamagedLine, stacklevel=calling_level())
        return head, records

    def begin(self, head: object, *values: object) -> None:
        """Write the first line and these records, as a whole or not at all; the folder is made."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_text(self.path, "".join(map(self.encoded, (head, *values))))
        self._end, self._gap = None, ""

    def append(self, *values: object, sync: bool = True) -> None:
        """Add records behind all that are complete. Raises OSError; the file is as before then."""
        append_text(self.path, self._gap + "".join(map(self.encoded, values)), end=self._end, sync=sync)
        self._end, self._gap = None, ""


class Table(Lines):
    """Rows of numbers as CSV, the first of a row a whole number, under a line of column names."""

    def __init__(self, path: str | os.PathLike) -> None:
        super().__init__(path, anything, head=anything)

    def encoded(self, value: Sequence) -> str:
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(value)
        return line.getvalue()

    def decoded(self, line: bytes, head: list[str] | None) -> list:
        try:
            text = line.decode("utf-8").removesuffix("\r")
            cells = next(csv.reader([text]), [])
            if head is None:
                return cells
        except (UnicodeDecodeError, csv.Error) as reason:
            raise Unfit(f"is no table ({' '.join(str(reason).split())})") from None
        try:
            row = [int(cells[0]), *map(float, cells[1:])]
        except (ValueError, IndexError):
            row = []
        if len(row) != len(head) or not cells[0].isdecimal() or any(map(math.isnan, row)):
            raise Unfit(f"found {text[:400]!r}, expected {len(head)} numbers, of {','.join(head)[:400]}")
        return row


# -- stores ------------------------------------------------------------------------------------------------------------


def changed(before: Mapping, now: Mapping) -> str:
    """How settings differ, "" where they do not."""
    return "; ".join(
        f"{' '.join(key.split())[:400]} was {before.get(key)!r}, now {now.get(key)!r}"
        for key in sorted({*before, *now})
        if before.get(key) != now.get(key)
    )


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of store: its errors in words.

    damaged: error of a file that holds no such records, with the advice how to resume; other: error of a store of
    another identity, whose refusal has {path} and {difference}; difference: how two identities differ, "" where they do
    not; lost: the consequence of a record that cannot be written.
    """

    damaged: type[ValueError]
    advice: str
    other: type[ValueError]
    refusal: str
    difference: Callable[[Mapping, Mapping], str] = changed
    lost: str = "the computation continues, but cannot resume from here"

    def verify(self, path: Path | None, before: Mapping, now: Mapping) -> None:
        """Raise `other` for a store of another identity."""
        if difference := self.difference(before, now):
            raise self.other(self.refusal.format(path=path, difference=difference))


class Store:
    """Records of one computation in a file. Only the first of several processes writes.

    path: None stores nothing; identity: everything that the records depend on, as plain values for JSON.
    """

    def __init__(self, path: str | os.PathLike | None, identity: Mapping, kind: Kind) -> None:
        self.path, self.identity, self.kind = None if path is None else Path(path), identity, kind

    def keep(self, write: Callable[..., None], *values: object) -> None:
        """Write by a function. Warns NotWritten where that fails: the computation continues and stores nothing more."""
        if self.path is None or share().rank:
            return
        try:
            write(*values)
        except OSError as error:
            words = f"{self.path}: {error.strerror}; {self.kind.lost}"
            warnings.warn(words, NotWritten, stacklevel=calling_level())
            self.path = None


class Document(Store):
    """A file of one record, {"of": the identity, …}, replaced as a whole."""

    def read(self, check: Check[T]) -> T:
        """The checked record. Raises OSError and the errors of the kind."""
        if self.path is None:
            raise FileNotFoundError("no file of this record; give its path")

        def checked(value: object) -> T:
            names = _names(value)
            if "of" not in names:
                raise Unfit("has no identity ('of'); an older version wrote it")
            self.kind.verify(self.path, _inside("of", mapped(anything), names["of"]), self.identity)
            return check(value)

        return read_document(self.path, checked, self.kind.damaged, self.kind.advice)

    def write(self, values: Mapping) -> None:
        """Replace the record. Warns NotWritten."""
        self.keep(write_json, self.path, {"of": self.identity, **values})


class Records(Store):
    """A file of appended records, a line of JSON each, behind a first line that holds the identity."""

    def __init__(self, path: str | os.PathLike | None, identity: Mapping, kind: Kind, check: Check[Any]) -> None:
        super().__init__(path, identity, kind)
        self.lines = None if path is None else Lines(path, check, head=mapped(anything))

    def read(self) -> list[tuple[int, Any]]:
        """Every record with the number of its line; a missing file is started.

        Warns DamagedLine. Raises OSError and the errors of the kind.
        """
        if self.lines is None:
            return []
        before, records = self.lines.read(self.kind.damaged, self.kind.advice)
        if before is not None:
            self.kind.verify(self.path, before, self.identity)
        elif not share().rank:
            self.lines.begin(self.identity)
        return records

    def append(self, value: object) -> None:
        """Add a record. Warns NotWritten."""
        if self.lines is not None:
            self.keep(self.lines.append, value)


class Folder:
    """A folder with the identity in `settings.json`; it is made, and refused if it has another identity.

    usual: defaults of settings that a folder of an older version does not have.
    """

    def __init__(
        self, path: str | os.PathLike, identity: Mapping, kind: Kind, *, usual: Mapping = MappingProxyType({})
    ) -> None:
        now, defaults = (json.loads(json.dumps(dict(values))) for values in (identity, usual))
        self.path = Path(path)
        self.path.mkdir(parents=True, exist_ok=True)
        file = self.path / "settings.json"
        if file.exists():
            before = read_document(file, mapped(anything), kind.damaged, kind.advice)
            kind.verify(self.path, {key: value for key, value in defaults.items() if key in now} | before, now)
        elif not share().rank:
            write_json(file, now)

    def record(self, name: str, compute: Callable, *, write: Callable, read: Callable[[Path], T]) -> T:
        """The record of a file, by `read(path)`; where there is none it is computed and stored by `write(path, …)`."""
        file = self.path / name
        if not file.exists():
            write(file, compute())
        return read(file)
