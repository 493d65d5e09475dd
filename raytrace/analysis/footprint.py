"""Footprint: the beams of all fields, wavelengths and configurations on a surface, with its apertures."""

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.panels import DASHES, ruled
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import NothingToShow, Numbers, Points, like, scene_of, setting
from raytrace.analysis.vignetting import clear_share, with_rims
from raytrace.maths.numerics import detached, dot_2, safe_divide, safe_sqrt, value
from raytrace.maths.result import Column, Table
from raytrace.plotting.style import (
    FAINT,
    GREY,
    INK,
    Axes,
    Figure,
    array,
    field_colours,
    fill,
    legend_entry,
    new_figure,
    number_text,
    styled,
)
from raytrace.system.apertures import Aperture, outlines
from raytrace.system.lens import Lens, field_label
from raytrace.tracing.clear_pupil import arms_of
from raytrace.tracing.geometry import semi_diameters
from raytrace.tracing.scene import Scene, beam_share, trace_scene
from raytrace.tracing.trace import without_apertures
from raytrace.words import option

_ARMS, _RINGS = 96, 6  # of the beam, up to its rim
_SPARSE = 5  # of its rays are drawn as dots
_MOST_PANELS = 6

#: Configurations superimposed in one result.
ALL = "all"


@value
class Footprint(Analysis):
    """Beams (C, F, W) on a surface, of every configuration, field and wavelength, in the axes of the surface, mm.

    low, high: (2, C, F, W) smallest and largest x and y; centroid: (2, C, F, W) of the light; reach: (C, F, W) largest
        distance from the vertex. Of the light that arrives, before the apertures of the surface; nan where none does.
    passed: (C, F, W) share of that light that the surface passes; passed_by_lens: (C, F, W) share of the entrance pupil
        whose rays reach the sensor.
    points: (2, C, F, W, P) rays, the last `rim` of them on the rim in order; lit: (C, F, W, P) whether they arrive.
    surface: its number; lenses, configurations: C lenses, and their numbers from 1; fields: (2, C, F).
    """

    lens: Lens
    surface: int
    lenses: tuple[Lens, ...]
    configurations: tuple[int, ...]
    fields: Tensor
    low: Tensor
    high: Tensor
    centroid: Tensor
    reach: Tensor
    passed: Tensor
    passed_by_lens: Tensor
    points: Tensor
    lit: Tensor
    rim: int

    COMMAND = "footprint"
    COLUMNS = (
        Column("configuration", "", ".0f", "config"),
        *(Column(f"{axis}_{end}", "mm", ".4f", f"{axis}\n{word}")
          for axis in "xy" for end, word in (("low", "from"), ("high", "to"))),
        Column("centroid_x", "mm", ".4f", "centroid\nx"), Column("centroid_y", "mm", ".4f", "centroid\ny"),
        Column("reach", "mm", ".4f"), Column("passed_percent", "%", ".3f", "passed by\nsurface"),
        Column("passed_by_lens_percent", "%", ".3f", "passed by\nlens"),
    )  # fmt: skip

    def columns(self) -> dict[str, Tensor]:
        several = len(self.configurations) > 1
        numbers = torch.tensor(self.configurations, device=self.low.device)[:, None, None]
        wavelengths = torch.stack([lens.wavelengths for lens in self.lenses])[:, None]
        return {
            **({"configuration": numbers} if several else {}),
            "field_x": self.fields[0][..., None],
            "field_y": self.fields[1][..., None],
            "wavelength": wavelengths,
            "x_low": self.low[0],
            "x_high": self.high[0],
            "y_low": self.low[1],
            "y_high": self.high[1],
            "centroid_x": self.centroid[0],
            "centroid_y": self.centroid[1],
            "reach": self.reach,
            "passed_percent": 100 * self.passed,
            "passed_by_lens_percent": 100 * self.passed_by_lens,
        }

    def about(self) -> dict[str, Any]:
        lit = torch.isfinite(self.reach)
        size = semi_diameters(detached(self.lens))[self.surface]
        return {
            "surface": self.surface,
            "semi_diameter": size if math.isfinite(size) else None,
            "reach": float(self.reach[lit].max()) if bool(lit.any()) else None,
        }

    def tables(self) -> list[Table]:
        about, surface = self.about(), self.lens.surfaces[self.surface]
        size = "unknown" if about["semi_diameter"] is None else f"{about['semi_diameter']:.6g} mm"
        clips = f"{len(surface.apertures)} aperture(s)" if surface.apertures else "it has no aperture and clips nothing"
        title = [
            f"beams on surface {self.surface}{f' ({surface.comment})' if surface.comment else ''}, in its own axes",
            f"  largest distance from the vertex {about['reach']:.6g} mm; semi-diameter {size}; {clips}",
            "",
        ]
        return [Table(self.columns(), title)]

    @styled
    def draw(self) -> Figure:
        """The rim and the rays of every beam, coloured by field, and the apertures; a panel for each configuration."""
        C = min(len(self.lenses), _MOST_PANELS)
        figure = new_figure(3.9 * C + 0.4, 4.9)
        panels = np.atleast_1d(figure.subplots(1, C, sharex=True, sharey=True))
        colours = field_colours(self.fields.shape[-1])
        for c, panel in enumerate(panels):
            self._draw_beams(ruled(panel), c, colours)
            _draw_apertures(panel, self.lenses[c], self.surface)
            panel.set_aspect("equal")
            panel.set_xlabel("x (mm)")
            if C > 1:
                panel.set_title(f"configuration {self.configurations[c]}")
        panels[0].set_ylabel("y (mm)")
        entries = [
            legend_entry(field_label(self.lens, field), color=colour, linewidth=1.6)
            for field, colour in zip(array(self.fields[:, 0]).T.tolist(), colours, strict=True)
        ]
        if len(waves := self.wavelengths.tolist()) > 1:
            entries += [
                legend_entry(f"{number_text(1e3 * wave, 4)} nm", color=GREY, linestyle=DASHES[w % len(DASHES)])
                for w, wave in enumerate(waves)
            ]
        has = bool(self.lens.surfaces[self.surface].apertures)
        entries.append(legend_entry("aperture" if has else "semi-diameter", color=INK, linewidth=1.4 if has else 0.9,
            linestyle="solid" if has else (0, (6, 3))))  # fmt: skip
        figure.legend(handles=entries, loc="outside lower center", ncols=3 if C == 1 else 6)
        words = f"{self.lens.name or 'Lens'}\nfootprint on surface {self.surface}"
        figure.suptitle(fill(words, figure.get_figwidth(), 10, bold=True), fontweight="bold", fontsize=10)
        return figure

    def _draw_beams(self, panel: Axes, c: int, colours: list[str]) -> None:
        points, lit = array(self.points[:, c]), array(self.lit[c])
        for f, colour in enumerate(colours):
            for w in range(points.shape[2]):
                x, y = np.where(lit[f, w], points[:, f, w], np.nan)
                inner = slice(None, -self.rim)
                if w == 0:
                    panel.plot(x[inner][::_SPARSE], y[inner][::_SPARSE], ".", color=colour, markersize=1.6, alpha=0.5)
                x, y = x[-self.rim :], y[-self.rim :]
                dash = DASHES[w % len(DASHES)]
                panel.plot([*x, x[0]], [*y, y[0]], color=colour, linewidth=1.2, linestyle=dash)


