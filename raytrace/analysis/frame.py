"""What the columns of analyses are made of: axes of one common shape, and values that are not there."""

import torch
from torch import Tensor


def axis(values: Tensor, place: int, axes: int) -> Tensor:
    """A vector (n,) as axis number `place` of so many `axes`."""
    return values.reshape(*(-1 if i == place else 1 for i in range(axes)))


def masked(values: Tensor, valid: Tensor) -> Tensor:
    """Values, NaN where invalid: for tables and figures only, never before a derivative."""
    return torch.where(valid, values, torch.nan)
