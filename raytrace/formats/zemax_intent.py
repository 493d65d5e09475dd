"""What a .zmx file says about how its lens is to be optimised: an `Intent`.

The rules of surfaces (`zemax_rules`), the merit function and the tolerances (`zemax_merit`), and the status of numbers
of the configurations: 1 variable, 2 a pickup; there a surface's own rule is void.
"""

import dataclasses
import math
from collections.abc import Iterator

from raytrace.formats import zemax_merit
from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError
from raytrace.formats.spelling import double, is_number, plain
from raytrace.formats.zemax_keywords import Record, Sections
from raytrace.formats.zemax_names import path_of, with_room
from raytrace.formats.zemax_operands import Cell, cell
from raytrace.formats.zemax_rules import (
    CONFIGURATION_RULES,
    CURVATURE_SOLVES,
    GIVEN,
    GLASS_NUMBERS,
    THICKNESS_SOLVES,
    VARIABLE,
    Told,
    code_of,
    rules_of,
    told_of,
)
from raytrace.system.intent import Intent, Solve, Vary
from raytrace.system.lens import Lens
from raytrace.system.places import places
from raytrace.system.surface import Surface


def read(found: Sections, lens: Lens, millimetres: float, report: Draft) -> Lens:
    """The lens with its intent, None where the file says no more than any does; what varies is modelled."""
    told = [told_of(*pair, millimetres) for pair in zip(found.surfaces, lens.surfaces, strict=True)]
    rules = [rule for one in told for rule in rules_of(one, told, report)]
    configured, own = list(_of_configurations(found, lens)), _paths_of_configurations(lens)
    rules = [rule for rule in rules if not (isinstance(rule, Vary) and _is_void(rule, lens, own))]
    variables = tuple(one for one in (*rules, *configured) if isinstance(one, Vary))
    solves = [one for one in (*rules, *configured) if isinstance(one, Solve)]
    followed = tuple(one for one in solves if _is_followed(one))
    kept = tuple(one for one in solves if not _is_followed(one))
    for one in kept:
        report.note(f"kept, and not followed when the lens is optimised: {one}")
    tail = _before_configurations(found)
    merit, tolerances = zemax_merit.rows(tail, report), zemax_merit.tolerances(tail, report)
    given = [k for k, one in enumerate(told) if one.surface.semi_diameter and code_of(one.block, "DIAM") == GIVEN]
    intent = Intent(
        variables,
        followed,
        merit,
        unit=millimetres if merit or tolerances or configured else 1.0,
        tolerances=tolerances,
        semi_diameters=tuple(given),
        semi_diameter_margin=_margin(found, millimetres),
        kept=kept,
    )
    _refuse_infinite(intent, told)
    return dataclasses.replace(_with_moving(lens, told, intent), intent=intent if _says_more(intent, lens) else None)


def _is_followed(one: Solve) -> bool:
    kinds = [rule.kind for rule in (*CURVATURE_SOLVES.values(), *THICKNESS_SOLVES.values()) if rule.followed]
    if one.operand is not None:
        return one.kind == "pickup" and bool(one.numbers) and _is_linear(one)
    return one.quantity != "semi_diameter" and one.kind in ("pickup", *kinds)


def _is_linear(one: Solve) -> bool:
    """Whether a pickup between configurations has a unit that is known, or needs none."""
    return one.quantity in ("thickness", "curvature", "conic") or (not one.offset and one.quantity.islower())


def _says_more(intent: Intent, lens: Lens) -> bool:
    """Whether an intent is another than that of a lens without one, whose semi-diameters are all given."""
    sized = tuple(k for k, surface in enumerate(lens.surfaces) if surface.semi_diameter)
    return intent != Intent(semi_diameters=sized)


def _refuse_infinite(intent: Intent, told: list[Told]) -> None:
    for one in (*intent.solves, *intent.kept):
        figures = *one.numbers, one.scale, one.offset
        if not all(map(math.isfinite, figures)):
            message = f"a rule of the {one.quantity}: a number is too large once converted to mm"
            raise LensFileError(message, told[min(one.surface, len(told) - 1)].block.place)


def _margin(found: Sections, millimetres: float) -> tuple[float, float]:
    record = found.system.last("SDMA")
    if record is None:
        return 0.0, 0.0
    percent, length = (record.number(k, "margin of semi-diameters", 0.0) for k in (0, 2))
    return percent, length * millimetres


# -- what moves is modelled -------------------------------------------------------------------------------------------


