"""Optimisation data of a .zmx file: variables, solves and pickups, merit function and tolerances; read and written.

The solves of a surface are stored with its numbers, which are the solved ones:

    CURV value code a b     code 1: variable; else a row of CURVATURE_SOLVES
    VDSZ least most         the thickness is variable; else a row of THICKNESS_SOLVES
    VCON / VPAR n           the conic, parameter n is variable; XDAT n value 1: datum n
    PPAR n surface factor offset    parameter n is a pickup
    GLAS name code surface nd Vd ΔPgF v v v    code 2: a pickup, 3: may be substituted; v 1: variable, of a model glass
    DIAM value code         0: automatic, 1: fixed, 2: a pickup, 3: the largest of all configurations
    MEMA value code         0: automatic, 1: fixed, 2: a pickup; mechanical semi-diameter
    OEMA value code         2: a pickup; chip zone
    OMMA 1 1                automatic MEMA are those of the cemented group; 0 0: each is of its own surface

CURV 2, 4, 8, 11, MAZH (paraxial, and by a real ray), PZUP, TOLE and EDGE reproduce the numbers that OpticStudio stored.
Codes that are not followed are kept with their numbers. A number of a configuration has a status, 1 variable or 2
pickup, which overrides the surface's variable or solve.

Merit function and tolerances follow the last surface, a row a line. Merit function files (.MF) have two more numbers
before the target.

    TRAC 0 1 0 0 3.35710687E-1 0 0 7.27220522E-2 0 0        operand, two whole numbers, four numbers, target, weight …
    BLNK Operands for field 1.
    TOL TTHI   1   2 -2.0E-1 2.0E-1   0 0 0                 operand, two whole numbers, least and largest change …
"""

import dataclasses
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from raytrace.io.source import (
    IGNORED,
    READ,
    Block,
    Draft,
    LensFileError,
    Place,
    Record,
    double,
    is_number,
    one_line,
    plain,
    read_text,
)
from raytrace.io.zemax.surfaces import (
    BLANK,
    INVERSE,
    MECHANICAL,
    SYSTEM_IGNORED,
    TAIL_REASON,
    TOLERANCES,
    Numbers,
    Sections,
    SurfaceType,
    in_millimetres,
    inverse,
    measured,
    numbers_of,
    records,
    spelled_inverse,
    type_name,
    type_of,
    types,
)
from raytrace.system.configurations import Operand, part, with_part
from raytrace.system.configurations import Path as LensPath
from raytrace.system.dimensions import DIMENSION
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Row, Solve, Vary
from raytrace.system.parameter_paths import BadVariables, parameter_paths, parse_bounds
from raytrace.system.surface import SIZES, Surface


class SolveRow(NamedTuple):
    """A solve: its kind, the power of length in each of its numbers, and whether it is followed.

    from_surface: whether the first word is the number of a surface.
    """

    kind: str
    powers: tuple[int, ...] = ()
    followed: bool = False
    from_surface: bool = False


#: Solves of the curvature by the code of CURV. Those without powers have not been met in a file.
CURVATURE_SOLVES = {
    2: SolveRow("marginal_angle", (0,), followed=True),
    3: SolveRow("chief_angle", (0,)),
    5: SolveRow("marginal_normal"),
    6: SolveRow("chief_normal"),
    7: SolveRow("aplanatic"),
    8: SolveRow("power", (-1,), followed=True),
    9: SolveRow("concentric_with_surface", (0,)),
    10: SolveRow("concentric_with_radius", (1,)),
    11: SolveRow("f_number", (0,), followed=True),
}
_CURVATURE_PICKUP = 4

#: Solves of the thickness by their keywords; PZUP is a pickup.
THICKNESS_SOLVES = {
    "MAZH": SolveRow("marginal_height", (1, 0), followed=True),
    "TOLE": SolveRow("position", (1,), from_surface=True, followed=True),
    "EDGE": SolveRow("edge_thickness", (1, 1), followed=True),
}
_FOLLOWED = ("pickup", *(r.kind for r in (*CURVATURE_SOLVES.values(), *THICKNESS_SOLVES.values()) if r.followed))

#: Keyword and rules by its code of each size of a surface, and rules by the code of GLAS.
_FIXED = 1
_SIZE_RULES = {
    "semi_diameter": ("DIAM", {2: "pickup", 3: "maximum"}),
    **{size: (keyword, {2: "pickup"}) for size, keyword in MECHANICAL.items()},
}
_MODEL, _GLASS_RULES = 1, {2: "pickup", 3: "substitute"}

#: Status of a number of a configuration: 1 is a variable.
VARIABLE, STATUSES = 1, {2: "pickup", 4: "thermal"}

