"""Prescriptions as pandas tables; the only module that imports pandas at the top."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from raytrace.io.source import Draft, LensFileError, Place
from raytrace.io.table.read import build
from raytrace.io.table.system import written
from raytrace.io.table.text import Table, add_metadata, add_row, header
from raytrace.io.table.write import rows
from raytrace.system.lens import Lens
from raytrace.system.surface import SIZES

_NUMERIC = ("curvature", "thickness", "conic", *SIZES)
_PLACE = Place("DataFrame")


def to_frame(lens: Lens, *, catalogs: Sequence[Path] = ()) -> pd.DataFrame:
    """One row per surface, object and image included, indexed by surface number; mm and 1/mm.

    The system (aperture, fields, wavelengths, …) is in `frame.attrs["system"]`, a list of (key, value) as in the header
    of a table file; `lens_from_frame` reads it back, number for number.
    """
    columns = rows(lens, _PLACE.file)
    frame = pd.DataFrame({name: _column(name, cells) for name, cells in columns.items() if name != "surface"})
    frame.index = pd.RangeIndex(len(frame), name="surface")
    frame.attrs["system"] = written(lens, _PLACE, catalogs)
    return frame


def lens_from_frame(
    frame: pd.DataFrame, *, catalogs: Sequence[Path] = (), strict: bool = False, **metadata: object
) -> Lens:
    """The lens of a table of pandas: columns as in `raytrace.io.table.read`, the system by keyword or in attrs.

    metadata: header keys with `_` for blanks, as text or numbers: aperture="EPD 33.33", fields="angle 0 10 14",
    wavelengths=[0.4861, 0.5876], primary_wavelength=2, object_distance=25000, stop=6, title, note. They go before
    `frame.attrs["system"]`. Raises LensFileError with the row where it applies, UnsupportedSurface and UnknownGlass.
    """
    report = Draft(_PLACE.file, "DataFrame")
    table = Table(_PLACE, report)
    stored = dict.fromkeys(metadata)
    for key, value in frame.attrs.get("system", ()):
        if key.replace(" ", "_") not in stored:
            add_metadata(table, key, value, _PLACE)
    for key, value in metadata.items():
        add_metadata(table, key, _text(value), _PLACE)
    if not isinstance(frame.index, pd.RangeIndex) or frame.index.name is not None:
        frame = frame.reset_index(names=frame.index.name or "surface")
    header(table, [str(column) for column in frame.columns], _PLACE)
    for cells in frame.itertuples(index=False, name=None):
        add_row(table, [_text(cell) for cell in cells], _PLACE)
    lens = build(table, catalogs=catalogs, packed={})
    report.finished(strict=strict)
    return lens


def _column(name: str, cells: list[str]) -> list[str] | list[float]:
    if name in _NUMERIC or (name[0] == "a" and name[1:].isdigit()):
        return [float(cell) if cell else float("nan") for cell in cells]
    return cells


def _text(value: Any) -> str:
    """A cell or header value as a table file has it; numbers keep all their digits."""
    if value is None or value is pd.NA or (isinstance(value, float) and value != value):
        return ""
    if isinstance(value, str):
        return value.strip()
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, Sequence):
        return " ".join(_text(part) for part in value)
    try:
        return repr(float(value))
    except (TypeError, ValueError) as error:
        raise LensFileError(f"{value!r} is neither a text nor a number", _PLACE) from error
