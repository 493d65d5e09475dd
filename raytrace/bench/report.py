"""Results of a benchmark: rows, page, JSON document and figure."""

import argparse
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType

import torch

from raytrace.cli.run import open_lens
from raytrace.files import write_text
from raytrace.maths.result import Result, plain
from raytrace.pages import machine, table, write_page
from raytrace.plotting.style import save
from raytrace.system.lens import Lens


@dataclasses.dataclass(frozen=True)
class Request:
    """A benchmark to run. arguments: of the command; peers: the module `bench.peers`, or None; threads: of torch."""

    arguments: argparse.Namespace
    peers: ModuleType | None
    threads: int

    def open_lens(self, name: str) -> Lens:
        return open_lens(argparse.Namespace(lens=name, catalog=[]))

    def about(self) -> dict[str, str | int]:
        """The machine and the versions."""
        torch.set_num_threads(self.threads)  # peers may have changed them
        return machine() | (self.peers.versions() if self.peers else {})


@dataclasses.dataclass(frozen=True, repr=False)
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
        return self.about | {"rows": [plain(dataclasses.asdict(row)) for row in self.rows]}

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def plot(self, path=None):
        figure = self.draw([dataclasses.asdict(row) for row in self.rows])
        if path is not None:
            save(figure, path)
        return figure

    def save(self, path: str | Path) -> None:
        """Write the page."""
        write_text(path, str(self) + "\n")

    def save_table(self, path: str | Path) -> None:
        """Write all rows as CSV."""
        write_text(path, table(self.rows))

    def save_page(self, folder: str | Path) -> None:
        """Write page, table and figure in a folder of pages; text below the mark of the page is kept."""
        path, stem = (Path(folder, name) for name in self.place)
        stem.parent.mkdir(parents=True, exist_ok=True)
        self.save_table(stem.with_suffix(".csv"))
        self.plot(stem.with_suffix(".png"))
        write_page(path, [str(self)])


def in_words(about: Mapping[str, str | int], sign: str = ": ", between: str = "; ") -> str:
    """The machine, in one line."""
    return between.join(f"{name}{sign}{value}" for name, value in about.items())


def clock_of(about: Mapping[str, str | int]) -> str:
    """The quantity that `measure.clock` reads."""
    return "processor time" if about["torch threads"] == 1 else "time of day"
