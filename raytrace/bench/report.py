"""What a benchmark gives: rows, the page about them, a document and a figure; and how tables of pages are made."""

import argparse
import dataclasses
import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType

from raytrace.files import table as csv_table
from raytrace.files import write_text
from raytrace.maths.result import Result
from raytrace.pages import KEPT, page
from raytrace.system.lens import Lens


@dataclasses.dataclass(frozen=True)
class Asked:
    """What a subject is asked to measure. arguments: of the command; open_lens: a lens by its name; peers: the module
    `bench.peers`, or None; about: the machine, in words; threads: of torch.
    """

    arguments: argparse.Namespace
    open_lens: Callable[[str], Lens]
    peers: ModuleType | None
    about: Callable[[], dict[str, str | int]]
    threads: int


@dataclasses.dataclass(frozen=True)
class Measured(Result):
    """Rows of one benchmark with what is said about them.

    lines: of the page; about: the document for JSON beside the rows; figure: name of a function of `bench.figures` and
    its further arguments; place: the page under --docs, and the name of its table and figure without suffix.
    """

    rows: Sequence
    lines: Sequence[str]
    about: dict
    figure: tuple
    place: tuple[str, str] | None = None

    def document(self) -> dict:
        return self.about | {"rows": [_finite(dataclasses.asdict(row)) for row in self.rows]}

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def plot(self, path=None):
        name, *others = self.figure
        drawing = importlib.import_module("raytrace.bench.figures")
        figure = getattr(drawing, name)([dataclasses.asdict(row) for row in self.rows], *others)
        if path is not None:
            drawing.style.save(figure, path)
        return figure

    def save(self, path: str | Path) -> None:
        """Write the report; what is written by hand below the mark of a page stays."""
        write_text(path, str(self) + "\n")

    def save_table(self, path: str | Path) -> None:
        """Write all rows as CSV."""
        write_text(path, csv_table([dataclasses.asdict(row) for row in self.rows], floats="{:.6g}".format))

    def save_page(self, folder: str | Path) -> None:
        """Write page, table and figure under a folder of pages; what stands below the mark of the page stays."""
        path, stem = (Path(folder, name) for name in self.place)
        kept = path.read_text(encoding="utf-8").partition(KEPT)[2].strip() if path.exists() else ""
        stem.parent.mkdir(parents=True, exist_ok=True)
        self.save_table(stem.with_suffix(".csv"))
        self.plot(stem.with_suffix(".png"))
        write_text(path, page(self.lines, kept))


def _finite(value):
    """For JSON: None for what is infinite or undefined."""
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(columns: Mapping[str, Callable], rows: Sequence) -> list[str]:
    """Lines of a table: under each heading, up to a | in it, what its function says of a row."""
    heading = [name.partition("|")[0] for name in columns]
    cells = ([form(row) for form in columns.values()] for row in rows)
    return ["| " + " | ".join(line) + " |" for line in (heading, ["---"] * len(columns), *cells)]


def digits(number: float | None, form: str = ".1e", none: str = "") -> str:
    """A number in a form; `none` where there is none."""
    return none if number is None or not math.isfinite(number) else format(number, form)


def significant(number: float | None, count: int = 3) -> str:
    """To so many digits, without an exponent where it is large; – where there is none."""
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
    """What `measure.clock` told the time by."""
    return "processor time" if about["torch threads"] == 1 else "time of day"
