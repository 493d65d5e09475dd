"""Pages: a document on A4 paper as PDF, its texts and tables set in lines and its figures drawn to fit."""

import copy
import dataclasses
import functools
import io
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

from raytrace.plotting import style
from raytrace.workshop.document import Document, Grid, Heading, Picture, Section

WIDTH, HEIGHT = 210 / 25.4 * 72, 297 / 25.4 * 72  # points
LEFT, TOP, BOTTOM = 51.0, 62.0, 54.0
ROOM = WIDTH - 2 * LEFT
TALL = HEIGHT - TOP - BOTTOM
_TEXT, _CELL, _LEAST = 8.5, 7.5, 4.5  # sizes of letters: paragraphs, tables, and the smallest of a wide table
_PAD = 4.0  # at each side of a cell
_BESIDE = 0.62  # least scale of two figures in one row
_TOGETHER = 4  # rows of a table that stay with its head
_WHOLE = 0.35  # of a page: shorter tables are not divided
_SHRUNK, _FILLING = 0.8, 0.7  # least scales of a figure at the end of a page, and of figures that fill one
_FOOT = 12.0  # below a table
_HEAD = 34.0  # the heading of a section
_NAMES = 24.0  # from the left edge to the names in the list of contents
_LINES = 3  # paragraphs that stay with the table behind them
_WRAPPED = 90.0  # least width of a column whose texts are set in several lines


@dataclasses.dataclass
class _Piece:
    """A piece of a page that is not divided: its height, and what it is made of, from its upper left corner.

    texts: x, y downwards, text, look; rules: y, width of the line, left and right end; pictures: figure, x, y, scale.
    keep: whether it stays on the page of the piece behind it.
    """

    height: float
    texts: list[tuple[float, float, str, dict[str, Any]]] = dataclasses.field(default_factory=list)
    rules: list[tuple[float, float, float, float]] = dataclasses.field(default_factory=list)
    pictures: list[tuple[style.Figure, float, float, float]] = dataclasses.field(default_factory=list)
    keep: bool = False


@dataclasses.dataclass
class _Table:
    """A table that is divided between its rows: its head is repeated."""

    head: _Piece
    rows: list[_Piece]
    foot: _Piece


def pdf(document: Document) -> bytes:
    """The document as a PDF file: title, contents, and sections, with running heads and page numbers."""
    from matplotlib.backends.backend_pdf import PdfPages

    pages, starts = _paginated(document)
    content = io.BytesIO()

    @style.styled
    def write() -> None:
        with PdfPages(content, metadata={"CreationDate": None, "Title": document.title}) as file:
            for number, page in enumerate(pages, 1):
                file.savefig(_sheet(document, page, number, len(pages)))

    _fill_contents(document, pages, starts)
    write()
    return content.getvalue()


@style.styled
def _paginated(document: Document) -> tuple[list[list[tuple[float, _Piece]]], list[int]]:
    """Pieces with their places from the top on every page, and the page of every section, from 1."""
    pages: list[list[tuple[float, _Piece]]] = [[]]
    starts: list[int] = []
    y = 0.0

    def place(pieces: Sequence[_Piece]) -> None:
        nonlocal y
        room = TALL + _FOOT - y - sum(piece.height for piece in pieces)
        if y > 0 and room < 0:
            last = pieces[-1]
            if last.pictures and room >= (_SHRUNK - 1) * last.height:
                pieces = [*pieces[:-1], _shrunk(last, 1 + room / last.height)]
            else:
                pages.append([])
                y = 0.0
        for piece in pieces:
            pages[-1].append((y, piece))
            y += piece.height

    place([_front(document)])
    for k, section in enumerate(document.sections, 1):
        kept: list[_Piece] = []
        for piece in _pieces(section, k):
            if isinstance(piece, _Piece) and piece.keep:
                kept.append(piece)
                continue
            if isinstance(piece, _Piece):
                place([*kept, piece])
            else:
                whole = len(piece.rows) if sum(row.height for row in piece.rows) <= _WHOLE * TALL else _TOGETHER
                place([*kept, piece.head, *piece.rows[:whole]])
            starts += [len(pages)] * (len(starts) < k)
            kept = []
            if isinstance(piece, _Table):
                for row in piece.rows[whole:]:
                    if y + row.height > TALL:
                        place([piece.foot])
                        pages.append([])
                        y = 0.0
                        place([piece.head])
                    place([row])
                place([piece.foot])
    return pages, starts


