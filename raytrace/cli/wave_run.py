"""`raytrace wave design` and `raytrace wave restore`: a designed phase element, and images restored behind one."""

import argparse
import copy
import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.cli.pictures import pictures_of
from raytrace.cli.progress import progress
from raytrace.cli.runner import CommandError, catalogs, say
from raytrace.cli.settings import given_settings
from raytrace.files import write_json
from raytrace.imaging.camera import Camera
from raytrace.imaging.closed_form import field_filters
from raytrace.imaging.pictures import Pictures, dead_leaves, digest, split
from raytrace.imaging.restoration import power_law, power_spectrum, psnr, restore
from raytrace.imaging.variables import PhaseVariables
from raytrace.imaging.wave_camera import ElementReport, WaveCameraConfig, depth_text, periodic
from raytrace.imaging.wave_design import Design
from raytrace.io.pictures import read_channels, write_picture
from raytrace.maths.numerics import detached
from raytrace.maths.result import Column, Result, Table, plain
from raytrace.settings import DesignSettings
from raytrace.tracing.compiled import prepare
from raytrace.wave_optics.compute import phase_elements
from raytrace.wave_optics.element import Element
from raytrace.wave_optics.element_files import write_element
from raytrace.wave_optics.fabrication import as_pixels, fabricated

WIDE = 512  # pixels of a period of the restored pictures
LEAF_COUNT = 40  # dead-leaves images
#: Dead-leaves images by their name: smallest radius, pixels.
LEAVES = {"sharp leaves": 2.5, "smooth leaves": 8.0}


def _config(arguments: argparse.Namespace) -> WaveCameraConfig:
    if arguments.size % 2 == 0:
        raise CommandError(f"--size {arguments.size}: a window needs a pixel at its middle; take an odd number")
    return WaveCameraConfig(
        radius=0.5 * arguments.aperture,
        sensor_distance=arguments.sensor,
        depths=tuple(arguments.depths),
        design=arguments.focus,
        wavelengths=tuple(arguments.wavelengths),
        pixel=arguments.pixel,
        size=arguments.size,
        noise=arguments.noise or WaveCameraConfig.noise,
        exact=arguments.exact,
    )


# -- design


@dataclasses.dataclass(frozen=True)
class DesignedElement(ElementReport):
    """A designed element and its image quality; errors: expected in closed form, of the initial and of this element."""

    settings: DesignSettings
    errors: tuple[float, float]
    initial: ElementReport = dataclasses.field(kw_only=True)

    def document(self) -> dict:
        inputs = {"settings": dataclasses.asdict(self.settings), "world": dataclasses.asdict(self.config)}
        before = {"initial": dataclasses.asdict(self.initial.quality)}
        errors = {"expected_error": dict(zip(("initial", "designed"), self.errors, strict=True))}
        return plain(inputs | dataclasses.asdict(self.quality) | errors | before)

    def tables(self) -> list[Table]:
        columns: dict[Column, Sequence] = {
            Column("object at"): [*map(depth_text, self.config.depths), "mean", "spread"]
        }
        for filter, heading in (("wiener", "Wiener"), ("blind", "invariant")):
            for rating, which in ((self.initial.quality, "initial"), (self.quality, "designed")):
                values = *rating.by_depth[filter], rating.mean[filter], rating.spread[filter]
                columns[Column(f"{filter}_{which}", "dB", ".2f", f"{heading}\n{which}")] = values
        lowest = min(min(row) for row in self.quality.energy)
        titles = ["PSNR of restored pictures; invariant: the depth-invariant filter"]
        before, after = self.errors
        size = f"{self.config.size} × {self.config.size} pixels"
        remarks = [
            f"expected mean square error behind the depth-invariant filter: {before:.6f} initial, {after:.6f} designed",
            f"light inside the window of {size}: {lowest:.3f} or more",
        ]
        return [Table(columns, titles, remarks)]


