"""The trace compiled from C++ (`cpp/`): which engine traces, a run of surfaces as that code reads it, and its calls.

torch's own operators ("eager") or the compiled trace ("compiled") carry a batch of rays; `trace_engine` and the
environment variable RAYTRACE_TRACE force either. The structure of a run of surfaces is a table of integers, a row each:
its kind, its effect on rays, and the numbers that it takes. The numbers are tensors, so that autograd sees how
they were made. The gradient is that of the compiled adjoint (cpp/adjoint.h); its gradient goes through torch.
"""

import contextlib
import contextvars
import ctypes
import dataclasses
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from raytrace.maths.numerics import broadcast_shape, in_forward_mode, in_transform, with_batch_axes
from raytrace.maths.tangents import MovingTensor, are_values_alone, tangents_of, value_of, with_tangents
from raytrace.system.apertures import SHAPES
from raytrace.system.phases import Facets, HologramPath, IdealLens, Phase, PolynomialPath, RadialPath, kind_of, path_of
from raytrace.system.poses import Gap, Turn, passage
from raytrace.system.rays import Rays
from raytrace.system.sag_terms import SAG_TERMS, PowerSag
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface, gap_behind
from raytrace.tracing.compiler import NoCompiler, is_built, library

ENGINES = ("auto", "eager", "compiled")

WORTH_COMPILING = 2**23  # rays × surfaces of one call: it takes torch 0.3 s, and compiling, once for a machine, 10 s
_WORTH_A_THREAD = 2**16  # rays × surfaces

_engine: contextvars.ContextVar[str | None] = contextvars.ContextVar("engine", default=None)
_refused: list[str] = []


# -- which engine traces -----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def trace_engine(engine: str) -> Iterator[None]:
    """Within the block, trace by this engine: "eager", "compiled" or "auto".

    "auto", the default, takes the compiled trace for tensors on the CPU once it has been compiled, compiles it for a
    large batch, and else falls back to eager. "compiled" raises NoCompiler where it cannot be compiled, but falls back
    to eager for all that the compiled trace does not support: other devices, forward derivatives, transforms of
    torch.func, height maps, kinds of sag that are not compiled, and Fresnel lenses other than even aspheres. Raises
    ValueError for another name.
    """
    token = _engine.set(_checked(engine, "trace_engine"))
    try:
        yield
    finally:
        _engine.reset(token)


def engine() -> str:
    """The engine requested by `trace_engine` or by RAYTRACE_TRACE, or "auto"."""
    return _engine.get() or _checked(os.environ.get("RAYTRACE_TRACE") or "auto", "RAYTRACE_TRACE")


def _checked(name: str, origin: str) -> str:
    if name not in ENGINES:
        raise ValueError(f"{origin} {name!r}: expected one of {', '.join(ENGINES)}")
    return name


def prepare() -> str:
    """Compile the trace if necessary: "compiled", or "eager" without it.

    For loops of many small batches, none of which is worth compiling, and for runs whose numbers must not depend on
    when another process compiled it.
    """
    return "compiled" if engine() != "eager" and _available(build=True) else "eager"


def uses_compiled(rays: Rays, numbers: Tensor, surfaces: int) -> bool:
    """Whether the compiled trace is used for these rays; numbers: a number of the lens, for its device."""
    requested = engine()
    dtypes = {part.dtype for part in (rays.direction, rays.position, rays.opl) if part is not None}
    if (
        requested == "eager"
        or rays.direction.device.type != "cpu"
        or numbers.device.type != "cpu"
        or dtypes not in ({torch.float32}, {torch.float64})
        or in_transform()
        or in_forward_mode()
        or torch.compiler.is_compiling()
    ):
        return False
    if requested == "compiled":
        library()
        return True
    return _available(build=rays.direction[0].numel() * surfaces >= WORTH_COMPILING)


def is_ready(surfaces: Sequence[Surface]) -> bool:
    """Whether the compiled trace is built and supports all of these surfaces."""
    return engine() != "eager" and _available(build=False) and all(map(is_expressible, surfaces))


