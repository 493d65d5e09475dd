"""The configurations of a .zmx file: its multi-configuration operands, as those of a lens.

    THIC   6   2 -2.0E+001 0 0 0 2 2 1.0E+000 0.0E+000 0

An operand gives its surface (field, wavelength), the configuration, the value, its status (1 variable, 2 pickup), and
its second argument, which is the number of the parameter for PRAM; then the numbers of a pickup from another
configuration. The value is the solved one. Its row in `surfaces.ROWS`, or that of the type of its surface, gives the
path in the lens and the power of length. A pickup of a surface is a further path. An operand without a path is
reported.

Temperature and pressure: ENVD gives those of the lens (°C, atm, and whether indices follow them; 0: those of the
catalogs). TEMP and PRES of the multi-configuration table hold for the surfaces that the operands after them name (CRVT,
THIC, GLSS), up to the next operand of the same name; the last sets the environment of the lens, as ENVD. With this rule
the stored image distance of OpticStudio's sample of an evacuated cell is reproduced to 4e-12 mm.
"""

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from raytrace.io.assembly import clear_aperture, environment_at
from raytrace.io.source import (
    IGNORED,
    READ,
    UNKNOWN,
    Block,
    Draft,
    LensFileError,
    Place,
    Record,
    by_word,
    double,
    integer,
    is_infinite,
    is_number,
    number,
    plain,
    shown,
)
from raytrace.io.zemax.optimization import STATUSES, VARIABLE, TypedSurface, path_of
from raytrace.io.zemax.surfaces import (
    AIMING,
    AIMINGS,
    FAR,
    GLASS,
    NUMBER,
    ROWS,
    SIZE,
    SWITCH,
    TEXT,
    TOLERANCES,
    Sections,
    SurfaceType,
    ValueRow,
    aperture_keywords,
    in_millimetres,
    inverse,
    is_blank,
    numbers_of,
)
from raytrace.materials import environment as environments
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.environment import REFERENCE, Environment
from raytrace.materials.glass import AIR, Glass
from raytrace.system import configurations
from raytrace.system.apertures import SHAPES
from raytrace.system.configurations import Operand, Path, ScaledPath, part, same, taken, with_part
from raytrace.system.lens import Lens, unknown_changes
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import parameter_paths
from raytrace.system.poses import Pose
from raytrace.system.sag_terms import IrregularSag
from raytrace.system.surface import Surface

#: More configurations, and more operands, than any file has.
MOST_CONFIGURATIONS, MOST_CELLS = 200, 2000

#: The operands of an environment, each with the field of `Environment` that it sets, and those that name its surfaces.
ENVIRONMENT_OPERANDS = {"TEMP": "temperature", "PRES": "pressure"}
_NAMING = ("CRVT", "THIC", "GLSS")


#: Operands that change no ray and are kept with the lens: a comment, the weight of a configuration.
KEPT = ("MOFF", "CWGT")

#: Operands that are known and left out, with the reason.
_LEFT_OUT = by_word(
    {
        "coatings refract no rays": "COTN",
        "global coordinate reference: changes no ray": "GCRS GCPR",
        "polarisation": "GPEX GPEY GPIU GPJX GPJY GPPX GPPY GQPO",
        "setting of the computation, independent of the lens": "MTFU OPDR CPCN PXAR SWCN AICN HOLD SDRW",
        "shift of the pupil for the program's own ray aiming": "PSHX PSHY PSHZ PSCX PSCY PUCN",
        "size of the part: for drawing and mounting, never clips a ray": "MCHI",
    }
)

#: Operands that are known, with the reason why a configuration in which they differ is refused.
_REFUSED = by_word(
    {
        "it is not modelled": "IGNR IGNM SATP FLTP AFOC APDF APDT APTP UDAF CAOR CBOR CROR CRSR SRTS CSP1 CSP2 PSP1 "
        "PSP2 PSP3 TSP1 TSP2 TSP3 NCOM NCOT NGLS NPAR NPOS NPRO"
    }
)


# -- cells of the table -----------------------------------------------------------------------------------------------


class Cell(NamedTuple):
    """One line of the table: an operand's value in one configuration, as text.

    row: of the table, from 1. covered: the surfaces that have a temperature or pressure of their own; None for the
    lens's. rule: the words behind the value: its status (1 variable, 2 a pickup) …
    """

    name: str
    number: int
    parameter: int
    configuration: int
    value: str
    record: Record
    row: int
    covered: tuple[int, ...] | None = None
    rule: tuple[str, ...] = ()


_CELL = re.compile(r'\s*(-?\d{1,6})\s+(-?\d{1,6})\s+("[^"]*"|\S+)(.*)', re.ASCII)


