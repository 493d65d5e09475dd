"""Values: frozen dataclasses of tensors that `torch.func` and `torch.utils._pytree` can walk."""

import dataclasses

import torch
from torch.utils import _pytree as pytree

_VALUE_TYPES: set[type] = set()


def value(cls: type) -> type:
    """Make a class a frozen, slotted dataclass and register it as a pytree.

    Tensors, values and tuples of values are its children; every other field (names, flags, `None`) is structure, so
    that `torch.func.vmap`, `jacfwd` and `tree_map` see only numbers. There is no generated `==` (it would raise on
    tensors) and no validation on construction (it would break `vmap`): wrong input is refused at the doors.
    """
    cls = dataclasses.dataclass(frozen=True, eq=False, slots=True)(cls)
    names = tuple(field.name for field in dataclasses.fields(cls))

    def flatten(instance):
        items = [(name, getattr(instance, name)) for name in names]
        children = {name: item for name, item in items if _is_child(item)}
        structure = tuple((name, item) for name, item in items if name not in children)
        return list(children.values()), (tuple(children), structure)

    def unflatten(children, context):
        child_names, structure = context
        return cls(**dict(zip(child_names, children, strict=True)), **dict(structure))

    pytree.register_pytree_node(cls, flatten, unflatten, serialized_type_name=f"raytrace.{cls.__name__}")
    _VALUE_TYPES.add(cls)
    return cls


def _is_child(item: object) -> bool:
    if isinstance(item, tuple):
        return bool(item) and all(type(entry) in _VALUE_TYPES for entry in item)
    return isinstance(item, torch.Tensor) or type(item) in _VALUE_TYPES


def to(instance, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None):
    """The same value with every floating-point tensor in it converted to `dtype` and moved to `device`."""

    def convert(leaf):
        if not isinstance(leaf, torch.Tensor):
            return leaf
        return leaf.to(device=device, dtype=dtype if leaf.is_floating_point() else None)

    return pytree.tree_map(convert, instance)
