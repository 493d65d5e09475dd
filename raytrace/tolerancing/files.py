"""The tolerances of a lens file, of its lines TOL: read, and stored in a lens."""

import dataclasses
from collections.abc import Iterable
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from raytrace.io import read_lens
from raytrace.io.source import LensFileError, Place, read_text
from raytrace.io.zemax.surfaces import records
from raytrace.io.zemax.tolerances import Unwritable, read_lines, written_lines
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData
from raytrace.system.tolerance_data import Compensator, Tolerance
from raytrace.tolerancing.perturbation import check_tolerances
from raytrace.tolerancing.table import BadTolerance, ToleranceTable, rows_of


def read_tolerances(path: str | PathLike, **options: Any) -> ToleranceTable:
    """The tolerances of a .zmx file: TRAD, TTHI, TETX … as rows, COMP and CPAR as compensators, TWAV, STAT, SAVE.

    options: of `read_lens`. Operands that are not read are listed in `unread`, each with the reason; see [Tolerances](
    tolerances.md) for what each operand means. Raises LensFileError with file, line and operand.
    """
    lens, file = read_lens(path, **options), fspath(path)
    if lens.optimization_data is None or not lens.optimization_data.tolerances:
        raise LensFileError("no lines of tolerances (TOL); give limits or a grade by `tolerances`", Place(file))
    numbers = []
    if Path(path).suffix.lower() == ".zmx":
        numbers = [
            record.place.line or 0 for record in records(read_text(Path(path)), file) if record.keyword in _LINES
        ]
    return ToleranceTable(*read_lines(lens, lens.optimization_data.tolerances, file, numbers))


_LINES = ("TOL", "TCMM")


def tolerances_of(lens: Lens) -> ToleranceTable:
    """The tolerances of the file of a lens; an empty table where it has none."""
    lines = () if lens.optimization_data is None else lens.optimization_data.tolerances
    return ToleranceTable(*read_lines(lens, lines))


def with_tolerances(
    lens: Lens, tolerances: ToleranceTable | Iterable[Tolerance], compensators: Iterable[Compensator] = ()
) -> Lens:
    """`Lens.with_tolerances`."""
    table = tolerances if isinstance(tolerances, ToleranceTable) else ToleranceTable(rows_of(tolerances))
    adjusted = (*table.compensators, *compensators)
    check_tolerances(lens, table.rows)
    data = lens.optimization_data or OptimizationData()
    try:
        lines = written_lines(lens, table.rows, adjusted, table.test_wavelength) if table.rows or adjusted else ()
    except Unwritable as error:
        raise BadTolerance(str(error)) from error
    return dataclasses.replace(lens, optimization_data=dataclasses.replace(data, tolerances=lines))
