"""Glass choice: the catalog glasses of an optimisation with variable glasses.

1. The lens is optimised with its glasses: later steps may not end worse.
2. Variable glasses become model glasses, whose numbers (n, V, ΔP) stay within the convex hull of the catalogs. The
   lens is optimised with them.
3. One element at a time takes a glass of the catalogs, first the one whose merit rises most by that.
4. One glass at a time is exchanged, until no exchange lowers the merit.

An expansion of the merit selects the glasses that are tried. With the derivatives J_y of the residuals r by all other
variables, and J_p by the numbers p of a glass, the merit after the others have followed is, to second order,

    M²(p + d) = |N (r + J_p d)|²,   N = 1 - J_y (J_yᵀ J_y + λ D²)⁻¹ J_yᵀ

so that NJ_p holds Schur's complement of the Hessian. The best few are optimised, and the merit reached decides.
"""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from typing import Any, TypeAlias

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from raytrace.materials.catalogs import Catalog, CatalogError, catalogs_named, missing_catalogs
from raytrace.materials.glass import Glass, model_glass, refractive_index
from raytrace.materials.selection import GlassList
from raytrace.materials.selection import glasses as selected
from raytrace.optimization.checkpoint import BadCheckpoint, Stored
from raytrace.optimization.conditions import Condition
from raytrace.optimization.least_squares import Evaluate, SumOfSquares, least_squares
from raytrace.optimization.problem import NoProblem, Problem
from raytrace.optimization.variables import DesignVariables, followers
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row, Solve, Vary
from raytrace.system.parameter_paths import GLASS
from raytrace.words import option

_MATTERS = 1e-6  # smallest change of the index at the wavelengths by a number of a glass that varies

_NOT_PREFERRED = 1.03  # factor on the merit with a glass that its maker does not prefer
_PRICE = 0.02  # exponent of the relative price of a glass in the factor on the merit


class Pool:
    """Glasses to choose from: their numbers (G, k) and the hull of these, normal (F, k) · p ≤ reach (F,)."""

    def __init__(
        self,
        glasses: Sequence[Glass],
        wavelengths: torch.Tensor,
        listing: GlassList | None = None,
        *,
        is_specified: bool = False,
    ):
        """listing: the selection that the glasses are of; is_specified: by words, which then hold for the glasses of
        the lens as well."""
        self.listing, self.is_specified = listing, is_specified
        self.wavelengths, self.basis = wavelengths, _basis(wavelengths)
        self.glasses = tuple(glasses)
        numbers = np.array([self.numbers_of(glass) for glass in self.glasses]).reshape(-1, self.count)
        usable = np.isfinite(numbers).all(1)
        self.glasses = tuple(glass for glass, use in zip(self.glasses, usable, strict=True) if use)
        self.numbers = numbers[usable]
        if not len(self.numbers):
            raise NoProblem(
                f"no glass of the catalogs covers the wavelengths of the lens; name others by {option('catalog')}"
            )
        self.normal, self.reach = hull(self.numbers)

    @property
    def count(self) -> int:
        return self.basis.shape[1]

    @property
    def names(self) -> tuple[str, ...]:
        """The numbers of a model glass that vary."""
        return tuple(GLASS)[: self.count]

    def numbers_of(self, glass: Glass) -> np.ndarray:
        """Numbers (k,) of the model glass whose indices at the wavelengths are nearest, by least squares."""
        excess = refractive_index(glass, self.wavelengths).numpy() - 1
        coefficients = np.linalg.lstsq(self.basis, excess, rcond=None)[0]
        n, dispersion, deviation = np.pad(coefficients, (0, 3 - self.count))
        if self.count == 1:
            return np.array([1 + n])
        return np.array([1 + n, n / dispersion, deviation / dispersion])[: self.count]

    def model(self, numbers: np.ndarray) -> Glass:
        """The model glass of numbers (k,)."""
        return model_glass(*np.pad(numbers, (0, 3 - self.count)))


