"""Spots: the spot of every field and wavelength on the sensor, of rays that are kept or of any number that are not."""

import contextlib
import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.panels import first_order_text
from raytrace.analysis.setting import scene_of
from raytrace.maths.numerics import detached, safe_divide, value
from raytrace.maths.result import Column, Result, Table, axis, number, numbers
from raytrace.maths.sampling import SAMPLINGS, gauss_rings, hexapolar, sampled, sobol, with_rim
from raytrace.plotting import style
from raytrace.system.lens import (
    Lens,
    aligned,
    field_label,
    field_points,
    field_title,
    one_lens,
    with_wavelengths,
)
from raytrace.tracing.clear_pupil import clear_rays, clipped
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.launch import warn_of_filling, with_ray_aiming
from raytrace.tracing.ray_failures import STATUS, LostRays, warn_of_failures
from raytrace.tracing.spot import Arrivals, Spot, arrivals, chief_reference, image_rays, spot_of, spot_of_points
from raytrace.tracing.streaming import MAX_BYTES, StreamedSpot, stream_spots
from raytrace.words import calling_level, option

_KERNELS = 64  # whose clear pupils are searched at once
_TRIED = 4096  # rays that are traced again for the cause where all fail
_RIM = 72  # rays on the rim of the pupil, for the largest radius, as the spot of few rays has them
_DOT_RINGS = 12  # 469 dots of a wavelength
_INSET = 0.395  # of a panel's width
_MAGNIFY = 4.0  # a spot smaller than its panel by more than this has an enlargement in it
_REFERENCES, _WEIGHTS = ("centroid", "chief"), ("area", "equal")


