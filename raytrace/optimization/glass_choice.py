"""Glass: which glasses of the catalogs an optimisation ends with.

1. The lens is optimised with its own glasses: nothing that follows may end worse.
2. Glasses that vary become model glasses, whose numbers (n, V, ΔP) have bounds in common: the convex hull of the
   catalogs. The lens is optimised with them too.
3. One element at a time, the one that loses most first, takes a glass of the catalogs.
4. Then one glass at a time is exchanged, until no exchange helps.

Which glasses are tried is told by an expansion of the merit. With the derivatives J_y by all other variables, and J_p
by the numbers p of a glass, of the residuals r, what is left after the others have followed is, to second order,

    M²(p + d) = |N (r + J_p d)|²,   N = 1 - J_y (J_yᵀ J_y + λ D²)⁻¹ J_yᵀ

so that NJ_p holds Schur's complement of the Hessian. The best few of the list are optimised; what they reach counts.

Pool: the glasses of catalogs that a lens may take, by the numbers of model glasses, and the hull of these.

Which glasses vary, and what varies beside them.
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
from raytrace.optimization.checkpoint import BadCheckpoint, Kept
from raytrace.optimization.least_squares import State, least_squares
from raytrace.optimization.lens_model import GLASS, Model
from raytrace.optimization.problem import Condition, NoProblem, Problem
from raytrace.optimization.variables import MEDIA, Freedom
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row, Solve, Vary

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
            raise NoProblem("no glass of the catalogs covers the wavelengths of the lens; name others by `catalog`")
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
    return tuple(_catalog(name) for name in (catalog or shipped or ("SCHOTT",)))


def _catalog(name: str | Path) -> Catalog:
    if Path(name).suffix or Path(name).is_file():
        return load(name)
    try:
        return shipped_catalog(str(name))
    except CatalogError as error:
        raise NoProblem(f"`catalog`: {error}") from None


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
    """By how much a merit counts more with a glass that its maker does not prefer, or that is dear."""
    price = next((numbers[0] for keyword, numbers in glass.records if keyword == "OD" and numbers), 0.0)
    return STATUSES.get(glass.status, max(STATUSES.values())) * max(price, 1.0) ** _PRICE


def without_glass(free: Freedom, vary: str | Sequence | None) -> tuple[Freedom, tuple[int, ...]]:
    """What varies but for glasses, and the surfaces whose glasses do.

    Those that the file marks, where words mean all; other numbers of those glasses vary no more. The file's variables
    follow where words name nothing but glasses. Raises NoProblem.
    """
    chosen = {one.surface for one in free.variables if one.quantity == "glass"}
    if not chosen:
        return free, ()
    chosen = _marked(free.lens, vary, chosen) - set(followers(free.lens))
    differing = [k for k in sorted(chosen) if _differs(free.lens, k)]
    if differing or not chosen:
        which = f"of surface {differing[0]} differs between the configurations" if differing else "follows another"
        raise NoProblem(f"`vary=glass`: the glass {which}")
    own = () if free.lens.optimization_data is None else free.lens.optimization_data.variables
    others = _others(free.variables, chosen) or _others(own, chosen)
    if not others:
        raise NoProblem("`vary=glass`: nothing but glasses varies; name what follows them, as 'curvature glass'")
    return dataclasses.replace(free, variables=others), tuple(sorted(chosen))


def _others(variables: Sequence[Vary], chosen: set[int]) -> tuple[Vary, ...]:
    """The variables but for glasses, and for numbers of glasses that are chosen."""
    of_media = (*MEDIA, *GLASS)
    return tuple(
        one for one in variables if one.quantity != "glass" and not (one.quantity in of_media and one.surface in chosen)
    )


def _marked(lens: Lens, vary: str | Sequence | None, surfaces: set[int]) -> set[int]:
    """Of the surfaces whose glasses vary those that the file marks as exchangeable, unless words name surfaces."""
    words = vary if isinstance(vary, str) else " ".join(one for one in vary or () if isinstance(one, str))
    kept = () if lens.optimization_data is None else lens.optimization_data.kept
    told = {one.surface for one in kept if (one.quantity, one.kind) == ("glass", "substitute")}
    all_meant = "glass" in words.split()
    return (told & surfaces or surfaces) if all_meant else surfaces


def followers(lens: Lens) -> dict[int, int]:
    """Surfaces whose glass is that of another, and which one's."""
    rules = () if lens.optimization_data is None else (*lens.optimization_data.solves, *lens.optimization_data.kept)
    return {
        one.surface: one.source
        for one in rules
        if (one.quantity, one.kind) == ("glass", "pickup") and one.operand is None
    }


