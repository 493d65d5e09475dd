"""Dimensions: powers of length of the numbers of a lens, and of merit operands that are known, evaluated or not.

`POWERS` has the power of every number that has one, by the class and the field that hold it; `scaled` multiplies all of
them by a factor. `DIMENSION` has the unit of the value of a merit operand, `ARGUMENTS` what its two integers number.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from raytrace.maths.bivariate import powers as powers_xy
from raytrace.maths.numerics import is_any
from raytrace.system.optimization_data import Row
from raytrace.system.shapes import KINDS
from raytrace.system.surface import SIZES

#: Names by unit; "" of pure numbers, of lines that set something, and of values on other rows, whose unit they have.
_UNITS = {
    "mm": (
        "TRAC TRCX TRCY TRAR TRAX TRAY TRAI TRAN TRAD TRAE REAX REAY REAZ REAR RAGX RAGY RAGZ PARX PARY PARZ PARR PATX"
        " PATY RETX RETY PIMH YNIP CENX CENY CNPX CNPY DXDX DXDY DYDX DYDY OPTH PLEN EFFL EFLX EFLY EFLA ENPP EXPP EPDI"
        " EXPD TOTR TTHI TGTH STHI ZTHI LINV PETZ FCGS FCGT SFCG LACL LONA AXCL SPCH BFSD RSCE RSCH RSRE RSRH MNCA MXCA"
        " MNCG MXCG MNCT MXCT MNEA MXEA MNEG MXEG MNET MXET XNEA XXEA XNEG XXEG XNET XXET MNSD MXSD OMSD CTGT CTLT CTVA"
        " ETGT ETLT ETVA TTGT TTLT TTVA FTGT FTLT DMGT DMLT DMVA SAGX SAGY GLCX GLCY GLCZ BLTH ERFP"
        " CEHX CEHY SSAG DSAG GBPP GBPR GBPS GBPW GBPZ GBSP GBSR GBSS GBSW"
    ),
    "1/mm": "MNCV MXCV CVGT CVLT CVVA PETC POWR SCUR",
    "mm³": "CVOL",
    "degrees": "RAID RAED",
    "radians": "RANG GBPD GBSD",
    "waves": "OPDC OPDM OPDX SPHA COMA ASTI FCUR DIST RWCE RWCH RWRE RWRH ZERN",
    "%": "DIMX DISC DISG DISA",
    "µm": "DENC DENF GENC GENF XENC XENF",
    "g": "TMAS",
    "cm³": "VOLU",
    "": (
        "BLNK DMFS USYM CONF PRIM WLEN IMSF GOTO DLTN SKIN SKIS ENDX REAA REAB REAC RAIN RAEN RAGA RAGB RAGC PANA PANB"
        " PANC RENA RENB RENC ANAR ANAX ANAY ANAC ANCX ANCY CNAX CNAY CODA COSI OOFF INDX PMAG AMAG ISNA ISFN WFNO SFNO"
        " TFNO EFNO GTCE TCGT TCLT TCVA COGT COLT COVA MNDT MXDT MNIN MXIN MNAB MXAB MNPD MXPD MNRE MXRE MNRI MXRI MNAI"
        " MXAI MTFT MTFS MTFA MTFN MTFX MTHA MTHN MTHS MTHT MTHX MSWA MSWN MSWS MSWT MSWX GMTA GMTN GMTS GMTT GMTX MECA"
        " MECS MECT STRH FICL FICP IMAE RELI SVIG CVIG NORD OBSN LPTD FREZ HHCN HACG GCOS GPIM GRMN GRMX GLCA GLCB GLCC"
        " GLCR POWP POWF BIOC BIOD FOUC BSER QOAC ZPLM UDOC UDOP CONS SINE COSA TANG LOGE LOGT CMGT CMLT CMVA ABCD VIGN"
        " PMGT PMLT PMVA RGLA FDMO FDRE OSCD SMIA ABGT ABLT CIGT CILT CIVA CEGT CELT CEVA"
        " XDGT XDLT XDVA MCOG MCOL MCOV SUMM DIFF OSUM QSUM EQUA ABSO OPGT OPLT OPVA PROB MINN MAXX DIVI PROD RECI SQRT"
        " DIVB ASIN ACOS ATAN SSLP DSLP SDRV NORX NORY NORZ"
    ),
}

#: The unit of every operand by its name; lengths in that of the file.
DIMENSION: dict[str, str] = {name: unit for unit, names in _UNITS.items() for name in names.split()}

#: Power of length of a value by its unit.
_OF_UNIT = {"mm": 1, "1/mm": -1, "mm³": 3, "µm": 1, "cm³": 3, "g": 3, "degrees": 0, "radians": 0, "waves": 0, "%": 0}

#: Names by what the two integers of their rows number: a surface, a gap (by the surface before it), both ends of a
#: range of them, rows, or numbers of the configurations; "contribution": of a surface, 0 of all. "" for anything else.
_ARGUMENTS = {
    ("surface", ""): (
        "REAX REAY REAZ REAR REAA REAB REAC RANG OPTH RAID RAIN RAED RAEN RAGX RAGY RAGZ RAGA RAGB RAGC PARX PARY PARZ"
        " PARR PATX PATY PANA PANB PANC RETX RETY RENA RENB RENC NORX NORY NORZ YNIP CENX CENY CNPX CNPY CNAX CNAY SAGX"
        " SAGY SSAG DSAG SSLP DSLP SCUR SDRV GLCX GLCY GLCZ GLCA GLCB GLCC GLCR GBPP GBPR GBPS GBPW GBPZ GBPD GBSP GBSR"
        " GBSS GBSW GBSD BLTH POWR POWP POWF HHCN GRMN GRMX GPIM LPTD CVGT CVLT CVVA COGT COLT COVA DMGT DMLT DMVA PMGT"
        " PMLT PMVA XDGT XDLT XDVA CMGT CMLT CMVA CIGT CILT CIVA CEGT CELT CEVA"
    ),
    ("contribution", ""): "SPHA COMA ASTI FCUR DIST",
    ("surface", "surface"): "PLEN EFLX EFLY MNCV MXCV MNSD MXSD OMSD MNRE MXRE MNRI MXRI MNAI MXAI",
    ("gap", ""): "CTGT CTLT CTVA ETGT ETLT ETVA TTGT TTLT TTVA FTGT FTLT STHI INDX GTCE TCGT TCLT TCVA",
    ("gap", "gap"): (
        "TTHI TGTH ZTHI MNCA MXCA MNCG MXCG MNCT MXCT MNEA MXEA MNEG MXEG MNET MXET XNEA XXEA XNEG XXEG XNET XXET MNDT"
        " MXDT MNIN MXIN MNAB MXAB MNPD MXPD CVOL TMAS VOLU RGLA"
    ),
    ("row", ""): (
        "OPVA OPGT OPLT ABGT ABLT PROB DIVB RECI ABSO SQRT SINE COSI TANG ASIN ACOS ATAN LOGT LOGE GOTO SKIN SKIS"
    ),
    ("row", "row"): "DIFF SUMM PROD DIVI",
    ("rows", "rows"): "OSUM QSUM MINN MAXX EQUA",
    ("operand", ""): "MCOG MCOL MCOV",
}

#: What the integers of the rows of an operand number, by its name.
ARGUMENTS: dict[str, tuple[str, str]] = {name: kinds for kinds, names in _ARGUMENTS.items() for name in names.split()}

#: Names whose value has the unit of the rows that they take, those of pure numbers, those without a value, and those of
#: an unknown unit.
_OF_ROWS, _PURE, _WITHOUT_VALUE, _UNKNOWN = map(
    str.split,
    (
        "OPVA OPGT OPLT ABGT ABLT PROB DIVB ABSO DIFF SUMM OSUM QSUM MINN MAXX EQUA",
        "SINE COSI TANG ASIN ACOS ATAN LOGT LOGE",
        "BLNK DMFS USYM CONF PRIM",
        "CONS PMGT PMLT PMVA XDGT XDLT XDVA",
    ),
)
#: Operands in % or, where their first number is not 0, in lengths.
_IN_PERCENT_OR_LENGTHS = "DIMX", "DISC", "DIST"
#: Powers of length of the four numbers of a row: of frequencies in cycles/mm, and of points of a surface.
_OF_NUMBERS = {
    (0, -1, 0, 0): (
        "MTFT MTFS MTFA MTFN MTFX MTHT MTHS MTHA MTHN MTHX MSWT MSWS MSWA MSWN MSWX GMTT GMTS GMTA GMTN GMTX"
    ),
    (1, 1, 0, 0): "SSAG DSAG SSLP DSLP SCUR SDRV",
}
_POWERS_OF_NUMBERS = {name: powers for powers, names in _OF_NUMBERS.items() for name in names.split()}


def power_of_row(
    rows: Sequence[Row], number: int, of_operand: Callable[[int], int | None], taken_by: Sequence[int] = ()
) -> float | None:
    """The power of length in the value of a row, counted from 1; None where it is not known.

    of_operand: that of the numbers of an operand of the configurations, by its number from 1; taken_by: rows that take
    the value.
    """
    if not 1 <= number <= len(rows) or number in taken_by:
        return None
    row = rows[number - 1]
    if not isinstance(row.operand, str):
        return getattr(row.operand, "length", None)
    if row.operand in _IN_PERCENT_OR_LENGTHS and row.numbers[0]:
        return 1
    kinds, (first, last) = ARGUMENTS.get(row.operand, ("", "")), row.integers
    if kinds[0] == "operand":
        return of_operand(first)
    if kinds[0] not in ("row", "rows") or row.operand in _PURE:
        return _OF_UNIT.get(DIMENSION[row.operand], 0) if row.operand in DIMENSION.keys() - {*_UNKNOWN} else None
    numbers = (
        range(min(first, last), max(first, last) + 1) if kinds[0] == "rows" else [first, last][: 1 + bool(kinds[1])]
    )
    of_rows = [
        power_of_row(rows, other, of_operand, (*taken_by, number))
        for other in numbers
        if not 1 <= other <= len(rows) or rows[other - 1].operand not in _WITHOUT_VALUE
    ]
    powers = [power for power in of_rows if power is not None]
    if not powers or len(powers) < len(of_rows):
        return None
    if row.operand in _OF_ROWS:
        return powers[0] if len({*powers}) == 1 else None
    products = {"PROD": sum(powers), "DIVI": powers[0] - powers[-1], "RECI": -powers[0], "SQRT": powers[0] / 2}
    return products.get(row.operand)


def scaled_numbers(row: Row, factor: float) -> tuple[float, float, float, float]:
    """The four numbers of a row of a lens that is scaled by a factor."""
    powers = _POWERS_OF_NUMBERS.get(str(row.operand), (0, 0, 0, 0))
    a, b, c, d = (number * factor**power for number, power in zip(row.numbers, powers, strict=True))
    return a, b, c, d


# -- numbers of a lens -------------------------------------------------------------------------------------------------

#: The power of the numbers of a field, or a function from the value to the powers of the entries along its first axis.
Power = int | Callable[[Any], int | list[int]]


def _of_coefficients(surface: Any) -> list[int]:
    kind = KINDS[surface.kind]
    return [kind.power_of(entry) for entry in range(0 if surface.coefficients is None else len(surface.coefficients))]


def _of_fields(fields: Any) -> int:
    return 0 if fields.kind == "angle" else 1


_LENGTHS_OF_PATH: dict[str, Power] = {
    "coefficients": lambda path: [1 - i - j for i, j in powers_xy(len(path.coefficients))],
    "constant": 1,
}
_TERMS: dict[str, Power] = {"coefficients": 1, "radius": 1}
_POINTS: dict[str, Power] = {"first": 1, "second": 1}

#: Power of length of every number of a lens that has one, by class and field; a class without a row is not scaled.
POWERS: dict[str, dict[str, Power]] = {
    "Surface": {"thickness": 1, "curvature": -1, "coefficients": _of_coefficients, **dict.fromkeys(SIZES, 1)},
    "Aperture": {"extent": 1, "centre": 1},
    "Pose": {"x": 1, "y": 1, "z": 1},
    "GridSag": {"heights": 1, "pitch": 1},
    "SplineSag": {"coefficients": 1, "pitch": 1},
    "ZernikeSag": _TERMS,
    "FringeSag": _TERMS | {"centre_x": 1, "centre_y": 1},
    "PolynomialSag": _TERMS,
    "IrregularSag": {"spherical": 1, "astigmatism": 1, "coma": 1, "radius": 1},
    "PowerSag": _TERMS | {"centre_x": 1, "centre_y": 1, "height": 1},
    # phases whose slopes stay: rays of the scaled lens are scaled as well
    **dict.fromkeys(("RadialPhase", "PolynomialPhase", "FringePhase"), _TERMS),
    **dict.fromkeys(("Hologram", "HologramPath"), _POINTS),
    "IdealLens": {"power_x": -1, "power_y": -1, "vergence": -1},
    "PolynomialPath": _LENGTHS_OF_PATH,
    "RadialPath": {"coefficients": lambda path: [1 - 2 * j for j in range(1, len(path.coefficients) + 1)]},
    "SystemAperture": {"value": lambda a: int(a.kind in ("entrance_pupil_diameter", "float_by_stop"))},
    "Fields": {"x": _of_fields, "y": _of_fields},
    **{name: {} for name in ("Lens", "Operand", "Environment", "Glass", "Grating", "Facets", "TiltSag")},
}


def power_at(whole: Any, path: Sequence[str | int | tuple[int, ...]]) -> int:
    """The power of length of the number at a path of `configurations`, 0 of a number that has none."""
    power: Any = 0
    for step in path:
        if isinstance(step, str):
            known = POWERS.get(type(whole).__name__, {}).get(step, 0)
            power, whole = known(whole) if callable(known) else known, getattr(whole, step)
        elif isinstance(step, int):
            whole = whole[step]
        elif isinstance(power, list):
            power = power[step[0]]
    return power


def scaled(part: Any, factor: Tensor | float, power: int | list[int] = 0) -> Any:
    """A part of a lens with every number multiplied by factor^power, and every number of its parts by its own power.

    A distance that is inf stays so; semi-diameters, which are plain numbers, have no derivative by the factor.
    """
    if isinstance(part, tuple):
        entries = tuple(scaled(entry, factor, power) for entry in part)
        return part if all(new is old for new, old in zip(entries, part, strict=True)) else entries
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        changes: dict[str, Any] = {}
        for field in dataclasses.fields(part):
            before, by = getattr(part, field.name), POWERS.get(type(part).__name__, {}).get(field.name, 0)
            after = scaled(before, factor, by(part) if callable(by) else by)
            if after is not before:
                is_plain = field.name in SIZES and isinstance(after, Tensor)
                changes[field.name] = float(after.detach()) if is_plain else after
        return dataclasses.replace(part, **changes) if changes else part
    if not isinstance(part, Tensor | float) or not power:
        return part
    if isinstance(power, list):
        assert isinstance(part, Tensor), "entries have their powers"
        return torch.stack([_times(number, factor, exponent) for number, exponent in zip(part, power, strict=True)])
    is_infinite = is_any(part.isinf()) if isinstance(part, Tensor) else math.isinf(part)
    return part if is_infinite else _times(part, factor, power)


def _times(number: Any, factor: Any, power: int) -> Any:
    return number * factor**power if power >= 0 else number / factor**-power
