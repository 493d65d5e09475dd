"""The figure of a co-design run: the loss over the steps of training or over the evaluations of the closed form."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from raytrace.plotting.style import FIELD_COLOURS, new_figure, styled


class HasCurves(Protocol):
    curves: Mapping[str, Sequence[float]]


@styled
def learning_figure(result: HasCurves) -> Figure:
    """Every curve one after the other; noisy ones faint, with their running mean over a fiftieth of the curve."""
    figure = new_figure(5.6, 3.2)
    panel, start = figure.subplots(), 0
    for number, (name, losses) in enumerate(result.curves.items()):
        steps = np.arange(start, start + len(losses))
        width = max(1, len(losses) // 50)
        panel.plot(steps, losses, color=FIELD_COLOURS[number], linewidth=0.6, alpha=1.0 if width == 1 else 0.3)
        means = np.convolve(losses, np.full(width, 1 / width), "valid")
        panel.plot(steps[width - 1 :], means, color=FIELD_COLOURS[number], label=name)
        start += len(losses)
    is_training = len(result.curves) > 1
    panel.set(xlabel="step" if is_training else "evaluation")
    panel.set_ylabel("training loss (mean L¹)" if is_training else "mean square error, best linear filter")
    if is_training:
        panel.legend()
    return figure
