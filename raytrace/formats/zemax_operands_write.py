"""The configurations of a lens as the multi-configuration operands of a .zmx file.

The word of an operand is the one that it stands for in the file of the lens in that configuration.
"""

from collections.abc import Callable

from raytrace.formats import zemax_environment
from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, Place
from raytrace.formats.spelling import exact, is_infinite, one_line
from raytrace.formats.zemax_intent_write import statuses, with_glass_line
from raytrace.formats.zemax_keywords import Record, Sections, sections
from raytrace.formats.zemax_operands import FAR, ROWS, Cell, word
from raytrace.system.configurations import Operand, count, same, with_operands
from raytrace.system.lens import Lens


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
        first = operand.places[0].path if operand.places else ()
        for path, factor, offset in operand.places[1:]:
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
    if operand.places and operand.name in ROWS and not zemax_environment.is_of_surfaces(operand):
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
