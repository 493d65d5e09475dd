"""Sharing: kernels of a scene computed by several processes, a block of object distances × fields × wavelengths each.

Each model decides some things for its whole scene: how many rays, how fine a cell, whether anything is clipped. Within
`shards.agreeing` those decisions are taken for all blocks (`largest`, `everywhere`), so that the kernels are those of
one process to rounding.
"""

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide
from raytrace.optics.scene import Kernels, Scene, trace_scene
from raytrace.optics.scene import symmetry as symmetry_of_part
from raytrace.shards import Share, agreeing, alone, gathered, largest, total
from raytrace.system.lens import with_object_distance

_FOLDS = ("round", "mirror", "none")


def symmetry(scene: Scene) -> str:
    """`scene.symmetry`, of the whole scene where this one is a block of it: the least that any block has."""
    return _FOLDS[int(largest(torch.tensor(_FOLDS.index(symmetry_of_part(scene)))))]


def shared(kernels: Callable[..., Kernels], share: Share, *, by_field: bool = False) -> Callable[..., Kernels]:
    """The same kernels, each process computing a block of them; all of them get all, without gradient.

    by_field: the model takes its decisions for each field by itself: then fields are dealt out whole, or each is cut.
    """

    def compute(scene: Scene, grid: Grid, **options) -> Kernels:
        cut = _cuts(scene.shape, share.processes, by_field=by_field)
        if math.prod(cut) == 1:
            return kernels(scene, grid, **options)
        # Processes beyond the number of blocks repeat one, so that all take part in all decisions.
        block = _block(scene.shape, cut, share.rank % math.prod(cut))
        with agreeing():
            with alone() if by_field and cut[1] > 1 else contextlib.nullcontext():
                found = kernels(_part(scene, block), _window(grid, block), **options)
            rays = int(largest(torch.tensor(found.rays)))
        return _joined(found, grid, scene.shape, block if share.rank < math.prod(cut) else None, rays)

    return compute


def trace_shared(scene: Scene, pupil: Tensor, share: Share | None) -> tuple[Tensor, Tensor]:
    """Hits (2, D, F, W, P) on the sensor and which rays arrive (D, F, W, P); each process traces some of the P rays."""
    if share is None or share.processes == 1:
        rays = trace_scene(scene, pupil)
        return rays.position[:2], rays.valid
    part = share.part(pupil.shape[-1])
    rays = trace_scene(scene, pupil[..., part])
    hits = rays.position.new_zeros(3, *scene.shape, pupil.shape[-1])
    hits[:2, ..., part], hits[2, ..., part] = rays.position[:2], rays.valid.to(hits.dtype)
    hits = total(hits)
    return hits[:2], hits[2] > 0.5


def pooled(energy: Tensor, centroid: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Centroid (2, ...) and covariance (3, ...) of all light, from those of each process and its energy (...).

        m = Σ_k s_k m_k,   C = Σ_k s_k (C_k + (m_k - m)(m_k - m)ᵀ),   s_k = E_k / Σ E

    Nothing large is subtracted (Chan, Golub and LeVeque, Updating formulae, Stanford STAN-CS-79-773, 1979, eq. 2.1).
    """
    energy, centroid, covariance = (gathered(t) for t in (energy, centroid, covariance))
    share = safe_divide(energy, energy.sum(0).expand_as(energy))[:, None]
    mean = (share * centroid).sum(0)
    x, y = (centroid - mean).unbind(1)
    return mean, (share * (covariance + torch.stack([x * x, x * y, y * y], 1))).sum(0)


def _cuts(shape: Sequence[int], processes: int, *, by_field: bool) -> tuple[int, int, int]:
    """Into how many parts each axis is cut so that the largest block is smallest; of equal ones the fewest parts."""
    choices = itertools.product(*(range(1, min(count, processes) + 1) for count in shape))
    fitting = [cut for cut in choices if math.prod(cut) <= processes]
    if by_field:
        fitting = [cut for cut in fitting if cut[1] == 1 or cut[0] * cut[2] == 1]
    return min(fitting, key=lambda cut: (math.prod(map(_ceil_divide, shape, cut)), math.prod(cut)))


def _ceil_divide(count: int, parts: int) -> int:
    return -(-count // parts)


def _block(shape: Sequence[int], cut: Sequence[int], number: int) -> tuple[slice, ...]:
    """Block `number` of those that axes of `shape` are cut into."""
    places = []
    for count, parts in zip(reversed(shape), reversed(cut), strict=True):
        number, place = divmod(number, parts)
        places.append(Share(place, parts).part(count))
    return tuple(reversed(places))


def _part(scene: Scene, block: tuple[slice, ...]) -> Scene:
    distances, fields, wavelengths = block
    return dataclasses.replace(
        scene,
        lens=with_object_distance(scene.lens, scene.lens.surfaces[0].thickness[distances]),
        fields=scene.fields[:, fields],
        wavelengths=scene.wavelengths[wavelengths],
    )


def _window(grid: Grid, block: tuple[slice, ...]) -> Grid:
    """The windows of a block; axes of length 1 stand for all."""
    centre = grid.centre
    for axis, part in enumerate(block, 1):
        if centre.dim() > 1 and centre.shape[axis] > 1:
            centre = centre[(slice(None),) * axis + (part,)]
    return dataclasses.replace(grid, centre=centre)


def _joined(found: Kernels, grid: Grid, shape: Sequence[int], block: tuple[slice, ...] | None, rays: int) -> Kernels:
    """All kernels from the blocks of all processes; block: where those of this one belong, None if another has it."""

    def whole(part: Tensor, before: int) -> Tensor:
        joined = part.new_zeros(*part.shape[:before], *shape, *part.shape[before + 3 :])
        if block is not None:
            joined[(slice(None),) * before + block] = part.detach()
        return total(joined)

    axes = {"kernel": 0, "centroid": 1, "covariance": 1, "residual": 0, "ray_centroid": 1, "ray_covariance": 1}
    parts = {name: getattr(found, name) for name in axes}
    return Kernels(
        grid=grid, rays=rays, **{name: None if t is None else whole(t, axes[name]) for name, t in parts.items()}
    )
