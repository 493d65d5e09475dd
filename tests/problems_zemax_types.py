"""Texts of .zmx files of every type of surface."""

from raytrace.io import FORMATS
from raytrace.io.zemax.surfaces import types


def xdat(radius: float, *terms: float) -> str:
    return "\n".join(f'XDAT {i} {value} 0 0 1 0 0 ""' for i, value in enumerate((len(terms), radius, *terms), 1))


def parm(first: int = 1, *values: float) -> str:
    return "\n".join(f"PARM {j} {value}" for j, value in enumerate(values, first))


GLASS = "GLAS ___BLANK 1 0 1.6 0 0 0 0 0 0 0"

SMALL = [((-1) ** k) * 0.4 / (k + 3) ** 2 for k in range(40)]  # terms that fall, of both signs

#: The lines of surface 2, and the type that it is written as.
CASES = {
    "standard": ("STANDARD", f"CURV 0.02\nCONI -0.4\n{GLASS}"),
    "even asphere": ("EVENASPH", f"CURV 0.02\nCONI -0.4\n{parm(1, 1e-3, 2e-5, -3e-7)}\n{GLASS}"),
    "odd asphere": ("ODDASPHE", f"CURV 0.02\nCONI -0.4\n{parm(1, 2e-3, 1e-3, -2e-5, 2e-6, 1e-8)}\n{GLASS}"),
    "extended asphere": ("XASPHERE", f"CURV 0.02\nCONI -0.8\n{xdat(8, 0.02, 0.03, -0.006, 0.001)}\n{GLASS}"),
    "long asphere": ("XASPHERE", f"CURV 0.02\n{xdat(20, *SMALL[:12])}\n{GLASS}"),
    "break": ("COORDBRK", parm(1, 1.5, -2, 7, -5, 11, 0)),
    "break of order 1": ("COORDBRK", parm(1, 1.5, -2, 7, -5, 11, 1)),
    "grating": ("DGRATING", f"{parm(1, 0.3, -1)}\n{GLASS}"),
    "curved grating": ("DGRATING", f"CURV 0.02\nCONI 1\n{parm(1, 0.2, 2)}"),
    "reflection grating": ("DGRATING", f"CURV -0.01\nCONI -0.5\n{parm(1, 0.15, -1)}\nGLAS MIRROR"),
    "ideal lens": ("PARAXIAL", parm(1, 37.3, 1)),
    "crossed ideal lens": ("PARAX_XY", parm(1, 0.02, -0.013, 0)),
    "Jones matrix": ("JONESMAT", f"{parm(1, 1, 0, 0.5)}\n{GLASS}"),
    "binary 1": ("BINARY_1", f"CURV 0.01\n{parm(0, 1, 1e-4, 1e-6)}\n{xdat(10, *(400 * a for a in SMALL[:14]))}"),
    "binary 2": ("BINARY_2", f"CURV 0.03\n{parm(0, 2)}\n{xdat(10, -1000, 300, -20, 4)}\n{GLASS}"),
    "fringe phase": ("FZERNPHA", f"CURV 0.01\n{parm(0, 1)}\n{xdat(11, *(30 * a for a in SMALL[:37]))}\n{GLASS}"),
    "hologram": ("HOLOGRM2", parm(1, 1, -20, -200, 2, 5, 100, 0.55, 1)),
    "reflection hologram": ("HOLOGRM2", f"{parm(1, 0, 10, -100, 0, -5, -80, 0.5, 1)}\nGLAS MIRROR"),
    "Fresnel lens": ("FRESNELS", f"CURV 0.03\nCONI -1\n{parm(1, 1e-3, 1e-5)}\n{GLASS}"),
    "tilted": ("TILTSURF", f"{parm(1, 0.2, -0.35)}\n{GLASS}"),
    "toroid": ("TOROIDAL", f"CURV 0.028\nCONI -0.3\n{parm(1, -60, 1e-4, -2e-6, 1e-8)}\n{xdat(100)}\n{GLASS}"),
    "cylinder": ("TOROIDAL", f"CURV -0.04\n{parm(1, 0, 0, 0, 0, 0, 0, 0, 0)}\n{xdat(100)}\n{GLASS}"),
    "biconic": ("BICONICX", f"CURV 0.025\nCONI -0.5\n{parm(1, 30, 0.4)}\n{GLASS}"),
    "extended polynomial": ("XPOLYNOM", f"CURV 0.01\nCONI 0.3\n{xdat(12, *SMALL[:20])}\n{GLASS}"),
    "fringe sag": ("FZERNSAG", f"{parm(1, 1e-4, 1e-6)}\n{parm(9, 0.7, -1.1)}\n{xdat(12, *SMALL[:37])}\n{GLASS}"),
    "irregular": ("IRREGULA", f"CURV 0.01\nCONI -2\n{parm(1, 0.5, -0.3, 2, -3, 0.04, -0.06, 0.05, 33)}\n{GLASS}"),
    "tilts": ("STANDARD", f"CURV 0.02\nSCBD 1 0 0 0.3 -0.2 4 -3 25\nSCBD 2 1 0 0.3 0.2 -4 3 -25\n{GLASS}"),
    "tilts first": ("STANDARD", "CURV 0.02\nSCBD 1 1 0 0.5 0.1 -2 5 10\nSCBD 2 0 1 0 0 30 10 0\nGLAS MIRROR"),
    "tilted grating": ("DGRATING", f"{parm(1, 0.3, -1)}\nSCBD 1 0 0 0.3 -0.2 4 -3 25\nGLAS MIRROR"),
}  # fmt: skip

CASES = {name: case for name, case in CASES.items() if case[0] in types()}


def text(name: str, unit: str = "MM", *more: str) -> str:
    """A lens with the surface of a case as its second, behind a mirror if it says so, in lengths of a unit."""
    kind, lines = CASES[name]
    return file(f"TYPE {kind}\n{lines}", unit, *more)


def file(second: str, unit: str = "MM", *more: str) -> str:
    lines = [
        "MODE SEQ", f"UNIT {unit} X W X CM MR CPMM", "ENPD 8", "FTYP 0 0 1 2 0 0 0", "XFLN 0", "YFLN 0",
        "WAVM 1 0.5 1", "WAVM 2 0.6 1", "PWAV 1", "SURF 0", "  TYPE STANDARD", "  CURV 0.0", "  DISZ INFINITY",
        "SURF 1", "  STOP", "  TYPE STANDARD", "  CURV 0.0", "  DISZ 6", "  DIAM 5", "SURF 2",
        *(f"  {line}" for line in second.split("\n") if line), *(["  CURV 0.0"] if "CURV" not in second else []),
        f"  DISZ {-5 if 'MIRROR' in second else 5}", *(["  DIAM 9"] if "DIAM" not in second else []),
        "  COMM the second", *(f"  {line}" for line in more),
        "SURF 3", "  TYPE STANDARD", "  CURV -0.03", "  CONI 0.2", f"  DISZ {-20 if 'MIRROR' in second else 20}",
        "SURF 4", "  TYPE STANDARD", "  CURV 0.0", "  DISZ 0",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def read(content: str, **options):
    return FORMATS[".zmx"].read(content, "lens.zmx", **options)
