"""Kernels shared between processes, one block of object distances × fields × wavelengths each.

Decisions made for the whole scene (number of rays, cell size, vignetting) go through `Scene.largest`, which then holds
for all blocks, so that the kernels equal those of one process to rounding.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths import pupil
from raytrace.maths.grid import Grid
from raytrace.psf_models.result import Kernels, combined, mixture
from raytrace.shards import Share, agreeing, gathered, total
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.scene import Scene


def check_shares(lens: Lens, parameters) -> None:
    """Raise ValueError for derivatives and for options that differ between kernels: processes cannot share them."""
    leaves = [leaf for leaf in pytree.tree_leaves((lens, parameters)) if isinstance(leaf, Tensor)]
    if torch.is_grad_enabled() and any(leaf.requires_grad for leaf in leaves):
        raise ValueError("kernels that processes share have no gradient: leave share out, or use torch.no_grad()")
    if any(isinstance(leaf, Tensor) and leaf.dim() > 1 for leaf in pytree.tree_leaves(parameters)):
        raise ValueError("processes share kernels of one rho and one zernike only: leave share out")


def shared(kernels: Callable[..., Kernels], share: Share, *, by_field: bool = False) -> Callable[..., Kernels]:
    """The same kernels, each process computing a block; all processes get all of them, without gradient.

    by_field: decisions are made for each field alone: either whole fields are dealt out, or each field is divided.
    """

    def compute(scene: Scene, grid: Grid, **options) -> Kernels:
        cut = _cuts(scene.shape, share.processes, by_field=by_field)
        if math.prod(cut) == 1:
            return kernels(scene, grid, **options)
        # Processes beyond the number of blocks repeat a block, so that all take part in all decisions.
        distances, fields, wavelengths = block = _block(scene.shape, cut, share.rank % math.prod(cut))
        part = dataclasses.replace(
            scene,
            lens=with_object_distance(scene.lens, scene.lens.surfaces[0].thickness[distances]),
            fields=scene.fields[:, fields],
            wavelengths=scene.wavelengths[wavelengths],
        )
        centre = grid.centre
        for axis, chosen in enumerate(block, 1):  # axes of length 1 hold for all
            if centre.dim() > 1 and centre.shape[axis] > 1:
                centre = centre[(slice(None),) * axis + (chosen,)]
        with agreeing() as largest:
            if not (by_field and cut[1] > 1):
                part = dataclasses.replace(part, largest=largest)
            light = kernels(part, dataclasses.replace(grid, centre=centre), **options)
            rays = int(largest(torch.tensor(light.rays)))

        def whole(parts: list[Tensor], before: int) -> Tensor:
            (part,) = parts
            joined = part.new_zeros(*part.shape[:before], *scene.shape, *part.shape[before + 3 :])
            if share.rank < math.prod(cut):  # the process does not repeat a block
                joined[(slice(None),) * before + block] = part.detach()
            return total(joined)

        return dataclasses.replace(combined([light], whole), grid=grid, rays=rays)

    return compute


def plain_rays_shared(plain: Callable[..., Kernels], share: Share, scene: Scene, grid: Grid, *, rays: int) -> Kernels:
    """Kernels of `rays` Sobol rays, each process tracing a share of them."""

    def some(count: int, **like) -> tuple[Tensor, Tensor]:
        points, weights = pupil.sobol(count, **like)
        return points[:, share.part(count)], weights[share.part(count)]

    light = plain(scene, grid, rays=rays, sampling=some)
    arrived, *moments = (gathered(t).movedim(0, -1) for t in (light.arrived, light.centroid, light.covariance))
    centroid, covariance = mixture(arrived, *moments)
    return dataclasses.replace(
        light, kernel=total(light.kernel), arrived=arrived.sum(-1), centroid=centroid, covariance=covariance
    )


def _cuts(shape: Sequence[int], processes: int, *, by_field: bool) -> tuple[int, int, int]:
    """Number of parts along each axis that minimises the largest block; of equal ones the fewest parts."""
    choices = itertools.product(*(range(1, min(count, processes) + 1) for count in shape))
    fitting = [cut for cut in choices if math.prod(cut) <= processes]
    if by_field:
        fitting = [cut for cut in fitting if cut[1] == 1 or cut[0] * cut[2] == 1]
    return min(
        fitting, key=lambda cut: (math.prod(-(-n // k) for n, k in zip(shape, cut, strict=True)), math.prod(cut))
    )


def _block(shape: Sequence[int], cut: Sequence[int], number: int) -> tuple[slice, ...]:
    """Block `number` of the axes of `shape` divided into `cut` parts."""
    axes = zip(np.unravel_index(number, cut), cut, shape, strict=True)
    return tuple(Share(int(part), parts).part(count) for part, parts, count in axes)
