"""Mounts: linear thermal expansion of the materials of spacers and barrels, a row of MOUNTS each.

Mean coefficients near room temperature, in 1e-6/K, from the sources in the rows. Alloys vary by some per cent with
temper and temperature, plastics by ten or more with fillers and moulding: the figure of the supplier goes first.
"""

import re
from typing import NamedTuple

from raytrace.words import did_you_mean


class Mount(NamedTuple):
    """A material: linear expansion in 1e-6/K, the grade and the range in °C that it belongs to, and its source."""

    expansion: float
    grade: str
    source: str


_ASM = "ASM Handbook, vol. {}"

#: Materials by the name that commands take.
MOUNTS = {
    "aluminium": Mount(23.6, "6061-T6, 20 to 100 °C", _ASM.format(2)),
    "beryllium": Mount(11.4, "S-200F, 25 to 100 °C", "Materion, data sheet of S-200F"),
    "brass": Mount(20.5, "C36000, 20 to 300 °C", "Copper Development Association"),
    "copper": Mount(17.0, "C10100, 20 to 100 °C", "Copper Development Association"),
    "delrin": Mount(110.0, "POM homopolymer, 23 to 55 °C", "DuPont, design guide of Delrin"),
    "fused silica": Mount(0.51, "0 to 100 °C", "Heraeus, data sheet of Suprasil"),
    "invar": Mount(1.3, "Invar 36, annealed, 25 to 93 °C", "Carpenter Technology, data sheet of Invar 36"),
    "magnesium": Mount(26.0, "AZ31B, 20 to 100 °C", _ASM.format(2)),
    "peek": Mount(45.0, "450G, along the flow, below 143 °C", "Victrex, data sheet of PEEK 450G"),
    "polycarbonate": Mount(65.0, "Makrolon 2405, 23 to 55 °C", "Covestro, data sheet of Makrolon 2405"),
    "stainless 304": Mount(17.2, "0 to 100 °C", _ASM.format(1)),
    "stainless 416": Mount(9.9, "0 to 100 °C", _ASM.format(1)),
    "steel": Mount(11.7, "low carbon (1018, 1020), 20 to 100 °C", _ASM.format(1)),
    "titanium": Mount(8.6, "Ti-6Al-4V, 20 to 100 °C", _ASM.format(2)),
    "zerodur": Mount(0.0, "expansion class 1, ± 0.05, 0 to 50 °C", "SCHOTT, data sheet of ZERODUR"),
}


def expansion_of(material: str | float) -> float:
    """Linear expansion in 1e-6/K of a material of MOUNTS by its name, or a number itself. Raises ValueError.

    Blanks, hyphens, case and the spelling of aluminium do not matter: "stainless-304", "Aluminum".
    """
    if not isinstance(material, str):
        return float(material)
    by_name = {_squeezed(name): mount for name, mount in MOUNTS.items()}
    if _squeezed(material) in by_name:
        return by_name[_squeezed(material)].expansion
    try:
        return float(material)
    except ValueError:
        listed = ", ".join(MOUNTS)
        meant = did_you_mean(material, MOUNTS)
        raise ValueError(
            f"mount {material!r}: expected one of {listed}, or its expansion in 1e-6/K, as 23.6{meant}"
        ) from None


def mount_words(expansion: float) -> str:
    """An expansion in 1e-6/K in words, with the materials of MOUNTS that have it: "aluminium, 23.6e-6/K"."""
    names = [name for name, mount in MOUNTS.items() if mount.expansion == expansion]
    return ", ".join([*names, f"{expansion:g}e-6/K"])


def _squeezed(name: str) -> str:
    return re.sub(r"[\s_-]", "", name.lower()).replace("aluminum", "aluminium")
