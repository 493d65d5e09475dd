"""Derivatives of hits by numbers of surfaces, from the compiled tangents: what tests compare with gradients."""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.compiled import is_expressible, task_of
from raytrace.tracing.trace import pushed


def hit_jacobian(
    surfaces: Sequence[Surface],
    rays: Rays,
    variables: Sequence[Tensor],
    *,
    indices: Sequence[Tensor],
    wavelength: Tensor | None = None,
) -> Tensor:
    """∂(x, y)/∂v (V, 2, ...) of the hits on the last surface by every entry of the variables, in their order.

    variables: tensors that require a gradient, which numbers of the surfaces or indices are or depend on; V counts all
    their entries. surfaces, rays, indices, wavelength: as for `trace.steps`, the rays before surfaces[0] held fixed.
    Failed rays have derivatives 0. Raises ValueError for surfaces that the compiled trace does not support (height
    maps, more than 16 terms), and for numbers of a lens that vary along the last axis of the rays.
    """
    known = all(map(is_expressible, surfaces))
    task = task_of(surfaces, rays, indices=indices, wavelength=wavelength) if known else None
    if task is None:
        raise ValueError(
            "no Jacobian for height maps, more than 16 terms, numbers of another dtype than "
            "the rays, or numbers that differ along the last axis of the rays: use torch.func.jacfwd on the trace"
        )
    return pushed(surfaces, task, _changes(task.inputs[3], variables)).by_position[:2].transpose(0, 1)


def _changes(table: Tensor, variables: Sequence[Tensor]) -> Tensor:
    """∂table/∂v (V, rows, K)."""
    every = torch.eye(table.numel(), dtype=table.dtype, device=table.device)
    found = torch.autograd.grad(
        table.reshape(-1), list(variables), every, retain_graph=True, is_grads_batched=True, allow_unused=True
    )
    columns = [
        table.new_zeros(v.numel(), table.numel()) if g is None else g.reshape(table.numel(), -1).T
        for v, g in zip(variables, found, strict=True)
    ]
    return torch.cat(columns).reshape(-1, *table.shape)
