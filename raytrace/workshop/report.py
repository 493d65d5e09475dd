"""Report of a lens: prescription, first-order data, figures and tables of its analyses, conditions and tolerances, as
one document for a reader (.pdf, .html).

A section is a row of KINDS_OF_SECTIONS. Its numbers and figures are the results of the public functions.
"""

import contextlib
import dataclasses
import datetime
import functools
import re
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from raytrace.analysis.chief import distortion, field_curvature, lateral_colour
from raytrace.analysis.chromatic import chromatic_focal_shift
from raytrace.analysis.encircled import encircled_energy
from raytrace.analysis.fans import opd_fan, ray_fan
from raytrace.analysis.illumination import relative_illumination
from raytrace.analysis.layout import ALL, layout
from raytrace.analysis.longitudinal import longitudinal_aberration
from raytrace.analysis.mtf import mtf
from raytrace.analysis.panels import first_order_text
from raytrace.analysis.seidel import seidel
from raytrace.analysis.setting import Numbers, Points
from raytrace.analysis.spot_diagram import spot
from raytrace.analysis.thermal import thermal
from raytrace.analysis.wavefronts import wavefront
from raytrace.files import write_atomically
from raytrace.maths.numerics import detached, value
from raytrace.maths.result import Column, Result, plain
from raytrace.optimization.attained import attained_by, columns_of
from raytrace.optimization.evaluate import MeritResult, evaluate
from raytrace.plotting.style import Figure
from raytrace.settings import ON_REQUEST, REPORTS, SECTIONS
from raytrace.system.lens import Lens, field_points, with_wavelengths
from raytrace.system.shapes import KINDS
from raytrace.tolerancing.analysis import tolerance as as_built
from raytrace.tracing.lens_report import Info, info
from raytrace.words import RaytraceError, RaytraceWarning, did_you_mean, option
from raytrace.workshop.document import (
    Block,
    Document,
    Heading,
    Picture,
    Section,
    grid_of,
    rows_grid,
    settled,
    tables_of,
)
from raytrace.workshop.indications import tolerances_for
from raytrace.workshop.pages import pdf
from raytrace.workshop.sheets import draw
from raytrace.workshop.web import page

#: Of the name of an analysis, the configuration that it is of.
_CONFIGURATION = re.compile(r", configuration \d+")

_SAMPLES = 6  # fields of the tables over the field
_TEMPERATURES = 5
_MOST_TERMS = 64  # of a surface that are listed


class BadReport(RaytraceError, ValueError):
    """Sections of a report that do not exist, or that leave nothing of it."""


@value
class Report(Result):
    """A report of a lens. The table lists its sections, with the reason of those that are empty.

    content: sections with their tables and figures; `save` writes .pdf or .html, and the results of all sections as
    .json.
    """

    lens: Lens
    content: Document

    COLUMNS = (Column("section", form="d"), Column("title", form="<"), Column("remark", form="<", heading=" "))

    def columns(self) -> dict[str, Tensor]:
        number = torch.arange(len(self.content.sections))
        return {"section": number + 1, "title": number, "remark": number}

    def words(self) -> dict[str, Sequence[str]]:
        return {
            "title": [section.title for section in self.content.sections],
            "remark": [section.gap for section in self.content.sections],
        }

    def document(self) -> dict:
        """The results of every section, as the commands of the analyses give them by --json."""
        sections = [
            {"name": s.name, "title": s.title, "results": list(s.documents)} | ({"remark": s.gap} if s.gap else {})
            for s in self.content.sections
        ]
        return plain({"name": self.lens.name, "date": self.content.date, "sections": sections})

    def save(self, path: str | PathLike) -> None:
        """Write .pdf, .html, or the results of all sections as .json; as a whole or not at all."""
        suffix = Path(path).suffix.lower()
        if suffix not in REPORTS:
            raise ValueError(f"{path}: expected a name that ends in {', '.join(REPORTS)}")
        if suffix == ".json":
            Result.save(self, path)
            return
        content = pdf(self.content) if suffix == ".pdf" else page(self.content).encode()
        write_atomically(path, lambda file: file.write(content))


@dataclasses.dataclass(frozen=True)
class _Request:
    """What a report is made of: the lens, its configurations, and the options of the analyses."""

    lens: Lens
    lenses: tuple[Lens, ...]
    fields: Points
    options: dict[str, Any]

    @property
    def at_fields(self) -> dict[str, Any]:
        return {} if self.fields is None else {"fields": self.fields}

    @property
    def over_field(self) -> dict[str, Any]:
        """Fields of the tables of curves over the field."""
        return self.at_fields or {"samples": _SAMPLES}


