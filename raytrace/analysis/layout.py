"""Layout: the cross section of a lens, from the side or from above, with the rays of its fields."""

import html
import io
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis import cross_section, layout_3d
from raytrace.analysis.panels import first_order_text
from raytrace.budget import RAY_BYTES, afford
from raytrace.maths.numerics import detached, value
from raytrace.maths.result import Result, numbers
from raytrace.maths.sampling import fan, hexapolar
from raytrace.plotting import style
from raytrace.system.apertures import reach
from raytrace.system.lens import (
    Lens,
    field_label,
    field_points,
    field_title,
    media,
    name_of_field,
    wavelengths_of,
)
from raytrace.system.phases import IdealLens
from raytrace.system.surface import Surface
from raytrace.tracing.geometry import edge_radius, mechanical_semi_diameters, warn_of_defects
from raytrace.tracing.launch import launch, stop_radius, warn_of_filling
from raytrace.tracing.lens_report import Info, text
from raytrace.tracing.trace import trace_lens
from raytrace.words import option

if TYPE_CHECKING:  # slow to load
    from matplotlib.patches import Polygon

_LEAD = 0.14  # of the length of the lens: rays of a far object start at this distance in front of it
_NEAR = 1.5  # an object nearer than this many lengths of the lens is drawn


Places = list[cross_section.Section]

#: The paths of the rays of every field.
Paths = list[list[cross_section.RayPath]]

#: From where a lens is looked at.
VIEWS = {"yz": "from the side, y upward", "xz": "from above, x upward", "3d": "in space"}


#: All configurations of a lens, drawn together.
ALL = "all"


@value
class Layout(Result):
    """The cross section of a lens with rays of fields (2, F), so many of each; wavelengths: (W,) µm, or the primary.

    view: a key of VIEWS. configuration: ALL where the configurations of the lens are superimposed, else None.
    has_fields: whether the fields were specified; otherwise each configuration is drawn with its nominal fields.
    """

    lens: Lens
    fields: Tensor
    rays: int = 7
    view: str = "yz"
    wavelengths: Tensor | None = None
    configuration: str | None = None
    has_fields: bool = True

    def document(self) -> dict:
        return {"fields": [numbers(point) for point in self.fields.unbind(1)]}

    def __str__(self) -> str:
        points = ", ".join(map(name_of_field, self.fields.unbind(1)))
        return f"{self.lens.name or 'Lens'}: field {points} {self.lens.fields.unit}"

    @style.styled
    def draw(self) -> style.Figure:
        """The lens in cross section or in space: glass filled by index, mirrors hatched, the stop marked.

        Rays are those of the primary wavelength, coloured by field, or coloured by wavelength where several are
        given. Failed and vignetted rays are faint and dashed and end at their last surface, with a cross where they
        miss it or are totally reflected. A folded system is drawn in its real geometry.
        Raises ValueError for a lens with an infinite thickness inside.
        """
        lens, fields = detached(self.lens), self.fields.detach()
        wavelengths = lens.primary[None] if self.wavelengths is None else self.wavelengths
        if self.configuration == ALL:
            return _superimposed(self, lens.configurations, fields, wavelengths.detach())
        if self.view == "3d":
            return _finished(
                layout_3d.draw(lens, fields, wavelengths.detach(), self.rays), lens, fields, wavelengths, 7.5
            )
        figure = style.new_figure(8.0, 4.0)
        axes, spectrum = figure.add_subplot(), None
        if len(wavelengths) > 1:
            figure.delaxes(axes)
            axes, spectrum = figure.subplots(1, 2, width_ratios=(5, 1))
        draw_layout(axes, lens, fields=fields, wavelengths=wavelengths.detach(), rays=self.rays, view=self.view)
        width, height = _page_size(axes)
        if spectrum is not None:
            width, height = 1.2 * width, max(height, 3.6)
            _draw_spectrum(spectrum, lens, fields, wavelengths.detach())
        figure.set_size_inches(width, height)
        axes.set_title(first_order_text(lens), fontsize=8.5, color=style.GREY, pad=4)
        return _finished(figure, lens, fields, wavelengths, width)