def _draw_apertures(panel: Axes, lens: Lens, surface: int) -> None:
    for aperture in lens.surfaces[surface].apertures:
        for x, y in outlines(aperture):
            panel.plot(array(x), array(y), color=INK, linewidth=1.4)
            if aperture.obscures:
                panel.fill(array(x), array(y), color=FAINT, alpha=0.6, linewidth=0)
    size = semi_diameters(detached(lens))[surface]
    if not lens.surfaces[surface].apertures and math.isfinite(size):
        for x, y in outlines(Aperture("circular", (0.0, size))):
            panel.plot(array(x), array(y), color=INK, linewidth=0.9, linestyle=(0, (6, 3)))


def footprint(
    lens: Lens,
    surface: int,
    *,
    fields: Points = None,
    wavelengths: Numbers = None,
    clipped: bool = False,
    rims: bool = False,
    configuration: int | str | None = None,
) -> Footprint:
    """The beams of all fields and wavelengths on a surface, by its number: extent, centroid, and the share that passes.

    fields: y or (x, y), wavelengths: µm, by default those of the lens; clipped: only the rays that reach the sensor,
    not all that reach the surface; rims: with the semi-diameters as apertures instead of the vignetting factors, as of
    `vignetting`; configuration: of `lens.configurations`, from 1, or "all". A beam that nothing clips has its extent to
    1e-9, one that an aperture clips to 1e-3 of its size; numbers have derivatives by those of the lens. Raises
    ValueError for a surface that does not exist, NothingToShow where no ray arrives.
    """
    last = len(lens.surfaces) - 1
    if not 1 <= surface <= last or lens.surfaces[surface].is_break:
        kind = "is a coordinate break" if 1 <= surface <= last else "does not exist"
        raise ValueError(f"surface {surface} {kind}; expected a surface that light meets, from 1 to {last}")
    if isinstance(configuration, str) and configuration != ALL:
        raise ValueError(f"{option('configuration', configuration)}: expected a number from 1, or {ALL}")
    lenses: tuple[Lens, ...]
    numbers: tuple[int, ...]
    if isinstance(configuration, str):
        lenses, numbers = lens.configurations, tuple(range(1, len(lens.configurations) + 1))
    else:
        number = lens.current_configuration if configuration is None else configuration
        lenses, numbers = (lens if configuration is None else lens.configuration(configuration),), (number,)
    beams = []
    for each in lenses:
        each, points = setting(with_rims(each) if rims else each, fields, wavelengths)
        beams.append(_beams(each, points, surface, clipped))
    joined = {name: torch.stack([beam.parts[name] for beam in beams], axis) for name, axis in _AXES.items()}
    if not bool(joined["lit"].any()):
        raise NothingToShow(f"nothing to show: no ray of these fields arrives on surface {surface}")
    return Footprint(
        lens=beams[numbers.index(lens.current_configuration)].lens if configuration == ALL else beams[0].lens,
        surface=surface,
        lenses=tuple(beam.lens for beam in beams),
        configurations=numbers,
        rim=beams[0].rim,
        **joined,
    )


