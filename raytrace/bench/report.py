"""Results of a benchmark: rows, page, JSON document and figure; tables of pages."""

import argparse
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType

from raytrace.files import table as csv_table
from raytrace.files import write_text
from raytrace.maths.result import Result
from raytrace.pages import grid, kept_of, page
from raytrace.plotting.style import save as save_figure
from raytrace.system.lens import Lens


@dataclasses.dataclass(frozen=True)
class Request:
    """A benchmark to run. arguments: of the command; open_lens: a lens by its name; peers: the module `bench.peers`, or
    None; about: the machine; threads: of torch.
    """

    arguments: argparse.Namespace
    open_lens: Callable[[str], Lens]
    peers: ModuleType | None
    about: Callable[[], dict[str, str | int]]
    threads: int


@dataclasses.dataclass(frozen=True)
class Measured(Result):
    """Rows of a benchmark.

    lines: of the page; about: the JSON document without the rows; draw: rows as mappings -> figure; place: the page
    in a folder of pages, and the name of its table and figure without suffix.
    """

    rows: Sequence
    lines: Sequence[str]
    about: dict
    draw: Callable
    place: tuple[str, str] | None = None

    def document(self) -> dict:
        return self.about | {"rows": [finite(dataclasses.asdict(row)) for row in self.rows]}

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def plot(self, path=None):
        figure = self.draw([dataclasses.asdict(row) for row in self.rows])
        if path is not None:
            save_figure(figure, path)
        return figure

    def save(self, path: str | Path) -> None:
        """Write the page."""
        write_text(path, str(self) + "\n")

    def save_table(self, path: str | Path) -> None:
        """Write all rows as CSV."""
        write_text(path, csv_table([dataclasses.asdict(row) for row in self.rows], floats="{:.6g}".format))

    def save_page(self, folder: str | Path) -> None:
        """Write page, table and figure in a folder of pages; text below the mark of the page is kept."""
        path, stem = (Path(folder, name) for name in self.place)
        stem.parent.mkdir(parents=True, exist_ok=True)
        self.save_table(stem.with_suffix(".csv"))
        self.plot(stem.with_suffix(".png"))
        write_text(path, page(self.lines, kept_of(path.read_text(encoding="utf-8")) if path.exists() else ""))


def finite(value):
    """For JSON: None for infinite and undefined numbers."""
    if isinstance(value, dict):
        return {name: finite(part) for name, part in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(columns: Mapping[str, Callable], rows: Sequence) -> list[str]:
    """Lines of a table: a column for each heading (text behind a | only tells columns apart), a line for each row."""
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


def in_words(about: Mapping[str, str | int], sign: str = ": ", between: str = "; ") -> str:
    """The machine, in one line."""
    return between.join(f"{name}{sign}{value}" for name, value in about.items())


def clock_of(about: Mapping[str, str | int]) -> str:
    """The quantity that `measure.clock` reads."""
    return "processor time" if about["torch threads"] == 1 else "time of day"
