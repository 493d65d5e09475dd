"""Operands of boundaries: thicknesses, curvatures, conics and semi-diameters that shall not pass a target.

A row over several surfaces is its target where all of them comply, else less, or more, by the sum of what they lack. So
its error is 0 and does not move where the boundary is kept, and grows from 0 steadily where it is passed. Breaks of
coordinates are no surfaces here, and a gap ends at the next one that is none. A surface that closes before its
semi-diameter has no edge: it lacks what it falls short of it in every row of edges, whichever side that bounds.

Semi-diameters: how far the light of all fields reaches from the vertex of every surface, with derivatives.

    s = (1 + a/100) max √(x² + y²) + c

over all fields and wavelengths and the ends of the two diameters of the pupil, at every state; a per cent and c mm are
the margin of `OptimizationData`, which neither the stop nor the image has. The derivative is that of the largest ray.

Gaps: what stands behind the surfaces of a lens: thicknesses at centre and edge, and sags, with derivatives.

A gap goes from a surface to the next one that is no coordinate break. All of them are found at once, when the first row
asks at a state; arrays (S,) have an entry for every surface, of which only those that were asked for mean anything.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch

from raytrace.materials.glass import is_air
from raytrace.maths.dual import Dual, value_of
from raytrace.optimization.context import Evaluate, EvaluationContext, Found, Line, Operand, Planner
from raytrace.optimization.lens_state import ENDS, LensState
from raytrace.optimization.ray_bundle import Bundle, Marks
from raytrace.system.shapes import EVEN
from raytrace.system.surface import Surface, medium_surfaces, sag_at
from raytrace.tracing.trace import media


class SemiDiameters:
    """Those of the surfaces that are asked for; rays are traced only where one of these follows them."""

    def __init__(self, planner: Planner):
        lens, view = planner.lens, planner.view
        self.given = given_semi_diameters(view)
        percent, length = (0.0, 0.0) if lens.optimization_data is None else lens.optimization_data.semi_diameter_margin
        without = (lens.stop, planner.image)
        surfaces = range(len(lens.surfaces))
        self.factors = np.array([1.0 if k in without else 1 + percent / 100 for k in surfaces])
        self.lengths = np.array([0.0 if k in without else length for k in surfaces])
        self.view, self.asked, self._bundle = view, set(), None

    def ask(self, surfaces: Iterable[int]) -> None:
        """Tell, while rows are planned, whose semi-diameters will be looked at."""
        self.asked |= set(surfaces)

    def at(self, context: EvaluationContext):
        """mm (S,) of all surfaces; nan of those that were not asked for, and where no ray arrives."""
        return context.once(self._found)

    def _found(self, context: EvaluationContext):
        found = np.full(len(self.factors), np.nan)
        follow = sorted(self.asked - set(self.given))
        slopes = np.zeros((context.state.count, len(found)))
        if follow:
            places = np.array(follow) - 1
            heights, by = largest_heights(self.bundle(follow[-1]).marks(context.state), places)
            found[follow] = self.factors[follow] * heights + self.lengths[follow]
            if by is not None:
                slopes[:, follow] = self.factors[follow] * by
        for surface, number in self.given.items():
            found[surface] = number
        return Dual(found, slopes) if context.state.count else found

    def bundle(self, last: int) -> Bundle:
        """The rays up to a surface; `last` is the same in every call, once rows are planned."""
        if self._bundle is None:
            self._bundle = outermost(self.view, last)
        return self._bundle


def given_semi_diameters(view) -> dict[int, float]:
    """mm, by surface: those that stay as they are; the object's is 0 where none is told."""
    surfaces, optimization_data = view.lens.surfaces, view.lens.optimization_data
    stay = range(len(surfaces)) if optimization_data is None else optimization_data.semi_diameters
    told = {k: float(surfaces[k].semi_diameter) for k in stay if surfaces[k].semi_diameter}
    return {0: surfaces[0].semi_diameter or 0.0} | told