#: Quantities of a model glass, by the position of the word of GLAS that makes them variable.
_GLASS_NUMBERS = {6: "index", 7: "abbe_number", 8: "partial_dispersion"}

#: Bounds of this size or larger are open.
_BOUNDLESS = 1e10


# -- the solves of a surface, read ------------------------------------------------------------------------------------


class TypedSurface(NamedTuple):
    """A surface with its records, its type and the numbers of that."""

    block: Block
    surface: Surface
    row: SurfaceType
    numbers: Numbers
    millimetres: float

    @property
    def number(self) -> int:
        return self.block.surface

    def names(self, keyword: str, j: int) -> dict[str, float]:
        """The numbers of the lens that PARM j, or XDAT j, gives, by their names, each with its factor."""
        return self.row.names(self.surface, self.numbers, keyword, j)[0]

    def modelled(self, quantity: str) -> Surface:
        """The surface with a quantity of its type modelled, where it was 0."""
        return self.row.named(self.surface, self.numbers).get(quantity, ("", 0, self.surface))[2]

    def code(self, keyword: str) -> int:
        return self.block.integer(keyword, "code", 0, 1)

    def numbered(self, keyword: str) -> list[tuple[int, Record]]:
        """The records of a keyword in the order of their numbers."""
        return sorted(((r.integer(0, "number"), r) for r in self.block.all(keyword)), key=lambda pair: pair[0])

    def solve(self, quantity: str, kind: str, numbers: Iterable[float] = (), source: int = 0) -> Solve:
        return Solve(self.number, quantity, kind, tuple(numbers), source=source)

    def coded(self, quantity: str, keyword: str, kinds: dict[int, str]) -> Solve:
        """The rule of a code, and the surface that it refers to."""
        code = self.code(keyword)
        refers = code in kinds and kinds[code] != "substitute"
        source = self.block.integer(keyword, "surface", 0, 2) if refers else 0
        return self.solve(quantity, kinds.get(code, f"code {code}"), source=source)

    def pickup(self, quantity: str, source: int, scale: float, offset: float = 0.0, other: str = "") -> Solve:
        """scale times a quantity of a surface, the same one unless another is named, plus an offset."""
        return Solve(self.number, quantity, "pickup", (), source, scale, offset, other)

    def has(self, quantity: str, keyword: str, report: Draft) -> bool:
        if quantity not in self.row.holds:
            message = f"a surface that is {self.row.name} has no {quantity}; left out"
            report.note(f"{self.block.place_of(keyword)}: {keyword}: {message}")
        return quantity in self.row.holds


def _rules(typed: TypedSurface, surfaces: Sequence[TypedSurface], report: Draft) -> Iterator[Vary | Solve]:
    """In the order of evaluation: parameters, curvature, thickness; then conic, extra data, glass, semi-diameter."""
    block = typed.block
    for j, record in typed.numbered("PPAR"):
        yield from _parameter_pickup(typed, j, record, surfaces)
    if (code := typed.code("CURV")) and typed.has("curvature", "CURV", report):
        yield _curvature_rule(typed, code)
    yield from _thickness_rules(typed)
    if block.last("VCON") and typed.has("conic", "VCON", report):
        yield Vary(typed.number, "conic")
    for j, _ in typed.numbered("VPAR"):
        yield from _parameter_variable(typed, "PARM", j)
    for j, record in typed.numbered("XDAT"):
        if (code := record.integer(2, "code", 0)) == VARIABLE:
            yield from _parameter_variable(typed, "XDAT", j)
        elif code:
            yield typed.solve(f"XDAT {j}", f"code {code}", _solve_numbers(record, 3))
    if (code := typed.code("GLAS")) == _MODEL:
        glass = block.last("GLAS")
        for k, name in _GLASS_NUMBERS.items():
            if glass and glass.number(k, "status", 0.0) == VARIABLE:
                yield Vary(typed.number, name)
    elif code:
        yield typed.coded("glass", "GLAS", _GLASS_RULES)
    for size, (keyword, kinds) in _SIZE_RULES.items():
        if typed.code(keyword) not in (0, _FIXED):
            yield typed.coded(size, keyword, kinds)


def _solve_numbers(record: Record | None, first: int) -> list[float]:
    """The numbers of a solve, from a word on, without a name in quotation marks; none without a record."""
    if record is None:
        return []
    return [record.number(k, "number of a solve") for k in range(first, len(record.words)) if record.words[k][0] != '"']


def _scaled(numbers: list[float], row: SolveRow, millimetres: float) -> list[float]:
    """The numbers of a solve in mm: as many as it has, and further numbers that are not 0."""
    count = len(row.powers)
    padded = [*numbers, *([0.0] * (count - len(numbers)))]
    while len(padded) > count and not padded[-1]:
        padded.pop()
    return [in_millimetres(n, p, millimetres) for n, p in zip(padded, row.powers, strict=False)] + padded[count:]


