"""Layout: the cross section of a lens in the y-z plane with the rays of its fields."""

import math

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from raytrace.maths.pupil import fan
from raytrace.optics.launch import stop_radius
from raytrace.optics.paraxial import first_order
from raytrace.optics.trace import media
from raytrace.optics.views import Layout
from raytrace.plot import outline, style
from raytrace.system.aperture import reach
from raytrace.system.lens import Lens

_LEAD = 0.14  # of the length of the lens: how far in front of it rays of a far object start
_NEAR = 1.5  # an object nearer than this many lengths of the lens is drawn
_GLASS = ("#e9f2f8", "#86b3d1")  # tints at n = 1.4 and n = 2.0


@style.styled
def layout(found: Layout) -> Figure:
    """The lens in cross section: glass filled by index, mirrors hatched, the stop marked, rays coloured by field.

    Rays are those of the primary wavelength. Lost ones are drawn faint and dashed up to where they are lost, with a
    cross where a surface is missed or reflects totally. Raises ValueError for a lens with an infinite thickness inside.
    """
    lens, fields = style.detached(found.lens), found.fields.detach()
    figure = style.new_figure(8.0, 4.0)
    axes = figure.add_subplot()
    draw_layout(axes, lens, fields=fields, rays=found.rays)
    (z0, z1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    shape = (y1 - y0) / (z1 - z0)
    width = min(max(6.0 / shape, 5.5), 8.0)
    figure.set_size_inches(width, min(max(0.98 * width * shape, 1.2), 6.0) + 1.1)
    figure.suptitle(style.fill(lens.name, width, 11, bold=True) or "Lens", fontsize=11, fontweight="bold")
    axes.set_title(style.first_order_text(lens, first_order(lens)), fontsize=8.5, color=style.GREY, pad=4)
    labels = [style.field_label(lens, field) for field in style.array(fields).T]
    colours = style.field_colours(len(labels))
    handles = [Line2D([], [], color=colour, label=label) for colour, label in zip(colours, labels, strict=True)]
    figure.legend(
        handles=[Line2D([], [], linestyle="", label=style.field_title(lens)), *handles],
        loc="outside lower center", ncols=min(len(handles) + 1, int(1.5 * width)), handlelength=1.4, columnspacing=1.6,
    )  # fmt: skip
    return figure


def draw_layout(axes: Axes, lens: Lens, *, fields: Tensor, wavelength: Tensor | None = None, rays: int = 7) -> None:
    """Draw the cross section into axes, equal in both directions and without ticks; wavelength: () µm, or primary."""
    wavelength = lens.wavelengths[lens.primary_wavelength] if wavelength is None else wavelength
    with torch.no_grad():
        z, radii = outline.vertices(lens), outline.drawn_radii(lens, wavelength, fields)
        indices = [float(index) for index in media(lens, wavelength)]
        reach = [z[k] + outline.depth(lens.surfaces[k], np.array([0.0, radii[k]])) for k in range(1, len(z) - 1)]
        first, last = min(np.min(reach), z[-1]), max(np.max(reach), z[-1])
        distance = float(lens.surfaces[0].thickness)
        near = math.isfinite(distance) and 0 < distance <= _NEAR * (last - first)
        start = -distance if near else first - _LEAD * (last - first)
        points = fan(rays, dtype=lens.surfaces[-2].thickness.dtype, device=lens.wavelengths.device)[0]
        paths = outline.ray_paths(lens, points, fields=fields, wavelength=wavelength, z_start=start)

        _draw_glass(axes, lens, z, radii, indices)
        _draw_mirrors(axes, lens, z, radii, paths)
        _draw_apertures(axes, lens, z, radii)
        _draw_stop(axes, lens, z, radii)
        _draw_rays(axes, paths, style.field_colours(len(paths)))
        half = _draw_sensor(axes, lens, z, radii, paths)
        if near:
            _draw_object(axes, lens, z, paths)
    largest = max(radii[1:-1])
    low, high = _ray_heights(paths)
    stop = radii[lens.stop] + 0.18 * largest
    _frame(axes, (min(first, start), last), (min(low, -largest, -half, -stop), max(high, largest, half, stop)))


def _draw_glass(axes: Axes, lens: Lens, z: np.ndarray, radii: list[float], indices: list[float]) -> None:
    glass = [index > 1.01 for index in indices]
    for k in range(1, len(z) - 1):
        if not glass[k] or z[k + 1] == z[k]:
            continue
        cemented = glass[k - 1] and not lens.surfaces[k].is_mirror, k + 2 < len(z) and glass[k + 1]
        pair = lens.surfaces[k], lens.surfaces[k + 1]
        if k + 2 == len(z):  # glass up to the image, which has no rim of its own
            shape = outline.element(*pair, z[k], z[k + 1], (radii[k], radii[k]), (False, False))
        else:
            shape = outline.element(*pair, z[k], z[k + 1], (radii[k], radii[k + 1]), cemented)
        axes.fill(*shape, facecolor=_tint(indices[k]), edgecolor=style.INK, linewidth=0.7, zorder=2, gid=f"glass {k}")


def _tint(index: float) -> tuple[float, ...]:
    light, dark = (np.array(to_rgb(colour)) for colour in _GLASS)
    share = min(max((index - 1.4) / 0.6, 0.0), 1.0)
    return tuple(light + share * (dark - light))


def _draw_mirrors(axes: Axes, lens: Lens, z: np.ndarray, radii: list[float], paths) -> None:
    for k, side in enumerate(outline.sides(lens)):
        surface = lens.surfaces[k]
        if not surface.is_mirror:
            continue
        hole = max([reach(a)[0] for a in surface.apertures if not a.obscures] or [0.0])
        hole = min(max(hole, outline.hole_radius(k, z, radii[k], paths)), 0.95 * radii[k])
        y = np.linspace(hole, radii[k], 121)
        face = z[k] + outline.depth(surface, y)
        back = face + side * max(0.07 * radii[k], 0.025 * max(radii[1:-1]))
        if hole == 0.0:
            y, face, back = (np.concatenate([part[:0:-1], part]) for part in (y, face, back))
            y[: len(y) // 2] *= -1
        for sign in (1,) if hole == 0.0 else (1, -1):
            corners = np.concatenate([face, back[::-1]]), sign * np.concatenate([y, y[::-1]])
            axes.fill(*corners, facecolor="#f1f1f1", edgecolor="#9a9a9a", hatch="/////", linewidth=0.4, zorder=2)
            axes.plot(face, sign * y, color=style.INK, linewidth=1.5, zorder=3, gid=f"mirror {k}")


def _draw_apertures(axes: Axes, lens: Lens, z: np.ndarray, radii: list[float]) -> None:
    """Obscurations as grey bars along their surface, apertures as bars from their rim outwards."""
    outward = 0.12 * max(radii[1:])
    for k, surface in enumerate(lens.surfaces[1:-1], start=1):
        for aperture in surface.apertures:
            centre, (inner, rim) = aperture.centre[1], reach(aperture)
            if not math.isfinite(rim):
                continue
            if aperture.obscures:
                bars = [(-rim, rim)] if inner <= 0 else [(-rim, -inner), (inner, rim)]
            elif surface.is_mirror:
                bars = []  # its mirror is drawn to this rim
            else:
                bars = [(-rim - outward, -rim), (rim, rim + outward)]
                bars += [(-inner, inner)] if inner > 0 else []
            for low, high in bars:
                y = centre + np.linspace(low, high, 41)
                depth = outline.depth(surface, np.minimum(np.abs(y), 0.9999 * outline.edge_radius(surface)))
                axes.plot(z[k] + depth, y, color="#8c8c8c", linewidth=2.4, solid_capstyle="butt", zorder=1.5)


def _draw_stop(axes: Axes, lens: Lens, z: np.ndarray, radii: list[float]) -> None:
    """The stop: a wedge on either side, its tip at the rim of the stop."""
    surface, largest = lens.surfaces[lens.stop], max(radii[1:-1])
    radius = float(stop_radius(lens))
    on_glass = not surface.is_plane or surface.is_mirror
    radius = radii[lens.stop] if on_glass or not math.isfinite(radius) else radius
    tip = z[lens.stop] + float(outline.depth(surface, np.array([radius]))[0])
    length, half = 0.16 * largest, 0.035 * largest
    for sign in (1, -1):
        y = sign * np.array([radius, radius + length, radius + length])
        axes.fill([tip, tip - half, tip + half], y, color=style.INK, linewidth=0.3, zorder=6, gid="stop")


def _draw_rays(axes: Axes, paths, colours) -> None:
    for field, colour in zip(paths, colours, strict=True):
        for path in field:
            if path.status == "ok":
                axes.plot(path.z, path.y, color=colour, linewidth=0.75, alpha=0.95, zorder=4, gid="ray")
                continue
            axes.plot(
                path.z, path.y, color=colour, linewidth=0.6, alpha=0.5, linestyle=(0, (4, 2)), zorder=4, gid="lost ray"
            )
            if path.status in ("miss", "tir"):
                axes.plot(path.z[-1:], path.y[-1:], "x", color=colour, markersize=4, markeredgewidth=0.9, zorder=7)


def _draw_sensor(axes: Axes, lens: Lens, z: np.ndarray, radii: list[float], paths) -> float:
    """The image surface, as far as the rays need it; returns its half height in mm."""
    hits = [abs(path.y[-1]) for field in paths for path in field if path.status == "ok"]
    half = min(
        max([1.06 * max(hits, default=0.0), 0.05 * max(radii[1:-1])]), 0.9999 * outline.edge_radius(lens.surfaces[-1])
    )
    y = np.linspace(-half, half, 81)
    axes.plot(
        z[-1] + outline.depth(lens.surfaces[-1], np.abs(y)), y, color=style.INK, linewidth=1.8, zorder=5, gid="sensor"
    )
    return half


def _draw_object(axes: Axes, lens: Lens, z: np.ndarray, paths) -> None:
    heights = [abs(path.y[0]) for field in paths for path in field]
    half = 1.06 * max(heights, default=0.0)
    if half > 0:
        y = np.linspace(-half, half, 81)
        axes.plot(z[0] + outline.depth(lens.surfaces[0], np.abs(y)), y, color=style.INK, linewidth=1.0, zorder=3)


def _ray_heights(paths) -> tuple[float, float]:
    """Lowest and highest y in mm of rays that do not run astray."""
    y = [path.y for field in paths for path in field if path.status in ("ok", "vignetted")]
    return (float(np.concatenate(y).min()), float(np.concatenate(y).max())) if y else (0.0, 0.0)


def _frame(axes: Axes, extent: tuple[float, float], heights: tuple[float, float]) -> None:
    """Optical axis, limits and scale bar."""
    length = extent[1] - extent[0]
    margin = 0.025 * length
    low, high = extent[0] - margin, extent[1] + margin
    axes.plot([low, high], [0, 0], color=style.GREY, linewidth=0.6, linestyle=(0, (10, 3, 2, 3)), zorder=1)
    bar = style.round_length(0.2 * length)
    bottom = heights[0] - 0.05 * length
    style.scale_bar(axes, high - margin - bar, bottom, bar)
    axes.set_aspect("equal")
    axes.set_xlim(low, high)
    axes.set_ylim(bottom - 0.015 * length, heights[1] + 0.01 * length)
    axes.axis("off")
