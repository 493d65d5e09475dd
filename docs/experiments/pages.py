"""Pages of results in Markdown: measurements are rewritten, text below the mark is kept."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from raytrace import files

#: Text below this line is written by hand and kept when a page is made again.
KEPT = "<!-- kept when this page is made again -->"

#: Rows of one kind as CSV, a column for each of their fields; empty where a quantity does not exist.
table = partial(files.table, floats="{:.6g}".format)


def markdown(parts: Iterable[str], kept: str = "") -> str:
    """A page of parts with a blank line between them, empty ones left out; the mark, and `kept` below it."""
    return "\n\n".join([*filter(None, parts), f"{KEPT}\n{kept}".strip()]) + "\n"


def kept_of(page: str) -> str:
    """The text below the mark of a page."""
    return page.partition(KEPT)[2].strip()


def write_page(path: Path, parts: Iterable[str]) -> None:
    """Write a page, or write it anew above what it keeps."""
    files.write_text(path, markdown(parts, kept_of(path.read_text(encoding="utf-8")) if path.exists() else ""))


def grid(header: Sequence, rows: Iterable[Sequence]) -> str:
    """A table of Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def listing(columns: Mapping[str, Callable], rows: Iterable) -> list[str]:
    """Lines of a table: a column for each heading (text behind a | only distinguishes columns), a line for each row."""
    heading = [name.partition("|")[0] for name in columns]
    return grid(heading, ([form(row) for form in columns.values()] for row in rows)).splitlines()


def digits(number: float | None, form: str = ".1e", none: str = "") -> str:
    """A number in a form; `none` if it is None or not finite."""
    return none if number is None or not math.isfinite(number) else format(number, form)


def significant(number: float | None, count: int = 3) -> str:
    """A number to `count` digits, large ones without exponent; – if it is None or not finite."""
    if number is None or not math.isfinite(number):
        return "–"
    return f"{number:,.0f}" if abs(number) >= 10 ** (count - 1) else f"{number:.{count}g}"


def milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1e3 * seconds:,.0f}" if seconds >= 0.1 else f"{1e3 * seconds:.3g}"


def yes(fact: bool | None, none: str = "–") -> str:
    return none if fact is None else "yes" if fact else "no"


def picture(place: str, caption: str) -> str:
    """A figure with its caption below it; the caption up to its first punctuation mark in place of the figure."""
    return f"![{re.split(r'[,;:.](?: |$)', caption)[0]}]({place})\n\n*{caption}*"


def shown(value: float, digits: int) -> str:
    """A number with so many digits behind the point; ∞, and – for none."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "∞" if math.isinf(value) else "–"


def measured(what: str, about: Mapping[str, str | int]) -> str:
    """A caption: the quantity measured, in one thread, and the machine."""
    return f"Median processor time of {what}, one thread; " + ", ".join(
        f"{name} {value}" for name, value in about.items()
    )
