"""What the forms of `raytrace codesign` share: settings, pictures, and one run with its progress."""

import argparse
import dataclasses
import hashlib
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, distributed
from tqdm import tqdm

from raytrace.cli.pictures import pictures_of
from raytrace.cli.progress import progress
from raytrace.cli.run import CommandError, catalogs, find_lens, open_lens, present, say
from raytrace.files import write_json
from raytrace.imaging.closed_form import power_spectrum
from raytrace.imaging.codesign import (
    LENS,
    STEPS,
    Optimum,
    Outcome,
    camera,
    closed_form,
    lens_at_start,
    outcome,
    run_model,
    variables,
)
from raytrace.imaging.network import PRESETS, RedNet, RedNetShape
from raytrace.imaging.pictures import Pictures, dead_leaves, digest, split
from raytrace.imaging.training import NotFinite, Record, read_json
from raytrace.imaging.variables import Limits
from raytrace.io import FORMATS, read_lens, write_lens
from raytrace.maths.result import Result, plain
from raytrace.settings import CodesignSettings
from raytrace.settings import read as read_settings
from raytrace.shards import share
from raytrace.system.lens import Lens, check, field_points
from raytrace.tracing.focus import NoImage
from raytrace.tracing.paraxial import paraxial_image_distance

_LEAVES = 100  # pictures, where none are given
_DISTANCES = 9  # at which a finished run is tested


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A lens, settings and pictures; about: what of them decides the result, for the folders of the runs; catalogs: of
    glass, that the lens was read with."""

    lens: Lens
    name: str
    settings: CodesignSettings
    train: Pictures
    test: Pictures
    about: dict[str, str]
    kind: str
    catalogs: tuple[Path, ...] = ()

    @property
    def steps_per_epoch(self) -> int:
        return len(self.train) * self.settings.crops // self.settings.batch

    @property
    def distances(self) -> tuple[float, ...]:
        """Object distances in mm at which runs are tested."""
        return tuple(np.linspace(self.settings.near, self.settings.far, _DISTANCES).tolist())

    @property
    def limits(self) -> Limits:
        """What thicknesses are held to."""
        return variables(self.lens, self.settings).limits

    def spectrum(self) -> Tensor:
        """Power spectrum of the training pictures, at the size of a patch with its margin."""
        size = self.settings.patch + self.settings.size - 1
        return power_spectrum(self.train, size, crops=self.settings.crops, seed=self.settings.seed)


def experiment(arguments: argparse.Namespace, settings: CodesignSettings) -> Experiment:
    """Open the lens, refuse what cannot be simulated, then read the pictures."""
    path, lens = find_lens(arguments.lens), lens_of_file(arguments)
    if settings.near >= settings.far:
        raise CommandError(f"--near {settings.near:g} is not nearer than --far {settings.far:g}")
    field_points(settings.fields, like=lens)  # refuses angles of 90 degrees
    try:
        camera(lens, settings)  # refuses bad variables, starts and networks
    except NoImage as error:
        message = "give --near, --far and --focus-distance beyond the focal length"
        raise CommandError(f"{arguments.lens}: {error}; {message}") from error
    begun = lens_at_start(lens, settings)
    try:
        check(begun)
    except ValueError as error:
        raise CommandError(f"{path}: {error}") from error
    FORMATS[".zmx"].write(begun, str(path), catalogs=catalogs(arguments))  # refuses what a learned lens could not keep
    least = settings.patch + settings.size - 1
    samples, kind = pictures_of(arguments, least, lambda: _leaves(arguments, least))
    about = {
        "lens": f"{path.stem}, sha256 {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}",
        "pictures": digest(samples.samples),
    }
    return Experiment(lens, path.stem, settings, *split(samples), about, kind, catalogs(arguments))


def refuse_too_few(given: Experiment) -> None:
    """Raise where the pictures to train on do not fill one batch."""
    if not given.steps_per_epoch:
        raise CommandError(
            f"{len(given.train)} pictures to train on, {given.settings.crops} crops of each, do not fill one batch of "
            f"{given.settings.batch}; give more pictures, more --crops or a smaller --batch"
        )


def settings_of(arguments: argparse.Namespace, begun: Path | None = None) -> CodesignSettings:
    """Settings from the options. begun: `settings.json` of a run, whose precision "auto" keeps; None without training
    of a network."""
    preset = PRESETS[arguments.preset]
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    given = {"depth": preset.depth, "width": preset.width} | given | _light(arguments)
    given |= {name: " ".join(given[name]) for name in ("vary", "bounds", "hold") if name in given}
    if "fields" in given:
        if any(x for x, _ in given["fields"]):
            raise CommandError("--field X,Y: co-design takes field points along y, --field Y")
        given["fields"] = [y for _, y in given["fields"]]
    if begun is None:
        given["precision"] = "float32"
    elif given.get("precision", "auto") == "auto":
        shape = RedNetShape(given["depth"], given["width"])
        given["precision"] = _agreed(lambda: recorded(begun).get("precision") or faster_precision(shape))
    return CodesignSettings.of(given)


def _light(arguments: argparse.Namespace) -> dict[str, Sequence[float]]:
    """Wavelengths and weights by the options: those given, or the file's own, its primary one first."""
    wavelengths, weights = arguments.wavelengths, arguments.wavelength_weights
    if not arguments.file_wavelengths:
        wavelengths = wavelengths or CodesignSettings.wavelengths
        return {"wavelengths": wavelengths, "wavelength_weights": weights or [1.0] * len(wavelengths)}
    if wavelengths or weights:
        raise CommandError("--file-wavelengths takes the file's own: leave out --wavelength and --wavelength-weights")
    lens = lens_of_file(arguments)
    order = sorted(range(len(lens.wavelengths)), key=lambda k: k != lens.primary_wavelength - 1)
    names = ("wavelengths", "wavelength_weights")
    return {name: getattr(lens, name)[order].tolist() for name in names}


