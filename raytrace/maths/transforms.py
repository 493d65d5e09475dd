"""What surrounds a computation: a graph, a forward derivative, a transform of torch.func.

Private names of torch stand here alone. Nested transforms wrap a tensor once for each; the innermost one shows.
"""

import torch
from torch import Tensor
from torch._C._functorch import get_unwrapped
from torch._C._functorch import is_functorch_wrapped_tensor as is_wrapped
from torch.autograd import forward_ad

__all__ = ["differentiating", "in_forward_mode", "in_transform", "is_any", "is_wrapped", "plain_functions"]

#: A context in which torch's functions take tensors of a subclass as plain ones.
plain_functions = torch._C.DisableTorchFunctionSubclass


def in_transform() -> bool:
    """Whether a transform of torch.func (`grad`, `vmap`, `jvp` …) is under way."""
    return torch._C._are_functorch_transforms_active()


def in_forward_mode() -> bool:
    """Whether a forward derivative of torch is under way."""
    return getattr(forward_ad, "_current_level", -1) >= 0


def has_forward_derivative(number: Tensor) -> bool:
    """Whether a tensor carries a forward derivative of torch."""
    return in_forward_mode() and forward_ad.unpack_dual(number).tangent is not None


def differentiating() -> bool:
    """True if derivatives may be asked for: a graph is recorded, or a forward derivative (`jvp`) is under way.

    False only under `torch.no_grad()` with no forward derivative; then what serves derivatives alone is left out.
    """
    return torch.is_grad_enabled() or in_forward_mode()


def is_any(mask: Tensor) -> bool:
    """Whether any entry of a mask (...) is true; inside `torch.func.vmap`, of any element of its batch.

    A search that ends early then ends when all elements have: `bool(mask.any())` raises an error there.
    """
    while is_wrapped(mask):
        mask = get_unwrapped(mask)
    return bool(mask.any())
