"""Geometry: surfaces and gaps of a lens that cannot be made.

A surface whose conic closes before its semi-diameter h, |c| h √(1+k) ≥ 1; a negative gap, or surfaces that cross,
between two surfaces that refract, reflect or diffract, along the light; glass whose edge thickness is negative.

The edge of glass is at the rim that both of its faces reach, the larger of their clear heights with their chip zones;
that of air is at the smaller of the rims of the two elements (`rims`). There the thickness is t + z′ - z
(`edge_thickness`), for checks, boundaries of merit functions and training. OpticStudio takes z and z′ each at the clear
height of its own surface, and both at that of the first one in a solve: operands and solves of files do so.
Flats between the chip zone and the mechanical semi-diameter change no edge.

Frames: position and rotation of every surface in the axes that rays start in.
"""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import Number, detached, dot_2, safe_sqrt, value
from raytrace.system import elements
from raytrace.system.configurations import taken, with_operands
from raytrace.system.expansion import expanded, in_contact
from raytrace.system.lens import Lens, media, per_lens, temperature_of
from raytrace.system.optimization_data import OptimizationData, Solve
from raytrace.system.poses import Pose, direction_out, point_out
from raytrace.system.shapes import KINDS
from raytrace.system.surface import Surface, sag_at
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import lens_steps, without_apertures
from raytrace.words import RaytraceWarning, calling_level

#: Points of the rim of the pupil at equal angles from +y, the ends of both diameters among them.
RIM_POINTS = tuple((round(math.sin(math.pi * k / 6), 15), round(math.cos(math.pi * k / 6), 15)) for k in range(12))

_SIZE = "semi_diameter"
_SAME = 1e-6  # of a stored automatic semi-diameter: a smaller difference leaves its digits
_HEIGHTS = 65  # at which two surfaces are compared
_LEAST = 1e-6  # mm: an overlap that counts


