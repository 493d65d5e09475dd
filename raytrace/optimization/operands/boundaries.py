"""Operands of boundaries: thicknesses, curvatures, conics and semi-diameters that shall not pass a target.

A row over several surfaces is its target if all of them comply, else less, or more, by the sum of their violations. Its
error is 0, with zero derivatives, where the boundary is kept, and grows continuously where it is passed. Coordinate
breaks are no surfaces here: a gap ends at the next surface that is none. A surface that closes before its semi-diameter
has no edge: the difference is a violation of every row of edges, least or largest.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch

from raytrace.materials.glass import is_air
from raytrace.maths.numerics import Dual, slope_of, value_of
from raytrace.optimization.lens_state import ENDS, Bundle, LensState, largest_field, listed
from raytrace.optimization.operands.operand import Evaluate, EvaluationContext, Line, Operand, Planner, RowValues
from raytrace.system.lens import media
from raytrace.system.shapes import EVEN
from raytrace.system.surface import Surface, medium_surfaces, sag_at


class SemiDiameters:
    """Semi-diameters with derivatives; rays are traced only for surfaces of rows whose semi-diameter follows the rays.

        s = (1 + a/100) max √(x² + y²) + c

    over all fields and wavelengths and the ends of the two diameters of the pupil; a per cent and c mm are the margin
    of `OptimizationData`, which neither the stop nor the image has. The derivative is that of the largest ray.
    """

    def __init__(self, planner: Planner):
        self.view, surfaces, data = planner.view, planner.lens.surfaces, planner.lens.optimization_data
        fixed = range(len(surfaces)) if data is None else data.semi_diameters
        #: mm, by surface, of those that do not follow the rays; the object's is 0 by default.
        self.fixed = {0: surfaces[0].semi_diameter or 0.0}
        self.fixed |= {k: float(surfaces[k].semi_diameter) for k in fixed if surfaces[k].semi_diameter}
        percent, length = (0.0, 0.0) if data is None else data.semi_diameter_margin
        has_margin = ~np.isin(np.arange(len(surfaces)), (planner.lens.stop, planner.image))
        self.factors, self.lengths = np.where(has_margin, 1 + percent / 100, 1.0), np.where(has_margin, length, 0.0)
        self.asked: set[int] = set()
        self._bundle: Bundle | None = None

    def ask(self, surfaces: Iterable[int]) -> None:
        """Register, while rows are planned, surfaces whose semi-diameters they need."""
        self.asked |= set(surfaces)

    def at(self, context: EvaluationContext):
        """mm (S,) of all surfaces; nan of those without a row, and where no ray arrives."""
        return context.once(self._at)

    def _at(self, context: EvaluationContext):
        sizes = np.full(len(self.factors), np.nan)
        slopes = np.zeros((context.state.count, len(sizes)))
        if follow := sorted(self.asked - set(self.fixed)):
            heights, by = self._largest_heights(context.state, follow)
            sizes[follow] = self.factors[follow] * heights + self.lengths[follow]
            if by is not None:
                slopes[:, follow] = self.factors[follow] * by
        for surface, number in self.fixed.items():
            sizes[surface] = number
        return Dual(sizes, slopes) if context.state.count else sizes

    def _largest_heights(self, state: LensState, surfaces: list[int]) -> tuple[np.ndarray, np.ndarray | None]:
        """Largest √(x² + y²) mm (P,) on some surfaces, and its derivatives (V, P); nan where no ray arrives."""
        marks, places = self._rays(surfaces[-1]).marks(state), np.array(surfaces) - 1
        x, y, valid = marks.x[places], marks.y[places], marks.valid[places]
        heights = np.where(valid, np.hypot(x, y), -1.0)
        ray, rows = heights.argmax(-1), np.arange(len(places))
        largest = heights[rows, ray]
        largest = np.where(largest < 0, np.nan, largest)
        if marks.by_x is None:
            return largest, None
        cosine, sine = (part[rows, ray] / np.where(largest > 0, largest, 1.0) for part in (x, y))
        by_x, by_y = (part[places, :, ray] for part in (marks.by_x, marks.by_y))
        slopes = cosine[:, None] * by_x + sine[:, None] * by_y
        return largest, np.where(np.isnan(largest)[:, None], 0.0, slopes).T

    def _rays(self, last: int) -> Bundle:
        """The rays through the `ENDS` of all fields and wavelengths up to a surface, the same in every call."""
        if self._bundle is None:
            fields, self._bundle = self.view.lens.fields, Bundle(self.view, last)
            largest = largest_field(self.view.lens) or 1.0
            points = [*zip((fields.x / largest).tolist(), (fields.y / largest).tolist(), strict=True)]
            for wavelength in range(len(self.view.wavelengths)):
                for field in points:
                    for end in ENDS:
                        self._bundle.ask(wavelength, field, end)
        return self._bundle


#: The point on the edge of a surface, by the code of a row: +y, +x, -y, -x.
SIDES = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))

_EDGE = 1e-4  # of 1 - (1+k) c² s²: from where the root of a conic is continued


class Gaps:
    """Gaps from a surface to the next one that is no coordinate break: thicknesses at centre and edge, sags.

    Arrays (S,) have an entry for every surface; those of surfaces without a row are meaningless.
    """

    def __init__(self, planner: Planner):
        view, surfaces = planner.view, planner.lens.surfaces
        last = len(surfaces) - 1
        self.semi_diameters = planner.shared(SemiDiameters)
        self.is_air = np.array([is_air(surfaces[k].glass) for k in medium_surfaces(surfaces)])
        #: -1 behind an odd number of mirrors, where light travels towards -z.
        self.side = np.where(view.indices[0] < 0, -1.0, 1.0)
        #: The surface that ends the gap behind each.
        self.end = np.array(
            [next((k for k in range(j + 1, last) if not surfaces[k].is_break), last) for j in range(last + 1)]
        )
        self.stored = {"thickness": np.array(view.thickness), "curvature": np.array(view.curvature)}
        self.stored |= {"conic": np.array([0.0 if s.conic is None else float(s.conic.detach()) for s in surfaces])}
        terms = [s.coefficients.tolist() if s.coefficients is not None and _is_even(s) else [] for s in surfaces]
        self.terms = [f"a{2 * j + 2}" for j in range(max(map(len, terms)))]
        for j, name in enumerate(self.terms):
            self.stored[name] = np.array([even[j] if j < len(even) else 0.0 for even in terms])
        self.others = [k for k, surface in enumerate(surfaces) if not (surface.is_break or _is_even(surface))]

    def ask_edges(self, surfaces: Iterable[int]) -> None:
        """Register, while rows are planned, surfaces behind which they need edges."""
        self.semi_diameters.ask([k for start in surfaces for k in (start, int(self.end[start]))])

    def numbers(self, state: LensState, quantity: str):
        """A number (S,) of all surfaces."""
        values, slopes = self.stored[quantity].copy(), None
        for (surface, name), number in state.numbers.items():
            if name == quantity:
                values[surface] = value_of(number)
                if isinstance(number, Dual):
                    slopes = np.zeros((state.count, len(values))) if slopes is None else slopes
                    slopes[:, surface] = number.slope
        return values if slopes is None else Dual(values, slopes)

    def centre(self, context: EvaluationContext):
        """mm on the axis, signed like the lens's."""
        return context.once(self._centre)

    def _centre(self, context: EvaluationContext):
        each = total = self.numbers(context.state, "thickness")
        start = np.arange(len(self.end))
        for step in range(1, int((self.end - start).max())):
            within = start + step < self.end
            total = total + np.where(within, each[np.where(within, start + step, 0)], 0.0)
        return total

    def edge(self, context: EvaluationContext, code: int = 0):
        """mm at the edge: t + z′ - z, each surface at its own semi-diameter; code: the number of a side in `SIDES`."""
        return context.once(self._edge, code)

    def _edge(self, context: EvaluationContext, code: int):
        z = self.sag(context, code)
        return self.centre(context) + (z[self.end] - z)

    def whole(self, context: EvaluationContext, code: int = 0):
        """mm along the axis between the extreme points of both surfaces, at the centre or at the edge."""
        z = self.sag(context, code)
        return self.centre(context) + (np.maximum(z[self.end], 0.0) - np.minimum(z, 0.0))

    def sag(self, context: EvaluationContext, code: int = 0):
        """mm at the semi-diameters."""
        return context.once(self._sag, code)

    def _sag(self, context: EvaluationContext, code: int):
        state, heights, (x, y) = context.state, self.semi_diameters.at(context), SIDES[code]
        sag = self._even_sag(state, heights)
        asked = [k for k in self.others if not np.isnan(value_of(heights)[k])]
        if not asked:
            return sag
        values, slopes = value_of(sag).copy(), slope_of(sag, state.count).copy()
        for k in asked:
            sag_of_k = lambda lens, s, k=k: sag_at(lens.surfaces[k], x * s, y * s)  # noqa: E731
            z = state.each_through_torch(sag_of_k, [heights[k : k + 1]])
            values[k], slopes[:, k] = value_of(z)[0], slope_of(z, state.count)[:, 0]
        return Dual(values, slopes) if state.count else values

    def shortfall(self, context: EvaluationContext):
        """mm by which surfaces fall short of their semi-diameters s, below 0 where they reach them: s (q - 1)/2.

        q = (1+k) c² s² is 1 where a conic closes at s; near there it is s - 1/(|c| √(1+k)).
        """
        return context.once(self._shortfall)

    def _shortfall(self, context: EvaluationContext):
        heights = self.semi_diameters.at(context)
        return 0.5 * heights * (self._closing(context.state, heights * heights) - 1.0)

    def _closing(self, state: LensState, u):
        """(1+k) c² u, which is 1 at the edge of a closed conic."""
        c = self.numbers(state, "curvature")
        return (1 + self.numbers(state, "conic")) * (c * c) * u

    def _even_sag(self, state: LensState, heights):
        """c u/(1 + √(1 - q)) + Σ a_j u^j, u = s², q = (1+k) c² u.

        Of a conic that closes within s, from 1 - q = ε on, 1 - q is ε/(1 + τ + τ²), τ = 1 - (1 - q)/ε: above 0, with
        two continuous derivatives.
        """
        u, c = heights * heights, self.numbers(state, "curvature")
        left = 1 - self._closing(state, u)
        closed = value_of(left) < _EDGE
        if closed.any():
            over = np.where(closed, 1 - left / _EDGE, 0.0)
            left = np.where(closed, _EDGE / (1 + over + over * over), left)
        sag = c * u / (1 + np.sqrt(left))
        power = u
        for name in self.terms:
            sag = sag + power * self.numbers(state, name)
            power = power * u
        return sag


