"""Read the lens of an OpticStudio archive (.zar), with the glass catalogs that are packed with it.

An archive is a sequence of members, each a header of fixed length and the bytes of one file. The first byte of a header
selects its layout (`_LAYOUTS`, from public readers of archives); numbers are little-endian. A member whose name ends in
.LZW is packed: codes of 9 bits, the highest bit first, of a dictionary of the 256 bytes that grows by one word with
every code, and of 10 bits, 11, … when the dictionary exceeds them; no code clears it.

Nothing is written, and the names of members are never used as paths. Only the lens and the catalogs that it names are
unpacked, each up to a limit of size.
"""

from array import array
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from raytrace.io.source import (
    IGNORED,
    MAX_BYTES,
    READ,
    UNKNOWN,
    Draft,
    LensFileError,
    Place,
    decode,
    read_content,
    shown,
)
from raytrace.io.zemax import read as zemax_read
from raytrace.materials import agf
from raytrace.materials.catalogs import Catalog, CatalogError
from raytrace.system.lens import Lens

#: Larger archives are refused before they are read; those of whole systems, with drawings, are some tens of MB.
MAX_ARCHIVE = 256 * 2**20

#: Bytes of all catalogs of an archive that its lens names, unpacked; all published catalogs have some MB.
MAX_CATALOGS = 32 * 2**20

#: More members than any archive has.
_MOST_MEMBERS = 1000


class _Layout(NamedTuple):
    """A header: its length, the positions of the size of the packed bytes and of the name, and the name's encoding."""

    length: int
    size: slice
    name: slice
    encoding: str


_LAYOUTS = {
    0xEA: _Layout(0x14C, slice(0x0C, 0x10), slice(0x20, 0x14C), "latin-1"),
    0xEC: _Layout(0x288, slice(0x10, 0x18), slice(0x30, 0x288), "utf-16-le"),
}

#: Other members of archives by suffix, and why they are left out.
_LEFT_OUT = {
    suffix: reason
    for reason, suffixes in {
        "settings of the program": ".cfg .zda .ses .lcf",
        "data that no modelled surface reads: coatings, tables, pictures": ".dat .grd .ima .bim .bmp .jpg .png",
        "part for drawing or for non-sequential mode": ".stp .step .igs .iges .sat .stl .zec .pob .zof",
        "merit function, tolerances or test plates": ".mf .tol .top .tpd",
        "program of a user-defined surface, never run": ".dll",
        "macro, never run": ".zpl",
    }.items()
    for suffix in suffixes.split()
}


class Member(NamedTuple):
    """A file of an archive: its name without folders, whether it is packed, and its bytes."""

    name: str
    packed: bool
    content: memoryview

    @property
    def stem(self) -> str:
        return self.name.rpartition(".")[0].upper()

    @property
    def suffix(self) -> str:
        return "." + self.name.rpartition(".")[2].lower()


def load(path: Path) -> bytes:
    """The bytes of an archive. Raises LensFileError for a file that is missing or larger than MAX_ARCHIVE."""
    return read_content(path, MAX_ARCHIVE)


def read(
    content: bytes, file: str, report: Draft, catalogs: Sequence[Path] = (), *, configuration: int | None = None
) -> Lens:
    """The lens of an archive's bytes; report: members first; otherwise as `zemax.read.read`."""
    packed_files = members(content, Place(file))
    lens_member = _lens(packed_files, file)
    place = Place(f"{file} ({lens_member.name})")
    text = decode(unpacked(lens_member, MAX_BYTES, place), place)
    used: set[str] = set()
    left = [MAX_CATALOGS]
    packed = {
        member.stem: (f"{member.name} of the archive", partial(_catalog, member, used, left))
        for member in packed_files
        if member.suffix == ".agf"
    }
    inner = report.again(place.file)
    lens = zemax_read.read(text, place.file, inner, catalogs, configuration=configuration, packed=packed)
    for member in packed_files:
        status, reason = UNKNOWN, ""
        if member is lens_member or member.name in used:
            status = READ
        elif member.suffix == ".zmx":
            status, reason = IGNORED, "another lens than that of the archive's name"
        elif member.suffix == ".agf":
            status, reason = IGNORED, "a glass catalog that the lens does not name, or that was given in its place"
        elif member.suffix in _LEFT_OUT:
            status, reason = IGNORED, _LEFT_OUT[member.suffix]
        report.met(f"member {member.name}", status, Place(file), reason)
    report.append(inner)
    return lens


def text_of_lens(content: bytes, file: str) -> str:
    """The text of the lens file of an archive."""
    member = _lens(members(content, Place(file)), file)
    place = Place(f"{file} ({member.name})")
    return decode(unpacked(member, MAX_BYTES, place), place)


