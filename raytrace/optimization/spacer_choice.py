"""Choice of the materials of spacers in an optimisation of a lens with temperatures (`Lens.with_temperatures`).

The word spacer:2,4 of variables means the expansions α of the spacers behind these surfaces, spacer those of all
spaces, barrel one material of all of them. Materials are few, so that all combinations are compared: with the
derivatives J_y of the residuals r by all other variables and J_α by the expansions, the merit after the others have
followed is

    M²(α + d) = |N (r + J_α d)|²,   N = 1 - J_y (J_yᵀ J_y + λ D²)⁻¹ J_yᵀ

as for glasses (`glass_choice`). The best few combinations are optimised, and the merit reached decides. Spaces are
linear in α, so that the prediction is nearly exact.
"""

import dataclasses
import itertools
import re
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from raytrace.materials.mounts import MOUNTS, expansion_of
from raytrace.optimization.glass_choice import TRIAL_CYCLES, TRIED, expansion
from raytrace.optimization.problem import NoProblem, Problem
from raytrace.system.expansion import spaces
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Vary
from raytrace.system.parameter_paths import BadVariables, counted, joined
from raytrace.words import option

_ROUNDS = 6
_GAIN = 1e-6  # smallest relative reduction of the merit by other materials
_MOST = 1_000_000  # combinations that are compared
_STEP = 1.0  # 1e-6/K, of the differences by expansions


@dataclass(frozen=True)
class SpacerStep:
    """Materials that were chosen: the spaces by the surfaces before them, with the expansion before, 1e-6/K or nan.

    surfaces: of each material; names; predicted, reached: merits; tried: (names, predicted, reached) of the
    combinations that were optimised.
    """

    surfaces: tuple[tuple[int, ...], ...]
    names: tuple[str, ...]
    before: tuple[float, ...]
    predicted: float
    reached: float
    seconds: float
    tried: tuple[tuple[tuple[str, ...], float, float], ...] = ()

    @property
    def words(self) -> str:
        pairs = zip(self.surfaces, self.names, strict=True)
        return ", ".join(f"spacer of {','.join(map(str, places))}: {name}" for places, name in pairs)

    def document(self) -> dict[str, Any]:
        spacers = [
            {"surfaces": [*places], "material": name, "expansion_before": None if np.isnan(old) else old}
            for places, name, old in zip(self.surfaces, self.names, self.before, strict=True)
        ]
        tried = [{"materials": [*names], "predicted": p, "reached": r} for names, p, r in self.tried]
        return {"spacers": spacers, "predicted": self.predicted, "reached": self.reached, "tried": tried}


def without_spacers(
    lens: Lens, vary: str | Sequence[str | Vary] | None
) -> tuple[str | Sequence[str | Vary] | None, list[tuple[int, ...]]]:
    """The variables without those of spacers, and the spaces that have one material each. Raises BadVariables."""
    words = vary.split() if isinstance(vary, str) else [*(vary or ())]
    mine = [word for word in words if isinstance(word, str) and re.fullmatch(r"(spacer|barrel)(:.*)?", word)]
    if not mine:
        return vary, []
    known, groups = spaces(lens.surfaces), list[tuple[int, ...]]()
    for word in mine:
        kind, _, places = str(word).partition(":")
        listed = counted(str(word), places) if places else known
        for k in listed:
            if k not in known:
                behind = ", ".join(map(str, known)) or "none"
                raise BadVariables(f"{word!r}: no spacer behind surface {k}; this lens has spaces behind {behind}")
        groups += [tuple(listed)] if kind == "barrel" else [(k,) for k in listed]
    twice = sorted(k for k, count in _counts(groups).items() if count > 1)
    if twice:
        raise BadVariables(f"{option('vary')}: the spacer behind surface {twice[0]} is named twice")
    solves = () if lens.optimization_data is None else lens.optimization_data.solves
    warm = {rule.surface for rule in solves if (rule.kind, rule.quantity) == ("thermal", "thickness")}
    if still := [k for group in groups for k in group if k not in warm]:
        raise BadVariables(
            f"{mine[0]!r}: the thickness behind surface {still[0]} has one temperature, at which its spacer does not "
            "matter; give the lens others by lens.with_temperatures([-20, 60]) or raytrace edit --temperatures -20 60"
        )
    return [word for word in words if word not in mine] or None, groups


def without_glasses(vary: str | Sequence[str | Vary] | None) -> list[str | Vary] | None:
    """The variables without glasses; None, those of the file, where there are no others."""
    words = vary.split() if isinstance(vary, str) else [*(vary or ())]
    return [word for word in words if not (isinstance(word, str) and word.partition(":")[0] == "glass")] or None


def _counts(groups: Sequence[tuple[int, ...]]) -> dict[int, int]:
    every = [k for group in groups for k in group]
    return {k: every.count(k) for k in every}


def materials_of(mounts: str | Sequence[str]) -> dict[str, float]:
    """Materials by name with their expansion, 1e-6/K, of words as "aluminium stainless-304 12.5"; by default MOUNTS.

    Raises ValueError for an unknown one.
    """
    words = joined(mounts).split()
    return {word: expansion_of(word) for word in words} or {name: mount.expansion for name, mount in MOUNTS.items()}


