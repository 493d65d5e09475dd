"""Figures of PSFs: one panel a kernel, object distances from left to right; and the light in them, finely sampled.

`close_up_of` samples the light of a model far more finely than the pixels of a sensor, in windows that it fills.
"""

import dataclasses
import itertools
import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_sqrt, value
from raytrace.maths.sampling import Grid
from raytrace.plotting.style import (
    GREY,
    INK,
    Axes,
    Figure,
    array,
    bar_on_dark,
    fill,
    framed,
    new_figure,
    round_length,
    styled,
)
from raytrace.psf_models.models import MODELS, NotConverged, psf
from raytrace.psf_models.result import EmptyPsf, Psf, mixture
from raytrace.system.lens import field_label, with_object_distance
from raytrace.tracing.f_number import axial_f_number

_SIGMAS = 3.0  # of the rays, and Airy radii, that half a window holds: a uniform disc reaches 2 σ, a caustic 3
_RADII = 3.0
_ALIKE = 4.0  # widths that differ by a larger factor have separate windows
_SAMPLES = 129  # across a window
_WORK = 3e9  # of a kernel of waves: pupil points times nodes of the sensor, seconds
_RAYS = 2**18  # of a ray-traced one: dozens in a sample


@value
class CloseUp:
    """Light over object distance × field (× wavelength), as the `Psf` it belongs to, N × N samples each.

    light: (D, F, N, N) or (D, F, W, N, N), 1 = all light through the entrance pupil, in each sample.
    half: (D, F) mm, half the width of the windows; centre: (2, D, F) mm on the sensor.
    """

    light: Tensor
    half: Tensor
    centre: Tensor


@torch.no_grad()
def close_up_of(psfs: Psf, size: float | None = None) -> CloseUp:
    """The light of the kernels of a `Psf`, finely sampled; size: mm, half the width of all windows instead.

    Windows are centred on the centroid of the rays and hold three of their σ, with diffraction three Airy radii more,
    but no less than a pixel where the light is a point. All have one size, unless kernels differ by more than four
    times in width. Where waves would need too many samples, windows are smaller, down to the window of `psfs`.
    """
    half, centre = windows(psfs, size)
    places = psfs.fields.reshape(2, -1, half.shape[1]).expand(2, *half.shape)
    plain = MODELS[psfs.model].plain is not None
    numbers: dict[str, Any] = {"rays": _RAYS, "order": None} if plain else {"order": psfs.order}
    parameters = psfs.parameters or MODELS[psfs.model].parameters()
    model = dataclasses.replace(parameters, **numbers)

    def light(distances: slice, fields: slice) -> Tensor:
        grid = Grid(2 * half[distances, fields].max() / _SAMPLES, _SAMPLES, _SAMPLES, centre[:, distances, fields])
        try:
            return psf(
                psfs.lens,
                model,
                fields=places[:, distances, fields],
                object_distances=psfs.object_distances[distances],
                wavelengths=psfs.wavelengths,
                wavelength_weights=psfs.wavelength_weights,
                grid=grid,
                center="axis",
                per_wavelength=not psfs.wavelengths_summed,
            ).kernel
        except EmptyPsf:
            return psfs.kernel.new_zeros(*psfs.energy[distances, fields].shape, _SAMPLES, _SAMPLES)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)
        if bool((half == half.max()).all()):
            return CloseUp(light(slice(None), slice(None)), half, centre)
        D, F = half.shape
        rows = [[light(slice(d, d + 1), slice(f, f + 1)) for f in range(F)] for d in range(D)]
        return CloseUp(torch.cat([torch.cat(row, 1) for row in rows]), half, centre)


def windows(psfs: Psf, size: float | None = None) -> tuple[Tensor, Tensor]:
    """Half widths (D, F) mm and centres (2, D, F) mm of windows that the kernels fill, or that waves can afford.

    size: mm, half the width of all windows instead.
    """
    centroid, covariance = (moment.nan_to_num(0.0) for moment in (psfs.ray_centroid, psfs.ray_covariance))
    blur = 2 * safe_sqrt(torch.maximum(covariance[0], covariance[2]))
    if not psfs.wavelengths_summed:
        blur = blur.amax(-1)
        centroid, covariance = mixture(psfs.wavelength_weights.expand(psfs.energy.shape), centroid, covariance)
    if size is not None:
        return torch.full_like(blur, size), centroid
    half = _SIGMAS * safe_sqrt(torch.maximum(covariance[0], covariance[2]))
    if psfs.waves:
        number = axial_f_number(with_object_distance(psfs.lens, psfs.object_distances[:, None])).abs()
        half = half + _RADII * 1.22e-3 * psfs.wavelengths.max() * torch.where(torch.isfinite(number), number, 0.0)
    half = torch.where(half > 1e-9, half, psfs.grid.pitch)
    half = half.max().expand_as(half) if bool(half.max() <= _ALIKE * half.min()) else half
    if psfs.waves:
        least = 0.5 * psfs.grid.pitch * max(psfs.grid.shape)
        cutoff = 1e3 / (psfs.wavelengths.min() * torch.where(torch.isfinite(number), number, 1.0))
        # Pupil points grow with the square of blur and window, nodes with that of the window over the finest fringes.
        for _ in range(20):
            points = psfs.rays * ((blur + 1.4 * half) / (blur + 1.4 * least)) ** 2
            nodes = math.pi * cutoff * half + 2 * _SAMPLES
            expensive = (points * nodes * nodes > _WORK) & (half > least)
            half = torch.where(expensive, torch.maximum(0.8 * half, least), half)
    return half, centroid


