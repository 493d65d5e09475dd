"""Shared by the scripts: a grid of cases, a store that resumes, a page with tables and figures."""

import itertools
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from pages import write_page

from raytrace.files import write_atomically, write_json, write_text
from raytrace.imaging.training import RUN
from raytrace.maths.arrays import ArrayError, read_npz
from raytrace.plotting.style import save
from raytrace.stores import Folder, Unfit, number, read_document, read_file

_ADVICE = "remove it to compute it again"


def cases(**axes: Sequence) -> Iterator[dict]:
    """All combinations of values, by the name of their axis; the last axis changes fastest."""
    return (dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values()))


class Store(Folder):
    """Results in a folder by key, computed only if they are missing.

    about: whatever all of them depend on; the folder refuses another (`OtherSettings`).
    """

    def __init__(self, folder: Path, about: Mapping):
        super().__init__(folder, about, RUN)

    def number(self, key: str, compute: Callable[[], float]) -> float:
        """A number. Raises DamagedRun."""
        read = lambda file: read_document(file, number(infinite=True), RUN.damaged, _ADVICE)  # noqa: E731
        return self.record(f"{key}.json", compute, write=write_json, read=read)

    def arrays(self, key: str, compute: Callable[[], Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Arrays by name. Raises DamagedRun."""

        def write(file: Path, arrays: Mapping) -> None:
            write_atomically(file, lambda stream: np.savez(stream, **arrays))

        def decode(content: bytes) -> dict[str, np.ndarray]:
            try:
                return read_npz(content)
            except ArrayError as error:
                raise Unfit(f"{error}") from error

        read = lambda file: read_file(file, decode, RUN.damaged, _ADVICE)  # noqa: E731
        return self.record(f"{key}.npz", compute, write=write, read=read)


def published(file: str | Path, docs: str | Path) -> str:
    """A file as the command of a page spells it: relative to docs/ if it is inside, else without the folder of an
    absolute path."""
    path, root = Path(file), Path(docs).resolve()
    if path.resolve().is_relative_to(root):
        return (Path("docs") / path.resolve().relative_to(root)).as_posix()
    return path.name if path.is_absolute() else path.as_posix()


def publish(page: Path, folder: str, parts: Iterable[str], *, tables: Mapping[str, str], figures: Mapping) -> None:
    """Write a page above its hand-written part, and its tables (CSV) and figures (matplotlib) by file name.

    folder: of tables and figures, next to the page.
    """
    place = page.parent / folder
    place.mkdir(parents=True, exist_ok=True)
    for name, text in tables.items():
        write_text(place / name, text)
    for name, figure in figures.items():
        save(figure, place / name)
    write_page(page, parts)
    print(f"raytrace: written: {page}", file=sys.stderr, flush=True)
