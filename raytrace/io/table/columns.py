"""The columns of a prescription table: the headings of designers, programs and patents, and the quantity of each.

A column of numbers is read by its name or refused by it, never guessed and never dropped. Case is significant where it
distinguishes: `nD` is the index at the sodium D line, `nd` at the helium d line; `D` is a diameter where another column
is named thickness, and else the thickness.
"""

import functools
import re
import unicodedata
from collections.abc import Sequence
from typing import NamedTuple

from raytrace.io.source import IGNORED, MILLIMETRES, READ, UNKNOWN, Draft, LensFileError, Place, shown
from raytrace.materials.glass import LINES
from raytrace.system.shapes import KINDS
from raytrace.system.surface import SIZES

_SPELLINGS = {
    "label": "surface, surf, srf, s, si, i, j, m, no, nr, num, number, #, id, surface no, surface number, surface #"
    ", surf no, element, lens, 面番号, 面no, 面, 番号, 面号, 面序号, 表面序号, 序号, 表面, 表面编号, flache"
    ", flachennummer, flachennr, numero",
    "type": "type, kind, surface type, surf type, shape, rmd, geometry, 面形状, 面タイプ, 種類, 面型, 类型, flachentyp",
    "comment": "comment, comments, remark, remarks, description, note, notes, 備考, コメント, 摘要, 备注, 注释"
    ", bemerkung, kommentar, remarque, commentaire",
    "curvature": "curvature, curv, c, cv, curvatures, cuy, 1/r, 曲率, krummung, courbure",
    "radius": "radius, r, roc, rad, radius of curvature, radii, radii of curvature, curvature radius, curvature radii"
    ", radius curvature, rdy, paraxial radius of curvature, paraxial curvature radius, 曲率半径, 近軸曲率半径, 半径"
    ", krummungsradius, rayon, rayon de courbure",
    "thickness": "thickness, thick, t, th, thi, distance, separation, spacing, gap, interval, thicknesses"
    ", axial distance, axial thickness, on-axis distance, on-axis spacing, on-axis surface spacing"
    ", center thickness, centre thickness"
    ", central thickness, surface distance, surface interval, surface spacing, interplanar spacing"
    ", surface separation, thickness or distance, distance to next surface, dn"
    ", 面間隔, 間隔, 軸上面間隔, 軸上間隔, 厚み, 厚さ, 中心厚, 肉厚, 距離, 厚度, 间距, 间隔, 面间距, dicke, mittendicke"
    ", abstand, scheitelabstand, epaisseur, espacement",
    "glass": "glass, material, medium, mat, glas, glass name, glasses, materials, glass type, glass material, gla"
    ", glass code, 硝材, 硝種, ガラス, 材料, 材質, 媒質, 玻璃, 材质, glasart, werkstoff, verre, materiau, milieu",
    "index": "n, index, refractive index, ior, index of refraction, refraction index, refr index, refractive indices"
    ", refractive power index, 屈折率, 折射率, brechzahl, brechungsindex, indice, indice de refraction",
    "abbe": "v, abbe, abbe number, abbe no, abbe #, abbe value, v number, v no, v #, v value, vno, abbe constant"
    ", アッベ数, 分散, 阿贝数, 阿贝系数, 色散系数, abbezahl, abbesche zahl, nombre d'abbe, constringence",
    "dpgf": "dpgf, δpgf, δpg,f, δθgf, δθg,f",
    "pgf": "pgf, pg,f, θgf, θg,f, partial dispersion ratio, 部分分散比",
    "conic": "conic, conic constant, k, cc, conic coefficient, conical constant, conical coefficient, conic k"
    ", コーニック係数, コーニック定数, 円錐定数, 円錐係数, 圆锥系数, 二次曲面系数, 二次曲面系数k, konische konstante"
    ", kegelschnittkonstante, constante conique, conicite",
    "semi_diameter": "semidiameter, semi aperture, semidia, sd, sdia, clear semidiameter, clear semidia, half diameter"
    ", half aperture, aperture radius, clear radius, clear aperture radius, effective radius, maximum effective radius"
    ", housing radius, semi clear aperture, semiapertures, sa, 有効半径, 半口径, 半直径, 有效半径, halbdurchmesser"
    ", demi-diametre",
    "diameter": "diameter, dia, diam, φ, ø, ca, clear aperture, clear diameter, clear diam, effective diameter, eff dia"
    ", eff diameter, effective dia, free diameter, aperture diameter, 有効径, 口径, 直径, 通光口径, 有效口径"
    ", durchmesser, freier durchmesser, diametre, diametre utile",
    "chip_zone": "chip zone",
    "mechanical_semi_diameter": "mechanical semidiameter",
    "stop": "stop, is stop, aperture stop, 絞り, 光阑, blende",
    "apertures": "aperture, apertures",
    "temperature": "temperature",
    "expansion": "expansion, tce, tce x 1e6",
    "pressure": "pressure",
}