def _with_offset(numbers: list[float], power: int | None, millimetres: float) -> list[float]:
    """Surface, factor, offset and further numbers, with the offset in mm."""
    exponent = 1 if power is INVERSE else power or 0
    return [in_millimetres(n, exponent, millimetres) if k == 2 else n for k, n in enumerate(numbers)]


def _source(numbers: list[float], before: int) -> int | None:
    """The surface that a pickup looks back to; None where the first number is no earlier surface."""
    is_surface = bool(numbers) and numbers[0] == int(numbers[0]) and 0 <= numbers[0] < before
    return int(numbers[0]) if is_surface else None


def _curvature_rule(typed: TypedSurface, code: int) -> Vary | Solve:
    if code == VARIABLE:
        return Vary(typed.number, "curvature")
    numbers = _solve_numbers(typed.block.last("CURV"), 2)
    source = _source(numbers, typed.number)
    if code == _CURVATURE_PICKUP and source is not None and not any(numbers[2:]):
        return typed.pickup("curvature", source, numbers[1] if len(numbers) > 1 else 1.0)
    row = CURVATURE_SOLVES.get(code, SolveRow(f"code {code}"))
    return typed.solve("curvature", row.kind, _scaled(numbers, row, typed.millimetres))


def _thickness_rules(typed: TypedSurface) -> Iterator[Vary | Solve]:
    millimetres = typed.millimetres
    for keyword, row in THICKNESS_SOLVES.items():
        if record := typed.block.last(keyword):
            numbers = _scaled(_solve_numbers(record, 0)[row.from_surface :], row, millimetres)
            first = record.integer(0, "surface") if row.from_surface else 0
            yield typed.solve("thickness", row.kind, numbers, source=first)
    if record := typed.block.last("PZUP"):
        source = _source([record.number(0, "surface")], typed.number)
        scale, offset = record.number(1, "factor", 1.0), measured(record, 2, "offset", millimetres, 0.0)
        if source is None or record.number(3, "column", 0.0):
            yield typed.solve("thickness", "PZUP", _with_offset(_solve_numbers(record, 0), 1, millimetres))
        else:
            yield typed.pickup("thickness", source, scale, offset)
    if record := typed.block.last("VDSZ"):
        if math.isinf(float(typed.surface.thickness)):
            yield typed.solve("thickness", "variable")
            return
        least, most = (record.number(k, "bound", 0.0) for k in (0, 1))
        is_open = least >= most or (least <= -_BOUNDLESS and most >= _BOUNDLESS)
        ends = (math.copysign(math.inf, n) if abs(n) >= _BOUNDLESS else n * millimetres for n in (least, most))
        yield Vary(typed.number, "thickness", bounds=() if is_open else tuple(ends))


def _parameter_pickup(typed: TypedSurface, j: int, record: Record, surfaces: Sequence[TypedSurface]) -> Iterator[Solve]:
    numbers = _solve_numbers(record, 1)
    source = _source(numbers, typed.number)
    names, names_of_source = typed.names("PARM", j), {} if source is None else surfaces[source].names("PARM", j)
    name, other = next(iter(names), ""), next(iter(names_of_source), "")
    power = typed.row.power("PARM", j)
    is_linear = bool(name and other) and names[name] == names_of_source[other] == 1
    if power is INVERSE:  # the lens holds the reciprocals of lengths, which are proportional without an offset
        is_linear = is_linear and len(numbers) > 1 and numbers[1] != 0 and not any(numbers[2:])
    if source is None or not is_linear or any(numbers[3:]) or len(numbers) < 2:
        yield typed.solve(f"PARM {j}", "PPAR", _with_offset(numbers, power or 0, typed.millimetres))
        return
    offset = in_millimetres(numbers[2] if len(numbers) > 2 else 0.0, power or 0, typed.millimetres)
    scale = inverse(record.words[2], 1.0) if power is INVERSE else numbers[1]
    yield typed.pickup(name, source, scale, offset, other if other != name else "")
    yield from _followers(typed, names)


def _parameter_variable(typed: TypedSurface, keyword: str, j: int) -> list[Vary | Solve]:
    names = typed.names(keyword, j)
    if not names:
        return [typed.solve(f"{keyword} {j}", "variable")]
    return [Vary(typed.number, next(iter(names))), *_followers(typed, names)]


def _followers(typed: TypedSurface, names: dict[str, float]) -> list[Solve]:
    """The further numbers of the lens that a number of the file gives, as pickups of the first."""
    first, *others = names
    return [typed.pickup(name, typed.number, names[name] / names[first], other=first) for name in others]


