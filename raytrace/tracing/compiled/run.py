"""Run: call the compiled trace on tensors, forward and backward.

The gradient is that of the compiled adjoint (adjoint.h); a gradient of the gradient goes through the eager trace.
"""

import ctypes
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import broadcast_shape, with_batch_axes
from raytrace.system.poses import Gap
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.compiled.library import library
from raytrace.tracing.compiled.structure import Structure, structure_of, with_numbers

_WORTH_A_THREAD = 2**16  # rays × surfaces

#: surfaces, rays, indices, side, gap -> the rays behind the last surface, by torch alone.
Eager = Callable[..., Rays]


class _Call(ctypes.Structure):
    """`Call` of trace.cpp."""

    _fields_ = (
        ("layout", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("surfaces", "rows", "rays", "numbers")),
        *((name, ctypes.c_void_p) for name in ("table", "constants")),
        *((name, ctypes.c_void_p * 7) for name in ("rays_in", "rays_out", "cotangents", "by_rays")),
        *((name, ctypes.c_void_p) for name in ("by_numbers", "valid_in", "valid_out")),
        ("changes", ctypes.c_int64),
        ("change", ctypes.c_void_p),
        ("changed", ctypes.c_void_p * 7),
        ("at_start", ctypes.c_void_p * 7),
        ("everywhere", ctypes.c_int64),
    )


def trace_compiled(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    side: int,
    gap: Tensor | Gap | None,
    wavelength: Tensor | None = None,
    eager: Eager,
) -> Rays | None:
    """The rays behind the last of the surfaces; None for a batch that the compiled trace has no form for.

    Arguments as for `trace.steps`; eager: the same trace by torch alone, for derivatives of derivatives.
    """
    task = task_of(surfaces, rays, indices=indices, side=side, gap=gap, wavelength=wavelength)
    if task is None:
        return None
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in task.given):
        again = _Again(task.structure, tuple(surfaces), side, eager)
        position, direction, opl, valid = _Compiled.apply(again, task.valid, *task.given)
    else:
        position, direction, opl, valid = _forward(task.structure, task.valid, *task.given)
    return Rays(position, direction, valid, opl)


class Task(NamedTuple):
    """What the compiled trace is given: contiguous rays, and the numbers (rows, K) in a table.

    given: position (3, ...), direction (3, ...), path (...) or None, and the table.
    """

    structure: Structure
    valid: Tensor
    given: tuple[Tensor, Tensor, Tensor | None, Tensor]


def task_of(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    side: int = 1,
    gap: Tensor | Gap | None = None,
    wavelength: Tensor | None = None,
) -> Task | None:
    """A batch as the compiled trace takes it; None if it has no form for it."""
    wavelength = None if wavelength is None else wavelength.to(rays.direction.dtype)
    structure, numbers = structure_of(surfaces, indices, side, gap, wavelength)
    shape = _batch(rays, numbers)
    if shape is None:
        return None
    position, direction = (
        with_batch_axes(x, len(shape)).expand(3, *shape).contiguous() for x in (rays.position, rays.direction)
    )
    opl = None if rays.opl is None else rays.opl.expand(shape).contiguous()
    return Task(structure, rays.valid.expand(shape).contiguous(), (position, direction, opl, _table(numbers, shape)))


def _batch(rays: Rays, numbers: Sequence[Tensor]) -> torch.Size | None:
    """Batch shape; None if a number has another dtype than the rays, or differs from ray to ray of the last axis."""
    parts = [rays.position[0], rays.direction[0], rays.valid, *([] if rays.opl is None else [rays.opl]), *numbers]
    shape = broadcast_shape(*(part.shape for part in parts))
    if any(n.dtype != rays.direction.dtype or (n.dim() and n.shape[-1] != 1) for n in numbers) or 0 in shape:
        return None
    return shape