#: The axis of the configurations in each number of a `Footprint`.
_AXES = {"fields": 1, "low": 1, "high": 1, "centroid": 1, "reach": 0, "passed": 0, "passed_by_lens": 0, "points": 1,
    "lit": 0}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Beams:
    """The numbers of one configuration; rim: rays on the rim."""

    lens: Lens
    rim: int
    parts: dict[str, Tensor]


def _beams(lens: Lens, fields: Tensor, surface: int, clipped: bool) -> _Beams:
    scene = scene_of(lens, fields)
    in_front = clear_share(scene, surface - 1)
    arms = arms_of(scene if clipped else dataclasses.replace(scene, last=surface - 1), _ARMS)
    (points, weights), (ends, exist) = arms.rule(_RINGS), arms.ends()
    on_surface = dataclasses.replace(scene, lens=without_apertures(scene.lens), last=surface)
    rim = ends.shape[-1] // 2
    rays = trace_scene(on_surface, torch.cat([points, ends], -1))
    x, lit = rays.position[:2], rays.valid & torch.cat([weights > 0, exist], -1)
    whole = (arms.area() > 1 - 1e-9) & lit[..., -rim:].all(-1)
    extremes, farthest = _extremes(on_surface, whole)
    light = torch.where(lit[..., : weights.shape[-1]], weights, 0.0)
    total, any_lit = light.sum(-1), lit.any(-1)
    centroid = safe_divide((light * x[..., : weights.shape[-1]]).sum(-1), total.expand(2, *total.shape))
    above, below = (torch.where(lit, side * x, -torch.inf).amax(-1) for side in (1, -1))
    reach = torch.where(lit, dot_2(x, x), -torch.inf).amax(-1)
    numbers = {
        "low": -torch.maximum(below, extremes[1::2]),
        "high": torch.maximum(above, extremes[::2]),
        "centroid": centroid,
        "reach": safe_sqrt(torch.where(any_lit, torch.maximum(reach, farthest), 1.0)),
        "passed": safe_divide(clear_share(scene, surface), in_front),
        "passed_by_lens": clear_share(scene) * beam_share(scene),
    }
    numbers = {name: torch.where(any_lit, number, torch.nan).squeeze(-3) for name, number in numbers.items()}
    return _Beams(lens, rim, {"fields": fields, **numbers, "points": x[:, 0], "lit": lit[0]})


def _extremes(scene: Scene, whole: Tensor) -> tuple[Tensor, Tensor]:
    """Largest x, -x, y, -y (4, D, F, W) of beams whose pupil is whole, and largest x² + y² (D, F, W); -inf of others.

    The farthest ray of the rim is near one of rays at equal angles: where a parabola through it and its neighbours is
    highest.
    """
    around = (torch.arange(_ARMS, **like(scene.lens)) + 0.5) * (2 * math.pi / _ARMS)
    rim = trace_scene(scene, torch.stack([torch.sin(around), torch.cos(around)])).position[:2]
    heights = torch.stack([side * x for x in rim.unbind(0) for side in (1, -1)] + [dot_2(rim, rim)]).detach()
    best = heights.argmax(-1, keepdim=True)
    before, here, after = (heights.gather(-1, (best + step) % _ARMS) for step in (-1, 0, 1))
    shift = safe_divide(0.5 * (before - after), before - 2 * here + after).clamp(-0.5, 0.5)
    angle = (best + 0.5 + shift)[..., 0].movedim(0, -1) * (2 * math.pi / _ARMS)  # (D, F, W, 5), from the y axis
    rays = trace_scene(scene, torch.stack([torch.sin(angle), torch.cos(angle)]))
    x, y = rays.position[:2]
    each = torch.stack([x[..., 0], -x[..., 1], y[..., 2], -y[..., 3], (x * x + y * y)[..., 4]])
    each = torch.where(whole & rays.valid.all(-1), each, -torch.inf)
    return each[:4], each[4]
