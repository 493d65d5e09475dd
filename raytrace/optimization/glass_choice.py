"""Glass choice: the catalog glasses of an optimisation with variable glasses.

1. The lens is optimised with its glasses: later steps may not end worse.
2. Variable glasses become model glasses, whose numbers (n, V, ΔP) stay within the convex hull of the catalogs. The
   lens is optimised with them.
3. One element at a time, the one that loses most first, takes a glass of the catalogs.
4. One glass at a time is exchanged, until no exchange lowers the merit.

An expansion of the merit selects the glasses that are tried. With the derivatives J_y of the residuals r by all other
variables, and J_p by the numbers p of a glass, the merit after the others have followed is, to second order,

    M²(p + d) = |N (r + J_p d)|²,   N = 1 - J_y (J_yᵀ J_y + λ D²)⁻¹ J_yᵀ

so that NJ_p holds Schur's complement of the Hessian. The best few are optimised, and the merit reached decides.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from raytrace.materials.catalogs import Catalog, CatalogError, load, missing_catalogs, shipped_catalog
from raytrace.materials.glass import Glass, is_air, model_glass, refractive_index
from raytrace.optimization.checkpoint import BadCheckpoint, Stored
from raytrace.optimization.least_squares import State, least_squares
from raytrace.optimization.problem import Condition, NoProblem, Problem
from raytrace.optimization.variables import DesignVariables, followers
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row, Solve, Vary
from raytrace.system.parameter_paths import GLASS
from raytrace.words import option

_MATTERS = 1e-6  # of the index: what a number of a glass must change of it at the wavelengths, to vary

#: Statuses that are chosen from; a merit counts so much more with a glass of another than the first.
STATUSES = {"preferred": 1.0, "standard": 1.03, "": 1.03}
_PRICE = 0.02  # the power of the price, relative to that of the catalog's cheapest sort, by which a merit counts more


class Pool:
    """Glasses to choose from: their numbers (G, k) and the hull of these, normal (F, k) · p ≤ reach (F,)."""

    def __init__(self, glasses: Sequence[Glass], wavelengths: torch.Tensor):
        self.wavelengths, self.basis = wavelengths, _basis(wavelengths)
        self.glasses = tuple(glasses)
        found = np.array([self.numbers_of(glass) for glass in self.glasses]).reshape(-1, self.count)
        usable = np.isfinite(found).all(1)
        self.glasses = tuple(glass for glass, use in zip(self.glasses, usable, strict=True) if use)
        self.numbers = found[usable]
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
        """What varies of a model glass."""
        return tuple(GLASS)[: self.count]

    def numbers_of(self, glass: Glass) -> np.ndarray:
        """(k,) of the model glass whose indices come nearest at the wavelengths; as many of them are met exactly."""
        excess = refractive_index(glass, self.wavelengths).numpy() - 1
        found = np.linalg.lstsq(self.basis, excess, rcond=None)[0]
        n, dispersion, deviation = np.pad(found, (0, 3 - self.count))
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
    at = lambda *numbers: refractive_index(model_glass(*numbers), wavelengths).numpy() - 1  # noqa: E731
    if len(wavelengths) == 1:
        return np.ones((1, 1))
    whole, half, deviating = at(2.0, 1.0), at(2.0, 2.0), at(2.0, 1.0, 1.0)
    basis = np.stack([2 * half - whole, 2 * (whole - half), deviating - whole], -1)[:, : len(wavelengths)]
    typical = np.array([0.6, 0.012, 1e-4])[: basis.shape[1]]
    new = np.abs(np.diag(np.linalg.qr(basis * typical)[1])) > _MATTERS
    return basis[:, : int(np.argmin(new)) if not new.all() else len(new)]


def hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The convex hull of points (G, k): normal (F, k) · p ≤ reach (F,), a length of 1 as large as all of them.

    A box where they are too few, or in a plane.
    """
    low, size = points.min(0), np.maximum(np.ptp(points, axis=0), 1e-9)
    scaled = (points - low) / size
    try:
        found = ConvexHull(scaled).equations
    except (QhullError, ValueError):
        axes = np.eye(points.shape[1])
        found = np.concatenate([np.c_[axes, -scaled.max(0)], np.c_[-axes, scaled.min(0)]])
    found = np.unique(found.round(12), axis=0)
    normal = found[:, :-1] / size
    return normal, normal @ low - found[:, -1]


