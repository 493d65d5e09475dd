"""Elements and cemented groups of a lens that parts of stock replace; see `fitting`."""

import dataclasses
import math
import warnings
from dataclasses import dataclass
from os import PathLike, fspath
from typing import Any

import numpy as np

from raytrace.edit.parts import faces_of, left_of, no_group, turned_part, with_part
from raytrace.materials.glass import abbe_number, nd
from raytrace.maths.result import Column, Columns
from raytrace.optimization.fitting import Design, Fit, Item, free_of, relaxed
from raytrace.optimization.least_squares import SumOfSquares
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.variables import DesignVariables, VariedGlass, with_modelled
from raytrace.stock.index import StockPart, lenses_of, parts_of
from raytrace.stock.parts import data_of, is_round
from raytrace.system.elements import cemented_groups, lens_elements
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import GLASS
from raytrace.system.surface import Surface
from raytrace.tracing.geometry import light_diameter
from raytrace.words import RaytraceError, option

_NEAR = 3.0  # largest factor between the powers of an element and of its part
#: Parts, in one orientation, that an expansion by the numbers of the element selects; the nearest weaker and stronger.
_SELECTED, _NEAREST = 8, 4
_TIGHT = 1e-3  # relative part by which the light may exceed a part


@dataclass(frozen=True)
class Oriented:
    """A part in an orientation."""

    part: StockPart
    reverse: bool

    @property
    def words(self) -> str:
        return f"{self.part.figures.part}{', reversed' if self.reverse else ''}"

    @property
    def key(self) -> tuple[str, bool]:
        return self.part.file, self.reverse

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Oriented) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


