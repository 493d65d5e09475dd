"""Numbers: arithmetic that stays finite, dual numbers, and values made of tensors.

Safe functions: every argument is made safe *before* the operation, so that value and gradient stay finite.

Dual numbers: a number, or an array, with its derivatives by all variables at once, in numpy.

    (a, a') (b, b') = (a b, a' b + a b')

They serve the many small steps of an optimisation, with too few numbers each for torch to be fast. Operators and
numpy's functions work on dual numbers as on arrays. Source: Clifford 1873; Griewank & Walther, Evaluating Derivatives,
2008, ch. 3 (vector forward mode).

Values: frozen dataclasses of tensors that `torch.func` and `torch.utils._pytree` can walk.

State of torch: whether a graph, a forward derivative or a transform of torch.func is active. Names that are private to
torch occur in this file alone. Nested transforms wrap a tensor once for each; the innermost one shows.
"""

import copy
import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass as value
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeAlias, TypeVar, cast, overload

import numpy as np
import torch
from torch import Tensor
from torch._C._functorch import get_unwrapped
from torch._C._functorch import is_functorch_wrapped_tensor as is_wrapped
from torch.autograd import forward_ad
from torch.utils import _pytree as pytree

#: A number of any type: a tensor, an array, a dual number or a plain number.
Number: TypeAlias = Any

Value = TypeVar("Value")


