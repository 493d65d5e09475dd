"""The figure of super-resolution."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from raytrace.plot.style import array, new_figure, styled
from raytrace.studies.figures import picture
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


def _kernel(ax: Axes, values: np.ndarray, title: str) -> None:
    top = float(values.max())
    picture(ax, np.maximum(values, 1e-4 * top), title, top=None, vmin=None, cmap="magma", norm=LogNorm(1e-4 * top, top))
