"""How a plate learns to be a lens, as a picture."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from raytrace.plotting.style import GREY, array, field_colour, new_figure, number_text, styled
from raytrace.plotting.wave import framed
from raytrace.studies.focusing.experiment import Learned


@styled
def focus_figure(found: Learned) -> Figure:
    """How a plate became a lens: height, PSF and image after some steps, the ideal lens beside them; and the curve."""
    frames, setting = found.frames, found.setting
    figure = new_figure(1.45 * len(frames) + 0.9, 6.6)
    grid = figure.add_gridspec(4, len(frames), height_ratios=(1, 1, 1, 0.85))
    axes = np.array([[figure.add_subplot(grid[r, c]) for c in range(len(frames))] for r in range(3)])
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
    _course(figure.add_subplot(grid[3, :]), found)
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