# -- the optimisation data of a file, read ----------------------------------------------------------------------------


def typed_surfaces(sections: Sections, lens: Lens, millimetres: float) -> list[TypedSurface]:
    """The surfaces with their records, types and numbers."""
    surfaces = []
    for block, surface in zip(sections.surfaces, lens.surfaces, strict=True):
        row = types()[type_name(block)]
        surfaces.append(TypedSurface(block, surface, row, numbers_of(block, row, millimetres), millimetres))
    return surfaces


def rules_of(surfaces: Sequence[TypedSurface], report: Draft) -> list[Vary | Solve]:
    """The variables, solves and pickups of the surfaces, in the order of their evaluation."""
    return [rule for typed in surfaces for rule in _rules(typed, surfaces, report)]


_BOUNDS = "bounds:"


def _with_bounds(variables: tuple[Vary, ...], merit: tuple[Row, ...]) -> tuple[tuple[Vary, ...], tuple[Row, ...]]:
    """Variables with the bounds of the last row, a text of `_bounds_row`, and the rows without it."""
    text = merit[-1].text if merit and merit[-1].operand == _TEXT else ""
    try:
        bounds = parse_bounds(text.removeprefix(_BOUNDS)) if text.startswith(_BOUNDS) else {}
    except BadVariables:
        bounds = {}
    if not bounds:
        return variables, merit
    return tuple(dataclasses.replace(v, bounds=bounds.get(v.name, v.bounds)) for v in variables), merit[:-1]


def _bounds_row(data: OptimizationData) -> tuple[Row, ...]:
    """A row of text with the bounds of variables that no other line holds: thicknesses have VDSZ."""
    words = [
        f"{v.name}:{v.bounds[0]!r}..{v.bounds[1]!r}"
        for v in data.variables
        if v.bounds and (v.quantity != "thickness" or v.operand is not None)
    ]
    return (Row(_TEXT, text=f"{_BOUNDS} {' '.join(words)}"),) if words else ()


def read(
    sections: Sections,
    lens: Lens,
    surfaces: Sequence[TypedSurface],
    rules: Sequence[Vary | Solve],
    configured: Sequence[Vary | Solve],
    report: Draft,
) -> Lens:
    """The lens with its optimisation data, None where the file has none; every variable is modelled.

    rules: of the surfaces; configured: the variables and pickups of the numbers that operands set.
    """
    millimetres, head = surfaces[0].millimetres, sections.system.last("MNUM")
    start = head.place.line or 0 if head else 0
    behind = start > (sections.surfaces[-1].place.line or 0)  # MNUM follows the surfaces
    tail = [record for record in sections.tail if not behind or (record.place.line or 0) < start]
    set_by_operands = {operand.paths[0].path for operand in lens.operands if operand.paths}

    def is_overridden(rule: Vary | Solve) -> bool:
        """Whether a variable of a surface is a number of the configurations, whose status holds."""
        path = path_of(lens.surfaces[rule.surface], rule.quantity) if isinstance(rule, Vary) else None
        return path is not None and ("surfaces", rule.surface, *path) in set_by_operands

    rules = [rule for rule in rules if not is_overridden(rule)]
    variables = tuple(rule for rule in (*rules, *configured) if isinstance(rule, Vary))
    solves = [rule for rule in (*rules, *configured) if isinstance(rule, Solve)]
    for solve in solves:
        if not all(map(math.isfinite, (*solve.numbers, solve.scale, solve.offset))):
            message = f"a solve of the {solve.quantity}: a number is too large once converted to mm"
            raise LensFileError(message, surfaces[min(solve.surface, len(surfaces) - 1)].block.place)
    kept = tuple(solve for solve in solves if not _is_followed(solve, lens))
    for solve in kept:
        if solve.is_largest_size:
            continue
        report.note(f"kept, and not followed when the lens is optimised: {solve}")
    lines = [record for record in sections.tail if record.keyword in TOLERANCES]  # also behind the configurations
    variables, merit = _with_bounds(variables, merit_rows(tail, report))
    for record in lines:
        report.met(record.keyword, READ, record.place)
    states_none = all(record.keyword == "TOL" and record.words[:1] == (_NO_TOLERANCE,) for record in lines)
    tolerances = [] if states_none else [f"{record.keyword} {record.text.strip()}".rstrip() for record in lines]
    margin = sections.system.last("SDMA")
    percent, length = (
        measured(margin, k, "margin of semi-diameters", millimetres, 0.0) if margin else 0.0 for k in (0, 2)
    )
    shared = sections.system.last("OMMA")
    data = OptimizationData(
        variables,
        tuple(solve for solve in solves if _is_followed(solve, lens)),
        merit,
        unit=millimetres if merit or tolerances or configured else 1.0,
        tolerances=tuple(tolerances),
        distributions=tuple(_distributions(lines)),
        semi_diameters=tuple(
            k for k, typed in enumerate(surfaces) if typed.surface.semi_diameter and typed.code("DIAM") == _FIXED
        ),
        semi_diameter_margin=(percent, length),
        kept=kept,
        shares_mechanical=shared is None or any(shared.integer(k, "sizes of parts", 1) for k in range(2)),
    )
    sized = tuple(k for k, surface in enumerate(lens.surfaces) if surface.semi_diameter)
    lens = _with_variables_modelled(lens, surfaces, data)
    return dataclasses.replace(lens, optimization_data=None if data == OptimizationData(semi_diameters=sized) else data)


