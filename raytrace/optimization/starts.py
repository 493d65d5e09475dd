"""Starts: where a search begins, points spread evenly between bounds and brought to a focal length and a focus.

Bounds that nobody gives follow from the focal length f and the radius h of the entrance pupil:

    |c| ≤ 1 / (0.9 h), 4 / f;  glass 0.02 f to 0.2 f, air 0.005 f to 0.35 f, before the image 0.05 f to 2 f
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from raytrace.optimization.constraints import Condition
from raytrace.optimization.lens_model import Model
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.problem import NoProblem
from raytrace.system.optimization_data import Row, Vary
from raytrace.system.parameter_paths import sensor

STEEPEST = 3.0  # curvature of a start in units of 1/f
_FACTORS = np.concatenate([np.geomspace(0.15, 4, 24), -np.geomspace(0.15, 4, 24)])  # of all curvatures
_HALVINGS = 40
_SPREAD = {"conic": (-2.0, 2.0), "index": (1.45, 1.9), "abbe_number": (20.0, 80.0)}

Range = tuple[float, float] | None


@dataclass(frozen=True)
class Space:
    """Where a search moves: bounds (n,) of the variables, and the part (n,) of them in which starts lie.

    focal_length: mm that starts are brought to, None where none is known.
    """

    model: Model
    lower: np.ndarray
    upper: np.ndarray
    low: np.ndarray
    high: np.ndarray
    focal_length: float | None

    def sobol(self, number: int, count: int, seed: int) -> np.ndarray:
        """(count, n) the points from number·count on of Sobol's sequence, scrambled by the seed."""
        sequence = qmc.Sobol(len(self.low), seed=seed)
        if number:
            sequence.fast_forward(number * count)
        return self.low + (self.high - self.low) * sequence.random(count)

    def prepared(self, x: np.ndarray) -> np.ndarray:
        """x with its curvatures scaled to the focal length and the sensor at the paraxial focus, within bounds."""
        x = np.clip(x, self.lower, self.upper)
        if self.focal_length is not None:
            x = np.clip(self._focused(x), self.lower, self.upper)
        place = next((k for k, one in enumerate(self.model.variables) if self._is_sensor(one)), None)
        distance = self._image_distance(x) if place is not None else np.nan
        if np.isfinite(distance):
            x[place] = np.clip(distance, self.lower[place], self.upper[place])
        return x

    def _is_sensor(self, one: Vary) -> bool:
        return (one.surface, one.quantity) == (sensor(self.model.lens), "thickness")

    def _state(self, x: np.ndarray) -> LensState:
        return self.model.views[self.model.lens.current_configuration - 1].state(x)

    def _excess(self, x: np.ndarray) -> float:
        """Power beyond that of the focal length, in its units."""
        state = self._state(x)
        data = state.gaussian(state.primary)
        return float(-data.C / abs(data.n_image) * self.focal_length - 1)

    def _image_distance(self, x: np.ndarray) -> float:
        state = self._state(x)
        data = state.gaussian(state.primary)
        height, omega = data.A + data.B * state.vergence, data.C + data.D * state.vergence
        return float(-height * data.n_image / omega) if omega != 0 else np.nan

    def _focused(self, x: np.ndarray) -> np.ndarray:
        """With all curvatures scaled by one number, or else with the last one changed."""
        bent = np.array([one.quantity == "curvature" for one in self.model.variables])
        if not bent.any():
            return x
        scaled = lambda s: np.where(bent, s * x, x)  # noqa: E731
        at = _root(lambda s: self._excess(scaled(s)), _FACTORS, lambda s: abs(np.log(abs(s))))
        if at is not None:
            return scaled(at)
        last = np.nonzero(bent)[0][-1]
        moved = lambda c: np.where(np.arange(len(x)) == last, c, x)  # noqa: E731
        steps = np.linspace(self.lower[last], self.upper[last], 24)
        at = _root(lambda c: self._excess(moved(c)), steps, abs)
        return x if at is None else moved(at)


def _root(function: Callable, places: np.ndarray, far: Callable) -> float | None:
    """The root between neighbouring places that is least far, which lie within a factor; None without any."""
    values = np.array([function(place) for place in places])
    turns = np.nonzero(values[:-1] * values[1:] < 0)[0]
    pairs = [(places[k], places[k + 1]) for k in turns if len(turns) and abs(places[k] - places[k + 1]) < 1]
    if not pairs:
        return None
    low, high = min(pairs, key=lambda pair: far(pair[0]))
    sign = np.sign(function(low))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.sign(function(middle)) == sign else (low, middle)
    return 0.5 * (low + high)