def design(arguments: argparse.Namespace) -> DesignedElement:
    """Design an element, or resume its design, and compute its image quality."""
    config, settings, folder = _config(arguments), _design_settings(arguments), Path(arguments.folder)
    label = f"{settings.kind}, seed {settings.seed}"
    with progress(None, what=f"{label}: training pictures"):
        train, test = split(training_pictures(arguments, "sharp leaves"))
    design, *cameras = learn(settings, config, train, folder, label)
    pictures = {"train": periodic(train, WIDE), "test": periodic(test, WIDE)}
    bar = progress(cameras, "element", what=f"{label}: image quality")
    initial, after = (ElementReport.of(detached(camera.elements()), config, **pictures) for camera in bar)
    before, designed_error = map(design.expected_error, cameras)
    errors, parts = (before, designed_error), after.elements
    designed = DesignedElement(parts, config, after.kernels, after.quality, settings, errors, initial=initial)
    write_json(folder / "outcome.json", designed.document())
    heights = fabricated(parts[0]) if settings.kind == "rings" else as_pixels(parts[0], config.pixel)
    write_element(heights, folder / "heights.npy", design_wavelength=config.wavelengths[len(config.wavelengths) // 2])
    say(f"written: {folder / 'outcome.json'}, {folder / 'heights.npy'}")
    return designed


def _design_settings(arguments: argparse.Namespace) -> DesignSettings:
    given = given_settings(arguments, DesignSettings)
    options = {name: value for name, value in vars(arguments).items() if name not in ("noise", "size")}
    options = given | {name: value for name, value in options.items() if value is not None}
    kind = options.get("kind", DesignSettings.kind)
    if kind != "rings":
        for option, value in (("feature", arguments.feature), ("tolerance", 1e6 * options.get("tolerance", 0))):
            if value:
                raise CommandError(f"--{option} {value:g}: a {kind} element has no rings; take --element rings")
    defaults = {"glass": "F_SILICA" if kind == "rings" else "PMMA", "terms": 36 if kind == "zernike" else 7}
    more = {name: options.get(name) or value for name, value in defaults.items()}
    more |= {"pitch": arguments.feature} if arguments.feature else {}
    more |= {"noise": (arguments.noise, arguments.noise)} if arguments.noise else {}
    more |= {"restoration": "blind"} if options.get("loss") != "images" else {}
    return DesignSettings.of(options, **more)


def learn(
    settings: DesignSettings, config: WaveCameraConfig, train: Pictures, folder: Path, label: str
) -> tuple[Design, Camera[PhaseVariables], Camera[PhaseVariables]]:
    """The design, its initial and its optimised camera: the remaining steps of its run, with a bar."""
    with progress(None, what=f"{label}: spectrum of the pictures"):
        S, images = power_spectrum(periodic(train, settings.size), window="none"), digest(train.samples)
    design = Design(settings, config, S)
    bars = []

    def starts(items: Iterable) -> Iterable:
        bars.append(progress(items, "start", what=f"{label}: initial element"))
        return bars[-1]

    def watch(start: int, evaluation: int, error: float) -> None:
        bars[-1].set_postfix_str(f"start {start}: evaluation {evaluation}, error {error:.6f}", refresh=False)

    with progress(None, what=f"{label}: initial element"):
        camera, run = design.begin(folder, pictures=images, progress=starts, watch=watch)
        initial = copy.deepcopy(camera)
    with progress(None, what=f"{label}: compiling the trace"):
        prepare()
    record = None
    with progress(settings.steps, what=f"{label}: optimisation") as bar:
        for step, record in design.learn(camera, train, run):
            if bar.n < step:  # resumed
                bar.n = bar.initial = step
            bar.set_postfix_str(f"loss {record['loss']:.6f}", refresh=False)
            bar.update()
    if record is None:
        say(f"{label}: finished before, nothing to learn")
    else:
        say(f"{label}: loss {record['loss']:.6f} after {settings.steps} steps")
    return design, initial, camera


def training_pictures(arguments: argparse.Namespace, leaves: str) -> Pictures:
    """Those of --data, else dead leaves by this name."""
    seed, smallest = arguments.seed or 0, LEAVES[leaves]
    drawn = functools.partial(dead_leaves, LEAF_COUNT, size=WIDE // 2, seed=seed, smallest=smallest)
    return pictures_of(arguments, WIDE // 2, drawn)[0]


# -- restoration


@dataclasses.dataclass(frozen=True, repr=False)
class RestoredImages(Result):
    """A record each: file, restored, and of simulated ones psnr_image and psnr_restored in dB."""

    records: tuple[dict, ...]

    def document(self) -> dict:
        return {"images": list(self.records)}

    def tables(self) -> list[Table]:
        names = {
            "file": ("<", ""),
            "restored": ("<", ""),
            "psnr_image": (".2f", "PSNR\nimage"),
            "psnr_restored": (".2f", "PSNR\nrestored"),
        }
        columns = {
            Column(name, "dB" if heading else "", form, heading): [record[name] for record in self.records]
            for name, (form, heading) in names.items()
            if self.records and name in self.records[0]
        }
        return [Table(columns)]


@torch.no_grad()
def captured_and_restored(
    image: Tensor, parts: tuple[Element, ...], config: WaveCameraConfig, *, simulate: float | None = None, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Captured and restored image (W, rows, columns), in [0, 1], a channel for each wavelength of the camera.

    simulate: object distance in mm; the image is then a scene, whose borders the camera reflects.
    """
    camera = config.camera(parts, boundary="reflect")
    if simulate is not None:
        (image,) = camera.demosaiced(camera.image(image[None], [simulate]), index=[0], seed=seed)
    shape = tuple(extent + config.size - 1 for extent in image.shape[-2:])
    S = power_law(shape, mean=float(image.mean()), deviation=max(float(image.std()), config.noise))
    (G,) = field_filters(camera, S, [0.0], config.depths)
    return image, restore(image, G, boundary="taper")


def restore_files(arguments: argparse.Namespace) -> RestoredImages:
    """Restore every image and write it as .png in the folder."""
    arguments.wavelengths = sorted(arguments.wavelengths)
    config = _config(arguments)
    names = ("aperture", "sensor", "focus", "design_wavelength", "levels", "exact", "glass", "index", "pitch", "span")
    options = {name: value for name, value in vars(arguments).items() if name in names}
    parts = phase_elements(arguments.element, wavelengths=config.wavelengths, catalog=catalogs(arguments), **options)
    folder, records = Path(arguments.folder), []
    folder.mkdir(parents=True, exist_ok=True)
    for file in arguments.images:
        channels = torch.as_tensor(read_channels(file, len(config.wavelengths))).flip(0)  # the shortest first
        if min(channels.shape[-2:]) < 2:
            raise CommandError(f"{file}: an image of {channels.shape[-1]} × {channels.shape[-2]} pixels is too small")
        simulation = {"simulate": arguments.simulate, "seed": arguments.seed}
        captured, estimate = captured_and_restored(channels, parts, config, **simulation)
        path = folder / f"{Path(file).stem}.png"
        write_picture(path, estimate.flip(0).clamp(0, 1).numpy())
        record = {"file": file, "restored": str(path)}
        if arguments.simulate is not None:
            write_picture(folder / f"{Path(file).stem}_image.png", captured.flip(0).clamp(0, 1).numpy())
            for name, picture in (("psnr_image", captured), ("psnr_restored", estimate)):
                record[name] = float(psnr((picture - channels).square().mean()))
        records.append(record)
        say(f"written: {path}")
    return RestoredImages(tuple(records))