class StockFit(Fit):
    """A fit of the elements and cemented groups of a lens to parts of as many surfaces.

    Elements none of whose curvatures vary, or follow by a solve, stay, and so do elements without power.
    """

    what = "parts"

    def __init__(self, design: Design, index: str | PathLike, **settings: Any):
        super().__init__(design, source=fspath(index), **settings)
        self.parts = [part for part in parts_of(index) if part.figures.elements == part.figures.surfaces - 1]
        self.index, self.read = index, dict[str, tuple[Surface, ...] | None]()
        self.of_element: dict[Item, tuple[float, float]] = {}  # EFL and clear diameter

    # -- elements -----------------------------------------------------------------------------------------------------

    def items(self) -> list[Item]:
        model, x = self.design.problem.model, self.design.state.x
        lens, groups = model.lens_at(x), []
        rules: tuple[Vary | Solve, ...] = (*model.variables, *model.solves)
        moved = {rule.address for rule in rules}
        cemented = cemented_groups(lens)
        singles = [pair for pair in lens_elements(lens) if not any(a <= pair[0] < b for a, b in cemented)]
        for first, last in sorted([*cemented, *singles]):
            if not any((k, "curvature") in moved for k in range(first, last + 1)):
                continue
            item = Item((first, last))
            if why := no_group(lens, first, last):
                self.missing.append((item.words, why))
                continue
            faces = self._faces(lens, item)
            efl = float(data_of(faces, lens.primary).effective_focal_length)
            self.of_element[item] = efl, light_diameter(lens, range(first, last + 1))
            if not self._possible(item):
                self.missing.append((item.words, self._none(item)))
            elif not self._outside(item):
                message = f"{option('stock')}: no air space varies, by which parts are placed"
                raise NoProblem(f"{message}; add thickness, or sensor, to {option('vary')}")
            else:
                groups.append(item)
        return groups

    def _outside(self, item: Item) -> bool:
        """Whether a variable is left when all elements are replaced."""
        kept = self.design.problem.model.variables
        for other in self.of_element:
            kept, _ = left_of(kept, (), other.surfaces[0], other.surfaces[-1])
        return bool(kept)

    @staticmethod
    def _faces(lens: Lens, item: Item) -> tuple[Surface, ...]:
        first, last = item.surfaces[0], item.surfaces[-1]
        end = lens.surfaces[last]
        return (*lens.surfaces[first:last], dataclasses.replace(end, thickness=0 * end.thickness))

    def _possible(self, item: Item) -> list[StockPart]:
        """Parts of as many surfaces that are large enough, of about the power, nearest first."""
        efl, clear = self.of_element[item]
        count = item.surfaces[-1] - item.surfaces[0] + 1
        near = [
            (abs(math.log(part.figures.efl / efl)), part)
            for part in self.parts
            if part.figures.surfaces == count
            and part.figures.efl * efl > 0
            and part.figures.clear >= clear * (1 - _TIGHT)
            and 1 / _NEAR < part.figures.efl / efl < _NEAR
        ]
        return [part for _, part in sorted(near, key=lambda pair: pair[0])]

    def _none(self, item: Item) -> str:
        efl, clear = self.of_element[item]
        count = item.surfaces[-1] - item.surfaces[0]
        kind = "element" if count == 1 else f"cemented group of {count} elements"
        return f"no {kind} with EFL {efl:.4g} mm (to a factor of {_NEAR:g}) and clear diameter {clear:.4g} mm"

    def _surfaces(self, part: StockPart) -> tuple[Surface, ...] | None:
        """The surfaces of a part; None of one that is not round."""
        if part.file not in self.read:
            self._read([part])
        return self.read[part.file]

    def _read(self, parts: list[StockPart]) -> None:
        for file, lens in lenses_of(self.index, [part.file for part in parts if part.file not in self.read]).items():
            faces = faces_of(lens)
            self.read[file] = faces if is_round(faces) else None

    def oriented(self, candidate: Oriented) -> tuple[Surface, ...]:
        faces = self._surfaces(candidate.part)
        assert faces is not None, "a round part"
        return turned_part(faces) if candidate.reverse else faces

    # -- candidates ---------------------------------------------------------------------------------------------------

    def candidates(self, design: Design, item: Item) -> list[tuple[float, Oriented]]:
        parts = self._possible(item)
        self._read(parts)
        every = [
            Oriented(part, reverse) for part in parts if self._surfaces(part) is not None for reverse in (False, True)
        ]
        estimates = self._estimates(design, item, every)
        order = [int(k) for k in np.argsort(estimates, kind="stable")]
        efl, _ = self.of_element[item]
        weaker = [k for k, candidate in enumerate(every) if candidate.part.figures.efl / efl > 1]
        stronger = [k for k in range(len(every)) if k not in weaker]
        some = dict.fromkeys([*order[:_SELECTED], *weaker[: 2 * _NEAREST], *stronger[: 2 * _NEAREST]])
        trials = [(self._predicted(design, item, every[k]), every[k]) for k in some]
        trials = [(merit, candidate) for merit, candidate in trials if math.isfinite(merit)]
        if not trials:
            trials = [(math.inf, every[0])]
        return sorted(trials, key=lambda pair: pair[0])

    def _estimates(self, design: Design, item: Item, every: list[Oriented]) -> np.ndarray:
        """Merits by an expansion in the curvatures, thicknesses and glasses of the element, all other variables
        following."""
        first, last = item.surfaces[0], item.surfaces[-1]
        lens = design.problem.model.lens_at(design.state.x)
        single = len(lens.wavelengths) == 1
        names = [*((k, "curvature") for k in range(first, last + 1)), *((k, "thickness") for k in range(first, last))]
        names += [(k, name) for k in range(first, last) for name in [*GLASS][: 1 if single else 2]]
        numbers = tuple(Vary(k, name) for k, name in names)
        variables, solves = left_of(design.problem.model.variables, design.problem.model.solves, first, last)
        bounds = {
            v.name: pair for v, *pair in zip(design.problem.model.variables, design.lower, design.upper, strict=True)
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", VariedGlass)
            model = DesignVariables(with_modelled(lens, numbers), (*variables, *numbers), solves)
        problem = design.problem.of(model)
        state = problem.state(model.start, True)
        inside = [k for k, v in enumerate(variables) if bounds[v.name][0] < model.start[k] < bounds[v.name][1]]
        columns = np.arange(len(variables), len(model.variables))
        quadratic = relaxed(state, np.array(inside, dtype=int), columns)
        values = np.array([self._numbers(self.oriented(candidate), single) for candidate in every])
        return quadratic.merit(values - model.start[columns])

    @staticmethod
    def _numbers(faces: tuple[Surface, ...], single: bool) -> list[float]:
        """Curvatures, thicknesses and glasses of a part, as the columns of its expansion."""
        curvatures = [0.0 if face.curvature is None else float(face.curvature) for face in faces]
        glasses = [face.glass for face in faces[:-1]]
        media = [[float(nd(g)), float(abbe_number(g))][: 1 if single else 2] for g in glasses]
        return [*curvatures, *(float(face.thickness) for face in faces[:-1]), *(n for pair in media for n in pair)]

    def _predicted(self, design: Design, item: Item, candidate: Oriented) -> float:
        """The merit with the part itself, by an expansion in the variables that follow; inf where light fails."""
        try:
            trial = self.placed(design, item, candidate)
        except (RaytraceError, ValueError):  # the glass does not cover the wavelengths
            return math.inf
        state = trial.state
        if not state.is_finite or state.lost > design.state.lost:
            return math.inf
        return float(np.sqrt(relaxed(state, free_of(trial)).cost))

    def placed(self, design: Design, item: Item, candidate: Oriented) -> Design:
        first, last = item.surfaces[0], item.surfaces[-1]
        old = design.problem.model
        addresses = {variable.address for variable in old.variables}
        moves = (first - 1, "thickness") in addresses, (last, "thickness") in addresses
        lens, _ = with_part(
            old.lens_at(design.state.x), first, self.oriented(candidate), name=candidate.part.figures.part, moves=moves
        )
        variables, solves = left_of(old.variables, old.solves, first, last)
        model = DesignVariables(lens, variables, solves)
        kept = [k for k, variable in enumerate(old.variables) if variable in variables]
        lower, upper = design.lower[kept], design.upper[kept]
        problem = design.problem.of(model)
        x = np.clip(model.start, lower, upper)
        state: SumOfSquares = problem.state(x, True)
        return Design(problem, lower, upper, state, {**design.chosen, item: candidate})

    def left_out(self, design: Design) -> list[tuple[str, str]]:
        model, notes = self.design.problem.model, []
        stored = () if model.lens.optimization_data is None else model.lens.optimization_data.kept
        for item in sorted(design.chosen, key=lambda item: item.surfaces):
            lost: list[str] = []
            left_of((), (*model.solves, *stored), item.surfaces[0], item.surfaces[-1], lost)
            if lost:
                notes.append((item.words, f"left out with the element: {', '.join(lost)}"))
        return notes

    def exceeded(self, design: Design) -> list[tuple[str, str]]:
        lens, notes = design.problem.model.lens_at(design.state.x), []
        for item, candidate in design.chosen.items():
            light, clear = (
                light_diameter(lens, range(item.surfaces[0], item.surfaces[-1] + 1)),
                candidate.part.figures.clear,
            )
            if light > clear * (1 + _TIGHT):
                notes.append(
                    (
                        item.words,
                        f"light of {light:.4g} mm, but {candidate.part.figures.part} is clear to {clear:.4g} mm",
                    )
                )
        return notes

    # -- report -------------------------------------------------------------------------------------------------------

    def name(self, item: Item, candidate: Oriented) -> str:
        return candidate.words

    def entries(self, design: Design) -> Columns:
        rows = sorted(design.chosen.items(), key=lambda pair: pair[0].surfaces)
        lens = design.problem.model.lens_at(design.state.x)
        light = [light_diameter(lens, range(item.surfaces[0], item.surfaces[-1] + 1)) for item, _ in rows]
        figures = [candidate.part.figures for _, candidate in rows]
        return {
            Column("surfaces", form="<"): [item.words for item, _ in rows],
            Column("part", form="<"): [part.part for part in figures],
            Column("vendor", form="<"): [part.vendor or "-" for part in figures],
            Column("shape", form="<"): [part.shape for part in figures],
            Column("orientation", form="<"): ["reversed" if c.reverse else "as listed" for _, c in rows],
            Column("designed efl", "mm", ".5g", "designed EFL"): [self.of_element[item][0] for item, _ in rows],
            Column("efl", "mm", ".5g", "EFL"): [part.efl for part in figures],
            Column("diameter", "mm", ".4g"): [part.diameter for part in figures],
            Column("light", "mm", ".4g"): light,
            Column("glasses", form="<"): [part.glasses for part in figures],
        }
