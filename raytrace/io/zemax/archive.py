"""Read the lens of an OpticStudio archive (.zar), with the glass catalogs that are packed with it.

An archive is a sequence of members, each a header of fixed length and the bytes of one file. The first byte of a header
tells its layout, which public readers found in archives of lens makers (`_LAYOUTS`); all numbers begin with the lowest
byte. A member whose name ends in .LZW is packed: codes of 9 bits, the highest bit first, of a dictionary of the 256
bytes that grows by one word with every code, and of 10 bits, 11, … once it has outgrown those; no code clears it.

Nothing is written, and the names of members are never used as paths. Only the lens and the catalogs that it names are
unpacked, neither further than what such files may hold.
"""

import dataclasses
from array import array
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from raytrace.io.materials import AtHand
from raytrace.io.report import IGNORED, READ, UNKNOWN, Draft, ImportReport
from raytrace.io.source import MAX_BYTES, LensFileError, Place, decode, read_content, shown
from raytrace.io.substitutes import NONE, Substitutes
from raytrace.io.zemax import read as zemax_read
from raytrace.materials import agf
from raytrace.materials.catalogs import Catalog, CatalogError
from raytrace.system.lens import Lens

#: Larger archives are refused before they are read; those of whole systems, with drawings, are some tens of MB.
MAX_ARCHIVE = 256 * 2**20

#: Bytes of all catalogs of an archive that its lens names, unpacked; all that makers publish have some MB.
MAX_CATALOGS = 32 * 2**20

#: More members than any archive has.
_MOST_MEMBERS = 1000


class _Layout(NamedTuple):
    """A header: its length, where the length of the packed bytes and the name stand, and how the name is written."""

    length: int
    size: slice
    name: slice
    encoding: str


_LAYOUTS = {
    0xEA: _Layout(0x14C, slice(0x0C, 0x10), slice(0x20, 0x14C), "latin-1"),
    0xEC: _Layout(0x288, slice(0x10, 0x18), slice(0x30, 0x288), "utf-16-le"),
}

#: What else archives hold, by suffix, and why it is left out.
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
    """A file of an archive: its name without folders, whether its bytes are packed, and these as they stand."""

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
    """The bytes of an archive. Raises LensFileError for a file that is missing, none, or larger than MAX_ARCHIVE."""
    return read_content(path, MAX_ARCHIVE)