class _Writer:
    """The blocks of a section while it is written; name: of the lens, which the titles of its figures leave out."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.blocks: list[Block] = []
        self.documents: list[dict[str, Any]] = []
        self.gaps: list[str] = []

    def analysis(self, name: str, make: Callable[[], Result], *, tables: bool = True, caption: str = "") -> None:
        """A result with its figure and its tables, or the reason why there is none."""
        try:
            result = make()
            picture = Picture(settled(_without_name(result.draw(), self.name)), name, caption)
            blocks = tables_of(result) if tables else []
        except (RaytraceError, ValueError) as error:
            self.gaps.append(f"{name}: {error}")
            return
        self.blocks += [picture, *blocks]
        self.documents.append(result.document())


def _without_name(figure: Figure, name: str) -> Figure:
    """A figure whose title names its content, without the name of the lens, which heads the report."""
    title = " ".join(figure.get_suptitle().split())
    shown = title.removeprefix(" ".join(name.split())).strip()
    if name and shown and shown != title:
        figure.suptitle(shown[0].upper() + shown[1:], fontweight="bold", fontsize=10)
    return figure


# -- sections


def _first_order(request: _Request, writer: _Writer) -> None:
    infos = [info(lens) for lens in request.lenses]
    if len(infos) == 1:
        writer.blocks.append(rows_grid(("quantity", "value", "unit or definition"), infos[0].quantities(), "lrl"))
    else:
        heads = ["quantity", *(f"configuration {lens.current_configuration}" for lens in request.lenses), "unit"]
        columns = [entry.quantities() for entry in infos]
        rows = [(row[0][0], *(figure for _, figure, _ in row), row[0][2]) for row in zip(*columns, strict=True)]
        writer.blocks.append(rows_grid(heads, rows, "l" + "r" * len(infos) + "l"))
    for lens, entry in zip(request.lenses, infos, strict=True):
        if rows := entry.base_ray_quantities():
            writer.blocks.append(Heading("About the axial chief ray" + _of(request, lens)))
            writer.blocks.append(rows_grid(("quantity", "tangential", "sagittal", "unit"), rows, "lrrl"))
    writer.blocks.append(Heading("Wavelengths and fields"))
    scenes = [entry.scene() for entry in infos]
    listed = zip(*scenes, strict=True) if len(set(map(len, scenes))) == 1 else ()
    for pairs in listed or zip(scenes[0], strict=True):
        texts = [*dict.fromkeys(text for _, text in pairs)]
        if pairs[0][0] == "configuration":
            continue
        if len(texts) == 1:
            writer.blocks.append(f"{pairs[0][0].capitalize()}: {texts[0]}")
        else:
            writer.blocks += [
                f"{pairs[0][0].capitalize()}{_of(request, lens)}: {text}"
                for lens, (_, text) in zip(request.lenses, pairs, strict=True)
            ]
    writer.documents += [entry.document() for entry in infos]


def _prescription(request: _Request, writer: _Writer) -> None:
    first = Info(request.lenses[0])
    writer.blocks.append(grid_of(first.tables()[0].columns, first))
    if rows := _coefficients(first.lens):
        writer.blocks.append(Heading("Coefficients of surfaces"))
        writer.blocks.append(rows_grid(("surface", "term", "value"), rows, "rlr"))
    operands = [operand for operand in request.lens.operands if operand.values()]
    if operands and len(request.lenses) > 1:
        writer.blocks.append(Heading("Numbers that differ between configurations"))
        heads = ["operand", *(f"configuration {lens.current_configuration}" for lens in request.lenses)]
        differing = [(str(operand), *(_cell(entry) for entry in operand.values())) for operand in operands]
        writer.blocks.append(rows_grid(heads, differing, "l" + "r" * len(request.lenses)))
        writer.blocks.append(
            f"The table of surfaces is that of configuration {request.lenses[0].current_configuration}."
        )
    writer.blocks += [note for note in request.lens.notes if note.strip()]


def _cell(entry: object) -> str:
    return f"{entry:.8g}" if isinstance(entry, float) else str(entry)


def _coefficients(lens: Lens) -> list[tuple[str, str, str]]:
    """Surface, term and value of the coefficients of sags, sag terms and phases."""
    rows = []
    for k, surface in enumerate(lens.surfaces):
        if surface.coefficients is not None:
            kind = KINDS[surface.kind]
            rows += [(str(k), kind.name_of(n), f"{a:.10g}") for n, a in enumerate(surface.coefficients.tolist()) if a]
        for part in (surface.sag_terms, surface.phase):
            for field in dataclasses.fields(part) if part is not None else ():
                numbers = getattr(part, field.name)
                if isinstance(numbers, Tensor) and 0 < numbers.numel() <= _MOST_TERMS:
                    name = field.name.replace("_", " ")
                    flat = numbers.flatten().tolist()
                    several = len(flat) > 1
                    rows += [
                        (str(k), f"{name} {n}" if several else name, f"{a:.10g}") for n, a in enumerate(flat, 1) if a
                    ]
    return rows


def _of(request: _Request, lens: Lens) -> str:
    return f", configuration {lens.current_configuration}" if len(request.lenses) > 1 else ""


def _layout(request: _Request, writer: _Writer) -> None:
    several = len(request.lenses) > 1
    if several:
        whole = request.lens
        name = "All configurations"
        writer.analysis(name, lambda: layout(whole, configuration=ALL, **request.at_fields), tables=False, caption=name)
    for lens in request.lenses:
        name = f"Configuration {lens.current_configuration}" if several else "Layout"
        caption = name if several else ""
        writer.analysis(name, functools.partial(layout, lens, **request.at_fields), tables=False, caption=caption)


def _each(
    *analyses: tuple[str, Callable[[Lens, _Request], Result]], tables: bool = True
) -> Callable[[_Request, _Writer], None]:
    """The section of analyses of every configuration."""

    def write(request: _Request, writer: _Writer) -> None:
        for lens in request.lenses:
            start = len(writer.blocks)
            for name, make in analyses:
                writer.analysis(name + _of(request, lens), functools.partial(make, lens, request), tables=tables)
            if len(request.lenses) > 1 and len(writer.blocks) > start:
                writer.blocks.insert(start, Heading(f"Configuration {lens.current_configuration}"))

    return write


def _conditions(request: _Request, writer: _Writer) -> None:
    lens = request.lens
    try:
        if attained := attained_by(lens):
            writer.blocks.append(grid_of(columns_of(attained)))
            writer.documents.append({"conditions": [row.document() for row in attained]})
        off = [str(condition) for condition in lens.conditions if not condition.on]
        writer.blocks += [f"Switched off: {line}" for line in off]
    except ValueError as error:
        writer.gaps.append(f"conditions: {error}")
    data = lens.optimization_data
    if data is not None and any(row.weight > 0 for row in data.merit):
        writer.blocks.append(Heading("Merit function"))
        writer.analysis("Merit function", lambda: _without_conditions(evaluate(lens)))  # which are listed above
    if not writer.blocks and not writer.gaps:
        writer.gaps.append(
            "The lens stores no conditions and no merit function; `raytrace optimize --hold` adds conditions."
        )


def _without_conditions(result: Result) -> Result:
    return dataclasses.replace(result, conditions=()) if isinstance(result, MeritResult) else result


def _tolerances(request: _Request, writer: _Writer) -> None:
    options = {name: request.options[name] for name in ("grade", "limits", "radial")}
    grade, table = options["grade"], tolerances_for(request.lens, **options)
    if not len(table):
        raise BadReport(f"The lens stores no tolerances; {option('grade')} adds those of a published grade.")
    if grade:
        writer.blocks.append(f"Tolerances of the grade {grade}.")
    writer.blocks += tables_of(table, most=len(table))
    writer.documents.append(table.document())


def _as_built(request: _Request, writer: _Writer) -> None:
    names = ("grade", "limits", "radial", "criterion", "trials", "seed", "progress")
    options = {name: request.options[name] for name in names}
    writer.analysis("The lens as built", lambda: as_built(request.lens, **options, **request.at_fields))


def _temperature(request: _Request, writer: _Writer) -> None:
    options = {name: request.options[name] for name in ("temperatures", "mount")}
    for lens in request.lenses:
        name = "Over temperature" + _of(request, lens)
        writer.analysis(name, functools.partial(thermal, lens, samples=_TEMPERATURES, **options, **request.at_fields))


def _drawings(request: _Request, writer: _Writer) -> None:
    lens = request.lens
    sheets = draw(
        lens,
        elements=(),
        grade=request.options["grade"],
        limits=request.options["limits"],
        radial=request.options["radial"],
        date=request.options["date"],
    )
    writer.blocks += [Picture(paper.figure(), paper.title) for paper in sheets.sheets()]
    writer.documents.append(sheets.document())


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of section: its title, and the function that writes it."""

    title: str
    write: Callable[[_Request, _Writer], None]


