"""The geometry of a cross section: surfaces and rays in a plane, in one frame.

z counts from the vertex of surface 1, in mm, to the right; upward goes y, or x in the view from above. Nothing here
draws.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.plotting.style import array
from raytrace.system.apertures import reach
from raytrace.system.intersection import intersect
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface, is_posed, sag_at
from raytrace.tracing.geometry import Frame, edge_radius, frames, polished_semi_diameters
from raytrace.tracing.launch import launch, stop_radius
from raytrace.tracing.trace import lens_steps, points_on_surfaces

_POINTS = 181  # of a surface's profile: smooth at any size of print

#: Points (right, up) of a closed line in the picture, mm.
Outline = tuple[np.ndarray, np.ndarray]

GLASSY = 1.01  # an index above which a medium is drawn as glass

#: The coordinate that points upward in a view, by its number among x, y and z; z points to the right.
UPWARD = {"yz": 1, "xz": 0}


class RayPath(NamedTuple):
    """One ray: its corners, how it ended, and where.

    z, y: (C,) mm, in the view. status: ok, miss, tir or vignetted; surface: number of the surface where the path ends.
    corners: number of the surface of every corner, 0 for the start; points: (3, C) mm in space.
    """

    z: np.ndarray
    y: np.ndarray
    status: str
    surface: int
    corners: tuple[int, ...]
    points: np.ndarray


class Section(NamedTuple):
    """A surface in a view: its vertex in the picture, and the directions of its z and of heights across it.

    origin: (2,) mm of its vertex, to the right and upward; along, across: (2,) the step in the picture of 1 mm of z and
    of 1 mm of height; direction: cosines (2,) along x and y of the surface in which heights are taken.
    """

    origin: np.ndarray
    along: np.ndarray
    across: np.ndarray
    direction: tuple[float, float]

    def at(self, z: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points of the picture (…) at depths z and heights (…) mm."""
        right, up = (self.origin[i] + z * self.along[i] + height * self.across[i] for i in (0, 1))
        return right, up

    def height(self, right: np.ndarray, up: np.ndarray) -> np.ndarray:
        """How high above its vertex, across the surface, a point of the picture is."""
        return (right - self.origin[0]) * self.across[0] + (up - self.origin[1]) * self.across[1]


def sections(lens: Lens, view: str = "yz") -> list[Section]:
    """Every surface in a view. Raises ValueError for a thickness that is not finite, but for the object's."""
    for k, surface in enumerate(lens.surfaces[1:-1], 1):
        if not math.isfinite(float(surface.thickness)):
            raise ValueError(f"surface {k} has a thickness of {float(surface.thickness)}: nothing to draw")
    return [_section(frame, view) for frame in frames(lens)]


def _section(frame: Frame, view: str) -> Section:
    """Heights are taken where the surface cuts a plane that is parallel to the picture."""
    up = UPWARD[view]
    seen, axes = [2, up], array(frame.axes)
    away = np.zeros(3)
    away[1 - up] = 1.0 if up == 1 else -1.0
    across = np.cross(axes[:, 2], away)
    size = float(np.linalg.norm(across))
    across = across / size if size > 1e-9 else np.eye(3)[up]  # of a surface seen face on: upward
    direction = (float(across @ axes[:, 0]), float(across @ axes[:, 1]))
    return Section(array(frame.origin)[seen], axes[seen, 2], across[seen], direction)


def vertices(lens: Lens) -> np.ndarray:
    """z (K,) mm of every vertex, that of surface 1 being 0; the object's may be -inf."""
    return np.array([section.origin[0] for section in sections(lens)])


def sides(lens: Lens) -> list[int]:
    """Axial direction of the light, 1 or -1, before every surface."""
    side, result = 1, []
    for surface in lens.surfaces:
        result.append(side)
        side = -side if surface.is_mirror else side
    return result


