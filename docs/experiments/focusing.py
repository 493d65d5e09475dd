"""Focusing: a flat plate of free heights becomes a lens, or a collimator, by optimisation on images alone.

    python docs/experiments/focusing.py --plot docs/wave/focus.png

    loss = mean (picture * PSF - picture)²        over dead leaves, a draw of its own at every step

A height is the phase at the middle of its pixel: between them the field is that of the samples, as of a polished
surface. Flat pixels would lose what a lens bends across each of them; the record says how much.
"""

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from torch import Tensor

from raytrace.cli.options import json, plot
from raytrace.cli.progress import progress
from raytrace.cli.runner import CommandError, present, refuse_suffix
from raytrace.cli.settings import SEED, add_options
from raytrace.cli.types import count, output_file
from raytrace.cli.wave_options import camera, feature, light, pixels
from raytrace.imaging.image import blur, visible
from raytrace.imaging.pictures import Pictures, crop, dead_leaves
from raytrace.imaging.variables import PhaseVariables
from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import index
from raytrace.maths.result import Result
from raytrace.maths.sampling import grid
from raytrace.plotting.style import GREY, array, field_colour, framed, new_figure, number_text, styled
from raytrace.plotting.style import save as save_figure
from raytrace.psf_models.dft import phasor
from raytrace.settings import Settings
from raytrace.shards import torch_threads
from raytrace.tracing.scene import Memo
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import Aim, aim, ideal
from raytrace.wave_optics.element import Element, Pixels, height
from raytrace.wave_optics.element_files import write_element
from raytrace.wave_optics.height_maps import FORMATS
from raytrace.wave_optics.plan import Plan
from raytrace.wave_optics.plan import plan as plan_of
from raytrace.wave_optics.pupil import disc_cells
from raytrace.wave_optics.scene import WaveScene, millimetres, residual

#: Rates of learning by method, on the phase in radians.
RATES = {"sgd": 2e4, "adam": 0.3}
_ACROSS = 8  # samples along a flat pixel, where that is asked for


@dataclasses.dataclass(frozen=True)
class Setting(Settings):
    """What is learned. Lengths mm, wavelength µm.

    diameter: of the aperture; distance: to the sensor, or of a collimator from the point source; samples: heights
    across; pixel, size: of the window of the PSF, odd; patch: pixels of an image; batch: images a step.
    collimator: the point stands at the front focus, and what comes out is looked at by a perfect lens of that focus.
    """

    diameter: float = 1.0
    distance: float = 25.0
    wavelength: float = 0.55
    samples: int = 128
    pixel: float = 0.004
    size: int = 65
    patch: int = 64
    batch: int = 4
    method: str = "sgd"
    rate: float | None = None
    collimator: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """One moment of learning. heights: (N, N) mm; kernel: (size, size); picture, image: (patch, patch)."""

    step: int
    peak_ratio: float
    heights: Tensor
    kernel: Tensor
    picture: Tensor
    image: Tensor


@dataclasses.dataclass(frozen=True, eq=False)
class Learned(Result):
    """What became of the plate. peak_ratios: before the first step, then after each; losses: of each step.

    flat_ratio: the peak ratio if pixels are flat, and flat_bound that of the best flat pixels, those of the ideal lens;
    residual: RMS phase that is left in the aperture, waves; frames: of the steps asked for, then the ideal lens as one
    of step -1; seconds, processor_seconds: what learning took.
    """

    setting: Setting
    peak_ratios: tuple[float, ...]
    losses: tuple[float, ...]
    flat_ratio: float
    flat_bound: float
    residual: float
    element: Element
    frames: tuple[Frame, ...]
    seconds: float
    processor_seconds: float

    def document(self) -> dict:
        return {
            "peak_ratio": self.peak_ratios[-1],
            "initial_peak_ratio": self.peak_ratios[0],
            "steps": self.steps,
            "residual_waves": self.residual,
            "flat_pixels_peak_ratio": self.flat_ratio,
            "flat_pixels_best": self.flat_bound,
            "method": self.setting.method,
            "collimator": self.setting.collimator,
            "loss": self.losses[-1] if self.losses else None,
            "seconds": self.seconds,
            "processor_seconds": self.processor_seconds,
        }

    def __str__(self) -> str:
        return (
            f"{self.title}\nfrom {self.peak_ratios[0]:.4f} in {self.steps} steps, {self.seconds:.1f} s\n"
            f"residual phase: {self.residual:.4f} waves RMS\n"
            f"peak with the height constant over each pixel: {self.flat_ratio:.3f}; the most that such pixels can "
            f"reach: {self.flat_bound:.3f}"
        )

    def plot(self, path: str | None = None) -> Figure:
        """The figure, also saved under `path`."""
        figure = focus_figure(self)
        if path is not None:
            save_figure(figure, path)
        return figure

    def save(self, path: str) -> None:
        """The height map, in the format of the suffix."""
        write_element(self.element, path, design_wavelength=self.setting.wavelength)

    @property
    def title(self) -> str:
        goal = "collimate" if self.setting.collimator else "focus"
        heights, peak = f"{self.setting.samples}² heights", f"{self.peak_ratios[-1]:.3f}"
        return f"A flat plate learns to {goal}: {heights}, peak {peak} of the ideal lens's"

    @property
    def steps(self) -> int:
        return len(self.losses)

    @property
    def wave(self) -> float:
        """Height in mm that delays the light by one wave."""
        return 2 * math.pi * radian(self.setting)


