"""Comparison of two lenses, such as one before and after an optimisation: every analysis in one table and one figure of
one scale.

The first lens sets the scene of both: fields, wavelengths, frequencies, radii. A new analysis is a row of COMPARED.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.chief import distortion, field_curvature, lateral_colour
from raytrace.analysis.chromatic import chromatic_focal_shift
from raytrace.analysis.encircled import encircled_energy
from raytrace.analysis.fans import opd_fan, ray_fan
from raytrace.analysis.grid import GridDistortion, distortion_grid, draw_grid
from raytrace.analysis.illumination import relative_illumination
from raytrace.analysis.incidence import incidence
from raytrace.analysis.layout import draw_layout, layout, on_one_scale
from raytrace.analysis.longitudinal import longitudinal_aberration
from raytrace.analysis.mtf import frequency_range, mtf
from raytrace.analysis.panels import DASHES, Dash, field_labels, field_name, ruled
from raytrace.analysis.result import Analysis
from raytrace.analysis.rms import rms_over_field
from raytrace.analysis.seidel import seidel
from raytrace.analysis.setting import Numbers, Points, primary_wavelength
from raytrace.analysis.spot_diagram import (
    Spots,
    airy_radius,
    draw_spot,
    panel_size,
    spot,
    wavelength_handles,
)
from raytrace.analysis.thermal import Thermal, thermal
from raytrace.analysis.wavefronts import WavefrontMap, diverging, draw_map, wavefront
from raytrace.io import as_lens
from raytrace.materials.mounts import mount_words
from raytrace.maths.numerics import detached, value
from raytrace.maths.result import Column, Result, Table, flat, rounding
from raytrace.plotting.style import (
    GREY,
    Axes,
    Figure,
    array,
    fill,
    legend_entry,
    new_figure,
    number_text,
    round_length,
    styled,
)
from raytrace.psf_models.figures import DECADES, close_up_of, panels, row_labels, windows, worded
from raytrace.psf_models.models import psf
from raytrace.psf_models.result import Psf
from raytrace.system.lens import Lens, field_points, with_wavelengths
from raytrace.tracing.lens_report import FIRST_ORDER_LINES, Info
from raytrace.words import RaytraceError, did_you_mean, option

COLOURS, WIDTHS = ("#0072B2", "#D55E00"), (1.9, 1.0)  # of the first and the second lens, also where they coincide
_HEADS = (
    *("field_x", "field_y", "wavelength", "frequency", "radius", "pupil", "temperature", "quantity"),
    *("surface", "object_distance"),
)
_NO_VALUES = (
    *("tangential_limit", "sagittal_limit", "rays", "projected_solid_angle", "noll", "coefficient"),
    *("fringe", "error"),
)
_SHOWN = 0.1  # of the size of a grid: the largest distortion that is drawn exaggerated
_ACROSS = 3  # panels in a row
_FREQUENCIES = 41


class Incomparable(RaytraceError, ValueError):
    """Two lenses, or an analysis, that cannot be compared."""


@dataclasses.dataclass(frozen=True)
class Curves:
    """How the curves of an analysis are drawn.

    x: the column of the abscissa; curves: columns and their labels; factor: of the curves, x_factor: of the abscissa;
    panels: a panel for each of these, "field", "wavelength" or "curve"; the others have a dash each; upright: the
    abscissa is drawn upwards; limits: of the curves; is_shared: whether all panels have one scale of the curves; tops:
    ends of the scales of curves that begin at 0.
    """

    x: str
    x_name: str
    name: str
    curves: Mapping[str, str]
    panels: tuple[str, ...] = ()
    factor: float = 1.0
    x_factor: float = 1.0
    upright: bool = False
    limits: tuple[float | None, float | None] = (None, None)
    is_shared: bool = True
    tops: Mapping[str, float | None] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Compared:
    """An analysis of both lenses: the function; the options of the second call by the first result; its curves, or the
    function that draws its figure; summary: whether the table is the summary of the results;
    text: what the text has of it, "all" or the "summary"; at_fields: whether it takes fields."""

    make: Callable[..., Result]
    alike: Callable[[Any], dict[str, Any]]
    draws: Curves | Callable[["LensComparison"], Figure]
    summary: bool = False
    text: Literal["all", "summary"] = "all"
    at_fields: bool = False


@value
class LensComparison(Result):
    """An analysis of two lenses and its differences: columns end in _1, _2 and _change, second less first.

    first, second: results of the function of the analysis at the same fields, wavelengths and abscissae; names: of the
    lenses; of layouts the table has first-order data.
    """

    lens: Lens
    other: Lens
    analysis: str
    names: tuple[str, str]
    first: Any
    second: Any

    @property
    def COLUMNS(self) -> Sequence[Column]:  # type: ignore[override]
        columns = []
        for name in self._values():
            column = self.first.column(name)
            title, _, second = (column.heading or name.replace("_", " ")).partition("\n")
            title = "" if name == "value" else f"{title} {second}".strip()
            form = column.form.removeprefix("+")
            ends = (("_1", "A"), ("_2", "B"), ("_change", "B − A"))
            columns += [Column(name + end, column.unit, form, f"{title if k == 0 else ' '}\n{label}")
                        for k, (end, label) in enumerate(ends)]  # fmt: skip
        return [*columns, Column("quantity", form="<"), Column("unit", form="<", heading="unit or definition")]

    def _of_both(self, *, brief: bool = False) -> list[dict[str, Tensor]]:
        """The tables of both results; brief: their summaries."""
        if self.analysis == "layout":
            return [_first_order(lens) for lens in (self.lens, self.other)]
        take = "summary" if brief or COMPARED[self.analysis].summary else "columns"
        return [getattr(result, take)() for result in (self.first, self.second)]

    def _values(self) -> list[str]:
        tables = [self._of_both()[0], *([self._of_both(brief=True)[0]] if self._is_brief else [])]
        return [*dict.fromkeys(name for table in tables for name in table if name not in (*_HEADS, *_NO_VALUES))]

    @property
    def _is_brief(self) -> bool:
        return COMPARED[self.analysis].text == "summary"

    def columns(self) -> dict[str, Tensor]:
        return _differences(*self._of_both())

    def column(self, name: str) -> Column:
        known = next((column for column in self.COLUMNS if column.name == name), None)
        return known or self.first.column(name)

    def words(self) -> dict[str, Sequence[str]]:
        if self.analysis != "layout":
            return {}
        return {
            "quantity": [words for words, *_ in FIRST_ORDER_LINES],
            "unit": [unit for *_, unit in FIRST_ORDER_LINES],
        }

    def units(self) -> dict[str, str]:
        return {name: unit for name in self.columns() if (unit := self.column(name).unit)}

    def document(self) -> dict:
        return {
            "analysis": self.analysis,
            "names": list(self.names),
            "units": self.units(),
            "first": self.first.document(),
            "second": self.second.document(),
            **Result.document(self),
        }

    def roundings(self) -> dict[str, Tensor]:
        """Roundings of the analysis and of the differences, by the larger of the values of both lenses: of all rows, or
        of each one where rows are quantities."""
        first, second = self._of_both(brief=self._is_brief)
        known, limits = self.first.roundings(), {}
        for name in (name for name in first if name not in (*_HEADS, *_NO_VALUES)):
            pair = first[name], second[name]
            if "quantity" in first:
                limits[f"{name}_change"] = torch.stack([rounding(*row) for row in zip(*pair, strict=True)])
                continue
            limits[f"{name}_change"] = rounding(*pair)
            if name in known:
                limits |= {f"{name}_1": known[name], f"{name}_2": known[name]}
                limits[f"{name}_change"] = torch.maximum(limits[f"{name}_change"], known[name])
        return limits

    def tables(self) -> list[Table]:
        title = [f"{self.analysis.replace('_', ' ')}: A {self.names[0]}, B {self.names[1]}"]
        if not torch.equal(self.lens.wavelengths, self.other.wavelengths):
            title.append("wavelengths of both: those of A")
        title += [self.first.scene()] if isinstance(self.first, Thermal) else []
        columns = _differences(*self._of_both(brief=self._is_brief))
        every = getattr(self.first, "EVERY", 1)
        tables = [Table(columns, title)]
        if every > 1 and isinstance(self.first, Analysis):
            tables = [self.first.thinned(columns, every)._replace(title=title)]
        if isinstance(self.first, Spots) and isinstance(self.second, Spots) and len(self.first.lens.wavelengths) > 1:
            radii = [1e3 * spots.whole.rms_radius for spots in (self.first, self.second)]
            y = {Column("field_x", self.first.lens.fields.unit): self.first.fields[0]}
            y |= {Column("field_y", self.first.lens.fields.unit): self.first.fields[1]}
            whole: dict[Any, Tensor] = y if bool(self.first.fields[0].any()) else {k: y[k] for k in [*y][1:]}
            for label, values in zip(("A", "B", "B − A"), (*radii, radii[1] - radii[0]), strict=True):
                whole[Column(f"rms {label}", "µm", ".4f", f"{'RMS' if label == 'A' else ' '}\n{label}")] = values
            tables.append(Table(whole, ["", "all wavelengths together"]))
        return tables

    @styled
    def draw(self) -> Figure:
        """Both lenses in one figure of one scale: the first in blue, the second in orange, or one above the other."""
        draws = COMPARED[self.analysis].draws
        return _curves(self, draws) if isinstance(draws, Curves) else draws(self)


def _differences(first: Mapping[str, Tensor], second: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The columns of two tables, and the second less the first."""
    table = {name: column for name, column in first.items() if name in _HEADS}
    for name in first:
        if name not in _HEADS and name not in _NO_VALUES:
            single, other = first[name], second[name]
            table |= {f"{name}_1": single, f"{name}_2": other, f"{name}_change": other - single}
    return table | ({"unit": table["quantity"]} if "quantity" in table else {})