class Dataclass(Protocol):
    """A value of any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]


F = TypeVar("F", bound=Callable[..., Any])

#: A context in which torch's functions take tensors of a subclass as plain ones.
plain_functions = torch._C.DisableTorchFunctionSubclass


def in_transform() -> bool:
    """Whether a transform of torch.func (`grad`, `vmap`, `jvp` …) is under way."""
    return torch._C._are_functorch_transforms_active()


def in_forward_mode() -> bool:
    """Whether a forward derivative of torch is under way."""
    return getattr(forward_ad, "_current_level", -1) >= 0


def as_tensor(numbers: Any, **like: Any) -> Tensor:
    """A tensor as it is, where `torch.as_tensor` moves one on the processor to a default device; other numbers on it.

    like: dtype of other numbers.
    """
    return numbers if isinstance(numbers, Tensor) else torch.as_tensor(numbers, device="cpu", **like)


def uncompiled(function: F) -> F:
    """A function that `torch.compile` does not enter: a graph ends before it, and the next one begins behind it.

    `torch.compiler.disable` alone imports the compiler, which takes seconds.
    """

    @functools.wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        if torch.compiler.is_dynamo_compiling():
            return torch.compiler.disable(function)(*arguments, **options)
        return function(*arguments, **options)

    return cast(F, call)


def varies(number: object) -> bool:
    """Whether a derivative by this number may be requested: backward, forward, by tangents
    (`maths.tangents`), or by a transform of torch.func.

    Inside nested transforms a tensor shows only the innermost one: any wrapped tensor may vary for an outer one.
    """
    if not isinstance(number, Tensor):
        return False
    if number.requires_grad or hasattr(number, "tangents") or is_wrapped(number):
        return True
    return in_forward_mode() and forward_ad.unpack_dual(number).tangent is not None


def differentiating() -> bool:
    """Whether derivatives may be requested: a graph is recorded, or a forward derivative (`jvp`) is under way.

    False only under `torch.no_grad()` with no forward derivative; then operations for derivatives alone are left out.
    """
    return torch.is_grad_enabled() or in_forward_mode()


def is_any(mask: Tensor) -> bool:
    """Whether any entry of a mask (...) is true; inside `torch.func.vmap`, of any element of its batch.

    A search that ends early then ends when all elements have: `bool(mask.any())` raises an error there.
    """
    while is_wrapped(mask):
        mask = get_unwrapped(mask)
    return bool(mask.any())


def safe_sqrt(x: Tensor) -> Tensor:
    """√x where x > 0, else 0 with gradient 0 (a plain `where` after `sqrt` would leave a NaN gradient)."""
    positive = x > 0
    return torch.where(positive, torch.sqrt(torch.where(positive, x, 1.0)), 0.0)


def safe_divide(numerator: Tensor, denominator: Tensor) -> Tensor:
    """numerator/denominator where the denominator is not 0, else 0 with gradient 0."""
    nonzero = denominator != 0
    return torch.where(nonzero, numerator / torch.where(nonzero, denominator, 1.0), 0.0)


@overload
def dot(a: Tensor | Sequence[Tensor], b: Tensor | Sequence[Tensor]) -> Tensor: ...
@overload
def dot(a: Iterable[Number], b: Iterable[Number]) -> Number: ...
def dot(a: Iterable[Number], b: Iterable[Number]) -> Number:
    """Scalar product over the leading axis of length 3, of tensors or of three dual numbers each.

    Written out, not summed over an axis: a reduction may associate differently in batches of different shape, and
    results must not depend on how rays are batched.
    """
    ax, ay, az = a
    bx, by, bz = b
    return torch.addcmul(ax * bx + ay * by, az, bz) if isinstance(az, Tensor) else ax * bx + ay * by + az * bz


def dot_2(a: Number, b: Number) -> Number:
    """Scalar product over a leading axis of length 2."""
    return a[0] * b[0] + a[1] * b[1]


def with_batch_axes(vector: Tensor, count: int) -> Tensor:
    """The vector (3, ...) with at least `count` batch axes: axes of length 1 are put in behind its components.

    Broadcasting aligns shapes from the right, so that a factor (W, 1) would meet a vector (3, P) at its components.
    """
    missing = count + 1 - vector.dim()
    return vector if missing <= 0 else vector.reshape(vector.shape[0], *(1,) * missing, *vector.shape[1:])


def broadcast_shape(*shapes: Sequence[int]) -> torch.Size:
    """The shape that all shapes broadcast to. Raises ValueError where there is none.

    `torch.broadcast_shapes` is the same, but its first call loads a library of computer algebra: 0.3 s.
    """
    sizes = [1] * max([0, *(len(shape) for shape in shapes)])
    for shape in shapes:
        for place in range(1, len(shape) + 1):
            if shape[-place] != 1:
                if sizes[-place] not in (1, shape[-place]):
                    raise ValueError(f"shapes {', '.join(str(tuple(shape)) for shape in shapes)} do not broadcast")
                sizes[-place] = shape[-place]
    return torch.Size(sizes)


def placed(entries: Tensor, mask: Tensor) -> Tensor:
    """A tensor (..., *mask.shape) with entries (..., K) where the mask (...) is true, in order, and 0 elsewhere."""
    places = mask.flatten().nonzero()[:, 0]
    empty = entries.new_zeros((*entries.shape[:-1], mask.numel()))
    return empty.index_copy(-1, places, entries).unflatten(-1, mask.shape)


def unit(vector: Tensor) -> Tensor:
    """vector/|vector| over the leading axis of length 3; scaled first, so that 1e-200 and 1e200 keep their direction.

    A zero or non-finite vector gives zeros, without nan.
    """
    largest = vector.detach().abs().amax(0)
    usable = (largest > 0) & (largest < torch.inf)
    scaled = torch.where(usable, vector, 0.0) / torch.where(usable, largest, 1.0)
    norm = torch.sqrt(torch.where(usable, dot(scaled, scaled), 1.0))
    return scaled / norm


@overload
def polynomial(coefficients: Tensor, x: Tensor) -> Tensor: ...
@overload
def polynomial(coefficients: Sequence[Number], x: Number) -> Number: ...
def polynomial(coefficients: Sequence[Number] | Tensor, x: Number) -> Number:
    """Σ_j coefficients[j]·x^j by Horner's rule; `coefficients`: (m, ...), broadcast against `x`, or m dual numbers."""
    if not isinstance(coefficients, Tensor):
        return functools.reduce(lambda total, coefficient: total * x + coefficient, reversed(coefficients), 0.0)
    if len(coefficients) == 0:
        return torch.zeros_like(x)
    *lower, total = coefficients.unbind(0)
    total = total.expand(broadcast_shape(total.shape, x.shape))
    for coefficient in reversed(lower):
        total = torch.addcmul(coefficient, total, x)
    return total


