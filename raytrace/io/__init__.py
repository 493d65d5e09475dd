"""Lens files: the suffix of a file selects its format; reading gives a Lens, writing brings every number back exactly.

source            text, numbers, records, errors with file, line and surface; the report of every keyword
assembly          glasses by name; a neutral draft of a lens, checked once for all readers
melts             glasses with index errors as a catalog beside a lens file
zemax/            .zmx and .zar of OpticStudio
codev/            .seq of CODE V
oslo              .len of OSLO, read
ray_optics        .roa of ray-optics, read
table/            prescription tables; `frames`: those of pandas
ray_tables        rays of a CSV file
pictures          image files

To add a format: a row of `FORMATS` and a module with a reader: text -> records with places -> LensDraft -> `assemble`.
To add a keyword or a surface type: a row of its format's tables, as the docstring of its folder says.

Tests: `tests/test_formats.py` for all formats; `tests/test_zemax*.py`, `tests/test_codev.py`, `tests/test_oslo.py`,
`tests/test_ray_optics.py`, `tests/test_table*.py`; `tests/test_input_limits.py` (rays), `tests/test_pictures.py`; real
files in `tests/test_corpus*.py`.
"""

import dataclasses
import os
import tempfile
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from raytrace import namespace
from raytrace.files import shipped, write_atomically
from raytrace.io import oslo, ray_optics
from raytrace.io.assembly import TILTED_OBJECT, changes
from raytrace.io.codev import read as codev_read
from raytrace.io.codev import write as codev_write
from raytrace.io.melts import check_catalog, with_melts
from raytrace.io.source import (
    NONE,
    Draft,
    Place,
    Substitutes,
    Varied,
    decode,
    operand_uses,
    read_content,
    read_text,
    substitutes_of,
)
from raytrace.io.source import BadSubstitute as BadSubstitute
from raytrace.io.source import ImportReport as ImportReport
from raytrace.io.source import LensFileError as LensFileError
from raytrace.io.source import LensFileWarning as LensFileWarning
from raytrace.io.source import UnsupportedSurface as UnsupportedSurface
from raytrace.io.table import read as table_read
from raytrace.io.table import write as table_write
from raytrace.io.zemax import archive as zemax_archive
from raytrace.io.zemax import read as zemax_read
from raytrace.io.zemax import write as zemax_write
from raytrace.materials.agf import write_agf
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import check_unit
from raytrace.maths.numerics import value
from raytrace.maths.result import Result
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData
from raytrace.system.surface import is_posed
from raytrace.words import calling_level, did_you_mean, named_value

#: Substitutes for glasses of a file: {"SSK4": "SSK4A"}, words like "SSK4=SSK4A", "nearest" for every unknown glass.
Substitute = Mapping[str, str] | str | Sequence[str] | None


class Format(NamedTuple):
    """A format of lens files.

    name: in the report; parse: (content, file, report, catalogs) -> Lens; write: (lens, file, catalogs) -> content,
    None for a format that is only read; load: path -> content, text or bytes; configurations: whether a file may hold
    several, of which `parse` takes the number; catalogs: whether a file names the catalogs of its glasses, so that
    glasses with index errors may be those of a catalog beside it.
    """

    name: str
    parse: Callable[..., Lens]
    write: Callable[..., bytes] | None = None
    load: Callable[[Path], str | bytes] = read_text
    configurations: bool = False
    catalogs: bool = False

    def read(
        self,
        content: str | bytes,
        file: str,
        *,
        catalogs: Sequence[str | Path] = (),
        strict: bool = False,
        substitutes: Substitutes = NONE,
        **options: int | None,
    ) -> tuple[Lens, ImportReport]:
        """The lens of a content and the report of its import.

        file: its name, for messages and for the catalogs in its folder. catalogs: further glass catalogs (.agf).
        strict: every warning is an error. Raises LensFileError, UnsupportedSurface and UnknownGlass.
        """
        report = Draft(file, self.name, substitutes)
        lens = self.parse(content, file, report, tuple(catalogs), **options)
        return lens, report.finished(strict=strict)


_TEXT_TABLE = Format("table", table_read.read, partial(table_write.write, separator="\t"), catalogs=True)

