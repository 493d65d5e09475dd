"""Results as tables: every analysis names its columns, and one row is one number of its curves. Loads pandas."""

import abc
from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from raytrace.maths.numerics import broadcast_shape


class Tabular(abc.ABC):
    """A result that can be written as a table."""

    __slots__ = ()

    @abc.abstractmethod
    def columns(self) -> dict[str, Tensor]:
        """Columns by name, broadcast against one another; NaN where no ray arrives."""

    def to_frame(self) -> pd.DataFrame:
        """A table with a row for every point of every curve."""
        return pd.DataFrame(flat(self.columns()))


def flat(columns: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Columns as flat arrays of one length, in the order of their common shape."""
    shape = broadcast_shape(*(column.shape for column in columns.values()))
    return {name: column.detach().cpu().expand(shape).reshape(-1).numpy() for name, column in columns.items()}


def numbered(columns: dict[str, Tensor], **names: Sequence[str]) -> pd.DataFrame:
    """A table in which the numbers of some columns, 0 and up, are replaced by names."""
    frame = pd.DataFrame(flat(columns))
    return frame.assign(**{name: [words[number] for number in frame[name]] for name, words in names.items()})


def axis(values: Tensor, place: int, axes: int) -> Tensor:
    """A vector (n,) as axis number `place` of so many `axes`."""
    return values.reshape(*(-1 if i == place else 1 for i in range(axes)))


def masked(values: Tensor, valid: Tensor) -> Tensor:
    """Values, NaN where invalid: for tables and figures only, never before a derivative."""
    return torch.where(valid, values, torch.nan)
