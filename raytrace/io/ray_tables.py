"""Tables of rays to be traced: x, y, z, l, m, n and optionally the wavelength of each ray."""

import dataclasses
import difflib
import io
import math
import os
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from raytrace.files import read_bytes
from raytrace.system.lens import Lens, check_media
from raytrace.system.rays import COLUMNS, TRACED, Rays, start
from raytrace.words import RaytraceError

if TYPE_CHECKING:  # slow to load
    import pandas

#: Limit of bytes, some two million rays.
LARGEST = 256 * 2**20


class RayTableError(RaytraceError, ValueError):
    """A file that is not a table of rays; the message has file, line and column."""


def read_rays(path: str | os.PathLike, lens: Lens) -> Rays:
    """Rays (3, P) in front of surface 1 of a CSV file, with their wavelengths if it has any, which the lens must take.

    Columns of words and those that `trace` writes are left out; others are errors: a misspelt wavelength must not
    become the primary one. Raises RayTableError naming file, line and column.
    """
    table = _parsed(path)
    _refuse_columns(table, path)
    names = [name for name in (*COLUMNS, "wavelength") if name in table.columns]
    values = np.stack([_floats(table[name]) for name in names], axis=1).reshape(-1, len(names))
    _refuse_values(values, table[names], path)
    position, direction = torch.from_numpy(values[:, :6].T.copy()).split(3)
    rays = start(position, direction, torch.zeros(len(values), dtype=torch.float64))
    if "wavelength" not in names:
        return rays
    check_media(lens, torch.from_numpy(np.unique(values[:, 6])), where=str(path))
    return dataclasses.replace(rays, wavelength=torch.from_numpy(values[:, 6].copy()))


def _parsed(path: str | os.PathLike) -> "pandas.DataFrame":
    """The table as words, without blank lines, which the index still counts, and without columns that are empty."""
    import pandas

    try:
        content = io.BytesIO(read_bytes(path, LARGEST))
        with warnings.catch_warnings():
            warnings.simplefilter("error", pandas.errors.ParserWarning)  # a row longer than the header
            table = pandas.read_csv(content, skipinitialspace=True, dtype=str, index_col=False, skip_blank_lines=False)
    except FileNotFoundError:
        expected = f"expected a table of rays with columns {','.join(COLUMNS)}"
        raise RayTableError(f"{path}: no such file; {expected}") from None
    except (pandas.errors.ParserError, pandas.errors.ParserWarning) as error:
        raise RayTableError(f"{path}: a row has more entries than the header: {_words(error)}") from error
    except (pandas.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise RayTableError(f"{path}: not a table of rays: {_words(error)}") from error
    except OSError as error:
        raise RayTableError(f"{path}: cannot be read: {error.strerror or error}") from error
    table.columns = [_words(name).lower() for name in table.columns]
    table = table.dropna(how="all")
    nameless = [k for k, name in enumerate(table.columns) if name.startswith("unnamed:")]
    empty = [k for k in nameless if k == 0 or table.iloc[:, k].isna().all()]  # a running number, a comma at the end
    return table.iloc[:, [k for k in range(table.shape[1]) if k not in empty]]


def _refuse_columns(table: "pandas.DataFrame", path: str | os.PathLike) -> None:
    """Refuse a table without the columns of rays, a repeated column, and a column of numbers that is not known."""
    known, names = (*COLUMNS, "wavelength", *TRACED), list(table.columns)
    expected = f"{','.join(COLUMNS)}[,wavelength]"
    for name in COLUMNS:
        if name not in names:
            raise RayTableError(
                f"{path}:1: column {name!r} is missing; expected a header {expected}, found {','.join(names)}"
            )
    for k, name in enumerate(names):
        if name in names[:k]:
            raise RayTableError(f"{path}:1: column {name[:40]!r} occurs twice")
        if name not in known and np.isfinite(_floats(table.iloc[:, k])).any():
            near = difflib.get_close_matches(name, known, n=1) or ["wavelength"] * name.startswith(("wave", "λ", "lam"))
            meant = f"did you mean {near[0]!r}?" if near else f"expected {expected}"
            raise RayTableError(f"{path}:1: column {name[:40]!r} is not known; {meant}")


def _refuse_values(values: np.ndarray, words: "pandas.DataFrame", path: str | os.PathLike) -> None:
    """Refuse entries that are not finite, directions of length 0 and wavelengths not above 0, by their lines."""
    lines = words.index.to_numpy() + 2
    for row, column in np.argwhere(~np.isfinite(values))[:1]:
        word = words.iloc[row, column]
        entry = repr(word) if isinstance(word, str) else "nothing"
        where = f"{path}:{lines[row]}: column {words.columns[column]}"
        raise RayTableError(f"{where}: expected a finite number, found {entry}")
    for row in np.flatnonzero((values[:, 3:6] == 0).all(1))[:1]:
        raise RayTableError(f"{path}:{lines[row]}: the direction l,m,n is 0,0,0; expected direction cosines")
    for row in np.flatnonzero(~(values[:, 6:] > 0).all(1))[:1]:
        raise RayTableError(f"{path}:{lines[row]}: wavelength {values[row, 6]:g}: expected µm above 0")


def _words(error: object) -> str:
    return " ".join(str(error).split())


def _floats(column: "pandas.Series") -> np.ndarray:
    """The column as float64, every text read to the nearest double; nan where it is no number."""
    try:
        return column.to_numpy(dtype=np.float64, na_value=np.nan)
    except ValueError:
        return np.array([_float(entry) for entry in column])


def _float(entry: Any) -> float:
    try:
        return float(entry)
    except (TypeError, ValueError):
        return math.nan
