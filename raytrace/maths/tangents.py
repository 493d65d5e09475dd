"""Tensors that carry their derivatives by n variables: vector forward mode, in one pass through any code of torch.

    x = with_tangents(value, tangents)      value (...), tangents (n, ...)
    y = torch.sqrt(x * x + 1)               tangents_of(y)  (n, ...): ∂y/∂v of all n variables

A function of torch acts on the values, and its differential on the tangents of all variables at once, so that formulas
of optics stand once, on tensors, and derivatives by the numbers of a lens take one pass. Functions without a row in
RULES are differentiated by torch's own forward mode, with the same result in more time. Under `torch.no_grad()` and in
`values_alone()` results carry no tangents, as they have no graph.

Source: Griewank & Walther, Evaluating Derivatives, 2008, ch. 3 (vector forward mode).
"""

import contextlib
import contextvars
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NoReturn, TypeAlias

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import Number, plain_functions

#: Axes of a reduction.
Axes: TypeAlias = int | tuple[int, ...] | list[int]

_stopped: contextvars.ContextVar[bool] = contextvars.ContextVar("stopped", default=False)


class MovingTensor(Tensor):
    """A tensor (...) with `tangents` (n, ...), its derivatives by n variables."""

    tangents: Tensor

    # Those of the tangents; torch reads them without `__torch_function__`.
    shape = property(lambda self: self.tangents.shape[1:])
    dtype = property(lambda self: self.tangents.dtype)
    device = property(lambda self: self.tangents.device)
    ndim = property(lambda self: self.tangents.dim() - 1)

    def dim(self) -> int:
        return self.tangents.dim() - 1

    def is_floating_point(self) -> bool:
        return self.tangents.is_floating_point()

    @classmethod
    def __torch_function__(
        cls, function: Callable, types: object, arguments: tuple = (), options: dict | None = None
    ) -> Any:
        options = options or {}
        with plain_functions():
            if _stopped.get() or not torch.is_grad_enabled():
                return _values(function(*arguments, **options))
            rule = RULES.get(function)
            return _by_torch(function, arguments, options) if rule is None else rule(*arguments, **options)

    def __repr__(self, *, tensor_contents: object = None) -> str:  # type: ignore[override]  # untyped in torch
        with plain_functions():
            return f"{self.as_subclass(Tensor)!r} with derivatives by {len(self.tangents)} variables"


Several: TypeAlias = tuple[MovingTensor, ...]


def with_tangents(value: Tensor, tangents: Tensor) -> MovingTensor:
    """The tensor (...) with derivatives (n, ...) by n variables."""
    moving = value.as_subclass(MovingTensor)
    moving.tangents = tangents
    return moving


def tangents_of(number: Tensor, count: int) -> Tensor:
    """The derivatives (n, ...) of a tensor (...) by `count` variables; 0 where it carries none."""
    return number.tangents if isinstance(number, MovingTensor) else number.new_zeros(count, *number.shape)


def value_of(number: Tensor) -> Tensor:
    """The tensor without its derivatives by variables."""
    if not isinstance(number, MovingTensor):
        return number
    with plain_functions():
        return number.as_subclass(Tensor)


@contextlib.contextmanager
def values_alone() -> Iterator[None]:
    """Within the block, results carry no derivatives by variables: for searches whose steps are not differentiated."""
    token = _stopped.set(True)
    try:
        yield
    finally:
        _stopped.reset(token)


def are_values_alone() -> bool:
    """Whether results carry no derivatives by variables, as within `values_alone`."""
    return _stopped.get()


def _values(result: Any) -> Any:
    """The result of a function without tangents."""
    if isinstance(result, MovingTensor):
        return result.as_subclass(Tensor)
    if isinstance(result, (tuple, list)) and any(isinstance(entry, MovingTensor) for entry in result):
        return type(result)(map(_values, result))
    return result


# -- rules -------------------------------------------------------------------------------------------------------------


def _under(tangents: Tensor, dim: int) -> Tensor:
    """Tangents (n, ...) with `dim` axes behind the first, for values of `dim` axes."""
    missing = dim + 1 - tangents.dim()
    return tangents.reshape(len(tangents), *(1,) * missing, *tangents.shape[1:]) if missing > 0 else tangents


def _full(tangents: Tensor, value: Tensor) -> Tensor:
    """Tangents with all axes of the value."""
    shape = len(tangents), *value.shape
    return tangents if tangents.shape == shape else _under(tangents, value.dim()).expand(shape)


