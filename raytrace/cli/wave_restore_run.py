"""`raytrace wave restore`: images restored by the depth-invariant Wiener filter of a camera with a phase element."""

import argparse
import dataclasses
from pathlib import Path

import torch
from torch import Tensor

from raytrace.cli.run import CommandError, catalogs, say
from raytrace.imaging.image import blur
from raytrace.imaging.restoration import depth_invariant_wiener, power_law, psnr, restore
from raytrace.imaging.wave_camera import WaveCameraConfig, kernels, transfer
from raytrace.io.pictures import read_channels, write_picture
from raytrace.maths.result import Result
from raytrace.wave_optics.compute import elements
from raytrace.wave_optics.element import Element


@dataclasses.dataclass(frozen=True)
class Restored(Result):
    """Restored images, a record each: file, restored, and of simulated ones psnr_image and psnr_restored in dB."""

    records: tuple[dict, ...]

    def document(self) -> dict:
        return {"images": list(self.records)}

    def __str__(self) -> str:
        return "\n".join(
            f"{record['file']}: {record['restored']}"
            + (
                f", PSNR of the image {record['psnr_image']:.2f} dB, restored {record['psnr_restored']:.2f} dB"
                if "psnr_image" in record
                else ""
            )
            for record in self.records
        )


@torch.no_grad()
def restored(
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
    spectrum = power_law(shape, mean=float(image.mean()), deviation=max(float(image.std()), config.noise))
    return image, restore(image, depth_invariant_wiener(H, spectrum, config.noise), boundary="taper")


def restore_files(arguments: argparse.Namespace) -> Restored:
    """Restore every image and write it as .png in the folder."""
    if arguments.size % 2 == 0:
        raise CommandError(f"--size {arguments.size}: a window needs a pixel at its middle; take an odd number")
    config = WaveCameraConfig(
        radius=0.5 * arguments.aperture,
        sensor_distance=arguments.sensor,
        depths=tuple(arguments.depths),
        design=arguments.focus,
        wavelengths=tuple(sorted(arguments.wavelengths)),
        pixel=arguments.pixel,
        size=arguments.size,
        noise=arguments.noise,
        exact=arguments.exact,
    )
    names = ("aperture", "sensor", "focus", "design_wavelength", "levels", "exact", "glass", "index", "pitch", "span")
    named = {name: getattr(arguments, name) for name in names}
    parts = elements(arguments.element, wavelengths=config.wavelengths, catalog=catalogs(arguments), **named)
    folder, records = Path(arguments.folder), []
    folder.mkdir(parents=True, exist_ok=True)
    for file in arguments.images:
        channels = torch.as_tensor(read_channels(file, len(config.wavelengths))).flip(0)  # the shortest first
        if min(channels.shape[-2:]) < 2:
            raise CommandError(f"{file}: an image of {channels.shape[-1]} × {channels.shape[-2]} pixels is too small")
        captured, estimate = restored(channels, parts, config, simulate=arguments.simulate, seed=arguments.seed)
        path = folder / f"{Path(file).stem}.png"
        write_picture(path, estimate.flip(0).clamp(0, 1).numpy())
        record = {"file": file, "restored": str(path)}
        if arguments.simulate is not None:
            write_picture(folder / f"{Path(file).stem}_image.png", captured.flip(0).clamp(0, 1).numpy())
            for name, picture in (("psnr_image", captured), ("psnr_restored", estimate)):
                record[name] = float(psnr((picture - channels).square().mean()))
        records.append(record)
        say(f"written: {path}")
    return Restored(tuple(records))
