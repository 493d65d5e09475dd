"""Extended depth of field over noise: elements learned and filters made anew for each, judged on many pictures.

    e = ⟨P |1 - G H|²⟩ + σ² ⟨|G|²⟩       P: the power of one picture; ⟨·⟩ over frequencies: the mean over noise, undrawn

Two means over pictures are in use, and differ by about 1 dB:

    pooled: 10 log₁₀(1/⟨e⟩)         the mean of the errors: the pictures that are restored worst decide
    mean:   ⟨10 log₁₀(1/e)⟩         the mean of the PSNRs of single pictures: the usual one

Intervals are of samples of pictures drawn with replacement (bootstrap; Efron and Tibshirani, 1993). Pictures of one
class are alike, so that whole classes are drawn. Gains are paired: both elements on the same pictures.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace.imaging.restoration import depth_invariant_error, depth_invariant_wiener, psnr, wiener
from raytrace.studies.edof.settings import Settings
from raytrace.studies.edof.table import ROWS, STRENGTHS
from raytrace.studies.edof.world import World, best_gamma, errors_of_pictures, kernels, power, transfer
from raytrace.studies.pictures import draws
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element

_STEPS_OF_SMOOTH = 60
_DRAWS = 2000  # of the pictures
_BOOTSTRAP = 25  # last number of the key of a draw


@dataclasses.dataclass(frozen=True)
class Unit:
    """One element to be learned: a row of the table, for one noise, from one random start."""

    row: str
    noise: float
    start: int

    def settings(self, steps: int) -> Settings:
        learning = ROWS[self.row].learning
        # What has seven numbers is found by the search for its start.
        steps = min(steps, _STEPS_OF_SMOOTH) if learning["kind"] == "smooth" else steps
        more = {"seed": self.start, "starts": 1, "steps": steps, "noise": (self.noise, self.noise)}
        return Settings.of({}, **learning, **more)

    def world(self) -> World:
        return dataclasses.replace(World(), noise=self.noise)

    def folder(self, root: Path) -> Path:
        return root / f"noise-{self.noise:g}" / self.row / f"start-{self.start}"


def units(rows: Sequence[str], noises: Sequence[float], starts: int) -> Iterator[Unit]:
    """All that is learned; every noise and row once before any of them a second time."""
    learned = [row for row in rows if ROWS[row].learning]
    return (Unit(row, noise, start) for start in range(starts) for noise in noises for row in learned)


# --- what an element is worth on many pictures


def mark_of(*values: Tensor) -> str:
    """A hash of all their numbers."""
    found = hashlib.blake2b(digest_size=8)
    for own in values:
        found.update(f"{tuple(own.shape)}".encode())
        found.update(own.detach().contiguous().numpy())
    return found.hexdigest()


def mark_of_elements(elements: Sequence[Element]) -> str:
    """A hash of all that decides what they do to light: numbers, kind and size of the profile, the glass."""
    found = hashlib.blake2b(digest_size=8)
    for element in elements:
        profile, glass, period = element.profile, element.glass, element.period
        numbers = [getattr(profile, field.name) for field in dataclasses.fields(profile)]
        numbers += [element.radius, glass.coefficients, *([] if period is None else [period])]
        found.update(f"{type(profile).__name__} {element.levels} {glass.formula} {mark_of(*numbers)}".encode())
    return found.hexdigest()


@dataclasses.dataclass(frozen=True)
class Bank:
    """A content's pictures: S (n, n) of those that filters are made for, P (B, n, n) the power of each restored one.

    classes: of each restored one; by default each is a class of its own.
    """

    name: str
    spectrum: Tensor
    powers: Tensor
    classes: tuple[str, ...] = ()

    @property
    def mark(self) -> str:
        """What it is known by: of filters' pictures and of restored ones."""
        return mark_of(self.spectrum, self.powers)

    @classmethod
    def of(cls, name: str, train: Tensor, test: Tensor, classes: Sequence[str] = ()) -> "Bank":
        """Periodic pictures (A, n, n) to make filters for, (B, n, n) to restore, and the classes of the latter."""
        powers = [power(picture) for picture in test]
        return cls(name, sum(map(power, train)) / len(train), torch.stack(powers), tuple(classes))

    @property
    def class_count(self) -> int:
        return len(set(self.classes)) or len(self.powers)

    def drawn(self, *, seed: int = 0) -> Tensor:
        """`drawn` of the restored pictures."""
        return drawn(self.classes or range(len(self.powers)), seed=seed)


#: Errors (B, D, W) of every picture, by filter.
Errors = dict[str, Tensor]


