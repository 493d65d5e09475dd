"""Lens files: the suffix of a file names its format; reading gives a Lens, writing brings every number back exactly."""

import dataclasses
import os
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from raytrace.files import shipped, write_atomically
from raytrace.io.codev import read as seq_read
from raytrace.io.codev import write as seq_write
from raytrace.io.oslo import read as oslo_read
from raytrace.io.ray_optics import parts as roa_parts
from raytrace.io.ray_optics import read as roa_read
from raytrace.io.report import ImportReport as ImportReport
from raytrace.io.report import Varied, operand_uses
from raytrace.io.source import LensFileError as LensFileError
from raytrace.io.source import LensFileWarning as LensFileWarning
from raytrace.io.source import Place, decode, read_text, shown
from raytrace.io.source import UnsupportedSurface as UnsupportedSurface
from raytrace.io.substitutes import BadSubstitute as BadSubstitute
from raytrace.io.substitutes import substitutes_of
from raytrace.io.table import read as table_read
from raytrace.io.table import write as table_write
from raytrace.io.zemax import archive as zemax_archive
from raytrace.io.zemax import read as zemax_read
from raytrace.io.zemax import write as zemax_write
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import check_unit
from raytrace.maths.result import Result
from raytrace.maths.value import value
from raytrace.system.configurations import count
from raytrace.system.lens import Lens, check_media
from raytrace.system.lens import check as check_lens
from raytrace.system.optimization_data import OptimizationData
from raytrace.words import calling_level, named_value

#: Other glasses for those of a file: {"SSK4": "SSK4A"}, words like "SSK4=SSK4A", "nearest" for every unknown one.
Substitute = Mapping[str, str] | str | Sequence[str] | None


class Format(NamedTuple):
    """read(text, file, catalogs, strict, substitutes) -> (Lens, ImportReport); write(lens, file, catalogs) -> content.

    write: None for a format that is only read. load: what of a file's content is read, its text. configurations:
    whether a file may hold several, of which `read` takes the number of one.
    """

    read: Callable[..., tuple[Lens, ImportReport]]
    write: Callable[..., bytes] | None = None
    load: Callable[[Path], str | bytes] = read_text
    configurations: bool = False


#: The formats by suffix, in lower case.
FORMATS = {
    ".zmx": Format(zemax_read.read, zemax_write.write, configurations=True),
    ".zar": Format(zemax_archive.read, load=zemax_archive.load, configurations=True),
    ".seq": Format(seq_read.read, seq_write.write),
    ".len": Format(oslo_read.read),
    ".roa": Format(roa_read.read, load=roa_parts.load),
    ".csv": Format(table_read.read, table_write.write),
    ".tsv": Format(table_read.read, partial(table_write.write, separator="\t")),
    ".txt": Format(table_read.read, partial(table_write.write, separator="\t")),
}

#: The suffixes of those that are written too.
WRITTEN = tuple(suffix for suffix, form in FORMATS.items() if form.write)