def layout(
    lens: Lens,
    *,
    fields: Tensor | Sequence | None = None,
    rays: int = 7,
    view: Literal["yz", "xz", "3d"] = "yz",
    wavelengths: Tensor | Sequence[float] | None = None,
    configuration: int | str | None = None,
) -> Layout:
    """The cross section, to be drawn by `plot`: glass filled by index, the stop marked, rays coloured by field.

    fields: y, (x, y) or (2, F), in the lens's own kind of field, by default its own; rays: of each fan, in the plane
    that is shown; view: "yz" (from the side), "xz" (from above) or "3d" (in space); wavelengths: µm, by default the
    primary one; rays of several are coloured by wavelength; configuration: of `lens.configurations`, from 1, or "all":
    superimposed, rays coloured by configuration. Warns UnfilledStop, and Unbuildable of a lens that cannot be made.
    Raises ValueError for an unknown view or configuration.
    """
    if view not in VIEWS:
        raise ValueError(f"{option('view', view)}: expected one of {', '.join(VIEWS)}")
    if configuration == ALL and view == "3d":
        raise ValueError(
            f"{option('view', '3d')}: shows one configuration; {option('configuration', 'all')} is drawn from the "
            "side or from above"
        )
    if isinstance(configuration, str) and configuration != ALL:
        raise ValueError(f"{option('configuration', configuration)}: expected a number from 1, or {ALL}")
    if isinstance(configuration, int):
        lens = lens.configuration(configuration)
    chosen = None if wavelengths is None else wavelengths_of(lens, wavelengths)
    for drawn in lens.configurations if configuration == ALL else (lens,):
        warn_of_defects(drawn)
    every = ALL if configuration == ALL else None
    points = field_points(fields, like=lens)
    count = rays * points.shape[1] * (1 if chosen is None else len(chosen))
    surfaces = len(lens.surfaces)
    afford(RAY_BYTES * count * surfaces, f"{count:,} rays at {surfaces} surfaces", helps="ask for fewer {rays}")
    warn_of_filling(lens, points)
    return Layout(lens, points, rays, view, chosen, every, fields is not None)


def _superimposed(figure_of: Layout, lenses: Sequence[Lens], fields: Tensor, wavelengths: Tensor) -> style.Figure:
    """The lens in all its configurations in one cross section, rays coloured by configuration."""
    figure, colours = style.new_figure(8.0, 4.0), style.field_colours(len(lenses))
    axes = figure.add_subplot()
    drawn = []
    for lens, colour in zip(lenses, colours, strict=True):
        points = fields if figure_of.has_fields else field_points(None, like=lens)
        rays, view = figure_of.rays, figure_of.view
        drawn.append(_drawn(axes, lens, fields=points, wavelengths=wavelengths, rays=rays, view=view, colour=colour))
    _framed(axes, drawn)
    width, height = _page_size(axes)
    figure.set_size_inches(width, height)
    return _titled(figure, lenses[0], width, "Configuration", map(str, range(1, len(colours) + 1)), colours)


