"""Figures of a co-design study: loss and focus in training, blur and loss over object distance, restored pictures.

And of the closed form: its error over the sensor's place, and its optima by what the paper leaves open.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from raytrace.plotting.style import GREY, LOOKS, new_figure, styled
from raytrace.studies.codesign.settings import NAMES
from raytrace.studies.codesign.study import PAPER
from raytrace.studies.codesign.sweep import FACTORS, Factor, Reading
from raytrace.studies.codesign.sweep_page import Sweep
from raytrace.studies.figures import picture as draw

#: Object distances in m that may be marked on an axis, the roundest first.
_MARKS = (10, 100, 20, 50, 200, 500, 30, 40, 15, 25, 70, 35, 150, 300, 60, 80, 45, 12, 1000, *range(11, 50))

#: What the panels of a sweep are called, and by how many points numbers of the paper are moved that would touch.
_TITLES = {
    "f_number": "aperture", "rho": "ρ", "noise": "noise", "normalise": "PSF sum",
    "start": "start", "spread": "distances", "rays": "rays, Sobol", "hexapolar": "hexapolar",
}  # fmt: skip
_SWEEP_MARKS = (10, 100, 20, 50, 30, 15, 25, 40, 70, 35, 200, 18, 12, 14, 16, 22)
_CROWDED = 6  # values of a factor, whose marks are turned from there on
_LIFT = {"fourier": 5, "gaussian": -2}  # points, of a label from its line: the lines of the first two nearly touch

#: Values over steps or distances, one list for each seed.
Curves = Mapping[str, Sequence[Sequence[float]]]


@styled
def loss_figure(joint: Curves, refined: Curves, steps_per_epoch: int) -> Figure:
    """Mean loss of every epoch, of step 1 and of step 2: means over seeds, and their range."""
    figure = new_figure(7.2, 3.3)
    axes = figure.subplots(1, 2, sharey=True)
    for panel, curves, title in zip(
        axes, (joint, refined), ("Step 1: own PSF model", "Step 2: DRT PSFs, optics frozen"), strict=True
    ):
        for model, seeds in curves.items():
            epochs = [_means(losses, steps_per_epoch) for losses in seeds]
            _band(panel, np.arange(1, len(epochs[0]) + 1), epochs, model)
        panel.set(title=title, xlabel="epoch")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes[0].set_ylabel("training loss (mean L¹)")
    _legend(figure, axes[0])
    return figure


@styled
def focus_figure(sensors: Curves, conjugates: tuple[Sequence[float], Sequence[float]], steps_per_epoch: int) -> Figure:
    """The sensor over training, and on the right the object distance whose paraxial image it is.

    conjugates: sensor distances in mm, ascending, and object distances in m.
    """
    figure = new_figure(5.6, 3.5)
    panel = figure.subplots()
    for model, seeds in sensors.items():
        shortest = min(map(len, seeds))
        _band(panel, np.arange(shortest) / steps_per_epoch, [s[:shortest] for s in seeds], model)
    panel.set(xlabel="epoch", ylabel="sensor behind the last surface (mm)")
    panel.set_xlim(left=0)
    panel.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    _legend(figure, panel)
    scale = panel.twinx()
    scale.set_ylim(panel.get_ylim())
    marks = _marks(conjugates, *panel.get_ylim())
    scale.set_yticks([_image(z, conjugates) for z in marks])
    scale.set_yticklabels([f"{z} m" for z in marks])
    scale.set_ylabel("object in paraxial focus")
    scale.spines["right"].set_visible(True)
    return figure


@styled
def blur_figure(distances: Sequence[float], diameters: Mapping[str, Sequence[float]], pixel: float) -> Figure:
    """RMS blur diameter (mm) of the optimised lenses over object distance (mm), beside a pixel."""
    figure = new_figure(5.6, 3.5)
    panel = figure.subplots()
    for model, values in diameters.items():
        panel.plot(np.asarray(distances) / 1e3, 1e3 * np.asarray(values), **_look(model))
    panel.axhline(1e3 * pixel, color=GREY, linewidth=0.7)
    panel.annotate("one pixel", (1, 1e3 * pixel), (-2, 3), ("axes fraction", "data"), "offset points", ha="right",
                   color=GREY, fontsize=7.5)  # fmt: skip
    panel.set(xlabel="object distance (m)", ylabel="RMS blur diameter, traced rays (µm)")
    panel.set_ylim(bottom=0)
    _legend(figure, panel)
    return figure


@styled
def distance_figure(distances: Sequence[float], losses: Curves) -> Figure:
    """Test loss on DRT PSFs after step 2 over object distance (mm): means over seeds, and their range."""
    figure = new_figure(5.6, 3.5)
    panel = figure.subplots()
    for model, seeds in losses.items():
        _band(panel, np.asarray(distances) / 1e3, seeds, model, marker="o")
    panel.set(xlabel="object distance (m)", ylabel="test loss with DRT PSFs (mean L¹)")
    _legend(figure, panel)
    return figure


@styled
def examples_figure(rows: Mapping[str, Mapping[str, np.ndarray]], distances: Sequence[float]) -> Figure:
    """Blurred and noisy images and their restorations, a row for each model, a pair of columns for each distance."""
    models = list(rows)
    figure = new_figure(1.15 * (2 * len(distances) + 1) + 0.8, 1.3 * len(models) + 0.5)
    axes = figure.subplots(len(models), 2 * len(distances) + 1, squeeze=False)
    for panels, model in zip(axes, models, strict=True):
        found = rows[model]
        pictures = [found["picture"][0]]
        for image, restored in zip(found["image"], found["restored"], strict=True):
            pictures += [image, restored]
        for panel, picture in zip(panels, pictures, strict=True):
            draw(panel, picture)
        panels[0].set_ylabel(NAMES[model].replace(" from ", "\nfrom "))
    axes[0][0].set_title("picture", fontsize=8)
    for number, distance in enumerate(distances):
        axes[0][2 * number + 1].set_title(f"{distance / 1e3:g} m: image", fontsize=8)
        axes[0][2 * number + 2].set_title("restored", fontsize=8)
    return figure


@styled
def scan_figure(
    sensors: Sequence[float], errors: Mapping[str, Sequence[float]], trained: Mapping[str, float]
) -> Figure:
    """Closed-form error over the sensor's place (mm) for each model, its minimum, and where training ended."""
    figure = new_figure(5.6, 3.7)
    panel = figure.subplots()
    for model, values in errors.items():
        values = np.asarray(values)
        panel.plot(sensors, values, **_look(model))
        best, colour = int(values.argmin()), _look(model)["color"]
        panel.plot(sensors[best], values[best], "o", color=colour, markersize=4)
        if model in trained:
            error = np.interp(trained[model], sensors, values)
            panel.plot(trained[model], error, "D", color=colour, markerfacecolor="white", markersize=5)
    panel.set(xlabel="sensor behind the last surface (mm)", ylabel="mean square error, best linear filter")
    marks = [Line2D([], [], color=GREY, linestyle="", marker="o", markersize=4, label="least error")]
    if trained:
        marks.append(
            Line2D([], [], color=GREY, linestyle="", marker="D", markerfacecolor="white", label="end of training")
        )
    _legend(figure, panel, marks)
    return figure


