"""Speed of pictures through a lens, and their error against direct superposition.

A step of training renders eight colour patches through a Cooke triplet, forward and backward by all of its curvatures
and air spaces. A picture of 12 megapixels is rendered with a PSF that varies over the field; in the middle, at an edge
and in a corner its pixels are compared with the sum over all points of the scene, each with the kernel of its place.
"""

import dataclasses
import math
import resource
import statistics
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.analysis.focus_report import focus
from raytrace.bench.measure import clock
from raytrace.bench.report import Measured, Request, in_words
from raytrace.cli.progress import progress
from raytrace.imaging.field_kernels import FieldKernels
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.render import ImageFormation, enlarged, optics, render_patches
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.variables import Variables
from raytrace.io import read_lens
from raytrace.pages import digits, listing, significant
from raytrace.plotting.style import new_figure, styled
from raytrace.system.lens import Lens

#: Patches of a step, pixels of their side and of the window, and their radii from the axis over the half diagonal.
PATCHES, SIDE, WINDOW = 8, 128, 51
RADII = 0.0, 0.7, 1.0
STEP_SENSOR = Sensor((18.0, 13.5), (3600, 2700), response="rgb")
SENSOR = Sensor((18.0, 13.5), (4096, 3072), response="rgb")
TOLERANCES = 1e-2, 1e-3
_CROP = 12  # pixels of a side that are compared


@dataclasses.dataclass(frozen=True)
class Row:
    """One measurement. what: the work; error: relative L1 against direct superposition, the largest of three places."""

    what: str
    tol: float | None
    kernels: str
    prepared: float | None
    seconds: float
    gigabytes: float
    error: float | None = None


COLUMNS = {
    "work": lambda row: row.what,
    "tolerance": lambda row: digits(row.tol, none="–"),
    "kernels": lambda row: row.kernels,
    "to prepare, s": lambda row: significant(row.prepared),
    "s": lambda row: significant(row.seconds),
    "peak memory, GB": lambda row: significant(row.gigabytes),
    "error": lambda row: digits(row.error, none="–"),
}


def triplet() -> Lens:
    return focus(read_lens("cooke_triplet")).lens


def step(lens: Lens) -> Callable[[], None]:
    """A step of training: its patches rendered, and the gradient of their mean square."""
    variables, draws = Variables(lens, "curvature thickness"), torch.Generator().manual_seed(0)
    patches = torch.rand(PATCHES, 3, SIDE, SIDE, generator=draws)
    radius = STEP_SENSOR.half_diagonal * torch.tensor(RADII, dtype=torch.float64).repeat(PATCHES)[:PATCHES]
    angle = 2 * math.pi * torch.rand(PATCHES, dtype=torch.float64, generator=draws)
    points = radius * torch.stack([torch.sin(angle), torch.cos(angle)])

    def run() -> None:
        variables.zero_grad()
        images = render_patches(variables(), patches, points, sensor=STEP_SENSOR, size=WINDOW, order=4)
        images.square().mean().backward()

    return run


def scene() -> Tensor:
    """A colour picture (3, H, W) of dead leaves in single precision."""
    columns, rows = SENSOR.pixels
    tiles = [torch.as_tensor(dead_leaves(1, size=1024, seed=seed).samples[0]).float() / 255 for seed in range(3)]
    return torch.stack([tile.repeat(math.ceil(rows / 1024), math.ceil(columns / 1024)) for tile in tiles])[
        :, :rows, :columns
    ]


@torch.no_grad()
def direct(lens: Lens, system: ImageFormation, picture: Tensor, top: int, left: int) -> Tensor:
    """Pixels (C, _CROP, _CROP) by superposition: every point of the scene with the kernel of its own place."""
    size, weights = system.kernels.shape[-1], SENSOR.weights(lens.wavelengths)
    half = size // 2
    first_row, first_column, side = top - half, left - half, _CROP + 2 * half
    row, column = torch.meshgrid(*(torch.arange(n, n + side) for n in (first_row, first_column)), indexing="ij")
    inside = (row >= 0) & (row < picture.shape[-2]) & (column >= 0) & (column < picture.shape[-1])
    row, column = row[inside], column[inside]
    distance = lens.surfaces[0].thickness.reshape(1)
    kernels = FieldKernels(lens, SENSOR, "gaussian", system.order, size, distance, weights, nodes=257)
    light = (enlarged(system.flux[0], picture) * picture)[:, row, column].double()
    total = light.new_zeros(3, _CROP, _CROP)
    for some in torch.arange(len(row)).split(512):
        kernel = kernels.at(SENSOR.points(column[some].double(), row[some].double()))[:, 0]
        for k, number in enumerate(some.tolist()):
            # Row i of the kernel lies at row + i - half of the image.
            up, over = top - int(row[number]) + half, left - int(column[number]) + half
            rows = slice(max(up, 0), min(up + _CROP, size))
            columns = slice(max(over, 0), min(over + _CROP, size))
            there = slice(rows.start - up, rows.stop - up), slice(columns.start - over, columns.stop - over)
            total[:, there[0], there[1]] += light[:, number, None, None] * kernel[k, :, rows, columns]
    return total


