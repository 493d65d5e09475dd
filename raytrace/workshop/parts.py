"""Parts of a lens as solids of revolution: profiles of elements and mirrors, their diameters, chamfers and volumes.

A profile is a closed line in the half plane (z, r) of a part, of mm from the vertex of its first surface in the
direction of the light. Spheres, planes and cones are exact; other sags become B-splines, whose deviation is known.
A face follows its sag up to its clear semi-diameter and chip zone; beyond, a convex conic and a cemented face follow it
to the edge of the part, other faces are flat, as all faces in air of a part of fixed mechanical semi-diameter are.
Clear diameters, and mechanical ones that are not fixed, are rounded up to `DIAMETER_STEP`, in drawings and solids.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import BSpline, make_interp_spline

from raytrace.analysis.cross_section import continuations, depth, sides
from raytrace.materials.glass import Glass
from raytrace.maths.numerics import detached
from raytrace.maths.sampling import gauss_legendre
from raytrace.system.apertures import Aperture, reach
from raytrace.system.elements import cemented_groups, lens_elements
from raytrace.system.lens import Lens
from raytrace.system.surface import Surface, is_round
from raytrace.tracing.geometry import (
    edge_radius,
    mechanical_semi_diameters,
    polished_semi_diameters,
    semi_diameters,
)
from raytrace.words import RaytraceError, option

#: Largest deviation in mm of the B-spline of a sag: 1 nm.
DEVIATION = 1e-6

#: mm of clear and mechanical diameters, a tenth of it below 1 mm.
DIAMETER_STEP = 0.01

_NODES = 200  # of the volume, between two corners of a profile
_DEGREE, _MOST_INTERVALS, _CHECKED = 5, 1024, 4001


class NoSolid(RaytraceError, ValueError):
    """An element that is no solid of revolution, or whose numbers leave no glass."""


class Segment(NamedTuple):
    """A part of a profile from `start` to `end`, (z, r) mm; face: whose sag it follows, None: a straight line."""

    start: tuple[float, float]
    end: tuple[float, float]
    face: "Face | None" = None

    def points(self, count: int = 121) -> np.ndarray:
        """(2, N) mm along the segment."""
        if self.face is None:
            return np.array([self.start, self.end]).T
        r = np.linspace(self.start[1], self.end[1], count)
        return np.stack([self.face.z(r), r])

    def spline(self) -> tuple[BSpline, float]:
        """z(r) as a B-spline of degree 5, r rising, and its largest deviation in mm. Raises NoSolid."""
        assert self.face is not None
        low, high = sorted((self.start[1], self.end[1]))
        dense, intervals = np.linspace(low, high, _CHECKED), 16
        exact = self.face.z(dense)
        while True:
            r = low + (high - low) * 0.5 * (1 - np.cos(np.linspace(0, math.pi, intervals + 1)))
            curve = make_interp_spline(r, self.face.z(r), k=_DEGREE)
            deviation = float(np.abs(curve(dense) - exact).max())
            if deviation <= DEVIATION:
                return curve, deviation
            intervals *= 2
            if intervals > _MOST_INTERVALS:
                raise NoSolid(
                    f"surface {self.face.number}: the B-spline of its sag deviates by {1e6 * deviation:.3g} nm, "
                    f"expected {1e6 * DEVIATION:g} nm: its terms oscillate within {high:.4g} mm"
                )


@dataclasses.dataclass(frozen=True, eq=False)
class Face:
    """A face of a part: a surface of a lens, seen along the light.

    number: of the surface; vertex: z mm; side: 1, or -1 where the z axis of the surface runs against the light.
    clear: clear semi-diameter, mm; reach: radius up to which it follows its sag, mm; is_cemented: to the next part.
    """

    number: int
    surface: Surface
    vertex: float
    side: int
    clear: float
    reach: float = math.inf
    is_cemented: bool = False

    @property
    def curvature(self) -> float:
        """1/mm, positive where the centre of curvature is behind the face along the light."""
        return 0.0 if self.surface.curvature is None else self.side * float(self.surface.curvature)

    @property
    def is_sphere(self) -> bool:
        """Whether the sag is a sphere or a plane."""
        surface = self.surface
        plain = surface.coefficients is None and surface.sag_terms is None
        return plain and (surface.conic is None or float(surface.conic) == 0 or self.curvature == 0)

    @property
    def is_plane(self) -> bool:
        return self.is_sphere and self.curvature == 0

    def z(self, r: np.ndarray) -> np.ndarray:
        """z (...) mm at radii (...) mm: the sag up to `reach`, flat beyond."""
        return self.vertex + self.side * depth(self.surface, np.minimum(r, self.reach))


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """An element of a lens.

    name: "1", "2", … in the order of the light; surfaces: first and last of the element; faces: front and back, the
    back of a mirror is the rear of its substrate; glass: of an element, of a mirror MIRROR; thickness: mm at centre;
    rim: mechanical semi-diameter, mm; chamfer: mm of both legs at each edge in air; hole: radius in mm of a mirror's.
    cuts: decentred or rectangular apertures, which cut a mirror; objection: why it is no solid of revolution, or "".
    """

    name: str
    surfaces: tuple[int, int]
    faces: tuple[Face, ...]
    glass: Glass
    thickness: float
    rim: float
    chamfer: float = 0.0
    hole: float = 0.0
    cuts: tuple[Aperture, ...] = ()
    objection: str = ""

    @property
    def is_mirror(self) -> bool:
        return self.glass.formula == "mirror"

    @property
    def chamfers(self) -> tuple[float, float]:
        """mm of the front and the back edge; a cemented edge and the rear of a mirror have none."""
        front, back = (0.0 if face.is_cemented else self.chamfer for face in self.faces)
        return front, 0.0 if self.is_mirror else back

    def ends(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z (...) mm of the front and the back at radii (...) mm, with chamfers."""
        cut = (1, -1)
        front, back = (
            face.z(np.minimum(r, self.rim - chamfer)) + sign * np.maximum(r - (self.rim - chamfer), 0.0)
            for face, chamfer, sign in zip(self.faces, self.chamfers, cut, strict=True)
        )
        return front, back

    @property
    def edge(self) -> float:
        """Length of the cylinder at the rim, mm."""
        front, back = self.ends(np.array([self.rim]))
        return float(back[0] - front[0])

    def profile(self) -> list[Segment]:
        """The closed line from the front vertex over the rim to the back vertex, the axis or hole last."""
        (front, back), rim, hole = self.faces, self.rim, self.hole
        way = [*_along(front, hole, rim, self.chamfers[0], 1)]
        rear = [Segment(s.end, s.start, s.face) for s in reversed(_along(back, hole, rim, self.chamfers[1], -1))]
        way += [Segment(way[-1].end, rear[0].start), *rear]
        return [*way, Segment(way[-1].end, way[0].start)]

    @property
    def volume(self) -> float:
        """2π ∫ r (z_back - z_front) dr in mm³; nan of a mirror that is cut."""
        if self.cuts:
            return math.nan
        corners = {self.hole, self.rim, *(self.rim - c for c in self.chamfers), *(f.reach for f in self.faces)}
        limits = sorted(corner for corner in corners if self.hole <= corner <= self.rim)
        nodes, weights = gauss_legendre(_NODES)
        total = 0.0
        for low, high in itertools.pairwise(limits):
            r = 0.5 * (high + low) + 0.5 * (high - low) * nodes
            front, back = self.ends(r)
            total += math.pi * (high - low) * float(weights @ (r * (back - front)))
        return total