def _basis(wavelengths: torch.Tensor) -> np.ndarray:
    """(W, k): n - 1 of a model glass by n - 1, (n - 1)/V and ΔP (n - 1)/V, of which it is a linear function.

    As many of the three, in this order, as change the index at the wavelengths independently.
    """
    excess = lambda *numbers: refractive_index(model_glass(*numbers), wavelengths).numpy() - 1  # noqa: E731
    if len(wavelengths) == 1:
        return np.ones((1, 1))
    whole, half, deviating = excess(2.0, 1.0), excess(2.0, 2.0), excess(2.0, 1.0, 1.0)
    basis = np.stack([2 * half - whole, 2 * (whole - half), deviating - whole], -1)[:, : len(wavelengths)]
    typical = np.array([0.6, 0.012, 1e-4])[: basis.shape[1]]
    new = np.abs(np.diag(np.linalg.qr(basis * typical)[1])) > _MATTERS
    return basis[:, : int(np.argmin(new)) if not new.all() else len(new)]


def hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The convex hull of points (G, k): normal (F, k) · p ≤ reach (F,), in units of the range of the points.

    A box where the points are too few, or in a plane.
    """
    low, size = points.min(0), np.maximum(np.ptp(points, axis=0), 1e-9)
    scaled = (points - low) / size
    try:
        planes = ConvexHull(scaled).equations
    except (QhullError, ValueError):
        axes = np.eye(points.shape[1])
        planes = np.concatenate([np.c_[axes, -scaled.max(0)], np.c_[-axes, scaled.min(0)]])
    planes = np.unique(planes.round(12), axis=0)
    normal = planes[:, :-1] / size
    return normal, normal @ low - planes[:, -1]


def catalogs_of(lens: Lens, catalog: Sequence[str | PathLike] = ()) -> tuple[Catalog, ...]:
    """Catalogs by name or AGF file; by default those of the lens, else SCHOTT. Raises NoProblem."""
    shipped = [name for name in lens.catalogs if name not in missing_catalogs([name])]
    try:
        return catalogs_named(catalog or shipped or ("SCHOTT",))
    except CatalogError as error:
        raise NoProblem(f"{option('catalog')}: {error}") from None


def pool_of(lens: Lens, catalogs: Sequence[Catalog], words: str | Sequence[str] = "") -> Pool:
    """Glasses of a selection (`materials.selection`) whose range covers the wavelengths of the lens.

    Raises NoProblem where there is none, and BadSelection.
    """
    listing = selected(words, catalogs=catalogs, wavelengths=lens.wavelengths)
    if not listing.glasses:
        raise NoProblem(f"no glass to choose: {listing.summary}. Change {option('glasses')} or {option('catalog')}")
    return Pool(listing.glasses, lens.wavelengths, listing, is_specified=bool(words))


def _is_among(glass: Glass, glasses: Sequence[Glass]) -> bool:
    keys = {(other.listed_name or other.name, other.catalog) for other in glasses}
    return bool(glass.catalog) and (glass.listed_name or glass.name, glass.catalog) in keys


def charge(glass: Glass) -> float:
    """Factor on the merit with a glass: above 1 if its maker does not prefer it, or if it is expensive."""
    return (1.0 if glass.status == "preferred" else _NOT_PREFERRED) * max(glass.relative_price or 1.0, 1.0) ** _PRICE


def with_glasses(lens: Lens, glasses: dict[int, Glass]) -> Lens:
    """The lens with other glasses behind its surfaces, and behind those that follow them."""
    surfaces = list(lens.surfaces)
    follow = {k: glasses[source] for k, source in followers(lens).items() if source in glasses}
    for k, glass in (glasses | follow).items():
        surfaces[k] = dataclasses.replace(surfaces[k], glass=glass)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


#: Candidates that are optimised for every element, and over how many cycles.
TRIED, TRIAL_CYCLES = 4, 15
_CYCLES = 100  # of a stage
_ROUNDS = 3  # of exchanges through all elements
_GAIN = 5e-3  # smallest relative reduction of the merit by an exchange
_DAMPING = 1e-4  # of the variables that follow in the expansion
_MET = 1e-5  # violation up to which a condition counts as met
_ALIKE = 0.01  # of the width of the hull: of two glasses that are nearer, one is tried

#: Descriptions of the kinds of steps.
WORDS = {
    "own": "all other variables, with the glasses of the lens",
    "model": "and with model glasses",
    "snap": "surface",
    "swap": "exchanged at surface",
}


#: Candidates that were optimised: name, predicted and reached merit.
Trials: TypeAlias = tuple[tuple[str, float, float], ...]


@dataclass(frozen=True)
class GlassStep:
    """One step of the choice.

    kind: "own", "model", "snap" or "swap"; surface, name, catalog: of the new glass, 0 and "" of "own" and "model";
    replaced: the glass before. predicted, reached: merits. tried: (name, predicted, reached) of all candidates that
    were optimised.
    """

    kind: str
    reached: float
    seconds: float
    surface: int = 0
    name: str = ""
    catalog: str = ""
    replaced: str = ""
    predicted: float = float("nan")
    tried: Trials = ()

    def document(self) -> dict[str, Any]:
        of_surface = {"surface": self.surface, "glass": self.name, "catalog": self.catalog, "predicted": self.predicted}
        tried = [dict(zip(("glass", "predicted", "reached"), trial, strict=True)) for trial in self.tried]
        more = {**of_surface, "replaced": self.replaced or None, "tried": tried} if self.surface else {}
        return {"step": self.kind, **more, "reached": self.reached, "seconds": round(self.seconds, 3)}

    @property
    def words(self) -> str:
        if not self.surface:
            return WORDS[self.kind]
        instead = f" for {self.replaced}" if self.replaced else ""
        return f"{WORDS[self.kind]} {self.surface}: {self.name} ({self.catalog}){instead}"


@dataclass(frozen=True)
class Design:
    """A lens of the choice: variables x (n,) without those of glasses, and the glasses by surface."""

    x: np.ndarray
    glasses: dict[int, Glass]


@dataclass(frozen=True)
class DescendedDesign(Design):
    """A design at the end of a descent, with its merit function there."""

    state: SumOfSquares

    @property
    def merit(self) -> float:
        return float(np.sqrt(self.state.cost))

    def rank(self, charged: float = 1.0) -> tuple[float, float, float]:
        """Fewer failed rays, then conditions met, then a lower merit."""
        missed = float(self.state.missed.max(initial=0.0))
        return self.state.lost, missed if missed > _MET else 0.0, self.merit * charged


@dataclass(frozen=True)
class Expansion:
    """The square of the merit by the numbers d (…, k) of a glass: cost + 2 gradient · d + d · hessian d."""

    cost: float
    gradient: np.ndarray
    hessian: np.ndarray

    def merit(self, d: np.ndarray) -> np.ndarray:
        """(…) the predicted merit."""
        square = self.cost + 2 * d @ self.gradient + np.einsum("...i,ij,...j", d, self.hessian, d)
        return np.sqrt(np.maximum(square, 0.0))


def expansion(state: SumOfSquares, columns_of_glass: np.ndarray, following: np.ndarray, fixed: np.ndarray) -> Expansion:
    """The merit by the numbers of a glass, with the `following` variables at their best and the conditions met.

    columns_of_glass, following: columns of the Jacobian. fixed: (h', n) slopes of active limits.
    """
    J, r = state.jacobian, state.residuals
    A, c = np.vstack([state.held_slope, fixed]), np.concatenate([state.held, np.zeros(len(fixed))])
    columns = J[:, following]
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    back = np.linalg.pinv(A[:, following] / scale) if len(A) else np.zeros((len(following), 0))
    columns = columns / scale
    r, steep = r - columns @ (back @ c), J[:, columns_of_glass] - columns @ (back @ A[:, columns_of_glass])
    free = columns - columns @ (back @ (A[:, following] / scale))
    left, sizes, _ = np.linalg.svd(free, full_matrices=False)
    keep = np.sqrt(_DAMPING / (sizes**2 + _DAMPING))  # N² = (λ/(σ² + λ))² + ridge λ (σ/(σ² + λ))² = λ/(σ² + λ)
    reduce = lambda m: m - left @ ((1 - keep) * (left.T @ m).T).T  # noqa: E731
    r, steep = reduce(r), reduce(steep)
    return Expansion(float(r @ r), steep.T @ r, steep.T @ steep)


class Choice:
    """The glasses of surfaces of a lens, chosen from a pool; `run` returns the best design."""

    def __init__(
        self,
        model: DesignVariables,
        surfaces: Sequence[int],
        pool: Pool,
        rows: Sequence[Row],
        conditions: Sequence[Condition],
        bounds: tuple[np.ndarray, np.ndarray],
        *,
        cycles: int | None = None,
        until: float = np.inf,
        keep: Callable[[Stored, float], None] | None = None,
        **options: Any,
    ):
        """cycles: of a stage, at most; until: a time of `time.monotonic`; keep: called with the best state while
        glasses are exchanged, and its merit; options: of Problem."""
        self.model, self.surfaces, self.pool, self.bounds = model, tuple(surfaces), pool, bounds
        self.rows, self.conditions, self.options = rows, conditions, options
        self.cycles = _CYCLES if cycles is None else min(cycles, _CYCLES)
        self.until, self.started, self.evaluations = until, time.monotonic(), 0
        self.descended = 0  # cycles
        self.steps: list[GlassStep] = []
        self.keep = keep or (lambda stored, merit: None)

    @cached_property
    def candidates(self) -> dict[int, tuple[tuple[Glass, ...], np.ndarray]]:
        """The glasses and their numbers for every surface: the pool, and the glass of the surface, if of a catalog and
        if no selection is specified."""
        candidates = {}
        for k in self.surfaces:
            glass_of_lens = self.model.lens.surfaces[k].glass
            new = (
                bool(glass_of_lens.catalog)
                and not self.pool.is_specified
                and not _is_among(glass_of_lens, self.pool.glasses)
            )
            glasses = (*self.pool.glasses, glass_of_lens) if new else self.pool.glasses
            numbers = [self.pool.numbers, self.pool.numbers_of(glass_of_lens)[None]] if new else [self.pool.numbers]
            candidates[k] = glasses, np.concatenate(numbers)
        return candidates

    def run(self, x: np.ndarray, stored: Stored | None = None) -> DescendedDesign:
        """The best design from variables x, which are within their bounds; stored: the state to resume."""
        glasses_of_lens = {k: self.model.lens.surfaces[k].glass for k in self.surfaces}
        if stored is not None and stored.glasses:
            chosen = glasses_of_lens | {k: self._named(k, *stored_glass) for k, stored_glass in stored.glasses.items()}
            self.best = DescendedDesign(x, chosen, self.limited(self.problem(chosen, ()), ())(x, True))
            if stored.descent is None:  # else all exchanges were done
                with suppress(KeyboardInterrupt):  # the best so far
                    self.swap(stored.tested)
            return self.best
        first = self.descend(Design(x, glasses_of_lens), (), self.cycles)
        self.steps.append(GlassStep("own", first.merit, self.seconds))
        self.best = first
        with suppress(KeyboardInterrupt):
            known = all(_is_among(glass, self.candidates[k][0]) for k, glass in glasses_of_lens.items())
            if known and time.monotonic() > self.until:
                return first
            snapped = self.snapped(first, known=known)
            self.best = min(first, snapped, key=DescendedDesign.rank) if known else snapped
            self._keep(())
            self.swap()
        return self.best

    def _named(self, surface: int, catalog: str, name: str) -> Glass:
        """The candidate of a name. Raises BadCheckpoint."""
        for glass in self.candidates[surface][0]:
            if (glass.catalog, glass.name) == (catalog, name):
                return glass
        raise BadCheckpoint(f"the checkpoint's glass {name} of {catalog}, surface {surface}: no catalog given has it")

    def _keep(self, tested: Iterable[int]) -> None:
        glasses = {k: (glass.catalog, glass.name) for k, glass in self.best.glasses.items()}
        self.keep(Stored(self.best.x, glasses, tuple(sorted(tested))), self.best.merit)

    def snapped(self, design: DescendedDesign, *, known: bool) -> DescendedDesign:
        """The design with model glasses, which glasses of the catalogs then replace one by one.

        known: whether the glasses of the design are candidates; then it is returned where no time is left.
        """
        first, model = design, {k: self.pool.model(self.pool.numbers_of(glass)) for k, glass in design.glasses.items()}
        design = self.descend(Design(design.x, model), self.surfaces, self.cycles)
        self.steps.append(GlassStep("model", design.merit, self.seconds))
        waiting = list(self.surfaces)
        while waiting:
            if known and time.monotonic() > self.until:
                return first
            design = self.snap(design, waiting)
        return self.descend(design, (), self.cycles)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.started

    def problem(self, glasses: dict[int, Glass], open_: Sequence[int]) -> Problem:
        """The problem with these glasses; numbers of the glasses of surfaces `open_` are the last variables."""
        numbers = tuple(Vary(k, name) for k in open_ for name in self.pool.names)
        follow = tuple(
            Solve(k, name, "pickup", source=source)
            for k, source in followers(self.model.lens).items()
            for name in self.pool.names
            if source in open_
        )
        model = DesignVariables(
            with_glasses(self.model.lens, glasses), (*self.model.variables, *numbers), (*self.model.solves, *follow)
        )
        return Problem(model, self.rows, self.conditions, **self.options)

    def limited(self, problem: Problem, open_: Sequence[int]) -> Evaluate:
        """The states of a problem with the hull of the glasses as limits."""
        count, k = len(self.model.variables), self.pool.count
        slope = np.zeros((0, count + k * len(open_)))
        for j in range(len(open_)):
            rows = np.zeros((len(self.pool.normal), slope.shape[1]))
            rows[:, count + k * j : count + k * (j + 1)] = self.pool.normal
            slope = np.vstack([slope, rows])
        reach = np.tile(self.pool.reach, len(open_))

        def state(x: np.ndarray, derivatives: bool) -> SumOfSquares:
            reached = problem.state(x, derivatives)
            limits = np.concatenate([reached.limits, slope @ x - reach])
            slopes = np.vstack([reached.limits_slope, slope]) if derivatives else reached.limits_slope
            return dataclasses.replace(reached, limits=limits, limits_slope=slopes)

        return state

    def _start(self, design: Design, open_: Sequence[int]) -> np.ndarray:
        numbers = [design.glasses[k].coefficients.numpy()[: self.pool.count] for k in open_]
        return np.concatenate([design.x, *numbers])

    def descend(self, design: Design, open_: Sequence[int], cycles: int) -> DescendedDesign:
        """The design at its minimum; glasses of surfaces `open_` are variable model glasses."""
        state = self.limited(self.problem(design.glasses, open_), open_)
        rest = np.full(self.pool.count * len(open_), np.inf)
        lower, upper = np.concatenate([self.bounds[0], -rest]), np.concatenate([self.bounds[1], rest])
        start = np.clip(self._start(design, open_), lower, upper)
        descent = least_squares(state, start, lower=lower, upper=upper, cycles=cycles, until=self.until)
        if descent.stopped == "interrupted":
            raise KeyboardInterrupt
        self.evaluations += descent.evaluations
        self.descended += len(descent.cycles)
        count, k = len(self.model.variables), self.pool.count
        end = descent.state.x
        numbers = {s: end[count + k * j : count + k * (j + 1)] for j, s in enumerate(open_)}
        glasses = design.glasses | {s: self.pool.model(of_glass) for s, of_glass in numbers.items()}
        return DescendedDesign(end[:count], glasses, descent.state)

    def predicted(self, design: Design, surfaces: Sequence[int], open_: Sequence[int]) -> dict[int, np.ndarray]:
        """The predicted merits (G,) of the candidates of surfaces; the glasses of `open_` follow as well."""
        models = {k: self.pool.model(self.numbers(design, k)) for k in self.surfaces}
        modelled = Design(design.x, models)
        x = self._start(modelled, self.surfaces)
        state = self.limited(self.problem(models, self.surfaces), self.surfaces)(x, True)
        count, k = len(self.model.variables), self.pool.count
        columns = {s: np.arange(count + k * j, count + k * (j + 1)) for j, s in enumerate(self.surfaces)}
        inside = np.arange(count)[(design.x > self.bounds[0]) & (design.x < self.bounds[1])]
        held = len(state.limits) - len(self.pool.normal) * len(self.surfaces)
        limits_met = state.limits_slope[:held][np.abs(state.limits[:held]) < _MET]
        merits = {}
        for s in surfaces:
            following = np.concatenate([inside, *(columns[o] for o in open_ if o != s)]).astype(int)
            change = self.candidates[s][1] - self.numbers(design, s)
            merits[s] = expansion(state, columns[s], following, limits_met).merit(change)
        return merits

    def numbers(self, design: Design, surface: int) -> np.ndarray:
        glass = design.glasses[surface]
        return self.pool.numbers_of(glass) if glass.catalog else glass.coefficients.numpy()[: self.pool.count]

    def tried(
        self, design: Design, surface: int, merits: np.ndarray, open_: Sequence[int]
    ) -> tuple[DescendedDesign, Glass, float, Trials] | None:
        """Design, glass and predicted merit of the best of the promising candidates, and all that were tried."""
        (glasses, numbers), current = self.candidates[surface], design.glasses[surface]
        width = np.maximum(np.ptp(self.pool.numbers, axis=0), 1e-9)
        candidates: list[int] = []  # none like another
        for i in np.argsort(merits * [charge(glass) for glass in glasses], kind="stable"):
            if glasses[i].name == current.name and current.catalog:
                continue
            if all(np.abs((numbers[i] - numbers[j]) / width).max() > _ALIKE for j in candidates):
                candidates.append(int(i))
            if len(candidates) == TRIED:
                break
        best: tuple[DescendedDesign, Glass, float] | None = None
        tried: list[tuple[str, float, float]] = []
        for i in candidates:
            if tried and time.monotonic() > self.until:
                break
            trial = Design(design.x, design.glasses | {surface: glasses[i]})
            end = self.descend(trial, open_, min(TRIAL_CYCLES, self.cycles))
            tried.append((glasses[i].name, float(merits[i]), end.merit))
            if best is None or end.rank(charge(glasses[i])) < best[0].rank(charge(best[1])):
                best = end, glasses[i], float(merits[i])
        return (*best, tuple(tried)) if best else None

    def snap(self, design: Design, waiting: list[int]) -> DescendedDesign:
        """The design with a glass of the catalogs in the element whose merit rises most by that."""
        merits = self.predicted(design, waiting, waiting)
        surface = max(waiting, key=lambda k: float(merits[k].min()))
        waiting.remove(surface)
        best = self.tried(design, surface, merits[surface], waiting)
        assert best is not None  # a model glass is no candidate itself
        end, glass, predicted, tried = best
        self._took("snap", surface, glass, "", predicted, end, tried)
        return end

    def swap(self, tested: Sequence[int] = ()) -> None:
        """Exchange one glass at a time, the most promising first, until no exchange lowers the merit.

        tested: surfaces at which no exchange lowers it.
        """
        left_alone = set(tested)
        for _ in range(_ROUNDS * len(self.surfaces)):
            left = [k for k in self.surfaces if k not in left_alone]
            if not left or time.monotonic() > self.until:
                return
            merits = self.predicted(self.best, left, ())
            surface = min(left, key=lambda k: float(merits[k].min()))
            left_alone.add(surface)
            if self._swap(surface, merits[surface]):
                left_alone = {surface}
            self._keep(left_alone)

    def _swap(self, surface: int, merits: np.ndarray) -> bool:
        """Exchange a glass, if that lowers the merit."""
        design, before = self.best, self.best.glasses[surface]
        best = self.tried(design, surface, merits, ())
        if best is None:
            return False
        end, glass, predicted, tried = best
        if not end.rank(charge(glass)) < design.rank(charge(before) * (1 - _GAIN)):
            return False
        end = self.descend(end, (), self.cycles)
        if not end.rank() < design.rank():
            return False
        self.best = end
        self._took("swap", surface, glass, before.name, predicted, end, tried)
        return True

    def _took(
        self,
        kind: str,
        surface: int,
        glass: Glass,
        replaced: str,
        predicted: float,
        design: DescendedDesign,
        tried: Trials,
    ) -> None:
        taken = surface, glass.name, glass.catalog, replaced, predicted, tried
        self.steps.append(GlassStep(kind, design.merit, self.seconds, *taken))