def depth(surface: Surface, radius: np.ndarray, direction: tuple[float, float] = (0.0, 1.0)) -> np.ndarray:
    """Sag (...) mm at a radius (...) mm, of either sign, along a direction by its cosines in x and y."""
    r = torch.as_tensor(radius, dtype=surface.thickness.dtype, device=surface.thickness.device)
    return array(sag_at(surface, direction[0] * r, direction[1] * r))


def clear_part(surface: Surface, radius: float) -> tuple[float, float, float]:
    """Centre (x, y) and radius in mm of the drawn part of a surface: a decentred aperture that is smaller than the
    surface, else the whole."""
    for aperture in surface.apertures:
        rim = reach(aperture)[1]
        if not aperture.obscures and rim < radius and any(aperture.centre):
            x, y = aperture.centre
            return float(x), float(y), rim
    return 0.0, 0.0, radius


def is_bent(lens: Lens) -> bool:
    """Whether a surface is tilted or off the z axis."""
    if not any(map(is_posed, lens.surfaces)):
        return False
    for frame in frames(lens):
        axes, origin = array(frame.axes), array(frame.origin)
        if not np.allclose(axes, np.eye(3), atol=1e-12) or np.abs(origin[:2]).max() > 1e-12:
            return True
    return False


def partner(lens: Lens, number: int) -> int:
    """The surface that ends the medium behind this one: the next that is no coordinate break."""
    return next(k for k in range(number + 1, len(lens.surfaces)) if not lens.surfaces[k].is_break)


def heights(*radii: float) -> np.ndarray:
    """Heights from -max to max, with the ± radii themselves among them."""
    return np.unique(np.concatenate([np.linspace(-max(radii), max(radii), _POINTS), *([-r, r] for r in radii)]))


def drawn_radii(lens: Lens, stop: float | None = None) -> list[float]:
    """Radius in mm to which every surface is drawn: its clear semi-diameter with its chip zone.

    stop: that of the stop, if it is known.
    """
    radii = [0.0 if math.isnan(size) else size for size in polished_semi_diameters(lens)]
    stop = abs(float(stop_radius(lens)) if stop is None else stop)
    if math.isfinite(stop):
        radii[lens.stop] = max(radii[lens.stop], stop)
    largest = max(radii[1:])
    return [
        min(radius if radius > 0 else 0.1 * largest, 0.9999 * edge_radius(surface))
        for surface, radius in zip(lens.surfaces, radii, strict=True)
    ]


def glass(
    lens: Lens,
    number: int,
    places: list[Section],
    radii: list[float],
    indices: list[float],
    widths: Sequence[float],
) -> Outline | None:
    """Outline in the picture of the glass behind a surface; None where the glass has no thickness.

    radii: mm, `drawn_radii`; widths: mm, `tracing.geometry.mechanical_semi_diameters`.
    """
    back = partner(lens, number)
    front, behind = places[number], places[back]
    within = front.along @ (behind.origin - front.origin), front.across @ (behind.origin - front.origin)
    upright = abs(within[1]) < 1e-9 and np.allclose(front.across, behind.across, atol=1e-9)
    pair = lens.surfaces[number], lens.surfaces[back]
    if not upright:
        return _wedge(pair, (front, behind), (radii[number], radii[back]))
    if within[0] == 0:
        return None
    if back + 1 == len(lens.surfaces):  # glass up to the image, which has no rim of its own
        outline = element(*pair, 0.0, within[0], (radii[number],) * 2, (False, False), 0.0, front.direction)
    else:
        glassy = indices[number - 1] > GLASSY, indices[back] > GLASSY
        cemented = glassy[0] and not pair[0].is_mirror, back + 1 < len(lens.surfaces) and glassy[1]
        rim = max((width for width in (widths[number], widths[back]) if not math.isnan(width)), default=0.0)
        outline = element(*pair, 0.0, within[0], (radii[number], radii[back]), cemented, rim, front.direction)
    return front.at(*outline)


