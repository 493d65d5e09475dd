"""Spot: centroid, RMS and geometric radius of the points where rays meet a surface.

Arrivals: where every ray of a spot meets the sensor, from which field, colour and point of the pupil.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from raytrace.budget import RAY_BYTES, afford, afford_rays, piece
from raytrace.maths.numerics import dot_2, is_any, safe_divide, safe_sqrt, value
from raytrace.maths.result import Column, Result, axis, masked
from raytrace.system.lens import Lens, field_points, one_lens
from raytrace.system.rays import Rays
from raytrace.tracing.compiled import is_ready
from raytrace.tracing.launch import launch
from raytrace.tracing.ray_failures import STATUS, ray_status
from raytrace.tracing.trace import is_bent, trace_lens, without_apertures
from raytrace.words import RaytraceError

_PIECE = 2**16  # points whose statistics are formed at once: they stay in the cache


@value
class Spot:
    """Statistics over the last axis of a batch of rays; entries (...), mm.

    centroid: (2, ...); rms_radius and geometric_radius (the largest distance) are about it, or about another point.
    mean_square_radius: mm², smooth where the RMS is 0: minimise this one.
    points: (2, ..., P) and valid: (..., P) of the rays that were averaged; rays: number of valid ones.

    A spot that no weighted ray reaches is nan, with gradient 0: the sum with it is nan, the derivatives of the others
    are not. A merit that ignores it (`nansum`, a mask by `rays`) rewards the loss: constrain `rays`, add a penalty, or
    request an error (`empty`).
    """

    centroid: Tensor
    mean_square_radius: Tensor
    rms_radius: Tensor
    geometric_radius: Tensor
    points: Tensor
    valid: Tensor
    rays: Tensor


class EmptySpot(RaytraceError, ValueError):
    """No ray of a spot arrives: it has no centroid and no radius."""


def spot_of(rays: Rays, weights: Tensor | None = None, *, about: Tensor | None = None, empty: str = "nan") -> Spot:
    """Spot of rays (3, ..., P) over their last axis, invalid ones left out; weights: (P,) or (..., P), 1 by default.

    about: (2, ...) mm, reference of radii, the centroid by default. OpticStudio's default is equally weighted hexapolar
    rays about the primary chief ray; weighted by pupil area, about the centroid, a spot has the moments of the light.
    empty: the result of a spot without rays: "nan", or "error", which raises EmptySpot and reads the numbers to do so.
    """
    return spot_of_points(rays.position[:2], rays.valid, weights, about=about, empty=empty)


def spot_of_points(
    points: Tensor, valid: Tensor, weights: Tensor | None = None, *, about: Tensor | None = None, empty: str = "nan"
) -> Spot:
    """Spot of points (2, ..., P) mm; `about` and `empty` as for `spot_of`.

    One point is subtracted before the mean is formed, so that a spot of 1 pm at 1 m from the axis loses no precision; a
    spot of one ray has radius 0 and gradient 0.
    """
    shape = points.shape[1:]
    weights = points.new_ones(()) if weights is None else weights
    weights = weights.expand(shape[-1:] if weights.dim() < 2 else shape)  # of all spots once, if they are alike
    size = max(1, _PIECE // max(1, shape[1:].numel()))
    if len(shape) == 1 or shape[0] <= size:
        figures = _statistics(points, valid, weights, about)
    else:
        around = itertools.repeat(None) if about is None else about.expand(2, *shape[:-1]).split(size, 1)
        shares = itertools.repeat(weights) if weights.dim() == 1 else weights.split(size)
        parts = zip(points.split(size, 1), valid.expand(shape).split(size), shares, around, strict=False)
        each = zip(*(_statistics(*part) for part in parts), strict=True)
        figures = tuple(torch.cat(pieces, int(k == 1)) for k, pieces in enumerate(each))
    centroid, mean_square, rms, geometric = where_lit(*figures, empty=empty)
    return Spot(centroid, mean_square, rms, geometric, points, valid, valid.sum(-1, dtype=torch.int32).to(torch.int64))


def _statistics(points: Tensor, valid: Tensor, weights: Tensor, about: Tensor | None) -> tuple[Tensor, ...]:
    """Whether light arrives (...), its centroid (2, ...), the mean square, RMS and geometric radius (...)."""
    lost = is_any(~valid)

    def of_valid(numbers: Tensor) -> Tensor:
        return torch.where(valid, numbers, 0.0) if lost else numbers

    weights = of_valid(weights)
    total = weights.sum(-1, keepdim=True)
    share = weights * safe_divide(torch.ones_like(total), total)
    reference = points[..., :1] if points.shape[-1] else torch.zeros_like(total)
    if lost:
        first = valid.to(torch.uint8).argmax(-1, keepdim=True)
        reference = points.gather(-1, first.expand(2, *first.shape))
        reference = torch.where(valid.any(-1, keepdim=True), reference, 0.0)
    offset = of_valid(points - reference)
    mean = (share * offset).sum(-1, keepdim=True)
    centre = mean if about is None else about[..., None] - reference
    centred = of_valid(offset - centre)
    # The radii are formed in units of a power of two near the largest coordinate: squares of 1e-200 or 1e200 are none.
    scale = _power_of_two(centred)
    scaled = centred / scale
    mean_square = (share * dot_2(centred, centred)).sum(-1)  # differentiable where a radius is 0
    square, scale = dot_2(scaled, scaled), scale[..., 0]
    scaled_mean = (share * square).sum(-1)
    largest = square.amax(-1) if square.shape[-1] else scaled_mean
    rms, geometric = (scale * safe_sqrt(t) for t in (scaled_mean, largest))
    lit = (total[..., 0] != 0).expand(rms.shape)
    return lit, (reference + mean)[..., 0], mean_square, rms, geometric


def where_lit(lit: Tensor, *numbers: Tensor, empty: str = "nan") -> tuple[Tensor, ...]:
    """The numbers (..., *lit.shape) of spots where light arrives; elsewhere nan with gradient 0.

    empty: "nan", or "error", which raises EmptySpot if a spot is dark. Raises ValueError for another word.
    """
    if empty not in ("nan", "error"):
        raise ValueError(f"empty = {empty!r}: expected 'nan' or 'error', the value of a spot without rays")
    if empty == "error" and not bool(lit.all()):
        first = tuple(torch.nonzero(~lit)[0].tolist())
        raise EmptySpot(
            f"no ray reaches {int((~lit).sum())} of {lit.numel()} spots, first that of index {first}: "
            "it has no centroid and no radius"
        )
    return tuple(torch.where(lit, number, torch.nan) for number in numbers)


def _power_of_two(vectors: Tensor) -> Tensor:
    """The power of two above the largest entry of (2, ..., P) over the first and last axes, (..., 1); 1 if none."""
    if not vectors.shape[-1]:
        return vectors.new_ones((*vectors.shape[1:-1], 1))
    vectors = vectors.detach()
    largest = torch.maximum(vectors.amax(-1, keepdim=True), -vectors.amin(-1, keepdim=True)).amax(0)
    usable = (largest > 0) & torch.isfinite(largest)
    return torch.ldexp(torch.ones_like(largest), torch.frexp(torch.where(usable, largest, 0.5)).exponent)


def image_rays(lens: Lens, pupil: Tensor, *, fields: Tensor | None = None, wavelengths: Tensor | None = None) -> Rays:
    """Rays (3, F, W, P) on the sensor; arguments as for `launch`.

    Raises budget.OverBudget for more rays than memory holds.
    """
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    count = lens.fields.y.numel() if fields is None else fields.shape[1]
    afford_rays(pupil.shape[-1], fields=count, wavelengths=len(wavelengths))
    rays = launch(lens, pupil, fields=fields, wavelengths=wavelengths)
    return trace_lens(lens, rays, wavelengths[:, None])


_KEPT_BYTES = 100  # of a ray on the sensor, with its status
_COMPILED_BYTES = 100  # as RAY_BYTES, of the compiled trace: 72 measured

#: Fields (2, F) and lenses of one trace.
Chunk = tuple[Tensor, Lens]


@value
class Arrivals(Result):
    """Rays (3, F, W, P) on the sensor, all of the pupil for every field and wavelength; (3, L, F, W, P) of a batch.

    status: (F, W, P), index in STATUS of the first failure; reached: (F, W, P), whether the ray has a point on the
    sensor, as a vignetted ray may. weight: (W, P), sum 1 for a field. pupil: (2, P); fields: (2, F); wavelengths: (W,)
    µm. The table has a row per ray; x and y are empty for rays that are not on the sensor.
    """

    COLUMNS = Column("field_x"), Column("field_y")  # in the unit of the lens, which is not stored

    rays: Rays
    status: Tensor
    reached: Tensor
    weight: Tensor
    pupil: Tensor
    fields: Tensor
    wavelengths: Tensor

    def columns(self) -> dict[str, Tensor]:
        return {
            "field_x": axis(self.fields[0], 0, 3),
            "field_y": axis(self.fields[1], 0, 3),
            "wavelength": axis(self.wavelengths, 1, 3),
            "pupil_x": axis(self.pupil[0], 2, 3),
            "pupil_y": axis(self.pupil[1], 2, 3),
            "x": masked(self.rays.position[0], self.reached),
            "y": masked(self.rays.position[1], self.reached),
            "weight": self.weight,
            "status": self.status,
        }

    def words(self) -> dict:
        return {"status": STATUS}


def arrivals(
    lens: Lens,
    pupil: Tensor,
    weights: Tensor,
    *,
    fields: Tensor | None = None,
    ray_aiming: str | None = None,
    progress: Callable[[Sequence[Chunk]], Iterable[Chunk]] = iter,
) -> Arrivals:
    """Trace points (2, P) of the pupil and their weights (P,) to the sensor, as many fields at once as a chunk holds.

    fields, ray_aiming: as for `launch`; progress: goes over the chunks, as a bar does. Raises budget.OverBudget for
    more rays than memory holds.
    """
    fields = field_points(fields, like=lens)
    F, W, P = fields.shape[1], len(lens.wavelengths), pupil.shape[1]
    L = lens.count or 1
    count = f"{L * F * W * P:,} rays ({F} fields × {W} wavelengths × {P:,} pupil points{f' × {L} lenses' * (L > 1)})"
    helps = "ask for fewer, or by {rays}, which keeps none"
    afford(L * (RAY_BYTES * W * P + _KEPT_BYTES * F * W * P), count, helps=helps)
    trace = W * P * (_COMPILED_BYTES if is_ready(lens.surfaces[1:]) else RAY_BYTES)  # bytes for each field of a lens
    size = piece(F * trace)  # lenses at once; a lens whose fields exceed a chunk is split by fields
    lenses = [lens] if size >= L else [one_lens(lens, slice(k, k + size)) for k in range(0, L, size)]
    some_fields = fields.split(piece(min(L, size) * trace), 1)
    each = []  # of every chunk, rays (3, F, W, P) on the sensor, whether they reach it, and their status if one fails
    for some, part in progress([(some, part) for some in some_fields for part in lenses]):
        launched = launch(part, pupil, fields=some, ray_aiming=ray_aiming)
        launched = dataclasses.replace(launched, opl=None)
        rays = trace_lens(part, launched, lens.wavelengths[:, None])
        on_sensor: tuple[Rays, Tensor, Tensor | None] = rays, rays.valid, None
        if not bool(rays.valid.all()):  # the surface that ends a ray is looked for where one fails
            reached = launched.valid
            for crossing, status in ray_status(part, launched, lens.wavelengths[:, None]):
                reached = reached & ~crossing.missed & ~crossing.totally_reflected
                on_sensor = crossing.rays, reached, status
        each.append(on_sensor)

    def joined(parts: list[Tensor]) -> Tensor:
        rows = [parts[k : k + len(lenses)] for k in range(0, len(parts), len(lenses))]
        return _cat([_cat(row, -4) for row in rows], -3)

    reached, none = joined([reached for _, reached, _ in each]), fields.new_zeros((), dtype=torch.int64)
    if all(status is None for *_, status in each):
        status = none.expand(reached.shape)
    else:
        status = joined([none.expand(reached.shape) if s is None else s for _, reached, s in each])
    rays = Rays(*(joined([getattr(rays, part) for rays, *_ in each]) for part in ("position", "direction", "valid")))
    shares = lens.wavelength_weights / lens.wavelength_weights.sum()
    weight = shares[:, None] * weights / weights.sum()
    return Arrivals(rays, status, reached, weight, pupil, fields, lens.wavelengths)


def _cat(parts: list[Tensor], dim: int) -> Tensor:
    return torch.cat(parts, dim) if len(parts) > 1 else parts[0]


def chief_points(lens: Lens, fields: Tensor, wavelengths: Tensor) -> tuple[Tensor, Tensor]:
    """Where chief rays of fields (2, F) meet the sensor, (2, F, W) mm; whether they arrive or were only vignetted."""
    rays = image_rays(lens, fields.new_zeros(2, 1), fields=fields, wavelengths=wavelengths)
    return rays.position[:2, ..., 0], chief_arrives(lens, rays, fields, wavelengths)


def chief_arrives(lens: Lens, rays: Rays, fields: Tensor, wavelengths: Tensor) -> Tensor:
    """Whether the first of the rays (3, F, W, P), chief rays, arrive or were only vignetted, (F, W)."""
    if is_bent(lens):
        return unclipped(lens, fields.new_zeros(2, 1), fields, wavelengths)[..., 0]
    on_axis = (fields == 0).all(0)[:, None]
    return (rays.valid | keeps_coordinates(rays.direction))[..., 0] | on_axis


@torch.no_grad()
def unclipped(lens: Lens, pupil: Tensor, fields: Tensor, wavelengths: Tensor) -> Tensor:
    """Which rays (F, W, P) of pupil points (2, P) reach the sensor, or would if nothing clipped any."""
    return image_rays(without_apertures(lens), pupil, fields=fields, wavelengths=wavelengths).valid


def chief_reference(lens: Lens, fields: Tensor) -> Tensor:
    """Where the primary wavelength's chief rays of fields (2, F) meet the sensor, (2, F, 1) mm; nan where none does."""
    points, valid = chief_points(lens, fields, lens.primary[None])
    return torch.where(valid, points, torch.nan)


def keeps_coordinates(direction: Tensor) -> Tensor:
    """Whether rays keep their coordinates, if the axis is straight: one that missed a surface has become axial."""
    return (direction[:2] != 0).any(0)
