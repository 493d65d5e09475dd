"""How the figures look: fonts, colours, the wording of numbers; and how a figure is saved."""

import functools
import io
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

from raytrace.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.lines import Line2D
    from mpl_toolkits.mplot3d.axes3d import Axes3D
else:  # slow to load
    Axes = Axes3D = Figure = SubFigure = Line2D = Any

Arguments = ParamSpec("Arguments")
Drawn = TypeVar("Drawn")

INK = "#262626"
GREY = "#7a7a7a"
FAINT = "#d0d0d0"

#: Colours of the fields: Okabe and Ito's set, distinct for colour-blind readers; the first three differ most.
FIELD_COLOURS = ("#0072B2", "#009E73", "#D55E00", "#CC79A7", "#E69F00", "#56B4E9", "#6A51A3", "#525252")

#: Colours of wavelengths the eye does not see, and markers of all wavelengths, in order.
INVISIBLE_COLOURS = ("#7a1f1f", "#525252", "#8c6d31", "#5e3c99", "#1b6f6a", "#b0578d")
GLASS_COLOURS = ("#e9f2f8", "#86b3d1")  # at n = 1.4 and n = 2.0
WAVELENGTH_MARKERS = ("o", "+", "x", "^", "s", "D", "v", "*")

#: Formats of `save` by suffix, with the metadata that would otherwise differ from file to file.
SUFFIXES: dict[str, dict[str, None]] = {".png": {}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
_PNG = {"compress_level": 4}  # of zlib; its default, 6, takes a fifth longer to save a figure, for 1 to 10 % less

_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.labelsize": 8.5,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "axes.unicode_minus": True,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.color": INK,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
    "hatch.linewidth": 0.5,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "raytrace",
    "savefig.facecolor": "white",
}


def styled(function: Callable[Arguments, Drawn]) -> Callable[Arguments, Drawn]:
    """Run a function under the style of these figures; the settings of the user's own figures do not change."""

    @functools.wraps(function)
    def wrapper(*arguments: Arguments.args, **options: Arguments.kwargs) -> Drawn:
        import matplotlib

        with matplotlib.rc_context(_STYLE):
            return function(*arguments, **options)

    return wrapper


def new_figure(width: float, height: float) -> Figure:
    """A figure of width × height inches with a canvas, which a notebook shows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150, facecolor="white")
    figure.set_layout_engine("constrained", w_pad=0.07, h_pad=0.07)
    FigureCanvasAgg(figure)
    setattr(figure, "_repr_png_", functools.partial(_png, figure))  # noqa: B010, IPython shows figures of pyplot alone
    return figure


@styled
def _png(figure: Figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


@styled
def save(figure: Figure, path: str | os.PathLike, *, dpi: float = 200) -> None:
    """Write a figure as .png, .pdf or .svg by its suffix; the file is replaced as a whole or not at all.

    The same figure, built again, gives the same bytes. Raises ValueError for another suffix, OSError where nothing can
    be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        ending = f"the suffix {Path(path).suffix!r}" if suffix else "no suffix"
        raise ValueError(f"{path}: {ending} is no format of figures; expected one of {', '.join(SUFFIXES)}")
    options: dict[str, Any] = {"pil_kwargs": _PNG} if suffix == ".png" else {}
    metadata = SUFFIXES[suffix]
    write_atomically(path, lambda file: figure.savefig(file, format=suffix[1:], dpi=dpi, metadata=metadata, **options))


def array(tensor: Tensor) -> np.ndarray:
    """The numbers of a tensor, for drawing."""
    return tensor.detach().to(device="cpu", dtype=torch.float64 if tensor.is_floating_point() else None).numpy()


def tint(index: float) -> tuple[float, ...]:
    """The colour of glass by its index."""
    from matplotlib.colors import to_rgb

    light, dark = (np.array(to_rgb(colour)) for colour in GLASS_COLOURS)
    share = min(max((index - 1.4) / 0.6, 0.0), 1.0)
    return tuple(light + share * (dark - light))


