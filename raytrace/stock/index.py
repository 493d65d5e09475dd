"""The index of stock: parts of vendors in one file, an SQLite database, which holds the content of their lens files.

Tables: `parts`, a row for each part with the figures of `parts.Figures`, its file and its content; `catalogs`, the
glass catalogs of the folders whose glasses the parts have and that are not shipped; `unread`, files without a part, and
why.
"""

import csv
import dataclasses
import functools
import math
import os
import re
import sqlite3
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from raytrace.files import check_output, read_bytes, write_atomically
from raytrace.io import FORMATS
from raytrace.io.source import Place, decode
from raytrace.io.zemax.archive import text_of_lens
from raytrace.materials.catalogs import SHIPPED
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Result, Table, number
from raytrace.stock.parts import Figures, NoPart, figures_of
from raytrace.system import prescription
from raytrace.system.lens import Lens
from raytrace.words import RaytraceError, did_you_mean, option

#: The index that commands read where none is given.
DEFAULT = "stock.sqlite"
#: Suffixes of indices, and of lens files of vendors; tables of prescriptions are not among them.
INDICES = (".sqlite", ".db")
READ = (".zmx", ".zar", ".seq", ".len", ".roa")

_VERSION = 1
_FIGURES = tuple(field.name for field in dataclasses.fields(Figures))
_LARGEST = 64 * 2**20  # bytes of a table of parts

#: Columns of a listing of parts; the distance is that to the figures that were asked for.
_COLUMNS = (
    *(Column(name, form="<") for name in ("part", "vendor", "shape")),
    *(Column(name, "mm", form) for name, form in (("efl", ".6g"), ("bfl", ".6g"), ("diameter", ".4g"))),
    *(Column(name, "mm", ".4g") for name in ("clear", "thickness")),
    Column("elements"),
    *(Column(name, form="<") for name in ("glasses", "coating")),
    Column("abbe", form=".3g"),
    Column("distance_percent", "%", ".2g", "distance"),
    Column("file", form="<"),
)


class BadStock(RaytraceError, ValueError):
    """An index, a table or a search of parts that cannot be read."""


@value
class StockPart:
    """A part of an index: its figures (`stock.parts.Figures`), the name of its file, and the index.

    distance: in %, the sum of the relative deviations from the figures that were asked for.
    """

    figures: Figures
    file: str
    index: str
    distance: float = 0.0

    @property
    def lens(self) -> Lens:
        """The lens file of the part, read from the index."""
        with _opened(self.index) as database:
            return _lens_of(database, self.file)


# -- making ------------------------------------------------------------------------------------------------------------


@value
class StockIndexed(Result):
    """An index that was written: its file, the count of parts by vendor and shape, and files without a part."""

    index: str
    parts: tuple[Figures, ...]
    unread: tuple[tuple[str, str], ...]

    def tables(self) -> list[Table]:
        kinds = sorted({(part.vendor or "-", part.shape) for part in self.parts})
        each = [[part for part in self.parts if (part.vendor or "-", part.shape) == kind] for kind in kinds]
        ends = lambda name, pick: [pick(abs(getattr(part, name)) for part in parts) for parts in each]  # noqa: E731
        columns: dict[Any, Sequence] = {
            Column("vendor", form="<"): [vendor for vendor, _ in kinds],
            Column("shape", form="<"): [shape for _, shape in kinds],
            Column("parts"): [len(parts) for parts in each],
            Column("least |EFL|", "mm", ".4g"): ends("efl", min),
            Column("largest |EFL|", "mm", ".4g"): ends("efl", max),
            Column("least diameter", "mm", ".4g"): ends("diameter", min),
            Column("largest diameter", "mm", ".4g"): ends("diameter", max),
        }
        listed = [f"  {file}:{' ' * (not reason[:1].isdigit())}{reason}" for file, reason in self.unread]
        notes = ["", f"{len(self.unread)} files without a part:", *listed] if self.unread else []
        return [Table(columns if self.parts else {}, [f"{self.index}: {len(self.parts)} parts", ""], notes)]

    def document(self) -> dict:
        return {
            "index": self.index,
            "parts": len(self.parts),
            "unread": [{"file": file, "reason": reason} for file, reason in self.unread],
        }