class Dual:
    """value: a number, or an array (...); slope: its derivatives by n variables, n and an axis for each of the value's.

    Axes of the slope behind the first may have length 1 where the derivatives are alike (`full` has them all).
    """

    __slots__ = ("slope", "value")
    __array_priority__ = 1000

    def __init__(self, value: Number, slope: np.ndarray) -> None:
        self.value, self.slope = value, slope

    @property
    def shape(self) -> tuple[int, ...]:
        return np.shape(self.value)

    def __repr__(self) -> str:
        return f"Dual({self.value!r}, {self.slope!r})"

    def full(self) -> np.ndarray:
        """The derivatives (n, ...) in full, with every axis of the value."""
        return np.broadcast_to(_under(self.slope, np.ndim(self.value)), (len(self.slope), *np.shape(self.value)))

    def __add__(self, other: Number) -> "Dual":
        if isinstance(other, Dual):
            return Dual(self.value + other.value, _sum(self, other))
        return Dual(self.value + other, self.slope if np.ndim(other) == 0 else _under(self.slope, _dim(self, other)))

    def __sub__(self, other: Number) -> "Dual":
        if isinstance(other, Dual):
            return Dual(self.value - other.value, _sum(self, -other))
        return Dual(self.value - other, self.slope if np.ndim(other) == 0 else _under(self.slope, _dim(self, other)))

    def __rsub__(self, other: Number) -> "Dual":
        return -self + other

    def __neg__(self) -> "Dual":
        return Dual(-self.value, -self.slope)

    def __mul__(self, other: Number) -> "Dual":
        if isinstance(other, Dual):
            dim = _dim(self, other)
            slope = _under(self.slope, dim) * other.value + _under(other.slope, dim) * self.value
            return Dual(self.value * other.value, slope)
        return Dual(self.value * other, _under(self.slope, _dim(self, other)) * other)

    def __truediv__(self, other: Number) -> "Dual":
        if isinstance(other, Dual):
            dim, ratio = _dim(self, other), self.value / other.value
            return Dual(ratio, (_under(self.slope, dim) - _under(other.slope, dim) * ratio) / other.value)
        return Dual(self.value / other, _under(self.slope, _dim(self, other)) / other)

    def __rtruediv__(self, other: Number) -> "Dual":
        ratio = other / self.value
        return Dual(ratio, _under(self.slope, _dim(self, other)) * (-ratio / self.value))

    def __pow__(self, power: float) -> "Dual":
        return self._through(self.value**power, power * self.value ** (power - 1))

    def __abs__(self) -> "Dual":
        return self._through(np.abs(self.value), np.sign(self.value))

    __radd__, __rmul__ = __add__, __mul__

    def __getitem__(self, place: Any) -> "Dual":
        """Entries of the value by places of its axes; all its derivatives."""
        place = place if isinstance(place, tuple) else (place,)
        return Dual(self.value[place], self.full()[(slice(None), *place)])

    def sum(self, axis: int | tuple[int, ...] | None = None) -> "Dual":
        axes = range(np.ndim(self.value)) if axis is None else (axis,) if isinstance(axis, int) else axis
        behind = tuple(a + 1 if a >= 0 else a for a in axes)
        return Dual(self.value.sum(tuple(axes)), self.full().sum(behind))

    def reshape(self, *shape: int) -> "Dual":
        return Dual(self.value.reshape(shape), self.full().reshape(len(self.slope), *shape))

    def _through(self, value: Number, derivative: Number) -> "Dual":
        return Dual(value, _under(self.slope, np.ndim(value)) * derivative)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Number, **options: object) -> Number:
        if method != "__call__" or options or ufunc not in _UFUNCS:
            return NotImplemented
        return _UFUNCS[ufunc](*inputs)

    def __array_function__(self, function: Callable, types: object, arguments: tuple, options: dict) -> Number:
        if function not in _FUNCTIONS:
            return NotImplemented
        return _FUNCTIONS[function](*arguments, **options)


def value_of(number: Number) -> Number:
    """The value of a number, dual or not."""
    return number.value if isinstance(number, Dual) else number


def slope_of(number: Number, variables: int) -> np.ndarray:
    """The derivatives (n, ...) of a number by n variables; 0 of a number that is not dual."""
    return number.full() if isinstance(number, Dual) else np.zeros((variables, *np.shape(number)))


