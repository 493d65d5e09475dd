"""Speed of pictures through a lens, and their error against direct superposition.

A step of training renders eight colour patches, forward and backward by all curvatures and thicknesses of the lens. A
picture of 12 megapixels is rendered with a PSF that varies over the field; in the middle, at an edge and in a corner
its pixels are compared with the sum over all points of the scene, each with the kernel of its own field point.
"""

import dataclasses
import math
import resource
import statistics
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

from raytrace.analysis.focus_report import focus
from raytrace.bench.measure import clock
from raytrace.bench.result import Measured, Quantity, clock_name, machine
from raytrace.cli.progress import progress
from raytrace.imaging.field_kernels import FieldKernels
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.render import ImageFormation, default_sensor, enlarged, optics, render_patches
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.variables import Variables
from raytrace.maths.result import Column
from raytrace.system.lens import Lens

#: Patches of a step, pixels of their side and of the window, and their radii from the axis over the half diagonal.
PATCHES, SIDE, WINDOW = 8, 128, 51
RADII = 0.0, 0.7, 1.0
PIXELS = (4096, 3072)
SENSORS = {"cooke_triplet": (18.0, 13.5)}  # (width, height) mm, smaller than the field of the lens
TOLERANCES = 1e-2, 1e-3
_CROP = 12  # pixels of a side that are compared


@dataclasses.dataclass(frozen=True)
class Row:
    """A measurement. prepared, seconds: s; error: relative L1 against direct superposition, the largest of three."""

    what: str
    tol: float | None
    kernels: str
    prepared: float | None
    seconds: float
    gigabytes: float
    error: float | None = None


PRINTED: Mapping[Column, Quantity] = {
    Column("work", form="<"): attrgetter("what"),
    Column("tolerance", form="g"): attrgetter("tol"),
    Column("kernels", form="<"): attrgetter("kernels"),
    Column("prepared", "s", ".3g", "to prepare"): attrgetter("prepared"),
    Column("time", "s", ".3g"): attrgetter("seconds"),
    Column("memory", "GB", ".3g", "peak\nmemory"): attrgetter("gigabytes"),
    Column("error", form=".1e"): attrgetter("error"),
}


def bench(lenses: Mapping[str, Lens], *, repeats: int, threads: int, sensor: tuple[float, float] | None) -> Measured:
    """Steps of training, and pictures of 12 megapixels at two tolerances, through one lens at its best focus.

    sensor: (width, height) mm, by default with the largest field of the lens in the corners.
    """
    ((name, lens),) = lenses.items()
    lens, picture, now = focus(lens).lens, scene(PIXELS), clock(threads)
    chip = default_sensor(lens, picture, size=sensor or SENSORS.get(name), response="rgb")
    rows = []
    with progress(repeats + 1 + len(TOLERANCES), "call", what="measuring") as bar:
        run, seconds = step(lens, chip), []
        run()
        bar.update(1)
        for _ in range(repeats):
            start = now()
            run()
            seconds.append(now() - start)
            bar.update(1)
        what = f"step of {PATCHES} RGB patches of {SIDE}² pixels"
        rows.append(Row(what, None, f"{PATCHES} of {WINDOW}² pixels", None, statistics.median(seconds), _peak()))
        for tol in TOLERANCES:
            start = now()
            system = blur_alone(lens, chip, tol=tol)
            ready = now()
            with torch.no_grad():
                image = system(picture, boundary="zero")
            done = now()
            m, n, *_, size = system.kernels.shape
            kernels = f"{m} × {n} of {size}² pixels"
            what = f"picture of {picture[0].numel() / 1e6:.1f} megapixels, RGB"
            difference = error(lens, system, picture, image)
            rows.append(Row(what, tol, kernels, ready - start, done - ready, _peak(), difference))
            bar.update(1)
    about = {"lens": name, "sensor_mm": chip.size, "repeats": repeats, "machine": machine()}
    notes = (
        f"Lens {name} at its best focus, sensor of {chip.size[0]:.4g} × {chip.size[1]:.4g} mm, "
        f"{len(lens.wavelengths)} wavelengths, three channels, Gaussian DRT; {clock_name(threads)}.",
        f"A step: {len(RADII)} radii, forward and backward by curvatures and thicknesses, median of {repeats} runs. "
        "Pictures: without distortion and illumination; prepared once for any number of pictures.",
        f"Error: Σ |y - y₀| / Σ y₀ against direct superposition of the kernels of every point, the largest of "
        f"{_CROP} × {_CROP} pixels in the middle, at an edge and in a corner. Memory: of the process so far.",
    )
    return Measured(rows, about, PRINTED, notes)