@torch.no_grad()
def errors_of(H: Tensor, world: World, bank: Bank) -> Errors:
    """Of each picture at every depth in every colour, expected over noise, of transfer functions H (D, W, n, n)."""
    at_design = H[world.depths.index(world.design)]
    gamma = best_gamma(H, bank.spectrum, world.noise, at_design)
    filters = {"wiener": wiener(at_design, gamma), "blind": depth_invariant_wiener(H, bank.spectrum, world.noise)}
    return {name: errors_of_pictures(H, G, world.noise, bank.powers) for name, G in filters.items()}


def pooled_psnr(errors: Tensor, weights: Tensor | None = None) -> Tensor:
    """PSNR (R,) in dB of the mean error over pictures and colours, mean over depths; errors: (B, D, W).

    weights: (R, B) of the pictures, by default once each.
    """
    return psnr(_shares(errors, weights) @ errors.mean(-1)).mean(-1)


def mean_psnr(errors: Tensor, weights: Tensor | None = None) -> Tensor:
    """PSNR (R,) in dB of each picture at each depth, mean over pictures and depths; arguments: of `pooled_psnr`."""
    return (_shares(errors, weights) @ psnr(errors.mean(-1))).mean(-1)


def _shares(errors: Tensor, weights: Tensor | None) -> Tensor:
    weights = errors.new_ones(1, len(errors)) if weights is None else weights
    return weights / weights.sum(1, keepdim=True)


def drawn(classes: Sequence, *, draws_of: int = _DRAWS, seed: int = 0) -> Tensor:
    """How often (R, B) each picture occurs in samples of as many classes, drawn with replacement.

    classes: (B,) of each picture.
    """
    order = sorted(set(classes))
    count, place = len(order), [order.index(own) for own in classes]
    random = draws(seed, count, _BOOTSTRAP)
    times = random.multinomial(count, np.full(count, 1 / count), draws_of).astype(np.float64)
    return torch.as_tensor(times)[:, place]


@dataclasses.dataclass(frozen=True)
class Interval:
    """A number, and where it lies in 95 of 100 samples of classes of pictures."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:+.2f} ({self.low:+.2f} … {self.high:+.2f})"

    def record(self, name: str) -> dict[str, float]:
        """Columns NAME, NAME_low, NAME_high."""
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


def gain(
    errors: Tensor, base: Tensor, weights: Tensor, *, mean: Callable[[Tensor, Tensor | None], Tensor] = pooled_psnr
) -> Interval:
    """PSNR of errors (B, D, W) over that of others, of the same pictures; mean: over pictures, by which of the two."""
    between = (mean(errors, weights) - mean(base, weights)).quantile(weights.new_tensor([0.025, 0.975]))
    return Interval(float(mean(errors, None) - mean(base, None)), *between.tolist())


@dataclasses.dataclass(frozen=True)
class Gains:
    """PSNR in dB of an element and its gain over another: of errors pooled over pictures, and as the mean of the PSNRs
    of single pictures."""

    pooled_psnr: float
    pooled: Interval
    mean_psnr: float
    mean: Interval

    @classmethod
    def of(cls, errors: Tensor, base: Tensor, weights: Tensor) -> "Gains":
        """Of errors (B, D, W) and those of the other element of the same pictures; weights: of `drawn`."""
        both = ((float(mean(errors)), gain(errors, base, weights, mean=mean)) for mean in (pooled_psnr, mean_psnr))
        return cls(*(one for pair in both for one in pair))


# --- baselines


def cases(
    rows: Sequence[str], noises: Sequence[float], strengths: Mapping[float, float]
) -> Iterator[tuple[str, tuple[Element, ...], list[float]]]:
    """Baselines of the rows, and the noises that each is for; strengths: of cubic plates, by noise."""
    world = World()
    made_for = aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design, exact=world.exact)
    for row in rows:
        if ROWS[row].learning:
            continue
        if not row.startswith("cubic"):
            yield row, baseline(row, made_for), list(noises)
            continue
        for strength in sorted(set(strengths.values())):
            own = [noise for noise in noises if strengths[noise] == strength]
            yield row, baseline(row, made_for, strength=strength), own


@torch.no_grad()
def best_strengths(noises: Sequence[float], S: Tensor) -> dict[float, float]:
    """The strength of cubic plates on the PMMA lens that is best for pictures of spectrum S (n, n), by noise."""
    world = World()
    made_for = aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design, exact=world.exact)
    found = {}
    for strength in STRENGTHS:
        H = transfer(kernels(baseline("cubic-refractive", made_for, strength=strength), world), S.shape[-1])
        found[strength] = {noise: float(depth_invariant_error(H, S, noise).mean()) for noise in noises}
    return {noise: min(STRENGTHS, key=lambda own: found[own][noise]) for noise in noises}
