"""The geometry of a cross section: where surfaces and rays lie in the y-z plane, in one frame.

z counts from the vertex of surface 1, in mm; nothing here draws.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.pupil import fan
from raytrace.optics.launch import launch, stop_radius
from raytrace.optics.trace import lens_steps, media
from raytrace.plot.style import array
from raytrace.system.lens import Lens
from raytrace.system.surface import Surface, intersect, sag_at

_POINTS = 181  # of a surface's profile: smooth at any size of print


class RayPath(NamedTuple):
    """One ray in the cross section: its corners, how it ended, and where.

    z, y: (C,) mm. status: ok, miss, tir or vignetted; surface: number of the surface where the path ends.
    corners: number of the surface of every corner, 0 for the start.
    """

    z: np.ndarray
    y: np.ndarray
    status: str
    surface: int
    corners: tuple[int, ...]


def vertices(lens: Lens) -> np.ndarray:
    """z (K,) mm of every vertex, that of surface 1 being 0; the object's may be -inf."""
    thickness = np.array([float(surface.thickness) for surface in lens.surfaces])
    behind = np.flatnonzero(~np.isfinite(thickness[1:-1]))
    if behind.size:
        raise ValueError(f"surface {behind[0] + 1} has a thickness of {thickness[behind[0] + 1]}: nothing to draw")
    return np.concatenate([[-thickness[0], 0.0], np.cumsum(thickness[1:-1])])


def sides(lens: Lens) -> list[int]:
    """Axial direction of the light, 1 or -1, before every surface."""
    side, result = 1, []
    for surface in lens.surfaces:
        result.append(side)
        side = -side if surface.is_mirror else side
    return result


def edge_radius(surface: Surface) -> float:
    """Largest radius in mm at which the surface exists: 1/(|c| √(1+k)) for a closed conic, else inf."""
    curvature = 0.0 if surface.curvature is None else abs(float(surface.curvature))
    shape = 1.0 if surface.conic is None else 1 + float(surface.conic)
    return 1 / (curvature * math.sqrt(shape)) if curvature > 0 and shape > 0 else math.inf


def depth(surface: Surface, radius: np.ndarray) -> np.ndarray:
    """Sag (...) mm at a radius (...) mm, of either sign, in the y-z plane."""
    radius = torch.as_tensor(radius, dtype=surface.thickness.dtype, device=surface.thickness.device)
    return array(sag_at(surface, torch.zeros_like(radius), radius))


def heights(*radii: float) -> np.ndarray:
    """Heights from -max to max, with the ± radii themselves among them."""
    return np.unique(np.concatenate([np.linspace(-max(radii), max(radii), _POINTS), *([-r, r] for r in radii)]))


def drawn_radii(lens: Lens, wavelength: Tensor, fields: Tensor) -> list[float]:
    """Radius in mm to which every surface is drawn.

    The file's semi-diameter; where it has none, what the rays of all fields need and 4 % more.
    """
    stored = [surface.semi_diameter or 0.0 for surface in lens.surfaces]
    if min(stored[1:]) <= 0:
        dtype, device = lens.surfaces[-2].thickness.dtype, lens.wavelengths.device
        points = torch.cat([fan(11, axis, dtype=dtype, device=device)[0] for axis in "xy"], dim=1)
        rays = launch(lens, points, fields=fields, wavelengths=wavelength.reshape(1))
        for k, crossing in enumerate(lens_steps(lens, rays, wavelength), start=1):
            if stored[k] <= 0:
                x, y, _ = crossing.rays.position
                reach = torch.where(crossing.rays.valid, torch.hypot(x, y), 0.0).max()
                stored[k] = 1.04 * float(reach)
    stop = abs(float(stop_radius(lens)))
    if math.isfinite(stop):
        stored[lens.stop] = max(stored[lens.stop], stop)
    largest = max(stored[1:])
    return [
        min(radius if radius > 0 else 0.1 * largest, 0.9999 * edge_radius(surface))
        for surface, radius in zip(lens.surfaces, stored, strict=True)
    ]


