"""A glass by its name for a reader: the catalogs' warnings go into the import report."""

import warnings
from collections.abc import Sequence
from pathlib import Path

from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, Place, shown
from raytrace.media.catalog import AmbiguousGlass, find_glass, missing_catalogs
from raytrace.media.glass import Glass

#: More characters than the name of any glass has.
_LONGEST = 80


def listed_glass(name: str, *, catalogs: Sequence[str], user: Sequence[Path], place: Place, report: Draft) -> Glass:
    """The glass of a name, as `find_glass` finds it; raises UnknownGlass naming the place."""
    if len(name) > _LONGEST:
        raise LensFileError(f"the glass {shown(name)} has {len(name)} characters; no glass has such a name", place)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        glass = find_glass(name, catalogs=catalogs, user=user, where=str(place))
    for warning in caught:
        if issubclass(warning.category, AmbiguousGlass):
            report.warn(str(warning.message).removeprefix(f"{place}: "), place)
        else:
            report.note(str(warning.message))
    alias = f" as {glass.listed_name}" if glass.listed_name and glass.listed_name.upper() != name.upper() else ""
    report.glass(place.surface, name, f"{glass.catalog or 'user catalog'}{alias}")
    return glass


def report_missing_catalogs(catalogs: Sequence[str], user: Sequence[Path], report: Draft) -> None:
    """Note the catalogs that a file names and that are not at hand."""
    missing = missing_catalogs(catalogs, user=user)
    if missing:
        report.note(f"catalogs that are not shipped: {', '.join(missing)}; their glasses are sought in the others")
