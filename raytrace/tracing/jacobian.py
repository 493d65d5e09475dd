"""Jacobian: how every hit moves with every variable of the lens, in one forward pass over the rays.

A gradient goes backward, from one merit to all variables. The Jacobian has as many rows as there are rays: it goes
forward, each change through the surfaces behind it, all of them while a block of rays is in the cache. Least squares
(Gauss-Newton, Levenberg-Marquardt) live on it.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.compiled.library import uses_compiled
from raytrace.tracing.compiled.run import Pushed, Task, forward, push, push_everywhere, task_of
from raytrace.tracing.compiled.structure import is_expressible, with_numbers
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

    variables: tensors that require a gradient and that numbers of the surfaces or indices were computed from, or are;
    V counts all their entries. surfaces, rays, indices, wavelength: as for `trace.steps`, the rays before surfaces[0]
    held fixed. Rays that are lost do not move. Raises ValueError for surfaces that the compiled trace does not know
    (height maps, more than 16 terms), and for numbers of a lens that differ from ray to ray
    of the last axis.
    """
    known = all(map(is_expressible, surfaces))
    task = task_of(surfaces, rays, indices=indices, wavelength=wavelength) if known else None
    if task is None:
        raise ValueError(
            "no Jacobian for height maps, more than 16 terms, numbers of another dtype than "
            "the rays, or numbers that differ along the last axis of the rays: use torch.func.jacfwd on the trace"
        )
    return pushed(surfaces, task, _changes(task.given[3], variables)).by_position[:2].transpose(0, 1)


def pushed(
    surfaces: Sequence[Surface], task: Task, changes: Tensor, start: tuple[Tensor, Tensor, Tensor | None] | None = None
) -> Pushed:
    """The rays behind the last surface and how they change, by the engine that is chosen; arguments as for `run.push`.

    surfaces: those that the task was made of.
    """
    rays = Rays(*task.given[:2], task.valid, task.given[2])
    if uses_compiled(rays, changes, len(surfaces)):
        return push(task, changes, start)
    return _pushed_by_torch(surfaces, task, changes, start)


def pushed_everywhere(
    surfaces: Sequence[Surface], task: Task, changes: Tensor, start: tuple[Tensor, Tensor, Tensor | None] | None = None
) -> Pushed | None:
    """`run.push_everywhere` where the compiled trace carries these rays; None where torch has to."""
    rays = Rays(*task.given[:2], task.valid, task.given[2])
    return push_everywhere(task, changes, start) if uses_compiled(rays, task.given[3], len(surfaces)) else None


def ends(surfaces: Sequence[Surface], task: Task) -> Rays:
    """The rays behind the last surface alone, by the engine that is chosen."""
    position, direction, opl, table = task.given
    if uses_compiled(Rays(position, direction, task.valid, opl), table, len(surfaces)):
        return forward(task)
    return _behind(surfaces, task, position, direction, opl, table)


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
    def behind(position: Tensor, direction: Tensor, opl: Tensor | None, table: Tensor) -> tuple:
        end = _behind(surfaces, task, position, direction, opl, table)
        return (end.position, end.direction, *([] if opl is None else [end.opl])), end.valid

    *rays, table = (None if part is None else part.detach() for part in task.given)
    found = []
    for number, change in enumerate(changes):
        steps = [
            None if part is None else torch.zeros_like(part) if start is None else start[k].select(int(k < 2), number)
            for k, part in enumerate(rays)
        ]
        given = [(part, step) for part, step in zip((*rays, table), (*steps, change), strict=True) if part is not None]
        without = rays[2] is None
        function = (lambda p, d, t: behind(p, d, None, t)) if without else behind
        found.append(torch.func.jvp(function, *map(tuple, zip(*given, strict=True)), has_aux=True))
    (ends, _, valid), by = found[0], [torch.stack(parts) for parts in zip(*(f[1] for f in found), strict=True)]
    position, direction, *opl = ends
    return Pushed(
        position,
        direction,
        opl[0] if opl else None,
        valid,
        by[0].transpose(0, 1),
        by[1].transpose(0, 1),
        by[2] if opl else None,
    )