def lens_of_file(arguments: argparse.Namespace) -> Lens:
    """The lens as its file has it: what options change of it is part of the settings."""
    own = {name: getattr(arguments, name, None) for name in ("lens", "catalog", "substitute")}
    return open_lens(argparse.Namespace(**own))


def _agreed(choose: Callable[[], str]) -> str:
    """The choice of the first process, for all."""
    chosen = [choose() if share().rank == 0 else ""]
    if share().processes > 1:
        distributed.broadcast_object_list(chosen)
    return chosen[0]


def recorded(path: Path) -> dict:
    """A `settings.json`, empty if there is none."""
    return read_json(path) if path.exists() else {}


def recorded_settings(path: Path) -> CodesignSettings:
    """The settings in a `settings.json`; those that it does not have are as by default."""
    known = {field.name for field in dataclasses.fields(CodesignSettings)}
    return read_settings(CodesignSettings, {name: value for name, value in recorded(path).items() if name in known})


def _leaves(arguments: argparse.Namespace, least: int) -> Pictures:
    count, size = arguments.limit or _LEAVES, max(256, least)
    say(f"no --data: training on {count} pictures of dead leaves, discs that hide one another")
    leaves = [dead_leaves(1, size=size, seed=seed).samples[0] for seed in progress(range(count), "dead leaf")]
    return Pictures(tuple(leaves), tuple(f"dead leaves {seed}" for seed in range(count)))


def train_run(given: Experiment, settings: CodesignSettings, folder: Path, label: str) -> Outcome:
    """Both steps of one run, or what is left of them, with a bar; a run that is finished is read again."""
    follow(
        given,
        settings,
        label,
        STEPS,
        lambda testing: run_model(
            given.lens,
            given.train,
            given.test,
            settings,
            folder,
            about=given.about,
            distances=given.distances,
            catalogs=given.catalogs,
            progress=testing,
        ),
    )
    return outcome(folder)


def follow(given: Experiment, settings: CodesignSettings, label: str, names: Sequence[str], train: Callable) -> None:
    """Take the steps of a training with a bar. names: of its steps; train: (what wraps tests) -> the iterator."""
    length = settings.epochs * given.steps_per_epoch
    shown = Progress(label, length, given.steps_per_epoch, focus_of(given.lens, settings), names)
    try:
        for name, step, record in train(shown.testing):
            shown(name, step, record)
    except NotFinite as error:
        raise CommandError(str(error)) from error
    finally:
        shown.close()
    if shown.bar is None:
        say(f"{label}: finished before, nothing to train")


