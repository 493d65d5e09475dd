"""Hold: what an optimisation keeps to, as words name it: "efl=50 total_track<=80 distortion<=2% bfd>=30".

A word is a row of WORDS, a relation and a number; efl@2=100 holds in configuration 2, thickness:3-5>=20 of the sum of
these thicknesses, and REAY(8,0,0,1,0,0)=2 of any operand by its arguments.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.variables import bends_light
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.system.parameter_paths import joined, sensor
from raytrace.words import did_you_mean

#: Relations by how they may be written.
RELATIONS = {"=": "=", "==": "=", "<=": "<=", "<": "<=", "≤": "<=", ">=": ">=", ">": ">=", "≥": ">="}


class BadHold(ValueError):
    """What is to be held cannot be read, or is nothing that the lens has."""


@dataclass(frozen=True)
class Condition:
    """What is held: the value of a row related to its target, lengths in mm; in a configuration, 0 the current one.

    relation: "=", "<=" or ">="; name: as it is called in tables, by default the operand of the row.
    """

    row: Row
    relation: str = "="
    configuration: int = 0
    name: str = ""


#: The arguments of a row: two whole numbers, four numbers.
Arguments = tuple[tuple[int, int], tuple[float, float, float, float]]

_NONE: Arguments = ((0, 0), (0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Word:
    """What may be held by a name: an operand with its arguments, in mm unless `unit` says otherwise.

    one_sided: whether the operand tells only what lies beyond its target, so that it has to be "<=".
    """

    operand: str
    text: str
    unit: str = "mm"
    arguments: Callable[[Lens], Arguments] = lambda lens: _NONE
    one_sided: bool = False


def conditions_of(lens: Lens, hold: str | Sequence[str] | None) -> tuple[Condition, ...]:
    """The conditions that words name. Raises BadHold."""
    text = re.sub(r"\s*([<>=≤≥,(])\s*|\s+([)%])", r"\1\2", joined(hold or ""))
    return tuple(_condition(lens, word) for word in text.split())


def _condition(lens: Lens, word: str) -> Condition:
    parts = re.fullmatch(r"([^<>=≤≥@]+?)(?:@(\d+))?(<=|>=|==|[<>=≤≥])(.+)", word)
    if not parts:
        raise BadHold(f"`hold`: {word!r}: expected a name, = or <= or >=, and a number, as efl=50")
    name, configuration, relation, number = parts[1], int(parts[2] or 0), RELATIONS[parts[3]], parts[4]
    if configuration > len(lens.configurations):
        raise BadHold(f"`hold`: {word!r}: configuration {configuration}; this lens has {len(lens.configurations)}")
    one = lens.configuration(configuration) if configuration else lens
    known, arguments = _named(one, name, word)
    if known.one_sided and relation != "<=":
        raise BadHold(f"`hold`: {word!r}: {name} is the largest that there is; expected {name}<={number}")
    row = Row(known.operand, *arguments, target=_number(number, known.unit, word))
    return Condition(row, relation, configuration, name)


def _named(lens: Lens, name: str, word: str) -> tuple[Word, Arguments]:
    """What a name stands for, and its arguments in a lens."""
    if name in WORDS:
        return WORDS[name], WORDS[name].arguments(lens)
    if sum_of := re.fullmatch(r"thickness:(\d+)(?:-(\d+))?", name):
        first, last = int(sum_of[1]), int(sum_of[2] or sum_of[1])
        if not 0 <= first <= last <= sensor(lens):
            raise BadHold(f"`hold`: {word!r}: this lens has gaps behind surfaces 0 to {sensor(lens)}")
        return Word("TTHI", "a sum of thicknesses"), ((first, last), _NONE[1])
    if operand := re.fullmatch(r"([A-Z][A-Z0-9]{3})(?:\(([^()]*)\))?", name):
        if operand[1] in OPERANDS:
            return Word(operand[1], "", ""), _arguments(operand[2] or "", word)
        raise BadHold(f"`hold`: {word!r}: no operand {operand[1]}{did_you_mean(operand[1], OPERANDS)}")
    meant = did_you_mean(name, WORDS)
    raise BadHold(f"`hold`: {word!r}: {name!r} is nothing to hold; expected one of {', '.join(WORDS)}{meant}")


def _arguments(text: str, word: str) -> Arguments:
    """Arguments as they stand in a row: two whole numbers, then up to four numbers."""
    try:
        found = [float(part) for part in text.split(",") if part]
        first = [int(part) for part in found[:2]]
    except ValueError:
        found, first = [0.0] * 7, []
    if len(found) > 6 or first != found[:2]:
        raise BadHold(f"`hold`: {word!r}: expected two whole numbers and up to four numbers, as REAY(8,0,0,1,0,0)")
    first, others = first + [0] * (2 - len(first)), found[2:] + [0.0] * (4 - len(found[2:]))
    return (first[0], first[1]), (others[0], others[1], others[2], others[3])


def _number(text: str, unit: str, word: str) -> float:
    number = text.removesuffix(unit) if unit else text
    try:
        found = float(number)
    except ValueError:
        found = float("nan")
    if not abs(found) < float("inf"):
        raise BadHold(f"`hold`: {word!r}: {text!r} is no number" + (f" in {unit}" if unit else ""))
    return found


# -- arguments in a lens -----------------------------------------------------------------------------------------------


def _behind_the_lens(lens: Lens) -> Arguments:
    """From the last surface that bends light to the image."""
    bending = [k for k in range(1, sensor(lens) + 1) if bends_light(lens, k)]
    return (max(bending, default=1), sensor(lens)), _NONE[1]


def _chief_ray(lens: Lens) -> Arguments:
    """The chief ray of the largest field on the image."""
    radius = torch.hypot(lens.fields.x, lens.fields.y)
    if not bool(radius.any()):
        raise BadHold("`hold`: all fields are on the axis: there is no chief ray beside it")
    largest = int(radius.argmax())
    field = (float(part[largest] / radius[largest]) for part in (lens.fields.x, lens.fields.y))
    return (len(lens.surfaces) - 1, 0), (*field, 0.0, 0.0)


def _outer_colours(lens: Lens) -> Arguments:
    """The shortest and the longest wavelength."""
    return (int(lens.wavelengths.argmin()) + 1, int(lens.wavelengths.argmax()) + 1), _NONE[1]


#: What may be held, by name.
WORDS = {
    "efl": Word("EFFL", "effective focal length"),
    "f_number": Word("ISFN", "focal length / entrance pupil diameter", ""),
    "working_f_number": Word("WFNO", "of the real cone on the axis", ""),
    "numerical_aperture": Word("ISNA", "of the image, paraxial", ""),
    "magnification": Word("PMAG", "paraxial, of an object at a finite distance", ""),
    "angular_magnification": Word("AMAG", "paraxial, of the chief ray", ""),
    "total_track": Word("TOTR", "from surface 1 to the image"),
    "bfd": Word("TTHI", "from the last surface that bends light to the image", arguments=_behind_the_lens),
    "image_height": Word("REAR", "of the chief ray of the largest field", arguments=_chief_ray),
    "paraxial_image_height": Word("PIMH", "of the largest field"),
    "distortion": Word("DIMX", "the largest of all fields", "%", one_sided=True),
    "petzval_radius": Word("PETZ", "of the image without astigmatism"),
    "entrance_pupil_diameter": Word("EPDI", "of the beam"),
    "entrance_pupil": Word("ENPP", "its place, from surface 1"),
    "exit_pupil": Word("EXPP", "its place, from the image"),
    "chief_ray_angle": Word("RAID", "between the chief ray of the largest field and the image's axis", "°", _chief_ray),
    "lateral_colour": Word("LACL", "between the outer wavelengths", arguments=_outer_colours),
    "axial_colour": Word("AXCL", "between the outer wavelengths", arguments=_outer_colours),
}
