"""Figures of co-design runs: loss and focus in training, blur and loss over object distance, restored pictures.

And the error of the closed form over the sensor distance.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from raytrace.plotting.images import show_image
from raytrace.plotting.style import GREY, LOOKS, new_figure, styled
from raytrace.settings import NAMES

#: Object distances in m that may be marked on an axis, the roundest first.
_MARKS = (10, 100, 20, 50, 200, 500, 30, 40, 15, 25, 70, 35, 150, 300, 60, 80, 45, 12, 1000, *range(11, 50))

#: Values over steps or distances, one list for each seed.
Curves = Mapping[str, Sequence[Sequence[float]]]


@styled
def loss_figure(joint: Curves, refined: Curves, steps_per_epoch: int):
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
def focus_figure(sensors: Curves, conjugates: tuple[Sequence[float], Sequence[float]], steps_per_epoch: int):
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
def blur_figure(distances: Sequence[float], diameters: Mapping[str, Sequence[float]], pixel: float):
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
def distance_figure(distances: Sequence[float], losses: Curves):
    """Test loss on DRT PSFs after step 2 over object distance (mm): means over seeds, and their range."""
    figure = new_figure(5.6, 3.5)
    panel = figure.subplots()
    for model, seeds in losses.items():
        _band(panel, np.asarray(distances) / 1e3, seeds, model, marker="o")
    panel.set(xlabel="object distance (m)", ylabel="test loss with DRT PSFs (mean L¹)")
    _legend(figure, panel)
    return figure


@styled
def examples_figure(rows: Mapping[str, Mapping[str, np.ndarray]], distances: Sequence[float]):
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
            show_image(panel, picture)
        panels[0].set_ylabel(NAMES[model].replace(" from ", "\nfrom "))
    axes[0][0].set_title("picture", fontsize=8)
    for number, distance in enumerate(distances):
        axes[0][2 * number + 1].set_title(f"{distance / 1e3:g} m: image", fontsize=8)
        axes[0][2 * number + 2].set_title("restored", fontsize=8)
    return figure


@styled
def scan_figure(
    sensors: Sequence[float], errors: Mapping[str, Sequence[float]], trained: Mapping[str, float]
):
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


def _apart(places: Mapping[float, float], low: float, high: float, parts: int) -> dict[float, float]:
    """Of marks with their places those from low to high, none nearer to an earlier one than 1/parts of that."""
    chosen: dict[float, float] = {}
    for mark, place in places.items():
        if low <= place <= high and all(abs(place - other) > (high - low) / parts for other in chosen.values()):
            chosen[mark] = place
    return chosen


def _legend(figure, panel, more: Sequence[Line2D] = ()) -> None:
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


def _band(panel, x: np.ndarray, seeds: Sequence[Sequence[float]], model: str, marker: str = "") -> None:
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