#: The formats by suffix, in lower case.
FORMATS = {
    ".zmx": Format("zmx", zemax_read.read, zemax_write.write, configurations=True, catalogs=True),
    ".zar": Format("zar", zemax_archive.read, load=zemax_archive.load, configurations=True),
    ".seq": Format("seq", codev_read.read, codev_write.write),
    ".len": Format("len", oslo.read, load=oslo.load),
    ".roa": Format("roa", ray_optics.read, load=read_content),
    ".csv": Format("table", table_read.read, table_write.write, catalogs=True),
    ".tsv": _TEXT_TABLE,
    ".txt": _TEXT_TABLE,
}

#: The suffixes of formats that are written too.
WRITTEN = tuple(suffix for suffix, form in FORMATS.items() if form.write)

#: The folder of the lenses that come with the package.
_LENSES = shipped("lenses")


# -- reading ----------------------------------------------------------------------------------------------------------


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

    path: of a file, or the name of a shipped lens, as "double_gauss". catalogs: further glass catalogs, .agf files or
    names of shipped ones, as ["SCHOTT"], searched as `raytrace.materials.catalogs.find_glass` does; a catalog that the
    file names is found in its folder, or in it.
    strict: raise where the file holds an unknown keyword or an assumption is needed, instead of one LensFileWarning.
    configuration: of a multi-configuration file, from 1; by default the one that was active when it was saved.
    `lens.configurations` are all of them. substitute: glasses in place of those of the file, each reported in a
    warning: {"SSK4": "SSK4A"}, or "nearest" for every unknown glass, by the nd and Vd of the file (`io.source`).
    Raises LensFileError, its subclass UnsupportedSurface, and UnknownGlass, each naming file, line and surface; and
    BadSubstitute.
    """
    lens, report = read_lens_with_report(
        path, catalogs=catalogs, strict=strict, configuration=configuration, substitute=substitute
    )
    if report.warnings:
        warnings.warn("; ".join(report.warnings), LensFileWarning, stacklevel=calling_level())
    return lens


def as_lens(lens: Lens | str | os.PathLike, verb: str) -> Lens:
    """A lens unchanged, or that of a path or of a shipped name. Raises TypeError, naming the function, for others."""
    if isinstance(lens, Lens):
        return lens
    if isinstance(lens, (str, os.PathLike)):
        return read_lens(lens)
    hint = "; it has one, as its `lens`" if isinstance(getattr(lens, "lens", None), Lens) else ""
    expected = "a Lens, the path of a lens file or the name of a shipped lens"
    raise TypeError(f"{verb}: `lens` is {named_value(lens)}; expected {expected}{hint}")


def read_lens_with_report(
    path: str | os.PathLike,
    *,
    catalogs: Sequence[str | Path] = (),
    strict: bool = False,
    configuration: int | None = None,
    substitute: Substitute = None,
    evaluated: Collection[str] | None = None,
) -> tuple[Lens, ImportReport]:
    """As `read_lens`, with the report of every keyword; its warnings are in it, and not issued.

    evaluated: the names of merit operands that are evaluated, as distinct from those that are only known.
    """
    path = Path(path)
    if not path.exists():
        path = shipped_lens(path) or _refuse_missing(path)
    form, file = _format(path), str(path)
    options = {"configuration": configuration} if form.configurations else {}
    substitutes = substitutes_of(substitute)
    lens, report = form.read(
        form.load(path), file, catalogs=catalogs, strict=strict, substitutes=substitutes, **options
    )
    if configuration is not None and configuration != lens.current_configuration:
        message = f"has no configuration {configuration}; a file of this format holds one"
        raise LensFileError(message, Place(file))
    varied = [Varied(str(operand), tuple(operand.values())) for operand in lens.operands if operand.name != "MOFF"]
    data = OptimizationData() if lens.optimization_data is None else lens.optimization_data
    report = dataclasses.replace(
        report,
        surfaces=len(lens.surfaces),
        stop_surface=lens.stop,
        primary_wavelength=lens.primary_wavelength,
        wavelengths=tuple(lens.wavelengths.tolist()),
        ray_aiming=lens.ray_aiming,
        configurations=tuple(varied),
        variables=tuple(map(str, data.variables)),
        solves=tuple(map(str, data.solves)),
        kept=tuple(map(str, data.kept)),
        operands=operand_uses(data.merit, evaluated),
        tolerances=len(data.tolerances),
    )
    return lens, report


def shipped_lens(name: str | os.PathLike) -> Path | None:
    """The file of a shipped lens, with or without its folder and .zmx; None if there is none."""
    path = Path(name)
    if not path.name or path.parent not in (Path(), Path("lenses"), Path("lenses/examples")):
        return None
    candidates = [_LENSES / part / file for part in ("", "examples") for file in (path.name, f"{path.name}.zmx")]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _refuse_missing(path: Path) -> Path:
    """The path of a file that is not there, whose reader refuses it. Raises LensFileError for a name alone."""
    names = [file.stem for part in ("", "examples") for file in sorted((_LENSES / part).glob("*.zmx"))]
    meant = did_you_mean(path.stem, names)
    if path.parent != Path() or path.suffix not in ("", ".zmx") or (path.suffix and not meant):
        return path
    message = f"no such file or shipped lens; the shipped lenses are {', '.join(names)}{meant}"
    raise LensFileError(message, Place(str(path)))


def _format(path: Path, known: Sequence[str] = tuple(FORMATS)) -> Format:
    suffix = path.suffix.lower()
    if suffix not in known:
        message = f"the suffix {path.suffix!r} is that of no format" if suffix else "has no suffix to select its format"
        message = f"a {suffix} file is read, but not written" if suffix in FORMATS else f"{message} of lens files"
        raise LensFileError(f"{message}; expected one of {', '.join(known)}", Place(str(path)))
    return FORMATS[suffix]


# -- conversion -------------------------------------------------------------------------------------------------------


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
    lens, report = read_lens_with_report(
        source, catalogs=catalogs, strict=strict, configuration=configuration, substitute=substitute
    )
    for warning in report.warnings:
        warnings.warn(warning, LensFileWarning, stacklevel=calling_level())
    write_lens(lens, target, catalogs=catalogs)
    return Conversion(report.file, str(target), len(lens.surfaces))


# -- writing ----------------------------------------------------------------------------------------------------------


def write_lens(lens: Lens, path: str | os.PathLike, *, catalogs: Sequence[str | Path] = ()) -> None:
    """Write a lens in the format of the suffix. The file is replaced as a whole or not at all.

    Glasses with index errors are written as melts into a glass catalog beside a .zmx file or a table, as
    worst-melts.agf of worst.zmx, which readers find there (`io.melts`). Semi-diameters are written as the lens
    stores them, and by the rays where it stores none; `Lens.with_semi_diameters` stores all automatic ones anew.
    catalogs: the glass catalogs (.agf) that the lens was read with. Raises LensFileError for a lens that the format
    cannot hold or that could not be read again, and where the file cannot be written. Warns LensFileWarning of texts
    and other data that the file does not bring back.
    """
    path, place = Path(path), Place(str(path))
    try:
        check_unit(lens.wavelengths, believed=lens.wavelengths)  # refuses wavelengths that are not above 0
    except ValueError as error:
        raise LensFileError(str(error), place) from error
    form = _format(path, WRITTEN)
    if is_posed(lens.surfaces[0]):
        raise LensFileError(TILTED_OBJECT, place._replace(surface=0))
    lens = lens.with_missing_semi_diameters()
    plain, melts = with_melts(lens, path) if form.catalogs else (lens, None)
    with tempfile.TemporaryDirectory() as folder:
        if melts is not None:  # where readers look for it
            beside = Path(folder) / f"{melts.name}.agf"
            write_agf(melts, beside)
            catalogs = (beside, *catalogs)
        content = _checked(form, plain, path, catalogs)
    try:
        if melts is not None:
            beside = path.with_name(f"{melts.name.lower()}.agf")
            check_catalog(beside, place)
            write_agf(melts, beside)  # first, so that no reader of the lens misses its glasses
        write_atomically(path, lambda file: file.write(content))
    except OSError as error:
        raise LensFileError(error.strerror or str(error), place) from error


def _checked(form: Format, lens: Lens, path: Path, catalogs: Sequence[str | Path]) -> bytes:
    """The content of the file of a lens, after it was read again; as `write_lens`."""
    place = Place(str(path))
    assert form.write is not None, "one of the formats WRITTEN"
    content = form.write(lens, str(path), catalogs=tuple(catalogs))
    try:
        again, _ = form.read(decode(content, place), str(path), catalogs=catalogs)
        changed = changes(lens, again)
    except UnknownGlass:  # of a catalog that is unavailable
        changed = []
    except LensFileError as error:
        reason = str(error).removeprefix(f"{Place(error.file, error.line, error.surface)}: ")
        message = f"the file would not be read again: {reason}"
        raise LensFileError(message, place._replace(surface=error.surface)) from error
    if changed:
        message = f"{path}: {', '.join(changed)}: not preserved by a {path.suffix} file"
        warnings.warn(message, LensFileWarning, stacklevel=calling_level())
    return content


__getattr__, __dir__ = namespace(__name__)