def _cells(records: Iterable[Record], count: int, report: Draft) -> list[Cell]:
    """The cells of the lines after MNUM, every line reported."""
    cells: list[Cell] = []
    row, before = 0, (("", 0, 0), 0)
    for record in records:
        match, word = _CELL.fullmatch(record.text), record.keyword
        if not match or not re.fullmatch(r"[A-Z][A-Z0-9]{3}", word):
            report.met(word[:40], IGNORED, record.place, "no multi-configuration operand")
            continue
        number, configuration, rest = int(match[1]), int(match[2]), match[4].split()
        parameter = int(rest[1]) if len(rest) > 1 and re.fullmatch(r"-?\d{1,6}", rest[1]) else 0
        if re.fullmatch(r"PAR[1-8]", word):
            parameter = int(word[3])
        elif word not in ("PRAM", "EDVA") and word in ROWS:
            parameter = 0
        key = (word, number, parameter)
        row += before[0] != key or before[1] >= configuration
        before = key, configuration
        if word in _LEFT_OUT:
            report.met(word, IGNORED, record.place, _LEFT_OUT[word])
        elif word not in ROWS and word not in KEPT and word not in _REFUSED:
            report.met(word, UNKNOWN, record.place)
        else:
            report.met(word, READ, record.place)
            if 1 <= configuration <= count:
                value = match[3].strip('"')
                cells.append(Cell(*key, configuration, value, record, row, None, tuple(rest)))
            else:
                report.warn(f"{word} of configuration {configuration}, of {count}: left out", record.place)
        if len(cells) > MOST_CELLS:
            raise LensFileError(f"more than {MOST_CELLS} multi-configuration operands", record.place)
    return cells


def _grouped(cells: Sequence[Cell], count: int, report: Draft) -> list[tuple[Cell, ...]]:
    """The cells of each row, one a configuration. A missing configuration has the value of the first.

    Operands of an environment other than the lens's have the surfaces that it covers.
    """
    groups = [[*group] for _, group in itertools.groupby(cells, key=lambda cell: cell.row)]
    operands = []
    for group in groups:
        by_number = {cell.configuration: cell for cell in group}
        missing = [str(k) for k in range(1, count + 1) if k not in by_number]
        if missing and group[0].name not in KEPT:
            listed = ", ".join(missing[:8])
            message = f"{group[0].name} {group[0].number} has no value for configuration {listed}; the first is taken"
            report.warn(message, group[0].record.place)
        operands.append(tuple(by_number.get(k, group[0]) for k in range(1, count + 1)))
    for name in ENVIRONMENT_OPERANDS:
        starts = [k for k, operand in enumerate(operands) if operand[0].name == name]
        for start, end in itertools.pairwise(starts):
            between = (operand[0] for operand in operands[start + 1 : end])
            covered = tuple(dict.fromkeys(cell.number for cell in between if cell.name in _NAMING))
            operands[start] = tuple(cell._replace(covered=covered) for cell in operands[start])
    return operands


# -- reading ----------------------------------------------------------------------------------------------------------


class LensFile(NamedTuple):
    """A file with its lens as stored: its surfaces with types and numbers, their rules, and the medium of a record."""

    sections: Sections
    lens: Lens
    millimetres: float
    surfaces: Sequence[TypedSurface]
    rules: Sequence[Vary | Solve]
    medium: Callable[[Record], Glass]


class PlacedOperand(NamedTuple):
    """An operand with the lines it comes from, and a lens in which all of its paths are modelled."""

    operand: Operand
    cells: tuple[Cell, ...]
    like: Lens