def _is_followed(solve: Solve, lens: Lens) -> bool:
    if solve.kind == "thermal":
        return lens.environment is not None and bool(re.fullmatch(r"thickness|curvature|a\d+", solve.quantity))
    if solve.operand is None:
        return solve.quantity not in SIZES and solve.kind in _FOLLOWED
    # a pickup between configurations: of a quantity whose unit is known, or that needs none
    is_linear = solve.quantity in ("thickness", "curvature", "conic") or (not solve.offset and solve.quantity.islower())
    return solve.kind == "pickup" and bool(solve.numbers) and is_linear


def path_of(surface: Surface, quantity: str) -> LensPath | None:
    """The path of a quantity in a surface; None where the surface does not have it."""
    if quantity in ("thickness", "glass", "curvature"):
        return (quantity,)
    place = parameter_paths(surface).get(quantity)
    return place and place.steps


def _with_variables_modelled(lens: Lens, surfaces: Sequence[TypedSurface], data: OptimizationData) -> Lens:
    """The lens with every number modelled that may change: variables, and solves and pickups of them."""
    moving = {(rule.surface, rule.quantity) for rule in data.variables if rule.operand is None}
    for solve in data.solves:
        source = (solve.source, solve.quantity_of_source or solve.quantity)
        if solve.operand is None and solve.quantity != "glass" and (solve.kind != "pickup" or source in moving):
            moving.add((solve.surface, solve.quantity))
    changed = list(lens.surfaces)
    for number, name in sorted(moving):
        like = surfaces[number].modelled(name)
        path = path_of(like, name)
        if path is not None and part(changed[number], path) is None:
            changed[number] = with_part(changed[number], path, double(0.0), like=like)
    return dataclasses.replace(lens, surfaces=tuple(changed))


def _distributions(lines: Sequence[Record]) -> Iterator[tuple[str, tuple[tuple[float, float], ...]]]:
    """The tables of errors (x, density) in the folder of the lens file, by the names in comments of STAT 3."""
    for line, comment in itertools.pairwise(lines):
        name = comment.text.strip()
        path = Path(line.place.file).parent / name
        if line.words[:2] == ("STAT", "3") and comment.keyword == "TCMM" and name == path.name and path.is_file():
            try:
                pairs = [row.split()[:2] for row in read_text(path).splitlines() if row.strip()]
                points = tuple((float(fraction), float(density)) for fraction, density in pairs)
            except ValueError as error:
                message = f"{name}: expected two numbers a line, the fraction of the limits and the density there"
                raise LensFileError(f"STAT: {message}", line.place) from error
            yield name, points


# -- the merit function and tolerances --------------------------------------------------------------------------------

_NO_TOLERANCE = "TOFF"
_TEXT = "BLNK"
_OPERAND = re.compile(r"[A-Z][A-Z0-9]{3}")


def merit_rows(lines: Iterable[Record], report: Draft, *, before_target: int = 0) -> tuple[Row, ...]:
    """The rows of the lines that are of a merit function, lengths in the unit of the file; every line is reported.

    before_target: count of numbers that precede the target, unlike in a .zmx file. Raises LensFileError for a malformed
    number of a known operand.
    """
    rows: list[Row] = []
    unknown: dict[str, Place] = {}
    for record in lines:
        word = record.keyword
        if word in TOLERANCES:
            continue
        if word == _TEXT:
            rows.append(Row(word, text=record.text.strip()))
        elif word in DIMENSION or (word not in SYSTEM_IGNORED and _is_row(record)):
            integers = record.integer(0, "whole number", 0), record.integer(1, "whole number", 0)
            h_x, h_y, p_x, p_y = (record.number(k, "argument", 0.0) for k in range(2, 6))
            target, weight = (
                record.number(6 + before_target + k, name, 0.0) for k, name in enumerate(("target", "weight"))
            )
            behind = record.words[8 + before_target :]
            text = next((k for k, w in enumerate(behind) if not is_number(w)), len(behind))
            others = (*record.words[6 : 6 + before_target], *behind[:text])
            further = tuple(plain(w) for w in others if is_number(w))
            rows.append(Row(word, integers, (h_x, h_y, p_x, p_y), target, weight, " ".join(behind[text:]), further))
            if word not in DIMENSION:
                unknown.setdefault(word, record.place)
        else:
            report.met(word[:40], IGNORED, record.place, SYSTEM_IGNORED.get(word, TAIL_REASON))
            continue
        report.met(word, READ, record.place)
    for word, place in unknown.items():
        report.note(f"{place}: {word} is no known operand of a merit function; kept unchanged")
    return tuple(rows)


