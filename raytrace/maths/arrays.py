"""Arrays of .npy and .npz files: sizes are checked before memory is taken, and no object is unpickled."""

import io
import math
import warnings
import zipfile

import numpy as np

from raytrace.words import RaytraceError

#: Bytes of memory that the arrays of one file may take.
LARGEST = 2**32

_KINDS = "biufSU"  # truth, whole and real numbers, texts
_FORMAT = np.lib.format


class ArrayError(RaytraceError, ValueError):
    """Bytes that hold no array of numbers or texts, in one line."""


def read_npy(content: bytes) -> list[np.ndarray]:
    """The arrays of an .npy file, one behind another. Raises ArrayError."""
    stream = io.BytesIO(content)
    arrays = [_array(stream, len(content))]
    while stream.tell() < len(content):
        arrays.append(_array(stream, len(content)))
    return arrays


def read_npz(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name. Raises ArrayError."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > LARGEST:
                raise ArrayError(f"its arrays take more than {LARGEST >> 20} MB")
            parts = {member.filename: _member(archive, member) for member in members}
    except ArrayError:
        raise
    except Exception as error:  # zipfile, zlib and lzma raise whatever their parsing meets
        raise ArrayError(f"no .npz file of arrays, damaged or cut off ({_words(error)})") from error
    return {name.removesuffix(".npy"): _only(name, read_npy(part)) for name, part in parts.items()}


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """The content of a member of an archive. Raises ArrayError where its size differs from that of its entry."""
    with archive.open(member) as stream:
        part = stream.read(member.file_size + 1)
    if len(part) != member.file_size:
        raise ArrayError(f"{member.filename!r} is {member.file_size} bytes long by its entry, but not by its content")
    return part


def _only(name: str, arrays: list[np.ndarray]) -> np.ndarray:
    if len(arrays) != 1:
        raise ArrayError(f"{name!r} holds {len(arrays)} arrays; expected one")
    return arrays[0]


def _array(stream: io.BytesIO, length: int) -> np.ndarray:
    try:
        with warnings.catch_warnings(action="ignore"):
            version = _FORMAT.read_magic(stream)
            readers = {(1, 0): _FORMAT.read_array_header_1_0, (2, 0): _FORMAT.read_array_header_2_0}
            shape, by_columns, kind = readers[version](stream)
    except Exception as error:  # the header is Python's text: parsing it raises all that parsing Python can
        raise ArrayError(f"no .npy array, damaged or cut off ({_words(error)})") from error
    if kind.kind not in _KINDS or kind.hasobject:
        raise ArrayError(f"an array of {kind}; expected numbers")
    if not all(isinstance(part, int) and part >= 0 for part in shape) or len(shape) > 32:
        raise ArrayError(f"an array of the shape {str(shape)[:60]}")
    count = math.prod(shape)
    size = count * kind.itemsize
    if size > length - stream.tell():
        raise ArrayError(f"an array of {count} numbers announced, but only {length - stream.tell()} bytes follow")
    array = np.frombuffer(stream.read(size), kind, count) if size else np.zeros(count if count < LARGEST else 0, kind)
    try:
        return array.reshape(shape, order="F" if by_columns else "C")
    except ValueError as error:
        raise ArrayError(f"an array of the shape {str(shape)[:60]}") from error


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