def compare(
    lens: Lens,
    other: Lens | str | PathLike,
    analysis: str = "layout",
    *,
    fields: Points = None,
    wavelengths: Numbers = None,
    frequencies: Numbers = None,
    names: Sequence[str] | None = None,
) -> LensComparison:
    """An analysis of two lenses, such as before and after an optimisation, its differences and one figure of one scale.

    analysis: a key of COMPARED: "layout" (with first-order data), "spot", "mtf", "ray_fan", "distortion" …; fields: y
    or (x, y), by default those of the first lens, as are wavelengths (µm) with their weights; frequencies: of "mtf",
    cycles/mm, by default to the higher of the resolutions of both lenses; names: of the lenses, by default A and B with
    their titles. Raises Incomparable for an unknown analysis and for lenses with different kinds of fields.
    """
    key = analysis.replace("-", "_")
    if key not in COMPARED:
        known = [name.replace("_", "-") for name in COMPARED]
        meant = did_you_mean(analysis.replace("_", "-"), known)
        listed = ", ".join(known)
        raise Incomparable(f"{option('analysis', analysis)}: no such analysis{meant}; expected one of {listed}")
    both = (lens, as_lens(other, "compare"))
    lens, other = (
        detached(single if wavelengths is None else with_wavelengths(single, wavelengths)) for single in both
    )
    if lens.fields.kind != other.fields.kind:
        kinds = " and ".join(single.fields.kind.replace("_", " ") for single in (lens, other))
        raise Incomparable(f"the fields of the lenses are of different kinds, {kinds}: they have no common field")
    if frequencies is not None and key != "mtf":
        raise Incomparable(f"{option('frequencies')} goes with {option('analysis', 'mtf')}")
    titles = tuple(names) if names is not None else (lens.name or "Lens", other.name or "Lens")
    if len(titles) != 2:
        raise Incomparable(f"{option('names')}: {len(titles)} names; expected 2")
    entry, alike = COMPARED[key], _in_scene(other, lens)
    given = {} if fields is None or not entry.at_fields else {"fields": fields}
    given |= {} if frequencies is None else {"frequencies": frequencies}
    if key == "mtf" and frequencies is None:
        points = field_points(fields, like=lens)
        ranges = [frequency_range(single, points, _FREQUENCIES) for single in (lens, alike)]
        given["frequencies"] = max(ranges, key=lambda row: float(row[-1]))
    first = entry.make(lens, **given)
    second = entry.make(alike, **entry.alike(first))
    if key == "encircled_energy":
        first, second = _to_common_radius(first, alike)
    return LensComparison(lens, other, key, (titles[0], titles[1]), first, second)