def read(file: LensFile, report: Draft, configuration: int | None) -> tuple[Lens, list[Vary | Solve]]:
    """The lens with its operands, in the stored or the requested configuration; variables and pickups of operands."""
    sections, lens = file.sections, file.lens
    head = sections.system.last("MNUM")
    if head is None:
        return (lens if configuration is None else lens.configuration(configuration)), []
    count = head.integer(0, "number of configurations", 1)
    if not 1 <= count <= MOST_CONFIGURATIONS:
        raise LensFileError(f"MNUM is {count}, expected 1 to {MOST_CONFIGURATIONS} configurations", head.place)
    behind = sections.tail[sum((record.place.line or 0) <= (head.place.line or 0) for record in sections.tail) :]
    tail = [record for record in behind if record.keyword not in TOLERANCES]
    groups = _grouped(_cells(tail, count, report), count, report)
    stated = head.integer(1, "active configuration", 0) if count > 1 else 1
    is_stated = 1 <= stated <= count
    covering = [group[(stated if is_stated else 1) - 1] for group in groups if group[0].covered is not None]
    lens = _with_environments(lens, covering)
    file = file._replace(lens=lens)
    operands = [_placed_operand(group, file) for group in groups]
    agreeing = [k for k in range(1, count + 1) if all(_agrees(placed, lens, k) is not False for placed in operands)]
    active = stated if is_stated else agreeing[0] if agreeing else 1
    if count > 1:
        sure = stated or len(agreeing) == 1
        which = f"configuration {active} of {count}" if sure else f"one of {count} configurations (taken for {active})"
        varied = ", ".join(sorted({placed.operand.name for placed in operands})[:8]) or "nothing"
        message = f"multi-configuration file: {which} read, as stored in its surfaces; they differ in {varied}"
        if configuration is not None:
            report.note(message.replace(" read,", ","))
            report.note(f"configuration {configuration} of {count} read, as requested")
        elif active == 1 and sure:
            report.note(message)
        else:
            report.warn(message, head.place)
    for placed in operands:
        _report_operand(placed, lens, active, count, report)
    _report_solved(sections, operands, active, report)
    for placed in operands:
        for place in placed.operand.paths if placed.operand.numbers is not None else ():
            if part(lens, place.path) is None:
                lens = with_part(lens, place.path, double(0.0), like=placed.like)
    # the surfaces have more digits than the operands, where both agree
    operands = [
        p._replace(operand=taken(p.operand, lens, active - 1)) if _agrees(p, lens, active) else p for p in operands
    ]
    operands = [
        p
        for p in operands
        if p.operand.name != "MOFF" or p.operand.numbers is not None or any(map(any, p.operand.words))
    ]
    listed = tuple(placed.operand for placed in operands)
    if count > 1 and not listed:
        listed = (Operand("MOFF", words=(("",),) * count),)  # keeps the count
    lens = dataclasses.replace(lens, operands=listed, current_configuration=active)
    try:
        chosen = lens if configuration is None else lens.configuration(configuration)
    except ValueError as error:
        raise LensFileError(str(error), head.place) from error
    return chosen, list(_rules(operands, lens))


def _rules(operands: Sequence[PlacedOperand], lens: Lens) -> Iterator[Vary | Solve]:
    """The variables and pickups of the numbers of configurations, by the status in their lines."""
    indices = {placed.cells[0].row: index for index, placed in enumerate(operands)}
    for index, (operand, cells, _) in enumerate(operands):
        path = operand.paths[0].path if operand.paths else ()
        number, name = cells[0].number, ""
        if len(path) > 2 and path[0] == "surfaces" and isinstance(path[1], int):  # the quantity of that surface
            names = {place.steps: name for name, place in parameter_paths(lens.surfaces[path[1]]).items()}
            number, name = path[1], names.get(path[2:], "thickness" if path[2] == "thickness" else "")
        for k, cell in enumerate(cells, 1):
            status = int(plain(cell.rule[0])) if cell.rule and is_number(cell.rule[0]) else 0
            if not status or cell.configuration != k:
                continue
            where: dict[str, Any] = {"configuration": k, "operand": index}
            if status == VARIABLE:
                yield Vary(number, name, **where) if name else Solve(cell.number, cell.name, "variable", **where)
                continue
            numbers = [plain(word) if is_number(word) else 0.0 for word in cell.rule[3:7]]
            source, row, scale, offset = (*numbers, *(0.0, 0.0, 1.0, 0.0)[len(numbers) :])
            followed = (float(indices[int(row)]),) if row == int(row) and int(row) in indices else ()
            kind = STATUSES.get(status, f"status {status}")
            yield Solve(cell.number, name or cell.name, kind, followed, int(source), scale, offset, **where)


def _with_environments(lens: Lens, covering: Sequence[Cell]) -> Lens:
    """The lens with the environments of surfaces, which only operands give: cells of TEMP and PRES."""
    if lens.environment is None:
        return lens
    surfaces = list(lens.surfaces)
    for cell in covering:
        value = number(cell.value, cell.name, cell.record.place)
        for k in cell.covered or ():
            if 0 <= k < len(surfaces):
                air = _with_quantity(surfaces[k].environment or lens.environment, cell, value)
                surfaces[k] = dataclasses.replace(surfaces[k], environment=air)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def _with_quantity(air: Environment, cell: Cell, value: float) -> Environment:
    """An environment with the temperature or pressure of a cell. Raises LensFileError out of range."""
    changed = {ENVIRONMENT_OPERANDS[cell.name]: double(value)}
    air = dataclasses.replace(air, **changed)
    environment_at((float(air.temperature), float(air.pressure)), cell.record.place)
    return air


def _agrees(placed: PlacedOperand, lens: Lens, configuration: int) -> bool | None:
    """Whether the lens as stored holds the operand of a configuration; None where that cannot be decided.

    Operands are saved with 13 digits. A semi-diameter of 0 is automatic.
    """
    operand, k = placed.operand, configuration - 1
    if not operand.paths:
        return None
    stored = part(lens, operand.paths[0].path)
    if operand.numbers is None:
        wanted: Any = operand.media[k] if operand.media else operand.words[k][0]
        if operand.name == "SDIA":
            return None if wanted is None else stored is not None and abs(stored - wanted) <= 1e-9 * wanted
        return same(stored, wanted)
    held, number = 0.0 if stored is None else float(stored), float(operand.numbers[k])
    return held == number or abs(held - number) <= 1e-9 * abs(number)


