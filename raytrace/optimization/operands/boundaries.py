"""Operands of boundaries: thicknesses, curvatures, conics and semi-diameters that shall not pass a target.

A row over several surfaces is its target if all of them comply, else less, or more, by the sum of their violations. Its
error is 0, with zero derivatives, where the boundary is kept, and grows continuously where it is passed. Coordinate
breaks are skipped: a gap ends at the next other surface. A surface that closes before its semi-diameter
has no edge: the difference is a violation of every row of edges, least or largest.

The edge of a row is where OpticStudio has it, each surface at its own semi-diameter; where the last of its four numbers
(Py) is not 0 it is at the common rim (`tracing.geometry.rims`), as in the boundaries of default merit functions.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.materials.glass import is_air
from raytrace.maths.numerics import Dual, Number, polynomial, slope_of, value_of
from raytrace.optimization.lens_state import Bundle, LensState, listed
from raytrace.optimization.operands.operand import (
    Evaluate,
    EvaluationContext,
    Line,
    Operand,
    Plan,
    Planner,
    RowValues,
    once_a_context,
)
from raytrace.system.lens import Lens, media
from raytrace.system.shapes import EVEN, conic_sag
from raytrace.system.surface import Surface, medium_surfaces, sag_at
from raytrace.tracing.geometry import (
    BETWEEN,
    FARTHER,
    RIM_POINTS,
    edge_thickness,
    fixed_semi_diameters,
    rims,
    semi_diameter_margin,
)


class SemiDiameters:
    """Semi-diameters with derivatives; rays are traced only for surfaces of rows whose semi-diameter follows the rays.

        s = (1 + a/100) max √(x² + y²) + c

    over all fields and wavelengths and the rim of the pupil, interpolated between twelve rays as of
    `tracing.geometry.clear_semi_diameters`; a per cent and c mm are the margin of `OptimizationData`, which neither the
    stop nor the image has.
    """

    def __init__(self, planner: Planner):
        self.view, surfaces = planner.view, planner.lens.surfaces
        #: Semi-diameters in mm that do not follow the rays, by surface; that of the object is 0 by default.
        self.fixed = {0: surfaces[0].semi_diameter or 0.0} | fixed_semi_diameters(planner.lens)
        self.factors, self.lengths = np.array([semi_diameter_margin(planner.lens, k) for k in range(len(surfaces))]).T
        self.asked: set[int] = set()
        self._bundle: Bundle | None = None
        self._rims = np.zeros((0, len(RIM_POINTS)), dtype=int)  # numbers of the rays of each rim

    def ask(self, surfaces: Iterable[int]) -> None:
        """Register, while rows are planned, surfaces whose semi-diameters they need."""
        self.asked |= set(surfaces)

    @once_a_context
    def at(self, context: EvaluationContext) -> Number:
        """Semi-diameters in mm (S,) of all surfaces; nan of surfaces without a row, and where no ray arrives."""
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
        x, y, valid = (part[places][:, self._rims] for part in (marks.x, marks.y, marks.valid))  # (P, R, 12)
        squares = np.where(valid, x * x + y * y, -1.0)
        farthest, around = squares.max(-1), (squares @ BETWEEN.T)
        counts = valid.all(-1) & (around.max(-1) > (1 + FARTHER) * farthest)
        largest = np.where(counts, around.max(-1), farthest)
        rows, rim = np.arange(len(places)), largest.argmax(-1)
        largest = largest[rows, rim]
        height = np.sqrt(np.where(largest < 0, np.nan, largest))
        if marks.by_x is None or marks.by_y is None:
            return height, None
        ray = squares[rows, rim].argmax(-1)
        weights = np.where(counts[rows, rim, None], BETWEEN[around[rows, rim].argmax(-1)], np.eye(len(RIM_POINTS))[ray])
        scale = weights / np.where(height > 0, height, 1.0)[:, None]
        numbers = self._rims[rim]  # (P, 12)
        by_x, by_y = (part[places[:, None], :, numbers] for part in (marks.by_x, marks.by_y))  # (P, 12, V)
        x, y = (part[rows, rim] * scale for part in (x, y))
        slopes = np.einsum("pk,pkv->vp", x, by_x) + np.einsum("pk,pkv->vp", y, by_y)
        return height, np.where(np.isnan(height), 0.0, slopes)

    def _rays(self, last: int) -> Bundle:
        """The rays of the rim of all fields and wavelengths up to a surface, the same in every call."""
        if self._bundle is None:
            fields, self._bundle = self.view.lens.fields, Bundle(self.view, last)
            largest, numbers = float(fields.extent) or 1.0, list[list[int]]()
            points = [*zip((fields.x / largest).tolist(), (fields.y / largest).tolist(), strict=True)]
            for wavelength in range(len(self.view.wavelengths)):
                for field in points:
                    numbers.append([self._bundle.ask(wavelength, field, point) for point in RIM_POINTS])
            self._rims = np.array(numbers)
        return self._bundle


#: The point on the edge of a surface, by the code of a row: +y, +x, -y, -x.
SIDES = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))

#: Offset of the code of a row at the common rim, and the numbers of such a row.
RIM, AT_RIM = len(SIDES), (0.0, 0.0, 0.0, 1.0)

#: Equidistant heights from the axis to the common rim at which a full thickness is compared; their codes follow 2·RIM.
ZONES = 16

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
        side = np.where(view.indices[0] < 0, -1.0, 1.0)
        #: -1 behind an odd number of mirrors, where light travels towards -z, unless thicknesses count as signed.
        self.side = 1.0 if planner.conventions.behind_mirrors == "signed" or (side > 0).all() else side
        #: The surface that ends the gap behind each.
        self.end = np.array(
            [next((k for k in range(j + 1, last) if not surfaces[k].is_break), last) for j in range(last + 1)]
        )
        #: mm (S,) by which faces are polished beyond their semi-diameters.
        self.chip_zones = np.array([surface.chip_zone or 0.0 for surface in surfaces])
        self.terms = [name for name in view.of_surfaces if name[0] == "a"]
        self.others = [k for k, surface in enumerate(surfaces) if not (surface.is_break or _is_even(surface))]

    @once_a_context
    def centre(self, context: EvaluationContext) -> Number:
        """Thickness in mm on the axis, signed as in the lens."""
        each: Number = context.state.of_surfaces("thickness")
        total = each
        start = np.arange(len(self.end))
        for step in range(1, int((self.end - start).max())):
            within = start + step < self.end
            total = total + np.where(within, each[np.where(within, start + step, 0)], 0.0)
        return total

    @once_a_context
    def edge(self, context: EvaluationContext, code: int) -> Number:
        """Thickness in mm at the edge; code: the number of a side in `SIDES`, plus RIM at the common rim."""
        return edge_thickness(self.centre(context), *self.sags(context, code))

    def whole(self, context: EvaluationContext, code: int) -> Number:
        """Thickness in mm along the axis between the extreme points of both surfaces, at the centre or at the edge."""
        front, back = self.sags(context, code)
        return self.centre(context) + (np.maximum(back, 0.0) - np.minimum(front, 0.0))

    @once_a_context
    def sags(self, context: EvaluationContext, code: int) -> tuple[Number, Number]:
        """Sags in mm (S,) of the surfaces on both sides of every gap, at their own semi-diameters or at the rim."""
        sizes, every = self.semi_diameters.at(context), np.arange(len(self.end))
        if code < RIM:
            sags_there = self._sag(context, code, every, sizes)
            return sags_there, sags_there[self.end]
        rim = rims(sizes + self.chip_zones, self.end, ~self.is_air & (self.end > every))
        if code >= 2 * RIM:
            rim, code = rim * ((code - 2 * RIM + 1) / ZONES), RIM
        front, back = (self._sag(context, code - RIM, surfaces, rim) for surfaces in (every, self.end))
        return front, back

    def _sag(self, context: EvaluationContext, code: int, surfaces: np.ndarray, heights: Number) -> Number:
        """Sag in mm (S,) of surfaces at heights (S,)."""
        state, (x, y) = context.state, SIDES[code]
        sag = self._even_sag(state, surfaces, heights)
        asked = np.flatnonzero(np.isin(surfaces, self.others) & ~np.isnan(value_of(heights)))
        if not asked.size:
            return sag
        values, slopes = value_of(sag).copy(), slope_of(sag, state.count).copy()
        for place in asked:
            sag_of = lambda lens, s, k=surfaces[place]: sag_at(lens.surfaces[k], x * s, y * s)  # noqa: E731
            z = state.each_through_torch(sag_of, [heights[place : place + 1]])
            values[place], slopes[:, place] = value_of(z)[0], slope_of(z, state.count)[:, 0]
        return Dual(values, slopes) if state.count else values

    @once_a_context
    def shortfall(self, context: EvaluationContext) -> Number:
        """Length in mm by which surfaces fall short of their semi-diameters s, negative if not: s (q - 1)/2.

        q = (1+k) c² s² is 1 where a conic closes at s; near there it is s - 1/(|c| √(1+k)).
        """
        heights = self.semi_diameters.at(context)
        every = np.arange(len(self.end))
        return 0.5 * heights * (self._closing(context.state, every, heights * heights) - 1.0)

    def _closing(self, state: LensState, surfaces: np.ndarray, u: Number) -> Number:
        """(1+k) c² u, which is 1 at the edge of a closed conic."""
        c = state.of_surfaces("curvature")[surfaces]
        return (1 + state.of_surfaces("conic")[surfaces]) * (c * c) * u

    def _even_sag(self, state: LensState, surfaces: np.ndarray, heights: Number) -> Number:
        """c u/(1 + √(1 - q)) + Σ a_j u^j, u = s², q = (1+k) c² u.

        Of a conic that closes within s, from 1 - q = ε on, 1 - q is ε/(1 + τ + τ²), τ = 1 - (1 - q)/ε: above 0, with
        two continuous derivatives.
        """
        u, c = heights * heights, state.of_surfaces("curvature")[surfaces]
        left = 1 - self._closing(state, surfaces, u)
        closed = value_of(left) < _EDGE
        if closed.any():
            over = np.where(closed, 1 - left / _EDGE, 0.0)
            left = np.where(closed, _EDGE / (1 + over + over * over), left)
        sag = conic_sag(u, c, np.sqrt(left))
        return sag + u * polynomial([state.of_surfaces(name)[surfaces] for name in self.terms], u)

    def slenderness(self, context: EvaluationContext) -> Number:
        """Diameter over centre thickness of glasses."""
        thickness = np.where(self.is_air, 1.0, self.side * self.centre(context))
        return 2.0 * self.semi_diameters.at(context) / thickness

    def of_glass(self, context: EvaluationContext, number: Callable[..., Tensor]) -> Number:
        """A number of the glasses behind the surfaces, of their indices at the lines d, F and C."""

        def numbers(lens: Lens) -> list[Tensor]:
            indices = media(lens, lens.wavelengths.new_tensor([0.5875618, 0.4861327, 0.6562725]))
            pairs = zip(indices, self.is_air, strict=True)
            return [torch.zeros(()) if air else number(*n.expand(3)) for n, air in pairs]

        return listed(context.state.through_torch(numbers), context.state.count)


def _is_even(surface: Surface) -> bool:
    """Whether the sag is that of a conic with even terms at most, which `Gaps` computes in numpy."""
    return surface.sag_terms is None and (surface.coefficients is None or surface.kind == EVEN)


class Amount(NamedTuple):
    """A number (S,) of all surfaces, which rows compare, by the gaps, a context and the code of a row.

    length: its power of length; needs: of the surfaces of rows, "edges" of the gaps behind them, or "semi-diameters".
    """

    number: Callable[[Gaps, EvaluationContext, int], Number]
    length: int = 0
    needs: str = ""


_CENTRE = Amount(lambda gaps, context, code: gaps.centre(context), 1)
_EDGE_THICKNESS = Amount(Gaps.edge, 1, "edges")
_SHORTFALL = Amount(lambda gaps, context, code: gaps.shortfall(context), 1, "semi-diameters")
_CURVATURE = Amount(lambda gaps, context, code: context.state.of_surfaces("curvature"), -1)

# -- surfaces of a row -------------------------------------------------------------------------------------------------

#: The surfaces of a row, each with a code.
Chosen = Callable[[Line, Planner], list[tuple[int, int]]]


def _single(line: Line, planner: Planner) -> list[tuple[int, int]]:
    """The surface of a row, and the side of its edge. Raises BadRow."""
    surface, code = planner.checked(line, line.row.integers[0]), line.row.integers[1]
    return [(surface, (code if 0 <= code < len(SIDES) else 0) + _rim_of(line))]


def _zones(line: Line, planner: Planner) -> list[tuple[int, int]]:
    """The surface of a row, once for every height. Raises BadRow."""
    surface = planner.checked(line, line.row.integers[0])
    return [(surface, 2 * RIM + zone) for zone in range(ZONES)]


def _rim_of(line: Line) -> int:
    return RIM if line.pupil[1] else 0


def _range(line: Line, planner: Planner, *, air: bool | None = None) -> list[tuple[int, int]]:
    """The surfaces of a row, from the first behind the object to the last before the image, without breaks.

    air: of those in front of air, or of glass, alone.
    """
    first, last = line.row.integers
    surfaces = range(max(first, 1), min(last, planner.image - 1) + 1)
    is_air = planner.shared(Gaps).is_air
    chosen = (k for k in surfaces if not planner.lens.surfaces[k].is_break and air in (None, is_air[k]))
    return [(k, _rim_of(line)) for k in chosen]


_in_glass, _in_air = partial(_range, air=False), partial(_range, air=True)


def _ends(line: Line, planner: Planner, *, chosen: Chosen) -> list[tuple[int, int]]:
    """The surfaces at the start and the end of the gaps, each once a row; the image has no edge."""
    ends = [end for k, _ in chosen(line, planner) for end in (k, int(planner.shared(Gaps).end[k]))]
    return [(k, 0) for k in dict.fromkeys(ends) if 0 < k < planner.image]


# -- comparison --------------------------------------------------------------------------------------------------------


class _Places:
    """The surfaces (P,) of all rows, the row of each, and their amounts at a state."""

    def __init__(self, amount: Amount, chosen: Chosen, lines: Sequence[Line], planner: Planner):
        places = [(number, *pair) for number, line in enumerate(lines) for pair in chosen(line, planner)]
        self.rows, self.surfaces, self.codes = np.array(places, dtype=int).reshape(-1, 3).T
        self.amount, self.gaps, self.each = amount, planner.shared(Gaps), sorted(set(self.codes.tolist()))
        if amount.needs:
            ends = self.gaps.end[self.surfaces] if amount.needs == "edges" else self.surfaces
            self.gaps.semi_diameters.ask([*self.surfaces.tolist(), *ends.tolist()])
            if amount.needs == "edges" and max(self.each, default=0) >= RIM:  # of the elements on both sides
                self.gaps.semi_diameters.ask(range(1, len(self.gaps.end)))

    def values(self, context: EvaluationContext) -> np.ndarray:
        """The amounts (P,) without derivatives."""
        values = np.zeros(len(self.rows))
        for code in self.each:
            same = self.codes == code
            values[same] = value_of(self.amount.number(self.gaps, context, code))[self.surfaces[same]]
        return values

    def at(self, context: EvaluationContext, places: np.ndarray) -> Number:
        """The amounts of some places, with derivatives."""
        numbers = np.zeros(len(places))
        for code in self.each:
            each = self.amount.number(self.gaps, context, code)[self.surfaces[places]]
            numbers = each if len(self.each) == 1 else np.where(self.codes[places] == code, each, numbers)
        return numbers


def _largest_violations(violated: np.ndarray, rows: np.ndarray, violations: np.ndarray) -> np.ndarray:
    """The place of the largest violation of every row."""
    order = violated[np.argsort(-violations[violated], kind="stable")]
    return order[np.unique(rows[order], return_index=True)[1]]


def _within(
    lines: Sequence[Line], planner: Planner, *, amount: Amount, chosen: Chosen, side: float, also: Amount | None = None
) -> Evaluate:
    """Rows that are their target if no surface passes it, else off by the violations.

    also: violations of the surfaces at both ends of the gaps, mm, whatever the target.
    """
    places = _Places(amount, chosen, lines, planner)
    targets = np.array([line.row.target for line in lines]) * planner.unit**amount.length
    summed = planner.conventions.boundary == "sum"
    ends = None if also is None else _Places(also, partial(_ends, chosen=chosen), lines, planner)
    rows = places.rows if ends is None else np.concatenate([places.rows, ends.rows])
    surfaces = places.surfaces if ends is None else np.concatenate([places.surfaces, ends.surfaces])

    def with_derivatives(context: EvaluationContext, some: np.ndarray) -> Number:
        """The violations of some places."""
        first = some[some < len(places.rows)]
        violations = side * (targets[places.rows[first]] - places.at(context, first))
        further = some[some >= len(places.rows)] - len(places.rows)
        if ends is None or not len(further):
            return violations
        return np.concatenate([violations, ends.at(context, further)])

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


def _value(amount: Amount) -> Plan:
    """Rows of the amount itself, of one surface."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        places, every = _Places(amount, _single, lines, planner), np.arange(len(lines))
        return lambda context: RowValues(places.at(context, every))

    return plan