@styled
def sweep_figure(found: Sweep) -> Figure:
    """Focus of the closed form's optima: a column of panels for each factor, a row for each definition of focus.

    Distances stand as they do behind the lens, evenly in 1/z, so that infinity has a place; of the paper's lens its
    numbers are lines.
    """
    papers = PAPER if found.of_paper else {}
    groups = {factor: [one for one in found.readings if one.factor == factor.name] for factor in FACTORS}
    groups = {factor: own for factor, own in groups.items() if own}
    figure = new_figure(max(9.6, 2.4 + 0.28 * sum(map(len, groups.values()))), 5.2)
    axes = figure.subplots(2, len(groups), sharey="row", width_ratios=[1 + len(own) for own in groups.values()])
    for panels, column, label in zip(
        axes, ("focus_paraxial_m", "focus_rms_m"), ("paraxial conjugate (m)", "least RMS spot (m)"), strict=True
    ):
        for panel, (factor, own) in zip(panels, groups.items(), strict=True):
            for model in factor.models:
                values = [-1 / getattr(one.of[model], column) for one in own]
                panel.plot(values, marker="o", markersize=3.5, **_look(model))
            for model, (*_, paper) in papers.items():
                panel.axhline(-1 / paper, color=_look(model)["color"], linewidth=0.6, alpha=0.7, zorder=0)
            panel.set_xticks(range(len(own)), [_sweep_tick(factor, one.value) for one in own])
            panel.tick_params(axis="x", labelrotation=90 if _is_crowded(factor, own) else 0)
            panel.set_xlim(-0.5, len(own) - 0.5)
            panel.tick_params(axis="y", left=panel is panels[0], length=2.5)
            panel.spines["left"].set_visible(panel is panels[0])
        panels[0].set_ylabel(f"object in focus,\n{label}")
        _distance_ticks(panels[0])
        for model, (*_, paper) in papers.items():
            # Right of the last panel, in the colour of its line.
            panels[-1].annotate(
                f"{paper:g}", (1, -1 / paper), (3, _LIFT.get(model, 0)), ("axes fraction", "data"), "offset points",
                va="center", fontsize=7, color=_look(model)["color"], annotation_clip=False,
            )  # fmt: skip
    for panel, factor in zip(axes[0], groups, strict=True):
        panel.set_title(_TITLES[factor.name])
    lines = [Line2D([], [], color=GREY, linewidth=0.6, label="the paper's")] if found.of_paper else []
    _legend(figure, axes[0][0], lines)
    return figure


