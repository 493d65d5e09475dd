"""Operands of arithmetic: functions of the values of other rows, before or after them.

Values are those of the rows as they are reported: in the unit of length of the merit function, without targets and
weights. A row without a number, as the root of a negative one, is nan and counts as lost.
"""

from collections.abc import Callable, Sequence
from functools import reduce

import numpy as np

from raytrace.maths.numerics import Dual, Number, value_of
from raytrace.optimization.lens_state import listed
from raytrace.optimization.operands.operand import (
    SETTINGS,
    BadRow,
    Evaluate,
    EvaluationContext,
    Line,
    Operand,
    Planner,
    RowValues,
)
from raytrace.system.optimization_data import Row

_ADDED = "; rows added by + count from 1 among themselves, as in [Row('DIMX'), Row('OPLT', 1)]"


def _row(line: Line, number: int, rows: Sequence[Row]) -> int:
    """The number of a row that has a value. Raises BadRow."""
    if not 1 <= number <= len(rows):
        raise BadRow(line, f"takes the value of row {number}: there are rows 1 to {len(rows)}{_ADDED}")
    operand = rows[number - 1].operand
    if operand in SETTINGS:
        raise BadRow(line, f"takes the value of row {number}, which has none: {operand}, {SETTINGS[operand]}")
    return number


def _one(line: Line, rows: Sequence[Row]) -> list[int]:
    return [_row(line, line.row.integers[0], rows)]


def _two(line: Line, rows: Sequence[Row]) -> list[int]:
    return [_row(line, number, rows) for number in line.row.integers]


def _range(line: Line, rows: Sequence[Row]) -> list[int]:
    """The numbers of all rows of a range that have a value; its ends may be text."""
    first, last = sorted(line.row.integers)
    if first < 1 or last > len(rows):
        raise BadRow(line, f"takes the values of rows {first} to {last}: there are rows 1 to {len(rows)}{_ADDED}")
    numbers = [number for number in range(first, last + 1) if rows[number - 1].operand not in SETTINGS]
    if not numbers:
        raise BadRow(line, f"takes the values of rows {first} to {last}: none of them has one")
    return numbers


def _operand(function: Callable, refers: Callable, text: str, convention: str = "", bounds: str = "") -> Operand:
    """function: of the row and of the values that it takes."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        taken = [(line.row, refers(line, planner.rows)) for line in lines]

        def evaluate(context: EvaluationContext) -> RowValues:
            with np.errstate(all="ignore"):
                numbers = [function(row, *(context.values[n] for n in rows)) for row, rows in taken]
                return RowValues(_finite(listed(numbers, context.state.count)))

        return evaluate

    return Operand(plan, text, convention=convention, refers=refers, bounds=bounds)


def _finite(number: Number) -> Number:
    """nan for an infinite number, with a derivative of 0."""
    if isinstance(number, Dual):
        return Dual(_finite(number.value), np.where(np.isfinite(number.slope), number.slope, 0.0))
    return np.where(np.isfinite(number), number, np.nan)


# -- their functions ---------------------------------------------------------------------------------------------------


def _in_angle(function: Callable) -> Callable:
    """A function of an angle in radians, or in degrees where the second integer is not 0."""
    return lambda row, a: function(np.deg2rad(a) if row.integers[1] else a)


def _to_angle(function: Callable) -> Callable:
    return lambda row, a: np.rad2deg(function(a)) if row.integers[1] else function(a)


def _logarithm(function: Callable) -> Callable:
    return lambda row, a: function(a) if value_of(a) > 0 else 0.0


def _folded(function: Callable) -> Callable:
    return lambda row, *values: reduce(function, values)


def _above(row: Row, a: Number) -> Number:
    return np.maximum(a, row.target)


def _below(row: Row, a: Number) -> Number:
    return np.minimum(a, row.target)


def _spread(row: Row, *values: Number) -> Number:
    """target + Σ (|v - mean| - target) over the values further from the mean than the target."""
    mean = sum(values) / len(values)
    return row.target + sum(np.maximum(np.abs(value - mean) - row.target, 0.0) for value in values)


_FLAG = "; in degrees where the second integer is not 0"
_SIDED = "the target itself where that is met"
_ROWS = "rows a to b"
_SKIPS = "rows of text between them do not count"

ARITHMETIC = {
    "CONS": _operand(lambda row: row.target, lambda line, rows: [], "the target itself, a number for other rows"),
    "OPVA": _operand(lambda row, a: a, _one, "value of row a"),
    "DIFF": _operand(lambda row, a, b: a - b, _two, "row a less row b"),
    "SUMM": _operand(lambda row, a, b: a + b, _two, "row a and row b together"),
    "PROD": _operand(lambda row, a, b: a * b, _two, "row a times row b"),
    "DIVI": _operand(lambda row, a, b: a / b, _two, "row a by row b"),
    "PROB": _operand(lambda row, a: a * row.numbers[0], _one, "row a times the number in the column of Hx"),
    "DIVB": _operand(lambda row, a: a / np.float64(row.numbers[0]), _one, "row a by the number in the column of Hx"),
    "RECI": _operand(lambda row, a: 1 / a, _one, "1 / row a"),
    "ABSO": _operand(lambda row, a: np.abs(a), _one, "absolute value of row a"),
    "SQRT": _operand(lambda row, a: np.sqrt(a), _one, "root of row a", "lost where row a is negative"),
    "OSUM": _operand(lambda row, *values: sum(values), _range, f"sum of {_ROWS}", _SKIPS),
    "QSUM": _operand(
        lambda row, *values: np.sqrt(sum(v * v for v in values)), _range, f"root of the squares' sum of {_ROWS}", _SKIPS
    ),
    "MINN": _operand(_folded(np.minimum), _range, f"smallest of {_ROWS}", _SKIPS),
    "MAXX": _operand(_folded(np.maximum), _range, f"largest of {_ROWS}", _SKIPS),
    "EQUA": _operand(
        _spread,
        _range,
        f"target + how much {_ROWS} are further from their mean than the target, all together",
        "what lies within the target of the mean does not count; " + _SKIPS,
    ),
    "SINE": _operand(_in_angle(np.sin), _one, "sine of row a" + _FLAG),
    "COSI": _operand(_in_angle(np.cos), _one, "cosine of row a" + _FLAG),
    "TANG": _operand(_in_angle(np.tan), _one, "tangent of row a" + _FLAG),
    "ASIN": _operand(_to_angle(np.arcsin), _one, "inverse sine of row a" + _FLAG),
    "ACOS": _operand(_to_angle(np.arccos), _one, "inverse cosine of row a" + _FLAG),
    "ATAN": _operand(_to_angle(np.arctan), _one, "inverse tangent of row a" + _FLAG),
    "LOGT": _operand(_logarithm(np.log10), _one, "decimal logarithm of row a, 0 where that is not positive"),
    "LOGE": _operand(_logarithm(np.log), _one, "natural logarithm of row a, 0 where that is not positive"),
    "OPGT": _operand(_below, _one, f"row a is meant to be above the target: its value, or {_SIDED}", bounds=">="),
    "OPLT": _operand(_above, _one, f"row a is meant to be below the target: its value, or {_SIDED}", bounds="<="),
    "ABGT": _operand(
        lambda row, a: _below(row, np.abs(a)),
        _one,
        f"|row a| is meant to be above the target: its value, or {_SIDED}",
        bounds=">=",
    ),
    "ABLT": _operand(
        lambda row, a: _above(row, np.abs(a)),
        _one,
        f"|row a| is meant to be below the target: its value, or {_SIDED}",
        bounds="<=",
    ),
}
