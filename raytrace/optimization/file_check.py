"""What was read from a lens file, the operands of its merit function that are evaluated among it."""

import dataclasses
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from raytrace.io import ImportReport, LensFileError, Substitute, read_lens_with_report
from raytrace.io.source import Place
from raytrace.optimization.operands.operand import SETTINGS
from raytrace.optimization.operands.table import OPERANDS
from raytrace.system.lens import check as check_lens
from raytrace.system.lens import check_media, glass_on_image
from raytrace.tracing.geometry import defects


def check(
    path: str | PathLike,
    *,
    catalogs: Sequence[str | Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    substitute: Substitute = None,
) -> ImportReport:
    """What was read from a lens file, what was not, and where each glass came from; what of its merit is evaluated, and
    what of the lens cannot be made (`tracing.geometry`).

    strict: raise where something was assumed. configuration: which one has to be such that it can be traced.
    substitute: as for `read_lens`. Raises as that, and LensFileError for what cannot be traced.
    """
    options = {"catalogs": catalogs, "strict": strict, "configuration": configuration, "substitute": substitute}
    lens, report = read_lens_with_report(path, **options, evaluated=(*OPERANDS, *SETTINGS))
    try:
        check_lens(lens)
    except ValueError as error:
        raise LensFileError(str(error), Place(str(path))) from error
    check_media(lens, lens.wavelengths, where=str(path))
    notes, image = report.notes, len(lens.surfaces) - 1
    if unused := glass_on_image(lens):
        notes = (
            *notes,
            f"surface {image}: light does not enter {unused}, the glass of the image: results are in front of it",
        )
    return dataclasses.replace(report, notes=notes, geometry=tuple(map(str, defects(lens))))
