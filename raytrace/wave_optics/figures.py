"""Waves as pictures: kernels over depth and colour, heights, caustics and encircled energy."""

import math
import textwrap
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.sampling import Grid, centres
from raytrace.plotting import style
from raytrace.plotting.style import Axes, Figure, array, framed, new_figure, styled
from raytrace.wave_optics.element import Element, has_features, height, is_smooth
from raytrace.wave_optics.scene import WaveScene

_GAMMA = 0.4  # of brightness in kernels: a haze of a hundredth of the peak is still seen
_DECADES = 4.0  # of light in a caustic
_ACROSS = 700  # points across a disc of heights


class Kernels(Protocol):
    """PSFs of an element, as `wave_optics.compute.ElementPsf` has them."""

    @property
    def kernel(self) -> Tensor: ...
    @property
    def scene(self) -> WaveScene: ...
    @property
    def grid(self) -> Grid: ...
    @property
    def pitch(self) -> Tensor: ...
    @property
    def depths(self) -> Tensor: ...
    @property
    def wavelengths(self) -> Tensor: ...
    @property
    def energy(self) -> Tensor: ...
    @property
    def peak(self) -> Tensor: ...
    @property
    def title(self) -> str: ...


@styled
def psf_figure(psfs: Kernels) -> Figure:
    """Kernels over depth (rows) and wavelength (columns), each from black to its own peak in its own colour.

    With several wavelengths a last column shows them together, as a camera would see a white point: each with its own
    share of the light, on one scale for the row. Below each: the light inside the window and its peak.
    """
    from matplotlib.colors import LinearSegmentedColormap, PowerNorm, to_rgb

    kernels, energy, peak = array(psfs.kernel), array(psfs.energy), array(psfs.peak)
    wavelengths = psfs.wavelengths.tolist()
    colours, together = style.wavelength_colours(wavelengths), len(wavelengths) > 1
    columns, order = len(wavelengths) + together, np.argsort(wavelengths)[::-1]
    place = np.linspace(0, 2, len(order))
    channels = np.stack([np.clip(1 - np.abs(place - c), 0, None) for c in range(3)])  # (3, W)
    shares = channels / channels.sum(1, keepdims=True).clip(1e-9)
    # From black through the colour to white: the peak is white, as on film.
    ramps = [((0.0, to_rgb("black")), (0.72, to_rgb(colour)), (1.0, to_rgb("white"))) for colour in colours]
    maps = [LinearSegmentedColormap.from_list("light", ramp) for ramp in ramps]
    figure = new_figure(max(3.4, 1.75 * columns + 0.6), 1.95 * len(kernels) + 0.8)
    axes = figure.subplots(len(kernels), columns, squeeze=False)
    for row, depth in enumerate(psfs.depths.tolist()):
        for column, wavelength in enumerate(wavelengths):
            panel, kernel = axes[row][column], kernels[row, column]
            norm = PowerNorm(_GAMMA, vmin=0.0, vmax=kernel.max())
            panel.imshow(kernel, origin="lower", cmap=maps[column], norm=norm, interpolation="nearest")
            panel.set_xlabel(
                f"{100 * energy[row, column]:.1f} %, peak {peak[row, column]:.2g}", fontsize=7, color=style.GREY
            )
            if row == 0:
                panel.set_title(f"{1e3 * wavelength:g} nm", color=colours[column])
        if together:
            # The longest wavelengths red, the shortest blue.
            picture = np.tensordot(shares, kernels[row][order], 1)
            bright = np.clip(picture, 0, None) / (picture.max() if picture.max() > 0 else 1)
            image = np.moveaxis(bright**_GAMMA, 0, -1)
            axes[row][-1].imshow(image, origin="lower", interpolation="nearest")
            if row == 0:
                axes[row][-1].set_title("together")
        axes[row][0].set_ylabel(_depth(depth))
    for panel in axes.flat:
        framed(panel)
    pitch = float(psfs.pitch)
    length = style.round_length(0.35 * pitch * psfs.grid.columns)
    style.bar_on_dark(axes[-1][0], 0.06 * psfs.grid.columns, 0.08 * psfs.grid.rows, length, unit=pitch)
    figure.suptitle(psfs.title, fontweight="bold", fontsize=10)
    caption = (
        f"{psfs.grid.columns} × {psfs.grid.rows} pixels of {1e3 * pitch:g} µm; brightness ∝ light^{_GAMMA:g}; "
        "below each: share of the light inside the window, share in the brightest pixel or one on the axis"
    )
    figure.supxlabel(textwrap.fill(caption, int(16 * figure.get_figwidth())), fontsize=7.5, color=style.GREY)
    return figure