def _page_size(axes: style.Axes) -> tuple[float, float]:
    """Width and height in inches of a page for the cross section in axes."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    shape = (high - low) / (right - left)
    width = min(max(6.0 / shape, 5.5), 8.0)
    return width, min(max(0.98 * width * shape, 1.2), 6.0) + 1.1


def _titled(
    figure: style.Figure, lens: Lens, width: float, title: str, labels: Iterable[str], colours: Sequence
) -> style.Figure:
    """The figure with the name of the lens and a legend of colours."""
    figure.suptitle(style.fill(lens.name, width, 11, bold=True) or "Lens", fontsize=11, fontweight="bold")
    entries = zip(colours, labels, strict=True)
    handles = [style.legend_entry(linestyle="", label=title)]
    handles += [style.legend_entry(color=colour, label=label) for colour, label in entries]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=min(len(handles), int(1.5 * width)), handlelength=1.4,
        columnspacing=1.6,
    )  # fmt: skip
    return figure


def _draw_spectrum(axes: style.Axes, lens: Lens, fields: Tensor, wavelengths: Tensor) -> None:
    """Where rays of every wavelength land on the image."""
    points = hexapolar(4, dtype=wavelengths.dtype, device=wavelengths.device)[0]
    end = trace_lens(lens, launch(lens, points, fields=fields, wavelengths=wavelengths), wavelengths[:, None])
    x, y = style.array(torch.where(end.valid, end.position[:2], torch.nan))
    for w, colour in enumerate(style.wavelength_colours(wavelengths.tolist())):
        axes.plot(x[:, w].ravel(), y[:, w].ravel(), ".", color=colour, markersize=2.5, markeredgewidth=0)
    if np.isfinite(x).any():
        low, high = np.nanmin(y), np.nanmax(y)
        half = 0.55 * max(np.nanmax(x) - np.nanmin(x), 0.25 * (high - low))
        middle = 0.5 * (np.nanmin(x) + np.nanmax(x))
        axes.set_xlim(middle - half, middle + half)
    axes.set_aspect("equal")
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    axes.set_title("on the image", fontsize=8.5, color=style.GREY, pad=4)


def _finished(figure: style.Figure, lens: Lens, fields: Tensor, wavelengths: Tensor, width: float) -> style.Figure:
    """The figure with its title and its legend: fields, or wavelengths where there are several."""
    if len(wavelengths) > 1:
        title, labels = "Wavelength", [f"{float(wavelength):g} µm" for wavelength in wavelengths]
    else:
        title, labels = field_title(lens), [field_label(lens, field) for field in style.array(fields).T.tolist()]
    colours = style.ray_colours(fields.shape[1], wavelengths.tolist())
    colours = [row[0] for row in colours] if len(wavelengths) > 1 else colours[0]
    return _titled(figure, lens, width, title, labels, colours)


def draw_layout(
    axes: style.Axes,
    lens: Lens,
    *,
    fields: Tensor,
    wavelengths: Tensor | None = None,
    rays: int = 7,
    view: str = "yz",
) -> None:
    """Draw the cross section into axes, equal in both directions, without ticks; wavelengths: (W,) µm, or primary."""
    wavelengths = lens.primary[None] if wavelengths is None else wavelengths
    _framed(axes, [_drawn(axes, lens, fields=fields, wavelengths=wavelengths, rays=rays, view=view)])


def on_one_scale(panels: Sequence[style.Axes]) -> None:
    """Give cross sections in axes of one size the same scale; the middle of each stays where it is."""
    limits = [(panel.get_xlim(), panel.get_ylim()) for panel in panels]
    width, height = (max(abs(limit[k][1] - limit[k][0]) for limit in limits) for k in (0, 1))
    for panel, ((left, right), (low, high)) in zip(panels, limits, strict=True):
        panel.set_xlim(0.5 * (left + right - width), 0.5 * (left + right + width))
        panel.set_ylim(0.5 * (low + high - height), 0.5 * (low + high + height))


class _Drawn(NamedTuple):
    """A cross section in axes: the places of its surfaces, whether it is bent, its extent in z and in height, mm."""

    places: Places
    is_bent: bool
    extent: tuple[float, float]
    heights: tuple[float, float]


def _drawn(
    axes: style.Axes, lens: Lens, *, fields: Tensor, wavelengths: Tensor, rays: int, view: str, colour: object = None
) -> _Drawn:
    """Draw surfaces and rays, of one colour if it is given; the frame is not drawn yet."""
    with torch.no_grad():
        stop = float(stop_radius(lens))
        places, radii = cross_section.sections(lens, view), cross_section.drawn_radii(lens, stop)
        indices, widths = [float(index) for index in media(lens, wavelengths[0])], mechanical_semi_diameters(lens)
        right, up = _extent(lens, places, radii)
        first, last = right
        distance = float(lens.surfaces[0].thickness)
        bent = cross_section.is_bent(lens)
        size = max(last - first, up[1] - up[0]) if bent or first == last else last - first
        near = math.isfinite(distance) and 0 < distance <= _NEAR * size
        front = _front(places, radii, lens) if bent else first
        start = -distance if near else front - _LEAD * size
        dtype, device = lens.surfaces[-2].thickness.dtype, lens.wavelengths.device
        points = fan(rays, view[0], dtype=dtype, device=device)[0]
        paths = []
        for wavelength in wavelengths:
            paths += cross_section.ray_paths(
                lens, points, fields=fields, wavelength=wavelength, z_start=start, view=view
            )

        _draw_glass(axes, lens, places, radii, indices, widths)
        _draw_mirrors(axes, lens, places, radii, paths)
        _draw_apertures(axes, lens, places, radii)
        _draw_stop(axes, lens, places, radii, stop)
        colours = [each for row in style.ray_colours(fields.shape[1], wavelengths.tolist()) for each in row]
        _draw_rays(axes, paths, colours if colour is None else [colour] * len(paths))
        half = _draw_sensor(axes, lens, places[-1], radii, paths)
        if near:
            _draw_object(axes, lens, places[0], paths)
    largest, (low, high) = max(*radii[1:-1], *(w for w in widths[1:-1] if w > 0)), _ray_heights(paths)
    rim = radii[lens.stop] + 0.18 * largest
    heights = min(low, -largest, -half, -rim), max(high, largest, half, rim)
    return _Drawn(places, bent, (min(first, start), last), heights)


def _framed(axes: style.Axes, drawn: Sequence[_Drawn]) -> None:
    """The frame of one cross section, or of several superimposed ones."""
    if any(section.is_bent for section in drawn):
        _frame_bent(axes, [section.places for section in drawn])
        return
    starts, ends = zip(*(section.extent for section in drawn), strict=True)
    low, high = zip(*(section.heights for section in drawn), strict=True)
    _frame(axes, (min(starts), max(ends)), (min(low), max(high)))


def _extent(lens: Lens, places: Places, radii: list[float]) -> tuple[tuple, tuple]:
    """The extent of the surfaces, ((left, right), (low, high)) mm; the image by its vertex."""
    right, up = [places[-1].origin[0]], [places[-1].origin[1]]
    for k in range(1, len(places) - 1):
        height = np.array([-radii[k], 0.0, radii[k]])
        z, y = places[k].at(cross_section.depth(lens.surfaces[k], height, places[k].direction), height)
        right, up = [*right, *z], [*up, *y]
    return (min(right), max(right)), (min(up), max(up))


def _front(places: Places, radii: list[float], lens: Lens) -> float:
    """The leftmost point of the first surface of a lens whose axis bends, mm."""
    height = np.array([-radii[1], radii[1]])
    return float(min(0.0, *places[1].at(cross_section.depth(lens.surfaces[1], height, places[1].direction), height)[0]))


def _draw_glass(
    axes: style.Axes, lens: Lens, places: Places, radii: list[float], indices: list[float], widths: list[float]
) -> None:
    for k in range(1, len(places) - 1):
        if indices[k] <= cross_section.GLASSY or lens.surfaces[k].is_break:
            continue
        shape = cross_section.glass(lens, k, places, radii, indices, widths)
        if shape is not None:
            colour = style.tint(indices[k])
            axes.fill(*shape, facecolor=colour, edgecolor=style.INK, linewidth=0.7, zorder=2, gid=f"glass {k}")
    for k in range(1, len(places) - 1):  # thin structures in air: ideal lenses, gratings
        if lens.surfaces[k].phase is not None and not lens.surfaces[k].is_mirror:
            _draw_thin(axes, lens.surfaces[k], places[k], radii[k])


def _draw_thin(axes: style.Axes, surface: Surface, place: cross_section.Section, radius: float) -> None:
    """A thin structure: a line along the surface, with arrows at the ends of an ideal lens."""
    height = np.linspace(-radius, radius, 81)
    line = place.at(cross_section.depth(surface, height, place.direction), height)
    axes.plot(*line, color=style.INK, linewidth=1.2, zorder=3, gid="thin")
    if isinstance(surface.phase, IdealLens):
        pointed = 1 if float(surface.phase.power_y) >= 0 else -1
        for end in (1, -1):
            tip = end * (radius + (0.0 if pointed > 0 else 0.07 * radius))
            back = tip - end * pointed * 0.07 * radius
            depth = 0.05 * radius
            corners = place.at(np.array([-depth, 0.0, depth]), np.array([back, tip, back]))
            axes.plot(*corners, color=style.INK, linewidth=1.0, zorder=3)


def _draw_mirrors(axes: style.Axes, lens: Lens, places: Places, radii: list[float], paths: Paths) -> None:
    bent = cross_section.is_bent(lens)
    for k, side in enumerate(cross_section.sides(lens)):
        surface = lens.surfaces[k]
        if not surface.is_mirror:
            continue
        x, y, radius = cross_section.clear_part(surface, radii[k])
        hole = max([reach(a)[0] for a in surface.apertures if not a.obscures] or [0.0])
        seen = 0.0 if bent else cross_section.hole_radius(k, cross_section.vertices(lens), radii[k], paths)
        hole = min(max(hole, seen), 0.95 * radius)
        height = np.linspace(hole, radius, 121)
        thick = side * max(0.07 * radius, 0.025 * max(radii[1:-1]))
        if hole == 0.0:
            middle = x * places[k].direction[0] + y * places[k].direction[1]
            height = middle + np.concatenate([-height[:0:-1], height])
        for sign in (1,) if hole == 0.0 else (1, -1):
            face = cross_section.depth(surface, sign * height, places[k].direction)
            front, back = places[k].at(face, sign * height), places[k].at(face + thick, sign * height)
            corners = (np.concatenate([a, b[::-1]]) for a, b in zip(front, back, strict=True))
            axes.fill(*corners, facecolor="#f1f1f1", edgecolor="#9a9a9a", hatch="/////", linewidth=0.4, zorder=2)
            axes.plot(*front, color=style.INK, linewidth=1.5, zorder=3, gid=f"mirror {k}")


def _draw_apertures(axes: style.Axes, lens: Lens, places: Places, radii: list[float]) -> None:
    """Obscurations as grey bars along their surface, apertures as bars from their rim outwards."""
    outward = 0.12 * max(radii[1:])
    for k, surface in enumerate(lens.surfaces[1:-1], start=1):
        for aperture in surface.apertures:
            place, (inner, rim) = places[k], reach(aperture)
            centre = aperture.centre[0] * place.direction[0] + aperture.centre[1] * place.direction[1]
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
                most = radii[k] + outward
                first, last = np.clip([float(centre + low), float(centre + high)], -most, most)
                height = np.linspace(first, last, 41)
                edge = 0.9999 * edge_radius(surface)
                depth = cross_section.depth(surface, np.clip(height, -edge, edge), place.direction)
                axes.plot(*place.at(depth, height), color="#8c8c8c", linewidth=2.4, solid_capstyle="butt", zorder=1.5)


def _draw_stop(axes: style.Axes, lens: Lens, places: Places, radii: list[float], radius: float) -> None:
    """The stop: a wedge on either side, its tip at the rim of the stop."""
    surface, place, largest = lens.surfaces[lens.stop], places[lens.stop], max(radii[1:-1])
    on_glass = not surface.is_plane or surface.is_mirror
    radius = radii[lens.stop] if on_glass or not math.isfinite(radius) else radius
    length, half = 0.16 * largest, 0.035 * largest
    for sign in (1, -1):
        tip = float(cross_section.depth(surface, np.array([sign * radius]), place.direction)[0])
        height = sign * np.array([radius, radius + length, radius + length])
        corners = place.at(np.array([tip, tip - half, tip + half]), height)
        axes.fill(*corners, color=style.INK, linewidth=0.3, zorder=6, gid="stop")


def _draw_rays(axes: style.Axes, paths: Paths, colours: Sequence) -> None:
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


def _draw_sensor(axes: style.Axes, lens: Lens, place: cross_section.Section, radii: list[float], paths: Paths) -> float:
    """Draw the image surface, as large as the rays need it; returns its half height in mm."""
    surface = lens.surfaces[-1]
    hits = [float(place.height(path.z[-1], path.y[-1])) for field in paths for path in field if path.status == "ok"]
    low, high = min(hits, default=0.0), max(hits, default=0.0)
    least, edge = 0.05 * max(radii[1:-1]), 0.9999 * edge_radius(surface)
    centre = 0.5 * (low + high) if cross_section.is_bent(lens) else 0.0
    half = min(max(1.06 * max(high - centre, centre - low), least), edge)
    height = centre + np.linspace(-half, half, 81)
    line = place.at(cross_section.depth(surface, height, place.direction), height)
    axes.plot(*line, color=style.INK, linewidth=1.8, zorder=5, gid="sensor")
    return half


def _draw_object(axes: style.Axes, lens: Lens, place: cross_section.Section, paths: Paths) -> None:
    heights = [abs(float(place.height(path.z[0], path.y[0]))) for field in paths for path in field]
    half = 1.06 * max(heights, default=0.0)
    if half > 0:
        y = np.linspace(-half, half, 81)
        depth = cross_section.depth(lens.surfaces[0], np.abs(y), place.direction)
        axes.plot(*place.at(depth, y), color=style.INK, linewidth=1.0, zorder=3)


def _ray_heights(paths: Paths) -> tuple[float, float]:
    """Lowest and highest y in mm of rays that arrive or are vignetted."""
    y = [path.y for field in paths for path in field if path.status in ("ok", "vignetted")]
    return (float(np.concatenate(y).min()), float(np.concatenate(y).max())) if y else (0.0, 0.0)


def _frame(axes: style.Axes, extent: tuple[float, float], heights: tuple[float, float]) -> None:
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


def _frame_bent(axes: style.Axes, ways: Sequence[Sequence[cross_section.Section]]) -> None:
    """The mechanical axis from vertex to vertex, limits and scale bar of a system that is folded."""
    axes.relim()
    for patch in axes.patches:
        axes.update_datalim(cast("Polygon", patch).get_xy())
    (left, low), (right, high) = axes.dataLim.get_points()
    for places in ways:
        way = np.array([place.origin for place in places[1:]]).T
        axes.plot(*way, color=style.GREY, linewidth=0.6, linestyle=(0, (10, 3, 2, 3)), zorder=1)
    size = max(right - left, high - low)
    bar = style.round_length(0.2 * size)
    bottom = low - 0.05 * size
    style.scale_bar(axes, right - bar, bottom, bar)
    axes.set_aspect("equal")
    axes.set_xlim(left - 0.025 * size, right + 0.025 * size)
    axes.set_ylim(bottom - 0.03 * size, high + 0.025 * size)
    axes.axis("off")


def page(lens: Lens) -> str:
    """A lens in a notebook: HTML of its cross section and its prescription, or plain text if it cannot be traced."""
    try:
        title, drawing = first_order_text(lens), io.StringIO()
        layout(lens).plot().savefig(drawing, format="svg")
        table = Info(lens).to_frame().to_html(index=False, float_format="{:.7g}".format, na_rep="")
    except (ValueError, RuntimeError):
        return f"<pre>{html.escape(text(lens))}</pre>"
    svg = drawing.getvalue()
    return f"<b>{html.escape(lens.name or 'Lens')}</b><br>{html.escape(title)}{svg[svg.index('<svg') :]}{table}"