def _available(*, build: bool) -> bool:
    if _refused or not (build or is_built()):
        return False
    try:
        library()
    except NoCompiler as error:
        _refused.append(str(error))
        print(f"raytrace: {error}; tracing by torch alone", file=sys.stderr)
        return False
    return True


# -- surfaces as integers and numbers ----------------------------------------------------------------------------------

_TURN, _PLANE, _SPHERE, _CONIC = range(-1, 3)  # and the codes of shapes.KINDS
_WITH_SAG_TERMS, _FRAME = 3, 4  # kWithSagTerms of sags.h; kFrame of sag_terms.h, its numbers before the coefficients
_NONE, _REFRACT, _REFLECT = range(3)

#: Codes of the kinds of sag, of shapes.KINDS, that the compiled trace supports.
_CODES = {name: kind.code for name, kind in KINDS.items() if kind.code is not None}

#: The powers about a centre of sag terms that the compiled trace supports, by the name of their class.
_POWERS = {name: kind.powers for name, kind in SAG_TERMS.items() if kind.powers is not None}

#: Codes of the shapes of apertures that the compiled trace supports.
_SHAPES = {name: shape.code for name, shape in SHAPES.items() if shape.code is not None}

#: Forms of phases in the compiled trace, by `Form` of paths.h.
FORMS = (None, PolynomialPath, RadialPath, IdealLens, HologramPath, Facets)


class _Row(NamedTuple):
    """`Layout` of block.h: the first six are values, the others positions of numbers, -1 where there is none."""

    kind: int
    bend: int
    side: int
    terms: int
    apertures: int
    first_aperture: int
    gap: int
    curvature: int
    conic: int
    coefficients: int
    before: int
    behind: int
    rim: int
    phase: int = 0
    phase_terms: int = 0
    phase_numbers: int = 0
    sag_term_count: int = 0
    sag_term_numbers: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class Structure:
    """Surfaces without their numbers.

    layout: (S, 18) int32, a `_Row` each; constants: (C,) float64, rims and apertures: whether a ray passes has no
    derivative.
    """

    layout: np.ndarray
    constants: np.ndarray


def is_expressible(surface: Surface) -> bool:
    """Whether the compiled trace supports the kind, sag terms, phase and apertures of a surface, and so many terms."""
    if surface.is_break:
        return True
    if surface.phase is not None:
        kind = kind_of(surface.phase)
        flat = surface.kind == EVEN and surface.sag_terms is None and not surface.is_mirror
        if not (flat if kind.flat else kind.slopes or kind.path is not None):
            return False
    if any(aperture.shape not in _SHAPES for aperture in surface.apertures):
        return False
    if surface.sag_terms is not None:
        name, numbers = type(surface.sag_terms).__name__, tree_leaves(surface.sag_terms)
        most = SAG_TERMS[name].compiled
        few = most is None or all(number.numel() <= most for number in numbers)
        alike = isinstance(surface.sag_terms, PowerSag) or all(number.dim() <= 1 for number in numbers)  # for all rays
        if not (surface.kind == EVEN and name in _POWERS and few and alike):
            return False
    most = KINDS[surface.kind].compiled
    return surface.coefficients is None or (surface.kind in _CODES and len(surface.coefficients) <= most)


class _Table:
    """The numbers that rows point to, and the constants."""

    def __init__(self) -> None:
        self.numbers: list[Tensor] = []
        self.constants: list[float] = []
        self._positions: dict[int, int] = {}

    def position(self, number: Tensor | None) -> int:
        """The position of a number, one for all rows that have it."""
        if number is None:
            return -1
        if id(number) not in self._positions:
            self._positions[id(number)] = len(self.numbers)
            self.numbers.append(number)
        return self._positions[id(number)]

    def first_of(self, numbers: Sequence[Tensor]) -> int:
        """The position of the first of numbers in sequence."""
        self.numbers.extend(numbers)
        return len(self.numbers) - len(numbers)

    def rim(self, surface: Surface) -> int:
        """The position of the semi-diameter, which the apertures follow."""
        position = len(self.constants)
        self.constants.append(float("inf") if surface.semi_diameter is None else surface.semi_diameter)
        for aperture in surface.apertures:
            code, sizes = _SHAPES[aperture.shape], aperture.extent
            numbers = [code, aperture.obscures, *aperture.centre, len(sizes), *sizes]
            self.constants += [float(n.detach() if isinstance(n, Tensor) else n) for n in numbers]
        return position