def catalogs_of(lens: Lens, catalog: Sequence[str | Path] = ()) -> tuple[Catalog, ...]:
    """Catalogs by their names or AGF files; without any those that the lens names, else SCHOTT. Raises CatalogError."""
    shipped = [name for name in lens.catalogs if name not in missing_catalogs([name])]
    catalogs = []
    for name in catalog or shipped or ("SCHOTT",):
        if Path(name).suffix or Path(name).is_file():
            catalogs.append(load(name))
            continue
        try:
            catalogs.append(shipped_catalog(str(name)))
        except CatalogError as error:
            raise NoProblem(f"{option('catalog')}: {error}") from None
    return tuple(catalogs)


def pool_of(lens: Lens, catalogs: Sequence[Catalog]) -> Pool:
    """Glasses of STATUSES whose range covers the wavelengths of the lens. Raises NoProblem where there is none."""
    shortest, longest = float(lens.wavelengths.min()), float(lens.wavelengths.max())
    span = lambda glass: glass.wavelength_range or (0.0, np.inf)  # noqa: E731
    found = [
        dataclasses.replace(glass, name=glass.listed_name or glass.name)
        for one in catalogs
        for glass in one.glasses.values()
        if glass.status in STATUSES and span(glass)[0] <= shortest and longest <= span(glass)[1] and not is_air(glass)
    ]
    return Pool(found, lens.wavelengths)


def charge(glass: Glass) -> float:
    """Factor on the merit of a glass that its maker does not prefer, or that is expensive."""
    price = next((numbers[0] for keyword, numbers in glass.records if keyword == "OD" and numbers), 0.0)
    return STATUSES.get(glass.status, max(STATUSES.values())) * max(price, 1.0) ** _PRICE


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
_GAIN = 5e-3  # by which an exchange must make the merit less, as part of it
_DAMPING = 1e-4  # of the variables that follow in the expansion
_MET = 1e-5  # up to which a condition that is missed counts as met
_ALIKE = 0.01  # of the width of the hull: glasses that are nearer are not both tried

#: Descriptions of the kinds of steps.
WORDS = {
    "own": "all other variables, with the glasses of the lens",
    "model": "and with model glasses",
    "snap": "surface",
    "swap": "exchanged at surface",
}