#: Kinds of sections by their names.
KINDS_OF_SECTIONS: dict[str, Kind] = {
    "first-order": Kind("First-order data", _first_order),
    "prescription": Kind("Prescription", _prescription),
    "layout": Kind("Layout", _layout),
    "spots": Kind("Spots", _each(("Spot diagram", lambda lens, r: spot(lens, **r.at_fields)))),
    "fans": Kind("Ray and OPD fans", _each(
        ("Ray fans", lambda lens, r: ray_fan(lens, **r.at_fields)),
        ("OPD fans", lambda lens, r: opd_fan(lens, **r.at_fields)), tables=False,
    )),
    "wavefront": Kind("Wavefront", _each(("Wavefront", lambda lens, r: wavefront(lens, **r.at_fields)))),
    "mtf": Kind("Modulation transfer function", _each(("MTF", lambda lens, r: mtf(lens, **r.at_fields)))),
    "encircled-energy": Kind("Encircled energy", _each(
        ("Encircled energy", lambda lens, r: encircled_energy(lens, **r.at_fields)))),
    "field-curves": Kind("Field curvature and colour", _each(
        ("Field curvature", lambda lens, r: field_curvature(lens, **r.over_field)),
        ("Longitudinal aberration", lambda lens, r: longitudinal_aberration(lens)),
        ("Lateral colour", lambda lens, r: lateral_colour(lens, **r.over_field)),
        ("Chromatic focal shift", lambda lens, r: chromatic_focal_shift(lens)), tables=False,
    )),
    "distortion": Kind("Distortion", _each(("Distortion", lambda lens, r: distortion(lens, **r.over_field)))),
    "illumination": Kind("Relative illumination", _each(
        ("Relative illumination", lambda lens, r: relative_illumination(lens, **r.over_field)))),
    "seidel": Kind("Seidel aberrations", _each(("Seidel aberrations", lambda lens, r: seidel(lens, **r.at_fields)))),
    "conditions": Kind("Conditions and merit function", _conditions),
    "tolerances": Kind("Tolerances", _tolerances),
    "as-built": Kind("The lens as built", _as_built),
    "temperature": Kind("Temperature", _temperature),
    "drawings": Kind("Drawings", _drawings),
}  # fmt: skip


