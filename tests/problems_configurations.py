"""Texts of .zmx files with several configurations."""

#: A mirror that scans, folded by half a right angle; the axes are turned back behind it by pickups.
MIRROR = """MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 10
FTYP 0 0 1 1 0 0 0
XFLN 0
YFLN 0
WAVM 1 0.55 1
PWAV 1
SURF 0
  DISZ INFINITY
SURF 1
  STOP
  DISZ 50
SURF 2
  TYPE COORDBRK
  PARM 3 -45
  DISZ 0
SURF 3
  TYPE COORDBRK
  PARM 3 {angle}
  DISZ 0
SURF 4
  DISZ 0
  GLAS MIRROR 0 0 1.5 40
SURF 5
  TYPE COORDBRK
  PARM 3 {back}
  PPAR 3 3 -1.0 0.0 0
  DISZ 0
SURF 6
  TYPE COORDBRK
  PARM 3 -45
  PPAR 3 2 1.0 0.0 0
  DISZ -80
SURF 7
  DISZ 0
"""

ANGLES = (-10.0, -5.0, 0.0, 5.0, 10.0)

SCANNED = [f"PRAM   3   {k} {angle} 0 3 0 1 1 1.0 0.0 0" for k, angle in enumerate(ANGLES, 1)]


def scan(active: int = 1) -> str:
    angle = ANGLES[active - 1]
    return MIRROR.format(angle=angle, back=-angle) + "\n".join([f"MNUM 5 {active}", *SCANNED]) + "\n"


def operands(*lines: str, count: int = 2, active: int = 1) -> str:
    return "\n".join([f"MNUM {count} {active}", *lines])


def two(name: str, number: int, first: str, second: str, parameter: int = 0) -> str:
    """An operand with two values."""
    return operands(*(f"{name} {number} {k} {v} 0 {parameter} 0 1 1 1.0 0.0 0" for k, v in ((1, first), (2, second))))


#: An operand, its values, and the file saved in each of the configurations: (text of the file, its replacement).
ASPHERE = "TYPE EVENASPH\nPARM 1 0\nPARM 2 1e-5"

RAIM = "PWAV 2\nRAIM 0 0"

CASES = {
    "thickness": (two("THIC", 1, "4", "5.5"), {}, ("DISZ 4\n", "DISZ 5.5\n")),
    "object": (two("THIC", 0, "1e10", "250"), {}, ("DISZ INFINITY", "DISZ 250")),
    "curvature": (two("CRVT", 1, "0.02", "-0.03"), {}, ("CURV 0.02", "CURV -0.03")),
    "plane": (two("CRVT", 2, "-0.02", "0"), {}, ("CURV -0.02", "CURV 0")),
    "conic": (two("CONN", 1, "-1", "-2"), {"surface": "CONI -1"}, ("CONI -1", "CONI -2")),
    "sphere to conic": (two("CONN", 1, "0", "-2"), {"surface": "CONI 0"}, ("CONI 0", "CONI -2")),
    "glass": (two("GLSS", 1, '"N-BK7"', '"N-SF6"'), {}, ("GLAS N-BK7", "GLAS N-SF6")),
    "no glass": (two("GLSS", 1, '"N-BK7"', '""'), {}, ("GLAS N-BK7", "GLAS AIR")),
    "mirror": (two("GLSS", 2, '""', '"MIRROR"'), {"stop": "COMM here"}, ("COMM here", "COMM here\n  GLAS MIRROR 0 0")),
    "model": (two("MIND", 1, "1.5", "1.6"), {"surface": "GLAS ___BLANK 1 0 1.5 60"}, ("1 0 1.5 60", "1 0 1.6 60")),
    "asphere": (two("PRAM", 1, "1e-5", "2e-5", 2), {"surface": ASPHERE}, ("PARM 2 1e-5", "PARM 2 2e-5")),
    "older": (two("PAR2", 1, "1e-5", "2e-5"), {"surface": ASPHERE}, ("PARM 2 1e-5", "PARM 2 2e-5")),
    "further term": (
        two("PRAM", 1, "0", "3e-9", 4),
        {"surface": ASPHERE},
        ("PARM 2 1e-5", "PARM 2 1e-5\n  PARM 4 3e-9"),
    ),
    "semi-diameter": (two("SDIA", 1, "6", "4"), {"surface": "FLAP 0 6 0"}, ("DIAM 6", "DIAM 4")),
    "aperture": (two("APMX", 1, "5", "3"), {"surface": "CLAP 1 5 0"}, ("CLAP 1 5", "CLAP 1 3")),
    "hole": (two("APMN", 1, "1", "2"), {"surface": "CLAP 1 5 0"}, ("CLAP 1 5", "CLAP 2 5")),
    "decentre": (two("APDY", 1, "0.5", "1"), {"surface": "CLAP 0 5 0\nOBDC 0 0.5"}, ("OBDC 0 0.5", "OBDC 0 1")),
    "before": (
        two("CBTX", 1, "0", "3"),
        {"surface": "SCBD 1 0 0 0 0 0 0 0", "PWAV": RAIM},
        ("1 0 0 0 0 0 0 0", "1 0 0 0 0 3 0 0"),
    ),
    "comment": (two("MCOM", 1, '"a"', '"b"'), {"surface": "COMM a"}, ("COMM a", "COMM b")),
    "field": (two("YFIE", 2, "7", "3.5"), {}, ("YFLN 0 7", "YFLN 0 3.5")),
    "field x": (two("XFIE", 2, "0", "2"), {}, ("XFLN 0 0", "XFLN 0 2")),
    "weight": (two("FLWT", 2, "1", "3"), {"X": "XFLN 0 0\nFWGN 1 1"}, ("FWGN 1 1", "FWGN 1 3")),
    "vignetting": (two("FVCY", 2, "0.1", "0.2"), {"X": "XFLN 0 0\nVCYN 0 0.1"}, ("VCYN 0 0.1", "VCYN 0 0.2")),
    "wavelength": (two("WAVE", 1, "0.4861327", "0.45"), {}, ("WAVM 1 0.4861327", "WAVM 1 0.45")),
    "its weight": (two("WLWT", 2, "0.5", "2"), {}, ("0.5875618 0.5", "0.5875618 2")),
    "primary": (two("PRWV", 0, "2", "1"), {}, ("PWAV 2", "PWAV 1")),
    "pupil": (two("APER", 0, "10", "6"), {}, ("ENPD 10", "ENPD 6")),
    "F-number": (two("APER", 0, "5", "8"), {"APERTURE": "FNUM 5 0"}, ("FNUM 5 0", "FNUM 8 0")),
    "telecentric": (two("TELE", 0, "0", "1"), {}, ("FTYP 0 0", "FTYP 0 1")),
    "aiming": (two("RAAM", 0, "0", "1"), {"PWAV": RAIM}, ("RAIM 0 0", "RAIM 0 1")),
    "title": (two("LTTL", 0, '"A singlet"', '"Far"'), {}, ("NAME A singlet", "NAME Far")),
    "stop": (two("STPS", 0, "2", "1"), {"surface": "COMM here"}, ("COMM here", "COMM here\n  STOP")),
}
