"""Operands of boundaries: thicknesses, curvatures, conics and semi-diameters that shall not pass a target.

A row over several surfaces is its target where all of them comply, else less, or more, by the sum of what they lack. So
its error is 0 and does not move where the boundary is kept, and grows from 0 steadily where it is passed. Breaks of
coordinates are no surfaces here, and a gap ends at the next one that is none. A surface that closes before its
semi-diameter has no edge: it lacks what it falls short of it in every row of edges, whichever side that bounds.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from raytrace.maths.dual import Dual, value_of
from raytrace.merit.gaps import SIDES, Gaps
from raytrace.merit.plan import Evaluate, Found, Line, Now, Operand, Planner
from raytrace.merit.semi_diameters import SemiDiameters
from raytrace.optics.sequence import media

_AT_LEAST, _AT_MOST = 1.0, -1.0

#: What is compared: numbers (S,) of all surfaces at a moment.
Amounts = Callable[[Now], object]

#: How rows are prepared to be compared: of a planner, the surfaces they look at, and their code.
Prepared = Callable[[Planner, Sequence[int], int], Amounts]


# -- what is compared --------------------------------------------------------------------------------------------------


def _centre(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    return planner.shared(Gaps).centre


def _edge(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    gaps = planner.shared(Gaps)
    gaps.ask_edges(surfaces)
    return lambda now: gaps.edge(now, code)


def _whole(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    gaps = planner.shared(Gaps)
    gaps.ask_edges(surfaces)
    return lambda now: gaps.whole(now, code)


def _along_light(prepared: Prepared) -> Prepared:
    """Thicknesses behind an odd number of mirrors turned to positive ones."""

    def prepare(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
        amounts, side = prepared(planner, surfaces, 0), planner.shared(Gaps).side
        if planner.readings.behind_mirrors == "signed" or (side > 0).all():
            return amounts
        return lambda now: side * amounts(now)

    return prepare


def _semi_diameter(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    found = planner.shared(SemiDiameters)
    found.ask(surfaces)
    return found.at


def _diameter(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    found = _semi_diameter(planner, surfaces, code)
    return lambda now: 2.0 * found(now)


def _slenderness(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    """Diameter over centre thickness."""
    diameter, thickness = _diameter(planner, surfaces, code), _along_light(_centre)(planner, surfaces, code)
    asked = np.isin(np.arange(planner.image + 1), surfaces)
    return lambda now: diameter(now) / np.where(asked, thickness(now), 1.0)


def _number(quantity: str) -> Prepared:
    def prepare(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
        gaps = planner.shared(Gaps)
        return lambda now: gaps.numbers(now.moment, quantity)

    return prepare


def _of_glass(tell: Callable) -> Prepared:
    """A number of the media behind the surfaces, of their indices at the lines d, F and C."""

    def prepare(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
        def numbers(lens) -> list:
            lines = lens.wavelengths.new_tensor([0.5875618, 0.4861327, 0.6562725])
            indices = media(lens, lines)
            return [
                tell(*indices[k].expand(3)) if k in surfaces else torch.zeros(()) for k in range(len(lens.surfaces))
            ]

        def amounts(now: Now):
            found = now.moment.through_torch(numbers)
            values = np.array([float(value_of(number)) for number in found])
            return Dual(values, np.stack([number.slope for number in found], -1)) if now.moment.count else values

        return amounts

    return prepare


# -- which surfaces ----------------------------------------------------------------------------------------------------


def _single(line: Line, planner: Planner) -> list[tuple[int, int]]:
    """The surface that a row names, and the side of its edge. Raises BadRow."""
    surface, code = planner.checked(line, line.row.integers[0]), line.row.integers[1]
    return [(surface, code if 0 <= code < len(SIDES) else 0)]


def _range(line: Line, planner: Planner) -> list[tuple[int, int]]:
    """The surfaces that a row names, from the first behind the object to the last before the image, but for breaks."""
    first, last = line.row.integers
    surfaces = range(max(first, 1), min(last, planner.image - 1) + 1)
    return [(k, 0) for k in surfaces if not planner.lens.surfaces[k].is_break]


def _in_glass(line: Line, planner: Planner) -> list[tuple[int, int]]:
    return [(k, code) for k, code in _range(line, planner) if not planner.shared(Gaps).is_air[k]]


def _in_air(line: Line, planner: Planner) -> list[tuple[int, int]]:
    return [(k, code) for k, code in _range(line, planner) if planner.shared(Gaps).is_air[k]]


#: The surfaces of a row, each with a code.
Chosen = Callable[[Line, Planner], list[tuple[int, int]]]


# -- how they are compared ---------------------------------------------------------------------------------------------


class _Places:
    """The surfaces (P,) of all rows: `rows`, of which row each is; `at`, their amounts at a moment."""

    def __init__(self, prepared: Prepared, chosen: Chosen, lines: Sequence[Line], planner: Planner):
        found = [(number, *pair) for number, line in enumerate(lines) for pair in chosen(line, planner)]
        self.rows, self.surfaces, self.codes = np.array(found, dtype=int).reshape(-1, 3).T
        self.amounts = {
            code: prepared(planner, self.surfaces[self.codes == code].tolist(), code)
            for code in sorted(set(self.codes.tolist()))
        }

    def values(self, now: Now) -> np.ndarray:
        """Without derivatives."""
        found = np.zeros(len(self.rows))
        for code, tell in self.amounts.items():
            own = self.codes == code
            found[own] = value_of(tell(now))[self.surfaces[own]]
        return found

    def at(self, now: Now, places: np.ndarray):
        """Those of some places, with derivatives."""
        found = np.zeros(len(places))
        for code, tell in self.amounts.items():
            own = tell(now)[self.surfaces[places]]
            found = own if len(self.amounts) == 1 else np.where(self.codes[places] == code, own, found)
        return found


def within(prepared: Prepared, chosen: Chosen, side: float, length: int, also: Prepared | None = None):
    """Rows that are their target where no surface passes it, else off by what the surfaces lack.

    also: what the surfaces at both ends of the gaps lack whatever the target is, mm.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        places = _Places(prepared, chosen, lines, planner)
        targets = np.array([line.row.target for line in lines]) * planner.unit**length
        counted = LACKS[planner.readings.boundary]
        closed = None if also is None else _Places(also, _both(chosen), lines, planner)
        rows = places.rows if closed is None else np.concatenate([places.rows, closed.rows])
        surfaces = places.surfaces if closed is None else np.concatenate([places.surfaces, closed.surfaces])

        def lacking(now: Now, chosen: np.ndarray):
            """What some places lack, with derivatives."""
            first = chosen[chosen < len(places.rows)]
            lacks = side * (targets[places.rows[first]] - places.at(now, first))
            further = chosen[chosen >= len(places.rows)] - len(places.rows)
            return np.concatenate([lacks, closed.at(now, further)]) if len(further) else lacks

        def evaluate(now: Now) -> Found:
            lacks = side * (targets[places.rows] - places.values(now))
            lacks = lacks if closed is None else np.concatenate([lacks, closed.values(now)])
            sides = (rows, lacking(now, np.arange(len(rows))), surfaces) if counted is _all else ()
            passed = counted(np.flatnonzero(~(lacks <= 0)), rows, lacks)  # nan is none that complies
            if not passed.size:
                return Found(targets, sides=sides)
            of_row = (rows[passed] == np.arange(len(lines))[:, None]).astype(float)
            return Found(targets - side * (of_row @ lacking(now, passed)), sides=sides)

        return evaluate

    return plan


