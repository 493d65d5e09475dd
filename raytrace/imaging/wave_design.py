"""Learning a phase element for extended depth of field: by the closed form, or by pictures and a filter in the loop.

    closed form   e = ⟨S (S var H + σ²)/(S ⟨|H|²⟩ + σ²)⟩ over frequencies and colours: no pictures, no noise drawn
    pictures      mean (x̂ - x)² of pictures at drawn depths with drawn noise, behind a filter that is learned with them

The filter is the best blind one for the kernels as they are, or that of Sitzmann et al. (ACM Trans. Graph. 37, 2018):
towards the measurement, for the kernel at a depth that is learned, with a weight that is learned. Or a network restores
what the blind filter leaves. Steps, logs and checkpoints are those of `training`.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from raytrace.files import write_atomically
from raytrace.imaging.network import RedNet, RedNetShape
from raytrace.imaging.pictures import Pictures, crop, draws
from raytrace.imaging.restoration import depth_invariant_wiener, towards_measurement
from raytrace.imaging.training import DamagedRun, Record, Run, Share, read_state, train
from raytrace.imaging.variables import PhaseVariables
from raytrace.imaging.wave_camera import (
    ClosedForm,
    WaveCameraConfig,
    best_of_starts,
    mirrored,
    restored,
    scene,
    transfer,
)
from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import index
from raytrace.maths.value import detached
from raytrace.settings import DesignSettings
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import aim, converging
from raytrace.wave_optics.element import Element, EvenPowers, Rings, Zernike
from raytrace.wave_optics.fabrication import Process, as_rings, matched

_NETWORK = RedNetShape(6, 16)  # behind the blind filter, the same for every colour
_NETWORK_RATE = 1e-3
_SAMPLE, _START = 20, 21  # last numbers of the keys of what is drawn


class WaveCamera(nn.Module):
    """A learned element, a world and a filter.

    spectrum: S (n, n) of the pictures. v, t: square roots of the weight γ and of the design depth in m of the filter
    "towards" the measurement, learned with it. network: (B, 1, n, n) -> the same, any module, behind the blind filter.
    """

    def __init__(
        self,
        variables: PhaseVariables,
        world: WaveCameraConfig,
        spectrum: Tensor,
        *,
        restoration: str = "blind",
        network: nn.Module | None = None,
    ):
        super().__init__()
        self.network = network
        self.variables, self.world, self.restoration = variables, world, restoration
        self.register_buffer("spectrum", spectrum, persistent=False)
        if restoration == "towards":
            like = variables.change
            self.v = nn.Parameter(like.new_tensor(0.1))
            self.t = nn.Parameter(like.new_tensor(math.sqrt(1e-3 * world.design)))
        # Rings are learned in single precision: their sums take most of the time, and Adam needs no more.
        dtype = torch.float32 if isinstance(variables.element.profile, Rings) else torch.float64
        self.expected = ClosedForm(variables(), world, spectrum, dtype=dtype)

    def transfer(self, *, draw: torch.Generator | None = None) -> Tensor:
        """H (D, W, n, n) of the world's depths, of an element as it may come out of fabrication."""
        return self.expected.transfer(self.variables(draw=draw))

    def filter(self, H: Tensor) -> Tensor:
        """G (W, n, n)."""
        if self.restoration != "towards":
            return depth_invariant_wiener(H, self.spectrum, self.world.noise)
        at_target = dataclasses.replace(scene(self.variables(), self.world), depths=1e3 * self.t.square().reshape(1))
        found = psf(at_target, plan=self.expected.plan)
        return towards_measurement(transfer(found, self.spectrum.shape[-1])[0], self.v.square())

    def forward(self, pictures: Tensor, depth: Tensor, noise: Tensor, *, draw: torch.Generator | None = None) -> Tensor:
        """Restored colours (B, W, n, n) of pictures (B, n, n) at depths of these numbers (B,); noise: added."""
        H = self.transfer(draw=draw)
        estimate = restored(H[depth], self.filter(H), pictures, noise)[1]
        if self.network is None:
            return estimate
        single = next(self.network.parameters()).dtype
        return (
            self.network(estimate.flatten(0, 1)[:, None].to(single))[:, 0].to(estimate).unflatten(0, estimate.shape[:2])
        )


