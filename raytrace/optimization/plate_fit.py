"""Radii of a lens that take those of test plates; see `fitting`."""

import dataclasses
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from raytrace.materials.glass import is_air
from raytrace.maths.result import Column, Columns
from raytrace.optimization.fitting import Design, Fit, Item, free_of, relaxed
from raytrace.stock.plates import TestPlate
from raytrace.system.lens import Lens
from raytrace.system.shapes import EVEN
from raytrace.system.surface import medium_surfaces
from raytrace.tracing.geometry import semi_diameters

_SHAPES = ("convex", "concave")


@dataclass(frozen=True)
class Radius:
    """A curvature of the list, 1/mm, and the plates of its radius."""

    curvature: float
    plates: tuple[TestPlate, ...]


def shapes_of(lens: Lens, k: int, sign: float) -> set[str]:
    """The shapes, "convex" and "concave", of the glass faces at surface k, where its curvature has this sign.

    A cemented surface has both: its face of either glass. A mirror is seen from the light.
    """
    behind, before = (lens.surfaces[medium_surfaces(lens.surfaces)[j]].glass for j in (k, k - 1))
    if lens.surfaces[k].is_mirror:
        return {_SHAPES[sign > 0]}
    faces = [] if is_air(behind) else [sign > 0]
    faces += [] if is_air(before) else [sign < 0]
    return {_SHAPES[not convex] for convex in faces}