def quotient(a: Number, b: Number) -> Number:
    """a/b of tensors or numbers; infinite where a number b is 0."""
    return a / b if isinstance(b, Tensor) or value_of(b) != 0 else np.inf


def divide(a: Number, b: Number) -> Number:
    """a/b of tensors, 0 where b is 0; of arrays or dual numbers as numpy divides."""
    return safe_divide(a, b) if isinstance(b, Tensor) else a / b


def select(condition: Tensor | bool, a: Number, b: Number) -> Number:
    """a where a condition holds, else b: entry by entry of tensors, else one or the other number."""
    if not isinstance(condition, Tensor):
        return a if condition else b
    # Of two plain numbers torch.where makes a tensor of 32 bits.
    return torch.where(condition, a, b if isinstance(b, Tensor) else torch.tensor(b, dtype=torch.float64, device="cpu"))


def root(x: Number) -> Number:
    """√x, 0 where x is negative, of a tensor, an array or dual numbers."""
    return safe_sqrt(x) if isinstance(x, Tensor) else np.sqrt(np.maximum(x, 0.0))


class Vector(tuple):
    """Three numbers, arrays or dual numbers with the arithmetic of a tensor (3, ...)."""

    __slots__ = ()
    __array_ufunc__ = None

    def __sub__(self, other: Iterable[Number]) -> "Vector":
        return Vector(a - b for a, b in zip(self, other, strict=True))

    def __mul__(self, factor: Number) -> "Vector":
        return Vector(part * factor for part in self)


def _dim(a: Dual, b: Number) -> int:
    """The number of axes of the sum of a and b."""
    dim = b.slope.ndim - 1 if isinstance(b, Dual) else b.ndim if isinstance(b, np.ndarray) else 0
    return max(a.slope.ndim - 1, dim)


def _under(slope: np.ndarray, dim: int) -> np.ndarray:
    """Derivatives (n, ...) with `dim` axes behind that of the variables."""
    missing = dim + 1 - slope.ndim
    return slope.reshape(len(slope), *(1,) * missing, *slope.shape[1:]) if missing > 0 else slope


def _sum(a: Dual, b: Dual) -> np.ndarray:
    if a.slope.ndim == b.slope.ndim:
        return a.slope + b.slope
    dim = _dim(a, b)
    return _under(a.slope, dim) + _under(b.slope, dim)


def _where(condition: np.ndarray, a: Number, b: Number) -> Number:
    if not (isinstance(a, Dual) or isinstance(b, Dual)):
        return np.where(condition, a, b)
    value = np.where(condition, value_of(a), value_of(b))
    count = len((a if isinstance(a, Dual) else b).slope)
    slope_a, slope_b = (_under(slope_of(x, count), np.ndim(value)) for x in (a, b))
    return Dual(value, np.where(condition, slope_a, slope_b))


def _stack(numbers: Sequence[Number], axis: int = 0) -> Dual:
    count = next(len(x.slope) for x in numbers if isinstance(x, Dual))
    values = np.broadcast_arrays(*[value_of(x) for x in numbers])
    shape = values[0].shape
    slopes = [np.broadcast_to(_under(slope_of(x, count), len(shape)), (count, *shape)) for x in numbers]
    return Dual(np.stack(values, axis), np.stack(slopes, axis + 1 if axis >= 0 else axis))


def _concatenate(numbers: Sequence[Number], axis: int = 0) -> Dual:
    count = next(len(x.slope) for x in numbers if isinstance(x, Dual))
    values, slopes = [value_of(x) for x in numbers], [slope_of(x, count) for x in numbers]
    return Dual(np.concatenate(values, axis), np.concatenate(slopes, axis + 1 if axis >= 0 else axis))


def _larger(a: Number, b: Number) -> Number:
    return _where(value_of(a) >= value_of(b), a, b)


def _smaller(a: Number, b: Number) -> Number:
    return _where(value_of(a) <= value_of(b), a, b)


def _root(x: Dual) -> Dual:
    """√x, with the derivative 0 where x is 0: there the derivative of a length has no direction."""
    root = np.sqrt(x.value)
    return x._through(
        root,
        np.divide(0.5, root, out=np.zeros_like(root), where=root != 0)
        if np.ndim(root)
        else (0.5 / root if root else 0.0),
    )