def stock_index(
    folder: str | os.PathLike,
    output: str | os.PathLike = DEFAULT,
    *,
    catalogs: Sequence[str | Path] = (),
    progress: Callable | None = None,
) -> StockIndexed:
    """Read the parts of a folder of vendors' lens files into one index, which suffices without the folder.

    folder: of lens files (.zmx, .zar, .seq, .len, .roa), with its subfolders and the glass catalogs (.agf) beside them;
    or a table (.csv) of parts, a row each: part, radius_1, thickness_1, glass_1, radius_2, … in mm, in the order of the
    light, and diameter, vendor, coating, wavelength (µm, by default 0.5876). output: the index to write, .sqlite or
    .db. catalogs: further glass catalogs. Files that hold no single lens in air, and those that cannot be read, are
    listed with the reason (`StockIndexed.unread`). Raises BadStock, and OSError where the index cannot be written.
    """
    check_output(output, INDICES)
    source = Path(folder)
    if source.suffix.lower() == ".csv":
        readers = _of_table(source)
    elif source.is_dir():
        paths = sorted(path for path in source.rglob("*") if path.suffix.lower() in READ and path.is_file())
        readers = [(str(path.relative_to(source)), functools.partial(_of_file, path, catalogs)) for path in paths]
    else:
        raise BadStock(f"{folder}: no such folder; expected a folder of lens files, or a table of parts (.csv)")
    parts: dict[str, Figures] = {}
    unread: list[tuple[str, str]] = []
    with closing(_empty()) as database:
        bar = progress(len(readers), "file") if progress else None
        for file, read in readers:
            try:
                figures, content, glass_catalogs = read()
                if figures.part in parts:
                    raise NoPart(f"part {figures.part} is in another file too")
                parts[figures.part] = figures
                _store(database, figures, file, content, glass_catalogs)
            except (RaytraceError, ValueError, LookupError, OSError, ArithmeticError) as error:
                unread.append((file, " ".join(str(error).split()).removeprefix(f"{source / file}").lstrip(": ")))
            if bar is not None:
                bar.update(1)
        if bar is not None:
            bar.close()
        if not parts:
            reason = f"; {unread[0][0]}: {unread[0][1]}" if unread else f"; expected files {', '.join(READ)}"
            raise BadStock(f"{folder}: no part in {len(readers)} files{reason}")
        database.executemany("INSERT INTO unread VALUES (?, ?)", unread)
        database.commit()
        content = database.serialize()
    write_atomically(output, lambda file: file.write(content))
    return StockIndexed(os.fspath(output), tuple(parts.values()), tuple(unread))


#: What a file is read to: figures, content, and glass catalogs by name.
_Read = tuple[Figures, str | bytes, dict[str, bytes]]


def _of_file(path: Path, catalogs: Sequence[str | Path]) -> _Read:
    form = FORMATS[path.suffix.lower()]
    content = form.load(path)
    lens, _ = form.read(content, str(path), catalogs=catalogs)
    used = {surface.glass.catalog.upper() for surface in lens.surfaces if surface.glass.catalog} - {*SHIPPED}
    beside = (
        {file.stem.upper(): file for file in path.parent.iterdir() if file.suffix.lower() == ".agf"} if used else {}
    )
    beside |= {Path(file).stem.upper(): Path(file) for file in catalogs}
    needed = {name: read_bytes(file, _LARGEST) for name, file in beside.items() if name in used}
    return figures_of(lens, path.name, _text(content, path)), content, needed


def _text(content: str | bytes, path: Path) -> str:
    """The text of a lens file, of an archive that of its lens."""
    if isinstance(content, str):
        return content
    return text_of_lens(content, str(path)) if path.suffix.lower() == ".zar" else decode(content, Place(str(path)))


