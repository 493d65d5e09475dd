"""Files: those that travel with the package, and how every file is written."""

import csv
import errno
import io
import json
import os
import secrets
import stat
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO


def shipped(folder: str) -> Path:
    """The folder `glass_catalogs` or `lenses`: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    installed = package / folder
    return installed if installed.is_dir() else package.parent / folder


def read_bytes(path: str | os.PathLike, most: int) -> bytes:
    """All of a regular file of at most `most` bytes. Raises OSError for anything else: a pipe is not waited for."""
    try:
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise OSError(errno.EINVAL, "is not a regular file", str(path))
            if status.st_size > most:
                raise OSError(errno.EFBIG, f"is larger than {most >> 20} MB", str(path))
            return file.read(status.st_size)  # as much as was there: a file may grow
    except ValueError as error:  # a zero byte in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from error


def encoding(content: bytes) -> str:
    """How a text is encoded that does not say so: UTF-16 by its mark or its zeros, UTF-8, else Latin-1."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    # Lens and glass files are mostly ASCII: in UTF-16 without its mark every second byte of the beginning is zero.
    head = content[: min(len(content), 512) // 2 * 2]
    for found, zeros in (("utf-16-le", head[1::2].count(0)), ("utf-16-be", head[0::2].count(0))):
        if head and zeros > 0.4 * len(head):
            return found
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def write_atomically(path: str | os.PathLike, write: Callable[[BinaryIO], None]) -> None:
    """Replace a file as a whole or not at all: `write` fills a temporary file beside it, which is then renamed.

    A link is written through. Raises OSError naming `path` where it cannot be written, or is no regular file; what
    `write` raises passes through. Nothing is left behind.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "is not a regular file; give the name of a file to write", str(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(6)}.tmp")
    try:
        with open(temporary, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (str(temporary), temporary):
            raise OSError(error.errno, f"cannot be written: {error.strerror}", str(path)) from error
        raise


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text in UTF-8, as a whole or not at all."""
    write_atomically(path, lambda file: file.write(text.encode()))


def write_json(path: str | os.PathLike, document: object) -> None:
    """Write a document as JSON, as a whole or not at all."""
    write_text(path, json.dumps(document, indent=1))


def write_table(path: str | os.PathLike, rows: Iterable, columns: Sequence[str] = (), **spelling) -> None:
    """Write `table` of rows, as a whole or not at all."""
    write_text(path, table(rows, columns, **spelling))


def table(rows: Iterable, columns: Sequence[str] = (), *, floats: Callable[[float], object] = float) -> str:
    """Rows of one kind as CSV under a line of headings; None is an empty cell.

    rows: mappings, or values such as dataclasses, whose fields are the cells. columns: their names in order, those of
    the first row if none are given. floats: how a number is written, as "{:.6g}".format; by default such that it comes
    back exactly.
    """
    rows = list(rows)
    columns = columns or list(rows[0] if isinstance(rows[0], Mapping) else rows[0].__dataclass_fields__)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        cells = [row[name] if isinstance(row, Mapping) else getattr(row, name) for name in columns]
        writer.writerow(floats(cell) if isinstance(cell, float) else cell for cell in cells)
    return text.getvalue()