def _shrunk(piece: _Piece, factor: float) -> _Piece:
    """A row of figures at another scale, in the middle of the page."""
    pictures = []
    for figure, x, y, scale in piece.pictures:
        pictures.append((figure, 0.5 * ROOM + factor * (x - 0.5 * ROOM), factor * y, factor * scale))
    texts = [(0.5 * ROOM + factor * (x - 0.5 * ROOM), factor * y, text, look) for x, y, text, look in piece.texts]
    return dataclasses.replace(piece, height=factor * piece.height, pictures=pictures, texts=texts)


def _front(document: Document) -> _Piece:
    """Title, lines below it and the list of contents, whose page numbers follow."""
    title = style.fill(document.title, (ROOM + 34) / 72, 17, bold=True).splitlines()
    piece = _Piece(0.0)
    y = 14.0
    for line in title:
        piece.texts.append((0, y, line, {"fontsize": 17, "weight": "bold"}))
        y += 22
    y += 2
    for text in document.lines:
        for line in style.fill(text, (ROOM + 2 * _TEXT) / 72, _TEXT).splitlines():
            piece.texts.append((0, y, line, {"fontsize": _TEXT, "color": style.GREY}))
            y += 12
        y += 1
    y += 8
    piece.rules.append((y - 6, 0.8, 0.0, ROOM))
    piece.texts.append((0, y + 8, "Contents", {"fontsize": 11, "weight": "bold"}))
    y += 24
    for k, section in enumerate(document.sections, 1):
        piece.texts.append((_NAMES - 8, y, str(k), {"fontsize": _TEXT, "ha": "right"}))
        piece.texts.append((_NAMES, y, section.title, {"fontsize": _TEXT}))
        y += 13
    piece.height = y + 14
    return piece


def _fill_contents(document: Document, pages: list[list[tuple[float, _Piece]]], starts: Sequence[int]) -> None:
    """Page numbers of the list of contents, with lines that lead to them."""
    front = pages[0][0][1]
    entries = front.texts[len(front.texts) - 2 * len(document.sections) + 1 :: 2]
    for (x, y, name, _), page in zip(entries, starts, strict=True):
        end = x + style.text_width(name, _TEXT) + 6
        number = str(page)
        right = ROOM - style.text_width(number, _TEXT) - 6
        front.texts.append((ROOM, y, number, {"fontsize": _TEXT, "ha": "right"}))
        front.rules.append((y, 0.2, end, right))


def _pieces(section: Section, number: int) -> Iterator[_Piece | _Table]:
    """The pieces of a section in order; figures that fit are beside each other."""
    head = _Piece(_HEAD, keep=True)
    head.texts.append((0, 18, f"{number}   {section.title}", {"fontsize": 12.5, "weight": "bold"}))
    head.rules.append((27, 0.5, 0.0, ROOM))
    yield head
    if section.gap:
        yield _paragraph(section.gap, italic=True)
    waiting: list[Picture] = []
    for k, block in enumerate(section.blocks):
        if isinstance(block, Picture):
            waiting.append(block)
            continue
        yield from _pictures(waiting)
        waiting = []
        if isinstance(block, Heading):
            piece = _Piece(22.0, keep=True)
            piece.texts.append((0, 12, block.text, {"fontsize": 9.5, "weight": "bold"}))
            yield piece
        elif isinstance(block, Grid):
            yield from _grid(block)
        else:
            behind = itertools.dropwhile(lambda other: isinstance(other, str), section.blocks[k : k + _LINES + 1])
            yield dataclasses.replace(_paragraph(block), keep=isinstance(next(behind, None), Grid))
    yield from _pictures(waiting)


def _paragraph(text: str, *, italic: bool = False) -> _Piece:
    lines = style.fill(text, (ROOM + 2 * _TEXT) / 72, _TEXT).splitlines()
    piece = _Piece(11.5 * len(lines) + 4)
    look: dict[str, Any] = {"fontsize": _TEXT} | ({"style": "italic", "color": style.GREY} if italic else {})
    piece.texts = [(0, 8 + 11.5 * k, line, look) for k, line in enumerate(lines)]
    return piece