def _of_table(path: Path) -> list[tuple[str, Callable[[], _Read]]]:
    """The parts of a table, each with the name of a .zmx file."""
    text = decode(read_bytes(path, _LARGEST), Place(str(path)))
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    names = [(name or "").strip().lower() for name in reader.fieldnames or ()]
    known = r"part|vendor|coating|diameter|wavelength|(radius|thickness|glass)_\d+"
    for name in names:
        if not re.fullmatch(known, name):
            meant = did_you_mean(name, ["part", "vendor", "coating", "diameter", "wavelength", "radius_1", "glass_1"])
            raise BadStock(
                f"{path}:1: no column {name!r}; expected part, radius_1, thickness_1, glass_1, radius_2{meant}"
            )
    if missing := {"part", "radius_1", "thickness_1", "glass_1", "radius_2"} - {*names}:
        raise BadStock(f"{path}:1: no column {min(missing)}; expected part, radius_1, thickness_1, glass_1, radius_2")
    rows: list[tuple[str, Callable[[], _Read]]] = []
    for cells in reader:
        row = {name: (cell or "").strip() for name, cell in zip(names, cells.values(), strict=False)}
        line = reader.line_num
        if any(row.values()):
            rows.append((f"{row['part'] or f'line {line}'}.zmx", functools.partial(_of_row, path, line, row)))
    return rows


def _of_row(path: Path, line: int, row: dict[str, str]) -> _Read:
    where = f"{path.name}:{line}"
    if not row["part"]:
        raise BadStock(f"{where}: no part number in the column part")

    def of(name: str) -> float:
        try:
            return float(row.get(name) or "nan")
        except ValueError:
            raise BadStock(f"{where}, {name}: {row[name]!r} is no number") from None

    faces, count = [], 1
    while row.get(f"radius_{count}"):
        glass, radius = row.get(f"glass_{count}", ""), of(f"radius_{count}") or math.inf
        face: dict[str, Any] = {"radius": radius, "thickness": of(f"thickness_{count}") if glass else 0.0}
        diameter = of("diameter")
        faces.append(
            face
            | ({"glass": glass} if glass else {})
            | ({"semi_diameter": diameter / 2} if diameter == diameter else {})
        )
        if not glass:
            break
        if not face["thickness"] > 0:
            raise BadStock(f"{where}, thickness_{count}: expected a thickness above 0 mm of {glass}")
        count += 1
    if len(faces) < 2 or "glass" in faces[-1]:
        raise BadStock(f"{where}: expected radius_{len(faces) + 1}, the last face, behind glass_{len(faces)}")
    waves = of("wavelength")
    diameter = of("diameter")
    beam = 0.5 * diameter if diameter == diameter else 1.0
    lens = prescription.lens(
        faces,
        stop=1,
        entrance_pupil_diameter=beam,
        wavelengths=[waves if waves == waves else 0.5875618],
        name=row["part"],
    )
    write = FORMATS[".zmx"].write
    assert write is not None, "a format that is written"
    content = decode(write(lens, f"{row['part']}.zmx", catalogs=()), Place(where))
    figures = figures_of(lens, f"{row['part']}.zmx")
    return (
        dataclasses.replace(figures, part=row["part"], vendor=row.get("vendor", ""), coating=row.get("coating", "")),
        content,
        {},
    )


def _empty() -> sqlite3.Connection:
    """A database in memory with empty tables."""
    kinds = {"int": "INTEGER", "float": "REAL", int: "INTEGER", float: "REAL"}
    columns = ", ".join(f"{field.name} {kinds.get(field.type, 'TEXT')}" for field in dataclasses.fields(Figures))
    database = sqlite3.connect(":memory:")
    database.executescript(
        f"PRAGMA user_version = {_VERSION};"
        f"CREATE TABLE parts ({columns}, file TEXT PRIMARY KEY, content);"
        "CREATE TABLE catalogs (folder TEXT, name TEXT, content BLOB, PRIMARY KEY (folder, name));"
        "CREATE TABLE unread (file TEXT, reason TEXT);"
    )
    return database


