"""Figures of a co-design study: loss and focus in training, blur and loss over object distance, restored pictures."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from raytrace.plot.style import FIELD_COLOURS, GREY, INK, new_figure, styled

#: What the models are called and how they are drawn: colour and dashes, to be told apart in print.
MODELS = {
    "paraxial": ("paraxial", FIELD_COLOURS[0], (0, (5, 2))),
    "fourier": ("Fourier", FIELD_COLOURS[1], (0, (1, 1.2))),
    "gaussian": ("Gaussian DRT", FIELD_COLOURS[2], "solid"),
    "drt": ("DRT", INK, (0, (6, 1.5, 1, 1.5))),
    "gaussian-after-paraxial": ("Gaussian DRT from paraxial", FIELD_COLOURS[3], (0, (3, 1, 1, 1, 1, 1))),
}

#: Values over steps or distances, one list for each seed.
Curves = Mapping[str, Sequence[Sequence[float]]]


@styled
def loss_figure(joint: Curves, refined: Curves, steps_per_epoch: int) -> Figure:
    """Mean loss of every epoch, of step 1 and of step 2: means over seeds, and their range."""
    figure = new_figure(7.2, 3.0)
    axes = figure.subplots(1, 2, sharey=True)
    for panel, curves, title in zip(
        axes, (joint, refined), ("Step 1: own PSF model", "Step 2: DRT PSFs, optics frozen"), strict=True
    ):
        for model, seeds in curves.items():
            epochs = [_means(losses, steps_per_epoch) for losses in seeds]
            _band(panel, np.arange(1, len(epochs[0]) + 1), epochs, model)
        panel.set(title=title, xlabel="epoch")
        panel.set_xlim(left=0)
    axes[0].set_ylabel("training loss (mean L¹)")
    axes[0].legend()
    return figure


@styled
def focus_figure(sensors: Curves, conjugates: tuple[Sequence[float], Sequence[float]], steps_per_epoch: int) -> Figure:
    """The sensor over training, and on the right the object distance whose paraxial image it is.

    conjugates: sensor distances in mm, ascending, and object distances in m.
    """
    figure = new_figure(5.2, 3.2)
    panel = figure.subplots()
    for model, seeds in sensors.items():
        shortest = min(map(len, seeds))
        _band(panel, np.arange(shortest) / steps_per_epoch, [s[:shortest] for s in seeds], model)
    panel.set(xlabel="epoch", ylabel="sensor behind the last surface (mm)")
    panel.set_xlim(left=0)
    panel.legend()
    scale = panel.twinx()
    scale.set_ylim(panel.get_ylim())
    low, high = panel.get_ylim()
    marks = [z for z in (10, 15, 20, 25, 30, 35, 40, 50, 70, 100, 200, 500) if _between(z, conjugates, low, high)]
    scale.set_yticks([_image(z, conjugates) for z in marks])
    scale.set_yticklabels([f"{z} m" for z in marks])
    scale.set_ylabel("paraxial conjugate of the sensor")
    scale.spines["right"].set_visible(True)
    return figure


@styled
def blur_figure(distances: Sequence[float], diameters: Mapping[str, Sequence[float]], pixel: float) -> Figure:
    """RMS blur diameter (mm) of the optimised lenses over object distance (mm), beside a pixel."""
    figure = new_figure(5.2, 3.2)
    panel = figure.subplots()
    for model, values in diameters.items():
        name, colour, dashes = _look(model)
        panel.plot(np.asarray(distances) / 1e3, 1e3 * np.asarray(values), color=colour, linestyle=dashes, label=name)
    panel.axhline(1e3 * pixel, color=GREY, linewidth=0.7)
    panel.annotate("one pixel", (1, 1e3 * pixel), (-2, 3), ("axes fraction", "data"), "offset points", ha="right",
                   color=GREY, fontsize=7.5)  # fmt: skip
    panel.set(xlabel="object distance (m)", ylabel="RMS blur diameter, traced rays (µm)")
    panel.set_ylim(bottom=0)
    panel.legend()
    return figure


@styled
def distance_figure(distances: Sequence[float], losses: Curves) -> Figure:
    """Test loss on DRT PSFs after step 2 over object distance (mm): means over seeds, and their range."""
    figure = new_figure(5.2, 3.2)
    panel = figure.subplots()
    for model, seeds in losses.items():
        _band(panel, np.asarray(distances) / 1e3, seeds, model, marker="o")
    panel.set(xlabel="object distance (m)", ylabel="test loss with DRT PSFs (mean L¹)")
    panel.legend()
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
            panel.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            panel.set(xticks=[], yticks=[])
            for spine in panel.spines.values():
                spine.set_visible(False)
        panels[0].set_ylabel(_look(model)[0])
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
    figure = new_figure(5.6, 3.4)
    panel = figure.subplots()
    for model, values in errors.items():
        name, colour, dashes = _look(model)
        values = np.asarray(values)
        panel.plot(sensors, values, color=colour, linestyle=dashes, label=name)
        best = int(values.argmin())
        panel.plot(sensors[best], values[best], "o", color=colour, markersize=4)
        if model in trained:
            place = trained[model]
            panel.plot(
                place, np.interp(place, sensors, values), "D", color=colour, markerfacecolor="white", markersize=5
            )
    panel.set(xlabel="sensor behind the last surface (mm)", ylabel="mean square error, best linear filter")
    panel.set_title("● least closed-form error   ◇ where training with the network ended", color=GREY, fontsize=8)
    panel.legend()
    return figure


def _look(model: str) -> tuple[str, str, object]:
    return MODELS.get(model, (model, INK, "solid"))


def _means(losses: Sequence[float], steps_per_epoch: int) -> np.ndarray:
    whole = max(1, len(losses) // steps_per_epoch)
    return np.asarray(losses[: whole * steps_per_epoch]).reshape(whole, -1).mean(1)


def _band(panel: Axes, x: np.ndarray, seeds: Sequence[Sequence[float]], model: str, marker: str = "") -> None:
    name, colour, dashes = _look(model)
    values = np.stack([np.asarray(seed, dtype=float) for seed in seeds])
    panel.plot(x, values.mean(0), color=colour, linestyle=dashes, label=name, marker=marker, markersize=3)
    if len(values) > 1:
        panel.fill_between(x, values.min(0), values.max(0), color=colour, alpha=0.18, linewidth=0)


def _image(distance: float, conjugates: tuple[Sequence[float], Sequence[float]]) -> float:
    """Sensor distance of an object distance: images move towards the lens as objects move away."""
    sensors, distances = (np.asarray(c) for c in conjugates)
    order = np.argsort(distances)
    return float(np.interp(distance, distances[order], sensors[order]))


def _between(distance: float, conjugates, low: float, high: float) -> bool:
    nearest, furthest = min(conjugates[1]), max(conjugates[1])
    return nearest <= distance <= furthest and low <= _image(distance, conjugates) <= high