@value
class Spots(Result):
    """Spots (F, W) of every field and wavelength on the sensor, (L, F, W) of a batch, mm, with the numbers of a `Spot`.

    each: (F, W) Spot, or StreamedSpot of rays that were not kept; whole: (F,) those of all wavelengths together, by
    their weights. arrivals: the rays, None where none were kept. reference, weights: as for `spot`.
    lens, fields: (2, F). The table has a row a spot; `save` writes the rays.
    """

    COLUMNS = (
        Column("centroid_x", "mm", ".7f", "centroid x"), Column("centroid_y", "mm", ".7f", "centroid y"),
        Column("rms_radius_um", "µm", ".4f", "RMS"), Column("geometric_radius_um", "µm", ".4f", "GEO"),
        Column("lost", "", ".0f", "rays\nlost"),
    )  # fmt: skip

    lens: Lens
    fields: Tensor
    each: Spot | StreamedSpot
    whole: Spot | StreamedSpot
    arrivals: Arrivals | None = None
    reference: str = "centroid"
    weights: str = "area"

    @property
    def centroid(self) -> Tensor:
        """(2, F, W) mm of every spot."""
        return self.each.centroid

    @property
    def mean_square_radius(self) -> Tensor:
        """(F, W) mm² of every spot."""
        return self.each.mean_square_radius

    @property
    def rms_radius(self) -> Tensor:
        """(F, W) mm of every spot."""
        return self.each.rms_radius

    @property
    def geometric_radius(self) -> Tensor:
        """(F, W) mm, the largest radius of every spot."""
        return self.each.geometric_radius

    @property
    def rays(self) -> Tensor:
        """(F, W), number of rays of every spot that arrive."""
        return self.each.rays

    @property
    def launched(self) -> int:
        """Number of rays launched for each field and wavelength."""
        return self.each.launched if isinstance(self.each, StreamedSpot) else self.each.valid.shape[-1]

    def columns(self) -> dict[str, Tensor]:
        x, y = (axis(component, 0, 2) for component in self.fields)
        of_lens = {} if self.lens.count is None else {"lens": axis(torch.arange(self.lens.count), 0, 3)}
        return {**of_lens, "field_x": x, "field_y": y, "wavelength": self.lens.wavelengths, **_figures(self.each)}

    def document(self) -> dict:
        places = [*np.ndindex(*self.rays.shape)]
        unit = {"field_type": self.lens.fields.kind, "field_unit": self.lens.fields.unit}
        about = {} if self.arrivals is None else {"reference": self.reference, "weights": self.weights}
        return {**unit, "results": [self._entry(*place) for place in places], **about}

    def _entry(self, *place: int) -> dict:
        """The spot of a field and a wavelength, of a lens of a batch, for JSON: null where no ray arrives."""
        *of_lens, f, w = place
        entry: dict[str, Any] = {"lens": of_lens[0]} if of_lens else {}
        entry |= {
            "field": numbers(self.fields[:, f]),
            "wavelength": number(self.lens.wavelengths[w]),
            "centroid": numbers(self.centroid.movedim(0, -1)[place]),
            "rms_radius_um": number(1e3 * self.rms_radius[place]),
            "geometric_radius_um": number(1e3 * self.geometric_radius[place]),
            "rays": int(self.rays[place]),
        }
        if isinstance(self.each, StreamedSpot):
            entry["geometric_bound_um"] = number(1e3 * self.each.geometric_bound[place])
        elif self.arrivals is not None:
            entry["vignetted"] = int((self.arrivals.status[place] == STATUS.index("vignetted")).sum())
        return {**entry, "launched": self.launched}

    def tables(self) -> list[Table]:
        """A row for each spot, and one for each field of several wavelengths together; of a batch one for each spot."""
        if self.lens.count is not None:
            table = self.columns()
            return [Table({**table, "lost": self.launched - table.pop("rays")})]
        waves = [f"{wavelength:g}" for wavelength in self.lens.wavelengths.tolist()]
        several = len(waves) > 1
        together = [""] * several
        whole, each = _figures(self.whole), _figures(self.each)
        lost = (self.launched - each.pop("rays")).tolist()
        columns: dict[str, Tensor | Sequence] = {
            name: [text for place in row.tolist() for text in (*[f"{place:g}"] * len(waves), *together)]
            for name, row in zip(("field_x", "field_y"), self.fields, strict=True)
            if name == "field_y" or bool(row.any())
        }
        columns["wavelength"] = [*waves, *["all"] * several] * self.fields.shape[1]
        for name, values in each.items():
            columns[name] = (torch.cat([values, whole[name][:, None]], 1) if several else values).flatten()
        columns["lost"] = [text for row in lost for text in (*map(str, row), *together)]
        return [Table(columns)]

    @style.styled
    def draw(self) -> style.Figure:
        """Spot diagram: one panel a field, one colour and marker a wavelength, the Airy disc at the primary wavelength.

        All panels have the same scale, are centred on the centroid over all wavelengths or on the chief ray of
        the primary one (`reference`), and print the RMS and the geometric radius about it. Raises ValueError for a
        batch of lenses.
        """
        lens, whole, dots, about = self.dots()
        fields, wavelengths = style.array(self.fields), lens.wavelengths.tolist()
        airy = float(airy_radius(lens))
        half = panel_size(whole.geometric_radius.tolist(), airy)
        columns = min(fields.shape[1], 4 if fields.shape[1] % 3 or fields.shape[1] == 12 else 3)
        rows = math.ceil(fields.shape[1] / columns)
        width = max(2.25 * columns, 5.6)
        figure = style.new_figure(width, ((width / columns if columns > 1 else 3.4) + 0.55) * rows + 1.05)
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for f, panel in enumerate(axes):
            if f >= fields.shape[1]:
                panel.axis("off")
                continue
            draw_spot(panel, whole, dots, f, wavelengths=wavelengths, airy=airy, half=half)
            panel.set_title(f"{field_title(lens)} {field_label(lens, fields[:, f].tolist())}")
        name = style.fill(lens.name, width, 11, bold=True) or "Lens"
        figure.suptitle(name, fontsize=11, fontweight="bold")
        legend = figure.legend(
            handles=wavelength_handles(wavelengths, airy),
            title=f"{first_order_text(lens)}\n"
            f"centred on the {'centroid' if about is None else 'chief ray'}; RMS and GEO (largest) radius about it, "
            "all wavelengths together",
            loc="outside lower center", ncols=min(6, int(width / 1.05)), handletextpad=0.3,
            title_fontproperties={"size": 8}, alignment="center",
        )  # fmt: skip
        legend.get_title().set(color=style.GREY, multialignment="center")
        return figure

    def dots(self) -> tuple[Lens, Spot, Spot, Tensor | None]:
        """For drawing: the lens, the spots (F,) of all wavelengths, the spots (F, W) of the rays that are dots, and the
        chief points (2, F) that the panels are centred on, None for centroids."""
        if self.lens.count is not None:
            raise ValueError("a spot diagram shows one lens, not a batch: choose one, as lens[0]")
        lens, points, rays = detached(self.lens), self.fields.detach(), self._kept(option("plot"))
        about = chief_reference(lens, points)[..., 0] if self.reference == "chief" else None
        whole, dots = field_spots(lens, fields=points, pupil=(rays.pupil, rays.weight.detach().sum(0)), about=about)
        radii = {name: getattr(self.whole, name).detach() for name in ("rms_radius", "geometric_radius")}
        centre = self.whole.centroid.detach() if about is None else about  # of the panels
        return lens, dataclasses.replace(whole, centroid=centre, **radii), dots, about

    def save(self, path: str | PathLike) -> None:
        """Write the rays as .csv: field, wavelength, pupil point, x, y, weight, status."""
        self._kept(option("output")).save(path)

    def _kept(self, use: str) -> Arrivals:
        if self.arrivals is None:
            raise ValueError(f"{use} needs the rays, and {option('rays')} keeps none: leave one out")
        return self.arrivals


