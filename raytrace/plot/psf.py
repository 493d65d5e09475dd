"""Point spread functions as pictures: one panel a kernel, object distances from left to right."""

import math
import textwrap
from collections.abc import Sequence

from matplotlib.figure import Figure

from raytrace.analysis import Comparison
from raytrace.plot.style import GREY, INK, array, new_figure, styled
from raytrace.psf import Psf


@styled
def psf_grid(found: Psf, object_distances: Sequence[float], labels: Sequence[str], *, title: str = "") -> Figure:
    """Kernels over object distance (columns) and field (rows, named by `labels`), each on its own brightness scale.

    Below each kernel: the energy inside its window (or the energy it was normalised by), and its peak.
    """
    energy, kernels = array(found.energy).T, array(found.kernel).swapaxes(0, 1)
    notes = [
        [f"energy {e:.3f}, peak {kernel.max():.3g}" for e, kernel in zip(*row, strict=True)]
        for row in zip(energy, kernels, strict=True)
    ]
    return _panels(kernels, found, object_distances, labels, notes, title)


@styled
def model_grid(found: Comparison, *, title: str = "") -> Figure:
    """Kernels over object distance (columns) and model (rows, with the number of its rays).

    Below each kernel: its energy inside the window, and its relative L1 difference from the last row, the reference.
    """
    kernels = [array(one.kernel)[:, 0] for one in found.psfs]
    notes = [
        [
            f"energy {k.sum():.2f}" + (f",  Δ {d:.2f}" if one is not kernels[-1] else "")
            for k, d in zip(one, row, strict=True)
        ]
        for one, row in zip(kernels, array(found.difference), strict=True)
    ]
    labels = [
        f"{name}\n" + (f"({one.rays} rays)" if one.rays else "")
        for name, one in zip(found.models, found.psfs, strict=True)
    ]
    remark = f"Δ: relative L¹ difference from {found.models[-1]}"
    return _panels(kernels, found.psfs[-1], found.object_distances.tolist(), labels, notes, title, remark)


def _panels(kernels, found: Psf, distances, labels, notes, title: str, remark: str = "") -> Figure:
    """Kernels[row][column] with a note below each, the distances above and the labels on the left."""
    rows, columns = len(labels), len(distances)
    figure = new_figure(max(3.2, 1.55 * columns + 0.5), 1.85 * rows + 0.75)
    axes = figure.subplots(rows, columns, squeeze=False)
    width = 1000 * float(found.grid.pitch) * found.grid.columns
    height = 1000 * float(found.grid.pitch) * found.grid.rows
    extent = (-0.5 * width, 0.5 * width, -0.5 * height, 0.5 * height)
    for row, label in enumerate(labels):
        for column, distance in enumerate(distances):
            panel, kernel = axes[row][column], kernels[row][column]
            panel.imshow(kernel, origin="lower", cmap="magma", vmin=0.0, extent=extent)
            panel.set_xticks([])
            panel.set_yticks([])
            for spine in panel.spines.values():
                spine.set_visible(True)
                spine.set_color(GREY)
            panel.set_xlabel(notes[row][column], fontsize=7, color=GREY)
            if row == 0:
                panel.set_title(_distance(distance), color=INK)
            if column == 0:
                panel.set_ylabel(label)
    figure.suptitle(_filled(title, figure, 10), fontweight="bold", fontsize=10)
    pixels = f"{found.grid.columns} × {found.grid.rows} pixels of {1000 * float(found.grid.pitch):g} µm"
    said = [f"window {width:g} µm, {pixels}; each panel from black (0) to its own peak", remark]
    figure.supxlabel("\n".join(_filled(line, figure, 7.5) for line in said if line), fontsize=7.5, color=GREY)
    return figure


def _filled(text: str, figure: Figure, size: float) -> str:
    """A text in lines as wide as the figure; a letter is about 0.62 of its size (points) wide."""
    return textwrap.fill(text, int(72 * figure.get_figwidth() / (0.62 * size)))


def _distance(millimetres: float) -> str:
    if math.isinf(millimetres):
        return "object at ∞"
    return f"{millimetres / 1000:g} m" if millimetres >= 1000 else f"{millimetres:g} mm"