def report(
    lens: Lens,
    path: str | PathLike | None = None,
    *,
    only: Sequence[str] = (),
    without: Sequence[str] = (),
    also: Sequence[str] = (),
    fields: Points = None,
    wavelengths: Numbers = None,
    configuration: int | str = "all",
    grade: Literal["commercial", "precision", "high"] | None = None,
    limits: str | Sequence[str] = "",
    radial: bool = False,
    tolerance: bool = False,
    criterion: str = "rms",
    trials: int = 1000,
    seed: int = 0,
    temperatures: Sequence[float] | None = None,
    mount: str | float = "aluminium",
    date: str | None = None,
    progress: Callable | None = None,
) -> Report:
    """A report of a lens, written to `path` (.pdf, .html, .json) if one is given.

    only: the names of its sections, of `raytrace.settings.SECTIONS`; without: sections that are left out; also:
    sections in addition to the usual ones. A section that does not apply to the lens gives the reason in a line.
    fields: y or (x, y), by default the lens's own; wavelengths: µm; configuration: a number from 1, or "all".
    grade, limits, radial: tolerances, as of `tolerances`, by default those of the lens; tolerance: with the lens as
    built, by `trials` perturbed lenses of `seed` and `criterion`, as of `rt.tolerance`. temperatures: lowest and
    highest, °C, of a section over temperature, by default -20 and 60 where the lens has a temperature or expansions,
    else no such section; mount: as of `thermal`. date: of the title, by default today. progress: called with (work,
    unit), returns the iterable.

    Every number is that of the public function of the section. Raises BadReport for unknown sections, ValueError for
    another suffix.
    """
    if path is not None and Path(path).suffix.lower() not in REPORTS:
        raise ValueError(f"{path}: expected a name that ends in {', '.join(REPORTS)}")
    lens = detached(lens if wavelengths is None else with_wavelengths(lens, wavelengths))
    if isinstance(configuration, int):
        lens = lens.configuration(configuration)
    elif configuration != ALL:
        raise BadReport(f"{option('configuration', configuration)}: expected a number from 1, or {ALL}")
    expands = lens.environment is not None or any(
        s.expansion is not None or s.environment is not None for s in lens.surfaces
    )
    extra = {"as-built": tolerance, "temperature": temperatures is not None or expands}
    names = _chosen(only, without, [*also, *(name for name, wanted in extra.items() if wanted)])
    lenses = tuple(map(detached, lens.configurations)) if configuration == ALL else (lens,)
    date = datetime.date.today().isoformat() if date is None else date
    options = {
        "grade": grade, "limits": limits, "radial": radial, "criterion": criterion, "trials": trials, "seed": seed,
        "date": date,
        "temperatures": (-20.0, 60.0) if temperatures is None else temperatures, "mount": mount,
        "progress": None if progress is None else lambda count, unit: progress(count, unit),
    }  # fmt: skip
    if fields is not None:
        field_points(fields, like=lens)  # refused before the first section
    request = _Request(lens, lenses, fields, options)
    told: set[str] = set()
    sections = [_section(name, request, told) for name in (names if progress is None else progress(names, "section"))]
    result = Report(lens, Document(f"{lens.name or 'Lens'}", tuple(_about(request)), tuple(sections), date))
    if path is not None:
        result.save(path)
    return result