def _differs(lens: Lens, surface: int) -> bool:
    return any(place.path[:3] == ("surfaces", surface, "glass") for one in lens.operands for place in one.paths)


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

#: Kinds of steps, by what is told of them.
WORDS = {
    "own": "all other variables, with the glasses of the lens",
    "model": "and with model glasses",
    "snap": "surface",
    "swap": "exchanged at surface",
}


@dataclass(frozen=True)
class GlassStep:
    """One step of the choice.

    kind: "own", "model", "snap" or "swap"; surface, name, catalog: of the glass that was taken, 0 and "" of the former
    two; replaced: the glass before. predicted, reached: merits. tried: (name, predicted, reached) of all that were
    optimised.
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

    def __str__(self) -> str:
        if not self.surface:
            return f"{WORDS[self.kind]:<52} {'':>14} {self.reached:>14.6g} {self.seconds:>8.1f}"
        instead = f" for {self.replaced}" if self.replaced else ""
        said = f"{WORDS[self.kind]} {self.surface}: {self.name} ({self.catalog}){instead}"
        return f"{said:<52} {self.predicted:>14.6g} {self.reached:>14.6g} {self.seconds:>8.1f}"


@dataclass(frozen=True)
class Design:
    """A state of the choice: variables x (n,) but for glasses, the glasses, and what the solver says there."""

    x: np.ndarray
    glasses: dict[int, Glass]
    state: State

    @property
    def merit(self) -> float:
        return float(np.sqrt(self.state.cost))

    def rank(self, charged: float = 1.0) -> tuple:
        """Fewer rays lost, then conditions met, then less merit."""
        missed = float(self.state.missed.max(initial=0.0))
        return self.state.lost, missed if missed > _MET else 0.0, self.merit * charged


@dataclass(frozen=True)
class Expansion:
    """The square of the merit by the numbers d (…, k) of a glass: cost + 2 gradient · d + d · hessian d."""

    cost: float
    gradient: np.ndarray
    hessian: np.ndarray

    def merit(self, d: np.ndarray) -> np.ndarray:
        """(…) the merit that is foretold."""
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
    """The glasses of surfaces of a lens, chosen from a pool; `run` gives the best design, its problem and the steps."""

    def __init__(
        self,
        free: Freedom,
        surfaces: Sequence[int],
        pool: Pool,
        rows: Sequence[Row],
        conditions: Sequence[Condition],
        bounds: tuple[np.ndarray, np.ndarray],
        *,
        cycles: int | None = None,
        until: float = np.inf,
        tell: Callable[[GlassStep], None] | None = None,
        keep: Callable[[Kept, float], None] | None = None,
        **options,
    ):
        """cycles: of a stage, at most; until: a time of `time.monotonic`; tell: told of steps; keep: given the best
        while glasses are exchanged, and its merit; options: of Problem."""
        self.free, self.surfaces, self.pool, self.bounds = free, tuple(surfaces), pool, bounds
        self.rows, self.conditions, self.options = rows, conditions, options
        self.cycles = _CYCLES if cycles is None else min(cycles, _CYCLES)
        self.until, self.begun, self.evaluations, self.tell = until, time.monotonic(), 0, tell or (lambda step: None)
        self.descended = 0  # cycles
        self.steps, self.keep = [], keep or (lambda kept, merit: None)

    @cached_property
    def candidates(self) -> dict[int, tuple[tuple[Glass, ...], np.ndarray]]:
        """For every surface the glasses and their numbers: of the pool, and its own glass, if of a catalog."""
        found = {}
        for k in self.surfaces:
            own, names = self.free.lens.surfaces[k].glass, {(g.name, g.catalog) for g in self.pool.glasses}
            new = bool(own.catalog) and (own.listed_name or own.name, own.catalog) not in names
            glasses = (*self.pool.glasses, own) if new else self.pool.glasses
            numbers = [self.pool.numbers, self.pool.numbers_of(own)[None]] if new else [self.pool.numbers]
            found[k] = glasses, np.concatenate(numbers)
        return found

    def run(self, x: np.ndarray, kept: Kept | None = None) -> Design:
        """The best design from variables x, which are within their bounds; kept: from where exchanges go on."""
        own = {k: self.free.lens.surfaces[k].glass for k in self.surfaces}
        if kept is not None and kept.glasses:
            chosen = own | {k: self._named(k, *one) for k, one in kept.glasses.items()}
            self.best = Design(x, chosen, self.limited(self.problem(chosen, ()), ())(x, True))
            if kept.course is None:  # else all exchanges were done
                with suppress(KeyboardInterrupt):  # the best so far
                    self.swap(kept.tested)
            return self.best
        first = self.descend(Design(x, own, None), (), self.cycles)
        self._tell(GlassStep("own", first.merit, self.seconds))
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
        self.keep(Kept(self.best.x, glasses, tuple(sorted(tested))), self.best.merit)

    def snapped(self, design: Design, *, known: bool) -> Design:
        """The design with model glasses first, then with glasses of the catalogs in their places, one by one; as it is
        where no time is left for that, and its glasses are known ones."""
        first, model = design, {k: self.pool.model(self.pool.numbers_of(glass)) for k, glass in design.glasses.items()}
        design = self.descend(Design(design.x, model, None), self.surfaces, self.cycles)
        self._tell(GlassStep("model", design.merit, self.seconds))
        waiting = list(self.surfaces)
        while waiting:
            if known and time.monotonic() > self.until:
                return first
            design = self.snap(design, waiting)
        return self.descend(design, (), self.cycles)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.begun

    def _tell(self, step: GlassStep) -> None:
        self.steps.append(step)
        self.tell(step)

    def problem(self, glasses: dict[int, Glass], open_: Sequence[int]) -> Problem:
        """With these glasses; the numbers of those of surfaces `open_` vary behind the other variables."""
        numbers = tuple(Vary(k, name) for k in open_ for name in self.pool.names)
        follow = tuple(
            Solve(k, name, "pickup", source=source)
            for k, source in followers(self.free.lens).items()
            for name in self.pool.names
            if source in open_
        )
        model = Model(
            with_glasses(self.free.lens, glasses), (*self.free.variables, *numbers), (*self.free.solves, *follow)
        )
        return Problem(model, self.rows, self.conditions, **self.options)

    def limited(self, problem: Problem, open_: Sequence[int]):
        """The states of a problem with the hull of the glasses as limits."""
        count, k = len(self.free.variables), self.pool.count
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
        """The design at its least; glasses of surfaces `open_` are model glasses that vary."""
        state = self.limited(self.problem(design.glasses, open_), open_)
        rest = np.full(self.pool.count * len(open_), np.inf)
        lower, upper = np.concatenate([self.bounds[0], -rest]), np.concatenate([self.bounds[1], rest])
        start = np.clip(self._start(design, open_), lower, upper)
        found = least_squares(state, start, lower=lower, upper=upper, cycles=cycles, until=self.until)
        if found.stopped == "interrupted":
            raise KeyboardInterrupt
        self.evaluations += found.evaluations
        self.descended += len(found.cycles)
        count, k = len(self.free.variables), self.pool.count
        end = found.state.x
        numbers = {s: end[count + k * j : count + k * (j + 1)] for j, s in enumerate(open_)}
        glasses = design.glasses | {s: self.pool.model(one) for s, one in numbers.items()}
        return Design(end[:count], glasses, found.state)

    def foretold(self, design: Design, surfaces: Sequence[int], open_: Sequence[int]) -> dict[int, np.ndarray]:
        """For surfaces the merits (G,) that their candidates are foretold to reach; those in `open_` follow too."""
        models = {k: self.pool.model(self.numbers(design, k)) for k in self.surfaces}
        modelled = Design(design.x, models, None)
        x = self._start(modelled, self.surfaces)
        state = self.limited(self.problem(models, self.surfaces), self.surfaces)(x, True)
        count, k = len(self.free.variables), self.pool.count
        columns = {s: np.arange(count + k * j, count + k * (j + 1)) for j, s in enumerate(self.surfaces)}
        inside = np.arange(count)[(design.x > self.bounds[0]) & (design.x < self.bounds[1])]
        held = len(state.limits) - len(self.pool.normal) * len(self.surfaces)
        at = state.limits_slope[:held][np.abs(state.limits[:held]) < _MET]
        found = {}
        for s in surfaces:
            following = np.concatenate([inside, *(columns[o] for o in open_ if o != s)]).astype(int)
            merits = expansion(state, columns[s], following, at).merit(self.candidates[s][1] - self.numbers(design, s))
            found[s] = merits
        return found

    def numbers(self, design: Design, surface: int) -> np.ndarray:
        glass = design.glasses[surface]
        return self.pool.numbers_of(glass) if glass.catalog else glass.coefficients.numpy()[: self.pool.count]

    def tried(self, design: Design, surface: int, merits: np.ndarray, open_: Sequence[int]):
        """(design, glass, merit that was foretold, all that were tried) of the best of the promising candidates."""
        glasses, best, told = self.candidates[surface][0], None, []
        for i in self._first(design.glasses[surface], surface, merits):
            if told and time.monotonic() > self.until:
                break
            trial = Design(design.x, design.glasses | {surface: glasses[i]}, None)
            one = self.descend(trial, open_, min(TRIAL_CYCLES, self.cycles))
            told.append((glasses[i].name, float(merits[i]), one.merit))
            if best is None or one.rank(charge(glasses[i])) < best[0].rank(charge(best[1])):
                best = one, glasses[i], float(merits[i])
        return (*best, tuple(told)) if best else None

    def _first(self, now: Glass, surface: int, merits: np.ndarray) -> list[int]:
        """The candidates to try, none like another."""
        glasses, numbers = self.candidates[surface]
        width = np.maximum(np.ptp(self.pool.numbers, axis=0), 1e-9)
        taken: list[int] = []
        for i in np.argsort(merits * [charge(glass) for glass in glasses], kind="stable"):
            if glasses[i].name == now.name and now.catalog:
                continue
            if all(np.abs((numbers[i] - numbers[j]) / width).max() > _ALIKE for j in taken):
                taken.append(int(i))
            if len(taken) == TRIED:
                break
        return taken

    def snap(self, design: Design, waiting: list[int]) -> Design:
        """The design in which the element that loses most by it has taken a glass of the catalogs."""
        foretold = self.foretold(design, waiting, waiting)
        surface = max(waiting, key=lambda k: float(foretold[k].min()))
        waiting.remove(surface)
        found, glass, predicted, told = self.tried(design, surface, foretold[surface], waiting)
        self._took("snap", surface, glass, "", predicted, found, told)
        return found

    def swap(self, tested: Sequence[int] = ()) -> None:
        """Exchange one glass at a time, the most promising first, until none helps; tested: where none has helped."""
        tested = set(tested)
        for _ in range(_ROUNDS * len(self.surfaces)):
            left = [k for k in self.surfaces if k not in tested]
            if not left or time.monotonic() > self.until:
                return
            foretold = self.foretold(self.best, left, ())
            surface = min(left, key=lambda k: float(foretold[k].min()))
            tested.add(surface)
            if self._swap(surface, foretold[surface]):
                tested = {surface}
            self._keep(tested)

    def _swap(self, surface: int, foretold: np.ndarray) -> bool:
        """Exchange a glass, if that helps."""
        design, before = self.best, self.best.glasses[surface]
        tried = self.tried(design, surface, foretold, ())
        if tried is None:
            return False
        found, glass, predicted, told = tried
        if not found.rank(charge(glass)) < design.rank(charge(before) * (1 - _GAIN)):
            return False
        found = self.descend(found, (), self.cycles)
        if not found.rank() < design.rank():
            return False
        self.best = found
        self._took("swap", surface, glass, before.name, predicted, found, told)
        return True

    def _took(self, kind: str, surface: int, glass: Glass, replaced: str, predicted: float, found: Design, told):
        taken = surface, glass.name, glass.catalog, replaced, predicted, told
        self._tell(GlassStep(kind, found.merit, self.seconds, *taken))
