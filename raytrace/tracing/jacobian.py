"""Jacobian: derivatives of every hit by every variable of the lens, in one forward pass over the rays.

For least squares (Gauss-Newton, Levenberg-Marquardt): all variables go through the surfaces behind them while a block
of rays is in the cache.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.compiled import Pushed, Task, forward, is_expressible, push, task_of, uses_compiled, with_numbers
from raytrace.tracing.trace import trace_surfaces


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


def pushed(
    surfaces: Sequence[Surface], task: Task, changes: Tensor, start: tuple[Tensor, Tensor, Tensor | None] | None = None
) -> Pushed:
    """`compiled.push` by the engine that is chosen; surfaces: those that the task was made of."""
    if _is_compiled(surfaces, task):
        return push(task, changes, start)
    return _pushed_by_torch(surfaces, task, changes, start)


def pushed_everywhere(
    surfaces: Sequence[Surface], task: Task, changes: Tensor, start: tuple[Tensor, Tensor, Tensor | None] | None = None
) -> Pushed | None:
    """`compiled.push` behind every row where the compiled trace carries these rays; None where torch has to."""
    return push(task, changes, start, everywhere=True) if _is_compiled(surfaces, task) else None


def ends(surfaces: Sequence[Surface], task: Task) -> Rays:
    """The rays behind the last surface alone, by the engine that is chosen."""
    return forward(task) if _is_compiled(surfaces, task) else _behind(surfaces, task, *task.inputs)


def _is_compiled(surfaces: Sequence[Surface], task: Task) -> bool:
    position, direction, opl, table = task.inputs
    return uses_compiled(Rays(position, direction, task.valid, opl), table, len(surfaces))


def _behind(surfaces: Sequence[Surface], task: Task, position, direction, opl, table: Tensor) -> Rays:
    shape = *task.valid.shape[:-1], 1
    numbers = [n.reshape(()) if len(table) == 1 else n.reshape(shape) for n in table.unbind(-1)]
    own, indices, gap = with_numbers(task.structure, surfaces, numbers)
    return trace_surfaces(own, Rays(position, direction, task.valid, opl), indices=indices, gap=gap)


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


def _pushed_by_torch(surfaces: Sequence[Surface], task: Task, changes: Tensor, start) -> Pushed:
    *rays, table = (part.detach() for part in task.inputs if part is not None)
    traces_path = len(rays) == 3

    def behind(position: Tensor, direction: Tensor, *others: Tensor) -> tuple:
        end = _behind(surfaces, task, position, direction, *(others if traces_path else (None, *others)))
        return (end.position, end.direction, *([end.opl] if traces_path else [])), end.valid

    slopes = []
    for number, change in enumerate(changes):
        steps = [
            torch.zeros_like(part) if start is None else start[k].select(int(k < 2), number)
            for k, part in enumerate(rays)
        ]
        ends, slope, valid = torch.func.jvp(behind, (*rays, table), (*steps, change), has_aux=True)
        slopes.append(slope)
    by_position, by_direction, *by_opl = (torch.stack(parts) for parts in zip(*slopes, strict=True))
    return Pushed(
        *ends[:2],
        ends[2] if traces_path else None,
        valid,
        by_position.transpose(0, 1),
        by_direction.transpose(0, 1),
        by_opl[0] if traces_path else None,
    )
