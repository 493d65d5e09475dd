"""Paper: lines and texts of a sheet of A4 in mm, and its figure."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from raytrace.plotting import style

WIDTH, HEIGHT, MARGIN = 297.0, 210.0, 8.0
POINT = 25.4 / 72  # mm

#: Scales of a drawing, from the largest.
SCALES = tuple(float(f"{digit}e{power}") for power in (1, 0) for digit in (5, 2, 1)) + tuple(
    1 / float(f"{digit}e{power}") for power in range(5) for digit in (1, 2, 5) if (power, digit) != (0, 1)
)

#: Width in points, colour and dashes of lines.
LINES: dict[str, tuple[float, str, Any]] = {
    "outline": (1.0, style.INK, "solid"),
    "frame": (0.7, style.INK, "solid"),
    "thin": (0.4, style.INK, "solid"),
    "axis": (0.5, style.GREY, (0, (10, 3, 2, 3))),
}


@dataclasses.dataclass
class Paper:
    """A sheet: closed shapes with their tint, lines and texts, in mm from the lower left corner."""

    title: str
    shapes: list[tuple[np.ndarray, Any]] = dataclasses.field(default_factory=list)
    lines: list[tuple[np.ndarray, str]] = dataclasses.field(default_factory=list)
    texts: list[tuple[float, float, str, dict[str, Any]]] = dataclasses.field(default_factory=list)

    def line(self, *points: Sequence[float], kind: str = "thin") -> None:
        self.lines.append((np.array(points).T, kind))

    def box(self, x: float, y: float, width: float, height: float, kind: str = "frame") -> None:
        self.line((x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y), kind=kind)

    def text(self, x: float, y: float, text: str, size: float = 7.0, **look: Any) -> None:
        """A text, its left end in the middle of its height at x, y; size: points; look: of matplotlib's text."""
        self.texts.append((x, y, text, {"fontsize": size, "va": "center", "ha": "left"} | look))

    def fitted(self, x: float, y: float, text: str, width: float, size: float = 7.0, **look: Any) -> None:
        """A text no wider than a width, in smaller letters where it must be."""
        taken = POINT * max(style.text_width(line, size) for line in text.splitlines() or [""])
        self.text(x, y, text, size * min(1.0, width / max(taken, 1e-9)), **look)

    def table(self, x: float, top: float, widths: Sequence[float], rows: Sequence[Sequence[str]], pitch: float) -> None:
        """A table whose first row is its heading, from the upper left corner; pitch: height of a row, mm."""
        size = min(7.0, 0.55 * pitch / POINT)
        for k, row in enumerate(rows):
            left = x
            for width, cell in zip(widths, row, strict=True):
                self.fitted(left + 1, top - (k + 0.5) * pitch, cell, width - 2, size, weight="normal" if k else "bold")
                left += width
            self.line((x, top - (k + 1) * pitch), (x + sum(widths), top - (k + 1) * pitch))
        for edge in np.cumsum([0.0, *widths]):
            self.line((x + edge, top), (x + edge, top - len(rows) * pitch))
        self.box(x, top - len(rows) * pitch, sum(widths), len(rows) * pitch)

    def across(self, left: float, right: float, y: float, ends: Sequence[float], text: str) -> None:
        """A horizontal dimension at y from left to right, with extension lines from the heights of its ends."""
        for x, end in zip((left, right), ends, strict=True):
            self.line((x, end + math.copysign(1, y - end)), (x, y + math.copysign(1.5, y - end)))
        taken = POINT * style.text_width(text, 7.0)
        fits = taken + 4 < right - left
        self._arrows((left, y), (right, y), right - left > 7)
        place = 0.5 * (left + right) if fits else right + (1.5 if right - left > 7 else 6.5)
        self.text(place, y + (1.8 if fits else 0), text, ha="center" if fits else "left")

    def up(self, x: float, low: float, high: float, end: float, text: str) -> None:
        """A vertical dimension at x from low to high, with extension lines from a place `end` along x."""
        for y in (low, high):
            self.line((end + math.copysign(1, x - end), y), (x + math.copysign(1.5, x - end), y))
        self._arrows((x, low), (x, high), high - low > 7)
        self.text(x - 1.8, 0.5 * (low + high), text, ha="center", rotation=90)

    def _arrows(self, start: tuple[float, float], end: tuple[float, float], inside: bool) -> None:
        """A line with an arrow at each end, from outside where there is no room inside."""
        a, b = np.array(start), np.array(end)
        along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
        aside = np.array([-along[1], along[0]])
        out = 0 if inside else 5
        self.line(a - out * along, b + out * along)
        for tip, way in ((a, along if inside else -along), (b, -along if inside else along)):
            corners = np.array([tip, tip + 2.2 * way + 0.4 * aside, tip + 2.2 * way - 0.4 * aside])
            self.shapes.append((corners.T, style.INK))

    @style.styled
    def figure(self) -> style.Figure:
        """The sheet, 297 × 210 mm."""
        figure = style.new_figure(WIDTH / 25.4, HEIGHT / 25.4)
        figure.set_layout_engine("none")
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, WIDTH), ylim=(0, HEIGHT))
        axes.axis("off")
        for (x, y), colour in self.shapes:
            axes.fill(x, y, facecolor=colour, edgecolor="none", zorder=1)
        for (x, y), kind in self.lines:
            width, colour, dashes = LINES[kind]
            axes.plot(x, y, color=colour, linewidth=width, linestyle=dashes, solid_joinstyle="miter", zorder=2)
        for x, y, text, look in self.texts:
            axes.text(x, y, text, **{"zorder": 3} | look)
        return figure


def scale_for(width: float, height: float, room: tuple[float, float]) -> float:
    """The largest scale of SCALES in which a drawing of mm fits a room of mm."""
    fitting = (scale for scale in SCALES if width * scale <= room[0] and height * scale <= room[1])
    return next(fitting, SCALES[-1])


def scale_text(scale: float) -> str:
    return f"{scale:g} : 1" if scale >= 1 else f"1 : {1 / scale:g}"
