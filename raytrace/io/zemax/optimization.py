"""What a .zmx file says about how its lens is to be optimised: an `OptimizationData`.

The rules of surfaces (`zemax_rules`), the merit function and the tolerances (`zemax_merit`), and the status of numbers
of the configurations: 1 variable, 2 a pickup; there a surface's own rule is void.

What PARM and XDAT of a surface of a .zmx file are called in the lens: found by reading the surface at two values.

So a new type of surface brings the names of its numbers with it.

The rules of the surfaces of a .zmx file: which of their numbers vary, and which follow.

A surface has its rules beside its numbers, which are the solved ones:

    CURV value code a b     code 1: variable; else a row of CURVATURE_SOLVES
    VDSZ least most         the thickness is variable; else a row of THICKNESS_SOLVES
    VCON / VPAR n           the conic, parameter n is variable; XDAT n value 1: datum n
    PPAR n surface factor offset    parameter n is a pickup
    GLAS name code surface nd Vd ΔPgF v v v    code 2: a pickup, 3: may be exchanged; v 1: of a model glass, variable
    DIAM value code         0: follows the rays, 1: given, 2: a pickup, 3: the largest of all configurations

Read against numbers that OpticStudio stored: CURV 2, 4, 8, 11, MAZH (paraxial, and by a real ray), PZUP, TOLE and
EDGE give them back. Codes that are
not followed are kept with their numbers.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import NamedTuple

from torch import Tensor

from raytrace.io.report import Draft
from raytrace.io.source import LensFileError
from raytrace.io.spelling import double, is_number, plain
from raytrace.io.zemax import merit as zemax_merit
from raytrace.io.zemax.keywords import Block, Record, Sections
from raytrace.io.zemax.numbers import INVERSE, Numbers, SurfaceType
from raytrace.io.zemax.operands import Cell, cell
from raytrace.io.zemax.surface_types import types
from raytrace.io.zemax.surfaces import numbers
from raytrace.system.configurations import Path, part, with_part
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.parameter_paths import number_at, parameter_paths
from raytrace.system.surface import Surface

#: Values far from what lenses have, exact in binary.
_PROBES = (0.34375, 0.40625)

#: The first datum of XDAT that is a term.
FIRST_TERM = 3


class Named(NamedTuple):
    """A number of the lens: its name in `parameter_paths`, and factor · (number of the file, in mm) + offset, it is."""

    name: str
    factor: float
    offset: float

    @property
    def is_plain(self) -> bool:
        return (self.factor, self.offset) == (1.0, 0.0)


def names(surface: Surface, row: SurfaceType, told: Numbers, keyword: str, j: int) -> tuple[tuple[Named, ...], Surface]:
    """What PARM j, or XDAT j, of a surface is in the lens, and a surface in which all of that is modelled.

    row, told: its type and its numbers. Nothing for what is no number of the lens, as the order of tilts.
    """
    try:
        probed = [dataclasses.replace(surface, **row.fields(_with(row, told, keyword, j, one))) for one in _PROBES]
    except (KeyError, IndexError, ValueError):
        return (), surface
    found = []
    for name, place in parameter_paths(probed[0]).items():
        one, other = (number_at(like, place) if name in parameter_paths(like) else None for like in probed)
        if isinstance(one, Tensor) and isinstance(other, Tensor) and float(one) != float(other):
            factor = (float(other) - float(one)) / (_PROBES[1] - _PROBES[0])
            found.append(Named(name, factor, float(one) - factor * _PROBES[0]))
    return tuple(found), probed[0]


def _with(row: SurfaceType, told: Numbers, keyword: str, j: int, number: float) -> Numbers:
    """The numbers with another one. Raises KeyError, IndexError for what the type does not have."""
    if keyword == "PARM":
        if j not in row.parameters:
            raise KeyError(j)
        return told._replace(parameters={**told.parameters, j: number})
    if told.terms is None or j < FIRST_TERM:
        raise IndexError(j)
    terms = told.terms.clone()
    terms[j - FIRST_TERM] = number
    return told._replace(terms=terms)


def listed(row: SurfaceType, told: Numbers) -> list[tuple[str, int]]:
    """Every PARM and XDAT that a surface of a type has."""
    data = 0 if told.terms is None else len(told.terms)
    return [*(("PARM", j) for j in row.parameters), *(("XDAT", FIRST_TERM + k) for k in range(data))]


def path_of(surface: Surface, name: str) -> Path | None:
    """Where a surface holds a number of a name; None of one that it has no room for."""
    place = parameter_paths(surface).get(name)
    if place is None:
        return None
    entry = () if place.entry is None else ((place.entry,),)
    return (*place.path, *entry)


def with_room(surface: Surface, name: str, like: Surface, zero: Tensor) -> Surface:
    """The surface with a number of a name modelled, 0 where it was not, as `like` has it."""
    path = ("thickness",) if name == "thickness" else path_of(like, name)
    if path is None or part(surface, path) is not None:
        return surface
    return with_part(surface, path, zero, like=like)


class Rule(NamedTuple):
    """A solve: its kind, the power of length in each of its numbers, and whether it is followed.

    from_surface: whether the first word is the number of a surface.
    """

    kind: str
    powers: tuple[int, ...] = ()
    followed: bool = False
    from_surface: bool = False


#: Solves of the curvature by the code of CURV; those without a file that has them are by name only.
CURVATURE_SOLVES = {
    2: Rule("marginal_angle", (0,), followed=True),
    3: Rule("chief_angle", (0,)),
    5: Rule("marginal_normal"),
    6: Rule("chief_normal"),
    7: Rule("aplanatic"),
    8: Rule("power", (-1,), followed=True),
    9: Rule("concentric_with_surface", (0,)),
    10: Rule("concentric_with_radius", (1,)),
    11: Rule("f_number", (0,), followed=True),
}
CURVATURE_PICKUP = 4

#: Solves of the thickness by their keywords; beside them PZUP, a pickup.
THICKNESS_SOLVES = {
    "MAZH": Rule("marginal_height", (1, 0), followed=True),
    "TOLE": Rule("position", (1,), from_surface=True, followed=True),
    "EDGE": Rule("edge_thickness", (1, 1), followed=True),
}

#: Rules of a semi-diameter by the code of DIAM.
GIVEN = 1
SEMI_DIAMETER_RULES = {2: "pickup", 3: "maximum"}

#: Rules of a glass by the code of GLAS, and what of a model glass is variable by which word.
MODEL = 1
GLASS_RULES = {2: "pickup", 3: "substitute"}
GLASS_NUMBERS = {6: "index", 7: "abbe_number", 8: "partial_dispersion"}

#: Rules of a number of a configuration by its status.
VARIABLE = 1
CONFIGURATION_RULES = {2: "pickup", 4: "thermal"}

#: Bounds this far out are none.
BOUNDLESS = 1e10


class Told(NamedTuple):
    """A surface with its records: its type and the numbers of that."""

    block: Block
    surface: Surface
    row: SurfaceType
    numbers: Numbers
    millimetres: float

    @property
    def number(self) -> int:
        return self.block.place.surface

    def names(self, keyword: str, j: int) -> tuple[tuple[Named, ...], Surface]:
        return names(self.surface, self.row, self.numbers, keyword, j)

    def solve(self, quantity: str, kind: str, *figures: float, source: int = 0) -> Solve:
        return Solve(self.number, quantity, kind, tuple(figures), source=source)


def told_of(block: Block, surface: Surface, millimetres: float) -> Told:
    kind = block.last("TYPE")
    row = types()[kind.words[0].upper() if kind else "STANDARD"]
    own = numbers(block, row, millimetres)._replace(size=surface.semi_diameter)
    return Told(block, surface, row, own, millimetres)


def code_of(block: Block, keyword: str) -> int:
    record = block.last(keyword)
    return record.integer(1, "code", 0) if record else 0


# -- the rules of a surface -------------------------------------------------------------------------------------------


def rules_of(one: Told, told: list[Told], report: Draft) -> Iterator[Vary | Solve]:
    """In the order in which they are evaluated: parameters, curvature, thickness; then conic, extra data and glass."""
    for record in _numbered_of_zemax_rules(one, "PPAR"):
        yield from _parameter_pickup(one, record, told)
    yield from _curvature(one, report)
    yield from _thickness(one)
    if (record := one.block.last("VCON")) and _holds(one, "conic", record, report):
        yield Vary(one.number, "conic")
    for keyword, record, j in _variable_numbers(one):
        yield from _variable_number(one, keyword, record, j)
    yield from _glass(one)
    code = code_of(one.block, "DIAM")
    if code in SEMI_DIAMETER_RULES:
        source = one.block.last("DIAM").integer(2, "surface", 0)
        yield one.solve("semi_diameter", SEMI_DIAMETER_RULES[code], source=source)
    elif code not in (0, GIVEN):
        yield one.solve("semi_diameter", f"code {code}")


def _numbered_of_zemax_rules(one: Told, keyword: str) -> list[Record]:
    """The records of a keyword by their numbers."""
    return sorted(one.block.all(keyword), key=lambda record: record.integer(0, "number"))


def _holds(one: Told, name: str, record: Record, report: Draft) -> bool:
    if name in one.row.holds:
        return True
    report.note(f"{record.place}: {record.keyword}: a surface that is {one.row.name} has no {name}; left out")
    return False


def _curvature(one: Told, report: Draft) -> Iterator[Vary | Solve]:
    record, code = one.block.last("CURV"), code_of(one.block, "CURV")
    if not record or not code or not _holds(one, "curvature", record, report):
        return
    if code == VARIABLE:
        yield Vary(one.number, "curvature")
        return
    figures = _figures(record, 2)
    source = _surface(figures[0], one.number) if figures else None
    if code == CURVATURE_PICKUP and source is not None and not any(figures[2:]):
        scale = figures[1] if len(figures) > 1 else 1.0
        yield Solve(one.number, "curvature", "pickup", source=source, scale=scale)
        return
    rule = CURVATURE_SOLVES.get(code, Rule(f"code {code}"))
    yield one.solve("curvature", rule.kind, *_scaled(figures, rule, one.millimetres))


def _figures(record: Record, first: int) -> list[float]:
    """The numbers of a rule, from a word on; a name in quotation marks is none."""
    return [record.number(k, "number of a solve") for k in range(first, len(record.words)) if record.words[k][0] != '"']


def _surface(figure: float, before: int) -> int | None:
    """The number of a surface that a pickup looks back to; None of any other number."""
    return int(figure) if figure == int(figure) and 0 <= figure < before else None


def _scaled(figures: list[float], rule: Rule, millimetres: float) -> list[float]:
    """The numbers of a rule in mm: as many as it has, and those further ones that are not 0."""
    count = len(rule.powers)
    padded = [*figures, *([0.0] * (count - len(figures)))]
    while len(padded) > count and not padded[-1]:
        padded.pop()
    return [_in_mm(one, power, millimetres) for one, power in zip(padded, rule.powers, strict=False)] + padded[count:]


def _in_mm(figure: float, power: int | None, millimetres: float) -> float:
    power = 1 if power is INVERSE else power
    return figure * millimetres**power if power >= 0 else figure / millimetres**-power


def _thickness(one: Told) -> Iterator[Vary | Solve]:
    for keyword, rule in THICKNESS_SOLVES.items():
        if record := one.block.last(keyword):
            figures = _figures(record, 0)
            source = record.integer(0, "surface") if rule.from_surface else 0
            yield one.solve(
                "thickness", rule.kind, *_scaled(figures[rule.from_surface :], rule, one.millimetres), source=source
            )
    if record := one.block.last("PZUP"):
        yield _thickness_pickup(one, record)
    if record := one.block.last("VDSZ"):
        if math.isinf(float(one.surface.thickness)):
            yield one.solve("thickness", "variable")
            return
        yield Vary(one.number, "thickness", bounds=_bounds(record, one.millimetres))


def _bounds(record: Record, millimetres: float) -> tuple[float, ...]:
    """Least and greatest in mm, infinite on a side that is open; () where both are."""
    least, most = (record.number(k, "bound", 0.0) for k in (0, 1))
    if least >= most or (least <= -BOUNDLESS and most >= BOUNDLESS):
        return ()
    return tuple(math.copysign(math.inf, n) if abs(n) >= BOUNDLESS else n * millimetres for n in (least, most))


def _thickness_pickup(one: Told, record: Record) -> Solve:
    source = _surface(record.number(0, "surface"), one.number)
    scale, offset = record.number(1, "factor", 1.0), record.number(2, "offset", 0.0)
    if source is None or record.number(3, "column", 0.0):
        return one.solve("thickness", "PZUP", *_with_offset(_figures(record, 0), 1, one.millimetres))
    return Solve(one.number, "thickness", "pickup", source=source, scale=scale, offset=offset * one.millimetres)


def _with_offset(figures: list[float], power: int, millimetres: float) -> list[float]:
    """Surface, factor, offset and what follows them, with the offset in mm."""
    return [_in_mm(one, power, millimetres) if k == 2 else one for k, one in enumerate(figures)]


def _parameter_pickup(one: Told, record: Record, told: list[Told]) -> Iterator[Solve]:
    j = record.integer(0, "number of the parameter")
    figures = _figures(record, 1)
    source = _surface(figures[0], one.number) if figures else None
    own, _ = one.names("PARM", j)
    there, _ = told[source].names("PARM", j) if source is not None else ((), None)
    power = one.row.parameters.get(j)
    alike = own and there and power is not INVERSE and own[0].is_plain and there[0].is_plain
    if not alike or any(figures[3:]) or len(figures) < 2:
        yield one.solve(f"PARM {j}", "PPAR", *_with_offset(figures, power or 0, one.millimetres))
        return
    offset = _in_mm(figures[2] if len(figures) > 2 else 0.0, power, one.millimetres)
    named = there[0].name if there[0].name != own[0].name else ""
    rule = {"source": source, "scale": figures[1], "offset": offset, "quantity_of_source": named}
    yield Solve(one.number, own[0].name, "pickup", **rule)
    yield from _followers(one, own)


def _followers(one: Told, own: tuple[Named, ...]) -> Iterator[Solve]:
    """The further numbers of the lens that a number of the file stands for, as pickups of the first."""
    first = own[0]
    for other in own[1:]:
        scale = other.factor / first.factor
        offset = other.offset - scale * first.offset
        rule = {"source": one.number, "scale": scale, "offset": offset, "quantity_of_source": first.name}
        yield Solve(one.number, other.name, "pickup", **rule)


def _variable_numbers(one: Told) -> Iterator[tuple[str, Record, int]]:
    for record in _numbered_of_zemax_rules(one, "VPAR"):
        yield "PARM", record, record.integer(0, "number of the parameter")
    for record in _numbered_of_zemax_rules(one, "XDAT"):
        if record.integer(2, "code", 0):
            yield "XDAT", record, record.integer(0, "number of the datum")


def _variable_number(one: Told, keyword: str, record: Record, j: int) -> Iterator[Vary | Solve]:
    if keyword == "XDAT" and record.integer(2, "code") != VARIABLE:
        figures = _figures(record, 3)
        yield one.solve(f"XDAT {j}", f"code {record.integer(2, 'code')}", *figures)
        return
    own, _ = one.names(keyword, j)
    if own:
        yield Vary(one.number, own[0].name)
        yield from _followers(one, own)
    else:
        yield one.solve(f"{keyword} {j}", "variable")


def _glass(one: Told) -> Iterator[Vary | Solve]:
    record, code = one.block.last("GLAS"), code_of(one.block, "GLAS")
    if not record or not code:
        return
    if code == MODEL:
        for k, name in GLASS_NUMBERS.items():
            if record.number(k, "whether it is variable", 0.0) == VARIABLE:
                yield Vary(one.number, name)
    elif code in GLASS_RULES:
        source = record.integer(2, "surface", 0) if GLASS_RULES[code] == "pickup" else 0
        yield one.solve("glass", GLASS_RULES[code], source=source)
    else:
        yield one.solve("glass", f"code {code}")


def read(found: Sections, lens: Lens, millimetres: float, report: Draft) -> Lens:
    """The lens with its optimisation data, None where the file says no more than any does; what varies is modelled."""
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
    optimization_data = OptimizationData(
        variables,
        followed,
        merit,
        unit=millimetres if merit or tolerances or configured else 1.0,
        tolerances=tolerances,
        semi_diameters=tuple(given),
        semi_diameter_margin=_margin(found, millimetres),
        kept=kept,
    )
    _refuse_infinite(optimization_data, told)
    return dataclasses.replace(
        _with_moving(lens, told, optimization_data),
        optimization_data=optimization_data if _says_more(optimization_data, lens) else None,
    )


def _is_followed(one: Solve) -> bool:
    kinds = [rule.kind for rule in (*CURVATURE_SOLVES.values(), *THICKNESS_SOLVES.values()) if rule.followed]
    if one.operand is not None:
        return one.kind == "pickup" and bool(one.numbers) and _is_linear(one)
    return one.quantity != "semi_diameter" and one.kind in ("pickup", *kinds)


def _is_linear(one: Solve) -> bool:
    """Whether a pickup between configurations has a unit that is known, or needs none."""
    return one.quantity in ("thickness", "curvature", "conic") or (not one.offset and one.quantity.islower())


def _says_more(optimization_data: OptimizationData, lens: Lens) -> bool:
    """Whether optimisation data is another than that of a lens without one, whose semi-diameters are all given."""
    sized = tuple(k for k, surface in enumerate(lens.surfaces) if surface.semi_diameter)
    return optimization_data != OptimizationData(semi_diameters=sized)


def _refuse_infinite(optimization_data: OptimizationData, told: list[Told]) -> None:
    for one in (*optimization_data.solves, *optimization_data.kept):
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


def _with_moving(lens: Lens, told: list[Told], optimization_data: OptimizationData) -> Lens:
    """The lens with every number modelled that may change: variables, and what follows them."""
    moving = {(one.surface, one.quantity) for one in optimization_data.variables if one.operand is None}
    for one in optimization_data.solves:
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
        place = lens.operands[operand].paths[:1]
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
    return next((name for name in parameter_paths(surface) if path_of(surface, name) == path[2:]), "")


def _paths_of_configurations(lens: Lens) -> set:
    return {operand.paths[0].path for operand in lens.operands if operand.paths}


def _is_void(one: Vary, lens: Lens, own: set) -> bool:
    """Whether a variable of a surface is a number of the configurations, where its status stands."""
    path = ("thickness",) if one.quantity == "thickness" else path_of(lens.surfaces[one.surface], one.quantity)
    return path is not None and ("surfaces", one.surface, *path) in own
