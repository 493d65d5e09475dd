"""Figures of fabrication: efficiency, expected PSNR, and errors of height."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from raytrace.plotting.style import FAINT, FIELD_COLOURS, GREY, INK, new_figure, styled
from raytrace.studies.quantise.experiment import WAYS, Steps, Tolerance
from raytrace.studies.quantise.report import Etched, Fabrication

_LOOKS = {"whole": (INK, "o"), "wrapped": (FIELD_COLOURS[2], "s"), "looped": (FIELD_COLOURS[0], "^"),
          "trained": (FIELD_COLOURS[1], "D")}  # fmt: skip


@styled
def quantise_figure(found: Fabrication) -> Figure:
    """Efficiency over levels, expected PSNR over levels, and what errors of height cost."""
    figure = new_figure(9.2, 3.6)
    light, error, off = figure.subplots(1, 3)
    _efficiency(light, found.etched)
    _levels(error, found.steps)
    _tolerance(off, found.tolerances)
    return figure


def _efficiency(ax: Axes, etched: Sequence[Etched]) -> None:
    etched = sorted((row for row in etched if row.levels), key=lambda row: row.levels)
    levels = [row.levels for row in etched]
    fine = np.geomspace(max(min(levels), 2), max(levels), 60)
    ax.plot(fine, np.sinc(1 / fine) ** 2, color=GREY, linewidth=1.0, label="sinc²(1/L)")
    ax.plot(
        levels, [row.any_width for row in etched], "o", color=FIELD_COLOURS[0], markersize=4, label="steps of any width"
    )
    ax.plot(levels, [row.rings for row in etched], "s", color=FIELD_COLOURS[1], markersize=4, label="rings of 2 µm")
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


@styled
def etch_figure(found) -> Figure:
    """Gain over the Fresnel lens of every process on pictures, behind both filters; found: an `Etching`."""
    content = "pictures" if "pictures" in found.pictures else next(iter(found.pictures))
    noise = found.rows[0].noise
    figure = new_figure(7.6, 3.8)
    axes = figure.subplots()
    for number, (filter, label) in enumerate((("wiener", "Wiener, 1 m"), ("blind", "depth-invariant"))):
        rows = [one for one in found.rows if (one.content, one.filter, one.noise) == (content, filter, noise)]
        place = np.arange(len(rows))[::-1] + 0.12 * (1 - 2 * number)
        gains = [one.gains["fresnel"].pooled for one in rows]
        values = np.array([one.value for one in gains])
        beside = np.abs(np.array([(one.value - one.low, one.high - one.value) for one in gains]).T)
        axes.errorbar(values, place, xerr=beside, fmt="os"[number], ms=5, lw=1.2, capsize=2,
                      color=FIELD_COLOURS[number], label=f"{label} filter")  # fmt: skip
        hybrid = rows[0].gains["fresnel"].pooled.value - rows[0].gains["hybrid"].pooled.value
        axes.axvline(hybrid, color=FIELD_COLOURS[number], lw=0.9, ls=(0, (2, 2)))
    axes.set_yticks(np.arange(len(rows))[::-1], [one.title for one in rows])
    axes.set(xlabel=f"PSNR over that of the Fresnel lens (dB), {content}, noise {noise:g}; dashed: the hybrid achromat")
    axes.legend(loc="best")
    return figure
