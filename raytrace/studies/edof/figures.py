"""Figures of extended depth of field: PSNR over depth, gains beside published ones, elements with their kernels."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from raytrace.plotting.style import FIELD_COLOURS, GREY, INK, array, new_figure, styled, wavelength_colours
from raytrace.studies.edof.scene import Deep
from raytrace.studies.edof.table import ROWS, title_of
from raytrace.studies.edof.world import Judged, Quality, World, depth_text
from raytrace.studies.figures import picture as show
from raytrace.wave_optics.compute import ElementPsf
from raytrace.wave_optics.element import Element, height

_LEARNED = ("learned", "learned-16", "learned-smooth")
#: Panels of the figure over noise, by filter.
NOISE_TITLES = {"wiener": "Wiener filter, 1 m", "blind": "depth-invariant filter"}
#: Lines of the figure of free heights.
_FREE = {
    "control": "rings learned on",
    "rings": "free, from rings",
    "cubic": "free, from cubic",
    "random": "free, from random",
}
_MARGIN = 1e-5  # of the brightest pixel, what is black


@styled
def depth_figure(found: Mapping[str, Mapping[str, Quality]], world: World) -> Figure:
    """PSNR behind the depth-invariant filter over depth in dioptres, a panel for each content, a line for each row."""
    figure = new_figure(3.1 * len(found) + 1.9, 3.8)
    axes = np.atleast_1d(figure.subplots(1, len(found), sharey=True))
    dioptres = [1e3 / depth for depth in world.depths]
    for panel, (content, rows) in zip(axes, found.items(), strict=True):
        for name, own in rows.items():
            panel.plot(dioptres, own.by_depth["blind"], label=ROWS[name].title, **_look(name, list(rows)))
        panel.set(title=content, xlabel="object distance")
        _mark_depths(panel, world)
    axes[0].set_ylabel("PSNR, depth-invariant filter (dB)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=7.5)
    return figure


@styled
def gain_figure(found: Mapping[str, Mapping[str, Quality]]) -> Figure:
    """Gains over the Fresnel lens: of every content and both filters, and those that Sitzmann et al. published."""
    rows = [name for name in next(iter(found.values())) if name != "fresnel"]
    figure = new_figure(7.6, 0.42 * len(rows) + 1.1)
    axes = figure.subplots()
    place = np.arange(len(rows))[::-1]
    marks = {"wiener": "o", "blind": "s"}
    for number, (content, own) in enumerate(found.items()):
        for filter, mark in marks.items():
            gain = [own[name].mean[filter] - own["fresnel"].mean[filter] for name in rows]
            label = f"{content}, {'1 m Wiener' if filter == 'wiener' else 'depth-invariant'} filter"
            face = FIELD_COLOURS[number] if filter == "blind" else "white"
            axes.plot(gain, place, mark, ms=5.5, mfc=face, mec=FIELD_COLOURS[number], label=label)
    published = [
        (ROWS[name].published - ROWS["fresnel"].published, y)
        for name, y in zip(rows, place, strict=True)
        if ROWS[name].published
    ]
    axes.plot(*zip(*published, strict=True), "|", ms=15, mew=2, color=INK, label="Sitzmann 2018")
    axes.set_yticks(place, [ROWS[name].title for name in rows])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.axvline(0, color=GREY, lw=0.8)
    axes.set(xlabel="mean PSNR over that of the Fresnel lens (dB)")
    figure.legend(loc="outside upper center", ncols=2, fontsize=7.5)
    return figure


@styled
def noise_figure(found) -> Figure:
    """Gain over the Fresnel lens over noise, a panel for each filter, intervals as bands; found: an `OverNoise`."""
    content = "pictures" if "pictures" in found.pictures else next(iter(found.pictures))
    figure = new_figure(9.2, 3.9)
    axes = figure.subplots(1, len(NOISE_TITLES), sharey=True)
    for panel, (filter, title) in zip(axes, NOISE_TITLES.items(), strict=True):
        rows = {row: own for row, own in found.of(content, filter).items() if row != "fresnel"}
        for row, own in rows.items():
            noises = sorted(own)
            gains = [own[noise].gains.pooled for noise in noises]
            look = _look(row, list(rows))
            panel.plot(noises, [one.value for one in gains], label=title_of(row), **look)
            low, high = ([getattr(one, end) for one in gains] for end in ("low", "high"))
            panel.fill_between(noises, low, high, color=look["color"], alpha=0.13, lw=0)
        published = ROWS["learned"].published - ROWS["fresnel"].published
        panel.axhline(published, color=INK, lw=0.8, ls=(0, (1, 2)))
        panel.annotate("Sitzmann 2018", (1, published), (-2, 2), xycoords=("axes fraction", "data"),
                       textcoords="offset points", ha="right", fontsize=7)  # fmt: skip
        panel.set(xscale="log", xlabel="noise, standard deviation", title=f"{content}, {title}")
        panel.set_xticks(noises, [f"{noise:g}" for noise in noises])
        panel.minorticks_off()
    axes[0].set_ylabel("PSNR over that of the Fresnel lens (dB)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=7.5)
    return figure


@styled
def free_figure(found) -> Figure:
    """Of every map a line: its heights, and its kernels over depth; found: a `Freed`."""
    world, columns = World(), len(World().depths) + 1
    figure = new_figure(1.75 * columns, 1.85 * len(found.shown))
    axes = figure.subplots(len(found.shown), columns, squeeze=False)
    half = 500 * world.pixel * world.size
    for line, (row, shown) in zip(axes, found.shown.items(), strict=True):
        wave = line[0].imshow(shown.heights, cmap="viridis", origin="lower")
        line[0].set_ylabel(_FREE[row], fontsize=8)
        figure.colorbar(wave, ax=line[0], location="left", fraction=0.05, pad=0.16).ax.tick_params(labelsize=6)
        for panel, kernel, depth in zip(line[1:], shown.kernels, world.depths, strict=True):
            logarithm = np.log10(np.maximum(kernel / shown.kernels.max(), _MARGIN))
            panel.imshow(logarithm, cmap="inferno", vmin=np.log10(_MARGIN), vmax=0, extent=(-half, half, -half, half))
            panel.set_title(depth_text(depth, "∞"), fontsize=8)
    for panel in axes.flat:
        panel.set(xticks=[], yticks=[])
    axes[0, 0].set_title("heights beyond\na smooth lens, µm", fontsize=8)
    return figure


@styled
def element_figure(judged: Judged) -> Figure:
    """Height over the radius, kernels over depth × colour, PSNR over depth, of one element."""
    own, world = judged.quality, judged.world
    figure = new_figure(9.2, 7.0)
    top, bottom = figure.subfigures(2, 1, height_ratios=(1, 1.75))
    profile, quality = top.subplots(1, 2)
    _draw_profile(profile, judged.elements)
    dioptres = [1e3 / depth for depth in world.depths]
    for filter, mark in (("wiener", "o--"), ("blind", "s-")):
        label = "Wiener, 1 m kernel" if filter == "wiener" else "best depth-invariant filter"
        quality.plot(dioptres, own.by_depth[filter], mark, ms=4, label=label, color=FIELD_COLOURS[filter == "blind"])
    _mark_depths(quality, world)
    quality.set(xlabel="object distance", ylabel="PSNR (dB)")
    quality.legend(fontsize=8)
    _draw_kernels(bottom, judged.kernels)
    return figure


@styled
def scene_figure(columns: Mapping[str, Mapping[str, tuple[np.ndarray, float]]], picture: np.ndarray) -> Figure:
    """Restored scenes: a column for each row of the table, a line for each depth; the picture itself in front.

    columns: name -> what it shows -> (picture (h, w, 3), its PSNR).
    """
    shown = list(next(iter(columns.values())))
    figure = new_figure(1.55 * (len(columns) + 1), 1.62 * len(shown) + 0.3)
    axes = figure.subplots(len(shown), len(columns) + 1, squeeze=False)
    for line, name in enumerate(shown):
        _show(axes[line, 0], picture, "scene" if line == 0 else "")
        axes[line, 0].set_ylabel(name, fontsize=8)
        for column, (row, cells) in enumerate(columns.items(), 1):
            image, ratio = cells[name]
            _show(axes[line, column], image, _title(row) if line == 0 else "")
            axes[line, column].set_xlabel(f"{ratio:.1f} dB", fontsize=7.5, labelpad=2)
    return figure


@styled
def deep_figure(found: Deep) -> Figure:
    """A scene in depth: above what the sensors saw, below what was restored; in front the scene and its depth."""
    figure = new_figure(1.9 * (len(found.seen) + 1), 4.3)
    axes = figure.subplots(2, len(found.seen) + 1, squeeze=False)
    _show(axes[0, 0], found.picture, "scene")
    shades = axes[1, 0].imshow(found.dioptres, cmap="cividis")
    axes[1, 0].set(xticks=[], yticks=[])
    axes[1, 0].set_title("depth", fontsize=7.5)
    bar = figure.colorbar(shades, ax=axes[1, 0], location="bottom", fraction=0.06, pad=0.04)
    marks = [mark for mark in (0, 0.5, 1, 1.5, 2) if found.dioptres.min() <= mark <= found.dioptres.max()]
    bar.set_ticks(marks, labels=["∞" if mark == 0 else f"{1 / mark:.2g} m" for mark in marks], fontsize=6.5)
    for column, name in enumerate(found.seen, 1):
        _show(axes[0, column], found.seen[name], _title(name))
        image, ratio = found.restored[name]
        _show(axes[1, column], image, "")
        axes[1, column].set_xlabel(f"{ratio:.1f} dB", fontsize=7.5, labelpad=2)
    axes[0, 1].set_ylabel("sensor", fontsize=8)
    axes[1, 1].set_ylabel("restored", fontsize=8)
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


def _show(axes: Axes, picture: np.ndarray, title: str) -> None:
    show(axes, np.clip(picture, 0, 1), title)


def _title(name: str) -> str:
    return ROWS[name].title.replace(", ", ",\n")


def _look(name: str, rows: Sequence[str]) -> dict:
    if name in _LEARNED:
        style = ("-", "--", ":")[_LEARNED.index(name)]
        return {"color": FIELD_COLOURS[2], "lw": 2, "ls": style, "marker": "o", "ms": 3.5}
    colours = [colour for colour in FIELD_COLOURS if colour != FIELD_COLOURS[2]]
    number = [row for row in rows if row not in _LEARNED].index(name)
    style = ("-", "--", ":")[number // len(colours) % 3]
    return {"color": colours[number % len(colours)], "lw": 1.2, "ls": style}


def _mark_depths(axes: Axes, world: World) -> None:
    """Near objects on the left, even in dioptres."""
    axes.set_xticks([1e3 / depth for depth in world.depths], [depth_text(depth, "∞") for depth in world.depths])
    axes.invert_xaxis()