def structure_of(
    surfaces: Sequence[Surface],
    indices: Sequence[Tensor],
    side: int,
    gap: Tensor | Gap | None,
    wavelength: Tensor | None = None,
) -> tuple[Structure, list[Tensor]]:
    """The structure of a run of surfaces, and its numbers, tensors (...); arguments as for `steps`.

    A pose before a surface is a row by itself; a coordinate break has this row alone.
    """
    table, rows = _Table(), []
    for surface, n1, n2 in zip(surfaces, indices[:-1], indices[1:], strict=True):
        if surface.is_break or surface.before is not None or isinstance(gap, Gap):
            rows.append(_turn(table, surface, gap, side, n1))
            gap = None
        if not surface.is_break:
            rows.append(_row(table, surface, gap, side, n1, n2, wavelength))
        gap, side = gap_behind(surface), -side if surface.is_mirror else side
    return Structure(np.array(rows, dtype=np.int32), np.array(table.constants, dtype=np.float64)), table.numbers


def rows_of(structure: Structure, surfaces: Sequence[Surface]) -> list[int]:
    """The row of the structure behind which rays have passed each of its surfaces, in their own axes."""
    rows, row = [], -1
    for surface in surfaces:
        row += 2 if not surface.is_break and structure.layout[row + 1, 0] == _TURN else 1
        rows.append(row)
    return rows


def _row(
    table: _Table, surface: Surface, gap: Tensor | None, side: int, n1: Tensor, n2: Tensor, wavelength: Tensor | None
) -> _Row:
    form, phase = _form_of(surface, n1, wavelength)
    if isinstance(surface.phase, Facets):  # a plane, whose phase has the shape
        surface = dataclasses.replace(surface, curvature=None, conic=None, coefficients=None)
    terms = () if surface.coefficients is None else surface.coefficients.unbind(0)
    first_term, rim = table.first_of(terms), table.rim(surface)
    sag_terms: tuple[Tensor, ...] = ()
    if surface.sag_terms is not None:  # as sag_terms.h has them
        *frame, powers = tree_leaves(_POWERS[type(surface.sag_terms).__name__](surface.sag_terms))
        sag_terms = *frame, *powers.unbind(0)
        kind = _WITH_SAG_TERMS
    elif surface.coefficients is not None:
        kind = _CODES[surface.kind]
    else:
        kind = _PLANE if surface.curvature is None else _SPHERE if surface.conic is None else _CONIC
    return _Row(
        kind=kind,
        bend=_REFLECT if surface.is_mirror else _NONE if n2 is n1 else _REFRACT,
        side=side,
        terms=len(terms),
        apertures=len(surface.apertures),
        first_aperture=rim + 1,
        gap=table.position(gap),
        curvature=table.position(surface.curvature),
        conic=table.position(surface.conic),
        coefficients=first_term,
        before=table.position(n1),
        behind=table.position(n2),
        rim=rim,
        phase=form,
        phase_terms=len(phase),
        phase_numbers=table.first_of(phase),
        sag_term_count=max(len(sag_terms) - _FRAME, 0),
        sag_term_numbers=table.first_of(sag_terms),
    )


def _turn(table: _Table, surface: Surface, gap: Tensor | Gap | None, side: int, n1: Tensor) -> _Row:
    """The row of a passage over a gap into the axes of a surface; numbers as in `Turn` and turns.h."""
    thickness = gap.thickness if isinstance(gap, Gap) else gap
    rows = passage(gap, surface.before)
    lag = 0.0 if thickness is None else n1 * (thickness * side)
    numbers = [*(entry for row in rows for entry in row[:3]), *(row[3] for row in rows), lag]
    exact = {number: n1.new_tensor(number) for number in {x for x in numbers if isinstance(x, float)}}
    first = table.first_of([exact[x] if isinstance(x, float) else x for x in numbers])
    rim, medium = table.rim(Surface(surface.thickness)), table.position(n1)
    return _Row(_TURN, _NONE, side, len(numbers), 0, rim + 1, -1, -1, -1, first, medium, medium, rim)


