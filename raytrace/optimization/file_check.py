"""What was read from a lens file, the operands of its merit function that are evaluated among it."""

import dataclasses
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from raytrace.io import ImportReport, Substitute, checked
from raytrace.optimization.context import SETTINGS
from raytrace.optimization.operands.table import OPERANDS
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
    evaluated = (*OPERANDS, *SETTINGS)
    lens, report = checked(path, catalogs, strict, configuration, substitute, evaluated)
    return dataclasses.replace(report, geometry=tuple(map(str, defects(lens))))
