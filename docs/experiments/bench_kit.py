"""Shared by the scripts bench_*.py: their options, the peers, and a page with its table and figure."""

import argparse
import dataclasses
import importlib
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType

import torch
from matplotlib.figure import Figure
from pages import table, write_page

from raytrace.bench.result import clock_name, machine
from raytrace.cli.options import json
from raytrace.cli.runner import open_lens, present, printed_on_failure, say
from raytrace.cli.settings import documents
from raytrace.cli.types import count
from raytrace.files import write_text
from raytrace.maths.result import Result, plain
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens

Options = Callable[[argparse.ArgumentParser], object]


@dataclasses.dataclass(frozen=True)
class Request:
    """A benchmark to run. arguments: of the script; peers: the module `bench_peers`, or None; threads: of torch."""

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
class Page(Result):
    """Rows of a benchmark.

    lines: of the page; about: the JSON document without the rows; figure: rows as mappings -> figure; place: the page
    in a folder of pages, and the name of its table and figure without suffix.
    """

    rows: Sequence
    lines: Sequence[str]
    about: dict
    figure: Callable[[Sequence[dict]], Figure]
    place: tuple[str, str]

    def document(self) -> dict:
        return self.about | {"rows": [plain(dataclasses.asdict(row)) for row in self.rows]}

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def draw(self) -> Figure:
        return self.figure([dataclasses.asdict(row) for row in self.rows])

    def save_page(self, folder: str | Path) -> None:
        """Write page, table and figure in a folder of pages; text below the mark of the page is kept."""
        path, stem = (Path(folder, name) for name in self.place)
        stem.parent.mkdir(parents=True, exist_ok=True)
        write_text(stem.with_suffix(".csv"), table(self.rows))
        self.plot(stem.with_suffix(".png"))
        write_page(path, [str(self)])


def in_words(about: Mapping[str, str | int], sign: str = ": ", between: str = "; ") -> str:
    """The machine, in one line."""
    return between.join(f"{name}{sign}{value}" for name, value in about.items())


def clock_of(about: Mapping[str, str | int]) -> str:
    """The quantity that times of this machine are."""
    return clock_name(int(about["torch threads"]))


def shared(parser: argparse.ArgumentParser, content: str) -> None:
    """--repeats, --threads, --no-peers, --docs and --json; content: of the folder --docs."""
    parser.add_argument("--repeats", metavar="N", type=count, default=5, help="runs, whose median is reported")
    parser.add_argument("--threads", metavar="N", type=count, default=1, help="threads of torch (default 1)")
    parser.add_argument("--no-peers", action="store_true", help="leave out Optiland even if it is installed")
    documents(parser, content)
    json(parser)


def run(bench: Callable[[Request], Page], options: Options, argv: Sequence[str] | None, *, peers: bool) -> None:
    """Measure, write the page under --docs, and print the result. peers: whether the script measures them."""
    parser = argparse.ArgumentParser(description=bench.__doc__)
    options(parser)
    arguments = parser.parse_args(argv)
    module = installed() if peers and not arguments.no_peers else None
    with torch_threads(arguments.threads):
        if module:
            module.set_threads(arguments.threads)
        result = bench(Request(arguments, module, arguments.threads))
    if arguments.docs:
        with printed_on_failure(result, arguments):
            result.save_page(arguments.docs)
    present(result, arguments)


def installed() -> ModuleType | None:
    """The module `bench_peers`, or None with a message if Optiland is not installed."""
    if importlib.util.find_spec("optiland") is None:
        say("Optiland is not installed: measuring this package alone (pip install 'raytrace[bench]' adds it)")
        return None
    return importlib.import_module("bench_peers")