def outermost(view, last: int) -> Bundle:
    """The rays through the `ENDS` of all fields and wavelengths, on the surfaces 1 to `last`."""
    fields, found = view.lens.fields, Bundle(view, last)
    x, y = fields.x.detach().numpy(), fields.y.detach().numpy()
    largest = np.hypot(x, y).max() or 1.0
    for wavelength in range(len(view.wavelengths)):
        for field in zip((x / largest).tolist(), (y / largest).tolist(), strict=True):
            for end in ENDS:
                found.ask(wavelength, field, end)
    return found


def largest_heights(marks: Marks, places: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Largest √(x² + y²) mm (P,) at some surfaces of a bundle, and its derivatives (V, P); nan where no ray arrives."""
    x, y, valid = marks.x[places], marks.y[places], marks.valid[places]
    heights = np.where(valid, np.hypot(x, y), -1.0)
    ray, rows = heights.argmax(-1), np.arange(len(places))
    found = heights[rows, ray]
    found = np.where(found < 0, np.nan, found)
    if marks.by_x is None:
        return found, None
    cosine, sine = (part[rows, ray] / np.where(found > 0, found, 1.0) for part in (x, y))
    by_x, by_y = (part[places, :, ray] for part in (marks.by_x, marks.by_y))
    return found, np.where(np.isnan(found)[:, None], 0.0, cosine[:, None] * by_x + sine[:, None] * by_y).T


#: Where on the edge of a surface a row looks, by its code: +y, +x, -y, -x.
SIDES = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))

_EDGE = 1e-4  # of 1 - (1+k) c² s²: how near its edge the root of a conic is held


class Gaps:
    """The gaps of a lens in one configuration."""

    def __init__(self, planner: Planner):
        view, surfaces = planner.view, planner.lens.surfaces
        self.semi_diameters = planner.shared(SemiDiameters)
        self.is_air = np.array([is_air(surfaces[k].glass) for k in medium_surfaces(surfaces)])
        #: -1 behind an odd number of mirrors, where light goes towards -z.
        self.side = np.where(view.indices[0] < 0, -1.0, 1.0)
        #: The surface behind each that ends its gap.
        self.end = np.array([_next(surfaces, k) for k in range(len(surfaces))])
        self.stored = {"thickness": np.array(view.thickness), "curvature": np.array(view.curvature)}
        self.stored |= {"conic": np.array([0.0 if s.conic is None else float(s.conic.detach()) for s in surfaces])}
        terms = [_even_terms(surface) for surface in surfaces]
        self.terms = [f"a{2 * j + 2}" for j in range(max(map(len, terms)))]
        for j, name in enumerate(self.terms):
            self.stored[name] = np.array([own[j] if j < len(own) else 0.0 for own in terms])
        self.others = [k for k, surface in enumerate(surfaces) if not (surface.is_break or is_even(surface))]

    def ask_edges(self, surfaces: Iterable[int]) -> None:
        """Tell, while rows are planned, behind which surfaces edges will be looked at."""
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
        """mm on the axis, as the lens has them."""
        return context.once(self._centre)

    def _centre(self, context: EvaluationContext):
        own = found = self.numbers(context.state, "thickness")
        start = np.arange(len(self.end))
        for step in range(1, int((self.end - start).max())):
            within = start + step < self.end
            found = found + np.where(within, own[np.where(within, start + step, 0)], 0.0)
        return found

    def edge(self, context: EvaluationContext, code: int = 0):
        """mm at the edge: t + z′ - z, each surface at its own semi-diameter; code: the number of a side in `SIDES`."""
        return context.once(self._edge, code)

    def _edge(self, context: EvaluationContext, code: int):
        z = self.sag(context, code)
        return self.centre(context) + (z[self.end] - z)

    def whole(self, context: EvaluationContext, code: int = 0):
        """mm along the axis between what stands out furthest, of both surfaces, be it at the centre or at the edge."""
        z = self.sag(context, code)
        return self.centre(context) + (np.maximum(z[self.end], 0.0) - np.minimum(z, 0.0))

    def sag(self, context: EvaluationContext, code: int = 0):
        """mm at the semi-diameters."""
        return context.once(self._sag, code)

    def _sag(self, context: EvaluationContext, code: int):
        heights = self.semi_diameters.at(context)
        found = self._even_sag(context.state, heights)
        asked = [k for k in self.others if not np.isnan(value_of(heights)[k])]
        if not asked:
            return found
        count = context.state.count
        found = found if isinstance(found, Dual) or not count else Dual(found, np.zeros((count, 1)))
        values, slopes = value_of(found).copy(), found.full().copy() if count else None
        for k in asked:
            one = _sag_by_torch(context.state, k, heights[k], SIDES[code])
            values[k] = value_of(one)
            if count:
                slopes[:, k] = one.slope
        return Dual(values, slopes) if count else values

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
        found = c * u / (1 + np.sqrt(left))
        power = u
        for name in self.terms:
            found = found + power * self.numbers(state, name)
            power = power * u
        return found


def is_even(surface: Surface) -> bool:
    """Whether the sag is that of a conic with even terms at most, which is told here in numpy."""
    return surface.sag_terms is None and (surface.coefficients is None or surface.kind == EVEN)


def _even_terms(surface: Surface) -> list[float]:
    return surface.coefficients.tolist() if surface.coefficients is not None and is_even(surface) else []


def _next(surfaces: tuple[Surface, ...], start: int) -> int:
    """The next surface that is no coordinate break, or the image."""
    last = len(surfaces) - 1
    return next((k for k in range(start + 1, last) if not surfaces[k].is_break), last)


def _sag_by_torch(state: LensState, surface: int, height, side: tuple[float, float]):
    """The sag of a surface of any kind, a number ()."""
    with torch.enable_grad():
        leaves, lens = state.view.leaves({at: value_of(n) for at, n in state.numbers.items()})
        s = torch.tensor(float(value_of(height)), dtype=torch.float64, requires_grad=True)
        z = sag_at(lens.surfaces[surface], side[0] * s, side[1] * s)
        if not state.count:
            return float(z.detach())
        by_height = torch.autograd.grad(z, s, retain_graph=True)[0]
        return state.chained(z, leaves) + float(by_height) * (height - value_of(height))


_AT_LEAST, _AT_MOST = 1.0, -1.0

#: What is compared: numbers (S,) of all surfaces at a state.
Amounts = Callable[[EvaluationContext], object]

#: How rows are prepared to be compared: of a planner, the surfaces they look at, and their code.
Prepared = Callable[[Planner, Sequence[int], int], Amounts]


# -- what is compared --------------------------------------------------------------------------------------------------


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
    """Thicknesses behind an odd number of mirrors turned to positive ones."""

    def prepare(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
        amounts, side = prepared(planner, surfaces, 0), planner.shared(Gaps).side
        if planner.conventions.behind_mirrors == "signed" or (side > 0).all():
            return amounts
        return lambda context: side * amounts(context)

    return prepare


def _semi_diameter(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    found = planner.shared(SemiDiameters)
    found.ask(surfaces)
    return found.at


def _diameter(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    found = _semi_diameter(planner, surfaces, code)
    return lambda context: 2.0 * found(context)


def _slenderness(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
    """Diameter over centre thickness."""
    diameter, thickness = _diameter(planner, surfaces, code), _along_light(_centre)(planner, surfaces, code)
    asked = np.isin(np.arange(planner.image + 1), surfaces)
    return lambda context: diameter(context) / np.where(asked, thickness(context), 1.0)


def _number(quantity: str) -> Prepared:
    def prepare(planner: Planner, surfaces: Sequence[int], code: int) -> Amounts:
        gaps = planner.shared(Gaps)
        return lambda context: gaps.numbers(context.state, quantity)

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

        def amounts(context: EvaluationContext):
            found = context.state.through_torch(numbers)
            values = np.array([float(value_of(number)) for number in found])
            return Dual(values, np.stack([number.slope for number in found], -1)) if context.state.count else values

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
    """The surfaces (P,) of all rows: `rows`, of which row each is; `at`, their amounts at a state."""

    def __init__(self, prepared: Prepared, chosen: Chosen, lines: Sequence[Line], planner: Planner):
        found = [(number, *pair) for number, line in enumerate(lines) for pair in chosen(line, planner)]
        self.rows, self.surfaces, self.codes = np.array(found, dtype=int).reshape(-1, 3).T
        self.amounts = {
            code: prepared(planner, self.surfaces[self.codes == code].tolist(), code)
            for code in sorted(set(self.codes.tolist()))
        }

    def values(self, context: EvaluationContext) -> np.ndarray:
        """Without derivatives."""
        found = np.zeros(len(self.rows))
        for code, tell in self.amounts.items():
            own = self.codes == code
            found[own] = value_of(tell(context))[self.surfaces[own]]
        return found

    def at(self, context: EvaluationContext, places: np.ndarray):
        """Those of some places, with derivatives."""
        found = np.zeros(len(places))
        for code, tell in self.amounts.items():
            own = tell(context)[self.surfaces[places]]
            found = own if len(self.amounts) == 1 else np.where(self.codes[places] == code, own, found)
        return found


def within(prepared: Prepared, chosen: Chosen, side: float, length: int, also: Prepared | None = None):
    """Rows that are their target where no surface passes it, else off by what the surfaces lack.

    also: what the surfaces at both ends of the gaps lack whatever the target is, mm.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        places = _Places(prepared, chosen, lines, planner)
        targets = np.array([line.row.target for line in lines]) * planner.unit**length
        counted = LACKS[planner.conventions.boundary]
        closed = None if also is None else _Places(also, _both(chosen), lines, planner)
        rows = places.rows if closed is None else np.concatenate([places.rows, closed.rows])
        surfaces = places.surfaces if closed is None else np.concatenate([places.surfaces, closed.surfaces])

        def lacking(context: EvaluationContext, chosen: np.ndarray):
            """What some places lack, with derivatives."""
            first = chosen[chosen < len(places.rows)]
            lacks = side * (targets[places.rows[first]] - places.at(context, first))
            further = chosen[chosen >= len(places.rows)] - len(places.rows)
            return np.concatenate([lacks, closed.at(context, further)]) if len(further) else lacks

        def evaluate(context: EvaluationContext) -> Found:
            lacks = side * (targets[places.rows] - places.values(context))
            lacks = lacks if closed is None else np.concatenate([lacks, closed.values(context)])
            sides = (rows, lacking(context, np.arange(len(rows))), surfaces) if counted is _all else ()
            passed = counted(np.flatnonzero(~(lacks <= 0)), rows, lacks)  # nan is none that complies
            if not passed.size:
                return Found(targets, sides=sides)
            of_row = (rows[passed] == np.arange(len(lines))[:, None]).astype(float)
            return Found(targets - side * (of_row @ lacking(context, passed)), sides=sides)

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


#: Which of the places that pass a target count, by `Conventions.boundary`.
LACKS = {"sum": _all, "largest": _largest}


def value(prepared: Prepared):
    """Rows of the amount itself, of one surface."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        places = _Places(prepared, _single, lines, planner)
        every = np.arange(len(lines))
        return lambda context: Found(places.at(context, every))

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
            convention=_SUM,
            bounds=_RELATIONS[side],
        )
        for head, side, word in _SIDES
    }


def _of_one(
    head: str, prepared: Prepared, text: str, length: int = 0, convention: str = "", also: Prepared | None = None
) -> dict[str, Operand]:
    """GT, LT and VA of a number of surface int1."""
    bounds = {
        f"{head}{tail}": Operand(
            within(prepared, _single, side, length, also),
            f"{text}, {word} the target",
            length,
            convention,
            bounds=_RELATIONS[side],
        )
        for tail, side, word in _BOUNDS
    }
    return bounds | {f"{head}VA": Operand(value(prepared), text, length, convention)}


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