def _is_row(record: Record) -> bool:
    """Whether a line with an unknown name has the form of a row."""
    first = record.words[:9]
    return bool(_OPERAND.fullmatch(record.keyword)) and len(first) > 7 and all(map(is_number, first))


def read_merit(path: str | PathLike) -> tuple[Row, ...]:
    """The rows of a merit function file (.MF) of OpticStudio, in the unit of length of its lens.

    `dataclasses.replace(lens.optimization_data, merit=rows)` are the optimisation data with them. Raises LensFileError.
    """
    name = str(path)
    lines = [record for record in records(read_text(Path(path)), name) if record.keyword != "VERS"]
    rows = merit_rows(lines, Draft(name, "mf"), before_target=2)
    if not rows:
        hint = "is it a merit function file of OpticStudio (.MF)?"
        raise LensFileError(f"no operand of a merit function in {len(lines)} lines; {hint}", Place(name))
    for record in lines:
        if record.keyword not in (*TOLERANCES, _TEXT) and record.keyword not in DIMENSION and not _is_row(record):
            raise LensFileError(f"{record.keyword[:40]} is no line of a merit function", record.place)
    return tuple(dataclasses.replace(row, further=row.further[2:]) for row in rows)


def merit_lines(merit: Iterable[Row], place: Place) -> list[str]:
    """The lines of a merit function. Raises LensFileError for a malformed row."""
    lines = []
    for row in merit:
        if not isinstance(row.operand, str):  # a text in its place, so that rows below keep their numbers
            name = one_line(row.name, "a name in the merit function", place)
            lines.append(f"{_TEXT} {name}: a function of the lens, target {row.target:g}, weight {row.weight:g}")
            continue
        if not _OPERAND.fullmatch(row.operand):
            raise LensFileError(f"{row.operand!r} is no name of an operand of four capital letters", place)
        text = one_line(row.text, "a text of the merit function", place)
        numbers = (*row.numbers, row.target, row.weight, *row.further)
        if not all(map(math.isfinite, numbers)):
            raise LensFileError(f"{row.operand}: only finite numbers can be written", place)
        words = [] if row.operand == _TEXT else [*map(str, row.integers), *(repr(float(n)) for n in numbers)]
        lines.append(" ".join([row.operand, *words, text]).rstrip())
    return lines


def tail_lines(data: OptimizationData | None, place: Place) -> list[str]:
    """The lines of merit function and tolerances; TOFF where there are no tolerances."""
    merit, tolerances = ((), ()) if data is None else ((*data.merit, *_bounds_row(data)), data.tolerances)
    lines = [one_line(line, "a tolerance", place) for line in tolerances]
    return [*merit_lines(merit, place), *(lines or [f"TOL {_NO_TOLERANCE}   0   0 0 0   0 0 0 0 0"])]


# -- the solves of a surface, written ---------------------------------------------------------------------------------

Lines = list[str]


def size_lines(data: OptimizationData | None) -> Lines:
    """The lines of SDMA and OMMA."""
    data = OptimizationData() if data is None else data
    percent, length = data.semi_diameter_margin
    return [f"SDMA {_spelled(percent)} 1 {_spelled(length)}", f"OMMA {'1 1' if data.shares_mechanical else '0 0'}"]