def with_spacers(lens: Lens, expansions: dict[int, float]) -> Lens:
    """The lens with spacers of these expansions, 1e-6/K, behind its surfaces."""
    surfaces = list(lens.surfaces)
    for k, number in expansions.items():
        surfaces[k] = dataclasses.replace(surfaces[k], expansion=lens.wavelengths.new_tensor(number))
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def choose_spacers(
    first: Any,
    groups: Sequence[tuple[int, ...]],
    materials: dict[str, float],
    problem: Callable[[Lens], Problem],
    optimised: Callable[..., Any],
    until: float,
) -> tuple[Any, list[SpacerStep], list[Any]]:
    """The best `Optimized`, the steps, and all results, from the first one, with the materials of the lens.

    problem: of a lens; optimised: the `Optimized` of a lens, of so many `cycles` and without a choice of glasses, or
    None: as requested. until: a time of `time.monotonic`.
    """
    best, steps, all_results, started = first, list[SpacerStep](), [first], time.monotonic()
    names, numbers = [*materials], np.array([*materials.values()])
    is_material = _expansions(best.lens, groups) is not None
    for _ in range(_ROUNDS):
        if time.monotonic() > until:
            break
        lens = best.lens
        combinations, predicted = _predicted(lens, groups, numbers, problem)
        order = np.argsort(predicted, kind="stable")
        now = _expansions(lens, groups)
        tried: list[tuple[np.ndarray, float, Any]] = []
        for index in order:
            choice = combinations[index]
            if now is not None and np.array_equal(numbers[choice], now):
                continue
            if len(tried) == TRIED:
                break
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                trial = optimised(_with(lens, groups, numbers[choice]), cycles=TRIAL_CYCLES)
            tried.append((choice, float(predicted[index]), trial))
            all_results.append(trial)
        if not tried:
            break
        choice, expected, trial = min(tried, key=lambda each: each[2].merit_after)
        if is_material and not trial.merit_after < best.merit_after * (1 - _GAIN):
            break
        before = [
            float("nan") if (α := lens.surfaces[group[0]].expansion) is None else float(α) for group in groups
        ]  # fmt: skip
        best = optimised(trial.lens, cycles=None)
        all_results.append(best)
        is_material = True
        listed = tuple((tuple(names[m] for m in c), p, r.merit_after) for c, p, r in tried)
        chosen = tuple(names[m] for m in choice)
        seconds = time.monotonic() - started
        steps.append(SpacerStep(tuple(groups), chosen, tuple(before), expected, best.merit_after, seconds, listed))
    return best, steps, all_results


def _expansions(lens: Lens, groups: Sequence[tuple[int, ...]]) -> np.ndarray | None:
    """The expansions of the groups; None where one has no material, or several."""
    stated = [[lens.surfaces[k].expansion for k in group] for group in groups]
    sets = [{None if α is None else float(α) for α in group} for group in stated]
    numbers = [next(iter(each)) for each in sets]
    known = [number for number in numbers if number is not None]
    return np.array(known) if len(known) == len(sets) and all(len(each) == 1 for each in sets) else None


def _with(lens: Lens, groups: Sequence[tuple[int, ...]], expansions: np.ndarray) -> Lens:
    pairs = zip(groups, expansions.tolist(), strict=True)
    return with_spacers(lens, {k: number for group, number in pairs for k in group})


def _predicted(
    lens: Lens, groups: Sequence[tuple[int, ...]], numbers: np.ndarray, problem: Callable[[Lens], Problem]
) -> tuple[np.ndarray, np.ndarray]:
    """Combinations (K, S) of materials, and the merits (K,) that are predicted for them."""
    if len(numbers) ** len(groups) > _MOST:
        raise NoProblem(
            f"{len(numbers)} materials of {len(groups)} spacers are more than {_MOST:,} combinations; name fewer "
            f"materials by {option('mounts')}, or barrel, one material of all spaces"
        )
    start = _expansions(lens, groups)
    start = np.full(len(groups), np.median(numbers)) if start is None else start
    states = []
    for k in range(-1, len(groups)):
        step = np.zeros(len(groups))
        step[k] = _STEP if k >= 0 else 0.0
        stepped = problem(_with(lens, groups, start + step))
        states.append(stepped.state(stepped.model.start, k < 0))
    here, *others = states
    rows, held = here.residuals, here.held
    by_residuals = np.stack([(other.residuals - rows) / _STEP for other in others], -1)
    by_held = np.stack([(other.held - held) / _STEP for other in others], -1)
    state = dataclasses.replace(
        here, jacobian=np.hstack([here.jacobian, by_residuals]), held_slope=np.hstack([here.held_slope, by_held])
    )
    count = here.jacobian.shape[1]
    columns, following = np.arange(count, count + len(groups)), np.arange(count)
    curve = expansion(state, columns, following, np.zeros((0, count + len(groups))))
    combinations = np.array([*itertools.product(range(len(numbers)), repeat=len(groups))])
    return combinations, curve.merit(numbers[combinations] - start)
