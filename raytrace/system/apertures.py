"""Aperture: the part of a surface that passes light, with a row for every shape.

A shape is defined by its edges, each a measure of a point and its limit. A new shape is a row of SHAPES, and its lines
in tracing/cpp/apertures.h.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from raytrace.maths.numerics import Number, safe_sqrt, value

#: Sizes of a shape, mm: floats, or scalar tensors.
Sizes: TypeAlias = Sequence[Number]


@value
class Aperture:
    """The part of a surface that passes light; one surface may carry several, and a ray must pass all of them.

    shape: a key of SHAPES, "circular" (extent: inner and outer radius), "rectangular" or "elliptic" (half-widths in x
        and y), "polygon" (x, y of its corners; several, each closed by its first corner, are one shape).
    extent: the numbers of the shape, mm: floats, or scalar tensors, which derivatives may be taken by (`clear_pupil`).
    obscures: True if the shape blocks what lies inside it (an obscuration) instead of passing it.
    centre: (x, y) mm of the shape in the surface's frame.
    """

    shape: str
    extent: tuple[float | Tensor, ...]
    obscures: bool = False
    centre: tuple[float | Tensor, ...] = (0.0, 0.0)


class Edge(NamedTuple):
    """An edge of a shape: a point lies within it if its measure (...) is at most the limit; of an inner edge, at least.

    size: the unit of distances from the edge; by default the limit.
    """

    measure: Tensor
    limit: Number
    is_inner: bool = False
    size: Number | None = None

    def within(self) -> Tensor:
        """Whether points (...) lie within, the edge itself included."""
        return self.measure >= self.limit if self.is_inner else self.measure <= self.limit

    def strictly(self) -> Tensor:
        """Whether points (...) lie within, without the edge."""
        return self.measure > self.limit if self.is_inner else self.measure < self.limit

    def distance(self) -> Tensor:
        """The distance of points (...) from the edge, positive within, smooth at the edge, in units of `size`."""
        if self.size is not None:
            return (self.limit - self.measure) / self.size
        return self.measure / self.limit - 1 if self.is_inner else 1 - self.measure / self.limit


@dataclasses.dataclass(frozen=True)
class Shape:
    """A shape of apertures; its numbers are sizes in mm.

    edges: x, y (...) mm from its centre, and sizes -> its edges; reach: sizes -> range of |y| in the cross section;
    symmetry: "round", "mirror" (in x and y) or "none"; zemax: keywords of a .zmx file as aperture and obscuration;
    code: of tracing/cpp/apertures.h, None: clipped by torch alone; sizes: count of sizes, each at least 0, None: three
    or more points x, y; outlines: sizes -> closed lines x, y mm along its edges; is_hollow: sizes -> whether light may
    be blocked inside it.
    """

    edges: Callable[[Tensor, Tensor, Sizes], list[Edge]]
    reach: Callable[[Sizes], tuple[Number, Number]]
    symmetry: str
    zemax: tuple[str, str]
    code: int | None = None
    sizes: int | None = 2
    outlines: Callable[[Sizes], list[tuple[Tensor, Tensor]]] = lambda sizes: []
    is_hollow: Callable[[Sizes], bool] = lambda sizes: False

    def objection(self, sizes: Sizes) -> str:
        """Why a shape cannot have these sizes; "" if it can."""
        if self.sizes is None:
            return "" if len(sizes) >= 6 and len(sizes) % 2 == 0 else "has no points x, y, three or more"
        if len(sizes) != self.sizes:
            return f"has not {self.sizes} sizes"
        return "" if min(sizes) >= 0 else "has a negative size"


def _rings(x: Tensor, y: Tensor, sizes: Sizes) -> list[Edge]:
    square, (inner, outer) = x * x + y * y, sizes
    return [Edge(square, outer * outer), *([Edge(square, inner * inner, True)] if inner > 0 else [])]


def _outlines(sizes: Sizes) -> list[tuple[Number, Number, Number, Number]]:
    """The sides (x1, y1, x2, y2) of polygons; each is closed where its first point is repeated, the last one always."""
    points = list(zip(sizes[::2], sizes[1::2], strict=True))
    sides, first = [], 0
    for k in range(1, len(points)):
        if first == k:
            continue
        sides.append((*points[k - 1], *points[k]))
        first = k + 1 if points[k] == points[first] else first
    return sides if first >= len(points) else [*sides, (*points[-1], *points[first])]


def _polygons(x: Tensor, y: Tensor, sizes: Sizes) -> list[Edge]:
    """The signed distance from the nearest side; points within an odd number of polygons are inside."""
    nearest, odd = torch.full_like(x, float("inf")), torch.zeros_like(x, dtype=torch.bool)
    for x1, y1, x2, y2 in _outlines(sizes):
        along_x, along_y = x2 - x1, y2 - y1
        length = along_x * along_x + along_y * along_y
        share = (((x - x1) * along_x + (y - y1) * along_y) / (length or 1.0)).clamp(0, 1)
        off_x, off_y = x - x1 - share * along_x, y - y1 - share * along_y
        nearest = torch.minimum(nearest, off_x * off_x + off_y * off_y)
        if y1 != y2:
            odd = odd ^ (((y1 > y) != (y2 > y)) & (x < x1 + (y - y1) * (along_x / along_y)))
    distance = safe_sqrt(nearest)
    return [Edge(torch.where(odd, -distance, distance), 0.0, size=max(abs(size) for size in sizes))]


def _box(x: Tensor, y: Tensor, sizes: Sizes) -> list[Edge]:
    return [Edge(x.abs(), sizes[0]), Edge(y.abs(), sizes[1])]


def _reach_of_corners(sizes: Sizes) -> tuple[Number, Number]:
    return 0.0, max(abs(size) for size in sizes[1::2])


def _ellipse(x: Tensor, y: Tensor, sizes: Sizes) -> list[Edge]:
    return [Edge((x / sizes[0]) ** 2 + (y / sizes[1]) ** 2, 1.0)]


_AROUND = torch.linspace(0, 2 * torch.pi, 361, dtype=torch.float64)


def _round_lines(sizes: Sizes) -> list[tuple[Tensor, Tensor]]:
    return [(radius * torch.cos(_AROUND), radius * torch.sin(_AROUND)) for radius in sizes if radius > 0]


def _oval_lines(sizes: Sizes) -> list[tuple[Tensor, Tensor]]:
    return [(sizes[0] * torch.cos(_AROUND), sizes[1] * torch.sin(_AROUND))]


def _box_lines(sizes: Sizes) -> list[tuple[Tensor, Tensor]]:
    corners = torch.tensor([[1.0, -1, -1, 1, 1], [1, 1, -1, -1, 1]], dtype=torch.float64)
    return [(sizes[0] * corners[0], sizes[1] * corners[1])]


def _corner_lines(sizes: Sizes) -> list[tuple[Tensor, Tensor]]:
    sides = [torch.tensor([float(size) for size in side], dtype=torch.float64) for side in _outlines(sizes)]
    return [(side[::2], side[1::2]) for side in sides]


SHAPES = {
    "circular": Shape(
        _rings, lambda sizes: (sizes[0], sizes[1]), "round", ("CLAP", "OBSC"), 0, outlines=_round_lines,
        is_hollow=lambda sizes: sizes[0] > 0,
    ),
    "rectangular": Shape(_box, lambda sizes: (0.0, sizes[1]), "mirror", ("SQAP", "SQOB"), 1, outlines=_box_lines),
    "elliptic": Shape(_ellipse, lambda sizes: (0.0, sizes[1]), "mirror", ("ELAP", "ELOB"), 2, outlines=_oval_lines),
    "polygon": Shape(
        _polygons, _reach_of_corners, "none", ("USAP", "USOB"), 3, None, outlines=_corner_lines,
        is_hollow=lambda sizes: True,
    ),
}  # fmt: skip


def edges(aperture: Aperture, hit: Tensor | Sequence[Tensor]) -> list[Edge]:
    """The edges of an aperture, measured at points (2 or 3, ...) mm."""
    x, y = hit[0] - aperture.centre[0], hit[1] - aperture.centre[1]
    return SHAPES[aperture.shape].edges(x, y, aperture.extent)


def inside(apertures: Sequence[Aperture], hit: Tensor | Sequence[Tensor]) -> Tensor | None:
    """Whether points (...) pass all the apertures; None without apertures. An edge belongs to the clear side."""
    passed: Tensor | None = None
    for aperture in apertures:
        sides = [edge.strictly() if aperture.obscures else edge.within() for edge in edges(aperture, hit)]
        within = functools.reduce(operator.and_, sides)
        clear = ~within if aperture.obscures else within
        passed = clear if passed is None else passed & clear
    return passed


def clearance(aperture: Aperture, hit: Tensor) -> Tensor:
    """The distance of points (2, ...) from the edge of an aperture, above 0 where light passes, smooth at the edge."""
    return functools.reduce(torch.minimum, clearances_of(aperture, hit))


def clearances_of(aperture: Aperture, hit: Tensor) -> list[Tensor]:
    """`clearance` of every edge by itself, where light must pass all of them; of an obscuration that of all edges."""
    sides = [edge.distance() for edge in edges(aperture, hit)]
    if not aperture.obscures:
        return sides
    return [-functools.reduce(torch.minimum, sides)]


def reach(aperture: Aperture) -> tuple[Number, Number]:
    """The smallest and largest |y| of the shape from its centre, mm."""
    return SHAPES[aperture.shape].reach(aperture.extent)


def outlines(aperture: Aperture) -> list[tuple[Tensor, Tensor]]:
    """Closed lines x, y (N,) mm along the edges of an aperture, in the frame of its surface."""
    lines = SHAPES[aperture.shape].outlines([torch.as_tensor(size, dtype=torch.float64) for size in aperture.extent])
    return [(x + aperture.centre[0], y + aperture.centre[1]) for x, y in lines]


def stands_inside(aperture: Aperture) -> bool:
    """Whether an aperture can block light inside a beam whose rim it passes."""
    return aperture.obscures or SHAPES[aperture.shape].is_hollow(aperture.extent)