def _of(function: np.ufunc, derivative: Callable) -> Callable:
    return lambda x: x._through(function(x.value), derivative(x.value))


def _matrix_times(matrix: np.ndarray, vector: Dual) -> Dual:
    return Dual(matrix @ vector.value, vector.full() @ matrix.T)


_UFUNCS: dict[np.ufunc, Callable] = {
    np.matmul: _matrix_times,
    np.add: lambda a, b: b.__radd__(a) if isinstance(b, Dual) and not isinstance(a, Dual) else a + b,
    np.subtract: lambda a, b: b.__rsub__(a) if not isinstance(a, Dual) else a - b,
    np.multiply: lambda a, b: b.__rmul__(a) if not isinstance(a, Dual) else a * b,
    np.true_divide: lambda a, b: b.__rtruediv__(a) if not isinstance(a, Dual) else a / b,
    np.negative: Dual.__neg__,
    np.absolute: Dual.__abs__,
    np.maximum: _larger,
    np.minimum: _smaller,
    np.sqrt: _root,
    np.sin: _of(np.sin, np.cos),
    np.cos: _of(np.cos, lambda x: -np.sin(x)),
    np.tan: _of(np.tan, lambda x: 1 + np.tan(x) ** 2),
    np.arcsin: _of(np.arcsin, lambda x: 1 / np.sqrt(1 - x * x)),
    np.arccos: _of(np.arccos, lambda x: -1 / np.sqrt(1 - x * x)),
    np.arctan: _of(np.arctan, lambda x: 1 / (1 + x * x)),
    np.exp: _of(np.exp, np.exp),
    np.log: _of(np.log, lambda x: 1 / x),
    np.log10: _of(np.log10, lambda x: 1 / (x * np.log(10))),
    np.deg2rad: _of(np.deg2rad, lambda x: np.pi / 180),
    np.rad2deg: _of(np.rad2deg, lambda x: 180 / np.pi),
}

_FUNCTIONS: dict[Callable, Callable] = {np.where: _where, np.stack: _stack, np.concatenate: _concatenate}


_VALUE_TYPES: set[type] = set()


def summary(instance: Dataclass) -> str:
    """A value with its fields that are not None."""
    fields = ((field.name, getattr(instance, field.name)) for field in dataclasses.fields(instance))
    entries = (f"{name}={_summary(item)}" for name, item in fields if item is not None)
    return f"{type(instance).__name__}({', '.join(entries)})"


def _summary(item: object) -> str:
    """The numbers of a tensor of at most nine, shape, type and range of a larger one; the repr of other items."""
    if type(item) is tuple:
        return f"({', '.join(map(_summary, item))}{',' if len(item) == 1 else ''})"
    if not isinstance(item, Tensor) or item.is_meta or is_wrapped(item):
        return repr(item)
    array = item.detach().cpu().resolve_conj()
    if array.numel() <= 9:
        return _listed(array.tolist(), "{:.6g}".format if array.is_floating_point() else str)
    limits = "" if array.is_complex() else " … ".join(f"{float(end):.6g}" for end in array.aminmax())
    return f"<{tuple(array.shape)} {str(array.dtype).removeprefix('torch.')}{limits and ', '}{limits}>"


def _listed(entry: object, form: Callable[[object], str]) -> str:
    """Nested lists of numbers as text."""
    return f"[{', '.join(_listed(part, form) for part in entry)}]" if isinstance(entry, list) else form(entry)