def _chosen(only: Sequence[str], without: Sequence[str], also: Sequence[str]) -> list[str]:
    """The names of the sections, in the order of a report. Raises BadReport."""
    lists = {"only": only, "without": without, "also": also}
    lists = {name: [names] if isinstance(names, str) else names for name, names in lists.items()}
    for word, names in lists.items():
        for name in names:
            if name not in SECTIONS:
                meant = did_you_mean(name, SECTIONS)
                raise BadReport(f"{option(word, name)}: no such section{meant}; the sections are {', '.join(SECTIONS)}")
    base = lists["only"] or [name for name in SECTIONS if name not in ON_REQUEST]
    wanted = {*base, *lists["also"]} - {*lists["without"]}
    if not wanted:
        raise BadReport(f"{option('without')} leaves no section")
    return [name for name in SECTIONS if name in wanted]


def _section(name: str, request: _Request, told: set[str]) -> Section:
    """A section with its warnings; told: warnings of former sections, which are not repeated."""
    writer = _Writer(request.lens.name)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            KINDS_OF_SECTIONS[name].write(request, writer)
        except (RaytraceError, ValueError) as error:
            writer.gaps.append(str(error))
    notes = dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, RaytraceWarning))
    fresh = [note for note in notes if note not in told]
    told.update(fresh)
    gaps = _shared(writer.gaps, len(request.lenses))
    if not writer.blocks:
        return Section(name, KINDS_OF_SECTIONS[name].title, (), (), " ".join(gaps) or "Nothing to report.")
    blocks = [*writer.blocks, *gaps, *(f"Note: {note}" for note in fresh)]
    return Section(name, KINDS_OF_SECTIONS[name].title, tuple(blocks), tuple(writer.documents))


def _shared(gaps: Sequence[str], count: int) -> list[str]:
    """The reasons, each once: one that all configurations have is stated without their numbers."""
    alike = Counter(_CONFIGURATION.sub("", gap) for gap in dict.fromkeys(gaps))
    merged = (general if alike[general := _CONFIGURATION.sub("", gap)] == count else gap for gap in gaps)
    return [*dict.fromkeys(merged)]


def _about(request: _Request) -> list[str]:
    """The lines below the title."""
    lens = request.lenses[0]
    lines = []
    with contextlib.suppress(RaytraceError, ValueError):
        lines.append(first_order_text(lens).replace("  ·  ", ", "))
    several = len(request.lenses)
    lines += [f"{several} configurations"] * (several > 1)
    lines += [f"Report of {request.options['date']}"] * bool(request.options["date"])
    lines.append(
        "Lengths are in mm, wavelengths in µm and angles in degrees, unless a unit is stated. Surfaces count from the "
        "object, which is surface 0; light travels along +z."
    )
    return lines