def _with_moving(lens: Lens, told: list[Told], intent: Intent) -> Lens:
    """The lens with every number modelled that may change: variables, and what follows them."""
    moving = {(one.surface, one.quantity) for one in intent.variables if one.operand is None}
    for one in intent.solves:
        if one.operand is not None or one.quantity == "glass":
            continue
        of = (one.source, one.quantity_of_source or one.quantity)
        if one.kind != "pickup" or of in moving:
            moving.add((one.surface, one.quantity))
    surfaces = list(lens.surfaces)
    for number, name in sorted(moving):
        surfaces[number] = with_room(surfaces[number], name, _like(told[number], name), double(0.0))
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def _like(one: Told, name: str) -> Surface:
    """A surface in which a number of a name is modelled."""
    if name in ("thickness", "curvature", "conic", *GLASS_NUMBERS.values()):
        return one.surface
    candidates = [("PARM", j) for j in one.row.parameters]
    candidates += [("XDAT", record.integer(0, "number of the datum")) for record in one.block.all("XDAT")]
    for keyword, j in candidates:
        own, like = one.names(keyword, j)
        if name in [named.name for named in own]:
            return like
    return one.surface


# -- configurations ---------------------------------------------------------------------------------------------------


def _before_configurations(found: Sections) -> list[Record]:
    head = found.system.last("MNUM")
    after = head.place.line if head and head.place.line > found.surfaces[-1].place.line else math.inf
    return [record for record in found.tail if record.place.line < after]


def _of_configurations(found: Sections, lens: Lens) -> Iterator[Vary | Solve]:
    """The variables and rules in the table of configurations, by the operands of the lens."""
    head = found.system.last("MNUM")
    if head is None or not lens.operands:
        return
    cells = [one for record in found.tail if record.place.line > head.place.line and (one := cell(record))]
    numbered = _numbered(cells, lens)
    for one, operand in zip(cells, numbered[0], strict=True):
        status = int(plain(one.rule[0])) if one.rule and is_number(one.rule[0]) else 0
        if operand is None or not status or not 1 <= one.configuration <= len(lens.operands[operand]):
            continue
        place = lens.operands[operand].places[:1]
        name = _name_at(lens, place[0].path) if place else ""
        where = {"configuration": one.configuration, "operand": operand}
        if status == VARIABLE and name:
            yield Vary(place[0].path[1], name, **where)
        elif status == VARIABLE:
            yield Solve(one.number, one.name, "variable", **where)
        else:
            yield _configuration_rule(one, status, name, where, numbered[1])


def _configuration_rule(one: Cell, status: int, name: str, where: dict, indices: list[int | None]) -> Solve:
    figures = [plain(word) if is_number(word) else 0.0 for word in one.rule[3:7]]
    source, number, scale, offset = (*figures, *(0.0, 0.0, 1.0, 0.0)[len(figures) :])
    kind = CONFIGURATION_RULES.get(status, f"status {status}")
    told = number == int(number) and 0 < number <= len(indices) and indices[int(number) - 1] is not None
    rule = {"numbers": (float(indices[int(number) - 1]),) if told else (), "source": int(source)}
    return Solve(one.number, name or one.name, kind, **rule, scale=scale, offset=offset, **where)


def _numbered(cells: list[Cell], lens: Lens) -> tuple[list[int | None], list[int | None]]:
    """Which operand of the lens every cell, and every row of the table, is: those that say nothing are none."""
    of_cells: list[int | None] = []
    of_rows: list[int | None] = []
    before, behind = None, 0
    for one in cells:
        if before is None or before.key != one.key or before.configuration >= one.configuration:
            keys = [(other.name, other.number, other.parameter) for other in lens.operands]
            index = next((k for k in range(behind, len(keys)) if keys[k] == one.key), None)
            behind = behind if index is None else index + 1
            of_rows.append(index)
        of_cells.append(of_rows[-1])
        before = one
    return of_cells, of_rows


def _name_at(lens: Lens, path: tuple) -> str:
    """The name of a number of a surface by where the lens holds it; "" of any other."""
    if len(path) < 3 or path[0] != "surfaces":
        return ""
    if path[2:] == ("thickness",):
        return "thickness"
    surface = lens.surfaces[path[1]]
    return next((name for name in places(surface) if path_of(surface, name) == path[2:]), "")


def _paths_of_configurations(lens: Lens) -> set:
    return {operand.places[0].path for operand in lens.operands if operand.places}


def _is_void(one: Vary, lens: Lens, own: set) -> bool:
    """Whether a variable of a surface is a number of the configurations, where its status stands."""
    path = ("thickness",) if one.quantity == "thickness" else path_of(lens.surfaces[one.surface], one.quantity)
    return path is not None and ("surfaces", one.surface, *path) in own
