"""The rules of the surfaces of a .zmx file: which of their numbers vary, and which follow.

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

import math
from collections.abc import Iterator
from typing import NamedTuple

from raytrace.formats.report import Draft
from raytrace.formats.zemax_keywords import Block, Record
from raytrace.formats.zemax_names import Named, names
from raytrace.formats.zemax_numbers import INVERSE, Numbers, SurfaceType
from raytrace.formats.zemax_parameters import numbers
from raytrace.formats.zemax_types import types
from raytrace.system.intent import Solve, Vary
from raytrace.system.surface import Surface


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
    for record in _numbered(one, "PPAR"):
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


def _numbered(one: Told, keyword: str) -> list[Record]:
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
    for record in _numbered(one, "VPAR"):
        yield "PARM", record, record.integer(0, "number of the parameter")
    for record in _numbered(one, "XDAT"):
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
