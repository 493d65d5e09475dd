"""Parts of a document: headings, paragraphs, tables and figures, which `pages` sets on paper and `web` as HTML."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

from raytrace.maths.result import Column, Columns, Result, cells
from raytrace.plotting.style import Figure, styled

MOST_ROWS = 80  # of a table


@dataclasses.dataclass(frozen=True)
class Grid:
    """A table of texts: two lines of headings, rows, and the side to which each column is aligned."""

    heads: tuple[tuple[str, str], ...]
    rows: tuple[tuple[str, ...], ...]
    sides: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Heading:
    """The heading of a part of a section."""

    text: str


@dataclasses.dataclass(frozen=True)
class Picture:
    """A figure and its description, and the caption that is set below it."""

    figure: Figure
    text: str
    caption: str = ""


#: A part of a section; a text is a paragraph.
Block: TypeAlias = str | Heading | Grid | Picture


@dataclasses.dataclass(frozen=True)
class Section:
    """A section of a document: its name, title and parts; documents: of its results, for JSON; gap: why it is empty."""

    name: str
    title: str
    blocks: tuple[Block, ...]
    documents: tuple[dict[str, Any], ...] = ()
    gap: str = ""


@dataclasses.dataclass(frozen=True)
class Document:
    """A document: title, lines below it, and sections."""

    title: str
    lines: tuple[str, ...]
    sections: tuple[Section, ...]
    date: str = ""


@styled
def settled(figure: Figure) -> Figure:
    """A figure whose parts have their final places: a second layout would move them again."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return figure


def grid_of(columns: Columns, result: Result | None = None) -> Grid:
    """A table of the columns of a result, with its units and formats."""
    printed: dict[Column, Sequence] = dict(columns) if result is None else result.printed_columns(columns)
    heads, rows = [], []
    for column, values in printed.items():
        first, second, *texts = cells(column, values)
        heads.append((first.replace("_", " "), second))
        rows.append([text.replace("-", "−") if _is_number(text) else text for text in texts])
    sides = tuple("left" if column.form.startswith("<") else "right" for column in printed)
    return Grid(tuple(heads), tuple(zip(*rows, strict=True)), sides)


def tables_of(result: Result, most: int = MOST_ROWS) -> list[Block]:
    """The tables of a result, of so many rows at most, with the lines above and below them."""
    blocks: list[Block] = []
    for table in result.tables():
        blocks += [line.strip() for line in table.title if line.strip()]
        if table.columns:
            grid = grid_of(table.columns, result)
            rest = len(grid.rows) - most
            blocks.append(dataclasses.replace(grid, rows=grid.rows[:most]) if rest > 0 else grid)
            blocks += [f"and {rest:,} more rows"] if rest > 0 else []
        blocks += [line.partition("; --json")[0].strip() for line in table.notes if line.strip()]
    return blocks


def rows_grid(heads: Sequence[str], rows: Iterable[Sequence[str]], sides: str) -> Grid:
    """A table of texts; sides: a letter for each column, l or r."""
    whole = {"l": "left", "r": "right"}
    texts = tuple(tuple(text.replace("-", "−") if _is_number(text) else text for text in row) for row in rows)
    return Grid(tuple((head, "") for head in heads), texts, tuple(whole[side] for side in sides))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
