"""What fabrication costs a phase element: steps of height, wrapping to one wave, and errors of height.

    efficiency   |⟨exp(ik W)⟩|² over the area of the aperture: light at the focus of a lens, over that of the ideal one;
                 a kinoform of L levels keeps sinc²(1/L) (Goodman and Silvestri, IBM J. Res. Dev. 14, 478, 1970)
    error        of an element of extended depth of field behind the best blind filter (`edof`), as PSNR in dB

An element learned in whole heights is wrapped and stepped afterwards, or learned on with wraps, or wraps and steps, in
the loop: gradients pass them as if they were not there (straight-through).
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.imaging.restoration import depth_invariant_wiener, errors, psnr
from raytrace.imaging.training import DamagedRun, load_state, read_json
from raytrace.imaging.variables import PhaseVariables
from raytrace.maths.value import detached
from raytrace.studies import options
from raytrace.studies.edof.settings import Settings
from raytrace.studies.edof.training import adam, begin
from raytrace.studies.edof.world import WAVELENGTH, ClosedForm, World, expected_error, scene, spectrum, transfer
from raytrace.studies.edof.world import kernels as kernels_of
from raytrace.studies.pictures import draws
from raytrace.wave_optics.element import Element, Pixels, Rings, period, with_tolerance, wrapped
from raytrace.wave_optics.scene import residual

_POINTS = 400_000  # over the aperture, of equal area
_DRAW = 24  # last number of the key of a draw of errors


# --- efficiency


def law(levels: int) -> float:
    """sinc²(1/L); 1 of any height (0)."""
    if not levels:
        return 1.0
    return (math.sin(math.pi / levels) / (math.pi / levels)) ** 2


@torch.no_grad()
def efficiency(element: Element, world: World, *, points: int = _POINTS) -> float:
    """Light at the sensor's centre over that of an ideal lens, of a point at the design depth, at 0.55 µm."""
    there = dataclasses.replace(world, wavelengths=(WAVELENGTH,))
    found = scene((element,), there, depths=[world.design])
    place = (torch.arange(points, dtype=element.radius.dtype) + 0.5) / points
    r = element.radius * torch.sqrt(place)
    x, y = r, torch.zeros_like(r)
    if isinstance(element.profile, Pixels):  # all round, by the golden angle
        turn = math.pi * (3 - math.sqrt(5)) * (place * points - 0.5)
        x, y = r * torch.cos(turn), r * torch.sin(turn)
    phase = 2 * math.pi / (1e-3 * WAVELENGTH) * residual(found, x, y)[0, 0]
    return float(torch.cos(phase).mean() ** 2 + torch.sin(phase).mean() ** 2)


# --- elements as they are made


def whole(element: Element) -> Element:
    """The element before it is wrapped or stepped."""
    return dataclasses.replace(element, period=None, levels=0)


def made(element: Element, levels: int, *, wrap: bool) -> Element:
    """Rings or pixels as they are made: in `levels` steps of a period (0: any height), modulo the period or not."""
    element = whole(element)
    if wrap:
        return wrapped(element, WAVELENGTH, levels=levels)
    if not levels:
        return element
    step = period(element.glass, WAVELENGTH).to(element.radius) / levels
    return element.with_numbers(torch.floor((element.numbers / step).detach() + 1e-4) * step)


class Judge:
    """Errors of elements in one world, for pictures of spectrum S (n, n): what the heights of rings do not change is
    kept; maps of pixels are computed depth by depth, for memory.
    """

    def __init__(self, world: World, S: Tensor):
        self.world, self.S, self._expected = world, S, None

    def error(self, element: Element) -> Tensor:
        """Mean square error of the best blind filter in closed form, mean over colours; differentiable."""
        if isinstance(element.profile, Pixels):
            return expected_error(self.transfer(element), self.S, self.world.noise)
        return self._of_rings(element)((element,))

    def transfer(self, element: Element) -> Tensor:
        """H (D, W, n, n)."""
        if isinstance(element.profile, Pixels):
            return transfer(kernels_of((element,), self.world), self.S.shape[-1])
        return self._of_rings(element).transfer((element,))

    def _of_rings(self, element: Element) -> ClosedForm:
        # The sums of rings depend on their heights no more than the plan should: one for all.
        self._expected = self._expected or ClosedForm((whole(element),), self.world, self.S)
        return self._expected

    @torch.no_grad()
    def closed(self, element: Element) -> float:
        """The same as PSNR, dB."""
        return float(psnr(self.error(element)))

    @torch.no_grad()
    def restored(self, element: Element, test: Tensor) -> float:
        """PSNR of test pictures (B, n, n) behind a filter made for S, dB: mean over depths, expected over noise."""
        H = self.transfer(element)
        G = depth_invariant_wiener(H, self.S, self.world.noise)
        left = errors(H, spectrum(test), self.world.noise, filter=G)  # (D, W)
        return float(psnr(left.mean(1)).mean())