def _sum(value: Tensor, parts: Iterable[tuple[Number, Number]]) -> MovingTensor:
    """The value with tangents Σ dx ∂y/∂x of parts (x, ∂y/∂x), one of which at least has tangents; ∂y/∂x None: 1."""
    total: Any = None
    for x, slope in parts:
        if not isinstance(x, MovingTensor):
            continue
        tangents = _under(x.tangents, value.dim())
        if total is None:
            total = tangents if slope is None else tangents * slope
        elif isinstance(slope, Tensor):
            total = torch.addcmul(total, tangents, slope)
        else:
            total = torch.add(total, tangents, alpha=1 if slope is None else slope)
    return with_tangents(value, _full(total, value))


def _add(a: Number, b: Number, *, alpha: float = 1) -> MovingTensor:
    return _sum(torch.add(a, b, alpha=alpha), ((a, None), (b, None if alpha == 1 else alpha)))


def _subtract(a: Number, b: Number, *, alpha: float = 1) -> MovingTensor:
    return _sum(torch.sub(a, b, alpha=alpha), ((a, None), (b, -alpha)))


def _multiply(a: Number, b: Number) -> MovingTensor:
    return _sum(a * b, ((a, b), (b, a)))


def _divide(a: Number, b: Number, *, rounding_mode: str | None = None) -> Tensor:
    if rounding_mode is not None:
        return torch.div(a, b, rounding_mode=rounding_mode)
    ratio = a / b
    inverse = 1 / b
    return _sum(ratio, ((a, inverse), (b, -ratio * inverse)))


def _power(x: Number, exponent: Number) -> MovingTensor:
    value = torch.pow(x, exponent)
    by_x = exponent * torch.pow(x, exponent - 1) if isinstance(x, MovingTensor) else None
    by_exponent = (
        value * (torch.log(x) if isinstance(x, Tensor) else math.log(x)) if isinstance(exponent, MovingTensor) else None
    )
    return _sum(value, ((x, by_x), (exponent, by_exponent)))


def _add_product(x: Tensor, a: Tensor, b: Tensor, *, value: float = 1) -> MovingTensor:
    by_a, by_b = (b, a) if value == 1 else (value * b, value * a)
    return _sum(torch.addcmul(x, a, b, value=value), ((x, None), (a, by_a), (b, by_b)))


def _angle(y: Tensor, x: Tensor) -> MovingTensor:
    square = x * x + y * y
    return _sum(torch.atan2(y, x), ((y, x / square), (x, -y / square)))


def _signed(x: Tensor, sign: Number) -> Tensor:
    """The rule of |x| with the sign of another number, which changes the result in jumps alone."""
    value = torch.copysign(x, sign)
    return _sum(value, ((x, torch.sign(x) * torch.sign(value)),)) if isinstance(x, MovingTensor) else value


def _length_of_two(a: Tensor, b: Tensor) -> MovingTensor:
    length = torch.hypot(a, b)
    safe = torch.where(length == 0, torch.ones_like(length), length)
    return _sum(length, ((a, a / safe), (b, b / safe)))


def _extreme(function: Callable) -> Callable:
    """The larger or smaller of two; equal ones have half of the derivative each, as in torch."""

    def rule(a: Tensor, b: Tensor) -> MovingTensor:
        value = function(a, b)
        share = torch.where(a == b, 0.5, (a == value).to(value.dtype))
        return _sum(value, ((a, share), (b, 1 - share)))

    return rule


def _where(condition: Tensor, a: Number, b: Number) -> MovingTensor:
    value = torch.where(condition, a, b)
    count = next(len(x.tangents) for x in (a, b) if isinstance(x, MovingTensor))
    moved_a, moved_b = (_under(x.tangents, value.dim()) if isinstance(x, MovingTensor) else 0.0 for x in (a, b))
    chosen = torch.where(condition, moved_a, moved_b)
    return with_tangents(
        value, chosen.expand(count, *value.shape) if chosen.dim() <= value.dim() else _full(chosen, value)
    )


def _complex(real: Tensor, imaginary: Tensor) -> MovingTensor:
    value = torch.complex(real, imaginary)
    count = next(len(x.tangents) for x in (real, imaginary) if isinstance(x, MovingTensor))
    parts = [_full(tangents_of(x, count), value) for x in (real, imaginary)]
    return with_tangents(value, torch.complex(*parts))


