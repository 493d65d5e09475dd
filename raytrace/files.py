"""Files: those that travel with the package, and how every file is written."""

import csv
import errno
import fcntl
import io
import json
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from raytrace.words import RaytraceWarning

_OPEN_FILES = "/proc/self/fd"  # the path by which an unnamed file is given a name


class NotWritten(RaytraceWarning):
    """An output could not be written; the computation continued without it."""


def shipped(folder: str) -> Path:
    """The folder `glass_catalogs` or `lenses`: inside an installed package, next to it in a checkout."""
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
    """The encoding of a text: UTF-16 by its mark or its zeros, UTF-8, else Latin-1."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    # Lens and glass files are mostly ASCII: in UTF-16 without its mark every second byte of the beginning is zero.
    head = content[: min(len(content), 512) // 2 * 2]
    for codec, zeros in (("utf-16-le", head[1::2].count(0)), ("utf-16-be", head[0::2].count(0))):
        if head and zeros > 0.4 * len(head):
            return codec
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def write_atomically(path: str | os.PathLike, write: Callable[[BinaryIO], object]) -> None:
    """Replace a file as a whole or not at all: `write` fills a temporary file, which is then renamed.

    The temporary file, in the same folder, has no name until complete, where the system allows that: a killed process
    leaves no file. Other abandoned temporary files of the target are removed. A link is written through. Raises OSError
    naming `path` where it cannot be written, or is no regular file; other errors of `write` pass through.
    """
    target = _regular(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(6)}.tmp")
    try:
        _remove_abandoned(target)
        with _unnamed(target.parent) or open(temporary, "xb") as file:
            with suppress(OSError):  # not every file system has locks
                fcntl.flock(file, fcntl.LOCK_EX)  # held until the file is closed, or the process ends: it is in use
            write(file)
            file.flush()
            os.fsync(file.fileno())
            if not isinstance(file.name, str | os.PathLike):
                folder = os.open(target.parent, os.O_RDONLY)  # with it `link` follows the link that an open file is
                try:
                    os.link(f"{_OPEN_FILES}/{file.fileno()}", temporary, src_dir_fd=folder, follow_symlinks=True)
                finally:
                    os.close(folder)
            os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(temporary), temporary):
            raise OSError(error.errno, f"cannot be written: {error.strerror or error}", str(path)) from error
        raise


def _unnamed(folder: Path) -> BinaryIO | None:
    """A new file of a folder, open for writing, that has no name; None where the system has no such files."""
    if not hasattr(os, "O_TMPFILE") or not os.path.isdir(_OPEN_FILES):
        return None
    try:
        return os.fdopen(os.open(folder, os.O_WRONLY | os.O_TMPFILE | os.O_CLOEXEC, 0o666), "wb")
    except OSError:
        return None


def _remove_abandoned(target: Path) -> None:
    """Remove temporary files of a target that no living process writes: those are locked."""
    pattern = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{12}}\.tmp")
    with suppress(OSError):
        for name in filter(pattern.fullmatch, os.listdir(target.parent)):
            with suppress(OSError), open(target.with_name(name), "rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                target.with_name(name).unlink()


def append_text(path: str | os.PathLike, text: str, *, end: int | None = None, sync: bool = True) -> None:
    """Append a text in UTF-8 to a file, as a whole or not at all. Raises OSError naming `path`.

    end: length in bytes to which the file is cut first, without the text that a killed process began to append; sync:
    wait until the text is on the disk.
    """
    try:
        with open(path, "ab", buffering=0) as file:
            if end is not None:
                file.truncate(end)
            whole, left = file.seek(0, os.SEEK_END), memoryview(text.encode())
            try:
                while left:
                    left = left[file.write(left) :]
                if sync:
                    os.fsync(file.fileno())
            except BaseException:
                file.truncate(whole)
                raise
    except OSError as error:
        raise OSError(error.errno, f"cannot be written: {error.strerror}", str(path)) from error


def check_output(path: str | os.PathLike, suffixes: Sequence[str] = ()) -> None:
    """Refuse an output file that cannot be written, before its content is computed.

    suffixes: those that are known, all if none are given. Raises ValueError for another suffix, and OSError for a
    folder that does not exist or is not writable, and for a file that is not regular.
    """
    target = Path(os.path.realpath(path))
    if suffixes and target.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: expected a name that ends in {', '.join(filter(None, suffixes))}")
    if target.is_dir():
        raise OSError(errno.EISDIR, "is a folder; give the name of a file to write", str(path))
    _check_folder(_regular(path).parent, path)


def _regular(path: str | os.PathLike) -> Path:
    """The file that a path or link leads to. Raises OSError for one that is not regular."""
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "is not a regular file; give the name of a file to write", str(path))
    return target


def check_output_folder(path: str | os.PathLike) -> None:
    """Refuse an output folder that is not writable and cannot be made, before the computation. Raises OSError."""
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_dir():
        raise OSError(errno.ENOTDIR, "is a file; give the name of a folder to write in", str(path))
    _check_folder(next(folder for folder in (target, *target.parents) if folder.exists()), path)


def _check_folder(folder: Path, path: str | os.PathLike) -> None:
    if not folder.is_dir():
        state = "is a file, not a folder" if folder.exists() else "does not exist; make it first"
        raise OSError(errno.ENOENT, f"cannot be written: the folder {folder} {state}", str(path))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, f"cannot be written: no permission to write in {folder}", str(path))


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text in UTF-8, as a whole or not at all."""
    write_atomically(path, lambda file: file.write(text.encode()))


def write_json(path: str | os.PathLike, document: object) -> None:
    """Write a document as JSON, as a whole or not at all."""
    write_text(path, json.dumps(document, indent=1))


def write_table(path: str | os.PathLike, rows: Iterable, columns: Sequence[str] = (), **spelling: Callable) -> None:
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
