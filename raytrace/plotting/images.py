"""An image in a panel without axes."""



def show_image(panel, values, title: str = "", *, top: float = 1.0, **drawing) -> None:
    """A grey or coloured image from 0 to `top`."""
    panel.imshow(values, **{"cmap": "gray", "vmin": 0, "vmax": top, "interpolation": "nearest"} | drawing)
    panel.set(xticks=[], yticks=[])
    panel.set_title(title, fontsize=7.5)
    for spine in panel.spines.values():
        spine.set_visible(False)
