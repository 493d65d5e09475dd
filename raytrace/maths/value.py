"""Values: frozen dataclasses of tensors that `torch.func` and `torch.utils._pytree` can walk."""

import dataclasses
import types
import typing

import torch
from torch.utils import _pytree as pytree

_VALUE_TYPES: set[type] = set()

Value = typing.TypeVar("Value")


def value(cls: type) -> type:
    """Make a class a frozen, slotted dataclass and register it as a pytree.

    Tensors, values and tuples of values are its children; every other field (names, flags, `None`) is structure, so
    that `torch.func.vmap`, `jacfwd` and `tree_map` see only numbers. There is no generated `==` (it would raise on
    tensors) and no validation on construction (it would break `vmap`): wrong input is refused at the doors.
    A class that says itself how it is shown keeps its `__repr__`.
    """
    shown = cls.__repr__ is object.__repr__
    cls = dataclasses.dataclass(frozen=True, eq=False, slots=True, repr=shown)(cls)
    fields = dataclasses.fields(cls)
    numeric = {field.name for field in fields if _holds_numbers(field.type)}

    def flatten(instance):
        items = [(field.name, getattr(instance, field.name)) for field in fields]
        children = {name: item for name, item in items if name in numeric and item is not None}
        structure = tuple((name, item) for name, item in items if name not in children)
        return list(children.values()), (tuple(children), structure)

    def unflatten(children, context):
        child_names, structure = context
        return cls(**dict(zip(child_names, children, strict=True)), **dict(structure))

    pytree.register_pytree_node(cls, flatten, unflatten, serialized_type_name=f"raytrace.{cls.__name__}")
    _VALUE_TYPES.add(cls)
    return cls


def _holds_numbers(annotation: object) -> bool:
    """Whether a field of this type holds a tensor, a value or a tuple of values (or None in their place)."""
    if typing.get_origin(annotation) is tuple:
        return typing.get_args(annotation)[0] in _VALUE_TYPES
    if isinstance(annotation, types.UnionType):
        return any(_holds_numbers(member) for member in typing.get_args(annotation))
    return annotation is torch.Tensor or annotation in _VALUE_TYPES


def check_precision(dtype: torch.dtype) -> None:
    """Refuse floating-point numbers of 16 bits and fewer: at a millimetre they are 0.5 µm or more apart."""
    if dtype.is_floating_point and torch.finfo(dtype).bits < 32:
        raise ValueError(f"dtype {dtype}: expected torch.float32 or torch.float64; fewer bits resolve no spot or path")


def to(instance: Value, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Value:
    """The same value with every floating-point tensor in it converted to `dtype` and moved to `device`.

    A tensor that stands in several places (the coefficients of air, say) stays one tensor. Raises ValueError for a
    dtype too coarse for optics (`check_precision`).
    """
    if dtype is not None:
        check_precision(dtype)
    converted: dict[int, torch.Tensor] = {}

    def convert(leaf):
        if not isinstance(leaf, torch.Tensor):
            return leaf
        if id(leaf) not in converted:
            converted[id(leaf)] = leaf.to(device=device, dtype=dtype if leaf.is_floating_point() else None)
        return converted[id(leaf)]

    return pytree.tree_map(convert, instance)


def detached(instance):
    """The same value as plain numbers, without gradients: to be shown or drawn. Tensors that were one stay one."""
    seen: dict[int, torch.Tensor] = {}

    def plain(leaf):
        return seen.setdefault(id(leaf), leaf.detach()) if isinstance(leaf, torch.Tensor) else leaf

    return pytree.tree_map(plain, instance)