#: Columns that are known and left out, with the reason.
_OTHERS = {
    "a focal length follows from the surfaces": "f, fl, efl, focal length, lens focal length, element focal length"
    ", focal length of lens, component focal length, 焦点距離, 焦距, brennweite, focale, distance focale",
    "a size of the mechanical part": "mech semidia, mech diam, mech dia, mechanical diameter, edge thickness, コバ厚",
    "a setting of the program": "ccy, cuc, thc, glc, spe, id no",
    "coatings and heat refract no rays": "coating, cte, specific gravity, density, 比重",
}


def squeezed(heading: str) -> str:
    """A heading without accents, blanks, dots and dashes; full-width letters and the variants of ν and φ made alike."""
    text = unicodedata.normalize("NFKD", unicodedata.normalize("NFKC", heading).replace("’", "'").replace("′", "'"))
    text = unicodedata.normalize("NFC", re.sub("[\u0300-\u036f]", "", text)).translate(str.maketrans("νυΦϕ", "vvφφ"))
    return re.sub(r"[\s._:*\u00ad\u2010-\u2015\u2212-]", "", text)


def _by_spelling(spellings: dict[str, str]) -> dict[str, str]:
    return {squeezed(word).casefold(): name for name, words in spellings.items() for word in words.split(", ")}


_HEADINGS, _IGNORED = _by_spelling(_SPELLINGS), _by_spelling(_OTHERS)
#: A thickness or a diameter; case-sensitive.
_EITHER = {"d": "d", "D": "D"}

#: Headings of the coefficient of r^n: a4, A4, r4, r^4, 4th, 4th order.
_TERM = re.compile(r"(?:a|r\^?|α|alphar?\^?|coefficientofr\^?)(\d{1,2})|(\d{1,2})(?:st|nd|rd|th)(?:order)?(?:term)?")
_INDEX = re.compile(r"([nNvV])\(?(d|D|e|E|F'|f'|F|f|C'|c'|C|c|g|G|h|H|i|I|r|s|S|t|T)\)?")
_WAVELENGTH = re.compile(r"n?\(?(?:at|@|λ=)?(\d{3,4}(?:\.\d+)?)nm\)?", re.IGNORECASE)
_LINE = re.compile(r"(?:at|for)?(?:the)?([A-Za-z]'?)(?:line|線)")
_UNITS = {"mm": "mm", "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm", "1/mm": "mm"}
_UNITS |= {"mm^1": "mm", "mm1": "mm", "/mm": "mm", "in": "in", "inch": "in", "inches": "in", '"': "in", "cm": "cm"}
_UNITS |= {"m": "m", "meter": "m", "meters": "m", "μm": "μm", "um": "μm", "micron": "μm", "microns": "μm", "nm": "nm"}
_UNITS |= {"1/in": "in", "1/cm": "cm", "1/m": "m", "unit:mm": "mm", "unitmm": "mm", "単位mm": "mm", "单位mm": "mm"}
#: A column of unknown meaning: its cells may be words, but not numbers.
UNREAD = "?"
_LENGTHS = ("radius", "thickness", "curvature", "diameter", "d", "D", *SIZES)


class Heading(NamedTuple):
    """The meaning of a heading: a key of _SPELLINGS, "a4", "index F", "abbe e", "d", "D", "ignored"; and its unit."""

    name: str
    unit: str = ""


@functools.lru_cache(4096)
def meaning(heading: str) -> Heading | None:
    """The meaning of a single heading; None where it is not known."""
    text = unicodedata.normalize("NFKC", heading).strip().strip('"*')
    text = re.sub(r"\s+", " ", re.sub(r"(?<=[\u3040-\u9fff])(?=[!-~νυφ])", " ", text))
    text = re.sub(r"(?<=\s)(?:at|for|the)\s", "", text)
    bare = squeezed(text)
    known = _named(bare) or _at_wavelength(text.replace(" ", ""))
    if known or len(text) > 60 or text.count(" ") > 8:
        return known
    if bare.casefold() in _UNITS:
        return Heading("", _UNITS[bare.casefold()])
    for separators in (r"[\[\](){}【】（）]", r"[,;/=]", r"\s(?=\S+$)", r"(?<=\S)\s"):
        parts = [part for part in re.split(separators, text, maxsplit=0 if "[" in separators else 1) if part.strip()]
        if len(parts) > 1:
            merged = _merged([meaning(part) for part in parts])
            if merged:
                return merged
    return None


