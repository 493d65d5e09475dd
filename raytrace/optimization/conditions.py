"""Conditions of a lens: quantities and their targets, which every optimisation meets exactly.

Syntax: "efl=50 total_track<=80 distortion<=2% bfd>=30 edge>=1": a name of WORDS or LIMITS, a relation and a number;
efl@2=100 applies to configuration 2, thickness:3-5>=20 to the sum of these thicknesses, and REAY(8,0,0,1,0,0)=2 to any
operand by its arguments. A name alone, as "efl", keeps the number of the lens as it is; distortion, a limit, does not
become larger. A condition with "off:" in front is stored, and not met.

A lens stores its conditions where OpticStudio does, in its merit function: a row of negative weight is met exactly,
as a limit on one side if its operand is one (MNCG, OPLT of another row), else as an equality. The rows of a condition
that is off have the weight 0 and follow a row of text, "BLNK off:".
"""

import dataclasses
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from raytrace.analysis.chief import SAMPLES
from raytrace.optimization.merit import (
    DefaultMerit,
    Evaluation,
    Merit,
    configurations_of,
    in_unit,
    merit_for,
    rereferenced,
)
from raytrace.optimization.operands.aberrations import unvignetted
from raytrace.optimization.operands.boundaries import AT_RIM, BOUNDARIES
from raytrace.optimization.operands.operand import Line
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.variables import BadHold, DesignVariables, constraint_words, has_power, split_constraint
from raytrace.system.dimensions import ARGUMENTS
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Row
from raytrace.system.parameter_paths import sensor
from raytrace.tracing.paraxial import largest_field
from raytrace.words import RaytraceWarning, calling_level, did_you_mean, option

#: The word in front of a condition that is stored and not met.
OFF = "off:"


class ReplacedCondition(RaytraceWarning):
    """A condition of the lens that another one of the same quantity replaces."""


@dataclass(frozen=True)
class Condition:
    """A quantity, the value of a row, related to its target.

    row: with the target, lengths in mm; relation: "=", "<=" or ">="; configuration: 0 for the current one; name: of the
    quantity, by default the operand of the row; before: rows whose values a row of arithmetic takes, numbered from 1;
    on: whether it is met, or only stored.
    """

    row: Row
    relation: str = "="
    configuration: int = 0
    name: str = ""
    before: tuple[Row, ...] = ()
    on: bool = True

    @property
    def quantity(self) -> str:
        """The quantity in the syntax of `hold`, as "efl@2"."""
        return f"{self.name or self.row.name}{f'@{self.configuration}' if self.configuration else ''}"

    @property
    def is_worded(self) -> bool:
        """Whether its words are constraint syntax, and not of a row that takes values of others, or of a function."""
        return isinstance(self.row.operand, str) and not self.before

    @property
    def unit(self) -> str:
        """Of the target, "" for mm and plain numbers."""
        unit = WORDS[self.name].unit if self.name in WORDS else ""
        return "" if unit == "mm" else unit

    def __str__(self) -> str:
        """In the syntax of `hold`, with all digits of the target."""
        target = f"{self.row.target:.12g}"
        target = target if float(target) == self.row.target else repr(float(self.row.target))
        return f"{'' if self.on else OFF}{self.quantity}{self.relation}{target}{self.unit}"

    def excludes(self, other: "Condition", current: int) -> bool:
        """Whether another condition is of the same quantity and on the same side; current: configuration."""
        same = [
            (c.row.operand, c.row.integers, c.row.numbers, c.before, c.configuration or current) for c in (self, other)
        ]
        return same[0] == same[1] and (self.relation == other.relation or "=" in (self.relation, other.relation))


#: The arguments of a row: two integers and four numbers.
Arguments = tuple[tuple[int, int], tuple[float, float, float, float]]