def read(
    content: bytes,
    file: str,
    *,
    catalogs: Sequence[Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    substitutes: Substitutes = NONE,
) -> tuple[Lens, ImportReport]:
    """The lens of an archive's bytes and the report of its import, members first; otherwise as `zemax_read.read`."""
    found = members(content, Place(file))
    lens_member = _lens(found, file)
    place = Place(f"{file} ({lens_member.name})")
    text = decode(unpacked(lens_member, MAX_BYTES, place), place)
    used: set[str] = set()
    packed = _catalogs(found, used)
    own = {
        "catalogs": catalogs,
        "strict": strict,
        "configuration": configuration,
        "packed": packed,
        "substitutes": substitutes,
    }
    lens, report = zemax_read.read(text, place.file, **own)
    listed = _listed(found, lens_member, used, file).finished(strict=strict)
    return lens, dataclasses.replace(
        report,
        file=file,
        format="zar",
        keywords=listed.keywords + report.keywords,
        warnings=listed.warnings + report.warnings,
    )


def members(content: bytes, place: Place) -> list[Member]:
    """The files of an archive, in its order. Raises LensFileError where it is damaged or cut off."""
    found, at, whole = [], 0, memoryview(content)
    while at < len(whole):
        layout = _LAYOUTS.get(whole[at])
        if layout is None:
            start = bytes(whole[at : at + 2]).hex(" ")
            known = " or ".join(f"{byte:02x}" for byte in _LAYOUTS)
            message = (
                f"member {len(found)} begins with {start} at byte {at}, expected {known}; an archive (.zar), whole?"
            )
            raise LensFileError(message, place)
        header = bytes(whole[at : at + layout.length])
        start, size = at + layout.length, int.from_bytes(header[layout.size], "little")
        if len(header) < layout.length or size > len(whole) - start:
            left = max(0, len(whole) - start)
            raise LensFileError(f"member {len(found)} has {size} bytes, but {left} follow: cut off or damaged", place)
        if len(found) >= _MOST_MEMBERS:
            raise LensFileError(f"more than {_MOST_MEMBERS} members; no archive has so many", place)
        found.append(_member(header[layout.name], layout.encoding, whole[start : start + size]))
        at = start + size
    return found


def _member(name: bytes, encoding: str, content: memoryview) -> Member:
    """Its name up to the first zero, without folders and with a mark for what cannot be printed."""
    text = name.decode(encoding, "replace").partition("\0")[0].replace("\\", "/").rpartition("/")[2]
    text = "".join(c if c.isprintable() else "?" for c in text)[:100] or "(no name)"
    packed = text.upper().endswith(".LZW")
    return Member(text[:-4] if packed else text, packed, content)


def unpacked(member: Member, most: int, place: Place) -> bytes:
    """The bytes of a member. Raises LensFileError where they are more than `most`, or not those of the packer."""
    if not member.packed:
        if len(member.content) > most:
            raise _too_large(member, most, place)
        return bytes(member.content)
    out, singles = bytearray(), [bytes([k]) for k in range(256)]
    starts, lengths = array("Q"), array("Q")  # where in the output each word of the dictionary stands
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
        if code < 256:
            word = singles[code]
        elif code - 256 < len(starts):
            start, length = starts[code - 256], lengths[code - 256]
            word = out[start : start + length]
            if len(word) < length:  # the word that ends with the first byte of this one, which is its own
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


def _lens(found: Sequence[Member], file: str) -> Member:
    """The one lens of an archive, or among several the one with the archive's name."""
    lenses = [member for member in found if member.suffix == ".zmx"]
    named = [member for member in lenses if member.stem == Path(file).stem.upper()]
    if len(lenses) == 1 or len(named) == 1:
        return lenses[0] if len(lenses) == 1 else named[0]
    listed = ", ".join(member.name for member in (lenses or found)[:8]) + (", …" if len(lenses or found) > 8 else "")
    if lenses:
        message = f"holds {len(lenses)} lenses ({listed}), none with its own name; unpack the one that is meant"
    else:
        message = f"holds no lens (.zmx) among its {len(found)} members" + (f" ({listed})" if found else "")
    raise LensFileError(message, Place(file))


def _catalogs(found: Sequence[Member], used: set[str]) -> AtHand:
    """The catalogs of an archive, unpacked when they are asked for, and then noted in `used`."""
    packed, left = [member for member in found if member.suffix == ".agf"], [MAX_CATALOGS]
    return {member.stem: (f"{member.name} of the archive", partial(_catalog, member, used, left)) for member in packed}


def _catalog(member: Member, used: set[str], left: list[int]) -> Catalog:
    """A catalog of an archive, its glasses parsed when they are asked for; left: how many bytes it may have, and then
    those that are left to the others."""
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


def _listed(found: Sequence[Member], lens: Member, used: set[str], file: str) -> Draft:
    """What became of every member."""
    draft = Draft(file, "zar")
    for member in found:
        status, reason = UNKNOWN, ""
        if member is lens or member.name in used:
            status = READ
        elif member.suffix == ".zmx":
            status, reason = IGNORED, "another lens than that of the archive's name"
        elif member.suffix == ".agf":
            status, reason = IGNORED, "a glass catalog that the lens does not name, or that was given in its place"
        elif member.suffix in _LEFT_OUT:
            status, reason = IGNORED, _LEFT_OUT[member.suffix]
        draft.met(f"member {member.name}", status, Place(file), reason)
    return draft