def with_rules(lines: Lines, lens: Lens, number: int, place: Place) -> Lines:
    """The lines of a surface with its variables, solves and pickups. Raises LensFileError for a rule without a line."""
    data = OptimizationData() if lens.optimization_data is None else lens.optimization_data
    rules = [rule for rule in data.rules if rule.surface == number]
    pickups = _operand_pickups(lens, number, place)
    solved = {rule.quantity for rule in rules if isinstance(rule, Solve) and rule.operand is None}
    picked = {rule.quantity for rule in pickups}
    rules = [
        rule for rule in rules if rule.operand is not None or isinstance(rule, Solve) or rule.quantity not in picked
    ]
    rules += [rule for rule in pickups if rule.quantity not in solved]
    fixed = number in data.semi_diameters
    lines = lines if lens.optimization_data is None else changed(lines, "DIAM", {2: str(_FIXED if fixed else 0)})
    for rule in rules:
        if isinstance(rule, Solve) and rule.quantity in SIZES and not (fixed and rule.quantity == "semi_diameter"):
            keyword, kinds = _SIZE_RULES[rule.quantity]
            lines = changed(lines, keyword, {2: str(_code_of(rule.kind, kinds)), 3: str(rule.source)})
    rules = [rule for rule in rules if rule.operand is None and rule.quantity not in SIZES]
    row, surface = types().get(type_of(lens.surfaces[number]) or ""), lens.surfaces[number]
    parameters: dict[str, tuple[str, int, Surface]] = {}
    if rules and row is not None:
        parameters = row.named(surface, row.numbers(surface)._replace(size=surface.semi_diameter))
    for rule in rules:
        if isinstance(rule, Solve) and rule.kind == "pickup" and rule.source == number and rule.quantity != "glass":
            continue  # a further number of the lens that the same number of the file gives
        if rule.quantity == "thickness":
            lines = _behind(lines, "DISZ", _thickness_line(rule, place))
        elif rule.quantity == "curvature":
            lines = _with_curvature(lines, rule, place)
        elif rule.quantity == "conic":
            if not isinstance(rule, Vary):
                raise _unheld(rule, place)
            lines = _behind(lines, "CONI", "VCON")
        elif isinstance(rule, Vary) and rule.quantity in _GLASS_NUMBERS.values():
            lines = changed(lines, "GLAS", {1 + k: "1" for k, name in _GLASS_NUMBERS.items() if name == rule.quantity})
        elif rule.quantity == "glass" and isinstance(rule, Solve):
            words = {2: str(_code_of(rule.kind, _GLASS_RULES))}
            if rule.kind == "pickup":
                lines, words[3] = with_glass_line(lines), str(rule.source)
            lines = changed(lines, "GLAS", words)
        else:
            lines = _with_parameter(lines, rule, row, parameters, place)
    return lines


def _operand_pickups(lens: Lens, number: int, place: Place) -> list[Solve]:
    """The pickups by which a surface follows operands of other surfaces.

    Raises LensFileError for a pickup that a .zmx file is not known to have.
    """
    pickups, quantities = [], {"THIC": "thickness", "CRVT": "curvature", "GLSS": "glass"}
    for operand in lens.operands:
        followed = [scaled for scaled in operand.paths[1:] if scaled.path[:2] == ("surfaces", number)]
        if number == operand.number or not followed or followed[0].path[2] == "environment":
            continue
        path, scale, offset = followed[0]
        names = {held.steps: name for name, held in parameter_paths(lens.surfaces[number]).items()}
        is_parameter = operand.name in ("PRAM", *(f"PAR{j}" for j in range(1, 9)))
        quantity = names.get(path[2:]) if is_parameter else quantities.get(operand.name)
        if not quantity or path[2:] != operand.paths[0].path[2:]:
            raise LensFileError(f"follows {operand} by a rule that is not written", place)
        pickups.append(Solve(number, quantity, "pickup", source=operand.number, scale=scale, offset=offset))
    return pickups


def _code_of(kind: str, codes: dict[int, str]) -> int:
    """The code of a kind in a file: of an unknown kind, the number in its name."""
    code = next((code for code, name in codes.items() if name == kind), None)
    return int(kind.rpartition(" ")[2]) if code is None else code


def changed(lines: Lines, keyword: str, words: dict[int, str]) -> Lines:
    """The lines of a surface with other words, counted from the keyword, in those of a keyword."""
    changed_lines = []
    for line in lines:
        old = line.split()
        if old[0] == keyword:
            old += ["0"] * (max(words) + 1 - len(old))
            line = "  " + " ".join(words.get(k, word) for k, word in enumerate(old))
        changed_lines.append(line)
    return changed_lines


def _behind(lines: Lines, start: str, line: str) -> Lines:
    """The lines with another inserted behind the line that begins with `start`, or at the end."""
    count = next((k for k, other in enumerate(lines, 1) if f"{other} ".startswith(f"  {start} ")), len(lines))
    return [*lines[:count], f"  {line}", *lines[count:]]