def step(lens: Lens, sensor: Sensor) -> Callable[[], None]:
    """A step of training: its patches rendered, and the gradient of their mean square."""
    variables, draws = Variables(lens, "curvature thickness"), torch.Generator().manual_seed(0)
    patches = torch.rand(PATCHES, 3, SIDE, SIDE, generator=draws)
    radius = sensor.half_diagonal * torch.tensor(RADII, dtype=torch.float64).repeat(PATCHES)[:PATCHES]
    angle = 2 * math.pi * torch.rand(PATCHES, dtype=torch.float64, generator=draws)
    points = radius * torch.stack([torch.sin(angle), torch.cos(angle)])

    def run() -> None:
        variables.zero_grad()
        images = render_patches(variables(), patches, points, sensor=sensor, size=WINDOW, order=4)
        images.square().mean().backward()

    return run


def scene(pixels: tuple[int, int]) -> Tensor:
    """A colour picture (3, H, W) of dead leaves in single precision."""
    columns, rows = pixels
    tiles = [torch.as_tensor(dead_leaves(1, size=1024, seed=seed).samples[0]).float() / 255 for seed in range(3)]
    picture = torch.stack([tile.repeat(math.ceil(rows / 1024), math.ceil(columns / 1024)) for tile in tiles])
    return picture[:, :rows, :columns]


def blur_alone(lens: Lens, sensor: Sensor, **options: Any) -> ImageFormation:
    """The Gaussian blur of the lens at its own wavelengths."""
    options |= {"model": "gaussian", "wavelengths": lens.wavelengths}
    return optics(lens, sensor, distortion=False, illumination=False, **options)


@torch.no_grad()
def direct(lens: Lens, system: ImageFormation, picture: Tensor, top: int, left: int) -> Tensor:
    """Pixels (C, _CROP, _CROP) by superposition: every point of the scene with the kernel of its own field point."""
    sensor = system.sensor
    size, weights = system.kernels.shape[-1], sensor.weights(lens.wavelengths)
    half = size // 2
    first_row, first_column, side = top - half, left - half, _CROP + 2 * half
    row, column = torch.meshgrid(*(torch.arange(n, n + side) for n in (first_row, first_column)), indexing="ij")
    inside = (row >= 0) & (row < picture.shape[-2]) & (column >= 0) & (column < picture.shape[-1])
    row, column = row[inside], column[inside]
    distance = lens.surfaces[0].thickness.reshape(1)
    kernels = FieldKernels(lens, sensor, "gaussian", system.order, size, distance, weights, nodes=257)
    light = (enlarged(system.flux[0], picture) * picture)[:, row, column].double()
    total = light.new_zeros(3, _CROP, _CROP)
    for points in torch.arange(len(row)).split(512):
        kernel = kernels.at(sensor.points(column[points].double(), row[points].double()))[:, 0]
        for k, number in enumerate(points.tolist()):
            # Row i of the kernel lies at row + i - half of the image.
            up, over = top - int(row[number]) + half, left - int(column[number]) + half
            rows = slice(max(up, 0), min(up + _CROP, size))
            columns = slice(max(over, 0), min(over + _CROP, size))
            down, right = slice(rows.start - up, rows.stop - up), slice(columns.start - over, columns.stop - over)
            total[:, down, right] += light[:, number, None, None] * kernel[k, :, rows, columns]
    return total


def error(lens: Lens, system: ImageFormation, picture: Tensor, image: Tensor) -> float:
    """Largest relative L1 error of the image in the middle, at an edge and in a corner."""
    rows, columns = picture.shape[-2:]
    corners = (rows // 2, columns // 2), (rows // 2, columns - _CROP), (rows - _CROP, columns - _CROP)
    errors = []
    for top, left in corners:
        exact = direct(lens, system, picture, top, left)
        part = image[:, top : top + _CROP, left : left + _CROP].double()
        errors.append(float((part - exact).abs().sum() / exact.abs().sum()))
    return max(errors)


def _peak() -> float:
    """Largest resident memory of this process so far, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