class PlateFit(Fit):
    """A fit of the variable curvatures of spherical surfaces to a list of test plates.

    A curvature that is picked up with the factor ±1 follows to the same plates. Fixed radii stay.
    """

    what = "test plates"

    def __init__(self, design: Design, plates: Sequence[TestPlate], **settings: Any):
        super().__init__(design, source=f"{len(plates)} test plates", **settings)
        self.by_radius: dict[float, list[TestPlate]] = defaultdict(list)
        for plate in plates:
            self.by_radius[plate.radius].append(plate)
        self.lens = design.problem.model.lens_at(design.state.x)
        sizes = [semi_diameters(lens) for lens in self.lens.configurations]
        self.heights = [
            max((size[k] for size in sizes if size[k] == size[k]), default=0.0) for k in range(len(sizes[0]))
        ]
        self.column: dict[Item, int] = {}
        self.factors: dict[Item, dict[int, float]] = {}
        self.before: dict[Item, float] = {}

    def items(self) -> list[Item]:
        model = self.design.problem.model
        result = []
        for column, variable in enumerate(model.variables):
            if variable.quantity != "curvature":
                continue
            factors, others = {variable.surface: 1.0}, []
            for solve in model.solves:
                if solve.kind == "pickup" and solve.address_of_source == variable.address and solve.operand is None:
                    exact = solve.quantity == "curvature" and abs(solve.scale) == 1 and not solve.offset
                    factors |= {solve.surface: solve.scale} if exact else {}
                    others += [] if exact else [solve.surface]
            item = Item(tuple(sorted(factors)))
            surfaces = [self.lens.surfaces[k] for k in factors]
            if variable.operand is not None:
                self._leave(item, "the radius differs between configurations")
            elif any(
                s.conic is not None or s.coefficients is not None or s.kind != EVEN or s.sag_terms for s in surfaces
            ):
                self._leave(item, "aspheric, without a test plate")
            else:
                self.column[item], self.factors[item] = column, factors
                self.before[item] = float(self.design.state.x[column])
                if self._radii(item):
                    result.append(item)
                else:
                    self._leave(item, self._none(item))
                for k in others:
                    self._leave(Item((k,)), f"its radius follows that of surface {variable.surface}, by another factor")
        for solve in model.solves:
            if solve.quantity == "curvature" and solve.kind != "pickup":
                self._leave(Item((solve.surface,)), f"its radius follows from a solve ({solve.kind})")
        return result

    def _leave(self, item: Item, reason: str) -> None:
        self.missing.append((item.words, reason))

    def _none(self, item: Item) -> str:
        shape = " and ".join(sorted(self._shapes(item, 1 if self.before[item] >= 0 else -1)))
        size = 2 * max(self.heights[k] for k in self.factors[item])
        return f"no plate for a {shape} radius, clear diameter {size:.4g} mm"

    def _shapes(self, item: Item, sign: float) -> set[str]:
        return set.union(*(shapes_of(self.lens, k, sign * factor) for k, factor in self.factors[item].items()))

    def _radii(self, item: Item) -> list[Radius]:
        """The curvatures within the bounds that plates of the shapes and the diameter test, in either direction."""
        size, result = 2 * max(self.heights[k] for k in self.factors[item]), []
        wanted = {sign: self._shapes(item, sign) for sign in (1.0, -1.0)}
        low, high = (float(ends[self.column[item]]) for ends in (self.design.lower, self.design.upper))
        for radius, plates in self.by_radius.items():
            large = [plate for plate in plates if plate.diameter >= size * (1 - 1e-9)]
            for sign in (1.0, -1.0) if math.isfinite(radius) else (1.0,):
                if not low <= sign / radius <= high:
                    continue
                needed = wanted[sign] if math.isfinite(radius) else set()
                used = [plate for plate in large if needed & {*plate.shapes} or not needed]
                if used and needed <= {shape for plate in used for shape in plate.shapes}:
                    result.append(Radius(sign / radius, tuple(used)))
        return result

    def candidates(self, design: Design, item: Item) -> list[tuple[float, Radius]]:
        radii, column, x = self._radii(item), self.column[item], design.state.x
        others = np.setdiff1d(free_of(design), [column])
        state = design.problem.state(x, True)
        curvatures = np.array([radius.curvature for radius in radii])
        merits = relaxed(state, others, [column]).merit((curvatures - x[column])[:, None])
        # of equal predictions, as where the expansion is below 0, the nearest radius
        order = np.lexsort((np.abs(curvatures - x[column]), merits))
        return [(float(merits[k]), radii[k]) for k in order]

    def placed(self, design: Design, item: Item, candidate: Radius) -> Design:
        column = self.column[item]
        x, lower, upper = design.state.x.copy(), design.lower.copy(), design.upper.copy()
        x[column] = lower[column] = upper[column] = candidate.curvature
        state = dataclasses.replace(design.state, x=x)
        return dataclasses.replace(
            design, lower=lower, upper=upper, state=state, chosen={**design.chosen, item: candidate}
        )

    def fixed(self, design: Design) -> set[tuple[int, str]]:
        variables = design.problem.model.variables
        return {variables[self.column[item]].address for item in design.chosen}

    def name(self, item: Item, candidate: Radius) -> str:
        return f"R {1 / candidate.curvature:.6g}" if candidate.curvature else "flat"

    def entries(self, design: Design) -> Columns:
        rows = [
            (item, self.before[item] * factor, radius.curvature * factor, radius.plates, k)
            for item, radius in design.chosen.items()
            for k, factor in self.factors[item].items()
        ]
        rows.sort(key=lambda row: row[-1])
        lens = design.problem.model.lens_at(design.state.x)
        heights = semi_diameters(lens)
        plates = [plates for *_, plates, _ in rows]
        radius = lambda c: 1 / c if c else math.inf  # noqa: E731
        return {
            Column("surface"): [k for *_, k in rows],
            Column("designed", "mm", ".7g", "designed radius"): [radius(before) for _, before, *_ in rows],
            Column("radius", "mm", ".7g"): [radius(after) for _, _, after, *_ in rows],
            Column("shape", form="<"): [
                " ".join(sorted(shapes_of(lens, k, c))) if c else "flat" for _, _, c, _, k in rows
            ],
            Column("plate", form="<"): [" ".join(filter(None, (p.name for p in used))) or "-" for used in plates],
            Column("tolerance", form="<"): [next((p.tolerance for p in used if p.tolerance), "-") for used in plates],
            Column("plate diameter", "mm", ".4g"): [
                size if math.isfinite(size := max(p.diameter for p in used)) else "-" for used in plates
            ],
            Column("clear diameter", "mm", ".4g"): [2 * heights[k] for *_, k in rows],
        }
