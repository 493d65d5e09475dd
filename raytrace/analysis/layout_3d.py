"""A lens in three dimensions, with the rays of its fields."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis import cross_section
from raytrace.maths.sampling import fan
from raytrace.plotting import style
from raytrace.system.apertures import inside, reach
from raytrace.system.lens import Lens, media
from raytrace.system.surface import Surface, sag_at
from raytrace.tracing.geometry import Frame, frames

_RINGS, _ARMS, _TILES = 6, 48, 80  # of the mesh of a surface; of obscurations across it
_LEAD = 0.14  # of the size of the system: rays of a far object start at this distance in front of it
_MIRROR = "#b9c2ca"

Colour = str | tuple[float, ...]


def draw(lens: Lens, fields: Tensor, wavelengths: Tensor, rays: int) -> style.Figure:
    """Surfaces as shaded meshes, glass with its edge, and the rays of both fans: z to the right, y upward."""
    figure = style.new_figure(7.5, 6.0)
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    with torch.no_grad():
        places, radii = frames(lens), cross_section.drawn_radii(lens)
        indices = [float(index) for index in media(lens, wavelengths[0])]
        corners = _draw_surfaces(axes, lens, places, radii, indices)
        size = max(np.ptp(corners, axis=1).max(), 1e-9)
        distance = float(lens.surfaces[0].thickness)
        near = math.isfinite(distance) and 0 < distance <= 1.5 * size
        start = -distance if near else min(0.0, corners[2].min()) - _LEAD * size
        drawn = _draw_rays(axes, lens, fields, wavelengths, rays, start)
        image = _draw_image(axes, places[-1], drawn)
    _frame(axes, np.concatenate([corners, *drawn, image], axis=1))
    return figure


def _seen(points: np.ndarray) -> np.ndarray:
    """Points (3, ...) of the system in the axes of the picture: z, x and y."""
    return points[[2, 0, 1]]


def _mesh(surface: Surface, frame: Frame, radius: float) -> np.ndarray:
    """Points (3, rings, arms) mm of the drawn part of a surface."""
    centre_x, centre_y, radius = cross_section.clear_part(surface, radius)
    holes = [reach(aperture)[0] for aperture in surface.apertures if not aperture.obscures and surface.is_mirror]
    hole = min(max(holes or [0.0]), 0.95 * radius)
    r = np.linspace(hole, radius, _RINGS + 1)[:, None]
    angle = np.linspace(0, 2 * np.pi, _ARMS + 1)[None]
    x, y = (frame.origin.new_tensor(p) for p in (centre_x + r * np.cos(angle), centre_y + r * np.sin(angle)))
    return style.array(frame.outside(torch.stack([x, y, sag_at(surface, x, y)])))


def _draw_surfaces(
    axes: style.Axes3D, lens: Lens, places: list[Frame], radii: list[float], indices: list[float]
) -> np.ndarray:
    """Draw the surfaces; returns all points (3, N) of their meshes."""
    meshes = {}
    for k, surface in enumerate(lens.surfaces[1:-1], 1):
        if surface.is_break:
            continue
        glass = max(indices[k - 1], indices[k]) > cross_section.GLASSY
        obscured = any(aperture.obscures for aperture in surface.apertures)
        if surface.is_mirror or glass or surface.phase is not None or obscured or k == lens.stop:
            meshes[k] = _mesh(surface, places[k], radii[k])
    for k, mesh in meshes.items():
        surface = lens.surfaces[k]
        if surface.is_mirror:
            _shade(axes, mesh, _MIRROR, 0.75)
        elif max(indices[k - 1], indices[k]) > cross_section.GLASSY:
            _shade(axes, mesh, style.tint(max(indices[k - 1], indices[k])), 0.35)
        elif surface.phase is not None:
            _shade(axes, mesh, "#d9d2e9", 0.45)
        _draw_obscurations(axes, surface, places[k], radii[k])
        _rim(axes, mesh, style.INK if k == lens.stop else style.GREY, 1.4 if k == lens.stop else 0.7)
        back = cross_section.partner(lens, k)
        if indices[k] > cross_section.GLASSY and not surface.is_mirror and back in meshes:
            _edge(axes, mesh, meshes[back], style.tint(indices[k]))
    return np.concatenate([mesh.reshape(3, -1) for mesh in meshes.values()], axis=1)


def _draw_obscurations(axes: style.Axes3D, surface: Surface, frame: Frame, radius: float) -> None:
    """The parts of the drawn surface that obscurations block, in small tiles."""
    obscurations = [aperture for aperture in surface.apertures if aperture.obscures]
    line = torch.linspace(-radius, radius, _TILES + 1, dtype=frame.origin.dtype, device=frame.origin.device)
    y, x = torch.meshgrid(line, line, indexing="ij")
    middle = torch.stack([x, y])[:, :-1, :-1] + 0.5 * (line[1] - line[0])
    clear = inside(obscurations, middle)
    if clear is not None:
        tiles = style.array(~clear & (middle.norm(dim=0) <= radius))
        _shade(axes, style.array(frame.outside(torch.stack([x, y, sag_at(surface, x, y)]))), "#8c8c8c", 0.9, tiles)


def _add_tiles(axes: style.Axes3D, tiles: Sequence[np.ndarray], **look: Any) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axes.add_collection3d(Poly3DCollection(tiles, **look))


def _add_lines(axes: style.Axes3D, lines: Sequence[np.ndarray], **look: Any) -> None:
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    axes.add_collection3d(Line3DCollection(lines, **look))


def _shade(axes: style.Axes3D, mesh: np.ndarray, colour: Colour, alpha: float, shown: np.ndarray | None = None) -> None:
    """The tiles of a mesh, all or those that are shown."""
    p = _seen(mesh)
    tiles = [
        np.stack([p[:, i, j], p[:, i + 1, j], p[:, i + 1, j + 1], p[:, i, j + 1]])
        for i in range(p.shape[1] - 1)
        for j in range(p.shape[2] - 1)
        if shown is None or shown[i, j]
    ]
    _add_tiles(axes, tiles, facecolor=colour, edgecolor="none", alpha=alpha, shade=False)


def _edge(axes: style.Axes3D, front: np.ndarray, back: np.ndarray, colour: Colour) -> None:
    """The ground edge of glass, from rim to rim."""
    a, b = _seen(front[:, -1]), _seen(back[:, -1])
    tiles = [np.stack([a[:, j], b[:, j], b[:, j + 1], a[:, j + 1]]) for j in range(a.shape[1] - 1)]
    _add_tiles(axes, tiles, facecolor=colour, edgecolor="none", alpha=0.25, shade=False)


def _rim(axes: style.Axes3D, mesh: np.ndarray, colour: str, width: float) -> None:
    lines = [_seen(mesh[:, -1]).T, *([_seen(mesh[:, 0]).T] if np.ptp(mesh[:, 0], axis=1).max() > 0 else [])]
    _add_lines(axes, lines, colors=colour, linewidths=width)


def _draw_rays(
    axes: style.Axes3D, lens: Lens, fields: Tensor, wavelengths: Tensor, rays: int, start: float
) -> list[np.ndarray]:
    """Draw both fans of every field and wavelength; returns the points (3, C) of rays that arrive."""
    dtype, device = lens.surfaces[-2].thickness.dtype, lens.wavelengths.device
    points = torch.cat([fan(rays, axis, dtype=dtype, device=device)[0] for axis in "xy"], dim=1)
    colours, arrived = style.ray_colours(fields.shape[1], wavelengths.tolist()), []
    for row, wavelength in zip(colours, wavelengths, strict=True):
        every = cross_section.ray_paths(lens, points, fields=fields, wavelength=wavelength, z_start=start)
        for colour, paths in zip(row, every, strict=True):
            whole = [path.points for path in paths if path.status == "ok"]
            lines = [_seen(path).T for path in whole]
            _add_lines(axes, lines, colors=[colour], linewidths=0.7, alpha=0.9)
            arrived += whole
    return arrived


def _draw_image(axes: style.Axes3D, frame: Frame, arrived: list[np.ndarray]) -> np.ndarray:
    """The image surface, a rectangle about where rays end; returns its corners (3, 4)."""
    if not arrived:
        return np.zeros((3, 0))
    ends = frame.origin.new_tensor(np.array([path[:, -1] for path in arrived]).T)
    x, y, _ = style.array(frame.inside(ends))
    least = 0.02 * max(np.ptp(np.concatenate(arrived, axis=1), axis=1))
    half = 0.55 * max(np.ptp(x), np.ptp(y)) + least
    middle = 0.5 * (x.min() + x.max()), 0.5 * (y.min() + y.max())
    u = frame.origin.new_tensor([-half, half, half, -half]) + middle[0]
    v = frame.origin.new_tensor([-half, -half, half, half]) + middle[1]
    corners = style.array(frame.outside(torch.stack([u, v, torch.zeros_like(u)])))
    _add_tiles(axes, [_seen(corners).T], facecolor="#f6f0d8", edgecolor=style.INK, linewidths=1.2, alpha=0.7)
    return corners


def _fill_page(axes: style.Axes3D, points: np.ndarray, span: np.ndarray) -> None:
    """Make the page as high as the projection of points (3, N) needs, and the projection as large as the page.

    Axes in space are square: they are made as wide as the page, and reach beyond it above and below.
    """
    figure = axes.figure
    width = figure.get_figwidth()
    wide, high = _seen_size(axes, points)
    page = min(max(width * high / wide + 1.3, 3.0), 6.5)
    figure.set_figheight(page)
    axes.set_position((0.0, 0.5 + (0.075 - 0.5 * width) / page, 1.0, width / page))
    wide, high = _seen_size(axes, points)
    room = (page - 1.15) * figure.dpi
    axes.set_box_aspect(span, zoom=0.95 * min(axes.bbox.width / wide, room / high))


def _seen_size(axes: style.Axes3D, points: np.ndarray) -> tuple[float, float]:
    """Width and height in dots of the projection of points (3, N) about the middle of the box."""
    axes.apply_aspect()
    from mpl_toolkits.mplot3d import proj3d

    x, y, _ = proj3d.proj_transform(*points, axes.get_proj())
    (left, low), (right, high) = axes.viewLim.get_points()  # the middle of the box is at (0, 0)
    dots = axes.bbox.width / (right - left), axes.bbox.height / (high - low)
    return 2 * np.abs(x).max() * dots[0], 2 * np.abs(y).max() * dots[1]


def _frame(axes: style.Axes3D, points: np.ndarray) -> None:
    """Equal scales about everything that is drawn, a scale bar, and no box."""
    p = _seen(points)
    low, high = p.min(axis=1), p.max(axis=1)
    size = float((high - low).max())
    span = np.maximum(high - low, 0.12 * size)
    for name, middle, width in zip("xyz", 0.5 * (low + high), span, strict=True):
        getattr(axes, f"set_{name}lim")(middle - 0.52 * width, middle + 0.52 * width)
    axes.set_box_aspect(span)
    axes.set_proj_type("ortho")
    axes.view_init(elev=22, azim=-62)
    axes.set_axis_off()
    bar = style.round_length(0.25 * size)
    left, front, bottom = 0.5 * (low[0] + high[0] - bar), low[1] - 0.02 * size, low[2] - 0.02 * size
    ends = np.array([[left, left + bar], [front] * 2, [bottom - 0.1 * size] * 2])  # with its label
    _fill_page(axes, np.concatenate([p, ends], axis=1), span)
    axes.plot(ends[0], ends[1], [bottom] * 2, color=style.INK, linewidth=1.5)
    label = (left + 0.5 * bar, front, bottom - 0.05 * size)
    axes.text(*label, style.round_text(bar), ha="center", va="top", fontsize=8)
