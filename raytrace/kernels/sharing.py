"""Sharing: kernels of a scene computed by several processes, a block of object distances × fields × wavelengths each.

Each model decides some things for its whole scene: how many rays, how fine a cell, whether anything is clipped. It asks
`Scene.largest` for them, which holds for all blocks here, so that the kernels are those of one process to rounding.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.kernels.models import Model
from raytrace.kernels.result import Kernels, combined, mixture
from raytrace.maths import pupil
from raytrace.maths.grid import Grid
from raytrace.optics.scene import Scene
from raytrace.shards import Share, agreeing, gathered, total
from raytrace.system.lens import Lens, with_object_distance


def shared_model(model: Model, share: Share) -> Model:
    """The model, computed together by processes that all call it alike and all get the kernels, without gradient.

    Each process computes some of the kernels, and whole fields of a model that decides `by_field`; or some of the rays
    where they are plain. A single kernel without plain rays is not cut: every process computes it.
    """
    deal = functools.partial(shared, share=share, by_field=model.by_field)
    plain = model.plain and functools.partial(_plain_rays, model.plain, share)
    return dataclasses.replace(model, kernels=deal(model.kernels), lean=model.lean and deal(model.lean), plain=plain)


def check_shares(lens: Lens, options: Sequence) -> None:
    """Raise ValueError for what processes cannot share: derivatives, and options that differ between kernels."""
    leaves = [leaf for leaf in pytree.tree_leaves((lens, options)) if isinstance(leaf, Tensor)]
    if torch.is_grad_enabled() and any(leaf.requires_grad for leaf in leaves):
        raise ValueError("kernels that processes share have no gradient: leave share out, or use torch.no_grad()")
    if any(isinstance(option, Tensor) and option.dim() > 1 for option in options):
        raise ValueError("processes share kernels of one rho and one zernike only: leave share out")


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
        own = _part(scene, block)
        with agreeing() as largest:
            if not (by_field and cut[1] > 1):
                own = dataclasses.replace(own, largest=largest)
            found = kernels(own, _window(grid, block), **options)
            rays = int(largest(torch.tensor(found.rays)))
        found = _joined(found, scene.shape, block if share.rank < math.prod(cut) else None)
        return dataclasses.replace(found, grid=grid, rays=rays)

    return compute


def _plain_rays(plain: Callable[..., Kernels], share: Share, scene: Scene, grid: Grid, *, rays: int) -> Kernels:
    """Kernels of so many Sobol rays, each process tracing some of them."""

    def some(count: int, **like) -> tuple[Tensor, Tensor]:
        points, weights = pupil.sobol(count, **like)
        return points[:, share.part(count)], weights[share.part(count)]

    found = plain(scene, grid, rays=rays, sampling=some)
    arrived, *moments = (gathered(t).movedim(0, -1) for t in (found.arrived, found.centroid, found.covariance))
    centroid, covariance = mixture(arrived, *moments)
    return dataclasses.replace(
        found, kernel=total(found.kernel), arrived=arrived.sum(-1), centroid=centroid, covariance=covariance
    )


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


def _joined(found: Kernels, shape: Sequence[int], block: tuple[slice, ...] | None) -> Kernels:
    """All kernels from the blocks of all processes; block: where those of this one belong, None if another has it."""

    def whole(parts: list[Tensor], before: int) -> Tensor:
        (part,) = parts
        joined = part.new_zeros(*part.shape[:before], *shape, *part.shape[before + 3 :])
        if block is not None:
            joined[(slice(None),) * before + block] = part.detach()
        return total(joined)

    return combined([found], whole)
