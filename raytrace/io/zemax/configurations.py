"""The configurations of a .zmx file: its multi-configuration operands as those of a lens.

Where an operand stands in the lens is found by reading the file with it at other values: so every type of surface is
served, and a pickup is one more place. What no reading moves is told.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.io.report import IGNORED, READ, UNKNOWN, Draft
from raytrace.io.source import LensFileError
from raytrace.io.spelling import double, is_number, plain
from raytrace.io.zemax import environment as zemax_environment
from raytrace.io.zemax.keywords import Record, Sections
from raytrace.io.zemax.operands import IGNORED as OPERANDS_IGNORED
from raytrace.io.zemax.operands import KEPT, REFUSED, ROWS, Cell, applied, cell, solved
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import Glass
from raytrace.system.configurations import Operand, Path, ScaledPath, differences, part, same, taken, with_part
from raytrace.system.lens import Lens

#: More configurations, and more operands, than any file has.
MOST_CONFIGURATIONS, MOST_CELLS = 200, 2000

#: Values at which the place of an operand is looked for: far from what lenses have, and exact in binary.
_PROBES = ("0.34375", "0.40625", "0.46875")

Rebuild = Callable[[Sections], Lens]


class Found(NamedTuple):
    """An operand with the lines it comes from, and a lens in which all of its places are modelled."""

    operand: Operand
    cells: tuple[Cell, ...]
    like: Lens


def read(found: Sections, lens: Lens, rebuild: Rebuild, report: Draft, configuration: int | None) -> Lens:
    """The lens, as its surfaces are stored, with its operands, and in the configuration that is asked for.

    rebuild: the lens of the records when some of them are changed.
    """
    head = found.system.last("MNUM")
    if head is None:
        return lens if configuration is None else lens.configuration(configuration)
    count = head.integer(0, "number of configurations", 1)
    if not 1 <= count <= MOST_CONFIGURATIONS:
        raise LensFileError(f"MNUM is {count}, expected 1 to {MOST_CONFIGURATIONS} configurations", head.place)
    cells = _cells([record for record in found.tail if record.place.line > head.place.line], count, report)
    groups = zemax_environment.with_covered(_grouped(cells, count, report))
    told = head.integer(1, "active configuration", 0) if count > 1 else 1
    found, lens = _placed(found, lens, groups, told if 1 <= told <= count else 1, rebuild)
    operands = [_operand(group, found, lens, rebuild) for group in groups]
    agreeing = [k for k in range(1, count + 1) if all(_agrees(one, lens, k) is not False for one in operands)]
    active = told if 1 <= told <= count else agreeing[0] if agreeing else 1
    _say(head, count, active, operands, bool(told or len(agreeing) == 1), configuration, report)
    for one in operands:
        _say_of(one, lens, active, count, report)
    _say_solved(found, operands, active, report)
    lens = _with_operands(lens, operands, count, active)
    return lens if configuration is None else _chosen(lens, configuration, head)


def _placed(
    found: Sections, lens: Lens, groups: Sequence[tuple[Cell, ...]], active: int, rebuild: Rebuild
) -> tuple[Sections, Lens]:
    """The records and the lens with the environments of surfaces, which operands alone tell."""
    own = [group[active - 1] for group in groups if group[0].covered is not None]
    for one in own:
        found = applied(found, one, one.value)
    return found, rebuild(found) if own else lens


def _chosen(lens: Lens, configuration: int, head: Record) -> Lens:
    try:
        return lens.configuration(configuration)
    except ValueError as error:
        raise LensFileError(str(error), head.place) from error


def _with_operands(lens: Lens, operands: Sequence[Found], count: int, active: int) -> Lens:
    """The lens with its operands, all their places modelled; one that is not used tells the count where none does."""
    for one in operands:
        for place in one.operand.paths if one.operand.numbers is not None else ():
            if part(lens, place.path) is None:
                lens = with_part(lens, place.path, double(0.0), like=one.like)
    exact = [_as_stored(one, lens, active) for one in operands]
    listed = tuple(one for one in exact if one.name != "MOFF" or any(one.values()))
    if count > 1 and not listed:
        listed = (Operand("MOFF", words=(("",),) * count),)
    return dataclasses.replace(lens, operands=listed, current_configuration=active)


def _as_stored(one: Found, lens: Lens, active: int) -> Operand:
    """The operand with the digits of the surfaces, which have more of them, where both agree."""
    return taken(one.operand, lens, active - 1) if _agrees(one, lens, active) else one.operand


# -- lines ------------------------------------------------------------------------------------------------------------


def _cells(records: Iterable[Record], count: int, report: Draft) -> list[Cell]:
    """The cells of the lines after MNUM, every line reported."""
    found = []
    for record in records:
        one, word = cell(record), record.keyword
        if one is None or word in OPERANDS_IGNORED:
            reason = OPERANDS_IGNORED.get(word, "no multi-configuration operand")
            report.met(word[:40], IGNORED, record.place, reason)
        elif word not in ROWS and word not in KEPT and word not in REFUSED:
            report.met(word, UNKNOWN, record.place)
        elif not 1 <= one.configuration <= count:
            report.met(word, READ, record.place)
            report.warn(f"{word} of configuration {one.configuration}, of {count}: left out", record.place)
        else:
            report.met(word, READ, record.place)
            found.append(one)
        if len(found) > MOST_CELLS:
            raise LensFileError(f"more than {MOST_CELLS} multi-configuration operands", record.place)
    return found


def _grouped(cells: Sequence[Cell], count: int, report: Draft) -> list[tuple[Cell, ...]]:
    """The cells of each operand, one a configuration. A configuration that is missing has the value of the first."""
    groups: list[list[Cell]] = []
    for one in cells:
        if groups and groups[-1][-1].key == one.key and groups[-1][-1].configuration < one.configuration:
            groups[-1].append(one)
        else:
            groups.append([one])
    found = []
    for group in groups:
        told = {one.configuration: one for one in group}
        missing = [k for k in range(1, count + 1) if k not in told]
        if missing and group[0].name not in KEPT:
            listed = ", ".join(map(str, missing[:8]))
            message = f"{group[0].name} {group[0].number} has no value for configuration {listed}; the first is taken"
            report.warn(message, group[0].record.place)
        found.append(tuple(told.get(k, group[0]) for k in range(1, count + 1)))
    return found


# -- where an operand stands in the lens -------------------------------------------------------------------------------


def _operand(cells: tuple[Cell, ...], found: Sections, lens: Lens, rebuild: Rebuild) -> Found:
    """The operand of these cells, looked for in the lens; one that is not followed says why."""
    first = cells[0]
    values = tuple(one.value for one in cells)
    named = {"name": first.name, "number": first.number, "parameter": first.parameter}
    words = tuple((value,) for value in values)
    numbers = _numbers(values)
    plain = Operand(**named, numbers=numbers, words=words if numbers is None else ())
    if first.name in KEPT:
        return Found(plain, cells, lens)
    if first.name in REFUSED:
        return Found(Operand(**named, words=words, refusal="it is not modelled"), cells, lens)
    try:
        read = {value: rebuild(applied(found, one, value)) for one, value in zip(cells, values, strict=True)}
    except (LensFileError, UnknownGlass) as error:
        return Found(Operand(**named, words=words, refusal=str(error)), cells, lens)
    probes = [] if ROWS[first.name].path else _probed(found, first, rebuild)
    paths = _paths(first, lens, probes or [lens, *read.values()])
    if not paths:
        return Found(plain, cells, lens)
    held = [[part(read[value], path) for path in paths] for value in values]
    scaled = _scaled_paths(paths, probes, held)
    if scaled:
        numbers = torch.stack([double(0.0) if row[0] is None else row[0] for row in held])
        return Found(Operand(**named, paths=scaled, numbers=numbers), cells, probes[0])
    if not all(_has_room(lens, path) for path in paths):
        refusal = "as it is stored the lens has nothing there, an aperture, say"
        return Found(Operand(**named, words=words, refusal=refusal), cells, lens)
    scaled = tuple(ScaledPath(path) for path in paths)
    if all(isinstance(row[0], Glass) and all(same(row[0], other) for other in row) for row in held):
        return Found(Operand(**named, paths=scaled, media=tuple(row[0] for row in held)), cells, lens)
    return Found(Operand(**named, paths=scaled, words=tuple(map(tuple, held))), cells, lens)


def _has_room(lens: Lens, path: Path) -> bool:
    """Whether a lens has a place for what stands at the end of a path."""
    *start, end = path
    return part(lens, path) is not None or (isinstance(end, str) and part(lens, tuple(start)) is not None)


def _numbers(values: Sequence[str]) -> Tensor | None:
    return double([plain(value) for value in values]) if all(map(is_number, values)) else None


def _probed(found: Sections, one: Cell, rebuild: Rebuild) -> list[Lens]:
    """The lens with an operand at the values of the probes; none where it is no number."""
    try:
        return [rebuild(applied(found, one, value)) for value in _PROBES]
    except (LensFileError, UnknownGlass):
        return []


def _paths(one: Cell, lens: Lens, read: Sequence[Lens]) -> list[Path]:
    """Where readings of the lens differ; what is no number stands where its row says, and where else they differ."""
    row = ROWS[one.name]
    start = ("surfaces", one.number) if row.of == "surface" else ()
    told = [(*start, *row.path.split("."))] if row.path else []
    found = [path for other in read[1:] for path in differences(read[0], other)]
    return [*told, *(path for path in dict.fromkeys(found) if path not in told)]


def _scaled_paths(paths: Sequence[Path], probes: Sequence[Lens], held: Sequence[Sequence]) -> tuple[ScaledPath, ...]:
    """The places of a number, each a line over the first; none where they are no numbers, or no lines."""
    if not probes or any(not _is_number(one) for row in held for one in row):
        return ()
    seen = [[part(lens, path) for path in paths] for lens in probes]
    if any(not _is_number(one) or one is None for row in seen for one in row):
        return ()
    probed = [[float(one) for one in row] for row in seen]
    scaled = [ScaledPath(paths[0])]
    for position, path in enumerate(paths[1:], 1):
        rise = (probed[1][position] - probed[0][position]) / (probed[1][0] - probed[0][0])
        scaled.append(ScaledPath(path, rise, probed[0][position] - rise * probed[0][0]))
    for row in (*probed, *([0.0 if one is None else float(one) for one in row] for row in held)):
        for number, place in zip(row, scaled, strict=True):
            if abs(place.factor * row[0] + place.offset - number) > 1e-12 * abs(number):
                return ()
    return tuple(scaled)


def _is_number(one) -> bool:
    return one is None or (isinstance(one, Tensor) and one.ndim == 0)


# -- what is said -----------------------------------------------------------------------------------------------------


def _agrees(one: Found, lens: Lens, configuration: int) -> bool | None:
    """Whether the lens as stored holds the operand of a configuration; None where that cannot be told.

    Operands are saved with 13 digits. A semi-diameter of 0 is left to be computed.
    """
    operand, k = one.operand, configuration - 1
    if not operand.paths:
        return None
    stored = part(lens, operand.paths[0].path)
    if operand.numbers is None:
        wanted = operand.media[k] if operand.media else operand.words[k][0]
        if operand.name == "SDIA":
            return None if wanted is None else stored is not None and abs(stored - wanted) <= 1e-9 * wanted
        return same(stored, wanted)
    number, wanted = 0.0 if stored is None else float(stored), float(operand.numbers[k])
    return number == wanted or abs(number - wanted) <= 1e-9 * abs(wanted)


def _say(
    head: Record, count: int, active: int, operands: Sequence[Found], sure: bool, asked: int | None, report: Draft
) -> None:
    """The surfaces of a file hold the configuration that was active when it was saved."""
    if count == 1:
        return
    which = f"configuration {active} of {count}" if sure else f"one of {count} configurations (taken for {active})"
    varied = ", ".join(sorted({one.operand.name for one in operands})[:8]) or "nothing"
    message = f"multi-configuration file: {which} read, as stored in its surfaces; they differ in {varied}"
    if asked is not None:
        report.note(message.replace(" read,", ","))
        report.note(f"configuration {asked} of {count} read, as asked for")
    elif active == 1 and sure:
        report.note(message)
    else:
        report.warn(message, head.place)


def _say_of(one: Found, lens: Lens, active: int, count: int, report: Draft) -> None:
    """Warn of an operand that is not followed, and of one that the surfaces contradict."""
    own, operand = one.cells[active - 1], one.operand
    place = own.record.place
    what = f"multi-configuration operand {own}"
    if own.name in ("TEMP", "PRES") and not operand.paths:
        _say_environment(own, report)
    elif operand.refusal:
        if count == 1 or any(other.value != own.value for other in one.cells):
            report.warn(f"{what} (configuration {active}): not followed: {operand.refusal}", place)
    elif not operand.paths:
        if operand.name not in KEPT:
            report.warn(f"{what}: not followed: no number of the lens depends on it", place)
    elif _agrees(one, lens, active) is False:
        held = _shown(part(lens, operand.paths[0].path))
        report.warn(f"{what}: not followed by the lens as stored, which holds {held} (configuration {active})", place)


def _shown(held) -> str:
    if isinstance(held, Glass):
        return held.name or "air"
    return "0" if held is None else f"{float(held):.13g}" if isinstance(held, Tensor | float) else repr(held)


def _say_environment(own: Cell, report: Draft) -> None:
    """Warn of an operand that sets a temperature or a pressure, which move every index."""
    normal, unit, what = {"PRES": (1, "atm", "pressure"), "TEMP": (20, "°C", "temperature")}[own.name]
    if is_number(own.value) and plain(own.value) != normal:
        message = f"{own.name} {plain(own.value):g} {unit} ({what} of configuration {own.configuration}): not followed"
        report.warn(f"{message}; indices are those at {normal} {unit}", own.record.place)


def _say_solved(found: Sections, operands: Sequence[Found], active: int, report: Draft) -> None:
    """Warn of what rays are solved for, where operands bend them: it is stored for one configuration only."""
    bend = [one.operand for one in operands if _bends(one.operand, found) and _varies(one.operand)]
    names = {"CRVT": "CURV", "THIC": "DISZ"}
    told = {f"{names.get(one.operand.name)} {one.operand.number}" for one in operands}
    left = [what for what in solved(found.surfaces) if what not in told]
    if bend and left:
        listed = ", ".join(f"{what.split()[0]} of surface {what.split()[1]}" for what in left)
        message = f"solved for configuration {active}, and kept in the others as it is there: {listed}"
        report.warn(message, found.system.last("MNUM").place)


def _bends(operand: Operand, found: Sections) -> bool:
    """Whether paraxial rays depend on an operand; the tilt of a coordinate break moves none."""
    row = ROWS.get(operand.name)
    if row is None or not row.keyword.startswith("PARM"):
        return row is not None and row.bends
    kind = found.surfaces[operand.number].last("TYPE") if operand.number < len(found.surfaces) else None
    return bool(operand.paths) and not (kind and kind.words[:1] == ("COORDBRK",))


def _varies(operand: Operand) -> bool:
    shown = operand.values()
    return any(other != shown[0] for other in shown)