def _contracted(equation: str, *operands: Any) -> Tensor:
    """The rule of einsum: multilinear, an axis of variables goes with each operand in turn."""
    operands = tuple(operands[0]) if len(operands) == 1 and isinstance(operands[0], (list, tuple)) else operands
    terms, arrow, result = equation.replace(" ", "").partition("->")
    if not arrow:
        return _by_torch(torch.einsum, (equation, *operands), {})
    letter = next(c for c in "zyxwvutsrqponmlkjihgfedcba" if c not in equation)
    values: list[Tensor] = [*map(_values, operands)]
    total: Number = 0.0
    for place, operand in enumerate(operands):
        if isinstance(operand, MovingTensor):
            each = [*terms.split(",")]
            each[place] = letter + each[place]
            moved = [*values[:place], operand.tangents, *values[place + 1 :]]
            total = total + torch.einsum(f"{','.join(each)}->{letter}{result}", *moved)
    return with_tangents(torch.einsum(equation, *values), total)


def _absolute(x: MovingTensor) -> Tensor:
    return _by_torch(torch.abs, (x,), {}) if x.tangents.is_complex() else _through(torch.abs, _UNARY["abs"])(x)


def _transformed(function: Callable) -> Callable:
    """The rule of a Fourier transform of torch.fft, linear, over axes counted from the last by default."""

    def rule(x: MovingTensor, n: Any = None, dim: Any = None, norm: str | None = None, **options: Any) -> MovingTensor:
        last = "s" if function.__name__.endswith(("2", "n")) else "n"
        axes = {} if dim is None else {"dim": dim}
        if dim is None and function.__name__.endswith("n"):
            axes = {"dim": tuple(range(-(x.tangents.dim() - 1), 0))}
        moved = {key: _shifted(value) for key, value in axes.items()}
        options |= {last: options.pop("s", n), "norm": norm}
        return with_tangents(
            function(x.as_subclass(Tensor), **options, **axes), function(x.tangents, **options, **moved)
        )

    return rule


def _through(function: Callable, slope: Callable[[Tensor, Tensor], Number]) -> Callable:
    """The rule of a function of one tensor; slope(x, y): its derivative."""

    def rule(x: MovingTensor, **options: Any) -> MovingTensor:
        value = function(x, **options)
        return with_tangents(value, x.tangents * slope(_values(x), value))

    return rule


def _clamped(x: MovingTensor, min: Number = None, max: Number = None) -> Tensor:
    value = torch.clamp(x, min, max)
    if isinstance(min, MovingTensor) or isinstance(max, MovingTensor):
        return _by_torch(torch.clamp, (x, min, max), {})
    return with_tangents(value, x.tangents * (value == x))


def _shifted(dim: Any) -> Any:
    """Axes of values as axes of tangents."""
    if isinstance(dim, (tuple, list)):
        return type(dim)(map(_shifted, dim))
    return dim + 1 if dim >= 0 else dim


def _linear(function: Callable, *, axes: Sequence[str] = ("dim",), first: int | None = None) -> Callable:
    """The rule of a linear function of one tensor: the same of the tangents, whose axes are moved by one.

    axes: names of options that are axes; first: the place of the first argument that is one, all behind it are, too.
    """

    def rule(x: MovingTensor, *arguments: Any, **options: Any) -> MovingTensor | Several:
        value = function(x, *arguments, **options)
        shifted = arguments if first is None else (*arguments[:first], *map(_shifted, arguments[first:]))
        moved = {name: _shifted(option) if name in axes else option for name, option in options.items()}
        tangents = function(x.tangents, *shifted, **moved)
        if isinstance(value, (tuple, list)):
            return tuple(map(with_tangents, value, tangents))
        return with_tangents(value, tangents)

    return rule


def _shape_of(arguments: tuple) -> tuple[int, ...]:
    return tuple(arguments[0]) if len(arguments) == 1 and not isinstance(arguments[0], int) else arguments


def _reshape(x: MovingTensor, *shape: Any, **options: Any) -> MovingTensor:
    value = x.reshape(*shape, **options)
    return with_tangents(value, x.tangents.reshape(len(x.tangents), *value.shape))


def _expand(x: MovingTensor, *shape: Any, **options: Any) -> MovingTensor:
    value = x.expand(*shape, **options)
    return with_tangents(value, _full(x.tangents, value))


