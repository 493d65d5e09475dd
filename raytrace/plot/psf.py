"""Point spread functions as pictures: one panel a kernel, object distances from left to right."""

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from raytrace.plot.style import GREY, INK, array, new_figure, styled
from raytrace.psf import Psf


@styled
def psf_grid(found: Psf, object_distances: Sequence[float], labels: Sequence[str], *, title: str = "") -> Figure:
    """Kernels over object distance (columns) and field (rows, named by `labels`), each on its own brightness scale.

    Below each kernel: the energy inside its window (or the energy it was normalised by), and its peak.
    """
    rows, columns = len(labels), len(object_distances)
    figure = new_figure(max(3.2, 1.55 * columns + 0.5), 1.85 * rows + 0.75)
    axes = figure.subplots(rows, columns, squeeze=False)
    kernels, energy = array(found.kernel), array(found.energy)
    width = 1000 * float(found.grid.pitch) * found.grid.columns
    half = 0.5 * width
    for row, label in enumerate(labels):
        for column, distance in enumerate(object_distances):
            panel, kernel = axes[row][column], kernels[column, row]
            panel.imshow(kernel, origin="lower", cmap="magma", vmin=0.0, extent=(-half, half, -half, half))
            panel.set_xticks([])
            panel.set_yticks([])
            for spine in panel.spines.values():
                spine.set_visible(True)
                spine.set_color(GREY)
            panel.set_xlabel(f"energy {energy[column, row]:.3f}, peak {kernel.max():.3g}", fontsize=7, color=GREY)
            if row == 0:
                panel.set_title(_distance(distance), color=INK)
            if column == 0:
                panel.set_ylabel(label)
    figure.suptitle(title, fontweight="bold", fontsize=10)
    pixels = f"{found.grid.columns} × {found.grid.rows} pixels of {1000 * float(found.grid.pitch):g} µm"
    figure.supxlabel(
        f"window {width:g} µm, {pixels}; each panel from black (0) to its own peak",
        fontsize=7.5,
        color=GREY,
    )
    return figure


def _distance(millimetres: float) -> str:
    if math.isinf(millimetres):
        return "object at ∞"
    return f"{millimetres / 1000:g} m" if millimetres >= 1000 else f"{millimetres:g} mm"