def _along(face: Face, hole: float, rim: float, chamfer: float, sign: int) -> list[Segment]:
    """The segments of a face from the hole or the axis outwards: sag, flat, chamfer."""
    top = rim - chamfer
    radii = [hole, *([face.reach] if hole < face.reach < top else []), top]
    z = face.z(np.array(radii)).tolist()
    corners = list(zip(z, radii, strict=True))
    result = [
        Segment(a, b, None if face.is_plane or a[1] >= face.reach else face) for a, b in itertools.pairwise(corners)
    ]
    if chamfer:
        result.append(Segment(corners[-1], (corners[-1][0] + sign * chamfer, rim)))
    return result


def _outward(semi_diameter: float, limit: float = math.inf) -> float:
    """mm, half the diameter rounded up to its step; as it is where that exceeds a limit."""
    step = 0.5 * (DIAMETER_STEP if semi_diameter >= 0.5 else 0.1 * DIAMETER_STEP)
    if not math.isfinite(semi_diameter):
        return semi_diameter
    rounded = round(math.ceil(semi_diameter / step - 1e-6) * step, 9)
    return rounded if rounded <= limit else semi_diameter


def _clear(lens: Lens) -> list[float]:
    """mm, the clear semi-diameters of the drawings, within the surface and a fixed mechanical one."""
    return [
        _outward(size, min(surface.mechanical_semi_diameter or math.inf, 0.9999 * edge_radius(surface)))
        for size, surface in zip(semi_diameters(lens), lens.surfaces, strict=True)
    ]