def _table(numbers: Sequence[Tensor], shape: torch.Size) -> Tensor:
    """The numbers (rows, K): one row if none of them has batch axes, else a row for all rays of the last axis."""
    if all(n.dim() == 0 for n in numbers):
        return torch.stack(numbers)[None]
    lead = shape[:-1]
    return torch.stack([(n[..., 0] if n.dim() else n).expand(lead) for n in numbers], -1).reshape(-1, len(numbers))


class _Again:
    """What a second differentiation needs: the trace by torch alone as a function of tensors."""

    def __init__(self, structure: Structure, surfaces: tuple[Surface, ...], side: int, eager: Eager):
        self.structure, self.surfaces, self.side, self.eager = structure, surfaces, side, eager

    def __call__(self, valid: Tensor, position: Tensor, direction: Tensor, opl: Tensor | None, table: Tensor) -> Rays:
        numbers = table[0].unbind(0) if len(table) == 1 else _unrolled(table, valid.shape)
        surfaces, indices, gap = with_numbers(self.structure, self.surfaces, numbers)
        rays = Rays(position, direction, valid, opl)
        return self.eager(surfaces, rays, indices=indices, side=self.side, gap=gap)


def _unrolled(table: Tensor, shape: torch.Size) -> tuple[Tensor, ...]:
    return table.reshape(*shape[:-1], 1, table.shape[-1]).unbind(-1)


class _Compiled(torch.autograd.Function):
    """Rays before the first surface and numbers of the lens -> rays behind the last."""

    @staticmethod
    def forward(ctx, again: _Again, valid, position, direction, opl, table):
        ctx.set_materialize_grads(False)
        ctx.again = again
        ctx.save_for_backward(valid, position, direction, opl, table)
        found = _forward(again.structure, valid, position, direction, opl, table)
        ctx.mark_non_differentiable(found[3])
        return found

    @staticmethod
    def backward(ctx, by_position, by_direction, by_opl, _):
        given, cotangents = ctx.saved_tensors, (by_position, by_direction, by_opl)
        if torch.is_grad_enabled():
            return None, None, *_differentiable(ctx.again, given, cotangents, ctx.needs_input_grad[2:])
        wanted = any(ctx.needs_input_grad[2:5])
        by_rays, by_table = _backward(ctx.again.structure, given, cotangents, wanted)
        return None, None, *by_rays, by_table


def _differentiable(again: _Again, given, cotangents, needed) -> list[Tensor | None]:
    """The gradient as a graph of its own, through the eager trace."""
    valid, *inputs = given
    end = again(valid, *inputs)
    pairs = [(o, c) for o, c in zip((end.position, end.direction, end.opl), cotangents, strict=True) if c is not None]
    wanted = [x for x, n in zip(inputs, needed, strict=True) if n and x is not None]
    outputs, weights = [o for o, _ in pairs], [c for _, c in pairs]
    found = iter(torch.autograd.grad(outputs, wanted, weights, create_graph=True, allow_unused=True))
    return [next(found) if n and x is not None else None for x, n in zip(inputs, needed, strict=True)]


def _forward(structure: Structure, valid, position, direction, opl, table):
    """Position, direction, path and validity behind the last surface."""
    out = torch.empty_like(position), torch.empty_like(direction), None if opl is None else torch.empty_like(opl)
    valid_out = torch.empty_like(valid)
    call = _call(structure, valid, position, direction, opl, table)
    call.rays_out = _pointers(*out)
    call.valid_out = valid_out.data_ptr()
    _run("forward", call, table)
    return *out, valid_out


def _backward(structure: Structure, given, cotangents, wanted: bool):
    """Derivatives by position, direction and path, if wanted, and by the numbers."""
    valid, position, direction, opl, table = given
    cotangents = [None if c is None else c.contiguous() for c in cotangents]
    by_rays = [torch.empty_like(x) if wanted and x is not None else None for x in (position, direction, opl)]
    call = _call(structure, valid, position, direction, opl, table)
    call.cotangents, call.by_rays = _pointers(*cotangents), _pointers(*by_rays)
    total = np.zeros((call.rows, call.numbers))
    call.by_numbers = total.ctypes.data
    _run("backward", call, table)
    return by_rays, torch.from_numpy(total).to(table.dtype)


