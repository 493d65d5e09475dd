"""The list of shipped lenses, and of the files of a folder that are read."""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from raytrace.files import shipped
from raytrace.io import FORMATS, read_lens
from raytrace.maths.result import Column, Result, Table

#: Files that are read, besides lens files: glass catalogs, checkpoints of optimisations and of tolerance studies.
_READ = {".agf": "glass catalog", ".json": "checkpoint", ".jsonl": "trials", **dict.fromkeys(FORMATS, "lens file")}


@dataclass(frozen=True)
class LensList(Result):
    """Kind, name and title of each entry: shipped lenses first, then files and folders of a folder."""

    entries: Sequence[tuple[str, str, str]]

    def tables(self) -> Sequence[Table]:
        names = ("kind", "name", "title")
        columns = dict(zip(names, zip(*self.entries, strict=True), strict=True))
        return [Table({Column(name, form="<"): texts for name, texts in columns.items()})]

    def document(self) -> dict:
        names = ("kind", "name", "title")
        return {"results": [dict(zip(names, entry, strict=True)) for entry in self.entries]}


def list_lenses(folder: str | os.PathLike = ".") -> LensList:
    """The shipped lenses, and the lens files, glass catalogs, checkpoints and folders of a folder. Raises OSError."""
    entries = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for path in sorted(shipped("lenses").rglob("*.zmx"), key=lambda path: (path.parent, path.stem)):
            entries.append(("shipped lens", path.stem, read_lens(path).name or ""))
    for path in sorted(Path(folder).iterdir()):
        kind = "folder" if path.is_dir() else _READ.get(path.suffix.lower())
        if kind and not path.name.startswith("."):
            entries.append((kind, str(path), ""))
    return LensList(entries)
