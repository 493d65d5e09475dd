"""Dual numbers: a number, or an array, with its derivatives by all variables at once, in numpy.

    (a, a') (b, b') = (a b, a' b + a b')

For the many small steps of an optimisation, which are too few numbers each for torch to be fast. Operators and numpy's
functions work on dual numbers as on arrays. Source: Clifford 1873; Griewank & Walther, Evaluating Derivatives, 2008,
ch. 3 (vector forward mode).
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide, safe_sqrt


class Dual:
    """value: a number, or an array (...); slope: its derivatives by n variables, n and an axis for each of the value's.

    Axes of the slope behind the first may have length 1 where the derivatives are alike (`full` has them all).
    """

    __slots__ = ("slope", "value")
    __array_priority__ = 1000

    def __init__(self, value, slope: np.ndarray):
        self.value, self.slope = value, slope

    @property
    def shape(self) -> tuple[int, ...]:
        return np.shape(self.value)

    def __repr__(self) -> str:
        return f"Dual({self.value!r}, {self.slope!r})"

    def full(self) -> np.ndarray:
        """The derivatives (n, ...) in full, with every axis of the value."""
        return np.broadcast_to(_under(self.slope, np.ndim(self.value)), (len(self.slope), *np.shape(self.value)))

    def __add__(self, other):
        if isinstance(other, Dual):
            return Dual(self.value + other.value, _sum(self, other))
        return Dual(self.value + other, self.slope if np.ndim(other) == 0 else _under(self.slope, _dim(self, other)))

    def __sub__(self, other):
        if isinstance(other, Dual):
            return Dual(self.value - other.value, _sum(self, -other))
        return Dual(self.value - other, self.slope if np.ndim(other) == 0 else _under(self.slope, _dim(self, other)))

    def __rsub__(self, other):
        return -self + other

    def __neg__(self):
        return Dual(-self.value, -self.slope)

    def __mul__(self, other):
        if isinstance(other, Dual):
            dim = _dim(self, other)
            slope = _under(self.slope, dim) * other.value + _under(other.slope, dim) * self.value
            return Dual(self.value * other.value, slope)
        return Dual(self.value * other, _under(self.slope, _dim(self, other)) * other)

    def __truediv__(self, other):
        if isinstance(other, Dual):
            dim, ratio = _dim(self, other), self.value / other.value
            return Dual(ratio, (_under(self.slope, dim) - _under(other.slope, dim) * ratio) / other.value)
        return Dual(self.value / other, _under(self.slope, _dim(self, other)) / other)

    def __rtruediv__(self, other):
        ratio = other / self.value
        return Dual(ratio, _under(self.slope, _dim(self, other)) * (-ratio / self.value))

    def __pow__(self, power: float):
        return self._through(self.value**power, power * self.value ** (power - 1))

    def __abs__(self):
        return self._through(np.abs(self.value), np.sign(self.value))

    __radd__, __rmul__ = __add__, __mul__

    def __getitem__(self, place):
        """Entries of the value by places of its axes; all its derivatives."""
        place = place if isinstance(place, tuple) else (place,)
        return Dual(self.value[place], self.full()[(slice(None), *place)])

    def sum(self, axis: int | tuple[int, ...] | None = None):
        axes = range(np.ndim(self.value)) if axis is None else (axis,) if isinstance(axis, int) else axis
        behind = tuple(a + 1 if a >= 0 else a for a in axes)
        return Dual(self.value.sum(tuple(axes)), self.full().sum(behind))

    def reshape(self, *shape: int):
        return Dual(self.value.reshape(shape), self.full().reshape(len(self.slope), *shape))

    def _through(self, value, derivative):
        return Dual(value, _under(self.slope, np.ndim(value)) * derivative)

    def __array_ufunc__(self, ufunc, method, *inputs, **options):
        if method != "__call__" or options or ufunc not in _UFUNCS:
            return NotImplemented
        return _UFUNCS[ufunc](*inputs)

    def __array_function__(self, function, types, arguments, options):
        if function not in _FUNCTIONS:
            return NotImplemented
        return _FUNCTIONS[function](*arguments, **options)


def value_of(number):
    """The value of a number that may be a dual one."""
    return number.value if isinstance(number, Dual) else number


def slope_of(number, variables: int) -> np.ndarray:
    """The derivatives (n, ...) of a number by n variables; 0 where it is no dual one."""
    return number.full() if isinstance(number, Dual) else np.zeros((variables, *np.shape(number)))


def quotient(a, b):
    """a/b of tensors or numbers; infinite where a number b is 0."""
    return a / b if isinstance(b, Tensor) or value_of(b) != 0 else np.inf


def divide(a, b):
    """a/b of tensors, 0 where b is 0; of arrays or dual numbers as numpy divides."""
    return safe_divide(a, b) if isinstance(b, Tensor) else a / b


def select(condition, a, b):
    """a where a condition holds, else b: entry by entry of tensors, else one or the other number."""
    return torch.where(condition, a, b) if isinstance(condition, Tensor) else a if condition else b


def root(x):
    """√x, 0 where x is negative, of a tensor, an array or dual numbers."""
    return safe_sqrt(x) if isinstance(x, Tensor) else np.sqrt(np.maximum(x, 0.0))


class Vector(tuple):
    """Three numbers, arrays or dual numbers with the arithmetic of a tensor (3, ...)."""

    __slots__ = ()
    __array_ufunc__ = None

    def __sub__(self, other):
        return Vector(a - b for a, b in zip(self, other, strict=True))

    def __mul__(self, factor):
        return Vector(part * factor for part in self)


def _dim(one: Dual, other) -> int:
    """How many axes the two have together."""
    other = other.slope.ndim - 1 if isinstance(other, Dual) else other.ndim if isinstance(other, np.ndarray) else 0
    return max(one.slope.ndim - 1, other)


def _under(slope: np.ndarray, dim: int) -> np.ndarray:
    """Derivatives whose axis of variables stands before so many axes."""
    missing = dim + 1 - slope.ndim
    return slope.reshape(len(slope), *(1,) * missing, *slope.shape[1:]) if missing > 0 else slope


def _sum(one: Dual, other: Dual) -> np.ndarray:
    if one.slope.ndim == other.slope.ndim:
        return one.slope + other.slope
    dim = _dim(one, other)
    return _under(one.slope, dim) + _under(other.slope, dim)


def _where(condition, one, other):
    if not (isinstance(one, Dual) or isinstance(other, Dual)):
        return np.where(condition, one, other)
    value = np.where(condition, value_of(one), value_of(other))
    count = len((one if isinstance(one, Dual) else other).slope)
    parts = [_under(slope_of(x, count), np.ndim(value)) for x in (one, other)]
    return Dual(value, np.where(condition, *parts))


def _stack(numbers, axis: int = 0):
    count = next(len(x.slope) for x in numbers if isinstance(x, Dual))
    values = np.broadcast_arrays(*[value_of(x) for x in numbers])
    shape = values[0].shape
    slopes = [np.broadcast_to(_under(slope_of(x, count), len(shape)), (count, *shape)) for x in numbers]
    return Dual(np.stack(values, axis), np.stack(slopes, axis + 1 if axis >= 0 else axis))


def _concatenate(numbers, axis: int = 0):
    count = next(len(x.slope) for x in numbers if isinstance(x, Dual))
    values, slopes = [value_of(x) for x in numbers], [slope_of(x, count) for x in numbers]
    return Dual(np.concatenate(values, axis), np.concatenate(slopes, axis + 1 if axis >= 0 else axis))


def _larger(one, other):
    return _where(value_of(one) >= value_of(other), one, other)


def _smaller(one, other):
    return _where(value_of(one) <= value_of(other), one, other)


def _root(x: Dual) -> Dual:
    """√x, whose derivative is 0 where x is 0: of a length of nothing, from which every way is up."""
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


_UFUNCS = {
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

_FUNCTIONS = {np.where: _where, np.stack: _stack, np.concatenate: _concatenate}