def _store(
    database: sqlite3.Connection, figures: Figures, file: str, content: str | bytes, catalogs: dict[str, bytes]
) -> None:
    cells = (*dataclasses.astuple(figures), file, content)
    database.execute(f"INSERT INTO parts VALUES ({', '.join('?' * len(cells))})", cells)
    for name, of_catalog in catalogs.items():
        cells = (str(Path(file).parent), name, of_catalog)
        database.execute("INSERT OR IGNORE INTO catalogs VALUES (?, ?, ?)", cells)


# -- reading -----------------------------------------------------------------------------------------------------------


@contextmanager
def _opened(index: str | os.PathLike) -> Iterator[sqlite3.Connection]:
    """An index, open for reading. Raises BadStock."""
    path = Path(index)
    if not path.is_file():
        raise BadStock(f"{index}: no such index of stock; `raytrace stock index FOLDER -o {path.name}` makes one")
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            (version,) = database.execute("PRAGMA user_version").fetchone()
            if version != _VERSION:
                raise BadStock(f"{index}: version {version} of an index of stock, expected {_VERSION}; make it again")
            yield database
    except sqlite3.DatabaseError as error:
        raise BadStock(f"{index}: no index of stock ({error}); `raytrace stock index` makes one") from error


def _lens_of(database: sqlite3.Connection, file: str) -> Lens:
    """The lens of a file of an index."""
    (content,) = database.execute("SELECT content FROM parts WHERE file = ?", (file,)).fetchone()
    form = FORMATS[Path(file).suffix.lower()]
    with tempfile.TemporaryDirectory() as folder:  # where readers look for glass catalogs
        known = database.execute("SELECT name, content FROM catalogs WHERE folder = ?", (str(Path(file).parent),))
        for name, of_catalog in known:
            beside = Path(folder) / f"{name}.agf"
            beside.write_bytes(of_catalog)
        return form.read(content, str(Path(folder) / Path(file).name))[0]


def parts_of(index: str | os.PathLike) -> list[StockPart]:
    """All parts of an index, in the order of their numbers. Raises BadStock."""
    names = ", ".join(_FIGURES)
    with _opened(index) as database:
        rows = database.execute(f"SELECT {names}, file FROM parts ORDER BY part").fetchall()
    nan = [k for k, field in enumerate(dataclasses.fields(Figures)) if field.name == "abbe"]
    cells: list[list[Any]] = [
        [math.nan if k in nan and cell is None else cell for k, cell in enumerate(row)] for row in rows
    ]
    return [StockPart(Figures(*row[:-1]), row[-1], os.fspath(index)) for row in cells]


def lenses_of(index: str | os.PathLike, files: Sequence[str]) -> dict[str, Lens]:
    """The lenses of several files of an index."""
    with _opened(index) as database:
        return {file: _lens_of(database, file) for file in files}


#: A figure that is asked for: a number, a range as "45..55" or (45, 55), or None.
Range = float | str | Sequence[float] | None


@value
class StockList(Result):
    """Parts of an index that a search passes, the nearest first; count: of all parts of the index."""

    COLUMNS = _COLUMNS

    parts: tuple[StockPart, ...]
    index: str
    count: int
    passing: int

    def _cells(self, name: str) -> list:
        if name in ("file", "distance_percent"):
            return [part.file if name == "file" else part.distance for part in self.parts]
        return [getattr(part.figures, name) for part in self.parts]

    def columns(self) -> dict[str, Tensor]:
        texts = self.words()
        return {
            column.name: torch.tensor([texts[column.name].index(cell) for cell in self._cells(column.name)])
            if column.name in texts
            else torch.tensor(self._cells(column.name), dtype=torch.float64)
            for column in _COLUMNS
        }

    def words(self) -> dict[str, Sequence[str]]:
        return {column.name: [*dict.fromkeys(self._cells(column.name))] for column in _COLUMNS if column.form == "<"}

    def tables(self) -> list[Table]:
        cells = {column: [cell or "-" if column.form == "<" else cell for cell in self._cells(column.name)]
                 for column in _COLUMNS[:-1]}  # fmt: skip
        more = f", the nearest {len(self.parts)}" if self.passing > len(self.parts) else ""
        return [Table(cells if self.parts else {}, [f"{self.passing} of {self.count} parts of {self.index}{more}", ""])]

    def document(self) -> dict:
        names = [column.name for column in _COLUMNS]
        rows = zip(*(self._cells(name) for name in names), strict=True)
        plain = [
            {name: cell if isinstance(cell, str | int) else number(cell) for name, cell in zip(names, row, strict=True)}
            for row in rows
        ]
        return {"index": self.index, "count": self.count, "passing": self.passing, "results": plain}


