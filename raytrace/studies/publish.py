"""Publishing: a page with its tables and figures in a folder beside it."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from raytrace.cli.door import say
from raytrace.files import write_text
from raytrace.pages import write_page
from raytrace.plotting.style import save


def published(file: str | Path, docs: str | Path) -> str:
    """A file as the command of a page names it: below docs/ where it lies there, as it was given, or by its name alone
    where that was from the root of this machine."""
    path, root = Path(file), Path(docs).resolve()
    if path.resolve().is_relative_to(root):
        return (Path("docs") / path.resolve().relative_to(root)).as_posix()
    return path.name if path.is_absolute() else path.as_posix()


def publish(page: Path, folder: str, parts: Iterable[str], *, tables: Mapping[str, str], figures: Mapping) -> None:
    """Write a page anew above what it keeps. tables (CSV), figures (of matplotlib): by file name, in the folder."""
    beside = page.parent / folder
    beside.mkdir(parents=True, exist_ok=True)
    for name, text in tables.items():
        write_text(beside / name, text)
    for name, figure in figures.items():
        save(figure, beside / name)
    write_page(page, parts)
    say(f"written: {page}")
