"""The optimisation data of a lens as lines of a .zmx file: the inverse of `optimization.py`.

The lines of a surface are those that a lens without optimisation data has; words in them are changed, and lines put in.

The lines of a .zmx file in mm as lines in another unit of length.

A merit function of lengths and pure numbers depends on the unit, so a lens with one is written in that of its file. A
number that came out of such a file is written such that reading it again gives the same number of mm; of others, two
of which may lie between neighbouring numbers of the file, it gives that or the next one.

The configurations of a lens as the multi-configuration operands of a .zmx file.

The word of an operand is the one that it stands for in the file of the lens in that configuration.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from decimal import Context, Decimal
from fractions import Fraction

from raytrace.io.report import Draft
from raytrace.io.source import LensFileError, Place
from raytrace.io.spelling import MILLIMETRES, exact, is_infinite, one_line
from raytrace.io.zemax import environment as zemax_environment
from raytrace.io.zemax.keywords import BLANK, FIELD_LISTS, Record, Sections, aperture_keywords, sections
from raytrace.io.zemax.numbers import INVERSE, SurfaceType
from raytrace.io.zemax.operands import FAR, ROWS, Cell, word
from raytrace.io.zemax.optimization import (
    BOUNDLESS,
    CONFIGURATION_RULES,
    CURVATURE_PICKUP,
    CURVATURE_SOLVES,
    GIVEN,
    GLASS_NUMBERS,
    GLASS_RULES,
    SEMI_DIAMETER_RULES,
    THICKNESS_SOLVES,
    VARIABLE,
    listed,
    names,
)
from raytrace.io.zemax.surface_types import type_of, types
from raytrace.system.apertures import SHAPES
from raytrace.system.configurations import Operand, count, same, with_operands
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.surface import Surface

#: Powers of length of the words of a line, from 1, by its keyword; others have none.
_WORDS = {
    "ENPD": {1: 1},
    "SDMA": {3: 1},
    "CURV": {1: -1},
    "DISZ": {1: 1},
    "DIAM": {1: 1},
    "VDSZ": {1: 1, 2: 1},
    "PZUP": {3: 1},
    "OBDC": {1: 1, 2: 1},
    "UDAD": {2: 1, 3: 1},
    "SCBD": {4: 1, 5: 1},
    **{
        keyword: {k: power for k, power in enumerate(rule.powers, 1 + rule.from_surface) if power}
        for keyword, rule in THICKNESS_SOLVES.items()
    },
}
_APERTURES = {
    keyword: dict.fromkeys(range(1, 1 + (SHAPES[name].sizes or 0)), 1)
    for keyword, (name, _) in aperture_keywords().items()
}


def unit_named(millimetres: float, place: Place) -> str:
    """The name of a unit of length. Raises LensFileError for one that a .zmx file does not have."""
    for name in ("MM", "CM", "IN", "METER"):
        if MILLIMETRES[name] == millimetres:
            return name
    raise LensFileError(f"a unit of {millimetres!r} mm, expected 1, 10, 25.4 or 1000 (MM, CM, IN, METER)", place)


def in_unit(lines: Iterable[str], millimetres: float, place: Place) -> list[str]:
    """The lines of the system and the surfaces, in mm, in a unit of `millimetres`."""
    lines = list(lines)
    if millimetres == 1:
        return lines
    name, angles, row, found = unit_named(millimetres, place), False, types()["STANDARD"], []
    for line in lines:
        words = line.split()
        keyword = words[0] if words else ""
        if keyword == "UNIT":
            line = line.replace("MM", name, 1)
        if keyword == "FTYP":
            angles = words[1] == "0"
        if keyword == "TYPE":
            row = types()[words[1]]
        powers = _powers(words, row, angles)
        found.append(_converted(line, words, powers, millimetres) if powers else line)
    return found


def _powers(words: list[str], row: SurfaceType, angles: bool) -> dict[int, int | None]:
    """The power of length of the words of a line that have one; row: the type of its surface."""
    keyword = words[0] if words else ""
    if keyword in ("PARM", "PPAR"):
        power = row.parameters.get(int(words[1]), 0)
        position = 2 if keyword == "PARM" else 4
        power = 0 if power is INVERSE and keyword == "PPAR" else power
        return {position: power} if power != 0 and len(words) > position else {}
    if keyword == "XDAT":
        power = {1: 0, 2: 1}.get(int(words[1]), row.terms or 0)
        return {2: power} if power else {}
    if keyword == "CURV" and len(words) > 3 and int(words[2]) in CURVATURE_SOLVES:
        solved = CURVATURE_SOLVES[int(words[2])].powers
        return _WORDS["CURV"] | {k: power for k, power in enumerate(solved, 3) if power}
    if keyword in (FIELD_LISTS["x"].keywords[0], FIELD_LISTS["y"].keywords[0]):
        return {} if angles else dict.fromkeys(range(1, len(words)), 1)
    if keyword == "FEFD":
        return {} if angles else {1: 1, 2: 1}
    return _WORDS.get(keyword) or _APERTURES.get(keyword) or {}


def _converted(line: str, words: list[str], powers: dict[int, int | None], millimetres: float) -> str:
    indent = line[: len(line) - len(line.lstrip())]
    told = [in_file(word, powers[k], millimetres) if k in powers else word for k, word in enumerate(words)]
    return indent + " ".join(told)


def in_file(word: str, power: int | None, millimetres: float) -> str:
    """A number in powers of mm as one in powers of a unit of `millimetres`; infinity and 0 as they are."""
    if is_infinite(word) or not float(word):
        return word
    if power is INVERSE:
        length = Fraction(word) / Fraction(repr(millimetres))
        return str(Context(prec=40).divide(Decimal(length.numerator), Decimal(length.denominator)))
    number = float(word)
    start = number / millimetres**power if power >= 0 else number * millimetres**-power
    if not math.isfinite(start):
        return word
    return repr(next((one for one in _near(start) if _read(one, power, millimetres) == number), start))


def _near(number: float) -> Iterable[float]:
    """A number and its neighbours, nearest first."""
    yield number
    above = below = number
    for _ in range(4):
        above, below = math.nextafter(above, math.inf), math.nextafter(below, -math.inf)
        yield above
        yield below


def _read(number: float, power: int, millimetres: float) -> float:
    """As the reader has it, in the same order."""
    return number * millimetres**power if power >= 0 else number / millimetres**-power


def operand_lines(lens: Lens, body: Callable[[Lens], list[str]], file: str) -> list[str]:
    """MNUM and a line for every operand in every configuration.

    body: the lines of system and surfaces of a lens. Raises LensFileError for what they cannot tell.
    """
    own, lens = lens, zemax_environment.with_operands(lens, Place(file))
    if not lens.operands:
        return ["MNUM 1 1", 'MOFF   0   1 "" 0 0 0 1 1 0 0.0 ""']
    numbers = range(1, count(lens.operands) + 1)
    texts = [sections("\n".join(body(with_operands(lens, k))) + "\n", file, Draft(file, "zmx")) for k in numbers]
    lines = [f"MNUM {len(numbers)} {lens.current_configuration}"]
    rules = statuses(own, lens.operands)
    for position, operand in enumerate(lens.operands):
        _refuse_alike(operand, texts, Place(file))
        lines += [_line(operand, k, texts[k - 1], rules.get((position, k), ()), Place(file)) for k in numbers]
    return lines


def with_pickups(lines: list[str], lens: Lens, number: int, place: Place) -> list[str]:
    """The lines of a surface with the pickups by which it follows operands of other surfaces.

    Raises LensFileError for one that a .zmx file is not known to have.
    """
    for operand in lens.operands:
        first = operand.paths[0].path if operand.paths else ()
        for path, factor, offset in operand.paths[1:]:
            if path[:2] != ("surfaces", number) or number == operand.number or path[2] == "environment":
                continue
            name = "PRAM" if operand.name.startswith("PAR") else operand.name
            if name not in ("PRAM", "THIC", "CRVT", "GLSS") or path[2:] != first[2:] or path[2] == "phase":
                raise LensFileError(f"follows {operand} by a rule that is not written", place)
            if _is_told(lines, name, operand.parameter):
                continue
            if name == "CRVT" and offset:
                raise LensFileError(f"follows {operand} with an offset, which is not written", place)
            rule = f"{operand.number} {factor!r} {offset!r} 0"
            if name in ("PRAM", "THIC"):
                lines = [*lines, f"  PPAR {operand.parameter} {rule}" if name == "PRAM" else f"  PZUP {rule}"]
            else:
                lines = with_glass_line(lines) if name == "GLSS" else lines
                lines = [_picking(line, name, operand.number, factor) for line in lines]
    return lines


def _is_told(lines: list[str], name: str, parameter: int) -> bool:
    """Whether the lines of a surface tell a rule of its own for what an operand of a name moves."""
    starts = {"PRAM": f"  PPAR {parameter} ", "THIC": "  PZUP "}
    if name in starts:
        return any(line.startswith(starts[name]) for line in lines)
    keyword = {"CRVT": "CURV", "GLSS": "GLAS"}[name]
    return any(line.split()[0] == keyword and line.split()[2] not in ("0", "1") for line in lines)


def _picking(line: str, name: str, source: int, factor: float) -> str:
    """A line of a surface; that of its curvature or glass, by the name of the operand, with its pickup."""
    words = line.split()
    if name == "CRVT" and words[0] == "CURV":
        return f'  CURV {words[1]} 4 {source} {factor!r} 0 ""'
    return "  " + " ".join([*words[:2], "2", str(source), *words[4:]]) if (name, words[0]) == ("GLSS", "GLAS") else line


def _line(operand: Operand, configuration: int, text: Sections, rule: tuple[str, ...], place: Place) -> str:
    value = _word(operand, configuration, text, place)
    parameter = operand.parameter if operand.name in ("PRAM", "EDVA") else 0
    head = f"{operand.name:<4} {operand.number:>3} {configuration:>3}"
    if operand.numbers is None and not _is_number(value):
        status, words = rule or ("0", '0 1 1 0 0.0 ""')
        return f'{head} "{value}" {status} {parameter} {words}'
    status, words = rule or ("0", "0 1 1 1.0 0.0 0")
    return f"{head} {value} {status} {parameter} {words}"


def _word(operand: Operand, configuration: int, text: Sections, place: Place) -> str:
    """The value of an operand: the word in the file of its configuration, or its own where it stands for none."""
    if operand.paths and operand.name in ROWS and not zemax_environment.is_of_surfaces(operand):
        found = word(text, _cell(operand, configuration, place))
        if found is not None:
            return repr(FAR) if is_infinite(found) else found.replace('"', "'")
    if operand.numbers is not None:
        return exact(operand.numbers[configuration - 1], str(operand), place)
    return one_line(str(operand.values()[configuration - 1]), str(operand), place).replace('"', "'")


def _is_number(value: str) -> bool:
    return bool(value) and all(character in "0123456789+-.eE" for character in value)


def _cell(operand: Operand, configuration: int, place: Place) -> Cell:
    record = Record(operand.name, (), "", place, False)
    return Cell(operand.name, operand.number, operand.parameter, configuration, "", record)


def _refuse_alike(operand: Operand, texts: list[Sections], place: Place) -> None:
    """Glasses that a name does not tell apart, as model glasses, are no value of GLSS."""
    names = [_word(operand, k, text, place).upper() for k, text in enumerate(texts, 1)] if operand.media else []
    for k, name in enumerate(names):
        if not same(operand.media[k], operand.media[names.index(name)]):
            message = f"{operand} has two glasses named {name!r}; a .zmx file tells them by their names"
            raise LensFileError(message, place._replace(surface=operand.number))


Lines = list[str]


def margin(optimization_data: OptimizationData | None) -> str:
    """The line of SDMA."""
    percent, length = (0.0, 0.0) if optimization_data is None else optimization_data.semi_diameter_margin
    return f"SDMA {_spelled(percent)} 1 {_spelled(length)}"


def with_rules(lines: Lines, lens: Lens, number: int, place: Place) -> Lines:
    """The lines of a surface with its variables, solves and pickups. Raises LensFileError for what no line holds."""
    optimization_data = lens.optimization_data
    if optimization_data is None:
        return lines
    lines = _with_diameter(lines, optimization_data, number)
    own = [
        one
        for one in (*optimization_data.variables, *optimization_data.solves, *optimization_data.kept)
        if one.surface == number
    ]
    own = [one for one in own if one.operand is None and one.quantity != "semi_diameter"]
    parameters = _parameters(lens.surfaces[number]) if own else {}
    for one in own:
        if isinstance(one, Solve) and one.kind == "pickup" and one.source == number and one.quantity != "glass":
            continue  # a further number of the lens that the same number of the file stands for
        write = _WRITERS.get(one.quantity, _with_parameter)
        lines = write(lines, one, parameters, place)
    return lines


def _with_diameter(lines: Lines, optimization_data: OptimizationData, number: int) -> Lines:
    rules = [one for one in optimization_data.kept if (one.surface, one.quantity) == (number, "semi_diameter")]
    if number in optimization_data.semi_diameters:
        code, source = GIVEN, 0
    elif rules:
        code, source = _code_of(rules[0].kind, SEMI_DIAMETER_RULES), rules[0].source
    else:
        code, source = 0, 0
    return _changed(lines, "DIAM", {2: str(code), 3: str(source)})


def _code_of(kind: str, codes: dict[int, str]) -> int:
    """The code of a kind in a file: of one that is not known, the number in its name."""
    known = next((code for code, name in codes.items() if name == kind), None)
    return int(kind.rpartition(" ")[2]) if known is None else known


def _changed(lines: Lines, keyword: str, words: dict[int, str]) -> Lines:
    """The lines with other words, from 0, the keyword, in those of a keyword."""

    def change(line: str) -> str:
        told = line.split()
        if told[0] != keyword:
            return line
        told += ["0"] * (max(words) + 1 - len(told))
        return "  " + " ".join(words.get(k, word) for k, word in enumerate(told))

    return [change(line) for line in lines]


def _behind(lines: Lines, start: str, line: str) -> Lines:
    """The lines with one put in behind that which starts so, at the end where none does."""
    at = next((k for k, one in enumerate(lines) if f"{one} ".startswith(f"  {start} ")), len(lines) - 1)
    return [*lines[: at + 1], f"  {line}", *lines[at + 1 :]]


# -- a rule of each quantity ------------------------------------------------------------------------------------------


def _with_thickness(lines: Lines, one: Vary | Solve, parameters: dict, place: Place) -> Lines:
    return _behind(lines, "DISZ", _thickness(one, place))


def _thickness(one: Vary | Solve, place: Place) -> str:
    if isinstance(one, Vary):
        far = 1e3 * BOUNDLESS  # mm: none in metres, too
        ends = (max(-far, min(end, far)) for end in one.bounds or (0.0, 0.0))
        return f"VDSZ {' '.join(map(_spelled, ends))}"
    if one.kind == "variable":
        return "VDSZ 0 0"
    if one.kind == "pickup":
        return f"PZUP {one.source} {one.scale!r} {one.offset!r} 0"
    if one.kind == "PZUP":
        return " ".join(["PZUP", *map(_spelled, one.numbers)])
    for keyword, rule in THICKNESS_SOLVES.items():
        if rule.kind == one.kind:
            return " ".join([keyword, *([str(one.source)] if rule.from_surface else []), *map(_spelled, one.numbers)])
    raise _unheld(one, place)


def _with_curvature(lines: Lines, one: Vary | Solve, parameters: dict, place: Place) -> Lines:
    if isinstance(one, Vary):
        words = [str(VARIABLE), "0", "0"]
    elif one.kind == "pickup":
        words = [str(CURVATURE_PICKUP), str(one.source), repr(one.scale)]
        if one.offset:
            raise LensFileError("a pickup of a curvature with an offset; a .zmx file has none", place)
    else:
        code = _code_of(one.kind, {code: rule.kind for code, rule in CURVATURE_SOLVES.items()})
        words = [str(code), *map(_spelled, one.numbers)]
    words += ["0"] * (4 - len(words))
    return _changed(lines, "CURV", dict(enumerate(words, 2)))


def _with_conic(lines: Lines, one: Vary | Solve, parameters: dict, place: Place) -> Lines:
    if not isinstance(one, Vary):
        raise _unheld(one, place)
    return _behind(lines, "CONI", "VCON")


def _with_glass(lines: Lines, one: Vary | Solve, parameters: dict, place: Place) -> Lines:
    if isinstance(one, Vary):
        return _changed(lines, "GLAS", {1 + k: "1" for k, name in GLASS_NUMBERS.items() if name == one.quantity})
    words = {2: str(_code_of(one.kind, GLASS_RULES))} | ({3: str(one.source)} if one.kind == "pickup" else {})
    return _changed(with_glass_line(lines) if one.kind == "pickup" else lines, "GLAS", words)


def with_glass_line(lines: Lines) -> Lines:
    """The lines of a surface with one for its medium, which a surface in air leaves out."""
    if any(line.split()[0] == "GLAS" for line in lines):
        return lines
    return _behind(lines, "DISZ", f"GLAS {BLANK} 0 0 1.5 40 0 0 0 0 0 0")


def _with_parameter(lines: Lines, one: Vary | Solve, parameters: dict, place: Place) -> Lines:
    keyword, _, j = one.quantity.partition(" ")
    keyword, j = (keyword, int(j)) if keyword in ("PARM", "XDAT") and j else parameters.get(one.quantity, ("", 0))
    if not keyword:
        raise _unheld(one, place)
    if keyword == "XDAT":
        code = VARIABLE if isinstance(one, Vary) or one.kind == "variable" else _code_of(one.kind, {})
        further = [] if isinstance(one, Vary) else [*map(_spelled, one.numbers)]
        words = {3: str(code)} | dict(enumerate(further, 4))
        start = f"  XDAT {j} "
        return [_changed([line], "XDAT", words)[0] if line.startswith(start) else line for line in lines]
    if isinstance(one, Vary) or one.kind == "variable":
        return _behind(lines, f"PARM {j}", f"VPAR {j}")
    if one.kind == "pickup":
        return _behind(lines, f"PARM {j}", f"PPAR {j} {one.source} {one.scale!r} {one.offset!r} 0")
    return _behind(lines, f"PARM {j}", " ".join([f"PPAR {j}", *map(_spelled, one.numbers)]))


def _parameters(surface: Surface) -> dict[str, tuple[str, int]]:
    """PARM and XDAT of a surface by the names of the numbers of the lens that they stand for."""
    row = types().get(type_of(surface) or "")
    if row is None:
        return {}
    told = row.numbers(surface)._replace(size=surface.semi_diameter)
    found = {}
    for keyword, j in listed(row, told):
        for one in names(surface, row, told, keyword, j)[0]:
            found.setdefault(one.name, (keyword, j))
    return found


#: By quantity what writes a rule of it; a parameter or a datum by any other.
_WRITERS: dict[str, Callable[[Lines, Vary | Solve, dict, Place], Lines]] = {
    "thickness": _with_thickness,
    "curvature": _with_curvature,
    "conic": _with_conic,
    **dict.fromkeys(("glass", *GLASS_NUMBERS.values()), _with_glass),
}


def _unheld(one: Vary | Solve, place: Place) -> LensFileError:
    what = "variable" if isinstance(one, Vary) else f"rule {one.kind!r}"
    return LensFileError(f"a {what} of the {one.quantity}, which a .zmx file does not hold; leave it out", place)


def _spelled(number: float) -> str:
    """The shortest text that is read as a number again."""
    return str(int(number)) if number == int(number) and abs(number) < 1e6 and repr(number) != "-0.0" else repr(number)


# -- configurations ---------------------------------------------------------------------------------------------------


def statuses(lens: Lens, written: Sequence[Operand]) -> dict[tuple[int, int], tuple[str, str]]:
    """The status of a number and the words behind its parameter, by the position of its operand and configuration.

    written: the operands that are written, among them those of the lens.
    """
    if lens.optimization_data is None:
        return {}
    positions = {id(one): k for k, one in enumerate(written)}
    at = [positions.get(id(one)) for one in lens.operands]
    found = {}
    for one in (*lens.optimization_data.variables, *lens.optimization_data.solves, *lens.optimization_data.kept):
        if one.operand is not None and one.operand < len(at) and at[one.operand] is not None:
            found[at[one.operand], one.configuration] = _status(one, at)
    return found


def _status(one: Vary | Solve, at: Sequence[int | None]) -> tuple[str, str]:
    """The status, and the words behind the parameter."""
    if isinstance(one, Vary) or one.kind == "variable":
        return str(VARIABLE), "0 1 1 1.0 0.0 0"
    row = at[int(one.numbers[0])] if one.numbers else None
    words = f"0 {one.source} {0 if row is None else row + 1} {one.scale!r} {one.offset!r} 0"
    return str(_code_of(one.kind, CONFIGURATION_RULES)), words
