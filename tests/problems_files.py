"""Lens files: their numbers, and files that are damaged."""

import dataclasses
import random
from pathlib import Path

import pytest
import torch
from problems import number

from raytrace.io import FORMATS, LensFileError, read_lens_with_report
from raytrace.io.source import Place, decode
from raytrace.materials.catalogs import UnknownGlass
from raytrace.system.lens import Lens


def leaves(value, path=""):
    """Every number and text of a lens with its name; numbers as their bytes."""
    if isinstance(value, torch.Tensor):
        return [(path, tuple(value.shape), value.double().numpy().tobytes())]
    if dataclasses.is_dataclass(value):
        return [leaf for f in dataclasses.fields(value) for leaf in leaves(getattr(value, f.name), f"{path}.{f.name}")]
    if isinstance(value, tuple):
        return [leaf for k, part in enumerate(value) for leaf in leaves(part, f"{path}[{k}]")]
    return [(path, value)]


def assert_same(found, expected):
    """All numbers bit for bit; semi-diameters of the rays, which a unit need not divide, to the last digit."""
    for one, other in zip(leaves(found), leaves(expected), strict=True):
        is_size = one[0].endswith("semi_diameter") and other[1] is not None
        assert one[1:] == (pytest.approx(other[1:], rel=3e-16) if is_size else other[1:]), one[0]


def sized(lens: Lens) -> Lens:
    """The lens as a file has it: semi-diameters of the rays where none are stored. Those that are stored stay."""
    return lens.with_missing_semi_diameters()


def readable(path: Path) -> Lens | None:
    try:
        return read_lens_with_report(path)[0]
    except (LensFileError, UnknownGlass):
        return None


_NUMBERS = "nan inf -inf INFINITY 1e999 1e308 -1e308 1e-320 0 -1 1 2 24 99 12345678901234567890 1_0 ١ 1,5 -0.0 10,20"

_NAMES = '___BLANK MIRROR AIR 517642 STANDARD EVENASPH COORDBRK SURF STOP IN M METER 1.5/ = ( ) # : nm + é \x00 " ""'

_WORDS = [*_NUMBERS.split(" "), *_NAMES.split(" ")]


def damaged(content: bytes, source: random.Random) -> bytes:
    """A file with bytes, lines or words changed, lost, doubled or moved."""
    for _ in range(source.choice([1, 1, 1, 2, 3, 8])):
        kind = source.randrange(9)
        position = source.randrange(len(content) + 1)
        noise = source.randbytes(source.randrange(1, 9))
        if kind == 0:
            content = content[:position] + noise[:1] + content[position + 1 :]
        elif kind == 1:
            content = content[:position]
        elif kind == 2:
            content = content[:position] + noise + content[position:]
        else:
            content = _edited(content, kind, source)
    return content


def _edited(content: bytes, kind: int, source: random.Random) -> bytes:
    encoding = "utf-16" if content[:2] == b"\xff\xfe" else "latin-1"
    lines = content.decode(encoding, "replace").split("\n")
    at, other = source.randrange(len(lines)), source.randrange(len(lines))
    if kind == 3:
        del lines[at]
    elif kind == 4:
        lines.insert(other, lines[at])
    elif kind == 5:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        separator = source.choice([" ", ",", "\t"])
        words = lines[at].split(separator)
        words[source.randrange(len(words))] = source.choice(_WORDS)
        lines[at] = separator.join([*words, source.choice(_WORDS)] if kind == 8 else words)
    return "\n".join(lines).encode(encoding, "replace")


def one_line(error: Exception) -> None:
    assert "\n" not in str(error)


def read_damaged(path: Path, content: bytes) -> None:
    """A lens of finite numbers that can be written and read again, or one of the two errors, in one line."""
    form = FORMATS[path.suffix.lower()]
    try:
        lens, report = form.read(decode(content, Place(path.name)), path.name)
    except (LensFileError, UnknownGlass) as error:
        return one_line(error)
    assert str(report)
    numbers = [
        leaf for surface in lens.surfaces for leaf in leaves(dataclasses.replace(surface, thickness=number(0.0)))
    ]
    assert all(
        torch.isfinite(torch.frombuffer(bytearray(leaf[2]), dtype=torch.float64)).all() for leaf in numbers if leaf[2:]
    )
    try:
        written = form.write(lens, path.name)
    except LensFileError as error:  # a text that no file can hold
        return one_line(error)
    again = form.read(decode(written, Place(path.name)), path.name)[0]
    assert leaves(again.surfaces) == leaves(lens.surfaces)
    return None