def _form_of(surface: Surface, n1: Tensor, wavelength: Tensor | None) -> tuple[int, Sequence[Tensor]]:
    """The number of the form of a phase in FORMS, and the numbers of that form."""
    phase = surface.phase
    if phase is None:
        return 0, ()
    if isinstance(phase, Facets):
        shape = [n1.new_zeros(()) if number is None else number for number in (surface.curvature, surface.conic)]
        numbers = *shape, *(() if surface.coefficients is None else surface.coefficients.unbind(0))
        return FORMS.index(Facets), numbers
    if isinstance(phase, IdealLens):
        vergence = torch.zeros_like(phase.power_x) if phase.vergence is None else phase.vergence
        return FORMS.index(IdealLens), (phase.power_x, phase.power_y, vergence)
    path = path_of(phase, wavelength)
    assert path is not None  # by `is_expressible`
    if isinstance(path, HologramPath):
        return FORMS.index(HologramPath), (*path.first.unbind(0), *path.second.unbind(0), path.scale)
    numbers = path.coefficients.unbind(0)
    if isinstance(path, PolynomialPath):
        numbers = path.coefficients.new_zeros(()) if path.constant is None else path.constant, *numbers
    return FORMS.index(type(path)), numbers


def with_numbers(
    structure: Structure, surfaces: Sequence[Surface], table: Tensor, batch: Sequence[int]
) -> tuple[list[Surface], list[Tensor], Tensor | None]:
    """Surfaces, indices and gap of a structure with a table of numbers, for rays (*batch, P): `structure_of` inverted.

    Every row becomes a surface; turned axes become a coordinate break.
    """
    numbers = table[0].unbind(0) if len(table) == 1 else table.reshape(*batch, 1, table.shape[-1]).unbind(-1)
    rows = [_Row(*row) for row in structure.layout.tolist()]
    gaps = [None if row.gap < 0 else numbers[row.gap] for row in rows]
    real = iter([surface for surface in surfaces if not surface.is_break])
    zero = torch.zeros_like(numbers[rows[0].before])
    rebuilt = [
        dataclasses.replace(
            _turned(row, numbers) if row.kind == _TURN else _rebuilt(row, next(real), numbers),
            thickness=zero if thickness is None else thickness,
        )
        for row, thickness in zip(rows, [*gaps[1:], zero], strict=True)
    ]
    return rebuilt, [numbers[rows[0].before], *(numbers[row.behind] for row in rows)], gaps[0]


def _turned(row: _Row, numbers: Sequence[Tensor]) -> Surface:
    entries = list(numbers[row.coefficients : row.coefficients + row.terms])
    rotation = torch.stack([torch.stack(entries[3 * i : 3 * i + 3]) for i in range(3)])
    turn = Turn(rotation, torch.stack(entries[9:12]), entries[12])
    return Surface(entries[12], before=turn, is_break=True)  # type: ignore[arg-type]  # a surface of the trace alone


def _rebuilt(row: _Row, surface: Surface, numbers: Sequence[Tensor]) -> Surface:
    terms = numbers[row.coefficients : row.coefficients + row.terms]
    curvature, conic = (None if position < 0 else numbers[position] for position in (row.curvature, row.conic))
    phase, sag_terms = surface.phase, surface.sag_terms
    if isinstance(phase, Facets):
        curvature, conic, *terms = numbers[row.phase_numbers : row.phase_numbers + row.phase_terms]
    else:
        phase = _phase_of(row, numbers)
    if row.kind == _WITH_SAG_TERMS:
        first, last = row.sag_term_numbers, row.sag_term_numbers + _FRAME + row.sag_term_count
        centre_x, centre_y, radius, height, *powers = numbers[first:last]
        coefficients = torch.stack(powers) if powers else height.new_zeros(0)
        sag_terms = PowerSag(centre_x, centre_y, radius, height, coefficients)
    return dataclasses.replace(
        surface,
        curvature=curvature,
        conic=conic,
        coefficients=torch.stack(list(terms)) if terms else surface.coefficients,
        phase=phase,
        sag_terms=sag_terms,
        before=None,
        after=None,
    )