def _in_scene(other: Lens, lens: Lens) -> Lens:
    """A lens at the wavelengths of another, with their weights and its primary one."""
    if torch.equal(other.wavelengths, lens.wavelengths):
        weights = lens.wavelength_weights
    else:
        other, weights = with_wavelengths(other, lens.wavelengths), lens.wavelength_weights
    return dataclasses.replace(other, wavelength_weights=weights, primary_wavelength=lens.primary_wavelength)


def _to_common_radius(first: Any, other: Lens) -> tuple[Result, Result]:
    """Encircled energy of both lenses up to the larger of their default radii."""
    alone = encircled_energy(other, fields=first.fields)
    radii = max(first.radii, alone.radii, key=lambda row: float(row[-1]))
    results = (encircled_energy(lens, radii, fields=first.fields) for lens in (first.lens, other))
    single, two = (dataclasses.replace(result, marked=False) for result in results)
    return single, two


def _first_order(lens: Lens) -> dict[str, Tensor]:
    document = Info(lens).document()
    numbers = [document[name] for _, name, _ in FIRST_ORDER_LINES]
    values = lens.wavelengths.new_tensor([math.nan if number is None else number for number in numbers])
    return {"quantity": torch.arange(len(numbers)), "value": values}


# -- figures


def _curves(pair: LensComparison, plot: Curves) -> Figure:
    """The curves of both lenses: a panel for each of its `panels`, one colour a lens, dashes for the rest."""
    results = [getattr(result, "drawn", lambda result=result: result)() for result in (pair.first, pair.second)]
    is_summary = COMPARED[pair.analysis].summary
    tables = [flat(result.summary() if is_summary else {**result.columns(), **_summary(result)}) for result in results]
    keys = {"field": ("field_x", "field_y"), "wavelength": ("wavelength",)}
    dims = [dim for dim, names in keys.items() if names[0] in tables[0] and not (dim == "field" and plot.x == "field")]
    if plot.x == "wavelength":
        dims.remove("wavelength")
    groups = {dim: _groups(tables[0], keys[dim]) for dim in dims} | {"curve": [(name,) for name in plot.curves]}
    groups["curve"] = [(name,) for name in plot.curves if name in tables[0]]
    shown = [dim for dim in plot.panels if len(groups.get(dim, [])) > 1] or ["curve"][: not plot.is_shared]
    dashed = [dim for dim in groups if dim not in shown]
    places = _product([groups[dim] for dim in shown])
    if len(shown) == 2:
        shape = len(groups[shown[0]]), len(groups[shown[1]])
    else:
        shape = -(-len(places) // _ACROSS), min(len(places), _ACROSS)
    wide, tall = (5.6, 3.6) if shape == (1, 1) else (3.1, 2.35)
    wide = min(wide, 9.3 / shape[1]) if shape[1] > 1 else max(wide, 5.0)
    if plot.upright:
        tall = max(tall, 3.4)
    figure = new_figure(wide * shape[1] + 0.3, tall * shape[0] + 1.2)
    grid = figure.subplots(*shape, squeeze=False, sharex=plot.is_shared or not plot.upright, sharey=plot.is_shared)
    panels = list(grid.flat)
    styles = _product([groups[dim] for dim in dashed])
    labels = {"field": dict(zip(groups.get("field", []), _field_words(results[0], groups), strict=False))}
    for panel, place in zip(panels, places, strict=False):
        ruled(panel)
        for k, style in enumerate(styles):
            chosen = dict(zip([*shown, *dashed], [*place, *style], strict=True))
            for table, colour, width in zip(tables, COLOURS, WIDTHS, strict=True):
                x, y = _line(table, chosen, keys, plot)
                look: dict[str, Any] = {"marker": "o", "markersize": 3} if len(x) <= 5 else {}
                look |= {"color": colour, "linestyle": DASHES[k % len(DASHES)], "linewidth": width}
                panel.plot(*((y, x) if plot.upright else (x, y)), **look)
        title = [_word(dim, part, labels, plot) for dim, part in zip(shown, place, strict=True)]
        if plot.is_shared:
            panel.set_title(", ".join(title))
        x_name = plot.x_name or field_name(pair.first.lens)
        axis_names = (plot.name if plot.is_shared else ", ".join(title), x_name)
        x_label, y_label = axis_names if plot.upright else axis_names[::-1]
        if plot.is_shared:
            panel.label_outer()
        bottom = panels.index(panel) + shape[1] >= len(places)
        panel.set(xlabel=x_label if bottom or not plot.is_shared else "")
        panel.set(ylabel=y_label if panel in grid[:, 0] or not plot.is_shared else "")
        if bottom:
            panel.tick_params(labelbottom=True)
        (panel.axvline if plot.upright else panel.axhline)(0, color=GREY, linewidth=0.6)
    for panel in panels[len(places) :]:
        panel.axis("off")
    extent = _line(tables[0], dict(zip([*shown, *dashed], [*places[0], *styles[0]], strict=True)), keys, plot)[0]
    for panel, place in zip(panels, places, strict=False):
        (panel.set_ylim if plot.upright else panel.set_xlim)(np.nanmin(extent), np.nanmax(extent) or 1.0)
        name = place[-1][0] if shown and shown[-1] == "curve" else ""
        if name in plot.tops:
            panel.set_ylim(0, plot.tops[name])
        if plot.limits != (None, None):
            panel.set_ylim(*plot.limits)
        if shape[1] > 1:
            panel.locator_params(axis="x", nbins=5)
    words = [", ".join(_word(dim, part, labels, plot) for dim, part in zip(dashed, style, strict=True)
                       if len(groups[dim]) > 1) for style in styles]  # fmt: skip
    return _finished(figure, pair, [*zip(words, DASHES * len(words), strict=False)] if len(styles) > 1 else [])


def _summary(result: Any) -> dict[str, Tensor]:
    """Columns of the summary over the field, of results that have one along the same fields."""
    summary: dict[str, Tensor] = getattr(result, "summary", dict)()
    table = result.columns()
    return {name: column[..., None] for name, column in summary.items() if name not in table and column.dim() == 1}


def _groups(table: Mapping[str, np.ndarray], names: Sequence[str]) -> list[tuple]:
    return [*dict.fromkeys(zip(*(table[name].tolist() for name in names), strict=True))]


def _product(groups: Sequence[Sequence]) -> list[tuple]:
    places: list[tuple] = [()]
    for group in groups:
        places = [(*place, part) for place in places for part in group]
    return places


def _line(
    table: Mapping[str, np.ndarray], chosen: Mapping[str, tuple], keys: Mapping[str, Sequence[str]], plot: Curves
) -> tuple[np.ndarray, np.ndarray]:
    """Abscissae and values of the curve of a field, a wavelength and a column."""
    (column,) = chosen["curve"]
    rows = np.ones(len(table[column]), dtype=bool)
    for dim, part in chosen.items():
        for name, number in zip(keys.get(dim, ()), part, strict=False):
            rows &= table[name] == number
    x = np.hypot(table["field_x"], table["field_y"]) if plot.x == "field" else table[plot.x]
    order = np.argsort(x[rows], kind="stable")
    return plot.x_factor * x[rows][order], plot.factor * table[column][rows][order]


def _field_words(result: Result, groups: Mapping[str, Sequence]) -> Sequence[str]:
    return field_labels(result) if "field" in groups and isinstance(result, Analysis) else []


def _word(dim: str, part: tuple, labels: Mapping[str, Mapping], plot: Curves) -> str:
    if dim == "wavelength":
        return f"{number_text(1e3 * part[0], 4)} nm"
    if dim == "curve":
        return plot.curves[part[0]]
    return labels["field"].get(part, f"{part[1]:g}")


def _finished(
    figure: Figure,
    pair: LensComparison,
    dashes: Sequence[tuple[str, Dash]] = (),
    *,
    coloured: bool = True,
    dash_colour: str = "#404040",
) -> Figure:
    """The figure with its title, and a legend of lenses and dashes."""
    handles = (
        [
            legend_entry(f"{letter}: {name}", color=colour, linewidth=2)
            for letter, name, colour in zip("AB", pair.names, COLOURS, strict=True)
        ]
        if coloured
        else []
    )
    handles += [legend_entry(word, color=dash_colour, linestyle=dash) for word, dash in dashes]
    if handles:
        width = 12.0 * figure.get_figwidth()
        columns = max(1, min(len(handles), int(width / (6 + max(len(str(h.get_label())) for h in handles)))))
        figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    titles = {"rms_over_field": "RMS over the field", "mtf": "MTF", "opd_fan": "OPD fans", "ray_fan": "ray fans"}
    titles |= {"seidel": "sums of the Seidel aberrations", "distortion_grid": "grid distortion"}
    if isinstance(pair.first, Thermal):
        titles["thermal"] = f"over temperature, mount: {mount_words(float(pair.first.expansion))}"
    titles |= {"incidence": "angles of incidence on the sensor"}
    figure.suptitle(titles.get(pair.analysis, pair.analysis.replace("_", " ")), fontweight="bold", fontsize=10)
    return figure


def _draw_layouts(pair: LensComparison) -> Figure:
    """The cross sections one above the other, on one scale of mm."""
    figure = new_figure(8.0, 7.2)
    panels = [*figure.subplots(2, 1)]
    for panel, letter, name, drawn in zip(panels, "AB", pair.names, (pair.first, pair.second), strict=True):
        draw_layout(panel, drawn.lens, fields=drawn.fields)
        panel.set_title(f"{letter}: {name}", fontsize=9)
    on_one_scale(panels)
    (left, right), (low, high) = panels[0].get_xlim(), panels[0].get_ylim()
    figure.set_size_inches(8.0, min(max(2 * 7.6 * abs((high - low) / (right - left)), 3.0), 10.0) + 1.0)
    return _finished(figure, pair, coloured=False)


def _draw_spots(pair: LensComparison) -> Figure:
    """A row of spots for each lens, on one scale."""
    both = [result.dots() for result in (pair.first, pair.second) if isinstance(result, Spots)]
    half = max(panel_size(whole.geometric_radius.tolist(), float(airy_radius(lens))) for lens, whole, *_ in both)
    fields, labels = pair.first.fields, [field_text for field_text in _labels(pair.first)]
    count = fields.shape[1]
    rows = -(-count // 4)
    across = min(count, 4)
    width = max(2.1 * across + 0.5, 5.0)
    figure = new_figure(width, 2 * rows * (width / across + 0.45) + 1.0)
    grid = figure.subplots(2 * rows, across, squeeze=False)
    for panel in grid.flat:
        panel.axis("off")
    for f, k in ((f, k) for f in range(count) for k in (0, 1)):
        lens, whole, dots, _ = both[k]
        panel = grid[2 * (f // 4) + k, f % 4]
        panel.axis("on")
        wavelengths, airy = lens.wavelengths.tolist(), float(airy_radius(lens))
        draw_spot(panel, whole, dots, f, wavelengths=wavelengths, airy=airy, half=half)
        panel.set_title(labels[f] if k == 0 else "")
        if f % 4 == 0:
            panel.set_ylabel("AB"[k], rotation=0, fontsize=12, fontweight="bold", labelpad=12, va="center")
    lens = both[0][0]
    legend = figure.legend(
        handles=wavelength_handles(lens.wavelengths.tolist(), float(airy_radius(lens))),
        title=fill(f"A: {pair.names[0]}\nB: {pair.names[1]}", width, 8), loc="outside lower center",
        ncols=min(6, int(width / 1.05)), handletextpad=0.3,
    )  # fmt: skip
    legend.get_title().set_fontsize(8)
    figure.suptitle("spots on one scale", fontweight="bold", fontsize=10)
    return figure


def _labels(result: Any) -> Sequence[str]:
    return field_labels(result)


def _draw_maps(pair: LensComparison) -> Figure:
    """A row of wavefront maps at the primary wavelength for each lens, on one scale of colours."""
    both = [result for result in (pair.first, pair.second) if isinstance(result, WavefrontMap)]
    w = both[0].lens.primary_wavelength - 1
    maps = [np.where(array(single.valid)[:, w], array(single.opd)[:, w], np.nan) for single in both]
    colours, scale = diverging(np.stack(maps))
    labels = field_labels(both[0])
    across = min(len(labels), 4)
    rows = -(-len(labels) // 4)
    figure = new_figure(1.9 * across + 1.8, 4.9 * rows + 1.1)
    grid = figure.subplots(2 * rows, across, squeeze=False)
    for panel in grid.flat:
        panel.axis("off")
    for f, k in ((f, k) for f in range(len(labels)) for k in (0, 1)):
        panel = grid[2 * (f // 4) + k, f % 4]
        panel.axis("on")
        drawn = draw_map(panel, maps[k][f], colours, scale)
        rms, strehl = (number_text(float(v[f, w]), 3) for v in (both[k].rms, both[k].strehl))
        panel.set_xlabel(f"RMS {rms}\nStrehl {strehl}", fontsize=7.5, color=GREY)
        panel.set_title(labels[f] if k == 0 else "")
        if f % 4 == 0:
            panel.set_ylabel("AB"[k], rotation=0, fontsize=12, fontweight="bold", labelpad=12, va="center")
    bar = figure.colorbar(drawn, ax=grid, shrink=0.8, aspect=30, pad=0.02)
    bar.set_label("OPD (waves)")
    bar.outline.set_visible(False)
    wavelength = number_text(1e3 * float(primary_wavelength(both[0].lens)), 4)
    words = f"wavefront, {wavelength} nm\nA: {pair.names[0]}\nB: {pair.names[1]}"
    figure.suptitle(fill(words, figure.get_figwidth(), 9, bold=True), fontweight="bold", fontsize=9)
    return figure


def _draw_grids(pair: LensComparison) -> Figure:
    """The grids of both lenses side by side on one scale of mm, each over that without distortion."""
    figure = new_figure(8.4, 4.9)
    grids = (pair.first, pair.second)
    axes = [*figure.subplots(1, 2, sharex=True, sharey=True)]
    largest = max(float(grid.largest().abs()[0]) for grid in grids)
    times = min(max(round_length(_SHOWN / max(largest, 1e-9)), 1.0), 1000.0)
    for panel, letter, colour, grid in zip(axes, "AB", COLOURS, grids, strict=True):
        draw_grid(panel, grid, colour, times)
        panel.set_title(f"{letter}: largest {number_text(100 * float(grid.largest()[0]), 3)} %")
        panel.set(xlabel="x on the sensor (mm)", aspect="equal")
    axes[0].set_ylabel("y on the sensor (mm)")
    finished = _finished(figure, pair, [("without distortion", "-")], dash_colour=GREY)
    if times > 1:
        finished.suptitle(f"grid distortion, drawn × {times:g}", fontweight="bold", fontsize=10)
    return finished


def _draw_psfs(pair: LensComparison) -> Figure:
    """The light of both lenses, a row for each field, in windows of one size, a row on one scale of brightness."""
    both = [psfs for psfs in (pair.first, pair.second) if isinstance(psfs, Psf)]
    size = max(float(windows(psfs)[0].max()) for psfs in both)
    light = np.stack([array(close_up_of(psfs, size).light)[0] for psfs in both], 1)  # field × lens × N × N
    notes = [[f"σ {sx:.3g}, {sy:.3g} µm" for sx, sy in row] for row in _widths(both)]
    labels = row_labels(both[0])
    peaks = light.max((1, 2, 3)).tolist()
    halves = np.full(light.shape[:2], size)
    figure, _ = panels(light, halves, ["A", "B"], labels, notes, log=True, peaks=peaks)
    lines = [
        f"A: {pair.names[0]}",
        f"B: {pair.names[1]}",
        f"windows of {2e3 * size:.3g} µm about the centroid",
        f"each row {10.0**-DECADES:g} to 1 of the higher peak, logarithmic",
        "σ: of the rays, along x and y",
    ]
    return worded(figure, f"{both[0].model} PSF", ["\n".join(lines)])


def _widths(both: Sequence[Psf]) -> list[list[tuple[float, float]]]:
    """σ_x and σ_y in µm of the rays, by field and lens."""
    sigmas = [1e3 * psfs.ray_covariance[::2, 0].clamp_min(0.0).sqrt().detach() for psfs in both]  # (2, F)
    return [[(float(each[0, f]), float(each[1, f])) for each in sigmas] for f in range(sigmas[0].shape[1])]


def _draw_thermal(pair: LensComparison) -> Figure:
    """Focus shift, and spot radius and lowest modulation with the fixed sensor, over temperature."""
    cycles = f"{float(pair.first.frequency):.4g}"
    curves = {
        "focus_shift_um": "focus shift (µm)",
        "rms_fixed_um": "RMS spot radius, sensor fixed (µm)",
        "modulation_fixed": f"lowest modulation at\n{cycles} cycles/mm, sensor fixed",
    }
    tops = {"rms_fixed_um": None, "modulation_fixed": 1.0}
    return _curves(pair, Curves("temperature", "temperature (°C)", "", curves, ("curve",), is_shared=False, tops=tops))


def _draw_sums(pair: LensComparison) -> Figure:
    """Bars of the sums of the Seidel aberrations of the outermost field."""
    sums = [flat(result.summary()) for result in (pair.first, pair.second)]
    names = [name for name in pair.first.names if len(pair.first.lens.wavelengths) > 1 or name[0] != "C"]
    figure = new_figure(6.0, 3.8)
    panel: Axes = ruled(figure.add_subplot())
    for k, (table, colour) in enumerate(zip(sums, COLOURS, strict=True)):
        place = np.arange(len(names)) + 0.4 * k - 0.2
        panel.bar(place, [table[name][-1] for name in names], width=0.38, color=colour)
    panel.set_xticks(range(len(names)), names)
    panel.axhline(0, color=GREY, linewidth=0.6)
    panel.set_ylabel(f"sum over the surfaces ({pair.first.unit})")
    return _finished(figure, pair)


def _grid(lens: Lens, scene: Lens | None = None) -> GridDistortion:
    """The grid distortion of a lens, of the objects of another one."""
    return distortion_grid(lens if scene is None else dataclasses.replace(lens, fields=scene.fields))


def _at_fields(first: Any) -> dict[str, Any]:
    return {"fields": first.fields}


_SECTIONS = {"tangential": "tangential", "sagittal": "sagittal"}

#: Analyses that are compared, by the name of their function.
COMPARED: dict[str, Compared] = {
    "layout": Compared(layout, _at_fields, _draw_layouts, at_fields=True),
    "spot": Compared(spot, _at_fields, _draw_spots, at_fields=True),
    "ray_fan": Compared(ray_fan, _at_fields, Curves(
        "pupil", "pupil coordinate", "transverse aberration (µm)", _SECTIONS, ("field", "curve"), factor=1e3),
        at_fields=True),
    "opd_fan": Compared(opd_fan, _at_fields, Curves(
        "pupil", "pupil coordinate", "OPD (waves)", _SECTIONS, ("field", "curve")), at_fields=True),
    "wavefront": Compared(wavefront, _at_fields, _draw_maps, summary=True, at_fields=True),
    "mtf": Compared(mtf, lambda first: {"fields": first.fields, "frequencies": first.frequencies}, Curves(
        "frequency", "spatial frequency (cycles/mm)", "modulation", _SECTIONS, ("field",), limits=(0, 1)),
        at_fields=True),
    "encircled_energy": Compared(encircled_energy, lambda first: {"fields": first.fields, "radii": first.radii}, Curves(
        "radius", "radius from the centroid (µm)", "encircled energy", {"share": "encircled energy"}, ("field",),
        x_factor=1e3, limits=(0, 1.02)), at_fields=True),
    "distortion": Compared(distortion, _at_fields, Curves(
        "field", "", "distortion (%)", {
        "f_tan_percent": "F-tan θ distortion (%)", "f_theta_percent": "F-θ distortion (%)"},
        ("curve",), upright=True, is_shared=False),
        at_fields=True),
    "field_curvature": Compared(field_curvature, _at_fields, Curves(
        "field", "", "focus from the sensor (mm)", _SECTIONS, ("wavelength",), upright=True), at_fields=True),
    "lateral_colour": Compared(lateral_colour, _at_fields, Curves(
        "field", "", "lateral colour (µm)", {"shift": "lateral colour"}, factor=1e3, upright=True), at_fields=True),
    "relative_illumination": Compared(relative_illumination, _at_fields, Curves(
        "field", "", "relative illumination", {"illumination": "relative illumination"}, limits=(0, None)),
        at_fields=True),
    "rms_over_field": Compared(rms_over_field, _at_fields, Curves(
        "field", "", "RMS wavefront error (waves)", {"rms": "RMS wavefront error"}, ("wavelength",), limits=(0, None)),
        at_fields=True),
    "longitudinal_aberration": Compared(longitudinal_aberration, lambda first: {}, Curves(
        "pupil", "height in the pupil", "crossing with the axis, from the sensor (mm)", {"crossing": "crossing"},
        upright=True)),
    "chromatic_focal_shift": Compared(chromatic_focal_shift, lambda first: {}, Curves(
        "wavelength", "wavelength (µm)", "paraxial focus, from that of the primary wavelength (mm)", {"shift": "focus"},
        upright=True)),
    "incidence": Compared(incidence, _at_fields, Curves(
        "field", "", "angle of incidence on the sensor (°)", {
        "chief": "chief ray", "upper": "upper rim", "lower": "lower rim"}), summary=True, at_fields=True),
    "distortion_grid": Compared(_grid, lambda first: {"scene": first.lens}, _draw_grids, text="summary"),
    "psf": Compared(psf, lambda first: {"fields": first.fields, "model": first.model}, _draw_psfs, at_fields=True),
    "seidel": Compared(seidel, _at_fields, _draw_sums, summary=True, at_fields=True),
    "thermal": Compared(thermal, lambda first: {"fields": first.fields, "modulation_frequency": float(first.frequency)},
        _draw_thermal, at_fields=True),
}  # fmt: skip