def spot(
    lens: Lens,
    *,
    fields: Tensor | Sequence | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    sampling: Literal["gauss", "hexapolar", "square", "sobol", "random"] = "gauss",
    rings: int | None = None,
    points: int | None = None,
    seed: int = 0,
    rays: int | None = None,
    reference: Literal["centroid", "chief"] = "centroid",
    weights: Literal["area", "equal"] = "area",
    ray_aiming: str | None = None,
    max_bytes: int | None = None,
    progress: Callable | None = None,
) -> Spots:
    """The spot of every field and wavelength on the sensor, differentiable in every number of the lens.

    fields: y, (x, y) or (2, F), in the lens's own kind of field, by default its own; wavelengths: µm, alike in weight,
    the first one primary, by default the lens's. sampling, rings, points, seed: as for `sampled`; rays: instead of
    `points`, any number of sobol or random rays for each field and wavelength, traced in chunks of at most `max_bytes`,
    none kept and nothing differentiated. reference: radii about the "centroid" or the "chief" ray of the primary
    wavelength; weights: of rays, by their share of the pupil's "area", or all "equal"; OpticStudio's spots are
    `sampling` hexapolar, `rings` 6, `weights` equal, `reference` chief. ray_aiming: a key of RAY_AIMING. Warns LostRays
    for fields that lose all their rays, UnfilledStop. Raises ValueError for unknown options. progress: called with
    (work, unit), returns the iterable, or a progress bar to update.

    Where apertures clip the beam, `gauss` by area integrates it up to its edge (`tracing.clear_pupil`): centroid and
    radii, and their derivatives, converge to those of the light, whose edge moves with the lens and its apertures.
    Other samplings and weights return sums over the rays that arrive, with the derivatives of these sums, which lack
    the motion of the edge. `rays` counts those launched in either case.
    """
    for name, word, known in (("reference", reference, _REFERENCES), ("weights", weights, _WEIGHTS)):
        if word not in known:
            raise ValueError(f"{name} {word!r}: expected one of {', '.join(known)}")
    lens = aligned(lens if wavelengths is None else with_wavelengths(lens, wavelengths), 3)
    fields = field_points(fields, like=lens)
    warn_of_filling(lens, fields, ray_aiming=ray_aiming)
    if rays is not None:
        if lens.count is not None:
            raise ValueError(
                f"{option('rays')} traces one lens, not a batch: leave it out, or choose a lens, as lens[0]"
            )
        _refuse_of_many(sampling, rings, points, reference, weights)
        rule = "random" if sampling == "random" else "sobol"
        return _of_many(lens, fields, rays, rule, seed, ray_aiming, max_bytes, progress)
    like = lens.surfaces[-2].thickness
    pupil, shares = sampled(sampling, rings=rings, points=points, seed=seed, dtype=like.dtype, device=like.device)
    if weights == "equal":
        shares = torch.full_like(shares, 1 / len(shares))
    else:  # the rim carries no weight: it shows in the geometric radius, which Gaussian nodes inside the pupil miss
        pupil, shares = with_rim(pupil, shares)
    each = iter if progress is None else lambda work: progress(work, "field")
    traced = arrivals(lens, pupil, shares, fields=fields, ray_aiming=ray_aiming, progress=each)
    if unaimed := int((traced.status == STATUS.index("unaimed")).sum()):
        message = f"{unaimed} of {traced.status.numel()} rays could not be aimed at their point of the stop"
        warnings.warn(message, LostRays, stacklevel=calling_level())
    about = None if reference == "centroid" else chief_reference(with_ray_aiming(lens, ray_aiming), fields)
    spots = spot_of(traced.rays, shares, about=about)
    warn_of_failures(lens, pupil, spots.rms_radius.isnan(), fields=fields, ray_aiming=ray_aiming)
    hits, valid = traced.rays.position[:2].flatten(-2), traced.rays.valid.flatten(-2)
    about = None if about is None else about[..., 0]
    whole = spot_of_points(hits, valid, traced.weight.flatten(), about=about)
    if (sampling, weights) == ("gauss", "area") and not bool(valid.all()):
        rings = SAMPLINGS["gauss"][2] if rings is None else rings
        spots, whole = _of_clear_pupils(
            with_ray_aiming(lens, ray_aiming), fields, pupil[:, shares > 0], rings, about, spots, whole
        )
    return Spots(lens, fields, spots, whole, traced, reference, weights)