DECADES = 4  # of light on a logarithmic scale
_MOST_PIXELS = 16  # across a panel, whose edges are drawn
_LINE = 4  # kernels of one distance in a line


@styled
def psf_grid(psfs: Psf, *, close_up: CloseUp | None = None, log: bool = False) -> Figure:
    """Kernels over object distance (columns) and field (rows), each on its own brightness scale.

    Where its pixels were specified, or rays are independent, pixels are drawn; else the light itself in windows that
    it fills, with the edges of the pixels. close_up: that light, if it is already computed. Kernels of each wavelength
    have a row each, fields outermost; of one distance, fields are rows and wavelengths are columns. log: four decades
    of brightness below the peak. Below each: the energy inside the window, and that of the brightest pixel.
    """
    if close_up is None and not psfs.framed and psfs.order is not None:
        close_up = close_up_of(psfs)
    headings = [distance_text(distance) for distance in psfs.object_distances.tolist()]
    labels = row_labels(psfs)
    line = _LINE if psfs.wavelengths_summed or len(psfs.wavelengths) > 2 * _LINE else len(psfs.wavelengths)
    title = ": ".join(filter(None, (psfs.lens.name, f"{psfs.model} PSF")))
    energy, kernels = rows_of(array(psfs.energy), 0), rows_of(array(psfs.kernel), 2)
    notes = [
        [f"energy {e:.3f}, max {kernel.max():.3g}" for e, kernel in zip(*row, strict=True)]
        for row in zip(energy, kernels, strict=True)
    ]
    pitch = float(psfs.grid.pitch)
    half = 0.5 * pitch * psfs.grid.columns
    if close_up is None:
        figure, _ = panels(kernels, [[half] * len(headings)] * len(labels), headings, labels, notes, log, line)
        return worded(figure, title, [f"{window(psfs.grid)}; max: light of the brightest pixel", brightness(log)])
    light, each = rows_of(array(close_up.light), 2), len(kernels) // close_up.half.shape[1]
    halves = np.repeat(array(close_up.half).T, each, 0)
    figure, axes = panels(light, halves, headings, labels, notes, log, line)
    centre = array(psfs.grid.centre).reshape(2, *(psfs.grid.centre.shape[1:] or (1, 1)))
    offset = np.repeat(np.moveaxis(centre - array(close_up.centre), 2, 0), each, 0)  # field × (x, y) × distance
    for row, place in zip(axes, offset, strict=True):
        for d, panel in enumerate(row):
            _draw_pixels(panel, place[:, d], pitch, psfs.grid.columns, psfs.grid.rows)
    size = f"window {2e3 * halves.max():.3g} µm" if np.ptp(halves) == 0 else "windows by the width of the light"
    note = f"{size}; energy and brightest pixel (max): of the {window(psfs.grid)}, outlined where they lie inside"
    return worded(figure, title, [note, brightness(log)])


def row_labels(psfs: Psf) -> list[str]:
    """The field of each row of panels, and its wavelength where each has its kernel."""
    if psfs.fields.dim() == 2:
        labels = [field_label(psfs.lens, field) for field in array(psfs.fields).T]
    else:  # others for each object distance
        labels = [f"field {number + 1}" for number in range(psfs.fields.shape[-1])]
    if psfs.wavelengths_summed:
        return labels
    return [f"{row}\n{1e3 * wavelength:.4g} nm" for row in labels for wavelength in psfs.wavelengths.tolist()]


def rows_of(values: np.ndarray, kept: int) -> np.ndarray:
    """(D, F, …) or (D, F, W, …), `kept` axes last, as (F or F·W, D, …)."""
    values = np.moveaxis(values, 0, values.ndim - kept - 1)
    return values.reshape(-1, *values.shape[values.ndim - kept - 1 :])