def _phase_of(row: _Row, numbers: Sequence[Tensor]) -> Phase | None:
    form, entries = FORMS[row.phase], numbers[row.phase_numbers : row.phase_numbers + row.phase_terms]
    if form is None:
        return None
    if form is IdealLens:
        power_x, power_y, vergence = entries
        return IdealLens(power_x, power_y, vergence)
    if form is HologramPath:
        first, second = (torch.stack(torch.broadcast_tensors(*entries[i : i + 3])) for i in (0, 3))
        return HologramPath(first, second, entries[6])
    terms = entries[1:] if form is PolynomialPath else entries
    coefficients = torch.stack(torch.broadcast_tensors(*terms)) if terms else numbers[row.before].new_zeros(0)
    return PolynomialPath(coefficients, entries[0]) if form is PolynomialPath else RadialPath(coefficients)


# -- calls -------------------------------------------------------------------------------------------------------------


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


#: Position (3, ...), direction (3, ...), path (...) or None, and the table of numbers (rows, K).
Inputs = tuple[Tensor, Tensor, Tensor | None, Tensor]

#: Changes of position (3, V, ...), direction (3, V, ...) and path (V, ...) of rays by V variables.
Changes = tuple[Tensor, Tensor, Tensor | None]


#: Structures, numbers and tables of surfaces, of calls that differ in the rays alone: see `task_of`.
Prepared: TypeAlias = dict[Any, Any]


class Task(NamedTuple):
    """Input of the compiled trace: contiguous rays, and the numbers (rows, K) in a table."""

    structure: Structure
    valid: Tensor
    inputs: Inputs


def task_of(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    side: int = 1,
    gap: Tensor | Gap | None = None,
    wavelength: Tensor | None = None,
    prepared: Prepared | None = None,
) -> Task | None:
    """A batch as the compiled trace takes it; arguments as for `steps`, prepared: as for `trace_surfaces`.

    None for an empty batch, and where a number has another dtype than the rays or varies along the last axis.
    """
    wavelength = None if wavelength is None else wavelength.to(rays.direction.dtype)
    # Poses of tilted surfaces are hundreds of operations: of a search, as many as its rays. They differ by derivatives.
    prepared = {} if prepared is None or in_transform() or in_forward_mode() else prepared
    kind = rays.direction.dtype, torch.is_grad_enabled(), are_values_alone()
    if kind not in prepared:
        prepared[kind] = *structure_of(surfaces, indices, side, gap, wavelength), {}
    structure, numbers, tables = prepared[kind]
    parts = [rays.position[0], rays.direction[0], rays.valid, *([] if rays.opl is None else [rays.opl]), *numbers]
    shape = broadcast_shape(*{part.shape for part in parts})
    if 0 in shape or any(n.dtype != rays.direction.dtype or (n.dim() and n.shape[-1] != 1) for n in numbers):
        return None
    position, direction = (
        with_batch_axes(x, len(shape)).expand(3, *shape).contiguous() for x in (rays.position, rays.direction)
    )
    opl = None if rays.opl is None else rays.opl.expand(shape).contiguous()
    if shape[:-1] not in tables:
        tables[shape[:-1]] = _table_of(numbers, shape[:-1])
    return Task(structure, rays.valid.expand(shape).contiguous(), (position, direction, opl, tables[shape[:-1]]))


def _table_of(numbers: Sequence[Tensor], shape: Sequence[int]) -> Tensor:
    """The table (rows, K) of K numbers, a row for all rays of the last axis of a batch (*shape, P)."""
    # Numbers that are the same in all rows are put into them together.
    single = [k for k, n in enumerate(numbers) if n.numel() == 1]
    several = [k for k, n in enumerate(numbers) if n.numel() > 1]
    parts = []
    if single:
        common = [n if n.dim() == 0 else n.reshape(()) for n in map(numbers.__getitem__, single)]
        parts.append(torch.stack(common)[None])
    if several:
        rows = torch.stack([numbers[k][..., 0].expand(shape) for k in several], -1)
        parts.append(rows.reshape(-1, len(several)))
    table = parts[0]
    if len(parts) == 2:
        places = {k: place for place, k in enumerate((*single, *several))}
        columns = torch.tensor([places[k] for k in range(len(numbers))], device=table.device)
        table = torch.cat([table.expand(len(parts[1]), -1), parts[1]], -1)[:, columns]
    return table


