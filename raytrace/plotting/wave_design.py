"""Figure of a designed phase element: its heights, its PSFs over depth and wavelength, its PSNR over depth."""

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from raytrace.imaging.wave_camera import ElementReport, WaveCameraConfig, depth_text
from raytrace.plotting.style import FIELD_COLOURS, array, new_figure, styled, wavelength_colours
from raytrace.wave_optics.compute import ElementPsf
from raytrace.wave_optics.element import Element, height

_MARGIN = 1e-5  # of the brightest pixel, shown black


@styled
def element_figure(judged: ElementReport) -> Figure:
    """Height over the radius, kernels over depth × colour, PSNR over depth, of one element."""
    own, config = judged.quality, judged.config
    figure = new_figure(9.2, 7.0)
    top, bottom = figure.subfigures(2, 1, height_ratios=(1, 1.75))
    profile, quality = top.subplots(1, 2)
    _draw_profile(profile, judged.elements)
    dioptres = [1e3 / depth for depth in config.depths]
    for filter, mark in (("wiener", "o--"), ("blind", "s-")):
        label = "Wiener, 1 m kernel" if filter == "wiener" else "best depth-invariant filter"
        quality.plot(dioptres, own.by_depth[filter], mark, ms=4, label=label, color=FIELD_COLOURS[filter == "blind"])
    mark_depths(quality, config)
    quality.set(xlabel="object distance", ylabel="PSNR (dB)")
    quality.legend(fontsize=8)
    _draw_kernels(bottom, judged.kernels)
    return figure


def _draw_profile(axes: Axes, elements: Sequence[Element]) -> None:
    radius = float(elements[0].radius)
    r = torch.linspace(0, radius * (1 - 1e-9), 4000, dtype=elements[0].radius.dtype)
    for number, element in enumerate(elements):
        h = height(element, r, torch.zeros_like(r)).detach()
        axes.plot(array(r), 1e3 * array(h - h.min()), lw=0.9, color=FIELD_COLOURS[number % 3], label=element.glass.name)
    axes.set(xlabel="radius (mm)", ylabel="height (µm)", title="element")
    axes.legend(fontsize=8)


def _draw_kernels(figure, found: ElementPsf) -> None:
    kernel = array(found.kernel.detach())
    D, W = kernel.shape[:2]
    axes = figure.subplots(W, D, squeeze=False)
    colours = wavelength_colours(found.wavelengths.tolist())
    half = 1e3 * float(found.pitch) * kernel.shape[-1] / 2
    for w in range(W):
        most = kernel[:, w].max()
        for d in range(D):
            panel = axes[w, d]
            logarithm = np.log10(np.maximum(kernel[d, w] / most, _MARGIN))
            panel.imshow(logarithm, cmap="inferno", vmin=np.log10(_MARGIN), vmax=0, extent=(-half, half, -half, half))
            panel.set(xticks=[], yticks=[])
            if w == 0:
                panel.set_title(depth_text(float(found.depths[d]), "∞"), fontsize=9)
            if d == 0:
                panel.set_ylabel(f"{1e3 * float(found.wavelengths[w]):.0f} nm", color=colours[w], fontsize=9)
    figure.supxlabel(
        f"PSFs, {2 * half:.0f} µm across; logarithmic, five decades down from the brightest pixel of a row", fontsize=8
    )


def mark_depths(axes: Axes, config: WaveCameraConfig) -> None:
    """Near objects on the left, even in dioptres."""
    axes.set_xticks([1e3 / depth for depth in config.depths], [depth_text(depth, "∞") for depth in config.depths])
    axes.invert_xaxis()