def panels(
    kernels: Sequence[np.ndarray] | np.ndarray,
    halves: Sequence[Sequence[float]] | np.ndarray,
    headings: Sequence[str],
    labels: Sequence[str],
    notes: Sequence[Sequence[str]],
    log: bool,
    line: int = _LINE,
    peaks: Sequence[float] | None = None,
) -> tuple[Figure, np.ndarray]:
    """Kernels[row][column] in windows of half widths (mm), a note below each; and the axes (rows, columns) of them.

    Headings of the columns, the distances, are above and labels on the left; kernels of one column follow each other in
    lines of `line`, each under its label. peaks: the end of the brightness of each row, by default of each panel its
    peak.
    """
    from matplotlib.colors import LogNorm, Normalize

    rows, columns = len(labels), len(headings)
    flows = columns == 1 and rows > 1
    shape = (-(-rows // line), min(rows, line)) if flows else (rows, columns)
    figure = new_figure(max(4.4, 1.75 * shape[1] + 0.7), (1.85 if max(shape) > 1 else 2.6) * shape[0] + 0.9)
    grid = figure.subplots(*shape, squeeze=False)
    axes = grid.reshape(-1, 1)[:rows] if flows else grid
    alike = len({round(float(half), 12) for row in halves for half in row}) == 1
    for row, column in itertools.product(range(rows), range(columns)):
        panel, kernel, half = axes[row, column], kernels[row][column], float(halves[row][column])
        tall = half * kernel.shape[0] / kernel.shape[1]
        extent = (-half, half, -tall, tall)
        peak = (float(kernel.max()) if peaks is None else peaks[row]) or 1.0
        norm = LogNorm(peak / 10**DECADES, peak, clip=True) if log else Normalize(0.0, peak)
        panel.imshow(kernel, origin="lower", cmap="magma", norm=norm, extent=extent, interpolation="nearest")
        framed(panel)
        panel.set(xlim=extent[:2], ylim=extent[2:])
        panel.set_xlabel(notes[row][column], fontsize=7, color=GREY)
        if not alike or (row, column) == (0, 0):
            bar_on_dark(panel, -0.88 * half, -0.86 * tall, round_length(0.5 * half))
        if flows:
            panel.set_title(labels[row].replace("\n", ", "), color=INK)
        elif row == 0:
            panel.set_title(headings[column], color=INK)
        if column == 0:
            panel.set_ylabel((headings[0] if row % line == 0 else "") if flows else labels[row])
    for panel in grid.flat[rows:] if flows else ():
        panel.axis("off")
    return figure, axes


def brightness(log: bool) -> str:
    return f"each panel from {f'{10.0**-DECADES:g} of its own peak, logarithmic' if log else '0 to its own peak'}"


def _draw_pixels(panel: Axes, centre: np.ndarray, pitch: float, columns: int, rows: int) -> None:
    """Outline the window of a kernel about a centre (2,) mm; and its pixels, where a panel holds only a few."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    (low, high), (bottom, top) = panel.get_xlim(), panel.get_ylim()
    corner = centre - 0.5 * pitch * np.array([columns, rows])
    if pitch * _MOST_PIXELS >= high - low:
        x, y = (corner[k] + pitch * np.arange(count + 1) for k, count in enumerate((columns, rows)))
        lines = [[(edge, y[0]), (edge, y[-1])] for edge in x if low < edge < high]
        lines += [[(x[0], edge), (x[-1], edge)] for edge in y if bottom < edge < top]
        edges = LineCollection(lines, colors="white", linewidths=0.4, alpha=0.45, gid="pixels")
        panel.add_collection(edges, autolim=False)
    line: dict[str, Any] = {"fill": False, "edgecolor": "white", "linewidth": 0.7, "alpha": 0.7, "gid": "window"}
    panel.add_patch(Rectangle((corner[0], corner[1]), pitch * columns, pitch * rows, **line))
    panel.set(xlim=(low, high), ylim=(bottom, top))


def worded(figure: Figure, title: str, notes: Sequence[str]) -> Figure:
    """The figure with a title above and one caption below, both wrapped to its width."""
    width = figure.get_figwidth()
    figure.suptitle(fill(title, width, 10, bold=True), fontweight="bold", fontsize=10)
    figure.supxlabel(fill("; ".join(notes), width, 7.5), fontsize=7.5, color=GREY)
    return figure


def window(grid: Grid) -> str:
    pitch = 1e3 * float(grid.pitch)
    return f"window of {pitch * grid.columns:.3g} µm, {grid.columns} × {grid.rows} pixels of {pitch:.3g} µm"


def distance_text(millimetres: float) -> str:
    if math.isinf(millimetres):
        return "object at ∞"
    return f"{millimetres / 1000:g} m" if millimetres >= 1000 else f"{millimetres:g} mm"