def read_lens(
    path: str | os.PathLike,
    *,
    catalogs: Sequence[str | Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    substitute: Substitute = None,
) -> Lens:
    """The lens of a file, in mm and µm: .zmx, .zar (OpticStudio), .seq (CODE V), .len (OSLO), .roa (ray-optics), or a
    table.

    path: of a file, or the name of a shipped lens, as "double_gauss". catalogs: further glass catalogs (.agf), searched
    as `raytrace.materials.catalogs.find_glass` does; a catalog that the file names and that lies beside it, or in it,
    is found by itself. strict: raise where the file holds something unknown or something has
    to be assumed; otherwise that is one LensFileWarning. configuration: which one of a multi-configuration file, from
    1; by default the one that was active when it was saved. `lens.configurations` are all of them.
    substitute: other glasses for those of the file, each reported in a warning: {"SSK4": "SSK4A"}, or "nearest" for
    every one that no catalog holds, by the nd and Vd that the file has for it (`io.substitutes`).
    Raises LensFileError, its subclass UnsupportedSurface, and UnknownGlass, each naming file, line and surface; and
    BadSubstitute.
    """
    how = {"catalogs": catalogs, "strict": strict, "configuration": configuration, "substitute": substitute}
    lens, report = read_lens_with_report(path, **how)
    if report.warnings:
        warnings.warn("; ".join(report.warnings), LensFileWarning, stacklevel=calling_level())
    return lens


def as_lens(given: Lens | str | os.PathLike, verb: str) -> Lens:
    """A lens as it is, or that of a path or of a shipped name. Raises TypeError, which names the verb, for no lens."""
    if isinstance(given, Lens):
        return given
    if isinstance(given, (str, os.PathLike)):
        return read_lens(given)
    hint = "; it has one, as its `lens`" if isinstance(getattr(given, "lens", None), Lens) else ""
    expected = "a Lens, the path of a lens file or the name of a shipped lens"
    raise TypeError(f"{verb}: `lens` is {named_value(given)}; expected {expected}{hint}")


def read_lens_with_report(
    path: str | os.PathLike,
    *,
    catalogs: Sequence[str | Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    substitute: Substitute = None,
    evaluated: Collection[str] | None = None,
) -> tuple[Lens, ImportReport]:
    """As `read_lens`, with the report of what became of every keyword; its warnings are in it, and not issued.

    evaluated: the names of merit operands that are evaluated, to be told from those that are only known.
    """
    path = Path(path)
    if not path.exists():
        path = shipped_lens(path) or path
    form = _format(path)
    asked = {"configuration": configuration} if form.configurations else {}
    asked["substitutes"] = substitutes_of(substitute)
    lens, report = form.read(form.load(path), str(path), catalogs=tuple(catalogs), strict=strict, **asked)
    if configuration is not None and configuration != lens.current_configuration:
        there = "a file of this format holds one"
        raise LensFileError(f"has no configuration {configuration}; {there}", Place(str(path)))
    _refuse_no_wavelengths(lens, path)
    varied = [Varied(str(operand), tuple(operand.values())) for operand in lens.operands if operand.name != "MOFF"]
    optimization_data = OptimizationData() if lens.optimization_data is None else lens.optimization_data
    report = dataclasses.replace(
        report,
        surfaces=len(lens.surfaces),
        stop_surface=lens.stop,
        primary_wavelength=lens.primary_wavelength,
        wavelengths=tuple(lens.wavelengths.tolist()),
        ray_aiming=lens.ray_aiming,
        configurations=tuple(varied),
        **{name: tuple(map(str, getattr(optimization_data, name))) for name in ("variables", "solves", "kept")},
        operands=operand_uses(optimization_data.merit, evaluated),
        tolerances=len(optimization_data.tolerances),
    )
    return lens, report


def check(
    path: str | os.PathLike,
    *,
    catalogs: Sequence[str | Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    substitute: Substitute = None,
    evaluated: Collection[str] | None = None,
) -> ImportReport:
    """What was read from a lens file, what was not, and where each glass came from.

    strict: raise where something was assumed. configuration: which one has to be such that it can be traced. evaluated:
    as for `read_lens_with_report`. Raises as `read_lens`, and LensFileError for what cannot be traced.
    """
    return checked(path, catalogs, strict, configuration, substitute, evaluated)[1]


def checked(
    path, catalogs, strict: bool, configuration: int | None, substitute: Substitute, evaluated
) -> tuple[Lens, ImportReport]:
    """The lens of `check` and the report."""
    options = {"catalogs": catalogs, "strict": strict, "configuration": configuration, "substitute": substitute}
    lens, report = read_lens_with_report(path, **options, evaluated=evaluated)
    try:
        check_lens(lens)
    except ValueError as error:
        raise LensFileError(str(error), Place(str(path))) from error
    check_media(lens, lens.wavelengths, where=str(path))
    return lens, report


@value
class Conversion(Result):
    """A lens file written in another format."""

    source: str
    target: str
    surfaces: int

    def document(self) -> dict:
        return {"input": self.source, "output": self.target, "surfaces": self.surfaces}

    def __str__(self) -> str:
        return f"{self.target}: {self.surfaces} surfaces from {self.source}"


def convert(
    source: str | os.PathLike,
    target: str | os.PathLike,
    *,
    catalogs: Sequence[str | Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    substitute: Substitute = None,
) -> Conversion:
    """Read a lens file and write it in the format of the suffix of `target`; as `read_lens` and `write_lens`."""
    how = {"catalogs": catalogs, "strict": strict, "configuration": configuration, "substitute": substitute}
    lens, report = read_lens_with_report(source, **how)
    for warning in report.warnings:
        warnings.warn(warning, LensFileWarning, stacklevel=calling_level())
    write_lens(lens, target, catalogs=catalogs)
    return Conversion(report.file, str(target), len(lens.surfaces))


def shipped_lens(name: str | os.PathLike) -> Path | None:
    """The file of a lens that travels with the package, with or without its folder and .zmx; None if there is none."""
    path, folder = Path(name), shipped("lenses")
    if not path.name or path.parent not in (Path(), Path("lenses"), Path("lenses/examples")):
        return None
    candidates = [folder / part / file for part in ("", "examples") for file in (path.name, f"{path.name}.zmx")]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def write_lens(lens: Lens, path: str | os.PathLike, *, catalogs: Sequence[str | Path] = ()) -> None:
    """Write a lens in the format of the suffix. The file is replaced as a whole or not at all.

    catalogs: the glass catalogs (.agf) that the lens was read with. Raises LensFileError for what the format cannot
    hold, for what would not be read again, and where the file cannot be written. Warns LensFileWarning of a text that
    a .zmx file does not bring back, such as blanks around it.
    """
    path = Path(path)
    _refuse_no_wavelengths(lens, path)
    form = _format(path, WRITTEN)
    content = form.write(lens, str(path), catalogs=tuple(catalogs))
    changed = _changed_texts(lens, content, form, path, tuple(catalogs))
    if changed:
        message = f"{path}: {', '.join(changed)}: not brought back as it is by a {path.suffix} file"
        warnings.warn(message, LensFileWarning, stacklevel=calling_level())
    try:
        write_atomically(path, lambda file: file.write(content))
    except OSError as error:
        raise LensFileError(error.strerror or str(error), Place(str(path))) from error


def _refuse_no_wavelengths(lens: Lens, path: Path) -> None:
    """Raises LensFileError for what is not above 0; the unit of a file is believed."""
    try:
        check_unit(lens.wavelengths, believed=lens.wavelengths)
    except ValueError as error:
        raise LensFileError(str(error), Place(str(path))) from error


def _changed_texts(lens: Lens, content: bytes, form: Format, path: Path, catalogs: tuple) -> list[str]:
    """The texts of a lens that the content of its file does not bring back. Raises LensFileError if it is not read."""
    try:
        again, _ = form.read(decode(content, Place(str(path))), str(path), catalogs=catalogs)
    except UnknownGlass:  # of a catalog that is not at hand
        return []
    except LensFileError as error:
        found = str(error).removeprefix(f"{Place(error.file, error.line, error.surface)}: ")
        message = f"the file would not be read again: {found}"
        raise LensFileError(message, Place(str(path), None, error.surface)) from error
    pairs = [("the title", lens.name, again.name), ("a note", lens.notes, again.notes)]
    lost = [name for name in lens.catalogs if name not in again.catalogs]
    pairs += [(f"the catalog {name}", name, "") for name in lost]
    comments = zip(lens.surfaces, again.surfaces, strict=True)
    pairs += [(f"the comment of surface {k}", a.comment, b.comment) for k, (a, b) in enumerate(comments)]
    if count(lens.operands) != count(again.operands):
        pairs.append((f"the other configurations, {count(lens.operands)} in all", lens.current_configuration, 0))
    else:
        pairs += [(str(a), a.values(), b.values()) for a, b in zip(lens.operands, again.operands, strict=False)]
    if unbound := _unbound(lens.optimization_data, again.optimization_data):
        pairs.append(("bounds of variables, of which it holds those of thicknesses alone", ", ".join(unbound), ""))
        again = dataclasses.replace(
            again,
            optimization_data=dataclasses.replace(again.optimization_data, variables=lens.optimization_data.variables),
        )
    if _asks(lens.optimization_data) and again.optimization_data != lens.optimization_data:
        pairs.append(("what is to be optimised", f"{len(lens.optimization_data.merit)} rows of a merit function", ""))
    return [f"{what} ({shown(str(before))})" for what, before, after in pairs if before != after]


def _asks(optimization_data: OptimizationData | None) -> bool:
    """Whether optimisation data says more than which semi-diameters are given."""
    return optimization_data is not None and any(
        (
            optimization_data.variables,
            optimization_data.solves,
            optimization_data.merit,
            optimization_data.tolerances,
            optimization_data.kept,
        )
    )


def _format(path: Path, known: Sequence[str] = tuple(FORMATS)) -> Format:
    suffix = path.suffix.lower()
    if suffix not in known:
        found = f"the suffix {path.suffix!r} names no format" if suffix else "has no suffix to name its format"
        found = f"a {suffix} file is read, but not written" if suffix in FORMATS else f"{found} of lens files"
        raise LensFileError(f"{found}; expected one of {', '.join(known)}", Place(str(path)))
    return FORMATS[suffix]


def _unbound(optimization_data: OptimizationData | None, again: OptimizationData | None) -> list[str]:
    """Variables whose bounds are not those that they were written with, where nothing else of them is another."""
    if optimization_data is None or again is None:
        return []
    free = [[dataclasses.replace(one, bounds=()) for one in told.variables] for told in (optimization_data, again)]
    pairs = zip(optimization_data.variables, again.variables, strict=False)
    bare = [f"{a.quantity} of surface {a.surface}" for a, b in pairs if a.bounds and not b.bounds]
    return bare if free[0] == free[1] else []