def _wedge(pair: tuple[Surface, Surface], places: tuple[Section, Section], radii: tuple[float, float]) -> Outline:
    """The outline of glass between two surfaces that are tilted to each other, each drawn to its rim."""
    profiles = []
    for surface, place, radius in zip(pair, places, radii, strict=True):
        height = heights(radius)
        profiles.append(place.at(depth(surface, height, place.direction), height))
    turned = -1 if places[0].across @ places[1].across < 0 else 1
    right, up = (np.concatenate([front, back[::-turned]]) for front, back in zip(*profiles, strict=True))
    return right, up


def element(
    front: Surface,
    back: Surface,
    z_front: float,
    z_back: float,
    radii: tuple[float, float],
    cemented: tuple[bool, bool],
    width: float = 0.0,
    direction: tuple[float, float] = (0.0, 1.0),
) -> Outline:
    """Outline (z, y) of the glass between two surfaces, each drawn to its own radius; width: mm, that of the glass.

    The smaller surface continues to the rim of the larger: flat, as it is ground, or along its sag where it is cemented
    or where a flat would cut the other surface; otherwise the rim is where the two surfaces meet.
    """
    rim = max(*radii, width)
    y = heights(*radii, rim)
    forward = math.copysign(1.0, z_back - z_front)
    outlines = []
    for ends in continuations((front, back), radii, rim, cemented):
        z = []
        for surface, vertex, end in zip((front, back), (z_front, z_back), ends, strict=True):
            z.append(vertex + depth(surface, np.clip(y, -end, end), direction))
        gap = forward * (z[1] - z[0])
        if (gap >= 0).all():
            break
        outlines.append((np.abs(y[gap < 0]).min(), z))
    else:
        limit, z = max(outlines, key=lambda entry: entry[0])
        kept = np.abs(y) < limit
        y, z = y[kept], [side[kept] for side in z]
    return np.concatenate([z[0], z[1][::-1]]), np.concatenate([y, y[::-1]])


def continuations(
    faces: tuple[Surface, Surface], radii: Sequence[float], rim: float, continued: tuple[bool, bool]
) -> Iterator[tuple[float, float]]:
    """Radii in mm up to which two faces of glass follow their sag, flat from there to the rim, in order of preference.

    radii: mm of each face, up to which it always does; continued: whether it does up to the rim, at first.
    """
    for along_sag in (continued, (True, True), (False, True), (True, False), (False, False)):
        front, back = (
            min(rim, edge_radius(surface)) if further else radius
            for surface, radius, further in zip(faces, radii, along_sag, strict=True)
        )
        yield front, back


def ray_paths(
    lens: Lens, pupil: Tensor, *, fields: Tensor, wavelength: Tensor, z_start: float, view: str = "yz"
) -> list[list[RayPath]]:
    """The paths of every field's rays, from the plane z_start (mm) or the object, whichever is nearer.

    A path ends at the image or at the surface where the ray fails or is vignetted: a ray that misses a surface in the
    plane of its vertex, another ray at its hit. Surfaces that do not deflect light are no corners of a path.
    """
    corners, endings, ends = _corners(lens, pupil, fields, wavelength, z_start)
    bends, seen = _bends(lens, wavelength), [2, UPWARD[view]]
    paths: list[list[RayPath]] = []
    for f, row in enumerate(endings):
        paths.append([])
        for p, (status, last) in enumerate(row):
            if last == 0:  # lost before surface 1: no aim was found
                continue
            numbers = (0, *(k for k in bends if k < last), last)
            points = np.array(
                [*(corners[k][:, f, p] for k in numbers[:-1]), ends.get((f, p), corners[last][:, f, p])]
            ).T
            z, y = points[seen]
            paths[f].append(RayPath(z, y, status, last, numbers, points))
    return paths


def _bends(lens: Lens, wavelength: Tensor) -> list[int]:
    """Numbers of the surfaces that change the direction of light."""
    indices, surfaces = media(lens, wavelength), lens.surfaces
    return [
        k
        for k in range(1, len(surfaces) - 1)
        if surfaces[k].is_mirror or surfaces[k].phase is not None or not torch.equal(indices[k], indices[k - 1])
    ]