@styled
def height_figure(elements: Sequence[Element], *, title: str = "") -> Figure:
    """The fabricated heights of elements in contact, a row for each: the disc, the profile along x, and the rim of an
    element with steps."""
    figure = new_figure(7.6, 3.1 * len(elements))
    grid = figure.add_gridspec(2 * len(elements), 2, width_ratios=(1.15, 1.6))
    for row, element in enumerate(elements):
        above, below = 2 * row, 2 * row + 1
        disc, R = figure.add_subplot(grid[above : below + 1, 0]), float(element.radius)
        line = torch.linspace(-R, R, _ACROSS, dtype=element.radius.dtype)
        y, x = torch.meshgrid(line, line, indexing="ij")
        with torch.no_grad():
            heights = 1e3 * array(height(element, x, y))
        heights[np.hypot(array(x), array(y)) > R] = np.nan
        shown = disc.imshow(heights, origin="lower", extent=(-R, R, -R, R), cmap="cividis", interpolation="nearest")
        kind = f"{element.kind.words}, wrapped" if element.period is not None else element.kind.words
        disc.set(xlabel="x, mm", ylabel="y, mm")
        disc.set_title("; ".join(filter(None, (kind, element.glass.name))), fontsize=8.5)
        figure.colorbar(shown, ax=disc, label="height, µm", shrink=0.85)
        if is_smooth(element):
            whole = figure.add_subplot(grid[above : below + 1, 1])
            _profile(whole, element, -R, R)
            whole.set_xlabel("x, mm")
            continue
        whole, rim = figure.add_subplot(grid[above, 1]), figure.add_subplot(grid[below, 1])
        _profile(whole, element, -R, R)
        feature = float(element.profile.pitch) if has_features(element.profile) else R / 500
        _profile(rim, element, R - min(0.3 * R, 40 * feature), R)
        rim.set_xlabel("x, mm  (above: the whole diameter; here: the rim)")
    figure.suptitle(title, fontweight="bold", fontsize=10)
    return figure


@styled
def caustic_figure(psfs: Kernels, light: Tensor, distances: Tensor, half: float) -> Figure:
    """Light per mm² over the distance behind the element, logarithmic; arguments: of `wave_optics.compute.caustic`.

    A row for each depth, a column for each wavelength; one scale for all; a dashed line at the sensor.
    """
    from matplotlib.colors import LogNorm

    values, z = array(light), array(distances)
    wavelengths, depths = psfs.wavelengths.tolist(), psfs.depths.tolist()
    colours = style.wavelength_colours(wavelengths)
    figure = new_figure(2.5 * len(wavelengths) + 0.9, 2.0 * len(depths) + 0.9)
    axes = figure.subplots(len(depths), len(wavelengths), squeeze=False, sharex=True, sharey=True)
    extent = (z[0], z[-1], -1e3 * half, 1e3 * half)
    norm = LogNorm(values.max() / 10**_DECADES, values.max(), clip=True)
    for row, depth in enumerate(depths):
        for column, wavelength in enumerate(wavelengths):
            panel = axes[row][column]
            shown = panel.imshow(
                values[row, column].T, origin="lower", extent=extent, aspect="auto", norm=norm, cmap="magma",
                interpolation="bilinear",
            )  # fmt: skip
            sensor = float(psfs.scene.sensor_distance)
            panel.axvline(sensor, color="white", linewidth=0.8, linestyle=(0, (4, 3)))
            panel.annotate("sensor", (sensor, 1), (-3, -3), xycoords=("data", "axes fraction"),
                           textcoords="offset points", ha="right", va="top", color="white", fontsize=7)  # fmt: skip
            if row == 0:
                panel.set_title(f"{1e3 * wavelength:g} nm", color=colours[column])
        axes[row][0].set_ylabel(f"{_depth(depth)}\nx, µm")
    figure.colorbar(shown, ax=axes, label="share of the light per mm²", pad=0.01)
    figure.supxlabel("distance behind the element, mm", fontsize=8.5)
    figure.suptitle(psfs.title, fontweight="bold", fontsize=10)
    return figure


@styled
def encircled_figure(psfs: Kernels) -> Figure:
    """Share of the light within a radius of the axis: a panel for each depth, a curve for each wavelength."""
    x, y = (array(line) for line in centres(psfs.grid))
    radius = np.hypot(x, y[:, None]).ravel()
    order = np.argsort(radius, kind="stable")
    edge = 1e3 * float(psfs.pitch) * min(psfs.grid.shape) / 2
    wavelengths, depths = psfs.wavelengths.tolist(), psfs.depths.tolist()
    figure = new_figure(max(3.4, 2.2 * len(depths) + 0.6), 2.6)
    axes = figure.subplots(1, len(depths), sharey=True, squeeze=False)[0]
    for d, (panel, depth) in enumerate(zip(axes, depths, strict=True)):
        for w, colour in enumerate(style.wavelength_colours(wavelengths)):
            held = np.cumsum(array(psfs.kernel[d, w]).ravel()[order])
            line = {"color": colour, "linewidth": 1.2, "label": f"{1e3 * wavelengths[w]:g} nm"}
            panel.plot(np.append(0, 1e3 * radius[order]), np.append(0, held), **line)
        panel.set(title=_depth(depth), xlim=(0, edge), ylim=(0, 1.02), xlabel="radius, µm")
        panel.grid(True, color=style.FAINT, linewidth=0.5)
    axes[0].set_ylabel("share of the light")
    axes[-1].legend(loc="lower right")
    figure.suptitle(psfs.title, fontweight="bold", fontsize=10)
    return figure


def _profile(panel: Axes, element: Element, first: float, last: float) -> None:
    """h(x) at y = 0 as a line."""
    x = torch.linspace(first, last, 4001, dtype=element.radius.dtype)
    with torch.no_grad():
        values = 1e3 * array(height(element, x, torch.zeros_like(x)))
    panel.plot(array(x), values, color=style.field_colour(0), linewidth=0.7)
    panel.set(xlim=(first, last), ylabel="height, µm")
    panel.grid(True, color=style.FAINT, linewidth=0.5)


def _depth(distance: float) -> str:
    if math.isinf(distance):
        return "point at ∞"
    return f"point at {distance / 1000:.3g} m" if distance >= 100 else f"point at {distance:g} mm"