# -- an operand, placed -----------------------------------------------------------------------------------------------


def _placed_operand(cells: tuple[Cell, ...], file: LensFile) -> PlacedOperand:
    """The operand of these cells with its paths in the lens, or the reason why it is not followed."""
    first, values = cells[0], tuple(cell.value for cell in cells)
    texts = tuple((value,) for value in values)

    def placed(like: Lens = file.lens, **fields: Any) -> PlacedOperand:
        return PlacedOperand(Operand(first.name, first.number, first.parameter, **fields), cells, like)

    unplaced = placed(words=texts)
    if all(map(is_number, values)):
        unplaced = placed(numbers=double([plain(value) for value in values]))
    if first.name in KEPT:
        return unplaced
    if first.name in _REFUSED:
        return placed(words=texts, refusal=_REFUSED[first.name])
    row, last = ROWS[first.name], len(file.lens.surfaces) - 1
    try:
        for k in (first.number,) if row.argument == "surface" else first.covered or ():
            if not 0 <= k <= last:
                raise LensFileError(f"{first.name} of surface {k}; expected one from 0 to {last}", first.record.place)
        if row.keyword == "XDAT" and _is_of_terms(first.parameter, file.surfaces[first.number].row):
            fields = [_terms(cell, file) for cell in cells]
            names = [name for name in ("coefficients", "sag_terms", "phase") if any(name in each for each in fields)]
            paths = tuple(ScaledPath(("surfaces", first.number, name)) for name in names)
            return placed(paths=paths, words=tuple(tuple(map(each.get, names)) for each in fields))
        paths, like = _paths_of_parameter(first, row, file) if not row.path else _paths(first, row, file)
        if not paths:
            return unplaced
        if row.kind == NUMBER:
            # the lens holds factor times the number of the file, of terms that are normalised by a radius
            factor, numbers = paths[0].factor, double([_number(cell, row, file) for cell in cells])
            paths = tuple(ScaledPath(path, f / factor, offset) for path, f, offset in paths)
            return placed(like, paths=paths, numbers=numbers if factor == 1 else factor * numbers)
        if any(part(file.lens, scaled.path[:-1]) is None for scaled in paths):
            raise LensFileError("the lens as stored has no such part, an aperture for example", first.record.place)
        if row.kind == GLASS:
            return placed(paths=paths, media=tuple(_medium(cell, row, file) for cell in cells))
        words = [_words(cell, row, file, paths) for cell in cells]
        varied = [j for j in range(len(paths)) if not j or any(not same(each[j], words[0][j]) for each in words)]
        return placed(
            paths=tuple(paths[j] for j in varied), words=tuple(tuple(each[j] for j in varied) for each in words)
        )
    except (LensFileError, UnknownGlass) as error:
        return placed(words=texts, refusal=str(error))


# -- paths ------------------------------------------------------------------------------------------------------------


def _paths(cell: Cell, row: ValueRow, file: LensFile) -> tuple[tuple[ScaledPath, ...], Lens]:
    """The paths of a row's value and of those that follow it, none where the lens lacks it; a lens that models them."""
    lens, k, path = file.lens, cell.number, row.path_in_lens(cell.number)
    paths, like = [path], lens
    if row.path.startswith("environment"):
        paths = _environment_paths(cell, path, lens)
    elif row.argument in ("field", "wavelength"):
        count = len(lens.fields.x if row.argument == "field" else lens.wavelengths)
        paths = paths if 1 <= k <= count else []
        if "vignetting" in path and lens.fields.vignetting is None:
            like = with_part(lens, ("fields", "vignetting"), lens.fields.x.new_zeros(5, count))
    elif row.argument == "":
        paths += [("aperture", "value")] if row.path == "stop" and lens.aperture.kind == "float_by_stop" else []
    else:
        return _paths_in_surface(cell, row, file)
    return tuple(map(ScaledPath, paths)), like