def error(lens: Lens, system: ImageFormation, picture: Tensor, image: Tensor) -> float:
    """Largest relative L1 error of the image at three places."""
    rows, columns = picture.shape[-2:]
    places = (rows // 2, columns // 2), (rows // 2, columns - _CROP), (rows - _CROP, columns - _CROP)
    errors = []
    for top, left in places:
        exact = direct(lens, system, picture, top, left)
        part = image[:, top : top + _CROP, left : left + _CROP].double()
        errors.append(float((part - exact).abs().sum() / exact.abs().sum()))
    return max(errors)


def bench(request: Request) -> Measured:
    """Steps of training, and pictures of 12 megapixels at two tolerances."""
    repeats, lens, now = request.arguments.repeats, triplet(), clock(request.threads)
    rows, picture = [], scene()
    with progress(repeats + 1 + 2 * len(TOLERANCES), "call", what="measuring") as bar:
        run, seconds = step(lens), []
        run()
        bar.update(1)
        for _ in range(repeats):
            start = now()
            run()
            seconds.append(now() - start)
            bar.update(1)
        what = f"step of {PATCHES} RGB patches of {SIDE}², {len(RADII)} radii, gradients by curvatures and air spaces"
        kernels = f"{PATCHES} of {WINDOW}² pixels"
        rows.append(Row(what, None, kernels, None, statistics.median(seconds), _peak()))
        for tol in TOLERANCES:
            start = now()
            how = {"model": "gaussian", "wavelengths": lens.wavelengths, "distortion": False, "illumination": False}
            system = optics(lens, SENSOR, tol=tol, **how)
            ready = now()
            bar.update(1)
            with torch.no_grad():
                image = system(picture, boundary="zero")
            done = now()
            m, n, *_, size = system.kernels.shape
            kernels = f"{m} × {n} of {size}² pixels"
            what = f"picture of {picture[0].numel() / 1e6:.1f} megapixels, RGB"
            off = error(lens, system, picture, image)
            rows.append(Row(what, tol, kernels, ready - start, done - ready, _peak(), off))
            bar.update(1)
    about = {"repeats": repeats, "machine": request.about()}
    return Measured(rows, report(rows, **about), about, figure)


def _peak() -> float:
    """Largest resident memory of this process so far, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def report(rows: Sequence[Row], *, repeats: int, machine: dict) -> list[str]:
    return [
        "Pictures through a focused Cooke triplet of 101 mm, sensor of 18 × 13.5 mm, three wavelengths, three "
        f"channels, Gaussian DRT. A step: median of {repeats} runs. Pictures: without distortion and illumination; "
        "prepared once for any number of pictures. Error: Σ |y - y₀| / Σ y₀ against direct superposition of the "
        f"kernels of every point, the largest of {_CROP} × {_CROP} pixels in the middle, at an edge and in a corner. "
        "Memory: of the process so far.",
        "",
        *listing(COLUMNS, rows),
        "",
        in_words(machine) + ".",
    ]


@styled
def figure(rows: Sequence[dict]):
    """Seconds of the works."""
    made = new_figure(7.0, 0.6 + 0.5 * len(rows))
    axes = made.subplots()
    names = [row["what"].split(",")[0] + ("" if row["tol"] is None else f", {row['tol']:g}") for row in rows]
    axes.barh(names, [row["seconds"] + (row["prepared"] or 0.0) for row in rows])
    axes.set(xscale="log", xlabel="seconds")
    axes.invert_yaxis()
    return made
