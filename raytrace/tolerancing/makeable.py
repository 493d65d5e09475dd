"""Makeable limits: the finest that a workshop keeps, the steps in which limits are stated, and what limits cost.

A workshop keeps the figures of its grade (GRADES). A proposal is no finer, is stated in steps, is ± where the given
limits are, and is the same along x and y. The cost of a tolerance of limits ± t is inverse to t,

    cost = w t₀/t,    t₀ the finest limit of the workshop, w a weight

1 for the finest limit of every kind. Sources: reciprocal costs, Chase & Greenwood, Manufacturing Review 1, 50 (1988);
tolerances of lenses at least cost, Youngworth & Stone, Opt. Rev. 8, 276 (2001). Prices are those of a workshop: the
weights are 1 unless they are given.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.materials.glass import abbe_number
from raytrace.system.lens import Lens
from raytrace.system.tolerance_data import TEST_WAVELENGTH, Tolerance
from raytrace.tolerancing.grades import GRADES, Figure, parsed_limits, parts_of, replaces
from raytrace.tolerancing.table import BadTolerance, ToleranceTable
from raytrace.tracing.geometry import semi_diameters

#: Steps in which limits are stated, by kind without its axis, in the unit; two digits of other kinds.
STEPS = {
    "thickness": 0.01, "radius %": 0.01, "power": 0.5, "irregularity": 0.1, "zernike": 1e-6, "fringe": 0.1,
    "index": 1e-4, "abbe %": 0.1, "abbe": 0.1, "element_decenter": 0.005, "element_decenter_z": 0.01,
    "surface_decenter": 0.005, "surface_runout": 0.001, "element_tilt": 0.005, "surface_tilt": 0.005,
    "element_roll": 0.1,
}  # fmt: skip
#: Kinds that are no matter of tightness: the direction of the astigmatism.
FIXED = ("irregularity_angle",)
_DIGITS = 2
_ROUNDING = 1e-6  # of a step or a limit, by which searches end too early


class Makeable:
    """The limits of tolerances that a workshop makes, by classes of rows that have one limit.

    A class has the rows of a group, and those along x and y at the same surfaces with the same limits. given: (C,) the
    largest given limit of a class, a magnitude if it is radial; finest: (C,) the finest limit that the workshop keeps,
    at most `given`; units: (C,) t₀ of the costs, of a kind without a figure the median t₀/t of the others times its
    limit; weights: (C,). classes: (N,) the class of every row; members: the rows of every class.
    """

    def __init__(self, lens: Lens, tolerances: ToleranceTable, workshop: str, costs: str | Sequence[str] = ""):
        self.tolerances, self.workshop = tolerances, workshop
        rows, radial = tolerances.rows, tolerances.radial
        magnitudes = {n: error.magnitude for error in radial.values() for n in error.places}
        keys = [row.group or _key(row) for row in rows]
        names = list(dict.fromkeys(keys))
        self.classes = torch.tensor([names.index(key) for key in keys], dtype=torch.int64)
        self.members = [[n for n, key in enumerate(keys) if key == name] for name in names]
        firsts = [rows[members[0]] for members in self.members]
        sizes = [magnitudes.get(n, max(abs(row.minimum), abs(row.maximum))) for n, row in enumerate(rows)]
        self.given = np.array([max(sizes[n] for n in members) for members in self.members])
        makes = _Workshop(lens, GRADES[workshop], 1e-3 * tolerances.test_wavelength)
        known, fixed = np.array([makes.finest(row) for row in firsts]), np.array([row.kind in FIXED for row in firsts])
        self.finest = np.where(fixed, self.given, np.minimum(known, self.given))
        self.steps = [STEPS.get(_name(row), 0.0) for row in firsts]
        counted = (known > 0) & (self.given > 0)
        usual = np.median(known[counted] / self.given[counted]) if counted.any() else 1.0
        self.units = np.where(fixed, 0.0, np.where(known > 0, known, usual * self.given))
        self.weights = _weights(lens, firsts, costs)

    def cost(self, tolerances: ToleranceTable) -> float:
        """The sum of the relative costs of tolerances with tighter limits."""
        pairs = zip(tolerances, self.tolerances, strict=True)
        parts = [max(_part(new.minimum, old.minimum), _part(new.maximum, old.maximum)) for new, old in pairs]
        limits = self.given * np.array([parts[members[0]] for members in self.members])
        used = limits > 0
        return float((self.weights * self.units)[used] @ (1 / limits[used]))

    def rounded(self, limits: np.ndarray) -> np.ndarray:
        """Limits (C,) in steps, no wider, and no finer than the workshop's finest."""
        return np.array([self._rounded(c, limit) for c, limit in enumerate(limits)])

    def _rounded(self, c: int, limit: float) -> float:
        if limit >= self.given[c] * (1 - _ROUNDING):
            return float(self.given[c])
        step = self.steps[c] or _step_of_digits(limit)
        return float(max(step * math.floor(limit / step + _ROUNDING), self.finest[c]))

    def wider(self, c: int, limit: float) -> float:
        """The next wider limit of a class."""
        step = self.steps[c] or _step_of_digits(limit)
        return float(min(step * (math.floor(limit / step + _ROUNDING) + 1), self.given[c]))

    def factors(self, limits: np.ndarray) -> Tensor:
        """Factors (N,) of the rows by limits (C,)."""
        ratios = np.divide(limits, self.given, out=np.ones_like(limits), where=self.given > 0)
        return torch.from_numpy(ratios)[self.classes]

    def at_finest(self, limits: np.ndarray) -> list[int]:
        """The first rows of the classes that are tightened to the finest limit of the workshop."""
        ended = (limits <= self.finest * (1 + _ROUNDING)) & (self.finest < self.given * (1 - _ROUNDING))
        return [members[0] for members, is_finest in zip(self.members, ended, strict=True) if is_finest]