def _between(around: int) -> np.ndarray:
    """Weights (A, 12) of a function at the points RIM_POINTS, for its trigonometric interpolation at A equal angles."""
    count = len(RIM_POINTS)
    waves = np.arange(count // 2 + 1)
    weights = np.where((waves == 0) | (waves == count // 2), 1.0, 2.0) / count
    angles, points = (2 * np.pi * np.arange(n) / n for n in (around, count))
    return np.cos((angles[:, None] - points)[..., None] * waves) @ weights


#: Between the points the square of a height is interpolated; the largest one is right to 6e-5 in the shipped lenses.
BETWEEN = _between(180)
#: The interpolation counts where it exceeds all points by more than this share.
FARTHER = 1e-7


class Unbuildable(RaytraceWarning):
    """A lens that cannot be made as its numbers say."""


@dataclasses.dataclass(frozen=True)
class Defect:
    """Part of a lens that cannot be made. surface: its number; kind: reach, gap, crossing or edge; amount: mm."""

    surface: int
    kind: str
    amount: float
    words: str

    def __str__(self) -> str:
        return self.words

    def document(self) -> dict:
        return {"surface": self.surface, "kind": self.kind, "amount": self.amount, "words": self.words}


@torch.no_grad()
def defects(lens: Lens) -> tuple[Defect, ...]:
    """Everything of a lens, in its configuration, that cannot be made."""
    lens = detached(lens)
    heights, result = polished_semi_diameters(lens), []
    for k, (surface, height) in enumerate(zip(lens.surfaces, heights, strict=True)):
        edge = math.inf if k == 0 or surface.is_break else _edge_radius(surface)
        if math.isfinite(edge) and height >= edge:
            words = (
                f"surface {k} does not reach its semi-diameter of {height:.6g} mm: it closes at {edge:.6g} mm "
                f"(|c| h √(1+k) = {height / edge:.4g}, less than 1 can be made)"
            )
            result.append(Defect(k, "reach", height - edge, words))
    spaces, is_glass = gaps(lens), np.array([abs(float(index)) > 1.01 for index in media(lens, lens.primary)])
    ends = np.arange(len(heights))
    for k, end, _ in spaces:
        ends[k] = end
    each = rims(np.array(heights), ends, is_glass & (ends > np.arange(len(ends))))
    for k, end, side in spaces:
        medium, clear = ("glass", min(heights[k], heights[end])) if is_glass[k] else ("air", float(each[k]))
        result += _of_gap(lens, k, end, side, medium, clear, float(each[k]))
    return tuple(result)


def warn_of_defects(lens: Lens) -> tuple[Defect, ...]:
    """`defects`, each with a warning Unbuildable."""
    every = defects(lens)
    for defect in every:
        warnings.warn(defect.words, Unbuildable, stacklevel=calling_level())
    return every


def fixed_semi_diameters(lens: Lens) -> dict[int, float]:
    """mm, by surface, of the semi-diameters that are given; the others follow the rays."""
    data = lens.optimization_data
    given = range(len(lens.surfaces)) if data is None else (*data.semi_diameters, *_contacts(lens))
    return {k: float(size) for k in given if (size := lens.surfaces[k].semi_diameter)}


def _contacts(lens: Lens) -> list[int]:
    """Surfaces whose automatic semi-diameters operands of configurations hold still: those of `with_temperatures`."""
    data = lens.optimization_data
    if data is None or not lens.operands:
        return []
    held = {path.path[1] for operand in lens.operands for path in operand.paths if path.path[-1] == _SIZE}
    automatic = {rule.surface for rule in data.kept if rule.is_largest_size}
    return sorted(automatic.intersection(held).difference(data.semi_diameters))


def with_contacts(lens: Lens) -> Lens:
    """The lens with temperatures as configurations whose spacers have contact at the automatic semi-diameters of its
    rays in configuration 1; the others follow by expansion. Others keep theirs. See `Lens.with_temperatures`."""
    numbers = _contacts(lens)
    if not numbers or lens.count is not None:
        return lens
    given, current = lens, lens.current_configuration
    lens = detached(with_operands(lens, 1))
    is_held = [any(path.path[-1] == _SIZE and path.path[1] in numbers for path in row.paths) for row in lens.operands]
    others = tuple(row for row, held in zip(lens.operands, is_held, strict=True) if not held)
    sizes = clear_semi_diameters(dataclasses.replace(lens, operands=others), numbers)
    factors = {k: float(sizes[k]) / float(lens.surfaces[k].semi_diameter or math.nan) for k in numbers}
    factors = {k: factor for k, factor in factors.items() if math.isfinite(factor) and abs(factor - 1) > _SAME}
    operands = tuple(
        dataclasses.replace(
            row, words=tuple(tuple(factors.get(row.number, 1.0) * size for size in sizes) for sizes in row.words)
        )
        if held and row.number in factors
        else row
        for row, held in zip(lens.operands, is_held, strict=True)
    )
    if not factors:
        return given
    lens = with_operands(dataclasses.replace(lens, operands=operands), current)
    return with_thermal_numbers(lens, lens.optimization_data.solves if lens.optimization_data else ())


def with_thermal_numbers(lens: Lens, solves: Sequence[Solve]) -> Lens:
    """The lens whose numbers with thermal pickups are those of their source, expanded."""
    rules = [rule for rule in solves if rule.kind == "thermal"]
    operands = list(lens.operands)
    for source, configuration in dict.fromkeys((rule.source, rule.configuration) for rule in rules):
        start, here = (with_operands(lens, number) for number in (source, configuration))
        warmer = temperature_of(here) - temperature_of(start)
        heights = contact_heights(start, in_contact(start.surfaces))
        warm = dataclasses.replace(start, surfaces=expanded(start.surfaces, warmer, heights))
        for rule in rules:
            if (rule.source, rule.configuration) == (source, configuration) and rule.operand is not None:
                operands[rule.operand] = taken(operands[rule.operand], warm, configuration - 1)
    lens = dataclasses.replace(lens, operands=tuple(operands))
    return with_operands(lens, lens.current_configuration) if rules else lens


def semi_diameter_margin(lens: Lens, k: int) -> tuple[float, float]:
    """Factor a and length c mm of the semi-diameter a h + c of a surface that rays reach up to a height h.

    `OptimizationData` has them; the stop and the image have no margin.
    """
    if lens.optimization_data is None or k in (lens.stop, len(lens.surfaces) - 1):
        return 1.0, 0.0
    percent, length = lens.optimization_data.semi_diameter_margin
    return 1 + percent / 100, length


def semi_diameters(lens: Lens) -> list[float]:
    """Clear semi-diameters in mm of every surface, as a lens is printed, drawn and written; nan: unknown.

    The fixed ones as stored; an automatic one is the largest of all configurations, but for those that a .zmx file has
    stored as automatic: they are of the current configuration, as in OpticStudio. No automatic one clips a ray; a
    coordinate break has none.
    """
    lens = detached(lens)
    numbers, fixed = range(1, len(lens.surfaces)), fixed_semi_diameters(lens)
    with torch.no_grad():
        sizes = clear_semi_diameters(lens, numbers)
        if shared := [k for k in numbers if k not in fixed and _is_of_all_configurations(lens, k)]:
            for state in lens.configurations if lens.operands else ():
                for k, size in clear_semi_diameters(state, shared).items():
                    sizes[k] = torch.fmax(sizes[k], size)
    automatic = {k: math.nan if lens.surfaces[k].is_break else float(size) for k, size in sizes.items()}
    return [fixed.get(k, automatic.get(k, math.nan)) for k in range(len(lens.surfaces))]


def polished_semi_diameters(lens: Lens, clear: Sequence[float] | None = None) -> list[float]:
    """mm of every surface, up to which it follows its sag: `semi_diameters`, or those given, and the chip zones."""
    return elements.polished_semi_diameters(lens, semi_diameters(lens) if clear is None else clear)


def mechanical_semi_diameters(lens: Lens, clear: Sequence[float] | None = None) -> list[float]:
    """mm of the part at every surface, as a lens is printed, drawn and written; nan: unknown.

    Fixed ones as stored; the others are the largest of `polished_semi_diameters` and fixed ones of the element, or of
    the cemented group, as in OpticStudio. clear: `semi_diameters`, where they are known.
    """
    return elements.mechanical_semi_diameters(lens, semi_diameters(lens) if clear is None else clear)


def _is_of_all_configurations(lens: Lens, k: int) -> bool:
    """Whether an automatic semi-diameter is the largest of all configurations: by its rule, or as none is stored."""
    data = lens.optimization_data
    rules = () if data is None else data.kept
    is_maximum = any(rule.surface == k and rule.is_largest_size for rule in rules)
    return is_maximum or not lens.surfaces[k].semi_diameter


def with_semi_diameters(
    lens: Lens, *, fixed: Sequence[int] | None = None, margin: tuple[float, float] | None = None
) -> Lens:
    """As `Lens.with_semi_diameters`."""
    lens = with_contacts(lens)
    data = lens.optimization_data or OptimizationData(semi_diameters=tuple(fixed_semi_diameters(lens)))
    if margin is not None:
        if len(margin) != 2 or not all(math.isfinite(part) and part >= 0 for part in margin):
            raise ValueError(f"margin {margin}: expected per cent and mm, both 0 or more, as (2, 0.5)")
        data = dataclasses.replace(data, semi_diameter_margin=(float(margin[0]), float(margin[1])))
    if fixed is not None:
        if not all(0 < k < len(lens.surfaces) for k in fixed):
            raise ValueError(f"fixed semi-diameters of surfaces {list(fixed)}: expected 1 to {len(lens.surfaces) - 1}")
        given = tuple(k for k in data.semi_diameters if k in fixed)  # the others of `fixed` are stored first
        data = dataclasses.replace(data, semi_diameters=given)
    if fixed is not None or margin is not None:
        lens = dataclasses.replace(lens, optimization_data=data)
    return lens if lens.count is not None else _stored(lens, data, fixed)


def with_missing_semi_diameters(lens: Lens) -> Lens:
    """The lens with a semi-diameter of the rays, automatic, at every surface that stores none; as a file has it."""
    missing = [k for k, surface in enumerate(lens.surfaces) if k and not surface.is_break and not surface.semi_diameter]
    if lens.count is not None or not missing:
        return lens
    data = lens.optimization_data or OptimizationData(semi_diameters=tuple(fixed_semi_diameters(lens)))
    return _stored(lens, data, None, missing)


def _stored(
    lens: Lens, data: OptimizationData, fixed: Sequence[int] | None, numbers: Sequence[int] | None = None
) -> Lens:
    """The lens with its clear semi-diameters stored, by default of all surfaces; `fixed`: as there."""
    set_by_others = {
        scaled.path[1] for operand in lens.operands for scaled in operand.paths if scaled.path[-1] == _SIZE
    }
    set_by_others |= {rule.surface for rule in data.kept if rule.quantity == _SIZE and not rule.is_largest_size}
    set_by_others |= {lens.stop} if lens.aperture.kind == "float_by_stop" else set()
    surfaces, rules = list(lens.surfaces), []
    for k, size in enumerate(semi_diameters(lens)):
        stored = surfaces[k].semi_diameter
        is_given = k in data.semi_diameters or k in set_by_others or surfaces[k].sag_terms is not None
        is_left = numbers is not None and k not in numbers
        if is_given or is_left or not size > 0 or (stored and abs(size - stored) < _SAME * stored):
            continue
        surfaces[k] = dataclasses.replace(surfaces[k], semi_diameter=size)
        if lens.operands and not stored:
            rules.append(Solve(k, _SIZE, "maximum"))
    if fixed is None and all(new is old for new, old in zip(surfaces, lens.surfaces, strict=True)):
        return lens
    kept = tuple(sorted((*data.kept, *rules), key=lambda rule: rule.surface))
    data = dataclasses.replace(data, kept=kept, semi_diameters=tuple(sorted(fixed or data.semi_diameters)))
    return dataclasses.replace(lens, surfaces=tuple(surfaces), optimization_data=data)


def clear_semi_diameters(lens: Lens, numbers: Sequence[int]) -> dict[int, Tensor]:
    """mm () of some surfaces from 1, in the current configuration, with derivatives; of a batch of lenses (L,).

    As stored where it is fixed or where no ray arrives, else a h + c: h is the largest height of the rays through the
    rim of the pupil, of all fields and wavelengths, and a and c are the margin. nan: unknown.
    """
    sizes = {k: lens.wavelengths.new_tensor(size) for k, size in fixed_semi_diameters(lens).items()}
    automatic = [k for k in numbers if k not in sizes]
    try:
        reaches = _reaches(lens, max(automatic)) if automatic else []
    except (ValueError, RuntimeError):
        reaches = []
    for k in automatic:
        factor, length = semi_diameter_margin(lens, k)
        stored = lens.wavelengths.new_tensor(lens.surfaces[k].semi_diameter or math.nan)
        reach = factor * reaches[k - 1] + length if reaches else stored
        sizes[k] = torch.where(torch.isfinite(reach), reach, stored)
    return {k: sizes[k] for k in numbers}


def semi_diameter(lens: Lens, k: int) -> Tensor:
    """mm () of surface k, as of `clear_semi_diameters`; of a batch of lenses (L, 1, 1, 1)."""
    return per_lens(clear_semi_diameters(lens, [k])[k])


def contact_heights(lens: Lens, numbers: Sequence[int]) -> dict[int, Tensor]:
    """mm () of some surfaces, as of `clear_semi_diameters`; 0, contact on the axis, where it is unknown."""
    return {k: torch.where(torch.isfinite(h), h, 0.0) for k, h in clear_semi_diameters(lens, numbers).items()}


@torch.no_grad()
def light_diameter(lens: Lens, numbers: Sequence[int]) -> float:
    """mm, the largest of the rays on some surfaces from 1, in all configurations, whatever semi-diameters are fixed."""
    reaches = [_reaches(view, max(numbers))[k - 1] for view in lens.configurations for k in numbers]
    return 2 * max(float(reach) for reach in reaches if reach == reach)


def _reaches(lens: Lens, last: int) -> list[Tensor]:
    """Largest √(x² + y²) mm () of the rays of the rim on the surfaces 1 to `last`; nan where none arrives.

    No aperture clips these rays. Where all twelve of a field and a wavelength arrive, the square of their height is
    interpolated between them. OpticStudio takes those at the ends of both diameters alone.
    """
    lens = without_apertures(lens)
    points = lens.wavelengths.new_tensor(RIM_POINTS, dtype=torch.float64).T
    between = points.new_tensor(BETWEEN.T)
    rays, reaches = launch(lens, points, wavelengths=lens.wavelengths), []
    for crossing in islice(lens_steps(lens, rays, lens.wavelengths[:, None]), last):
        position, valid = crossing.rays.position, crossing.rays.valid
        squares = torch.where(valid, dot_2(position, position), -1.0)
        farthest, around = squares.amax(-1), (squares @ between.to(squares.dtype)).amax(-1)
        counts = valid.all(-1) & (around > (1 + FARTHER) * farthest)
        farthest = torch.where(counts, around, farthest).amax((-2, -1))
        reaches.append(torch.where(farthest < 0, torch.nan, safe_sqrt(farthest)))
    return reaches


def rims(heights: Number, ends: np.ndarray, is_glass: np.ndarray) -> Number:
    """mm (S,), of the edge of the gap behind every surface: of glass the larger of the clear heights of its two faces,
    of air the smaller of the rims of the elements on both sides; a surface in air is its own rim.

    heights: (S,) mm, clear heights of the surfaces, plain or dual; ends: (S,) the surface that ends each gap.
    """
    of_glass = np.maximum(heights, heights[ends])
    start = np.arange(len(ends))
    start[ends[is_glass]] = np.flatnonzero(is_glass)  # the front face of the glass in front of a surface
    front = np.where(is_glass[start] & (start != np.arange(len(ends))), of_glass[start], heights)
    of_element = np.maximum(front, np.where(is_glass, of_glass, heights))
    return np.where(is_glass, of_glass, np.minimum(of_element, of_element[ends]))


def edge_thickness(thickness: Number, front: Number, back: Number) -> Number:
    """mm between two surfaces where their sags are `front` and `back`; of any number type."""
    return thickness + (back - front)


def edge_radius(surface: Surface) -> float:
    """Largest radius in mm at which the conic of a surface exists: 1/(|c| √(1+k)) where it closes, else inf.

    Of a toroid or a biconic it is that of the section along y.
    """
    curvature = 0.0 if surface.curvature is None else abs(float(surface.curvature))
    shape = 1.0 if surface.conic is None else 1 + float(surface.conic)
    return 1 / (curvature * math.sqrt(shape)) if curvature > 0 and shape > 0 else math.inf


def _edge_radius(surface: Surface) -> float:
    """mm at which a surface closes, along x or along y; inf where it does not."""
    form, a = KINDS[surface.kind].form, surface.coefficients
    if form is None or a is None:
        return edge_radius(surface)
    a = a.double()
    c, k = (a.new_zeros(()) if number is None else number.double() for number in (surface.curvature, surface.conic))
    far = a.new_tensor(1e9)
    ends = form.extent(c, k, a, far)
    return min(float(end) if end < far else math.inf for end in ends)


def gaps(lens: Lens, *, to_image: bool = False) -> list[tuple[int, int, float]]:
    """Powered surfaces that follow one another on one axis, and the direction of the light along z between them.

    to_image: also the last of them and the image, if they are on one axis.
    """
    indices = media(lens, lens.primary)
    pairs, before, side = [], None, 1.0
    for k, surface in enumerate(lens.surfaces[1:-1], 1):
        if surface.is_break or surface.before is not None:
            before = None
        if surface.is_mirror or surface.phase is not None or not torch.equal(indices[k], indices[k - 1]):
            if before is not None:
                pairs.append((before, k, side))
            before = k
        side = -side if surface.is_mirror else side
        if surface.after is not None:
            before = None
    if to_image and before is not None:
        pairs.append((before, len(lens.surfaces) - 1, side))
    return pairs


def _of_gap(lens: Lens, k: int, end: int, side: float, medium: str, clear: float, rim: float) -> list[Defect]:
    """The defects of the gap between two surfaces; clear, rim: mm, up to where light passes and where its edge is."""
    front, back = lens.surfaces[k], lens.surfaces[end]
    gap = side * sum(float(surface.thickness) for surface in lens.surfaces[k:end])
    if gap < -_LEAST:
        return [Defect(k, "gap", gap, f"the {medium} between surfaces {k} and {end} is {gap:.6g} mm thick: negative")]
    if math.isnan(rim) or not math.isfinite(gap):
        return []
    for x, y in ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)):
        r = torch.linspace(0.0, rim, _HEIGHTS, dtype=torch.float64, device="cpu")
        left = edge_thickness(gap, side * _sag(front, x * r, y * r), side * _sag(back, x * r, y * r))
        within = left[r <= clear]
        if within.min() < -_LEAST:
            height, least = float(r[left < 0][0]), float(within.min())
            where = f"surfaces {k} and {end} cross {height:.4g} mm from the axis"
            words = f"{where}: {medium} of {least:.4g} mm within the edge"
            return [Defect(k, "crossing", least, words)]
        if left[-1] < -_LEAST:
            edge = float(left[-1])
            words = f"the glass between surfaces {k} and {end} is {edge:.4g} mm thick at its edge: negative"
            return [Defect(k, "edge", edge, words)]
    return []


def _sag(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """The sag, beyond where the surface closes that of its edge."""
    edge = 0.999999 * _edge_radius(surface)
    r = torch.hypot(x, y)
    held = torch.where(r > edge, edge / torch.where(r > edge, r, 1.0), 1.0) if math.isfinite(edge) else 1.0
    return sag_at(surface, held * x, held * y)


@value
class Frame:
    """The axes of a surface: its vertex (3,) mm, and by columns (3, 3) the directions of its x, y and z."""

    origin: Tensor
    axes: Tensor

    def outside(self, point: Tensor) -> Tensor:
        """A point (3, ...) mm of the surface in the axes that rays start in."""
        return self.along(point) + self.origin.reshape(3, *(1,) * (point.dim() - 1))

    def along(self, direction: Tensor) -> Tensor:
        """A direction (3, ...) in the axes that rays start in."""
        return torch.tensordot(self.axes, direction, dims=1)

    def inside(self, point: Tensor) -> Tensor:
        """A point (3, ...) mm in the axes of the surface."""
        moved = point - self.origin.reshape(3, *(1,) * (point.dim() - 1))
        return torch.tensordot(self.axes.T, moved, dims=1)


def frames(lens: Lens) -> list[Frame]:
    """The frame of every surface after its pose, in that of surface 1 before its own; the object's may be at -inf."""
    distance = lens.surfaces[0].thickness
    axes = torch.eye(3, dtype=distance.dtype, device=distance.device)
    here = Frame(torch.zeros_like(axes[0]), axes)
    result = [_posed(Frame(-distance * axes[2], axes), lens.surfaces[0].before)]
    for surface in lens.surfaces[1:]:
        here = _posed(here, surface.before)
        result.append(here)
        here = _posed(here, surface.after)
        here = Frame(here.origin + surface.thickness * here.axes[:, 2], here.axes)
    return result


def _posed(frame: Frame, pose: Pose | None) -> Frame:
    if pose is None:
        return frame
    axes = torch.eye(3, dtype=frame.axes.dtype, device=frame.axes.device)
    zero = list(torch.zeros_like(axes[0]))
    vertex = torch.stack(list(point_out(pose, zero)))
    turned = torch.stack([torch.stack(list(direction_out(pose, list(axis)))) for axis in axes], 1)
    return Frame(frame.outside(vertex), frame.axes @ turned)