def start(
    settings: DesignSettings,
    world: WaveCameraConfig,
    spectrum: Tensor,
    *,
    progress: Callable[[Iterable], Iterable] = iter,
) -> PhaseVariables:
    """Where learning begins: a lens for the design depth, or the best smooth element of several random starts; of rings
    in steps, those nearest to it in phase."""
    if settings.tolerance and settings.kind != "rings":
        raise ValueError(f"a tolerance of {settings.tolerance:g} mm belongs to rings; {settings.kind!r} has none")
    glass = find_glass(settings.glass)
    made_for = aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design, exact=world.exact)
    path = converging(made_for) / (index(glass, made_for.wavelength) - 1)
    if settings.kind == "zernike":
        return _zernike(settings, Element(EvenPowers(path), made_for.radius, glass))
    powers = path.new_zeros(max(settings.terms, len(path)))
    powers[: len(path)] = path
    smooth = Element(EvenPowers(powers), made_for.radius, glass)
    basis = radial_powers(smooth.radius, len(powers))[:, : settings.terms]
    best = best_of_starts(
        lambda: PhaseVariables(smooth, basis=basis),
        world,
        spectrum,
        starts=settings.starts,
        spread=settings.spread,
        steps=settings.start_steps,
        seed=settings.seed,
        progress=progress,
    )
    if settings.kind == "smooth":
        return best
    (element,) = detached(best())
    element = as_rings(element, settings.pitch)
    if settings.levels:
        process = Process(levels=settings.levels, wavelength=float(made_for.wavelength))
        element, _ = matched(element, process, element.radius.new_tensor(world.wavelengths))
    return PhaseVariables(element, tolerance=settings.tolerance)


def _zernike(settings: DesignSettings, lens: Element) -> PhaseVariables:
    """Noll's polynomials from piston to the last of `terms`, in contact with a lens that stays."""
    none = Zernike(lens.radius.new_zeros(settings.terms))
    random = torch.as_tensor(draws(settings.seed, _START).standard_normal(settings.terms)).to(lens.radius)
    variables = PhaseVariables(dataclasses.replace(lens, profile=none), others=(lens,))
    with torch.no_grad():
        variables.change.copy_(settings.spread * random)
        variables.change[:3] = 0  # piston and tilts change no picture
    return variables


def learn_element(
    camera: WaveCamera, pictures: Pictures, settings: DesignSettings, run: Run, *, every: int = 20
) -> Iterator[tuple[int, Record]]:
    """The steps of learning, one at a time; resumed where the run stands."""
    groups = [{"params": list(camera.variables.parameters()), "lr": settings.rate}]
    if camera.restoration == "towards":
        groups.append({"params": [camera.v, camera.t], "lr": 0.1 * settings.rate})
    if camera.network is not None:
        groups.append({"params": list(camera.network.parameters()), "lr": _NETWORK_RATE})
    optimizer = _optimizer(settings, groups)
    rates = [group["lr"] for group in groups]

    def loss(step: int, share: Share) -> tuple[Tensor, Record]:
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * scheduled(settings.schedule, step / settings.steps)
        value = _loss(camera, pictures, settings, step, share)
        return value, {"rate": optimizer.param_groups[0]["lr"], **_filter_record(camera)}

    yield from train(camera, optimizer, loss, steps=settings.steps, run=run, every=every)