def learn_to_focus(
    setting: Setting,
    *,
    steps: int = 300,
    enough: float = 0.999,
    frames: Sequence[int] = (),
    progress: Callable[[int, float], object] = lambda step, ratio: None,
) -> Learned:
    """Learn by SGD with Nesterov's momentum of 0.5 or by Adam, until the peak is `enough` of the ideal lens's.

    frames: steps (0: before the first) of which pictures are kept, beside the last. progress: (step, peak ratio).
    Raises ValueError for a window whose size is not odd, which has no pixel at its middle.
    """
    if setting.size % 2 == 0:
        raise ValueError(f"a window of {setting.size} pixels has no pixel at its middle: expected an odd size")
    torch.optim.SGD([torch.zeros(1)], 1.0)  # torch loads its compiler with the first optimiser: no part of learning
    began, busy = time.perf_counter(), time.process_time()
    variables = PhaseVariables(plate(setting), unit=radian(setting), others=_behind(setting))
    plan, memo = sampled(setting, variables()), Memo()
    best = best_kernel(setting)
    leaves = dead_leaves(8, size=2 * (setting.patch + setting.size), seed=setting.seed, smallest=1.5)
    optimizer = _optimizer(setting, variables)
    ratios, losses, kept = [], [], []
    for step in range(steps + 1):
        kernel = psf(scene_of(setting, variables()), plan=plan, memo=memo).kernel[0, 0]
        ratios.append(float((kernel.max() / best.max()).detach()))
        progress(step, ratios[-1])
        last = step == steps or ratios[-1] >= enough
        if last or step in frames:
            kept.append(_frame(setting, step, ratios[-1], variables.numbers(), kernel, leaves))
        if last:
            break
        picture = draw(leaves, setting, step)
        loss = (blur(picture, kernel) - visible(picture, kernel.shape)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    with torch.no_grad():
        kept.append(_frame(setting, -1, 1.0, ideal_heights(setting), best, leaves))
        return Learned(
            setting=setting,
            peak_ratios=tuple(ratios),
            losses=tuple(losses),
            flat_ratio=float(_flat_kernel(setting, variables.numbers()).max() / best.max()),
            flat_bound=float(_flat_kernel(setting, ideal_heights(setting)).max() / best.max()),
            residual=residual_phase(setting, variables()),
            element=variables()[0],
            frames=tuple(kept),
            seconds=time.perf_counter() - began,
            processor_seconds=time.process_time() - busy,
        )


# -- the camera --------------------------------------------------------------------------------------------------------


def plate(setting: Setting, heights: Tensor | None = None) -> Element:
    """A plate of fused silica of these heights (N, N) mm, flat by default."""
    count = setting.samples
    heights = torch.zeros(count, count, dtype=torch.float64) if heights is None else heights
    pitch = torch.tensor(setting.diameter / count, dtype=torch.float64)
    return Element(Pixels(heights, pitch), 0.5 * count * pitch, find_glass("F_SILICA"))


def radian(setting: Setting) -> float:
    """Height in mm that delays the light by a radian."""
    return 1e-3 * setting.wavelength / (2 * math.pi * (float(index(find_glass("F_SILICA"), setting.wavelength)) - 1))


def scene_of(setting: Setting, elements: Sequence[Element]) -> WaveScene:
    """A point at infinity before the element; for a collimator the point at its focus, and a lens looks at infinity."""
    number = elements[0].radius.new_tensor
    return WaveScene(
        elements=tuple(elements),
        sensor_distance=number(setting.distance),
        depths=number([setting.distance if setting.collimator else math.inf]),
        wavelengths=number([setting.wavelength]),
        grid=grid(number(setting.pixel), setting.size),
        exact=setting.collimator,
    )


def sampled(setting: Setting, elements: Sequence[Element], across: int = 1) -> Plan:
    """The pupil engine with one sample to each height, or with `across` of them along a flat pixel."""
    count = across * setting.samples
    found = plan_of(scene_of(setting, elements), engine="pupil", samples=count)
    return dataclasses.replace(found, cells="sampled", samples=count, extent=1.0, parts=1)


def best_kernel(setting: Setting) -> Tensor:
    """(size, size) of the ideal continuous lens in the same aperture."""
    return psf(scene_of(setting, (_ideal(setting), *_behind(setting))), tol=1e-6).kernel[0, 0]


def ideal_heights(setting: Setting) -> Tensor:
    """Heights (N, N) mm of that lens in the middles of the pixels, modulo one wave, of the plate's glass."""
    flat = plate(setting)
    pitch, wave = flat.profile.pitch, 2 * math.pi * radian(setting)
    x = (torch.arange(setting.samples, dtype=torch.float64) - 0.5 * (setting.samples - 1)) * pitch
    path = height(_ideal(setting), x.expand(len(x), -1), x[:, None].expand(-1, len(x)))
    turns = path / (1e-3 * setting.wavelength)  # the ideal lens has n - 1 = 1
    return torch.remainder(turns, 1.0) * wave


def residual_phase(setting: Setting, elements: Sequence[Element]) -> float:
    """RMS in waves of what is left of the phase in the aperture, modulo a wave, about the phase of its mean field."""
    scene = scene_of(setting, elements)
    pitch = elements[0].profile.pitch
    x = (torch.arange(setting.samples, dtype=torch.float64) - 0.5 * (setting.samples - 1)) * pitch
    y, x = torch.meshgrid(x, x, indexing="ij")
    turns = residual(scene, x, y)[0, 0] / millimetres(scene)[0]
    light = torch.as_tensor(disc_cells(setting.samples))
    mean = (light * phasor(turns)).sum()
    left = turns - torch.angle(mean) / (2 * math.pi)
    left = left - left.round()
    return float(torch.sqrt((light * left**2).sum() / light.sum()))


def _ideal(setting: Setting) -> Element:
    """The continuous lens that the plate is to become."""
    (lens,) = ideal(_aim(setting))
    return lens


def _behind(setting: Setting) -> tuple[Element, ...]:
    """What looks at the far field of a collimator: a lens without fault that brings plane waves to the sensor."""
    return ideal(_aim(setting)) if setting.collimator else ()


def _aim(setting: Setting) -> Aim:
    return aim(
        radius=0.5 * setting.diameter,
        sensor=setting.distance,
        focus=math.inf,
        wavelength=setting.wavelength,
        exact=setting.collimator,
    )


def _flat_kernel(setting: Setting, heights: Tensor) -> Tensor:
    """The kernel of heights whose pixels are flat, by so many samples across each as tell it from that."""
    elements = (plate(setting, heights), *_behind(setting))
    return psf(scene_of(setting, elements), plan=sampled(setting, elements, _ACROSS)).kernel[0, 0]


# -- pictures ----------------------------------------------------------------------------------------------------------


def draw(leaves: Pictures, setting: Setting, step: int) -> Tensor:
    """Pictures (batch, P, P) of a step, in [0, 1], keyed by it: the margin of the kernel around each patch."""
    size = setting.patch + setting.size - 1
    crops = [
        crop(leaves, sample, epoch=step, size=size, crops=setting.batch, seed=setting.seed)
        for sample in range(setting.batch)
    ]
    return torch.as_tensor(np.stack(crops), dtype=torch.float64)


def _frame(setting: Setting, step: int, ratio: float, heights: Tensor, kernel: Tensor, leaves: Pictures) -> Frame:
    picture = draw(leaves, setting, 0)[0]
    image = blur(picture, kernel)
    return Frame(step, ratio, *(t.detach().clone() for t in (heights, kernel, visible(picture, kernel.shape), image)))


def _optimizer(setting: Setting, variables: PhaseVariables) -> torch.optim.Optimizer:
    rate = setting.rate or RATES[setting.method]
    if setting.method == "adam":
        return torch.optim.Adam(variables.parameters(), rate)
    return torch.optim.SGD(variables.parameters(), rate, momentum=0.5, nesterov=True)


# -- figure ------------------------------------------------------------------------------------------------------------


@styled
def focus_figure(found: Learned) -> Figure:
    """How a plate became a lens: height, PSF and image after some steps, the ideal lens beside them; and the curve."""
    frames, setting = found.frames, found.setting
    figure = new_figure(1.45 * len(frames) + 0.9, 6.6)
    layout = figure.add_gridspec(4, len(frames), height_ratios=(1, 1, 1, 0.85))
    axes = np.array([[figure.add_subplot(layout[r, c]) for c in range(len(frames))] for r in range(3)])
    top = float(frames[-1].kernel.max())
    wave = 1e6 * found.wave
    for column, frame in enumerate(frames):
        heights, kernel = 1e6 * array(frame.heights), array(frame.kernel)
        half = 0.5 * setting.samples - 0.5
        outside = np.hypot(*np.ogrid[-half : half + 1, -half : half + 1]) > 0.5 * setting.samples
        # A whole wave more or less is the same lens, and so is any height that all have in common.
        middle = heights[setting.samples // 2, setting.samples // 2]
        axes[0][column].imshow(
            np.where(outside, np.nan, (heights - middle) % wave), origin="lower", cmap="twilight", vmin=0, vmax=wave,
            interpolation="nearest",
        )  # fmt: skip
        axes[1][column].imshow(
            np.maximum(kernel, 1e-6 * top), origin="lower", cmap="magma", norm=LogNorm(1e-5 * top, top, clip=True)
        )
        axes[2][column].imshow(array(frame.image), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes[0][column].set_title("ideal lens" if frame.step < 0 else f"step {frame.step}")
        axes[1][column].set_xlabel(f"peak {number_text(frame.peak_ratio, 3)}", fontsize=7.5, color=GREY)
    for panel in axes.flat:
        framed(panel)
    for row, label in enumerate((f"height, 0 … {wave:.0f} nm", "PSF, logarithmic", "image")):
        axes[row][0].set_ylabel(label)
    _course(figure.add_subplot(layout[3, :]), found)
    figure.suptitle(found.title, fontweight="bold", fontsize=10)
    return figure


def _course(panel: Axes, found: Learned) -> None:
    """Peak ratio and loss over the steps."""
    panel.plot(found.peak_ratios, color=field_colour(0), linewidth=1.3)
    panel.axhline(1, color=GREY, linewidth=0.6)
    panel.set(xlabel="step", ylim=(0, 1.05), xlim=(0, max(1, found.steps)))
    panel.set_ylabel("peak / ideal peak", color=field_colour(0))
    loss = panel.twinx()
    loss.plot(np.arange(len(found.losses)), found.losses, color=field_colour(2), linewidth=1.0)
    if found.losses and max(found.losses) > 10 * min(found.losses) > 0:  # a decade, so that the axis has numbers
        loss.set_yscale("log")
        loss.yaxis.set_minor_formatter(NullFormatter())
    loss.set_ylabel("mean square error", color=field_colour(2))
    loss.spines["right"].set_visible(True)


# -- the script --------------------------------------------------------------------------------------------------------

_SHOWN = (0, 5, 10, 20, 40, 80, 160)  # steps that the figure shows


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--collimator", action="store_true", help="the other way round: a point at the front focus, a plane wave out"
    )
    for add in (
        camera(exact=False, aperture=1.0, sensor=25.0),
        light(depths=(), wavelengths=(0.55,)),
        pixels(size=65, pixel=0.004),
        feature("the aperture over --samples"),
    ):
        add(parser)
    parser.add_argument("--method", choices=("sgd", "adam"), default="sgd", help="SGD with momentum (default), or Adam")
    parser.add_argument("--steps", metavar="N", type=count, default=300, help="at most (default 300)")
    parser.add_argument(
        "--samples", metavar="N", type=count, default=128, help="heights across the aperture (default 128)"
    )
    add_options(parser, {"seed": 0}, {"seed": SEED})
    json(parser)
    what = "height map to write: .npy, .csv, .dat, .grd, or as the grey of a picture: .png, .tif"
    parser.add_argument("-o", "--output", metavar="FILE", type=output_file, help=what)
    plot("height map, PSF and image over the steps")(parser)


def focus(arguments: argparse.Namespace) -> Learned:
    """A flat plate becomes a lens."""
    refuse_suffix("-o", arguments.output, tuple(FORMATS))
    if len(arguments.wavelengths) > 1:
        raise CommandError("--wavelength: a lens is learned at one wavelength")
    across, feature = arguments.aperture, arguments.feature or arguments.aperture / arguments.samples
    if arguments.feature and feature > 0.5 * across:
        raise CommandError(f"--feature {feature:g}: wider than half of the aperture of {across:g} mm")
    setting = Setting.of(
        vars(arguments),
        diameter=across,
        distance=arguments.sensor,
        wavelength=arguments.wavelengths[0],
        samples=round(across / feature),
    )
    # Arrays are small: a second thread would only wait.
    with torch_threads(1), progress(arguments.steps, what="learning") as bar:

        def show(step: int, ratio: float) -> None:
            bar.set_postfix_str(f"peak {ratio:.3f} of the ideal lens's")
            bar.update(min(1, step))

        return learn_to_focus(setting, steps=arguments.steps, frames=_SHOWN, progress=show)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args(argv)
    present(focus(arguments), arguments)


if __name__ == "__main__":
    sys.exit(main())
