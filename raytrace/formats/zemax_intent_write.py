"""The intent of a lens as lines of a .zmx file: `zemax_intent` and `zemax_rules` undone.

The lines of a surface are those that a lens without an intent has; words in them are changed, and lines put in.
"""

from collections.abc import Callable, Sequence

from raytrace.formats.source import LensFileError, Place
from raytrace.formats.zemax_keywords import BLANK
from raytrace.formats.zemax_names import listed, names
from raytrace.formats.zemax_rules import (
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
)
from raytrace.formats.zemax_types import type_of, types
from raytrace.system.configurations import Operand
from raytrace.system.intent import Intent, Solve, Vary
from raytrace.system.lens import Lens
from raytrace.system.surface import Surface

Lines = list[str]


def margin(intent: Intent | None) -> str:
    """The line of SDMA."""
    percent, length = (0.0, 0.0) if intent is None else intent.semi_diameter_margin
    return f"SDMA {_spelled(percent)} 1 {_spelled(length)}"


def with_rules(lines: Lines, lens: Lens, number: int, place: Place) -> Lines:
    """The lines of a surface with its variables, solves and pickups. Raises LensFileError for what no line holds."""
    intent = lens.intent
    if intent is None:
        return lines
    lines = _with_diameter(lines, intent, number)
    own = [one for one in (*intent.variables, *intent.solves, *intent.kept) if one.surface == number]
    own = [one for one in own if one.operand is None and one.quantity != "semi_diameter"]
    parameters = _parameters(lens.surfaces[number]) if own else {}
    for one in own:
        if isinstance(one, Solve) and one.kind == "pickup" and one.source == number and one.quantity != "glass":
            continue  # a further number of the lens that the same number of the file stands for
        write = _WRITERS.get(one.quantity, _with_parameter)
        lines = write(lines, one, parameters, place)
    return lines


def _with_diameter(lines: Lines, intent: Intent, number: int) -> Lines:
    rules = [one for one in intent.kept if (one.surface, one.quantity) == (number, "semi_diameter")]
    if number in intent.semi_diameters:
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
    if lens.intent is None:
        return {}
    positions = {id(one): k for k, one in enumerate(written)}
    at = [positions.get(id(one)) for one in lens.operands]
    found = {}
    for one in (*lens.intent.variables, *lens.intent.solves, *lens.intent.kept):
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