def _split(x: MovingTensor, split_size: Any, dim: int = 0) -> Several:
    parts = zip(torch.split(x, split_size, dim), torch.split(x.tangents, split_size, _shifted(dim)), strict=True)
    return tuple(with_tangents(*part) for part in parts)


def _permuted(x: MovingTensor, dims: tuple[int, ...]) -> MovingTensor:
    count = x.tangents.dim() - 1
    return with_tangents(x.permute(dims), x.tangents.permute(0, *(dim % count + 1 for dim in dims)))


def _finite(x: MovingTensor, *arguments: Any, **options: Any) -> MovingTensor:
    return with_tangents(torch.nan_to_num(x, *arguments, **options), x.tangents * torch.isfinite(x))


def _crossed(a: Tensor, b: Tensor, dim: int = -1) -> MovingTensor:
    """The rule of the vector product along an axis."""
    value = torch.linalg.cross(a, b, dim=dim)
    count = next(len(x.tangents) for x in (a, b) if isinstance(x, MovingTensor))
    (a_by, b_by), axis = (_full(tangents_of(x, count), value) for x in (a, b)), dim % value.dim() + 1
    a, b = (_values(x).expand_as(a_by) for x in (a, b))
    return with_tangents(value, torch.linalg.cross(a_by, b, dim=axis) + torch.linalg.cross(a, b_by, dim=axis))


def _flipped(x: MovingTensor, dims: tuple[int, ...]) -> MovingTensor:
    return with_tangents(x.flip(dims), x.tangents.flip(_shifted(dims)))


def _flatten(x: MovingTensor, start_dim: int = 0, end_dim: int = -1) -> MovingTensor:
    value = x.flatten(start_dim, end_dim)
    return with_tangents(value, x.tangents.reshape(len(x.tangents), *value.shape))


def _unbind(x: MovingTensor, dim: int = 0) -> Several:
    values, tangents = x.unbind(dim), x.tangents.unbind(_shifted(dim))
    return tuple(map(with_tangents, values, tangents))


def _reduced(function: Callable) -> Callable:
    """The rule of sum and mean, over all axes without `dim`."""

    def rule(
        x: MovingTensor, dim: Axes | None = None, keepdim: bool = False, *, dtype: torch.dtype | None = None
    ) -> MovingTensor:
        value = function(x, dtype=dtype) if dim is None else function(x, dim, keepdim, dtype=dtype)
        axes = (dim,) if isinstance(dim, int) else tuple(dim or range(x.dim()))
        return with_tangents(value, function(x.tangents, _shifted(axes), keepdim, dtype=dtype) if axes else x.tangents)

    return rule


def _cumulated(x: MovingTensor, dim: int, *, dtype: torch.dtype | None = None) -> MovingTensor:
    return with_tangents(x.cumsum(dim, dtype=dtype), x.tangents.cumsum(_shifted(dim), dtype=dtype))


def _joined(function: Callable) -> Callable:
    """The rule of `stack` and `cat`."""

    def rule(tensors: Sequence[Tensor], dim: int = 0) -> MovingTensor:
        tensors = list(tensors)
        value = function(tensors, dim)
        count = next(len(x.tangents) for x in tensors if isinstance(x, MovingTensor))
        return with_tangents(value, function([tangents_of(x, count) for x in tensors], _shifted(dim)))

    return rule


def _broadcast(*tensors: Any) -> tuple[Tensor, ...]:
    tensors = tuple(tensors[0]) if len(tensors) == 1 and not isinstance(tensors[0], Tensor) else tensors
    values = torch.broadcast_tensors(*tensors)
    return tuple(
        with_tangents(value, _full(x.tangents, value)) if isinstance(x, MovingTensor) else _values(value)
        for x, value in zip(tensors, values, strict=True)
    )


def _entries(x: Tensor, place: Any) -> Tensor:
    if not isinstance(x, MovingTensor):
        return _values(x[_values(place)])
    place = place if isinstance(place, tuple) else (place,)
    return with_tangents(x[place], x.tangents[(slice(None), *place)])


def _converted(x: MovingTensor, *arguments: Any, **options: Any) -> Tensor:
    value = x.to(*arguments, **options)
    if not _is_continuous(value):
        return value
    return with_tangents(value, x.tangents.to(dtype=value.dtype, device=value.device))