_NONE: Arguments = ((0, 0), (0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Word:
    """A quantity of conditions: an operand with its arguments, in mm or `unit`."""

    operand: str
    text: str
    unit: str = "mm"
    arguments: Callable[[Lens], Arguments] = lambda lens: _NONE


def conditions_of(lens: Lens, hold: str | Sequence[str | Condition] | None) -> tuple[Condition, ...]:
    """The conditions of constraint syntax, or as they are. Raises BadHold."""
    listed = [hold] if isinstance(hold, str) else hold or ()
    words = constraint_words([word for word in listed if isinstance(word, str)])
    return *(_condition(lens, word) for word in words), *(c for c in listed if isinstance(c, Condition))


def conditions_in_unit(lens: Lens, hold: str | Sequence[str | Condition] | None, unit: float) -> tuple[Condition, ...]:
    """The conditions of `hold` that are on, from mm to the unit of length of the merit function."""
    return tuple(
        dataclasses.replace(condition, row=in_unit(condition.row, 1.0, unit))
        for condition in conditions_of(lens, hold)
        if condition.on
    )


def _condition(lens: Lens, word: str) -> Condition:
    name, configuration, relation, number = split_constraint(word.removeprefix(OFF))
    if configuration > len(lens.configurations):
        raise BadHold(
            f"{option('hold')}: {word!r}: configuration {configuration}; this lens has {len(lens.configurations)}"
        )
    view, last = lens.configuration(configuration) if configuration else lens, sensor(lens)
    surfaces = re.fullmatch(r"([a-z]\w*)(?::(\d+)(?:-(\d+))?)?", name)
    kind = surfaces[1] if surfaces else ""
    if surfaces and surfaces[2] and kind in ("thickness", *LIMITS):
        first, end = int(surfaces[2]), int(surfaces[3] or surfaces[2])
        if not (0 if kind == "thickness" else 1) <= first <= end <= last:
            least = 0 if kind == "thickness" else 1
            raise BadHold(f"{option('hold')}: {word!r}: this lens has gaps behind surfaces {least} to {last}")
    if name in WORDS:
        known = WORDS[name]
        arguments = known.arguments(view)
    elif kind == "thickness" and surfaces and surfaces[2]:
        known, arguments = Word("TTHI", "a sum of thicknesses"), ((first, end), _NONE[1])
    elif kind in LIMITS:
        if relation not in LIMITS[kind].operands or not number:
            sides = " or ".join(f"{name}{side}{number or '1'}" for side in LIMITS[kind].operands)
            raise BadHold(f"{option('hold')}: {word!r}: {name} is a limit on one side; expected {sides}")
        operand, numbers = LIMITS[kind].operands[relation], LIMITS[kind].numbers
        known = Word(operand, LIMITS[kind].text)
        arguments = ((first, end) if surfaces and surfaces[2] else _whole(lens, operand)), numbers
    elif row := re.fullmatch(r"([A-Z][A-Z0-9]{3})(?:\(([^()]*)\))?", name):
        if row[1] not in OPERANDS:
            raise BadHold(f"{option('hold')}: {word!r}: no operand {row[1]}{did_you_mean(row[1], map(str, OPERANDS))}")
        known, arguments = Word(row[1], "", ""), _arguments(row[2] or "", word)
    else:
        names = (*WORDS, *LIMITS)
        meant = f"; did you mean {_INSTEAD[name.lower()]}?" if name.lower() in _INSTEAD else did_you_mean(name, names)
        raise BadHold(
            f"{option('hold')}: {word!r}: {name!r} is nothing to hold; expected one of {', '.join(names)}{meant}"
        )
    bounds, is_on = OPERANDS[known.operand].bounds, not word.startswith(OFF)
    if not number:
        held = Row(known.operand, *arguments)
        held = dataclasses.replace(held, target=_number_of(view, held, word))
        return Condition(held, bounds or relation, configuration, name, on=is_on)
    if bounds and relation != bounds:
        raise BadHold(f"{option('hold')}: {word!r}: {name} is a limit on one side; expected {name}{bounds}{number}")
    try:
        target = float(number.removesuffix(known.unit) if known.unit else number)
    except ValueError:
        target = float("nan")
    if not abs(target) < float("inf"):
        unit = f" in {known.unit}" if known.unit else ""
        raise BadHold(f"{option('hold')}: {word!r}: {number!r} is no number{unit}")
    return Condition(Row(known.operand, *arguments, target=target), relation, configuration, name, on=is_on)


def _number_of(lens: Lens, row: Row, word: str) -> float:
    """The number of a row of a lens as it is. Raises BadHold."""
    number = float(Evaluation(DesignVariables(lens), (row,))(np.zeros(0)).values[0])
    if not np.isfinite(number):
        raise BadHold(f"{option('hold')}: {word!r} keeps the number of the lens as it is, which is {number:g}")
    return number


def _arguments(text: str, word: str) -> Arguments:
    """The arguments of a row from text: two integers, then up to four numbers."""
    try:
        numbers = [float(part) for part in text.split(",") if part]
        first = [int(part) for part in numbers[:2]]
    except ValueError:
        numbers, first = [0.0] * 7, []
    if len(numbers) > 6 or first != numbers[:2]:
        raise BadHold(
            f"{option('hold')}: {word!r}: expected two whole numbers and up to four numbers, as REAY(8,0,0,1,0,0)"
        )
    first, others = first + [0] * (2 - len(first)), numbers[2:] + [0.0] * (4 - len(numbers[2:]))
    return (first[0], first[1]), (others[0], others[1], others[2], others[3])


# -- arguments in a lens -----------------------------------------------------------------------------------------------


def _behind_the_lens(lens: Lens) -> Arguments:
    """The gaps from the last powered surface to the image."""
    bending = [k for k in range(1, sensor(lens) + 1) if has_power(lens, k)]
    return (max(bending, default=1), sensor(lens)), _NONE[1]


def _chief_ray(lens: Lens) -> Arguments:
    """The ray of the largest field through the centre of its pupil, vignetting applied, on the image."""
    if not (extent := lens.fields.extent):
        raise BadHold(f"{option('hold')}: all fields are on the axis: there is no off-axis chief ray")
    x, y = (largest_field(lens)[:, 0] / extent).tolist()
    return (len(lens.surfaces) - 1, 0), (x, y, 0.0, 0.0)


def _through_stop(lens: Lens) -> Arguments:
    """The ray of the largest field through the centre of the stop, without vignetting factors, on the image."""
    surface, (x, y, *_) = _chief_ray(lens)
    return surface, (x, y, *unvignetted(lens, (x, y)))


def _curve(lens: Lens) -> Arguments:
    """The fields of the curve of `analysis.chief.distortion`."""
    return (0, 0), (0.0, float(SAMPLES), 0.0, 0.0)


def _outer_colours(lens: Lens) -> Arguments:
    """The shortest and the longest wavelength."""
    return (int(lens.wavelengths.argmin()) + 1, int(lens.wavelengths.argmax()) + 1), _NONE[1]


#: Names of quantities in other programs, and their name in constraint syntax.
_INSTEAD = {
    **dict.fromkeys(("bfl", "back_focal_length", "back_focal_distance"), "bfd"),
    **dict.fromkeys(("focal_length", "effective_focal_length", "efy"), "efl"),
    **dict.fromkeys(("ttl", "oal", "track", "length"), "total_track"),
    **dict.fromkeys(("fno", "f#", "f/#"), "f_number"),
    "epd": "entrance_pupil_diameter",
    "na": "numerical_aperture",
}

#: Quantities of constraint syntax; each is the number of the analysis of that name.
WORDS = {
    "efl": Word("EFFL", "effective focal length"),
    "f_number": Word("ISFN", "focal length in air / entrance pupil diameter", ""),
    "working_f_number": Word("WFNO", "of the real cone on the axis", ""),
    "numerical_aperture": Word("ISNA", "of the image, paraxial", ""),
    "magnification": Word("PMAG", "paraxial, of an object at a finite distance", ""),
    "angular_magnification": Word("AMAG", "paraxial, of the chief ray", ""),
    "total_track": Word("TOTR", "from the first vertex to the image"),
    "bfd": Word("TTHI", "from the last powered surface to the image", arguments=_behind_the_lens),
    "image_height": Word(
        "REAR",
        "from the vertex of the sensor, of the ray of the largest field through the centre of the stop",
        arguments=_through_stop,
    ),
    "paraxial_image_height": Word("PIMH", "of the largest field"),
    "distortion": Word("DIMX", "the largest absolute value from the axis to the largest field", "%", _curve),
    "petzval_radius": Word("PETZ", "of the image without astigmatism"),
    "entrance_pupil_diameter": Word("EPDI", "of the beam"),
    "entrance_pupil": Word("ENPP", "distance from surface 1"),
    "exit_pupil": Word("EXPP", "distance from the image"),
    "chief_ray_angle": Word("RAID", "between the chief ray of the largest field and the image's axis", "°", _chief_ray),
    "lateral_colour": Word("LACL", "between the outer wavelengths", arguments=_outer_colours),
    "axial_colour": Word("AXCL", "between the outer wavelengths", arguments=_outer_colours),
}


@dataclass(frozen=True)
class Limit:
    """A limit of thicknesses, mm, of all elements or spaces: its operand for each relation; numbers: of its rows."""

    operands: dict[str, str]
    text: str
    numbers: tuple[float, float, float, float] = _NONE[1]


#: Limits of constraint syntax, of all surfaces, or of some, as edge:1-4>=1.
LIMITS = {
    "glass_thickness": Limit({">=": "MNCG", "<=": "MXCG"}, "of glass on the axis"),
    "air_thickness": Limit({">=": "MNCA", "<=": "MXCA"}, "of air on the axis; no largest in front of the image"),
    "edge": Limit({">=": "MNEG", "<=": "MXEG"}, "of glass at the rim that both surfaces reach", AT_RIM),
    "air_edge": Limit({">=": "MNEA", "<=": "MXEA"}, "of air at the rim that both surfaces reach", AT_RIM),
}


def _whole(lens: Lens, operand: str) -> tuple[int, int]:
    """The surfaces of a limit of all elements or spaces; the space in front of the image has no largest thickness."""
    return 1, sensor(lens) - (operand in ("MXCA", "MXEA"))


# -- conditions that a lens stores -------------------------------------------------------------------------------------


def stored_conditions(lens: Lens) -> tuple[Condition, ...]:
    """`Lens.conditions`: those of its merit function, in the order of the rows. Raises BadHold."""
    data = lens.optimization_data
    return () if data is None else tuple(condition for _, condition in _of_rows(lens, data.merit, data.unit))


def with_conditions(lens: Lens, conditions: str | Sequence[str | Condition], *, only: bool = False) -> Lens:
    """`Lens.with_conditions`."""
    data, new = lens.optimization_data, conditions_of(lens, conditions)
    if data is None:
        if not new:
            return lens
        sized = tuple(k for k, surface in enumerate(lens.surfaces) if surface.semi_diameter)
        data = OptimizationData(semi_diameters=sized)
    old, current = [*_of_rows(lens, data.merit, data.unit, checked=False)], lens.current_configuration
    same = {c for _, c in old if c in new}
    gone = {k for k, c in old if c not in same and (only or any(other.excludes(c, current) for other in new))}
    gone |= {text for k, text in _off_rows(data.merit).items() if k in gone}
    rows = list(without_rows(data.merit, gone))
    for condition in new:
        if condition not in same:
            rows += _rows_of(condition, lens, rows, data.unit)
    return dataclasses.replace(lens, optimization_data=dataclasses.replace(data, merit=tuple(rows)))


def has_other_rows(lens: Lens) -> bool:
    """Whether the merit function of a lens has rows other than its conditions, and settings of them."""
    data = with_conditions(lens, (), only=True).optimization_data
    return data is not None and any(row.operand not in ("CONF", "PRIM") for row in data.merit)


def specified(
    lens: Lens,
    merit: Merit | DefaultMerit | Sequence[Row] | str | None,
    hold: str | Sequence[str | Condition] | None,
    *,
    stored: bool = True,
) -> tuple[Merit, tuple[Condition, ...]]:
    """The merit function of an optimisation, without its conditions, and all conditions, also off ones, in mm.

    These are the conditions of the lens, if `stored`, of rows of negative weight of `merit`, and of `hold`, each of
    which replaces the earlier conditions of the same quantity; hold None: without the conditions of the lens. Warns
    ReplacedCondition. Raises BadHold.
    """
    function, current = merit_for(lens, merit), lens.current_configuration
    among = [*_of_rows(lens, function.rows, function.unit)]
    added = conditions_of(lens, hold)
    conditions = stored_conditions(lens)
    of_lens = conditions if stored and hold is not None else ()
    data = lens.optimization_data
    of_file = len(data.merit) if data is not None and function.rows[: len(data.merit)] == data.merit else 0
    of_rows = [condition for k, condition in among if k > of_file]
    for before in conditions:
        if before.on and any(c.excludes(before, current) and c != before for c in added):
            other = next(c for c in added if c.excludes(before, current))
            message = f"{option('hold')}: {other} replaces {before}, a condition of the lens"
            warnings.warn(message, ReplacedCondition, stacklevel=calling_level())
    listed: list[Condition] = []
    for group in (of_lens, of_rows, added):
        listed = [c for c in listed if not any(other.excludes(c, current) for other in group)] + [*group]
    unit = 1.0 if data is None else data.unit
    if any(c.before for c in of_lens) and unit != function.unit:
        raise BadHold(
            f"{option('merit')}: {next(c for c in of_lens if c.before)} takes values of other rows, in units of "
            f"{unit:g} mm, and the merit function is in units of {function.unit:g} mm: use the unit of the file"
        )
    exact = {k: 0.0 for k, condition in among if condition.on}
    return function.with_weights(exact) if exact else function, tuple(listed)


def _of_rows(lens: Lens, rows: Sequence[Row], unit: float, *, checked: bool = True) -> Iterator[tuple[int, Condition]]:
    """The conditions among rows, lengths of the row in mm, each with the number of its row, from 1.

    checked: raise BadHold for a surface that the lens does not have.
    """
    configurations = configurations_of(rows, lens.current_configuration)
    several, off = any(row.operand == "CONF" for row in rows), _off_rows(rows)
    for k, row in enumerate(rows, 1):
        is_off = k in off
        if row.operand in OPERANDS and (row.weight < 0 or is_off):
            condition = _of_row(rows, k, unit)
            if several and not any(other.operand == "CONF" for other in condition.before):
                condition = dataclasses.replace(condition, configuration=configurations[k - 1])
            if checked:
                _check_surfaces(lens, condition, k)
            yield k, dataclasses.replace(condition, name=_name(lens, condition, k), on=not is_off)


def _off_rows(rows: Sequence[Row]) -> dict[int, int]:
    """The rows of conditions that are off, from 1, and the row of text above each."""
    off = {}
    for k, row in enumerate(rows, 1):
        if row.operand == "BLNK" and row.text == OFF and k < len(rows) and not rows[k].weight:
            sided = k + 1 < len(rows) and not rows[k + 1].weight and _taken(rows, k + 2) == [k + 1]
            off[k + 2 if sided else k + 1] = k
    return off


def _of_row(rows: Sequence[Row], k: int, unit: float) -> Condition:
    """The condition of row k, from 1, without a name."""
    row, operand = rows[k - 1], OPERANDS[rows[k - 1].operand]
    primary = tuple(row for row in rows[:k] if row.operand == "PRIM")[-1:]
    if operand.refers is None:
        if row.operand in BOUNDARIES and row.name[:2] in ("MN", "MX"):  # from the object means from surface 1
            row = dataclasses.replace(row, integers=(max(row.integers[0], 1), row.integers[1]))
        return Condition(_free(in_unit(row, unit, 1.0)), operand.bounds or "=", before=primary)
    taken = _taken(rows, k)
    if operand.bounds:  # OPLT, ABGT …
        source, size, configured = rows[taken[0] - 1], row.name.startswith("AB"), configurations_of(rows, 0)
        plain = OPERANDS[source.operand].refers is None and OPERANDS[source.operand].bounds in ("", operand.bounds)
        if plain and not (size or primary) and configured[k - 1] == configured[taken[0] - 1]:
            held = dataclasses.replace(source, target=row.target, weight=0.0)
            return Condition(in_unit(held, unit, 1.0), operand.bounds)
        row = Row("ABSO" if size else "OPVA", row.integers, target=row.target)
    needed = with_taken(rows, taken)
    before: list[Row] = []
    numbers: dict[int, int] = {}
    for number, other in enumerate(rows[:k], 1):
        if other.operand in ("CONF", "PRIM") or number in needed:
            numbers[number] = len(before) + 1
            before.append(_free(rereferenced(other, lambda n: numbers.get(n, n))))
    return Condition(_free(rereferenced(row, lambda n: numbers.get(n, n))), operand.bounds or "=", before=tuple(before))


def _free(row: Row) -> Row:
    return dataclasses.replace(row, weight=0.0)


def _check_surfaces(lens: Lens, condition: Condition, k: int) -> None:
    """Raise BadHold for a row of a surface that the lens does not have."""
    last = len(lens.surfaces) - 1
    for row in (*condition.before, condition.row):
        for number, is_surface in zip(row.integers, surface_arguments(row), strict=True):
            if is_surface and not 0 <= number <= last:
                raise BadHold(
                    f"row {k} of the merit function, the condition {row.name}{condition.relation}{row.target:g}, names "
                    f"surface {number}: this lens has surfaces 0 to {last}; give the row another surface, or leave it "
                    "out by lens.with_conditions(…, only=True)"
                )


def surface_arguments(row: Row) -> tuple[bool, bool]:
    """Which of the two integers of a row are numbers of surfaces or gaps."""
    first, second = ARGUMENTS.get(row.operand, ("", "")) if isinstance(row.operand, str) else ("", "")
    is_numbered = first in ("surface", "gap", "contribution")
    return is_numbered, is_numbered and bool(second)


def _name(lens: Lens, condition: Condition, k: int) -> str:
    """The quantity of a row in the syntax of `hold`; "row 7" for one that takes values of other rows."""
    row, operand = condition.row, condition.row.operand
    if condition.before or not isinstance(operand, str):
        return f"row {k}"
    view = lens.configuration(condition.configuration) if condition.configuration else lens
    for name, word in WORDS.items():
        if word.operand == operand:
            try:
                if word.arguments(view) == (row.integers, row.numbers):
                    return name
            except BadHold:
                continue
    first, last = row.integers
    span = f":{first}" if first == last else f":{first}-{last}"
    for name, limit in LIMITS.items():
        if operand in limit.operands.values() and row.numbers == limit.numbers:
            return name if row.integers == _whole(lens, operand) else f"{name}{span}"
    if operand == "TTHI" and not any(row.numbers):
        return f"thickness{span}"
    numbers = [*map(str, row.integers), *(f"{n:g}" if float(f"{n:g}") == n else repr(n) for n in row.numbers)]
    while numbers and float(numbers[-1]) == 0:
        numbers.pop()
    return f"{operand}({','.join(numbers)})" if numbers else operand


def named_row(lens: Lens, rows: Sequence[Row], k: int, unit: float) -> Condition | None:
    """Row k, from 1, as a condition with a name, whatever its weight, the primary wavelength as the default; unit: of
    rows, mm. None for unknown operands."""
    if rows[k - 1].operand not in OPERANDS:
        return None
    condition = _of_row(rows, k, unit)
    row, takes = condition.row, OPERANDS[condition.row.operand].takes
    if takes[1] == "wavelength" and row.integers[1] == lens.primary_wavelength and not condition.before:
        row = dataclasses.replace(row, integers=(row.integers[0], 0))
        condition = dataclasses.replace(condition, row=row)
    return dataclasses.replace(condition, name=_name(lens, condition, k))


def without_rows(rows: Sequence[Row], gone: Iterable[int]) -> tuple[Row, ...]:
    """Rows without some, from 1, and without those above whose values these alone take; rows that others need stay."""
    gone = set(gone)
    taken = {k: _taken(rows, k) for k in range(1, len(rows) + 1)}
    gone |= {k - 1 for k in gone if taken[k] == [k - 1] and rows[k - 2].weight == 0}
    needed = {number for k, numbers in taken.items() if k not in gone for number in numbers}
    stay = gone & needed
    new = {k: place for place, k in enumerate((k for k in taken if k not in gone or k in stay), 1)}
    kept = (_free(rows[k - 1]) if k in stay else rows[k - 1] for k in new)
    return tuple(rereferenced(row, lambda n: new.get(n, n)) for row in kept)


def with_taken(rows: Sequence[Row], numbers: Iterable[int]) -> set[int]:
    """Numbers of rows, from 1, and of all rows whose values these take."""
    needed: set[int] = set()
    left = list(numbers)
    while left:
        number = left.pop()
        if number not in needed:
            needed.add(number)
            left += _taken(rows, number)
    return needed


def _taken(rows: Sequence[Row], k: int) -> list[int]:
    """The rows whose values row k takes."""
    refers = OPERANDS[rows[k - 1].operand].refers if rows[k - 1].operand in OPERANDS else None
    return [] if refers is None else list(refers(Line(k, rows[k - 1], 0), rows))


def _rows_of(condition: Condition, lens: Lens, above: Sequence[Row], unit: float) -> Iterator[Row]:
    """The rows of a condition below the rows `above`, in the unit of the file. Raises BadHold."""
    if not (condition.on or condition.is_worded):
        raise BadHold(f"{condition.quantity} takes values of other rows: it cannot be off; leave it out")
    current, row = lens.current_configuration, in_unit(condition.row, 1.0, unit)
    wanted, start = condition.configuration or current, len(above)
    if configurations_of(above, current)[-1:] not in ([], [wanted]) or (not above and wanted != current):
        yield Row("CONF", (wanted, 0))
        start += 1
    last_primary = next((r.integers[1] for r in reversed(above) if r.operand == "PRIM"), lens.primary_wavelength)
    if last_primary != lens.primary_wavelength:
        yield Row("PRIM", (0, lens.primary_wavelength))
        start += 1
    if not condition.on:
        yield Row("BLNK", text=OFF)
        start += 1
    for other in condition.before:
        yield rereferenced(other, lambda n: n + start)
    start += len(condition.before)
    if condition.before:
        row = rereferenced(row, lambda n: n + start - len(condition.before))
    weight = -1.0 if condition.on else 0.0
    if condition.relation == "=" or OPERANDS[row.operand].bounds:
        yield dataclasses.replace(row, weight=weight)
        return
    sided = {"<=": "LT", ">=": "GT"}[condition.relation]
    if row.operand in ("OPVA", "ABSO"):
        yield Row(f"{'AB' if row.operand == 'ABSO' else 'OP'}{sided}", row.integers, target=row.target, weight=-1.0)
        return
    yield dataclasses.replace(row, target=0.0, weight=0.0)
    yield Row(f"OP{sided}", (start + 1, 0), target=row.target, weight=weight)