def _pictures(pictures: Sequence[Picture]) -> list[_Piece]:
    """Figures in rows: two beside each other where they stay legible; somewhat smaller if they fill one page then."""
    rest, pieces = [*pictures], []
    while rest:
        row = [rest.pop(0)]
        if rest and _scale([row[0], rest[0]]) >= _BESIDE:
            row.append(rest.pop(0))
        scale = _scale(row)
        sizes = [72 * scale * size for picture in row for size in [picture.figure.get_size_inches()]]
        height = max(size[1] for size in sizes)
        below = 14 if any(picture.caption for picture in row) else 0
        piece = _Piece(height + 12 + below)
        x = 0.5 * (ROOM - sum(size[0] for size in sizes) - 10 * (len(row) - 1))
        for picture, size in zip(row, sizes, strict=True):
            piece.pictures.append((picture.figure, x, 4 + 0.5 * (height - size[1]), scale))
            look: dict[str, Any] = {"fontsize": _TEXT, "ha": "center"}
            piece.texts += [(x + 0.5 * size[0], height + 12, picture.caption, look)] if picture.caption else []
            x += size[0] + 10
        pieces.append(piece)
    factor = (TALL - _HEAD) / max(sum(piece.height for piece in pieces), 1.0)
    return [_shrunk(piece, factor) for piece in pieces] if len(pieces) > 1 and _FILLING <= factor < 1 else pieces


def _scale(row: Sequence[Picture]) -> float:
    sizes = [72 * picture.figure.get_size_inches() for picture in row]
    wide, tall = sum(size[0] for size in sizes), max(size[1] for size in sizes)
    return min(1.0, (ROOM - 10 * (len(row) - 1)) / wide, (TALL - 60) / tall)


# -- tables