def _copied(x: Tensor, dim: int, index: Tensor, source: Tensor) -> MovingTensor:
    """The rule of index_copy."""
    value = torch.index_copy(x, dim, index, source)
    count = next(len(part.tangents) for part in (x, source) if isinstance(part, MovingTensor))
    moved = torch.index_copy(tangents_of(x, count), _shifted(dim), index, tangents_of(source, count))
    return with_tangents(value, moved)


def _gathered(x: Tensor, dim: int, index: Tensor) -> Tensor:
    if not isinstance(x, MovingTensor):
        return torch.gather(x, dim, _values(index))
    value = torch.gather(x, dim, index)
    places = index.expand(len(x.tangents), *index.shape)
    return with_tangents(value, torch.gather(x.tangents, _shifted(dim), places))


def _chosen_along(function: Callable) -> Callable:
    """The rule of amax and amin over axes: the mean of the derivatives of all entries equal to it, as in torch."""

    def rule(x: MovingTensor, dim: Axes = (), keepdim: bool = False) -> MovingTensor:
        value = function(x, dim, keepdim)
        dim = tuple(range(x.dim())) if dim == () else (dim,) if isinstance(dim, int) else tuple(dim)
        kept = function(x, dim, True)
        is_it = (_values(x) == kept).to(value.dtype)
        share = is_it / is_it.sum(dim, True)
        return with_tangents(value, (x.tangents * share).sum(_shifted(dim), keepdim) if x.dim() else x.tangents)

    return rule


def _chosen(function: Callable) -> Callable:
    """The rule of max and min: of one tensor, along an axis, or of two tensors."""

    def rule(x: MovingTensor, *arguments: Any, **options: Any) -> Tensor | Several:
        if not arguments and not options:
            return _chosen_along(torch.amax if function is torch.max else torch.amin)(x)
        if arguments and isinstance(arguments[0], Tensor):
            return _extreme(torch.maximum if function is torch.max else torch.minimum)(x, arguments[0])
        result = function(x, *arguments, **options)
        dim = options.get("dim", arguments[0] if arguments else None)
        keepdim = options.get("keepdim", arguments[1] if len(arguments) > 1 else False)
        places = result.indices if keepdim else result.indices.unsqueeze(dim)
        tangents = torch.gather(x.tangents, _shifted(dim), places.expand(len(x.tangents), *places.shape))
        return type(result)(
            (with_tangents(result.values, tangents if keepdim else tangents.squeeze(_shifted(dim))), result.indices)
        )

    return rule


def _norm(x: MovingTensor, ord: Any = 2, dim: Axes | None = None, keepdim: bool = False, **options: Any) -> Tensor:
    if ord not in (2, None) or dim is None:
        return _by_torch(torch.linalg.vector_norm, (x, ord, dim, keepdim), options)
    length = torch.linalg.vector_norm(x, 2, dim, True)
    safe = torch.where(length == 0, torch.ones_like(length), length)
    dim = (dim,) if isinstance(dim, int) else tuple(dim)
    moved = (x.tangents * (x / safe)).sum(_shifted(dim), keepdim)
    return with_tangents(torch.linalg.vector_norm(x, 2, dim, keepdim), moved)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """a @ b of matrices, or of batches of them."""
    value = a @ b
    if a.dim() < 2 or b.dim() < 2:
        return _by_torch(torch.matmul, (a, b), {})
    total: Number = 0.0
    if isinstance(a, MovingTensor):
        total = total + _under(a.tangents, value.dim()) @ _values(b)
    if isinstance(b, MovingTensor):
        total = total + _values(a) @ _under(b.tangents, value.dim())
    return with_tangents(value, total)


def _by_torch(function: Callable, arguments: tuple, options: dict) -> Any:
    """By torch's forward derivatives, one for each variable; of functions without derivatives their values alone."""
    name = getattr(function, "__name__", "")
    if (name.endswith("_") and not name.endswith("__")) or name in ("__setitem__", "__set__"):
        raise RuntimeError(f"{name} changes a tensor in place, which then would lose derivatives by variables")
    leaves, form = pytree.tree_flatten((list(arguments), options))
    result = _values(function(*arguments, **options))
    floats = [leaf for leaf in pytree.tree_leaves(result) if isinstance(leaf, Tensor) and _is_continuous(leaf)]
    if not floats:
        return result
    moving = [place for place, leaf in enumerate(leaves) if isinstance(leaf, MovingTensor)]
    if not moving or _stopped.get() or not torch.is_grad_enabled():
        return result
    slopes = []
    for k in range(len(leaves[moving[0]].tangents)):
        with forward_ad.dual_level():
            given = [*map(_values, leaves)]
            for place in moving:
                given[place] = forward_ad.make_dual(given[place], leaves[place].tangents[k].contiguous())
            positional, by_name = pytree.tree_unflatten(given, form)
            slopes.append(pytree.tree_map_only(Tensor, _forward_derivative, function(*positional, **by_name)))
    flat, tree = pytree.tree_flatten(result)
    columns = zip(*map(pytree.tree_leaves, slopes), strict=True)
    parts = [
        with_tangents(value, torch.stack(column)) if _is_continuous(value) else value
        for value, column in zip(flat, columns, strict=True)
    ]
    return pytree.tree_unflatten(parts, tree)


