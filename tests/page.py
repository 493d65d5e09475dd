"""What is wrong with the words of a figure, as they would be printed."""

from matplotlib.axes import Axes
from matplotlib.text import Text


def _ticks(axis) -> list:
    return [*axis.get_major_ticks(), *axis.get_minor_ticks()]


def outside(figure) -> list[str]:
    """The words that leave the canvas or lie over each other."""
    figure.canvas.draw()
    renderer, page = figure.canvas.get_renderer(), figure.bbox
    axes = [axis for panel in figure.findobj(Axes) for axis in (panel.xaxis, panel.yaxis)]
    ticks = [{label for tick in ticks for label in (tick.label1, tick.label2)} for ticks in map(_ticks, axes)]
    shown = {label for axis in axes for tick in axis._update_ticks() for label in (tick.label1, tick.label2)}
    unseen = set().union(*ticks) - shown  # beyond the limits of their axis, or of axes that are switched off
    unseen |= {label for panel in figure.findobj(Axes) if not panel.axison for label in panel.findobj(Text)} - {
        text for panel in figure.findobj(Axes) for text in (*panel.texts, panel.title)
    }
    said = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip() and t not in unseen]
    boxes = [(t.get_text(), t.get_window_extent(renderer)) for t in said]
    boxes = [(words, box) for words, box in boxes if box.width > 0]
    lost = [w for w, b in boxes if b.x0 < -1 or b.y0 < -1 or b.x1 > page.x1 + 1 or b.y1 > page.y1 + 1]
    for k, (words, box) in enumerate(boxes):
        for other, place in boxes[:k]:
            across = min(box.x1, place.x1) - max(box.x0, place.x0)
            along = min(box.y1, place.y1) - max(box.y0, place.y0)
            if across > 2 and along > 2:
                lost.append(f"{words!r} over {other!r}")
    return lost
