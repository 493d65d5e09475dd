"""`raytrace wave design` and `raytrace wave restore`: a designed phase element, and images restored behind one."""

import argparse
import dataclasses
from pathlib import Path

import torch
from torch import Tensor

from raytrace.cli.pictures import pictures_of
from raytrace.cli.progress import progress
from raytrace.cli.run import CommandError, catalogs, say
from raytrace.files import write_json
from raytrace.imaging.image import blur
from raytrace.imaging.pictures import Pictures, dead_leaves, digest, split
from raytrace.imaging.restoration import depth_invariant_wiener, power_law, psnr, restore
from raytrace.imaging.wave_camera import (
    ElementReport,
    WaveCameraConfig,
    depth_text,
    kernels,
    periodic,
    quality,
    spectrum,
    transfer,
)
from raytrace.imaging.wave_design import WaveCamera, begin, learn_element
from raytrace.io.pictures import read_channels, write_picture
from raytrace.maths.result import Column, Result, Table, plain
from raytrace.settings import DesignSettings
from raytrace.wave_optics.compute import elements
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
    """A designed element and its image quality."""

    settings: DesignSettings

    def document(self) -> dict:
        inputs = {"settings": dataclasses.asdict(self.settings), "world": dataclasses.asdict(self.config)}
        return plain(inputs | dataclasses.asdict(self.quality))

    def tables(self) -> list[Table]:
        result = self.quality
        both = zip(*result.by_depth.values(), strict=True), (result.mean.values(), result.spread.values())
        wiener, invariant = zip(*(row for rows in both for row in rows), strict=True)
        lowest = min(min(row) for row in result.energy)
        columns = {
            Column("object at"): [*map(depth_text, self.config.depths), "mean", "spread"],
            Column("Wiener", "dB", ".2f"): wiener,
            Column("invariant", "dB", ".2f"): invariant,
        }
        title = "PSNR of restored pictures; invariant: the depth-invariant filter"
        size = f"{self.config.size} × {self.config.size} pixels"
        return [Table(columns, [title], [f"light inside the window of {size}: {lowest:.3f} or more"])]


def design(arguments: argparse.Namespace) -> DesignedElement:
    """Design an element, or resume its design, and compute its image quality."""
    config, settings, folder = _config(arguments), _design_settings(arguments), Path(arguments.folder)
    train, test = split(training_pictures(arguments, "sharp leaves"))
    camera = learn(settings, config, train, folder, f"{settings.kind}, seed {settings.seed}")
    with torch.no_grad():
        parts = camera.variables()
        psf = kernels(parts, config)
        rating = quality(parts, config, train=periodic(train, WIDE), test=periodic(test, WIDE), psf=psf)
    designed = DesignedElement(parts, config, psf, rating, settings)
    write_json(folder / "outcome.json", designed.document())
    heights = fabricated(parts[0]) if settings.kind == "rings" else as_pixels(parts[0], config.pixel)
    write_element(heights, folder / "heights.npy", design_wavelength=config.wavelengths[len(config.wavelengths) // 2])
    say(f"written: {folder / 'outcome.json'}, {folder / 'heights.npy'}")
    return designed


def _design_settings(arguments: argparse.Namespace) -> DesignSettings:
    kind = arguments.kind or DesignSettings.kind
    if kind != "rings":
        for option, value in (("feature", arguments.feature), ("tolerance", 1e6 * (arguments.tolerance or 0))):
            if value:
                raise CommandError(f"--{option} {value:g}: a {kind} element has no rings; take --element rings")
    options = {name: value for name, value in vars(arguments).items() if name not in ("noise", "size")}
    defaults = {"glass": "F_SILICA" if kind == "rings" else "PMMA", "terms": 36 if kind == "zernike" else 7}
    more = {name: options.get(name) or value for name, value in defaults.items()}
    more |= {"pitch": arguments.feature} if arguments.feature else {}
    more |= {"noise": (arguments.noise, arguments.noise)} if arguments.noise else {}
    more |= {"restoration": "blind"} if arguments.loss != "images" else {}
    return DesignSettings.of(options, **more)


def learn(settings: DesignSettings, config: WaveCameraConfig, train: Pictures, folder: Path, label: str) -> WaveCamera:
    """An optimised camera: the remaining steps of its run, with a bar."""
    S, images = spectrum(periodic(train, settings.size)), digest(train.samples)
    camera, run = begin(
        settings, config, S, folder, pictures=images, progress=lambda starts: progress(starts, "start", what=label)
    )
    bar = None
    for step, record in learn_element(camera, train, settings, run):
        bar = bar or progress(settings.steps, what=label, initial=step)
        bar.set_postfix_str(f"loss {record['loss']:.6f}", refresh=False)
        bar.update()
    if bar is None:
        say(f"{label}: finished before, nothing to learn")
    else:
        bar.close()
        say(f"{label}: loss {record['loss']:.6f} after {settings.steps} steps")
    return camera


def training_pictures(arguments: argparse.Namespace, leaves: str) -> Pictures:
    """Those of --data, else dead leaves by this name."""
    options = {"size": WIDE // 2, "seed": arguments.seed or 0, "smallest": LEAVES[leaves]}
    return pictures_of(arguments, WIDE // 2, lambda: dead_leaves(LEAF_COUNT, **options))[0]


# -- restoration


@dataclasses.dataclass(frozen=True)
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
    if simulate is not None:
        psf = kernels(parts, config, depths=[simulate])
        haze = (1 - psf.energy[0])[:, None, None] * image.mean((-2, -1), keepdim=True)
        noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed), dtype=image.dtype)
        image = blur(image, psf.kernel[0], boundary="reflect") + haze + config.noise * noise
    shape = tuple(extent + config.size - 1 for extent in image.shape[-2:])
    H = transfer(kernels(parts, config), shape)
    S = power_law(shape, mean=float(image.mean()), deviation=max(float(image.std()), config.noise))
    return image, restore(image, depth_invariant_wiener(H, S, config.noise), boundary="taper")


def restore_files(arguments: argparse.Namespace) -> RestoredImages:
    """Restore every image and write it as .png in the folder."""
    arguments.wavelengths = sorted(arguments.wavelengths)
    config = _config(arguments)
    names = ("aperture", "sensor", "focus", "design_wavelength", "levels", "exact", "glass", "index", "pitch", "span")
    options = {name: value for name, value in vars(arguments).items() if name in names}
    parts = elements(arguments.element, wavelengths=config.wavelengths, catalog=catalogs(arguments), **options)
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