def _is_even(surface: Surface) -> bool:
    """Whether the sag is that of a conic with even terms at most, which `Gaps` computes in numpy."""
    return surface.sag_terms is None and (surface.coefficients is None or surface.kind == EVEN)


_AT_LEAST, _AT_MOST = 1.0, -1.0

#: Numbers (S,) of all surfaces at a state, which rows compare.
Amounts = Callable[[EvaluationContext], object]

#: Plans the amounts of rows: of a planner, the surfaces of the rows, and their code.
Prepared = Callable[[Planner, Sequence[int], int], Amounts]

#: The surfaces of a row, each with a code.
Chosen = Callable[[Line, Planner], list[tuple[int, int]]]

# -- amounts -----------------------------------------------------------------------------------------------------------


def _centre(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    return planner.shared(Gaps).centre


def _edge(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    gaps = planner.shared(Gaps)
    gaps.ask_edges(surfaces)
    return lambda context: gaps.edge(context, code)


def _whole(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    gaps = planner.shared(Gaps)
    gaps.ask_edges(surfaces)
    return lambda context: gaps.whole(context, code)


def _along_light(prepared: Prepared) -> Prepared:
    """Thicknesses with the sign of the direction of light: positive behind an odd number of mirrors, too."""

    def prepare(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
        amounts, side = prepared(planner, surfaces, 0), planner.shared(Gaps).side
        if planner.conventions.behind_mirrors == "signed" or (side > 0).all():
            return amounts
        return lambda context: side * amounts(context)

    return prepare


def _semi_diameter(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    semi_diameters = planner.shared(SemiDiameters)
    semi_diameters.ask(surfaces)
    return semi_diameters.at


def _diameter(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    semi_diameter = _semi_diameter(planner, surfaces, code)
    return lambda context: 2.0 * semi_diameter(context)


def _slenderness(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    """Diameter over centre thickness."""
    diameter, thickness = _diameter(planner, surfaces, code), _along_light(_centre)(planner, surfaces, code)
    asked = np.isin(np.arange(planner.image + 1), surfaces)
    return lambda context: diameter(context) / np.where(asked, thickness(context), 1.0)


def _shortfall(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    gaps = planner.shared(Gaps)
    gaps.semi_diameters.ask(surfaces)
    return gaps.shortfall


def _number(quantity: str) -> Prepared:
    def prepare(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
        gaps = planner.shared(Gaps)
        return lambda context: gaps.numbers(context.state, quantity)

    return prepare


def _of_glass(number: Callable) -> Prepared:
    """A number of the media behind the surfaces, of their indices at the lines d, F and C."""

    def prepare(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
        def numbers(lens) -> list:
            indices = media(lens, lens.wavelengths.new_tensor([0.5875618, 0.4861327, 0.6562725]))
            every = range(len(lens.surfaces))
            return [number(*indices[k].expand(3)) if k in surfaces else torch.zeros(()) for k in every]

        return lambda context: listed(context.state.through_torch(numbers), context.state.count)

    return prepare


# -- surfaces of a row -------------------------------------------------------------------------------------------------


def _single(line: Line, planner: Planner) -> list[tuple[int, int]]:
    """The surface of a row, and the side of its edge. Raises BadRow."""
    surface, code = planner.checked(line, line.row.integers[0]), line.row.integers[1]
    return [(surface, code if 0 <= code < len(SIDES) else 0)]


def _range(line: Line, planner: Planner) -> list[tuple[int, int]]:
    """The surfaces of a row, from the first behind the object to the last before the image, without breaks."""
    first, last = line.row.integers
    surfaces = range(max(first, 1), min(last, planner.image - 1) + 1)
    return [(k, 0) for k in surfaces if not planner.lens.surfaces[k].is_break]


def _in_glass(line: Line, planner: Planner) -> list[tuple[int, int]]:
    return [(k, code) for k, code in _range(line, planner) if not planner.shared(Gaps).is_air[k]]


def _in_air(line: Line, planner: Planner) -> list[tuple[int, int]]:
    return [(k, code) for k, code in _range(line, planner) if planner.shared(Gaps).is_air[k]]


def _both_ends(chosen: Chosen) -> Chosen:
    """The surfaces at the start and the end of the gaps, each once a row; the image has no edge."""

    def ends_of(line: Line, planner: Planner) -> list[tuple[int, int]]:
        ends = [end for k, _ in chosen(line, planner) for end in (k, int(planner.shared(Gaps).end[k]))]
        return [(k, 0) for k in dict.fromkeys(ends) if 0 < k < planner.image]

    return ends_of


# -- comparison --------------------------------------------------------------------------------------------------------


class _Places:
    """The surfaces (P,) of all rows, the row of each, and their amounts at a state."""

    def __init__(self, prepared: Prepared, chosen: Chosen, lines: Sequence[Line], planner: Planner):
        places = [(number, *pair) for number, line in enumerate(lines) for pair in chosen(line, planner)]
        self.rows, self.surfaces, self.codes = np.array(places, dtype=int).reshape(-1, 3).T
        self.amounts = {
            code: prepared(planner, self.surfaces[self.codes == code].tolist(), code)
            for code in sorted(set(self.codes.tolist()))
        }

    def values(self, context: EvaluationContext) -> np.ndarray:
        """Without derivatives."""
        values = np.zeros(len(self.rows))
        for code, amounts in self.amounts.items():
            same = self.codes == code
            values[same] = value_of(amounts(context))[self.surfaces[same]]
        return values

    def at(self, context: EvaluationContext, places: np.ndarray):
        """Those of some places, with derivatives."""
        numbers = np.zeros(len(places))
        for code, amounts in self.amounts.items():
            each = amounts(context)[self.surfaces[places]]
            numbers = each if len(self.amounts) == 1 else np.where(self.codes[places] == code, each, numbers)
        return numbers


def _largest_violations(violated: np.ndarray, rows: np.ndarray, violations: np.ndarray) -> np.ndarray:
    """Of every row the place of the largest violation."""
    order = violated[np.argsort(-violations[violated], kind="stable")]
    return order[np.unique(rows[order], return_index=True)[1]]


def _within(prepared: Prepared, chosen: Chosen, side: float, length: int, also: Prepared | None = None):
    """Rows that are their target if no surface passes it, else off by the violations.

    also: violations of the surfaces at both ends of the gaps, mm, whatever the target.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        places = _Places(prepared, chosen, lines, planner)
        targets = np.array([line.row.target for line in lines]) * planner.unit**length
        summed = planner.conventions.boundary == "sum"
        ends = None if also is None else _Places(also, _both_ends(chosen), lines, planner)
        rows = places.rows if ends is None else np.concatenate([places.rows, ends.rows])
        surfaces = places.surfaces if ends is None else np.concatenate([places.surfaces, ends.surfaces])

        def with_derivatives(context: EvaluationContext, some: np.ndarray):
            """The violations of some places."""
            first = some[some < len(places.rows)]
            violations = side * (targets[places.rows[first]] - places.at(context, first))
            further = some[some >= len(places.rows)] - len(places.rows)
            return np.concatenate([violations, ends.at(context, further)]) if len(further) else violations

        def evaluate(context: EvaluationContext) -> RowValues:
            violations = side * (targets[places.rows] - places.values(context))
            violations = violations if ends is None else np.concatenate([violations, ends.values(context)])
            sides = (rows, with_derivatives(context, np.arange(len(rows))), surfaces) if summed else ()
            counted = np.flatnonzero(~(violations <= 0))  # nan does not comply
            counted = counted if summed else _largest_violations(counted, rows, violations)
            if not counted.size:
                return RowValues(targets, sides=sides)
            of_row = (rows[counted] == np.arange(len(lines))[:, None]).astype(float)
            return RowValues(targets - side * (of_row @ with_derivatives(context, counted)), sides=sides)

        return evaluate

    return plan


def _value(prepared: Prepared):
    """Rows of the amount itself, of one surface."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        places, every = _Places(prepared, _single, lines, planner), np.arange(len(lines))
        return lambda context: RowValues(places.at(context, every))

    return plan


_SUM = (
    "`boundary` sum: of the violations of all surfaces, or largest; `behind_mirrors` reversed: thicknesses behind an "
    "odd number of mirrors are compared along the light, or signed: as the lens has them"
)
_SIGNED = "thicknesses behind mirrors as the lens has them, negative"
_SIDE = "thickness at the edge behind surface int1; int2: 0 +y, 1 +x, 2 -y, 3 -x"
_WHOLE = "thickness behind surface int1 between the extreme points of both surfaces"
_PLACES = {
    "G": (_in_glass, " in glass"),
    "A": (_in_air, " in air, behind mirrors too"),
    "T": (_range, " in glass and air"),
}
_RELATIONS = {_AT_LEAST: ">=", _AT_MOST: "<="}


def _of_range(
    tail: str, prepared: Prepared, surfaces: Chosen, text: str, length: int = 0, also: Prepared | None = None
) -> dict[str, Operand]:
    """MN and MX of a number of surfaces int1 to int2."""
    return {
        f"{head}{tail}": Operand(
            _within(prepared, surfaces, side, length, also),
            f"{word} {text}, surfaces int1 to int2",
            length,
            _SUM,
            bounds=_RELATIONS[side],
        )
        for head, side, word in (("MN", _AT_LEAST, "least"), ("MX", _AT_MOST, "largest"))
    }


def _of_gaps(letter: str, prepared: Prepared, text: str, also: Prepared | None = None) -> dict[str, Operand]:
    """MN and MX of thicknesses in glass, in air and in both."""
    rows = {}
    for kind, (surfaces, place) in _PLACES.items():
        rows |= _of_range(f"{letter}{kind}", _along_light(prepared), surfaces, text + place, 1, also)
    return rows


def _of_one(
    head: str, prepared: Prepared, text: str, length: int = 0, convention: str = "", also: Prepared | None = None
) -> dict[str, Operand]:
    """GT, LT and VA of a number of surface int1."""
    bounds = {
        f"{head}{tail}": Operand(
            _within(prepared, _single, side, length, also),
            f"{text}, {word} the target",
            length,
            convention,
            bounds=_RELATIONS[side],
        )
        for tail, side, word in (("GT", _AT_LEAST, "at least"), ("LT", _AT_MOST, "at most"))
    }
    return bounds | {f"{head}VA": Operand(_value(prepared), text, length, convention)}


BOUNDARIES: dict[str, Operand] = {
    **_of_gaps("C", _centre, "thickness on the axis"),
    **_of_gaps("E", _edge, "thickness at the edge", _shortfall),
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