def _thickness_line(rule: Vary | Solve, place: Place) -> str:
    if isinstance(rule, Vary):
        far = 1e3 * _BOUNDLESS  # mm: open in metres, too
        ends = (max(-far, min(end, far)) for end in rule.bounds or (0.0, 0.0))
        return f"VDSZ {' '.join(map(_spelled, ends))}"
    if rule.kind == "variable":
        return "VDSZ 0 0"
    if rule.kind == "pickup":
        return f"PZUP {rule.source} {rule.scale!r} {rule.offset!r} 0"
    if rule.kind == "PZUP":
        return " ".join(["PZUP", *map(_spelled, rule.numbers)])
    for keyword, row in THICKNESS_SOLVES.items():
        if row.kind == rule.kind:
            return " ".join([keyword, *([str(rule.source)] if row.from_surface else []), *map(_spelled, rule.numbers)])
    raise _unheld(rule, place)


def _with_curvature(lines: Lines, rule: Vary | Solve, place: Place) -> Lines:
    if isinstance(rule, Vary):
        words = [str(VARIABLE), "0", "0"]
    elif rule.kind == "pickup":
        words = [str(_CURVATURE_PICKUP), str(rule.source), repr(rule.scale)]
        if rule.offset:
            raise LensFileError("a pickup of a curvature with an offset; a .zmx file has none", place)
    else:
        code = _code_of(rule.kind, {code: row.kind for code, row in CURVATURE_SOLVES.items()})
        words = [str(code), *map(_spelled, rule.numbers)]
    words += ["0"] * (4 - len(words))
    return changed(lines, "CURV", dict(enumerate(words, 2)))


def with_glass_line(lines: Lines) -> Lines:
    """The lines of a surface with one for its medium, which a surface in air leaves out."""
    if any(line.split()[0] == "GLAS" for line in lines):
        return lines
    return _behind(lines, "DISZ", f"GLAS {BLANK} 0 0 1.5 40 0 0 0 0 0 0")


def _with_parameter(
    lines: Lines, rule: Vary | Solve, row: SurfaceType | None, parameters: Mapping[str, tuple], place: Place
) -> Lines:
    keyword, _, digits = rule.quantity.partition(" ")
    if keyword in ("PARM", "XDAT") and digits:
        j = int(digits)
    elif rule.quantity in parameters:
        keyword, j, _ = parameters[rule.quantity]
    else:
        raise _unheld(rule, place)
    is_variable = isinstance(rule, Vary) or rule.kind == "variable"
    if keyword == "XDAT":
        further = [] if isinstance(rule, Vary) else [*map(_spelled, rule.numbers)]
        code = VARIABLE if isinstance(rule, Vary) or is_variable else _code_of(rule.kind, {})
        words = {3: str(code)} | dict(enumerate(further, 4))
        start = f"  XDAT {j} "
        return [changed([line], "XDAT", words)[0] if line.startswith(start) else line for line in lines]
    if isinstance(rule, Vary) or is_variable:
        line = f"VPAR {j}"
    elif rule.kind == "pickup":
        scale = spelled_inverse(rule.scale) if row and row.power("PARM", j) is INVERSE else repr(rule.scale)
        line = f"PPAR {j} {rule.source} {scale} {rule.offset!r} 0"
    else:
        line = " ".join([f"PPAR {j}", *map(_spelled, rule.numbers)])
    return _behind(lines, f"PARM {j}", line)


def _unheld(rule: Vary | Solve, place: Place) -> LensFileError:
    role = "variable" if isinstance(rule, Vary) else f"solve {rule.kind!r}"
    return LensFileError(f"a {role} of the {rule.quantity}, which a .zmx file does not hold; leave it out", place)


def _spelled(number: float) -> str:
    """The shortest text that reads back as the number."""
    return str(int(number)) if number == int(number) and abs(number) < 1e6 and repr(number) != "-0.0" else repr(number)


def statuses(lens: Lens, written: Sequence[Operand]) -> dict[tuple[int, int], tuple[str, str]]:
    """The status of a number and the words after its parameter, by the position of its operand and configuration.

    written: the operands that are written, among them those of the lens.
    """
    if lens.optimization_data is None:
        return {}
    positions = {id(operand): k for k, operand in enumerate(written)}
    written_at = [positions.get(id(operand)) for operand in lens.operands]
    words: dict[tuple[int, int], tuple[str, str]] = {}
    for rule in lens.optimization_data.rules:
        if rule.operand is None or rule.operand >= len(written_at):
            continue
        if (position := written_at[rule.operand]) is None:
            continue
        if isinstance(rule, Vary) or rule.kind == "variable":
            status = str(VARIABLE), "0 1 1 1.0 0.0 0"
        else:
            row = written_at[int(rule.numbers[0])] if rule.numbers else None
            pickup = f"0 {rule.source} {0 if row is None else row + 1} {rule.scale!r} {rule.offset!r} 0"
            status = str(_code_of(rule.kind, STATUSES)), pickup
        words[position, rule.configuration] = status
    return words
