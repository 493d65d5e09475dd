"""Figures of super-resolution and of fabrication."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from torch import Tensor

from raytrace.plot.style import FAINT, FIELD_COLOURS, GREY, INK, array, new_figure, styled
from raytrace.studies.quantise.experiment import WAYS, Steps, Tolerance
from raytrace.studies.superres.experiment import Row

_LOOKS = {"whole": (INK, "o"), "wrapped": (FIELD_COLOURS[2], "s"), "looped": (FIELD_COLOURS[0], "^"),
          "trained": (FIELD_COLOURS[1], "D")}  # fmt: skip
_SHOWN = 64  # pixels of a full-frame picture, of its 96 that are not mirrored


@styled
def superres_figure(
    full: Sequence[Row],
    picture: Tensor,
    small: Sequence[Row],
    scene: Tensor,
    kernels: Mapping[str, Tensor],
    sensor: Tensor,
) -> Figure:
    """Pictures as restored, with PSNR, and the kernels behind them.

    full: bicubic, MMSE, learned; picture: (n, n); small: bicubic, MMSE, jointly; scene: (n, n); kernels: (k, k) of
    the plain lens, the learned one and the plate; sensor: (m, m) behind the plate. One colour is drawn, the middle one.
    """
    figure = new_figure(9.2, 4.1)
    axes = figure.subplots(2, 6)
    corner = slice(0, _SHOWN)
    _picture(axes[0, 0], array(picture)[corner, corner], "picture")
    _picture(axes[1, 0], array(scene), "scene on dark ground")
    for panels, rows, cut in ((axes[0, 1:4], full, corner), (axes[1, 1:4], small, slice(None))):
        for ax, row in zip(panels, rows, strict=True):
            middle = row.estimate.shape[1] // 2
            _picture(ax, array(row.estimate[0, middle])[cut, cut], f"{row.name}\n{row.psnr:.1f} dB")
    plain, learned, plate = (array(kernel) for kernel in kernels.values())
    for ax, kernel, name in zip(axes[0, 4:], (plain, learned), kernels, strict=False):
        middle = kernel.shape[0] // 2
        _kernel(ax, kernel[middle - 10 : middle + 11, middle - 10 : middle + 11], f"PSF: {name}\n21 × 21 pixels")
    _kernel(axes[1, 4], plate, f"PSF: {list(kernels)[2]}\n{len(plate)} × {len(plate)} pixels")
    _picture(axes[1, 5], array(sensor), "the sensor behind it", top=None)
    return figure


def _picture(ax: Axes, values: np.ndarray, title: str, *, top: float | None = 1.0) -> None:
    ax.imshow(values, cmap="gray", vmin=0, vmax=top or float(values.max()), interpolation="nearest")
    _bare(ax, title)


def _kernel(ax: Axes, values: np.ndarray, title: str) -> None:
    top = float(values.max())
    ax.imshow(np.maximum(values, 1e-4 * top), cmap="magma", norm=LogNorm(1e-4 * top, top), interpolation="nearest")
    _bare(ax, title)


def _bare(ax: Axes, title: str) -> None:
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize=7.5)
    for spine in ax.spines.values():
        spine.set_visible(False)


@styled
def quantise_figure(
    etched: Sequence[tuple[int, float, float]], steps: Sequence[Steps], tolerances: Sequence[Tolerance]
) -> Figure:
    """Efficiency over levels, expected PSNR over levels, and what errors of height cost.

    etched: (levels, efficiency of the profile as it is, that of its rings).
    """
    figure = new_figure(9.2, 3.6)
    light, error, off = figure.subplots(1, 3)
    _efficiency(light, etched)
    _levels(error, steps)
    _tolerance(off, tolerances)
    return figure


def _efficiency(ax: Axes, etched: Sequence[tuple[int, float, float]]) -> None:
    levels = sorted(row[0] for row in etched if row[0])
    fine = np.geomspace(max(min(levels), 2), max(levels), 60)
    ax.plot(fine, np.sinc(1 / fine) ** 2, color=GREY, linewidth=1.0, label="sinc²(1/L)")
    for column, name, marker in ((1, "steps of any width", "o"), (2, "rings of 2 µm", "s")):
        values = {row[0]: row[column] for row in etched}
        ax.plot(levels, [values[n] for n in levels], marker, color=FIELD_COLOURS[column - 1], markersize=4, label=name)
    ax.set(title="Fresnel lens, at its focus", ylabel="light at the focus, ideal lens = 1", ylim=(0, 1.05))
    _over_levels(ax, levels)


def _levels(ax: Axes, steps: Sequence[Steps]) -> None:
    levels = sorted({row.levels for row in steps if row.levels})
    for element in dict.fromkeys(row.element for row in steps):
        for way in WAYS:
            own = {row.levels: row.closed for row in steps if (row.element, row.made) == (element, way)}
            if not own:
                continue
            plain = element == "fresnel"
            colour, marker = (GREY, "x") if plain else _LOOKS[way]
            ax.plot([n for n in levels if n in own], [own[n] for n in levels if n in own], f"-{marker}",
                    color=colour, markersize=4, linewidth=1.0,
                    label="Fresnel lens" if plain else f"{element}: {WAYS[way]}")  # fmt: skip
            ax.axhline(own[0], color=colour, linewidth=0.6, linestyle=(0, (4, 3)))
    ax.set(title="all depths and colours (dashed: any height)", ylabel="expected PSNR (dB)")
    _over_levels(ax, levels, size=6.5)


def _over_levels(ax: Axes, levels: Sequence[int], size: float = 7.5) -> None:
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(FixedLocator(levels))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xticklabels([str(n) for n in levels])
    ax.set_xlabel("levels of a wave")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=size)


def _tolerance(ax: Axes, rows: Sequence[Tolerance]) -> None:
    kinds = list(dict.fromkeys((row.element, row.made) for row in rows))
    for element, way in kinds:
        own = [row for row in rows if (row.element, row.made) == (element, way)]
        base = own[0].mean
        colour, marker = (GREY, "x") if element == "fresnel" else _LOOKS[way]
        x = [row.nm for row in own]
        ax.fill_between(x, [row.least - base for row in own], [row.greatest - base for row in own], color=colour,
                        alpha=0.2, linewidth=0)  # fmt: skip
        levels = f"{own[0].levels} levels" if own[0].levels else "any height"
        name = "Fresnel lens" if element == "fresnel" else f"{element}: {WAYS[way].split(',')[0]}"
        ax.plot(x, [row.mean - base for row in own], f"-{marker}", color=colour, markersize=4, linewidth=1.0,
                label=f"{name}, {levels}")  # fmt: skip
    ax.axhline(0, color=FAINT, linewidth=0.7, zorder=0)
    ax.set(title="errors of height, uniform ±", xlabel="tolerance (nm)", ylabel="change of expected PSNR (dB)")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=6.5)