_SUM = (
    "`boundary` sum: of the violations of all surfaces, or largest; `behind_mirrors` reversed: thicknesses behind an "
    "odd number of mirrors are compared along the light, or signed: as the lens has them"
)
_SIGNED = "thicknesses behind mirrors as the lens has them, negative"
_SIDE = "thickness at the edge behind surface int1; int2: 0 +y, 1 +x, 2 -y, 3 -x"
_WHOLE = "thickness behind surface int1 between the extreme points of both surfaces"

_CENTRE_ALONG = Amount(lambda gaps, context, code: gaps.side * gaps.centre(context), 1)
_EDGE_ALONG = Amount(lambda gaps, context, code: gaps.side * gaps.edge(context, code), 1, "edges")
_SEMI_DIAMETER = Amount(lambda gaps, context, code: gaps.semi_diameters.at(context), 1, "semi-diameters")
_SLENDERNESS = Amount(lambda gaps, context, code: gaps.slenderness(context), needs="semi-diameters")
_INDEX = Amount(lambda gaps, context, code: gaps.of_glass(context, lambda d, F, C: d))
_ABBE_NUMBER = Amount(lambda gaps, context, code: gaps.of_glass(context, lambda d, F, C: (d - 1) / (F - C)))

#: Of surfaces int1 to int2: tail of the names, amount, surfaces, text, violations of the ends of the gaps.
_OF_RANGES = (
    ("CG", _CENTRE_ALONG, _in_glass, "thickness on the axis in glass", None),
    ("CA", _CENTRE_ALONG, _in_air, "thickness on the axis in air, behind mirrors too", None),
    ("CT", _CENTRE_ALONG, _range, "thickness on the axis in glass and air", None),
    ("EG", _EDGE_ALONG, _in_glass, "thickness at the edge in glass", _SHORTFALL),
    ("EA", _EDGE_ALONG, _in_air, "thickness at the edge in air, behind mirrors too", _SHORTFALL),
    ("ET", _EDGE_ALONG, _range, "thickness at the edge in glass and air", _SHORTFALL),
    ("CV", _CURVATURE, _range, "curvature", None),
    ("SD", _SEMI_DIAMETER, _range, "semi-diameter", None),
    ("DT", _SLENDERNESS, _in_glass, "diameter over thickness of glasses", None),
    ("IN", _INDEX, _in_glass, "index of glasses at the d line", None),
    ("AB", _ABBE_NUMBER, _in_glass, "Abbe number of glasses at the d line", None),
)