def element(
    front: Surface,
    back: Surface,
    z_front: float,
    z_back: float,
    radii: tuple[float, float],
    cemented: tuple[bool, bool],
) -> tuple[np.ndarray, np.ndarray]:
    """Outline (z, y) of the glass between two surfaces, each drawn to its own radius.

    The smaller surface is carried on to the rim of the larger: flat, as it is ground, or along its own sag where it is
    cemented or where a flat would cut the other surface; where nothing fits, the rim is where the two surfaces meet.
    """
    rim = max(radii)
    y = heights(*radii)
    direction = math.copysign(1.0, z_back - z_front)
    outlines = []
    for along_sag in (cemented, (True, True), (False, True), (True, False), (False, False)):
        z = []
        for surface, vertex, radius, own in zip((front, back), (z_front, z_back), radii, along_sag, strict=True):
            reach = min(rim, edge_radius(surface)) if own else radius
            z.append(vertex + depth(surface, np.clip(y, -reach, reach)))
        gap = direction * (z[1] - z[0])
        if (gap >= 0).all():
            break
        outlines.append((np.abs(y[gap < 0]).min(), z))
    else:
        limit, z = max(outlines, key=lambda entry: entry[0])
        kept = np.abs(y) < limit
        y, z = y[kept], [side[kept] for side in z]
    return np.concatenate([z[0], z[1][::-1]]), np.concatenate([y, y[::-1]])


def ray_paths(lens: Lens, pupil: Tensor, *, fields: Tensor, wavelength: Tensor, z_start: float) -> list[list[RayPath]]:
    """The paths of every field's rays, from the plane z_start (mm) or the object, whichever is nearer.

    A path ends at the image or at the surface where the ray is lost: a vignetted or totally reflected one at its hit,
    one that misses in the surface's vertex plane. Surfaces that do not bend light are no corners of a path.
    """
    rays = launch(lens, pupil, fields=fields, wavelengths=wavelength.reshape(1))
    z, indices = vertices(lens), media(lens, wavelength)
    corners = [_start(lens, rays, z_start)]
    alive, gap = rays.valid, None
    fate = [[("miss", 0)] * pupil.shape[1] for _ in range(fields.shape[1])]
    ends: dict[tuple[int, int], np.ndarray] = {}
    for k, crossing in enumerate(lens_steps(lens, rays, wavelength), start=1):
        arrival = (
            rays.position if gap is None else rays.position - torch.stack([0 * gap, 0 * gap, gap])[:, None, None, None]
        )
        hit, _ = intersect(lens.surfaces[k], arrival, rays.direction)
        at_plane = arrival - rays.direction * (arrival[2] / rays.direction[2])
        here = array(torch.where(crossing.missed, at_plane, hit))[1:, :, 0, :] + np.array([0.0, z[k]])[:, None, None]
        for status, lost in (
            ("miss", crossing.missed),
            ("tir", crossing.totally_reflected),
            ("vignetted", crossing.clipped),
        ):
            for f, p in np.argwhere(array(alive & lost)[:, 0]):
                fate[f][p], ends[f, p] = (status, k), here[:, f, p]
        rays, gap, alive = crossing.rays, lens.surfaces[k].thickness, crossing.rays.valid
        corners.append(here)
    for f, p in np.argwhere(array(alive)[:, 0]):
        fate[f][p] = ("ok", len(lens.surfaces) - 1)
    bends = [
        k
        for k in range(1, len(lens.surfaces) - 1)
        if lens.surfaces[k].is_mirror or not torch.equal(indices[k], indices[k - 1])
    ]
    paths = []
    for f, row in enumerate(fate):
        paths.append([])
        for p, (status, last) in enumerate(row):
            if last == 0:  # lost before surface 1: no aim was found
                continue
            numbers = (0, *(k for k in bends if k < last), last)
            y, depths = np.array([corners[k][:, f, p] for k in numbers]).T
            paths[f].append(RayPath(depths, y, status, last, numbers))
    return paths


def _start(lens: Lens, rays, z_start: float) -> np.ndarray:
    """(y, z) (2, F, P) mm where rays enter the picture: in the plane z_start, or on the object in front of nothing."""
    distance = float(lens.surfaces[0].thickness)
    position, direction = rays.position, rays.direction
    if math.isfinite(distance) and -distance >= z_start:
        shift = position.new_tensor([0.0, 0.0, -distance]).reshape(3, 1, 1, 1)
        points = intersect(lens.surfaces[0], position - shift, direction)[0] + shift
    else:
        points = position + direction * ((z_start - position[2]) / direction[2])
    return array(points)[1:, :, 0, :]


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