def forward(task: Task) -> Rays:
    """The rays behind the last surface, outside the graph."""
    position, direction, opl, valid = _forward(task.structure, task.valid, *task.given)
    return Rays(position, direction, valid, opl)


class Pushed(NamedTuple):
    """Rays behind the last surface, and how their position (3, V, ...), direction (3, V, ...) and path (V, ...) change.

    opl and by_opl: None where paths are not traced.
    """

    position: Tensor
    direction: Tensor
    opl: Tensor | None
    valid: Tensor
    by_position: Tensor
    by_direction: Tensor
    by_opl: Tensor | None


def push(task: Task, changes: Tensor, start: tuple[Tensor, Tensor, Tensor | None] | None = None) -> Pushed:
    """The rays behind the last surface, and how they change with the table and with the rays before the first.

    changes: (V, rows, K), that of the table for each of V variables; start: those of position (3, V, ...), direction
    (3, V, ...) and path (V, ...) before the first surface, or None where these rays stay. A lost ray does not change.
    """
    return _pushed(task, changes, start, ())


def push_everywhere(task: Task, changes: Tensor, start: tuple[Tensor, Tensor, Tensor | None] | None = None) -> Pushed:
    """`push` for the rays behind every row of the structure, K of them, not the last alone.

    The rays have a first axis more: position (3, K, ...), opl and valid (K, ...), by_position (3, K, V, ...). V may be
    0. A ray is valid up to where it is lost.
    """
    return _pushed(task, changes, start, (len(task.structure.layout),))


def _pushed(task: Task, changes: Tensor, start, pages: tuple[int, ...]) -> Pushed:
    position, direction, opl, table = task.given
    call = _call(task.structure, task.valid, *task.given)
    changes, shape = changes.contiguous(), task.valid.shape
    call.changes, call.change, call.everywhere = len(changes), changes.data_ptr(), len(pages)
    ends = [part.new_empty(3, *pages, *shape) for part in (position, direction)]
    ends.append(None if opl is None else opl.new_empty(*pages, *shape))
    valid = task.valid.new_empty(*pages, *shape)
    call.rays_out, call.valid_out = _pointers(*ends), valid.data_ptr()
    by = [changes.new_empty(3, *pages, len(changes), *shape) for _ in range(2)]
    by_opl = None if opl is None else changes.new_empty(*pages, len(changes), *shape)
    call.changed = _pointers(*by, by_opl)
    if start is not None:
        start = [None if part is None else part.contiguous() for part in start]
        call.at_start = _pointers(*start)
    _run("tangents", call, table)
    return Pushed(*ends, valid, *by, by_opl)


def _call(structure: Structure, valid, position, direction, opl, table) -> _Call:
    rows, numbers = table.shape
    return _Call(
        layout=structure.layout.ctypes.data,
        surfaces=len(structure.layout),
        rows=rows,
        rays=valid.numel() // rows,
        numbers=numbers,
        table=table.data_ptr(),
        constants=structure.constants.ctypes.data,
        rays_in=_pointers(position, direction, opl),
        valid_in=valid.data_ptr(),
    )


def _pointers(position: Tensor | None, direction: Tensor | None, opl: Tensor | None):
    parts = [None if t is None else t.data_ptr() + i * (t.nbytes // 3) for t in (position, direction) for i in range(3)]
    return (ctypes.c_void_p * 7)(*parts, None if opl is None else opl.data_ptr())


def _run(what: str, call: _Call, table: Tensor) -> None:
    """Call the compiled code, in torch's threads where the work is worth them."""
    function = getattr(library(), f"raytrace_{what}_{'float' if table.dtype == torch.float32 else 'double'}")
    work = call.rows * call.rays * call.surfaces
    function(ctypes.byref(call), min(torch.get_num_threads(), 1 + work // _WORTH_A_THREAD))