def _paths_in_surface(cell: Cell, row: ValueRow, file: LensFile) -> tuple[tuple[ScaledPath, ...], Lens]:
    """`_paths` of a value of a surface."""
    lens, k, path = file.lens, cell.number, row.path_in_lens(cell.number)
    kind = file.surfaces[k].row
    block, surface = file.sections.surfaces[k], file.lens.surfaces[k]
    is_missing = {
        "CURV": "curvature" not in kind.holds,
        "CONI": "conic" not in kind.holds,
        "GLAS": kind.is_break,
        "SCBD": kind.is_break and path[2] == "before",
        "CLAP": any(SHAPES[clear.shape].sizes is None for clear in surface.apertures),
    }
    if is_missing.get(row.keyword):
        return (), lens
    paths, like = [ScaledPath(path)], lens
    if row.kind == GLASS:
        record = block.last("GLAS")
        if row.word > 1:
            if record is None:
                raise LensFileError(f"{cell.name} of surface {k}, which has no glass", cell.record.place)
            if not is_blank(record) and record.integer(1, "flag", 0) != 1:
                return (), lens
        paths += _picked_up(paths, file)[0] if row.word == 1 else []
    elif row.keyword == "SCBD" and part(lens, path[:-1]) is None:
        side = _numbered(block, "SCBD", "1" if path[2] == "before" else "2")
        pose = Pose(tilts_first=bool(side and side.number(1, "order", 0.0)))
        like = with_part(with_part(lens, path[:-1], pose), path, double(0.0))
    elif row.keyword == "DIAM":  # followed by a floating aperture, irregular terms and the size of the stop
        apertures = block.all(*aperture_keywords())
        floats = bool(apertures) and apertures[-1].keyword == "FLAP"
        paths += [ScaledPath((*path[:2], "apertures", 0, "extent", 1))] if floats else []
        irregular = isinstance(surface.sag_terms, IrregularSag)
        paths += [ScaledPath((*path[:2], "sag_terms", "radius"))] if irregular else []
        sized = lens.stop == k and lens.aperture.kind == "float_by_stop"
        paths += [ScaledPath(("aperture", "value"))] if sized else []
    elif row.keyword in ("DISZ", "CURV"):
        paths += _picked_up(paths, file)[0]
    return tuple(paths), like


def _paths_of_parameter(cell: Cell, row: ValueRow, file: LensFile) -> tuple[tuple[ScaledPath, ...], Lens]:
    """The paths of PARM or XDAT by the row of the surface's type, with its pickups; and a lens that models them."""
    k, j, lens = cell.number, cell.parameter, file.lens
    kind, numbers = file.surfaces[k].row, file.surfaces[k].numbers
    if any(rule.kind == "PPAR" and rule.quantity == f"PARM {j}" and rule.numbers[:1] == (k,) for rule in _solves(file)):
        raise LensFileError(f"parameter {j} is picked up by a rule that is not followed", cell.record.place)
    factors, like = kind.places(lens.surfaces[k], numbers, row.keyword, j)
    paths = [ScaledPath(("surfaces", k, *place.steps), factor) for place, factor in factors.items()]
    picked, likes = _picked_up(paths, file) if row.keyword == "PARM" else ([], {})
    surfaces = tuple({k: like, **likes}.get(number, surface) for number, surface in enumerate(lens.surfaces))
    return (*paths, *picked), dataclasses.replace(lens, surfaces=surfaces)


def _environment_paths(cell: Cell, path: Path, lens: Lens) -> list[Path]:
    """A temperature or pressure of the surfaces that it covers, or of the lens and of surfaces that share it."""
    if lens.environment is None:
        return []
    if cell.covered is not None:
        return [("surfaces", k, *path) for k in sorted(cell.covered)]
    sharing = [
        ("surfaces", k, *path)
        for k, surface in enumerate(lens.surfaces)
        if surface.environment is not None and part(surface, path) is part(lens, path)
    ]
    return [path, *sharing]


def _solves(file: LensFile) -> list[Solve]:
    return [rule for rule in file.rules if isinstance(rule, Solve)]


def _picked_up(paths: Sequence[ScaledPath], file: LensFile) -> tuple[list[ScaledPath], dict[int, Surface]]:
    """The paths of pickups of a value, from the object on, as a pickup looks back; and surfaces that model them.

    A pickup whose stored value differs from its rule is left out: its meaning is not known.
    """
    followed, likes = {scaled.path: scaled for scaled in paths}, {}
    for solve in (rule for rule in _solves(file) if rule.kind == "pickup"):
        k = solve.surface
        if not 0 <= solve.source <= k:
            continue
        like = file.surfaces[k].modelled(solve.quantity)
        of_source = solve.quantity_of_source or solve.quantity
        inner = path_of(file.surfaces[solve.source].modelled(of_source), of_source)
        source, path = followed.get(("surfaces", solve.source, *(inner or ()))), path_of(like, solve.quantity)
        if source is None or path is None or ("surfaces", k, *path) in followed:
            continue
        stored, wanted = part(file.lens, ("surfaces", k, *path)), part(file.lens, source.path)
        if isinstance(wanted, Glass):
            agrees = same(stored, wanted)
        else:
            value, rule = float(stored or 0.0), solve.scale * float(wanted or 0.0) + solve.offset
            agrees = abs(value - rule) <= 1e-9 * abs(rule) + 1e-300
        if agrees:
            factor, offset = solve.scale * source.factor, solve.scale * source.offset + solve.offset
            followed["surfaces", k, *path], likes[k] = ScaledPath(("surfaces", k, *path), factor, offset), like
    return [*followed.values()][len(paths) :], likes