@torch.no_grad()
def parts_of(lens: Lens, *, margin: float = 0.0, chamfer: float = 0.0, substrate: float | None = None) -> list[Part]:
    """The elements and mirrors of a lens.

    Their diameters are those of `mechanical_semi_diameters`. margin: mm added to each that is not fixed on a surface of
    the element or its cemented group; chamfer: mm of both legs; substrate: thickness in mm of mirrors, by default a
    sixth of their diameter. Raises NoSolid for margins and chamfers that do not fit.
    """
    lens = detached(lens)
    clear, elements, direction = _clear(lens), lens_elements(lens), sides(lens)
    groups = cemented_groups(lens)
    polished, widths = polished_semi_diameters(lens, clear), mechanical_semi_diameters(lens, clear)
    result = []
    for number, (first, last) in enumerate(elements, 1):
        name, side = str(number), direction[first]
        mirrors = [k for k in range(first, last + 1) if lens.surfaces[k].is_mirror]
        back = mirrors[0] if mirrors else last
        if objection := _objection(lens, first, back, mirrors, clear):
            glass = lens.surfaces[first].glass
            result.append(Part(name, (first, last), (), glass, math.nan, math.nan, objection=objection))
        elif first == last:
            fixed = lens.surfaces[first].mechanical_semi_diameter
            width = fixed or _outward(widths[first] + margin)
            result.append(_mirror(lens, name, first, side, clear[first], width, substrate))
        else:
            whole = next(((a, b) for a, b in groups if a <= first and back <= b), (first, back))
            fixed_sizes = [surface.mechanical_semi_diameter for surface in lens.surfaces[whole[0] : whole[1] + 1]]
            rim, is_fixed = max(widths[first], widths[back]), any(fixed_sizes)
            rim = rim if rim in fixed_sizes else _outward(rim + (0.0 if is_fixed else margin))
            for k in (first, back):
                if rim < clear[k]:
                    raise NoSolid(
                        f"element {name}: its mechanical semi-diameter of {rim:.6g} mm is smaller than the clear one "
                        f"of surface {k}, {clear[k]:.6g} mm; expected at least as much"
                    )
            sizes = [(clear[k], min(polished[k], rim)) for k in (first, back)]
            cemented = tuple(any(a < k < b for a, b in groups) for k in (first, back))
            result.append(_element(lens, name, (first, last, back), side, sizes, rim, is_fixed, cemented, chamfer))
    return result