def space_of(
    model: Model, bounds: tuple[np.ndarray, np.ndarray], length: float | None, glass: Range = None, air: Range = None
) -> Space:
    """Where to search: bounds (n,), infinite ones replaced; length: the focal length in mm, None where it is free.

    glass, air: of thicknesses, mm. Raises NoProblem where bounds are needed and no length is known.
    """
    ends = [_ends(model, one, length, glass, air) for one in model.variables]
    lower = np.where(np.isfinite(bounds[0]), bounds[0], [low for low, _ in ends])
    upper = np.where(np.isfinite(bounds[1]), bounds[1], [high for _, high in ends])
    for one, least, most in zip(model.variables, lower, upper, strict=True):
        if not least <= most:
            raise NoProblem(f"`bounds` of {one.quantity}_{one.surface}: from {least:g} to {most:g} there is nothing")
    low, high = lower.copy(), upper.copy()
    for k, one in enumerate(model.variables):
        if one.quantity == "curvature" and length is not None:
            low[k], high[k] = max(low[k], -STEEPEST / length), min(high[k], STEEPEST / length)
            low[k], high[k] = (low[k], high[k]) if low[k] <= high[k] else (lower[k], upper[k])
    start = np.clip(model.start, lower, upper)
    finite = np.isfinite(low) & np.isfinite(high)
    return Space(model, lower, upper, np.where(finite, low, start), np.where(finite, high, start), length)


def _ends(model: Model, one: Vary, length: float | None, glass: Range, air: Range) -> tuple[float, float]:
    """Least and greatest of a variable that has no bounds of its own; infinite where nothing is sensible."""
    if one.quantity in _SPREAD:
        return _SPREAD[one.quantity]
    if one.quantity not in ("curvature", "thickness") or one.surface == 0:
        return -np.inf, np.inf
    if length is None:
        raise NoProblem("how large the lens is to be is not known: `hold` its focal length, as efl=50")
    if one.quantity == "curvature":
        steepest = min(1 / (0.9 * _pupil_radius(model, length)), 4 / length)
        return -steepest, steepest
    if one.surface == sensor(model.lens):
        return 0.05 * length, 2 * length if np.isinf(float(model.lens.surfaces[0].thickness)) else 20 * length
    is_glass = one.surface in _glasses(model)
    least, most = (glass if is_glass else air) or ((0.02, 0.2) if is_glass else (0.005, 0.35))
    scale = 1.0 if (glass if is_glass else air) else length
    return scale * least, scale * most if np.isfinite(most) else (0.2 if is_glass else 0.35) * length


def _glasses(model: Model) -> Sequence[int]:
    view = model.views[0]
    return [k for k, n in enumerate(view.indices[model.lens.primary_wavelength - 1]) if abs(n) > 1.01]


def _pupil_radius(model: Model, length: float) -> float:
    aperture = model.lens.aperture
    if aperture.kind == "entrance_pupil_diameter":
        return 0.5 * float(aperture.value)
    if aperture.kind in ("image_f_number", "paraxial_working_f_number"):
        return 0.5 * length / float(aperture.value)
    found = float(model.views[0].state(model.start).entrance_pupil_diameter)
    return 0.5 * found if np.isfinite(found) and found > 0 else length / 16


def length_of(model: Model, rows: Sequence[Row], unit: float, conditions: Sequence[Condition]) -> float | None:
    """The focal length in mm that is held, or aimed at by a row, or that the lens has; None where it has none."""
    for one in conditions:
        if one.row.operand == "EFFL":
            return abs(one.row.target * unit)
    aimed = [row for row in rows if row.operand == "EFFL" and row.weight != 0 and row.target != 0]
    if aimed:
        return abs(aimed[0].target * unit)
    state = model.views[model.lens.current_configuration - 1].state(model.start)
    with np.errstate(divide="ignore"):
        found = abs(float(state.gaussian(state.primary).effective_focal_length)) if _has_power(state) else np.inf
    return found if np.isfinite(found) else None


def _has_power(state: LensState) -> bool:
    return float(state.gaussian(state.primary).C) != 0
