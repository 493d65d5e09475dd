"""The picture of the book's first page, docs/front.png: `python docs/front.py`.

The code of docs/index.md is run as it stands there; here its results are drawn.
"""

import re
from pathlib import Path

from PIL import Image

import raytrace as rt
from raytrace.analysis.layout import draw_layout
from raytrace.plotting.style import new_figure, styled
from raytrace.system.lens import field_points

DOCS = Path(__file__).parent
MARGIN = 60  # pixels at the border of a picture that are not shown


def results() -> dict:
    """Names of the first block of Python of the page, run."""
    names: dict = {}
    exec(re.search(r"^```python\n(.*?)^```", (DOCS / "index.md").read_text("utf-8"), re.M | re.S)[1], names)
    return names


@styled
def picture(lens, scene, psfs, images, restored):
    """Lens and scene on the left; on the right a column for each field with its PSF, image and restored picture."""
    figure = new_figure(10.2, 5.9)
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.45))
    layout, whole = left.subplots(2, 1, height_ratios=(1, 1.6))
    fields = field_points(None, like=lens)
    draw_layout(layout, lens, fields=fields, rays=5)
    layout.set_title("lens", fontsize=9)
    show(whole, scene, "scene")
    inside = (slice(None), *2 * (slice(MARGIN, -MARGIN),))
    panels = right.subplots(3, len(psfs))
    for column, psf, image, estimate, angle in zip(panels.T, psfs, images, restored, fields[1].tolist(), strict=True):
        window = psf[..., 8:-8, 8:-8].clamp_min(0)
        show(column[0], (window / window.amax((-2, -1), keepdim=True)).sqrt(), f"PSF at {angle:g}°")
        for panel, one, name in ((column[1], image, "image"), (column[2], estimate, "restored")):
            ratio = float(rt.imaging.psnr((one - scene)[inside].square().mean()))
            show(panel, one[inside], f"{name}, {ratio:.1f} dB")
    return figure


def show(panel, colours, title: str) -> None:
    panel.imshow(colours.movedim(0, -1).clamp(0, 1), interpolation="nearest")
    panel.set_title(title, fontsize=9)
    panel.axis("off")


if __name__ == "__main__":
    names = results()
    drawn = picture(*(names[name] for name in ("lens", "scene", "psfs", "images", "restored")))
    drawn.savefig(DOCS / "front.png", dpi=100)
    with Image.open(DOCS / "front.png") as full:
        reduced = full.convert("RGB").quantize(192)
    reduced.save(DOCS / "front.png", optimize=True)
