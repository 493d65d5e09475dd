"""Grid: the pixels of a sensor, at an absolute place."""

import torch
from torch import Tensor

from raytrace.maths.value import value


@value
class Grid:
    """rows × columns square pixels.

        x_i = centre_x + (i - (columns - 1)/2)·pitch,   y_j likewise: an odd grid has a pixel at its centre

    pitch: scalar, mm; rows, columns: how many; centre: (2, ...) mm on the sensor, batch axes as those of the kernels.
    """

    pitch: Tensor
    rows: int
    columns: int
    centre: Tensor

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns


def grid(pitch: Tensor | float, size: int | tuple[int, int], centre: Tensor | None = None) -> Grid:
    """A grid of `size` pixels (rows, columns; one number for a square) around `centre`, by default the axis."""
    rows, columns = (size, size) if isinstance(size, int) else size
    pitch = torch.as_tensor(pitch, dtype=torch.float64) if not isinstance(pitch, Tensor) else pitch
    return Grid(pitch, rows, columns, pitch.new_zeros(2) if centre is None else centre)


def centres(grid: Grid) -> tuple[Tensor, Tensor]:
    """x (..., columns) and y (..., rows) of the pixel centres, mm."""
    return _line(grid, 0, grid.columns, 0.0), _line(grid, 1, grid.rows, 0.0)


def edges(grid: Grid) -> tuple[Tensor, Tensor]:
    """x (..., columns + 1) and y (..., rows + 1) of the pixel edges, mm."""
    return _line(grid, 0, grid.columns + 1, -0.5), _line(grid, 1, grid.rows + 1, -0.5)


def _line(grid: Grid, axis: int, count: int, first: float) -> Tensor:
    pixels = grid.columns if axis == 0 else grid.rows
    position = torch.arange(count, dtype=grid.pitch.dtype, device=grid.pitch.device) + (first - 0.5 * (pixels - 1))
    return grid.centre[axis][..., None] + position * grid.pitch