def field_colour(number: int) -> str:
    return FIELD_COLOURS[number % len(FIELD_COLOURS)]


def field_colours(count: int) -> list[str]:
    """A colour for each of so many fields; where there are too many to name, from dark to bright in their order."""
    if count <= len(FIELD_COLOURS):
        return [field_colour(f) for f in range(count)]
    import matplotlib
    from matplotlib.colors import to_hex

    return [to_hex(matplotlib.colormaps["viridis"](0.92 * f / (count - 1))) for f in range(count)]


def wavelength_colours(wavelengths: Sequence[float]) -> list[str | tuple[float, float, float]]:
    """A colour for each wavelength in µm: the one the eye sees, dark enough for a white page, where it sees one."""
    colours: list[str | tuple[float, float, float]] = []
    unseen = 0
    for wavelength in wavelengths:
        if 0.39 <= wavelength <= 0.75:
            colours.append(_spectral_colour(float(wavelength)))
        else:
            colours.append(INVISIBLE_COLOURS[unseen % len(INVISIBLE_COLOURS)])
            unseen += 1
    return colours


def ray_colours(fields: int, wavelengths: Sequence[float]) -> list[list]:
    """A colour for the rays of every wavelength and field: by wavelength where there are several, else by field."""
    if len(wavelengths) > 1:
        return [[colour] * fields for colour in wavelength_colours(wavelengths)]
    return [field_colours(fields)]


def _spectral_colour(wavelength: float) -> tuple[float, float, float]:
    """Hues by wavelength, interpolated; chosen by eye for legibility rather than for colorimetry."""
    from matplotlib.colors import to_rgb

    knots = {
        0.39: "#5b1a9a", 0.43: "#4421b8", 0.46: "#1f3fd1", 0.49: "#0077b6", 0.51: "#008f7a", 0.53: "#0a8f3c",
        0.555: "#3f9a12", 0.575: "#8a9400", 0.59: "#c78500", 0.61: "#dd5f00", 0.64: "#d62828", 0.75: "#8b0f14",
    }  # fmt: skip
    channels = np.array([to_rgb(colour) for colour in knots.values()]).T
    red, green, blue = (float(np.interp(wavelength, list(knots), channel)) for channel in channels)
    return red, green, blue


def length_text(length: float, digits: int = 4) -> str:
    """A length in mm with a suitable unit: µm below 0.1 mm, m from 10 m, km from 10 km."""
    if math.isinf(length):
        return "∞"
    scales = ((0.1, 1e3, "µm"), (1e4, 1.0, "mm"), (1e7, 1e-3, "m"), (math.inf, 1e-6, "km"))
    scale, unit = next((scale, unit) for limit, scale, unit in scales if abs(length) < limit)
    return f"{number_text(length * scale, digits)} {unit}"


def number_text(value: float, digits: int = 4) -> str:
    """A number to so many significant digits, never in exponents between 1e-4 and 1e6."""
    if not math.isfinite(value):
        return "∞" if math.isinf(value) else "–"
    if value == 0 or not 1e-4 <= abs(value) < 1e6:
        return _minus(f"{value:.{digits}g}")
    rounded = abs(float(f"{value:.{digits - 1}e}"))  # 99.9999 is 100.0, not 100.00
    return _minus(f"{value:.{max(digits - 1 - math.floor(math.log10(rounded)), 0)}f}")


def micrometres(length: float) -> str:
    """A length in mm written in µm, four significant digits."""
    return f"{number_text(1e3 * length)} µm"


def round_length(length: float) -> float:
    """The largest of 1, 2, 5 × 10^n that is not above a length."""
    decade = 10.0 ** math.floor(math.log10(length))
    return max(step for step in (decade, 2 * decade, 5 * decade) if step <= length * (1 + 1e-9))