def _named(bare: str) -> Heading | None:
    lower = bare.casefold()
    if bare in _EITHER:
        return Heading(_EITHER[bare])
    if lower in _HEADINGS:
        return Heading(_HEADINGS[lower])
    if lower in _IGNORED:
        return Heading(f"ignored {_IGNORED[lower]}")
    symbol, line = _INDEX.fullmatch(bare), _LINE.fullmatch(bare)
    if symbol:
        return _at_line("abbe" if symbol[1] in "vV" else "index", symbol[2], capital=symbol[1].isupper())
    if line:
        return _at_line("line", line[1], capital=False)
    term = _TERM.fullmatch(lower)
    return Heading(f"a{int(term[1] or term[2])}") if term else None


def _at_wavelength(text: str) -> Heading | None:
    """An index, or a line, by its wavelength: n(587.6nm) is nd."""
    match = _WAVELENGTH.fullmatch(text)
    near = [name for name, place in LINES.items() if abs(1e3 * place - float(match[1])) < 0.6] if match else []
    return Heading(f"{'index' if text[0] in 'nN' else 'line'} {near[0]}") if len(near) == 1 else None


def _at_line(kind: str, line: str, *, capital: bool) -> Heading | None:
    """`index` or `abbe` at a spectral line: nD is sodium's, ND as nd helium's; NF and nf are at F."""
    line = "d" if line == "D" and capital else line
    names = {name.casefold(): name for name in LINES if name != "D"}
    line = line if line in LINES else names.get(line.casefold(), "")
    return Heading(f"{kind} {line}") if line and (kind != "abbe" or line in "deD") else None


def _merged(meanings: list[Heading | None]) -> Heading | None:
    """The meaning of several words or symbols of a quantity, as 'Abbe number (νe)' and 'R [mm]'; else None."""
    parts = [part for part in meanings if part is not None]
    if len(parts) < len(meanings):
        return None
    units = {part.unit for part in parts if part.unit}
    names = {part.name for part in parts if part.name}
    if "index" in names or "abbe" in names:
        kind = "index" if "index" in names else "abbe"
        names = {name.replace("line ", f"{kind} ") for name in names}
        names = names - {kind} if len(names) > 1 else names
        names = names if all(name.split()[0] == kind for name in names) else {"", *names}
    for either in ("d", "D"):
        if names in ({either, "thickness"}, {either, "diameter"}):
            names -= {either}
    if len(names) != 1 or len(units) > 1 or next(iter(names)).startswith("line"):
        return None
    return Heading(names.pop(), units.pop() if units else "")


def order(column: str) -> int | None:
    """n of a column "an", the coefficient of r^n; None for other columns."""
    return int(column[1:]) if column[0] == "a" and column[1:].isdigit() else None


def is_header(cells: list[str], *, known: float = 0.5) -> bool:
    """True for a line that names a thickness and a curvature or radius, with a `known` share of its cells headings."""
    cells = [cell for cell in cells if cell.strip()]
    if not 2 <= len(cells) <= 200 or max(map(len, cells)) > 60:
        return False
    headings = [column for column in _without_counters(cells)[1] if column is not None]
    names = {column.name for column in headings}
    complete = names & {"thickness", "d", "D"} and names & {"curvature", "radius"}
    return bool(complete) and len(headings) >= known * len(cells)


def columns(cells: Sequence[str], units: str, ignored: Sequence[str], place: Place, report: Draft) -> list[str | None]:
    """The meaning of each column of a line of headings, every one reported; None for those left out, else UNREAD.

    units: of the header; ignored: headings that the header leaves out. Raises LensFileError for two columns of one
    meaning, for a column in other units, and for an ambiguous one.
    """
    cells, headings = _without_counters(cells)
    for k, cell in enumerate(cells):
        if squeezed(cell).casefold() in ignored and cell.strip():
            headings[k] = Heading("ignored by the header")
    _check_units(cells, headings, units, place)
    names = [column.name if column else None for column in headings]
    if names and not cells[0].strip():
        names[0] = "label"
    _settle_thickness(cells, names, place, report)
    _settle_lines(cells, names, place)
    _refuse_repeats(cells, names, place)
    for cell, name in zip(cells, names, strict=True):
        _report(cell, name, place, report)
    return [None if (name or "").startswith("ignored") else name or UNREAD for name in names]