def _numbered(block: Block, keyword: str, number: str) -> Record | None:
    records = reversed(block.all(keyword))
    return next((record for record in records if record.words and record.words[0] == number), None)


# -- values -----------------------------------------------------------------------------------------------------------


def power_of(row: ValueRow, lens: Lens) -> int | None:
    """The power of length in the value of a row; that of fields and of the aperture depends on their kind."""
    is_length = lens.aperture.kind in ("entrance_pupil_diameter", "float_by_stop")
    has_none = (row.argument == "field" and lens.fields.kind == "angle") or (
        row.path == "aperture.value" and not is_length
    )
    return 0 if has_none else row.power


def _number(cell: Cell, row: ValueRow, file: LensFile) -> float:
    """The number of a cell, in powers of mm. Raises LensFileError for a value out of range."""
    text, place, label = cell.value, cell.record.place, f"{cell.name}: {row.quantity}"
    if row.keyword == "DISZ" and cell.number == 0:
        text = "INFINITY" if is_number(text) and plain(text) >= FAR else text
        if is_infinite(text) and text[0] != "-":
            return math.inf
    if is_infinite(text):
        raise LensFileError(f"{cell.name} is {shown(text)}; only the object may be at infinity", place)
    value, power = number(text, label, place), power_of(row, file.lens)
    if not row.path:
        power = file.surfaces[cell.number].row.power(row.keyword, cell.parameter)
    try:
        value = inverse(text, file.millimetres) if power is None else in_millimetres(value, power, file.millimetres)
    except OverflowError as error:
        raise LensFileError(f"{label} is {shown(text)}, too small a length", place) from error
    if not math.isfinite(value):
        raise LensFileError(f"{label} is {shown(text)}, too large once converted to mm", place)
    if row.keyword == "PARM":
        kind, numbers = file.surfaces[cell.number].row, file.surfaces[cell.number].numbers
        changed = numbers._replace(parameters={**numbers.parameters, cell.parameter: value})
        if objection := kind.objection(changed):
            raise LensFileError(objection, place)
    if row.path.startswith("environment") and file.lens.environment is not None:
        _with_quantity(file.lens.environment, cell, value)
    if row.path in ("wavelengths", "aperture.value") and value <= 0:
        raise LensFileError(f"{label} is {shown(text)}, expected a positive number", place)
    if row.path == "wavelength_weights" and value < 0:
        raise LensFileError(f"{label} is {shown(text)}, expected 0 or more", place)
    return value


def _medium(cell: Cell, row: ValueRow, file: LensFile) -> Glass:
    """The medium of a name, or of the stored model glass with another index, Abbe number or partial dispersion."""
    record = file.sections.surfaces[cell.number].last("GLAS")
    place = cell.record.place._replace(surface=cell.number)
    if row.word > 1 and record:
        words = [*record.words, *["0"] * (row.word - len(record.words))]
        words[row.word - 1] = cell.value
        return file.medium(Record("GLAS", tuple(words), "", place))
    if record and record.words and record.words[0].upper() == cell.value.upper():
        return file.lens.surfaces[cell.number].glass  # of the same name, with the indices that the file has for it
    return file.medium(Record("GLAS", (cell.value, "0", "0", "1.5", "40"), "", place)) if cell.value else AIR


def _is_of_terms(j: int, row: SurfaceType) -> bool:
    """Whether XDAT j changes every term: their number, or the radius by which coefficients are normalised."""
    return row.terms is not None and (j == 1 or (j == 2 and row.terms_are_coefficients))


def _terms(cell: Cell, file: LensFile) -> dict:
    """The fields of a surface whose terms have another number (XDAT 1), or another radius of normalisation (XDAT 2)."""
    typed, place = file.surfaces[cell.number], cell.record.place
    changed = Block(typed.block.place)
    datum = Record("XDAT", (str(cell.parameter), cell.value), "", place)
    changed.records = {**typed.block.records, "XDAT": [*typed.block.all("XDAT"), datum]}
    try:
        return typed.row.fields(numbers_of(changed, typed.row, file.millimetres))
    except ValueError as error:
        raise LensFileError(str(error), place) from error