def _part(new: float, old: float) -> float:
    return new / old if old else 0.0


def _key(row: Tolerance) -> str:
    """What the rows of a class have in common: all but the axis."""
    kind = row.kind.removesuffix("_x").removesuffix("_y")
    return repr(dataclasses.replace(row, kind=kind, source="", unit=row.unit))


def _name(row: Tolerance) -> str:
    kind = row.kind.removesuffix("_x").removesuffix("_y")
    return f"{kind} %" if row.unit == "%" else kind


def _step_of_digits(limit: float) -> float:
    return 10.0 ** (math.floor(math.log10(limit)) - _DIGITS + 1) if limit > 0 else 1.0


class _Workshop:
    """The finest limits of a workshop in the unit of a row."""

    def __init__(self, lens: Lens, figures: dict[str, Figure], wavelength: float):
        self.lens, self.figures, self.wavelength = lens, figures, wavelength
        self.radii = semi_diameters(lens)
        self.glasses = {a for a, _ in parts_of(lens).glasses}

    def finest(self, row: Tolerance) -> float:
        """0 where no figure of a grade applies to the kind."""
        name, figures = _name(row), self.figures
        kind = name.removesuffix(" %")
        k = row.surfaces[0] if row.surfaces else -1
        if kind in ("radius", "power", "curvature"):
            return self._of_curvature(k, name)
        if kind == "thickness":
            return figures["thickness" if k in self.glasses else "air"].limit
        if kind == "surface_runout":
            return figures["wedge"].limit
        if kind in ("surface_tilt", "surface_decenter"):
            h, c = self.radii[k], abs(self._curvature(k))
            slope = figures["wedge"].limit / (2 * h) if h > 0 else 0.0
            if kind == "surface_tilt":
                return math.degrees(math.atan(slope))
            return slope / c if c > 0 else 0.0
        if name == "abbe":
            return figures["abbe"].limit / 100 * float(abbe_number(self.lens.surfaces[k].glass))
        return figures[kind].limit if kind in figures else 0.0

    def _of_curvature(self, k: int, name: str) -> float:
        """The finest error of the curvature, the larger one of the figures in % and in fringes, in a unit."""
        figure, h, c = self.figures["radius"], self.radii[k], abs(self._curvature(k))
        fringes = figure.fringes * 1e-3 * TEST_WAVELENGTH / (h * h) if h > 0 else 0.0
        error = max(figure.limit / 100 * c, fringes)
        if name == "power":
            return error * h * h / self.wavelength
        if name == "curvature" or not c:
            return error
        return 100 * error / c if name == "radius %" else error / (c * c)

    def _curvature(self, k: int) -> float:
        curvature = self.lens.surfaces[k].curvature
        return 0.0 if curvature is None else float(curvature)


def _weights(lens: Lens, rows: Sequence[Tolerance], costs: str | Sequence[str]) -> np.ndarray:
    """The weights of the costs of rows. Raises BadTolerance for costs that are no positive numbers."""
    parts, weights = parts_of(lens), np.ones(len(rows))
    for limit in parsed_limits(costs):
        if not (limit.maximum > 0 and limit.minimum == -limit.maximum and not limit.unit):
            raise BadTolerance(f"costs {limit.word}: expected a positive weight, as {limit.word}=2")
        applies = np.array([replaces(limit, row, parts) for row in rows], dtype=bool)
        if not applies.any():
            raise BadTolerance(f"costs {limit.word}: none of the tolerances is of this kind")
        weights[applies] = limit.maximum
    return weights