def _objection(lens: Lens, first: int, back: int, mirrors: list[int], clear: list[float]) -> str:
    inside = lens.surfaces[first : back + 1]
    if len(mirrors) > 1:
        return "a prism or a folded element"
    if first == back and not mirrors:
        return "a thin structure, without glass"
    if any(surface.is_break for surface in inside) or any(
        a.after is not None or b.before is not None for a, b in itertools.pairwise(inside)
    ):
        return "its faces are tilted or decentred to each other"
    for k in (first, back):
        if not is_round(lens.surfaces[k]) or (lens.surfaces[k].phase is not None and not mirrors):
            return f"surface {k} is not rotationally symmetric, or has a phase"
        if not clear[k] > 0 or not math.isfinite(clear[k]):
            return f"surface {k} has no semi-diameter, and no ray reaches it"
    return ""


def _element(
    lens: Lens,
    name: str,
    surfaces: tuple[int, int, int],
    side: int,
    sizes: Sequence[tuple[float, float]],
    rim: float,
    is_fixed: bool,
    cemented: tuple[bool, ...],
    chamfer: float,
) -> Part:
    first, last, back = surfaces
    thickness = side * float(sum(surface.thickness for surface in lens.surfaces[first:back]))
    faces = [
        Face(k, lens.surfaces[k], vertex, side, size, is_cemented=joined)
        for k, vertex, (size, _), joined in zip((first, back), (0.0, thickness), sizes, cemented, strict=True)
    ]
    # A convex conic is polished to the edge; a concave face and an asphere end with a flat.
    further = tuple(
        face.is_cemented
        or (face.surface.coefficients is None and face.surface.sag_terms is None and convex >= 0 and not is_fixed)
        for face, convex in zip(faces, (faces[0].curvature, -faces[1].curvature), strict=True)
    )
    pair = (faces[0].surface, faces[1].surface)
    edges = [0.9999 * edge_radius(surface) for surface in pair]
    radii = [min(polished, edge) for (_, polished), edge in zip(sizes, edges, strict=True)]
    r, part = np.linspace(0, rim, 257), None
    for ends in continuations(pair, radii, rim, (further[0], further[1])):
        reached = (dataclasses.replace(f, reach=min(e, m)) for f, e, m in zip(faces, ends, edges, strict=True))
        part = Part(name, (first, last), tuple(reached), lens.surfaces[first].glass, thickness, rim, chamfer)
        front, behind = part.ends(r)
        if (behind - front).min() >= 0 and part.edge > 0:
            return part
    raise NoSolid(
        f"element {name} (surfaces {first}-{last}): no glass is left at its rim of {rim:.4g} mm; expected a positive "
        f"edge: make it thicker, or {option('margin')} and {option('chamfer')} smaller"
    )


def _mirror(lens: Lens, name: str, k: int, side: int, clear: float, width: float, substrate: float | None) -> Part:
    """A mirror on a substrate with a plane rear, whose least thickness is `substrate`; width: its rim, mm."""
    surface, rim = lens.surfaces[k], min(width, 0.9999 * edge_radius(lens.surfaces[k]))
    thickness = 2 * rim / 6 if substrate is None else substrate
    front = Face(k, surface, 0.0, side, clear, reach=rim)
    rise = max(0.0, float(front.z(np.array([rim]))[0]))
    rear = Face(k, Surface(surface.thickness), thickness + rise, 1, clear, reach=rim)
    holes = [float(reach(a)[0]) for a in surface.apertures if not a.obscures and a.shape == "circular"]
    hole = max(holes, default=0.0)
    cuts = tuple(
        a
        for a in surface.apertures
        if not a.obscures and (a.shape == "rectangular" or (a.shape == "circular" and any(map(float, a.centre))))
    )
    if cuts:
        hole = 0.0  # of the aperture, not of the whole mirror
    return Part(name, (k, k), (front, rear), surface.glass, thickness + rise, rim, hole=hole, cuts=cuts)
