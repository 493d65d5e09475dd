"""`raytrace codesign`: settings and pictures of an experiment, one run with its progress, and its results."""

import argparse
import dataclasses
import hashlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, distributed

from raytrace.cli.pictures import pictures_of
from raytrace.cli.progress import progress
from raytrace.cli.runner import CommandError, catalogs, find_lens, open_lens, present, say
from raytrace.cli.settings import given_settings
from raytrace.files import write_json
from raytrace.imaging.codesign import (
    LENS,
    LENS_STEPS,
    STEPS,
    Optimum,
    Outcome,
    closed_form,
    initial_camera,
    lens_at_start,
    network_at_start,
    outcome,
    run_model,
    sensor_at_start,
    spectrum_of,
    steps_per_epoch,
    variables,
)
from raytrace.imaging.network import PRESETS, UNetShape
from raytrace.imaging.pictures import Pictures, dead_leaves, digest, split
from raytrace.imaging.training import read_json, read_log
from raytrace.io import FORMATS, read_lens, write_lens
from raytrace.io.zemax import write as zemax
from raytrace.maths.result import Column, Result, Table, plain
from raytrace.optimization.between import Between, between, summary, warn_of_worse
from raytrace.plotting.style import FIELD_COLOURS, Figure, new_figure, styled
from raytrace.settings import CodesignSettings
from raytrace.settings import read as read_settings
from raytrace.shards import processes, share
from raytrace.system.lens import Lens, check, field_points
from raytrace.tracing.focus import NoImage
from raytrace.tracing.paraxial import paraxial_image_distance