def _is_continuous(number: Tensor) -> bool:
    return number.is_floating_point() or number.is_complex()


def _gradient(
    outputs: Tensor | Sequence[Tensor],
    inputs: Tensor | Sequence[Tensor],
    grad_outputs: Tensor | Sequence[Tensor | None] | None = None,
    retain_graph: bool | None = None,
    create_graph: bool = False,
    **options: Any,
) -> tuple[MovingTensor | None, ...]:
    """The rule of `torch.autograd.grad`: the gradients of the values, whose tangents are the gradients of tangents."""
    outputs = (outputs,) if isinstance(outputs, Tensor) else tuple(outputs)
    shared = [grad_outputs] if isinstance(grad_outputs, Tensor) else grad_outputs
    weights = [None] * len(outputs) if shared is None else [*shared]
    count = next(len(x.tangents) for x in (*outputs, *weights) if isinstance(x, MovingTensor))
    how = {**options, "retain_graph": True, "create_graph": create_graph, "allow_unused": True}
    values = torch.autograd.grad([*map(_values, outputs)], inputs, [*map(_values, weights)], **how)
    columns: list[Sequence[Tensor | None]] = []
    for k in range(count):
        terms = [(tangents_of(output, count)[k], _values(w)) for output, w in zip(outputs, weights, strict=True)]
        terms += [
            (_values(output), w.tangents[k])
            for output, w in zip(outputs, weights, strict=True)
            if isinstance(w, MovingTensor)
        ]
        terms = [(term, w) for term, w in terms if term.requires_grad]
        if terms:
            moved, shares = zip(*terms, strict=True)
            columns.append(torch.autograd.grad(moved, inputs, shares, **how))
        else:
            columns.append([None] * len(values))
    return tuple(
        None
        if value is None
        else with_tangents(value, torch.stack([torch.zeros_like(value) if t is None else t for t in tangents]))
        for value, tangents in zip(values, zip(*columns, strict=True), strict=True)
    )


def _forward_derivative(number: Tensor) -> Tensor:
    """The forward derivative that a tensor carries."""
    tangent = forward_ad.unpack_dual(number).tangent
    return torch.zeros_like(number) if tangent is None else tangent.clone()


def applied(function: type[torch.autograd.Function], *arguments: Any, slopes: Callable | None = None) -> Any:
    """The result of a torch.autograd.Function, with tangents where its arguments have them.

    slopes(*arguments): the derivatives by the first arguments of a function that acts entry by entry; without them, the
    function needs a `jvp`.
    """
    if not any(isinstance(argument, MovingTensor) for argument in arguments):
        return function.apply(*arguments)
    with plain_functions():
        if slopes is None or not torch.is_grad_enabled():
            return _by_torch(function.apply, arguments, {})
        values = [*map(_values, arguments)]
        return _sum(function.apply(*values), [*zip(arguments, slopes(*values), strict=False)])


def _no_array(x: Tensor, *arguments: object, **options: object) -> NoReturn:
    raise RuntimeError("a tensor with derivatives by variables has no array: its numbers are those of x.detach()")


def _constant(function: Callable) -> Callable:
    """The rule of functions whose result does not depend on the entries, or is outside of the graph."""
    return lambda *arguments, **options: _values(function(*arguments, **options))