def _shortfall(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    """How far surfaces fall short of their semi-diameters."""
    gaps = planner.shared(Gaps)
    gaps.semi_diameters.ask(surfaces)
    return gaps.shortfall


def _both(chosen: Chosen) -> Chosen:
    """The surfaces that begin and end the gaps, each once a row; the image ends none that has an edge."""

    def either(line: Line, planner: Planner) -> list[tuple[int, int]]:
        ends = [end for k, _ in chosen(line, planner) for end in (k, int(planner.shared(Gaps).end[k]))]
        return [(k, 0) for k in dict.fromkeys(ends) if 0 < k < planner.image]

    return either


def _all(passed: np.ndarray, rows: np.ndarray, lacks: np.ndarray) -> np.ndarray:
    return passed


def _largest(passed: np.ndarray, rows: np.ndarray, lacks: np.ndarray) -> np.ndarray:
    """Of every row the place that lacks most."""
    order = passed[np.argsort(-lacks[passed], kind="stable")]
    return order[np.unique(rows[order], return_index=True)[1]]


#: Which of the places that pass a target count, by `Readings.boundary`.
LACKS = {"sum": _all, "largest": _largest}


def value(prepared: Prepared):
    """Rows of the amount itself, of one surface."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        places = _Places(prepared, _single, lines, planner)
        every = np.arange(len(lines))
        return lambda now: Found(places.at(now, every))

    return plan


_SUM = (
    "`boundary` sum: of what all surfaces lack, or largest; `behind_mirrors` reversed: thicknesses behind an odd "
    "number of mirrors are compared along the light, or signed: as the lens has them"
)
_SIGNED = "thicknesses behind mirrors as the lens has them, negative"
_SIDE = "thickness at the edge behind surface int1; int2: 0 +y, 1 +x, 2 -y, 3 -x"
_WHOLE = "thickness behind surface int1 from where it begins to where it ends"
_PLACES = {
    "G": (_in_glass, "in glass"),
    "A": (_in_air, "in air, behind mirrors too"),
    "T": (_range, "in glass and air"),
}
_RELATIONS = {_AT_LEAST: ">=", _AT_MOST: "<="}
_SIDES = (("MN", _AT_LEAST, "least"), ("MX", _AT_MOST, "largest"))
_BOUNDS = (("GT", _AT_LEAST, "at least"), ("LT", _AT_MOST, "at most"))


def _ranges(letter: str, prepared: Prepared, text: str, also: Prepared | None = None) -> dict[str, Operand]:
    """MN… and MX… over the gaps of surfaces int1 to int2."""
    return {
        f"{head}{letter}{kind}": Operand(
            within(_along_light(prepared), surfaces, side, 1, also),
            f"{word} {text} {place}, surfaces int1 to int2",
            1,
            _SUM,
            bounds=_RELATIONS[side],
        )
        for head, side, word in _SIDES
        for kind, (surfaces, place) in _PLACES.items()
    }


def _of_range(tail: str, prepared: Prepared, surfaces, text: str, length: int = 0) -> dict[str, Operand]:
    """MN and MX of a number of surfaces int1 to int2."""
    return {
        f"{head}{tail}": Operand(
            within(prepared, surfaces, side, length),
            f"{word} {text}, surfaces int1 to int2",
            length=length,
            reading=_SUM,
            bounds=_RELATIONS[side],
        )
        for head, side, word in _SIDES
    }


def _of_one(
    head: str, prepared: Prepared, text: str, length: int = 0, reading: str = "", also: Prepared | None = None
) -> dict[str, Operand]:
    """GT, LT and VA of a number of surface int1."""
    bounds = {
        f"{head}{tail}": Operand(
            within(prepared, _single, side, length, also),
            f"{text}, {word} the target",
            length,
            reading,
            bounds=_RELATIONS[side],
        )
        for tail, side, word in _BOUNDS
    }
    return bounds | {f"{head}VA": Operand(value(prepared), text, length, reading)}


BOUNDARIES: dict[str, Operand] = {
    **_ranges("C", _centre, "thickness on the axis"),
    **_ranges("E", _edge, "thickness at the edge", _shortfall),
    **_of_range("CV", _number("curvature"), _range, "curvature", -1),
    **_of_range("SD", _semi_diameter, _range, "semi-diameter", 1),
    **_of_range("DT", _slenderness, _in_glass, "diameter over thickness of glasses"),
    **_of_range("IN", _of_glass(lambda d, F, C: d), _in_glass, "index of glasses at the d line"),
    **_of_range("AB", _of_glass(lambda d, F, C: (d - 1) / (F - C)), _in_glass, "Abbe number of glasses at the d line"),
    **_of_one("CT", _centre, "thickness on the axis behind surface int1", 1, _SIGNED),
    **_of_one("ET", _edge, _SIDE, 1, _SIGNED, _shortfall),
    **_of_one("TT", _whole, _WHOLE, 1, _SIGNED, _shortfall),
    **_of_one("CV", _number("curvature"), "curvature of surface int1", -1),
    **_of_one("CO", _number("conic"), "conic constant of surface int1"),
    **_of_one("DM", _diameter, "diameter of surface int1", 1),
}