def round_text(length: float) -> str:
    """A round length in mm, without zeros behind the point: `50 µm`, `20 mm`, `1 m`."""
    scale, unit = (1e3, "µm") if length < 0.9 else (1.0, "mm") if length < 900 else (1e-3, "m")
    return f"{length * scale:.6g} {unit}"


def scale_bar(axes: Axes, x: float, y: float, length: float, align: str = "center") -> None:
    """A bar of a length in mm that starts at (x, y), its length written above it: centred, or from its "left"."""
    axes.plot([x, x + length], [y, y], color=INK, linewidth=1.6, solid_capstyle="butt", clip_on=False, zorder=6)
    place = (x if align == "left" else x + length / 2, y)
    axes.annotate(
        round_text(length), place, (0, 3), textcoords="offset points", ha=align, va="bottom", fontsize=7.5, zorder=6,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6},
    )  # fmt: skip


def bar_on_dark(axes: Axes, x: float, y: float, length: float, words: str = "", *, unit: float = 1.0) -> None:
    """A white bar of a length in mm from (x, y), on axes of so many mm a unit, its length written above it."""
    from matplotlib.patheffects import withStroke

    dark = [withStroke(linewidth=1.6, foreground="black")]  # legible on bright kernels too
    frame = [withStroke(linewidth=3.0, foreground="black")]
    axes.plot([x, x + length / unit], [y, y], color="white", linewidth=1.6, zorder=6, path_effects=frame)
    axes.annotate(
        words or round_text(length), (x, y), (0, 3), textcoords="offset points", color="white", fontsize=7, va="bottom",
        zorder=6, path_effects=dark,
    )  # fmt: skip


def show_image(panel: Axes, values: np.ndarray | Tensor, title: str = "", *, top: float = 1.0, **drawing: Any) -> None:
    """A grey or coloured image from 0 to `top`."""
    options: dict[str, Any] = {"cmap": "gray", "vmin": 0, "vmax": top, "interpolation": "nearest"}
    panel.imshow(values, **options | drawing)
    panel.set(xticks=[], yticks=[])
    panel.set_title(title, fontsize=7.5)
    for spine in panel.spines.values():
        spine.set_visible(False)


def framed(panel: Axes) -> None:
    """A panel with a thin grey frame and no ticks."""
    panel.set(xticks=[], yticks=[])
    for spine in panel.spines.values():
        spine.set_visible(True)
        spine.set_color(GREY)


def legend_entry(label: str, **look: Any) -> Line2D:
    """A line or marker of a legend that no curve has."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **look)


def text_width(text: str, size: float) -> float:
    """Points that a line of text of a size in points takes."""
    return sum(_width(word, size, False) for word in text.split(" ")) + text.count(" ") * _width(" ", size, False)


def fill(text: str, width: float, size: float, *, bold: bool = False) -> str:
    """A text of a size in points in lines no wider than a figure of a width in inches, by the widths of its letters.

    Lines that are there stay; a word wider than the figure is left whole.
    """
    space = _width(" ", size, bold)
    room, lines = 72 * width - 2 * size, []
    for paragraph in text.splitlines():
        line, length = "", 0.0
        for word in paragraph.split(" "):
            width_of_word = _width(word, size, bold)
            if line and length + space + width_of_word > room:
                lines.append(line)
                line, length = "", 0.0
            line, length = (f"{line} {word}", length + space + width_of_word) if line else (word, width_of_word)
        lines.append(line)
    return "\n".join(lines)


@functools.lru_cache(maxsize=8192)
def _width(word: str, size: float, bold: bool) -> float:
    """Points that a word of a size in points takes, from where it begins to where the next letter would."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(family=_STYLE["font.family"], size=size, weight="bold" if bold else "normal")
    between, none = (
        text_to_path.get_text_width_height_descent(letters, font, ismath=False)[0] for letters in (f"n{word}n", "nn")
    )
    return between - none


def _minus(text: str) -> str:
    return text.replace("-", "−")