def _without_counters(cells: Sequence[str]) -> tuple[list[str], list[Heading | None]]:
    """Headings without a running index, as ri, di, Ndi, νdi, and their meanings."""
    bare = [squeezed(cell) for cell in cells]
    for letter in "ijkn":
        stems = [re.sub(rf"(?<=.),?{letter}$", "", name) for name in bare]
        if {stem for stem, name in zip(stems, bare, strict=True) if stem != name} >= {"r", "d"} or {
            stem for stem, name in zip(stems, bare, strict=True) if stem != name
        } >= {"R", "D"}:
            known = {"r", "d", "R", "D", "n", "N", "v", "nd", "Nd", "vd", "ne", "ve", "Ne"}
            cells = [stem if stem in known else cell for stem, cell in zip(stems, cells, strict=True)]
    return list(cells), [meaning(cell) for cell in cells]


def _check_units(cells: Sequence[str], headings: list[Heading | None], units: str, place: Place) -> None:
    for cell, column in zip(cells, headings, strict=True):
        if column is None or column.name not in _LENGTHS or not column.unit:
            continue
        scale = MILLIMETRES.get(column.unit.upper())
        if scale is None:
            raise LensFileError(f"column {shown(cell)} is in {column.unit}; convert it to mm", place)
        if scale != MILLIMETRES.get((units or "mm").upper()):
            fix = f"write the header line '# units: {column.unit}'"
            raise LensFileError(f"column {shown(cell)} is not in {units or 'mm'}; {fix}, of every length", place)


def _settle_thickness(cells: list[str], names: list[str | None], place: Place, report: Draft) -> None:
    """d and D: the thickness if nothing else could be; D next to a named thickness is the diameter; else an error."""
    either = [k for k, name in enumerate(names) if name in ("d", "D")]
    thicknesses = [cells[k] for k, name in enumerate(names) if name == "thickness"]
    if len(either) + len(thicknesses) > 1 and not (thicknesses and len(either) == 1 and names[either[0]] == "D"):
        listed = " and ".join(shown(cell) for cell in [*thicknesses, *(cells[k] for k in either)])
        raise LensFileError(f"columns {listed} could each be the thickness; write 'thickness' and 'diameter'", place)
    for k in either:
        if names[k] == "D":
            report.note(f"column {shown(cells[k])} is taken as the {'diameter' if thicknesses else 'thickness'}")
        names[k] = "diameter" if thicknesses else "thickness"


def _settle_lines(cells: list[str], names: list[str | None], place: Place) -> None:
    """An index or Abbe number without a spectral line is of the d line, unless other columns are of another line."""
    for kind, other in (("index", "abbe"), ("abbe", "index")):
        lines = {name.split()[1] for name in names if name and name.startswith(other + " ")}
        for k, name in enumerate(names):
            if name != kind:
                continue
            lines_of_kind = {n.split()[1] for n in names if n and n.startswith(kind + " ")}
            if (kind == "abbe" and lines and not lines & {"d", "D"}) or (
                kind == "index" and (lines - {"d"} or lines_of_kind)
            ):
                symbol = "n" if kind == "index" else "V"
                fix = f"write '{symbol}d' or '{symbol}e'"
                raise LensFileError(f"column {shown(cells[k])} does not name its spectral line; {fix}", place)
            names[k] = f"{kind} D" if lines == {"D"} else f"{kind} d"


def _refuse_repeats(cells: list[str], names: list[str | None], place: Place) -> None:
    for k, name in enumerate(names):
        if name in names[:k] and name not in (None, "", "label", "comment") and not name.startswith("ignored"):
            listed = f"{shown(cells[names.index(name)])} and {shown(cells[k])}"
            fix = "name one otherwise, or leave it out by a header line '# ignore: HEADING'"
            raise LensFileError(f"columns {listed} are both the {name.replace('_', '-')}; {fix}", place)
        term = order(name) if name else None
        least = min(kind.step for kind in KINDS.values())
        if term is not None and not least <= term <= 60:
            raise LensFileError(f"column {shown(cells[k])}: expected a coefficient of r^{least} to r^60", place)


def _report(cell: str, name: str | None, place: Place, report: Draft) -> None:
    label = f"column {cell[:40] or '(unnamed)'}"
    if name and name.startswith("ignored"):
        report.met(label, IGNORED, place, name.removeprefix("ignored "))
    elif name:
        report.met(label, READ, place)
    elif cell.strip():
        report.met(label, UNKNOWN, place)
    if name == "diameter":
        report.note(f"column {shown(cell)} is a diameter: halved")
