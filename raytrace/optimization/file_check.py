"""Import report of a lens file, with the operands of its merit function that are evaluated."""

import dataclasses
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from raytrace.io import ImportReport, LensFileError, Substitute, read_lens_with_report
from raytrace.io.source import Place
from raytrace.io.zemax.tolerances import read_lines
from raytrace.optimization.attained import in_words
from raytrace.optimization.operands.operand import SETTINGS
from raytrace.optimization.operands.table import OPERANDS
from raytrace.system.lens import Lens, check_media, glass_on_image
from raytrace.system.lens import check as check_lens
from raytrace.tracing.geometry import defects


def check(
    path: str | PathLike,
    *,
    catalogs: Sequence[str | Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    substitute: Substitute = None,
) -> ImportReport:
    """The import report of a lens file: parts that were read and that were not, the source of each glass, the operands
    that are evaluated, conditions and boundaries with the values of the lens, and surfaces and gaps that cannot be made
    (`tracing.geometry`).

    strict: raise where something was assumed. configuration: the one that is traced. substitute: as for `read_lens`.
    Raises as `read_lens`, and LensFileError for a lens that cannot be traced.
    """
    lens, report = read_lens_with_report(
        path, catalogs=catalogs, strict=strict, configuration=configuration, substitute=substitute,
        evaluated=(*OPERANDS, *SETTINGS),
    )  # fmt: skip
    try:
        check_lens(lens)
    except ValueError as error:
        raise LensFileError(str(error), Place(str(path))) from error
    check_media(lens, lens.wavelengths, where=str(path))
    notes, image = report.notes, len(lens.surfaces) - 1
    if unused := glass_on_image(lens):
        note = f"surface {image}: light does not enter {unused}, the glass of the image: results are in front of it"
        notes = (*notes, note)
    geometry, unread = tuple(map(str, defects(lens))), _unread_tolerances(lens)
    conditions = tuple(in_words(lens))
    return dataclasses.replace(report, notes=notes, geometry=geometry, unread_tolerances=unread, conditions=conditions)


def _unread_tolerances(lens: Lens) -> tuple[str, ...]:
    """The lines of tolerances that are not read, with the reason, or the first that the lens does not have."""
    try:
        return read_lines(lens, lens.optimization_data.tolerances).unread if lens.optimization_data else ()
    except LensFileError as error:
        return (str(error),)
