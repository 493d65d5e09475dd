"""`raytrace wave design`: an element designed for a camera, and its image quality."""

import argparse
import dataclasses
from pathlib import Path

import torch

from raytrace.cli.pictures import pictures_of
from raytrace.cli.progress import progress
from raytrace.cli.run import CommandError, say
from raytrace.files import write_json
from raytrace.imaging.pictures import Pictures, dead_leaves, digest, split
from raytrace.imaging.training import NotFinite, OtherSettings
from raytrace.imaging.wave_camera import Judged, WaveCameraConfig, depth_text, kernels, periodic, quality, spectrum
from raytrace.imaging.wave_design import WaveCamera, begin, learn_element
from raytrace.maths.result import plain
from raytrace.settings import DesignSettings
from raytrace.wave_optics.element_files import write_element
from raytrace.wave_optics.fabrication import as_pixels, fabricated

WIDE = 512  # pixels of a period of the restored pictures
LEAF_COUNT = 40  # dead-leaves images
#: Dead-leaves images by their name: smallest radius, pixels.
LEAVES = {"sharp leaves": 2.5, "smooth leaves": 8.0}


@dataclasses.dataclass(frozen=True)
class Learned(Judged):
    """A learned element, and what it is worth."""

    settings: DesignSettings

    def document(self) -> dict:
        named = {"settings": self.settings, "world": self.world}
        return plain({name: dataclasses.asdict(one) for name, one in named.items()} | dataclasses.asdict(self.quality))

    def __str__(self) -> str:
        own, world = self.quality, self.world
        rows = [(depth_text(depth), *both) for depth, *both in zip(world.depths, *own.by_depth.values(), strict=True)]
        rows += [("mean", *own.mean.values()), ("spread", *own.spread.values())]
        lowest = min(min(row) for row in own.energy)
        return "\n".join(
            [
                f"{'object at':>12} {'Wiener':>9} {'invariant':>9}   PSNR of restored pictures, dB; invariant: the "
                "filter that knows no depth",
                *(f"{name:>12} {classic:>9.2f} {invariant:>9.2f}" for name, classic, invariant in rows),
                f"light inside the window of {world.size} × {world.size} pixels: {lowest:.3f} or more",
            ]
        )


def design(arguments: argparse.Namespace) -> Learned:
    """Learn one element, or go on with it; then say what it is worth."""
    world, settings, folder = config_of(arguments), _settings(arguments), Path(arguments.folder)
    train, test = split(training_pictures(arguments, "sharp leaves"))
    camera = learn(settings, world, train, folder, f"{settings.kind}, seed {settings.seed}")
    with torch.no_grad():
        elements = camera.variables()
        found = kernels(elements, world)
        own = quality(elements, world, train=periodic(train, WIDE), test=periodic(test, WIDE), found=found)
    learned = Learned(elements, world, found, own, settings)
    write_json(folder / "outcome.json", learned.document())
    made = fabricated(elements[0]) if settings.kind == "rings" else as_pixels(elements[0], world.pixel)
    write_element(made, folder / "heights.npy", design_wavelength=world.wavelengths[len(world.wavelengths) // 2])
    say(f"written: {folder / 'outcome.json'}, {folder / 'heights.npy'}")
    return learned


def config_of(arguments: argparse.Namespace) -> WaveCameraConfig:
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


def _settings(arguments: argparse.Namespace) -> DesignSettings:
    kind = arguments.kind or DesignSettings.kind
    if kind != "rings":
        for option, given in (("feature", arguments.feature), ("tolerance", 1e6 * (arguments.tolerance or 0))):
            if given:
                raise CommandError(f"--{option} {given:g}: a {kind} element has no rings; take --element rings")
    named = {name: value for name, value in vars(arguments).items() if name not in ("noise", "size")}
    usual = {"glass": "F_SILICA" if kind == "rings" else "PMMA", "terms": 36 if kind == "zernike" else 7}
    more = {name: named.get(name) or value for name, value in usual.items()}
    more |= {"pitch": arguments.feature} if arguments.feature else {}
    more |= {"noise": (arguments.noise, arguments.noise)} if arguments.noise else {}
    more |= {"restoration": "blind"} if arguments.loss != "images" else {}
    return DesignSettings.of(named, **more)


def learn(settings: DesignSettings, world: WaveCameraConfig, train: Pictures, folder: Path, label: str) -> WaveCamera:
    """A learned camera, trained as far as is left, with a bar."""
    S = spectrum(periodic(train, settings.size))
    try:
        camera, run = begin(
            settings,
            world,
            S,
            folder,
            pictures=digest(train.samples),
            progress=lambda given: progress(given, "start", what=label),
        )
        bar, last = None, None
        for step, record in learn_element(camera, train, settings, run):
            bar = bar or progress(settings.steps, what=label, initial=step)
            bar.set_postfix_str(f"loss {record['loss']:.6f}", refresh=False)
            bar.update()
            last = record
    except (NotFinite, OtherSettings) as error:
        raise CommandError(str(error)) from error
    if bar is None:
        say(f"{label}: finished before, nothing to learn")
    else:
        bar.close()
        say(f"{label}: loss {last['loss']:.6f} after {settings.steps} steps")
    return camera


def training_pictures(arguments: argparse.Namespace, leaves: str) -> Pictures:
    """Those of --data, else leaves of this content."""
    made = {"size": WIDE // 2, "seed": arguments.seed or 0, "smallest": LEAVES[leaves]}
    return pictures_of(arguments, WIDE // 2, lambda: dead_leaves(LEAF_COUNT, **made))[0]