#: Statistics of a `Spot` and the axes that each has by itself.
_STATISTICS = {"centroid": 1, "mean_square_radius": 0, "rms_radius": 0, "geometric_radius": 0}


def _of_clear_pupils(
    lens: Lens, fields: Tensor, launched: Tensor, rings: int, about: Tensor | None, each: Spot, whole: Spot
) -> tuple[Spot, Spot]:
    """The spots (F, W) and (F,) of launched rays, (L, F, W) and (L, F) of a batch, with the statistics of the clear
    pupils of the fields that apertures clip.

    about: (2, F) mm, (2, L, F) of a batch, or None. The points, and which of them are valid, stay those launched.
    """
    size = max(1, _KERNELS // len(lens.wavelengths))
    parts = torch.arange(fields.shape[1]).split(size)
    clips = torch.cat([clipped(scene_of(lens, fields[:, part]), launched) for part in parts], 1).any(-1)  # (L, F)
    lenses = clips.any(-1).nonzero()[:, 0]
    clips = clips[0] if lens.count is None else clips
    shares = lens.wavelength_weights / lens.wavelength_weights.sum()
    clear_each, clear_whole = each, whole
    for some in lenses.split(max(1, size // fields.shape[1])):
        chosen = lens if lens.count is None else one_lens(lens, some)
        alone, joint = [], []
        for part in parts:
            rays, weights = clear_rays(scene_of(chosen, fields[:, part]), rings)
            hits, valid = rays.position[:2], rays.valid
            centre = None if about is None else about.reshape(2, -1, fields.shape[1])[:, some][..., part]
            together = hits.flatten(-2), valid.flatten(-2), (weights * shares[:, None]).flatten(-2)
            alone.append(spot_of_points(hits, valid, weights, about=None if centre is None else centre[..., None]))
            joint.append(spot_of_points(*together, about=centre))
        clear_each, clear_whole = _put(clear_each, alone, some), _put(clear_whole, joint, some)

    def clear_where_clipped(new: Spot, old: Spot, clips: Tensor) -> Spot:
        return _with_statistics(old, lambda name, _: torch.where(clips, getattr(new, name), getattr(old, name)))

    return clear_where_clipped(clear_each, each, clips[..., None]), clear_where_clipped(clear_whole, whole, clips)


def _with_statistics(spot: Spot, number_of: Callable[[str, int], Tensor]) -> Spot:
    """The spot with other statistics, by their name and number of axes."""
    numbers: dict[str, Any] = {name: number_of(name, axis) for name, axis in _STATISTICS.items()}
    return dataclasses.replace(spot, **numbers)


def _put(spots: Spot, parts: Sequence[Spot], lenses: Tensor) -> Spot:
    """Spots (…, lenses, …) in which some lenses have those of parts of the fields; of one lens, those of the parts."""

    def number_of(name: str, axis: int) -> Tensor:
        numbers, new = getattr(spots, name), torch.cat([getattr(part, name) for part in parts], axis + 1)
        return numbers.index_copy(axis, lenses, new) if new.dim() == numbers.dim() else new.squeeze(axis)

    return _with_statistics(spots, number_of)


def _refuse_of_many(sampling: str, rings: int | None, points: int | None, reference: str, weights: str) -> None:
    if (reference, weights) != ("centroid", "area"):
        raise ValueError(
            f"{option('rays')} gives radii about the centroid by area: leave {option('reference')} and "
            f"{option('weights')} out"
        )
    for name, given in (("rings", rings), ("points", points)):
        if given is not None:
            raise ValueError(f"{option('rays')} and {option(name)} exclude each other: both are a number of rays")
    if sampling in ("hexapolar", "square"):
        raise ValueError(
            f"{option('rays')} takes {option('sampling', 'sobol')} (its default) or random, not {sampling}"
        )


def _of_many(
    lens: Lens,
    fields: Tensor,
    rays: int,
    sampling: str,
    seed: int,
    ray_aiming: str | None,
    max_bytes: int | None,
    progress: Callable | None,
) -> Spots:
    count = rays * fields.shape[1] * len(lens.wavelengths)
    with contextlib.nullcontext() if progress is None else progress(count, "ray") as bar:
        each, whole = stream_spots(
            lens,
            rays,
            fields=fields,
            sampling=sampling,
            seed=seed,
            rim=_RIM,
            ray_aiming=ray_aiming,
            max_bytes=MAX_BYTES if max_bytes is None else max_bytes,
            progress=bar and bar.update,
        )
    tried = sobol(min(rays, _TRIED))[0].to(lens.surfaces[-2].thickness)
    warn_of_failures(lens, tried, each.rays == 0, fields=fields, ray_aiming=ray_aiming)
    return Spots(lens, fields, each, whole)


def _figures(spots: Spot | StreamedSpot) -> dict[str, Tensor]:
    """Columns of the table, of spots (...)."""
    x, y = spots.centroid
    radii = {"rms_radius_um": 1e3 * spots.rms_radius, "geometric_radius_um": 1e3 * spots.geometric_radius}
    return {"centroid_x": x, "centroid_y": y, **radii, "rays": spots.rays}


def airy_radius(lens: Lens) -> Tensor:
    """Radius in mm of the first dark ring, 1.22 λ N: λ the primary wavelength, N the paraxial working F/#."""
    return 1.22e-3 * lens.primary * axial_f_number(lens)


def field_spots(
    lens: Lens,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    wavelength_weights: Tensor | None = None,
    pupil: tuple[Tensor, Tensor] | None = None,
    about: Tensor | None = None,
    rings: int = _DOT_RINGS,
) -> tuple[Spot, Spot]:
    """Polychromatic spots (F,), and the spots (F, W) of the rays that are drawn as dots.

    The RMS radius is computed from the arriving rays of the rule `pupil` (points, weights), by default `spot`'s.
    The dots have no weight in it but count for the geometric radius, as do points on the rim of the pupil. They are
    points of `even_hexapolar`: each stands for the same area of the pupil, so that their density is the light's.
    about: (2, F) mm, from where radii count, the centroid by default. rings: of dots.
    """
    dtype, device = lens.surfaces[-2].thickness.dtype, lens.wavelengths.device
    rule = SAMPLINGS["gauss"][2]
    points, weights = gauss_rings(rule, dtype=dtype, device=device) if pupil is None else pupil
    points, weights = with_rim(points, weights)
    dots = even_hexapolar(rings, dtype=dtype, device=device)
    shares = shares_of(lens, wavelengths, wavelength_weights)
    with torch.no_grad():
        rays = image_rays(lens, torch.cat([points, dots], dim=1), fields=fields, wavelengths=wavelengths)
        weights = torch.cat([weights, torch.zeros_like(dots[0])])
        hits, valid = rays.position[:2], rays.valid
        whole = spot_of_points(hits.flatten(2), valid.flatten(1), (shares[:, None] * weights).flatten(), about=about)
        drawn = points.shape[1]
        seen = spot_of_points(hits[..., drawn:], valid[..., drawn:])
        if pupil is None and not bool(valid.all()):
            lens = lens if wavelengths is None else with_wavelengths(lens, wavelengths)
            fields, inside = field_points(fields, like=lens), points[:, weights[:drawn] > 0]
            seen, whole = _of_clear_pupils(lens, fields, inside, rule, about, seen, whole)
        return whole, seen


def even_hexapolar(rings: int, **like: Any) -> Tensor:
    """Points (2, 1 + 3·rings·(rings + 1)) of equal areas of the pupil: the centre, and 6, 12, … on circles.

    The first j rings and the centre fill the radius √((1 + 3j(j + 1))/N) of N points in all; each ring halves its area.
    """
    points = hexapolar(rings, **like)[0]
    ring = torch.round(torch.hypot(*points) * rings)
    radius = torch.sqrt((1 + 3 * ring * ring) / points.shape[1])
    return torch.where(ring > 0, points * safe_divide(radius, torch.hypot(*points)), 0.0)


def shares_of(lens: Lens, wavelengths: Tensor | None, weights: Tensor | None) -> Tensor:
    """Weights (W,) of wavelengths: those given, else the lens's for its own wavelengths and equal ones for others."""
    if weights is not None:
        return weights.to(lens.wavelengths)
    return lens.wavelength_weights if wavelengths is None else torch.ones_like(wavelengths)


def panel_size(radii: Sequence[float], airy: float) -> float:
    """Half width in mm that holds spots of these geometric radii and the Airy disc."""
    return 1.14 * max(1e-7, *(radius for radius in (*radii, airy) if math.isfinite(radius)))


def draw_spot(
    axes: style.Axes,
    whole: Spot,
    dots: Spot,
    number: int,
    *,
    wavelengths: Sequence[float],
    airy: float,
    half: float,
) -> None:
    """Draw the spot of one field into square axes of ± half mm about its centroid, with its radii below."""
    draw_dots(axes, whole, dots, number, wavelengths=wavelengths, airy=airy, half=half)
    bar = style.round_length(0.62 * half)
    style.scale_bar(axes, -0.93 * half, -0.93 * half, bar, align="left")
    if bool(whole.rms_radius[number].isnan()):
        axes.text(0, 0, "no ray reaches\nthe image", ha="center", va="center", color=style.GREY)
        axes.set_xlabel(" \n ")
        return
    rms, largest = (1e3 * float(r[number]) for r in (whole.rms_radius, whole.geometric_radius))
    axes.set_xlabel(f"RMS {style.number_text(rms)} µm\nGEO {style.number_text(largest)} µm", labelpad=4)


def draw_spot_to_scale(
    axes: style.Axes,
    whole: Spot,
    dots: Spot,
    number: int,
    *,
    wavelengths: Sequence[float],
    airy: float,
    half: float,
) -> None:
    """As `draw_spot`, on the scale of other panels; a spot much smaller than its panel is enlarged in a corner of it,
    with the factor below."""
    draw_spot(axes, whole, dots, number, wavelengths=wavelengths, airy=airy, half=half)
    size = panel_size([float(whole.geometric_radius[number])], airy)
    if bool(whole.rms_radius[number].isfinite()) and half > _MAGNIFY * size:
        inset = axes.inset_axes((0.985 - _INSET, 0.985 - _INSET, _INSET, _INSET), zorder=8)
        draw_dots(inset, whole, dots, number, wavelengths=wavelengths, airy=airy, half=size)
        inset.set_facecolor("#fbfbfb")
        inset.set_xlabel(f"{style.number_text(_INSET * half / size, 2)}×", fontsize=7, labelpad=1)


def draw_dots(
    axes: style.Axes,
    whole: Spot,
    dots: Spot,
    number: int,
    *,
    wavelengths: Sequence[float],
    airy: float,
    half: float,
) -> None:
    """The dots and the Airy circle, without words."""
    centre = style.array(whole.centroid[:, number])
    size = 2.0 if half > 4 * airy else 2.4
    for cross in (axes.axhline, axes.axvline):
        cross(0, color=style.FAINT, linewidth=0.5, zorder=1)
    for w, colour in enumerate(style.wavelength_colours(wavelengths)):
        kept = style.array(dots.valid[number, w]).astype(bool)
        x, y = style.array(dots.points[:, number, w])[:, kept] - centre[:, None]
        marker = style.WAVELENGTH_MARKERS[w % len(style.WAVELENGTH_MARKERS)]
        width = 0.0 if marker not in "+x" else 0.5
        axes.plot(x, y, marker, color=colour, markersize=size + 2 * width, markeredgewidth=width, zorder=3 + 0.1 * w)
    if math.isfinite(airy):
        from matplotlib.patches import Circle

        axes.add_patch(Circle((0, 0), airy, fill=False, edgecolor=style.INK, linewidth=0.9, zorder=4, gid="Airy"))
    axes.set_xlim(-half, half)
    axes.set_ylim(-half, half)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(True)


def wavelength_handles(wavelengths: Sequence[float], airy: float) -> list[style.Line2D]:
    """Entries of the legend: the colours of the wavelengths, and the Airy circle."""
    handles = [
        style.legend_entry(
            linestyle="", marker=style.WAVELENGTH_MARKERS[w % len(style.WAVELENGTH_MARKERS)], color=colour,
               markersize=4.5, label=f"{wavelength:.4g} µm")
        for w, (wavelength, colour) in enumerate(zip(wavelengths, style.wavelength_colours(wavelengths), strict=True))
    ]  # fmt: skip
    if math.isfinite(airy):
        handles.append(
            style.legend_entry(linestyle="", marker="o", markerfacecolor="none", color=style.INK, markersize=6,
                   label=f"Airy radius {style.micrometres(airy)}")
        )  # fmt: skip
    return handles