class Progress:
    """A bar over the steps of a run, by their names, on a terminal; elsewhere a line for every epoch."""

    def __init__(
        self,
        label: str,
        length: int,
        steps_per_epoch: int,
        focus: Callable[[float], float] | None,
        names: Sequence[str] = STEPS,
    ):
        self.label, self.length, self.steps_per_epoch, self.focus = label, length, steps_per_epoch, focus
        self.names, self.whole = names, len(names) * length
        self.bar: tqdm | None = None
        self.losses: list[float] = []
        self.first, self.since, self.is_testing = 0, time.monotonic(), False

    def __call__(self, name: str, step: int, record: Record) -> None:
        place = self.names.index(name) * self.length + step + 1
        if self.bar is None:
            self.first = place - 1
            if self.first:
                say(f"{self.label}: going on behind step {self.first} of {self.whole}")
            self.bar = tqdm(total=self.whole, initial=self.first, unit="step", disable=None, dynamic_ncols=True)
        self.is_testing = False
        self.losses.append(record["loss"])
        if not self.bar.disable:
            self._describe(name, f"loss {record['loss']:.4f}{self._lens(record)}")
            self.bar.update()
        elif (step + 1) % self.steps_per_epoch == 0:
            self._line(name, step, record, place)

    def testing(self, batches: Sequence[int]) -> Iterator[int]:
        """The batches of a test one by one, counted on the bar; elsewhere one line for all tests behind a step."""
        is_drawn = self.bar is not None and not self.bar.disable
        if not (is_drawn or self.is_testing):
            say(f"{self.label}: testing")
            sys.stderr.flush()
        self.is_testing = True
        for place, first in enumerate(batches, 1):
            if is_drawn:
                self._describe("testing", f"batch {place} of {len(batches)}", refresh=True)
            yield first

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()

    def _describe(self, name: str, words: str, refresh: bool = False) -> None:
        self.bar.set_description(f"{self.label}, {name}", refresh=refresh)
        self.bar.set_postfix_str(words, refresh=refresh)

    def _line(self, name: str, step: int, record: Record, place: int) -> None:
        left = (self.whole - place) * (time.monotonic() - self.since) / (place - self.first)
        epoch, epochs = (step + 1) // self.steps_per_epoch, self.length // self.steps_per_epoch
        loss = sum(self.losses) / len(self.losses)
        self.losses.clear()
        say(
            f"{self.label}, {name}, epoch {epoch} of {epochs}: loss {loss:.4f}{self._lens(record)}, "
            f"{tqdm.format_interval(left)} left"
        )
        sys.stderr.flush()

    def _lens(self, record: Record) -> str:
        """Penalty and place of the sensor."""
        said = f", penalty {record['penalty']:.3g} mm²" if record["penalty"] else ""
        if "sensor" not in record:
            return said
        said += f", sensor {record['sensor']:.4f} mm"
        return said if self.focus is None else f"{said}, focus {self.focus(record['sensor']):.1f} m"


def conjugates(lens: Lens, settings: CodesignSettings) -> tuple[list[float], list[float]]:
    """Sensor distances in mm, ascending, and the object distances in m whose paraxial images are there."""
    distances = np.geomspace(settings.near / 10, settings.far * 200, 2000)
    lens = lens_at_start(lens, settings)
    with torch.no_grad():
        images = paraxial_image_distance(lens, lens.wavelengths.new_tensor(distances)).tolist()
    order = np.argsort(images)
    return np.asarray(images)[order].tolist(), (distances[order] / 1e3).tolist()


def focus_of(lens: Lens, settings: CodesignSettings) -> Callable[[float], float] | None:
    """Object distance in m in paraxial focus, of a sensor distance in mm; None where more than the sensor varies."""
    if settings.vary.split() != ["sensor"]:
        return None
    sensors, distances = conjugates(lens, settings)
    return lambda sensor: float(np.interp(sensor, sensors, distances))


def faster_precision(shape: RedNetShape, *, size: int = 64, count: int = 4) -> str:
    """Whether this machine's processor trains the network faster in "bfloat16" or in "float32", by trying both.

    Processors without instructions for bfloat16 emulate it, ten times slower.
    """
    network = RedNet(shape).to(memory_format=torch.channels_last)
    picture = torch.rand(count, 1, size, size)
    seconds = {}
    for name, enabled in (("float32", False), ("bfloat16", True)):
        for _ in range(2):  # the first call prepares
            start = time.perf_counter()
            with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
                restored = network(picture)
            restored.float().abs().mean().backward()
            seconds[name] = time.perf_counter() - start
    return min(seconds, key=seconds.get)


# -- codesign LENS -----------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Learned(Result):
    """What an experiment found."""

    given: Experiment
    found: Outcome | Optimum

    def document(self) -> dict:
        settings, limits = (dataclasses.asdict(one) for one in (self.given.settings, self.given.limits))
        return plain({"settings": settings, **self.given.about, "limits": limits, **self.found.document()})

    def __str__(self) -> str:
        lines = _outcome if isinstance(self.found, Outcome) else _optimum
        return "\n".join(lines(self.found, _lens(self.found, self.given.limits)))


