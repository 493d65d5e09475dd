"""Sheets: drawings of the elements of a lens to ISO 10110, of its cemented groups and of the whole lens.

A sheet is A4. An element has its profile to scale, a table of its left surface, material and right surface, and a title
block; an asphere its equation, coefficients and sag table; the whole lens its parts and the distances of vertices.
"""

import functools
import io
import itertools
import math
import re
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.cross_section import sections
from raytrace.analysis.sag_table import sag
from raytrace.files import write_atomically
from raytrace.materials.glass import abbe_number, has_abbe_number, label, nd
from raytrace.maths.numerics import detached, value
from raytrace.maths.result import Column, Result, Table, plain
from raytrace.plotting import style
from raytrace.settings import DRAWINGS
from raytrace.system.elements import cemented_groups
from raytrace.system.lens import Lens
from raytrace.system.shapes import EVEN, KINDS
from raytrace.tracing.geometry import semi_diameters
from raytrace.tracing.lens_report import remarks
from raytrace.words import option
from raytrace.workshop import dxf, step
from raytrace.workshop.indications import Indications, limits, sized, stated, toleranced, tolerances_for
from raytrace.workshop.paper import HEIGHT, MARGIN, WIDTH, Paper, scale_for, scale_text
from raytrace.workshop.parts import Face, Part, parts_of

_FOOT = 58.0  # mm: top of the table and of the title block of an element
_SPLIT = 178.0  # mm: right end of the table
_TOP = HEIGHT - MARGIN