def members(content: bytes, place: Place) -> list[Member]:
    """The files of an archive, in its order. Raises LensFileError where it is damaged or cut off."""
    packed_files: list[Member] = []
    end, whole = 0, memoryview(content)  # end: of the members so far
    while end < len(whole):
        layout = _LAYOUTS.get(whole[end])
        if layout is None:
            first = bytes(whole[end : end + 2]).hex(" ")
            known = " or ".join(f"{byte:02x}" for byte in _LAYOUTS)
            message = f"member {len(packed_files)} begins with {first} at byte {end}, expected {known}: a .zar file?"
            raise LensFileError(message, place)
        header = bytes(whole[end : end + layout.length])
        start, size = end + layout.length, int.from_bytes(header[layout.size], "little")
        if len(header) < layout.length or size > len(whole) - start:
            left = max(0, len(whole) - start)
            raise LensFileError(
                f"member {len(packed_files)} has {size} bytes, but {left} follow: cut off or damaged", place
            )
        if len(packed_files) >= _MOST_MEMBERS:
            raise LensFileError(f"more than {_MOST_MEMBERS} members; no archive has so many", place)
        name = header[layout.name].decode(layout.encoding, "replace").partition("\0")[0]
        name = name.replace("\\", "/").rpartition("/")[2]
        name = "".join(c if c.isprintable() else "?" for c in name)[:100] or "(no name)"
        packed = name.upper().endswith(".LZW")
        packed_files.append(Member(name[:-4] if packed else name, packed, whole[start : start + size]))
        end = start + size
    return packed_files


def unpacked(member: Member, most: int, place: Place) -> bytes:
    """The bytes of a member. Raises LensFileError where they are more than `most`, or damaged."""
    if not member.packed:
        if len(member.content) > most:
            raise _too_large(member, most, place)
        return bytes(member.content)
    out, singles = bytearray(), [bytes([k]) for k in range(256)]
    starts, lengths = array("Q"), array("Q")  # of each word of the dictionary, in the output
    before, bits, held, width = 0, 0, 0, 9  # before: the length of the word before
    for byte in member.content:
        bits, held = bits << 8 | byte, held + 8
        if held < width:
            continue
        held -= width
        code, bits = bits >> held, bits & (1 << held) - 1
        if before:
            starts.append(len(out) - before)
            lengths.append(before + 1)
        word: bytes | bytearray
        if code < 256:
            word = singles[code]
        elif code - 256 < len(starts):
            start, length = starts[code - 256], lengths[code - 256]
            word = out[start : start + length]
            if len(word) < length:  # the word of this code itself, which ends with its first byte
                word += word[:1]
        else:
            count = 256 + len(starts) - bool(before)
            raise LensFileError(f"{shown(member.name)}: code {code} of a dictionary of {count} words; damaged", place)
        out += word
        before = len(word)
        if len(out) > most:
            raise _too_large(member, most, place)
        width = (256 + len(starts)).bit_length()
    return bytes(out)


def _too_large(member: Member, most: int, place: Place) -> LensFileError:
    message = f"{shown(member.name)} holds more than {most / 1e6:.0f} MB, more than any file of its kind; not read"
    return LensFileError(message, place)


def _lens(packed_files: Sequence[Member], file: str) -> Member:
    """The only lens of an archive, or among several lenses that of the archive's name."""
    lenses = [member for member in packed_files if member.suffix == ".zmx"]
    of_name = [member for member in lenses if member.stem == Path(file).stem.upper()]
    if len(lenses) == 1 or len(of_name) == 1:
        return lenses[0] if len(lenses) == 1 else of_name[0]
    listed = ", ".join(member.name for member in (lenses or packed_files)[:8]) + (
        ", …" if len(lenses or packed_files) > 8 else ""
    )
    if lenses:
        message = f"holds {len(lenses)} lenses ({listed}), none with its own name; unpack the intended one"
    else:
        message = f"holds no lens (.zmx) among its {len(packed_files)} members" + (
            f" ({listed})" if packed_files else ""
        )
    raise LensFileError(message, Place(file))


def _catalog(member: Member, used: set[str], left: list[int]) -> Catalog:
    """A catalog of an archive, its glasses parsed on request; left: bytes that it and the others may have."""
    used.add(member.name)
    most = min(MAX_BYTES, left[0])
    left[0] -= most
    try:
        content = unpacked(member, most, Place(member.name))
    except LensFileError as error:
        together = f"{member.name}: the catalogs of the archive hold more than {MAX_CATALOGS / 1e6:.0f} MB; not read"
        raise CatalogError(str(error) if most == MAX_BYTES else together) from error
    left[0] += most - len(content)
    return agf.listed(agf.decode(content, member.name), member.name)
