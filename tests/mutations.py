"""Files damaged by chance, and what a reader owes them: a value or its own one-line error, soon, in little memory."""

import contextlib
import io
import re
import resource
import signal
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import NamedTuple

SECONDS, MEGABYTES = 5, 500

_NUMBER = re.compile(rb"[+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?")
_NUMBERS = [
    *b"nan inf -inf 1e999 1e308 -1e308 1e-320 5e-324 0 -0.0 -1 1 2 3 7 24 1000 65535 99999999 4294967296".split(),
    *b"1e9 0.5 12345678901234567890 1D0 0D0 1d-3 1_0 0x10 1,5 1,234 1.2.3 --1".split(),
    *(text.encode() for text in ("١", "１", "−1", "")),
]
_BYTES = (0, 1, 0x20, 0x22, 0x23, 0x2C, 0x0A, 0x0D, 0x7F, 0x80, 0xFF)


class Reader(NamedTuple):
    """originals: whole files; read: what reads the bytes of one; errors: what it may raise."""

    originals: tuple[bytes, ...]
    read: Callable[[bytes], object]
    errors: tuple[type[Exception], ...]


def damaged(content: bytes, other: bytes, source: Random) -> bytes:
    """Bytes flipped, lost, put in or spliced from another file; lines swapped, lost or doubled; numbers replaced."""
    if content.startswith(b"PK") and source.randrange(2):
        return _inside(content, source)
    for _ in range(source.choice((1, 1, 1, 2, 4))):
        content = source.choice(_DAMAGES)(content, other, source)
    return content


def _flipped(content: bytes, other: bytes, source: Random) -> bytes:
    changed = bytearray(content)
    for _ in range(source.choice((1, 1, 2, 8))):
        if changed:
            at = source.randrange(len(changed))
            changed[at] = source.choice((changed[at] ^ 1 << source.randrange(8), source.choice(_BYTES)))
    return bytes(changed)


def _truncated(content: bytes, other: bytes, source: Random) -> bytes:
    return content[: source.randrange(len(content) + 1)]


def _spliced(content: bytes, other: bytes, source: Random) -> bytes:
    start, end = sorted(source.randrange(len(other) + 1) for _ in range(2))
    at = source.randrange(len(content) + 1)
    return content[:at] + other[start:end][:4096] + content[at + source.randrange(2) * (end - start) :]


def _cut(content: bytes, other: bytes, source: Random) -> bytes:
    at = source.randrange(len(content) + 1)
    return content[:at] + content[at + source.randrange(1, 40) :]


def _renumbered(content: bytes, other: bytes, source: Random) -> bytes:
    found = list(_NUMBER.finditer(content[: 1 << 16]))
    if not found:
        return _flipped(content, other, source)
    start, end = source.choice(found).span()
    return content[:start] + source.choice(_NUMBERS) + content[end:]


def _reordered(content: bytes, other: bytes, source: Random) -> bytes:
    lines = content.split(b"\n")
    at, place = source.randrange(len(lines)), source.randrange(len(lines))
    kind = source.randrange(3)
    if kind == 0:
        lines[at], lines[place] = lines[place], lines[at]
    elif kind == 1:
        del lines[at]
    else:
        lines.insert(place, lines[at])
    return b"\n".join(lines)


def _inside(content: bytes, source: Random) -> bytes:
    """An archive with one of its files damaged, and all checksums right."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = {part.filename: archive.read(part) for part in archive.infolist()}
    name = source.choice(list(parts))
    parts[name] = damaged(parts[name], source.choice(list(parts.values())), source)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for part, inner in parts.items():
            archive.writestr(zipfile.ZipInfo(part), inner)
    return stream.getvalue()


def resealed(content: bytes) -> bytes:
    """A PNG with the checksums of its chunks made right again: so that the damage is met behind them."""
    parts, at = [content[:8]], 8
    while at + 12 <= len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        body = content[at + 4 : at + 8 + length]
        parts.append(content[at : at + 4] + body + struct.pack(">I", zlib.crc32(body)))
        at += 12 + length
    return b"".join(parts) + content[at:]


_DAMAGES = (_flipped, _flipped, _truncated, _spliced, _cut, _renumbered, _renumbered, _reordered)


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """What runs inside may take MEGABYTES more address space than there is, and stops when `_limited` says so."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEGABYTES * 2**20, before[1]))
    handlers = {kind: signal.signal(kind, _too_slow) for kind in (signal.SIGALRM, signal.SIGPROF)}
    try:
        yield
    finally:
        _limited(0)
        for kind, handler in handlers.items():
            signal.signal(kind, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


def _limited(seconds: int) -> None:
    """From now on so much time of the processor, and twelve times as long on a clock: the machine may be busy."""
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.alarm(12 * seconds)


class TooSlow(BaseException):
    """Not an Exception, so that no reader takes it for one of a decoder."""


def _too_slow(*_: object) -> None:
    raise TooSlow(f"more than {SECONDS} s")


def _check(error: BaseException) -> None:
    """One line, and not for want of memory."""
    assert str(error).strip()
    assert "\n" not in str(error), repr(error)
    cause = error
    while cause is not None:
        assert not isinstance(cause, MemoryError), "took more memory than it may"
        cause = cause.__cause__


def survive(reader: Reader, count: int, seed: int) -> tuple[int, int]:
    """Read `count` damaged files; how many were read, and how many refused. Raises what no reader may raise."""
    source, read = Random(seed), 0
    with bounded(), warnings.catch_warnings(action="ignore"):
        for _ in range(count):
            content = damaged(source.choice(reader.originals), source.choice(reader.originals), source)
            if content.startswith(b"\x89PNG") and source.randrange(2):
                content = resealed(content)
            _limited(SECONDS)
            try:
                reader.read(content)
                read += 1
            except reader.errors as error:
                _check(error)
            except BaseException as error:
                error.add_note(f"of a damaged file of {len(content)} bytes: {content[:3000]!r}")
                raise
    return read, count - read
