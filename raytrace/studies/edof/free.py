"""Free heights: a map of pixels learned for extended depth of field, symmetry not assumed.

At a round start the slope of every change without symmetry is 0, so that each start has a small random change; and from
some no symmetry was there. A control learns the same rings on, for as many steps: what is more than that is what giving
up symmetry brings.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from raytrace.files import write_atomically
from raytrace.imaging.training import Record, Run, Share, load_state, read_state, train
from raytrace.imaging.variables import PhaseVariables
from raytrace.maths.value import detached
from raytrace.studies.edof.noise import best_strengths, mark_of_elements
from raytrace.studies.edof.training import scheduled
from raytrace.studies.edof.world import ClosedForm, World, expected_error, scene, transfer
from raytrace.studies.pictures import draws
from raytrace.wave_optics.coarse import Coarse
from raytrace.wave_optics.designs import Aim, aim, baseline
from raytrace.wave_optics.element import Element, Pixels, Zernike, as_pixels, excess_index, features, path

_CHANGE, _SMOOTH = 33, 34  # last numbers of the keys of random starts
TERMS, SPREAD = 36, 0.5  # Noll's polynomials, piston and tilts left out, of a random start; µm RMS of each
WHITE = 0.02  # µm, of every pixel's random change
_NODES = 3  # per pixel of the sensor while learning; 4 to be judged


class PixelForm:
    """`world.ClosedForm` of one map of pixels, by coarse cells; in single precision to be learned."""

    def __init__(self, first: Sequence[Element], world: World, S: Tensor, *, dtype: torch.dtype = torch.float64):
        self.world, self.S = world, S
        nodes = _NODES if dtype == torch.float32 else _NODES + 1
        self._coarse = Coarse(scene(first, world), nodes, dtype=dtype)

    def __call__(self, elements: tuple[Element, ...]) -> Tensor:
        return expected_error(self.transfer(elements), self.S, self.world.noise)

    def kernels(self, elements: tuple[Element, ...]) -> Tensor:
        """Light in the pixels of the sensor (D, W, rows, columns)."""
        return self._coarse.kernels(scene(elements, self.world))

    def transfer(self, elements: tuple[Element, ...]) -> Tensor:
        """H (D, W, n, n)."""
        return transfer(self._coarse.psf(scene(elements, self.world)), self.S.shape[-1])


# --- starts


def as_map(elements: tuple[Element, ...], like: Element, pitch: float, wavelength: Tensor) -> Element:
    """One map of pixels of the material of `like` with the path of elements in contact at a wavelength (µm)."""
    size, step = features(2 * like.radius, like.radius.new_tensor(pitch)), like.radius.new_tensor(pitch)
    x = (torch.arange(size).to(step) - 0.5 * (size - 1)) * step
    together = path(elements, x.expand(size, -1), x[:, None].expand(-1, size), wavelength.reshape(1))[0]
    heights = together / excess_index(like, wavelength.reshape(1), step)
    return dataclasses.replace(like, profile=Pixels(heights, step), period=None, levels=0)


def _of_rings(rings: Element, pitch: float, made_for: Aim, noise: float, seed: int, S: Tensor) -> Element:
    return as_pixels(rings, pitch)


def _cubic(rings: Element, pitch: float, made_for: Aim, noise: float, seed: int, S: Tensor) -> Element:
    strength = best_strengths([noise], S)[noise]
    plate = baseline("cubic-refractive", made_for, strength=strength)
    return as_map(plate, rings, pitch, made_for.wavelength)


def _random(rings: Element, pitch: float, made_for: Aim, noise: float, seed: int, S: Tensor) -> Element:
    random = 1e-3 * SPREAD * torch.as_tensor(draws(seed, _SMOOTH).standard_normal(TERMS)).to(rings.radius)
    random[:3] = 0
    plate = Element(Zernike(random), rings.radius, rings.glass)
    return as_map((*baseline("singlet", made_for), plate), rings, pitch, made_for.wavelength)


#: Where a map begins, before its random change: name -> title, maker.
STARTS: dict[str, tuple[str, Callable[..., Element]]] = {
    "rings": ("from the learned rings", _of_rings),
    "cubic": ("from a cubic plate on a lens", _cubic),
    "random": ("from random polynomials on a lens", _random),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """What is learned: a map from one of STARTS, or "control", the rings themselves. pitch: mm; rate: µm a step."""

    start: str
    noise: float
    pitch: float
    steps: int
    rate: float
    seed: int = 0

    def folder(self, root: Path) -> Path:
        return root / f"noise-{self.noise:g}" / f"free-{self.start}"

    def world(self) -> World:
        return dataclasses.replace(World(), noise=self.noise)


class FreeCamera(nn.Module):
    """Heights, single precision in what was changed, and the error that they are expected to leave.

    form: `ClosedForm` of rings, `PixelForm` of pixels, made where it is asked for.
    """

    def __init__(self, element: Element, form: type[ClosedForm] | type[PixelForm], world: World, S: Tensor):
        super().__init__()
        self.variables = PhaseVariables(element).float()
        self._make = functools.cache(lambda: form((element,), world, S, dtype=torch.float32))

    def forward(self) -> Tensor:
        return self._make()(self.variables())

    @torch.no_grad()
    def element(self) -> Element:
        return detached(self.variables()[0])


def _start(case: Case, rings: Element, S: Tensor, folder: Path) -> Element:
    """Where a case begins; found once and kept in its folder."""
    if case.start == "control":
        return rings
    kept = folder / "start.pt"
    if not kept.exists():
        world = case.world()
        made_for = aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design, exact=world.exact)
        found = STARTS[case.start][1](rings, case.pitch, made_for, case.noise, case.seed, S)
        write_atomically(kept, lambda file: torch.save({"heights": found.numbers}, file))
    heights = read_state(kept)["heights"]
    return dataclasses.replace(rings, profile=Pixels(heights, heights.new_tensor(case.pitch)))


def camera_of(case: Case, rings: Element, S: Tensor, folder: Path) -> FreeCamera:
    """The camera of a case as it begins; S (n, n): spectrum of the pictures."""
    element = _start(case, rings, S, folder)
    camera = FreeCamera(element, (ClosedForm if case.start == "control" else PixelForm), case.world(), S)
    if case.start != "control":
        change = WHITE * draws(case.seed, _CHANGE).standard_normal(tuple(element.numbers.shape))
        with torch.no_grad():
            camera.variables.change.copy_(torch.as_tensor(change))
    return camera


def learn_free(
    case: Case,
    rings: Element,
    S: Tensor,
    root: Path,
    *,
    bar: Callable[[Iterator, int], Iterable] = lambda steps, first: steps,
    every: int = 20,
) -> Element:
    """The element of a case, from its folder, learned as far as is left by Adam, whose rate falls as a cosine."""
    run = Run(case.folder(root), dataclasses.asdict(case) | {"rings": mark_of_elements([rings])})
    camera, state = camera_of(case, rings, S, run.folder), run.load()
    if state is not None and state["step"] >= case.steps:
        load_state(camera, state, run.checkpoint)
        return camera.element()
    optimizer = torch.optim.Adam(camera.parameters(), lr=case.rate)

    def loss(step: int, share: Share) -> tuple[Tensor, Record]:
        for group in optimizer.param_groups:
            group["lr"] = case.rate * scheduled("cosine", step / case.steps)
        return camera() / share.processes, {"rate": optimizer.param_groups[0]["lr"]}

    for _ in bar(
        train(camera, optimizer, loss, steps=case.steps, run=run, every=every), 0 if state is None else state["step"]
    ):
        pass
    return camera.element()


@torch.no_grad()
def departure(element: Element) -> float:
    """nm RMS of heights without their mean over each ring as wide as a pixel, inside the aperture."""
    heights, pitch = element.numbers, element.profile.pitch
    if heights.dim() == 1:
        return 0.0
    x, y = ((torch.arange(n) + 0.5 - 0.5 * n) * pitch for n in heights.shape[::-1])
    ring = (torch.hypot(x, y[:, None]) / pitch).long()
    inside = ring < element.radius / pitch
    ring, heights = ring[inside], heights[inside].double()
    count = torch.bincount(ring).clamp(min=1)
    mean = torch.bincount(ring, weights=heights) / count
    return 1e6 * float((heights - mean[ring]).square().mean().sqrt())
