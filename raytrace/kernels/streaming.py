"""PSFs of any number of rays within a memory budget; see raytrace/optics/streaming.py."""

import dataclasses

import torch
from torch import Tensor

from raytrace.kernels.ladder import Psf, polychromatic, without_dark
from raytrace.kernels.splat import histogram, splat_smooth
from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide
from raytrace.maths.value import value
from raytrace.optics.scene import Kernels, beam_share, scene
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
from raytrace.system.lens import Lens, with_object_distance


@value
class StreamedPsf:
    """psf: as `raytrace.kernels.psf(model="drt", rays=N)` gives it; its error is the change from half as many rays.

    arrived: (D, F) energy on the whole sensor plane, of the light through the entrance pupil: what psf.energy lacks of
    it lies beside the window, what it lacks of 1 was lost in the lens.
    """

    psf: Psf
    arrived: Tensor


@torch.no_grad()
def stream_psf(
    lens: Lens,
    rays: int,
    *,
    grid: Grid,
    fields: Tensor | None = None,
    object_distances: Tensor | None = None,
    wavelengths: Tensor | None = None,
    wavelength_weights: Tensor | None = None,
    sampling: str = "sobol",
    seed: int = 0,
    width: float = 0.25,
    max_bytes: int = MAX_BYTES,
    progress: Progress | None = None,
) -> StreamedPsf:
    """PSFs (D, F) of that many plain rays for each distance, field and wavelength, as by `psf(model="drt", rays=…)`.

    grid: its centre is (2,) or (2, D, F) mm; width: half width in pixels of the kernel each ray is blurred by
    (`splat_smooth`), 0 for none; the rest as for `psf` and `stream_spots`. Kernels are float64; two of each are kept.
    """
    distances = lens.surfaces[0].thickness.reshape(1) if object_distances is None else object_distances
    batches = [
        shots_of(with_object_distance(lens, d), rays, fields, wavelengths, wavelength_weights, None)
        for d in distances.unbind(0)
    ]
    shots, (_, shape, weights) = [s for batch in batches for s in batch[0]], batches[0]
    shape = len(distances), *shape
    like = lens.surfaces[-2].thickness
    centre = grid.centre.reshape(2, *(1,) * (3 - grid.centre.dim()), *grid.centre.shape[1:]).expand(2, *shape[:2])
    grids = [dataclasses.replace(grid, centre=c) for c in centre.flatten(1).unbind(1) for _ in range(shape[2])]
    kept = 3 * 8 * len(shots) * grid.rows * grid.columns
    size = chunk_size(shots[0], max_bytes, kept=kept)
    references: list[Tensor] = []
    sums, kernels = [nothing(like)] * len(shots), like.new_zeros(len(shots), *grid.shape, dtype=torch.float64)
    done, half = 0, max(1, rays // 2)
    for points in pupil_chunks(rays, size, sampling=sampling, seed=seed, like=like, cut=half):
        for k, s in enumerate(shots):
            found, valid = hits(s, points)
            if not done:
                references.append(moments(found, valid, like.new_zeros(2)).mean.to(like.dtype))
            sums[k] = merge(sums[k], moments(found, valid, references[k]))
            kernels[k] += _energy(grids[k], found, valid.double(), width)
            if progress is not None:
                progress(points.shape[1])
        done += points.shape[1]
        if done == half:
            before = kernels.clone()
    sums = [Moments(m.count, r + m.mean, m.scatter) for r, m in zip(references, sums, strict=True)]
    return _psf(shots, grid, centre, weights, stacked(sums, shape), kernels.unflatten(0, shape), rays, before / half)


def _energy(grid: Grid, points: Tensor, energy: Tensor, width: float) -> Tensor:
    return splat_smooth(grid, points, energy, width=width) if width else histogram(grid, points, energy)


def _psf(
    shots, grid: Grid, centre: Tensor, weights: Tensor, m: Moments, kernels: Tensor, rays: int, half: Tensor
) -> StreamedPsf:
    """The polychromatic PSF of kernels (D, F, W, rows, columns) that count rays; half: (D F W, …), of half of them."""
    fields = torch.stack([s.field for s in shots[:: m.count.shape[2]]][: m.count.shape[1]], 1)
    first = shots[0].lens
    light = beam_share(scene(first, fields, first.surfaces[0].thickness.reshape(1), shots[0].wavelength[None])).double()
    if grid.centre.dim() > 1:
        grid = dataclasses.replace(grid, centre=centre[..., None].expand(2, *m.count.shape))
    found, before = (
        polychromatic(
            Kernels(k * light[..., None, None], grid, m.mean, safe_divide(m.scatter, m.count), rays), weights, "drt"
        )
        for k in (kernels / rays, half.unflatten(0, m.count.shape))
    )
    wavelengths = torch.stack([s.wavelength for s in shots[: m.count.shape[2]]])
    error = safe_divide((found.kernel - before.kernel).abs().sum((-2, -1)), found.energy)
    found = dataclasses.replace(found, error=error, wavelengths=wavelengths, wavelength_weights=weights)
    return StreamedPsf(without_dark(found), (weights * light * m.count / rays).sum(-1))