def adam(
    parameters: Iterable[nn.Parameter],
    error: Callable[[int], Tensor],
    *,
    steps: int,
    rate: float,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Iterator[float]:
    """Steps of Adam down the error of each step, kept nowhere; its value comes before the parameters change.

    rate: falls to 0 as a cosine.
    """
    optimizer = torch.optim.Adam(parameters, lr=rate)
    for step in progress(range(steps)):
        for group in optimizer.param_groups:
            group["lr"] = rate * scheduled("cosine", step / steps)
        optimizer.zero_grad()
        value = error(step)
        value.backward()
        yield float(value.detach())
        optimizer.step()


def scheduled(schedule: str, place: float) -> float:
    """What is left of a rate at a place from 0 to 1 of the way: a function of the step alone, so that runs resume."""
    return {"constant": 1.0, "linear": 1 - place, "cosine": 0.5 * (1 + math.cos(math.pi * place))}[schedule]


def _optimizer(settings: DesignSettings, groups: list[dict]) -> torch.optim.Optimizer:
    if settings.optimizer == "sgd":
        return torch.optim.SGD(groups, momentum=0.5, nesterov=True)
    return {"adam": torch.optim.Adam, "adadelta": torch.optim.Adadelta}[settings.optimizer](groups)


def _loss(camera: WaveCamera, pictures: Pictures, settings: DesignSettings, step: int, share: Share) -> Tensor:
    draw = torch.Generator().manual_seed(int(draws(settings.seed, step, _SAMPLE).integers(2**62)))
    if settings.loss == "spectral":
        # One process has it all: shares of a sum that is not one over samples.
        return camera.expected(camera.variables(draw=draw)) / share.processes
    per_epoch = max(1, len(pictures) * 4 // settings.batch)
    epoch, place = divmod(step, per_epoch)
    samples = share.of(range(place * settings.batch, (place + 1) * settings.batch))
    parts = [_sample(camera, pictures, settings, sample, epoch) for sample in samples]
    picture, depth, noise = (torch.stack(part) for part in zip(*parts, strict=True))
    estimate = camera(picture, depth, noise, draw=draw)
    return (estimate - picture[:, None]).square().mean((1, 2, 3)).sum() / settings.batch


def _sample(camera: WaveCamera, pictures: Pictures, settings: DesignSettings, sample: int, epoch: int):
    """Picture (n, n), number of its depth, noise (W, n, n): keyed by the sample's number."""
    n = camera.spectrum.shape[-1]
    count = len(pictures) * 4
    patch = crop(pictures, sample % count, epoch=epoch, size=n // 2, crops=4, seed=settings.seed)
    random = draws(settings.seed, epoch, sample, _SAMPLE)
    depth = int(random.integers(len(camera.world.depths)))
    sigma = random.uniform(*settings.noise)
    noise = sigma * random.standard_normal((len(camera.world.wavelengths), n, n))
    like = camera.spectrum
    return torch.as_tensor(mirrored(patch)).to(like), torch.tensor(depth), torch.as_tensor(noise).to(like)


def _filter_record(camera: WaveCamera) -> Record:
    if camera.restoration != "towards":
        return {}
    return {"gamma": float(camera.v.detach() ** 2), "target_m": float(camera.t.detach() ** 2)}


def begin(
    settings: DesignSettings,
    world: WaveCameraConfig,
    spectrum: Tensor,
    folder: str | Path,
    *,
    pictures: str,
    progress: Callable[[Iterable], Iterable] = iter,
) -> tuple[WaveCamera, Run]:
    """The camera of a run as it begins and its folder; the start is found once and kept there.

    pictures: `digest` of those that are learned from, whose spectrum it is.
    Raises training.OtherSettings where the folder was begun with others.
    """
    run = Run(folder, {**dataclasses.asdict(settings), "world": dataclasses.asdict(world), "pictures": pictures})
    kept = run.folder / "start.pt"
    if kept.exists():
        variables = start(dataclasses.replace(settings, starts=0), world, spectrum)
        found = read_state(kept)
        try:
            with torch.no_grad():
                variables.change.copy_(found["change"])
            variables.start = found["start"]
        except (KeyError, RuntimeError, TypeError) as error:
            raise DamagedRun(f"{kept}: no start of this run; remove it to find it anew") from error
    else:
        variables = start(settings, world, spectrum, progress=progress)
        found = {"start": variables.start, "change": variables.change.detach()}
        write_atomically(kept, lambda file: torch.save(found, file))
    network = RedNet(_NETWORK, seed=settings.seed) if settings.restoration == "network" else None
    return WaveCamera(variables, world, spectrum, restoration=settings.restoration, network=network), run


def radial_powers(radius: Tensor, terms: int) -> Tensor:
    """Zernike polynomials without angle, n = 2, 4, …, as even powers of r in mm: (terms, terms), a column each.

    Z_n0 = √(n + 1) Σ_s (-1)^s (n - s)!/(s! ((n/2 - s)!)²) (r/R)^(n - 2s);   piston is left out
    """
    found = torch.zeros(terms, terms, dtype=torch.float64)
    for k in range(1, terms + 1):
        for s in range(k):
            share = math.factorial(2 * k - s) / (math.factorial(s) * math.factorial(k - s) ** 2)
            found[k - s - 1, k - 1] = (-1) ** s * math.sqrt(2 * k + 1) * share
    power = radius.detach() ** (-2.0 * torch.arange(1, terms + 1, dtype=torch.float64).to(radius))
    return power[:, None] * found.to(radius)