def learn_on(
    element: Element,
    judge: Judge,
    *,
    steps: int = 30,
    rate: float = 0.02,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Element:
    """The best that Adam meets from an element as it is made, steps and wraps in the loop; never worse than it was.

    rate: µm a step, falling to 0 as a cosine.
    """
    variables = PhaseVariables(element)
    best, least = element, math.inf

    def error(step: int = 0) -> Tensor:
        return judge.error(variables()[0])

    course = adam(variables.parameters(), error, steps=steps, rate=rate, progress=progress)
    for found in itertools.chain(course, _after(error)):
        if found < least:
            best, least = element.with_numbers(variables.numbers().detach().clone()), found
    return best


def _after(error: Callable[[], Tensor]) -> Iterator[float]:
    """The error when its turn comes: of what the last step has left."""
    with torch.no_grad():
        yield float(error())


# --- the learned element


def read(folder: str | Path, S: Tensor) -> tuple[Element, World]:
    """The element of a run's last checkpoint as it was learned, and its world.

    S: of whatever pictures, it was learned from its own. Raises ValueError for a folder without a run that was learned
    on, and for an element that is not in rings.
    """
    written = Path(folder) / "settings.json"
    if not written.exists():
        raise ValueError(f"{folder}: no settings.json; expected the folder of a run of `raytrace wave edof`")
    given = read_json(written)
    try:
        world, pictures = options.read(World, given.pop("world")), given.pop("pictures")
        settings = options.read(Settings, given)
    except (KeyError, TypeError, AttributeError) as error:
        raise DamagedRun(f"{written}: no settings of `raytrace wave edof` ({error})") from error
    # Before the run is begun here: a start that it does not have yet would be sought, and kept, by other pictures.
    missing = [name for name in ("start.pt", "checkpoint.pt") if not (Path(folder) / name).exists()]
    if missing:
        raise ValueError(f"{folder}: no {missing[0]}; let `raytrace wave edof` finish")
    camera, run = begin(settings, world, S, folder, pictures=pictures)
    load_state(camera, run.load(), run.checkpoint)
    element = detached(camera.variables()[0])
    if not isinstance(element.profile, Rings):
        kind = type(element.profile).__name__
        raise ValueError(f"{folder}: heights are {kind}; expected Rings: learn with --element rings")
    return element, world


# --- what it costs

#: How an element may be made, and what it is called.
WAYS = {
    "whole": "full height, quantised afterwards",
    "wrapped": "wrapped and quantised afterwards",
    "looped": "learned wrapped, quantised afterwards",
    "trained": "learned wrapped and quantised",
}


@dataclasses.dataclass(frozen=True)
class Steps:
    """PSNR in dB of an element in so many levels (0: any height).

    closed: in closed form; restored: of test pictures; efficiency: at the design depth, at 0.55 µm. made: of WAYS.
    """

    element: str
    made: str
    levels: int
    closed: float
    restored: float
    efficiency: float


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """PSNR in dB, closed form, of an element whose heights err by up to ± nm: mean, least and greatest of draws."""

    element: str
    made: str
    levels: int
    nm: float
    mean: float
    least: float
    greatest: float


def steps_of(
    name: str,
    element: Element,
    judge: Judge,
    test: Tensor,
    *,
    levels: Sequence[int],
    ways: Sequence[str],
    steps: int = 20,
    progress: Callable[[Iterable], Iterable] = iter,
) -> tuple[list[Steps], dict[tuple[str, int], Element]]:
    """A row for any height and every number of levels, by every way of making; and what was made, by (way, levels).

    steps: of learning on quantised, after 4 times as many for the wraps; as many for what is quantised afterwards.
    """
    begun = {}
    if {"looped", "trained"} & set(ways):
        begun["trained"] = learn_on(made(element, 0, wrap=True), judge, steps=4 * steps, progress=progress)
        begun["looped"] = learn_on(begun["trained"], judge, steps=steps)
    rows, elements = [], {}
    for way, count in progress([(way, count) for way in ways for count in (0, *levels)]):
        own = made(begun.get(way, element), count, wrap=way != "whole")
        if way == "trained":
            own = learn_on(own, judge, steps=steps)
        shown = judge.restored(own, test)
        rows.append(Steps(name, way, count, judge.closed(own), shown, efficiency(own, judge.world)))
        elements[way, count] = own
    return rows, elements


@torch.no_grad()
def tolerances_of(
    name: str, way: str, element: Element, judge: Judge, *, nm: Sequence[float], count: int = 5, seed: int = 0
) -> list[Tolerance]:
    """A row for every tolerance, `count` draws each; the same errors, larger, at each."""
    rows = []
    for most in nm:
        found = []
        for number in range(count):
            key = int(draws(seed, number, _DRAW).integers(2**62))
            off = with_tolerance(element, 1e-6 * most, generator=torch.Generator().manual_seed(key))
            found.append(judge.closed(off))
        mean = sum(found) / len(found)
        rows.append(Tolerance(name, way, element.levels, most, mean, min(found), max(found)))
    return rows
