"""Streaming: kernels of any number of plain rays within a memory budget; see raytrace/optics/streaming.py."""

import dataclasses

import torch
from torch import Tensor

from raytrace.kernels.rays import deposit
from raytrace.kernels.result import Kernels
from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide
from raytrace.optics.scene import Scene, beam_share
from raytrace.optics.streaming import (
    MAX_BYTES,
    Moments,
    Progress,
    chunk_size,
    hits,
    merge,
    moments,
    nothing,
    pupil_chunks,
    shots_of,
    stacked,
)
from raytrace.system.lens import with_object_distance


@torch.no_grad()
def stream_kernels(
    scene: Scene,
    grid: Grid,
    rays: int,
    *,
    sampling: str = "sobol",
    seed: int = 0,
    width: float = 0.25,
    max_bytes: float = MAX_BYTES,
    progress: Progress | None = None,
) -> tuple[Kernels, Kernels]:
    """Kernels of that many plain rays for each distance, field and wavelength, as `rays.kernels` has them, and of the
    first half of them. No derivatives.

    sampling, seed: as for `stream_spots`; width: half width in pixels of the kernel each ray is blurred by, 0 for none;
    max_bytes: of memory beside what the process has; progress: called with the number of rays traced since the last
    call. Sums are float64; two kernels of each are kept.
    """
    shape, lens = scene.shape, scene.lens
    like = lens.surfaces[-2].thickness
    at = (with_object_distance(lens, d) for d in lens.surfaces[0].thickness.flatten().unbind(0))
    shots = [s for here in at for s in shots_of(here, rays, scene.fields, scene.wavelengths, None, None)[0]]
    centre = grid.centre.reshape(2, *(grid.centre.shape[1:] or (1, 1, 1))).expand(2, *shape)
    grids = [dataclasses.replace(grid, centre=c) for c in centre.flatten(1).unbind(1)]
    size = chunk_size(shots[0], max_bytes, kept=3 * 8 * len(shots) * grid.rows * grid.columns)
    references: list[Tensor] = []
    sums, kernels = [nothing(like)] * len(shots), like.new_zeros(len(shots), *grid.shape, dtype=torch.float64)
    done, half = 0, max(1, rays // 2)
    for points in pupil_chunks(rays, size, sampling=sampling, seed=seed, like=like, cut=half):
        for k, s in enumerate(shots):
            found, valid = hits(s, points)
            if not done:
                references.append(moments(found, valid, like.new_zeros(2)).mean.to(like.dtype))
            sums[k] = merge(sums[k], moments(found, valid, references[k]))
            kernels[k] += deposit(grids[k], found, valid.double(), width)
            if progress is not None:
                progress(points.shape[1])
        done += points.shape[1]
        if done == half:
            before = kernels.clone()
    m = stacked([Moments(m.count, r + m.mean, m.scatter) for r, m in zip(references, sums, strict=True)], shape)
    light = beam_share(scene).double()
    about, arrived = (m.mean, safe_divide(m.scatter, m.count)), light * m.count / rays
    whole, first = (
        k.unflatten(0, shape) * (light / count)[..., None, None] for k, count in ((kernels, rays), (before, half))
    )
    return Kernels(whole, grid, *about, rays, arrived=arrived), Kernels(first, grid, *about, half, arrived=arrived)
