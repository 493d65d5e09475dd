"""What figures of studies share: a picture in a panel without axes."""

from matplotlib.axes import Axes


def picture(panel: Axes, values, title: str = "", *, top: float = 1.0, **drawing) -> None:
    """A grey or coloured picture from 0 to `top`."""
    panel.imshow(values, **{"cmap": "gray", "vmin": 0, "vmax": top, "interpolation": "nearest"} | drawing)
    panel.set(xticks=[], yticks=[])
    panel.set_title(title, fontsize=7.5)
    for spine in panel.spines.values():
        spine.set_visible(False)
