"""Texts of .zmx files."""

from raytrace.io import FORMATS

HEAD = {
    "MODE": "MODE SEQ",
    "NAME": "NAME A singlet",
    "UNIT": "UNIT MM X W X CM MR CPMM",
    "APERTURE": "ENPD 10",
    "GCAT": "GCAT SCHOTT",
    "FTYP": "FTYP 0 0 2 2 0 0 0",
    "X": "XFLN 0 0 0 0 0 0 0 0 0 0 0 0",
    "Y": "YFLN 0 7 0 0 0 0 0 0 0 0 0 0",
    "W1": "WAVM 1 0.4861327 1",
    "W2": "WAVM 2 0.5875618 0.5",
    "W3": "WAVM 3 0.55 1",
    "PWAV": "PWAV 2",
}


def file(*, surface: str = "", stop: str = "", object_: str = "", tail: str = "", **head: str) -> str:
    """A singlet of three surfaces between object and image; header lines replaced, lines of surfaces added."""
    lines = [line for line in (HEAD | head).values() if line]
    lines += ["SURF 0", "  TYPE STANDARD", "  CURV 0.0", "  DISZ INFINITY", *_indented(object_)]
    lines += ["SURF 1", "  TYPE STANDARD", "  CURV 0.02 0 0 0 0", "  DISZ 4", "  GLAS N-BK7 0 0 1.5 40", "  DIAM 6"]
    lines += _indented(surface)
    lines += ["SURF 2", "  STOP", "  TYPE STANDARD", "  CURV -0.02", "  DISZ 47.5", "  DIAM 5.5", *_indented(stop)]
    lines += ["SURF 3", "  TYPE STANDARD", "  CURV 0.0", "  DISZ 0", *tail.splitlines()]
    return "\n".join(lines) + "\n"


def _indented(text: str) -> list[str]:
    return [f"  {line}" for line in text.splitlines()]


def read(text: str, **options):
    return FORMATS[".zmx"].read(text, "lens.zmx", **options)


def lens(**changes):
    return read(file(**changes))[0]


def lzw(content: bytes) -> bytes:
    """The codes of LZW, of 9 bits and more, the highest bit first, padded with zeros to whole bytes."""
    words, codes, before = {bytes([k]): k for k in range(256)}, [], b""
    for k in range(len(content)):
        longer = before + content[k : k + 1]
        if longer not in words:
            codes.append(words[before])
            words[longer] = len(words)
            longer = content[k : k + 1]
        before = longer
    return bits([*codes, *([words[before]] if before else [])])


def bits(codes: list[int]) -> bytes:
    """Codes as bits: code k, from 0, has as many as the dictionary of its reader then needs."""
    text = "".join(f"{code:0{(255 + max(k, 1)).bit_length()}b}" for k, code in enumerate(codes))
    return int(text.ljust(-(-len(text) // 8) * 8, "0") or "0", 2).to_bytes(-(-len(text) // 8), "big")


def header(name: str, size: int, version: int) -> bytes:
    if version == 0xEA:
        head = bytearray(0x14C)
        head[0x0C:0x10], head[0x20 : 0x20 + len(name)] = size.to_bytes(4, "little"), name.encode("latin-1")
    else:
        head = bytearray(0x288)
        head[0x10:0x18], head[0x30 : 0x30 + 2 * len(name)] = size.to_bytes(8, "little"), name.encode("utf-16-le")
    head[0] = version
    return bytes(head)


def archive(files: dict[str, str | bytes], version: int = 0xEC, packed: bool = True) -> bytes:
    parts = []
    for name, content in files.items():
        content = content if isinstance(content, bytes) else content.encode("utf-16")
        content, name = (lzw(content), f"{name}.LZW") if packed else (content, name)
        parts += [header(name, len(content), version), content]
    return b"".join(parts)


SMALL = """CC A catalog for tests: Prüfgläser
! a note on statuses
NM ONE 2 517642.251 1.516800 64.17 0 1 1
GC the first; alternatives: TWO, THREE
ED 7.1 8.3 2.51 -0.0009 0
CD 1.03961212E+000 6.00069867E-003 2.31792344E-001 2.00179144E-002 1.01046945E+000
1.03560653E+002 0 0 0 0
TD 1.86E-006 1.31E-008 -1.37E-011 4.34E-007 6.27E-010 1.70E-001 2.0E+001
OD 1.0 2.0 - 1.0 2.3 _
LD 3.00000000E-001 2.50000000E+000
IT 3.00E-001 5.0E-002 2.5E+001
IT 5.00E-001 9.98E-001 2.5E+001

NM Two 1 620603 1.620409 60.280874 0 2 -1
CD 2.592001 -0.01540969 0.0102268 0.001581559 -0.0001877149 1.012515e-05 0 0 0 0
LD 0.4 0.7
"""
