"""Design of a phase element for extended depth of field: by the closed form, or by simulated images and their filter.

    closed form   e = ⟨S (S var H + σ²)/(S ⟨|H|²⟩ + σ²)⟩ over frequencies and colours: no pictures, no random noise
    images        mean (x̂ - x)² of pictures at random depths with random noise, restored by a filter

The filter is the best depth-invariant one of the current kernels, or that of Sitzmann et al. (ACM Trans. Graph. 37,
2018): towards the measurement, for the kernel at a trainable depth, with a trainable weight. Optionally a network
follows the depth-invariant filter. Steps, logs and checkpoints are those of `training`.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from raytrace.imaging.camera import Camera
from raytrace.imaging.camera_filters import DepthInvariantFilter, LinearFilter, TowardsMeasurement
from raytrace.imaging.closed_form import camera_error
from raytrace.imaging.network import RedNet, RedNetShape
from raytrace.imaging.pictures import Pictures, crop, draws
from raytrace.imaging.restoration import restore
from raytrace.imaging.training import DamagedRun, Record, Run, Share, read_state, train, write_state
from raytrace.imaging.variables import PhaseVariables
from raytrace.imaging.wave_camera import WaveCameraConfig, mirrored
from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import index
from raytrace.maths.numerics import detached
from raytrace.optimization.least_squares import minimise_tensors
from raytrace.settings import DesignSettings
from raytrace.wave_optics.designs import aim, converging
from raytrace.wave_optics.element import Element, EvenPowers, Zernike
from raytrace.wave_optics.fabrication import Process, as_rings, matched

_NETWORK = RedNetShape(6, 16)  # behind the depth-invariant filter, the same for every colour
_NETWORK_RATE = 1e-3
_CROPS = 4  # patches of a picture in an epoch
_SAMPLE, _START = 20, 21  # last numbers of the keys of random numbers

#: Called with a random start, an evaluation of its error, and that error.
Watch = Callable[[int, int, float], None]


def _unwatched(start: int, evaluation: int, error: float) -> None:
    """No report."""


class RedNetOfChannels(RedNet):
    """A RED-Net of one channel, for every channel of an image (B, C, n, n) alone."""

    def forward(self, image: Tensor) -> Tensor:
        return super().forward(image.flatten(0, 1)[:, None])[:, 0].unflatten(0, image.shape[:2])


@dataclasses.dataclass(frozen=True)
class Design:
    """The design of an element: settings, numbers of its camera, and S (n, n) of the training pictures."""

    settings: DesignSettings
    config: WaveCameraConfig
    spectrum: Tensor

    def camera(self, variables: PhaseVariables) -> Camera[PhaseVariables]:
        """The camera of the design; its sampling is that of the current element."""
        settings, config = self.settings, self.config
        filter: LinearFilter
        if settings.restoration == "towards":
            filter = TowardsMeasurement(self.spectrum, config.design)
        else:
            filter = DepthInvariantFilter(self.spectrum, config.depths)
        network = RedNetOfChannels(_NETWORK, seed=settings.seed) if settings.restoration == "network" else None
        planned = config.camera(variables, network, filter=filter)
        planned.plan(config.depths)
        return planned

    def start(self, *, progress: Callable[[Iterable], Iterable] = iter, watch: Watch = _unwatched) -> PhaseVariables:
        """The initial element: a lens for the design depth with random Zernike terms; the best smooth element of
        several random starts; or the rings, of any height or in equal steps, nearest to that in phase."""
        settings, config = self.settings, self.config
        if settings.tolerance and settings.kind != "rings":
            raise ValueError(f"a tolerance of {settings.tolerance:g} mm belongs to rings; {settings.kind!r} has none")
        glass = find_glass(settings.glass)
        goal = aim(radius=config.radius, sensor=config.sensor_distance, focus=config.design, exact=config.exact)
        path = converging(goal) / (index(glass, goal.wavelength) - 1)
        if settings.kind == "zernike":  # Noll's polynomials up to `terms`, in contact with a fixed lens
            lens = Element(EvenPowers(path), goal.radius, glass)
            random = torch.as_tensor(draws(settings.seed, _START).standard_normal(settings.terms)).to(lens.radius)
            profile = Zernike(lens.radius.new_zeros(settings.terms))
            variables = PhaseVariables(dataclasses.replace(lens, profile=profile), others=(lens,))
            with torch.no_grad():
                variables.change.copy_(settings.spread * random)
                variables.change[:3] = 0  # piston and tilts change no picture
            return variables
        powers = path.new_zeros(max(settings.terms, len(path)))
        powers[: len(path)] = path
        smooth = Element(EvenPowers(powers), goal.radius, glass)
        basis = radial_powers(smooth.radius, len(powers))[:, : settings.terms]
        best = self.best_of_starts(lambda: PhaseVariables(smooth, basis=basis), progress=progress, watch=watch)
        if settings.kind == "smooth":
            return best
        (element,) = detached(best())
        element = as_rings(element, settings.pitch)
        if settings.levels:
            process = Process(levels=settings.levels, wavelength=float(goal.wavelength))
            element, _ = matched(element, process, element.radius.new_tensor(config.wavelengths))
        return PhaseVariables(element, tolerance=settings.tolerance)

    def best_of_starts(
        self,
        variables: Callable[[], PhaseVariables],
        *,
        progress: Callable[[Iterable], Iterable] = iter,
        watch: Watch = _unwatched,
    ) -> PhaseVariables:
        """The lowest minimum of the closed-form error by L-BFGS from random starts; several minima exist.

        variables: new ones at each call; starts 0: unchanged variables; watch: called with the start, the evaluation,
        both from 1, and its error.
        """
        settings = self.settings
        best, least = variables(), math.inf
        for number in progress(range(settings.starts)):
            trial = variables()
            with torch.no_grad():
                for p in trial.parameters():
                    random = draws(settings.seed, number, _START).standard_normal(p.shape)
                    p.copy_(torch.as_tensor(settings.spread * random))
            tried, evaluations = self.camera(trial), itertools.count(1)

            def error(tried: Camera = tried, number: int = number, evaluations: Iterator[int] = evaluations) -> Tensor:
                square = camera_error(tried, self.spectrum, self.config.depths)
                watch(number + 1, next(evaluations), float(square.detach()))
                return square

            lowest = min(minimise_tensors(list(trial.parameters()), error, steps=settings.start_steps).values)
            if lowest < least:
                best, least = trial, lowest
        return best

    def begin(
        self,
        folder: str | Path,
        *,
        pictures: str,
        progress: Callable[[Iterable], Iterable] = iter,
        watch: Watch = _unwatched,
    ) -> tuple[Camera[PhaseVariables], Run]:
        """The camera at the start of a run, and its folder, where the initial element is stored.

        pictures: `digest` of the training pictures of the spectrum.
        Raises training.OtherSettings if the folder was started with others.
        """
        inputs = {"world": dataclasses.asdict(self.config), "pictures": pictures}
        run = Run(folder, dataclasses.asdict(self.settings) | inputs)
        file = run.path / "start.pt"
        if file.exists():
            variables = dataclasses.replace(self, settings=dataclasses.replace(self.settings, starts=0)).start()
            state = read_state(file)
            try:
                with torch.no_grad():
                    variables.change.copy_(state["change"])
                variables.start = state["start"]
            except (KeyError, RuntimeError, TypeError) as error:
                raise DamagedRun(f"{file}: not the start of this run; remove it to compute it again") from error
        else:
            variables = self.start(progress=progress, watch=watch)
            state = {"start": variables.start, "change": variables.change.detach()}
            write_state(file, state)
        return self.camera(variables), run

    @torch.no_grad()
    def expected_error(self, camera: Camera[PhaseVariables]) -> float:
        """`camera_error` of a camera at the depths of the design."""
        return float(camera_error(camera, self.spectrum, self.config.depths))

    def learn(
        self, camera: Camera[PhaseVariables], pictures: Pictures, run: Run, *, every: int = 20
    ) -> Iterator[tuple[int, Record]]:
        """The steps of optimisation, one at a time; an unfinished run is resumed."""
        settings = self.settings
        groups: list[dict[str, Any]] = [{"params": list(camera.variables.parameters()), "lr": settings.rate}]
        for part, rate in ((camera.filter, 0.1 * settings.rate), (camera.network, _NETWORK_RATE)):
            if parameters := [] if part is None else list(part.parameters()):
                groups.append({"params": parameters, "lr": rate})
        if settings.optimizer == "sgd":
            optimizer = torch.optim.SGD(groups, momentum=0.5, nesterov=True)
        else:
            optimizer = {"adam": torch.optim.Adam, "adadelta": torch.optim.Adadelta}[settings.optimizer](groups)

        def loss(step: int, share: Share) -> tuple[Tensor, Record]:
            record = {"rate": optimizer.param_groups[0]["lr"]}
            if isinstance(camera.filter, TowardsMeasurement):
                gamma, target = camera.filter.v.detach() ** 2, camera.filter.t.detach() ** 2
                record |= {"gamma": float(gamma), "target_m": float(target)}
            return self._loss(camera, pictures, step, share), record

        return train(camera, optimizer, loss, steps=settings.steps, run=run, every=every, schedule=settings.schedule)

    def _loss(self, camera: Camera[PhaseVariables], pictures: Pictures, step: int, share: Share) -> Tensor:
        settings, config, n = self.settings, self.config, self.spectrum.shape[-1]
        draw = torch.Generator().manual_seed(int(draws(settings.seed, step, _SAMPLE).integers(2**62)))
        if settings.loss == "spectral":
            # Every process computes all of it: it is not a sum over samples.
            return camera_error(camera, self.spectrum, config.depths, draw=draw) / share.processes
        epoch, batch = divmod(step, max(1, len(pictures) * _CROPS // settings.batch))
        samples = []
        for number in share.of(range(batch * settings.batch, (batch + 1) * settings.batch)):
            sample = number % (len(pictures) * _CROPS)
            patch = crop(pictures, sample, epoch=epoch, size=n // 2, crops=_CROPS, seed=settings.seed)
            random = draws(settings.seed, epoch, number, _SAMPLE)
            place = torch.tensor(int(random.integers(len(config.depths))))
            normal = random.uniform(*settings.noise) * random.standard_normal((len(config.wavelengths), n, n))
            samples.append((torch.as_tensor(patch), place, torch.as_tensor(normal)))
        patches, depth, noise = (torch.stack(part) for part in zip(*samples, strict=True))
        picture = mirrored(patches).to(self.spectrum)
        # Periodic pictures are blurred by their transfer functions, from which the filter follows, too.
        H = camera.transfer(camera.kernels(config.depths, draw=draw), n)
        image = restore(picture[:, None], H[depth]) + noise.to(picture)
        estimate = camera.restore(image, H if isinstance(camera.filter, DepthInvariantFilter) else None)
        return (estimate - picture[:, None]).square().mean((1, 2, 3)).sum() / settings.batch


def radial_powers(radius: Tensor, terms: int) -> Tensor:
    """Zernike polynomials without angle, n = 2, 4, …, as even powers of r in mm: (terms, terms), a column each.

    Z_n0 = √(n + 1) Σ_s (-1)^s (n - s)!/(s! ((n/2 - s)!)²) (r/R)^(n - 2s);   piston is left out
    """
    coefficients = torch.zeros(terms, terms, dtype=torch.float64)
    for k in range(1, terms + 1):
        for s in range(k):
            share = math.factorial(2 * k - s) / (math.factorial(s) * math.factorial(k - s) ** 2)
            coefficients[k - s - 1, k - 1] = (-1) ** s * math.sqrt(2 * k + 1) * share
    power = radius.detach() ** (-2.0 * torch.arange(1, terms + 1, dtype=torch.float64).to(radius))
    return power[:, None] * coefficients.to(radius)