@dataclass(frozen=True)
class GlassStep:
    """One step of the choice.

    kind: "own", "model", "snap" or "swap"; surface, name, catalog: of the new glass, 0 and "" of the former two;
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
    tried: tuple[tuple[str, float, float], ...] = ()

    def document(self) -> dict:
        named = {"surface": self.surface, "glass": self.name, "catalog": self.catalog, "predicted": self.predicted}
        tried = [dict(zip(("glass", "predicted", "reached"), one, strict=True)) for one in self.tried]
        more = {**named, "replaced": self.replaced or None, "tried": tried} if self.surface else {}
        return {"step": self.kind, **more, "reached": self.reached, "seconds": round(self.seconds, 3)}

    @property
    def words(self) -> str:
        if not self.surface:
            return WORDS[self.kind]
        instead = f" for {self.replaced}" if self.replaced else ""
        return f"{WORDS[self.kind]} {self.surface}: {self.name} ({self.catalog}){instead}"


@dataclass(frozen=True)
class Design:
    """A state of the choice: variables x (n,) but for glasses, the glasses, and the state of the solver."""

    x: np.ndarray
    glasses: dict[int, Glass]
    state: State

    @property
    def merit(self) -> float:
        return float(np.sqrt(self.state.cost))

    def rank(self, charged: float = 1.0) -> tuple:
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


def expansion(state: State, own: np.ndarray, following: np.ndarray, fixed: np.ndarray) -> Expansion:
    """The merit by the variables `own` after `following` ones have followed, conditions met; numbers of columns.

    fixed: (h', n) slopes of limits that are met just so, and stay met.
    """
    J, r = state.jacobian, state.residuals
    A, c = np.vstack([state.held_slope, fixed]), np.concatenate([state.held, np.zeros(len(fixed))])
    columns = J[:, following]
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    back = np.linalg.pinv(A[:, following] / scale) if len(A) else np.zeros((len(following), 0))
    columns = columns / scale
    r, steep = r - columns @ (back @ c), J[:, own] - columns @ (back @ A[:, own])
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
        **options,
    ):
        """cycles: of a stage, at most; until: a time of `time.monotonic`; keep: called with the best state while
        glasses are exchanged, and its merit; options: of Problem."""
        self.model, self.surfaces, self.pool, self.bounds = model, tuple(surfaces), pool, bounds
        self.rows, self.conditions, self.options = rows, conditions, options
        self.cycles = _CYCLES if cycles is None else min(cycles, _CYCLES)
        self.until, self.started, self.evaluations = until, time.monotonic(), 0
        self.descended = 0  # cycles
        self.steps, self.keep = [], keep or (lambda stored, merit: None)

    @cached_property
    def candidates(self) -> dict[int, tuple[tuple[Glass, ...], np.ndarray]]:
        """For every surface the glasses and their numbers: of the pool, and its own glass, if of a catalog."""
        found = {}
        for k in self.surfaces:
            own, names = self.model.lens.surfaces[k].glass, {(g.name, g.catalog) for g in self.pool.glasses}
            new = bool(own.catalog) and (own.listed_name or own.name, own.catalog) not in names
            glasses = (*self.pool.glasses, own) if new else self.pool.glasses
            numbers = [self.pool.numbers, self.pool.numbers_of(own)[None]] if new else [self.pool.numbers]
            found[k] = glasses, np.concatenate(numbers)
        return found

    def run(self, x: np.ndarray, stored: Stored | None = None) -> Design:
        """The best design from variables x, which are within their bounds; stored: from where exchanges resume."""
        own = {k: self.model.lens.surfaces[k].glass for k in self.surfaces}
        if stored is not None and stored.glasses:
            chosen = own | {k: self._named(k, *one) for k, one in stored.glasses.items()}
            self.best = Design(x, chosen, self.limited(self.problem(chosen, ()), ())(x, True))
            if stored.descent is None:  # else all exchanges were done
                with suppress(KeyboardInterrupt):  # the best so far
                    self.swap(stored.tested)
            return self.best
        first = self.descend(Design(x, own, None), (), self.cycles)
        self.steps.append(GlassStep("own", first.merit, self.seconds))
        self.best = first
        with suppress(KeyboardInterrupt):
            known = all(glass.catalog for glass in own.values())
            if known and time.monotonic() > self.until:
                return first
            snapped = self.snapped(first, known=known)
            self.best = min(first, snapped, key=Design.rank) if known else snapped
            self._keep(())
            self.swap()
        return self.best

    def _named(self, surface: int, catalog: str, name: str) -> Glass:
        """The candidate of a name. Raises BadCheckpoint."""
        for glass in self.candidates[surface][0]:
            if (glass.catalog, glass.name) == (catalog, name):
                return glass
        raise BadCheckpoint(f"the checkpoint's glass {name} of {catalog}, surface {surface}: no catalog given has it")

    def _keep(self, tested: Sequence[int]) -> None:
        glasses = {k: (glass.catalog, glass.name) for k, glass in self.best.glasses.items()}
        self.keep(Stored(self.best.x, glasses, tuple(sorted(tested))), self.best.merit)

    def snapped(self, design: Design, *, known: bool) -> Design:
        """The design with model glasses first, then with glasses of the catalogs in their places, one by one; as it is
        where no time is left for that, and its glasses are known ones."""
        first, model = design, {k: self.pool.model(self.pool.numbers_of(glass)) for k, glass in design.glasses.items()}
        design = self.descend(Design(design.x, model, None), self.surfaces, self.cycles)
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
        """With these glasses; the numbers of those of surfaces `open_` vary behind the other variables."""
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

    def limited(self, problem: Problem, open_: Sequence[int]):
        """The states of a problem with the hull of the glasses as limits."""
        count, k = len(self.model.variables), self.pool.count
        slope = np.zeros((0, count + k * len(open_)))
        for j in range(len(open_)):
            rows = np.zeros((len(self.pool.normal), slope.shape[1]))
            rows[:, count + k * j : count + k * (j + 1)] = self.pool.normal
            slope = np.vstack([slope, rows])
        reach = np.tile(self.pool.reach, len(open_))

        def state(x: np.ndarray, derivatives: bool) -> State:
            found = problem.state(x, derivatives)
            limits = np.concatenate([found.limits, slope @ x - reach])
            slopes = None if found.limits_slope is None else np.vstack([found.limits_slope, slope])
            return dataclasses.replace(found, limits=limits, limits_slope=slopes)

        return state

    def _start(self, design: Design, open_: Sequence[int]) -> np.ndarray:
        numbers = [design.glasses[k].coefficients.numpy()[: self.pool.count] for k in open_]
        return np.concatenate([design.x, *numbers])

    def descend(self, design: Design, open_: Sequence[int], cycles: int) -> Design:
        """The design at its minimum; glasses of surfaces `open_` are variable model glasses."""
        state = self.limited(self.problem(design.glasses, open_), open_)
        rest = np.full(self.pool.count * len(open_), np.inf)
        lower, upper = np.concatenate([self.bounds[0], -rest]), np.concatenate([self.bounds[1], rest])
        start = np.clip(self._start(design, open_), lower, upper)
        found = least_squares(state, start, lower=lower, upper=upper, cycles=cycles, until=self.until)
        if found.stopped == "interrupted":
            raise KeyboardInterrupt
        self.evaluations += found.evaluations
        self.descended += len(found.cycles)
        count, k = len(self.model.variables), self.pool.count
        end = found.state.x
        numbers = {s: end[count + k * j : count + k * (j + 1)] for j, s in enumerate(open_)}
        glasses = design.glasses | {s: self.pool.model(one) for s, one in numbers.items()}
        return Design(end[:count], glasses, found.state)

    def predicted(self, design: Design, surfaces: Sequence[int], open_: Sequence[int]) -> dict[int, np.ndarray]:
        """For surfaces the predicted merits (G,) of their candidates; glasses of `open_` follow too."""
        models = {k: self.pool.model(self.numbers(design, k)) for k in self.surfaces}
        modelled = Design(design.x, models, None)
        x = self._start(modelled, self.surfaces)
        state = self.limited(self.problem(models, self.surfaces), self.surfaces)(x, True)
        count, k = len(self.model.variables), self.pool.count
        columns = {s: np.arange(count + k * j, count + k * (j + 1)) for j, s in enumerate(self.surfaces)}
        inside = np.arange(count)[(design.x > self.bounds[0]) & (design.x < self.bounds[1])]
        held = len(state.limits) - len(self.pool.normal) * len(self.surfaces)
        at = state.limits_slope[:held][np.abs(state.limits[:held]) < _MET]
        merits = {}
        for s in surfaces:
            following = np.concatenate([inside, *(columns[o] for o in open_ if o != s)]).astype(int)
            change = self.candidates[s][1] - self.numbers(design, s)
            merits[s] = expansion(state, columns[s], following, at).merit(change)
        return merits

    def numbers(self, design: Design, surface: int) -> np.ndarray:
        glass = design.glasses[surface]
        return self.pool.numbers_of(glass) if glass.catalog else glass.coefficients.numpy()[: self.pool.count]

    def tried(self, design: Design, surface: int, merits: np.ndarray, open_: Sequence[int]):
        """(design, glass, predicted merit, all that were tried) of the best of the promising candidates."""
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
        best, tried = None, []
        for i in candidates:
            if tried and time.monotonic() > self.until:
                break
            trial = Design(design.x, design.glasses | {surface: glasses[i]}, None)
            end = self.descend(trial, open_, min(TRIAL_CYCLES, self.cycles))
            tried.append((glasses[i].name, float(merits[i]), end.merit))
            if best is None or end.rank(charge(glasses[i])) < best[0].rank(charge(best[1])):
                best = end, glasses[i], float(merits[i])
        return (*best, tuple(tried)) if best else None

    def snap(self, design: Design, waiting: list[int]) -> Design:
        """The design in which the element that loses most by it has taken a glass of the catalogs."""
        merits = self.predicted(design, waiting, waiting)
        surface = max(waiting, key=lambda k: float(merits[k].min()))
        waiting.remove(surface)
        end, glass, predicted, tried = self.tried(design, surface, merits[surface], waiting)
        self._took("snap", surface, glass, "", predicted, end, tried)
        return end

    def swap(self, tested: Sequence[int] = ()) -> None:
        """Exchange one glass at a time, the most promising first, until none helps; tested: where none has helped."""
        tested = set(tested)
        for _ in range(_ROUNDS * len(self.surfaces)):
            left = [k for k in self.surfaces if k not in tested]
            if not left or time.monotonic() > self.until:
                return
            merits = self.predicted(self.best, left, ())
            surface = min(left, key=lambda k: float(merits[k].min()))
            tested.add(surface)
            if self._swap(surface, merits[surface]):
                tested = {surface}
            self._keep(tested)

    def _swap(self, surface: int, merits: np.ndarray) -> bool:
        """Exchange a glass, if that helps."""
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

    def _took(self, kind: str, surface: int, glass: Glass, replaced: str, predicted: float, design: Design, tried):
        taken = surface, glass.name, glass.catalog, replaced, predicted, tried
        self.steps.append(GlassStep(kind, design.merit, self.seconds, *taken))
