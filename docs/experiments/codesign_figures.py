"""Figures of a study of co-design: loss and focus in training, blur and loss over object distance, restored pictures,
and the error of the closed form over the sensor distance.

paper: a published value by model, drawn as a dashed line of its colour.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from codesign_study import NAMES, Curves
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from raytrace.plotting.style import FIELD_COLOURS, GREY, INK, new_figure, show_image, styled

#: How the models are drawn: colour and dashes, distinguishable in print.
LOOKS = {
    "paraxial": (FIELD_COLOURS[0], (0, (5, 2))),
    "fourier": (FIELD_COLOURS[1], (0, (1, 1.2))),
    "gaussian": (FIELD_COLOURS[2], "solid"),
    "drt": (INK, (0, (6, 1.5, 1, 1.5))),
    "gaussian-after-paraxial": (FIELD_COLOURS[3], (0, (3, 1, 1, 1, 1, 1))),
}

_NOTHING: Mapping[str, float] = {}

#: Object distances in m that may be marked on an axis, in order of preference.
_MARKS = (10, 100, 20, 50, 200, 500, 30, 40, 15, 25, 70, 35, 150, 300, 60, 80, 45, 12, 1000, *range(11, 50))


@styled
def loss_figure(joint: Curves, refined: Curves, steps_per_epoch: int) -> Figure:
    """Mean loss of every epoch, of step 1 and of step 2: means over seeds, and their range."""
    figure = new_figure(7.2, 3.3)
    axes = figure.subplots(1, 2, sharey=True)
    titles = ("Step 1: own PSF model", "Step 2: DRT PSFs, optics frozen")
    for panel, curves, title in zip(axes, (joint, refined), titles, strict=True):
        for model, seeds in curves.items():
            count = max(1, min(map(len, seeds)) // steps_per_epoch)
            epochs = [np.reshape(losses[: count * steps_per_epoch], (count, -1)).mean(1) for losses in seeds]
            _band(panel, np.arange(1, count + 1), epochs, model)
        panel.set(title=title, xlabel="epoch")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes[0].set_ylabel("training loss (mean L¹)")
    _legend(figure, axes[0])
    return figure


@styled
def focus_figure(
    sensors: Curves,
    conjugates: tuple[Sequence[float], Sequence[float]],
    steps_per_epoch: int,
    paper: Mapping[str, float] = _NOTHING,
) -> Figure:
    """The sensor distance in training; on the right axis the object distance whose paraxial image is there.

    conjugates: sensor distances in mm, ascending, and object distances in m; paper: focus in m.
    """
    figure = new_figure(5.6, 3.5)
    panel = figure.subplots()
    for model, seeds in sensors.items():
        shortest = min(map(len, seeds))
        _band(panel, np.arange(shortest) / steps_per_epoch, [course[:shortest] for course in seeds], model)
    panel.set(xlabel="epoch", ylabel="sensor behind the last surface (mm)")
    panel.set_xlim(left=0)
    panel.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    places, distances = (np.asarray(values) for values in conjugates)
    order = np.argsort(distances)
    images = {model: float(np.interp(z, distances[order], places[order])) for model, z in paper.items()}
    for model, image in images.items():
        panel.axhline(image, color=_look(model)["color"], linestyle="--", linewidth=0.9)
        text = f"paper {paper[model]:g} m"
        offset = -9 if image == min(images.values()) and len(images) > 1 else 2
        panel.annotate(text, (0.99, image), (0, offset), ("axes fraction", "data"), "offset points", ha="right",
                       color=_look(model)["color"], fontsize=7)  # fmt: skip
    _legend(figure, panel)
    scale = panel.twinx()
    scale.set_ylim(panel.get_ylim())
    marks = focus_marks(conjugates, *panel.get_ylim())
    scale.set_yticks(list(marks.values()), [f"{distance} m" for distance in marks])
    scale.set_ylabel("object in paraxial focus")
    scale.spines["right"].set_visible(True)
    return figure


def focus_marks(conjugates: tuple[Sequence[float], Sequence[float]], low: float, high: float) -> dict[int, float]:
    """Round object distances in m and their sensor distances from low to high, at least a twelfth of that range apart.

    conjugates: sensor distances in mm, ascending, and object distances in m.
    """
    sensors, distances = (np.asarray(values) for values in conjugates)
    order, marks = np.argsort(distances), {}
    for mark in _MARKS:
        place = float(np.interp(mark, distances[order], sensors[order]))
        is_free = all(abs(place - other) > (high - low) / 12 for other in marks.values())
        if distances.min() <= mark <= distances.max() and low <= place <= high and is_free:
            marks[mark] = place
    return dict(sorted(marks.items()))


@styled
def blur_figure(
    distances: Sequence[float],
    diameters: Mapping[str, Sequence[float]],
    pixel: float,
    paper: Mapping[str, float] = _NOTHING,
) -> Figure:
    """RMS blur diameter (mm) of the optimised lenses over object distance (mm), and the width of a pixel; paper: focus
    in m."""
    figure = new_figure(5.6, 3.5)
    panel = figure.subplots()
    for model, values in diameters.items():
        panel.plot(np.asarray(distances) / 1e3, 1e3 * np.asarray(values), **_look(model))
    panel.axhline(1e3 * pixel, color=GREY, linewidth=0.7)
    panel.annotate("one pixel", (1, 1e3 * pixel), (-2, 3), ("axes fraction", "data"), "offset points", ha="right",
                   color=GREY, fontsize=7.5)  # fmt: skip
    highest = 1e3 * max((max(values) for values in diameters.values()), default=0.0)
    for model, focus in paper.items():
        panel.axvline(focus, color=_look(model)["color"], linestyle="--", linewidth=0.9)
        panel.annotate(f"paper's focus {focus:g} m", (focus, highest), (-8, 0), "data", "offset points", rotation=90,
                       va="top", color=_look(model)["color"], fontsize=7)  # fmt: skip
    panel.set(xlabel="object distance (m)", ylabel="RMS blur diameter, traced rays (µm)")
    panel.set_ylim(bottom=0)
    _legend(figure, panel)
    return figure


@styled
def distance_figure(distances: Sequence[float], losses: Curves, paper: Mapping[str, float] = _NOTHING) -> Figure:
    """Test loss on DRT PSFs after step 2 over object distance (mm): means over seeds, and their range.

    paper: the loss of all distances.
    """
    figure = new_figure(5.6, 3.5)
    panel = figure.subplots()
    for model, seeds in losses.items():
        _band(panel, np.asarray(distances) / 1e3, seeds, model, marker="o")
    heights = sorted(paper.values())
    for model, loss in paper.items():
        panel.axhline(loss, color=_look(model)["color"], linestyle="--", linewidth=0.9)
        text = f"paper, mean of all distances: {NAMES[model]} {loss:.4f}"
        offset = -9 if heights.index(loss) == len(heights) - 2 else 2  # the two highest may be close
        panel.annotate(text, (0.01, loss), (0, offset), ("axes fraction", "data"), "offset points",
                       color=_look(model)["color"], fontsize=7)  # fmt: skip
    panel.set(xlabel="object distance (m)", ylabel="test loss with DRT PSFs (mean L¹)")
    _legend(figure, panel)
    return figure


@styled
def examples_figure(rows: Mapping[str, Mapping[str, np.ndarray]], distances: Sequence[float]) -> Figure:
    """The object, and its blurred and noisy image (left half of a panel) and restoration (right half): a row for each
    model, a column for each distance (mm), with the mean absolute error of the whole restored patch."""
    figure = new_figure(1.45 * (len(distances) + 1) + 0.3, 1.68 * len(rows) + 0.3)
    axes = figure.subplots(len(rows), len(distances) + 1, squeeze=False)
    for panels, (model, patches) in zip(axes, rows.items(), strict=True):
        show_image(panels[0], patches["picture"][0])
        panels[0].set_ylabel(NAMES[model].replace(" from ", "\nfrom "), fontsize=9)
        for panel, picture, image, restored in zip(
            panels[1:], patches["picture"], patches["image"], patches["restored"], strict=True
        ):
            half = image.shape[-1] // 2
            show_image(panel, np.concatenate([image[:, :half], restored[:, half:]], 1))
            panel.axvline(half - 0.5, color="white", linewidth=1.2)
            panel.set_xlabel(f"L¹ {np.abs(restored - picture).mean():.3f}", fontsize=8, labelpad=2)
    for panel, title in zip(axes[0], ["object", *(f"{z / 1e3:g} m" for z in distances)], strict=True):
        panel.set_title(title, fontsize=9)
    axes[0, 1].set_title(f"{distances[0] / 1e3:g} m\nsensor image | restored", fontsize=8)
    return figure


@styled
def scan_figure(
    sensors: Sequence[float], errors: Mapping[str, Sequence[float]], trained: Mapping[str, float]
) -> Figure:
    """Closed-form error over the sensor distance (mm) for each model, its minimum, and the end of training."""
    figure = new_figure(5.6, 3.7)
    panel = figure.subplots()
    for model, values in errors.items():
        panel.plot(sensors, values, **_look(model))
        best, colour = int(np.argmin(values)), _look(model)["color"]
        panel.plot(sensors[best], values[best], "o", color=colour, markersize=4)
        if model in trained:
            error = np.interp(trained[model], sensors, values)
            panel.plot(trained[model], error, "D", color=colour, markerfacecolor="white", markersize=5)
    panel.set(xlabel="sensor behind the last surface (mm)", ylabel="mean square error, best linear filter")
    marks = [Line2D([], [], color=GREY, linestyle="", marker="o", markersize=4, label="minimum")]
    if trained:
        diamond = {"marker": "D", "markerfacecolor": "white"}
        marks.append(Line2D([], [], color=GREY, linestyle="", label="end of training", **diamond))
    _legend(figure, panel, marks)
    return figure


def _legend(figure: Figure, panel: Axes, more: Sequence[Line2D] = ()) -> None:
    """Above the axes, where no curve runs."""
    handles = [*panel.get_legend_handles_labels()[0], *more]
    columns = len(handles) if len(handles) <= 4 or figure.get_figwidth() > 9 else 3
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, handlelength=3)


def _look(model: str) -> dict:
    colour, dashes = LOOKS.get(model, (GREY, "solid"))
    return {"color": colour, "linestyle": dashes, "label": NAMES[model]}


def _band(panel: Axes, x: np.ndarray, seeds: Sequence[Sequence[float]], model: str, marker: str = "") -> None:
    values = np.stack([np.asarray(curve, dtype=float) for curve in seeds])
    panel.plot(x, values.mean(0), **_look(model), marker=marker, markersize=3)
    if len(values) > 1:
        panel.fill_between(x, values.min(0), values.max(0), color=_look(model)["color"], alpha=0.14, linewidth=0)