_UNARY = {
    "sqrt": lambda x, y: 0.5 / y,
    "rsqrt": lambda x, y: -0.5 * y / x,
    "square": lambda x, y: 2 * x,
    "reciprocal": lambda x, y: -y * y,
    "neg": lambda x, y: -1.0,
    "abs": lambda x, y: torch.sign(x),
    "exp": lambda x, y: y,
    "log": lambda x, y: 1 / x,
    "log10": lambda x, y: 1 / (x * math.log(10)),
    "sin": lambda x, y: torch.cos(x),
    "cos": lambda x, y: -torch.sin(x),
    "tan": lambda x, y: 1 + y * y,
    "asin": lambda x, y: torch.rsqrt(1 - x * x),
    "acos": lambda x, y: -torch.rsqrt(1 - x * x),
    "atan": lambda x, y: 1 / (1 + x * x),
    "sinh": lambda x, y: torch.cosh(x),
    "cosh": lambda x, y: torch.sinh(x),
    "tanh": lambda x, y: 1 - y * y,
    "erf": lambda x, y: 2 / math.sqrt(math.pi) * torch.exp(-x * x),
    "deg2rad": lambda x, y: math.pi / 180,
    "rad2deg": lambda x, y: 180 / math.pi,
}

_MOVES = {
    "unsqueeze": 0,
    "squeeze": 0,
    "movedim": 0,
    "transpose": 0,
    "swapaxes": 0,
    "narrow": 0,
    "select": 0,
    "diff": 1,
    "roll": 1,
}

#: Rules by function of torch: its result with tangents.
RULES: dict[Callable, Callable] = {}


def _functions(*names: str) -> Iterator[Callable]:
    """The functions of torch, of tensors and of torch.linalg that have these names."""
    for name in names:
        for home in (torch, Tensor, torch.linalg):
            if (function := getattr(home, name, None)) is not None:
                yield function


def _getter(name: str) -> Callable:
    """The function that reads a property of tensors."""
    return getattr(Tensor, name).__get__


def _row(names: Sequence[str], rule: Callable, *, of_first: bool = False) -> None:
    """A rule for a function of torch by its names; of_first: of its first argument alone."""
    for function in _functions(*names):
        RULES[function] = _of_first(function, rule) if of_first else rule


def _of_first(function: Callable, rule: Callable) -> Callable:
    """The rule of a function that is differentiable by its first argument; others are sizes and indices."""

    def chosen(x: Tensor, *arguments: Any, **options: Any) -> Any:
        if isinstance(x, MovingTensor):
            return rule(x, *map(_values, arguments), **options)
        return _values(function(x, *map(_values, arguments), **options))

    return chosen


for _name, _slope in _UNARY.items():
    _row([_name], _through(getattr(torch, _name), _slope), of_first=True)
for _name, _first in _MOVES.items():
    _row(
        [_name],
        _linear(getattr(torch, _name), first=_first, axes=("dim", "dim0", "dim1", "source", "destination", "dims")),
    )