def _words(cell: Cell, row: ValueRow, file: LensFile, paths: Sequence[ScaledPath]) -> tuple:
    """The contents of the paths of a value that is no tensor. Raises LensFileError for a value out of range."""
    lens, place, last = file.lens, cell.record.place, len(file.lens.surfaces) - 1
    if row.kind == TEXT:
        return (cell.value.strip(),)
    if row.kind != SIZE:
        whole = integer(cell.value, f"{cell.name}: {row.quantity}", place)
        if row.kind == SWITCH:
            return (bool(whole),)
        if row.kind == AIMING and 0 <= whole < len(AIMINGS):
            return (AIMINGS[whole],)
        if row.path == "primary_wavelength" and 1 <= whole <= len(lens.wavelengths):
            return (whole,)
        if row.path == "stop" and 0 < whole < last:
            if len(paths) == 1:
                return (whole,)
            if not (radius := lens.surfaces[whole].semi_diameter):
                raise LensFileError("FLOA (float by stop size), but the stop surface has no DIAM", place)
            return whole, double(radius)
        most = {"stop": f"a surface from 1 to {last - 1}", "ray_aiming": "0 (off), 1 (paraxial) or 2 (real)"}
        expected = most.get(row.path, f"1 to {len(lens.wavelengths)}, the number of wavelengths")
        raise LensFileError(f"{cell.name} is {shown(cell.value)}; expected {expected}", place)
    size = _number(cell, row, file)
    if row.keyword != "DIAM":
        *owner, _, _ = paths[0].path
        clear = with_part(part(lens, tuple(owner)), paths[0].path[len(owner) :], size)
        clear_aperture(clear.shape, clear.extent, clear.obscures, clear.centre, cell.name, place)
        return (size,)
    if size < 0 or (not size and any(isinstance(part(lens, path), Tensor) for path, *_ in paths[1:])):
        raise LensFileError(f"{cell.name} is {shown(cell.value)}, expected a semi-diameter above 0", place)
    sizes: list[Any] = [size or None]
    for path, *_ in paths[1:]:  # a floating aperture of an automatic semi-diameter keeps its own size
        sizes.append(double(size) if isinstance(part(lens, path), Tensor) else size or part(lens, path))
    return tuple(sizes)


# -- reporting --------------------------------------------------------------------------------------------------------


def _report_operand(placed: PlacedOperand, lens: Lens, active: int, count: int, report: Draft) -> None:
    """Warn of an operand that is not followed, and of one that contradicts the surfaces."""
    cell, operand = placed.cells[active - 1], placed.operand
    text = f"{plain(cell.value):g}" if is_number(cell.value) else cell.value or '""'
    place, label = cell.record.place, f"multi-configuration operand {cell.name} {cell.number} = {text}"
    if cell.name in ENVIRONMENT_OPERANDS and not operand.paths:
        normal, unit, quantity = {"PRES": (1, "atm", "pressure"), "TEMP": (20, "°C", "temperature")}[cell.name]
        if is_number(cell.value) and plain(cell.value) != normal:
            message = f"{cell.name} {text} {unit} ({quantity} of configuration {cell.configuration})"
            report.warn(f"{message}: not followed; indices are those at {normal} {unit}", place)
    elif operand.refusal:
        if count == 1 or any(other.value != cell.value for other in placed.cells):
            report.warn(f"{label} (configuration {active}): not followed: {operand.refusal}", place)
    elif not operand.paths:
        if operand.name not in KEPT:
            report.warn(f"{label}: not followed: no number of the lens depends on it", place)
    elif _agrees(placed, lens, active) is False:
        stored = part(lens, operand.paths[0].path)
        if isinstance(stored, Glass):
            value = stored.name or "air"
        elif stored is None:
            value = "0"
        else:
            value = f"{float(stored):.13g}" if isinstance(stored, Tensor | float) else repr(stored)
        report.warn(f"{label}: not followed by the lens as stored, which holds {value} (configuration {active})", place)


def _report_solved(sections: Sections, operands: Sequence[PlacedOperand], active: int, report: Draft) -> None:
    """Warn of ray solves, where operands change the rays: their result is stored for one configuration only."""

    def refracts(operand: Operand) -> bool:
        row = ROWS.get(operand.name)
        if row is None or row.keyword != "PARM":
            return row is not None and row.refracts
        kind = sections.surfaces[operand.number].last("TYPE") if operand.number < len(sections.surfaces) else None
        return bool(operand.paths) and not (kind and kind.words[:1] == ("COORDBRK",))

    solved = []
    for block in sections.surfaces:
        curvature = block.last("CURV")
        if curvature and len(curvature.words) > 1 and curvature.words[1] not in ("0", "1", "4"):
            solved.append(("CRVT", block.surface))
        if block.last("MAZH"):
            solved.append(("THIC", block.surface))
    listed = [placed.operand for placed in operands]
    set_by_operands = {(operand.name, operand.number) for operand in listed}
    left = [f"{ROWS[name].keyword} of surface {k}" for name, k in solved if (name, k) not in set_by_operands]
    varying = (operand.values() for operand in listed if refracts(operand))
    if left and any(value != values[0] for values in varying for value in values):
        message = f"solved for configuration {active}, and unchanged in the others: {', '.join(left)}"
        report.warn(message, sections.system.place_of("MNUM"))


# -- the environment, read --------------------------------------------------------------------------------------------