def _grid(grid: Grid) -> Iterator[_Table]:
    """A table as wide as the page allows: long narrow ones are set in several columns."""
    size, widths = _widths(grid)
    total = sum(widths)
    pitch = 1.45 * size
    columns = int((ROOM + 24) / (total + 24)) if len(grid.rows) > 12 else 1
    columns = max(1, min(columns, 3))
    length = -(-len(grid.rows) // columns)
    parts = [grid.rows[k * length : (k + 1) * length] for k in range(columns)]
    parts = [part for part in parts if part]
    places = [k * (total + 24) for k in range(len(parts))]
    two = any(second for _, second in grid.heads)
    head = _Piece((2 if two else 1) * pitch + 7)
    foot = _Piece(_FOOT)
    for x in places:
        left = x
        head.rules += [(1.5, 0.8, x, x + total), (head.height - 1.5, 0.5, x, x + total)]
        foot.rules.append((1.5, 0.8, x, x + total))
        for (first, second), side, width in zip(grid.heads, grid.sides, widths, strict=True):
            place = left + _PAD if side == "left" else left + width - _PAD
            head.texts.append((place, 3 + 0.7 * pitch, first, {"fontsize": size, "weight": "bold", "ha": side}))
            if second:
                look = {"fontsize": size, "color": style.GREY, "ha": side}
                head.texts.append((place, 3 + 1.7 * pitch, second, look))
            left += width
    rows = []
    for k in range(length):
        piece = _Piece(pitch)
        for part, x in zip(parts, places, strict=True):
            if k < len(part):
                _row(piece, part[k], grid, widths, x, size, pitch)
        rows.append(piece)
    yield _Table(head, rows, foot)


def _row(
    piece: _Piece, row: Sequence[str], grid: Grid, widths: Sequence[float], x: float, size: float, pitch: float
) -> None:
    most = 1
    for text, side, width in zip(row, grid.sides, widths, strict=True):
        lines = _lines(text, width - 2 * _PAD, size)
        for n, line in enumerate(lines):
            place = x + _PAD if side == "left" else x + width - _PAD
            piece.texts.append((place, (0.7 + n) * pitch, line, {"fontsize": size, "ha": side}))
        most = max(most, len(lines))
        x += width
    piece.height = max(piece.height, most * pitch)


@functools.lru_cache(maxsize=4096)
def _lines(text: str, width: float, size: float) -> list[str]:
    """The lines of a cell; a text without spaces that is too long is broken anywhere."""
    if style.text_width(text, size) <= width + 0.5:
        return [text]
    lines = []
    for line in style.fill(text, (width + 2 * size) / 72, size).splitlines():
        while style.text_width(line, size) > width + 0.5 and len(line) > 4:
            cut = max(int(len(line) * width / style.text_width(line, size)), 4)
            lines.append(line[:cut])
            line = line[cut:]
        lines.append(line)
    return lines


def _widths(grid: Grid) -> tuple[float, list[float]]:
    """Size of the letters and widths of the columns: texts are broken, then letters are smaller, to fit the page."""
    size = _CELL
    while True:
        natural = (
            [2 * _PAD + max(style.text_width(text, size) for text in texts) for texts in zip(*grid.rows, strict=True)]
            if grid.rows
            else [0.0] * len(grid.heads)
        )
        heads = [2 * _PAD + max(1.12 * style.text_width(text, size) for text in pair) for pair in grid.heads]
        natural = [max(pair) for pair in zip(natural, heads, strict=True)]
        over = sum(natural) - ROOM
        if over <= 0:
            return size, natural
        breakable = [k for k, side in enumerate(grid.sides) if side == "left" and natural[k] > _WRAPPED]
        room = sum(natural[k] - _WRAPPED for k in breakable)
        if room >= over:
            for k in breakable:
                natural[k] -= over * (natural[k] - _WRAPPED) / room
            return size, natural
        if size <= _LEAST:
            factor = ROOM / sum(natural)
            return size * factor, [width * factor for width in natural]
        size -= 0.5


# -- sheets


def _sheet(document: Document, page: Sequence[tuple[float, _Piece]], number: int, count: int) -> style.Figure:
    """A page with its running head and number."""
    figure = style.new_figure(WIDTH / 72, HEIGHT / 72)
    figure.set_layout_engine("none")
    figure.dpi = 72

    def write(x: float, y: float, text: str, **look: Any) -> None:
        text = text.replace("$", r"\$")
        figure.text((LEFT + x) / WIDTH, 1 - y / HEIGHT, text, **{"va": "baseline", "ha": "left"} | look)

    def rule(y: float, width: float, left: float, right: float) -> None:
        from matplotlib.lines import Line2D

        ends = [(LEFT + left) / WIDTH, (LEFT + right) / WIDTH]
        height = [1 - y / HEIGHT] * 2
        figure.add_artist(Line2D(ends, height, linewidth=width, color=style.INK, solid_capstyle="butt"))

    small = {"fontsize": 7, "color": style.GREY}
    write(ROOM, HEIGHT - 28, f"page {number} of {count}", ha="right", **small)
    write(0, HEIGHT - 28, "raytrace" + f"  ·  {document.date}" * bool(document.date), **small)
    if number > 1:
        title = document.title if style.text_width(document.title, 7) < ROOM else document.title[:90] + " …"
        write(0, 40, title, **small)
    for top, piece in page:
        for x, y, text, look in piece.texts:
            write(x, TOP + top + y, text, **look)
        for y, width, left, right in piece.rules:
            rule(TOP + top + y, width, left, right)
        for drawn, x, y, scale in piece.pictures:
            _inset(figure, drawn, LEFT + x, HEIGHT - TOP - top - y, scale)
    return figure


def _inset(page: style.Figure, drawn: style.Figure, x: float, top: float, scale: float) -> None:
    """Draw a figure on the page, its upper left corner at x, top (points from below), as vectors, at a scale.

    The graphics of the inner figure are set between `q … cm` and `Q` of the content of the page.
    """
    from matplotlib.artist import Artist
    from matplotlib.backends.backend_pdf import FigureCanvasPdf, Op
    from matplotlib.collections import QuadMesh

    class Inset(Artist):
        def draw(self, renderer: Any) -> None:
            size, page_size = drawn.get_size_inches(), (renderer.file.width, renderer.file.height)
            height = 72 * size[1]
            before, canvas = drawn.dpi, drawn.canvas
            for part in drawn.findobj(Artist.get_rasterized):
                part.set_rasterized(False)  # the page would place the pixels without the scale
                if isinstance(part, QuadMesh):  # no gaps between the shades of a scale of colours
                    part.set(edgecolor="face", linewidth=0.3)
            FigureCanvasPdf(drawn)
            drawn.dpi = 72
            renderer.file.output(*renderer.gc.finalize())
            state = copy.copy(renderer.gc)
            renderer.file.output(Op.gsave, scale, 0, 0, scale, x, top - scale * height, Op.concat_matrix)
            renderer.file.width, renderer.file.height = map(float, size)  # lines are cut there, in units of the figure
            drawn.draw(renderer)
            renderer.file.width, renderer.file.height = page_size
            renderer.file.output(*renderer.gc.finalize())
            renderer.file.output(Op.grestore)
            renderer.gc.copy_properties(state)
            drawn.dpi = before
            drawn.set_canvas(canvas)

    page.add_artist(Inset())
