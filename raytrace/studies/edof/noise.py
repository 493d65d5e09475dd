"""Extended depth of field over noise: elements learned and filters made anew for each, judged on many pictures.

    e = ⟨P |1 - G H|²⟩ + σ² ⟨|G|²⟩       P: the power of one picture; ⟨·⟩ over frequencies: the mean over noise, undrawn

Every picture has its own error, so that pictures drawn with replacement (bootstrap; Efron and Tibshirani, 1993) say how
far a mean over them is to be trusted. Gains are paired: both elements on the same pictures.
"""

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace.camera.deconvolve import blind_error, blind_filter, psnr, wiener
from raytrace.studies.edof.settings import Settings
from raytrace.studies.edof.table import ROWS, STRENGTHS
from raytrace.studies.edof.world import World, best_gamma, kernels, transfer
from raytrace.studies.pictures import draws
from raytrace.wave.designs import aim, baseline
from raytrace.wave.element import Element

FILTERS = ("wiener", "blind")
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
    """A content's pictures: S (n, n) of those that filters are made for, P (B, n, n) the power of each restored one."""

    name: str
    spectrum: Tensor
    powers: Tensor

    @property
    def mark(self) -> str:
        """What it is known by: of filters' pictures and of restored ones."""
        return mark_of(self.spectrum, self.powers)

    @classmethod
    def of(cls, name: str, train: Tensor, test: Tensor) -> "Bank":
        """Periodic pictures (A, n, n) to make filters for, (B, n, n) to restore."""
        powers = [_power(picture) for picture in test]
        return cls(name, sum(map(_power, train)) / len(train), torch.stack(powers))


def _power(picture: Tensor) -> Tensor:
    transformed = torch.fft.fft2(picture)
    return (transformed.real**2 + transformed.imag**2) / picture.numel()


#: Errors (B, D, W) of every picture, by filter.
Errors = dict[str, Tensor]


@torch.no_grad()
def errors_of(H: Tensor, world: World, bank: Bank) -> Errors:
    """Of each picture at every depth in every colour, expected over noise, of transfer functions H (D, W, n, n)."""
    at_design = H[world.depths.index(world.design)]
    gamma = best_gamma(H, bank.spectrum, world.noise, at_design)
    filters = {"wiener": wiener(at_design, gamma), "blind": blind_filter(H, bank.spectrum, world.noise)}
    return {name: _errors(H, G, world.noise, bank.powers) for name, G in filters.items()}


def _errors(H: Tensor, G: Tensor, noise: float, powers: Tensor) -> Tensor:
    left = torch.view_as_real(1 - G * H).square().sum(-1).flatten(2)  # (D, W, n²)
    added = noise**2 * torch.view_as_real(G).square().sum(-1).mean((-2, -1))
    return (left @ powers.flatten(1).T / left.shape[-1]).movedim(-1, 0) + added


def mean_psnr(errors: Tensor, weights: Tensor | None = None) -> Tensor:
    """PSNR (R,) in dB, mean over depths, of errors (B, D, W) over pictures and colours.

    weights: (R, B) of the pictures, by default once each.
    """
    if weights is None:
        weights = errors.new_ones(1, len(errors))
    own = weights / weights.sum(1, keepdim=True) @ errors.mean(-1)
    return psnr(own).mean(-1)


def drawn(count: int, *, draws_of: int = _DRAWS, seed: int = 0) -> Tensor:
    """How often (R, B) each of `count` pictures stands in samples as large, drawn with replacement."""
    random = draws(seed, count, _BOOTSTRAP)
    return torch.as_tensor(random.multinomial(count, np.full(count, 1 / count), draws_of).astype(np.float64))


@dataclasses.dataclass(frozen=True)
class Interval:
    """A number, and where it lies in 95 of 100 samples of pictures."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:+.2f} ({self.low:+.2f} … {self.high:+.2f})"


def gain(errors: Tensor, base: Tensor, weights: Tensor) -> Interval:
    """Mean PSNR of errors (B, D, W) over that of others, of the same pictures."""
    between = (mean_psnr(errors, weights) - mean_psnr(base, weights)).quantile(weights.new_tensor([0.025, 0.975]))
    return Interval(float(mean_psnr(errors) - mean_psnr(base)), *between.tolist())


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
        found[strength] = {noise: float(blind_error(H, S, noise).mean()) for noise in noises}
    return {noise: min(STRENGTHS, key=lambda own: found[own][noise]) for noise in noises}