def stock_find(
    index: str | os.PathLike = DEFAULT,
    *,
    part: str = "",
    vendor: str = "",
    efl: Range = None,
    bfl: Range = None,
    diameter: Range = None,
    tolerance: float = 10.0,
    elements: int | None = None,
    achromat: bool = False,
    shape: str = "",
    glass: str | Sequence[str] = (),
    coating: str = "",
    limit: int = 20,
) -> StockList:
    """Parts of an index by their figures, the nearest to what is asked for first.

    efl, bfl, diameter: mm, each a number, which is met to `tolerance` in %, or a range as "45..55", "25.." or (45, 55).
    part, vendor, shape, coating: a part of the text, in any case, as shape="plano-convex"; glass: names of glasses that
    the part has, all of them; elements: their number; achromat: cemented groups whose power changes by less than 1/200
    from F to C. limit: of the parts that are listed. The distance is the sum of the relative deviations in %.
    Raises BadStock.
    """
    asked = {"efl": efl, "bfl": bfl, "diameter": diameter}
    ranges = {name: _range(name, wanted, tolerance) for name, wanted in asked.items() if wanted is not None}
    glasses = {word.upper() for word in ([glass] if isinstance(glass, str) else glass) if word}
    texts = {"part": part, "vendor": vendor, "shape": shape, "coating": coating}
    every, passing = parts_of(index), []
    for entry in every:
        figures = entry.figures
        if not all(low <= getattr(figures, name) <= high for name, (low, high, _) in ranges.items()):
            continue
        if not all(text.lower() in getattr(figures, name).lower() for name, text in texts.items()):
            continue
        if (elements is not None and figures.elements != elements) or (achromat and not figures.is_achromat):
            continue
        if not glasses <= {*figures.glasses.upper().split()}:
            continue
        off = sum(abs(getattr(figures, name) / aim - 1) for name, (*_, aim) in ranges.items() if aim)
        passing.append(dataclasses.replace(entry, distance=100 * off))
    passing.sort(key=lambda entry: (entry.distance, entry.figures.part.lower() != part.lower(), abs(entry.figures.efl)))
    return StockList(tuple(passing[:limit]), os.fspath(index), len(every), len(passing))


def _range(name: str, wanted: Range, tolerance: float) -> tuple[float, float, float]:
    """Least and largest value, and the one asked for, 0 of a range. Raises BadStock."""
    try:
        if isinstance(wanted, str):
            low, dots, high = wanted.partition("..")
            ends = [float(low or "-inf"), float(high or "inf")] if dots else [float(low)]
        else:
            ends = [*map(float, wanted)] if isinstance(wanted, Sequence) else [float(wanted or 0.0)]
    except ValueError:
        ends = []
    if len(ends) == 2 and ends[0] <= ends[1]:
        return ends[0], ends[1], 0.0
    if len(ends) != 1 or not ends[0] or not math.isfinite(ends[0]):
        raise BadStock(f"{option(name, wanted)}: expected a length in mm, as 50, or a range, as 45..55 or 25..")
    width = abs(ends[0]) * tolerance / 100
    return ends[0] - width, ends[0] + width, ends[0]


def part_named(index: str | os.PathLike, name: str) -> StockPart:
    """The part of an index by its number, in any case. Raises NoPart."""
    every = parts_of(index)
    part = next((part for part in every if part.figures.part.lower() == name.lower()), None)
    if part is None:
        meant = did_you_mean(name, [part.figures.part for part in every])
        raise NoPart(f"{index}: no part {name!r} among {len(every)}{meant}; `raytrace stock find` lists them")
    return part
