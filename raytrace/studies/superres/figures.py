"""The figure of super-resolution."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from raytrace.plotting.style import array, new_figure, styled
from raytrace.studies.figures import picture
from raytrace.studies.superres.discover_report import Discovered
from raytrace.studies.superres.report import Superresolution

_SHOWN = 64  # pixels of a full-frame picture, of its 96 that are not mirrored


@styled
def superres_figure(found: Superresolution) -> Figure:
    """Pictures of the first camera as restored, with PSNR, and the kernels behind them, in the middle colour.

    Above, of the full frame: bicubic, MMSE, learned; below, of the small scene: bicubic, MMSE, jointly.
    """
    block = found.blocks[0]
    drawn, colour = block.drawn, len(block.wavelengths) // 2
    figure = new_figure(9.2, 4.1)
    axes = figure.subplots(2, 6)
    corner = slice(0, _SHOWN)
    picture(axes[0, 0], array(drawn["picture"])[corner, corner], "picture")
    picture(axes[1, 0], array(drawn["scene"]), "scene on dark ground")
    small = [*block.small.rows[:2], drawn["row"]]
    for panels, rows, cut in ((axes[0, 1:4], block.full.rows, corner), (axes[1, 1:4], small, slice(None))):
        for ax, row in zip(panels, rows, strict=True):
            picture(ax, array(row.estimate[0, colour])[cut, cut], f"{row.name}\n{row.psnr:.1f} dB")
    for ax, name in zip(axes[0, 4:], ("plain lens", "learned"), strict=True):
        kernel = array(drawn[name][colour])
        middle = slice(len(kernel) // 2 - 10, len(kernel) // 2 + 11)
        _kernel(ax, kernel[middle, middle], f"PSF: {name}\n21 × 21 pixels")
    plate = array(drawn["plate"][colour])
    _kernel(axes[1, 4], plate, f"PSF: plate\n{len(plate)} × {len(plate)} pixels")
    picture(
        axes[1, 5], array(drawn["sensor"][colour]), "the sensor behind it", top=float(drawn["sensor"][colour].max())
    )
    return figure


def _kernel(ax: Axes, values: np.ndarray, title: str, *, decades: int = 4) -> None:
    top = float(values.max())
    least = 10.0**-decades * top
    picture(ax, np.maximum(values, least), title, top=None, vmin=None, cmap="magma", norm=LogNorm(least, top))


@styled
def discover_figure(found: Discovered) -> Figure:
    """Kernels of every plate in the middle colour, a line for each camera, circles where the scene is shown."""
    cameras = found.cameras
    columns = max(len(found.lines(colours)) for colours in cameras)
    figure = new_figure(1.32 * columns, 1.75 * len(cameras) + 0.2)
    axes = figure.subplots(len(cameras), columns, squeeze=False)
    for line, colours in zip(axes, cameras, strict=True):
        own = [one for one in found.plates if one.colours == colours]
        for ax, one in zip(line, own, strict=False):
            kernel = array(one.found.kernel[len(one.found.kernel) // 2])
            title = one.found.start.replace(", ", ",\n").replace("waves RMS", "waves")
            _kernel(ax, kernel, f"{title}\n{one.found.after:.1f} dB", decades=3)
            half = kernel.shape[-1] // 2
            for place in one.found.places:
                ax.plot(half + place.column, half + place.row, "o", ms=9, mfc="none", mec="white", mew=0.8)
        line[0].set_ylabel(colours, fontsize=8)
    return figure
