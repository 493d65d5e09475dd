"""An element one can make: rings learned under the process that etches them, for extended depth of field.

An element learned in whole heights is the model: the depths nearest to its phases in all colours are the start
(`wave_optics.etching`), and what the process does is in the loop: heights modulo its relief, errors of height drawn
anew at
every step. Steps of height are no gradient's matter: after the nearest level a few rings at a time move by one level
where the gradient says that the error falls, and stay where it does.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.imaging.variables import PhaseVariables
from raytrace.maths.value import detached
from raytrace.studies.edof.noise import Unit
from raytrace.studies.edof.training import adam
from raytrace.studies.edof.world import ClosedForm
from raytrace.studies.pictures import draws
from raytrace.wave_optics.element import Element, fabricated, with_tolerance
from raytrace.wave_optics.etching import Process, matched

_DRAW, _MOVE = 26, 27  # last numbers of the keys of errors of height, of rings that may move
_FIRST, _MOST = 0.05, 0.2  # of the rings: how many move at once


@dataclasses.dataclass(frozen=True)
class Case:
    """One element to be learned: waves and levels of its process, the noise, the start it is modelled on."""

    waves: int
    levels: int
    noise: float
    start: int

    @property
    def row(self) -> str:
        return f"etched-{self.waves}-{self.levels}"

    @property
    def model(self) -> Unit:
        return Unit("learned", self.noise, self.start)

    def folder(self, root: Path) -> Path:
        return root / f"noise-{self.noise:g}" / self.row / f"start-{self.start}"


def cases(waves: Sequence[int], levels: Sequence[int], noises: Sequence[float], starts: int) -> Iterator[Case]:
    """Every process once before any of them a second time."""
    return (
        Case(m, count, noise, start) for start in range(starts) for noise in noises for m in waves for count in levels
    )


def etch_rings(
    model: Element,
    process: Process,
    expected: ClosedForm,
    *,
    steps: int = 300,
    moves: int = 300,
    rate: float = 0.04,
    seed: int = 0,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Element:
    """Rings as the process makes them, learned: `steps` with any depth, then `moves` between levels; depths in mm."""
    wavelengths = model.radius.new_tensor(expected.world.wavelengths)
    start, _ = matched(model, dataclasses.replace(process, levels=0), wavelengths)
    continuous = fabricated(
        learn_depths(start, process, expected, steps=steps, rate=rate, seed=seed, progress=progress)
    )
    if not process.levels:
        return continuous
    step = process.period(model) / process.levels
    numbers = torch.round(continuous.numbers / step).long() % process.levels
    found = move_levels(continuous, numbers, process, expected, moves=moves, seed=seed, progress=progress)
    return continuous.with_numbers(found * step)


def learn_depths(
    start: Element,
    process: Process,
    expected: ClosedForm,
    *,
    steps: int,
    rate: float,
    seed: int = 0,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Element:
    """Adam from a wrapped element, with errors of height; rate: µm a step, falling to 0 as a cosine."""
    variables = PhaseVariables(start, tolerance=process.tolerance)

    def error(step: int) -> Tensor:
        return expected(variables(draw=_generator(seed, step)))

    for _ in adam(variables.parameters(), error, steps=steps, rate=rate, progress=progress):
        pass
    return detached(variables()[0])


def move_levels(
    like: Element,
    numbers: Tensor,
    process: Process,
    expected: ClosedForm,
    *,
    moves: int,
    seed: int = 0,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Tensor:
    """Levels (R,) from 0 to L - 1, after so many trials: of half of the rings, drawn, those of the steepest error move
    by one level down its slope; kept where the error falls, for the same errors of height."""
    step, share = process.period(like) / process.levels, _FIRST
    for trial in progress(range(moves)):
        off = process.tolerance * (
            2 * torch.rand(len(numbers), generator=_generator(seed, trial, _MOVE), dtype=torch.float64) - 1
        )
        free = (numbers * step + off).requires_grad_()
        before = expected((like.with_numbers(free),))
        slope = torch.autograd.grad(before, free)[0]
        eligible = torch.as_tensor(draws(seed, trial, _MOVE).random(len(numbers)) < 0.5)
        chosen = (slope.abs() * eligible).topk(max(1, round(share * len(numbers)))).indices
        moved = numbers.clone()
        moved[chosen] = (moved[chosen] - slope[chosen].sign().long()) % process.levels
        with torch.no_grad():
            falls = bool(expected((like.with_numbers(moved * step + off),)) < before)
        numbers = moved if falls else numbers
        share = min(_MOST, 1.3 * share) if falls else max(1 / len(numbers), 0.7 * share)
    return numbers


def _generator(*key: int) -> torch.Generator:
    return torch.Generator().manual_seed(int(draws(*key, _DRAW).integers(2**62)))


@torch.no_grad()
def under_errors(element: Element, expected: ClosedForm, tolerance: float, *, count: int = 10) -> tuple[float, ...]:
    """Expected error of an element whose heights err by up to ± tolerance mm, for each draw."""
    return tuple(
        float(expected((with_tolerance(element, tolerance, generator=_generator(number)),))) for number in range(count)
    )
