"""The text of a lens file, read with care: size and encoding, and the errors that name file, line and surface."""

import os
import re
import stat
from pathlib import Path
from typing import NamedTuple

from raytrace.files import encoding

#: Larger files are refused before they are read; the largest real lens files are a few hundred kB.
MAX_BYTES = 16 * 2**20

#: More surfaces than any sequential lens has; a file with more is damaged or not a lens.
MAX_SURFACES = 1000

#: Longer files, and longer lines, are no lens files; the limits keep every reader quick on them.
MAX_LINES = 200_000
MAX_LINE = 100_000

_NOT_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f\ufffd]")


class Place(NamedTuple):
    """Where in a lens file something stands: file name, line from 1, surface from 0 (None where they do not apply)."""

    file: str
    line: int | None = None
    surface: int | None = None

    def __str__(self) -> str:
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        return place if self.surface is None else f"{place}, surface {self.surface}"


class LensFileError(ValueError):
    """A lens file that cannot be read or written, said in one line: where, what was found, what to do.

    file, line, surface: where it was found; None where that does not apply.
    """

    def __init__(self, message: str, place: Place):
        super().__init__(" ".join(f"{place}: {message}".split()))
        self.file, self.line, self.surface = place


class UnsupportedSurface(LensFileError):
    """A surface of a type that is not modelled; it is never dropped and never read as another type."""


class LensFileWarning(UserWarning):
    """A lens file that was read, but from which something was left out or assumed."""


def read_text(path: Path) -> str:
    """The text of a lens file: UTF-16 (either order, with or without mark), UTF-8, else Latin-1.

    Raises LensFileError for a file that is missing, not a regular file, larger than MAX_BYTES, or not text.
    """
    return decode(read_content(path, MAX_BYTES), Place(str(path)))


def read_content(path: Path, most: int) -> bytes:
    """The bytes of a lens file. Raises LensFileError for one that is missing, no regular file or larger than `most`."""
    place = Place(str(path))
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise LensFileError("is not a regular file; give the path of a lens file", place)
        if status.st_size > most:
            size = f"{status.st_size / 1e6:.0f} MB"
            raise LensFileError(f"is {size} long, more than any lens file ({most / 1e6:.0f} MB); not read", place)
        with open(path, "rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise LensFileError(f"cannot be read: {error.strerror or error}", place) from error
    except ValueError as error:
        if isinstance(error, LensFileError):
            raise
        raise LensFileError(f"cannot be opened: {error}", place) from error
    return content


def decode(content: bytes, place: Place) -> str:
    """Bytes to text by the rules of `read_text`."""
    if not content.strip():
        raise LensFileError("is empty", place)
    found = encoding(content)
    try:
        text = content.decode(found)
    except UnicodeDecodeError as error:
        message = f"is not valid {found.upper()} at byte {error.start}: damaged or cut off; save it again as UTF-8"
        raise LensFileError(message, place) from error
    text = text.removeprefix("\ufeff").rstrip("\x1a\x00 \t\r\n") + "\n"
    found = _NOT_TEXT.search(text)
    if found:
        line = text.count("\n", 0, found.start()) + 1
        message = f"holds the character U+{ord(found[0]):04X}: binary, or of an unknown encoding; save it as UTF-8"
        raise LensFileError(message, place._replace(line=line))
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    if len(lines) > MAX_LINES or max(map(len, lines)) > MAX_LINE:
        found = f"{len(lines)} lines, the longest of {max(map(len, lines))} characters"
        raise LensFileError(f"{found}; more than any lens file ({MAX_LINES}, {MAX_LINE})", place)
    return text


def shown(text: str) -> str:
    """A piece of a file as an error quotes it: at most 40 characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")
