"""The columns of a prescription table: the headings designers write, and what each means."""

import re

from raytrace.formats.source import LensFileError, Place, shown

_SPELLINGS = {
    "label": "surface surf s no nr num number id surfaceno surfacenumber element",
    "type": "type kind surfacetype shape",
    "comment": "comment comments remark remarks description note notes",
    "curvature": "curvature curv c cv curvatures",
    "radius": "radius r roc rad radiusofcurvature radii curvatureradius",
    "thickness": "thickness thick t th thi d distance separation spacing gap thicknesses",
    "glass": "glass material medium mat glas glassname glasses materials",
    "nd": "n nd index refractiveindex indexnd",
    "vd": "v vd abbe abbenumber vnumber abbevd",
    "dpgf": "dpgf",
    "conic": "conic conicconstant k kappa cc",
    "semi_diameter": "semidiameter semiaperture semidia sd sdia clearsemidiameter",
    "diameter": "diameter dia clearaperture cleardiameter",
    "stop": "stop isstop",
    "apertures": "aperture apertures",
}

#: Heading, without blanks and signs -> meaning.
HEADINGS = {spelling: name for name, spellings in _SPELLINGS.items() for spelling in spellings.split()}

#: Headings of the coefficient of r^n: a4, A4, r4, r^4, 4th, 4th order.
_TERM = re.compile(r"(?:a|r\^?|alpha_?r\^?)(\d{1,2})|(\d{1,2})(?:st|nd|rd|th)(?:order)?(?:term)?")


def meaning(heading: str, place: Place) -> str | None:
    """What a heading means: a key of the spellings, "a4" for the coefficient of r⁴, or None if it is not known.

    Raises LensFileError for a unit of length in brackets that is not mm.
    """
    bracket = re.search(r"[(\[]([^)\]]*)[)\]]", heading)
    name = re.sub(r"[(\[].*?[)\]]", "", heading).strip().lower()
    bare = re.sub(r"[^a-z0-9^]", "", name)
    found = HEADINGS.get(bare)
    if found is None:
        term = _TERM.fullmatch(bare)
        found = f"a{int(term[1] or term[2])}" if term else ("label" if bare == "" else None)
    unit = bracket[1].strip().lower() if bracket else ""
    if found in ("radius", "thickness", "curvature", "semi_diameter", "diameter") and unit in ("in", "inch", "cm", "m"):
        raise LensFileError(f"column {shown(heading)} is not in mm; write the header line '# units: {unit}'", place)
    return found


def order(column: str) -> int | None:
    """n of a column "an", the coefficient of r^n; None for other columns."""
    return int(column[1:]) if column[0] == "a" and column[1:].isdigit() else None


def is_header(cells: list[str], place: Place, *, known: float = 0.5) -> bool:
    """True for a line that names a thickness and a curvature or radius, with a `known` share of its cells headings."""
    cells = [cell for cell in cells if cell]
    if not 2 <= len(cells) <= 200 or max(map(len, cells)) > 60:
        return False
    found = [meaning(cell, place) for cell in cells]
    complete = "thickness" in found and ("curvature" in found or "radius" in found)
    return complete and len(found) - found.count(None) >= known * len(found)