_LEAVES = 100  # dead-leaves images, without --data
_DISTANCES = 9  # at which a finished run is tested


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A lens, settings and pictures; about: hashes of the lens file and the pictures, for the folders of the runs;
    kind: of the pictures; catalogs: of glass, with which the lens was read."""

    lens: Lens
    name: str
    settings: CodesignSettings
    train: Pictures
    test: Pictures
    about: dict[str, str]
    kind: str
    catalogs: tuple[Path, ...] = ()
    device: str = "cpu"

    @property
    def steps_per_epoch(self) -> int:
        """Raises ValueError if the pictures do not fill a batch."""
        return steps_per_epoch(self.train, self.settings)

    def spectrum(self) -> Tensor:
        """Power spectrum of the training pictures, at the size of a patch with its margin."""
        return spectrum_of(self.train, self.settings)


def open_experiment(
    arguments: argparse.Namespace, settings: CodesignSettings, pictures: str | None = None
) -> Experiment:
    """Open the lens, refuse what cannot be simulated, then read the pictures.

    pictures: digest of the pictures of a finished run, which are not read again.
    """
    path, lens = find_lens(arguments.lens), _file_lens(arguments)
    if settings.near >= settings.far:
        raise CommandError(f"--near {settings.near:g} is not nearer than --far {settings.far:g}")
    field_points(settings.fields, like=lens)  # refuses angles of 90 degrees
    try:
        # refuses bad variables, starts and networks
        initial_camera(lens, settings, catalogs=catalogs(arguments))
    except NoImage as error:
        message = "give --near, --far and --focus-distance beyond the focal length"
        raise CommandError(f"{arguments.lens}: {error}; {message}") from error
    initial = lens_at_start(lens, settings)
    try:
        check(initial)
    except ValueError as error:
        raise CommandError(f"{path}: {error}") from error
    zemax.write(initial, str(path), catalogs=catalogs(arguments))  # refuses what the file cannot hold
    least = settings.patch + settings.size - 1
    sensor = sensor_at_start(settings)
    colour = len(sensor.channels) == 3
    leaves = arguments.limit or _LEAVES, max(256, least), colour
    kind, parts = "", (Pictures((), ()),) * 2
    if pictures is None:
        samples, kind = pictures_of(arguments, least, lambda: _leaves(*leaves), colour=colour)
        parts, pictures = split(samples), digest(samples.samples)
    about = {
        "lens": f"{path.stem}, sha256 {_sha256(path)}",
        "pictures": pictures,
    }
    if arguments.catalog and (settings.relearn or "catalog" in settings.hold.split()):  # glasses are chosen from them
        about["catalogs"] = ", ".join(f"{path.stem}, sha256 {_sha256(path)}" for path in catalogs(arguments))
    return Experiment(lens, path.stem, settings, *parts, about, kind, catalogs(arguments), arguments.device)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _leaves(count: int, size: int, colour: bool) -> Pictures:
    say(f"no --data: training on {count} pictures of dead leaves, discs that hide one another")
    seeds = progress(range(count), "dead leaf")
    leaves = [dead_leaves(1, size=size, seed=seed, colour=colour).samples[0] for seed in seeds]
    return Pictures(tuple(leaves), tuple(f"dead leaves {seed}" for seed in range(count)))


def _file_lens(arguments: argparse.Namespace) -> Lens:
    """The lens of the file, unchanged: conditions of the options are settings of the experiment."""
    names = ("lens", "catalog", "substitute")
    return open_lens(argparse.Namespace(**{name: getattr(arguments, name, None) for name in names}))


def settings_of(arguments: argparse.Namespace, stored: Path | None = None) -> CodesignSettings:
    """Settings from the options. stored: `settings.json` of a run, whose choice for precision "auto" is kept; None
    without training of a network."""
    preset = PRESETS[arguments.preset]
    options = {name: value for name, value in vars(arguments).items() if value is not None and value is not False}
    if isinstance(preset, UNetShape):
        network = {"network": "u-net", "depth": preset.levels, "width": preset.width}
    else:
        network = {"network": "red-net", "depth": preset.depth, "width": preset.width}
    given = given_settings(arguments, CodesignSettings)
    options = network | _wavelengths(arguments, given) | given | options
    texts = ("vary", "bounds", "hold", "glasses", "limits")
    options |= {name: " ".join(options[name]) for name in texts if isinstance(options.get(name), list)}
    if arguments.fields:
        if any(x for x, _ in options["fields"]):
            raise CommandError("--field X,Y: co-design takes field points along y, --field Y")
        options["fields"] = [y for _, y in options["fields"]]
    if stored is None:
        options["precision"] = "float32"
    elif options.get("precision", "auto") == "auto":
        # The choice of the first process, for all.
        chosen = [""]
        if share().rank == 0:
            before = read_json(stored) if stored.exists() else {}
            chosen = [
                before.get("precision") or faster_precision(CodesignSettings.of(options | {"precision": "float32"}))
            ]
        if share().processes > 1:
            distributed.broadcast_object_list(chosen)
        options["precision"] = chosen[0]
    return CodesignSettings.of(options)


def _wavelengths(arguments: argparse.Namespace, given: Mapping) -> dict[str, Sequence[float]]:
    """Wavelengths and weights of the options or of given settings, or those of the file, its primary one first."""
    wavelengths, weights = arguments.wavelengths, arguments.wavelength_weights
    if "wavelengths" in given and not wavelengths and not arguments.file_wavelengths:
        return {}
    of_file = arguments.file_wavelengths or ((arguments.sensor or given.get("sensor")) and not wavelengths)
    if not of_file:
        wavelengths = wavelengths or CodesignSettings.wavelengths
        return {"wavelengths": wavelengths, "wavelength_weights": weights or [1.0] * len(wavelengths)}
    if arguments.file_wavelengths and (wavelengths or weights):
        raise CommandError("--file-wavelengths takes the file's own: leave out --wavelength and --wavelength-weights")
    lens = _file_lens(arguments)
    order = sorted(range(len(lens.wavelengths)), key=lambda k: k != lens.primary_wavelength - 1)
    return {
        "wavelengths": lens.wavelengths[order].tolist(),
        "wavelength_weights": lens.wavelength_weights[order].tolist(),
    }


def recorded_settings(path: Path) -> CodesignSettings:
    """The settings in a `settings.json`, with defaults for missing ones."""
    return read_settings(CodesignSettings, CodesignSettings.recorded(read_json(path)))


def faster_precision(settings: CodesignSettings, *, size: int = 64, count: int = 4) -> str:
    """The precision in which this machine's processor trains the network faster, "bfloat16" or "float32", measured.

    Processors without instructions for bfloat16 emulate it, ten times slower.
    """
    trained = network_at_start(settings)
    sensor = sensor_at_start(settings)
    picture = torch.rand(count, len(sensor.channels), size, size)
    seconds = {}
    for name, enabled in (("float32", False), ("bfloat16", True)):
        for _ in range(2):  # the first call prepares
            start = time.perf_counter()
            with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
                restored = trained(picture)
            restored.float().abs().mean().backward()
            seconds[name] = time.perf_counter() - start
    return min(seconds, key=lambda name: seconds[name])


def conjugates(lens: Lens, settings: CodesignSettings) -> tuple[list[float], list[float]]:
    """Sensor distances in mm, ascending, and the object distances in m whose paraxial images are there."""
    distances = np.geomspace(settings.near / 10, settings.far * 200, 2000)
    lens = lens_at_start(lens, settings)
    with torch.no_grad():
        images = paraxial_image_distance(lens, lens.wavelengths.new_tensor(distances)).numpy()
    order = np.argsort(images)
    return images[order].tolist(), (distances[order] / 1e3).tolist()


def focus_of(lens: Lens, settings: CodesignSettings) -> Callable[[float], float] | None:
    """Object distance in m in paraxial focus, of a sensor distance in mm; None if more than the sensor varies."""
    if settings.vary.split() != ["sensor"]:
        return None
    sensors, distances = conjugates(lens, settings)
    return lambda sensor: float(np.interp(sensor, sensors, distances))


def train_run(experiment: Experiment, settings: CodesignSettings, folder: Path, label: str) -> Outcome:
    """Train both steps of a run, or their remaining epochs, with a bar and a line for every epoch."""
    per_epoch = experiment.steps_per_epoch if len(experiment.train) else 0  # of a finished run
    focus = focus_of(experiment.lens, settings)
    epochs = {STEPS[0]: settings.epochs * (1 + settings.turns) + settings.relearn, STEPS[1]: settings.epochs}
    length, losses, bar = epochs[STEPS[0]] * per_epoch + settings.turns * LENS_STEPS, [], None

    def testing(batches: Sequence[int]) -> Iterator[int]:
        for number, first in enumerate(batches, 1):
            if bar is not None:
                bar.set_postfix_str(f"testing, batch {number} of {len(batches)}")
            yield first

    total = length + settings.epochs * per_epoch
    distances = np.linspace(settings.near, settings.far, _DISTANCES).tolist()
    steps = run_model(
        experiment.lens, experiment.train, experiment.test, settings, folder, about=experiment.about,
        distances=tuple(distances), catalogs=experiment.catalogs, device=experiment.device, progress=testing,
    )  # fmt: skip
    try:
        for name, step, record in steps:
            if bar is None:
                done = STEPS.index(name) * length + step
                if done:
                    say(f"{label}: resumes after step {done} of {total}")
                bar = progress(total, what=label, initial=done)
            losses.append(record["loss"])
            turn = int(record.get("turn", 0))
            words = f", turn {turn} of {settings.turns}" if turn else ""
            words += f", penalty {record['penalty']:.3g} mm²" if record["penalty"] else ""
            if "sensor" in record:
                words += f", sensor {record['sensor']:.4f} mm"
                words += f", focus {focus(record['sensor']):.1f} m" if focus else ""
            bar.set_postfix_str(f"{name}, loss {record['loss']:.4f}{words}", refresh=False)
            bar.update()
            epoch, rest = divmod(step + 1 - turn * LENS_STEPS, per_epoch)
            if "lens_step" in record:
                bar.write(f"raytrace: {label}, lens step {record['lens_step']:.0f}: loss {record['loss']:.4f}{words}")
                losses.clear()
            elif rest == 0:
                progressed = f"epoch {epoch} of {epochs[name]}"
                bar.write(f"raytrace: {label}, {name}, {progressed}: loss {sum(losses) / len(losses):.4f}{words}")
                losses.clear()
    finally:
        if bar is not None:
            bar.close()
    if bar is None:
        say(f"{label}: finished before, nothing to train")
    result = outcome(folder)
    assert result is not None  # the run ends by writing it
    return result


# -- results


@dataclasses.dataclass(frozen=True, repr=False)
class CodesignResult(Result):
    """The outcome of a run, or the optimum of the closed form.

    curves: losses by their name, for the figure; between: spots of the lens between the fields that the loss has, none
    where these are places all over a sensor.
    """

    experiment: Experiment
    lens: Outcome | Optimum
    curves: dict[str, Sequence[float]]
    between: tuple[Between, ...] = ()

    @styled
    def draw(self) -> Figure:
        """Every curve one after the other; noisy ones faint, with their running mean over a fiftieth of the curve."""
        figure = new_figure(5.6, 3.2)
        panel, start = figure.subplots(), 0
        for number, (name, losses) in enumerate(self.curves.items()):
            steps = np.arange(start, start + len(losses))
            width = max(1, len(losses) // 50)
            panel.plot(steps, losses, color=FIELD_COLOURS[number], linewidth=0.6, alpha=1.0 if width == 1 else 0.3)
            means = np.convolve(losses, np.full(width, 1 / width), "valid")
            panel.plot(steps[width - 1 :], means, color=FIELD_COLOURS[number], label=name)
            start += len(losses)
        is_training = len(self.curves) > 1
        panel.set(xlabel="step" if is_training else "evaluation")
        panel.set_ylabel("training loss (mean L¹)" if is_training else "mean square error, best linear filter")
        if is_training:
            panel.legend()
        return figure

    def document(self) -> dict:
        limits = dataclasses.asdict(variables(self.experiment.lens, self.experiment.settings).limits)
        settings = dataclasses.asdict(self.experiment.settings)
        between = {"between": [dataclasses.asdict(spot) for spot in self.between]} if self.between else {}
        about = {"settings": settings, **self.experiment.about, "limits": limits}
        return plain({**about, **self.lens.document(), **between})

    def tables(self) -> list[Table]:
        result = self.lens
        if isinstance(result, Outcome):
            lines = [
                f"{result.model} PSFs, seed {result.seed}",
                *self._lens_lines(),
                "L1 loss of test pictures:",
                f"  after step 1, with its own PSFs  {result.l1_joint:.5f}",
                f"  the same network with DRT PSFs   {result.l1_before:.5f}",
                f"  after step 2, with DRT PSFs      {result.l1_drt:.5f}",
                *_place_lines(result),
                *_as_built_lines(result, self.experiment.settings.as_built),
            ]
            distances = [float(z) / 1e3 for z in result.by_distance]
            losses = Column("L1 with DRT PSFs", form=".5f")
            return [Table({Column("object at", "m", "g"): distances, losses: [*result.by_distance.values()]}, lines)]
        course = {
            Column("evaluation"): range(1, len(result.course) + 1),
            Column("error", form=".8f"): result.course,
            Column("penalty", "mm²"): result.penalties,
        }
        errors = f"{result.error:.8f} with its own PSFs, {result.error_drt:.8f} with DRT PSFs"
        title = f"{result.model} PSFs, mean square error of a pixel behind the best linear filter"
        return [Table(course, [title], [*self._lens_lines(), f"error of this lens: {errors}"])]

    def _lens_lines(self) -> Iterator[str]:
        result = self.lens
        yield f"sensor at {result.sensor_mm:.4f} mm"
        for name, value in result.variables.items():
            if name != "sensor":
                yield f"{name} = {value:.7g} {'1/mm' if name.startswith('curvature') else ''}".rstrip()
        paraxial, rms = (
            f"{distance:.2f} m" if math.isfinite(distance) else "infinity"
            for distance in (result.focus_paraxial_m, result.focus_rms_m)
        )
        yield f"in focus: {paraxial} (paraxial), {rms} (least RMS spot)"
        limits = variables(self.experiment.lens, self.experiment.settings).limits
        glass, air = (
            f"{low:.4g}" + (f" to {high:.4g}" if math.isfinite(high) else " at least")
            for low, high in (limits.glass, limits.air)
        )
        thicknesses = f"glass {glass}, its edge {limits.edge:.4g} at least, air {air} (mm)"
        yield f"penalty {result.penalty:.6g} mm², not part of the loss; thicknesses: {thicknesses}"
        yield from summary(self.between, "the spots of the fields and wavelengths of the loss")


def _between_fields(lens: Lens, settings: CodesignSettings) -> tuple[Between, ...]:
    """Spots between the fields of a co-design, focused at the middle of its range; warns of those much larger."""
    if settings.sensor or len(settings.fields) < 2:
        return ()
    distance = 2 / (1 / settings.near + 1 / settings.far)
    view = lens.at(fields=[*settings.fields], wavelengths=[*settings.wavelengths], object_distance=distance)
    gaps = tuple(gap for gap in between(view) if gap.samples != "rays")
    warn_of_worse(gaps)
    return gaps


def _place_lines(result: Outcome) -> Iterator[str]:
    if result.l1_by_place:
        yield "at shares of the half diagonal of the sensor, with DRT PSFs:"
        for place, l1 in result.l1_by_place.items():
            behind = f"behind a Wiener filter of that place {result.wiener_by_place[place]:.5f}"
            yield f"  {float(place):4g}   {l1:.5f}, {behind}"


def _as_built_lines(result: Outcome, as_built: bool) -> Iterator[str]:
    if count := len(result.l1_as_built):
        l1, psnr = (np.array([*errors.values()]) for errors in (result.l1_as_built, result.psnr_as_built))
        training = "trained as built" if as_built else "nominal training"
        yield f"{count} perturbed cameras that training never draws, mean ± standard deviation ({training}):"
        yield f"  L1                               {l1.mean():.5f} ± {l1.std():.5f}"
        spread = f"{psnr.mean():.3f} ± {psnr.std():.3f} dB, least {psnr.min():.3f} dB"
        yield f"  PSNR                             {spread}"


def run(arguments: argparse.Namespace) -> None:
    """Train one model, or bring it to the optimum of the closed form."""
    with processes():
        if arguments.loss == "spectral":
            _spectral(arguments)
        else:
            _train(arguments)


def _train(arguments: argparse.Namespace) -> None:
    folder, lens_file = _outputs(arguments)
    if folder is None:
        raise CommandError("no folder to keep the run in: give -o FOLDER")
    stored = folder / STEPS[0] / "settings.json"
    if arguments.resume and not stored.exists():
        raise CommandError(f"{folder}: no run was started here; omit --resume to start one")
    is_finished = arguments.resume and (folder / "outcome.json").exists()
    pictures = read_json(stored).get("pictures") if is_finished else None
    experiment = open_experiment(arguments, settings_of(arguments, stored), pictures)
    settings = experiment.settings
    result = train_run(experiment, settings, folder, f"{settings.model}, seed {settings.seed}")
    lens = read_lens(folder / LENS, catalogs=experiment.catalogs)
    if lens_file and not share().rank:
        write_lens(lens, lens_file, catalogs=experiment.catalogs)
    in_turns = [f"network_{turn}" for turn in range(1, settings.turns + 1)]
    curves: dict[str, Sequence[float]] = {
        f"step {k}": [row["loss"] for name in names for row in read_log(folder / name / "log.csv")]
        for k, names in enumerate(([STEPS[0], *in_turns], [STEPS[1]]), 1)
    }
    _present(
        CodesignResult(experiment, result, curves, _between_fields(lens, settings)),
        arguments,
        f"{folder / 'outcome.json'}, {lens_file or folder / LENS}",
    )


def _spectral(arguments: argparse.Namespace) -> None:
    if arguments.resume:
        raise CommandError("--resume belongs to training; leave out --resume or --loss spectral")
    settings = settings_of(arguments)
    if settings.is_toleranced:
        raise CommandError("--as-built, --grade and --limits belong to training; leave them out, or --loss spectral")
    if settings.turns or settings.relearn:
        name = "--turns" if settings.turns else "--relearn"
        raise CommandError(f"{name} belongs to training; leave out {name} or --loss spectral")
    experiment = open_experiment(arguments, settings)
    optimum = closed_form(experiment.lens, experiment.settings, experiment.spectrum(), catalogs=experiment.catalogs)
    for name in optimum.at_end:
        say(f"warning: {name} ends at a bound, and the loss still falls beyond it")
    spots = _between_fields(optimum.lens, experiment.settings)
    result = CodesignResult(experiment, optimum, {"closed form": optimum.course}, spots)
    folder, lens_file = _outputs(arguments)
    written: object = lens_file
    if lens_file:
        write_lens(optimum.lens, lens_file, catalogs=experiment.catalogs)
    elif folder:
        folder.mkdir(parents=True, exist_ok=True)
        write_lens(optimum.lens, folder / LENS, catalogs=experiment.catalogs)
        write_json(folder / "spectral.json", result.document())
        written = f"{folder / 'spectral.json'}, {folder / LENS}"
    _present(result, arguments, written)


def _outputs(arguments: argparse.Namespace) -> tuple[Path | None, Path | None]:
    """The folder of -o, and the lens file if it names one."""
    if not arguments.folder:
        return None, None
    path = Path(arguments.folder)
    return (path.with_suffix(""), path) if path.suffix.lower() in FORMATS else (path, None)


def _present(result: CodesignResult, arguments: argparse.Namespace, written: object) -> None:
    """Print the result; raise afterwards if it is no optimum."""
    present(result, arguments)
    if written:
        say(f"written: {written}")
    if result.lens.no_optimum:
        raise CommandError(result.lens.no_optimum)