_DIAMETER = Amount(lambda gaps, context, code: 2.0 * gaps.semi_diameters.at(context), 1, "semi-diameters")
_CONIC = Amount(lambda gaps, context, code: context.state.of_surfaces("conic"))

#: Of surface int1: head of the names, amount, text, convention, violations of the ends of the gap.
_OF_ONE = (
    ("CT", _CENTRE, "thickness on the axis behind surface int1", _SIGNED, None),
    ("ET", _EDGE_THICKNESS, _SIDE, _SIGNED, _SHORTFALL),
    ("TT", Amount(Gaps.whole, 1, "edges"), _WHOLE, _SIGNED, _SHORTFALL),
    ("CV", _CURVATURE, "curvature of surface int1", "", None),
    ("CO", _CONIC, "conic constant of surface int1", "", None),
    ("DM", _DIAMETER, "diameter of surface int1", "", None),
)

_FULL = Amount(Gaps.edge, 1, "edges")

BOUNDARIES: dict[str, Operand] = {
    **{
        f"FT{tail}": Operand(
            partial(_within, amount=_FULL, chosen=_zones, side=side),
            f"thickness behind surface int1 at {ZONES} heights up to the common rim, {word} the target",
            1,
            f"{_SIGNED}; `boundary` sum: of the violations at all heights, or largest",
            bounds=relation,
        )
        for tail, side, word, relation in (("GT", 1.0, "at least", ">="), ("LT", -1.0, "at most", "<="))
    },
    **{
        f"{head}{tail}": Operand(
            partial(_within, amount=amount, chosen=chosen, side=side, also=also),
            f"{word} {text}, surfaces int1 to int2",
            amount.length,
            _SUM,
            bounds=relation,
        )
        for tail, amount, chosen, text, also in _OF_RANGES
        for head, side, word, relation in (("MN", 1.0, "least", ">="), ("MX", -1.0, "largest", "<="))
    },
    **{
        f"{head}{tail}": Operand(
            partial(_within, amount=amount, chosen=_single, side=side, also=also),
            f"{text}, {word} the target",
            amount.length,
            convention,
            bounds=relation,
        )
        for head, amount, text, convention, also in _OF_ONE
        for tail, side, word, relation in (("GT", 1.0, "at least", ">="), ("LT", -1.0, "at most", "<="))
    },
    **{
        f"{head}VA": Operand(_value(amount), text, amount.length, convention)
        for head, amount, text, convention, _ in _OF_ONE
    },
}