if not TYPE_CHECKING:  # checkers of types see a dataclass, whose fields they know

    def value(cls: type) -> type:
        """Make a class a frozen, slotted dataclass and register it as a pytree.

        Tensors, values and tuples of values are its children; every other field (names, flags, `None`) is structure, so
        that `torch.func.vmap`, `jacfwd` and `tree_map` see only numbers. A tuple of numbers, of a field of the type
        `tuple[float | Tensor, ...]`, is a child where one of them is a tensor. There is no generated `==` (it would
        raise on tensors) and no validation on construction (it would break `vmap`): the public API refuses wrong input.
        `copy.deepcopy` keeps the graph of tensors that have one. A class with a `__repr__` keeps it; others print large
        tensors by shape and range. `torch.load` accepts it: restoring its fields executes nothing.
        """
        if cls.__repr__ is object.__repr__:
            cls.__repr__ = summary
        cls = dataclasses.dataclass(frozen=True, eq=False, slots=True, repr=False)(cls)
        fields = dataclasses.fields(cls)
        numeric = {field.name for field in fields if holds_numbers(field.type)}
        mixed = [field.name for field in fields if _may_hold_tensors(field.type)]

        def flatten(instance):
            items = [(field.name, getattr(instance, field.name)) for field in fields]
            children = {name: item for name, item in items if name in numeric and item is not None}
            for name in mixed:
                if any(isinstance(number, torch.Tensor) for number in getattr(instance, name)):
                    children[name] = getattr(instance, name)
            structure = tuple((name, item) for name, item in items if name not in children)
            return list(children.values()), (tuple(children), structure)

        def unflatten(children, context):
            child_names, structure = context
            return cls(**dict(zip(child_names, children, strict=True)), **dict(structure))

        def deep_copy(instance, memo):
            for leaf in pytree.tree_leaves(instance):
                if isinstance(leaf, torch.Tensor) and not leaf.is_leaf:  # which torch does not copy
                    memo[id(leaf)] = leaf.clone()
            return cls(**{field.name: copy.deepcopy(getattr(instance, field.name), memo) for field in fields})

        cls.__deepcopy__ = deep_copy
        pytree.register_pytree_node(cls, flatten, unflatten, serialized_type_name=f"raytrace.{cls.__name__}")
        _VALUE_TYPES.add(cls)
        torch.serialization.add_safe_globals([cls])
        return cls


def holds_numbers(annotation: object) -> bool:
    """Whether a field of this type holds a tensor, a value or a tuple of values (or None in their place)."""
    if typing.get_origin(annotation) is tuple:
        return typing.get_args(annotation)[0] in _VALUE_TYPES
    if isinstance(annotation, types.UnionType):
        return any(holds_numbers(member) for member in typing.get_args(annotation))
    return annotation is torch.Tensor or annotation in _VALUE_TYPES


def _may_hold_tensors(annotation: object) -> bool:
    """Whether a field of this type is a tuple of numbers, each of which may be a tensor."""
    members = typing.get_args(annotation) if typing.get_origin(annotation) is tuple else ()
    return any(isinstance(member, types.UnionType) and Tensor in typing.get_args(member) for member in members)


def check_precision(dtype: torch.dtype) -> None:
    """Refuse floating-point numbers of 16 bits and fewer: at a millimetre they are 0.5 µm or more apart."""
    if dtype.is_floating_point and torch.finfo(dtype).bits < 32:
        raise ValueError(f"dtype {dtype}: expected torch.float32 or torch.float64; fewer bits resolve no spot or path")


def to(instance: Value, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Value:
    """The same value with every floating-point tensor in it converted to `dtype` and moved to `device`.

    A tensor that occurs in several places (the coefficients of air, say) stays one tensor. Raises ValueError for a
    dtype too coarse for optics (`check_precision`).
    """
    if dtype is not None:
        check_precision(dtype)
    converted: dict[int, torch.Tensor] = {}

    def convert(leaf: object) -> object:
        if not isinstance(leaf, torch.Tensor):
            return leaf
        if id(leaf) not in converted:
            converted[id(leaf)] = leaf.to(device=device, dtype=dtype if leaf.is_floating_point() else None)
        return converted[id(leaf)]

    return pytree.tree_map(convert, instance)


def detached(instance: Value) -> Value:
    """The same value without gradients, to be shown or drawn.

    A tensor that occurs in several places stays one tensor; a value without gradients is returned itself.
    """
    if not any(map(varies, pytree.tree_leaves(instance))):
        return instance
    seen: dict[int, torch.Tensor] = {}

    def plain(leaf: object) -> object:
        return seen.setdefault(id(leaf), leaf.detach()) if isinstance(leaf, torch.Tensor) else leaf

    return pytree.tree_map(plain, instance)