def environment(system: Block) -> Environment | None:
    """The environment of ENVD; None where indices do not follow it. Raises LensFileError for values out of range."""
    record = system.last("ENVD")
    if record is None or not record.integer(2, "whether indices follow the environment", 0):
        return None
    return environment_at([ROWS[name].read(record) for name in ENVIRONMENT_OPERANDS], record.place)


def report_environment(sections: Sections, lens: Lens, report: Draft) -> None:
    """Report the environment of the indices, and the glasses whose thermal data are incomplete."""
    record = sections.system.last("ENVD")
    if lens.environment is not None:
        report.note(
            f"indices are those at {environments.in_words(lens.environment)} (ENVD); radii, thicknesses as stored"
        )
        for number, message in unknown_changes(lens).items():
            glass = sections.surfaces[number].last("GLAS")
            report.warn(message, glass.place if glass else sections.surfaces[number].place)
    elif record and record.words:
        stored = record.number(0, "temperature"), record.number(1, "pressure", REFERENCE[1])
        if stored != REFERENCE:
            message = f"environment of {stored[0]:g} °C and {stored[1]:g} atm, which indices do not follow (ENVD, third"
            report.warn(f"{message} number 0): they are the catalogs'", record.place)


# -- the environment, written -----------------------------------------------------------------------------------------


def environment_line(lens: Lens, place: Place) -> str:
    """The line of ENVD."""
    if lens.environment is None:
        return "ENVD 20 1 0"
    return " ".join(["ENVD", *(ROWS[name].write(lens, place) for name in ENVIRONMENT_OPERANDS), "1"])


def is_of_surfaces(operand: Operand) -> bool:
    """Whether an operand sets the environment of some surfaces, and not that of the lens."""
    return operand.name in ENVIRONMENT_OPERANDS and bool(operand.paths) and operand.paths[0].path[0] == "surfaces"


def with_environments(lens: Lens, place: Place) -> Lens:
    """The lens with operands that give the environments of its surfaces.

    Raises LensFileError for a lens without an environment: the indices of its file follow none.
    """
    missing = [k for k, s in enumerate(lens.surfaces) if s.environment is not None and not _is_set(lens, k)]
    if lens.environment is None and missing:
        message = "a surface in an environment of its own, of a lens without one; give it one, as lens.at(pressure=1)"
        raise LensFileError(message, place._replace(surface=missing[0]))
    added = [operand for k in missing for operand in (*_environment_operands(lens, "surfaces", k), _naming(lens, k))]
    listed: list[Operand] = []
    for position, operand in enumerate(candidates := [*added, *lens.operands]):
        listed.append(operand)
        if is_of_surfaces(operand):  # is followed by operands that name its surfaces
            names = [other.name for other in candidates[position + 1 :]]
            count = names.index(operand.name) if operand.name in names else len(names)
            behind = candidates[position + 1 : position + 1 + count]
            surfaces = {other.number for other in behind if other.name in _NAMING}
            covered = [k for (_, k, *_), *_ in operand.paths if isinstance(k, int)]
            listed += [_naming(lens, k) for k in covered if k not in surfaces]
    for name, last in zip(ENVIRONMENT_OPERANDS, _environment_operands(lens) if lens.environment else (), strict=False):
        of_name = [operand for operand in listed if operand.name == name]
        listed += [last] if of_name and is_of_surfaces(of_name[-1]) else []
    return dataclasses.replace(lens, operands=tuple(listed))


def _is_set(lens: Lens, k: int) -> bool:
    """Whether operands of the lens set the environment of a surface, and all other quantities are those of the lens."""
    if lens.environment is None:
        return False
    held = {path for operand in lens.operands for path, *_ in operand.paths}
    is_set = {name: ("surfaces", k, "environment", name) in held for name in ENVIRONMENT_OPERANDS.values()}
    as_lens = (same(getattr(lens.surfaces[k].environment, n), getattr(lens.environment, n)) for n in is_set)
    return any(is_set.values()) and all(map(max, is_set.values(), as_lens))


def _naming(lens: Lens, k: int) -> Operand:
    """An operand that changes nothing and names a surface."""
    media = (lens.surfaces[k].glass,) * configurations.count(lens.operands)
    return Operand("GLSS", k, paths=(ScaledPath(("surfaces", k, "glass")),), media=media)


def _environment_operands(lens: Lens, *path: str | int) -> list[Operand]:
    """Temperature and pressure of the lens, or of one of its surfaces, alike in all configurations."""
    air, count = part(lens, (*path, "environment")), configurations.count(lens.operands)
    return [
        Operand(
            name,
            paths=(ScaledPath((*path, "environment", field)),),
            numbers=torch.stack([getattr(air, field)] * count),
        )
        for name, field in ENVIRONMENT_OPERANDS.items()
    ]