def _is_crowded(factor: Factor, own: Sequence[Reading]) -> bool:
    """Whether marks of its values would touch, side by side."""
    return max(len(_sweep_tick(factor, one.value)) for one in own) > 4 or len(own) > _CROWDED


def _sweep_tick(factor: Factor, value: str) -> str:
    return factor.text.format(value) if factor.name == "f_number" else value


def _distance_ticks(panel: Axes) -> None:
    """Marks of object distances in m on an axis of -1/z."""
    low, high = panel.get_ylim()
    chosen = _apart({z: -1 / z for z in (np.inf, *_SWEEP_MARKS)}, low, high, 15)
    panel.set_yticks([*chosen.values()], ["∞" if np.isinf(z) else f"{z:g}" for z in chosen])
    panel.set_ylim(low, high)


def _apart(places: Mapping[float, float], low: float, high: float, parts: int) -> dict[float, float]:
    """Of marks with their places those from low to high, none nearer to an earlier one than 1/parts of that."""
    chosen: dict[float, float] = {}
    for mark, place in places.items():
        if low <= place <= high and all(abs(place - other) > (high - low) / parts for other in chosen.values()):
            chosen[mark] = place
    return chosen


def _legend(figure: Figure, panel: Axes, more: Sequence[Line2D] = ()) -> None:
    """Above the axes, where no curve runs."""
    handles = [*panel.get_legend_handles_labels()[0], *more]
    columns = len(handles) if len(handles) <= 4 or figure.get_figwidth() > 9 else 3
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, handlelength=3)


def _look(model: str) -> dict:
    colour, dashes = LOOKS.get(model, (GREY, "solid"))
    return {"color": colour, "linestyle": dashes, "label": NAMES[model]}


def _means(losses: Sequence[float], steps_per_epoch: int) -> np.ndarray:
    whole = max(1, len(losses) // steps_per_epoch)
    return np.asarray(losses[: whole * steps_per_epoch]).reshape(whole, -1).mean(1)


def _band(panel: Axes, x: np.ndarray, seeds: Sequence[Sequence[float]], model: str, marker: str = "") -> None:
    values = np.stack([np.asarray(seed, dtype=float) for seed in seeds])
    panel.plot(x, values.mean(0), **_look(model), marker=marker, markersize=3)
    if len(values) > 1:
        panel.fill_between(x, values.min(0), values.max(0), color=_look(model)["color"], alpha=0.14, linewidth=0)


def _image(distance: float, conjugates: tuple[Sequence[float], Sequence[float]]) -> float:
    """Sensor distance of an object distance: images move towards the lens as objects move away."""
    sensors, distances = (np.asarray(c) for c in conjugates)
    order = np.argsort(distances)
    return float(np.interp(distance, distances[order], sensors[order]))


def _marks(conjugates: tuple[Sequence[float], Sequence[float]], low: float, high: float) -> list[int]:
    """Round object distances in m whose images lie from low to high, none closer than a twelfth of that to another."""
    nearest, furthest = min(conjugates[1]), max(conjugates[1])
    return sorted(_apart({z: _image(z, conjugates) for z in _MARKS if nearest <= z <= furthest}, low, high, 12))