def _outcome(found: Outcome, lens: Iterator[str]) -> Iterator[str]:
    yield f"{found.model} PSFs, seed {found.seed}"
    yield from lens
    yield "L1 loss of test pictures:"
    yield f"  after step 1, with its own PSFs  {found.l1_joint:.5f}"
    yield f"  the same network with DRT PSFs   {found.l1_before:.5f}"
    yield f"  after step 2, with DRT PSFs      {found.l1_drt:.5f}"
    yield f"{'object at':>12} {'L1 with DRT PSFs':>18}"
    for distance, loss in found.by_distance.items():
        yield f"{float(distance) / 1e3:>10g} m {loss:>18.5f}"


def _optimum(found: Optimum, lens: Iterator[str]) -> Iterator[str]:
    yield f"{found.model} PSFs, mean square error of a pixel behind the best linear filter"
    yield f"{'evaluation':>12} {'error':>12} {'penalty, mm²':>13}"
    for evaluation, (error, penalty) in enumerate(zip(found.course, found.penalties, strict=True), 1):
        yield f"{evaluation:>12} {error:>12.8f} {penalty:>13.6g}"
    yield from lens
    yield f"error of this lens: {found.error:.8f} with its own PSFs, {found.error_drt:.8f} with DRT PSFs"


def _lens(found: Outcome | Optimum, held: Limits) -> Iterator[str]:
    yield f"sensor at {found.sensor_mm:.4f} mm"
    for name, value in found.variables.items():
        if name != "sensor":
            yield f"{name} = {value:.7g} {'1/mm' if name.startswith('curvature') else ''}".rstrip()
    yield f"in focus: {_metres(found.focus_paraxial_m)} (paraxial), {_metres(found.focus_rms_m)} (least RMS spot)"
    ranges = (held.glass, held.air)
    glass, air = (f"{low:.4g}" + (f" to {high:.4g}" if math.isfinite(high) else " at least") for low, high in ranges)
    limits = f"glass {glass}, its edge {held.edge:.4g} at least, air {air} (mm)"
    yield f"penalty {found.penalty:.6g} mm² beside the loss; thicknesses: {limits}"


def _metres(distance: float) -> str:
    return f"{distance:.2f} m" if math.isfinite(distance) else "infinity"


def single(arguments: argparse.Namespace) -> None:
    """Train what is left of a run."""
    if not arguments.folder:
        raise CommandError("no folder to keep the run in: give -o FOLDER")
    folder, lens_file = _outputs(arguments)
    begun = folder / STEPS[0] / "settings.json"
    if arguments.resume and not begun.exists():
        raise CommandError(f"{folder}: no run was begun here; leave out --resume to begin one")
    given = experiment(arguments, settings_of(arguments, begun))
    refuse_too_few(given)
    found = train_run(given, given.settings, folder, f"{given.settings.model}, seed {given.settings.seed}")
    if lens_file and not share().rank:
        write_lens(read_lens(folder / LENS, catalogs=given.catalogs), lens_file, catalogs=given.catalogs)
    _tell(Learned(given, found), arguments, f"{folder / 'outcome.json'}, {lens_file or folder / LENS}")


def spectral(arguments: argparse.Namespace) -> None:
    """Find the optimum of the closed form."""
    given = experiment(arguments, settings_of(arguments))
    found = closed_form(given.lens, given.settings, given.spectrum())
    for name in found.at_end:
        say(f"warning: {name} stands at an end of its bounds, and the loss still falls beyond it")
    folder, lens_file = _outputs(arguments) if arguments.folder else (None, None)
    if lens_file:
        write_lens(found.lens, lens_file, catalogs=given.catalogs)
    elif folder:
        folder.mkdir(parents=True, exist_ok=True)
        write_lens(found.lens, folder / LENS, catalogs=given.catalogs)
        write_json(folder / "spectral.json", Learned(given, found).document())
    written = lens_file or (folder and f"{folder / 'spectral.json'}, {folder / LENS}")
    _tell(Learned(given, found), arguments, written)


def _outputs(arguments: argparse.Namespace) -> tuple[Path, Path | None]:
    """The folder of -o, and the lens file where it names one."""
    path = Path(arguments.folder)
    return (path.with_suffix(""), path) if path.suffix.lower() in FORMATS else (path, None)


def _tell(learned: Learned, arguments: argparse.Namespace, written: object) -> None:
    """Print what was found; raise where it is no optimum, after all is said."""
    present(learned, arguments)
    if written:
        say(f"written: {written}")
    if learned.found.no_optimum:
        raise CommandError(learned.found.no_optimum)