#: surfaces, rays, indices, side, gap -> the rays behind the last surface, by torch alone.
Eager = Callable[..., Rays]


def trace_compiled(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    side: int,
    gap: Tensor | Gap | None,
    wavelength: Tensor | None = None,
    eager: Eager,
    prepared: Prepared | None = None,
) -> Rays | None:
    """The rays behind the last of the surfaces; None for a batch that `task_of` refuses.

    Arguments as for `task_of`; eager: the same trace by torch alone, for derivatives of derivatives.
    """
    task = task_of(surfaces, rays, indices=indices, side=side, gap=gap, wavelength=wavelength, prepared=prepared)
    if task is None:
        return None
    if any(isinstance(part, MovingTensor) for part in task.inputs):
        return None if any(t is not None and t.requires_grad for t in task.inputs) else moved(task)
    if not (torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in task.inputs)):
        return forward(task)

    def again(valid: Tensor, position: Tensor, direction: Tensor, opl: Tensor | None, table: Tensor) -> Rays:
        rebuilt, indices, gap = with_numbers(task.structure, surfaces, table, valid.shape[:-1])
        return eager(rebuilt, Rays(position, direction, valid, opl), indices=indices, side=side, gap=gap)

    position, direction, opl, valid = _Compiled.apply(task.structure, again, task.valid, *task.inputs)
    return Rays(position, direction, valid, opl)


def forward(task: Task) -> Rays:
    """The rays behind the last surface, outside the graph."""
    position, direction, opl, table = task.inputs
    end = Rays(
        torch.empty_like(position),
        torch.empty_like(direction),
        torch.empty_like(task.valid),
        None if opl is None else torch.empty_like(opl),
    )
    call = _call(task)
    call.rays_out, call.valid_out = _pointers(end.position, end.direction, end.opl), end.valid.data_ptr()
    _run("forward", call, table)
    return end