@value
class Drawings(Result):
    """Drawings of a lens: a row for each part, with mechanical diameter, thickness, edge and volume.

    parts: `Part`; groups: of names of cemented parts; chosen: names of the parts whose sheets are drawn, () for the
    whole lens alone; has_assembly: whether the sheet of the whole lens is drawn; indications: of ISO 10110; date: of
    the title block and of STEP files. `save` writes .pdf with a page a sheet, .svg and .png with a file a sheet, .dxf
    and .step of the same parts.
    """

    lens: Lens
    parts: tuple[Part, ...]
    groups: tuple[tuple[str, ...], ...]
    chosen: tuple[str, ...]
    has_assembly: bool
    indications: Indications
    date: str = ""

    COLUMNS = (
        Column("part", "", "d"), Column("first", "", "d"), Column("last", "", "d"), Column("material", form="<"),
        Column("thickness", "mm", ".4f"), Column("edge", "mm", ".4f"), Column("diameter", "mm", ".4f"),
        Column("volume", "mm³", ".6g"), Column("note", form="<"),
    )  # fmt: skip

    def columns(self) -> dict[str, Tensor]:
        shown, number = self.parts, torch.arange(len(self.parts))
        sizes = [(p.thickness, p.edge, 2 * p.rim, p.volume) if not p.objection else (math.nan,) * 4 for p in shown]
        thickness, edge, diameter, volume = torch.tensor(sizes, dtype=torch.float64).reshape(-1, 4).T
        first, last = (torch.tensor([p.surfaces[end] for p in shown]) for end in (0, 1))
        return {
            "part": number + 1, "first": first, "last": last, "material": number, "thickness": thickness,
            "edge": edge, "diameter": diameter, "volume": volume, "note": number,
        }  # fmt: skip

    def words(self) -> dict[str, Sequence[str]]:
        cut = "cut by its aperture in STEP files"
        notes = [f"not drawn: {part.objection}" if part.objection else cut if part.cuts else "" for part in self.parts]
        return {"material": [label(part.glass) for part in self.parts], "note": notes}

    def document(self) -> dict:
        parts = plain(self.to_frame().to_dict("records"))
        return {"name": self.lens.name, "parts": parts, "tolerances": self.indications.sources()}

    def tables(self) -> list[Table]:
        sources = self.indications.sources()
        note = f"tolerances: {'; '.join(sources)}" if sources else "tolerances: the lens has none"
        return [Table(self.columns() if self.parts else {}, [self.lens.name or "Lens", ""], ["", note])]

    def drawn_parts(self) -> list[Part]:
        """The parts of the sheets: those chosen, or all of the whole lens."""
        every = [part for part in self.parts if not part.objection]
        return every if self.has_assembly else [part for part in every if part.name in self.chosen]

    def sheets(self) -> list[Paper]:
        """The sheet of the whole lens, then those of elements and of cemented groups."""
        return [self.sheet(number) for number in range(1, len(self._contents()) + 1)]

    def sheet(self, number: int) -> Paper:
        """A sheet by its number, from 1."""
        contents = self._contents()
        if not 1 <= number <= len(contents):
            raise ValueError(f"{option('sheet', number)}: expected a number from 1 to {len(contents)}")
        parts = contents[number - 1]
        paper = _element(self, parts) if parts else _assembly(self)
        paper.text(WIDTH - MARGIN - 2, MARGIN + 3, f"{number} / {len(contents)}", ha="right")
        return paper

    def _contents(self) -> list[list[Part]]:
        """The parts of every sheet; none for the whole lens."""
        by_name = {part.name: part for part in self.parts if not part.objection and part.name in self.chosen}
        single = [[by_name[name]] for name in self.chosen if name in by_name]
        groups = [[by_name[name] for name in group] for group in self.groups if by_name.keys() >= set(group)]
        return [*([[]] if self.has_assembly else []), *single, *groups]

    @style.styled
    def draw(self, sheet: int = 1) -> style.Figure:
        """The figure of a sheet by its number, from 1."""
        return self.sheet(sheet).figure()

    def save(self, path: str | PathLike) -> None:
        """Write .pdf (a page a sheet), .svg or .png (a file a sheet, numbered), .dxf or .step, or the table (.csv,
        .json). Raises MissingExtra for .dxf and .step without the extra `cad`."""
        suffix = Path(path).suffix.lower()
        if suffix not in DRAWINGS:
            raise ValueError(f"{path}: expected a name that ends in {', '.join(DRAWINGS)}")
        if suffix in (".csv", ".json"):
            Result.save(self, path)
        elif suffix == ".dxf":
            title = self.lens.name or "Lens"
            dxf.write(path, title, [(part, _lines(self, [part])) for part in self.drawn_parts()])
        elif suffix in (".step", ".stp"):
            step.write(path, self.lens, self.drawn_parts(), self.date)
        elif suffix == ".pdf":
            content = _pages(self.sheets())
            write_atomically(path, lambda file: file.write(content))
        else:
            for paper, name in zip(self.sheets(), self.files(path), strict=True):
                style.save(paper.figure(), name)

    def files(self, path: str | PathLike) -> list[Path]:
        """The files that `save` writes: of several sheets as .svg or .png NAME_1, NAME_2, …"""
        path, count = Path(path), len(self._contents())
        if path.suffix.lower() not in (".svg", ".png") or count == 1:
            return [path]
        return [path.with_stem(f"{path.stem}_{k}") for k in range(1, count + 1)]


def draw(
    lens: Lens,
    *,
    elements: Sequence[int] | None = None,
    grade: str | None = None,
    limits: str | Sequence[str] = "",
    radial: bool = False,
    indications: str | Sequence[str] = "",
    coating: str = "",
    margin: float = 0.0,
    chamfer: float = 0.0,
    substrate: float | None = None,
    date: str = "",
) -> Drawings:
    """Drawings of a lens to ISO 10110: the whole lens, its elements and cemented groups; also as DXF and STEP.

    elements: numbers of the elements with a sheet of their own, from 1 in the order of the light, without the sheet of
    the whole lens; (): all of them and the whole lens; None: the whole lens alone.
    grade, limits, radial: tolerances, as of `tolerances`, by default those of the lens. indications: further ones of
    all parts, "0/20 1/3x0.16 2/1;1 5/5x0.25 6/-"; coating: of all surfaces in air. What is not specified is a dash.
    margin: mm added to mechanical semi-diameters that are not fixed; chamfer: mm of both legs, at 45°; substrate:
    thickness in mm of mirrors, by default a sixth of their diameter; date: of the title block. `save` writes .pdf,
    .svg, .png, .dxf or .step. Raises ValueError, NoSolid, BadTolerance, BadIndication.
    """
    for name, size in (("margin", margin), ("chamfer", chamfer)):
        if not 0 <= size < math.inf:
            raise ValueError(f"{option(name, size)}: expected a length of 0 mm or more")
    if substrate is not None and not 0 < substrate < math.inf:
        raise ValueError(f"{option('substrate', substrate)}: expected a length above 0 mm")
    lens = detached(lens)
    parts = parts_of(lens, margin=margin, chamfer=chamfer, substrate=substrate)
    names = [part.name for part in parts]
    for number in elements or ():
        part = parts[number - 1] if 1 <= number <= len(parts) else None
        if part is None:
            raise ValueError(f"{option('elements', number)}: expected numbers from 1 to {len(parts)}")
        if part.objection:
            raise ValueError(f"element {number} is not drawn: {part.objection}")
    if not any(not part.objection for part in parts):
        raise ValueError("the lens has no element that is a solid of revolution: nothing to draw")
    groups = tuple(
        tuple(part.name for part in parts if first <= part.surfaces[0] and part.surfaces[1] <= last)
        for first, last in cemented_groups(lens)
    )
    table = tolerances_for(lens, limits, grade=grade, radial=radial)
    chosen = () if elements is None else tuple(map(str, elements)) if elements else tuple(names)
    words = Indications(table, stated(indications), coating)
    return Drawings(lens, tuple(parts), groups, chosen, not elements, words, date)