_row(["__neg__"], _through(torch.neg, _UNARY["neg"]), of_first=True)
_row(["abs", "__abs__", "absolute"], _absolute, of_first=True)
_row(["add", "__add__", "__radd__"], _add)
_row(["sub", "subtract", "__sub__"], _subtract)
_row(["__rsub__", "rsub"], lambda a, b: _subtract(b, a) if isinstance(b, Tensor) else _sum(b - a, ((a, -1.0),)))
_row(["mul", "multiply", "__mul__", "__rmul__"], _multiply)
_row(["div", "divide", "true_divide", "__truediv__", "__div__"], _divide)
_row(["__rtruediv__", "__rdiv__"], lambda a, b: _divide(b, a))
_row(["pow", "__pow__"], _power)
_row(["flip"], lambda x, *dims: _flipped(x, _shape_of(dims)), of_first=True)
_row(["__rpow__"], lambda a, b: _power(b, a))
_row(["addcmul"], _add_product)
_row(["atan2", "arctan2"], _angle)
_row(["hypot"], _length_of_two)
_row(["copysign"], _signed)
_row(["maximum"], _extreme(torch.maximum))
_row(["minimum"], _extreme(torch.minimum))
_row(["max"], _chosen(torch.max))
_row(["min"], _chosen(torch.min))
_row(["amax"], _chosen_along(torch.amax), of_first=True)
_row(["amin"], _chosen_along(torch.amin), of_first=True)
_row(["clamp", "clip"], _clamped)
_row(["clamp_min"], lambda x, min: _clamped(x, min=min))
_row(["clamp_max"], lambda x, max: _clamped(x, max=max))
_row(["reshape", "view"], _reshape, of_first=True)
_row(["expand", "broadcast_to"], _expand, of_first=True)
_row(["split"], _split, of_first=True)
_row(
    ["index_select"],
    lambda x, dim, index: with_tangents(
        torch.index_select(x, dim, index), torch.index_select(x.tangents, _shifted(dim), index)
    ),
    of_first=True,
)
_row(["permute"], lambda x, *dims: _permuted(x, _shape_of(dims)), of_first=True)
_row(["nan_to_num"], _finite, of_first=True)
_row(["cross"], _crossed)
_row(["expand_as"], lambda x, other: _expand(x, other.shape) if isinstance(x, MovingTensor) else x.expand(other.shape))
_row(["flatten"], _flatten, of_first=True)
_row(["unbind"], _unbind, of_first=True)
_row(["stack"], _joined(torch.stack))
_row(["cat", "concatenate", "concat"], _joined(torch.cat))
_row(["broadcast_tensors"], _broadcast)
_row(["sum"], _reduced(torch.sum), of_first=True)
_row(["mean"], _reduced(torch.mean), of_first=True)
_row(["cumsum"], _cumulated, of_first=True)
_row(["gather"], _gathered)
_row(["index_copy"], _copied)
_row(["vector_norm"], _norm)
_row(["matmul", "__matmul__"], _product)
_row(["__getitem__"], _entries)
_row(["to"], _converted, of_first=True)
_row(["double"], lambda x: _converted(x, torch.float64), of_first=True)
_row(["float"], lambda x: _converted(x, torch.float32), of_first=True)
_row(["clone", "contiguous"], lambda x, **options: with_tangents(x.clone(), x.tangents))
_row(["detach"], lambda x: x.as_subclass(Tensor).detach())
for _function in _functions(
    *(
        "gt",
        "lt",
        "ge",
        "le",
        "eq",
        "ne",
        "__gt__",
        "__lt__",
        "__ge__",
        "__le__",
        "__eq__",
        "__ne__",
        "greater",
        "less",
    ),
    *("isfinite", "isnan", "isinf", "isclose", "allclose", "equal", "any", "all", "argmax", "argmin", "argsort"),
    *("item", "tolist", "__bool__", "__float__", "__int__", "__len__", "numel", "nelement", "size", "stride"),
    *("is_contiguous", "element_size", "is_complex", "searchsorted", "bucketize", "nonzero"),
    *("zeros_like", "ones_like", "full_like", "empty_like", "new_zeros", "new_ones", "new_tensor", "new_full"),
    *("new_empty", "sign", "floor", "ceil", "round", "trunc", "heaviside"),
):
    RULES[_function] = _constant(_function)
for _property in ("requires_grad", "grad_fn", "is_leaf", "is_meta", "is_cuda", "layout", "is_sparse", "is_quantized"):
    RULES[_getter(_property)] = _constant(_getter(_property))
for _name in ("fft", "ifft", "rfft", "irfft", "fft2", "ifft2", "rfft2", "irfft2", "fftn", "ifftn"):
    RULES[getattr(torch.fft, _name)] = _of_first(getattr(torch.fft, _name), _transformed(getattr(torch.fft, _name)))
for _name in ("fftshift", "ifftshift"):
    _function = getattr(torch.fft, _name)
    RULES[_function] = _of_first(_function, _linear(_function, axes=("dim",), first=0))
for _function in (
    torch.real,
    torch.imag,
    torch.conj,
    _getter("real"),
    _getter("imag"),
    Tensor.conj,
    torch.view_as_real,
    torch.view_as_complex,
):
    RULES[_function] = _linear(_function)
RULES[torch.complex], RULES[torch.einsum] = _complex, _contracted
RULES[torch.autograd.grad] = _gradient
RULES[_getter("data")] = _constant(_getter("data"))
RULES[Tensor.numpy] = RULES[Tensor.__array__] = RULES[Tensor.data_ptr] = _no_array
RULES[torch.functional.broadcast_tensors] = _broadcast
RULES[torch.where] = _where
RULES[Tensor.where] = lambda x, condition, other: _where(condition, x, other)
RULES[Tensor.unflatten] = lambda x, dim, sizes: _reshape(x, x.as_subclass(Tensor).unflatten(dim, sizes).shape)
RULES[_getter("T")] = lambda x: with_tangents(
    x.as_subclass(Tensor).T,
    x.tangents.movedim(tuple(range(1, x.tangents.dim())), tuple(range(x.tangents.dim() - 1, 0, -1))),
)
RULES[_getter("mT")] = lambda x: with_tangents(x.as_subclass(Tensor).mT, x.tangents.mT)