def _corners(
    lens: Lens, pupil: Tensor, fields: Tensor, wavelength: Tensor, z_start: float
) -> tuple[list[np.ndarray], list[list[tuple[str, int]]], dict[tuple[int, int], np.ndarray]]:
    """Where rays meet every surface, each (3, F, P) mm; status and last surface of each ray; the ends of lost rays."""
    rays = launch(lens, pupil, fields=fields, wavelengths=wavelength.reshape(1))
    placed, corners, alive = frames(lens), [_start(lens, rays, z_start)], rays.valid
    points = points_on_surfaces(lens, rays, wavelength)
    if points is not None:  # no ray is lost
        for k, here in enumerate(points.unbind(1), start=1):
            corners.append(corners[-1] if lens.surfaces[k].is_break else array(placed[k].outside(here))[:, :, 0, :])
        endings = [[("ok", len(lens.surfaces) - 1)] * pupil.shape[1] for _ in range(fields.shape[1])]
        return corners, endings, {}
    position, direction = rays.position, rays.direction
    endings = [[("miss", 0)] * pupil.shape[1] for _ in range(fields.shape[1])]
    ends: dict[tuple[int, int], np.ndarray] = {}
    for k, crossing in enumerate(lens_steps(lens, rays, wavelength), start=1):
        frame = placed[k]
        if lens.surfaces[k].is_break:
            corners.append(corners[-1])
            continue
        here = crossing.rays.position
        if bool((crossing.missed | crossing.totally_reflected).any()):  # these have no point behind the surface
            arrival = frame.inside(position), torch.tensordot(frame.axes.T, direction, dims=1)
            hit, _ = intersect(lens.surfaces[k], *arrival)
            at_plane = arrival[0] - arrival[1] * (arrival[0][2] / arrival[1][2])
            here = torch.where(crossing.missed, at_plane, hit)
        met = array(frame.outside(here))[:, :, 0, :]
        for status, lost in (
            ("miss", crossing.missed),
            ("tir", crossing.totally_reflected),
            ("vignetted", crossing.clipped),
        ):
            for f, p in np.argwhere(array(alive & lost)[:, 0]):
                endings[f][p], ends[f, p] = (status, k), met[:, f, p]
        alive = crossing.rays.valid
        position, direction = frame.outside(crossing.rays.position), frame.along(crossing.rays.direction)
        corners.append(met)
    for f, p in np.argwhere(array(alive)[:, 0]):
        endings[f][p] = ("ok", len(lens.surfaces) - 1)
    return corners, endings, ends


def _start(lens: Lens, rays: Rays, z_start: float) -> np.ndarray:
    """Points (3, F, P) mm where rays enter the picture: in the plane z_start, or on the object if it is nearer."""
    distance = float(lens.surfaces[0].thickness)
    position, direction = rays.position, rays.direction
    if math.isfinite(distance) and -distance >= z_start:
        frame = frames(lens)[0]
        along = torch.tensordot(frame.axes.T, direction, dims=1)
        points = frame.outside(intersect(lens.surfaces[0], frame.inside(position), along)[0])
    else:
        points = position + direction * ((z_start - position[2]) / direction[2])
    return array(points)[:, :, 0, :]


def hole_radius(number: int, z: np.ndarray, radius: float, paths: list[list[RayPath]]) -> float:
    """Radius of the hole a mirror needs for light that passes through its unlit centre later or before; else 0."""
    lit, through = [], []
    for path in (path for field in paths for path in field if path.status == "ok"):
        for corner in range(len(path.z)):
            if path.corners[corner] == number:
                lit.append(abs(path.y[corner]))
        for i in range(len(path.z) - 1):
            if number in path.corners[i : i + 2] or (path.z[i] - z[number]) * (path.z[i + 1] - z[number]) >= 0:
                continue
            share = (z[number] - path.z[i]) / (path.z[i + 1] - path.z[i])
            height = abs(path.y[i] + share * (path.y[i + 1] - path.y[i]))
            if height < radius:
                through.append(height)
    if not through or not lit or max(through) >= min(lit):
        return 0.0
    return min(max(1.3 * max(through), 0.06 * radius), 0.5 * (max(through) + min(lit)))