def _pages(papers: Sequence[Paper]) -> bytes:
    """The sheets as the pages of a PDF file."""
    from matplotlib.backends.backend_pdf import PdfPages

    content = io.BytesIO()

    @style.styled
    def write() -> None:
        with PdfPages(content, metadata={"CreationDate": None}) as pages:
            for paper in papers:
                pages.savefig(paper.figure())

    write()
    return content.getvalue()


def _outline(part: Part, count: int = 121) -> np.ndarray:
    """(2, N) mm: z, r of the profile from the axis or hole over the rim, without the closing line."""
    return np.concatenate([segment.points(count) for segment in part.profile()[:-1]], axis=1)


def _shapes(part: Part) -> list[np.ndarray]:
    """Closed outlines (2, N) mm of the section of a part, of both halves."""
    z, r = _outline(part)
    if part.hole > 0:
        return [np.stack([z, sign * r]) for sign in (1, -1)]
    return [np.stack([np.concatenate([z, z[::-1]]), np.concatenate([r, -r[::-1]])])]


def _tint(part: Part) -> object:
    return "#e4e4e4" if part.is_mirror else style.tint(float(nd(part.glass)))


def _draw_part(paper: Paper, part: Part, place: Callable[[np.ndarray, np.ndarray], tuple]) -> None:
    """The section of a part; place: z, r (N,) mm -> places on the paper."""
    for z, r in _shapes(part):
        x, y = place(z, r)
        paper.shapes.append((np.stack([x, y]), _tint(part)))
        paper.lines.append((np.stack([np.append(x, x[:1]), np.append(y, y[:1])]), "outline"))


# -- the sheet of an element or of a cemented group


