"""Arguments: what the integers of a merit function's rows name, a row a kind, and whether the lens has it."""

import dataclasses
from collections.abc import Callable

from raytrace.optimization.context import BadRow, Line, Operand
from raytrace.system.lens import Lens
from raytrace.tracing.launch import is_at_infinity


@dataclasses.dataclass(frozen=True)
class Argument:
    """What an integer names: in words, the smallest and the largest, and what a smallest of 0 means."""

    word: str
    first: Callable[[Lens], int]
    last: Callable[[Lens], int]
    nought: str = ""


def _image(lens: Lens) -> int:
    return len(lens.surfaces) - 1


#: By the names of `Operand.takes`.
ARGUMENTS = {
    "surface": Argument("surface", lambda lens: 0, _image, "the object"),
    "place": Argument("surface", lambda lens: int(is_at_infinity(lens)), _image, "the object, at a finite distance"),
    "met surface": Argument("surface", lambda lens: 1, _image),
    "contribution": Argument("surface", lambda lens: 0, lambda lens: _image(lens) - 1, "all of them"),
    "wavelength": Argument("wavelength", lambda lens: 0, lambda lens: len(lens.wavelengths), "the primary one"),
    "colour": Argument("wavelength", lambda lens: 0, lambda lens: len(lens.wavelengths), "all by their weights"),
    "shortest": Argument("wavelength", lambda lens: 0, lambda lens: len(lens.wavelengths), "the shortest"),
    "longest": Argument("wavelength", lambda lens: 0, lambda lens: len(lens.wavelengths), "the longest"),
    "field": Argument("field", lambda lens: 0, lambda lens: len(lens.fields.x), "the largest"),
    "configuration": Argument("configuration", lambda lens: 1, lambda lens: len(lens.configurations)),
    "primary": Argument("wavelength", lambda lens: 1, lambda lens: len(lens.wavelengths)),
}


def need(line: Line, kind: str, number: int, lens: Lens) -> int:
    """The number, if the lens has what it names. Raises BadRow."""
    argument = ARGUMENTS[kind]
    first, last = argument.first(lens), argument.last(lens)
    if not first <= number <= last:
        meant = f" (0: {argument.nought})" if argument.nought and first == 0 else ""
        here = f"{argument.word}s {first} to {last}" if last > first else f"{argument.word} {last} alone"
        raise BadRow(line, f"names {argument.word} {number}: this lens has {here}{meant}")
    return number


def need_all(line: Line, operand: Operand, lens: Lens) -> None:
    """Check the integers of a row. Raises BadRow."""
    for kind, number in zip(operand.takes, line.row.integers, strict=True):
        if kind:
            need(line, kind, number, lens)