class _Compiled(torch.autograd.Function):
    """Rays before the first surface and numbers of the lens -> rays behind the last."""

    @staticmethod
    def forward(
        ctx: Any,
        structure: Structure,
        again: Callable[..., Rays],
        valid: Tensor,
        position: Tensor,
        direction: Tensor,
        opl: Tensor | None,
        table: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
        ctx.set_materialize_grads(False)
        ctx.structure, ctx.again = structure, again
        ctx.save_for_backward(valid, position, direction, opl, table)
        end = forward(Task(structure, valid, (position, direction, opl, table)))
        ctx.mark_non_differentiable(end.valid)
        return end.position, end.direction, end.opl, end.valid

    @staticmethod
    def backward(
        ctx: Any, by_position: Tensor | None, by_direction: Tensor | None, by_opl: Tensor | None, _: None
    ) -> tuple[Tensor | None, ...]:
        cotangents, (valid, *inputs) = (by_position, by_direction, by_opl), ctx.saved_tensors
        needed = ctx.needs_input_grad[3:]
        if not torch.is_grad_enabled():
            task = Task(ctx.structure, valid, (*inputs,))
            return None, None, None, *_backward(task, cotangents, any(needed[:3]))
        # The gradient as a graph of its own, through the eager trace.
        end = ctx.again(valid, *inputs)
        ends = (end.position, end.direction, end.opl)
        pairs = [pair for pair in zip(ends, cotangents, strict=True) if pair[1] is not None]
        outputs, weights = zip(*pairs, strict=True)
        wanted = [x if n else None for x, n in zip(inputs, needed, strict=True)]
        leaves = [x for x in wanted if x is not None]
        gradients = iter(torch.autograd.grad(outputs, leaves, weights, create_graph=True, allow_unused=True))
        return None, None, None, *(None if x is None else next(gradients) for x in wanted)


def _backward(task: Task, cotangents: Sequence[Tensor | None], wanted: bool) -> tuple[Tensor | None, ...]:
    """Derivatives by position, direction and path, if wanted, and by the table."""
    *rays, table = task.inputs
    cotangents = [None if c is None else c.contiguous() for c in cotangents]
    by_rays = [torch.empty_like(x) if wanted and x is not None else None for x in rays]
    call = _call(task)
    call.cotangents, call.by_rays = _pointers(*cotangents), _pointers(*by_rays)
    total = np.zeros((call.rows, call.numbers))
    call.by_numbers = total.ctypes.data
    _run("backward", call, table)
    return *by_rays, torch.from_numpy(total).to(table.dtype)


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


def push(task: Task, changes: Tensor, start: Changes | None = None, *, everywhere: bool = False) -> Pushed:
    """The rays behind the last surface, and how they change with the table and with the rays before the first.

    changes: (V, rows, K), that of the table for each of V variables; start: those of the rays before the first surface,
    or None where these rays stay. A lost ray does not change.
    everywhere: the same behind each of the K rows of the structure, with a first axis more: position (3, K, ...), opl
    and valid (K, ...), by_position (3, K, V, ...). V may be 0. A ray is valid up to where it is lost.
    """
    position, direction, opl, table = task.inputs
    pages = (len(task.structure.layout),) if everywhere else ()
    call = _call(task)
    changes, shape = changes.contiguous(), task.valid.shape
    call.changes, call.change, call.everywhere = len(changes), changes.data_ptr(), everywhere
    end = Pushed(
        position.new_empty((3, *pages, *shape)),
        direction.new_empty((3, *pages, *shape)),
        None if opl is None else opl.new_empty((*pages, *shape)),
        task.valid.new_empty((*pages, *shape)),
        changes.new_empty((3, *pages, len(changes), *shape)),
        changes.new_empty((3, *pages, len(changes), *shape)),
        None if opl is None else changes.new_empty((*pages, len(changes), *shape)),
    )
    call.rays_out, call.valid_out = _pointers(end.position, end.direction, end.opl), end.valid.data_ptr()
    call.changed = _pointers(end.by_position, end.by_direction, end.by_opl)
    if start is not None:
        contiguous = [None if part is None else part.contiguous() for part in start]
        call.at_start = _pointers(*contiguous)
    _run("tangents", call, table)
    return end


def moved(task: Task) -> Rays:
    """The rays behind the last surface with their derivatives by the variables that rays or table carry."""
    count = next(len(part.tangents) for part in task.inputs if isinstance(part, MovingTensor))
    position, direction, opl, table = task.inputs
    start = None
    if any(isinstance(part, MovingTensor) for part in (position, direction, opl)):
        by_position, by_direction = (tangents_of(part, count).movedim(1, 0) for part in (position, direction))
        start = by_position, by_direction, None if opl is None else tangents_of(opl, count)
    inputs = value_of(position), value_of(direction), None if opl is None else value_of(opl), value_of(table)
    end = push(Task(task.structure, task.valid, inputs), tangents_of(table, count), start)
    return Rays(
        with_tangents(end.position, end.by_position.movedim(1, 0)),
        with_tangents(end.direction, end.by_direction.movedim(1, 0)),
        end.valid,
        None if end.opl is None or end.by_opl is None else with_tangents(end.opl, end.by_opl),
    )


def _call(task: Task) -> _Call:
    structure, valid, (position, direction, opl, table) = task
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


def _pointers(position: Tensor | None, direction: Tensor | None, opl: Tensor | None) -> ctypes.Array:
    parts = [None if t is None else t.data_ptr() + i * (t.nbytes // 3) for t in (position, direction) for i in range(3)]
    return (ctypes.c_void_p * 7)(*parts, None if opl is None else opl.data_ptr())


def _run(name: str, call: _Call, table: Tensor) -> None:
    """Call the compiled code, in torch's threads where the work is worth them."""
    function = getattr(library(), f"raytrace_{name}_{'float' if table.dtype == torch.float32 else 'double'}")
    work = call.rows * call.rays * call.surfaces
    function(ctypes.byref(call), min(torch.get_num_threads(), 1 + work // _WORTH_A_THREAD))