def _element(drawings: Drawings, parts: Sequence[Part]) -> Paper:
    """The sheet of one element, or of the elements of a cemented group together."""
    lens, given = drawings.lens, drawings.indications
    name = "Element " + parts[0].name if len(parts) == 1 else "Cemented elements " + ", ".join(p.name for p in parts)
    paper = Paper(name)
    aspheric = [] if len(parts) > 1 else [f for f in parts[0].faces if f.number and not f.is_sphere]
    offsets = np.cumsum([0.0, *(part.thickness for part in parts)])
    moves = [np.array([[offset], [0.0]]) for offset in offsets[:-1]]
    outlines = np.concatenate([_outline(part) + move for part, move in zip(parts, moves, strict=True)], axis=1)
    (low, high), rim = (outlines[0].min(), outlines[0].max()), max(part.rim for part in parts)
    right = 192.0 if aspheric else WIDTH - MARGIN
    lines = _below(drawings, parts, right - MARGIN - 4)
    foot = _FOOT + 3.4 * len(lines)
    scale = scale_for(high - low, 2 * rim, (right - MARGIN - 64, _TOP - foot - 34))
    centre = 0.5 * (MARGIN + right) - 4
    start, axis = centre - 0.5 * scale * (low + high), 0.5 * (foot + _TOP) + 1

    def place(offset: float, z: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return start + scale * (z + offset), axis + scale * r

    for part, offset in zip(parts, offsets[:-1], strict=True):
        _draw_part(paper, part, functools.partial(place, offset))
    left_end, right_end = start + scale * low, start + scale * high
    paper.line((left_end - 8, axis), (right_end + 8, axis), kind="axis")
    thick = float(offsets[-1])
    ends = [(parts[0], 0, left_end - 12, 0.0), (parts[-1], 1, right_end + 12, float(offsets[-2]))]
    for part, end, x, offset in ends[: 1 if parts[-1].is_mirror else 2]:
        height = min(part.faces[end].clear, part.rim)
        rim_end = start + scale * (float(part.ends(np.array([height]))[end][0]) + offset)
        paper.up(x, axis - scale * height, axis + scale * height, rim_end, f"⌀e {sized(2 * height)}")
    widest = max(parts, key=lambda part: part.rim)
    z_rim = offsets[parts.index(widest)] + widest.ends(np.array([widest.rim]))[1][0]
    paper.up(
        right_end + 22, axis - scale * rim, axis + scale * rim, start + scale * float(z_rim), f"⌀ {sized(2 * rim)}"
    )
    bottom = axis - scale * rim - 9
    first = parts[0].surfaces[0]
    row = given.row("thickness", first) if len(parts) == 1 else None
    size = toleranced(thick, row) if len(parts) == 1 else _total(given, parts)
    paper.across(start, start + scale * thick, bottom, (axis, axis), size)
    if len(parts) == 1:
        start_of_edge, end_of_edge = (start + scale * float(z[0]) for z in widest.ends(np.array([widest.rim])))
        top = axis + scale * rim
        paper.across(start_of_edge, end_of_edge, top + 7, (top, top), f"({sized(widest.edge, 2)})")

    _table_of_faces(paper, drawings, parts)
    for k, face in enumerate(aspheric):
        _asphere(paper, lens, face, "left" if face is parts[0].faces[0] else "right", 196.0, _TOP - 4 - k * 66)
    for k, line in enumerate(lines):
        paper.fitted(MARGIN + 2, _FOOT + 3 + 3.4 * (len(lines) - 1 - k), line, right - MARGIN - 4, 6)
    comment = lens.surfaces[parts[0].surfaces[0]].comment.strip()
    is_name = re.search(r"[^\W\d_]{3}", comment) and parts[0].surfaces[0] != lens.stop  # not the radius of a patent
    words = f"{name}: {comment}" if is_name else name
    _title_block(paper, drawings, words, scale, (_SPLIT, _FOOT))
    return paper


def _total(given: Indications, parts: Sequence[Part]) -> str:
    """Thickness of a cemented group in mm, the sum of those of its elements as they are printed."""
    rows = ((part.thickness, given.row("thickness", part.surfaces[0])) for part in parts)
    return sized(sum(float(toleranced(size, row).split()[0]) for size, row in rows))


def _table_of_faces(paper: Paper, drawings: Drawings, parts: Sequence[Part]) -> None:
    """Left surface, material and right surface."""
    front, back = parts[0].faces[0], parts[-1].faces[1]
    columns = [
        _column(drawings, front, parts[0], -1),
        _material(drawings, parts),
        _column(drawings, back, parts[-1], 1),
    ]
    heads = ("Left surface", "Material" if len(parts) == 1 else "Elements", "Right surface")
    rows = [[f"{head}{_number(face)}" for head, face in zip(heads, (front, None, back), strict=True)]]
    rows += [list(row) for row in zip(*columns, strict=True)]
    paper.table(MARGIN, _FOOT, ((_SPLIT - MARGIN) / 3,) * 3, rows, (_FOOT - MARGIN) / len(rows))


def _number(face: Face | None) -> str:
    return "" if face is None else f" (surface {face.number})"


def _column(drawings: Drawings, face: Face, part: Part, outward: int) -> list[str]:
    """The cells of a surface: radius, diameter, chamfer, coating, 3/ to 6/."""
    given = drawings.indications
    if part.is_mirror and outward > 0:
        return ["R ∞ (rear of the substrate)", "", "", "", "3/ –", "4/ –", "5/ –", "6/ –"]
    bent = outward * face.curvature
    side, kind = "CX" if bent < 0 else "CC", "" if face.is_sphere else ", asphere"
    chamfer = part.chamfers[0 if outward < 0 else 1]
    return [
        f"{given.radius(face, side)}{kind}",
        f"⌀e {sized(2 * face.clear)}",
        f"Prot. chamfer {chamfer:g} × 45°" if chamfer else "Prot. chamfer –",
        "cemented" if face.is_cemented else f"λ {given.coating}" if given.coating else "λ –",
        given.form(face),
        given.centring(face),
        given.of_words("5"),
        given.of_words("6"),
    ]


def _material(drawings: Drawings, parts: Sequence[Part]) -> list[str]:
    """The cells of the glass, or of the elements of a group and their mounting."""
    given = drawings.indications
    if len(parts) > 1:
        shift, tilt = given.mounting(parts[0].surfaces[0], parts[-1].surfaces[1])
        cells = [
            f"{p.name}: {label(p.glass)}, {toleranced(p.thickness, given.row('thickness', p.surfaces[0]))}"
            for p in parts
        ]
        cells = [*cells[:4], "; ".join(cells[4:])] if len(cells) > 5 else [*cells, *[""] * (5 - len(cells))]
        return [*cells, "cement –", f"decentre in the mount {shift}", f"tilt in the mount {tilt}"]
    part, k = parts[0], parts[0].surfaces[0]
    if part.is_mirror:
        return ["Mirror, material of the substrate –", "", "", *(given.of_words(n) for n in "012"), "", ""]
    index = f"nd {float(nd(part.glass)):.6f} {limits(given.row('index', k))}".rstrip()
    row = given.row("abbe", k)
    abbe = f"νd {float(abbe_number(part.glass)):.4g} {limits(row, unit=' %' if row and row.unit == '%' else '')}"
    catalog = f" ({part.glass.catalog})" if part.glass.catalog else ""
    shift, tilt = given.mounting(*part.surfaces)
    return [
        f"{label(part.glass)}{catalog}",
        index,
        abbe.rstrip() if has_abbe_number(part.glass) else "νd –",
        *(given.of_words(n) for n in "012"),
        f"decentre in the mount {shift}",
        f"tilt in the mount {tilt}",
    ]


def _below(drawings: Drawings, parts: Sequence[Part], width: float) -> list[str]:
    """Lines between drawing and table, of a width in mm: further tolerances, their source, dashes and fringes."""
    others = "; ".join(line for part in parts for line in drawings.indications.others(part))
    sources = "; ".join(drawings.indications.sources())
    text = [others.replace("-", "−")] if others else []
    text.append(f"Tolerances: {sources}." if sources else "The lens has no tolerances.")
    text.append("Lengths in mm. 3/ in fringes of 546.07 nm. –: not specified. (): auxiliary dimension.")
    return style.fill("\n".join(text), width / 25.4, 6).splitlines()


def _lines(drawings: Drawings, parts: Sequence[Part]) -> list[str]:
    """The table of an element as lines of text."""
    front, back = parts[0].faces[0], parts[-1].faces[1]
    heads = (f"LEFT SURFACE{_number(front)}", "MATERIAL", f"RIGHT SURFACE{_number(back)}")
    cells = (_column(drawings, front, parts[0], -1), _material(drawings, parts), _column(drawings, back, parts[-1], 1))
    thick = toleranced(parts[0].thickness, drawings.indications.row("thickness", front.number))
    lines = [f"Element {parts[0].name}", f"⌀ {sized(2 * parts[0].rim)}, thickness {thick}"]
    for head, column in zip(heads, cells, strict=True):
        lines += [head, *(f"  {cell}" for cell in column if cell)]
    return lines


def _asphere(paper: Paper, lens: Lens, face: Face, where: str, x: float, top: float) -> None:
    """Equation, coefficients and sag table of an asphere, in a column of 92 mm by 62 mm."""
    surface, kind = face.surface, KINDS[face.surface.kind]
    powers = "r²ʲ" if surface.kind == EVEN else "rʲ"
    paper.text(x, top, f"Surface {face.number} ({where}), along the light", weight="bold")
    terms = "" if surface.coefficients is None else f" + Σ aₙ r{'ⁿ' if powers else ''}"
    paper.text(x, top - 4.5, f"z = c r² / (1 + √(1 − (1 + k) c² r²)){terms},  c = 1/R", 6.5)
    conic = 0.0 if surface.conic is None else float(surface.conic)
    lines = [f"R   {1 / face.curvature:.9g}" if face.curvature else "R   ∞", f"k   {conic:.9g}"]
    for k, a in enumerate([] if surface.coefficients is None else surface.coefficients.tolist()):
        if a:
            lines.append(f"{kind.name_of(k)}   {face.side * a:.10g}")
    if surface.sag_terms is not None:
        lines += remarks(surface)
    step = style.round_length(face.clear / 6)
    table = sag(lens, face.number, step=step, semi_diameter=face.clear)
    lines += ["departure from the", f"best‐fit sphere ≤ {1e3 * float(table.largest):.4g} µm"]
    if face.curvature or surface.coefficients is not None:
        lines.append(f"(R {abs(float(table.best_fit_radius)):.6g})")
    pitch = min(3.6, 54 / max(len(lines), 12))
    for k, line in enumerate(lines):
        paper.fitted(x, top - 9 - k * pitch, line.replace("-", "−"), 44, 6)
    rows = [("r", "z", "dz/dr")]
    rows += [
        (f"{r:.5g}", f"{face.side * z:.6f}".replace("-", "−"), f"{face.side * s:.5f}".replace("-", "−"))
        for r, z, s in zip(table.radii.tolist(), table.sag.tolist(), table.slope.tolist(), strict=True)
    ]
    paper.table(x + 46, top - 7, (12, 19, 15), rows, min(4.2, 54 / len(rows)))


def _title_block(paper: Paper, drawings: Drawings, name: str, scale: float, corner: tuple[float, float]) -> None:
    """Frame and title block, from its upper left corner to the lower right one of the frame."""
    paper.box(MARGIN, MARGIN, WIDTH - 2 * MARGIN, HEIGHT - 2 * MARGIN)
    x, top = corner
    width, height = WIDTH - MARGIN - x, top - MARGIN
    paper.box(x, MARGIN, width, height)
    pitch = height / 6
    title = style.fill(drawings.lens.name or "Lens", width / 25.4, 9, bold=True)
    paper.fitted(x + 2, top - pitch, "\n".join(title.splitlines()[:2]), width - 4, 9, weight="bold")
    paper.fitted(x + 2, top - 2.5 * pitch, name, width - 4, 9)
    half = x + 0.5 * width
    for k in (2, 3, 4, 5):
        paper.line((x, top - k * pitch), (x + width, top - k * pitch))
    paper.line((half, top - 3 * pitch), (half, MARGIN))
    paper.text(x + 2, top - 3.5 * pitch, f"Scale {scale_text(scale)}")
    paper.text(half + 2, top - 3.5 * pitch, "Lengths in mm, A4")
    paper.text(x + 2, top - 4.5 * pitch, f"Date {drawings.date or '–'}")
    paper.text(half + 2, top - 4.5 * pitch, "Indications to ISO 10110", 6.5)
    paper.text(x + 2, top - 5.5 * pitch, "raytrace")
    paper.text(half + 2, top - 5.5 * pitch, "Sheet")


# -- the sheet of the whole lens


def _assembly(drawings: Drawings) -> Paper:
    lens, given = drawings.lens, drawings.indications
    parts = [part for part in drawings.parts if not part.objection]
    paper, places = Paper("Assembly"), sections(lens)

    def at(part: Part, z: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return places[part.surfaces[0]].at(part.faces[0].side * z, r)

    corners = np.concatenate([np.stack(at(part, *shape)) for part in parts for shape in _shapes(part)], axis=1)
    (left, low), (right, high) = corners.min(1), corners.max(1)
    room = (WIDTH - 2 * MARGIN - 24, _TOP - 118.0)
    scale = scale_for(right - left, high - low, room)
    x0 = 0.5 * WIDTH - 0.5 * scale * (left + right)
    y0 = 0.5 * (102 + _TOP) - 0.5 * scale * (low + high)

    def on_paper(part: Part, z: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _scaled(at(part, z, r), scale, (x0, y0))

    tags: list[tuple[float, float]] = []
    for part in parts:
        _draw_part(paper, part, functools.partial(on_paper, part))
        x, y = on_paper(part, *np.concatenate(_shapes(part), axis=1))
        tag = float(x[y > y.max() - 0.5].mean()), float(y.max()) + 3
        while any(abs(tag[0] - x) < 4 and abs(tag[1] - y) < 3.5 for x, y in tags):
            tag = tag[0], tag[1] + 3.5
        tags.append(tag)
        paper.text(*tag, part.name, 7.5, ha="center", weight="bold")
    way = np.stack([np.array(place.origin) for place in places[1:]], 1)
    way = way[:, np.isfinite(way).all(0)]
    x, y = _scaled(tuple(way), scale, (x0, y0))
    shown = (x > MARGIN) & (x < WIDTH - MARGIN) & (y > 100) & (y < _TOP)
    paper.lines.append((np.stack([x[shown], y[shown]]), "axis"))

    foot = 92.0
    rows = [("Part", "Surfaces", "Material", "Thickness", "⌀", "Decentre", "Tilt")]
    for part in parts:
        thick = toleranced(part.thickness, given.row("thickness", part.surfaces[0]))
        surfaces = "–".join(map(str, sorted({*part.surfaces})))
        mount = given.mounting(*part.surfaces)
        rows.append((part.name, surfaces, label(part.glass) or "–", thick, sized(2 * part.rim), *mount))
    by_name = {part.name: part for part in parts}
    for group in drawings.groups:
        if all(name in by_name for name in group):
            first, last = by_name[group[0]].surfaces[0], by_name[group[-1]].surfaces[1]
            joined = [by_name[name] for name in group]
            widest = sized(2 * max(part.rim for part in joined))
            cells = ("+".join(group), f"{first}–{last}", "cemented", _total(given, joined), widest)
            rows.append((*cells, *given.mounting(first, last)))
    pitch = min(5.0, (foot - MARGIN - 6) / len(rows))
    paper.table(MARGIN, foot, (14, 18, 34, 38, 20, 23, 23), rows, pitch)
    gaps = [("Vertex distance", "mm"), *_distances(drawings)]
    paper.table(_SPLIT + 2, foot, (62, WIDTH - MARGIN - _SPLIT - 64), gaps, min(5.0, 46 / len(gaps)))
    left_out = [f"not drawn: element {part.name}, {part.objection}" for part in drawings.parts if part.objection]
    for k, line in enumerate([*left_out[:3], *_below(drawings, (), WIDTH - 2 * MARGIN - 4)][::-1]):
        paper.fitted(MARGIN + 2, foot + 3 + 3.4 * k, line, WIDTH - 2 * MARGIN - 4, 6)
    _title_block(paper, drawings, f"Assembly of {len(parts)} parts", scale, (_SPLIT + 2, 44.0))
    return paper


def _scaled(point: Sequence, scale: float, origin: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    return origin[0] + scale * np.asarray(point[0]), origin[1] + scale * np.asarray(point[1])


def _distances(drawings: Drawings) -> list[tuple[str, str]]:
    """Distances along the light between the parts, the stop and the image, with their tolerances, and the stop."""
    lens, given = drawings.lens, drawings.indications
    stations = {end for part in drawings.parts for end in part.surfaces} | {lens.stop, len(lens.surfaces) - 1}
    inside = {(a, b) for a, b in (part.surfaces for part in drawings.parts) if a != b}
    names = {lens.stop: " (stop)", len(lens.surfaces) - 1: " (image)"}
    words = {end: f"{end}{names.get(end, '')}" for end in stations}
    rows, order = [], sorted(stations)
    for a, b in itertools.pairwise(order):
        if any(first <= a and b <= last for first, last in inside):
            continue
        length = abs(float(sum(surface.thickness for surface in lens.surfaces[a:b])))
        rows.append((f"surface {words[a]} to {words[b]}", toleranced(length, given.row("thickness", a))))
    diameter = 2 * semi_diameters(lens)[lens.stop]
    is_apart = all(lens.stop not in part.surfaces for part in drawings.parts)
    return rows + ([(f"stop, surface {lens.stop}", f"⌀ {diameter:.3f}")] if is_apart and diameter > 0 else [])
